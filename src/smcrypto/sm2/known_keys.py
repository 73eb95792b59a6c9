"""Combs for the public keys that are met again: a bounded memory of which keys those are.

A comb makes verifying three to four times as fast and costs about as much to build as
eight verifications, so a key earns it by being used: it is built at the third use. Only what
succeeded counts, so that nobody fills the memory with keys that sign nothing.
The least recently used go first.
"""

from __future__ import annotations

from collections import OrderedDict
from threading import Lock
from typing import Final

from smcrypto.sm2.curve import Curve, Point
from smcrypto.sm2.points import Comb

__all__ = ["KnownKeys", "known_keys"]


class KnownKeys:
    """Counts uses of public keys and keeps the combs of up to `combs` of them.

    combs: at most so many combs are kept, about 0.7 MB each.
    candidates: so many keys that have no comb yet are counted.
    uses: a comb is built when this many uses have succeeded.
    Safe to use from several threads.
    """

    def __init__(self, *, combs: int = 32, candidates: int = 1024, uses: int = 2, width: int = 8) -> None:
        self._limits = combs, candidates
        self._uses = uses
        self._width = width
        self._combs: OrderedDict[tuple[Curve, Point], Comb] = OrderedDict()
        self._counts: OrderedDict[tuple[Curve, Point], int] = OrderedDict()
        self._lock = Lock()

    def __len__(self) -> int:
        return len(self._combs)

    def comb(self, curve: Curve, P: Point) -> Comb | None:
        """P's comb if P has earned one."""
        key = curve, P
        with self._lock:
            comb = self._combs.get(key)
            if comb is not None:
                self._combs.move_to_end(key)
                return comb
            if self._counts.get(key, 0) < self._uses:
                return None
            del self._counts[key]
        comb = Comb(P, self._width, curve)
        with self._lock:
            self._combs[key] = comb
            while len(self._combs) > self._limits[0]:
                self._combs.popitem(last=False)
        return comb

    def used(self, curve: Curve, P: Point) -> None:
        """Count one use of P that succeeded."""
        key = curve, P
        with self._lock:
            if key in self._combs:
                return
            self._counts[key] = self._counts.get(key, 0) + 1
            self._counts.move_to_end(key)
            while len(self._counts) > self._limits[1]:
                self._counts.popitem(last=False)


known_keys: Final = KnownKeys()
"""The memory that verification, encryption and key exchange share."""
