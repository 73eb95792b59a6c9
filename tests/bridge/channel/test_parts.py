"""The parts under the channel, each against a plain model: windows, ranges, frames, buckets, tables, epochs."""

from __future__ import annotations

import random
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bridge.channel.steps import Steps, events
from bridge.channel.world import make_client, make_server
from rosbridge_eth.channel import ClientConfig, MessageReceived, ServerConfig, states
from rosbridge_eth.channel.admission import Cookies, Sources, TokenBucket
from rosbridge_eth.channel.protection import Direction, ReplayWindow
from rosbridge_eth.channel.recovery import Congestion, InFlight, Received, RoundTrip, SentPacket
from rosbridge_eth.channel.states import CLIENT, SERVER, ClientInput, ClientState, ServerState, advance
from rosbridge_eth.channel.wire import (
    MAX_ACK_RANGES,
    Malformed,
    Mode,
    ack_frame,
    fields,
    parse_ack,
    parse_fields,
)
from smcrypto import InvalidTag


@given(st.lists(st.integers(0, 5000), max_size=300))
def test_the_replay_window_takes_each_number_once_and_nothing_too_old(numbers):
    window, seen, highest = ReplayWindow(1024), set(), -1
    for number in numbers:
        expected = number in seen or number <= highest - 1024
        assert window.seen(number) == expected
        if not expected:
            window.mark(number)
            seen.add(number)
            highest = max(highest, number)


def test_the_replay_window_is_at_least_1024_wide_and_does_not_grow():
    window = ReplayWindow()
    window.mark(0)
    window.mark(2**47)
    assert not window.seen(2**47 - 1024) and window.seen(0)
    assert window._bits.bit_length() <= window.size


@given(st.lists(st.integers(0, 120), max_size=150))
def test_acknowledged_is_what_was_received_and_nothing_else(numbers):
    received = Received()
    for number in numbers:
        received.add(number, 0.0)
    told = {n for first, last in received.ranges for n in range(first, last + 1)}
    assert told <= set(numbers)
    assert len(received.ranges) <= MAX_ACK_RANGES + 1
    spans = received.ranges
    assert all(low > high + 1 for (low, _), (_, high) in pairwise(spans))  # apart, going down
    if numbers:
        assert max(numbers) in told
        ranges, _, end = parse_ack(ack_frame(spans, 0.0), 0)
        assert ranges == spans and end == len(ack_frame(spans, 0.0))
    if len(set(numbers)) and len(received.ranges) <= MAX_ACK_RANGES and len(numbers) == len(set(numbers)) < 20:
        assert told == set(numbers)


def test_an_acknowledgement_of_a_very_long_run_is_cut_not_wrong():
    ranges, _, _ = parse_ack(ack_frame([(0, 200_000), ], 0.5), 0)
    assert ranges == [(200_000 - 65535, 200_000)]
    ranges, delay, _ = parse_ack(ack_frame([(300_000, 300_001), (5, 6)], 99.0), 0)
    assert ranges == [(300_000, 300_001)] and delay == pytest.approx(6.5535)


@given(st.binary(max_size=200))
def test_any_bytes_are_an_acknowledgement_or_malformed(data):
    try:
        ranges, _, end = parse_ack(b"\x02" + data, 0)
    except Malformed:
        return
    assert end <= len(data) + 1
    assert all(0 <= first <= last for first, last in ranges)


@given(st.lists(st.binary(max_size=60), max_size=9), st.binary(min_size=1, max_size=3))
def test_fields_come_back_and_nothing_may_follow(parts, more):
    body = fields(parts)
    assert parse_fields(body, len(parts))[0] == parts
    with pytest.raises(Malformed):
        parse_fields(body + more, len(parts))
    if parts:
        with pytest.raises(Malformed):
            parse_fields(body[:-1], len(parts))


def test_packets_are_lost_by_number_and_by_time():
    flight: InFlight[str] = InFlight()
    for number in range(6):
        flight.add(SentPacket(number, number / 10, 100, (f"frame {number}",)))
    taken = flight.acknowledge([(4, 4)])
    assert [p.number for p in taken] == [4]
    assert [p.number for p in flight.take_lost(0.5, 0.35)] == [0, 1]  # three below the largest acknowledged
    assert flight.loss_time(0.35) == pytest.approx(0.55)
    assert [p.number for p in flight.take_lost(0.55, 0.35)] == [2]
    assert flight.bytes == 200 and [p.number for p in flight] == [3, 5]


def test_the_window_grows_is_halved_once_a_round_trip_and_paced():
    congestion = Congestion(0.0, 100_000)
    begin = congestion.window
    congestion.acknowledged(1200, 0.0)
    assert congestion.window == begin + 1200
    congestion.lost(0.5, 1.0)
    congestion.lost(0.9, 1.1)
    assert congestion.window == (begin + 1200) // 2
    for _ in range(50):
        congestion.lost(2.0, 1.0)
    assert congestion.window >= 2 * 1200
    sent, now = 0, 10.0
    while now < 11.0:
        if congestion.wait(now, 0.1) == 0:
            congestion.sent(1200)
            sent += 1200
        now += 0.0005
    assert sent <= 10 * 1200 + 1.25 * congestion.window / 0.1 + 1200


def test_the_probe_timeout_doubles_to_a_limit():
    rtt = RoundTrip(0.1)
    timeouts = [rtt.pto(0.02, count) for count in range(20)]
    assert timeouts[0] == pytest.approx(0.1 + 4 * 0.05 + 0.02)
    assert timeouts[1] == pytest.approx(2 * timeouts[0]) and max(timeouts) == timeouts[-1] <= 4.0


