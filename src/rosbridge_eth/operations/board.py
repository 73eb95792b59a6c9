"""Where snapshots meet: the newest of each process, and what they say together. Safe for several threads.

Ready means: every process that must be there has published lately, and all
their conditions hold. Healthy means the first half alone: what is not healthy
should be started again, what is not ready may mend by itself.
"""

from __future__ import annotations

import errno
import socket
import threading
import time
from collections.abc import Callable, Collection, Iterable
from dataclasses import dataclass

from prometheus_client.core import Metric as PrometheusMetric
from prometheus_client.registry import Collector

from rosbridge_eth.operations.figures import METRICS, Condition, Histogram, Kind, Sample, Snapshot, sample

EVERY = 1.0  # seconds between two snapshots of a process
SILENCE = 15.0  # seconds without one, after which a process counts as hanging
LARGEST = 1 << 17  # bytes of a snapshot


@dataclass(frozen=True, slots=True)
class Shown:
    """A snapshot and its age in seconds."""

    snapshot: Snapshot
    age: float


class Board:
    """The newest snapshot of each process.

    expected: the processes without which nothing is healthy. awaited: further
    names under which something must have been published lately to be ready.
    """

    def __init__(
        self, expected: Collection[str], awaited: Collection[str] = (), *, clock: Callable[[], float] = time.monotonic
    ) -> None:
        self._expected, self._awaited = tuple(expected), tuple(awaited)
        self._clock = clock
        self._started = clock()
        self._lock = threading.Lock()
        self._held: dict[str, tuple[Snapshot, float]] = {}

    def put(self, snapshot: Snapshot) -> None:
        with self._lock:
            self._held[snapshot.process] = (snapshot, self._clock())

    def shown(self) -> list[Shown]:
        """All snapshots, by the name of their process."""
        now = self._clock()
        with self._lock:
            return [Shown(snapshot, now - at) for _, (snapshot, at) in sorted(self._held.items())]

    def health(self) -> list[Condition]:
        """Each expected process: has it published lately? One that never did has as long as one that falls silent."""
        return [self._lately(name, "process") for name in self._expected]

    def readiness(self) -> list[Condition]:
        """Health, everyone's first word, and the conditions that the processes name."""
        shown = self.shown()
        heard = {each.snapshot.process for each in shown}
        starting = [
            Condition(name, False, "not heard of yet") for name in (*self._expected, *self._awaited)
            if name not in heard
        ]
        return [
            *self.health(),
            *(self._lately(name, "news of the") for name in self._awaited),
            *starting,
            *(condition for each in shown for condition in each.snapshot.conditions),
        ]

    def _lately(self, name: str, what: str) -> Condition:
        with self._lock:
            held = self._held.get(name)
        age = self._clock() - (self._started if held is None else held[1])
        return Condition(f"{what} {name}", age <= SILENCE, "" if age <= SILENCE else f"silent for {age:.0f} s")


class BoardCollector(Collector):
    """A board as Prometheus metrics; each sample is labelled with its process."""

    def __init__(self, board: Board) -> None:
        self._board = board

    def collect(self) -> Iterable[PrometheusMetric]:
        shown = self._board.shown()
        families: dict[str, PrometheusMetric] = {}
        for each in shown:
            ages = (sample("snapshot_age_seconds", each.age, each.snapshot.process),)
            for one in (*each.snapshot.samples, *ages):
                metric = METRICS[one.metric]
                family = families.get(metric.name)
                if family is None:
                    name = metric.shown.removesuffix("_total")
                    family = families[metric.name] = PrometheusMetric(name, metric.help, str(metric.kind))
                self._add(family, metric.kind, one, each.snapshot.process)
        yield from families.values()

    @staticmethod
    def _add(family: PrometheusMetric, kind: Kind, one: Sample, process: str) -> None:
        # What a process says of others carries their names; `process` then is theirs.
        labels = {"process": process, **dict(zip(METRICS[one.metric].labels, one.labels, strict=True))}
        if isinstance(one.value, tuple):
            counts, total = one.value
            for bound, count in Histogram(list(counts), total).buckets():
                family.add_sample(family.name + "_bucket", {**labels, "le": bound}, count)
            family.add_sample(family.name + "_count", labels, float(sum(counts)))
            family.add_sample(family.name + "_sum", labels, total)
        else:
            family.add_sample(family.name + ("_total" if kind is Kind.COUNTER else ""), labels, one.value)


class Wire:
    """One-way, from many processes to one: a snapshot is one datagram of a socket pair made before they are forked."""

    def __init__(self) -> None:
        self._receive, self._send = socket.socketpair(socket.AF_UNIX, socket.SOCK_DGRAM)
        self._send.setblocking(False)
        self.lost = 0

    def publish(self, snapshot: Snapshot) -> None:
        """Send it; one that finds no room, or nobody there, is lost: the next one replaces it anyway."""
        try:
            self._send.send(snapshot.encode())
        except OSError as error:
            if error.errno not in (errno.EAGAIN, errno.ENOBUFS, errno.ECONNREFUSED, errno.EMSGSIZE):
                raise
            self.lost += 1

    def receive(self, timeout: float) -> Snapshot | None:
        """The next snapshot, or None after so many seconds."""
        self._receive.settimeout(timeout)
        try:
            return Snapshot.decode(self._receive.recv(LARGEST))
        except TimeoutError:
            return None

    def close(self) -> None:
        self._receive.close()
        self._send.close()


class Pace:
    """Says when the next snapshot is due, on the caller's clock; the first one is due at once."""

    def __init__(self, every: float = EVERY) -> None:
        self._every, self._next = every, float("-inf")

    def due(self, now: float) -> bool:
        if now < self._next:
            return False
        self._next = now + self._every
        return True
