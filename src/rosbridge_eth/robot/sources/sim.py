"""A simulated robot for a machine without one: nav_msgs/Odometry and sensor_msgs/Imu, as ROS 1 writes them.

It drives a figure eight at a constant speed. The motion is a function of the time alone (`drive`); `SimSource` gives it
a pace.
"""

from __future__ import annotations

import math
import threading
from collections.abc import Iterator, Mapping, Sequence
from itertools import count
from typing import Any, NamedTuple

from rosbridge_eth.capture import Decoder, RawMessage, Restoration, Wire, decoder_for_known
from rosbridge_eth.robot.sources.protocol import Clock, Emit, Offer, Selection, Source

SPEED = 0.5
"""Metres per second along the path."""
RADIUS = 1.0
"""Metres; of each of the two circles."""
GRAVITY = 9.80665

ODOMETRY = "nav_msgs/msg/Odometry"
IMU = "sensor_msgs/msg/Imu"


class Motion(NamedTuple):
    """Where the robot is and how it turns: metres, radians in (-pi, pi], radians a second."""

    x: float
    y: float
    heading: float
    turn: float


def drive(seconds: float) -> Motion:
    """Where it is after so long: a circle to the left, one to the right, and again."""
    laps, lap = divmod(seconds * SPEED / (math.tau * RADIUS), 1)
    side, angle = (1, -1)[int(laps) % 2], lap * math.tau
    x, y = RADIUS * math.sin(angle), side * RADIUS * (1 - math.cos(angle))
    return Motion(x, y, math.remainder(side * angle, math.tau), side * SPEED / RADIUS)


class SimSource(Source):
    """The simulated robot as a source: `/NAME/odom` and `/NAME/imu`, published by the node `/NAME/sim`.

    rate: of odometry and of IMU messages, Hz. duration: ns; None is endless. speed: as of a bag.
    """

    kind = "sim"
    live = False

    def __init__(
        self, selection: Selection, clock: Clock | None = None, *,
        robot: str = "robot_1", rate: float = 10.0, duration: int | None = None,
        speed: float | None = 1.0,
    ) -> None:  # fmt: skip
        """Raises SourceError if the selection names what the robot does not have."""
        self._robot, self._rate, self._duration, self._speed = robot, rate, duration, speed
        self._clock = clock or Clock()
        nodes = (f"/{robot}/sim",)
        self._offers = (Offer(f"/{robot}/imu", IMU, nodes), Offer(f"/{robot}/odom", ODOMETRY, nodes))
        chosen = selection.resolve_all(self._offers, "the simulated robot")
        known = ((offer, decoder_for_known(Wire.ROS1, offer.type_name)) for offer in chosen)
        self._watched = [(offer, Restoration(decoder)) for offer, decoder in known if decoder is not None]

    def offers(self) -> Sequence[Offer]:
        """Odometry and IMU."""
        return self._offers

    def decoders(self) -> Mapping[str, Sequence[Decoder]]:
        """The decoders of each watched topic, to check a configuration beforehand."""
        return {offer.topic: [restoration.decoder] for offer, restoration in self._watched}

    def messages(self, start_ns: int) -> Iterator[RawMessage]:
        """The watched messages from a start time on, without waiting."""
        for tick in count():
            passed = round(tick * 1e9 / self._rate)
            if self._duration is not None and passed >= self._duration:
                return
            for offer, restoration in self._watched:
                data = _CONTENT[offer.type_name](self._robot, tick, start_ns + passed, drive(passed / 1e9))
                raw = restoration.decoder.encode(restoration.restore(data).message)
                yield RawMessage(offer.topic, offer.type_name, start_ns + passed, raw, restoration.decoder)

    def run(self, emit: Emit, stop: threading.Event) -> None:
        """Publish at the set speed until the duration is over or `stop` is set."""
        wall, monotonic = self._clock.wall_ns(), self._clock.monotonic_ns()
        for message in self.messages(wall):
            if self._speed is None:
                if stop.is_set():
                    return
            elif self._clock.wait_until(monotonic + round((message.received_ns - wall) / self._speed), stop):
                return
            emit(message)


def _odometry(robot: str, tick: int, stamp_ns: int, motion: Motion) -> dict[str, Any]:
    """Fields that are left out are zero."""
    position = {"x": motion.x, "y": motion.y}
    return {
        "header": {"seq": tick, "stamp": stamp_ns, "frame_id": f"{robot}/odom"},
        "child_frame_id": f"{robot}/base_link",
        "pose": {"pose": {"position": position, "orientation": _orientation(motion)}},
        "twist": {"twist": {"linear": {"x": SPEED}, "angular": {"z": motion.turn}}},
    }


def _imu(robot: str, tick: int, stamp_ns: int, motion: Motion) -> dict[str, Any]:
    return {
        "header": {"seq": tick, "stamp": stamp_ns, "frame_id": f"{robot}/imu"},
        "orientation": _orientation(motion),
        "angular_velocity": {"z": motion.turn},
        # Centripetal, and the table that holds it up.
        "linear_acceleration": {"y": SPEED * motion.turn, "z": GRAVITY},
    }


def _orientation(motion: Motion) -> dict[str, float]:
    return {"z": math.sin(motion.heading / 2), "w": math.cos(motion.heading / 2)}


_CONTENT = {ODOMETRY: _odometry, IMU: _imu}
