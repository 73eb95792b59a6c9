"""The robot's spool: sealed records from the moment they are sealed until the server has them.

Commits come in groups. A record that is still in the group when the process is
killed or the power fails is lost (at most `SpoolLimits.window` seconds and
`SpoolLimits.group` records), but it was never sent either: only committed
records are handed out. So the newest committed record is the newest that can
exist anywhere, and the next stream's `open` may say so.

The spool cannot read what it keeps. It knows a record's delivery class and,
of `latest` records, a lane: a number the robot gives to each topic as it
starts, forgotten when it stops, and never written down.
"""

from __future__ import annotations

import sqlite3
import threading
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass
from enum import IntEnum
from itertools import islice
from pathlib import Path
from typing import Final

from rosbridge_eth.errors import StoreError
from rosbridge_eth.records import RecordId, SealedRecord, SeqRange
from rosbridge_eth.store import sql
from rosbridge_eth.store.database import damage_error, is_damage, open_database, primary_code, transaction


class SpoolFull(StoreError):
    """The record was not kept: the spool is at its bound, or the disk has been full for long. A gap will say so."""


class Delivery(IntEnum):
    """What may happen to a record before it is acknowledged."""

    CONTROL = 0  # open, gap, end: never dropped
    RELIABLE = 1  # dropped at the bound alone, oldest first, when there are no `latest` ones left
    LATEST = 2  # superseded by a newer one of its lane that comes before it was sent; dropped first at the bound


@dataclass(frozen=True, slots=True)
class SpoolLimits:
    """records, bytes: the bound on what is kept; control records, a few hundred bytes a stream, come on top.

    group, window: a commit is due after so many records or seconds.
    unwritten: how many records wait in memory while the disk takes no more.
    """

    records: int = 1_000_000
    bytes: int = 256 << 20
    group: int = 64
    window: float = 0.05
    unwritten: int = 1024


@dataclass(frozen=True, slots=True)
class SpoolStatistics:
    """records, bytes: kept. superseded, dropped, refused: not, since the start. undeclared: ranges no gap names yet."""

    records: int
    bytes: int
    superseded: int
    dropped: int
    refused: int
    undeclared: int
    trouble: str | None


@dataclass(frozen=True, slots=True)
class _Waiting:
    """A record in memory, before its commit."""

    record: SealedRecord
    delivery: Delivery
    lane: int | None


@dataclass(frozen=True, slots=True)
class _Row:
    """A record in the file."""

    place: int
    delivery: Delivery
    size: int


_MAX_DECLARED: Final = 1024  # ranges; even if each is of a stream of its own they fit one record
_RESERVE: Final = 512 << 10  # bytes of a file beside the spool that is given up when the disk is full
_REMOVED_AT_ONCE: Final = 32  # records, when the disk is full; each changes a page or two of 4 KiB
_RETRY: Final = 1.0  # seconds between attempts to write while the disk refuses


