"""The page and the pictures of paper.py: what was measured, beside what the paper has."""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

import matplotlib

import baseline
import latency
import scale

matplotlib.use("Agg")

import matplotlib.pyplot as plt
from cycler import cycler

STEPS = ("submit", "include", "confirm")
SAID = {"submit": "accepted by the node", "include": "in a block", "confirm": "two more on top"}
COLOURS = ("#0072B2", "#D55E00", "#009E73", "#CC79A7", "#E69F00", "#56B4E9")  # Okabe and Ito's, for every eye
PAPER = {300: (2994, 2993, 186.34), 500: (4986, 4986, 249.88), 700: (6991, 6991, 370.29)}
"""By clients: received, on the chain, ms of decryption in 8 processes."""
CHAINS = {"poa": "proof of authority", "pow": "proof of work"}
PARTS = ("user", "server", "poa", "bridge-poa", "pow", "bridge-pow", "latency", "baseline", "scale")
Figures = Mapping[str, Any]


def number(value: float) -> str:
    """Three digits or so."""
    return f"{value:,.0f}" if abs(value) >= 100 else f"{value:.3g}"


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


def _user(figures: Figures) -> Any:
    figure, axes = plt.subplots(1, 2, figsize=(9, 3.4), layout="constrained")
    part = figures["user"]
    for axis, (per_chunk, run) in zip(axes, part["runs"].items(), strict=True):
        series = run["series"]
        step = part["messages"] / len(next(iter(series.values())))
        places = [step * (n + 0.5) for n in range(len(next(iter(series.values()))))]
        axis.stackplot(places, series.values(), labels=series.keys())
        axis.axhspan(0.50, 1.23, color="0.88", zorder=0)
        axis.axhline(0.852, color="0.3", linestyle="--", linewidth=1)
        axis.text(places[-1], 0.86, "the paper: 0.852 ms; its SM4: 0.50 to 1.23", ha="right", va="bottom", fontsize=8)
        axis.set_ylim(0, max(1.4, 1.5 * run["whole"]["mean"]))
        axis.set(title="a chunk for each message" if per_chunk == "1" else f"{per_chunk} messages to a chunk",
                 xlabel="message")  # fmt: skip
    axes[0].set_ylabel("ms a message, mean of 100")
    axes[0].legend(loc="upper left", ncols=4, fontsize=8)
    return figure


def _server(figures: Figures) -> Any:
    figure, (left, right) = plt.subplots(1, 2, figsize=(9, 3.4), layout="constrained")
    runs = figures["server"]["runs"]
    places = range(len(runs))
    names = [f"{run['sessions']} × {run['messages']}" for run in runs]
    lost = [run["sent"] - run["equal"] for run in runs]
    left.bar([p - 0.2 for p in places], lost, 0.4, label="here")
    theirs = [run["sent"] - PAPER[run["sessions"]][0] if run["sessions"] in PAPER else 0 for run in runs]
    left.bar([p + 0.2 for p in places], theirs, 0.4, label="the paper")
    for place, ours, paper in zip(places, lost, theirs, strict=True):
        left.text(place - 0.2, ours, str(ours), ha="center", va="bottom")
        left.text(place + 0.2, paper, str(paper), ha="center", va="bottom")
    left.set(xticks=list(places), xticklabels=names, ylabel="messages lost")
    left.legend()
    stages = {
        "open the channel": [run["opening_ms"] / run["sent"] for run in runs],
        "verify signatures": [run["verifying_ms"] / run["sent"] for run in runs],
        "the rest of the shard": [
            max(0.0, run["message_cpu_ms"] - (run["opening_ms"] + run["verifying_ms"]) / run["sent"]) for run in runs
        ],
        "submitter": [run["submitter_cpu_ms"] for run in runs],
    }
    below = [0.0] * len(runs)
    for stage, values in stages.items():
        right.bar(places, values, 0.5, bottom=below, label=stage)
        below = [a + b for a, b in zip(below, values, strict=True)]
    right.axhline(0.422, color="0.3", linestyle="--", linewidth=1)
    right.text(-0.4, 0.43, "the paper's decryption: 0.422 ms", fontsize=8)
    right.set(xticks=list(places), xticklabels=names, ylabel="processor, ms a message")
    right.set_ylim(0, max(0.55, 1.35 * max(below)))
    right.legend(fontsize=8, loc="upper right", ncols=2)
    return figure


