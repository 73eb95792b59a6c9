"""A server of the channel: one process's connections. Sans-IO.

What a stranger can cost: a HELLO, one keyed hash and a COOKIE of 66 bytes for 1,200; a PROOF piece with a good
cookie, one of `max_half_open` places; a whole PROOF, signatures, within `source_rate` and `handshake_share`. DATA of
unknown connections costs a look-up, and is not answered.
"""

from __future__ import annotations

import heapq
import time
from collections import OrderedDict, deque
from collections.abc import Callable
from datetime import datetime
from hashlib import blake2s

from rosbridge_eth.channel import wire
from rosbridge_eth.channel.admission import Address, Cookies, Sources, TokenBucket
from rosbridge_eth.channel.client import ACCEPTED_SIZE, utc_now
from rosbridge_eth.channel.events import (
    AddressChanged,
    Connected,
    Counters,
    Disconnected,
    Drop,
    End,
    Event,
    Message,
    NotConnected,
    ServerConfig,
    Statistics,
)
from rosbridge_eth.channel.handshake import HandshakeRefused, Randomness, ServerHandshake
from rosbridge_eth.channel.session import LENGTH_SIZE, NEVER, Budget, Session
from rosbridge_eth.channel.states import SERVER, ServerInput, ServerState, advance
from rosbridge_eth.channel.wire import Assembly, Hello, Kind, Malformed, Reason
from rosbridge_eth.identity import Identity, PeerIdentity, Role, Trust

OFFER_INTERVAL = 0.04  # s: an OFFER is repeated no faster, however often its PROOF comes
AMPLIFICATION = 3  # RFC 9000, 8: bytes sent to an address that is not proven, per byte received from it
SHARE_BURST = 0.25  # s of handshake work that may come at once
PATIENCE = 5.0  # s in line, after which a client is about to begin anew: to answer it would be work for nothing
FINISHED_SIZE = 64
_FINISHED = wire.SEGMENT_HEADER.pack(wire.Frame.SEGMENT, 0) + FINISHED_SIZE.to_bytes(LENGTH_SIZE, "big")


def cookie_key(identity: Identity) -> bytes:
    """A cookie key for `Server` that all processes of a server, and its next start, derive alike."""
    return blake2s(identity.signing_key.to_bytes(), person=b"rbe-key2").digest()


class _HalfOpen:
    """A handshake with a good cookie: pieces of its PROOF, then the OFFER and the connection it made."""

    __slots__ = (
        "assembly", "began", "connection", "cookie", "hello", "offer", "offered_at", "offers", "state", "waits",
    )  # fmt: skip

    def __init__(self, hello: Hello, cookie: bytes, now: float) -> None:
        self.state = ServerState.ASSEMBLING
        self.waits = False  # its PROOF is whole, and stands in line for its share of the time
        self.hello, self.cookie = hello, cookie
        self.began = now
        self.assembly = Assembly()
        self.connection: _Connection | None = None
        self.offer: list[bytes] = []
        self.offers, self.offered_at = 0, now


class _Connection:
    """A session, and where its client is: the address that sent the newest authentic packet (WireGuard's rule).

    Until a packet first sent to that address, `first_there` or a later one, is acknowledged, only `allowance` bytes
    more go there.
    """

    __slots__ = (
        "address", "allowance", "cid", "first_there", "half_open_key", "peer", "proven", "scheduled", "session",
        "state",
    )  # fmt: skip

    def __init__(self, cid: bytes, key: tuple[Address, bytes], peer: PeerIdentity, session: Session) -> None:
        self.cid = cid
        self.half_open_key = key
        self.peer = peer
        self.session = session
        self.state = ServerState.OFFERED
        self.address = self.proven = key[0]  # proven by the cookie
        self.allowance = 0
        self.first_there = 0
        self.scheduled = NEVER

    @property
    def quota(self) -> float:
        """Bytes that may go to `address`."""
        return NEVER if self.address == self.proven else self.allowance


