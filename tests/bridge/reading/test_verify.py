"""What a reader proves: each way in which a server, a node, a stranger or the robot itself may lie is told, by name."""

from __future__ import annotations

import tracemalloc
from collections.abc import Iterator
from dataclasses import replace
from itertools import permutations

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bridge.reading.world import (
    LEDGER,
    LOG,
    NAME,
    START,
    STREAM_LINE,
    T0,
    DataEvent,
    Pen,
    authority,
    events,
    line,
    message,
    read,
    reader,
    registration,
    revocation,
    robot,
    standing,
)
from rosbridge_eth.capture.lines import parse_line
from rosbridge_eth.errors import VerificationError
from rosbridge_eth.identity import Role, Trust, create_ca, enrol
from rosbridge_eth.log.chunk import Chunk, Log, robot_id
from rosbridge_eth.reading.verdict import Findings, Kind
from rosbridge_eth.reading.verify import NO_DIGEST, Verifier


def tampered(chunk: Chunk, at: int) -> bytes:
    spoiled = bytearray(chunk.encoded)
    spoiled[at] ^= 1
    return bytes(spoiled)


def body_tampered(chunk: Chunk) -> Chunk:
    return replace(chunk, body=bytes([chunk.body[0] ^ 1]) + chunk.body[1:])


# --- nothing is wrong


def test_an_honest_log_is_sound_and_its_records_come_in_order():
    pen = Pen()
    chunks = [pen.write(STREAM_LINE, message(0), message(1)), *pen.chunks(5), pen.write(goodbye=True)]
    result = read(chunks)
    assert result.found == []
    assert result.verdict.sound
    assert result.numbers == [0, 1, 1, 2, 3, 4, 5]
    head = result.verdict.head
    assert head is not None
    assert (head.number, head.digest, head.goodbye) == (6, chunks[-1].header.digest.hex(), True)
    assert (result.verdict.chunks, result.verdict.records) == (7, 7)
    assert [record.place.chunk for record in result.records] == [0, 0, 1, 2, 3, 4, 5]


def test_a_robot_that_wrote_nothing():
    result = read([])
    assert result.verdict.sound
    assert "no chunk of this robot is written" in "\n".join(result.verdict.lines())


def test_a_stream_after_a_goodbye_is_no_restart():
    pen = Pen()
    first = pen.chunks(2, goodbye=True)
    pen.new_stream(b"b" * 16)
    assert read([*first, *pen.chunks(2)]).found == []


@pytest.mark.parametrize("per_event", [1, 2, 100])
def test_how_chunks_are_cut_into_batches_does_not_matter(per_event):
    assert read(data=events(Pen().chunks(5), per_event)).numbers == [0, 1, 2, 3, 4]


# --- chunks


def test_bytes_that_are_no_chunk_hide_nothing_else():
    chunks = Pen().chunks(5)
    result = read([*chunks[:2], b"\x02junk", *chunks[3:]])
    assert [(kind, first) for kind, first, *_ in result.found] == [("malformed", 2), ("missing", 3)]
    assert result.numbers == [0, 1, 3, 4]


def test_an_altered_header_is_forged():
    chunks = Pen().chunks(3)
    result = read([chunks[0], tampered(chunks[1], 60), chunks[2]])
    assert [(kind, first) for kind, first, *_ in result.found] == [("forged", 1), ("missing", 2)]
    assert result.numbers == [0, 2]


def test_an_altered_body_is_told_and_the_chunk_keeps_its_place_in_the_log():
    chunks = Pen().chunks(3)
    result = read([chunks[0], body_tampered(chunks[1]), chunks[2]])
    assert result.only(Kind.ALTERED).places[0][0] == 1
    assert result.numbers == [0, 2]
    assert not result.verdict.sound


def test_an_altered_body_under_an_altered_header_is_forged():
    """That a body does not fit its header says something of the robot only if the header is the robot's."""
    chunks = Pen().chunks(2)
    spoiled = bytearray(body_tampered(chunks[0]).encoded)
    spoiled[60] ^= 1
    assert [kind for kind, *_ in read([bytes(spoiled), chunks[1]]).found] == ["forged", "missing"]


