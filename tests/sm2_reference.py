"""Plain elliptic curve arithmetic by the definition, and curves to run it on: the oracle of the SM2 tests.

Affine coordinates, None for infinity, one inversion for each addition, double
and add. Nothing here is shared with the library but the Curve type.
"""

from __future__ import annotations

import json

from smcrypto.sm2.curve import SM2P256V1, Curve, Point
from vectors_json import STANDARDS


def add(P: Point | None, Q: Point | None, curve: Curve) -> Point | None:
    if P is None:
        return Q
    if Q is None:
        return P
    p = curve.p
    if P[0] == Q[0]:
        if (P[1] + Q[1]) % p == 0:
            return None
        slope = (3 * P[0] ** 2 + curve.a) * pow(2 * P[1], -1, p)
    else:
        slope = (Q[1] - P[1]) * pow(Q[0] - P[0], -1, p)
    x = (slope * slope - P[0] - Q[0]) % p
    return x, (slope * (P[0] - x) - P[1]) % p


def multiple(k: int, P: Point | None, curve: Curve) -> Point | None:
    result = None
    for bit in bin(k)[2:]:
        result = add(result, result, curve)
        if bit == "1":
            result = add(result, P, curve)
    return result


def points(curve: Curve) -> list[Point]:
    """All finite points, by trying."""
    p = curve.p
    return [(x, y) for x in range(p) for y in range(p) if (y * y - x**3 - curve.a * x - curve.b) % p == 0]


def _tiny(p: int, a: int, b: int, G: Point, n: int) -> Curve:
    return Curve(name=f"tiny, p = {p}, n = {n}", p=p, a=a % p, b=b, n=n, G=G)


# Orders counted by trying all x, y (test_curve does it again). a = -3 and not; n below p and above it.
TINY_17 = _tiny(11, -3, 1, (0, 1), 17)
TINY_61 = _tiny(67, 2, 18, (1, 17), 61)
TINY_79 = _tiny(67, -3, 36, (0, 6), 79)
TINY_1009 = _tiny(1031, -3, 63, (2, 257), 1009)
TINY = (TINY_17, TINY_61, TINY_79, TINY_1009)

_sample = {
    name: int(value, 16) if isinstance(value, str) and name != "name" else value
    for name, value in json.loads((STANDARDS / "sm2_sign.json").read_text())["curves"]["sample"].items()
}
SAMPLE = Curve(
    name=_sample["name"],
    p=_sample["p"],
    a=_sample["a"],
    b=_sample["b"],
    n=_sample["n"],
    G=(_sample["gx"], _sample["gy"]),
)
CURVES = {"sm2p256v1": SM2P256V1, SAMPLE.name: SAMPLE}


def number(data: bytes) -> int:
    return int.from_bytes(data, "big")
