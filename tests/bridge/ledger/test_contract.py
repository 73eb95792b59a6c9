"""RobotLedger on the EVM: what every call does, who may call it, each reason to refuse, and what it costs."""

from __future__ import annotations

import re
import secrets
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import replace

import pytest
from eth.vm.forks import LondonVM, PragueVM
from eth_hash.auto import keccak

from bridge.ledger.world import ETH, KEYS
from rosbridge_eth.config.home import Deployment
from rosbridge_eth.errors import ChainError
from rosbridge_eth.ledger import Ledger, RegistrationEvent, contract
from rosbridge_eth.ledger.contract import NOTHING, Standing, artifact, set_data_cost, set_data_gas
from rosbridge_eth.ledger.nodes import EmbeddedChain
from rosbridge_eth.ledger.transport import ChainUnavailable, OutOfFunds, Reverted, Underpriced
from rosbridge_eth.log.chunk import robot_id

OPERATOR, ROBOT, OTHER = KEYS.operator, KEYS.account(1), KEYS.account(2)
TK, OTHER_TK = robot_id("robot_1"), robot_id("robot_2")
NOBODY = "0x" + "00" * 20


@pytest.fixture
def bare() -> Ledger:
    """Deployed and nothing else; everybody has money."""
    chain = EmbeddedChain({account.address: 100 * ETH for account in (OPERATOR, ROBOT, OTHER)})
    return Ledger.deploy(chain, OPERATOR)[0]


@pytest.fixture
def made(bare: Ledger) -> Ledger:
    """robot_1 is registered."""
    bare.registration(OPERATOR, TK, ROBOT.address, b"certificates")
    return bare


@contextmanager
def refused(name: str, *arguments: object) -> Iterator[None]:
    """The contract's own error, with these values."""
    with pytest.raises(Reverted) as caught:
        yield
    words = [f"0x{value.hex()}" if isinstance(value, bytes) else str(value).lower() for value in arguments]
    told = re.fullmatch(rf"the contract refuses: {name}\((.*)\)", str(caught.value))
    assert told is not None
    assert re.findall(r"\w+ (\w+)", told[1].lower()) == words


def test_whoever_deploys_is_the_operator(bare: Ledger):
    assert bare.operator() == OPERATOR.address


def test_a_name_never_registered_stands_at_nothing(bare: Ledger):
    assert bare.standings([TK]) == [Standing(None, NOTHING, False, 0, NOTHING, 0, 0, 0)]
    assert bare.standings([]) == []
    with refused("NotRegistered", TK):
        bare.check_data(TK, 0, [], 0, b"")


def test_registration_binds_the_account(made: Ledger):
    block = made.block_number()
    [standing] = made.standings([TK])
    assert standing == Standing(
        ROBOT.address, keccak(b"certificates"), False, 0, NOTHING, made.balance(ROBOT.address), 0, block
    )
    assert made.registrations(TK, standing) == [
        RegistrationEvent(ROBOT.address, b"certificates", 0, 0, block, revoked=False)
    ]


def test_the_same_registration_again_is_quiet_and_another_is_refused(made: Ledger):
    made.registration(OPERATOR, TK, ROBOT.address, b"certificates")
    assert len(made.registrations(TK, made.standings([TK])[0])) == 1
    for account, certificates in ((OTHER, b"certificates"), (ROBOT, b"others")):
        with refused("AlreadyRegistered", TK, ROBOT.address):
            made.registration(OPERATOR, TK, account.address, certificates)
    made.revoke_robot(OPERATOR, TK)
    with refused("AlreadyRegistered", TK, ROBOT.address):
        made.registration(OPERATOR, TK, ROBOT.address, b"certificates")


def test_an_account_serves_one_robot_for_good(made: Ledger):
    with refused("AccountInUse", ROBOT.address, TK):
        made.registration(OPERATOR, OTHER_TK, ROBOT.address, b"")
    made.replace_registration(OPERATOR, TK, OTHER.address, b"new")
    with refused("AccountInUse", ROBOT.address, TK):
        made.registration(OPERATOR, OTHER_TK, ROBOT.address, b"")


def test_registration_needs_a_name_and_an_account(bare: Ledger):
    for tk, account in ((NOTHING, ROBOT.address), (TK, NOBODY)):
        with refused("ZeroArgument"):
            bare.registration(OPERATOR, tk, account, b"")


