"""Lines of a log: one form, and nothing else is accepted, whatever is wrong with it."""

from __future__ import annotations

import contextlib
import json
import time

import orjson
import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosbridge_eth.capture import (
    LostLine,
    MessageLine,
    StreamLine,
    TriggerLine,
    TypeLine,
    Wire,
    decoder_for,
    definition_line,
    parse_line,
    stream_line,
    trigger_line,
)
from rosbridge_eth.capture.definitions import MAX_KEPT
from rosbridge_eth.errors import VerificationError
from rosbridge_eth.log.chunk import MAX_LINE

LINE = (
    '{"topic":"/robot_1/odom","type":"nav_msgs/msg/Odometry","source":"ros1","received_ns":1795226223226026342,'
    '"captured_ns":2,"clock":true,"data":{"x":0.1,"s":"ü\\n\\u0001"}}'
).encode()
MESSAGE = MessageLine(
    "/robot_1/odom", "nav_msgs/msg/Odometry", "ros1", 1795226223226026342, 2, True, {"x": 0.1, "s": "ü\n\x01"}
)
TYPE = b'{"type":"a/msg/B","wire":"ros1","format":"msg","definition":"int32 x\\n"}'


def test_the_five_kinds_of_line():
    assert parse_line(LINE) == MESSAGE
    assert parse_line(TYPE) == TypeLine("a/msg/B", "ros1", "msg", "int32 x\n")
    assert parse_line(b'{"lost":3,"topic":"/a","why":"dropped"}') == LostLine(3, "/a", "dropped")
    assert trigger_line("crash", "/b data == true", 7) == b'{"trigger":"crash","why":"/b data == true","at_ns":7}'
    assert parse_line(trigger_line("crash", "SIGUSR1", 7)) == TriggerLine("crash", "SIGUSR1", 7)
    assert stream_line("ros1", "rosbridge_eth 2.0") == b'{"stream":{"source":"ros1","software":"rosbridge_eth 2.0"}}'
    assert parse_line(stream_line("ros1", "rosbridge_eth 2.0")) == StreamLine("ros1", "rosbridge_eth 2.0")


def test_a_type_comes_back_from_its_line():
    decoder = decoder_for(Wire.ROS1, "a/B", "int32 x # a comment\n\nint8 C=1")
    line = definition_line(decoder)
    assert line == b'{"type":"a/msg/B","wire":"ros1","format":"msg","definition":"int32 x\\nint8 C=1\\n"}'
    again = parse_line(line).decoder()
    assert (again.type_name, again.wire, again.fields) == (decoder.type_name, decoder.wire, decoder.fields)
    assert definition_line(again) == line


@pytest.mark.parametrize(
    "line", [TYPE.replace(b"ros1", b"ros3"), TYPE.replace(b'"msg"', b'"idl"'), TYPE.replace(b"int32", b"int33"),
             TYPE.replace(b"a/msg/B", b"../B"), TYPE.replace(b"int32 x", b"uint8[99999999999] x")],
)  # fmt: skip
def test_a_type_that_cannot_be_is_found_when_it_is_needed(line):
    found = parse_line(line)
    with pytest.raises(VerificationError, match="a type in the log cannot be read"):
        found.decoder()


def test_no_definition_that_is_read_is_too_long_for_its_line():
    fields = "".join(f'string {"n" * 100}{n} "\\x01\\x01\\x01"\n' for n in range(300))
    decoder = decoder_for(Wire.ROS1, "a/" + "B" * 128, fields)
    assert MAX_KEPT // 2 < len(definition_line(decoder)) <= MAX_LINE
    parse_line(definition_line(decoder))


def message(data: object) -> bytes:
    return LINE[: LINE.index(b'{"x"')] + orjson.dumps(data) + b"}"


