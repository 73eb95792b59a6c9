"""GHASH, the universal hash under GCM: NIST SP 800-38D, 6.3 and 6.4.

Notation: a block is an element of GF(2^128) = GF(2)[x] / (x^128 + x^7 + x^2 + x + 1), held as an integer whose
bit 127 is the coefficient of x^0 (the order of 6.3). Multiplying by x is therefore a shift to the right.
GHASH(X_1 ... X_m) = X_1·H^m + X_2·H^(m-1) + ... + X_m·H, and + is XOR.

    serial          (Y + X_i)·H, a block at a time, over one table of 256 multiples of H: 8 µs to make,
                    some 0.9 µs a block. For a key's first messages.
    in pairs        (Y + X_i)·H² + X_(i+1)·H, with a table of H² as well: 0.7 µs a block. For keys that stay.
    folding         turns a message into one of 8 to 128 blocks with the same GHASH, 0.05 µs a block
                    where the message is long; that is then hashed in pairs. See `_Fold`.

The algorithms as 6.3 and 6.4 write them are the tests' oracle (tests/sm4_reference.py).

Side channels: the first two index their tables by bytes of Y + X_i, `_Fold` its tables by bits of powers of H, so the
addresses all three touch depend on the authentication key. Big integers take no data-dependent branches in any.
"""

from __future__ import annotations

from functools import cache
from typing import NamedTuple

__all__ = ["GHASH"]

_R = 0xE1 << 120  # x^128 = 1 + x + x^2 + x^7
_ONE = 1 << 127  # x^0


# --- one table, one block at a time ----------------------------------------------------------------------------


def _multiples(H: int) -> list[int]:
    """T[b] = b·H for the 256 polynomials b of degree below 8; b's bit 7 is x^0, as in a block's first byte."""
    powers = []  # x^0·H ... x^7·H
    for _ in range(8):
        powers.append(H)
        H = H >> 1 ^ _R if H & 1 else H >> 1
    T = [0]
    for V in reversed(powers):
        T += [V ^ W for W in T]
    return T


_M120 = (1 << 120) - 1


def _serial(T: list[int], data: bytes) -> int:
    """GHASH of whole blocks with T = _multiples(H).

    (Y + X)·H is the sum of T[byte i]·x^(8i): 248 bits, x^0 being bit 247. The low 120 bits stand for
    x^128 and above; x^128 = 1 + x + x^2 + x^7 brings them back, and since they end eight places
    before x^255 once is enough.
    """
    Y = 0
    from_bytes = int.from_bytes
    for i in range(0, len(data), 16):
        a, b, c, d, e, f, g, h, s, t, u, v, w, x, y, z = (Y ^ from_bytes(data[i : i + 16], "big")).to_bytes(16, "big")
        P = ((T[a] << 8 ^ T[b]) << 8 ^ T[c]) << 8 ^ T[d]
        P = (((P << 8 ^ T[e]) << 8 ^ T[f]) << 8 ^ T[g]) << 8 ^ T[h]
        P = (((P << 8 ^ T[s]) << 8 ^ T[t]) << 8 ^ T[u]) << 8 ^ T[v]
        P = (((P << 8 ^ T[w]) << 8 ^ T[x]) << 8 ^ T[y]) << 8 ^ T[z]
        low = (P & _M120) << 8
        Y = P >> 120 ^ low ^ low >> 1 ^ low >> 2 ^ low >> 7
    return Y


