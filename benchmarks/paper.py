"""The paper's evaluation, done again: its tables and figures, with this implementation's rows beside the paper's.

    python -m benchmarks.paper [--runs 3] [--quick] [--only PART ...] [--dag FOLDER] [--out FOLDER]

Writes evaluation.json, evaluation.md and the pictures evaluation-*.svg into FOLDER (docs). Each part keeps its figures
in the JSON file, so that parts can be measured one by one; the page and the pictures are made of what is there. Every
point of a table or picture is the median of the runs, with the lowest and the highest of them.

    user         10,000 messages in sequence at the user end, stage by stage (the paper's Table 3 and Figure 12), and a
                 robot at its real pace
    server       300, 500 and 700 clients, 10 messages each, onto three nodes by proof of authority (Table 4, Figure
                 13), and 200 robots at their real pace
    poa, pow     every client registers once, writes four times and asks four times, by number of clients
    bridge-poa   from `init` to a proven read, four robots as in the paper
    bridge-pow   the same by proof of work, and a reorganisation by two miners that were cut from each other
    latency      from capture to store and chain, through networks that lose and delay (latency.py)
    baseline     the same records into an ordinary replicated log with an anchor on the chain (baseline.py)
    scale        the model of scale.py, with the costs that are measured here

--quick: one run of few messages and clients, the load on anvil, and nothing by proof of work, into a folder of its own:
what continuous integration runs. What each part ran on is printed, and stands on the page.
The paper's figures are those of Security and Communication Networks 2022, article 7206494. By proof of work nodes take
ethash's dataset of 1 GB, which is made in FOLDER of --dag if it is not there: 20 minutes of a busy core.
"""

from __future__ import annotations

import argparse
import importlib.util
import json
import logging
import os
import platform
import statistics
import sys
import tempfile
import time
from collections import defaultdict
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import Any

sys.path.append(str(Path(__file__).parent))  # for `python -m benchmarks.paper`

import baseline
import bridge_costs
import chain_interaction
import geth_network
import latency
import load
import paper_page
import scale
from rosbridge_eth.log.chunk import Chunk, robot_id
from rosbridge_eth.log.store import Offer
from rosbridge_eth.operator.registry import Registry
from rosbridge_eth.server.shard import open_store, open_submitter
from rosbridge_eth.server.submitter import Submitter

PER_BUCKET = 100  # messages that share a point of the picture
CONFIRMATIONS = {"poa": 3, "pow": 12}
DEPTH = 6  # blocks that the reorganisation takes back, at least

CLIQUE, ETHASH = "three nodes of geth 1.13 with Clique", "three nodes of geth 1.10 with ethash"

Part = dict[str, Any]


class Trace(bridge_costs.Stopwatch):
    """Keeps every call's seconds by stage."""

    def __init__(self) -> None:
        super().__init__()
        self.calls: dict[str, list[float]] = defaultdict(list)

    @contextmanager
    def __call__(self, stage: str) -> Iterator[None]:
        started = time.perf_counter()
        with super().__call__(stage):
            yield
        self.calls[stage].append(time.perf_counter() - started)


def milliseconds(values: Sequence[float]) -> dict[str, float]:
    """How seconds are distributed, in ms."""
    ordered = sorted(values)
    if not ordered:
        return {}
    at = {name: ordered[int(share * (len(ordered) - 1))] for name, share in
          (("least", 0.0), ("5 %", 0.05), ("median", 0.5), ("95 %", 0.95), ("most", 1.0))}  # fmt: skip
    return {name: value * 1000 for name, value in (at | {"mean": statistics.fmean(ordered)}).items()}


