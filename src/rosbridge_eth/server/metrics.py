"""What the processes count: served at /metrics, and saved in the home, where `status` finds it.

A shard of the server, or a robot, keeps its figures in memory. Every two seconds it saves them in a file of its home
(`.shard-0.json`, `.robot.json`), which it removes when it ends: a file older than SILENCE belongs to a process that was
killed or hangs. With `monitor`, prometheus_client serves them, too. docs/operations.md says what each figure is.
"""

from __future__ import annotations

import json
import shutil
import socket
import time
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Mapping
from contextlib import contextmanager, suppress
from importlib.util import find_spec
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

from rosbridge_eth.channel import Drop
from rosbridge_eth.config.values import Address
from rosbridge_eth.errors import ConfigError, NetworkError
from rosbridge_eth.ledger.contract import WEI_PER_ETH

if TYPE_CHECKING:
    from rosbridge_eth.operator.registry import Enrolment
    from rosbridge_eth.robot.loop import Robot
    from rosbridge_eth.server.reception import Worker
    from rosbridge_eth.server.submitter import Submitter

EVERY: Final = 2.0  # seconds between two looks at what a process counted
SILENCE: Final = 15.0  # seconds without a beat after which a process counts as hanging
LITTLE_ROOM: Final = 64 << 20  # bytes; below this the disk counts as full

Figure = tuple[str, dict[str, str], float]
"""Name, labels and value."""
FIGURES: dict[tuple[str, tuple[tuple[str, str], ...]], float] = {}


def show(figures: Iterable[Figure]) -> None:
    """Set these figures; all others of this process stay as they are."""
    for name, labels, value in figures:
        FIGURES[name, (*labels.items(),)] = float(value)


def figures() -> list[Figure]:
    """All that this process shows."""
    shown = list(FIGURES.items())  # at once: the submitter's thread adds to them
    return [(name, dict(labels), value) for (name, labels), value in shown]


# Where others see them


class _Collector:
    """What prometheus_client asks for the figures."""

    def collect(self) -> Iterable[Any]:
        from prometheus_client.metrics_core import GaugeMetricFamily

        families: dict[str, GaugeMetricFamily] = {}
        for name, labels, value in figures():
            new = GaugeMetricFamily(f"rosbridge_eth_{name}", "See docs/operations.md.", labels=[*labels])
            families.setdefault(name, new).add_metric([*labels.values()], value)
        return families.values()


@contextmanager
def served(address: Address | None) -> Iterator[None]:
    """Inside, /metrics answers at this address (None: nowhere). Raises NetworkError if the port cannot be opened.

    For the machine itself or a private network: whoever reaches the port reads names, balances and counts.
    """
    if address is None:
        yield
        return
    require_free(address)
    from prometheus_client import CollectorRegistry, start_http_server

    registry = CollectorRegistry()
    registry.register(_Collector())
    http, _ = start_http_server(address.port, address.host, registry)
    try:
        yield
    finally:
        http.shutdown()
        http.server_close()


def require_free(address: Address | None) -> None:
    """Raises ConfigError without the package that serves /metrics, NetworkError if the port cannot be opened."""
    if address is None:
        return
    if not find_spec("prometheus_client"):
        raise ConfigError("`monitor` needs prometheus-client: pip install 'pysmcrypto[metrics]'")
    try:
        socket.create_server(address, family=address.family).close()
    except OSError as error:
        raise NetworkError(f"TCP {address} cannot be opened: {error.strerror}; correct `monitor`") from error


def file_of(home: Path, process: str) -> Path:
    return home / f".{process}.json"


def save(file: Path) -> None:
    """For `status`. Where the disk is full, it shows at least that the process is there."""
    new = file.with_suffix(".new")
    try:
        new.write_text(json.dumps(figures()))
        new.replace(file)  # not synchronised: after a power cut nobody needs it
    except OSError:
        with suppress(OSError):
            new.unlink(missing_ok=True)
            file.touch()


def running(home: Path) -> dict[str, list[Figure] | None]:
    """The figures of every process of this home; None for one that was killed or hangs."""
    found: dict[str, list[Figure] | None] = {}
    for file in sorted(home.glob(".*.json")):
        with suppress(OSError):  # it ends at this moment
            alive = time.time() - file.stat().st_mtime <= SILENCE
            content = file.read_text() or "[]"  # empty: there was never room on the disk
            found[file.stem.removeprefix(".")] = [(*figure,) for figure in json.loads(content)] if alive else None
    return found


def failing(figures: Iterable[Figure]) -> list[str]:
    """Of what a process shows: its parts that hang, and the conditions that do not hold."""
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
    """How much a count grows in a second, over the last ten looks, by a name."""

    def __init__(self) -> None:
        self._seen: dict[str, deque[tuple[float, float]]] = {}

    def of(self, name: str, count: float, now: float) -> float:
        """Add a count; the rate since the oldest look that is kept."""
        seen = self._seen.setdefault(name, deque(maxlen=11))
        seen.append((now, count))
        return (count - seen[0][1]) / (now - seen[0][0]) if now > seen[0][0] else 0.0


_STORED_RATES = Rates()
_ADDRESSES: dict[str, str] = {}
"""By robot, where its session was seen last."""


# What each process shows


def _channel(process: str, counted: Mapping[str, int], lost_sends: int) -> Iterator[Figure]:
    for what, count in counted.items():
        if isinstance(what, Drop):
            yield "datagrams_dropped", {"process": process, "reason": what}, count
        else:
            yield "channel", {"process": process, "count": what}, count
    yield "channel", {"process": process, "count": "lost_sends"}, lost_sends


