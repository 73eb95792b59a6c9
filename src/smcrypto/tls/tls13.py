"""The handshake of TLS 1.3 with SM algorithms: RFC 8446, 2 and 4; RFC 8998.

SM2 for the key agreement (curveSM2) and signatures (sm2sig_sm3, the signer's identifier being IDENTIFIER), SM4-GCM or
SM4-CCM, SM3. Pre-shared keys come from earlier connections only, always with a fresh key agreement (psk_dhe_ke).
"""

from __future__ import annotations

from hmac import compare_digest
from typing import Final

from smcrypto import sm3
from smcrypto.sm2 import SM2P256V1, PrivateKey, PublicKey
from smcrypto.sm2.points import secret_sum, to_affine_all
from smcrypto.tls import messages
from smcrypto.tls.alerts import Alert, refusing, require
from smcrypto.tls.context import SUITES
from smcrypto.tls.events import Session, SessionIssued
from smcrypto.tls.handshake import CURVE_SM2, DAY, SIGNING, Handshake, Steps
from smcrypto.tls.messages import Extension, Hello, Kind, Message, Reader, pack, vector
from smcrypto.tls.record import AEAD13, HANDSHAKE, TLS12_VERSION
from smcrypto.tls.schedule import EMPTY_HASH, derive_secret, expand_label, extract, finished_mac, next_stage, updated

__all__ = ["IDENTIFIER", "TLS13", "TLS13_VERSION"]

TLS13_VERSION: Final = 0x0304
IDENTIFIER: Final = b"TLSv1.3+GM+Cipher+Suite"  # RFC 8998, 3.2.1
SM2SIG_SM3: Final = 0x0708
PSK_DHE_KE: Final = 1
RETRY: Final = bytes.fromhex("CF21AD74E59A6111BE1D8C021E65B891C2A211167ABB8C5E079E09E2C8A8339C")  # 4.1.3
TICKET_LIFETIME: Final = 7 * DAY  # the longest that is allowed: 4.6.1
NO_KEY: Final = bytes(32)


