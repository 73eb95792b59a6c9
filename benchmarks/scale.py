"""How many robots a server and a chain bear: a model, with costs that are measured here, and runs that it is held to.

    python -m benchmarks.paper --only scale

Arithmetic, not simulation: nothing here waits for anything else, so that what is said holds for a server and a chain
that are not overloaded. Its assumptions are in `ASSUMED`, and stand on the page that paper.py writes.
"""

from __future__ import annotations

import tempfile
import time
from dataclasses import asdict, dataclass
from math import ceil, inf
from pathlib import Path
from typing import Any

import numpy

import bench_reading
import bridge_costs
import load
from rosbridge_eth.ledger.contract import set_data_gas
from rosbridge_eth.operator.registry import Registry
from rosbridge_eth.server.shard import open_store, open_submitter

RATES = (1, 10, 100)  # messages a second of each robot
ROBOTS = (10, 30, 100, 300, 1000, 3000, 10_000, 30_000, 100_000)
SESSION = 52.5 * 60  # seconds of a session, between 45 and 60 minutes
DAY = 86_400
BATCH = 96 * 1024  # bytes of chunks in a transaction, at most
NODE_DISK = 3.7  # bytes on a node's disk for each byte of chunks: measured with geth and Clique
REGISTERING_GAS = 146_733  # a robot, once: docs/ledger.md

CHAINS: dict[str, float] = {
    "Clique as tested here": 30e6 / 1,
    "Clique of the paper": 0xFFFFFFFF / 20,
    "Ethereum": 60e6 / 12,
    "a rollup": 60e6 / 2,
}
"""Gas a second, all of it."""

ASSUMED = (
    "A chunk is closed at about 100 records, or after 60 s (`period` set to that). Records are the sample's Odometry,"
    " pose and twist, for one reader. Sessions last 52.5 minutes, spread evenly.",
    "A robot's chunks of one block go into one transaction of at most 96 KiB, by the submitter's formula, a tenth above"
    f" the EVM's gas. Registering a robot takes {REGISTERING_GAS:,} once. A node's disk takes {NODE_DISK} times the"
    " bytes of the chunks.",
    "All costs grow in a straight line. A submitter is one thread, a core at most; one more is one shard more.",
    "Gas of a chain, in M a second, with nobody else on it: "
    + ", ".join(f"{name} {gas / 1e6:.1f}" for name, gas in CHAINS.items())
    + ". Ethereum: 60 M in 12 s; the rollup: 60 M in 2 s, a round figure.",
)  # fmt: skip


@dataclass(frozen=True)
class Costs:
    """Processor time in ms, sizes in bytes: what the model is calibrated by."""

    record_ms: float
    chunk_ms: float
    handshake_ms: float
    session_ms: float  # a session and second in which nothing is said, in the shard
    submitted_ms: float  # a chunk, in the submitter
    quiet_ms: float  # a registered robot and look at the chain, in the submitter
    read_record_ms: float  # at a reader
    read_chunk_ms: float
    registering_ms: float  # of the clock, a robot: keys, certificates, transactions on anvil
    record_bytes: float
    chunk_bytes: float
    session_kib: float


@dataclass(frozen=True)
class Need:
    """What some robots need. shards: as many as their submitters need, each of which has one core.

    reading_s: the processor's seconds that a reader takes for a robot's day.
    """

    robots: int
    rate: int
    cores: float
    submitter_cores: float
    shards: int
    memory_gib: float
    bytes_a_day: float
    disk_a_day: float
    gas_a_second: float
    reading_s: float


