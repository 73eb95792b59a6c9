"""What a reader proves: each way in which a server, a stranger or a node may lie is found, as its own finding."""

from __future__ import annotations

import json
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, replace
from datetime import UTC, datetime, timedelta
from functools import cache, partial

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rosbridge_eth.errors import VerificationError
from rosbridge_eth.identity import Identity, Role, Trust, create_ca, enrol, sign, verify
from rosbridge_eth.reading import Finding, FindingKind, ProvenHistory, join_certificates, prove, split_certificates
from rosbridge_eth.records import RecordId, SealedRecord, SeqRange, robot_id
from rosbridge_eth.sealing import Opener, Sealer, StreamLimits

NAME, ACCOUNT, STRANGER = "robot_1", "0x" + "aB" * 20, "0x" + "cd" * 20
ROBOT = robot_id(NAME)
START = datetime(2026, 1, 1, tzinfo=UTC)
T0 = int(START.timestamp()) + 3600
NS = 10**9
REGISTERED, FIRST = 5, 10  # blocks


@cache
def authority():
    return create_ca("Test CA", at=START)


@cache
def robot(number: int = 0, name: str = NAME, role: Role = Role.ROBOT, days: int = 365) -> Identity:
    return enrol(authority(), role, name, at=START, valid_for=timedelta(days=days))


@cache
def reader(name: str = "reader_1") -> Identity:
    return enrol(authority(), Role.READER, name, at=START)


@dataclass(frozen=True)
class Item:
    record: SealedRecord
    block_number: int
    block_timestamp: int
    log_index: int = 0
    leaf: int = 0
    tx_hash: bytes = b"\x11" * 32
    sender: str = ACCOUNT.lower()


@dataclass(frozen=True)
class Registered:
    account: str
    certificates: bytes
    block_number: int = REGISTERED
    block_timestamp: int = T0
    revoked_block: int | None = None


def registration(identity: Identity | None = None, **more) -> Registered:
    identity = identity or robot()
    certificates = join_certificates(
        identity.signing_certificate.to_der(), identity.encryption_certificate.to_der()
    )
    return Registered(ACCOUNT, certificates, **more)


def sealer(identity: Identity | None = None, readers: Iterable[Identity] | None = None, **more) -> Sealer:
    identity = identity or robot()
    keys = [one.encryption_key.public_key for one in readers or [reader()]]
    return Sealer(ROBOT, partial(sign, identity.signing_key), keys, **more)


def payload(n: int, **more) -> bytes:
    return json.dumps({"topic": "/odom", "wall_ns": n, "clock": True, "data": {"x": n}} | more).encode()


def sealed(count: int, seal: Sealer | None = None, end: bool = True) -> list[SealedRecord]:
    """open, data 1 .. count, and the end."""
    seal = seal or sealer()
    records = [record for n in range(1, count + 1) for record in seal.seal(payload(n), T0 * NS)]
    return records + list(seal.end(T0 * NS) if end else ())


