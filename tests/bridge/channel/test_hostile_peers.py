"""Peers that hold a good session and misuse it, and strangers who touch somebody's session.

A stranger changes nothing. A peer that breaks the protocol loses its session,
and what it can make this end hold is bounded.
"""

from __future__ import annotations

import random
from itertools import pairwise

import pytest

from bridge.channel.steps import HERE, Steps, dropped, events, flipped
from bridge.channel.world import SERVER_ADDRESS, make_client, make_server, robot
from rosbridge_eth.channel import (
    Disconnected,
    Drop,
    End,
    Full,
    Message,
    NotConnected,
    ServerConfig,
)
from rosbridge_eth.channel.session import RECEIVE_SEGMENTS, RESERVED_SEGMENTS
from rosbridge_eth.channel.wire import SEGMENT_HEADER, SEGMENT_SIZE, Ack, Frame

ELSEWHERE = ("203.0.113.66", 6666)


def connected(config: ServerConfig | None = None, **options) -> Steps:
    steps = Steps(server=make_server(1000.0, config), **options).until_connected()
    events(steps.server)
    return steps


def from_client(steps: Steps, frames: bytes) -> list[bytes]:
    """A packet of the client's keys with any frames at all in it."""
    return steps.to_server(steps.client._session._seal(frames))


def from_server(steps: Steps, frames: bytes) -> list[bytes]:
    [connection] = steps.server._connections.values()
    return steps.to_client(connection.session._seal(frames))


def segment(index: int, data: bytes) -> bytes:
    return SEGMENT_HEADER.pack(Frame.SEGMENT, index) + data


def message(payload: bytes) -> bytes:
    return len(payload).to_bytes(4, "big") + payload


def sent(steps: Steps, *payloads: bytes) -> list[bytes]:
    """The client's packets with these messages."""
    for payload in payloads:
        steps.client.send(payload)
    return [data for data, _ in steps.client.datagrams_to_send(steps.now)]


BREACHES = {
    "no frame that exists": b"\x00",
    "another frame that does not exist": b"\x05",
    "acknowledgement of a packet never sent": Ack(1000, 0, 1).to_bytes(),
    "acknowledgement of a segment never sent": Ack(0, 1000, 1).to_bytes(),
    "acknowledgement of negative numbers": Ack(0, 0, 3).to_bytes(),
    "acknowledgement without its largest": Ack(0, 0, 2).to_bytes(),
    "acknowledgement of nothing": Ack(0, 0, 0).to_bytes(),
    "half an acknowledgement": Ack(0, 0, 1).to_bytes()[:9],
    "acknowledgement cut before its last byte": Ack(0, 0, 1).to_bytes()[:-1],
    "acknowledgement too long": Ack(0, 0, 1).to_bytes()[:-2] + b"\xff" + bytes(254) + b"\1",
    "message too long": segment(1, (72 * 1024 + 1).to_bytes(4, "big")),
    "message of four gigabytes": segment(1, b"\xff\xff\xff\xff"),
    "empty segment": segment(1, b""),
    "half a segment's number": segment(1, b"")[:3],
    "segment beyond the limit": segment(RECEIVE_SEGMENTS + 1, b"x"),
    "segment far beyond the limit": segment(2**32 - 1, b"x"),
    "close without a reason": bytes((Frame.CLOSE,)),
    "close for no reason that exists": bytes((Frame.CLOSE, 99)),
    "something behind a close": bytes((Frame.CLOSE, 0, Frame.PING)),
}


@pytest.mark.parametrize("breach", BREACHES)
def test_a_client_that_breaks_the_protocol_loses_its_session(breach):
    steps = connected()
    answers = from_client(steps, BREACHES[breach])
    [ended] = [e for e in events(steps.server) if isinstance(e, Disconnected)]
    assert ended.reason is End.PROTOCOL
    assert steps.server.statistics()["early"] == 0
    steps.to_client(*answers)
    [told] = events(steps.client)
    assert isinstance(told, Disconnected) and told.reason is End.PROTOCOL


@pytest.mark.parametrize("breach", BREACHES)
def test_a_server_that_breaks_the_protocol_loses_the_client(breach):
    steps = connected()
    answers = from_server(steps, BREACHES[breach])
    [ended] = events(steps.client)
    assert ended.reason is End.PROTOCOL
    steps.to_server(*answers)
    [told] = events(steps.server)
    assert told.reason is End.PROTOCOL


