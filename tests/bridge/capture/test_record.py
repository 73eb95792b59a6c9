"""Captured records as bytes: one form, and nothing else is accepted."""

from __future__ import annotations

import json

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosbridge_eth.capture import CapturedRecord
from rosbridge_eth.errors import VerificationError

RECORD = CapturedRecord(
    "/robot_1/odom", "nav_msgs/msg/Odometry", 1795226223226026342, 2, 3, True, {"x": 0.1, "s": "ü"}, "reliable"
)
ENCODED = (
    '{"v":1,"topic":"/robot_1/odom","type":"nav_msgs/msg/Odometry","received_ns":1795226223226026342,'
    '"wall_ns":2,"mono_ns":3,"clock":true,"delivery":"reliable","data":{"x":0.1,"s":"ü"}}'
).encode()


def test_the_form_is_fixed():
    assert RECORD.to_json() == ENCODED
    assert CapturedRecord.from_json(ENCODED) == RECORD


values = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats(allow_nan=False, allow_infinity=False) | st.text(),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(st.text(), inner, max_size=4),
    max_leaves=20,
)


@given(st.dictionaries(st.text(), values, max_size=5), st.text(), st.integers())
def test_any_data_comes_back_equal(data, topic, moment):
    record = CapturedRecord(topic, "a/msg/B", moment, moment, moment, False, data, "latest")
    encoded = record.to_json()
    assert CapturedRecord.from_json(encoded) == record
    assert CapturedRecord.from_json(encoded).to_json() == encoded


def changed(**members: object) -> bytes:
    return json.dumps({**json.loads(ENCODED), **members}, separators=(",", ":"), ensure_ascii=False).encode()


@pytest.mark.parametrize(
    "encoded",
    [
        b"",
        b"null",
        b"[]",
        b"\xff",
        b"[" * 100_000,
        ENCODED[:-1],
        ENCODED + b" ",
        b" " + ENCODED,
        ENCODED.replace(b'"v":1', b'"v":2'),
        ENCODED.replace(b'"v":1', b'"v":true'),
        ENCODED.replace(b'"v":1', b'"v":1.0'),
        ENCODED.replace(b'"v":1', b'"v":1,"v":1'),
        ENCODED.replace(b'"v":1,', b""),
        ENCODED.replace(b"0.1", b"0.10"),
        ENCODED.replace(b"0.1", b"NaN"),
        ENCODED.replace(b"0.1", b"1e999"),
        ENCODED.replace(b"0.1", b"9" * 5000),
        ENCODED.replace("ü".encode(), b"\\ud800"),
        ENCODED.replace("ü".encode(), b"\\u00fc"),
        changed(topic=1),
        changed(received_ns="1"),
        changed(received_ns=1.5),
        changed(received_ns=True),
        changed(clock=1),
        changed(delivery="sometimes"),
        changed(data=[]),
        changed(more=1),
    ],
    ids=range(27),
)
def test_anything_else_is_refused(encoded):
    with pytest.raises(VerificationError):
        CapturedRecord.from_json(encoded)
