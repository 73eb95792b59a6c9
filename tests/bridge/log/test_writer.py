"""The robot's pen: when chunks are closed, what stands in them and in which order, and how they link."""

from __future__ import annotations

import copy
import json
import random
from typing import Any

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bridge.log.making import LOG, READER, ROBOT, repeating
from rosbridge_eth.log.chunk import (
    MAX_BODY,
    MAX_LINE,
    MAX_RECORDS,
    MAX_TIME_MS,
    Chunk,
    NoGrant,
    TooLarge,
    content_key,
    open_lines,
    verify,
)
from rosbridge_eth.log.writer import MAX_JSON, LogWriter
from smcrypto import sm2

STREAM_LINE = b'{"stream":{"source":"sim"}}'
ZEROS = bytes(32)


def writer(**changes: Any) -> LogWriter:
    given: dict[str, Any] = {"previous": ZEROS, "stream_line": STREAM_LINE, "now": 0.0}
    return LogWriter(LOG, ROBOT, [READER.public_key], **given | changes)


def started(**changes: Any) -> LogWriter:
    """A writer whose first chunk, with nothing but the stream's line, is gone at second 1."""
    made = writer(**changes)
    assert [read(chunk) for chunk in made.closed(1.0, 1)] == [(STREAM_LINE,)]
    return made


def read(chunk: Chunk) -> tuple[bytes, ...]:
    verify(LOG, ROBOT.public_key, chunk)
    return open_lines(LOG, chunk, content_key(chunk.header, READER)) if chunk.body else ()


def message(i: int, size: int = 20) -> bytes:
    return (b'{"n":%d}' % i).ljust(size)


def noise(seed: int, size: int) -> bytes:
    """A line that no compressor makes shorter."""
    return random.Random(seed).randbytes(size).replace(b"\n", b" ")


def check_links(chunks: list[Chunk], previous: bytes = ZEROS) -> None:
    number, stream = 0, None
    for chunk in chunks:
        number = number + 1 if chunk.header.stream == stream else 0
        stream = chunk.header.stream
        assert (chunk.header.number, chunk.header.previous) == (number, previous)
        previous = chunk.header.digest


# When


def test_a_chunk_is_closed_a_period_after_its_first_line():
    made = started(period=2.0, now=-1.0)
    made.add(message(0), 5.0)
    made.add(message(1), 6.9)
    assert made.next_timer() == 7.0 and made.closed(6.99, 0) == []
    assert [read(chunk) for chunk in made.closed(7.0, 0)] == [(message(0), message(1))]
    made.add(message(2), 7.5)
    assert made.next_timer() == 9.5


def test_a_start_shows_after_a_period_though_nothing_is_captured():
    made = writer(period=0.5, now=10.0)
    assert made.next_timer() == 10.5 and made.closed(10.4, 0) == []
    assert [read(chunk) for chunk in made.closed(10.5, 0)] == [(STREAM_LINE,)]


def test_a_chunk_is_closed_at_a_thousand_records_and_the_rest_waits_for_its_own_period():
    made = started()
    for i in range(MAX_RECORDS - 1):
        made.add(message(i), 2.0)
    assert made.next_timer() == 3.0 and made.closed(2.1, 0) == []
    made.add(message(999), 2.2)
    made.add(message(1000), 2.3)
    assert made.next_timer() <= 2.3
    (chunk,) = made.closed(2.3, 0)
    assert read(chunk) == tuple(message(i) for i in range(MAX_RECORDS))
    assert made.next_timer() == 3.3
    assert [read(chunk) for chunk in made.closed(3.3, 0)] == [(message(1000),)]


