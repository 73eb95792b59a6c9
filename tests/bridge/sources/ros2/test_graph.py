"""The ros2 source against genuine nodes: types, qualities of service, nodes that come, go and die."""

from __future__ import annotations

import itertools
import json
import os
from collections import Counter
from pathlib import Path

import pytest
from rosbags.rosbag1 import Reader
from rosbags.typesys import Stores, get_typestore

from bridge.sources.ros2.graph import Graph
from rosbridge_eth.capture import Capture, TopicRule, parse_line
from rosbridge_eth.robot.sources import BagSource, Selection, sample_bag
from smcrypto import sm3

pytestmark = pytest.mark.service
STRING, NUMBER, ODOMETRY = "std_msgs/msg/String", "std_msgs/msg/UInt32", "nav_msgs/msg/Odometry"


def data_of(records, topic):
    return [record["data"] for record in records if record["topic"] == topic]


MESSAGES = {
    # topic: type, fields as published, record's data
    "/said": (STRING, {"data": "零 é 😀"}, {"data": "零 é 😀"}),
    "/joints": (
        "sensor_msgs/msg/JointState",
        {"header": {"stamp": {"sec": 5, "nanosec": 7}, "frame_id": "arm"}, "name": ["a"], "position": [1.5]},
        {
            "header": {"stamp": 5_000_000_007, "frame_id": "arm"},
            "name": ["a"], "position": [1.5], "velocity": [], "effort": [],
        },
    ),
    "/scan": (
        "sensor_msgs/msg/LaserScan",
        {"angle_min": -0.5, "ranges": [1.0, float("inf"), float("nan")]},
        {
            "header": {"stamp": 0, "frame_id": ""}, "angle_min": -0.5, "angle_max": 0.0, "angle_increment": 0.0,
            "time_increment": 0.0, "scan_time": 0.0, "range_min": 0.0, "range_max": 0.0,
            "ranges": [1.0, "Infinity", "NaN"], "intensities": [],
        },
    ),
    "/image": (
        "sensor_msgs/msg/CompressedImage",
        {"format": "jpeg", "data": {"bytes": [255, 0, 1]}},
        {"header": {"stamp": 0, "frame_id": ""}, "format": "jpeg", "data": "/wAB"},
    ),
    # From here on types of a package that nobody but the robot's own ROS knows.
    "/own/strings": (
        "test_msgs/msg/Strings",
        {"string_value": "x", "bounded_string_value": "y"},
        {
            "string_value": "x", "string_value_default1": "Hello world!", "string_value_default2": "Hello'world!",
            "string_value_default3": 'Hello"world!', "string_value_default4": "Hello'world!",
            "string_value_default5": 'Hello"world!', "bounded_string_value": "y",
            "bounded_string_value_default1": "Hello world!", "bounded_string_value_default2": "Hello'world!",
            "bounded_string_value_default3": 'Hello"world!', "bounded_string_value_default4": "Hello'world!",
            "bounded_string_value_default5": 'Hello"world!',
        },
    ),
    "/own/nested": (
        "test_msgs/msg/Nested",
        {
            "basic_types_value": {
                "bool_value": True, "byte_value": {"bytes": [200]}, "char_value": 65, "int64_value": -(2**63),
            }
        },
        {
            "basic_types_value": {
                "bool_value": True, "byte_value": 200, "char_value": 65, "float32_value": 0.0, "float64_value": 0.0,
                "int8_value": 0, "uint8_value": 0, "int16_value": 0, "uint16_value": 0, "int32_value": 0,
                "uint32_value": 0, "int64_value": -(2**63), "uint64_value": 0,
            }
        },
    ),
    "/own/empty": ("test_msgs/msg/Empty", {}, {}),
    "/own/times": (
        "test_msgs/msg/Builtins",
        {"duration_value": {"sec": -2, "nanosec": 500_000_000}, "time_value": {"sec": 1, "nanosec": 2}},
        {"duration_value": -1_500_000_000, "time_value": 1_000_000_002},
    ),
}  # fmt: skip


