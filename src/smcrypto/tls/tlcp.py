"""The handshake of TLCP: GB/T 38636-2020, 6.4. Each side with two certificates: one signs, the other encrypts.

    ECC      the client encrypts the pre-master secret for the server's encryption certificate
    ECDHE    SM2 key exchange (GB/T 32918.3) with the keys of both encryption certificates, the server being its
             initiator; so the client must have certificates too

Signatures and the exchange use the identifier of GM/T 0009, DEFAULT_UID.
"""

from __future__ import annotations

from typing import Final, cast

from smcrypto.sm2 import DEFAULT_UID, KeyExchange, PrivateKey
from smcrypto.tls.alerts import Alert, refusing, require
from smcrypto.tls.context import SUITES, expect
from smcrypto.tls.events import Session, SessionIssued
from smcrypto.tls.handshake import CURVE_SM2, DAY, ENCRYPTING, SIGNING, Handshake, Steps
from smcrypto.tls.messages import Hello, Kind, Message, Reader, pack, vector
from smcrypto.tls.record import CBC, CHANGE_CIPHER_SPEC, GCM, TLCP_VERSION, Protection
from smcrypto.tls.schedule import prf
from smcrypto.x509 import AnyCertificate, Certificate

__all__ = ["TLCP"]

ECDSA_SIGN: Final = 64  # ClientCertificateType, 6.4.5.5: what SM2 certificates go by
PRE_MASTER: Final = 48  # bytes
VERSION_BYTES: Final = pack(TLCP_VERSION)
EPHEMERAL: Final = ("ECDHE_SM4_GCM_SM3", "ECDHE_SM4_CBC_SM3")
CURVE: Final = b"\x03" + pack(CURVE_SM2)  # ECParameters of RFC 4492, 5.4: named_curve