def need(costs: Costs, robots: int, rate: float, block: float) -> Need:
    """block: seconds between blocks."""
    records = min(100.0, 60.0 * rate)
    chunks = rate / records  # a second, of each robot
    size = round(costs.chunk_bytes + records * costs.record_bytes)
    session = costs.session_ms + costs.handshake_ms / SESSION
    cores = robots * (rate * costs.record_ms + chunks * costs.chunk_ms + session) / 1000
    submitter = robots * (chunks * costs.submitted_ms + costs.quiet_ms) / 1000  # it looks once a second
    together = max(1, min(BATCH // size, round(chunks * block)))
    gas = set_data_gas([size] * together) / together * chunks
    kept = robots * chunks * size * DAY
    reading = chunks * DAY * (costs.read_chunk_ms + records * costs.read_record_ms) / 1000
    return Need(
        robots, int(rate), cores, submitter, ceil(submitter), robots * costs.session_kib / 2**20, kept,
        NODE_DISK * kept, robots * gas, reading,
    )  # fmt: skip


def most(costs: Costs, rate: float, block: float, gas_a_second: float = inf, submitter_cores: float = inf) -> int:
    """The most robots that a chain holds and so many submitters bear."""
    one = need(costs, 1, rate, block)
    return int(min(gas_a_second / one.gas_a_second, submitter_cores / one.submitter_cores))


def calibrate(quick: bool) -> dict[str, float]:
    """The costs of `Costs` that a run of `load.py` does not give: straight lines through three sizes of chunks.

    Errors count in proportion, so that a record's small cost is not lost in the noise of the chunk's. Nothing is cut
    off at zero: a cost below it says that the fit does not tell it from nothing.
    """
    who, rows = bridge_costs.Identities(), []
    for per_chunk in (1, 10, 100):
        count = 5 if quick else 100
        with tempfile.TemporaryDirectory() as folder:
            found = bridge_costs.stage_costs(who, Path(folder), count * per_chunk, per_chunk, False)
        size = sum(len(chunk.encoded) for chunk in found["chunks"])
        read = bench_reading.History(bridge_costs.POSE_AND_TWIST, count, per_chunk).read() * 1000
        rows.append((per_chunk, sum(cpu for cpu, _ in found["costs"]["server"].values()) * per_chunk, size / count,
                     read / count))  # fmt: skip
    records, *columns = (numpy.array(column) for column in zip(*rows, strict=True))
    (record_ms, _), (record_bytes, chunk_bytes), (read_record_ms, read_chunk_ms) = (
        numpy.polyfit(records, column, 1, w=1 / column) for column in columns
    )
    return {"record_ms": record_ms, "record_bytes": record_bytes, "chunk_bytes": chunk_bytes,
            "read_record_ms": read_record_ms, "read_chunk_ms": read_chunk_ms}  # fmt: skip


def quiet(operator: load.Operator, looks: int) -> float:
    """Milliseconds of processor time that the submitter takes for a registered robot which says nothing, and a look."""
    store, registry = open_store(operator.config, operator.home), Registry(operator.home.registry)
    submitter = open_submitter(operator.config, operator.ledger, store, registry, operator.keys)
    now = time.time()
    submitter.turn(now)
    started = time.process_time()
    for look in range(1, looks + 1):
        submitter.turn(now + 2.0 * look)
    used = time.process_time() - started
    store.close()
    return used / looks / len(registry.robots()) * 1000


def measure(quick: bool) -> dict[str, Any]:
    """Calibrate, run more robots than it was calibrated by, and compare."""
    fitted = calibrate(quick)
    counts, messages, per_chunk = ([3, 6], 10, 5) if quick else ([200, 400, 800], 40, 10)
    runs = list[load.Figures]()
    with tempfile.TemporaryDirectory() as folder:
        operator = load.Operator(Path(folder), "anvil", "sqlite", counts[-1], lambda text: None)
        try:
            for count in counts:
                idle = 0.0 if runs else 1.0 if quick else 20.0
                runs.append(load.run(operator, count, messages, per_chunk=per_chunk, idle=idle, limit=1200.0))
            quiet_ms = quiet(operator, 2 if quick else 20)
        finally:
            operator.close()
    first = runs[0]
    # A shard's time for a chunk is that with many robots: it keeps tables for the keys of 150 or so.
    costs = Costs(
        **fitted, chunk_ms=(first.message_cpu_ms - fitted["record_ms"]) * first.sent / first.chunks,
        handshake_ms=first.handshake_cpu_ms, submitted_ms=first.submitter_cpu_ms * first.sent / first.chunks,
        quiet_ms=quiet_ms, session_ms=first.idle_cpu_ms, session_kib=first.growth_kib_per_session,
        registering_ms=operator.registering_ms,
    )  # fmt: skip
    compared = []
    for run in runs:
        worked = run.sessions * costs.handshake_ms + run.sent * costs.record_ms + run.chunks * costs.chunk_ms
        compared.append({
            "sessions": run.sessions, "messages": run.sent, "chunks": run.chunks, "calibrating": run is first,
            "shard_ms": run.established * run.handshake_cpu_ms + run.sent * run.message_cpu_ms, "model_ms": worked,
            "submitter_ms": run.sent * run.submitter_cpu_ms, "submitter_model_ms": run.chunks * costs.submitted_ms,
            "session_kib": run.growth_kib_per_session, "lost": run.lost, "doubled": run.doubled,
            "equal": run.equal, "load": run.load_average,
        })  # fmt: skip
    needs = [asdict(need(costs, robots, rate, 1.0)) for rate in RATES for robots in ROBOTS]
    limits = {
        name: {str(rate): most(costs, rate, block, gas_a_second=gas, submitter_cores=1.0) for rate in RATES}
        for (name, gas), block in zip(CHAINS.items(), (1.0, 20.0, 12.0, 2.0), strict=True)
    } | {"one shard's submitter": {str(rate): most(costs, rate, 1.0, submitter_cores=1.0) for rate in RATES}}
    return {"costs": asdict(costs), "compared": compared, "needs": needs, "limits": limits}
