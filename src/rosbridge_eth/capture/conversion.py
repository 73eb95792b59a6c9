"""A decoded message of any type to a value JSON can hold, compiled once per type and selection.

The converters follow the field *definitions*, never the attributes of the
message object (rosbags adds a member to empty messages and renames Python's
keywords), and keep their order, so equal messages give equal JSON.

    in the definition             in the record
    bool                          true, false
    integers, char                integer; ROS 1's byte is signed, ROS 2's is not
    float32, float64              number; "NaN", "Infinity", "-Infinity"; a float32 with all its digits
    string                        string
    uint8[], char[], byte[]       base64 (RFC 4648) of the bytes
    other arrays of numbers       list
    time, duration                integer: nanoseconds; ROS 1's time is unsigned
    a message                     object of its fields
    messages, strings, in arrays  list

A field above the limit (1 KiB) becomes {"sm3": hex, "length": bytes}. Measured
and hashed are: a string's UTF-8, an array of numbers as on the wire
(little-endian), any other array as its JSON.
"""

from __future__ import annotations

import difflib
from base64 import b64encode
from collections.abc import Callable
from json import JSONEncoder
from math import inf, isfinite
from typing import Any, Final, Literal, TypeAlias

import numpy
from rosbags.interfaces import Nodetype
from rosbags.interfaces.typing import FieldDesc

from rosbridge_eth.capture.definitions import DURATION, TIME, attribute_name
from rosbridge_eth.capture.messages import Decoder, Wire
from rosbridge_eth.capture.paths import EVERYTHING, Selection
from rosbridge_eth.errors import ConfigError
from smcrypto import sm3

OversizePolicy: TypeAlias = Literal["digest", "refuse"]
Converter: TypeAlias = Callable[[Any], Any]

DEFAULT_LIMIT: Final = 1024
"""Bytes of one field from which on its digest stands for it."""

to_json: Final = JSONEncoder(ensure_ascii=False, allow_nan=False, separators=(",", ":")).encode

_SECOND: Final = 10**9
_BYTES: Final = frozenset({"uint8", "char", "byte"})
NUMPY: Final = {"bool": "?", "byte": "i1", "char": "u1"} | {
    f"{kind}{bits}": f"<{letter}{bits // 8}"
    for kind, letter in (("int", "i"), ("uint", "u"), ("float", "f"))
    for bits in (8, 16, 32, 64)
}


class FieldTooLarge(Exception):
    """A field is above the limit and the policy is to refuse such messages."""

    def __init__(self, path: str, length: int) -> None:
        super().__init__(f"{path} has {length} bytes")
        self.path = path
        self.length = length


