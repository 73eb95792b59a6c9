"""The channel over real sockets on the loopback interface, with two server processes' worth of sockets on one port."""

from __future__ import annotations

import errno
import os
import socket
import struct
import threading
import time
from contextlib import closing
from datetime import UTC, datetime, timedelta
from hashlib import sha256

import pytest

from rosbridge_eth import identity as ids
from rosbridge_eth.channel import (
    Client,
    ClientConfig,
    Connected,
    Disconnected,
    Message,
    Server,
    ServerConfig,
    State,
    Unresolved,
    cookie_key,
)
from rosbridge_eth.channel.udp import ClientLoop, UdpLoop, client_socket, server_socket
from rosbridge_eth.channel.wire import HELLO_PADDING, Hello, Kind, Mode
from rosbridge_eth.errors import NetworkError

NOW = datetime.now(UTC) - timedelta(hours=1)
CA = ids.create_ca("operator", at=NOW)
HUB = ids.enrol(CA, ids.Role.SERVER, "hub", at=NOW)
ROBOTS = [ids.enrol(CA, ids.Role.ROBOT, f"robot_{i}", at=NOW) for i in range(4)]
TRUST = ids.Trust((CA.certificate,))
PATIENCE = 30.0  # s, until a test gives up


def told(payloads: list[bytes]) -> bytes:
    """How many messages came in a session, and the digest of the newest."""
    return len(payloads).to_bytes(4, "big") + sha256(payloads[-1]).digest()


class Worker:
    """A server process, as a thread; its state says what came."""

    def __init__(self, sock: socket.socket) -> None:
        self.server = Server(ServerConfig(), HUB, TRUST, cookie_key(HUB), time.monotonic())
        self.events: list[object] = []
        self.loop = UdpLoop(self.server, sock, self.on_event)
        self.stopped = threading.Event()
        self.thread = threading.Thread(target=self.run)
        self.thread.start()

    def run(self) -> None:
        while not self.stopped.is_set():
            self.loop.step(10.0)

    def on_event(self, event: object) -> None:
        self.events.append(event)
        if isinstance(event, Message):
            came = [e.payload for e in self.events if isinstance(e, Message) and e.connection == event.connection]
            self.server.set_state(event.connection, told(came))

    def stop(self) -> None:
        self.stopped.set()
        self.loop.wake()
        self.thread.join(5.0)
        assert not self.thread.is_alive()
        self.loop.close()


@pytest.fixture
def workers():
    running = [Worker(server_socket(("127.0.0.1", 0)))]
    yield running
    for worker in running:
        worker.stop()


class Robot:
    def __init__(self, who: ids.Identity, port: int) -> None:
        sock, address = client_socket(("127.0.0.1", port))
        self.client = Client(ClientConfig(), who, TRUST, "hub", time.monotonic())
        self.events: list[object] = []
        self.sent: list[bytes] = []
        self.loop = UdpLoop(self.client, sock, self.events.append)
        self.client.connect(address, time.monotonic())

    def until(self, condition) -> None:
        end = time.monotonic() + PATIENCE
        while not condition():
            assert time.monotonic() < end, f"{self.events} {self.client.statistics()}"
            self.loop.step(0.5)

    def connect(self) -> None:
        self.until(lambda: self.client.connected)
        self.sent = []

    def ask(self, payloads: list[bytes]) -> None:
        """Send them, and hear that all of this session came."""
        waiting = list(payloads)
        self.sent += payloads

        def done() -> bool:
            while waiting and self.client.room() >= len(waiting[0]):
                self.client.send(waiting.pop(0))
            return State(told(self.sent)) in self.events

        self.until(done)

    def close(self) -> None:
        self.client.close(time.monotonic())
        self.loop.step(0.0)
        self.loop.close()


def port_of(workers: list[Worker]) -> int:
    return workers[0].loop.socket.getsockname()[1]


