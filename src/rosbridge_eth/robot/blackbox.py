"""The black box: records of chosen topics are kept in memory and go into the log when an event happens.

A trigger is an event and what is done about it: the last `before` of its topics' records, and those of the next
`after`, are written. An event is a message that a condition of the trigger holds for, or whoever calls `fire`. One that
happens while records are written for the one before only makes that last longer.

Time is the messages' receive time, so a bag gives the same records at any replay speed. A trigger keeps at most its
`memory`: a record counts its line, the definition of its type (once for all of that definition), and 256 bytes for the
objects that hold it. What has to go before its time is over is counted, by the second, and is `lost` for "memory" if
an event follows that would have had it written.

No clock and no I/O. What was kept is gone when the process ends.
"""

from __future__ import annotations

import logging
import operator
import re
from collections import Counter, deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import suppress
from functools import lru_cache
from typing import Any, Final, NamedTuple

import orjson
from rosbags.interfaces import Nodetype

from rosbridge_eth.capture import Conversion, DecodeError, Decoder, NamePattern, RawMessage, Record, trigger_line
from rosbridge_eth.capture.conversion import BYTES
from rosbridge_eth.capture.definitions import DURATION, TIME
from rosbridge_eth.capture.messages import MAX_RAW
from rosbridge_eth.capture.process import LAST_TIME
from rosbridge_eth.capture.restoration import NOT_FINITE
from rosbridge_eth.capture.rules import Step, parse_path, parse_paths
from rosbridge_eth.errors import ConfigError

log = logging.getLogger(__name__)

OVERHEAD: Final = 256
"""Bytes counted for each record besides its line: two tuples, an integer, a bytes object's head, a queue's place."""
SECOND: Final = 10**9
MAX_DECODERS: Final = 64
"""Definitions that one condition is compiled for; a publisher may bring another with each of its connections."""

_OPERATORS: Final[dict[str, Callable[[Any, Any], bool]]] = {
    "==": operator.eq, "!=": operator.ne, "<=": operator.le, ">=": operator.ge, "<": operator.lt, ">": operator.gt,
}  # fmt: skip
_FORM = re.compile(r"(\S+) +([^\s=!<>]+) *(==|!=|<=|>=|<|>) *(.+)")


class Condition(NamedTuple):
    """`/bumper data == true`: of each message of a topic, a field is compared with a constant.

    A path with [*] holds if it does for any element. NaN is equal to nothing.
    """

    text: str
    topic: str
    field: str
    path: tuple[Step, ...]
    sign: str
    value: bool | int | float | str

    @classmethod
    def parse(cls, text: str) -> Condition:
        """Raises ValueError with the rest of a sentence."""
        match = _FORM.fullmatch(text)
        try:
            value = orjson.loads(match[4]) if match else None
        except ValueError:
            value = None
        if match is None or not isinstance(value, bool | int | float | str):
            raise ValueError(
                f"is {text!r}; write a topic, a field, a comparison (== != < <= > >=) and a number, true, false or a"
                " \"string\", such as '/bumper data == true'"
            )
        if isinstance(value, bool | str) and match[3] not in ("==", "!="):
            raise ValueError(f"is {text!r}; only numbers are less or more than others")
        topic = NamePattern(match[1])
        if not topic.is_exact:
            raise ValueError(f"is {text!r}; name one topic")
        return cls(text, topic.text, match[2], parse_path(match[2]), match[3], value)

    def compiled(self, decoder: Decoder) -> Callable[[RawMessage], bool]:
        """What tells whether it holds for a message of this type, or raises DecodeError. ConfigError where the type has
        no such field, or one of another kind than the constant."""
        conversion = Conversion(decoder, parse_paths([self.field]), limit=MAX_RAW)
        wanted = {bool: "true or false", str: "a string"}.get(type(self.value), "a number")
        if (found := self._kind(decoder)) != wanted:
            raise ConfigError(f"{self.field} of {decoder.type_name} is {found}, and compared with {wanted}")
        compare = _OPERATORS[self.sign]

        def holds(raw: RawMessage) -> bool:
            found = _at(self.path, conversion.convert(decoder.decode(raw.raw)))
            if wanted == "a number":
                found = (NOT_FINITE.get(each, each) for each in found)
            return any(compare(each, self.value) for each in found)

        return holds

    def _kind(self, decoder: Decoder) -> str:
        """What the field is, in words; Conversion has found that there is one."""
        description: Any = (Nodetype.NAME, decoder.type_name)
        for step in self.path:
            if description[0] == Nodetype.NAME:
                description = dict(decoder.fields[description[1]])[str(step)]
            else:
                description = description[1][0]
                if step == "*" and description[0] == Nodetype.BASE and description[1][0] in BYTES:
                    return "bytes, of which one is named by its index"
        if description[0] == Nodetype.NAME:
            return "a number" if description[1] in (TIME, DURATION) else "a message"
        if description[0] != Nodetype.BASE:
            return "an array"
        return {"bool": "true or false", "string": "a string"}.get(description[1][0], "a number")


