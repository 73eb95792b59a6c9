"""RobotLedger on the EVM: what every call does, who may call it, and each reason to refuse."""

from __future__ import annotations

import pytest

from bridge.ledger.world import ACCOUNT, ETH, OPERATOR, OTHER_ACCOUNT, OTHER_ROBOT, ROBOT, Ledger, Records
from rosbridge_eth.errors import ChainError
from rosbridge_eth.ledger import merkle, packing
from rosbridge_eth.ledger.chain import Call
from rosbridge_eth.ledger.contract import (
    BatchRecorded,
    Contract,
    ETHAllocated,
    OperatorChanged,
    OperatorOffered,
    Registered,
    Revoked,
    calldata,
    decode_event,
    explain,
)
from rosbridge_eth.ledger.failures import Reverted

NOBODY = "0x" + "00" * 20
ZERO_HASH = bytes(32)


def refused(name: str, *arguments: object):
    """Expect the contract's own error with these arguments."""

    class _Refused:
        def __enter__(self):
            self.raises = pytest.raises(Reverted)
            self.info = self.raises.__enter__()
            return self.info

        def __exit__(self, *error):
            done = self.raises.__exit__(*error)
            assert self.info.value.name == name
            got = tuple(v.lower() if isinstance(v, str) else v for v in self.info.value.arguments)
            expected = tuple(v.lower() if isinstance(v, str) else v for v in arguments)
            assert not arguments or got == expected
            return done

    return _Refused()


def events(receipt):
    return [decode_event(log) for log in receipt.logs]


# ---------------------------------------------------------------------- the operator


def test_whoever_deploys_is_the_operator(bare: Ledger):
    assert bare.contract.operator() == OPERATOR.address
    (log,) = bare.chain.logs(bare.contract.address, [], 0, bare.chain.head().number)
    assert decode_event(log) == OperatorChanged(NOBODY, OPERATOR.address, log)


def test_registration_returns_and_binds_the_account(bare: Ledger):
    data = calldata("registration", ROBOT, ACCOUNT.address, b"C")
    answer = bare.chain.call(Call(bare.contract.address, data, OPERATOR.address))
    assert answer == bytes(12) + bytes.fromhex(ACCOUNT.address[2:])
    receipt = bare.contract.transact(OPERATOR, "registration", ROBOT, ACCOUNT.address, b"C")
    (event,) = events(receipt)
    assert event == Registered(ROBOT, ACCOUNT.address, 1, 0, b"C", receipt.logs[0])
    state = bare.contract.robot(ROBOT)
    assert (state.account, state.revoked, state.batches, state.generation) == (ACCOUNT.address, False, 0, 1)
    assert state.registered_at == state.changed_at == receipt.block_number
    assert state.may_write
    assert bare.contract.robot_of(ACCOUNT.address) == ROBOT


def test_the_same_registration_again_is_quiet_and_another_is_refused(made: Ledger):
    receipt = made.contract.transact(OPERATOR, "registration", ROBOT, ACCOUNT.address, b"certificates")
    assert receipt.logs == ()
    for account, certificates in ((OTHER_ACCOUNT, b"certificates"), (ACCOUNT, b"others")):
        with refused("AlreadyRegistered", ROBOT, ACCOUNT.address):
            made.contract.transact(OPERATOR, "registration", ROBOT, account.address, certificates)
    made.contract.transact(OPERATOR, "revokeRobot", ROBOT)
    with refused("AlreadyRegistered", ROBOT, ACCOUNT.address):
        made.contract.transact(OPERATOR, "registration", ROBOT, ACCOUNT.address, b"certificates")


def test_an_account_serves_one_robot_for_good(made: Ledger):
    with refused("AccountInUse", ACCOUNT.address, ROBOT):
        made.contract.transact(OPERATOR, "registration", OTHER_ROBOT, ACCOUNT.address, b"")
    made.contract.transact(OPERATOR, "replaceRegistration", ROBOT, OTHER_ACCOUNT.address, b"new")
    with refused("AccountInUse", ACCOUNT.address, ROBOT):
        made.contract.transact(OPERATOR, "registration", OTHER_ROBOT, ACCOUNT.address, b"")


