"""`topics`: what a source offers, how often and how large, and what of it the configuration takes at what cost.

A live source is listened to for some seconds; a bag or a simulation is read as fast as it goes, for as long at most.
The messages are captured, written and sealed as a robot does it, with keys that are thrown away: sizes are measured,
only the way from there to a day is arithmetic. A topic's cost is that of its records alone, compressed; the headers of
chunks and the transactions come once, with the total. What was heard once costs nothing a day, and so does what is
written only when a trigger's event happens.
"""

from __future__ import annotations

import json as jsonlib
import os
import threading
import time
from collections.abc import Collection, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated, Any

import typer

from rosbridge_eth.capture import Capture, RawMessage, TopicRule, stream_line
from rosbridge_eth.config import RobotConfig, load_robot_config, parse_config
from rosbridge_eth.config.home import RobotHome
from rosbridge_eth.config.models import SOURCE_KINDS, BagConfig, SimConfig
from rosbridge_eth.log.chunk import Chunk, Log
from rosbridge_eth.log.writer import LogWriter
from rosbridge_eth.robot.sources import Offer, Selection, Source, open_source
from rosbridge_eth.terminal import ROBOT_HOME, Json, RobotHomeOption, data, print_json, table, talk
from smcrypto import sm2

PLUMBING = {"/rosout", "/rosout_agg", "/parameter_events", "/clock"}
"""Topics of ROS itself, which `join` suggests to leave out."""
ANYTHING = RobotConfig.model_validate({"topics": ["**"]})
DAY = 86_400.0
SIMULATED = 60 * 10**9  # ns of a simulation without an end that are looked at
SETTLED = 1.0  # seconds in which a live graph offers nothing new
PATIENCE = 5.0  # seconds for it to offer anything
ENOUGH = 2**24  # bytes of captured lines, after which no more is read


def robot_toml(topics: Sequence[str], source: str) -> str:
    """A robot.toml. source: ros1, ros2 or sim, the URI of a ROS 1 master, or the path of a bag."""
    what = {"kind": source}
    if "://" in source:
        what = {"kind": "ros1", "master": source}
    elif source not in SOURCE_KINDS:
        what = {"kind": "bag", "path": str(Path(source).absolute())}
    said = "# What this robot sends to the chain; docs/configuration.md describes every key."
    lines = [said, f"topics = {_toml([*topics])}", "", "[source]", *(f"{key} = {_toml(what[key])}" for key in what)]
    return "\n".join(lines) + "\n"


def _toml(value: Any) -> str:
    return jsonlib.dumps(value, ensure_ascii=False)  # strings and lists of them are written alike in both


def everything(config: RobotConfig) -> Source:
    """The configured source with all that it has, and no pace of its own. Raises SourceError, ConfigError."""
    source, _ = config.source_and_why(os.environ)
    if isinstance(source, SimConfig):
        source = source.model_copy(update={"speed": None, "duration": source.duration or SIMULATED})
    elif isinstance(source, BagConfig):
        source = source.model_copy(update={"speed": None})
    return open_source(source, Selection(["**"]))


def offered(source: Source) -> list[Offer]:
    """The topics of a source; of a live one, when nothing new was offered for a moment."""
    offers, until = list(source.offers()), time.monotonic() + (PATIENCE if source.live else 0.0)
    while time.monotonic() < until:
        time.sleep(SETTLED)
        before, offers = offers, list(source.offers())
        if offers and offers == before:
            break
    return offers


@dataclass(slots=True)
class Heard:
    """A topic: when its messages came (ns since 1970), their bytes, and the lines they were captured as."""

    offer: Offer
    times: list[int] = field(default_factory=list)
    size: int = 0
    lines: list[tuple[float, bytes]] = field(default_factory=list)  # when it was captured (s), and the line
    trigger: str | None = None

    @property
    def rate(self) -> float | None:
        """Messages a second; None where there were not two."""
        span = self.times[-1] - self.times[0] if self.times else 0
        return (len(self.times) - 1) * 1e9 / span if span > 0 else None

    @property
    def all_day(self) -> list[tuple[float, bytes]]:
        """The lines of a topic that comes again and again."""
        return self.lines if self.rate and not self.trigger else []


