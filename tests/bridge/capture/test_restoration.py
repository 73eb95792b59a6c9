"""Nothing is lost on the way: types and messages made at random, as bytes, to JSON, and back to the same bytes."""

from __future__ import annotations

import hashlib
import math
from pathlib import Path
from struct import pack

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from rosbags import rosbag1, rosbag2
from rosbags.highlevel import AnyReader
from rosbags.typesys import Stores, get_typestore

from rosbridge_eth.capture import (
    Capture,
    RawMessage,
    Restoration,
    TopicRule,
    Wire,
    decoder_for,
    decoder_for_known,
    definition_line,
    parse_line,
)
from rosbridge_eth.errors import VerificationError

INTEGERS = {"int8": "b", "uint8": "B", "byte": "b", "char": "B", "int16": "h", "uint16": "H", "int32": "i",
            "uint32": "I", "int64": "q", "uint64": "Q"}  # fmt: skip
FLOATS = {"float32": "f", "float64": "d"}
SEPARATOR = "=" * 80

names = st.from_regex(r"[a-z][a-z0-9_]{0,8}", fullmatch=True)


@st.composite
def scalars(draw):
    """A built-in type of ROS 1 and a strategy for its bytes."""
    kind = draw(st.sampled_from([*INTEGERS, *FLOATS, "bool", "string", "time", "duration"]))
    if kind in INTEGERS:
        code = "<" + INTEGERS[kind]
        bits = 8 * len(pack(code, 0))
        low, high = (0, 2**bits - 1) if code[1].isupper() else (-(2 ** (bits - 1)), 2 ** (bits - 1) - 1)
        return kind, st.integers(low, high).map(lambda value: pack(code, value))
    if kind in FLOATS:
        width = 32 if kind == "float32" else 64
        # One NaN: JSON has no room for the other 2**52.
        values = st.floats(width=width, allow_nan=False) | st.just(math.nan)
        return kind, values.map(lambda value: pack("<" + FLOATS[kind], value))
    if kind == "bool":
        return kind, st.booleans().map(lambda value: pack("<?", value))
    if kind == "string":
        return kind, st.text(max_size=12).map(lambda s: pack("<I", len(s.encode())) + s.encode())
    seconds = st.integers(0, 2**32 - 1) if kind == "time" else st.integers(-(2**31), 2**31 - 1)
    code = "<II" if kind == "time" else "<iI"
    return kind, st.tuples(seconds, st.integers(0, 10**9 - 1)).map(lambda parts: pack(code, *parts))


@st.composite
def types(draw, depth=0):
    """(definition lines, definitions of other types, strategy for the bytes) of a message type."""
    lines, others, strategies = [], [], []
    for name in draw(st.lists(names, min_size=1, max_size=4, unique=True)):
        if depth < 2 and draw(st.integers(0, 3)) == 0:
            inner_lines, inner_others, element = draw(types(depth=depth + 1))
            content = "\n".join(inner_lines)
            kind = f"T{hashlib.md5(content.encode()).hexdigest()}"  # equal names, equal definitions
            others += [f"MSG: pkg/{kind}\n{content}", *inner_others]
        else:
            kind, element = draw(scalars())
        shape = draw(st.sampled_from(["", "", "[]", "[3]"]))
        if shape == "[]":
            element = st.lists(element, max_size=4).map(lambda parts: pack("<I", len(parts)) + b"".join(parts))
        elif shape:
            element = st.tuples(element, element, element).map(b"".join)
        lines.append(f"{kind}{shape} {name}")
        strategies.append(element)
    return lines, others, st.tuples(*strategies).map(b"".join)


def through_a_log(decoder, raw: bytes, wire: Wire | None = None):
    """The bytes that a reader makes of a message, who has two lines and nothing else; and what is missing in them."""
    capture = Capture([TopicRule("/t", limit=10**6)], source_kind="bag")
    line = capture.process(RawMessage("/t", decoder.type_name, 0, raw, decoder), 0).line
    restoration = Restoration(parse_line(definition_line(decoder)).decoder(), wire)
    restored = restoration.restore(parse_line(line).data)
    return restoration.decoder.encode(restored.message), restored.missing


@given(st.data())
@settings(max_examples=60)
def test_ros_1_messages_come_back_byte_for_byte(data):
    lines, others, messages = data.draw(types())
    decoder = decoder_for(Wire.ROS1, "pkg/Type", f"\n{SEPARATOR}\n".join(["\n".join(lines), *others]))
    raw = data.draw(messages)
    restored, missing = through_a_log(decoder, raw)
    assert missing == ()
    assert restored == raw


