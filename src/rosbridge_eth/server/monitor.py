"""The server's process that shows: collects the others' snapshots, looks at node and store itself, answers HTTP.

A process of its own, so that a slow scraper or a hanging node holds up
neither records nor the supervisor.
"""

from __future__ import annotations

import logging
import os
import tempfile
import threading
import time
from collections.abc import Callable, Sequence
from pathlib import Path

from rosbridge_eth.errors import ChainError, StoreError
from rosbridge_eth.ledger import Chain, NodeFailure
from rosbridge_eth.ledger.journal import Journal
from rosbridge_eth.operations.board import Board, Wire
from rosbridge_eth.operations.figures import Condition, Sample, Snapshot, sample
from rosbridge_eth.operations.web import Web
from rosbridge_eth.store import Inbox

log = logging.getLogger(__name__)

NODE, STORE = "node", "store"
LOOK_EVERY = 5.0  # seconds between two looks at node and store
BALANCES_EVERY = 60.0
SHARE = 0.05  # of the time at most goes into counting a large store
LITTLE_ROOM = 64 << 20  # bytes; below this the disk counts as full
_ETH = 10**18


class NodeWatch:
    """Looks at the node: its head, whether it is the right chain with the contract, the balances.

    check: raises ChainError where the chain or the contract is not the one that was deployed on.
    accounts: gives (address, name) of those whose balance matters. Times are the caller's.
    """

    def __init__(
        self, chain: Chain, check: Callable[[], object], accounts: Callable[[], Sequence[tuple[str, str]]]
    ) -> None:
        self._chain, self._check, self._accounts = chain, check, accounts
        self._answered: float | None = None
        self._balances: list[Sample] = []
        self._balances_at = float("-inf")
        self._wrong = "not looked at yet"

    def look(self, now: float, wall: Callable[[], float]) -> Snapshot:
        """Ask the node. now: monotonic seconds; wall: the clock to hold the last block's time against."""
        samples, failure = list[Sample](), ""
        try:
            head = self._chain.head()
            samples += [
                sample("head_block", head.number),
                sample("head_age_seconds", max(0.0, wall() - head.timestamp)),
            ]
            if now - self._balances_at >= BALANCES_EVERY or self._wrong:
                self._check()
                self._wrong = ""
                self._balances = [
                    sample("balance_eth", self._chain.balance(account) / _ETH, account, name)
                    for account, name in self._accounts()
                ]
                self._balances_at = now
            self._answered = now
        except NodeFailure as error:
            failure = str(error)
        except ChainError as error:
            self._wrong = str(error)
        if self._answered is not None:
            samples.append(sample("node_answered_seconds", now - self._answered))
        return Snapshot.of(
            NODE,
            [*samples, *self._balances],
            [
                Condition("node answers", not failure, failure),
                Condition("contract is the right one", not self._wrong, self._wrong),
            ],
        )


class StoreWatch:
    """Looks at inbox, journal and disk."""

    def __init__(self, inbox: Inbox, journal: Journal, folder: Path) -> None:
        self._inbox, self._journal, self._folder = inbox, journal, folder
        self._next_count = float("-inf")
        self._counted: list[Sample] = []

    def look(self, now: float, wall: float) -> Snapshot:
        """now: monotonic seconds; wall: the inbox's clock."""
        trouble = self._try_to_write()
        if now >= self._next_count and not trouble:
            started = time.monotonic()
            try:
                self._counted = self._count(wall)
                self._inbox.forget(0.0, 1)  # forgets nothing, but has to be allowed to write
            except StoreError as error:
                trouble = str(error)
            self._next_count = now + (time.monotonic() - started) / SHARE
        free = os.statvfs(self._folder)
        room = free.f_bavail * free.f_frsize
        return Snapshot.of(
            STORE,
            [*self._counted, sample("disk_free_bytes", room)],
            [
                Condition("store is writable", not trouble, trouble),
                Condition("disk has room", room >= LITTLE_ROOM,
                          "" if room >= LITTLE_ROOM else f"{room >> 20} MiB free at {self._folder}; make room"),
            ],
        )

    def _try_to_write(self) -> str:
        try:
            with tempfile.NamedTemporaryFile(dir=self._folder, prefix=".writable.") as file:
                file.write(bytes(4096))
                file.flush()
                os.fsync(file.fileno())
        except OSError as error:
            return f"{self._folder} takes no file: {error.strerror}"
        return ""

    def _count(self, wall: float) -> list[Sample]:
        inbox = self._inbox.statistics(wall)
        return [
            sample("inbox_records", inbox.waiting, "waiting"),
            sample("inbox_records", inbox.leased, "leased"),
            sample("inbox_records", inbox.dead, "dead"),
            sample("inbox_bytes", inbox.bytes),
            sample("inbox_oldest_seconds", max(0.0, inbox.oldest_age or 0.0)),
            sample("dead_letters", inbox.dead, "inbox"),
            sample("dead_letters", self._journal.count_dead_letters(), "journal"),
            *(sample("batches", number, state) for state, number in sorted(self._journal.counts().items())),
        ]


class Monitor:
    """Runs until told to stop: receives in the calling thread, looks and serves in threads of its own."""

    def __init__(self, wire: Wire, board: Board, web: Web, node: NodeWatch, store: StoreWatch) -> None:
        self._wire, self._board, self._web, self._node, self._store = wire, board, web, node, store
        self._stop = threading.Event()

    def run(self, stopped: Callable[[], bool]) -> None:
        threads = [
            threading.Thread(target=self._every, args=(look,), name=name, daemon=True)
            for name, look in (
                (NODE, lambda: self._node.look(time.monotonic(), time.time)),
                (STORE, lambda: self._store.look(time.monotonic(), time.time())),
            )
        ]
        for thread in threads:
            thread.start()
        self._web.start()
        log.info("/metrics, /healthz and /readyz at http://%s:%d", *self._web.address)
        while not stopped():
            snapshot = self._wire.receive(0.5)
            if snapshot is not None:
                self._board.put(snapshot)
        self._stop.set()
        self._web.stop()

    def _every(self, look: Callable[[], Snapshot]) -> None:
        while not self._stop.is_set():
            self._board.put(look())
            self._stop.wait(LOOK_EVERY)
