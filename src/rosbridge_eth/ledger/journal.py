"""What the submitter knows, on disk: SQLite, WAL, synchronous=FULL.

A batch is written here before its records leave the inbox; a nonce and the
signed bytes before a node sees them. Every change of a job is one transaction
that also checks the lease, so of two submitters only the newer one's changes
count. A crash between any two writes leaves a state of states.TRANSITIONS
from which the submitter goes on.

A journal belongs to one contract on one chain (Binding). With another it
refuses to open: its nonces and indices would be wrong there.
"""

from __future__ import annotations

import sqlite3
import threading
from collections.abc import Collection, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rosbridge_eth.errors import ChainError, StoreError
from rosbridge_eth.ledger import merkle, packing
from rosbridge_eth.ledger.batching import halves
from rosbridge_eth.ledger.states import IN_FLIGHT, OPEN, Event, Kind, State, after
from rosbridge_eth.ledger.transactions import Fees, SignedTransaction
from rosbridge_eth.records import RecordId, SealedRecord

if TYPE_CHECKING:
    from rosbridge_eth.ledger.chain import Receipt
    from rosbridge_eth.ledger.contract import Contract

SCHEMA_VERSION = 1
SCHEMA = """
CREATE TABLE IF NOT EXISTS binding (      -- one row: the chain and contract everything here is about
    schema INTEGER NOT NULL, chain_id TEXT NOT NULL, genesis BLOB NOT NULL,
    contract TEXT NOT NULL, code_hash BLOB NOT NULL);
CREATE TABLE IF NOT EXISTS account (      -- the nonce to use next, above every one ever signed with
    address TEXT PRIMARY KEY, next_nonce INTEGER NOT NULL) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS robot (        -- the batch index to use next
    id BLOB PRIMARY KEY, next_index INTEGER NOT NULL) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS job (
    id INTEGER PRIMARY KEY AUTOINCREMENT,
    kind TEXT NOT NULL, state TEXT NOT NULL, robot BLOB NOT NULL,
    batch_index INTEGER, root BLOB, records BLOB, count INTEGER NOT NULL DEFAULT 0,  -- batches; records are packed
    value INTEGER NOT NULL DEFAULT 0, target TEXT,                                   -- top-ups: gwei, to whom
    account TEXT, nonce INTEGER, gas INTEGER, max_fee TEXT, tip TEXT, legacy INTEGER NOT NULL DEFAULT 0,
    parent INTEGER REFERENCES job,                       -- of a half: the batch it was cut from
    held_account TEXT, held_nonce INTEGER,               -- not to be signed before this nonce is settled
    tx_hash BLOB, block_number INTEGER, block_hash BLOB, gas_used INTEGER,           -- where it was mined
    failures INTEGER NOT NULL DEFAULT 0, bumps INTEGER NOT NULL DEFAULT 0, reason TEXT,
    sealed_at REAL NOT NULL, signed_at REAL, submitted_at REAL, included_at REAL, confirmed_at REAL);
CREATE INDEX IF NOT EXISTS job_by_state ON job (state, id);
CREATE INDEX IF NOT EXISTS job_by_nonce ON job (account, nonce);
CREATE INDEX IF NOT EXISTS job_by_parent ON job (parent) WHERE parent IS NOT NULL;
CREATE INDEX IF NOT EXISTS job_settled ON job (block_number) WHERE state IN ('confirmed', 'acknowledged');
CREATE TABLE IF NOT EXISTS attempt (      -- every transaction ever signed for a job; any of them may be mined
    hash BLOB PRIMARY KEY, job INTEGER NOT NULL REFERENCES job, account TEXT NOT NULL, nonce INTEGER NOT NULL,
    raw BLOB NOT NULL, signed_at REAL NOT NULL) WITHOUT ROWID;
CREATE INDEX IF NOT EXISTS attempt_by_nonce ON attempt (account, nonce);
CREATE INDEX IF NOT EXISTS attempt_by_job ON attempt (job);
CREATE TABLE IF NOT EXISTS record (       -- every record that was ever in a batch, and in which it is now
    robot BLOB NOT NULL, stream BLOB NOT NULL, seq BLOB NOT NULL,  -- seq: 8 bytes, big-endian
    job INTEGER NOT NULL REFERENCES job, leaf INTEGER NOT NULL,
    PRIMARY KEY (robot, stream, seq)) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS dead_letter (
    robot BLOB NOT NULL, stream BLOB NOT NULL, seq BLOB NOT NULL, job INTEGER,
    ciphertext BLOB NOT NULL, reason TEXT NOT NULL, at REAL NOT NULL,
    PRIMARY KEY (robot, stream, seq)) WITHOUT ROWID;
CREATE TABLE IF NOT EXISTS lease (        -- who may act for an account; `token` grows with every new holder
    account TEXT PRIMARY KEY, holder TEXT NOT NULL, token INTEGER NOT NULL, expires REAL NOT NULL) WITHOUT ROWID;
"""