def _chain(figures: Figures) -> Any:
    kinds = [kind for kind in CHAINS if kind in figures]
    figure, axes = plt.subplots(1, len(kinds), figsize=(4.5 * len(kinds), 4), sharey=True, squeeze=False,
                                layout="constrained")
    for axis, kind in zip(axes[0], kinds, strict=True):
        runs = [run for run in figures[kind]["runs"] if run["period"] <= 1]
        clients = [run["clients"] for run in runs]
        curves = [("registration", step) for step in STEPS] + [("write", step) for step in STEPS] + [("query", None)]
        for index, (what, step) in enumerate(curves):
            found = [run["times"][what] if step is None else run["times"][what][step] for run in runs]
            middle = [one["median"] / 1000 for one in found]
            spread = [[m - one["5 %"] / 1000 for m, one in zip(middle, found, strict=True)],
                      [one["95 %"] / 1000 - m for m, one in zip(middle, found, strict=True)]]  # fmt: skip
            colour = COLOURS[{"registration": 0, "write": 1, "query": 2}[what]]
            style = {"submit": ":", "include": "--", "confirm": "-", None: ":"}[step]
            axis.errorbar([c * (1 + 0.015 * (index - 3)) for c in clients], middle, yerr=spread, color=colour,
                          linestyle=style, marker="o", markersize=3, linewidth=1.2, elinewidth=0.7,
                          label=what if step is None else f"{what}, {SAID[step]}")  # fmt: skip
        axis.set(title=CHAINS[kind], xlabel="clients", xscale="log", yscale="log")
        axis.set_xticks(clients, [str(c) for c in clients])
        axis.minorticks_off()
    axes[0][0].set_ylabel("s, median and 5 to 95 %")
    figure.legend(*axes[0][0].get_legend_handles_labels(), loc="outside lower center", ncols=2, fontsize=8)
    return figure


def _scale(figures: Figures) -> Any:
    figure, axes = plt.subplots(1, 3, figsize=(11, 3.6), layout="constrained")
    needs = figures["scale"]["needs"]
    for axis, key, unit in zip(axes, ("cores", "bytes_a_day", "gas_a_second"),
                               ("cores of shards, submitters among them", "GB a day on the chain", "M gas a second"),
                               strict=True):  # fmt: skip
        for rate in scale.RATES:
            own = [need for need in needs if need["rate"] == rate]
            values = [need["cores"] + need["submitter_cores"] if key == "cores" else
                      need[key] / (1e9 if key == "bytes_a_day" else 1e6) for need in own]  # fmt: skip
            axis.plot([need["robots"] for need in own], values, marker="o", markersize=3, label=f"{rate} messages/s")
        axis.axvline(max(row["sessions"] for row in figures["scale"]["compared"]), color="0.3", linestyle=":")
        axis.set(xscale="log", yscale="log", xlabel="robots (right of the dotted line: not run)", ylabel=unit)
    for gas in sorted(set(scale.CHAINS.values())):
        axes[2].axhline(gas / 1e6, color="0.5", linewidth=0.8, linestyle="--")
        names = ", ".join(name for name, own in scale.CHAINS.items() if own == gas)
        axes[2].text(scale.ROBOTS[-1], gas / 1e6, names, fontsize=7, va="bottom", ha="right")
    axes[0].legend(fontsize=8)
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
    return "\n\n".join(filter(None, sections)) + "\n"


