"""The page and the pictures of paper.py: what was measured, beside what the paper has."""

from __future__ import annotations

import re
import textwrap
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import Any

import matplotlib

import scale
from spread import Point, across, along, at

matplotlib.use("Agg")

import matplotlib.pyplot as plt
from cycler import cycler

EDITION = 3  # of the bridge; what was measured with an earlier one is marked
STEPS = ("submit", "include", "confirm")
SAID = {"submit": "accepted by the node", "include": "in a block", "confirm": "two more on top"}
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")  # Okabe and Ito's, for every eye
PAPER = {300: (2994, 2993, 186.34), 500: (4986, 4986, 249.88), 700: (6991, 6991, 370.29)}
"""By clients: received, on the chain, ms of decryption in 8 processes."""
CHAINS = {"poa": "proof of authority", "pow": "proof of work"}
PARTS = ("user", "server", "poa", "bridge-poa", "pow", "bridge-pow", "latency", "baseline", "scale")
Figures = Mapping[str, Any]
Runs = Sequence[Any]
"""What each run of a part has found."""


def number(value: float) -> str:
    """Three digits or so."""
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"


def seconds(milliseconds: float) -> str:
    return f"{milliseconds / 1000:.3g}"


def table(head: Sequence[str], rows: Sequence[Sequence[object]]) -> str:
    lines = ["| " + " | ".join(head) + " |", "| --- |" + " ---: |" * (len(head) - 1)]
    return "\n".join(lines + ["| " + " | ".join(str(cell) for cell in row) + " |" for row in rows])


# --- pictures


def draw(figures: Figures, folder: Path) -> list[Path]:
    """Each picture whose figures are there; their files."""
    plt.rcParams.update({"font.size": 9, "axes.spines.top": False, "axes.spines.right": False, "svg.hashsalt": "paper",
                         "axes.prop_cycle": cycler(color=COLOURS)})  # fmt: skip
    drawn = []
    for name, parts, make in (("user", {"user"}, _user), ("server", {"server"}, _server),
                              ("chain", {"poa", "pow"}, _chain), ("scale", {"scale"}, _scale)):  # fmt: skip
        if parts & set(figures):
            figure = make(figures)
            drawn.append(folder / f"evaluation-{name}.svg")
            figure.savefig(drawn[-1], metadata={"Date": None})
            plt.close(figure)
    return drawn


def _bars(points: Sequence[Point]) -> list[list[float]]:
    """From the median down to the lowest run, and up to the highest."""
    return [[p.median - p.low for p in points], [p.high - p.median for p in points]]


def _user(figures: Figures) -> Any:
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.8), layout="constrained")
    runs = figures["user"]["measured"]
    for axis, per_chunk in zip(axes, runs[0]["runs"], strict=True):
        own = [run["runs"][per_chunk]["series"] for run in runs]
        stages = {stage: along(own, at(stage)) for stage in own[0]}
        whole = along(own, lambda series: [sum(each) for each in zip(*series.values(), strict=True)])
        step = runs[0]["messages"] / len(whole)
        places = [step * (n + 0.5) for n in range(len(whole))]
        axis.stackplot(places, [[p.median for p in points] for points in stages.values()], labels=stages)
        if len(runs) > 1:
            axis.fill_between(places, [p.low for p in whole], [p.high for p in whole], color="0.2", alpha=0.3,
                              linewidth=0, label="lowest to highest run")  # fmt: skip
        axis.axhspan(0.50, 1.23, color="0.88", zorder=0, label="the paper's SM4, 0.50 to 1.23 ms")
        axis.axhline(0.852, color="0.3", linestyle="--", linewidth=1, label="the paper, 0.852 ms")
        axis.set_ylim(0, max(1.4, 1.2 * max(p.high for p in whole)))
        axis.set(title="a chunk for each message" if per_chunk == "1" else f"{per_chunk} messages to a chunk",
                 xlabel="message")  # fmt: skip
    axes[0].set_ylabel("ms a message, mean of 100")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, fontsize=8)
    return figure


