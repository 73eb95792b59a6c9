"""Combs for the public keys that are met again: a bounded memory of which keys those are.

With a comb, verifying and encrypting take a fifth to a quarter of the time, but building
one costs as much as several verifications: 3.5 ms for a narrow one, 10 ms for a wide one. So
a key earns them by being used. Only what succeeded counts, so that nobody
makes us build tables for keys that sign nothing. The least recently used go first.
"""

from __future__ import annotations

from collections import OrderedDict
from collections.abc import Sequence
from threading import Lock
from typing import Final, TypeAlias

from smcrypto.sm2.curve import Curve, Point
from smcrypto.sm2.points import Comb

__all__ = ["KnownKeys", "known_keys"]

_Key: TypeAlias = tuple[Curve, Point]


class _Record:
    """What is known of one key: its uses, the comb, and the width of the comb that was last begun."""

    __slots__ = ("comb", "uses", "width")

    def __init__(self) -> None:
        self.comb: Comb | None = None
        self.uses = 0
        self.width = 0


class KnownKeys:
    """Counts uses of public keys and keeps combs for some of them. Safe to use from several threads.

    stages: (uses, width): from so many successful uses on, a comb of that width; ascending.
    combs: at most so many keys have one; 0.6 MB each at width 8.
    candidates: so many keys that have none are counted.
    """

    def __init__(
        self, *, stages: Sequence[tuple[int, int]] = ((2, 5), (64, 8)), combs: int = 32, candidates: int = 1024
    ) -> None:
        self._stages = stages
        self._limits = combs, candidates
        self._known: OrderedDict[_Key, _Record] = OrderedDict()
        self._candidates: OrderedDict[_Key, _Record] = OrderedDict()
        self._lock = Lock()

    def __len__(self) -> int:
        """The number of keys that have a comb."""
        return len(self._known)

    def comb(self, curve: Curve, P: Point) -> Comb | None:
        """P's comb if P has earned one. Who finds it due builds it; others go on without meanwhile, or with the old."""
        key = curve, P
        with self._lock:
            record = self._known.get(key) or self._candidates.get(key)
            if record is None:
                return None
            if record.comb is not None:
                self._known.move_to_end(key)
            due = max((width for uses, width in self._stages if record.uses >= uses), default=0)
            if record.width >= due:
                return record.comb
            record.width = due
        comb = Comb(P, due, curve)
        with self._lock:
            record.comb = comb
            self._candidates.pop(key, None)
            self._known[key] = record
            self._known.move_to_end(key)
            _shorten(self._known, self._limits[0])
        return comb

    def used(self, curve: Curve, P: Point) -> None:
        """Count one use of P that succeeded."""
        key = curve, P
        with self._lock:
            record = self._known.get(key)
            if record is None:
                record = self._candidates.setdefault(key, _Record())
                self._candidates.move_to_end(key)
                _shorten(self._candidates, self._limits[1])
            record.uses += 1


def _shorten(records: OrderedDict[_Key, _Record], limit: int) -> None:
    while len(records) > limit:
        records.popitem(last=False)


known_keys: Final = KnownKeys()
"""The memory that verification, encryption and key exchange share."""