def user_end(quick: bool) -> Part:
    """The robot's stages, message by message: a chunk for each, as the paper has it, and 100 to a chunk."""
    messages = 200 if quick else 10_000
    who, part = bridge_costs.Identities(), Part(messages=messages, runs={})
    for per_chunk in (1, 100):
        watch = Trace()
        with tempfile.TemporaryDirectory() as folder:
            bridge_costs.stage_costs(who, Path(folder), messages, per_chunk, False, watch=watch, turn=per_chunk)
        own = {stage.partition(": ")[2]: calls for stage, calls in watch.calls.items() if stage.startswith("robot: ")}
        series = {}
        for stage in ("capture", "seal", "spool", "send"):
            each = spread(own[stage], messages)
            series[stage] = [statistics.fmean(each[at : at + PER_BUCKET]) * 1000
                             for at in range(0, messages, PER_BUCKET)]  # fmt: skip
        whole = [sum(spread(own[stage], messages)[n] for stage in series) for n in range(messages)]
        part["runs"][str(per_chunk)] = {
            "stages": {stage: sum(calls) / messages * 1000 for stage, calls in own.items()},
            "processor": {stage.partition(": ")[2]: seconds / messages * 1000 for stage, seconds in
                          watch.seconds.items() if stage.startswith("robot: ")},
            "whole": milliseconds(whole), "series": series,
        }  # fmt: skip
    with tempfile.TemporaryDirectory() as folder:
        rate, per_chunk_, stored, _ = bridge_costs.throughput(who, Path(folder), messages, False)
    opening = 2  # lines of the stream that are no messages: what it is from, and the type's definition
    seconds = 1 if quick else 20
    with tempfile.TemporaryDirectory() as folder:
        _, paced_chunk, _, (waking, rest) = bridge_costs.throughput(
            who, Path(folder), int(seconds * bridge_costs.PACE), False, pace=bridge_costs.PACE
        )
    return part | {
        "rate": rate, "per_chunk": per_chunk_, "delivered": stored - opening, "on": "no chain",
        "paced": {"pace": bridge_costs.PACE, "per_chunk": paced_chunk, "ms": waking + rest, "waking": waking},
    }  # fmt: skip


def spread(calls: Sequence[float], messages: int) -> list[float]:
    """What each message took of calls that several messages share."""
    share = min(1.0, len(calls) / messages)
    return [calls[int(n * share)] * share for n in range(messages)]


def server_end(quick: bool) -> Part:
    """The load of the paper's clients, through the real server onto three nodes by proof of authority; and of robots
    at their real pace, 10 messages a second and a chunk a second each."""
    counts, messages = ([10], 3) if quick else ([300, 500, 700], 10)
    robots, paced_messages = (4, 20) if quick else (200, 300)
    runs = []
    with tempfile.TemporaryDirectory() as folder:
        operator = load.Operator(Path(folder), "anvil" if quick else "clique", "sqlite", max(counts), say)
        try:
            for count in counts:
                runs.append(asdict(load.run(operator, count, messages, on_stage=say)))
            paced = load.run(operator, robots, paced_messages, per_chunk=10, pace=10.0, on_stage=say)
        finally:
            operator.close()
    return {"runs": runs, "paced": asdict(paced), "on": "anvil" if quick else CLIQUE}


def interaction(kind: str, quick: bool, dag: Path | None) -> Part:
    """The response times of registration, writing and querying, by number of clients."""
    part = Part(runs=[], on=CLIQUE if dag is None else ETHASH)
    periods = {"poa": [1] if quick else [1, 20], "pow": [0]}[kind]
    for period in periods:
        counts = [4] if quick else [100] if period == 20 else [10, 30, 100]
        with chain_interaction.network("clique" if dag is None else "ethash", 0, period, dag) as urls:
            for clients in counts:
                say(f"{kind}, a block every {period or '13 or so'} s: {clients} clients")
                found = chain_interaction.measure(urls, clients)
                registered, used = found["registration"], found["use"]
                part["runs"].append({
                    "period": period, "clients": clients, "load": os.getloadavg()[0],
                    "registered": len(registered.get("written", [])),
                    "written": len(used.get("written", [])), "answered": len(used.get("answered", [])),
                    "times": {"registration": {k: milliseconds(registered.get(k, [])) for k in paper_page.STEPS},
                              "write": {k: milliseconds(used.get(k, [])) for k in paper_page.STEPS},
                              "query": milliseconds(used["query"])},
                })  # fmt: skip
    return part