def test_messages_of_any_type_become_records(ros: Graph):
    known = get_typestore(Stores.ROS2_KILTED).fielddefs
    assert not any(kind in known for topic, (kind, *_) in MESSAGES.items() if topic.startswith("/own/"))
    node = ros.node("/robot_1/base")
    for topic, (kind, fields, _) in MESSAGES.items():
        node.order(create=topic, type=kind, latched=True)
        node.order(publish=topic, fields=fields)
    watcher = ros.watcher('topics = ["/**"]')
    records = watcher.recorded(len(MESSAGES))
    assert watcher.rebuilt == [True] * len(MESSAGES)
    assert {record["topic"]: record["type"] for record in records} == {
        topic: kind for topic, (kind, *_) in MESSAGES.items()
    }
    assert {record["topic"]: record["data"] for record in records} == {
        topic: data for topic, (*_, data) in MESSAGES.items()
    }


def test_the_same_odometry_gives_the_same_record_from_ros_1_and_ros_2(ros: Graph):
    """The sample bag was recorded by ROS 1; its Odometry is published again by ROS 2."""
    source = BagSource(sample_bag(), Selection(["/robot_1/odom"]), speed=None)
    capture = Capture([TopicRule("/robot_1/odom")], source_kind=source.kind)
    from_ros1 = [parse_line(capture.process(raw, 0).line).data for raw in itertools.islice(source.messages(), 20)]
    for data in from_ros1:
        del data["header"]["seq"]  # which only ROS 1 has
    node = ros.node("/base")
    node.order(create="/robot_1/odom", type=ODOMETRY, latched=True, depth=20)
    store = get_typestore(Stores.ROS1_NOETIC)
    with Reader(sample_bag()) as bag:
        chosen = [connection for connection in bag.connections if connection.topic == "/robot_1/odom"]
        for connection, _, raw in itertools.islice(bag.messages(chosen), 20):
            node.order(publish="/robot_1/odom", fields=as_ros2(store.deserialize_ros1(raw, connection.msgtype)))
    records = ros.watcher('topics = ["/robot_1/odom"]').recorded(20)
    assert [(record["type"], record["source"]) for record in records] == [(ODOMETRY, "ros2")] * 20
    # As text, so that the order counts.
    assert [json.dumps(record["data"]) for record in records] == list(map(json.dumps, from_ros1))


def as_ros2(message):
    """The fields of a rosbags message, without the header's `seq`, which ROS 2 does not have."""
    fields = {}
    for name in message.__dataclass_fields__.keys() - {"seq", "__msgtype__"}:
        value = getattr(message, name)
        if hasattr(value, "__dataclass_fields__"):
            value = as_ros2(value)
        fields[name] = value.tolist() if hasattr(value, "tolist") else value
    return fields


@pytest.mark.parametrize("reliable", [True, False], ids=["reliable", "best effort"])
@pytest.mark.parametrize("latched", [True, False], ids=["transient local", "volatile"])
def test_whatever_quality_is_offered_is_matched(ros: Graph, reliable, latched):
    node = ros.node("/base")
    node.order(create="/t", type=STRING, reliable=reliable, latched=latched, depth=1)
    node.order(publish="/t", fields={"data": "before"})
    watcher = ros.watcher('topics = ["/t"]')
    watcher.says(f"watched ({STRING})")
    if latched and reliable:
        assert data_of(watcher.recorded(1), "/t") == [{"data": "before"}]
    node.order(**{"await": "/t"})
    node.order(publish="/t", fields={"data": "after"})
    watcher.until(lambda: {"data": "after"} in data_of(watcher.records, "/t"), "the message")
    assert watcher.stop()["/t"]["lost"] == 0


def test_publishers_of_one_topic_may_differ_and_change(ros: Graph):
    """One that offers less comes and goes, and all are heard; nothing is repeated."""
    first, second = ros.node("/first"), ros.node("/second")
    first.order(create="/t", type=STRING, latched=True, depth=1)
    first.order(publish="/t", fields={"data": "latched"})
    watcher = ros.watcher('topics = ["/t"]')
    watcher.recorded(1)
    second.order(create="/t", type=STRING, reliable=False)
    watcher.says("watched again")
    for node in (first, second):
        node.order(**{"await": "/t"})
    second.order(publish="/t", fields={"data": "second"})
    first.order(publish="/t", fields={"data": "both"})
    watcher.recorded(3)
    second.order(destroy="/t")
    first.order(publish="/t", fields={"data": "alone"})
    watcher.recorded(4)
    watcher.stop()
    said = [data["data"] for data in data_of(watcher.records, "/t")]
    assert [word for word in said if word != "second"] == ["latched", "both", "alone"]


