"""How many robots a server and a chain bear: a model, with costs that are measured here, and runs that it is held to.

    python benchmarks/paper.py --only scale

Arithmetic, not simulation: nothing here waits for anything else, so that what is said holds for a server and a chain
that are not overloaded. Its assumptions are in `ASSUMED`, and stand on the page that paper.py writes.
"""

from __future__ import annotations

import tempfile
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy

import bridge_costs
import load
from rosbridge_eth.ledger.contract import set_data_gas

RATES = (1, 10, 100)  # messages a second of each robot
ROBOTS = (10, 30, 100, 300, 1000, 3000, 10_000, 30_000, 100_000)
SESSION = 52.5 * 60  # seconds of a session, between 45 and 60 minutes
DAY = 86_400
BATCH = 96 * 1024  # bytes of chunks in a transaction, at most
ANCHOR_EVERY = 60.0
SET_ROOT_GAS = 53_500  # for any number of chunks of a robot; DESIGN section 3, not written yet
HEADER = 139 + 64 + 113  # bytes of a chunk's header, signature and one grant: what is anchored without its body

CHAINS: dict[str, float] = {
    "Clique as tested here": 30e6 / 1,
    "Clique of the paper": 0xFFFFFFFF / 20,
    "Ethereum": 60e6 / 12,
    "a rollup": 60e6 / 2,
}
"""Gas a second, all of it."""

ASSUMED = (
    "A chunk is closed at about 100 records, but after 60 s at the latest: `period` is set to that.",
    "Messages are the sample's Odometry, pose and twist; one reader; compressed as measured.",
    "A robot's chunks of one block go into one transaction of at most 96 KiB.",
    "Sessions last 52.5 minutes and are spread evenly; keep-alives cost nothing beside them.",
    "A worker's processor time is per chunk and per record, a submitter's per chunk; both grow in a straight line.",
    "Gas of a chain in M a second, with nobody else on it: "
    + ", ".join(f"{name} {gas / 1e6:.1f}" for name, gas in CHAINS.items())
    + ". Ethereum: 60 M gas in 12 s; the rollup: 60 M gas in 2 s, a round figure.",
    "Gas is that of the submitter's formula, which is above what the EVM takes by a tenth or so.",
    f"Anchored: header and signature alone, {HEADER} bytes a chunk; or one `setRoot` a robot and minute,"
    f" {SET_ROOT_GAS:,} gas. Neither is built.",
)  # fmt: skip


@dataclass(frozen=True)
class Costs:
    """Processor time in ms, sizes in bytes: what the model is calibrated by."""

    record_ms: float
    chunk_ms: float
    handshake_ms: float
    submitted_ms: float  # a chunk, in the submitter
    record_bytes: float
    chunk_bytes: float
    session_kib: float


@dataclass(frozen=True)
class Need:
    """What some robots need."""

    robots: int
    rate: int
    cores: float
    submitter_cores: float
    memory_gib: float
    bytes_a_day: float
    gas_a_second: float
    anchored_gas_a_second: float
    root_gas_a_second: float


