"""Peers that hold a good session and misuse it, and strangers who touch somebody's session.

A stranger changes nothing, and to no address go more bytes than came from it. A peer that breaks the protocol loses
its session, and what it can make this end hold is bounded.
"""

from __future__ import annotations

import random

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

from bridge.channel.steps import HERE, Steps, dropped, events, flipped, message, segment
from bridge.channel.world import SERVER_ADDRESS, make_client, make_server, robot
from rosbridge_eth.channel import MAX_STATE, Disconnected, Drop, End, Full, Message, ServerConfig, State
from rosbridge_eth.channel.transfer import RESERVED_SEGMENTS, SEGMENTS
from rosbridge_eth.channel.wire import (
    PROBE,
    SEGMENT_SIZE,
    Answer,
    Frame,
    Mode,
)

ELSEWHERE = ("203.0.113.66", 6666)


def connected(config: ServerConfig | None = None, **options) -> Steps:
    steps = Steps(server=make_server(1000.0, config), **options).until_connected()
    events(steps.server)
    return steps


def answer(largest: int, next_segment: int, bits: int) -> bytes:
    return Answer(largest, next_segment, 0, bits, b"").to_bytes()


NO_FRAMES = {
    "no frame that exists": b"\x00",
    "another frame that does not exist": b"\x05",
    "close without a reason": bytes((Frame.CLOSE,)),
    "close for no reason that exists": bytes((Frame.CLOSE, 99)),
    "something behind a close": bytes((Frame.CLOSE, 0, 0)),
}
UP = {
    **NO_FRAMES,
    "an answer, which is the server's": answer(0, 0, 1),
    "probe that says something": bytes((Frame.PROBE, 0, 1)),
    "message too long": segment(0, (72 * 1024 + 1).to_bytes(4, "big")),
    "message of four gigabytes": segment(0, b"\xff\xff\xff\xff"),
    "empty segment": segment(0, b""),
    "half a segment's number": segment(0, b"")[:3],
    "segment beyond the limit": segment(SEGMENTS, b"x"),
    "segment far beyond the limit": segment(2**32 - 1, b"x"),
}
DOWN = {
    **NO_FRAMES,
    "a segment, which is the client's": segment(0, b"x"),
    "a probe, which is the client's": PROBE,
    "acknowledgement of a packet never sent": answer(1000, 0, 1),
    "acknowledgement of a segment never sent": answer(0, 1000, 1),
    "acknowledgement of negative numbers": answer(0, 0, 3),
    "acknowledgement without its largest": answer(0, 0, 2),
    "acknowledgement of nothing": answer(0, 0, 0),
    "half an answer": answer(0, 0, 1)[:9],
    "answer cut before its last byte": answer(0, 0, 1)[:-1],
    "more acknowledgements than there may be": answer(0, 0, 1)[:-2] + b"\xff" + bytes(254) + b"\1",
    "state too long": answer(0, 0, 1) + bytes(MAX_STATE + 1),
    "a time beyond any clock": Answer(0, 0, 2**48, 1, b"").to_bytes(),
}


@pytest.mark.parametrize("breach", UP)
def test_a_client_that_breaks_the_protocol_loses_its_session(breach):
    steps = connected()
    answers = steps.from_client(UP[breach])
    [ended] = [e for e in events(steps.server) if isinstance(e, Disconnected)]
    assert ended.reason is End.PROTOCOL
    assert steps.server.statistics()["early"] == 0
    steps.to_client(*answers)
    [told] = events(steps.client)
    assert isinstance(told, Disconnected) and told.reason is End.PROTOCOL


@pytest.mark.parametrize("breach", DOWN)
def test_a_server_that_breaks_the_protocol_loses_the_client(breach):
    steps = connected()
    answers = steps.from_server(DOWN[breach])
    [ended] = events(steps.client)
    assert ended.reason is End.PROTOCOL
    steps.to_server(*answers)
    [told] = events(steps.server)
    assert told.reason is End.PROTOCOL


