"""The robot's replica of its log: chunks from the moment they are sealed until they are confirmed on the chain.

One SQLite table; `append` is one commit, and what it returned for survives kill -9 and the loss of power. When the
spool is at its bound, or its disk is full, there is room for what is new at the expense of what is old:

    1. chunks that the server has stored, and those set aside, as a whole
    2. bodies of the oldest other ones; the robot signs that form of the chunk, and it is still sent
    3. headers of the oldest without body: they take at most an eighth of the room; the links of the log show it
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from pathlib import Path
from typing import Final, NamedTuple

from rosbridge_eth.errors import StoreError
from rosbridge_eth.log.chunk import Chunk, Log
from rosbridge_eth.log.database import Database, DiskFull

log = logging.getLogger(__name__)

_APPLICATION: Final = 0x52425350  # "RBSP"
_STORED, _ASIDE, _BARE, _WHOLE = 2, 3, 4, 5
"""States of a chunk: the server has it; it refused it; not stored, without and with a body.

All take one byte in SQLite's format (0 and 1 take none), so that a change of state does not move the body.
"""
_BARE_SHARE: Final = 8  # of what is there, for chunks without body
_SPARE: Final = 64 * 1024  # bytes removed beyond a chunk's own on a full disk, where pages count and not bytes
_FEW: Final = 32  # rows

_SCHEMA: Final = """
-- position: the order of the log. number: 8 bytes, big-endian, which order as they count. chunk: as it travels.
CREATE TABLE IF NOT EXISTS chunk (
    position INTEGER PRIMARY KEY AUTOINCREMENT, stream BLOB NOT NULL, number BLOB NOT NULL, digest BLOB NOT NULL,
    records INTEGER NOT NULL, size INTEGER NOT NULL, state INTEGER NOT NULL, chunk BLOB NOT NULL,
    UNIQUE (stream, number)
);
CREATE INDEX IF NOT EXISTS chunk_by_state ON chunk (state, position);
-- Sums over the chunks in each state, kept by the triggers.
CREATE TABLE IF NOT EXISTS held (state INTEGER PRIMARY KEY, chunks INTEGER, records INTEGER, bytes INTEGER);
INSERT OR IGNORE INTO held VALUES (2, 0, 0, 0), (3, 0, 0, 0), (4, 0, 0, 0), (5, 0, 0, 0);
CREATE TRIGGER IF NOT EXISTS added AFTER INSERT ON chunk BEGIN {more} END;
CREATE TRIGGER IF NOT EXISTS removed AFTER DELETE ON chunk BEGIN {less} END;
CREATE TRIGGER IF NOT EXISTS changed AFTER UPDATE ON chunk BEGIN {less} {more} END;
-- One row: whose log, the newest header ever appended, and how many bodies were dropped since the spool was made.
CREATE TABLE IF NOT EXISTS spool (
    ledger BLOB, tk BLOB, last BLOB, dropped_bodies INTEGER
);
""".format(
    more="UPDATE held SET chunks = chunks + 1, records = records + new.records, bytes = bytes + new.size"
    " WHERE state = new.state;",
    less="UPDATE held SET chunks = chunks - 1, records = records - old.records, bytes = bytes - old.size"
    " WHERE state = old.state;",
)
_MAKE: Final = """
INSERT INTO spool (ledger, tk, last, dropped_bodies) SELECT ?, ?, ?, 0 WHERE NOT EXISTS (SELECT 1 FROM spool)
"""
_OLDEST: Final = "SELECT position, chunk FROM chunk WHERE state = ? ORDER BY position LIMIT 1"
# The place in the log of a stream's newest chunk up to a number.
_UP_TO: Final = "(SELECT position FROM chunk WHERE stream = ? AND number <= ? ORDER BY number DESC LIMIT 1)"


class SpoolStatistics(NamedTuple):
    """What is in the spool; unstored: chunks that the server does not have, as far as is known; aside: refused ones.

    dropped_bodies: since the spool was made, those that were removed although the server did not have them.
    """

    chunks: int
    records: int
    bytes: int
    unstored: int
    aside: int
    dropped_bodies: int


class Spool:
    """One robot's log, for one process and one thread. Every method may raise StoreError; then nothing was changed.

    max_bytes: the bound on the chunks as they travel; the file takes about a tenth more. drop: gives the dropped
    form of a chunk, signed (chunk.drop). read_only: for a look at its statistics; database.InUse while its robot
    runs. StoreError if the file is another log's, or see database.Database.
    """

    def __init__(
        self, path: Path, log: Log, *, max_bytes: int, drop: Callable[[Chunk], Chunk], read_only: bool = False
    ) -> None:
        self._max_bytes, self._drop = max_bytes, drop
        self.disk_was_full = False
        """Whether old chunks gave way because the disk had no room for a new one, and not because of max_bytes."""
        self._db = Database(
            path, "spool", application=_APPLICATION, schema=_SCHEMA, wal_pages=128, exclusive=True, read_only=read_only
        )
        try:
            if not read_only:
                self._db.write(lambda: self._db.run(_MAKE, (*log, bytes(32))))
            with self._db.errors():
                row = self._db.one("SELECT ledger, tk, last FROM spool") or (*log, bytes(32))
            if row[:2] != log:
                raise StoreError(
                    f"the spool {path} is another robot's, or for another contract; what it holds is signed for that"
                    " one alone: move it away"
                )
        except BaseException:
            self.close()
            raise
        self.last_digest: bytes = row[2]
        """Digest of the newest header ever appended, zeros if none: `previous` of the next chunk."""

    def close(self) -> None:
        self._db.close()

    def append(self, chunk: Chunk) -> None:
        """Add the next chunk of the log. DiskFull where even the removal of old ones makes no room for it."""
        size = len(chunk.encoded)
        try:
            self._db.write(lambda: self._append(chunk, size, spare=0))
        except DiskFull as error:
            if not self.disk_was_full:
                log.warning("%s; until then the oldest chunks give way to new ones", error)
            self.disk_was_full = True
            self._db.write(lambda: self._append(chunk, size, spare=4 * size + _SPARE))
        self.last_digest = chunk.header.digest

    def _append(self, chunk: Chunk, size: int, *, spare: int) -> None:
        self._shrink(min(self._max_bytes - size, self._bytes() - spare))
        self._insert(None, chunk)
        self._db.run("UPDATE spool SET last = ?", (chunk.header.digest,))

    def _insert(self, position: int | None, chunk: Chunk) -> None:
        header, encoded, state = chunk.header, chunk.encoded, _WHOLE if chunk.body else _BARE
        place = (position, header.stream, _sortable(header.number), header.digest)
        row = (*place, header.records, len(encoded), state, encoded)
        self._db.run("INSERT INTO chunk VALUES (?, ?, ?, ?, ?, ?, ?, ?)", row)

    def _bytes(self, *states: int) -> int:
        held = self._db.run("SELECT state, bytes FROM held").fetchall()
        return sum(size for state, size in held if not states or state in states)

    def _shrink(self, limit: int) -> None:
        """Remove until no more than `limit` bytes are left, in the order that the module's docstring gives."""
        while self._bytes() > max(0, limit):
            many = self._bytes(_BARE) > self._bytes() // _BARE_SHARE
            for state in (_STORED, _ASIDE, _BARE, _WHOLE) if many else (_STORED, _ASIDE, _WHOLE, _BARE):
                row = self._db.one(_OLDEST, (state,))
                if row is not None:
                    self._remove(state, *row)
                    break

    def _remove(self, state: int, position: int, encoded: bytes) -> None:
        chunk = Chunk.parse(encoded)
        self._db.run("DELETE FROM chunk WHERE position = ?", (position,))
        if state == _WHOLE:  # put back: an UPDATE would leave it a page of its own
            self._insert(position, self._drop(chunk))
        if state != _STORED:
            self._db.run("UPDATE spool SET dropped_bodies = dropped_bodies + ?", (bool(chunk.body),))

    def next_stream(self, stream: bytes) -> tuple[bytes, int, bytes] | None:
        """Stream, number and digest of the oldest chunk that is not set aside, of the streams that begin after this
        one; of all others if this one is not here, such as b"".
        """
        following = (
            "SELECT stream, number, digest FROM chunk WHERE state != ? AND stream != ? AND position >"
            " (SELECT coalesce(max(position), 0) FROM chunk WHERE stream = ?) ORDER BY position LIMIT 1"
        )
        with self._db.errors():
            row = self._db.one(following, (_ASIDE, stream, stream))
        return None if row is None else (row[0], int.from_bytes(row[1], "big"), row[2])

    def following(self, stream: bytes, number: int | None, limit_bytes: int) -> list[Chunk]:
        """The chunks of a stream above a number (None: from its first), in order; at least one, if there is any."""
        chunks: list[Chunk] = []
        with self._db.errors():
            for (encoded,) in self._db.run(
                "SELECT chunk FROM chunk WHERE stream = ? AND number > ? AND state != ? ORDER BY number",
                (stream, _sortable(number), _ASIDE),
            ):
                limit_bytes -= len(encoded)
                if chunks and limit_bytes < 0:
                    break
                chunks.append(Chunk.parse(encoded))
        return chunks

    def stored(self, stream: bytes, number: int) -> None:
        """The server has everything of this stream up to this number."""
        where = f"state IN (?, ?) AND stream = ? AND position <= {_UP_TO}"
        self._change("UPDATE chunk SET state = ?", where, _STORED, _BARE, _WHOLE, stream, stream, _sortable(number))

    def lost(self, stream: bytes, number: int | None) -> None:
        """Of this stream the server has nothing above this number (None: nothing at all), whatever it said before."""
        where = "state = ? AND stream = ? AND number > ?"  # _WHOLE without a body becomes _BARE where room is made
        self._change("UPDATE chunk SET state = ?", where, _WHOLE, _STORED, stream, _sortable(number))

    def confirmed(self, stream: bytes, number: int) -> int:
        """This chunk and everything before it in the log leave the spool; what is set aside stays. Returns how many."""
        where = f"state != ? AND position <= {_UP_TO}"
        return self._change("DELETE FROM chunk", where, _ASIDE, stream, _sortable(number))

    def set_aside(self, stream: bytes, number: int) -> int:
        """The server will never take this stream from this number on: it is not sent again. Returns how many."""
        where = "state != ? AND stream = ? AND number >= ?"
        return self._change("UPDATE chunk SET state = ?", where, _ASIDE, _ASIDE, stream, _sortable(number))

    def _change(self, statement: str, where: str, *values: bytes | int) -> int:
        """Without an fsync: the server says it again. Few rows at a time, which takes little room on a full disk."""
        few = f"{statement} WHERE position IN (SELECT position FROM chunk WHERE {where} LIMIT {_FEW})"  # noqa: S608
        count = changed = self._db.write(lambda: self._db.run(few, values).rowcount, durable=False)
        while changed == _FEW:
            changed = self._db.write(lambda: self._db.run(few, values).rowcount, durable=False)
            count += changed
        return count

    def statistics(self) -> SpoolStatistics:
        """What is in the spool at this moment."""
        with self._db.errors():
            held = {row[0]: row[1:] for row in self._db.run("SELECT * FROM held")}
            dropped = self._db.one("SELECT dropped_bodies FROM spool") or (0,)
        chunks, records, size = map(sum, zip(*held.values(), strict=True))
        return SpoolStatistics(chunks, records, size, held[_BARE][0] + held[_WHOLE][0], held[_ASIDE][0], *dropped)


def _sortable(number: int | None) -> bytes:
    return b"" if number is None else number.to_bytes(8, "big")
