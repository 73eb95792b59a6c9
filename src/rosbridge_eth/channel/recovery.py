"""Which packets arrived, which are lost, and how fast to send: RFC 9002 in the small.

Names are RFC 9002's: smoothed RTT, RTT variance, PTO (probe timeout),
congestion window, slow start threshold. Loss is found by packet threshold 3
or time threshold 9/8 RTT (6.1); the window is NewReno's (7.3) and paced (7.7).
Left out: ECN, under-use of the window, per-path state.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Generic, TypeVar

from rosbridge_eth.channel.wire import DATAGRAM_SIZE, MAX_ACK_RANGES

__all__ = ["Congestion", "InFlight", "Received", "RoundTrip", "SentPacket"]

T = TypeVar("T")

PACKET_THRESHOLD = 3
TIME_THRESHOLD = 9 / 8
GRANULARITY = 0.001  # s
INITIAL_RTT = 0.2  # s; RFC 9002 has 0.333, a handshake has usually measured it before
MAX_PTO = 4.0  # s: after an outage the path is tried at least this often

INITIAL_WINDOW = 10 * DATAGRAM_SIZE
MINIMUM_WINDOW = 2 * DATAGRAM_SIZE
PACING_GAIN = 1.25
PACING_BURST = 10 * DATAGRAM_SIZE


class RoundTrip:
    """RTT estimate (RFC 9002, 5.3), in seconds."""

    __slots__ = ("latest", "minimum", "smoothed", "variance")

    def __init__(self, sample: float | None = None) -> None:
        self.latest = self.minimum = 0.0
        self.smoothed, self.variance = INITIAL_RTT, INITIAL_RTT / 2
        if sample is not None:
            self.update(sample, 0.0)

    def update(self, sample: float, ack_delay: float) -> None:
        sample = max(sample, 1e-6)
        self.latest = sample
        if not self.minimum:
            self.minimum = self.smoothed = sample
            self.variance = sample / 2
            return
        self.minimum = min(self.minimum, sample)
        if sample - ack_delay >= self.minimum:
            sample -= ack_delay
        self.variance += (abs(self.smoothed - sample) - self.variance) / 4
        self.smoothed += (sample - self.smoothed) / 8

    def pto(self, max_ack_delay: float, count: int) -> float:
        """How long to wait for an acknowledgement after `count` probes went unanswered (6.2)."""
        base = self.smoothed + max(4 * self.variance, GRANULARITY) + max_ack_delay
        return float(min(base * 2 ** min(count, 16), max(MAX_PTO, base)))

    def loss_delay(self) -> float:
        return max(TIME_THRESHOLD * max(self.latest, self.smoothed), GRANULARITY)


class Congestion:
    """Congestion window in bytes, and the pacing that spreads it over a round trip."""

    __slots__ = ("_allowance", "_paced_at", "_recovery_start", "maximum", "threshold", "window")

    def __init__(self, now: float, maximum: int) -> None:
        self.window = INITIAL_WINDOW
        self.maximum = maximum
        self.threshold = maximum
        self._recovery_start = -1.0
        self._allowance = float(PACING_BURST)
        self._paced_at = now

    def acknowledged(self, size: int, sent_at: float) -> None:
        if sent_at <= self._recovery_start:
            return
        if self.window < self.threshold:
            self.window += size
        else:
            self.window += DATAGRAM_SIZE * size // self.window
        self.window = min(self.window, self.maximum)

    def lost(self, sent_at: float, now: float) -> None:
        """Halve the window, once per round trip."""
        if sent_at <= self._recovery_start:
            return
        self._recovery_start = now
        self.window = max(self.window // 2, MINIMUM_WINDOW)
        self.threshold = self.window

    def collapse(self, now: float) -> None:
        """After an outage: begin again at the minimum, so that what waited does not come as a flood (7.6)."""
        self._recovery_start = now
        self.threshold = max(self.window // 2, MINIMUM_WINDOW)
        self.window = MINIMUM_WINDOW
        self._allowance = min(self._allowance, float(MINIMUM_WINDOW))

    def _rate(self, rtt: float) -> float:
        return PACING_GAIN * self.window / max(rtt, GRANULARITY)

    def wait(self, now: float, rtt: float) -> float:
        """Seconds until pacing lets another datagram go; 0 is now."""
        elapsed = now - self._paced_at
        if elapsed > 0:
            self._allowance = min(self._allowance + elapsed * self._rate(rtt), float(PACING_BURST))
            self._paced_at = now
        if self._allowance > 0:
            return 0.0
        # Rounded up, or a timer may fire a hair too early and find nothing to do.
        return -self._allowance / self._rate(rtt) + 1e-4

    def sent(self, size: int) -> None:
        self._allowance -= size


class SentPacket(Generic[T]):
    """A packet that asked for an acknowledgement and has none yet; `frames` is what it carried."""

    __slots__ = ("at", "frames", "number", "size")

    def __init__(self, number: int, at: float, size: int, frames: tuple[T, ...]) -> None:
        self.number = number
        self.at = at
        self.size = size
        self.frames = frames


class InFlight(Generic[T]):
    """Packets sent and neither acknowledged nor lost, in the order of their numbers."""

    __slots__ = ("_packets", "bytes", "largest_acked")

    def __init__(self) -> None:
        self._packets: dict[int, SentPacket[T]] = {}
        self.bytes = 0
        self.largest_acked = -1

    def __len__(self) -> int:
        return len(self._packets)

    def __iter__(self) -> Iterator[SentPacket[T]]:
        return iter(self._packets.values())

    def add(self, packet: SentPacket[T]) -> None:
        self._packets[packet.number] = packet
        self.bytes += packet.size

    def oldest(self) -> SentPacket[T] | None:
        return next(iter(self._packets.values()), None)

    def acknowledge(self, ranges: list[tuple[int, int]]) -> list[SentPacket[T]]:
        """Take out what `ranges` (inclusive, highest first) name; at most as many steps as are in flight."""
        self.largest_acked = max(self.largest_acked, ranges[0][1])
        packets = self._packets
        taken: list[SentPacket[T]] = []
        for low, high in ranges:
            if high - low < len(packets):
                numbers = [n for n in range(low, high + 1) if n in packets]
            else:
                numbers = [n for n in packets if low <= n <= high]
            for number in numbers:
                packet = packets.pop(number)
                self.bytes -= packet.size
                taken.append(packet)
        return taken

    def take_lost(self, now: float, delay: float) -> list[SentPacket[T]]:
        """Take out what RFC 9002, 6.1 holds for lost at `now`."""
        lost: list[SentPacket[T]] = []
        for packet in self._packets.values():
            if packet.number > self.largest_acked:
                break
            if packet.at + delay <= now or packet.number <= self.largest_acked - PACKET_THRESHOLD:
                lost.append(packet)
        for packet in lost:
            del self._packets[packet.number]
            self.bytes -= packet.size
        return lost

    def take_all(self) -> list[SentPacket[T]]:
        """Take out everything."""
        taken = list(self._packets.values())
        self._packets.clear()
        self.bytes = 0
        return taken

    def loss_time(self, delay: float) -> float | None:
        """When the next packet below the largest acknowledged one will count as lost."""
        oldest = self.oldest()
        if oldest is None or oldest.number > self.largest_acked:
            return None
        return oldest.at + delay


class Received:
    """Packet numbers to acknowledge, as at most MAX_ACK_RANGES + 1 ranges, and when."""

    __slots__ = ("due", "largest_at", "pending", "ranges")

    def __init__(self) -> None:
        self.ranges: list[tuple[int, int]] = []  # inclusive, highest first
        self.pending = 0  # packets that asked for an acknowledgement and got none
        self.due: float | None = None
        self.largest_at = 0.0

    def add(self, number: int, now: float) -> bool:
        """Note a packet; True if it arrived out of order."""
        ranges = self.ranges
        if not ranges or number > ranges[0][1]:
            self.largest_at = now
            if ranges and number == ranges[0][1] + 1:
                ranges[0] = (ranges[0][0], number)
                return False
            gap = bool(ranges)
            ranges.insert(0, (number, number))
            del ranges[MAX_ACK_RANGES + 1 :]
            return gap
        for index, (first, last) in enumerate(ranges):
            if first <= number <= last:
                return True
            if number == first - 1:
                ranges[index] = (number, last)
                if index + 1 < len(ranges) and ranges[index + 1][1] == number - 1:
                    ranges[index] = (ranges.pop(index + 1)[0], last)
                return True
            if number > last:
                ranges[index : index + 1] = (
                    [(first, number)] if number == last + 1 else [(number, number), (first, last)]
                )
                del ranges[MAX_ACK_RANGES + 1 :]
                return True
        if len(ranges) <= MAX_ACK_RANGES:
            ranges.append((number, number))
        return True

    def forget_below(self, number: int) -> None:
        """The peer knows of everything up to `number`: no need to say it again."""
        kept = [(max(first, number), last) for first, last in self.ranges if last >= number]
        if kept:
            self.ranges = kept