class Spool:
    """One robot's spool in one file, which no other process may have. Safe for several threads.

    `now` is a monotonic clock in seconds. StoreError from any method: the file
    is damaged; the text says where it was kept and what to do.
    """

    def __init__(self, path: Path | str, robot: bytes, limits: SpoolLimits = SpoolLimits()) -> None:
        self._path, self._robot, self._limits = Path(path), robot, limits
        self._lock = threading.RLock()
        self._waiting: dict[RecordId, _Waiting] = {}
        self._removed: set[int] = set()  # places whose rows go with the next commit
        self._due: float | None = None
        self._trouble: str | None = None
        self._handed: dict[RecordId, _Row] = {}
        self._handed_to = 0
        self._returned: set[int] = set()
        self._dropped_to = dict.fromkeys(Delivery, 0)
        self._lanes: dict[int, tuple[RecordId, _Row | None]] = {}  # the newest record of each, while it is kept
        self._lane_of: dict[int, int] = {}  # by place
        self._superseded = self._dropped = self._refused = 0
        self._closed = False
        self._reserve_path = self._path.with_name(self._path.name + ".reserve")
        with suppress(OSError):  # if there is none, or no such folder, the next line says so
            self._reserve_path.unlink()
        self._db = open_database(
            self._path, application=sql.SPOOL_APPLICATION, schema=sql.SPOOL_SCHEMA, what="spool", exclusive=True
        )
        try:
            self._last, self._records, self._bytes, self._gaps = self._load()
        except BaseException:
            self._db.close()
            raise
        self._has_room()

    def _load(self) -> tuple[RecordId | None, int, int, _Gaps]:
        with self._translated():
            row = self._db.execute(sql.SPOOL_READ).fetchone()
            if row is None:
                self._db.execute(sql.SPOOL_BIND, (self._robot,))
                row = (self._robot, None, None)
            robot, stream, seq = row
            if robot != self._robot:
                raise StoreError(f"the spool {self._path} is another robot's; give each robot a spool of its own")
            sizes = [row[1:] for row in self._db.execute(sql.SPOOL_SIZE) if row[0] != Delivery.CONTROL]
            gaps = _Gaps(
                SeqRange(stream, int.from_bytes(first, "big"), int.from_bytes(last, "big"))
                for stream, first, last in self._db.execute(sql.UNDECLARED_READ)
            )
        last = None if stream is None else _id(robot, stream, seq)
        return last, sum(count for count, _ in sizes), sum(size for _, size in sizes), gaps

    def __enter__(self) -> Spool:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        """Write what is waiting and close; StoreError if it could not be written. Closing again does nothing."""
        with self._lock:
            if self._closed:
                return
            try:
                self._write()
                if self._trouble is not None:
                    raise StoreError(self._trouble)
            finally:
                self._closed = True
                self._db.close()

    @property
    def last(self) -> RecordId | None:
        """The newest record that was ever given to this spool: `previous` of a Sealer at its start."""
        with self._lock:
            return self._last

    @property
    def empty(self) -> bool:
        """Everything that was ever appended is acknowledged or dropped; control records count here."""
        with self._lock, self._translated():
            return not self._waiting and not self._handed and next(self._candidates(), None) is None

    @property
    def statistics(self) -> SpoolStatistics:
        with self._lock:
            return SpoolStatistics(
                records=self._records,
                bytes=self._bytes,
                superseded=self._superseded,
                dropped=self._dropped,
                refused=self._refused,
                undeclared=len(self._gaps),
                trouble=self._trouble,
            )

    # --- keeping

    def append(self, records: Sequence[SealedRecord], delivery: Delivery, now: float, lane: int = 0) -> None:
        """Keep records as the sealer gave them, in that order; one of seq 0 opens a stream and is CONTROL.

        lane: of LATEST records. SpoolFull if one was not kept; that it has to
        be declared is noted.
        """
        with self._lock:
            refused = None
            for record in records:
                try:
                    self._append(record, delivery if record.id.seq else Delivery.CONTROL, lane)
                except SpoolFull as error:
                    refused = error
            self.commit(now)
            if refused is not None:
                raise refused

    def _append(self, record: SealedRecord, delivery: Delivery, lane: int) -> None:
        id, size = record.id, len(record.ciphertext)
        self._last = id
        if delivery is not Delivery.CONTROL:
            if delivery is Delivery.LATEST:
                self._supersede(lane)
            try:
                self._make_room(size, delivery)
            except SpoolFull:
                self._refused += 1
                self._gaps.add(SeqRange(id.stream, id.seq, id.seq))
                raise
            self._records += 1
            self._bytes += size
        if delivery is Delivery.LATEST:
            self._lanes[lane] = id, None
        self._waiting[id] = _Waiting(record, delivery, lane if delivery is Delivery.LATEST else None)

    def _supersede(self, lane: int) -> None:
        id, row = self._lanes.pop(lane, (None, None))
        if id is None:
            return
        if row is None:
            superseded = id in self._waiting
            if superseded:
                self._forget(self._waiting.pop(id))
        else:
            superseded = row.place > self._handed_to or row.place in self._returned
            if superseded:
                self._remove(row)
        if superseded:
            self._superseded += 1
            self._gaps.add(SeqRange(id.stream, id.seq, id.seq))

    def _make_room(self, size: int, delivery: Delivery) -> None:
        limits = self._limits
        if self._trouble is not None and len(self._waiting) >= limits.unwritten:
            raise SpoolFull(self._trouble)
        while self._records + 1 > limits.records or self._bytes + size > limits.bytes:
            if size <= limits.bytes and self._drop_oldest(Delivery.LATEST):
                continue
            if size <= limits.bytes and delivery is Delivery.RELIABLE and self._drop_oldest(Delivery.RELIABLE):
                continue
            raise SpoolFull(f"the spool {self._path} is full ({self._records} records, {self._bytes} bytes)")

    def _drop_oldest(self, delivery: Delivery) -> bool:
        with self._translated():
            while True:
                found = self._db.execute(sql.SPOOL_OLDEST, (delivery, self._dropped_to[delivery])).fetchone()
                if found is None:
                    break
                place, stream, seq, size = found
                self._dropped_to[delivery] = place
                if place not in self._removed:
                    id = _id(self._robot, stream, seq)
                    self._handed.pop(id, None)
                    self._remove(_Row(place, delivery, size))
                    return self._note_dropped(id)
        for id, waiting in self._waiting.items():
            if waiting.delivery is delivery:
                self._forget(self._waiting.pop(id))
                return self._note_dropped(id)
        return False

    def _note_dropped(self, id: RecordId) -> bool:
        self._dropped += 1
        self._gaps.add(SeqRange(id.stream, id.seq, id.seq))
        return True

    def declare(self, seal: Callable[[Sequence[SeqRange]], Sequence[SealedRecord]], now: float) -> bool:
        """Have the dropped records declared, if there are any: `seal` makes the gap record of the ranges it is given.

        The gap record is kept and its ranges are forgotten in one commit. False
        if there was nothing to declare, or the disk takes nothing now. Declare
        when records can be sent: until then, ranges grow together.
        """
        with self._lock:
            ranges = self._gaps.some(_MAX_DECLARED)
            if not ranges or self._trouble is not None:
                return False
            for record in seal(ranges):
                self._append(record, Delivery.CONTROL, 0)
            for part in ranges:
                self._gaps.remove(part)
            self.commit(now)
            return True

    # --- sending

    def pending(self, limit: int, max_bytes: int = 1 << 20) -> list[SealedRecord]:
        """The next committed records, oldest first, that are not handed out; one at least, if there is one."""
        with self._lock, self._translated():
            records, total = list[SealedRecord](), 0
            for place, delivery, stream, seq, ciphertext in self._candidates():
                total += len(ciphertext)
                if len(records) == limit or (records and total > max_bytes):
                    break
                id = _id(self._robot, stream, seq)
                self._returned.discard(place)
                self._handed_to = max(self._handed_to, place)
                self._handed[id] = _Row(place, Delivery(delivery), len(ciphertext))
                records.append(SealedRecord(id, ciphertext))
            return records

    def _candidates(self) -> Iterator[tuple[int, int, bytes, bytes, bytes]]:
        for place in sorted(self._returned):
            yield self._db.execute(sql.SPOOL_ONE, (place,)).fetchone()
        for row in self._db.execute(sql.SPOOL_NEXT, (self._handed_to,)):
            if row[0] not in self._removed:
                yield row

    def returned(self, ids: Iterable[RecordId] | None = None) -> None:
        """These (or all) were handed out in vain, the session ended or the server was busy: hand them out again."""
        with self._lock:
            for id in list(self._handed if ids is None else ids):
                row = self._handed.pop(id, None)
                if row is not None:
                    self._returned.add(row.place)

    def acknowledged(self, ids: Iterable[RecordId], now: float) -> None:
        """The server has these: they leave. Of ids that are not handed out (dropped meanwhile) nothing happens."""
        with self._lock:
            for id in ids:
                row = self._handed.pop(id, None)
                if row is not None:
                    self._remove(row)
            self.commit(now)

    def _remove(self, row: _Row) -> None:
        self._removed.add(row.place)
        self._returned.discard(row.place)
        lane = self._lane_of.pop(row.place, None)
        if lane is not None and self._lanes.get(lane, (None, None))[1] == row:
            del self._lanes[lane]
        if row.delivery is not Delivery.CONTROL:
            self._records -= 1
            self._bytes -= row.size

    def _forget(self, waiting: _Waiting) -> None:
        self._records -= 1
        self._bytes -= len(waiting.record.ciphertext)

    # --- writing

    def next_commit(self) -> float | None:
        """When `commit` wants to be called again; None while there is nothing to write."""
        with self._lock:
            return self._due

    def commit(self, now: float) -> None:
        """Write the group if it is due. A disk that refuses is no error here: see `statistics.trouble`."""
        with self._lock:
            changes = len(self._waiting) + len(self._removed)
            if changes == 0 and not self._gaps.changed:
                self._due = None
                return
            if self._due is None:
                self._due = now + self._limits.window
            if now >= self._due or (changes >= self._limits.group and self._trouble is None):
                self._write()
                self._due = None if self._trouble is None else now + _RETRY

    def _write(self) -> None:
        if self._try_to_write():
            return
        with self._translated():
            self._drain()  # that may have made the room
        self._try_to_write()

    def _try_to_write(self) -> bool:
        """False if the disk is full; `_trouble` says whether, and why else, nothing was written."""
        try:
            if self._has_room():
                self._store(self._waiting, list(self._removed), self._last)
                self._waiting.clear()
                self._trouble = None
                return True
        except sqlite3.Error as error:
            if is_damage(error):
                raise self._damage(error) from None
            if primary_code(error) != sqlite3.SQLITE_FULL:
                self._trouble = f"the spool {self._path} cannot be written ({error}); what was kept before is safe"
                return True
        self._trouble = f"the disk of the spool {self._path} is full; make room, what was kept before is safe"
        return False

    def _store(self, waiting: Mapping[RecordId, _Waiting], removed: list[int], last: RecordId | None) -> None:
        """One transaction: these records and removals, and all gaps. What is in memory follows once it is done."""
        rows: list[_Row] = []
        with transaction(self._db):
            for id, one in waiting.items():
                ciphertext = one.record.ciphertext
                place = self._db.execute(
                    sql.SPOOL_KEEP, (one.delivery, id.stream, _seq(id.seq), ciphertext)
                ).lastrowid
                rows.append(_Row(place or 0, one.delivery, len(ciphertext)))
            self._db.executemany(sql.SPOOL_REMOVE, [(place,) for place in removed])
            gone, written = self._gaps.changes()
            self._db.executemany(sql.UNDECLARED_REMOVE, [(stream, _seq(first)) for stream, first in gone])
            self._db.executemany(
                sql.UNDECLARED_WRITE, [(stream, _seq(first), _seq(last)) for stream, first, last in written]
            )
            if last is not None:
                self._db.execute(sql.SPOOL_LAST, (last.stream, _seq(last.seq)))
        for (id, one), row in zip(waiting.items(), rows, strict=True):
            if one.lane is not None and self._lanes.get(one.lane) == (id, None):
                self._lanes[one.lane] = id, row
                self._lane_of[row.place] = one.lane
        self._removed.difference_update(removed)
        self._gaps.changed.clear()

    def _has_room(self) -> bool:
        """Whether the reserve is there, or can be made: as long as not, what room there is serves for removing."""
        if self._reserve_path.exists():
            return True
        try:
            self._reserve_path.write_bytes(bytes(_RESERVE))
        except OSError:
            self._reserve_path.unlink(missing_ok=True)
            return False
        return True

    def _drain(self) -> None:
        """On a full disk, let go at least of what was acknowledged, so that there is room for what is new.

        Even that needs some: the log takes a copy of every changed page until it is moved into the file. The
        reserve is given up for it, and little is removed at a time.
        """
        self._reserve_path.unlink(missing_ok=True)
        with suppress(sqlite3.OperationalError):  # still no room: all is as it was, and is tried again
            self._db.execute("PRAGMA wal_checkpoint(TRUNCATE)")
            places = sorted(self._removed)
            for start in range(0, max(len(places), 1), _REMOVED_AT_ONCE):  # once, if only for the gaps
                # The records in memory are not written, so the newest one written stays what it was.
                self._store({}, places[start : start + _REMOVED_AT_ONCE], None)
                self._db.execute(f"PRAGMA incremental_vacuum({2 * _REMOVED_AT_ONCE})").fetchall()
                self._db.execute("PRAGMA wal_checkpoint(TRUNCATE)")

    def _damage(self, error: sqlite3.Error) -> StoreError:
        self._closed = True
        self._db.close()
        return damage_error(self._path, "spool", error, move=True)

    @contextmanager
    def _translated(self) -> Iterator[None]:
        try:
            yield
        except sqlite3.Error as error:
            if is_damage(error):
                raise self._damage(error) from None
            raise StoreError(f"the spool {self._path} cannot be read: {error}") from None