def _in_pairs(T: list[int], T2: list[int], data: bytes) -> int:
    """The same with T2 = _multiples(H²) as well: (Y + X_i)·H² + X_(i+1)·H, two blocks for one chain of shifts."""
    if len(data) % 32:
        data = bytes(16) + data  # zero blocks in front do not count
    Y = 0
    from_bytes = int.from_bytes
    for i in range(0, len(data), 32):
        a, b, c, d, e, f, g, h, s, t, u, v, w, x, y, z = (Y ^ from_bytes(data[i : i + 16], "big")).to_bytes(16, "big")
        A, B, C, D, E, F, G, H, S, T_, U, V, W, X, Y_, Z = data[i + 16 : i + 32]
        P = (T2[a] ^ T[A]) << 8 ^ T2[b] ^ T[B]
        P = (P << 8 ^ T2[c] ^ T[C]) << 8 ^ T2[d] ^ T[D]
        P = (P << 8 ^ T2[e] ^ T[E]) << 8 ^ T2[f] ^ T[F]
        P = (P << 8 ^ T2[g] ^ T[G]) << 8 ^ T2[h] ^ T[H]
        P = (P << 8 ^ T2[s] ^ T[S]) << 8 ^ T2[t] ^ T[T_]
        P = (P << 8 ^ T2[u] ^ T[U]) << 8 ^ T2[v] ^ T[V]
        P = (P << 8 ^ T2[w] ^ T[W]) << 8 ^ T2[x] ^ T[X]
        P = (P << 8 ^ T2[y] ^ T[Y_]) << 8 ^ T2[z] ^ T[Z]
        low = (P & _M120) << 8
        Y = P >> 120 ^ low ^ low >> 1 ^ low >> 2 ^ low >> 7
    return Y


def _times(T: list[int], X: int) -> int:
    """X·H with T = _multiples(H)."""
    return _serial(T, X.to_bytes(16, "big"))


def _square(X: int) -> int:
    """X²: squaring puts a zero between any two coefficients, which is reading the bits as digits of base 4."""
    P = int(f"{X:0128b}", 4) << 1  # 256 bits, x^0 on top
    for _ in range(2):  # the first reduction leaves x^128 ... x^133
        high = P >> 128 << 128
        low = (P ^ high) << 128
        P = high ^ low ^ low >> 1 ^ low >> 2 ^ low >> 7
    return P >> 128


# --- many blocks as one integer --------------------------------------------------------------------------------

_GROUP = 5  # parts whose 2^5 sums are tabulated together: (26 + 128) / 5 additions a part, the least there is
_LOW_BITS = int.from_bytes(b"\x01" * 128, "big")


class _Masks(NamedTuple):
    """Of n lanes (n even), 128 bits each; a pair of lanes is a slot of 256 bits."""

    upper: int  # the upper lane of every slot, that is blocks 0, 2, 4, ... of a part
    lower: int  # the lower lanes, blocks 1, 3, 5, ...
    spread: int  # the upper lanes of n slots


