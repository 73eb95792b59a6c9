"""A client of the channel: connects, stays connected, sends messages and hears the server's state. Sans-IO."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable
from datetime import UTC, datetime
from enum import StrEnum

from rosbridge_eth.channel import events, wire
from rosbridge_eth.channel.admission import Address
from rosbridge_eth.channel.endpoint import Endpoint, utc_now
from rosbridge_eth.channel.events import ClientConfig, End, close_frame, parse_close
from rosbridge_eth.channel.handshake import Agreed, ClientHandshake, Randomness
from rosbridge_eth.channel.protection import SESSION_PACKETS, Direction, ReplayWindow
from rosbridge_eth.channel.transfer import NEVER, Sending
from rosbridge_eth.channel.wire import Answer, Assembly, Drop, Hello, Kind, Malformed, Reason, Refused
from rosbridge_eth.identity import Identity, Trust

FIRST_RETRY = 0.1  # s until a HELLO is repeated, where no round trip was measured yet
SHORTEST_RETRY = 0.05
LAST_RETRY = 2.0
RETRY_GROWTH = 1.5
RECONNECT_MIN, RECONNECT_MAX = 0.25, 10.0
"""s before another handshake; it grows from one to the other, less up to a half by chance."""
SESSION_SECONDS = (2700.0, 3600.0)
"""The age at which a session is ended and another made is drawn between the two."""
SHORT_SESSION = 60.0
"""s; a session that ends sooner counts as an attempt that failed."""
PROBE_FIRST, KEEP_ALIVE = 1.0, 10.0
"""s without a packet after which the server is probed: the first after a message was sent, doubled up to the second."""
SILENCE, SILENCE_PTOS = 10.0, 8
"""s, and probe timeouts, without a packet while one is not acknowledged, after which a new session is made."""
MAX_BAD_OFFERS = 8
"""Offers that do not hold, after which an attempt is given up: nobody makes a client verify all day."""
CLOSES = 2
LATEST_MS = 1 << 47  # of the server's clock: the year 6429
_NO_ANSWER = events.HandshakeFailed("the server does not answer")
_HINTS = {
    Reason.CERTIFICATE: "the server seems to refuse this identity's certificates",
    Reason.EXPIRED: "the server seems to find this identity's certificates not valid at this time",
    Reason.NOT_ALLOWED: "the server seems not to have this identity on its allow list",
    Reason.FULL: "the server seems to have no room for another connection",
}


class Phase(StrEnum):
    """Where a client stands; docs/channel.md has what leads from one to another."""

    IDLE = "idle"  # made, or closed: nothing is sent
    GREETING = "greeting"  # HELLO sent, waiting for a COOKIE
    PROVING = "proving"  # PROOF sent, waiting for an OFFER
    CONFIRMING = "confirming"  # the server is probed under the session's keys, waiting for its first packet
    CONNECTED = "connected"
    WAITING = "waiting"  # between two attempts


_TAKES = {Phase.GREETING: (Kind.COOKIE,), Phase.PROVING: (Kind.OFFER, Kind.REFUSAL)}


class _Session:
    """The keys of an OFFER that holds, and what is sent and heard under them."""

    def __init__(self, agreed: Agreed, sending: Sending, now: float, lasts: float) -> None:
        self.peer, self._cid = agreed.peer, agreed.told
        self.seals, self.opens = Direction(agreed.secrets.client), Direction(agreed.secrets.server)
        self.replay, self.sending = ReplayWindow(), sending
        self.state = b""  # what the server's program said last
        self.began = self.heard = now
        self.expires = now + lasts
        self.interval = PROBE_FIRST

    def seal(self, number: int, frame: bytes) -> bytes:
        return self.seals.seal(self._cid, number, frame)

    def close(self, reason: End) -> bytes:
        return self.seal(self.sending.take_number(), close_frame(reason))

    def probe_at(self) -> float:
        """When to ask for the server's state; never while an acknowledgement is due, which has it."""
        return self.heard + self.interval if self.sending.oldest == NEVER else NEVER

    def silent_at(self) -> float:
        return max(self.heard, self.sending.oldest) + max(SILENCE, SILENCE_PTOS * self.sending.pto)


