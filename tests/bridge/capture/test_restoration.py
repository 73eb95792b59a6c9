"""Nothing is lost on the way: types and messages made at random, as bytes, to JSON, and back to the same bytes."""

from __future__ import annotations

import hashlib
import math
from struct import pack

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rosbridge_eth.capture import CapturedRecord, Conversion, Restoration, Wire, decoder_for
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


@given(st.data())
@settings(max_examples=60)
def test_ros_1_messages_come_back_byte_for_byte(data):
    lines, others, messages = data.draw(types())
    decoder = decoder_for(Wire.ROS1, "pkg/Type", f"\n{SEPARATOR}\n".join(["\n".join(lines), *others]))
    conversion = Conversion(decoder, limit=10**6)
    raw = data.draw(messages)
    record = CapturedRecord("/t", "pkg/msg/Type", 0, 0, 0, False, conversion.convert(decoder.decode(raw)), "reliable")
    restored = Restoration(decoder).restore(CapturedRecord.from_json(record.to_json()).data)
    assert restored.missing == ()
    assert decoder.encode(restored.message) == raw


@given(st.integers(0, 255), st.binary(max_size=5), st.integers(-(2**31), 2**31 - 1), st.text(max_size=5))
def test_ros_2_messages_come_back_byte_for_byte(octet, octets, seconds, words):
    decoder = decoder_for(Wire.CDR, "pkg/Type", "byte b\nbyte[] bs\nbuiltin_interfaces/Time t\nstring s")
    body = pack("<B", octet) + bytes(3) + pack("<I", len(octets)) + octets
    body += bytes(-len(body) % 4) + pack("<iI", seconds, 5)
    encoded = words.encode() + b"\x00"
    raw = b"\x00\x01\x00\x00" + body + pack("<I", len(encoded)) + encoded
    restored = Restoration(decoder).restore(Conversion(decoder).convert(decoder.decode(raw)))
    assert decoder.encode(restored.message) == raw


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
