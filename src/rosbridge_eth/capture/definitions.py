"""Message definitions, read strictly: what rosbags compiles is only what passed here.

rosbags turns a definition into Python source and executes it, once for the message class and once for each way of
(de)serialising it; `conversion` does the same. A definition comes from a publisher's connection header, from a bag or
from a log, that is, from anyone. So what is handed on is a tree that holds nothing but names that match the grammar of
ROS identifiers, built-in type names and bounded integers. Constants and default values never reach it: they are not
on the wire. They are kept in `text`, which is copied and not interpreted.

Refused besides bad syntax: a type that is missing, contains itself or is nested too deeply (rosbags would recurse), a
type that doubles at every level, a fixed array that unrolls into too much code, arrays of elements that take no bytes
(a count of 2**32 would cost no data), and a definition too long for a line of the log.

The MSG format (wiki.ros.org/msg, "Interfaces" of the ROS 2 documentation) is read here, by a grammar of one line:
rosbags' parser refuses names that ROS 1 allows. IDL is rewritten in it by `idl`.
"""

from __future__ import annotations

import hashlib
import keyword
import re
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import dataclass
from functools import cached_property
from typing import Any, Literal, TypeAlias

import orjson
from rosbags.interfaces import Nodetype
from rosbags.interfaces.typing import Fielddefs, FieldDesc

from rosbridge_eth.capture.idl import idl_as_msg
from rosbridge_eth.errors import SourceError

Format: TypeAlias = Literal["msg", "idl"]

MAX_TEXT = 256 * 1024
"""Characters of one definition with everything it refers to; moveit's largest have about 60,000."""
MAX_KEPT = 48 * 1024
"""Bytes of a definition without its comments: it has to fit into a line of the log."""
MAX_TYPES = 256
MAX_FIELDS = 1024
"""Fields of all types of one definition together; rosbags needs about a millisecond for each."""
MAX_LEAVES = 8192
"""Fields of one message with those of the messages in it, an array counting once."""
MAX_DEPTH = 32
MAX_NAME = 128
MAX_UNROLLED = 1024
"""Elements of fixed arrays of strings or messages, together: rosbags writes a line of code for each."""
MAX_FIXED_BYTES = 1 << 20
"""Bytes of one fixed array of numbers."""
MAX_COUNT = 2**32 - 1

TIME = "builtin_interfaces/msg/Time"
DURATION = "builtin_interfaces/msg/Duration"
HEADER = "std_msgs/msg/Header"
_BUILTIN: dict[str, Fielddefs] = {
    name: [("sec", (Nodetype.BASE, ("int32", 0))), ("nanosec", (Nodetype.BASE, ("uint32", 0)))]
    for name in (TIME, DURATION)
}
_SHORT_NAMES = {"time": TIME, "duration": DURATION, "Header": HEADER}
_ROS1_NAMES = {TIME: "time", DURATION: "duration"}