@given(st.integers(0, 255), st.binary(max_size=5), st.integers(0, 2**31 - 1), st.text(max_size=5))
def test_ros_2_messages_come_back_byte_for_byte(octet, octets, seconds, words):
    decoder = decoder_for(Wire.CDR, "pkg/Type", "byte b\nbyte[] bs\nbuiltin_interfaces/Time t\nstring s")
    body = pack("<B", octet) + bytes(3) + pack("<I", len(octets)) + octets
    body += bytes(-len(body) % 4) + pack("<iI", seconds, 5)
    encoded = words.encode() + b"\x00"
    raw = b"\x00\x01\x00\x00" + body + pack("<I", len(encoded)) + encoded
    assert through_a_log(decoder, raw) == (raw, ())
    # As a message of ROS 1 and back, it is the same.
    as_ros1, _ = through_a_log(decoder, raw, Wire.ROS1)
    ros1 = decoder_for(Wire.ROS1, "pkg/Type", "byte b\nbyte[] bs\ntime t\nstring s")
    assert through_a_log(ros1, as_ros1, Wire.CDR) == (raw, ())


TEXT = (
    "int32 x\nInner one\nInner[] many\nfloat64[2] two\nuint8[] data\nstring s\ntime t\nInner[2] pair\n"
    f"{SEPARATOR}\nMSG: pkg/Inner\nint32 y\nstring name"
)


def test_what_was_not_captured_is_zero_and_named():
    restoration = Restoration(decoder_for(Wire.ROS1, "pkg/Type", TEXT))
    digest = {"sm3": "00" * 32, "length": 2000}
    restored = restoration.restore({"one": {"y": 3}, "many": {"2": {"y": 1}}, "data": digest, "two": digest, "t": 5})
    message = restored.message
    assert (message.x, message.one.y, message.one.name, message.s, message.t.nanosec) == (0, 3, "", "", 5)
    assert (len(message.many), message.two.tolist(), len(message.data), len(message.pair)) == (0, [0.0, 0.0], 0, 2)
    assert set(restored.missing) == {"x", "one.name", "many", "data", "two", "s", "pair"}


@pytest.mark.parametrize(
    "data",
    [
        {"x": 2**31},
        {"x": 1.0},
        {"x": True},
        {"x": "1"},
        {"x": None},
        {"unknown": 1},
        {"one": 5},
        {"one": {"z": 1}},
        {"many": 5},
        {"many": [5]},
        {"two": [1.0]},
        {"two": ["nan", "inf"]},
        {"two": [1.0, 10**400]},
        {"data": "not base64!"},
        {"data": [1, 2]},
        {"s": 5},
        {"t": 2**32 * 10**9},
        {"t": -1},
        {"t": 1.5},
        {"pair": [{"y": 1}]},
    ],
    ids=str,
)
def test_data_that_does_not_fit_the_type_is_refused(data):
    with pytest.raises(VerificationError, match="does not fit"):
        Restoration(decoder_for(Wire.ROS1, "pkg/Type", TEXT)).restore(data)


def test_a_float32_holds_its_largest_value_and_no_larger_one():
    largest = 3.4028234663852886e38
    restoration = Restoration(decoder_for(Wire.ROS1, "pkg/Type", "float32 f\nfloat32[] fs"))
    restored = restoration.restore({"f": largest, "fs": [-largest, "NaN"]})
    assert (restored.message.f, restored.message.fs[0]) == (largest, -largest)
    for data in ({"f": 3.5e38}, {"fs": [-3.5e38]}, {"f": 1e308}):
        with pytest.raises(VerificationError, match="does not fit"):
            restoration.restore(data)


ODOMETRY = "nav_msgs/msg/Odometry"


def odometry(wire: Wire) -> bytes:
    """The same message in both wire forms; ROS 1's has a sequence number, 7."""
    store = get_typestore(Stores.ROS1_NOETIC if wire is Wire.ROS1 else Stores.ROS2_KILTED)
    types = store.types
    stamp = types["builtin_interfaces/msg/Time"](5, 6)
    header = types["std_msgs/msg/Header"](*([7] if wire is Wire.ROS1 else []), stamp, "odom")
    whole = decoder_for_known(wire, ODOMETRY)
    absent = Restoration(whole).restore({}).message
    message = types[ODOMETRY](header, "base", absent.pose, absent.twist)
    write = store.serialize_ros1 if wire is Wire.ROS1 else store.serialize_cdr
    return bytes(write(message, ODOMETRY))


