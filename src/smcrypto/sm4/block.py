"""The SM4 block cipher on one block, GB/T 32907-2016.

Names are the standard's: X words of the state, MK the key, rk round keys,
FK and CK the constants of the key expansion, tau the S-box on four bytes,
L and L' the linear maps, T = L.tau, T' = L'.tau. Words are 32-bit integers,
most significant byte first (6.2).

This file can be read beside clauses 6 and 7. It is the oracle of all the
tests, and what the engines take their constants and tables from (tables for
serial work, byteplanes and bitslice for many blocks at once).
"""

from __future__ import annotations

from collections.abc import Sequence

__all__ = ["CK", "FK", "SBOX", "L", "L_prime", "reference_crypt", "reference_expand_key"]

FK = (0xA3B1BAC6, 0x56AA3350, 0x677D9197, 0xB27022DC)
# ck[i][j] = (4i + j) * 7 mod 256, 7.3.2.
CK = tuple(int.from_bytes(bytes((4 * i + j) * 7 % 256 for j in range(4)), "big") for i in range(32))


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


def _sbox() -> bytes:
    """The table of 6.2 a) from its algebraic form, affine . inversion . affine (compared with the table by a test)."""
    inverse = _gf_inverse()
    return bytes(_affine(inverse[_affine(x)]) for x in range(256))


SBOX = _sbox()


def _rotl(word: int, n: int) -> int:
    return (word << n | word >> (32 - n)) & 0xFFFFFFFF


def _tau(word: int) -> int:
    return int.from_bytes(word.to_bytes(4, "big").translate(SBOX), "big")


def L(B: int) -> int:
    """6.2 b)."""
    return B ^ _rotl(B, 2) ^ _rotl(B, 10) ^ _rotl(B, 18) ^ _rotl(B, 24)


def L_prime(B: int) -> int:
    """7.3 c)."""
    return B ^ _rotl(B, 13) ^ _rotl(B, 23)


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
