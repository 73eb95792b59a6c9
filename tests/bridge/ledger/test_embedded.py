"""The chain in process: its pool behaves as geth's, and the whole way runs on a genuine EVM."""

from __future__ import annotations

import subprocess
import sys
import threading
from collections import Counter
from pathlib import Path

import pytest

from bridge.ledger.world import (
    ACCOUNT,
    ETH,
    OPERATOR,
    OTHER_ACCOUNT,
    OTHER_ROBOT,
    ROBOT,
    Ledger,
    Records,
    new_ledger,
)
from rosbridge_eth.ledger import failures, packing
from rosbridge_eth.ledger.batching import Limits
from rosbridge_eth.ledger.chain import Call
from rosbridge_eth.ledger.contract import calldata
from rosbridge_eth.ledger.history import fetch
from rosbridge_eth.ledger.journal import Binding, Journal
from rosbridge_eth.ledger.pump import pump, run
from rosbridge_eth.ledger.recovery import adopt_history, missing_batches
from rosbridge_eth.ledger.states import SETTLED, Kind
from rosbridge_eth.ledger.submitter import Settings, Submitter
from rosbridge_eth.ledger.transactions import Fees, Transaction, sign

GWEI = 10**9


def transfer(made: Ledger, nonce: int, *, max_fee: int = 10 * GWEI, tip: int = GWEI, gas: int = 21_000, value: int = 1):
    to = OTHER_ACCOUNT.address
    unsigned = Transaction(made.chain.chain_id(), nonce, to, b"", gas, Fees(max_fee, tip), value)
    return sign(unsigned, ACCOUNT)


@pytest.fixture
def still() -> Ledger:
    """Mines only when told to."""
    return new_ledger(auto_mine=False)


def test_nonces_wait_for_those_before_them(still: Ledger):
    second, first = transfer(still, 1), transfer(still, 0)
    assert still.chain.send([second.raw]) == [second.hash]
    still.chain.mine()
    assert still.chain.receipts([second.hash]) == [None]
    assert still.chain.knows(second.hash)
    still.chain.send([first.raw])
    still.chain.mine()
    assert all(receipt is not None and receipt.succeeded for receipt in still.chain.receipts([first.hash, second.hash]))
    assert still.chain.nonce(ACCOUNT.address) == 2
    assert still.chain.nonce(ACCOUNT.address, still.chain.head().number - 1) == 0


def test_what_the_pool_has_or_mined_is_known_already(still: Ledger):
    one = transfer(still, 0)
    still.chain.send([one.raw])
    for _ in range(2):
        (again,) = still.chain.send([one.raw])
        assert isinstance(again, failures.AlreadyKnown)
        still.chain.mine()
    (other,) = still.chain.send([transfer(still, 0, value=2).raw])
    assert isinstance(other, failures.NonceTooLow)


