"""The submitter on a model chain: every chunk once and in order, whatever happens, and nothing wasted."""

from __future__ import annotations

import random
from collections.abc import Iterator
from pathlib import Path

import pytest
from eth_hash.auto import keccak

from bridge.ledger.model_chain import ETH, GWEI
from bridge.ledger.world import KEYS, Pen, World
from rosbridge_eth.ledger.contract import DataEvent, Fees
from rosbridge_eth.ledger.transport import ChainUnavailable, Underpriced
from rosbridge_eth.log.store import NO_HASH, NOWHERE, Outcome, place_of
from rosbridge_eth.server.submitter import BATCH_BYTES, IN_FLIGHT, PATIENCE, Submitter

ROBOT, OPERATOR = KEYS.account(1).address, KEYS.operator.address


def waiting(world: World) -> list[int]:
    return sorted(world.model.pool.get(ROBOT, {}))


def batches(world: World) -> list[int]:
    """How many chunks each transaction in the pool has."""
    return [len(tx.call[4]) for _, tx in sorted(world.model.pool.get(ROBOT, {}).items())]


def test_chunks_get_there_and_are_confirmed(world: World):
    world.take(world.pen.chunks(5))
    world.turn(mine=1)
    assert world.on_chain() == world.pen.digests
    assert world.confirmed() == NOWHERE
    world.turn()
    assert world.confirmed() == world.pen.last
    assert world.state().certificates == world.model.state.standings[world.pen.tk][1]
    assert world.model.reverted == 0


@pytest.mark.parametrize("confirmations", [1, 3])
def test_a_chunk_is_confirmed_n_blocks_deep(tmp_path: Path, confirmations: int):
    world = World(tmp_path, confirmations=confirmations)
    world.model.mine(5)
    world.take(world.pen.chunks(1))
    world.turn(mine=1)
    for _ in range(confirmations - 1):
        world.turn(mine=1)
        assert world.confirmed() == NOWHERE
    world.turn()
    assert world.confirmed() == world.pen.last


def test_a_node_without_old_states_confirms_nothing_and_says_so(tmp_path: Path):
    world = World(tmp_path, confirmations=10)
    world.model.mine(20)
    world.model.history = 5
    world.take(world.pen.chunks(1))
    for _ in range(15):
        world.turn(mine=1)
    assert world.on_chain() == world.pen.digests
    assert world.confirmed() == NOWHERE
    assert "missing trie node" in str(world.submitter.unconfirmed)


def test_batches_are_full_and_one_is_not(world: World):
    world.take(world.pen.chunks(200, 8_000))
    world.turn()
    assert world.in_flight == IN_FLIGHT
    sizes = [sum(map(len, tx.call[4])) for tx in world.model.pool[ROBOT].values()]
    assert all(BATCH_BYTES - 9_000 < size <= BATCH_BYTES for size in sizes)
    world.run()
    assert world.model.reverted == 0
    world.take(world.pen.chunks(1))
    world.turn()
    assert batches(world) == [1]
    world.take(world.pen.chunks(3))
    world.turn()
    assert batches(world) == [1], "it waits until the other one, which is not full, is in a block"
    world.take(world.pen.chunks(30, 8_000))
    world.turn()
    assert len(batches(world)) == 3, "full ones need not wait"
    world.run()


def test_a_small_block_takes_small_batches(tmp_path: Path):
    world = World(tmp_path)
    world.model.states[-1].block = world.model.state.block._replace(gas_limit=2_000_000)
    world.take(world.pen.chunks(10, 8_000))
    world.turn()
    assert all(tx.gas <= 1_000_000 for tx in world.model.pool[ROBOT].values())
    assert sum(tx.gas for tx in world.model.pool[ROBOT].values()) <= 4_000_000
    world.run()


def test_all_robots_together_fill_two_blocks_oldest_rows_first(tmp_path: Path):
    world = World(tmp_path, robots=3)
    for pen in reversed(world.pens):
        world.now += 1
        world.take(pen.chunks(100, 8_000), pen)
    world.turn()
    limit = world.model.state.block.gas_limit
    pool = {pen: sum(tx.gas for tx in world.model.pool.get(pen.account.address, {}).values()) for pen in world.pens}
    assert limit < sum(pool.values()) <= 2 * limit
    assert pool[world.pens[2]] > pool[world.pens[1]] > pool[world.pens[0]]
    world.run()
    assert world.model.reverted == 0