@pytest.mark.parametrize(("wire", "other"), [(Wire.ROS1, Wire.CDR), (Wire.CDR, Wire.ROS1)])
def test_only_the_sequence_number_of_a_header_differs_between_ros_1_and_ros_2(wire, other):
    decoder = decoder_for_known(wire, ODOMETRY)
    restored, missing = through_a_log(decoder, odometry(wire), other)
    expected = odometry(other)
    assert missing == ()
    assert restored == (expected if other is Wire.CDR else bytes(4) + expected[4:])


def test_types_are_to_ros_what_they_are_to_it():
    """The sums by which ROS 1 and ROS 2 know a type, from the definition of the other."""
    kilted, noetic = get_typestore(Stores.ROS2_KILTED), get_typestore(Stores.ROS1_NOETIC)
    compared = 0
    for name in sorted(kilted.fielddefs.keys() & noetic.fielddefs.keys()):
        same = [field for field, _ in kilted.fielddefs[name][1]] == [field for field, _ in noetic.fielddefs[name][1]]
        if not same and name != "std_msgs/msg/Header":
            continue  # it was changed between them
        try:
            from_ros2 = decoder_for_known(Wire.CDR, name, "kilted")
            rewired = Restoration(decoder_for_known(Wire.ROS1, name), Wire.CDR).connection
        except Exception as error:
            assert "wstring" in str(error)
            continue
        if rewired["rihs01"] == kilted.hash_rihs01(name):
            compared += 1
            assert Restoration(from_ros2).connection["rihs01"] == rewired["rihs01"]
    assert compared > 60


CUSTOM = (
    "# A type that no package has.\nuint8 OK=0\nHeader header\nReading[] readings\nbyte state\nduration[2] spans\n"
    f"{SEPARATOR}\nMSG: std_msgs/Header\nuint32 seq\ntime stamp\nstring frame_id\n"
    f"{SEPARATOR}\nMSG: fleet_msgs/Reading\nstring name\nfloat32[3] values\n"
)
CUSTOM_RAW = (
    pack("<III", 7, 5, 6) + pack("<I", 3) + b"map"
    + pack("<I", 1) + pack("<I", 1) + b"r" + pack("<3f", 1, 2, 3)
    + b"\xff" + pack("<iIiI", 1, 2, -3, 4)
)  # fmt: skip


@pytest.mark.parametrize("kind", ["bag", "mcap", "folder"])
def test_a_type_that_nobody_knows_becomes_a_bag_of_any_kind(tmp_path: Path, kind):
    """Written by rosbags' writers with what `connection` says, read by its readers with the bag's own definition."""
    decoder = decoder_for(Wire.ROS1, "fleet_msgs/Report", CUSTOM)
    wire = Wire.ROS1 if kind == "bag" else Wire.CDR
    capture = Capture([TopicRule("/t")], source_kind="ros1")
    data = parse_line(capture.process(RawMessage("/t", decoder.type_name, 0, CUSTOM_RAW, decoder), 0).line).data
    restoration = Restoration(parse_line(definition_line(decoder)).decoder(), wire)
    path = tmp_path / ("some.bag" if kind == "bag" else "some")
    plugin = rosbag2.StoragePlugin.MCAP if kind == "mcap" else rosbag2.StoragePlugin.SQLITE3
    with rosbag1.Writer(path) if kind == "bag" else rosbag2.Writer(path, version=9, storage_plugin=plugin) as writer:
        connection = writer.add_connection("/t", decoder.type_name, **restoration.connection)
        writer.write(connection, 1, restoration.decoder.encode(restoration.restore(data).message))
    with AnyReader([path]) as reader:
        [(connection, _, raw)] = reader.messages()
        message = reader.deserialize(raw, connection.msgtype)
        assert "uint8 OK=0" in connection.msgdef.data or kind != "bag"
    assert hasattr(message.header, "seq") is (kind == "bag")
    assert (message.header.stamp.sec, message.header.frame_id) == (5, "map")
    assert (message.readings[0].name, message.readings[0].values.tolist()) == ("r", [1.0, 2.0, 3.0])
    assert (message.spans[1].sec, message.spans[1].nanosec, message.state & 0xFF) == (-3, 4, 0xFF)
    if kind == "bag":
        assert bytes(raw) == CUSTOM_RAW
        assert connection.digest == decoder.definition.md5


def test_what_ros_1_does_not_have_is_refused():
    decoder = decoder_for(Wire.CDR, "a/action/B_Feedback", "int32 x")
    with pytest.raises(VerificationError, match="no messages of actions"):
        Restoration(decoder, Wire.ROS1)
    later = decoder_for(Wire.ROS1, "a/B", "time t")
    with pytest.raises(VerificationError, match="does not fit"):  # ROS 2's time is signed, and ends in 2038
        Restoration(later, Wire.CDR).restore({"t": 2**31 * 10**9})
