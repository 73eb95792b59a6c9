"""A record's data back to a message, for those who write what they read from the chain into a bag.

The inverse of conversion. What was not captured (fields not selected, fields whose digest stands for them) is left
zero, and named. A message of ROS 1 can be written as one of ROS 2 and the other way round: the fields are those of
its definition, but for the `seq` of a header, which only ROS 1 has.
"""

from __future__ import annotations

from base64 import b64decode
from collections.abc import Callable, Mapping
from functools import cached_property, partial
from typing import Any, Final, NamedTuple, TypeAlias

import numpy
from rosbags.interfaces import Nodetype
from rosbags.interfaces.typing import FieldDesc

from rosbridge_eth.capture.conversion import BYTES
from rosbridge_eth.capture.definitions import DURATION, HEADER, NUMBERS, TIME, check_types, write_text
from rosbridge_eth.capture.messages import Decoder, Wire
from rosbridge_eth.errors import SourceError, VerificationError

_SECOND: Final = 10**9
_UINT32: Final = 2**32
NOT_FINITE: Final = {"NaN": float("nan"), "Infinity": float("inf"), "-Infinity": float("-inf")}

Builder: TypeAlias = Callable[[Any, list[str]], Any]
"""Takes the JSON value (or _ABSENT) and the list to which paths of what is missing are added."""


_ABSENT: Final = object()
"""Stands for a value that was not captured."""


class Restored(NamedTuple):
    """A message object of rosbags, and the paths that are zero in it because they were not captured."""

    message: Any
    missing: tuple[str, ...]


