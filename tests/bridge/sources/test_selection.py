"""Topics and nodes against what a source offers; the kinds of source."""

from __future__ import annotations

import inspect
import threading

import pytest

from rosbridge_eth.config.models import SOURCE_KINDS, SimConfig
from rosbridge_eth.errors import SourceError
from rosbridge_eth.robot.sources import _KINDS, Offer, Selection, open_source

ODOM = Offer("/robot_1/odom", "nav_msgs/msg/Odometry", ("/robot_1/base",))
IMU = Offer("/robot_1/imu", "sensor_msgs/msg/Imu", ("/robot_1/base", "/robot_1/imu_driver"))
SCAN = Offer("/robot_2/scan", "sensor_msgs/msg/LaserScan", ("/robot_2/laser",))
OFFERS = (ODOM, IMU, SCAN)


@pytest.mark.parametrize(
    ("topics", "nodes", "chosen"),
    [
        (["/robot_1/odom"], [], [ODOM]),
        (["robot_1/odom"], [], [ODOM]),
        (["/robot_1/*"], [], [ODOM, IMU]),
        (["**"], [], [ODOM, IMU, SCAN]),
        ([], ["/robot_1/base"], [ODOM, IMU]),
        ([], ["/robot_1/imu_driver"], [IMU]),
        ([], ["/*/laser"], [SCAN]),
        (["/robot_1/odom"], ["/robot_2/*"], [ODOM, SCAN]),
        (["/nothing"], [], []),
        ([], [], []),
    ],
)
def test_topics_and_nodes_are_resolved(topics, nodes, chosen):
    assert list(Selection(topics, nodes).resolve(OFFERS)) == chosen


def test_what_means_nothing_is_known():
    selection = Selection(["/robot_1/odom", "/nope", "/no/*"], ["/nobody", "/robot_1/base"])
    assert selection.unmatched(OFFERS) == ("/nope", "/no/*", "/nobody")
    with pytest.raises(SourceError, match=r"here has no topic or node /nope, /nobody; .*/robot_1/odom"):
        selection.resolve_all(OFFERS, "here")


@pytest.mark.parametrize("kind", SOURCE_KINDS)
def test_every_key_of_a_table_is_taken_by_its_source(kind):
    parameters = inspect.signature(_KINDS[kind]).parameters
    assert SOURCE_KINDS[kind].model_fields.keys() - {"kind"} <= parameters.keys()


def test_what_the_table_says_is_opened():
    source = open_source(SimConfig(kind="sim", robot="bot", duration="1s", speed="max"), Selection(["**"]))
    received = []
    source.run(received.append, threading.Event())
    assert [raw.topic for raw in received] == ["/bot/imu", "/bot/odom"] * 10
