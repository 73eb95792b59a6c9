"""What happens to the records when things fail: faults injected into the real processes, and what was counted.

    python benchmarks/faults.py [--fault NAME ...] [--seed N] [--rounds N] [--json FILE]

A node (anvil), a server and robots are started as an operator
starts them, by `python -m rosbridge_eth`. Each robot replays the first 100
Odometry messages of the sample bag, so what it says is known. While they flow, at moments
drawn from the seed, something is killed, filled, cut or confused. Then the
chain is read as a reader does it, and held against two truths that the server
has no part in: the bag, and the robot's own spool, which knows the newest chunk
that was ever sealed; its number says how many the stream has.

`missing` counts chunks that were sealed and are neither on the chain nor a dead
letter nor in the spool. `doubled` counts chunks that the chain has more than
once. Both have to be 0, whatever the fault.

The network between robot and server is a relay (relay.py) that
loses, doubles and reorders; `tc netem` needs a kernel with sch_netem.
"""

from __future__ import annotations

import argparse
import json
import os
import random
import re
import shutil
import signal
import socket
import sqlite3
import subprocess
import sys
import tempfile
import time
import urllib.request
from collections import Counter
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import ExitStack, closing, contextmanager, suppress
from dataclasses import asdict, dataclass, field
from functools import cache
from itertools import pairwise
from pathlib import Path

import rosbridge_eth
from ports import free_port
from relay import Harm, Relay
from rosbridge_eth.capture import Capture, MessageLine, TopicRule, parse_line
from rosbridge_eth.config import load_server_config
from rosbridge_eth.config.home import OperatorHome, ReaderHome, RobotHome
from rosbridge_eth.identity import Trust, load_identity
from rosbridge_eth.ledger import Ledger
from rosbridge_eth.log.chunk import Chunk, Header, robot_id
from rosbridge_eth.log.hop import FORKED
from rosbridge_eth.reading import Kind, ProvenRecord, Verdict, read_robot
from rosbridge_eth.robot.sources import BagSource, Selection
from rosbridge_eth.robot.sources.bag import sample_bag
from rosbridge_eth.server.shard import open_store

TOPIC = "/robot_1/odom"
MESSAGES, PACE = 100, 5  # times as fast as recorded
FLOW = 2.0  # seconds, as it comes to
PATIENCE = 30.0  # seconds within which every recovery has to be over
BAD_NETWORK = Harm(loss=0.2, duplicate=0.1, reorder=0.2)
PACKAGE = Path(rosbridge_eth.__file__).parents[1]
REDIS = ("--appendonly", "yes", "--appendfsync", "always", "--maxmemory-policy", "noeviction", "--save", "")


# Python runs this before anything else; the wall clock is what the file says away from the true one.
SHIFTED_CLOCK = """
import datetime, os, time

true_time, true_time_ns, true_datetime = time.time, time.time_ns, datetime.datetime

def offset():
    with open(os.environ["CLOCK_OFFSET"]) as file:
        return int(file.read() or 0)

class Datetime(true_datetime):
    @classmethod
    def now(cls, tz=None):
        return cls.fromtimestamp(time.time(), tz)

time.time = lambda: true_time() + offset()
time.time_ns = lambda: true_time_ns() + offset() * 10**9
datetime.datetime = Datetime
"""


class Unavailable(Exception):
    """This machine lacks what the fault needs; the text says what."""


class Stuck(AssertionError):
    """Something did not happen within PATIENCE."""


def until(what: str, holds: Callable[[], bool], within: float = PATIENCE) -> None:
    """Wait for another process; Stuck if it takes longer than it may."""
    deadline = time.monotonic() + within
    while not holds():
        if time.monotonic() > deadline:
            raise Stuck(f"{what}: not within {within:.0f} s")
        time.sleep(0.05)


def family(pid: int) -> list[int]:
    """A process and all that descend from it, the eldest first."""
    children: dict[int, list[int]] = {}
    for stat in Path("/proc").glob("[0-9]*/stat"):
        try:
            parts = stat.read_text().rpartition(")")[2].split()
        except OSError:  # it has just ended
            continue
        children.setdefault(int(parts[1]), []).append(int(stat.parent.name))
    found = [pid]
    for member in found:
        found += children.get(member, [])
    return found


