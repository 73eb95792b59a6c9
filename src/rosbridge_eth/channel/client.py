"""A client of the channel: connects, stays connected, sends and hands out messages. Sans-IO."""

from __future__ import annotations

from collections import Counter, deque
from collections.abc import Callable
from datetime import UTC, datetime
from enum import StrEnum

from rosbridge_eth.channel import events, wire
from rosbridge_eth.channel.admission import Address
from rosbridge_eth.channel.events import ClientConfig, Drop, End, Event
from rosbridge_eth.channel.handshake import ClientHandshake, HandshakeRefused, Randomness
from rosbridge_eth.channel.session import MAX_MESSAGE, NEVER, RECEIVE_SEGMENTS, Early, Session
from rosbridge_eth.channel.wire import Assembly, Hello, Kind, Malformed, Reason
from rosbridge_eth.identity import Identity, Trust

FIRST_RETRY = 0.1  # s until a HELLO is repeated, where no round trip was measured yet
SHORTEST_RETRY = 0.05
LAST_RETRY = 2.0
RETRY_GROWTH = 1.5
RECONNECT_MIN, RECONNECT_MAX = 0.25, 10.0
"""s before another handshake; it grows from one to the other, less up to a half by chance."""
SESSION_SECONDS = (2700.0, 3600.0)
"""The age at which a session is ended and another made is drawn between the two."""
KEEP_ALIVE = 10.0
"""s without a packet after which a client pings; a third of it while it waits for something."""
MAX_BAD_OFFERS = 8
"""Offers that do not hold, after which an attempt is given up: nobody makes a client verify all day."""
CLOSES = 2
ACCEPTED_SIZE = 8
PATIENCE_PTOS = 8
_NO_ANSWER = events.HandshakeFailed("the server does not answer")
_HINTS = {
    Reason.CERTIFICATE: "the server seems to refuse this identity's certificates",
    Reason.EXPIRED: "the server seems to find this identity's certificates not valid at this time",
    Reason.NOT_ALLOWED: "the server seems not to have this identity on its allow list",
    Reason.FULL: "the server seems to have no room for another connection",
}


class State(StrEnum):
    """Where a client stands; docs/channel.md has what leads from one to another."""

    IDLE = "idle"  # made, or closed: nothing is sent
    GREETING = "greeting"  # HELLO sent, waiting for a COOKIE
    PROVING = "proving"  # PROOF sent, waiting for an OFFER
    FINISHING = "finishing"  # FINISHED sent, waiting for ACCEPTED
    CONNECTED = "connected"
    WAITING = "waiting"  # between two attempts


_TAKES = {State.GREETING: (Kind.COOKIE,), State.PROVING: (Kind.OFFER, Kind.REFUSAL)}


def utc_now() -> datetime:
    return datetime.now(UTC)


