"""A store that is lost, or put back from an old copy, while the server runs: every chunk that a robot was told to be
stored reaches the chain, once and in the order of its log, and the robot's disk empties.

The real robot's end, reception, store and submitter. The contract is the real one on the embedded chain, for each back
end of the store; where dice decide what happens and when, a model of it, which can also turn back.
"""

from __future__ import annotations

import os
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest
from eth_hash.auto import keccak

from bridge.channel.simulation import Faults
from bridge.ledger.model_chain import ModelChain
from bridge.log.backends import BACKENDS, Backend
from bridge.redis_server import RedisServer
from bridge.test_delivery import PLACE, World, identity
from rosbridge_eth.identity import Role
from rosbridge_eth.ledger import Keyring, Ledger
from rosbridge_eth.ledger.nodes import EmbeddedChain
from rosbridge_eth.log.chunk import Chunk
from rosbridge_eth.log.store import Store
from rosbridge_eth.server.submitter import Settings, Submitter

KEYS = Keyring.from_mnemonic("test " * 11 + "junk")
ACCOUNT = KEYS.account(1)
CERTIFICATES = identity(Role.ROBOT).public.certificates
SEEDS = range(int(os.environ.get("RESTORE_SEEDS", "4")))
CONFIRMATIONS = 3


class Site(World):
    """A world with a chain, to which a submitter brings what the server has."""

    def __init__(self, backend: Backend, seed: int, faults: Faults, ledger: Any, **settings: int) -> None:
        self.backend, self.ledger, self.settings = backend, ledger, Settings(**settings)
        self.sealed: list[bytes] = []  # digests, in the order of the log
        super().__init__(backend.folder, seed, faults)
        self.restart_submitter()

    def open_store(self) -> Store:
        return self.backend.open()

    def restart_submitter(self) -> None:
        self.submitter = Submitter(
            self.ledger, self.backend.open(), lambda: [PLACE.tk], lambda tk: ACCOUNT, None, self.settings
        )

    def says(self, chunks: int = 1) -> None:
        """The robot seals so many chunks."""
        for _ in range(chunks):
            self.robot.capture(3)
            self.sealed += [self.robot.spool.last_digest] if self.robot.spool.last_digest not in self.sealed else []

    def write(self, seconds: float = 3.0) -> None:
        """The submitter takes its turns for a while, and nothing else happens."""
        for _ in range(int(2 * seconds)):
            self.network.now += 0.5
            self.submitter.turn(self.network.now)
            if isinstance(self.ledger, ModelChain):
                self.ledger.mine()

    def on_chain(self) -> list[bytes]:
        [standing] = self.ledger.standings([PLACE.tk])
        events = list(self.ledger.newest_data(PLACE.tk, standing.data_block))[::-1]
        return [Chunk.parse(chunk).header.digest for event in events for chunk in event.chunks]

    def finish(self) -> None:
        """Robot, server and submitter go on until nothing is left to do."""
        for _ in range(120):
            self.pass_time(1.0)
            self.write(0.5)
            if self.robot.chunks() == [] and self.on_chain() == self.sealed:
                return
        raise AssertionError((self.sender.held, self.submitter.trouble, self.store.states([PLACE.tk])))


@pytest.fixture(scope="module")
def redis_server(tmp_path_factory: pytest.TempPathFactory) -> Iterator[RedisServer]:
    server = RedisServer(tmp_path_factory.mktemp("redis"))
    yield server
    server.kill()


@pytest.fixture(params=["sqlite", pytest.param("redis", marks=pytest.mark.service)])
def backend(request: pytest.FixtureRequest, tmp_path: Path) -> Backend:
    return BACKENDS[request.param](tmp_path, request.getfixturevalue)


@pytest.fixture
def site(backend: Backend) -> Iterator[Site]:
    ledger, _ = Ledger.deploy(EmbeddedChain({KEYS.operator.address: 10**20, ACCOUNT.address: 10**18}), KEYS.operator)
    ledger.registration(KEYS.operator, PLACE.tk, ACCOUNT.address, CERTIFICATES)
    yield Site(backend, 1, Faults(), ledger)
    ledger.close()


@pytest.mark.parametrize("written", [False, True], ids=["before it is on the chain", "after"])
def test_what_was_acknowledged_and_is_not_in_the_copy_reaches_the_chain(site: Site, written: bool) -> None:
    site.says(4)
    assert site.run(30)
    site.write()
    copy = site.backend.copy()
    site.says(3)
    assert site.run(30)
    assert len(site.stored()) == 7
    if written:
        site.write()
        assert len(site.on_chain()) == 7
    site.backend.put_back(copy)
    site.says(2)
    site.finish()
    assert site.on_chain() == site.sealed and len(site.sealed) == 9
    assert site.sender.sessions == 1 and site.sender.refused == 0


@pytest.mark.parametrize("written", [False, True], ids=["before it is on the chain", "after"])
def test_a_copy_of_a_store_that_was_still_empty_is_filled_again(site: Site, written: bool) -> None:
    copy = site.backend.copy()
    site.says(4)
    assert site.run(30)
    if written:
        site.write()
        assert site.run(30, until=lambda: site.robot.chunks() == [])
    site.backend.put_back(copy)
    site.says(2)
    site.finish()
    assert site.on_chain() == site.sealed and len(site.sealed) == 6


@pytest.mark.parametrize("seed", SEEDS)
def test_whatever_is_lost_put_back_killed_or_turned_back_the_chain_has_the_log_once_and_in_order(
    tmp_path: Path, seed: int
) -> None:
    ledger = ModelChain()
    ledger.register(PLACE.tk, ACCOUNT.address, 10**20)
    known = ledger.state.standings[PLACE.tk]
    ledger.state.standings[PLACE.tk] = known._replace(certificates_hash=keccak(CERTIFICATES))
    ledger.mine()
    backend = BACKENDS["sqlite"](tmp_path, lambda name: None)
    site = Site(backend, seed, Faults(loss=(0.0, 0.1, 0.3)[seed % 3], jitter=0.03), ledger,
                confirmations=CONFIRMATIONS)  # fmt: skip
    dice, copy = site.random, backend.copy()
    for _ in range(60):
        site.says(dice.randrange(3))
        site.pass_time(dice.uniform(0, 1))
        site.write(dice.choice([0, 0.5, 1]))
        match dice.randrange(14):
            case 0:
                copy = backend.copy()
            case 1:
                backend.put_back(copy)
            case 2:
                site.restart_server()
            case 3:
                site.restart_server(store=lambda: backend.put_back(None))
                site.restart_submitter()
            case 4:
                site.restart_submitter()
            case 5:
                site.robot.restart()
            case 6:
                ledger.reorg(dice.randrange(1, CONFIRMATIONS))
            case 7:
                site.pass_time(12)
    site.finish()
    assert site.on_chain() == site.sealed
