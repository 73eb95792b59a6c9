"""What people see of the program: the options that commands share, a console for messages (stderr) and one for data
(stdout), and the log on stderr.

A log's event is one line, as text or JSON; of a record it names the place and never the content. JSON has the members
time (UTC), level, part, process, event and, if any, failure (the exception's class and where it was raised).
An exception's own text is shown only where the bridge wrote it: what others write may quote what they could not read.
"""

from __future__ import annotations

import json
import logging
import os
import sys
import threading
import time
import traceback
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from datetime import UTC, datetime
from enum import StrEnum
from pathlib import Path
from typing import Annotated, Any, TypeAlias

import typer
from rich.box import SIMPLE_HEAD
from rich.console import Console, RenderableType
from rich.live import Live
from rich.table import Table
from rich.text import Text

from rosbridge_eth.errors import BridgeError, ConfigError

log = logging.getLogger(__name__)

LOGGER = "rosbridge_eth"
LEVELS = (logging.WARNING, logging.INFO, logging.DEBUG)


class LogFormat(StrEnum):
    TEXT = "text"
    JSON = "json"


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
    """A table whose cells are plain text. right: the columns aligned to the right, of figures, which are not broken."""
    made = Table(
        title=Text(title, "table.title"), title_justify="left", header_style="bold", box=SIMPLE_HEAD,
        padding=(0, 1, 0, 0),
    )  # fmt: skip
    for index, column in enumerate(columns):
        figures = index in right
        made.add_column(column, justify="right" if figures else "left", overflow="fold", no_wrap=figures)
    for row in rows:
        made.add_row(*(plain(str(cell)) for cell in row))
    return made


# The log


class Trouble:
    """One thing that may fail and work again: each change is logged once, in both directions.

    what: the sentence's subject, such as "the node".
    """

    def __init__(self, log: logging.Logger, what: str) -> None:
        self._log, self._what = log, what
        self.why: str | None = None

    def now(self, why: str | None) -> None:
        """Take the present state: the reason why it fails, None if it does not."""
        if why is not None and why != self.why:
            self._log.error("%s: %s", self._what, why)
        elif why is None and self.why is not None:
            self._log.warning("%s: works again", self._what)
        self.why = why


def one_line(text: str) -> str:
    """The text with line breaks and control characters written out, so that foreign words never begin a line."""
    return "".join(c if c.isprintable() else c.encode("unicode_escape").decode() for c in text)


def _failure(event: logging.LogRecord) -> str:
    if not event.exc_info or event.exc_info[1] is None:
        return ""
    error = event.exc_info[1]
    said = f": {error}" if isinstance(error, BridgeError) else ""
    frames = traceback.extract_tb(error.__traceback__)
    where = " < ".join(f"{frame.name} ({frame.filename.rpartition('/')[2]}:{frame.lineno})" for frame in frames[::-1])
    return f"{type(error).__name__}{said} in {where}"


def _time(event: logging.LogRecord) -> str:
    return datetime.fromtimestamp(event.created, UTC).isoformat(timespec="milliseconds").replace("+00:00", "Z")


class TextFormatter(logging.Formatter):
    """`2026-11-21T10:00:00.000Z INFO server: robot robot_1: session begun`."""

    def format(self, record: logging.LogRecord) -> str:
        failure = _failure(record)
        text = record.getMessage() + (f" [{failure}]" if failure else "")
        return f"{_time(record)} {record.levelname} {record.name.removeprefix(LOGGER + '.')}: {one_line(text)}"


class JsonFormatter(logging.Formatter):
    """One JSON object."""

    def format(self, record: logging.LogRecord) -> str:
        failure = _failure(record)
        return json.dumps({
            "time": _time(record), "level": record.levelname.lower(), "part": record.name.removeprefix(LOGGER + "."),
            "process": record.processName, "event": record.getMessage(), **({"failure": failure} if failure else {}),
        })  # fmt: skip


def log_to_stderr(format: LogFormat = LogFormat.TEXT, verbosity: int = 0) -> None:
    """Send the bridge's logs to stderr: warnings, with verbosity 1 what happens, with 2 every chunk.

    Other packages' logs are shown from warnings on, whatever the verbosity: theirs would name URLs and quote requests.
    """
    handler = logging.StreamHandler()
    handler.setFormatter(JsonFormatter() if format is LogFormat.JSON else TextFormatter())
    logging.basicConfig(level=logging.WARNING, handlers=[handler], force=True)
    logging.getLogger(LOGGER).setLevel(LEVELS[min(verbosity, len(LEVELS) - 1)])


def speaks_json() -> bool:
    """Whether stderr carries JSON events, so that nothing else may stand there."""
    return any(isinstance(handler.formatter, JsonFormatter) for handler in logging.getLogger().handlers)