def test_another_robots_chunk():
    stranger = Pen(identity=robot(1, "robot_2"), log=Log(LEDGER, robot_id("robot_2")))
    assert read(stranger.chunks(1)).only(Kind.FORGED).count == 1


def test_a_chunk_that_was_written_for_another_contract_is_refused():
    other = b"M" * 32
    chunk = Pen(log=Log(other, LOG.tk)).write(message(1))
    assert read([chunk]).only(Kind.FORGED).places[0][0] == 0


def test_a_dropped_form_that_the_robot_did_not_sign():
    chunk = Pen().chunks(1)[0]
    assert read([replace(chunk, body=b"")]).only(Kind.FORGED).places[0][0] == 0


def test_the_contracts_hash_of_the_last_chunk_is_held_against_it():
    data = events(Pen().chunks(3))
    stands = standing(data, [registration()])._replace(tail=b"x" * 32)
    assert read(data=data, stands=stands).only(Kind.ALTERED).places[0][0] == 2


def test_a_header_without_its_body_is_dropped_only_if_the_robot_signed_that():
    pen = Pen()
    whole = pen.write(message(1), message(2))
    dropped = pen.drop(whole)
    assert read([dropped, *pen.chunks(1)]).found == [("dropped", 0, 0, 2)]
    assert read([replace(whole, body=b"")]).only(Kind.FORGED).places[0][0] == 0
    assert read([replace(dropped, body=whole.body)]).only(Kind.FORGED).places[0][0] == 0


# --- what is not there


@pytest.mark.parametrize(
    ("gone", "told"),
    [
        ([0], ("withheld", 0, 2, 3)),
        ([1], ("withheld", 3, 5, 3)),
        ([2], ("withheld", 6, 8, 3)),
        ([0, 1, 2], ("withheld", 0, 8, 9)),
    ],
)
def test_events_that_a_node_withholds(gone, told):
    """At the beginning, in the middle, at the end: the contract counts what there is."""
    data = events(Pen().chunks(9, goodbye=True))
    stands = standing(data, [registration()])
    result = read(data=[event for n, event in enumerate(data) if n not in gone], stands=stands)
    assert told in result.found
    assert not result.verdict.sound


def test_events_that_a_node_gives_twice_are_read_once():
    data = events(Pen().chunks(6))
    result = read(data=[data[0], data[0], *data], stands=standing(data, [registration()]))
    assert result.numbers == [0, 1, 2, 3, 4, 5]
    assert result.found == []


def test_what_came_after_the_block_that_is_looked_at_is_left_for_later():
    data = events(Pen().chunks(9))
    assert read(data=data, stands=standing(data[:2], [registration()])).numbers == [0, 1, 2, 3, 4, 5]


def test_a_node_that_claims_an_immense_log_costs_no_memory():
    data = events(Pen().chunks(2))
    stands = standing(data, [registration()])._replace(chunks=2**60)
    assert read(data=[data[0]._replace(first=2**59)], stands=stands).verdict.counts["withheld"] == 2**60 - 2


@pytest.mark.parametrize("gone", [1, 2, 3])
def test_chunks_that_the_server_left_out(gone):
    chunks = Pen().chunks(6)
    found = read(chunks[:2] + chunks[2 + gone :]).only(Kind.MISSING)
    assert (found.places[0][0], found.count) == (2, gone)


def test_a_first_chunk_that_is_not_the_logs_first():
    assert read(Pen().chunks(4)[2:]).only(Kind.MISSING).count == 2


def test_a_stream_whose_end_was_left_out():
    pen = Pen()
    first = pen.chunks(3, goodbye=True)
    pen.new_stream(b"b" * 16)
    result = read([*first[:2], *pen.chunks(2)])
    assert [kind for kind, *_ in result.found] == ["missing", "restarted"]


def test_a_stream_that_was_left_out_whole():
    pen = Pen()
    first = pen.chunks(2, goodbye=True)
    pen.new_stream(b"b" * 16)
    pen.chunks(2, goodbye=True)
    pen.new_stream(b"c" * 16)
    assert read([*first, *pen.chunks(2)]).only(Kind.MISSING).places[0][0] == 2