def need(costs: Costs, robots: int, rate: float, block: float) -> Need:
    """block: seconds between blocks."""
    records = min(100.0, 60.0 * rate)
    chunks = rate / records  # a second, of each robot
    size = round(costs.chunk_bytes + records * costs.record_bytes)
    cores = robots * (rate * costs.record_ms + chunks * costs.chunk_ms + costs.handshake_ms / SESSION) / 1000
    together = max(1, min(BATCH // size, round(chunks * block)))
    gas = set_data_gas([size] * together) / together * chunks
    anchored = set_data_gas([HEADER] * together) / together * chunks
    return Need(
        robots, int(rate), cores, robots * chunks * costs.submitted_ms / 1000, robots * costs.session_kib / 2**20,
        robots * chunks * size * DAY, robots * gas, robots * anchored, robots * SET_ROOT_GAS / ANCHOR_EVERY,
    )  # fmt: skip


def holds(costs: Costs, rate: float, gas_a_second: float, block: float, of: Callable[[Need], float]) -> int:
    """The most robots that a chain holds."""
    return int(gas_a_second / of(need(costs, 1, rate, block)))


def calibrate(quick: bool) -> tuple[dict[str, float], list[tuple[float, float, float]]]:
    """The costs of `Costs` that a run of `load.py` does not give, and the rows that they were fitted to."""
    who, rows = bridge_costs.Identities(), []
    for per_chunk in (1, 10, 100):
        records = (5 if quick else 100) * per_chunk
        with tempfile.TemporaryDirectory() as folder:
            found = bridge_costs.stage_costs(who, Path(folder), records, per_chunk, False)
        size = sum(len(chunk.encoded) for chunk in found["chunks"])
        rows.append((1 / per_chunk, sum(cpu for cpu, _ in found["costs"]["server"].values()), size / records))
    inverse, server, sizes = (numpy.array(column) for column in zip(*rows, strict=True))
    _, record_ms = numpy.polyfit(inverse, server, 1)
    chunk_bytes, record_bytes = numpy.polyfit(inverse, sizes, 1)
    return {"record_ms": max(0.0, record_ms), "record_bytes": record_bytes, "chunk_bytes": chunk_bytes}, rows


def measure(quick: bool) -> dict[str, Any]:
    """Calibrate, run more robots than it was calibrated by, and compare."""
    fitted, rows = calibrate(quick)
    counts, messages, per_chunk = ([3, 6], 10, 5) if quick else ([500, 1000, 2000], 40, 10)
    runs = []
    with tempfile.TemporaryDirectory() as folder:
        operator = load.Operator(Path(folder), "anvil", "sqlite", counts[-1], lambda text: None)
        try:
            for count in counts:
                runs.append(load.run(operator, count, messages, per_chunk=per_chunk, limit=1200.0))
        finally:
            operator.close()
    first = runs[0]
    # A worker's time for a chunk is that with many robots: it keeps tables for the keys of 150 or so.
    costs = Costs(
        **fitted, chunk_ms=(first.message_cpu_ms - fitted["record_ms"]) * first.sent / first.chunks,
        handshake_ms=first.handshake_cpu_ms, submitted_ms=first.submitter_cpu_ms * first.sent / first.chunks,
        session_kib=first.growth_kib_per_session,
    )  # fmt: skip
    compared = []
    for run in runs:
        worked = run.sessions * costs.handshake_ms + run.sent * costs.record_ms + run.chunks * costs.chunk_ms
        compared.append({
            "sessions": run.sessions, "messages": run.sent, "chunks": run.chunks, "calibrating": run is first,
            "workers_ms": run.established * run.handshake_cpu_ms + run.sent * run.message_cpu_ms, "model_ms": worked,
            "submitter_ms": run.sent * run.submitter_cpu_ms, "submitter_model_ms": run.chunks * costs.submitted_ms,
            "session_kib": run.growth_kib_per_session, "lost": run.lost, "doubled": run.doubled,
            "equal": run.equal, "load": run.load_average,
        })  # fmt: skip
    needs = [asdict(need(costs, robots, rate, 1.0)) for rate in RATES for robots in ROBOTS]
    limits = {
        name: {str(rate): {
            "whole": holds(costs, rate, gas, block, lambda need: need.gas_a_second),
            "headers": holds(costs, rate, gas, block, lambda need: need.anchored_gas_a_second),
            "roots": holds(costs, rate, gas, block, lambda need: need.root_gas_a_second),
        } for rate in RATES}
        for (name, gas), block in zip(CHAINS.items(), (1.0, 20.0, 12.0, 2.0), strict=True)
    }  # fmt: skip
    return {"rows": rows, "costs": asdict(costs), "compared": compared, "needs": needs, "limits": limits}
