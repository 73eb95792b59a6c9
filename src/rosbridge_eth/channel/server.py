"""A server of the channel: one process's connections. Sans-IO.

What a stranger can cost: a HELLO, one keyed hash and a COOKIE of 66 bytes for
1,200; a PROOF piece with a good cookie, one of `max_half_open` places; a whole
PROOF, signatures, within `source_rate` and `handshake_share`. DATA of unknown
connections costs a look-up, and at most `reset_rate` resets a second.
"""

from __future__ import annotations

import heapq
import time
from collections import OrderedDict, deque
from collections.abc import Callable
from datetime import UTC, datetime
from hashlib import blake2s

from rosbridge_eth.channel.admission import Address, Cookies, Sources, TokenBucket
from rosbridge_eth.channel.events import (
    AddressChanged,
    Connected,
    Counters,
    Disconnected,
    Drop,
    End,
    Event,
    MessageReceived,
    ServerConfig,
    Statistics,
)
from rosbridge_eth.channel.handshake import (
    HandshakeRefused,
    Randomness,
    ServerHandshake,
    VerifiedCertificates,
)
from rosbridge_eth.channel.session import Accepted, Budget, Link, ServerSession
from rosbridge_eth.channel.states import SERVER, ServerInput, ServerState, advance
from rosbridge_eth.channel.wire import (
    CID_SIZE,
    DATA_OVERHEAD,
    Assembly,
    Cookie,
    Frame,
    Hello,
    Kind,
    Malformed,
    Piece,
    Reason,
    offer_datagrams,
    refusal_datagram,
    reset_datagram,
)
from rosbridge_eth.identity import Identity, PeerIdentity, Role, Trust

__all__ = ["Server", "cookie_key"]

OFFER_INTERVAL = 0.1  # s: an OFFER is repeated no faster, however often its PROOF comes
CHALLENGE_INTERVAL = 0.2  # s
AMPLIFICATION = 3  # RFC 9000, 8: bytes sent to an address that is not proven, per byte received from it
SHARE_BURST = 0.25  # s of handshake work that may come at once
PATIENCE = 5.0  # s in line, after which a client is about to begin anew: to answer it would be work for nothing


def cookie_key(identity: Identity) -> bytes:
    """A cookie key for `Server` that all processes of a server, and its next start, derive alike."""
    return blake2s(identity.signing_key.to_bytes(), person=b"rbe-key1").digest()


def _wall() -> datetime:
    return datetime.now(UTC)


class _HalfOpen:
    """A handshake with a good cookie: pieces of its PROOF, then the OFFER and the connection it made."""

    __slots__ = ("assembly", "began", "connection", "nonce", "offer", "offered_at", "state", "waits")

    def __init__(self, nonce: bytes, now: float) -> None:
        self.state = ServerState.ASSEMBLING
        self.waits = False  # its PROOF is whole, and stands in line for its share of the time
        self.nonce = nonce
        self.began = now
        self.assembly = Assembly()
        self.connection: _Connection | None = None
        self.offer: list[bytes] = []
        self.offered_at = now


class _Candidate:
    """An address a connection's packets come from, and which is not proven yet."""

    __slots__ = ("address", "asked_at", "challenge", "received", "sent")

    def __init__(self, address: Address, challenge: bytes) -> None:
        self.address = address
        self.challenge = challenge
        self.received = 0
        self.sent = 0
        self.asked_at = -1e9


class _Connection:
    __slots__ = ("address", "candidate", "cid", "half_open_key", "peer", "scheduled", "session", "state")

    def __init__(
        self, cid: bytes, address: Address, peer: PeerIdentity, half_open_key: tuple[Address, bytes]
    ) -> None:
        self.cid = cid
        self.address = address
        self.peer = peer
        self.half_open_key = half_open_key
        self.state = ServerState.OFFERED
        self.candidate: _Candidate | None = None
        self.session: ServerSession
        self.scheduled = float("inf")


