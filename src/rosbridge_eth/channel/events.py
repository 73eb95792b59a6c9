"""What an endpoint tells the program that drives it, and its settings."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from enum import StrEnum
from typing import NamedTuple

from rosbridge_eth.channel.wire import Frame, Malformed, Mode, Reason
from rosbridge_eth.errors import NetworkError
from rosbridge_eth.identity import PeerIdentity


class Full(NetworkError):
    """There is no session, or no more is taken until some of what was sent is acknowledged; ask `room` first."""


class End(StrEnum):
    """Why a session ended."""

    CLOSED = "closed here"
    CLOSED_BY_PEER = "closed by the peer"
    REPLACED = "replaced by a newer session of the same identity"
    REVOKED = "identity revoked"
    SILENT = "the peer fell silent"
    PROTOCOL = "the peer broke the protocol"
    EXPIRED = "the session's time or packet numbers are used up"


_CLOSE_CODES = (End.CLOSED, End.PROTOCOL, End.REPLACED, End.REVOKED, End.EXPIRED, End.SILENT)


def close_frame(reason: End) -> bytes:
    return bytes((Frame.CLOSE, _CLOSE_CODES.index(reason)))


def parse_close(frame: bytes) -> End | None:
    """Why the peer ends the session; None if it does not."""
    if frame[0] != Frame.CLOSE:
        return None
    if len(frame) != 2 or frame[1] >= len(_CLOSE_CODES):
        raise Malformed("a close for no reason that exists")
    reason = _CLOSE_CODES[frame[1]]
    return End.CLOSED_BY_PEER if reason is End.CLOSED else reason


class Connected(NamedTuple):
    """A session stands. connection: its handle at a server (8 bytes), at a client its own id.

    server_time: at a client, the server's authenticated wall clock when it accepted; None at a server.
    """

    peer: PeerIdentity
    connection: bytes
    server_time: datetime | None = None


class Disconnected(NamedTuple):
    """The session ended. Which messages arrived, the server's next state says."""

    reason: End
    connection: bytes
    peer: PeerIdentity


class Message(NamedTuple):
    """At a server: a message of a client's, in the order of its sending, each once a session."""

    connection: bytes
    payload: bytes


class State(NamedTuple):
    """At a client: what the server's program says now, which takes the place of what it said before. The first of a
    session follows Connected; later ones come when it has changed."""

    data: bytes


class HandshakeFailed(NamedTuple):
    """At a client: an attempt to connect came to nothing; another follows. why: a sentence for a person.

    hint: what somebody at the server's address says, or EXPIRED of its own certificate; not authenticated, so only a
    hint.
    """

    why: str
    hint: Reason | None = None


class Unresolved(NamedTuple):
    """At a client: its server's name has no address at this moment; it is asked for again. why: as of HandshakeFailed,
    with what to do."""

    why: str


Event = Connected | Disconnected | Message | State | HandshakeFailed | Unresolved


@dataclass(frozen=True, slots=True, kw_only=True)
class ClientConfig:
    """Settings of a client. Times in seconds."""

    mode: Mode = Mode.EXCHANGE
    """The one it uses; it never falls back to another."""
    attempt_timeout: float = 8.0
    """A handshake that takes longer is started again."""


@dataclass(frozen=True, slots=True, kw_only=True)
class ServerConfig:
    """Settings of a server; the limits are per process."""

    modes: tuple[Mode, ...] = (Mode.EXCHANGE,)
    """Those it takes; `transport`, which is not forward secret, only where it is named here."""
    session_seconds: float = 3900.0
    """A session that its client did not end by this age is ended."""
    max_half_open: int = 1024
    """Handshakes that wait for pieces of a PROOF, and as many that wait for the client's first packet."""
    max_connections: int = 4096
    max_early: int = 50_000
    """Segments of all sessions that came too early (60 MB). Above it each session keeps a few, and else takes only
    what comes in order."""
    handshake_share: float = 0.5
    """Share of time that handshakes may take."""