class _Gaps:
    """Dropped records that no gap record declares yet, as the fewest ranges.

    Ranges of a stream do not touch, so between two of them lies a record that
    is kept or was sent; what is dropped at the bound is the oldest, which joins
    one range. changed: ranges (by stream and first) that the file has otherwise.
    """

    def __init__(self, ranges: Iterable[SeqRange]) -> None:
        self._last: dict[tuple[bytes, int], int] = {}  # (stream, first) -> last
        self._first: dict[tuple[bytes, int], int] = {}  # (stream, last + 1) -> first
        self.changed: set[tuple[bytes, int]] = set()
        for stream, first, last in ranges:
            self._last[stream, first] = last
            self._first[stream, last + 1] = first

    def __len__(self) -> int:
        return len(self._last)

    def add(self, part: SeqRange) -> None:
        stream, first, last = part
        before = self._first.pop((stream, first), None)
        if before is not None:
            first = before
        after = self._last.pop((stream, last + 1), None)
        if after is not None:
            self.changed.add((stream, last + 1))
            del self._first[stream, after + 1]
            last = after
        self._last[stream, first] = last
        self._first[stream, last + 1] = first
        self.changed.add((stream, first))

    def remove(self, part: SeqRange) -> None:
        stream, first, last = part
        del self._last[stream, first]
        del self._first[stream, last + 1]
        self.changed.add((stream, first))

    def some(self, limit: int) -> list[SeqRange]:
        return [SeqRange(stream, first, last) for (stream, first), last in islice(self._last.items(), limit)]

    def changes(self) -> tuple[list[tuple[bytes, int]], list[SeqRange]]:
        """Keys that are no more, and ranges to write."""
        gone = [key for key in self.changed if key not in self._last]
        return gone, [SeqRange(*key, self._last[key]) for key in self.changed if key in self._last]


def _seq(seq: int) -> bytes:
    return seq.to_bytes(8, "big")


def _id(robot: bytes, stream: bytes, seq: bytes) -> RecordId:
    return RecordId(robot, stream, int.from_bytes(seq, "big"))
