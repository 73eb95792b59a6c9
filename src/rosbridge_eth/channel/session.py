"""One session after its handshake: sealed packets, frames, delivery. Bytes and `now` in, datagrams out.

Both ends share packets, acknowledgements, loss recovery, epochs and timers
(`Session`). A client sends messages and takes answers (`ClientSession`); a
server takes messages and sends answers (`ServerSession`). Each has a table of
the frames it takes; any other frame, or a malformed one, in a packet that was
authenticated is the peer's breach of the protocol and ends the session.

What came in is left in plain attributes for the endpoint to collect.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from dataclasses import dataclass, field
from typing import ClassVar

from rosbridge_eth.channel.events import ChannelConfig, Counters, Drop, End, Full
from rosbridge_eth.channel.protection import Direction, ReplayWindow
from rosbridge_eth.channel.recovery import (
    Congestion,
    InFlight,
    Received,
    RoundTrip,
    SentPacket,
)
from rosbridge_eth.channel.wire import (
    ACCEPTED,
    DATA_OVERHEAD,
    DATAGRAM_SIZE,
    MAX_PACKET_NUMBER,
    PART,
    WHOLE,
    Frame,
    Malformed,
    ack_frame,
    parse_ack,
)
from smcrypto import InvalidTag

__all__ = ["Accepted", "Budget", "ClientSession", "Link", "ServerSession", "Session"]

ROOM = DATAGRAM_SIZE - DATA_OVERHEAD
WHOLE_LIMIT = ROOM - WHOLE.size
PART_SIZE = ROOM - PART.size
MIN_PART = 256
"""Bytes of a part that is not the last: no message comes in thousands of crumbs."""
PIECE_OVERHEAD = 64
"""What a part, or an id that is waiting, is taken to cost beside its bytes."""
PERSISTENT_OUTAGE = 3
"""Unanswered probes after which the congestion window begins anew (RFC 9002, 7.6)."""
PROBES = 2
KEY_LIMIT = 1 << 23
"""Packets under one key, after which the session ends (RFC 9001, 6.6: the limit of GCM with 128-bit keys)."""

CLOSE_CODES = {
    End.CLOSED: 0,
    End.PROTOCOL: 1,
    End.REPLACED: 2,
    End.REVOKED: 3,
    End.EXHAUSTED: 4,
    End.SILENT: 5,
}
CLOSE_MEANINGS = {
    0: End.CLOSED_BY_PEER,
    1: End.PROTOCOL,
    2: End.REPLACED,
    3: End.REVOKED,
    4: End.EXHAUSTED,
    5: End.SILENT,
}


@dataclass(frozen=True, slots=True)
class Link:
    """Where a session's packets go, and the first secrets of both directions, which are not shown."""

    remote_cid: bytes
    send_secret: bytes = field(repr=False)
    receive_secret: bytes = field(repr=False)


class Outgoing:
    """A frame to be sent until it is acknowledged. `number` is the packet that carried it last."""

    __slots__ = ("acked", "data", "ident", "kind", "number", "queued")

    def __init__(self, kind: Frame, ident: int, data: bytes) -> None:
        self.kind = kind
        self.ident = ident
        self.data = data
        self.number = -1
        self.acked = False
        self.queued = True


class Budget:
    """Bytes held for all sessions of a process."""

    __slots__ = ("limit", "used")

    def __init__(self, limit: int) -> None:
        self.limit = limit
        self.used = 0


@dataclass(frozen=True, slots=True)
class Accepted:
    """Contents of ACCEPTED; the reset token is not shown."""

    reset_token: bytes
    max_unanswered: int
    max_unanswered_bytes: int
    idle_timeout: float
    server_time_ms: int

    def __repr__(self) -> str:
        return f"Accepted(max_unanswered={self.max_unanswered}, server_time_ms={self.server_time_ms})"

    def frame(self) -> bytes:
        return ACCEPTED.pack(
            Frame.ACCEPTED,
            self.reset_token,
            self.max_unanswered,
            self.max_unanswered_bytes,
            int(self.idle_timeout),
            self.server_time_ms,
        )


