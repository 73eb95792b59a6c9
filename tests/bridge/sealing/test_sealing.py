"""The sealed record: what it gives back, what it refuses, what it hides. Layout: docs/records.md."""

from __future__ import annotations

import itertools
import json
import struct
import zlib
from base64 import b64encode
from contextlib import suppress
from dataclasses import replace
from functools import partial

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bridge.secrecy import assert_hidden, secrets_of
from rosbridge_eth.identity import sign, verify
from rosbridge_eth.records import RecordId, SealedRecord, SeqRange, robot_id
from rosbridge_eth.sealing import (
    Altered,
    Forged,
    Kind,
    Malformed,
    NoGrant,
    NoReaders,
    Opener,
    RecordTooLarge,
    Sealer,
    StreamLimits,
    parse_header,
    read_opening,
)
from rosbridge_eth.sealing.layout import (
    MAX_CIPHERTEXT,
    MAX_PAYLOAD,
    Opening,
    pack_ranges,
    padded_size,
    parse_ranges,
)
from rosbridge_eth.sealing.packing import DICTIONARY, pack, unpack
from smcrypto import sm2, sm3, sm4

ROBOT = robot_id("robot_1")
ROBOT_KEY, READER, OTHER = (sm2.PrivateKey.generate() for _ in range(3))
SIGN = partial(sign, ROBOT_KEY)
VERIFY = partial(verify, ROBOT_KEY.public_key)
T0 = 1_763_690_000_000_000_000
DAY = 24 * 3600 * 10**9

def odometry(**pose_and_twist) -> bytes:
    return json.dumps(
        {
            "v": 1,
            "topic": "/robot_1/odom",
            "type": "nav_msgs/msg/Odometry",
            "received_ns": 1763690000123456789,
            "wall_ns": 1763690000123498765,
            "mono_ns": 84120012345678,
            "clock": True,
            "delivery": "reliable",
            "data": {
                "header": {"stamp": 1763690000120000000, "frame_id": "odom"},
                "child_frame_id": "base_link",
                **pose_and_twist,
            },
        },
        separators=(",", ":"),
    ).encode()


ODOMETRY = odometry(
    pose={"pose": {"position": {"x": -1.2345678901234567, "y": 0.9876543210987654, "z": 0.0}}},
    twist={"twist": {"linear": {"x": 0.31415926535897931, "y": 0.0, "z": 0.0}}},
)
N = iter(n**0.5 / 7 for n in range(2, 99) if n**0.5 % 1)
FULL_ODOMETRY = odometry(
    pose={"pose": {"position": {axis: next(N) for axis in "xyz"}, "orientation": {axis: next(N) for axis in "xyzw"}}},
    twist={"twist": {"linear": {axis: next(N) for axis in "xyz"}, "angular": {axis: next(N) for axis in "xyz"}}},
)


def sealer(*readers, **options):
    return Sealer(ROBOT, SIGN, [key.public_key for key in readers or (READER,)], **options)


def stream_of(opening, key=READER):
    return Opener(key).grant(read_opening(opening, VERIFY))


def test_a_reader_gets_back_what_was_sealed_and_the_robots_signature():
    opening, record = sealer().seal(ODOMETRY, T0)
    opened = stream_of(opening).open(record, VERIFY)
    assert (opened.kind, opened.payload, opened.id) == (Kind.DATA, ODOMETRY, record.id)
    # The signature alone convinces somebody who has only the robot's public key.
    verify(ROBOT_KEY.public_key, "record", opened.bound + opened.payload, opened.signature)


@pytest.mark.parametrize("payload", [ODOMETRY, FULL_ODOMETRY], ids=["planar", "all 13 numbers"])
def test_an_odometry_record_fits_the_256_bytes_that_the_papers_figures_are_given_for(payload):
    *_, record = sealer().seal(payload, T0)
    assert len(record.ciphertext) == 256


def test_every_reader_opens_it_and_nobody_else():
    opening, record = sealer(READER, OTHER).seal(b"payload", T0)
    for key in (READER, OTHER):
        assert stream_of(opening, key).open(record, VERIFY).payload == b"payload"
    with pytest.raises(NoGrant):
        stream_of(opening, sm2.PrivateKey.generate())