def test_a_chunk_is_closed_at_256_kib_of_json():
    made = started()
    lines = [message(i, 4096) for i in range(MAX_JSON // 4096)]
    for line in lines[:-1]:
        made.add(line, 2.0)
    assert made.closed(2.1, 0) == []
    made.add(lines[-1], 2.1)
    made.add(b"rest", 2.1)
    assert [read(chunk) for chunk in made.closed(2.1, 0)] == [tuple(lines)]


def test_definitions_count_among_the_thousand_records():
    made = writer()
    for i in range(MAX_RECORDS + 500):
        made.add(message(i), 0.1, (f"t{i % 700}", b"type %d" % (i % 700)))
    chunks = [*made.closed(0.1, 0), *made.finish(0)]
    lines = [read(chunk) for chunk in chunks]
    # a definition and its message stay together: 1 + 2 * 499 lines, then 2 * 201 + 598, then what is left of 2201
    assert [len(group) for group in lines] == [999, MAX_RECORDS, 202]
    assert [line for group in lines for line in group if line.startswith(b"{")][1:] == [message(i) for i in range(1500)]


def test_many_lines_at_once_become_several_chunks():
    made = started()
    for i in range(2500):
        made.add(message(i), 2.0)
    chunks = made.closed(2.0, 0)
    assert [chunk.header.records for chunk in chunks] == [1000, 1000]
    assert [chunk.header.records for chunk in made.closed(3.0, 0)] == [500]


def test_silence_is_a_chunk_without_records_every_heartbeat():
    made = started(heartbeat=60.0)
    assert made.next_timer() == 61.0 and made.closed(60.9, 0) == []
    (silent,) = made.closed(61.0, 77)
    assert (silent.header.records, silent.body, silent.header.goodbye, silent.header.sealed_ms) == (0, b"", False, 77)
    verify(LOG, ROBOT.public_key, silent)
    assert made.next_timer() == 121.0
    made.add(message(0), 100.0)
    (chunk,) = made.closed(101.0, 0)
    assert chunk.header.previous == silent.header.digest and made.next_timer() == 161.0


def test_a_machine_that_slept_seals_one_heartbeat_and_not_one_an_hour():
    made = started(heartbeat=60.0)
    assert len(made.closed(1e6, 0)) == 1 and made.next_timer() == 1e6 + 60


@pytest.mark.parametrize(("wall", "sealed"), [(-5, 0), (10**30, MAX_TIME_MS - 1), (123, 123)])
def test_a_mad_clock_does_not_stop_the_log(wall, sealed):
    (chunk,) = writer().finish(wall)
    assert chunk.header.sealed_ms == sealed and Chunk.parse(chunk.encoded) == chunk


# What


def definition(name: str, text: str = "") -> tuple[str, bytes]:
    return name, f'{{"type":"{name}{text}"}}'.encode()


def test_a_definition_stands_before_the_first_message_of_its_type_and_once_a_stream():
    made = writer()
    for i, name in enumerate(("A", "A", "B", "A")):
        made.add(message(i), 0.0, definition(name))
    made.add(b'{"lost":1}', 0.0)
    (chunk,) = made.closed(1.0, 0)
    kinds = [next(iter(json.loads(line))) for line in read(chunk)]
    assert kinds == ["stream", "type", "n", "n", "type", "n", "n", "lost"]
    made.add(message(9), 1.1, definition("A"))
    assert [read(chunk) for chunk in made.closed(3.0, 0)] == [(message(9),)]


def test_a_definition_is_said_again_where_publishers_disagree_about_it():
    made = started()
    for i, text in enumerate(("", "x", "x", "")):
        made.add(message(i), 2.0, definition("A", text))
    (chunk,) = made.closed(3.0, 0)
    assert read(chunk) == (
        b'{"type":"A"}', message(0), b'{"type":"Ax"}', message(1), message(2), b'{"type":"A"}', message(3),
    )  # fmt: skip


def test_a_new_stream_says_its_start_and_definitions_again_and_takes_the_lines_that_wait():
    made = writer()
    made.add(message(0), 0.0, ("A", b"type A"))
    (sealed,) = made.closed(1.0, 0)
    first = made.stream
    made.add(message(1), 1.0, ("A", b"type A"))
    made.new_stream()
    made.add(message(2), 1.1, ("A", b"type A"))
    (chunk,) = made.closed(2.0, 0)
    assert made.stream == chunk.header.stream != first == sealed.header.stream
    assert read(chunk) == (STREAM_LINE, b"type A", message(1), message(2))
    check_links([sealed, chunk])


def test_streams_are_named_by_their_time_and_always_above_the_one_known():
    made = writer(newest=(5_000).to_bytes(8, "big") + bytes(8))
    [first] = made.closed(1.0, 7_000)
    made.new_stream()
    [second] = made.closed(2.0, 3_000)  # the clock was put back
    made.new_stream()
    [third] = made.closed(3.0, 9_000)
    times = [int.from_bytes(one.header.stream[:8], "big") for one in (first, second, third)]
    assert times == [7_000, 7_001, 9_000] and len({one.header.stream[8:] for one in (first, second, third)}) == 3


def test_a_new_stream_with_nothing_to_say_still_begins():
    made = started()
    made.new_stream()
    (chunk,) = made.closed(2.0, 0)
    assert read(chunk) == (STREAM_LINE,) and chunk.header.number == 0


@pytest.mark.parametrize("compress", [True, False])
def test_what_does_not_fit_one_body_is_cut_and_nothing_is_lost(compress):
    made = started(compress=compress)
    lines = [noise(i, 6000) for i in range(44)]
    for line in lines:
        made.add(line, 2.0)
    chunks = made.finish(5)
    assert len(chunks) > 4 and all(len(chunk.body) <= MAX_BODY for chunk in chunks)
    assert [line for chunk in chunks for line in read(chunk)] == lines
    assert [chunk.header.number for chunk in chunks] == list(range(1, len(chunks) + 1))
    assert [chunk.header.goodbye for chunk in chunks] == [False] * (len(chunks) - 1) + [True]


def test_the_longest_lines_fit_and_a_longer_one_is_refused_and_changes_nothing():
    made = writer()
    made.add(noise(0, MAX_LINE), 0.0, ("A", noise(1, MAX_LINE)))
    with pytest.raises(TooLarge):
        made.add(noise(2, MAX_LINE + 1), 0.0)
    with pytest.raises(TooLarge):
        made.add(b"line", 0.0, ("B", noise(2, MAX_LINE + 1)))
    with pytest.raises(TooLarge):
        writer(stream_line=noise(1, MAX_LINE + 1))
    assert [line for chunk in made.finish(0) for line in read(chunk)] == [
        STREAM_LINE, noise(1, MAX_LINE), noise(0, MAX_LINE)
    ]  # fmt: skip


def test_goodbye_is_said_last_and_once_even_with_nothing_to_say():
    made = writer()
    made.add(message(0), 0.0)
    (only,) = made.finish(0)
    assert only.header.goodbye and read(only) == (STREAM_LINE, message(0))
    (silent,) = started().finish(9)
    assert silent.header.goodbye and silent.header.records == 0 and silent.header.number == 1
    verify(LOG, ROBOT.public_key, silent)
    many = started()
    for i in range(2100):
        many.add(message(i), 2.0)
    assert [chunk.header.goodbye for chunk in many.finish(0)] == [False, False, True]


# Links and keys


def test_the_first_chunk_names_the_last_one_of_the_run_before():
    before = writer().finish(0)
    after = writer(previous=before[-1].header.digest)
    check_links([*before, *after.closed(1.0, 0), *after.finish(0)])


steps = st.lists(
    st.one_of(
        st.tuples(st.just("add"), st.integers(1, 3000), st.sampled_from([None, "A", "B"])),
        st.tuples(st.just("wait"), st.floats(0.01, 5.0), st.none()),
        st.tuples(st.just("new"), st.just(0), st.none()),
    ),
    max_size=40,
)


@given(steps, st.booleans())
@settings(max_examples=60)
def test_whatever_happens_the_log_is_linked_and_says_everything_once_in_order(steps, compress):
    made, now, chunks, said = writer(compress=compress, heartbeat=3.0, randomness=repeating()), 0.0, [], []
    for i, (what, size, name) in enumerate(steps):
        if what == "add":
            line = b'{"n":%d,"' % i + noise(i, size) + b'"}'
            made.add(line, now, name and (name, f"type {name}".encode()))
            said.append((line, name))
        elif what == "wait":
            now += size
            chunks += made.closed(now, int(now * 1000))
            assert made.next_timer() > now
        else:
            made.new_stream()
    chunks += made.finish(int(now * 1000))
    check_links(chunks)
    assert [chunk.header.goodbye for chunk in chunks] == [False] * (len(chunks) - 1) + [True]
    found, defined, stream = [], set(), None
    for chunk in chunks:
        for place, line in enumerate(read(chunk)):
            if chunk.header.stream != stream:
                assert line == STREAM_LINE and place == chunk.header.number == 0
                stream, defined = chunk.header.stream, set()
            elif line.startswith(b"type "):
                assert line not in defined
                defined.add(line)
            else:
                name = said[len(found)][1]
                assert name is None or f"type {name}".encode() in defined
                found.append(line)
    assert found == [line for line, _ in said]


def test_two_copies_of_a_robot_with_one_random_source_never_share_a_key():
    """A machine restored from a snapshot, or a process that forked: everything is the same but what is captured."""
    original = writer(randomness=repeating())
    original.add(message(0), 0.0)
    copied = copy.deepcopy(original)
    chunks = []
    for i, fork in enumerate((original, copied)):
        fork.add(message(100 + i), 0.5)
        chunks.append(fork.closed(1.0, 1000))
        fork.add(message(7), 2.0)  # from here on both say the same
        chunks[-1] += fork.finish(2000)
    first, second = chunks
    assert [c.header.stream for c in first] == [c.header.stream for c in second]
    contents: dict[bytes, set[tuple[bytes, ...]]] = {}
    for chunk in first + second:
        contents.setdefault(content_key(chunk.header, READER), set()).add(read(chunk))
    assert all(len(lines) == 1 for lines in contents.values()) and len(contents) >= 3


def test_two_starts_with_one_random_source_never_share_a_key():
    keys = set()
    for i in range(2):
        made = writer(randomness=lambda size: bytes(size))
        made._secret = bytes(32)
        made.add(message(i), 0.0)
        keys.add(content_key(made.finish(0)[0].header, READER))
    assert len(keys) == 2


def test_a_repr_shows_no_line():
    made = writer()
    made.add(b"secret", 0.0)
    assert "secret" not in repr(made)


def test_a_new_reader_opens_the_next_chunk_and_finds_the_definitions_in_it():
    made, late = started(), sm2.PrivateKey.generate()

    def chunk(now: float) -> Chunk:
        made.add(message(0), now - 1, ("T", b'{"type":"T"}'))
        [closed] = made.closed(now, 0)
        return closed

    assert read(chunk(2.0)) == (b'{"type":"T"}', message(0))
    made.change_readers([READER.public_key])
    assert read(chunk(4.0)) == (message(0),), "nothing is said again where nothing changed"
    made.change_readers([READER.public_key, late.public_key])
    both = chunk(6.0)
    assert read(both) == (b'{"type":"T"}', message(0))
    assert open_lines(LOG, both, content_key(both.header, late)) == read(both)
    made.change_readers([late.public_key])
    with pytest.raises(NoGrant):
        read(chunk(8.0))


@given(
    st.lists(st.tuples(st.sampled_from(["", "A", "B"]), st.sampled_from([b"1", b"2"]), st.floats(0, 2))),
    st.booleans(),
)  # fmt: skip
@settings(max_examples=60)
def test_whatever_comes_stands_in_order_behind_its_definition(added, again):
    made, now, chunks = writer(), 0.0, []
    for i, (kind, version, after) in enumerate(added):
        now += after
        made.add(message(i), now, (kind, b"def " + kind.encode() + version) if kind else None)
        chunks += made.closed(now, 0)
        if again and i == len(added) // 2:
            made.new_stream()
    chunks += made.finish(0)
    check_links(chunks)
    assert chunks[-1].header.goodbye
    known: dict[str, bytes] = {}
    seen = []
    for chunk in chunks:
        known = {} if chunk.header.number == 0 else known
        for line in read(chunk):
            if line.startswith(b"def "):
                known[line[4:5].decode()] = line[5:]
            elif line != STREAM_LINE:
                seen.append(json.loads(line)["n"])
                kind, version, _ = added[seen[-1]]
                assert not kind or known[kind] == version
    assert seen == [*range(len(added))]