def test_registration_needs_a_name_and_an_account(bare: Ledger):
    for robot, account in ((ZERO_HASH, ACCOUNT.address), (ROBOT, NOBODY)):
        with refused("ZeroArgument"):
            bare.contract.transact(OPERATOR, "registration", robot, account, b"")


@pytest.mark.parametrize(
    ("function", "arguments"),
    [
        ("registration", (OTHER_ROBOT, OTHER_ACCOUNT.address, b"")),
        ("replaceRegistration", (ROBOT, ACCOUNT.address, b"")),
        ("revokeRobot", (ROBOT,)),
        ("allocETH", (ACCOUNT.address,)),
        ("offerOperator", (ACCOUNT.address,)),
    ],
)
def test_only_the_operator_may(made: Ledger, function: str, arguments: tuple[object, ...]):
    with refused("NotOperator", ACCOUNT.address):
        made.contract.transact(ACCOUNT, function, *arguments)


def test_replacing_revokes_the_old_account_and_goes_on_counting(made: Ledger, records: Records):
    made.write(records.run(3), 0)
    before = made.contract.robot(ROBOT)
    receipt = made.contract.transact(OPERATOR, "replaceRegistration", ROBOT, OTHER_ACCOUNT.address, b"new")
    revoked, registered = events(receipt)
    assert revoked == Revoked(ROBOT, ACCOUNT.address, 1, before.changed_at, receipt.logs[0])
    assert registered == Registered(ROBOT, OTHER_ACCOUNT.address, 2, receipt.block_number, b"new", receipt.logs[1])
    with refused("NotTheRobot", ROBOT, ACCOUNT.address):
        made.write(records.run(1), 1)
    made.contract.transact(OPERATOR, "allocETH", OTHER_ACCOUNT.address, value=ETH)
    made.write(records.run(1), 1, OTHER_ACCOUNT)
    state = made.contract.robot(ROBOT)
    assert (state.account, state.batches, state.generation, state.may_write) == (OTHER_ACCOUNT.address, 2, 2, True)


def test_replacing_a_revoked_robot_lets_it_write_again_and_does_not_revoke_twice(made: Ledger, records: Records):
    made.contract.transact(OPERATOR, "revokeRobot", ROBOT)
    receipt = made.contract.transact(OPERATOR, "replaceRegistration", ROBOT, ACCOUNT.address, b"renewed")
    assert [type(event) for event in events(receipt)] == [Registered]
    made.write(records.run(1), 0)
    assert made.contract.robot(ROBOT).revoked_at == 0


def test_there_is_nothing_to_replace_or_revoke_of_a_name_never_used(made: Ledger):
    with refused("NotRegistered", OTHER_ROBOT):
        made.contract.transact(OPERATOR, "replaceRegistration", OTHER_ROBOT, OTHER_ACCOUNT.address, b"")
    with refused("NotRegistered", OTHER_ROBOT):
        made.contract.transact(OPERATOR, "revokeRobot", OTHER_ROBOT)


def test_a_revoked_robot_writes_no_more_and_what_it_wrote_stays_provable(made: Ledger, records: Records):
    (record,) = batch = records.run(1)
    made.write(batch, 0)
    registered = made.contract.robot(ROBOT).changed_at
    receipt = made.contract.transact(OPERATOR, "revokeRobot", ROBOT)
    assert events(receipt) == [Revoked(ROBOT, ACCOUNT.address, 1, registered, receipt.logs[0])]
    state = made.contract.robot(ROBOT)
    assert state.revoked
    assert state.revoked_at == receipt.block_number
    assert not state.may_write
    with refused("AlreadyRevoked", ROBOT, receipt.block_number):
        made.write(records.run(1), 1)
    with refused("AlreadyRevoked", ROBOT, receipt.block_number):
        made.contract.transact(OPERATOR, "revokeRobot", ROBOT)
    assert made.contract.check_data(record, 0, 0, 1, [])


