"""Everything that happens to a chain, at random, while a submitter writes two robots' logs; then all is counted.

    python benchmarks/ledger_faults.py [--chain anvil|clique] [--seeds A:B] [--seconds S] [--out FILE]

Each seed is a run of its own: a real node (anvil with a block a second or two a second, or a geth that signs blocks
by Clique, named by GETH), the contract, a store, the submitter as a process, and two robots that seal chunks and send
what follows the head that the store says, from what they were not told to be confirmed. For `seconds` the faults that
the seed draws come in between:

    kill        the submitter is killed (-9) and started again         rival      a second submitter, by mistake
    drop        a transaction in the pool is lost                       empty      all of them are
    foreign     the robot's key is used elsewhere                       spike      the price of gas rises
    reorg       the newest blocks are replaced, below N                 deep       and beyond N
    limit       the node answers 429 to most requests                   cut        its answers are lost
    lost        the store is deleted, or                                old        an old copy of it is put back,
                while the submitter is stopped or while it runs

Then it is left alone until all is written, and the chain is read. `missing` counts chunks that were sealed and are
not there, `doubled` those that are there twice, `disorder` those out of the log's order; all have to be 0. A seed has
either deep reorganisations or lost stores: with both, what the robot was told to be confirmed is nowhere.
`reverted` counts transactions that were in a block for nothing. One line of JSON for each seed.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import signal
import sqlite3
import subprocess
import sys
import tempfile
import threading
import time
import traceback
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import ExitStack, closing, contextmanager, suppress
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from itertools import pairwise
from pathlib import Path
from typing import Any

import requests

import geth_network
from ports import free_port
from rosbridge_eth.errors import BridgeError, StoreError
from rosbridge_eth.ledger import Keyring, Ledger
from rosbridge_eth.ledger.contract import Fees
from rosbridge_eth.ledger.nodes import Anvil
from rosbridge_eth.log.chunk import Chunk, Log, robot_id, seal, stream_name
from rosbridge_eth.log.sqlite import SqliteStore
from rosbridge_eth.log.store import Offer, Store, place_of
from rosbridge_eth.server import submitter
from smcrypto import sm2

KEYS = Keyring.from_mnemonic("test " * 11 + "junk")
SIGNER, READER = sm2.PrivateKey.from_bytes(bytes(31) + b"\x07"), sm2.PrivateKey.from_bytes(bytes(31) + b"\x09")
ETH, GWEI = 10**18, 10**9
CONFIRMATIONS, PATIENCE, SETTLE = 3, 4.0, 90.0
ROBOTS = 2


# ---------------------------------------------------------------------- nodes


class AnvilNode:
    """Every fault, by anvil's own calls."""

    floor = 0  # the chain turns back to this block at most: there the robots are registered

    def __init__(self, dice: random.Random) -> None:
        pace = dice.choice([0.5, 1.0])
        self._anvil = Anvil.start(free_port(), block_time=pace, options=["--silent"])
        self.url, self.ask, self._dice = self._anvil.url, self._anvil.ask, dice
        for number in range(ROBOTS + 1):
            self.ask("anvil_setBalance", KEYS.account(number).address, hex(1000 * ETH if number == 0 else 0))

    def drop(self, account: str) -> None:
        pool = self.ask("txpool_content")["pending"]
        if waiting := next((w for a, w in pool.items() if a.lower() == account.lower()), None):
            self.ask("anvil_dropTransaction", self._dice.choice(list(waiting.values()))["hash"])

    def empty(self) -> None:
        self.ask("anvil_dropAllTransactions")

    def reorg(self, depth: int) -> None:
        """What the blocks held is gone; half the time it is handed to the node again, as its peers would."""
        head = int(self.ask("eth_blockNumber"), 16)
        depth = min(depth, head - self.floor)
        if depth < 1:
            return
        raws = []
        for number in range(head - depth + 1, head + 1):
            count = int(self.ask("eth_getBlockTransactionCountByNumber", hex(number)), 16)
            raws += [self.ask("eth_getRawTransactionByBlockNumberAndIndex", hex(number), hex(i)) for i in range(count)]
        self.ask("anvil_reorg", depth, [])
        if self._dice.random() < 0.5:
            for raw in raws:
                with suppress(BridgeError):
                    self.ask("eth_sendRawTransaction", raw)

    def spike(self) -> None:
        self.ask("anvil_setNextBlockBaseFeePerGas", hex(self._dice.choice([5, 20, 60]) * GWEI))

    def close(self) -> None:
        self._anvil.stop()


