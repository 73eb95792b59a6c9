"""The whole robot, started as on a machine with ROS 2: its command, run by the Python that has rclpy."""

from __future__ import annotations

import json
import re
import signal
import socket
from pathlib import Path
from urllib.request import urlopen

import pytest

from bridge.lone_robot import chunks_of, command, lines_of, lone_robot
from bridge.sources.ros2.graph import Graph
from bridge.terminal import Terminal
from rosbridge_eth.config import load_robot_config
from rosbridge_eth.config.home import RobotHome
from rosbridge_eth.errors import ExitCode

pytestmark = pytest.mark.service


@pytest.fixture
def robot(tmp_path: Path) -> RobotHome:
    return lone_robot(tmp_path)


def test_a_robot_with_hardly_a_configuration_records_its_ros_2(ros: Graph, robot: RobotHome, tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
    robot.config.write_text(f'topics = ["/robot_1/odom"]\nmonitor = "127.0.0.1:{port}"')
    node = ros.node("/robot_1/base")
    node.order(create="/robot_1/odom", type="nav_msgs/msg/Odometry", depth=100)
    process = ros.program(command(robot), ROS_VERSION="2", ROS_DISTRO="kilted")
    process.says("Messages come from the live ROS 2 graph (ROS_VERSION is 2).")
    process.says("sends to server at 127.0.0.1:9")
    node.order(**{"await": "/robot_1/odom"})
    node.order(burst="/robot_1/odom", count=100, rate=100)
    metrics = f"http://127.0.0.1:{port}/metrics"
    process.until(lambda: re.search(r"captured\S* 100\b", urlopen(metrics).read().decode()), "capturing everything")
    assert process.finish(signal.SIGTERM) == 0
    process.says("100 records captured in ")
    lines = lines_of(chunks_of(robot))
    assert lines[0]["stream"]["source"] == "ros2"
    assert (lines[1]["type"], lines[1]["wire"], lines[1]["format"]) == ("nav_msgs/msg/Odometry", "cdr", "msg")
    assert [line["topic"] for line in lines[2:]] == ["/robot_1/odom"] * 100


def test_a_robot_without_rclpy_says_what_to_do(robot: RobotHome, ros: Graph, tmp_path):
    robot.config.write_text('topics = ["/odom"]\n[source]\nkind = "ros2"\n')
    hidden = tmp_path / "hidden"
    hidden.mkdir()
    (hidden / "rclpy.py").write_text("raise ModuleNotFoundError(\"No module named 'rclpy'\", name='rclpy')")
    path = f"{hidden}:{ros.environment['PYTHONPATH']}"
    process = ros.program(command(robot), PYTHONPATH=path)
    assert process.finish() == 8
    told = " ".join("\n".join(process.errors).split())
    assert (
        "a ROS 2 source needs rclpy (No module named 'rclpy'); start the robot in an environment where" in told
    )
    assert "Traceback" not in told


def test_topics_and_join_show_the_live_graph(ros: Graph, python: str, tmp_path: Path):
    node = ros.node("/robot_1/base")
    node.order(create="/robot_1/odom", type="nav_msgs/msg/Odometry", depth=100)
    node.order(create="/status", type="std_msgs/msg/String", depth=10)
    here = {name: text for name, text in ros.environment.items() if name.startswith("ROS_")}
    listing = ros.program(["-m", "rosbridge_eth", "topics", "--source", "ros2", "--seconds", "3", "--json"])
    node.order(**{"await": "/robot_1/odom"})
    node.order(burst="/robot_1/odom", count=20, rate=50)
    assert listing.finish() == 0, listing.errors
    found = {each["topic"]: each for each in json.loads(listing.lines[0])["topics"]}
    odom = found["/robot_1/odom"]
    assert (odom["type"], odom["nodes"], odom["messages"]) == ("nav_msgs/msg/Odometry", ["/robot_1/base"], 20)
    assert odom["rate"] == pytest.approx(50, rel=0.5) and found["/status"]["messages"] == 0
    (tmp_path / "word").write_text("word")
    with Terminal(tmp_path, "join", "--password-file", "word", python=python, **here) as join:
        join.answer("Name of this robot", "")
        join.answer("Messages come from", "ros2")
        numbers = dict(re.findall(r"(\d+) [^\w/]*(/\S+)", join.until("Which, by number, name or pattern")))
        [status] = [number for number, topic in numbers.items() if topic == "/status"]
        join.type("99")
        join.until("There is no number 99.")
        join.answer("Which, by number, name or pattern", f"{status} /robot_1/*")
        join.until("rosbridge-eth register robot_1 robot/request.json")
        assert join.end() == 0
    config = load_robot_config(tmp_path / "robot" / "robot.toml")
    assert [topic.topic for topic in config.topics] == ["/status", "/robot_1/*"]
    assert config.source is not None and config.source.kind == "ros2"


def test_a_graph_without_topics_is_no_choice(ros: Graph, python: str, tmp_path: Path):
    (tmp_path / "word").write_text("word")
    here = {name: text for name, text in ros.environment.items() if name.startswith("ROS_")}
    with Terminal(tmp_path, "join", "--password-file", "word", "--source", "ros2", python=python, **here) as join:
        join.answer("Name of this robot", "")
        join.until("ros2 offers no topics now: name them with --topic")
        assert join.end() == ExitCode.CONFIG
    assert not (tmp_path / "robot").exists()
