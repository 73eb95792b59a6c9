"""Records that were read back, held against a recording of the same messages, field by field.

The recording is a bag that this robot replayed, or that was recorded beside it. Both sides are taken in order per
topic, so a record that is missing, doubled or out of its place is a difference.
"""

from __future__ import annotations

import threading
from base64 import b64encode
from collections import defaultdict
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from math import inf, isfinite
from pathlib import Path
from typing import Any

import numpy

from rosbridge_eth.capture import MessageLine, RawMessage
from rosbridge_eth.reading.verdict import shown
from rosbridge_eth.sources import BagSource, Selection
from smcrypto import sm3

MAX_DIFFERENCES = 100


@dataclass(frozen=True, slots=True)
class Comparison:
    """`equal` records, and a sentence for each that is not, MAX_DIFFERENCES of them at most."""

    equal: int
    differences: tuple[str, ...]


def compare(bag: Path, topics: Sequence[str], records: Iterable[MessageLine]) -> Comparison:
    """Hold each record against the bag's own message: the same receive time, and each captured field equal."""
    expected: dict[str, list[RawMessage]] = defaultdict(list)
    source = BagSource(bag, Selection(topics), speed=None)
    try:
        source.run(lambda raw: expected[raw.topic].append(raw), threading.Event())
    finally:
        source.close()
    got: dict[str, list[MessageLine]] = defaultdict(list)
    for record in records:
        got[record.topic].append(record)
    equal, differences = 0, []
    for topic in sorted(expected.keys() | got.keys()):
        if len(got[topic]) != len(expected[topic]):
            differences.append(f"{topic}: the bag has {len(expected[topic])} messages, {len(got[topic])} came back")
        for raw, record in zip(expected[topic], got[topic], strict=False):
            wrong = _difference(record, raw)
            if wrong is None:
                equal += 1
            else:
                differences.append(f"{topic} at {raw.received_ns}: {wrong}")
    return Comparison(equal, tuple(shown(text) for text in differences[:MAX_DIFFERENCES]))


def _difference(record: MessageLine, raw: RawMessage) -> str | None:
    if record.received_ns != raw.received_ns:
        return f"received at {record.received_ns} instead"
    return _wrong(record.data, raw.decoder.decode(raw.raw), "")


def _wrong(value: Any, message: Any, path: str) -> str | None:
    """The first place where captured JSON is not what the ROS message says; None if there is none."""
    if isinstance(value, dict) and value.keys() == {"sm3", "length"} and not hasattr(message, "sm3"):
        content = message.encode() if isinstance(message, str) else numpy.asarray(message).tobytes()
        right = {"sm3": sm3.digest(content).hex(), "length": len(content)}
        return None if value == right else f"{path} is a digest of something else"
    if isinstance(value, dict):
        if not value:
            return f"{path or 'the record'} is empty"
        parts = (_wrong(part, getattr(message, name), f"{path}.{name}".lstrip(".")) for name, part in value.items())
        return next((found for found in parts if found is not None), None)
    if isinstance(value, list):
        if len(value) != len(message):
            return f"{path} has {len(value)} elements instead of {len(message)}"
        parts = (_wrong(a, b, f"{path}[{i}]") for i, (a, b) in enumerate(zip(value, message, strict=True)))
        return next((found for found in parts if found is not None), None)
    if hasattr(message, "nanosec"):
        message = message.sec * 10**9 + message.nanosec
    elif isinstance(message, numpy.ndarray | bytes):
        message = b64encode(bytes(message)).decode()
    elif isinstance(message, float) and not isfinite(message):
        message = {inf: "Infinity", -inf: "-Infinity"}.get(message, "NaN")
    return None if value == message else f"{path} is {value!r} instead of {message!r}"
