"""Any message to JSON-ready data. Raw bytes are put together here with struct, from the wire formats' rules."""

from __future__ import annotations

import hashlib
import json
import math
from base64 import b64decode, b64encode
from struct import pack

import orjson
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosbridge_eth.capture import Conversion, DecodeError, Wire, decoder_for
from rosbridge_eth.capture.messages import MAX_ELEMENTS
from rosbridge_eth.capture.rules import parse_paths
from rosbridge_eth.errors import ConfigError


def sm3(data: bytes) -> str:
    try:
        return hashlib.new("sm3", data).hexdigest()
    except ValueError:
        pytest.skip("this OpenSSL has no SM3")


def string(text: str) -> bytes:
    encoded = text.encode()
    return pack("<I", len(encoded)) + encoded


def ros1(text: str, raw: bytes, *paths: str, **options):
    decoder = decoder_for(Wire.ROS1, "pkg/Type", text)
    conversion = Conversion(decoder, parse_paths(paths), **options)
    return conversion.convert(decoder.decode(raw))


def cdr(text: str, raw: bytes):
    decoder = decoder_for(Wire.CDR, "pkg/Type", text)
    return Conversion(decoder).convert(decoder.decode(b"\x00\x01\x00\x00" + raw))


@pytest.mark.parametrize(
    ("kind", "raw", "expected"),
    [
        ("bool", b"\x01", True),
        ("bool", b"\x00", False),
        ("int8", b"\xff", -1),
        ("uint8", b"\xff", 255),
        ("byte", b"\xff", -1),  # wiki.ros.org/msg: byte is a deprecated alias of int8
        ("char", b"\xff", 255),  # and char of uint8
        ("int16", b"\x00\x80", -(2**15)),
        ("uint16", b"\xff\xff", 2**16 - 1),
        ("int32", b"\x00\x00\x00\x80", -(2**31)),
        ("uint32", b"\xff" * 4, 2**32 - 1),
        ("int64", b"\x00" * 7 + b"\x80", -(2**63)),
        ("uint64", b"\xff" * 8, 2**64 - 1),
        ("float64", pack("<d", 0.1), 0.1),
        ("float64", pack("<d", -0.0), -0.0),
        ("float32", pack("<f", 0.1), 0.10000000149011612),
        ("float64", pack("<d", math.nan), "NaN"),
        ("float64", pack("<d", math.inf), "Infinity"),
        ("float32", pack("<f", -math.inf), "-Infinity"),
        ("string", string("Größe \U0001f916"), "Größe \U0001f916"),
        ("string", string('"\\\n\x00'), '"\\\n\x00'),
        ("time", pack("<II", 1, 2), 1_000_000_002),
        ("time", pack("<II", 2**32 - 1, 999_999_999), 4294967295_999999999),  # the year 2106: unsigned
        ("duration", pack("<ii", -1, 500_000_000), -500_000_000),
        ("duration", pack("<ii", 0, -1), -1),
        ("duration", pack("<ii", -(2**31), 0), -(2**31) * 10**9),
        ("uint8[]", pack("<I", 3) + b"\x00\xff\x10", b64encode(b"\x00\xff\x10").decode()),
        ("uint8[2]", b"\xfe\xed", b64encode(b"\xfe\xed").decode()),
        ("char[]", pack("<I", 2) + b"hi", b64encode(b"hi").decode()),
        ("byte[]", pack("<I", 2) + b"\xff\x01", b64encode(b"\xff\x01").decode()),
        ("uint8[]", pack("<I", 0), ""),
        ("int8[]", pack("<I", 2) + b"\xff\x01", [-1, 1]),
        ("bool[2]", b"\x01\x00", [True, False]),
        ("int16[]", pack("<I2h", 2, -5, 5), [-5, 5]),
        ("uint64[1]", b"\xff" * 8, [2**64 - 1]),
        ("float64[3]", pack("<3d", 1.5, math.nan, -math.inf), [1.5, "NaN", "-Infinity"]),
        ("float32[]", pack("<I1f", 1, 0.1), [0.10000000149011612]),
        ("string[]", pack("<I", 2) + string("a") + string(""), ["a", ""]),
        ("string[2]", string("x") + string("y"), ["x", "y"]),
        ("time[]", pack("<I2I", 1, 1, 1), [1_000_000_001]),
        ("int32[]", pack("<I", 0), []),
    ],
)
def test_every_kind_of_field(kind, raw, expected):
    data = ros1(f"{kind} x", raw)
    assert data == {"x": expected}
    assert json.loads(orjson.dumps(data)) == {"x": expected}
    assert math.copysign(1, data["x"]) == math.copysign(1, expected) if isinstance(expected, float) else True
    assert type(data["x"]) is type(expected)


