"""The back ends of the inbox that the conformance suite runs on.

A back end makes independent Inbox objects on one set of data, as several processes of a server would. To add one:
a class with this interface, and its name in BACKENDS.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

from bridge.redis_server import RedisServer
from rosbridge_eth.inbox import Inbox, open_inbox
from smcrypto import sm3

PLENTY = 1 << 30


class Backend(Protocol):
    def __init__(self, folder: Path, fixture: Callable[[str], Any]) -> None:
        """folder: its own, empty. fixture: gives a fixture of this name, such as a running service."""

    url: str
    folder: Path
    ledger: bytes

    def open(self, *, max_bytes: int = PLENTY, share: int = PLENTY, read_only: bool = False) -> Inbox:
        """Another Inbox on the same data."""
        return open_inbox(
            self.url, home=self.folder, ledger=self.ledger, max_bytes=max_bytes, max_bytes_per_robot=share,
            read_only=read_only,
        )  # fmt: skip

    def copy(self) -> Any:
        """All of the data, taken while nothing writes."""

    def put_back(self, copy: Any) -> None:
        """Replace all of the data by a copy, or by nothing at all (None), while nobody has it open."""


class SqliteBackend(Backend):
    url = "sqlite"

    def __init__(self, folder: Path, fixture: Callable[[str], Any]) -> None:
        self.folder, self.ledger = folder, b"l" * 32

    def _files(self) -> list[Path]:
        return [path for path in self.folder.glob("inbox.sqlite*") if path.suffix != ".reserve"]

    def copy(self) -> dict[Path, bytes]:
        return {path: path.read_bytes() for path in self._files()}

    def put_back(self, copy: dict[Path, bytes] | None) -> None:
        for path in self._files():
            path.unlink()
        for path, content in (copy or {}).items():
            path.write_bytes(content)


class RedisBackend(Backend):
    def __init__(self, folder: Path, fixture: Callable[[str], Any]) -> None:
        self._server: RedisServer = fixture("redis_server")
        self.folder, self.ledger = folder, sm3.digest(str(folder).encode())
        self.url = self._server.url

    def _keys(self, client: Any) -> list[bytes]:
        return client.keys(f"rosbridge-eth:2:{self.ledger[:8].hex()}:*")

    def copy(self) -> dict[bytes, bytes]:
        with self._server.client() as client:
            return {key: client.dump(key) for key in self._keys(client)}

    def put_back(self, copy: dict[bytes, bytes] | None) -> None:
        with self._server.client() as client:
            for key in self._keys(client):
                client.delete(key)
            for key, content in (copy or {}).items():
                client.restore(key, 0, content)


BACKENDS: dict[str, type[Backend]] = {"sqlite": SqliteBackend, "redis": RedisBackend}
