"""The whole robot, started as on a machine with ROS 2: its command, run by the Python that has rclpy."""

from __future__ import annotations

import re
import signal
import socket
from datetime import UTC, datetime
from pathlib import Path
from urllib.request import urlopen

import pytest

from bridge.sources.ros2.graph import Graph
from rosbridge_eth.bundle import open_bundle
from rosbridge_eth.home import OperatorHome, RobotHome
from rosbridge_eth.ledger.accounts import Keyring
from rosbridge_eth.ledger.embedded import EmbeddedChain
from rosbridge_eth.records import robot_id
from rosbridge_eth.robot.assembly import join
from rosbridge_eth.server.administration import deploy_contract, init_home, load_ca, register_robot
from rosbridge_eth.store import Spool, SpoolLimits

pytestmark = pytest.mark.service
PASSPHRASE, PASSWORD = b"operator's", b"robot's"


@pytest.fixture
def robot(tmp_path: Path) -> RobotHome:
    """The home of a registered robot, whose server is not there."""
    home, robot, now = OperatorHome(tmp_path / "operator"), RobotHome(tmp_path / "robot"), datetime.now(UTC)
    init_home(
        home, PASSPHRASE, listen="127.0.0.1:9", public=None, chain_url="http://127.0.0.1:9", server="server", now=now
    )
    keys = Keyring.load(home.accounts, PASSPHRASE)
    chain = EmbeddedChain(fund={keys.operator.address: 10**21})
    deploy_contract(home, chain, keys)
    registered = register_robot(
        home, "robot_1", ca=load_ca(home, PASSPHRASE), keys=keys, chain=chain, password=PASSWORD, now=now
    )
    join(robot, open_bundle(registered.bundle.read_bytes(), PASSWORD), PASSWORD)
    return robot


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
    node.order(**{"await": "/robot_1/odom"})
    node.order(burst="/robot_1/odom", count=100, rate=100)
    metrics = f"http://127.0.0.1:{port}/metrics"
    process.until(lambda: re.search(r"captured\S* 100", urlopen(metrics).read().decode()), "capturing everything")
    assert process.finish(signal.SIGTERM) == 0
    process.says("100 captured, 0 stored by the server, ")
    spool = Spool(robot.spool, robot_id("robot_1"), SpoolLimits())
    assert spool.statistics.records == 100
    spool.close()


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