def test_robots_talk_to_a_server(workers):
    robots = [Robot(who, port_of(workers)) for who in ROBOTS]
    for robot in robots:
        robot.connect()
        robot.ask([b"message %d " % i + bytes(i * 7) for i in range(200)] + [bytes(72 * 1024)])
        robot.close()
        assert [type(e) for e in robot.events if not isinstance(e, State)] == [Connected, Disconnected]
    heard = sum(isinstance(e, Message) for worker in workers for e in worker.events)
    assert heard == 201 * len(robots)


def test_a_robot_that_moves_stays_with_its_session(workers):
    robot = Robot(ROBOTS[0], port_of(workers))
    robot.connect()
    robot.ask([b"before"])
    for _ in range(2):
        old = robot.loop
        sock, _ = client_socket(("127.0.0.1", port_of(workers)))
        robot.loop = UdpLoop(robot.client, sock, robot.events.append)
        old.close()
        robot.ask([b"after"])
    assert not [e for e in robot.events if isinstance(e, Disconnected)]
    robot.until(lambda: workers[0].server.statistics()["address_changes"] == 2)
    robot.close()
    robot.loop.close()


def test_a_loop_that_is_closed_sends_what_its_endpoint_still_has_to_say(workers):
    robot = Robot(ROBOTS[0], port_of(workers))
    robot.connect()
    assert sum(worker.server.statistics()["connections"] for worker in workers) == 1
    robot.client.close(time.monotonic())
    robot.loop.close()
    end = time.monotonic() + PATIENCE
    while any(worker.server.statistics()["connections"] for worker in workers) and time.monotonic() < end:
        workers[0].thread.join(0.01)
    assert not any(worker.server.statistics()["connections"] for worker in workers)
    robot.loop.wake()  # harmless now


def test_a_port_in_use_is_an_error_with_a_way_out(workers):
    with pytest.raises(NetworkError, match="choose another port"):
        server_socket(("127.0.0.1", port_of(workers)))


def test_an_address_of_another_machine_is_an_error_with_its_own_way_out():
    with pytest.raises(NetworkError, match=r"no interface here has that address; .* 0\.0\.0\.0"):
        server_socket(("203.0.113.7", 0))


@pytest.mark.parametrize("name", ["no-such-host.invalid", "two..dots", "a" * 64 + ".example", "."])
def test_a_name_that_does_not_exist_is_an_error(name):
    with pytest.raises(NetworkError, match=f"the address {name!r} cannot be found"):
        client_socket((name, 1))


def notice_soon(monkeypatch: pytest.MonkeyPatch) -> None:
    """A client notices soon that its server is gone."""
    for name in ("SILENCE", "PROBE_FIRST", "KEEP_ALIVE"):
        monkeypatch.setattr(f"rosbridge_eth.channel.client.{name}", 0.2)


class Names:
    """A name server that knows one name; while `gate` is clear it does not answer."""

    def __init__(self, monkeypatch: pytest.MonkeyPatch) -> None:
        self.address: tuple[str, int] | None = None
        self.gate, self.asked, self._real = threading.Event(), 0, socket.getaddrinfo
        self.gate.set()
        monkeypatch.setattr(socket, "getaddrinfo", self)
        monkeypatch.setattr("rosbridge_eth.channel.udp.ASK_AGAIN", 0.02)
        notice_soon(monkeypatch)

    def __call__(self, host: str, *rest: object, **more: object) -> object:
        if host != "robots.example":
            return self._real(host, *rest, **more)  # type: ignore[arg-type]
        self.asked += 1
        assert self.gate.wait(PATIENCE)
        if self.address is None:
            raise socket.gaierror(socket.EAI_AGAIN, "Temporary failure in name resolution")
        return self._real(*self.address, type=socket.SOCK_DGRAM)


class NamedRobot(Robot):
    """A robot that knows its server by name."""

    def __init__(self, *servers: tuple[str, int]) -> None:
        self.client = Client(ClientConfig(), ROBOTS[0], TRUST, "hub", time.monotonic())
        self.events: list[object] = []
        self.sent: list[bytes] = []
        self.loop = ClientLoop(self.client, servers or [("robots.example", 7410)], self.events.append)
        step = self.loop.step

        def seeking(longest: float) -> None:
            self.loop.seek(time.monotonic())
            step(longest)

        self.loop.step = seeking


