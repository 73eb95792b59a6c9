"""A client of the channel: connects, stays connected, sends and hands out messages. Sans-IO."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable
from datetime import UTC, datetime

from rosbridge_eth.channel import wire
from rosbridge_eth.channel.admission import Address
from rosbridge_eth.channel.events import (
    ClientConfig,
    Connected,
    Counters,
    Disconnected,
    Drop,
    End,
    Event,
    HandshakeFailed,
    Message,
    NotConnected,
    Statistics,
)
from rosbridge_eth.channel.handshake import ClientHandshake, HandshakeRefused, Randomness
from rosbridge_eth.channel.session import NEVER, Budget, Session
from rosbridge_eth.channel.states import CLIENT, ClientInput, ClientState, advance
from rosbridge_eth.channel.wire import Assembly, Kind, Malformed, Reason
from rosbridge_eth.identity import Identity, PeerIdentity, Trust

FIRST_RETRY = 0.1  # s until a HELLO is repeated, where no round trip was measured yet
SHORTEST_RETRY = 0.05
LAST_RETRY = 2.0
RETRY_GROWTH = 1.5
MAX_BAD_OFFERS = 8
"""Offers that do not hold, after which an attempt is given up: nobody makes a client verify all day."""
CLOSES = 2
ACCEPTED_SIZE = 8
PATIENCE_PTOS = 8
_HINTS = {
    Reason.CERTIFICATE: "the server seems to refuse this identity's certificates",
    Reason.EXPIRED: "the server seems to find this identity's certificates not valid at this time",
    Reason.NOT_ALLOWED: "the server seems not to have this identity on its allow list",
    Reason.FULL: "the server seems to have no room for another connection",
}


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
        self.state = ClientState.IDLE
        self._identity, self._trust, self._server_name = identity, trust, server_name
        self._wall, self._randomness = wall, randomness or Randomness()
        self._now = now
        self._address: Address = ("", 0)
        self._counters = Counters()
        self._events: deque[Event] = deque()
        self._outbox: list[bytes] = []
        self._cid = b""
        self._handshake: ClientHandshake | None = None
        self._flight: list[bytes] = []  # the handshake message that waits for its answer
        self._flight_at = 0.0
        self._rtt: float | None = None
        self._retry_after = self._retry_at = self._deadline = 0.0
        self._failures = 0
        self._silences = 0  # sessions that ended in silence since anything was stored
        self._patience = config.patience
        self._expecting_since = NEVER
        self._bad_offers = 0
        self._why = HandshakeFailed("the server does not answer")
        self._assembly = Assembly()
        self._session: Session | None = None
        self._peer: PeerIdentity | None = None

    # What the program calls

    def connect(self, address: Address, now: float) -> None:
        """Begin to connect to `address`, and go on until `close`."""
        self._address = address
        self._advance(ClientInput.CONNECT)
        self._greet(now)

    def writable(self, now: float, size: int | None = None) -> bool:
        """Whether `send` takes a message of `size` bytes (default: the longest) at this moment."""
        size = self.config.max_message if size is None else size
        return self.state is ClientState.CONNECTED and self._session is not None and self._session.has_room(size)

    def send(self, payload: bytes) -> None:
        """Send a message of 0 to max_message bytes; they arrive in order, each once, while this session lasts.

        Raises NotConnected, or Full while too much is not acknowledged.
        """
        if self.state is not ClientState.CONNECTED or self._session is None:
            raise NotConnected("there is no session; wait until it is connected")
        self._session.send(payload)
        self._counters.count["messages_sent"] += 1

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
        """The oldest event that was not fetched, or None."""
        if not self._events:
            return None
        event = self._events.popleft()
        if isinstance(event, Message) and self._session is not None and event.connection == self._cid:
            self._session.taken(event.payload)
        return event

    def close(self, now: float) -> None:
        """End the session, or the attempt at one. The server is told twice, and else learns it by silence."""
        if self.state is ClientState.IDLE:
            return
        if self.state is ClientState.CONNECTED and self._session is not None:
            self._outbox += [self._session.close_datagram(End.CLOSED) for _ in range(CLOSES)]
            self._disconnected(End.CLOSED)
        self._advance(ClientInput.CLOSE)
        self._session = self._handshake = None

    def statistics(self) -> Statistics:
        return self._counters.snapshot(connections=int(self.state is ClientState.CONNECTED))

    # What the network and the clock call

    def receive_datagram(self, data: bytes, address: Address, now: float) -> None:
        """Take what came; anything that is not right is dropped and counted."""
        self._now = now
        self._counters.count["datagrams_received"] += 1
        self._counters.count["bytes_received"] += len(data)
        if address != self._address:
            self._counters.drop(Drop.ADDRESS)
            return
        kind = data[0] if data else 0
        try:
            if kind == Kind.DATA:
                self._on_data(data, now)
            elif kind == Kind.COOKIE:
                self._on_cookie(data, now)
            elif kind == Kind.OFFER:
                self._on_offer(data, now)
            elif kind == Kind.REFUSAL:
                self._on_refusal(data)
            else:
                raise Malformed("not for a client")
        except Malformed:
            self._counters.drop(Drop.MALFORMED)

    def datagrams_to_send(self, now: float) -> list[tuple[bytes, Address]]:
        """What may go to the network now."""
        self._now = now
        session = self._session
        if session is not None and self.state in (ClientState.FINISHING, ClientState.CONNECTED):
            while (datagram := session.next_datagram(now)) is not None:
                self._outbox.append(datagram)
            self._look_for_end(now)
        out, self._outbox = self._outbox, []
        self._counters.count["datagrams_sent"] += len(out)
        self._counters.count["bytes_sent"] += sum(map(len, out))
        return [(datagram, self._address) for datagram in out]

    def next_timer(self) -> float | None:
        """When to call `handle_timer`, on the clock of `now`; None for never."""
        session = self._session
        match self.state:
            case ClientState.IDLE:
                return None
            case ClientState.GREETING | ClientState.PROVING:
                return min(self._retry_at, self._deadline)
            case ClientState.FINISHING if session is not None:
                return min(session.timer(self._now), self._deadline)
            case ClientState.CONNECTED if session is not None:
                return min(session.timer(self._now), self._ping_at(session), self._silent_at(session))
        return self._retry_at

    def handle_timer(self, now: float) -> None:
        """Do what is due at `now`; harmless if nothing is."""
        self._now = now
        session = self._session
        match self.state:
            case ClientState.GREETING | ClientState.PROVING:
                if now >= self._deadline:
                    self._fail(now)
                elif now >= self._retry_at:
                    self._send_flight(now)
            case ClientState.WAITING if now >= self._retry_at:
                self._advance(ClientInput.RETRY)
                self._greet(now)
            case ClientState.FINISHING | ClientState.CONNECTED if session is not None:
                session.handle_timer(now)
                if self.state is ClientState.FINISHING and now >= self._deadline:
                    self._fail(now)
                elif self.state is ClientState.CONNECTED and now >= self._silent_at(session):
                    session.end(End.SILENT)
                elif self.state is ClientState.CONNECTED and now >= self._ping_at(session):
                    session.ping()
                self._look_for_end(now)

    def _ping_at(self, session: Session) -> float:
        often = 1 if self._expecting_since == NEVER else 3
        return session.last_received + self.config.keep_alive / often if session.idle else NEVER

    def _silent_at(self, session: Session) -> float:
        waiting_since = min(session.waiting_since, self._expecting_since)
        return max(session.last_received, waiting_since) + max(self._patience, PATIENCE_PTOS * session.pto)

    # Handshake

    def _advance(self, happened: ClientInput) -> None:
        self.state = advance(CLIENT, self.state, happened)

    def _chance(self) -> float:
        return int.from_bytes(self._randomness.bytes(2), "big") / 65536

    def _greet(self, now: float) -> None:
        self._cid = self._randomness.bytes(wire.CID_SIZE)
        self._handshake = ClientHandshake(self.config.mode, self._identity, self._cid, self._randomness)
        self._session = self._peer = None
        self._bad_offers = 0
        self._why = HandshakeFailed("the server does not answer")
        self._assembly = Assembly()
        self._deadline = now + self.config.attempt_timeout
        self._counters.count["handshakes_begun"] += 1
        self._begin_flight([self._handshake.hello.to_bytes()], now)

    def _begin_flight(self, flight: list[bytes], now: float) -> None:
        self._flight = flight
        self._retry_after = FIRST_RETRY if self._rtt is None else max(2 * self._rtt, SHORTEST_RETRY)
        self._send_flight(now)

    def _send_flight(self, now: float) -> None:
        self._outbox = list(self._flight)
        self._flight_at = now
        self._retry_at = now + self._retry_after
        self._retry_after = max(self._retry_after, min(self._retry_after * RETRY_GROWTH, LAST_RETRY))

    def _is_mine(self, cid: bytes, nonce: bytes | None = None) -> ClientHandshake | None:
        """The handshake that an answer with these fields belongs to."""
        handshake = self._handshake
        if handshake is None or cid != self._cid or nonce not in (None, handshake.hello.nonce):
            self._counters.drop(Drop.UNEXPECTED)
            return None
        return handshake

    def _expects(self, happened: ClientInput) -> bool:
        if (self.state, happened) in CLIENT:
            return True
        self._counters.drop(Drop.UNEXPECTED)
        return False

    def _on_cookie(self, data: bytes, now: float) -> None:
        cookie = wire.Cookie.parse(data)
        if not self._expects(ClientInput.COOKIE):
            return
        handshake = self._is_mine(cookie.client_cid, cookie.nonce)
        if handshake is None:
            return
        # Since the last HELLO, whichever was answered: at worst the PROOF is repeated a little early.
        self._rtt = now - self._flight_at
        self._advance(ClientInput.COOKIE)
        body = handshake.proof(cookie.cookie)
        self._begin_flight(wire.proof_datagrams(handshake.hello, cookie.cookie, body), now)

    def _on_offer(self, data: bytes, now: float) -> None:
        cid, piece = wire.parse_offer(data)
        if not self._expects(ClientInput.OFFER) or (handshake := self._is_mine(cid)) is None:
            return
        body = self._assembly.add(piece)
        if body is None:
            return
        try:
            agreed = handshake.accept(body, self._trust, server_name=self._server_name, at=self._wall())
        except HandshakeRefused as refused:
            self._counters.drop(refused.drop)
            self._why = HandshakeFailed(f"the server's offer is refused: {refused}")
            self._bad_offers += 1
            if self._bad_offers >= MAX_BAD_OFFERS:
                self._fail(now)
            return
        self._advance(ClientInput.OFFER)
        self._peer = agreed.peer
        youngest, oldest = self.config.session_seconds
        self._session = Session(
            self.config, self._counters, agreed.server_cid, agreed.secrets.client, agreed.secrets.server, now=now,
            rtt=self._rtt, expires=now + youngest + (oldest - youngest) * self._chance(),
            budget=Budget(4 * self.config.max_buffered),
        )  # fmt: skip
        self._session.send(agreed.confirmation + agreed.finished)
        self._handshake = None
        self._flight, self._outbox = [], []

    def _on_refusal(self, data: bytes) -> None:
        refusal = wire.Refusal.parse(data)
        if self.state is not ClientState.PROVING:
            self._counters.drop(Drop.UNEXPECTED)
        elif self._is_mine(refusal.client_cid, refusal.nonce) is not None:
            # Anybody on the path may have said it: it explains a failure, it does not cause one.
            self._why = HandshakeFailed(_HINTS[refusal.reason], refusal.reason)

    def _fail(self, now: float) -> None:
        self._advance(ClientInput.FAILED)
        self._events.append(self._why)
        self._failures += 1
        self._wait(now)

    def _wait(self, now: float) -> None:
        longest = min(self.config.reconnect_min * 2 ** min(self._failures, 16), self.config.reconnect_max)
        self._retry_at = now + longest * (1 - self._chance() / 2)
        self._session = self._handshake = None
        self._flight = []

    # Session

    def _on_data(self, data: bytes, now: float) -> None:
        session = self._session
        if session is None:
            self._counters.drop(Drop.UNEXPECTED)
            return
        if len(data) <= wire.DATA_OVERHEAD:
            raise Malformed("a packet without a frame")
        if data[1:9] != self._cid:
            self._counters.drop(Drop.UNKNOWN_CONNECTION)
            return
        if not session.receive(data, now):
            return
        for payload in session.messages:
            if self._peer is None:
                break
            if self.state is ClientState.FINISHING:
                self._accepted(session, payload, self._peer)
            elif self.state is ClientState.CONNECTED:
                self._counters.count["messages_received"] += 1
                self._events.append(Message(self._cid, payload, self._peer))
        session.messages.clear()
        self._look_for_end(now)

    def _accepted(self, session: Session, payload: bytes, peer: PeerIdentity) -> None:
        """The server's first message: its wall clock in ms since 1970."""
        session.taken(payload)
        milliseconds = int.from_bytes(payload, "big")
        if len(payload) != ACCEPTED_SIZE or milliseconds > 2**47:
            session.end(End.PROTOCOL)
            return
        self._advance(ClientInput.ACCEPTED)
        self._failures = 0
        self._expecting_since = NEVER
        longest = min(self.config.patience * 2**self._silences, self.config.patience_max)
        self._patience = longest * (1 + self._chance() / 4)
        self._counters.count["handshakes"] += 1
        self._events.append(Connected(peer, self._cid, datetime.fromtimestamp(milliseconds / 1000, UTC)))

    def _look_for_end(self, now: float) -> None:
        session = self._session
        if session is None or session.ended is None:
            return
        reason = session.ended
        if reason in (End.PROTOCOL, End.EXPIRED):
            self._outbox.append(session.close_datagram(reason))
        if self.state is ClientState.FINISHING:
            self._why = HandshakeFailed(f"the session ended before it began: {reason}")
            self._fail(now)
            return
        self._advance(ClientInput.LOST)
        self._disconnected(reason)
        if reason is End.SILENT:
            self._silences = min(self._silences + 1, 16)
        if reason in (End.REPLACED, End.REVOKED):
            self._failures += 3  # whoever has our name, or took it away, is not to be fought over it
        self._wait(now)
        if reason is End.EXPIRED:
            self._retry_at = now

    def _disconnected(self, reason: End) -> None:
        if self._peer is not None:
            self._events.append(Disconnected(reason, self._cid, self._peer))
