"""Robots and a server on the simulated network, with the program that each end would run.

`RobotProgram` is a spool in the small: what has no answer is sent again in the
next session. `ServerProgram` commits after a while and then replies; what it
committed survives its restarts, what it only heard does not. Both write down
whatever a promise of the channel forbids.
"""

from __future__ import annotations

from datetime import UTC, datetime, timedelta
from functools import cache

from rosbridge_eth import identity as ids
from rosbridge_eth.channel import (
    AddressChanged,
    Client,
    ClientConfig,
    Connected,
    Disconnected,
    Event,
    Full,
    HandshakeFailed,
    MessageAnswered,
    MessageReceived,
    NotConnected,
    Server,
    ServerConfig,
    cookie_key,
)
from rosbridge_eth.channel.simulation import Host, Network

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


def answer_to(payload: bytes) -> bytes:
    """What the server's program replies: recognisably to this message, and sometimes in parts."""
    return b"answer to " + payload[:12] + (payload if len(payload) % 7 == 0 else b"")


class ServerProgram:
    def __init__(self, network: Network, config: ServerConfig | None = None, commit_delay: float = 0.0) -> None:
        self.network = network
        self.config = config
        self.commit_delay = commit_delay
        self.committed: list[bytes] = []
        self.heard: set[tuple[int, bytes, int]] = set()
        self.events: list[Event] = []
        self.broken: list[str] = []
        self.most_held = 0
        self.starts = 0
        self.host: Host = network.attach(self._start(), SERVER_ADDRESS, self.on_event)

    @property
    def server(self) -> Server:
        assert isinstance(self.host.endpoint, Server)
        return self.host.endpoint

    def _start(self) -> Server:
        self.starts += 1
        return make_server(self.network.now, self.config)

    def restart(self) -> None:
        self.host.endpoint = self._start()

    def on_event(self, event: Event) -> None:
        self.most_held = max(self.most_held, self.server.statistics().held_bytes)
        if not isinstance(event, MessageReceived):
            self.events.append(event)
            return
        key = (self.starts, event.connection, event.message_id)
        if key in self.heard:
            self.broken.append(f"message {event.message_id} was delivered twice in a session")
        self.heard.add(key)
        server = self.server

        def commit() -> None:
            if server is self.server:  # else this process died before its commit
                self.committed.append(event.payload)
                server.reply(event.connection, event.message_id, answer_to(event.payload))

        if self.commit_delay:
            self.network.at(self.network.now + self.commit_delay, commit)
        else:
            commit()


class RobotProgram:
    """Sends `messages`, each until it is answered."""

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
        self.to_send = list(messages)
        self.asked: dict[int, bytes] = {}
        self.answered: list[bytes] = []
        self.events: list[Event] = []
        self.broken: list[str] = []
        self.host = network.attach(self._start(), address, self.on_event)

    @property
    def client(self) -> Client:
        assert isinstance(self.host.endpoint, Client)
        return self.host.endpoint

    def _start(self) -> Client:
        client = make_client(self.network.now, self.config, self.who)
        client.connect(SERVER_ADDRESS, self.network.now)
        return client

    def restart(self) -> None:
        """The process dies and comes back; its spool remembers what was not answered."""
        self.to_send = list(self.asked.values()) + self.to_send
        self.asked = {}
        self.host.endpoint = self._start()

    def feed(self) -> None:
        client = self.client
        while self.to_send and client.writable(self.network.now, len(self.to_send[0])):
            payload = self.to_send.pop(0)
            try:
                self.asked[client.send(payload, priority=len(payload) % 2)] = payload
            except (Full, NotConnected) as error:
                self.broken.append(f"send refused what writable promised: {error}")

    def on_event(self, event: Event) -> None:
        match event:
            case MessageAnswered(message_id, payload):
                question = self.asked.pop(message_id, None)
                if question is None:
                    self.broken.append(f"message {message_id} was answered twice or never asked")
                elif payload != answer_to(question):
                    self.broken.append(f"message {message_id} got another's answer")
                else:
                    self.answered.append(question)
            case Disconnected(unanswered=unanswered):
                if list(unanswered) != sorted(self.asked):
                    self.broken.append("the unanswered messages are not those without an answer")
                self.to_send = [self.asked[i] for i in unanswered] + self.to_send
                self.asked = {}
                self.events.append(event)
            case Connected() | HandshakeFailed() | AddressChanged():
                self.events.append(event)
        self.feed()

    @property
    def done(self) -> bool:
        return not self.to_send and not self.asked
