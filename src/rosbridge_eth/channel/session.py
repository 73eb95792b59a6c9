"""One session after its handshake: sealed packets, and an ordered stream of messages each way.

A message stands in the stream behind its length (4 bytes); the stream is cut into segments, counted from 0, when they
are first sent, and a segment that is lost is sent again as it was, in a new packet. The receiver tells which packets
came and which segment is next in order; it has room for RECEIVE_SEGMENTS from that one on. Bytes and `now` in,
datagrams out.

A frame that does not exist or is malformed, in a packet that was authenticated, is the peer's breach of the protocol
and ends the session. What came in is left in plain attributes for the endpoint to collect.
"""

from __future__ import annotations

from collections import Counter
from heapq import heappop, heappush
from itertools import cycle, islice
from typing import NamedTuple

from rosbridge_eth.channel import wire
from rosbridge_eth.channel.delivery import RoundTrip, Window
from rosbridge_eth.channel.events import Drop, End, Full
from rosbridge_eth.channel.protection import Direction, ReplayWindow
from rosbridge_eth.channel.wire import Ack, Malformed
from rosbridge_eth.identity import PeerIdentity
from smcrypto import InvalidTag

MAX_MESSAGE = 72 * 1024
MAX_BUFFERED = 1 << 20
"""Bytes of one session that were sent and are not acknowledged, or wait to be sent."""
SESSION_PACKETS = 1 << 20
"""A session ends when so many packets were sent in a direction."""
RECEIVE_SEGMENTS = 1024
RESERVED_SEGMENTS = 16
"""Segments that a session may keep before their turn though all sessions together keep as many as they may."""
MAX_ACK_DELAY = 0.02  # s
ACK_EVERY = 8
"""Packets after which an acknowledgement is sent without waiting for MAX_ACK_DELAY."""
PERSISTENT_OUTAGE = 3
"""Unanswered probe timeouts after which the congestion window begins anew (RFC 9002, 7.6)."""
PROBES = 2
LENGTH_SIZE = 4
PING = bytes((wire.Frame.PING,))
NEVER = float("inf")
CLOSE_CODES = (End.CLOSED, End.PROTOCOL, End.REPLACED, End.REVOKED, End.EXPIRED, End.SILENT)


class Early:
    """How many segments all sessions of a process keep before their turn, and how many they may."""

    __slots__ = ("kept", "limit")

    def __init__(self, limit: int) -> None:
        self.limit = limit
        self.kept = 0


class SentPacket(NamedTuple):
    """A packet that asked for an acknowledgement and has none yet. segment: the one it carried, or -1."""

    at: float
    size: int
    segment: int


class Segment:
    """A segment that was sent and is not acknowledged. packet: the number that carried it last; None: to be sent."""

    __slots__ = ("data", "packet")

    def __init__(self, data: bytes) -> None:
        self.data = data
        self.packet: int | None = None