@pytest.mark.parametrize(
    "call",
    [
        lambda ledger: ledger.registration(ROBOT, OTHER_TK, OTHER.address, b""),
        lambda ledger: ledger.replace_registration(ROBOT, TK, ROBOT.address, b""),
        lambda ledger: ledger.revoke_robot(ROBOT, TK),
        lambda ledger: ledger.alloc_eth(ROBOT, ROBOT.address, 0),
        lambda ledger: ledger.transact(ROBOT, "offerOperator", ROBOT.address),
    ],
)
def test_only_the_operator_may(made: Ledger, call: Callable[[Ledger], object]):
    with refused("NotOperator", ROBOT.address):
        call(made)


def test_a_change_says_from_which_chunk_on_it_holds(made: Ledger):
    made.set_data(ROBOT, TK, [b"a", b"b"])
    first = made.standings([TK])[0].changed_block
    replaced = made.replace_registration(OPERATOR, TK, OTHER.address, b"new").block
    with refused("NotTheRobot", TK, ROBOT.address):
        made.set_data(ROBOT, TK, [b"c"])
    made.set_data(OTHER, TK, [b"c"])
    revoked = made.revoke_robot(OPERATOR, TK).block
    with refused("AlreadyRevoked", TK):
        made.set_data(OTHER, TK, [b"d"])
    with refused("AlreadyRevoked", TK):
        made.revoke_robot(OPERATOR, TK)
    again = made.replace_registration(OPERATOR, TK, OTHER.address, b"newer").block
    made.set_data(OTHER, TK, [b"d"])
    [standing] = made.standings([TK])
    assert (standing.chunks, standing.revoked, standing.changed_block) == (4, False, again)
    assert made.registrations(TK, standing) == [
        RegistrationEvent(ROBOT.address, b"certificates", 0, 0, first, revoked=False),
        RegistrationEvent(OTHER.address, b"new", 2, first, replaced, revoked=False),
        RegistrationEvent(OTHER.address, b"", 3, replaced, revoked, revoked=True),
        RegistrationEvent(OTHER.address, b"newer", 3, revoked, again, revoked=False),
    ]


def test_there_is_nothing_to_replace_revoke_or_pay_of_a_name_never_used(made: Ledger):
    with refused("NotRegistered", OTHER_TK):
        made.replace_registration(OPERATOR, OTHER_TK, OTHER.address, b"")
    with refused("NotRegistered", OTHER_TK):
        made.revoke_robot(OPERATOR, OTHER_TK)
    with refused("AccountNotRegistered", OTHER.address):
        made.alloc_eth(OPERATOR, OTHER.address, 1)


def test_eth_goes_to_registered_robots_up_to_five():
    chain = EmbeddedChain({OPERATOR.address: 100 * ETH})
    ledger, _ = Ledger.deploy(chain, OPERATOR)
    ledger.registration(OPERATOR, TK, ROBOT.address, b"")
    ledger.alloc_eth(OPERATOR, ROBOT.address, 2 * ETH)
    assert ledger.balance(ROBOT.address) == ledger.standings([TK])[0].balance == 2 * ETH
    with refused("AboveLimit", ROBOT.address, 2 * ETH):
        ledger.alloc_eth(OPERATOR, ROBOT.address, 3 * ETH + 1)
    ledger.alloc_eth(OPERATOR, ROBOT.address, 3 * ETH)
    ledger.replace_registration(OPERATOR, TK, OTHER.address, b"")
    with refused("AccountNotRegistered", ROBOT.address):
        ledger.alloc_eth(OPERATOR, ROBOT.address, 0)
    ledger.revoke_robot(OPERATOR, TK)
    with refused("AccountNotRegistered", OTHER.address):
        ledger.alloc_eth(OPERATOR, OTHER.address, 1)


def test_a_robot_without_money_cannot_write(bare: Ledger):
    poor = KEYS.account(3)
    bare.registration(OPERATOR, TK, poor.address, b"")
    with pytest.raises(OutOfFunds):  # a node; the contract's NoBalance is for what a node lets through
        bare.set_data(poor, TK, [b"a"])


def test_the_office_changes_hands_when_it_is_accepted(made: Ledger):
    with refused("NotOffered", ROBOT.address):
        made.transact(ROBOT, "acceptOperator")
    made.transact(OPERATOR, "offerOperator", OTHER.address)
    assert made.operator() == OPERATOR.address
    made.transact(OTHER, "acceptOperator")
    assert made.operator() == OTHER.address
    with refused("NotOperator", OPERATOR.address):
        made.revoke_robot(OPERATOR, TK)
    with refused("NotOffered", OTHER.address):
        made.transact(OTHER, "acceptOperator")


