"""SQLite files that chunks depend on: durable, private, refused where they are damaged, usable on a full disk.

WAL mode, one fsync a commit: what was committed survives the loss of power. A page that the log (FILE-wal) adds
to the file needs room on the disk a second time, when it is copied there, and as long as it cannot be copied
nothing at all can be written, not even what removes. So a file FILE.reserve keeps that room: the log is copied
every `wal_pages`, and a write that finds the disk full removes the reserve, has the log copied, and is tried again.
As long as the reserve cannot be made again, the file may not grow: rows can be removed, and others take their place.
"""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from itertools import count
from pathlib import Path
from typing import Any, TypeVar

from rosbridge_eth.errors import StoreError

VERSION = 2
_PAGE = 4096  # bytes
BUSY_TIMEOUT = 10.0  # s that a write waits for those of other processes
_LARGEST = 1073741823  # pages of a database, SQLite's own limit
DAMAGED = {sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB}
_IN_USE = {sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED}
_BESIDE = ("", "-wal", "-shm")

T = TypeVar("T")


class DiskFull(StoreError):
    """Nothing was written: the disk has no room for it. What was written before is safe."""


class InUse(StoreError):
    """Another process has the file."""


class NothingThere(StoreError):
    """There is nothing to read: it has not been made yet."""


def _code(error: sqlite3.Error) -> int:
    """SQLite's result code without its extension; 0 for an error of Python's module itself."""
    return getattr(error, "sqlite_errorcode", 0) & 0xFF


def _make(path: Path) -> None:
    """An empty file for its owner alone, unless there is one, which is not opened: to close it would drop the locks
    of this process's other connections (sqlite.org/howtocorrupt.html, 2.2), and the next process that closes the file
    would then remove its log. OSError if it cannot be written.
    """
    try:
        os.utime(path)
    except FileNotFoundError:
        with suppress(FileExistsError):
            os.close(os.open(path, os.O_RDWR | os.O_CREAT | os.O_EXCL | os.O_CLOEXEC, 0o600))


