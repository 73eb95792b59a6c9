"""Message definitions, read strictly: what rosbags compiles is only what passed here.

rosbags turns a definition into Python source and executes it, once for the
message class and once for each way of (de)serialising it. A definition comes
from a publisher's connection header or from a bag, that is, from anyone. So the
text is parsed here, by a grammar of one line, into rosbags' own tree, and the
tree that is handed on holds nothing but names that match the grammar of ROS
identifiers, built-in type names and bounded integers. Constants and default
values, the only free text of the format, never reach it: they are not on the wire.

Refused besides bad syntax: a type that is missing, contains itself or is nested
too deeply (rosbags would recurse), a fixed array that unrolls into too much code,
and arrays of elements that take no bytes (a count of 2**32 would cost no data).

The MSG format: wiki.ros.org/msg and "Interfaces" of the ROS 2 documentation.
What is parsed from IDL (see idl) goes through the same checks.
"""

from __future__ import annotations

import keyword
import re
from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, TypeAlias, cast

from rosbags.interfaces import Nodetype
from rosbags.interfaces.typing import BaseDesc, Fielddefs, FieldDesc, NameDesc, Typesdict

from rosbridge_eth.capture.idl import parse_idl
from rosbridge_eth.errors import SourceError

Format: TypeAlias = Literal["msg", "idl"]

MAX_TEXT = 256 * 1024
"""Characters of one definition with everything it refers to; moveit's largest have about 60,000."""
MAX_TYPES = 256
MAX_FIELDS = 1024
"""Fields of all types of one definition together; rosbags needs about a millisecond for each."""
MAX_DEPTH = 32
MAX_NAME = 128
MAX_UNROLLED = 1024
"""Elements of fixed arrays of strings or messages, together: rosbags writes a line of code for each."""
MAX_FIXED_BYTES = 1 << 20
"""Bytes of one fixed array of numbers."""
MAX_COUNT = 2**32 - 1

TIME = "builtin_interfaces/msg/Time"
DURATION = "builtin_interfaces/msg/Duration"
_BUILTIN: dict[str, Fielddefs] = {
    name: [("sec", (Nodetype.BASE, ("int32", 0))), ("nanosec", (Nodetype.BASE, ("uint32", 0)))]
    for name in (TIME, DURATION)
}
_SHORT_NAMES = {"time": TIME, "duration": DURATION, "Header": "std_msgs/msg/Header"}

SIZES = {
    "bool": 1, "byte": 1, "char": 1, "int8": 1, "uint8": 1, "int16": 2, "uint16": 2,
    "int32": 4, "uint32": 4, "int64": 8, "uint64": 8, "float32": 4, "float64": 8,
}  # fmt: skip
"""Bytes on the wire of the built-in types; a string takes 4 for its length, then its bytes."""
_BASES = SIZES.keys() | {"string"}
_UNSUPPORTED = {"wstring", "wchar", "float128", "fixed"}
EMPTY_MESSAGE_FIELD = "structure_needs_at_least_one_member"
"""rosidl's name for the byte that stands for a message without fields."""

_SEPARATOR = "=" * 80
_IDENTIFIER = r"[A-Za-z][A-Za-z0-9_]*"
# A type name becomes a Python name by writing "__" for "/": a "__" of its own would make two names one.
_TYPE_NAME = re.compile(r"[A-Za-z][A-Za-z0-9]*(?:_[A-Za-z0-9]+)*_?", re.ASCII)
_FIELD_NAME = re.compile(_IDENTIFIER, re.ASCII)
_LINE = re.compile(
    rf"""
    (?P<type>{_IDENTIFIER}(?:/{_IDENTIFIER})*)
    (?:<=(?P<string_bound>[0-9]{{1,10}}))?
    (?P<array>\[(?P<bounded><=)?(?P<count>[0-9]{{0,10}})\])?
    [ \t]+
    (?P<name>{_IDENTIFIER})
    (?:[ \t]*(?P<constant>=).*|[ \t]*\#.*|[ \t]+[^=].*)?
    """,
    re.ASCII | re.VERBOSE,
)


class DefinitionError(SourceError):
    """A message definition is malformed, hostile, or uses what cannot be decoded."""


@dataclass(frozen=True)
class Definition:
    """A message type with everything it refers to, in rosbags' tree form, checked.

    fields: of each type name (`pkg/msg/Name`), in wire order, without constants.
    smallest: bytes the shortest message of each type takes on the wire (ROS 1 form, no padding).
    """

    type_name: str
    fields: Mapping[str, Fielddefs]
    smallest: Mapping[str, int]

    def typesdict(self) -> Typesdict:
        """The tree for rosbags' type store: no constants."""
        return {name: ([], list(fields)) for name, fields in self.fields.items()}


