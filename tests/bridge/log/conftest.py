"""A Redis and a Redis Cluster that the tests share; each test has its own ledger."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from bridge.redis_server import RedisClusterServer, RedisServer


@pytest.fixture(scope="session")
def redis_server(tmp_path_factory) -> Iterator[RedisServer]:
    server = RedisServer(tmp_path_factory.mktemp("redis"))
    yield server
    server.kill()


@pytest.fixture(scope="session")
def redis_cluster(tmp_path_factory) -> Iterator[RedisClusterServer]:
    cluster = RedisClusterServer(tmp_path_factory.mktemp("cluster"))
    yield cluster
    cluster.kill()
