"""SM2 key exchange with confirmation, GB/T 32918.3-2016.

Names are the standard's: A the initiator, B the responder; d, P long-term, r, R
ephemeral keys; x~ = 2^w + (x mod 2^w) with w = ceil(ceil(log2 n)/2) - 1; U = V the
shared point; K the key; S_B = S1 and S_A = S2 the confirmations. A1-A10 and B1-B10 mark
the steps (6.1).

A run that was not confirmed has agreed with whoever holds the peer's private key, or with
nobody; confirmation tells which, and hands out the key. The exchange authenticates keys: that a key is the peer's
is for the caller to know, by a certificate.
"""

from __future__ import annotations

from hmac import compare_digest
from typing import Literal, NoReturn, overload

from smcrypto import sm3
from smcrypto.errors import ConfirmationError, InvalidKey, InvalidLength, OutOfOrder
from smcrypto.inputs import BytesLike, KeyHolder, as_bytes, require_int, require_type
from smcrypto.kdf import sm2_kdf
from smcrypto.sm2.curve import Curve, Point, decode_point, encode_point
from smcrypto.sm2.keys import PrivateKey, PublicKey
from smcrypto.sm2.known_keys import known_keys
from smcrypto.sm2.points import secret_sum, to_affine
from smcrypto.sm2.signature import z_value

__all__ = ["KeyExchange"]