def kill(pid: int) -> None:
    """SIGKILL; nothing if it is gone."""
    try:
        os.kill(pid, signal.SIGKILL)
    except ProcessLookupError:
        return


def running(pid: int) -> bool:
    try:
        return Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()[0] != "Z"
    except OSError:
        return False


class Program:
    """`python -m rosbridge_eth ...` as its own process, with what it said in a file."""

    def __init__(self, log: Path, arguments: Sequence[str], environment: Mapping[str, str]) -> None:
        self.log = log
        self._from = log.stat().st_size if log.exists() else 0
        with log.open("ab") as out:
            self._process = subprocess.Popen(
                [sys.executable, "-m", "rosbridge_eth", *arguments], stdin=subprocess.DEVNULL, stdout=out, stderr=out,
                env={**os.environ, "COLUMNS": "200", **environment,
                     "PYTHONPATH": os.pathsep.join([*filter(None, [environment.get("PYTHONPATH")]), str(PACKAGE)])},
            )
        self.pid = self._process.pid

    @property
    def said(self) -> str:
        with self.log.open("rb") as file:
            file.seek(self._from)
            return file.read().decode(errors="replace")

    def ended(self) -> bool:
        return self._process.poll() is not None

    def wait(self, within: float = PATIENCE) -> int:
        try:
            return self._process.wait(within)
        except subprocess.TimeoutExpired:
            raise Stuck(f"{self.log.name} does not end within {within:.0f} s: {self.said[-2000:]}") from None

    def terminate(self) -> int:
        self._process.terminate()
        return self.wait(20)

    def kill(self) -> None:
        self._process.kill()
        self._process.wait()


@dataclass
class Count:
    """One fault's row of the report, in chunks but for `records`."""

    fault: str
    seed: int
    injected: int = 0
    lives: int = 0  # processes of robots, each with a stream of its own
    sealed: int = 0
    acknowledged: int = 0
    on_chain: int = 0
    doubled: int = 0
    altered: int = 0
    missing: int = 0
    declared: int = 0
    records: int = 0  # proven, equal to the bag's
    restarts: int = 0
    sessions: int = 0
    seconds: float = 0.0
    findings: list[str] = field(default_factory=list)
    events: list[str] = field(default_factory=list)


@cache
def known() -> list[MessageLine]:
    """What the bag says, in order."""
    bag = BagSource(sample_bag(), Selection([TOPIC]), speed=None)
    capture = Capture([TopicRule(TOPIC)], source_kind="bag")
    try:
        lines = [parse_line(record.line) for raw in bag.messages() if (record := capture.process(raw, 0, True))]
    finally:
        bag.close()
    return [line for line in lines if isinstance(line, MessageLine)]


@dataclass
class Log:
    """A robot's log as the chain has it: what a reader makes of it, and its chunks in order."""

    verdict: Verdict
    records: list[ProvenRecord]
    chunks: list[Chunk]


# --- one deployment


