"""What an endpoint tells the program that drives it, its settings, and its counters."""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping
from dataclasses import dataclass, field
from datetime import datetime
from enum import StrEnum
from types import MappingProxyType

from rosbridge_eth.channel.admission import Address
from rosbridge_eth.channel.wire import Mode, Reason
from rosbridge_eth.errors import NetworkError
from rosbridge_eth.identity import PeerIdentity, Role


class Full(NetworkError):
    """No more is taken until some of what was sent is acknowledged; ask `writable` first."""


class NotConnected(NetworkError):
    """There is no session to send on; wait for Connected."""


class End(StrEnum):
    """Why a session ended."""

    CLOSED = "closed here"
    CLOSED_BY_PEER = "closed by the peer"
    REPLACED = "replaced by a newer session of the same identity"
    REVOKED = "identity revoked"
    SILENT = "the peer fell silent"
    PROTOCOL = "the peer broke the protocol"
    EXPIRED = "the session's time or packet numbers are used up"


class Drop(StrEnum):
    """Why a datagram was dropped without a word; the keys of Statistics.dropped."""

    MALFORMED = "malformed"
    MODE = "other mode"
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
    REPLAYED = "packet number seen before"
    TAG = "authentication failed"
    EARLY = "before the handshake was finished"
    FULL = "no room to keep it until what comes before it is there"


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
    """The session ended. What it did not deliver is the program's to send again in the next one."""

    reason: End
    connection: bytes
    peer: PeerIdentity


@dataclass(frozen=True, slots=True)
class Message:
    """A message of the peer's, in the order of its sending, once a session."""

    connection: bytes
    payload: bytes
    peer: PeerIdentity


@dataclass(frozen=True, slots=True)
class AddressChanged:
    """At a server: a client was proven to be at a new address."""

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


Event = Connected | Disconnected | Message | AddressChanged | HandshakeFailed


@dataclass(frozen=True, slots=True, kw_only=True)
class ChannelConfig:
    """Settings of either end. Times in seconds, sizes in bytes."""

    max_ack_delay: float = 0.02
    ack_every: int = 8
    """Packets after which an acknowledgement is sent without waiting for max_ack_delay."""
    max_message: int = 72 * 1024
    max_buffered: int = 1 << 20
    """Of one session: what was sent and is not acknowledged yet."""
    max_window: int = 512 * 1024
    """Upper limit of the congestion window."""
    session_packets: int = 1 << 20
    """A session ends when so many packets were sent in a direction."""

    def __post_init__(self) -> None:
        if not 0 < self.max_message <= self.max_buffered - 4:
            raise ValueError("max_buffered must hold at least one message of max_message bytes")
        if not 1 <= self.session_packets <= 1 << 23:  # RFC 9001, 6.6: the limit of GCM with 128-bit keys
            raise ValueError(f"session_packets must be 1 to 2**23, not {self.session_packets}")


@dataclass(frozen=True, slots=True, kw_only=True)
class ClientConfig(ChannelConfig):
    """Settings of a client."""

    mode: Mode = Mode.EXCHANGE
    """The one it uses; it never falls back to another."""
    keep_alive: float = 10.0
    """A client that sent nothing for so long sends a ping; three times as often while it waits for something."""
    patience: float = 10.0
    patience_max: float = 60.0
    """A client that waits and gets no packet for so long makes a new session; doubled each time, up to the second."""
    session_seconds: tuple[float, float] = (2700.0, 3600.0)
    """The age at which a session is ended and another made, drawn between the two."""
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
    idle_timeout: float = 30.0
    """A session without an authenticated packet for so long has ended."""
    session_seconds: float = 3900.0
    """A session that its client did not end by this age is ended."""
    cookie_lifetime: float = 20.0
    half_open_timeout: float = 10.0
    max_half_open: int = 1024
    max_connections: int = 4096
    max_total_bytes: int = 64 << 20
    """Of all sessions: messages that were not taken, parts of messages, and segments that came too early. Above it,
    each session keeps a few of these, and else takes only what comes in order."""
    source_rate: float = 10.0
    source_burst: float = 400.0
    """Handshakes that one source may fail per second, and at once."""
    max_sources: int = 4096
    handshake_share: float = 0.5
    """Share of time that handshakes may take."""

    def __post_init__(self) -> None:
        super(ServerConfig, self).__post_init__()
        if not 0 <= self.worker <= 255:
            raise ValueError(f"worker must be 0 to 255, not {self.worker}")


@dataclass(frozen=True, slots=True)
class Statistics:
    """Counters of an endpoint since it was made, and after them what is there at this moment."""

    datagrams_sent: int = 0
    datagrams_received: int = 0
    bytes_sent: int = 0
    bytes_received: int = 0
    packets_lost: int = 0
    retransmitted: int = 0
    duplicates: int = 0
    messages_sent: int = 0
    messages_received: int = 0
    handshakes: int = 0
    handshakes_begun: int = 0
    cookies: int = 0
    address_changes: int = 0
    connections: int = 0
    half_open: int = 0
    held_bytes: int = 0
    dropped: Mapping[str, int] = field(default_factory=lambda: MappingProxyType({}))


class Counters:
    """The counters while they count; `Statistics` is what is shown of them."""

    def __init__(self) -> None:
        self.count: Counter[str] = Counter()
        self.dropped: Counter[Drop] = Counter()

    def drop(self, reason: Drop) -> None:
        self.dropped[reason] += 1

    def snapshot(self, **gauges: int) -> Statistics:
        dropped = MappingProxyType({str(reason): n for reason, n in sorted(self.dropped.items())})
        return Statistics(**self.count, **gauges, dropped=dropped)