def test_streams_that_were_left_out_before_the_first():
    pen = Pen()
    pen.chunks(2, goodbye=True)
    pen.new_stream(b"b" * 16)
    assert read(pen.chunks(2)).only(Kind.MISSING).places[0][0] == 0


def test_no_order_but_the_robots_own_is_sound():
    pen = Pen()
    chunks = pen.chunks(2)
    pen.new_stream(b"b" * 16)
    chunks += pen.chunks(2)
    for order in permutations(range(4)):
        result = read([chunks[n] for n in order])
        assert result.verdict.sound == (order == (0, 1, 2, 3)), order
        assert sorted(result.verifier.findings.counts) != [] or order == (0, 1, 2, 3)


# --- forks


def test_two_chunks_with_one_number():
    pen = Pen()
    first, second = pen.chunks(2)
    other = Pen(number=1, previous=first.header.digest, sealed_ms=pen.sealed_ms).write(message(9))
    found = read([first, second, other]).only(Kind.FORKED)
    assert (found.places[0][0], found.count) == (2, 1)
    assert "register --replace" in found.detail


def test_two_machines_with_one_identity_are_told_in_one_sentence_with_the_remedy():
    first, second = Pen(), Pen(stream=b"b" * 16)
    chunks = [pen.write(message(n)) for n in range(100) for pen in (first, second)]
    verdict = read(chunks).verdict
    assert verdict.counts["forked"] > 100
    told = [line for line in verdict.lines() if "forked:" in line and "chunk" in line and "join" in line]
    assert len(told) == 1 and "another machine has this robot's identity" in told[0]


def test_what_stands_behind_a_goodbye_goes_back():
    pen = Pen()
    chunks = [*pen.chunks(2, goodbye=True), *pen.chunks(1)]
    result = read(chunks)
    assert result.only(Kind.FORKED).places == [(2, 2)] and result.numbers == [0, 1, 2]


@pytest.mark.parametrize("known", [True, False])
def test_a_stream_is_named_above_the_one_before(known):
    pen = Pen(stream=b"b" * 16)
    chunks = pen.chunks(2, goodbye=True)
    pen.new_stream(b"a" * 16, None if known else NO_DIGEST)
    result = read([*chunks, pen.write(message(2))])
    assert [kind for kind, *_ in result.found] == ["forked"] + ["restarted"] * (not known)
    assert result.numbers == [0, 1, 2]


def test_the_name_of_a_stream_again():
    pen = Pen()
    chunks = pen.chunks(2, goodbye=True)
    pen.new_stream(b"b" * 16)
    chunks += pen.chunks(2, goodbye=True)
    pen.new_stream(b"a" * 16)
    assert read([*chunks, pen.write(message(4))]).only(Kind.FORKED).places == [(4, 4)]


def test_a_fork_shows_in_what_follows_even_if_the_other_branch_is_not_written():
    pen = Pen()
    first = pen.chunks(1)
    pen.write(message(1))
    hidden = Pen(number=1, previous=first[0].header.digest, sealed_ms=pen.sealed_ms).write(message(9))
    third = pen.write(message(2))
    found = read([first[0], hidden, third]).only(Kind.FORKED)
    assert "where another one is" in found.detail or found.places[0][0] == 2


def test_a_restored_disk_goes_on_from_an_older_chunk():
    pen = Pen()
    chunks = pen.chunks(5)
    restored = Pen(stream=b"b" * 16, previous=chunks[1].header.digest, sealed_ms=pen.sealed_ms)
    result = read([*chunks, *restored.chunks(2)])
    assert [(kind, first) for kind, first, *_ in result.found] == [("forked", 5), ("restarted", 5)]
    assert "disk was put back" in result.verdict.findings[0].detail


