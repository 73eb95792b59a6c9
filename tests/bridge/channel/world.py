"""Robots and a server on the simulated network, with the program that each end would run.

`RobotProgram` has messages to be stored: at each session it asks what the server has of them, and sends what follows.
`ServerProgram` stores after a while and then says so; what it stored survives its restarts, what it only heard does
not. Both write down whatever a promise of the channel forbids.
"""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from functools import cache

from bridge.channel.simulation import Host, Network
from rosbridge_eth import identity as ids
from rosbridge_eth.channel import (
    Client,
    ClientConfig,
    Connected,
    Disconnected,
    Event,
    Message,
    Server,
    ServerConfig,
    cookie_key,
)

BIRTH = datetime(2026, 1, 1, tzinfo=UTC)
TODAY = BIRTH + timedelta(days=30)
SERVER_ADDRESS = ("192.0.2.1", 4433)


def wall() -> datetime:
    return TODAY


@cache
def authority(name: str) -> ids.CertificateAuthority:
    return ids.create_ca(name, at=BIRTH)


@cache
def identity(role: ids.Role, name: str, ca: str) -> ids.Identity:
    return ids.enrol(authority(ca), role, name, at=BIRTH)


def robot(name: str = "robot_1") -> ids.Identity:
    return identity(ids.Role.ROBOT, name, "operator")


def hub() -> ids.Identity:
    return identity(ids.Role.SERVER, "hub", "operator")


def trust() -> ids.Trust:
    return ids.Trust((authority("operator").certificate,))


def make_server(now: float, config: ServerConfig | None = None, **options: object) -> Server:
    return Server(
        config or ServerConfig(),
        hub(),
        options.pop("trust", trust()),
        cookie_key(hub()),
        now,
        wall=wall,
        stopwatch=lambda: 0.0,
        **options,
    )


def make_client(
    now: float, config: ClientConfig | None = None, who: ids.Identity | None = None, **options: object
) -> Client:
    return Client(
        config or ClientConfig(),
        who or robot(),
        options.pop("trust", trust()),
        options.pop("server_name", "hub"),
        now,
        wall=wall,
        **options,
    )


class ServerProgram:
    """Messages up: `?`, or a number and what is to be stored. Down: how many are stored, after each of them."""

    def __init__(self, network: Network, config: ServerConfig | None = None, commit_delay: float = 0.0) -> None:
        self.network = network
        self.config = config
        self.commit_delay = commit_delay
        self.stored: dict[str, list[bytes]] = {}
        self.next: dict[bytes, int] = {}
        self.events: list[Event] = []
        self.broken: list[str] = []
        self.most_early = 0
        self.host: Host = network.attach(self._start(), SERVER_ADDRESS, self.on_event)

    @property
    def server(self) -> Server:
        assert isinstance(self.host.endpoint, Server)
        return self.host.endpoint

    def _start(self) -> Server:
        return make_server(self.network.now, self.config)

    def restart(self) -> None:
        self.host.endpoint = self._start()

    def on_event(self, event: Event) -> None:
        self.most_early = max(self.most_early, self.server.statistics()["early"])
        if not isinstance(event, Message):
            self.events.append(event)
            return
        stored = self.stored.setdefault(event.peer.name, [])
        if event.payload == b"?":
            if event.connection in self.next:
                self.broken.append("a question was heard twice in a session")
            self.next[event.connection] = len(stored)
            self._say(event.connection, len(stored))
            return
        number = int.from_bytes(event.payload[:4], "big")
        expected = self.next.get(event.connection, -1)
        if number != expected:
            self.broken.append(f"message {number} came where {expected} was expected")
        self.next[event.connection] = number + 1
        server = self.server

        def commit() -> None:
            if server is not self.server:
                return  # this process died before its commit
            if number == len(stored):
                stored.append(event.payload[4:])
            self._say(event.connection, len(stored))

        if self.commit_delay:
            self.network.at(self.network.now + self.commit_delay, commit)
        else:
            commit()

    def _say(self, connection: bytes, count: int) -> None:
        if self.server.writable(connection, 4):
            self.server.send(connection, count.to_bytes(4, "big"))


class RobotProgram:
    """Sends `messages`, each until it is stored."""

    def __init__(
        self,
        network: Network,
        messages: list[bytes],
        who: ids.Identity | None = None,
        address: tuple[str, int] = ("198.51.100.7", 50000),
        config: ClientConfig | None = None,
    ) -> None:
        self.network = network
        self.who = who
        self.config = config
        self.messages = list(messages)
        self.sent: int | None = None
        self.stored = 0
        self.session_stored = 0
        self.events: list[Event] = []
        self.broken: list[str] = []
        self.host = network.attach(self._start(), address, self.on_event)

    @property
    def client(self) -> Client:
        assert isinstance(self.host.endpoint, Client)
        return self.host.endpoint

    def _start(self) -> Client:
        self.sent = None
        client = make_client(self.network.now, self.config, self.who)
        client.connect(SERVER_ADDRESS, self.network.now)
        return client

    def restart(self) -> None:
        """The process dies and comes back."""
        self.host.endpoint = self._start()

    def feed(self) -> None:
        """Send what the session takes."""
        while self.sent is not None and self.sent < len(self.messages):
            payload = self.sent.to_bytes(4, "big") + self.messages[self.sent]
            if not self.client.writable(len(payload)):
                break
            self.client.send(payload)
            self.client.expecting(True)
            self.sent += 1

    def on_event(self, event: Event) -> None:
        match event:
            case Message(payload=payload):
                stored = int.from_bytes(payload, "big")
                if self.sent is None:
                    self.sent = self.session_stored = stored
                if stored < self.session_stored:
                    self.broken.append(f"{stored} came after {self.session_stored}")
                self.stored = self.session_stored = stored
                self.client.progressed()
                self.client.expecting(stored < self.sent)
            case Connected():
                self.sent = None
                self.client.send(b"?")
                self.client.expecting(True)
                self.events.append(event)
            case Disconnected():
                self.sent = None
                self.events.append(event)
            case _:
                self.events.append(event)
        self.feed()

    @property
    def done(self) -> bool:
        return self.stored == len(self.messages)
