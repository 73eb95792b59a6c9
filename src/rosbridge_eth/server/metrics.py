"""What the processes count, as Prometheus has it, and the HTTP server of /metrics, /healthz and /readyz.

A running server or robot has its figures in files of a folder in memory (`shared`, prometheus_client's multiprocess
mode), to which its home leads: that is how the server's processes share them, and how `status` knows. The table of
docs/operations.md has them all. The server is healthy while its processes beat, and ready when every condition holds,
too.
"""

from __future__ import annotations

import json
import math
import os
import shutil
import socket
import struct
import tempfile
import threading
import time
from collections import deque
from collections.abc import Collection, Iterator, Mapping
from contextlib import contextmanager, suppress
from http import HTTPStatus
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final
from wsgiref.simple_server import WSGIRequestHandler, WSGIServer, make_server

from prometheus_client import CollectorRegistry, Gauge, values
from prometheus_client.exposition import CONTENT_TYPE_LATEST, ThreadingWSGIServer, generate_latest
from prometheus_client.multiprocess import MultiProcessCollector

from rosbridge_eth.channel import Drop
from rosbridge_eth.config.values import Address
from rosbridge_eth.errors import NetworkError
from rosbridge_eth.ledger.contract import WEI_PER_ETH
from rosbridge_eth.log.store import Store

if TYPE_CHECKING:
    from rosbridge_eth.operator.registry import Enrolment
    from rosbridge_eth.robot.loop import Robot
    from rosbridge_eth.server.reception import Worker
    from rosbridge_eth.server.submitter import Submitter

SILENCE: Final = 15.0  # seconds without a beat after which a process counts as hanging
DEADLINE: Final = 10.0  # seconds for a client to send its request and take the answer
LITTLE_ROOM: Final = 64 << 20  # bytes; below this the disk counts as full

REGISTRY = CollectorRegistry()
_ENVIRONMENT: Final = "PROMETHEUS_MULTIPROC_DIR"
_LINK: Final = ".figures"  # in the home; leads to the folder
_PREFIX: Final = "rosbridge-eth-"


def _gauge(name: str, help: str, *labels: str) -> Gauge:
    # Without a label it would stand at 0 in every process that has nothing to say of it.
    return Gauge(f"rosbridge_eth_{name}", help, labels, registry=REGISTRY, multiprocess_mode="mostrecent")


BEAT = _gauge("beat_seconds", "When the process last took a turn, seconds since 1970.", "process")
STARTS = _gauge("starts", "How often the process was started since the server was.", "process")
CONDITION = _gauge("condition", "1 while the condition holds; /readyz lists them.", "name")
CHANNEL = _gauge("channel", "Counts of the channel since the process began, by what was counted.", "process", "count")
DROPPED = _gauge("datagrams_dropped", "Datagrams dropped without an answer, by reason.", "process", "reason")

CHUNKS = _gauge("chunks", "Chunks that arrived since the process began, by what became of them.", "process", "outcome")
STORED = _gauge("records_stored", "Lines of the log stored since the process began.", "process", "robot")
RATE = _gauge("records_per_second", "Lines stored a second, over the last ten.", "process", "robot")
NEWEST = _gauge(
    "newest_chunk_seconds", "When its newest chunk was sealed, seconds since 1970 by its clock.", "process", "robot"
)
SESSION = _gauge("session_seen_seconds", "When its session was last seen, seconds since 1970.", "robot", "address")
FORKED = _gauge(
    "forked_seconds",
    "When its log was last seen to go on in two places, or two machines to have its identity, seconds since 1970.",
    "robot",
)
WAITING = _gauge("waiting_chunks", "Chunks in the store that are not confirmed on the chain.", "robot")
WAITING_BYTES = _gauge("waiting_bytes", "Their bytes.", "robot")
OLDEST = _gauge("waiting_seconds", "Age of the oldest of them.", "robot")
HELD = _gauge("on_hold", "1 while nothing is written for the robot; `status` says why.", "robot")
ON_CHAIN = _gauge("chain_chunks", "Its chunks on the chain.", "robot")
BLOCK = _gauge("chain_block", "The block that has the newest of them.", "robot")
GAS = _gauge("gas", "Gas of the transactions sent for it since the submitter began.", "robot")
SUBMITTER = _gauge("submitter", "Counts of the submitter since it began, by what was counted.", "count")
BALANCE = _gauge("treasury_eth", "Balance of the operator's account.", "process")
HEAD = _gauge("head_block", "Number of the node's latest block.", "process")
HEAD_AGE = _gauge("head_age_seconds", "Age of that block by its own timestamp.", "process")
DISK_FREE = _gauge("disk_free_bytes", "Bytes free where the home is.", "process")