def test_the_layout_is_the_documented_one_checked_without_the_opener():
    """Header, associated data, nonce, plaintext and key id taken apart by hand."""
    opening, record = sealer().seal(b"payload", T0)
    content = opening.ciphertext[10:-64]
    assert opening.ciphertext[:2] == b"\x01\x00"
    assert int.from_bytes(content[:8], "big") == T0
    commitment, previous, readers = content[8:40], content[40:41], content[41:]
    assert previous == b"\0"
    assert (readers[0], len(readers)) == (1, 1 + 8 + 113)
    public = READER.public_key.to_bytes()
    assert readers[1:9] == sm3.digest(b"rosbridge-eth/1 reader\0" + ROBOT + record.id.stream + public)[:8]
    key = READER.decrypt(readers[9:], encoding="c1c3c2")
    assert sm3.digest(b"rosbridge-eth/1 stream key\0" + ROBOT + record.id.stream + key) == commitment
    verify(ROBOT_KEY.public_key, "open", ROBOT + opening.id.stream + bytes(8) + opening.ciphertext[:-64],
           opening.ciphertext[-64:])

    assert record.id.seq == 1
    assert record.ciphertext[:10] == b"\x01\x01" + commitment[:8]
    bound = ROBOT + record.id.stream + (1).to_bytes(8, "big") + record.ciphertext[:10]
    padded = sm4.SM4GCM(key).decrypt((1).to_bytes(12, "big"), record.ciphertext[10:], bound)
    inflate = zlib.decompressobj(-15, zdict=DICTIONARY)
    assert padded[64] == 1
    assert inflate.decompress(padded[65:]) == b"payload"
    assert set(inflate.unused_data) == {0}
    verify(ROBOT_KEY.public_key, "record", bound + b"payload", padded[:64])


def test_the_dictionary_is_part_of_the_format_and_does_not_change():
    assert sm3.digest(DICTIONARY).hex() == "7452f2af3f3f021c8166e8bcd6dd22b2b9cf542e3e006d2dde727a4a79728e3c"


