"""Many robots at once: from their handshakes to the chain, each stage counted and timed.

    python benchmarks/load.py [--sessions 300 500 700] [--messages 10] [--per-chunk 1] [--pace 0]
                              [--store sqlite redis] [--shards 1 2 4] [--runs 3]
                              [--chain anvil|embedded|clique] [--json FILE]

Each store is tried with each number of shards and of sessions. Printed are all counts, and for each of them a line with
messages a second and what limits them.

The paper's blockchain end received 2,994, 4,986 and 6,991 messages of 300, 500
and 700 clients that sent 10 each, and so lost 0.23 % (Security and
Communication Networks 2022, article 7206494, Table 4).

Everything is real but the robots' hardware: every session has an identity,
certificates, an account, a registration in the contract, a spool, a socket and
chunks of the sample bag's Odometry, sealed by the robot's writer; each message
is a chunk of its own, as if it were the only one of its second. The sessions
are spread over a few client processes. Each shard of the server has its UDP
port, store and submitter, and the robots are told what is confirmed. At the end every robot's log is read
back from the chain, compared byte by byte with what was sealed, verified and
opened with the reader's key, and its messages compared with those captured.

All robots of a run begin at the same moment, from one address: the worst case.
They send when all sessions stand, so that handshakes and chunks are timed
apart: everything at once, or with --pace so many messages a second each, as
robots do.
"""

from __future__ import annotations

import argparse
import itertools
import json
import logging
import math
import multiprocessing
import os
import platform
import random
import resource
import secrets
import select
import shutil
import signal
import socket
import subprocess
import sys
import tempfile
import time
from collections import Counter, defaultdict
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from functools import cache, partial
from multiprocessing.connection import Connection
from operator import attrgetter
from pathlib import Path
from typing import Any

import geth_network
from ports import free_port
from rosbridge_eth.capture import Capture, TopicRule, definition_line, stream_line
from rosbridge_eth.channel import Client, ClientConfig, Drop
from rosbridge_eth.channel.protection import Direction
from rosbridge_eth.channel.udp import UdpLoop, client_socket, server_socket
from rosbridge_eth.config import Address, load_server_config
from rosbridge_eth.config.home import OperatorHome, ReaderHome, shard_of
from rosbridge_eth.identity import (
    CertificateAuthority,
    Identity,
    Role,
    Trust,
    load_ca,
    load_identity,
    public_identity,
)
from rosbridge_eth.ledger import Keyring, Ledger
from rosbridge_eth.ledger.contract import Place, Receipt, call_gas
from rosbridge_eth.ledger.nodes import Anvil, EmbeddedChain
from rosbridge_eth.log.chunk import Chunk, Log, drop, robot_id
from rosbridge_eth.log.writer import LogWriter
from rosbridge_eth.operator.bundle import Request, read_bundle
from rosbridge_eth.operator.enrolment import deploy_contract, init_home, load_server_identity, register_robot
from rosbridge_eth.operator.registry import Registry
from rosbridge_eth.reading import Verifier
from rosbridge_eth.robot.sender import Sender
from rosbridge_eth.robot.sources import BagSource, Selection
from rosbridge_eth.robot.sources.bag import sample_bag
from rosbridge_eth.robot.spool import Spool
from rosbridge_eth.server import reception as door
from rosbridge_eth.server.reception import Worker
from rosbridge_eth.server.shard import Shard, open_reception, open_store, open_submitter
from smcrypto import sm2
from spread import across, point

TOPIC = "/robot_1/odom"
FORK = multiprocessing.get_context("fork")
RICH = 100_000
SETTLING = 180.0
BUSY = 0.9  # of the cores there are: from here on they are what limits
MIB = 1 << 20
DURABLE = ("--appendonly", "yes", "--appendfsync", "always", "--maxmemory-policy", "noeviction", "--save", "")


@dataclass
class Use:
    """How many cores were busy during a span, and by whom. rest: the node, Redis, the kernel, whatever else runs."""

    shards: float = 0.0
    submitters: float = 0.0
    robots: float = 0.0
    rest: float = 0.0


