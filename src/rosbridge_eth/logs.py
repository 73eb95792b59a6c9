"""Logs on stderr: one event is one line, as text or JSON; of a record it names the place and never the content.

JSON has the members time (UTC), level, part, process, event and, where there is one, failure (the exception's class
and where it was raised). An exception's own text is shown only where the bridge wrote it: what others write may quote
what they could not read.
"""

from __future__ import annotations

import json
import logging
import traceback
from datetime import UTC, datetime
from enum import StrEnum

from rosbridge_eth.errors import BridgeError

LOGGER = "rosbridge_eth"
LEVELS = (logging.WARNING, logging.INFO, logging.DEBUG)


class LogFormat(StrEnum):
    TEXT = "text"
    JSON = "json"


class Trouble:
    """One thing that may fail and be well again: each change is logged once, the return to health too.

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
            self._log.warning("%s: well again", self._what)
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
