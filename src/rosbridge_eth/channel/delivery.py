"""Which packets are lost, and how fast to send. Loss and round trip after RFC 9002; the window is this project's.

Names are RFC 9002's: smoothed RTT, RTT variance, PTO (probe timeout). A packet is lost when one sent later is
acknowledged and 9/8 of a round trip have passed (6.1.2); the threshold of three packets (6.1.1) is left out, since it
takes reordering for loss.

The window follows the queue that it makes, not loss, since radio loses without being full; see `Window`.
Left out: ECN, state per path.
"""

from __future__ import annotations

from collections import deque

from rosbridge_eth.channel.admission import TokenBucket
from rosbridge_eth.channel.wire import DATAGRAM_SIZE

TIME_THRESHOLD = 9 / 8
GRANULARITY = 0.001  # s
INITIAL_RTT = 0.2  # s; RFC 9002 has 0.333, a handshake has usually measured it before
MAX_PTO = 4.0  # s: after an outage the path is tried at least this often


class RoundTrip:
    """RTT estimate (RFC 9002, 5.3), in seconds. What the peer waits before it acknowledges is taken as part of it."""

    def __init__(self, sample: float | None = None) -> None:
        self.latest, self.smoothed, self.variance = 0.0, INITIAL_RTT, INITIAL_RTT / 2
        if sample is not None:
            self.update(sample)

    def update(self, sample: float) -> None:
        if self.latest:
            self.variance += (abs(self.smoothed - sample) - self.variance) / 4
            self.smoothed += (sample - self.smoothed) / 8
        else:
            self.smoothed, self.variance = sample, sample / 2
        self.latest = max(sample, 1e-6)

    def pto(self, max_ack_delay: float, count: int = 0) -> float:
        """How long to wait for an acknowledgement after `count` probes went unanswered (6.2)."""
        base = self.smoothed + max(4 * self.variance, GRANULARITY) + max_ack_delay
        return float(min(base * 2 ** min(count, 16), max(MAX_PTO, base)))

    def loss_delay(self) -> float:
        return max(TIME_THRESHOLD * max(self.latest, self.smoothed), GRANULARITY)


INITIAL_WINDOW = 16 * DATAGRAM_SIZE
MAX_WINDOW = 512 * 1024
MINIMUM_WINDOW = 2 * DATAGRAM_SIZE
QUEUE_SHARE = 4 * DATAGRAM_SIZE
"""What each sender adds to a queue that is long enough: it makes those that share one come to equal windows."""
QUEUE_TIME = 0.025  # s; a queue this long, and a quarter of the round trip, is long enough (LEDBAT++ aims at 0.06)
QUEUE_SHARE_OF_RTT = 1 / 4
GAIN = 1.7
GAIN_PERIOD = 6
"""The window is at most GAIN times what one of the last GAIN_PERIOD round trips delivered: it holds up to 1 - 1/1.7 =
41 % of loss, and a link that drops instead of queueing is overdriven by no more than that."""
BASE_PERIOD = 30.0  # s; the shortest round trip is that of the last one or two periods
PACING_GAIN = 1.25
PACING_BURST = 10 * DATAGRAM_SIZE


class Window:
    """Congestion window in bytes, adjusted once a round trip, and the pacing that spreads it over one.

    A round trip that met less than half of the queue it may make doubles it; else it becomes
    window * (shortest round trip + that queue) / present round trip + QUEUE_SHARE (FAST TCP, Wei et al. 2006, with
    gamma = 1). `GAIN` bounds both.
    """

    def __init__(self, now: float, maximum: int = MAX_WINDOW) -> None:
        self.size = min(INITIAL_WINDOW, maximum)
        self.maximum = maximum
        self.limited = False
        """The window kept something from being sent in this round trip."""
        self._base = self._next_base = self._round_rtt = float("inf")
        self._base_at = now
        self._round_end = 0  # a round trip is over when a packet sent after its beginning is acknowledged
        self._delivered = 0
        self._recent: deque[int] = deque(maxlen=GAIN_PERIOD)  # what round trips delivered
        self._pacing = TokenBucket(0.0, PACING_BURST, now)

    def acknowledged(self, size: int, rtt: float | None, largest: int, next_number: int, now: float) -> None:
        """`size` bytes arrived; `largest` is the highest number acknowledged, `next_number` the next one's."""
        self._delivered += size
        if rtt is not None:
            self._round_rtt = min(self._round_rtt, rtt)
        if largest >= self._round_end:
            self._recent.append(self._delivered)
            if self._round_rtt < float("inf"):
                self._adjust(now)
            self._round_end = next_number
            self._delivered, self._round_rtt, self.limited = 0, float("inf"), False

    def _adjust(self, now: float) -> None:
        rtt = self._round_rtt
        if now - self._base_at >= BASE_PERIOD:
            self._base, self._next_base, self._base_at = self._next_base, float("inf"), now
        self._next_base = min(self._next_base, rtt)
        self._base = min(self._base, rtt)
        if not self.limited:
            return  # it was not put to the test
        queue = QUEUE_TIME + QUEUE_SHARE_OF_RTT * self._base
        may_double = rtt < self._base + queue / 2
        wanted = 2.0 * self.size if may_double else self.size * (self._base + queue) / rtt + QUEUE_SHARE
        bound = GAIN * max(self._recent) + QUEUE_SHARE
        self.size = int(max(MINIMUM_WINDOW, min(wanted, bound, self.maximum)))

    def collapse(self) -> None:
        """After an outage: begin again at the minimum, so that what waited does not come as a flood (7.6)."""
        self.size = MINIMUM_WINDOW
        self._recent.clear()
        self._pacing.level = min(self._pacing.level, MINIMUM_WINDOW)

    def wait(self, now: float, rtt: float) -> float:
        """Seconds until pacing lets another datagram go; 0 is now."""
        self._pacing.rate = PACING_GAIN * self.size / max(rtt, GRANULARITY)
        return 0.0 if self._pacing.available(now) > 0 else self._pacing.ready_at() - now

    def sent(self, size: int) -> None:
        self._pacing.charge(size)
