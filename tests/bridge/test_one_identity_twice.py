"""Two machines with one robot's identity at one worker: the session goes to and fro, and the operator is told."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator, Sequence
from datetime import UTC, datetime, timedelta
from pathlib import Path

import pytest
from eth_hash.auto import keccak

from bridge.machine import PATIENCE, Machine, Running
from rosbridge_eth import identity as ids
from rosbridge_eth.channel import Disconnected, End, Server, ServerConfig, cookie_key
from rosbridge_eth.channel.udp import UdpLoop, server_socket
from rosbridge_eth.log.chunk import robot_id
from rosbridge_eth.log.hop import FORKED
from rosbridge_eth.log.sqlite import SqliteStore
from rosbridge_eth.log.store import State
from rosbridge_eth.server.reception import Reception, Worker

NOW = datetime.now(UTC) - timedelta(hours=1)
CA = ids.create_ca("operator", at=NOW)
HUB = ids.enrol(CA, ids.Role.SERVER, "hub", at=NOW)
ROBOTS = [ids.enrol(CA, ids.Role.ROBOT, name, at=NOW) for name in ("robot_1", "robot_2")]
TRUST = ids.Trust((CA.certificate,))
LEDGER = bytes(32)


@pytest.fixture
def serving(tmp_path: Path) -> Iterator[Running]:
    sock = server_socket(("127.0.0.1", 0))
    server = Server(ServerConfig(), HUB, TRUST, cookie_key(HUB), time.monotonic())
    reception = Reception(
        server, SqliteStore(tmp_path / "store.sqlite", LEDGER, 1 << 24, 1 << 24), LEDGER,
        lambda: {robot_id(robot.name): keccak(robot.public.certificates) for robot in ROBOTS},
    )  # fmt: skip
    running = Running(Worker(reception, lambda handle: UdpLoop(server, sock, handle)))
    yield running
    running.stop()


def machine(who: ids.Identity, serving: Running) -> Machine:
    made = Machine(who, TRUST, "hub", serving.port)
    made.until("connected")
    return made


def warnings(caplog: pytest.LogCaptureFixture) -> list[str]:
    return [entry.getMessage() for entry in caplog.records if entry.levelno >= logging.WARNING]


def test_a_second_machine_with_the_same_identity_is_told_of(serving: Running, caplog: pytest.LogCaptureFixture) -> None:
    first, second = machine(ROBOTS[0], serving), machine(ROBOTS[0], serving)
    end = time.monotonic() + PATIENCE
    while not warnings(caplog) and time.monotonic() < end:
        second.loop.step(0.1)
    [told] = warnings(caplog)
    assert "robot robot_1" in told and "two machines have its identity" in told
    second.close()
    first.loop.close()


def test_the_first_machine_gets_its_session_back_and_that_is_told_too(
    serving: Running, caplog: pytest.LogCaptureFixture
) -> None:
    machines = [machine(ROBOTS[0], serving), machine(ROBOTS[0], serving)]
    end = time.monotonic() + 2 * PATIENCE
    while len(warnings(caplog)) < 2 and time.monotonic() < end:
        for one in machines:
            one.loop.step(0.05)
    assert any(FORKED in warning for warning in warnings(caplog)) and "robot_1" in serving.worker.reception.forked
    for one in machines:
        one.loop.close()


def test_other_robots_and_a_robot_that_comes_again_are_no_reason(
    serving: Running, caplog: pytest.LogCaptureFixture
) -> None:
    other, first = machine(ROBOTS[1], serving), machine(ROBOTS[0], serving)
    first.close()
    machine(ROBOTS[0], serving).close()
    other.close()
    assert warnings(caplog) == []


def test_a_robot_that_comes_costs_a_look_at_itself_and_not_at_all_the_others(
    serving: Running, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Thousands come at once after a restart."""
    asked: list[int] = []
    states = SqliteStore.states

    def counted(store: SqliteStore, tks: Sequence[bytes]) -> list[State]:
        asked.append(len(tks))
        return states(store, tks)

    monkeypatch.setattr("rosbridge_eth.server.reception.LOOK_EVERY", 1e6)
    monkeypatch.setattr(SqliteStore, "states", counted)
    machines = [machine(robot, serving) for robot in ROBOTS]
    assert [count for count in asked if count] == [1, 1]
    for one in machines:
        one.close()


def test_the_worker_ends_the_session_that_was_replaced(serving: Running) -> None:
    first, second = machine(ROBOTS[0], serving), machine(ROBOTS[0], serving)
    end = time.monotonic() + PATIENCE
    while len(serving.worker.reception.sessions) != 1 and time.monotonic() < end:
        second.loop.step(0.1)
    assert len(serving.worker.reception.sessions) == 1
    assert not [e for e in second.events if isinstance(e, Disconnected) and e.reason is End.REPLACED]
    second.close()
    first.loop.close()
