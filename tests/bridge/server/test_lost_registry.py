"""A registry taken away under a running server: the process ends and says so, and does not go by what is gone."""

from __future__ import annotations

from pathlib import Path

import pytest

from bridge.server.world import PASSPHRASE, World
from rosbridge_eth.channel.udp import server_sockets
from rosbridge_eth.config import load_server_config
from rosbridge_eth.errors import StoreError
from rosbridge_eth.home import OperatorHome
from rosbridge_eth.server.administration import load_server_identity, server_trust
from rosbridge_eth.server.assembly import open_journal, open_worker


def test_a_worker_whose_registry_is_taken_away_ends_and_says_so(tmp_path: Path) -> None:
    world = World(OperatorHome(tmp_path / "operator"))
    [sock] = server_sockets(("127.0.0.1", 0))
    config, identity = load_server_config(world.home.config), load_server_identity(world.home, PASSPHRASE)
    worker = open_worker(
        0, sock, config=config, identity=identity, trust=server_trust(world.home, world.registry),
        registry=world.registry, inbox=world.inbox, journal=open_journal(world.home, world.home.deployment()),
        deployment=world.home.deployment(),
    )
    turns = iter(range(20))

    def take_away() -> None:
        if next(turns) == 3:
            world.home.registry.rename(world.home.path / "elsewhere")

    with pytest.raises(StoreError, match=r"restore registry\.sqlite"):
        worker.run(lambda: False, on_turn=take_away)
    sock.close()


def test_a_submitter_whose_registry_is_taken_away_writes_for_nobody(tmp_path: Path) -> None:
    world = World(OperatorHome(tmp_path / "operator"))
    world.register()
    world.hand_over(0, 1)
    world.home.registry.rename(world.home.path / "elsewhere")
    with pytest.raises(StoreError, match=r"restore registry\.sqlite"):
        for _ in range(9):
            world.serve(1)
    assert world.written() == {}
