"""The channel over real sockets on the loopback interface, with two server processes' worth of sockets on one port."""

from __future__ import annotations

import socket
import sys
import threading
import time
from datetime import UTC, datetime, timedelta

import pytest

from rosbridge_eth import identity as ids
from rosbridge_eth.channel import (
    AddressChanged,
    Client,
    ClientConfig,
    Connected,
    Disconnected,
    MessageAnswered,
    MessageReceived,
    Server,
    ServerConfig,
    cookie_key,
)
from rosbridge_eth.channel.udp import UdpLoop, client_socket, server_sockets
from rosbridge_eth.errors import NetworkError

NOW = datetime.now(UTC) - timedelta(hours=1)
CA = ids.create_ca("operator", at=NOW)
HUB = ids.enrol(CA, ids.Role.SERVER, "hub", at=NOW)
ROBOTS = [ids.enrol(CA, ids.Role.ROBOT, f"robot_{i}", at=NOW) for i in range(4)]
TRUST = ids.Trust((CA.certificate,))
PATIENCE = 30.0  # s, until a test gives up


class Worker:
    """A server process, as a thread."""

    def __init__(self, number: int, sock: socket.socket) -> None:
        self.server = Server(
            ServerConfig(worker=number), HUB, TRUST, cookie_key(HUB), time.monotonic()
        )
        self.events: list[object] = []
        self.batch: list[MessageReceived] = []
        self.loop = UdpLoop(self.server, sock, self.on_event, on_batch=self.commit)
        self.thread = threading.Thread(target=self.loop.run)
        self.thread.start()

    def on_event(self, event: object) -> None:
        self.events.append(event)
        if isinstance(event, MessageReceived):
            self.batch.append(event)

    def commit(self, now: float) -> None:
        for event in self.batch:
            self.server.reply(event.connection, event.message_id, event.payload[::-1])
        self.batch.clear()

    def stop(self) -> None:
        self.loop.stop()
        self.thread.join()
        self.loop.close()


@pytest.fixture
def workers():
    running = [Worker(number, sock) for number, sock in enumerate(server_sockets(("127.0.0.1", 0), 2))]
    yield running
    for worker in running:
        worker.stop()


class Robot:
    def __init__(self, who: ids.Identity, port: int) -> None:
        sock, address = client_socket(("127.0.0.1", port))
        self.client = Client(ClientConfig(), who, TRUST, "hub", time.monotonic())
        self.events: list[object] = []
        self.loop = UdpLoop(self.client, sock, self.events.append)
        self.client.connect(address, time.monotonic())

    def until(self, condition) -> None:
        end = time.monotonic() + PATIENCE
        while not condition():
            assert time.monotonic() < end, f"{self.events} {self.client.statistics()}"
            self.loop.step(0.5)

    def connect(self) -> None:
        self.until(lambda: self.client.state == "connected")

    def ask(self, payloads: list[bytes]) -> dict[int, bytes]:
        asked: dict[int, bytes] = {}
        waiting = list(payloads)

        def done() -> bool:
            while waiting and self.client.writable(time.monotonic()):
                payload = waiting.pop()
                asked[self.client.send(payload)] = payload
            answers = {e.message_id: e.payload for e in self.events if isinstance(e, MessageAnswered)}
            return not waiting and all(answers.get(i) == payload[::-1] for i, payload in asked.items())

        self.until(done)
        return asked

    def close(self) -> None:
        self.client.close(time.monotonic())
        self.until(lambda: self.client.state == "idle")
        self.loop.close()


def port_of(workers: list[Worker]) -> int:
    return workers[0].loop.socket.getsockname()[1]


def test_robots_talk_to_the_workers_of_one_port(workers):
    robots = [Robot(who, port_of(workers)) for who in ROBOTS]
    for robot in robots:
        robot.connect()
        robot.ask([b"message %d " % i + bytes(i * 7) for i in range(200)] + [bytes(48 * 1024)])
        robot.close()
        assert [type(e) for e in robot.events if not isinstance(e, MessageAnswered)] == [Connected, Disconnected]
    heard = sum(isinstance(e, MessageReceived) for worker in workers for e in worker.events)
    assert heard == 201 * len(robots)


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="steering datagrams to workers needs Linux")
def test_a_robot_that_moves_stays_with_its_worker(workers):
    robot = Robot(ROBOTS[0], port_of(workers))
    robot.connect()
    robot.ask([b"before"])
    for _ in range(8):  # eight new source ports: by address alone, half of them would go to the other worker
        old = robot.loop
        sock, _ = client_socket(("127.0.0.1", port_of(workers)))
        robot.loop = UdpLoop(robot.client, sock, robot.events.append)
        old.close()
        robot.ask([b"after"])
    assert not [e for e in robot.events if isinstance(e, Disconnected)]
    moved = sum(isinstance(e, AddressChanged) for worker in workers for e in worker.events)
    assert moved == 8
    robot.close()
    robot.loop.close()


def test_work_is_handed_over_from_another_thread(workers):
    called = threading.Event()
    workers[0].loop.submit(lambda now: called.set())
    assert called.wait(PATIENCE)


def test_a_port_in_use_is_an_error_with_a_way_out(workers):
    for count in (1, 2):
        with pytest.raises(NetworkError, match="choose another port"):
            server_sockets(("127.0.0.1", port_of(workers)), count)


def test_a_name_that_does_not_exist_is_an_error():
    with pytest.raises(NetworkError, match=r"no-such-host\.invalid"):
        client_socket(("no-such-host.invalid", 1))


def test_nobody_at_the_other_end_is_not_an_error_of_the_socket():
    free = server_sockets(("127.0.0.1", 0))[0]
    port = free.getsockname()[1]
    free.close()
    robot = Robot(ROBOTS[0], port)
    end = time.monotonic() + 0.6
    while time.monotonic() < end:
        robot.loop.step(0.1)
    assert robot.client.state == "greeting"
    robot.loop.close()