@dataclass(frozen=True, slots=True)
class Binding:
    """The contract and chain a journal belongs to."""

    chain_id: int
    genesis: bytes
    contract: str
    code_hash: bytes

    @staticmethod
    def of(contract: Contract) -> Binding:
        """Ask the node. ChainError if it does not say."""
        genesis = contract.chain.block(0)
        if genesis is None:
            raise ChainError(f"{contract.chain.url} does not have its own first block")
        return Binding(contract.chain.chain_id(), genesis.hash, contract.address, contract.code_hash)

    def difference(self, other: Binding) -> str:
        """What differs, in words."""
        if self.chain_id != other.chain_id:
            return f"chain {self.chain_id} instead of {other.chain_id}"
        if self.genesis != other.genesis:
            return f"another chain with the id {self.chain_id} (its first block is 0x{self.genesis.hex()[:8]}…)"
        if self.contract != other.contract:
            return f"the contract {self.contract} instead of {other.contract}"
        return "another version of the contract"


class LeaseLost(StoreError):
    """Another submitter has taken the account over; this one must not act for it any more."""


@dataclass(frozen=True, slots=True)
class Lease:
    """The right to act for an account until `expires`."""

    account: str
    holder: str
    token: int
    expires: float


@dataclass(frozen=True, slots=True)
class Job:
    """A row of `job`; the columns are explained there. `value` in wei."""

    id: int
    kind: Kind
    state: State
    robot: bytes
    batch_index: int | None
    root: bytes | None
    count: int
    value: int
    target: str | None
    account: str | None
    nonce: int | None
    gas: int | None
    fees: Fees | None
    parent: int | None
    held_account: str | None
    held_nonce: int | None
    tx_hash: bytes | None
    block_number: int | None
    block_hash: bytes | None
    gas_used: int | None
    failures: int
    bumps: int
    reason: str | None
    sealed_at: float
    signed_at: float | None
    submitted_at: float | None
    included_at: float | None
    confirmed_at: float | None


@dataclass(frozen=True, slots=True)
class Attempt:
    """A signed transaction of a job."""

    hash: bytes
    job: int
    account: str
    nonce: int
    raw: bytes = field(repr=False)


@dataclass(frozen=True, slots=True)
class RecordLocation:
    """Where a record is: its batch's state, and the transaction and block once it is in one."""

    state: State
    job: int
    batch_index: int | None
    leaf: int
    leaves: int
    tx_hash: bytes | None
    block_number: int | None


@dataclass(frozen=True, slots=True)
class DeadLetter:
    """A record that can never be written, and why."""

    record: SealedRecord
    reason: str
    at: float


_COLUMNS = (
    "id, kind, state, robot, batch_index, root, count, value, target, account, nonce, gas, max_fee, tip, legacy,"
    " parent, held_account, held_nonce, tx_hash, block_number, block_hash, gas_used, failures, bumps, reason,"
    " sealed_at, signed_at, submitted_at, included_at, confirmed_at"
)
GWEI = 10**9  # top-ups are kept in gwei: SQLite's integers end at 2**63, 9.2 ETH in wei


def _job(row: Sequence[Any]) -> Job:
    id, kind, state, robot, index, root, count, value, target, account, nonce, gas, max_fee, tip, legacy, *rest = row
    fees = None if max_fee is None else Fees(int(max_fee), int(tip), bool(legacy))
    return Job(
        id, Kind(kind), State(state), robot, index, root, count, value * GWEI, target, account, nonce, gas, fees, *rest
    )


def _key(id: RecordId) -> tuple[bytes, bytes, bytes]:
    return id.robot, id.stream, id.seq.to_bytes(8, "big")


