"""Arithmetic in the group of order n: Jacobian coordinates, windows, combs.

Notation: P, Q points, (x, y) affine; M, S a multiplication, a squaring modulo p.
Jacobian (X, Y, Z) stands for x = X/Z^2, y = Y/Z^3, and extended (X, Y, ZZ, ZZZ) holds
Z^2 and Z^3 in place of Z, which makes additions cheaper and doublings dearer. Infinity
has Z = 0 and is kept as (0, 1, 0). Coordinates are reduced.

CPython needs about 85 ns for a product of 256-bit integers and 160 ns for `% p`, so
formulas are chosen and arranged for few reductions. (Folding by the shape of the SM2
prime, and Montgomery's form, take 240 ns and more in Python.) An inversion costs
10 us, `pow(x, -1, p)`.

Two kinds of sums of multiples:

* `secret_sum`: scalars are secret. The sequence of operations is the same for all
  of them: every window holds an odd digit, so no addition is skipped, and the sum
  begins with a random Z, so nobody can predict the numbers it goes through. What
  stays visible is *which* entry of a table is read, to who shares the caches.
* `public_sum`: scalars are public (verification); zero digits are skipped.

The odd digits need no recoding. With C = 2^(wm) - 1 and k' = (k + C)/2 mod n,
whose w-bit windows are b_0 ... b_(m-1),

    k = 2k' - C = sum over i of (2 b_i - (2^w - 1)) 2^(wi)   (mod n),

so window i of k' indexes a table of the odd multiples from -(2^w - 1) to 2^w - 1.

All points here are of prime order n > 4 (`curve.require_point`).

Where the package `gmpy2` is installed (extra `fast`), its integers, GMP's, take the place of Python's once the process
has computed some dozens of sums: see `_calculating`. A product and its reduction take a third of the time then.
"""

from __future__ import annotations

import secrets
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from functools import lru_cache
from typing import Final, TypeAlias

from smcrypto.optional import OptionalEngine
from smcrypto.sm2.curve import Curve, Point

__all__ = ["ENGINE", "Comb", "Extended", "base_comb", "public_sum", "secret_sum", "to_affine", "to_affine_all"]

Jacobian: TypeAlias = tuple[int, int, int]
Extended: TypeAlias = tuple[int, int, int, int]

_INFINITY: Final[Jacobian] = (0, 1, 0)

# Window widths for 256 bits, measured. One more bit: _SECRET and _NAF lose as much by the larger table as
# they save in additions; _BASE saves 9 us of 110 at each signature and costs 12 ms at the first.
_SECRET_WINDOW: Final = 5
_NAF_WINDOW: Final = 5
_BASE_WINDOW: Final = 9


def _load() -> Callable[[int], int] | None:
    try:
        from gmpy2 import mpz
    except ImportError:
        return None
    number: Callable[[int], int] = mpz
    return number


ENGINE: Final = OptionalEngine("gmpy2", _load, 64)  # sums: the import takes 33 ms, and each saves some 0.5


@lru_cache(maxsize=8)
def _converted(curve: Curve, number: Callable[[int], int]) -> Curve:
    return replace(curve, p=number(curve.p), a=number(curve.a))


def _calculating(curve: Curve) -> Curve:
    """The same curve, its p and a of the engine's integers: whatever is reduced modulo this p becomes one as well."""
    number = ENGINE.after(1)
    return curve if number is None else _converted(curve, number)


