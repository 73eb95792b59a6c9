"""The submitter against a chain that misbehaves in every way it knows: nothing lost, nothing written twice."""

from __future__ import annotations

import random
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bridge.ledger.model_chain import CHAIN_ID, CONTRACT, GWEI, ModelChain, parse
from bridge.ledger.world import ACCOUNT, ETH, KEYRING, OPERATOR, OTHER_ACCOUNT, OTHER_ROBOT, ROBOT, Records
from rosbridge_eth.errors import StoreError
from rosbridge_eth.ledger import failures
from rosbridge_eth.ledger.batching import Limits
from rosbridge_eth.ledger.journal import Binding, Journal, LeaseLost
from rosbridge_eth.ledger.pump import pump
from rosbridge_eth.ledger.states import Kind, State
from rosbridge_eth.ledger.submitter import Settings, Submitter
from rosbridge_eth.records import SealedRecord

SMALL = Settings(limits=Limits(records=4), confirmations=3, poll=1.0)
BINDING = Binding(CHAIN_ID, bytes(32), CONTRACT, b"code")
ACCOUNTS = {ROBOT: ACCOUNT, OTHER_ROBOT: OTHER_ACCOUNT}


class Crash(BaseException):
    """The process ends here."""


class Moments:
    """Counts the moments at which a process could end, and ends it at one of them."""

    def __init__(self) -> None:
        self.passed = 0
        self.crash_at: int | None = None

    def pass_(self) -> None:
        self.passed += 1
        if self.passed == self.crash_at:
            raise Crash


class CrashingJournal(Journal):
    """Ends the process before a transaction, within it, or after it."""

    moments: Moments | None = None

    def __init__(self, path: Path | str, binding: Binding) -> None:
        super().__init__(path, binding)
        self._db.execute("PRAGMA synchronous=OFF")  # the process ends here, not the machine: no need to wait for it

    @contextmanager
    def transaction(self) -> Iterator[object]:
        if self.moments is None or self._inside:
            with super().transaction() as db:
                yield db
            return
        self.moments.pass_()
        with super().transaction() as db:
            yield db
            self.moments.pass_()
        self.moments.pass_()


class FaultyChain:
    """A chain some of whose answers fail or get lost; `before`, `after` may raise."""

    def __init__(self, chain: ModelChain) -> None:
        self._chain = chain
        self.before: Callable[[str], None] = lambda method: None
        self.after: Callable[[str], None] = lambda method: None

    def __getattr__(self, name: str) -> object:
        inner = getattr(self._chain, name)
        if not callable(inner):
            return inner

        def ask(*arguments: object) -> object:
            self.before(name)
            answer = inner(*arguments)
            self.after(name)
            return answer

        return ask


@dataclass
class World:
    """A model chain with two registered robots, and the submitter's process."""

    path: Path | str = ":memory:"
    settings: Settings = SMALL
    treasury: int = 100 * ETH
    wei: int = ETH
    now: float = 1000.0
    given: list[SealedRecord] = field(default_factory=list)
    moments: Moments | None = None
    holder: str = "first"

    def __post_init__(self) -> None:
        self.model = ModelChain(OPERATOR.address, self.treasury)
        for robot, account in ACCOUNTS.items():
            self.model.state.accounts[robot] = account.address
            self.model.state.balances[account.address] = self.wei
        self.chain = FaultyChain(self.model)
        self.accounts = dict(ACCOUNTS)
        self.records = Records()
        self.start()

    def start(self) -> None:
        self.journal = CrashingJournal(self.path, BINDING)
        self.journal.moments = self.moments
        self.submitter = Submitter(
            self.journal,
            contract=CONTRACT,
            chain_id=CHAIN_ID,
            account_of=self.accounts.get,
            operator=OPERATOR,
            holder=self.holder,
            settings=self.settings,
        )

    def seal(self, records: list[SealedRecord]) -> None:
        self.given += [record for record in records if record not in self.given]
        self.submitter.seal(records, self.now)

    def step(self, mine: int = 1, seconds: float = 2.0) -> None:
        pump(self.submitter, self.chain, self.now)
        self.model.mine(mine)
        self.now += seconds

    def finish(self, steps: int = 120) -> None:
        for _ in range(steps):
            self.step()
            if self.submitter.idle():
                return
        raise AssertionError(f"not idle: {[(j.id, j.kind, j.state, j.reason) for j in self.journal.jobs()]}")

    def jobs(self, kind: Kind = Kind.BATCH, states: tuple[State, ...] = tuple(State)) -> list:
        return [job for job in self.journal.jobs(states) if job.kind is kind]

    def in_flight(self) -> list:
        return self.jobs(states=(State.READY, State.PENDING))

    def check(self, dead: int = 0) -> None:
        """Every record given is on the chain once, or is one of `dead` dead letters."""
        assert not self.jobs(states=(State.SEALED, State.READY, State.PENDING, State.INCLUDED, State.SPLIT))
        letters = {letter.record for letter in self.journal.dead_letters()}
        assert len(letters) == dead
        assert Counter(self.model.written) + Counter(letters) == Counter(self.given)
        for record in self.given:
            location = self.journal.find(record.id)
            assert location is not None
            assert location.state in ((State.DEAD,) if record in letters else (State.CONFIRMED, State.ACKNOWLEDGED))
        for account in [*ACCOUNTS.values(), OPERATOR]:
            assert self.journal.next_nonce(account.address) <= self.model.nonce(account.address)


