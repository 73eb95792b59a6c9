"""A robot's messages as a byte stream, one way, over packets that get lost: the sending and the receiving half.

A message stands in the stream behind its length (4 bytes). The stream is cut into segments, counted from 0, when they
are first sent; a segment that is lost goes again as it was, in a new packet. The receiver says which packets came and
which segment is next in order (wire.Answer); it has room for SEGMENTS from that one on. No clock, no socket, no keys.
"""

from __future__ import annotations

from collections import Counter
from heapq import heappop, heappush
from itertools import cycle, islice
from typing import NamedTuple

from rosbridge_eth.channel import wire
from rosbridge_eth.channel.delivery import RoundTrip, Window
from rosbridge_eth.channel.wire import Answer, Drop, Frame, Malformed, Refused

MAX_MESSAGE = 72 * 1024
BUFFER = 1 << 20
"""Bytes that were sent and are not acknowledged, or wait to be sent."""
SEGMENTS = 1024
RESERVED_SEGMENTS = 16
"""Segments that a session may keep before their turn though all sessions together keep as many as they may."""
ACK_DELAY = 0.02  # s
ACK_EVERY = 8
"""Packets after which the receiver answers without waiting for ACK_DELAY."""
PROBES = 2
OUTAGE = 3
"""Unanswered probe timeouts after which the congestion window starts again (RFC 9002, 7.6)."""
LENGTH_SIZE = 4
NEVER = float("inf")


class Flight(NamedTuple):
    """A packet without an acknowledgement. segment: the index of what it carries, or -1: a probe."""

    at: float
    size: int
    segment: int


class Sending:
    """The sending half. rtt: what the handshake measured; counts: of the endpoint."""

    def __init__(self, now: float, rtt: float | None, counts: Counter[str]) -> None:
        self.packets = 0
        """How many were sent, which is the next one's number."""
        self._counts = counts
        self._round_trip, self._window = RoundTrip(rtt), Window(now)
        self._unsent = bytearray()
        self._segments: dict[int, bytes] = {}  # by index: sent and not acknowledged
        self._carrier: dict[int, int] = {}  # segment -> number of the packet that carried it last
        self._again: list[int] = []  # a heap of lost segments
        self._next = self._below = 0  # the next new segment; all below are acknowledged
        self._flights: dict[int, Flight] = {}  # by number, rising
        self._flying = 0  # bytes
        self._largest = -1
        self._probes = 0  # packets that go although window or pacing say no
        self._unanswered = 0  # probe timeouts in a row
        self._base = now  # the probe timeout counts from here

    def room(self) -> int:
        """The longest message that `write` takes now."""
        kept = len(self._unsent) + len(self._segments) * wire.SEGMENT_SIZE
        return max(0, min(MAX_MESSAGE, BUFFER - kept - LENGTH_SIZE))

    def write(self, message: bytes) -> None:
        self._unsent += len(message).to_bytes(LENGTH_SIZE, "big") + message

    def probe(self) -> None:
        """Ask for an answer at once, though there may be nothing to send."""
        self._probes = max(self._probes, 1)

    @property
    def oldest(self) -> float:
        """When the oldest packet was sent that may still be acknowledged; NEVER if there is none."""
        return next(iter(self._flights.values())).at if self._flights else NEVER

    @property
    def pto(self) -> float:
        """Seconds after which an acknowledgement should have come."""
        return self._round_trip.pto(ACK_DELAY)

    def acknowledged(self, answer: Answer, now: float) -> None:
        """Take what an answer says of packets and segments."""
        if answer.largest >= self.packets or answer.next_segment > self._next:
            raise Malformed("an acknowledgement of what was not sent")
        self._largest = max(self._largest, answer.largest)
        for index in range(self._below, answer.next_segment):
            self._forget(index)
        self._below = max(self._below, answer.next_segment)
        taken = list[int]()
        for number in self._flights:
            if number > answer.largest:
                break
            if answer.bits >> answer.largest - number & 1:
                taken.append(number)
        size, rtt = 0, None
        for number in taken:
            flight = self._flights.pop(number)
            size += flight.size
            self._forget(flight.segment)
            if number == answer.largest:
                rtt = now - flight.at
                self._round_trip.update(rtt)
        if taken:
            self._flying -= size
            self._window.acknowledged(size, rtt, answer.largest, self.packets, now)
            self._probes, self._unanswered, self._base = 0, 0, now
        self._find_lost(now)

    def _forget(self, index: int) -> None:
        self._segments.pop(index, None)
        self._carrier.pop(index, None)

    def _find_lost(self, now: float) -> None:
        delay, lost = self._round_trip.loss_delay(), list[int]()
        for number, flight in self._flights.items():
            if number > self._largest or flight.at + delay > now:
                break
            lost.append(number)
        for number in lost:
            flight = self._flights.pop(number)
            self._flying -= flight.size
            if self._carrier.get(flight.segment) == number:  # no other packet has taken it since
                heappush(self._again, flight.segment)
        self._counts["packets_lost"] += len(lost)

    def _waits(self) -> bool:
        """There is a segment to send."""
        while self._again and self._again[0] not in self._segments:
            heappop(self._again)
        return bool(self._again) or (bool(self._unsent) and self._next < self._below + SEGMENTS)

    def next(self, now: float) -> tuple[int, bytes] | None:
        """Number and frame of the next packet that may go now."""
        if self._probes:
            self._probes -= 1
        elif not self._waits():
            return None
        elif self._flying + wire.DATAGRAM_SIZE > self._window.size:
            self._window.limited = True
            return None
        elif self._window.wait(now, self._round_trip.smoothed):
            return None
        index, frame = -1, wire.PROBE
        if self._waits():
            if self._again:
                index = heappop(self._again)
                self._counts["retransmitted"] += 1
            else:
                index = self._next
                self._segments[index] = bytes(self._unsent[: wire.SEGMENT_SIZE])
                del self._unsent[: wire.SEGMENT_SIZE]
                self._next += 1
            frame = wire.SEGMENT_HEADER.pack(Frame.SEGMENT, index) + self._segments[index]
        number, size = self.take_number(), wire.DATA_OVERHEAD + len(frame)
        if index >= 0:
            self._carrier[index] = number
        self._flights[number] = Flight(now, size, index)
        self._flying += size
        self._window.sent(size)
        self._base = now
        return number, frame

    def take_number(self) -> int:
        """The number of a packet that is sent now."""
        self.packets += 1
        return self.packets - 1

    def _probe_at(self) -> float:
        return self._base + self._round_trip.pto(ACK_DELAY, self._unanswered) if self._flights else NEVER

    def _lost_at(self) -> float:
        """When the oldest packet below the largest acknowledged one counts as lost."""
        for number, flight in self._flights.items():
            return flight.at + self._round_trip.loss_delay() if number < self._largest else NEVER
        return NEVER

    def timer(self, now: float) -> float:
        """When `handle_timer` or `next` has something to do, if nothing arrives before."""
        if self._probes:
            return now
        when = min(self._probe_at(), self._lost_at())
        if self._waits() and self._flying + wire.DATAGRAM_SIZE <= self._window.size:
            when = min(when, now + self._window.wait(now, self._round_trip.smoothed))
        return when

    def handle_timer(self, now: float) -> None:
        if now >= self._lost_at():
            self._find_lost(now)
        if now >= self._probe_at():
            self._unanswered += 1
            self._base, self._probes = now, PROBES
            if self._unanswered == OUTAGE:
                self._window.collapse()
            for index in islice(cycle(self._segments), PROBES):
                heappush(self._again, index)


