"""IDL definitions, as far as ROS 2 messages use it: modules, structs, typedefs, constants (OMG IDL 4.2, 7.4).

A reader of its own, with one pass over the text: rosbags' parser takes time
exponential in nested parentheses and evaluates shifts of any size. Annotations
and constants are read over; only constants that are a plain number are kept,
as bounds. Unions, enumerations and arrays of more than one dimension, which
ROS 2 does not generate for messages, are refused.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from typing import cast

from rosbags.interfaces import Nodetype
from rosbags.interfaces.typing import BaseDesc, Fielddefs, FieldDesc, NameDesc

_SKIPPED = re.compile(r"(?:\s+|//[^\n]*|/\*.*?\*/|\#[^\n]*)+", re.DOTALL)
_TOKEN = re.compile(
    r"""[A-Za-z_][A-Za-z0-9_]*|::|[0-9][A-Za-z0-9.+]*|"(?:[^"\\\n]|\\.)*"|'(?:[^'\\\n]|\\.)*'|<<|>>|[^\s\w]""", re.ASCII
)
_INTEGER = re.compile(r"[0-9]{1,10}", re.ASCII)
_BASES = {
    "boolean": "bool", "octet": "byte", "char": "char", "wchar": "wchar", "short": "int16", "long": "int32",
    "float": "float32", "double": "float64", "string": "string", "wstring": "wstring",
    "int8": "int8", "int16": "int16", "int32": "int32", "int64": "int64",
    "uint8": "uint8", "uint16": "uint16", "uint32": "uint32", "uint64": "uint64",
}  # fmt: skip
_KEYWORDS = {"module", "struct", "typedef", "const", "union", "enum", "sequence", "bitset", "bitmask", "native"}
_MAX_NESTING = 16


def parse_idl(text: str, error: Callable[[str], Exception]) -> dict[str, Fielddefs]:
    """The structs of the text, in rosbags' tree form, not checked. `error` makes the exception of a reason."""
    return _Parser(text, error).parse()