def walk(P: Jacobian, steps: Iterable[tuple[int, Sequence[Point]]], curve: Curve) -> Jacobian:
    """Horner's rule: for each (times, addends) in turn, P becomes 2^times * P plus the addends.

    Doubling, 3M + 5S and 7 reductions: EFD shortw-jacobian-3, dbl-2001-b, carried in
    T = 2Y from step to step; with B = T^2 = 4Y^2 and C = BX = 4XY^2 few small factors are left.
    A run ends by halving T without a branch. For a != -3, alpha is 3X^2 + aZ^4.

    Addition, 8M + 3S and 10 reductions: the textbook mixed one. H = 0 where P is infinite
    or meets +-the addend: on tiny curves often, with secret scalars at random never (2^-250).

    One loop for both: a call for each would cost as much as half a field multiplication.
    """
    X, Y, Z = P
    p, a = curve.p, curve.a
    minus_three = a == p - 3
    for times, addends in steps:
        if times:
            T = 2 * Y
            for _ in range(times):
                ZZ = Z * Z % p
                B = T * T % p
                C = B * X % p
                alpha = (3 * (X - ZZ) * (X + ZZ) if minus_three else 3 * X * X + a * (ZZ * ZZ % p)) % p
                Z = T * Z % p
                X = (alpha * alpha - C - C) % p
                T = ((alpha + alpha) * (C - X) - B * B) % p
            Y = T + (T & 1) * p >> 1
        for x2, y2 in addends:
            ZZ = Z * Z % p
            H = (x2 * ZZ - X) % p
            r = (y2 * (Z * ZZ % p) - Y) % p
            if not H:
                X, Y, Z = _add_with_equal_x(Z, r, (x2, y2), curve)
                continue
            HH = H * H % p
            HHH = H * HH % p
            V = X * HH % p
            Z = Z * H % p
            X = (r * r - HHH - V - V) % p
            Y = (r * (V - X) - Y * HHH) % p
    return X, Y, Z


def _add_with_equal_x(Z: int, r: int, Q: Point, curve: Curve) -> Jacobian:
    """The addition of Q to (X, Y, Z) where H = 0: to infinity, to itself (r = 0) or to its negative."""
    if not Z:
        return *Q, 1
    return double((*Q, 1), curve) if not r else _INFINITY


def double(P: Jacobian, curve: Curve) -> Jacobian:
    """2P."""
    return walk(P, [(1, ())], curve)


def extended(P: Jacobian, curve: Curve) -> Extended:
    """The same point with Z^2 and Z^3 in place of Z."""
    X, Y, Z = P
    ZZ = Z * Z % curve.p
    return X, Y, ZZ, Z * ZZ % curve.p


def add_all(P: Extended, addends: Iterable[Point], curve: Curve) -> Extended:
    """P plus every addend, where no doublings come between. 8M + 2S, 9 reductions: EFD shortw-xyzz, madd-2008-s."""
    X, Y, ZZ, ZZZ = P
    p = curve.p
    for x2, y2 in addends:
        H = (x2 * ZZ - X) % p
        r = (y2 * ZZZ - Y) % p
        if not H:
            X, Y, ZZ, ZZZ = extended(_add_with_equal_x(ZZ, r, (x2, y2), curve), curve)
            continue
        HH = H * H % p
        HHH = H * HH % p
        V = X * HH % p
        X = (r * r - HHH - V - V) % p
        Y = (r * (V - X) - Y * HHH) % p
        ZZ = ZZ * HH % p
        ZZZ = ZZZ * HHH % p
    return X, Y, ZZ, ZZZ


def inverses(values: Sequence[int], p: int) -> list[int]:
    """1/v for each v, none of them 0 modulo p: one inversion and 3M each (Montgomery's trick)."""
    products, product = [], 1
    for v in values:
        products.append(product)
        product = product * v % p
    inverse = pow(product, -1, p)
    result = []
    for v, before in zip(reversed(values), reversed(products), strict=True):
        result.append(inverse * before % p)
        inverse = inverse * v % p
    result.reverse()
    return result


def to_affine_all(points: Sequence[Extended], curve: Curve) -> list[Point]:
    """The affine form of finite points, in Python's integers, with one inversion for all."""
    p = curve.p
    result = []
    for (X, Y, ZZ, _), cube in zip(points, inverses([P[3] for P in points], p), strict=True):
        z = ZZ * cube % p  # 1/Z
        result.append((int(X * (z * z % p) % p), int(Y * cube % p)))
    return result


def to_affine(P: Extended, curve: Curve) -> Point | None:
    """The affine form, None for infinity."""
    return to_affine_all([P], curve)[0] if P[2] else None


