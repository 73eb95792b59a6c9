"""IDL definitions, as far as ROS 2 messages use it (OMG IDL 4.2, 7.4), rewritten in the MSG format.

    module pkg { module msg {
      typedef double double__36[36];                         pkg/msg/Name:
      const long LIMIT = 7;
      struct Name {
        double__36 covariance;                                 float64[36] covariance
        sequence<string<5>, LIMIT> names;                      string<=5[<=7] names
        other::msg::Part a, b[2];                              other/msg/Part a, other/msg/Part[2] b
      };
    }; };

Comments, annotations and preprocessor lines are left out; a constant is known where it is a plain number. Unions, enums
and expressions are refused here; what MSG has no form for (arrays of arrays, unknown bounds) makes a line that is
refused there. Nothing recurses, and the expressions below match in linear time: rosbags' parser needs exponential time
for nested parentheses and sequences, and computes shifts of any size.
"""

from __future__ import annotations

import re
from collections.abc import Iterator

_STRING = r""" "(?:[^"\\\n]|\\.)*+" | '(?:[^'\\\n]|\\.)*+' """
_ID = r"[A-Za-z][A-Za-z0-9_]*+"
_SCOPED = rf"(?:::)?+{_ID}(?:::{_ID})*+"
_BOUND = rf"(?:[0-9]{{1,10}}|{_SCOPED})"
# Of a file that has several: a line of 80 "=" before each. A comment that does not end goes on to the end of the text.
_SKIPPED = re.compile(
    rf"""^={{80}}\r?\n(?:IDL:[^\n]*+)? | //[^\n]*+ | /\*.*?(?:\*/|\Z) | \#[^\n]*+
       | @\s*+{_SCOPED}\s*+(?:\((?:{_STRING}|[^"'()])*+\))? | {_STRING}""",
    re.ASCII | re.DOTALL | re.MULTILINE | re.VERBOSE,
)
# The others are for text without superfluous spaces.
_SCOPE = re.compile(rf"(module|struct) ({_ID})", re.ASCII)
_CONSTANT = re.compile(rf"const [A-Za-z][\w:<> ]* ({_ID}) ?= ?(?:([0-9]{{1,10}})|.*)", re.ASCII)
_DECLARATION = re.compile(
    rf"""(?P<sequence>sequence\ ?<\ ?)?
    (?P<type>unsigned\ (?:short|long\ long|long)\b|long\ (?:long|double)\b|{_SCOPED})
    (?:\ ?<\ ?(?P<length>{_BOUND})\ ?>)?
    (?(sequence)\ ?(?:,\ ?(?P<bound>{_BOUND})\ ?)?>)
    \ ?\b(?P<names>[^<>]+)""",
    re.ASCII | re.VERBOSE,
)
_DECLARATOR = re.compile(rf" ?({_ID}) ?(?:\[ ?({_BOUND}) ?\])? ?", re.ASCII)
_BASES = {
    "boolean": "bool", "octet": "byte", "float": "float32", "double": "float64", "long double": "float128",
    "short": "int16", "unsigned short": "uint16", "long": "int32", "unsigned long": "uint32", "long long": "int64",
    "unsigned long long": "uint64",
} | {name: name for name in (
    "char", "wchar", "string", "wstring", "int8", "uint8", "int16", "uint16", "int32", "uint32", "int64", "uint64",
)}  # fmt: skip


def idl_as_msg(text: str) -> dict[str, list[str]]:
    """Of each struct, its fields as lines in the MSG format. Raises ValueError with a reason."""
    structs: dict[str, list[str]] = {}
    known: dict[str, str] = {}  # typedefs and constants by their full names, as MSG writes them
    scope: list[str] = []
    *statements, rest = re.split("([;{}])", " ".join(_SKIPPED.sub(" ", text).split()))
    for statement, end in zip(statements[::2], statements[1::2], strict=True):
        head, inside = statement.strip(), "/".join(scope)
        if end == "{" and (match := _SCOPE.fullmatch(head)) and inside not in structs and len(scope) < 8:
            scope.append(match[2])
            if match[1] == "struct" and structs.setdefault("/".join(scope), []):
                raise ValueError(f"struct {match[2]} is defined twice")
        elif end == "}" and not head and scope:
            scope.pop()
        elif end == ";" and (match := _CONSTANT.fullmatch(head)):
            known["::".join([*scope, match[1]])] = match[2] or "unknown"
        elif end == ";" and head.startswith("typedef "):
            known |= {"::".join([*scope, name]): kind for kind, name in _declared(head[8:], scope, known)}
        elif end == ";" and head and inside in structs:
            structs[inside] += [f"{kind} {name}" for kind, name in _declared(head, scope, known)]
        elif head or end != ";":
            raise ValueError(f"{head[:40] + end!r} is not supported in a message")
    if rest.strip() or scope:
        raise ValueError("it ends within a declaration")
    return structs


def _declared(text: str, scope: list[str], known: dict[str, str]) -> Iterator[tuple[str, str]]:
    """Type, as MSG writes it, and name of all that a declaration declares."""

    def resolved(name: str, otherwise: str) -> str:
        """What is known by that name, in the nearest scope."""
        names = ("::".join([*scope[:depth], name.removeprefix("::")]) for depth in range(len(scope), -1, -1))
        return next((known[full] for full in names if full in known), otherwise)

    match = _DECLARATION.fullmatch(text)
    if match is None:
        raise ValueError(f"{text[:40]!r} is not a type and a name")
    kind, length, bound = match["type"], match["length"], match["bound"]
    parts = kind.removeprefix("::").split("::")
    kind = _BASES.get(kind) or resolved(kind, "/".join(parts if len(parts) > 1 else [*scope[:2], *parts]))
    if length:
        kind += f"<={resolved(length, length)}"
    if match["sequence"]:
        kind += f"[<={resolved(bound, bound)}]" if bound else "[]"
    for declarator in match["names"].split(","):
        part = _DECLARATOR.fullmatch(declarator)
        if part is None:
            raise ValueError(f"{declarator[:40]!r} is not a name")
        yield f"{kind}[{resolved(part[2], part[2])}]" if part[2] else kind, part[1]