class CliqueNode:
    """A geth that signs alone, a block a second. It has no call to lose transactions: it is started anew instead."""

    floor = 0

    def __init__(self, dice: random.Random, folder: Path) -> None:
        self._network = geth_network.Network(folder, {KEYS.operator.address: 1000 * ETH}, nodes=1, period=1)
        self._node = self._network.nodes[0]
        self.url, self.ask, self._dice = self._node.url, self._node.request, dice
        self._network.await_blocks(2)

    def drop(self, account: str) -> None:
        self.empty()

    def empty(self) -> None:
        self._node.restart()

    def reorg(self, depth: int) -> None:
        head = self._node.height()
        if head - depth >= self.floor:
            self.ask("debug_setHead", hex(head - depth))

    def spike(self) -> None:
        """Others fill the blocks; the price follows."""

    def close(self) -> None:
        self._network.close()


class Proxy:
    """Between the submitter and its node: `limit` requests a second, or answers that get lost."""

    def __init__(self, node: str) -> None:
        proxy = self
        self.limit, self.cut = 0.0, False
        self._credit, self._at = 5.0, time.monotonic()
        lock, local = threading.Lock(), threading.local()

        class Handler(BaseHTTPRequestHandler):
            protocol_version = "HTTP/1.1"

            def do_POST(self) -> None:
                body = self.rfile.read(int(self.headers["Content-Length"]))
                with lock:
                    allowed = proxy._allowed()
                if not allowed:
                    self._say(429, b'{"jsonrpc":"2.0","id":1,"error":{"code":-32005,"message":"rate limit"}}')
                    return
                try:
                    local.session = getattr(local, "session", None) or requests.Session()
                    headers = {"Content-Type": "application/json"}
                    answer = local.session.post(node, data=body, headers=headers, timeout=9)
                except requests.RequestException:
                    self._say(502, b"<html>bad gateway</html>")
                    return
                self._say(504, b"<html>") if proxy.cut else self._say(answer.status_code, answer.content)

            def _say(self, status: int, body: bytes) -> None:
                self.send_response(status)
                self.send_header("Content-Length", str(len(body)))
                self.end_headers()
                self.wfile.write(body)

            def log_message(self, *_: object) -> None:
                pass

        self._server = ThreadingHTTPServer(("127.0.0.1", 0), Handler)
        self._server.handle_error = lambda *_: None  # type: ignore[method-assign]  # killed clients
        self._server.daemon_threads = True
        self.url = f"http://127.0.0.1:{self._server.server_address[1]}"
        threading.Thread(target=self._server.serve_forever, daemon=True).start()

    def _allowed(self) -> bool:
        now = time.monotonic()
        self._credit = min(10.0, self._credit + (now - self._at) * self.limit)
        self._at = now
        if self.limit and self._credit < 1:
            return False
        self._credit -= 1
        return True

    def close(self) -> None:
        self._server.shutdown()
        self._server.server_close()


# ---------------------------------------------------------------------- robots and the submitter's process