def odd_multiples(P: Point, count: int, curve: Curve) -> list[Point]:
    """P, 3P, 5P, ..., `count` of them; 2 * count < n. One inversion for all, and 9M + 3S each.

    Co-Z addition (Meloni, "New point addition formulae for ECC applications", 2007): 2P and
    the last multiple have the same Z; their sum costs 5M + 2S and gives 2P with the sum's Z
    as well. Each Z is the one before times a gap, so one inversion and the gaps give all 1/Z.
    """
    p = curve.p
    x, y = P
    # 2P with Z = 2y, and P with the same Z: (4xy^2, 8y^4).
    yy = y * y % p
    X2, Y2 = 4 * x * yy % p, 8 * yy * yy % p
    slope = (3 * x * x + curve.a) % p
    X1 = (slope * slope - 2 * X2) % p
    Y1 = (slope * (X2 - X1) - Y2) % p
    Z = 2 * y
    found, gaps = [(X2, Y2)], [Z]
    for _ in range(count - 1):
        gap = X1 - X2
        square = gap * gap % p
        W1, W2 = X1 * square % p, X2 * square % p
        rise = Y1 - Y2
        A = Y1 * (W1 - W2) % p
        X2 = (rise * rise - W1 - W2) % p
        Y2 = (rise * (W1 - X2) - A) % p
        X1, Y1 = W1, A
        Z = Z * gap % p
        found.append((X2, Y2))
        gaps.append(gap)
    z = pow(Z, -1, p)
    result = []
    for (X, Y), gap in zip(reversed(found), reversed(gaps), strict=True):
        zz = z * z % p
        result.append((X * zz % p, Y * (z * zz % p) % p))
        z = z * gap % p
    result.reverse()
    return result


def sums_and_differences(pairs: Sequence[tuple[Point, Point]], curve: Curve) -> list[tuple[Point, Point]]:
    """(P + Q, P - Q) for each pair, P != +-Q: affine additions that share one inversion, 4.5M each."""
    p = curve.p
    result = []
    for ((x1, y1), (x2, y2)), inverse in zip(pairs, inverses([Q[0] - P[0] for P, Q in pairs], p), strict=True):
        slope = (y2 - y1) * inverse % p
        other = (-y2 - y1) * inverse % p
        x3 = (slope * slope - x1 - x2) % p
        x4 = (other * other - x1 - x2) % p
        result.append(((x3, (slope * (x1 - x3) - y1) % p), (x4, (other * (x1 - x4) - y1) % p)))
    return result


def _mirrored(row: Sequence[Point], p: int) -> list[Point]:
    """From P, 3P, ..., (2^w - 1)P the table -(2^w - 1)P, ..., -P, P, ..., (2^w - 1)P."""
    return [(x, p - y) for x, y in reversed(row)] + list(row)


def _window_bits(wanted: int, curve: Curve) -> int:
    """The odd multiples below 2^w must be distinct and finite, so 2^w < n. Matters on tiny curves."""
    return min(wanted, curve.n.bit_length() - 1)


