"""The same on a real node: anvil, with what it can be made to do wrong, and the file that keeps its chain."""

from __future__ import annotations

import json
import os
import shutil
import signal
import subprocess
import sys
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from eth_hash.auto import keccak

import ledger_faults
from bridge.ledger.world import ETH, KEYS, World
from conftest import unavailable
from ports import free_port
from rosbridge_eth.errors import ChainError
from rosbridge_eth.ledger import Ledger, nodes
from rosbridge_eth.ledger.contract import NOTHING, Fees
from rosbridge_eth.ledger.nodes import Anvil
from rosbridge_eth.ledger.transport import AlreadyKnown, NonceTooLow, OutOfFunds, Reverted, Underpriced
from rosbridge_eth.log.chunk import robot_id

pytestmark = pytest.mark.service

OPERATOR, ROBOT, TK = KEYS.operator, KEYS.account(1), robot_id("robot_1")
GWEI = 10**9


def start(port: int, **options) -> Anvil:
    if not shutil.which("anvil") and not shutil.which("npx"):
        unavailable("neither anvil nor npx is installed")
    try:
        return Anvil.start(port, **options)
    except ChainError as error:
        unavailable(str(error))
        raise


@pytest.fixture(scope="module")
def node() -> Iterator[Anvil]:
    with start(free_port()) as running:
        yield running


@pytest.fixture
def ledger(node: Anvil) -> Ledger:
    """A fresh chain with the contract."""
    node.ask("anvil_reset")
    node.ask("evm_setAutomine", True)
    node.ask("anvil_setBalance", ROBOT.address, "0x0")  # anvil makes its own accounts rich
    return Ledger.deploy(node.url, OPERATOR)[0]


def test_chunks_get_there_and_are_confirmed(ledger: Ledger, tmp_path: Path):
    world = World(tmp_path, ledger=ledger)
    world.take(world.pen.chunks(40, 8_000))
    world.run()
    assert world.confirmed() == world.pen.last


def test_the_nodes_refusals_are_understood(ledger: Ledger, node: Anvil):
    with pytest.raises(Reverted) as caught:
        ledger.revoke_robot(ROBOT, TK)
    assert str(caught.value) == f"the contract refuses: NotOperator(sender {ROBOT.address.lower()})"
    node.ask("evm_setAutomine", False)
    [(nonce, _)] = ledger.nonces([OPERATOR.address])

    def signed(account=OPERATOR, number=nonce, price=10 * GWEI, value=0) -> bytes:
        return ledger.sign(account, b"", nonce=number, gas=60_000, fees=Fees(price, GWEI), value=value).raw

    answers = ledger.send(
        [signed(), signed(), signed(value=1), signed(number=0), signed(ROBOT, 0), signed(price=20 * GWEI),
         signed(number=nonce + 1, price=1), signed(number=nonce + 5), b"\x02"]
    )  # fmt: skip
    kinds = [None, AlreadyKnown, Underpriced, NonceTooLow, OutOfFunds, None, Underpriced, None, ChainError]
    assert [type(answer) if answer else None for answer in answers[:-1]] == kinds[:-1]
    assert isinstance(answers[-1], ChainError)
    assert ledger.nonces([OPERATOR.address, ROBOT.address]) == [(nonce, nonce + 1), (0, 0)]


def test_a_robot_without_money_is_refused_by_the_contract(ledger: Ledger):
    ledger.registration(OPERATOR, TK, ROBOT.address, b"")
    with pytest.raises(Reverted, match="NoBalance"):
        ledger.set_data(ROBOT, TK, [b"a"])


