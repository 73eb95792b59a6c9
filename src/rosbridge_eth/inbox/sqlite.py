"""The inbox in a SQLite file: the embedded back end."""

from __future__ import annotations

import secrets
from collections.abc import Collection, Mapping, Sequence
from pathlib import Path
from typing import Any, Final

from eth_hash.auto import keccak

from rosbridge_eth.errors import StoreError
from rosbridge_eth.inbox import DEAD_LETTERS, DeadLetter, Head, Inbox, InboxExchanged, Outcome, Row, Waiting
from rosbridge_eth.log.chunk import Chunk
from rosbridge_eth.log.database import Database, NothingThere

_APPLICATION: Final = 0x52424942  # "RBIB"
_NOWHERE: Final = -(2**63)  # a position before all rows
_SCHEMA: Final = """
-- One row: the store's id, and whose chunks it holds.
CREATE TABLE IF NOT EXISTS inbox (id BLOB NOT NULL, ledger BLOB NOT NULL);
-- bytes: of its rows. next: the position of its next row. state: JSON.
CREATE TABLE IF NOT EXISTS robot (
    tk BLOB PRIMARY KEY, bytes INTEGER NOT NULL DEFAULT 0, next INTEGER NOT NULL DEFAULT 0, state TEXT
) WITHOUT ROWID;
-- number: 8 bytes, big-endian, which order as they count. chunk: as it travelled.
CREATE TABLE IF NOT EXISTS chunk (
    no INTEGER PRIMARY KEY, tk BLOB NOT NULL, position INTEGER NOT NULL, digest BLOB NOT NULL, hash BLOB NOT NULL,
    size INTEGER NOT NULL, taken_at REAL NOT NULL, records INTEGER NOT NULL, stream BLOB NOT NULL,
    number BLOB NOT NULL, chunk BLOB NOT NULL
);
-- The rows without their chunks: what the submitter looks through.
CREATE UNIQUE INDEX IF NOT EXISTS row ON chunk (tk, position, digest, hash, size, taken_at, records);
CREATE INDEX IF NOT EXISTS chunk_by_hash ON chunk (tk, hash);
CREATE INDEX IF NOT EXISTS chunk_by_number ON chunk (tk, stream, number);
-- The newest chunk ever taken of each stream.
CREATE TABLE IF NOT EXISTS head (
    tk BLOB, stream BLOB, number BLOB, digest BLOB, PRIMARY KEY (tk, stream)
) WITHOUT ROWID;
-- How often each process that appends has done so: fewer than it knows of, and an old copy was put back meanwhile.
CREATE TABLE IF NOT EXISTS writer (no INTEGER PRIMARY KEY, id BLOB UNIQUE NOT NULL, commits INTEGER NOT NULL);
CREATE TABLE IF NOT EXISTS dead (no INTEGER PRIMARY KEY AUTOINCREMENT, tk BLOB, why TEXT, taken_at REAL, chunk BLOB);
"""
_WRITERS: Final = 1000  # that are kept; the oldest go
_COMMITTED: Final = (
    "INSERT INTO writer (id, commits) VALUES (?, ?) ON CONFLICT DO UPDATE SET commits = excluded.commits"
)
_NEXT: Final = "UPDATE robot SET next = next + 1 WHERE tk = ? AND bytes <= ? RETURNING next"
_BURY: Final = "INSERT INTO dead SELECT NULL, tk, ?, taken_at, chunk FROM chunk WHERE tk = ? AND position = ?"