class Database:
    """One file. An object belongs to one thread; open one per process, after forking.

    what: "spool" or "inbox", for messages. application: see SQLite's application_id. schema: makes the tables that
    are not there. wal_pages: how long the log grows; the reserve is twice that, for one transaction more.
    exclusive: no other process may have it; a damaged file, which then nobody else holds, is moved aside.
    read_only: nothing is made or changed; NothingThere if there is no file.
    StoreError if it is of another kind, version or edition, damaged, in use, or cannot be made.
    """

    def __init__(
        self, path: Path, what: str, *, application: int, schema: str, wal_pages: int, exclusive: bool = False,
        read_only: bool = False,
    ) -> None:  # fmt: skip
        self.path, self._what, self._wal_pages = path, what, wal_pages
        self._exclusive = exclusive and not read_only
        self._reserve = path.with_name(path.name + ".reserve")
        self._nothing = NothingThere(f"there is no {what} {path} yet")
        if read_only and not path.exists():
            raise self._nothing
        try:
            if not read_only:
                _make(path)
        except OSError as error:
            raise StoreError(f"the {what} {path} cannot be opened: {error.strerror}") from None
        # Without a log there is nothing that it could add, and SQLite would make one even to read.
        unused = read_only and not path.with_name(path.name + "-wal").exists()
        mode = ("?mode=ro" if read_only else "?mode=rw") + ("&immutable=1" if unused else "")
        with self.errors():
            self._db = sqlite3.connect(
                path.absolute().as_uri() + mode, uri=True, timeout=0.2 if exclusive or read_only else BUSY_TIMEOUT,
                isolation_level=None, check_same_thread=False,
            )  # fmt: skip
        self._file = path.stat()
        try:
            self._open(application, schema, read_only)
        except BaseException:
            self.close()
            raise

    def _open(self, application: int, schema: str, read_only: bool) -> None:
        with self.errors(opening=True):
            if self._exclusive:
                self._db.execute("PRAGMA locking_mode = EXCLUSIVE")  # and no -shm file, which would need room
            self._db.execute("PRAGMA temp_store = MEMORY")
            found, version = self.one("PRAGMA application_id")[0], self.one("PRAGMA user_version")[0]
            if found == 0 and self.one("SELECT count(*) FROM sqlite_master")[0] == 0:
                if read_only:
                    raise self._nothing
                self._db.execute("PRAGMA journal_mode = WAL")
                self._db.executescript(
                    f"BEGIN IMMEDIATE; {schema} PRAGMA application_id = {application};"
                    f" PRAGMA user_version = {VERSION}; COMMIT"
                )
                found, version = application, VERSION
            if (found, version) != (application, VERSION):
                raise StoreError(
                    f"{self.path} is no {self._what} of version {VERSION}; name another file, or let the program that"
                    " wrote it finish what it holds, and move it away"
                )
            if not read_only:
                self._db.execute("PRAGMA journal_mode = WAL")
                self._db.execute(f"PRAGMA wal_autocheckpoint = {self._wal_pages}")
                self._reserved()
            if self._exclusive:
                self.check()

    def check(self) -> None:
        """StoreError if the file is damaged; reads all of it."""
        with self.errors(opening=True):
            if (health := self.one("PRAGMA quick_check(1)")[0]) != "ok":
                raise sqlite3.DatabaseError(health)

    def replaced(self) -> bool:
        """Whether the path leads to another file by now, or to none."""
        try:
            return not os.path.samestat(self._file, self.path.stat())
        except FileNotFoundError:
            return True

    def close(self) -> None:
        self._db.close()

    def run(self, statement: str, values: Any = ()) -> sqlite3.Cursor:
        return self._db.execute(statement, values)

    def one(self, statement: str, values: Any = ()) -> Any:
        """The first row, or None."""
        return self._db.execute(statement, values).fetchone()

    def write(self, action: Callable[[], T], *, durable: bool = True) -> T:
        """Carry out `action` in one transaction, or not at all; it may be called twice. DiskFull, StoreError.

        durable=False: without an fsync, for what is asked again if a power cut takes it. A write within a write is a
        part of that one.
        """
        if self._db.in_transaction:
            return action()
        with self.errors():
            self._db.execute(f"PRAGMA synchronous = {'FULL' if durable else 'NORMAL'}")
            try:
                return self._transact(action, grow=self._reserved())
            except sqlite3.Error as error:
                if _code(error) != sqlite3.SQLITE_FULL:
                    raise
                self._reserve.unlink(missing_ok=True)
                self._db.execute("PRAGMA wal_checkpoint").fetchall()
            return self._transact(action, grow=False)

    def _transact(self, action: Callable[[], T], *, grow: bool) -> T:
        self._db.execute("BEGIN IMMEDIATE")
        try:
            self._db.execute(f"PRAGMA max_page_count = {_LARGEST if grow else 1}")  # at least those that are there
            result = action()
            self._db.execute("COMMIT")
        except BaseException:
            if self._db.in_transaction:  # some failures (a full disk) roll back by themselves
                self._db.execute("ROLLBACK")
            raise
        return result

    def _reserved(self) -> bool:
        """Whether the reserve is there, or could be made."""
        size = 2 * self._wal_pages * _PAGE
        try:
            if self._reserve.exists() and self._reserve.stat().st_size == size:  # a crash may have cut it short
                return True
            room = os.statvfs(self.path.parent)
            if room.f_bavail * room.f_frsize < size:
                return False
            self._reserve.write_bytes(os.urandom(size))  # what no file system compresses
            return True
        except OSError:  # what is the matter, the write to the database says
            with suppress(OSError):
                self._reserve.unlink()
            return False

    @contextmanager
    def errors(self, *, opening: bool = False) -> Iterator[None]:
        """Turn SQLite's errors into StoreError, with what to do."""
        try:
            yield
        except sqlite3.Error as error:
            where, code = f"the {self._what} {self.path}", _code(error)
            if code in _IN_USE:
                raise InUse(f"{where} is in use by another process; stop that one first") from None
            if code in DAMAGED or (opening and code == 0):
                raise self._damage(" ".join(str(error).split()), move=opening and self._exclusive) from None
            if code == sqlite3.SQLITE_FULL:
                raise DiskFull(f"the disk of {where} is full; make room, what was kept before is safe") from None
            raise StoreError(f"{where} cannot be used ({error}); what was kept before is safe") from None

    def _damage(self, reason: str, *, move: bool) -> StoreError:
        numbered = (self.path.with_name(f"{self.path.name}.damaged-{number}") for number in count(1))
        aside = next(path for path in numbered if not path.exists())
        todo = f"stop what uses it, move it and the files beside it (-wal, -shm) to {aside}, and start again"
        if move:
            todo = f"it is kept as {aside}; start again, with an empty one"
            self.close()
            for suffix in _BESIDE:
                if (part := self.path.with_name(self.path.name + suffix)).exists():
                    part.rename(aside.with_name(aside.name + suffix))
        return StoreError(
            f"the {self._what} {self.path} is damaged ({reason}); {todo}; 'sqlite3 {aside} .recover' salvages what it"
            " held"
        )