# ---------------------------------------------------------------------- chunks


def test_chunks_are_events_and_leave_their_number_and_the_last_ones_hash(made: Ledger):
    first = made.set_data(ROBOT, TK, [b"a", b"", b"c" * 100])
    second = made.set_data(ROBOT, TK, [b"d"])
    [standing] = made.standings([TK])
    assert (standing.chunks, standing.tail, standing.data_block) == (4, keccak(b"d"), second.block)
    events = list(made.data_events(TK, 0, second.block))
    assert events == list(made.newest_data(TK, second.block))[::-1]
    assert [(e.first, e.previous_block, e.chunks, e.block, e.transaction, e.account) for e in events] == [
        (0, 0, (b"a", b"", b"c" * 100), first.block, first.hash, ROBOT.address),
        (3, first.block, (b"d",), second.block, second.hash, ROBOT.address),
    ]
    assert made.standings([TK], first.block)[0].chunks == 3
    assert list(made.data_events(OTHER_TK, 0, second.block)) == []


def test_a_batch_is_taken_only_where_it_follows_what_is_there(made: Ledger):
    tail = keccak(b"b")
    made.set_data(ROBOT, TK, [b"a", b"b"])
    for first, said in ((0, NOTHING), (0, tail), (1, tail), (3, tail), (2, NOTHING), (2, keccak(b"a")), (2**255, tail)):
        with refused("NotNext", TK, 2, tail):
            made.transact(ROBOT, "setData", TK, first, said, [b"c"])
    with refused("ZeroArgument"):
        made.transact(ROBOT, "setData", TK, 2, tail, [])
    with refused("NotTheRobot", TK, OTHER.address):
        made.transact(OTHER, "setData", TK, 2, tail, [b"c"])
    made.transact(ROBOT, "setData", TK, 2, tail, [b"c"])
    with refused("NotNext", TK, 3, keccak(b"c")):
        made.transact(ROBOT, "setData", TK, 2, tail, [b"c"])


def test_check_data_knows_each_chunk_at_its_place_and_nothing_else(made: Ledger):
    chunks = [b"a", b"b" * 1000, b"a"]
    hashes = [keccak(chunk) for chunk in chunks]
    made.set_data(ROBOT, TK, chunks)
    made.set_data(ROBOT, TK, [b"d"])
    made.revoke_robot(OPERATOR, TK)
    for i, chunk in enumerate(chunks):
        assert made.check_data(TK, 0, hashes, i, chunk)
        assert not made.check_data(TK, 0, hashes, i, chunk + b"\0")
    assert made.check_data(TK, 3, [keccak(b"d")], 0, b"d")
    for first, said, i, chunk in (
        (0, hashes, 1, b"a"), (0, hashes, 3, b"a"), (0, hashes[:2], 0, b"a"), (1, hashes, 0, b"a"), (0, [], 0, b""),
        (3, hashes, 0, b"a"), (0, [keccak(b"x"), *hashes[1:]], 0, b"x"), (9, [], 0, b""), (0, hashes, 2**255, b"a"),
    ):  # fmt: skip
        assert not made.check_data(TK, first, said, i, chunk)


def test_robots_do_not_touch_each_other(made: Ledger):
    made.registration(OPERATOR, OTHER_TK, OTHER.address, b"c2")
    made.set_data(ROBOT, TK, [b"a"])
    made.set_data(OTHER, OTHER_TK, [b"x", b"y"])
    made.set_data(ROBOT, TK, [b"b"])
    assert [standing.chunks for standing in made.standings([OTHER_TK, TK, NOTHING])] == [2, 2, 0]
    assert [e.chunks for e in made.newest_data(TK, made.block_number())] == [(b"b",), (b"a",)]


# ---------------------------------------------------------------------- what it costs