values = st.recursive(
    st.none() | st.booleans() | st.integers(-(2**63), 2**64 - 1)
    | st.floats(allow_nan=False, allow_infinity=False) | st.text(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
    max_leaves=20,
)  # fmt: skip


@given(st.dictionaries(st.text(), values, max_size=5))
def test_any_data_comes_back_equal(data):
    assert parse_line(message(data)).data == data
    # As another program writes the same: only its numbers may look different.
    other = json.dumps(data, ensure_ascii=False, separators=(",", ":")).encode()
    assert parse_line(message(data).replace(orjson.dumps(data), other)).data == data


@pytest.mark.parametrize("spelled", ["0.10", "1e-1", "1E-1", "0.1000000000000000055511151231257827"])
def test_a_number_may_be_spelled_in_any_way(spelled):
    assert parse_line(LINE.replace(b"0.1", spelled.encode())) == MESSAGE


DEEP = b'{"a":' * 99 + b"1" + b"}" * 99
REFUSED = {
    "nothing": b"",
    "null": b"null",
    "a list": b"[]",
    "not UTF-8": b"\xff",
    "an overlong form": LINE.replace("ü".encode(), b"\xc1\xbf"),
    "a surrogate in UTF-8": LINE.replace("ü".encode(), b"\xed\xa0\x80"),
    "too deep": b"[" * 100_000,
    "a little too deep": LINE.replace(b"0.1", DEEP),
    "cut off": LINE[:-1],
    "a space behind": LINE + b" ",
    "a line's end": LINE + b"\n",
    "a space before": b" " + LINE,
    "a space within": LINE.replace(b":2,", b": 2,"),
    "a tab within": LINE.replace(b":2,", b":\t2,"),
    "a byte order mark": b"\xef\xbb\xbf" + LINE,
    "another order": LINE.replace(b'"captured_ns":2,"clock":true', b'"clock":true,"captured_ns":2'),
    "a member twice": LINE.replace(b'"clock":true', b'"clock":true,"clock":true'),
    "a name in the data twice": LINE.replace(b'"x":0.1', b'"x":0.1,"x":0.1'),
    "a member too few": LINE.replace(b'"clock":true,', b""),
    "a member too many": LINE[:-1] + b',"more":1}',
    "NaN": LINE.replace(b"0.1", b"NaN"),
    "Infinity": LINE.replace(b"0.1", b"-Infinity"),
    "1e999": LINE.replace(b"0.1", b"1e999"),
    "10^400": LINE.replace(b"0.1", b"1" + b"0" * 400),
    "10^5000": LINE.replace(b"0.1", b"9" * 5000),
    "a leading zero": LINE.replace(b"0.1", b"00.1"),
    "half a surrogate pair": LINE.replace("ü".encode(), b"\\ud800"),
    "a needless escape": LINE.replace("ü".encode(), b"\\u00fc"),
    "another needless escape": LINE.replace(b"/robot_1", b"\\/robot_1"),
    "an escape in capitals": LINE.replace(b"\\n", b"\\u000A"),
    "a control character": LINE.replace(b"\\n", b"\n"),
    "a topic that is none": LINE.replace(b'"/robot_1/odom"', b"1"),
    "a time of 10^30": LINE.replace(b"1795226223226026342", b"1" + b"0" * 30),
    "a time of 2^63": LINE.replace(b"1795226223226026342", str(2**63).encode()),
    "a time before 1970": LINE.replace(b":2,", b":-2,"),
    "a time with a fraction": LINE.replace(b":2,", b":2.0,"),
    "a time that is text": LINE.replace(b":2,", b':"2",'),
    "a time that is true": LINE.replace(b":2,", b":true,"),
    "a clock that is 1": LINE.replace(b"true", b"1"),
    "data that is a list": message([]),
    "too long": message({"x": "y" * MAX_LINE}),
    "a stream within a stream": b'{"stream":{"stream":{"source":"a","software":"b"}}}',
    "a stream unwrapped": b'{"source":"a","software":"b"}',
    "a loss wrapped": b'{"stream":{"lost":3,"topic":"/a","why":"x"}}',
    "a loss below nothing": b'{"lost":-3,"topic":"/a","why":"x"}',
    "a stream that is none": b'{"stream":5}',
    "the first edition": b'{"v":1,"topic":"/a","type":"b","received_ns":1,"wall_ns":1,"mono_ns":1,"clock":true,'
                         b'"delivery":"reliable","data":{}}',
}  # fmt: skip


@pytest.mark.parametrize("line", REFUSED.values(), ids=REFUSED)
def test_anything_else_is_refused(line):
    assert line != LINE
    with pytest.raises(VerificationError):
        parse_line(line)


def test_the_depth_that_is_allowed_is_read():
    assert parse_line(LINE.replace(b"0.1", DEEP[5:-1])).data["x"]
    assert parse_line(message({"x": "[{" * 10_000})).data


@given(st.binary(max_size=60) | st.text(max_size=60).map(str.encode))
def test_any_bytes_are_a_line_or_refused(line):
    with contextlib.suppress(VerificationError):
        parse_line(line)


@given(st.integers(0, len(LINE) - 1), st.integers(0, 255))
def test_any_changed_byte_is_a_line_or_refused(position, byte):
    with contextlib.suppress(VerificationError):
        parse_line(LINE[:position] + bytes([byte]) + LINE[position + 1 :])


@pytest.mark.parametrize("filler", [b'"', b'\\"', b"\\", b'"\\', b"1", b"1e", b"-", b"[]", b'{"":'])
def test_hostile_lines_take_no_time(filler):
    line = LINE.replace(b"0.1", filler * ((MAX_LINE - len(LINE)) // len(filler)))
    started = time.process_time()
    with contextlib.suppress(VerificationError):
        parse_line(line)
    assert time.process_time() - started < 10