def test_dropped_transactions_are_sent_again(world: World):
    world.take(world.pen.chunks(60, 8_000))
    world.turn()
    assert len(waiting(world)) == 5
    world.model.drop(ROBOT, 2)
    world.turn()
    assert waiting(world) == [0, 1, 2, 3, 4]
    world.model.drop()
    world.turn()
    assert waiting(world) == [0, 1, 2, 3, 4]
    world.run()
    assert world.model.reverted == 0


@pytest.mark.parametrize("forget", [True, False])
@pytest.mark.parametrize("depth", [1, 2, 5])
def test_reorganisations_are_healed(tmp_path: Path, depth: int, forget: bool):
    """Also deeper than `confirmations`, which are 2 here."""
    world = World(tmp_path, confirmations=2)
    for _ in range(6):
        world.take(world.pen.chunks(2))
        world.turn(mine=1)
    before = world.on_chain()
    world.model.reorg(depth, forget=forget)
    assert len(world.on_chain()) < len(before)
    world.take(world.pen.chunks(1))
    world.run()
    assert world.model.reverted == 0


def test_what_is_confirmed_may_move_back(tmp_path: Path):
    world = World(tmp_path)
    for _ in range(3):
        world.take(world.pen.chunks(1))
        world.turn(mine=1)
    world.turn()
    assert world.confirmed() == place_of(world.pen.written[2].header)
    world.model.reorg(2, forget=True)
    world.model.pool.clear()
    world.turn()
    assert world.confirmed() == place_of(world.pen.written[0].header)


def test_a_restart_waits_for_what_is_in_the_pool(world: World):
    world.take(world.pen.chunks(40, 8_000))
    world.turn()
    pool = dict(world.model.pool[ROBOT])
    world.restart()
    world.take(world.pen.chunks(1))
    world.turn()
    assert world.model.pool[ROBOT] == pool
    world.model.mine()
    world.run()
    assert world.model.reverted == 0


def test_what_stays_in_the_pool_is_sent_over_after_a_while(world: World):
    world.take(world.pen.chunks(2))
    world.turn()
    world.restart()
    world.model.base_fee *= 10
    world.turn(mine=1)
    world.turn(PATIENCE - 5)
    assert world.model.pool[ROBOT][0].fees == Fees(3 * GWEI, GWEI)
    world.turn(10)
    assert world.model.pool[ROBOT][0].fees.highest >= 20 * GWEI
    world.run()


def test_a_price_that_rises_is_followed_up_to_the_limit(tmp_path: Path):
    world = World(tmp_path, max_fee=50 * GWEI, low_water=0)
    world.take(world.pen.chunks(40, 8_000))
    world.turn()
    world.model.base_fee *= 10
    for _ in range(3):
        world.turn(PATIENCE + 1)
    fees = {tx.fees for tx in world.model.pool[ROBOT].values()}
    assert len(fees) == 1
    assert fees.pop().highest >= 21 * GWEI
    world.run()
    world.model.base_fee = 60 * GWEI
    world.model.mine()
    world.take(world.pen.chunks(1))
    for _ in range(5):
        world.turn(PATIENCE + 1)
    assert "max_fee_gwei" in str(world.submitter.trouble)
    world.model.base_fee = GWEI
    world.model.mine()
    world.run()
    assert world.model.reverted == 0


def test_a_node_that_wants_a_higher_tip_than_it_suggests_is_given_it_up_to_the_limit(tmp_path: Path):
    world = World(tmp_path, max_fee=50 * GWEI, low_water=0)
    world.model.least_tip = 3 * GWEI
    world.take(world.pen.chunks(3))
    world.run()
    assert world.submitter.trouble is None
    world.model.least_tip = 51 * GWEI
    world.take(world.pen.chunks(1))
    for _ in range(60):
        world.turn()
    assert "tip needed 51000000000" in str(world.submitter.trouble)
    world.model.least_tip = 0
    world.run()
    assert world.submitter.trouble is None