def test_the_office_passes_when_the_other_accepts(made: Ledger):
    with refused("NotOffered", ACCOUNT.address):
        made.contract.transact(ACCOUNT, "acceptOperator")
    receipt = made.contract.transact(OPERATOR, "offerOperator", ACCOUNT.address)
    assert events(receipt) == [OperatorOffered(OPERATOR.address, ACCOUNT.address, receipt.logs[0])]
    assert made.contract.operator() == OPERATOR.address
    receipt = made.contract.transact(ACCOUNT, "acceptOperator")
    assert events(receipt) == [OperatorChanged(OPERATOR.address, ACCOUNT.address, receipt.logs[0])]
    assert made.contract.operator() == ACCOUNT.address
    with refused("NotOperator", OPERATOR.address):
        made.contract.transact(OPERATOR, "revokeRobot", ROBOT)
    with refused("NotOffered", ACCOUNT.address):
        made.contract.transact(ACCOUNT, "acceptOperator")


def test_an_offer_can_be_taken_back(made: Ledger):
    made.contract.transact(OPERATOR, "offerOperator", ACCOUNT.address)
    made.contract.transact(OPERATOR, "offerOperator", NOBODY)
    with refused("NotOffered", ACCOUNT.address):
        made.contract.transact(ACCOUNT, "acceptOperator")


# ---------------------------------------------------------------------- money


def test_alloc_eth_pays_up_to_five_eth_and_not_beyond(made: Ledger):
    before = made.chain.balance(ACCOUNT.address)
    receipt = made.contract.transact(OPERATOR, "allocETH", ACCOUNT.address, value=4 * ETH)
    assert events(receipt) == [ETHAllocated(ROBOT, ACCOUNT.address, 4 * ETH, receipt.logs[0])]
    assert made.chain.balance(ACCOUNT.address) == before + 4 * ETH == 5 * ETH
    with refused("AboveLimit", ACCOUNT.address, 5 * ETH):
        made.contract.transact(OPERATOR, "allocETH", ACCOUNT.address, value=1)
    made.chain.fund(ACCOUNT.address, 1)  # already holds more than 5 ETH, the paper's case
    with refused("AboveLimit", ACCOUNT.address, 5 * ETH + 1):
        made.contract.transact(OPERATOR, "allocETH", ACCOUNT.address)
    assert made.chain.balance(made.contract.address) == 0


def test_alloc_eth_pays_registered_accounts_only(made: Ledger):
    with refused("AccountNotRegistered", OTHER_ACCOUNT.address):
        made.contract.transact(OPERATOR, "allocETH", OTHER_ACCOUNT.address, value=1)
    made.contract.transact(OPERATOR, "replaceRegistration", ROBOT, OTHER_ACCOUNT.address, b"")
    with refused("AccountNotRegistered", ACCOUNT.address):
        made.contract.transact(OPERATOR, "allocETH", ACCOUNT.address, value=1)
    made.contract.transact(OPERATOR, "revokeRobot", ROBOT)
    with refused("AccountNotRegistered", OTHER_ACCOUNT.address):
        made.contract.transact(OPERATOR, "allocETH", OTHER_ACCOUNT.address, value=1)


def test_alloc_eth_says_when_the_receiver_does_not_take_it(made: Ledger):
    # The ledger itself has no receive function: registered as a robot it cannot be paid.
    made.register(OTHER_ROBOT, made.contract, wei=0)
    with refused("TransferFailed", made.contract.address):
        made.contract.transact(OPERATOR, "allocETH", made.contract.address, value=1)


# ---------------------------------------------------------------------- the robot


