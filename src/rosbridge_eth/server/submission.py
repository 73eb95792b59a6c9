"""From the inbox to the chain: lease, batch, journal, submit, acknowledge. One such process acts for a store.

A record leaves the inbox when the journal has it on disk, and not before: a
crash between the two leaves a lease, which the next life under the same name
takes back at its start, and which runs out otherwise; the journal recognises
what it has already.
"""

from __future__ import annotations

import logging
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from rosbridge_eth.errors import StoreError
from rosbridge_eth.ledger.batching import Batcher, Limits, refusal
from rosbridge_eth.ledger.chain import Chain
from rosbridge_eth.ledger.pump import pump
from rosbridge_eth.ledger.submitter import BatchTiming, Status, Submitter
from rosbridge_eth.records import RecordId, SealedRecord
from rosbridge_eth.store import Inbox, LeasedRecord

log = logging.getLogger(__name__)

LEASE = 60.0  # seconds; many times a batch's age
LEASE_RECORDS = 512
LEASE_BYTES = 1 << 20
GATHER_RECORDS = 4096  # held in open batches at most: with many robots that say little, a few from each
GATHER_BYTES = 8 << 20  # taken over in one turn at most
MAX_BACKLOG = 256  # batches on their way, above which the inbox keeps the rest; some 24 MiB at most
FORGET_EVERY = 3600.0
SHORTEST_PAUSE, LONGEST_PAUSE = 0.005, 0.5


def steady_clock() -> Callable[[], float]:
    """The wall clock as it is now, counted on by the monotonic one: seconds since 1970 that do not jump.

    Ages of batches, pauses and leases are differences of these times; a wall
    clock that is set back would make each of them wait as long.
    """
    offset = time.time() - time.monotonic()
    return lambda: offset + time.monotonic()


class Submission:
    """Moves records from an inbox to a chain. `now` is in seconds since 1970, as in the inbox."""

    def __init__(
        self,
        inbox: Inbox,
        submitter: Submitter,
        chain: Chain,
        *,
        limits: Limits,
        holder: str,
        keep_batches: float,
        remember: float,
        prune: Callable[[float], int],
        on_confirmed: Callable[[BatchTiming], None] = lambda timing: None,
    ) -> None:
        self._inbox, self._submitter, self._chain = inbox, submitter, chain
        self._limits, self._batcher, self._holder = limits, Batcher(limits), holder
        self._keep_batches, self._prune, self._remember = keep_batches, prune, remember
        self._forget_at = 0.0
        self._on_confirmed = on_confirmed
        self._said: str | None = None
        self._journaled: list[RecordId] = []  # and the inbox does not know it yet
        self._inbox_trouble: str | None = None
        self._blocked: dict[bytes, str] = {}
        self.gathered = 0
        self.sealed = 0

    def turn(self, now: float, *, flush: bool = False, clock: Callable[[], float] | None = None) -> bool:
        """Do what can be done at `now`; whether anything moved. `flush` closes batches before they are full or old.

        clock: with it, what the node takes its time for is timed to the end.
        """
        self._finish(now)
        moved = self._gather(now)
        for batch in self._batcher.due(now, flush=flush):
            self._seal(batch, now)
            moved = True
        pump(self._submitter, self._chain, now, clock=clock)
        moved = self._tell(now) or moved
        if now >= self._forget_at:
            self._forget_at = now + FORGET_EVERY
            with self._inbox_may_be_away():
                self._inbox.forget(now - self._remember)
            self._prune(now - self._keep_batches)
        return moved

    def _gather(self, now: float) -> bool:
        """Take waiting records over into open batches, while the chain keeps up."""
        if self._submitter.backlog() >= MAX_BACKLOG:
            return False
        held, taken = len(self._batcher), 0
        while held < GATHER_RECORDS and taken < GATHER_BYTES:
            # One robot's at a time.
            leased: list[LeasedRecord] = []
            with self._inbox_may_be_away():
                leased = self._inbox.lease(
                    self._holder, limit=LEASE_RECORDS, max_bytes=LEASE_BYTES, now=now, ttl=LEASE
                )
            if not leased:
                break
            self.gathered += len(leased)
            for entry in leased:
                held, taken = held + 1, taken + len(entry.record.ciphertext)
                if refusal(entry.record, self._limits) is None:
                    self._batcher.add(entry.record, now)
                else:
                    self._seal([entry.record], now)  # the journal keeps it as a dead letter, with the reason
        return taken > 0

    def _seal(self, batch: list[SealedRecord], now: float) -> None:
        sealing = self._submitter.seal(batch, now)
        self._journaled += [record.id for record in batch]
        self._finish(now)
        self.sealed += len(sealing.jobs)
        for job in sealing.jobs:
            log.info("batch %s of robot %s: %d records", job.batch_index, job.robot.hex()[:8], job.count)
        for id in sealing.dead:
            log.error("record %s can be in no batch; see the dead letters", id)

    def _finish(self, now: float) -> None:
        """Tell the inbox what the journal has; what it could not be told before, too."""
        if self._journaled:
            with self._inbox_may_be_away():
                self._inbox.done(self._journaled, now)
                self._journaled.clear()

    @contextmanager
    def _inbox_may_be_away(self) -> Iterator[None]:
        """A Redis that restarts stops no batch that is on its way; each turn tries again."""
        try:
            yield
        except StoreError as error:
            if self._inbox_trouble is None:
                log.error("no records are taken from the inbox: %s", error)
            self._inbox_trouble = str(error)
        else:
            self._inbox_trouble = None

    def _tell(self, now: float) -> bool:
        confirmed = self._submitter.confirmed()
        if confirmed:
            self._submitter.acknowledge(confirmed)
        for timing in self._submitter.timings():
            self._on_confirmed(timing)
            log.info("batch of %d records confirmed in block %d, 0x%s", timing.records, timing.block_number,
                     timing.tx_hash.hex())
        status = self._submitter.status()
        trouble = status.failure or ("the treasury is empty: send ETH to the operator's account"
                                     if status.treasury_empty else None)
        for robot, why in status.blocked.items():
            if self._blocked.get(robot) != why:
                log.warning("the batches of robot %s wait: %s", robot.hex()[:8], why)
        self._blocked = dict(status.blocked)
        if trouble != self._said:
            if trouble is not None:
                log.warning("%s", trouble)
            self._said = trouble
        return bool(confirmed)

    def status(self) -> Status:
        """Why the ledger's end is as it is."""
        return self._submitter.status()

    @property
    def idle(self) -> bool:
        """Nothing is gathered and nothing is on its way."""
        return len(self._batcher) == 0 and self._submitter.idle()

    def run(
        self,
        stopped: Callable[[], bool],
        *,
        clock: Callable[[], float] | None = None,
        on_turn: Callable[[], None] = lambda: None,
    ) -> None:
        """Until `stopped()`. What is gathered and not sealed stays in the inbox.

        clock: without it, a steady one. on_turn: called after every turn.
        """
        clock = clock or steady_clock()
        self._inbox.reclaim(self._holder)
        pause = SHORTEST_PAUSE
        while not stopped():
            pause = SHORTEST_PAUSE if self.turn(clock(), clock=clock) else min(2 * pause, LONGEST_PAUSE)
            on_turn()
            time.sleep(pause)
        self._submitter.close()
