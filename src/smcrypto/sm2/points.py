"""Arithmetic in the group of order n: Jacobian coordinates, combs, windows.

Notation: P, Q points; (X, Y, Z) stands for x = X/Z^2, y = Y/Z^3; Z = 0 is infinity,
kept as (0, 1, 0). M, S: a multiplication, a squaring modulo p. All coordinates
are reduced. CPython's `%` costs twice a multiplication, so formulas are arranged
for few reductions; special reduction for the SM2 prime was measured and is slower.

Two kinds of multiples:

* `secret_sum`: scalars are secret. The sequence of operations is the same for all
  scalars: every window holds an odd digit, so none is skipped, and the accumulator
  starts with a random Z, so no intermediate value can be predicted from outside.
  What remains visible is what Python leaves visible: the time of an integer
  multiplication on operands that are random, and *which* table entry is fetched.
* `public_sum`: scalars are public (verification); zeros are skipped.

The odd digits cost no recoding: with C = 2^(wm) - 1 and k' = (k + C)/2 mod n,
whose w-bit windows are b_0 ... b_(m-1),

    k = 2k' - C = sum over i of (2 b_i - (2^w - 1)) 2^(wi)   (mod n),

so window i of k' indexes a table of the odd multiples from -(2^w - 1) to 2^w - 1.

All points here are of prime order n (`curve.require_point`).
"""

from __future__ import annotations

import secrets
from collections.abc import Iterable, Sequence
from functools import lru_cache
from typing import Final, TypeAlias

from smcrypto.sm2.curve import Curve, Point

__all__ = ["INFINITY", "Comb", "Jacobian", "base_comb", "public_sum", "secret_sum", "to_affine"]

Jacobian: TypeAlias = tuple[int, int, int]

INFINITY: Final[Jacobian] = (0, 1, 0)

_WINDOW: Final = 4  # for multiples of a point met for the first time
_NAF_WIDTH: Final = 5
BASE_WINDOW: Final = 8


def double(P: Jacobian, times: int, curve: Curve) -> Jacobian:
    """2^times * P; infinity stays infinity.

    EFD shortw-jacobian-3, dbl-2001-b, 3M + 5S, with Z3 = 2YZ so that one squaring
    is a product but no sum needs reducing; for a != -3 alpha is 3X^2 + aZ^4.
    """
    X, Y, Z = P
    p, a = curve.p, curve.a
    minus_three = a == p - 3
    for _ in range(times):
        delta = Z * Z % p
        gamma = Y * Y % p
        beta = X * gamma % p
        alpha = 3 * (X - delta) * (X + delta) % p if minus_three else (3 * X * X + a * delta * delta) % p
        Z = 2 * Y * Z % p
        X = (alpha * alpha - 8 * beta) % p
        Y = (alpha * (4 * beta - X) - 8 * gamma * gamma) % p
    return X, Y, Z


def add_all(P: Jacobian, addends: Iterable[Point], curve: Curve) -> Jacobian:
    """P plus every affine point of `addends`.

    EFD shortw-jacobian, madd (Z2 = 1), 8M + 3S each. H = 0 where the sum meets +-itself
    or infinity; secret scalars get there with probability 2^-250, tiny curves often.
    """
    X1, Y1, Z1 = P
    p = curve.p
    for x2, y2 in addends:
        ZZ = Z1 * Z1 % p
        H = (x2 * ZZ - X1) % p
        r = (y2 * (Z1 * ZZ % p) - Y1) % p
        if not H:
            if not Z1:
                X1, Y1, Z1 = x2, y2, 1
            elif r:
                X1, Y1, Z1 = INFINITY
            else:
                X1, Y1, Z1 = double((X1, Y1, Z1), 1, curve)
            continue
        HH = H * H % p
        HHH = H * HH % p
        V = X1 * HH % p
        Z1 = Z1 * H % p
        X1 = (r * r - HHH - 2 * V) % p
        Y1 = (r * (V - X1) - Y1 * HHH) % p
    return X1, Y1, Z1


def inverses(values: Sequence[int], p: int) -> list[int]:
    """1/v for each v, none of them 0 modulo p: one inversion and 3M each (Montgomery's trick)."""
    partial, product = [], 1
    for v in values:
        partial.append(product)
        product = product * v % p
    inverse = pow(product, -1, p)
    result = [0] * len(values)
    for i in range(len(values) - 1, -1, -1):
        result[i] = inverse * partial[i] % p
        inverse = inverse * values[i] % p
    return result


def to_affine_all(points: Sequence[Jacobian], curve: Curve) -> list[Point]:
    """The affine form of finite points, with one inversion for all."""
    p = curve.p
    result = []
    for (X, Y, _), z in zip(points, inverses([Z for _, _, Z in points], p), strict=True):
        zz = z * z % p
        result.append((X * zz % p, Y * (z * zz % p) % p))
    return result


