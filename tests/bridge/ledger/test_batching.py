"""Batches: every limit holds, no record is lost or moved, and the gas bound is above what the EVM takes."""

from __future__ import annotations

from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bridge.ledger.world import ACCOUNT, OTHER_ROBOT, ROBOT, Ledger, Records
from rosbridge_eth.ledger import batching, packing
from rosbridge_eth.ledger.batching import Batcher, Limits, calldata_size, gas_bound, halves, plan, refusal
from rosbridge_eth.ledger.chain import Call
from rosbridge_eth.ledger.contract import calldata
from rosbridge_eth.records import RecordId, SealedRecord

SIZES = st.lists(st.tuples(st.integers(1, 3000), st.booleans()), max_size=60)


def make(sizes, robot=ROBOT):
    seq, records = 0, []
    for size, gap in sizes:
        seq += 1 + gap
        records.append(SealedRecord(RecordId(robot, bytes(16), seq), bytes(size)))
    return records


@given(SIZES)
def test_batches_keep_every_limit_and_the_order(sizes):
    records = make(sizes)
    limits = Limits(records=7, calldata=9_000, gas=500_000)
    batches = plan(records, limits)
    assert [record for batch in batches for record in batch] == records
    for batch in batches:
        assert 1 <= len(batch) <= limits.records
        assert len(calldata("setBatch", ROBOT, 0, packing.pack(batch))) <= limits.calldata
        assert gas_bound(batch) <= limits.gas
    for batch, after in pairwise(batches):
        more = [*batch, after[0]]  # no batch was closed before it had to be
        assert len(more) > limits.records or calldata_size(more) > limits.calldata or gas_bound(more) > limits.gas


@pytest.mark.parametrize(("count", "size"), [(1, 1), (1, 32_768), (2, 32_768), (100, 1), (100, 256), (23, 4096)])
def test_the_bounds_are_above_what_the_chain_takes_and_not_far(made: Ledger, records: Records, count: int, size: int):
    batch = records.run(count, size=size)
    data = calldata("setBatch", ROBOT, 0, packing.pack(batch))
    assert calldata_size(batch) - 31 <= len(data) <= calldata_size(batch)
    gas = made.chain.estimate_gas(Call(made.contract.address, data, ACCOUNT.address))
    assert gas <= gas_bound(batch) <= 3 * gas


def test_the_bound_holds_for_records_that_are_all_runs_of_their_own(made: Ledger, records: Records):
    batch = [record for _ in range(100) for record in records.run(1, size=10)]
    data = calldata("setBatch", ROBOT, 0, packing.pack(batch))
    assert made.chain.estimate_gas(Call(made.contract.address, data, ACCOUNT.address)) <= gas_bound(batch)


def test_a_record_that_fits_no_batch_is_refused_with_the_reason(records: Records):
    def one(size):
        return SealedRecord(RecordId(ROBOT, bytes(16), 0), bytes(size))

    assert refusal(one(32 * 1024), Limits()) is None
    assert "1 to 65535" in str(refusal(one(0), Limits()))
    assert "1 to 65535" in str(refusal(one(2**16), Limits()))
    assert "calldata" in str(refusal(one(2000), Limits(calldata=2000)))
    assert "gas" in str(refusal(one(2000), Limits(gas=100_000)))


def test_halves_are_all_of_it(records: Records):
    batch = records.run(5)
    left, right = halves(batch)
    assert [*left, *right] == batch
    assert left
    assert right
    with pytest.raises(ValueError, match="cannot be halved"):
        halves(batch[:1])


# ---------------------------------------------------------------------- with a clock


def test_a_batch_is_due_when_it_is_full_or_old(records: Records):
    batcher = Batcher(Limits(records=3, age=2.0))
    assert batcher.next_timer() is None
    first, second, third, fourth = records.run(4)
    batcher.add(first, 10.0)
    batcher.add(second, 11.0)
    assert batcher.due(11.9) == []
    assert batcher.next_timer() == 12.0
    batcher.add(third, 11.9)
    assert batcher.due(11.9) == [[first, second, third]]
    batcher.add(fourth, 11.95)
    assert batcher.next_timer() == 13.95
    assert len(batcher) == 1
    assert batcher.due(13.95) == [[fourth]]
    assert len(batcher) == 0


def test_robots_do_not_share_batches(records: Records):
    batcher = Batcher(Limits(records=2, age=1.0))
    mine, others = records.run(2), records.run(1, robot=OTHER_ROBOT)
    batcher.add(mine[0], 0.0)
    batcher.add(others[0], 0.5)
    batcher.add(mine[1], 0.6)
    assert batcher.due(0.6) == [mine]
    assert batcher.due(0.6, flush=True) == [others]


def test_a_full_batch_waits_for_nobody_and_nothing_is_reordered(records: Records):
    batcher = Batcher(Limits(calldata=1500))
    given_ = records.run(9, size=600)
    for record in given_:
        batcher.add(record, 0.0)
    due = batcher.due(0.0) + batcher.due(0.0, flush=True)
    assert [record for batch in due for record in batch] == given_
    assert all(calldata_size(batch) <= 1500 for batch in due)


def test_the_batcher_refuses_what_fits_no_batch(records: Records):
    with pytest.raises(ValueError, match="calldata"):
        Batcher(Limits(calldata=300)).add(records.run(1)[0], 0.0)


def test_the_default_limits_are_the_designs():
    limits = Limits()
    assert (limits.records, limits.calldata, limits.gas, limits.age) == (100, 96 * 1024, 8_000_000, 2.0)
    assert batching.gas_bound(Records().run(100)) <= limits.gas