@dataclass
class Figures:
    """What one run counted. Seconds, unless the name says otherwise; processor time is the server's own.

    pace: messages a second of each robot, 0: all at once.
    """

    sessions: int
    messages: int
    per_chunk: int
    store: str
    chain: str
    shards: int
    pace: float = 0.0
    load_average: float = 0.0
    established: int = 0
    sent: int = 0
    chunks: int = 0
    stored: int = 0
    on_chain: int = 0
    equal: int = 0
    lost: int = 0
    doubled: int = 0
    altered: int = 0
    unsound: list[str] = field(default_factory=list)
    connecting: float = 0.0
    sending: float = 0.0
    to_chain: float = 0.0
    handshake_cpu_ms: float = 0.0
    message_cpu_ms: float = 0.0
    submitter_cpu_ms: float = 0.0
    opening_ms: float = 0.0
    opened: int = 0
    verifying_ms: float = 0.0
    verified: int = 0
    retransmitted: int = 0
    reconnected: int = 0
    batches: int = 0
    dropped: dict[str, int] = field(default_factory=dict)
    shard_mib: list[float] = field(default_factory=list)
    growth_kib_per_session: float = 0.0
    idle_cpu_ms: float = 0.0  # a session and second in which nothing is said; measured where `idle` is given
    storing: Use = field(default_factory=Use)
    writing: Use = field(default_factory=Use)


# --- the operator: a home, a chain, a contract, robots


class Unwaited(Ledger):
    """The operator's transactions one behind the other, without waiting for the block of each; then `settle`."""

    def __init__(self, where: Any, place: Place, account: str) -> None:
        super().__init__(where, place.contract, place)
        [(self._next, _)] = self.nonces([account])
        self._fees, self._hashes = self.fees(self.block()), list[bytes]()

    def transact(self, account: Any, function: str, *arguments: Any, value: int = 0, wait: float = 120.0) -> Receipt:
        data = self.calldata(function, *arguments)
        signed = self.sign(account, data, nonce=self._next, gas=call_gas(data), fees=self._fees, value=value)
        [refused] = self.send([signed.raw])
        if refused is not None:
            raise refused
        self._next += 1
        self._hashes.append(signed.hash)
        return Receipt(signed.hash, 0, True, 0, None)

    def settle(self) -> None:
        """Until blocks hold all of them."""
        for hash in self._hashes:
            deadline = time.monotonic() + SETTLING
            while (receipt := self.receipt(hash)) is None:
                if time.monotonic() > deadline:
                    raise SystemExit("a registration is in no block")
                time.sleep(0.2)
            if not receipt.succeeded:
                raise SystemExit("a registration failed")