class SqliteInbox(Inbox):
    """`Inbox` in one file. An object belongs to one thread; open one per process, after forking."""

    def __init__(
        self, path: Path, ledger: bytes, max_bytes: int, max_bytes_per_robot: int, *, read_only: bool = False
    ) -> None:
        self._path, self._ledger, self._read_only = path, ledger, read_only
        self.max_bytes, self.max_bytes_per_robot = max_bytes, max_bytes_per_robot
        self._open()

    def _open(self) -> None:
        self._writer, self._commits = secrets.token_bytes(8), 0
        self._db = Database(
            self._path, "inbox", application=_APPLICATION, schema=_SCHEMA, wal_pages=1000, read_only=self._read_only
        )
        try:
            if not self._read_only:
                make = "INSERT INTO inbox SELECT ?, ? WHERE NOT EXISTS (SELECT 1 FROM inbox)"
                self._db.write(lambda: self._db.run(make, (secrets.token_bytes(16), self._ledger)))
                many = "DELETE FROM writer WHERE no <= (SELECT max(no) FROM writer) - ?"
                self._db.write(lambda: self._db.run(many, (_WRITERS,)), durable=False)
            rows = self._read("SELECT id, ledger FROM inbox")
            if not rows:
                raise NothingThere(f"there is no inbox {self._path} yet")
            self.id, ledger = rows[0]
            if ledger != self._ledger:
                raise StoreError(f"the inbox {self._path} is for another contract or chain; move it away")
        except BaseException:
            self.close()
            raise

    def close(self) -> None:
        self._db.close()

    def check(self) -> None:
        self._db.check()

    def _read(self, statement: str, *values: Any) -> list[Any]:
        with self._db.errors():
            return self._db.run(statement, values).fetchall()

    def append(self, chunks: Sequence[tuple[bytes, Chunk]], now: float) -> list[Outcome]:
        hashed = [(tk, chunk, keccak(chunk.encoded)) for tk, chunk in chunks]
        try:
            if self._db.replaced():
                raise InboxExchanged(f"the inbox {self._path} was exchanged or removed while it was in use")
            if not chunks:
                self._require_commits()
                return []
            outcomes = self._db.write(lambda: self._append(hashed, now))
        except InboxExchanged:
            self.close()
            self._open()
            raise
        self._commits += 1
        return outcomes

    def _require_commits(self) -> None:
        """InboxExchanged unless all is there that this object has committed: SQLite's own backup can put an old copy
        into the file while it is in use, and what was acknowledged since is to be sent again."""
        rows = self._read("SELECT commits FROM writer WHERE id = ?", self._writer)
        if (rows[0][0] if rows else 0) != self._commits:
            raise InboxExchanged(f"an old copy of the inbox {self._path} was put back while it was in use")

    def _append(self, chunks: Sequence[tuple[bytes, Chunk, bytes]], now: float) -> list[Outcome]:
        self._require_commits()
        self._db.run(_COMMITTED, (self._writer, self._commits + 1))
        outcomes: list[Outcome] = []
        full: set[bytes] = set()
        (room,) = self._db.one("SELECT ? - coalesce(sum(bytes), 0) FROM robot", (self.max_bytes,))
        for tk, chunk, hash in chunks:
            header, head = chunk.header, self.head(tk, chunk.header.stream)
            if head is not None and header.number <= head.number:
                outcomes.append(self._compare(tk, chunk, head))
                continue
            self._db.run("INSERT OR IGNORE INTO robot (tk) VALUES (?)", (tk,))
            size = len(chunk.encoded)
            place = None if tk in full or size > room else self._db.one(_NEXT, (tk, self.max_bytes_per_robot - size))
            if place is None:
                full.add(tk)
                outcomes.append(Outcome.FULL)
            else:
                room -= size
                self._add(tk, place[0], chunk, hash, now)
                self._raise(tk, header.stream, header.number, header.digest)
                outcomes.append(Outcome.STORED)
        return outcomes

    def _compare(self, tk: bytes, chunk: Chunk, head: Head) -> Outcome:
        header = chunk.header
        same = "SELECT digest FROM chunk WHERE tk = ? AND stream = ? AND number = ?"
        there = {digest for (digest,) in self._read(same, tk, header.stream, _sortable(header.number))}
        if header.number == head.number:
            there.add(head.digest)
        return Outcome.DIFFERENT if there and header.digest not in there else Outcome.KNOWN

    def _add(self, tk: bytes, position: int, chunk: Chunk, hash: bytes, now: float) -> None:
        header, encoded = chunk.header, chunk.encoded
        row = (tk, position, header.digest, hash, len(encoded), now, header.records)
        place = (header.stream, _sortable(header.number), encoded)
        self._db.run("INSERT INTO chunk VALUES (NULL, ?, ?, ?, ?, ?, ?, ?, ?, ?, ?)", row + place)
        self._db.run("UPDATE robot SET bytes = bytes + ? WHERE tk = ?", (len(encoded), tk))

    def head(self, tk: bytes, stream: bytes) -> Head | None:
        rows = self._read("SELECT number, digest FROM head WHERE tk = ? AND stream = ?", tk, stream)
        return Head(int.from_bytes(rows[0][0], "big"), rows[0][1]) if rows else None

    def raise_heads(self, tk: bytes, heads: Mapping[bytes, Head]) -> None:
        def write() -> None:
            for stream, head in heads.items():
                self._raise(tk, stream, *head)

        self._db.write(write)

    def _raise(self, tk: bytes, stream: bytes, number: int, digest: bytes) -> None:
        self._db.run(
            "INSERT INTO head VALUES (?, ?, ?, ?) ON CONFLICT DO UPDATE"
            " SET number = excluded.number, digest = excluded.digest WHERE number < excluded.number",
            (tk, stream, _sortable(number), digest),
        )

    def sizes(self) -> dict[bytes, int]:
        return dict(self._read("SELECT tk, bytes FROM robot"))

    def find(self, tk: bytes, hash: bytes) -> int | None:
        rows = self._read("SELECT position FROM chunk WHERE tk = ? AND hash = ?", tk, hash)
        return rows[0][0] if rows else None

    def rows(self, tk: bytes, after: int | None, limit: int) -> list[Row]:
        rows = self._read(
            "SELECT position, digest, hash, size, taken_at, records FROM chunk INDEXED BY row"
            " WHERE tk = ? AND position > ? ORDER BY position LIMIT ?",
            tk, _NOWHERE if after is None else after, limit,
        )  # fmt: skip
        return [Row(*row) for row in rows]

    def chunks(self, tk: bytes, positions: Collection[int]) -> list[bytes]:
        one = "SELECT chunk FROM chunk INDEXED BY row WHERE tk = ? AND position = ?"
        found = [chunk for position in positions for (chunk,) in self._read(one, tk, position)]
        if len(found) != len(positions):
            raise StoreError(f"the inbox {self._path} has no such row any more")
        return found

    def remove(self, tk: bytes, positions: Collection[int], why: str | None = None) -> None:
        self._db.write(lambda: self._remove(tk, positions, why), durable=why is not None)

    def _remove(self, tk: bytes, positions: Collection[int], why: str | None) -> None:
        for position in positions:
            if why is not None:
                self._db.run(_BURY, (why, tk, position))
            gone = "DELETE FROM chunk WHERE tk = ? AND position = ? RETURNING size"
            for (size,) in self._db.run(gone, (tk, position)).fetchall():
                self._db.run("UPDATE robot SET bytes = bytes - ? WHERE tk = ?", (size, tk))
        self._db.run("DELETE FROM dead WHERE no <= (SELECT max(no) FROM dead) - ?", (DEAD_LETTERS,))

    def _put_in_front(self, tk: bytes, front: Sequence[Chunk], on_chain: set[bytes], now: float) -> None:
        def put() -> None:
            rows = self.rows(tk, None, -1)
            self._remove(tk, [row.position for row in rows if row.digest in on_chain], None)
            self._db.run("INSERT OR IGNORE INTO robot (tk) VALUES (?)", (tk,))
            free = "SELECT coalesce((SELECT min(position) - 1 FROM chunk WHERE tk = ?1), next) FROM robot WHERE tk = ?1"
            (last,) = self._db.one(free, (tk,))
            for position, chunk in enumerate(front, last - len(front) + 1):
                self._add(tk, position, chunk, keccak(chunk.encoded), now)

        self._db.write(put)

    def _load(self, tks: Sequence[bytes]) -> Sequence[str | bytes | None]:
        with self._db.errors():
            found = (self._db.one("SELECT state FROM robot WHERE tk = ?", (tk,)) for tk in tks)
            return [row and row[0] for row in found]

    def _save(self, tk: bytes, text: str) -> None:
        save = "INSERT INTO robot (tk, state) VALUES (?, ?) ON CONFLICT DO UPDATE SET state = excluded.state"
        self._db.write(lambda: self._db.run(save, (tk, text)), durable=False)

    def dead(self, limit: int = 100) -> list[DeadLetter]:
        rows = self._read("SELECT tk, why, taken_at, chunk FROM dead ORDER BY no DESC LIMIT ?", limit)
        return [DeadLetter(*row) for row in rows]

    def waiting(self, tk: bytes, after: int | None) -> Waiting:
        (figures,) = self._read(
            "SELECT count(*), coalesce(sum(records), 0), coalesce(sum(size), 0), min(taken_at)"
            " FROM chunk INDEXED BY row WHERE tk = ? AND position > ?",
            tk, _NOWHERE if after is None else after,
        )  # fmt: skip
        return Waiting(*figures)


def _sortable(number: int) -> bytes:
    return number.to_bytes(8, "big")