class Robot:
    """Seals chunks; sends what follows the store's head; keeps on its disk what it was not told to be confirmed."""

    def __init__(self, number: int, ledger: bytes, dice: random.Random) -> None:
        self.account, self.tk = KEYS.account(number), robot_id(f"robot_{number}")
        self._log, self._dice = Log(ledger, self.tk), dice
        self.written: list[Chunk] = []
        self.disk: list[Chunk] = []
        self._previous, self._stream, self._number = bytes(32), bytes(16), 0
        self._begin()

    def _begin(self) -> None:
        wall = int(time.time() * 1000) - self._dice.choice([0, 0, 3_600_000])  # a clock that is put back
        self._stream, self._number = stream_name(wall, self._stream, self._dice.randbytes), 0

    def seal(self) -> None:
        if self._dice.random() < 0.1:
            self._begin()
            self._previous = self._previous if self._dice.random() < 0.8 else bytes(32)
        lines = [b"x" * self._dice.choice([100, 8_000, 30_000])] if self._dice.random() < 0.7 else []
        chunk = seal(self._log, SIGNER, lines, stream=self._stream, number=self._number, previous=self._previous,
                     sealed_ms=int(time.time() * 1000), readers=[READER.public_key], compress=False)  # fmt: skip
        self._previous, self._number = chunk.header.digest, self._number + 1
        self.written.append(chunk)
        self.disk.append(chunk)

    def talk(self, store: Store) -> None:
        """A dozen chunks at most."""
        [state] = store.states([self.tk])
        self.disk = [chunk for chunk in self.disk if place_of(chunk.header) > state.confirmed]
        rest = [chunk for chunk in self.disk if place_of(chunk.header) > state.head][:12]
        before = [state.digest, *(chunk.header.digest for chunk in rest)]
        store.append([Offer(self.tk, *each) for each in zip(rest, before, strict=False)], time.time())


def submit(url: str, contract: str, path: str, ledger: str) -> None:
    """The child: a submitter, until it is killed."""
    submitter.PATIENCE = PATIENCE  # the runs are short
    submitter.LONGEST_PAUSE = 2.0
    keys = {robot_id(f"robot_{n}"): KEYS.account(n) for n in range(1, ROBOTS + 1)}
    store = SqliteStore(Path(path), bytes.fromhex(ledger), 10**9, 10**8)
    writer = submitter.Submitter(
        Ledger(url, contract, timeout=5), store, keys.keys, keys.get, KEYS.operator,
        submitter.Settings(confirmations=CONFIRMATIONS, gas_per_day=10**12),
    )  # fmt: skip
    said = None
    while True:
        try:
            time.sleep(writer.turn(time.time()))
            holds = [state.hold for state in store.states(list(keys))]
            if said != (said := (writer.trouble, writer.funds, writer.unconfirmed, *holds)):
                print(f"{time.time():.1f}", *said, dict(writer.counts), sep=" | ", file=sys.stderr, flush=True)
        except BridgeError as error:
            print(error, file=sys.stderr, flush=True)
            time.sleep(0.2)


