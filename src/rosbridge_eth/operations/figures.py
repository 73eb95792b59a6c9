"""The figures that processes publish: every metric by name, and a process's snapshot of its own.

METRICS is the one table: /metrics, `status` and docs/operations.md follow it.
A snapshot is a frozen value that travels as one datagram of JSON, so that the
workers' numbers reach the one process that shows them and no memory is shared.
Names follow the Prometheus conventions: base units, `_total` for counters.
"""

from __future__ import annotations

import json
from bisect import bisect_left
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum
from typing import Final

PREFIX: Final = "rosbridge_eth_"
LATENCIES: Final = (0.01, 0.025, 0.05, 0.1, 0.25, 0.5, 1.0, 2.5, 5.0, 10.0, 30.0, 60.0, 300.0, 1800.0)
"""Upper bounds in seconds: from a local chain's block to a node that was away for half an hour."""


class Kind(StrEnum):
    COUNTER = "counter"
    GAUGE = "gauge"
    HISTOGRAM = "histogram"


@dataclass(frozen=True, slots=True)
class Metric:
    """One metric; `name` is without PREFIX and, for counters, without `_total`."""

    name: str
    kind: Kind
    help: str
    labels: tuple[str, ...] = ()

    @property
    def shown(self) -> str:
        """The name that Prometheus has."""
        return PREFIX + self.name + ("_total" if self.kind is Kind.COUNTER else "")


def _table(*rows: tuple[str, Kind, str, tuple[str, ...]]) -> Mapping[str, Metric]:
    return {name: Metric(name, kind, help, labels) for name, kind, help, labels in rows}


C, G, H = Kind.COUNTER, Kind.GAUGE, Kind.HISTOGRAM
METRICS: Final[Mapping[str, Metric]] = _table(
    # The channel, at either end.
    ("datagrams_sent", C, "UDP datagrams sent.", ()),
    ("datagrams_received", C, "UDP datagrams received.", ()),
    ("sent_bytes", C, "Bytes of the datagrams sent.", ()),
    ("received_bytes", C, "Bytes of the datagrams received.", ()),
    ("datagrams_dropped", C, "Datagrams dropped without a word, by reason.", ("reason",)),
    ("socket_overflows", C, "Datagrams the kernel dropped because the receive buffer was full.", ()),
    ("socket_refused", C, "Datagrams the system did not take for sending.", ()),
    ("packets_lost", C, "Packets found lost.", ()),
    ("frames_retransmitted", C, "Frames sent again.", ()),
    ("handshakes", C, "Handshakes completed.", ()),
    ("handshakes_begun", C, "Handshakes begun.", ()),
    ("cookies", C, "Cookies handed to unproven addresses.", ()),
    ("resets", C, "Resets sent to connections nobody knows.", ()),
    ("rekeys", C, "Changes of session keys.", ()),
    ("address_changes", C, "Robots that went on from another address.", ()),
    ("sessions", G, "Sessions that stand.", ()),
    ("half_open", G, "Handshakes under way.", ()),
    ("held_bytes", G, "Bytes of messages under way.", ()),
    # The server's reception.
    ("records", C, "Records that arrived, by what became of them: stored, duplicate, conflict, busy, refused.",
     ("outcome",)),
    # The inbox and the journal.
    ("inbox_records", G, "Records in the inbox: waiting, leased, dead.", ("state",)),
    ("inbox_bytes", G, "Bytes of ciphertext in the inbox.", ()),
    ("inbox_oldest_seconds", G, "Age of the oldest record that is not in the journal yet; 0 if there is none.", ()),
    ("batches", G, "Batches in the journal, by state.", ("state",)),
    ("dead_letters", G, "Records that can never be written, by where they are kept: inbox, journal.", ("where",)),
    ("disk_free_bytes", G, "Bytes free where the store is.", ()),
    # The submitter.
    ("records_gathered", C, "Records taken over from the inbox into batches.", ()),
    ("batches_sealed", C, "Batches sealed.", ()),
    ("batches_confirmed", C, "Batches confirmed.", ()),
    ("records_confirmed", C, "Records in batches confirmed.", ()),
    ("gas_used", C, "Gas of the batches confirmed.", ()),
    ("submit_seconds", H, "From a batch sealed to a node's acceptance.", ()),
    ("include_seconds", H, "From acceptance to a block seen to hold it.", ()),
    ("confirm_seconds", H, "From that block to the configured depth.", ()),
    ("robots_blocked", G, "Robots the contract does not let write.", ()),
    ("accounts_not_leased", G, "Accounts that another submitter holds.", ()),
    ("treasury_empty", G, "1 while the operator's account cannot pay a top-up.", ()),
    ("fee_capped", G, "1 while gas costs more than [chain] max_fee_gwei.", ()),
    # The node.
    ("head_block", G, "Number of the last block.", ()),
    ("head_age_seconds", G, "Age of the last block by its own timestamp.", ()),
    ("node_answered_seconds", G, "Seconds since the node last answered.", ()),
    ("balance_eth", G, "Balance, by account.", ("account", "name")),
    # The server's processes.
    ("process_up", G, "1 while the process runs.", ("process",)),
    ("process_restarts", C, "How often the process was started again.", ("process",)),
    ("snapshot_age_seconds", G, "Seconds since the process last published.", ("process",)),
    # The robot.
    ("source_dropped", C, "Messages of live topics that the robot was too slow to capture.", ()),
    ("captured", C, "Messages captured, sealed and spooled.", ()),
    ("too_large", C, "Messages left out because no record holds them.", ()),
    ("sent", C, "Records sent, repeats after a new session included.", ()),
    ("acknowledged", C, "Records by the server's answer: stored, confirmed, conflict, refused, busy.", ("answer",)),
    ("spool_records", G, "Records in the spool.", ()),
    ("spool_bytes", G, "Bytes in the spool.", ()),
    ("spool_removed", C, "Records that left the spool undelivered: superseded, dropped, refused.", ("how",)),
    ("spool_undeclared", G, "Ranges of dropped records no gap record names yet.", ()),
    ("connected", G, "1 while a session with the server stands.", ()),
    ("sessions_begun", C, "Sessions begun.", ()),
    ("stage_seconds", C, "Time spent per stage: capture, seal, spool.", ("stage",)),
)
del C, G, H


