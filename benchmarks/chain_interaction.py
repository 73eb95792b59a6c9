"""The paper's chain interaction, on a real network: each client registers once, writes four times, asks four times.

    python benchmarks/chain_interaction.py [--clients N] [--period SECONDS]
                                           [--chain clique|ethash|anvil] [--dag FOLDER] [--json FILE]

The chain is three geth nodes that sign by proof of authority, or of which one
mines (geth_network.py), or anvil. Eight processes make the requests, as in the paper. The operator
registers and funds the clients; each client then writes records of 256 bytes
with `setData` from its own account, and asks for each with `checkData`.

A write is timed in three parts, which the paper's figure does not tell apart:
until the node accepts the transaction, until a block that this node knows
holds it, and until that block has two more on top. A query is one eth_call.
What counts as success of a write is that it is confirmed, of a query that the
contract answers `true`.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import statistics
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING

from eth_hash.auto import keccak

import geth_network
from ports import free_port
from rosbridge_eth.ledger import Keyring, Ledger
from rosbridge_eth.ledger.contract import NOTHING, Receipt, call_gas, set_data_gas
from rosbridge_eth.ledger.nodes import Anvil
from rosbridge_eth.log.chunk import robot_id

if TYPE_CHECKING:
    from eth_account.signers.local import LocalAccount

PROCESSES, WRITES, QUERIES, CONFIRMATIONS = 8, 4, 4, 3
ETH = 10**18
PATIENCE = 400.0  # seconds; by proof of work, blocks may be a minute apart
Times = dict[str, list[float]]
KEYS = Keyring.from_mnemonic("test test test test test test test test test test test junk")  # of every test chain


@contextmanager
def network(kind: str, clients: int, period: int, dag: Path | None = None) -> Iterator[list[str]]:
    """The URLs of its nodes. As in the paper, ten accounts have 100 ETH each; the operator's is one of them."""
    with tempfile.TemporaryDirectory(prefix="interaction-") as folder:
        if kind == "anvil":
            with Anvil.start(free_port(), block_time=period) as node:
                node.fund(KEYS.operator.address, 100)
                for client in range(1, clients + 1):  # some of them are those that anvil makes rich
                    node.ask("anvil_setBalance", KEYS.account(client).address, "0x0")
                yield [node.url]
            return
        balances = geth_network.ten_accounts(KEYS.operator.address)
        with geth_network.Network(Path(folder), balances, period=period, gas_limit=0xFFFFFFFF, dag=dag) as running:
            running.await_blocks(3)
            yield [node.url for node in running.nodes]


class Requests:
    """Transactions of some accounts, followed until they are confirmed."""

    def __init__(self, ledger: Ledger, times: Times) -> None:
        self._ledger, self._times = ledger, times
        self._sent: dict[bytes, float] = {}
        self._fees = ledger.fees(ledger.block())

    def send(self, account: LocalAccount, nonce: int, data: bytes, gas: int, value: int = 0) -> None:
        signed = self._ledger.sign(account, data, nonce=nonce, gas=gas, fees=self._fees, value=value)
        before = time.perf_counter()
        [refused] = self._ledger.send([signed.raw])
        if refused is not None:
            self._times["refused"].append(0.0)
            return
        self._sent[signed.hash] = time.perf_counter()
        self._times["submit"].append(self._sent[signed.hash] - before)

    def settle(self) -> None:
        """Until all are confirmed, or it took too long."""
        waiting, included = dict(self._sent), dict[bytes, tuple[Receipt, float]]()
        self._sent.clear()
        deadline = time.monotonic() + PATIENCE
        while (waiting or included) and time.monotonic() < deadline:
            for hash in list(waiting):
                if (receipt := self._ledger.receipt(hash)) is not None:
                    now = time.perf_counter()
                    self._times["include"].append(now - waiting.pop(hash))
                    included[hash] = receipt, now
            head = self._ledger.block_number()
            for hash, (receipt, since) in list(included.items()):
                if head >= receipt.block + CONFIRMATIONS - 1:
                    now_in = self._ledger.receipt(hash)
                    self._times["confirm"].append(time.perf_counter() - since)
                    self._times["written" if now_in and now_in.succeeded else "failed"].append(0.0)
                    del included[hash]
            time.sleep(0.05)
        self._times["late"] += [0.0] * (len(waiting) + len(included))


def record(client: int, number: int) -> bytes:
    return (f"{client}/{number} ".encode() * 64)[:256]