def _at(path: Sequence[Step], value: Any) -> Iterator[Any]:
    """The values at a path of what Conversion made."""
    if not path:
        yield value
    elif path[0] == "*":
        for each in value:
            yield from _at(path[1:], each)
    elif (step := str(path[0])) in value:
        yield from _at(path[1:], value[step])


class TriggerRule(NamedTuple):
    """An event, how much before and after it is written, and how many bytes are kept for that."""

    name: str
    before_ns: int
    after_ns: int
    memory: int
    when: tuple[Condition, ...] = ()


class Ring:
    """The newest records of a length of time that fit into so many bytes, in the order in which they came."""

    def __init__(self, length_ns: int, memory: int) -> None:
        self._length, self._memory = length_ns, memory
        self._records: deque[Record] = deque()
        self._definitions: Counter[bytes] = Counter()
        self._early: dict[int, Counter[str]] = {}  # second of receipt -> topics of what had to go before its time
        self.bytes = 0

    def __len__(self) -> int:
        return len(self._records)

    def add(self, record: Record) -> None:
        """Keep it, and no longer what it leaves no time or room for."""
        self._records.append(record)
        self.bytes += self._size(record, +1)
        while self._records and self._records[0].received_ns < record.received_ns - self._length:
            self._pop()
        while self.bytes > self._memory:
            gone = self._pop()
            second = gone.received_ns // SECOND
            if second not in self._early:  # those of the future are a clock's that was set back
                oldest = (record.received_ns - self._length) // SECOND
                self._early = {key: held for key, held in self._early.items() if oldest <= key <= second}
                self._early[second] = Counter()
            self._early[second][gone.topic] += 1

    def take(self, at_ns: int) -> tuple[list[Record], Counter[str]]:
        """All that is kept at this time, which is then empty; and what had to go early, by topic."""
        since_ns = at_ns - self._length
        # All are looked at: a clock that was set back leaves records of the future in front of older ones.
        records = [record for record in self._records if record.received_ns >= since_ns]
        early = sum((held for second, held in self._early.items() if second >= since_ns // SECOND), Counter[str]())
        self._records.clear()
        self._definitions.clear()
        self._early.clear()
        self.bytes = 0
        return records, early

    def _pop(self) -> Record:
        record = self._records.popleft()
        self.bytes -= self._size(record, -1)
        return record

    def _size(self, record: Record, change: int) -> int:
        """Bytes that it takes, or gives back: its definition's if it is the first, or was the last, to refer to it."""
        definition = b"" if record.definition is None else record.definition[1]
        others = self._definitions[definition] - (change < 0)
        self._definitions[definition] += change
        if not self._definitions[definition]:
            del self._definitions[definition]
        return OVERHEAD + len(record.line) + (0 if others else len(definition))


class Trigger:
    """One rule with what is kept for it, and the time in which its records are written as they come."""

    def __init__(self, rule: TriggerRule) -> None:
        self.rule, self.ring = rule, Ring(rule.before_ns, rule.memory)
        self.fired = 0
        self._begin, self._end = 0, -1

    def is_open(self, at_ns: int) -> bool:
        return self._begin <= at_ns <= self._end

    def fire(self, at_ns: int) -> bool:
        """Whether an event at this time is one of its own, and not the same still going on."""
        begun = not self.is_open(at_ns)
        self.fired += begun
        self._end = at_ns + self.rule.after_ns if begun else max(self._end, at_ns + self.rule.after_ns)
        self._begin = at_ns - self.rule.before_ns
        return begun


class BlackBox:
    """All triggers of a robot. What is to be written now is in `released`, in its order.

    lost: what had to go for want of memory and would have been written, by topic and "memory".
    newest_ns: when the newest message was received.
    """

    def __init__(self, rules: Iterable[TriggerRule]) -> None:
        self.triggers: dict[str, Trigger] = {}
        self.released: deque[Record] = deque()
        self.lost: Counter[tuple[str, str]] = Counter()
        self.newest_ns = 0
        self.take_up(rules)

    def take_up(self, rules: Iterable[TriggerRule]) -> None:
        """Go on by other rules. What is kept for one that stays the same stays."""
        known = self.triggers
        self.triggers = {
            rule.name: known[rule.name] if rule.name in known and known[rule.name].rule == rule else Trigger(rule)
            for rule in rules
        }
        self._conditions: dict[str, list[tuple[Trigger, Condition]]] = {}
        self._compiled = lru_cache(MAX_DECODERS)(self._compile)
        for trigger in self.triggers.values():
            for condition in trigger.rule.when:
                self._conditions.setdefault(condition.topic, []).append((trigger, condition))

    def check(self, topic: str, decoder: Decoder) -> None:
        """ConfigError now, rather than at the first message, if a condition does not fit the topic's type."""
        for trigger, condition in self._conditions.get(topic, ()):
            try:
                condition.compiled(decoder)
            except ConfigError as error:
                raise ConfigError(f"trigger {trigger.rule.name}: {condition.text!r} never holds: {error}") from None

    def look(self, raw: RawMessage) -> None:
        """Whether this message is an event; every message of a condition's topic is looked at, captured or not."""
        self.newest_ns = raw.received_ns
        for trigger, condition in self._conditions.get(raw.topic, ()):
            with suppress(DecodeError):  # capture tells of it
                if self._compiled(condition, raw.decoder)(raw):
                    self.fire(raw.received_ns, condition.text, trigger.rule.name)

    def _compile(self, condition: Condition, decoder: Decoder) -> Callable[[RawMessage], bool]:
        try:
            return condition.compiled(decoder)
        except ConfigError as error:
            log.error("%r does not hold for this type: %s", condition.text, error)
            return lambda raw: False

    def keep(self, name: str, record: Record) -> None:
        """Take a record of a topic of this trigger: for the log, while an event lasts; else into memory."""
        trigger = self.triggers[name]
        if trigger.is_open(record.received_ns):
            self.released.append(record)
        else:
            trigger.ring.add(record)

    def fire(self, at_ns: int, why: str, name: str | None = None) -> None:
        """An event of this trigger, or of all: release what is kept, behind a line that says why."""
        for trigger in self.triggers.values() if name is None else [self.triggers[name]]:
            if not trigger.fire(at_ns):
                continue
            records, early = trigger.ring.take(at_ns)
            notice = trigger_line(trigger.rule.name, why, min(max(at_ns, 0), LAST_TIME))
            self.released.append(Record("", at_ns, notice, None))
            self.released += records
            self.lost.update({(topic, "memory"): count for topic, count in early.items()})
            log.warning(
                "trigger %s (%s): %d records from before are written, and what comes in the next %.3g s%s",
                trigger.rule.name, why, len(records), trigger.rule.after_ns / SECOND,
                f"; {early.total()} had to go before, for want of memory" if early else "",
            )