@pytest.mark.parametrize("again", [[0], [2], [0, 1, 2], [1, 1]])
def test_a_chunk_that_is_written_twice_is_told_and_given_once(again):
    chunks = Pen().chunks(3)
    rest = Pen(number=3, previous=chunks[2].header.digest, sealed_ms=T0 * 1000 + 3000).chunks(2)
    result = read([*chunks, *(chunks[n] for n in again), *rest])
    assert {kind for kind, *_ in result.found} == {"forked"}
    assert sum(count for *_, count in result.found) == len(again)
    assert result.numbers == [0, 1, 2, 3, 4]


@pytest.mark.parametrize("again", [1, 2])
def test_a_log_s_beginning_that_is_written_again_is_no_restart(again):
    """It names nothing before it, as the first chunk of a robot that lost its disk does."""
    pen = Pen()
    first = pen.chunks(2)
    pen.new_stream(b"b" * 16)
    result = read([*first, *pen.chunks(1), *first[:again]])
    assert result.verdict.counts == {"forked": again, "restarted": 1} and not result.verdict.sound
    assert result.numbers == [0, 1, 0]


def test_one_identity_on_two_robots():
    a, b = Pen(), Pen(stream=b"b" * 16)
    result = read([a.write(message(0)), b.write(message(1)), a.write(message(2)), b.write(message(3))])
    assert result.verdict.counts["forked"] == 2
    assert result.numbers == [0, 1, 2, 3]


# --- certificates


def changed() -> tuple[list[Chunk], list]:
    """Three chunks under one certificate, three under its successor."""
    old, new = Pen(), Pen(identity=robot(1), stream=b"b" * 16)
    chunks = old.chunks(3, goodbye=True)
    new.previous, new.sealed_ms = old.previous, old.sealed_ms
    chunks += new.chunks(3)
    return chunks, [registration(), revocation(3, 5), registration(robot(1), 3, 5, 5)]


def test_which_certificate_governs_goes_by_the_index():
    chunks, registered = changed()
    result = read(chunks, registrations=registered)
    assert result.found == []
    assert [one.first for one in result.verdict.certificates] == [0, 3, 3]
    assert result.verdict.certificates[1].revoked
    assert len({one.fingerprint for one in result.verdict.certificates}) == 3


def test_a_chunk_under_the_certificate_before_or_after_is_forged():
    chunks, registered = changed()
    for index in (2, 4):
        moved = [replace(one, index=index if n else 0) for n, one in enumerate(registered)]
        assert any(kind == "forged" for kind, *_ in read(chunks, registrations=moved).found)


def test_a_chunk_after_the_revocation():
    result = read(Pen().chunks(4), registrations=[registration(), revocation(2, 5)])
    assert result.found == [("untrusted", 2, 3, 2)]
    assert result.numbers == [0, 1]


@pytest.mark.parametrize(
    "identity",
    [
        pytest.param(lambda: robot(0, "robot_9"), id="another name"),
        pytest.param(lambda: robot(0, NAME, Role.READER), id="another role"),
        pytest.param(lambda: enrol(create_ca("Other", at=START), Role.ROBOT, NAME, at=START), id="another CA"),
    ],
)
def test_a_registered_certificate_that_is_not_to_be_trusted(identity):
    one = identity()
    result = read(Pen(identity=one).chunks(2), registrations=[registration(one)])
    assert result.only(Kind.UNTRUSTED).count == 2
    assert result.numbers == []
    assert "NOT TRUSTED" in "\n".join(result.verdict.lines())


@pytest.mark.parametrize("certificates", [b"", b"\x30\x82", b"junk" * 100])
def test_a_registration_without_certificates(certificates):
    registered = [registration(certificates=certificates)]
    assert read(Pen().chunks(1), registrations=registered).only(Kind.UNTRUSTED).places[0][0] == 0


def test_a_robot_without_registration():
    result = read(Pen().chunks(1), registrations=[])
    assert "no certificate is registered" in result.only(Kind.UNTRUSTED).detail


@pytest.mark.parametrize("block_time", [0, T0 - 400 * 86_400, -5, 2**240])
def test_no_clock_of_a_chain_makes_an_error_and_one_that_is_behind_does_no_harm(block_time):
    result = read(Pen().chunks(2), block_time=lambda block: block_time)
    if block_time < T0:
        assert {kind for kind, *_ in result.found} == {"clock"}
        assert result.numbers == [0, 1]
    else:
        assert result.only(Kind.UNTRUSTED).count == 2