class Operator:
    """An operator's home with many robots registered and funded, and the chain they write to.

    chain: "anvil", "embedded", "clique" (three nodes here, a block a second), or a network that runs elsewhere, where
    `keys` has money. settings: TOML for server.toml, besides what `init` writes.
    """

    def __init__(
        self, folder: Path, chain: str, store: str, robots: int, on_stage: Callable[[str], None], settings: str = "",
        listen: str = "127.0.0.1:0", keys: Keyring | None = None, confirmations: int = 1,
    ) -> None:  # fmt: skip
        self._stack = ExitStack()
        self.folder, self.chain_kind, self.store_kind = folder, chain, store
        self.home, self.reader_home = OperatorHome(folder / "operator"), ReaderHome(folder / "reader")
        self.passphrase, now = secrets.token_hex(16).encode(), datetime.now(UTC)
        on_stage(f"a chain ({chain}) and a contract")
        self.anvil: Anvil | None = None
        where: Any = "http://127.0.0.1:8545"
        if chain == "anvil":
            # Blocks come when there is something to write: the node is not what is measured.
            self.anvil = self._stack.enter_context(Anvil.start(free_port()))
            where = self.anvil.url
        elif chain == "clique":
            keys = Keyring.create()
            network = geth_network.Network(folder / "network", {keys.operator.address: RICH * 10**18})
            self._stack.callback(network.close)
            network.await_blocks(3)
            where = network.nodes[0].url
        elif chain != "embedded":
            where = chain
        self.keys = init_home(
            self.home, self.passphrase, reader=self.reader_home, reader_passphrase=self.passphrase, now=now,
            listen=listen, public="127.0.0.1:7410", chain_url=where,
            keys=keys,
        )
        store_url = self._open_store(folder, store)
        more = f'confirmations = {confirmations}\n\n[store]\nurl = "{store_url}"\n{settings}'
        if "[funds]" not in settings:
            more += "\n[funds]\ngas_per_day = 1_000_000_000_000\n"
        with self.home.config.open("a") as file:
            file.write(more)
        self.config = load_server_config(self.home.config)
        if self.anvil is not None:
            self.anvil.fund(self.keys.operator.address, RICH)
        elif chain == "embedded":
            where = EmbeddedChain(fund={self.keys.operator.address: RICH * 10**18})
        self._where = where
        self.deployment = deploy_contract(self.home, where, self.keys)
        self.ledger = Ledger.connect(where, self.deployment)
        self.server = load_server_identity(self.home, self.passphrase)
        self.reader, roots = load_identity(self.reader_home.path, self.passphrase)
        self.trust = Trust(roots)
        on_stage(f"{robots} robots: keys, certificates, accounts, registrations in the contract")
        ca = load_ca(self.home.ca, self.passphrase, now)
        registrar = Unwaited(where, self.deployment, keys.operator.address) if keys is not None else self.ledger
        started = time.perf_counter()
        self.robots = [self._register(registrar, ca, f"robot_{number}", now) for number in range(1, robots + 1)]
        if isinstance(registrar, Unwaited):
            registrar.settle()
            registrar.close()
        self.registering_ms = (time.perf_counter() - started) / robots * 1000
        self.sealed: dict[bytes, bytes] = {}
        """By digest, the chunks of all runs."""
        self.spools = folder / "spools"
        self.spools.mkdir()

    def _open_store(self, folder: Path, store: str) -> str:
        if store != "redis":
            return store
        port = free_port()
        (folder / "redis").mkdir()
        process = subprocess.Popen(
            ["redis-server", "--port", str(port), "--bind", "127.0.0.1", "--dir", str(folder / "redis"), *DURABLE],
            stdout=subprocess.DEVNULL,
        )
        self._stack.callback(process.wait)
        self._stack.callback(process.kill)
        while socket.socket().connect_ex(("127.0.0.1", port)) != 0:
            time.sleep(0.02)
        return f"redis://127.0.0.1:{port}/0"

    def _register(self, ledger: Ledger, ca: CertificateAuthority, name: str, now: datetime) -> Identity:
        """As `join` and `register` do it; only the keys are kept in no file."""
        keys = [sm2.PrivateKey.generate() for _ in range(2)]
        made = register_robot(
            self.home, name, ca=ca, keys=self.keys, ledger=ledger, now=now, request=Request.make(name, *keys),
            inbox=lambda: open_store(self.config, self.home),
        )
        files = read_bundle(made.bundle.read_bytes()).certificates
        peer = public_identity((files["sign.crt.pem"] + files["enc.crt.pem"]).encode())
        return Identity(Role.ROBOT, name, peer.signing_certificate, peer.encryption_certificate, *keys)

    def close(self) -> None:
        self.ledger.close()
        self._stack.close()

    def connect(self) -> Ledger:
        """The contract, for one process. The embedded chain lives in the process that asks."""
        return Ledger.connect(self._where, self.deployment)

    def serve(self, shard: int, shards: int, sock: socket.socket, submitted: Any, report: Connection) -> None:
        """A shard, as a process; when it is ended, it reads back what the chain has of those robots it is told."""
        stopped, config = _until_terminated(), self.config.model_copy(update={"shards": shards})
        opening, verifying, ledger = _time_calls(Direction, "open"), _time_calls(door, "verify"), self.connect()
        registry, store = Registry(self.home.registry), open_store(config, self.home, shard)
        reception = open_reception(config, self.server, self.home, registry, store, shard)
        submitter = open_submitter(
            config, ledger, open_store(config, self.home, shard), Registry(self.home.registry), self.keys, shard
        )
        turning = _time_calls(submitter, "turn")
        before = resident_kib()

        def note() -> None:
            submitted.value = turning["seconds"]

        Shard(Worker(reception, lambda handle: UdpLoop(reception.server, sock, handle)), submitter).run(
            stopped, on_turn=note
        )
        drops = {str(what): n for what, n in reception.server.statistics().items() if isinstance(what, Drop)}
        served = {"opening": opening, "verifying": verifying, "dropped": drops, "before": before, "peak": peak_kib()}
        own = [robot for robot in self.robots[: report.recv()] if shard_of(robot_id(robot.name), shards) == shard]
        report.send(served | {"found": [read_back(self, ledger, robot) for robot in own]})


@dataclass(frozen=True)
class ReadBack:
    """A robot's log on the chain: its chunks by batch, the lines of its messages by chunk's digest, findings."""

    batches: list[tuple[bytes, ...]]
    lines: dict[bytes, list[bytes]]
    findings: list[str]