class Client:
    """Call `connect`; then, in a loop, `receive_datagram`, `handle_timer`, `next_event`, `datagrams_to_send`.

    now: monotonic seconds, the same clock in every call. wall: the clock that certificates are checked against.
    server_name: the server's name in its certificate; None takes any server of the operator.

    A session that is lost is made anew, after a growing wait; what was sent and not answered is the program's to send
    again. Not thread-safe.
    """

    def __init__(
        self, config: ClientConfig, identity: Identity, trust: Trust, server_name: str | None, now: float, *,
        wall: Callable[[], datetime] = utc_now, randomness: Randomness | None = None,
    ) -> None:  # fmt: skip
        self.config = config
        self.state = State.IDLE
        self._identity, self._trust, self._server_name = identity, trust, server_name
        self._wall, self._randomness = wall, randomness or Randomness()
        self._now = now
        self._address: Address = ("", 0)
        self._counts: Counter[str] = Counter()
        self._events: deque[Event] = deque()
        self._outbox: list[bytes] = []
        self._cid = b""
        self._handshake: ClientHandshake | None = None
        self._flight: list[bytes] = []  # the handshake message that waits for its answer
        self._flight_at = 0.0
        self._rtt: float | None = None
        self._retry_after = self._retry_at = self._deadline = NEVER
        self._failures = 0
        self._silences = 0  # sessions that ended in silence since anything was stored
        self._patience = config.patience
        self._expecting_since = NEVER
        self._bad_offers = 0
        self._why = _NO_ANSWER
        self._assembly = Assembly()
        self._session: Session | None = None

    # What the program calls

    def connect(self, address: Address, now: float) -> None:
        """Begin to connect to `address`, and go on until `close`."""
        self._address = address
        self._greet(now)

    def writable(self, size: int = MAX_MESSAGE) -> bool:
        """Whether `send` takes a message of `size` bytes at this moment."""
        return self.state is State.CONNECTED and self._session is not None and self._session.has_room(size)

    def send(self, payload: bytes) -> None:
        """Send a message of 0 to MAX_MESSAGE bytes; they arrive in order, each once, while this session lasts.

        Raises NotConnected, or Full while too much is not acknowledged.
        """
        if self.state is not State.CONNECTED or self._session is None:
            raise events.NotConnected("there is no session; wait until it is connected")
        self._session.send(payload)
        self._counts["messages_sent"] += 1

    def expecting(self, waits: bool) -> None:
        """Say whether the program waits for a message of the server's; False with each new session.

        While it does, a server from which no packet comes for `patience` is given up and a new session made.
        """
        if not waits:
            self._expecting_since = NEVER
        elif self._expecting_since == NEVER:
            self._expecting_since = self._now

    def progressed(self) -> None:
        """Say that the server has stored something: this client's patience is what it was at first."""
        self._silences = 0
        self._patience = self.config.patience

    def next_event(self) -> Event | None:
        """The oldest event that was not fetched, or None. Fetch them all in each turn: nothing bounds them."""
        return self._events.popleft() if self._events else None

    def close(self, now: float) -> None:
        """End the session, or the attempt at one. The server is told twice, and else learns it by silence."""
        if self.state is State.CONNECTED and self._session is not None:
            self._outbox += [self._session.close_datagram(End.CLOSED) for _ in range(CLOSES)]
            self._events.append(events.Disconnected(End.CLOSED, self._cid, self._session.peer))
        self.state = State.IDLE
        self._session = self._handshake = None

    def statistics(self) -> Counter[str]:
        """What was counted since this client was made, each Drop among it, and whether it is connected."""
        return Counter({**self._counts, "connections": int(self.state is State.CONNECTED)})

    # What the network and the clock call

    def receive_datagram(self, data: bytes, address: Address, now: float) -> None:
        """Take what came; anything that is not right is dropped and counted."""
        self._now = now
        self._counts["datagrams_received"] += 1
        self._counts["bytes_received"] += len(data)
        try:
            if address != self._address:
                self._counts[Drop.ADDRESS] += 1
            elif data and data[0] == Kind.DATA:
                self._on_data(data, now)
            else:
                self._on_handshake(data, now)
        except Malformed:
            self._counts[Drop.MALFORMED] += 1

    def datagrams_to_send(self, now: float) -> list[tuple[bytes, Address]]:
        """What may go to the network now."""
        self._now = now
        session = self._session
        if session is not None:
            while (datagram := session.next_datagram(now)) is not None:
                self._outbox.append(datagram)
            self._look_for_end(session, now)
        out, self._outbox = self._outbox, []
        self._counts["datagrams_sent"] += len(out)
        self._counts["bytes_sent"] += sum(map(len, out))
        return [(datagram, self._address) for datagram in out]

    def next_timer(self) -> float | None:
        """When to call `handle_timer`, on the clock of `now`; None for never."""
        session = self._session
        if self.state is State.IDLE:
            return None
        if session is None:
            return min(self._retry_at, self._deadline)
        ends = min(session.expires, self._deadline, self._silent_at(session))
        return min(session.timer(self._now), self._ping_at(session), ends)

    def handle_timer(self, now: float) -> None:
        """Do what is due at `now`; harmless if nothing is."""
        self._now = now
        session = self._session
        if self.state is State.IDLE:
            return
        if now >= self._deadline:
            self._fail(now)
        elif session is not None:
            session.handle_timer(now)
            if now >= self._silent_at(session):
                session.end(End.SILENT)
            elif now >= self._ping_at(session):
                session.ping()
            self._look_for_end(session, now)
        elif now >= self._retry_at:
            if self.state is State.WAITING:
                self._greet(now)
            else:
                self._send_flight(now)

    def _ping_at(self, session: Session) -> float:
        often = 1 if self._expecting_since == NEVER else 3
        return session.last_received + KEEP_ALIVE / often if session.waiting_since == NEVER else NEVER

    def _silent_at(self, session: Session) -> float:
        waiting_since = min(session.waiting_since, self._expecting_since)
        return max(session.last_received, waiting_since) + max(self._patience, PATIENCE_PTOS * session.pto)

    # Handshake

    def _chance(self) -> float:
        return int.from_bytes(self._randomness.bytes(2), "big") / 65536

    def _greet(self, now: float) -> None:
        self.state = State.GREETING
        self._cid = self._randomness.bytes(wire.CID_SIZE)
        self._handshake = ClientHandshake(self.config.mode, self._identity, self._cid, self._randomness)
        self._session = None
        self._bad_offers = 0
        self._why = _NO_ANSWER
        self._assembly = Assembly()
        self._deadline = now + self.config.attempt_timeout
        self._counts["handshakes_begun"] += 1
        self._begin_flight([self._handshake.hello.datagram(Kind.HELLO, wire.HELLO_PADDING)], now)

    def _begin_flight(self, flight: list[bytes], now: float) -> None:
        self._flight = flight
        self._retry_after = FIRST_RETRY if self._rtt is None else max(2 * self._rtt, SHORTEST_RETRY)
        self._send_flight(now)

    def _send_flight(self, now: float) -> None:
        self._outbox = list(self._flight)
        self._flight_at = now
        self._retry_at = now + self._retry_after
        self._retry_after = max(self._retry_after, min(self._retry_after * RETRY_GROWTH, LAST_RETRY))

    def _on_handshake(self, data: bytes, now: float) -> None:
        hello, rest = Hello.parse(data)
        handshake = self._handshake
        if handshake is None or hello != handshake.hello or data[0] not in _TAKES.get(self.state, ()):
            self._counts[Drop.UNEXPECTED] += 1
        elif data[0] == Kind.COOKIE:
            if len(rest) != wire.COOKIE_SIZE:
                raise Malformed("a cookie of another length")
            # Since the last HELLO, whichever was answered: at worst the PROOF is repeated a little early.
            self._rtt = now - self._flight_at
            self.state = State.PROVING
            self._begin_flight(hello.in_pieces(Kind.PROOF, rest, handshake.proof(rest)), now)
        elif data[0] == Kind.OFFER:
            body = self._assembly.add(wire.parse_piece(rest))
            if body is not None:
                self._on_offer(handshake, body, now)
        else:
            if len(rest) != 1 or rest[0] not in _HINTS:
                raise Malformed("a reason that does not exist")
            # Anybody on the path may have said it: it explains a failure, it does not cause one.
            self._why = events.HandshakeFailed(_HINTS[Reason(rest[0])], Reason(rest[0]))

    def _on_offer(self, handshake: ClientHandshake, body: bytes, now: float) -> None:
        try:
            agreed = handshake.accept(body, self._trust, server_name=self._server_name, at=self._wall())
        except HandshakeRefused as refused:
            self._counts[refused.drop] += 1
            self._why = events.HandshakeFailed(f"the server's offer is refused: {refused}", refused.hint)
            self._bad_offers += 1
            if self._bad_offers >= MAX_BAD_OFFERS:
                self._fail(now)
            return
        self.state = State.FINISHING
        youngest, oldest = SESSION_SECONDS
        self._session = Session(
            agreed.peer, agreed.server_cid, agreed.secrets.client, agreed.secrets.server, now=now, rtt=self._rtt,
            expires=now + youngest + (oldest - youngest) * self._chance(), early=Early(RECEIVE_SEGMENTS),
            counts=self._counts,
        )  # fmt: skip
        self._session.send(agreed.finished)
        self._handshake = None
        self._outbox = []

    def _fail(self, now: float) -> None:
        self._events.append(self._why)
        self._failures += 1
        self._wait(now)

    def _wait(self, now: float) -> None:
        self.state = State.WAITING
        self._session = self._handshake = None
        self._deadline = NEVER
        longest = min(RECONNECT_MIN * 2 ** min(self._failures, 16), RECONNECT_MAX)
        self._retry_at = now + longest * (1 - self._chance() / 2)

    # Session

    def _on_data(self, data: bytes, now: float) -> None:
        session = self._session
        if len(data) <= wire.DATA_OVERHEAD:
            raise Malformed("a packet without a frame")
        if session is None or data[1:9] != self._cid:
            self._counts[Drop.UNKNOWN_CONNECTION] += 1
            return
        if not session.receive(data, now):
            return
        if self.state is State.FINISHING and session.messages:
            self._accepted(session, session.messages.pop(0))
        for payload in session.messages:
            self._counts["messages_received"] += 1
            self._events.append(events.Message(self._cid, payload, session.peer))
        session.messages.clear()
        self._look_for_end(session, now)

    def _accepted(self, session: Session, payload: bytes) -> None:
        """The server's first message: its wall clock in ms since 1970."""
        milliseconds = int.from_bytes(payload, "big")
        if len(payload) != ACCEPTED_SIZE or milliseconds > 2**47:
            session.messages.clear()
            session.end(End.PROTOCOL)
            return
        self.state = State.CONNECTED
        self._deadline = NEVER
        self._failures = 0
        self._expecting_since = NEVER
        longest = min(self.config.patience * 2**self._silences, self.config.patience_max)
        self._patience = longest * (1 + self._chance() / 4)
        self._counts["handshakes"] += 1
        self._events.append(events.Connected(session.peer, self._cid, datetime.fromtimestamp(milliseconds / 1000, UTC)))

    def _look_for_end(self, session: Session, now: float) -> None:
        reason = session.ended
        if reason is None:
            return
        if reason in (End.PROTOCOL, End.EXPIRED):
            self._outbox.append(session.close_datagram(reason))
        if self.state is State.FINISHING:
            self._why = events.HandshakeFailed(f"the session ended before it began: {reason}")
            self._fail(now)
            return
        self._events.append(events.Disconnected(reason, self._cid, session.peer))
        if reason is End.SILENT:
            self._silences = min(self._silences + 1, 16)
        if reason in (End.REPLACED, End.REVOKED):
            self._failures += 3  # whoever has our name, or took it away, is not to be fought over it
        self._wait(now)
        if reason is End.EXPIRED:
            self._retry_at = now