@pytest.mark.parametrize("payload", [b"", bytes(7), bytes(9), b"\xff" * 8])
def test_a_server_whose_first_message_is_not_its_time_is_no_server(payload):
    steps = Steps()
    steps.to_server(steps.until_finished())
    [connection] = steps.server._connections.values()
    steps.to_client(connection.session._seal(segment(0, message(payload))))
    assert steps.client.state == "waiting"
    assert [type(e).__name__ for e in events(steps.client)] == ["HandshakeFailed"]


def test_random_frames_never_do_anything_but_end_the_session():
    draw = random.Random(7)
    steps = connected()
    for _ in range(200):
        if steps.client.state != "connected":
            steps = connected()
        from_client(steps, draw.randbytes(draw.randrange(1, 80)))
        from_server_frames = bytes((draw.randrange(1, 6),)) + draw.randbytes(draw.randrange(0, 60))
        if steps.server._connections:
            from_server(steps, from_server_frames)
        if not steps.server._connections:
            steps = connected()


def test_a_segment_sent_again_is_delivered_once_and_cannot_be_changed():
    steps = connected()
    for data in (b"first", b"second", b"other"):
        from_client(steps, segment(1, message(data)))
    assert [e.payload for e in events(steps.server)] == [b"first"]
    for data in (b"later", b"changed"):  # the same before its turn
        from_client(steps, segment(3, message(data)))
    from_client(steps, segment(2, message(b"second")))
    assert [e.payload for e in events(steps.server)] == [b"second", b"later"]
    assert steps.server.statistics()["duplicates"] == 3


def test_messages_are_cut_out_of_any_segments_and_segments_come_in_any_order():
    whole = b"".join(message(random.Random(i).randbytes(i * 7 % 400)) for i in range(40)) + message(bytes(3000))
    for seed in range(10):
        draw = random.Random(seed)
        steps = connected()
        cuts = sorted({0, len(whole), *(draw.randrange(len(whole)) for _ in range(draw.randrange(30)))})
        pieces = [whole[a:b] for a, b in pairwise(cuts)]
        pieces = [p[i : i + SEGMENT_SIZE] for p in pieces for i in range(0, len(p), SEGMENT_SIZE)]
        numbered = list(enumerate(pieces, 1))
        draw.shuffle(numbered)
        for index, data in numbered:
            from_client(steps, segment(index, data))
        assert b"".join(message(e.payload) for e in events(steps.server)) == whole


def test_what_a_client_makes_the_server_hold_is_bounded():
    steps = connected()
    for index in range(2, RECEIVE_SEGMENTS + 1):
        from_client(steps, segment(index, bytes(SEGMENT_SIZE)))  # and never the first
    assert steps.server.statistics()["early"] == RECEIVE_SEGMENTS - 1
    steps = connected(ServerConfig(max_early=80))
    for index in range(2, RECEIVE_SEGMENTS + 1):
        from_client(steps, segment(index, bytes(SEGMENT_SIZE)))
    assert steps.server.statistics()["early"] == 80
    assert dropped(steps.server)[Drop.FULL] > 500
    assert events(steps.server) == []


def test_clients_that_fill_the_servers_memory_do_not_keep_others_out():
    server = make_server(1000.0, ServerConfig(max_early=100))
    for number in range(4):
        client = make_client(1000.0, None, robot(f"robot_{number}"))
        steps = Steps(server=server, client=client).until_connected()
        for index in range(2, 400):
            steps.to_server(client._session._seal(segment(index, bytes(1000))))
    assert server.statistics()["early"] == 100 + 3 * RESERVED_SEGMENTS
    honest = Steps(server=server, client=make_client(1000.0, None, robot("robot_9"))).until_connected()
    events(server)
    before = server.statistics()["early"]
    for data in reversed(sent(honest, bytes(9_000))):
        honest.to_server(data)
    assert [len(e.payload) for e in events(server)] == [9_000]
    assert server.statistics()["early"] == before
    server.close()
    assert server.statistics()["early"] == 0


