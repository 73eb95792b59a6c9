"""`read`: what a robot wrote, proven, from the chain alone."""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import ExitStack
from datetime import datetime
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from rosbridge_eth.config import load_reader_config
from rosbridge_eth.config.values import parse_time
from rosbridge_eth.errors import ConfigError, IdentityError, VerificationError
from rosbridge_eth.home import ReaderHome
from rosbridge_eth.passphrases import read_passphrase
from rosbridge_eth.terminal import READER_HOME, Json, PassphraseFile, ReaderHomeOption, print_json, talk

if TYPE_CHECKING:
    from rosbridge_eth.reading import ProvenRecord


def add_commands(app: typer.Typer) -> None:
    app.command(epilog="Example: rosbridge-eth read robot_1 --topic /robot_1/odom > records.jsonl")(read)


def _time(text: str | None) -> int | None:
    try:
        return None if text is None else parse_time(datetime.fromisoformat(text))
    except ValueError as error:
        raise typer.BadParameter(f"{text!r}: write a time such as 2026-11-21T10:00:00Z") from error


def read(
    robot: Annotated[str, typer.Argument(help="The robot's name.")],
    home: ReaderHomeOption = READER_HOME,
    topic: Annotated[str | None, typer.Option(help="Only this topic.")] = None,
    from_: Annotated[str | None, typer.Option("--from", help="Only what was received from this time on.")] = None,
    to: Annotated[str | None, typer.Option(help="Only what was received before this time.")] = None,
    at: Annotated[str | None, typer.Option(help="Only the last record of each topic up to this moment.")] = None,
    bag: Annotated[Path | None, typer.Option(help="Write NAME.bag (ROS 1), NAME.mcap, NAME.db3 or a folder.")] = None,
    csv: Annotated[Path | None, typer.Option(help="Write a table.")] = None,
    plot: Annotated[Path | None, typer.Option(help="Draw the trajectory: .png, .svg or .pdf.")] = None,
    node: Annotated[list[str] | None, typer.Option(help="Ask these nodes, not those of reader.toml.")] = None,
    confirm: Annotated[
        bool, typer.Option("--confirm", help="The fingerprints of new certificates are compared and right.")
    ] = False,
    passphrase_file: PassphraseFile = None,
    json: Json = False,
) -> None:
    """Fetch a robot's log from the chain, prove it, open it, and give its records as JSON lines, bag, table or plot.

    Exits with 9 where what the chain has is not what the robot wrote, or not all of it, and with 4 where every record
    of it is sealed for others.
    """
    from rosbridge_eth.identity import Trust, load_identity
    from rosbridge_eth.ledger import Ledger
    from rosbridge_eth.reading import Bookmarks, outputs, read_robot

    choice = outputs.Choice(topic, _time(from_), _time(to), _time(at))
    if choice.at_ns is not None and (choice.from_ns is not None or choice.to_ns is not None):
        raise typer.BadParameter("a moment has no range: give --at, or --from and --to", param_hint="--at")
    if choice.from_ns is not None and choice.to_ns is not None and choice.from_ns >= choice.to_ns:
        raise typer.BadParameter(f"{from_} is not before --to {to}", param_hint="--from")
    place = ReaderHome(home).require()
    config = load_reader_config(place.config)
    if bag is not None:
        outputs.check_bag(bag)
    if csv is not None:
        outputs.check_table(csv)
    trajectory = None if plot is None else outputs.Trajectory()
    if plot is not None:
        outputs.check_picture(plot)
    passphrase = read_passphrase("reader", "Passphrase of the reader", file=passphrase_file)
    identity, roots = load_identity(config.identity, passphrase)
    ledgers = [Ledger.connect(url, config) for url in node or config.chain]
    bookmarks = Bookmarks(place.path / "bookmarks.json")
    chosen, topics = 0, set[str]()
    with ExitStack() as stack:
        for ledger in ledgers:
            stack.callback(ledger.close)
        reading = read_robot(
            ledgers, robot, trust=Trust(roots), reader=identity.encryption_key, now=time.time(), bookmarks=bookmarks
        )
        sinks = [stack.enter_context(outputs.bag(bag)).write] if bag is not None else []
        if csv is not None:
            sinks.append(stack.enter_context(outputs.table(csv)).write)
        if trajectory is not None:
            sinks.append(trajectory.write)
        if not sinks and not json:
            sinks.append(lambda record: print(outputs.json_line(record), end=""))
        for record in choice.choose(_noting(reading.records(), topics)):
            chosen += 1
            for sink in sinks:
                sink(record)
        verdict = reading.verdict()
    reading.keep(bookmarks, confirm=confirm)
    if json:
        print_json(verdict.as_json() | {"chosen": chosen})
    for line in verdict.lines():
        talk(line)
    if topic is not None and chosen == 0 and topic not in topics:
        talk(f"nothing was read on {topic}; what was read is on: {', '.join(sorted(topics)) or 'no topic'}")
    if not verdict.sound:
        raise VerificationError(f"what the chain has of {robot} is not what the robot wrote; see the findings above")
    if not verdict.records and "no-grant" in verdict.counts:
        raise IdentityError(f"nothing of {robot} is sealed for this reader; put {place.public} into its `readers/`")
    if plot is not None and trajectory is not None and not trajectory.draw(plot):
        raise ConfigError(f"{plot} is not drawn: none of the {chosen} chosen records holds a position")


def _noting(records: Iterator[ProvenRecord], topics: set[str]) -> Iterator[ProvenRecord]:
    for record in records:
        topics.add(record.content.topic)
        yield record
