"""Where messages come from: bags, a simulated robot, live ROS 1 and ROS 2 graphs.

Uses `capture` for the form in which a message is handed over (RawMessage, Decoder).
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import ClassVar, Protocol, cast

from rosbridge_eth.errors import SourceError
from rosbridge_eth.sources.bag import BagSettings, BagSource, sample_bag
from rosbridge_eth.sources.protocol import Clock, Emit, Offer, Source, SystemClock
from rosbridge_eth.sources.selection import Selection
from rosbridge_eth.sources.sim import SimSettings, SimSource

__all__ = [
    "KINDS", "BagSettings", "BagSource", "Clock", "Emit", "Offer", "Selection", "SimSettings", "SimSource", "Source",
    "SourceSettings", "SystemClock", "open_source", "sample_bag",
]  # fmt: skip


class SourceSettings(Protocol):
    """Settings of some kind of source."""

    kind: ClassVar[str]


KINDS: dict[str, str] = {
    "bag": "rosbridge_eth.sources.bag:BagSource",
    "ros1": "rosbridge_eth.sources.ros1:Ros1Source",
    "ros2": "rosbridge_eth.sources.ros2:Ros2Source",
    "sim": "rosbridge_eth.sources.sim:SimSource",
}
"""Kind to factory, called with (settings, selection, clock or None), and imported when it is needed."""


def open_source(settings: SourceSettings, selection: Selection, clock: Clock | None = None) -> Source:
    """The source that the settings describe, opened. Raises SourceError."""
    if settings.kind not in KINDS:
        raise SourceError(f"there is no source of kind {settings.kind!r}; there are {', '.join(sorted(KINDS))}")
    module, _, name = KINDS[settings.kind].partition(":")
    try:
        factory = getattr(import_module(module), name)
    except ImportError as error:
        raise SourceError(f"a source of kind {settings.kind!r} needs {error.name}, which is not installed") from error
    return cast(Callable[[SourceSettings, Selection, Clock | None], Source], factory)(settings, selection, clock)
