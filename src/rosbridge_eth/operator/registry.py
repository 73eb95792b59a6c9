"""Who is enrolled: the operator's list of names, their certificates and accounts, and the server's allow list.

One SQLite file in the operator's home. A name has at most one enrolment in
force; enrolling it again needs `replace`, which revokes the one before. The
server asks `allows` at every handshake and closes what is no longer allowed.
"""

from __future__ import annotations

import os
import sqlite3
from collections.abc import Iterable, Mapping
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, NamedTuple, Self

from eth_hash.auto import keccak

from rosbridge_eth.errors import IdentityError, StoreError
from rosbridge_eth.identity import PeerIdentity, Role
from rosbridge_eth.log.chunk import robot_id
from rosbridge_eth.log.database import DAMAGED

if TYPE_CHECKING:
    from rosbridge_eth.ledger import Standing

OWNER = "owner"
"""The reader that `init` makes."""

SCHEMA = """
CREATE TABLE IF NOT EXISTS enrolment (
    number        INTEGER PRIMARY KEY,   -- order of enrolment; also the index of the account's derivation path
    role          TEXT NOT NULL,         -- robot | server | reader
    name          TEXT NOT NULL,
    fingerprint   BLOB NOT NULL UNIQUE,  -- SM3 of the signing certificate, 32 bytes
    certificates  BLOB NOT NULL,         -- signing and encryption certificate, PEM
    hash          BLOB NOT NULL,         -- keccak256 of both in DER, which the contract has for a robot
    account       TEXT,                  -- the robot's address on the chain
    enrolled_at   TEXT NOT NULL,         -- UTC, ISO 8601
    revoked_at    TEXT                   -- NULL while in force
);
CREATE UNIQUE INDEX IF NOT EXISTS in_force ON enrolment (role, name) WHERE revoked_at IS NULL;
"""


class Enrolment(NamedTuple):
    """One identity the operator certified: a row as above, `account` for robots only."""

    number: int
    role: str
    name: str
    fingerprint: bytes
    certificates: bytes
    hash: bytes
    account: str | None
    enrolled_at: str
    revoked_at: str | None

    @property
    def tk(self) -> bytes:
        """The robot's identity on the chain, 32 bytes."""
        return robot_id(self.name)


