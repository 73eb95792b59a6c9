"""Reading back: every record with its place, and what a node leaves out or changes is noticed."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
from eth_abi.abi import decode, encode

from bridge.ledger.world import ACCOUNT, OPERATOR, OTHER_ACCOUNT, OTHER_ROBOT, ROBOT, Ledger, Records
from rosbridge_eth.errors import ChainError, VerificationError
from rosbridge_eth.ledger import history, merkle, packing
from rosbridge_eth.ledger.chain import Log
from rosbridge_eth.ledger.contract import Contract, topic
from rosbridge_eth.ledger.failures import RangeTooWide
from rosbridge_eth.ledger.history import ProblemKind, block_at, fetch


class Node:
    """A chain whose answers can be tampered with."""

    def __init__(self, inner) -> None:
        self._inner = inner
        self.tamper: Callable[[list[Log]], list[Log]] = lambda logs: logs
        self.widest: int | None = None
        self.log_calls: list[tuple[int, int]] = []

    def __getattr__(self, name: str):
        return getattr(self._inner, name)

    def logs(self, address, topics, from_block, to_block):
        self.log_calls.append((from_block, to_block))
        if self.widest is not None and to_block - from_block + 1 > self.widest:
            raise RangeTooWide("block range too wide")
        return self.tamper(self._inner.logs(address, topics, from_block, to_block))


@pytest.fixture
def node(made: Ledger) -> Node:
    return Node(made.chain)


def at(node: Node, made: Ledger) -> Contract:
    return Contract(node, made.contract.address)


def write_some(made: Ledger, records: Records, sizes=(3, 1, 5, 2)) -> list:
    given = []
    for index, size in enumerate(sizes):
        batch = records.run(size)
        made.write(batch, index)
        made.chain.mine(2)
        given += batch
    return given


def test_every_record_comes_back_in_order_with_its_place(made: Ledger, records: Records):
    given = write_some(made, records)
    found = fetch(made.chain, made.contract, ROBOT)
    assert [item.record for item in found.records] == given
    assert (found.batches, found.problems) == (4, ())
    for item in found.records:
        block = made.chain.block(item.block_number)
        assert (item.block_hash, item.block_timestamp, item.sender) == (block.hash, block.timestamp, ACCOUNT.address)
        (receipt,) = made.chain.receipts([item.tx_hash])
        assert receipt.block_number == item.block_number
        assert item.log_index in [log.index for log in receipt.logs]
        batch = [i.record for i in found.records if i.batch_index == item.batch_index]
        assert batch[item.leaf] == item.record
        assert len(batch) == item.leaves
        proof = merkle.proof([merkle.leaf_hash(record) for record in batch], item.leaf)
        assert made.contract.check_data(item.record, item.batch_index, item.leaf, item.leaves, proof)


def test_registrations_tell_accounts_certificates_and_when_they_held(made: Ledger):
    made.contract.transact(OPERATOR, "replaceRegistration", ROBOT, OTHER_ACCOUNT.address, b"second")
    made.contract.transact(OPERATOR, "revokeRobot", ROBOT)
    made.chain.mine(3)
    made.contract.transact(OPERATOR, "replaceRegistration", ROBOT, OTHER_ACCOUNT.address, b"third")
    found = fetch(made.chain, made.contract, ROBOT).registrations
    assert [(r.generation, r.account, r.certificates) for r in found] == [
        (1, ACCOUNT.address, b"certificates"),
        (2, OTHER_ACCOUNT.address, b"second"),
        (3, OTHER_ACCOUNT.address, b"third"),
    ]
    assert found[0].revoked_block == found[1].block_number
    assert found[1].revoked_block == found[1].block_number + 1
    assert found[2].revoked_block is None
    assert found[0].block_timestamp == made.chain.block(found[0].block_number).timestamp


def test_robots_are_kept_apart(made: Ledger, records: Records):
    made.register(OTHER_ROBOT, OTHER_ACCOUNT, b"other")
    given = write_some(made, records)
    made.write(records.run(2, robot=OTHER_ROBOT), 0, OTHER_ACCOUNT)
    assert [item.record for item in fetch(made.chain, made.contract, ROBOT).records] == given
    other = fetch(made.chain, made.contract, OTHER_ROBOT)
    assert len(other.records) == 2
    assert [r.certificates for r in other.registrations] == [b"other"]


def test_a_name_never_used_has_an_empty_history(made: Ledger):
    found = fetch(made.chain, made.contract, OTHER_ROBOT)
    assert (found.registrations, found.records, found.problems) == ((), (), ())


def test_any_range_of_blocks_gives_exactly_what_is_in_it(made: Ledger, records: Records):
    write_some(made, records)
    everything = fetch(made.chain, made.contract, ROBOT).records
    last = made.chain.head().number
    for first in range(last + 2):
        for end in range(first, last + 1):
            found = fetch(made.chain, made.contract, ROBOT, first, end)
            assert found.records == tuple(item for item in everything if first <= item.block_number <= end)
            assert found.problems == ()


def test_a_time_becomes_a_block(made: Ledger):
    made.clock.now += 100
    made.chain.mine()
    made.clock.now += 100
    made.chain.mine()
    head = made.chain.head()
    assert block_at(made.chain, 0) == 0
    assert block_at(made.chain, head.timestamp) == head.number
    assert block_at(made.chain, head.timestamp - 50) == head.number
    assert block_at(made.chain, head.timestamp - 100) == head.number - 1
    assert block_at(made.chain, head.timestamp + 1) == head.number + 1


def test_the_links_spare_a_scan(made: Ledger, records: Records, node: Node, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(history, "SPAN", 20)
    made.write(records.run(1), 0)
    made.chain.mine(5 * history.SPAN)
    made.write(records.run(1), 1)
    found = fetch(node, at(node, made), ROBOT)
    assert len(found.records) == 2
    assert len(node.log_calls) <= 3  # two for batches, one for the registration; a scan would take six


def test_a_node_that_wants_narrow_ranges_is_asked_for_them(made: Ledger, records: Records, node: Node):
    given = write_some(made, records)
    node.widest = 2
    found = fetch(node, at(node, made), ROBOT)
    assert [item.record for item in found.records] == given
    assert found.problems == ()


# ---------------------------------------------------------------------- a node that lies


def kinds(found) -> list[ProblemKind]:
    return [problem.kind for problem in found.problems]


@pytest.mark.parametrize("withheld", [{0}, {1}, {3}, {1, 2}, {0, 3}, {0, 1, 2, 3}])
def test_a_withheld_batch_is_missed(made: Ledger, records: Records, node: Node, withheld: set[int]):
    given = write_some(made, records)
    hidden = {index.to_bytes(32, "big") for index in withheld}
    node.tamper = lambda logs: [x for x in logs if not (x.topics[0] == topic("Batch") and x.topics[2] in hidden)]
    found = fetch(node, at(node, made), ROBOT)
    assert set(kinds(found)) == {ProblemKind.MISSING_BATCH}
    assert {item.batch_index for item in found.records} == {0, 1, 2, 3} - withheld
    assert {item.record for item in found.records} <= set(given)
    with pytest.raises(VerificationError, match="missing-batch"):
        found.require_sound()


def test_of_several_batches_in_one_block_none_can_be_withheld(made: Ledger, records: Records, node: Node):
    made.chain.auto_mine = False
    for index in range(3):
        raw = _signed(made, records.run(2), index)
        made.chain.send([raw])
    made.chain.mine()
    assert fetch(node, at(node, made), ROBOT).problems == ()
    for hidden in range(3):
        node.tamper = lambda logs, h=hidden: [
            x for x in logs if x.topics[0] != topic("Batch") or x.topics[2] != h.to_bytes(32, "big")
        ]
        found = fetch(node, at(node, made), ROBOT)
        assert kinds(found) == [ProblemKind.MISSING_BATCH]
        assert len(found.records) == 4


def _signed(made: Ledger, batch, index: int) -> bytes:
    from rosbridge_eth.ledger.contract import calldata
    from rosbridge_eth.ledger.transactions import Fees, Transaction, sign

    head = made.chain.head()
    data = calldata("setBatch", ROBOT, index, packing.pack(batch))
    transaction = Transaction(
        made.chain.chain_id(), index, made.contract.address, data, 300_000, Fees.suggested(head, 10**9)
    )
    return sign(transaction, ACCOUNT).raw


@pytest.mark.parametrize("place", [-1, -40, 200])
def test_an_altered_record_is_noticed(made: Ledger, records: Records, node: Node, place: int):
    write_some(made, records)

    def alter(logs):
        changed = []
        for log in logs:
            if log.topics[0] == topic("Batch") and log.topics[2] == (2).to_bytes(32, "big"):
                data = bytearray(log.data)
                data[place if place > 0 else len(data) + place] ^= 1
                log = replace(log, data=bytes(data))
            changed.append(log)
        return changed

    node.tamper = alter
    found = fetch(node, at(node, made), ROBOT)
    assert set(kinds(found)) & {ProblemKind.ROOT_MISMATCH, ProblemKind.MALFORMED_EVENT}
    assert {item.batch_index for item in found.records} == {0, 1, 3}


def test_an_event_that_is_forged_to_be_consistent_is_not_what_the_contract_has(
    made: Ledger, records: Records, node: Node
):
    write_some(made, records)
    forged = records.run(5)
    root = merkle.root([merkle.leaf_hash(record) for record in forged])

    def forge(logs):
        changed = []
        for log in logs:
            if log.topics[0] == topic("Batch") and log.topics[2] == (2).to_bytes(32, "big"):
                types = ["bytes32", "uint64", "uint64", "bytes"]
                _, number, previous, _ = decode(types, log.data)
                log = replace(log, data=encode(types, [root, number, previous, packing.pack(forged)]))
            changed.append(log)
        return changed

    node.tamper = forge
    found = fetch(node, at(node, made), ROBOT)
    assert kinds(found) == [ProblemKind.ROOT_MISMATCH]
    assert {item.batch_index for item in found.records} == {0, 1, 3}


def test_an_event_in_a_block_that_is_not_the_chains_is_refused(made: Ledger, records: Records, node: Node):
    write_some(made, records)
    node.tamper = lambda logs: [replace(log, block_hash=bytes(32)) for log in logs]
    found = fetch(node, at(node, made), ROBOT)
    assert ProblemKind.WRONG_BLOCK in kinds(found)
    assert found.records == ()


def test_withheld_or_altered_registrations_are_noticed(made: Ledger, node: Node):
    made.contract.transact(OPERATOR, "replaceRegistration", ROBOT, OTHER_ACCOUNT.address, b"second")
    node.tamper = lambda logs: []
    assert kinds(fetch(node, at(node, made), ROBOT)) == [ProblemKind.MISSING_REGISTRATION]
    node.tamper = lambda logs: [replace(x, data=x.data.replace(b"second", b"forged")) for x in logs]
    assert kinds(fetch(node, at(node, made), ROBOT)) == [ProblemKind.WRONG_CERTIFICATES]


def test_a_chain_that_does_not_hold_still_is_given_up(made: Ledger, records: Records, node: Node):
    write_some(made, records)

    def reorganise(logs):
        made.chain.reorg(1)
        return logs

    node.tamper = reorganise
    with pytest.raises(ChainError, match="changed its mind"):
        fetch(node, at(node, made), ROBOT)


def test_a_reorganisation_while_reading_is_read_again(made: Ledger, records: Records, node: Node):
    given = write_some(made, records)
    once = [True]

    def reorganise(logs):
        if once and once.pop():
            made.chain.reorg(1)
            made.chain.mine(2)
        return logs

    node.tamper = reorganise
    assert [item.record for item in fetch(node, at(node, made), ROBOT).records] == given