def _windows(k: int, width: int, curve: Curve) -> list[int]:
    """The windows b_i of k' = (k + 2^(wm) - 1)/2 mod n, least significant first."""
    count = -(-curve.n.bit_length() // width)
    shifted = (k + (1 << width * count) - 1) * ((curve.n + 1) // 2) % curve.n
    mask = (1 << width) - 1
    return [shifted >> i & mask for i in range(0, width * count, width)]


class Comb:
    """Tables for a point that is multiplied often: no doublings are left, one addition a row.

    Row i holds the odd multiples of 2^(wi) P from -(2^w - 1) to 2^w - 1. For 256 bits:
    w = 8, 32 rows, 10 ms to build, 0.6 MB; w = 9, 29 rows, 16 ms, 1 MB.
    """

    __slots__ = ("curve", "rows", "width")

    def __init__(self, P: Point, width: int, curve: Curve) -> None:
        self.curve = curve
        curve = _calculating(curve)
        self.width = width = _window_bits(width, curve)
        count = -(-curve.n.bit_length() // width)
        chain: list[Jacobian] = [(*P, 1)]
        for _ in range(width * count - 1):
            chain.append(double(chain[-1], curve))
        powers = to_affine_all([extended(Q, curve) for Q in chain], curve)  # 2^j P
        rows = [[B] for B in powers[::width]]
        for j in range(1, width):
            # The odd multiples from 2^j to 2^(j+1) lie around c = 3 * 2^(j-1): c +- those below 2^(j-1); and 3 is c.
            doubles = zip(powers[j::width], powers[j - 1 :: width], strict=True)
            centres = [c for c, _ in sums_and_differences(list(doubles), curve)]
            near = (1 << j) // 4
            pairs = [(c, Q) for c, row in zip(centres, rows, strict=True) for Q in row[:near]]
            found = sums_and_differences(pairs, curve)
            for i, row in enumerate(rows):
                both = found[i * near : (i + 1) * near]
                row += [minus for _, minus in reversed(both)]
                row += [centres[i]] if j == 1 else []
                row += [plus for plus, _ in both]
        self.rows = [_mirrored(row, curve.p) for row in rows]

    def entries(self, k: int) -> list[Point]:
        """One point of each row; their sum is [k]P."""
        return [row[b] for row, b in zip(self.rows, _windows(k, self.width, self.curve), strict=True)]


@lru_cache(maxsize=8)
def base_comb(curve: Curve) -> Comb:
    """The comb of G, built when it is first used and shared by all keys."""
    return Comb(curve.G, _BASE_WINDOW, curve)


def secret_sum(curve: Curve, *terms: tuple[int, Point | Comb]) -> Extended:
    """The sum of [k]P over the terms (k, P or P's comb), 0 <= k < n, in steps that do not depend on any k."""
    curve = _calculating(curve)
    width = _window_bits(_SECRET_WINDOW, curve)
    combed: list[Point] = []
    walked: list[list[Point]] = []
    for k, P in terms:
        if isinstance(P, Comb):
            combed += P.entries(k)
        else:
            table = _mirrored(odd_multiples(P, 1 << (width - 1), curve), curve.p)
            walked.append([table[b] for b in _windows(k, width, curve)])
    if not walked:
        return add_all(extended(_randomised(combed[0], curve), curve), combed[1:], curve)
    (first, *others), *columns = reversed(list(zip(*walked, strict=True)))
    steps = [(0, others), *((width, column) for column in columns)]
    return add_all(extended(walk(_randomised(first, curve), steps, curve), curve), combed, curve)


def _randomised(P: Point, curve: Curve) -> Jacobian:
    """P with a Z drawn anew: what is computed from it are numbers that nobody can predict."""
    p = curve.p
    Z = secrets.randbelow(p - 1) + 1
    ZZ = Z * Z % p
    return P[0] * ZZ % p, P[1] * (ZZ * Z % p) % p, Z


def public_sum(curve: Curve, *terms: tuple[int, Point | Comb]) -> Extended:
    """The same sum for public scalars: its steps depend on them. At most one term without a comb."""
    curve = _calculating(curve)
    combed: list[Point] = []
    start = _INFINITY
    for k, P in terms:
        if isinstance(P, Comb):
            combed += P.entries(k)
        else:
            start = naf_multiple(k, P, curve)
    return add_all(extended(start, curve), combed, curve)


def naf_multiple(k: int, P: Point, curve: Curve) -> Jacobian:
    """[k]P by the width-w non-adjacent form (Guide to Elliptic Curve Cryptography, algorithms 3.35 and 3.36).

    For public k >= 0: the steps depend on it.
    """
    width = _window_bits(_NAF_WINDOW, curve)
    table = odd_multiples(P, 1 << (width - 2), curve)
    p, full, mask = curve.p, 1 << width, (1 << width) - 1
    steps: list[tuple[int, list[Point]]] = []  # k = 2^z0 (d0 + 2^z1 (d1 + ...)), from the right
    addend: list[Point] = []
    while k:
        zeros = (k & -k).bit_length() - 1
        steps.append((zeros, addend))
        k >>= zeros
        digit = k & mask
        if digit > full >> 1:
            digit -= full
        k -= digit
        x, y = table[abs(digit) >> 1]
        addend = [(x, y if digit > 0 else p - y)]
    steps.append((0, addend))
    return walk(_INFINITY, reversed(steps), curve)