class Client(Endpoint):
    """Call `connect`; then, in a loop, `receive_datagram`, `handle_timer`, `next_event`, `datagrams_to_send`.

    now: monotonic seconds, the same clock in every call. wall, randomness: see Endpoint.
    server_name: the server's name in its certificate; None takes any server of the operator.

    A session that is lost is made again, after a growing wait.
    """

    def __init__(
        self, config: ClientConfig, identity: Identity, trust: Trust, server_name: str | None, now: float, *,
        wall: Callable[[], datetime] = utc_now, randomness: Randomness | None = None,
    ) -> None:  # fmt: skip
        super().__init__(wall, randomness)
        self.config, self.phase = config, Phase.IDLE
        self._identity, self._trust, self._server_name = identity, trust, server_name
        self._now = now
        self._address: Address = ("", 0)
        self._cid = b""
        self._handshake: ClientHandshake | None = None
        self._assembly, self._bad_offers = Assembly(), 0
        self._flight: list[bytes] = []  # the handshake message that waits for its answer
        self._flight_at = 0.0
        self._rtt: float | None = None
        self._retry_after = self._retry_at = self._deadline = NEVER
        self._failures = 0
        self._why = _NO_ANSWER
        self._session: _Session | None = None

    # What the program calls

    @property
    def connected(self) -> bool:
        return self.phase is Phase.CONNECTED

    def connect(self, address: Address, now: float) -> None:
        """Begin to connect to `address`, and go on until `close`."""
        self._address = address
        self._greet(now)

    def room(self) -> int:
        """The longest message, in bytes, that `send` takes at this moment; 0 where there is no session."""
        return self._session.sending.room() if self._session is not None and self.connected else 0

    def send(self, message: bytes) -> None:
        """Send a message of 0 to MAX_MESSAGE bytes; they arrive in order, each once, while this session lasts.

        Raises Full where the message is longer than `room` says, or there is no session.
        """
        if self._session is None or not self.connected or len(message) > self.room():
            raise events.Full("no session, or no room until some of what was sent is acknowledged")
        self._session.sending.write(message)
        self._session.interval = PROBE_FIRST
        self._counts["messages_sent"] += 1

    def close(self, now: float) -> None:
        """End the session, or the attempt at one. The server is told twice, and else learns it by silence."""
        if self.connected and self._session is not None:
            self._outbox += [(self._session.close(End.CLOSED), self._address) for _ in range(CLOSES)]
            self._events.append(events.Disconnected(End.CLOSED, self._cid, self._session.peer))
        self.phase = Phase.IDLE
        self._session = self._handshake = None

    def statistics(self) -> Counter[str]:
        """What was counted since this client was made, each Drop among it, and whether it is connected."""
        return Counter({**self._counts, "connections": int(self.connected)})

    # What the network and the clock call

    def _prepare(self, now: float) -> None:
        self._now = now
        while (session := self._session) is not None and (packet := session.sending.next(now)) is not None:
            self._outbox.append((session.seal(*packet), self._address))
            if session.sending.packets >= SESSION_PACKETS:
                self._end(End.EXPIRED, now)

    def next_timer(self) -> float | None:
        """When to call `handle_timer`, on the clock of `now`; None for never."""
        session = self._session
        if self.phase is Phase.IDLE:
            return None
        when = min(self._retry_at, self._deadline)
        if session is None:
            return when
        return min(when, session.sending.timer(self._now), session.probe_at(), session.silent_at(), session.expires)

    def handle_timer(self, now: float) -> None:
        """Do what is due at `now`; harmless if nothing is."""
        self._now = now
        session = self._session
        if self.phase is Phase.IDLE:
            return
        if now >= self._deadline:
            self._fail(now)
        elif now >= self._retry_at:
            if self.phase is Phase.WAITING:
                self._greet(now)
            else:
                self._send_flight(now)
        elif session is not None and now >= min(session.silent_at(), session.expires):
            self._end(End.EXPIRED if now >= session.expires else End.SILENT, now)
        elif session is not None:
            session.sending.handle_timer(now)
            if now >= session.probe_at():
                session.interval = min(2 * session.interval, KEEP_ALIVE)
                session.sending.probe()

    # Handshake

    def _chance(self) -> float:
        return int.from_bytes(self._randomness.bytes(2), "big") / 65536

    def _greet(self, now: float) -> None:
        self.phase = Phase.GREETING
        self._cid = self._randomness.bytes(wire.CID_SIZE)
        self._handshake = ClientHandshake(self.config.mode, self._identity, self._cid, self._randomness)
        self._session = None
        self._assembly, self._bad_offers = Assembly(), 0
        self._why = _NO_ANSWER
        self._deadline = now + self.config.attempt_timeout
        self._counts["handshakes_begun"] += 1
        self._begin_flight([self._handshake.hello.datagram(Kind.HELLO, wire.HELLO_PADDING)], now)

    def _begin_flight(self, flight: list[bytes], now: float) -> None:
        self._flight = flight
        self._retry_after = FIRST_RETRY if self._rtt is None else max(2 * self._rtt, SHORTEST_RETRY)
        self._send_flight(now)

    def _send_flight(self, now: float) -> None:
        """Send the handshake message that waits for its answer; the last of them is a probe, sealed again each time."""
        self._outbox = [(datagram, self._address) for datagram in self._flight]
        if self._session is not None:
            self._session.sending.probe()
        self._flight_at = now
        self._retry_at = now + self._retry_after
        self._retry_after = max(self._retry_after, min(self._retry_after * RETRY_GROWTH, LAST_RETRY))

    def _on_handshake(self, data: bytes, address: Address, now: float) -> None:
        self._now = now
        if address != self._address:
            raise Refused(Drop.ADDRESS)
        hello, rest = Hello.parse(data)
        handshake = self._handshake
        if handshake is None or hello != handshake.hello or data[0] not in _TAKES.get(self.phase, ()):
            raise Refused(Drop.UNEXPECTED)
        if data[0] == Kind.COOKIE:
            if len(rest) != wire.COOKIE_SIZE:
                raise Malformed("a cookie of another length")
            # Since the last HELLO, whichever was answered: at worst the PROOF is repeated a little early.
            self._rtt = now - self._flight_at
            self.phase = Phase.PROVING
            self._begin_flight(hello.in_pieces(Kind.PROOF, rest, handshake.proof(rest)), now)
        elif data[0] == Kind.OFFER:
            body = self._assembly.add(rest)
            if body is not None:
                self._assembly = Assembly()
                self._on_offer(handshake, body, now)
            elif self._assembly.count > len(self._flight):  # an offer of more datagrams than its proof: each draws one
                self._send_flight(now)
        else:
            if len(rest) != 1 or rest[0] not in _HINTS:
                raise Malformed("a reason that does not exist")
            # Anybody on the path may have said it: it explains a failure, it does not cause one.
            self._why = events.HandshakeFailed(_HINTS[Reason(rest[0])], Reason(rest[0]))

    def _on_offer(self, handshake: ClientHandshake, body: bytes, now: float) -> None:
        try:
            agreed = handshake.accept(body, self._trust, server_name=self._server_name, at=self._wall())
        except Refused as refused:
            self._why = events.HandshakeFailed(f"the server's offer is refused: {refused}", refused.hint)
            self._bad_offers += 1
            if self._bad_offers >= MAX_BAD_OFFERS:
                self._fail(now)
            raise
        self.phase = Phase.CONFIRMING
        self._handshake = None
        youngest, oldest = SESSION_SECONDS
        lasts = youngest + (oldest - youngest) * self._chance()
        self._session = _Session(agreed, Sending(now, self._rtt, self._counts), now, lasts)
        self._begin_flight([], now)

    def _fail(self, now: float) -> None:
        self._events.append(self._why)
        self._failures += 1
        self._wait(now)

    def _wait(self, now: float) -> None:
        self.phase = Phase.WAITING
        self._session = self._handshake = None
        self._deadline = NEVER
        longest = min(RECONNECT_MIN * 2 ** min(self._failures, 16), RECONNECT_MAX)
        self._retry_at = now + longest * (1 - self._chance() / 2)

    # Session

    def _on_data(self, data: bytes, address: Address, now: float) -> None:
        self._now = now
        if address != self._address:
            raise Refused(Drop.ADDRESS)
        session = self._session
        if session is None or data[1:9] != self._cid:
            raise Refused(Drop.UNKNOWN_CONNECTION)
        number, frame = session.opens.open(data, session.replay)
        newest = number > session.replay.highest
        session.replay.mark(number)
        session.heard = now
        try:
            if (reason := parse_close(frame)) is not None:
                self._end(reason, now)
            else:
                self._on_answer(session, Answer.parse(frame), newest, now)
        except Malformed:
            self._end(End.PROTOCOL, now)

    def _on_answer(self, session: _Session, answer: Answer, newest: bool, now: float) -> None:
        if answer.time_ms > LATEST_MS:
            raise Malformed("a time beyond any clock")
        session.sending.acknowledged(answer, now)
        if self.phase is Phase.CONFIRMING:
            self.phase = Phase.CONNECTED
            self._deadline = self._retry_at = NEVER
            self._counts["handshakes"] += 1
            when = datetime.fromtimestamp(answer.time_ms / 1000, UTC)
            self._events.append(events.Connected(session.peer, self._cid, when))
        if newest and answer.data not in (b"", session.state):
            session.state = answer.data
            self._events.append(events.State(answer.data))
        elif newest and session.state and not answer.data:
            session.sending.probe()  # nothing had come from here that was long enough for the state

    def _end(self, reason: End, now: float) -> None:
        session = self._session
        if session is None:
            return
        if reason in (End.PROTOCOL, End.EXPIRED):
            self._outbox.append((session.close(reason), self._address))
        if not self.connected:
            self._why = events.HandshakeFailed(f"the session ended before it began: {reason}")
            self._fail(now)
            return
        self._events.append(events.Disconnected(reason, self._cid, session.peer))
        self._failures = self._failures + 1 if now < session.began + SHORT_SESSION else 0
        if reason in (End.REPLACED, End.REVOKED):
            self._failures += 3  # whoever has our name, or took it away, is not to be fought over it
        self._wait(now)
        if reason is End.EXPIRED:
            self._retry_at = now
