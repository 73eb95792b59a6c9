"""The parts under the channel, each against a plain model: windows, answers, streams, buckets."""

from __future__ import annotations

import random
import tracemalloc
from collections import Counter
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bridge.channel.steps import Steps, events
from rosbridge_eth.channel import Drop, Message
from rosbridge_eth.channel.admission import Cookies, TokenBucket
from rosbridge_eth.channel.delivery import GAIN, INITIAL_WINDOW, MINIMUM_WINDOW, QUEUE_SHARE, RoundTrip, Window
from rosbridge_eth.channel.protection import WINDOW, Direction, ReplayWindow
from rosbridge_eth.channel.transfer import Receiving

from rosbridge_eth.channel.wire import (  # isort: skip
    ACK_BITS, MAX_STATE, Answer, Hello, Malformed, Mode, Refused, fields, parse_fields,
)  # fmt: skip


@given(st.lists(st.integers(0, 10_000), max_size=300))
def test_the_replay_window_takes_each_number_once_and_nothing_too_old(numbers):
    window, seen, highest = ReplayWindow(), set(), -1
    for number in numbers:
        expected = number in seen or number <= highest - WINDOW
        assert window.seen(number) == expected
        if not expected:
            window.mark(number)
            seen.add(number)
            highest = max(highest, number)


def test_the_replay_window_is_at_least_1024_wide_and_does_not_grow():
    window = ReplayWindow()
    window.mark(0)
    tracemalloc.start()
    window.mark(2**31)
    assert tracemalloc.get_traced_memory()[1] < 100_000  # no integer of 2**31 bits on the way
    tracemalloc.stop()
    assert not window.seen(2**31 - 1024) and window.seen(0)
    assert window.bits.bit_length() <= WINDOW


@given(st.lists(st.integers(0, 2000), min_size=1, max_size=150), st.binary(max_size=MAX_STATE))
def test_acknowledged_is_what_was_received_and_nothing_else(numbers, state):
    window = ReplayWindow()
    for number in numbers:
        window.mark(number)
    answer = Answer.parse(Answer(window.highest, 3, 10**12, window.bits, state).to_bytes())
    assert answer.data == state
    told = {answer.largest - i for i in range(answer.bits.bit_length()) if answer.bits >> i & 1}
    assert told == {n for n in numbers if n > max(numbers) - ACK_BITS}
    assert (answer.next_segment, answer.time_ms) == (3, 10**12)


@given(st.binary(max_size=800))
def test_any_bytes_are_an_answer_or_malformed(data):
    try:
        answer = Answer.parse(b"\x03" + data)
    except Malformed:
        return
    assert data.endswith(answer.data) and len(answer.data) <= MAX_STATE
    assert answer.bits & 1 and answer.bits.bit_length() <= min(answer.largest + 1, ACK_BITS)


@given(st.lists(st.binary(max_size=60), max_size=9), st.binary(min_size=1, max_size=3), st.randoms())
def test_fields_come_back_and_nothing_but_zeros_may_follow(parts, more, draw):
    body = fields(parts)
    lengths = [draw.choice((None, len(part))) for part in parts]
    assert parse_fields(body, lengths)[0] == parse_fields(body + bytes(7), lengths)[0] == parts
    if any(more):
        with pytest.raises(Malformed):
            parse_fields(body + more, lengths)
    if parts:
        with pytest.raises(Malformed):
            parse_fields(body[:-1], lengths)
        with pytest.raises(Malformed):
            parse_fields(body, [*lengths[:-1], len(parts[-1]) + 1])


@given(st.lists(st.binary(max_size=1300), max_size=40), st.randoms())
def test_messages_are_cut_out_of_any_segments_and_segments_come_in_any_order(payloads, draw):
    stream = b"".join(len(payload).to_bytes(4, "big") + payload for payload in payloads)
    cuts = sorted({0, len(stream), *(draw.randrange(len(stream) + 1) for _ in range(20))})
    numbered = [*enumerate(stream[a:b] for a, b in pairwise(cuts))]
    draw.shuffle(numbered)
    counts = Counter[str]()
    receiving = Receiving(counts, 1000)
    messages = []
    for index, data in numbered:
        messages += receiving.take(index, data)
        assert receiving.take(index, b"a duplicate") == []
    assert messages == payloads
    assert (counts["early"], counts["duplicates"]) == (0, len(numbered))


def rounds(window: Window, rtt: float, delivered: float, count: int = 1, now: float = 1.0) -> int:
    """`count` round trips of `rtt` that each delivered `delivered` windows, the window being what held them back."""
    for _ in range(count):
        window.limited = True
        window.acknowledged(int(window.size * delivered), rtt, 10**6, 0, now)
    return window.size


def test_the_window_doubles_while_its_queue_is_short_and_settles_when_it_is_long_enough():
    window = Window(0.0, 1 << 30)
    begin = window.size
    assert begin == INITIAL_WINDOW
    assert rounds(window, 0.1, 1.0) == int(GAIN * begin) + QUEUE_SHARE
    assert rounds(window, 0.12, 1.0) > 2 * begin
    queue = 0.025 + 0.1 / 4
    before = window.size
    assert rounds(window, 0.1 + queue, 1.0) == before + QUEUE_SHARE  # as long as it should be: the others' share
    before = window.size
    assert rounds(window, 2 * (0.1 + queue), 1.0) == before // 2 + QUEUE_SHARE
    for _ in range(20):  # a link of 100 kB/s: the round trip is what the window takes to pass through it
        rounds(window, max(0.1, window.size / 100_000), 1.0)
    assert 0.15 < window.size / 100_000 < 0.25


