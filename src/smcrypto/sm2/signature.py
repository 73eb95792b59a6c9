"""SM2 signatures, GB/T 32918.2-2016, and their encodings.

Names are the standard's: d_A, P_A, Z_A (5.5), e, k, r, s, t. A1-A7 and B1-B7 mark
the steps of signing (6.1) and verifying (7.1). Signatures are SEQUENCE { r, s } in
DER (GM/T 0009-2012, 7.3) or raw, r || s.

Not here: keys as objects (keys), nonces (nonces).
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import lru_cache
from typing import Final

from smcrypto import der, sm3
from smcrypto.errors import InvalidEncoding, InvalidLength, InvalidOption, InvalidSignature
from smcrypto.sm2.curve import Curve, Point
from smcrypto.sm2.known_keys import known_keys
from smcrypto.sm2.points import base_comb, public_sum, secret_sum, to_affine_all

__all__ = ["DEFAULT_UID", "decode_signature", "encode_signature", "message_digest", "sign", "verify", "z_value"]

DEFAULT_UID: Final = b"1234567812345678"
"""The distinguishing identifier where none was agreed (GM/T 0009-2012, clause 10)."""

# One text for every reason to refuse (as of decryption), and where to look on one's own desk.
REFUSED: Final = "the signature does not hold (smcrypto.diagnose tells why it may not)"
_MAX_UID: Final = 8191  # ENTL_A counts bits in two bytes (GB/T 32918.2, 5.5)


@lru_cache(maxsize=128)
def z_value(curve: Curve, P: Point, uid: bytes) -> bytes:
    """Z = SM3(ENTL || ID || a || b || x_G || y_G || x_A || y_A), GB/T 32918.2, 5.5.

    uid: at most 8191 bytes, else InvalidLength.
    """
    if len(uid) > _MAX_UID:
        raise InvalidLength(f"uid must be at most {_MAX_UID} bytes, not {len(uid)}")
    size = curve.field_bytes
    numbers = (curve.a, curve.b, *curve.G, *P)
    return sm3.digest((8 * len(uid)).to_bytes(2, "big") + uid + b"".join(v.to_bytes(size, "big") for v in numbers))


def message_digest(curve: Curve, P: Point, uid: bytes, message: bytes) -> bytes:
    """e = SM3(Z_A || M), steps A1 and A2."""
    return sm3.digest(z_value(curve, P, uid) + message)


def sign(curve: Curve, d_plus_1_inverse: int, e: int, nonces: Iterator[int]) -> tuple[int, int]:
    """(r, s) with the first nonce that the standard allows, steps A3-A7."""
    n = curve.n
    while True:
        k = next(nonces)
        [(x, _)] = to_affine_all([secret_sum(curve, (k, base_comb(curve)))], curve)
        r = (e + x) % n
        if r == 0 or r + k == n:
            continue
        # A6, s = (k - r d)/(1 + d), is (k + r)/(1 + d) - r: one product, and r never meets d alone.
        s = (d_plus_1_inverse * (k + r) - r) % n
        if s != 0:
            return r, s


def verify(curve: Curve, P: Point, e: int, r: int, s: int) -> None:
    """InvalidSignature unless (r, s) signs e under P, steps B1-B7."""
    n, p = curve.n, curve.p
    t = (r + s) % n
    if not (0 < r < n and 0 < s < n) or t == 0:
        raise InvalidSignature(REFUSED)
    X, _, ZZ, _ = public_sum(curve, (s, base_comb(curve)), (t, known_keys.comb(curve, P) or P))
    # B7, R = (e + x) mod n = r, without the inversion for x: X = x Z^2 for an x = r - e modulo n below p.
    if ZZ == 0 or all((x * ZZ - X) % p for x in range((r - e) % n, p, n)):
        raise InvalidSignature(REFUSED)
    known_keys.used(curve, P)


def encode_signature(r: int, s: int, curve: Curve, encoding: str) -> bytes:
    if encoding == "der":
        return der.sequence(der.integer(r), der.integer(s))
    size = curve.scalar_bytes
    return r.to_bytes(size, "big") + s.to_bytes(size, "big")


def decode_signature(signature: bytes, curve: Curve, encoding: str) -> tuple[int, int]:
    """(r, s) as encoded, their range not yet checked; InvalidSignature if they are not."""
    if encoding == "raw":
        size = curve.scalar_bytes
        if len(signature) != 2 * size:
            raise InvalidSignature(REFUSED)
        return int.from_bytes(signature[:size], "big"), int.from_bytes(signature[size:], "big")
    try:
        with der.reading_sequence(signature) as body:
            r, s = body.integer(), body.integer()
    except InvalidEncoding:
        raise InvalidSignature(REFUSED) from None
    return r, s


def require_encoding(encoding: str) -> None:
    if encoding not in ("der", "raw"):
        raise InvalidOption(f'encoding must be "der" or "raw", not {encoding!r}')