@pytest.mark.parametrize(
    ("kind", "raw", "expected"),
    [
        ("byte", b"\xff", 255),  # ROS 2: an octet
        ("byte[]", pack("<I", 2) + b"\xff\x01", b64encode(b"\xff\x01").decode()),
        ("char", b"\xff", 255),
        ("string", pack("<I", 3) + b"hi\x00", "hi"),
        ("string<=5[<=2]", pack("<II", 1, 2) + b"a\x00", ["a"]),
        ("builtin_interfaces/Time", pack("<iI", -1, 5), -999_999_995),  # ROS 2: signed seconds
        ("builtin_interfaces/Duration", pack("<iI", -1, 500_000_000), -500_000_000),
        ("float64[2]", pack("<2d", 1, math.inf), [1.0, "Infinity"]),
    ],
)
def test_what_differs_in_ros_2(kind, raw, expected):
    assert cdr(f"{kind} x", raw) == {"x": expected}


def test_big_endian_cdr():
    decoder = decoder_for(Wire.CDR, "pkg/Type", "uint16 a\nfloat64[2] b")
    raw = b"\x00\x00\x00\x00" + pack(">H6x2d", 258, 1.5, -2.0)
    assert Conversion(decoder).convert(decoder.decode(raw)) == {"a": 258, "b": [1.5, -2.0]}


NESTED = (
    "Inner one\nInner[] many\nInner[2] two\nEmpty nothing\nint32 class\nint32 CONSTANT=9\n"
    + "=" * 80
    + "\nMSG: pkg/Inner\nint32 x\nstring name\n"
    + "=" * 80
    + "\nMSG: pkg/Empty\n"
)
NESTED_RAW = (
    pack("<i", 1) + string("one")
    + pack("<I", 2) + pack("<i", 2) + string("a") + pack("<i", 3) + string("b")
    + pack("<i", 4) + string("c") + pack("<i", 5) + string("d")
    + pack("<i", 6)
)  # fmt: skip
NESTED_DATA = {
    "one": {"x": 1, "name": "one"},
    "many": [{"x": 2, "name": "a"}, {"x": 3, "name": "b"}],
    "two": [{"x": 4, "name": "c"}, {"x": 5, "name": "d"}],
    "nothing": {},
    "class": 6,
}


def test_nested_messages_keep_their_shape_and_order():
    data = ros1(NESTED, NESTED_RAW)
    assert data == NESTED_DATA
    assert list(data) == list(NESTED_DATA), "in the order of the definition"


@pytest.mark.parametrize(
    ("paths", "expected"),
    [
        (["*"], NESTED_DATA),
        (["one"], {"one": {"x": 1, "name": "one"}}),
        (["one.x"], {"one": {"x": 1}}),
        (["class", "one.name"], {"one": {"name": "one"}, "class": 6}),
        (["one.x", "one"], {"one": {"x": 1, "name": "one"}}),
        (["many"], {"many": NESTED_DATA["many"]}),
        (["many[*].x"], {"many": [{"x": 2}, {"x": 3}]}),
        (["many[1]"], {"many": {"1": {"x": 3, "name": "b"}}}),
        (["many[1].name", "many[0].x"], {"many": {"0": {"x": 2}, "1": {"name": "b"}}}),
        (["many[7].x"], {"many": {}}),
        (["many[2].x", "many[1].x"], {"many": {"1": {"x": 3}}}),
        (["two[1].x"], {"two": {"1": {"x": 5}}}),
        (["nothing"], {"nothing": {}}),
    ],
)
def test_fields_are_selected(paths, expected):
    assert ros1(NESTED, NESTED_RAW, *paths) == expected


