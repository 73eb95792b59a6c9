"""What a revoked robot handed over is never written by the identity that gets its name next, and is not lost either."""

from __future__ import annotations

from pathlib import Path

import pytest

from bridge.server.world import NOW, TK, World
from rosbridge_eth.errors import StoreError
from rosbridge_eth.home import OperatorHome
from rosbridge_eth.identity import Role
from rosbridge_eth.ledger import fetch
from rosbridge_eth.ledger.journal import Journal, LeaseLost
from rosbridge_eth.ledger.states import State
from rosbridge_eth.records import RecordId, SealedRecord
from rosbridge_eth.server.assembly import open_journal

REASON = "given up by `revoke robot_1`"


@pytest.fixture
def world(tmp_path: Path) -> World:
    return World(OperatorHome(tmp_path / "operator"))


@pytest.fixture
def journal(world: World) -> Journal:
    return open_journal(world.home, world.home.deployment())


def dead(journal: Journal) -> dict[int, str]:
    return {letter.record.id.seq: letter.reason for letter in journal.dead_letters()}


def restarted(world: World) -> None:
    """A server's next life: it goes by what is on the disk."""
    world.submission = world.next_submission()


def written_after(world: World, turns: int = 90) -> dict[int, str]:
    for _ in range(turns):
        world.serve(1)
    return world.written()


def sealed(world: World) -> None:
    """The robot is revoked behind the server's back, with records sealed that the contract refuses from then on."""
    world.contract.transact(world.keys.operator, "revokeRobot", TK)
    world.submission.turn(world.now, flush=True)
    world.registry.revoke(Role.ROBOT, "robot_1", NOW)


def test_what_waits_in_the_inbox_becomes_dead_letters_with_the_reason(world: World, journal: Journal) -> None:
    world.register()
    world.hand_over(0, 300)  # more than are given up at once
    assert world.revoke(world.wait).not_written == 300
    assert world.register(world.wait, replace=True).given_up == 300
    assert dead(journal) == dict.fromkeys(range(300), REASON)
    assert world.inbox.statistics(world.now).waiting == 0
    restarted(world)
    assert written_after(world) == {}


@pytest.mark.parametrize("server_runs", [True, False])
def test_what_is_sealed_in_batches_does_too_under_a_running_server_as_well(
    world: World, journal: Journal, server_runs: bool
) -> None:
    world.register()
    world.hand_over(0, 5)
    sealed(world)
    assert sum(job.count for job in journal.jobs()) == 5
    if server_runs:
        world.serve(1)
        assert world.submission.status().blocked
    new = world.register(world.wait, replace=True)
    assert new.given_up == 5
    if not server_runs:
        restarted(world)
    world.hand_over(10, 3)
    assert written_after(world) == dict.fromkeys(range(10, 13), new.account)
    assert dead(journal) == dict.fromkeys(range(5), REASON)
    assert not world.submission.status().blocked
    assert fetch(world.chain, world.contract, TK).problems == ()


def test_what_a_running_server_has_taken_from_the_inbox_and_not_sealed_is_given_up_too(
    world: World, journal: Journal
) -> None:
    world.register()
    world.hand_over(0, 4)
    world.submission.turn(world.now)  # in an open batch, in memory
    assert world.inbox.statistics(world.now).leased == 4
    world.contract.transact(world.keys.operator, "revokeRobot", TK)
    world.registry.revoke(Role.ROBOT, "robot_1", NOW)
    world.register(world.wait, replace=True)
    assert written_after(world) == {}
    assert dead(journal) == dict.fromkeys(range(4), REASON)


