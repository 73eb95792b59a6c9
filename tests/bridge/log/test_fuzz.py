"""The invariant of fuzz/bridge_parsers.py, by hypothesis: valid input, altered, given to every reader."""

from __future__ import annotations

import importlib.util
from pathlib import Path

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from bridge.log.making import sealed
from rosbridge_eth.channel import wire
from rosbridge_eth.log.hop import ServerState, encode_offer

PATH = Path(__file__).resolve().parents[3] / "fuzz" / "bridge_parsers.py"
_SPEC = importlib.util.spec_from_file_location("bridge_parsers", PATH)
assert _SPEC is not None and _SPEC.loader is not None
parsers = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(parsers)

CHUNK = parsers.chunks.seal(
    parsers._LOG, parsers.KEY, [b"one", b"two"], stream=bytes(16), number=0, previous=bytes(32), sealed_ms=0,
    readers=[parsers.KEY.public_key],
)  # fmt: skip
PLACE, DIGEST = bytes(range(24)), bytes(range(32))
INPUTS = [
    CHUNK.header.encoded, CHUNK.encoded, sealed([]).encoded, parsers.chunks._compressed(b"one\ntwo\n", 3) + bytes(20),
    parsers.chunks._compressed(b"one\n" + b"a" * 70_000 + b"\n", 3), encode_offer(CHUNK.encoded),
    encode_offer(CHUNK.encoded, DIGEST),
    ServerState().encode(), ServerState(PLACE, DIGEST, PLACE, 2, 255, DIGEST, "größer").encode(),
    wire.Answer(600, 3, 10**12, 5, b"state").to_bytes(), wire.fields([b"one", b"", b"three", bytes(64)]) + bytes(9),
    wire.Hello(wire.Mode.EXCHANGE, bytes(8), bytes(16)).datagram(wire.Kind.OFFER, b"\0\1piece"),
]  # fmt: skip


@given(st.integers(0, len(parsers.READERS) - 1), st.sampled_from(INPUTS), st.data())
def test_altered_input_breaks_no_invariant(reader, valid, draw):
    data = bytearray(valid)
    for _ in range(draw.draw(st.integers(0, 3))):
        position = draw.draw(st.integers(0, len(data) - 1))
        match draw.draw(st.sampled_from(["change", "remove", "insert", "cut"])):
            case "change":
                data[position] = draw.draw(st.integers(0, 255))
            case "remove" if len(data) > 1:
                del data[position]
            case "insert":
                data.insert(position, draw.draw(st.integers(0, 255)))
            case "cut":
                del data[position + 1 :]
    parsers.check(bytes([reader]) + bytes(data))


@given(st.binary(max_size=100))
@example(b"")
def test_any_bytes_break_no_invariant(data):
    parsers.check(data)


def test_every_reader_accepts_some_input():
    """Otherwise the invariant would hold of nothing."""
    accepted = set()
    for reader in parsers.READERS:
        for valid in INPUTS:
            try:
                reader(valid)
            except (parsers.ChunkError, parsers.HopError, parsers.Malformed):
                continue
            accepted.add(reader)
    assert accepted == set(parsers.READERS)


def test_a_broken_invariant_is_reported():
    with pytest.raises(RuntimeError, match="invariant broken: chunk"):
        parsers._require(False, "chunk")