def after_the_end() -> int:
    return int(robot().public.not_after.timestamp()) + 1


def test_a_certificate_that_had_ended_when_it_was_registered():
    result = read(Pen().chunks(1), block_time=lambda block: after_the_end())
    assert "valid" in result.only(Kind.UNTRUSTED).detail


def test_what_was_sealed_after_the_certificates_end():
    pen = Pen()
    chunks = [pen.write(message(0)), pen.write(message(1), sealed_ms=after_the_end() * 1000)]
    result = read(chunks)
    assert result.only(Kind.UNTRUSTED).places[0][0] == 1
    assert result.numbers == [0]


def test_what_was_sealed_in_time_and_written_after_the_certificates_end_counts():
    times = {1: T0}  # the block of the registration
    assert read(Pen().chunks(2), block_time=lambda block: times.get(block, after_the_end())).found == []


def test_a_registration_that_a_node_withholds():
    chunks, registered = changed()
    data = events(chunks)
    stands = standing(data, registered)
    for shown in ([], registered[:1], registered[:2], registered[1:], [registered[0], registered[2]]):
        result = read(data=data, registrations=shown, stands=stands)
        assert any(kind == "withheld" for kind, *_ in result.found), shown


# --- content


def test_a_chunk_for_other_readers_is_a_notice_with_its_records():
    pen = Pen(readers=[reader("insurer")])
    result = read(pen.chunks(2, records=5))
    assert result.only(Kind.NO_GRANT).count == 10
    assert result.verdict.sound


def test_without_a_key_everything_but_the_content_is_checked():
    chunks = Pen().chunks(3)
    assert read(chunks, keyless=True).only(Kind.NO_GRANT).count == 3
    assert [kind for kind, *_ in read([chunks[0], chunks[2]], keyless=True).found] == ["no-grant", "missing"]


def test_a_key_that_the_robot_wrapped_wrongly_is_none_for_this_reader(monkeypatch):
    pen = Pen()
    other = reader("insurer").encryption_key.public_key
    key = type(other)
    encrypt = key.encrypt
    monkeypatch.setattr(key, "encrypt", lambda self, data, encoding: encrypt(other, data, encoding=encoding))
    chunk = pen.write(message(1))
    monkeypatch.undo()
    result = read([chunk, *Pen(number=1, previous=pen.previous, sealed_ms=pen.sealed_ms).chunks(1)])
    assert result.only(Kind.NO_GRANT).places[0][0] == 0
    assert result.numbers == [1]


def test_a_reader_who_comes_behind_others_tries_all_grants_once(monkeypatch):
    from rosbridge_eth.reading import verify

    asked = []
    unwrap = verify.unwrap

    def asking(header, key, likely):
        asked.append(likely)
        return unwrap(header, key, likely)

    monkeypatch.setattr(verify, "unwrap", asking)
    pen, facts = Pen(readers=[reader("insurer"), reader()]), dict[bytes, bytes]()
    chunks = pen.chunks(3)
    assert read(chunks).verdict.sound
    assert asked == [0, 1, 1]
    for _ in range(2):
        assert read(chunks, key=reader("stranger"), facts=facts).only(Kind.NO_GRANT).count == 3
    assert asked == [0, 1, 1, 0, 0, 0], "that it was granted nothing is a fact, too"


def test_a_root_that_is_not_the_records(monkeypatch):
    from rosbridge_eth.log import chunk as chunks

    with monkeypatch.context() as lie:
        lie.setattr(chunks, "_leaf", lambda salt, line: b"\0" * 32)
        lying = Pen().write(message(1), message(2))
    assert read([lying]).only(Kind.UNOPENABLE).places[0][0] == 0


