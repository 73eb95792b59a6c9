"""The handshake's contents: what is signed, what is agreed on, what is confirmed. No clock, no socket, no state.

    client                                                         server
    HELLO    mode, cid_c, N, zeros up to 1,200          ─────────▶  (keeps nothing)
             cookie                                     ◀─────────  COOKIE
    PROOF    the same, cookie, certificates, R_A,
             signature over H1                          ─────────▶  half open
             N_s, cid_s, certificates, R_B or C,
             signature over H2, finished over H3        ◀─────────  OFFER
    the first packet of the session that opens          ─────────▶  session

Mode `exchange`: SM2 key exchange, GB/T 32918.3-2016, 6.1, client A, server B,
ephemeral points R_A and R_B; ID = role | SM3 of the encryption certificate.
K is 32 bytes. Forward secret. The standard's confirmations S_B and S_A, which
are optional there, are not used: `finished` and the first packet confirm K and
the whole transcript.

Mode `transport`: the server draws K (32 bytes) and sends C, K encrypted by SM2
to the client's encryption certificate (GB/T 32918.4); the client verifies the
server's signature before it decrypts. Not forward secret: who obtains the
client's encryption key later opens what was recorded.

Transcript hashes are SM3 over everything sent so far, from the HELLO on: H1 up
to R_A, H2 up to R_B or C, H3 up to the server's signature. Session keys come
from K and H3 (protection), so they agree only if every byte did.
"""

from __future__ import annotations

import hmac
import secrets
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import datetime
from typing import NamedTuple

from rosbridge_eth import identity as ids
from rosbridge_eth.channel import wire
from rosbridge_eth.channel.protection import SessionSecrets
from rosbridge_eth.channel.wire import Drop, Hello, Malformed, Mode, Reason, Refused
from rosbridge_eth.identity import Identity, PeerIdentity, Role, Trust
from smcrypto import SMCryptoError, sm2, sm3

SHARED_SIZE = 32
POINT_SIZE = 65
MAC_SIZE = 32
ROOM_FOR_SECRET = bytes(256)
"""Zeros behind a PROOF in mode `transport`, whose answer is longer by C: an answer is never longer than what asked."""


@dataclass(frozen=True, slots=True)
class Randomness:
    """Where nonces, ids and ephemeral keys come from; another source is for vectors and simulations only."""

    bytes: Callable[[int], bytes] = secrets.token_bytes
    private_key: Callable[[], sm2.PrivateKey] = field(default=sm2.PrivateKey.generate)


def exchange_id(role: Role, encryption_certificate: bytes) -> bytes:
    """ID of GB/T 32918.3 for one end: its role's name | SM3 of its encryption certificate (DER)."""
    return role.value.encode("ascii") + sm3.digest(encryption_certificate)


def _exchange(mine: Identity, peer: PeerIdentity, ephemeral: sm2.PrivateKey, *, initiator: bool) -> sm2.KeyExchange:
    return sm2.KeyExchange(
        mine.encryption_key, exchange_id(mine.role, mine.encryption_certificate.to_der()),
        peer.encryption_certificate.public_key, exchange_id(peer.role, peer.encryption_certificate.to_der()),
        initiator=initiator, ephemeral_key=ephemeral,
    )  # fmt: skip


def _transcript(hello: Hello, cookie: bytes) -> sm3.SM3:
    version_and_mode = bytes((wire.VERSION, hello.mode))
    return sm3.SM3(b"rosbridge-eth/3 handshake\0" + version_and_mode + hello.client_cid + hello.nonce + cookie)


class Agreed(NamedTuple):
    """What an end has of a handshake: who the peer is, the session's secrets, and at a client the server's cid, at a
    server the body of its OFFER."""

    peer: PeerIdentity
    secrets: SessionSecrets
    told: bytes