def test_several_batches_in_one_block_are_all_found(ledger: Ledger, node: Anvil):
    ledger.registration(OPERATOR, TK, ROBOT.address, b"1")
    ledger.alloc_eth(OPERATOR, ROBOT.address, ETH)
    node.ask("evm_setAutomine", False)
    tail, raws, fees = NOTHING, [], Fees(20 * GWEI, GWEI)
    for i in range(3):
        data = ledger.calldata("setData", TK, i, tail, [b"%d" % i])
        raws.append(ledger.sign(ROBOT, data, nonce=i, gas=200_000, fees=fees).raw)
        tail = keccak(b"%d" % i)
    [(nonce, _)] = ledger.nonces([OPERATOR.address])
    for i in range(2):
        data = ledger.calldata("replaceRegistration", TK, ROBOT.address, b"%d" % i)
        raws.append(ledger.sign(OPERATOR, data, nonce=nonce + i, gas=300_000, fees=Fees(20 * GWEI, 2 * GWEI - i)).raw)
    assert ledger.send(raws) == [None] * 5
    node.ask("anvil_mine", "0x1")
    [standing] = ledger.standings([TK])
    block = standing.data_block
    assert block == standing.changed_block
    assert [(e.first, e.previous_block) for e in ledger.newest_data(TK, block)] == [(2, block), (1, block), (0, 0)]
    changes = ledger.registrations(TK, standing)
    assert [e.certificates for e in changes] == [b"1", b"0", b"1"]
    assert [e.block for e in changes[1:]] == [block, block]


def test_a_node_that_hangs_is_waited_for(ledger: Ledger, node: Anvil, tmp_path: Path):
    world = World(tmp_path, ledger=Ledger(node.url, ledger.contract, timeout=0.5))
    world.take(world.pen.chunks(5))
    os.killpg(node.pid, signal.SIGSTOP)
    try:
        world.turn()
        assert "too slow" in str(world.submitter.trouble)
    finally:
        os.killpg(node.pid, signal.SIGCONT)
    world.run()
    assert world.submitter.trouble is None


def test_a_chain_that_was_made_anew_is_said_to_be_another_one(ledger: Ledger, node: Anvil, tmp_path: Path):
    world = World(tmp_path, ledger=ledger)
    assert ledger.genesis == ledger.block(0).hash
    world.turn()
    time.sleep(1.1)  # its first block is as old as it is, in seconds
    node.ask("anvil_reset")
    for _ in range(2):
        world.turn()
    assert "is another chain" in str(world.submitter.trouble)


def test_dropped_and_reorganised_transactions_are_sent_again(ledger: Ledger, node: Anvil, tmp_path: Path):
    world = World(tmp_path, ledger=ledger)
    node.ask("evm_setAutomine", False)
    world.take(world.pen.chunks(20, 8_000))
    world.turn()
    assert world.in_flight == 2
    node.ask("anvil_dropAllTransactions")
    world.turn()
    node.ask("anvil_mine", "0x1")
    world.turn()
    assert world.on_chain() == world.pen.digests
    node.ask("anvil_reorg", 1, [])
    assert world.on_chain() == []
    node.ask("evm_setAutomine", True)
    world.run()


# ---------------------------------------------------------------------- the file


def chain_state(port: int, state: Path, write: int = 0) -> tuple[bytes, list[bytes]]:
    """Start, write so many chunks, end orderly; the genesis and all chunks."""
    with start(port, state=state) as running:
        running.fund(OPERATOR.address, 100)
        try:
            contract = (state.parent / "contract").read_text()
            ledger = Ledger(running.url, contract)
        except FileNotFoundError:
            ledger, _ = Ledger.deploy(running.url, OPERATOR)
            (state.parent / "contract").write_text(ledger.contract)
            ledger.registration(OPERATOR, TK, ROBOT.address, b"certificates")
        for _ in range(write):
            ledger.set_data(ROBOT, TK, [os.urandom(5_000)])
        [standing] = ledger.standings([TK])
        chunks = [chunk for e in ledger.newest_data(TK, standing.data_block) for chunk in e.chunks]
        return ledger.genesis, chunks[::-1]


def test_a_chain_stays_the_same_however_often_its_node_is_started(tmp_path: Path):
    port, state = free_port(), tmp_path / "chain"
    seen, before = set(), list[bytes]()
    for _ in range(4):
        genesis, chunks = chain_state(port, state, write=2)
        seen.add(genesis)
        assert chunks[: len(before)] == before
        before = chunks
        time.sleep(1.1)  # the next start's own first block is of another second
    assert len(seen) == 1
    assert len(before) == 8
    numbers = [int(block["header"]["number"], 16) for block in json.loads(state.read_bytes())["blocks"]]
    assert sorted(numbers) == list(range(len(numbers))), "one first block, the chain's own"