CAPTURED = _gauge("captured", "Records captured since the robot was started.", "robot")
LOST = _gauge("lost", "Messages not captured, by topic and why; the log says so, too.", "robot", "topic", "why")
FIRED = _gauge("trigger_fired", "Events since the robot was started.", "robot", "trigger")
KEPT = _gauge("trigger_records", "Records in memory for the next event.", "robot", "trigger")
KEPT_BYTES = _gauge("trigger_bytes", "Bytes that these count, of the trigger's `memory`.", "robot", "trigger")
SPOOL_CHUNKS = _gauge("spool_chunks", "Chunks in the spool: all, not stored there, set aside.", "robot", "state")
SPOOL_BYTES = _gauge("spool_bytes", "Bytes in the spool.", "robot")
SPOOL_DROPPED = _gauge("spool_dropped", "Bodies of chunks that a full spool gave up since it was made.", "robot")
CONNECTED = _gauge("connected", "1 while a session with the server stands.", "robot")


@contextmanager
def shared(home: Path) -> Iterator[None]:
    """Inside, this process and those it forks count in files of a folder that `collected` finds by the home.

    They are mapped into memory, and a process that writes to such a file on a full disk is killed: so not on a disk.
    """
    link, before, known = home / _LINK, values.ValueClass, os.environ.get(_ENVIRONMENT)
    shm = "/dev/shm"  # noqa: S108 - a folder of a new name, for this user alone
    folder = tempfile.mkdtemp(prefix=_PREFIX, dir=shm if os.access(shm, os.W_OK) else None)
    with suppress(OSError):  # a full disk; then `status` does not know the figures
        if (old := link.resolve()).name.startswith(_PREFIX):  # left by a process that was killed
            shutil.rmtree(old, ignore_errors=True)
        link.unlink(missing_ok=True)
        link.symlink_to(folder)
    _forget()
    os.environ[_ENVIRONMENT] = folder
    values.ValueClass = values.MultiProcessValue()  # type: ignore[no-untyped-call]
    try:
        yield
    finally:
        values.ValueClass = before
        os.environ.pop(_ENVIRONMENT)
        if known is not None:
            os.environ[_ENVIRONMENT] = known
        _forget()
        link.unlink(missing_ok=True)
        shutil.rmtree(folder, ignore_errors=True)


def forget_process(pid: int | None) -> None:
    """Drop the figures of a process that has ended: those of the next one begin anew, and the old ones are not true."""
    for file in Path(os.environ[_ENVIRONMENT]).glob(f"*_{pid}.db"):
        file.unlink()


def _forget() -> None:
    """A figure is kept where it was first set: let it be set anew."""
    for gauge in set(REGISTRY._names_to_collectors.values()):
        gauge.clear()  # type: ignore[attr-defined]


class _Shared(MultiProcessCollector):
    """What all processes show; reads again where a file is just made, and is empty for a moment, or just removed."""

    def collect(self) -> Any:
        for _ in range(20):
            with suppress(struct.error, FileNotFoundError):
                return super().collect()  # type: ignore[no-untyped-call]
            time.sleep(0.05)  # its process is about to write it
        raise ValueError("the figures of a process are cut off")


def collected(home: Path | None = None) -> CollectorRegistry:
    """The registry to show: of what runs with that home (ValueError where nothing does); without one, of all processes
    where they share a folder, else of this one."""
    if home is None and _ENVIRONMENT not in os.environ:
        return REGISTRY
    registry = CollectorRegistry()
    _Shared(registry, None if home is None else home / _LINK)  # type: ignore[no-untyped-call]
    return registry


def figures(home: Path) -> list[tuple[str, dict[str, str], float]]:
    """Name (without its prefix), labels and value of all that the process of that home shows; ValueError, as above.

    A figure of what is no more is NaN, and left out."""
    samples = [sample for family in collected(home).collect() for sample in family.samples]
    return [(sample.name.removeprefix("rosbridge_eth_"), sample.labels, sample.value) for sample in samples
            if not math.isnan(sample.value)]  # fmt: skip