def _head(figures: Figures) -> str:
    rows = [(name, part["machine"]["processor"], part["machine"]["python"], part["machine"]["load"],
             f"{part['seconds'] / 60:.1f} min" + (" (--quick)" if part["quick"] else ""))
            for name, part in figures.items()]  # fmt: skip
    missing = [name for name in PARTS if name not in figures]
    absent = f" Not measured yet: {', '.join(missing)}." if missing else ""
    return f"""# The paper's evaluation, done again

The system that this project implements was judged by its authors with tables and figures (Security and Communication
Networks 2022, article 7206494) on a 10-core i9-10900KF at 3.7 GHz with 64 GB. This page has the same rows from this
implementation. It is written by `python benchmarks/paper.py`, from the figures in
[evaluation.json](evaluation.json).{absent}

{table(["part", "processor", "Python", "load average before", "took"], rows)}

**What differs from the paper's set-up.** All of it runs on the one machine of the table: robots, server, three nodes
and those who ask. A client is a session with a socket of its own, in one of two processes, where the paper had a
process for each. The paper's response times end when the node accepts a request; here that is `accepted by the node`,
and what a user waits for, a block and two more on top of it, stands beside it. A message here is signed by its chunk's
signature, encrypted to the readers, and encrypted once more by the channel; the paper's was signed and encrypted twice.
The processors are different ones: the rows compare two systems on two machines. Figures are those with the extra
`[fast]`, whose SM4 is OpenSSL's; without it, with 100 records to a chunk, the robot took 0.111 ms a record where it
took 0.067, and the server 0.037 where it took 0.0155. A part marked --quick ran with few messages, its load on
anvil."""


def _user_section(figures: Figures) -> str:
    part = figures["user"]
    runs, messages = part["runs"], part["messages"]
    rows: list[tuple[str, ...]] = [("delivered", "9,986 of 10,000", f"{part['delivered']:,} of {messages:,}", "")]
    stages: tuple[tuple[str, str, Callable[[Any], float]], ...] = (
        ("ms a message, stages added up", "0.852", lambda run: sum(run["stages"].values())),
        ("of it capture", "", lambda run: run["stages"]["capture"]),
        ("of it seal (tree, zstd, SM4, SM2)", "0.819 (SM4)", lambda run: run["stages"]["seal"]),
        ("of it spool, with its fsync", "", lambda run: run["stages"]["spool"]),
        ("of it send, and take answers", "",
         lambda run: run["stages"]["send"] + run["stages"]["acknowledgements"]),
        ("processor, ms a message", "", lambda run: sum(run["processor"].values())),
        ("least", "0.50 (SM4)", lambda run: run["whole"]["least"]),
        ("median", "", lambda run: run["whole"]["median"]),
        ("95 %", "", lambda run: run["whole"]["95 %"]),
        ("s in all", "8.508", lambda run: sum(run["stages"].values()) * messages / 1000),
    )
    rows += [(name, paper, *(number(function(run)) for run in runs.values())) for name, paper, function in stages]
    head = ["", "the paper", *("a chunk a message" if n == "1" else f"{n} to a chunk" for n in runs)]
    return f"""## User end

{messages:,} messages in sequence (the paper's Table 3 and Figure 12). Where a chunk has 100 messages, what is done once
a chunk is shared by them.

{table(head, rows)}

{_slower(runs)}

![Stages of the user end, message by message](evaluation-user.svg)

Through two processes on loopback, from the source to the server's commit: {number(part["rate"])} messages a second,
{part["per_chunk"]:.0f} to a chunk."""


def _slower(runs: Any) -> str:
    """What a chunk for each message costs beside the paper's message, and what it is spent on."""
    if "1" not in runs:
        return ""
    times = sum(runs["1"]["stages"].values()) / 0.852
    return f"""With a chunk for each message the robot takes {times:.1f} times as long as the paper's. That buys a
signature and an fsync for each message: what was acknowledged survives the loss of power, and each message is proven by
itself. The paper's message is in memory until it is sent. With 100 messages to a chunk the same is bought once for all,
and a message waits for its chunk, a second at most by default."""


def _server_section(figures: Figures) -> str:
    runs = figures["server"]["runs"]
    rows: list[Sequence[object]] = []
    for run in runs:
        received, written, decrypted = PAPER.get(run["sessions"], ("–", "–", "–"))
        rows.append((f"{run['sessions']} × {run['messages']}", received, f"{run['stored']:,}", written,
                     f"{run['equal']:,}", f"{run['lost']} / {run['doubled']} / {run['altered']}", decrypted,
                     f"{run['opening_ms']:.0f}", f"{run['message_cpu_ms']:.3f}", f"{run['to_chain']:.1f} s"))
    head = ["clients × messages", "received: paper", "here", "on the chain: paper", "here, proven and equal",
            "lost / doubled / altered", "decryption, ms: paper (8 processes)", "here (one shard)",
            "shard, ms a message", "last confirmation"]  # fmt: skip
    return f"""## Blockchain end

Every client sends at once (the paper's Table 4 and Figure 13). Three nodes of geth with Clique, a block a second; each
message is a chunk of its own. The two columns of decryption are not the same measure: the paper's is wall time of eight
processes together, 0.311 to 0.78 ms a message by number of clients; here it is the processor time of one shard. Its
contract takes 268,924 gas for a message of 256 bytes (measured with its code); here see
[what a record costs](bridge-figures.md).

{table(head, rows)}

![Messages lost, and the server's stages a message](evaluation-server.svg)"""


