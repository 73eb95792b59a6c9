"""Capture: from the raw bytes of a message, out of the sample bag, to a line of the log, and a line read back.

The peer is the obvious way with the same library: rosbags' deserialisation,
`dataclasses.asdict` and `json.dumps`, without checks, rules or selection.
"""

from __future__ import annotations

import dataclasses
import json
import threading
from typing import Any

import numpy
import orjson
import pytest

from rosbridge_eth.capture import (
    Capture,
    Conversion,
    RawMessage,
    Restoration,
    TopicRule,
    Wire,
    decoder_for_known,
    definition_line,
    parse_line,
)
from rosbridge_eth.robot.sources import BagSource, Selection, sample_bag


def messages(topic: str) -> list[RawMessage]:
    source = BagSource(sample_bag(), Selection([topic]))
    return list(source.messages())


def scan(readings: int) -> list[RawMessage]:
    """A laser's message, of which the sample bag has none."""
    name = "sensor_msgs/msg/LaserScan"
    decoder = decoder_for_known(Wire.ROS1, name)
    if decoder is None:
        pytest.skip("this rosbags does not know LaserScan")
    types = decoder.typestore.types
    header = types["std_msgs/msg/Header"](1, types["builtin_interfaces/msg/Time"](1, 2), "laser")
    ranges = numpy.linspace(0.1, 30, readings, dtype=numpy.float32)
    message = types[name](header, -3.14, 3.14, 0.01, 0.0, 0.1, 0.1, 30.0, ranges, ranges)
    return [RawMessage("/scan", name, 0, decoder.encode(message), decoder)]


def run(benchmark: Any, implementation: str, function: Any, inputs: list[RawMessage]) -> None:
    """Time one message, on average over all of them."""
    benchmark.extra_info["implementation"] = implementation
    benchmark.extra_info["messages"] = len(inputs)

    def all_of_them() -> None:
        for message in inputs:
            function(message)

    function(inputs[0])
    benchmark(all_of_them)
    benchmark.extra_info["microseconds per message"] = round(benchmark.stats["mean"] / len(inputs) * 1e6, 2)


def captured(rule: TopicRule) -> Any:
    capture = Capture([rule], source_kind="bag")
    return lambda message: capture.process(message, 1).line  # type: ignore[union-attr]


def the_obvious_way(message: RawMessage) -> str:
    decoded = message.decoder.typestore.deserialize_ros1(message.raw, message.type_name)
    return json.dumps(dataclasses.asdict(decoded), default=lambda array: array.tolist())  # type: ignore[call-overload]


POSE_AND_TWIST = ("header.stamp", "header.frame_id", "child_frame_id", "pose.pose", "twist.twist")


@pytest.mark.benchmark(group="capture Odometry")
def test_odometry_pose_and_twist(benchmark: Any) -> None:
    rule = TopicRule("**", fields=POSE_AND_TWIST)
    run(benchmark, "rosbridge_eth, pose and twist", captured(rule), messages("/robot_1/odom"))


@pytest.mark.benchmark(group="capture Odometry")
def test_odometry_every_field(benchmark: Any) -> None:
    run(benchmark, "rosbridge_eth, every field", captured(TopicRule("**")), messages("/robot_1/odom"))


@pytest.mark.benchmark(group="capture Odometry")
def test_odometry_the_obvious_way(benchmark: Any) -> None:
    run(benchmark, "rosbags, asdict, json", the_obvious_way, messages("/robot_1/odom"))


@pytest.mark.benchmark(group="capture Odometry")
def test_odometry_decoding_alone(benchmark: Any) -> None:
    run(benchmark, "rosbags, decoding alone", lambda m: m.decoder.decode(m.raw), messages("/robot_1/odom"))