class Rates:
    """What a count grows by a second, over the last ten looks, by a name."""

    def __init__(self) -> None:
        self._seen: dict[str, deque[tuple[float, float]]] = {}

    def of(self, name: str, count: float, now: float) -> float:
        """Take a count in; the rate since the oldest look that is kept."""
        seen = self._seen.setdefault(name, deque(maxlen=11))
        seen.append((now, count))
        return (count - seen[0][1]) / (now - seen[0][0]) if now > seen[0][0] else 0.0


_STORED_RATES = Rates()


def beat(process: str, wall: float) -> None:
    BEAT.labels(process).set(wall)


def conditions(registry: CollectorRegistry, expected: Collection[str], wall: float) -> Mapping[str, bool]:
    """Of each expected process whether it beats, and of each condition whether it holds."""
    found = {f"{process} runs": False for process in expected}
    for family in registry.collect():
        for sample in family.samples:
            if sample.name == "rosbridge_eth_beat_seconds" and sample.labels["process"] in expected:
                found[f"{sample.labels['process']} runs"] = wall - sample.value <= SILENCE
            elif sample.name == "rosbridge_eth_condition":
                found[sample.labels["name"]] = sample.value == 1
    return found


class _Handler(WSGIRequestHandler):
    timeout = DEADLINE

    def log_message(self, format: str, *arguments: Any) -> None:
        """Nothing: what a client asked for is its own words."""


class _Server(ThreadingWSGIServer):
    """Threads without number are not had: a connection that is not done after DEADLINE is shut."""

    def server_bind(self) -> None:
        self._open: dict[socket.socket, float] = {}
        super().server_bind()

    def process_request(self, request: Any, client_address: Any) -> None:
        self._open[request] = time.monotonic() + DEADLINE
        super().process_request(request, client_address)

    def shutdown_request(self, request: Any) -> None:
        self._open.pop(request, None)
        super().shutdown_request(request)

    def service_actions(self) -> None:
        now = time.monotonic()
        for request, deadline in list(self._open.items()):
            if now > deadline:
                self._open.pop(request, None)
                try:
                    request.shutdown(socket.SHUT_RDWR)
                except OSError:
                    continue  # the client has gone by itself

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Nothing: a client went away."""


class Web:
    """Serves from threads of its own between `start` and `stop`. NetworkError if the port cannot be had.

    Meant for the machine itself or a private network: whoever reaches the port reads names, balances and counts.
    """

    def __init__(self, address: Address, expected: Collection[str]) -> None:
        self._expected = expected
        server = type("_FamilyServer", (_Server,), {"address_family": address.family})
        try:
            self._http: WSGIServer = make_server(*address, self._answer, server, _Handler)
        except OSError as error:
            raise NetworkError(f"TCP {address} cannot be opened: {error.strerror}; correct `monitor`") from error
        self.address = Address(address.host, self._http.server_port)

    def start(self) -> None:
        # Made only here: the server forks in between, and a thread made before that cannot be started after it (3.13).
        threading.Thread(target=self._http.serve_forever, args=(0.2,), name="web", daemon=True).start()

    def stop(self) -> None:
        self._http.shutdown()
        self._http.server_close()

    def _answer(self, environ: Mapping[str, Any], start_response: Any) -> list[bytes]:
        path, registry = environ["PATH_INFO"], collected()
        status, body, kind = HTTPStatus.OK, b"", "application/json"
        if environ["REQUEST_METHOD"] not in ("GET", "HEAD"):
            status = HTTPStatus.METHOD_NOT_ALLOWED
        elif path == "/metrics":
            body, kind = generate_latest(registry), CONTENT_TYPE_LATEST
        elif path in ("/healthz", "/readyz"):
            found = conditions(registry, self._expected, time.time())
            if path == "/healthz":
                found = {name: holds for name, holds in found.items() if name.endswith(" runs")}
            status = HTTPStatus.OK if all(found.values()) else HTTPStatus.SERVICE_UNAVAILABLE
            body = json.dumps({"ok": all(found.values()), "conditions": found}, indent=1).encode() + b"\n"
        else:
            status, body, kind = HTTPStatus.NOT_FOUND, b"/metrics /healthz /readyz\n", "text/plain"
        headers = [("Content-Type", kind), ("Content-Length", str(len(body))), ("Cache-Control", "no-store")]
        start_response(f"{status.value} {status.phrase}", headers)
        return [body]


# What each process shows of itself, once a second


def show_channel(process: str, counted: Mapping[str, int], lost_sends: int) -> None:
    for what, count in counted.items():
        (DROPPED if isinstance(what, Drop) else CHANNEL).labels(process, what).set(count)
    CHANNEL.labels(process, "lost_sends").set(lost_sends)


def show_worker(process: str, worker: Worker, wall: float) -> None:
    """A worker's channel and sessions, and what became of the chunks that reached it."""
    reception = worker.reception
    beat(process, wall)
    show_channel(process, reception.server.statistics(), worker.loop.lost_sends)
    for outcome, count in reception.counts.items():
        CHUNKS.labels(process, outcome).set(count)
    for robot, records in reception.records.items():
        STORED.labels(process, robot).set(records)
        RATE.labels(process, robot).set(_STORED_RATES.of(robot, records, wall))
        NEWEST.labels(process, robot).set(reception.newest[robot])
    for session in reception.sessions.values():
        address = reception.server.address_of(session.connection)
        if address is not None:  # without its port, which is another each time
            SESSION.labels(session.peer.name, address[0]).set(wall)
    for robot, at in reception.forked.items():
        FORKED.labels(robot).set(wall - time.monotonic() + at)
    CONDITION.labels(f"{process} stores chunks").set(reception.trouble.why is None)