def _chain_section(figures: Figures) -> str:
    sections = []
    for kind, name in CHAINS.items():
        if kind not in figures:
            continue
        rows = []
        for run in figures[kind]["runs"]:
            times, n = run["times"], run["clients"]
            cells = [
                f"{one['median'] / 1000:.3g} ({one['95 %'] / 1000:.3g})" if one else "–"
                for one in [*(times["registration"][s] for s in STEPS), *(times["write"][s] for s in STEPS),
                            times["query"]]
            ]  # fmt: skip
            failed = 9 * n - run["registered"] - run["written"] - run["answered"]
            rows.append((f"{n}, {run['period']} s" if run["period"] else n, *cells, f"{failed} of {9 * n}"))
        head = ["clients, period" if kind == "poa" else "clients", *(f"registration: {SAID[s]}" for s in STEPS),
                *(f"write: {SAID[s]}" for s in STEPS), "query", "failed"]  # fmt: skip
        sections.append(f"### By {name}\n\n{table(head, rows)}")
    if not sections:
        return ""
    return """## Chain interaction

Each client registers once, writes four times and asks four times; eight processes make the requests. Three nodes, ten
accounts of 100 ETH, gas limit 0xffffffff. In seconds: median (95 %). `Two more on top` counts from the block that holds
it. In the paper more than 99 % succeeded on both networks.

![Response times by number of clients](evaluation-chain.svg)

""" + "\n\n".join(sections)


def _bridge_section(figures: Figures) -> str:
    rows = []
    for kind, name in CHAINS.items():
        if f"bridge-{kind}" not in figures:
            continue
        part = figures[f"bridge-{kind}"]
        run = part["run"]
        rows.append((name, f"{part['ready']:.0f} s", part["confirmations"], f"{run['sent']:,} in {run['chunks']}",
                     f"{run['to_chain']:.0f} s", f"{run['equal']:,}",
                     f"{run['lost']} / {run['doubled']} / {run['altered']}"))  # fmt: skip
    if not rows:
        return ""
    text = """## The bridge on both networks

Four robots, as in the paper: from `init` over contract, registrations, sessions and chunks to a read that proves every
record.

""" + table(["network", "until robots are registered", "N", "messages in chunks", "until all is confirmed",
             "proven and equal", "lost / doubled / altered"], rows)  # fmt: skip
    turned = figures.get("bridge-pow", {}).get("reorganisation")
    if turned:
        there = "in order" if turned["in_order"] else "NOT in order"
        text += f"""

**A reorganisation by proof of work.** Two miners were cut from each other. The one that the submitter writes to made
{turned["depth"]} blocks, with {turned["before"] - turned["after"]} chunks in them, and lost them when the other one,
which had two threads, was connected again: {turned["before"]} chunks before, {turned["after"]} after. The submitter
wrote them once more: {turned["there"]} of {turned["sealed"]} chunks are on the chain, each once and {there};
{turned["reverted"]} transactions were reverted, and the reader found {len(turned["findings"]) or "nothing"} against it.

**Choosing N**, the confirmations: [howto-poa.md](howto-poa.md) has the rule for proof of authority: half of the
signers and one, and never below 3. By proof of work no depth is final. Who has a share q of the hash power takes back z
blocks with a chance of about (q / (1 − q))^z (Nakamoto, "Bitcoin", 2008, section 11): with a quarter of it and N = 12
two in a million, with a third two in ten thousand. So N follows from the share that has to be feared, and on a private
network where one miner may be cut from the others for a while, from how many blocks it makes meanwhile. One
that is deeper is healed by the same rule, for a day; what was told as confirmed was wrong in between."""
    return text


