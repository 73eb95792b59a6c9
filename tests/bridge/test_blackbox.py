"""The black box: what is kept for an event, within which bounds, which message is one, and what is written then."""

from __future__ import annotations

import json
import logging
import random
import tracemalloc
from collections import Counter

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosbridge_eth.capture import RawMessage, Restoration, Wire, decoder_for, parse_line
from rosbridge_eth.capture.lines import TriggerLine
from rosbridge_eth.errors import ConfigError
from rosbridge_eth.robot.blackbox import OVERHEAD, BlackBox, Condition, Record, Ring, TriggerRule

S = 10**9
START = 1_700_000_000 * S
DEFINITIONS = [("T", b"definition of T"), ("U", b"a longer definition, that of U"), None]


class Plain:
    """What a ring is to do, on a plain list."""

    def __init__(self, length: int, memory: int) -> None:
        self.length, self.memory, self.kept, self.early = length, memory, list[Record](), list[Record]()

    @property
    def bytes(self) -> int:
        return sum(OVERHEAD + len(record.line) for record in self.kept)

    def forget(self, since: int) -> None:
        while self.kept and self.kept[0].received_ns < since:
            del self.kept[0]

    def add(self, record: Record) -> None:
        self.kept.append(record)
        self.forget(record.received_ns - self.length)
        while self.bytes > self.memory:
            self.early.append(self.kept.pop(0))

    def take(self, at: int) -> tuple[list[Record], Counter[str]]:
        self.forget(at - self.length)
        oldest = (at - self.length) // S
        kept, early = self.kept, Counter(each.topic for each in self.early if each.received_ns // S >= oldest)
        self.kept, self.early = [], []
        return kept, early


steps = st.lists(
    st.tuples(
        st.integers(0, 3 * S), st.sampled_from(["/a", "/b"]), st.integers(1, 900), st.sampled_from(DEFINITIONS),
        st.integers(0, 9),
    ),
    max_size=60,
)


@given(steps, st.integers(1, 20 * S), st.integers(1, 8000))
def test_a_ring_is_a_list_of_what_its_time_and_memory_leave(steps, length, memory):
    ring, plain, now = Ring(length, memory), Plain(length, memory), START
    for passed, topic, size, definition, chance in steps:
        now += passed
        if chance == 0:
            assert ring.take(now) == plain.take(now)
        else:
            record = Record(topic, now, b"x" * size, definition)
            ring.add(record)
            plain.add(record)
        assert (len(ring), ring.bytes) == (len(plain.kept), plain.bytes)
        assert ring.bytes <= memory
    assert ring.take(now) == plain.take(now)
    assert (len(ring), ring.bytes) == (0, 0)


@given(st.lists(st.tuples(st.integers(-3600 * S, 3600 * S), st.integers(1, 900)), max_size=60))
def test_a_clock_that_jumps_does_not_break_the_bound(jumps):
    ring, now = Ring(10 * S, 4000), START
    for jump, size in jumps:
        now += jump
        ring.add(Record("/a", now, b"x" * size, DEFINITIONS[0]))
        assert ring.bytes <= 4000 and len(ring._early) <= 3600 + 12
    records, early = ring.take(now)
    assert len(records) + early.total() <= len(jumps)


@pytest.mark.parametrize("size", [1, 50, 3000, 60_000, 3_000_000])
def test_the_bytes_that_are_counted_are_at_least_those_that_are_taken(size):
    memory, noise, ring = 2 << 20, random.Random(1), Ring(3600 * S, 2 << 20)
    count = 10_000 if size < 100 else 100 if size < 100_000 else 10
    tracemalloc.start()
    try:
        before, _ = tracemalloc.get_traced_memory()
        tracemalloc.reset_peak()
        for number in range(count):
            line = noise.randbytes(size)  # of its own each, as captured lines are
            ring.add(Record("/camera", START + number * 10**6, line, ("sensor_msgs/msg/Image", b"the definition")))
            del line
        now, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert now - before <= memory
    assert peak - before <= memory + 2 * size + 100_000, "one more than fits, at most"
    records, early = ring.take(START)
    assert len(records) + early["/camera"] == count
    assert (early.total() > 0) == (size != 3000)


BEFORE, AFTER = 5 * S, 3 * S


@given(
    st.lists(st.tuples(st.integers(0, 2 * S), st.sampled_from(["message", "message", "message", "event"])), max_size=80)
)
def test_exactly_the_records_around_events_are_written_once_and_in_order(steps):
    box, now, messages, events, written = BlackBox([TriggerRule("crash", BEFORE, AFTER, 1 << 20)]), START, [], [], []
    for number, (passed, what) in enumerate(steps):
        now += passed
        if what == "event":
            events.append(now)
            box.fire(now, "test")
        else:
            messages.append(now)
            box.keep("crash", Record("/a", now, b"%d" % number, DEFINITIONS[0]))
        while box.released:
            written.append(box.released.popleft())
    # An event counts for what came after it in the order of arrival, and so do those at its own nanosecond.
    lines = [record for record in written if record.definition]
    assert [record.received_ns for record in lines] == [
        at for at in messages if any(event - BEFORE <= at <= event + AFTER for event in events)
    ]
    notices = [parse_line(record.line) for record in written if not record.definition]
    begun = [event for event, last in zip(events, [-S * S, *events], strict=False) if event > last + AFTER]
    assert [notice.at_ns for notice in notices] == begun
    assert box.triggers["crash"].fired == len(begun)
    assert not box.lost


def test_what_memory_had_no_room_for_is_lost_once_an_event_follows():
    rule = TriggerRule("crash", 10 * S, S, 10 * (OVERHEAD + 100))
    box = BlackBox([rule])
    for number in range(100):  # ten seconds and a little more, of which a tenth fits
        topic = "/camera" if number % 4 else "/odom"
        box.keep("crash", Record(topic, START + number * S // 9, b"x" * 100, None))
    assert not box.lost, "without an event nothing of it would be in the log"
    box.fire(START + 99 * S // 9, "test")
    written = [record for record in box.released if record.topic]
    in_time = [number for number in range(100) if 99 - number <= 90]
    assert len(written) == 10
    assert sum(box.lost.values()) in range(len(in_time) - 10, len(in_time) - 10 + 9), "counted by whole seconds"
    assert box.lost["/camera", "memory"] > 2 * box.lost["/odom", "memory"] > 0
    before = box.lost.total()
    box.fire(START + 60 * S, "test")
    assert box.lost.total() == before, "said once"


def test_a_clock_that_is_set_back_ends_what_was_written_because_of_an_event():
    box = BlackBox([TriggerRule("crash", S, S, 1 << 20)])
    box.fire(START, "test")
    box.keep("crash", Record("/a", START + S, b"x", DEFINITIONS[0]))
    assert len(box.released) == 2
    box.keep("crash", Record("/a", START - 3600 * S, b"x", DEFINITIONS[0]))
    assert len(box.released) == 2, "it is not written for an hour"


def test_rules_are_changed_and_what_is_kept_for_the_same_stays():
    same, other = TriggerRule("a", S, S, 1 << 20), TriggerRule("b", S, S, 1 << 20)
    box = BlackBox([same, other])
    for name in ("a", "b"):
        box.keep(name, Record("/x", START, b"x", None))
    box.change_rules([same, other._replace(after_ns=2 * S), TriggerRule("c", S, S, 1 << 20)])
    assert [len(trigger.ring) for trigger in box.triggers.values()] == [1, 0, 0]


def test_a_moment_before_1970_is_no_line_that_cannot_be_read():
    box = BlackBox([TriggerRule("crash", S, S, 1 << 20)])
    box.fire(-5, "a bag with a broken clock")
    assert parse_line(box.released[0].line) == TriggerLine("crash", "a bag with a broken clock", 0)


# Conditions

TEXT = (
    "bool ok\nint32 number\nfloat64 real\nstring word\ntime stamp\nfloat32[] reals\nuint8[] blob\nPart[] parts\n"
    f"float64[2] pair\n{'=' * 80}\nMSG: my_pkg/Part\nstring name\nbool hot\n"
)
DECODER = decoder_for(Wire.ROS1, "my_pkg/msg/All", TEXT)
DATA = {
    "ok": True, "number": -3, "real": 2.5, "word": "über", "stamp": 10**18 + 1, "reals": [1.0, "NaN", "-Infinity"],
    "blob": "AQID", "parts": [{"name": "a", "hot": False}, {"name": "b", "hot": True}], "pair": [0.5, "Infinity"],
}  # fmt: skip


def raw(data: dict[str, object], topic: str = "/all") -> RawMessage:
    message = Restoration(DECODER).restore({**DATA, **data}).message
    return RawMessage(topic, DECODER.type_name, START, DECODER.encode(message), DECODER)


@pytest.mark.parametrize(("text", "holds"), [
    ("ok == true", True), ("ok == false", False), ("ok != true", False),
    ("number < 0", True), ("number <= -3", True), ("number == -3", True), ("number == -3.0", True),
    ("number > -3", False), ("real>2.49", True), ("real >= 2.5", True), ("real != 2.5", False), ("real < 1e300", True),
    ('word == "über"', True), ('word != "über"', False),
    ("stamp == 1000000000000000001", True), ("stamp == 1000000000000000000", False),
    ("reals[0] == 1", True), ("reals[1] == 1", False), ("reals[1] != 1", True), ("reals[2] < -1e308", True),
    ("reals[9] != 0", False), ("reals[*] == 1", True), ("reals[*] > 1", False), ("pair[1] > 1e308", True),
    ("blob[1] == 2", True), ("blob[3] == 0", False),
    ("parts[*].hot == true", True), ('parts[*].name == "c"', False), ('parts[1].name == "b"', True),
])  # fmt: skip
def test_a_condition_holds_for_the_messages_that_it_says(text: str, holds: bool):
    assert Condition.parse(f"/all {text}").compiled(DECODER)(raw({})) is holds


def test_nan_is_equal_to_nothing_and_a_large_array_is_looked_through():
    reals = ["NaN"] + [0.0] * 100_000 + [7.0]
    for text, holds in (("reals[*] == 7", True), ("reals[*] > 7", False), ("reals[0] != 3", True), ("real < 9", False)):
        found = Condition.parse(f"/all {text}").compiled(DECODER)(raw({"reals": reals, "real": "NaN"}))
        assert found is holds, text


@pytest.mark.parametrize("text", [
    "", "/all", "/all ok", "/all ok true", "/all ok = true", "/all ok == yes", "/all ok == null", "/all ok == [1]",
    "/all number == 1 2", "/all .ok == true", "/all ok. == true", "/all reals[x] == 1", "/all reals[-1] == 1",
    "/* ok == true", "/all/ ok == true", '/all word < "a"', "/all ok > false", "/all number == NaN",
    "/all __import__('os') == 1", "/all ok == 1" + "0" * 400,
])  # fmt: skip
def test_what_is_no_condition_is_refused_with_a_sentence(text: str):
    with pytest.raises(ValueError, match=r"^is |is not a "):
        Condition.parse(text)


@pytest.mark.parametrize(("text", "says"), [
    ("okay == true", "has no field 'okay'; it has: ok, "), ("ok == 1", "true or false, and compared with a number"),
    ('ok == "true"', "compared with a string"), ("word == 1", "a string, and"), ("number == true", "a number, and"),
    ("parts == 1", "no single value"), ("parts[0] == 1", "no single value"), ("reals == 1", "no single value"),
    ("blob[*] == 1", "no single value"),
    ("number[0] == 1", "nothing can be selected"),
])  # fmt: skip
def test_a_condition_that_can_never_hold_is_told(text: str, says: str, caplog: pytest.LogCaptureFixture):
    rule = TriggerRule("crash", S, S, 1 << 20, (Condition.parse(f"/all {text}"),))
    box = BlackBox([rule])
    with pytest.raises(ConfigError, match=r"the condition .* never holds") as told:
        box.check("/all", DECODER)
    assert says in str(told.value)
    box.check("/other", DECODER)
    for _ in range(3):  # a live source: the type is known at the first message
        box.look(raw({}))
    assert not box.released
    assert [says in record.getMessage() for record in caplog.records if record.levelno == logging.ERROR] == [True]


def test_the_message_that_is_the_event_is_written_with_what_came_before_it():
    box = BlackBox([TriggerRule("crash", S, S, 1 << 20, (Condition.parse("/all number > 4"),))])
    for number in range(6):
        message = raw({"number": number})._replace(received_ns=START + number)
        box.look(message)
        box.keep("crash", Record("/all", START + number, b"%d" % number, DEFINITIONS[0]))
    assert [record.line for record in box.released if record.definition] == [b"0", b"1", b"2", b"3", b"4", b"5"]
    assert not box.released[0].definition, "the line that says why comes first"


def test_a_message_that_cannot_be_decoded_is_no_event():
    box = BlackBox([TriggerRule("crash", S, S, 1 << 20, (Condition.parse("/all ok == true"),))])
    box.look(raw({})._replace(raw=b"\x01"))
    box.look(raw({}, topic="/else"))
    assert not box.released
    box.look(raw({}))
    assert json.loads(box.released[0].line) == {"trigger": "crash", "why": "/all ok == true", "at_ns": START}


def test_definitions_without_end_do_not_fill_the_memory_of_a_condition():
    box = BlackBox([TriggerRule("crash", S, S, 1 << 20, (Condition.parse("/all x == 1"),))])
    for number in range(100):
        decoder = decoder_for(Wire.ROS1, f"a/msg/T{number}", "int32 x\n")
        box.look(RawMessage("/all", decoder.type_name, START, b"\0\0\0\0", decoder))
    assert box._compiled.cache_info().currsize <= 64
