"""One's own recording against what came back: bags that rosbags writes, records that capture makes."""

from __future__ import annotations

import tracemalloc
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import numpy
import pytest
from rosbags.rosbag1 import Writer

from bridge.image_bags import CAMERA, CLOUD, IMAGES, JPEG, STORE, bag_of_images
from rosbridge_eth.capture import Capture, MessageLine, RawMessage, TopicRule, Wire, decoder_for, parse_line
from rosbridge_eth.reading.compare import MAX_DIFFERENCES, Comparison, compare
from rosbridge_eth.robot.sources import BagSource, Selection

T0, STEP = 1_763_690_000_000_000_000, 100_000_000
DEFINITION = "int64 n\nfloat32 f\nuint8[] raw\nstring[] names\ntime at\nbool from\nbyte b\n"
DECODER = decoder_for(Wire.ROS1, "acme_msgs/msg/Thing", DEFINITION)


def thing(n: int, f: float = 0.5, text: str = "b") -> bytes:
    types = DECODER.typestore.types
    at = types["builtin_interfaces/msg/Time"](5, n)
    raw = numpy.array([n % 256, 2], "u1")
    return DECODER.encode(types[DECODER.type_name](n, f, raw, ["a", text], at, True, -3))


def messages(count: int, topic: str = "/t", same: bool = False) -> list[RawMessage]:
    return [
        RawMessage(topic, DECODER.type_name, T0 + n * STEP, thing(0 if same else n), DECODER) for n in range(count)
    ]


def bag(path: Path, written: Sequence[RawMessage]) -> Path:
    with Writer(path) as writer:
        connections: dict[str, Any] = {}
        for raw in written:
            if raw.topic not in connections:
                connections[raw.topic] = writer.add_connection(
                    raw.topic, raw.type_name, msgdef=DECODER.definition.text, md5sum=DECODER.definition.md5
                )
            writer.write(connections[raw.topic], raw.received_ns, raw.raw)
    return path


def records(captured: Sequence[RawMessage], late_ns: int = 0, fields: Sequence[str] = ()) -> Iterator[MessageLine]:
    capture = Capture([TopicRule("**", fields=tuple(fields))], source_kind="ros1")
    for raw in captured:
        line = capture.process(raw._replace(received_ns=raw.received_ns + late_ns), T0)
        assert line is not None
        found = parse_line(line.line)
        assert isinstance(found, MessageLine)
        yield found


def told(comparison: Comparison) -> tuple[int, int]:
    return comparison.equal, comparison.wrong


@pytest.mark.parametrize("late_ns", [0, 3_000_000, -3_000_000])
@pytest.mark.parametrize("fields", [(), ("n", "raw"), ("names[1]",)])
def test_what_was_replayed_or_recorded_beside_the_robot_is_equal(tmp_path, late_ns, fields):
    written = messages(50)
    path = bag(tmp_path / "my.bag", written)
    assert told(compare(path, ["/t"], records(written, late_ns, fields))) == (50, 0)


@pytest.mark.parametrize("same", [False, True])
@pytest.mark.parametrize("late_ns", [0, 3_000_000])
@pytest.mark.parametrize("gone", [0, 20, 49])
def test_a_record_that_is_missing(tmp_path, gone, late_ns, same):
    written = messages(50, same=same)
    path = bag(tmp_path / "my.bag", written)
    there = [*written[:gone], *written[gone + 1 :]]
    made = compare(path, ["/t"], records(there, late_ns))
    assert told(made) == (49, 1)
    assert "the chain has no record of" in made.differences[0]
    assert told(compare(path, ["/t"], records(there, late_ns), some=True)) == (49, 0)


@pytest.mark.parametrize("late_ns", [0, 3_000_000])
@pytest.mark.parametrize("twice", [0, 20, 49])
def test_a_record_that_is_doubled(tmp_path, twice, late_ns):
    written = messages(50)
    made = compare(
        bag(tmp_path / "my.bag", written), ["/t"], records([*written[: twice + 1], *written[twice:]], late_ns)
    )
    assert told(made) == (50, 1)
    assert "the bag has no such message" in made.differences[0]


