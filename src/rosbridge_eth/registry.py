"""Who is enrolled: the operator's list of names, their certificates and accounts, and the server's allow list.

One SQLite file in the operator's home. A name has at most one enrolment in
force; enrolling it again needs `replace`, which revokes the one before. The
server asks `allows` at every handshake and closes what is no longer allowed.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

from rosbridge_eth.errors import IdentityError, StoreError

OWNER = "owner"
"""The reader that `init` makes."""

SCHEMA = """
CREATE TABLE IF NOT EXISTS enrolment (
    number        INTEGER PRIMARY KEY,   -- order of enrolment; also the index of the account's derivation path
    role          TEXT NOT NULL,         -- robot | server | reader
    name          TEXT NOT NULL,
    fingerprint   BLOB NOT NULL UNIQUE,  -- SM3 of the signing certificate, 32 bytes
    certificates  BLOB NOT NULL,         -- signing and encryption certificate, PEM
    account       TEXT,                  -- the robot's address on the chain
    enrolled_at   TEXT NOT NULL,         -- UTC, ISO 8601
    revoked_at    TEXT                   -- NULL while in force
);
CREATE UNIQUE INDEX IF NOT EXISTS in_force ON enrolment (role, name) WHERE revoked_at IS NULL;
"""


@dataclass(frozen=True, slots=True)
class Enrolment:
    """One identity the operator made: certificates in PEM, signing first; account for robots only."""

    number: int
    role: str
    name: str
    fingerprint: bytes
    certificates: bytes
    account: str | None
    enrolled_at: datetime
    revoked_at: datetime | None


class Registry:
    """The enrolments of one operator's home; safe to open from several processes.

    new: make it, for a home that begins. Otherwise StoreError where it is missing, or lacks the identities that every
    home begins with: it was lost, and taken for a new one it would refuse every robot.
    """

    def __init__(self, path: Path, *, new: bool = False) -> None:
        self._path = path
        self._file = None if new else self._file_now()
        try:
            self._db = sqlite3.connect(
                f"{path.absolute().as_uri()}?mode={'rwc' if new else 'rw'}",
                uri=True, timeout=10, isolation_level=None, check_same_thread=False,
            )
        except sqlite3.Error as error:
            raise StoreError(self._lost(f"it cannot be opened as a database, {error}")) from error
        try:
            self._begin(new)
        except sqlite3.Error as error:
            self._db.close()
            raise StoreError(self._lost(f"it cannot be used as a database, {error}")) from error
        except BaseException:
            self._db.close()
            raise

    def _begin(self, new: bool) -> None:
        self._db.execute("PRAGMA journal_mode=WAL")
        self._db.execute("PRAGMA synchronous=FULL")
        self._db.executescript(SCHEMA)
        if new:
            self._file = self._file_now()
            return
        found = set(self._db.execute("SELECT DISTINCT role, name FROM enrolment WHERE role IN ('server', 'reader')"))
        if ("reader", OWNER) not in found or not any(role == "server" for role, _ in found):
            raise StoreError(self._lost("it lacks the server and the owner, whom `init` enrolled"))

    def _file_now(self) -> tuple[int, int]:
        """Which file stands at the path; StoreError if there is none."""
        try:
            found = self._path.stat()
        except OSError as error:
            raise StoreError(self._lost(error.strerror or str(error))) from error
        return found.st_dev, found.st_ino

    def _lost(self, why: str) -> str:
        return f"the registry {self._path} was lost or damaged ({why}): restore {self._path.name} from your backup"

    def close(self) -> None:
        self._db.close()

    @contextmanager
    def _transaction(self) -> Iterator[None]:
        self._db.execute("BEGIN IMMEDIATE")
        try:
            yield
        except BaseException:
            self._db.execute("ROLLBACK")
            raise
        self._db.execute("COMMIT")

    def revision(self) -> tuple[int, int]:
        """Another value after every change, whichever process made it; cheap, so readers can keep what they read.

        StoreError where another file, or none, stands at the path by now: changes would be made there and never seen.
        """
        if self._file_now() != self._file:
            raise StoreError(
                f"the registry {self._path} was replaced by another file while it was open, and what is in that one is"
                " not known here; end this process and start it again"
            )
        (others,) = self._db.execute("PRAGMA data_version").fetchone()
        return int(others), self._db.total_changes

    def next_number(self) -> int:
        """The number the next enrolment will get: never used before, so no account is ever shared."""
        (highest,) = self._db.execute("SELECT coalesce(max(number), 0) FROM enrolment").fetchone()
        return int(highest) + 1

    def require_free(self, role: str, name: str) -> None:
        """IdentityError where the name is in force."""
        if self.find(role, name) is not None:
            raise IdentityError(
                f"{role} {name!r} is enrolled already; choose another name, or give --replace to revoke the old one"
            )

    def enrol(
        self, *, number: int, role: str, name: str, fingerprint: bytes, certificates: bytes,
        account: str | None, now: datetime, replace: bool = False,
    ) -> Enrolment:
        """Put an identity in force; with `replace` the one that held the name is revoked in the same write."""
        with self._transaction():
            if replace:
                self._revoke(role, name, now)
            else:
                self.require_free(role, name)
            self._db.execute(
                "INSERT INTO enrolment VALUES (?, ?, ?, ?, ?, ?, ?, NULL)",
                (number, role, name, fingerprint, certificates, account, now.isoformat()),
            )
        found = self.find(role, name)
        if found is None:
            raise StoreError(f"the registry lost {role} {name!r} as it was written; check the disk")
        return found

    def _revoke(self, role: str, name: str, now: datetime) -> int:
        return self._db.execute(
            "UPDATE enrolment SET revoked_at = ? WHERE role = ? AND name = ? AND revoked_at IS NULL",
            (now.isoformat(), role, name),
        ).rowcount

    def revoke(self, role: str, name: str, now: datetime) -> None:
        """Take a name out of force; IdentityError where it is not in force."""
        if self._revoke(role, name, now) == 0:
            raise IdentityError(f"no {role} {name!r} is enrolled; `status` lists the names")

    def find(self, role: str, name: str) -> Enrolment | None:
        """The enrolment in force under this name."""
        rows = self._db.execute(
            "SELECT * FROM enrolment WHERE role = ? AND name = ? AND revoked_at IS NULL", (role, name)
        ).fetchall()
        return _enrolment(rows[0]) if rows else None

    def all(self, role: str | None = None) -> list[Enrolment]:
        """Every enrolment there ever was, in order."""
        rows = self._db.execute(
            "SELECT * FROM enrolment WHERE ?1 IS NULL OR role = ?1 ORDER BY number", (role,)
        ).fetchall()
        return [_enrolment(row) for row in rows]

    def allows(self, role: str, name: str, fingerprint: bytes) -> bool:
        """Is this very certificate the one in force for the name?"""
        found = self.find(role, name)
        return found is not None and found.fingerprint == fingerprint


def _enrolment(row: tuple[int, str, str, bytes, bytes, str | None, str, str | None]) -> Enrolment:
    number, role, name, fingerprint, certificates, account, enrolled_at, revoked_at = row
    return Enrolment(
        number, role, name, fingerprint, certificates, account,
        datetime.fromisoformat(enrolled_at).astimezone(UTC),
        None if revoked_at is None else datetime.fromisoformat(revoked_at).astimezone(UTC),
    )