class Site:
    """An operator's home, a node and a server, as processes. `folder` holds everything; `home` may lie elsewhere."""

    def __init__(self, folder: Path, *, home: Path | None = None, redis: bool = False) -> None:
        self._stack, self.folder = ExitStack(), folder
        self.home, self.reader = OperatorHome(home or folder / "operator"), ReaderHome(folder / "reader")
        self._secret = folder / "passphrase"
        self._secret.write_text("correct horse battery staple\n")
        self._secret.chmod(0o600)
        self.node_port, self.udp_port, self.monitor_port = free_port(), free_port(socket.SOCK_DGRAM), free_port()
        self.redis_port = free_port()
        self.redis: subprocess.Popen[bytes] | None = None
        self.node: Program | None = None
        self.server: Program | None = None
        self.robots = 0
        self._lives: list[Program] = []
        try:
            self._set_up(redis)
        except BaseException:
            self.close()
            raise

    def _set_up(self, redis: bool) -> None:
        self.command("init", "--listen", f"127.0.0.1:{self.udp_port}", "--chain", f"http://127.0.0.1:{self.node_port}",
                     "--reader", str(self.reader.path), "--reader-passphrase-file", str(self._secret),
                     *self._passphrase)
        settings = self.home.config.read_text() + "confirmations = 2\n"
        if redis:
            self.start_redis()
            settings += f'\n[store]\nurl = "redis://127.0.0.1:{self.redis_port}/0"\n'
        settings += "\n[funds]\ngas_per_day = 1_000_000_000_000\n"  # a month's records in an hour
        self.home.config.write_text(f'monitor = "127.0.0.1:{self.monitor_port}"\n{settings}')
        self.start_node()
        self.command("deploy", *self._passphrase)
        self.start_server()

    @property
    def _passphrase(self) -> tuple[str, ...]:
        return "--home", str(self.home.path), "--passphrase-file", str(self._secret)

    def command(self, *arguments: str) -> str:
        """A command that ends, and what it said; AssertionError if it fails."""
        program = Program(self.folder / "commands.log", arguments, {})
        code = program.wait()
        assert code == 0, f"{arguments[0]} ended with {code}: {program.said[-2000:]}"
        return program.said

    def close(self) -> None:
        for program in (*self._lives, self.server, self.node):
            if program is not None and not program.ended():
                for pid in family(program.pid):
                    kill(pid)
                program.kill()
        if self.redis is not None:
            self.redis.kill()
            self.redis.wait()
        self._stack.close()

    def __enter__(self) -> Site:
        return self

    def __exit__(self, *_: object) -> None:
        self.close()

    # The node.

    def start_node(self) -> None:
        self.node = node = Program(
            self.folder / "node.log",
            ["chain", "--home", str(self.home.path), "--port", str(self.node_port), "--block-time", "0.2"], {},
        )
        until("the node answers", lambda: "A local chain runs" in node.said or node.ended())
        assert not node.ended(), node.said

    def kill_node(self, wait: float) -> None:
        """Everything that belongs to it, so many seconds after it has written down that the robot is registered.

        wait: below 4; it writes again after five seconds, and a kill in the middle may cost the file.
        """
        assert self.node is not None
        state, registered = self.home.path / "chain.json", time.time()

        def is_written() -> bool:
            with suppress(OSError, ValueError):
                return state.stat().st_mtime > registered and bool(json.loads(state.read_bytes()))
            return False

        until("the node has written its state", is_written, 20)
        time.sleep(wait)
        for pid in family(self.node.pid):
            kill(pid)
        self.node.kill()

    # The server.

    def start_server(self, **environment: str) -> None:
        self.server = server = Program(
            self.folder / "server.log",
            ["server", "--verbose", *self._passphrase], environment,
        )
        until("the server listens", lambda: "Listening on" in server.said or server.ended())
        assert not server.ended(), server.said[-3000:]

    def restart_server(self, **environment: str) -> None:
        assert self.server is not None
        self.server.terminate()
        self.start_server(**environment)

    def child(self, name: str) -> int:
        """The process that has this name now; waits where it is just being started again."""
        assert self.server is not None
        found: list[int] = []

        def alive() -> bool:
            assert self.server is not None
            pids = re.findall(rf"{name} started, process (\d+)", self.server.said)
            found[:] = [int(pids[-1])] if pids and running(int(pids[-1])) else []
            return bool(found)

        until(f"{name} runs", alive)
        return found[0]

    def start_redis(self) -> None:
        program = shutil.which("redis-server")
        if program is None:
            raise Unavailable("the program 'redis-server' is not installed")
        data = self.folder / "redis"
        data.mkdir(exist_ok=True)
        self.redis = subprocess.Popen(
            [program, "--port", str(self.redis_port), "--bind", "127.0.0.1", "--dir", str(data), *REDIS],
            stdout=subprocess.DEVNULL,
        )
        until("Redis answers", lambda: socket.socket().connect_ex(("127.0.0.1", self.redis_port)) == 0)

    # Robots.

    def register(self) -> str:
        self.robots += 1
        name = f"robot_{self.robots}"
        self.command("register", name, "--password-file", str(self._secret), *self._passphrase)
        return name

    def join(self, name: str, home: Path) -> None:
        self.command("join", str(self.home.bundles / f"{name}.bundle"), "--home", str(home), "--password-file",
                     str(self._secret))

    def revoke(self, name: str) -> None:
        self.command("revoke", name, *self._passphrase)

    def run_robot(self, home: Path, log: Path, environment: Mapping[str, str]) -> Program:
        arguments = ["robot", "--home", str(home), "--password-file", str(self._secret), "--verbose"]
        self._lives.append(Program(log, arguments, environment))
        return self._lives[-1]

    # What became of the records.

    def outstanding(self, robot: bytes) -> str:
        """What the server has still to do for a robot; empty if nothing."""
        with closing(open_store(load_server_config(self.home.config), self.home, read_only=True)) as inbox:
            waiting, [state] = inbox.waiting(robot), inbox.states([robot])
        return f"{waiting.chunks} chunks wait ({state.hold})" if waiting.chunks else ""

    def dead_letters(self, robot: bytes) -> set[bytes]:
        with closing(open_store(load_server_config(self.home.config), self.home, read_only=True)) as inbox:
            return {Chunk.parse(letter.chunk).header.digest for letter in inbox.dead(10_000) if letter.tk == robot}

    def read(self, name: str) -> Log:
        reader, roots = load_identity(self.reader.path, self._secret.read_bytes().strip())
        ledger = Ledger.connect(load_server_config(self.home.config).chain.url, self.home.deployment())
        with closing(ledger):
            reading = read_robot([ledger], name, trust=Trust(roots), reader=reader.encryption_key, now=time.time())
            records = list(reading.records())
            events = ledger.data_events(robot_id(name), 0, ledger.block_number())
            return Log(reading.verdict(), records, [Chunk.parse(data) for event in events for data in event.chunks])

    def figure(self, name: str, port: int | None = None, **labels: str) -> int:
        """One of the counters at /metrics, summed over all processes; 0 where nobody answers."""
        try:
            with urllib.request.urlopen(f"http://127.0.0.1:{port or self.monitor_port}/metrics", timeout=2) as answer:
                text = answer.read().decode()
        except OSError:
            return 0
        wanted = [f'{key}="{value}"' for key, value in labels.items()]
        lines = [line for line in text.splitlines() if re.match(rf"rosbridge_eth_{name}(_total)?[ {{]", line)]
        return int(sum(float(line.rsplit(" ", 1)[1]) for line in lines if all(label in line for label in wanted)))


