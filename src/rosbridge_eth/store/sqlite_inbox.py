"""The inbox in a SQLite file: the embedded back end."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from hashlib import blake2b
from pathlib import Path
from typing import NamedTuple

from rosbridge_eth.errors import StoreError
from rosbridge_eth.records import RecordId, SealedRecord
from rosbridge_eth.store import sql
from rosbridge_eth.store.database import damage_error, is_damage, open_database, primary_code, transaction
from rosbridge_eth.store.inbox import (
    DEFAULT_LIMITS,
    DeadLetter,
    InboxLimits,
    InboxStatistics,
    LeasedRecord,
    Outcome,
    State,
)

_FINISHED = {1: State.DONE, 2: State.DEAD}
_CODES = {state: code for code, state in _FINISHED.items()}
_KNOWN_STREAMS = 4096


class _Place(NamedTuple):
    """The numbers that the database gave to a robot and one of its streams."""

    robot: int
    stream: int


class SqliteInbox:
    """`Inbox` in one file. An object belongs to one thread; open one per process, after forking."""

    def __init__(self, path: Path | str, limits: InboxLimits = DEFAULT_LIMITS) -> None:
        self._path = Path(path)
        self._limits = limits
        self._db = open_database(
            self._path, application=sql.INBOX_APPLICATION, schema=sql.INBOX_SCHEMA, what="inbox", exclusive=False
        )
        self._places: dict[tuple[bytes, bytes], _Place] = {}

    def __enter__(self) -> SqliteInbox:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def close(self) -> None:
        self._db.close()

    def append(self, records: Sequence[SealedRecord], now: float) -> list[Outcome]:
        if not records:
            return []
        with self._writing() as db:
            held_records, held_bytes = db.execute(sql.INBOX_HELD).fetchone()
            room = _Room(self._limits.records - held_records, self._limits.bytes - held_bytes)
            outcomes = [self._append(record, now, room) for record in records]
            if room.records_taken:
                db.execute(sql.INBOX_HOLD, (room.records_taken, room.bytes_taken))
        return outcomes

    def _append(self, record: SealedRecord, now: float, room: _Room) -> Outcome:
        id, ciphertext, seq = record.id, record.ciphertext, _seq(record.id)
        place = self._place(id)
        taken_by = None
        if place is not None:
            taken_by = self._known(place, seq, ciphertext)
            if taken_by is Outcome.DUPLICATE:
                return taken_by
        if not room.take(len(ciphertext)):
            # The conflicting bytes may be kept already, from before.
            return Outcome.FULL
        if place is None:
            place = self._add_place(id)
        if taken_by is Outcome.CONFLICT:
            buried = self._db.execute(
                sql.INBOX_BURY,
                (place.stream, seq, _digest(ciphertext), ciphertext, 1, "this identity is taken by other bytes", now),
            )
            if buried.rowcount != 1:
                room.give_back(len(ciphertext))
            return Outcome.CONFLICT
        self._db.execute(sql.INBOX_ADD, (place.robot, place.stream, seq, ciphertext, now))
        return Outcome.NEW

    def _known(self, place: _Place, seq: bytes, ciphertext: bytes) -> Outcome | None:
        waiting = self._db.execute(sql.INBOX_WAITING, (*place, seq)).fetchone()
        if waiting is not None:
            return Outcome.DUPLICATE if waiting[1] == ciphertext else Outcome.CONFLICT
        finished = self._db.execute(sql.INBOX_FINISHED, (place.stream, seq)).fetchone()
        if finished is not None:
            return Outcome.DUPLICATE if finished[0] == _digest(ciphertext) else Outcome.CONFLICT
        return None

    def lease(
        self, consumer: str, *, limit: int, max_bytes: int, now: float, ttl: float, robot: bytes | None = None
    ) -> list[LeasedRecord]:
        with self._writing() as db:
            turn = db.execute(sql.INBOX_TURN, {"robot": robot, "now": now, "consumer": consumer}).fetchone()
            if turn is None:
                return []
            leased, numbers, total = list[LeasedRecord](), list[int](), 0
            rows = db.execute(sql.INBOX_NEXT, {"robot": turn[0], "now": now, "limit": limit})
            for number, tk, stream, seq, ciphertext, arrived, attempts in rows:
                total += len(ciphertext)
                if leased and total > max_bytes:
                    break
                id = RecordId(tk, stream, int.from_bytes(seq, "big"))
                leased.append(LeasedRecord(SealedRecord(id, ciphertext), arrived, attempts + 1))
                numbers.append(number)
            db.executemany(sql.INBOX_LEASE, [(consumer, now + ttl, number) for number in numbers])
            db.execute(sql.INBOX_TAKE_TURN, turn)
        return leased

    def release(self, consumer: str, ids: Iterable[RecordId]) -> None:
        with self._writing() as db:
            placed = ((self._place(id), id) for id in ids)
            db.executemany(
                sql.INBOX_RELEASE, [(*place, _seq(id), consumer) for place, id in placed if place is not None]
            )

    def reclaim(self, consumer: str) -> None:
        with self._writing() as db:
            db.execute(sql.INBOX_RECLAIM, (consumer,))

    def held(self, robot: bytes, limit: int) -> list[SealedRecord]:
        with self._reading() as db:
            return [
                SealedRecord(RecordId(robot, stream, int.from_bytes(seq, "big")), ciphertext)
                for stream, seq, ciphertext in db.execute(sql.INBOX_HELD_OF, (robot, limit))
            ]

    def done(self, ids: Iterable[RecordId], now: float) -> None:
        self._finish(ids, State.DONE, "", now)

    def dead_letter(self, ids: Iterable[RecordId], reason: str, now: float) -> None:
        self._finish(ids, State.DEAD, reason, now)

    def _finish(self, ids: Iterable[RecordId], state: State, reason: str, now: float) -> None:
        with self._writing() as db:
            freed_records = freed_bytes = 0
            for id in ids:
                place, seq = self._place(id), _seq(id)
                row = None if place is None else db.execute(sql.INBOX_WAITING, (*place, seq)).fetchone()
                if place is None or row is None:
                    continue
                number, ciphertext = row[:2]
                digest = _digest(ciphertext)
                db.execute(sql.INBOX_REMOVE, (number,))
                db.execute(sql.INBOX_FINISH, (place.stream, seq, digest, _CODES[state], now))
                if state is State.DEAD:
                    db.execute(sql.INBOX_BURY, (place.stream, seq, digest, ciphertext, 0, reason, now))
                else:
                    freed_records += 1
                    freed_bytes += len(ciphertext)
            if freed_records:
                db.execute(sql.INBOX_HOLD, (-freed_records, -freed_bytes))

    def dead_letters(self, limit: int = 100, *, after: int = 0) -> list[DeadLetter]:
        with self._reading() as db:
            return [
                DeadLetter(
                    SealedRecord(RecordId(tk, stream, int.from_bytes(seq, "big")), ciphertext),
                    bool(conflict),
                    reason,
                    at,
                )
                for tk, stream, seq, ciphertext, conflict, reason, at in db.execute(sql.INBOX_DEAD, (after, limit))
            ]

    def state(self, id: RecordId, now: float) -> State:
        with self._reading() as db:
            place = self._place(id)
            if place is None:
                return State.UNKNOWN
            # A record moves from waiting to finished, never back: looked up in this order it is not missed.
            waiting = db.execute(sql.INBOX_WAITING, (*place, _seq(id))).fetchone()
            if waiting is not None:
                return State.LEASED if waiting[3] > now else State.WAITING
            finished = db.execute(sql.INBOX_FINISHED, (place.stream, _seq(id))).fetchone()
            return State.UNKNOWN if finished is None else _FINISHED[finished[1]]

    def statistics(self, now: float) -> InboxStatistics:
        with self._reading() as db:
            waiting, leased, done, dead, held, oldest = db.execute(sql.INBOX_COUNT, {"now": now}).fetchone()
        return InboxStatistics(waiting, leased, done, dead, held, None if oldest is None else now - oldest)

    def forget(self, done_before: float, limit: int = 10_000) -> int:
        with self._writing() as db:
            return db.execute(sql.INBOX_FORGET, (done_before, limit)).rowcount

    def _place(self, id: RecordId) -> _Place | None:
        place = self._places.get((id.robot, id.stream))
        if place is None:
            row = self._db.execute(sql.INBOX_STREAM, (id.robot, id.stream)).fetchone()
            if row is not None:
                place = _Place(*row)
                if len(self._places) >= _KNOWN_STREAMS:
                    self._places.clear()
                self._places[id.robot, id.stream] = place
        return place

    def _add_place(self, id: RecordId) -> _Place:
        row = self._db.execute(sql.INBOX_ROBOT, (id.robot,)).fetchone()
        robot = row[0] if row is not None else _row_id(self._db.execute(sql.INBOX_ADD_ROBOT, (id.robot,)))
        return _Place(robot, _row_id(self._db.execute(sql.INBOX_ADD_STREAM, (robot, id.stream))))

    @contextmanager
    def _reading(self) -> Iterator[sqlite3.Connection]:
        try:
            yield self._db
        except sqlite3.Error as error:
            raise self._failure(error) from None

    @contextmanager
    def _writing(self) -> Iterator[sqlite3.Connection]:
        try:
            with transaction(self._db):
                yield self._db
        except BaseException as error:
            self._places.clear()  # numbers given in a transaction that failed are void
            if isinstance(error, sqlite3.Error):
                raise self._failure(error) from None
            raise

    def _failure(self, error: sqlite3.Error) -> StoreError:
        if is_damage(error):
            return damage_error(self._path, "inbox", error, move=False)
        if primary_code(error) == sqlite3.SQLITE_FULL:
            return StoreError(f"the disk of the inbox {self._path} is full; nothing was lost, make room")
        return StoreError(f"the inbox {self._path} cannot be used: {error}")


class _Room:
    """What the bounds leave for one append."""

    def __init__(self, records: int, size: int) -> None:
        self._records, self._bytes = records, size
        self.records_taken = self.bytes_taken = 0

    def take(self, size: int) -> bool:
        if self.records_taken + 1 > self._records or self.bytes_taken + size > self._bytes:
            return False
        self.records_taken += 1
        self.bytes_taken += size
        return True

    def give_back(self, size: int) -> None:
        self.records_taken -= 1
        self.bytes_taken -= size


def _seq(id: RecordId) -> bytes:
    return id.seq.to_bytes(8, "big")


def _digest(ciphertext: bytes) -> bytes:
    return blake2b(ciphertext, digest_size=16).digest()


def _row_id(cursor: sqlite3.Cursor) -> int:
    if cursor.lastrowid is None:
        raise StoreError("the database gave no number to a new row")
    return cursor.lastrowid
