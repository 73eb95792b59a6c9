"""Message definitions: parsed by rosbags, behind limits; what rosbags compiles is only what passed the checks here.

rosbags turns a definition into Python source and executes it, once for the message class and once for each way of
(de)serialising it; `conversion` does the same. A definition comes from a publisher's connection header, from a bag or
from a log, that is, from anyone. So what is handed on is a tree that holds nothing but names that match the grammar of
ROS identifiers, built-in type names and bounded integers. Constants and default values never reach it: they are not
on the wire. They are kept in `text`, which is copied and not interpreted.

Before rosbags parses a text (MSG: wiki.ros.org/msg; IDL: OMG IDL 4.2, 7.4): comments and blank lines are gone, since
its time grows with the square of their number; its length, fields and nesting are bounded; and of IDL, annotations,
expressions and sequences of sequences are gone or refused, on which it takes exponential time, or another type.

Refused after it: a type that is missing, contains itself or is nested too deeply (rosbags would recurse), one that
comes to too many fields or bytes with all that is in it, arrays of elements that take no bytes (a count of 2**32 would
cost no data), and a definition too long for a line of the log.
"""

from __future__ import annotations

import keyword
import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate
from typing import Any, Final, Literal, TypeAlias

import numpy
import orjson
from rosbags.interfaces import Nodetype
from rosbags.interfaces.typing import Constdefs, Fielddefs, FieldDesc, Typesdict
from rosbags.typesys import TypesysError, get_types_from_idl, get_types_from_msg
from rosbags.typesys.store import Typestore

from rosbridge_eth.errors import SourceError

Format: TypeAlias = Literal["msg", "idl"]

MAX_TEXT = 256 * 1024
"""Characters of one definition with everything it refers to; moveit's largest have about 60,000."""
MAX_KEPT = 48 * 1024
"""Bytes of a definition without its comments: it has to fit into a line of the log."""
MAX_FIELDS = 1024
"""Types and their fields in one definition, together; rosbags needs about a millisecond for each."""
MAX_LEAVES = 8192
"""Fields of one message with those of the messages in it: the code that is generated for it has a line for each.

A fixed array of strings or messages counts all its elements, since rosbags unrolls it; other arrays count as one.
"""
MAX_DEPTH = 32
MAX_NAME = 128
MAX_SMALLEST = 1 << 20
"""Bytes of the shortest message, fixed arrays included."""

TIME = "builtin_interfaces/msg/Time"
DURATION = "builtin_interfaces/msg/Duration"
HEADER = "std_msgs/msg/Header"
_BUILTIN: dict[str, Fielddefs] = {
    name: [("sec", (Nodetype.BASE, ("int32", 0))), ("nanosec", (Nodetype.BASE, ("uint32", 0)))]
    for name in (TIME, DURATION)
}
_ROS1_NAMES = {TIME: "time", DURATION: "duration"}

NUMBERS: Final[dict[str, numpy.dtype[Any]]] = {name: numpy.dtype(code) for name, code in {
    "bool": "?", "byte": "i1", "char": "u1", "int8": "i1", "uint8": "u1", "int16": "<i2", "uint16": "<u2",
    "int32": "<i4", "uint32": "<u4", "int64": "<i8", "uint64": "<u8", "float32": "<f4", "float64": "<f8",
}.items()}  # fmt: skip
"""The built-in types but strings, as they are on the wire."""
_UNSUPPORTED = {"wstring", "wchar", "float128", "fixed"}
EMPTY_MESSAGE_FIELD = "structure_needs_at_least_one_member"
"""rosidl's and rosbags' name for the byte that stands for a message without fields."""

_SEPARATOR = "=" * 80
_IDENTIFIER = r"[A-Za-z][A-Za-z0-9_]*"
# A type name becomes a Python name by writing "__" for "/": a "__" of its own would make two names one.
_TYPE_NAME = re.compile(r"[A-Za-z][A-Za-z0-9]*(?:_[A-Za-z0-9]+)*_?", re.ASCII)
_FIELD_NAME = re.compile(_IDENTIFIER, re.ASCII)
_CONSTANT = re.compile(rf"({_IDENTIFIER})[ \t]+({_IDENTIFIER})[ \t]*=", re.ASCII)
_STRING = r""" "(?:[^"\\\n]|\\.)*+" | '(?:[^'\\\n]|\\.)*+' """
# Of a file that has several: a line of 80 "=" before each. A comment that does not end goes on to the end of the text.
_NO_IDL = re.compile(
    rf"""^={{80}}\r?\n(?:IDL:[^\n]*+)? | //[^\n]*+ | /\*.*?(?:\*/|\Z) | \#[^\n]*+
       | @\s*+[\w:]++\s*+(?:\((?:{_STRING}|[^"'()])*+\))? | {_STRING}""",
    re.ASCII | re.DOTALL | re.MULTILINE | re.VERBOSE,
)
_UNREAD_CONSTANT = re.compile(r"const [^;=]*=(?! ?[0-9]{1,10} ?;)[^;]*;", re.ASCII)
MAX_SCOPES = 8
"""Modules and structs of IDL within each other, and parts of a name there; rosidl has three."""
_PLAIN_IDL = re.compile(r"[\w\s:;,{}<>=\[\]]*", re.ASCII)
_BEYOND_IDL = re.compile(rf"<<|sequence ?< ?(?:[\w:]+ ?< ?[^<>]*<|sequence\b)|(?:\w* ?:: ?){{{MAX_SCOPES}}}", re.ASCII)
_PARSER_ERRORS = (
    TypesysError, ArithmeticError, AssertionError, AttributeError, LookupError, RecursionError, TypeError, ValueError,
)  # fmt: skip
"""What rosbags' parsers raise for a text that is no definition."""


