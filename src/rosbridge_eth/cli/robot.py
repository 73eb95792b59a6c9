"""`join` and `robot`: the commands that run on a robot."""

from __future__ import annotations

import os
import signal
import threading
import time
from contextlib import ExitStack
from pathlib import Path
from types import FrameType
from typing import Annotated

import typer

from rosbridge_eth import bundle as bundles
from rosbridge_eth.config import load_robot_config
from rosbridge_eth.errors import ConfigError
from rosbridge_eth.home import RobotHome
from rosbridge_eth.logs import LogFormat, log_to_stderr
from rosbridge_eth.passphrases import read_passphrase
from rosbridge_eth.reading.verdict import grouped
from rosbridge_eth.terminal import ROBOT_HOME, LogFormatOption, PasswordFile, RobotHomeOption, Verbose, talk

SOURCES = {
    "bag": "a bag",
    "ros1": "the live ROS 1 graph",
    "ros2": "the live ROS 2 graph",
    "sim": "a SIMULATED robot",
}
"""Kinds of source, as a person is told of them."""


def add_commands(app: typer.Typer) -> None:
    app.command(epilog="Example: rosbridge-eth join --name robot_1; later: rosbridge-eth join robot_1.bundle")(join)
    app.command(epilog="Example: rosbridge-eth robot --home robot --verbose")(robot)


def join(
    bundle: Annotated[Path | None, typer.Argument(help="The bundle that `register` wrote.")] = None,
    name: Annotated[str | None, typer.Option(help="Make keys here, and the request for `register`.")] = None,
    home: RobotHomeOption = ROBOT_HOME,
    password_file: PasswordFile = None,
) -> None:
    """Make this machine a robot: first with --name, then with the bundle that the operator answers with.

    A bundle of `register` without a request holds the robot's keys and is all there is to join with.
    """
    place = RobotHome(home)
    if (bundle is None) == (name is None):
        raise typer.BadParameter("give --name to make keys and a request, or the bundle that answers it")
    if name is not None:
        password = read_passphrase("robot", f"Password for the keys of {name}", file=password_file, confirm=True)
        bundles.ask_to_join(place, name, password)
        talk(f"{home} has the keys of {name}; they never leave it.")
        talk(f"Carry {place.request} to the operator, who runs: rosbridge-eth register {name} {place.request.name}")
        return
    assert bundle is not None  # noqa: S101 - one of the two is given
    try:
        content = bundle.read_bytes()
    except OSError as error:
        raise ConfigError(f"{bundle} cannot be read: {error.strerror}") from error
    sealed = bundles.needs_password(content)
    secret = read_passphrase("robot", "Registration password", file=password_file) if sealed else None
    opened = bundles.read_bundle(content, secret)
    fingerprint = bundles.join(place, opened, secret)
    talk(f"The operator's CA is {grouped(fingerprint)}; compare it with what `register` showed.")
    talk(f"{home} is now the home of {opened.end.robot}. Name its topics in {place.config}, then run `robot`.")


def robot(
    home: RobotHomeOption = ROBOT_HOME,
    config: Annotated[Path | None, typer.Option(help="Use this file instead of robot.toml.")] = None,
    password_file: PasswordFile = None,
    verbose: Verbose = 0,
    log_format: LogFormatOption = LogFormat.TEXT,
) -> None:
    """Watch the configured topics and bring what they say to the server, until stopped or the source ends.

    SIGHUP: topics, nodes, [capture] and readers are read again.
    """
    from rosbridge_eth import metrics
    from rosbridge_eth.robot import open_robot, read_again
    from rosbridge_eth.supervisor import Beats, notify

    log_to_stderr(log_format, verbose)
    place = RobotHome(home)
    end = place.bridge()
    file = config or place.config
    settings = load_robot_config(file)
    source, why = settings.source_and_why(os.environ)
    talk(f"Messages come from {SOURCES[source.kind]} ({why}).")
    running = open_robot(place, settings, read_passphrase("robot", f"Password of {end.robot}", file=password_file))

    again, terminal = threading.Event(), os.isatty(2)

    def on_signal(number: int, frame: FrameType | None) -> None:
        if number == signal.SIGHUP and os.isatty(2) == terminal:
            again.set()
        else:  # also of a terminal that is gone
            running.stop()

    for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
        signal.signal(number, on_signal)
    beats = Beats()

    def on_turn() -> None:
        nonlocal settings
        if again.is_set():
            again.clear()
            settings = read_again(running, place, settings, file)
        if beats.due():
            notify("WATCHDOG=1")
            metrics.show_robot(end.robot, running, time.time())

    with ExitStack() as stack:
        if settings.monitor is not None:
            web = metrics.Web(settings.monitor, ["robot"])
            web.start()
            stack.callback(web.stop)
        talk(f"{end.robot} sends to {end.server_name} at {settings.server or end.server_address}; Ctrl-C ends it.")
        notify("READY=1")
        stack.callback(notify, "STOPPING=1")
        running.run(on_turn=on_turn)
    talk(running.summary)
