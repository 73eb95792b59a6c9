"""Records that were read back, held against a recording of the same messages, field by field.

The recording is a bag that this robot replayed, or that was recorded beside it. Both sides are taken in order per
topic, so a record that is missing, doubled or out of its place is a difference. A record of a replay has the bag's
receive time; one of a live robot was received by it and by the recorder at times of their own, so there it is the
content that says which message it is, among those of a SLACK around. Memory holds the messages of twice that.

The bag need not span the whole log. Up to a SLACK outside its first and last message, a record may have a message in it
and need not. Where contents repeat, those before the first message are counted back from the first record inside. The
clocks of a live robot and of the recorder differ: up to a SLACK inside, too, a record need not have a message if it is
before the one of the topic's first message, or after that of its last.
"""

from __future__ import annotations

from base64 import b64encode
from collections import deque
from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from math import inf, isfinite
from pathlib import Path
from typing import Any

import numpy

from rosbridge_eth.capture import MessageLine, RawMessage
from rosbridge_eth.capture.definitions import attribute_name
from rosbridge_eth.config.values import counted, time_text
from rosbridge_eth.reading.verdict import shown
from rosbridge_eth.robot.sources import BagSource, Selection
from smcrypto import sm3

MAX_DIFFERENCES = 100
SLACK = 1_000_000_000  # ns


@dataclass(slots=True)
class Comparison:
    """`equal` records, `wrong` ones, and a sentence for each of those, MAX_DIFFERENCES of them at most.

    absent: topics of which there is no record.
    """

    equal: int = 0
    wrong: int = 0
    absent: list[str] = field(default_factory=list)
    differences: list[str] = field(default_factory=list)

    def differ(self, topic: str, at_ns: int, why: str) -> None:
        self.wrong += 1
        if self.wrong <= MAX_DIFFERENCES:
            self.differences.append(f"{shown(topic)} at {time_text(at_ns)}: {shown(why)}")


def compare(bag: Path, topics: Sequence[str], records: Iterable[MessageLine], *, some: bool = False) -> Comparison:
    """Hold each record on the topics against the bag's own message: each captured field equal, and none missing.

    Records that were received a SLACK before the bag begins or after it ends are not looked at; nearer to its ends, one
    without a message is no difference, unless it is the record before it once more.
    topics: none for all of the bag's; then one without a single record is `absent`, and no difference.
    some: the robot captured only some of the messages, by a rate or period; those that it did not are no difference.
    """
    source = BagSource(bag, Selection(topics or ["/**"]))
    made, messages = Comparison(), source.messages()
    waiting: dict[str, deque[RawMessage]] = {topic: deque() for topic in source.decoders()}
    unmet = dict.fromkeys(waiting, 0)  # of the topics that had no record yet, messages that should have had one
    early: dict[str, list[MessageLine]] = {topic: [] for topic in waiting}  # until the first record inside the bag
    replayed = set[str]()  # topics of which a record has a message's own receive time
    previous: dict[str, MessageLine] = {}

    def missing(raw: RawMessage) -> None:
        if raw.topic in unmet:
            unmet[raw.topic] += 1
        elif not some:
            made.differ(raw.topic, raw.received_ns, "the chain has no record of this message")

    def judge(record: MessageLine) -> None:
        topic, time, mine = record.topic, record.received_ns, waiting[record.topic]
        before, wrong = _message_of(record, mine)
        at_its_time = any(raw.received_ns == time for raw in mine)
        if at_its_time:
            replayed.add(topic)
        elif wrong is not None:
            at_an_end = (topic in unmet and time < first + SLACK) or (not mine and time > last - SLACK)
            if first <= time <= last and (topic in replayed or not at_an_end):
                made.differ(topic, time, wrong)
            return
        for _ in range(before):
            missing(mine.popleft())
        mine.popleft()
        if (count := unmet.pop(topic, 0)) and not some:
            made.differ(topic, time, f"the chain has no record of {counted(count, 'message')} before this one")
        if wrong is None:
            made.equal += 1
        else:
            made.differ(topic, time, wrong)

    try:
        (first, last), ahead = source.span, next(messages, None)
        for record in (record for record in records if record.topic in waiting):
            topic, time = record.topic, record.received_ns
            if not first - SLACK <= time <= last + SLACK:
                continue
            while ahead is not None and ahead.received_ns <= time + SLACK:
                waiting[ahead.topic].append(ahead)
                ahead = next(messages, None)
            twin, previous[topic] = previous.get(topic), record
            if (
                twin and (twin.received_ns, twin.data) == (time, record.data)
                and not any(raw.received_ns == time for raw in waiting[topic])
            ):  # fmt: skip
                made.differ(topic, time, "the bag has no such message; it is the record before it once more")
                continue
            if time < first and topic in early:
                early[topic].append(record)
                continue
            for one in _with_message(early.pop(topic, []), record, waiting[topic]):
                judge(one)
            for old in waiting.values():
                while old and old[0].received_ns < time - SLACK:
                    missing(old.popleft())
            judge(record)
        for record in (record for rest in early.values() for record in rest):
            judge(record)
        for rest in (*waiting.values(), [] if ahead is None else [ahead], messages):
            for raw in rest:
                missing(raw)
    finally:
        source.close()
    for topic, count in unmet.items():
        if count and (topics or topic in previous):
            made.differ(topic, first, f"the chain has no record of any of this topic's messages; the bag has {count:,}")
        else:
            made.absent.append(shown(topic))
    return made


