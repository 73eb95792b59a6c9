"""`read`: from the chain to JSON lines, a bag or a plot, with what is wrong said on stderr."""

from __future__ import annotations

import sys
from pathlib import Path
from typing import Annotated, Any

import typer

from rosbridge_eth.cli.options import OPERATOR_HOME, OperatorHomeOption
from rosbridge_eth.cli.output import Json, print_json, talk
from rosbridge_eth.config.values import parse_time
from rosbridge_eth.errors import ConfigError, VerificationError
from rosbridge_eth.home import OperatorHome
from rosbridge_eth.passphrases import read_passphrase


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
    reader: Annotated[str, typer.Option(help="Which reader of the home reads.")] = "owner",
    passphrase_file: Annotated[
        Path | None, typer.Option(help="Read the reader's passphrase from the first line of this file.")
    ] = None,
    topic: Annotated[str | None, typer.Option(help="Only this topic.")] = None,
    from_: Annotated[str | None, typer.Option("--from", help="Only from this time on (RFC 3339).")] = None,
    to: Annotated[str | None, typer.Option(help="Only before this time (RFC 3339).")] = None,
    at: Annotated[str | None, typer.Option(help="The state at this moment: each topic's last record by then.")] = None,
    bag: Annotated[Path | None, typer.Option(help="Write a bag that ROS tools open.")] = None,
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
    end = open_reader(OperatorHome(home), config, reader, lambda: read_passphrase(
        "reader", f"Passphrase of reader {reader}", file=passphrase_file))
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
    if plot is not None:
        outputs.draw_trajectory(plot, records)
    if bag is None and plot is None and not json:
        for record in records:
            sys.stdout.write(outputs.json_line(record))
    findings = [str(problem) for problem in reading.history.problems] + [str(f) for f in reading.proven.findings]
    if json:
        print_json(_summary(reading, findings, [outputs.as_json(record) for record in records]))
    for finding in findings:
        talk(finding)
    talk(f"{robot}: {len(reading.proven.records)} records proven, {len(chosen)} chosen; "
         + ("complete" if reading.complete else "sound, its end is open" if reading.sound else "NOT SOUND"))
    if not reading.sound:
        raise VerificationError(f"what the chain has of {robot} is not what the robot wrote; see the findings above")


def _summary(reading: Any, findings: list[str], records: list[Any]) -> dict[str, Any]:
    return {
        "robot": reading.robot, "sound": reading.sound, "complete": reading.complete,
        "proven": len(reading.proven.records), "findings": findings, "records": records,
    }