def test_transactions_of_somebody_else_are_waited_for(world: World):
    world.take(world.pen.chunks(3))
    world.turn(mine=1)
    for _ in range(3):
        world.model.spend(ROBOT)
    world.take(world.pen.chunks(3))
    world.turn()
    assert [tx.call[0] for tx in world.model.pool[ROBOT].values()] == ["plain"] * 3
    world.model.mine()
    world.run()
    assert world.model.reverted == 0
    world.take(world.pen.chunks(1))
    world.turn()
    world.model.drop()
    world.model.spend(ROBOT)  # takes the very number of one in flight
    world.model.mine()
    world.run()
    assert world.model.reverted == 0


def test_an_answer_that_is_lost_is_not_needed(world: World):
    world.take(world.pen.chunks(3))
    world.model.mute = True
    assert world.turn() > 1
    assert "too slow" in str(world.submitter.trouble)
    world.model.mute = False
    world.run()
    assert world.model.reverted == 0
    assert world.model.state.nonces[ROBOT] == 1


def test_a_node_that_is_away_is_asked_less_and_less_often(world: World):
    world.turn()
    head, world.model.down = world.submitter.head, True
    pauses = [world.turn() for _ in range(8)]
    assert pauses == sorted(pauses)
    assert pauses[-1] == 30
    assert head is not None and world.submitter.head == head  # whose age tells how long
    world.model.down = False
    world.take(world.pen.chunks(1))
    world.run()
    assert world.submitter.trouble is None


# ---------------------------------------------------------------------- the store is not what it was


def test_a_lost_store_learns_where_the_chain_is(world: World):
    world.take(world.pen.chunks(30))
    world.run()
    world.new_store()
    assert world.state().certificates == b"", "the chain was not asked yet"
    world.turn()
    assert world.state().certificates != b""
    assert (world.state().head, world.state().digest) == (world.pen.last, world.pen.digests[-1])
    world.turn()
    assert world.confirmed() == world.pen.last, "a robot that writes no more may forget its log"
    assert set(world.take(world.pen.written)) == {Outcome.KNOWN}
    world.take(world.pen.chunks(2))
    world.run()
    assert world.model.reverted == 0
    assert world.submitter.counts["followed"] == 1


def test_what_was_not_confirmed_when_the_store_was_lost_is_confirmed_later(tmp_path: Path):
    world = World(tmp_path, confirmations=3)
    world.model.mine(5)
    world.take(world.pen.chunks(3))
    world.turn(mine=1)
    world.new_store()
    world.turn()
    assert (world.state().head, world.confirmed()) == (world.pen.last, NOWHERE)
    world.restart()
    world.run()
    assert world.pen.disk == []


@pytest.mark.parametrize("since", [0, 3, 17, 29, 30])
def test_chunks_that_a_robot_sends_again_are_not_written_again(world: World, since: int):
    """It sends everything from number `since` on before the submitter looked."""
    world.take(world.pen.chunks(30))
    world.run()
    world.new_store()
    world.pen.disk = world.pen.written[since:]
    world.take(world.pen.written[since:])
    world.take(world.pen.chunks(2))
    world.run()
    assert world.model.reverted == 0


def test_streams_of_before_that_come_again_are_not_written_again(world: World):
    """The store is lost, and the robot, long without a network, begins with what it has not heard to be confirmed."""
    for _ in range(4):
        world.take(world.pen.chunks(3))
        for _ in range(3):
            world.turn(mine=1)
        world.pen.restart()
    assert len(world.pen.disk) == 12
    world.new_store()
    world.take(world.pen.written[4:])
    world.take(world.pen.chunks(2))
    world.run()
    assert world.model.reverted == 0


def test_a_log_that_nothing_leads_to_is_written_behind_the_other(world: World):
    """The robot lost its disk, and the server its store."""
    world.take(world.pen.chunks(30))
    world.run()
    world.new_store()
    world.turn()
    for _ in range(3):
        world.pen.restart(knows_previous=False)
        assert set(world.take(world.pen.chunks(3))) == {Outcome.STORED}
        world.run()
    assert world.model.reverted == 0


