"""Topics and nodes against what a source offers, once and over time; the registry of kinds."""

from __future__ import annotations

import sys
import types
from dataclasses import dataclass
from typing import ClassVar

import pytest

from rosbridge_eth.errors import SourceError
from rosbridge_eth.sources import KINDS, Offer, Selection, SimSettings, SimSource, Watch, open_source, register_kind

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


def test_a_watch_follows_topics_as_they_come_and_go():
    watch = Watch(Selection(["/*/odom"], ["/robot_1/*"]), every=3.0)
    assert watch.next_timer() is None, "resolve at once"
    changes = watch.update([SCAN], now=10.0)
    assert (changes.added, changes.removed, watch.next_timer()) == ((), (), 13.0)
    changes = watch.update([ODOM, IMU, SCAN], now=13.0)
    assert (changes.added, changes.removed) == ((ODOM, IMU), ())
    assert watch.update([IMU, ODOM], now=16.0).added == ()
    # Another publisher of the same topic is no change; another type is.
    more = Offer(ODOM.topic, ODOM.type_name, ("/robot_1/base", "/robot_1/ekf"))
    assert watch.update([IMU, more], now=19.0) == watch.update([IMU, more], now=19.0)
    other = Offer(ODOM.topic, "my_pkg/msg/Odometry", ODOM.nodes)
    changes = watch.update([IMU, other], now=22.0)
    assert (changes.added, changes.removed) == ((other,), (more,))
    watch.failed(now=25.0)
    assert (watch.next_timer(), len(watch.watched)) == (28.0, 2)
    changes = watch.update([], now=28.0)
    assert (changes.added, set(changes.removed)) == ((), {IMU, other})


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
    register_kind("other", "a_module_of_nobody:Source")
    assert open_source(OtherSettings(), Selection())[0] == OtherSettings()
    with pytest.raises(ValueError, match="already registered"):
        register_kind("other", "another:Source")