def test_elements_of_arrays_of_numbers_are_selected():
    raw = pack("<I3d", 3, 1.0, math.nan, 3.0)
    assert ros1("float64[] ranges", raw, "ranges[0]", "ranges[1]", "ranges[9]") == {"ranges": {"0": 1.0, "1": "NaN"}}
    assert ros1("float64[] ranges", raw, "ranges[*]") == {"ranges": [1.0, "NaN", 3.0]}
    element = ros1("uint8[] data", pack("<I", 2) + b"\x07\x08", "data[1]")
    assert element == {"data": {"1": 8}}
    assert orjson.dumps(element) == b'{"data":{"1":8}}'
    assert orjson.dumps(ros1("bool[2] flags", b"\x01\x00", "flags[0]")) == b'{"flags":{"0":true}}'
    assert ros1("byte[1] b", b"\xff", "b[0]") == {"b": {"0": -1}}


@pytest.mark.parametrize(
    ("path", "words"),
    [
        ("oen", "has no field 'oen'; it has: one, "),
        ("one.y", "has no field 'y'; it has: x, name"),
        ("one[0]", "is not an array"),
        ("one.x.y", "nothing can be selected"),
        ("many.x", r"write many\[\*\] or many\[0\]"),
        ("class[0]", "nothing can be selected"),
        ("nothing.x", "no fields"),
    ],
)
def test_a_wrong_path_says_what_there_is(path, words):
    with pytest.raises(ConfigError, match=words):
        ros1(NESTED, NESTED_RAW, path)


def test_nothing_is_selected_inside_a_time():
    with pytest.raises(ConfigError, match="nanoseconds"):
        ros1("time t", bytes(8), "t.sec")


def test_a_field_above_the_limit_becomes_its_digest():
    limit = 1024
    for size in (limit, limit + 1):
        content = bytes(range(256)) * 4 + b"x" * (size - 1024)
        expected = b64encode(content).decode() if size == limit else {"sm3": sm3(content), "length": size}
        assert ros1("uint8[] d", pack("<I", size) + content, limit=limit) == {"d": expected}
    text = "ü" * 513
    assert ros1("string s", string(text), limit=limit) == {"s": {"sm3": sm3(text.encode()), "length": 1026}}
    assert ros1("string s", string("ü" * 512), limit=limit) == {"s": "ü" * 512}
    numbers = pack("<129d", *range(129))
    assert ros1("float64[] n", pack("<I", 129) + numbers, limit=limit) == {"n": {"sm3": sm3(numbers), "length": 1032}}
    assert ros1("float64[] n", pack("<I", 128) + numbers[:1024], limit=limit) == {"n": [float(n) for n in range(128)]}
    names = [f"name {n}" for n in range(200)]
    listed = json.dumps(names, separators=(",", ":")).encode()
    raw = pack("<I", 200) + b"".join(map(string, names))
    assert ros1("string[] s", raw, limit=limit) == {"s": {"sm3": sm3(listed), "length": len(listed)}}


def test_only_selected_fields_are_measured():
    raw = pack("<I", 5000) + bytes(5000) + pack("<i", 3)
    assert ros1("uint8[] big\nint32 x", raw, "x", limit=1024) == {"x": 3}


def test_a_scan_and_its_neighbours_are_whole_by_default():
    ranges = [0.5 * n for n in range(360)]
    assert ros1("float32[] ranges", pack("<I360f", 360, *ranges)) == {"ranges": ranges}
    assert ros1("float64[36] covariance", pack("<36d", *range(36)))["covariance"] == list(map(float, range(36)))


def test_an_array_whose_sum_overflows_is_one_of_finite_numbers():
    largest = [1.7e308] * 3
    assert ros1("float64[3] x", pack("<3d", *largest)) == {"x": largest}


