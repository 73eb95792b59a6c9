"""Whole conversations on a network made of a seed: what was promised holds whatever the network does.

The invariant: every message is delivered exactly once in a session, answered
with its own answer, and survives loss, duplication, reordering, corruption,
changes of address, and restarts of either end; what is held stays bounded and
is given back. CHANNEL_SEEDS sets how many seeds are tried, CHANNEL_FIRST_SEED
where they begin.
"""

from __future__ import annotations

import os
import random

import pytest

from bridge.channel.world import SERVER_ADDRESS, RobotProgram, ServerProgram
from rosbridge_eth.channel import (
    AddressChanged,
    ClientConfig,
    Connected,
    Disconnected,
    End,
    Mode,
    ServerConfig,
)
from rosbridge_eth.channel.simulation import Faults, Network

SEEDS = int(os.environ.get("CHANNEL_SEEDS", "200"))
FIRST = int(os.environ.get("CHANNEL_FIRST_SEED", "0"))
SIZES = (0, 1, 17, 300, 540, 540, 800, 1161, 1162, 1163, 2500, 9000)


def messages(draw: random.Random, count: int, who: int = 0) -> list[bytes]:
    found = []
    for number in range(count):
        size = draw.choice(SIZES) if draw.random() > 0.02 else 48 * 1024
        found.append((b"%d/%06d " % (who, number)).ljust(size, bytes((draw.randrange(256),)))[: max(size, 10)])
    return found


@pytest.mark.parametrize("seed", range(FIRST, FIRST + SEEDS))
def test_every_message_arrives_once_and_is_answered_whatever_the_network_does(seed):
    draw = random.Random(seed)
    mode = draw.choice((Mode.EXCHANGE, Mode.EXCHANGE, Mode.TRANSPORT))
    faults = Faults(
        loss=draw.choice((0, 0.05, 0.15, 0.3)),
        duplication=draw.choice((0, 0.1, 0.3)),
        corruption=draw.choice((0, 0.02, 0.1)),
        delay=draw.choice((0.001, 0.02, 0.1)),
        jitter=draw.choice((0, 0.01, 0.1)),
    )
    network = Network(seed, faults)
    sizes: set[int] = set()
    network.watch = lambda data, source, target: sizes.add(len(data))
    limits = ServerConfig(
        modes=(mode,),
        max_unanswered=draw.choice((3, 32, 256)),
        max_unanswered_bytes=draw.choice((60_000, 1 << 20)),
        max_total_bytes=draw.choice((100_000, 1 << 22)),
        rekey_packets=draw.choice((7, 50, 1 << 20)),
        rekey_interval=0.0,
    )
    hub = ServerProgram(network, limits, commit_delay=draw.choice((0, 0.005, 0.2)))
    config = ClientConfig(mode=mode, rekey_packets=draw.choice((11, 1 << 20)), rekey_interval=0.0)
    sent = messages(draw, draw.choice((5, 40, 80)))
    robot = RobotProgram(network, sent, config=config)
    for _ in range(draw.randrange(4)):
        port = draw.randrange(1024, 65536)
        network.at(
            network.now + draw.uniform(0, 5), lambda port=port: setattr(robot.host, "address", ("198.51.100.9", port))
        )
    for _ in range(draw.randrange(3)):
        network.at(network.now + draw.uniform(0, 5), draw.choice((robot.restart, hub.restart)))

    start = network.now
    finished = network.run(lambda: robot.done and network.now > start + 5, limit=900.0)
    told = f"seed {seed}: {robot.client.statistics()} {hub.server.statistics()}"
    assert finished, told
    assert robot.broken == [] and hub.broken == [], told
    assert max(sizes) <= 1200, told
    assert sorted(set(hub.committed)) == sorted(set(sent)), told
    assert sorted(robot.answered) == sorted(sent), told
    assert hub.most_held <= limits.max_total_bytes + limits.max_message * limits.max_unanswered, told

    network.faults = Faults()
    robot.client.close(network.now)
    assert network.run(lambda: hub.server.statistics().connections == 0, limit=120.0), told
    network.run(lambda: False, limit=60.0)
    left = hub.server.statistics()
    assert (left.held_bytes, left.half_open, left.connections) == (0, 0, 0), told
    assert robot.client.next_timer() is None, told


