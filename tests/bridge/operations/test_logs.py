"""One event is one line, with the record's name; nobody's words make a line of their own, no secret gets out."""

from __future__ import annotations

import io
import json
import logging
from collections.abc import Iterator

import pytest

from rosbridge_eth.errors import StoreError
from rosbridge_eth.operations.logs import LogFormat, log_to
from rosbridge_eth.records import RecordId

ID = RecordId(bytes(range(32)), bytes(range(16)), 2**63 + 1)
IN_FULL = f"{bytes(range(32)).hex()}/{bytes(range(16)).hex()}/{2**63 + 1}"
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
    log_to(stream, format, verbosity)
    return stream


def test_json_names_records_in_full_beside_the_short_form():
    stream = lines(LogFormat.JSON)
    log.info("record %s of %s: stored", ID, "robot robot_1")
    event = json.loads(stream.getvalue())
    assert event["records"] == [IN_FULL]
    assert event["event"] == f"record {ID} of robot robot_1: stored"
    assert (event["level"], event["part"]) == ("info", "server.reception")
    assert event["time"].endswith("Z")


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
        log.error("records are not taken", exc_info=True)
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
