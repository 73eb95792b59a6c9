"""Files made of proven records: read back by rosbags, csv, json and an image reader, not by what wrote them."""

from __future__ import annotations

import csv
import json
import math
import struct
import tracemalloc
from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Any

import numpy
import pytest
from matplotlib.image import imread
from mcap.exceptions import EndOfFile, McapError
from mcap.reader import NonSeekingReader, make_reader
from mcap.records import Message
from mcap.stream_reader import StreamReader
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from rosbridge_eth.capture import (
    Capture,
    MessageLine,
    RawMessage,
    TopicRule,
    TypeLine,
    Wire,
    decoder_for_known,
    definition_line,
    parse_line,
)
from rosbridge_eth.errors import ConfigError
from rosbridge_eth.reading import outputs
from rosbridge_eth.reading.outputs import Bag
from rosbridge_eth.reading.verify import Choice, Place, ProvenRecord

T0 = 1_763_690_000_000_000_000
PLACE = Place(7, b"s" * 16, 3, b"d" * 32, 9, T0 // 10**9 + 7, b"\xab" * 32, T0 // 10**6)
BAGS = ["out.bag", "out", "out.mcap", "out.db3"]
EVIL = "/\x1b[2J\u202e"


def known(type_name: str, wire: Wire = Wire.CDR) -> TypeLine:
    decoder = decoder_for_known(wire, type_name)
    assert decoder is not None
    found = parse_line(definition_line(decoder))
    assert isinstance(found, TypeLine)
    return found


def record(
    n: int, type_name: str, data: dict[str, Any], topic: str = "/t", definition: TypeLine | None = None
) -> ProvenRecord:
    line = json.dumps(
        {"topic": topic, "type": type_name, "source": "bag", "received_ns": T0 + n, "captured_ns": T0 + n + 5,
         "clock": True, "data": data},
        separators=(",", ":"), ensure_ascii=False,
    ).encode()  # fmt: skip
    content = parse_line(line)
    assert isinstance(content, MessageLine)
    return ProvenRecord(PLACE, n, line, content, definition)


def point(n: int, x: float = 0.5, y: float = -1.5, topic: str = "/t", **more: Any) -> ProvenRecord:
    data = {"x": x, "y": y, "z": 0.0} | more
    return record(n, "geometry_msgs/msg/Point", data, topic, known("geometry_msgs/msg/Point"))


def odometry(n: int, x: float, y: float) -> ProvenRecord:
    data = {"pose": {"pose": {"position": {"x": x, "y": y, "z": 0.0}}}}
    return record(n, "nav_msgs/msg/Odometry", data, "/odom", known("nav_msgs/msg/Odometry"))


def write_bag(path: Path, records: Iterable[ProvenRecord]) -> Bag:
    with outputs.bag(path) as bag:
        for one in records:
            bag.write(one)
    return bag


def messages(path: Path) -> list[tuple[str, str, int, Any]]:
    store = get_typestore(Stores.ROS1_NOETIC if path.suffix == ".bag" else Stores.LATEST)
    with AnyReader([path], default_typestore=store) as reader:
        return [
            (connection.topic, connection.msgtype, time, reader.deserialize(raw, connection.msgtype))
            for connection, time, raw in reader.messages()
        ]


# --- choosing


def test_records_are_chosen_by_topic_and_time_as_they_come():
    records = [point(n, topic="ab"[n % 2]) for n in range(6)]

    def chosen(**wanted: Any) -> list[int]:
        return [one.number for one in Choice(**wanted).choose(iter(records))]

    assert chosen() == [0, 1, 2, 3, 4, 5]
    assert chosen(topic="b") == [1, 3, 5]
    assert chosen(from_ns=T0 + 2, to_ns=T0 + 4) == [2, 3]
    assert chosen(at_ns=T0 + 4) == [4, 3]
    assert next(Choice().choose(point(n) for n in iter(int, 1))).number == 0, "nothing is read ahead"


# --- JSON lines


def test_a_json_line_is_the_record_and_where_it_is_proven():
    text = outputs.json_line(point(3))
    value = json.loads(text)
    assert text.endswith("}\n")
    assert text.count("\n") == 1
    assert (value["topic"], value["data"], value["received_ns"]) == ("/t", {"x": 0.5, "y": -1.5, "z": 0.0}, T0 + 3)
    assert value["proof"] == {
        "chunk": 7, "record": 3, "stream": "73" * 16, "number": 3, "digest": "64" * 32,
        "sealed": "2025-11-21T01:53:20.000Z", "block": 9, "block_time": "2025-11-21T01:53:27.000Z",
        "transaction": "0x" + "ab" * 32,
    }  # fmt: skip


@pytest.mark.parametrize("text", ["\x7f\x9b31m", "\u202e", "\u2028", "\U000e0041", "é漢", '\\"\n'])
def test_a_json_line_keeps_its_text_and_shows_nothing_that_acts_on_a_terminal(text):
    line = outputs.json_line(record(1, "pkg/msg/Type", {text: text}, "/" + text))
    assert line[:-1].isprintable()
    assert json.loads(line)["data"] == {text: text}


# --- tables


def read_table(path: Path) -> list[dict[str, str]]:
    with path.open(newline="", encoding="utf-8") as file:
        return list(csv.DictReader(file))


def test_a_table_has_a_column_for_each_field_of_any_record(tmp_path):
    with outputs.table(tmp_path / "t.csv") as table:
        for one in (point(1), odometry(2, 3.0, 4.0), record(3, "pkg/msg/A", {"ranges": [1, 2.5, "NaN"], "on": True})):
            table.write(one)
    rows = read_table(tmp_path / "t.csv")
    assert [row["topic"] for row in rows] == ["/t", "/odom", "/t"]
    assert [row["x"] for row in rows] == ["0.5", "", ""]
    assert [row["pose.pose.position.y"] for row in rows] == ["", "4.0", ""]
    assert (rows[2]["ranges"], rows[2]["on"], rows[2]["received_ns"]) == ('[1, 2.5, "NaN"]', "True", str(T0 + 3))
    assert (rows[0]["chunk"], rows[0]["record"], rows[0]["block"]) == ("7", "1", "9")


def test_no_cell_is_taken_for_a_formula_or_acts_on_a_terminal(tmp_path):
    hostile = {"=cmd|' /C calc'!A0": "=1+1", "@x": "+1", "s": EVIL, "n": -3, "low": "-Infinity"}
    with outputs.table(tmp_path / "t.csv") as table:
        table.write(record(1, "pkg/msg/A", hostile, "-topic"))
    [row] = read_table(tmp_path / "t.csv")
    assert not any(cell.startswith(("=", "@", "+")) for cell in [*row, *row.values()])
    assert (row["topic"], row["n"], float(row["low"])) == ("'-topic", "-3", -math.inf)
    assert all(text.isprintable() for text in (tmp_path / "t.csv").read_text("utf-8").splitlines())


@pytest.mark.parametrize("text", [
    "=1", "+1", "-1+1", "@SUM(1)", " =1", "a;=1", "a; @x", "a,=1", "a|+1", "＝1", "＋1", "－1", "＠x", "a;＝cmd",
    ";;-1",
])  # fmt: skip
def test_no_text_is_a_formula_at_its_beginning_or_behind_what_divides_cells_elsewhere(tmp_path, text):
    with outputs.table(tmp_path / "t.csv") as table:
        table.write(record(1, "pkg/msg/A", {"cell": text, text: 1}))
    for delimiter in ",;|":
        with (tmp_path / "t.csv").open(newline="", encoding="utf-8") as file:
            cells = [cell for row in csv.reader(file, delimiter=delimiter) for cell in row]
        assert not [cell for cell in cells if cell.lstrip()[:1] in {*"=+-@＝＋－＠"}]


@pytest.mark.parametrize("text", ["a=1", "frame-id", "x@y", "1;2", "a - b", "'=1"])
def test_text_that_is_no_formula_stays_as_it_is(tmp_path, text):
    with outputs.table(tmp_path / "t.csv") as table:
        table.write(record(1, "pkg/msg/A", {"cell": text}))
    assert read_table(tmp_path / "t.csv")[0]["cell"] == text


def test_numbers_that_some_records_have_stay_exact(tmp_path):
    with outputs.table(tmp_path / "t.csv") as table:
        for n, data in enumerate(({"stamp": T0 + 1, "on": True}, {"other": 0.1}, {"stamp": T0 + 3})):
            table.write(record(n, "pkg/msg/A", data))
    rows = read_table(tmp_path / "t.csv")
    assert [row["stamp"] for row in rows] == [str(T0 + 1), "", str(T0 + 3)]
    assert ([row["on"] for row in rows], [row["other"] for row in rows]) == (["True", "", ""], ["", "0.1", ""])
    table = parquet(tmp_path / "t.parquet", [record(n, "pkg/msg/A", {"stamp": T0 + n} if n else {}) for n in range(3)])
    assert table["stamp"].to_pylist() == [None, T0 + 1, T0 + 2]


@pytest.mark.parametrize("name", ["t.csv", "t.parquet"])
def test_a_table_takes_no_more_memory_for_more_rows(tmp_path, monkeypatch, name):
    monkeypatch.setattr(outputs, "_BATCH", 100)
    highest = []
    for count in (500, 4_000):
        with outputs.table(tmp_path / f"{count}{name}") as table:
            for n in range(count):
                table.write(record(n, "pkg/msg/A", {"text": "x" * 1_000, "n": n}))
            tracemalloc.start()
        highest.append(tracemalloc.get_traced_memory()[1])
        tracemalloc.stop()
    assert highest[1] < 2 * highest[0] + 500_000


def test_columns_are_bounded(tmp_path):
    with outputs.table(tmp_path / "t.csv") as table:
        for n in range(12):
            table.write(record(n, "pkg/msg/A", {f"f{n}_{m}": m for m in range(500)}))
    assert len(read_table(tmp_path / "t.csv")[0]) == outputs.MAX_COLUMNS + 12


def test_a_path_of_any_length_costs_no_more_than_the_record_has(tmp_path):
    deep = {"n" * 30_000: {f"f{n}": n for n in range(2_000)}, "m" * 200: {"m" * 54: {"x": 5}, "m" * 52: {"x": 6}}}
    with outputs.table(tmp_path / "t.csv") as table:
        table.write(record(1, "pkg/msg/A", deep))
    assert (tmp_path / "t.csv").stat().st_size < 2_000
    [row] = read_table(tmp_path / "t.csv")
    assert [value for name, value in row.items() if name[0] == "m"] == ["6"]


# --- bags


@pytest.mark.parametrize("name", BAGS)
def test_whole_records_become_their_own_messages(tmp_path, name):
    summary = write_bag(tmp_path / name, [point(2, x=2.0), point(1, x=1.0)])
    assert (summary.whole, summary.partial, summary.as_json) == (2, 0, 0)
    read = messages(tmp_path / name)
    assert sorted((topic, kind, time) for topic, kind, time, _ in read) == [
        ("/t", "geometry_msgs/msg/Point", T0 + 1), ("/t", "geometry_msgs/msg/Point", T0 + 2)]  # fmt: skip
    assert sorted(m.x for *_, m in read) == [1.0, 2.0]


@pytest.mark.parametrize("name", BAGS)
def test_partial_records_are_on_a_topic_that_says_so(tmp_path, name):
    summary = write_bag(tmp_path / name, [odometry(1, 3.0, 4.0), odometry(2, 5.0, 6.0)])
    assert (summary.whole, summary.partial) == (0, 2)
    read = messages(tmp_path / name)
    assert {(topic, kind) for topic, kind, *_ in read} == {("/odom/partial", "nav_msgs/msg/Odometry")}
    assert [(m.pose.pose.position.x, m.twist.twist.linear.x) for *_, m in read] == [(3.0, 0.0), (5.0, 0.0)]


CUSTOM = TypeLine("acme_msgs/msg/Arm", "ros1", "msg", "Header header\nfloat64[2] joints\nstring name\n" + "=" * 80 +
                  "\nMSG: std_msgs/Header\nuint32 seq\ntime stamp\nstring frame_id\n")  # fmt: skip
ARM = {"header": {"seq": 5, "stamp": T0, "frame_id": "base"}, "joints": [1.5, 2.5], "name": "left"}


@pytest.mark.parametrize("name", BAGS)
def test_a_type_of_ones_own_comes_back_whole_in_every_kind_of_bag(tmp_path, name):
    """From ROS 1: in ROS 2's bags the header has no seq."""
    summary = write_bag(tmp_path / name, [record(1, "acme_msgs/msg/Arm", ARM, "/arm", CUSTOM)])
    assert (summary.whole, summary.as_json) == (1, 0)
    [(topic, kind, time, arm)] = messages(tmp_path / name)
    assert (topic, kind, time) == ("/arm", "acme_msgs/msg/Arm", T0 + 1)
    assert (arm.joints.tolist(), arm.name, arm.header.frame_id) == ([1.5, 2.5], "left", "base")
    assert (arm.header.stamp.sec, arm.header.stamp.nanosec) == divmod(T0, 10**9)
    assert hasattr(arm.header, "seq") == (name == "out.bag")


def test_a_ros_2_record_becomes_a_ros_1_message(tmp_path):
    data = {"header": {"stamp": T0, "frame_id": "map"}, "point": {"x": 1.0, "y": 2.0, "z": 3.0}}
    one = record(1, "geometry_msgs/msg/PointStamped", data, "/p", known("geometry_msgs/msg/PointStamped"))
    assert write_bag(tmp_path / "out.bag", [one]).whole == 1
    [(*_, message)] = messages(tmp_path / "out.bag")
    assert (message.header.seq, message.header.frame_id, message.point.z) == (0, "map", 3.0)


def captured(wire: Wire, topic: str, type_name: str, *fields: Any) -> ProvenRecord:
    """A message that a robot took in as it is configured by default: all fields, as far as they fit."""
    decoder = decoder_for_known(wire, type_name)
    assert decoder is not None
    types = decoder.typestore.types
    stamp = types["builtin_interfaces/msg/Time"](5, 6)
    header = types["std_msgs/msg/Header"](*([7] if wire is Wire.ROS1 else []), stamp, "odom")
    raw = decoder.encode(types[type_name](header, *fields))
    found = Capture([TopicRule("**")], source_kind="ros").process(RawMessage(topic, type_name, T0, raw, decoder), T0)
    assert found is not None
    content, definition = parse_line(found.line), parse_line(definition_line(decoder))
    assert isinstance(content, MessageLine) and isinstance(definition, TypeLine)
    return ProvenRecord(PLACE, 0, found.line, content, definition)


@pytest.mark.parametrize("name", BAGS)
@pytest.mark.parametrize("wire", Wire)
def test_a_scan_and_an_odometry_come_back_whole_by_default_from_ros_1_and_ros_2_in_any_bag(tmp_path, name, wire):
    ranges, covariance = numpy.linspace(0.1, 30, 360, dtype="f4"), numpy.arange(36) / 7
    numbers = 0.0, 6.25, 0.5, 0.0, 0.25, 0.125, 30.0
    scan = captured(wire, "/scan", "sensor_msgs/msg/LaserScan", *numbers, ranges, ranges / 2)
    store = decoder_for_known(wire, "nav_msgs/msg/Odometry").typestore.types

    def made(name: str, *fields: Any) -> Any:
        return store[f"geometry_msgs/msg/{name}"](*fields)

    pose = made("Pose", made("Point", 1.0, 2.0, 3.0), made("Quaternion", 0.0, 0.0, 0.0, 1.0))
    twist = made("Twist", made("Vector3", 4.0, 5.0, 6.0), made("Vector3", 4.0, 5.0, 6.0))
    both = made("PoseWithCovariance", pose, covariance), made("TwistWithCovariance", twist, -covariance)
    odom = captured(wire, "/odom", "nav_msgs/msg/Odometry", "base", *both)
    summary = write_bag(tmp_path / name, [scan, odom])
    assert (summary.whole, summary.partial, summary.as_json) == (2, 0, 0)
    found = {topic: message for topic, _, _, message in messages(tmp_path / name)}
    assert found["/scan"].ranges.tolist() == ranges.tolist()
    assert (found["/scan"].range_max, found["/scan"].intensities[359]) == (30.0, 15.0)
    assert found["/odom"].pose.covariance.tolist() == covariance.tolist()
    assert found["/odom"].twist.covariance.tolist() == (-covariance).tolist()
    assert (found["/odom"].twist.twist.angular.z, found["/odom"].pose.pose.position.y) == (6.0, 2.0)
    for message in found.values():
        assert (message.header.stamp.sec, message.header.stamp.nanosec, message.header.frame_id) == (5, 6, "odom")
        assert hasattr(message.header, "seq") == (name == "out.bag")
        assert getattr(message.header, "seq", 7 if wire is Wire.ROS1 else 0) == (7 if wire is Wire.ROS1 else 0)


def test_two_definitions_of_one_name_stay_apart(tmp_path):
    first, second = (TypeLine("a_msgs/msg/A", "ros1", "msg", f"int32 {name}\n") for name in "xy")
    records = [record(1, "a_msgs/msg/A", {"x": 1}, "/a", first), record(2, "a_msgs/msg/A", {"y": 2}, "/a", second)]
    assert write_bag(tmp_path / "out.bag", records).whole == 2
    made = write_bag(tmp_path / "out.mcap", records)  # where readers know a type by its name
    assert (made.whole, made.as_json) == (1, 1)
    assert [(topic, kind) for topic, kind, _, _ in messages(tmp_path / "out.mcap")] == [
        ("/a", "a_msgs/msg/A"), ("/a/json", "std_msgs/msg/String")]  # fmt: skip


@pytest.mark.parametrize("name", BAGS)
def test_one_topic_under_two_texts_of_one_definition(tmp_path, name):
    """A robot that went from ROS 1 to ROS 2, another comment, no definition at all, a topic that is named as ours."""
    texts = [TypeLine("std_msgs/msg/String", wire, "msg", text) for wire, text in (
        (Wire.ROS1, "string data\n"), (Wire.CDR, "string data\n"), (Wire.CDR, "# What is said\nstring data\n"))]
    said = [record(n, "std_msgs/msg/String", {"data": str(n)}, "/t/json", one) for n, one in enumerate([*texts, None])]
    assert write_bag(tmp_path / name, [*said, record(9, "x/msg/None", {}), record(10, "x/msg/None", {}, "")]).whole == 4
    found = messages(tmp_path / name)
    assert [message.data for topic, _, _, message in found if topic == "/t/json"][:4] == ["0", "1", "2", "3"]
    assert len(found) == 6


def test_a_service_s_message_of_ros_1_is_json(tmp_path):
    """There are none; rosbags ends in an AssertionError at one."""
    request = TypeLine("x_msgs/srv/A_Request", "ros1", "msg", "int32 n\n")
    one = record(1, request.type_name, {"n": 1}, "/t", request)
    assert write_bag(tmp_path / "out.bag", [one]).as_json == 1


def test_types_are_bounded(tmp_path, monkeypatch):
    monkeypatch.setattr(outputs, "MAX_TYPES", 8)
    with outputs.bag(tmp_path / "out.mcap") as bag:
        for n in range(40):
            bag.write(record(n, f"x/msg/T{n % 20}", {}))
            bag.write(point(n))
        assert bag._restoration.cache_info().currsize <= 8
    assert (bag.whole, bag.as_json) == (40, 40)


@pytest.mark.parametrize("name", BAGS)
@pytest.mark.parametrize(
    "one",
    [
        record(1, "acme_msgs/msg/Arm", {"joint": 1}),
        record(1, "no type at all", {"joint": 1}),
        point(1, unheard_of=2),
        record(1, "a_msgs/msg/A", {"x": 1}, definition=TypeLine("a_msgs/msg/A", "ros1", "msg", "evil[][ x")),
        record(1, "a_msgs/msg/A", {"x": 1}, definition=TypeLine("a_msgs/msg/A", "ros3", "msg", "int32 x")),
        record(1, "a_msgs/msg/A", {"x": 2**40}, definition=TypeLine("a_msgs/msg/A", "ros1", "msg", "int32 x")),
    ],
)
def test_what_cannot_be_a_message_is_json(tmp_path, name, one):
    summary = write_bag(tmp_path / name, [one])
    assert (summary.whole, summary.as_json) == (0, 1)
    [(topic, kind, time, message)] = messages(tmp_path / name)
    assert (topic, kind, time) == ("/t/json", "std_msgs/msg/String", T0 + 1)
    assert message.data.encode() == one.line


@pytest.mark.parametrize("name", BAGS)
@pytest.mark.parametrize("received_ns", [0, 2**63 - 1])
def test_times_that_no_bag_can_have_are_brought_into_its_range(tmp_path, name, received_ns):
    one = point(1)
    one = one._replace(content=one.content._replace(received_ns=received_ns))
    assert write_bag(tmp_path / name, [one]).whole == 1


@pytest.mark.parametrize("name", BAGS)
def test_topics_are_escaped(tmp_path, name):
    write_bag(tmp_path / name, [point(1, topic=EVIL)])
    assert all(topic.isprintable() for topic, *_ in messages(tmp_path / name))


@pytest.mark.parametrize("name", BAGS)
def test_a_bag_that_is_there_is_not_overwritten(tmp_path, name):
    (tmp_path / name).write_bytes(b"mine")
    with pytest.raises(ConfigError, match="there already"):
        write_bag(tmp_path / name, [point(1)])
    assert (tmp_path / name).read_bytes() == b"mine"


@pytest.mark.parametrize("name", [*BAGS, "out.csv"])
def test_what_fails_half_way_leaves_nothing_under_the_name(tmp_path, name):
    def failing() -> Iterable[ProvenRecord]:
        yield point(1)
        raise OSError("the node went away")

    make: Any = outputs.table if name == "out.csv" else outputs.bag
    with pytest.raises(OSError, match="went away"), make(tmp_path / name) as output:
        for one in failing():
            output.write(one)
    assert list(tmp_path.iterdir()) == []


@pytest.mark.parametrize("name", BAGS)
def test_a_bag_of_nothing(tmp_path, name):
    assert write_bag(tmp_path / name, []).whole == 0
    assert (tmp_path / name).exists()


# --- pictures


def drawn(path: Path, records: Iterable[ProvenRecord]) -> int:
    trajectory = outputs.Trajectory()
    for one in records:
        trajectory.write(one)
    return trajectory.draw(path)


def test_positions_are_found_in_the_usual_messages():
    trajectory = outputs.Trajectory()
    for one in (
        odometry(1, 1.0, 2.0),
        record(2, "geometry_msgs/msg/PoseStamped", {"pose": {"position": {"x": 3, "y": 4.0}}}, "/pose"),
        point(3, 5.0, 6.0),
        record(4, "geometry_msgs/msg/Point", {"x": "NaN", "y": 6.0}),
        record(5, "geometry_msgs/msg/Point", {"x": 1e300, "y": 6.0}),
        record(6, "geometry_msgs/msg/Point", {"x": True, "y": 6.0}),
        record(7, "std_msgs/msg/String", {"data": "x"}, "/text"),
    ):
        trajectory.write(one)
    assert {topic: points.kept for topic, points in trajectory.tracks.items()} == {
        "/odom": [(T0 + 1, 1.0, 2.0)], "/pose": [(T0 + 2, 3.0, 4.0)], "/t": [(T0 + 3, 5.0, 6.0)]}  # fmt: skip


def test_the_picture_shows_the_track_where_it_was(tmp_path):
    """A track along the left and lower edge leaves ink there and none in the middle of the upper right."""
    corner = [odometry(n, 0.0, 10.0 - n) for n in range(11)] + [odometry(11 + n, float(n), 0.0) for n in range(11)]
    assert drawn(tmp_path / "track.png", corner) == 22
    image = imread(tmp_path / "track.png")[:, :, :3]
    coloured = (image.max(axis=2) - image.min(axis=2)) > 0.3
    height, width = coloured.shape
    assert coloured[: height // 2, : width // 3].any()
    assert coloured[height * 2 // 3 :, width // 2 :].any()
    assert not coloured[height // 4 : height // 2, width // 2 : width * 3 // 4].any()


@pytest.mark.parametrize("topic", [r"$\frac{$", "$x$", "_hidden", EVIL, "/" + "x" * 50_000, "%s", "\\"])
def test_a_topic_is_drawn_as_it_is_written(tmp_path, topic):
    assert drawn(tmp_path / "track.svg", [point(1, topic=topic), point(2, topic=topic)]) == 2


def test_topics_in_a_picture_are_bounded(tmp_path):
    assert drawn(tmp_path / "track.png", [point(n, topic=f"/t{n}") for n in range(100)]) == outputs.MAX_TRACKS


def test_a_picture_that_is_cut_off_leaves_the_one_before(tmp_path, monkeypatch):
    def savefig(self: Any, path: Path, **options: Any) -> None:
        Path(path).write_bytes(b"half of it")
        raise OSError(28, "No space left on device")

    (tmp_path / "p.png").write_bytes(b"the one before")
    monkeypatch.setattr("matplotlib.figure.Figure.savefig", savefig)
    with pytest.raises(OSError, match="No space"):
        drawn(tmp_path / "p.png", [point(1)])
    assert [path.read_bytes() for path in tmp_path.iterdir()] == [b"the one before"]


@pytest.mark.parametrize("name", ["a.png", "a.svg", "a.pdf"])
def test_without_positions_the_picture_says_so(tmp_path, name):
    assert drawn(tmp_path / name, []) == 0
    assert (tmp_path / name).stat().st_size > 500


@pytest.mark.parametrize("name", ["a.doc", "a"])
def test_an_ending_that_is_no_picture(tmp_path, name):
    with pytest.raises(ConfigError, match=r"\.png, \.svg or \.pdf"):
        outputs.check_picture(tmp_path / name)


def test_a_picture_in_no_folder_is_told_before_anything_is_read(tmp_path):
    with pytest.raises(ConfigError, match="make it first"):
        outputs.check_picture(tmp_path / "absent" / "a.png")


@pytest.mark.parametrize(("check", "name"), [(outputs.check_bag, "a.doc"), (outputs.check_table, "a.doc")])
def test_an_ending_that_is_no_bag_or_table(tmp_path, check, name):
    with pytest.raises(ConfigError, match="doc"):
        check(tmp_path / name)


@pytest.mark.parametrize(("check", "name"), [(outputs.check_bag, "b/a.bag"), (outputs.check_table, "b/a.csv")])
def test_a_folder_that_is_not_there(tmp_path, check, name):
    with pytest.raises(ConfigError, match="no folder"):
        check(tmp_path / name)


def test_a_field_is_drawn_over_time_where_it_was(tmp_path):
    """A step from low to high leaves ink lower left and upper right, and none upper left."""
    curves = outputs.Curves(["pose.pose.position.x", "pose.pose.position.y"])
    for n in range(200):
        curves.write(odometry(n * 10**9, 0.0 if n < 100 else 5.0, 1.0))
        curves.write(point(n * 10**9))
    assert {key: points.count for key, points in curves.curves.items()} == {
        ("pose.pose.position.x", "/odom"): 200, ("pose.pose.position.y", "/odom"): 200}  # fmt: skip
    assert curves.draw(tmp_path / "curves.png") == 400
    image = imread(tmp_path / "curves.png")[:, :, :3]
    coloured = (image.max(axis=2) - image.min(axis=2)) > 0.3
    height, width = coloured.shape
    upper, left, right = slice(height // 10, height // 4), slice(width // 5, width * 2 // 5), slice(width // 2, width)
    assert coloured[height // 4 : height // 2, left].any()
    assert coloured[: height // 4, right].any()
    assert not coloured[upper, left].any()


def test_elements_of_arrays_and_what_is_no_number():
    curves = outputs.Curves(["ranges[1]", "on", "deep[0].x"])
    for data in ({"ranges": [1, 2.5]}, {"ranges": [1]}, {"ranges": "x"}, {"ranges": {"1": 5}}, {"ranges": [1, "NaN"]},
                 {"on": True}, {"deep": [{"x": 7}]}, {"deep": [7]}, {}):  # fmt: skip
        curves.write(record(1, "pkg/msg/A", data))
    assert {field: points.kept for (field, _), points in curves.curves.items()} == {
        "ranges[1]": [(T0 + 1, 2.5, 2.5), (T0 + 1, 5.0, 5.0)], "on": [(T0 + 1, 1.0, 1.0)],
        "deep[0].x": [(T0 + 1, 7.0, 7.0)]}  # fmt: skip


@pytest.mark.filterwarnings("error")
def test_the_highest_numbers_are_drawn_or_left_out(tmp_path):
    curves = outputs.Curves(["x"])
    for n, value in enumerate((1e300, -1e300, 1.7e308, -1.7e308, 5e-324, 2**64 - 1)):
        curves.write(record(n, "pkg/msg/A", {"x": value}))
    assert curves.draw(tmp_path / "p.png") == 4


@pytest.mark.parametrize("field", ["", "a..b", "a[x]", "a b", ".a", "$x$", "a["])
def test_what_names_no_field(field):
    with pytest.raises(ConfigError, match="names no field"):
        outputs.Curves([field])


def test_a_curve_of_very_many_values_keeps_its_peaks_in_little_memory():
    curves = outputs.Curves(["x"])
    peaks = {12_345, 54_321}
    for n in range(60_000):
        content = MessageLine("/t", "a/msg/A", "sim", T0 + n, 0, True, {"x": 9.0 if n in peaks else 0.0})
        curves.write(ProvenRecord(PLACE, n, b"", content, None))
    [points] = curves.curves.values()
    assert points.count == 60_000
    assert outputs.MAX_POINTS // 2 <= len(points.kept) <= outputs.MAX_POINTS
    assert [time - T0 <= peak < time - T0 + 8 for time, _, high in points.kept if high == 9.0 for peak in sorted(peaks)
            if abs(time - T0 - peak) < 8] == [True, True]  # fmt: skip
    assert points.kept[0][0] == T0
    assert T0 + 59_990 < points.kept[-1][0] < T0 + 60_000


@pytest.mark.parametrize("topic", [r"$\frac{$", "_hidden", EVIL])
def test_a_topic_of_a_curve_is_drawn_as_it_is_written(tmp_path, topic):
    curves = outputs.Curves(["x"])
    curves.write(point(1, topic=topic))
    assert curves.draw(tmp_path / "curve.svg") == 1


# --- Parquet


def parquet(path: Path, records: Iterable[ProvenRecord]) -> Any:
    with outputs.table(path) as table:
        for one in records:
            table.write(one)
    return pytest.importorskip("pyarrow.parquet").read_table(path)


def test_a_parquet_file_has_numbers_times_and_lists(tmp_path, monkeypatch):
    monkeypatch.setattr(outputs, "_BATCH", 2)
    more = {"header": {"stamp": T0 + 7, "frame_id": "=base"}, "joints": [1, 2.5], "ids": [1, 2], "on": True, "n": 3,
            "f": "NaN", "big": 2**64 - 1, "mixed": [{"a": 1}], "empty": []}  # fmt: skip
    definition = TypeLine("acme_msgs/msg/Arm", "ros1", "msg", "Header header\nint64 n\n" + "=" * 80 +
                          "\nMSG: std_msgs/Header\nuint32 seq\ntime stamp\nstring frame_id\n")  # fmt: skip
    arms = [record(n, "acme_msgs/msg/Arm", more | {"f": 0.5} if n else more, "/arm", definition) for n in range(4)]
    table = parquet(tmp_path / "t.parquet", [*arms, point(9)])
    types = {field.name: str(field.type) for field in table.schema}
    assert types | {
        "topic": "string", "received_ns": "timestamp[ns, tz=UTC]", "captured_ns": "timestamp[ns, tz=UTC]",
        "clock": "bool", "stream": "string", "number": "int64", "chunk": "int64", "block": "int64",
        "transaction": "string",
        "header.stamp": "int64", "header.frame_id": "string", "joints": "list<element: double>",
        "ids": "list<element: double>", "on": "bool", "n": "int64", "f": "double", "big": "string", "mixed": "string",
        "empty": "list<element: double>", "x": "double",
    } == types  # fmt: skip
    rows = table.drop(["received_ns", "captured_ns"]).to_pylist()
    assert table["received_ns"].cast("int64").to_pylist() == [T0, T0 + 1, T0 + 2, T0 + 3, T0 + 9]
    assert table["header.stamp"].to_pylist() == [T0 + 7] * 4 + [None]
    assert (rows[1]["joints"], rows[1]["ids"], rows[1]["f"]) == ([1.0, 2.5], [1, 2], 0.5)
    assert rows[0]["f"] != rows[0]["f"], "NaN is a number that is not one"
    assert (rows[1]["big"], rows[1]["mixed"], rows[1]["empty"]) == (str(2**64 - 1), '[{"a": 1}]', [])
    assert (rows[1]["header.frame_id"], rows[4]["n"], rows[4]["x"]) == ("=base", None, 0.5)


def test_a_field_that_is_named_as_a_column_of_every_table_has_one_of_its_own(tmp_path):
    fields = {"topic": "mine", "number": 5, "received": 1.5, "received_ns": 6}
    with outputs.table(tmp_path / "t.csv") as table:
        table.write(record(1, "pkg/msg/A", fields, "/its"))
    [row] = read_table(tmp_path / "t.csv")
    assert (row["topic"], row[".topic"], row[".number"], row["received"]) == ("/its", "mine", "5", "1.5")
    assert (row["received_ns"], row[".received_ns"]) == (str(T0 + 1), "6")
    table = parquet(tmp_path / "t.parquet", [record(1, "pkg/msg/A", fields, "/its")])
    [found] = table.drop(["received_ns", "captured_ns"]).to_pylist()
    assert (found["topic"], found[".topic"], found[".number"], found["received"]) == ("/its", "mine", 5, 1.5)
    assert found[".received_ns"] == 6


def test_whatever_only_a_lying_robot_signs_a_table_can_be_read(tmp_path):
    """Names that would be one column twice, and the highest number that a chunk can have."""
    fields = {"topic": 1, ".topic": 2, "..topic": 3, "\x01": 4, "\\u0001": 5, "": 6, "a.b": 7, "a": {"b": 8}}
    lying = record(1, "pkg/msg/A", fields)
    lying = lying._replace(place=PLACE._replace(number=2**64 - 1))
    table = parquet(tmp_path / "t.parquet", [lying])
    [found] = table.drop(["received_ns", "captured_ns"]).to_pylist()
    assert (found["number"], found["topic"], found["a.b"], found["\\u0001"]) == (str(2**64 - 1), "/t", 8, 5)
    assert [found[f"{'.' * n}topic"] for n in (1, 2, 3)] == [1, 2, 3]
    with outputs.table(tmp_path / "t.csv") as written:
        written.write(lying)
    [row] = read_table(tmp_path / "t.csv")
    assert row["number"] == str(2**64 - 1) and set(row) >= set(found)


def test_columns_that_hold_this_and_that_are_text(tmp_path):
    rows = [{"a": 1, "b": 1, "c": "NaN", "d": [1], "e": None, "f": [], "g": []},
            {"a": "x", "b": 2.5, "c": "y", "d": 7, "e": {}, "f": 1.5, "g": ["x"]}]  # fmt: skip
    table = parquet(tmp_path / "t.parquet", [record(n, "pkg/msg/A", row) for n, row in enumerate(rows)])
    assert {name: table[name].to_pylist() for name in "abcdfg"} == {
        "a": ["1", '"x"'], "b": [1.0, 2.5], "c": ["NaN", "y"], "d": ["[1]", "7"], "f": ["[]", "1.5"],
        "g": ["[]", '["x"]']}  # fmt: skip


def test_a_parquet_file_of_nothing_has_its_columns(tmp_path):
    assert parquet(tmp_path / "t.parquet", []).num_rows == 0


def test_without_pyarrow_a_parquet_file_is_refused_before_anything_is_read(tmp_path, monkeypatch):
    monkeypatch.setattr(outputs, "find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=r"pip install 'pysmcrypto\[table\]'"):
        outputs.check_table(tmp_path / "t.parquet")
    outputs.check_table(tmp_path / "t.csv")


def test_without_matplotlib_a_picture_is_refused_before_anything_is_read(tmp_path, monkeypatch):
    monkeypatch.setattr(outputs, "find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=r"pip install 'pysmcrypto\[plot\]'"):
        outputs.check_picture(tmp_path / "t.png")


# --- files that grow


def test_an_mcap_file_that_grows_is_whole_after_every_flush(tmp_path: Path):
    """Read by the format's own reader, by its index where there is one and as a stream, and by rosbags."""
    path, copy, own = tmp_path / "g.mcap", tmp_path / "copy.mcap", known("nav_msgs/msg/Odometry")
    odometry = {"child_frame_id": "base"}
    with outputs.bag(path, grows=True) as made:
        for n in range(4):
            made.write(point(n))
            if n > 1:
                made.write(record(n, "nav_msgs/msg/Odometry", odometry, topic="/odom", definition=own))
            made.flush()
            made.flush()
            copy.write_bytes(path.read_bytes())
            check_mcap(copy, ["/t"] * (n + 1) + ["/odom/partial"] * max(0, n - 1))
    check_mcap(path, ["/t"] * 4 + ["/odom/partial"] * 2)
    with path.open("rb") as file:
        summary = make_reader(file).get_summary()
    assert summary is not None and summary.statistics is not None
    assert (summary.statistics.message_count, len(summary.chunk_indexes)) == (6, 4)
    assert [one.name for one in tmp_path.iterdir() if one.name.startswith(".")] == []


def check_mcap(path: Path, topics: list[str]) -> None:
    for reader in (make_reader, NonSeekingReader):
        with path.open("rb") as file:
            found = list(reader(file).iter_messages())
            assert sorted(channel.topic for _, channel, _ in found) == sorted(topics)
            for schema, channel, message in found:
                assert (channel.message_encoding, schema.encoding) == ("cdr", "ros2msg")
                assert message.data and (b"float64" in schema.data or b"string" in schema.data)
    with path.open("rb") as file:
        assert make_reader(file).get_header().profile == "ros2"
    with AnyReader([path]) as bag:
        assert bag.message_count == len(topics)


def test_what_was_flushed_is_there_after_a_kill(tmp_path: Path):
    """The file between two flushes, and cut within the second, as a stream is read."""
    path, copy = tmp_path / "g.mcap", tmp_path / "copy.mcap"
    with outputs.bag(path, grows=True) as made:
        for n in range(3):
            made.write(point(n))
        made.flush()
        before = len(path.read_bytes())
        made.write(point(3))
        copy.write_bytes(path.read_bytes())
        check_mcap(copy, ["/t"] * 3)
        made.flush()
        for cut in (before, before + 10, len(path.read_bytes()) - 60):
            copy.write_bytes(path.read_bytes()[:cut])
            got = []
            with copy.open("rb") as file, suppress(EndOfFile, McapError, struct.error):
                for one in StreamReader(file).records:
                    got += [one] if isinstance(one, Message) else []
            assert len(got) in (3, 4)
