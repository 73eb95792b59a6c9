"""The md5 sum by which ROS 1 tells message definitions apart.

Of a type: its constants, then its fields, one a line, comments and spaces
removed; a field of another message type has that type's sum in place of its
name (wiki.ros.org/ROS/Technical Overview, "Message serialization and msg MD5 sums").
It says whether two parties mean the same layout; it protects against nobody.
"""

from __future__ import annotations

import hashlib
import re

from rosbridge_eth.capture import Definition, DefinitionError, normalised_type_name
from rosbridge_eth.capture.definitions import SIZES

_BUILTIN = SIZES.keys() | {"string", "time", "duration"}
_SECTION = re.compile(r"^={80}[ \t]*\r?\n[ \t]*MSG:", re.MULTILINE)


def md5_of(definition: Definition, text: str) -> str:
    """The sum of a type, from the text that `definition` was read from. Raises DefinitionError."""
    first, *rest = _SECTION.split(text)
    texts = {definition.type_name: first}
    for section in rest:
        name, _, body = section.partition("\n")
        texts.setdefault(normalised_type_name(name.strip()), body)
    sums: dict[str, str] = {}
    # The definition's own order has every type after those it refers to, so nothing recurses here.
    for name in definition.fields:
        if name in texts:
            sums[name] = _sum(name, texts[name], sums)
    return sums[definition.type_name]


def _sum(owner: str, text: str, sums: dict[str, str]) -> str:
    constants, fields = [], []
    for line in text.splitlines():
        content = line.partition("#")[0].split()
        if not content:
            continue
        kind = content[0]
        if any("=" in part for part in content[1:]):
            # In a string's value, "#" and spaces are part of the value.
            declaration = line if kind == "string" else line.partition("#")[0]
            name, _, value = declaration.strip().partition(kind)[2].partition("=")
            constants.append(f"{kind} {name.strip()}={value.strip()}")
        elif len(content) < 2:
            raise DefinitionError(f"a line in the definition of {owner} is not a field: {line[:60]!r}")
        else:
            bare = kind.partition("[")[0]
            shown = kind if bare in _BUILTIN else sums.get(_full_name(owner, bare))
            if shown is None:
                raise DefinitionError(f"the definition of {owner} refers to {bare[:60]}, which is not ROS 1's")
            fields.append(f"{shown} {content[1]}")
    return hashlib.md5("\n".join([*constants, *fields]).encode(), usedforsecurity=False).hexdigest()


def _full_name(owner: str, name: str) -> str:
    if name == "Header":
        return "std_msgs/msg/Header"
    return normalised_type_name(name if "/" in name else f"{owner.partition('/')[0]}/{name}")
