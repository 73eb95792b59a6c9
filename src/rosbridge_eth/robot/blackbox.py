"""The black box: records of chosen topics are kept in memory and go into the log when an event happens.

A trigger is an event and what is done about it: the last `before` of its topics' records, and those of the next
`after`, are written. An event is a message for which a condition of the trigger holds, or a call of `fire`. An event
while records are still written for the one before makes that last longer.

Time is the messages' receive time, so a bag gives the same records at any replay speed. A trigger keeps at most its
`memory`: a record counts its line, and 256 bytes for the objects that hold it. What is removed for want of memory
before its time is over is counted, by the second, and is `lost` for "memory" if an event follows for which it would
have been written.

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
from rosbridge_eth.capture.process import LAST_TIME, MAX_CONVERSIONS
from rosbridge_eth.capture.restoration import NOT_FINITE
from rosbridge_eth.capture.rules import Step, parse_path, parse_paths
from rosbridge_eth.errors import ConfigError

log = logging.getLogger(__name__)

OVERHEAD: Final = 256
"""Bytes counted for each record besides its line: two tuples, an integer, a bytes object's head, a queue's place."""
SECOND: Final = 10**9

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
    sign: str
    value: bool | int | float | str

    @classmethod
    def parse(cls, text: str) -> Condition:
        """Raises ValueError with the rest of a sentence."""
        match, value = _FORM.fullmatch(text), None
        with suppress(ValueError):
            value = orjson.loads(match[4]) if match else None
        kinds = (int, float) if match and match[3] not in ("==", "!=") else (bool, int, float, str)
        if match is None or type(value) not in kinds or not (topic := NamePattern(match[1])).is_exact:
            raise ValueError(
                f"is {text!r}; write the name of a topic, a field, == or != (for a number also < <= > >=), and a"
                " number, true, false or a \"string\", such as '/bumper data == true'"
            )
        parse_path(match[2])
        return cls(text, topic.text, match[2], match[3], value)  # type: ignore[arg-type]

    def compiled(self, decoder: Decoder) -> Callable[[RawMessage], bool]:
        """A function that says whether it holds for a message of this type, or raises DecodeError. ConfigError where
        the type has no such field, or one of another kind than the constant."""
        path, compare = parse_path(self.field), _OPERATORS[self.sign]
        wanted = {bool: "true or false", str: "a string"}.get(type(self.value), "a number")
        try:
            conversion = Conversion(decoder, parse_paths([self.field]), limit=MAX_RAW)
            if (found := _kind(path, decoder)) != wanted:
                raise ConfigError(f"{self.field} of {decoder.type_name} is {found}, and compared with {wanted}")
        except ConfigError as error:
            raise ConfigError(f"the condition {self.text!r} never holds: {error}") from None
        stands_for = NOT_FINITE if wanted == "a number" else {}

        def holds(raw: RawMessage) -> bool:
            found = _at(path, conversion.convert(decoder.decode(raw.raw)))
            return any(compare(stands_for.get(each, each), self.value) for each in found)

        return holds


def _kind(path: Sequence[Step], decoder: Decoder) -> str:
    """What the field at this path is, in words; there is one."""
    description: Any = (Nodetype.NAME, decoder.type_name)
    for step in path:
        of_message = description[0] == Nodetype.NAME
        description = dict(decoder.fields[description[1]])[str(step)] if of_message else description[1][0]
    kind, what = description
    if kind == Nodetype.BASE and not (path[-1] == "*" and what[0] in BYTES):  # bytes are no list in the record
        return {"bool": "true or false", "string": "a string"}.get(what[0], "a number")
    return "a number" if what in (TIME, DURATION) else "no single value"


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
        self._early = Counter[tuple[int, str]]()  # by second of receipt and topic: what was removed before its time
        self.bytes = 0

    def __len__(self) -> int:
        return len(self._records)

    def add(self, record: Record) -> None:
        """Keep it, and remove from the front what is too old, and what there is no memory for."""
        self._records.append(record)
        self.bytes += OVERHEAD + len(record.line)
        since_ns = record.received_ns - self._length
        while self._records and (self._records[0].received_ns < since_ns or self.bytes > self._memory):
            gone = self._records.popleft()
            self.bytes -= OVERHEAD + len(gone.line)
            if gone.received_ns < since_ns:
                continue
            second, early = gone.received_ns // SECOND, self._early
            if (second, gone.topic) not in early:  # later seconds are from before the clock was set back
                self._early = Counter({key: early[key] for key in early if since_ns // SECOND <= key[0] <= second})
            self._early[second, gone.topic] += 1

    def take(self, at_ns: int) -> tuple[list[Record], Counter[str]]:
        """All that is kept at this time, which is then empty; and what was removed early, by topic."""
        since_ns = at_ns - self._length
        # All are looked at: a clock that was set back leaves records of the future in front of older ones.
        records = [record for record in self._records if record.received_ns >= since_ns]
        early = Counter[str]()
        for (second, topic), count in self._early.items():
            early[topic] += count if second >= since_ns // SECOND else 0
        self._records.clear()
        self._early.clear()
        self.bytes = 0
        return records, early


class Trigger:
    """One rule with what is kept for it, and the time in which its records are written as they come."""

    def __init__(self, rule: TriggerRule) -> None:
        self.rule, self.ring = rule, Ring(rule.before_ns, rule.memory)
        self.fired = 0
        self.open = range(0)
        """Receive times (ns) whose records are written. It has a beginning, since a clock may be set back."""

    def fire(self, at_ns: int) -> bool:
        """Whether an event at this time is one of its own, and not the same still going on."""
        begun = at_ns not in self.open
        self.fired += begun
        end = at_ns + self.rule.after_ns + 1
        self.open = range(at_ns - self.rule.before_ns, end if begun else max(end, self.open.stop))
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
        self.change_rules(rules)

    def change_rules(self, rules: Iterable[TriggerRule]) -> None:
        """Go on by other rules. What is kept for one that stays the same stays."""
        known = {trigger.rule: trigger for trigger in self.triggers.values()}
        self.triggers = {rule.name: known.get(rule) or Trigger(rule) for rule in rules}
        self._conditions: dict[str, list[tuple[Trigger, Condition]]] = {}
        self._compiled = lru_cache(MAX_CONVERSIONS * len(self.triggers))(self._compile)
        for trigger in self.triggers.values():
            for condition in trigger.rule.when:
                self._conditions.setdefault(condition.topic, []).append((trigger, condition))

    def check(self, topic: str, decoder: Decoder) -> None:
        """ConfigError now, rather than at the first message, if a condition does not fit the topic's type."""
        for _, condition in self._conditions.get(topic, ()):
            condition.compiled(decoder)

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
            log.error("%s", error)
            return lambda raw: False

    def keep(self, name: str, record: Record) -> None:
        """Take a record of a topic of this trigger: for the log, while an event lasts; else into memory."""
        trigger = self.triggers[name]
        if record.received_ns in trigger.open:
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
            self.released += [Record("", at_ns, notice, None), *records]
            self.lost.update({(topic, "memory"): count for topic, count in early.items()})
            log.warning(
                "trigger %s (%s): %d records from before are written, and what comes in the next %.3g s%s",
                trigger.rule.name, why, len(records), trigger.rule.after_ns / SECOND,
                f"; {early.total()} were removed before, for want of memory" if early else "",
            )
