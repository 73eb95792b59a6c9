"""SM4 and GHASH as the standards write them, GB/T 32907-2016 and NIST SP 800-38D: the oracle of the SM4 tests.

Names are the standards': X words of the state, rk round keys, tau the S-box on four bytes, L and L' the linear maps.
"""

from __future__ import annotations

from collections.abc import Sequence

from smcrypto.sm4.block import CK, FK, SBOX, L, L_prime


def _affine(x: int) -> int:
    """A.x + 0xD3 over GF(2): bit i of A.x is the parity of x under 0xA7 rotated left by i."""
    y = 0
    for i in range(8):
        row = (0xA7 << i | 0xA7 >> (8 - i)) & 0xFF
        y |= ((x & row).bit_count() & 1) << i
    return y ^ 0xD3


def _gf_inverse() -> list[int]:
    """Inverses in GF(2)[x] / (x^8 + x^7 + x^6 + x^5 + x^4 + x^2 + 1), 0 to 0: powers of 2, forth and back."""
    powers = [1]
    for _ in range(254):
        power = powers[-1] << 1
        powers.append(power ^ 0x1F5 if power & 0x100 else power)
    inverse = [0] * 256
    for exponent, power in enumerate(powers):
        inverse[power] = powers[-exponent % 255]
    return inverse


def sbox() -> bytes:
    """The table of 6.2 a) from its algebraic form, affine . inversion . affine."""
    inverse = _gf_inverse()
    return bytes(_affine(inverse[_affine(x)]) for x in range(256))


def _tau(word: int) -> int:
    return int.from_bytes(word.to_bytes(4, "big").translate(SBOX), "big")


def reference_expand_key(key: bytes) -> tuple[int, ...]:
    """The 32 round keys of a 16-byte key, 7.3. Reversed, they decrypt (7.2)."""
    K = [int.from_bytes(key[4 * i : 4 * i + 4], "big") ^ FK[i] for i in range(4)]
    for i in range(32):
        K.append(K[i] ^ L_prime(_tau(K[i + 1] ^ K[i + 2] ^ K[i + 3] ^ CK[i])))
    return tuple(K[4:])


def reference_crypt(rk: Sequence[int], block: bytes) -> bytes:
    """One 16-byte block through the 32 rounds of 7.1, as the standard writes it."""
    X = [int.from_bytes(block[4 * i : 4 * i + 4], "big") for i in range(4)]
    for i in range(32):
        X.append(X[i] ^ L(_tau(X[i + 1] ^ X[i + 2] ^ X[i + 3] ^ rk[i])))
    return b"".join(word.to_bytes(4, "big") for word in reversed(X[32:]))


def multiply_by_definition(X: int, Y: int) -> int:
    """X·Y, SP 800-38D, 6.3, algorithm 1."""
    Z, V = 0, Y
    for i in range(128):
        if X >> (127 - i) & 1:
            Z ^= V
        V = V >> 1 ^ 0xE1 << 120 if V & 1 else V >> 1
    return Z


def ghash_by_definition(H: int, data: bytes) -> int:
    """GHASH_H of whole blocks, SP 800-38D, 6.4, algorithm 2."""
    Y = 0
    for i in range(0, len(data), 16):
        Y = multiply_by_definition(Y ^ int.from_bytes(data[i : i + 16], "big"), H)
    return Y