def test_a_field_that_differs_is_told_by_its_path(tmp_path):
    written = messages(50)
    found = list(records(written))
    found[7] = found[7]._replace(data=found[7].data | {"f": 0.25})
    found[9] = found[9]._replace(data=found[9].data | {"names": ["a", "\x1b"]})
    found[11] = found[11]._replace(data=found[11].data | {"more": 1})
    made = compare(bag(tmp_path / "my.bag", written), ["/t"], iter(found))
    assert told(made) == (47, 3)
    assert made.differences[0] == "/t at 2025-11-21T01:53:20.700Z: f is 0.25 instead of 0.5"
    assert "names[1]" in made.differences[1]
    assert all(text.isprintable() for text in made.differences)
    late = [one._replace(received_ns=one.received_ns + 1000) for one in found]
    made = compare(tmp_path / "my.bag", ["/t"], iter(late))
    assert (made.equal, made.wrong) == (47, 6), "a message without a record, and a record without a message, each"
    assert any("in the nearest, f is 0.25 instead of 0.5" in text for text in made.differences)


def test_elements_of_arrays_are_held_against_the_message_whatever_number_they_are(tmp_path):
    definition = "float32[] ranges\nfloat64[2] pair\nbool[] on\nfloat32 f\n"
    decoder = decoder_for(Wire.ROS1, "acme_msgs/msg/Scan", definition)
    ranges = numpy.array([0.1, numpy.inf, -numpy.inf, numpy.nan], "f4")
    scan = decoder.typestore.types[decoder.type_name]
    made = scan(ranges, numpy.array([numpy.nan, 2]), numpy.array([True]), numpy.inf)
    raw = RawMessage("/scan", decoder.type_name, T0, decoder.encode(made), decoder)
    with Writer(tmp_path / "my.bag") as writer:
        to = writer.add_connection(
            raw.topic, raw.type_name, msgdef=decoder.definition.text, md5sum=decoder.definition.md5
        )
        writer.write(to, raw.received_ns, raw.raw)
    for fields in ((), ("ranges[1]", "ranges[3]", "on[0]", "f")):
        [found] = records([raw], fields=fields)
        assert told(compare(tmp_path / "my.bag", ["/scan"], [found])) == (1, 0), found.data
    wrong = found._replace(data={"ranges": [0.5, "Infinity", "-Infinity", "NaN"]})
    [said] = compare(tmp_path / "my.bag", ["/scan"], [wrong]).differences
    assert said.endswith("ranges[0] is 0.5 instead of 0.10000000149011612")


@pytest.mark.parametrize("same", [False, True])
@pytest.mark.parametrize("late_ns", [0, 3_000_000, -3_000_000])
def test_a_bag_that_does_not_span_the_log(tmp_path, same, late_ns):
    """The robot wrote 8 s; the recording has 2.0 to 5.9 s of them."""
    written = messages(80, same=same)
    path = bag(tmp_path / "my.bag", written[20:60])
    made = compare(path, ["/t"], records(written, late_ns))
    assert (told(made), made.differences) == ((40, 0), [])
    for twice in (20, 40, 59):
        doubled = [*written[: twice + 1], *written[twice:]]
        assert told(compare(path, ["/t"], records(doubled, late_ns))) == (40, 1), twice
    for gone in (20, 40, 59):
        short = [*written[:gone], *written[gone + 1 :]]
        made = compare(path, ["/t"], records(short, late_ns))
        # Where all messages are alike, a record from beside the recording may stand for the one that is missing.
        assert told(made) == (39, 1) or (same and told(made) == (40, 0)), (gone, made.differences)


@pytest.mark.parametrize("same", [False, True])
@pytest.mark.parametrize("late_ns", [433_333_000, -433_333_000])
def test_a_bag_within_the_log_by_a_clock_of_its_own(tmp_path, same, late_ns):
    """As above, and the recorder's clock differs from the robot's by more than a message's time."""
    written = messages(80, same=same)
    path = bag(tmp_path / "my.bag", written[20:60])
    made = compare(path, ["/t"], records(written, late_ns))
    assert (told(made), made.differences) == ((40, 0), [])
    if not same:
        for at in (20, 21, 40, 58, 59):
            found = list(records(written, late_ns))
            found[at] = found[at]._replace(data=found[at].data | {"f": 0.25})
            made = compare(path, ["/t"], found)
            assert made.equal == 39 and made.wrong, at
            assert compare(path, ["/t"], found[:20] + found[60:]).wrong, "none of the messages has a record"


def test_a_record_beside_a_replay_is_a_difference_at_the_ends_too(tmp_path):
    written = messages(50)
    path = bag(tmp_path / "my.bag", written[1:49:2])
    for at in (2, 46):
        found = records(sorted([*written[1:49:2], written[at]], key=lambda raw: raw.received_ns))
        assert told(compare(path, ["/t"], found)) == (24, 1), at


