"""The robot's replica of its own log: chunks from the moment they are sealed until they are confirmed on the chain.

A store with one robot in it. What `append` returned for survives kill -9 and the loss of power. When the spool is at
its bound, or its disk is full, there is room for what is new at the expense of what is old:

    1. chunks that the server's head covers, the oldest first; then those set aside
    2. bodies of the oldest other ones; the robot signs that form of the chunk, and it is still sent
    3. the oldest without body: they take at most an eighth of the room; the links of the log show it
"""

from __future__ import annotations

import logging
import sys
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Final, NamedTuple

from rosbridge_eth.errors import StoreError
from rosbridge_eth.log.chunk import Chunk, Log, Malformed
from rosbridge_eth.log.database import DiskFull
from rosbridge_eth.log.sqlite import SqliteStore
from rosbridge_eth.log.store import DEAD_LETTERS, NOWHERE, Offer, Outcome, Row, place_of

log = logging.getLogger(__name__)

_APPLICATION: Final = 0x52425350  # "RBSP"
_BARE_SHARE: Final = 8  # of what is there, for chunks without body
_SPARE: Final = 64 * 1024  # bytes removed beyond a chunk's own on a full disk, where pages count and not bytes
_FEW: Final = 32  # rows that one transaction removes: on a full disk there is little room for its log
_DROPPED, _CONFIRMED = 0.0, -1.0
"""When a chunk was taken whose body was given up since, and the newest one that is confirmed."""


