"""`join` and `robot`: the commands that run on a robot."""

from __future__ import annotations

import os
import signal
from pathlib import Path
from types import FrameType
from typing import Annotated

import typer

from rosbridge_eth.bundle import open_bundle
from rosbridge_eth.cli.options import ROBOT_HOME, LogFormatOption, PasswordFile, RobotHomeOption, Verbose
from rosbridge_eth.cli.output import talk
from rosbridge_eth.config import load_robot_config
from rosbridge_eth.errors import ConfigError
from rosbridge_eth.home import RobotHome
from rosbridge_eth.operations.logs import LogFormat, log_to_stderr
from rosbridge_eth.passphrases import read_passphrase

SOURCES = {
    "bag": "a bag",
    "ros1": "the live ROS 1 graph",
    "ros2": "the live ROS 2 graph",
    "sim": "a SIMULATED robot",
}
"""Kinds of source, as a person is told of them."""


def add_commands(app: typer.Typer) -> None:
    app.command(epilog="Example: rosbridge-eth join robot_1.bundle --home robot")(join)
    app.command(epilog="Example: rosbridge-eth robot --home robot --verbose")(robot)


def join(
    bundle: Annotated[Path, typer.Argument(help="The file that `register` wrote.")],
    home: RobotHomeOption = ROBOT_HOME,
    password_file: PasswordFile = None,
    keys: Annotated[
        Path | None, typer.Option(help="Folder of the robot's own keys, where the bundle was made from requests.")
    ] = None,
) -> None:
    """Make this machine a robot: unpack the bundle that the operator made for it."""
    from rosbridge_eth.robot import assembly

    try:
        content = bundle.read_bytes()
    except OSError as error:
        raise ConfigError(f"{bundle} cannot be read: {error.strerror}") from error
    password = read_passphrase("robot", "Registration password", file=password_file)
    opened = open_bundle(content, password)
    assembly.join(RobotHome(home), opened, password, keys)
    talk(f"{home} is now the home of {opened.name}. Name its topics in {RobotHome(home).config}, then run `robot`.")


def robot(
    home: RobotHomeOption = ROBOT_HOME,
    config: Annotated[Path | None, typer.Option(help="Use this file instead of robot.toml.")] = None,
    password_file: PasswordFile = None,
    verbose: Verbose = 0,
    log_format: LogFormatOption = LogFormat.TEXT,
) -> None:
    """Watch the configured topics and bring what they say to the server, until stopped or the source ends."""
    from rosbridge_eth.robot.assembly import open_robot
    from rosbridge_eth.robot.monitor import monitored

    log_to_stderr(log_format, verbose)
    place = RobotHome(home)
    end = place.bridge()
    settings = load_robot_config(config or place.config)
    source, why = settings.source_and_why(os.environ)
    talk(f"Messages come from {SOURCES[source.kind]} ({why}).")
    running = open_robot(place, settings, read_passphrase("robot", f"Password of {end.robot}", file=password_file))

    def stop(number: int, frame: FrameType | None) -> None:
        running.stop()

    for number in (signal.SIGTERM, signal.SIGINT):
        signal.signal(number, stop)
    talk(f"{end.robot} sends to {end.server_name} at {settings.server or end.server_address}; Ctrl-C ends it.")
    with monitored(running, settings.monitor) as on_turn:
        running.run(on_turn=on_turn)
    talk(running.summary())
