"""A decoded message of any type to a value that JSON can hold, compiled once per type and selection.

What is compiled is one Python expression over the message object, written from the field *definitions* and in their
order, never from the attributes of the object (rosbags adds a member to empty messages and renames Python's keywords);
so equal messages give equal JSON. Definitions hold checked identifiers only, and these are all that is written out.

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

A field above the limit (16 KiB) becomes {"sm3": hex, "length": bytes}. Measured and hashed are: a string's UTF-8, an
array of numbers as on the wire (little-endian), any other array as its JSON.
"""

from __future__ import annotations

from base64 import b64encode
from collections.abc import Callable
from math import inf, isfinite
from typing import Any, Final

import numpy
import orjson
from rosbags.interfaces import Nodetype
from rosbags.interfaces.typing import FieldDesc

from rosbridge_eth.capture.definitions import DURATION, NUMBERS, TIME, attribute_name
from rosbridge_eth.capture.messages import Decoder, Wire
from rosbridge_eth.capture.rules import DEFAULT_LIMIT, Selection
from rosbridge_eth.errors import ConfigError
from smcrypto import sm3

BYTES: Final = frozenset({"uint8", "char", "byte"})


class Conversion:
    """One type's compiled conversion. `convert(message)` gives the record's data."""

    def __init__(self, decoder: Decoder, selection: Selection = None, *, limit: int = DEFAULT_LIMIT) -> None:
        self._fields = decoder.fields
        self._ros1 = decoder.wire is Wire.ROS1
        self._limit = limit
        self.type_name = decoder.type_name
        self._names: dict[str, Any] = {  # of functions, in the expression
            "isfinite": isfinite, "_float": _float, "_string": lambda value: self._bounded(value, value.encode()),
            "_list": lambda items: self._bounded(items, orjson.dumps(items) if items else b""),
        }  # fmt: skip
        expression = self._message(self.type_name, selection, "m", "")
        self.convert: Callable[[Any], dict[str, Any]] = eval(f"lambda m: {expression}", self._names)  # noqa: S307

    # Each method writes the expression for the value of a field, given the expression for the field itself.

    def _message(self, type_name: str, selection: Selection, value: str, path: str) -> str:
        fields = dict(self._fields[type_name])
        for name in () if selection is None else selection:
            if isinstance(name, int) or name == "*":
                raise ConfigError(f"field {path!r} of {self.type_name} is not an array")
            if name not in fields:
                where = f"field {path!r} of {self.type_name}" if path else self.type_name
                raise ConfigError(f"{where} has no field {name!r}; it has: {', '.join(fields) or 'no fields'}")
        members = []
        for name, description in fields.items():
            if selection is None or name in selection:
                chosen = None if selection is None else selection[name]
                attribute = f"{value}.{attribute_name(name)}"
                members.append(f'"{name}": {self._value(description, chosen, attribute, f"{path}.{name}".lstrip("."))}')
        return f"{{{', '.join(members)}}}"

    def _value(self, description: FieldDesc, selection: Selection, value: str, path: str) -> str:
        if description[0] == Nodetype.BASE:
            self._check_leaf(selection, path, f"a {description[1][0]}")
            return self._scalar(description[1][0], value)
        if description[0] == Nodetype.NAME:
            if description[1] in (TIME, DURATION):
                self._check_leaf(selection, path, "captured as one number, in nanoseconds")
                return self._instant(description[1], value)
            return self._message(description[1], selection, value, path)
        element = description[1][0]
        if selection is None:
            return self._array(element, None, value, path)
        if "*" in selection:
            if element[0] == Nodetype.BASE:
                self._check_leaf(selection["*"], f"{path}[*]", f"a {element[1][0]}")
            return self._array(element, selection["*"], value, path)
        elements = {step: selection[step] for step in selection if isinstance(step, int)}
        if len(elements) < len(selection):
            raise ConfigError(f"field {path!r} of {self.type_name} is an array; write {path}[*] or {path}[0]")
        return self._elements(element, elements, value, path)

    def _check_leaf(self, selection: Selection, path: str, what: str) -> None:
        if selection is not None:
            raise ConfigError(f"field {path!r} of {self.type_name} is {what}: nothing can be selected in it")

    def _scalar(self, base: str, value: str) -> str:
        if base in ("float32", "float64"):
            return f"v if isfinite(v := {value}) else _float(v)"
        if base == "string":  # a character is at most 4 bytes of UTF-8
            return f"v if len(v := {value}) <= {self._limit // 4} else _string(v)"
        if base == "byte" and not self._ros1:
            return f"{value} & 0xFF"  # rosbags reads it as signed
        return value

    def _instant(self, type_name: str, value: str) -> str:
        if not self._ros1:
            return f"{value}.sec * 1000000000 + {value}.nanosec"
        if type_name == TIME:
            # rosbags reads the seconds as signed; ROS 1 writes uint32 (its time ends in 2106).
            return f"({value}.sec & 0xFFFFFFFF) * 1000000000 + {value}.nanosec"
        # Both parts of a ROS 1 duration are int32, rosbags reads the second one as unsigned.
        return f"{value}.sec * 1000000000 + ({value}.nanosec + 2**31) % 2**32 - 2**31"

    def _array(self, element: FieldDesc, selection: Selection, value: str, path: str) -> str:
        if element[0] == Nodetype.BASE and element[1][0] != "string":
            return f"{self._call(self._numbers(element[1][0]))}({value})"
        item = self._call(None)  # a name that no array within this one has
        inner = self._value(element, selection, item, f"{path}[*]")
        return f"_list([{inner} for {item} in {value}])"

    def _elements(self, element: FieldDesc, elements: dict[int, Selection], value: str, path: str) -> str:
        """The chosen ones by index, as far as the array has them."""
        item = self._call(None)
        convert = {}
        for index, selection in sorted(elements.items()):
            inner = self._value(element, selection, item, f"{path}[{index}]")
            convert[index] = eval(f"lambda {item}: {inner}", self._names)  # noqa: S307

        def choose(array: Any) -> dict[str, Any]:
            items = array.tolist() if isinstance(array, numpy.ndarray) else array
            return {str(index): function(items[index]) for index, function in convert.items() if index < len(items)}

        return f"{self._call(choose)}({value})"

    def _call(self, function: Callable[..., Any] | None) -> str:
        """A name for the function in the expression."""
        name = f"_{len(self._names)}"
        self._names[name] = function
        return name

    def _bounded(self, value: Any, content: bytes) -> Any:
        """The value, or the digest of its content where that is above the limit."""
        return value if len(content) <= self._limit else _digest(content)

    def _numbers(self, base: str) -> Callable[[Any], Any]:
        wire = NUMBERS[base]
        longest, binary, real = self._limit // wire.itemsize, base in BYTES, base in ("float32", "float64")

        def convert(value: Any) -> Any:
            if len(value) > longest:
                return _digest(numpy.asarray(value, wire).tobytes())
            array = numpy.asarray(value)
            if binary:
                return b64encode(array.tobytes() if array.itemsize == 1 else bytes(value)).decode("ascii")
            numbers = array.tolist()
            # The sum of finite numbers may overflow, which costs a second look and no more.
            return numbers if not real or isfinite(sum(numbers)) else [_float(number) for number in numbers]

        return convert


def _digest(content: bytes) -> dict[str, Any]:
    return {"sm3": sm3.digest(content).hex(), "length": len(content)}


def _float(value: float) -> float | str:
    return value if isfinite(value) else {inf: "Infinity", -inf: "-Infinity"}.get(value, "NaN")