def show_submitter(
    submitter: Submitter, store: Store, robots: Mapping[bytes, Enrolment], folder: Path, wall: float
) -> None:  # fmt: skip
    """What waits for the chain, and whether it gets there. Raises StoreError."""
    process = "submitter"
    beat(process, wall)
    for (tk, robot), state in zip(robots.items(), store.states([*robots]), strict=True):
        name, held = robot.name, store.waiting(tk)
        WAITING.labels(name).set(held.chunks)
        WAITING_BYTES.labels(name).set(held.bytes)
        OLDEST.labels(name).set(0 if held.oldest is None else max(0.0, wall - held.oldest))
        HELD.labels(name).set(bool(state.hold) and (held.chunks > 0 or robot.revoked_at is None))
        GAS.labels(name).set(submitter.gas[tk])
        if standing := submitter.standings.get(tk):
            ON_CHAIN.labels(name).set(standing.chunks)
            BLOCK.labels(name).set(standing.data_block)
    for what, count in submitter.counts.items():
        SUBMITTER.labels(what).set(count)
    if submitter.head is not None:
        HEAD.labels(process).set(submitter.head.number)
        HEAD_AGE.labels(process).set(max(0.0, wall - submitter.head.time))
    if submitter.operator_balance is not None:
        BALANCE.labels(process).set(submitter.operator_balance / WEI_PER_ETH)
    room = shutil.disk_usage(folder).free
    DISK_FREE.labels(process).set(room)
    CONDITION.labels("node answers").set(submitter.trouble is None)
    CONDITION.labels("chunks are confirmed").set(submitter.unconfirmed is None)
    CONDITION.labels("treasury can pay").set(submitter.funds is None)
    CONDITION.labels("disk has room").set(room >= LITTLE_ROOM)


def show_robot(name: str, robot: Robot, wall: float) -> None:
    """A robot's capture, spool and session. Raises StoreError."""
    beat("robot", wall)
    show_channel("robot", robot.client.statistics(), robot.loop.lost_sends)
    CAPTURED.labels(name).set(robot.captured)
    for gone in {trigger for _, trigger in FIRED._metrics} - robot.box.triggers.keys():  # by a reload
        for gauge in (FIRED, KEPT, KEPT_BYTES):
            gauge.labels(name, gone).set(math.nan)
    for trigger in robot.box.triggers.values():
        FIRED.labels(name, trigger.rule.name).set(trigger.fired)
        KEPT.labels(name, trigger.rule.name).set(len(trigger.ring))
        KEPT_BYTES.labels(name, trigger.rule.name).set(trigger.ring.bytes)
    for (topic, why), count in robot.lost.items():
        LOST.labels(name, topic, why).set(count)
    spool = robot.spool.statistics()
    for state, chunks in (("all", spool.chunks), ("not stored", spool.unstored), ("set aside", spool.aside)):
        SPOOL_CHUNKS.labels(name, state).set(chunks)
    SPOOL_BYTES.labels(name).set(spool.bytes)
    SPOOL_DROPPED.labels(name).set(spool.dropped_bodies)
    CONNECTED.labels(name).set(robot.sender.connected)
    if robot.sender.forked:
        FORKED.labels(name).set(wall)
    CONDITION.labels("robot has a session").set(robot.sender.connected)
    CONDITION.labels("server's name has an address").set(robot.loop.resolved)
    CONDITION.labels("spool takes chunks").set(robot.spool_trouble.why is None)