class Restoration:
    """Builds messages of one type, to be written with `decoder`: `decoder.encode(restored.message)`.

    captured: the decoder by the definition that the log has (TypeLine.decoder); wire: how the messages are to be
    written, by default as they were.
    """

    def __init__(self, captured: Decoder, wire: Wire | None = None) -> None:
        """VerificationError for a type that this wire cannot have."""
        if (wire or captured.wire) is Wire.ROS1 and any("/msg/" not in name for name in captured.fields):
            raise VerificationError(f"{captured.type_name}: ROS 1 has no messages of actions and services")
        self.decoder = captured if wire in (None, captured.wire) else _rewired(captured, wire)
        # Of a header, what may stand in the data beside its fields, and what need not.
        rewired = self.decoder is not captured
        self._foreign = {"seq"} if rewired and self.decoder.wire is Wire.CDR else set()
        self._new = {"seq"} if rewired and self.decoder.wire is Wire.ROS1 else set()
        self._build = self._message(captured.type_name, "")

    def restore(self, data: Mapping[str, Any]) -> Restored:
        """The message of a record's data; VerificationError if the data does not fit the type."""
        missing: list[str] = []
        message = self._build(data, missing)
        return Restored(message, tuple(missing))

    @cached_property
    def connection(self) -> dict[str, str]:
        """What `add_connection` of rosbags' writers is to know of the type, besides topic and name."""
        definition = self.decoder.definition
        if self.decoder.wire is Wire.ROS1:
            return {"msgdef": definition.text, "md5sum": definition.md5}
        return {"msgdef": definition.text, "rihs01": self.decoder.typestore.hash_rihs01(definition.type_name)}

    def _message(self, type_name: str, path: str) -> Builder:
        make = self.decoder.typestore.types[type_name]
        members = [
            (name, self._value(description, f"{path}.{name}" if path else name))
            for name, description in self.decoder.fields[type_name]
        ]
        foreign, new = (self._foreign, self._new) if type_name == HEADER else (set(), set())
        names = {name for name, _ in members} | foreign

        def build(data: Any, missing: list[str]) -> Any:
            if data is _ABSENT:
                missing.append(path)
                return make(*[builder(_ABSENT, []) for _, builder in members])
            if not isinstance(data, dict) or not data.keys() <= names:
                raise _unfit(path or type_name, data)
            return make(
                *[builder(data.get(name, _ABSENT), [] if name in new else missing) for name, builder in members]
            )

        return build

    def _value(self, description: FieldDesc, path: str) -> Builder:
        if description[0] == Nodetype.BASE:
            if description[1][0] == "string":
                return _leaf(path, str, partial(_exactly, str))
            kind = NUMBERS[description[1][0]]
            # A byte is signed in ROS 1, unsigned in ROS 2; rosbags packs it as signed.
            read = _signed if description[1][0] == "byte" else partial(_checked, kind)
            return _leaf(path, lambda: kind.type(0).item(), read)
        if description[0] == Nodetype.NAME:
            if description[1] in (TIME, DURATION):
                return self._instant(description[1], path)
            return self._message(description[1], path)
        element, count = description[1]
        length = count if description[0] == Nodetype.ARRAY else None
        if element[0] == Nodetype.BASE and element[1][0] != "string":
            return _numbers(element[1][0], length, path)
        return _list(self._value(element, f"{path}[*]"), length, path)

    def _instant(self, type_name: str, path: str) -> Builder:
        make = self.decoder.typestore.types[type_name]
        unsigned = self.decoder.wire is Wire.ROS1 and type_name == TIME
        first = 0 if unsigned else -_UINT32 // 2

        def read(data: Any) -> Any:
            seconds, nanoseconds = divmod(_exactly(int, data), _SECOND)
            if not first <= seconds < first + _UINT32:
                raise ValueError
            # rosbags writes the seconds as int32: the same 32 bits as ROS 1's uint32.
            return make((seconds + _UINT32 // 2) % _UINT32 - _UINT32 // 2, nanoseconds)

        return _leaf(path, lambda: make(0, 0), read)


def _leaf(path: str, zero: Callable[[], Any], read: Callable[[Any], Any]) -> Builder:
    """The builder of a field without fields. An object stands there for a value: a digest, or single elements."""

    def build(data: Any, missing: list[str]) -> Any:
        if data is _ABSENT or isinstance(data, dict):
            missing.append(path)
            return zero()
        try:
            return read(data)
        except (TypeError, ValueError):
            raise _unfit(path, data) from None

    return build


def _numbers(base: str, length: int | None, path: str) -> Builder:
    kind, binary = NUMBERS[base], base in BYTES

    def read(data: Any) -> Any:
        if binary:
            array = numpy.frombuffer(b64decode(data, validate=True), kind)
        else:
            array = numpy.array([_checked(kind, item) for item in _exactly(list, data)], kind)
        if length not in (None, len(array)):
            raise ValueError
        return array

    return _leaf(path, lambda: numpy.zeros(length or 0, kind), read)


def _list(builder: Builder, length: int | None, path: str) -> Builder:
    def build(data: Any, missing: list[str]) -> Any:
        if data is _ABSENT or isinstance(data, dict):  # as of a leaf
            missing.append(path)
            return [builder(_ABSENT, []) for _ in range(length or 0)]
        if not isinstance(data, list) or length not in (None, len(data)):
            raise _unfit(path, data)
        below: list[str] = []
        items = [builder(item, below) for item in data]
        missing.extend(dict.fromkeys(below))
        return items

    return build


def _rewired(captured: Decoder, wire: Wire | None) -> Decoder:
    """The decoder of the same type in the other wire form."""
    ros1 = wire is Wire.ROS1
    types = dict(captured.fields)
    if HEADER in types:
        header = [field for field in types[HEADER] if field[0] != "seq"]
        types[HEADER] = [("seq", (Nodetype.BASE, ("uint32", 0))), *header] if ros1 else header
    try:
        text = write_text(captured.type_name, types, ros1=ros1)
        return Decoder(wire or captured.wire, check_types(captured.type_name, types, text))
    except SourceError as error:
        raise VerificationError(f"{captured.type_name} cannot be written as {wire}: {error}") from None


def _exactly(kind: type, data: Any) -> Any:
    if type(data) is not kind:
        raise TypeError
    return data


def _signed(data: Any) -> Any:
    return data - 256 if type(data) is int and 127 < data < 256 else _checked(numpy.dtype("i1"), data)


def _checked(kind: numpy.dtype[Any], data: Any) -> Any:
    """The number, if it is one of this kind; else ValueError or TypeError."""
    if kind.kind == "b":
        return _exactly(bool, data)
    if kind.kind == "f":
        if isinstance(data, str) and data in NOT_FINITE:
            return NOT_FINITE[data]
        largest = float(numpy.finfo(kind).max)
        fits = -largest <= _exactly(float, data) <= largest
    else:
        limits = numpy.iinfo(kind)
        fits = limits.min <= _exactly(int, data) <= limits.max
    if not fits:
        raise ValueError
    return data


def _unfit(path: str, data: Any) -> VerificationError:
    shown = repr(data)
    return VerificationError(
        f"a record's {path} does not fit its type: {shown if len(shown) < 60 else shown[:57] + '...'}"
    )
