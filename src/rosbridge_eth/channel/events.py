"""What an endpoint tells the program that drives it, its settings, and its counters."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import datetime
from enum import StrEnum
from types import MappingProxyType
from typing import Protocol

from rosbridge_eth.channel.admission import Address
from rosbridge_eth.channel.wire import Mode, Reason
from rosbridge_eth.errors import NetworkError
from rosbridge_eth.identity import PeerIdentity, Role

__all__ = [
    "AddressChanged",
    "ChannelConfig",
    "ClientConfig",
    "Connected",
    "Disconnected",
    "Drop",
    "End",
    "Endpoint",
    "Event",
    "Full",
    "HandshakeFailed",
    "MessageAnswered",
    "MessageReceived",
    "NotConnected",
    "ServerConfig",
    "Statistics",
]


class Full(NetworkError):
    """No more messages are taken until some are answered; ask `writable` first."""


class NotConnected(NetworkError):
    """There is no session to send on; wait for Connected."""


class End(StrEnum):
    """Why a session ended."""

    CLOSED = "closed here"
    CLOSED_BY_PEER = "closed by the peer"
    REPLACED = "replaced by a newer session of the same identity"
    REVOKED = "identity revoked"
    SILENT = "the peer fell silent"
    RESET = "the server does not know the session any more"
    PROTOCOL = "the peer broke the protocol"
    EXHAUSTED = "the session's keys or numbers are used up"


class Drop(StrEnum):
    """Why a datagram was dropped without a word; the keys of Statistics.dropped."""

    MALFORMED = "malformed"
    VERSION_OR_MODE = "other mode"
    UNEXPECTED = "unexpected in this state"
    ADDRESS = "from another address"
    COOKIE = "cookie wrong or too old"
    REPLAYED_HANDSHAKE = "handshake seen before"
    SOURCE_LIMIT = "too many handshakes from the source"
    BUSY = "no time left for handshakes"
    HALF_OPEN = "too many half-open handshakes"
    CONNECTIONS = "too many connections"
    CERTIFICATE = "certificate refused"
    SIGNATURE = "handshake signature or confirmation wrong"
    UNKNOWN_CONNECTION = "unknown connection"
    EPOCH = "unknown epoch"
    REPLAYED = "packet number seen before"
    TAG = "authentication failed"
    EARLY = "before the handshake was finished"
    RESET = "reset that proves nothing"
    FULL = "messages refused for lack of room"


@dataclass(frozen=True, slots=True)
class Connected:
    """A session stands. connection: its handle at a server (8 bytes), at a client its own id.

    server_time: at a client, the server's authenticated wall clock when it accepted; None at a server.
    """

    peer: PeerIdentity
    connection: bytes
    server_time: datetime | None = None


@dataclass(frozen=True, slots=True)
class Disconnected:
    """The session ended. unanswered: at a client, ids of messages without an answer, in order."""

    reason: End
    connection: bytes
    unanswered: tuple[int, ...] = ()
    peer: PeerIdentity | None = None


@dataclass(frozen=True, slots=True)
class MessageReceived:
    """At a server: a message, once per connection. Answer it with `reply` after the commit."""

    connection: bytes
    message_id: int
    payload: bytes
    peer: PeerIdentity


@dataclass(frozen=True, slots=True)
class MessageAnswered:
    """At a client: the server's answer to the message that `send` gave this id."""

    message_id: int
    payload: bytes


@dataclass(frozen=True, slots=True)
class AddressChanged:
    """At a server: a client was proven to be at a new address, and is sent to there from now on."""

    connection: bytes
    peer: PeerIdentity
    address: Address


@dataclass(frozen=True, slots=True)
class HandshakeFailed:
    """At a client: an attempt to connect came to nothing; another follows. why: a sentence for a person.

    hint: what somebody at the server's address says; not authenticated, so only a hint.
    """

    why: str
    hint: Reason | None = None


Event = Connected | Disconnected | MessageReceived | MessageAnswered | AddressChanged | HandshakeFailed


class Endpoint(Protocol):
    """What Client and Server have in common."""

    def receive_datagram(self, data: bytes, address: Address, now: float) -> None: ...

    def datagrams_to_send(self, now: float) -> list[tuple[bytes, Address]]: ...

    def next_timer(self) -> float | None: ...

    def handle_timer(self, now: float) -> None: ...

    def next_event(self) -> Event | None: ...


