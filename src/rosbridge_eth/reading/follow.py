"""Following: the same reading asked again when the chain has come on, of which only what is new is given.

Nothing is remembered of the chain but what the reading before ended with. A reading goes on behind it where the chain
is the same up to there; where it is not (a reorganisation), or a node failed in the middle, it starts again.

Not here: waiting, and what is made of the records.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from typing import TYPE_CHECKING, Final

from rosbridge_eth.errors import ChainError, IdentityError
from rosbridge_eth.reading.fetch import Reading
from rosbridge_eth.reading.verdict import Bookmarks, Kind, shown
from rosbridge_eth.reading.verify import Choice, ProvenRecord

if TYPE_CHECKING:
    from rosbridge_eth.ledger.contract import Ledger

EVERY: Final = 1.0
"""Seconds between two looks at the nodes' newest block."""


class Followed:
    """A robot's log. reading: the newest that came to its end. trouble: why the one after it did not, or nothing.

    read: fetch.read_robot, told everything but `now` and `before`. confirm: as Reading.keep, for the first reading:
    whoever looks at a certificate that is registered later was not there yet.
    """

    def __init__(self, name: str, read: Callable[..., Reading], bookmarks: Bookmarks, *, confirm: bool = False) -> None:
        self.name, self.trouble = name, ""
        self._read, self._bookmarks, self._confirm = read, bookmarks, confirm
        self.reading: Reading | None = None
        self._before: Reading | None = None  # to go on behind
        self._given = 0
        self._told: set[tuple[Kind, str]] | None = None  # until it was told how it stands
        self._told_trouble = ""

    def new(self, choice: Choice, now: float) -> Iterator[ProvenRecord]:
        """The records that were not given before. What is behind chunks that a node withholds comes after those."""
        try:
            reading = self._read(self.name, now=now, before=self._before)
        except IdentityError as error:
            if self.reading is None:
                raise
            raise ChainError(f"the node is behind, or of another chain: {error}") from error
        self._before = None  # it is used up, also where this one ends in the middle
        try:
            for record in reading.records(choice, self._given):
                if reading.verifier.shown_all:
                    self._given = record.place.chunk + 1
                    yield record
        finally:
            reading.close()
        if reading.verifier.shown_all:
            self._given = max(self._given, reading.verdict().chunks)
        reading.keep(self._bookmarks, confirm=self._confirm)
        self.reading = self._before = reading
        self._confirm = False

    def news(self) -> Iterator[str]:
        """For a person who looks on: how it stands after the first reading, then each trouble and finding once."""
        if self.trouble != self._told_trouble:
            yield f"{self.name}: {self.trouble}; it is asked again" if self.trouble else f"{self.name}: read on"
        self._told_trouble = self.trouble
        if self.reading is not None:
            verdict = self.reading.verdict()
            if self._told is None:
                self._told = set()
                yield next(verdict.lines())
            for found in verdict.findings:
                if (found.kind, found.detail) not in self._told:
                    yield f"{self.name}: {found}"
                    self._told.add((found.kind, found.detail))


class Following:
    """Robots that are followed on the same nodes."""

    def __init__(self, robots: Sequence[Followed], ledgers: Sequence[Ledger]) -> None:
        self.robots, self._ledgers, self._heads = robots, ledgers, list[bytes | str]()

    def new(self, choice: Choice, clock: Callable[[], float] = time.time) -> Iterator[tuple[str, ProvenRecord]]:
        """One look: of each robot what is new, where a node has another block than at the look before."""
        heads = [_head(ledger) for ledger in self._ledgers]
        if heads == self._heads:
            return
        self._heads = heads
        for robot in self.robots:
            try:
                for record in robot.new(choice, clock()):
                    yield robot.name, record
                robot.trouble = ""
            except ChainError as error:
                robot.trouble = shown(str(error), 300)
                if any(isinstance(head, bytes) for head in heads):
                    self._heads = []  # to be asked again without a new block

    def news(self) -> Iterator[str]:
        for robot in self.robots:
            yield from robot.news()


def _head(ledger: Ledger) -> bytes | str:
    """The hash of the node's newest block, or in its place what is wrong with the node."""
    try:
        return ledger.block().hash
    except ChainError as error:
        return str(error)
