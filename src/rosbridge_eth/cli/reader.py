"""`read`: from the chain to JSON lines, a bag or a plot, with what is wrong said on stderr."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from rosbridge_eth.cli.options import OPERATOR_HOME, OperatorHomeOption
from rosbridge_eth.cli.output import Json, print_json, talk
from rosbridge_eth.config.values import parse_time
from rosbridge_eth.errors import ConfigError, VerificationError
from rosbridge_eth.home import OperatorHome
from rosbridge_eth.passphrases import read_passphrase

if TYPE_CHECKING:
    from rosbridge_eth.reader import Reading

OWNER = "owner"
"""The reader that `init` makes."""


def add_commands(app: typer.Typer) -> None:
    app.command(epilog="Example: rosbridge-eth read robot_1 --topic /robot_1/odom --plot path.png")(read)


def _time(text: str | None) -> int | None:
    if text is None:
        return None
    try:
        return parse_time(text)
    except ValueError as error:
        raise ConfigError(f"the time {error}") from error


def read(
    robot: Annotated[str, typer.Argument(help="The robot's name.")],
    home: OperatorHomeOption = OPERATOR_HOME,
    config: Annotated[
        Path | None, typer.Option(help="A reader.toml: contract, CA, identity and node; then no home is needed.")
    ] = None,
    reader: Annotated[str | None, typer.Option(help="Which reader of the home reads.", show_default="owner")] = None,
    passphrase_file: Annotated[
        Path | None, typer.Option(help="Read the reader's passphrase from the first line of this file.")
    ] = None,
    topic: Annotated[str | None, typer.Option(help="Only this topic.")] = None,
    from_: Annotated[str | None, typer.Option("--from", help="Only from this time on (RFC 3339).")] = None,
    to: Annotated[str | None, typer.Option(help="Only before this time (RFC 3339).")] = None,
    at: Annotated[str | None, typer.Option(help="The state at this moment: each topic's last record by then.")] = None,
    bag: Annotated[
        Path | None,
        typer.Option(help="Write a bag that ROS tools open: NAME.bag (ROS 1), NAME.mcap, NAME.db3, or NAME, a folder."),
    ] = None,
    plot: Annotated[Path | None, typer.Option(help="Draw the trajectory (.png, .svg, .pdf).")] = None,
    json: Json = False,
    from_block: Annotated[int | None, typer.Option(min=0, help="Read the chain from this block on.")] = None,
) -> None:
    """Read a robot's records back from the chain and prove them. JSON lines go to stdout unless a bag or plot is asked.

    Exits with 9 where anything is altered, forged, missing or doubled.
    """
    from rosbridge_eth.cli.reading_ends import open_reader
    from rosbridge_eth.reader import Choice, read_robot
    from rosbridge_eth.reading import outputs

    choice = Choice(topic, _time(from_), _time(to), _time(at))
    if choice.at_ns is not None and (choice.from_ns is not None or choice.to_ns is not None):
        raise typer.BadParameter("a moment has no range: give --at, or --from and --to", param_hint="--at")
    if choice.from_ns is not None and choice.to_ns is not None and choice.from_ns >= choice.to_ns:
        raise typer.BadParameter(f"{from_} is not before --to {to}", param_hint="--from")
    if config is not None and reader is not None:
        raise typer.BadParameter("a reader.toml names its reader itself: give one of the two", param_hint="--reader")
    if bag is not None:
        outputs.check_bag(bag)
    if plot is not None:
        outputs.check_picture(plot)
    who = reader or OWNER
    end = open_reader(OperatorHome(home), config, who, lambda: read_passphrase(
        "reader", "Passphrase of the reader" if config else f"Passphrase of reader {who}", file=passphrase_file))
    try:
        reading = read_robot(
            end.chain, end.contract, robot, roots=end.roots, reader=end.identity,
            from_block=end.from_block if from_block is None else from_block,
        )
    finally:
        end.chain.close()
    chosen = choice.choose(reading.proven.records)
    records = [record.proven for record in chosen]
    if bag is not None:
        written = outputs.write_bag(bag, records)
        talk(f"{bag}: {written.whole} messages whole, {written.partial} in part, {written.as_json} as JSON")
    drawn = plot is not None and bool(outputs.positions(records))
    if plot is not None and drawn:
        outputs.draw_trajectory(plot, records)
    if bag is None and plot is None and not json:
        for record in records:
            sys.stdout.write(outputs.json_line(record))
    findings = [str(problem) for problem in reading.history.problems] + [str(f) for f in reading.proven.findings]
    if json:
        print_json(_summary(reading, findings, [outputs.as_json(record) for record in records]))
    for finding in findings:
        talk(finding)
    talk(f"{robot}: {len(reading.proven.records)} records proven, {len(chosen)} chosen; " + _verdict(reading))
    if topic is not None and not any(record.captured.topic == topic for record in chosen):
        topics = sorted({record.captured.topic for record in Choice().choose(reading.proven.records)})
        if topic not in topics:
            talk(f"nothing was read on {topic}; what was read is on: {', '.join(topics) or 'no topic'}")
    if not reading.sound:
        raise VerificationError(f"what the chain has of {robot} is not what the robot wrote; see the findings above")
    if plot is not None and not drawn:
        raise ConfigError(f"{plot} is not drawn: none of the {len(records)} chosen records holds a position")


def _verdict(reading: Reading) -> str:
    if not reading.sound:
        return "NOT SOUND"
    return "complete" if reading.complete else ", ".join(["sound", *reading.open_ends])


def _summary(reading: Reading, findings: list[str], records: list[Any]) -> dict[str, Any]:
    return {
        "robot": reading.robot, "sound": reading.sound, "complete": reading.complete, "open": reading.open_ends,
        "from_block": reading.history.from_block, "to_block": reading.history.to_block,
        "proven": len(reading.proven.records), "findings": findings, "records": records,
    }
