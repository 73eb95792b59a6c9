"""TCPROS bytes: what rospy writes is read, in any chunks; anything else is an error or passed over, within bounds."""

from __future__ import annotations

import itertools
import struct

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosbridge_eth.sources.ros1.errors import ProtocolError
from rosbridge_eth.sources.ros1.framing import (
    IMPLAUSIBLE,
    MAX_FIELDS,
    MAX_HEADER,
    Framer,
    Header,
    Message,
    PassedOver,
    decode_header,
    encode_header,
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
LIMIT = 1000


def length(value: int) -> bytes:
    return struct.pack("<I", value)


def read(framer: Framer, data: bytes, cuts: list[int] | None = None) -> list[object]:
    events: list[object] = []
    edges = [0, *sorted(min(cut, len(data)) for cut in cuts or []), len(data)]
    for start, end in itertools.pairwise(edges):
        events += framer.feed(data[start:end])
        assert framer.buffered <= max(LIMIT, MAX_HEADER)
    return events


@given(st.lists(st.integers(0, len(WIKI) + len(HELLO))))
def test_the_published_example_is_read_in_any_chunks(cuts):
    events = read(Framer(LIMIT), WIKI + HELLO, cuts)
    assert events == [
        Header(
            {
                "message_definition": "string data\n\n",
                "callerid": "/rostopic_4767_1316912741557",
                "latching": "1",
                "md5sum": "992ce8a1687cec8c8bd883ec73ca41d1",
                "topic": "/chatter",
                "type": "std_msgs/String",
            }
        ),
        Message(b"\x05\0\0\0hello"),
    ]


def test_what_a_subscriber_writes_is_framed_likewise():
    expected = length(30) + length(14) + b"topic=/chatter" + length(8) + b"md5sum=*"
    assert encode_header({"topic": "/chatter", "md5sum": "*"}) == expected


BODIES = st.lists(st.binary(max_size=LIMIT + 200), max_size=8)


@given(BODIES, st.lists(st.integers(0, 12_000), max_size=30))
def test_messages_come_out_as_they_were_framed_and_large_ones_are_passed_over(bodies, cuts):
    framer = Framer(LIMIT)
    stream = encode_header({"type": "a/B"}) + b"".join(length(len(body)) + body for body in bodies)
    assert read(framer, stream, cuts)[1:] == [
        Message(body) if len(body) <= LIMIT else PassedOver(len(body)) for body in bodies
    ]
    assert framer.between_messages
    assert framer.buffered == 0


@given(st.lists(st.binary(max_size=300), max_size=20), st.booleans())
def test_any_bytes_in_any_chunks_end_in_events_or_a_protocol_error(chunks, after_a_header):
    framer = Framer(LIMIT)
    if after_a_header:
        list(framer.feed(encode_header({})))
    try:
        for chunk in chunks:
            for event in framer.feed(chunk):
                assert isinstance(event, Header | Message | PassedOver)
            assert framer.buffered <= max(LIMIT, MAX_HEADER)
    except ProtocolError:
        pass


@given(st.integers(0, LIMIT - 1), st.binary(max_size=50))
def test_a_message_that_is_given_up_does_not_cost_the_next_one(arrived, following):
    framer = Framer(LIMIT)
    stream = encode_header({}) + length(LIMIT) + bytes(arrived)
    list(framer.feed(stream))
    assert framer.pass_over() == PassedOver(LIMIT)
    assert framer.buffered == 0
    rest = bytes(LIMIT - arrived) + length(len(following)) + following
    assert list(framer.feed(rest)) == [Message(following)]


def test_nothing_is_given_up_between_messages():
    framer = Framer(LIMIT)
    assert framer.pass_over() is None
    list(framer.feed(encode_header({}) + length(3) + b"abc" + b"\x01\0"))
    assert framer.pass_over() is None
    assert not framer.between_messages


@pytest.mark.parametrize(
    ("stream", "why"),
    [
        (length(MAX_HEADER + 1), "a connection header of"),
        (length(2**32 - 1), "a connection header of"),
        (length(3) + b"abc", "ends within a field's length"),
        (length(8) + length(5) + b"a=bc", "does not fit"),
        (length(8) + length(2**32 - 1) + b"a=bc", "does not fit"),
        (length(8) + length(4) + b"abcd", "not name=value"),
        (length(8) + length(4) + b"=bcd", "not name=value"),
        (length(8) + length(4) + b"\xff=cd", "not name=value"),
        (length(14) + length(3) + b"a=b" + length(3) + b"a=c", "has a twice"),
        (encode_header({f"f{n}": "" for n in range(MAX_FIELDS + 1)}), f"more than {MAX_FIELDS} fields"),
        (encode_header({}) + length(IMPLAUSIBLE + 1), "out of step"),
        (encode_header({}) + b"\xff\xff\xff\xff", "out of step"),
    ],
)
def test_what_tcpros_does_not_allow_is_refused(stream, why):
    with pytest.raises(ProtocolError, match=why):
        list(Framer(LIMIT).feed(stream))


def test_a_field_that_is_said_twice_with_one_value_says_nothing_wrong():
    assert decode_header(2 * (length(3) + b"a=b")) == {"a": "b"}


@given(st.dictionaries(st.from_regex(r"[a-z_]{1,20}", fullmatch=True), st.text(max_size=50).filter(str.isprintable)))
def test_headers_survive_the_round_trip(fields):
    assert decode_header(encode_header(fields)[4:]) == fields