def reduced_x(R: Point, curve: Curve) -> int:
    """x~ of R, steps A4 and B3."""
    w = -(-(curve.n - 1).bit_length() // 2) - 1
    return 1 << w | R[0] & (1 << w) - 1


def shared_point(curve: Curve, d: int, r: int, R: Point, peer_P: Point, peer_R: Point) -> Point | None:
    """[h t](P' + [x~'] R') with t = d + x~ r, h = 1: U for A (steps A5-A7), V for B (B4-B6); None if infinite.

    Taken as [t]P' + [t x~']R': one run of doublings serves both, or none is needed
    for P' where its comb is known.
    """
    t = (d + reduced_x(R, curve) * r) % curve.n
    point = secret_sum(
        curve, (t, known_keys.comb(curve, peer_P) or peer_P), (t * reduced_x(peer_R, curve) % curve.n, peer_R)
    )
    return to_affine(point, curve)


class UnconfirmedKey(KeyHolder):
    """In the place of a key that the peer has not confirmed: its length, and whether it equals a key, are known.

    It is no bytes-like object: no function takes it for a key. `KeyExchange.confirm` returns the bytes.
    """

    __slots__ = ("_key",)

    def __init__(self, key: bytes) -> None:
        self._key = key

    def __len__(self) -> int:
        return len(self._key)

    def __eq__(self, other: object) -> bool:
        key = other._key if isinstance(other, UnconfirmedKey) else other
        return compare_digest(self._key, key) if isinstance(key, bytes) else NotImplemented


class KeyExchange:
    """One party's side of one run of the key exchange.

    own_key, own_uid: one's own key and distinguishing identifier; peer_public, peer_uid: the peer's.
    Identifiers have at most 8191 bytes (InvalidLength). initiator: True for A, False for B.
    ephemeral_key: r, drawn afresh if None; never use one twice.

    Each side sends `ephemeral`, calls `agree` once with what it received, sends the
    confirmation and calls `confirm` with the peer's, which returns the key. Another order is OutOfOrder.

    >>> from smcrypto.sm2 import KeyExchange, PrivateKey
    >>> a, b = PrivateKey.generate(), PrivateKey.generate()
    >>> robot = KeyExchange(a, b"robot", b.public_key, b"server", initiator=True)
    >>> server = KeyExchange(b, b"server", a.public_key, b"robot", initiator=False)
    >>> _, s_b = server.agree(robot.ephemeral, 16)
    >>> _, s_a = robot.agree(server.ephemeral, 16)
    >>> robot.confirm(s_b) == server.confirm(s_a)
    True
    """

    __slots__ = ("_curve", "_ephemeral", "_ephemeral_key", "_expected", "_initiator", "_own", "_peer", "_z")

    def __init__(
        self, own_key: PrivateKey, own_uid: BytesLike, peer_public: PublicKey, peer_uid: BytesLike, *, initiator: bool,
        ephemeral_key: PrivateKey | None = None,
    ) -> None:  # fmt: skip
        for key, kind, name in (
            (own_key, PrivateKey, "own_key"),
            (peer_public, PublicKey, "peer_public"),
            (own_key if ephemeral_key is None else ephemeral_key, PrivateKey, "ephemeral_key"),
        ):
            require_type(key, kind, name)
        require_type(initiator, bool, "initiator")
        self._curve = curve = own_key.curve
        if ephemeral_key is None:
            ephemeral_key = PrivateKey.generate(curve)
        if peer_public.curve != curve or ephemeral_key.curve != curve:
            raise InvalidKey("the keys are not of the same curve")
        own_z = z_value(curve, own_key.public_key.point, as_bytes(own_uid, "own_uid"))
        peer_z = z_value(curve, peer_public.point, as_bytes(peer_uid, "peer_uid"))
        self._z = (own_z, peer_z) if initiator else (peer_z, own_z)
        self._own = own_key
        self._peer = peer_public
        self._initiator = initiator
        self._ephemeral_key: PrivateKey | None = ephemeral_key
        self._ephemeral = ephemeral_key.public_key.point
        self._expected: tuple[bytes, bytes] | None = None  # the peer's confirmation, and the key

    @property
    def ephemeral(self) -> bytes:
        """One's own R, to be sent to the peer: 04 || x || y, 65 bytes."""
        return encode_point(self._ephemeral, self._curve)

    @overload
    def agree(
        self, peer_ephemeral: BytesLike, length: int, *, unconfirmed: Literal[False] = False
    ) -> tuple[UnconfirmedKey, bytes]: ...

    @overload
    def agree(
        self, peer_ephemeral: BytesLike, length: int, *, unconfirmed: Literal[True]
    ) -> tuple[bytes, bytes]: ...

    def agree(
        self, peer_ephemeral: BytesLike, length: int, *, unconfirmed: bool = False
    ) -> tuple[UnconfirmedKey | bytes, bytes]:
        """(key, confirmation): a key of `length` bytes, and 32 bytes for the peer's `confirm`, S_A or S_B.

        The key is an UnconfirmedKey, which cannot be used; `confirm` returns its bytes. unconfirmed: True for the bytes
        at once, in a protocol that confirms by other means.
        peer_ephemeral: the peer's R, 04 || x || y; InvalidKey if it is no point of the curve, or if the
        shared point is at infinity; the exchange then is as before. length: at least 1, else InvalidLength.
        OutOfOrder if it has agreed already.
        """
        data = as_bytes(peer_ephemeral, "peer_ephemeral")
        require_type(unconfirmed, bool, "unconfirmed")
        if not 1 <= require_int(length, "length") < 32 * (2**32 - 1):
            raise InvalidLength(f"length must be at least 1 byte and below 32 * (2**32 - 1), not {length}")
        if self._ephemeral_key is None:
            raise OutOfOrder("this exchange has agreed on a key already; every run needs its own")
        curve = self._curve
        peer_R = decode_point(data, curve, allow_compressed=False)
        peer_P = self._peer.point
        V = shared_point(curve, self._own.to_int(), self._ephemeral_key.to_int(), self._ephemeral, peer_P, peer_R)
        if V is None:
            raise InvalidKey("the shared point is at infinity")
        known_keys.used(curve, peer_P)
        self._ephemeral_key = None
        size = curve.field_bytes
        x, y = V[0].to_bytes(size, "big"), V[1].to_bytes(size, "big")
        z = b"".join(self._z)
        key = sm2_kdf(x + y + z, length)
        first, second = (self._ephemeral, peer_R) if self._initiator else (peer_R, self._ephemeral)
        inner = sm3.digest(x + z + b"".join(v.to_bytes(size, "big") for v in (*first, *second)))
        s_b, s_a = (sm3.digest(prefix + y + inner) for prefix in (b"\x02", b"\x03"))
        own, expected = (s_a, s_b) if self._initiator else (s_b, s_a)
        self._expected = expected, key
        return key if unconfirmed else UnconfirmedKey(key), own

    def confirm(self, peer_confirmation: BytesLike) -> bytes:
        """The key, if the peer's confirmation shows that it holds the same one; else ConfirmationError.

        After ConfirmationError nothing returns the key. OutOfOrder before `agree`, and at a second try.
        """
        data = as_bytes(peer_confirmation, "peer_confirmation")
        if self._expected is None:
            raise OutOfOrder("confirm comes after agree, and once")
        (expected, key), self._expected = self._expected, None
        if not compare_digest(expected, data):
            raise ConfirmationError("the peer did not arrive at the same key")
        return key

    def __reduce__(self) -> NoReturn:
        raise TypeError("a key exchange is neither copied nor pickled: its ephemeral key serves one run")