def survey(
    config: RobotConfig, seconds: float, readers: int = 1, without: Collection[str] = ()
) -> dict[str, Any]:
    """Listen for so many seconds at most; what `topics --json` prints. Raises SourceError, ConfigError.

    without: topics that are not taken, although the configuration names them.
    """
    from rosbridge_eth.ledger.contract import GAS_A_BYTE, set_data_cost

    source, stop, one_thread, room = everything(config), threading.Event(), threading.Lock(), [ENOUGH]
    timer = threading.Timer(seconds, stop.set)
    capture = Capture([*config.rules(), TopicRule("**")], source_kind=source.kind, live=True)

    def take(raw: RawMessage) -> None:
        with one_thread:  # at a time
            topic = heard.setdefault(raw.topic, Heard(Offer(raw.topic, raw.type_name)))
            topic.times.append(raw.received_ns)
            topic.size += len(raw.raw)
            if record := capture.process(raw, raw.received_ns):
                topic.trigger = record.trigger
                topic.lines.append((raw.received_ns / 1e9, record.line))
                room[0] -= len(record.line)
            if room[0] < 0:
                stop.set()

    try:
        heard = {offer.topic: Heard(offer) for offer in offered(source)}
        began = time.monotonic()
        timer.start()
        source.run(take, stop)
    finally:
        timer.cancel()
        source.close()
    times = [time for topic in heard.values() for time in topic.times]
    took = time.monotonic() - began if source.live else (max(times) - min(times)) / 1e9 if times else 0.0
    selection, days = Selection.of(config), max(took, 1.0) / DAY
    chosen = [topic for topic in heard.values() if selection.wants(topic.offer) and topic.offer.topic not in without]
    chunks = _sealed([line for topic in chosen for line in topic.all_day], config, source.kind, readers)
    sizes = [len(chunk.encoded) for chunk in chunks]
    bodies = {
        name: sum(len(chunk.body) for chunk in _sealed(topic.all_day, config, source.kind, readers)) / days
        for name, topic in heard.items()
    }
    return {
        "seconds": took,
        "topics": [
            {"topic": name, "type": topic.offer.type_name, "nodes": list(topic.offer.nodes),
             "chosen": topic in chosen, "trigger": topic.trigger,
             "messages": (count := len(topic.times)), "rate": topic.rate, "size": topic.size / count if count else None,
             "bytes_per_day": bodies[name], "gas_per_day": GAS_A_BYTE * bodies[name]}
            for name, topic in sorted(heard.items())
        ],
        "chunks_per_day": len(sizes) / days, "bytes_per_day": sum(sizes) / days,
        "gas_per_day": {"full_batches": set_data_cost(sizes) / days,
                        "one_chunk_each": sum(set_data_cost([size]) for size in sizes) / days},
    }  # fmt: skip


def _sealed(lines: list[tuple[float, bytes]], config: RobotConfig, kind: str, readers: int) -> list[Chunk]:
    """The chunks that a robot would make of these lines, for so many readers."""
    if not lines:
        return []
    lines.sort()
    key, reader = sm2.PrivateKey.generate(), sm2.PrivateKey.generate().public_key
    writer = LogWriter(
        Log(bytes(32), bytes(32)), key, [reader] * readers, previous=bytes(32), now=lines[0][0],
        stream_line=stream_line(kind, ""), period=config.log.period, compress=config.log.compress,
    )
    chunks = []
    for at, line in lines:
        writer.add(line, at)
        chunks += writer.closed(at, 0)
    return chunks + writer.finish(0)


SourceOption = Annotated[
    str | None, typer.Option(help="ros1, ros2, sim, a ROS 1 master's URI or a bag; else what the environment says.")
]


def topics(
    home: RobotHomeOption = ROBOT_HOME, source: SourceOption = None,
    seconds: Annotated[float, typer.Option(min=1, max=3600, help="How long to listen.")] = 5.0, json: Json = False,
) -> None:  # fmt: skip
    """List the topics and what they cost a day. With types, rates, sizes, and what robot.toml takes.

    Without a robot.toml, everything is taken but the topics of ROS itself, as `join --yes` chooses.
    """
    place = RobotHome(home)
    configured = place.config.exists()
    config = load_robot_config(place.config) if configured else ANYTHING
    if source is not None:
        named = parse_config(RobotConfig, robot_toml(["**"], source), place.config).source
        config = config.model_copy(update={"source": named})
    readers = len([*place.readers.glob("*.pem")]) or 1
    report = survey(config, seconds, readers, () if configured else PLUMBING)
    if json:
        print_json(report)
        return
    columns = ["topic and type", "Hz", "bytes", "taken", "MB a day", "Ggas a day"]
    rows = [
        (f"{each['topic']}\n  {each['type']}", "" if each["rate"] is None else f"{each['rate']:.3g}",
         "" if each["size"] is None else f"{each['size']:.0f}",
         f"at {each['trigger']}" if each["trigger"] else "yes" if each["chosen"] else "",
         f"{each['bytes_per_day'] / 1e6:.3g}", f"{each['gas_per_day'] / 1e9:.3g}")
        for each in report["topics"]
    ]  # fmt: skip
    data.print(table(f"Topics, as heard in {report['seconds']:.0f} s", columns, rows, right=[1, 2, 4, 5]))
    low, high = report["gas_per_day"]["full_batches"] / 1e9, report["gas_per_day"]["one_chunk_each"] / 1e9
    talk(
        f"What is taken makes {report['bytes_per_day'] / 1e6:.3g} MB a day in {report['chunks_per_day']:.0f} chunks"
        f" and costs {low:.3g} (full batches) to {high:.3g} (a transaction for each chunk) Ggas: as many ETH at 1 gwei."
    )