class Registry:
    """The enrolments of one operator's home; safe to open from several processes, and a context manager.

    new: make it, for a home that begins. Otherwise StoreError where it is missing, or lacks the identities that every
    home begins with: it was lost, and taken for a new one it would refuse every robot.
    """

    def __init__(self, path: Path, *, new: bool = False) -> None:
        self._path = path
        try:
            self._db = sqlite3.connect(
                f"{path.absolute().as_uri()}?mode={'rwc' if new else 'rw'}", uri=True, timeout=10, isolation_level=None,
                check_same_thread=False,
            )  # fmt: skip
            self._db.execute("PRAGMA journal_mode=WAL")
            self._db.execute("PRAGMA synchronous=FULL")
            self._db.executescript(SCHEMA)
            self._file = path.stat()
            self._robots: tuple[tuple[int, int], dict[bytes, Enrolment]] | None = None  # by revision
            begun = set(self._db.execute("SELECT role, name FROM enrolment"))
        except (sqlite3.Error, OSError) as error:
            if (new or path.exists()) and getattr(error, "sqlite_errorcode", 0) & 0xFF not in DAMAGED:
                raise StoreError(f"the registry {path} cannot be used: {error}; see that you may write it") from error
            raise StoreError(self._lost(f"it cannot be used as a database, {error}")) from error
        if not new and (("reader", OWNER) not in begun or "server" not in {role for role, _ in begun}):
            self.close()
            raise StoreError(self._lost("it lacks the server and the owner, whom `init` enrolled"))

    def _lost(self, why: str) -> str:
        return f"the registry {self._path} was lost or damaged ({why}): restore {self._path.name} from your backup"

    def close(self) -> None:
        self._db.close()

    def __enter__(self) -> Self:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    def revision(self) -> tuple[int, int]:
        """Another value after every change, whichever process made it; cheap, so readers can keep what they read.

        StoreError where another file, or none, stands at the path by now: changes would be made there and never seen.
        """
        try:
            replaced = not os.path.samestat(self._path.stat(), self._file)
        except OSError as error:
            raise StoreError(self._lost(error.strerror or str(error))) from error
        if replaced:
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
        self, peer: PeerIdentity, now: datetime, *, number: int | None = None, account: str | None = None,
        replace: bool = False,
    ) -> None:  # fmt: skip
        """Put an identity in force; with `replace` the one that held the name is revoked in the same write.

        number: of the account, for a robot; otherwise the next one.
        """
        with self._db:  # commits, or rolls back
            self._db.execute("BEGIN IMMEDIATE")
            if replace:
                self.revoke(peer.role, peer.name, now)
            self.require_free(peer.role, peer.name)
            row = (
                number or self.next_number(), str(peer.role), peer.name, peer.signing_certificate.fingerprint(),
                peer.pem, keccak(peer.certificates), account, now.isoformat(),
            )  # fmt: skip
            self._db.execute("INSERT INTO enrolment VALUES (?, ?, ?, ?, ?, ?, ?, ?, NULL)", row)

    def revoke(self, role: str, name: str, now: datetime) -> bool:
        """Take a name out of force; whether it was in force."""
        changed = self._db.execute(
            "UPDATE enrolment SET revoked_at = ? WHERE role = ? AND name = ? AND revoked_at IS NULL",
            (now.isoformat(), str(role), name),
        )
        return changed.rowcount > 0

    def all(self, role: str | None = None) -> list[Enrolment]:
        """Every enrolment there ever was, in order."""
        rows = self._db.execute(
            "SELECT * FROM enrolment WHERE ?1 IS NULL OR role = ?1 ORDER BY number", (role and str(role),)
        )
        return [Enrolment(*row) for row in rows]

    def find(self, role: str, name: str) -> Enrolment | None:
        """The enrolment in force under this name."""
        row = self._db.execute(
            "SELECT * FROM enrolment WHERE role = ? AND name = ? AND revoked_at IS NULL", (str(role), name)
        ).fetchone()
        return Enrolment(*row) if row else None

    def allows(self, peer: PeerIdentity) -> bool:
        """Is this very certificate the one in force for the name? StoreError as `revision`: asked of a registry that
        was exchanged, a revocation would never be heard of."""
        self.revision()
        found = self.find(peer.role, peer.name)
        return found is not None and found.fingerprint == peer.signing_certificate.fingerprint()

    def readers(self) -> list[Enrolment]:
        """The readers in force."""
        return [reader for reader in self.all(Role.READER) if reader.revoked_at is None]

    def robots(self) -> Mapping[bytes, Enrolment]:
        """Every robot there ever was: Tk to its newest enrolment, in force or not. Read again only after a change, so
        that a server of thousands may ask every second; StoreError as `revision`."""
        revision = self.revision()
        if self._robots is None or self._robots[0] != revision:
            self._robots = revision, {robot.tk: robot for robot in self.all(Role.ROBOT)}
        return self._robots[1]

    def in_force(self) -> dict[bytes, bytes]:
        """Every robot in force: Tk to keccak256 of its certificates. StoreError as `revision`."""
        return {tk: robot.hash for tk, robot in self.robots().items() if robot.revoked_at is None}


def differences(enrolled: Iterable[Enrolment], standings: Mapping[bytes, Standing]) -> dict[str, str]:
    """By name, of the robots in force: what the contract says otherwise, and what to do.

    enrolled: all that there ever were. standings: by Tk, as a node tells them; a name that is not there is not judged.
    The contract hears of a registration before the registry does, and of a revocation after it. So where they differ
    the node is behind, or the registry is an older copy.
    """
    found, before = dict[str, str](), dict[bytes, set[bytes]]()
    for robot in enrolled:
        if robot.role != Role.ROBOT or (standing := standings.get(robot.tk)) is None:
            continue
        known = before.setdefault(robot.tk, set())
        if robot.revoked_at is not None:
            known.add(robot.hash)
        elif standing.account is None or standing.certificates_hash in known:
            found[robot.name] = "the node does not have its registration yet: wait until the node has caught up"
        elif standing.certificates_hash != robot.hash:
            found[robot.name] = (
                "the contract has certificates that this registry does not know, so the registry is an older copy:"
                f" restore a newer registry.sqlite, or run `register {robot.name} REQUEST --replace`"
            )
        elif standing.revoked:
            found[robot.name] = (
                "it was revoked on the chain, which this registry does not know, so the registry is an older copy:"
                f" run `revoke {robot.name}`, or `register {robot.name} REQUEST --replace` to let it write again"
            )
    return found