def _latency_section(figures: Figures) -> str:
    part = figures["latency"]
    head = ["loss each way, round trip", "until", *(name for name, _ in latency.SHARES), "mean"]
    rows = [
        (f"{row['loss']:.0%}, {2000 * row['delay']:.0f} ms", what, *(f"{value:.2f}" for value in row[what].values()))
        for row in part["rows"] for what in ("stored", "confirmed")
    ]  # fmt: skip
    return f"""## From capture to store and chain

{part["messages"]:,} messages at {part["pace"]:.0f} a second through a relay that loses and delays, in seconds from the
moment at which the source hands a message out until the robot is told that the server has stored it, or that the chain
has it ([benchmarks/latency.py](../benchmarks/latency.py)). A chunk is closed a second after its first message, so half
a second is the least mean there can be; anvil makes a block at once, so that of another chain is to be added. The first
messages wait for the session, too.

{table(head, rows)}"""


GIVES = (
    ("who can read a record", "whoever reads the log", "the readers whom the robot named, by their keys"),
    ("who can prove whose it is", "nobody: the operator says so", "every reader, by the robot's signature"),
    ("who can change or leave out a record unseen", "the operator, before it is anchored",
     "nobody: the robot signs its chunks, each with the digest of the one before"),
    ("what is left if the log's machines burn", "the anchors: that something was there", "every record, on the chain"),
    ("what a record costs on the chain", "a share of the anchor", "its bytes"),
    ("30 % loss, weeks without a network", "TCP; the robot's program has to keep what it cannot send",
     "the robot's disk and the channel"),
)  # fmt: skip


def _baseline_section(figures: Figures) -> str:
    part = figures["baseline"]
    head = ["", "Redis Streams and anchor", "the bridge"]
    return f"""## Beside an ordinary replicated log

The same {part["records"]:,} records, captured alike, in two ways: into a stream of a Redis with one replica, which both
fsync every write and acknowledge every batch of {part["per_batch"]}, with SHA-256 of the whole stream written to the
chain once a batch; and through the bridge, {part["per_batch"]} records to a chunk
([benchmarks/baseline.py](../benchmarks/baseline.py)). "Server" is Redis, its replica and the anchorer on one side,
reception and commit on the other; the submitter's time is in the model below.

{table(head, baseline.rows(part))}

The anchor is the cheaper one on the chain by far; where a fleet's chain has no room for whole records, that is what to
take. What each gives:

{table(head, GIVES)}"""


def _scale_section(figures: Figures) -> str:
    part = figures["scale"]
    costs, compared = part["costs"], part["compared"]
    rows = [
        (f"{row['sessions']:,} robots, {row['messages']:,} messages" + (", calibrating" if row["calibrating"] else ""),
         f"{row['shard_ms'] / 1000:.2f}", f"{row['model_ms'] / 1000:.2f}", f"{row['submitter_ms'] / 1000:.2f}",
         f"{row['submitter_model_ms'] / 1000:.2f}", f"{row['equal']:,}", f"{row['lost']} / {row['doubled']}")
        for row in compared
    ]  # fmt: skip
    limits = [(name, *(f"{held[str(rate)]:,}" for rate in scale.RATES)) for name, held in part["limits"].items()]
    head = ["the most robots", *(f"{rate} messages/s each" for rate in scale.RATES)]
    tried = max(row["sessions"] for row in compared)
    assumed = "\n".join(f"- {line}" for line in scale.ASSUMED)
    return f"""## Past this machine

A model ([benchmarks/scale.py](../benchmarks/scale.py)), calibrated by: {costs["record_ms"]:.4f} ms a record,
{costs["chunk_ms"]:.2f} ms a chunk, {costs["handshake_ms"]:.1f} ms a handshake in a shard,
{costs["submitted_ms"]:.2f} ms a chunk and {costs["quiet_ms"]:.3f} ms a registered robot and second in its submitter,
{costs["record_bytes"]:.0f} bytes a record, {costs["chunk_bytes"]:.0f} a chunk, {costs["session_kib"]:.0f} KiB of memory
a session. What lies to the right of the dotted line, at {tried:,} robots, was not run.

{assumed}

![Cores, bytes and gas by number of robots](evaluation-scale.svg)

A chain holds so many robots, and one shard's submitter bears so many:

{table(head, limits)}

Held to runs of this machine, processor time in seconds. What a session costs that says nothing is not in the model:

{table(["", "shard", "model", "submitter", "model", "proven and equal", "lost / doubled"], rows)}"""