def _server(figures: Figures) -> Any:
    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.8), layout="constrained")
    measured = [part["runs"] for part in figures["server"]["measured"]]
    loads = measured[0]
    places = list(range(len(loads)))
    names = [f"{run['sessions']} × {run['messages']}" for run in loads]
    lost = along(measured, lambda runs: [run["sent"] - run["equal"] for run in runs])
    left.bar([p - 0.2 for p in places], [p.median for p in lost], 0.4, label="here", yerr=_bars(lost))
    theirs = [run["sent"] - PAPER[run["sessions"]][0] if run["sessions"] in PAPER else 0 for run in loads]
    left.bar([p + 0.2 for p in places], theirs, 0.4, label="the paper")
    for place, ours, paper in zip(places, lost, theirs, strict=True):
        left.text(place - 0.2, ours.high, ours.say(".0f"), ha="center", va="bottom")
        left.text(place + 0.2, paper, str(paper), ha="center", va="bottom")
    left.set(xticks=places, xticklabels=names, ylabel="messages lost")
    left.legend()
    stages: dict[str, Callable[[Any], float]] = {
        "open the channel": lambda run: run["opening_ms"] / run["sent"],
        "verify signatures": lambda run: run["verifying_ms"] / run["sent"],
        "the rest of the shard": lambda run: max(
            0.0, run["message_cpu_ms"] - (run["opening_ms"] + run["verifying_ms"]) / run["sent"]
        ),
        "submitter": lambda run: run["submitter_cpu_ms"],
    }
    below = [0.0] * len(loads)
    for stage, value in stages.items():
        points = along(measured, partial(_map, value))
        right.bar(places, [p.median for p in points], 0.5, bottom=below, label=stage)
        below = [a + p.median for a, p in zip(below, points, strict=True)]
    whole = along(measured, lambda runs: [run["message_cpu_ms"] + run["submitter_cpu_ms"] for run in runs])
    if len(measured) > 1:
        right.errorbar(places, [p.median for p in whole], _bars(whole), fmt="none", color="0.2", capsize=3)
    right.set(xticks=places, xticklabels=names, ylabel="processor, ms a message")
    right.legend(fontsize=8, loc="upper center", bbox_to_anchor=(0.5, -0.1), ncols=2)
    return figure


def _chain(figures: Figures) -> Any:
    kinds = [kind for kind in CHAINS if kind in figures]
    figure, axes = plt.subplots(1, len(kinds), figsize=(4.5 * len(kinds), 4.2), sharey=True, squeeze=False,
                                layout="constrained")
    for axis, kind in zip(axes[0], kinds, strict=True):
        measured = [[run for run in part["runs"] if run["period"] <= 1] for part in figures[kind]["measured"]]
        clients = [run["clients"] for run in measured[0]]
        curves = [("registration", step) for step in STEPS] + [("write", step) for step in STEPS] + [("query", None)]
        for index, (what, step) in enumerate(curves):
            keys = ("times", what, "median") if step is None else ("times", what, step, "median")
            middle = along(measured, partial(_map, at(*keys)))
            colour = COLOURS[{"registration": 0, "write": 1, "query": 2}[what]]
            style = {"submit": ":", "include": "--", "confirm": "-", None: ":"}[step]
            axis.errorbar([c * (1 + 0.015 * (index - 3)) for c in clients], [p.median for p in middle],
                          yerr=_bars(middle), color=colour, linestyle=style, marker="o", markersize=3, linewidth=1.2,
                          elinewidth=0.7, capsize=2,
                          label=what if step is None else f"{what}, {SAID[step]}")  # fmt: skip
        edition = figures[kind]["edition"]
        axis.set(title=CHAINS[kind] + ("" if edition == EDITION else f" (edition {edition})"), xlabel="clients",
                 xscale="log", yscale="log")  # fmt: skip
        axis.set_xticks(clients, [str(c) for c in clients])
        axis.minorticks_off()
    axes[0][0].set_ylabel("ms, median")
    figure.legend(*axes[0][0].get_legend_handles_labels(), loc="outside lower center", ncols=2, fontsize=8)
    return figure


def _map(figure: Callable[[Any], float], found: Sequence[Any]) -> list[float]:
    return [figure(one) for one in found]


