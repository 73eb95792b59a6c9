"""Opening a SQLite file that records depend on: durable, private, checked, and refused with a way out."""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

from rosbridge_eth.errors import StoreError

_DAMAGED = {sqlite3.SQLITE_CORRUPT, sqlite3.SQLITE_NOTADB}
_BESIDE = ("-wal", "-shm")
VERSION = 1


def primary_code(error: sqlite3.Error) -> int:
    """SQLite's result code without its extension; 0 for an error that Python's module raised itself."""
    return getattr(error, "sqlite_errorcode", 0) & 0xFF


def is_damage(error: sqlite3.Error) -> bool:
    return primary_code(error) in _DAMAGED


def open_database(path: Path, *, application: int, schema: str, what: str, exclusive: bool) -> sqlite3.Connection:
    """Open or make the database `path`, mode 0600; autocommit, so that transactions are explicit.

    what: "spool" or "inbox", for messages. exclusive: no other process may
    have it. StoreError if it is damaged, of another kind or a newer version, in
    use, or cannot be made. Nobody else holds a damaged file that is exclusive,
    so it is moved aside and the next start begins an empty one.
    """
    try:
        os.close(os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600))
    except OSError as error:
        raise StoreError(f"the {what} {path} cannot be opened: {error.strerror}") from None
    db = sqlite3.connect(path, timeout=0.2 if exclusive else 10, isolation_level=None, check_same_thread=False)
    try:
        _prepare(db, path, application=application, schema=schema, what=what, exclusive=exclusive)
    except BaseException:
        db.close()
        raise
    return db


def _prepare(
    db: sqlite3.Connection, path: Path, *, application: int, schema: str, what: str, exclusive: bool
) -> None:
    try:
        if exclusive:
            db.execute("PRAGMA locking_mode = EXCLUSIVE")
        if path.stat().st_size == 0:
            db.execute("PRAGMA auto_vacuum = INCREMENTAL")  # possible only before there is anything
        db.execute("PRAGMA journal_mode = WAL")
        db.execute("PRAGMA synchronous = FULL")
        db.execute("PRAGMA foreign_keys = ON")
        with transaction(db):
            (found,) = db.execute("PRAGMA application_id").fetchone()
            (version,) = db.execute("PRAGMA user_version").fetchone()
            (tables,) = db.execute("SELECT count(*) FROM sqlite_master").fetchone()
            if tables == 0 and found == 0:
                for statement in _statements(schema):
                    db.execute(statement)
                db.execute(f"PRAGMA application_id = {application}")
                db.execute(f"PRAGMA user_version = {VERSION}")
            elif found != application:
                raise StoreError(f"{path} is a database, but no {what}; name another file")
            elif version != VERSION:
                raise StoreError(f"the {what} {path} has version {version}; this program knows {VERSION}")
        (health,) = db.execute("PRAGMA quick_check(1)").fetchone()
        if health != "ok":
            raise sqlite3.DatabaseError(health)
    except sqlite3.Error as error:
        db.close()
        if primary_code(error) in (sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED):
            raise StoreError(f"the {what} {path} is in use by another process; stop that one first") from None
        if is_damage(error) or primary_code(error) == 0:
            raise damage_error(path, what, error, move=exclusive) from None
        raise StoreError(f"the {what} {path} cannot be opened: {error}") from None


def damage_error(path: Path, what: str, error: sqlite3.Error, *, move: bool) -> StoreError:
    """The error that says so, and how to go on; the file is kept, under another name if `move`."""
    number = 1
    while (aside := path.with_name(f"{path.name}.damaged-{number}")).exists():
        number += 1
    reason = " ".join(str(error).split())
    salvage = f"'sqlite3 {aside} .recover' salvages what it held"
    if not move:
        return StoreError(
            f"the {what} {path} is damaged ({reason}); stop every process that uses it, move it and the files beside "
            f"it ({', '.join(path.name + suffix for suffix in _BESIDE)}) to {aside}, and start again; {salvage}"
        )
    for suffix in ("", *_BESIDE):
        part = path.with_name(path.name + suffix)
        if part.exists():
            part.rename(aside.with_name(aside.name + suffix))
    return StoreError(
        f"the {what} {path} is damaged ({reason}) and was kept as {aside}; "
        f"start again to go on with an empty {what}; {salvage}"
    )


def _statements(schema: str) -> Iterator[str]:
    statement = ""
    for line in schema.splitlines(keepends=True):
        statement += line
        if sqlite3.complete_statement(statement):
            yield statement
            statement = ""


@contextmanager
def transaction(db: sqlite3.Connection) -> Iterator[None]:
    """Write now or not at all: locks at once, so that two processes never read first and then both write."""
    db.execute("BEGIN IMMEDIATE")
    try:
        yield
        db.execute("COMMIT")
    except BaseException:
        if db.in_transaction:  # some failures (a full disk) roll back by themselves
            db.execute("ROLLBACK")
        raise
