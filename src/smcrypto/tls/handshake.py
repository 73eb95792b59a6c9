"""What the handshakes of both protocols have in common: transcript, certificates, sessions, ALPN.

A handshake is a generator: it yields the kinds of message that may come next and is sent the one that came, so that
its text has the order of the standards' figures. Whatever is not among those kinds is refused by `Connection`.
"""

from __future__ import annotations

from collections.abc import Callable, Generator
from dataclasses import dataclass
from datetime import timedelta
from hmac import compare_digest
from typing import ClassVar, Final, TypeAlias, cast

from smcrypto import errors, sm3
from smcrypto.sm2 import PublicKey
from smcrypto.tls import messages
from smcrypto.tls.alerts import Alert, TLSError, refusing, require
from smcrypto.tls.context import MAX_SESSIONS, SUITES, SMContext
from smcrypto.tls.events import Event, HandshakeCompleted, Session
from smcrypto.tls.messages import Extension, Hello, Kind, Message, Reader, vector
from smcrypto.tls.record import HANDSHAKE, Records
from smcrypto.x509 import AnyCertificate, Certificate, load_der_certificate, verify_chain

__all__ = ["CURVE_SM2", "DAY", "ENCRYPTING", "SIGNING", "Handshake", "Steps"]

Steps: TypeAlias = Generator[tuple[int, ...], Message, None]

CURVE_SM2: Final = 41  # RFC 8998, 3.2; TLCP's ECDHE writes the same
MAX_CERTIFICATES: Final = 10
DAY: Final = 86400
SIGNING: Final = frozenset({"digitalSignature"})
ENCRYPTING: Final = frozenset({"keyEncipherment", "dataEncipherment", "keyAgreement"})

# RFC 8446, 6.2: what a refusal of verify_chain is to the peer; any other is bad_certificate.
ALERTS: Final[dict[type[errors.CertificateError], Alert]] = {
    errors.CertificateExpiredError: Alert.certificate_expired,
    errors.CertificateNotYetValidError: Alert.certificate_expired,
    errors.CertificateUnknownIssuerError: Alert.unknown_ca,
    errors.CertificateUsageError: Alert.unsupported_certificate,
    errors.CertificateAlgorithmError: Alert.unsupported_certificate,
}


