"""Field paths: which parts of a message are captured.

    pose.pose.position.x     a field of a field
    pose.pose                a field with everything in it
    ranges[0]                one element of an array; absent from the record if the array is shorter
    poses[*].position        a field of every element
    *                        the whole message

The record keeps the shape of the message: `pose.pose.position.x` is found in its
data as {"pose": {"pose": {"position": {"x": ...}}}}, and `ranges[0]` as
{"ranges": {"0": ...}}.
"""

from __future__ import annotations

import re
from collections.abc import Iterable
from dataclasses import dataclass, field

_SEGMENT = re.compile(r"([A-Za-z][A-Za-z0-9_]*)(?:\[(\*|[0-9]{1,9})\])?", re.ASCII)


@dataclass
class Selection:
    """A tree of what is selected: everything below, or these members, or these elements."""

    everything: bool = False
    members: dict[str, Selection] = field(default_factory=dict)
    each: Selection | None = None
    elements: dict[int, Selection] = field(default_factory=dict)


EVERYTHING = Selection(everything=True)


def parse_path(path: str) -> tuple[str | int | None, ...]:
    """Steps of a path: a name, an index, or None for every element. Raises ValueError with a sentence."""
    steps: list[str | int | None] = []
    for segment in path.split("."):
        match = _SEGMENT.fullmatch(segment)
        if match is None:
            raise ValueError(f"{path!r} is not a field path, such as pose.pose.position.x or ranges[0]")
        name, index = match.groups()
        steps.append(name)
        if index is not None:
            steps.append(None if index == "*" else int(index))
    return tuple(steps)


def parse_paths(paths: Iterable[str]) -> Selection:
    """The union of the paths; "*" is the whole message. Raises ValueError with a sentence."""
    root = Selection()
    for path in paths:
        node = root
        for step in () if path == "*" else parse_path(path):
            if isinstance(step, str):
                node = node.members.setdefault(step, Selection())
            elif step is None:
                node.each = node.each or Selection()
                node = node.each
            else:
                node = node.elements.setdefault(step, Selection())
        node.everything = True
    _check(root)
    return root


def _check(node: Selection) -> None:
    if node.each is not None and node.elements and not node.everything:
        raise ValueError("one array is selected by [*] and by an index; choose one of them")
    for below in (*node.members.values(), *node.elements.values(), *([node.each] if node.each else ())):
        _check(below)