class Flow:
    """One robot of a site under a fault: its lives, and at the end the account of its records."""

    def __init__(
        self, site: Site, fault: str, seed: int, *, harm: Harm | None = None, home: Path | None = None,
        pace: float = PACE,
    ) -> None:
        self.site, self.count, self.random = site, Count(fault, seed), random.Random(seed)
        self._started = time.monotonic()
        self.name = site.register()
        self.robot = robot_id(self.name)
        self.home = home or site.folder / self.name
        self.relay: Relay | None = None
        self._port = site.udp_port
        if harm is not None:
            self.relay = Relay(("127.0.0.1", site.udp_port), Harm(harm.loss, harm.duplicate, harm.reorder, seed))
            self._port = self.relay.port
        self.monitor, self._pace = free_port(), pace
        self._last: list[bytes] = []  # digests of the newest header of each life
        self._left: dict[bytes, Header] = {}  # what the spool has, by digest; at the end of the newest life
        self._restarts_before = self._restarts()
        self.program: Program | None = None
        self.make_home(self.home)

    def make_home(self, home: Path) -> None:
        """A robot of this name, that replays the bag."""
        self.site.join(self.name, home)
        (home / "robot.toml").write_text(
            f'topics = [{{topic = "{TOPIC}", for = "{MESSAGES // 10}s"}}]\n'
            f'server = "127.0.0.1:{self._port}"\nmonitor = "127.0.0.1:{self.monitor}"\n\n'
            f'[log]\nperiod = "100ms"\n\n[spool]\nmax_size = "1 MiB"\n\n'
            f'[source]\nkind = "bag"\npath = "{sample_bag().resolve()}"\nspeed = {self._pace}\n'
        )

    def event(self, text: str) -> None:
        self.count.injected += 1
        self.count.events.append(text)

    # Lives.

    def start(self, home: Path | None = None, environment: Mapping[str, str] | None = None) -> Program:
        """The robot begins to replay the bag; returns when its session stands."""
        place = home or self.home
        program = self.site.run_robot(place, self.site.folder / f"{place.name}.log", environment or {})
        self.program = program
        until("the robot is connected", lambda: "connected to" in program.said or program.ended())
        assert not program.ended(), program.said[-2000:]
        self.count.lives += 1
        return program

    def pause(self, low: float = 0.1, high: float = 0.8) -> None:
        """Until a moment of the flow that the seed chose."""
        time.sleep(self.random.uniform(low, high) * FLOW)

    def finish(self, program: Program | None = None, home: Path | None = None) -> None:
        """Wait for the robot to end by itself: the server has everything."""
        program = program or self.program
        assert program is not None
        deadline = time.monotonic() + PATIENCE
        while not program.ended():
            if time.monotonic() > deadline:
                raise Stuck(f"{self.name} does not end: {program.said[-3000:]}")
            time.sleep(0.2)
        code = program.wait()
        assert code == 0, f"the robot ended with {code}: {program.said[-3000:]}"
        self.buried(program, home)

    def buried(self, program: Program, home: Path | None = None) -> None:
        """A robot's process is no more: its spool says what it ever sealed, and what it still has."""
        spool = RobotHome(home or self.home).spool
        with tempfile.TemporaryDirectory() as copy:
            for part in spool.parent.glob(spool.name + "*"):
                if not part.name.endswith("-shm"):
                    shutil.copy(part, copy)
            with closing(sqlite3.connect(Path(copy) / spool.name)) as found:
                self._last += [digest for (digest,) in found.execute("SELECT digest FROM robot") if any(digest)]
                chunks = [Chunk.parse(data) for (data,) in found.execute("SELECT chunk FROM chunk")]
        self._left = {chunk.header.digest: chunk.header for chunk in chunks}
        self.count.sessions += program.said.count(" connected to ")

    # The account.

    def _restarts(self) -> int:
        log = self.site.folder / "server.log"
        return log.read_text(errors="replace").count("it is started again") if log.exists() else 0

    def audit(self, *, allow: frozenset[Kind] = frozenset()) -> Count:
        """Wait until the server is done, read the chain, and compare. Sets every figure of the count.

        allow: violations that this fault is meant to show.
        """
        count, site = self.count, self.site
        try:
            until("the server has nothing left to do", lambda: not site.outstanding(self.robot))
        except Stuck as stuck:
            said = site.server.said[-3000:] if site.server is not None else ""
            raise Stuck(f"{stuck}: {site.outstanding(self.robot)}\n{said}") from None
        log = site.read(self.name)
        if self.relay is not None:
            self.relay.close()
        headers = {chunk.header.digest: chunk.header for chunk in log.chunks}
        written = Counter((chunk.header.stream, chunk.header.number) for chunk in log.chunks)
        sealed = set(self._sealed(self._left | headers))
        waiting = {(header.stream, header.number) for header in self._left.values()}
        dead = {(headers[digest].stream, headers[digest].number) for digest in site.dead_letters(self.robot)
                if digest in headers}
        named = sealed - written.keys() & (waiting | dead)
        count.sealed, count.on_chain = len(sealed), len(sealed & written.keys())
        count.acknowledged = len(sealed) - len(named)
        count.doubled = sum(times - 1 for times in written.values())
        dropped = sum(chunk.bare for chunk in log.chunks)
        count.declared = dropped + len((sealed - written.keys()) & (waiting | dead))
        count.missing = len(sealed - written.keys() - waiting - dead) + count.missing
        count.records = len(log.records)
        count.altered = len(written.keys() - sealed) + self._unlike_the_bag(log)
        count.restarts += self._restarts() - self._restarts_before
        count.findings = [str(found) for found in log.verdict.findings
                          if found.kind.violation and found.kind not in allow]
        count.seconds = time.monotonic() - self._started
        return count

    def _sealed(self, headers: Mapping[bytes, Header]) -> Iterator[tuple[bytes, int]]:
        """Stream and number of every chunk ever sealed: a stream has those up to its newest."""
        newest: dict[bytes, int] = {}
        for digest in self._last:
            header = headers.get(digest)
            if header is None:
                self.count.missing += 1
            else:
                newest[header.stream] = max(header.number, newest.get(header.stream, 0))
        for header in headers.values():  # a stream that began within a life, because the server refused the one before
            if header.stream not in newest:
                newest[header.stream] = max(h.number for h in headers.values() if h.stream == header.stream)
        for stream, last in newest.items():
            yield from ((stream, number) for number in range(last + 1))

    def _unlike_the_bag(self, log: Log) -> int:
        """Records that are not the bag's message at their place: each life says the bag from its start."""
        expected, unlike = known(), 0
        streams: dict[bytes, list[MessageLine]] = {}
        for record in log.records:
            streams.setdefault(record.place.stream, []).append(record.content)
        place = {record.received_ns: number for number, record in enumerate(expected)}
        for said in streams.values():
            order = [place.get(record.received_ns, -1) for record in said]
            unlike += sum(before >= after for before, after in pairwise(order))
            unlike += sum(number < 0 or expected[number].data != record.data
                          for number, record in zip(order, said, strict=True))
        return unlike


