"""From a raw message to a line: is it due, decode it, choose its fields, write it, keep it within bounds.

No clock and no I/O: times come in as arguments. What a person should hear is logged once per topic and cause; the
counters say how often it happened. Not thread-safe: one thread feeds one Capture.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from enum import StrEnum
from functools import lru_cache, partial
from typing import Final, NamedTuple

import orjson

from rosbridge_eth.capture.conversion import Conversion
from rosbridge_eth.capture.lines import definition_line, lost_line
from rosbridge_eth.capture.messages import DecodeError, Decoder, RawMessage
from rosbridge_eth.capture.rules import NamePattern, Schedule, TopicRule, parse_paths, rule_for
from rosbridge_eth.errors import ConfigError
from rosbridge_eth.log.chunk import MAX_LINE

MAX_CONVERSIONS: Final = 8
"""Of one topic, for as many types or definitions; a publisher may bring another one with each of its connections."""
LAST_TIME: Final = 2**63 - 1
"""Nanoseconds since 1970, in a line."""

log = logging.getLogger(__name__)


class Cause(StrEnum):
    """Why a message was not captured."""

    FIELD_MISSING = "field_missing"
    RECORD_TOO_LARGE = "record_too_large"
    UNDECODABLE = "undecodable"


class Record(NamedTuple):
    """A line on its way to the writer. definition: as LogWriter.add takes it; trigger: as in its rule."""

    topic: str
    received_ns: int
    line: bytes
    definition: tuple[str, bytes] | None
    trigger: str | None = None


@dataclass
class _Topic:
    rule: TopicRule
    schedule: Schedule
    conversion: Callable[[Decoder], Conversion]  # compiled once for each of MAX_CONVERSIONS; ConfigError


class Capture:
    """Captures by rules; a topic that none of them names or matches is not captured.

    source_kind: stands in every line.
    live: types come from whoever publishes, so a message whose type lacks a field of its rule is refused; without it,
    that is an error of the configuration.
    lost: messages so far that were left out, by topic and Cause.
    """

    def __init__(self, rules: Sequence[TopicRule], *, source_kind: str, live: bool = False) -> None:
        """Raises ValueError with a sentence for a rule with a malformed pattern or field path."""
        self.lost: Counter[tuple[str, str]] = Counter()
        self._topics: dict[str, _Topic | None] = {}
        self._source_kind = source_kind
        self._live = live
        self._declared: Counter[tuple[str, str]] = Counter()  # losses that are in a line already, by topic and why
        self.change_rules(rules)

    def change_rules(self, rules: Sequence[TopicRule]) -> None:
        """Go on by other rules. A topic whose rule stays the same goes on as it is. ValueError: by the old ones."""
        patterns, selections = [NamePattern(rule.topic) for rule in rules], [parse_paths(rule.fields) for rule in rules]
        self._rules = list(zip(patterns, rules, strict=True))
        self._selections = dict(zip(rules, selections, strict=True))
        self._topics = {name: topic for name, topic in self._topics.items()
                        if topic is not None and topic.rule == rule_for(name, self._rules)}  # fmt: skip

    def process(self, raw: RawMessage, wall_ns: int, clock_synchronised: bool = False) -> Record | None:
        """The record of a message, or None if it is not due, refused or cannot be decoded.

        Raises ConfigError if the rule names a field that the message's type does not have, unless `live`.
        """
        topic = self._topic(raw.topic)
        if topic is None or not topic.schedule.due(raw.received_ns):
            return None
        try:
            conversion = topic.conversion(raw.decoder)
            if not 0 <= raw.received_ns <= LAST_TIME:
                raise DecodeError(f"its receive time is {raw.received_ns}")
            data = conversion.convert(raw.decoder.decode(raw.raw))
        except ConfigError as error:
            if not self._live:
                raise
            return self._left_out(raw, Cause.FIELD_MISSING, str(error))
        except DecodeError as error:
            return self._left_out(raw, Cause.UNDECODABLE, f"it cannot be decoded: {error}")
        line = orjson.dumps({
            "topic": raw.topic, "type": raw.type_name, "source": self._source_kind,
            "received_ns": raw.received_ns, "captured_ns": wall_ns, "clock": clock_synchronised, "data": data,
        })  # fmt: skip
        if len(line) > MAX_LINE:
            why = f"its fields come to more than {MAX_LINE} bytes of JSON; choose fewer fields"
            return self._left_out(raw, Cause.RECORD_TOO_LARGE, why)
        topic.schedule.captured(raw.received_ns)
        definition = raw.type_name, definition_line(raw.decoder)
        return Record(raw.topic, raw.received_ns, line, definition, topic.rule.trigger)

    def check(self, topic: str, decoder: Decoder) -> None:
        """ConfigError now, rather than at the first message, if the topic's rule does not fit the type."""
        state = self._topic(topic)
        if state is not None:
            state.conversion(decoder)

    def loss_lines(self, source_lost: Mapping[tuple[str, str], int]) -> list[bytes]:
        """The lines for what was refused here, and lost by the source (`Source.lost`), since the last call."""
        so_far = Counter(source_lost) + self.lost
        new, self._declared = so_far - self._declared, so_far
        return [lost_line(count, *key) for key, count in new.items()]

    def _topic(self, name: str) -> _Topic | None:
        if name not in self._topics:
            rule = rule_for(name, self._rules)
            self._topics[name] = None if rule is None else _Topic(
                rule, Schedule(rule),
                lru_cache(MAX_CONVERSIONS)(partial(Conversion, selection=self._selections[rule], limit=rule.limit)),
            )  # fmt: skip
        return self._topics[name]

    def _left_out(self, raw: RawMessage, cause: Cause, why: str) -> Record | None:
        """Count it; None is what became of it."""
        self.lost[raw.topic, cause] += 1
        if self.lost[raw.topic, cause] == 1:
            log.warning("%s: a message is left out: %s", raw.topic, why)
        return None