class Conversion:
    """One type's compiled conversion. `convert(message)` gives the record's data.

    digested: how many fields a digest stood for, so far; last_digested: the latest of them.
    """

    def __init__(
        self,
        decoder: Decoder,
        selection: Selection = EVERYTHING,
        *,
        limit: int = DEFAULT_LIMIT,
        oversize: OversizePolicy = "digest",
    ) -> None:
        self._fields = decoder.fields
        self._ros1 = decoder.wire is Wire.ROS1
        self._limit = limit
        self._refuse = oversize == "refuse"
        self.type_name = decoder.type_name
        self.digested = 0
        self.last_digested = ""
        self.convert = self._message(self.type_name, selection, "")

    # Each method compiles: it returns the function that will convert a value, or None where
    # the value is already what JSON holds.

    def _message(self, type_name: str, selection: Selection, path: str) -> Converter:
        fields = self._fields[type_name]
        if not selection.everything:
            self._check_names(type_name, selection, path)
            fields = [field for field in fields if field[0] in selection.members]
        members = [
            (
                name,
                attribute_name(name),
                self._value(
                    description,
                    EVERYTHING if selection.everything else selection.members[name],
                    f"{path}.{name}" if path else name,
                ),
            )
            for name, description in fields
        ]

        def convert(message: Any) -> dict[str, Any]:
            data = {}
            for name, attribute, converter in members:
                value = getattr(message, attribute)
                data[name] = value if converter is None else converter(value)
            return data

        return convert

    def _check_names(self, type_name: str, selection: Selection, path: str) -> None:
        if selection.each or selection.elements:
            raise ConfigError(f"field {path!r} of {self.type_name} is not an array")
        names = [name for name, _ in self._fields[type_name]]
        for name in selection.members:
            if name not in names:
                near = difflib.get_close_matches(name, names, 1)
                hint = f"did you mean {near[0]!r}?" if near else f"it has: {', '.join(names) or 'no fields'}"
                where = f"field {path!r} of {self.type_name}" if path else self.type_name
                raise ConfigError(f"{where} has no field {name!r}; {hint}")

    def _value(self, description: FieldDesc, selection: Selection, path: str) -> Converter | None:
        if description[0] == Nodetype.BASE:
            self._check_leaf(selection, path, f"a {description[1][0]}")
            return self._scalar(description[1][0], path)
        if description[0] == Nodetype.NAME:
            if description[1] in (TIME, DURATION):
                self._check_leaf(selection, path, "captured as one number, in nanoseconds")
                return self._instant(description[1])
            return self._message(description[1], selection, path)
        element = description[1][0]
        if selection.everything:
            return self._array(element, path)
        if selection.members:
            raise ConfigError(f"field {path!r} of {self.type_name} is an array; write {path}[*] or {path}[0]")
        if selection.each is not None:
            if element[0] == Nodetype.BASE:
                self._check_leaf(selection.each, f"{path}[*]", f"a {element[1][0]}")
                return self._array(element, path)
            return self._list(self._value(element, selection.each, f"{path}[*]"), path)
        return self._elements(element, selection.elements, path)

    def _check_leaf(self, selection: Selection, path: str, what: str) -> None:
        if not selection.everything:
            raise ConfigError(f"field {path!r} of {self.type_name} is {what}: nothing can be selected in it")

    def _scalar(self, base: str, path: str) -> Converter | None:
        if base in ("float32", "float64"):
            return _float
        if base == "string":
            return self._string(path)
        if base == "byte" and not self._ros1:
            return lambda value: value & 0xFF  # rosbags reads it as signed
        return None

    def _string(self, path: str) -> Converter:
        limit, too_large = self._limit, self._too_large

        def convert(value: str) -> Any:
            if len(value) * 4 <= limit:  # a character is at most 4 bytes of UTF-8
                return value
            encoded = value.encode()
            return value if len(encoded) <= limit else too_large(path, encoded)

        return convert

    def _instant(self, type_name: str) -> Converter:
        if not self._ros1:
            return lambda value: value.sec * _SECOND + value.nanosec
        if type_name == TIME:
            # rosbags reads the seconds as signed; ROS 1 writes uint32 (its time ends in 2106).
            return lambda value: (value.sec & 0xFFFFFFFF) * _SECOND + value.nanosec
        # Both parts of a ROS 1 duration are int32, rosbags reads the second one as unsigned.
        return lambda value: value.sec * _SECOND + ((value.nanosec + 2**31) % 2**32 - 2**31)

    def _array(self, element: FieldDesc, path: str) -> Converter:
        if element[0] == Nodetype.BASE and element[1][0] != "string":
            return self._numbers(element[1][0], path)
        return self._list(self._value(element, EVERYTHING, f"{path}[*]"), path)

    def _numbers(self, base: str, path: str) -> Converter:
        limit, too_large, wire = self._limit, self._too_large, numpy.dtype(NUMPY[base])
        size, binary, real = wire.itemsize, base in _BYTES, base in ("float32", "float64")

        def convert(value: Any) -> Any:
            if len(value) * size > limit:
                return too_large(path, numpy.asarray(value, wire).tobytes())
            array = numpy.asarray(value)
            if binary:
                return b64encode(array.tobytes() if array.itemsize == 1 else bytes(value)).decode("ascii")
            numbers = array.tolist()
            if real and not numpy.isfinite(array).all():
                return [_float(number) for number in numbers]
            return numbers

        return convert

    def _list(self, converter: Converter | None, path: str) -> Converter:
        limit, too_large = self._limit, self._too_large

        def convert(value: Any) -> Any:
            items = list(value) if converter is None else [converter(item) for item in value]
            if not items:
                return items
            encoded = to_json(items).encode()
            return items if len(encoded) <= limit else too_large(path, encoded)

        return convert

    def _elements(self, element: FieldDesc, elements: dict[int, Selection], path: str) -> Converter:
        chosen = [
            (index, str(index), self._value(element, selection, f"{path}[{index}]"))
            for index, selection in sorted(elements.items())
        ]

        def convert(value: Any) -> dict[str, Any]:
            data = {}
            for index, key, converter in chosen:
                if index < len(value):
                    item = value[index]
                    item = item.item() if isinstance(item, numpy.generic) else item
                    data[key] = item if converter is None else converter(item)
            return data

        return convert

    def _too_large(self, path: str, content: bytes) -> dict[str, Any]:
        if self._refuse:
            raise FieldTooLarge(path, len(content))
        self.digested += 1
        self.last_digested = path
        return {"sm3": sm3.digest(content).hex(), "length": len(content)}


def _float(value: float) -> float | str:
    if isfinite(value):
        return value
    if value == inf:
        return "Infinity"
    return "-Infinity" if value == -inf else "NaN"
