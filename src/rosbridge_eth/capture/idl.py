"""IDL definitions, as far as ROS 2 messages use it, by rosbags' parser, which is given only what it reads quickly.

rosbags' parser takes time exponential in nested parentheses and sequences, evaluates shifts of any size and recurses.
So the text is first reduced to plain declarations (OMG IDL 4.2, 7.4): comments and annotations go, a constant keeps
its value only where that is a plain number, as which it may be a bound, and any expression, deep nesting or endless
list is refused.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator

from rosbags.interfaces.typing import Fielddefs
from rosbags.typesys import TypesysError, get_types_from_idl

_TOKEN = re.compile(
    r"""(?P<skipped>\s+|//[^\n]*|/\*.*?\*/|\#[^\n]*)|[A-Za-z][A-Za-z0-9_]*|::|[0-9][A-Za-z0-9.+]*"""
    r"""|"(?:[^"\\\n]|\\.)*"|'(?:[^'\\\n]|\\.)*'|[^\w\s"']""",
    re.ASCII | re.DOTALL,
)
_INTEGER = re.compile(r"[0-9]{1,10}", re.ASCII)
_PLAIN = re.compile(r"[A-Za-z][A-Za-z0-9_]*|[0-9]{1,10}|::|[;,<>{}\[\]=]", re.ASCII)
_CLOSING = {"}": "{", "]": "[", ">": "<"}
_MAX_TOKENS = 1 << 14
_MAX_NESTING = 16
_MAX_SCOPES = 8
_MAX_BOUNDS = 128
"""Lengths of arrays, sequences and strings: rosbags' parser takes up to ten milliseconds for each."""

MakeError = Callable[[str], Exception]


def parse_idl(text: str, error: MakeError) -> dict[str, Fielddefs]:
    """The structs of the text, in rosbags' tree form, not checked. `error` makes the exception of a reason."""
    tokens = list(_without_constants(iter(_without_annotations(_tokens(text, error), error)), error))
    if not tokens:
        return {}
    _check(tokens, error)
    try:
        types = get_types_from_idl(" ".join(tokens).replace(" :: ", "::"))
    except (TypesysError, ValueError, KeyError, AssertionError, RecursionError) as reason:
        # rosbags quotes the whole text first; what it expected stands at the end.
        raise error(str(reason).rpartition("\n")[2] or type(reason).__name__) from None
    if len(types) != tokens.count("struct"):
        raise error("a struct is defined twice")
    return {name: fields for name, (_, fields) in types.items()}


def _tokens(text: str, error: MakeError) -> list[str]:
    tokens: list[str] = []
    position = 0
    while position < len(text):
        match = _TOKEN.match(text, position)
        if match is None or (text.startswith("/*", match.start()) and match["skipped"] is None):
            raise error(f"{text[position : position + 20]!r} is not IDL")
        position = match.end()
        if match["skipped"] is None:
            tokens.append(match[0])
    return tokens


def _without_annotations(tokens: list[str], error: MakeError) -> list[str]:
    """`@name(...)` goes; whatever else has parentheses is refused later."""
    kept: list[str] = []
    position = 0
    while position < len(tokens):
        if tokens[position] != "@":
            kept.append(tokens[position])
            position += 1
            continue
        position += 2
        while tokens[position : position + 1] == ["::"]:
            position += 2
        depth = 0
        while tokens[position : position + 1] == ["("] or depth:
            if position >= len(tokens):
                raise error("an annotation does not end")
            depth += (tokens[position] == "(") - (tokens[position] == ")")
            position += 1
            if not depth:
                break
    return kept


def _without_constants(tokens: Iterator[str], error: MakeError) -> Iterator[str]:
    """A constant becomes a number; 0 if it is not a plain one, which no bound may be."""
    for token in tokens:
        if token != "const":  # noqa: S105 - a keyword of IDL
            yield token
            continue
        declaration: list[str] = []
        while not declaration or declaration[-1] != ";":
            try:
                declaration.append(next(tokens))
            except StopIteration:
                raise error("a constant does not end") from None
        if "=" not in declaration[1:]:
            raise error("a constant has no value")
        name, value = declaration[declaration.index("=", 1) - 1], declaration[-2]
        plain = declaration[-3] == "=" and _INTEGER.fullmatch(value)
        yield from ("const", "long", name, "=", value.lstrip("0") or "0" if plain else "0", ";")


def _check(tokens: list[str], error: MakeError) -> None:
    """Nothing that rosbags' parser takes long for, or recurses in."""
    if len(tokens) > _MAX_TOKENS:
        raise error("it is too long")
    opened: list[str] = []
    scopes = bounds = 0
    for before, token in zip(["", *tokens], tokens, strict=False):
        if not _PLAIN.fullmatch(token):
            raise error(f"{token!r} is not supported in a message")
        scopes = scopes + 1 if token == "::" else scopes if before == "::" else 0  # noqa: S105 - a sign
        if scopes > _MAX_SCOPES or len(opened) > _MAX_NESTING:
            raise error("it is nested too deeply")
        in_sequence = opened[-1:] == ["<"]
        if token == "sequence" and in_sequence:  # noqa: S105 - a keyword of IDL
            raise error("a sequence of sequences is not supported")
        bounds += token == "[" or (token == "<" and before != "sequence") or (token == "," and in_sequence)  # noqa: S105
        if bounds > _MAX_BOUNDS:
            raise error("it has too many bounds")
        if token in "{[<":  # noqa: S105 - signs
            opened.append(token)
        elif token in _CLOSING and (not opened or opened.pop() != _CLOSING[token]):
            raise error(f"{token!r} closes nothing")
