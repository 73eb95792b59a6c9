"""A Redis that is killed, flushed or exchanged under the running server: nothing lost, nothing doubled, and it is said.

A server as an operator starts it (`python -m rosbridge_eth server`), a node, a Redis, and robots with
sockets of their own (benchmarks/load.py); at the end every log is read back from the chain.
"""

from __future__ import annotations

import shutil
import socket
import threading
import time
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

import faults
import load
from bridge.redis_server import RedisServer
from ports import free_port

ROBOTS, MESSAGES = 6, 40
LIMIT = 90.0  # s for a phase


@pytest.fixture
def redis_server(tmp_path: Path) -> Iterator[RedisServer]:
    (tmp_path / "redis").mkdir()
    server = RedisServer(tmp_path / "redis")
    yield server
    server.kill()


class Site:
    """Operator, node and server; robots that have sealed all that they will say."""

    def __init__(self, folder: Path, redis: RedisServer) -> None:
        port = free_port(socket.SOCK_DGRAM)
        self.operator = load.Operator(
            folder, "anvil", redis.url, ROBOTS, lambda stage: None, listen=f"127.0.0.1:{port}"
        )
        secret = folder / "passphrase"
        secret.write_bytes(self.operator.passphrase + b"\n")
        secret.chmod(0o600)
        self.program = faults.Program(
            folder / "server.log",
            ["server", "--home", str(self.operator.home.path), "--passphrase-file", str(secret), "--verbose"], {},
        )  # fmt: skip
        faults.until("the server listens", lambda: "Listening on" in self.program.said or self.program.ended())
        address = ("127.0.0.1", port)
        self.sessions = [load.Session(self.operator, robot, address) for robot in self.operator.robots]
        self.sealed = [session.seal(MESSAGES, 1) for session in self.sessions]
        for session in self.sessions:
            session.connect()
        self.drive(lambda session: session.connected)
        for session in self.sessions:
            session.begin()

    def drive(self, done: Callable[[object], bool], limit: float = LIMIT) -> None:
        load.drive(self.sessions, done, limit)

    def drive_some(self, chunks: int) -> None:
        """Until so many chunks more went out, of all robots together."""
        end = self.sent + chunks
        self.drive(lambda session: self.sent >= end or session.stored)

    @property
    def sent(self) -> int:
        return sum(session.sender.sent for session in self.sessions)

    def said(self, text: str) -> int:
        return self.program.said.count(text)

    def finish(self) -> None:
        """Every robot is told that all of its chunks are on the chain; a reader finds them there, once, in order."""
        self.drive(lambda session: session.confirmed)
        left = [session.spool.statistics().chunks for session in self.sessions]
        assert left == [0] * ROBOTS, self.program.said[-3000:]
        assert sum(session.sender.refused for session in self.sessions) == 0
        ledger = self.operator.connect()
        for session, sealed in zip(self.sessions, self.sealed, strict=True):
            found = load.read_back(self.operator, ledger, session.robot)
            assert [chunk for batch in found.batches for chunk in batch] == list(sealed.values())
            assert found.findings == []
        ledger.close()

    def close(self) -> None:
        assert self.program.terminate() == 0
        for session in self.sessions:
            session.close()
        self.operator.close()


@pytest.fixture
def site(redis_server: RedisServer, tmp_path: Path, require: Callable[[str], str]) -> Iterator[Site]:
    require("npx")
    made = Site(tmp_path, redis_server)
    yield made
    made.close()


@pytest.mark.service
@pytest.mark.slow
def test_a_redis_that_is_away_makes_robots_hold_and_its_return_is_told(site: Site, redis_server: RedisServer) -> None:
    site.drive_some(20)
    redis_server.kill()
    site.drive(lambda session: bool(session.sender.held), 8.0)
    held = [session.sender.held for session in site.sessions]
    assert any("store" in why for why in held)
    redis_server.start()
    site.finish()
    faults.until("its return is told", lambda: site.said("the store: works again") >= 1)
    assert site.said(" the store: ") > site.said("the store: works again") >= 1


@pytest.mark.service
@pytest.mark.slow
@pytest.mark.parametrize("idle", [False, True], ids=["while robots send", "when all is stored"])
def test_a_flushed_redis_is_filled_again(site: Site, redis_server: RedisServer, idle: bool) -> None:
    if idle:
        site.drive(lambda session: session.stored)
    else:
        site.drive_some(40)
    with redis_server.client() as client:
        client.flushall()
    site.finish()


@pytest.mark.service
@pytest.mark.slow
def test_an_exchanged_redis_is_filled_again(site: Site, redis_server: RedisServer, tmp_path: Path) -> None:
    site.drive_some(40)
    redis_server.kill()
    shutil.move(tmp_path / "redis" / "appendonlydir", tmp_path / "old")  # another, empty one under the same address
    site.drive(lambda session: False, 1.0)
    redis_server.start()
    site.finish()


@pytest.mark.service
@pytest.mark.slow
def test_redis_is_killed_again_and_again_while_robots_send(site: Site, redis_server: RedisServer) -> None:
    over, kills = threading.Event(), list[float]()

    def harm() -> None:
        while not over.is_set() and len(kills) < 8:
            redis_server.kill()
            kills.append(time.monotonic())
            over.wait(0.1)
            redis_server.start()
            over.wait(0.4)

    harming = threading.Thread(target=harm)
    harming.start()
    try:
        site.drive(lambda session: session.stored)
        assert len(kills) >= 2
    finally:
        over.set()
        harming.join()
    site.finish()
    assert not site.said("a defect ended this process")
