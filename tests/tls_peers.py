"""Two connections of smcrypto.tls that talk to each other in memory, and the certificates they need."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass, field
from typing import Any

import pytest

import x509_authority as authority
from smcrypto.tls import Alert, Connection, Event, HandshakeCompleted, SMContext, TLSError
from smcrypto.tls.handshake import Handshake
from smcrypto.tls.messages import Kind, pack_message
from smcrypto.tls.record import HANDSHAKE
from smcrypto.x509 import ENCRYPTION_KEY_USAGE

HOST = "server.example"
NOW = authority.NOW
ROOT = authority.root()
OTHER_ROOT = authority.root("another root")
CA = ROOT.ca("intermediate")
SERVER = CA.issue(HOST, subject_alt_names=[f"DNS:{HOST}", "IP:192.0.2.1"], extended_key_usage=["serverAuth"])
SERVER_ENC = CA.issue(HOST, subject_alt_names=[f"DNS:{HOST}"], key_usage=ENCRYPTION_KEY_USAGE)
CLIENT = ROOT.issue("client", extended_key_usage=["clientAuth"])
CLIENT_ENC = ROOT.issue("client", key_usage=ENCRYPTION_KEY_USAGE)


def context(**options: Any) -> SMContext:
    return SMContext(**{"roots": authority.certificates(ROOT), "now": lambda: NOW, **_tuples(options)})


def _tuples(options: dict[str, Any]) -> dict[str, Any]:
    return {name: tuple(value) if isinstance(value, list) else value for name, value in options.items()}


def server_context(**options: Any) -> SMContext:
    own = {
        "certificates": (SERVER.certificate, CA.certificate), "key": SERVER.key,
        "encryption_certificate": SERVER_ENC.certificate, "encryption_key": SERVER_ENC.key,
    }  # fmt: skip
    return context(**own | options)


def client_context(*, certificate: bool = False, **options: Any) -> SMContext:
    own: dict[str, Any] = {}
    if certificate:
        own = {
            "certificates": (CLIENT.certificate,), "key": CLIENT.key,
            "encryption_certificate": CLIENT_ENC.certificate, "encryption_key": CLIENT_ENC.key,
        }  # fmt: skip
    return context(**own | options)


@dataclass
class Pair:
    """A client, a server, and what each was told."""

    client: Connection
    server: Connection
    client_events: list[Event] = field(default_factory=list)
    server_events: list[Event] = field(default_factory=list)

    def run(self, step: int = 1 << 30) -> None:
        """Carry bytes both ways, `step` at a time, until neither has any."""
        while True:
            up, down = self.client.data_to_send(), self.server.data_to_send()
            if not up and not down:
                return
            for i in range(0, len(up), step):
                self.server_events += self.server.receive_data(up[i : i + step])
            for i in range(0, len(down), step):
                self.client_events += self.client.receive_data(down[i : i + step])


def pair(client: SMContext, server: SMContext, *, host: str | None = HOST, session: Any = None) -> Pair:
    return Pair(Connection(client, server_hostname=host, session=session), Connection(server, server_side=True))


def connect(client: SMContext, server: SMContext, *, step: int = 1 << 30, **options: Any) -> Pair:
    """A pair whose handshake is done."""
    made = pair(client, server, **options)
    made.run(step)
    return made


def completed(events: list[Event]) -> HandshakeCompleted:
    [event] = [event for event in events if isinstance(event, HandshakeCompleted)]
    return event


Change = Callable[[bytes], Iterable[tuple[int, bytes]]]


def lie(monkeypatch: pytest.MonkeyPatch, liar: SMContext, kind: Kind, change: Change) -> None:
    """Whoever has the context `liar` sends, for its message of this kind, those that `change` makes of its body.

    It believes that it has sent these, so that its Finished holds for them: only a check of the message itself helps.
    """
    honest = Handshake.send

    def send(self: Handshake, sent: Kind, *parts: bytes) -> None:
        if self.context is not liar or sent != kind:
            honest(self, sent, *parts)
            return
        for number, body in change(b"".join(parts)):
            raw = pack_message(number, body)
            self.transcript.update(raw)
            self.records.write(HANDSHAKE, raw)

    monkeypatch.setattr(Handshake, "send", send)


def refused(pair: Pair, alert: Alert, step: int = 1 << 30) -> TLSError:
    """The error with which one of the two gives up: the only one, after which its alert is sent and nothing else."""
    with pytest.raises(TLSError) as caught:
        pair.run(step)
    assert caught.value.alert == alert, caught.value
    for connection in (pair.client, pair.server):
        if connection._error is caught.value:
            victim, other = connection, pair.server if connection is pair.client else pair.client
            break
    with pytest.raises(TLSError):
        victim.receive_data(b"more")
    with pytest.raises(TLSError):
        victim.send(b"more")
    sent = victim.data_to_send()
    assert sent and not victim.data_to_send()
    with pytest.raises(TLSError):
        other.receive_data(sent)
    return caught.value
