"""From a raw message to a record: is it due, decode it, choose its fields, keep it within bounds.

No clock and no I/O: times come in as arguments, and what a person should hear
goes out through a callback, once per topic and cause. Not thread-safe: one
thread feeds one Capture.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from enum import StrEnum

from rosbridge_eth.capture.conversion import Conversion, FieldTooLarge, to_json
from rosbridge_eth.capture.messages import DecodeError, Decoder, RawMessage
from rosbridge_eth.capture.paths import DEFAULT_FIELDS, EVERYTHING, Selection, parse_paths
from rosbridge_eth.capture.record import CapturedRecord
from rosbridge_eth.capture.rules import NamePattern, Schedule, TopicRule, rule_for
from rosbridge_eth.errors import ConfigError

MAX_DATA = 30 * 1024
"""Bytes of one record's data as JSON, so that what is sealed never exceeds 32 KiB even if it does not compress."""

MAX_CONVERSIONS = 8
"""Of one topic, for as many types or definitions; a publisher may bring another one with each of its connections."""

log = logging.getLogger(__name__)


class Cause(StrEnum):
    """Why a message was not captured as it came."""

    FIELD_DIGESTED = "field_digested"  # captured, with a digest in place of a large field
    FIELD_MISSING = "field_missing"
    FIELD_TOO_LARGE = "field_too_large"
    RECORD_TOO_LARGE = "record_too_large"
    UNDECODABLE = "undecodable"


@dataclass(frozen=True, slots=True)
class Notice:
    """Said once per topic and cause; the counters say how often it happened."""

    topic: str
    cause: Cause
    text: str


@dataclass(frozen=True, slots=True)
class TopicStatistics:
    """Messages of one topic so far. seen = captured + not_due + refused + undecodable."""

    seen: int = 0
    captured: int = 0
    not_due: int = 0
    refused: int = 0
    undecodable: int = 0
    fields_digested: int = 0


@dataclass
class _Topic:
    rule: TopicRule
    selection: Selection | None  # None: the default of each type
    schedule: Schedule
    conversions: dict[Decoder, Conversion] = field(default_factory=dict)
    said: set[Cause] = field(default_factory=set)
    captured: int = 0
    not_due: int = 0
    refused: int = 0
    undecodable: int = 0
    fields_digested: int = 0

    def statistics(self) -> TopicStatistics:
        seen = self.captured + self.not_due + self.refused + self.undecodable
        return TopicStatistics(seen, self.captured, self.not_due, self.refused, self.undecodable, self.fields_digested)


def _log(notice: Notice) -> None:
    log.warning("%s: %s", notice.topic, notice.text)


class Capture:
    """Captures by rules; a topic that none of them names or matches is not captured.

    notify: is given each Notice; by default it is logged as a warning.
    live: types come from whoever publishes, so a message whose type lacks a field of its rule is refused; without it,
    that is an error of the configuration.
    """

    def __init__(
        self, rules: Sequence[TopicRule], notify: Callable[[Notice], None] = _log, *, live: bool = False
    ) -> None:
        """Raises ValueError with a sentence for a rule with a malformed pattern or field path."""
        self._rules = [(NamePattern(rule.topic), rule) for rule in rules]
        self._selections = {id(rule): parse_paths(rule.fields) for rule in rules if rule.fields}
        self._topics: dict[str, _Topic | None] = {}
        self._notify = notify
        self._live = live

    def process(
        self, raw: RawMessage, wall_ns: int, mono_ns: int, clock_synchronised: bool = False
    ) -> CapturedRecord | None:
        """The record of a message, or None if it is not due, refused or cannot be decoded.

        Raises ConfigError if the rule names a field that the message's type does not have, unless `live`.
        """
        topic = self._topic(raw.topic)
        if topic is None:
            return None
        if not topic.schedule.due(raw.received_ns):
            topic.not_due += 1
            return None
        try:
            conversion = topic.conversions.get(raw.decoder) or self._compile(topic, raw.decoder)
        except ConfigError as error:
            if not self._live:
                raise
            topic.refused += 1
            self._say(raw.topic, topic, Cause.FIELD_MISSING, f"a message is left out: {error}")
            return None
        digested_before = conversion.digested
        try:
            data = conversion.convert(raw.decoder.decode(raw.raw))
        except DecodeError as error:
            topic.undecodable += 1
            self._say(raw.topic, topic, Cause.UNDECODABLE, f"a message cannot be decoded and is left out: {error}")
            return None
        except FieldTooLarge as error:
            topic.refused += 1
            self._say(
                raw.topic,
                topic,
                Cause.FIELD_TOO_LARGE,
                f"a message is left out: {error}, more than {topic.rule.limit}; "
                'choose other fields, or oversize = "digest"',
            )
            return None
        data_json = to_json(data)
        if len(data_json) > MAX_DATA or (not data_json.isascii() and len(data_json.encode()) > MAX_DATA):
            topic.refused += 1
            self._say(
                raw.topic,
                topic,
                Cause.RECORD_TOO_LARGE,
                f"a message is left out: its fields come to more than {MAX_DATA} bytes of JSON; choose fewer fields",
            )
            return None
        digested = conversion.digested - digested_before
        if digested:
            self._say(
                raw.topic,
                topic,
                Cause.FIELD_DIGESTED,
                f"{conversion.last_digested} is above {topic.rule.limit} bytes: its SM3 digest is captured instead",
            )
        topic.schedule.captured(raw.received_ns)
        topic.captured += 1
        topic.fields_digested += digested
        return CapturedRecord(
            raw.topic,
            raw.type_name,
            raw.received_ns,
            wall_ns,
            mono_ns,
            clock_synchronised,
            data,
            topic.rule.delivery,
            data_json,
        )

    def check(self, topic: str, decoder: Decoder) -> None:
        """ConfigError now, rather than at the first message, if the topic's rule does not fit the type."""
        state = self._topic(topic)
        if state is not None:
            self._compile(state, decoder)

    def statistics(self) -> Mapping[str, TopicStatistics]:
        """By topic, in the order in which they were first seen."""
        return {name: topic.statistics() for name, topic in self._topics.items() if topic is not None}

    @property
    def finished(self) -> bool:
        """Every rule names one topic and none of them will capture anything more."""
        return all(
            pattern.is_exact and (topic := self._topics.get(pattern.text)) is not None and topic.schedule.finished
            for pattern, _ in self._rules
        )

    def _topic(self, name: str) -> _Topic | None:
        if name not in self._topics:
            rule = rule_for(name, self._rules)
            self._topics[name] = None if rule is None else _Topic(rule, self._selections.get(id(rule)), Schedule(rule))
        return self._topics[name]

    def _compile(self, topic: _Topic, decoder: Decoder) -> Conversion:
        selection = topic.selection
        if selection is None:
            defaults = DEFAULT_FIELDS.get(decoder.type_name)
            selection = parse_paths(defaults) if defaults else EVERYTHING
        conversion = Conversion(decoder, selection, limit=topic.rule.limit, oversize=topic.rule.oversize)
        while len(topic.conversions) >= MAX_CONVERSIONS:
            del topic.conversions[next(iter(topic.conversions))]
        topic.conversions[decoder] = conversion
        return conversion

    def _say(self, name: str, topic: _Topic, cause: Cause, text: str) -> None:
        if cause not in topic.said:
            topic.said.add(cause)
            self._notify(Notice(name, cause, text))
