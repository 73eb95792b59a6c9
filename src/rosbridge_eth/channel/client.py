"""A client of the channel: connects, stays connected, sends messages, hands out answers. Sans-IO."""

from __future__ import annotations

import hmac
from collections import deque
from collections.abc import Callable
from datetime import UTC, datetime

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
    MessageAnswered,
    NotConnected,
    Statistics,
)
from rosbridge_eth.channel.handshake import (
    ClientHandshake,
    HandshakeRefused,
    Randomness,
    VerifiedCertificates,
)
from rosbridge_eth.channel.session import ClientSession, Link
from rosbridge_eth.channel.states import CLIENT, ClientInput, ClientState, advance
from rosbridge_eth.channel.wire import (
    CID_SIZE,
    DATA_OVERHEAD,
    Assembly,
    Cookie,
    Frame,
    Kind,
    Malformed,
    Reason,
    ServerPiece,
    parse_refusal,
    parse_reset,
    proof_datagrams,
)
from rosbridge_eth.identity import Identity, PeerIdentity, Trust

__all__ = ["Client"]

FIRST_RETRY = 0.25  # s, doubled with each repetition of a handshake message
LAST_RETRY = 2.0
MAX_BAD_OFFERS = 8
"""Offers that do not hold, after which an attempt is given up: nobody makes a client verify all day."""
CLOSE_TRIES = 3
_HINTS = {
    Reason.CERTIFICATE: "the server seems to refuse this identity's certificates",
    Reason.EXPIRED: "the server seems to find this identity's certificates not valid at this time",
    Reason.NOT_ALLOWED: "the server seems not to have this identity on its allow list",
    Reason.FULL: "the server seems to have no room for another connection",
}


def _wall() -> datetime:
    return datetime.now(UTC)