def read_back(operator: Operator, ledger: Ledger, robot: Identity) -> ReadBack:
    """As a reader does it; the events by their links, since the embedded chain is slow where there is nothing."""
    tk = robot_id(robot.name)
    [standing] = ledger.standings([tk])
    events = list(ledger.newest_data(tk, standing.data_block))[::-1]
    verifier = Verifier(
        robot.name, ledger.ledger, standing, ledger.registrations(tk, standing), trust=operator.trust,
        reader=operator.reader.encryption_key, block=ledger.block_number(), block_time=ledger.block_time,
        now=time.time(),
    )
    lines = defaultdict[bytes, list[bytes]](list)
    for record in verifier.read(events):
        lines[record.place.digest].append(record.line)
    verdict = verifier.verdict(())
    findings = [] if verdict.sound else [f"{robot.name}: {line}" for line in verdict.lines()]
    return ReadBack([event.chunks for event in events], lines, findings)


def _until_terminated() -> Callable[[], bool]:
    asked: list[int] = []
    signal.signal(signal.SIGTERM, lambda number, frame: asked.append(number))
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    return lambda: bool(asked)


def _time_calls(owner: Any, name: str) -> dict[str, float]:
    """From now on, the processor time that this process spends in a function is added up here."""
    total = {"seconds": 0.0, "calls": 0}
    plain = getattr(owner, name)

    def timed(*arguments: Any) -> Any:
        started = time.thread_time()
        try:
            return plain(*arguments)
        finally:
            total["seconds"] += time.thread_time() - started
            total["calls"] += 1

    setattr(owner, name, timed)
    return total


def _status_kib(name: str) -> int:
    """A line of /proc/self/status; 0 where there is none."""
    try:
        lines = Path("/proc/self/status").read_text().splitlines()
    except OSError:
        return 0
    return next((int(line.split()[1]) for line in lines if line.startswith(name + ":")), 0)


def resident_kib() -> int:
    return _status_kib("VmRSS")


def peak_kib() -> int:
    return _status_kib("VmHWM") or resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


TICK = os.sysconf("SC_CLK_TCK")


def cpu_seconds(pids: Sequence[int]) -> float:
    total = 0.0
    for pid in pids:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        total += (int(fields[11]) + int(fields[12])) / TICK
    return total


def busy_seconds() -> float:
    """Of all cores of this machine, since it started; idle and waiting for a disk are the fourth and fifth figure."""
    fields = [int(field) for field in Path("/proc/stat").read_text().splitlines()[0].split()[1:9]]
    return (sum(fields) - fields[3] - fields[4]) / TICK


# --- the robots' end


@cache
def captured(count: int) -> tuple[list[bytes], str, bytes]:
    """Lines of the sample bag's Odometry as capture writes them, their type, and its definition's line."""
    bag = BagSource(sample_bag(), Selection([TOPIC]), speed=None)
    capture, lines = Capture([TopicRule(TOPIC)], source_kind="bag"), list[bytes]()
    for raw in bag.messages():
        record = capture.process(raw, time.time_ns(), True)
        if record is not None:
            lines.append(record.line)
        if len(lines) == count:
            break
    bag.close()
    if len(lines) < count:
        raise SystemExit(f"the sample bag has {len(lines)} messages on {TOPIC}, not {count}")
    return lines, raw.type_name, definition_line(raw.decoder)