def test_a_topic_may_appear_late_and_the_domain_may_be_configured(ros: Graph):
    elsewhere = str(ros.domain % 90 + 1)
    watcher = ros.watcher(
        f'topics = ["/late/*", "/never"]\n[source]\nkind = "ros2"\ndomain = {ros.domain}', ROS_DOMAIN_ID=elsewhere
    )
    for name in ("/late/*", "/never"):
        watcher.says(f"nothing publishes {name} yet")
    node = ros.node("/base")
    for topic in ("/late/a", "/late/b", "/other"):
        node.order(create=topic, type=NUMBER)
    for topic in ("/late/a", "/late/b"):
        node.order(**{"await": topic})
    node.order(burst=["/late/a", "/late/b", "/other"], count=50)
    records = watcher.recorded(100)
    for topic in ("/late/a", "/late/b"):
        assert [data["data"] for data in data_of(records, topic)] == list(range(50))
    assert set(watcher.stop()) == {"/late/a", "/late/b"}


def test_a_publisher_that_is_killed_is_heard_again_from_its_first_message(ros: Graph):
    watcher = ros.watcher('topics = ["/t"]')
    for start in range(3):
        node = ros.node("/base")
        node.order(create="/t", type=NUMBER)
        node.order(**{"await": "/t"})
        node.order(burst="/t", count=20)
        watcher.recorded(20 * (start + 1))
        node.kill()
    assert [data["data"] for data in data_of(watcher.records, "/t")] == [*range(20)] * 3
    assert sum("watched" in line for line in watcher.errors) == 1


def test_a_node_stands_for_what_it_publishes(ros: Graph):
    arm, base = ros.node("/robot_1/arm"), ros.node("/robot_1/base")
    arm.order(create="/joints", type=STRING, latched=True)
    arm.order(create="/shared", type=STRING, latched=True)
    base.order(create="/odom", type=STRING, latched=True)
    base.order(create="/shared", type=STRING, latched=True)
    arm.order(create="/_hidden", type=STRING, latched=True)
    for node, topic in ((arm, "/joints"), (arm, "/shared"), (base, "/odom"), (base, "/shared"), (arm, "/_hidden")):
        node.order(publish=topic, fields={"data": "x"})
    watcher = ros.watcher('topics = []\nnodes = ["/robot_1/arm"]')
    watcher.recorded(3)
    arm.order(create="/joints/late", type=STRING)
    arm.order(**{"await": "/joints/late"})
    arm.order(publish="/joints/late", fields={"data": "x"})
    watcher.recorded(4)
    watcher.stop()
    counts = Counter(record["topic"] for record in watcher.records)
    assert counts == {"/joints": 1, "/shared": 2, "/joints/late": 1}


RELOADED = """
import logging, queue, threading
from rosbridge_eth.robot.sources import Selection
from rosbridge_eth.robot.sources.ros2 import source as ros2

told = queue.SimpleQueue()
handler = logging.Handler(logging.WARNING)
handler.emit = lambda record: told.put(record.getMessage())
logging.getLogger().addHandler(handler)
ros2.UNMATCHED_AFTER = 0.1
stop, source = threading.Event(), ros2.Ros2Source(Selection(["/first"]))
running = threading.Thread(target=source.run, args=(print, stop), daemon=True)
running.start()
print(told.get(timeout=20))
source.watch(Selection(["/second"]))
print(told.get(timeout=20))
stop.set()
running.join()
source.close()
"""


def test_a_name_that_nobody_publishes_is_said_after_every_change_of_the_topics(ros: Graph):
    """As `robot` changes them at a reload."""
    first, second = ros.run(RELOADED).splitlines()
    assert first.startswith("nothing publishes /first yet; domain")
    assert second.startswith("nothing publishes /second yet; domain")


def test_ten_topics_at_100_hz_lose_nothing(ros: Graph):
    topics = [f"/odom_{number}" for number in range(10)]
    node = ros.node("/base")
    for topic in topics:
        node.order(create=topic, type=ODOMETRY, depth=100)
    watcher = ros.watcher('topics = ["/odom_*"]')
    for topic in topics:
        node.order(**{"await": topic})
    node.order(burst=topics, count=200, rate=100)
    watcher.recorded(2000)
    statistics = watcher.stop()
    assert statistics == {topic: {"received": 200, "lost": 0, "dropped": 0, "foreign": 0} for topic in topics}
    for topic in topics:
        stamps = [data["header"]["stamp"] for data in data_of(watcher.records, topic)]
        assert stamps == [second * 10**9 for second in range(200)]