@pytest.mark.parametrize("breach", DOWN)
def test_a_server_whose_first_packet_breaks_the_protocol_is_no_server(breach):
    steps = Steps()
    steps.to_server(steps.until_first())
    steps.from_server(DOWN[breach])
    assert steps.client.phase == "waiting"
    assert [type(e).__name__ for e in events(steps.client)] == ["HandshakeFailed"]


@given(st.lists(st.binary(min_size=1, max_size=80), min_size=1, max_size=10), st.booleans())
def test_any_frames_do_nothing_but_end_the_session(frames, from_client):
    """Under the session's own keys: any bytes are taken, or the session ends; nothing is raised."""
    steps = connected()
    for frame in frames:
        if not steps.client.connected or not steps.server._sessions:
            break
        out = steps.from_client(frame) if from_client else steps.from_server(frame)
        (steps.to_client if from_client else steps.to_server)(*out)
    ends = {e.reason for e in events(steps.server) + events(steps.client) if isinstance(e, Disconnected)}
    assert ends <= {End.PROTOCOL, *End}
    assert steps.server.statistics()["early"] <= len(frames)


def test_a_segment_sent_again_is_delivered_once_and_cannot_be_changed():
    steps = connected()
    for data in (b"first", b"second", b"other"):
        steps.from_client(segment(0, message(data)))
    assert [e.payload for e in events(steps.server)] == [b"first"]
    for data in (b"later", b"changed"):  # the same before its turn
        steps.from_client(segment(2, message(data)))
    steps.from_client(segment(1, message(b"second")))
    assert [e.payload for e in events(steps.server)] == [b"second", b"later"]
    assert steps.server.statistics()["duplicates"] == 3


def test_what_a_client_makes_the_server_hold_is_bounded():
    steps = connected()
    for index in range(1, SEGMENTS):
        steps.from_client(segment(index, bytes(SEGMENT_SIZE)))  # and never the first
    assert steps.server.statistics()["early"] == SEGMENTS - 1
    steps = connected(ServerConfig(max_early=80))
    for index in range(1, SEGMENTS):
        steps.from_client(segment(index, bytes(SEGMENT_SIZE)))
    assert steps.server.statistics()["early"] == 80
    assert dropped(steps.server)[Drop.FULL] > 500
    assert events(steps.server) == []


def test_clients_that_fill_the_servers_memory_do_not_keep_others_out():
    server = make_server(1000.0, ServerConfig(max_early=100))
    for number in range(4):
        steps = Steps(server=server, client=make_client(1000.0, None, robot(f"robot_{number}"))).until_connected()
        for index in range(1, 400):
            steps.from_client(segment(index, bytes(1000)))
    assert server.statistics()["early"] == 100 + 3 * RESERVED_SEGMENTS
    honest = Steps(server=server, client=make_client(1000.0, None, robot("robot_9"))).until_connected()
    events(server)
    before = server.statistics()["early"]
    for data in reversed(honest.sent(bytes(9_000))):
        honest.to_server(data)
    assert [len(e.payload) for e in events(server)] == [9_000]
    assert server.statistics()["early"] == before
    server.close()
    assert server.statistics()["early"] == 0


def test_what_is_refused_for_lack_of_room_is_not_acknowledged_and_may_come_again():
    steps = connected(ServerConfig(max_early=0))
    packets = [steps.sealed(segment(i, bytes(1000))) for i in range(1, RESERVED_SEGMENTS + 3)]
    steps.to_server(*packets)
    replay = steps.session.replay
    numbers = [int.from_bytes(packet[9:13], "big") for packet in packets]
    assert [replay.seen(n) for n in numbers] == [True] * RESERVED_SEGMENTS + [False] * 2
    steps.from_client(segment(0, bytes(1000)))
    steps.to_server(*packets)
    assert dropped(steps.server)[Drop.FULL] == 2 and replay.seen(numbers[-1])


