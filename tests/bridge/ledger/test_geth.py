"""The same on a network as the paper had it: three geth nodes that sign blocks in turn (Clique), each a process.

Reorganisations here are real: a node that was cut off made a block that the others never saw, and gives it up.
"""

from __future__ import annotations

import json
import os
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest
from eth_account import Account

from bridge.ledger.world import ACCOUNT, ETH, OPERATOR, ROBOT, Records
from bridge.load_script import load_script
from conftest import unavailable
from rosbridge_eth import ledger
from rosbridge_eth.ledger import failures, packing
from rosbridge_eth.ledger.batching import Limits
from rosbridge_eth.ledger.contract import Contract
from rosbridge_eth.ledger.journal import Binding, Journal
from rosbridge_eth.ledger.pump import pump
from rosbridge_eth.ledger.states import State
from rosbridge_eth.ledger.submitter import Settings, Submitter
from rosbridge_eth.sources.sample import sample_bag

pytestmark = [pytest.mark.service, pytest.mark.slow]
ROOT = Path(__file__).resolve().parents[3]
PATIENCE = 90.0
clique = load_script("clique")


@pytest.fixture(scope="module")
def network(tmp_path_factory: pytest.TempPathFactory) -> Iterator[clique.Network]:
    try:
        with clique.Network(tmp_path_factory.mktemp("clique"), {OPERATOR.address: 1000 * ETH}) as running:
            running.await_blocks(3)
            yield running
    except clique.Unavailable as reason:
        unavailable(str(reason))


