"""The back ends of the store that its tests run on.

A back end makes independent Store objects on one set of data, as several processes would. To add one: a class with this
interface, and its name in BACKENDS.
"""

from __future__ import annotations

import sqlite3
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from typing import Any, Protocol

from bridge.redis_server import RedisClusterServer, RedisServer
from rosbridge_eth.log.opening import open_store
from rosbridge_eth.log.store import Store
from smcrypto import sm3

PLENTY = 1 << 30


class Backend(Protocol):
    def __init__(self, folder: Path, fixture: Callable[[str], Any]) -> None:
        """folder: its own, empty. fixture: gives a fixture of this name, such as a running service."""

    url: str
    folder: Path
    ledger: bytes = b"l" * 32
    bounded: bool
    """Whether it keeps max_bytes, the bound on all robots together."""

    def open(self, *, max_bytes: int = PLENTY, share: int = PLENTY, read_only: bool = False) -> Store:
        """Another Store on the same data."""
        return open_store(
            self.url, file=self.folder / "store.sqlite", ledger=self.ledger, max_bytes=max_bytes,
            max_bytes_per_robot=share, read_only=read_only,
        )  # fmt: skip

    def copy(self) -> Any:
        """All of the data; a store may be in use."""

    def put_back(self, copy: Any) -> None:
        """Replace all of the data by a copy, or by nothing at all (None); a store may be in use."""


class SqliteBackend(Backend):
    url = "sqlite"
    bounded = True

    def __init__(self, folder: Path, fixture: Callable[[str], Any]) -> None:
        self.folder = folder

    def copy(self) -> sqlite3.Connection:
        copy = sqlite3.connect(":memory:")
        with closing(sqlite3.connect(self.folder / "store.sqlite")) as file:
            file.backup(copy)
        return copy

    def put_back(self, copy: sqlite3.Connection | None) -> None:
        """By SQLite's own backup, as `.restore` of its shell does it; emptied, by removing the files."""
        if copy is None:
            for path in self.folder.glob("store.sqlite*"):
                path.unlink()
            return
        with closing(sqlite3.connect(self.folder / "store.sqlite")) as file:
            copy.backup(file)


class RedisBackend(Backend):
    bounded = False
    server = "redis_server"

    def __init__(self, folder: Path, fixture: Callable[[str], Any]) -> None:
        self._server: RedisServer | RedisClusterServer = fixture(self.server)
        self.folder, self.ledger = folder, sm3.digest(str(folder).encode())
        self.url = self._server.url

    def copy(self) -> dict[bytes, bytes]:
        with self._server.client() as client:
            return {key: client.dump(key) for key in self._keys(client)}

    def put_back(self, copy: dict[bytes, bytes] | None) -> None:
        """By DUMP and RESTORE of every key."""
        with self._server.client() as client:
            for key in self._keys(client):
                client.delete(key)
            for key, content in (copy or {}).items():
                client.restore(key, 0, content)

    def _keys(self, client: Any) -> list[bytes]:
        return list(client.scan_iter(f"rosbridge-eth:3:{self.ledger.hex()}:*", count=10_000))


class ClusterBackend(RedisBackend):
    server = "redis_cluster"


BACKENDS: dict[str, type[Backend]] = {"sqlite": SqliteBackend, "redis": RedisBackend, "cluster": ClusterBackend}
