"""XTS, GB/T 17964-2021 and IEEE 1619-2018: a tweak for each block, ciphertext stealing at the end.

T_0 = E(K_2, tweak), T_(j+1) = alpha * T_j in GF(2)[alpha] / (alpha^128 + alpha^7 + alpha^2 + alpha + 1), and
a block becomes E(K_1, P ^ T) ^ T. The standards differ in which bit stands for which power:

"ieee"  alpha^0 is the lowest bit of the first byte, alpha^8 that of the second
"gb"    alpha^0 is the highest bit of the first byte, alpha^8 that of the second (as in GCM)

So one is the other with the bits of each byte reversed, and the first block is the same in both.
"""

from __future__ import annotations

from collections.abc import Iterator
from functools import cache
from typing import Literal, TypeAlias

from smcrypto.errors import InvalidLength
from smcrypto.sm4.engine import Engine, xor_bytes

__all__ = ["Variant", "XTSStream", "tweak_sequence"]

Variant: TypeAlias = Literal["gb", "ieee"]

_REVERSED = bytes(int(f"{byte:08b}"[::-1], 2) for byte in range(256))
_LANES = 64  # tweaks computed at once; alpha^64 is the largest power that _times_alpha takes


@cache
def _low_bits(e: int, lanes: int) -> int:
    """The lowest e bits of each of `lanes` lanes of 128 bits."""
    return sum(((1 << e) - 1) << 128 * lane for lane in range(lanes))


def _times_alpha(T: int, e: int, lanes: int) -> int:
    """T * alpha^e in each lane of T, alpha^0 being the lowest bit; e <= 64, so that one reduction is enough."""
    over = T >> (128 - e) & _low_bits(e, lanes)
    return (T & _low_bits(128 - e, lanes)) << e ^ over ^ over << 1 ^ over << 2 ^ over << 7


def _runs(first: bytes) -> Iterator[bytes]:
    """The tweaks from `first` on in the order of "ieee", 1, 1, 2, 4, ... 32, and from then on 64 at a time."""
    T, lanes = int.from_bytes(first, "little"), 1
    yield first
    while lanes < _LANES:
        following = _times_alpha(T, lanes, lanes)
        yield following.to_bytes(16 * lanes, "little")
        T |= following << 128 * lanes
        lanes *= 2
    while True:
        T = _times_alpha(T, _LANES, _LANES)
        yield T.to_bytes(16 * _LANES, "little")


def tweak_sequence(first: bytes, n: int, variant: Variant) -> bytes:
    """T_0 = `first`, T_1, ... T_(n-1), joined."""
    runs = _runs(first.translate(_REVERSED) if variant == "gb" else first)
    tweaks = bytearray()
    while len(tweaks) < 16 * n:
        tweaks += next(runs)
    del tweaks[16 * n :]
    return bytes(tweaks.translate(_REVERSED) if variant == "gb" else tweaks)


class XTSStream:
    """One data unit in one direction; keeps 16 to 31 bytes back, which the stealing may need.

    Equal halves of the key are taken, as vectors of GB/T 17964 have them; a key
    drawn at random never does. With them a chosen plaintext reveals tweaks, and FIPS 140-3
    (IG C.I) forbids them.
    """

    def __init__(self, key: bytes, tweak: bytes, variant: Variant, *, encrypting: bool) -> None:
        engine = Engine(key[:16])
        self._crypt = engine.encrypt if encrypting else engine.decrypt
        self._encrypting, self._variant = encrypting, variant
        self._tweak = Engine(key[16:]).encrypt(tweak)
        self._pending = b""

    def update(self, data: bytes) -> bytes:
        data = self._pending + data
        ready = max(0, (len(data) - 16) & ~15)
        self._pending = data[ready:]
        if not ready:
            return b""
        tweaks = tweak_sequence(self._tweak, ready // 16 + 1, self._variant)
        self._tweak = tweaks[ready:]
        return self._masked(data[:ready], tweaks[:ready])

    def _masked(self, blocks: bytes, tweaks: bytes) -> bytes:
        return self._crypt(xor_bytes(blocks, tweaks), tweaks)

    def finalize(self) -> bytes:
        """The last whole block and what is left, which borrows the end of that block's ciphertext."""
        full, rest = self._pending[:16], self._pending[16:]
        if len(full) < 16:
            raise InvalidLength("XTS takes at least 16 bytes")
        tweaks = tweak_sequence(self._tweak, 2, self._variant)
        T, T_next = tweaks[:16], tweaks[16:]
        if not rest:
            return self._masked(full, T)
        if not self._encrypting:
            T, T_next = T_next, T
        lender = self._masked(full, T)
        return self._masked(rest + lender[len(rest) :], T_next) + lender[: len(rest)]
