"""Where messages come from: bags, a simulated robot, live ROS 1 and ROS 2 graphs.

Uses `capture` for the form in which a message is handed over (RawMessage, Decoder), and `config` for the tables that
describe a source.
"""

from __future__ import annotations

from collections.abc import Callable

from rosbridge_eth.config.models import AnySource
from rosbridge_eth.robot.sources.bag import BagSource, sample_bag
from rosbridge_eth.robot.sources.protocol import Clock, Emit, Offer, Selection, Source
from rosbridge_eth.robot.sources.ros1.source import Ros1Source
from rosbridge_eth.robot.sources.ros2.source import Ros2Source
from rosbridge_eth.robot.sources.sim import SimSource

__all__ = ["BagSource", "Clock", "Emit", "Offer", "Selection", "SimSource", "Source", "open_source", "sample_bag"]

_KINDS: dict[str, Callable[..., Source]] = {"bag": BagSource, "ros1": Ros1Source, "ros2": Ros2Source, "sim": SimSource}


def open_source(table: AnySource, selection: Selection) -> Source:
    """The source that `[source]` describes: its keys are what a source is made with. Raises SourceError."""
    return _KINDS[table.kind](selection=selection, **table.model_dump(exclude={"kind"}))
