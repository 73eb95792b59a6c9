"""Where messages come from: bags, a simulated robot, and whatever kinds are registered.

Uses `capture` for the form in which a message is handed over (RawMessage, Decoder).
"""

from rosbridge_eth.sources.bag import BagSettings, BagSource
from rosbridge_eth.sources.kinds import KINDS, SourceSettings, open_source, register_kind
from rosbridge_eth.sources.protocol import Clock, Emit, Offer, Source, SystemClock
from rosbridge_eth.sources.sample import sample_bag
from rosbridge_eth.sources.selection import Changes, Selection, Watch
from rosbridge_eth.sources.sim import SimSettings, SimSource

__all__ = [
    "KINDS",
    "BagSettings",
    "BagSource",
    "Changes",
    "Clock",
    "Emit",
    "Offer",
    "Selection",
    "SimSettings",
    "SimSource",
    "Source",
    "SourceSettings",
    "SystemClock",
    "Watch",
    "open_source",
    "register_kind",
    "sample_bag",
]
