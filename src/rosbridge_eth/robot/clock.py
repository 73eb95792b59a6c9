"""What time it is on a robot, and how far that can be believed.

Many robots have no clock battery and start in 1970. Certificates are checked
at the later of the machine's clock and a floor that authenticated servers
raised; records say whether the kernel holds its clock to be synchronised.
"""

from __future__ import annotations

import ctypes
import sys
import time
from collections.abc import Callable
from datetime import UTC, datetime

from rosbridge_eth.home import RobotHome

_TIME_ERROR = 5  # adjtimex(2): the clock is not synchronised
_TIMEX_SIZE = 512  # struct timex has 208 bytes on 64-bit Linux; modes = 0 in its first word asks and changes nothing


def clock_synchronised() -> bool:
    """Whether the kernel counts its clock as synchronised (NTP, PTP, chrony); False where it cannot be asked."""
    if not sys.platform.startswith("linux"):
        return False
    adjtimex = getattr(ctypes.CDLL(None), "adjtimex", None)
    if adjtimex is None:
        return False
    state = int(adjtimex(ctypes.create_string_buffer(_TIMEX_SIZE)))
    return 0 <= state < _TIME_ERROR


def certificate_clock(home: RobotHome, wall: Callable[[], float] = time.time) -> Callable[[], datetime]:
    """The clock to check certificates against: never before the latest time a server has proven to this robot."""

    def now() -> datetime:
        return datetime.fromtimestamp(max(wall(), home.clock_floor()), UTC)

    return now