def test_every_flipped_bit_of_a_record_is_refused():
    opening, record = sealer().seal(b"payload", T0)
    stream = stream_of(opening)
    for bit in range(8 * len(record.ciphertext)):
        flipped = bytearray(record.ciphertext)
        flipped[bit // 8] ^= 1 << bit % 8
        with pytest.raises((Altered, Malformed)):
            stream.open(SealedRecord(record.id, bytes(flipped)), VERIFY)


def test_flipped_bytes_of_an_open_record_are_refused():
    opening, _ = sealer().seal(b"payload", T0)
    for index in range(len(opening.ciphertext)):
        flipped = bytearray(opening.ciphertext)
        flipped[index] ^= 0x40
        with pytest.raises((Forged, Malformed)):
            read_opening(SealedRecord(opening.id, bytes(flipped)), VERIFY)


@pytest.mark.parametrize("size", [0, 9, 10, 64, 74, 90, 255, 257, 512])
def test_a_record_cut_or_lengthened_is_refused(size):
    opening, record = sealer().seal(b"payload", T0)
    changed = SealedRecord(record.id, record.ciphertext.ljust(size, b"\0")[:size])
    with pytest.raises((Altered, Malformed)):
        stream_of(opening).open(changed, VERIFY)


@pytest.mark.parametrize("size", [0, 9, 10, 74, 75, 90, -64, -1])
def test_an_open_record_cut_is_refused(size):
    opening, _ = sealer().seal(b"payload", T0)
    for changed in (opening.ciphertext[:size], opening.ciphertext + b"\0"):
        with pytest.raises((Forged, Malformed)):
            read_opening(SealedRecord(opening.id, changed), VERIFY)


def test_a_record_does_not_open_under_another_identity():
    seal = sealer()
    opening, one = seal.seal(b"one", T0)
    (two,) = seal.seal(b"two", T0)
    with pytest.raises(Altered):
        stream_of(opening).open(SealedRecord(one.id, two.ciphertext), VERIFY)


def test_a_co_reader_who_has_the_key_cannot_speak_for_the_robot():
    """A reader re-seals something under the stream's own key, with its own signature."""
    opening, record = sealer(READER, OTHER).seal(b"payload", T0)
    content = read_opening(opening, VERIFY)
    wrapped = next(v for v in content.wrapped.values() if _opens(OTHER, v))
    key = OTHER.decrypt(wrapped, encoding="c1c3c2")
    bound = ROBOT + record.id.stream + (1).to_bytes(8, "big") + record.ciphertext[:10]
    lie = sign(OTHER, "record", bound + b"lie") + pack(b"lie")
    sealed = record.ciphertext[:10] + sm4.SM4GCM(key).encrypt((1).to_bytes(12, "big"), lie.ljust(230, b"\0"), bound)
    with pytest.raises(Forged):
        stream_of(opening).open(SealedRecord(record.id, sealed), VERIFY)


def reseal(record, key, *, key_id=None, size=256, seq=None):
    """What a robot with other software could seal under its own stream's key, correctly signed."""
    head = b"\1\1" + (key_id or record.ciphertext[2:10])
    bound = ROBOT + record.id.stream + (seq or record.id.seq).to_bytes(8, "big") + head
    plain = (sign(ROBOT_KEY, "record", bound + b"payload") + pack(b"payload")).ljust(size - 26, b"\0")
    sealed = sm4.SM4GCM(key).encrypt((seq or record.id.seq).to_bytes(12, "big"), plain, bound)
    return SealedRecord(replace(record.id, seq=seq or record.id.seq), head + sealed)


def test_even_the_robot_cannot_use_another_key_id_or_size():
    """Or records of one stream could be told apart by marks that the format does not have."""
    opening, record = sealer().seal(b"payload", T0)
    stream = stream_of(opening)
    key = READER.decrypt(next(iter(stream.opening.wrapped.values())), encoding="c1c3c2")
    assert stream.open(reseal(record, key, seq=9), VERIFY).payload == b"payload"
    with pytest.raises(Altered, match="another key"):
        stream.open(reseal(record, key, key_id=b"other id"), VERIFY)
    for size in (257, 300, 4096 + 300):
        with pytest.raises(Malformed, match="bytes, which no record has"):
            stream.open(reseal(record, key, size=size), VERIFY)


def _opens(key, wrapped):
    try:
        key.decrypt(wrapped, encoding="c1c3c2")
    except ValueError:
        return False
    return True


def test_the_purposes_of_signatures_are_apart():
    """A data record's signature does not make a gap or an end of the same bytes."""
    seal = sealer()
    opening, data = seal.seal(b"", T0)
    (end,) = seal.end(T0)
    opened = stream_of(opening).open(data, VERIFY)
    for purpose in ("gap", "end", "open"):
        with pytest.raises(ValueError, match="signature"):
            verify(ROBOT_KEY.public_key, purpose, opened.bound, opened.signature)
    assert stream_of(opening).open(end, VERIFY).kind is Kind.END


def test_a_key_that_is_not_committed_to_is_refused():
    """The wrapped key of one stream, signed by the robot itself into another's opening."""
    opening = read_opening(sealer().seal(b"a", T0)[0], VERIFY)
    other = read_opening(sealer().seal(b"b", T0)[0], VERIFY)
    (tag,) = opening.wrapped
    (wrapped,) = other.wrapped.values()
    forged = Opening(ROBOT, opening.stream, T0, None, opening.commitment, {tag: wrapped})
    with pytest.raises(Altered):
        Opener(READER).grant(forged)


def test_seq_counts_from_zero_and_streams_are_linked():
    seal = sealer(limits=StreamLimits(records=4))
    records = [record for n in range(5) for record in seal.seal(b"%d" % n, T0)]
    assert [record.id.seq for record in records] == [0, 1, 2, 3, 0, 1, 2]
    assert parse_header(records[4]).kind is Kind.OPEN
    assert read_opening(records[4], VERIFY).previous == records[3].id
    assert len({record.id.stream for record in records}) == 2


@pytest.mark.parametrize("later", [DAY, -DAY, 3 * DAY])
def test_a_new_stream_begins_after_a_day_whichever_way_the_clock_moved(later):
    seal = sealer()
    seal.seal(b"a", T0)
    assert len(seal.seal(b"b", T0 + DAY - 1)) == 1
    assert len(seal.seal(b"c", T0 + later)) == 2


def test_a_restart_continues_from_what_the_spool_remembers():
    before = RecordId(ROBOT, b"p" * 16, 77)
    opening, _ = sealer(previous=before).seal(b"a", T0)
    assert read_opening(opening, VERIFY).previous == before


def test_no_key_or_stream_id_is_used_twice():
    streams = {sealer().seal(b"a", T0)[0].id.stream for _ in range(50)}
    assert len(streams) == 50


def test_a_revoked_reader_opens_the_past_and_not_the_future():
    seal = sealer(READER, OTHER)
    opening, record = seal.seal(b"before", T0)
    seal.set_readers([READER.public_key])
    later, after = seal.seal(b"after", T0)
    assert stream_of(opening, OTHER).open(record, VERIFY).payload == b"before"
    assert stream_of(later, READER).open(after, VERIFY).payload == b"after"
    with pytest.raises(NoGrant):
        stream_of(later, OTHER)


def test_without_readers_nothing_is_sealed():
    with pytest.raises(NoReaders):
        Sealer(ROBOT, SIGN, [])
    seal = sealer()
    with pytest.raises(NoReaders):
        seal.set_readers([])


def test_what_does_not_fit_is_refused_and_uses_nothing_up():
    seal = sealer()
    seal.seal(b"a", T0)
    for payload in (bytes(MAX_PAYLOAD + 1), _noise(MAX_CIPHERTEXT)):
        with pytest.raises(RecordTooLarge):
            seal.seal(payload, T0)
    assert seal.seal(b"b", T0)[-1].id.seq == 2


def _noise(size):
    return b"".join(sm3.digest(n.to_bytes(4, "big")) for n in range(size // 32))


def test_a_failed_signature_leaves_no_hole():
    answers = iter([True, False, True, True])

    def flaky(purpose, body):
        if not next(answers):
            raise OSError("token removed")
        return SIGN(purpose, body)

    seal = Sealer(ROBOT, flaky, [READER.public_key])
    with pytest.raises(OSError, match="token"):
        seal.seal(b"a", T0)
    opening, record = seal.seal(b"a", T0)
    assert stream_of(opening).open(record, VERIFY).payload == b"a"


def test_a_small_record_cannot_unpack_to_a_large_memory():
    bomb = pack(bytes(MAX_PAYLOAD))
    assert len(unpack(bomb)) == MAX_PAYLOAD
    for mode, text in ((b"\0", bytes(30_000_000)), (b"\1", b"\1" * 30_000_000)):
        with pytest.raises(Malformed, match="unpacks to more"):
            unpack(mode + deflated(text))
    # Numbers are longer as text than as bytes: 2 bytes each, 20 in the text.
    many = b"\3" * 15_000
    with pytest.raises(Malformed, match="unpacks to more"):
        unpack(b"\1" + deflated(many) + b"\x09" + b"\x7f" * 9 + b"\1\0" * 14_999)


def deflated(text: bytes) -> bytes:
    stream = zlib.compressobj(9, zlib.DEFLATED, -15)
    return stream.compress(text) + stream.flush()


@pytest.mark.parametrize("payload", [b"payload " * 9, ODOMETRY, b"\1" + ODOMETRY])
@pytest.mark.parametrize(
    "change",
    [lambda p: p[:-1], lambda p: p + b"\1", lambda p: b"\xff" + p, lambda p: b"\2" + p[1:], lambda p: b"",
     lambda p: p[:1]],
)
def test_packed_payloads_that_are_cut_or_trailed_by_anything_but_zeros_are_refused(change, payload):
    packed = pack(payload)
    assert unpack(packed + bytes(500)) == payload
    with pytest.raises(Malformed):
        unpack(change(packed))


def test_numbers_are_taken_out_as_documented():
    """0.1 of a float32, a double, an integer, one that is 5 less, and what has to stay as it is."""
    payload = b"[0.10000000149011612,0.1234567890123,1763690000000000005,1763690000000000000,1.5,-0.00000001,0000012]"
    packed = pack(payload)
    inflate = zlib.decompressobj(-15, zdict=DICTIONARY)
    assert inflate.decompress(packed[1:]) == b"[\2,\1,\3,\3,1.5,-0.00000001,0000012]"
    assert inflate.unused_data == (
        struct.pack(">fd", 0.1, 0.1234567890123) + b"\x08" + (1763690000000000005).to_bytes(8, "big") + b"\1\xfb"
    )
    assert unpack(packed) == payload


@pytest.mark.parametrize("numbers", [b"", b"\0", b"\x0a" + bytes(10), b"\4\0\0\0"])
def test_integers_of_an_impossible_size_are_refused(numbers):
    with pytest.raises(Malformed):
        unpack(b"\1" + deflated(b"\3") + numbers)


NUMBERS = st.one_of(
    st.floats(), st.floats(width=32), st.integers(), st.integers(-(2**64), 2**64), st.floats(-10, 10)
)


@settings(max_examples=300)
@given(st.lists(st.one_of(NUMBERS.map(repr), st.text(alphabet="0123456789.-+eE\1,", max_size=30)), max_size=30))
def test_any_numbers_come_back_as_they_were_written(tokens):
    payload = ",".join(tokens).encode()
    assert unpack(pack(payload) + bytes(9)) == payload


@settings(max_examples=300)
@given(st.binary(max_size=60), st.booleans())
def test_no_bytes_break_unpacking(noise, has_mode):
    with suppress(Malformed):
        unpack(b"\1" + deflated(noise) + noise if has_mode else noise)


def test_sizes_tell_little():
    sizes = {padded_size(size) for size in range(1, MAX_CIPHERTEXT + 1)}
    assert {s for s in sizes if s <= 4096} == set(range(256, 4097, 256))
    assert max(sizes) == MAX_CIPHERTEXT
    # Padmé: at most 12 % on top, and O(log log) bits of the length leak (PoPETs 2019, 4, section 4).
    assert all(size <= padded_size(size) <= size * 1.12 for size in range(4097, MAX_CIPHERTEXT + 1))
    assert len(sizes) == 64
    assert all(padded_size(size) == size for size in sizes)


@settings(max_examples=60, deadline=None)
@given(st.binary(max_size=6000))
def test_any_payload_comes_back_and_every_size_is_a_padded_one(payload):
    opening, record = sealer().seal(payload, T0)
    assert padded_size(len(record.ciphertext)) == len(record.ciphertext)
    assert stream_of(opening).open(record, VERIFY).payload == payload


RANGES = st.lists(
    st.builds(
        lambda stream, first, count: SeqRange(bytes([stream]) * 16, first, first + count),
        st.integers(0, 2), st.integers(0, 2**40), st.integers(0, 2**20),
    ),
    max_size=40,
)


@settings(max_examples=100)
@given(RANGES)
def test_ranges_keep_the_records_they_name(ranges):
    packed = parse_ranges(pack_ranges(ranges))
    for part in ranges:
        assert any(p.stream == part.stream and p.first <= part.first and part.last <= p.last for p in packed)
    assert sum(p.last - p.first + 1 for p in packed) <= sum(p.last - p.first + 1 for p in ranges)
    assert all(a.stream != b.stream or a.last + 1 < b.first for a, b in itertools.pairwise(packed))


@settings(max_examples=200)
@given(st.binary(max_size=80))
def test_no_bytes_break_the_readers_of_ranges_and_openings(content):
    for read in (parse_ranges, lambda c: Opening.from_bytes(ROBOT, bytes(16), c)):
        with suppress(Malformed):
            read(content)


def test_a_gap_record_declares_across_streams():
    seal = sealer()
    dropped = [SeqRange(b"a" * 16, 5, 9), SeqRange(b"b" * 16, 1, 1), SeqRange(b"a" * 16, 10, 11)]
    opening, gap = seal.declare(dropped, T0)
    opened = stream_of(opening).open(gap, VERIFY)
    assert opened.kind is Kind.GAP
    assert opened.dropped == (SeqRange(b"a" * 16, 5, 11), SeqRange(b"b" * 16, 1, 1))


def test_a_regular_pattern_of_drops_stays_small():
    every_other = [SeqRange(b"a" * 16, n, n) for n in range(1, 2049, 2)]
    *_, gap = sealer().declare(every_other, T0)
    assert len(gap.ciphertext) == 256


def test_a_robot_with_nothing_to_say_seals_nothing():
    assert sealer().end(T0) == ()


def test_after_the_end_a_new_stream_begins():
    seal = sealer()
    seal.seal(b"a", T0)
    (end,) = seal.end(T0)
    opening, _ = seal.seal(b"b", T0)
    assert read_opening(opening, VERIFY).previous == end.id


def test_nothing_of_a_record_is_to_be_seen():
    records = sealer().seal(ODOMETRY, T0)
    seen = b"".join(record.ciphertext + record.id.stream for record in records)
    assert_hidden(seen, secrets_of(ODOMETRY))


@pytest.mark.parametrize("show", [bytes, bytes.hex, b64encode, lambda p: b64encode(b"12" + p), lambda p: p[9:31]])
def test_the_search_for_secrets_finds_them(show):
    shown = show(ODOMETRY)
    with pytest.raises(AssertionError):
        assert_hidden(shown if isinstance(shown, bytes) else shown.encode(), secrets_of(ODOMETRY))


def test_representations_show_no_key():
    opening, _ = sealer().seal(b"a", T0)
    stream = stream_of(opening)
    key = READER.decrypt(next(iter(stream.opening.wrapped.values())), encoding="c1c3c2")
    assert key.hex() not in repr(stream) + repr(Opener(READER)) + repr(sealer())
    assert repr(key) not in repr(stream)
