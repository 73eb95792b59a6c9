"""`join` and `robot`: the commands that run on a robot."""

from __future__ import annotations

import os
import re
import shlex
import signal
import sys
import threading
import time
from collections.abc import Iterable, Sequence
from contextlib import ExitStack, closing, nullcontext, suppress
from pathlib import Path
from types import FrameType
from typing import Annotated

import typer
from rich.console import RenderableType

from rosbridge_eth import terminal
from rosbridge_eth.config import RobotConfig, load_robot_config, parse_config
from rosbridge_eth.config.home import RobotHome, require_empty
from rosbridge_eth.config.models import BagConfig, SimConfig
from rosbridge_eth.config.passphrases import read_passphrase, warn_if_others_read
from rosbridge_eth.errors import ConfigError, StoreError
from rosbridge_eth.files import naming
from rosbridge_eth.identity import check_name
from rosbridge_eth.log.chunk import STREAM_SIZE
from rosbridge_eth.operator import bundle as bundles
from rosbridge_eth.operator.status import robot_picture
from rosbridge_eth.reading.verdict import grouped
from rosbridge_eth.robot.loop import open_robot, read_again
from rosbridge_eth.robot.sources import Offer, Selection
from rosbridge_eth.robot.topics import ANYTHING, PLUMBING, SourceOption, everything, offered, robot_toml
from rosbridge_eth.server import metrics
from rosbridge_eth.server.parent import notify
from rosbridge_eth.terminal import LogFormat, errors, live, log_to_stderr, table, talk

SOURCES = {"bag": "a bag", "ros1": "the live ROS 1 graph", "ros2": "the live ROS 2 graph", "sim": "a SIMULATED robot"}
"""Kinds of source, as a person is told of them."""
TAKEN_WITHIN = 10.0  # seconds for a running robot to see what `trigger` asks for; it looks once a second


def join(
    bundle: Annotated[Path | None, typer.Argument(help="A bundle that holds the robot's keys (easy_register).")] = None,
    name: Annotated[str | None, typer.Option(help="Make keys here, and the request for `register`.")] = None,
    home: terminal.RobotHomeOption = terminal.ROBOT_HOME,
    source: SourceOption = None,
    topic: Annotated[list[str] | None, typer.Option(help="Topics, by name or pattern; else you are asked.")] = None,
    yes: Annotated[bool, typer.Option("--yes", "-y", help="Do not ask: take all topics that are found.")] = False,
    password_file: terminal.PasswordFile = None,
) -> None:
    """Make this machine a robot: its keys, topics, and a request. The operator's `register` answers it.

    The answer is a bundle: put it into the robot's home, and `robot` joins with it. A bundle of `register` without a
    request holds the robot's keys and is all there is to join with.
    """
    place = RobotHome(home)
    if bundle is not None and name is None:
        _join_with(bundle, place, password_file)
        return
    if bundle is not None or (name is None and not sys.stdin.isatty()):
        raise typer.BadParameter("give --name to make keys and a request, or a bundle that holds the keys")
    if name is None:
        name = str(typer.prompt("Name of this robot", default="robot_1", err=True))
    check_name(name)
    require_empty(home)
    config = _first_config(place, source, topic or [], asks=sys.stdin.isatty() and not yes, yes=yes)
    password = read_passphrase("robot", f"Password for the keys of {name}", file=password_file, confirm=True)
    bundles.ask_to_join(place, name, password, config)
    talk(f"{home} has the keys of {name}; they never leave it. {place.config} says what it sends.")
    talk(f"The operator runs now: rosbridge-eth register {name} {shlex.quote(str(place.request))}")


def _first_config(place: RobotHome, source: str | None, topics: list[str], *, asks: bool, yes: bool) -> str:
    """A robot.toml of what is given, found and chosen."""
    if not (asks or yes or source or topics):
        return bundles.FIRST_CONFIG
    if source is None:
        source = "sim"
        with suppress(ConfigError) if asks else nullcontext():  # who is asked need not have ROS
            source = str(ANYTHING.source_and_why(os.environ)[0].kind)
        if asks:
            asked = "Messages come from (ros1, ros2, sim, a ROS 1 master's URI, or a bag)"
            source = str(typer.prompt(asked, default=source, err=True))
    config = parse_config(RobotConfig, robot_toml(topics or ["**"], source), place.config)
    if not topics or isinstance(config.source, BagConfig | SimConfig):  # which will not offer more
        with closing(everything(config)) as opened:
            offers = offered(opened)
        if topics and not opened.live:
            Selection.of(config).resolve_all(offers, str(source))
            offers = []
        topics = topics or sorted({offer.topic for offer in offers} - PLUMBING)
        if asks and offers:
            topics = _choose(offers, topics)
    if not topics:
        raise ConfigError(f"{source} offers no topics now: name them with --topic, or start what publishes them")
    made = robot_toml(topics, source)
    parse_config(RobotConfig, made, place.config)  # what was typed may be no name
    return made


def _choose(offers: Sequence[Offer], suggested: list[str]) -> list[str]:
    numbered = {str(number): offer for number, offer in enumerate(offers, 1)}
    rows = [(number, offer.topic, offer.type_name) for number, offer in numbered.items()]
    errors.print(table("Topics", ["", "topic", "type"], rows, right=[0]))
    while True:
        given = str(typer.prompt("Which, by number, name or pattern", default="all", err=True)).strip(" ,")
        if given == "all":
            return suggested
        words = re.split("[ ,]+", given)
        if absent := [word for word in words if word.isdigit() and word not in numbered]:
            talk(f"There is no number {', '.join(absent)}. The numbers are 1 to {len(numbered)}.")
            continue
        chosen = list(dict.fromkeys(numbered[word].topic if word in numbered else word for word in words))
        try:
            parse_config(RobotConfig, robot_toml(chosen, "sim"), Path("Again"))
        except ConfigError as error:
            talk(f"{error}.")
            continue
        return chosen


