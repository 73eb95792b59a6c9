"""What was captured of one message: the plaintext that is sealed, and that a reader gets back.

As bytes it is one JSON object (RFC 8259, UTF-8, no white space), its members in
this order:

    {"v":1,"topic":"/robot_1/odom","type":"nav_msgs/msg/Odometry","received_ns":1763...,
     "wall_ns":1763...,"mono_ns":8412...,"clock":true,"delivery":"reliable","data":{...}}

Times are integers of nanoseconds and need 64 bits: a reader whose JSON numbers
are doubles (JavaScript) has to parse them as big integers.
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass, field
from typing import Any, Literal, TypeAlias, get_args

from rosbridge_eth.capture.conversion import to_json
from rosbridge_eth.errors import VerificationError

Delivery: TypeAlias = Literal["reliable", "latest"]
DELIVERIES: tuple[Delivery, ...] = get_args(Delivery)
VERSION = 1
MAX_DEPTH = 100
"""Levels of nesting of a record's JSON; definitions of messages are nested less (capture.definitions)."""
_STRINGS = re.compile(rb'"(?:[^"\\]|\\.)*"')


@dataclass(frozen=True, slots=True)
class CapturedRecord:
    """The chosen fields of one message, with where and when.

    received_ns: when the message was received, by the bag's recorder or by a live source.
    wall_ns, mono_ns: when it was captured, by the robot's wall and monotonic clocks.
    clock_synchronised: whether the wall clock was known to be synchronised then.
    data: JSON-ready; see conversion for what each type becomes.
    """

    topic: str
    type_name: str
    received_ns: int
    wall_ns: int
    mono_ns: int
    clock_synchronised: bool
    data: dict[str, Any]
    delivery: Delivery
    data_json: str | None = field(default=None, compare=False, repr=False)
    """`data` as JSON where capture has it already: it has to know the length."""

    def to_json(self) -> bytes:
        """Deterministic and compact: equal records give equal bytes."""
        head = to_json(
            {
                "v": VERSION,
                "topic": self.topic,
                "type": self.type_name,
                "received_ns": self.received_ns,
                "wall_ns": self.wall_ns,
                "mono_ns": self.mono_ns,
                "clock": self.clock_synchronised,
                "delivery": self.delivery,
            }
        )
        data = to_json(self.data) if self.data_json is None else self.data_json
        return f'{head[:-1]},"data":{data}}}'.encode()

    @classmethod
    def from_json(cls, encoded: bytes) -> CapturedRecord:
        """The record again, or VerificationError: whoever signed it did not write it by these rules."""
        if _depth(encoded) > MAX_DEPTH:
            raise VerificationError(f"a record's content is nested more than {MAX_DEPTH} deep")
        try:
            value = json.loads(encoded.decode(), parse_constant=_refuse_constant)
        except (ValueError, RecursionError) as error:
            raise VerificationError(f"a record's content is not JSON: {error}") from None
        if not isinstance(value, dict) or value.keys() != _MEMBERS.keys():
            raise VerificationError(f"a record's content is not an object of {', '.join(_MEMBERS)}")
        for name, kind in _MEMBERS.items():
            if type(value[name]) is not kind:
                raise VerificationError(f"{name!r} of a record's content is not {_KINDS[kind]}")
        if value["v"] != VERSION:
            raise VerificationError(f"a record's content has version {value['v']}; this reader knows {VERSION}")
        if value["delivery"] not in DELIVERIES:
            raise VerificationError(f"'delivery' of a record's content is not one of {', '.join(DELIVERIES)}")
        record = cls(
            value["topic"],
            value["type"],
            value["received_ns"],
            value["wall_ns"],
            value["mono_ns"],
            value["clock"],
            value["data"],
            value["delivery"],
        )
        # Also refuses what JSON allows and these rules do not: a name twice, 1e999, half of a surrogate pair.
        try:
            canonical = record.to_json() == encoded
        except (ValueError, RecursionError):
            canonical = False
        if not canonical:
            raise VerificationError("a record's content is not in its one form: no white space, members in order")
        return record


def _depth(encoded: bytes) -> int:
    """How deep brackets are nested outside strings; 0 where there are too few of them to matter.

    Before parsing: Python's JSON parser stops at the recursion limit, which a library may have raised until
    the C stack ends first.
    """
    if encoded.count(b"[") + encoded.count(b"{") <= MAX_DEPTH:
        return 0
    depth = deepest = 0
    for byte in _STRINGS.sub(b"", encoded):
        if byte in b"[{":
            depth += 1
            deepest = max(deepest, depth)
        elif byte in b"]}":
            depth -= 1
    return deepest


_MEMBERS: dict[str, type] = {
    "v": int,
    "topic": str,
    "type": str,
    "received_ns": int,
    "wall_ns": int,
    "mono_ns": int,
    "clock": bool,
    "delivery": str,
    "data": dict,
}
_KINDS: dict[type, str] = {int: "an integer", str: "a string", bool: "true or false", dict: "an object"}


def _refuse_constant(name: str) -> float:
    raise ValueError(f"{name} is not JSON")
