"""Combs for the public keys that are used again and again."""

from __future__ import annotations

from smcrypto.sm2.curve import Curve, Point
from smcrypto.sm2.points import Comb

__all__ = ["comb_if_known", "saw"]


def comb_if_known(curve: Curve, P: Point) -> Comb | None:
    return None


def saw(curve: Curve, P: Point) -> None:
    pass
