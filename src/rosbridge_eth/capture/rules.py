"""What is captured of which topic: fields, rate, moment or period.

All times are compared with a message's receive time, so a bag gives the same
records at any replay speed. Field paths:

    pose.pose.position.x     a field of a field
    pose.pose                a field with everything in it
    ranges[0]                one element of an array; absent from the record if the array is shorter
    poses[*].position        a field of every element
    *                        the whole message

The record keeps the shape of the message: `pose.pose.position.x` is found in its data as
{"pose": {"pose": {"position": {"x": ...}}}}, and `ranges[0]` as {"ranges": {"0": ...}}.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from contextlib import suppress
from dataclasses import dataclass
from math import inf
from typing import Final, TypeAlias

DEFAULT_LIMIT: Final = 16 * 1024
"""Bytes of one field from which on its digest stands for it."""


@dataclass(frozen=True)
class TopicRule:
    """How the topics that match `topic` are captured.

    topic: a name, or a pattern: `*` and `?` within one part of a name, `**` across parts, `[ab]`.
    fields: paths; empty means every field.
    rate: records a second at most; None for every message.
    at_ns: only the first message received at this moment or after it.
    once: only the first message (of the period).
    from_ns, until_ns: only messages received in [from, until).
    for_ns: length of the period: from `from_ns`, or from the first message if that is None.
    limit: bytes of a field above which its digest stands for it.
    trigger: records are kept in memory until this event; None: they are written.
    """

    topic: str
    fields: tuple[str, ...] = ()
    rate: float | None = None
    at_ns: int | None = None
    once: bool = False
    from_ns: int | None = None
    until_ns: int | None = None
    for_ns: int | None = None
    limit: int = DEFAULT_LIMIT
    trigger: str | None = None


class Schedule:
    """Which messages of one topic are due, by their receive times.

    A rate makes records due every period; taken is the message nearest to that
    moment, judged by the mean interval at which messages come. So a 10 Hz topic
    that jitters passes a rate of 10 almost undiminished, a 100 Hz topic is thinned out
    evenly, and no window of T seconds has more than rate * T + 1.5 records.
    """

    def __init__(self, rule: TopicRule) -> None:
        self._start = rule.from_ns if rule.at_ns is None else rule.at_ns
        self._end = inf if rule.until_ns is None else rule.until_ns
        self._length = rule.for_ns
        self._single = rule.once or rule.at_ns is not None
        self._done = False
        self._period = 0 if rule.rate is None else round(1e9 / rule.rate)
        self._next: int | None = None
        self._latest: int | None = None
        self._interval = 0.0

    def due(self, received_ns: int) -> bool:
        """Whether a message received then should be captured; `captured` tells that it was."""
        if self._done or (self._start is not None and received_ns < self._start):
            return False
        if self._length is not None:  # the period is known now
            self._start = received_ns if self._start is None else self._start
            self._end, self._length = min(self._end, self._start + self._length), None
        if received_ns >= self._end:
            return False
        if not self._period:
            return True
        self._measure(received_ns)
        return self._next is None or self._next - received_ns <= min(self._interval, self._period) / 2

    def captured(self, received_ns: int) -> None:
        """A due message became a record. One that could not be decoded does not count."""
        self._done = self._single
        self._next = max(self._next or received_ns, received_ns) + self._period

    def _measure(self, received_ns: int) -> None:
        """Keep the mean interval; start again when the clock stepped back."""
        gap = 0 if self._latest is None else received_ns - self._latest
        self._latest = received_ns
        if gap < -self._period:
            self._next, self._interval = None, 0.0
        elif gap > 0:
            self._interval += (gap - self._interval) / (8 if self._interval else 1)


MAX_NAME = 255  # characters; https://design.ros2.org/articles/topic_and_service_names.html


class NamePattern:
    """A topic's or node's name, or a pattern of names."""

    def __init__(self, pattern: str) -> None:
        """Raises ValueError with a sentence."""
        self.text = pattern if pattern.startswith(("/", "**")) else f"/{pattern}"
        self.is_exact = not set(pattern) & set("*?[")
        if len(self.text) > MAX_NAME:
            raise ValueError(f"{pattern[:40]!r}… has {len(self.text)} characters; ROS 2 allows {MAX_NAME}")
        self._expression = _expression(self.text)

    def matches(self, name: str) -> bool:
        """Whether `name` (with its leading slash) is meant."""
        return self._expression.fullmatch(name) is not None


_PIECE = re.compile(r"\*\*|\*|\?|\[[A-Za-z0-9_\-]+\]|[A-Za-z0-9_/]+", re.ASCII)
_MEANING = {"**": ".*", "*": "[^/]*", "?": "[^/]"}
"""Of a piece as a regular expression; letters and a class read the same in both notations."""


def _expression(pattern: str) -> re.Pattern[str]:
    pieces = _PIECE.findall(pattern)
    if "".join(pieces) == pattern and "//" not in pattern and not pattern.endswith("/"):
        with suppress(re.error):  # a range out of order
            return re.compile("".join(_MEANING.get(piece, piece) for piece in pieces), re.ASCII)
    raise ValueError(
        f"{pattern!r} is not a name or pattern: names have letters, digits, _ and / between, patterns *, **, ? and [ab]"
    )


def rule_for(topic: str, rules: Sequence[tuple[NamePattern, TopicRule]]) -> TopicRule | None:
    """The rule of a topic: the one that names it, otherwise the first whose pattern matches."""
    matching = [(pattern, rule) for pattern, rule in rules if pattern.matches(topic)]
    return next((rule for pattern, rule in matching if pattern.is_exact), matching[0][1] if matching else None)


_SEGMENT = re.compile(r"([A-Za-z][A-Za-z0-9_]*)(?:\[(\*|[0-9]{1,9})\])?", re.ASCII)

Step: TypeAlias = str | int
"""The name of a field, an index, or "*" for every element."""
Selection: TypeAlias = "Mapping[Step, Selection] | None"
"""What is selected below each step; None is everything."""


def parse_path(path: str) -> tuple[Step, ...]:
    """Steps of a path. Raises ValueError with a sentence."""
    steps: list[Step] = []
    for segment in path.split("."):
        match = _SEGMENT.fullmatch(segment)
        if match is None:
            raise ValueError(f"{path!r} is not a field path, such as pose.pose.position.x or ranges[0]")
        name, index = match.groups()
        steps += [name] if index is None else [name, "*" if index == "*" else int(index)]
    return tuple(steps)


def parse_paths(paths: Iterable[str]) -> Selection:
    """The union of the paths; "*" is the whole message, and so is no path. Raises ValueError with a sentence."""
    return _union([() if path == "*" else parse_path(path) for path in paths])


def _union(paths: Sequence[tuple[Step, ...]]) -> Selection:
    if not paths or () in paths:
        return None
    first = dict.fromkeys(path[0] for path in paths)
    if "*" in first and any(isinstance(step, int) for step in first):
        raise ValueError("one array is selected by [*] and by an index; choose one of them")
    return {step: _union([path[1:] for path in paths if path[0] == step]) for step in first}