def test_a_batch_is_one_event_that_holds_every_record(made: Ledger, records: Records):
    batch = records.run(3) + records.run(2, first=7, size=1)
    receipt = made.contract.transact(ACCOUNT, "setBatch", ROBOT, 5, packing.pack(batch))
    (event,) = events(receipt)
    root = merkle.root([merkle.leaf_hash(record) for record in batch])
    assert event == BatchRecorded(ROBOT, 5, ACCOUNT.address, root, 1, 0, packing.pack(batch), receipt.logs[0])
    assert packing.unpack(ROBOT, event.records) == batch
    assert made.contract.root(ROBOT, 5) == root
    state = made.contract.robot(ROBOT)
    assert (state.batches, state.batch_block) == (1, receipt.block_number)


def test_batches_are_numbered_and_linked(made: Ledger, records: Records):
    seen = []
    for index in (0, 3, 1):
        receipt = made.contract.transact(ACCOUNT, "setBatch", ROBOT, index, packing.pack(records.run(1)))
        (event,) = events(receipt)
        seen.append((event.number, event.previous_block, receipt.block_number))
    assert [number for number, _, _ in seen] == [1, 2, 3]
    assert [previous for _, previous, _ in seen] == [0, seen[0][2], seen[1][2]]


def test_set_data_is_a_batch_of_one(made: Ledger, records: Records):
    (record,) = records.run(1, first=2**64 - 1, size=300)
    id = record.id
    receipt = made.contract.transact(ACCOUNT, "setData", ROBOT, 0, id.stream, id.seq, record.ciphertext)
    (event,) = events(receipt)
    assert packing.unpack(ROBOT, event.records) == [record]
    assert event.root == merkle.leaf_hash(record) == made.contract.root(ROBOT, 0)
    # The same through the other call is the same batch: it returns quietly.
    assert made.contract.transact(ACCOUNT, "setBatch", ROBOT, 0, packing.pack([record])).logs == ()


def test_the_same_batch_again_returns_quietly_and_another_reverts(made: Ledger, records: Records):
    batch = records.run(4)
    made.write(batch, 0)
    state = made.contract.robot(ROBOT)
    receipt = made.contract.transact(ACCOUNT, "setBatch", ROBOT, 0, packing.pack(batch))
    assert receipt.succeeded
    assert receipt.logs == ()
    assert made.contract.robot(ROBOT) == state
    with refused("BatchIndexTaken", ROBOT, 0, made.contract.root(ROBOT, 0)):
        made.write(records.run(4), 0)


@pytest.mark.parametrize("function", ["setBatch", "setData"])
def test_only_the_bound_account_writes(made: Ledger, records: Records, function: str):
    (record,) = records.run(1)
    arguments = {
        "setBatch": (0, packing.pack([record])),
        "setData": (0, record.id.stream, record.id.seq, record.ciphertext),
    }[function]
    with refused("NotTheRobot", ROBOT, OPERATOR.address):
        made.contract.transact(OPERATOR, function, ROBOT, *arguments)
    with refused("NotRegistered", OTHER_ROBOT):
        made.contract.transact(ACCOUNT, function, OTHER_ROBOT, *arguments)
    made.register(OTHER_ROBOT, OTHER_ACCOUNT)
    with refused("NotTheRobot", ROBOT, OTHER_ACCOUNT.address):
        made.contract.transact(OTHER_ACCOUNT, function, ROBOT, *arguments)


def test_a_sender_without_a_balance_is_refused(bare: Ledger, records: Records):
    bare.register(ROBOT, ACCOUNT, wei=0)
    data = calldata("setBatch", ROBOT, 0, packing.pack(records.run(1)))
    with pytest.raises(Reverted) as failure:
        bare.chain.call(Call(bare.contract.address, data, ACCOUNT.address))
    reason = explain(failure.value)
    assert (reason.name, reason.arguments) == ("NoBalance", (ACCOUNT.address.lower(),))


STREAM = bytes(range(16))


