"""What `Connection.receive_data` returns, in the order in which it happened."""

from __future__ import annotations

from dataclasses import dataclass, field
from datetime import datetime
from typing import TypeAlias

from smcrypto.x509 import AnyCertificate

__all__ = ["ConnectionClosed", "DataReceived", "Event", "HandshakeCompleted", "Session", "SessionIssued"]


@dataclass(frozen=True, slots=True)
class Session:
    """What a later connection to the same server needs to resume this one. Secret: not in its repr.

    A client gives it to `Connection(context, session=…)` with the same server_hostname, otherwise InvalidOption, and
    with a context that trusts the same roots: the server's certificate is not checked again. A server that has
    forgotten the session, or finds it too old, makes a full handshake.
    """

    version: str
    suite: str
    server_hostname: str | None
    """The name that the server's certificate was checked for, None for none."""
    peer_certificates: tuple[AnyCertificate, ...]
    issued: datetime
    lifetime: int
    """Seconds from `issued` in which it may be used."""
    identity: bytes = field(repr=False)
    """TLCP: the session id; TLS 1.3: the ticket."""
    secret: bytes = field(repr=False)
    """TLCP: the master secret, 48 bytes; TLS 1.3: the pre-shared key, 32 bytes."""
    age_add: int = field(default=0, repr=False)
    """TLS 1.3: what hides the ticket's age, in milliseconds (RFC 8446, 4.6.1)."""


@dataclass(frozen=True, slots=True)
class HandshakeCompleted:
    """Both sides are done: the peer is who the certificates say, and data may be sent."""

    version: str
    """"TLCPv1.1" or "TLSv1.3"."""
    suite: str
    """The suite by its standard name, such as "ECC_SM4_CBC_SM3"."""
    peer_certificates: tuple[AnyCertificate, ...]
    """As the peer sent them: the signing certificate first, in TLCP the encryption certificate second, then those of
    CAs. (A client's second one is needed, and checked, with ECDHE only.) Of a resumed session: those of its first
    handshake. Empty for a client without a certificate."""
    alpn: str | None
    """The application protocol that was agreed on."""
    resumed: bool
    """Were keys and certificates taken over from an earlier session?"""


@dataclass(frozen=True, slots=True)
class DataReceived:
    """Application data, in order, never empty."""

    data: bytes


@dataclass(frozen=True, slots=True)
class SessionIssued:
    """To clients: a session that a later connection can resume."""

    session: Session


@dataclass(frozen=True, slots=True)
class ConnectionClosed:
    """The peer sent close_notify: no data follow. One's own direction stays open until `close` (RFC 8446, 6.1)."""


Event: TypeAlias = HandshakeCompleted | DataReceived | SessionIssued | ConnectionClosed