def test_a_name_is_asked_for_until_it_has_an_address_and_again_when_the_session_is_lost(monkeypatch):
    names, robot = Names(monkeypatch), NamedRobot()
    robot.until(lambda: sum(isinstance(event, Unresolved) for event in robot.events) == 3)
    assert robot.events[0].why.startswith("the address 'robots.example' cannot be found: Temporary failure")
    assert not robot.loop.resolved and robot.client.phase == "idle"
    for place in [("127.0.0.1", 0), ("::1", 0)]:  # the second time, the server has moved
        try:
            sock = server_socket(place)
        except (OSError, NetworkError):  # a machine without IPv6
            sock = server_socket(("127.0.0.1", 0))
        worker = Worker(sock)
        names.address = worker.loop.socket.getsockname()[:2]
        robot.connect()
        robot.ask([b"are you there?"])
        asked = names.asked
        robot.ask([b"still there?"])
        assert robot.loop.resolved and names.asked == asked, "nobody is asked while the session stands"
        worker.stop()
        robot.until(lambda: not robot.client.connected)
    robot.close()


def test_of_two_servers_the_one_that_answers_is_taken_and_a_robot_that_is_sent_on_goes_there(monkeypatch):
    monkeypatch.setattr("rosbridge_eth.channel.udp.ASK_AGAIN", 0.5)
    notice_soon(monkeypatch)
    first, other = (Worker(server_socket(("127.0.0.1", 0))) for _ in range(2))
    with closing(server_socket(("127.0.0.1", 0))) as silent:
        robot = NamedRobot(silent.getsockname(), first.loop.socket.getsockname())
        robot.until(lambda: first.server.statistics()["connections"] == 1)
        robot.until(lambda: robot.client.connected)
        robot.loop.go(other.loop.socket.getsockname(), time.monotonic())
        robot.until(lambda: other.server.statistics()["connections"] == 1)
        robot.until(lambda: first.server.statistics()["connections"] == 0)
        robot.until(lambda: robot.client.connected)
        other.stop()
        robot.until(lambda: first.server.statistics()["connections"] == 1)
    robot.close()
    first.stop()


@pytest.mark.parametrize("error", [OSError(errno.EMFILE, "Too many open files"), None], ids=str)
def test_an_address_that_is_of_no_use_here_is_none(monkeypatch, error):
    names, robot = Names(monkeypatch), NamedRobot()
    names.address = ("::1", 7410)
    if error is not None:  # EAI_SYSTEM
        names._real = lambda *given, **more: (_ for _ in ()).throw(error)
    else:
        monkeypatch.setattr("rosbridge_eth.channel.udp._open", lambda family: socket.socket(99))
    robot.until(lambda: robot.events)
    assert isinstance(robot.events[0], Unresolved) and not robot.loop.resolved
    robot.loop.close()


def test_of_several_addresses_of_a_name_the_first_that_is_ipv4_is_taken(monkeypatch):
    """As `localhost` has on most machines, where a server listens on 0.0.0.0."""
    six, four = ((family, socket.SOCK_DGRAM, 17, "", (host, 7410)) for family, host in
                 ((socket.AF_INET6, "::1"), (socket.AF_INET, "127.0.0.1")))  # fmt: skip
    for found, address in (([six, four], "127.0.0.1"), ([six], "::1")):
        monkeypatch.setattr(socket, "getaddrinfo", lambda *_, found=found, **__: found)
        sock, taken = client_socket(("localhost", 7410))
        sock.close()
        assert taken == (address, 7410)


def test_a_name_server_that_does_not_answer_keeps_nobody_waiting(monkeypatch):
    names = Names(monkeypatch)
    names.gate.clear()
    robot = NamedRobot()
    for _ in range(20):
        robot.loop.step(0.0)
    assert names.asked == 1 and robot.events == []
    robot.loop.close()
    names.gate.set()  # and its answer finds nobody


def test_nobody_at_the_other_end_is_not_an_error_of_the_socket():
    free = server_socket(("127.0.0.1", 0))
    port = free.getsockname()[1]
    free.close()
    robot = Robot(ROBOTS[0], port)
    end = time.monotonic() + 0.6
    while time.monotonic() < end:
        robot.loop.step(0.1)
    assert robot.client.phase == "greeting"
    robot.loop.close()


