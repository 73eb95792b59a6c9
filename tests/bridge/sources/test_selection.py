"""Topics and nodes against what a source offers; the kinds of source."""

from __future__ import annotations

import sys
import types
from dataclasses import dataclass
from typing import ClassVar

import pytest

from rosbridge_eth.errors import SourceError
from rosbridge_eth.sources import KINDS, Offer, Selection, SimSettings, SimSource, open_source

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


@dataclass(frozen=True)
class OtherSettings:
    kind: ClassVar[str] = "other"


def test_kinds_are_found_by_name_and_may_be_added(monkeypatch):
    assert isinstance(open_source(SimSettings(), Selection(["**"])), SimSource)
    with pytest.raises(SourceError, match="no source of kind 'other'; there are bag, ros1, ros2, sim"):
        open_source(OtherSettings(), Selection(["**"]))
    monkeypatch.setitem(KINDS, "other", "a_module_of_nobody:Source")
    with pytest.raises(SourceError, match="needs a_module_of_nobody, which is not installed"):
        open_source(OtherSettings(), Selection(["**"]))
    module = types.ModuleType("a_module_of_nobody")
    module.Source = lambda settings, selection, clock: (settings, selection, clock)
    monkeypatch.setitem(sys.modules, "a_module_of_nobody", module)
    assert open_source(OtherSettings(), Selection())[0] == OtherSettings()
