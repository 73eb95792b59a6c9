"""What a record costs the robot, the server and the chain, stage by stage, and how many go through in a second.

    python benchmarks/bridge_costs.py [--records 20000] [--json FILE] [--first-edition FOLDER]

The messages are the sample bag's Odometry, over and over; captured are pose and twist, as the first edition did, or
the whole message with its covariances. In the first part both ends run in one process without a socket, and the time
of each stage is added up where it is spent. In the second, robot and server are two processes on loopback with
everything real up to the server's commit. The gas is that of the contract on the embedded chain.

--first-edition: a checkout of commit ebd8d7e (`git worktree add FOLDER ebd8d7e`), whose own benchmark is run before
and after, in the same environment. The paper's user end took 0.852 ms a message and its server 0.422 ms to decrypt
one, on an i9-10900KF at 3.7 GHz; its storage slots cost 268,924 gas for 256 bytes (Security and Communication
Networks 2022, article 7206494).
"""

from __future__ import annotations

import argparse
import json
import multiprocessing
import os
import platform
import subprocess
import sys
import tempfile
import threading
import time
from collections import defaultdict
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from datetime import UTC, datetime
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any

from eth_hash.auto import keccak

from rosbridge_eth import identity as ids
from rosbridge_eth.capture import Capture, RawMessage, TopicRule, stream_line
from rosbridge_eth.channel import Client, ClientConfig, Server, ServerConfig, cookie_key
from rosbridge_eth.channel.udp import UdpLoop, server_socket
from rosbridge_eth.config import Address
from rosbridge_eth.ledger import Keyring, Ledger
from rosbridge_eth.ledger.nodes import EmbeddedChain
from rosbridge_eth.log.chunk import Chunk, Log, drop, robot_id
from rosbridge_eth.log.sqlite import SqliteStore
from rosbridge_eth.log.store import Store
from rosbridge_eth.log.writer import LogWriter
from rosbridge_eth.robot.loop import TAKE, Robot
from rosbridge_eth.robot.sender import Sender
from rosbridge_eth.robot.sources import BagSource, Selection
from rosbridge_eth.robot.sources.bag import sample_bag
from rosbridge_eth.robot.spool import Spool
from rosbridge_eth.server.reception import Reception, Worker

TOPIC = "/robot_1/odom"
POSE_AND_TWIST = ("header.stamp", "header.frame_id", "child_frame_id", "pose.pose", "twist.twist")
NOW = datetime.now(UTC)
LEDGER, PLACE = bytes(32), Log(bytes(32), robot_id("robot_1"))
GIB = 1 << 30
PACE = 165.0  # messages a second of a robot as it is


class Identities:
    """A CA, a server, a robot and a reader, made once."""

    def __init__(self) -> None:
        ca = ids.create_ca("benchmark", at=NOW)
        self.server = ids.enrol(ca, ids.Role.SERVER, "server", at=NOW)
        self.robot = ids.enrol(ca, ids.Role.ROBOT, "robot_1", at=NOW)
        self.reader = ids.enrol(ca, ids.Role.READER, "owner", at=NOW)
        self.trust = ids.Trust((ca.certificate,))

    def spool(self, file: Path) -> Spool:
        return Spool(file, PLACE, max_bytes=GIB, drop=partial(drop, PLACE, self.robot.signing_key))

    def writer(self, period: float, now: float) -> LogWriter:
        return LogWriter(
            PLACE, self.robot.signing_key, [self.reader.encryption_certificate.public_key], previous=bytes(32),
            stream_line=stream_line("bag", "benchmark"), period=period, now=now,
        )

    def reception(self, store: Store) -> Reception:
        server = Server(ServerConfig(), self.server, self.trust, cookie_key(self.server), time.monotonic())
        return Reception(server, store, LEDGER, lambda: {PLACE.tk: keccak(self.robot.public.certificates)})