class Parts:
    """A message or an answer that comes in parts."""

    __slots__ = ("_parts", "got", "total")

    def __init__(self, total: int) -> None:
        self.total = total
        self.got = 0
        self._parts: dict[int, bytes] = {}

    def __len__(self) -> int:
        return len(self._parts)

    def has(self, offset: int) -> bool:
        return offset in self._parts

    def add(self, offset: int, data: bytes) -> bytes | None:
        """The whole, once it is there. Malformed if parts overlap or a part is a crumb."""
        if offset + len(data) > self.total or not data:
            raise Malformed("a part outside its message")
        if len(data) < MIN_PART and offset + len(data) != self.total:
            raise Malformed("a part too small")
        self._parts[offset] = data
        self.got += len(data)
        if self.got < self.total:
            return None
        expected = 0
        for start in sorted(self._parts):
            if start != expected:
                raise Malformed("parts overlap")
            expected += len(self._parts[start])
        return b"".join(self._parts[start] for start in sorted(self._parts))


class Session:
    """What both ends do alike. `receive`, `next_datagram`, `timer`, `handle_timer`; then look at `ended`."""

    FRAMES: ClassVar[dict[int, Callable[..., int]]] = {}
    is_client: ClassVar[bool]

    def __init__(
        self,
        config: ChannelConfig,
        counters: Counters,
        link: Link,
        *,
        now: float,
        rtt: float | None,
    ) -> None:
        self.config = config
        self.remote_cid = link.remote_cid
        self.idle_timeout = config.idle_timeout
        self.established = False
        self.ended: End | None = None
        self.newest_packet = False  # the packet received last has the highest number so far
        self._count = counters.count
        self._drop = counters.drop
        self._out = Direction(link.send_secret)
        self._in: dict[int, Direction] = {0: Direction(link.receive_secret)}  # by the epoch's low four bits
        self._in_epoch = 0
        self._in_epoch_at = -1e9
        self._retire_at: float | None = None
        self._replay = ReplayWindow()
        self._next_number = 0
        self._epoch_began = now
        self._epoch_packets = 0
        self._update: Outgoing | None = None
        self._round_trip = RoundTrip(rtt)
        self._congestion = Congestion(now, config.max_window)
        self._in_flight: InFlight[Outgoing] = InFlight()
        self._received = Received()
        self._acks_sent: deque[tuple[int, int]] = deque(maxlen=64)  # (packet, largest number it acknowledged)
        self._control: deque[Outgoing] = deque()
        self._urgent: deque[Outgoing] = deque()
        self._bulk: deque[Outgoing] = deque()
        self._queues = (self._control, self._urgent, self._bulk)
        self._probes = 0
        self._pto_count = 0
        self._pto_base = now
        self._ping = False
        self._refused = False
        self._last_received = now
        self._last_sent = now
        self._waiting_since: float | None = None

    # Receiving

    def receive(self, datagram: bytes, now: float) -> bool:
        """Take a DATA datagram; False if it was dropped: then nothing but counters has changed."""
        number = int.from_bytes(datagram[9:15], "big")
        if self._replay.seen(number):
            self._drop(Drop.REPLAYED)
            return False
        keys = self._in.get(datagram[0] & 15)
        if keys is None:
            self._drop(Drop.EPOCH)
            return False
        try:
            frames = keys.open(datagram, number)
        except InvalidTag:
            self._drop(Drop.TAG)
            return False
        if not self._admit(frames):
            return False
        self.newest_packet = number > self._replay.highest
        self._replay.mark(number)
        self._last_received = now
        if self._retire_at is not None:
            self._retire(keys, now)
        self._refused = False
        eliciting = False
        position, end, table = 0, len(frames), self.FRAMES
        try:
            if not end:
                raise Malformed("a packet without a frame")
            while position < end:
                kind = frames[position]
                handler = table.get(kind)
                if handler is None:
                    raise Malformed(f"frame {kind} is not for this end")
                if kind != Frame.ACK and kind != Frame.CLOSE:
                    eliciting = True
                position = handler(self, frames, position, now)
            if position != end:
                raise Malformed("a frame goes on behind its packet")
        except Malformed:
            self.end(End.PROTOCOL)
            return True
        if self._refused:
            return True  # not acknowledged: the peer sends it again when there may be room
        received = self._received
        out_of_order = received.add(number, now)
        if eliciting:
            received.pending += 1
            if out_of_order or received.pending >= self.config.ack_every:
                received.due = now
            elif received.due is None:
                received.due = now + self.config.max_ack_delay
        return True

    def _admit(self, frames: bytes) -> bool:
        """Whether a packet may be taken at all; a server takes none before the handshake is finished."""
        return True

    def end(self, reason: End) -> None:
        if self.ended is None:
            self.ended = reason

    def _retire(self, keys: Direction, now: float) -> None:
        """Forget the epoch before the present one, some time after the present one was first used."""
        if self._retire_at is not None and keys.epoch == self._in_epoch and now >= self._retire_at:
            self._in = {self._in_epoch & 15: self._in[self._in_epoch & 15]}
            self._retire_at = None

    def _on_ping(self, frames: bytes, position: int, now: float) -> int:
        return position + 1

    def _on_ack(self, frames: bytes, position: int, now: float) -> int:
        ranges, delay, position = parse_ack(frames, position)
        largest = ranges[0][1]
        if largest >= self._next_number:
            raise Malformed("an acknowledgement of a packet that was not sent")
        taken = self._in_flight.acknowledge(ranges)
        if taken:
            for packet in taken:
                if packet.number == largest:
                    self._round_trip.update(now - packet.at, min(delay, self.config.max_ack_delay))
                self._congestion.acknowledged(packet.size, packet.at)
                for frame in packet.frames:
                    if not frame.acked:
                        frame.acked = True
                        self._acknowledged(frame, now)
                        frame.data = b""
            self._pto_count = 0
            self._probes = 0
            self._pto_base = now
            self._waiting_since = now
            acks = self._acks_sent
            forget = -1
            while acks and acks[0][0] <= largest:
                sent, upto = acks.popleft()
                if any(low <= sent <= high for low, high in ranges):
                    forget = upto
            if forget >= 0:
                self._received.forget_below(forget)
        self._find_lost(now)
        return position

    def _acknowledged(self, frame: Outgoing, now: float) -> None:
        if frame is self._update:
            self._update = None
            self._out = self._out.next_epoch()
            self._epoch_began = now
            self._epoch_packets = 0
            self._count["rekeys"] += 1

    def _find_lost(self, now: float) -> None:
        lost = self._in_flight.take_lost(now, self._round_trip.loss_delay())
        if lost:
            self._count["packets_lost"] += len(lost)
            self._congestion.lost(lost[-1].at, now)
            for packet in reversed(lost):
                self._again(packet, only_latest=True)

    def _again(self, packet: SentPacket[Outgoing], *, only_latest: bool) -> None:
        """Queue what `packet` carried once more, before everything else of its kind."""
        for frame in reversed(packet.frames):
            if frame.acked or frame.queued or (only_latest and frame.number != packet.number):
                continue
            queue = self._queue_of(frame)
            if queue is not None:
                frame.queued = True
                queue.appendleft(frame)
                self._count["frames_retransmitted"] += 1

    def _queue_of(self, frame: Outgoing) -> deque[Outgoing] | None:
        """The queue `frame` belongs to, or None if it needs not be sent any more."""
        return None if frame.kind is Frame.PATH_RESPONSE else self._control

    def _on_key_update(self, frames: bytes, position: int, now: float) -> int:
        stop = position + 5
        epoch = int.from_bytes(frames[position + 1 : stop], "big")
        if epoch == self._in_epoch + 1:
            if now - self._in_epoch_at < self.config.rekey_interval:
                self._refused = True  # a peer cannot make us derive keys all day
                return stop
            present = self._in[self._in_epoch & 15]
            following = present.next_epoch()
            self._in = {present.epoch & 15: present, following.epoch & 15: following}
            self._in_epoch = epoch
            self._in_epoch_at = now
            self._retire_at = now + 3 * self._round_trip.pto(self.config.max_ack_delay, 0)
        elif epoch > self._in_epoch:
            raise Malformed("an epoch was skipped")
        return stop

    def _on_close(self, frames: bytes, position: int, now: float) -> int:
        meaning = CLOSE_MEANINGS.get(frames[position + 1]) if position + 1 < len(frames) else None
        if meaning is None:
            raise Malformed("a CLOSE for no reason")
        self.end(meaning)
        return position + 2

    def _deliver_to_queue(
        self, queue: deque[Outgoing], kinds: tuple[Frame, Frame], ident: int, payload: bytes
    ) -> int:
        """Cut `payload` into frames and queue them; how many."""
        whole, part = kinds
        total = len(payload)
        if total <= WHOLE_LIMIT:
            queue.append(Outgoing(whole, ident, WHOLE.pack(whole, ident, total) + payload))
            return 1
        count = 0
        for offset in range(0, total, PART_SIZE):
            piece = payload[offset : offset + PART_SIZE]
            queue.append(
                Outgoing(part, ident, PART.pack(part, ident, total, offset, len(piece)) + piece)
            )
            count += 1
        return count

    # Sending

    def queue_control(self, kind: Frame, body: bytes) -> Outgoing:
        frame = Outgoing(kind, 0, bytes((kind,)) + body)
        self._control.append(frame)
        return frame

    def _wants_to_send(self) -> bool:
        return bool(self._control or self._urgent or self._bulk or self._ping)

    def next_datagram(self, now: float) -> bytes | None:
        """The next datagram that may go now, or None."""
        if self.ended is not None:
            return None
        received = self._received
        window_open = self._probes > 0 or (
            self._wants_to_send()
            and self._in_flight.bytes + DATAGRAM_SIZE <= self._congestion.window
            and self._congestion.wait(now, self._round_trip.smoothed) == 0
        )
        ack_due = received.due is not None and received.due <= now
        if not window_open and not ack_due:
            return None
        parts: list[bytes] = []
        size = 0
        if received.pending and received.ranges:
            ack = ack_frame(received.ranges, now - received.largest_at)
            parts.append(ack)
            size = len(ack)
        carried: list[Outgoing] = []
        if window_open:
            for queue in self._queues:
                while queue:
                    frame = queue[0]
                    if frame.acked or not self._relevant(frame):
                        queue.popleft()
                        frame.queued = False
                        continue
                    if size + len(frame.data) > ROOM:
                        break
                    queue.popleft()
                    frame.queued = False
                    frame.number = self._next_number
                    parts.append(frame.data)
                    size += len(frame.data)
                    carried.append(frame)
            if not carried and (self._ping or self._probes):
                parts.append(bytes((Frame.PING,)))
                size += 1
                self._in_flight_add((), size, now)
            elif carried:
                self._in_flight_add(tuple(carried), size, now)
            if carried or self._ping or self._probes:
                self._ping = False
                self._probes = max(0, self._probes - 1)
        if not parts:
            return None
        if received.pending and received.ranges:
            self._acks_sent.append((self._next_number, received.ranges[0][1]))
            received.pending = 0
            received.due = None
        return self._seal(b"".join(parts), now)

    def _relevant(self, frame: Outgoing) -> bool:
        return True

    def _in_flight_add(self, frames: tuple[Outgoing, ...], size: int, now: float) -> None:
        if not self._in_flight:
            self._waiting_since = now
        self._in_flight.add(SentPacket(self._next_number, now, size + DATA_OVERHEAD, frames))
        self._congestion.sent(size + DATA_OVERHEAD)
        self._pto_base = now

    def _seal(self, frames: bytes, now: float) -> bytes:
        number = self._next_number
        self._next_number += 1
        self._epoch_packets += 1
        self._last_sent = now
        if self._epoch_packets >= self.config.rekey_packets and self._update is None and self.established:
            self._rekey()
        if number >= MAX_PACKET_NUMBER or self._epoch_packets >= KEY_LIMIT:
            self.end(End.EXHAUSTED)
        return self._out.seal(self.remote_cid, number, frames)

    def _rekey(self) -> None:
        self._update = self.queue_control(Frame.KEY_UPDATE, (self._out.epoch + 1).to_bytes(4, "big"))

    def close_datagram(self, reason: End, now: float) -> bytes:
        """A packet that tells the peer that this session ends."""
        return self._seal(bytes((Frame.CLOSE, CLOSE_CODES.get(reason, 0))), now)

    def path_changed(self, now: float) -> None:
        """The peer is somewhere else: what was learnt of the path does not hold there (RFC 9000, 9.4).

        What is in flight went to the old address, and most likely to nobody: it is sent again at once.
        """
        for packet in reversed(self._in_flight.take_all()):
            self._again(packet, only_latest=True)
        self._round_trip = RoundTrip()
        self._congestion = Congestion(now, self.config.max_window)
        self._pto_count = 0

    def path_challenge(self, challenge: bytes, now: float) -> bytes:
        """A packet with eight bytes that only who receives it can send back."""
        return self._seal(bytes((Frame.PATH_CHALLENGE,)) + challenge, now)

    # Time

    def timer(self, now: float) -> float:
        """When `handle_timer` or `next_datagram` has something to do, if nothing arrives before."""
        times = [self._last_received + self.idle_timeout]
        if self._received.due is not None:
            times.append(self._received.due)
        if self._in_flight:
            times.append(self._pto_base + self._pto())
            loss = self._in_flight.loss_time(self._round_trip.loss_delay())
            if loss is not None:
                times.append(loss)
        if self._wants_to_send() and self._in_flight.bytes + DATAGRAM_SIZE <= self._congestion.window:
            times.append(now + self._congestion.wait(now, self._round_trip.smoothed))
        if self.established:
            times.append(self._epoch_began + self.config.rekey_seconds)
        return min(times)

    @property
    def probe_timeout(self) -> float:
        """Seconds after which an answer should have come."""
        return self._round_trip.pto(self.config.max_ack_delay, 0)

    def _pto(self) -> float:
        return self._round_trip.pto(self.config.max_ack_delay, self._pto_count)

    def handle_timer(self, now: float) -> None:
        if now >= self._last_received + self.idle_timeout:
            self.end(End.SILENT)
            return
        if self.established and self._update is None and now >= self._epoch_began + self.config.rekey_seconds:
            self._epoch_began = now  # again in as long, should this one not be acknowledged
            self._rekey()
        if not self._in_flight:
            return
        loss = self._in_flight.loss_time(self._round_trip.loss_delay())
        if loss is not None and now >= loss:
            self._find_lost(now)
        if self._in_flight and now >= self._pto_base + self._pto():
            self._pto_count += 1
            self._pto_base = now
            self._probes = PROBES
            if self._pto_count == PERSISTENT_OUTAGE:
                self._congestion.collapse(now)
            for packet, _ in zip(self._in_flight, range(PROBES), strict=False):
                self._again(packet, only_latest=False)