@pytest.mark.parametrize(
    ("packed", "position"),
    [
        (b"", 0),
        (STREAM, 0),  # a run's header cut off
        (STREAM + bytes(8) + b"\0\0", 0),  # a run of none
        (STREAM + bytes(8) + b"\0\1", 26),  # without its record
        (STREAM + bytes(8) + b"\0\1\0", 26),  # half a length
        (STREAM + bytes(8) + b"\0\1\0\0", 26),  # an empty record
        (STREAM + bytes(8) + b"\0\1\0\2x", 26),  # a record cut off
        (STREAM + bytes(8) + b"\0\2\0\1x", 29),  # the second missing
        (STREAM + bytes(8) + b"\0\1\0\1x\0", 29),  # trailing bytes
        (STREAM + b"\xff" * 8 + b"\0\2\0\1x\0\1y", 0),  # past the last seq
    ],
)
def test_malformed_records_revert_and_say_where(made: Ledger, packed: bytes, position: int):
    with refused("MalformedRecords", position):
        made.contract.transact(ACCOUNT, "setBatch", ROBOT, 0, packed)


@pytest.mark.parametrize("size", [0, 2**16])
def test_set_data_takes_one_to_65535_bytes(made: Ledger, size: int):
    with refused("MalformedRecords", 0):
        made.contract.transact(ACCOUNT, "setData", ROBOT, 0, STREAM, 0, b"x" * size)


# ---------------------------------------------------------------------- anyone


@pytest.mark.parametrize("size", [1, 2, 3, 4, 5, 6, 7, 8, 9, 31, 33, 100])
def test_check_data_accepts_exactly_what_is_recorded(made: Ledger, records: Records, size: int):
    batch = records.run(size, size=20)
    made.write(batch, 0)
    leaves = [merkle.leaf_hash(record) for record in batch]
    for i in {0, 1 % size, size // 2, size - 1}:
        proof = merkle.proof(leaves, i)
        check = made.contract.check_data
        assert check(batch[i], 0, i, size, proof)
        assert not check(batch[i], 1, i, size, proof)
        assert not check(batch[i], 0, size, size, proof)
        assert not check(batch[i], 0, i, size, [*proof, bytes(32)])
        other = type(batch[i])(batch[i].id, batch[i].ciphertext[:-1] + b"?")
        assert not check(other, 0, i, size, proof)
        if proof:
            assert not check(batch[i], 0, i, size, proof[:-1])
            assert not check(batch[i], 0, i, size, [bytes(32), *proof[1:]])


def test_an_empty_index_proves_nothing(made: Ledger, records: Records):
    (record,) = records.run(1)
    assert not made.contract.check_data(record, 0, 0, 1, [])
    assert not made.contract.check_data(record, 0, 0, 0, [])


def test_check_data_reverts_for_a_name_never_registered(made: Ledger, records: Records):
    (record,) = records.run(1, robot=OTHER_ROBOT)
    with refused("NotRegistered", OTHER_ROBOT):
        made.contract.check_data(record, 0, 0, 1, [])


def test_a_record_is_not_proven_for_another_robot(made: Ledger, records: Records):
    made.register(OTHER_ROBOT, OTHER_ACCOUNT)
    (record,) = records.run(1)
    made.write([record], 0)
    moved = type(record)(type(record.id)(OTHER_ROBOT, record.id.stream, record.id.seq), record.ciphertext)
    assert not made.contract.check_data(moved, 0, 0, 1, [])


def test_the_contract_takes_no_coins_and_no_unknown_calls(made: Ledger):
    for data, value in ((b"", 1), (b"\xde\xad\xbe\xef", 0)):
        with pytest.raises(Reverted):
            made.chain.call(Call(made.contract.address, data, OPERATOR.address, value))


def test_another_contract_at_the_address_is_refused(made: Ledger):
    with pytest.raises(ChainError, match="no contract"):
        Contract.at(made.chain, ACCOUNT.address)
    with pytest.raises(ChainError, match="not an Ethereum address"):
        Contract.at(made.chain, "0x1234")