def hello_from(port: int, target: int) -> bytes:
    """A UDP datagram as it stands in an IP packet, with a good HELLO in it, from any port."""
    hello = Hello(Mode.EXCHANGE, bytes(8), bytes(16)).datagram(Kind.HELLO, HELLO_PADDING)
    return struct.pack(">HHHH", port, target, 8 + len(hello), 0) + hello  # a checksum of 0: none


def test_a_hello_from_port_0_costs_one_datagram(workers):
    """Its answer cannot be sent (EINVAL), and ended a worker of the first edition."""
    try:
        raw = socket.socket(socket.AF_INET, socket.SOCK_RAW, socket.IPPROTO_UDP)
    except PermissionError:
        pytest.skip("raw sockets are not permitted here; the next test does it with a made-up address")
    port = port_of(workers)
    with raw:
        for _ in range(3):
            raw.sendto(hello_from(0, port), ("127.0.0.1", port))
    robot = Robot(ROBOTS[0], port)
    robot.until(lambda: sum(worker.loop.lost_sends for worker in workers) == 3)
    robot.connect()
    robot.ask([b"still there"])
    robot.close()
    assert all(worker.thread.is_alive() for worker in workers)


@pytest.mark.parametrize(
    "address",
    [("127.0.0.1", 0), ("127.0.0.1", 70_000), ("255.255.255.255", 9), ("240.0.0.1", 9), ("::1", 9), ("", 0)],
    ids=lambda address: f"{address[0]} {address[1]}",
)
def test_a_datagram_that_cannot_be_sent_is_a_lost_datagram(address):
    sock = server_socket(("127.0.0.1", 0))
    server = Server(ServerConfig(), HUB, TRUST, cookie_key(HUB), time.monotonic())
    loop = UdpLoop(server, sock, lambda event: None)
    hello = Hello(Mode.EXCHANGE, bytes(8), bytes(16)).datagram(Kind.HELLO, HELLO_PADDING)
    server.receive_datagram(hello, address, time.monotonic())
    loop.step(0.0)
    assert loop.lost_sends == 1
    loop.close()


class Socket:
    """A socket whose calls fail as a test wants, and otherwise work."""

    def __init__(self, real: socket.socket, **errors: int) -> None:
        self._real, self._errors = real, errors

    def __getattr__(self, name: str) -> object:
        if name not in self._errors:
            return getattr(self._real, name)

        def fail_once(*arguments: object) -> object:
            code = self._errors.pop(name, None)
            if code is None:
                return getattr(self._real, name)(*arguments)
            raise OSError(code, os.strerror(code))

        return fail_once


@pytest.mark.parametrize("code", [errno.ECONNREFUSED, errno.EHOSTUNREACH, errno.ENETDOWN, errno.EMSGSIZE, errno.EIO])
def test_news_of_the_network_does_not_end_a_loop(code):
    sock = server_socket(("127.0.0.1", 0))
    server = Server(ServerConfig(), HUB, TRUST, cookie_key(HUB), time.monotonic())
    loop = UdpLoop(server, Socket(sock, recvfrom=code, sendto=code), lambda event: None)
    robot = Robot(ROBOTS[0], sock.getsockname()[1])
    end = time.monotonic() + PATIENCE
    while not robot.client.connected and time.monotonic() < end:
        robot.loop.step(0.01)
        loop.step(0.01)
    assert robot.client.connected and loop.lost_sends == 1
    robot.loop.close()
    loop.close()


def test_a_socket_that_is_no_socket_any_more_is_an_error():
    sock = server_socket(("127.0.0.1", 0))
    server = Server(ServerConfig(), HUB, TRUST, cookie_key(HUB), time.monotonic())
    loop = UdpLoop(server, Socket(sock, recvfrom=errno.EBADF), lambda event: None)
    Robot(ROBOTS[0], sock.getsockname()[1]).loop.step(0.0)
    with pytest.raises(NetworkError, match="cannot be read"):
        loop.step(1.0)
    loop.close()
