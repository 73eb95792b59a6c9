"""One session after its handshake: sealed packets, and an ordered stream of messages each way.

A message stands in the stream behind its length (4 bytes); the stream is cut into segments, counted from 0, when they
are first sent, and a segment that is lost is sent again as it was, in a new packet. The receiver tells which packets
came, which segment is next in order, and up to where it has room. Bytes and `now` in, datagrams out.

A frame that does not exist or is malformed, in a packet that was authenticated, is the peer's breach of the protocol
and ends the session. What came in is left in plain attributes for the endpoint to collect.
"""

from __future__ import annotations

from collections.abc import Callable
from heapq import heappop, heappush
from typing import NamedTuple

from rosbridge_eth.channel import wire
from rosbridge_eth.channel.delivery import RoundTrip, Window
from rosbridge_eth.channel.events import ChannelConfig, Counters, Drop, End, Full
from rosbridge_eth.channel.protection import Direction, ReplayWindow
from rosbridge_eth.channel.wire import Ack, Malformed
from smcrypto import InvalidTag

RECEIVE_SEGMENTS = 1024
"""Segments from the next one on that a receiver has room for."""
RESERVED_SEGMENTS = 16
"""Of them, those that a session may keep before their turn though the process' budget is used up."""
LENGTH_SIZE = 4
KEEPING = 64
"""Bytes that a message or segment is taken to cost beside its own."""
PERSISTENT_OUTAGE = 3
"""Unanswered probe timeouts after which the congestion window begins anew (RFC 9002, 7.6)."""
PROBES = 2
PING = bytes((wire.Frame.PING,))
NEVER = float("inf")
CLOSE_CODES = (End.CLOSED, End.PROTOCOL, End.REPLACED, End.REVOKED, End.EXPIRED, End.SILENT)


class Budget:
    """Bytes held for all sessions of a process. Above the limit, little is taken that does not come in order."""

    __slots__ = ("limit", "used")

    def __init__(self, limit: int) -> None:
        self.limit = limit
        self.used = 0


class SentPacket(NamedTuple):
    """A packet that asked for an acknowledgement and has none yet. segment: the one it carried, or None."""

    at: float
    size: int
    segment: int | None


class Segment:
    """A segment that was sent and is not acknowledged. packet: the number that carried it last; None: to be sent."""

    __slots__ = ("data", "packet")

    def __init__(self, data: bytes) -> None:
        self.data = data
        self.packet: int | None = None


