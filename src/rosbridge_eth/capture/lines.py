"""The lines of a log: canonical JSON (RFC 8259, UTF-8), one object a line, written and read strictly.

    a message     {"topic":"/odom","type":"nav_msgs/msg/Odometry","source":"ros1","received_ns":1763...,
                   "captured_ns":1763...,"clock":true,"data":{...}}
    a type        {"type":"nav_msgs/msg/Odometry","wire":"ros1","format":"msg","definition":"..."}
    a loss        {"lost":3,"topic":"/scan","why":"dropped"}
    an event      {"trigger":"crash","why":"/bumper data == true","at_ns":1763...}
    a stream      {"stream":{"source":"ros1","software":"rosbridge_eth 2.0"}}

Canonical: no white space, members in this order (of `data`, in that of the definition), no name twice, strings with
no escapes but \\" \\\\ \\b \\f \\n \\r \\t and \\u00XX for other control characters. Numbers are 64-bit integers or
doubles; how a double is spelled is left open, since no two languages agree. Times are integers of nanoseconds: a
reader whose JSON numbers are doubles (JavaScript) has to parse them as big integers.
"""

from __future__ import annotations

import re
from functools import lru_cache
from itertools import accumulate
from typing import Any, Final, NamedTuple, TypeAlias

import orjson

from rosbridge_eth.capture.messages import Decoder, Wire, decoder_for
from rosbridge_eth.errors import SourceError, VerificationError
from rosbridge_eth.log.chunk import MAX_LINE

MAX_DEPTH: Final = 100
"""Levels of nesting of a line; definitions of messages are nested less (capture.definitions)."""

_TOKEN = re.compile(rb'("(?:[^"\\]|\\.)*")|-?[0-9][0-9.eE+\-]*')
_STRINGS = re.compile(rb'"(?:[^"\\]|\\.)*"')


class MessageLine(NamedTuple):
    """The chosen fields of one message, with where and when.

    source: kind of the source: bag, sim, ros1, ros2.
    received_ns: when the message was received, by the bag's recorder or by a live source.
    captured_ns: when it was captured, by the robot's clock; clock: whether that was known to be synchronised then.
    data: see conversion for what each type becomes.
    """

    topic: str
    type_name: str
    source: str
    received_ns: int
    captured_ns: int
    clock: bool
    data: dict[str, Any]


class TypeLine(NamedTuple):
    """The definition of a type, before the first message of that type in a stream."""

    type_name: str
    wire: str
    format: str
    definition: str

    def decoder(self) -> Decoder:
        """The decoder by this definition. VerificationError: whoever signed it did not take it from a message."""
        try:
            if self.wire not in tuple(Wire) or self.format != "msg":
                raise SourceError(f"a {self.wire} definition as {self.format} is not known here")
            return decoder_for(Wire(self.wire), self.type_name, self.definition)
        except SourceError as error:
            raise VerificationError(f"a type in the log cannot be read: {error}") from None


class LostLine(NamedTuple):
    """Messages of a topic that were received or due and are not in the log."""

    lost: int
    topic: str
    why: str


class TriggerLine(NamedTuple):
    """An event at this time (as received_ns), for which records that were kept in memory follow."""

    trigger: str
    why: str
    at_ns: int


class StreamLine(NamedTuple):
    """The first line of a stream: the kind of source, and the software with its version."""

    source: str
    software: str


Line: TypeAlias = MessageLine | TypeLine | LostLine | TriggerLine | StreamLine

_FORMS: Final[dict[tuple[str, ...], tuple[Any, tuple[type, ...]]]] = {
    (): (None, ()),
    ("topic", "type", "source", "received_ns", "captured_ns", "clock", "data"):
        (MessageLine, (str, str, str, int, int, bool, dict)),
    ("type", "wire", "format", "definition"): (TypeLine, (str, str, str, str)),
    ("lost", "topic", "why"): (LostLine, (int, str, str)),
    ("trigger", "why", "at_ns"): (TriggerLine, (str, str, int)),
    ("source", "software"): (StreamLine, (str, str)),
}  # fmt: skip


@lru_cache(maxsize=256)
def definition_line(decoder: Decoder) -> bytes:
    """The type line of what a decoder decodes."""
    text = decoder.definition.text
    return orjson.dumps({"type": decoder.type_name, "wire": decoder.wire, "format": "msg", "definition": text})


def lost_line(count: int, topic: str, why: str) -> bytes:
    """The line for messages that are not in the log."""
    return orjson.dumps({"lost": count, "topic": topic, "why": why})


def trigger_line(trigger: str, why: str, at_ns: int) -> bytes:
    """The line before what is written because of an event."""
    return orjson.dumps({"trigger": trigger, "why": why, "at_ns": at_ns})


def stream_line(source_kind: str, software: str) -> bytes:
    """The line that opens a stream."""
    return orjson.dumps({"stream": {"source": source_kind, "software": software}})


def parse_line(line: bytes) -> Line:
    """What a line says, or VerificationError: whoever signed it did not write it by these rules."""
    if len(line) > MAX_LINE:
        raise VerificationError(f"a record has {len(line)} bytes; at most {MAX_LINE} are allowed")
    if _too_deep(line):
        raise VerificationError(f"a record is nested more than {MAX_DEPTH} deep")
    try:
        value = orjson.loads(line)  # refuses NaN, what is beyond a double, halves of surrogate pairs, bad UTF-8
        encoded = orjson.dumps(value)
    except (ValueError, TypeError) as error:
        raise VerificationError(f"a record is not JSON: {error}") from None
    # A name twice, white space, an escape too many: what is written again is not what was read.
    if encoded != line and _TOKEN.sub(_spelling_aside, encoded) != _TOKEN.sub(_spelling_aside, line):
        raise VerificationError("a record is not in its one form: no white space, no needless escapes, no name twice")
    is_stream = line.startswith(b'{"stream":{') and value.keys() == {"stream"}
    members = value["stream"] if is_stream else value
    form, kinds = _FORMS.get(tuple(members) if isinstance(members, dict) else (), _FORMS[()])
    if form is None or (form is StreamLine) != is_stream:
        kinds_of_lines = "a message, a type, a loss, an event or a stream"
        raise VerificationError(f"a record has not the members of {kinds_of_lines}, in order")
    values = tuple(members.values())
    # A time of more than 64 bits was read as a double.
    if tuple(map(type, values)) != kinds or not all(0 <= value < 1 << 63 for value in values if type(value) is int):
        wanted = ", ".join(map(_KINDS.__getitem__, kinds))
        raise VerificationError(f"{', '.join(members)} of a record are not {wanted}")
    line_found: Line = form._make(values)
    return line_found


_KINDS: Final[dict[type, str]] = {
    int: "an integer of 63 bits", str: "a string", bool: "true or false", dict: "an object",
}  # fmt: skip


def _spelling_aside(token: re.Match[bytes]) -> bytes:
    return token[1] or b"0"


def _too_deep(line: bytes) -> bool:
    """Whether brackets are nested too deeply outside strings. Before parsing: what follows may recurse."""
    if line.count(b"[") + line.count(b"{") <= MAX_DEPTH:
        return False
    steps = (1 if byte in b"[{" else -1 for byte in _STRINGS.sub(b"", line) if byte in b"[{]}")
    return max(accumulate(steps), default=0) > MAX_DEPTH
