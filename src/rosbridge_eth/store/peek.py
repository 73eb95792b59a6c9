"""What a spool holds, asked without owning it: the file is opened for reading, and never moved, mended or made."""

from __future__ import annotations

import sqlite3
from dataclasses import dataclass
from pathlib import Path

from rosbridge_eth.errors import StoreError
from rosbridge_eth.store.database import primary_code


@dataclass(frozen=True, slots=True)
class SpoolPeek:
    """in_use: a robot has the spool; then nothing more is to be seen from outside, and records and bytes are None."""

    in_use: bool
    records: int | None = None
    bytes: int | None = None


def peek_spool(path: Path) -> SpoolPeek:
    """Look into the spool `path`, which must exist. StoreError if it is damaged."""
    db = sqlite3.connect(f"{path.absolute().as_uri()}?mode=ro", uri=True, timeout=0.2, isolation_level=None)
    try:
        records, size = db.execute("SELECT count(*), coalesce(sum(length(ciphertext)), 0) FROM record").fetchone()
    except sqlite3.Error as error:
        if primary_code(error) in (sqlite3.SQLITE_BUSY, sqlite3.SQLITE_LOCKED):
            return SpoolPeek(in_use=True)
        raise StoreError(
            f"the spool {path} cannot be read ({error}); the robot's next start keeps it aside and begins another"
        ) from None
    finally:
        db.close()
    return SpoolPeek(False, records, size)
