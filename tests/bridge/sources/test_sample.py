"""Facts of the sample bag, as `rosbag info` of the recorder printed them and as the robot was driven."""

from __future__ import annotations

import math
import subprocess
from itertools import pairwise
from pathlib import Path

import pytest
from rosbags.rosbag1 import Reader

from bridge.sources.values import value_at
from rosbridge_eth.capture import Capture, TopicRule, parse_line
from rosbridge_eth.robot.sources import BagSource, Offer, Selection, sample_bag


def records(topic: str):
    capture = Capture([TopicRule(topic)], source_kind=BagSource.kind)
    source = BagSource(sample_bag(), Selection([topic]))
    return [parse_line(capture.process(message, 0).line) for message in source.messages()]


def test_what_was_recorded():
    with Reader(sample_bag()) as reader:
        connections = {connection.topic: connection for connection in reader.connections}
        assert {topic: connection.msgcount for topic, connection in connections.items()} == {
            "/robot_1/odom": 300,
            "/robot_1/imu": 300,
        }
        # md5sums as genmsg computes them and rosmsg prints them.
        assert connections["/robot_1/odom"].digest == "cd5e73d190d741a2f92e81eda573aca7"
        assert connections["/robot_1/imu"].digest == "6a62c6daae103f4ff57a132d6f95cec2"
        assert 29.5 < (reader.end_time - reader.start_time) / 1e9 < 30.5
    assert sample_bag().stat().st_size < 100_000


def test_rosbag_itself_agrees(require):
    listing = subprocess.run(
        [require("rosbag"), "info", "--yaml", "--key=topics", sample_bag()], capture_output=True, text=True, check=True
    ).stdout
    assert listing.count("messages: 300") == 2
    assert "/robot_1/odom" in listing


def test_the_publisher_s_node_is_known():
    source = BagSource(sample_bag(), Selection(nodes=["/robot_1/base"]))
    assert source.offers() == (
        Offer("/robot_1/imu", "sensor_msgs/msg/Imu", ("/robot_1/base",)),
        Offer("/robot_1/odom", "nav_msgs/msg/Odometry", ("/robot_1/base",)),
    )
    assert len(list(source.messages())) == 600


def test_the_robot_drives_a_figure_eight():
    odometry = records("/robot_1/odom")
    assert len(odometry) == 300
    x = [value_at(record.data, "pose.pose.position.x") for record in odometry]
    y = [value_at(record.data, "pose.pose.position.y") for record in odometry]
    assert (min(y), max(y)) == (pytest.approx(-2.2, abs=0.1), pytest.approx(2.2, abs=0.1))
    headings = [
        2 * math.atan2(value_at(r.data, "pose.pose.orientation.z"), value_at(r.data, "pose.pose.orientation.w"))
        for r in odometry
    ]
    turned = [math.remainder(after - before, math.tau) for before, after in pairwise(headings)]
    assert sum(turn for turn in turned if turn > 0) == pytest.approx(math.tau, abs=0.3)
    assert sum(turn for turn in turned if turn < 0) == pytest.approx(-math.tau, abs=0.3)
    # What the wheels report is what the pose does: 10 Hz, so speed / 10 from one to the next.
    for index in range(20, 299):
        step = math.dist((x[index], y[index]), (x[index + 1], y[index + 1]))
        assert step == pytest.approx(value_at(odometry[index + 1].data, "twist.twist.linear.x") / 10, abs=1e-3)
    assert all(record.data["header"]["frame_id"] == "robot_1/odom" for record in odometry)
    assert all(abs(record.received_ns - record.data["header"]["stamp"]) < 50_000_000 for record in odometry)


def test_the_imu_feels_gravity_and_the_odometry_s_turns():
    imu, odometry = records("/robot_1/imu"), records("/robot_1/odom")
    gravity = [value_at(record.data, "linear_acceleration.z") for record in imu]
    assert sum(gravity) / len(gravity) == pytest.approx(9.81, abs=0.05)
    for felt, turned in list(zip(imu, odometry, strict=True))[20:]:
        turn = value_at(turned.data, "twist.twist.angular.z")
        assert value_at(felt.data, "angular_velocity.z") == pytest.approx(turn, abs=0.1)


def test_the_repository_links_to_the_packaged_bag():
    link = Path(__file__).parents[3] / "samples" / "robot_1.bag"
    assert link.read_bytes() == sample_bag().read_bytes()