def test_a_short_bag_of_which_nothing_is_on_the_chain(tmp_path):
    written = messages(5)
    found = [one._replace(data=one.data | {"f": 0.25}) for one in records(written, 3_000_000)]
    assert compare(bag(tmp_path / "my.bag", written), [], found).wrong


def test_records_in_another_order(tmp_path):
    written = messages(50)
    found = list(records(written))
    found[20], found[21] = found[21], found[20]
    made = compare(bag(tmp_path / "my.bag", written), ["/t"], iter(found))
    assert told(made) == (49, 2)


def test_a_topic_that_is_not_on_the_chain_is_a_difference_where_it_is_asked_for(tmp_path):
    here, there = messages(20), messages(20, "/u")
    path = bag(tmp_path / "my.bag", sorted([*here, *there], key=lambda raw: raw.received_ns))
    made = compare(path, [], records(here))
    assert (told(made), made.absent) == ((20, 0), ["/u"])
    made = compare(path, ["/t", "/u"], records(here))
    assert told(made) == (20, 1)
    assert "any of this topic's messages; the bag has 20" in made.differences[0]


def test_records_of_other_topics_and_other_times_are_not_looked_at(tmp_path):
    written = messages(20)
    before = [raw._replace(received_ns=raw.received_ns - 10**12) for raw in written]
    after = [raw._replace(received_ns=raw.received_ns + 10**12) for raw in written]
    found = records([*before, *messages(3, "/x"), *written, *after])
    assert told(compare(bag(tmp_path / "my.bag", written), ["/t"], found)) == (20, 0)


@pytest.mark.parametrize(
    "data", [{}, {"n": []}, {"n": {}}, {"names": 5}, {"names": [1]}, {"names": {"9": "a"}}, {"at": {}}, {"raw": [1]},
             {"nothing": {"x": 1}}, {"sm3": 1, "length": 2}, {"n": {"sm3": "", "length": 1}}, {"b": 253}],
)  # fmt: skip
def test_whatever_a_robot_signed_is_a_difference_and_no_traceback(tmp_path, data):
    written = messages(1)
    [one] = records(written)
    assert compare(bag(tmp_path / "my.bag", written), ["/t"], [one._replace(data=data)]).wrong == 1


def test_many_differences_are_counted_and_the_first_are_told(tmp_path):
    written = messages(400)
    found = (one._replace(data={"n": -1}) for one in records(written))
    made = compare(bag(tmp_path / "my.bag", written), ["/t"], found)
    assert (made.equal, made.wrong, len(made.differences)) == (0, 400, MAX_DIFFERENCES)


def test_memory_holds_two_seconds_of_a_bag(tmp_path):
    written = [raw._replace(raw=thing(n, text=f"{n}" * 4_000)) for n, raw in enumerate(messages(900))]
    path = bag(tmp_path / "my.bag", written)
    tracemalloc.start()
    try:
        assert compare(path, ["/t"], records(written)).equal == 900
        assert tracemalloc.get_traced_memory()[1] < sum(len(raw.raw) for raw in written) / 3
    finally:
        tracemalloc.stop()


def test_images_and_clouds_that_a_recorder_kept_are_proven_by_the_digests_in_the_log(tmp_path):
    """What is above 16 KiB is in the log as its SM3; `rosbag record` beside the robot keeps the bytes."""
    kept = tmp_path / "kept.bag"
    bag_of_images(kept)
    captured = list(BagSource(kept, Selection(["**"])).messages())
    found = list(records(captured))
    for topic, field in ((CAMERA, "data"), (JPEG, "data"), (CLOUD, "data")):
        assert all(one.data[field].keys() == {"sm3", "length"} for one in found if one.topic == topic)
    assert told(compare(kept, [], iter(found))) == (3 * IMAGES + IMAGES // 3, 0)

    [image] = [n for n, raw in enumerate(captured) if raw.topic == CAMERA][7:8]
    spoilt = captured[image].raw[:-1] + bytes([captured[image].raw[-1] ^ 1])  # one pixel
    captured[image] = captured[image]._replace(raw=spoilt)
    other = tmp_path / "other.bag"
    with Writer(other) as writer:
        to: dict[str, Any] = {}
        for raw in captured:
            if raw.topic not in to:
                to[raw.topic] = writer.add_connection(raw.topic, raw.type_name, typestore=STORE)
            writer.write(to[raw.topic], raw.received_ns, raw.raw)
    made = compare(other, [], iter(found))
    assert told(made) == (3 * IMAGES + IMAGES // 3 - 1, 1)
    assert CAMERA in made.differences[0] and "data" in made.differences[0]
