"""Combs for the public keys that are met again: a bounded memory of which keys those are.

With a comb, verifying and encrypting take a fifth to a quarter of the time, but building one costs as much as several
verifications: 3.5 ms for a narrow one, 10 ms for a wide one. So a key gets one after about as many uses as it costs.
Only uses that succeeded count, so that nobody makes us build tables for keys that sign nothing. The least recently used
key goes first, and begins anew when it comes back: where more keys take turns than there is room for, building combs
that are soon gone never takes more time than their keys' uses without one did. A wider comb takes nobody's place.
"""

from __future__ import annotations

import os
import sys
from collections import OrderedDict
from collections.abc import Sequence
from dataclasses import dataclass
from threading import Lock
from typing import Final

from smcrypto.sm2.curve import Curve, Point
from smcrypto.sm2.points import Comb

__all__ = ["KnownKeys", "known_keys"]


@dataclass(slots=True)
class _Record:
    uses: int = 0
    width: int = 0  # of the comb that was last begun
    comb: Comb | None = None

    def points(self) -> int:
        return 0 if self.comb is None else sum(map(len, self.comb.rows))


class KnownKeys:
    """Counts uses of public keys and keeps combs for some of them. Safe to use from several threads.

    stages: (uses, width): from so many successful uses on, a comb of that width; ascending, one after the other.
    points: that all combs have together, 0.15 kB each. On SM2's curve a comb of width 5 has 1,664, one of width 8 has
    8,192: so 157 keys have the narrow one, or 32 the wide one, in 40 MB.
    keys: so many are counted, in 0.5 kB each.
    """

    def __init__(
        self, *, stages: Sequence[tuple[int, int]] = ((5, 5), (64, 8)), points: int = 1 << 18, keys: int = 1024
    ) -> None:
        self._stages, self._limits = stages, (points, keys)
        self._points = 0  # of all combs
        self._records: OrderedDict[tuple[Curve, Point], _Record] = OrderedDict()
        self._lock = Lock()

    def comb(self, curve: Curve, P: Point) -> Comb | None:
        """P's comb if P has earned one. Who finds it due builds it; others go on without meanwhile, or with the old."""
        with self._lock:
            record = self._records.get((curve, P), _Record())
            room = self._limits[0] - self._points + record.points() if record.comb else sys.maxsize
            bits = curve.n.bit_length()
            fits = [w for uses, w in self._stages if record.uses >= uses and -(-bits // w) << w <= room]
            due = max(fits, default=0)
            if due <= record.width:
                return record.comb
            record.width = due
        comb = Comb(P, due, curve)
        with self._lock:
            if self._records.get((curve, P)) is record:  # it may have gone meanwhile
                self._points -= record.points()
                record.comb = comb
                self._points += record.points()
                self._records.move_to_end((curve, P))
                self._shrink()
        return comb

    def used(self, curve: Curve, P: Point) -> None:
        """Count one use of P that succeeded."""
        with self._lock:
            record = self._records.setdefault((curve, P), _Record())
            self._records.move_to_end((curve, P))
            record.uses += 1
            self._shrink()

    def _shrink(self) -> None:
        points, keys = self._limits
        while len(self._records) > keys or self._points > points:
            self._points -= self._records.popitem(last=False)[1].points()


known_keys: Final = KnownKeys()
"""The memory that verification, encryption and key exchange share."""

if hasattr(os, "register_at_fork"):  # pragma: no branch - not on Windows
    # A child that inherits the lock from a thread that it has not would wait for ever.
    _lock: Final = known_keys._lock
    os.register_at_fork(before=_lock.acquire, after_in_parent=_lock.release, after_in_child=_lock.release)