class Receiving:
    """The receiving half. counts["early"]: segments that all sessions of a process keep before their turn, of which
    there may be `limit`."""

    def __init__(self, counts: Counter[str], limit: int) -> None:
        self.next = 0
        """The first segment that is missing."""
        self._counts, self._limit = counts, limit
        self._early: dict[int, bytes] = {}
        self._arrived = bytearray()  # the stream, from the beginning of the message that is not whole yet

    def take(self, index: int, data: bytes) -> list[bytes]:
        """The messages that a segment makes whole. Refused where there is no room for one that comes too early."""
        if index >= self.next + SEGMENTS:
            raise Malformed("a segment beyond the limit")
        if index < self.next or index in self._early:
            self._counts["duplicates"] += 1
            return []
        if index > self.next and len(self._early) >= RESERVED_SEGMENTS and self._counts["early"] >= self._limit:
            raise Refused(Drop.FULL)
        self._early[index] = data
        self._counts["early"] += 1
        while (more := self._early.pop(self.next, None)) is not None:
            self._arrived += more
            self.next += 1
            self._counts["early"] -= 1
        return self._cut()

    def _cut(self) -> list[bytes]:
        messages, start, end = list[bytes](), 0, len(self._arrived)
        while end - start >= LENGTH_SIZE:
            begin = start + LENGTH_SIZE
            length = int.from_bytes(self._arrived[start:begin], "big")
            if length > MAX_MESSAGE:
                raise Malformed("a message too long")
            if begin + length > end:
                break
            start = begin + length
            messages.append(bytes(self._arrived[begin:start]))
        del self._arrived[:start]
        return messages

    def release(self) -> None:
        """Give back what this session had of the process's room."""
        self._counts["early"] -= len(self._early)
        self._early.clear()