# ---------------------------------------------------------------------- the ordinary way


def test_batches_go_from_sealed_to_confirmed_and_are_acknowledged():
    world = World()
    world.seal(world.records.run(10) + world.records.run(3, robot=OTHER_ROBOT))
    assert [job.count for job in world.jobs()] == [4, 4, 2, 3]
    pump(world.submitter, world.chain, world.now)
    assert {job.state for job in world.jobs()} == {State.PENDING}
    assert world.submitter.confirmed() == []
    world.finish()
    confirmed = world.submitter.confirmed()
    assert len(confirmed) == 4
    world.submitter.acknowledge(confirmed)
    assert world.submitter.confirmed() == []
    world.check()
    assert {job.state for job in world.jobs()} == {State.ACKNOWLEDGED}


def test_confirmed_means_so_many_blocks_deep():
    world = World()
    world.seal(world.records.run(1))
    world.step()  # block 1 holds it: depth 1
    for depth in (1, 2):
        pump(world.submitter, world.chain, world.now)
        assert [job.state for job in world.jobs()] == [State.INCLUDED], depth
        world.step()
    pump(world.submitter, world.chain, world.now)
    assert [job.state for job in world.jobs()] == [State.CONFIRMED]


def test_submit_include_and_confirm_are_timed_apart():
    world = World()
    world.seal(world.records.run(2))
    sealed = world.now
    world.now += 5
    pump(world.submitter, world.chain, world.now)
    world.now += 7
    world.model.mine()
    pump(world.submitter, world.chain, world.now)
    world.now += 11
    world.model.mine(2)
    pump(world.submitter, world.chain, world.now)
    (timing,) = world.submitter.timings()
    assert (timing.submit, timing.include, timing.confirm) == (5, 7, 11)
    assert world.now == sealed + 23
    assert world.submitter.timings() == []


def test_several_are_in_flight_but_no_more_than_allowed():
    world = World(settings=Settings(limits=Limits(records=1), max_in_flight=3))
    world.seal(world.records.run(7))
    pump(world.submitter, world.chain, world.now)
    assert len(world.model.pool) == 3
    world.finish()
    world.check()
    assert world.model.nonce(ACCOUNT.address) == 7


def test_records_known_already_are_not_sealed_again():
    world = World()
    records = world.records.run(5)
    world.seal(records[:3])
    sealing = world.submitter.seal(records, world.now)
    assert [job.count for job in sealing.jobs] == [2]
    assert set(sealing.known) == {record.id for record in records[:3]}
    world.given = records
    world.finish()
    assert world.submitter.seal(records, world.now).jobs == ()
    world.check()


