"""Many robots at once: from their handshakes to the chain, each stage counted and timed.

    python benchmarks/load.py [--sessions 300 500 700] [--messages 10] [--store sqlite|redis|URL]
                              [--chain anvil|embedded] [--workers 2] [--json FILE]

The paper's blockchain end received 2,994, 4,986 and 6,991 messages of 300, 500
and 700 clients that sent 10 each, and so lost 0.23 % (Security and
Communication Networks 2022, article 7206494, Table 4).

Everything is real but the robots' hardware: every session has an identity,
certificates, an account, a registration in the contract, a socket and records
sealed from the sample bag's Odometry. The sessions are spread over a few
client processes. The server's workers share one UDP port, commit to the inbox
and answer; the submitter writes to the chain; at the end every robot's history
is fetched from there and compared byte by byte with what was sealed.

All robots of a run begin at the same moment, from one address: the worst case.
They send when all sessions stand, so that handshakes and messages are timed
apart.
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import platform
import resource
import secrets
import select
import shutil
import signal
import socket
import subprocess
import tempfile
import time
from collections import Counter, deque
from collections.abc import Callable, Iterator, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import asdict, dataclass, field
from datetime import UTC, datetime
from functools import partial
from hashlib import blake2b
from multiprocessing.connection import Connection
from pathlib import Path
from typing import Any

from rosbridge_eth import identity as ids
from rosbridge_eth import ledger, protocol
from rosbridge_eth.capture import Capture, TopicRule
from rosbridge_eth.channel import Client, ClientConfig, Connected, Disconnected, MessageAnswered
from rosbridge_eth.channel.protection import Direction
from rosbridge_eth.channel.udp import client_socket, server_sockets
from rosbridge_eth.config import load_server_config
from rosbridge_eth.home import OperatorHome
from rosbridge_eth.ledger.accounts import Keyring
from rosbridge_eth.ledger.embedded import EmbeddedChain
from rosbridge_eth.protocol import Ack, RecordRequest
from rosbridge_eth.reading import join_certificates
from rosbridge_eth.records import RecordId, SealedRecord
from rosbridge_eth.registry import Registry
from rosbridge_eth.sealing import Sealer
from rosbridge_eth.server.administration import (
    allot,
    ca_certificate,
    deploy_contract,
    init_home,
    load_ca,
    load_server_identity,
    server_trust,
)
from rosbridge_eth.server.assembly import bound_contract, open_inbox, open_journal, open_submission, open_worker
from rosbridge_eth.sources import BagSettings, Selection
from rosbridge_eth.sources.bag import BagSource
from rosbridge_eth.sources.sample import sample_bag

TOPIC = "/robot_1/odom"
PAPER = {300: 2994, 500: 4986, 700: 6991}
BUSY_PAUSE = 0.2  # s
FORK = multiprocessing.get_context("fork")
RICH = 100_000 * 10**18
DURABLE = ("--appendonly", "yes", "--appendfsync", "always", "--maxmemory-policy", "noeviction", "--save", "")


@dataclass(frozen=True)
class Robot:
    """One session's secrets and place."""

    identity: ids.Identity
    number: int

    @property
    def tk(self) -> bytes:
        return self.identity.public.robot_id


@dataclass
class Figures:
    """What one run counted. Seconds, unless the name says otherwise; processor time is the server's own."""

    sessions: int
    messages: int
    store: str
    chain: str
    workers: int
    load_average: float = 0.0
    established: int = 0
    sent: int = 0
    stored: int = 0
    on_chain: int = 0
    lost: int = 0
    doubled: int = 0
    altered: int = 0
    connecting: float = 0.0
    sending: float = 0.0
    to_chain: float = 0.0
    handshake_cpu_ms: float = 0.0
    message_cpu_ms: float = 0.0
    opening_ms: float = 0.0
    opened: int = 0
    retransmitted: int = 0
    reconnected: int = 0
    busy: int = 0
    batches: int = 0
    dropped: dict[str, int] = field(default_factory=dict)
    worker_mib: list[float] = field(default_factory=list)
    growth_kib_per_session: float = 0.0
    submitter_mib: float = 0.0


def digest(ciphertext: bytes) -> bytes:
    return blake2b(ciphertext, digest_size=16).digest()


# --- the operator: a home, a chain, a contract, robots


