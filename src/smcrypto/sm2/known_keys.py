"""Combs for the public keys that are met again: a bounded memory of which keys those are.

With a comb, verifying and encrypting take a fifth to a quarter of the time, but building
one costs as much as several verifications: 3.5 ms for a narrow one, 10 ms for a wide one. So
a key earns them by being used. Only what succeeded counts, so that nobody
makes us build tables for keys that sign nothing. The least recently used go first, and only
for a key that was used more often since than its comb costs: where more keys come than there is
room for, in turn or at random, those that have a comb keep it, and no time goes into combs that
are gone before they have paid. A wider comb takes nobody's place.
"""

from __future__ import annotations

import os
from collections import OrderedDict, deque
from collections.abc import Sequence
from threading import Lock
from typing import Final, TypeAlias

from smcrypto.sm2.curve import Curve, Point
from smcrypto.sm2.points import Comb

__all__ = ["KnownKeys", "known_keys"]

_Key: TypeAlias = tuple[Curve, Point]
_TAKES_A_PLACE: Final = 16  # uses since another key's last one, from which on a key's comb may take the other's place


class _Record:
    """What is known of one key: its uses, when the last were, its comb, the width of the comb that was last begun."""

    __slots__ = ("comb", "recent", "uses", "width")

    def __init__(self) -> None:
        self.comb: Comb | None = None
        self.recent: deque[int] = deque(maxlen=_TAKES_A_PLACE)
        self.uses = self.width = 0


class KnownKeys:
    """Counts uses of public keys and keeps combs for some of them. Safe to use from several threads.

    stages: (uses, width): from so many successful uses on, a comb of that width; ascending, one after the other.
    points: that all combs have together, 0.15 kB each. On SM2's curve a comb of width 5 has 1,664, one of width 8 has
    8,192: so 157 keys have the narrow one, or 32 the wide one, in 40 MB.
    candidates: so many keys that have none are counted, in 1.5 kB each.
    """

    def __init__(
        self, *, stages: Sequence[tuple[int, int]] = ((2, 5), (64, 8)), points: int = 1 << 18, candidates: int = 1024
    ) -> None:
        self._stages = stages
        self._limits = points, candidates
        self._clock = self._points = 0  # uses of all keys; points of all combs
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
            due = next((width for uses, width in self._stages if width > record.width and record.uses >= uses), 0)
            if not due or not self._may_build(record, -(-curve.n.bit_length() // due) << due):
                return record.comb
            record.width = due
        comb = Comb(P, due, curve)
        with self._lock:
            # The record in place is another where this key was put out meanwhile and earned a comb again.
            self._points += _points(comb) - _points(self._known.get(key, record).comb)
            record.comb = comb
            self._candidates.pop(key, None)
            self._known[key] = record
            self._known.move_to_end(key)
            while self._points > self._limits[0] and len(self._known) > 1:
                _, oldest = self._known.popitem(last=False)
                self._points -= _points(oldest.comb)
                oldest.comb = None  # a thread may be building it a wider one at this moment
        return comb

    def _may_build(self, record: _Record, points: int) -> bool:
        """Whether there is room, or (for a first comb) this key was used often since some key with a comb last was."""
        if not self._known or self._points + points <= self._limits[0]:
            return True
        oldest = next(iter(self._known.values()))
        return record.comb is None and len(record.recent) == _TAKES_A_PLACE and record.recent[0] > oldest.recent[-1]

    def used(self, curve: Curve, P: Point) -> None:
        """Count one use of P that succeeded."""
        key = curve, P
        with self._lock:
            record = self._known.get(key)
            if record is None:
                record = self._candidates.setdefault(key, _Record())
                self._candidates.move_to_end(key)
                if len(self._candidates) > self._limits[1]:
                    self._candidates.popitem(last=False)
            record.uses += 1
            self._clock += 1
            record.recent.append(self._clock)


def _points(comb: Comb | None) -> int:
    return 0 if comb is None else sum(map(len, comb.rows))


known_keys: Final = KnownKeys()
"""The memory that verification, encryption and key exchange share."""

if hasattr(os, "register_at_fork"):  # pragma: no branch - not on Windows
    # A child that inherits the lock from a thread that it has not would wait for ever.
    _lock: Final = known_keys._lock
    os.register_at_fork(before=_lock.acquire, after_in_parent=_lock.release, after_in_child=_lock.release)
