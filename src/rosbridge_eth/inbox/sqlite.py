"""The inbox in a SQLite file: the embedded back end."""

from __future__ import annotations

import os
import secrets
from collections.abc import Collection, Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from eth_utils.crypto import keccak

from rosbridge_eth.chunk import Chunk
from rosbridge_eth.database import Database
from rosbridge_eth.errors import StoreError
from rosbridge_eth.inbox import (
    DEAD_SHARE,
    MAX_STREAMS,
    DeadLetter,
    Head,
    InboxExchanged,
    Outcome,
    RobotState,
    Row,
    Waiting,
    kept_for,
)

_APPLICATION: Final = 0x52424942  # "RBIB"
_SCHEMA: Final = """
-- One row: the store's id, whose chunks it holds, and how many bytes of them.
CREATE TABLE inbox (id BLOB NOT NULL, ledger BLOB NOT NULL, bytes INTEGER NOT NULL);
-- bytes: of its rows. next: the position of its next row. confirmed: the position up to which all is.
CREATE TABLE robot (
    tk BLOB PRIMARY KEY, bytes INTEGER NOT NULL DEFAULT 0, next INTEGER NOT NULL DEFAULT 0, confirmed INTEGER,
    hold TEXT, certificates_hash BLOB
);
-- number: 8 bytes, big-endian, which order as they count. chunk: as it travelled.
CREATE TABLE chunk (
    no INTEGER PRIMARY KEY, tk BLOB NOT NULL, position INTEGER NOT NULL, stream BLOB NOT NULL, number BLOB NOT NULL,
    digest BLOB NOT NULL, hash BLOB NOT NULL, size INTEGER NOT NULL, taken_at REAL NOT NULL, records INTEGER NOT NULL,
    chunk BLOB NOT NULL
);
-- Rows without the chunks: what the submitter looks through.
CREATE INDEX row ON chunk (tk, position, digest, hash, size, taken_at, records);
CREATE INDEX chunk_by_hash ON chunk (tk, hash);
CREATE INDEX chunk_by_number ON chunk (tk, stream, number);
CREATE TRIGGER added AFTER INSERT ON chunk BEGIN
    UPDATE robot SET bytes = bytes + new.size WHERE tk = new.tk;
    UPDATE inbox SET bytes = bytes + new.size;
END;
CREATE TRIGGER removed AFTER DELETE ON chunk BEGIN
    UPDATE robot SET bytes = bytes - old.size WHERE tk = old.tk;
    UPDATE inbox SET bytes = bytes - old.size;
END;
-- The newest chunk ever taken of each stream, and when.
CREATE TABLE head (tk BLOB, stream BLOB, number BLOB, digest BLOB, at REAL, PRIMARY KEY (tk, stream)) WITHOUT ROWID;
-- When which position was first confirmed.
CREATE TABLE mark (tk BLOB, position INTEGER, at REAL, PRIMARY KEY (tk, position)) WITHOUT ROWID;
CREATE TABLE dead (
    no INTEGER PRIMARY KEY AUTOINCREMENT, tk BLOB NOT NULL, why TEXT NOT NULL, taken_at REAL NOT NULL,
    chunk BLOB NOT NULL
);
"""
_NOWHERE: Final = -(2**63)  # a position before all rows
_ROWS: Final = """
SELECT position, digest, hash, size, taken_at, records FROM chunk INDEXED BY row
WHERE tk = ? AND position > ? ORDER BY position LIMIT ?
"""
_ADD: Final = """
INSERT INTO chunk (tk, position, stream, number, digest, hash, size, taken_at, records, chunk)
VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?, ?)
"""
_FORGET: Final = """
DELETE FROM chunk WHERE tk = :tk AND position < :confirmed
    AND position <= (SELECT max(position) FROM mark WHERE tk = :tk AND at < :before)
"""
# The oldest confirmed rows that have :excess bytes together, the newest confirmed one excepted.
_MAKE_ROOM: Final = """
DELETE FROM chunk WHERE no IN (
    SELECT no FROM (SELECT no, size, sum(size) OVER (ORDER BY position) AS upto FROM chunk
                    WHERE tk = :tk AND position < :confirmed)
    WHERE upto - size < :excess
)
"""
_STATE: Final = """
SELECT stream, number, hold, certificates_hash
FROM robot LEFT JOIN chunk ON chunk.tk = robot.tk AND position = confirmed WHERE robot.tk = ?
"""
_BURY: Final = """
INSERT INTO dead (tk, why, taken_at, chunk)
SELECT tk, ?, taken_at, chunk FROM chunk WHERE tk = ? AND position > ? ORDER BY position
"""
_FORGET_DEAD: Final = """
DELETE FROM dead WHERE no IN (
    SELECT no FROM (SELECT no, sum(length(chunk)) OVER (ORDER BY no DESC) AS kept FROM dead) WHERE kept > ?
)
"""
_TOTALS: Final = """
SELECT robot.tk, count(position), coalesce(sum(records), 0), coalesce(sum(size), 0), min(taken_at)
FROM robot LEFT JOIN chunk INDEXED BY row ON chunk.tk = robot.tk AND position > coalesce(confirmed, ?)
GROUP BY robot.tk
"""