def _scale(figures: Figures) -> Any:
    """Each curve ends where one shard's submitter has enough; what was not run is dashed, on grey."""
    figure, axes = plt.subplots(1, 3, figsize=(11, 3.8), layout="constrained")
    measured = figures["scale"]["measured"]
    tried = max(row["sessions"] for row in measured[0]["compared"])
    curves: tuple[tuple[str, Callable[[Any], float]], ...] = (
        ("cores: shard and its submitter", lambda need: need["cores"] + need["submitter_cores"]),
        ("GB a day on the chain", lambda need: need["bytes_a_day"] / 1e9),
        ("M gas a second", lambda need: need["gas_a_second"] / 1e6),
    )
    for axis, (unit, value) in zip(axes, curves, strict=True):
        highest = 0
        for rate, colour in zip(scale.RATES, COLOURS, strict=False):
            own = [[need for need in run["needs"] if need["rate"] == rate and need["submitter_cores"] <= 1]
                   for run in measured]  # fmt: skip
            shortest = min(map(len, own))
            robots = [need["robots"] for need in own[0][:shortest]]
            points = along([needs[:shortest] for needs in own], partial(_map, value))
            for (x, p), (next_x, next_p) in pairwise(zip(robots, points, strict=True)):
                axis.plot([x, next_x], [p.median, next_p.median], color=colour, linewidth=1.3,
                          linestyle="-" if next_x <= tried else "--")  # fmt: skip
            axis.errorbar(robots, [p.median for p in points], _bars(points), color=colour, fmt="o", markersize=3,
                          capsize=2, label=f"{rate} messages/s each")  # fmt: skip
            highest = max(highest, robots[-1])
        axis.axvspan(tried, 2 * highest, color="0.92", zorder=0, label=f"extrapolated: over {tried:,} robots")
        axis.set(xscale="log", yscale="log", xlabel="robots", title=unit, xlim=(robots[0] / 1.5, 2 * highest))
    for gas in sorted(set(scale.CHAINS.values())):
        axes[2].axhline(gas / 1e6, color="0.5", linewidth=0.8, linestyle=":")
        names = "\n".join(name for name, own in scale.CHAINS.items() if own == gas)
        axes[2].annotate(names, (1.02, gas / 1e6), xycoords=("axes fraction", "data"), fontsize=8, va="center")
    figure.legend(*axes[0].get_legend_handles_labels(), loc="outside lower center", ncols=4, fontsize=8)
    return figure


# --- the page


def page(figures: Figures) -> str:
    """docs/evaluation.md."""
    sections = [_head(figures)]
    for name, make in (
        ("user", _user_section), ("server", _server_section), ("chain", _chain_section), ("bridge", _bridge_section),
        ("latency", _latency_section), ("baseline", _baseline_section), ("scale", _scale_section),
    ):  # fmt: skip
        if name in figures or name in ("chain", "bridge"):
            sections.append(make(figures))
    blocks = "\n\n".join(filter(None, sections)).split("\n\n")
    return "\n\n".join(map(_wrapped, blocks)) + "\n"


def _wrapped(block: str) -> str:
    """Paragraphs and lists in lines of 120; tables, headings and pictures as they are."""
    if block.startswith("- "):
        items = re.split(r"\n(?=- )", block)
        return "\n".join(textwrap.fill(item, 120, subsequent_indent="  ", break_on_hyphens=False) for item in items)
    if block.startswith(("|", "#", "![")):
        return block
    return textwrap.fill(block, 120, break_on_hyphens=False, break_long_words=False)


def ran_on(figures: Figures) -> str:
    """What each part ran on: a sentence for each machine, a row for each part."""
    machines = dict[str, list[str]]()
    for name, part in figures.items():
        own = part["machine"]
        fast = "with" if own["fast"] else "without"
        machines.setdefault(f"{own['processor']}, Python {own['python']}, {fast} `[fast]`", []).append(name)
    said = "\n".join(f"- {machine}: {', '.join(names)}" for machine, names in machines.items())
    rows = [(name + " (--quick)" * part["quick"], part["measured"][0]["on"], part["machine"]["load"],
             len(part["measured"]), f"{part['seconds'] / 60:.1f}", part["edition"])
            for name, part in figures.items()]  # fmt: skip
    return f"{said}\n\n{table(['part', 'chain', 'load before', 'runs', 'minutes', 'edition'], rows)}"