SIZES = {
    "bool": 1, "byte": 1, "char": 1, "int8": 1, "uint8": 1, "int16": 2, "uint16": 2,
    "int32": 4, "uint32": 4, "int64": 8, "uint64": 8, "float32": 4, "float64": 8,
}  # fmt: skip
"""Bytes on the wire of the built-in types; a string takes 4 for its length, then its bytes."""
_BASES = SIZES.keys() | {"string"}
_UNSUPPORTED = {"wstring", "wchar", "float128", "fixed"}
EMPTY_MESSAGE_FIELD = "structure_needs_at_least_one_member"
"""rosidl's and rosbags' name for the byte that stands for a message without fields."""

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

    fields: of each type name (`pkg/msg/Name`), parts before wholes, in wire order, without constants.
    smallest: bytes the shortest message of each type takes on the wire (ROS 1 form, no padding).
    text: the same in the MSG format with sections: as it was read, without comments, where that was MSG.
    """

    type_name: str
    fields: Mapping[str, Fielddefs]
    smallest: Mapping[str, int]
    text: str

    @cached_property
    def md5(self) -> str:
        """The sum by which ROS 1 tells definitions apart (wiki.ros.org/ROS/Technical Overview). DefinitionError.

        Of a type: its constants, then its fields, one a line; a field of another message type has that type's sum in
        place of its name. It says whether two parties mean the same layout, and protects against nobody.
        """
        texts = dict(_sections(self.type_name, self.text.splitlines()))
        sums: dict[str, str] = {}
        for name in self.fields:  # parts before wholes: nothing recurses
            if name in texts:
                sums[name] = _md5_of_one(name, texts[name], sums)
        return sums[self.type_name]


def normalised_type_name(name: str) -> str:
    """`nav_msgs/Odometry` and `nav_msgs/msg/Odometry` are both `nav_msgs/msg/Odometry`."""
    parts = name.split("/")
    if len(parts) == 2:
        parts.insert(1, "msg")
    legal = all(len(part) <= MAX_NAME and _TYPE_NAME.fullmatch(part) for part in parts)
    if len(parts) != 3 or parts[1] not in ("msg", "srv", "action") or not legal:
        raise DefinitionError(f"{_shown(name)} is not a message type's name, such as nav_msgs/Odometry")
    return "/".join(parts)


def read_definition(type_name: str, text: str, format: Format = "msg") -> Definition:
    """Parse and check the definition of `type_name`, followed by those of the types it refers to.

    text: as a ROS 1 connection header or an mcap schema has it: sections after the first open with a line of 80 "="
    and `MSG: pkg/Name`. Raises DefinitionError.
    """
    name = normalised_type_name(type_name)
    if len(text) > MAX_TEXT:
        raise DefinitionError(f"the definition of {name} has {len(text)} characters; at most {MAX_TEXT} are read")
    sections: Iterable[tuple[str, list[str]]]
    if format == "idl":
        try:
            kept, sections = None, idl_as_msg(text).items()
        except ValueError as error:
            raise DefinitionError(f"the IDL definition of {name} cannot be read: {error}") from None
    else:
        lines = [stripped for line in text.splitlines() if (stripped := _without_comment(line))]
        kept, sections = "".join(f"{line}\n" for line in lines), _sections(name, lines)
    types: dict[str, Fielddefs] = {}
    for section, lines in sections:
        fields = [field for line in lines if line != "@key" and (field := _parse_line(section, line))]
        if types.setdefault(normalised_type_name(section), fields) != fields:
            raise DefinitionError(f"message type {section} is defined twice, differently")
    return check_types(name, types, kept)


def check_types(type_name: str, types: Mapping[str, Fielddefs], text: str | None = None) -> Definition:
    """Check a tree, whoever parsed it, and keep of it what `type_name` refers to. Raises DefinitionError.

    text: what it was parsed from; without it, the text is written from the tree.
    """
    if len(types) > MAX_TYPES:
        raise DefinitionError(f"the definition of {type_name} brings {len(types)} types; at most {MAX_TYPES}")
    if sum(len(fields) for fields in types.values()) > MAX_FIELDS:
        raise DefinitionError(f"the definition of {type_name} has more than {MAX_FIELDS} fields")
    for name, standard in _BUILTIN.items():
        if name in types and list(types[name]) != standard:
            raise DefinitionError(f"the definition of {type_name} redefines {name}")
    checker = _Checker({**types, **_BUILTIN})
    checker.visit(type_name, 0)
    text = write_text(type_name, checker.done) if text is None else text
    try:
        length = len(orjson.dumps(text))
    except orjson.JSONEncodeError:
        raise DefinitionError(f"the definition of {type_name} is not text") from None
    if length > MAX_KEPT:
        raise DefinitionError(f"the definition of {type_name} is longer than {MAX_KEPT} bytes without its comments")
    return Definition(type_name, checker.done, checker.smallest, text)


class _Checker:
    """Walks a tree from its root, depth first; `done` is in an order where parts precede wholes."""

    def __init__(self, types: Mapping[str, Fielddefs]) -> None:
        self.types = types
        self.done: dict[str, Fielddefs] = {}
        self.smallest: dict[str, int] = {}
        self.unrolled = 0
        self._leaves: dict[str, int] = {}
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
            raise DefinitionError(f"message type {name} is used but not defined")
        self._open.add(name)
        # A message without fields is padded with one byte by ROS 2, and rosbags says so in its own definitions.
        fields = [field for field in self.types[name] if field[0] != EMPTY_MESSAGE_FIELD]
        seen: set[str] = set()
        size = leaves = 0
        for field, description in fields:
            if not _FIELD_NAME.fullmatch(field) or len(field) > MAX_NAME:
                raise DefinitionError(f"message type {name} has a field {_shown(field)}, which is not a name")
            attribute = attribute_name(field)
            if attribute in seen:
                raise DefinitionError(f"message type {name} has field {field} twice")
            seen.add(attribute)
            size += self._field(f"{name}.{field}", description, depth)
            leaves += self._leaves.get(referred(description) or "", 0) + 1
        if leaves > MAX_LEAVES:
            raise DefinitionError(f"message type {name} comes to more than {MAX_LEAVES} fields, all within it counted")
        self._open.discard(name)
        self.done[name], self.smallest[name], self._leaves[name] = fields, size, leaves
        return size

    def _field(self, where: str, description: FieldDesc, depth: int) -> int:
        if description[0] == Nodetype.BASE:
            name, bound = description[1]
            if not 0 <= bound <= MAX_COUNT:
                raise DefinitionError(f"{where} has a length out of range: {bound}")
            if name in _UNSUPPORTED:
                raise DefinitionError(f"{where} is a {name}, not supported: its wire form differs between middlewares")
            if name not in _BASES:
                raise DefinitionError(f"{where} has the unknown type {_shown(name)}")
            return SIZES.get(name, 4)
        if description[0] == Nodetype.NAME:
            return self.visit(description[1], depth + 1)
        element, count = description[1]
        if not 0 <= count <= MAX_COUNT:
            raise DefinitionError(f"{where} has an array length out of range: {count}")
        size = self._field(where, element, depth)
        if size == 0:
            raise DefinitionError(f"{where} is an array of empty messages")
        if description[0] == Nodetype.SEQUENCE:
            return 4
        if count == 0:
            raise DefinitionError(f"{where} is a fixed array of no elements")
        if element[0] == Nodetype.NAME or element[1][0] == "string":
            self.unrolled += count
            if self.unrolled > MAX_UNROLLED:
                raise DefinitionError(f"{where}: more than {MAX_UNROLLED} elements in fixed arrays of this kind")
        elif count * size > MAX_FIXED_BYTES:
            raise DefinitionError(f"{where} is a fixed array of {count * size} bytes; at most {MAX_FIXED_BYTES}")
        return count * size


def attribute_name(field: str) -> str:
    """The attribute of rosbags' message object that holds `field`: Python's keywords get a "_"."""
    return f"{field}_" if keyword.iskeyword(field) else field


def referred(description: FieldDesc) -> str | None:
    """The message type that a field has, or has an array of."""
    element = description[1][0] if description[0] in (Nodetype.ARRAY, Nodetype.SEQUENCE) else description
    return element[1] if element[0] == Nodetype.NAME else None


def write_text(type_name: str, fields: Mapping[str, Fielddefs], *, ros1: bool = False) -> str:
    """A tree in the MSG format with sections; the root's comes first. ros1: in the spelling and without bounds."""
    sections = []
    for name in [type_name, *(name for name in fields if name != type_name)]:
        if ros1 and name in _ROS1_NAMES:
            continue
        lines = [] if name == type_name else [_SEPARATOR, f"MSG: {_spelled(name, ros1)}"]
        sections += [*lines, *(f"{_spelled_type(description, ros1)} {field}" for field, description in fields[name])]
    return "".join(f"{line}\n" for line in sections)


