"""A million records through a server that is killed, cut off and put back again and again; then all is counted.

    GETH=FOLDER/geth python benchmarks/soak.py [--records 1_000_000] [--robots 8] [--rate 500] [--seed N] [--json FILE]

A geth that signs blocks by Clique (a block a second), a server of two shards and the robots are started by
`python -m rosbridge_eth`, as an operator starts them. Each robot publishes simulated odometry, whose content is a
function of its tick, without leaving out a message. Every few seconds one of these faults comes, as the seed draws:

    robot    kill -9 of a robot, which is started again on its disk        shard     kill -9 of a shard
    server   kill -9 of the server's parent, and a new server              node      kill -9 of geth, and a new start
    store    an old copy is put back over a shard's store while it runs    network   20 % loss on one robot's way

At the end each robot's log is read from the chain and held against the robot's disk (how many chunks it ever
sealed) and against the simulation: within a robot's life the ticks follow each other without a gap, and each record
says what the simulation says at its tick. `missing`, `doubled` and `altered` have to be 0, or the exit code is 1.
"""

from __future__ import annotations

import argparse
import json
import random
import resource
import socket
import sqlite3
import sys
import tempfile
import time
from collections import Counter
from collections.abc import Sequence
from contextlib import ExitStack, closing
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

import geth_network
from faults import BAD_NETWORK, Count, Flow, Log, Program, Site, family, kill, running, table, until
from ports import free_port
from rosbridge_eth.capture import MessageLine
from rosbridge_eth.config import load_server_config
from rosbridge_eth.config.home import shard_of
from rosbridge_eth.ledger import Keyring
from rosbridge_eth.log.chunk import Chunk
from rosbridge_eth.robot.sources.sim import drive
from rosbridge_eth.server.shard import open_store

SHARDS = 2
WORDS = "test " * 11 + "junk"
GAP = (3.0, 7.0)  # seconds between two faults
LONG = 600.0  # seconds for what waits for everything
FAULTS = ["robot", "robot", "shard", "shard", "server", "node", "store"]


class CliqueSite(Site):
    """A site of two shards, whose chain is a geth of its own."""

    def _set_up(self, redis: bool) -> None:
        self.udp_port = free_port(socket.SOCK_DGRAM, SHARDS)
        program, key = geth_network.find_geth("clique"), geth_network.new_key()
        self.geth = geth_network.Node(program, self.folder / "geth", key, {
            "mine": None, "miner.gaslimit": geth_network.GAS_LIMIT, "gcmode": "archive"})
        rich: dict[str, int] = {Keyring.from_mnemonic(WORDS).operator.address: 10**6 * 10**18}
        self.geth.init(geth_network.genesis([self.geth.signer], rich, 1, geth_network.GAS_LIMIT))
        self.geth.start()
        words = self.folder / "words"
        words.write_text(WORDS)
        words.chmod(0o600)
        self.command("init", "--listen", f"127.0.0.1:{self.udp_port}", "--chain", self.geth.url,
                     "--reader", str(self.reader.path), "--reader-passphrase-file", str(self._secret),
                     "--mnemonic-file", str(words), *self._passphrase)
        settings = self.home.config.read_text() + f"confirmations = 2\n\n[funds]\ngas_per_day = {10**12}\n"
        self.home.config.write_text(f"shards = {SHARDS}\n{settings}")
        self.command("deploy", *self._passphrase)
        self.start_server()

    def close(self) -> None:
        super().close()
        if hasattr(self, "geth"):
            self.geth.kill()

    def outstanding(self, robot: bytes) -> str:
        with closing(self._store_of(robot)) as store:
            waiting, [state] = store.waiting(robot), store.states([robot])
        return f"{waiting.chunks} chunks wait ({state.hold})" if waiting.chunks else ""

    def is_done(self, robot: bytes) -> bool:
        return not self.outstanding(robot)

    def dead_letters(self, robot: bytes) -> set[bytes]:
        with closing(self._store_of(robot)) as store:
            return {Chunk.parse(letter.chunk).header.digest for letter in store.dead(10_000) if letter.tk == robot}

    def _store_of(self, robot: bytes) -> Any:
        shard = shard_of(robot, SHARDS)
        return open_store(load_server_config(self.home.config), self.home, shard, read_only=True)


class SimFlow(Flow):
    """A robot that publishes the simulation's odometry as it comes, from tick 0 in each of its lives."""

    def __init__(self, site: CliqueSite, number: int, rate: float, seed: int) -> None:
        self._rate = rate
        super().__init__(site, f"robot {number}", seed, harm=BAD_NETWORK if number == 1 else None)
        if self.relay is None:
            self._port = site.udp_port + shard_of(self.robot, SHARDS)
            self.make_settings()

    def make_home(self, home: Path) -> None:
        self.site.join(self.name, home)
        self.make_settings()

    def make_settings(self, duration: str = "") -> None:
        (self.home / "robot.toml").write_text(
            'topics = ["/robot_1/odom"]\n'
            f'server = "127.0.0.1:{self._port}"\n\n[log]\nperiod = "500ms"\n\n[spool]\nmax_size = "256 MiB"\n\n'
            f'[source]\nkind = "sim"\nrate = {self._rate}\n{duration}'
        )

    def last_life(self) -> None:
        """A second of records more, and what the disk has of all before; ends when the server has everything."""
        self.make_settings('duration = "1s"\n')
        program = self.start()
        until(f"{self.name} ends", program.ended, LONG)
        assert program.wait() == 0, program.said[-3000:]
        self.buried(program)

    def _unlike_the_bag(self, log: Log) -> int:
        """Records whose tick does not follow the one before, and that do not say what the simulation says at it."""
        unlike, ticks = 0, [content(record.content) for record in log.records]
        longest = 1 + max((tick for tick, _ in ticks), default=0)
        places = (drive(round(tick * 1e9 / self._rate) / 1e9) for tick in range(longest))
        expected = [(place.x, place.y, place.turn) for place in places]
        next_tick = 0
        for tick, said in ticks:
            unlike += tick not in (next_tick, 0)
            unlike += any(abs(a - b) > 1e-9 for a, b in zip(said, expected[tick], strict=True))
            next_tick = tick + 1
        return unlike


