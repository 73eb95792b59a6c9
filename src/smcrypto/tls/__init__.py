"""TLCP (GB/T 38636-2020) and TLS 1.3 with SM algorithms (RFC 8446, RFC 8998), as state machines without sockets.

`SMContext` is the configuration, `Connection` one connection: bytes from the network go in by `receive_data`, events
come out; `data_to_send` gives the bytes for the network. Failures are `TLSError`, which names the alert.

    alerts         the error and the alert descriptions
    events         what `receive_data` returns, and sessions
    context        configuration
    messages       handshake messages as bytes: one bounded reader, and their writers
    schedule       keys from secrets: PRF of TLCP, HKDF of TLS 1.3
    record         records and their protection
    peer           is the peer's certificate to be trusted
    tlcp, tls13    the two handshakes, client and server
    connection     what holds them together

Not here: renegotiation, compression, 0-RTT data, other cipher suites, and a fallback from one version to the other.
"""

from __future__ import annotations

from smcrypto.tls.alerts import Alert, TLSError
from smcrypto.tls.connection import Connection
from smcrypto.tls.context import SUITES, SMContext
from smcrypto.tls.events import ConnectionClosed, DataReceived, Event, HandshakeCompleted, Session, SessionIssued

__all__ = [
    "SUITES", "Alert", "Connection", "ConnectionClosed", "DataReceived", "Event", "HandshakeCompleted", "SMContext",
    "Session", "SessionIssued", "TLSError",
]  # fmt: skip
