"""The back ends of the inbox that the conformance suite runs on.

A back end makes independent Inbox objects on one set of data, as several
processes of a server would. To add one: a class with this interface, and its
name in BACKENDS.
"""

from __future__ import annotations

from collections.abc import Callable
from pathlib import Path
from typing import Any, Protocol

from bridge.store.redis_server import RedisServer
from rosbridge_eth.store import Inbox, InboxLimits, SqliteInbox
from rosbridge_eth.store.inbox import DEFAULT_LIMITS
from rosbridge_eth.store.redis_inbox import RedisInbox


class Backend(Protocol):
    def __init__(self, folder: Path, fixture: Callable[[str], Any]) -> None:
        """folder: its own, empty. fixture: gives a fixture of this name, such as a running service."""

    def open(self, limits: InboxLimits = DEFAULT_LIMITS) -> Inbox:
        """Another Inbox on the same data."""
        ...

    def opener_source(self) -> str:
        """Python source of an expression that opens it in another process."""
        ...

    def clear(self) -> None:
        """Remove all data; nothing has it open."""
        ...


class SqliteBackend:
    def __init__(self, folder: Path, fixture: Callable[[str], Any]) -> None:
        self._path = folder / "inbox.db"

    def open(self, limits: InboxLimits = DEFAULT_LIMITS) -> Inbox:
        return SqliteInbox(self._path, limits)

    def opener_source(self) -> str:
        return f"__import__('rosbridge_eth.store').store.SqliteInbox({str(self._path)!r})"

    def clear(self) -> None:
        for path in self._path.parent.glob(self._path.name + "*"):
            path.unlink()


class RedisBackend:
    def __init__(self, folder: Path, fixture: Callable[[str], Any]) -> None:
        self._server: RedisServer = fixture("redis_server")
        self._binding = str(folder)

    def open(self, limits: InboxLimits = DEFAULT_LIMITS) -> Inbox:
        return RedisInbox(self._server.url, self._binding, limits)

    def opener_source(self) -> str:
        module = "__import__('rosbridge_eth.store.redis_inbox').store.redis_inbox"
        return f"{module}.RedisInbox({self._server.url!r}, {self._binding!r})"

    def clear(self) -> None:
        with self._server.client() as client:
            client.flushall()


BACKENDS: dict[str, type[Backend]] = {"sqlite": SqliteBackend, "redis": RedisBackend}
