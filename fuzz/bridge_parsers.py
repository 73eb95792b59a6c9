"""Coverage-guided fuzzing of what reads the bytes of others in the bridge; needs the package `atheris`.

Invariant, for every reader below and any bytes whatever:

1. it returns a value or raises its own error: no other exception, no hang;
2. what it returned is written again as exactly the bytes that were read, where there is one encoding.

    python fuzz/bridge_parsers.py -max_total_time=60 [CORPUS]

Without atheris tests/bridge/log/test_fuzz.py checks the same with random alterations of valid input. Apart from
parsers.py, which is the library's and knows no bridge.
"""

from __future__ import annotations

import sys
from collections.abc import Callable

from rosbridge_eth.channel.wire import Answer, Hello, Kind, Malformed, fields, parse_fields
from rosbridge_eth.log import chunk as chunks
from rosbridge_eth.log.chunk import Chunk, ChunkError, Header
from rosbridge_eth.log.hop import HopError, ServerState, decode_offer, encode_offer
from smcrypto import sm2

_LOG = chunks.Log(b"l" * 32, b"t" * 32)
KEY = sm2.PrivateKey.from_int(1000)
HEADER = chunks.seal(
    _LOG, KEY, [b"one", b"two"], stream=bytes(16), number=0, previous=bytes(32), sealed_ms=0, readers=[KEY.public_key]
).header


def _require(holds: bool, what: str) -> None:
    if not holds:
        raise RuntimeError(f"invariant broken: {what}")


def _header(data: bytes) -> None:
    header = Header.parse(data)
    _require(header.encoded == data and len(data) <= chunks.MAX_HEADER, "header")
    _require((header.records == 0) == (header.body_length == 0) == (not header.grants), "records, body and grants")
    try:
        chunks.content_key(header, KEY)
    except ChunkError:
        return


def _chunk(data: bytes) -> None:
    chunk = Chunk.parse(data)
    _require(chunk.encoded == data, "chunk")
    chunks.verify(_LOG, KEY.public_key, chunk)


def _plaintext(data: bytes) -> None:
    lines = chunks._unpack(HEADER, data)
    _require(len(lines) == HEADER.records and all(lines), "records")
    _require(sum(map(len, lines)) < chunks.MAX_PLAINTEXT and not any(b"\n" in line for line in lines), "lines")


def _offer(data: bytes) -> None:
    _require(encode_offer(*decode_offer(data)) == data, "a robot's offer")


def _state(data: bytes) -> None:
    _require(ServerState.decode(data).encode() == data, "a server's state")


def _answer(data: bytes) -> None:
    _require(Answer.parse(data).to_bytes() == data, "a server's answer in the channel")


def _hello(data: bytes) -> None:
    hello, rest = Hello.parse(data)
    _require(hello.datagram(Kind(data[0]), rest) == data if data[0] in [*Kind] else True, "a handshake's head")


def _fields(data: bytes) -> None:
    parts, offsets = parse_fields(data, [None] * 4)
    _require(fields(parts) == data[: offsets[-1]] and not any(data[offsets[-1] :]), "the fields of a proof")


READERS: tuple[Callable[[bytes], None], ...] = (
    _header, _chunk, _plaintext, _offer, _state, _answer, _hello, _fields,
)  # fmt: skip


def check(data: bytes) -> None:
    """One input: its first byte chooses the reader."""
    if not data:
        return
    try:
        READERS[data[0] % len(READERS)](data[1:])
    except (ChunkError, HopError, Malformed):
        return


if __name__ == "__main__":
    import atheris

    atheris.instrument_all()
    atheris.Setup(sys.argv, check)
    atheris.Fuzz()