def normalised_type_name(name: str) -> str:
    """`nav_msgs/Odometry` and `nav_msgs/msg/Odometry` are both `nav_msgs/msg/Odometry`."""
    parts = name.split("/")
    if len(parts) == 2:
        parts.insert(1, "msg")
    if len(parts) != 3 or parts[1] not in ("msg", "srv", "action"):
        raise DefinitionError(f"{_shown(name)} is not a message type's name, such as nav_msgs/Odometry")
    for part in parts:
        if len(part) > MAX_NAME or not _TYPE_NAME.fullmatch(part):
            raise DefinitionError(f"{_shown(name)} is not a message type's name, such as nav_msgs/Odometry")
    return "/".join(parts)


def read_definition(type_name: str, text: str, format: Format = "msg") -> Definition:
    """Parse and check the definition of `type_name`, followed by those of the types it refers to.

    text: as a ROS 1 connection header or an mcap schema has it: sections after
    the first open with a line of 80 "=" and `MSG: pkg/Name`.
    Raises DefinitionError.
    """
    name = normalised_type_name(type_name)
    if len(text) > MAX_TEXT:
        raise DefinitionError(f"the definition of {name} has {len(text)} characters; at most {MAX_TEXT} are read")
    types = _parse_msg(name, text) if format == "msg" else _parse_idl(name, text)
    return check_types(name, types)


def check_types(type_name: str, types: Mapping[str, Fielddefs]) -> Definition:
    """Check a tree, whoever parsed it, and keep of it what `type_name` refers to. Raises DefinitionError."""
    if len(types) > MAX_TYPES:
        raise DefinitionError(f"the definition of {type_name} brings {len(types)} types; at most {MAX_TYPES}")
    if sum(len(fields) for fields in types.values()) > MAX_FIELDS:
        raise DefinitionError(f"the definition of {type_name} has more than {MAX_FIELDS} fields")
    for name, standard in _BUILTIN.items():
        if name in types and list(types[name]) != standard:
            raise DefinitionError(f"the definition of {type_name} redefines {name}")
    checker = _Checker({**types, **_BUILTIN})
    checker.visit(type_name, 0)
    return Definition(type_name, checker.done, checker.smallest)


class _Checker:
    """Walks a tree from its root, depth first; `done` is in an order where parts precede wholes."""

    def __init__(self, types: Mapping[str, Fielddefs]) -> None:
        self.types = types
        self.done: dict[str, Fielddefs] = {}
        self.smallest: dict[str, int] = {}
        self.unrolled = 0
        self._open: set[str] = set()

    def visit(self, name: str, depth: int) -> int:
        """Bytes that the shortest message of type `name` takes."""
        if name in self.smallest:
            return self.smallest[name]
        if normalised_type_name(name) != name:
            raise DefinitionError(f"{_shown(name)} is not a message type's full name")
        if name in self._open:
            raise DefinitionError(f"message type {name} contains itself")
        if depth > MAX_DEPTH:
            raise DefinitionError(f"message types are nested more than {MAX_DEPTH} deep at {name}")
        if name not in self.types:
            raise DefinitionError(f"the definition of message type {name} is missing")
        self._open.add(name)
        seen: set[str] = set()
        size = 0
        fields = [field for field in self.types[name] if field[0] != EMPTY_MESSAGE_FIELD]
        for field, description in fields:
            if len(field) > MAX_NAME or not _FIELD_NAME.fullmatch(field):
                raise DefinitionError(f"{_shown(field)} in {name} is not a field's name")
            attribute = attribute_name(field)
            if attribute in seen:
                raise DefinitionError(f"message type {name} has field {field} twice")
            seen.add(attribute)
            size += self._field(f"{name}.{field}", description, depth)
        self._open.discard(name)
        self.done[name] = fields
        self.smallest[name] = size
        return size

    def _field(self, where: str, description: FieldDesc, depth: int) -> int:
        if description[0] == Nodetype.BASE:
            return self._base(where, description[1])
        if description[0] == Nodetype.NAME:
            return self.visit(description[1], depth + 1)
        element, count = description[1]
        if not 0 <= count <= MAX_COUNT:
            raise DefinitionError(f"{where} has an array length out of range: {count}")
        if element[0] == Nodetype.BASE:
            size = self._base(where, element[1])
            unrolls = element[1][0] == "string"
        else:
            size = self.visit(element[1], depth + 1)
            unrolls = True
        if size == 0:
            raise DefinitionError(f"{where} is an array of empty messages")
        if description[0] == Nodetype.SEQUENCE:
            return 4
        if count == 0:
            raise DefinitionError(f"{where} is a fixed array of no elements")
        if unrolls:
            self.unrolled += count
            if self.unrolled > MAX_UNROLLED:
                raise DefinitionError(f"{where}: more than {MAX_UNROLLED} elements in fixed arrays of this kind")
        elif count * size > MAX_FIXED_BYTES:
            raise DefinitionError(f"{where} is a fixed array of {count * size} bytes; at most {MAX_FIXED_BYTES}")
        return count * size

    @staticmethod
    def _base(where: str, base: tuple[str, int]) -> int:
        name, bound = base
        if not 0 <= bound <= MAX_COUNT:
            raise DefinitionError(f"{where} has a length out of range: {bound}")
        if name in _UNSUPPORTED:
            raise DefinitionError(f"{where} is a {name}, whose wire form differs between middlewares; not supported")
        if name not in _BASES:
            raise DefinitionError(f"{where} has the unknown type {_shown(name)}")
        return SIZES.get(name, 4)