def _head(figures: Figures) -> str:
    missing = [name for name in PARTS if name not in figures]
    old = [name for name, part in figures.items() if part["edition"] != EDITION]
    notes = f"\n\nNot measured yet: {', '.join(missing)}." if missing else ""
    if old:
        notes += f"""

**Measured with the second edition of the bridge**, and marked: {", ".join(old)}. Measured again by
`python -m benchmarks.paper --only {" ".join(old)}`."""
    return f"""# The paper's evaluation, done again

The tables and figures of the paper that this project implements (Security and Communication Networks 2022, article
7206494; 10-core i9-10900KF at 3.7 GHz, 64 GB), with rows from this implementation. `python -m benchmarks.paper` writes
this page and [evaluation.json](evaluation.json), `--only PART` measures one part. Figures are the median of the runs,
in brackets the lowest and the highest where there were several.

{ran_on(figures)}{notes}

**What differs from the paper.** The processors: rows compare two systems on two machines. Robots, server, nodes and
clients share one here; a client is a socket in one of two processes, in the paper a process. Our message is signed by
its chunk, sealed for the readers, and encrypted by the channel; the paper's was signed and encrypted twice. Our figures
need the extra `[fast]`: without it, at 100 records to a chunk, the robot takes 1.7 times as long, the server 2.4."""


def _user_section(figures: Figures) -> str:
    runs = figures["user"]["measured"]
    sizes, messages = list(runs[0]["runs"]), runs[0]["messages"]
    stages: tuple[tuple[str, str, Callable[[Any], float]], ...] = (
        ("ms a message, wall time", "0.852", lambda run: sum(run["stages"].values())),
        ("capture", "", at("stages", "capture")),
        ("seal (tree, zstd, SM4, SM2)", "0.819 (SM4)", at("stages", "seal")),
        ("spool, with its fsync", "", at("stages", "spool")),
        ("send, take answers", "", lambda run: run["stages"]["send"] + run["stages"]["acknowledgements"]),
        ("processor", "", lambda run: sum(run["processor"].values())),
        ("least", "0.50 (SM4)", at("whole", "least")),
        ("median", "", at("whole", "median")),
        ("95 %", "", at("whole", "95 %")),
        ("most", "", at("whole", "most")),
        ("s in all", "8.508", lambda run: sum(run["stages"].values()) * messages / 1000),
    )
    rows = [
        (name, paper, *(across([run["runs"][n] for run in runs], figure).say(number) for n in sizes))
        for name, paper, figure in stages
    ]
    head = ["", "the paper", *("a chunk a message" if n == "1" else f"{n} to a chunk" for n in sizes)]
    delivered = across(runs, at("delivered")).say(",.0f")
    times = across(runs, lambda run: sum(run["runs"]["1"]["stages"].values()) / 0.852).say(".1f")
    most = across(runs, at("runs", "1", "whole", "most")).say(".0f")
    waited = across(runs, lambda run: 100 * _waited(run["runs"]["1"])).say(".0f")
    text = f"""## User end

{messages:,} messages in sequence (Table 3 and Figure 12); {delivered} were delivered, in the paper 9,986 of 10,000.

{table(head, rows)}

A chunk a message takes {times} times as long as the paper's message. That buys a signature and an fsync for each:
what was acknowledged survives the loss of power, and each message is proven alone. The paper's message is in memory
until it is sent. With 100 to a chunk they share both, and wait for their chunk, a second at most by default.

![Stages of the user end, message by message](evaluation-user.svg)

Spikes are waiting, not work: the longest message took {most} ms, and of all wall time {waited} % is not processor time.
In `spool` the disk is waited for, elsewhere other processes of the machine. The first point includes the keys' tables.

Through two processes on loopback, to the server's commit: {across(runs, at("rate")).say(number)} messages a second,
{across(runs, at("per_chunk")).say(number)} to a chunk."""
    if "paced" in runs[0]:
        text += f""" **At a robot's real pace**, {runs[0]["paced"]["pace"]:.0f} messages a second,
{across(runs, at("paced", "per_chunk")).say(number)} to a chunk, the robot takes
{across(runs, at("paced", "ms")).say(number)} ms of processor a message, its session and all;
{across(runs, at("paced", "waking")).say(number)} ms of it wake the thread that the message comes to."""
    return text


def _waited(run: Any) -> float:
    """The share of wall time that is no processor time."""
    return 1 - float(sum(run["processor"].values())) / float(sum(run["stages"].values()))