def test_loss_up_to_two_fifths_does_not_shrink_the_window_and_more_does():
    window = Window(0.0, 1 << 30)
    assert rounds(window, 0.1, 0.7, 30) > 20 * INITIAL_WINDOW
    window = Window(0.0, 1 << 30)
    rounds(window, 0.1, 0.7, 30)
    before = window.size
    assert rounds(window, 0.1, 0.3, 20) < before / 5
    assert rounds(window, 0.1, 0.0, 20) <= QUEUE_SHARE + MINIMUM_WINDOW


def test_a_window_that_was_not_used_does_not_grow_and_none_outgrows_its_maximum():
    window = Window(0.0, 50_000)
    for _ in range(10):
        window.acknowledged(window.size, 0.1, 10**6, 0, 1.0)
    assert window.size == INITIAL_WINDOW
    assert rounds(window, 0.1, 1.0, 10) == 50_000
    window.collapse()
    assert window.size == MINIMUM_WINDOW


def test_the_shortest_round_trip_is_forgotten_after_a_minute():
    """A robot that moved to a slower network would otherwise take its round trip for a queue for ever."""
    window = Window(0.0, 1 << 30)
    rounds(window, 0.02, 1.0, now=1.0)
    for second in range(2, 90):
        rounds(window, 0.3, 1.0, now=float(second))
    assert window.size > 100 * INITIAL_WINDOW


def test_datagrams_are_paced_over_the_round_trip():
    window = Window(0.0, 100_000)
    sent, now = 0, 10.0
    while now < 11.0:
        if window.wait(now, 0.1) == 0:
            window.sent(1200)
            sent += 1200
        now += 0.0005
    assert 0.9 * window.size / 0.1 < sent <= 10 * 1200 + 1.25 * window.size / 0.1 + 1200


def test_the_probe_timeout_doubles_to_a_limit():
    rtt = RoundTrip(0.1)
    timeouts = [rtt.pto(0.02, count) for count in range(20)]
    assert timeouts[0] == pytest.approx(0.1 + 4 * 0.05 + 0.02)
    assert timeouts[1] == pytest.approx(2 * timeouts[0]) and max(timeouts) == timeouts[-1] <= 4.0


def test_a_cookie_is_for_one_address_hello_and_time():
    cookies = Cookies(bytes(32), 20.0)
    place, hello = ("192.0.2.1", 5), Hello(Mode.EXCHANGE, b"clientid", bytes(16))
    cookie = cookies.make(place, hello, 100.0)
    assert cookies.holds(cookie, place, hello, 119.9)
    for address, other, now in (
        (("192.0.2.2", 5), hello, 100.0),
        (("192.0.2.1", 6), hello, 100.0),
        (place, hello._replace(mode=Mode.TRANSPORT), 100.0),
        (place, hello._replace(client_cid=b"clientiD"), 100.0),
        (place, hello._replace(nonce=b"\1" + bytes(15)), 100.0),
        (place, hello, 120.1),
        (place, hello, 99.0),
    ):
        assert not cookies.holds(cookie, address, other, now)
    assert not Cookies(b"\1" * 32, 20.0).holds(cookie, place, hello, 100.0)


def test_a_bucket_never_holds_more_than_its_burst():
    bucket = TokenBucket(10.0, 5.0, 0.0)
    assert bucket.available(1000.0) == 5.0
    bucket.charge(7.0)
    assert bucket.available(1000.1) == pytest.approx(-1.0)
    bucket.charge(-100.0)
    assert bucket.level == 5.0


def test_a_packet_opens_under_its_key_its_number_and_its_header_only():
    keys = Direction(b"s" * 32)
    packet = keys.seal(b"12345678", 7, b"frames")
    assert packet[:13] == b"\x4012345678" + (7).to_bytes(4, "big")
    assert Direction(b"s" * 32).open(packet, ReplayWindow()) == (7, b"frames")
    seen = ReplayWindow()
    seen.mark(7)
    for other, data, replay, drop in (
        (Direction(b"t" * 32), packet, ReplayWindow(), Drop.TAG),
        (keys, packet[:12] + b"\x08" + packet[13:], ReplayWindow(), Drop.TAG),
        (keys, b"\x41" + packet[1:], ReplayWindow(), Drop.TAG),
        (keys, packet[:5] + b"x" + packet[6:], ReplayWindow(), Drop.TAG),
        (keys, packet, seen, Drop.REPLAYED),
    ):
        with pytest.raises(Refused) as refused:
            other.open(data, replay)
        assert refused.value.drop is drop


def test_noise_to_either_end_changes_nothing():
    draw = random.Random(11)
    steps = Steps().until_connected()
    for _ in range(3000):
        kind = draw.choice((1, 2, 3, 4, 5, 6, 0x40, 0x40, draw.randrange(256)))
        cid = draw.choice((steps.connection, steps.client._cid, draw.randbytes(8)))
        data = bytes((kind,)) + draw.choice((b"", b"\1", cid, b"\1" + cid)) + draw.randbytes(draw.randrange(0, 1300))
        steps.to_server(data)
        steps.to_client(data)
    steps.to_server(*steps.sent(b"still here"))
    assert [e.payload for e in events(steps.server) if isinstance(e, Message)] == [b"still here"]