def test_a_replacement_needs_ten_percent_more_of_both_fees(still: Ledger):
    still.chain.send([transfer(still, 0).raw])
    for max_fee, tip in ((11 * GWEI, GWEI), (10 * GWEI, 2 * GWEI), (109 * GWEI // 10, 109 * GWEI // 100)):
        (answer,) = still.chain.send([transfer(still, 0, max_fee=max_fee, tip=tip).raw])
        assert isinstance(answer, failures.Underpriced)
    better = transfer(still, 0, max_fee=11 * GWEI, tip=11 * GWEI // 10)
    assert still.chain.send([better.raw]) == [better.hash]
    still.chain.mine()
    assert still.chain.receipts([better.hash])[0] is not None


def test_a_fee_below_the_base_fee_waits(still: Ledger):
    cheap = transfer(still, 0, max_fee=1000, tip=1)
    assert still.chain.send([cheap.raw]) == [cheap.hash]
    still.chain.mine()
    assert still.chain.receipts([cheap.hash]) == [None]


@pytest.mark.parametrize(
    ("changes", "kind"),
    [
        ({"value": 2 * ETH}, failures.InsufficientFunds),
        ({"gas": 20_999}, failures.GasRefused),
        ({"gas": 30_000_001}, failures.GasRefused),
    ],
)
def test_what_can_never_be_mined_is_refused(still: Ledger, changes: dict, kind: type[failures.NodeFailure]):
    (answer,) = still.chain.send([transfer(still, 0, **changes).raw])
    assert isinstance(answer, kind)


def test_garbage_another_chains_and_oversized_transactions_are_refused(still: Ledger):
    raw = transfer(still, 0).raw
    unsigned = Transaction(5, 0, ACCOUNT.address, b"", 21_000, Fees(GWEI, GWEI))
    for bad in (b"", b"\x02", b"\x05" + raw[1:], raw[:-1], raw[:-40] + bytes(40), sign(unsigned, ACCOUNT).raw):
        (answer,) = still.chain.send([bad])
        assert isinstance(answer, failures.Refused), bad
    (answer,) = still.chain.send([bytes(200_000)])
    assert isinstance(answer, failures.TooLarge)


def test_an_estimate_is_enough_and_not_a_gas_more(made: Ledger, records: Records):
    for index, (count, size) in enumerate([(1, 1), (3, 300), (50, 20), (100, 256)]):
        data = calldata("setBatch", ROBOT, index, packing.pack(records.run(count, size=size)))
        gas = made.chain.estimate_gas(Call(made.contract.address, data, ACCOUNT.address))
        fees = Fees.suggested(made.chain.head(), GWEI)
        for nonce, given, enough in ((2 * index, gas - 1, False), (2 * index + 1, gas, True)):
            unsigned = Transaction(made.chain.chain_id(), nonce, made.contract.address, data, given, fees)
            signed = sign(unsigned, ACCOUNT)
            (answer,) = made.chain.send([signed.raw])
            if isinstance(answer, failures.GasRefused):  # below the floor price of calldata it is not even taken
                assert not enough
                filler = sign(Transaction(made.chain.chain_id(), nonce, ACCOUNT.address, b"", 21_000, fees), ACCOUNT)
                made.chain.send([filler.raw])
                continue
            (receipt,) = made.chain.receipts([signed.hash])
            assert receipt is not None
            assert receipt.succeeded is enough


def test_a_reorganisation_takes_blocks_back_and_their_transactions_wait_again(still: Ledger):
    one = transfer(still, 0)
    still.chain.send([one.raw])
    still.chain.mine(2)
    before = still.chain.head()
    still.chain.reorg(2)
    assert still.chain.head().number == before.number + 1
    assert still.chain.block(before.number).hash != before.hash
    assert still.chain.receipts([one.hash]) == [None]
    assert still.chain.balance(OTHER_ACCOUNT.address) == 0
    still.chain.mine()
    assert still.chain.balance(OTHER_ACCOUNT.address) == 1
    still.chain.reorg(1, forget=True)
    still.chain.mine()
    assert not still.chain.knows(one.hash)


# ---------------------------------------------------------------------- the whole way, on a genuine EVM


def submitter_for(made: Ledger, path: Path | str = ":memory:", **settings) -> tuple[Submitter, Journal]:
    journal = Journal(path, Binding.of(made.contract))
    options = {"limits": Limits(records=5), "poll": 0.5, "bump_after": 3.0, "stuck_blocks": 2, "stuck_bumps": 1}
    return (
        Submitter(
            journal,
            contract=made.contract.address,
            chain_id=made.chain.chain_id(),
            account_of={ROBOT: ACCOUNT, OTHER_ROBOT: OTHER_ACCOUNT}.get,
            operator=OPERATOR,
            holder="here",
            settings=Settings(**(options | settings)),
        ),
        journal,
    )


def drive(made: Ledger, submitter: Submitter, *, steps: int = 80) -> None:
    for _ in range(steps):
        pump(submitter, made.chain, made.clock.now)
        made.chain.mine()
        made.clock.now += 1.0
        if submitter.idle():
            return
    raise AssertionError("not idle")


def test_records_of_two_robots_arrive_once_through_reorganisations_and_drops(still: Ledger, records: Records):
    still.chain.auto_mine = True
    still.register(OTHER_ROBOT, OTHER_ACCOUNT, wei=ETH // 100)
    still.chain.auto_mine = False
    submitter, journal = submitter_for(still)
    given = {robot: records.run(23, robot=robot) for robot in (ROBOT, OTHER_ROBOT)}
    for batch in given.values():
        submitter.seal(batch, still.clock.now)
    pump(submitter, still.chain, still.clock.now)
    (attempt,) = journal.attempts(ACCOUNT.address, 1)
    still.chain.drop(attempt.hash)
    still.chain.mine()
    still.clock.now += 1
    pump(submitter, still.chain, still.clock.now)
    still.chain.reorg(1)
    drive(still, submitter)
    still.chain.reorg(2, forget=True)  # within what counts as confirmed
    still.clock.now += 20
    given[ROBOT] += (more := records.run(1))
    submitter.seal(more, still.clock.now)
    drive(still, submitter)
    for robot, batch in given.items():
        found = fetch(still.chain, still.contract, robot)
        assert found.problems == ()
        assert Counter(item.record for item in found.records) == Counter(batch)
    (top_up,) = [job for job in journal.jobs(SETTLED) if job.kind is Kind.TOP_UP]
    assert top_up.target == OTHER_ACCOUNT.address


def test_a_journal_lost_is_made_anew_and_nothing_is_written_twice(made: Ledger, records: Records, tmp_path: Path):
    submitter, journal = submitter_for(made, tmp_path / "first")
    old = records.run(12)
    submitter.seal(old, made.clock.now)
    drive(made, submitter)
    journal.close()

    submitter, journal = submitter_for(made, tmp_path / "second")
    assert missing_batches(journal, made.contract, [ROBOT, OTHER_ROBOT]) == {ROBOT: 3}
    assert adopt_history(journal, made.contract, [ROBOT], made.clock.now) == 3
    assert adopt_history(journal, made.contract, [ROBOT], made.clock.now) == 0
    assert missing_batches(journal, made.contract, [ROBOT]) == {}
    sealing = submitter.seal(old + records.run(4), made.clock.now)
    assert set(sealing.known) == {record.id for record in old}
    assert [job.batch_index for job in sealing.jobs] == [3]
    drive(made, submitter)
    found = fetch(made.chain, made.contract, ROBOT)
    assert len(found.records) == len({item.record.id for item in found.records}) == 16
    location = journal.find(old[7].id)
    assert made.chain.receipts([location.tx_hash])[0].block_number == location.block_number


def test_a_revoked_robots_batches_wait_until_it_is_registered_again(made: Ledger, records: Records):
    submitter, journal = submitter_for(made)
    made.contract.transact(OPERATOR, "revokeRobot", ROBOT)
    given = records.run(7)
    submitter.seal(given, made.clock.now)
    for _ in range(10):
        pump(submitter, made.chain, made.clock.now)
        made.chain.mine()
        made.clock.now += 1.0
    assert "AlreadyRevoked" in submitter.status().blocked[ROBOT]
    made.contract.transact(OPERATOR, "replaceRegistration", ROBOT, ACCOUNT.address, b"renewed")
    made.clock.now += 100
    drive(made, submitter)
    assert [item.record for item in fetch(made.chain, made.contract, ROBOT).records] == given
    assert journal.dead_letters() == []


def test_a_chain_that_mines_only_when_it_must_is_enough(made: Ledger, records: Records):
    submitter, _ = submitter_for(made, confirmations=1, poll=0.01, max_in_flight=2)
    given = records.run(60)
    submitter.seal(given, made.clock.now)
    for _ in range(300):  # no block is mined here but those the transactions bring
        pump(submitter, made.chain, made.clock.now)
        made.clock.now += 0.02
    assert submitter.idle()
    assert [item.record for item in fetch(made.chain, made.contract, ROBOT).records] == given


def test_a_thread_pumps_until_it_is_stopped_and_gives_its_leases_back(made: Ledger, records: Records):
    submitter, journal = submitter_for(made, confirmations=1, poll=0.01)
    given = records.run(12)
    submitter.seal(given, made.clock.now)
    stop = threading.Event()

    def clock() -> float:
        made.clock.now += 0.1
        if submitter.idle():
            stop.set()
        return made.clock.now

    thread = threading.Thread(target=run, args=(submitter, made.chain, stop), kwargs={"clock": clock})
    thread.start()
    thread.join(30)
    assert not thread.is_alive()
    assert [item.record for item in fetch(made.chain, made.contract, ROBOT).records] == given
    assert journal.lease(ACCOUNT.address, "another", made.clock.now, 1.0) is not None


def test_the_process_keeps_its_recursion_limit() -> None:
    script = (
        "import json, sys; before = sys.getrecursionlimit();"
        "from rosbridge_eth.ledger.embedded import EmbeddedChain; EmbeddedChain();"
        "assert sys.getrecursionlimit() == before"
    )
    subprocess.run([sys.executable, "-c", script], check=True)