def test_what_is_refused_for_lack_of_room_is_not_acknowledged_and_may_come_again():
    steps = connected(ServerConfig(max_early=0))
    packets = [steps.client._session._seal(segment(i, bytes(1000))) for i in range(2, RESERVED_SEGMENTS + 4)]
    steps.to_server(*packets)
    [connection] = steps.server._connections.values()
    replay = connection.session._replay
    numbers = [int.from_bytes(packet[9:13], "big") for packet in packets]
    assert [replay.seen(n) for n in numbers] == [True] * RESERVED_SEGMENTS + [False] * 2
    from_client(steps, segment(1, bytes(1000)))
    steps.to_server(*packets)
    assert dropped(steps.server)[Drop.FULL] == 2 and replay.seen(numbers[-1])


def test_an_end_takes_no_more_than_its_session_has_room_for(monkeypatch):
    monkeypatch.setattr("rosbridge_eth.channel.session.MAX_BUFFERED", 80_000)
    steps = Steps().until_connected()
    steps.client.send(bytes(70_000))
    assert not steps.client.writable() and steps.client.writable(9_000)
    with pytest.raises(Full):
        steps.client.send(bytes(10_000))
    with pytest.raises(ValueError, match="at most"):
        steps.client.send(bytes(72 * 1024 + 1))
    [connection] = steps.server._connections
    while steps.server.writable(connection):
        steps.server.send(connection, bytes(72 * 1024))
    with pytest.raises(Full):
        steps.server.send(connection, bytes(72 * 1024))
    steps.server.close()
    assert not steps.server.writable(connection)
    with pytest.raises(NotConnected):
        steps.server.send(connection, b"")


# Strangers


def test_every_flipped_bit_of_a_packet_is_dropped_and_the_packet_still_counts():
    steps = connected()
    [packet] = sent(steps, b"the message")
    for bit in range(len(packet) * 8):
        assert steps.to_server(flipped(packet, bit)) == []
    for length in range(len(packet)):
        assert steps.to_server(packet[:length]) == []
    assert events(steps.server) == []
    steps.to_server(packet)
    before = dropped(steps.server)[Drop.REPLAYED]
    steps.to_server(packet)
    assert [e.payload for e in events(steps.server)] == [b"the message"]
    assert dropped(steps.server)[Drop.REPLAYED] == before + 1


def test_forged_numbers_do_not_move_the_replay_window():
    steps = connected()
    [packet] = sent(steps, b"the message")
    for number in (2**31, 2**20, 5000, 10):
        steps.to_server(packet[:9] + number.to_bytes(4, "big") + packet[13:])
    steps.to_server(packet)
    assert len(events(steps.server)) == 1


def test_a_packet_of_no_connection_draws_nothing():
    steps = connected()
    [packet] = sent(steps, b"x")
    other = make_server(1000.0, ServerConfig(worker=1))
    other.receive_datagram(packet, ELSEWHERE, steps.now)
    assert other.datagrams_to_send(steps.now) == []
    assert dropped(other) == {Drop.UNKNOWN_CONNECTION: 1}


# Addresses


def test_the_newest_packets_address_is_the_clients_and_proven_when_a_packet_sent_there_is_acknowledged():
    steps = connected()
    [packet] = sent(steps, b"x")
    steps.server.receive_datagram(packet, ELSEWHERE, steps.now)
    events(steps.server)
    [connection] = steps.server._connections
    assert steps.server.address_of(connection) == ELSEWHERE
    answers = steps.server.datagrams_to_send(steps.now)
    assert {address for _, address in answers} == {ELSEWHERE}
    assert steps.server.statistics()["address_changes"] == 0
    steps.to_client(*(data for data, _ in answers))
    steps.now += 0.1
    for data, _ in steps.client.datagrams_to_send(steps.now):
        steps.server.receive_datagram(data, ELSEWHERE, steps.now)
    assert steps.server.statistics()["address_changes"] == 1
    steps.server.send(connection, bytes(5000))
    out = steps.server.datagrams_to_send(steps.now)
    assert sum(len(data) for data, _ in out) > 5000  # no limit any more


