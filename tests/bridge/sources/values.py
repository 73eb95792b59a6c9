"""What a record's data holds at a path, such as pose.pose.position.x."""

from __future__ import annotations

from functools import reduce
from typing import Any


def value_at(data: dict[str, Any], path: str) -> Any:
    return reduce(lambda value, name: value[name], path.split("."), data)
