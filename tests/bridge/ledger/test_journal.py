"""The journal: bound to one ledger, fenced, and clear about what is wrong with it."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from bridge.ledger.world import ACCOUNT, OTHER_ACCOUNT, ROBOT, Ledger, Records
from rosbridge_eth.errors import StoreError
from rosbridge_eth.ledger.journal import Binding, Journal, LeaseLost
from rosbridge_eth.ledger.states import Event, State, WrongTransition
from rosbridge_eth.ledger.transactions import Fees, SignedTransaction

BINDING = Binding(1, b"g" * 32, ACCOUNT.address, b"c" * 32)
FEES = Fees(3 * 10**9, 10**9)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "journal.sqlite"


def sign(journal: Journal, job, lease, nonce: int = 0, event: Event = Event.SIGNED):
    transaction = SignedTransaction(b"h%d" % nonce, b"raw")
    return journal.signed(job, event, lease, nonce=nonce, gas=50_000, fees=FEES, transaction=transaction, now=2.0)


@pytest.mark.parametrize(
    ("change", "words"),
    [
        ({"chain_id": 2}, "chain 2 instead of 1"),
        ({"genesis": b"x" * 32}, "another chain with the id 1"),
        ({"contract": OTHER_ACCOUNT.address}, "the contract"),
        ({"code_hash": b"x" * 32}, "another version"),
    ],
)
def test_a_journal_of_another_ledger_refuses_to_open_and_says_the_way_out(path: Path, change: dict, words: str):
    Journal(path, BINDING).close()
    with pytest.raises(StoreError, match=words) as refusal:
        Journal(path, replace(BINDING, **change))
    assert "correct the node's URL" in str(refusal.value)
    assert "store of its own" in str(refusal.value)
    Journal(path, BINDING).close()


def test_a_binding_is_taken_from_the_chain(made: Ledger):
    binding = Binding.of(made.contract)
    assert binding.chain_id == made.chain.chain_id()
    assert binding.genesis == made.chain.block(0).hash
    assert binding.contract == made.contract.address


def test_a_corrupt_journal_says_the_way_out(path: Path):
    path.write_bytes(b"SQLite format 3\0" + bytes(range(256)) * 20)
    with pytest.raises(StoreError, match="rebuilt from the chain"):
        Journal(path, BINDING)


def test_a_journal_damaged_while_open_says_the_way_out(path: Path, records: Records):
    journal = Journal(path, BINDING)
    for _ in range(50):
        journal.seal([records.run(5)], 1.0)
    journal._db.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    journal.close()
    content = bytearray(path.read_bytes())
    content[4096:-4096] = bytes(len(content) - 8192)
    path.write_bytes(content)
    with pytest.raises(StoreError, match="move it away"):
        reopened = Journal(path, BINDING)
        reopened.seal([records.run(1)], 2.0)
        for job in reopened.jobs():
            reopened.records(job)


def test_a_folder_that_is_not_there_is_a_store_error(tmp_path: Path):
    with pytest.raises(StoreError, match="cannot be used"):
        Journal(tmp_path / "none" / "journal", BINDING)


def test_a_newer_layout_is_not_touched(path: Path):
    journal = Journal(path, BINDING)
    with journal.transaction() as db:
        db.execute("UPDATE binding SET schema = 99")
    journal.close()
    with pytest.raises(StoreError, match="layout 99"):
        Journal(path, BINDING)


def test_a_record_is_in_one_batch_only(path: Path, records: Records):
    journal = Journal(path, BINDING)
    batch = records.run(3)
    journal.seal([batch], 1.0)
    with pytest.raises(StoreError):
        journal.seal([records.run(2), [batch[1]]], 2.0)
    assert len(journal.jobs()) == 1  # of the failed call nothing stayed
    assert journal.known([record.id for record in batch]) == {record.id for record in batch}


def test_batches_survive_as_they_were_given(path: Path, records: Records):
    journal = Journal(path, BINDING)
    first, second = records.run(3), records.run(2)
    journal.seal([first, second], 1.0)
    journal.close()
    again = Journal(path, BINDING)
    assert [again.records(job) for job in again.jobs()] == [first, second]
    assert [job.batch_index for job in again.jobs()] == [0, 1]
    location = again.find(second[1].id)
    assert (location.state, location.batch_index, location.leaf, location.leaves) == (State.SEALED, 1, 1, 2)
    assert again.find(records.run(1)[0].id) is None


def test_a_lease_is_one_holders_until_it_runs_out(path: Path):
    journal, other = Journal(path, BINDING), Journal(path, BINDING)
    mine = journal.lease("account", "me", 10.0, 5.0)
    assert mine is not None
    assert other.lease("account", "you", 14.9, 5.0) is None
    renewed = journal.lease("account", "me", 14.0, 5.0)
    assert renewed is not None
    assert renewed.token == mine.token
    taken = other.lease("account", "you", 19.1, 5.0)
    assert taken is not None
    assert taken.token > mine.token
    other.release(taken)
    assert journal.lease("account", "me", 19.2, 5.0) is not None


def test_a_holder_that_was_replaced_changes_nothing(path: Path, records: Records):
    journal = Journal(path, BINDING)
    (job,) = journal.seal([records.run(2)], 1.0)
    old = journal.lease(ACCOUNT.address, "me", 1.0, 5.0)
    new = journal.lease(ACCOUNT.address, "you", 7.0, 5.0)
    assert old is not None
    assert new is not None
    with pytest.raises(LeaseLost):
        sign(journal, job, old)
    assert journal.job(job.id).state is State.SEALED
    assert journal.attempts(ACCOUNT.address, 0) == []
    assert journal.next_nonce(ACCOUNT.address) == 0
    assert sign(journal, job, new).state is State.READY


def test_the_table_is_asked_about_the_journals_own_state(path: Path, records: Records):
    journal = Journal(path, BINDING)
    (job,) = journal.seal([records.run(2)], 1.0)
    lease = journal.lease(ACCOUNT.address, "me", 1.0, 5.0)
    ready = sign(journal, job, lease)
    with pytest.raises(WrongTransition):
        sign(journal, job, lease, nonce=1)  # with a stale copy
    assert journal.next_nonce(ACCOUNT.address) == 1
    assert journal.accepted(ready, lease, 3.0).state is State.PENDING


def test_every_signed_transaction_is_kept_for_its_nonce(path: Path, records: Records):
    journal = Journal(path, BINDING)
    (job,) = journal.seal([records.run(2)], 1.0)
    lease = journal.lease(ACCOUNT.address, "me", 1.0, 5.0)
    ready = sign(journal, job, lease, nonce=7)
    journal.signed(
        ready,
        Event.BUMPED,
        lease,
        nonce=7,
        gas=1,
        fees=FEES,
        transaction=SignedTransaction(b"second", b"raw2"),
        now=3.0,
    )
    assert [attempt.hash for attempt in journal.attempts(ACCOUNT.address, 7)] == [b"second", b"h7"]
    assert journal.latest_attempt(journal.job(job.id)).raw == b"raw2"
    assert journal.next_nonce(ACCOUNT.address) == 8
    assert journal.job(job.id).bumps == 1


def test_pruning_drops_bytes_and_keeps_identities(path: Path, records: Records):
    journal = Journal(path, BINDING)
    batch = records.run(3)
    assert journal.adopt(0, batch, ACCOUNT.address, (b"tx", 5, b"block"), 10.0)
    assert not journal.adopt(0, batch, ACCOUNT.address, (b"tx", 5, b"block"), 10.0)
    journal.prune(11.0)
    location = journal.find(batch[2].id)
    assert (location.state, location.tx_hash, location.block_number) == (State.ACKNOWLEDGED, b"tx", 5)
    assert journal.seal([records.run(1)], 12.0)[0].batch_index == 1
    assert journal.included(ROBOT) == 1
