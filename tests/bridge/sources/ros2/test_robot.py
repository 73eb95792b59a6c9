"""The whole robot, started as on a machine with ROS 2: its command, run by the Python that has rclpy."""

from __future__ import annotations

import re
import signal
import socket
from datetime import UTC, datetime
from functools import partial
from pathlib import Path
from urllib.request import urlopen

import pytest

from bridge.sources.ros2.graph import Graph
from rosbridge_eth import identity as ids
from rosbridge_eth.bundle import Bundle, ask_to_join, join
from rosbridge_eth.chunk import Log, content_key, drop, open_lines, robot_id
from rosbridge_eth.home import BridgeEnd, RobotHome
from rosbridge_eth.spool import Spool

pytestmark = pytest.mark.service
PASSWORD = b"robot's"
END = BridgeEnd("robot_1", "server", "127.0.0.1:9", 31337, "0x" + "11" * 32, "0x" + "22" * 20)
NOW = datetime.now(UTC)
CA = ids.create_ca("CA", at=NOW)
READER = ids.enrol(CA, ids.Role.READER, "owner", at=NOW)


@pytest.fixture
def robot(tmp_path: Path) -> RobotHome:
    """The home of a registered robot, whose server is not there."""
    home = RobotHome(tmp_path / "robot")
    request = ask_to_join(home, END.robot, PASSWORD)
    peer = ids.enrol_requests(CA, ids.Role.ROBOT, END.robot, request.signing, request.encryption, at=NOW)
    certificates = {name: text.decode() for name, text in ids.certificate_files(peer, [CA.certificate]).items()}
    join(home, Bundle(END, certificates, {"owner": READER.public.pem.decode()}))
    return home


def test_a_robot_with_hardly_a_configuration_records_its_ros_2(ros: Graph, robot: RobotHome, tmp_path):
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
    robot.config.write_text(f'topics = ["/robot_1/odom"]\nmonitor = "127.0.0.1:{port}"')
    word = tmp_path / "word"
    word.write_bytes(PASSWORD)
    node = ros.node("/robot_1/base")
    node.order(create="/robot_1/odom", type="nav_msgs/msg/Odometry", depth=100)
    command = ["-m", "rosbridge_eth", "robot", "--home", str(robot.path), "--password-file", str(word)]
    process = ros.program(command, ROS_VERSION="2", ROS_DISTRO="kilted")
    process.says("Messages come from the live ROS 2 graph (ROS_VERSION is 2).")
    process.says("sends to server at 127.0.0.1:9")
    node.order(**{"await": "/robot_1/odom"})
    node.order(burst="/robot_1/odom", count=100, rate=100)
    metrics = f"http://127.0.0.1:{port}/metrics"
    process.until(lambda: re.search(r"captured\S* 100\b", urlopen(metrics).read().decode()), "capturing everything")
    assert process.finish(signal.SIGTERM) == 0
    process.says("100 records captured in ")
    log = Log(END.ledger, robot_id(END.robot))
    spool = Spool(robot.spool, log, max_bytes=1 << 30, drop=partial(drop, log, READER.signing_key))
    stream, _, _ = spool.first_unconfirmed()
    chunks = spool.following(stream, None, 1 << 24)
    lines = [
        line
        for chunk in chunks
        if chunk.header.records  # the last may only say goodbye
        for line in open_lines(log, chunk, content_key(chunk.header, READER.encryption_key))
    ]
    spool.close()
    assert lines[0].startswith(b'{"stream":{"source":"ros2"')
    assert lines[1].startswith(b'{"type":"nav_msgs/msg/Odometry","wire":"cdr","format":"msg"')
    assert sum(line.startswith(b'{"topic":"/robot_1/odom"') for line in lines[2:]) == 100 == len(lines) - 2


def test_a_robot_without_rclpy_says_what_to_do(robot: RobotHome, ros: Graph, tmp_path):
    robot.config.write_text('topics = ["/odom"]\n[source]\nkind = "ros2"\n')
    word = tmp_path / "word"
    word.write_bytes(PASSWORD)
    hidden = tmp_path / "hidden"
    hidden.mkdir()
    (hidden / "rclpy.py").write_text("raise ModuleNotFoundError(\"No module named 'rclpy'\", name='rclpy')")
    command = ["-m", "rosbridge_eth", "robot", "--home", str(robot.path), "--password-file", str(word)]
    path = f"{hidden}:{ros.environment['PYTHONPATH']}"
    process = ros.program(command, PYTHONPATH=path)
    assert process.finish() == 8
    told = " ".join("\n".join(process.errors).split())
    assert (
        "a ROS 2 source needs rclpy, which this Python does not have; start the robot in an environment where" in told
    )
    assert "Traceback" not in told
