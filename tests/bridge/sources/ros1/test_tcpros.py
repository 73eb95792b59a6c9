"""TCPROS bytes: what rospy writes is read, however it trickles in; anything else is an error, within bounds."""

from __future__ import annotations

import contextlib
import io
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosbridge_eth.robot.sources.ros1.api import ProtocolError
from rosbridge_eth.robot.sources.ros1.tcpros import (
    IMPLAUSIBLE,
    MAX_HEADER,
    encode_header,
    pass_over,
    read_exactly,
    read_header,
    read_length,
)

# The connection header of wiki.ros.org/ROS/Connection Header, in its own bytes.
WIKI = bytes.fromhex(
    "b0000000"
    "20000000" "6d6573736167655f646566696e6974696f6e3d737472696e6720646174610a0a"
    "25000000" "63616c6c657269643d2f726f73746f7069635f343736375f31333136393132373431353537"
    "0a000000" "6c61746368696e673d31"
    "27000000" "6d643573756d3d39393263653861313638376365633863386264383833656337336361343164"
    "31"
    "0e000000" "746f7069633d2f63686174746572"
    "14000000" "747970653d7374645f6d7367732f537472696e67"
)  # fmt: skip
HELLO = bytes.fromhex("09000000" "05000000" "68656c6c6f")


class Trickling(io.RawIOBase):
    """Gives the bytes in pieces of these sizes, the rest one by one."""

    def __init__(self, data: bytes, sizes: list[int]) -> None:
        self._data, self._sizes = data, sizes

    def readable(self) -> bool:
        return True

    def readinto(self, buffer) -> int:
        size = min(len(buffer), self._sizes.pop(0) if self._sizes else 1, len(self._data))
        buffer[:size], self._data = self._data[:size], self._data[size:]
        return size


def stream(data: bytes, sizes: list[int] | None = None) -> io.BufferedReader:
    return io.BufferedReader(Trickling(data, list(sizes or [])))


def length(value: int) -> bytes:
    return struct.pack("<I", value)


SIZES = st.lists(st.integers(1, 300))


@given(SIZES)
def test_the_published_example_is_read_in_any_pieces(sizes):
    found = stream(WIKI + HELLO, sizes)
    assert read_header(found) == {
        "message_definition": "string data\n\n",
        "callerid": "/rostopic_4767_1316912741557",
        "latching": "1",
        "md5sum": "992ce8a1687cec8c8bd883ec73ca41d1",
        "topic": "/chatter",
        "type": "std_msgs/String",
    }
    assert read_exactly(found, read_length(found)) == b"\x05\0\0\0hello"
    with pytest.raises(EOFError):
        read_length(found)


def test_what_a_subscriber_writes_is_framed_likewise():
    expected = length(30) + length(14) + b"topic=/chatter" + length(8) + b"md5sum=*"
    assert encode_header({"topic": "/chatter", "md5sum": "*"}) == expected


@given(st.lists(st.tuples(st.binary(max_size=400), st.booleans()), max_size=8), SIZES)
def test_messages_come_out_as_they_were_framed_beside_those_passed_over(messages, sizes):
    found = stream(b"".join(length(len(body)) + body for body, _ in messages), sizes)
    for body, kept in messages:
        size = read_length(found)
        assert size == len(body)
        assert not kept or read_exactly(found, size) == body
        if not kept:
            pass_over(found, size)


@given(st.binary(max_size=300))
def test_any_bytes_are_a_header_or_an_error(data):
    for header in (data, length(len(data)) + data):
        with contextlib.suppress(ProtocolError, EOFError):
            assert all(isinstance(value, str) for value in read_header(stream(header)).values())


@pytest.mark.parametrize(
    ("data", "why"),
    [
        (length(MAX_HEADER + 1), "a connection header of"),
        (length(2**32 - 1), "out of step"),
        (length(8) + length(5) + b"a=bc", "does not fit"),
        (length(8) + length(4) + b"abcd", "not name=value"),
    ],
)
def test_a_header_that_is_none_is_refused(data, why):
    with pytest.raises(ProtocolError, match=why):
        read_header(stream(data))


@pytest.mark.parametrize("size", [IMPLAUSIBLE + 1, 2**32 - 1])
def test_a_message_that_cannot_be_is_out_of_step(size):
    with pytest.raises(ProtocolError, match="out of step"):
        read_length(stream(length(size)))


@given(st.dictionaries(st.from_regex(r"[a-z_]{1,20}", fullmatch=True), st.text(max_size=50).filter(str.isprintable)))
def test_headers_survive_the_round_trip(fields):
    assert read_header(stream(encode_header(fields))) == fields
