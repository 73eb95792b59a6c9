"""SM2 public key encryption, GB/T 32918.4-2016, and its encodings.

Names are the standard's: C1 = [k]G, C2 = M xor t, C3 = SM3(x2 || M || y2), t = KDF(x2 || y2).
A1-A8 and B1-B7 mark the steps of encrypting (6.1) and decrypting (7.1). A ciphertext is
SEQUENCE { x1, y1, C3, C2 } in DER (GM/T 0009-2012, 7.2), or C1 || C3 || C2, the order of
2016, or C1 || C2 || C3, the order of 2010; in the raw forms C1 begins with 04.

The empty message is allowed: then C2 is empty, and the rule that t must not be all
zero (A5, B4), which keeps a message from travelling in clear, has nothing to keep.
"""

from __future__ import annotations

from collections.abc import Iterator
from hmac import compare_digest
from typing import Final

from smcrypto import der, sm3
from smcrypto.errors import InvalidCiphertext, InvalidEncoding, InvalidKey, InvalidOption
from smcrypto.kdf import sm2_kdf
from smcrypto.sm2.curve import Curve, Point, decode_point, encode_point, require_point
from smcrypto.sm2.known_keys import known_keys
from smcrypto.sm2.points import base_comb, secret_sum, to_affine_all

__all__ = ["decode_ciphertext", "decrypt", "encode_ciphertext", "encrypt"]

REFUSED: Final = "not a ciphertext for this key (smcrypto.diagnose tells what it is)"
_C3_BYTES: Final = 32


def encrypt(curve: Curve, P: Point, message: bytes, nonces: Iterator[int]) -> tuple[Point, bytes, bytes]:
    """(C1, C3, C2) with the first nonce whose t is not all zero, steps A1-A8."""
    while True:
        k = next(nonces)
        # A2 and A4. A3 asks for [h]P != O, which holds for every public key (curve.require_point).
        C1, shared = to_affine_all(
            [secret_sum(curve, (k, base_comb(curve))), secret_sum(curve, (k, known_keys.comb(curve, P) or P))], curve
        )
        x2, y2 = _field_elements(shared, curve)
        C2 = _mask(x2 + y2, message)
        if C2 is not None:
            known_keys.used(curve, P)
            return C1, sm3.digest(x2 + message + y2), C2


def decrypt(curve: Curve, d: int, C1: Point, C3: bytes, C2: bytes) -> bytes:
    """The message, or InvalidCiphertext, steps B1-B7; C1 is a point of the curve (decode_ciphertext)."""
    [shared] = to_affine_all([secret_sum(curve, (d, C1))], curve)
    x2, y2 = _field_elements(shared, curve)
    message = _mask(x2 + y2, C2)
    # B4 and B6 fail alike.
    if message is None or not compare_digest(sm3.digest(x2 + message + y2), C3):
        raise InvalidCiphertext(REFUSED)
    return message


def _field_elements(point: Point, curve: Curve) -> tuple[bytes, bytes]:
    size = curve.field_bytes
    return point[0].to_bytes(size, "big"), point[1].to_bytes(size, "big")


def _mask(z: bytes, text: bytes) -> bytes | None:
    """text xor KDF(z); None where the standard refuses the key stream because it is all zero."""
    length = len(text)
    if length == 0:
        return b""
    t = int.from_bytes(sm2_kdf(z, length), "big")
    return (int.from_bytes(text, "big") ^ t).to_bytes(length, "big") if t else None


def encode_ciphertext(C1: Point, C3: bytes, C2: bytes, curve: Curve, encoding: str) -> bytes:
    if encoding == "der":
        return der.sequence(der.integer(C1[0]), der.integer(C1[1]), der.octet_string(C3), der.octet_string(C2))
    start = encode_point(C1, curve)
    return start + C3 + C2 if encoding == "c1c3c2" else start + C2 + C3


def decode_ciphertext(ciphertext: bytes, curve: Curve, encoding: str) -> tuple[Point, bytes, bytes]:
    """(C1, C3, C2), C1 on the curve (step B1); InvalidCiphertext for anything else."""
    try:
        if encoding == "der":
            with der.reading_sequence(ciphertext) as body:
                C1 = require_point((body.integer(), body.integer()), curve)
                C3, C2 = body.octet_string(), body.octet_string()
        else:
            size = 1 + 2 * curve.field_bytes
            C1 = decode_point(ciphertext[:size], curve, allow_compressed=False)
            rest = ciphertext[size:]
            cut = _C3_BYTES if encoding == "c1c3c2" else max(len(rest) - _C3_BYTES, 0)
            C3, C2 = (rest[:cut], rest[cut:]) if encoding == "c1c3c2" else (rest[cut:], rest[:cut])
    except (InvalidEncoding, InvalidKey):
        raise InvalidCiphertext(REFUSED) from None
    if len(C3) != _C3_BYTES:
        raise InvalidCiphertext(REFUSED)
    return C1, C3, C2


def require_encoding(encoding: str) -> None:
    if encoding not in ("der", "c1c3c2", "c1c2c3"):
        raise InvalidOption(f'encoding must be "der", "c1c3c2" or "c1c2c3", not {encoding!r}')
