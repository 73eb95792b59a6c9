"""The main job in one process: a bag through real UDP onto an EVM and back, every record proven and compared.

Operator, server and robot are the same parts that run apart otherwise, on the
embedded chain; only the processes are threads. What comes back is compared
with the bag's messages, field by field, not with what was sent.
"""

from __future__ import annotations

import secrets
import threading
import time
from collections import defaultdict
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from pathlib import Path
from statistics import median
from typing import Any

from rosbridge_eth.bundle import open_bundle
from rosbridge_eth.capture import CapturedRecord
from rosbridge_eth.channel.udp import server_sockets
from rosbridge_eth.config import load_robot_config, load_server_config
from rosbridge_eth.errors import BridgeError
from rosbridge_eth.home import OperatorHome, RobotHome
from rosbridge_eth.identity import load_identity
from rosbridge_eth.ledger.accounts import Keyring
from rosbridge_eth.ledger.embedded import EmbeddedChain
from rosbridge_eth.ledger.submitter import BatchTiming
from rosbridge_eth.reader import Choice, Reading, ReadRecord, read_robot
from rosbridge_eth.registry import OWNER, Registry
from rosbridge_eth.relay import Harm, Relay
from rosbridge_eth.robot import assembly as robot_assembly
from rosbridge_eth.robot.process import Robot
from rosbridge_eth.server.administration import (
    deploy_contract,
    init_home,
    load_ca,
    load_server_identity,
    register_robot,
    server_trust,
)
from rosbridge_eth.server.assembly import bound_contract, open_inbox, open_journal, open_submission, open_worker
from rosbridge_eth.server.submission import Submission
from rosbridge_eth.server.worker import Worker
from rosbridge_eth.sources import BagSettings, Selection, open_source

ROBOT = "robot_1"
FUNDS = 1000 * 10**18
SETTLE = 60.0  # seconds for the last batch to be confirmed


@dataclass(slots=True)
class Stages:
    """How many records reached each stage, and how long each took (seconds).

    From `sent` on, the stream's own records count too: one that opens it, one that ends it.
    """

    captured: int = 0
    sent: int = 0
    retransmitted: int = 0
    stored: int = 0
    included: int = 0
    verified: int = 0
    times: dict[str, float] = field(default_factory=dict)


@dataclass(frozen=True, slots=True)
class Comparison:
    """What the bag says against what came back: `equal` records, and a sentence for each that is not."""

    equal: int
    differences: tuple[str, ...]


@dataclass(frozen=True, slots=True)
class DemoResult:
    """Everything the report shows."""

    stages: Stages
    batches: tuple[BatchTiming, ...]
    reading: Reading
    records: tuple[ReadRecord, ...]
    comparison: Comparison
    contract: str
    seconds: float

    @property
    def passed(self) -> bool:
        """Every captured record came back, proven, equal to the bag's, once."""
        return (
            self.reading.complete
            and not self.comparison.differences
            and self.stages.captured == self.comparison.equal == len(self.records) > 0
        )


@dataclass(slots=True)
class _Server:
    """The server's parts, in two threads."""

    worker: Worker
    submission: Submission
    timings: list[BatchTiming]
    stop: threading.Event = field(default_factory=threading.Event)
    failures: list[BaseException] = field(default_factory=list)
    threads: list[threading.Thread] = field(default_factory=list)

    def start(self) -> None:
        for name, task in (("worker", self.worker.run), ("submitter", self.submission.run)):
            thread = threading.Thread(target=self._run, args=(task,), name=name, daemon=True)
            self.threads.append(thread)
            thread.start()

    def _run(self, task: Callable[[Callable[[], bool]], None]) -> None:
        try:
            task(self.stop.is_set)
        except BaseException as error:  # kept and raised in the main thread, which waits for this one
            self.failures.append(error)
            self.stop.set()

    def check(self) -> None:
        if self.failures:
            raise self.failures[0]

    def end(self) -> None:
        self.stop.set()
        self.worker.loop.wake()
        for thread in self.threads:
            thread.join(10)


