"""The simulated robot: kinematics that hold, the same drive for the same seed, a pace that follows the clock."""

from __future__ import annotations

import math
import threading
from itertools import islice, pairwise

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bridge.sources.values import value_at
from rosbridge_eth.capture import Capture, TopicRule, parse_line
from rosbridge_eth.errors import SourceError
from rosbridge_eth.robot.sources import Selection, SimSource
from rosbridge_eth.robot.sources.sim import RADIUS, SPEED, Motion, advance, drive

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


finite = st.floats(-3, 3)


@given(finite, finite.filter(lambda turn: abs(turn) > 0.01), st.floats(0.01, 2))
def test_an_arc_is_the_limit_of_small_steps(speed, turn, seconds):
    whole = advance(Motion(), speed, turn, seconds)
    parts = Motion()
    for _ in range(1000):
        parts = advance(parts, speed, turn, seconds / 1000)
    assert whole.x == pytest.approx(parts.x, abs=1e-5)
    assert whole.y == pytest.approx(parts.y, abs=1e-5)
    assert math.cos(whole.heading - parts.heading) == pytest.approx(1)
    # Never further than the path is long.
    assert math.hypot(whole.x, whole.y) <= abs(speed) * seconds + 1e-9


def test_a_full_turn_comes_back():
    motion = advance(Motion(x=1, y=2, heading=0.5), 2.0, math.tau, 1.0)
    assert (motion.x, motion.y) == (pytest.approx(1), pytest.approx(2))


def test_the_drive_is_a_figure_eight_and_depends_on_the_seed_alone():
    lap = math.tau * RADIUS / SPEED
    motions = list(islice(drive(7, 50.0), round(2 * lap * 50)))
    assert motions == list(islice(drive(7, 50.0), len(motions)))
    assert motions[1:] != list(islice(drive(8, 50.0), len(motions)))[1:]
    # One circle to the left of the start, one to the right, of two radii each.
    assert max(motion.y for motion in motions) == pytest.approx(2 * RADIUS, abs=0.2)
    assert min(motion.y for motion in motions) == pytest.approx(-2 * RADIUS, abs=0.2)
    for before, after in pairwise(motions):
        assert math.dist((before.x, before.y), (after.x, after.y)) <= after.speed / 50 + 1e-9


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
    motions = list(islice(drive(1, 10.0), 30))
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