def of_worker(process: str, worker: Worker, wall: float) -> Iterator[Figure]:
    """A shard's channel and sessions, and what became of the chunks that reached it."""
    reception = worker.reception
    yield "beat_seconds", {"process": process}, wall
    yield from _channel(process, reception.server.statistics(), worker.loop.lost_sends)
    for outcome, count in reception.counts.items():
        yield "chunks", {"process": process, "outcome": outcome}, count
    for robot, records in reception.records.items():
        yield "records_stored", {"process": process, "robot": robot}, records
        yield "records_per_second", {"process": process, "robot": robot}, _STORED_RATES.of(robot, records, wall)
        yield "newest_chunk_seconds", {"process": process, "robot": robot}, reception.newest[robot]
    for session in reception.sessions.values():
        address = reception.server.address_of(session.connection)
        if address is not None:  # without its port, which is another each time
            name, before = session.peer.name, _ADDRESSES.get(session.peer.name, "")
            if before != address[0]:  # else a robot that moves without end would add figures without end
                FIGURES.pop(("session_seen_seconds", (("robot", name), ("address", before))), None)
            _ADDRESSES[name] = address[0]
            yield "session_seen_seconds", {"robot": name, "address": address[0]}, wall
    for robot, at in reception.forked.items():
        yield "forked_seconds", {"robot": robot}, wall - time.monotonic() + at
    yield "condition", {"process": process, "name": "stores chunks"}, reception.trouble.why is None


def of_submitter(
    process: str, submitter: Submitter, robots: Mapping[bytes, Enrolment], folder: Path, wall: float
) -> Iterator[Figure]:
    """What waits for the chain, and whether it gets there. Raises StoreError."""
    yield "beat_seconds", {"process": f"{process} submitter"}, wall
    for (tk, robot), state in zip(robots.items(), submitter.store.states([*robots]), strict=True):
        name, held = {"robot": robot.name}, submitter.store.waiting(tk)
        yield "waiting_chunks", name, held.chunks
        yield "waiting_bytes", name, held.bytes
        yield "waiting_seconds", name, 0 if held.oldest is None else max(0.0, wall - held.oldest)
        yield "on_hold", name, bool(state.hold) and (held.chunks > 0 or robot.revoked_at is None)
        yield "gas", name, submitter.gas[tk]
        if standing := submitter.standings.get(tk):
            yield "chain_chunks", name, standing.chunks
            yield "chain_block", name, standing.data_block
    for what, count in submitter.counts.items():
        yield "submitter", {"process": process, "count": what}, count
    if submitter.head is not None:
        yield "head_block", {"process": process}, submitter.head.number
        yield "head_age_seconds", {"process": process}, max(0.0, wall - submitter.head.time)
    if submitter.operator_balance is not None:
        yield "treasury_eth", {"process": process}, submitter.operator_balance / WEI_PER_ETH
    room = shutil.disk_usage(folder).free
    yield "disk_free_bytes", {"process": process}, room
    yield "condition", {"process": process, "name": "node answers"}, submitter.trouble is None
    yield "condition", {"process": process, "name": "chunks are confirmed"}, submitter.unconfirmed is None
    yield "condition", {"process": process, "name": "treasury can pay"}, submitter.funds is None
    yield "condition", {"process": process, "name": "disk has room"}, room >= LITTLE_ROOM


def of_robot(name: str, robot: Robot, wall: float) -> Iterator[Figure]:
    """A robot's capture, spool and session. Raises StoreError."""
    for key in [key for key in FIGURES if key[0] == "records" or key[0].startswith("trigger_")]:
        del FIGURES[key]  # a reload may have removed the trigger; what is confirmed may be known no more
    yield "beat_seconds", {"process": "robot"}, wall
    yield from _channel("robot", robot.client.statistics(), robot.loop.lost_sends)
    yield "captured", {"robot": name}, robot.captured
    for trigger in robot.box.triggers.values():
        yield "trigger_fired", {"robot": name, "trigger": trigger.rule.name}, trigger.fired
        yield "trigger_records", {"robot": name, "trigger": trigger.rule.name}, len(trigger.ring)
        yield "trigger_bytes", {"robot": name, "trigger": trigger.rule.name}, trigger.ring.bytes
    for (topic, why), count in robot.lost.items():
        yield "lost", {"robot": name, "topic": topic, "why": why}, count
    spool = robot.spool.statistics()
    known = not robot.sender.refused and not spool.dropped_bodies  # else what is below a confirmed place may be absent
    for topic, captured in robot.written.items():
        sealed, confirmed = robot.writer.sealed[topic], robot.confirmed()[topic]
        yield "records", {"robot": name, "topic": topic, "state": "captured"}, captured
        yield "records", {"robot": name, "topic": topic, "state": "sealed"}, sealed
        if known:
            yield "records", {"robot": name, "topic": topic, "state": "waiting"}, sealed - confirmed
            yield "records", {"robot": name, "topic": topic, "state": "confirmed"}, confirmed
    yield "spool_chunks", {"robot": name, "state": "all"}, spool.chunks
    yield "spool_chunks", {"robot": name, "state": "not stored"}, spool.unstored
    yield "spool_chunks", {"robot": name, "state": "set aside"}, spool.aside
    yield "spool_bytes", {"robot": name}, spool.bytes
    yield "spool_dropped", {"robot": name}, spool.dropped_bodies
    yield "connected", {"robot": name}, robot.sender.connected
    if robot.sender.forked:
        yield "forked_seconds", {"robot": name}, wall
    yield "condition", {"process": "robot", "name": "robot has a session"}, robot.sender.connected
    yield "condition", {"process": "robot", "name": "server's name has an address"}, robot.loop.resolved
    yield "condition", {"process": "robot", "name": "spool takes chunks"}, robot.spool_trouble.why is None
