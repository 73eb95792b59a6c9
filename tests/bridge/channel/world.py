"""Robots and a server on the simulated network, with the program that each end would run.

`RobotProgram` has messages to be stored: in each session it sends what follows those that the server's state names.
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
    State,
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
    """Messages up: a number, and what is to be stored. State down: how many are stored, then `more`."""

    def __init__(self, network: Network, config: ServerConfig | None = None, commit_delay: float = 0.0) -> None:
        self.network = network
        self.config = config
        self.commit_delay = commit_delay
        self.stored: dict[str, list[bytes]] = {}
        self.names: dict[bytes, str] = {}
        self.next: dict[bytes, int] = {}
        self.more = bytes(117)  # the hop's state has 121 bytes without a reason
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
            if isinstance(event, Connected):
                self.names[event.connection] = event.peer.name
                self.next[event.connection] = len(self.stored.setdefault(event.peer.name, []))
                self.say(event.connection)
            return
        stored = self.stored[self.names[event.connection]]
        number = int.from_bytes(event.payload[:4], "big")
        expected = self.next[event.connection]
        if number != expected:
            self.broken.append(f"message {number} came where {expected} was expected")
        self.next[event.connection] = number + 1
        server = self.server

        def commit() -> None:
            if server is not self.server:
                return  # this process died before its commit
            if number == len(stored):
                stored.append(event.payload[4:])
            self.say(event.connection)

        if self.commit_delay:
            self.network.at(self.network.now + self.commit_delay, commit)
        else:
            commit()

    def say(self, connection: bytes) -> None:
        count = len(self.stored[self.names[connection]])
        self.server.set_state(connection, count.to_bytes(4, "big") + self.more)


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
            if not self.client.connected or self.client.room() < len(payload):
                break
            self.client.send(payload)
            self.sent += 1

    def on_event(self, event: Event) -> None:
        match event:
            case State(data=data):
                stored = int.from_bytes(data[:4], "big")
                if self.sent is None:
                    self.sent = self.session_stored = stored
                if stored < self.session_stored:
                    self.broken.append(f"{stored} came after {self.session_stored}")
                self.stored = self.session_stored = stored
            case _:
                self.events.append(event)
                if isinstance(event, Connected | Disconnected):
                    self.sent = None
        self.feed()

    @property
    def done(self) -> bool:
        return self.stored == len(self.messages)