def run_demo(
    folder: Path,
    bag: Path,
    *,
    topics: Sequence[str] = (f"/{ROBOT}/odom",),
    harm: Harm | None = None,
    on_datagram: Callable[[bytes], None] = lambda data: None,
    on_stage: Callable[[str], None] = lambda text: None,
    on_progress: Callable[[Stages], None] = lambda stages: None,
) -> DemoResult:
    """Run everything in `folder` (empty or absent), with fresh keys that are of no use afterwards.

    harm: what the network between robot and server does to datagrams; nothing by default.
    on_datagram: is shown each of them.
    """
    started = time.monotonic()
    stages = Stages()
    home, robot_home = OperatorHome(folder / "operator"), RobotHome(folder / "robot")
    passphrase, password = secrets.token_hex(16).encode(), secrets.token_hex(16).encode()
    now = datetime.now(UTC)

    on_stage("making keys and certificates")
    with _timed(stages, "keys and certificates"):
        init_home(home, passphrase, listen="127.0.0.1:0", public=None, chain_url="embedded", server="server", now=now)
        keys = Keyring.load(home.accounts, passphrase)

    on_stage("starting the embedded chain, deploying the contract")
    with _timed(stages, "chain and contract"):
        chain = EmbeddedChain(fund={keys.operator.address: FUNDS})
        deployment = deploy_contract(home, chain, keys)
        contract = bound_contract(chain, deployment)

    on_stage("registering the robot")
    with _timed(stages, "registration"):
        made = register_robot(
            home, ROBOT, ca=load_ca(home, passphrase), keys=keys, chain=chain, password=password, now=now
        )
        robot_assembly.join(robot_home, open_bundle(made.bundle.read_bytes(), password), password)

    config = load_server_config(home.config)
    [sock] = server_sockets(config.listen)
    registry, journal = Registry(home.registry), open_journal(home, deployment)
    timings: list[BatchTiming] = []
    server = _Server(
        open_worker(
            0, sock, config=config, identity=load_server_identity(home, passphrase),
            trust=server_trust(home, registry), registry=registry, inbox=open_inbox(config, home), journal=journal,
            deployment=deployment,
        ),
        open_submission(
            config=config, contract=contract, journal=journal, inbox=open_inbox(config, home), registry=registry,
            keys=keys, on_confirmed=timings.append,
        ),
        timings,
    )
    relay = Relay(sock.getsockname()[:2], harm or Harm(), on_datagram)
    robot_home.config.write_text(robot_toml(topics, bag, relay.port))
    robot = robot_assembly.open_robot(robot_home, load_robot_config(robot_home.config), password)

    on_stage("replaying the bag over UDP")
    server.start()
    try:
        with _timed(stages, "replay and delivery"):
            robot.run(on_turn=lambda: _progress(robot, server, stages, on_progress))
            _progress(robot, server, stages, on_progress)
        on_stage("waiting for the last block")
        with _timed(stages, "last batches"):
            _settle(server, stages, on_progress)
    finally:
        server.end()
        relay.close()
    server.check()
    _costs(robot, server, stages)

    on_stage("reading everything back from the chain")
    with _timed(stages, "fetch, open and verify"):
        reader, roots = load_identity(home.reader(OWNER), passphrase)
        reading = read_robot(chain, deployment.contract, ROBOT, roots=roots, reader=reader)
        records = Choice().choose(reading.proven.records)
    on_stage("comparing with the bag")
    with _timed(stages, "comparison with the bag"):
        comparison = compare(bag, topics, [record.captured for record in records])
    stages.verified = comparison.equal
    on_progress(stages)
    return DemoResult(
        stages, tuple(server.timings), reading, tuple(records), comparison, deployment.contract,
        time.monotonic() - started,
    )


def robot_toml(topics: Sequence[str], bag: Path, port: int) -> str:
    names = ", ".join(f'"{topic}"' for topic in topics)
    return (
        f'topics = [{names}]\nserver = "127.0.0.1:{port}"\n\n'
        f'[source]\nkind = "bag"\npath = "{bag.resolve()}"\nspeed = "max"\n'
    )