class Session:
    """`receive`, `next_datagram`, `timer`, `handle_timer`; then look at `messages` and `ended`.

    cid: the peer's connection id. expires: when the session ends at the latest. counts: of the endpoint.
    """

    def __init__(
        self, peer: PeerIdentity, cid: bytes, send_secret: bytes, receive_secret: bytes, *, now: float,
        rtt: float | None, expires: float, early: Early, counts: Counter[str],
    ) -> None:  # fmt: skip
        self.peer = peer
        self.cid = cid
        self.expires = expires
        self.messages: list[bytes] = []
        self.ended: End | None = None
        self.newest = False
        """The packet received last has the highest number so far."""
        self.last_received = now
        self.next_number = 0
        self.largest_acked = -1
        self.round_trip = RoundTrip(rtt)
        self._counts = counts
        self._out, self._in = Direction(send_secret), Direction(receive_secret)
        # Receiving
        self._replay = ReplayWindow()
        self._pending = 0  # packets that asked for an acknowledgement and got none
        self._ack_due = NEVER
        self._next_in = 0
        self._all_early = early
        self._early: dict[int, bytes] = {}
        self._arrived = bytearray()  # the stream, from the beginning of the message that is not whole yet
        # Sending
        self._unsent = bytearray()
        self._unacked: dict[int, Segment] = {}  # by index, rising
        self._again: list[int] = []  # a heap: what is lost
        self._next_out = 0
        self._all_acked_below = 0
        self._in_flight: dict[int, SentPacket] = {}  # by number, rising
        self._in_flight_size = 0
        self._window = Window(now)
        self._ping = False
        self._probes = self._pto_count = 0
        self._pto_base = now

    # Receiving

    def receive(self, datagram: bytes, now: float) -> bool:
        """Take a DATA datagram; False if it was dropped: then nothing but counters has changed."""
        number = int.from_bytes(datagram[9:wire.DATA_HEADER_SIZE], "big")
        if self._replay.seen(number):
            self._counts[Drop.REPLAYED] += 1
            return False
        try:
            frames = self._in.open(datagram, number)
        except InvalidTag:
            self._counts[Drop.TAG] += 1
            return False
        self.last_received = now
        try:
            asks = self._take_frames(frames, now)
        except Malformed:
            asks = False
            self.end(End.PROTOCOL)
        if asks is None:
            self._counts[Drop.FULL] += 1  # not marked, so not acknowledged: it comes again when there may be room
            self.newest = False
            return True
        highest = self._replay.highest
        self.newest = number > highest
        self._replay.mark(number)
        if asks:
            self._pending += 1
            at_once = number != highest + 1 or self._pending >= ACK_EVERY
            self._ack_due = now if at_once else min(self._ack_due, now + MAX_ACK_DELAY)
        if number >= SESSION_PACKETS:
            self.end(End.EXPIRED)
        return True

    def _take_frames(self, frames: bytes, now: float) -> bool | None:
        """Whether the packet asks for an acknowledgement; None if there is no room for what it carries."""
        if frames[0] == wire.Frame.ACK:
            ack, frames = Ack.parse(frames)
            self._on_ack(ack, now)
            if not frames:
                return False
        kind, rest = frames[0], frames[1:]
        if kind == wire.Frame.SEGMENT and len(rest) > 4:
            return True if self._take_segment(int.from_bytes(rest[:4], "big"), rest[4:]) else None
        if kind == wire.Frame.PING and not rest:
            return True
        if kind == wire.Frame.CLOSE and len(rest) == 1 and rest[0] < len(CLOSE_CODES):
            reason = CLOSE_CODES[rest[0]]
            self.end(End.CLOSED_BY_PEER if reason is End.CLOSED else reason)
            return False
        raise Malformed(f"frame {kind} does not exist, or not with {len(rest)} bytes behind it")

    def _take_segment(self, index: int, data: bytes) -> bool:
        """Keep or deliver it; False if there is no room for one that comes too early."""
        if index >= self._next_in + RECEIVE_SEGMENTS:
            raise Malformed("a segment beyond the limit")
        if index < self._next_in or index in self._early:
            self._counts["duplicates"] += 1
        elif index > self._next_in:
            if len(self._early) >= RESERVED_SEGMENTS and self._all_early.kept >= self._all_early.limit:
                return False
            self._early[index] = data
            self._all_early.kept += 1
        else:
            self._arrived += data
            self._next_in += 1
            while (more := self._early.pop(self._next_in, None)) is not None:
                self._arrived += more
                self._next_in += 1
                self._all_early.kept -= 1
            self._cut_messages()
        return True

    def _cut_messages(self) -> None:
        arrived = self._arrived
        start, end = 0, len(arrived)
        while end - start >= LENGTH_SIZE:
            begin = start + LENGTH_SIZE
            length = int.from_bytes(arrived[start:begin], "big")
            if length > MAX_MESSAGE:
                raise Malformed("a message too long")
            if begin + length > end:
                break
            start = begin + length
            self.messages.append(bytes(arrived[begin:start]))
        del arrived[:start]

    def release(self) -> None:
        """Give back what this session had of the process's room."""
        self._all_early.kept -= len(self._early)
        self._early.clear()

    def end(self, reason: End) -> None:
        if self.ended is None:
            self.ended = reason

    def _on_ack(self, ack: Ack, now: float) -> None:
        if ack.largest >= self.next_number or ack.next_segment > self._next_out:
            raise Malformed("an acknowledgement of what was not sent")
        self.largest_acked = max(self.largest_acked, ack.largest)
        flying, largest, bits = self._in_flight, ack.largest, ack.bits
        taken: list[int] = []
        for number in flying:
            if number > largest:
                break
            if bits >> largest - number & 1:
                taken.append(number)
        for index in range(self._all_acked_below, ack.next_segment):
            self._unacked.pop(index, None)
        self._all_acked_below = max(self._all_acked_below, ack.next_segment)
        if taken:
            size, rtt = 0, None
            for number in taken:
                packet = flying.pop(number)
                size += packet.size
                if number == largest:
                    rtt = now - packet.at
                    self.round_trip.update(rtt)
                self._unacked.pop(packet.segment, None)
            self._in_flight_size -= size
            self._window.acknowledged(size, rtt, largest, self.next_number, now)
            self._pto_count = self._probes = 0
            self._pto_base = now
        self._find_lost(now)

    def _find_lost(self, now: float) -> None:
        flying = self._in_flight
        delay = self.round_trip.loss_delay()
        lost: list[int] = []
        for number, packet in flying.items():
            if number > self.largest_acked or packet.at + delay > now:
                break
            lost.append(number)
        for number in lost:
            packet = flying.pop(number)
            self._in_flight_size -= packet.size
            segment = self._unacked.get(packet.segment)
            if segment is not None and segment.packet == number:  # no other packet has taken it since
                self._send_again(packet.segment, segment)
        self._counts["packets_lost"] += len(lost)

    def _send_again(self, index: int, segment: Segment) -> None:
        segment.packet = None
        heappush(self._again, index)

    # Sending

    def has_room(self, size: int) -> bool:
        waiting = len(self._unsent) + len(self._unacked) * wire.SEGMENT_SIZE
        return waiting + LENGTH_SIZE + size <= MAX_BUFFERED

    def send(self, payload: bytes) -> None:
        """Put a message into the stream. ValueError if it is too long, Full if `has_room` says no."""
        if len(payload) > MAX_MESSAGE:
            raise ValueError(f"a message is at most {MAX_MESSAGE} bytes, not {len(payload)}")
        if not self.has_room(len(payload)):
            raise Full("no room for another message until some of what was sent is acknowledged")
        self._unsent += len(payload).to_bytes(LENGTH_SIZE, "big") + payload

    def ping(self) -> None:
        """Ask for an acknowledgement, though there may be nothing to say."""
        self._ping = True

    @property
    def waiting_since(self) -> float:
        """When the oldest packet was sent that may still be acknowledged; NEVER if there is none."""
        return next(iter(self._in_flight.values())).at if self._in_flight else NEVER

    def _has_new(self) -> bool:
        return bool(self._unsent) and self._next_out < self._all_acked_below + RECEIVE_SEGMENTS

    def _wants_to_send(self) -> bool:
        while self._again and self._again[0] not in self._unacked:
            heappop(self._again)
        return self._ping or bool(self._again) or self._has_new()

    def next_datagram(self, now: float) -> bytes | None:
        """The next datagram that may go now, or None."""
        if self.ended is not None:
            return None
        sends = self._probes > 0
        if not sends and self._wants_to_send():
            if self._in_flight_size + wire.DATAGRAM_SIZE > self._window.size:
                self._window.limited = True
            else:
                sends = self._window.wait(now, self.round_trip.smoothed) == 0
        if not sends and self._ack_due > now:
            return None
        frames, index = b"", -1
        if sends:
            index, frames = self._next_segment()
        if self._pending and len(frames) <= wire.DATAGRAM_SIZE - wire.DATA_OVERHEAD - wire.MAX_ACK_SIZE:
            self._pending, self._ack_due = 0, NEVER
            frames = Ack(self._replay.highest, self._next_in, self._replay.bits).to_bytes() + frames
        if sends:
            self._in_flight_add(len(frames), index, now)
        return self._seal(frames)

    def challenge(self, now: float) -> bytes:
        """A packet as short as can be that asks for an acknowledgement, which only who receives it can give."""
        self._in_flight_add(len(PING), -1, now)
        return self._seal(PING)

    def _in_flight_add(self, size: int, index: int, now: float) -> None:
        size += wire.DATA_OVERHEAD
        self._in_flight[self.next_number] = SentPacket(now, size, index)
        self._in_flight_size += size
        self._window.sent(size)
        self._pto_base = now

    def _next_segment(self) -> tuple[int, bytes]:
        """The segment to send and its frame; a PING if there is none."""
        self._probes = max(0, self._probes - 1)
        self._ping = False
        if self._wants_to_send() and self._again:
            index = heappop(self._again)
            segment = self._unacked[index]
            self._counts["retransmitted"] += 1
        elif self._has_new():
            index = self._next_out
            segment = self._unacked[index] = Segment(bytes(self._unsent[:wire.SEGMENT_SIZE]))
            del self._unsent[:wire.SEGMENT_SIZE]
            self._next_out += 1
        else:
            return -1, PING
        segment.packet = self.next_number
        return index, wire.SEGMENT_HEADER.pack(wire.Frame.SEGMENT, index) + segment.data

    def _seal(self, frames: bytes) -> bytes:
        number = self.next_number
        self.next_number += 1
        if self.next_number >= SESSION_PACKETS:
            self.end(End.EXPIRED)
        return self._out.seal(self.cid, number, frames)

    def close_datagram(self, reason: End) -> bytes:
        """A packet that tells the peer that this session ends."""
        return self._seal(bytes((wire.Frame.CLOSE, CLOSE_CODES.index(reason))))

    # Time

    @property
    def pto(self) -> float:
        """Seconds after which an acknowledgement should have come."""
        return self.round_trip.pto(MAX_ACK_DELAY)

    def _probe_at(self) -> float:
        """When to probe, because nothing is acknowledged."""
        return self._pto_base + self.round_trip.pto(MAX_ACK_DELAY, self._pto_count) if self._in_flight else NEVER

    def _lost_at(self) -> float:
        """When the oldest packet below the largest acknowledged one counts as lost."""
        for number, packet in self._in_flight.items():
            return packet.at + self.round_trip.loss_delay() if number < self.largest_acked else NEVER
        return NEVER

    def timer(self, now: float) -> float:
        """When `handle_timer` or `next_datagram` has something to do, if nothing arrives before and it stays young."""
        when = min(self._ack_due, self._probe_at(), self._lost_at())
        if self._wants_to_send() and self._in_flight_size + wire.DATAGRAM_SIZE <= self._window.size:
            when = min(when, now + self._window.wait(now, self.round_trip.smoothed))
        return when

    def handle_timer(self, now: float) -> None:
        if now >= self.expires:
            self.end(End.EXPIRED)
        if now >= self._lost_at():
            self._find_lost(now)
        if now >= self._probe_at():
            self._pto_count += 1
            self._pto_base = now
            self._probes = PROBES
            if self._pto_count == PERSISTENT_OUTAGE:
                self._window.collapse()
            for index, segment in islice(cycle(self._unacked.items()), PROBES):
                self._send_again(index, segment)
