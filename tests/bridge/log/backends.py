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

from rosbridge_eth.log.opening import open_store
from rosbridge_eth.log.store import Store

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
            self.url, home=self.folder, ledger=self.ledger, max_bytes=max_bytes, max_bytes_per_robot=share,
            read_only=read_only,
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


BACKENDS: dict[str, type[Backend]] = {"sqlite": SqliteBackend}