def test_an_acknowledgement_of_what_was_sent_to_the_old_address_proves_nothing():
    steps = connected()
    [connection] = steps.server._connections.values()
    steps.server.send(connection.cid, b"to the old address")
    earlier = [data for data, _ in steps.server.datagrams_to_send(steps.now)]
    steps.client.send(b"x")
    [(packet, _)] = steps.client.datagrams_to_send(steps.now)
    steps.server.receive_datagram(packet, ELSEWHERE, steps.now)
    for data in earlier:
        steps.client.receive_datagram(data, SERVER_ADDRESS, steps.now)
    steps.now += 0.1
    for data, _ in steps.client.datagrams_to_send(steps.now):
        steps.server.receive_datagram(data, ELSEWHERE, steps.now)
    assert connection.session.largest_acked == connection.first_there - 1
    assert connection.address == ELSEWHERE and connection.allowance < 3 * 1200
    assert steps.server.statistics()["address_changes"] == 0


def test_an_address_that_is_not_proven_gets_at_most_three_bytes_for_one():
    steps = connected()
    [connection] = steps.server._connections
    steps.server.send(connection, bytes(60_000))
    packets = sent(steps, *[bytes(random.Random(i).randrange(1, 3000)) for i in range(20)])
    received = drawn = 0
    for packet in packets:
        received += len(packet)
        steps.server.receive_datagram(packet, ELSEWHERE, steps.now)
        for data, address in steps.server.datagrams_to_send(steps.now):
            assert address in (HERE, ELSEWHERE)
            drawn += len(data) * (address == ELSEWHERE)
        assert drawn <= 3 * received
        while (timer := steps.server.next_timer()) is not None and timer < steps.now + 0.01:
            steps.now = max(steps.now, timer)
            steps.server.handle_timer(steps.now)
            drawn += sum(len(data) for data, _ in steps.server.datagrams_to_send(steps.now))
            assert drawn <= 3 * received
    assert drawn > received
    steps.server.close()  # the word of farewell is counted, too
    drawn += sum(len(data) for data, _ in steps.server.datagrams_to_send(steps.now))
    assert drawn <= 3 * received
    assert steps.server.statistics()["address_changes"] == 0


def test_not_even_a_farewell_goes_where_nothing_more_may_go():
    steps = connected()
    [packet] = sent(steps, b"x")
    steps.server.receive_datagram(packet, ELSEWHERE, steps.now)
    steps.server.datagrams_to_send(steps.now)
    [connection] = steps.server._connections.values()
    connection.allowance = 30  # a farewell has 31 bytes
    steps.server.close()
    assert steps.server.datagrams_to_send(steps.now) == []
    assert isinstance(events(steps.server)[-1], Disconnected)


def test_who_copies_packets_from_elsewhere_and_is_faster_loses_the_session_again_with_the_clients_next_packet():
    steps = connected()
    [connection] = steps.server._connections.values()
    for number in range(50):
        steps.now += 0.1
        packets = sent(steps, b"%d" % number)
        for data in packets:
            steps.server.receive_datagram(data, ELSEWHERE, steps.now)  # a copy, before the client's own arrives
            assert connection.address == ELSEWHERE
        for _, address in steps.server.datagrams_to_send(steps.now):
            assert address == ELSEWHERE
        for data in sent(steps, b"next"):
            steps.server.receive_datagram(data, HERE, steps.now)
        assert connection.address == HERE
        for data, address in steps.server.datagrams_to_send(steps.now):
            assert address == HERE
            steps.client.receive_datagram(data, SERVER_ADDRESS, steps.now)
    assert len([e for e in events(steps.server) if isinstance(e, Message)]) == 100


def test_a_packet_held_back_and_sent_later_from_elsewhere_is_no_move():
    steps = connected()
    [held] = sent(steps, b"held back")
    steps.to_server(*sent(steps, b"newer"))
    steps.server.receive_datagram(held, ELSEWHERE, steps.now)
    assert all(address == HERE for _, address in steps.server.datagrams_to_send(steps.now))
    heard = [e.payload for e in events(steps.server)]
    assert heard == [b"held back", b"newer"]  # it counts, wherever it came from


def test_a_client_hears_only_the_address_it_talks_to():
    steps = connected()
    [connection] = steps.server._connections
    steps.server.send(connection, b"y")
    for data, _ in steps.server.datagrams_to_send(steps.now):
        steps.client.receive_datagram(data, ELSEWHERE, steps.now)
        assert events(steps.client) == []
        steps.to_client(data)
    assert [e.payload for e in events(steps.client)] == [b"y"]