class _timed:
    """Adds the seconds of a block to the stages' times."""

    def __init__(self, stages: Stages, name: str) -> None:
        self._times, self._name = stages.times, name

    def __enter__(self) -> None:
        self._started = time.perf_counter()

    def __exit__(self, *_: object) -> None:
        self._times[self._name] = time.perf_counter() - self._started


def _progress(robot: Robot, server: _Server, stages: Stages, on_progress: Callable[[Stages], None]) -> None:
    server.check()
    stages.captured = robot.recorder.times.records
    stages.sent = robot.sender.statistics.sent
    stages.retransmitted = robot.client.statistics().frames_retransmitted
    stages.stored = robot.sender.statistics.stored
    stages.included = sum(timing.records for timing in server.timings)
    on_progress(stages)


def _settle(server: _Server, stages: Stages, on_progress: Callable[[Stages], None]) -> None:
    """Wait until everything stored is confirmed."""
    deadline = time.monotonic() + SETTLE
    while stages.included < stages.stored:
        server.check()
        if time.monotonic() > deadline:
            raise BridgeError(f"{stages.stored - stages.included} records are in no block after {SETTLE:.0f} s")
        server.stop.wait(0.02)
        stages.included = sum(timing.records for timing in server.timings)
        on_progress(stages)


def _costs(robot: Robot, server: _Server, stages: Stages) -> None:
    """The cost of a message on the robot, stage by stage, and the latencies of the batches."""
    times = robot.recorder.times
    for name, total in (("capture", times.capture), ("seal", times.seal), ("spool", times.spool)):
        stages.times[f"{name}, per record"] = total / max(1, times.records)
    batches = server.timings
    for name in ("submit", "include", "confirm"):
        stages.times[f"{name}, per batch"] = median(getattr(batch, name) for batch in batches) if batches else 0.0


def compare(bag: Path, topics: Sequence[str], records: Sequence[CapturedRecord]) -> Comparison:
    """Hold each record against the bag's own message: the same receive time, and each captured field equal.

    Both sides are taken in order per topic, so a record that is missing,
    doubled or out of its place is a difference.
    """
    expected: dict[str, list[tuple[int, Any]]] = defaultdict(list)
    source = open_source(BagSettings(bag, speed=None), Selection(topics))
    try:
        source.run(
            lambda raw: expected[raw.topic].append((raw.received_ns, raw.decoder.decode(raw.raw))), threading.Event()
        )
    finally:
        source.close()
    equal, differences = 0, []
    for topic, messages in expected.items():
        got = [record for record in records if record.topic == topic]
        if len(got) != len(messages):
            differences.append(f"{topic}: the bag has {len(messages)} messages, {len(got)} came back")
        for (received_ns, message), record in zip(messages, got, strict=False):
            wrong = _difference(record.data, message, "")
            if record.received_ns != received_ns:
                wrong = f"received at {record.received_ns} instead of {received_ns}"
            if wrong is None:
                equal += 1
            else:
                differences.append(f"{topic} at {received_ns}: {wrong}")
    strangers = {record.topic for record in records} - expected.keys()
    differences += [f"{topic} came back and is not in the bag" for topic in sorted(strangers)]
    return Comparison(equal, tuple(differences))


def _difference(value: Any, message: Any, path: str) -> str | None:
    """The first place where captured JSON is not what the ROS message says; None if there is none."""
    if isinstance(value, dict):
        if not value:
            return f"{path or 'the record'} is empty"
        return next(
            (
                found
                for name, part in value.items()
                if (found := _difference(part, getattr(message, name), f"{path}.{name}".lstrip("."))) is not None
            ),
            None,
        )
    if isinstance(value, list):
        if len(value) != len(message):
            return f"{path} has {len(value)} elements instead of {len(message)}"
        parts = (_difference(a, b, f"{path}[{i}]") for i, (a, b) in enumerate(zip(value, message, strict=True)))
        return next((found for found in parts if found is not None), None)
    if hasattr(message, "nanosec"):
        message = message.sec * 10**9 + message.nanosec
    return None if value == message else f"{path} is {value!r} instead of {message!r}"