class Journal:
    """The submitter's memory; `path` may be ":memory:" for a chain that does not outlive the process either."""

    def __init__(self, path: Path | str, binding: Binding) -> None:
        self._path = path
        self._lock = threading.RLock()
        self._inside = False
        try:
            self._db = sqlite3.connect(path, timeout=10, isolation_level=None, check_same_thread=False)
            self._db.execute("PRAGMA journal_mode=WAL")
            self._db.execute("PRAGMA synchronous=FULL")
            self._db.executescript(SCHEMA)
        except sqlite3.Error as error:
            raise StoreError(self._trouble(error)) from error
        try:
            self._bind(binding)
        except BaseException:
            self._db.close()
            raise

    def _trouble(self, error: sqlite3.Error) -> str:
        if "full" in str(error):
            return f"the journal {self._path} cannot grow, the disk is full; make room, nothing is lost"
        return (
            f"the journal {self._path} cannot be used ({error}); restore it from a backup, or move it away:"
            " a new one is rebuilt from the chain"
        )

    def _bind(self, binding: Binding) -> None:
        with self.transaction() as db:
            row = db.execute("SELECT schema, chain_id, genesis, contract, code_hash FROM binding").fetchone()
            if row is None:
                values = (SCHEMA_VERSION, str(binding.chain_id), binding.genesis, binding.contract, binding.code_hash)
                db.execute("INSERT INTO binding VALUES (?, ?, ?, ?, ?)", values)
                return
        if row[0] != SCHEMA_VERSION:
            raise StoreError(
                f"the journal {self._path} has layout {row[0]}, this version reads {SCHEMA_VERSION};"
                " use the version that wrote it until its batches are confirmed, then move it away"
            )
        kept = Binding(int(row[1]), row[2], row[3], row[4])
        if kept != binding:
            raise StoreError(
                f"the journal {self._path} belongs to contract {kept.contract} on chain {kept.chain_id}, but the"
                f" configuration leads to {binding.difference(kept)}; correct the node's URL or the contract's"
                " address, or give the new ledger a store of its own"
            )

    def close(self) -> None:
        with self._lock:
            self._db.close()

    @contextmanager
    def transaction(self) -> Iterator[sqlite3.Connection]:
        """All or nothing, on disk when it ends; an inner one is part of the outer."""
        with self._lock:
            if self._inside:
                yield self._db
                return
            self._inside = True
            try:
                self._db.execute("BEGIN IMMEDIATE")
                yield self._db
                self._db.execute("COMMIT")
            except sqlite3.Error as error:
                self._undo()
                raise StoreError(self._trouble(error)) from error
            except BaseException:
                self._undo()
                raise
            finally:
                self._inside = False

    def _undo(self) -> None:
        if self._db.in_transaction:
            self._db.execute("ROLLBACK")

    def _rows(self, sql: str, *values: object) -> list[Any]:
        with self._lock:
            try:
                return self._db.execute(sql, values).fetchall()
            except sqlite3.Error as error:
                raise StoreError(self._trouble(error)) from error

    # ------------------------------------------------------------------ leases

    def lease(self, account: str, holder: str, now: float, ttl: float) -> Lease | None:
        """Take or renew the right to act for an account; None while another holder's has not run out."""
        with self.transaction() as db:
            row = db.execute("SELECT holder, token, expires FROM lease WHERE account = ?", (account,)).fetchone()
            if row is not None and row[0] != holder and row[2] > now:
                return None
            token = 1 if row is None else row[1] + (row[0] != holder)
            db.execute("INSERT OR REPLACE INTO lease VALUES (?, ?, ?, ?)", (account, holder, token, now + ttl))
            return Lease(account, holder, token, now + ttl)

    def release(self, lease: Lease) -> None:
        """Give the right back before it runs out."""
        with self.transaction() as db:
            db.execute(
                "UPDATE lease SET expires = 0 WHERE account = ? AND holder = ? AND token = ?",
                (lease.account, lease.holder, lease.token),
            )

    def _fence(self, db: sqlite3.Connection, lease: Lease) -> None:
        row = db.execute("SELECT token FROM lease WHERE account = ?", (lease.account,)).fetchone()
        if row != (lease.token,):
            raise LeaseLost(f"another submitter acts for {lease.account} now; only one may run on this store")

    # ------------------------------------------------------------------ sealing

    def known(self, ids: Iterable[RecordId]) -> set[RecordId]:
        """Those of `ids` that are in the journal, in a batch or as a dead letter."""
        sql = (
            "SELECT 1 FROM record WHERE robot = ? AND stream = ? AND seq = ?"
            " UNION ALL SELECT 1 FROM dead_letter WHERE robot = ? AND stream = ? AND seq = ?"
        )
        return {id for id in ids if self._rows(sql, *_key(id), *_key(id))}

    def seal(self, batches: Sequence[Sequence[SealedRecord]], now: float) -> list[Job]:
        """Keep batches to be written, each with the next index of its robot. StoreError if a record is known."""
        with self.transaction() as db:
            return [self._insert_batch(db, records, now) for records in batches]

    def bury(self, record: SealedRecord, reason: str, now: float) -> None:
        """Keep a record that can be in no batch, as a dead letter."""
        with self.transaction() as db:
            self._dead_letter(db, record, reason, now, None)

    def _dead_letter(
        self, db: sqlite3.Connection, record: SealedRecord, reason: str, now: float, job: int | None
    ) -> None:
        values = (*_key(record.id), job, record.ciphertext, reason, now)
        db.execute("INSERT OR IGNORE INTO dead_letter VALUES (?, ?, ?, ?, ?, ?, ?)", values)

    def _insert_batch(
        self,
        db: sqlite3.Connection,
        records: Sequence[SealedRecord],
        now: float,
        *,
        parent: Job | None = None,
        takes_nonce: bool = False,
        held: bool = False,
    ) -> Job:
        """`takes_nonce`: stands in its parent's place; `held`: waits until that nonce is settled."""
        robot = records[0].id.robot
        packed, root = packing.pack(records), merkle.root([merkle.leaf_hash(record) for record in records])
        index = parent.batch_index if parent is not None and takes_nonce else self._next_index(db, robot)
        cursor = db.execute(
            "INSERT INTO job (kind, state, robot, batch_index, root, records, count, sealed_at, parent, account, nonce,"
            " max_fee, tip, legacy, held_account, held_nonce) VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)",
            (
                *(Kind.BATCH, State.SEALED, robot, index, root, packed, len(records)),
                now if parent is None else parent.sealed_at,
                None if parent is None else parent.id,
                *(_nonce_of(parent) if takes_nonce else (None, None, None, None, 0)),
                *((parent.account, parent.nonce) if parent is not None and held else (None, None)),
            ),
        )
        id = int(cursor.lastrowid or 0)
        verb = "INSERT" if parent is None else "INSERT OR REPLACE"  # the halves take the records over
        db.executemany(
            f"{verb} INTO record VALUES (?, ?, ?, ?, ?)",
            [(*_key(record.id), id, leaf) for leaf, record in enumerate(records)],
        )
        return self._load(db, id)

    def _next_index(self, db: sqlite3.Connection, robot: bytes) -> int:
        row = db.execute("SELECT next_index FROM robot WHERE id = ?", (robot,)).fetchone()
        index = 0 if row is None else int(row[0])
        db.execute("INSERT OR REPLACE INTO robot VALUES (?, ?)", (robot, index + 1))
        return index

    # ------------------------------------------------------------------ reading

    def _load(self, db: sqlite3.Connection, id: int) -> Job:
        row = db.execute(f"SELECT {_COLUMNS} FROM job WHERE id = ?", (id,)).fetchone()  # noqa: S608 - a constant
        if row is None:
            raise StoreError(f"the journal {self._path} has no job {id}; it was changed by hand or lost writes")
        return _job(row)

    def job(self, id: int) -> Job:
        with self._lock:
            return self._load(self._db, id)

    def jobs(self, states: Sequence[State] = OPEN) -> list[Job]:
        """All jobs in these states, oldest first."""
        marks = ", ".join("?" * len(states))
        sql = f"SELECT {_COLUMNS} FROM job WHERE state IN ({marks}) ORDER BY id"  # noqa: S608 - question marks
        return [_job(row) for row in self._rows(sql, *states)]

    def counts(self) -> dict[State, int]:
        """How many batches are in each state."""
        rows = self._rows("SELECT state, count(*) FROM job WHERE kind = ? GROUP BY state", Kind.BATCH)
        return {State(state): number for state, number in rows}

    def included(self, robot: bytes) -> int:
        """How many of a robot's batches are known to be on the chain."""
        sql = "SELECT count(*) FROM job WHERE kind = ? AND robot = ? AND state IN (?, ?, ?)"
        states = (State.INCLUDED, State.CONFIRMED, State.ACKNOWLEDGED)
        return int(self._rows(sql, Kind.BATCH, robot, *states)[0][0])

    def packed(self, job: Job) -> bytes:
        """The packed records of a batch; StoreError if they were pruned."""
        ((packed,),) = self._rows("SELECT records FROM job WHERE id = ?", job.id)
        if packed is None:
            raise StoreError(f"the records of batch {job.id} were removed from the journal, it was confirmed long ago")
        return bytes(packed)

    def records(self, job: Job) -> list[SealedRecord]:
        return packing.unpack(job.robot, self.packed(job))

    def attempts(self, account: str, nonce: int) -> list[Attempt]:
        """Every transaction signed with that nonce, the newest first."""
        sql = (
            "SELECT hash, job, account, nonce, raw FROM attempt WHERE account = ? AND nonce = ?"
            " ORDER BY signed_at DESC, job DESC"
        )
        return [Attempt(*row) for row in self._rows(sql, account, nonce)]

    def latest_attempt(self, job: Job) -> Attempt:
        sql = (
            "SELECT hash, job, account, nonce, raw FROM attempt WHERE job = ? AND nonce = ?"
            " ORDER BY signed_at DESC LIMIT 1"
        )
        rows = self._rows(sql, job.id, job.nonce)
        if not rows:
            raise StoreError(f"job {job.id} of the journal {self._path} is {job.state} without a signed transaction")
        return Attempt(*rows[0])

    def next_nonce(self, account: str) -> int:
        rows = self._rows("SELECT next_nonce FROM account WHERE address = ?", account)
        return int(rows[0][0]) if rows else 0

    def nonce_is_used(self, account: str, nonce: int) -> bool:
        """Is there a job that holds this nonce, other than one that is void or dead?"""
        sql = "SELECT 1 FROM job WHERE account = ? AND nonce = ? AND state NOT IN (?, ?, ?) LIMIT 1"
        return bool(self._rows(sql, account, nonce, State.VOID, State.DEAD, State.SPLIT))

    def highest_settled(self) -> Job | None:
        """The settled job in the highest block: while that block is the chain's, all below it are.

        Only of those that could be sent again: what was pruned or adopted cannot.
        """
        sql = (
            f"SELECT {_COLUMNS} FROM job WHERE state IN ('confirmed', 'acknowledged')"  # noqa: S608 - a constant
            " AND EXISTS (SELECT 1 FROM attempt WHERE attempt.job = job.id) ORDER BY block_number DESC LIMIT 1"
        )
        rows = self._rows(sql)
        return _job(rows[0]) if rows else None

    def find(self, id: RecordId) -> RecordLocation | None:
        """Where a record is; None if the journal never had it."""
        sql = (
            "SELECT j.state, j.id, j.batch_index, r.leaf, j.count, j.tx_hash, j.block_number FROM record r"
            " JOIN job j ON j.id = r.job WHERE r.robot = ? AND r.stream = ? AND r.seq = ?"
        )
        rows = self._rows(sql, *_key(id))
        if rows:
            return RecordLocation(State(rows[0][0]), *rows[0][1:])
        dead = self._rows("SELECT 1 FROM dead_letter WHERE robot = ? AND stream = ? AND seq = ?", *_key(id))
        return RecordLocation(State.DEAD, 0, None, 0, 1, None, None) if dead else None

    def count_dead_letters(self) -> int:
        """How many there are, without reading them."""
        return int(self._rows("SELECT count(*) FROM dead_letter")[0][0])

    def dead_by_reason(self) -> list[tuple[bytes, str, int]]:
        """Robot, reason and how many records, the latest last; without reading them."""
        return self._rows("SELECT robot, reason, count(*) FROM dead_letter GROUP BY robot, reason ORDER BY max(at)")

    def dead_letters(self) -> list[DeadLetter]:
        rows = self._rows("SELECT robot, stream, seq, ciphertext, reason, at FROM dead_letter ORDER BY at")
        return [
            DeadLetter(SealedRecord(RecordId(robot, stream, int.from_bytes(seq, "big")), ciphertext), reason, at)
            for robot, stream, seq, ciphertext, reason, at in rows
        ]

    # ------------------------------------------------------------------ changing

    def _change(
        self, db: sqlite3.Connection, job: Job, event: Event, lease: Lease, **columns: object
    ) -> Job:
        """One transition, checked against the journal's own copy of the job."""
        self._fence(db, lease)
        kept = self._load(db, job.id)
        columns["state"] = after(kept.state, event)
        sets = ", ".join(f"{name} = ?" for name in columns)
        db.execute(f"UPDATE job SET {sets} WHERE id = ?", (*columns.values(), job.id))  # noqa: S608 - our own names
        return self._load(db, job.id)

    def signed(
        self,
        job: Job,
        event: Event,
        lease: Lease,
        *,
        nonce: int,
        gas: int,
        fees: Fees,
        transaction: SignedTransaction,
        now: float,
    ) -> Job:
        """SIGNED or BUMPED: nonce and bytes are on disk from here on."""
        with self.transaction() as db:
            values = (transaction.hash, job.id, lease.account, nonce, transaction.raw, now)
            db.execute("INSERT OR REPLACE INTO attempt VALUES (?, ?, ?, ?, ?, ?)", values)
            db.execute(
                "INSERT INTO account VALUES (?, ?) ON CONFLICT DO UPDATE"
                " SET next_nonce = max(next_nonce, excluded.next_nonce)",
                (lease.account, nonce + 1),
            )
            return self._change(
                db,
                job,
                event,
                lease,
                account=lease.account,
                nonce=nonce,
                gas=gas,
                max_fee=str(fees.max_fee),
                tip=str(fees.tip),
                legacy=int(fees.legacy),
                signed_at=now,
                bumps=job.bumps + (event is Event.BUMPED),
            )

    def accepted(self, job: Job, lease: Lease, now: float) -> Job:
        with self.transaction() as db:
            return self._change(db, job, Event.ACCEPTED, lease, submitted_at=job.submitted_at or now)

    def dropped(self, job: Job, lease: Lease) -> Job:
        with self.transaction() as db:
            return self._change(db, job, Event.DROPPED, lease)

    def mined(self, job: Job, receipt: Receipt, lease: Lease, now: float) -> tuple[Job, list[Job]]:
        """It is in a block. Also gives what stood in its place and does so no more."""
        with self.transaction() as db:
            overtaken = []
            if job.state in (State.SPLIT, State.DEAD):
                overtaken = self._overtake(db, job, lease)
            changed = self._change(
                db,
                job,
                Event.MINED,
                lease,
                tx_hash=receipt.tx_hash,
                block_number=receipt.block_number,
                block_hash=receipt.block_hash,
                gas_used=receipt.gas_used,
                submitted_at=job.submitted_at or now,
                included_at=now,
            )
            return changed, overtaken

    def _overtake(self, db: sqlite3.Connection, parent: Job, lease: Lease) -> list[Job]:
        """The parent was mined after all: its records are its own again."""
        found, wanted = [], [parent.id]
        while wanted:
            rows = db.execute(f"SELECT {_COLUMNS} FROM job WHERE parent = ?", (wanted.pop(),))  # noqa: S608
            for child in [_job(row) for row in rows]:
                wanted.append(child.id)
                if child.state is not State.VOID:
                    found.append(self._change(db, child, Event.OVERTAKEN, lease))
        if parent.kind is Kind.BATCH:
            records = self.records(parent)
            db.executemany(
                "INSERT OR REPLACE INTO record VALUES (?, ?, ?, ?, ?)",
                [(*_key(record.id), parent.id, leaf) for leaf, record in enumerate(records)],
            )
            db.executemany(
                "DELETE FROM dead_letter WHERE robot = ? AND stream = ? AND seq = ?",
                [_key(record.id) for record in records],
            )
        return found

    def nonce_lost(self, job: Job, event: Event, lease: Lease, reason: str) -> tuple[Job, list[Job]]:
        """FAILED or SUPERSEDED, N blocks deep: the nonce is spent, the work is not done. A filler's is."""
        with self.transaction() as db:
            others = self._settle(db, job, lease)
            if job.kind is Kind.FILLER:
                return self._change(db, job, Event.SETTLED, lease, reason=reason), others
            changed = self._change(
                db,
                job,
                event,
                lease,
                nonce=None,
                account=None,
                max_fee=None,
                tip=None,
                failures=job.failures + (event is Event.FAILED),
                reason=reason,
            )
            return changed, others

    def reindexed(self, job: Job, lease: Lease) -> Job:
        with self.transaction() as db:
            return self._change(db, job, Event.REINDEXED, lease, batch_index=self._next_index(db, job.robot))

    def reorged(self, job: Job, lease: Lease) -> Job:
        with self.transaction() as db:
            return self._change(
                db, job, Event.REORGED, lease, tx_hash=None, block_number=None, block_hash=None, confirmed_at=None
            )

    def buried(self, job: Job, lease: Lease, now: float) -> tuple[Job, list[Job]]:
        """N blocks deep. Also gives every other job that changed because the nonce is settled."""
        with self.transaction() as db:
            changed = self._change(db, job, Event.BURIED, lease, confirmed_at=now)
            return changed, self._settle(db, job, lease)

    def _settle(self, db: sqlite3.Connection, job: Job, lease: Lease) -> list[Job]:
        """The nonce of `job` is spent for good: what was split under it is void, what waited for it need not."""
        nonce = (job.account, job.nonce)
        split = f"SELECT {_COLUMNS} FROM job WHERE account = ? AND nonce = ? AND state = ?"  # noqa: S608 - a constant
        rows = db.execute(split, (*nonce, State.SPLIT)).fetchall()
        settled = [self._change(db, _job(row), Event.SETTLED, lease) for row in rows]
        held = [row[0] for row in db.execute("SELECT id FROM job WHERE held_account = ? AND held_nonce = ?", nonce)]
        db.execute(
            "UPDATE job SET held_account = NULL, held_nonce = NULL WHERE held_account = ? AND held_nonce = ?", nonce
        )
        return settled + [self._load(db, id) for id in held]

    def acknowledged(self, jobs: Iterable[Job]) -> None:
        """Whoever waited has been told. Needs no lease: it concerns nobody's nonce."""
        with self.transaction() as db:
            for job in jobs:
                state = after(self._load(db, job.id).state, Event.ACKNOWLEDGED)
                db.execute("UPDATE job SET state = ? WHERE id = ?", (state, job.id))

    def halved(self, job: Job, lease: Lease, reason: str) -> tuple[Job, Job, Job]:
        """The batch and its two halves. With a nonce, the first half takes it and the second waits for it."""
        left, right = halves(self.records(job))
        takes_nonce = job.nonce is not None
        with self.transaction() as db:
            changed = self._change(db, job, Event.HALVED, lease, reason=reason)
            now = job.sealed_at
            first = self._insert_batch(db, left, now, parent=changed, takes_nonce=takes_nonce)
            second = self._insert_batch(db, right, now, parent=changed, held=takes_nonce)
            return changed, first, second

    def refused(self, job: Job, lease: Lease, reason: str, now: float) -> tuple[Job, Job | None]:
        """Never to be written. Its record becomes a dead letter; a nonce it has goes to a filler."""
        with self.transaction() as db:
            changed = self._change(db, job, Event.REFUSED, lease, reason=reason)
            if job.kind is Kind.BATCH:
                for record in self.records(job):
                    self._dead_letter(db, record, reason, now, job.id)
            filler = None
            if job.nonce is not None and job.account is not None:
                filler = self._insert_filler(db, job.robot, job.account, job.nonce, now, changed)
            return changed, filler

    def give_up(
        self, robot: bytes, accounts: Collection[str], spent: Collection[tuple[str, int]], reason: str, now: float
    ) -> int:
        """Every record of a robot that is in no block becomes a dead letter; how many.

        accounts: those that were ever the robot's. spent: of these, nonces with which a batch was written; it is left
        to the submitter, which learns so. Needs no lease and takes them all: a submitter that acts for one of the
        accounts reads the journal anew before it does anything more for the robot.
        """
        sql = f"SELECT {_COLUMNS} FROM job WHERE robot = ? AND state IN (?, ?, ?, ?)"  # noqa: S608 - a constant
        buried = 0
        with self.transaction() as db:
            rows = db.execute(sql, (robot, *IN_FLIGHT, State.SEALED, State.SPLIT)).fetchall()
            for job in (_job(row) for row in rows):
                if (job.account, job.nonce) in spent or not (job.kind is Kind.BATCH or job.account in accounts):
                    continue
                letters = self.records(job) if job.kind is Kind.BATCH and job.state is not State.SPLIT else []
                event = Event.REFUSED if letters else Event.SETTLED
                values = (after(job.state, event), reason, job.id)
                db.execute("UPDATE job SET state = ?, reason = ? WHERE id = ?", values)
                for record in letters:
                    self._dead_letter(db, record, reason, now, job.id)
                buried += len(letters)
            db.executemany(
                "UPDATE lease SET holder = '', token = token + 1, expires = 0 WHERE account = ?",
                [(account,) for account in accounts],
            )
        return buried

    def fill(self, robot: bytes, lease: Lease, nonce: int, now: float) -> Job:
        """Plan a filler for a nonce that nothing holds; `robot`: whose account it is, b"" for the operator's."""
        with self.transaction() as db:
            self._fence(db, lease)
            return self._insert_filler(db, robot, lease.account, nonce, now, None)

    def _insert_filler(
        self, db: sqlite3.Connection, robot: bytes, account: str, nonce: int, now: float, parent: Job | None
    ) -> Job:
        _, _, max_fee, tip, legacy = _nonce_of(parent) if parent is not None else (None, None, None, None, 0)
        cursor = db.execute(
            "INSERT INTO job (kind, state, robot, target, account, nonce, max_fee, tip, legacy, parent, sealed_at)"
            " VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)",
            (
                *(Kind.FILLER, State.SEALED, robot, account, account, nonce),
                *(max_fee, tip, legacy, None if parent is None else parent.id, now),
            ),
        )
        return self._load(db, int(cursor.lastrowid or 0))

    def top_up(self, robot: bytes, target: str, wei: int, lease: Lease, now: float) -> Job:
        """Plan a payment to a robot's account, from the account of the lease."""
        with self.transaction() as db:
            self._fence(db, lease)
            cursor = db.execute(
                "INSERT INTO job (kind, state, robot, target, value, sealed_at) VALUES (?, ?, ?, ?, ?, ?)",
                (Kind.TOP_UP, State.SEALED, robot, target, wei // GWEI, now),
            )
            return self._load(db, int(cursor.lastrowid or 0))

    # ------------------------------------------------------------------ restoring and forgetting

    def adopt(
        self,
        batch_index: int,
        records: Sequence[SealedRecord],
        account: str,
        where: tuple[bytes, int, bytes],
        now: float,
    ) -> bool:
        """Take over a batch found on the chain; False if the journal has it. `where`: transaction, block, its hash."""
        robot = records[0].id.robot
        with self.transaction() as db:
            row = db.execute(
                "SELECT 1 FROM job WHERE robot = ? AND batch_index = ? AND state != ?", (robot, batch_index, State.VOID)
            ).fetchone()
            if row is not None:
                return False
            root = merkle.root([merkle.leaf_hash(record) for record in records])
            cursor = db.execute(
                "INSERT INTO job (kind, state, robot, batch_index, root, count, account, tx_hash, block_number,"
                " block_hash, sealed_at, confirmed_at) VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)",
                (Kind.BATCH, State.ACKNOWLEDGED, robot, batch_index, root, len(records), account, *where, now, now),
            )
            db.executemany(
                "INSERT OR IGNORE INTO record VALUES (?, ?, ?, ?, ?)",
                [(*_key(record.id), cursor.lastrowid, leaf) for leaf, record in enumerate(records)],
            )
            db.execute(
                "INSERT INTO robot VALUES (?, ?) ON CONFLICT DO UPDATE"
                " SET next_index = max(next_index, excluded.next_index)",
                (robot, batch_index + 1),
            )
            return True

    def prune(self, before: float) -> int:
        """Drop the bytes of batches acknowledged and confirmed before that time; how many. Identities stay."""
        with self.transaction() as db:
            rows = db.execute(
                "SELECT id FROM job WHERE state IN (?, ?) AND coalesce(confirmed_at, sealed_at) < ?"
                " AND (records IS NOT NULL OR id IN (SELECT job FROM attempt))",
                (State.ACKNOWLEDGED, State.VOID, before),
            ).fetchall()
            db.executemany("DELETE FROM attempt WHERE job = ?", rows)
            db.executemany("UPDATE job SET records = NULL WHERE id = ?", rows)
            return len(rows)


def _nonce_of(job: Job | None) -> tuple[str | None, int | None, str | None, str | None, int]:
    """Account, nonce and fees, as columns."""
    if job is None:
        return None, None, None, None, 0
    fees = job.fees
    return (
        job.account,
        job.nonce,
        None if fees is None else str(fees.max_fee),
        None if fees is None else str(fees.tip),
        int(fees.legacy) if fees else 0,
    )