@cache
def _masks(n: int) -> _Masks:
    slot = ((1 << 128) - 1 << 128).to_bytes(32, "big")
    upper = int.from_bytes(slot * (n // 2), "big")
    return _Masks(upper, upper >> 128, int.from_bytes(slot * n, "big"))


class _Fold:
    """Turns a message into n blocks with the same GHASH, for one H.

    The message, in front of it zero blocks up to a multiple of n, is cut into parts V_J ... V_1, V_0 of n
    blocks. A part is *one* integer of n lanes. Block l of all parts adds up to V_0 + V_1·H^n + V_2·H^2n + ...
    in lane l, so the lanes all multiply by the same constants c_j = H^(n·j). With the bits of the constants
    c_j = sum of c_jk·x^k, the sum over j of c_j·V_j is that of S_k·x^k for k = 0 ... 127, where

        S_k = sum of those V_j that have c_jk = 1

    which needs additions of whole parts only. Five parts have just 32 sums: they are made once, and each of
    the 128 rows S_k takes one of them ("four Russians"). Which, says `_choices`: 128 bytes per five parts.
    What is left are 128 shifts: S_0 + x·(S_1 + x·(S_2 + ...)) in lanes of 255 bits, and one reduction.

    early: spread the lanes to 256 bits before the additions, which then have twice the length but no more
    steps (right while parts are short), or after them.
    """

    __slots__ = ("_H_n", "_constants", "_early", "n")

    def __init__(self, H: int, n: int, *, early: bool) -> None:
        self.n = n
        self._early = early
        self._H_n = H
        for _ in range(n.bit_length() - 1):
            self._H_n = _square(self._H_n)
        # The choices so far and the next constant; replaced as a whole, so that threads may share a key.
        self._constants: tuple[list[bytes], int] = ([], _ONE)

    def _choices(self, groups: int) -> list[bytes]:
        """For at least so many groups: byte k of group g has bit i set where c_(5g+i),k is."""
        known, c = self._constants
        if len(known) >= groups:
            return known
        choices = known.copy()
        T = _multiples(self._H_n)
        while len(choices) < groups:
            packed = 0
            for i in range(_GROUP):
                digits = f"{c:0128b}".encode()  # character k: coefficient of x^k
                packed |= (int.from_bytes(digits, "big") & _LOW_BITS) << i
                c = _times(T, c)
            choices.append(packed.to_bytes(128, "big"))
        self._constants = (choices, c)
        return choices

    def fold(self, data: bytes) -> bytes:
        """n blocks with the GHASH of `data` (whole blocks, one at least)."""
        n, early = self.n, self._early
        width = 128 * n
        upper, lower, spread = _masks(n)
        size = 16 * n
        count = -(-len(data) // size)
        data = data.rjust(size * count, b"\0")
        V = [int.from_bytes(data[i : i + size], "big") for i in range(size * (count - 1), -1, -size)]
        if early:
            V = [(v & upper) << width | (v & lower) << 128 for v in V]
        groups = -(-count // _GROUP)
        S: list[int] = []
        for g, choice in zip(range(0, count, _GROUP), self._choices(groups), strict=False):
            sums = [0]
            for v in V[g : g + _GROUP]:
                sums += [v ^ w for w in sums]
            sums *= 1 << _GROUP - (len(sums).bit_length() - 1)  # parts that are not there add nothing
            S = [s ^ sums[i] for s, i in zip(S, choice, strict=True)] if S else [sums[i] for i in choice]
        if not early:
            S = [(s & upper) << width | (s & lower) << 128 for s in S]
        P = 0
        for s in reversed(S):
            P = P >> 1 ^ s
        for _ in range(2):  # as in _square
            high = P & spread
            low = (P ^ high) << 128
            P = high ^ low ^ low >> 1 ^ low >> 2 ^ low >> 7
        P &= spread
        return (P >> width | (P & (1 << width) - 1) >> 128).to_bytes(size, "big")


# --- which, when -----------------------------------------------------------------------------------------------

# (lanes, blocks from which to fold to so many). Measured by benchmarks/bench_sm4_aead.py.
_FOLDS = ((128, 12288), (32, 1536), (16, 400), (8, 34))
_EARLY = 8  # lanes up to which spreading before the additions is the faster way
_PIECE = 1 << 20  # bytes folded at once: bounds memory and the number of constants
# Tables for pairs take 10 µs to make and save 0.2 µs a block, a fold's constants take 30 µs and save from 0.3 to
# 0.8. Both are made once a key has served so many blocks; a key for one short message does not pay for them.
_WORTH_MORE = 64


class GHASH:
    """GHASH under one key, quicker as the key serves longer.

    H: the hash subkey, E(K, 0^128), 16 bytes. Memory: 13 KB of tables, 26 KB from a kilobyte of messages on, and
    up to 30 KB more for messages of a mebibyte.
    """

    __slots__ = ("_H", "_T", "_T2", "_folds", "_served")

    def __init__(self, H: bytes) -> None:
        self._H = int.from_bytes(H, "big")
        self._T = _multiples(self._H)
        self._T2: list[int] | None = None
        self._folds: dict[int, _Fold] = {}
        self._served = 0

    def __call__(self, data: bytes) -> int:
        """GHASH of `data`, whole blocks."""
        blocks = len(data) // 16
        if self._T2 is None:
            self._served += blocks
            if self._served < _WORTH_MORE:
                return _serial(self._T, data)
            self._T2 = _multiples(_square(self._H))
        for n, least in _FOLDS:
            if blocks >= least:
                data = self._folded(n, data)
                blocks = n
        return _in_pairs(self._T, self._T2, data)

    def _folded(self, n: int, data: bytes) -> bytes:
        fold = self._folds.get(n)
        if fold is None:
            fold = self._folds[n] = _Fold(self._H, n, early=n <= _EARLY)
        folded = b""
        for i in range(0, len(data), _PIECE):
            folded = fold.fold(folded + data[i : i + _PIECE])
        return folded