class World:
    """One run."""

    def __init__(self, chain: str, seed: int, folder: Path, stack: ExitStack) -> None:
        self.dice = dice = random.Random(seed)
        self.node: Any = AnvilNode(dice) if chain == "anvil" else CliqueNode(dice, folder / "geth")
        stack.callback(self.node.close)
        self.ledger, _ = Ledger.deploy(self.node.url, KEYS.operator)
        self.robots = [Robot(n, self.ledger.ledger, dice) for n in range(1, ROBOTS + 1)]
        for robot in self.robots:
            self.ledger.registration(KEYS.operator, robot.tk, robot.account.address, b"certificates")
        self.node.floor = self.ledger.block_number()
        self.proxy = Proxy(self.node.url)
        stack.callback(self.proxy.close)
        self.folder, self.stores = folder, 0
        self.copy: Path | None = None
        self.processes: list[subprocess.Popen[bytes]] = []
        stack.callback(self.stop)
        self.counts: Counter[str] = Counter()
        self.new_store()
        self.start()

    def new_store(self, path: Path | None = None) -> None:
        self.stores += 1
        self.path = path or self.folder / f"store-{self.stores}"
        self.store = SqliteStore(self.path, self.ledger.ledger, 10**9, 10**8)

    def start(self) -> None:
        command = [sys.executable, __file__, "--submit", self.proxy.url, self.ledger.contract, str(self.path),
                   self.ledger.ledger.hex()]  # fmt: skip
        with (self.folder / "submitter.log").open("ab") as log:
            self.processes.append(subprocess.Popen(command, stdin=subprocess.DEVNULL, stdout=log, stderr=log))

    def stop(self) -> None:
        for process in self.processes:
            process.send_signal(signal.SIGKILL)
            process.wait()
        self.processes.clear()

    # ---- faults

    def kill(self) -> None:
        self.stop()
        self.start()

    def rival(self) -> None:
        if len(self.processes) < 2:
            self.start()

    def drop(self) -> None:
        self.node.drop(self.dice.choice(self.robots).account.address)

    def empty(self) -> None:
        self.node.empty()

    def foreign(self) -> None:
        """A transaction of the robot's key that the submitter knows nothing of, now or with a number yet to come."""
        account = self.dice.choice(self.robots).account
        [(latest, pending)] = self.ledger.nonces([account.address])
        fees = Fees(10 * GWEI, GWEI)
        nonce = self.dice.choice([latest, pending, pending + 1])
        self.ledger.send([self.ledger.sign(account, b"", nonce=nonce, gas=60_000, fees=fees).raw])

    def spike(self) -> None:
        self.node.spike()

    def reorg(self) -> None:
        self.node.reorg(self.dice.randrange(1, CONFIRMATIONS))

    def deep(self) -> None:
        self.node.reorg(self.dice.randrange(CONFIRMATIONS, 3 * CONFIRMATIONS))

    def limit(self) -> None:
        self.proxy.limit = 0 if self.proxy.limit else self.dice.choice([3.0, 10.0])

    def cut(self) -> None:
        self.proxy.cut = not self.proxy.cut

    def lost(self) -> None:
        if self.dice.random() < 0.5:  # under those who use it
            for suffix in ("", "-wal", "-shm"):
                Path(f"{self.path}{suffix}").unlink(missing_ok=True)
            return
        self.stop()
        self.new_store()
        if self.dice.random() < 0.5:
            self.talk()
        self.start()

    def old(self) -> None:
        if self.copy is None:
            self.copy = self.folder / f"copy-{self.stores}"
            _copy(self.path, self.copy)
            return
        if self.dice.random() < 0.5:
            _copy(self.copy, self.path)  # under those who use it
        else:
            self.stop()
            self.new_store(self.copy)
            self.start()
        self.copy = None

    # ---- the run

    def talk(self) -> None:
        for robot in self.robots:
            robot.talk(self.store)

    def rage(self, seconds: float) -> None:
        faults = ["kill", "kill", "rival", "drop", "drop", "empty", "foreign", "spike", "reorg", "reorg", "limit"]
        faults += ["cut", *self.dice.choice([["deep", "deep"], ["lost", "old", "old"]])]
        end = time.monotonic() + seconds
        while time.monotonic() < end:
            time.sleep(self.dice.uniform(0.1, 0.5))
            for robot in self.robots:
                for _ in range(self.dice.choice([0, 0, 1, 1, 3, 9])):
                    robot.seal()
                with suppress(StoreError):
                    robot.talk(self.store)
            if self.dice.random() < 0.6:
                fault = self.dice.choice(faults)
                try:
                    getattr(self, fault)()
                    self.counts[fault] += 1
                except (BridgeError, OSError, RuntimeError) as error:
                    self.counts[f"{fault} failed"] += 1
                    print(f"{fault}: {error}", file=sys.stderr)

    def settle(self) -> float:
        """Left alone; seconds until all is confirmed."""
        self.proxy.limit, self.proxy.cut = 0, False
        self.kill()
        began = time.monotonic()
        while time.monotonic() < began + SETTLE:
            self.talk()
            if not any(robot.disk for robot in self.robots):
                break
            time.sleep(0.3)
        return time.monotonic() - began

    def judge(self) -> dict[str, int]:
        found: Counter[str] = Counter(chunks=0, missing=0, doubled=0, disorder=0, unconfirmed=0)
        head = self.ledger.block_number()
        for robot in self.robots:
            events = list(self.ledger.data_events(robot.tk, 0, head))
            chain = [Chunk.parse(chunk).header.digest for event in events for chunk in event.chunks]
            place = {chunk.header.digest: i for i, chunk in enumerate(robot.written)}
            counted = Counter(chain)
            found["chunks"] += len(robot.written)
            found["missing"] += sum(digest not in counted for digest in place)
            found["doubled"] += sum(count - 1 for count in counted.values())
            found["strange"] += sum(digest not in place for digest in counted)
            found["disorder"] += sum(place.get(a, 0) >= place.get(b, 0) for a, b in pairwise(chain))
            found["unconfirmed"] += len(robot.disk)
        for number in range(1, head + 1):
            for hash in self.node.ask("eth_getBlockByNumber", hex(number), False)["transactions"]:
                receipt = self.node.ask("eth_getTransactionReceipt", hash)
                if receipt and (receipt["to"] or "").lower() == self.ledger.contract.lower():
                    sent = self.node.ask("eth_getTransactionByHash", hash)["input"]
                    kind = "foreign" if len(sent) <= 2 else "transactions"
                    found[kind] += 1
                    found["reverted"] += kind == "transactions" and receipt["status"] != "0x1"
        return dict(found)