def content(line: MessageLine) -> tuple[int, tuple[float, float, float]]:
    """Tick, x, y and turn of an odometry record."""
    data: Any = line.data
    position = data["pose"]["pose"]["position"]
    return data["header"]["seq"], (position["x"], position["y"], data["twist"]["twist"]["angular"]["z"])


def copy_of(store: Path, copy: Path) -> None:
    """All of a store that is in use, or, the other way, all of a copy into it: SQLite's online backup."""
    with closing(sqlite3.connect(store, timeout=60)) as old, closing(sqlite3.connect(copy, timeout=60)) as new:
        old.backup(new)


class Faults:
    """What goes wrong, drawn from the seed; counts it."""

    def __init__(self, site: CliqueSite, flows: Sequence[SimFlow], seed: int) -> None:
        self._site, self._flows, self._dice = site, flows, random.Random(seed)
        self.counts: Counter[str] = Counter()
        self._copies: dict[int, Path] = {}

    def next(self) -> None:
        name = self._dice.choice(FAULTS)
        getattr(self, name)()
        self.counts[name] += 1

    def robot(self) -> None:
        flow = self._dice.choice(self._flows)
        program = flow.program
        assert program is not None
        program.kill()
        flow.buried(program)
        flow.start()

    def shard(self) -> None:
        kill(self._site.child(f"shard-{self._dice.randrange(SHARDS)}"))

    def server(self) -> None:
        server: Program | None = self._site.server
        assert server is not None
        orphans = family(server.pid)[1:]
        server.kill()
        until("the children of a dead server end", lambda: not any(map(running, orphans)))
        self._site.start_server()

    def node(self) -> None:
        self._site.geth.kill()
        time.sleep(self._dice.uniform(0, 2))
        self._site.geth.start()

    def store(self) -> None:
        """The newest copy is put back, and another is made."""
        shard = self._dice.randrange(SHARDS)
        live = self._site.home.store(shard)
        if shard in self._copies:
            copy_of(self._copies[shard], live)
        copy = self._site.folder / f"copy-{shard}.sqlite"
        copy.unlink(missing_ok=True)
        copy_of(live, copy)
        self._copies[shard] = copy


def run(records: int, robots: int, rate: float, seed: int) -> tuple[list[Count], Counter[str], dict[str, float]]:
    """One soak: a count for each robot, the faults by name, and figures."""
    with tempfile.TemporaryDirectory(prefix="soak-") as folder, ExitStack() as stack:
        site = CliqueSite(Path(folder))
        stack.callback(site.close)
        flows = [SimFlow(site, number, rate, seed + number) for number in range(1, robots + 1)]
        began = time.monotonic()
        for flow in flows:
            flow.start()
        faults, dice = Faults(site, flows, seed), random.Random(seed)
        while (time.monotonic() - began) * rate * robots < records * 1.1:  # a killed robot has lost half a second
            time.sleep(dice.uniform(*GAP))
            faults.next()
            print(f"{time.monotonic() - began:6.0f} s  {dict(faults.counts)}", flush=True)
        for flow in flows:
            assert flow.program is not None
            flow.program.terminate()
            flow.buried(flow.program)
        for flow in flows:
            flow.last_life()
        for flow in flows:
            until(f"all of {flow.name} is on the chain", partial(site.is_done, flow.robot), LONG)
        confirmed = time.monotonic() - began
        counts = [flow.audit() for flow in flows]
        figures = {"seconds to the last confirmation": confirmed, "seconds with reading": time.monotonic() - began,
                   "blocks": float(site.geth.height()),
                   "MiB of the chain's database": size_of(site.folder / "geth"),
                   "MiB of the largest process": resource.getrusage(resource.RUSAGE_CHILDREN).ru_maxrss / 1024}
        return counts, faults.counts, figures


def size_of(folder: Path) -> float:
    return sum(file.stat().st_size for file in folder.rglob("*") if file.is_file()) / 2**20


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--records", type=lambda text: int(text.replace("_", "")), default=1_000_000)
    parser.add_argument("--robots", type=int, default=8)
    parser.add_argument("--rate", type=float, default=500.0, help="messages a second of each robot")
    parser.add_argument("--seed", type=int, default=random.SystemRandom().randrange(1 << 31))
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    print(f"seed {options.seed}")
    counts, faults, figures = run(options.records, options.robots, options.rate, options.seed)
    print(f"\n{table(counts)}\n\nfaults: {dict(faults)}")
    for name, figure in figures.items():
        print(f"{name}: {figure:.0f}")
    total = sum(count.records for count in counts)
    print(f"records: {total}")
    for finding in (finding for count in counts for finding in count.findings):
        print(finding)
    if options.json:
        options.json.write_text(json.dumps({"robots": [asdict(count) for count in counts], "faults": faults,
                                            "figures": figures}, indent=1) + "\n")
    bad = any(count.missing or count.doubled or count.altered or count.findings for count in counts)
    return 1 if bad or total < options.records else 0


if __name__ == "__main__":
    sys.exit(main())