def written(records: Sequence[SealedRecord], first_block: int = FIRST, per_block: int = 4) -> list[Item]:
    return [
        Item(record, first_block + n // per_block, T0 + n // per_block, leaf=n % per_block)
        for n, record in enumerate(records)
    ]


def read(items: Sequence[Item], registrations=None, key: Identity | None = None, **more) -> ProvenHistory:
    opener = Opener((key or reader()).encryption_key)
    registrations = [registration()] if registrations is None else registrations
    return prove(NAME, registrations, items, trust=Trust([authority().certificate]), opener=opener, **more)


def kinds(history: ProvenHistory) -> list[FindingKind]:
    return [found.kind for found in history.findings]


def only(history: ProvenHistory, kind: FindingKind) -> Finding:
    """The one finding, which is of this kind."""
    assert kinds(history) == [kind], [str(found) for found in history.findings]
    return history.findings[0]


def numbers(history: ProvenHistory) -> list[int]:
    return [record.content()["data"]["x"] for record in history.records]


# --- nothing is wrong


def test_an_honest_history_is_complete_and_in_order():
    items = written(sealed(9))
    history = read(items)
    assert history.findings == ()
    assert history.is_complete
    assert numbers(history) == list(range(1, 10))
    assert [record.item for record in history.records] == items[1:-1]
    (stream,) = history.streams
    assert (stream.granted, stream.highest, stream.end, stream.proven, stream.dropped) == (True, 10, 10, 11, 0)
    history.require_sound()


def test_each_record_carries_its_proof():
    record = read(written(sealed(1))).records[0].opened
    verify(robot().signing_certificate.public_key, "record", record.bound + record.payload, record.signature)


def test_streams_follow_each_other_whatever_the_order_on_the_chain():
    seal = sealer(limits=StreamLimits(records=3))
    records = sealed(7, seal)
    first, second, third, fourth = (
        [r for r in records if r.id.stream == s] for s in dict.fromkeys(r.id.stream for r in records)
    )
    history = read(written([*third, *fourth, *first, *second]))
    assert numbers(history) == list(range(1, 8))
    assert history.is_complete


def test_an_empty_history():
    assert read([]).findings == ()


# --- a server that alters, drops, withholds, reorders, doubles


@pytest.mark.parametrize("seq", [1, 4, 6])
def test_an_altered_record(seq):
    items = written(sealed(5))
    spoiled = bytearray(items[seq].record.ciphertext)
    spoiled[100] ^= 1
    items[seq] = replace(items[seq], record=SealedRecord(items[seq].record.id, bytes(spoiled)))
    history = read(items)
    found = history.findings[0]
    assert (found.kind, found.first, found.block) == (FindingKind.ALTERED, seq, items[seq].block_number)
    # Losing the end record costs the knowledge that nothing follows, and nothing else.
    assert kinds(history)[1:] == ([FindingKind.END_UNKNOWN] if seq == 6 else [])
    assert numbers(history) == [n for n in range(1, 6) if n != seq]
    with pytest.raises(VerificationError, match="altered"):
        history.require_sound()


def test_bytes_that_are_no_record():
    items = written(sealed(3))
    items[2] = replace(items[2], record=SealedRecord(items[2].record.id, b"\x01\x01"))
    assert only(read(items), FindingKind.MALFORMED).first == 2


def test_a_record_under_anothers_identity():
    items = written(sealed(3))
    items[2] = replace(items[2], record=SealedRecord(items[2].record.id, items[1].record.ciphertext))
    assert only(read(items), FindingKind.ALTERED).first == 2


@pytest.mark.parametrize("gone", [[1], [3], [2, 3, 4], [1, 5]])
def test_withheld_records(gone):
    items = [item for item in written(sealed(5)) if item.record.id.seq not in gone]
    history = read(items)
    assert set(kinds(history)) == {FindingKind.MISSING}
    assert [n for f in history.findings for n in range(f.first, f.last + 1)] == gone
    assert not history.is_complete


def test_a_withheld_end_is_unknown_and_not_taken_for_complete():
    history = read(written(sealed(5)[:-1]))
    assert "after record 5" in str(only(history, FindingKind.END_UNKNOWN))
    assert history.violations == ()
    assert not history.is_complete


def test_a_withheld_tail_is_found_once_the_next_stream_is_written():
    seal = sealer(limits=StreamLimits(records=6))
    records = sealed(8, seal)
    assert [record.id.seq for record in records] == [0, 1, 2, 3, 4, 5, 0, 1, 2, 3, 4]
    found = only(read(written([*records[:4], *records[6:]])), FindingKind.TAIL_MISSING)
    assert (found.stream, found.first, found.last) == (records[0].id.stream, 4, 5)


def test_a_withheld_tail_that_includes_the_end_record():
    seal = sealer()
    records = [*sealed(3, seal), *sealed(2, seal)]
    found = only(read(written([*records[:3], *records[5:]])), FindingKind.TAIL_MISSING)
    assert (found.first, found.last) == (3, 4)


def test_a_wholly_withheld_stream():
    seal = sealer(limits=StreamLimits(records=3))
    records = sealed(6, seal)
    found = only(read(written(records[3:])), FindingKind.UNKNOWN_PREVIOUS)
    assert records[0].id.stream.hex()[:8] in found.detail
    assert "3 records" in found.detail


def test_a_withheld_open_record():
    records = sealed(3)
    history = read(written(records[1:]))
    assert only(history, FindingKind.NO_OPEN).stream == records[0].id.stream
    assert history.records == ()


def test_an_altered_open_record():
    items = written(sealed(3))
    spoiled = bytearray(items[0].record.ciphertext)
    spoiled[20] ^= 1
    items[0] = replace(items[0], record=SealedRecord(items[0].record.id, bytes(spoiled)))
    assert set(kinds(read(items))) == {FindingKind.FORGED, FindingKind.NO_OPEN}


def test_reordered_records_are_told_and_shown_in_order():
    records = sealed(5)
    history = read(written([records[n] for n in (0, 1, 4, 2, 3, 5, 6)]))
    assert {found.kind for found in history.findings} == {FindingKind.REORDERED}
    assert {seq for found in history.findings for seq in range(found.first, found.last + 1)} == {2, 3}
    assert numbers(history) == [1, 2, 3, 4, 5]


def test_neighbours_that_come_late_in_one_block_are_one_finding():
    records = sealed(9)
    items = written([records[n] for n in (0, 9, 1, 2, 3, 7, 8, 4, 5, 6, 10)])
    history = read([replace(item, block_number=FIRST, leaf=place) for place, item in enumerate(items)])
    assert [(found.first, found.last) for found in history.findings if found.kind is FindingKind.REORDERED] == [(1, 8)]
    assert numbers(history) == list(range(1, 10))


def test_a_doubled_record():
    items = written(sealed(3))
    again = replace(items[2], block_number=FIRST + 9)
    history = read([*items, again])
    found = only(history, FindingKind.DUPLICATED)
    assert (found.first, found.block) == (2, FIRST + 9)
    assert numbers(history) == [1, 2, 3]
    assert history.violations


@pytest.mark.parametrize("lie_first", [True, False])
def test_two_versions_of_a_record(lie_first):
    items = written(sealed(3))
    lie = replace(items[2], record=SealedRecord(items[2].record.id, bytes([1, 1]) + bytes(254)),
                  block_number=1 + REGISTERED if lie_first else FIRST + 9)
    history = read([*items, lie])
    assert set(kinds(history)) == {FindingKind.CONFLICTING, FindingKind.ALTERED}
    assert numbers(history) == [1, 2, 3]


# --- others who write


def test_a_record_with_a_huge_seq_that_somebody_made_up_moves_no_end():
    items = written(sealed(3))
    made_up = Item(SealedRecord(RecordId(ROBOT, items[0].record.id.stream, 2**63), bytes([1, 1]) + bytes(254)), 12, T0)
    history = read([*items, made_up])
    assert only(history, FindingKind.ALTERED).first == 2**63


def test_a_stream_that_somebody_made_up():
    fake = sealed(2, sealer(robot(1)))
    history = read(written([*sealed(2), *fake]))
    assert {(f.kind, f.stream) for f in history.findings} == {
        (FindingKind.FORGED, fake[0].id.stream), (FindingKind.NO_OPEN, fake[0].id.stream)}
    assert numbers(history) == [1, 2]


def test_another_robots_stream_under_this_robots_name():
    """Same CA, another robot: its certificate is not registered for this name."""
    other = robot(0, "robot_2")
    history = read(written(sealed(2, sealer(other))), [registration(), registration(other, block_number=6)])
    assert set(kinds(history)) == {FindingKind.UNTRUSTED, FindingKind.FORGED, FindingKind.NO_OPEN}
    assert history.records == ()


def test_records_of_another_robot_are_set_aside():
    items = written(sealed(2))
    foreign = replace(items[1], record=SealedRecord(RecordId(b"x" * 32, b"y" * 16, 0), b"z"))
    assert only(read([*items, foreign]), FindingKind.OTHER_ROBOT).stream == b"y" * 16


def test_written_by_a_strangers_account():
    items = written(sealed(2))
    items[1] = replace(items[1], sender=STRANGER)
    assert STRANGER in only(read(items), FindingKind.STRANGER).detail


def test_written_before_the_robot_was_registered():
    items = written(sealed(2), first_block=REGISTERED - 1, per_block=1)
    assert "before any registration" in read(items).findings[0].detail


def test_an_unregistered_robot():
    assert kinds(read(written(sealed(1)), [])) == [FindingKind.UNREGISTERED, FindingKind.NO_OPEN]


# --- certificates


@pytest.mark.parametrize(
    "identity",
    [
        pytest.param(lambda: robot(0, "robot_9"), id="another name"),
        pytest.param(lambda: robot(0, NAME, Role.READER), id="another role"),
        pytest.param(lambda: enrol(create_ca("Other", at=START), Role.ROBOT, NAME, at=START), id="another CA"),
        pytest.param(lambda: enrol(authority(), Role.ROBOT, NAME, at=START + timedelta(days=9)), id="not valid yet"),
    ],
)
def test_a_registered_certificate_that_is_not_to_be_trusted(identity):
    one = identity()
    history = read(written(sealed(2, sealer(one))), [registration(one)])
    assert kinds(history)[0] is FindingKind.UNTRUSTED
    assert history.records == ()


def test_written_after_revocation():
    items = written(sealed(6), per_block=1)
    history = read(items, [registration(revoked_block=FIRST + 3)])
    found = only(history, FindingKind.AFTER_REVOCATION)
    assert (found.first, found.last, found.block) == (4, 7, FIRST + 4)
    assert history.violations


def test_a_stream_of_the_replaced_certificate_written_after_the_replacement():
    old, new = robot(), robot(2)
    items = [*written(sealed(2, sealer(old))), *written(sealed(2, sealer(new)), first_block=30)]
    registrations = [registration(old, revoked_block=20), registration(new, block_number=21)]
    assert FindingKind.AFTER_REVOCATION not in kinds(read(items, registrations))
    late = [*items, *written(sealed(2, sealer(old)), first_block=40)]
    assert FindingKind.AFTER_REVOCATION in kinds(read(late, registrations))


def test_the_same_certificate_registered_again_holds_on():
    registrations = [registration(revoked_block=FIRST), registration(block_number=FIRST + 1)]
    assert read(written(sealed(9)), registrations).is_complete


def test_written_after_the_certificate_ran_out():
    short = robot(3, days=30)
    items = written(sealed(2, sealer(short)), per_block=1)
    items[2:] = [replace(item, block_timestamp=T0 + 31 * 86400) for item in items[2:]]
    found = only(read(items, [registration(short)]), FindingKind.OUTSIDE_VALIDITY)
    assert (found.first, found.last) == (2, 3)


def test_a_certificate_that_has_run_out_by_now_still_proves_what_was_written_in_its_time():
    assert read(written(sealed(2, sealer(robot(4, days=1)))), [registration(robot(4, days=1))]).is_complete


@pytest.mark.parametrize("change", [lambda c: c[:-1], lambda c: c + b"\0", lambda c: b"", lambda c: c[:400],
                                    lambda c: b"\x30\x82" + c])
def test_registrations_without_two_certificates_are_refused(change):
    whole = registration().certificates
    assert b"".join(split_certificates(whole)) == whole
    with pytest.raises(VerificationError):
        split_certificates(change(whole))


# --- gaps, restarts, grants


def test_declared_drops_are_no_breach():
    seal = sealer()
    records = sealed(6, seal, end=False)
    stream = records[0].id.stream
    gap = seal.declare([SeqRange(stream, 2, 3), SeqRange(stream, 5, 5)], T0 * NS)
    history = read(written([*(records[n] for n in (0, 1, 4, 6)), *gap, *seal.end(T0 * NS)]))
    assert [(f.kind, f.first, f.last) for f in history.findings] == [
        (FindingKind.DROPPED, 2, 3), (FindingKind.DROPPED, 5, 5)]
    assert history.is_complete
    assert history.streams[0].dropped == 3


def test_what_is_declared_too_little_is_missing():
    seal = sealer()
    records = sealed(6, seal, end=False)
    gap = seal.declare([SeqRange(records[0].id.stream, 3, 4)], T0 * NS)
    history = read(written([*(records[n] for n in (0, 1, 6)), *gap, *seal.end(T0 * NS)]))
    assert [(f.kind, f.first, f.last) for f in history.findings] == [
        (FindingKind.MISSING, 2, 2), (FindingKind.DROPPED, 3, 4), (FindingKind.MISSING, 5, 5)]


def test_a_gap_declared_by_the_next_stream_and_a_drop_that_arrived_after_all():
    seal = sealer(limits=StreamLimits(records=4))
    records = sealed(3, seal, end=False)
    rest = [*seal.declare([SeqRange(records[0].id.stream, 1, 3)], T0 * NS), *seal.end(T0 * NS)]
    history = read(written([records[0], records[2], *rest]))
    assert [(f.kind, f.first, f.last) for f in history.findings] == [
        (FindingKind.DROPPED, 1, 1), (FindingKind.DROPPED, 3, 3)]


def test_a_withheld_gap_record_excuses_nothing():
    seal = sealer()
    records = sealed(4, seal, end=False)
    seal.declare([SeqRange(records[0].id.stream, 2, 2)], T0 * NS)
    history = read(written([records[n] for n in (0, 1, 3, 4)] + list(seal.end(T0 * NS))))
    assert [(f.kind, f.first) for f in history.findings] == [(FindingKind.MISSING, 2), (FindingKind.MISSING, 5)]


def test_a_crash_is_followed_by_a_stream_that_says_where_the_last_one_ended():
    first = sealed(4, end=False)
    second = sealed(2, sealer(previous=first[-1].id))
    assert read(written([*first, *second])).is_complete
    assert only(read(written([*first[:-1], *second])), FindingKind.TAIL_MISSING).first == 4


def test_a_robot_that_lost_its_spool():
    items = written([*sealed(2, end=False), *sealed(2)])
    assert kinds(read(items)) == [FindingKind.END_UNKNOWN, FindingKind.RESTARTED]


def test_a_restored_spool_claims_an_earlier_end_than_there_is():
    first = sealed(4, end=False)
    second = sealed(2, sealer(previous=first[2].id))
    found = only(read(written([*first, *second])), FindingKind.PREVIOUS_MISMATCH)
    assert (found.first, found.last) == (3, 4)


def test_two_robots_with_one_key():
    first = sealed(2, end=False)
    twins = [sealed(2, sealer(previous=first[-1].id)) for _ in range(2)]
    found = only(read(written([*first, *twins[0], *twins[1]])), FindingKind.FORKED)
    assert twins[0][0].id.stream.hex()[:8] in found.detail


def test_a_reader_without_a_grant_opens_nothing():
    history = read(written(sealed(3)), key=reader("reader_2"))
    assert only_kinds(history) == {FindingKind.NO_GRANT, FindingKind.END_UNKNOWN}
    assert history.records == ()
    assert not history.is_complete


def test_without_any_key_the_chain_of_streams_is_still_checked():
    records = sealed(6, sealer(limits=StreamLimits(records=4)))
    trust = Trust([authority().certificate])
    history = prove(NAME, [registration()], written(records[4:]), trust=trust, opener=None)
    assert FindingKind.UNKNOWN_PREVIOUS in kinds(history)


def test_a_revoked_reader_keeps_the_past():
    seal = sealer(readers=[reader(), reader("reader_2")])
    records = sealed(3, seal, end=False)
    seal.set_readers([reader().encryption_key.public_key])
    records += sealed(2, seal)
    history = read(written(records), key=reader("reader_2"))
    assert numbers(history) == [1, 2, 3]
    assert only_kinds(history) == {FindingKind.NO_GRANT, FindingKind.END_UNKNOWN}
    # A record it may open is not there; the gap could be declared where it may not look.
    assert FindingKind.UNDECIDED in kinds(read(written(records[:2] + records[3:]), key=reader("reader_2")))
    assert FindingKind.MISSING in kinds(read(written(records[:2] + records[3:])))


def only_kinds(history: ProvenHistory) -> set[FindingKind]:
    return set(kinds(history))


def test_a_clock_that_was_not_synchronised_is_told():
    seal = sealer()
    records = [r for n in range(1, 5) for r in seal.seal(payload(n, clock=n not in (2, 3)), T0 * NS)]
    found = only(read(written([*records, *seal.end(T0 * NS)])), FindingKind.CLOCK)
    assert (found.first, found.last) == (2, 3)


def test_a_later_part_of_the_history():
    seal = sealer(limits=StreamLimits(records=4))
    items = written(sealed(9, seal))
    history = read(items[6:], from_start=False)
    assert FindingKind.BEFORE_RANGE in kinds(history)
    assert history.violations == ()
    assert numbers(history) == [7, 8, 9]


def test_signed_content_that_is_not_json_is_refused_when_it_is_looked_at():
    seal = sealer()
    history = read(written([*seal.seal(b"\xff", T0 * NS), *seal.end(T0 * NS)]))
    assert history.is_complete
    with pytest.raises(VerificationError, match="not a JSON object"):
        history.records[0].content()


def test_progress_is_told():
    seen = []
    read(written(sealed(3)), progress=seen.append)
    assert seen == sorted(seen)
    assert seen[-1] == 5


@pytest.mark.parametrize("kind", list(FindingKind))
def test_every_finding_says_what_it_means(kind):
    text = str(Finding(kind, b"s" * 16, 3, 5, 77, "detail"))
    assert text.startswith(kind.label + ":")
    assert all(part in text for part in ("73737373", "3-5", "77", kind.meaning, "detail"))


# --- any mischief at all


@settings(max_examples=60, deadline=None)
@given(st.data())
def test_whatever_a_server_does_is_found_and_nothing_false_is_shown(data):
    """Drop, double, swap, flip, rename: what is shown is a subset of the truth in order; a loss is a finding."""
    seal = sealer(limits=StreamLimits(records=5))
    truth = sealed(8, seal)
    records = list(truth)
    lost = set()
    for _ in range(data.draw(st.integers(1, 3))):
        at = data.draw(st.integers(0, len(records) - 1))
        match data.draw(st.sampled_from(["drop", "double", "swap", "flip", "rename"])):
            case "drop":
                lost.add(records.pop(at).id)
            case "double":
                records.insert(data.draw(st.integers(0, len(records))), records[at])
            case "swap":
                other = data.draw(st.integers(0, len(records) - 1))
                records[at], records[other] = records[other], records[at]
            case "flip":
                old = records[at]
                bit = data.draw(st.integers(0, 8 * len(old.ciphertext) - 1))
                spoiled = bytearray(old.ciphertext)
                spoiled[bit // 8] ^= 1 << bit % 8
                records[at] = SealedRecord(old.id, bytes(spoiled))
            case "rename":
                old, seq = records[at], data.draw(st.integers(0, 12))
                records[at] = SealedRecord(replace(old.id, seq=seq), old.ciphertext)
    history = read(written(records))
    shown = numbers(history)
    assert shown == sorted(set(shown))
    assert set(shown) <= set(range(1, 9))
    if set(records) != set(truth):  # two harms can undo each other
        assert history.findings
        assert not history.is_complete
    if shown != list(range(1, 9)):
        assert not history.is_complete
