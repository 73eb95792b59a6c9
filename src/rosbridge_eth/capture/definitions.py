"""Message definitions: parsed by rosbags, behind limits; what rosbags compiles is only what passed the checks here.

rosbags turns a definition into Python source and executes it, once for the message class and once for each way of
(de)serialising it; `conversion` does the same. A definition comes from a publisher's connection header, from a bag or
from a log, that is, from anyone. So what is handed on is a tree that holds nothing but names that match the grammar of
ROS identifiers, built-in type names and bounded integers. Constants and default values never reach it: they are not
on the wire. They are kept in `text`, which is copied and not interpreted.

Before rosbags parses a text (MSG: wiki.ros.org/msg; IDL: OMG IDL 4.2, 7.4): comments and blank lines are gone, since
its time grows with the square of their number; its length, fields and nesting are bounded; and of IDL, annotations,
expressions and sequences of sequences are gone or refused, on which it takes exponential time, or another type.

Refused after it: a type that is missing, contains itself or is nested too deeply (rosbags would recurse), a
type that doubles at every level, a fixed array that unrolls into too much code, arrays of elements that take no bytes
(a count of 2**32 would cost no data), and a definition too long for a line of the log.
"""

from __future__ import annotations

import keyword
import re
from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from itertools import accumulate
from typing import Literal, TypeAlias

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
"""In what rosbags' parsers end on what is no definition."""


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
    if unnamed := [each for each in types if normalised_type_name(each) != each]:
        raise DefinitionError(f"{_shown(unnamed[0])} is not a message type's full name")
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
    if plain.count(";") + plain.count(",") > MAX_FIELDS + MAX_TYPES:
        raise ValueError(f"it has more than {MAX_FIELDS + MAX_TYPES} declarations")
    types = get_types_from_idl(plain.replace(">>", "> >"))  # which it takes for a shift
    if len(types) < len(re.findall(r"\bstruct\b", plain)):
        raise ValueError("a struct is defined twice")
    return types


def _check_length(name: str, text: str) -> None:
    try:
        length = len(orjson.dumps(text))
    except orjson.JSONEncodeError:
        raise DefinitionError(f"the definition of {name} is not text") from None
    if length > MAX_KEPT:
        raise DefinitionError(f"the definition of {name} is longer than {MAX_KEPT} bytes without its comments")


def check_types(
    type_name: str, types: Mapping[str, Fielddefs], text: str | None = None,
    constants: Mapping[str, Constdefs] | None = None,
) -> Definition:  # fmt: skip
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
    _check_length(type_name, text)
    return Definition(type_name, checker.done, checker.smallest, text, constants or {})


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

    def _refuse_unsupported(self, where: str, kind: str) -> None:
        if kind in _UNSUPPORTED:
            raise DefinitionError(f"{where} is a {kind}, not supported: its wire form differs between middlewares")

    def _field(self, where: str, description: FieldDesc, depth: int) -> int:
        if description[0] == Nodetype.BASE:
            name, bound = description[1]
            if not 0 <= bound <= MAX_COUNT:
                raise DefinitionError(f"{where} has a length out of range: {bound}")
            self._refuse_unsupported(where, name)
            if name not in _BASES:
                raise DefinitionError(f"{where} has the unknown type {_shown(name)}")
            return SIZES.get(name, 4)
        if description[0] == Nodetype.NAME:
            if description[1] not in self.types:  # rosbags takes a wstring in MSG for a message type
                self._refuse_unsupported(where, description[1].rpartition("/")[2])
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


def _shown(text: str) -> str:
    """Foreign text for a message: printable, quoted, short."""
    return repr(text if len(text) <= 60 else text[:57] + "...")
