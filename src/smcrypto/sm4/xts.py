"""XTS, GB/T 17964-2021 clause 11 and IEEE 1619-2018: a tweak per block, ciphertext stealing at the end.

T_0 = E(K2, tweak), T_(j+1) = T_j times alpha in GF(2^128); a block becomes
E(K1, P xor T) xor T. The two standards name the bits of T differently:

"gb"    bit 127 of the big-endian number is alpha^0, so doubling shifts right
        and folds with 0xE1 on top (as GCM does)
"ieee"  the number is little-endian, doubling shifts left and folds with 0x87

The first block is therefore the same in both, all later ones differ.
"""

from __future__ import annotations

from hmac import compare_digest
from typing import Literal, TypeAlias

from smcrypto.errors import InvalidKey, InvalidLength, InvalidOption
from smcrypto.sm4.engine import Engine, xor_bytes

__all__ = ["Variant", "XTSStream", "check_variant"]

Variant: TypeAlias = Literal["gb", "ieee"]


def check_variant(variant: str) -> None:
    """InvalidOption unless it is one of the two."""
    if variant not in ("gb", "ieee"):
        raise InvalidOption('variant must be "gb" or "ieee"')


def _double_gb(tweak: bytes) -> bytes:
    t = int.from_bytes(tweak, "big")
    return (t >> 1 ^ (0xE1 << 120) * (t & 1)).to_bytes(16, "big")


def _double_ieee(tweak: bytes) -> bytes:
    t = int.from_bytes(tweak, "little")
    return ((t << 1) % (1 << 128) ^ 0x87 * (t >> 127)).to_bytes(16, "little")


class XTSStream:
    """One data unit in one direction; keeps 16 to 31 bytes back, which the stealing may need.

    Equal key halves are refused for encryption (they let a chosen ciphertext
    reveal a tweak; NIST SP 800-38E by way of FIPS 140 IG C.I), accepted for decryption so
    that data written elsewhere stays readable.
    """

    def __init__(self, key: bytes, tweak: bytes, variant: Variant, *, encrypting: bool) -> None:
        if encrypting and compare_digest(key[:16], key[16:]):
            raise InvalidKey("the two halves of an XTS key must differ")
        engine = Engine(key[:16])
        self._crypt = engine.encrypt if encrypting else engine.decrypt
        self._encrypting = encrypting
        self._tweak = Engine(key[16:]).encrypt(tweak)
        self._double = _double_gb if variant == "gb" else _double_ieee
        self._pending = b""

    def _blocks(self, data: bytes) -> bytes:
        tweaks = []
        for _ in range(0, len(data), 16):
            tweaks.append(self._tweak)
            self._tweak = self._double(self._tweak)
        mask = b"".join(tweaks)
        return xor_bytes(self._crypt(xor_bytes(data, mask)), mask)

    def update(self, data: bytes) -> bytes:
        data = self._pending + data
        ready = max(0, (len(data) - 16) & ~15)
        self._pending = data[ready:]
        return self._blocks(data[:ready])

    def finalize(self) -> bytes:
        pending, self._pending = self._pending, b""
        if len(pending) < 16:
            raise InvalidLength("XTS takes at least 16 bytes")
        if len(pending) == 16:
            return self._blocks(pending)
        first, second = self._tweak, self._double(self._tweak)
        if not self._encrypting:
            first, second = second, first
        full, rest = pending[:16], pending[16:]
        stolen = xor_bytes(self._crypt(xor_bytes(full, first)), first)
        return xor_bytes(self._crypt(xor_bytes(rest + stolen[len(rest):], second)), second) + stolen[: len(rest)]