def attribute_name(field: str) -> str:
    """The attribute of rosbags' message object that holds `field`: Python's keywords get a "_"."""
    return f"{field}_" if keyword.iskeyword(field) else field


def _parse_msg(type_name: str, text: str) -> dict[str, Fielddefs]:
    types: dict[str, Fielddefs] = {}
    section: str | None = type_name
    fields: Fielddefs = []
    for number, raw_line in enumerate(text.splitlines(), 1):
        line = raw_line.strip(" \t\r\n\ufeff")
        if line == _SEPARATOR and section is not None:
            _add(types, section, fields)
            section, fields = None, []
        elif section is None:
            if line.startswith("IDL:"):
                raise DefinitionError(f"the definition of {type_name} mixes MSG and IDL")
            if not line.startswith("MSG:"):
                raise DefinitionError(f"line {number} of the definition of {type_name} should be MSG: pkg/Name")
            section = normalised_type_name(line[4:].strip())
        elif line and not line.startswith("#") and line != "@key":
            field = _parse_line(section, line, number)
            if field is not None:
                fields.append(field)
    if section is None:
        raise DefinitionError(f"the definition of {type_name} ends after a separator")
    _add(types, section, fields)
    return types


def _add(types: dict[str, Fielddefs], name: str, fields: Fielddefs) -> None:
    if types.setdefault(name, fields) != fields:
        raise DefinitionError(f"message type {name} is defined twice, differently")


def _parse_line(owner: str, line: str, number: int) -> tuple[str, FieldDesc] | None:
    """One field, or None for a constant."""
    match = _LINE.fullmatch(line)
    if match is None:
        raise DefinitionError(f"line {number} in the definition of {owner} is not a field: {_shown(line)}")
    if match["constant"]:
        return None
    element = _element(owner, match["type"], int(match["string_bound"] or 0))
    if match["string_bound"] and match["type"] not in ("string", "wstring"):
        raise DefinitionError(f"line {number} in the definition of {owner}: only a string has a bound")
    description: FieldDesc = element
    if match["array"]:
        if match["count"] and not match["bounded"]:
            description = (Nodetype.ARRAY, (element, int(match["count"])))
        elif bool(match["count"]) == bool(match["bounded"]):
            description = (Nodetype.SEQUENCE, (element, int(match["count"] or 0)))
        else:
            raise DefinitionError(f"line {number} in the definition of {owner}: an array bound without a number")
    return match["name"], description


def _element(owner: str, name: str, bound: int) -> BaseDesc | NameDesc:
    if name in _BASES or name in _UNSUPPORTED:
        return cast(BaseDesc, (Nodetype.BASE, (name, bound)))
    if name in _SHORT_NAMES:
        return (Nodetype.NAME, _SHORT_NAMES[name])
    if "/" not in name:
        name = f"{owner.rpartition('/')[0]}/{name}"
    return (Nodetype.NAME, normalised_type_name(name))


def _parse_idl(type_name: str, text: str) -> dict[str, Fielddefs]:
    def error(reason: str) -> DefinitionError:
        return DefinitionError(f"the IDL definition of {type_name} cannot be read: {_shown(reason)}")

    # As mcap stores it: every type after a line of 80 "=" and `IDL: pkg/msg/Name`; or one text alone.
    sections = re.split(rf"^{_SEPARATOR}\r?\n(?:IDL: [^\n]*\n)?", text, flags=re.MULTILINE)
    types: dict[str, Fielddefs] = {}
    for section in sections:
        for name, fields in parse_idl(section, error).items():
            _add(types, normalised_type_name(name), fields)
    return types


def _shown(text: str) -> str:
    """Foreign text for a message: printable, quoted, short."""
    return repr(text if len(text) <= 60 else text[:57] + "...")