# --- the faults


def kill_robot(site: Site, seed: int) -> Count:
    """kill -9 of the robot, twice; each time it starts again on the spool it left."""
    flow = Flow(site, "robot killed", seed)
    for _ in range(2):
        program = flow.start()
        flow.pause()
        program.kill()
        flow.event("kill -9 robot")
        flow.buried(program)
        flow.count.restarts += 1
    flow.start()
    flow.finish()
    return flow.audit()


def kill_shard(site: Site, seed: int) -> Count:
    """kill -9 of the shard, with its submitter between any two of its writes; twice."""
    flow = Flow(site, "shard killed", seed)
    flow.start()
    for _ in range(2):
        flow.pause(0.1, 0.5)
        kill(site.child("shard-0"))
        flow.event("kill -9 shard-0")
    flow.finish()
    return flow.audit()


def kill_server(site: Site, seed: int) -> Count:
    """kill -9 of the server's parent: its children end by themselves, and a new server takes over."""
    flow = Flow(site, "server killed", seed)
    flow.start()
    flow.pause(0.2, 0.6)
    assert site.server is not None
    orphans = family(site.server.pid)[1:]
    site.server.kill()
    flow.event("kill -9 server")
    site.start_server()
    flow.count.restarts += 1
    until("the children of a dead server end", lambda: not any(map(running, orphans)), 15)
    flow.finish()
    return flow.audit()