class DefinitionError(SourceError):
    """A message definition is malformed, hostile, or uses what cannot be decoded."""


@dataclass(frozen=True)
class Definition:
    """A message type with everything it refers to, in rosbags' tree form, checked.

    fields: of each type name (`pkg/msg/Name`), parts before wholes, in wire order, without constants.
    smallest: bytes the shortest message of each type takes on the wire (ROS 1 form, no padding).
    text: the same in the MSG format with sections: as it was read, without comments, where that was MSG.
    constants: of each type, those that rosbags reads.
    """

    type_name: str
    fields: Mapping[str, Fielddefs]
    smallest: Mapping[str, int]
    text: str
    constants: Mapping[str, Constdefs]

    @cached_property
    def md5(self) -> str:
        """The sum by which ROS 1 tells definitions apart (wiki.ros.org/ROS/Technical Overview), as rosbags has it."""
        store = Typestore()
        store.fielddefs.update({name: (self.constants.get(name, []), list(own)) for name, own in self.fields.items()})
        try:
            return store.generate_msgdef(self.type_name)[1]
        except AssertionError:
            raise DefinitionError(f"{self.type_name} is of an action or service: ROS 1 has no such messages") from None


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
    kept = None if format == "idl" else "\n".join(filter(None, map(_without_comment, text.splitlines()))) + "\n"
    try:
        types = _idl_types(text) if kept is None else _msg_types(name, kept)
    except _PARSER_ERRORS as error:
        why = _shown(str(error).split("\n", 3)[-1])  # of rosbags' lines, the place where it ended
        raise DefinitionError(f"the definition of {name} cannot be read: {why}") from None
    fields = {each: own for each, (_, own) in types.items()}
    return check_types(name, fields, kept, {each: constants for each, (constants, _) in types.items()})


def _msg_types(name: str, text: str) -> Typesdict:
    """Of each type in the text, which has no blank lines, constants and fields. A constant's value is kept as written:
    so it counts for `md5`, and rosbags takes fewer forms of it than ROS 1."""
    _check_length(name, text)
    constants, fields = dict[str, Constdefs](), dict[str, list[str]]()
    for section in f"MSG: {name}\n{text}".split(f"{_SEPARATOR}\n"):
        head, *lines = section.splitlines() or [""]
        if not head.startswith("MSG:"):
            raise ValueError(f"behind a separator stands no MSG: pkg/Name but {_shown(head)}")
        own, found = normalised_type_name(head[4:].strip()), list(map(_CONSTANT.match, lines))
        kept = [line for line, constant in zip(lines, found, strict=True) if not constant and line != "@key"]
        if fields.setdefault(own, kept) != kept:
            raise ValueError(f"message type {own} is defined twice, differently")
        constants[own] = [(each[2], each[1], each.string[each.end() :].strip()) for each in found if each]  # type: ignore[misc]
    whole = f"{_SEPARATOR}\n".join("".join(f"{line}\n" for line in [f"MSG: {own}", *fields[own]]) for own in fields)
    types = get_types_from_msg(whole.partition("\n")[2], name)
    return {own: (constants[own], parsed) for own, (_, parsed) in zip(fields, types.values(), strict=True)}


def _idl_types(text: str) -> Typesdict:
    plain = _UNREAD_CONSTANT.sub("", " ".join(_NO_IDL.sub(" ", text).split()))
    scopes = accumulate((char == "{") - (char == "}") for char in plain)
    if not _PLAIN_IDL.fullmatch(plain) or _BEYOND_IDL.search(plain) or max(scopes, default=0) > MAX_SCOPES:
        raise ValueError("expressions, nested sequences and deeper scopes of IDL are not supported")
    if plain.count(";") + plain.count(",") > MAX_FIELDS:
        raise ValueError(f"it has more than {MAX_FIELDS} declarations")
    types = get_types_from_idl(plain.replace(">>", "> >"))  # which it takes for a shift
    if len(types) < len(re.findall(r"\bstruct\b", plain)):
        raise ValueError("a struct is defined twice")
    return types


