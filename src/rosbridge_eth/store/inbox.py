"""The inbox of the blockchain end: what has arrived and is not yet in the journal of the ledger.

This is the protocol that every back end keeps and its vocabulary;
tests/bridge/store/test_inbox_conformance.py says what it means. `now` is the
wall clock in seconds, shared by the processes that use one inbox.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from enum import Enum
from typing import Protocol

from rosbridge_eth.records import RecordId, SealedRecord


class Outcome(Enum):
    """What became of a record that was appended. NEW and DUPLICATE may be acknowledged: it is durable."""

    NEW = "new"
    DUPLICATE = "duplicate"  # the same bytes are here already, or were
    CONFLICT = "conflict"  # this identity is taken by other bytes; these were kept as a dead letter
    FULL = "full"  # not stored: the inbox is at its bound, send again later


class State(Enum):
    """Where a record is, as far as the inbox knows."""

    UNKNOWN = "unknown"  # never arrived, or finished so long ago that it was forgotten
    WAITING = "waiting"
    LEASED = "leased"
    DONE = "done"  # in the ledger's journal
    DEAD = "dead"  # will not be written; see the dead letters


@dataclass(frozen=True, slots=True)
class LeasedRecord:
    """A record given out. arrived: seconds. attempts: how often it was given out, with this time."""

    record: SealedRecord
    arrived: float
    attempts: int


@dataclass(frozen=True, slots=True)
class DeadLetter:
    """A record that will not be written. conflict: its identity belongs to other bytes, whose fate is their own."""

    record: SealedRecord
    conflict: bool
    reason: str
    at: float


@dataclass(frozen=True, slots=True)
class InboxStatistics:
    """waiting + leased is the depth. bytes: ciphertext of these and of dead letters. oldest_age: seconds, or None."""

    waiting: int
    leased: int
    done: int
    dead: int
    bytes: int
    oldest_age: float | None


@dataclass(frozen=True, slots=True)
class InboxLimits:
    """Bounds on what is kept, dead letters included: records, and bytes of ciphertext."""

    records: int = 1_000_000
    bytes: int = 1 << 30


DEFAULT_LIMITS = InboxLimits()


class Inbox(Protocol):
    """Durable, and unique on the identity of a record. Safe for several processes, each with its own object.

    Every method that changes something has committed it when it returns.
    """

    def append(self, records: Sequence[SealedRecord], now: float) -> list[Outcome]:
        """Keep records, all in one commit; one outcome for each, in order."""
        ...

    def lease(
        self, consumer: str, *, limit: int, max_bytes: int, now: float, ttl: float, robot: bytes | None = None
    ) -> list[LeasedRecord]:
        """Give out records of one robot to `consumer` for `ttl` seconds: no one else gets any of that robot meanwhile.

        In order: streams as they first arrived, then seq. At least one record
        even if above `max_bytes` by itself. `robot` (Tk) asks for that one;
        otherwise the robots take turns. Empty if there is nothing to give.
        """
        ...

    def release(self, consumer: str, ids: Iterable[RecordId]) -> None:
        """Give back unfinished what `consumer` leased; others' leases are left alone."""
        ...

    def reclaim(self, consumer: str) -> None:
        """Give back all that `consumer` leased: it has just started, and knows of none that an earlier life took."""
        ...

    def held(self, robot: bytes, limit: int) -> list[SealedRecord]:
        """The first `limit` records of one robot that are not finished, leased or not, in their order."""
        ...

    def done(self, ids: Iterable[RecordId], now: float) -> None:
        """The journal has these: let go of the bytes, remember the identities. Unknown or finished ones: no effect."""
        ...

    def dead_letter(self, ids: Iterable[RecordId], reason: str, now: float) -> None:
        """These can never be written: keep them aside, with the reason. Unknown or finished ones: no effect."""
        ...

    def dead_letters(self, limit: int = 100, *, after: int = 0) -> list[DeadLetter]:
        """The dead letters in order of death, `after` so many."""
        ...

    def state(self, id: RecordId, now: float) -> State: ...

    def statistics(self, now: float) -> InboxStatistics: ...

    def forget(self, done_before: float, limit: int = 10_000) -> int:
        """Forget identities done before that time, at most `limit`; how many. Duplicates of them count as new again."""
        ...

    def close(self) -> None: ...
