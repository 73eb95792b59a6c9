"""The simulated robot: kinematics that hold, a pace that follows the clock."""

from __future__ import annotations

import math
import threading
from itertools import pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bridge.sources.values import value_at
from rosbridge_eth.capture import Capture, TopicRule, parse_line
from rosbridge_eth.errors import SourceError
from rosbridge_eth.robot.sources import Selection, SimSource
from rosbridge_eth.robot.sources.sim import RADIUS, SPEED, drive

S = 10**9


class FakeClock:
    def __init__(self) -> None:
        self.now = 5 * S

    def wall_ns(self) -> int:
        return 1_700_000_000 * S + self.now

    def monotonic_ns(self) -> int:
        return self.now

    def wait_until(self, monotonic_ns: int, stop: threading.Event) -> bool:
        self.now = max(self.now, monotonic_ns)
        return stop.is_set()


LAP = math.tau * RADIUS / SPEED


@given(st.floats(0, 10 * LAP), st.floats(1e-6, 1e-3))
def test_speed_heading_and_turn_are_those_of_the_path(seconds, step):
    before, after = drive(seconds), drive(seconds + step)
    assert math.dist((before.x, before.y), (after.x, after.y)) == pytest.approx(SPEED * step, rel=1e-3, abs=1e-12)
    if before.turn == after.turn and math.dist(before, after) < 1:  # neither from circle to circle, nor from pi to -pi
        assert after.heading - before.heading == pytest.approx(before.turn * step, rel=1e-3, abs=1e-12)
        assert math.atan2(after.y - before.y, after.x - before.x) == pytest.approx(before.heading, abs=1e-2) or (
            abs(before.heading) > 3
        )


def test_the_drive_is_a_figure_eight():
    motions = [drive(tick / 50) for tick in range(round(2 * LAP * 50))]
    # One circle to the left of the start, one to the right, of two radii each.
    assert max(motion.y for motion in motions) == pytest.approx(2 * RADIUS, abs=1e-3)
    assert min(motion.y for motion in motions) == pytest.approx(-2 * RADIUS, abs=1e-3)
    assert drive(2 * LAP) == pytest.approx(drive(0), abs=1e-9)


def test_messages_are_odometry_and_imu_that_capture_understands():
    clock = FakeClock()
    source = SimSource(Selection(["**"]), clock, rate=10, duration=3 * S)
    emitted = []
    source.run(emitted.append, threading.Event())
    assert len(emitted) == 60
    capture = Capture([TopicRule("**")], source_kind=source.kind)
    records = [parse_line(capture.process(message, 0).line) for message in emitted]
    odometry = [record for record in records if record.topic == "/robot_1/odom"]
    assert [record.type_name for record in odometry] == ["nav_msgs/msg/Odometry"] * 30
    motions = [drive(tick / 10) for tick in range(30)]
    assert [value_at(record.data, "pose.pose.position.x") for record in odometry] == [motion.x for motion in motions]
    for record, motion in zip(odometry, motions, strict=True):
        assert value_at(record.data, "header.stamp") == record.received_ns
        orientation = value_at(record.data, "pose.pose.orientation")
        assert 2 * math.atan2(orientation["z"], orientation["w"]) == pytest.approx(motion.heading)
    # No reader can take it for the record of a robot.
    assert all(record.source == "sim" for record in records)
    imu = records[0]
    assert imu.type_name == "sensor_msgs/msg/Imu"
    assert value_at(imu.data, "linear_acceleration.z") == pytest.approx(9.80665)


@pytest.mark.parametrize(("speed", "passed"), [(1.0, 2.9), (10.0, 0.29), (None, 0)])
def test_the_pace(speed, passed):
    clock = FakeClock()
    source = SimSource(Selection(["/robot_1/odom"]), clock, rate=10, duration=3 * S, speed=speed)
    emitted = []
    source.run(emitted.append, threading.Event())
    assert (clock.now - 5 * S) / S == pytest.approx(passed)
    assert [b.received_ns - a.received_ns for a, b in pairwise(emitted)] == [S // 10] * 29


def test_it_stops_when_told_and_refuses_what_it_does_not_have():
    for speed in (1.0, None):
        stop, emitted = threading.Event(), []
        source = SimSource(Selection(nodes=["/robot_1/sim"]), FakeClock(), speed=speed)

        def emit(message, emitted=emitted, stop=stop):
            emitted.append(message)
            if len(emitted) == 5:
                stop.set()

        source.run(emit, stop)
        assert len(emitted) == 5
    with pytest.raises(SourceError, match="the simulated robot has no topic or node /robot_2/odom; did you mean"):
        SimSource(Selection(["/robot_2/odom"]))
    with pytest.raises(SourceError, match="/bot/odom"):
        SimSource(Selection(["/robot_1/odom"]), robot="bot")