def _copy(source: Path, target: Path) -> None:
    """SQLite's online backup, which is also its restore where somebody uses the target."""
    with closing(sqlite3.connect(source)) as one, closing(sqlite3.connect(target)) as other:
        one.backup(other)


@contextmanager
def _folder() -> Iterator[Path]:
    with tempfile.TemporaryDirectory(prefix="ledger-faults-") as name:
        yield Path(name)


def run(chain: str, seed: int, seconds: float) -> dict[str, Any]:
    with _folder() as folder, ExitStack() as stack:
        began = time.monotonic()
        world = World(chain, seed, folder, stack)
        world.rage(seconds)
        settled = world.settle()
        result = {"chain": chain, "seed": seed, "settled": round(settled, 1)} | world.judge()
        result["faults"] = dict(sorted(world.counts.items()))
        log = (folder / "submitter.log").read_text(errors="replace")
        result["tracebacks"] = log.count("Traceback")
        result["took"] = round(time.monotonic() - began, 1)
        if not is_right(result):
            result["log"] = log[-2000:]
        return result


def is_right(result: dict[str, Any]) -> bool:
    bad = ("missing", "doubled", "disorder", "strange", "unconfirmed", "tracebacks")
    return "error" not in result and not any(result[name] for name in bad)


def main(arguments: list[str] | None = None, say: Callable[[str], None] = print) -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--chain", choices=["anvil", "clique"], default="anvil")
    parser.add_argument("--seeds", default="0:5", help="A:B, from A on, below B")
    parser.add_argument("--seconds", type=float, default=8.0, help="of faults in each run")
    parser.add_argument("--out", type=Path, help="a file to which each line is added as it comes")
    parser.add_argument("--submit", nargs=4, help=argparse.SUPPRESS)
    options = parser.parse_args(arguments)
    if options.submit:
        submit(*options.submit)
    signal.signal(signal.SIGTERM, signal.default_int_handler)  # so that the node ends, too
    first, _, end = options.seeds.partition(":")
    wrong, total = [], Counter[str]()
    for seed in range(int(first), int(end)):
        try:
            result = run(options.chain, seed, options.seconds)
        except geth_network.Unavailable as reason:
            print(reason, file=sys.stderr)
            return 1
        except Exception:
            result = {"chain": options.chain, "seed": seed, "error": traceback.format_exc()}
        if not is_right(result):
            wrong.append(seed)
        total += Counter({k: v for k, v in result.items() if isinstance(v, int) and k != "seed"})
        line = json.dumps(result)
        say(line)
        if options.out:
            with options.out.open("a") as out:
                out.write(line + os.linesep)
    say(f"seeds {options.seeds} on {options.chain}: {dict(total)}; wrong: {wrong or 'none'}")
    return int(bool(wrong))


if __name__ == "__main__":
    sys.exit(main())
