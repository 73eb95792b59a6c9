"""How the commands meet a person: the options they share, one console for talk (stderr), one for data (stdout)."""

from __future__ import annotations

import json
import logging
import os
import sys
import threading
import time
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from pathlib import Path
from typing import Annotated, Any, TypeAlias

import typer
from rich.box import SIMPLE_HEAD
from rich.console import Console, RenderableType
from rich.live import Live
from rich.table import Table
from rich.text import Text

from rosbridge_eth.errors import ConfigError
from rosbridge_eth.logs import LogFormat, one_line, speaks_json

log = logging.getLogger(__name__)

errors = Console(stderr=True, highlight=False, soft_wrap=True, emoji=False)  # else ":b:" of an address is a picture
data = Console(highlight=False, emoji=False)

OPERATOR_HOME, ROBOT_HOME, READER_HOME = Path("operator"), Path("robot"), Path("reader")

OperatorHomeOption: TypeAlias = Annotated[Path, typer.Option(
    "--home", help="The operator's folder.", envvar="ROSBRIDGE_ETH_HOME")]
RobotHomeOption: TypeAlias = Annotated[Path, typer.Option(
    "--home", help="The robot's folder.", envvar="ROSBRIDGE_ETH_ROBOT_HOME")]
ReaderHomeOption: TypeAlias = Annotated[Path, typer.Option(
    "--home", help="The reader's folder.", envvar="ROSBRIDGE_ETH_READER_HOME")]
AnyHomeOption: TypeAlias = Annotated[Path, typer.Option(
    "--home", help="An operator's, a robot's or a reader's folder.", envvar="ROSBRIDGE_ETH_HOME")]
PassphraseFile: TypeAlias = Annotated[Path | None, typer.Option(
    "--passphrase-file", help="Read the passphrase from the first line of this file, and do not ask.")]
PasswordFile: TypeAlias = Annotated[Path | None, typer.Option(
    "--password-file", help="Read the robot's password from the first line of this file.")]
Verbose: TypeAlias = Annotated[int, typer.Option(
    "--verbose", "-v", count=True, help="Log what happens on stderr; twice (-vv): every chunk.")]
LogFormatOption: TypeAlias = Annotated[LogFormat, typer.Option("--log-format", help="How a line of the log looks.")]
Json = Annotated[bool, typer.Option("--json", help="Print JSON on stdout.")]


def utc_now() -> datetime:
    return datetime.now(UTC)


def read_given(path: Path, limit: int = -1) -> bytes:
    """A file that was named on the command line, or so many bytes of it; ConfigError."""
    try:
        with path.open("rb") as file:
            return file.read(limit)
    except OSError as error:
        raise ConfigError(f"{path} cannot be read: {error.strerror}") from error


def talk(text: str) -> None:
    """A line for the person at the terminal; nothing in it is markup or acts on the terminal. An event, where stderr
    carries JSON."""
    if speaks_json():
        log.warning("%s", text)
        return
    errors.print(one_line(text), markup=False)


@contextmanager
def live(make: Callable[[], RenderableType]) -> Iterator[Callable[[], None]]:
    """At a terminal a picture that stays below all that is written to stderr, also by processes that are forked inside.
    Gives what brings it up to date, once a second at most. Without a terminal there is nothing, and it does nothing.
    """
    if not os.isatty(2) or speaks_json():
        yield lambda: None
        return
    ours, (end, begin), due = os.dup(2), os.pipe(), [0.0]
    errors.file = os.fdopen(ours, "w")
    os.dup2(begin, 2)
    os.close(begin)

    def pass_on() -> None:
        with os.fdopen(end, errors="replace") as lines:
            for line in lines:
                with suppress(OSError):  # the terminal is gone
                    errors.print(line.rstrip("\n"), markup=False)

    def show() -> None:
        if time.monotonic() >= due[0]:
            due[0] = time.monotonic() + 1.0
            with suppress(OSError):
                shown.update(make(), refresh=True)

    thread = threading.Thread(target=pass_on, name="stderr", daemon=True)
    thread.start()
    shown = Live(console=errors, auto_refresh=False, redirect_stdout=False, redirect_stderr=False)
    shown.start()
    try:
        yield show
    finally:
        os.dup2(ours, 2)  # and the thread comes to its end
        thread.join(1.0)
        with suppress(OSError):
            shown.stop()
        errors.file = sys.stderr


def plain(text: str) -> Text:
    """For a picture or table: nothing in it is markup or acts on the terminal. It may have several lines."""
    return Text("\n".join(map(one_line, text.split("\n"))))


def print_json(value: Any) -> None:
    """One JSON value on stdout, for programs. In ASCII: what a robot wrote does not act on a terminal."""
    sys.stdout.write(json.dumps(value) + "\n")


def table(title: str, columns: Sequence[str], rows: Iterable[Sequence[object]], *, right: Sequence[int] = ()) -> Table:
    """A table whose cells are plain text; `right` are the columns aligned to the right."""
    made = Table(
        title=Text(title, "table.title"), title_justify="left", header_style="bold", box=SIMPLE_HEAD,
        padding=(0, 1, 0, 0),
    )  # fmt: skip
    for index, column in enumerate(columns):
        made.add_column(column, justify="right" if index in right else "left", overflow="fold", no_wrap=not index)
    for row in rows:
        made.add_row(*(plain(str(cell)) for cell in row))
    return made