class TLS13(Handshake):
    """One side's handshake, and what follows it: tickets and key updates."""

    VERSION = "TLSv1.3"
    _stage: bytes  # Handshake Secret, then Master Secret

    # --- the client: 2, figure 1 ---

    def client(self) -> Steps:
        key = PrivateKey.generate()
        offered = tuple(SUITES[name][0] for name in self.suites)
        hello = Hello(TLS12_VERSION, self.context.random(32), b"", offered, self._offer(key))
        self._send_hello(hello)
        message = yield from self.receive(Kind.server_hello)
        answer = self._read_answer(hello, message)
        if answer.random == RETRY:
            hello, first = self._retried(hello, answer, message), answer
            self._send_hello(hello)
            message = yield from self.receive(Kind.server_hello)
            answer = self._read_answer(hello, message)
            require(answer.random != RETRY, Alert.unexpected_message, "the server asks for another hello twice")
            require(answer.suites == first.suites, Alert.illegal_parameter, "the server changes its mind on the suite")
        self._early = extract(NO_KEY, NO_KEY)
        chosen = answer.extensions.get(Extension.pre_shared_key)
        if chosen is not None and self.session is not None:
            require(chosen == pack(0), Alert.illegal_parameter, "the server resumes a session that was not offered")
            self._take_session(self.session)
        with Reader(_needed(answer.extensions, Extension.key_share)) as reader:
            group, share = reader.integer(2), reader.vector(2, 1)
        require(group == CURVE_SM2, Alert.illegal_parameter, f"the server agrees on a key in group {group}")
        self._handshake_keys(key, share, "s", "c")

        message = yield from self.receive(Kind.encrypted_extensions)
        with Reader(message.body) as reader:
            self.check_answer(hello.extensions, reader.numbered())
        asked = False
        if not self.resumed:
            message = yield from self.receive(Kind.certificate_request, Kind.certificate)
            asked = message.kind == Kind.certificate_request
            if asked:
                _read_request(message)
                message = yield from self.receive(Kind.certificate)
            self._read_certificates(message)
            require(self.peer_certificates, Alert.decode_error, "the server has no certificate")
            self.check_certificate(0, SIGNING, "serverAuth")
            self.check_host()
            yield from self._verify_signature("server")
        message = yield from self.receive(Kind.finished)
        self.check_finished(message, finished_mac(self._theirs, self.earlier.digest()))
        self._stage = next_stage(self._stage, NO_KEY)
        own = self._traffic("c ap traffic")
        self._read_with(self._traffic("s ap traffic"))
        if asked:
            self._send_certificates("client")
        self.send(Kind.finished, finished_mac(self._own, self.transcript.digest()))
        self._write_with(own)
        self._resumption = self._traffic("res master")
        self.complete()
        yield from self._afterwards(Kind.new_session_ticket, Kind.key_update)

    def _offer(self, key: PrivateKey) -> dict[int, bytes]:
        extensions = self.hello_extensions() | {
            Extension.supported_groups: messages.pack_numbers([CURVE_SM2]),
            Extension.signature_algorithms: messages.pack_numbers([SM2SIG_SM3]),
            Extension.supported_versions: messages.pack_numbers([TLS13_VERSION], 1),
            Extension.psk_key_exchange_modes: vector(1, bytes([PSK_DHE_KE])),
            Extension.key_share: vector(2, _pack_share(key)),
        }
        if self.session is not None and self.usable(self.session):
            age = self.context.now() - self.session.issued
            hidden = int(age.total_seconds() * 1000) + self.session.age_add & 0xFFFFFFFF
            identity = vector(2, vector(2, self.session.identity), pack(hidden, 4))
            # 4.2.11: the last extension. The binder follows in `_send_hello`.
            extensions[Extension.pre_shared_key] = identity + vector(2, vector(1, bytes(32)))
        return extensions

    def _send_hello(self, hello: Hello) -> None:
        body = hello.pack(Kind.client_hello)
        if self.session is not None and Extension.pre_shared_key in hello.extensions:
            truncated = messages.pack_message(Kind.client_hello, body)[: -2 - 1 - 32]
            body = body[:-32] + _binder(self.session, self.transcript, truncated)
        self.send(Kind.client_hello, body)

    def _read_answer(self, hello: Hello, message: Message) -> Hello:
        """ServerHello or HelloRetryRequest, as far as both have the same rules: 4.1.3, 4.1.4."""
        answer = Hello.read(message)
        self.check_answer(hello.extensions, answer.extensions, *([Extension.cookie] if answer.random == RETRY else []))
        chosen = answer.extensions.get(Extension.supported_versions)
        require(chosen == pack(TLS13_VERSION), Alert.protocol_version, "the server does not choose TLS 1.3")
        same = (answer.version, answer.session_id) == (TLS12_VERSION, b"")
        require(same, Alert.illegal_parameter, "the server does not repeat the session id or the version")
        self.choose_suite(self.suites, answer.suites, Alert.illegal_parameter)
        return answer

    def _retried(self, hello: Hello, answer: Hello, message: Message) -> Hello:
        """The hello again, with the server's cookie. There is one group, so nothing else can change: 4.1.4."""
        changed = Extension.cookie in answer.extensions and Extension.key_share not in answer.extensions
        require(changed, Alert.illegal_parameter, "the server asks for a hello that would be no other")
        self.transcript = _restarted(self.earlier)
        self.transcript.update(message.raw)
        cookie = {Extension.cookie: answer.extensions[Extension.cookie]}
        return hello._replace(extensions=cookie | hello.extensions)

    # --- the server ---

    def server(self, message: Message) -> Steps:
        self.took(message)
        hello = Hello.read(message)
        self.choose_suite(self.suites, hello.suites)
        groups = messages.read_numbers(_needed(hello.extensions, Extension.supported_groups))
        require(CURVE_SM2 in groups, Alert.handshake_failure, "the client does not know curveSM2")
        version = {int(Extension.supported_versions): pack(TLS13_VERSION)}
        share = _find_share(hello)
        if not share:
            self.transcript, first = _restarted(self.transcript), hello
            asked = version | {Extension.key_share: pack(CURVE_SM2)}
            self.send_answer(TLS12_VERSION, RETRY, hello.session_id, asked)
            message = yield from self.receive(Kind.client_hello)
            hello = Hello.read(message)
            require(hello[:4] == first[:4], Alert.illegal_parameter, "the client's second hello is not its first one")
            share = _find_share(hello)
            require(share, Alert.illegal_parameter, "the client does not send the share that it was asked for")
        answered = self.answer(hello.extensions)
        self._early = extract(NO_KEY, NO_KEY)
        resumed = self._choose_session(hello, message)
        if not self.resumed:
            algorithms = messages.read_numbers(_needed(hello.extensions, Extension.signature_algorithms))
            require(SM2SIG_SM3 in algorithms, Alert.handshake_failure, "the client does not know sm2sig_sm3")
        key = PrivateKey.generate()
        agreed = version | {Extension.key_share: _pack_share(key)} | resumed
        self.send_answer(TLS12_VERSION, self.context.random(32), hello.session_id, agreed)
        self._handshake_keys(key, share, "c", "s")

        self.send(Kind.encrypted_extensions, messages.pack_extensions(answered))
        asks = not self.resumed and self.context.verify_client != "none"
        if asks:
            self.send(Kind.certificate_request, vector(1), messages.pack_extensions(REQUEST))
        if not self.resumed:
            self._send_certificates("server")
        self.send(Kind.finished, finished_mac(self._own, self.transcript.digest()))
        self._stage = next_stage(self._stage, NO_KEY)
        theirs = self._traffic("c ap traffic")
        self._write_with(self._traffic("s ap traffic"))
        if asks:
            message = yield from self.receive(Kind.certificate)
            self._read_certificates(message)
            enough = self.peer_certificates or self.context.verify_client == "optional"
            require(enough, Alert.certificate_required, "the client has no certificate")
            if self.peer_certificates:
                self.check_certificate(0, SIGNING, "clientAuth")
                yield from self._verify_signature("client")
        message = yield from self.receive(Kind.finished)
        self.check_finished(message, finished_mac(self._theirs, self.earlier.digest()))
        self._read_with(theirs)
        self._resumption = self._traffic("res master")
        self.complete()
        if PSK_DHE_KE in hello.extensions.get(Extension.psk_key_exchange_modes, b"")[1:]:  # 4.2.9: else of no use
            self._issue()
        yield from self._afterwards(Kind.key_update)

    def _choose_session(self, hello: Hello, message: Message) -> dict[int, bytes]:
        """The answer that resumes the first session offered that is known here, its binder being right: 4.2.11."""
        if Extension.pre_shared_key not in hello.extensions:
            return {}
        *_, (last, offered) = hello.extensions.items()
        require(last == Extension.pre_shared_key, Alert.illegal_parameter, "pre_shared_key is not the last extension")
        with Reader(_needed(hello.extensions, Extension.psk_key_exchange_modes)) as reader:
            modes = reader.vector(1, 1)
        with Reader(offered) as reader:
            identities, binders = Reader(reader.vector(2, 7)), reader.vector(2, 33)
        truncated = message.raw[: -2 - len(binders)]
        place, macs = 0, Reader(binders)
        while identities.more():
            identity, _, mac = identities.vector(2, 1), identities.take(4), macs.vector(1, 32)
            session = self.recall(identity)
            if session is not None and PSK_DHE_KE in modes:
                expected = _binder(session, self.earlier, truncated)
                require(compare_digest(mac, expected), Alert.decrypt_error, "the binder of a session does not hold")
                self._take_session(session)
                return {Extension.pre_shared_key: pack(place)}
            place += 1
        return {}

    # --- keys: 7.1 ---

    def _take_session(self, session: Session) -> None:
        self.resumed, self.peer_certificates = True, session.peer_certificates
        self._early = extract(NO_KEY, session.secret)

    def _handshake_keys(self, key: PrivateKey, share: bytes, theirs: str, own: str) -> None:
        """Of the rest of the handshake; the sides are "c" and "s".

        RFC 8998, 3.3.1: the shared secret of the key agreement is the x coordinate, 32 bytes.
        """
        require(len(share) == 65, Alert.illegal_parameter, f"a share of {len(share)} bytes, not 65")
        with refusing(Alert.illegal_parameter, "the peer's share"):
            peer = PublicKey.from_bytes(share)
        [(x, _)] = to_affine_all([secret_sum(SM2P256V1, (key.to_int(), peer.point))], SM2P256V1)
        self._stage = next_stage(self._early, pack(x, 32))
        self._read_with(self._traffic(f"{theirs} hs traffic"))
        self._write_with(self._traffic(f"{own} hs traffic"))

    def _traffic(self, label: str) -> bytes:
        return derive_secret(self._stage, label.encode(), self.transcript.digest())

    def _read_with(self, secret: bytes) -> None:
        self._theirs = secret
        self.records.read_with(AEAD13(self.suite, secret))

    def _write_with(self, secret: bytes) -> None:
        self._own = secret
        self.records.writer = AEAD13(self.suite, secret)

    # --- certificates: 4.4 ---

    def _send_certificates(self, side: str) -> None:
        """Certificate and CertificateVerify; of a client without a certificate, the former and empty."""
        entries = (vector(3, found.to_der()) + vector(2) for found in self.context.certificates)
        self.send(Kind.certificate, vector(1), vector(3, *entries))
        if self.context.key is not None:
            signature = self.context.key.sign(_signed(side, self.transcript), uid=IDENTIFIER)
            self.send(Kind.certificate_verify, pack(SM2SIG_SM3), vector(2, signature))

    def _read_certificates(self, message: Message) -> None:
        with Reader(message.body) as reader:
            context, certificates = reader.vector(1), reader.vector(3)
        require(not context, Alert.illegal_parameter, "certificates with a context that was not asked for")
        self.take_certificates(certificates, entries=True)

    def _verify_signature(self, side: str) -> Steps:
        message = yield from self.receive(Kind.certificate_verify)
        with Reader(message.body) as reader:
            algorithm, signature = reader.integer(2), reader.vector(2)
        require(algorithm == SM2SIG_SM3, Alert.illegal_parameter, f"a signature with {algorithm:#06x}, not sm2sig_sm3")
        with refusing(Alert.decrypt_error, "the peer's signature"):
            self.peer_key(0).verify(signature, _signed(side, self.earlier), uid=IDENTIFIER)

    # --- after the handshake: 4.6 ---

    def _afterwards(self, *kinds: Kind) -> Steps:
        while True:
            message = yield kinds
            if message.kind == Kind.new_session_ticket:
                self._read_ticket(message)
                continue
            require(message.body in (b"\0", b"\1"), Alert.illegal_parameter, "a KeyUpdate is 0 or 1")
            self._read_with(updated(self._theirs))
            if message.body == b"\1":
                self.update_keys()

    def update_keys(self) -> None:
        """Send KeyUpdate and go on with new keys; the peer keeps its own: 4.6.3."""
        self.records.write(HANDSHAKE, messages.pack_message(Kind.key_update, b"\0"))
        self._write_with(updated(self._own))

    def _issue(self) -> None:
        """A server's ticket is the name of a session that it remembers: 4.6.1."""
        nonce, ticket, age_add = self.context.random(8), self.context.random(32), self.context.random(4)
        session = self.new_session(ticket, self._psk(nonce), DAY)
        self.remember(session)
        body = pack(session.lifetime, 4) + age_add + vector(1, nonce) + vector(2, ticket) + vector(2)
        self.records.write(HANDSHAKE, messages.pack_message(Kind.new_session_ticket, body))

    def _read_ticket(self, message: Message) -> None:
        with Reader(message.body) as reader:
            lifetime, age_add, nonce = reader.integer(4), reader.integer(4), reader.vector(1)
            ticket, _ = reader.vector(2, 1), reader.numbered()
        require(lifetime <= TICKET_LIFETIME, Alert.illegal_parameter, f"a ticket for {lifetime} seconds, over 7 days")
        self.emit(SessionIssued(self.new_session(ticket, self._psk(nonce), lifetime, age_add)))

    def _psk(self, nonce: bytes) -> bytes:
        return expand_label(self._resumption, b"resumption", nonce, 32)