class Odometry:
    """A source of `count` messages: the sample bag's, again and again, `pace` of them a second (0: at once)."""

    live, kind = False, "bag"
    lost: Mapping[tuple[str, str], int] = {}

    def __init__(self, count: int, pace: float = 0.0) -> None:
        bag = BagSource(sample_bag(), Selection([TOPIC]), speed=None)
        self.messages = list(bag.messages())
        bag.close()
        self.count, self.pace = count, pace
        self.seconds = 0.0
        """Of the processor, in the thread that `run` had: with a pace it is woken once a message."""

    def __iter__(self) -> Iterator[RawMessage]:
        for number in range(self.count):
            yield self.messages[number % len(self.messages)]

    def run(self, emit: Any, stop: threading.Event) -> None:
        due, used = time.monotonic(), time.thread_time()
        for message in self:
            if stop.is_set():
                return
            emit(message)
            if self.pace:
                due += 1 / self.pace
                time.sleep(max(0.0, due - time.monotonic()))
        self.seconds = time.thread_time() - used

    def close(self) -> None:
        """Nothing is open."""


class Stopwatch:
    """Seconds of the processor's time by stage, and of the wall clock's: with it the disk is waited for."""

    def __init__(self) -> None:
        self.seconds: dict[str, float] = defaultdict(float)
        self.wall: dict[str, float] = defaultdict(float)

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        wall, started = time.perf_counter(), time.process_time()
        yield
        self.seconds[stage] += time.process_time() - started
        self.wall[stage] += time.perf_counter() - wall


def rule(whole: bool) -> TopicRule:
    return TopicRule(TOPIC) if whole else TopicRule(TOPIC, fields=POSE_AND_TWIST)