class Operator:
    """An operator's home with many robots enrolled, registered and funded, and the chain they write to."""

    def __init__(self, folder: Path, chain: str, store: str, robots: int, on_stage: Callable[[str], None]) -> None:
        self._stack = ExitStack()
        self.home, self.chain_kind, self.store_kind = OperatorHome(folder / "operator"), chain, store
        passphrase, now = secrets.token_hex(16).encode(), datetime.now(UTC)
        on_stage(f"a chain ({chain}) and a contract")
        url = "embedded"
        if chain == "anvil":
            from rosbridge_eth.ledger import anvil

            # Blocks come when there is something to write: the node is not what is measured.
            url = self._stack.enter_context(anvil.start(_free_port())).url
        init_home(self.home, passphrase, listen="127.0.0.1:0", public=None, chain_url=url, server="server", now=now)
        store_url = self._open_store(folder, store)
        with self.home.config.open("a") as file:
            file.write(f'confirmations = 1\n\n[store]\nurl = "{store_url}"\n')
        self.config = load_server_config(self.home.config)
        self.keys = Keyring.load(self.home.accounts, passphrase)
        self.chain: Any
        if chain == "anvil":
            self.chain = ledger.connect(url)
            self.chain.request("anvil_setBalance", self.keys.operator.address, hex(RICH))
        else:
            self.chain = EmbeddedChain(fund={self.keys.operator.address: RICH})
        self.deployment = deploy_contract(self.home, self.chain, self.keys)
        self.contract = bound_contract(self.chain, self.deployment)
        self.server = load_server_identity(self.home, passphrase)
        ca = load_ca(self.home, passphrase)
        self.reader = ids.enrol(ca, ids.Role.READER, "load", at=now)
        on_stage(f"{robots} robots: keys, certificates, accounts, registrations in the contract")
        registry = Registry(self.home.registry)
        self.robots = [self._register(registry, ca, number, now) for number in range(1, robots + 1)]
        registry.close()

    def _open_store(self, folder: Path, store: str) -> str:
        if store != "redis":
            return store
        port = _free_port()
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

    def _register(self, registry: Registry, ca: ids.CertificateAuthority, number: int, now: datetime) -> Robot:
        """As `register` does it, without a bundle."""
        robot = Robot(ids.enrol(ca, ids.Role.ROBOT, f"robot_{number}", at=now), registry.next_number())
        peer, account = robot.identity.public, self.keys.robot(robot.number).address
        certificates = join_certificates(peer.signing_certificate.to_der(), peer.encryption_certificate.to_der())
        self.contract.transact(self.keys.operator, "registration", robot.tk, account, certificates)
        allot(self.contract, self.keys, account, self.config)
        registry.enrol(
            number=robot.number, role=peer.role, name=peer.name, account=account, now=now, replace=False,
            fingerprint=peer.signing_certificate.fingerprint(),
            certificates=peer.signing_certificate.to_pem() + peer.encryption_certificate.to_pem(),
        )
        return robot

    def close(self) -> None:
        self.chain.close()
        self._stack.close()

    # The server's processes, made of the parts that the supervisor forks.

    def work(self, number: int, sock: socket.socket, report: Connection) -> None:
        stopped = _until_terminated()
        opening = _time_opening()
        registry = Registry(self.home.registry)
        worker = open_worker(
            number, sock, config=self.config, identity=self.server, trust=server_trust(self.home, registry),
            registry=registry, inbox=open_inbox(self.config, self.home),
            journal=open_journal(self.home, self.deployment), deployment=self.deployment,
        )
        before = resident_kib()
        worker.run(stopped)
        statistics = worker.server.statistics()
        report.send({
            "opening": opening, "dropped": dict(statistics.dropped), "acks": dict(worker.reception.acks),
            "before": before, "peak": peak_kib(), "handshakes": statistics.handshakes,
        })

    def submit(self, confirmed: Any, report: Connection) -> None:
        """The submitter; when it is ended, it reads back what the chain holds of the robots it is given."""
        stopped = _until_terminated()
        chain = self.chain if self.chain_kind == "embedded" else ledger.connect(self.config.chain.url)
        contract = bound_contract(chain, self.deployment)
        batches = 0

        def count(timing: ledger.BatchTiming) -> None:
            nonlocal batches
            batches += 1
            confirmed.value += timing.records

        submission = open_submission(
            config=self.config, contract=contract, journal=open_journal(self.home, self.deployment),
            inbox=open_inbox(self.config, self.home), registry=Registry(self.home.registry), keys=self.keys,
            on_confirmed=count,
        )
        submission.run(stopped)
        peak = peak_kib()
        found: list[tuple[RecordId, bytes]] = []
        for tk in report.recv():
            history = ledger.fetch(chain, contract, tk)
            history.require_sound()
            found += [(one.record.id, digest(one.record.ciphertext)) for one in history.records]
        report.send({"found": found, "peak": peak, "batches": batches})