def _server_section(figures: Figures) -> str:
    measured = figures["server"]["measured"]
    rows: list[Sequence[object]] = []
    for index, first in enumerate(measured[0]["runs"]):
        runs = [part["runs"][index] for part in measured]
        rows.append((f"{first['sessions']} × {first['messages']}",
                     *_counted(runs, *PAPER.get(first["sessions"], ("–", "–", "–")))))  # fmt: skip
    if "paced" in measured[0]:
        runs = [part["paced"] for part in measured]
        rows.append((f"{runs[0]['sessions']} × {runs[0]['messages']}, {runs[0]['pace']:g} a second each, "
                     f"{runs[0]['per_chunk']} to a chunk", *_counted(runs, "–", "–", "–")))  # fmt: skip
    head = ["clients × messages", "received: paper", "here", "on the chain: paper", "here, proven and equal",
            "lost/doubled/altered", "decryption, ms of wall time: paper, 8 processes", "ms of processor: here",
            "shard, ms a message", "last confirmation, s"]  # fmt: skip
    return f"""## Blockchain end

Every client sends at once (Table 4 and Figure 13), onto {measured[0]["on"]}; each message is a chunk, unless the row
says otherwise. The columns of decryption do not compare: the paper's is wall time of eight processes (0.311 to 0.78 ms
a message), ours processor time of one shard. The paper's contract takes 268,924 gas for a message of 256 bytes
(measured with its code), ours 29,607 in a chunk of its own, 2,849 at 100 to a chunk
([what a record costs](bridge-figures.md#what-a-record-costs)).

{table(head, rows)}

![Messages lost, and the server's stages a message](evaluation-server.svg)"""


def _counted(runs: Runs, received: object, written: object, decrypted: object) -> list[object]:
    """The cells of a load: the paper's beside ours."""
    return [received, across(runs, lambda run: run["stored"] * run["sent"] / run["chunks"]).say(",.0f"), written,
            across(runs, at("equal")).say(",.0f"), _wrong(runs), decrypted,
            across(runs, at("opening_ms")).say(".0f"), across(runs, at("message_cpu_ms")).say(".3f"),
            across(runs, at("to_chain")).say(".1f")]  # fmt: skip


def _wrong(runs: Runs) -> str:
    return "/".join(across(runs, at(what)).say(".0f") for what in ("lost", "doubled", "altered"))


RESPONSES = (
    *((f"registration: {SAID[step]}", ("registration", step)) for step in STEPS),
    *((f"write: {SAID[step]}", ("write", step)) for step in STEPS),
    ("query", ("query",)),
)


def _chain_section(figures: Figures) -> str:
    head, columns = [], []
    for kind in CHAINS:
        measured = figures[kind]["measured"] if kind in figures else []
        for index, first in enumerate(measured[0]["runs"] if measured else []):
            runs, n = [part["runs"][index] for part in measured], first["clients"]
            head.append(f"{kind}, {n} clients" + (f", {first['period']} s" if first["period"] else ""))
            failed = across(runs, lambda run: 9 * run["clients"] - run["registered"] - run["written"] - run["answered"])
            columns.append([*(_response(runs, keys) for _, keys in RESPONSES), f"{failed.say('.0f')} of {9 * n}"])
    if not columns:
        return ""
    rows = zip([*(name for name, _ in RESPONSES), "failed"], *columns, strict=True)
    return f"""## Chain interaction

Each client registers once, writes four times and asks four times, through eight processes; three nodes, ten accounts of
100 ETH, gas limit 0xffffffff; by proof of authority (poa, with the seconds between blocks) and of work (pow). In
seconds: median, 95 %. The paper's times end where the node accepts a request; a user waits for the block and for two
more, which count from that block. In the paper more than 99 % succeeded.{_old(figures)}

{table(["", *head], list(rows))}

![Response times by number of clients](evaluation-chain.svg)"""


def _old(figures: Figures) -> str:
    old = [kind for kind in CHAINS if kind in figures and figures[kind]["edition"] != EDITION]
    return f" Measured with edition 2: {', '.join(old)}." if old else ""


