"""The store in a SQLite file: on every robot, and on a server that needs no Redis."""

from __future__ import annotations

from collections.abc import Callable, Collection, Sequence
from functools import partial
from pathlib import Path
from typing import Any, Final

from eth_hash.auto import keccak

from rosbridge_eth.errors import StoreError
from rosbridge_eth.log.chunk import Chunk, Header
from rosbridge_eth.log.database import Database

from rosbridge_eth.log.store import (  # isort: skip
    DEAD_LETTERS, NOWHERE, DeadLetter, Offer, Outcome, Row, State, Store, Waiting, place_of, successor,
)  # fmt: skip

_APPLICATION: Final = 0x52425354  # "RBST"
_SCHEMA: Final = """
-- One row: whose chunks these are.
CREATE TABLE IF NOT EXISTS store (ledger BLOB NOT NULL);
INSERT INTO store SELECT x'{ledger}' WHERE NOT EXISTS (SELECT 1 FROM store);
-- store.State, and the bytes of the robot's rows.
CREATE TABLE IF NOT EXISTS robot (
    tk BLOB PRIMARY KEY, head BLOB NOT NULL, digest BLOB NOT NULL, base BLOB NOT NULL, confirmed BLOB NOT NULL,
    block INTEGER NOT NULL, hold TEXT NOT NULL, certificates BLOB NOT NULL, bytes INTEGER NOT NULL
) WITHOUT ROWID;
-- chunk: as it travelled.
CREATE TABLE IF NOT EXISTS chunk (
    no INTEGER PRIMARY KEY, tk BLOB NOT NULL, place BLOB NOT NULL, digest BLOB NOT NULL, hash BLOB NOT NULL,
    size INTEGER NOT NULL, records INTEGER NOT NULL, taken_at REAL NOT NULL, chunk BLOB NOT NULL
);
-- The rows without their chunks: what the submitter looks through.
CREATE UNIQUE INDEX IF NOT EXISTS row ON chunk (tk, place, digest, hash, size, records, taken_at);
CREATE INDEX IF NOT EXISTS chunk_by_hash ON chunk (tk, hash);
CREATE INDEX IF NOT EXISTS chunk_by_digest ON chunk (tk, digest);
CREATE TABLE IF NOT EXISTS dead (no INTEGER PRIMARY KEY AUTOINCREMENT, tk BLOB, why TEXT, taken_at REAL, chunk BLOB);
"""
_STATE: Final = "SELECT head, digest, base, confirmed, block, hold, certificates, bytes FROM robot WHERE tk = ?"
_BURY: Final = "INSERT INTO dead SELECT NULL, tk, ?, taken_at, chunk FROM chunk WHERE tk = ? AND place = ?"


