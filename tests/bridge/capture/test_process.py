"""From raw message to record: what is counted, what is said, and that equal messages give equal bytes."""

from __future__ import annotations

from struct import pack

import pytest

from rosbridge_eth.capture import Capture, CapturedRecord, Cause, RawMessage, TopicRule, Wire, decoder_for
from rosbridge_eth.capture.process import MAX_CONVERSIONS, MAX_DATA
from rosbridge_eth.errors import ConfigError

NUMBER = decoder_for(Wire.ROS1, "pkg/Number", "int32 x")
BLOB = decoder_for(Wire.ROS1, "pkg/Blob", "uint8[] data\nint32 x")


def number(value: int, at: int = 0, topic: str = "/n") -> RawMessage:
    return RawMessage(topic, "pkg/msg/Number", at, pack("<i", value), NUMBER)


def blob(size: int, topic: str = "/b") -> RawMessage:
    return RawMessage(topic, "pkg/msg/Blob", 0, pack("<I", size) + bytes(size) + pack("<i", 1), BLOB)


def test_a_record_says_what_when_and_how_it_was_captured():
    capture = Capture([TopicRule("/n", delivery="latest")])
    record = capture.process(number(5, at=7), wall_ns=8, mono_ns=9, clock_synchronised=True)
    assert record == CapturedRecord("/n", "pkg/msg/Number", 7, 8, 9, True, {"x": 5}, "latest")
    assert CapturedRecord.from_json(record.to_json()) == record


def test_equal_messages_give_equal_bytes():
    encoded = [Capture([TopicRule("/n")]).process(number(5), 1, 2).to_json() for _ in range(2)]
    assert encoded[0] == encoded[1]


def test_a_topic_without_a_rule_is_not_captured_nor_counted():
    capture = Capture([TopicRule("/other")])
    assert capture.process(number(1), 0, 0) is None
    assert capture.statistics() == {}


def test_everything_seen_is_counted_once():
    notices = []
    rules = [TopicRule("/n", rate=1), TopicRule("/b", oversize="refuse"), TopicRule("/d")]
    capture = Capture(rules, notices.append)
    for tick in range(10):
        capture.process(number(tick, at=tick * 10**8), 0, 0)
    for size in (10, 2000, 3000):
        capture.process(blob(size), 0, 0)
    for size in (10, 2000, 3000):
        capture.process(blob(size, "/d"), 0, 0)
    for _ in range(3):
        assert capture.process(RawMessage("/n", "pkg/msg/Number", 10**12, b"", NUMBER), 0, 0) is None
    counts = capture.statistics()
    assert (counts["/n"].seen, counts["/n"].captured, counts["/n"].not_due, counts["/n"].undecodable) == (13, 1, 9, 3)
    assert (counts["/b"].captured, counts["/b"].refused, counts["/b"].fields_digested) == (1, 2, 0)
    assert (counts["/d"].captured, counts["/d"].refused, counts["/d"].fields_digested) == (3, 0, 2)
    for topic in counts.values():
        assert topic.seen == topic.captured + topic.not_due + topic.refused + topic.undecodable
    # Said once per topic and cause, naming the field and what to do.
    assert [(notice.topic, notice.cause) for notice in notices] == [
        ("/b", Cause.FIELD_TOO_LARGE),
        ("/d", Cause.FIELD_DIGESTED),
        ("/n", Cause.UNDECODABLE),
    ]
    assert "data has 2000 bytes" in notices[0].text


def test_a_record_that_could_not_be_sealed_is_refused():
    text = "\n".join(f"string s{i}" for i in range(40))
    decoder = decoder_for(Wire.ROS1, "pkg/Wordy", text)
    notices = []
    capture = Capture([TopicRule("/w")], notices.append)
    for words, fits in ((700, True), (1000, False)):
        raw = (pack("<I", words) + b"x" * words) * 40
        record = capture.process(RawMessage("/w", "pkg/msg/Wordy", 0, raw, decoder), 0, 0)
        assert (record is not None) is fits
        assert record is None or len(record.to_json()) <= MAX_DATA + 1024
    assert [notice.cause for notice in notices] == [Cause.RECORD_TOO_LARGE]


def test_the_bound_on_a_record_is_in_bytes_of_its_json():
    decoder = decoder_for(Wire.ROS1, "pkg/Words", "string[] s")
    frame = len('{"s":[""]}')
    for letter, size in (("x", 1), ("ü", 2)):
        for letters, fits in ((MAX_DATA - frame) // size, True), ((MAX_DATA - frame) // size + 1, False):
            encoded = (letter * letters).encode()
            raw = pack("<II", 1, len(encoded)) + encoded
            capture = Capture([TopicRule("/w", limit=1 << 20)], lambda notice: None)
            record = capture.process(RawMessage("/w", "pkg/msg/Words", 0, raw, decoder), 0, 0)
            assert (record is not None) is fits, (letter, letters)


def test_a_field_the_type_does_not_have_is_an_error_of_the_configuration():
    capture = Capture([TopicRule("/n", fields=("y",))])
    with pytest.raises(ConfigError, match="has no field 'y'"):
        capture.check("/n", NUMBER)
    with pytest.raises(ConfigError, match="has no field 'y'"):
        capture.process(number(1), 0, 0)


def test_a_live_publisher_of_a_type_without_the_field_does_not_end_the_robot():
    notices = []
    capture = Capture([TopicRule("/x", fields=("data",))], notices.append, live=True)
    assert capture.process(blob(1, "/x"), 0, 0) is not None
    assert capture.process(number(1, topic="/x"), 0, 0) is None
    assert capture.process(number(2, topic="/x"), 0, 0) is None
    assert capture.process(blob(1, "/x"), 0, 0) is not None
    assert [notice.cause for notice in notices] == [Cause.FIELD_MISSING]
    assert "has no field 'data'" in notices[0].text
    statistics = capture.statistics()["/x"]
    assert (statistics.seen, statistics.captured, statistics.refused) == (4, 2, 2)


def test_definitions_that_come_and_go_are_not_kept_for_ever():
    capture = Capture([TopicRule("/x")], live=True)
    for number_ in range(50):
        decoder = decoder_for(Wire.ROS1, "pkg/Number", f"int32 x{number_}")
        raw = RawMessage("/x", "pkg/msg/Number", 0, pack("<i", number_), decoder)
        assert capture.process(raw, 0, 0).data == {f"x{number_}": number_}
    (topic,) = capture._topics.values()
    assert len(topic.conversions) <= MAX_CONVERSIONS
    assert capture.process(number(7, topic="/x"), 0, 0).data == {"x": 7}


def test_types_may_change_under_a_topic():
    capture = Capture([TopicRule("/**")])
    assert capture.process(number(1, topic="/x"), 0, 0).data == {"x": 1}
    assert capture.process(blob(1, "/x"), 0, 0).data == {"data": "AA==", "x": 1}


def test_it_is_finished_when_no_rule_can_capture_more():
    capture = Capture([TopicRule("/n", once=True), TopicRule("/m", once=True)])
    assert not capture.finished
    capture.process(number(1), 0, 0)
    assert not capture.finished
    capture.process(number(1, topic="/m"), 0, 0)
    assert capture.finished
    assert capture.process(number(1), 0, 0) is None
    assert not Capture([TopicRule("/*", once=True)]).finished


def test_a_malformed_rule_is_refused_at_once():
    with pytest.raises(ValueError, match="is not a name or pattern"):
        Capture([TopicRule("/a b")])
    with pytest.raises(ValueError, match="is not a field path"):
        Capture([TopicRule("/a", fields=("x..y",))])