def kill_node(site: Site, seed: int) -> Count:
    """kill -9 of the node; it comes back with the blocks of its state file, and without the later ones."""
    flow = Flow(site, "node killed", seed)
    flow.start()
    flow.pause(0.3, 0.9)
    site.kill_node(flow.random.uniform(0, 3))
    flow.event("kill -9 node")
    flow.pause(0.1, 0.5)
    site.start_node()
    flow.count.restarts += 1
    flow.finish()
    return flow.audit()


def kill_redis(site: Site, seed: int) -> Count:
    """kill -9 of the Redis that holds the store; its append-only file brings it back."""
    flow = Flow(site, "Redis killed", seed)
    flow.start()
    for _ in range(2):
        flow.pause(0.1, 0.4)
        assert site.redis is not None
        site.redis.kill()
        site.redis.wait()
        flow.event("kill -9 redis-server")
        flow.pause(0.05, 0.2)
        site.start_redis()
        flow.count.restarts += 1
    flow.finish()
    return flow.audit()


def bad_network(site: Site, seed: int) -> Count:
    """20 % of the datagrams lost each way, others doubled and reordered."""
    flow = Flow(site, "bad network", seed, harm=BAD_NETWORK)
    flow.start()
    flow.finish()
    assert flow.relay is not None
    flow.count.injected = flow.relay.lost
    flow.count.events.append(f"{flow.relay.lost} datagrams lost")
    return flow.audit()


def everything(site: Site, seed: int) -> Count:
    """A bad network, and on it a robot and the shard, twice, killed in an order that the seed chose."""
    flow = Flow(site, "several at once", seed, harm=BAD_NETWORK)
    program = flow.start()
    for victim in flow.random.sample(["shard-0", "shard-0", "robot"], 3):
        flow.pause(0.05, 0.3)
        flow.event(f"kill -9 {victim}")
        if victim == "robot":
            program.kill()
            flow.buried(program)
            flow.count.restarts += 1
            program = flow.start()
        else:
            kill(site.child(victim))
    flow.finish()
    return flow.audit()


