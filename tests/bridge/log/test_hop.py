"""What robot and server say to each other: every message comes back, and nothing else is one."""

from __future__ import annotations

import contextlib

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from rosbridge_eth.log.chunk import MAX_CHUNK
from rosbridge_eth.log.hop import FORKED, MAX_OVERHEAD, MAX_WHY, HopError, ServerState, decode_offer, encode_offer
from rosbridge_eth.server.reception import AWAY, MISMATCH, NO_ROOM

places, digests = st.binary(min_size=24, max_size=24), st.binary(min_size=32, max_size=32)
numbers = st.integers(0, 2**64 - 1)
reasons = st.text(max_size=100).filter(str.isprintable)
states = st.builds(ServerState, places, digests, places, numbers, st.integers(0, 255), digests, reasons)
offers = st.tuples(st.binary(min_size=1, max_size=300), st.one_of(st.just(b""), digests))


@given(states, offers)
def test_every_message_comes_back(state, offer):
    assert ServerState.decode(state.encode()) == state
    assert decode_offer(encode_offer(*offer)) == offer


@given(st.binary(max_size=200))
@example(b"")
@example(bytes(129))
@example(bytes(1))
@example(b"\1" + bytes(33))
def test_any_bytes_are_a_message_or_an_error(data):
    with contextlib.suppress(HopError):
        assert ServerState.decode(data).encode() == data
    with contextlib.suppress(HopError):
        assert encode_offer(*decode_offer(data)) == data


def test_a_state_that_is_cut_is_none():
    data = ServerState(bytes(24), bytes(32), bytes(24), 1, 2, bytes(32)).encode()
    for size in range(len(data)):
        with pytest.raises(HopError):
            ServerState.decode(data[:size])


@pytest.mark.parametrize("offer", [b"", b"\0", b"\1", b"\1" + bytes(32), b"\2" * 99])
def test_an_offer_has_a_chunk(offer):
    with pytest.raises(HopError):
        decode_offer(offer)


def test_the_largest_chunk_fits_an_offer():
    assert len(encode_offer(bytes(MAX_CHUNK), bytes(32))) == MAX_CHUNK + MAX_OVERHEAD


@given(st.text(max_size=500))
@example("\x1b[2Jcleared\n" + "ß" * 300)
@example("\ud800")
def test_any_reason_can_be_said_and_arrives_short_and_printable(why):
    arrived = ServerState.decode(ServerState(why=why).encode()).why
    assert arrived.isprintable() and len(arrived.encode()) <= MAX_WHY
    if why.isprintable() and len(why.encode()) <= MAX_WHY:
        assert arrived == why


def test_the_reasons_of_the_bridge_arrive_whole():
    for why in (FORKED, AWAY, MISMATCH, NO_ROOM):
        assert ServerState.decode(ServerState(why=why).encode()).why == why


@pytest.mark.parametrize("why", [b"\x1b[2J", b"two\nlines", b"\xff", b"\xed\xa0\x80", b"x" * (MAX_WHY + 1)])
def test_a_server_that_says_what_does_not_print_is_not_listened_to(why):
    with pytest.raises(HopError):
        ServerState.decode(ServerState().encode() + why)
