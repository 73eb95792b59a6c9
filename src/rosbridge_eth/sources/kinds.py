"""The registry of source kinds. A kind is a settings class with `kind`, and a factory.

Factories are named as `module:function` and imported when first used, so a kind
may need a package (rclpy) that most robots do not have.
"""

from __future__ import annotations

from collections.abc import Callable
from importlib import import_module
from typing import ClassVar, Protocol, cast

from rosbridge_eth.errors import SourceError
from rosbridge_eth.sources.protocol import Clock, Source
from rosbridge_eth.sources.selection import Selection


class SourceSettings(Protocol):
    """Settings of some kind of source."""

    kind: ClassVar[str]


KINDS: dict[str, str] = {
    "bag": "rosbridge_eth.sources.bag:BagSource",
    "ros1": "rosbridge_eth.sources.ros1:Ros1Source",
    "ros2": "rosbridge_eth.sources.ros2:Ros2Source",
    "sim": "rosbridge_eth.sources.sim:SimSource",
}
"""Kind to factory, called with (settings, selection, clock or None)."""


def register_kind(kind: str, factory: str) -> None:
    """Add a kind; `factory` is "module:function". ValueError if the kind exists with another factory."""
    if KINDS.setdefault(kind, factory) != factory:
        raise ValueError(f"source kind {kind!r} is already registered as {KINDS[kind]}")


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