def _response(runs: Runs, keys: Sequence[str]) -> str:
    own = [at("times", *keys)(run) for run in runs]
    return ", ".join(across(own, at(share)).say(seconds) for share in ("median", "95 %")) if all(own) else "–"


def _edition(part: Any) -> str:
    return "" if part["edition"] == EDITION else f" (edition {part['edition']} of the bridge)"


def _bridge_section(figures: Figures) -> str:
    rows = []
    for kind, name in CHAINS.items():
        if f"bridge-{kind}" not in figures:
            continue
        measured = figures[f"bridge-{kind}"]["measured"]
        runs = [part["run"] for part in measured]
        rows.append((name + _edition(figures[f"bridge-{kind}"]), across(measured, at("ready")).say(".0f"),
                     measured[0]["confirmations"], f"{runs[0]['sent']:,} in {runs[0]['chunks']}",
                     across(runs, at("to_chain")).say(".0f"), across(runs, at("equal")).say(",.0f"),
                     _wrong(runs)))  # fmt: skip
    if not rows:
        return ""
    text = """## The bridge on both networks

Four robots, as in the paper, from `init` to a read that proves every record.

""" + table(["network", "s until robots are registered", "N", "messages in chunks", "s until all is confirmed",
             "proven and equal", "lost/doubled/altered"], rows)  # fmt: skip
    for part in figures.get("bridge-pow", {}).get("measured", []):
        text += f"\n\n{_reorganisation(part['reorganisation'])}"
    return text + """

**Choosing N**, the confirmations: for proof of authority see [howto-poa.md](howto-poa.md). By proof of work no depth
is final: a share q of the hash power takes back z blocks with a chance of about (q / (1 − q))^z (Nakamoto, "Bitcoin",
2008, section 11). With N = 12 that is two in a million for a quarter of it, two in ten thousand for a third. Choose N
by the share that you fear, and on a private network by the blocks that a miner makes while it is cut off. Deeper ones
are healed by the same rule, for a day; what was told as confirmed was wrong in between."""


def _reorganisation(turned: Any) -> str:
    order, found = "in order" if turned["in_order"] else "NOT in order", len(turned["findings"]) or "nothing"
    return f"""**A reorganisation by proof of work.** Two miners were cut from each other; the submitter's lost
{turned["depth"]} blocks with {turned["before"] - turned["after"]} chunks when they were connected again:
{turned["before"]} chunks before, {turned["after"]} after. The submitter wrote them once more: {turned["there"]} of
{turned["sealed"]} are there, each once and {order}; {turned["reverted"]} transactions were reverted, and the reader
found {found} against it."""


SHOWN = ("median", "95 %", "most")


def _latency_section(figures: Figures) -> str:
    measured = figures["latency"]["measured"]
    rows = []
    for index, first in enumerate(measured[0]["rows"]):
        runs = [part["rows"][index] for part in measured]
        cells = [across(runs, at(what, share)).say(".2f") for what in ("stored", "confirmed") for share in SHOWN]
        rows.append((f"{first['loss']:.0%}, {2000 * first['delay']:.0f} ms", *cells))
    head = ["loss each way, round trip", *(f"{what}: {share}" for what in ("stored", "confirmed") for share in SHOWN)]
    return f"""## From capture to store and chain

{measured[0]["messages"]:,} messages at {measured[0]["pace"]:.0f} a second through a relay that loses and delays:
seconds from the source until the robot is told that the server has stored a message, or that the chain has it. A chunk
is closed a second after its first message, so half a second is the least mean; the first messages wait for the
session, too. anvil makes a block at once: add your chain's.

{table(head, rows)}"""


GIVES = (
    ("who can read a record", "whoever reads the log", "the readers whom the robot named"),
    ("who can prove whose it is", "nobody", "every reader, by the robot's signature"),
    ("who can change or omit a record unseen", "the operator, before it is anchored", "nobody"),
    ("left when the log's machines burn", "the anchors", "every record, on the chain"),
    ("30 % loss, weeks without a network", "left to the robot's program", "the robot's disk and the channel"),
)
COMPARED = (
    ("robot, ms of processor a record", "robot_ms", ".4f"), ("server, ms a record", "server_ms", ".4f"),
    ("gas a record", "gas", ",.0f"), ("bytes a record that are kept", "bytes", ".0f"),
    ("records a second until they are durable", "records_per_second", ",.0f"),
)  # fmt: skip