class Server:
    """In a loop: `receive_datagram`, `handle_timer`, `next_event`, `datagrams_to_send`. See Client for clocks.

    cookie_key: 32 secret bytes, the same for all processes that share the port
    and across restarts (`cookie_key(identity)`), or robots will wait for their
    timeouts where a reset would have told them. stopwatch: measures what a
    handshake costs. Not thread-safe.
    """

    def __init__(
        self,
        config: ServerConfig,
        identity: Identity,
        trust: Trust,
        cookie_key: bytes,
        now: float,
        *,
        wall: Callable[[], datetime] = _wall,
        randomness: Randomness | None = None,
        stopwatch: Callable[[], float] = time.perf_counter,
    ) -> None:
        self.config = config
        self._identity = identity
        self._certificates = VerifiedCertificates(
            trust, capacity=config.max_certificates, recheck=config.certificate_recheck
        )
        self._wall = wall
        self._randomness = randomness or Randomness()
        self._stopwatch = stopwatch
        self._cookies = Cookies(cookie_key, config.cookie_lifetime)
        self._sources = Sources(config.source_rate, config.source_burst, config.max_sources)
        self._share = TokenBucket(config.handshake_share, SHARE_BURST, now)
        self._resets = TokenBucket(config.reset_rate, config.reset_rate, now)
        self._budget = Budget(config.max_total_bytes)
        self._counters = Counters()
        self._events: deque[Event] = deque()
        self._outbox: list[tuple[bytes, Address]] = []
        self._half_open: OrderedDict[tuple[Address, bytes], _HalfOpen] = OrderedDict()
        self._line: deque[tuple[_HalfOpen, tuple[Address, bytes], Piece, bytes]] = deque()
        self._finished: OrderedDict[bytes, float] = OrderedDict()  # client nonces, until their cookies expire
        self._connections: dict[bytes, _Connection] = {}
        self._by_peer: dict[tuple[Role, str], bytes] = {}
        self._touched: dict[bytes, _Connection] = {}
        self._timers: list[tuple[float, int, bytes]] = []
        self._timer_count = 0

    # What the program calls

    def next_event(self) -> Event | None:
        """The oldest event that was not fetched, or None."""
        return self._events.popleft() if self._events else None

    def reply(self, connection: bytes, message_id: int, payload: bytes) -> None:
        """Answer a message, once, after its commit. Nothing happens if the connection is gone.

        payload: 0 to max_message bytes. ValueError if that message is not waiting for an answer.
        """
        if len(payload) > self.config.max_message:
            raise ValueError(f"an answer is at most {self.config.max_message} bytes, not {len(payload)}")
        found = self._connections.get(connection)
        if found is None:
            return
        found.session.reply(message_id, bytes(payload))
        self._touched[connection] = found

    def close_connection(self, connection: bytes, now: float, reason: End = End.CLOSED) -> None:
        """End one session and tell the client; nothing happens if it is gone."""
        found = self._connections.get(connection)
        if found is not None:
            self._remove(found, reason, now, tell=True)

    def close_peer(
        self, name: str, now: float, *, role: Role = Role.ROBOT, reason: End = End.REVOKED
    ) -> None:
        """End the session of an identity, if it has one here, and those it is about to have."""
        for connection in list(self._connections.values()):
            if connection.peer.name == name and connection.peer.role is role:
                self._remove(connection, reason, now, tell=True)

    def close(self, now: float) -> None:
        """End every session and tell the clients."""
        for connection in list(self._connections.values()):
            self._remove(connection, End.CLOSED, now, tell=True)

    def peers(self) -> list[PeerIdentity]:
        """Who has a session here."""
        return [c.peer for c in self._connections.values() if c.state is ServerState.CONNECTED]

    def address_of(self, connection: bytes) -> Address | None:
        """Where the client of a connection was proven to be last; None if the connection is gone."""
        found = self._connections.get(connection)
        return None if found is None else found.address

    def statistics(self) -> Statistics:
        return self._counters.snapshot(
            connections=len(self._by_peer), half_open=len(self._half_open), held_bytes=self._budget.used
        )

    # What the network and the clock call

    def receive_datagram(self, data: bytes, address: Address, now: float) -> None:
        """Take what came; anything that is not right is dropped and counted."""
        count = self._counters.count
        count["datagrams_received"] += 1
        count["bytes_received"] += len(data)
        try:
            kind = data[0] if data else 0
            if kind & 0xF0 == Kind.DATA:
                self._on_data(data, address, now)
            elif kind == Kind.HELLO:
                self._on_hello(data, address, now)
            elif kind == Kind.PROOF:
                self._on_proof(data, address, now)
            else:
                raise Malformed("not for a server")
        except Malformed:
            self._counters.drop(Drop.MALFORMED)

    def datagrams_to_send(self, now: float) -> list[tuple[bytes, Address]]:
        """What may go to the network now."""
        touched, self._touched = self._touched, {}
        for connection in touched.values():
            session = connection.session
            if connection.state is ServerState.CONNECTED:
                address = connection.address
                while (datagram := session.next_datagram(now)) is not None:
                    self._outbox.append((datagram, address))
            if session.ended is not None:
                self._remove(connection, session.ended, now, tell=True)
            else:
                self._schedule(connection, now)
        out, self._outbox = self._outbox, []
        count = self._counters.count
        count["datagrams_sent"] += len(out)
        count["bytes_sent"] += sum(len(datagram) for datagram, _ in out)
        return out

    def next_timer(self) -> float | None:
        """When to call `handle_timer`, on the clock of `now`; None for never."""
        times = []
        if self._timers:
            times.append(self._timers[0][0])
        if self._half_open:
            oldest = next(iter(self._half_open.values()))
            times.append(oldest.began + self.config.half_open_timeout)
        if self._line:
            times.append(self._share.ready_at())
        return min(times, default=None)

    def handle_timer(self, now: float) -> None:
        """Do what is due at `now`; harmless if nothing is."""
        while self._half_open:
            key, oldest = next(iter(self._half_open.items()))
            if now < oldest.began + self.config.half_open_timeout:
                break
            if oldest.waits:
                self._give_up(key, oldest)
                continue
            oldest.state = advance(SERVER, oldest.state, ServerInput.EXPIRED)
            if oldest.connection is not None:
                self._forget(oldest.connection)
            self._half_open.pop(key, None)
        while self._finished and now > next(iter(self._finished.values())) + self.config.cookie_lifetime:
            self._finished.popitem(last=False)
        while self._line and self._share.available(now) > 0:
            half_open, key, piece, body = self._line.popleft()
            if half_open.state is not ServerState.ASSEMBLING:
                continue
            if now - half_open.began > PATIENCE:
                self._give_up(key, half_open)
            else:
                half_open.waits = False
                self._answer_proof(piece, body, key, half_open, now)
        while self._timers and self._timers[0][0] <= now:
            when, _, cid = heapq.heappop(self._timers)
            connection = self._connections.get(cid)
            if connection is None or connection.scheduled != when:
                continue
            connection.scheduled = float("inf")
            if connection.session.timer(now) <= now:
                connection.session.handle_timer(now)
            self._touched[cid] = connection

    def _schedule(self, connection: _Connection, now: float) -> None:
        """Put the connection's timer into the heap if it is earlier than the one that is there."""
        when = connection.session.timer(now)
        if when < connection.scheduled:
            connection.scheduled = when
            self._timer_count += 1
            heapq.heappush(self._timers, (when, self._timer_count, connection.cid))
            if len(self._timers) > 64 + 8 * len(self._connections):
                self._timers = [
                    entry
                    for entry in self._timers
                    if entry[2] in self._connections and self._connections[entry[2]].scheduled == entry[0]
                ]
                heapq.heapify(self._timers)

    # Handshake

    def _on_hello(self, data: bytes, address: Address, now: float) -> None:
        hello = Hello.parse(data)
        if hello.mode not in self.config.modes:
            self._counters.drop(Drop.VERSION_OR_MODE)
            return
        cookie = self._cookies.make(address, hello.mode, hello.client_cid, hello.nonce, now)
        self._counters.count["cookies"] += 1
        answer = Cookie(hello.client_cid, hello.nonce, cookie)
        self._outbox.append((answer.to_bytes(), address))

    def _on_proof(self, data: bytes, address: Address, now: float) -> None:
        piece = Piece.parse(data)
        drop = self._counters.drop
        if piece.mode not in self.config.modes:
            drop(Drop.VERSION_OR_MODE)
            return
        if not self._cookies.holds(
            piece.cookie, address, piece.mode, piece.client_cid, piece.nonce, now
        ):
            drop(Drop.COOKIE)
            return
        # From here on the sender has shown that it receives at its address.
        if piece.nonce in self._finished:
            drop(Drop.REPLAYED_HANDSHAKE)
            return
        key = (address, piece.client_cid)
        half_open = self._half_open.get(key)
        if half_open is not None and half_open.nonce != piece.nonce:
            drop(Drop.UNEXPECTED)
            return
        if half_open is None:
            if len(self._half_open) >= self.config.max_half_open:
                drop(Drop.HALF_OPEN)
                return
            if not self._sources.take(address, now):
                drop(Drop.SOURCE_LIMIT)
                return
            half_open = self._half_open[key] = _HalfOpen(piece.nonce, now)
            self._counters.count["handshakes_begun"] += 1
        if half_open.state is ServerState.OFFERED:
            if now - half_open.offered_at >= OFFER_INTERVAL:
                half_open.offered_at = now
                self._outbox += [(datagram, address) for datagram in half_open.offer]
            return
        if half_open.waits:
            return
        try:
            body = half_open.assembly.add(piece.index, piece.count, piece.data)
        except Malformed:
            half_open.assembly = Assembly()
            raise
        if body is None:
            return
        if self._line or self._share.available(now) <= 0:
            # Many robots begin at once, after a power cut: in line they are served as fast as the share allows,
            # turned away they would come back later and later. The line is no longer than max_half_open.
            half_open.waits = True
            self._line.append((half_open, key, piece, body))
            return
        self._answer_proof(piece, body, key, half_open, now)

    def _give_up(self, key: tuple[Address, bytes], half_open: _HalfOpen) -> None:
        """Its turn did not come in time. That is no failure of the source's."""
        self._counters.drop(Drop.BUSY)
        half_open.state = advance(SERVER, half_open.state, ServerInput.EXPIRED)
        self._sources.give_back(key[0])
        del self._half_open[key]

    def _answer_proof(
        self, piece: Piece, body: bytes, key: tuple[Address, bytes], half_open: _HalfOpen, now: float
    ) -> None:
        began = self._stopwatch()
        self._examine_proof(piece, body, key, half_open, now)
        self._share.charge(self._stopwatch() - began)

    def _examine_proof(
        self, piece: Piece, body: bytes, key: tuple[Address, bytes], half_open: _HalfOpen, now: float
    ) -> None:
        address = key[0]
        try:
            if len(self._connections) >= self.config.max_connections:
                raise HandshakeRefused(Drop.CONNECTIONS, "no room for another connection", Reason.FULL)
            cid = self._new_cid()
            handshake = ServerHandshake(
                Hello(piece.mode, piece.client_cid, piece.nonce),
                piece.cookie,
                body,
                identity=self._identity,
                certificates=self._certificates,
                roles=self.config.roles,
                server_cid=cid,
                randomness=self._randomness,
                at=self._wall(),
                now=now,
            )
        except HandshakeRefused as refused:
            self._counters.drop(refused.drop)
            half_open.state = advance(SERVER, half_open.state, ServerInput.REFUSED)
            del self._half_open[key]
            if refused.hint is not None:
                answer = refusal_datagram(piece.client_cid, piece.nonce, refused.hint)
                self._outbox.append((answer, address))
            return
        half_open.state = advance(SERVER, half_open.state, ServerInput.PROOF)
        half_open.assembly = Assembly()
        half_open.offer = offer_datagrams(piece.client_cid, handshake.offer)
        half_open.offered_at = now
        connection = _Connection(cid, address, handshake.peer, key)

        def confirm(confirmation: bytes, mac: bytes) -> bool:
            try:
                handshake.confirm(confirmation, mac)
            except HandshakeRefused:
                return False
            return True

        link = Link(piece.client_cid, handshake.secrets.server, handshake.secrets.client)
        connection.session = ServerSession(
            self.config, self._counters, link, now=now, budget=self._budget, confirm=confirm
        )
        half_open.connection = connection
        self._connections[cid] = connection
        self._outbox += [(datagram, address) for datagram in half_open.offer]

    def _new_cid(self) -> bytes:
        while True:
            cid = bytes((self.config.worker,)) + self._randomness.bytes(CID_SIZE - 1)
            if cid not in self._connections:
                return cid

    # Sessions

    def _on_data(self, data: bytes, address: Address, now: float) -> None:
        if len(data) <= DATA_OVERHEAD:
            raise Malformed("a packet without a frame")
        cid = data[1:9]
        connection = self._connections.get(cid)
        if connection is None:
            self._counters.drop(Drop.UNKNOWN_CONNECTION)
            # Another process may hold the connections of other numbers; their tokens are not to be told.
            if cid[0] == self.config.worker and self._resets.available(now) >= 1:
                self._resets.charge(1)
                self._counters.count["resets"] += 1
                self._outbox.append((reset_datagram(cid, self._cookies.reset_token(cid)), address))
            return
        session = connection.session
        if not session.receive(data, now):
            return
        self._touched[cid] = connection
        if connection.state is ServerState.OFFERED:
            self._establish(connection, now)
        if session.messages:
            for ident, payload in session.messages:
                self._events.append(MessageReceived(cid, ident, payload, connection.peer))
            session.messages.clear()
        if address != connection.address or session.path_responses:
            self._look_at_path(connection, len(data), address, now)
        if session.ended is not None:
            self._remove(connection, session.ended, now, tell=True)

    def _establish(self, connection: _Connection, now: float) -> None:
        """The client's FINISHED held: only now does this session replace another of the same identity."""
        connection.state = advance(SERVER, connection.state, ServerInput.FINISHED)
        half_open = self._half_open.pop(connection.half_open_key)
        self._sources.give_back(connection.half_open_key[0])
        self._finished[half_open.nonce] = now
        who = (connection.peer.role, connection.peer.name)
        older = self._connections.get(self._by_peer.get(who, b""))
        if older is not None:
            self._remove(older, End.REPLACED, now, tell=True)
        self._by_peer[who] = connection.cid
        config = self.config
        accepted = Accepted(
            self._cookies.reset_token(connection.cid),
            config.max_unanswered,
            config.max_unanswered_bytes,
            config.idle_timeout,
            int(self._wall().timestamp() * 1000),
        )
        connection.session.queue_control(Frame.ACCEPTED, accepted.frame()[1:])
        self._counters.count["handshakes"] += 1
        self._events.append(Connected(connection.peer, connection.cid))

    def _look_at_path(self, connection: _Connection, size: int, address: Address, now: float) -> None:
        """A client's packets come from another address: ask there, and move only when the answer comes from there.

        Until then at most three bytes go there for each that came, and all else goes to the proven address.
        """
        session = connection.session
        responses, session.path_responses = session.path_responses, []
        candidate = connection.candidate
        if candidate is not None and candidate.address == address and candidate.challenge in responses:
            connection.address = address
            connection.candidate = None
            session.path_changed(now)
            self._counters.count["address_changes"] += 1
            self._events.append(AddressChanged(connection.cid, connection.peer, address))
            return
        if address == connection.address:
            return
        if candidate is None or candidate.address != address:
            if not session.newest_packet:
                return  # an old packet that came late, or was held back by somebody
            candidate = connection.candidate = _Candidate(address, self._randomness.bytes(8))
        candidate.received += size
        if (
            session.ended is None
            and now - candidate.asked_at >= CHALLENGE_INTERVAL
            and candidate.sent + DATA_OVERHEAD + 9 <= AMPLIFICATION * candidate.received
        ):
            datagram = session.path_challenge(candidate.challenge, now)
            candidate.asked_at = now
            candidate.sent += len(datagram)
            self._outbox.append((datagram, address))

    def _remove(self, connection: _Connection, reason: End, now: float, *, tell: bool = False) -> None:
        was_connected = connection.state is ServerState.CONNECTED
        if tell and was_connected:
            self._outbox.append((connection.session.close_datagram(reason, now), connection.address))
        connection.state = advance(SERVER, connection.state, ServerInput.CLOSED)
        self._half_open.pop(connection.half_open_key, None)
        self._forget(connection)
        if was_connected:
            self._events.append(Disconnected(reason, connection.cid, (), connection.peer))

    def _forget(self, connection: _Connection) -> None:
        connection.session.release()
        self._connections.pop(connection.cid, None)
        self._touched.pop(connection.cid, None)
        who = (connection.peer.role, connection.peer.name)
        if self._by_peer.get(who) == connection.cid:
            del self._by_peer[who]