class Server:
    """In a loop: `receive_datagram`, `handle_timer`, `next_event`, `datagrams_to_send`. See Client for clocks.

    cookie_key: 32 secret bytes, the same for all processes that share the port and across restarts
    (`cookie_key(identity)`). stopwatch: measures what a handshake costs. Not thread-safe.
    """

    def __init__(
        self, config: ServerConfig, identity: Identity, trust: Trust, cookie_key: bytes, now: float, *,
        wall: Callable[[], datetime] = utc_now, randomness: Randomness | None = None,
        stopwatch: Callable[[], float] = time.perf_counter,
    ) -> None:  # fmt: skip
        self.config = config
        self._identity, self._trust = identity, trust
        self._wall, self._randomness, self._stopwatch = wall, randomness or Randomness(), stopwatch
        self._cookies = Cookies(cookie_key, config.cookie_lifetime)
        self._sources = Sources(config.source_rate, config.source_burst, config.max_sources)
        self._share = TokenBucket(config.handshake_share, SHARE_BURST, now)
        self._budget = Budget(config.max_total_bytes)
        self._counters = Counters()
        self._events: deque[Event] = deque()
        self._outbox: list[tuple[bytes, Address]] = []
        self._half_open: OrderedDict[tuple[Address, bytes], _HalfOpen] = OrderedDict()
        self._line: deque[tuple[_HalfOpen, tuple[Address, bytes], bytes]] = deque()
        self._finished: OrderedDict[bytes, float] = OrderedDict()  # client nonces, until their cookies expire
        self._connections: dict[bytes, _Connection] = {}
        self._by_peer: dict[tuple[Role, str], bytes] = {}
        self._touched: dict[bytes, _Connection] = {}
        self._timers: list[tuple[float, int, bytes]] = []
        self._timer_count = 0

    # What the program calls

    def next_event(self) -> Event | None:
        """The oldest event that was not fetched, or None."""
        if not self._events:
            return None
        event = self._events.popleft()
        if isinstance(event, Message) and (found := self._connections.get(event.connection)) is not None:
            found.session.taken(event.payload)
            self._touched[event.connection] = found
        return event

    def writable(self, connection: bytes, size: int | None = None) -> bool:
        """Whether `send` takes a message of `size` bytes (default: the longest) at this moment."""
        found = self._connections.get(connection)
        size = self.config.max_message if size is None else size
        return found is not None and found.state is ServerState.CONNECTED and found.session.has_room(size)

    def send(self, connection: bytes, payload: bytes) -> None:
        """Send a message of 0 to max_message bytes. NotConnected if the session is gone, Full if `writable` says no."""
        found = self._connections.get(connection)
        if found is None or found.state is not ServerState.CONNECTED:
            raise NotConnected("the session is gone")
        found.session.send(payload)
        self._touched[connection] = found
        self._counters.count["messages_sent"] += 1

    def close_connection(self, connection: bytes, now: float, reason: End = End.CLOSED) -> None:
        """End one session and tell the client; nothing happens if it is gone."""
        found = self._connections.get(connection)
        if found is not None:
            self._remove(found, reason)

    def close_peer(self, name: str, now: float, *, role: Role = Role.ROBOT, reason: End = End.REVOKED) -> None:
        """End the session of an identity, if it has one here, and those it is about to have."""
        for connection in list(self._connections.values()):
            if connection.peer.name == name and connection.peer.role is role:
                self._remove(connection, reason)

    def close(self, now: float) -> None:
        """End every session and tell the clients."""
        for connection in list(self._connections.values()):
            self._remove(connection, End.CLOSED)

    def address_of(self, connection: bytes) -> Address | None:
        """Where the client of a connection is; None if the connection is gone."""
        found = self._connections.get(connection)
        return None if found is None else found.address

    def statistics(self) -> Statistics:
        return self._counters.snapshot(
            connections=len(self._by_peer), half_open=len(self._half_open), held_bytes=self._budget.used
        )

    # What the network and the clock call

    def receive_datagram(self, data: bytes, address: Address, now: float) -> None:
        """Take what came; anything that is not right is dropped and counted."""
        self._counters.count["datagrams_received"] += 1
        self._counters.count["bytes_received"] += len(data)
        kind = data[0] if data else 0
        try:
            if kind == Kind.DATA:
                self._on_data(data, address, now)
            elif kind == Kind.HELLO:
                self._on_hello(Hello.parse(data), address, now)
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
                while connection.quota >= wire.DATAGRAM_SIZE and (datagram := session.next_datagram(now)) is not None:
                    connection.allowance -= len(datagram)
                    self._outbox.append((datagram, connection.address))
            if session.ended is not None:
                self._remove(connection, session.ended)
            else:
                self._schedule(connection, now)
        out, self._outbox = self._outbox, []
        self._counters.count["datagrams_sent"] += len(out)
        self._counters.count["bytes_sent"] += sum(len(datagram) for datagram, _ in out)
        return out

    def next_timer(self) -> float | None:
        """When to call `handle_timer`, on the clock of `now`; None for never."""
        when = self._timers[0][0] if self._timers else NEVER
        if self._half_open:
            when = min(when, next(iter(self._half_open.values())).began + self.config.half_open_timeout)
        if self._line:
            when = min(when, self._share.ready_at())
        return None if when == NEVER else when

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
            half_open, key, body = self._line.popleft()
            if half_open.state is not ServerState.ASSEMBLING:
                continue
            if now - half_open.began > PATIENCE:
                self._give_up(key, half_open)
            else:
                half_open.waits = False
                self._answer_proof(half_open, key, body, now)
        while self._timers and self._timers[0][0] <= now:
            when, _, cid = heapq.heappop(self._timers)
            connection = self._connections.get(cid)
            if connection is None or connection.scheduled != when:
                continue
            connection.scheduled = NEVER
            session = connection.session
            session.handle_timer(now)
            if now >= session.last_received + self.config.idle_timeout:
                session.end(End.SILENT)
            self._touched[cid] = connection

    def _schedule(self, connection: _Connection, now: float) -> None:
        """Put the connection's timer into the heap if it is earlier than the one that is there."""
        session = connection.session
        when = session.last_received + self.config.idle_timeout
        if connection.quota >= wire.DATAGRAM_SIZE:  # else it is the client's turn
            when = min(when, session.timer(now))
        if when < connection.scheduled:
            connection.scheduled = when
            self._timer_count += 1
            heapq.heappush(self._timers, (when, self._timer_count, connection.cid))
            if len(self._timers) > 64 + 8 * len(self._connections):
                known = self._connections
                self._timers = [t for t in self._timers if t[2] in known and known[t[2]].scheduled == t[0]]
                heapq.heapify(self._timers)

    # Handshake

    def _on_hello(self, hello: Hello, address: Address, now: float) -> None:
        if hello.mode not in self.config.modes:
            self._counters.drop(Drop.MODE)
            return
        cookie = self._cookies.make(address, hello, now)
        self._counters.count["cookies"] += 1
        self._outbox.append((wire.Cookie(hello.client_cid, hello.nonce, cookie).to_bytes(), address))

    def _on_proof(self, data: bytes, address: Address, now: float) -> None:
        hello, cookie, piece = wire.parse_proof(data)
        drop = self._counters.drop
        if hello.mode not in self.config.modes:
            drop(Drop.MODE)
            return
        if not self._cookies.holds(cookie, address, hello, now):
            drop(Drop.COOKIE)
            return
        # From here on the sender has shown that it receives at its address.
        if hello.nonce in self._finished:
            drop(Drop.REPLAYED_HANDSHAKE)
            return
        key = (address, hello.client_cid)
        half_open = self._half_open.get(key)
        if half_open is not None and half_open.hello != hello:
            drop(Drop.UNEXPECTED)
            return
        if half_open is None:
            if len(self._half_open) >= self.config.max_half_open:
                drop(Drop.HALF_OPEN)
                return
            if not self._sources.take(address, now):
                drop(Drop.SOURCE_LIMIT)
                return
            half_open = self._half_open[key] = _HalfOpen(hello, cookie, now)
            self._counters.count["handshakes_begun"] += 1
        if half_open.state is ServerState.OFFERED:
            if now - half_open.offered_at >= OFFER_INTERVAL:
                self._offer(half_open, address, now)
            return
        if half_open.waits or (body := half_open.assembly.add(piece)) is None:
            return
        half_open.cookie = cookie  # what the body's signature covers, should the client have been given two
        if self._line or self._share.available(now) <= 0:
            # Many robots begin at once, after a power cut: in line they are served as fast as the share allows,
            # turned away they would come back later and later. The line is no longer than max_half_open.
            half_open.waits = True
            self._line.append((half_open, key, body))
        else:
            self._answer_proof(half_open, key, body, now)

    def _give_up(self, key: tuple[Address, bytes], half_open: _HalfOpen) -> None:
        """Its turn did not come in time. That is no failure of the source's."""
        self._counters.drop(Drop.BUSY)
        half_open.state = advance(SERVER, half_open.state, ServerInput.EXPIRED)
        self._sources.give_back(key[0])
        del self._half_open[key]

    def _answer_proof(self, half_open: _HalfOpen, key: tuple[Address, bytes], body: bytes, now: float) -> None:
        began = self._stopwatch()
        try:
            self._examine_proof(half_open, key, body, now)
        except HandshakeRefused as refused:
            self._counters.drop(refused.drop)
            half_open.state = advance(SERVER, half_open.state, ServerInput.REFUSED)
            del self._half_open[key]
            if refused.hint is not None:
                hello = half_open.hello
                self._outbox.append((wire.Refusal(hello.client_cid, hello.nonce, refused.hint).to_bytes(), key[0]))
        self._share.charge(self._stopwatch() - began)

    def _examine_proof(self, half_open: _HalfOpen, key: tuple[Address, bytes], body: bytes, now: float) -> None:
        if len(self._connections) >= self.config.max_connections:
            raise HandshakeRefused(Drop.CONNECTIONS, "no room for another connection", Reason.FULL)
        cid = self._new_cid()
        handshake = ServerHandshake(
            half_open.hello, half_open.cookie, body, identity=self._identity, trust=self._trust,
            roles=self.config.roles, server_cid=cid, randomness=self._randomness, at=self._wall(),
        )  # fmt: skip

        def admit(frames: bytes) -> bool:
            """Nothing is taken from a client before its FINISHED, which is the first message of its stream."""
            if len(frames) != len(_FINISHED) + FINISHED_SIZE or not frames.startswith(_FINISHED):
                self._counters.drop(Drop.EARLY)
                return False
            try:
                handshake.confirm(frames[-FINISHED_SIZE:-32], frames[-32:])
            except HandshakeRefused as refused:
                self._counters.drop(refused.drop)
                return False
            return True

        session = Session(
            self.config, self._counters, half_open.hello.client_cid, handshake.secrets.server, handshake.secrets.client,
            now=now, rtt=None, expires=now + self.config.session_seconds, budget=self._budget, admit=admit,
        )  # fmt: skip
        half_open.state = advance(SERVER, half_open.state, ServerInput.PROOF)
        half_open.offer = wire.offer_datagrams(half_open.hello.client_cid, handshake.offer)
        half_open.connection = self._connections[cid] = _Connection(cid, key, handshake.peer, session)
        self._offer(half_open, key[0], now)

    def _offer(self, half_open: _HalfOpen, address: Address, now: float) -> None:
        half_open.offers += 1
        half_open.offered_at = now
        self._outbox += [(datagram, address) for datagram in half_open.offer]

    def _new_cid(self) -> bytes:
        while True:
            cid = bytes((self.config.worker,)) + self._randomness.bytes(wire.CID_SIZE - 1)
            if cid not in self._connections:
                return cid

    # Sessions

    def _on_data(self, data: bytes, address: Address, now: float) -> None:
        if len(data) <= wire.DATA_OVERHEAD:
            raise Malformed("a packet without a frame")
        connection = self._connections.get(data[1:9])
        if connection is None:
            self._counters.drop(Drop.UNKNOWN_CONNECTION)
            return
        session = connection.session
        if not session.receive(data, now):
            return
        self._touched[connection.cid] = connection
        if connection.state is ServerState.OFFERED:
            self._establish(connection, now)
        for payload in session.messages:
            self._counters.count["messages_received"] += 1
            self._events.append(Message(connection.cid, payload, connection.peer))
        session.messages.clear()
        self._look_at_address(connection, len(data), address, now)
        if session.ended is not None:
            self._remove(connection, session.ended)

    def _establish(self, connection: _Connection, now: float) -> None:
        """The client's FINISHED held: only now does this session replace another of the same identity."""
        connection.state = advance(SERVER, connection.state, ServerInput.FINISHED)
        session = connection.session
        session.taken(session.messages.pop(0))
        half_open = self._half_open.pop(connection.half_open_key)
        if half_open.offers == 1:
            session.measured(now - half_open.offered_at)
        self._sources.give_back(connection.half_open_key[0])
        self._finished[half_open.hello.nonce] = now
        who = (connection.peer.role, connection.peer.name)
        older = self._connections.get(self._by_peer.get(who, b""))
        if older is not None:
            self._remove(older, End.REPLACED)
        self._by_peer[who] = connection.cid
        session.send(int(self._wall().timestamp() * 1000).to_bytes(ACCEPTED_SIZE, "big"))
        self._counters.count["handshakes"] += 1
        self._events.append(Connected(connection.peer, connection.cid))

    def _look_at_address(self, connection: _Connection, size: int, address: Address, now: float) -> None:
        session = connection.session
        if address != connection.address and session.newest:  # an older one came late, or was held back by somebody
            connection.address = address
            connection.allowance = 0
            connection.first_there = session.next_number
        if connection.address == connection.proven:
            return
        if session.largest_acked >= connection.first_there:
            connection.proven = connection.address
            self._counters.count["address_changes"] += 1
            self._events.append(AddressChanged(connection.cid, connection.peer, connection.address))
        elif address == connection.address:
            connection.allowance += AMPLIFICATION * size
            datagram = session.challenge(now)  # shorter than any packet that came
            connection.allowance -= len(datagram)
            self._outbox.append((datagram, address))

    def _remove(self, connection: _Connection, reason: End) -> None:
        was_connected = connection.state is ServerState.CONNECTED
        if was_connected and reason is not End.CLOSED_BY_PEER and connection.quota >= wire.DATA_OVERHEAD + 2:
            self._outbox.append((connection.session.close_datagram(reason), connection.address))
        connection.state = advance(SERVER, connection.state, ServerInput.CLOSED)
        self._half_open.pop(connection.half_open_key, None)
        self._forget(connection)
        if was_connected:
            self._events.append(Disconnected(reason, connection.cid, connection.peer))

    def _forget(self, connection: _Connection) -> None:
        connection.session.release()
        self._connections.pop(connection.cid, None)
        self._touched.pop(connection.cid, None)
        who = (connection.peer.role, connection.peer.name)
        if self._by_peer.get(who) == connection.cid:
            del self._by_peer[who]