def _baseline_section(figures: Figures) -> str:
    measured = figures["baseline"]["measured"]
    rows = [
        (name, *(across(measured, at(way, key)).say(form) for way in ("ordinary", "bridge")))
        for name, key, form in COMPARED
    ]
    batch = measured[0]["per_batch"]
    return f"""## Beside an ordinary replicated log

The same {measured[0]["records"]:,} records in two ways: into a Redis stream with one replica, both of which fsync every
write and acknowledge every batch of {batch}, with SHA-256 of the stream written to the chain once a batch; and through
the bridge, {batch} to a chunk ([baseline.py](../benchmarks/baseline.py)). "Server" is Redis, replica and anchorer, or
reception and commit without the submitter.

{table(["", "Redis Streams and anchor", "the bridge"], [*rows, *GIVES])}

Where a chain has no room for whole records, take the anchor."""


COSTS = {
    "record_ms": "shard, ms a record", "chunk_ms": "shard, ms a chunk", "handshake_ms": "shard, ms a handshake",
    "session_ms": "shard, ms a silent session and second", "submitted_ms": "submitter, ms a chunk",
    "quiet_ms": "submitter, ms a registered robot and second", "read_record_ms": "reader, ms a record",
    "read_chunk_ms": "reader, ms a chunk", "registering_ms": "registering, ms a robot",
    "record_bytes": "bytes a record", "chunk_bytes": "bytes a chunk", "session_kib": "KiB of memory a session",
}  # fmt: skip


def _scale_section(figures: Figures) -> str:
    measured = figures["scale"]["measured"]
    first = measured[0]
    tried = max(row["sessions"] for row in first["compared"])
    costs = "; ".join(f"{name}: {across(measured, at('costs', key)).say(number)}"
                      for key, name in COSTS.items() if key in first["costs"])  # fmt: skip
    assumed = "\n".join(f"- {line}" for line in scale.ASSUMED)
    limits = [
        (name, *(across(measured, at("limits", name, str(rate))).say(",.0f") for rate in scale.RATES))
        for name in first["limits"]
    ]
    held = []
    for index, row in enumerate(first["compared"]):
        runs = [part["compared"][index] for part in measured]
        used = [across(runs, at(key)).say(seconds)
                for key in ("shard_ms", "model_ms", "submitter_ms", "submitter_model_ms")]  # fmt: skip
        held.append((f"{row['sessions']:,} × {row['messages'] // row['sessions']}"
                     + (", calibrating" if row["calibrating"] else ""), *used,
                     across(runs, at("equal")).say(",.0f"),
                     "/".join(across(runs, at(what)).say(".0f") for what in ("lost", "doubled"))))  # fmt: skip
    return f"""## Past this machine

A model ([scale.py](../benchmarks/scale.py)), calibrated by {costs}.

{assumed}

{_day(measured)}

![Cores, bytes and gas by number of robots](evaluation-scale.svg)

Curves and the table end where one shard's submitter has enough. Dashed, on grey, is what was not
run: more than {tried:,} robots.

{table(["the most robots on", *(f"{rate} messages/s each" for rate in scale.RATES)], limits)}

Held to runs of this machine, seconds of processor:

{table(["robots × messages", "shard", "model", "submitter", "model", "proven and equal", "lost/doubled"], held)}"""


def _day(measured: Runs) -> str:
    """What a robot's day takes at each rate."""
    rows = []
    units: tuple[tuple[str, str, float], ...] = (
        ("MB on the chain", "bytes_a_day", 1e-6), ("MB of a node's disk", "disk_a_day", 1e-6),
        ("s of processor at a reader", "reading_s", 1.0),
    )  # fmt: skip
    for name, key, unit in units:
        if key in measured[0]["needs"][0]:
            days = [across(measured, partial(_each, rate, key, unit)).say(number) for rate in scale.RATES]
            rows.append((name, *days))
    return table(["a robot's day", *(f"{rate} messages/s" for rate in scale.RATES)], rows)


def _each(rate: int, key: str, unit: float, run: Any) -> float:
    need = next(need for need in run["needs"] if need["rate"] == rate)
    whole = float(need[key]) * unit
    return whole if key == "reading_s" else whole / need["robots"]