@dataclass(frozen=True, slots=True, kw_only=True)
class ChannelConfig:
    """Settings of either end. Times in seconds, sizes in bytes."""

    idle_timeout: float = 30.0
    """A session without an authenticated packet for so long has ended."""
    keep_alive: float = 10.0
    """A client that sent nothing for so long sends a ping."""
    silence_timeout: float = 10.0
    """A client whose packets go unacknowledged for so long begins a new session."""
    max_ack_delay: float = 0.02
    ack_every: int = 8
    """Packets after which an acknowledgement is sent without waiting for max_ack_delay."""
    max_message: int = 48 * 1024
    max_unanswered: int = 256
    """Messages of one session that wait for their answer. The smaller figure of both ends holds."""
    max_unanswered_bytes: int = 1 << 20
    max_window: int = 256 * 1024
    """Upper limit of the congestion window."""
    rekey_packets: int = 1 << 20
    rekey_seconds: float = 3600.0
    rekey_interval: float = 1.0
    """A peer's epochs may not follow each other faster."""

    def __post_init__(self) -> None:
        if not 1 <= self.max_message <= 0xFFFF:
            raise ValueError(f"max_message must be 1 to 65535 bytes, not {self.max_message}")
        if self.max_unanswered < 1 or self.max_unanswered_bytes < self.max_message:
            raise ValueError("max_unanswered and max_unanswered_bytes must hold at least one message")
        if not 1 <= self.rekey_packets <= 1 << 22:
            raise ValueError(f"rekey_packets must be 1 to 2**22, not {self.rekey_packets}")


@dataclass(frozen=True, slots=True, kw_only=True)
class ClientConfig(ChannelConfig):
    """Settings of a client."""

    mode: Mode = Mode.EXCHANGE
    """The one it uses; it never falls back to another."""
    reconnect_min: float = 0.25
    reconnect_max: float = 10.0
    """A client's wait before another handshake grows from one to the other, less up to a half by chance."""
    attempt_timeout: float = 8.0
    """A handshake that takes longer is begun anew."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ServerConfig(ChannelConfig):
    """Settings of a server; the limits are per process."""

    modes: tuple[Mode, ...] = (Mode.EXCHANGE,)
    """Those it takes; `transport`, which is not forward secret, only where it is named here."""
    roles: tuple[Role, ...] = (Role.ROBOT,)
    worker: int = 0
    """This process's number among those that share the port (0 to 255): first byte of its connection ids."""
    cookie_lifetime: float = 20.0
    half_open_timeout: float = 10.0
    max_half_open: int = 1024
    max_connections: int = 4096
    max_total_bytes: int = 64 << 20
    """Messages without an answer, parts of messages and answers without an acknowledgement, all connections."""
    source_rate: float = 10.0
    source_burst: float = 400.0
    """Handshakes that one source may fail per second, and at once."""
    max_sources: int = 4096
    handshake_share: float = 0.5
    """Share of time that handshakes may take."""
    reset_rate: float = 100.0
    max_certificates: int = 4096
    certificate_recheck: float = 600.0
    """A verified pair of certificates is believed for so long before its chain is verified again."""

    def __post_init__(self) -> None:
        super(ServerConfig, self).__post_init__()
        if not 0 <= self.worker <= 255:
            raise ValueError(f"worker must be 0 to 255, not {self.worker}")


@dataclass(frozen=True, slots=True)
class Statistics:
    """Counters of an endpoint since it was made."""

    datagrams_sent: int = 0
    datagrams_received: int = 0
    bytes_sent: int = 0
    bytes_received: int = 0
    packets_lost: int = 0
    frames_retransmitted: int = 0
    messages: int = 0
    answers: int = 0
    duplicates: int = 0
    handshakes: int = 0
    handshakes_begun: int = 0
    cookies: int = 0
    resets: int = 0
    rekeys: int = 0
    address_changes: int = 0
    connections: int = 0
    half_open: int = 0
    held_bytes: int = 0
    dropped: Mapping[str, int] = field(default_factory=lambda: MappingProxyType({}))


class Counters:
    """The counters while they count; `Statistics` is what is shown of them."""

    __slots__ = ("count", "dropped")

    def __init__(self) -> None:
        self.count: Counter[str] = Counter()
        self.dropped: Counter[Drop] = Counter()

    def drop(self, reason: Drop) -> None:
        self.dropped[reason] += 1

    def snapshot(self, **gauges: int) -> Statistics:
        dropped = MappingProxyType({str(reason): n for reason, n in sorted(self.dropped.items())})
        return Statistics(**self.count, **gauges, dropped=dropped)
