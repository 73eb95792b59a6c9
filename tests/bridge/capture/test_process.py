"""From raw message to line: what is counted, said and declared lost, and that equal messages give equal bytes."""

from __future__ import annotations

from struct import pack

import pytest

from rosbridge_eth.capture import Capture as AnyCapture
from rosbridge_eth.capture import (
    LostLine,
    MessageLine,
    RawMessage,
    Record,
    TopicRule,
    Wire,
    decoder_for,
    definition_line,
    parse_line,
)
from rosbridge_eth.capture.process import MAX_CONVERSIONS
from rosbridge_eth.errors import ConfigError
from rosbridge_eth.log.chunk import MAX_LINE

NUMBER = decoder_for(Wire.ROS1, "pkg/Number", "int32 x")
BLOB = decoder_for(Wire.ROS1, "pkg/Blob", "uint8[] data\nint32 x")


def Capture(rules, **options):
    return AnyCapture(rules, source_kind="sim", **options)


def data(record: Record) -> dict:
    return parse_line(record.line).data


def said(caplog) -> list[str]:
    """What was logged since the last look."""
    messages = [record.getMessage() for record in caplog.records]
    caplog.clear()
    return messages


def number(value: int, at: int = 0, topic: str = "/n") -> RawMessage:
    return RawMessage(topic, "pkg/msg/Number", at, pack("<i", value), NUMBER)


def blob(size: int, topic: str = "/b") -> RawMessage:
    return RawMessage(topic, "pkg/msg/Blob", 0, pack("<I", size) + bytes(size) + pack("<i", 1), BLOB)


def test_a_record_says_what_when_and_how_it_was_captured():
    captured = Capture([TopicRule("/n")]).process(number(5, at=7), wall_ns=8, clock_synchronised=True)
    line = (
        b'{"topic":"/n","type":"pkg/msg/Number","source":"sim","received_ns":7,"captured_ns":8,"clock":true,'
        b'"data":{"x":5}}'
    )
    assert captured == Record("/n", 7, line, ("pkg/msg/Number", definition_line(NUMBER)))
    assert parse_line(line) == MessageLine("/n", "pkg/msg/Number", "sim", 7, 8, True, {"x": 5})


def test_equal_messages_give_equal_bytes():
    lines = [Capture([TopicRule("/n")]).process(number(5), 1).line for _ in range(2)]
    assert lines[0] == lines[1]


def test_a_topic_without_a_rule_is_not_captured_nor_counted():
    capture = Capture([TopicRule("/other")])
    assert capture.process(number(1), 0) is None
    assert not capture.lost


def test_everything_left_out_is_counted_once(caplog):
    rules = [TopicRule("/n", rate=1), TopicRule("/b", limit=61440), TopicRule("/d", limit=1024)]
    capture = Capture(rules)
    for tick in range(10):
        capture.process(number(tick, at=tick * 10**8), 0)
    for size in (10, 50_000, 60_000):
        capture.process(blob(size), 0)
    for size in (10, 50_000, 60_000):
        capture.process(blob(size, "/d"), 0)
    for _ in range(3):
        assert capture.process(RawMessage("/n", "pkg/msg/Number", 10**12, b"", NUMBER), 0) is None
    assert capture.lost == {("/n", "undecodable"): 3, ("/b", "record_too_large"): 2}
    # Said once per topic and cause, with what to do.
    told = said(caplog)
    assert told[0] == "/b: a message is left out: its fields come to more than 61440 bytes of JSON; choose fewer fields"
    assert len(told) == 2
    assert told[1].startswith("/n: a message is left out: it cannot be decoded: ")


def test_what_is_not_in_the_log_is_declared_once():
    rules = [TopicRule("/n", rate=1), TopicRule("/b", limit=61440), TopicRule("/d", limit=1024)]
    capture = Capture(rules)
    assert capture.loss_lines({}) == []
    for size in (10, 50_000, 60_000):
        capture.process(blob(size), 0)
        capture.process(blob(size, "/d"), 0)  # a digest is no loss
    for tick in range(3):
        capture.process(number(tick), 0)  # nor is what is not due
    capture.process(RawMessage("/n", "pkg/msg/Number", 10**12, b"", NUMBER), 0)
    lost = [parse_line(line) for line in capture.loss_lines({("/b", "dropped"): 5, ("/quiet", "lost"): 0})]
    assert sorted(lost, key=lambda line: line.lost) == [
        LostLine(1, "/n", "undecodable"), LostLine(2, "/b", "record_too_large"), LostLine(5, "/b", "dropped"),
    ]  # fmt: skip
    assert capture.loss_lines({("/b", "dropped"): 5}) == []
    capture.process(blob(50_000), 0)
    assert capture.loss_lines({("/b", "dropped"): 6, ("/c", "lost"): 1}) == [
        b'{"lost":1,"topic":"/b","why":"dropped"}', b'{"lost":1,"topic":"/c","why":"lost"}',
        b'{"lost":1,"topic":"/b","why":"record_too_large"}',
    ]  # fmt: skip


@pytest.mark.parametrize("moment", [-1, 2**63, 10**30])
def test_a_receive_time_that_is_none_costs_its_message_only(moment, caplog):
    capture = Capture([TopicRule("/n")])
    assert capture.process(number(1, at=moment), 0) is None
    assert capture.process(number(1, at=5), 0) is not None
    assert capture.lost["/n", "undecodable"] == 1
    assert said(caplog) == [f"/n: a message is left out: it cannot be decoded: its receive time is {moment}"]