def _whole(frames: bytes, position: int) -> tuple[int, bytes, int]:
    """(id, payload, position behind) of a MESSAGE or ANSWER."""
    start = position + WHOLE.size
    if start > len(frames):
        raise Malformed("a frame ends early")
    _, ident, length = WHOLE.unpack_from(frames, position)
    stop = start + length
    if stop > len(frames):
        raise Malformed("a frame ends early")
    return ident, frames[start:stop], stop


def _part(frames: bytes, position: int) -> tuple[int, int, int, bytes, int]:
    """(id, total, offset, data, position behind) of a MESSAGE_PART or ANSWER_PART."""
    start = position + PART.size
    if start > len(frames):
        raise Malformed("a frame ends early")
    _, ident, total, offset, length = PART.unpack_from(frames, position)
    stop = start + length
    if stop > len(frames):
        raise Malformed("a frame ends early")
    return ident, total, offset, frames[start:stop], stop


class _Waiting:
    """A message of this client without an answer."""

    __slots__ = ("answer", "queue", "size")

    def __init__(self, size: int, queue: deque[Outgoing]) -> None:
        self.size = size
        self.queue = queue
        self.answer: Parts | None = None


class ClientSession(Session):
    """A client's end: `send`, then `answers`."""

    is_client = True

    def __init__(
        self,
        config: ChannelConfig,
        counters: Counters,
        link: Link,
        *,
        now: float,
        rtt: float | None,
    ) -> None:
        super().__init__(config, counters, link, now=now, rtt=rtt)
        self.accepted: Accepted | None = None
        self.answers: list[tuple[int, bytes]] = []
        self._waiting: dict[int, _Waiting] = {}
        self._waiting_bytes = 0
        self._answer_bytes = 0  # parts of answers that are not whole yet
        self._next_id = 0
        self._max_unanswered = config.max_unanswered
        self._max_bytes = config.max_unanswered_bytes

    @property
    def sent_messages(self) -> int:
        return self._next_id

    @property
    def unanswered(self) -> tuple[int, ...]:
        return tuple(self._waiting)

    def has_room(self, size: int) -> bool:
        first = next(iter(self._waiting), self._next_id)
        return (
            len(self._waiting) < self._max_unanswered
            and self._next_id - first < 2 * self._max_unanswered
            and self._waiting_bytes + size <= self._max_bytes
            and self._next_id <= 0xFFFFFFFF
        )

    def send(self, payload: bytes, priority: int) -> int:
        if not self.has_room(len(payload)):
            raise Full("no room for another message until some are answered")
        ident = self._next_id
        self._next_id += 1
        queue = self._bulk if priority else self._urgent
        self._waiting[ident] = _Waiting(len(payload), queue)
        self._waiting_bytes += len(payload)
        self._deliver_to_queue(queue, (Frame.MESSAGE, Frame.MESSAGE_PART), ident, payload)
        self._count["messages"] += 1
        return ident

    def _relevant(self, frame: Outgoing) -> bool:
        return frame.kind not in (Frame.MESSAGE, Frame.MESSAGE_PART) or frame.ident in self._waiting

    def _queue_of(self, frame: Outgoing) -> deque[Outgoing] | None:
        if frame.kind in (Frame.MESSAGE, Frame.MESSAGE_PART):
            waiting = self._waiting.get(frame.ident)
            return waiting.queue if waiting else None
        return super()._queue_of(frame)

    def _answered(self, ident: int, payload: bytes) -> None:
        waiting = self._waiting.pop(ident)
        self._waiting_bytes -= waiting.size
        self.answers.append((ident, payload))
        self._count["answers"] += 1

    def _on_answer(self, frames: bytes, position: int, now: float) -> int:
        ident, payload, stop = _whole(frames, position)
        if ident in self._waiting:
            self._answered(ident, payload)
        elif ident >= self._next_id:
            raise Malformed("an answer to a message that was not sent")
        else:
            self._count["duplicates"] += 1
        return stop

    def _on_answer_part(self, frames: bytes, position: int, now: float) -> int:
        ident, total, offset, data, stop = _part(frames, position)
        if ident >= self._next_id:
            raise Malformed("an answer to a message that was not sent")
        waiting = self._waiting.get(ident)
        if waiting is None:
            self._count["duplicates"] += 1
            return stop
        if waiting.answer is None:
            waiting.answer = Parts(total)
        parts = waiting.answer
        if parts.total != total or total > self.config.max_message:
            raise Malformed("an answer too long, or of two lengths")
        if parts.has(offset):
            self._count["duplicates"] += 1
            return stop
        if self._answer_bytes + len(data) > self._max_bytes:
            self._refused = True
            self._drop(Drop.FULL)
            return stop
        self._answer_bytes += len(data)
        payload = parts.add(offset, data)
        if payload is not None:
            self._answer_bytes -= total
            self._answered(ident, payload)
        return stop

    def _on_path_challenge(self, frames: bytes, position: int, now: float) -> int:
        stop = position + 9
        if len(self._control) < 16:
            self.queue_control(Frame.PATH_RESPONSE, frames[position + 1 : stop])
        return stop

    def _on_accepted(self, frames: bytes, position: int, now: float) -> int:
        stop = position + ACCEPTED.size
        if stop > len(frames):
            raise Malformed("a frame ends early")
        if self.accepted is None:
            _, token, messages, size, idle, milliseconds = ACCEPTED.unpack_from(frames, position)
            self.accepted = Accepted(token, messages, size, float(idle), milliseconds)
            self._max_unanswered = max(1, min(self._max_unanswered, messages))
            self._max_bytes = max(self.config.max_message, min(self._max_bytes, size))
            self.idle_timeout = min(self.idle_timeout, max(1.0, float(idle)))
            self.established = True
        return stop

    def timer(self, now: float) -> float:
        when = super().timer(now)
        if self.established:
            when = min(when, self._last_sent + self._keep_alive())
        if self._in_flight and self._waiting_since is not None:
            when = min(when, self._waiting_since + self.config.silence_timeout)
        return when

    def _keep_alive(self) -> float:
        return min(self.config.keep_alive, self.idle_timeout / 3)

    def handle_timer(self, now: float) -> None:
        if (
            self._in_flight
            and self._waiting_since is not None
            and now >= self._waiting_since + self.config.silence_timeout
        ):
            self.end(End.SILENT)
            return
        if self.established and now >= self._last_sent + self._keep_alive():
            self._ping = True
            self._last_sent = now
        super().handle_timer(now)

    FRAMES: ClassVar[dict[int, Callable[..., int]]] = {
        Frame.PING: Session._on_ping,
        Frame.ACK: Session._on_ack,
        Frame.ANSWER: _on_answer,
        Frame.ANSWER_PART: _on_answer_part,
        Frame.KEY_UPDATE: Session._on_key_update,
        Frame.PATH_CHALLENGE: _on_path_challenge,
        Frame.ACCEPTED: _on_accepted,
        Frame.CLOSE: Session._on_close,
    }


