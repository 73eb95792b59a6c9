"""The same against a real node: anvil, over HTTP and WebSocket, with what it can be made to do wrong."""

from __future__ import annotations

import contextlib
import json
import os
import shutil
import signal
import socket
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest

from bridge.ledger.world import ACCOUNT, ETH, OPERATOR, ROBOT, Records
from conftest import unavailable
from rosbridge_eth import ledger
from rosbridge_eth.errors import ChainError
from rosbridge_eth.ledger import anvil, failures, packing
from rosbridge_eth.ledger.batching import Limits
from rosbridge_eth.ledger.contract import Contract
from rosbridge_eth.ledger.failures import NodeFailure
from rosbridge_eth.ledger.journal import Binding, Journal
from rosbridge_eth.ledger.jsonrpc import JsonRpcChain
from rosbridge_eth.ledger.pump import pump
from rosbridge_eth.ledger.states import State
from rosbridge_eth.ledger.submitter import Settings, Submitter

pytestmark = pytest.mark.service


def free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


def start(port: int, **options) -> anvil.Anvil:
    if not shutil.which("anvil") and not shutil.which("npx"):
        unavailable("neither anvil nor npx is installed")
    try:
        return anvil.start(port, **options)
    except ChainError as error:
        unavailable(f"anvil does not start: {error}")
        raise


@pytest.fixture(scope="module")
def node() -> Iterator[anvil.Anvil]:
    with start(free_port()) as running:
        yield running


@pytest.fixture(params=["http", "ws"])
def chain(node: anvil.Anvil, request: pytest.FixtureRequest) -> Iterator[JsonRpcChain]:
    """A fresh chain on the running node, mining only when told to."""
    made = ledger.connect(node.url.replace("http", request.param))
    made.request("anvil_reset")
    made.request("anvil_setBalance", OPERATOR.address, hex(100 * ETH))
    made.request("evm_setAutomine", True)
    yield made
    made.close()


def deploy(chain: JsonRpcChain) -> Contract:
    chain.request("anvil_setBalance", ACCOUNT.address, "0x0")  # anvil makes its own accounts rich
    contract = ledger.deploy(chain, OPERATOR)
    contract.transact(OPERATOR, "registration", ROBOT, ACCOUNT.address, b"certificates")
    contract.transact(OPERATOR, "allocETH", ACCOUNT.address, value=ETH)
    return contract


class Process:
    """A submitter on a journal, driven by hand."""

    def __init__(self, contract: Contract, path: Path | str = ":memory:", **settings) -> None:
        self.contract, self.chain = contract, contract.chain
        self.journal = Journal(path, Binding.of(contract))
        options = {"limits": Limits(records=10), "confirmations": 2, "poll": 0.5}
        self.submitter = Submitter(
            self.journal,
            contract=contract.address,
            chain_id=contract.chain.chain_id(),
            account_of={ROBOT: ACCOUNT}.get,
            operator=OPERATOR,
            holder="test",
            settings=Settings(**(options | settings)),
        )
        self.now = 1000.0

    def pump(self) -> None:
        pump(self.submitter, self.chain, self.now)

    def drive(self, steps: int = 60) -> None:
        for _ in range(steps):
            self.pump()
            with contextlib.suppress(NodeFailure):
                self.chain.request("anvil_mine", "0x1")
            self.now += 1.0
            if self.submitter.idle():
                return
        raise AssertionError(f"not idle: {self.submitter.status()}")


def check(contract: Contract, given: list) -> None:
    found = ledger.fetch(contract.chain, contract, ROBOT)
    assert found.problems == ()
    assert Counter(item.record for item in found.records) == Counter(given)


def test_records_go_there_and_come_back(chain: JsonRpcChain, records: Records):
    contract = deploy(chain)
    process = Process(contract)
    given = records.run(35, size=300)
    process.submitter.seal(given, process.now)
    process.drive()
    check(contract, given)
    assert [item.record for item in ledger.fetch(chain, contract, ROBOT).records] == given


def test_the_contract_answers_as_it_does_in_process(chain: JsonRpcChain, records: Records):
    contract = deploy(chain)
    with pytest.raises(failures.Reverted, match="NotOperator"):
        contract.transact(ACCOUNT, "revokeRobot", ROBOT)
    with pytest.raises(failures.Reverted, match=r"MalformedRecords\(position 0\)"):
        contract.transact(ACCOUNT, "setBatch", ROBOT, 0, b"?")
    receipt = contract.transact(ACCOUNT, "setBatch", ROBOT, 0, packing.pack(records.run(100)))
    assert receipt.gas_used / 100 <= 15_000


