"""What the processes count, as Prometheus has it: served at /metrics, and saved where `status` finds it.

A shard of the server, and a robot, has its figures in its own memory; prometheus_client serves them on the port that
`monitor` names. Every two seconds it saves them in a file of its home, too (`.shard-0.prom`, `.robot.prom`), which it
removes at its end: a file that was not touched for SILENCE is of a process that was killed, or hangs.
"""

from __future__ import annotations

import shutil
import socket
import time
from collections import deque
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from pathlib import Path
from typing import TYPE_CHECKING, Final

from prometheus_client import CollectorRegistry, Gauge, start_http_server, write_to_textfile
from prometheus_client.parser import text_string_to_metric_families

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

EVERY: Final = 2.0  # seconds between two looks at what a process counted
SILENCE: Final = 15.0  # seconds without a beat after which a process counts as hanging
LITTLE_ROOM: Final = 64 << 20  # bytes; below this the disk counts as full

REGISTRY = CollectorRegistry()
_PREFIX: Final = "rosbridge_eth_"
Figure = tuple[str, dict[str, str], float]


def _gauge(name: str, help: str, *labels: str) -> Gauge:
    # Without a label it would stand at 0 in every process that has nothing to say of it.
    return Gauge(_PREFIX + name, help, labels, registry=REGISTRY)


BEAT = _gauge("beat_seconds", "When the process last took a turn, seconds since 1970.", "process")
STARTS = _gauge("starts", "How often the shard was started since the server was.", "process")
CONDITION = _gauge("condition", "1 while the condition holds.", "process", "name")
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
SUBMITTER = _gauge("submitter", "Counts of the submitter since it began, by what was counted.", "process", "count")
BALANCE = _gauge("treasury_eth", "Balance of the operator's account, at shard 0.", "process")
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
SPOOL_DROPPED = _gauge("spool_dropped", "Bodies of chunks that a full spool gave up since the start.", "robot")
CONNECTED = _gauge("connected", "1 while a session with the server stands.", "robot")


# Where others see them


@contextmanager
def served(address: Address | None) -> Iterator[None]:
    """Inside, /metrics answers at this address (None: nowhere). NetworkError if the port cannot be had.

    Meant for the machine itself or a private network: whoever reaches the port reads names, balances and counts.
    """
    if address is None:
        yield
        return
    require_free(address)
    http, _ = start_http_server(address.port, address.host, REGISTRY)
    try:
        yield
    finally:
        http.shutdown()
        http.server_close()


def require_free(address: Address | None) -> None:
    """NetworkError if the port of /metrics cannot be had."""
    try:
        if address is not None:
            socket.create_server(address, family=address.family).close()
    except OSError as error:
        raise NetworkError(f"TCP {address} cannot be opened: {error.strerror}; correct `monitor`") from error


def file_of(home: Path, process: str) -> Path:
    return home / f".{process}.prom"


def save(file: Path) -> None:
    """For `status`. Where the disk is full, it shows at least that the process is there."""
    try:
        write_to_textfile(str(file), REGISTRY)
    except OSError:
        with suppress(OSError):
            file.touch()


def parsed(text: str) -> list[Figure]:
    """Name (without its prefix), labels and value of what /metrics shows."""
    return [(sample.name.removeprefix(_PREFIX), sample.labels, sample.value)
            for family in text_string_to_metric_families(text) for sample in family.samples]  # fmt: skip


def running(home: Path) -> dict[str, list[Figure] | None]:
    """The figures of every process of this home; None of one that was killed, or hangs."""
    found: dict[str, list[Figure] | None] = {}
    for file in sorted(home.glob(".*.prom")):
        with suppress(OSError):  # it ends at this moment
            alive = time.time() - file.stat().st_mtime <= SILENCE
            found[file.stem.removeprefix(".")] = parsed(file.read_text()) if alive else None
    return found


def failing(figures: list[Figure]) -> list[str]:
    """Of what a process shows, its parts that hang and the conditions that do not hold."""
    beats = {labels["process"]: value for name, labels, value in figures if name == "beat_seconds"}
    return [
        *(f"{part} works" for part, beat in beats.items() if max(beats.values()) - beat > SILENCE),
        *(f"{labels['process']}: {labels['name']}" for name, labels, value in figures
          if name == "condition" and value != 1),
    ]  # fmt: skip


class Beats:
    """Says at a steady pace that the figures are due."""

    def __init__(self, every: float = EVERY, clock: Callable[[], float] = time.monotonic) -> None:
        self._every, self._clock, self._next = every, clock, float("-inf")

    def due(self) -> bool:
        now = self._clock()
        if now < self._next:
            return False
        self._next = now + self._every
        return True


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


# What each process shows of itself


def show_channel(process: str, counted: Mapping[str, int], lost_sends: int) -> None:
    for what, count in counted.items():
        (DROPPED if isinstance(what, Drop) else CHANNEL).labels(process, what).set(count)
    CHANNEL.labels(process, "lost_sends").set(lost_sends)


def show_worker(process: str, worker: Worker, wall: float) -> None:
    """A shard's channel and sessions, and what became of the chunks that reached it."""
    reception = worker.reception
    BEAT.labels(process).set(wall)
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
    CONDITION.labels(process, "stores chunks").set(reception.trouble.why is None)


def show_submitter(
    process: str, submitter: Submitter, store: Store, robots: Mapping[bytes, Enrolment], folder: Path, wall: float
) -> None:
    """What waits for the chain, and whether it gets there. Raises StoreError."""
    BEAT.labels(f"{process} submitter").set(wall)
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
        SUBMITTER.labels(process, what).set(count)
    if submitter.head is not None:
        HEAD.labels(process).set(submitter.head.number)
        HEAD_AGE.labels(process).set(max(0.0, wall - submitter.head.time))
    if submitter.operator_balance is not None:
        BALANCE.labels(process).set(submitter.operator_balance / WEI_PER_ETH)
    room = shutil.disk_usage(folder).free
    DISK_FREE.labels(process).set(room)
    for condition, holds in {
        "node answers": submitter.trouble is None, "chunks are confirmed": submitter.unconfirmed is None,
        "treasury can pay": submitter.funds is None, "disk has room": room >= LITTLE_ROOM,
    }.items():  # fmt: skip
        CONDITION.labels(process, condition).set(holds)


def show_robot(name: str, robot: Robot, wall: float) -> None:
    """A robot's capture, spool and session. Raises StoreError."""
    BEAT.labels("robot").set(wall)
    show_channel("robot", robot.client.statistics(), robot.loop.lost_sends)
    CAPTURED.labels(name).set(robot.captured)
    for gauge in (FIRED, KEPT, KEPT_BYTES):  # of triggers that a reload took away, too
        gauge.clear()
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
    for condition, holds in {
        "robot has a session": robot.sender.connected, "server's name has an address": robot.loop.resolved,
        "spool takes chunks": robot.spool_trouble.why is None,
    }.items():
        CONDITION.labels("robot", condition).set(holds)