@pytest.mark.benchmark(group="capture Odometry")
def test_odometry_choosing_and_writing_alone(benchmark: Any) -> None:
    inputs = messages("/robot_1/odom")
    capture = captured(TopicRule("**"))
    decoded = {message.raw: message.decoder.decode(message.raw) for message in inputs}
    lines: dict[bytes, Any] = {message.raw: parse_line(capture(message)) for message in inputs}
    conversion = Conversion(inputs[0].decoder)

    def write(message: RawMessage) -> bytes:
        data = conversion.convert(decoded[message.raw])
        return orjson.dumps({"topic": message.topic, "data": data})

    assert all(lines[message.raw].data == orjson.loads(write(message))["data"] for message in inputs)
    run(benchmark, "rosbridge_eth, without decoding", write, inputs)


@pytest.mark.benchmark(group="read Odometry")
def test_odometry_parsed(benchmark: Any) -> None:
    capture = captured(TopicRule("**"))
    lines = {message.raw: capture(message) for message in messages("/robot_1/odom")}
    run(benchmark, "rosbridge_eth, checked", lambda m: parse_line(lines[m.raw]), messages("/robot_1/odom"))


@pytest.mark.benchmark(group="read Odometry")
def test_odometry_parsed_by_json(benchmark: Any) -> None:
    capture = captured(TopicRule("**"))
    lines = {message.raw: capture(message) for message in messages("/robot_1/odom")}
    run(benchmark, "json, unchecked", lambda m: json.loads(lines[m.raw]), messages("/robot_1/odom"))


@pytest.mark.benchmark(group="read Odometry")
def test_odometry_restored(benchmark: Any) -> None:
    capture, inputs = captured(TopicRule("**")), messages("/robot_1/odom")
    lines: dict[bytes, Any] = {message.raw: parse_line(capture(message)) for message in inputs}
    definition: Any = parse_line(definition_line(inputs[0].decoder))
    restoration = Restoration(definition.decoder())
    run(benchmark, "rosbridge_eth, to ROS bytes", lambda m: restoration.decoder.encode(
        restoration.restore(lines[m.raw].data).message), inputs)  # fmt: skip


@pytest.mark.benchmark(group="capture Imu")
def test_imu(benchmark: Any) -> None:
    run(benchmark, "rosbridge_eth, every field", captured(TopicRule("**")), messages("/robot_1/imu"))


@pytest.mark.benchmark(group="capture Imu")
def test_imu_the_obvious_way(benchmark: Any) -> None:
    run(benchmark, "rosbags, asdict, json", the_obvious_way, messages("/robot_1/imu"))


@pytest.mark.benchmark(group="capture LaserScan of 720 readings")
def test_scan_as_digests(benchmark: Any) -> None:
    run(benchmark, "rosbridge_eth, digests", captured(TopicRule("**", limit=1024)), scan(720))


@pytest.mark.benchmark(group="capture LaserScan of 720 readings")
def test_scan_one_reading(benchmark: Any) -> None:
    run(benchmark, "rosbridge_eth, ranges[0]", captured(TopicRule("**", fields=("ranges[0]",))), scan(720))


@pytest.mark.benchmark(group="capture LaserScan of 720 readings")
def test_scan_in_full(benchmark: Any) -> None:
    run(benchmark, "rosbridge_eth, in full", captured(TopicRule("**")), scan(720))


@pytest.mark.benchmark(group="capture LaserScan of 720 readings")
def test_scan_the_obvious_way(benchmark: Any) -> None:
    run(benchmark, "rosbags, asdict, json", the_obvious_way, scan(720))


@pytest.mark.benchmark(group="replay of the sample bag, 600 messages")
def test_replay_and_capture(benchmark: Any) -> None:
    """Open the bag, check its definitions, read, decode, capture."""

    def replay() -> int:
        source = BagSource(sample_bag(), Selection(["**"]), speed=None)
        capture = Capture([TopicRule("**")], source_kind=source.kind)
        records: list[bytes] = []
        source.run(lambda message: records.append(capture.process(message, 1).line), threading.Event())  # type: ignore[union-attr]
        source.close()
        return len(records)

    benchmark.extra_info["implementation"] = "rosbridge_eth"
    assert benchmark(replay) == 600