def test_dropped_and_reorganised_transactions_are_sent_again(chain: JsonRpcChain, records: Records):
    contract = deploy(chain)
    process = Process(contract)
    chain.request("evm_setAutomine", False)
    given = records.run(40)
    process.submitter.seal(given, process.now)
    process.pump()
    (lost,) = process.journal.attempts(ACCOUNT.address, 1)
    chain.request("anvil_dropTransaction", "0x" + lost.hash.hex())
    chain.request("anvil_mine", "0x1")
    process.now += 1
    process.pump()
    assert len(process.journal.jobs((State.INCLUDED,))) == 1
    chain.request("anvil_reorg", 1, [])
    process.now += 1
    process.drive()
    check(contract, given)


def test_a_base_fee_that_rises_tenfold_is_followed(chain: JsonRpcChain, records: Records):
    contract = deploy(chain)
    process = Process(contract, bump_after=5.0)
    chain.request("evm_setAutomine", False)
    given = records.run(20)
    process.submitter.seal(given, process.now)
    process.pump()
    before = chain.head().base_fee
    assert before is not None
    chain.request("anvil_setNextBlockBaseFeePerGas", hex(10 * before))
    chain.request("anvil_mine", "0x1")
    assert chain.head().base_fee == 10 * before
    process.now += 1
    process.drive()
    check(contract, given)


def test_a_node_that_hangs_is_waited_for(node: anvil.Anvil, records: Records):
    chain = ledger.connect(node.url, timeout=0.5)
    chain.request("anvil_reset")
    chain.request("anvil_setBalance", OPERATOR.address, hex(100 * ETH))
    chain.request("evm_setAutomine", True)
    process = Process(deploy(chain))
    given = records.run(5)
    process.submitter.seal(given, process.now)
    os.killpg(node.pid, signal.SIGSTOP)
    try:
        process.pump()
        assert "no answer within" in str(process.submitter.status().failure)
    finally:
        os.killpg(node.pid, signal.SIGCONT)
    process.now += 5
    process.drive()
    check(process.contract, given)


def test_a_node_that_is_killed_and_comes_back_with_its_state(records: Records, tmp_path: Path):
    port, state = free_port(), tmp_path / "state.json"
    given = records.run(15)
    with start(port, state=state) as first:
        chain = ledger.connect(first.url)
        chain.request("anvil_setBalance", OPERATOR.address, hex(100 * ETH))
        contract = deploy(chain)
        process = Process(contract, tmp_path / "journal")
        process.submitter.seal(given, process.now)
        process.drive()
    assert state.exists()
    process.submitter.seal(more := records.run(5), process.now)
    process.pump()
    assert "no connection" in str(process.submitter.status().failure)
    with start(port, state=state):
        process.now += 120
        process.drive()
        check(contract, given + more)
        Journal(tmp_path / "journal", Binding.of(Contract.at(chain, contract.address))).close()  # still the same chain
        process.journal.close()


def test_a_chain_stays_the_same_however_often_its_node_is_started(tmp_path: Path):
    port, state = free_port(), tmp_path / "state.json"
    genesis = set()
    for _ in range(4):
        with start(port, state=state) as running:
            chain = JsonRpcChain(running.url)
            genesis.add(chain.request("eth_getBlockByNumber", "0x0", False)["hash"])
            chain.request("anvil_mine", "0x2")
            chain.close()
        blocks = [int(block["header"]["number"], 16) for block in json.loads(state.read_bytes())["blocks"]]
        assert set(blocks) == set(range(max(blocks) + 1))
        time.sleep(1.1)  # the next start's own first block is of another second
    assert len(genesis) == 1
    assert blocks.count(0) == 2, "anvil no longer writes the first block of every start: keep_one_genesis can go"


def test_a_state_file_that_was_cut_off_is_said(tmp_path: Path):
    (state := tmp_path / "chain.json").write_text('{"blocks": [{"head')
    with pytest.raises(ChainError, match="not whole"):
        anvil.start(free_port(), state=state)


def test_a_port_in_use_is_said(node: anvil.Anvil):
    port = int(node.url.rsplit(":", 1)[1])
    with pytest.raises(ChainError, match="in use"):
        anvil.start(port)