HOSTILE = [
    b"not json",
    b"[" * 5000,
    b'{"a":' * 200 + b"1" + b"}" * 200,
    b"null",
    b"\xff\xfe",
    line({"topic": "/t"}),
    message(10**400),
    message(1).replace(b'"received_ns":1', b'"received_ns":1' + b"0" * 30),
    message(1).replace(b'"received_ns":1', b'"received_ns":-1'),
    message(1).replace(b'"x":1', b'"x":1e999'),
    message(1).replace(b'"x":1', b'"x":NaN'),
    message(1).replace(b'"x":1', b'"x":"\\ud800"'),
    message(1).replace(b'"x":1', b'"x":1,"x":2'),
    message(1) + b" ",
    message(0, text="x" * 100_000),
    line({"lost": 10**30, "topic": "/t", "why": "dropped"}),
    line({"lost": -1, "topic": "/t", "why": "dropped"}),
    line({"stream": []}),
]


@pytest.mark.parametrize("hostile", HOSTILE, ids=lambda value: repr(value[:24]))
def test_a_line_that_does_not_parse_is_told_and_hides_nothing_else(hostile):
    pen = Pen()
    result = read([pen.write(message(1), hostile, message(2)), pen.write(message(3))])
    found = result.only(Kind.UNOPENABLE)
    assert found.places[0][0] == 0
    assert found.detail.startswith("line 1:")
    assert result.numbers == [1, 2, 3]
    assert all(text.isprintable() for text in result.verdict.lines())


LINES = st.binary(min_size=1, max_size=40).filter(lambda value: b"\n" not in value)


@settings(max_examples=40)
@given(st.lists(LINES | st.sampled_from(HOSTILE), max_size=8))
def test_whatever_a_robot_signs_the_reading_ends_with_a_verdict(lines):
    pen = Pen()
    result = read([pen.write(*lines), pen.write(message(3))])
    bad = sum(not _parses(one) for one in lines)
    assert result.verdict.counts.get("unopenable", 0) == bad
    assert result.numbers[-1] == 3
    assert all(text.isprintable() for text in result.verdict.lines())


def _parses(value: bytes) -> bool:
    try:
        parse_line(value)
    except VerificationError:
        return False
    return True


@settings(max_examples=60)
@given(st.data())
def test_no_bytes_on_the_chain_end_a_reading_and_none_of_the_robots_records_is_invented(data):
    chunks = [chunk.encoded for chunk in CHUNKS]
    for _ in range(data.draw(st.integers(1, 4))):
        at = data.draw(st.integers(0, len(chunks) - 1))
        whole = chunks[at] or b"\0"
        chunks[at] = data.draw(
            st.binary(max_size=300)
            | st.integers(0, len(whole) * 8 - 1).map(lambda bit, w=whole: _flipped(w, bit))
            | st.integers(0, len(whole)).map(lambda cut, w=whole: w[:cut])
            | st.just(whole + b"\0")
            | st.sampled_from(chunks)
        )
    result = read(chunks)
    assert set(result.numbers) <= set(range(len(CHUNKS)))
    assert len(result.numbers) == len(set(result.numbers))
    assert result.verdict.sound == (chunks == [chunk.encoded for chunk in CHUNKS])


CHUNKS = Pen().chunks(5)