def bridge(kind: str, quick: bool, dag: Path | None) -> Part:
    """Four robots from `init` to a proven read; by proof of work with a reorganisation in a second run."""
    messages = 10 if quick else 300
    network = chain_interaction.network("clique" if dag is None else "ethash", 0, 1, dag)
    with network as urls, tempfile.TemporaryDirectory() as folder:
        began = time.monotonic()
        operator = load.Operator(
            Path(folder), urls[0], "sqlite", 4, say, keys=chain_interaction.KEYS, confirmations=CONFIRMATIONS[kind]
        )
        ready = time.monotonic() - began
        try:
            run = load.run(operator, 4, messages, per_chunk=10, limit=1200.0, on_stage=say)
        finally:
            operator.close()
    part = Part(
        run=asdict(run), ready=ready, confirmations=CONFIRMATIONS[kind], on=CLIQUE if dag is None else ETHASH
    )
    return part if dag is None else part | {"reorganisation": reorganisation(dag)}


def reorganisation(dag: Path) -> Part:
    """Two miners are cut from each other, and the one that the submitter writes to loses.

    It is stopped DEPTH blocks after it was cut off; the other goes on with two threads until it is further. What was
    written in the lost blocks has to be on the chain once again afterwards, once, and everything in order.
    """
    keys = chain_interaction.KEYS
    with tempfile.TemporaryDirectory() as folder, geth_network.Network(
        Path(folder) / "network", geth_network.ten_accounts(keys.operator.address), nodes=2, miners=2, dag=dag
    ) as network:  # fmt: skip
        ours, other = network.nodes
        network.await_blocks(2)
        operator = load.Operator(
            Path(folder), ours.url, "sqlite", 1, say, keys=keys, confirmations=CONFIRMATIONS["pow"]
        )
        [robot] = operator.robots
        tk = robot_id(robot.name)
        session = load.Session(operator, robot, ("127.0.0.1", 9))
        sealed = session.seal(300, 15)
        chunks = [Chunk.parse(chunk) for chunk in sealed.values()]
        inbox = open_store(operator.config, operator.home)
        submitter = open_submitter(
            operator.config, operator.ledger, inbox, Registry(operator.home.registry), operator.keys
        )

        def written() -> int:
            return operator.ledger.standings([tk])[0].chunks

        def stands(chunks: int) -> bool:
            return written() == chunks

        inbox.append([Offer(tk, chunk) for chunk in chunks[:5]], time.time())
        turn_until(submitter, partial(stands, 5))
        say("the miners are cut from each other")
        network.cut_off(ours)
        fork = ours.height()
        other.request("miner_start", 2)
        for given in (10, 15):  # two batches, in blocks that will be lost
            inbox.append([Offer(tk, chunk) for chunk in chunks[given - 5 : given]], time.time())
            turn_until(submitter, partial(stands, given))
        turn_until(submitter, lambda: ours.height() >= fork + DEPTH)
        ours.request("miner_stop")
        before, depth = written(), ours.height() - fork
        say(f"{before - 5} chunks stand in {depth} blocks that will be lost")
        while other.height() <= ours.height() + 2:
            time.sleep(0.5)
        head = ours.request("eth_getBlockByNumber", hex(fork + depth), False)["hash"]
        network.connect()
        while ours.request("eth_getBlockByNumber", hex(fork + depth), False)["hash"] == head:
            time.sleep(0.5)
        after = written()
        say(f"the chain turned: {after} chunks are left")
        inbox.append([Offer(tk, chunk) for chunk in chunks[15:]], time.time())
        ours.request("miner_start", 1)
        turn_until(submitter, partial(stands, len(chunks)))
        found = load.read_back(operator, operator.ledger, robot)
        back = [chunk for batch in found.batches for chunk in batch]
        figures = Part(
            depth=depth, before=before, after=after, sealed=len(chunks), there=len(back), in_order=back == [
                chunk.encoded for chunk in chunks
            ], findings=found.findings, reverted=submitter.counts.get("reverted", 0),
        )  # fmt: skip
        session.spool.close()
        inbox.close()
        operator.close()
        return figures


