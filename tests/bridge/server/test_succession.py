"""A robot is replaced while the server still has records of the old one: they are written first, or it stays."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path

import pytest

from rosbridge_eth.config import load_server_config
from rosbridge_eth.errors import StoreError
from rosbridge_eth.home import OperatorHome
from rosbridge_eth.identity import Role
from rosbridge_eth.ledger import Contract, fetch
from rosbridge_eth.ledger.accounts import Keyring
from rosbridge_eth.ledger.embedded import EmbeddedChain
from rosbridge_eth.records import RecordId, SealedRecord, robot_id
from rosbridge_eth.registry import Registry
from rosbridge_eth.server.administration import (
    Registered,
    Revoked,
    deploy_contract,
    init_home,
    load_ca,
    register_robot,
    revoke,
)
from rosbridge_eth.server.assembly import bound_contract, open_inbox, open_journal, open_submission

PASSPHRASE, NOW = b"operator's", datetime.now(UTC)
TK = robot_id("robot_1")


@dataclass
class World:
    home: OperatorHome
    now: float = field(default_factory=time.time)

    def __post_init__(self) -> None:
        init_home(self.home, PASSPHRASE, listen="127.0.0.1:0", public=None, chain_url="embedded", server="server",
                  now=NOW)
        self.keys = Keyring.load(self.home.accounts, PASSPHRASE)
        self.chain = EmbeddedChain(fund={self.keys.operator.address: 10**21})
        deployment = deploy_contract(self.home, self.chain, self.keys)
        self.contract: Contract = bound_contract(self.chain, deployment)
        config = load_server_config(self.home.config)
        self.inbox = open_inbox(config, self.home)
        self.registry = Registry(self.home.registry)
        self.submission = open_submission(
            config=config, contract=self.contract, journal=open_journal(self.home, deployment),
            inbox=open_inbox(config, self.home), registry=self.registry, keys=self.keys,
        )

    def register(self, pause: Callable[[float], None] = lambda seconds: None, *, replace: bool = False) -> Registered:
        return register_robot(
            self.home, "robot_1", ca=load_ca(self.home, PASSPHRASE), keys=self.keys, chain=self.chain,
            password=b"robot's", now=NOW, replace=replace, clock=lambda: self.now, pause=pause,
        )

    def revoke(self, pause: Callable[[float], None]) -> Revoked:
        return revoke(self.home, Role.ROBOT, "robot_1", keys=self.keys, chain=self.chain, now=NOW,
                      clock=lambda: self.now, pause=pause)

    def hand_over(self, first: int, count: int) -> None:
        seqs = range(first, first + count)
        records = [SealedRecord(RecordId(TK, bytes(16), seq), bytes([seq]) * 300) for seq in seqs]
        self.inbox.append(records, self.now)

    def wait(self, seconds: float) -> None:
        self.now += seconds

    def serve(self, seconds: float) -> None:
        self.now += seconds
        self.submission.turn(self.now)

    def written(self) -> dict[int, str]:
        return {found.record.id.seq: found.sender for found in fetch(self.chain, self.contract, TK).records}


@pytest.fixture
def world(tmp_path: Path) -> World:
    return World(OperatorHome(tmp_path / "operator"))


def test_what_the_old_robot_handed_over_is_written_from_its_own_account_before_it_is_replaced(world: World) -> None:
    old = world.register()
    world.hand_over(0, 5)
    late = iter([5])

    def serve(seconds: float) -> None:
        for seq in late:  # its session is closed within a second, and not before
            world.hand_over(seq, 1)
        world.serve(seconds)

    new = world.register(serve, replace=True)
    assert new.account != old.account
    assert world.written() == dict.fromkeys(range(6), old.account)
    assert all(found.block_number < new.block for found in fetch(world.chain, world.contract, TK).records)


def test_without_a_server_the_robot_is_not_replaced_and_the_way_out_is_told(world: World) -> None:
    old = world.register()
    world.hand_over(0, 3)
    with pytest.raises(StoreError, match="revoke robot_1"):
        world.register(world.wait, replace=True)
    assert world.contract.robot(TK).account.lower() == old.account.lower()
    assert world.registry.find(Role.ROBOT, "robot_1") is None  # it takes nothing more, whatever becomes of this
    world.register(world.serve, replace=True)  # the server runs again
    assert world.written() == dict.fromkeys(range(3), old.account)


def test_a_robot_revoked_on_the_chain_is_replaced_without_waiting(world: World) -> None:
    old = world.register()
    assert world.revoke(world.wait).all_written

    def never(seconds: float) -> None:
        pytest.fail("there is nothing to wait for")

    assert world.register(never, replace=True).account != old.account


def test_what_a_revoked_robot_handed_over_is_written_before_its_right_ends(world: World) -> None:
    account = world.register().account
    world.hand_over(0, 5)
    ended = world.revoke(world.serve)
    assert ended.all_written and ended.block is not None
    assert world.written() == dict.fromkeys(range(5), account)
    assert not world.contract.robot(TK).may_write


def test_without_a_server_a_robot_is_revoked_all_the_same_and_what_is_not_written_is_told(world: World) -> None:
    world.register()
    world.hand_over(0, 5)
    assert not world.revoke(world.wait).all_written
    assert not world.contract.robot(TK).may_write
    assert world.written() == {}
