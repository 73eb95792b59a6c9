"""Files made of proven records: read back by rosbags, by json and by an image reader, not by what wrote them."""

from __future__ import annotations

import json
from dataclasses import dataclass

import pytest
from matplotlib.image import imread
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from rosbridge_eth.capture import CapturedRecord
from rosbridge_eth.errors import ConfigError
from rosbridge_eth.reading import ProvenRecord, outputs
from rosbridge_eth.records import RecordId, SealedRecord
from rosbridge_eth.sealing import Kind, OpenedRecord

T0 = 1_763_690_000_000_000_000


@dataclass(frozen=True)
class Item:
    record: SealedRecord
    block_number: int = 7
    block_timestamp: int = 1_763_690_007
    log_index: int = 0
    leaf: int = 0
    tx_hash: bytes = b"\xab" * 32
    sender: str = "0x" + "cd" * 20


def proven(n: int, type_name: str, data: dict, topic: str = "/t") -> ProvenRecord:
    content = CapturedRecord(topic, type_name, T0 + n, T0 + n + 5, n, True, data, "reliable")
    id = RecordId(b"r" * 32, b"s" * 16, n)
    opened = OpenedRecord(id, Kind.DATA, content.to_json(), (), b"bound", b"g" * 64)
    return ProvenRecord(opened, Item(SealedRecord(id, b"")))


def point(n: int, x=0.5, y=-1.5, **more) -> ProvenRecord:
    return proven(n, "geometry_msgs/msg/Point", {"x": x, "y": y, "z": 0.0} | more)


def odometry(n: int, x: float, y: float) -> ProvenRecord:
    return proven(n, "nav_msgs/msg/Odometry", {"pose": {"pose": {"position": {"x": x, "y": y, "z": 0.0}}}}, "/odom")


def messages(path):
    store = get_typestore(Stores.ROS1_NOETIC if path.suffix == ".bag" else Stores.LATEST)
    with AnyReader([path], default_typestore=store) as reader:
        return [
            (connection.topic, connection.msgtype, time, reader.deserialize(raw, connection.msgtype))
            for connection, time, raw in reader.messages()
        ]


def test_a_json_line_is_the_record_and_its_proof():
    line = outputs.json_line(point(3))
    value = json.loads(line)
    assert line.endswith("}\n")
    assert line.count("\n") == 1
    assert (value["topic"], value["data"], value["received_ns"]) == ("/t", {"x": 0.5, "y": -1.5, "z": 0.0}, T0 + 3)
    assert value["proof"] == {
        "stream": "73" * 16, "seq": 3, "signature": "67" * 64, "block": 7, "block_time": "2025-11-21T01:53:27Z",
        "transaction": "0x" + "ab" * 32, "sender": "0x" + "cd" * 20,
    }


@pytest.mark.parametrize("name", ["out.bag", "out"])
def test_whole_records_become_their_own_messages(tmp_path, name):
    summary = outputs.write_bag(tmp_path / name, [point(2, x=2.0), point(1, x=1.0)])
    assert (summary.whole, summary.partial, summary.as_json, summary.notes) == (2, 0, 0, [])
    read = messages(tmp_path / name)
    assert [(topic, kind, time) for topic, kind, time, _ in read] == [
        ("/t", "geometry_msgs/msg/Point", T0 + 1), ("/t", "geometry_msgs/msg/Point", T0 + 2)]
    assert [(m.x, m.y, m.z) for *_, m in read] == [(1.0, -1.5, 0.0), (2.0, -1.5, 0.0)]


@pytest.mark.parametrize("name", ["out.bag", "out"])
def test_partial_records_are_on_a_topic_that_says_so(tmp_path, name):
    summary = outputs.write_bag(tmp_path / name, [odometry(1, 3.0, 4.0), odometry(2, 5.0, 6.0)])
    assert (summary.whole, summary.partial) == (0, 2)
    read = messages(tmp_path / name)
    assert {(topic, kind) for topic, kind, *_ in read} == {
        ("/odom/partial", "nav_msgs/msg/Odometry"), (outputs.NOTES, "std_msgs/msg/String")}
    assert [m.pose.pose.position.x for topic, *_, m in read if topic != outputs.NOTES] == [3.0, 5.0]
    (note,) = (m.data for topic, *_, m in read if topic == outputs.NOTES)
    assert "pose.covariance" in note
    assert "twist" in note


@pytest.mark.parametrize("name", ["out.bag", "out"])
@pytest.mark.parametrize("record", [proven(1, "acme_msgs/msg/Arm", {"joint": 1}), point(1, unheard_of=2)])
def test_what_cannot_be_a_message_is_json(tmp_path, name, record):
    summary = outputs.write_bag(tmp_path / name, [record])
    assert (summary.as_json, len(summary.notes)) == (1, 1)
    (topic, kind, time, message), _ = sorted(messages(tmp_path / name), key=lambda m: m[0] == outputs.NOTES)
    assert (topic, kind, time) == ("/t/json", "std_msgs/msg/String", T0 + 1)
    assert message.data.encode() == record.payload


def test_a_bag_that_is_there_is_not_overwritten(tmp_path):
    (tmp_path / "out.bag").write_bytes(b"mine")
    with pytest.raises(ConfigError, match="there already"):
        outputs.write_bag(tmp_path / "out.bag", [point(1)])
    assert (tmp_path / "out.bag").read_bytes() == b"mine"


def test_positions_are_found_in_the_usual_messages():
    records = [
        odometry(1, 1.0, 2.0),
        proven(2, "geometry_msgs/msg/PoseStamped", {"pose": {"position": {"x": 3, "y": 4.0}}}, "/pose"),
        point(3, 5.0, 6.0),
        point(4, "NaN", 6.0),
        proven(5, "std_msgs/msg/String", {"data": "x"}, "/text"),
    ]
    assert outputs.positions(records) == {
        "/odom": [(T0 + 1, 1.0, 2.0)], "/pose": [(T0 + 2, 3.0, 4.0)], "/t": [(T0 + 3, 5.0, 6.0)]}


def test_the_picture_shows_the_track_where_it_was(tmp_path):
    """A track along the left and lower edge leaves ink there and none in the middle of the upper right."""
    corner = [odometry(n, 0.0, 10.0 - n) for n in range(11)] + [odometry(11 + n, float(n), 0.0) for n in range(11)]
    assert outputs.draw_trajectory(tmp_path / "track.png", corner) == 22
    image = imread(tmp_path / "track.png")[:, :, :3]
    coloured = (image.max(axis=2) - image.min(axis=2)) > 0.3
    height, width = coloured.shape
    assert coloured[: height // 2, : width // 3].any()
    assert coloured[height * 2 // 3 :, width // 2 :].any()
    assert not coloured[height // 4 : height // 2, width // 2 : width * 3 // 4].any()


@pytest.mark.parametrize("name", ["a.png", "a.svg", "a.pdf"])
def test_without_positions_the_picture_says_so(tmp_path, name):
    assert outputs.draw_trajectory(tmp_path / name, []) == 0
    assert (tmp_path / name).stat().st_size > 500


def test_an_ending_that_is_no_picture(tmp_path):
    with pytest.raises(ConfigError, match=r"\.png, \.svg or \.pdf"):
        outputs.draw_trajectory(tmp_path / "a.doc", [])