REQUEST: Final = {int(Extension.signature_algorithms): messages.pack_numbers([SM2SIG_SM3])}  # 4.3.2


def _restarted(transcript: sm3.SM3) -> sm3.SM3:
    """After a HelloRetryRequest the hash of the first hello stands for it: 4.4.1."""
    return sm3.SM3(messages.pack_message(Kind.message_hash, transcript.digest()))


def _binder(session: Session, transcript: sm3.SM3, truncated: bytes) -> bytes:
    """The MAC over the transcript and the hello as far as its binders, under the session's key: 4.2.11.2."""
    transcript = transcript.copy()
    transcript.update(truncated)
    early = extract(NO_KEY, session.secret)
    return finished_mac(derive_secret(early, b"res binder", EMPTY_HASH), transcript.digest())


def _signed(side: str, transcript: sm3.SM3) -> bytes:
    """What CertificateVerify signs: 4.4.3."""
    return b" " * 64 + f"TLS 1.3, {side} CertificateVerify".encode() + b"\0" + transcript.digest()


def _needed(extensions: dict[int, bytes], wanted: Extension) -> bytes:
    require(wanted in extensions, Alert.missing_extension, f"the extension {wanted.name} is missing")
    return extensions[wanted]


def _pack_share(key: PrivateKey) -> bytes:
    return pack(CURVE_SM2) + vector(2, key.public_key.to_bytes())


def _find_share(hello: Hello) -> bytes:
    """The client's share in curveSM2, b"" if it sent none: 4.2.8."""
    with Reader(_needed(hello.extensions, Extension.key_share)) as reader:
        return reader.numbered(1).get(CURVE_SM2, b"")


def _read_request(message: Message) -> None:
    """CertificateRequest, 4.3.2: only one whose signatures can be made here."""
    with Reader(message.body) as reader:
        context, extensions = reader.vector(1), reader.numbered()
    require(not context, Alert.illegal_parameter, "a request for certificates with a context, in the handshake")
    algorithms = messages.read_numbers(_needed(extensions, Extension.signature_algorithms))
    require(SM2SIG_SM3 in algorithms, Alert.handshake_failure, "the server does not know sm2sig_sm3")