def _flipped(data: bytes, bit: int) -> bytes:
    changed = bytearray(data)
    changed[bit // 8] ^= 1 << bit % 8
    return bytes(changed)


# --- notices


def test_what_the_robot_dropped_is_summed():
    pen = Pen()
    chunks = pen.chunks(6, records=7)
    result = read([pen.drop(chunk) if n in (1, 2, 4) else chunk for n, chunk in enumerate(chunks)])
    found = result.only(Kind.DROPPED)
    assert (found.places, found.count) == ([(1, 2), (4, 4)], 21)
    assert "dropped: chunks 1 to 2, 4: 21 records: " in "\n".join(result.verdict.lines())
    assert result.verdict.as_json()["findings"][0]["places"] == [(1, 2), (4, 4)]
    assert result.verdict.sound
    assert len(result.numbers) == 21


def test_of_endlessly_many_places_the_first_are_kept_and_the_others_counted():
    findings = Findings({}, [])
    for n in range(1_000):
        findings.add(Kind.DROPPED, 2 * n, count=3)
    [found] = findings.kept
    assert (len(found.places), found.more, found.count) == (100, 900, 3_000)
    assert "196, 198 and 900 places behind: 3,000 records" in str(found)


@pytest.mark.parametrize("between", [0, 2])
def test_a_whole_chunk_behind_its_dropped_form_is_opened_once(between):
    pen = Pen()
    chunks = pen.chunks(4, records=2)
    order = [chunks[0], pen.drop(chunks[1]), *chunks[2 : 2 + between], chunks[1], *chunks[2 + between :]]
    result = read(order)
    opened = [0, 1, *range(4, 4 + 2 * between), 2, 3, *range(4 + 2 * between, 8)]
    assert result.numbers == opened
    assert result.verdict.sound and result.verdict.counts == {"dropped": 2}
    altered = replace(chunks[1], body=bytes([chunks[1].body[0] ^ 1]) + chunks[1].body[1:])
    result = read([*order[:-1], altered, order[-1], chunks[1]])
    assert result.numbers == opened and result.verdict.counts["forked"] >= 1, "once, and nothing is opened twice"
    first = read([chunks[0], pen.drop(chunks[1]), altered, chunks[1]])
    assert first.numbers == [0, 1, 2, 3] and not first.verdict.sound


def test_what_was_lost_before_sealing_is_summed_by_topic_and_reason():
    pen = Pen()
    counts = ((3, "/scan"), (4, "/scan"), (1, "/odom"))
    lost = [line({"lost": n, "topic": topic, "why": "too long"}) for n, topic in counts]
    result = read([pen.write(message(1), *lost), pen.write(lost[0])])
    assert result.found == [("lost", 0, 1, 10), ("lost", 0, 0, 1)]
    assert result.verdict.counts == {"lost": 11}
    assert result.verdict.sound


@pytest.mark.parametrize("knows", [True, False])
def test_restarts_without_goodbye_are_counted(knows):
    pen, chunks = Pen(), []
    for name in b"abcd":
        pen.new_stream(bytes([name]) * 16, None if knows else NO_DIGEST)
        chunks += pen.chunks(2)
    result = read(chunks)
    assert result.only(Kind.RESTARTED).count == 3
    assert result.verdict.counts == {"restarted": 3}
    assert result.verdict.sound
    assert ("knows of nothing before" in result.verdict.findings[0].detail) == (not knows)


def test_why_and_when_records_were_written_late_is_told():
    pen, event = Pen(), {"trigger": "crash\x1b[2J", "why": "/bumper data == true", "at_ns": 1_700_000_000_500_000_000}
    result = read([pen.write(message(1)), pen.write(line(event), message(2))])
    assert result.verdict.sound and result.found == [("triggered", 1, 1, 1)]
    [finding] = result.verdict.findings
    assert finding.detail.endswith(": /bumper data == true, 2023-11-14T22:13:20.500Z") and "\x1b" not in finding.detail


def test_a_robot_that_lost_its_spool_after_a_goodbye():
    pen = Pen()
    chunks = pen.chunks(2, goodbye=True)
    pen.new_stream(b"b" * 16, NO_DIGEST)
    assert read([*chunks, *pen.chunks(1)]).only(Kind.RESTARTED).count == 1


@pytest.mark.parametrize(
    ("times", "told"),
    [
        ([0, 1000, 500], 0),  # what NTP does
        ([0, 100_000, 98_000], 1),
        ([0, 600_000, 601_000], 2),  # ahead of their blocks, by more than five minutes
        ([-10 * 86_400_000, 0, 1000], 1),  # before the certificate
        ([0, -20 * 86_400_000, 0], 2),  # a clock that was reset
    ],
)
def test_clocks_that_cannot_be_right(times, told):
    pen = Pen()
    result = read([pen.write(message(n), sealed_ms=T0 * 1000 + offset) for n, offset in enumerate(times)])
    assert result.verdict.counts.get("clock", 0) == told
    assert result.verdict.sound


def test_messages_captured_while_the_clock_was_not_synchronised_are_counted():
    pen = Pen()
    off = [message(n, clock=False) for n in range(3)]
    result = read([pen.write(message(1), *off[:2]), pen.write(off[2])])
    assert result.only(Kind.CLOCK).count == 3


@pytest.mark.parametrize(("hours", "goodbye", "silent"), [(0.5, False, False), (2, False, True), (2, True, False)])
def test_silence_longer_than_the_heartbeat_is_told(hours, goodbye, silent):
    verdict = read(Pen().chunks(2, goodbye=goodbye), now=T0 + hours * 3600).verdict
    assert verdict.silent == silent
    assert next(read(Pen().chunks(1)).verdict.lines()) == "robot_1: sound, 1 chunk, read up to block 1000"
    assert ("longer ago than 1h, a robot's heartbeat" in "\n".join(verdict.lines())) == silent
    assert verdict.sound


# --- memory


def test_memory_does_not_grow_with_the_log(tmp_path):
    """160 chunks of 50 KiB: what is kept of them is their places, not their content."""
    pen, filler = Pen(), "x" * 50_000
    lengths = []
    with (tmp_path / "chunks").open("wb") as file:
        for n in range(160):
            lengths.append(file.write(pen.write(message(n, text=filler)).encoded))

    def grown(count: int) -> int:
        def log() -> Iterator[DataEvent]:
            with (tmp_path / "chunks").open("rb") as file:
                for first, length in enumerate(lengths[:count]):
                    yield DataEvent(first, 0, (file.read(length),), first + 2, b"", "")

        stands = standing([], [registration()])._replace(chunks=count)
        verifier = Verifier(
            NAME, LEDGER, stands, [registration()], trust=Trust([authority().certificate]), block=9,
            reader=reader().encryption_key, block_time=lambda block: T0 + block, now=T0,
        )  # fmt: skip
        tracemalloc.reset_peak()
        begin = tracemalloc.get_traced_memory()[0]
        assert sum(1 for _ in verifier.read(log())) == count
        return tracemalloc.get_traced_memory()[1] - begin

    tracemalloc.start()
    try:
        grown(10)  # tables of keys, caches of the JSON parser
        small, large = grown(20), grown(160)
    finally:
        tracemalloc.stop()
    assert large < small + 100_000


def test_findings_are_counted_beyond_those_that_are_kept():
    pen = Pen()
    lines = [line({"lost": 1, "topic": f"/t{n}", "why": "x" * 1000}) for n in range(900)]
    verdict = read([pen.write(*lines)]).verdict
    assert verdict.counts["lost"] == 900
    assert len(verdict.findings) == 250
    assert sum(map(len, verdict.lines())) < 200_000
    assert any("only the first 250 findings" in text for text in verdict.lines())
    whole = read([Pen().write(*lines[:250])]).verdict
    assert len(whole.findings) == 250
    assert not any("only the first" in text for text in whole.lines())


def test_an_empty_chunk_at_the_end_is_malformed_and_the_contract_s_own():
    read([*Pen().chunks(2), b""]).only(Kind.MALFORMED)


def test_definitions_are_bounded():
    rest = {"wire": "ros1", "format": "msg", "definition": "int8 x\n"}
    lines = [line({"type": f"a/msg/T{n}"} | rest) for n in range(300)]
    assert len(read([Pen().write(*lines, message(1))]).verifier.progress().types) == 256


# --- terminals


EVIL = ["\x1b[2J\x1b]0;owned\x07", "a\nb\rc", "\u202e\u2066evil", "\x9b31m", "\x7f", "\U000e0041"]


@pytest.mark.parametrize("evil", EVIL)
def test_nothing_of_a_log_acts_on_a_terminal(evil):
    pen = Pen()
    hostile = line({"lost": 3, "topic": "/" + evil, "why": evil})
    result = read([pen.write(hostile, message(1, **{evil: evil}), b'{"' + evil.replace("\n", "").encode() + b'":1}')])
    assert all(text.isprintable() for text in result.verdict.lines())
    assert result.verdict.counts == {"lost": 3, "unopenable": 1}


def test_the_accounts_and_names_of_certificates_are_escaped():
    result = read(Pen().chunks(1), registrations=[registration(account="\x1b[2J")])
    assert "\\u001b" in result.verdict.certificates[0].account