class ClientHandshake:
    """One attempt of a client. `hello`, then `proof(cookie)`, then `accept(offer)` until one is good."""

    def __init__(self, mode: Mode, identity: Identity, cid: bytes, randomness: Randomness) -> None:
        self.hello = Hello(mode, cid, randomness.bytes(wire.NONCE_SIZE))
        self._identity = identity
        self._ephemeral = randomness.private_key() if mode is Mode.EXCHANGE else None
        self._transcript = sm3.SM3()

    def proof(self, cookie: bytes) -> bytes:
        """The body of the PROOF."""
        identity = self._identity
        point = self._ephemeral.public_key.to_bytes() if self._ephemeral else b""
        self._transcript = transcript = _transcript(self.hello, cookie)
        unsigned = wire.fields([identity.signing_certificate.to_der(), identity.encryption_certificate.to_der(), point])
        transcript.update(unsigned)
        signature = wire.fields([ids.sign(identity.signing_key, "handshake", b"client" + transcript.digest())])
        transcript.update(signature)
        return unsigned + signature + (b"" if self._ephemeral else ROOM_FOR_SECRET)

    def accept(self, body: bytes, trust: Trust, *, server_name: str | None, at: datetime) -> Agreed:
        """Verify an OFFER's body; Refused leaves this attempt as it was, ready for another."""
        lengths = (
            wire.NONCE_SIZE, wire.CID_SIZE, None, None, POINT_SIZE if self._ephemeral else None, None, MAC_SIZE,
        )  # fmt: skip
        (_, server_cid, signing, encryption, material, signature, mac), offsets = wire.parse_fields(body, lengths)
        try:
            peer = trust.check(signing, encryption, role=Role.SERVER, name=server_name, at=at)
        except ids.UntrustedCertificate as error:
            hint = Reason.EXPIRED if isinstance(error, ids.ExpiredCertificate) else None
            raise Refused(Drop.CERTIFICATE, str(error), hint) from error
        transcript = self._transcript.copy()
        transcript.update(body[: offsets[5]])
        try:
            ids.verify(peer.signing_certificate.public_key, "handshake", b"server" + transcript.digest(), signature)
            if self._ephemeral is not None:
                exchange = _exchange(self._identity, peer, self._ephemeral, initiator=True)
                shared, _ = exchange.agree(material, SHARED_SIZE, unconfirmed=True)
            else:
                shared = self._identity.encryption_key.decrypt(material)
        except SMCryptoError as error:
            raise Refused(Drop.SIGNATURE, "the offer does not hold") from error
        if len(shared) != SHARED_SIZE:
            raise Malformed("the secret has another length")
        transcript.update(body[offsets[5] : offsets[6]])
        keys = SessionSecrets(shared, transcript.digest(), self.hello.mode)
        if not hmac.compare_digest(mac, keys.confirmation):
            raise Refused(Drop.SIGNATURE, "the offer does not hold")
        return Agreed(peer, keys, server_cid)


def answer_proof(
    hello: Hello, cookie: bytes, body: bytes, *, identity: Identity, trust: Trust, server_cid: bytes,
    randomness: Randomness, at: datetime,
) -> Agreed:  # fmt: skip
    """A server's side, from a whole PROOF. Refused unless its certificates and signature hold; the cookie was
    checked before. The session stands when a packet of the client's opens."""
    exchange = hello.mode is Mode.EXCHANGE
    lengths = (None, None, POINT_SIZE if exchange else 0, None)
    (signing, encryption, point, signature), offsets = wire.parse_fields(body, lengths)
    try:
        peer = trust.check(signing, encryption, role=Role.ROBOT, at=at)
    except ids.UntrustedCertificate as error:
        hints = {ids.ExpiredCertificate: Reason.EXPIRED, ids.NotAllowed: Reason.NOT_ALLOWED}
        raise Refused(Drop.CERTIFICATE, str(error), hints.get(type(error), Reason.CERTIFICATE)) from error
    transcript = _transcript(hello, cookie)
    transcript.update(body[: offsets[3]])
    try:
        ids.verify(peer.signing_certificate.public_key, "handshake", b"client" + transcript.digest(), signature)
        if exchange:
            run = _exchange(identity, peer, randomness.private_key(), initiator=False)
            shared, _ = run.agree(point, SHARED_SIZE, unconfirmed=True)
            material = run.ephemeral
        else:
            shared = randomness.bytes(SHARED_SIZE)
            material = peer.encryption_certificate.public_key.encrypt(shared)
    except SMCryptoError as error:
        raise Refused(Drop.SIGNATURE, "the proof does not hold") from error
    transcript.update(body[offsets[3] : offsets[4]])
    mine = (identity.signing_certificate.to_der(), identity.encryption_certificate.to_der())
    unsigned = wire.fields([randomness.bytes(wire.NONCE_SIZE), server_cid, *mine, material])
    transcript.update(unsigned)
    signed = wire.fields([ids.sign(identity.signing_key, "handshake", b"server" + transcript.digest())])
    transcript.update(signed)
    keys = SessionSecrets(shared, transcript.digest(), hello.mode)
    return Agreed(peer, keys, unsigned + signed + wire.fields([keys.confirmation]))