class Session:
    """`receive`, `next_datagram`, `timer`, `handle_timer`; then look at `messages` and `ended`.

    cid: the peer's connection id. expires: when the session ends at the latest. admit: judges the frames of every
    packet until one is good; what comes before is dropped, and leaves no trace.
    """

    def __init__(
        self, config: ChannelConfig, counters: Counters, cid: bytes, send_secret: bytes, receive_secret: bytes, *,
        now: float, rtt: float | None, expires: float, budget: Budget, admit: Callable[[bytes], bool] | None = None,
    ) -> None:  # fmt: skip
        self.config = config
        self.cid = cid
        self.expires = expires
        self.messages: list[bytes] = []
        self.ended: End | None = None
        self.newest = False
        """The packet received last has the highest number so far."""
        self.last_received = now
        self.waiting_since = NEVER
        """Since when there has been something without an acknowledgement."""
        self.next_number = 0
        self.largest_acked = -1
        self._count, self._drop = counters.count, counters.drop
        self._admit = admit
        self._out, self._in = Direction(send_secret), Direction(receive_secret)
        # Receiving
        self._replay = ReplayWindow()
        self._largest_at = now
        self._pending = 0  # packets that asked for an acknowledgement and got none
        self._ack_due = NEVER
        self._next_in = 0
        self._early: dict[int, bytes] = {}
        self._early_size = 0
        self._arrived = bytearray()  # the stream, from the beginning of the message that is not whole yet
        self._untaken = 0
        self._limit_in = self._told_limit = RECEIVE_SEGMENTS
        self._budget = budget
        self._held = 0
        # Sending
        self._unsent = bytearray()
        self._unacked: dict[int, Segment] = {}
        self._again: list[int] = []  # a heap: what is lost
        self._next_out = 0
        self._all_acked_below = 0
        self._limit_out = RECEIVE_SEGMENTS
        self._buffered = 0
        self._in_flight: dict[int, SentPacket] = {}  # by number, rising
        self._in_flight_size = 0
        self._round_trip = RoundTrip(rtt)
        self._window = Window(now, config.max_window)
        self._ping = False
        self._probes = self._pto_count = 0
        self._pto_base = now

    # Receiving

    def receive(self, datagram: bytes, now: float) -> bool:
        """Take a DATA datagram; False if it was dropped: then nothing but counters has changed."""
        number = int.from_bytes(datagram[9:wire.DATA_HEADER_SIZE], "big")
        if self._replay.seen(number):
            self._drop(Drop.REPLAYED)
            return False
        try:
            frames = self._in.open(datagram, number)
        except InvalidTag:
            self._drop(Drop.TAG)
            return False
        if self._admit is not None:
            if not self._admit(frames):
                return False
            self._admit = None
        self.last_received = now
        try:
            asks = self._take_frames(frames, now)
        except Malformed:
            asks = False
            self.end(End.PROTOCOL)
        if asks is None:
            self._drop(Drop.FULL)  # not marked, so not acknowledged: the peer sends it again when there may be room
            self.newest = False
            return True
        highest = self._replay.highest
        self.newest = number > highest
        if self.newest:
            self._largest_at = now
        self._replay.mark(number)
        if asks:
            self._pending += 1
            if number != highest + 1 or self._pending >= self.config.ack_every:
                self._ack_due = now
            else:
                self._ack_due = min(self._ack_due, now + self.config.max_ack_delay)
        if number >= self.config.session_packets:
            self.end(End.EXPIRED)
        return True

    def _take_frames(self, frames: bytes, now: float) -> bool | None:
        """Whether the packet asks for an acknowledgement; None if there is no room for what it carries."""
        asks = False
        position, end = 0, len(frames)
        while position < end:
            kind = frames[position]
            if kind == wire.Frame.SEGMENT:
                start = position + wire.SEGMENT_HEADER.size
                if start >= end:
                    raise Malformed("an empty segment")
                _, index = wire.SEGMENT_HEADER.unpack_from(frames, position)
                return True if self._take_segment(index, frames[start:]) else None
            if kind == wire.Frame.ACK:
                ack, position = Ack.parse(frames, position)
                self._on_ack(ack, now)
            elif kind == wire.Frame.PING:
                asks = True
                position += 1
            elif kind == wire.Frame.CLOSE and position + 2 == end and frames[position + 1] < len(CLOSE_CODES):
                reason = CLOSE_CODES[frames[position + 1]]
                self.end(End.CLOSED_BY_PEER if reason is End.CLOSED else reason)
                return False
            else:
                raise Malformed(f"frame {kind} does not exist, or does not stand here")
        return asks

    def _take_segment(self, index: int, data: bytes) -> bool:
        """Keep or deliver it; False if there is no room for one that comes too early."""
        if index >= self._limit_in:
            raise Malformed("a segment beyond the limit")
        if index < self._next_in or index in self._early:
            self._count["duplicates"] += 1
            return True
        if index > self._next_in:
            size = len(data) + KEEPING
            if len(self._early) >= RESERVED_SEGMENTS and self._budget.used + size > self._budget.limit:
                return False
            self._early[index] = data
            self._early_size += size
        else:
            arrived = self._arrived
            arrived += data
            self._next_in += 1
            while (more := self._early.pop(self._next_in, None)) is not None:
                arrived += more
                self._early_size -= len(more) + KEEPING
                self._next_in += 1
            self._cut_messages()
        self._account()
        return True

    def _cut_messages(self) -> None:
        arrived = self._arrived
        start, end = 0, len(arrived)
        while end - start >= LENGTH_SIZE:
            stop = start + LENGTH_SIZE + int.from_bytes(arrived[start : start + LENGTH_SIZE], "big")
            if stop - start - LENGTH_SIZE > self.config.max_message:
                raise Malformed("a message too long")
            if stop > end:
                break
            self.messages.append(bytes(arrived[start + LENGTH_SIZE : stop]))
            self._untaken += stop - start + KEEPING
            start = stop
        del arrived[:start]

    def taken(self, payload: bytes) -> None:
        """The program has taken a message: there is room for so much more."""
        self._untaken -= LENGTH_SIZE + len(payload) + KEEPING
        self._account()
        if self._limit_in - self._told_limit >= RECEIVE_SEGMENTS // 4:
            self._pending += 1
            self._ack_due = 0.0

    def _account(self) -> None:
        held = len(self._arrived) + self._early_size + self._untaken
        self._budget.used += held - self._held
        self._held = held
        self._limit_in = max(self._limit_in, self._next_in + RECEIVE_SEGMENTS - self._untaken // wire.SEGMENT_SIZE)

    def release(self) -> None:
        """Give back what this session held of the process's budget."""
        self._budget.used -= self._held
        self._held = 0

    def end(self, reason: End) -> None:
        if self.ended is None:
            self.ended = reason

    def _on_ack(self, ack: Ack, now: float) -> None:
        if ack.largest >= self.next_number or ack.next_segment > self._next_out:
            raise Malformed("an acknowledgement of what was not sent")
        self.largest_acked = max(self.largest_acked, ack.largest)
        self._limit_out = max(self._limit_out, ack.limit)
        flying, largest, bits = self._in_flight, ack.largest, ack.bits
        taken: list[int] = []
        for number in flying:
            if number > largest:
                break
            if bits >> largest - number & 1:
                taken.append(number)
        for index in range(self._all_acked_below, ack.next_segment):
            self._delivered(index)
        self._all_acked_below = max(self._all_acked_below, ack.next_segment)
        if taken:
            size, rtt = 0, None
            for number in taken:
                packet = flying.pop(number)
                size += packet.size
                if number == largest:
                    rtt = now - packet.at
                    self._round_trip.update(rtt, min(ack.delay, self.config.max_ack_delay))
                if packet.segment is not None:
                    self._delivered(packet.segment)
            self._in_flight_size -= size
            self._window.acknowledged(size, rtt, largest, self.next_number, now)
            self._pto_count = self._probes = 0
            self._pto_base = now
            if not flying:
                self.waiting_since = NEVER
        self._find_lost(now)

    def _delivered(self, index: int) -> None:
        segment = self._unacked.pop(index, None)
        if segment is not None:
            self._buffered -= len(segment.data)

    def _find_lost(self, now: float) -> None:
        flying = self._in_flight
        delay = self._round_trip.loss_delay()
        lost: list[int] = []
        for number, packet in flying.items():
            if number > self.largest_acked or packet.at + delay > now:
                break
            lost.append(number)
        for number in lost:
            packet = flying.pop(number)
            self._in_flight_size -= packet.size
            self._send_again(number, packet)
        self._count["packets_lost"] += len(lost)

    def _send_again(self, number: int, packet: SentPacket) -> None:
        """Queue what `packet` carried once more, unless another packet has taken it since."""
        segment = None if packet.segment is None else self._unacked.get(packet.segment)
        if packet.segment is not None and segment is not None and segment.packet == number:
            segment.packet = None
            heappush(self._again, packet.segment)

    # Sending

    def has_room(self, size: int) -> bool:
        return self._buffered + LENGTH_SIZE + size <= self.config.max_buffered

    def send(self, payload: bytes) -> None:
        """Put a message into the stream. ValueError if it is too long, Full if `has_room` says no."""
        if len(payload) > self.config.max_message:
            raise ValueError(f"a message is at most {self.config.max_message} bytes, not {len(payload)}")
        if not self.has_room(len(payload)):
            raise Full("no room for another message until some of what was sent is acknowledged")
        self._unsent += len(payload).to_bytes(LENGTH_SIZE, "big")
        self._unsent += payload
        self._buffered += LENGTH_SIZE + len(payload)

    def ping(self) -> None:
        """Ask for an acknowledgement, though there may be nothing to say."""
        self._ping = True

    @property
    def idle(self) -> bool:
        """Nothing was sent that is not acknowledged."""
        return not self._in_flight

    def _has_new(self) -> bool:
        return bool(self._unsent) and self._next_out < self._limit_out

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
                sends = self._window.wait(now, self._round_trip.smoothed) == 0
        if not sends and self._ack_due > now:
            return None
        frames, index = b"", None
        if sends:
            index, frames = self._next_segment()
        if self._pending and len(frames) <= wire.DATAGRAM_SIZE - wire.DATA_OVERHEAD - wire.MAX_ACK_SIZE:
            frames = self._ack(now) + frames
        if sends:
            self._in_flight_add(len(frames), index, now)
        return self._seal(frames)

    def challenge(self, now: float) -> bytes:
        """A packet as short as can be that asks for an acknowledgement, which only who receives it can give."""
        self._in_flight_add(len(PING), None, now)
        return self._seal(PING)

    def _in_flight_add(self, size: int, index: int | None, now: float) -> None:
        size += wire.DATA_OVERHEAD
        if not self._in_flight:
            self.waiting_since = now
        self._in_flight[self.next_number] = SentPacket(now, size, index)
        self._in_flight_size += size
        self._window.sent(size)
        self._pto_base = now

    def _next_segment(self) -> tuple[int | None, bytes]:
        """The segment to send and its frame; a PING if there is none."""
        probing = self._probes > 0
        self._probes = max(0, self._probes - 1)
        self._ping = False
        if self._wants_to_send() and self._again:
            index = heappop(self._again)
            segment = self._unacked[index]
            self._count["retransmitted"] += 1
        elif self._has_new():
            index = self._next_out
            segment = self._unacked[index] = Segment(bytes(self._unsent[:wire.SEGMENT_SIZE]))
            del self._unsent[:wire.SEGMENT_SIZE]
            self._next_out += 1
        elif probing and self._unacked:
            index, segment = next(iter(self._unacked.items()))
            self._count["retransmitted"] += 1
        else:
            return None, PING
        segment.packet = self.next_number
        return index, wire.SEGMENT_HEADER.pack(wire.Frame.SEGMENT, index) + segment.data

    def _ack(self, now: float) -> bytes:
        self._pending = 0
        self._ack_due = NEVER
        self._told_limit = self._limit_in
        replay = self._replay
        return Ack(replay.highest, now - self._largest_at, self._next_in, self._limit_in, replay.bits).to_bytes()

    def _seal(self, frames: bytes) -> bytes:
        number = self.next_number
        self.next_number += 1
        if self.next_number >= self.config.session_packets:
            self.end(End.EXPIRED)
        return self._out.seal(self.cid, number, frames)

    def close_datagram(self, reason: End) -> bytes:
        """A packet that tells the peer that this session ends."""
        return self._seal(bytes((wire.Frame.CLOSE, CLOSE_CODES.index(reason) if reason in CLOSE_CODES else 0)))

    # Time

    def measured(self, rtt: float) -> None:
        """A round trip that the handshake took."""
        self._round_trip.update(rtt, 0.0)

    @property
    def pto(self) -> float:
        """Seconds after which an acknowledgement should have come."""
        return self._round_trip.pto(self.config.max_ack_delay)

    def _probe_at(self) -> float:
        """When to probe, because nothing is acknowledged, or because there is no room at the peer."""
        blocked = self._unsent and self._next_out >= self._limit_out
        if not self._in_flight and not blocked:
            return NEVER
        return self._pto_base + self._round_trip.pto(self.config.max_ack_delay, self._pto_count)

    def _lost_at(self) -> float:
        """When the oldest packet below the largest acknowledged one counts as lost."""
        for number, packet in self._in_flight.items():
            return packet.at + self._round_trip.loss_delay() if number < self.largest_acked else NEVER
        return NEVER

    def timer(self, now: float) -> float:
        """When `handle_timer` or `next_datagram` has something to do, if nothing arrives before."""
        when = min(self.expires, self._ack_due, self._probe_at(), self._lost_at())
        if self._wants_to_send() and self._in_flight_size + wire.DATAGRAM_SIZE <= self._window.size:
            when = min(when, now + self._window.wait(now, self._round_trip.smoothed))
        return when

    def handle_timer(self, now: float) -> None:
        if now >= self.expires:
            self.end(End.EXPIRED)
            return
        if now >= self._lost_at():
            self._find_lost(now)
        if now >= self._probe_at():
            self._pto_count += 1
            self._pto_base = now
            self._probes = PROBES
            if self._pto_count == PERSISTENT_OUTAGE:
                self._window.collapse()
            for (number, packet), _ in zip(self._in_flight.items(), range(PROBES), strict=False):
                self._send_again(number, packet)