class Client:
    """Call `connect`; then, in a loop, `receive_datagram`, `handle_timer`, `next_event`, `datagrams_to_send`.

    now: monotonic seconds, the same clock in every call. wall: the clock that
    certificates are checked against. server_name: the server's name in its
    certificate; None takes any server of the operator.

    A session that is lost is made anew, after a growing wait; messages that
    had no answer are listed in Disconnected and are the caller's to send
    again. Not thread-safe.
    """

    def __init__(
        self,
        config: ClientConfig,
        identity: Identity,
        trust: Trust,
        server_name: str | None,
        now: float,
        *,
        wall: Callable[[], datetime] = _wall,
        randomness: Randomness | None = None,
    ) -> None:
        self.config = config
        self.state = ClientState.IDLE
        self._identity = identity
        self._server_name = server_name
        self._certificates = VerifiedCertificates(trust, capacity=4, recheck=600.0)
        self._wall = wall
        self._randomness = randomness or Randomness()
        self._now = now
        self._address: Address = ("", 0)
        self._counters = Counters()
        self._events: deque[Event] = deque()
        self._outbox: list[bytes] = []
        self._cid = b""
        self._handshake: ClientHandshake | None = None
        self._flight: list[bytes] = []  # the handshake message that waits for its answer
        self._flight_at = 0.0
        self._flight_once = False  # sent once only, so that its answer measures the round trip
        self._rtt: float | None = None
        self._retry_after = FIRST_RETRY
        self._retry_at = 0.0
        self._deadline = 0.0
        self._failures = 0
        self._bad_offers = 0
        self._why = HandshakeFailed("the server does not answer")
        self._assembly = Assembly()
        self._session: ClientSession | None = None
        self._peer: PeerIdentity | None = None
        self._first_id = 0
        self._closes_left = 0

    # What the program calls

    def connect(self, address: Address, now: float) -> None:
        """Begin to connect to `address`, and go on until `close`."""
        self._address = address
        self._now = now
        self._advance(ClientInput.CONNECT)
        self._greet(now)

    def writable(self, now: float, size: int | None = None) -> bool:
        """Whether `send` takes a message of `size` bytes (default: the longest) at this moment."""
        session = self._session
        return (
            self.state is ClientState.CONNECTED
            and session is not None
            and session.has_room(self.config.max_message if size is None else size)
        )

    def send(self, payload: bytes, *, priority: int = 1) -> int:
        """Queue a message; its id, which no later message of this Client has.

        payload: 0 to max_message bytes. priority: 0 goes before 1. Raises
        NotConnected, or Full while too many messages wait for their answer.
        """
        if priority not in (0, 1):
            raise ValueError(f"priority must be 0 or 1, not {priority!r}")
        if len(payload) > self.config.max_message:
            raise ValueError(f"a message is at most {self.config.max_message} bytes, not {len(payload)}")
        if self.state is not ClientState.CONNECTED or self._session is None:
            raise NotConnected("there is no session; wait until it is connected")
        return self._first_id + self._session.send(bytes(payload), priority)

    def next_event(self) -> Event | None:
        """The oldest event that was not fetched, or None."""
        return self._events.popleft() if self._events else None

    def close(self, now: float) -> None:
        """End the session, or the attempt at one. Disconnected follows when the server knows, or soon after."""
        self._now = now
        if self.state in (ClientState.IDLE, ClientState.CLOSING):
            return
        self._outbox.clear()
        self._advance(ClientInput.CLOSE)
        if self._session is not None:  # the table leads to CLOSING from where there is one
            self._closes_left = CLOSE_TRIES
            self._send_close(now)

    def statistics(self) -> Statistics:
        return self._counters.snapshot(connections=int(self.state is ClientState.CONNECTED))

    # What the network and the clock call

    def receive_datagram(self, data: bytes, address: Address, now: float) -> None:
        """Take what came; anything that is not right is dropped and counted."""
        self._now = now
        count = self._counters.count
        count["datagrams_received"] += 1
        count["bytes_received"] += len(data)
        if address != self._address:
            self._counters.drop(Drop.ADDRESS)
            return
        if not data:
            self._counters.drop(Drop.MALFORMED)
            return
        kind = data[0]
        try:
            if kind & 0xF0 == Kind.DATA:
                self._on_data(data, now)
            elif kind == Kind.COOKIE:
                self._on_cookie(data, now)
            elif kind == Kind.OFFER:
                self._on_offer(data, now)
            elif kind == Kind.RESET:
                self._on_reset(data, now)
            elif kind == Kind.REFUSAL:
                self._on_refusal(data)
            else:
                raise Malformed("not for a client")
        except Malformed:
            self._counters.drop(Drop.MALFORMED)

    def datagrams_to_send(self, now: float) -> list[tuple[bytes, Address]]:
        """What may go to the network now."""
        self._now = now
        out = self._outbox
        self._outbox = []
        session = self._session
        if session is not None and self.state in (ClientState.FINISHING, ClientState.CONNECTED):
            while (datagram := session.next_datagram(now)) is not None:
                out.append(datagram)
            self._look_for_end(now)
        count = self._counters.count
        count["datagrams_sent"] += len(out)
        count["bytes_sent"] += sum(map(len, out))
        return [(datagram, self._address) for datagram in out]

    def next_timer(self) -> float | None:
        """When to call `handle_timer`, on the clock of `now`; None for never."""
        match self.state:
            case ClientState.IDLE:
                return None
            case ClientState.GREETING | ClientState.PROVING:
                return min(self._retry_at, self._deadline)
            case ClientState.WAITING | ClientState.CLOSING:
                return self._retry_at
        when = self._session.timer(self._now) if self._session else self._deadline
        return min(when, self._deadline) if self.state is ClientState.FINISHING else when

    def handle_timer(self, now: float) -> None:
        """Do what is due at `now`; harmless if nothing is."""
        self._now = now
        match self.state:
            case ClientState.IDLE:
                return
            case ClientState.GREETING | ClientState.PROVING:
                if now >= self._deadline:
                    self._fail(now)
                elif now >= self._retry_at:
                    self._flight_once = False
                    self._send_flight(now)
            case ClientState.WAITING:
                if now >= self._retry_at:
                    self._advance(ClientInput.RETRY)
                    self._greet(now)
            case ClientState.CLOSING:
                if now >= self._retry_at:
                    if self._closes_left:
                        self._send_close(now)
                    else:
                        self._closed()
            case _:
                if self.state is ClientState.FINISHING and now >= self._deadline:
                    self._fail(now)
                elif self._session is not None:
                    self._session.handle_timer(now)
                    self._look_for_end(now)

    # Handshake

    def _advance(self, happened: ClientInput) -> None:
        self.state = advance(CLIENT, self.state, happened)

    def _expects(self, happened: ClientInput) -> bool:
        if (self.state, happened) in CLIENT:
            return True
        self._counters.drop(Drop.UNEXPECTED)
        return False

    def _greet(self, now: float) -> None:
        self._cid = self._randomness.bytes(CID_SIZE)
        self._handshake = ClientHandshake(self.config.mode, self._identity, self._cid, self._randomness)
        self._session = None
        self._peer = None
        self._bad_offers = 0
        self._why = HandshakeFailed("the server does not answer")
        self._assembly = Assembly()
        self._deadline = now + self.config.attempt_timeout
        self._counters.count["handshakes_begun"] += 1
        self._begin_flight([self._handshake.hello.to_bytes()], now)

    def _begin_flight(self, flight: list[bytes], now: float) -> None:
        self._flight = flight
        self._flight_once = True
        self._retry_after = FIRST_RETRY
        self._send_flight(now)

    def _send_flight(self, now: float) -> None:
        self._outbox = list(self._flight)
        self._flight_at = now
        self._retry_at = now + self._retry_after
        self._retry_after = min(self._retry_after * 2, LAST_RETRY)

    def _on_cookie(self, data: bytes, now: float) -> None:
        cookie = Cookie.parse(data)
        if not self._expects(ClientInput.COOKIE):
            return
        handshake = self._handshake
        if (
            handshake is None
            or cookie.client_cid != self._cid
            or not hmac.compare_digest(cookie.nonce, handshake.hello.nonce)
        ):
            self._counters.drop(Drop.UNEXPECTED)
            return
        self._rtt = now - self._flight_at if self._flight_once else None
        self._advance(ClientInput.COOKIE)
        body = handshake.proof(cookie.cookie)
        self._begin_flight(proof_datagrams(handshake.hello, cookie.cookie, body), now)

    def _on_offer(self, data: bytes, now: float) -> None:
        piece = ServerPiece.parse(data)
        if not self._expects(ClientInput.OFFER):
            return
        handshake = self._handshake
        if handshake is None or piece.client_cid != self._cid:
            self._counters.drop(Drop.UNEXPECTED)
            return
        try:
            body = self._assembly.add(piece.index, piece.count, piece.data)
        except Malformed:
            self._assembly = Assembly()  # one wrong piece must not keep the right ones out
            raise
        if body is None:
            return
        self._assembly = Assembly()
        try:
            agreed = handshake.accept(
                body, self._certificates, server_name=self._server_name, at=self._wall(), now=now
            )
        except HandshakeRefused as refused:
            self._counters.drop(refused.drop)
            self._why = HandshakeFailed(f"the server's offer is refused: {refused}")
            self._bad_offers += 1
            if self._bad_offers >= MAX_BAD_OFFERS:
                self._fail(now)
            return
        self._advance(ClientInput.OFFER)
        self._peer = agreed.peer
        link = Link(agreed.server_cid, agreed.secrets.client, agreed.secrets.server)
        self._session = ClientSession(self.config, self._counters, link, now=now, rtt=self._rtt)
        self._session.queue_control(Frame.FINISHED, agreed.confirmation + agreed.finished)
        self._handshake = None
        self._flight = []
        self._outbox = []

    def _on_refusal(self, data: bytes) -> None:
        cid, nonce, reason = parse_refusal(data)
        handshake = self._handshake
        if (
            self.state is not ClientState.PROVING
            or handshake is None
            or cid != self._cid
            or not hmac.compare_digest(nonce, handshake.hello.nonce)
        ):
            self._counters.drop(Drop.UNEXPECTED)
            return
        # Anybody on the path may have said it: it explains a failure, it does not cause one.
        self._why = HandshakeFailed(_HINTS[reason], reason)

    def _fail(self, now: float) -> None:
        self._advance(ClientInput.FAILED)
        self._events.append(self._why)
        self._failures += 1
        self._wait(now)

    def _wait(self, now: float) -> None:
        longest = min(self.config.reconnect_min * 2 ** min(self._failures, 16), self.config.reconnect_max)
        chance = int.from_bytes(self._randomness.bytes(2), "big") / 65536
        self._retry_at = now + longest * (1 - chance / 2)
        self._session = None
        self._handshake = None
        self._outbox = []
        self._flight = []

    # Session

    def _on_data(self, data: bytes, now: float) -> None:
        session = self._session
        if session is None:
            self._counters.drop(Drop.UNEXPECTED)
            return
        if len(data) <= DATA_OVERHEAD:
            raise Malformed("a packet without a frame")
        if data[1:9] != self._cid:
            self._counters.drop(Drop.UNKNOWN_CONNECTION)
            return
        if not session.receive(data, now):
            return
        if self.state is ClientState.FINISHING and session.accepted is not None and self._peer is not None:
            self._advance(ClientInput.ACCEPTED)
            self._failures = 0
            self._counters.count["handshakes"] += 1
            at = datetime.fromtimestamp(min(session.accepted.server_time_ms, 2**47) / 1000, UTC)
            self._events.append(Connected(self._peer, self._cid, at))
        if session.answers:
            for ident, payload in session.answers:
                self._events.append(MessageAnswered(self._first_id + ident, payload))
            session.answers.clear()
        self._look_for_end(now)

    def _look_for_end(self, now: float) -> None:
        session = self._session
        if session is None or session.ended is None:
            return
        if self.state is ClientState.CLOSING:
            self._closed()
            return
        if session.ended in (End.PROTOCOL, End.EXHAUSTED):
            self._outbox.append(session.close_datagram(session.ended, now))
        self._lose(session.ended, now)

    def _lose(self, reason: End, now: float) -> None:
        outbox = self._outbox
        connected = self.state is ClientState.CONNECTED
        self._advance(ClientInput.LOST)
        if connected:
            self._disconnected(reason)
        else:
            self._failures += 1
            self._events.append(HandshakeFailed(f"the session ended before it began: {reason}"))
        if reason in (End.REPLACED, End.REVOKED):
            self._failures += 3  # whoever has our name, or took it away, is not to be fought over it
        self._wait(now)
        self._outbox = outbox

    def _disconnected(self, reason: End) -> None:
        session = self._session
        if session is None:
            return
        unanswered = tuple(self._first_id + ident for ident in session.unanswered)
        self._first_id += session.sent_messages
        self._events.append(Disconnected(reason, self._cid, unanswered, self._peer))

    def _on_reset(self, data: bytes, now: float) -> None:
        cid, token = parse_reset(data)
        session = self._session
        if (
            session is None
            or session.accepted is None
            or cid != session.remote_cid
            or not hmac.compare_digest(token, session.accepted.reset_token)
        ):
            self._counters.drop(Drop.RESET)
            return
        self._counters.count["resets"] += 1
        session.end(End.RESET)
        self._look_for_end(now)

    def _send_close(self, now: float) -> None:
        if self._session is not None:
            self._outbox.append(self._session.close_datagram(End.CLOSED, now))
            self._closes_left -= 1
            self._retry_at = now + self._session.probe_timeout

    def _closed(self) -> None:
        self._advance(ClientInput.CLOSED)
        if self._session is not None and self._session.established:
            self._disconnected(End.CLOSED)
        self._session = None