class SqliteStore(Store):
    """`Store` in one file, for the chunks of one ledger. what: its name in messages; exclusive: see Database.

    Once the path leads to another file, or to none, that is what the store holds: by the rule, robots and submitter go
    on from there.
    """

    def __init__(
        self, path: Path, ledger: bytes, max_bytes: int, max_bytes_per_robot: int, *, read_only: bool = False,
        what: str = "store", application: int = _APPLICATION, wal_pages: int = 1000, exclusive: bool = False,
    ) -> None:  # fmt: skip
        self.max_bytes, self.max_bytes_per_robot = max_bytes, max_bytes_per_robot
        self._where, self._ledger = f"the {what} {path}", ledger
        self._connect = partial(
            Database, path, what, application=application, schema=_SCHEMA.format(ledger=ledger.hex()),
            wal_pages=wal_pages, exclusive=exclusive, read_only=read_only,
        )  # fmt: skip
        self._open()

    def _open(self) -> None:
        self._db = self._connect()
        if self._read("SELECT ledger FROM store") != [(self._ledger,)]:
            self.close()
            raise StoreError(f"{self._where} is for another contract or chain; move it away")

    def close(self) -> None:
        self._db.close()

    def check(self) -> None:
        self._db.check()

    def _look(self) -> None:
        """Open what the path leads to, if that is another file by now."""
        if self._db.replaced():
            self.close()
            self._open()

    def _read(self, statement: str, *values: Any) -> list[Any]:
        with self._db.errors():
            return self._db.run(statement, values).fetchall()

    def _robot(self, tk: bytes) -> tuple[State, int]:
        """The state of a robot and the bytes of its rows."""
        rows = self._read(_STATE, tk)
        return (State(*rows[0][:-1]), rows[0][-1]) if rows else (State(), 0)

    def _save(self, tk: bytes, state: State, size: int) -> None:
        self._db.run("INSERT OR REPLACE INTO robot VALUES (?, ?, ?, ?, ?, ?, ?, ?, ?)", (tk, *state, size))

    # What changes something

    def append(self, offers: Sequence[Offer], now: float) -> list[Outcome]:
        self._look()
        hashed = [(offer, keccak(offer.chunk.encoded)) for offer in offers]
        return self._db.write(lambda: self._append(hashed, now)) if offers else []

    def _append(self, offers: Sequence[tuple[Offer, bytes]], now: float) -> list[Outcome]:
        [(total,)] = self._read("SELECT coalesce(sum(bytes), 0) FROM robot")
        full, outcomes = set[bytes](), list[Outcome]()
        for (tk, chunk, after), hash in offers:
            (state, held), header, size = self._robot(tk), chunk.header, len(chunk.encoded)
            outcome = self._judge(tk, state, header, state.digest if tk in full else after)
            if outcome is Outcome.STORED:
                if tk in full or held + size > self.max_bytes_per_robot or total + size > self.max_bytes:
                    outcome = Outcome.FULL
                    full.add(tk)
                else:
                    self._insert(tk, chunk, hash, now)
                    held, total = held + size, total + size
            if outcome in (Outcome.STORED, Outcome.KNOWN) and place_of(header) > state.head:
                self._save(tk, state._replace(head=place_of(header), digest=header.digest), held)
            outcomes.append(outcome)
        return outcomes

    def _insert(self, tk: bytes, chunk: Chunk, hash: bytes, now: float) -> None:
        header, encoded = chunk.header, chunk.encoded
        row = (tk, place_of(header), header.digest, hash, len(encoded), header.records, now, encoded)
        self._db.run("INSERT INTO chunk VALUES (NULL, ?, ?, ?, ?, ?, ?, ?, ?)", row)

    def _judge(self, tk: bytes, state: State, header: Header, after: bytes) -> Outcome:
        """What the rule says of a chunk (see `Store.append`) where there is room for it."""
        place = place_of(header)
        there = self._read("SELECT digest FROM chunk WHERE tk = ? AND place = ?", tk, place)
        if place == state.head:
            there.append((state.digest,))
        if any(digest != header.digest for (digest,) in there):
            return Outcome.DIFFERENT
        if place <= state.head:
            first = self.rows(tk, NOWHERE, 1)
            return Outcome.DIFFERENT if not there and first and first[0].place < place else Outcome.KNOWN
        if header.previous != state.digest:
            named = self.place(tk, header.previous)
            if place == successor(state.head) or (named and self._between(tk, state.head, named, place)):
                return Outcome.DIFFERENT
            if after != state.digest:
                return Outcome.NOT_NEXT
        return Outcome.KNOWN if there else Outcome.STORED

    def _between(self, tk: bytes, head: bytes, place: bytes, before: bytes) -> bool:
        """Whether the head or a row stands between these places."""
        return place < head < before or any(row.place < before for row in self.rows(tk, place, 1))

    def set_state(self, tk: bytes, **changes: Any) -> None:
        def change() -> None:
            state, size = self._robot(tk)
            self._save(tk, state._replace(**changes), size)

        [known] = self.states([tk])
        if known != known._replace(**changes):
            self._db.write(change, durable=False)

    def remove(self, tk: bytes, places: Collection[bytes], why: str = "") -> None:
        self._db.write(lambda: self._remove(tk, places, why), durable=bool(why))

    def _remove(self, tk: bytes, places: Collection[bytes], why: str) -> None:
        for place in places:
            if why:
                self._db.run(_BURY, (why, tk, place))
            gone = "DELETE FROM chunk WHERE tk = ? AND place = ? RETURNING size"
            for (size,) in self._db.run(gone, (tk, place)).fetchall():
                self._db.run("UPDATE robot SET bytes = bytes - ? WHERE tk = ?", (size, tk))
        self._db.run("DELETE FROM dead WHERE no <= (SELECT max(no) FROM dead) - ?", (DEAD_LETTERS,))

    def together(self, action: Callable[[], None]) -> None:
        """Carry out what `action` changes in one commit, or not at all; it may be called twice."""
        self._db.write(action)

    def replace(self, tk: bytes, chunk: Chunk, now: float) -> None:
        """Put another form of a chunk into its row. A power cut may take it back."""

        def put() -> None:
            self._remove(tk, [place_of(chunk.header)], "")  # an UPDATE would leave a page to what became short
            self._insert(tk, chunk, keccak(chunk.encoded), now)
            self._db.run("UPDATE robot SET bytes = bytes + ? WHERE tk = ?", (len(chunk.encoded), tk))

        self._db.write(put, durable=False)

    def forget_dead(self) -> None:
        """Remove all dead letters."""
        self._db.write(lambda: self._db.run("DELETE FROM dead"), durable=False)

    # What looks

    def states(self, tks: Sequence[bytes]) -> list[State]:
        self._look()
        return [self._robot(tk)[0] for tk in tks]

    def find(self, tk: bytes, hash: bytes) -> bytes | None:
        found = self._read("SELECT place FROM chunk WHERE tk = ? AND hash = ?", tk, hash)
        return found[0][0] if found else None

    def has(self, tk: bytes, digest: bytes) -> bool:
        return self.place(tk, digest) is not None

    def place(self, tk: bytes, digest: bytes) -> bytes | None:
        """The place of the row with this header."""
        found = self._read("SELECT place FROM chunk WHERE tk = ? AND digest = ?", tk, digest)
        return found[0][0] if found else None

    def rows(self, tk: bytes, after: bytes, limit: int) -> list[Row]:
        found = self._read(
            "SELECT place, digest, hash, size, records, taken_at FROM chunk INDEXED BY row"
            " WHERE tk = ? AND place > ? ORDER BY place LIMIT ?", tk, after, limit,
        )  # fmt: skip
        return [Row(*row) for row in found]

    def chunks(self, tk: bytes, places: Sequence[bytes]) -> list[bytes]:
        one = "SELECT chunk FROM chunk INDEXED BY row WHERE tk = ? AND place = ?"
        found = [chunk for place in places for (chunk,) in self._read(one, tk, place)]
        if len(found) != len(places):
            raise StoreError(f"{self._where} has no such row any more")
        return found

    def sizes(self) -> dict[bytes, int]:
        return dict(self._read("SELECT tk, bytes FROM robot"))

    def waiting(self, tk: bytes) -> Waiting:
        return self.behind(tk, self._robot(tk)[0].confirmed)

    def behind(self, tk: bytes, place: bytes) -> Waiting:
        """The rows behind a place, summed."""
        [figures] = self._read(
            "SELECT count(*), coalesce(sum(records), 0), coalesce(sum(size), 0), min(taken_at)"
            " FROM chunk INDEXED BY row WHERE tk = ? AND place > ?", tk, place,
        )  # fmt: skip
        return Waiting(*figures)

    def dead(self, limit: int = 100) -> list[DeadLetter]:
        found = self._read("SELECT tk, why, taken_at, chunk FROM dead ORDER BY no DESC LIMIT ?", limit)
        return [DeadLetter(*row) for row in found]