def _with_message(
    early: list[MessageLine], record: MessageLine, waiting: Sequence[RawMessage]
) -> list[MessageLine]:
    """Those of the records before the bag's begin that can have a message before that of the first record inside."""
    if not early:  # of all records but a topic's first: nothing is to be decoded for them
        return early
    same = [at for at, raw in enumerate(waiting) if _wrong(record.data, raw.decoder.decode(raw.raw), "") is None]
    if not same:
        return early
    count = min(same, key=lambda at: abs(waiting[at].received_ns - record.received_ns))
    return early[-count:] if count else []


def _message_of(record: MessageLine, waiting: Sequence[RawMessage]) -> tuple[int, str | None]:
    """How many messages come before that of the record, and what is wrong with it; all if none is like it."""
    same = [at for at, raw in enumerate(waiting) if raw.received_ns == record.received_ns]
    wrong, nearest = "the bag has no such message", 2 * SLACK
    for at in same or range(len(waiting)):
        found = _wrong(record.data, waiting[at].decoder.decode(waiting[at].raw), "")
        if found is None:
            return at, None
        if (away := abs(waiting[at].received_ns - record.received_ns)) < nearest:
            wrong, nearest = found, away
    if same:
        return same[0], wrong
    return 0, wrong if not waiting else f"the bag has no such message; in the nearest, {wrong}"


def _wrong(value: Any, message: Any, path: str) -> str | None:
    """The first place where captured JSON is not what the ROS message says; None if there is none."""
    if isinstance(message, numpy.generic):  # an array's element; of float32, infinity is no float of Python's
        message = message.item()
    if isinstance(value, dict) and value.keys() == {"sm3", "length"} and not hasattr(message, "sm3"):
        content = message.encode() if isinstance(message, str) else numpy.asarray(message).tobytes()
        right = {"sm3": sm3.digest(content).hex(), "length": len(content)}
        return None if value == right else f"{path} is a digest of something else"
    if isinstance(value, dict):
        if not value and getattr(message, "__dataclass_fields__", True):
            return f"{path or 'the record'} is empty"
        parts = (_wrong(part, _member(message, name), f"{path}.{name}".lstrip(".")) for name, part in value.items())
        return next((found for found in parts if found is not None), None)
    if isinstance(value, list):
        if not isinstance(message, list | numpy.ndarray) or len(value) != len(message):
            return f"{path} has {len(value)} elements, not as the message"
        parts = (_wrong(a, b, f"{path}[{i}]") for i, (a, b) in enumerate(zip(value, message, strict=True)))
        return next((found for found in parts if found is not None), None)
    if hasattr(message, "nanosec"):
        message = message.sec * 10**9 + message.nanosec
    elif isinstance(message, numpy.ndarray | bytes):
        message = b64encode(bytes(message)).decode()
    elif isinstance(message, float) and not isfinite(message):
        message = {inf: "Infinity", -inf: "-Infinity"}.get(message, "NaN")
    return None if value == message else f"{path} is {value!r} instead of {message!r}"


def _member(message: Any, name: str) -> Any:
    """A message's field, or an array's element of which only some were captured; None for what is not there."""
    if isinstance(message, list | numpy.ndarray):
        return message[int(name)] if name.isdecimal() and int(name) < len(message) else None
    return getattr(message, attribute_name(name), None)