def stage_costs(
    who: Identities, folder: Path, records: int, per_chunk: int, whole: bool, *, watch: Stopwatch | None = None,
    turn: int = TAKE,
) -> dict[str, Any]:
    """Milliseconds a record of each stage (processor, wall), both ends in one process; and the chunks made.

    turn: messages between two turns of the network; by default as the robot's loop turns while messages come in.
    """
    watch = watch or Stopwatch()
    spool, store = who.spool(folder / "spool.sqlite"), SqliteStore(folder / "store.sqlite", LEDGER, GIB, GIB)
    now = time.monotonic()
    capture, writer = Capture([rule(whole)], source_kind="bag"), who.writer(1.0, now)
    client = Client(ClientConfig(), who.robot, who.trust, "server", now)
    reception = who.reception(store)
    server, sender = reception.server, Sender(client, spool, writer)
    there, back = ("192.0.2.1", 7410), ("192.0.2.2", 5000)
    client.connect(there, now)

    def exchange(watch: Stopwatch) -> None:
        now = time.monotonic()
        with watch("robot: send"):
            sender.send(now)
            client.handle_timer(now)
            sent = client.datagrams_to_send(now)
        with watch("server: receive and open"):
            for data, _ in sent:
                server.receive_datagram(data, back, now)
        with watch("server: parse"):
            while (event := server.next_event()) is not None:
                reception.handle(event, now)
        with watch("server: verify, commit and answer"):
            reception.turn(now + 1.0, time.time())
            server.handle_timer(now)
            answers = server.datagrams_to_send(now)
        with watch("robot: acknowledgements"):
            for data, _ in answers:
                client.receive_datagram(data, there, now)
            while (event := client.next_event()) is not None:
                sender.handle(event, now)

    unmeasured = Stopwatch()
    while not sender.connected:
        exchange(unmeasured)
    chunks: list[Chunk] = []
    number, messages = 0, iter(Odometry(records))
    while taken := list(islice(messages, turn)):  # many at once, since the watch itself takes some microseconds
        with watch("robot: capture"):
            captured = [capture.process(raw, time.time_ns(), True) for raw in taken]
        closed: list[Chunk] = []
        with watch("robot: seal"):
            for record in captured:
                assert record is not None
                number, now = number + 1, time.monotonic()
                writer.add(record.line, now, record.definition)
                if number % per_chunk == 0:
                    closed += writer.closed(now + 2.0, time.time_ns() // 10**6)
        chunks += closed
        with watch("robot: spool"):
            for chunk in closed:
                spool.append(chunk)
        if len(taken) == turn:
            exchange(watch)
    while not sender.idle:
        exchange(watch)
    spool.close()
    store.close()
    costs: dict[str, dict[str, tuple[float, float]]] = {"robot": {}, "server": {}}
    for stage, seconds in watch.seconds.items():
        end, _, what = stage.partition(": ")
        costs[end][what] = (seconds / records * 1000, watch.wall[stage] / records * 1000)
    return {"costs": costs, "chunks": chunks}


def gas(chunks: list[Chunk]) -> float:
    """Gas of these chunks, in batches of 96 KiB, on the embedded chain."""
    keys = Keyring.create()
    chain = EmbeddedChain(fund={keys.operator.address: 10**21})
    ledger, _ = Ledger.deploy(chain, keys.operator)
    robot, total = keys.account(1), 0
    ledger.registration(keys.operator, PLACE.tk, robot.address, b"certificates")
    ledger.alloc_eth(keys.operator, robot.address, 10**18)
    batch: list[bytes] = []
    for chunk in [*chunks, None]:
        if batch and (chunk is None or sum(map(len, batch)) + len(chunk.encoded) > 96 * 1024):
            total += ledger.set_data(robot, PLACE.tk, batch).gas_used
            batch = []
        if chunk is not None:
            batch.append(chunk.encoded)
    return float(total)


def throughput(
    who: Identities, folder: Path, records: int, whole: bool, *, pace: float = 0.0
) -> tuple[float, float, int, tuple[float, float]]:
    """From the source to the server's commit, two processes on loopback.

    Records a second, records in a chunk, lines in the store (the records, and those that open the stream), and
    milliseconds a record of the robot's processor, session and all: in the thread of the source, and elsewhere.
    pace: messages a second, 0: as fast as it goes.
    """
    sock = server_socket(("127.0.0.1", 0))
    port = sock.getsockname()[1]
    context = multiprocessing.get_context("fork")
    stop = context.Event()

    def serve() -> None:
        reception = who.reception(SqliteStore(folder / "store-2.sqlite", LEDGER, GIB, GIB))
        Worker(reception, lambda handle: UdpLoop(reception.server, sock, handle)).run(stop.is_set)

    serving = context.Process(target=serve)
    serving.start()
    spool, now = who.spool(folder / "spool-2.sqlite"), time.monotonic()
    client = Client(ClientConfig(), who.robot, who.trust, "server", now)
    writer = who.writer(1.0 if pace else 0.05, now)
    sender = Sender(client, spool, writer)
    source = Odometry(records, pace)
    robot = Robot(
        source=source, capture=Capture([rule(whole)], source_kind="bag"),  # type: ignore[arg-type]
        writer=writer, spool=spool, client=client, sender=sender,
        servers=[Address("127.0.0.1", port)],
    )  # fmt: skip
    started, used = time.perf_counter(), time.process_time()
    robot.run()
    seconds, used = time.perf_counter() - started, time.process_time() - used
    stop.set()
    serving.join(10)
    if robot.captured < records:
        raise SystemExit(f"only {robot.captured} of {records} were captured: {robot.summary}")
    store = SqliteStore(folder / "store-2.sqlite", LEDGER, GIB, GIB)
    stored = store.waiting(PLACE.tk).records
    store.close()
    waking, rest = (each / records * 1000 for each in (source.seconds, used - source.seconds))
    return records / seconds, records / robot.chunks, stored, (waking, rest)


def first_edition(folder: Path, records: int) -> dict[str, Any]:
    """The figures of the first edition's own benchmark, in this environment."""
    with tempfile.NamedTemporaryFile(suffix=".json") as file:
        command = [sys.executable, str(folder / "benchmarks/bridge_costs.py"), "--messages", str(records),
                   "--json", file.name]  # fmt: skip
        environment = {**os.environ, "PYTHONPATH": str(folder / "src")}
        subprocess.run(command, env=environment, check=True, capture_output=True)
        figures: dict[str, Any] = json.loads(Path(file.name).read_bytes())
    return figures


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--records", type=int, default=20_000)
    parser.add_argument("--json", type=Path, help="write the figures here as well")
    parser.add_argument("--first-edition", type=Path, metavar="FOLDER")
    options = parser.parse_args()
    who, rows = Identities(), []
    before = None if options.first_edition is None else first_edition(options.first_edition, 3000)
    print(f"{platform.processor() or platform.machine()}, {os.cpu_count()} cores, Python {platform.python_version()}, "
          f"{options.records} records, load average {os.getloadavg()[0]:.1f}\n")
    for whole in (False, True):
        for per_chunk in (1, 10, 100):
            records = max(per_chunk, min(options.records, 200 * per_chunk))
            with tempfile.TemporaryDirectory() as folder:
                found = stage_costs(who, Path(folder), records, per_chunk, whole)
            chunks = found["chunks"]
            size = sum(len(chunk.encoded) for chunk in chunks) / records
            row = {"fields": "all" if whole else "pose and twist", "records a chunk": per_chunk, "bytes": size,
                   "gas": gas(chunks) / records, "costs": found["costs"]}  # fmt: skip
            rows.append(row)
    print("| captured | records a chunk | end | stage | processor, ms a record | wall clock |")
    print("| --- | ---: | --- | --- | ---: | ---: |")
    for row in rows:
        for end, stages in row["costs"].items():
            for stage, (cost, wall) in stages.items():
                print(f"| {row['fields']} | {row['records a chunk']} | {end} | {stage} | {cost:.4f} | {wall:.4f} |")
    print("\n| captured | records a chunk | robot, ms a record (wall clock) | server, ms a record (wall clock) "
          "| bytes a record | gas a record |\n| --- | ---: | ---: | ---: | ---: | ---: |")
    for row in rows:
        robot, server = ([sum(each[k] for each in row["costs"][end].values()) for k in (0, 1)]
                         for end in ("robot", "server"))  # fmt: skip
        print(f"| {row['fields']} | {row['records a chunk']} | {robot[0]:.3f} ({robot[1]:.3f}) "
              f"| {server[0]:.4f} ({server[1]:.4f}) | {row['bytes']:.0f} | {row['gas']:,.0f} |")
    rates = []
    for whole in (False, True):
        with tempfile.TemporaryDirectory() as folder:
            rate, per_chunk_, _, _ = throughput(who, Path(folder), options.records, whole)
        rates.append({"fields": "all" if whole else "pose and twist", "records_per_second": rate})
        print(f"\nThrough loopback, robot and server as two processes, {rates[-1]['fields']}: {rate:,.0f} records/s, "
              f"{per_chunk_:.0f} records a chunk")
    with tempfile.TemporaryDirectory() as folder:
        _, per_chunk_, _, (waking, paced) = throughput(who, Path(folder), int(20 * PACE), False, pace=PACE)
    print(f"\nAt {PACE:.0f} messages a second, {per_chunk_:.0f} records a chunk: robot {paced:.3f} ms a record, session"
          f" and all, and {waking:.3f} ms to be woken for each message")
    if options.first_edition is not None:
        after = first_edition(options.first_edition, 3000)
        for name, figures in (("before", before), ("after", after)):
            assert figures is not None
            robot, server = (sum(figures["milliseconds"][end].values()) for end in ("robot", "server"))
            print(f"\nFirst edition, {name}: robot {robot:.3f} ms, server {server:.3f} ms a record, "
                  f"{figures['messages_per_second']:,.0f} records/s")
    if options.json:
        figures = {"rows": rows, "throughput": rates, "paced": paced, "waking": waking}
        options.json.write_text(json.dumps(figures, indent=1))


if __name__ == "__main__":
    main()