def _until_terminated() -> Callable[[], bool]:
    asked: list[int] = []
    signal.signal(signal.SIGTERM, lambda number, frame: asked.append(number))
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    return lambda: bool(asked)


def _time_opening() -> dict[str, float]:
    """From now on, the processor time that this process takes to decrypt and authenticate packets is added up here."""
    total = {"seconds": 0.0, "packets": 0}
    plain = Direction.open

    def timed(self: Direction, datagram: bytes, number: int) -> bytes:
        started = time.thread_time()
        try:
            return plain(self, datagram, number)
        finally:
            total["seconds"] += time.thread_time() - started
            total["packets"] += 1

    Direction.open = timed  # type: ignore[method-assign]
    return total


def _free_port() -> int:
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port: int = probe.getsockname()[1]
        return port


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


def cpu_seconds(pids: Sequence[int]) -> float:
    total = 0.0
    for pid in pids:
        fields = Path(f"/proc/{pid}/stat").read_text().rpartition(")")[2].split()
        total += (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    return total


# --- the robots' end


def payloads(count: int) -> list[bytes]:
    """Captured Odometry of the sample bag, as robots seal it."""
    bag = BagSource(BagSettings(sample_bag(), speed=None), Selection([TOPIC]))
    capture, captured = Capture([TopicRule(TOPIC)]), list[bytes]()
    for raw in bag.messages():
        record = capture.process(raw, time.time_ns(), time.monotonic_ns(), True)
        if record is not None:
            captured.append(record.to_json())
        if len(captured) == count:
            break
    bag.close()
    return captured


class Session:
    """A robot as the server sees it: sends its records, keeps each until it is acknowledged as stored."""

    def __init__(self, robot: Robot, trust: ids.Trust, server: tuple[str, int], records: list[SealedRecord]) -> None:
        now = time.monotonic()
        self.client = Client(ClientConfig(), robot.identity, trust, "server", now)
        self.sock, address = client_socket(server)
        self.records, self.todo = records, deque[SealedRecord]()
        self.waiting: dict[int, SealedRecord] = {}
        self.stored: set[RecordId] = set()
        self.connected, self.sessions, self.busy, self.resume_at = False, 0, 0, 0.0
        self.other: list[Ack] = []
        self.client.connect(address, now)

    def begin(self) -> None:
        self.todo.extend(self.records)

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
            if isinstance(event, Connected):
                self.connected = True
                self.sessions += 1
            elif isinstance(event, Disconnected):
                self.connected = False
                self.todo.extendleft(reversed([self.waiting.pop(id) for id in event.unanswered]))
            elif isinstance(event, MessageAnswered):
                self._answered(self.waiting.pop(event.message_id), protocol.decode_ack(event.payload), now)
        while self.todo and now >= self.resume_at and client.writable(now):
            record = self.todo.popleft()
            self.waiting[client.send(protocol.encode_request(RecordRequest(record)))] = record
        for data, place in client.datagrams_to_send(now):
            self.sock.sendto(data, place)
        due = client.next_timer() or now + 1
        return max(now, min(due, self.resume_at)) if self.todo and self.connected else due

    def _answered(self, record: SealedRecord, ack: Ack, now: float) -> None:
        if ack is Ack.STORED:
            self.stored.add(record.id)
        elif ack is Ack.BUSY:
            self.busy += 1
            self.todo.appendleft(record)
            self.resume_at = now + BUSY_PAUSE
        else:
            self.other.append(ack)

    @property
    def finished(self) -> bool:
        return len(self.stored) + len(self.other) == len(self.records)


def client_process(
    operator: Operator, robots: Sequence[Robot], server: tuple[str, int], messages: int, report: Connection,
    limit: float,
) -> None:
    """Several robots in one process. It reports after each phase and waits for the word to go on."""
    trust = ids.Trust((ca_certificate(operator.home),))
    captured = payloads(messages)
    key = operator.reader.encryption_certificate.public_key
    sealed: list[list[SealedRecord]] = []
    for robot in robots:
        sealer = Sealer(robot.tk, partial(ids.sign, robot.identity.signing_key), [key])
        sealed.append([record for payload in captured for record in sealer.seal(payload, time.time_ns())])
    report.send({record.id: digest(record.ciphertext) for records in sealed for record in records})
    report.recv()
    sessions = [Session(robot, trust, server, own) for robot, own in zip(robots, sealed, strict=True)]
    _drive(sessions, lambda session: session.connected, limit)
    report.send(sum(session.connected for session in sessions))
    _drive(sessions, lambda session: False, limit, report)
    report.recv()
    for session in sessions:
        session.begin()
    _drive(sessions, lambda session: session.finished, limit)
    report.send({
        "stored": {id for session in sessions for id in session.stored},
        "busy": sum(session.busy for session in sessions),
        "reconnected": sum(session.sessions - 1 for session in sessions),
        "retransmitted": sum(session.client.statistics().frames_retransmitted for session in sessions),
        "other": Counter(ack.name for session in sessions for ack in session.other),
    })
    report.recv()


def _drive(
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
            if done(by_fd[fd]):
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

    yield start
    for process in running:
        process.kill()
        process.join()


def run(
    operator: Operator, sessions: int, messages: int, *, workers: int = 2, clients: int = 2, limit: float = 240.0,
    on_stage: Callable[[str], None] = lambda text: None,
) -> Figures:
    """One run with the first `sessions` robots of `operator`; `limit` is for each phase, in seconds."""
    figures = Figures(sessions, messages, operator.store_kind, operator.chain_kind, workers)
    figures.load_average = os.getloadavg()[0]
    robots = operator.robots[:sessions]
    sockets = server_sockets(("127.0.0.1", 0), workers)
    address = sockets[0].getsockname()[:2]
    confirmed = FORK.Value("q", 0)
    with _processes() as start:
        serving = [start(operator.work, number, sock) for number, sock in enumerate(sockets)]
        submitter, submitter_pipe = start(operator.submit, confirmed)
        pids = [process.pid for process, _ in serving]
        ends = [
            start(lambda pipe, own=robots[n::clients]: client_process(operator, own, address, messages, pipe, limit))[1]
            for n in range(clients)
        ]
        on_stage(f"{sessions} robots seal {messages} messages each")
        sealed: dict[RecordId, bytes] = {}
        for pipe in ends:
            sealed.update(pipe.recv())
        opens = len(sealed) - sessions * messages  # each stream begins with its `open` record

        on_stage("handshakes")
        cpu, started = cpu_seconds(pids), time.perf_counter()
        for pipe in ends:
            pipe.send("connect")
        figures.established = sum(pipe.recv() for pipe in ends)
        figures.connecting = time.perf_counter() - started
        figures.handshake_cpu_ms = (cpu_seconds(pids) - cpu) / max(1, figures.established) * 1000

        on_stage("messages")
        cpu, started = cpu_seconds(pids), time.perf_counter()
        for pipe in ends:
            pipe.send("send")
        reports = [pipe.recv() for pipe in ends]
        figures.sending = time.perf_counter() - started
        figures.message_cpu_ms = (cpu_seconds(pids) - cpu) / max(1, len(sealed)) * 1000
        stored = {id for report in reports for id in report["stored"]}

        on_stage("the chain")
        deadline = time.perf_counter() + limit
        while confirmed.value < len(stored) and time.perf_counter() < deadline:
            time.sleep(0.05)
        figures.to_chain = time.perf_counter() - started
        for pipe in ends:
            pipe.send("end")
        for process, _ in serving:
            process.terminate()
        served = [pipe.recv() for _, pipe in serving]
        on_stage("reading back")
        submitter.terminate()
        submitter_pipe.send([robot.tk for robot in robots])
        read = submitter_pipe.recv()
    for sock in sockets:
        sock.close()

    # The operator's chain may hold earlier runs of the same robots, in other streams.
    streams = {(id.robot, id.stream) for id in sealed}
    found = [(id, seen) for id, seen in read["found"] if (id.robot, id.stream) in streams]
    times_found = Counter(id for id, _ in found)
    data = {id for id in sealed if id.seq > 0}
    figures.sent = len(data)
    figures.stored = len(stored & data)
    figures.on_chain = len(data & times_found.keys())
    figures.lost = len(sealed.keys() - times_found.keys())
    figures.doubled = sum(times > 1 for times in times_found.values())
    figures.altered = sum(sealed.get(id) != seen for id, seen in found)
    figures.batches = read["batches"]
    figures.submitter_mib = read["peak"] / 1024
    figures.opened = int(sum(one["opening"]["packets"] for one in served))
    figures.opening_ms = sum(one["opening"]["seconds"] for one in served) * 1000
    figures.dropped = dict(sum((Counter(one["dropped"]) for one in served), Counter()))
    figures.worker_mib = [one["peak"] / 1024 for one in served]
    figures.growth_kib_per_session = sum(one["peak"] - one["before"] for one in served) / sessions
    for name in ("busy", "reconnected", "retransmitted"):
        setattr(figures, name, sum(report[name] for report in reports))
    if opens != sessions:
        raise SystemExit(f"{opens} open records of {sessions} streams")
    return figures


# --- printing


def rows(figures: Figures) -> list[tuple[str, str]]:
    f = figures
    paper = PAPER.get(f.sessions) if f.messages == 10 else None
    return [
        ("sessions established", f"{f.established} of {f.sessions}"),
        ("handshakes per second, all at once", f"{f.established / f.connecting:.0f}"),
        ("server's processor time per handshake", f"{f.handshake_cpu_ms:.2f} ms"),
        ("messages sent", f"{f.sent}"),
        ("acknowledged as stored", f"{f.stored}"),
        ("read back from the chain", f"{f.on_chain}"),
        ("**lost / doubled / altered**", f"**{f.lost} / {f.doubled} / {f.altered}**"),
        ("the paper: reached its server", f"{paper:,} ({(1 - paper / f.sent):.2%} lost)" if paper else "–"),
        ("messages per second into the inbox", f"{f.sent / f.sending:.0f}"),
        ("server's processor time per record, all of it", f"{f.message_cpu_ms:.3f} ms"),
        ("of it decrypting the channel", f"{f.opening_ms / max(1, f.opened):.3f} ms a packet, {f.opening_ms:.0f} ms"),
        ("first message to last confirmation", f"{f.to_chain:.1f} s, {f.batches} transactions"),
        ("peak memory of each worker", ", ".join(f"{mib:.0f} MiB" for mib in f.worker_mib)),
        ("of it per session", f"{f.growth_kib_per_session:.1f} KiB"),
        ("peak memory of the submitter", f"{f.submitter_mib:.0f} MiB"),
        ("frames sent again / sessions made again / busy", f"{f.retransmitted} / {f.reconnected} / {f.busy}"),
        ("datagrams dropped by the server", ", ".join(f"{n} {why}" for why, n in f.dropped.items()) or "none"),
    ]


def table(results: Sequence[Figures]) -> str:
    columns = [rows(figures) for figures in results]
    lines = ["| | " + " | ".join(f"{f.sessions} × {f.messages}, {f.store}" for f in results) + " |",
             "| --- |" + " ---: |" * len(results)]
    lines += [
        f"| {cells[0][0]} | " + " | ".join(value for _, value in cells) + " |"
        for cells in zip(*columns, strict=True)
    ]
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
    parser.add_argument("--workers", type=int, default=2)
    parser.add_argument("--store", default="sqlite", help="sqlite, redis (started here) or the URL of one")
    parser.add_argument("--chain", choices=["anvil", "embedded"],
                        default="anvil" if shutil.which("npx") or shutil.which("anvil") else "embedded")
    parser.add_argument("--json", type=Path, help="write the figures here as well")
    options = parser.parse_args()
    began = time.perf_counter()

    def say(text: str) -> None:
        print(f"{time.perf_counter() - began:6.1f} s  {text}", flush=True)

    results = []
    with tempfile.TemporaryDirectory() as folder:
        operator = Operator(Path(folder), options.chain, options.store, max(options.sessions), say)
        try:
            for count in options.sessions:
                results.append(run(operator, count, options.messages, workers=options.workers, on_stage=say))
        finally:
            operator.close()
    loads = ", ".join(f"{figures.load_average:.1f}" for figures in results)
    print(f"\n{processor()}, Python {platform.python_version()}, load average before each run {loads};"
          f" {options.workers} workers, {options.chain}\n\n{table(results)}")
    if options.json:
        options.json.write_text(json.dumps([asdict(figures) for figures in results], indent=1))
    if any(f.lost or f.doubled or f.altered for f in results):
        raise SystemExit("records were lost, doubled or altered")


if __name__ == "__main__":
    main()