@pytest.mark.parametrize(
    ("size", "count"),
    [(1, 1), (1, 100), (203, 1), (203, 200), (400, 100), (6_500, 15), (8_500, 11), (65_000, 1), (98_000, 1)],
)
@pytest.mark.parametrize("rules", [PragueVM, LondonVM])
def test_the_gas_formula_holds_on_the_evm(rules: type, size: int, count: int):
    """Since Prague calldata has a floor price; before, and with zeros, execution alone counts."""
    chain = EmbeddedChain({account.address: 100 * ETH for account in (OPERATOR, ROBOT, OTHER)}, rules=rules)
    made, _ = Ledger.deploy(chain, OPERATOR)
    made.registration(OPERATOR, TK, ROBOT.address, b"")
    for chunk in (secrets.token_bytes(size), bytes(size)):
        made.set_data(ROBOT, TK, [b"slots that were zero cost more"])
        for first in (True, False):
            if first:
                made.registration(OPERATOR, OTHER_TK, OTHER.address, b"")
            tk, account = (OTHER_TK, OTHER) if first else (TK, ROBOT)
            used = made.set_data(account, tk, [chunk] * count).gas_used
            assert used <= set_data_gas([size] * count)
    if rules is PragueVM:
        used = made.set_data(ROBOT, TK, [secrets.token_bytes(size)] * count).gas_used
        assert set_data_gas([size] * count) <= 1.25 * used + 60_000
        assert set_data_cost([size] * count) == pytest.approx(used, rel=0.03)


def test_a_record_costs_at_most_3800_gas(made: Ledger):
    """100 records in a chunk of 8.4 KB, several chunks in a batch: what capture gives of the sample's Odometry."""
    made.set_data(ROBOT, TK, [b"a"])
    used = made.set_data(ROBOT, TK, [secrets.token_bytes(8_400) for _ in range(11)]).gas_used
    assert used / 1100 <= 3_450  # what it is; a change for the worse should be noticed


# ---------------------------------------------------------------------- the client


def test_a_ledger_is_found_again_by_where_it_was_deployed(made: Ledger):
    place = Deployment(made.chain_id, "0x" + made.genesis.hex(), made.contract, 1)
    again = Ledger.connect(made._node.w3.provider, place)
    again.check()
    assert again.ledger == made.ledger
    with pytest.raises(ChainError, match="another chain"):
        Ledger.connect(EmbeddedChain(), place).check()
    place = replace(place, contract=OTHER.address)
    with pytest.raises(ChainError, match="no contract"):
        Ledger.connect(made._node.w3.provider, place).check()
    assert Ledger.connect(made._node.w3.provider, place).ledger != made.ledger


def test_blocks_have_numbers_and_times(made: Ledger):
    head = made.block()
    assert head == made.block(head.number)
    assert made.block_time(head.number) == head.time
    with pytest.raises(ChainUnavailable):
        made.block(head.number + 1)


def test_a_transaction_that_another_one_overtakes_is_sent_with_the_next_nonce(made: Ledger):
    """Two processes that use the operator's account at once."""
    real, stale = made.nonces, made.nonces([OPERATOR.address])
    made.transact(OPERATOR, "offerOperator", OTHER.address)
    answers = iter([stale])
    made.nonces = lambda accounts: next(answers, None) or real(accounts)  # type: ignore[method-assign]
    assert made.transact(OPERATOR, "offerOperator", ROBOT.address).succeeded


def test_a_transaction_whose_receipt_comes_late_is_not_sent_again(made: Ledger, monkeypatch):
    """A node may count a block's transactions before it can say what became of each: revoking twice would fail."""
    real, late = made.receipt, iter([None] * 3)
    monkeypatch.setattr(made, "receipt", lambda transaction: next(late, real(transaction)))
    assert made.revoke_robot(OPERATOR, TK).succeeded


def test_a_transaction_whose_place_another_one_took_in_the_pool_is_sent_with_the_next_nonce(made: Ledger, monkeypatch):
    monkeypatch.setattr(contract, "RECEIPT_LATE", 0.1)
    real = made.send

    def overtaken(raws: list[bytes]) -> list[ChainError | None]:
        """Says that it took it; and another transaction of the account has its number."""
        monkeypatch.setattr(made, "send", real)
        made.transact(OPERATOR, "offerOperator", OTHER.address)
        return [None]

    monkeypatch.setattr(made, "send", overtaken)
    assert made.revoke_robot(OPERATOR, TK).succeeded


def test_a_transaction_that_the_node_does_not_take_is_not_said_to_be_taken(made: Ledger, monkeypatch):
    """As where a node wants a higher tip than it names."""
    monkeypatch.setattr(made, "send", lambda raws: [Underpriced("transaction underpriced") for _ in raws])
    with pytest.raises(Underpriced, match="transaction underpriced"):
        made.transact(OPERATOR, "offerOperator", ROBOT.address, wait=0.1)


def test_every_function_event_and_error_is_on_the_page():
    from pathlib import Path

    page = (Path(__file__).parents[3] / "docs" / "ledger.md").read_text("utf-8")
    for item in artifact()["abi"]:
        if item["type"] in ("function", "event", "error"):
            assert f"`{item['name']}" in page, item["name"]
