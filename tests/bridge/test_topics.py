"""`topics`: what there is, how much of it, and what it would cost; `join` chooses among it."""

from __future__ import annotations

import json
import re
import threading
from pathlib import Path
from typing import Any

import pytest

from bridge.image_bags import bag_of_images
from rosbridge_eth.cli import run
from rosbridge_eth.config import load_robot_config
from rosbridge_eth.config.models import BagConfig
from rosbridge_eth.errors import ExitCode, SourceError
from rosbridge_eth.ledger.contract import set_data_cost
from rosbridge_eth.log.chunk import MAX_READERS
from rosbridge_eth.robot.sources import BagSource, sample_bag
from rosbridge_eth.robot.topics import ANYTHING, robot_toml, survey

Capture = pytest.CaptureFixture[str]
BAG = str(sample_bag())
DAY = 86_400


@pytest.fixture(autouse=True)
def _place(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    for name in ("ROS_VERSION", "ROS_DISTRO", "ROS_MASTER_URI"):
        monkeypatch.delenv(name, raising=False)
    Path("word").write_text("word")


def topics(capsys: Capture, *arguments: str) -> dict[str, Any]:
    assert run(["topics", "--json", *arguments]) == 0
    report: dict[str, Any] = json.loads(capsys.readouterr().out)
    return report


def test_a_bag_is_told_topic_by_topic_with_rates_sizes_and_cost(capsys: Capture):
    from rosbags.rosbag1 import Reader

    report = topics(capsys, "--source", BAG)
    with Reader(BAG) as bag:
        span = (bag.end_time - bag.start_time) / 1e9
        counts = {name: info.msgcount for name, info in bag.topics.items()}
        sizes = dict.fromkeys(counts, 0)
        for connection, _, raw in bag.messages():
            sizes[connection.topic] += len(raw)
    assert report["seconds"] == pytest.approx(span, abs=0.1)
    assert [each["topic"] for each in report["topics"]] == sorted(counts)
    for each in report["topics"]:
        count = counts[each["topic"]]
        assert each["messages"] == count and each["size"] == pytest.approx(sizes[each["topic"]] / count)
        assert each["rate"] == pytest.approx(count / span, rel=0.05)
        assert each["chosen"] and each["bytes_per_day"] > 0
    odom = next(each for each in report["topics"] if each["topic"] == "/robot_1/odom")
    assert odom["type"] == "nav_msgs/msg/Odometry" and odom["nodes"]
    assert 50 < odom["bytes_per_day"] / (odom["rate"] * DAY) < 200, "bytes a record, see docs/bridge-figures.md"
    assert run(["topics", "--source", BAG]) == 0
    shown = capsys.readouterr()
    assert "/robot_1/imu" in shown.out and "ETH at 1 gwei" in shown.err


def test_the_topics_of_ros_itself_are_not_counted_where_join_leaves_them_out():
    config = ANYTHING.model_copy(update={"source": BagConfig(kind="bag", path=BAG)})  # type: ignore[arg-type]
    everything = survey(config, 5.0)
    without = survey(config, 5.0, 1, {"/robot_1/imu"})
    assert [each["chosen"] for each in without["topics"]] == [False, True]
    assert without["bytes_per_day"] < everything["bytes_per_day"]
    assert without["gas_per_day"]["full_batches"] < everything["gas_per_day"]["full_batches"]


@pytest.mark.parametrize("topic, says", [("odom", "has no topic or node /odom;"), ("a" * 300, "300|301")])
@pytest.mark.parametrize("source", ["sim", BAG])
def test_join_refuses_a_topic_that_can_never_come(source: str, topic: str, says: str, capsys: Capture):
    given = ["join", "--name", "r", "--topic", topic, "--source", source, "--password-file", "word"]
    assert run(given) in (ExitCode.SOURCE, ExitCode.CONFIG)
    assert re.search(says, capsys.readouterr().err)
    assert not Path("robot").exists()


def test_a_type_is_in_one_piece_at_80_columns(capsys: Capture, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setenv("COLUMNS", "80")
    assert run(["topics", "--source", BAG]) == 0
    assert "nav_msgs/msg/Odometry" in capsys.readouterr().out


def test_the_cost_is_that_of_what_robot_toml_takes(capsys: Capture):
    everything = topics(capsys, "--source", BAG)
    Path("robot").mkdir()
    Path("robot/robot.toml").write_text(robot_toml(["/robot_1/odom"], BAG))
    odom = topics(capsys)
    assert [each["chosen"] for each in odom["topics"]] == [False, True]
    assert [each["bytes_per_day"] for each in odom["topics"]] == pytest.approx(
        [each["bytes_per_day"] for each in everything["topics"]], rel=0.1), "each is told what it would cost"
    assert odom["bytes_per_day"] < everything["bytes_per_day"] and odom["chunks_per_day"] == pytest.approx(DAY, rel=0.1)
    gas = odom["gas_per_day"]
    chunk = odom["bytes_per_day"] / odom["chunks_per_day"]
    assert gas["one_chunk_each"] == pytest.approx(odom["chunks_per_day"] * set_data_cost([round(chunk)]), rel=0.02)
    assert 40 * odom["bytes_per_day"] < gas["full_batches"] < gas["one_chunk_each"]
    text = Path("robot/robot.toml").read_text()
    Path("robot/robot.toml").write_text(text.replace('"/robot_1/odom"', '{topic = "/robot_1/odom", rate = 1.0}'))
    slow = topics(capsys)["topics"][1]
    assert slow["rate"] == odom["topics"][1]["rate"] and slow["bytes_per_day"] < odom["topics"][1]["bytes_per_day"] / 3


def test_every_reader_costs(capsys: Capture):
    from rosbridge_eth.robot.topics import survey

    Path("robot.toml").write_text(robot_toml(["/robot_1/odom"], "sim"))
    config = load_robot_config(Path("robot.toml"))
    one, all_of_them = survey(config, 5.0), survey(config, 5.0, MAX_READERS)
    grown = all_of_them["bytes_per_day"] / all_of_them["chunks_per_day"] - one["bytes_per_day"] / one["chunks_per_day"]
    assert grown == pytest.approx(15 * 113, abs=4), "docs/log.md: a wrapped key"


def test_each_reader_costs(capsys: Capture):
    Path("robot/readers").mkdir(parents=True)
    taken = robot_toml(["/robot_1/odom"], BAG)
    Path("robot/robot.toml").write_text(taken)
    one = topics(capsys)
    for name in ("a.pem", "b.pem", "c.pem"):
        Path("robot/readers", name).touch()
    three = topics(capsys)
    grown = three["bytes_per_day"] / three["chunks_per_day"] - one["bytes_per_day"] / one["chunks_per_day"]
    assert grown == pytest.approx(2 * 113, abs=4)


def test_a_source_that_breaks_ends_the_listening_too(monkeypatch: pytest.MonkeyPatch):
    from rosbridge_eth.robot.topics import survey

    def breaks(source: BagSource, emit: object, stop: object) -> None:
        raise SourceError("the bag is cut off here")

    monkeypatch.setattr(BagSource, "run", breaks)
    Path("robot.toml").write_text(robot_toml(["**"], BAG))
    before, config = {*threading.enumerate()}, load_robot_config(Path("robot.toml"))
    with pytest.raises(SourceError):
        survey(config, 30.0)
    for thread in {*threading.enumerate()} - before:
        thread.join(5.0)
        assert not thread.is_alive(), "nothing waits for the time to pass"


def test_where_there_is_no_source_it_says_how_to_name_one(capsys: Capture):
    assert run(["topics"]) == ExitCode.CONFIG
    assert "ROS_MASTER_URI" in capsys.readouterr().err
    assert run(["topics", "--source", "absent.bag"]) == ExitCode.SOURCE
    assert "absent.bag" in capsys.readouterr().err
    assert run(["topics", "--source", "http://127.0.0.1:9"]) == ExitCode.SOURCE
    assert "Traceback" not in capsys.readouterr().err


def join(*arguments: str) -> int:
    return run(["join", "--name", "robot_1", "--password-file", "word", *arguments])


@pytest.mark.parametrize("source, kind", [
    ("sim", "sim"), ("ros2", "ros2"), ("http://robot:11311", "ros1"), (BAG, "bag"),
])
def test_join_writes_the_source_and_the_topics_that_it_is_given(source: str, kind: str):
    assert join("--source", source, "--topic", "/robot_1/odom", "--topic", "/robot_1/i*") == 0
    config = load_robot_config(Path("robot/robot.toml"))
    assert [topic.topic for topic in config.topics] == ["/robot_1/odom", "/robot_1/i*"] and config.source is not None
    assert config.source.kind == kind and Path("robot/request.json").exists()
    assert source in Path("robot/robot.toml").read_text()


def test_join_takes_all_that_a_source_offers_where_nobody_is_to_be_asked(capsys: Capture):
    assert join("--source", BAG, "--yes") == 0
    config = load_robot_config(Path("robot/robot.toml"))
    assert [topic.topic for topic in config.topics] == ["/robot_1/imu", "/robot_1/odom"]


@pytest.mark.parametrize("arguments, code, says", [
    (["--yes"], ExitCode.CONFIG, "ROS_MASTER_URI"),
    (["--source", "absent.bag"], ExitCode.SOURCE, "absent.bag"),
    (["--source", "absent.bag", "--topic", "/a"], ExitCode.SOURCE, "absent.bag"),
    (["--source", "gopher://robot", "--topic", "/a"], ExitCode.CONFIG, "master"),
    (["--source", "sim", "--topic", "a b"], ExitCode.CONFIG, "a b"),
])
def test_join_makes_nothing_where_the_choice_cannot_be_made(
    arguments: list[str], code: ExitCode, says: str, capsys: Capture
):
    assert join(*arguments) == code
    assert says in capsys.readouterr().err and not Path("robot").exists()


def test_a_topic_of_images_costs_its_digests(capsys: Capture):
    bag_of_images(Path("drive.bag"))
    Path("robot").mkdir()
    Path("robot/robot.toml").write_text(robot_toml(["/camera/compressed"], "drive.bag"))
    [taken] = [each for each in topics(capsys)["topics"] if each["chosen"]]
    assert taken["size"] > 30_000
    assert taken["bytes_per_day"] < 300 * 30 * DAY, "a record is a digest and a stamp"