class SpoolStatistics(NamedTuple):
    """What is in the spool and not confirmed. unstored: chunks above the server's head, as it was told last; aside:
    refused ones, which are not among the `chunks`. dropped_bodies: those that were given up since it was opened, and
    the server had not.
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
        self._path, self._tk, self._max_bytes, self._drop = path, log.tk, max_bytes, drop
        self.disk_was_full = False
        """Whether old chunks gave way because the disk had no room for a new one, and not because of max_bytes."""
        self._store = SqliteStore(
            path, log.ledger, sys.maxsize, sys.maxsize, what="spool", application=_APPLICATION, wal_pages=128,
            exclusive=True, read_only=read_only,
        )  # fmt: skip
        try:
            if self._store.sizes().keys() - {log.tk}:
                raise StoreError(
                    f"the spool {path} is another robot's; what it holds is signed for that one alone: move it away"
                )
            [state] = self._store.states([log.tk])
            self._aside = self._held_aside()  # bytes
        except BaseException:
            self.close()
            raise
        self.newest, self.last_digest = state.head, state.digest
        """Place and digest of the newest chunk ever appended: `previous` of the next one."""
        self.covered = state.confirmed
        """The server's head, as it was told last: what is up to there may leave for what is new."""
        self._bare_to, self._bare = NOWHERE, 0  # up to here no row has a body, and how many bytes those rows take
        self._dropped_bodies = 0

    def close(self) -> None:
        self._store.close()

    # What looks

    def rows(self, after: bytes, limit: int) -> list[Row]:
        """Up to `limit` chunks behind a place, in order; without those set aside."""
        return self._store.rows(self._tk, after, limit)

    def chunks(self, places: Sequence[bytes]) -> list[bytes]:
        """The encoded chunks at these places."""
        return self._store.chunks(self._tk, places)

    def chunk(self, place: bytes, digest: bytes) -> Chunk | None:
        """The chunk there, whose header has this digest; None where the disk changed it."""
        try:
            found = Chunk.parse(*self.chunks([place]))
        except Malformed:
            return None
        return found if found.header.digest == digest else None

    def place(self, digest: bytes) -> bytes | None:
        """The place of the chunk with this header, None if it is not here, or set aside."""
        return self._store.place(self._tk, digest)

    def statistics(self) -> SpoolStatistics:
        """What is in the spool at this moment."""
        first = [row.place for row in self.rows(NOWHERE, 1) if row.taken_at == _CONFIRMED]
        every, unstored = (self._store.behind(self._tk, max([place, *first])) for place in (NOWHERE, self.covered))
        aside = len(self._store.dead(DEAD_LETTERS)) if self._aside else 0
        return SpoolStatistics(*every[:3], unstored.chunks, aside, self._dropped_bodies)

    # What the server says

    def stored(self, head: bytes) -> None:
        """The server has the log up to this place; it may move back."""
        self._store.set_state(self._tk, confirmed=head)
        self.covered = head

    def confirmed(self, place: bytes) -> int:
        """What is up to this place leaves the spool, but for the newest of it, which shows a fork if there is one; what
        is set aside stays. Returns how many are newly confirmed."""
        count = 0
        while len(rows := [row for row in self.rows(NOWHERE, _FEW) if row.place <= place]) > 1:
            self._remove(rows[:-1])
            count += sum(row.taken_at != _CONFIRMED for row in rows[:-1])
        if rows and rows[0].taken_at != _CONFIRMED:
            if chunk := self.chunk(rows[0].place, rows[0].digest):
                self._store.replace(self._tk, chunk, _CONFIRMED)
            else:
                self._remove(rows)
            count += 1
        return count

    def set_aside(self, digest: bytes) -> bytes | None:
        """The chunk with this header is wrong: it is not sent again. Its place, None if it is not here."""
        place = self.place(digest)
        if place is not None:
            self._store.remove(self._tk, [place], "it is wrong")
            self._aside = self._held_aside()
            self._bare_to, self._bare = NOWHERE, 0
        return place

    def _held_aside(self) -> int:
        return sum(len(letter.chunk) for letter in self._store.dead(DEAD_LETTERS))

    def _remove(self, rows: Sequence[Row]) -> None:
        self._store.remove(self._tk, [row.place for row in rows])
        self._bare -= sum(row.size for row in rows if row.place <= self._bare_to)

    # What comes, and what gives way to it

    def append(self, chunk: Chunk) -> None:
        """Add the next chunk of the log. DiskFull where even the removal of old ones makes no room for it."""
        try:
            self._append(chunk, spare=0)
        except DiskFull as error:
            if not self.disk_was_full:
                log.warning("%s; until then the oldest chunks give way to new ones", error)
            self.disk_was_full = True
            self._append(chunk, spare=4 * len(chunk.encoded) + _SPARE)
        self.newest, self.last_digest = place_of(chunk.header), chunk.header.digest

    def _append(self, chunk: Chunk, *, spare: int) -> None:
        size, before = len(chunk.encoded), (self._bare_to, self._bare, self._aside, self._dropped_bodies)
        offer = Offer(self._tk, chunk, self.last_digest)  # its own log goes on as the robot says

        def write() -> None:
            self._bare_to, self._bare, self._aside, self._dropped_bodies = before
            self._shrink(min(self._max_bytes - size, self._bytes() - spare))
            [outcome] = self._store.append([offer], chunk.header.sealed_ms / 1000)
            if outcome is not Outcome.STORED and self.place(chunk.header.digest) is None:
                raise StoreError(f"the spool {self._path} holds what is newer than {chunk.header}; move it away")

        try:
            self._store.together(write)
        except BaseException:
            self._bare_to, self._bare, self._aside, self._dropped_bodies = before
            raise

    def _bytes(self) -> int:
        return self._store.sizes().get(self._tk, 0) + self._aside

    def _shrink(self, limit: int) -> None:
        """Remove until no more than `limit` bytes are left, in the order that the module's docstring gives."""
        while (held := self._bytes()) > max(0, limit):
            oldest = self.rows(NOWHERE, 1)
            if oldest and oldest[0].place <= self.covered:
                self._remove(oldest)
            elif self._aside:
                self._dropped_bodies += len(self._store.dead(DEAD_LETTERS))
                self._store.forget_dead()
                self._aside = 0
            elif (whole := self._oldest_body()) is None or self._bare > held // _BARE_SHARE:
                self._remove(oldest)
            else:
                bare = self._drop(whole)
                self._store.replace(self._tk, bare, _DROPPED)
                self._bare_to, self._bare = place_of(bare.header), self._bare + len(bare.encoded)
                self._dropped_bodies += 1

    def _oldest_body(self) -> Chunk | None:
        """The oldest chunk with a body; those before it are counted as bare."""
        while rows := self.rows(self._bare_to, 200):
            for row in rows:
                chunk = None if row.taken_at == _DROPPED else self.chunk(row.place, row.digest)
                if chunk and chunk.body:
                    return chunk
                self._bare_to, self._bare = row.place, self._bare + row.size
        return None
