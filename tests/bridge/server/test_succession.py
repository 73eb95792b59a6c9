"""A robot is replaced while the server still has records of the old one: they are written first, or it stays."""

from __future__ import annotations

import sqlite3
from pathlib import Path

import pytest

from bridge.server.world import NOW, TK, World
from rosbridge_eth.errors import IdentityError, StoreError
from rosbridge_eth.home import OperatorHome
from rosbridge_eth.identity import Role
from rosbridge_eth.ledger import fetch
from rosbridge_eth.records import robot_id


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
    assert world.revoke(world.wait).not_written == 0

    def never(seconds: float) -> None:
        pytest.fail("there is nothing to wait for")

    assert world.register(never, replace=True).account != old.account


def test_what_a_revoked_robot_handed_over_is_written_before_its_right_ends(world: World) -> None:
    account = world.register().account
    world.hand_over(0, 5)
    ended = world.revoke(world.serve)
    assert ended.not_written == 0 and ended.block is not None
    assert world.written() == dict.fromkeys(range(5), account)
    assert not world.contract.robot(TK).may_write


def test_without_a_server_a_robot_is_revoked_all_the_same_and_what_is_not_written_is_told(world: World) -> None:
    world.register()
    world.hand_over(0, 5)
    assert world.revoke(world.wait).not_written == 5
    assert not world.contract.robot(TK).may_write
    assert world.written() == {}


def test_an_old_backup_of_the_registry_does_not_stop_registrations(world: World) -> None:
    backup = world.home.registry.with_name("backup")
    with sqlite3.connect(backup) as copy:
        world.registry._db.backup(copy)
    accounts = {world.register_as(f"robot_{n}").account for n in (1, 2, 3)}
    with sqlite3.connect(backup) as copy:
        copy.backup(world.registry._db)
    new = world.register_as("robot_4")
    assert new.account not in accounts
    found = world.registry.find(Role.ROBOT, "robot_4")
    assert found is not None and found.account == new.account == world.keys.robot(found.number).address
    with pytest.raises(IdentityError, match="robot_2"):
        world.register_as("robot_2")


def test_a_revoked_name_is_said_to_be_one(world: World) -> None:
    world.register()
    world.revoke(world.wait)
    with pytest.raises(IdentityError, match=r"was revoked; give --replace") as told:
        world.register()
    assert "registry does not" not in str(told.value)
    world.register(replace=True)


def test_a_name_that_only_the_contract_has_in_force_is_taken_over_only_on_demand(world: World) -> None:
    world.register()
    world.registry.revoke(Role.ROBOT, "robot_1", NOW)
    with pytest.raises(IdentityError, match="the contract knows a robot 'robot_1' that the registry does not"):
        world.register()


def test_no_robot_is_called_as_the_treasury_is(world: World) -> None:
    with pytest.raises(IdentityError, match="treasury"):
        world.register_as("operator")
    assert not world.contract.robot(robot_id("operator")).registered
