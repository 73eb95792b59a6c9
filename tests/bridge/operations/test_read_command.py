"""`read` as it is typed: every output in one pass, what is kept, and what a person sees."""

from __future__ import annotations

import json
import os
import signal
from collections.abc import Callable
from urllib.request import urlopen

import pytest
from rosbags.highlevel import AnyReader

from bridge.operations.conftest import Place
from bridge.operations.test_exit_codes import READER, STREAM, STREAM_LINE, replayed, written
from rosbridge_eth.cli import run
from rosbridge_eth.errors import ChainError
from rosbridge_eth.identity import load_identity
from rosbridge_eth.ledger import Keyring, Ledger
from rosbridge_eth.reading import follow

READ = ("read", "robot_1", *READER)


@pytest.fixture(autouse=True)
def node(place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    connect = Ledger.connect
    monkeypatch.setattr(Ledger, "connect", lambda where, at, **more: connect(place.chain, at, **more))


def test_every_output_comes_of_one_reading(place: Place, keys: Keyring, capsys: pytest.CaptureFixture[str]):
    parquet = pytest.importorskip("pyarrow.parquet")
    replayed(place, keys)
    field = ("--plot", "x.png", "--field", "pose.pose.position.x", "--field", "twist.twist.linear.x")
    outputs = ("--bag", "o.mcap", "--table", "o.parquet", *field, "--json")
    assert run([*READ, *outputs]) == 0
    shown = capsys.readouterr()
    said = json.loads(shown.out)
    assert "o.mcap: 300 whole messages, 0 with fields left out, 0 as JSON" in shown.err
    assert (said["sound"], said["records"], said["chosen"]) == (True, 300, 300)
    table = parquet.read_table("o.parquet")
    assert table.num_rows == 300
    assert str(table.schema.field("received_ns").type) == "timestamp[ns, tz=UTC]"
    assert str(table.schema.field("header.stamp").type) == "int64"
    assert str(table.schema.field("pose.covariance").type) == "list<element: double>"
    assert place.path.joinpath("x.png").read_bytes().startswith(b"\x89PNG")
    assert place.path.joinpath("o.mcap").stat().st_size > 10_000
    assert run([*READ, "--plot", "y.png", "--field", "no.such.field"]) == 3
    assert run([*READ, "--field", "x"]) == 2


def test_stream_and_number_of_a_record_and_of_the_verdict_are_what_status_shows(
    place: Place, keys: Keyring, capsys: pytest.CaptureFixture[str]
):
    replayed(place, keys)
    assert run(READ) == 0
    said = capsys.readouterr()
    proof = json.loads(said.out.splitlines()[0])["proof"]
    assert (proof["stream"], proof["number"]) == (STREAM.hex(), 0)
    assert f"number 0 of stream {STREAM.hex()}" in said.err
    assert run([*READ, "--json"]) == 0
    head = json.loads(capsys.readouterr().out)["head"]
    assert (head["stream"], head["number"]) == (proof["stream"], proof["number"])
    assert run(["status", "robot_1", "--json"]) == 0
    log = json.loads(capsys.readouterr().out)["robots"]["robot_1"]["log"]
    assert (log["confirmed"]["stream"], log["confirmed"]["number"]) == (proof["stream"], proof["number"])
    assert (log["confirmed"]["block"], log["confirmed"]["transaction"]) == (proof["block"], proof["transaction"])


def test_what_was_read_is_kept_and_ends_the_same(place: Place, keys: Keyring, capsys: pytest.CaptureFixture[str]):
    replayed(place, keys)
    place.chain.ethereum_tester.mine_blocks(5)
    said = []
    for _ in range(2):
        assert run([*READ, "--topic", "/robot_1/odom"]) == 0
        said.append(capsys.readouterr())
    assert said[0].out == said[1].out
    assert said[0].err == said[1].err
    [kept] = place.path.joinpath("reader", "proven").iterdir()
    assert kept.stat().st_size > 4_096
    assert run([*READ, "--confirmations", "7"]) == 0
    assert "no chunk of this robot is written" in capsys.readouterr().err


def test_topics_are_escaped_where_nothing_was_read(place: Place, keys: Keyring, capsys: pytest.CaptureFixture[str]):
    owner, _ = load_identity(place.path / "reader", b"the reader's own words")
    line = {"topic": "/\x1b[2J\u202e", "type": "a/msg/A", "source": "sim", "received_ns": 1, "captured_ns": 1,
            "clock": True, "data": {"x": 1}}  # fmt: skip
    hostile = json.dumps(line, separators=(",", ":"), ensure_ascii=False).replace("\x1b", "\\u001b").encode()
    written(place, keys, owner.encryption_key.public_key, [STREAM_LINE, hostile])
    assert run([*READ, "--topic", "/\x1b[3J"]) == 0
    said = capsys.readouterr().err
    assert "nothing was read on" in said
    assert all(text.isprintable() for text in said.splitlines())


def steps(monkeypatch: pytest.MonkeyPatch, *each: Callable[[], object]) -> None:
    """Between the looks of a `read --follow`, one after the other; the last one ends it."""
    left = [*each]
    news = follow.Following.news

    def step(self: follow.Following) -> list[str]:
        said = list(news(self))
        left.pop(0)()
        return said

    monkeypatch.setattr(follow, "EVERY", 0.0)
    monkeypatch.setattr(follow.Following, "news", step)


@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_read_goes_on_as_blocks_come_and_ends_in_order(
    place: Place, keys: Keyring, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch, number: int
):
    def grown() -> None:
        with AnyReader([place.path / "g.mcap"]) as bag:
            assert bag.message_count == 300

    steps(monkeypatch, lambda: replayed(place, keys), grown, lambda: os.kill(os.getpid(), number))
    before = signal.getsignal(number)
    assert run([*READ, "--follow", "--bag", "g.mcap", "--table", "g.csv", "--plot", "g.png", "--json"]) == 0
    said = capsys.readouterr()
    verdict = json.loads(said.out)
    assert (verdict["sound"], verdict["records"], verdict["chosen"], verdict["chunks"]) == (True, 300, 300, 1)
    assert "robot_1: sound, 0 chunks, read up to block" in said.err and "300 records proven" in said.err
    assert (place.path / "g.csv").read_text().count("\n") == 301
    assert "g.mcap: 300 whole messages" in said.err and (place.path / "g.png").stat().st_size > 5_000
    assert signal.getsignal(number) is before
    bookmarks = json.loads((place.path / "reader" / "bookmarks.json").read_text())
    assert [mark["count"] for mark in bookmarks["logs"].values()] == [1]


def test_json_lines_come_as_blocks_come_and_an_unsound_log_ends_with_9(
    place: Place, keys: Keyring, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    replayed(place, keys)
    steps(monkeypatch, lambda: replayed(place, keys), lambda: None, lambda: os.kill(os.getpid(), signal.SIGINT))
    assert run([*READ, "--follow"]) == 9
    said = capsys.readouterr()
    assert said.out.count('"proof":') == 600
    assert "forked: chunk 1" in said.err and "see the findings above" in said.err


def test_the_page_is_served_while_it_is_followed(
    place: Place, keys: Keyring, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    shown = list[bytes]()

    def look() -> None:
        said = capsys.readouterr().err
        address = said.partition("The page is ")[2].partition(";")[0]
        shown.append(urlopen(address).read())
        with urlopen(address + "events") as events:
            shown.extend(events.readline() for _ in range(3))

    replayed(place, keys)
    steps(monkeypatch, look, lambda: os.kill(os.getpid(), signal.SIGINT))
    assert run([*READ, "robot_1", "--follow", "--serve", "0"]) == 0
    assert b"<title>Robots" in shown[0]
    [robot] = json.loads(shown[3].removeprefix(b"data: "))["robots"]
    assert (robot["name"], robot["sound"], robot["tracks"][0]["count"]) == ("robot_1", True, 300)
    assert capsys.readouterr().out == "", "with a page there are no JSON lines"


@pytest.mark.parametrize("wrong", [
    ["--serve", "0"], ["--follow", "--at", "2026-11-21T10:00:00Z"], ["--follow", "--bag", "g.bag"], ["robot_2"],
    ["robot_2", "--follow"], ["robot_2", "--follow", "--serve", "0", "--bag", "g.mcap"],
    ["--follow", "--serve", "x:y:1"], ["--follow", "--serve", "70000"],
])  # fmt: skip
def test_what_does_not_go_together_is_a_usage_error(place: Place, wrong: list[str]):
    assert run([*READ, *wrong]) == 2


def test_a_reading_that_never_came_to_its_end_is_interrupted(
    place: Place, keys: Keyring, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    def away(*_: object) -> None:
        raise ChainError("the node does not answer")

    monkeypatch.setattr(Ledger, "block", away)
    steps(monkeypatch, lambda: None, lambda: os.kill(os.getpid(), signal.SIGINT))
    assert run([*READ, "--follow"]) == 7
    assert capsys.readouterr().err.count("the node does not answer; it is asked again") == 1
