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
from collections.abc import Iterable, Mapping, Sequence
from typing import TypeAlias

_SEGMENT = re.compile(r"([A-Za-z][A-Za-z0-9_]*)(?:\[(\*|[0-9]{1,9})\])?", re.ASCII)

Step: TypeAlias = str | int
"""The name of a field, an index, or "*" for every element."""
Selection: TypeAlias = "Mapping[Step, Selection] | None"
"""What is selected below each step; None is everything."""


def parse_path(path: str) -> tuple[Step, ...]:
    """Steps of a path. Raises ValueError with a sentence."""
    steps: list[Step] = []
    for segment in path.split("."):
        match = _SEGMENT.fullmatch(segment)
        if match is None:
            raise ValueError(f"{path!r} is not a field path, such as pose.pose.position.x or ranges[0]")
        name, index = match.groups()
        steps += [name] if index is None else [name, "*" if index == "*" else int(index)]
    return tuple(steps)


def parse_paths(paths: Iterable[str]) -> Selection:
    """The union of the paths; "*" is the whole message, and so is no path. Raises ValueError with a sentence."""
    return _union([() if path == "*" else parse_path(path) for path in paths])


def _union(paths: Sequence[tuple[Step, ...]]) -> Selection:
    if not paths or () in paths:
        return None
    first = dict.fromkeys(path[0] for path in paths)
    if "*" in first and any(isinstance(step, int) for step in first):
        raise ValueError("one array is selected by [*] and by an index; choose one of them")
    return {step: _union([path[1:] for path in paths if path[0] == step]) for step in first}