def test_without_faults_nothing_is_sent_twice():
    network = Network(1, Faults(delay=0.01))
    hub = ServerProgram(network)
    robot = RobotProgram(network, messages(random.Random(5), 300))
    assert network.run(lambda: robot.done)
    for end in (robot.client.statistics(), hub.server.statistics()):
        assert (end.packets_lost, end.frames_retransmitted, end.duplicates, dict(end.dropped)) == (0, 0, 0, {})
    network.run(lambda: False, limit=1.0)
    [connection] = hub.server._connections.values()
    assert hub.server.statistics().held_bytes == 0  # given back while the session lives, not at its end
    assert connection.session._incoming == {}
    for session in (robot.client._session, connection.session):
        assert session._round_trip.smoothed == pytest.approx(0.02, rel=0.5)
        assert len(session._received.ranges) == 1 and not session._in_flight


def test_datagrams_are_filled_to_the_last_byte_and_no_further():
    for second, count in ((577, 1), (578, 2)):
        network = Network(1, Faults())
        ServerProgram(network)
        robot = RobotProgram(network, [])
        assert network.run(lambda robot=robot: bool(robot.events))
        network.run(lambda: False, limit=1.0)
        for size in (578, second):
            robot.asked[robot.client.send(bytes(size))] = bytes(size)
        sizes = [len(data) for data, _ in robot.client.datagrams_to_send(network.now)]
        assert len(sizes) == count and max(sizes) <= 1200 and sum(sizes) >= 1200


def test_many_small_messages_share_datagrams():
    network = Network(1, Faults(delay=0.01))
    ServerProgram(network)
    robot = RobotProgram(network, [b"%04d" % i + bytes(316) for i in range(600)])
    assert network.run(lambda: robot.done)
    sent = robot.client.statistics()
    assert sent.datagrams_sent < 600 / 3 + 600 / 8 + 20  # three to a datagram, and acknowledgements


def test_many_robots_keep_their_messages_apart():
    from bridge.channel.world import robot as enrolled

    network = Network(3, Faults(loss=0.1, jitter=0.02))
    hub = ServerProgram(network, commit_delay=0.003)
    robots = [
        RobotProgram(
            network,
            messages(random.Random(i), 20, who=i),
            who=enrolled(f"robot_{i}"),
            address=("198.51.100.7", 50000 + i),
        )
        for i in range(8)
    ]
    assert network.run(lambda: all(r.done for r in robots))
    assert [r.broken for r in robots] == [[]] * 8 and hub.broken == []
    assert hub.server.statistics().connections == 8


def test_a_restarted_server_resets_old_sessions_and_robots_return_within_a_round_trip_or_two():
    network = Network(4, Faults(delay=0.02))
    hub = ServerProgram(network)
    robot = RobotProgram(network, messages(random.Random(1), 20))
    assert network.run(lambda: robot.done)
    hub.restart()
    robot.to_send = [b"after the restart"]
    robot.feed()
    began = network.now
    assert network.run(lambda: robot.done)
    assert [e.reason for e in robot.events if isinstance(e, Disconnected)] == [End.RESET]
    assert network.now - began < 1.0
    assert hub.committed[-1] == b"after the restart"


def test_a_restarted_robot_replaces_its_session_and_only_then_is_the_old_one_ended():
    network = Network(5, Faults(delay=0.02))
    hub = ServerProgram(network)
    robot = RobotProgram(network, [b"before"])
    assert network.run(lambda: robot.done)
    robot.restart()
    robot.to_send = [b"after"]
    assert network.run(lambda: robot.done)
    kinds = [type(e) if isinstance(e, Connected) else e.reason for e in hub.events]
    assert kinds == [Connected, End.REPLACED, Connected]
    assert hub.server.statistics().connections == 1


