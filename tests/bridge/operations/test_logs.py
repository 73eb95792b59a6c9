"""One event is one line; nobody's words make a line of their own, no secret gets out; what is works again is said."""

from __future__ import annotations

import contextlib
import io
import json
import logging
import os
import shutil
from collections.abc import Iterator
from pathlib import Path

import pytest

from rosbridge_eth.errors import StoreError
from rosbridge_eth.terminal import LogFormat, Trouble, log_to_stderr, speaks_json

log = logging.getLogger("rosbridge_eth.server.reception")


@pytest.fixture(autouse=True)
def _as_before() -> Iterator[None]:
    root, ours = logging.getLogger(), logging.getLogger("rosbridge_eth")
    handlers, levels = root.handlers[:], (root.level, ours.level)
    yield
    root.handlers[:] = handlers
    root.setLevel(levels[0])
    ours.setLevel(levels[1])


def lines(format: LogFormat, verbosity: int = 2) -> io.StringIO:
    stream = io.StringIO()
    with contextlib.redirect_stderr(stream):
        log_to_stderr(format, verbosity)
    return stream


def test_json_has_time_level_part_process_and_event():
    stream = lines(LogFormat.JSON)
    log.info("%s: chunk %d stored", "robot robot_1", 7)
    event = json.loads(stream.getvalue())
    assert event["event"] == "robot robot_1: chunk 7 stored"
    assert (event["level"], event["part"], event["process"]) == ("info", "server.reception", "MainProcess")
    assert event["time"].endswith("Z") and speaks_json()


WORDS = ["a\nb", "a\r\nERROR b", "\x1b[2Ja", "a\u2028b", "\x00", "a\x85b", '"}\n{"level": "x"}']


@pytest.mark.parametrize("format", list(LogFormat))
@pytest.mark.parametrize("words", WORDS)
def test_a_strangers_words_stay_on_their_line_and_out_of_the_terminal(format: LogFormat, words: str):
    stream = lines(format)
    log.warning("no session: %s", words)
    text = stream.getvalue()
    assert text.endswith("\n") and len(text.splitlines()) == 1
    assert text[:-1].isprintable()
    if format is LogFormat.JSON:
        assert json.loads(text)["event"] == f"no session: {words}"


@pytest.mark.parametrize("format", list(LogFormat))
def test_a_failure_is_one_line_that_says_where_and_not_what_others_wrote(format: LogFormat):
    stream = lines(format)
    try:
        raise KeyError("the payload it choked on")
    except KeyError:
        log.critical("a defect ended this process", exc_info=True)
    text = stream.getvalue()
    assert len(text.splitlines()) == 1
    assert "KeyError" in text and "test_logs.py" in text
    assert "choked" not in text


def test_a_failure_of_the_bridges_own_says_its_sentence():
    stream = lines(LogFormat.TEXT)
    try:
        raise StoreError("the disk is full; make room")
    except StoreError:
        log.error("chunks are not taken", exc_info=True)
    assert "StoreError: the disk is full; make room" in stream.getvalue()


@pytest.mark.parametrize("verbosity, levels", [(0, ["WARNING"]), (1, ["INFO", "WARNING"]),
                                               (2, ["DEBUG", "INFO", "WARNING"]), (5, ["DEBUG", "INFO", "WARNING"])])
def test_verbosity_chooses_how_much_the_bridge_says_and_other_packages_stay_quiet(verbosity: int, levels: list[str]):
    stream = lines(LogFormat.TEXT, verbosity)
    for level in (logging.DEBUG, logging.INFO, logging.WARNING):
        log.log(level, "ours")
        logging.getLogger("web3.providers").log(level, "theirs")
    said = [line.split()[1] for line in stream.getvalue().splitlines() if "ours" in line]
    assert said == levels
    assert stream.getvalue().count("theirs") == 1


def test_a_log_that_is_copied_and_cut_short_goes_on_at_its_beginning(tmp_path: Path):
    """logrotate's copytruncate, of a file that the shell appends to."""
    file = tmp_path / "log"
    with file.open("a") as stream:
        with contextlib.redirect_stderr(stream):
            log_to_stderr(LogFormat.JSON, 1)
        log.info("before")
        shutil.copy(file, tmp_path / "log.1")
        os.truncate(file, 0)
        log.info("after")
    assert [json.loads(line)["event"] for line in file.read_text().splitlines()] == ["after"]
    assert json.loads((tmp_path / "log.1").read_text())["event"] == "before"


def test_trouble_is_said_at_each_change_and_so_is_its_end():
    stream = lines(LogFormat.TEXT, 0)
    trouble = Trouble(log, "the node")
    for why in (None, None, "no answer", "no answer", "too slow", None, None, "no answer", None):
        trouble.now(why)
        assert trouble.why == why
    said = [line.partition("server.reception: ")[2] for line in stream.getvalue().splitlines()]
    assert said == ["the node: no answer", "the node: too slow", "the node: works again", "the node: no answer",
                    "the node: works again"]  # fmt: skip