def _join_with(bundle: Path, place: RobotHome, password_file: Path | None) -> None:
    content = terminal.read_given(bundle)
    with naming(bundle):
        sealed = bundles.needs_password(content)
    secret = read_passphrase("robot", "Registration password", file=password_file) if sealed else None
    with naming(bundle):
        opened = bundles.read_bundle(content, secret)
    _say_who(bundles.join(place, opened, secret))
    talk(f"{place.path} is now the home of {opened.end.robot}. Name its topics in {place.config}, then run `robot`.")


def _say_who(joined: bundles.Joined) -> None:
    talk(f"The operator's CA is {grouped(joined.ca)}; compare it with what `register` showed.")
    talk(f"Readers who can open this robot's records: {', '.join(joined.readers) or 'nobody'}.")


def robot(
    home: terminal.RobotHomeOption = terminal.ROBOT_HOME,
    password_file: terminal.PasswordFile = None, verbose: terminal.Verbose = 0,
    log_format: terminal.LogFormatOption = LogFormat.TEXT,
) -> None:  # fmt: skip
    """Capture the configured topics and send them to the server. Ends when it is stopped, or the source ends.

    SIGHUP: topics, nodes, triggers, [capture] and readers are read again. SIGUSR1: all triggers.
    """
    log_to_stderr(log_format, verbose)
    place = RobotHome(home)
    if joined := bundles.join_with_answer(place):
        _say_who(joined)
    end = place.bridge()
    settings = load_robot_config(place.config)
    source, why = settings.source_and_why(os.environ)
    talk(f"Messages come from {SOURCES[source.kind]} ({why}).")
    warn_if_others_read(*sorted(place.identity.glob("*.key.pem")))
    password = read_passphrase("robot", f"Password of {end.robot}", file=password_file)
    again, event, at_terminal = threading.Event(), threading.Event(), os.isatty(0)
    with ExitStack() as stack:
        running = open_robot(place, settings, password)  # a second robot gets no further: the spool is in use
        stack.callback(metrics.file_of(home, "robot").unlink, missing_ok=True)
        _asked_for(place, running.box.triggers)  # when nobody was there to take it

        def on_signal(number: int, frame: FrameType | None) -> None:
            if number == signal.SIGUSR1:
                event.set()
            elif number == signal.SIGHUP and os.isatty(0) == at_terminal:
                again.set()
            else:  # also of a terminal that is gone
                running.stop()

        for number in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP, signal.SIGUSR1):
            signal.signal(number, on_signal)
        stack.enter_context(metrics.served(settings.monitor))
        talk(f"{end.robot} sends to {end.server_name} at {settings.server or end.addresses()[0]}; Ctrl-C ends it.")
        beats, told, sender = metrics.Beats(1.0), not errors.is_terminal, running.sender

        def picture() -> RenderableType:
            session = sender.held or ("connected" if sender.connected else sender.refusal or "no session yet")
            return robot_picture(end.robot, session, metrics.figures())

        show = stack.enter_context(live(picture))

        def on_turn() -> None:
            nonlocal settings, told
            if again.is_set():
                again.clear()
                settings = read_again(running, place, settings)
            if event.is_set():
                event.clear()
                running.fire("SIGUSR1")
            with suppress(StoreError):  # which the robot itself tells
                if beats.due():
                    notify("WATCHDOG=1")
                    for name in _asked_for(place, running.box.triggers):
                        running.fire("asked for", name)
                    if not told and running.writer.stream and sender.newest[:STREAM_SIZE] == running.writer.stream:
                        told = True
                        before = " or before" if any(sender.newest[STREAM_SIZE:]) else ""
                        talk(f"The first record is in block {sender.block}{before}.")
                    metrics.show(metrics.of_robot(end.robot, running, time.time()))
                    metrics.save(metrics.file_of(home, "robot"))
                show()

        notify("READY=1")
        stack.callback(notify, "STOPPING=1")
        running.run(on_turn=on_turn)
    talk(running.summary)


def trigger(
    name: Annotated[str | None, typer.Argument(help="One of them; without it, all.")] = None,
    home: terminal.RobotHomeOption = terminal.ROBOT_HOME,
) -> None:
    """Trigger an event now. The robot that runs with this home writes what it has in memory."""
    (place := RobotHome(home)).bridge()
    nobody = ConfigError(f"no robot runs with the home {home}, or it has no trigger: nothing is kept in memory")
    if (figures := metrics.running(home).get("robot")) is None:
        raise nobody
    known = [labels["trigger"] for what, labels, _ in figures if what == "trigger_fired"]
    wanted = known if name is None else [name]
    if not wanted or name not in (None, *known):
        raise ConfigError(f"the robot has no trigger {name or 'at all'}; it has: {', '.join(known) or 'none'}")
    for each in wanted:
        place.event(each).touch()
    deadline = time.monotonic() + TAKEN_WITHIN
    while any(place.event(each).exists() for each in wanted):
        if time.monotonic() > deadline:
            _asked_for(place, wanted)
            raise nobody
        time.sleep(0.05)
    talk(f"{', '.join(wanted)}: what was kept is written, and so is what comes next.")


def _asked_for(place: RobotHome, triggers: Iterable[str]) -> list[str]:
    """Those of the triggers that are asked for; they are no more."""
    asked = [name for name in triggers if place.event(name).exists()]
    for name in asked:
        place.event(name).unlink(missing_ok=True)
    return asked
