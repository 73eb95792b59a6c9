"""What robot and server say to each other: every message comes back, and nothing else is one."""

from __future__ import annotations

import contextlib

import pytest
from hypothesis import example, given
from hypothesis import strategies as st
from rosbridge_eth.protocol import (
    MAX_WHY,
    Confirmed,
    Hold,
    Offer,
    ProtocolError,
    Refused,
    Stored,
    Where,
    decode_down,
    decode_up,
    encode,
)

from rosbridge_eth.log.chunk import MAX_CHUNK

streams, digests = st.binary(min_size=16, max_size=16), st.binary(min_size=32, max_size=32)
numbers = st.integers(0, 2**64 - 1)
reasons = st.text(max_size=100).filter(str.isprintable)
ups = st.one_of(st.builds(Where, streams, numbers, digests), st.builds(Offer, st.binary(min_size=1, max_size=300)))
downs = st.one_of(
    st.builds(Stored, streams, numbers, digests), st.builds(lambda s: Stored(s, None, bytes(32)), streams),
    st.builds(Confirmed, streams, numbers, numbers), st.builds(Hold, reasons),
    st.builds(Refused, streams, numbers, reasons),
)  # fmt: skip


@given(ups, downs)
def test_every_message_comes_back_and_means_nothing_in_the_other_direction(up, down):
    assert decode_up(encode(up)) == up
    assert decode_down(encode(down)) == down
    with pytest.raises(ProtocolError):
        decode_down(encode(up))
    with pytest.raises(ProtocolError):
        decode_up(encode(down))


@given(st.binary(max_size=80))
@example(b"")
def test_any_bytes_are_a_message_or_a_protocol_error(data):
    for decode in (decode_up, decode_down):
        with contextlib.suppress(ProtocolError):
            assert encode(decode(data)) == data


@pytest.mark.parametrize(
    "message", [Where(bytes(16), 1, bytes(32)), Stored(bytes(16), 1, bytes(32)), Confirmed(bytes(16), 1, 2)]
)
def test_a_message_that_is_cut_or_longer_is_none(message):
    data = encode(message)
    decode = decode_up if isinstance(message, Where) else decode_down
    for wrong in (*(data[:size] for size in range(len(data))), data + b"\0"):
        with pytest.raises(ProtocolError):
            decode(wrong)


def test_nothing_stored_is_said_in_one_way():
    data = encode(Stored(bytes(16), None, bytes(32)))
    for place in (17, 18, 25, 26, 57):
        wrong = bytearray(data)
        wrong[place] ^= 2
        with pytest.raises(ProtocolError):
            decode_down(bytes(wrong))
    assert decode_down(encode(Stored(bytes(16), 0, bytes(32)))) == Stored(bytes(16), 0, bytes(32))


def test_an_offer_is_neither_empty_nor_longer_than_a_chunk():
    assert decode_up(encode(Offer(bytes(MAX_CHUNK)))) == Offer(bytes(MAX_CHUNK))
    for size in (0, MAX_CHUNK + 1):
        with pytest.raises(ProtocolError):
            decode_up(encode(Offer(bytes(size))))


@given(st.text(max_size=500))
@example("\x1b[2Jcleared\n" + "ß" * 300)
@example("\ud800")
def test_any_reason_can_be_said_and_arrives_short_and_printable(why):
    for message in (Hold(why), Refused(bytes(16), 3, why)):
        arrived = decode_down(encode(message)).why
        assert arrived.isprintable() and len(arrived.encode()) <= MAX_WHY
        if why.isprintable() and len(why.encode()) <= MAX_WHY:
            assert arrived == why


@pytest.mark.parametrize("why", [b"\x1b[2J", b"two\nlines", b"\xff", b"\xed\xa0\x80", b"x" * (MAX_WHY + 1)])
def test_a_server_that_says_what_does_not_print_is_not_listened_to(why):
    for data in (b"\x13" + why, b"\x14" + bytes(24) + why):
        with pytest.raises(ProtocolError):
            decode_down(data)
