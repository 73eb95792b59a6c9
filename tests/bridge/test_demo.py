"""The main job: every record of the sample bag through UDP onto the EVM and back, and what the demo says if not."""

from __future__ import annotations

import json
import os
import re
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import pytest

from rosbridge_eth.capture import MessageLine
from rosbridge_eth.cli import run
from rosbridge_eth.cli.demo import DemoResult, _page, run_demo
from rosbridge_eth.errors import ExitCode
from rosbridge_eth.reading import Kind
from rosbridge_eth.reading.compare import compare
from rosbridge_eth.robot.loop import Robot
from rosbridge_eth.robot.sources.bag import sample_bag

ROOT = Path(__file__).resolve().parents[2]
TOPIC = "/robot_1/odom"


@pytest.fixture(scope="module")
def result(tmp_path_factory: pytest.TempPathFactory) -> DemoResult:
    return run_demo(tmp_path_factory.mktemp("demo"), sample_bag())


def contents(result: DemoResult) -> list[MessageLine]:
    return [record.content for record in result.records]


def test_every_record_of_the_bag_comes_back_proven(result: DemoResult) -> None:
    assert result.passed
    assert result.captured == result.comparison.equal == 300
    assert result.verdict.sound and result.verdict.head is not None and result.verdict.head.goodbye
    assert {finding.kind for finding in result.verdict.findings} <= {Kind.CLOCK}  # this machine's may be wrong
    assert not result.comparison.differences


def test_a_record_costs_less_gas_than_half_of_the_first_editions(result: DemoResult) -> None:
    gas = sum(transaction.gas for transaction in result.transactions)
    assert sum(transaction.chunks for transaction in result.transactions) == result.chunks
    assert 0 < gas / len(result.records) < 5_250


def test_a_missing_record_is_told(result: DemoResult) -> None:
    comparison = compare(sample_bag(), [TOPIC], contents(result)[:-1])
    assert (comparison.equal, comparison.wrong) == (299, 1)
    assert "no record of this message" in comparison.differences[0]


def test_a_doubled_record_is_told(result: DemoResult) -> None:
    records = contents(result)
    comparison = compare(sample_bag(), [TOPIC], [*records, records[-1]])
    assert (comparison.equal, comparison.wrong) == (300, 1)
    assert "no such message" in comparison.differences[0]


def test_an_altered_field_is_told_by_its_path(result: DemoResult) -> None:
    records = contents(result)
    data = json.loads(json.dumps(records[7].data))
    data["pose"]["pose"]["position"]["x"] += 1e-9
    records[7] = records[7]._replace(data=data)
    comparison = compare(sample_bag(), [TOPIC], records)
    assert comparison.equal == 299
    assert "pose.pose.position.x" in comparison.differences[0]


def test_an_incomplete_result_does_not_pass(result: DemoResult) -> None:
    assert not replace(result, records=result.records[:-1]).passed


def test_a_robot_that_is_stopped_says_so_on_the_chain(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    # What waits when the robot is stopped is captured, too.
    monkeypatch.setattr("rosbridge_eth.robot.loop.REPLAYED_BYTES", 5000)
    monkeypatch.setattr("rosbridge_eth.robot.loop.TAKE", 1)

    def stop_early(robot: Robot) -> None:
        # Without a session it would stop with everything in its spool, as it should.
        if robot.captured >= 100 and robot.sender.connected:
            robot.stop()  # at the end once more, as a signal may come when all is done

    for attempt in range(5):  # a machine that is busy may capture the whole bag before there is a session
        (folder := tmp_path / str(attempt)).mkdir()
        stopped = run_demo(folder, sample_bag(), on_turn=stop_early)
        if len(stopped.records) < 300:
            break
    assert 100 <= len(stopped.records) < 300
    assert stopped.verdict.sound and stopped.verdict.head is not None
    assert stopped.verdict.head.goodbye  # nothing after the last record can have been withheld
    assert not stopped.passed


def test_the_report_says_what_failed_and_escapes_what_others_wrote(result: DemoResult) -> None:
    altered = [*contents(result)[:-1], contents(result)[0]]
    failed = replace(
        result, comparison=compare(sample_bag(), [TOPIC], altered), verdict=replace(result.verdict, robot="<script>"),
    )  # fmt: skip
    passed, page = _page(result, "drive.bag", "", []), _page(failed, "<i>.bag", "", [])
    assert 'class="verdict good">Every record came back' in passed and "drive.bag" in passed
    assert 'class="verdict bad">Not every record came back' in page and "no record of this message" in page
    assert "<b>300</b>records captured" in page and "<b>299</b>equal" in page
    assert "&lt;script&gt;" in page and "&lt;i&gt;.bag" in page and "<script>" not in page and "<i>" not in page


def test_a_report_that_cannot_be_written_is_told_before_the_work(capsys: pytest.CaptureFixture[str]) -> None:
    assert run(["demo", "--report", "/proc/x"]) == ExitCode.CONFIG
    said = capsys.readouterr().err
    assert "/proc/x cannot be written" in said and "--report" in said and "keys" not in said


@pytest.mark.slow
def test_the_command_prints_the_stages_and_leaves_a_report(tmp_path: Path) -> None:
    environment = {**os.environ, "PYTHONPATH": str(ROOT / "src")}
    done = subprocess.run(
        [sys.executable, "-m", "rosbridge_eth", "demo", "--report", str(tmp_path / "report")],
        capture_output=True, env=environment, cwd=tmp_path, check=False, timeout=120,
    )
    assert done.returncode == 0, done.stderr.decode()
    assert re.search(r"records equal to the bag's +300 .*Transactions to 0x.*0x", done.stdout.decode(), re.DOTALL)
    assert (tmp_path / "report" / "trajectory.png").read_bytes().startswith(b"\x89PNG")
    assert len((tmp_path / "report" / "records.jsonl").read_text().splitlines()) == 300
    page = (tmp_path / "report" / "report.html").read_text()
    assert "Every record came back" in page and "<pre" not in page
    assert "<b>300</b>records captured" in page and "<h2>Transactions to 0x" in page