def test_a_robot_whose_address_changes_keeps_its_session():
    network = Network(6, Faults(delay=0.02))
    hub = ServerProgram(network)
    robot = RobotProgram(network, [b"before"])
    assert network.run(lambda: robot.done)
    robot.host.address = ("203.0.113.5", 40000)
    robot.to_send = [b"after"]
    robot.feed()
    began = network.now
    assert network.run(lambda: robot.done)
    assert network.now - began < 6 * 0.04  # there, challenge, response, answer; no waiting for a timeout
    moved = [e for e in hub.events if isinstance(e, AddressChanged)]
    assert [e.address for e in moved] == [("203.0.113.5", 40000)]
    assert not [e for e in robot.events if isinstance(e, Disconnected)]


def test_after_an_outage_what_waited_does_not_come_as_a_flood():
    network = Network(7, Faults(delay=0.02))
    ServerProgram(network)
    robot = RobotProgram(network, [b"%05d" % i + bytes(1000) for i in range(100)])
    assert network.run(lambda: robot.done)
    before = robot.client._session._congestion.window
    network.faults = Faults(loss=1.0)
    robot.to_send = [b"%05d" % i + bytes(1000) for i in range(2000)]
    robot.feed()
    network.run(lambda: False, limit=5.0)
    sent: list[tuple[float, int]] = []
    network.watch = lambda data, source, target: (
        sent.append((network.now, len(data))) if target == SERVER_ADDRESS else None
    )
    network.faults = Faults(delay=0.02)
    network.run(lambda: len(sent) > 0, limit=5.0)
    began = sent[0][0]
    network.run(lambda: robot.done)
    first = sum(size for when, size in sent if when <= began + 0.001)
    three = sum(size for when, size in sent if when <= began + 0.13)
    assert first <= 2 * 1200  # two probes, no more
    assert three <= (2 + 4 + 8 + 16) * 1200  # then slow start, from the beginning
    assert before > 100_000  # though the window had been open wide
    assert robot.broken == [] and robot.client.statistics().handshakes == 1


def test_an_idle_session_is_kept_alive_and_a_dead_robot_is_forgotten():
    network = Network(8, Faults(delay=0.02))
    hub = ServerProgram(network)
    robot = RobotProgram(network, [b"hello"])
    assert network.run(lambda: robot.done)
    network.run(lambda: False, limit=300.0)
    assert hub.server.statistics().connections == 1
    before = robot.client.statistics().datagrams_sent
    network.run(lambda: False, limit=100.0)
    assert robot.client.statistics().datagrams_sent - before <= 12  # one ping in ten seconds
    network.hosts.remove(robot.host)
    network.run(lambda: False, limit=60.0)
    assert hub.server.statistics().connections == 0
    assert [e.reason for e in hub.events if isinstance(e, Disconnected)] == [End.SILENT]


def test_urgent_messages_overtake_the_others():
    network = Network(9, Faults(delay=0.02))
    order: list[bytes] = []
    hub = ServerProgram(network)
    robot = RobotProgram(network, [])
    network.run(lambda: bool(robot.events))
    for i in range(100):
        robot.asked[robot.client.send(b"bulk %02d" % i + bytes(1000), priority=1)] = b"bulk %02d" % i + bytes(1000)
    robot.asked[robot.client.send(b"urgent", priority=0)] = b"urgent"
    assert network.run(lambda: robot.done)
    order = hub.committed
    assert order.index(b"urgent") == 0


def test_two_machines_with_one_identity_do_not_take_turns_all_the_time():
    network = Network(10, Faults(delay=0.02))
    hub = ServerProgram(network)
    RobotProgram(network, [b"one"])
    RobotProgram(network, [b"two"], address=("198.51.100.8", 50001))
    network.run(lambda: False, limit=60.0)
    assert sum(isinstance(event, Connected) for event in hub.events) <= 60