@pytest.fixture
def contract(network: clique.Network) -> Contract:
    """A fresh one, with a registered and funded robot."""
    made = ledger.deploy(ledger.connect(network.nodes[0].url), OPERATOR)
    made.transact(OPERATOR, "registration", ROBOT, ACCOUNT.address, b"certificates")
    made.transact(OPERATOR, "allocETH", ACCOUNT.address, value=ETH // 10)
    return made


class Process:
    """A submitter that looks at the network as a server does, by the clock on the wall."""

    def __init__(self, contract: Contract) -> None:
        self.contract = contract
        self.journal = Journal(":memory:", Binding.of(contract))
        self.submitter = Submitter(
            self.journal, contract=contract.address, chain_id=contract.chain.chain_id(),
            account_of={ROBOT: ACCOUNT}.get, operator=OPERATOR, holder="test",
            # A majority of three signers is two; the howto's three.
            settings=Settings(limits=Limits(records=10), confirmations=3, poll=0.2),
        )

    def turn(self) -> None:
        pump(self.submitter, self.contract.chain, time.monotonic())
        time.sleep(0.1)

    def until(self, what: str, holds) -> None:
        deadline = time.monotonic() + PATIENCE
        while not holds():
            assert time.monotonic() < deadline, f"{what}: {self.submitter.status()}"
            self.turn()

    def finish(self, given: list) -> None:
        """Every record is confirmed, and the chain has each once."""
        self.until("idle", self.submitter.idle)
        found = ledger.fetch(self.contract.chain, self.contract, ROBOT)
        assert Counter(item.record for item in found.records) == Counter(given)
        self.journal.close()

    def seal(self, records: list) -> list:
        self.submitter.seal(records, time.monotonic())
        return records


def test_headers_are_those_of_proof_of_authority(network: clique.Network, contract: Contract) -> None:
    block = network.nodes[0].request("eth_getBlockByNumber", "latest", False)
    assert len(block["extraData"]) == 2 + 2 * 97  # what strict readers of headers refuse
    head = contract.chain.head()
    assert head.number > 0 and head.base_fee is not None
    assert contract.chain.chain_id() == clique.CHAIN_ID


@pytest.mark.parametrize("scheme", ["http", "ws"])
def test_records_go_there_and_come_back(
    network: clique.Network, contract: Contract, records: Records, scheme: str
) -> None:
    url = network.nodes[0].url if scheme == "http" else network.nodes[0].ws_url
    process = Process(Contract.at(ledger.connect(url), contract.address))
    process.finish(process.seal(records.run(35, size=300)))


def test_every_node_has_what_one_was_given(network: clique.Network, contract: Contract, records: Records) -> None:
    process = Process(contract)
    given = process.seal(records.run(10))
    process.until("idle", process.submitter.idle)
    other = Contract.at(ledger.connect(network.nodes[2].url), contract.address)
    network.await_blocks(1, network.nodes[2])
    found = ledger.fetch(other.chain, other, ROBOT)
    assert [item.record for item in found.records] == given


def test_the_contract_answers_as_it_does_in_process(contract: Contract, records: Records) -> None:
    with pytest.raises(failures.Reverted, match="NotOperator"):
        contract.transact(ACCOUNT, "revokeRobot", ROBOT)
    with pytest.raises(failures.Reverted, match=r"MalformedRecords\(position 0\)"):
        contract.transact(ACCOUNT, "setBatch", ROBOT, 0, b"?")
    receipt = contract.transact(ACCOUNT, "setBatch", ROBOT, 0, packing.pack(records.run(100)))
    assert receipt.gas_used / 100 <= 15_000


def test_a_signer_that_is_killed_is_not_needed(network: clique.Network, contract: Contract, records: Records) -> None:
    network.nodes[2].kill()
    process = Process(contract)
    process.finish(process.seal(records.run(25)))
    network.nodes[2].start()
    network.connect()


def test_the_node_that_is_asked_is_killed_with_transactions_on_their_way(
    network: clique.Network, contract: Contract, records: Records
) -> None:
    process = Process(contract)
    given = process.seal(records.run(40))
    process.turn()
    network.nodes[0].kill()
    for _ in range(5):
        process.turn()
    assert "no connection" in str(process.submitter.status().failure)
    network.nodes[0].start()
    network.connect()
    process.finish(given)


def test_a_block_that_the_majority_never_saw_is_given_up_and_its_records_are_written_again(
    network: clique.Network, contract: Contract, records: Records
) -> None:
    alone, others = network.nodes[0], network.nodes[1:]
    process = Process(contract)
    alone.request("miner_stop")  # the others go on without it; who signed one of the last two blocks has to wait
    network.await_blocks(3)
    network.cut_off(alone)
    given = process.seal(records.run(10))
    process.turn()
    alone.request("miner_start")
    process.until("a block of its own", lambda: process.journal.jobs((State.INCLUDED,)))
    included = process.journal.jobs((State.INCLUDED,))
    number, hash = included[0].block_number, included[0].block_hash
    network.await_blocks(3, others[0])  # heavier than what one signer can make
    network.connect()
    process.until("the block is another", lambda: (b := contract.chain.block(number)) is not None and b.hash != hash)
    process.finish(given)


def test_the_bridge_on_proof_of_authority_from_init_to_a_complete_read(
    network: clique.Network, tmp_path: Path
) -> None:
    (tmp_path / "pass").write_text("the operator's words")
    port, environment = clique.free_ports(1)[0], {**os.environ, "PYTHONPATH": str(ROOT / "src")}

    def command(*arguments: str) -> list[str]:
        return [sys.executable, "-m", "rosbridge_eth", *arguments]

    def do(*arguments: str) -> str:
        done = subprocess.run(command(*arguments), cwd=tmp_path, env=environment, text=True, capture_output=True,
                              timeout=PATIENCE, check=False)
        assert done.returncode == 0, done.stderr
        return done.stdout

    do("init", "--listen", f"127.0.0.1:{port}", "--chain", network.nodes[1].url, "--passphrase-file", "pass")
    config = tmp_path / "operator" / "server.toml"
    config.write_text(config.read_text() + 'confirmations = 3\npoll = "200ms"\n')
    operator = json.loads((tmp_path / "operator/accounts.json").read_bytes())["operator"]
    chain = ledger.connect(network.nodes[1].url)
    gift = {"to": operator, "value": 10 * ETH, "gas": 21_000, "gasPrice": 10**10, "chainId": clique.CHAIN_ID,
            "nonce": int(chain.request("eth_getTransactionCount", OPERATOR.address, "latest"), 16)}
    chain.request("eth_sendRawTransaction", Account.sign_transaction(gift, OPERATOR.key).raw_transaction.to_0x_hex())
    network.await_blocks(2)
    do("deploy", "--passphrase-file", "pass")
    do("register", "robot_1", "--passphrase-file", "pass", "--password-file", "pass")
    do("join", "operator/bundles/robot_1.bundle", "--password-file", "pass")
    (tmp_path / "robot/robot.toml").write_text(
        f'topics = ["/robot_1/odom"]\n[source]\nkind = "bag"\npath = "{sample_bag()}"\nspeed = "max"\n'
    )
    server = subprocess.Popen(command("server", "--passphrase-file", "pass"), cwd=tmp_path, env=environment,
                              stderr=subprocess.DEVNULL)
    try:
        do("robot", "--password-file", "pass")
        deadline = time.monotonic() + PATIENCE
        while (seen := json.loads(do("read", "robot_1", "--passphrase-file", "pass", "--json")))["proven"] < 300:
            assert time.monotonic() < deadline, seen["findings"]
        assert seen["sound"] and seen["complete"]
    finally:
        server.terminate()
        assert server.wait(30) == 0