def test_the_bound_on_a_line_is_in_bytes_and_exact(caplog):
    decoder = decoder_for(Wire.ROS1, "pkg/Words", "string[] s")
    frame = len(
        '{"topic":"/w","type":"pkg/msg/Words","source":"sim","received_ns":0,"captured_ns":0,"clock":false,'
        '"data":{"s":[""]}}'
    )
    for letter, size in (("x", 1), ("ü", 2)):
        most = (MAX_LINE - frame) // size
        for letters, fits in ((most, True), (most + 1, False)):
            encoded = (letter * letters).encode()
            raw = pack("<II", 1, len(encoded)) + encoded
            capture = Capture([TopicRule("/w", limit=1 << 20)])
            captured = capture.process(RawMessage("/w", "pkg/msg/Words", 0, raw, decoder), 0)
            assert (captured is not None) is fits, (letter, letters)
            assert captured is None or MAX_LINE - 1 <= len(captured.line) <= MAX_LINE
            told = "/w: a message is left out: its fields come to more than 61440 bytes of JSON; choose fewer fields"
            assert said(caplog) == ([] if fits else [told])
            assert capture.loss_lines({}) == ([] if fits else [b'{"lost":1,"topic":"/w","why":"record_too_large"}'])


def test_a_field_the_type_does_not_have_is_an_error_of_the_configuration():
    capture = Capture([TopicRule("/n", fields=("y",))])
    with pytest.raises(ConfigError, match="has no field 'y'"):
        capture.check("/n", NUMBER)
    with pytest.raises(ConfigError, match="has no field 'y'"):
        capture.process(number(1), 0)


def test_a_live_publisher_of_a_type_without_the_field_does_not_end_the_robot(caplog):
    capture = Capture([TopicRule("/x", fields=("data",))], live=True)
    assert capture.process(blob(1, "/x"), 0) is not None
    assert capture.process(number(1, topic="/x"), 0) is None
    assert capture.process(number(2, topic="/x"), 0) is None
    assert capture.process(blob(1, "/x"), 0) is not None
    [told] = said(caplog)
    assert "/x: a message is left out: " in told
    assert "has no field 'data'" in told
    assert capture.lost == {("/x", "field_missing"): 2}


def test_definitions_that_come_and_go_are_not_kept_for_ever():
    capture = Capture([TopicRule("/x")], live=True)
    for number_ in range(50):
        decoder = decoder_for(Wire.ROS1, "pkg/Number", f"int32 x{number_}")
        raw = RawMessage("/x", "pkg/msg/Number", 0, pack("<i", number_), decoder)
        assert data(capture.process(raw, 0)) == {f"x{number_}": number_}
    (topic,) = capture._topics.values()
    assert topic.conversion.cache_info().currsize <= MAX_CONVERSIONS
    assert data(capture.process(number(7, topic="/x"), 0)) == {"x": 7}


def test_types_may_change_under_a_topic():
    capture = Capture([TopicRule("/**")])
    assert data(capture.process(number(1, topic="/x"), 0)) == {"x": 1}
    assert data(capture.process(blob(1, "/x"), 0)) == {"data": "AA==", "x": 1}


def test_a_malformed_rule_is_refused_at_once():
    with pytest.raises(ValueError, match="is not a name or pattern"):
        Capture([TopicRule("/a b")])
    with pytest.raises(ValueError, match="is not a field path"):
        Capture([TopicRule("/a", fields=("x..y",))])


def test_rules_that_are_refused_leave_the_old_ones_in_force():
    capture = Capture([TopicRule("/n", fields=("x",))])
    with pytest.raises(ValueError, match="is not a field path"):
        capture.change_rules([TopicRule("/m"), TopicRule("/n", fields=("x..y",))])
    assert capture.process(number(1), 0) is not None
    assert capture.process(number(1, topic="/m"), 0) is None


def test_other_rules_leave_what_is_unchanged_as_it_is_and_lose_no_count():
    capture = Capture([TopicRule("/once", once=True), TopicRule("/n"), TopicRule("/b", limit=61440)])
    for topic in ("/once", "/n"):
        assert capture.process(number(1, topic=topic), 0) is not None
    assert capture.process(blob(50_000), 0) is None
    assert len(capture.loss_lines({("/n", "dropped"): 2})) == 2
    capture.change_rules([TopicRule("/once", once=True), TopicRule("/b", limit=10), TopicRule("/new", fields=("x",))])
    assert capture.process(number(2, topic="/once"), 0) is None, "its one message was captured before"
    assert capture.process(number(2), 0) is None
    assert capture.process(blob(50_000), 0) is not None, "by the new rule, a digest"
    captured = capture.process(number(2, topic="/new"), 0)
    assert captured is not None and data(captured) == {"x": 2}
    assert capture.loss_lines({("/n", "dropped"): 2}) == [], "nothing is said twice"
    capture.change_rules([TopicRule("/b", limit=61440)])
    assert capture.process(blob(50_000), 0) is None
    [line] = capture.loss_lines({("/n", "dropped"): 2})
    assert parse_line(line) == LostLine(1, "/b", "record_too_large")
