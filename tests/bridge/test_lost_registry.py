"""A registry taken away or exchanged under a running server: its processes end and say so, and do not go by what is
gone."""

from __future__ import annotations

import shutil
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from bridge.home.world import PASSPHRASE, World
from bridge.machine import PATIENCE, Machine, Running
from rosbridge_eth.channel.udp import UdpLoop, server_socket
from rosbridge_eth.config import Address, load_server_config
from rosbridge_eth.config.home import RobotHome
from rosbridge_eth.errors import StoreError
from rosbridge_eth.identity import Trust, load_identity
from rosbridge_eth.operator.bundle import join, read_bundle
from rosbridge_eth.operator.enrolment import load_server_identity
from rosbridge_eth.operator.registry import Registry
from rosbridge_eth.server import shard
from rosbridge_eth.server.reception import Worker
from rosbridge_eth.server.shard import Secrets, open_reception, open_submitter


def take_away(world: World) -> None:
    world.home.registry.rename(world.home.path / "elsewhere")


def exchange(world: World) -> None:
    """As an operator does who puts a backup in its place."""
    backup = world.home.path / "backup"
    shutil.copy(world.home.registry, backup)
    backup.rename(world.home.registry)


HARMS = pytest.mark.parametrize(
    "harm, said", [(take_away, r"restore registry\.sqlite"), (exchange, "was replaced by another file")]
)
Harm = Callable[[World], None]


@pytest.fixture
def world(tmp_path: Path) -> World:
    return World(tmp_path)


@HARMS
@pytest.mark.parametrize("connected", [True, False], ids=["with a session", "at the next handshake"])
def test_a_worker_whose_registry_is_gone_ends_and_says_so(
    world: World, harm: Harm, said: str, connected: bool
) -> None:
    place = RobotHome(world.path / "robot-1")
    join(place, read_bundle(world.register().bundle.read_bytes()))
    robot, roots = load_identity(place.identity, b"robot's")
    sock = server_socket(("127.0.0.1", 0))
    reception = open_reception(
        load_server_config(world.home.config), load_server_identity(world.home, PASSPHRASE), world.home,
        Registry(world.home.registry), world.open_store(),
    )  # fmt: skip
    serving = Running(Worker(reception, lambda handle: UdpLoop(reception.server, sock, handle)))
    try:
        if connected:
            machine = Machine(robot, Trust(roots), "server", serving.port)
            machine.until("connected")
        harm(world)
        if not connected:
            machine = Machine(robot, Trust(roots), "server", serving.port)
        end = time.monotonic() + PATIENCE
        while serving.thread.is_alive() and time.monotonic() < end:
            machine.loop.step(0.1)
        assert isinstance(serving.error, StoreError)
        with pytest.raises(StoreError, match=said):
            raise serving.error
    finally:
        serving.stop()
        machine.loop.close()


@HARMS
def test_a_submitter_writes_for_nobody(world: World, harm: Harm, said: str) -> None:
    world.register()
    world.hand_over(1)
    submitter = open_submitter(
        load_server_config(world.home.config), world.ledger, world.open_store(), Registry(world.home.registry),
        world.keys,
    )  # fmt: skip
    harm(world)
    for second in range(3):
        with pytest.raises(StoreError, match=said):
            submitter.turn(world.now + second)
    assert world.written() == []


def test_a_shard_ends_so_that_the_next_one_opens_what_is_there(world: World, monkeypatch: pytest.MonkeyPatch) -> None:
    secrets = Secrets(load_server_identity(world.home, PASSPHRASE), world.keys)
    monkeypatch.setattr(shard.Ledger, "connect", lambda url, deployment: world.ledger)
    config = load_server_config(world.home.config).model_copy(update={"listen": Address("127.0.0.1", 0)})
    begun, ends = time.monotonic(), time.monotonic() + PATIENCE

    def stopped() -> bool:
        if world.home.registry.exists() and time.monotonic() > begun + 1.0:
            take_away(world)
        return time.monotonic() > ends

    with pytest.raises(StoreError, match="registry"):
        shard.run_shard(0, config, world.home, secrets, stopped)
