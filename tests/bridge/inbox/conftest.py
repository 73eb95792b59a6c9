"""A Redis that the tests share."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from bridge.redis_server import RedisServer


@pytest.fixture(scope="session")
def redis_server(tmp_path_factory) -> Iterator[RedisServer]:
    """A durable Redis; each test has its own ledger."""
    server = RedisServer(tmp_path_factory.mktemp("redis"))
    yield server
    server.kill()
