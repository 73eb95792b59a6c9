"""`read` as it is typed: every output in one pass, what is kept, and what a person sees."""

from __future__ import annotations

import json

import pytest

from bridge.operations.conftest import Place
from bridge.operations.test_exit_codes import CHECK, READER, STREAM_LINE, replayed, written
from rosbridge_eth.cli import run
from rosbridge_eth.identity import load_identity
from rosbridge_eth.ledger import Keyring, Ledger
from rosbridge_eth.reading.fetch import MARGIN

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
    for column in ("received", "header.stamp"):
        assert str(table.schema.field(column).type) == "timestamp[ns, tz=UTC]"
    assert str(table.schema.field("pose.covariance").type) == "list<element: double>"
    assert place.path.joinpath("x.png").read_bytes().startswith(b"\x89PNG")
    assert place.path.joinpath("o.mcap").stat().st_size > 10_000
    assert run([*READ, "--plot", "y.png", "--field", "no.such.field"]) == 3
    assert run([*READ, "--field", "x"]) == 2


def test_stream_and_number_of_a_record_and_of_the_verdict_are_what_check_takes(
    place: Place, keys: Keyring, capsys: pytest.CaptureFixture[str]
):
    replayed(place, keys)
    assert run(READ) == 0
    said = capsys.readouterr()
    proof = json.loads(said.out.splitlines()[0])["proof"]
    assert (proof["stream"], str(proof["number"])) == CHECK[2:4]
    assert f"number 0 of stream {CHECK[2]}" in said.err
    assert run([*READ, "--json"]) == 0
    head = json.loads(capsys.readouterr().out)["head"]
    assert (head["stream"], head["number"]) == (proof["stream"], proof["number"])
    assert run(["check", "robot_1", head["stream"], str(head["number"])]) == 0


def test_what_was_read_is_kept_and_ends_the_same(place: Place, keys: Keyring, capsys: pytest.CaptureFixture[str]):
    replayed(place, keys)
    place.chain.ethereum_tester.mine_blocks(MARGIN)
    said = []
    for _ in range(2):
        assert run([*READ, "--topic", "/robot_1/odom"]) == 0
        said.append(capsys.readouterr())
    assert said[0].out == said[1].out
    assert said[0].err == said[1].err
    [kept] = place.path.joinpath("reader", "proven").iterdir()
    assert kept.stat().st_size > 10_000
    assert run([*READ, "--confirmations", str(MARGIN + 2)]) == 0
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
