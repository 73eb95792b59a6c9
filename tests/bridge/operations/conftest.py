"""A home with a deployed contract and a registered robot, made once and copied for each test."""

from __future__ import annotations

import shutil
from dataclasses import dataclass
from datetime import UTC, datetime
from pathlib import Path

import pytest

from rosbridge_eth.bundle import open_bundle
from rosbridge_eth.home import OperatorHome, RobotHome
from rosbridge_eth.ledger.accounts import Keyring
from rosbridge_eth.ledger.embedded import EmbeddedChain
from rosbridge_eth.robot.assembly import join
from rosbridge_eth.server.administration import deploy_contract, init_home, load_ca, register_robot

PASSPHRASE, PASSWORD = b"the operator's own words", b"the robot's own words"
NODE = "http://user:node-key@127.0.0.1:9/v1/path-key?token=query-key"


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


@pytest.fixture(scope="session")
def _made(tmp_path_factory: pytest.TempPathFactory) -> Place:
    folder, now = tmp_path_factory.mktemp("operations"), datetime.now(UTC)
    home, robot = OperatorHome(folder / "operator"), RobotHome(folder / "robot")
    init_home(home, PASSPHRASE, listen="127.0.0.1:0", public="127.0.0.1:9", chain_url=NODE, server="server", now=now)
    keys = Keyring.load(home.accounts, PASSPHRASE)
    chain = EmbeddedChain(fund={keys.operator.address: 10**21})
    deploy_contract(home, chain, keys)
    registered = register_robot(
        home, "robot_1", ca=load_ca(home, PASSPHRASE), keys=keys, chain=chain, password=PASSWORD, now=now
    )
    join(robot, open_bundle(registered.bundle.read_bytes(), PASSWORD), PASSWORD)
    (folder / "pass").write_bytes(PASSPHRASE)
    (folder / "word").write_bytes(PASSWORD)
    return Place(folder, chain)


@pytest.fixture
def place(_made: Place, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Place:
    shutil.copytree(_made.path, tmp_path / "here")
    monkeypatch.chdir(tmp_path / "here")
    return Place(tmp_path / "here", _made.chain)