def test_a_chain_that_was_kept_goes_on_at_the_time_of_day(tmp_path: Path):
    for _ in range(2):
        with start(free_port(), state=tmp_path / "chain") as running:
            before = int(time.time())
            running.ask("evm_mine")
            made = int(running.ask("eth_getBlockByNumber", "latest", False)["timestamp"], 16)
            assert before - 1 <= made <= time.time() + 2
        time.sleep(1.1)


def test_a_kill_costs_what_was_not_saved(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(nodes, "STATE_SECONDS", 3)  # a kill in the middle of writing may cost the file
    port, state = free_port(), tmp_path / "chain"
    genesis, chunks = chain_state(port, state, write=3)
    running = start(port, state=state)
    ledger = Ledger(running.url, (tmp_path / "contract").read_text())
    running.fund(account := "0x" + "ab" * 20, 1)
    running.keeps(account)
    ledger.set_data(ROBOT, TK, [b"perhaps lost"])
    running.kill()
    assert not running.running()
    found = chain_state(port, state)
    assert found[0] == genesis and found[1][:3] == chunks and len(found[1]) in (3, 4)


def test_what_is_not_written_is_waited_for_and_then_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(nodes, "START_SECONDS", 10.0)
    with start(free_port(), state=tmp_path / "chain") as running:
        monkeypatch.setattr(nodes, "START_SECONDS", 0.2)
        with pytest.raises(ChainError, match="is there room on the disk"):
            running.keeps("0x" + "cd" * 20)


def test_it_ends_with_the_process_that_started_it_also_where_that_is_killed(tmp_path: Path, node: Anvil) -> None:
    """A chain that nobody saves would be lost at the next power cut, with all that robots believe to be on it."""
    port = free_port()
    code = f"from rosbridge_eth.ledger.nodes import Anvil; Anvil.start({port}); print(flush=True); input()"
    with subprocess.Popen([sys.executable, "-c", code], stdin=subprocess.PIPE, stdout=subprocess.PIPE) as starter:
        assert starter.stdout is not None and starter.stdout.readline()
        assert not nodes.is_free(port)
        starter.kill()
    deadline = time.monotonic() + 30
    while not nodes.is_free(port):
        assert time.monotonic() < deadline, "it runs on"
        time.sleep(0.05)


def test_a_state_file_that_is_damaged_is_said(tmp_path: Path, node: Anvil):
    (state := tmp_path / "chain.json").write_text('{"blocks": [{"head')
    with pytest.raises(ChainError, match=r"chain\.json is damaged"):
        Anvil.start(free_port(), state=state)


def test_with_the_network_cable_pulled_a_chain_starts(node: Anvil):
    """In a network of its own that has nothing but this machine; npx has fetched anvil by now."""
    if os.geteuid() != 0 or shutil.which("unshare") is None:
        unavailable("only root can have a network of its own")
    program = (
        "import subprocess; subprocess.run(['ip', 'link', 'set', 'lo', 'up'], check=True);"
        "from rosbridge_eth.ledger.nodes import Anvil; anvil = Anvil.start(8545); anvil.stop()"
    )
    subprocess.run(["unshare", "--net", sys.executable, "-c", program], check=True, timeout=50, env=os.environ | {
        "PYTHONPATH": str(Path(nodes.__file__).parents[2])
    })  # fmt: skip


def test_a_port_in_use_is_said(node: Anvil):
    port = int(node.url.rsplit(":", 1)[1])
    with pytest.raises(ChainError, match="in use"):
        Anvil.start(port)


def test_a_missing_program_is_said(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("PATH", "/nowhere")
    with pytest.raises(ChainError, match="install one of them"):
        Anvil.start(free_port())


# ---------------------------------------------------------------------- at random


@pytest.mark.slow
@pytest.mark.timeout(300)
@pytest.mark.parametrize(("chain", "seed"), [("anvil", 0), ("anvil", 1), ("clique", 0)])
def test_every_chunk_is_written_once_whatever_happens(chain: str, seed: int, node: Anvil):
    """benchmarks/ledger_faults.py, of which many more seeds were run by hand (docs/ledger.md)."""
    try:
        result = ledger_faults.run(chain, seed, 6.0)
    except ledger_faults.geth_network.Unavailable as reason:
        unavailable(str(reason))
    assert ledger_faults.is_right(result), json.dumps(result, indent=1)