def write_and_ask(url: str, address: str, clients: dict[int, int]) -> Times:
    """One of the eight processes. clients: with the nonce that each begins at."""
    times: Times = defaultdict(list)
    ledger = Ledger(url, address)
    requests = Requests(ledger, times)
    for number in range(WRITES):
        for client, start in clients.items():
            tail = keccak(record(client, number - 1)) if number else NOTHING
            data = ledger.calldata("setData", robot_id(f"client_{client}"), number, tail, [record(client, number)])
            requests.send(KEYS.account(client), start + number, data, set_data_gas([256]))
        requests.settle()
    for number in range(QUERIES):
        for client in clients:
            chunk = record(client, number)
            before = time.perf_counter()
            found = ledger.check_data(robot_id(f"client_{client}"), number, [keccak(chunk)], 0, chunk)
            times["query"].append(time.perf_counter() - before)
            times["answered" if found else "denied"].append(0.0)
    ledger.close()
    return dict(times)


def measure(urls: list[str], clients: int) -> dict[str, Times]:
    """{"registration": ..., "use": ...}; the contract is a new one."""
    ledger, _ = Ledger.deploy(urls[0], KEYS.operator, wait=PATIENCE)
    times: Times = defaultdict(list)
    requests, nonce = Requests(ledger, times), ledger.nonces([KEYS.operator.address])[0][0]
    starts = {client: start for client, (start, _) in enumerate(
        ledger.nonces([KEYS.account(client).address for client in range(1, clients + 1)]), 1)}  # fmt: skip
    # Each registration first: money goes to registered accounts alone, and not above 5 ETH.
    for function, value in (("registration", 0), ("allocETH", ETH // 10)):
        for client in range(1, clients + 1):
            address = KEYS.account(client).address
            data = (ledger.calldata(function, robot_id(f"client_{client}"), address, b"certificates")
                    if function == "registration" else ledger.calldata(function, address))
            requests.send(KEYS.operator, nonce, data, call_gas(data), value)
            nonce += 1
        requests.settle()
        if function == "registration":
            registered = {name: list(values) for name, values in times.items()}
    shares = [list(range(1 + process, clients + 1, PROCESSES)) for process in range(PROCESSES)]
    with multiprocessing.get_context("spawn").Pool(PROCESSES) as pool:
        parts = pool.starmap(write_and_ask, [
            (urls[number % len(urls)], ledger.contract, {client: starts[client] for client in share})
            for number, share in enumerate(shares) if share
        ])
    ledger.close()
    use: Times = defaultdict(list)
    for part in parts:
        for name, values in part.items():
            use[name] += values
    return {"registration": registered, "use": dict(use)}


def report(kind: str, clients: int, found: dict[str, Times]) -> str:
    registration, use = found["registration"], found["use"]
    rows = [f"{kind}: {clients} clients, load average {os.getloadavg()[0]:.1f}",
            "| | median | 95 % | worst |", "| --- | ---: | ---: | ---: |"]
    for what, values in [
        ("registration, accepted by the node", registration["submit"]), ("in a block", registration["include"]),
        ("and two more on top", registration["confirm"]), ("write, accepted by the node", use["submit"]),
        ("in a block", use["include"]), ("and two more on top", use["confirm"]), ("query", use["query"]),
    ]:
        ordered = sorted(values)
        cells = [statistics.median(ordered), ordered[int(0.95 * (len(ordered) - 1))], ordered[-1]]
        rows.append(f"| {what} | " + " | ".join(f"{1000 * cell:.1f} ms" for cell in cells) + " |")
    writes, asked = WRITES * clients, QUERIES * clients
    rows.append(f"registered {len(registration['written'])} of {clients}, written and confirmed"
                f" {len(use['written'])} of {writes}, proven by the contract {len(use['answered'])} of {asked}")
    return "\n".join(rows)


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--clients", type=int, default=100)
    parser.add_argument("--period", type=int, default=1, help="seconds between blocks")
    parser.add_argument("--chain", choices=["clique", "ethash", "anvil"], default="clique")
    parser.add_argument("--dag", type=Path, default=Path(".dag"), help="ethash's 1 GB, made here if it is not there")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    try:
        if dag := options.dag if options.chain == "ethash" else None:
            geth_network.make_dag(dag)
        with network(options.chain, options.clients, options.period, dag) as urls:
            found = measure(urls, options.clients)
    except geth_network.Unavailable as reason:
        print(reason, file=sys.stderr)
        return 1
    print(report(options.chain, options.clients, found))
    if options.json:
        options.json.write_text(json.dumps(found, indent=1) + "\n")
    whole = len(found["use"]["written"]) == WRITES * options.clients
    return 0 if whole and len(found["use"]["answered"]) == QUERIES * options.clients else 1


if __name__ == "__main__":
    sys.exit(main())