def test_huge_messages_arrive_whole(ros: Graph):
    node = ros.node("/camera")
    node.order(create="/compressed", type="sensor_msgs/msg/CompressedImage")
    watcher = ros.watcher('topics = ["/compressed"]')
    node.order(**{"await": "/compressed"})
    size = 8 << 20
    node.order(publish="/compressed", fields={"data": {"repeat": [7, size]}})
    (record,) = watcher.recorded(1)
    assert record["data"]["data"] == {"sm3": sm3.digest(bytes([7]) * size).hex(), "length": size}


def test_a_robot_that_is_too_slow_counts_what_it_could_not_take(ros: Graph):
    count = 6000
    node = ros.node("/base")
    node.order(create="/flood", type=NUMBER, depth=count)
    node.order(create="/odom", type=STRING)
    watcher = ros.watcher(f'topics = ["/flood", "/odom"]\n[source]\nkind = "ros2"\ndepth = {count}', "hold")
    for topic in ("/flood", "/odom"):
        node.order(**{"await": topic})
    node.order(publish="/odom", fields={"data": "0"})
    node.order(burst="/flood", count=count)
    node.order(publish="/odom", fields={"data": "1"})
    watcher.says("/flood: messages arrive faster than they are taken")
    watcher.process.stdin.close()  # from now on the robot takes what there is
    watcher.until(
        lambda: data_of(watcher.records, "/flood")[-1:] == [{"data": count - 1}]
        and len(data_of(watcher.records, "/odom")) == 2,
        "the last message",
    )
    statistics = watcher.stop()
    numbers = [data["data"] for data in data_of(watcher.records, "/flood")]
    dropped = count - len(numbers)
    assert dropped > 0
    assert statistics["/flood"] == {"received": count, "lost": 0, "dropped": dropped, "foreign": 0}
    assert statistics["/odom"] == {"received": 2, "lost": 0, "dropped": 0, "foreign": 0}
    assert numbers == sorted(set(numbers))


def test_what_the_middleware_loses_is_counted(ros: Graph):
    """A queue of one message, and a burst: most of it is overwritten before it can be taken."""
    node = ros.node("/base")
    node.order(create="/t", type=NUMBER, depth=1)
    watcher = ros.watcher('topics = ["/t"]\n[source]\nkind = "ros2"\ndepth = 1')
    node.order(**{"await": "/t"})
    node.order(publish="/t", fields={"data": 10_000})
    watcher.recorded(1)
    node.order(burst="/t", count=2000)
    watcher.until(lambda: {"data": 1999} in data_of(watcher.records, "/t"), "the last message")
    watcher.says("/t: messages were lost on their way here")
    (counts,) = watcher.stop().values()
    assert counts["lost"] > 0
    assert counts["received"] + counts["lost"] == 2001
    assert counts["received"] == len(watcher.records)
    assert watcher.declared == [{"lost": counts["lost"], "topic": "/t", "why": "lost"}]


def test_what_cannot_be_decoded_is_told_and_does_no_harm(ros: Graph, tmp_path):
    """A type that is not installed on the robot, and wstring, which rosbags does not read."""
    shadow = tmp_path / "shadow" / "sensor_msgs"
    shadow.mkdir(parents=True)
    (shadow / "__init__.py").touch()
    node = ros.node("/base")
    node.order(create="/absent", type="sensor_msgs/msg/Imu", latched=True)
    node.order(create="/wide", type="test_msgs/msg/WStrings", latched=True)
    node.order(create="/good", type=STRING, latched=True)
    for topic in ("/absent", "/wide", "/good"):
        node.order(publish=topic)
    path = os.pathsep.join([str(shadow.parent), ros.environment["PYTHONPATH"]])
    watcher = ros.watcher('topics = ["/**"]', PYTHONPATH=path)
    watcher.recorded(1)
    watcher.says("/absent (sensor_msgs/msg/Imu) is left out: message type sensor_msgs/msg/Imu is not installed here")
    watcher.says("/wide (test_msgs/msg/WStrings) is left out: test_msgs/msg/WStrings.wstring_value is a wstring")
    assert "/good" in (watched := watcher.stop())
    assert not {"/absent", "/wide"} & watched.keys()
    assert len(watcher.errors) == len(set(watcher.errors))  # each is said once