def test_an_end_takes_no_more_than_there_is_room_for(monkeypatch):
    monkeypatch.setattr("rosbridge_eth.channel.transfer.BUFFER", 80_000)
    steps = Steps().until_connected()
    steps.client.send(bytes(70_000))
    assert 9_000 <= steps.client.room() < 10_000
    with pytest.raises(Full):
        steps.client.send(bytes(10_000))
    with pytest.raises(Full):
        steps.client.send(bytes(72 * 1024 + 1))
    connection = steps.connection
    steps.server.close()
    steps.server.set_state(connection, b"to nobody")
    steps.client.close(steps.now)
    assert steps.client.room() == 0
    with pytest.raises(Full):
        steps.client.send(b"")


# Strangers


def test_every_flipped_bit_of_a_packet_is_dropped_and_the_packet_still_counts():
    steps = connected()
    [packet] = steps.sent(b"the message")
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
    [packet] = steps.sent(b"the message")
    for number in (2**31, 2**20, 5000, 10):
        steps.to_server(packet[:9] + number.to_bytes(4, "big") + packet[13:])
    steps.to_server(packet)
    assert len(events(steps.server)) == 1


def test_a_packet_of_no_connection_draws_nothing():
    steps = connected()
    [packet] = steps.sent(b"x")
    other = make_server(1000.0)
    other.receive_datagram(packet, ELSEWHERE, steps.now)
    assert other.datagrams_to_send(steps.now) == []
    assert dropped(other) == {Drop.UNKNOWN_CONNECTION: 1}


# Addresses and what is sent there


class Attacked:
    """A server with a session, and what a stranger may have recorded of it; `worst`: how many bytes more went to an
    address than came from it."""

    def __init__(self) -> None:
        self.steps = steps = Steps()
        steps.until_connected()
        steps.server.set_state(steps.connection, bytes(MAX_STATE))
        steps.to_client(*steps.to_server())
        self.recorded = [steps.hello, *steps.proof, steps.first, *steps.sent(b"x", bytes(3000)), steps.sealed(PROBE)]
        other = Steps(Mode.EXCHANGE, server=steps.server)
        self.recorded += [other.hello, *other.until_proof()]
        self.balance: dict[object, int] = {}
        self.worst = 0

    def deliver(self, data: bytes, source: tuple[str, int]) -> None:
        server, now = self.steps.server, self.steps.now
        self.balance[source] = self.balance.get(source, 0) - len(data)
        server.receive_datagram(data, source, now)
        while (event := server.next_event()) is not None:
            if isinstance(event, Message):  # each changes the state, which is told at once
                server.set_state(event.connection, bytes((len(event.payload) % 256,)) * MAX_STATE)
        self.settle(now)

    def settle(self, now: float) -> None:
        for sent, address in self.steps.server.datagrams_to_send(now):
            self.balance[address] = self.balance.get(address, 0) + len(sent)
            if address != HERE:  # to HERE the handshake before this was sent
                self.worst = max(self.worst, self.balance[address])


SOURCES = st.sampled_from([ELSEWHERE, ("203.0.113.67", 1), ("2001:db8::1", 9)])


@settings(deadline=None)
@given(
    st.lists(
        st.tuples(
            st.one_of(
                st.binary(max_size=1300),
                st.integers(0, 8),  # something recorded, as it was
                st.tuples(st.integers(0, 8), st.integers(0, 9999), st.integers(0, 1300)),  # a bit flipped, cut
            ),
            SOURCES,
        ),
        max_size=20,
    ),
    st.floats(0, 60),
)
@example([(index, ELSEWHERE) for index in range(9)], 1.0)
def test_to_no_address_go_more_bytes_than_came_from_it(datagrams, later):
    """Any bytes, from any address: invented, recorded, recorded and altered; also what comes by time, and farewells."""
    attacked = Attacked()
    for what, source in datagrams:
        if isinstance(what, tuple):
            index, bit, length = what
            data = attacked.recorded[index % len(attacked.recorded)]
            data = flipped(data, bit % (8 * len(data)))[:length]
        else:
            data = what if isinstance(what, bytes) else attacked.recorded[what % len(attacked.recorded)]
        attacked.deliver(data, source)
    attacked.steps.now += later
    attacked.steps.server.handle_timer(attacked.steps.now)
    attacked.settle(attacked.steps.now)
    attacked.steps.server.close()
    attacked.settle(attacked.steps.now)
    assert attacked.worst <= 0