@dataclass(slots=True)
class Histogram:
    """Counts of values up to each bound of LATENCIES, and above; grows only."""

    counts: list[int] = field(default_factory=lambda: [0] * (len(LATENCIES) + 1))
    sum: float = 0.0

    def observe(self, seconds: float) -> None:
        """Count a value; a wall clock that was set back gives a negative one, which counts as 0."""
        seconds = max(0.0, seconds)
        self.counts[bisect_left(LATENCIES, seconds)] += 1
        self.sum += seconds

    def buckets(self) -> list[tuple[str, float]]:
        """As Prometheus wants them: cumulative, ending with +Inf."""
        total, shown = 0, []
        for bound, count in zip((*map(str, LATENCIES), "+Inf"), self.counts, strict=True):
            total += count
            shown.append((bound, float(total)))
        return shown


@dataclass(frozen=True, slots=True)
class Sample:
    """One value of a metric; a histogram's is (counts, sum)."""

    metric: str
    value: float | tuple[tuple[int, ...], float]
    labels: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        if len(self.labels) != len(METRICS[self.metric].labels):
            raise ValueError(f"{self.metric} has the labels {METRICS[self.metric].labels}, not {self.labels}")


def sample(metric: str, value: float, *labels: str) -> Sample:
    return Sample(metric, float(value), labels)


def histogram(metric: str, values: Histogram) -> Sample:
    return Sample(metric, (tuple(values.counts), values.sum))


@dataclass(frozen=True, slots=True)
class Condition:
    """Something that must hold for a process to do its work. `says` is for people: why not, and what to do."""

    name: str
    holds: bool
    says: str = ""


@dataclass(frozen=True, slots=True)
class Snapshot:
    """What a process knows of itself at one moment; it replaces the one before."""

    process: str
    samples: tuple[Sample, ...]
    conditions: tuple[Condition, ...] = ()

    @staticmethod
    def of(process: str, samples: Iterable[Sample], conditions: Iterable[Condition] = ()) -> Snapshot:
        return Snapshot(process, tuple(samples), tuple(conditions))

    def encode(self) -> bytes:
        return json.dumps(
            [
                self.process,
                [[s.metric, s.value, s.labels] for s in self.samples],
                [[c.name, c.holds, c.says] for c in self.conditions],
            ],
            separators=(",", ":"),
        ).encode()

    @staticmethod
    def decode(data: bytes) -> Snapshot:
        """The snapshot that `encode` made, by another process of this server."""
        process, samples, conditions = json.loads(data)
        return Snapshot(
            process,
            tuple(Sample(name, _value(value), tuple(labels)) for name, value, labels in samples),
            tuple(Condition(name, holds, says) for name, holds, says in conditions),
        )


def _value(value: float | Sequence[object]) -> float | tuple[tuple[int, ...], float]:
    if isinstance(value, int | float):
        return float(value)
    counts, total = value
    return tuple(counts), total  # type: ignore[arg-type, return-value]


def reference() -> str:
    """METRICS as the table of docs/operations.md, which a test compares."""
    lines = ["| metric | kind | labels | |", "| --- | --- | --- | --- |"]
    for metric in METRICS.values():
        labels = ", ".join(f"`{label}`" for label in metric.labels)
        lines.append(f"| `{metric.shown}` | {metric.kind} | {labels} | {metric.help} |")
    return "\n".join(lines) + "\n"