@contextmanager
def small_disk(folder: Path, size: str) -> Iterator[Path]:
    """A file system of its own."""
    folder.mkdir()
    mount, umount = shutil.which("mount"), shutil.which("umount")
    if not mount or not umount or subprocess.run(
        [mount, "-t", "tmpfs", "-o", f"size={size},mode=700", "tmpfs", folder], capture_output=True
    ).returncode:
        raise Unavailable("a small file system cannot be mounted here (needs root)")
    try:
        yield folder
    finally:
        subprocess.run([umount, "-l", folder], check=True)


def fill_up(folder: Path) -> Path:
    """Leave no room; removing the file that is returned makes it again."""
    ballast = folder / "ballast"
    with ballast.open("wb", buffering=0) as file:
        try:
            while True:
                file.write(bytes(4096))
        except OSError:
            return ballast


def full_disk_of_robot(site: Site, seed: int) -> Count:
    """The disk of the robot's spool is full for a while, and the server does not answer: what is new can go nowhere."""
    with small_disk(site.folder / f"disk-{seed}-{site.robots}", "2m") as disk:
        flow = Flow(site, "robot's disk full", seed, home=disk / "robot")
        program = flow.start()
        flow.pause(0.05, 0.3)
        shard = site.child("shard-0")
        os.kill(shard, signal.SIGSTOP)
        try:
            ballast = fill_up(disk)
            flow.event("the disk of the spool is full, and the server does not answer")
            flow.pause(0.3, 0.5)
        finally:
            os.kill(shard, signal.SIGCONT)
        flow.pause(0.1, 0.3)
        ballast.unlink()
        flow.finish(program)
        return flow.audit()


def full_disk_of_server(site: Site, seed: int) -> Count:
    """The disk of the server's store is full for a while: nothing is acknowledged that is not kept."""
    disk = site.home.path.parent
    if not os.path.ismount(disk):
        raise Unavailable("the server's home is on no disk of its own (needs root)")
    site.restart_server()  # so that the logs of the databases are short and have to grow
    flow = Flow(site, "server's disk full", seed)
    program = flow.start()
    flow.pause(0.1, 0.3)
    ballast = fill_up(disk)
    flow.event("the disk of the store is full")
    assert site.server is not None
    server = site.server
    until("the server says that it takes nothing", lambda: "the store: " in server.said, 20)
    flow.pause(0.2, 0.5)
    ballast.unlink()
    flow.finish(program)
    return flow.audit()


def clock_jumps(site: Site, seed: int) -> Count:
    """The wall clocks of server and robot jump, forward and back; what is measured in seconds goes on."""
    folder = site.folder / f"clock-{seed}"
    folder.mkdir()
    (folder / "sitecustomize.py").write_text(SHIFTED_CLOCK)
    offset = folder / "offset"
    offset.write_text("0")
    fake = {"PYTHONPATH": str(folder), "CLOCK_OFFSET": str(offset)}
    site.restart_server(**fake)
    try:
        flow = Flow(site, "clock jumps", seed)
        flow.start(environment=fake)
        # A day is what a stream of records lasts: the robot goes on in a new one.
        for jump in flow.random.sample([86_400, flow.random.choice([-7200, -600, 3600])], 2):
            flow.pause(0.1, 0.4)
            offset.write_text(str(jump))
            flow.event(f"clocks of server and robot at {jump:+} s")
        flow.finish()
        return flow.audit()
    finally:
        site.restart_server()


def revoked(site: Site, seed: int) -> Count:
    """The robot is revoked while it sends: its session ends, what it handed over is written, the rest has a name."""
    flow = Flow(site, "robot revoked", seed, pace=0.2)  # it would go on for 50 s
    program = flow.start()
    flow.pause(0.3, 0.9)
    site.revoke(flow.name)
    flow.event("revoked")
    until("the robot's session is closed", lambda: "disconnected" in program.said, 20)
    time.sleep(1.5)
    assert program.said.count("connected to") == 1, f"a revoked robot got a session: {program.said[-2000:]}"
    assert program.terminate() == 0, program.said[-2000:]
    flow.buried(program)
    return flow.audit()


