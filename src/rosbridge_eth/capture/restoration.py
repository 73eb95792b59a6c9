"""A record's data back to a message, for those who write what they read from the chain into a bag.

The inverse of conversion. What was not captured (fields not selected, fields whose digest stands for them) is left
zero, and named. A message of ROS 1 can be written as one of ROS 2 and the other way round: the fields are those of
its definition, but for the `seq` of a header, which only ROS 1 has.
"""

from __future__ import annotations

from base64 import b64decode
from collections.abc import Mapping
from functools import cached_property
from typing import Any, Final, NamedTuple

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
_LIMITS: Final[dict[str, tuple[type, float, float]]] = {
    base: (float, -float(numpy.finfo(kind).max), float(numpy.finfo(kind).max)) if kind.kind == "f"
    else (int, numpy.iinfo(kind).min, numpy.iinfo(kind).max)
    for base, kind in NUMBERS.items() if kind.kind != "b"
}  # fmt: skip
"""Of the numbers' types, Python's own, and the least and the highest value."""
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
        self._rewired = self.decoder is not captured

    def restore(self, data: Mapping[str, Any]) -> Restored:
        """The message of a record's data; VerificationError if the data does not fit the type."""
        missing: dict[str, None] = {}
        message = self._message(self.decoder.type_name, data, "", missing)
        return Restored(message, tuple(missing))

    @cached_property
    def connection(self) -> dict[str, str]:
        """What `add_connection` of rosbags' writers is to know of the type, besides topic and name."""
        definition = self.decoder.definition
        if self.decoder.wire is Wire.ROS1:
            return {"msgdef": definition.text, "md5sum": definition.md5}
        return {"msgdef": definition.text, "rihs01": self.decoder.typestore.hash_rihs01(definition.type_name)}

    def _message(self, type_name: str, data: Any, path: str, missing: dict[str, None]) -> Any:
        fields = dict(self.decoder.fields[type_name])
        if self._rewired and type_name == HEADER and isinstance(data, dict):  # `seq` is ROS 1's alone
            data = {"seq": 0, **data} if "seq" in fields else {name: data[name] for name in data if name != "seq"}
        if not isinstance(data, dict) or not data.keys() <= fields.keys():
            raise _unfit(path or type_name, data)
        return self.decoder.typestore.types[type_name](*[
            self._field(description, data.get(name, _ABSENT), f"{path}.{name}" if path else name, missing)
            for name, description in fields.items()
        ])  # fmt: skip

    def _field(self, description: FieldDesc, data: Any, path: str, missing: dict[str, None]) -> Any:
        is_message = description[0] == Nodetype.NAME and description[1] not in (TIME, DURATION)
        # Otherwise an object stands for the value: a digest, or single elements.
        if data is _ABSENT or (isinstance(data, dict) and not is_message):
            missing[path] = None
            return self._zero(description)
        try:
            if description[0] == Nodetype.NAME:
                if is_message:
                    return self._message(description[1], data, path, missing)
                return self._instant(description[1], _exactly(int, data))
            if description[0] == Nodetype.BASE:
                return _scalar(description[1][0], data)
            element, count = description[1]
            if _is_numeric(element):
                items = _numbers(element[1][0], data)
            else:
                items = [self._field(element, item, f"{path}[*]", missing) for item in _exactly(list, data)]
            if description[0] == Nodetype.ARRAY and len(items) != count:
                raise ValueError
        except (TypeError, ValueError):
            raise _unfit(path, data) from None
        return items

    def _zero(self, description: FieldDesc) -> Any:
        if description[0] == Nodetype.NAME:
            parts = [self._zero(part) for _, part in self.decoder.fields[description[1]]]
            return self.decoder.typestore.types[description[1]](*parts)
        if description[0] == Nodetype.BASE:
            return "" if description[1][0] == "string" else NUMBERS[description[1][0]].type(0).item()
        element, count = description[1]
        length = count if description[0] == Nodetype.ARRAY else 0
        if _is_numeric(element):
            return numpy.zeros(length, NUMBERS[element[1][0]])
        return [self._zero(element) for _ in range(length)]

    def _instant(self, type_name: str, value: int) -> Any:
        seconds, nanoseconds = divmod(value, _SECOND)
        first = 0 if self.decoder.wire is Wire.ROS1 and type_name == TIME else -_UINT32 // 2
        if not first <= seconds < first + _UINT32:
            raise ValueError
        # rosbags writes the seconds as int32: the same 32 bits as ROS 1's uint32.
        seconds = (seconds + _UINT32 // 2) % _UINT32 - _UINT32 // 2
        return self.decoder.typestore.types[type_name](seconds, nanoseconds)


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


# The value of a field of a built-in type, or ValueError or TypeError


def _exactly(kind: type, data: Any) -> Any:
    if type(data) is not kind:
        raise TypeError
    return data


def _is_numeric(element: FieldDesc) -> bool:
    return element[0] == Nodetype.BASE and element[1][0] != "string"


def _scalar(base: str, data: Any) -> Any:
    if base == "string":
        return _exactly(str, data)
    if base not in _LIMITS:
        return _exactly(bool, data)
    exact, least, most = _LIMITS[base]
    if exact is float and isinstance(data, str) and data in NOT_FINITE:
        return NOT_FINITE[data]
    if base == "byte" and 127 < _exactly(int, data) < 256:
        data -= 256  # it is signed in ROS 1, unsigned in ROS 2; rosbags packs it as signed
    if not least <= _exactly(exact, data) <= most:
        raise ValueError
    return data


def _numbers(base: str, data: Any) -> Any:
    if base in BYTES:
        return numpy.frombuffer(b64decode(data, validate=True), NUMBERS[base])
    return numpy.array([_scalar(base, item) for item in _exactly(list, data)], NUMBERS[base])


def _unfit(path: str, data: Any) -> VerificationError:
    shown = repr(data)
    return VerificationError(
        f"a record's {path} does not fit its type: {shown if len(shown) < 60 else shown[:57] + '...'}"
    )