class TLCP(Handshake):
    """One side's handshake."""

    VERSION = "TLCPv1.1"

    # --- the client: 6.4.1, figure 4; resumed: figure 5 ---

    def client(self) -> Steps:
        session = self.session if self.session is not None and self.usable(self.session) else None
        names = self.suites
        if self.context.encryption_certificate is None:
            names = _static(names)
        expect(names, "a client needs an encryption certificate for ECDHE of TLCP")
        identity, numbers = b"" if session is None else session.identity, tuple(SUITES[name][0] for name in names)
        hello = Hello(TLCP_VERSION, self.context.random(32), identity, numbers, self.hello_extensions())
        self.send(Kind.client_hello, hello.pack(Kind.client_hello))
        message = yield from self.receive(Kind.server_hello)
        answer = Hello.read(message)
        require(answer.version == TLCP_VERSION, Alert.protocol_version, f"the server has version {answer.version:#06x}")
        self.choose_suite(names, answer.suites, Alert.illegal_parameter)
        self.check_answer(hello.extensions, answer.extensions)
        self._randoms = hello.random, answer.random
        if session is not None and answer.session_id == session.identity:
            require(self.suite == session.suite, Alert.illegal_parameter, "the session is resumed with another suite")
            self._resume(session)
            yield from self._take_finished("server")
            self._send_finished("client")
            self.complete()
            return

        self._read_certificates((yield from self.receive(Kind.certificate)))
        self._check_certificates("serverAuth")
        self.check_host()
        share = self._read_exchange((yield from self.receive(Kind.server_key_exchange)))
        message = yield from self.receive(Kind.certificate_request, Kind.server_hello_done)
        asked = message.kind == Kind.certificate_request
        if asked:
            _read_request(message)
            message = yield from self.receive(Kind.server_hello_done)
            self._send_certificates()
        require(not message.body, Alert.decode_error, "a ServerHelloDone is empty")
        certified = asked and self.context.key is not None
        require(certified or self.suite not in EPHEMERAL, Alert.handshake_failure, "ECDHE without certificate_request")
        self._answer_exchange(share)
        if certified:
            signature = cast(PrivateKey, self.context.key).sign(self.transcript.digest())
            self.send(Kind.certificate_verify, vector(2, signature))
        self._send_finished("client")
        yield from self._take_finished("server")
        self.complete()
        if answer.session_id:
            self.emit(SessionIssued(self.new_session(answer.session_id, self._master, DAY)))

    # --- the server ---

    def server(self, message: Message) -> Steps:
        self.took(message)
        hello = Hello.read(message)
        answered = self.answer(hello.extensions)
        session = self.recall(hello.session_id)
        # ECDHE needs the client's certificates: the first choice only of who requires them, none of who trusts nobody.
        suites = self.suites
        if self.context.verify_client != "required":
            suites = _static(suites) + (tuple(one for one in suites if one in EPHEMERAL) if self.context.roots else ())
        self.choose_suite(suites, hello.suites)
        self._randoms = hello.random, self.context.random(32)
        if session is not None and session.suite == self.suite:
            self.send_answer(TLCP_VERSION, self._randoms[1], session.identity, answered)
            self._resume(session)
            self._send_finished("server")
            yield from self._take_finished("client")
            self.complete()
            return

        identity = self.context.random(32)
        self.send_answer(TLCP_VERSION, self._randoms[1], identity, answered)
        self._send_certificates()
        self._send_exchange()
        requires = self.context.verify_client == "required" or self.suite in EPHEMERAL
        asks = requires or self.context.verify_client == "optional"
        if asks:
            # GmSSL's clients send a certificate only if its CA is named here. What does not fit is left to the client.
            names = b"".join(vector(2, root.subject.to_der()) for root in self.context.roots)
            fitting = names if len(names) < 1 << 16 else b""
            self.send(Kind.certificate_request, vector(1, bytes([ECDSA_SIGN])), vector(2, fitting))
        self.send(Kind.server_hello_done)
        if asks:
            self._read_certificates((yield from self.receive(Kind.certificate)))
            require(self.peer_certificates or not requires, Alert.handshake_failure, "the client has no certificate")
            if self.peer_certificates:
                # With ECC the second serves nothing; gmsm's and GmSSL's clients leave it out, against 6.4.5.3.
                self._check_certificates("clientAuth", both=self.suite in EPHEMERAL)
        self._take_exchange((yield from self.receive(Kind.client_key_exchange)))
        if self.peer_certificates:
            message = yield from self.receive(Kind.certificate_verify)
            with Reader(message.body) as reader:
                signature = reader.vector(2)
            self._verify(signature, self.earlier.digest())
        yield from self._take_finished("client")
        self._send_finished("server")
        self.remember(self.new_session(identity, self._master, DAY))
        self.complete()

    # --- certificates: 6.4.5.3; the signing one, the encryption one, then those of CAs ---

    def _send_certificates(self) -> None:
        own: list[AnyCertificate] = [*self.context.certificates]
        if self.context.encryption_certificate is not None:
            own.insert(1, self.context.encryption_certificate)
        self.send(Kind.certificate, vector(3, *(vector(3, one.to_der()) for one in own)))

    def _read_certificates(self, message: Message) -> None:
        with Reader(message.body) as reader:
            certificates = reader.vector(3)
        self.take_certificates(certificates, entries=False)

    def _check_certificates(self, purpose: str, *, both: bool = True) -> None:
        require(len(self.peer_certificates) > both, Alert.bad_certificate, "one certificate; TLCP needs two")
        self.check_certificate(0, SIGNING, purpose)
        if both:
            self.check_certificate(1, ENCRYPTING, purpose)

    def _verify(self, signature: bytes, signed: bytes) -> None:
        with refusing(Alert.decrypt_error, "the peer's signature"):
            self.peer_key(0).verify(signature, signed)

    # --- key exchange: 6.4.5.4 and 6.4.5.8 ---

    def _send_exchange(self) -> None:
        """ServerKeyExchange: the ephemeral key, or nothing; and the signature that joins it, or the encryption
        certificate, with the randoms."""
        shown, signed = b"", b""
        if self.suite in EPHEMERAL:
            self._ephemeral = PrivateKey.generate()
            shown = signed = CURVE + vector(1, self._ephemeral.public_key.to_bytes())
        else:
            signed = vector(3, cast(Certificate, self.context.encryption_certificate).to_der())
        signature = cast(PrivateKey, self.context.key).sign(b"".join(self._randoms) + signed)
        self.send(Kind.server_key_exchange, shown, vector(2, signature))

    def _read_exchange(self, message: Message) -> bytes:
        """The server's ephemeral key, of ECC b"", once the signature is verified."""
        share = b""
        with Reader(message.body) as reader:
            if self.suite in EPHEMERAL:
                # 6.4.5.4: with SM2 the curve's parameters are not looked at.
                parameters, share = reader.take(3), reader.vector(1)
                signed = parameters + vector(1, share)
            else:
                signed = vector(3, self.peer_certificates[1].to_der())
            signature = reader.vector(2)
        self._verify(signature, b"".join(self._randoms) + signed)
        return share

    def _answer_exchange(self, share: bytes) -> None:
        """ClientKeyExchange. Written as Tongsuo does, ECDHE's without a length of two bytes before it."""
        if self.suite in EPHEMERAL:
            self._ephemeral = PrivateKey.generate()
            self._agree(share, initiator=False)
            self.send(Kind.client_key_exchange, CURVE, vector(1, self._ephemeral.public_key.to_bytes()))
        else:
            secret = VERSION_BYTES + self.context.random(PRE_MASTER - 2)
            self._derive(secret)
            self.send(Kind.client_key_exchange, vector(2, self.peer_key(1).encrypt(secret)))

    def _take_exchange(self, message: Message) -> None:
        """ClientKeyExchange. Of ECDHE, GmSSL and gotlcp write a length of two bytes before it, Tongsuo does not."""
        with Reader(message.body) as reader:
            if self.suite in EPHEMERAL:
                reader.take(5 if message.body[:1] == b"\0" else 3)
            given = reader.vector(1 if self.suite in EPHEMERAL else 2)
        if self.suite in EPHEMERAL:
            self._agree(given, initiator=True)
            return
        with refusing(Alert.decrypt_error, "the client's pre-master secret"):
            secret = cast(PrivateKey, self.context.encryption_key).decrypt(given)
        fit = len(secret) == PRE_MASTER and secret.startswith(VERSION_BYTES)
        require(fit, Alert.decrypt_error, "the client's pre-master secret is not one of TLCP 1.1")
        self._derive(secret)

    def _agree(self, share: bytes, *, initiator: bool) -> None:
        own, peer, fresh = cast(PrivateKey, self.context.encryption_key), self.peer_key(1), self._ephemeral
        exchange = KeyExchange(own, DEFAULT_UID, peer, DEFAULT_UID, initiator=initiator, ephemeral_key=fresh)
        with refusing(Alert.illegal_parameter, "the peer's ephemeral key"):
            secret, _ = exchange.agree(share, PRE_MASTER, unconfirmed=True)
        self._derive(secret)

    # --- keys and the end: 6.5, 6.4.5.10 ---

    def _derive(self, secret: bytes) -> None:
        """The master secret."""
        self._master = prf(secret, b"master secret", b"".join(self._randoms), 48)

    def _resume(self, session: Session) -> None:
        self.resumed, self.peer_certificates, self._master = True, session.peer_certificates, session.secret

    def _protection(self, side: str) -> Protection:
        """Of what the client, or the server, sends: its part of the key block, MAC keys, keys, IVs in pairs."""
        sizes = (16, 4) if "GCM" in self.suite else (32, 16)
        block = Reader(prf(self._master, b"key expansion", b"".join(reversed(self._randoms)), 2 * sum(sizes)))
        first, second = ([block.take(size) for _ in ("client", "server")][side == "server"] for size in sizes)
        return GCM(first, second) if "GCM" in self.suite else CBC(second, first, self.context.random)

    def _send_finished(self, side: str) -> None:
        self.records.write(CHANGE_CIPHER_SPEC, b"\x01")
        self.records.writer = self._protection(side)
        self.send(Kind.finished, self._verify_data(side, self.transcript.digest()))

    def _take_finished(self, side: str) -> Steps:
        yield (Kind.change_cipher_spec,)
        self.records.read_with(self._protection(side))
        message = yield from self.receive(Kind.finished)
        self.check_finished(message, self._verify_data(side, self.earlier.digest()))

    def _verify_data(self, side: str, transcript_hash: bytes) -> bytes:
        return prf(self._master, f"{side} finished".encode(), transcript_hash, 12)


def _static(names: tuple[str, ...]) -> tuple[str, ...]:
    return tuple(name for name in names if name not in EPHEMERAL)


def _read_request(message: Message) -> None:
    """CertificateRequest: what it says about kinds and CAs chooses among certificates; here there is one pair."""
    with Reader(message.body) as reader:
        reader.vector(1, 1)
        reader.vector(2)