def test_arrays_within_arrays_and_every_kind_of_value_in_them():
    text = (
        "Row[] rows\n" + "=" * 80 + "\nMSG: pkg/Row\nCell[2] cells\nstring[] names\ntime[] at\nfloat32 f\n"
        + "=" * 80 + "\nMSG: pkg/Cell\nstring s\nfloat64 d\nuint8[] b"
    )
    cell = string("c") + pack("<d", math.nan) + pack("<I", 1) + b"\x07"
    row = cell * 2 + pack("<I", 2) + string("a") + string("b") + pack("<III", 1, 3, 4) + pack("<f", 0.5)
    cells = [{"s": "c", "d": "NaN", "b": "Bw=="}] * 2
    expected = {"cells": cells, "names": ["a", "b"], "at": [3_000_000_004], "f": 0.5}
    assert ros1(text, pack("<I", 2) + row * 2) == {"rows": [expected] * 2}
    assert ros1(text, pack("<I", 1) + row, "rows[*].cells[1].d", "rows[*].at") == {
        "rows": [{"cells": {"1": {"d": "NaN"}}, "at": [3_000_000_004]}]
    }


def test_a_digest_of_a_big_endian_array_is_that_of_the_little_endian_one():
    decoder = decoder_for(Wire.CDR, "pkg/Type", "int32[] n")
    converted = [
        Conversion(decoder, limit=8).convert(decoder.decode(header + pack(f"{order}I3i", 3, 1, 2, 3)))
        for order, header in (("<", b"\x00\x01\x00\x00"), (">", b"\x00\x00\x00\x00"))
    ]
    assert converted[0] == converted[1] == {"n": {"sm3": sm3(pack("<3i", 1, 2, 3)), "length": 12}}


@pytest.mark.parametrize(
    ("text", "raw"),
    [
        ("int32 x", b"\x00\x00\x00"),
        ("int32 x", b"\x00" * 5),
        ("string s", pack("<I", 100) + b"short"),
        ("string s", pack("<I", 2**32 - 1)),
        ("string s", pack("<I", 2) + b"\xff\xfe"),  # not UTF-8
        ("float64[] x", pack("<I", 2**32 - 1) + bytes(8)),
        ("string[] x", pack("<I", 2**32 - 1)),
        ("Inner[] x\n" + "=" * 80 + "\nMSG: pkg/Inner\nint8 x", pack("<I", 2**32 - 1) + bytes(100)),
        ("uint8[4] x", b"\x00"),
    ],
)
def test_bytes_that_do_not_fit_the_definition_are_undecodable(text, raw):
    decoder = decoder_for(Wire.ROS1, "pkg/Type", text)
    with pytest.raises(DecodeError):
        decoder.decode(raw)


def test_a_message_that_would_become_too_many_objects_is_not_decoded():
    decoder = decoder_for(Wire.ROS1, "pkg/Type", "Inner[] x\n" + "=" * 80 + "\nMSG: pkg/Inner\nint8 x")
    with pytest.raises(DecodeError, match="at most"):
        decoder.decode(pack("<I", MAX_ELEMENTS) + bytes(MAX_ELEMENTS))
    # An image of six megabytes is one object.
    image = decoder_for(Wire.ROS1, "pkg/Type", "uint8[] data")
    assert len(image.decode(pack("<I", 6_220_800) + bytes(6_220_800)).data) == 6_220_800


def test_base64_gives_the_bytes_back():
    content = bytes(range(256))
    assert b64decode(ros1("uint8[256] d", content)["d"], validate=True) == content


EVERYTHING_AT_ONCE = (
    "Inner[] many\nInner[2] two\nstring[] names\nfloat32[] floats\nbool[] flags\nuint8[] data\n"
    "time[] times\nduration d\nEmpty e\nint64 last\n"
    + "=" * 80
    + "\nMSG: pkg/Inner\nstring name\nfloat64[2] pair\nint8 x\n"
    + "=" * 80
    + "\nMSG: pkg/Empty\n"
)


@given(st.binary(max_size=200) | st.lists(st.sampled_from([0, 0, 0, 1, 2, 255]), max_size=300).map(bytes))
@pytest.mark.parametrize("wire", list(Wire))
def test_any_bytes_are_a_message_or_undecodable(wire, raw):
    decoder = decoder_for(wire, "pkg/Type", EVERYTHING_AT_ONCE)
    if wire is Wire.CDR:
        raw = b"\x00\x01\x00\x00" + raw
    try:
        message = decoder.decode(raw)
    except DecodeError:
        return
    json.loads(orjson.dumps(Conversion(decoder).convert(message)))
