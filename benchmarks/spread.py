"""What was measured several times: the median of the runs, and the spread from the lowest to the highest of them."""

from __future__ import annotations

import statistics
from collections.abc import Callable, Sequence
from functools import reduce
from typing import Any, NamedTuple


class Point(NamedTuple):
    """One figure of a table or a picture."""

    median: float
    low: float
    high: float

    def say(self, form: Callable[[float], str] | str = "") -> str:
        """"3 (2–4)"; "3" where all runs give the same, or there was one."""
        said, low, high = (form(value) if callable(form) else format(value, form) for value in self)
        return said if low == high else f"{said} ({low}–{high})"


def at(*keys: Any) -> Callable[[Any], Any]:
    """Looks a figure up in what a run has found: its keys, from outside."""
    return lambda found: reduce(lambda part, key: part[key], keys, found)


def point(values: Sequence[float]) -> Point:
    return Point(statistics.median(values), min(values), max(values))


def across(runs: Sequence[Any], figure: Callable[[Any], float]) -> Point:
    """A figure of each run."""
    return point([figure(run) for run in runs])


def along(runs: Sequence[Any], figures: Callable[[Any], Sequence[float]]) -> list[Point]:
    """A row of figures of each run: one point for each place in the row."""
    return [point(values) for values in zip(*map(figures, runs), strict=True)]
