"""A server that could not keep what it is given, or write it, does not begin: no port is open before that is known."""

from __future__ import annotations

import socket
from pathlib import Path

import pytest

from bridge.home.world import PASSPHRASE, World
from bridge.redis_server import RedisServer
from rosbridge_eth.errors import BridgeError, ChainError, StoreError
from rosbridge_eth.operator.enrolment import load_server_identity
from rosbridge_eth.server import parent
from rosbridge_eth.server.parent import Parent
from rosbridge_eth.server.shard import Secrets


@pytest.fixture
def world(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> World:
    made = World(tmp_path)
    monkeypatch.setattr(parent.Ledger, "connect", lambda url, deployment: made.ledger)
    return made


def start(world: World, store: str = "") -> None:
    """What `server` does, as far as it comes. Every test here has it end before the port is open."""
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))  # a server that came so far would fail by it, with another error
        text = world.home.config.read_text().replace("127.0.0.1:7410", f"127.0.0.1:{taken.getsockname()[1]}", 1)
        world.home.config.write_text(f"{text}\n{store}")
        running = Parent(world.home, Secrets(load_server_identity(world.home, PASSPHRASE), world.keys))
        try:
            running.run()
        finally:
            assert running._children == {}


def test_with_everything_in_order_it_comes_as_far_as_the_port(world: World) -> None:
    with pytest.raises(BridgeError, match="UDP port"):
        start(world)


@pytest.mark.parametrize("command", ["hget", "info", "zadd"])
def test_a_store_that_lacks_a_right_stops_the_server_before_a_robot_is_answered(
    world: World, tmp_path: Path, command: str
) -> None:
    (tmp_path / "redis").mkdir()
    redis = RedisServer(tmp_path / "redis")
    try:
        with redis.client() as client:
            client.execute_command("ACL", "SETUSER", "default", f"-{command}")
        with pytest.raises(StoreError, match=rf"ACL SETUSER default .*\+{command} "):
            start(world, f'[store]\nurl = "{redis.url}"\n')
    finally:
        redis.kill()


def test_a_store_that_may_forget_stops_it(world: World, tmp_path: Path) -> None:
    (tmp_path / "redis").mkdir()
    redis = RedisServer(tmp_path / "redis", "--appendonly", "no")
    try:
        with pytest.raises(StoreError, match="CONFIG SET appendonly yes"):
            start(world, f'[store]\nurl = "{redis.url}"\n')
    finally:
        redis.kill()


def test_a_chain_that_is_another_one_stops_it(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    def check() -> None:
        raise ChainError("another chain")

    monkeypatch.setattr(world.ledger, "check", check)
    with pytest.raises(ChainError, match="another chain"):
        start(world)