def twins(site: Site, seed: int) -> Count:
    """Two robots with one identity: one goes on, the other keeps what it says, and both and the server are told."""
    flow = Flow(site, "one identity twice", seed)
    double = site.folder / f"{flow.name}-double"
    flow.make_home(double)
    settings = double / "robot.toml"
    settings.write_text(settings.read_text().replace(f":{flow.monitor}", f":{free_port()}"))
    first = flow.start()
    flow.pause(0.1, 0.3)
    second = flow.start(double)
    flow.event("a second robot with the same keys")
    flow.finish(second, double)
    until("the first robot is told", lambda: FORKED in first.said)
    log = site.folder / "server.log"
    until("the server tells it", lambda: FORKED in log.read_text(errors="replace"))
    assert first.terminate() == 0
    flow.buried(first)
    count = flow.audit(allow=frozenset({Kind.FORKED, Kind.MISSING}))
    told = {found.kind for found in site.read(flow.name).verdict.findings}
    if not told & {Kind.RESTARTED, Kind.FORKED, Kind.MISSING}:
        count.findings.append("the reader is not told that the second log knows nothing of the first")
    return count


FAULTS: dict[str, Callable[[Site, int], Count]] = {
    "robot": kill_robot,
    "shard": kill_shard,
    "server": kill_server,
    "node": kill_node,
    "network": bad_network,
    "several": everything,
    "robot-disk": full_disk_of_robot,
    "server-disk": full_disk_of_server,
    "clock": clock_jumps,
    "revoked": revoked,
    "twins": twins,
    "redis": kill_redis,
}
ON_REDIS = {"redis"}


@contextmanager
def open_site(folder: Path, *, redis: bool = False) -> Iterator[Site]:
    """A site whose home lies on a disk of its own where one can be mounted."""
    if shutil.which("anvil") is None and shutil.which("npx") is None:
        raise Unavailable("neither 'anvil' nor 'npx' is installed")
    with ExitStack() as stack:
        try:
            disk = stack.enter_context(small_disk(folder / "server-disk", "64m"))
        except Unavailable:
            disk = folder / "no-disk"
            disk.mkdir()
        yield stack.enter_context(Site(folder, home=disk / "operator", redis=redis))


def table(counts: Sequence[Count]) -> str:
    heads: list[str | int] = ["fault", "times", "lives", "sealed", "acked", "on chain", "doubled", "altered", "missing",
                              "declared", "records", "restarts", "sessions", "s"]
    rows: list[list[str | int]] = [
        [c.fault, c.injected, c.lives, c.sealed, c.acknowledged, c.on_chain, c.doubled, c.altered, c.missing,
         c.declared, c.records, c.restarts, c.sessions, f"{c.seconds:.0f}"] for c in counts
    ]
    widths = [max(len(str(row[i])) for row in [heads, *rows]) for i in range(len(heads))]
    return "\n".join(
        "  ".join(str(cell).ljust(width) if i == 0 else str(cell).rjust(width)
                  for i, (cell, width) in enumerate(zip(row, widths, strict=True)))
        for row in [heads, *rows]
    )


def main() -> int:
    parser = argparse.ArgumentParser(description=(__doc__ or "").partition("\n")[0])
    parser.add_argument("--fault", nargs="+", choices=FAULTS, default=list(FAULTS))
    parser.add_argument("--seed", type=int, default=random.SystemRandom().randrange(1 << 31))
    parser.add_argument("--rounds", type=int, default=1, help="each fault so many times, with the seeds that follow")
    parser.add_argument("--json", type=Path)
    options = parser.parse_args()
    print(f"seed {options.seed}")
    counts: list[Count] = []
    for redis in (False, True):
        chosen = [name for name in options.fault if (name in ON_REDIS) == redis]
        if not chosen:
            continue
        with tempfile.TemporaryDirectory(prefix="faults-") as folder, open_site(Path(folder), redis=redis) as site:
            for name in chosen:
                for number in range(options.rounds):
                    try:
                        count = FAULTS[name](site, options.seed + number)
                    except Unavailable as reason:
                        print(f"{name}: left out, {reason}")
                        continue
                    counts.append(count)
                    print(f"{count.fault}: {'; '.join(count.events)}; {count.seconds:.0f} s", flush=True)
    print(f"\n{table(counts)}")
    bad = [count for count in counts if count.missing or count.doubled or count.altered or count.findings]
    for count in bad:
        print(f"\n{count.fault} (seed {count.seed}):", *count.findings, sep="\n  ")
    if options.json:
        options.json.write_text(json.dumps([asdict(count) for count in counts], indent=1) + "\n")
    return 1 if bad else 0


if __name__ == "__main__":
    sys.exit(main())