class _Parser:
    def __init__(self, text: str, error: Callable[[str], Exception]) -> None:
        self._error = error
        self._tokens = self._tokenise(text)
        self._next = 0
        self._structs: dict[str, Fielddefs] = {}
        self._typedefs: dict[str, FieldDesc] = {}
        self._constants: dict[str, int] = {}

    def parse(self) -> dict[str, Fielddefs]:
        while self._next < len(self._tokens):
            self._definition(())
        return self._structs

    def _tokenise(self, text: str) -> list[str]:
        tokens = []
        position = 0
        while position < len(text):
            if skipped := _SKIPPED.match(text, position):
                position = skipped.end()
            elif text.startswith("/*", position):
                raise self._error("a comment does not end")
            elif match := _TOKEN.match(text, position):
                tokens.append(match[0])
                position = match.end()
            else:
                raise self._error(f"character {text[position]!r} is not IDL")
        return tokens

    def _peek(self) -> str:
        return self._tokens[self._next] if self._next < len(self._tokens) else ""

    def _take(self, expected: str = "") -> str:
        token = self._peek()
        if not token or (expected and token != expected):
            raise self._error(f"{expected or 'more'!r} is expected where {token or 'the end'!r} is")
        self._next += 1
        return token

    def _identifier(self) -> str:
        name = self._take()
        if not (name[0].isalpha() or name[0] == "_") or name in _KEYWORDS:
            raise self._error(f"{name!r} is not a name")
        return name

    def _definition(self, scope: tuple[str, ...]) -> None:
        self._annotations()
        kind = self._take()
        if kind == "module":
            if len(scope) >= _MAX_NESTING:
                raise self._error("modules are nested too deeply")
            inner = (*scope, self._identifier())
            self._take("{")
            while self._peek() != "}":
                self._definition(inner)
            self._take("}")
        elif kind == "struct":
            self._struct(scope)
        elif kind == "typedef":
            for name, description in self._declarations(scope):
                self._typedefs["/".join((*scope, name))] = description
        elif kind == "const":
            self._constant(scope)
        elif kind != ";":
            raise self._error(f"{kind!r} is not supported in a message")
        if kind in ("module", "struct") and self._peek() == ";":
            self._take()

    def _struct(self, scope: tuple[str, ...]) -> None:
        name = "/".join((*scope, self._identifier()))
        if self._peek() == ":":
            raise self._error("a struct that inherits is not supported")
        self._take("{")
        fields: Fielddefs = []
        while self._peek() != "}":
            self._annotations()
            fields.extend(self._declarations(scope))
        self._take("}")
        if name in self._structs:
            raise self._error(f"{name} is defined twice")
        self._structs[name] = fields

    def _constant(self, scope: tuple[str, ...]) -> None:
        tokens = []
        while (token := self._take()) != ";":
            tokens.append(token)
        if len(tokens) > 3 and tokens[-2] == "=" and _INTEGER.fullmatch(tokens[-1]):
            self._constants["/".join((*scope, tokens[-3]))] = int(tokens[-1])

    def _annotations(self) -> None:
        while self._peek() == "@":
            self._take()
            self._identifier()
            while self._peek() == "::":
                self._take()
                self._identifier()
            if self._peek() == "(":
                depth = 0
                while True:
                    token = self._take()
                    depth += (token == "(") - (token == ")")  # noqa: S105 - brackets, no password
                    if depth == 0:
                        break

    def _declarations(self, scope: tuple[str, ...]) -> list[tuple[str, FieldDesc]]:
        """`type name, name[3];`"""
        description = self._type(scope, 0)
        declared: list[tuple[str, FieldDesc]] = []
        while True:
            name = self._identifier()
            if self._peek() == "[":
                self._take()
                declared.append((name, (Nodetype.ARRAY, (self._element(description), self._number(scope)))))
                self._take("]")
                if self._peek() == "[":
                    raise self._error("an array of more than one dimension is not supported")
            else:
                declared.append((name, description))
            if self._take() != ",":
                self._next -= 1
                self._take(";")
                return declared

    def _type(self, scope: tuple[str, ...], depth: int) -> FieldDesc:
        word = self._take()
        if word == "sequence":
            if depth:
                raise self._error("a sequence of sequences is not supported")
            self._take("<")
            element = self._element(self._type(scope, depth + 1))
            bound = 0
            if self._peek() == ",":
                self._take()
                bound = self._number(scope)
            self._take(">")
            return (Nodetype.SEQUENCE, (element, bound))
        if word in ("string", "wstring"):
            bound = 0
            if self._peek() == "<":
                self._take()
                bound = self._number(scope)
                self._take(">")
            return cast(BaseDesc, (Nodetype.BASE, (word, bound)))
        if word == "unsigned":
            size = {"short": "uint16", "long": "uint32"}.get(self._take())
            if size is None:
                raise self._error("unsigned what?")
            return self._base("uint64" if size == "uint32" and self._took("long") else size)
        if word == "long":
            return self._base("int64" if self._took("long") else "float128" if self._took("double") else "int32")
        if word in _BASES:
            return self._base(_BASES[word])
        if word != "::":
            self._next -= 1
        parts = [self._identifier()]
        while self._took("::"):
            parts.append(self._identifier())
        return self._resolve(scope, parts)

    def _took(self, token: str) -> bool:
        if self._peek() == token:
            self._next += 1
            return True
        return False

    @staticmethod
    def _base(name: str) -> BaseDesc:
        return cast(BaseDesc, (Nodetype.BASE, (name, 0)))

    def _element(self, description: FieldDesc) -> BaseDesc | NameDesc:
        if description[0] == Nodetype.BASE or description[0] == Nodetype.NAME:
            return description
        raise self._error("an array of arrays is not supported")

    def _resolve(self, scope: tuple[str, ...], parts: list[str]) -> FieldDesc:
        """The typedef a name stands for, innermost scope first; else the struct of that name, defined here or not."""
        for end in range(len(scope), -1, -1):
            name = "/".join((*scope[:end], *parts))
            if name in self._typedefs:
                return self._typedefs[name]
            if name in self._structs:
                return (Nodetype.NAME, name)
        return (Nodetype.NAME, "/".join(parts if len(parts) > 1 else (*scope, *parts)))

    def _number(self, scope: tuple[str, ...]) -> int:
        token = self._peek()
        if _INTEGER.fullmatch(token):
            self._take()
            return int(token)
        parts = [self._identifier()]
        while self._took("::"):
            parts.append(self._identifier())
        for end in range(len(scope), -1, -1):
            name = "/".join((*scope[:end], *parts))
            if name in self._constants:
                return self._constants[name]
        raise self._error(f"{'::'.join(parts)} is not a number")