def test_a_cookie_is_for_one_address_hello_and_time():
    cookies = Cookies(bytes(32), 20.0)
    place, cid, nonce = ("192.0.2.1", 5), b"clientid", bytes(32)
    cookie = cookies.make(place, Mode.EXCHANGE, cid, nonce, 100.0)
    assert cookies.holds(cookie, place, Mode.EXCHANGE, cid, nonce, 119.9)
    for address, mode, other_cid, other_nonce, now in (
        (("192.0.2.2", 5), Mode.EXCHANGE, cid, nonce, 100.0),
        (("192.0.2.1", 6), Mode.EXCHANGE, cid, nonce, 100.0),
        (place, Mode.TRANSPORT, cid, nonce, 100.0),
        (place, Mode.EXCHANGE, b"clientiD", nonce, 100.0),
        (place, Mode.EXCHANGE, cid, b"\1" + bytes(31), 100.0),
        (place, Mode.EXCHANGE, cid, nonce, 120.1),
        (place, Mode.EXCHANGE, cid, nonce, 99.0),
    ):
        assert not cookies.holds(cookie, address, mode, other_cid, other_nonce, now)
    assert not Cookies(b"\1" * 32, 20.0).holds(cookie, place, Mode.EXCHANGE, cid, nonce, 100.0)


def test_sources_are_few_and_an_ipv6_network_is_one():
    sources = Sources(1.0, 3.0, 10)
    for i in range(1000):
        sources.take((f"10.0.{i // 256}.{i % 256}", 1), 0.0)
    assert len(sources) == 10
    taken = [sources.take((f"2001:db8::{i:x}", 1), 0.0) for i in range(6)]
    assert taken == [True] * 3 + [False] * 3
    assert sources.take(("2001:db8:0:1::1", 1), 0.0)


def test_a_bucket_never_holds_more_than_its_burst():
    bucket = TokenBucket(10.0, 5.0, 0.0)
    assert bucket.available(1000.0) == 5.0
    bucket.charge(7.0)
    assert bucket.available(1000.1) == pytest.approx(-1.0)
    bucket.charge(-100.0)
    assert bucket.level == 5.0


# Tables


def test_every_state_can_be_reached_and_left_and_an_absent_step_is_an_error():
    for table, kind, first in ((CLIENT, ClientState, ClientState.IDLE), (SERVER, ServerState, ServerState.ASSEMBLING)):
        reached = {first} | set(table.values())
        assert reached == set(kind)
        assert {state for state, _ in table} | {ServerState.GONE} >= set(kind)
    with pytest.raises(RuntimeError, match="cannot happen"):
        advance(CLIENT, ClientState.IDLE, ClientInput.ACCEPTED)


def test_the_documentation_shows_the_tables_of_the_code():
    from pathlib import Path

    text = (Path(__file__).parents[3] / "docs" / "channel.md").read_text()
    assert states.as_markdown(CLIENT) in text
    assert states.as_markdown(SERVER) in text


# Epochs


def test_epochs_have_keys_of_their_own():
    first = Direction(b"s" * 32)
    second = first.next_epoch()
    packet = first.seal(b"12345678", 7, b"frames")
    assert Direction(b"s" * 32).open(packet, 7) == b"frames"
    for keys, number in ((second, 7), (first, 8)):
        with pytest.raises(InvalidTag):
            keys.open(packet, number)


def test_a_new_epoch_is_used_when_it_was_acknowledged_and_not_before():
    steps = Steps(
        server=make_server(1000.0, ServerConfig(rekey_seconds=100.0)),
        client=make_client(1000.0, ClientConfig(rekey_seconds=100.0, idle_timeout=1e6, silence_timeout=1e6)),
    ).until_connected()
    events(steps.server)
    steps.now += 25
    steps.client.handle_timer(steps.now)  # a ping: the session is alive
    steps.to_client(*steps.to_server(*(d for d, _ in steps.client.datagrams_to_send(steps.now))))
    session = steps.client._session
    steps.now = 1100.1
    [connection] = steps.server._connections.values()
    connection.session._last_received = steps.now
    session._last_received = steps.now
    steps.client.handle_timer(steps.now)
    announced = [d for d, _ in steps.client.datagrams_to_send(steps.now)]
    assert session._update is not None and all(d[0] == 0x40 for d in announced)
    steps.client.send(b"before the acknowledgement")
    before = [d for d, _ in steps.client.datagrams_to_send(steps.now)]
    assert [d[0] for d in before] == [0x40]
    answers = steps.to_server(*announced, *before)
    steps.now += 0.05
    answers += [d for d, _ in steps.server.datagrams_to_send(steps.now)]
    steps.to_client(*answers)
    steps.client.send(b"after it")
    after = [d for d, _ in steps.client.datagrams_to_send(steps.now)]
    assert [d[0] for d in after] == [0x41]
    steps.to_server(*after)
    assert [e.payload for e in events(steps.server) if isinstance(e, MessageReceived)] == [
        b"before the acknowledgement",
        b"after it",
    ]
    assert steps.client.statistics().rekeys == 1


def test_noise_to_either_end_changes_nothing():
    draw = random.Random(11)
    steps = Steps().until_connected()
    session = steps.client._session
    for _ in range(3000):
        kind = draw.choice((1, 2, 3, 4, 5, 6, 0x40, 0x41, draw.randrange(256)))
        cid = draw.choice((session.remote_cid, steps.client._cid, draw.randbytes(8)))
        data = bytes((kind,)) + draw.choice((b"", b"\1", cid, b"\1" + cid)) + draw.randbytes(draw.randrange(0, 1300))
        steps.to_server(data)
        steps.to_client(data)
    steps.client.send(b"still here")
    steps.to_server(*(d for d, _ in steps.client.datagrams_to_send(steps.now)))
    assert [e.payload for e in events(steps.server) if isinstance(e, MessageReceived)] == [b"still here"]