def _check_length(name: str, text: str) -> None:
    if len(orjson.dumps(text)) > MAX_KEPT:
        raise DefinitionError(f"the definition of {name} is longer than {MAX_KEPT} bytes without its comments")


def check_types(
    type_name: str, types: Mapping[str, Fielddefs], text: str | None = None,
    constants: Mapping[str, Constdefs] | None = None,
) -> Definition:  # fmt: skip
    """Check a tree, whoever parsed it, and keep of it what `type_name` refers to. Raises DefinitionError.

    text: what it was parsed from; without it, the text is written from the tree.
    """
    if len(types) + sum(map(len, types.values())) > MAX_FIELDS:
        raise DefinitionError(f"the definition of {type_name} has more than {MAX_FIELDS} types and fields")
    for name, standard in _BUILTIN.items():
        if name in types and list(types[name]) != standard:
            raise DefinitionError(f"the definition of {type_name} redefines {name}")
    checker = _Checker({**types, **_BUILTIN})
    checker.visit(type_name)
    text = write_text(type_name, checker.done) if text is None else text
    _check_length(type_name, text)
    smallest = {name: size for name, (size, _) in checker.sizes.items()}
    return Definition(type_name, checker.done, smallest, text, constants or {})


class _Checker:
    """Walks a tree from its root, depth first; `done` is in an order where parts precede wholes.

    sizes: of each type the bytes of its shortest message, and its fields as MAX_LEAVES counts them.
    """

    def __init__(self, types: Mapping[str, Fielddefs]) -> None:
        self.types = types
        self.done: dict[str, Fielddefs] = {}
        self.sizes: dict[str, tuple[int, int]] = {}
        self._within: list[str] = []

    def visit(self, name: str) -> tuple[int, int]:
        if name in self.sizes:
            return self.sizes[name]
        if normalised_type_name(name) != name:
            raise DefinitionError(f"{_shown(name)} is not a message type's full name")
        if name in self._within:
            raise DefinitionError(f"message type {name} contains itself")
        if len(self._within) > MAX_DEPTH:
            raise DefinitionError(f"message types are nested more than {MAX_DEPTH} deep at {name}")
        if name not in self.types:
            raise DefinitionError(f"message type {name} is used but not defined")
        self._within.append(name)
        # A message without fields is padded with one byte by ROS 2, and rosbags says so in its own definitions.
        fields = [field for field in self.types[name] if field[0] != EMPTY_MESSAGE_FIELD]
        seen: set[str] = set()
        size = leaves = 0
        for field, description in fields:
            if not _FIELD_NAME.fullmatch(field) or len(field) > MAX_NAME:
                raise DefinitionError(f"message type {name} has a field {_shown(field)}, which is not a name")
            if (attribute := attribute_name(field)) in seen:
                raise DefinitionError(f"message type {name} has field {field} twice")
            seen.add(attribute)
            own_size, own_leaves = self._field(f"{name}.{field}", description)
            size, leaves = size + own_size, leaves + own_leaves + 1
        if leaves > MAX_LEAVES or size > MAX_SMALLEST:
            raise DefinitionError(
                f"message type {name} comes to more than {MAX_LEAVES} fields or {MAX_SMALLEST} bytes with all within it"
            )
        self._within.pop()
        self.done[name], self.sizes[name] = fields, (size, leaves)
        return size, leaves

    def _field(self, where: str, description: FieldDesc) -> tuple[int, int]:
        if description[0] in (Nodetype.ARRAY, Nodetype.SEQUENCE):
            return self._array(where, *description[1], fixed=description[0] == Nodetype.ARRAY)
        name = description[1][0] if description[0] == Nodetype.BASE else description[1]
        plain = name.rpartition("/")[2]
        if plain in _UNSUPPORTED and name not in self.types:  # in MSG, rosbags takes a wstring for a message type
            raise DefinitionError(f"{where} is a {plain}, not supported: its wire form differs between middlewares")
        if description[0] == Nodetype.NAME:
            return self.visit(name)
        if name != "string" and name not in NUMBERS:
            raise DefinitionError(f"{where} has the unknown type {_shown(name)}")
        return 4 if name == "string" else NUMBERS[name].itemsize, 0  # a string's length, then its bytes

    def _array(self, where: str, element: FieldDesc, count: int, *, fixed: bool) -> tuple[int, int]:
        size, leaves = self._field(where, element)
        if size == 0:
            raise DefinitionError(f"{where} is an array of empty messages")
        if not fixed:
            return 4, leaves
        if count < 1:
            raise DefinitionError(f"{where} is a fixed array of {count} elements")
        unrolled = element[0] == Nodetype.NAME or element[1][0] == "string"
        return count * size, count * max(leaves, 1) if unrolled else 0


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


def _shown(text: str) -> str:
    """Foreign text for a message: printable, quoted, short."""
    return repr(text if len(text) <= 60 else text[:57] + "...")