def test_a_store_that_saw_all_asks_for_no_event(world: World, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(world.model, "newest_data", None)
    for _ in range(3):
        world.take(world.pen.chunks(3))
        for _ in range(3):
            world.turn(mine=1)
        assert world.confirmed() == world.pen.last
        world.restart()


@pytest.mark.parametrize("running", [True, False])
def test_an_old_copy_of_the_store_is_put_back(world: World, running: bool):
    """Also under a submitter that runs; what the robot was told to be stored, and nothing else has, comes again."""
    world.take(world.pen.chunks(10))
    world.run()
    world.take(world.pen.chunks(5))  # not on the chain when the copy is made
    old = world.copy()
    world.run()
    world.take(world.pen.chunks(10))
    world.run()
    world.take(world.pen.chunks(4))
    if running:
        world.put_back(old)
    else:
        world.new_store(old)
    world.take(world.pen.chunks(5))
    world.run()
    assert world.model.reverted == 0


def test_what_was_in_flight_when_the_store_was_lost_is_written_once(world: World):
    world.take(world.pen.chunks(3))
    world.turn()
    world.lose()
    world.turn()
    world.model.mine()
    world.run()
    assert world.model.reverted == 0
    world.take(world.pen.chunks(3))
    world.turn()
    world.model.drop()
    world.lose()
    world.run()
    assert world.model.reverted == 0


def test_what_was_in_flight_and_is_no_row_any_more_is_let_go(world: World):
    world.take(world.pen.chunks(6))
    world.turn()
    world.model.drop()
    world.lose()
    assert set(world.take(world.pen.written[:2])) == {Outcome.STORED}
    world.turn(mine=1)
    assert world.on_chain() == world.pen.digests[:2]
    world.run()
    assert world.model.reverted == 0


def test_rows_beyond_the_head_wait_for_those_in_front(world: World):
    """A store that was put back took a robot's oldest before anybody looked at the chain, which then turned back."""
    world.take(world.pen.chunks(4))
    world.turn(mine=1)
    world.new_store()
    assert world.take(world.pen.written[3:]) == [Outcome.STORED]
    world.model.reorg(1, forget=True)
    world.model.pool.clear()
    world.store.follow(world.pen.tk, NO_HASH, None)
    world.turn(mine=1)
    assert world.on_chain() == []
    assert set(world.take(world.pen.written[:2])) == {Outcome.STORED}
    world.turn(mine=1)
    assert world.on_chain() == world.pen.digests[:2], "the third is still to come, and the fourth behind it"
    world.run()
    assert world.model.reverted == 0


def test_the_head_is_never_behind_the_chain(world: World):
    """Rows of which the store forgot that it has them, and which somebody wrote meanwhile."""
    world.take(world.pen.chunks(4))
    world.run()
    assert world.pen.disk == []
    world.store.follow(world.pen.tk, keccak(world.pen.written[1].encoded), world.pen.written[1].header)
    assert len(world.store.rows(world.pen.tk, NOWHERE, 9)) == 2
    for _ in range(2):
        world.turn(mine=1)
    assert (world.state().head, world.confirmed()) == (world.pen.last, world.pen.last)
    assert world.model.reverted == 0


def test_a_chain_that_turns_back_while_it_is_asked_is_asked_again(world: World, monkeypatch: pytest.MonkeyPatch):
    world.take(world.pen.chunks(2))
    world.run()
    world.new_store()
    with monkeypatch.context() as patched:
        event = next(world.model.newest_data(world.pen.tk, 10**6))
        older = event._replace(chunks=(world.pen.written[0].encoded,))
        for shown in (older, older._replace(chunks=()), None):
            patched.setattr(world.model, "newest_data", lambda tk, block, shown=shown: iter([shown] if shown else []))
            world.turn(mine=1)
            assert "chain changed" in world.hold() and world.state().head == NOWHERE
            assert world.state().certificates == b""
    world.turn()
    assert world.state().head == world.pen.last and world.hold() == ""


def test_a_chain_that_cannot_be_read_holds_only_that_robot_up(tmp_path: Path):
    world = World(tmp_path, robots=2)
    world.take(world.pen.chunks(1))
    world.run()
    world.new_store()
    other, read = world.pens[1], world.model.newest_data

    def refuse(*_: object) -> Iterator[DataEvent]:
        raise ChainUnavailable("range too wide")

    world.model.newest_data = refuse  # type: ignore[method-assign]
    world.take(other.chunks(1), other)
    world.turn(mine=1)
    assert "range too wide" in world.hold() and world.state().certificates == b""
    world.model.newest_data = read  # type: ignore[method-assign]
    assert world.on_chain(other) == other.digests
    world.run()
    assert world.hold() == ""


def test_confirmed_rows_are_kept_for_a_day_or_half_of_the_share(tmp_path: Path):
    world = World(tmp_path)
    world.store.max_bytes_per_robot = 20_000
    world.take(world.pen.chunks(10, 1_500))
    world.run()
    world.turn(61)
    world.turn()
    assert 2 <= len(world.store.rows(world.pen.tk, NOWHERE, 99)) <= 7
    world.turn(86_401)
    world.turn(61)
    assert [row.place for row in world.store.rows(world.pen.tk, NOWHERE, 99)] == [world.pen.last]
    world.take(world.pen.chunks(3))
    world.run()
    assert world.model.reverted == 0 and world.submitter.counts["followed"] == 0


def test_a_quiet_robot_costs_no_call_of_the_store(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    world = World(tmp_path, robots=20)
    for pen in world.pens[:10]:
        world.take(pen.chunks(2), pen)
    world.run()
    for _ in range(2):
        world.turn(mine=1)
    for name in ("find", "rows", "set_state", "follow"):
        monkeypatch.setattr(world.store, name, None)
    for _ in range(20):
        world.turn(mine=1)
    assert world.submitter.trouble is None and len(world.submitter.standings) == 20


def test_what_another_program_wrote_holds_only_its_robot_up(tmp_path: Path):
    world = World(tmp_path, robots=2)
    world.take(world.pen.chunks(1))
    world.run()
    standing = world.model.state.standings[world.pen.tk]
    raw = world.model.sign(
        KEYS.account(1), ("setData", world.pen.tk, 1, standing.tail, [b"?"]), nonce=1, gas=10**6, fees=Fees(10**10, 1)
    )
    world.model.send([raw.raw])
    world.model.mine()
    other = world.pens[1]
    world.take(world.pen.chunks(1))
    world.take(other.chunks(1), other)
    world.turn(mine=1)
    assert "another program" in world.hold()
    assert world.on_chain(other) == other.digests


# ---------------------------------------------------------------------- permission and money


def test_a_robot_that_may_not_write_is_on_hold_and_others_go_on(tmp_path: Path):
    world = World(tmp_path, robots=4)
    stranger, revoked, moved, fine = world.pens
    standings = world.model.state.standings
    del standings[stranger.tk]
    standings[revoked.tk] = standings[revoked.tk]._replace(revoked=True)
    standings[moved.tk] = standings[moved.tk]._replace(account=KEYS.account(9).address)
    for pen in world.pens:
        world.take(pen.chunks(2), pen)
    world.turn(mine=1)
    world.turn()
    assert "not registered" in world.hold(stranger)
    assert "revoked" in world.hold(revoked)
    assert "whose key is not here" in world.hold(moved)
    assert world.on_chain(fine) == fine.digests
    assert world.hold(fine) == ""
    for pen in (stranger, revoked):
        assert world.state(pen).certificates == bytes(32), "no certificate is right"
    standings = world.model.state.standings
    standings[revoked.tk] = standings[revoked.tk]._replace(revoked=False)
    world.turn(mine=1)
    assert world.on_chain(revoked) == revoked.digests
    world.turn()
    assert world.hold(revoked) == ""


def test_what_a_robot_had_in_flight_when_it_was_revoked_takes_no_room_from_others(tmp_path: Path):
    world = World(tmp_path, robots=2)
    revoked, fine = world.pens
    world.take(revoked.chunks(120, 8_000), revoked)
    world.turn()
    assert world.in_flight == IN_FLIGHT
    standings = world.model.state.standings
    standings[revoked.tk] = standings[revoked.tk]._replace(revoked=True)
    world.model.drop()
    world.take(fine.chunks(100, 8_000), fine)
    for _ in range(10):
        world.turn(mine=1)
    world.turn()
    assert world.on_chain(fine) == fine.digests
    assert world.in_flight == 0


def test_a_refusal_costs_one_transaction_and_then_nothing(world: World):
    """The contract refuses what the submitter has no other way to foresee."""
    world.take(world.pen.chunks(3))
    refuse, world.model._refuse = world.model._refuse, lambda *_: exec("raise Reverted('no: Paused()')", globals_)
    globals_ = vars(__import__("rosbridge_eth.ledger.transport", fromlist=["Reverted"]))
    for _ in range(200):
        world.turn(mine=1)
    assert world.model.reverted == 1
    assert "Paused" in world.hold()
    world.model._refuse = refuse  # type: ignore[method-assign]
    world.turn(PATIENCE + 1)
    world.run()
    assert world.hold() == ""


def test_accounts_are_topped_up_once_each(tmp_path: Path):
    world = World(tmp_path, robots=3, wei=0)
    for pen in world.pens:
        world.take(pen.chunks(1), pen)
    world.turn()
    assert [tx.call for tx in world.model.pool[OPERATOR].values()] == [
        ("allocETH", pen.account.address) for pen in world.pens
    ]
    for _ in range(3):
        world.turn()
    world.run()
    for pen in world.pens:
        assert ETH // 2 - ETH // 50 < world.model.balance(pen.account.address) <= ETH // 2
    assert world.submitter.counts["top-ups"] == 3
    assert world.model.reverted == 0


def test_accounts_of_robots_that_others_write_for_are_topped_up_each_minute(tmp_path: Path):
    """As shard 0 does for the other shards' robots, whose work it does not see."""
    world = World(tmp_path, robots=4, wei=0)
    mine, poor, revoked, rich = world.pens
    world.model.state.balances[rich.account.address] = ETH // 2
    standings = world.model.state.standings
    standings[revoked.tk] = standings[revoked.tk]._replace(revoked=True)
    world.submitter = Submitter(
        world.model, world.store, lambda: [mine.tk], lambda tk: mine.account, KEYS.operator, world.settings,  # type: ignore[arg-type]
        others=lambda: [poor.tk, revoked.tk, rich.tk],
    )  # fmt: skip
    for _ in range(50):
        world.turn(mine=1)
    assert [world.model.balance(pen.account.address) for pen in world.pens] == [0, ETH // 2, 0, ETH // 2]
    world.model.state.balances[poor.account.address] = 0
    world.model.state.balances[OPERATOR] = 0
    for _ in range(61):
        world.turn(mine=1)
    assert "is empty" in str(world.submitter.funds)
    world.model.state.balances[OPERATOR] = ETH
    for _ in range(2):
        world.turn(mine=1)
    assert world.model.balance(poor.account.address) == ETH // 2 and world.submitter.funds is None
    assert world.model.reverted == 0 and world.submitter.counts["top-ups"] == 2


def test_a_top_up_that_is_stuck_is_raised_and_one_that_was_dropped_sent_again(tmp_path: Path):
    world = World(tmp_path, wei=0)
    world.take(world.pen.chunks(1))
    world.turn()
    world.model.drop()
    world.turn()
    world.model.base_fee *= 20
    world.turn(mine=1)
    world.turn(PATIENCE + 1)
    world.run()
    assert world.model.balance(ROBOT) <= ETH // 2


def test_an_empty_treasury_is_said_and_nothing_is_dropped(tmp_path: Path):
    world = World(tmp_path, wei=0)
    world.model.state.balances[OPERATOR] = 0
    world.take(world.pen.chunks(2))
    for _ in range(5):
        world.turn(mine=1)
    assert "is empty" in str(world.submitter.funds)
    world.model.state.balances[OPERATOR] = ETH
    world.run()
    assert world.submitter.funds is None


def test_a_top_up_that_the_node_refuses_is_said_and_not_counted(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    world = World(tmp_path, wei=0)
    world.take(world.pen.chunks(1))
    with monkeypatch.context() as patched:
        patched.setattr(world.model, "_accept", lambda tx: Underpriced("transaction underpriced"))
        for _ in range(3):
            world.turn()
    assert "underpriced" in str(world.submitter.funds)
    assert world.submitter.counts["top-ups"] == 0
    world.run()
    assert world.submitter.counts["top-ups"] == 1 and world.submitter.funds is None


def test_robots_without_money_take_no_room_from_one_that_has_some(tmp_path: Path):
    world = World(tmp_path, robots=3)
    *broke, rich = world.pens
    world.model.state.balances[OPERATOR] = 0
    for pen in broke:
        world.model.state.balances[pen.account.address] = 0
        world.take(pen.chunks(120, 8_000), pen)
    world.turn()
    world.take(rich.chunks(100, 8_000), rich)
    for _ in range(20):
        world.turn(mine=1)
    assert world.on_chain(rich) == rich.digests
    world.model.state.balances[OPERATOR] = 10 * ETH
    world.run()
    assert world.model.reverted == 0


def test_what_is_said_of_the_treasury_ends_with_the_work_that_needed_it(tmp_path: Path):
    world = World(tmp_path, wei=ETH // 100)
    world.model.state.balances[OPERATOR] = 0
    world.take(world.pen.chunks(1))
    world.turn()
    assert "is empty" in str(world.submitter.funds)
    world.run()
    world.model.state.balances[OPERATOR] = ETH
    world.turn()
    assert world.submitter.funds is None


def test_a_batch_above_the_gas_of_an_hour_is_paid_by_those_after_it(tmp_path: Path):
    world = World(tmp_path, gas_per_day=1_000_000)
    world.take(world.pen.chunks(12, 8_000))
    for _ in range(3 * 24):
        world.turn(3600, mine=1)
    assert world.on_chain() == world.pen.digests, "about 4 million gas: one day's, and the next three are spent"
    world.take(world.pen.chunks(1, 8_000))
    for _ in range(2):
        world.turn(3600, mine=1)
    assert len(world.on_chain()) == 12 and "gas_per_day" in world.hold()


def test_a_robot_spends_at_most_its_gas_of_a_day(tmp_path: Path):
    world = World(tmp_path, robots=2, gas_per_day=40_000_000)
    greedy, modest = world.pens
    world.take(greedy.chunks(300, 8_000), greedy)
    world.take(modest.chunks(2), modest)
    for _ in range(10):
        world.turn(mine=1)
    first = sum(tx.gas for s in world.model.states for tx in s.transactions if tx.sender == greedy.account.address)
    assert first <= 4_000_000, "one batch, above an hour's gas"
    assert world.on_chain(modest) == modest.digests
    assert "gas_per_day" in world.hold(greedy)
    for _ in range(24 * 6):
        world.turn(600, mine=1)
    spent = sum(tx.gas for s in world.model.states for tx in s.transactions if tx.sender == greedy.account.address)
    assert 36_000_000 < spent <= 44_000_000
    world.turn(30 * 86_400, mine=1)
    for _ in range(10):
        world.turn(mine=1)
    more = sum(tx.gas for s in world.model.states for tx in s.transactions if tx.sender == greedy.account.address)
    assert more - spent <= 4_000_000, "what was not used for a month is not kept for a burst"


# ---------------------------------------------------------------------- everything at once


@pytest.mark.parametrize("seed", range(40))
def test_whatever_happens_every_chunk_is_written_once_and_in_order(tmp_path: Path, seed: int):
    """Random faults; the robots do by the rule: they send what follows the head that they are told.

    Either the chain turns back beyond `confirmations`, or the store is lost or an old one put back: with both, what
    the robot was told to be confirmed is nowhere.
    """
    dice = random.Random(seed)
    faults = "mmmmmmmmwwwwwwdpfrknsu" + dice.choice(["RR", "loOc"])
    world = World(tmp_path, robots=2, confirmations=3)
    old: Path | None = None
    rivals = list[Submitter]()  # two submitters by mistake
    for _ in range(120):
        world.turn(dice.choice([0.3, 1, 1, 5, 40]))
        for rival in rivals:
            rival.turn(world.now)
        match dice.choice(faults):
            case "m":
                world.model.mine(dice.choice([1, 1, 2]))
            case "w":
                pen = dice.choice(world.pens)
                if dice.random() < 0.2:
                    pen.restart(knows_previous=dice.random() < 0.8)
                pen.chunks(dice.randrange(1, 12), dice.choice([0, 0, 8_000]))
            case "d":
                world.model.drop(ROBOT, world.model.state.nonces[ROBOT] + dice.randrange(3))
            case "p":
                world.model.drop()
            case "f":
                world.model.base_fee = GWEI * dice.choice([1, 1, 3, 20])
            case "r":
                world.model.reorg(dice.randrange(1, 3), forget=dice.random() < 0.5)
            case "R":
                world.model.reorg(dice.randrange(3, 8), forget=dice.random() < 0.5)
            case "k":
                world.restart()
            case "l":
                world.new_store()
            case "c":
                old = world.copy()
            case "o" if old is not None:
                world.new_store(old)
                old = None
            case "O":  # while it is used; the robots may speak before the submitter looks
                world.put_back(old) if old is not None else world.lose()
            case "n":
                world.model.spend(dice.choice(world.pens).account.address)
            case "s":
                first = world.submitter
                world.restart()
                rivals = [first] if not rivals else []
            case "u":
                world.model.mute = not world.model.mute
        for pen in world.pens:
            if dice.random() < 0.6:  # the others have no network
                assert Outcome.DIFFERENT not in world.talk(pen)
    world.model.mute, world.model.base_fee = False, GWEI
    for _ in range(60):
        world.turn(10, mine=1)
        for pen in world.pens:
            world.talk(pen)
    for pen in world.pens:
        assert world.on_chain(pen) == pen.digests
        assert pen.disk == []


@pytest.mark.parametrize("seed", range(20))
def test_robots_that_move_between_shards_whose_stores_are_lost_are_written_once_and_in_order(tmp_path: Path, seed: int):
    """Servers that share nothing but the contract: each has a store and a submitter, for the robots it has just now.

    What a shard had of a robot that comes back is old; what it sent for one that went may still be mined.
    """
    dice = random.Random(seed)
    folders = [tmp_path / str(number) for number in range(3)]
    for folder in folders:
        folder.mkdir()
    shards = [World(folder, robots=0, confirmations=3) for folder in folders]
    pens = [Pen(f"robot_{number}", number) for number in range(1, 4)]
    here = {pen.tk: 0 for pen in pens}
    chain = shards[0].model
    chain.history = 1_000
    for pen in pens:
        chain.register(pen.tk, pen.account.address, 0)
    chain.state.balances[OPERATOR] = 1000 * ETH
    chain.mine()
    for number, shard in enumerate(shards):
        shard.pens, shard.chain, shard.ledger, shard.pays = pens, chain, chain, number == 0
        shard.robots = lambda number=number: [tk for tk, at in here.items() if at == number]
        shard.restart()
    copies: dict[int, Path] = {}

    def talk(pen: Pen) -> None:
        assert Outcome.DIFFERENT not in shards[here[pen.tk]].talk(pen)

    for _ in range(100):
        for shard in shards:
            shard.turn(dice.choice([0.3, 1, 5, 40]))
        at = dice.randrange(3)
        match dice.choice("mmmmmmwwwwwwdprkloOcMM"):
            case "m":
                chain.mine()
            case "w":
                pen = dice.choice(pens)
                if dice.random() < 0.2:
                    pen.restart(knows_previous=dice.random() < 0.8)
                pen.chunks(dice.randrange(1, 8), dice.choice([0, 0, 8_000]))
            case "d":
                account = dice.choice(pens).account.address
                chain.drop(account, chain.state.nonces[account] + dice.randrange(3))
            case "p":
                chain.drop()
            case "r":
                chain.reorg(dice.randrange(1, 3), forget=dice.random() < 0.5)
            case "k":
                shards[at].restart()
            case "l":
                shards[at].new_store()
            case "c":
                copies[at] = shards[at].copy()
            case "o" if at in copies:
                shards[at].new_store(copies.pop(at))
            case "O":
                shards[at].put_back(copies[at]) if at in copies else shards[at].lose()
            case "M":  # to another shard
                here[dice.choice(pens).tk] = at
        for pen in pens:
            if dice.random() < 0.6:
                talk(pen)
    for _ in range(60):
        for shard in shards:
            shard.turn(10)
        chain.mine()
        for pen in pens:
            talk(pen)
    for pen in pens:
        assert shards[0].on_chain(pen) == pen.digests
        assert pen.disk == []
