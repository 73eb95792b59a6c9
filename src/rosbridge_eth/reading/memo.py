"""Facts that a reader need not prove twice: that a signature holds, and the key that a header wraps
for this reader, or that it wraps none.

Both follow from the chunk's bytes and a key alone, and stay true whatever a node says. Registrations, places, blocks
and times are a node's word: they are not here, and are asked for at every reading.

One SQLite file. A row is the fact's name (SM3 of what it is about) and its value, sealed with SM4-GCM under a key that
comes of the reader's private key; the name is associated data. Who has not that key cannot add a fact, and sees only
which chunks were read. A row that does not open is as if it were not there. Nothing depends on the file.
"""

from __future__ import annotations

import logging
import os
import secrets
import sqlite3
from contextlib import suppress
from pathlib import Path
from typing import Final

from smcrypto import InvalidTag, sm2, sm3, sm4

_AT_ONCE: Final = 1_000  # facts in one transaction
_NONCE: Final = 12

log = logging.getLogger(__name__)


class Memo:
    """The facts in the file at `path`, which `close` writes. A file that cannot be used costs only the keeping."""

    def __init__(self, path: Path, reader: sm2.PrivateKey) -> None:
        self._path = path
        self._gcm = sm4.SM4GCM(sm3.hmac(reader.to_bytes(), b"rosbridge-eth/2 facts")[:16])
        self._new = dict[bytes, bytes]()
        self._db: sqlite3.Connection | None = None
        try:
            path.parent.mkdir(mode=0o700, exist_ok=True)
            os.close(os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600))
            self._db = sqlite3.connect(path)
            self._db.execute("CREATE TABLE IF NOT EXISTS fact (name BLOB PRIMARY KEY, sealed BLOB) WITHOUT ROWID")
        except (sqlite3.Error, OSError) as error:
            self._give_up(error)

    def get(self, name: bytes) -> bytes | None:
        """name: 32 bytes."""
        if self._db is None:
            return None
        try:
            row = self._db.execute("SELECT sealed FROM fact WHERE name = ?", [name]).fetchone()
            return row and self._gcm.decrypt(row[0][:_NONCE], row[0][_NONCE:], name)
        except (InvalidTag, ValueError, TypeError):
            return None
        except sqlite3.Error as error:
            self._give_up(error)
            return None

    def __setitem__(self, name: bytes, value: bytes) -> None:
        nonce = secrets.token_bytes(_NONCE)
        self._new[name] = nonce + self._gcm.encrypt(nonce, value, name)
        if len(self._new) >= _AT_ONCE:
            self._write()

    def close(self) -> None:
        self._write()
        if self._db is not None:
            self._db.close()

    def _write(self) -> None:
        new, self._new = self._new, {}
        if self._db is not None and new:
            try:
                with self._db:
                    self._db.executemany("INSERT OR REPLACE INTO fact VALUES (?, ?)", new.items())
            except sqlite3.Error as error:
                self._give_up(error)

    def _give_up(self, error: Exception) -> None:
        log.warning("%s: what is proven is not kept: %s", self._path, error)
        if self._db is not None:
            self._db.close()
        self._db = None
        if isinstance(error, sqlite3.DatabaseError) and not isinstance(error, sqlite3.OperationalError):
            with suppress(OSError):  # damaged: the next reading begins it again
                self._path.write_bytes(b"")