class SqliteInbox:
    """`Inbox` in one file. An object belongs to one thread; open one per process, after forking."""

    def __init__(
        self, path: Path, ledger: bytes, max_bytes: int, max_bytes_per_robot: int, *, read_only: bool = False
    ) -> None:
        self._path, self._ledger = path, ledger
        self._max_bytes, self._share = max_bytes, max_bytes_per_robot
        self._open(read_only)

    def _open(self, read_only: bool = False) -> None:
        self._db = Database(
            self._path, "inbox", application=_APPLICATION, schema=_SCHEMA, wal_pages=1000, read_only=read_only
        )
        try:
            self._file = self._file_now()
            if not read_only:
                self._db.write(
                    lambda: self._db.run(
                        "INSERT INTO inbox SELECT ?, ?, 0 WHERE NOT EXISTS (SELECT 1 FROM inbox)",
                        (secrets.token_bytes(16), self._ledger),
                    )
                )
            ((self.id, ledger),) = self._read("SELECT id, ledger FROM inbox")
            if ledger != self._ledger:
                raise StoreError(f"the inbox {self._path} is for another contract or chain; move it away")
        except BaseException:
            self.close()
            raise

    def _file_now(self) -> tuple[int, int] | None:
        try:
            found = os.stat(self._path)
        except FileNotFoundError:
            return None
        return found.st_dev, found.st_ino

    def close(self) -> None:
        self._db.close()

    def check(self) -> None:
        """A file that could be opened keeps what is committed."""

    def _read(self, statement: str, *values: Any) -> list[Any]:
        with self._db.errors():
            return self._db.run(statement, values).fetchall()

    def append(self, chunks: Sequence[tuple[bytes, Chunk]], now: float) -> list[Outcome]:
        if self._file_now() != self._file:
            self.close()
            self._open()
            raise InboxExchanged(f"the inbox {self._path} was exchanged or removed while it was in use")
        hashed = [(tk, chunk, encoded := chunk.encoded, keccak(encoded)) for tk, chunk in chunks]
        return self._db.write(lambda: self._append(hashed, now)) if chunks else []

    def _append(self, chunks: Iterable[tuple[bytes, Chunk, bytes, bytes]], now: float) -> list[Outcome]:
        outcomes: list[Outcome] = []
        full: set[bytes] = set()
        for tk, chunk, encoded, hash in chunks:
            header = chunk.header
            head = self.head(tk, header.stream)
            if head is not None and header.number <= head.number:
                outcomes.append(self._compare(tk, chunk, head))
            elif tk in full or not self._has_room(tk, len(encoded)):
                full.add(tk)
                outcomes.append(Outcome.FULL)
            else:
                (position,) = self._db.one("UPDATE robot SET next = next + 1 WHERE tk = ? RETURNING next", (tk,))
                self._add(tk, position, chunk, encoded, hash, now)
                self._raise(tk, {header.stream: Head(header.number, header.digest)}, now)
                outcomes.append(Outcome.STORED)
        return outcomes

    def _compare(self, tk: bytes, chunk: Chunk, head: Head) -> Outcome:
        header = chunk.header
        place = (tk, header.stream, _sortable(header.number))
        rows = self._db.run("SELECT digest FROM chunk WHERE tk = ? AND stream = ? AND number = ?", place)
        there = {digest for (digest,) in rows}
        if header.number == head.number:
            there.add(head.digest)
        return Outcome.DIFFERENT if there and header.digest not in there else Outcome.KNOWN

    def _has_room(self, tk: bytes, size: int) -> bool:
        self._db.run("INSERT OR IGNORE INTO robot (tk) VALUES (?)", (tk,))
        own, total = self._db.one("SELECT robot.bytes, inbox.bytes FROM robot, inbox WHERE tk = ?", (tk,))
        return bool(own + size <= self._share and total + size <= self._max_bytes)

    def _add(self, tk: bytes, position: int, chunk: Chunk, encoded: bytes, hash: bytes, now: float) -> None:
        header = chunk.header
        self._db.run(
            _ADD,
            (tk, position, header.stream, _sortable(header.number), header.digest, hash, len(encoded), now,
             header.records, encoded),
        )  # fmt: skip

    def head(self, tk: bytes, stream: bytes) -> Head | None:
        rows = self._read("SELECT number, digest FROM head WHERE tk = ? AND stream = ?", tk, stream)
        return Head(int.from_bytes(rows[0][0], "big"), rows[0][1]) if rows else None

    def raise_heads(self, tk: bytes, heads: Mapping[bytes, Head], now: float) -> None:
        self._db.write(lambda: self._raise(tk, heads, now))

    def _raise(self, tk: bytes, heads: Mapping[bytes, Head], now: float) -> None:
        for stream, head in heads.items():
            known = self.head(tk, stream)
            if known is None and self._db.one("SELECT count(*) FROM head WHERE tk = ?", (tk,))[0] >= MAX_STREAMS:
                oldest = "SELECT stream FROM head WHERE tk = ? ORDER BY at LIMIT 1"
                self._db.run(f"DELETE FROM head WHERE tk = ? AND stream = ({oldest})", (tk, tk))  # noqa: S608
            if known is None or known.number < head.number:
                self._db.run(
                    "INSERT OR REPLACE INTO head VALUES (?, ?, ?, ?, ?)",
                    (tk, stream, _sortable(head.number), head.digest, now),
                )

    def robots(self) -> list[bytes]:
        return [tk for (tk,) in self._read("SELECT tk FROM robot")]

    def find(self, tk: bytes, hash: bytes) -> int | None:
        rows = self._read("SELECT position FROM chunk WHERE tk = ? AND hash = ?", tk, hash)
        return rows[0][0] if rows else None

    def rows(self, tk: bytes, after: int | None, limit: int) -> list[Row]:
        return [Row(*row) for row in self._read(_ROWS, tk, _NOWHERE if after is None else after, limit)]

    def chunks(self, tk: bytes, positions: Collection[int]) -> list[bytes]:
        found: list[bytes] = []
        for position in positions:
            rows = self._read("SELECT chunk FROM chunk WHERE tk = ? AND position = ?", tk, position)
            if not rows:
                raise self._gone()
            found.append(rows[0][0])
        return found

    def rebase(
        self, tk: bytes, tail: Chunk | None, on_chain: Collection[bytes], heads: Mapping[bytes, Head], now: float
    ) -> None:
        self._db.write(lambda: self._rebase(tk, tail, set(on_chain), heads, now))

    def _rebase(
        self, tk: bytes, tail: Chunk | None, on_chain: set[bytes], heads: Mapping[bytes, Head], now: float
    ) -> None:
        self._db.run("INSERT OR IGNORE INTO robot (tk) VALUES (?)", (tk,))
        if tail is not None:
            on_chain.add(tail.header.digest)
        for position, digest in self._read("SELECT position, digest FROM chunk INDEXED BY row WHERE tk = ?", tk):
            if digest in on_chain:
                self._db.run("DELETE FROM chunk WHERE tk = ? AND position = ?", (tk, position))
        if tail is not None:
            first = "(SELECT coalesce(min(position) - 1, robot.next) FROM chunk WHERE tk = robot.tk)"
            (position,) = self._db.one(f"SELECT {first} FROM robot WHERE tk = ?", (tk,))  # noqa: S608
            encoded = tail.encoded
            self._add(tk, position, tail, encoded, keccak(encoded), now)
            heads = {tail.header.stream: Head(tail.header.number, tail.header.digest), **heads}
        self._raise(tk, heads, now)
        self._db.run("UPDATE robot SET confirmed = NULL WHERE tk = ?", (tk,))
        self._db.run("DELETE FROM mark WHERE tk = ?", (tk,))

    def confirm(self, tk: bytes, position: int | None, now: float) -> None:
        known = self._read("SELECT confirmed FROM robot WHERE tk = ?", tk)
        if position != (known[0][0] if known else None):
            self._db.write(lambda: self._confirm(tk, position, now), durable=False)

    def _confirm(self, tk: bytes, position: int | None, now: float) -> None:
        if position is not None:
            if self._db.one("SELECT 1 FROM chunk WHERE tk = ? AND position = ?", (tk, position)) is None:
                raise self._gone()
            self._db.run("INSERT OR IGNORE INTO mark VALUES (?, ?, ?)", (tk, position, now))
        self._db.run("DELETE FROM mark WHERE tk = ? AND position > ?", (tk, _NOWHERE if position is None else position))
        self._db.run("UPDATE robot SET confirmed = ? WHERE tk = ?", (position, tk))

    def forget(self, before: float) -> None:
        self._db.write(lambda: self._forget(before), durable=False)

    def _forget(self, before: float) -> None:
        ((total, robots),) = self._read("SELECT bytes, (SELECT count(*) FROM robot) FROM inbox")
        kept = kept_for(total, robots, self._max_bytes, self._share)
        for tk, confirmed in self._read("SELECT tk, confirmed FROM robot WHERE confirmed IS NOT NULL"):
            which = {"tk": tk, "confirmed": confirmed, "before": before}
            self._db.run(_FORGET, which)
            self._db.run("DELETE FROM mark WHERE tk = :tk AND at < :before", which)
            (own,) = self._db.one("SELECT bytes FROM robot WHERE tk = :tk", which)
            if own > kept:
                self._db.run(_MAKE_ROOM, which | {"excess": own - kept})

    def state(self, tk: bytes) -> RobotState:
        rows = self._read(_STATE, tk)
        if not rows:
            return RobotState()
        stream, number, hold, certificates_hash = rows[0]
        confirmed = None if stream is None else (stream, int.from_bytes(number, "big"))
        return RobotState(confirmed, hold, certificates_hash)

    def set_state(self, tk: bytes, **changes: Any) -> None:
        known = self.state(tk)
        if known._replace(**changes) != known:  # ValueError if it has no such field
            self._db.write(lambda: self._set_state(tk, changes), durable=False)

    def _set_state(self, tk: bytes, changes: Mapping[str, Any]) -> None:
        self._db.run("INSERT OR IGNORE INTO robot (tk) VALUES (?)", (tk,))
        for name, value in changes.items():
            self._db.run(f"UPDATE robot SET {name} = ? WHERE tk = ?", (value, tk))  # noqa: S608

    def bury(self, tk: bytes, after: int | None, why: str) -> int:
        return self._db.write(lambda: self._bury(tk, _NOWHERE if after is None else after, why))

    def _bury(self, tk: bytes, after: int, why: str) -> int:
        self._db.run(_BURY, (why, tk, after))
        self._db.run(_FORGET_DEAD, (self._max_bytes // DEAD_SHARE,))
        self._db.run("UPDATE robot SET confirmed = NULL WHERE tk = ? AND confirmed > ?", (tk, after))
        self._db.run("DELETE FROM mark WHERE tk = ? AND position > ?", (tk, after))
        return self._db.run("DELETE FROM chunk WHERE tk = ? AND position > ?", (tk, after)).rowcount

    def dead(self, limit: int = 100) -> list[DeadLetter]:
        rows = self._read("SELECT tk, why, taken_at, chunk FROM dead ORDER BY no DESC LIMIT ?", limit)
        return [DeadLetter(*row) for row in rows]

    def totals(self) -> dict[bytes, Waiting]:
        return {tk: Waiting(*figures) for tk, *figures in self._read(_TOTALS, _NOWHERE)}

    def _gone(self) -> StoreError:
        return StoreError(f"the inbox {self._path} has no such row any more")


def _sortable(number: int) -> bytes:
    return number.to_bytes(8, "big")