def test_the_robots_signals_and_threads_are_left_alone(ros: Graph):
    watcher = ros.watcher('topics = ["/t"]')
    assert '{"opened": "Ros2Source", "handlers_kept": true}' in watcher.lines
    assert watcher.stop() == {}


def test_a_domain_that_cannot_be_is_a_source_error(ros: Graph):
    watcher = ros.watcher('topics = ["/t"]', ROS_DOMAIN_ID="nonsense")
    assert watcher.finish() == 8
    assert "the ROS 2 graph cannot be joined" in watcher.lines[0]


def test_a_publisher_with_another_definition_is_left_out_and_the_others_are_heard(ros: Graph, tmp_path):
    """Its message package is of another version: the hash of the type that it advertises says so.

    The other version is the genuine library with one bit of that hash changed.
    """
    kind = "test_msgs/msg/Builtins"
    library, advertised = json.loads(ros.run(FIND_HASH))
    content = Path(library).read_bytes()
    hash = bytes.fromhex(advertised.removeprefix("RIHS01_"))
    assert hash in content
    other = tmp_path / Path(library).name
    other.write_bytes(content.replace(hash, bytes([hash[0] ^ 1]) + hash[1:]))
    swapped = {"LD_PRELOAD": str(other), "LD_LIBRARY_PATH": str(Path(library).parent)}
    node, stranger = ros.node("/base"), ros.node("/ns/stranger", **swapped)
    for publisher in (stranger, node):
        publisher.order(create="/t", type=kind, latched=True)
    stranger.order(publish="/t", fields={"time_value": {"sec": 666}})
    node.order(publish="/t", fields={"time_value": {"sec": 1}})
    watcher = ros.watcher('topics = ["/t"]')
    watcher.says("publishes with another definition of test_msgs/msg/Builtins than is installed here")
    # Only now the one that latches nothing: on a busy machine a publisher may be discovered after half a minute, and
    # what it had published before is given to who asks for the past, which nobody does beside one without any.
    watcher.recorded(1)
    late = ros.node("/late", **swapped)
    late.order(create="/t", type=kind)
    late.order(**{"await": "/t"})
    late.order(burst="/t", count=10)
    node.order(publish="/t", fields={"time_value": {"sec": 2}})
    watcher.recorded(2)
    node.order(publish="/t", fields={"time_value": {"sec": 3}})
    assert [data["time_value"] for data in data_of(watcher.recorded(3), "/t")] == [10**9, 2 * 10**9, 3 * 10**9]
    assert watcher.stop()["/t"] == {"received": 3, "lost": 0, "dropped": 0, "foreign": 11}


FIND_HASH = """
import json, sys
from pathlib import Path
lib, share = Path(sys.prefix, "lib"), Path(sys.prefix, "share")
hashes = json.loads((share / "test_msgs/msg/Builtins.json").read_text())["type_hashes"]
(found,) = [each["hash_string"] for each in hashes if each["type_name"] == "test_msgs/msg/Builtins"]
print(json.dumps([str(lib / "libtest_msgs__rosidl_generator_c.so"), found]))
"""


def test_two_types_under_one_name_do_no_harm(ros: Graph):
    """A DDS participant can hear one of them; that one, and whatever else there is, is recorded."""
    first, second = ros.node("/first"), ros.node("/second")
    first.order(create="/t", type=STRING, latched=True)
    second.order(create="/t", type=NUMBER, latched=True)
    first.order(create="/good", type=STRING, latched=True)
    first.order(publish="/t", fields={"data": "x"})
    second.order(publish="/t", fields={"data": 5})
    first.order(publish="/good", fields={"data": "y"})
    watcher = ros.watcher('topics = ["/t", "/good"]')
    watcher.until(lambda: len({record["topic"] for record in watcher.records}) == 2, "a message of each topic")
    heard = [(record["type"], record["data"]["data"]) for record in watcher.records if record["topic"] == "/t"]
    assert heard in ([(STRING, "x")], [(NUMBER, 5)])
    watcher.says(f"/t ({NUMBER if heard[0][0] == STRING else STRING}) is left out: it cannot be subscribed to")
    assert watcher.stop().keys() == {"/t", "/good"}