def _spelled(name: str, ros1: bool) -> str:
    """As definitions write it; `/srv/` and `/action/` stay."""
    return _ROS1_NAMES[name] if ros1 and name in _ROS1_NAMES else name.replace("/msg/", "/")


def _spelled_type(description: FieldDesc, ros1: bool) -> str:
    if description[0] == Nodetype.BASE:
        name, bound = description[1]
        return f"{name}<={bound}" if bound and not ros1 else name
    if description[0] == Nodetype.NAME:
        return _spelled(description[1], ros1)
    element, count = description[1]
    size = str(count) if description[0] == Nodetype.ARRAY else f"<={count}" if count and not ros1 else ""
    return f"{_spelled_type(element, ros1)}[{size}]"


def _without_comment(line: str) -> str:
    """The line as it counts. In the value of a string's constant or default, "#" is part of it."""
    line = line.strip(" \t\r\n\ufeff")
    if line.startswith("#"):
        return ""
    return line if line.startswith(("string", "wstring")) else line.partition("#")[0].rstrip()


def _sections(type_name: str, lines: list[str]) -> Iterator[tuple[str, list[str]]]:
    """The type names and lines of a definition in the MSG format. Raises DefinitionError."""
    section: str | None = type_name
    kept: list[str] = []
    for line in lines:
        if line == _SEPARATOR and section is not None:
            yield section, kept
            section, kept = None, []
        elif section is not None:
            kept.append(line)
        elif line.startswith("MSG:"):
            section = normalised_type_name(line[4:].strip())
        else:
            raise DefinitionError(f"after a separator, the definition of {type_name} should have MSG: pkg/Name")
    if section is None:
        raise DefinitionError(f"the definition of {type_name} ends after a separator")
    yield section, kept