@pytest.mark.parametrize("mode", Mode)
def test_a_whole_handshake_draws_no_more_bytes_than_it_sends_however_often_each_datagram_comes(mode):
    draw = random.Random(3)
    steps = Steps(mode)
    sent = got = 0
    cookie = steps.to_server(steps.hello)
    [proof, *more] = steps.to_client(*cookie)
    for _ in range(50):
        data = draw.choice([steps.hello, proof, *more])
        sent += len(data)
        got += sum(map(len, steps.to_server(data)))
        assert got <= sent


def test_the_newest_packets_address_is_the_clients_and_begins_without_credit():
    steps = connected()
    for _ in range(20):
        steps.from_client(PROBE)
    [packet] = steps.sent(bytes(100))
    steps.server.receive_datagram(packet, ELSEWHERE, steps.now)
    assert steps.server.address_of(steps.connection) == ELSEWHERE
    assert steps.server.statistics()["address_changes"] == 1
    steps.server.set_state(steps.connection, bytes(300))
    [(bare, address)] = steps.server.datagrams_to_send(steps.now)
    assert address == ELSEWHERE and len(bare) <= len(packet)  # no state: it would be longer than what came
    steps.server.set_state(steps.connection, bytes(301))
    assert sum(len(data) for data, _ in steps.server.datagrams_to_send(steps.now)) <= len(packet) - len(bare)


def test_an_answer_without_the_state_for_want_of_credit_is_asked_for_at_once():
    steps = connected()
    steps.server.set_state(steps.connection, bytes(300))
    steps.to_client(*steps.to_server())
    [packet] = steps.sent(bytes(100))
    steps.server.receive_datagram(packet, ELSEWHERE, steps.now)
    steps.server.set_state(steps.connection, bytes(301))
    [probe] = steps.to_client(*(data for data, _ in steps.server.datagrams_to_send(steps.now)))
    steps.server.receive_datagram(probe, ELSEWHERE, steps.now)
    steps.to_client(*(data for data, _ in steps.server.datagrams_to_send(steps.now)))
    assert events(steps.client)[-1] == State(bytes(301))


def test_who_copies_packets_from_elsewhere_and_is_faster_loses_the_session_again_with_the_clients_next_packet():
    steps = connected()
    for number in range(50):
        steps.now += 0.1
        for data in steps.sent(b"%d" % number):
            steps.server.receive_datagram(data, ELSEWHERE, steps.now)  # a copy, before the client's own arrives
            assert steps.session.address == ELSEWHERE
        for _, address in steps.server.datagrams_to_send(steps.now):
            assert address == ELSEWHERE
        for data in steps.sent(b"next"):
            steps.server.receive_datagram(data, HERE, steps.now)
        assert steps.session.address == HERE
        for data, address in steps.server.datagrams_to_send(steps.now):
            assert address == HERE
            steps.client.receive_datagram(data, SERVER_ADDRESS, steps.now)
    assert len([e for e in events(steps.server) if isinstance(e, Message)]) == 100


def test_a_packet_held_back_and_sent_later_from_elsewhere_is_no_move():
    steps = connected()
    [held] = steps.sent(b"held back")
    steps.to_server(*steps.sent(b"newer"))
    credit = steps.session.credit
    steps.server.receive_datagram(held, ELSEWHERE, steps.now)
    assert steps.server.address_of(steps.connection) == HERE
    assert steps.session.credit <= credit  # what came from elsewhere pays for nothing here
    assert all(address == HERE for _, address in steps.server.datagrams_to_send(steps.now))
    heard = [e.payload for e in events(steps.server)]
    assert heard == [b"held back", b"newer"]  # it counts, wherever it came from


def test_a_client_hears_only_the_address_it_talks_to():
    steps = connected()
    steps.server.set_state(steps.connection, b"y")
    for data, _ in steps.server.datagrams_to_send(steps.now):
        steps.client.receive_datagram(data, ELSEWHERE, steps.now)
        assert events(steps.client) == []
        steps.to_client(data)
    assert events(steps.client) == [State(b"y")]
    assert dropped(steps.client) == {Drop.ADDRESS: 1}