@dataclass
class Handshake:
    """One side's handshake, and what it finds out. `emit` takes events."""

    VERSION: ClassVar[str]

    context: SMContext
    records: Records
    emit: Callable[[Event], None]
    server_hostname: str | None = None
    session: Session | None = None

    def __post_init__(self) -> None:
        self.transcript = sm3.SM3()
        self.earlier = sm3.SM3()
        """The transcript without the message that `receive` gave last."""
        self.suites = self.context.suites_of(self.VERSION)
        self.completed = False
        self.suite = ""
        self.alpn: str | None = None
        self.resumed = False
        self.peer_certificates: tuple[AnyCertificate, ...] = ()

    # --- messages ---

    def send(self, kind: Kind, *parts: bytes) -> None:
        raw = messages.pack_message(kind, *parts)
        self.transcript.update(raw)
        self.records.write(HANDSHAKE, raw)

    def receive(self, *kinds: Kind) -> Generator[tuple[int, ...], Message, Message]:
        """The next message, which has to be one of these kinds; it is then part of the transcript."""
        message = yield kinds
        self.took(message)
        return message

    def took(self, message: Message) -> None:
        self.earlier = self.transcript.copy()
        self.transcript.update(message.raw)

    def check_finished(self, message: Message, expected: bytes) -> None:
        require(compare_digest(message.body, expected), Alert.decrypt_error, "Finished: the sides saw other messages")

    def complete(self) -> None:
        self.completed = True
        self.emit(HandshakeCompleted(self.VERSION, self.suite, self.peer_certificates, self.alpn, self.resumed))

    # --- negotiation ---

    def send_answer(self, version: int, random: bytes, identity: bytes, extensions: dict[int, bytes]) -> None:
        """ServerHello."""
        answer = Hello(version, random, identity, (SUITES[self.suite][0],), extensions)
        self.send(Kind.server_hello, answer.pack(Kind.server_hello))

    def choose_suite(
        self, names: tuple[str, ...], theirs: tuple[int, ...], alert: Alert = Alert.handshake_failure
    ) -> None:
        """The first of `names` that the client offers; at a client, the one that the server has chosen."""
        self.suite = next((name for name in names if SUITES[name][0] in theirs), "")
        require(self.suite, alert, "no cipher suite in common")

    def hello_extensions(self) -> dict[int, bytes]:
        """Of a ClientHello, in both versions."""
        extensions: dict[int, bytes] = {}
        name = (self.server_hostname or "").removesuffix(".")
        # RFC 6066, 3: no IP addresses. They have colons, or digits as their last label as no name has (RFC 1123, 2.1).
        if self.context.sni and name and ":" not in name and not name.rpartition(".")[2].isdigit():
            extensions[Extension.server_name] = vector(2, b"\0", vector(2, name.encode("ascii")))
        if self.context.alpn:
            extensions[Extension.alpn] = vector(2, *(vector(1, name.encode()) for name in self.context.alpn))
        return extensions

    def answer(self, offered: dict[int, bytes]) -> dict[int, bytes]:
        """A server's answer to them: RFC 7301, 3.2."""
        if Extension.server_name in offered:
            self.server_hostname = messages.read_server_name(offered[Extension.server_name])
        if not self.context.alpn or Extension.alpn not in offered:
            return {}
        theirs = messages.read_alpn(offered[Extension.alpn])
        self.alpn = next((name for name in self.context.alpn if name.encode() in theirs), None)
        if self.alpn is None:
            raise TLSError(Alert.no_application_protocol, "no application protocol in common")
        return {Extension.alpn: vector(2, vector(1, self.alpn.encode()))}

    def check_answer(self, offered: dict[int, bytes], answered: dict[int, bytes], *more: int) -> None:
        """A client's check of the server's extensions: only what was asked for (RFC 8446, 4.2)."""
        unasked = answered.keys() - offered.keys() - set(more)
        require(not unasked, Alert.unsupported_extension, f"the server answers extensions {unasked}, unasked")
        if Extension.alpn in answered:
            names = messages.read_alpn(answered[Extension.alpn])
            self.alpn = next((name for name in self.context.alpn if names == (name.encode(),)), None)
            require(self.alpn is not None, Alert.illegal_parameter, "the server chose a protocol that was not offered")

    # --- certificates ---

    def take_certificates(self, data: bytes, *, entries: bool) -> None:
        """`data`: a list of certificates, with extensions beside each if `entries` (RFC 8446, 4.4.2)."""
        reader = Reader(data)
        found: list[AnyCertificate] = []
        while reader.more():
            require(len(found) < MAX_CERTIFICATES, Alert.bad_certificate, f"more than {MAX_CERTIFICATES} certificates")
            der = reader.vector(3, 1)
            with refusing(Alert.bad_certificate, "the peer's certificate"):
                found.append(load_der_certificate(der))
            if entries:
                reader.numbered()
        self.peer_certificates = tuple(found)

    def check_certificate(self, place: int, usages: frozenset[str], purpose: str) -> None:
        """Is the peer's certificate to be trusted, for one of these usages at least, and for its role?"""
        leaf, trusted = self.peer_certificates[place], self.context.roots
        try:
            verify_chain(leaf, intermediates=self.peer_certificates, roots=trusted, at=self.context.now(),
                         extended_key_usage=purpose)  # fmt: skip
        except errors.CertificateError as error:
            alert = next((ALERTS[kind] for kind in ALERTS if isinstance(error, kind)), Alert.bad_certificate)
            raise TLSError(alert, str(error)) from None
        allowed = cast(Certificate, leaf).key_usage
        fit = allowed is None or usages & allowed
        require(fit, Alert.unsupported_certificate, f"{leaf.subject} is not for {' or '.join(sorted(usages))}")

    def check_host(self) -> None:
        """Of a client: is the server's first certificate for the host that it wanted?"""
        if self.context.check_hostname and self.server_hostname is not None:
            with refusing(Alert.bad_certificate, "the server"):
                cast(Certificate, self.peer_certificates[0]).verify_hostname(self.server_hostname)

    def peer_key(self, place: int) -> PublicKey:
        """Of a certificate that has passed `check_certificate`, which takes SM2 keys only."""
        return cast(Certificate, self.peer_certificates[place]).public_key

    # --- sessions ---

    def new_session(self, identity: bytes, secret: bytes, seconds: int, age_add: int = 0) -> Session:
        """For at most `seconds`, and not beyond what the peer's certificate is valid for."""
        now, host = self.context.now(), self.server_hostname if self.context.check_hostname else None
        end = min([now + timedelta(seconds=seconds), *(found.not_after for found in self.peer_certificates[:1])])
        lifetime, peer = max(int((end - now).total_seconds()), 0), self.peer_certificates
        return Session(self.VERSION, self.suite, host, peer, now, lifetime, identity, secret, age_add)

    def usable(self, session: Session) -> bool:
        """Is it of this version, and neither too old nor from the future?"""
        age = (self.context.now() - session.issued).total_seconds()
        return session.version == self.VERSION and 0 <= age < session.lifetime

    def remember(self, session: Session) -> None:
        """A server's: keep it, and no more than MAX_SESSIONS."""
        sessions = self.context.sessions
        sessions[session.identity] = session
        for oldest in list(sessions)[:-MAX_SESSIONS]:  # a copy: other threads may change them meanwhile
            sessions.pop(oldest, None)

    def recall(self, identity: bytes) -> Session | None:
        """A server's: the session, if it may be resumed."""
        session = self.context.sessions.get(identity)
        if session is None or not self.usable(session):
            return None
        return session if session.peer_certificates or self.context.verify_client != "required" else None
