"""A home with a deployed contract, a registered robot and a reader, made once and copied for each test."""

from __future__ import annotations

import shutil
import threading
from collections.abc import Iterator
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import pytest

from rosbridge_eth.channel.udp import UdpLoop, server_socket
from rosbridge_eth.config import Address, load_server_config
from rosbridge_eth.config.home import OperatorHome, ReaderHome, RobotHome
from rosbridge_eth.identity import load_ca
from rosbridge_eth.ledger import Keyring, Ledger
from rosbridge_eth.ledger.nodes import EmbeddedChain
from rosbridge_eth.log.store import Store
from rosbridge_eth.operator import enrolment as admin
from rosbridge_eth.operator.bundle import Request, ask_to_join, join, read_bundle
from rosbridge_eth.operator.registry import Registry
from rosbridge_eth.server import metrics
from rosbridge_eth.server.reception import Worker
from rosbridge_eth.server.shard import open_reception, open_store

PASSPHRASE, PASSWORD, READERS = b"the operator's own words", b"the robot's own words", b"the reader's own words"
NODE = "http://user:node-key@127.0.0.1:9/v1/path-key?token=query-key"
NODE_SECRETS = ("node-key", "path-key", "query-key")


@dataclass(frozen=True)
class Place:
    """The folder, and the chain that the home was deployed on (no server of this home can reach it: NODE is dead)."""

    path: Path
    chain: EmbeddedChain

    @property
    def operator(self) -> OperatorHome:
        return OperatorHome(self.path / "operator")

    @property
    def robot(self) -> RobotHome:
        return RobotHome(self.path / "robot")

    @property
    def ledger(self) -> Ledger:
        return Ledger.connect(self.chain, self.operator.deployment())

    def inbox(self) -> Store:
        return open_store(load_server_config(self.operator.config), self.operator)

    def configure(self, old: str, new: str) -> None:
        """Change server.toml."""
        text = self.operator.config.read_text()
        assert old in text
        self.operator.config.write_text(text.replace(old, new))


@pytest.fixture(autouse=True)
def _nothing_counted() -> None:
    """The figures of a process, which are those of one test here."""
    metrics.FIGURES.clear()


@pytest.fixture(scope="session")
def _made(tmp_path_factory: pytest.TempPathFactory) -> Place:
    folder, now = tmp_path_factory.mktemp("operations"), datetime.now(UTC)
    home, robot = OperatorHome(folder / "operator"), RobotHome(folder / "robot")
    keys = admin.init_home(
        home, PASSPHRASE, reader=ReaderHome(folder / "reader"), reader_passphrase=READERS, now=now,
        listen="127.0.0.1:0", public="127.0.0.1:9", chain_url=NODE,
    )
    chain = EmbeddedChain({keys.operator.address: 10**21})
    place = Place(folder, chain)
    admin.deploy_contract(home, chain, keys)
    ask_to_join(robot, "robot_1", PASSWORD)
    made = admin.register_robot(
        home, "robot_1", ca=load_ca(home.ca, PASSPHRASE, now), keys=keys, ledger=place.ledger, inbox=place.inbox,
        now=now, request=Request.decode(robot.request.read_bytes()),
    )
    join(robot, read_bundle(made.bundle.read_bytes()))
    for name, words in (("pass", PASSPHRASE), ("word", PASSWORD), ("readers", READERS)):
        (folder / name).write_bytes(words)
        (folder / name).chmod(0o600)
    return place


@pytest.fixture
def place(_made: Place, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Place]:
    shutil.copytree(_made.path, tmp_path / "here")
    monkeypatch.chdir(tmp_path / "here")
    monkeypatch.setenv("COLUMNS", "120")
    snapshot = _made.chain.ethereum_tester.take_snapshot()
    yield Place(tmp_path / "here", _made.chain)
    _made.chain.ethereum_tester.revert_to_snapshot(snapshot)


@pytest.fixture
def keys(place: Place) -> Keyring:
    return Keyring.load(place.operator.accounts, PASSPHRASE)


@pytest.fixture
def server(place: Place) -> Iterator[Address]:
    """A real worker at a real port, its loop in a thread; the robot's home knows the address."""
    config, registry = load_server_config(place.operator.config), Registry(place.operator.registry)
    sock = server_socket(config.listen)
    reception = open_reception(
        config, admin.load_server_identity(place.operator, PASSPHRASE), place.operator, registry, place.inbox()
    )
    worker, stop = Worker(reception, lambda handle: UdpLoop(reception.server, sock, handle)), threading.Event()
    thread = threading.Thread(target=worker.run, args=(stop.is_set,))
    thread.start()
    address = Address(*sock.getsockname()[:2])
    place.robot.config.write_text(f'topics = ["/robot_1/odom"]\nserver = "{address}"\n[source]\nkind = "sim"\n')
    yield address
    stop.set()
    worker.loop.wake()
    thread.join(10)
    registry.close()