def to_affine(P: Jacobian, curve: Curve) -> Point | None:
    """The affine form, None for infinity."""
    return to_affine_all([P], curve)[0] if P[2] else None


def odd_multiples(P: Point, count: int, curve: Curve) -> list[Point]:
    """P, 3P, 5P, ... (`count` of them, 2 * count < n)."""
    if count == 1:
        return [P]
    twice = to_affine_all([double((*P, 1), 1, curve)], curve)
    chain: list[Jacobian] = [(*P, 1)]
    for _ in range(count - 1):
        chain.append(add_all(chain[-1], twice, curve))
    return to_affine_all(chain, curve)


def _mirrored(row: Sequence[Point], p: int) -> list[Point]:
    """From 1P, 3P, ... (2^w - 1)P the table -(2^w - 1)P, ..., -P, P, ..., (2^w - 1)P that k' indexes."""
    return [(x, p - y) for x, y in reversed(row)] + list(row)


def _window_bits(wanted: int, curve: Curve) -> int:
    """The odd multiples below 2^w must be distinct and finite: 2^w < n. Concerns tiny curves."""
    return min(wanted, curve.n.bit_length() - 1)


def _windows(k: int, width: int, curve: Curve) -> list[int]:
    """The windows b_i of k' = (k + 2^(wm) - 1)/2 mod n, least significant first."""
    count = -(-curve.n.bit_length() // width)
    shifted = (k + (1 << width * count) - 1) * ((curve.n + 1) // 2) % curve.n
    mask = (1 << width) - 1
    return [shifted >> i & mask for i in range(0, width * count, width)]


class Comb:
    """Tables for multiples of one point that will be used often: no doublings are left.

    Row i holds the odd multiples of 2^(wi) * P from -(2^w - 1) to 2^w - 1, so k * P
    is a sum of one entry per row. Built with batched affine additions.
    """

    __slots__ = ("curve", "rows", "width")

    def __init__(self, P: Point, width: int, curve: Curve) -> None:
        self.curve = curve
        self.width = width = _window_bits(width, curve)
        count = -(-curve.n.bit_length() // width)
        self.rows = []
        base = P
        for _ in range(count):
            self.rows.append(_mirrored(odd_multiples(base, 1 << (width - 1), curve), curve.p))
            base = to_affine_all([double((*base, 1), width, curve)], curve)[0]

    def entries(self, k: int) -> list[Point]:
        """One point of each row; their sum is k * P."""
        return [row[b] for row, b in zip(self.rows, _windows(k, self.width, self.curve), strict=True)]


@lru_cache(maxsize=8)
def base_comb(curve: Curve) -> Comb:
    """The comb of G, built at its first use (about 10 ms)."""
    return Comb(curve.G, BASE_WINDOW, curve)


def secret_sum(curve: Curve, *terms: tuple[int, Point | Comb]) -> Jacobian:
    """The sum of k * P over all terms (k, P or its comb), 0 <= k < n, by a sequence of steps that no k changes."""
    fixed: list[Point] = []
    tables: list[tuple[list[Point], list[int]]] = []
    width = _window_bits(_WINDOW, curve)
    for k, P in terms:
        if isinstance(P, Comb):
            fixed += P.entries(k)
        else:
            table = _mirrored(odd_multiples(P, 1 << (width - 1), curve), curve.p)
            tables.append((table, _windows(k, width, curve)))
    if not tables:
        return add_all(_randomised(fixed[0], curve), fixed[1:], curve)
    top = [table[windows.pop()] for table, windows in tables]
    total = add_all(_randomised(top[0], curve), top[1:], curve)
    while tables[0][1]:
        total = double(total, width, curve)
        total = add_all(total, [table[windows.pop()] for table, windows in tables], curve)
    return add_all(total, fixed, curve)


def _randomised(P: Point, curve: Curve) -> Jacobian:
    """P with a random Z."""
    p = curve.p
    Z = secrets.randbelow(p - 1) + 1
    ZZ = Z * Z % p
    return P[0] * ZZ % p, P[1] * (ZZ * Z % p) % p, Z


def public_sum(curve: Curve, *terms: tuple[int, Point | Comb]) -> Jacobian:
    """The sum of k * P over all terms, for public k >= 0; its steps depend on every k."""
    result = INFINITY
    for k, P in terms:
        if not isinstance(P, Comb):
            result = add_all(result, [Q for Q in [to_affine(_naf_multiple(k, P, curve), curve)] if Q], curve)
    for k, P in terms:
        if isinstance(P, Comb):
            result = add_all(result, P.entries(k), curve)
    return result


def _naf_multiple(k: int, P: Point, curve: Curve) -> Jacobian:
    result = INFINITY
    for bit in bin(k)[2:]:
        result = double(result, 1, curve)
        if bit == "1":
            result = add_all(result, [P], curve)
    return result
