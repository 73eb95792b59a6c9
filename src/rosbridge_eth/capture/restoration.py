"""A record's data back to a message, for those who write what they read from the chain into a bag.

The inverse of conversion. What was not captured (fields not selected, fields whose digest stands for them) is left
zero, and named. A message of ROS 1 can be written as one of ROS 2 and the other way round: the fields are those of
its definition, but for the `seq` of a header, which only ROS 1 has.
"""

from __future__ import annotations

import binascii
from base64 import b64decode
from collections.abc import Callable, Mapping
from dataclasses import dataclass
from typing import Any, Final, TypeAlias

import numpy
from rosbags.interfaces import Nodetype
from rosbags.interfaces.typing import FieldDesc

from rosbridge_eth.capture.conversion import NUMPY
from rosbridge_eth.capture.definitions import DURATION, HEADER, TIME, check_types, write_text
from rosbridge_eth.capture.messages import Decoder, Wire
from rosbridge_eth.errors import SourceError, VerificationError

_SECOND: Final = 10**9
_UINT32: Final = 2**32
_BYTES: Final = frozenset({"uint8", "char", "byte"})
NOT_FINITE: Final = {"NaN": float("nan"), "Infinity": float("inf"), "-Infinity": float("-inf")}

Builder: TypeAlias = Callable[[Any, list[str]], Any]
"""Takes the JSON value (or _ABSENT) and the list to which paths of what is missing are added."""


class _Absent:
    """Stands for a value that was not captured."""


_ABSENT: Final = _Absent()


@dataclass(frozen=True, slots=True)
class Restored:
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

    def connection(self) -> dict[str, Any]:
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
            return _string(path) if description[1][0] == "string" else self._number(description[1][0], path)
        if description[0] == Nodetype.NAME:
            if description[1] in (TIME, DURATION):
                return self._instant(description[1], path)
            return self._message(description[1], path)
        element, count = description[1]
        length = count if description[0] == Nodetype.ARRAY else None
        if element[0] == Nodetype.BASE and element[1][0] != "string":
            return self._numbers(element[1][0], length, path)
        return self._list(self._value(element, f"{path}[*]"), length, path)

    def _number(self, base: str, path: str) -> Builder:
        kind = numpy.dtype(NUMPY[base])
        is_byte = base == "byte"  # signed in ROS 1, unsigned in ROS 2; rosbags packs it as signed

        def build(data: Any, missing: list[str]) -> Any:
            if data is _ABSENT:
                missing.append(path)
                return kind.type(0).item()
            if is_byte and type(data) is int and 0 <= data < 256:
                return data - 256 if data > 127 else data
            return _checked(data, kind, path)

        return build

    def _numbers(self, base: str, length: int | None, path: str) -> Builder:
        kind = numpy.dtype(NUMPY[base])

        def build(data: Any, missing: list[str]) -> Any:
            if data is _ABSENT or (isinstance(data, dict) and base not in _BYTES) or _is_digest(data):
                missing.append(path)
                return numpy.zeros(length or 0, kind)
            if base in _BYTES:
                array = numpy.frombuffer(_base64(data, path), kind)
            elif isinstance(data, list):
                array = numpy.array([_checked(item, kind, path) for item in data], kind)
            else:
                raise _unfit(path, data)
            if length is not None and len(array) != length:
                raise _unfit(path, data)
            return array

        return build

    def _list(self, builder: Builder, length: int | None, path: str) -> Builder:
        def build(data: Any, missing: list[str]) -> Any:
            if data is _ABSENT or isinstance(data, dict):  # a digest, or single elements
                missing.append(path)
                return [builder(_ABSENT, []) for _ in range(length or 0)]
            if not isinstance(data, list) or (length is not None and len(data) != length):
                raise _unfit(path, data)
            below: list[str] = []
            items = [builder(item, below) for item in data]
            missing.extend(dict.fromkeys(below))
            return items

        return build

    def _instant(self, type_name: str, path: str) -> Builder:
        make = self.decoder.typestore.types[type_name]
        ros1 = self.decoder.wire is Wire.ROS1
        unsigned = ros1 and type_name == TIME

        def build(data: Any, missing: list[str]) -> Any:
            if data is _ABSENT:
                missing.append(path)
                return make(0, 0)
            if type(data) is not int:
                raise _unfit(path, data)
            seconds, nanoseconds = divmod(data, _SECOND)
            if not (0 <= seconds < _UINT32 if unsigned else -_UINT32 // 2 <= seconds < _UINT32 // 2):
                raise _unfit(path, data)
            # rosbags writes the seconds as int32: the same 32 bits as ROS 1's uint32.
            return make((seconds + _UINT32 // 2) % _UINT32 - _UINT32 // 2, nanoseconds)

        return build


def _rewired(captured: Decoder, wire: Wire | None) -> Decoder:
    """The decoder of the same type in the other wire form."""
    ros1 = wire is Wire.ROS1
    types = dict(captured.fields)
    if HEADER in types:
        header = [field for field in types[HEADER] if field[0] != "seq"]
        types[HEADER] = [("seq", (Nodetype.BASE, ("uint32", 0))), *header] if ros1 else header
    try:
        if ros1 and any("/msg/" not in name for name in types):
            raise SourceError("ROS 1 has no messages of actions and services")
        text = write_text(captured.type_name, types, ros1=ros1)
        return Decoder(wire or captured.wire, check_types(captured.type_name, types, text))
    except SourceError as error:
        raise VerificationError(f"{captured.type_name} cannot be written as {wire}: {error}") from None


def _string(path: str) -> Builder:
    def build(data: Any, missing: list[str]) -> Any:
        if data is _ABSENT or _is_digest(data):
            missing.append(path)
            return ""
        if not isinstance(data, str):
            raise _unfit(path, data)
        return data

    return build


def _checked(data: Any, kind: numpy.dtype[Any], path: str) -> Any:
    if kind.kind == "f":
        if isinstance(data, str) and data in NOT_FINITE:
            return NOT_FINITE[data]
        if type(data) is float and abs(data) <= float(numpy.finfo(kind).max):
            return data
    elif kind.kind == "b":
        if type(data) is bool:
            return data
    elif type(data) is int:
        limits = numpy.iinfo(kind)
        if limits.min <= data <= limits.max:
            return data
    raise _unfit(path, data)


def _base64(data: Any, path: str) -> bytes:
    try:
        return b64decode(data, validate=True)
    except (TypeError, ValueError, binascii.Error):
        raise _unfit(path, data) from None


def _is_digest(data: Any) -> bool:
    return isinstance(data, dict) and data.keys() == {"sm3", "length"}


def _unfit(path: str, data: Any) -> VerificationError:
    shown = repr(data)
    return VerificationError(
        f"a record's {path} does not fit its type: {shown if len(shown) < 60 else shown[:57] + '...'}"
    )