def test_what_fits_no_batch_is_a_dead_letter_at_once():
    world = World(settings=Settings(limits=Limits(calldata=1000)))
    good, large = world.records.run(1), world.records.run(1, size=1000)
    world.given = good + large
    sealing = world.submitter.seal(good + large, world.now)
    assert sealing.dead == (large[0].id,)
    world.finish()
    world.check(dead=1)
    assert "calldata" in world.journal.dead_letters()[0].reason


# ---------------------------------------------------------------------- a process that ends


STORY = Settings(
    limits=Limits(records=4),
    confirmations=3,
    bump_after=4.0,
    probe_after=3.0,
    stuck_blocks=2,
    stuck_bumps=1,
    low_water=ETH // 50,
    top_up=ETH // 10,
    lease=5.0,
)


def live_through(path: Path, crash_at: int | None) -> tuple[World, int]:
    """The story, with the process ending at one moment and another one taking over; how many moments it had.

    Two robots with little money, a record that can never be mined, two reorganisations.
    """
    moments = Moments()
    moments.crash_at = crash_at
    world = World(path=path, settings=STORY, wei=ETH // 100, moments=moments)
    world.chain.before = world.chain.after = lambda method: moments.pass_()
    poison = world.records.run(1, robot=OTHER_ROBOT, size=99)[0]
    world.model.never_mines = lambda tx: poison.ciphertext in tx.data
    chapters = {
        0: world.records.run(6),
        2: [*world.records.run(2, robot=OTHER_ROBOT), poison, *world.records.run(1, robot=OTHER_ROBOT)],
    }
    for chapter in range(90):
        if chapter in chapters:
            persist(world, lambda records=chapters[chapter]: world.seal(records))
        if chapter in (4, 9):
            world.model.reorg(2)
        persist(world, lambda: pump(world.submitter, world.chain, world.now))
        world.model.mine()
        world.now += 2.0
        if chapter > 12 and world.submitter.idle():
            return world, moments.passed
    raise AssertionError(f"does not end: {[(j.id, j.kind, j.state, j.reason) for j in world.journal.jobs()]}")


def persist(world: World, act: Callable[[], object]) -> None:
    """Do it; if the process ends there, start another one, which does it again."""
    try:
        act()
    except Crash:
        world.journal.close()
        world.start()
        act()


@pytest.mark.slow
def test_a_crash_between_any_two_writes_loses_and_doubles_nothing(tmp_path: Path):
    untouched, moments = live_through(tmp_path / "none", None)
    untouched.check(dead=1)
    assert moments > 300
    assert len(untouched.jobs(Kind.TOP_UP)) == 2
    assert untouched.jobs(Kind.FILLER)
    spent = {a.address: untouched.model.balance(a.address) for a in (ACCOUNT, OTHER_ACCOUNT)}
    for moment in range(1, moments + 1):
        world, _ = live_through(tmp_path / f"{moment}", moment)
        try:
            world.check(dead=1)
            paid = [job for job in world.jobs(Kind.TOP_UP) if job.state is State.CONFIRMED]
            assert len(paid) == 2
            assert all(world.model.balance(address) > wei // 2 for address, wei in spent.items())
        except AssertionError as error:
            raise AssertionError(f"after a crash at moment {moment} of {moments}: {error}") from error
        finally:
            world.journal.close()
            (tmp_path / f"{moment}").unlink()


# ---------------------------------------------------------------------- what a node answers


@pytest.mark.parametrize(
    "failure",
    [
        failures.Unreachable("no answer"),
        failures.Garbled("not JSON"),
        failures.RateLimited("slow down", 3.0),
        failures.Refused("words nobody knows"),
        failures.PoolFull("txpool is full"),
        failures.NonceTooHigh("nonce too high"),
        failures.Unsupported("method not found"),
    ],
    ids=lambda failure: type(failure).__name__,
)
@pytest.mark.parametrize("method", ["head", "nonce", "block", "estimate_gas", "send", "receipts"])
def test_a_failing_node_only_delays(failure: failures.NodeFailure, method: str):
    world = World()
    remaining = Counter({method: 4})

    def fail(called: str) -> None:
        if remaining[called] > 0:
            remaining[called] -= 1
            raise failure

    world.chain.before = fail
    world.seal(world.records.run(6))
    world.finish()
    assert remaining[method] == 0
    world.check()


@pytest.mark.parametrize(
    "failure",
    [failures.PoolFull("full"), failures.NonceTooHigh("gap"), failures.RateLimited("slow"), failures.Refused("?")],
    ids=lambda failure: type(failure).__name__,
)
def test_a_transaction_refused_for_now_is_sent_again(failure: failures.NodeFailure, monkeypatch: pytest.MonkeyPatch):
    world = World()
    world.seal(world.records.run(2))
    accept, refusals = world.model._accept, [failure] * 3
    monkeypatch.setattr(world.model, "_accept", lambda tx: refusals.pop() if refusals else accept(tx))
    pump(world.submitter, world.chain, world.now)
    assert [job.state for job in world.jobs()] == [State.READY]
    assert world.submitter.status().failure == str(failure)
    world.finish()
    world.check()


def test_an_answer_that_was_lost_is_found_out():
    world = World()
    lost = [failures.Unreachable("connection reset")]

    def lose(called: str) -> None:
        if called == "send" and lost:
            raise lost.pop()

    world.chain.after = lose
    world.seal(world.records.run(2))
    pump(world.submitter, world.chain, world.now)
    assert [job.state for job in world.jobs()] == [State.READY]  # though the node has it
    assert len(world.model.pool) == 1
    world.finish()
    world.check()
    assert world.model.nonce(ACCOUNT.address) == 1


def test_a_retry_waits_longer_each_time_and_as_long_as_the_node_asks():
    world = World()
    asked = []
    world.chain.before = lambda method: asked.append(world.now) or (_ for _ in ()).throw(failures.Unreachable("x"))
    world.seal(world.records.run(1))
    for _ in range(400):
        pump(world.submitter, world.chain, world.now)
        world.now += 0.5
    pauses = [after - before for before, after in pairwise(asked)]
    assert pauses[:5] == [1, 2, 4, 8, 16]
    assert max(pauses) <= world.settings.max_retry
    world.chain.before = lambda method: (_ for _ in ()).throw(failures.RateLimited("x", 200.0))
    world.now += 100
    pump(world.submitter, world.chain, world.now)
    assert world.submitter.next_timer(world.now) == world.now + 200


# ---------------------------------------------------------------------- fees


def test_a_stuck_transaction_gets_a_higher_fee_under_the_same_nonce():
    world = World()
    world.seal(world.records.run(1))
    pump(world.submitter, world.chain, world.now)
    (first,) = world.model.pool.values()
    world.model.base_fee = first.max_fee + 1
    world.step()
    pump(world.submitter, world.chain, world.now)
    (second,) = world.model.pool.values()
    assert (second.sender, second.nonce, second.data) == (first.sender, first.nonce, first.data)
    assert second.max_fee >= first.max_fee * 1.1
    assert second.tip >= first.tip * 1.1
    assert second.max_fee >= world.model.base_fee
    world.finish()
    world.check()


def test_a_base_fee_that_rises_tenfold_is_followed():
    world = World()
    world.seal(world.records.run(12))
    pump(world.submitter, world.chain, world.now)
    for _ in range(20):
        world.model.base_fee = world.model.base_fee * 9 // 8 + 1
        world.step()
        world.seal(world.records.run(1))
    assert world.model.base_fee > 10 * GWEI
    world.finish()
    world.check()


def test_above_the_highest_fee_allowed_it_waits_and_says_so():
    world = World(settings=Settings(limits=Limits(records=4), max_fee=20 * GWEI))
    world.seal(world.records.run(1))
    world.model.base_fee = 30 * GWEI
    for _ in range(50):
        world.step()
    assert world.submitter.status().fee_capped
    assert not world.model.written
    assert all(tx.max_fee <= 20 * GWEI for tx in world.model.pool.values())
    world.model.base_fee = GWEI
    world.finish()
    world.check()
    assert not world.submitter.status().fee_capped


# ---------------------------------------------------------------------- lost, replaced, reorganised


def test_a_dropped_transaction_is_sent_again_as_it_was():
    world = World()
    world.seal(world.records.run(8))
    pump(world.submitter, world.chain, world.now)
    first, second = world.model.pool.values()
    world.model.drop(first.hash)
    for _ in range(8):
        world.step()
    assert world.model.receipts([first.hash]) != [None]
    assert world.model.receipts([second.hash]) != [None]
    world.finish()
    world.check()


@pytest.mark.parametrize("forget", [False, True])
@pytest.mark.parametrize("depth", [1, 2, 3, 5, 8])
def test_a_reorganisation_of_any_depth_loses_nothing(depth: int, forget: bool):
    world = World()
    world.model.mine(10)
    world.seal(world.records.run(10))
    for _ in range(7):
        world.step()  # the first are confirmed by now
    world.seal(world.records.run(3))
    world.step()
    world.model.reorg(depth, forget=forget)
    for _ in range(20):
        world.step()
    world.finish()
    world.check()


def test_a_nonce_that_something_else_used_is_given_up_for_another():
    world = World()
    world.seal(world.records.run(3))
    pump(world.submitter, world.chain, world.now)
    (mine,) = world.model.pool.values()
    world.model.drop(mine.hash)
    world.model.state.nonces[ACCOUNT.address] = 1  # somebody has the key, too
    world.finish()
    world.check()
    (job,) = world.jobs()
    assert job.nonce == 1
    assert job.batch_index == 0
    assert "another transaction" in job.reason


def test_a_nonce_counts_as_lost_only_when_that_is_final():
    world = World()
    world.seal(world.records.run(3))
    pump(world.submitter, world.chain, world.now)
    (mine,) = world.model.pool.values()
    world.model.pool.clear()
    world.model.mine()
    world.model.state.nonces[ACCOUNT.address] = 1  # somebody else's transaction, in the last block
    for _ in range(2):
        world.now += 2.0
        pump(world.submitter, world.chain, world.now)
        assert [(job.state, job.nonce) for job in world.jobs()] == [(State.PENDING, 0)]
        world.model.mine()
    world.model.reorg(3)  # and it is gone again
    world.finish()
    world.check()
    assert world.model.receipts([mine.hash]) != [None]


def test_a_revert_counts_only_when_it_is_final():
    world = World()
    world.seal(world.records.run(3))
    pump(world.submitter, world.chain, world.now)
    world.model.state.revoked.add(ROBOT)
    world.model.mine()
    world.now += 2.0
    pump(world.submitter, world.chain, world.now)
    assert [job.state for job in world.jobs()] == [State.PENDING]
    world.model.blocks[0].state.revoked.clear()
    world.model.reorg(1)
    world.finish()
    world.check()
    (job,) = world.jobs()
    assert (job.failures, job.nonce) == (0, 0)


def test_a_gap_of_nonces_is_filled():
    world = World()
    world.seal(world.records.run(4))
    pump(world.submitter, world.chain, world.now)
    # The journal of another time had used nonces up to 3, and lost them: nothing holds 1 and 2.
    with world.journal.transaction() as db:
        db.execute("UPDATE account SET next_nonce = 3")
    world.seal(world.records.run(4))
    world.finish()
    world.check()
    assert [job.nonce for job in world.jobs(Kind.FILLER)] == [1, 2]
    assert world.model.nonce(ACCOUNT.address) == 4


def test_a_batch_whose_index_is_taken_gets_the_next_free_one():
    world = World()
    foreign = [(ROBOT, 0), (ROBOT, 1)]
    for key in foreign:
        world.model.state.roots[key] = b"r" * 32
    world.seal(world.records.run(4))
    world.finish()
    world.check()
    assert [job.batch_index for job in world.jobs()] == [2]


def test_a_transaction_that_reverts_is_done_again_under_another_nonce():
    world = World()
    world.seal(world.records.run(3))
    pump(world.submitter, world.chain, world.now)
    world.model.state.revoked.add(ROBOT)  # between sending and mining
    world.model.mine()
    world.model.state.revoked.clear()
    world.finish()
    world.check()
    (job,) = world.jobs()
    assert (job.failures, job.nonce, job.batch_index) == (1, 1, 0)


# ---------------------------------------------------------------------- money


def test_a_low_account_is_topped_up_once_and_to_the_amount():
    world = World(wei=0)
    world.seal(world.records.run(9))
    world.finish()
    world.check()
    (top_up,) = world.jobs(Kind.TOP_UP)
    assert (top_up.state, top_up.value, top_up.target) == (State.CONFIRMED, ETH, ACCOUNT.address)
    assert 0 < world.model.balance(ACCOUNT.address) < ETH


def test_a_top_up_stays_within_the_contracts_limit():
    world = World(settings=Settings(top_up=9 * ETH, low_water=ETH), wei=ETH // 2)
    world.seal(world.records.run(1))
    world.finish()
    world.check()
    (top_up,) = world.jobs(Kind.TOP_UP)
    assert top_up.value == 5 * ETH - ETH // 2
    assert top_up.state is State.CONFIRMED


def test_an_empty_treasury_pauses_and_drops_nothing():
    world = World(wei=0, treasury=ETH // 1000)
    world.seal(world.records.run(9))
    for _ in range(100):
        world.step()
    assert world.submitter.status().treasury_empty
    assert world.submitter.backlog() == 3
    assert not world.journal.dead_letters()
    world.model.state.balances[OPERATOR.address] = 50 * ETH
    world.finish()
    world.check()
    assert not world.submitter.status().treasury_empty


def test_without_an_operator_it_waits_for_somebody_to_pay():
    world = World(wei=0)
    world.submitter = Submitter(
        world.journal,
        contract=CONTRACT,
        chain_id=CHAIN_ID,
        account_of=world.accounts.get,
        operator=None,
        holder="first",
        settings=SMALL,
    )
    world.seal(world.records.run(2))
    for _ in range(20):
        world.step()
    assert not world.jobs(Kind.TOP_UP)
    world.model.state.balances[ACCOUNT.address] = ETH
    world.finish()
    world.check()


# ---------------------------------------------------------------------- permission


@pytest.mark.parametrize("reason", ["revoked", "unregistered", "replaced", "no account"])
def test_a_robot_that_may_not_write_waits_and_holds_up_nobody(reason: str):
    world = World()
    if reason == "revoked":
        world.model.state.revoked.add(ROBOT)
    elif reason == "unregistered":
        del world.model.state.accounts[ROBOT]
    elif reason == "replaced":
        world.model.state.accounts[ROBOT] = KEYRING.robot(7).address
    else:
        del world.accounts[ROBOT]
    world.seal(world.records.run(9) + world.records.run(9, robot=OTHER_ROBOT))
    for _ in range(40):
        world.step()
    assert {record.id.robot for record in world.model.written} == {OTHER_ROBOT}
    assert len(world.model.written) == 9
    assert list(world.submitter.status().blocked) == [ROBOT]
    assert world.submitter.backlog() == 0  # what waits for a person keeps no other robot's records from being taken
    world.model.state.revoked.clear()
    world.model.state.accounts[ROBOT] = KEYRING.robot(7).address if reason == "replaced" else ACCOUNT.address
    world.accounts[ROBOT] = KEYRING.robot(7) if reason == "replaced" else ACCOUNT
    world.finish()
    world.check()
    assert world.submitter.status().blocked == {}


def test_a_robot_replaced_while_batches_wait_for_a_block_goes_on_with_the_new_account():
    world = World()
    world.seal(world.records.run(8))
    pump(world.submitter, world.chain, world.now)
    world.model.state.accounts[ROBOT] = KEYRING.robot(7).address
    world.accounts[ROBOT] = KEYRING.robot(7)
    world.finish()
    world.check()
    assert world.model.nonce(KEYRING.robot(7).address) == 2


# ---------------------------------------------------------------------- what can never succeed


@pytest.mark.parametrize("bad", [{0}, {3}, {5}, {1, 2}, {0, 4, 7}, set(range(8))])
def test_a_batch_the_node_refuses_is_cut_down_to_its_bad_records(bad: set[int]):
    world = World(settings=Settings(limits=Limits(records=8)))
    records = world.records.run(8)
    wrong = {records[i] for i in bad}
    world.model.bad = lambda record: record in wrong
    world.seal(records)
    world.finish()
    world.check(dead=len(bad))
    assert {letter.record for letter in world.journal.dead_letters()} == wrong
    assert world.model.nonce(ACCOUNT.address) == world.journal.next_nonce(ACCOUNT.address)
    assert not world.jobs(Kind.FILLER)  # no nonce was ever lost on it


@pytest.mark.parametrize("bad", [{0}, {3}, {6}, {0, 7}])
def test_a_batch_accepted_and_never_mined_is_cut_under_the_same_nonce(bad: set[int]):
    quick = Settings(limits=Limits(records=8), bump_after=4.0, stuck_blocks=2, stuck_bumps=1)
    world = World(settings=quick)
    records = world.records.run(8)
    wrong = [records[i].ciphertext for i in bad]
    world.model.never_mines = lambda tx: any(text in tx.data for text in wrong)
    world.seal(records)
    world.seal(world.records.run(3))  # behind it
    world.finish(steps=400)
    world.check(dead=len(bad))
    assert world.jobs(Kind.FILLER)
    # Nonces are without a gap: the bad record's own went to a filler.
    assert world.model.nonce(ACCOUNT.address) == world.journal.next_nonce(ACCOUNT.address)


def test_a_batch_that_is_mined_after_all_counts_once():
    quick = Settings(limits=Limits(records=8), bump_after=4.0, stuck_blocks=2, stuck_bumps=1)
    world = World(settings=quick)
    world.model.never_mines = lambda tx: tx.to == CONTRACT
    world.seal(world.records.run(8))
    originals = []
    while not world.jobs(states=(State.SPLIT,)):
        world.step()
        originals += world.model.pool.values()
    last = originals[-1]
    world.step()
    world.step()  # the first half is sent in its place, the second must wait for what becomes of it
    assert len(world.model.pool) == 1
    world.model.never_mines = lambda tx: False
    world.model.pool[last.sender, last.nonce] = last  # the network had kept the whole batch
    world.model.mine()
    world.finish()
    world.check()
    whole, *halves = world.jobs()
    assert whole.state is State.CONFIRMED
    assert {half.state for half in halves} == {State.VOID}


def test_what_cannot_be_paid_for_is_not_taken_for_what_can_never_be_mined():
    quick = Settings(limits=Limits(records=8), bump_after=4.0, stuck_blocks=2, stuck_bumps=1)
    world = World(settings=quick, treasury=0)
    world.seal(world.records.run(8))
    pump(world.submitter, world.chain, world.now)
    world.model.state.balances[ACCOUNT.address] = 1  # spent by another program in the meantime
    for _ in range(40):
        world.step()
    assert [job.count for job in world.jobs()] == [8]
    assert world.submitter.status().treasury_empty
    world.model.state.balances[ACCOUNT.address] = ETH  # somebody pays; the top-up that was planned is not needed
    world.finish()
    world.check()
    assert not world.submitter.status().treasury_empty


# ---------------------------------------------------------------------- one submitter at a time


def test_only_one_of_two_submitters_acts_and_the_other_takes_over(tmp_path: Path):
    world = World(path=tmp_path / "journal")
    world.seal(world.records.run(2))
    pump(world.submitter, world.chain, world.now)
    world.holder = "second"
    world.start()
    world.seal(world.records.run(2))
    pump(world.submitter, world.chain, world.now)
    assert len(world.model.pool) == 1
    assert set(world.submitter.status().not_ours) == {ACCOUNT.address, OPERATOR.address}
    world.now += world.settings.lease + 1
    world.model.mine()
    world.finish()  # the second goes on with what the first had sent
    world.check()


def test_a_submitter_that_slept_through_its_lease_is_stopped_by_the_journal(tmp_path: Path):
    world = World(path=tmp_path / "journal")
    world.seal(world.records.run(2))
    pump(world.submitter, world.chain, world.now)
    world.seal(world.records.run(2))
    sleeper, bedtime = world.submitter, world.now
    world.holder = "second"
    world.start()
    world.now += world.settings.lease + 1
    pump(world.submitter, world.chain, world.now)
    with pytest.raises(LeaseLost, match="another submitter"):
        for _ in range(3):
            bedtime += 1.0  # by its own clock the lease still runs
            pump(sleeper, world.chain, bedtime)
    world.finish()
    world.check()


def test_a_submitter_that_gets_its_accounts_back_knows_what_happened_meanwhile(tmp_path: Path):
    world = World(path=tmp_path / "journal")
    world.seal(world.records.run(6))
    pump(world.submitter, world.chain, world.now)
    first = world.submitter
    world.holder = "second"
    world.start()
    world.now += world.settings.lease + 1
    world.seal(world.records.run(6))
    world.finish()
    world.submitter.close()
    world.submitter = first
    world.now += 1
    world.seal(world.records.run(1))
    world.finish()
    world.check()


def test_a_submitter_that_ends_gives_its_accounts_back(tmp_path: Path):
    world = World(path=tmp_path / "journal")
    world.seal(world.records.run(2))
    pump(world.submitter, world.chain, world.now)
    world.submitter.close()
    world.holder = "second"
    world.start()
    pump(world.submitter, world.chain, world.now)
    assert world.submitter.status().not_ours == ()
    world.finish()
    world.check()


def test_a_full_disk_ends_the_pump_and_loses_nothing(tmp_path: Path):
    world = World(path=tmp_path / "journal")
    world.seal(world.records.run(4))
    ((pages,),) = world.journal._db.execute("PRAGMA page_count").fetchall()
    world.journal._db.execute(f"PRAGMA max_page_count = {pages}")
    more = world.records.run(8, size=9000)
    with pytest.raises(StoreError, match="disk is full"):
        world.submitter.seal(more, world.now)
    world.journal._db.execute("PRAGMA max_page_count = 1000000")
    world.seal(more)
    world.finish()
    world.check()


# ---------------------------------------------------------------------- all of it at once


@settings(max_examples=40)
@given(seed=st.integers(0, 2**32))
def test_whatever_the_network_does_every_record_arrives_once(seed: int):
    chance = random.Random(seed)
    quick = Settings(
        limits=Limits(records=3),
        bump_after=6.0,
        probe_after=3.0,
        max_in_flight=4,
        low_water=ETH // 50,
        top_up=ETH // 20,
    )
    world = World(settings=quick, wei=ETH // 50)

    def trouble(method: str) -> None:
        if chance.random() < 0.05:
            raise chance.choice([failures.Unreachable("x"), failures.Garbled("x"), failures.RateLimited("x", 1.0)])

    world.chain.before = world.chain.after = trouble
    for _ in range(40):
        if chance.random() < 0.3:
            robot = chance.choice([ROBOT, OTHER_ROBOT])
            world.seal(world.records.run(chance.randint(1, 7), robot=robot, size=20))
        pump(world.submitter, world.chain, world.now)
        match chance.randint(0, 9):
            case 0 if world.model.pool:
                world.model.drop(chance.choice(list(world.model.pool.values())).hash)
            case 1 if len(world.model.blocks) > 3:
                world.model.reorg(chance.randint(1, 2), forget=chance.random() < 0.5)
            case 2:
                world.model.base_fee = int(world.model.base_fee * chance.uniform(0.8, 1.5))
        if chance.random() < 0.7:
            world.model.mine()
        world.now += chance.uniform(0.1, 4.0)
    world.chain.before = world.chain.after = lambda method: None
    world.finish(steps=300)
    world.check()


def test_a_signed_transaction_is_on_disk_before_a_node_sees_it(tmp_path: Path):
    world = World(path=tmp_path / "journal")
    seen = []

    def look(method: str) -> None:
        if method == "send":
            with_nonce = Journal(tmp_path / "journal", BINDING)
            seen.append([parse(a.raw).nonce for a in with_nonce.attempts(ACCOUNT.address, len(seen))])
            with_nonce.close()

    world.chain.before = look
    world.seal(world.records.run(3))
    pump(world.submitter, world.chain, world.now)
    assert seen == [[0]]