class _Incoming:
    """A message at a server: in parts, then waiting for its answer, then for the answer's acknowledgement."""

    __slots__ = ("held", "parts", "unacked")

    def __init__(self, parts: Parts | None) -> None:
        self.parts = parts
        self.unacked = -1  # frames of the answer without an acknowledgement; -1: not answered
        self.held = 0


class ServerSession(Session):
    """A server's end: `messages`, then `reply`."""

    is_client = False

    def __init__(
        self,
        config: ChannelConfig,
        counters: Counters,
        link: Link,
        *,
        now: float,
        budget: Budget,
        confirm: Callable[[bytes, bytes], bool],
    ) -> None:
        super().__init__(config, counters, link, now=now, rtt=None)
        self.messages: list[tuple[int, bytes]] = []
        self.path_responses: list[bytes] = []
        self.finished = False
        self._confirm = confirm
        self._budget = budget
        self._held = 0
        self._floor = 0  # every id below it is done with
        self._incoming: dict[int, _Incoming | None] = {}  # None: done with, but not the ids below it

    def _admit(self, frames: bytes) -> bool:
        if self.finished:
            return True
        if len(frames) < 65 or frames[0] != Frame.FINISHED:
            self._drop(Drop.EARLY)
            return False
        if not self._confirm(frames[1:33], frames[33:65]):
            self._drop(Drop.SIGNATURE)
            return False
        self.finished = self.established = True
        return True

    def _on_finished(self, frames: bytes, position: int, now: float) -> int:
        return position + 65

    def _on_path_response(self, frames: bytes, position: int, now: float) -> int:
        stop = position + 9
        if len(self.path_responses) < 4:
            self.path_responses.append(frames[position + 1 : stop])
        return stop

    def release(self) -> None:
        """Give the process's budget back what this session held."""
        self._budget.used -= self._held
        self._held = 0

    def _hold(self, entry: _Incoming, size: int) -> None:
        entry.held += size
        self._held += size
        self._budget.used += size

    def _room_for(self, ident: int, size: int) -> bool:
        limit = self.config.max_unanswered
        if (
            ident < self._floor + 4 * limit
            and self._held + size <= 2 * self.config.max_unanswered_bytes
            and self._budget.used + size <= self._budget.limit
        ):
            return True
        self._refused = True
        self._drop(Drop.FULL)
        return False

    def _on_message(self, frames: bytes, position: int, now: float) -> int:
        ident, payload, stop = _whole(frames, position)
        if ident < self._floor or ident in self._incoming:
            self._count["duplicates"] += 1
        elif self._room_for(ident, len(payload) + PIECE_OVERHEAD):
            entry = self._incoming[ident] = _Incoming(None)
            self._hold(entry, len(payload) + PIECE_OVERHEAD)
            self.messages.append((ident, payload))
            self._count["messages"] += 1
        return stop

    def _on_message_part(self, frames: bytes, position: int, now: float) -> int:
        ident, total, offset, data, stop = _part(frames, position)
        if total > self.config.max_message:
            raise Malformed("a message too long")
        entry = self._incoming.get(ident)
        parts = entry.parts if entry is not None else None
        if ident < self._floor or (parts is None and ident in self._incoming):
            self._count["duplicates"] += 1
            return stop
        if parts is not None and parts.total != total:
            raise Malformed("a message of two lengths")
        if parts is not None and parts.has(offset):
            self._count["duplicates"] += 1
            return stop
        if not self._room_for(ident, len(data) + PIECE_OVERHEAD):
            return stop
        if entry is None or parts is None:
            parts = Parts(total)
            entry = self._incoming[ident] = _Incoming(parts)
        self._hold(entry, len(data) + PIECE_OVERHEAD)
        payload = parts.add(offset, data)
        if payload is not None:
            entry.parts = None
            self.messages.append((ident, payload))
            self._count["messages"] += 1
        return stop

    def reply(self, ident: int, payload: bytes) -> None:
        entry = self._incoming.get(ident)
        if entry is None or entry.parts is not None or entry.unacked >= 0:
            raise ValueError(f"message {ident} is not waiting for an answer")
        entry.unacked = self._deliver_to_queue(
            self._urgent, (Frame.ANSWER, Frame.ANSWER_PART), ident, payload
        )
        self._hold(entry, len(payload) + PIECE_OVERHEAD - entry.held)
        self._count["answers"] += 1

    def _acknowledged(self, frame: Outgoing, now: float) -> None:
        if frame.kind not in (Frame.ANSWER, Frame.ANSWER_PART):
            super()._acknowledged(frame, now)
            return
        incoming = self._incoming
        entry = incoming.get(frame.ident)
        if entry is None:
            return
        entry.unacked -= 1
        if entry.unacked == 0:
            self._hold(entry, -entry.held)
            incoming[frame.ident] = None
            while self._floor in incoming and incoming[self._floor] is None:
                del incoming[self._floor]
                self._floor += 1

    def _queue_of(self, frame: Outgoing) -> deque[Outgoing] | None:
        if frame.kind in (Frame.ANSWER, Frame.ANSWER_PART):
            return self._urgent
        return super()._queue_of(frame)

    FRAMES: ClassVar[dict[int, Callable[..., int]]] = {
        Frame.PING: Session._on_ping,
        Frame.ACK: Session._on_ack,
        Frame.MESSAGE: _on_message,
        Frame.MESSAGE_PART: _on_message_part,
        Frame.KEY_UPDATE: Session._on_key_update,
        Frame.PATH_RESPONSE: _on_path_response,
        Frame.FINISHED: _on_finished,
        Frame.CLOSE: Session._on_close,
    }