def seal_all(writer: LogWriter, messages: int, per_chunk: int) -> Iterator[Chunk]:
    """A whole stream of so many messages, that says goodbye."""
    lines, type_name, definition = captured(messages)
    now = 0.0
    for number, line in enumerate(lines, 1):
        writer.add(line, now, (type_name, definition))
        if number % per_chunk == 0 and number < messages:
            now += 10.0  # `period` is over
            yield from writer.closed(now, time.time_ns() // 10**6)
    yield from writer.finish(time.time_ns() // 10**6)


class Session:
    """A robot without source and process of its own: writer, spool, sender, channel and socket are the robot's."""

    def __init__(self, operator: Operator, robot: Identity, server: tuple[str, int]) -> None:
        place = Log(operator.ledger.ledger, robot_id(robot.name))
        self.robot, self._operator, self._server, self._place = robot, operator, server, place
        key = robot.signing_key
        self.spool = Spool(
            operator.spools / f"{robot.name}.sqlite", place, max_bytes=64 * MIB, drop=partial(drop, place, key)
        )
        self._chunks: list[Chunk] = []
        self._every, self._due = 0.0, math.inf

    def seal(self, messages: int, per_chunk: int) -> dict[bytes, bytes]:
        self._writer = LogWriter(
            self._place, self.robot.signing_key, [self._operator.reader.encryption_certificate.public_key],
            previous=self.spool.last_digest, newest=self.spool.newest[:16], stream_line=stream_line("bag", "load"),
            now=0.0,
        )
        self._chunks = list(seal_all(self._writer, messages, per_chunk))
        return {chunk.header.digest: chunk.encoded for chunk in self._chunks}

    def connect(self) -> None:
        now = time.monotonic()
        self.client = Client(ClientConfig(), self.robot, self._operator.trust, "server", now)
        self.sender = Sender(self.client, self.spool, self._writer)
        self.sock, address = client_socket(self._server)
        self.client.connect(address, now)

    def begin(self, every: float = 0.0) -> None:
        """What was sealed is there to be sent from now on: all of it, or a chunk every so many seconds."""
        self._every, self._due = every, time.monotonic() + random.random() * every
        if not every:
            self._append(math.inf)

    def _append(self, now: float) -> None:
        while self._chunks and self._due <= now:
            self.spool.append(self._chunks.pop(0))
            self._due += self._every

    def turn(self, now: float, *, readable: bool) -> float:
        """Do what there is to do; when to be called again at the latest."""
        client = self.client
        if readable:
            try:
                while True:
                    data, place = self.sock.recvfrom(2048)
                    client.receive_datagram(data, place[:2], now)
            except (BlockingIOError, ConnectionRefusedError):
                pass
        client.handle_timer(now)
        while (event := client.next_event()) is not None:
            self.sender.handle(event, now)
        self._append(now)
        self.sender.send(now)
        for data, place in client.datagrams_to_send(now):
            self.sock.sendto(data, place)
        return min(client.next_timer() or now + 1, self._due if self._chunks else math.inf)

    @property
    def connected(self) -> bool:
        return self.sender.connected

    @property
    def stored(self) -> bool:
        """The server has everything."""
        return not self._chunks and self.sender.idle

    @property
    def confirmed(self) -> bool:
        """Everything is on the chain, as the server says."""
        return not self._chunks and self.spool.statistics().chunks == 0

    def close(self) -> None:
        self.spool.close()
        self.sock.close()


def client_process(
    operator: Operator, robots: Sequence[Identity], servers: Sequence[tuple[str, int]], messages: int, per_chunk: int,
    report: Connection, limit: float, every: float,
) -> None:
    """Several robots in one process. It reports after each phase and waits for the word to go on."""
    logging.getLogger("rosbridge_eth").setLevel(logging.ERROR)  # that a session takes long is in the figures
    sessions = [Session(operator, robot, servers[shard_of(robot_id(robot.name), len(servers))]) for robot in robots]
    sealed: dict[bytes, bytes] = {}
    for session in sessions:
        sealed |= session.seal(messages, per_chunk)
    report.send(sealed)
    report.recv()
    for session in sessions:
        session.connect()
    drive(sessions, lambda session: session.connected, limit)
    report.send(sum(session.connected for session in sessions))
    drive(sessions, lambda session: False, limit, report)
    report.recv()
    for session in sessions:
        session.begin(every)
    report.send("begun")
    drive(sessions, lambda session: session.stored, limit)
    report.send(sum(session.spool.statistics().unstored for session in sessions))
    drive(sessions, lambda session: session.confirmed, limit)
    report.send({
        "sent": sum(session.sender.sent for session in sessions),
        "refused": sum(session.sender.refused for session in sessions),
        "reconnected": sum(session.sender.sessions - 1 for session in sessions),
        "retransmitted": sum(session.client.statistics()["retransmitted"] for session in sessions),
    })  # fmt: skip
    report.recv()
    for session in sessions:
        session.close()


def drive(
    sessions: Sequence[Session], done: Callable[[Session], bool], limit: float, word: Connection | None = None
) -> None:
    """Until all are done, `limit` seconds have passed, or the word comes."""
    poll, by_fd = select.poll(), {session.sock.fileno(): session for session in sessions}
    for fd in by_fd:
        poll.register(fd, select.POLLIN)
    if word is not None:
        poll.register(word.fileno(), select.POLLIN)
    due, end = dict.fromkeys(by_fd, 0.0), time.monotonic() + limit
    pending = set(by_fd)
    while pending and (now := time.monotonic()) < end:
        ready = {fd for fd, _ in poll.poll(max(0, int((min(due.values()) - now) * 1000)))}
        if word is not None and word.fileno() in ready:
            return
        now = time.monotonic()
        for fd in {fd for fd, when in due.items() if when <= now} | ready:
            due[fd] = by_fd[fd].turn(now, readable=fd in ready)
            if fd in pending and done(by_fd[fd]):
                pending.discard(fd)


# --- a run


@contextmanager
def _processes() -> Iterator[Callable[..., tuple[Any, Connection]]]:
    """Starts processes that each have a pipe to here; none outlives the block."""
    running: list[Any] = []

    def start(target: Callable[..., None], *arguments: Any) -> tuple[Any, Connection]:
        here, there = FORK.Pipe()
        process = FORK.Process(target=target, args=(*arguments, there), daemon=True)
        process.start()
        there.close()
        running.append(process)
        return process, here

    try:
        yield start
    finally:
        for process in running:
            process.kill()
            process.join()


def _use(before: Sequence[float], after: Sequence[float]) -> Use:
    """Cores between two readings of the clock, the machine, the shards, of them the submitters, and the robots."""
    clock, machine, shards, submitters, robots = (b - a for a, b in zip(before, after, strict=True))
    rest = machine - shards - robots
    return Use((shards - submitters) / clock, submitters / clock, robots / clock, rest / clock)


def run(
    operator: Operator, sessions: int, messages: int, *, per_chunk: int = 1, shards: int = 1, clients: int = 2,
    pace: float = 0.0, idle: float = 0.0, limit: float = 240.0, on_stage: Callable[[str], None] = lambda text: None,
) -> Figures:
    """One run with the first `sessions` robots of `operator`; `limit` is for each phase, in seconds.

    pace: messages a second of each robot, 0: all at once. idle: seconds in which the sessions stand and say nothing.
    """
    figures = Figures(sessions, messages, per_chunk, operator.store_kind, operator.chain_kind, shards, pace)
    figures.load_average, figures.sent = os.getloadavg()[0], sessions * messages
    robots = operator.robots[:sessions]
    sockets = [server_socket(Address("127.0.0.1", 0)) for _ in range(shards)]
    addresses, submitted = [sock.getsockname()[:2] for sock in sockets], [FORK.Value("d", 0.0) for _ in sockets]
    lines = captured(messages)[0]  # before the processes are forked, that all have the same
    with _processes() as start:
        serving = [start(operator.serve, number, shards, sock, submitted[number])
                   for number, sock in enumerate(sockets)]  # fmt: skip
        pids = [process.pid for process, _ in serving]

        def client(own: Sequence[Identity], pipe: Connection) -> None:
            every = per_chunk / pace if pace else 0.0
            client_process(operator, own, addresses, messages, per_chunk, pipe, limit, every)

        driving = [start(client, robots[n::clients]) for n in range(clients)]
        ends = [pipe for _, pipe in driving]

        def used() -> list[float]:
            """Seconds so far: the clock's, the machine's, the shards', of them the submitters', the robots'."""
            return [time.perf_counter(), busy_seconds(), cpu_seconds(pids), sum(each.value for each in submitted),
                    cpu_seconds([process.pid for process, _ in driving])]  # fmt: skip

        on_stage(f"{sessions} robots seal {messages} messages each")
        sealed: dict[bytes, bytes] = {}
        for pipe in ends:
            sealed |= pipe.recv()
        operator.sealed |= sealed
        figures.chunks = len(sealed)

        on_stage("handshakes")
        cpu, started = cpu_seconds(pids), time.perf_counter()
        for pipe in ends:
            pipe.send("connect")
        figures.established = sum(pipe.recv() for pipe in ends)
        figures.connecting = time.perf_counter() - started
        figures.handshake_cpu_ms = (cpu_seconds(pids) - cpu) / max(1, figures.established) * 1000

        if idle:
            on_stage(f"{idle:.0f} s of silence")
            before_it = used()
            time.sleep(idle)
            figures.idle_cpu_ms = _use(before_it, used()).shards / sessions * 1000

        on_stage("messages")
        cpu, before = cpu_seconds(pids), sum(each.value for each in submitted)
        for pipe in ends:
            pipe.send("send")
        for pipe in ends:
            pipe.recv()
        started, begun = time.perf_counter(), used()
        figures.stored = figures.chunks - sum(pipe.recv() for pipe in ends)
        figures.sending, figures.storing = time.perf_counter() - started, _use(begun, used())
        writing = sum(each.value for each in submitted) - before
        figures.message_cpu_ms = (cpu_seconds(pids) - cpu - writing) / figures.sent * 1000
        on_stage("the chain")
        reports = [pipe.recv() for pipe in ends]
        figures.to_chain, figures.writing = time.perf_counter() - started, _use(begun, used())
        figures.submitter_cpu_ms = (sum(each.value for each in submitted) - before) / figures.sent * 1000
        for pipe in ends:
            pipe.send("end")
        on_stage("reading back")
        for process, pipe in serving:
            process.terminate()
            pipe.send(sessions)
        served = [pipe.recv() for _, pipe in serving]
    for sock in sockets:
        sock.close()

    for found in [found for one in served for found in one["found"]]:
        # The operator's chain may hold earlier runs of the same robots.
        chunks = [(Chunk.parse(chunk).header.digest, chunk) for batch in found.batches for chunk in batch]
        times = Counter(digest for digest, _ in chunks)
        ours = [digest for digest in times if digest in sealed]
        figures.on_chain += len(ours)
        figures.doubled += sum(count > 1 for count in times.values())
        figures.altered += sum(operator.sealed.get(digest) != chunk for digest, chunk in chunks)
        said = [line for digest in ours for line in found.lines.get(digest, [])]
        figures.equal += sum(one == other for one, other in zip(said, lines, strict=False))
        figures.altered += max(0, len(said) - len(lines))
        figures.unsound += found.findings
        figures.batches += sum(Chunk.parse(batch[0]).header.digest in sealed for batch in found.batches)
    figures.lost = figures.chunks - figures.on_chain
    for name, what in (("opened", "opening"), ("verified", "verifying")):
        setattr(figures, name, int(sum(one[what]["calls"] for one in served)))
        setattr(figures, f"{what}_ms", sum(one[what]["seconds"] for one in served) * 1000)
    figures.dropped = dict(sum((Counter(one["dropped"]) for one in served), Counter()))
    figures.shard_mib = [one["peak"] / 1024 for one in served]
    figures.growth_kib_per_session = sum(one["peak"] - one["before"] for one in served) / sessions
    for name in ("reconnected", "retransmitted"):
        setattr(figures, name, sum(report[name] for report in reports))
    figures.altered += sum(report["refused"] for report in reports)
    return figures


# --- printing


def per_packet(f: Figures) -> float:
    return f.opening_ms / max(1, f.opened)


def table(runs: Sequence[Sequence[Figures]]) -> str:
    """Every count of one load or several, each with its runs."""
    numbers: list[tuple[str, Callable[[Figures], float], str]] = [
        ("sessions established", lambda f: f.established, ",.0f"),
        ("sessions a second, all at once", lambda f: f.established / f.connecting, ".0f"),
        ("server, ms a handshake", lambda f: f.handshake_cpu_ms, ".2f"),
        ("messages sent", lambda f: f.sent, ",.0f"),
        ("chunks", lambda f: f.chunks, ",.0f"),
        ("chunks acknowledged as stored", lambda f: f.stored, ",.0f"),
        ("chunks read back from the chain", lambda f: f.on_chain, ",.0f"),
        ("messages proven, opened and equal", lambda f: f.equal, ",.0f"),
        ("lost", lambda f: f.lost, ",.0f"),
        ("doubled", lambda f: f.doubled, ",.0f"),
        ("altered", lambda f: f.altered, ",.0f"),
        ("server, ms a message, to the store", lambda f: f.message_cpu_ms, ".3f"),
        ("decrypting the channel, ms a packet", per_packet, ".3f"),
        ("decrypting the channel, ms in all", lambda f: f.opening_ms, ".0f"),
        ("verifying, ms a chunk", lambda f: f.verifying_ms / max(1, f.verified), ".3f"),
        ("submitter, ms a message", lambda f: f.submitter_cpu_ms, ".3f"),
        ("first message to last confirmation, s", lambda f: f.to_chain, ".1f"),
        ("transactions", lambda f: f.batches, ",.0f"),
        ("memory of the largest shard, MiB", lambda f: max(f.shard_mib), ".0f"),
        ("memory a session, KiB", lambda f: f.growth_kib_per_session, ".0f"),
        ("packets sent again", lambda f: f.retransmitted, ",.0f"),
        ("sessions made again", lambda f: f.reconnected, ",.0f"),
        ("datagrams that the server dropped", lambda f: sum(f.dropped.values()), ",.0f"),
    ]  # fmt: skip
    lines = ["| | " + " | ".join(title(one[0]) for one in runs) + " |", "| --- |" + " ---: |" * len(runs)]
    lines += [
        f"| {name} | " + " | ".join(across(one, figure).say(form) for one in runs) + " |"
        for name, figure, form in numbers
    ]
    return "\n".join(lines)


def title(f: Figures) -> str:
    paced = f", {f.pace:g} a second each" if f.pace else ""
    return f"{f.store}, {f.shards} shard{'s' * (f.shards > 1)}, {f.sessions} × {f.messages}{paced}"


def limit_of(runs: Sequence[Figures], use: Callable[[Figures], Use]) -> str:
    """What a load waited for: its own pace, the machine, a core of each shard, or none of them."""
    cores, shards = os.cpu_count() or 1, runs[0].shards
    uses = [use(figures) for figures in runs]
    parts = [across(uses, attrgetter(part)).median for part in ("shards", "submitters", "robots", "rest")]
    shares = f"shards {parts[0]:.1f}, submitters {parts[1]:.1f}, robots {parts[2]:.1f}, node and rest {parts[3]:.1f}"
    if runs[0].pace:
        return f"the robots' pace; {sum(parts):.1f} of {cores} cores busy: {shares}"
    if sum(parts) >= BUSY * cores:
        return f"the machine's {cores} cores: {shares}"
    if parts[0] + parts[1] >= BUSY * shards:
        return f"one core a shard: {shares}"
    return f"waiting for disks, store or blocks; {sum(parts):.1f} of {cores} cores busy: {shares}"


def limits(runs: Sequence[Sequence[Figures]]) -> str:
    """A line for each load: messages a second into the store and onto the chain, and what limits each."""
    lines = ["| | messages a second, stored | limited by | confirmed on the chain | limited by |",
             "| --- | ---: | --- | ---: | --- |"]  # fmt: skip
    for one in runs:
        stored, confirmed = (across(one, figure).say(",.0f") for figure in
                             (lambda f: f.sent / f.sending, lambda f: f.sent / f.to_chain))  # fmt: skip
        lines.append(f"| {title(one[0])} | {stored} | {limit_of(one, lambda f: f.storing)} | {confirmed}"
                     f" | {limit_of(one, lambda f: f.writing)} |")  # fmt: skip
    return "\n".join(lines)


def processor() -> str:
    try:
        names = {line.partition(":")[2].strip() for line in Path("/proc/cpuinfo").read_text().splitlines()
                 if line.startswith("model name")}
    except OSError:
        names = set()
    return f"{os.cpu_count()} cores, {', '.join(sorted(names)) or platform.machine()}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--sessions", type=int, nargs="+", default=[300, 500, 700])
    parser.add_argument("--messages", type=int, default=10)
    parser.add_argument("--per-chunk", type=int, default=1, help="messages in a chunk")
    parser.add_argument("--pace", type=float, default=0.0, help="messages a second of each robot; 0: all at once")
    parser.add_argument("--shards", type=int, nargs="+", default=[1])
    parser.add_argument("--store", nargs="+", default=["sqlite"], help="sqlite, redis (started here) or a URL of one")
    parser.add_argument("--runs", type=int, default=1, help="of each; shown are the median, the lowest and the highest")
    parser.add_argument("--chain", choices=["anvil", "embedded", "clique"],
                        default="anvil" if shutil.which("npx") or shutil.which("anvil") else "embedded")
    parser.add_argument("--json", type=Path, help="write the figures here as well")
    options = parser.parse_args()
    began = time.perf_counter()

    def say(text: str) -> None:
        print(f"{time.perf_counter() - began:6.1f} s  {text}", file=sys.stderr, flush=True)

    results: list[list[Figures]] = []
    for store in options.store:
        with tempfile.TemporaryDirectory() as folder:
            operator = Operator(Path(folder), options.chain, store, max(options.sessions), say)
            try:
                for shards, count in itertools.product(options.shards, options.sessions):
                    say(f"{store}, {shards} shards, {count} robots")
                    results.append([
                        run(operator, count, options.messages, per_chunk=options.per_chunk, shards=shards,
                            pace=options.pace, on_stage=say)
                        for _ in range(options.runs)
                    ])  # fmt: skip
            finally:
                operator.close()
    every = [figures for one in results for figures in one]
    loads = point([figures.load_average for figures in every]).say(".1f")
    print(f"{processor()}, Python {platform.python_version()}, load average before a run {loads}; {options.chain}; runs"
          f" of each: {options.runs}, shown as median (lowest–highest)\n\n{table(results)}\n\n{limits(results)}")
    if options.json:
        options.json.write_text(json.dumps([[asdict(figures) for figures in one] for one in results], indent=1))
    for finding in itertools.chain.from_iterable(figures.unsound for figures in every):
        print(finding)
    if any(f.lost or f.doubled or f.altered or f.unsound or f.equal != f.sent for f in every):
        raise SystemExit("records were lost, doubled or altered")


if __name__ == "__main__":
    main()
