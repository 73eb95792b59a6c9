"""A store in memory, for tests of who uses one: the rule of log/store.py in few lines, and copies to put back."""

from __future__ import annotations

import copy
from bisect import insort
from collections.abc import Collection, Sequence
from typing import Any

from eth_hash.auto import keccak

from rosbridge_eth.errors import StoreError
from rosbridge_eth.log.store import NOWHERE, DeadLetter, Offer, Outcome, Row, State, Store, Waiting, place_of


class MemoryStore(Store):
    def __init__(self, max_bytes: int = 10**9, max_bytes_per_robot: int = 10**8) -> None:
        self.max_bytes, self.max_bytes_per_robot = max_bytes, max_bytes_per_robot
        self._states: dict[bytes, State] = {}
        self._rows: dict[bytes, list[tuple[Row, bytes]]] = {}  # by place
        self._dead: list[DeadLetter] = []
        self.calls = 0

    def copy(self) -> MemoryStore:
        return copy.deepcopy(self)

    def put_back(self, other: MemoryStore) -> None:
        """As a restore of the database's file under those who use it."""
        self._states, self._rows, self._dead = copy.deepcopy((other._states, other._rows, other._dead))

    def append(self, offers: Sequence[Offer], now: float) -> list[Outcome]:
        self.calls += 1
        return [self._append(offer, now) for offer in offers]

    def _append(self, offer: Offer, now: float) -> Outcome:
        tk, (header, encoded) = offer.tk, (offer.chunk.header, offer.chunk.encoded)
        state, place, rows = self._states.get(tk, State()), place_of(header), self._rows.setdefault(tk, [])
        there = next((row for row, _ in rows if row.place == place), None)
        if there is not None or place == state.head:
            same = header.digest == (there.digest if there else state.digest)
            if not same:
                return Outcome.DIFFERENT
            if place > state.head and (offer.oldest or header.previous == state.digest):
                self._states[tk] = state._replace(head=place, digest=header.digest)
            return Outcome.KNOWN if place <= self._states[tk].head else Outcome.NOT_NEXT
        if place < state.head:
            return Outcome.KNOWN if not rows or place < rows[0][0].place else Outcome.DIFFERENT
        if header.previous != state.digest and not offer.oldest:
            return Outcome.NOT_NEXT
        if header.previous != state.digest and self.has(tk, header.previous):
            return Outcome.DIFFERENT
        if sum(row.size for row, _ in rows) + len(encoded) > self.max_bytes_per_robot:
            return Outcome.FULL
        insort(rows, (Row(place, header.digest, keccak(encoded), len(encoded), header.records, now), encoded))
        self._states[tk] = state._replace(head=place, digest=header.digest)
        return Outcome.STORED

    def states(self, tks: Sequence[bytes]) -> list[State]:
        return [self._states.get(tk, State()) for tk in tks]

    def set_state(self, tk: bytes, **changes: Any) -> None:
        self.calls += 1
        self._states[tk] = self._states.get(tk, State())._replace(**changes)

    def find(self, tk: bytes, hash: bytes) -> bytes | None:
        self.calls += 1
        return next((row.place for row, _ in self._rows.get(tk, ()) if row.hash == hash), None)

    def has(self, tk: bytes, digest: bytes) -> bool:
        return any(row.digest == digest for row, _ in self._rows.get(tk, ()))

    def rows(self, tk: bytes, after: bytes, limit: int) -> list[Row]:
        self.calls += 1
        return [row for row, _ in self._rows.get(tk, ()) if row.place > after][:limit]

    def chunks(self, tk: bytes, places: Sequence[bytes]) -> list[bytes]:
        here = {row.place: encoded for row, encoded in self._rows.get(tk, ())}
        if not here.keys() >= set(places):
            raise StoreError("a chunk is not there any more")
        return [here[place] for place in places]

    def remove(self, tk: bytes, places: Collection[bytes], why: str = "") -> None:
        rows = self._rows.get(tk, [])
        self._dead += [DeadLetter(tk, why, row.taken_at, e) for row, e in rows if why and row.place in places]
        self._rows[tk] = [entry for entry in rows if entry[0].place not in places]

    def sizes(self) -> dict[bytes, int]:
        return {tk: sum(row.size for row, _ in self._rows.get(tk, ())) for tk in self._states.keys() | self._rows}

    def waiting(self, tk: bytes) -> Waiting:
        [state] = self.states([tk])
        rows = self.rows(tk, state.confirmed, 10**9)
        return Waiting(len(rows), sum(row.records for row in rows), sum(row.size for row in rows),
                       min((row.taken_at for row in rows), default=None))  # fmt: skip

    def dead(self, limit: int = 100) -> list[DeadLetter]:
        return self._dead[::-1][:limit]

    def check(self) -> None:
        pass

    def close(self) -> None:
        pass


__all__ = ["NOWHERE", "MemoryStore"]