def test_what_was_written_before_the_end_is_no_dead_letter_though_the_server_died_without_knowing(
    world: World, journal: Journal
) -> None:
    old = world.register()
    world.hand_over(0, 3)
    world.chain.auto_mine = False
    world.submission.turn(world.now, flush=True)
    world.serve(1)
    assert [job.state for job in journal.jobs()] == [State.PENDING]
    world.chain.auto_mine = True
    world.chain.mine()
    world.contract.transact(world.keys.operator, "revokeRobot", TK)
    world.registry.revoke(Role.ROBOT, "robot_1", NOW)
    assert world.register(world.wait, replace=True).given_up == 0
    restarted(world)
    assert written_after(world) == dict.fromkeys(range(3), old.account)
    assert dead(journal) == {} and journal.jobs() == []


@pytest.mark.parametrize("server_runs", [True, False])
def test_what_was_sent_and_is_refused_by_the_contract_is_given_up(
    world: World, journal: Journal, server_runs: bool
) -> None:
    world.register()
    world.hand_over(0, 3)
    world.chain.auto_mine = False
    world.submission.turn(world.now, flush=True)
    world.serve(1)
    (job,) = journal.jobs()
    assert job.state is State.PENDING
    world.chain.drop(journal.latest_attempt(job).hash)
    world.chain.auto_mine = True
    world.contract.transact(world.keys.operator, "revokeRobot", TK)
    world.registry.revoke(Role.ROBOT, "robot_1", NOW)
    new = world.register(world.wait, replace=True)
    assert new.given_up == 3
    if not server_runs:
        restarted(world)
    world.hand_over(7, 1)
    assert written_after(world) == {7: new.account}
    assert dead(journal) == dict.fromkeys(range(3), REASON)
    assert not world.submission.status().blocked


def crash(*_: object, **__: object) -> None:
    raise KeyboardInterrupt


@pytest.mark.parametrize("target", [
    "rosbridge_eth.store.SqliteInbox.done",
    "rosbridge_eth.ledger.journal.Journal.give_up",
    "rosbridge_eth.ledger.Contract.transact",
    "rosbridge_eth.server.administration.allot",
    "rosbridge_eth.server.administration._register",
    "rosbridge_eth.server.administration.seal_bundle",
])
def test_a_crash_between_any_two_steps_loses_and_writes_nothing(
    world: World, journal: Journal, target: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    world.register()
    world.hand_over(0, 2)
    world.submission.turn(world.now)
    sealed(world)
    world.hand_over(2, 2)
    with monkeypatch.context() as patched:
        patched.setattr(target, crash)
        with pytest.raises(KeyboardInterrupt):
            world.register(world.wait, replace=True)
    restarted(world)
    assert written_after(world, 30) == {}
    new = world.register(world.wait, replace=True)
    world.hand_over(9, 1)
    assert written_after(world) == {9: new.account}
    assert dead(journal) == dict.fromkeys(range(4), REASON)
    assert fetch(world.chain, world.contract, TK).problems == ()


def test_who_acted_for_the_account_before_can_change_nothing_any_more(world: World, journal: Journal) -> None:
    (job,) = journal.seal([[SealedRecord(RecordId(TK, bytes(16), 0), b"sealed")]], world.now)
    before = journal.lease("0xold", "server", world.now, 30)
    assert before is not None
    assert journal.give_up(TK, ["0xold"], [], REASON, world.now) == 1
    with pytest.raises(LeaseLost):
        journal.reindexed(job, before)
    after = journal.lease("0xold", "server", world.now, 30)
    assert after is not None and after.token > before.token


def test_a_robot_is_told_that_a_record_given_up_will_not_be_written(world: World, journal: Journal) -> None:
    world.register()
    world.hand_over(0, 1)
    world.revoke(world.wait)
    world.register(world.wait, replace=True)
    found = journal.find(RecordId(TK, bytes(16), 0))
    assert found is not None and found.state is State.DEAD


def test_without_its_revocation_nothing_is_given_up(world: World, journal: Journal) -> None:
    world.register()
    world.hand_over(0, 3)
    with pytest.raises(StoreError, match="revoke robot_1"):
        world.register(world.wait, replace=True)
    assert dead(journal) == {}