def _parse_line(owner: str, line: str) -> tuple[str, FieldDesc] | None:
    """One field, or None for a constant."""
    match = _LINE.fullmatch(line)
    if match is None:
        raise DefinitionError(f"a line in the definition of {owner} is not a field: {_shown(line)}")
    if match["constant"]:
        return None
    kind, bound = match["type"], match["string_bound"]
    if bound and kind not in ("string", "wstring"):
        raise DefinitionError(f"in the definition of {owner}, only a string has a bound: {_shown(line)}")
    known = kind in _BASES or kind in _UNSUPPORTED
    element: Any = (Nodetype.BASE, (kind, int(bound or 0))) if known else (Nodetype.NAME, _full_name(owner, kind))
    description: Any = element
    if match["array"]:
        if match["count"] and not match["bounded"]:
            description = (Nodetype.ARRAY, (element, int(match["count"])))
        elif bool(match["count"]) == bool(match["bounded"]):
            description = (Nodetype.SEQUENCE, (element, int(match["count"] or 0)))
        else:
            raise DefinitionError(f"in the definition of {owner}, an array bound has no number: {_shown(line)}")
    return match["name"], description


def _full_name(owner: str, name: str) -> str:
    if name in _SHORT_NAMES:
        return _SHORT_NAMES[name]
    return normalised_type_name(name if "/" in name else f"{owner.rpartition('/')[0]}/{name}")


def _md5_of_one(owner: str, lines: list[str], sums: Mapping[str, str]) -> str:
    constants, fields = [], []
    for match in map(_LINE.fullmatch, lines):
        if match is None:
            raise DefinitionError(f"a line in the definition of {owner} is not a field")
        kind, name = match["type"], match["name"]
        if match["constant"]:  # in a string's value, "#" and spaces are part of the value
            constants.append(f"{kind} {name}={match.string[match.end('constant') :].strip()}")
        elif kind in _BASES or kind in ("time", "duration"):
            fields.append(f"{kind}{match['array'] or ''} {name}")
        elif (inner := sums.get(_full_name(owner, kind))) is not None:
            fields.append(f"{inner} {name}")
        else:
            raise DefinitionError(f"the definition of {owner} refers to {_shown(kind)}, which is not ROS 1's")
    return hashlib.md5("\n".join([*constants, *fields]).encode(), usedforsecurity=False).hexdigest()


def _shown(text: str) -> str:
    """Foreign text for a message: printable, quoted, short."""
    return repr(text if len(text) <= 60 else text[:57] + "...")