def turn_until(submitter: Submitter, holds: Callable[[], bool], limit: float = 900.0) -> None:
    deadline = time.monotonic() + limit
    while not holds():
        if time.monotonic() > deadline:
            raise SystemExit("the submitter did not bring its chunks onto the chain in time")
        time.sleep(min(submitter.turn(time.time()), 0.5))


def say(text: str) -> None:
    print(f"{time.strftime('%H:%M:%S')}  {text}", file=sys.stderr, flush=True)


def machine() -> dict[str, Any]:
    fast = all(importlib.util.find_spec(name) for name in ("cryptography", "gmpy2"))  # the extra [fast]
    return {"processor": load.processor(), "python": platform.python_version(), "fast": fast,
            "load": round(os.getloadavg()[0], 1)}  # fmt: skip


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true")
    parser.add_argument("--runs", type=int, help="of each part; 3, with --quick 1")
    parser.add_argument("--only", nargs="*", metavar="PART", help="measure these; none: only make page and pictures")
    parser.add_argument("--dag", type=Path, default=Path(".dag"))
    parser.add_argument("--out", type=Path, help="docs; with --quick evaluation-quick in the folder of temporary files")
    options = parser.parse_args()
    docs = Path(__file__).resolve().parent.parent / "docs"
    options.out = options.out or (Path(tempfile.gettempdir()) / "evaluation-quick" if options.quick else docs)
    logging.getLogger("rosbridge_eth").setLevel(logging.ERROR)
    file = options.out / "evaluation.json"
    figures: dict[str, Any] = json.loads(file.read_text()) if file.exists() else {}
    quick, dag, runs = options.quick, options.dag, options.runs or (1 if options.quick else 3)
    parts: Mapping[str, Callable[[], Part]] = {
        "user": lambda: user_end(quick),
        "server": lambda: server_end(quick),
        "poa": lambda: interaction("poa", quick, None),
        "bridge-poa": lambda: bridge("poa", quick, None),
        "pow": lambda: interaction("pow", quick, dag),
        "bridge-pow": lambda: bridge("pow", quick, dag),
        "latency": lambda: latency.measure(quick) | {"on": "anvil"},
        "baseline": lambda: baseline.measure(quick) | {"on": "the embedded chain"},
        "scale": lambda: scale.measure(quick) | {"on": "anvil"},
    }
    wanted = options.only if options.only is not None else [name for name in parts if not (quick and "pow" in name)]
    if unknown := set(wanted) - set(parts):
        parser.error(f"there is no part {', '.join(sorted(unknown))}; there are {', '.join(parts)}")
    options.out.mkdir(parents=True, exist_ok=True)
    try:
        if any("pow" in name for name in wanted):
            say("ethash's dataset")
            geth_network.make_dag(dag)
        for name in wanted:
            before, began = machine(), time.monotonic()
            measured = []
            for number in range(runs):
                say(f"part {name}, run {number + 1} of {runs}")
                measured.append(parts[name]())
            figures[name] = {"quick": quick, "edition": paper_page.EDITION, "machine": before,
                             "seconds": time.monotonic() - began, "measured": measured}  # fmt: skip
            file.write_text(json.dumps(figures, indent=1) + "\n")
    except geth_network.Unavailable as reason:
        raise SystemExit(str(reason)) from None
    for picture in paper_page.draw(figures, options.out):
        say(f"{picture}")
    (options.out / "evaluation.md").write_text(paper_page.page(figures))
    print(f"{options.out / 'evaluation.md'}\n\n{paper_page.ran_on(figures)}")


if __name__ == "__main__":
    main()
