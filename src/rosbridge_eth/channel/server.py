"""A server of the channel: one process's connections. Sans-IO.

What a stranger can cost: a HELLO, one keyed hash and a COOKIE of 51 bytes for 1,200; a PROOF piece with a good
cookie, one of `max_half_open` places; a whole PROOF, signatures, within `source_rate` and `handshake_share`. DATA of
unknown connections costs a look-up, and is not answered.
"""

from __future__ import annotations

import heapq
import time
from collections import Counter, OrderedDict, deque
from collections.abc import Callable
from datetime import datetime
from hashlib import blake2s

from rosbridge_eth.channel import events, wire
from rosbridge_eth.channel.admission import Address, Cookies, Sources, TokenBucket
from rosbridge_eth.channel.client import ACCEPTED_SIZE, utc_now
from rosbridge_eth.channel.events import Drop, End, Event, ServerConfig
from rosbridge_eth.channel.handshake import HandshakeRefused, Randomness, ServerHandshake
from rosbridge_eth.channel.session import MAX_MESSAGE, NEVER, Early, Session
from rosbridge_eth.channel.wire import Assembly, Hello, Kind, Malformed, Reason
from rosbridge_eth.identity import Identity, Trust

COOKIE_LIFETIME = 20.0  # s
HALF_OPEN_TIMEOUT = 10.0
IDLE_TIMEOUT = 30.0
"""s; a session without an authenticated packet for so long has ended."""
OFFER_INTERVAL = 0.04  # s: an OFFER is repeated no faster, however often its PROOF comes
AMPLIFICATION = 3  # RFC 9000, 8: bytes sent to an address that is not proven, per byte received from it
SHARE_BURST = 0.25  # s of handshake work that may come at once
PATIENCE = 5.0  # s in line, after which a client is about to begin anew: to answer it would be work for nothing
SWEEP = 0.5  # s between two looks for what is over: half-open, silent and expired
MAX_SOURCES = 4096


def cookie_key(identity: Identity) -> bytes:
    """A cookie key for `Server` that all processes of a server, and its next start, derive alike."""
    return blake2s(identity.signing_key.to_bytes(), person=b"rbe-key2").digest()


class _HalfOpen:
    """A handshake with a good cookie: pieces of its PROOF; the whole of it, in line; then an OFFER and a connection."""

    __slots__ = (
        "assembly", "began", "confirm", "connection", "cookie", "key", "offer", "offered_at", "offers", "proof",
    )  # fmt: skip
    offer: list[bytes]
    confirm: Callable[[bytes], None]

    def __init__(self, key: tuple[Address, Hello], cookie: bytes, now: float) -> None:
        self.key, self.cookie = key, cookie
        self.began = now
        self.assembly = Assembly()
        self.proof: bytes | None = None
        self.connection: _Connection | None = None
        self.offers, self.offered_at = 0, now


class _Connection:
    """A session, and where its client is: the address that sent the newest authentic packet (WireGuard's rule).

    A new address is proven when a packet first sent there, `first_there` or a later one, is acknowledged; until then
    only `allowance` bytes more go there. half_open: until the client's FINISHED holds.
    """

    __slots__ = ("address", "allowance", "cid", "first_there", "half_open", "scheduled", "session")

    def __init__(self, cid: bytes, half_open: _HalfOpen, session: Session) -> None:
        self.cid = cid
        self.half_open: _HalfOpen | None = half_open
        self.session = session
        self.address = half_open.key[0]  # proven by the cookie
        self.allowance = NEVER
        self.first_there = 0
        self.scheduled = NEVER


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
        self._cookies = Cookies(cookie_key, COOKIE_LIFETIME)
        self._sources = Sources(config.source_rate, config.source_burst, MAX_SOURCES)
        self._share = TokenBucket(config.handshake_share, SHARE_BURST, now)
        self._early = Early(config.max_early)
        self._counts: Counter[str] = Counter()
        self._events: deque[Event] = deque()
        self._outbox: list[tuple[bytes, Address]] = []
        self._half_open: dict[tuple[Address, Hello], _HalfOpen] = {}  # in the order of their beginning
        self._line: deque[_HalfOpen] = deque()
        self._finished: OrderedDict[bytes, float] = OrderedDict()  # client nonces, until their cookies expire
        self._connections: dict[bytes, _Connection] = {}
        self._by_name: dict[str, _Connection] = {}
        self._touched: dict[bytes, _Connection] = {}
        self._timers: list[tuple[float, bytes]] = []
        self._sweep_at = now

    # What the program calls

    def next_event(self) -> Event | None:
        """The oldest event that was not fetched, or None. Fetch them all in each turn: nothing bounds them."""
        return self._events.popleft() if self._events else None

    def _standing(self, connection: bytes) -> _Connection | None:
        found = self._connections.get(connection)
        return found if found is not None and found.half_open is None else None

    def writable(self, connection: bytes, size: int = MAX_MESSAGE) -> bool:
        """Whether `send` takes a message of `size` bytes at this moment."""
        found = self._standing(connection)
        return found is not None and found.session.has_room(size)

    def send(self, connection: bytes, payload: bytes) -> None:
        """Send a message of 0 to MAX_MESSAGE bytes. NotConnected if the session is gone, Full if `writable` says no."""
        found = self._standing(connection)
        if found is None:
            raise events.NotConnected("the session is gone")
        found.session.send(payload)
        self._touched[connection] = found
        self._counts["messages_sent"] += 1

    def close_connection(self, connection: bytes, reason: End = End.CLOSED) -> None:
        """End one session and tell the client; nothing happens if it is gone."""
        found = self._connections.get(connection)
        if found is not None:
            self._remove(found, reason)

    def close_peer(self, name: str, reason: End = End.REVOKED) -> None:
        """End the session of a robot, if it has one here, and those it is about to have."""
        for connection in list(self._connections.values()):
            if connection.session.peer.name == name:
                self._remove(connection, reason)

    def close(self) -> None:
        """End every session and tell the clients."""
        for connection in list(self._connections.values()):
            self._remove(connection, End.CLOSED)

    def address_of(self, connection: bytes) -> Address | None:
        """Where the client of a connection is; None if the connection is gone."""
        found = self._connections.get(connection)
        return None if found is None else found.address

    def statistics(self) -> Counter[str]:
        """What was counted since this server was made, each Drop among it, and what is there at this moment."""
        there = {"connections": len(self._by_name), "half_open": len(self._half_open), "early": self._early.kept}
        return Counter({**self._counts, **there})

    # What the network and the clock call

    def receive_datagram(self, data: bytes, address: Address, now: float) -> None:
        """Take what came; anything that is not right is dropped and counted."""
        self._counts["datagrams_received"] += 1
        self._counts["bytes_received"] += len(data)
        try:
            if data and data[0] == Kind.DATA:
                self._on_data(data, address, now)
            else:
                self._on_handshake(data, address, now)
        except Malformed:
            self._counts[Drop.MALFORMED] += 1
        except HandshakeRefused as refused:
            self._counts[refused.drop] += 1

    def datagrams_to_send(self, now: float) -> list[tuple[bytes, Address]]:
        """What may go to the network now."""
        touched, self._touched = self._touched, {}
        for connection in touched.values():
            session = connection.session
            while connection.allowance >= wire.DATAGRAM_SIZE and (datagram := session.next_datagram(now)) is not None:
                connection.allowance -= len(datagram)
                self._outbox.append((datagram, connection.address))
            if session.ended is not None:
                self._remove(connection, session.ended)
                continue
            # Where no more may go to its address, it is the client's turn.
            when = session.timer(now) if connection.allowance >= wire.DATAGRAM_SIZE else NEVER
            if when < connection.scheduled:
                connection.scheduled = when
                heapq.heappush(self._timers, (when, connection.cid))
        out, self._outbox = self._outbox, []
        self._counts["datagrams_sent"] += len(out)
        self._counts["bytes_sent"] += sum(len(datagram) for datagram, _ in out)
        return out

    def next_timer(self) -> float | None:
        """When to call `handle_timer`, on the clock of `now`; None for never."""
        when = self._timers[0][0] if self._timers else NEVER
        if self._half_open or self._connections:
            when = min(when, self._sweep_at)
        if self._line:
            when = min(when, self._share.ready_at())
        return None if when == NEVER else when

    def handle_timer(self, now: float) -> None:
        """Do what is due at `now`; harmless if nothing is."""
        if now >= self._sweep_at:
            self._sweep(now)
        self._serve_line(now)
        while self._timers and self._timers[0][0] <= now:
            when, cid = heapq.heappop(self._timers)
            connection = self._connections.get(cid)
            if connection is not None and connection.scheduled == when:
                connection.scheduled = NEVER
                connection.session.handle_timer(now)
                self._touched[cid] = connection

    def _sweep(self, now: float) -> None:
        self._sweep_at = now + SWEEP
        for half_open in list(self._half_open.values()):
            if now < half_open.began + HALF_OPEN_TIMEOUT:
                break
            if half_open.connection is not None:
                self._remove(half_open.connection, End.SILENT)
            elif half_open.proof is not None:
                self._give_up(half_open)
            else:
                del self._half_open[half_open.key]
        while self._finished and now > next(iter(self._finished.values())) + COOKIE_LIFETIME:
            self._finished.popitem(last=False)
        for connection in list(self._connections.values()):
            if connection.half_open is None and now >= connection.session.last_received + IDLE_TIMEOUT:
                self._remove(connection, End.SILENT)
            elif now >= connection.session.expires:
                self._remove(connection, End.EXPIRED)

    # Handshake

    def _on_handshake(self, data: bytes, address: Address, now: float) -> None:
        hello, rest = Hello.parse(data)
        if hello.mode not in self.config.modes:
            raise HandshakeRefused(Drop.MODE)
        if data[0] == Kind.HELLO and rest == wire.HELLO_PADDING:
            self._counts["cookies"] += 1
            self._outbox.append((hello.datagram(Kind.COOKIE, self._cookies.make(address, hello, now)), address))
        elif data[0] == Kind.PROOF:
            cookie, piece = rest[:wire.COOKIE_SIZE], wire.parse_piece(rest[wire.COOKIE_SIZE:])
            self._on_proof((address, hello), cookie, piece, now)
        else:
            raise Malformed("not for a server")

    def _on_proof(self, key: tuple[Address, Hello], cookie: bytes, piece: wire.Piece, now: float) -> None:
        address, hello = key
        if not self._cookies.holds(cookie, address, hello, now):
            raise HandshakeRefused(Drop.COOKIE)
        # From here on the sender has shown that it receives at its address.
        if hello.nonce in self._finished:
            raise HandshakeRefused(Drop.REPLAYED_HANDSHAKE)
        half_open = self._half_open.get(key)
        if half_open is None:
            if len(self._half_open) >= self.config.max_half_open:
                raise HandshakeRefused(Drop.HALF_OPEN)
            if not self._sources.take(address, now):
                raise HandshakeRefused(Drop.SOURCE_LIMIT)
            half_open = self._half_open[key] = _HalfOpen(key, cookie, now)
            self._counts["handshakes_begun"] += 1
        if half_open.connection is not None:
            if now - half_open.offered_at >= OFFER_INTERVAL:
                self._offer(half_open, now)
        elif half_open.proof is None and (proof := half_open.assembly.add(piece)) is not None:
            # The cookie is what the body's signature covers, should the client have been given two.
            half_open.cookie, half_open.proof = cookie, proof
            self._line.append(half_open)
            self._serve_line(now)

    def _serve_line(self, now: float) -> None:
        """Answer whole PROOFs, in order, as long as handshakes have time.

        Many robots begin at once, after a power cut: in line they are served as fast as the share allows, turned
        away they would come back later and later. The line is no longer than max_half_open.
        """
        while self._line and self._share.available(now) > 0:
            half_open = self._line.popleft()
            if self._half_open.get(half_open.key) is not half_open:
                continue
            if now - half_open.began > PATIENCE:
                self._give_up(half_open)
                continue
            began = self._stopwatch()
            try:
                self._answer_proof(half_open, now)
            except HandshakeRefused as refused:
                self._counts[refused.drop] += 1
                address, hello = half_open.key
                del self._half_open[half_open.key]
                if refused.hint is Reason.FULL:  # no failure of the source's
                    self._sources.give_back(address)
                if refused.hint is not None:
                    self._outbox.append((hello.datagram(Kind.REFUSAL, bytes((refused.hint,))), address))
            self._share.charge(self._stopwatch() - began)

    def _give_up(self, half_open: _HalfOpen) -> None:
        """Its turn did not come in time. That is no failure of the source's."""
        self._counts[Drop.BUSY] += 1
        self._sources.give_back(half_open.key[0])
        del self._half_open[half_open.key]

    def _answer_proof(self, half_open: _HalfOpen, now: float) -> None:
        if len(self._connections) >= self.config.max_connections:
            raise HandshakeRefused(Drop.CONNECTIONS, "no room for another connection", Reason.FULL)
        hello = half_open.key[1]
        cid = bytes((self.config.worker,)) + self._randomness.bytes(wire.CID_SIZE - 1)
        handshake = ServerHandshake(
            hello, half_open.cookie, half_open.proof or b"", identity=self._identity, trust=self._trust,
            server_cid=cid, randomness=self._randomness, at=self._wall(),
        )  # fmt: skip
        session = Session(
            handshake.peer, hello.client_cid, handshake.secrets.server, handshake.secrets.client, now=now, rtt=None,
            expires=now + self.config.session_seconds, early=self._early, counts=self._counts,
        )  # fmt: skip
        half_open.offer, half_open.confirm = hello.in_pieces(Kind.OFFER, b"", handshake.offer), handshake.confirm
        half_open.connection = self._connections[cid] = _Connection(cid, half_open, session)
        self._offer(half_open, now)

    def _offer(self, half_open: _HalfOpen, now: float) -> None:
        half_open.offers += 1
        half_open.offered_at = now
        self._outbox += [(datagram, half_open.key[0]) for datagram in half_open.offer]

    # Sessions

    def _on_data(self, data: bytes, address: Address, now: float) -> None:
        if len(data) <= wire.DATA_OVERHEAD:
            raise Malformed("a packet without a frame")
        connection = self._connections.get(data[1:9])
        if connection is None:
            self._counts[Drop.UNKNOWN_CONNECTION] += 1
            return
        session = connection.session
        if not session.receive(data, now):
            return
        if connection.half_open is not None and session.messages:
            self._establish(connection, connection.half_open, session.messages.pop(0), now)
        if connection.half_open is None:
            for payload in session.messages:
                self._counts["messages_received"] += 1
                self._events.append(events.Message(connection.cid, payload, session.peer))
            session.messages.clear()
            self._look_at_address(connection, len(data), address, now)
            self._touched[connection.cid] = connection
        if session.ended is not None:
            self._remove(connection, session.ended)

    def _establish(self, connection: _Connection, half_open: _HalfOpen, finished: bytes, now: float) -> None:
        """If the client's FINISHED, its first message, holds. Only now is another session of this robot replaced."""
        session = connection.session
        try:
            half_open.confirm(finished)
        except HandshakeRefused as refused:
            self._counts[refused.drop] += 1
            session.end(End.PROTOCOL)
            return
        address, hello = half_open.key
        del self._half_open[half_open.key]
        connection.half_open = None
        if half_open.offers == 1:
            session.round_trip.update(now - half_open.offered_at)
        self._sources.give_back(address)
        self._finished[hello.nonce] = now
        older = self._by_name.get(session.peer.name)
        if older is not None:
            self._remove(older, End.REPLACED)
        self._by_name[session.peer.name] = connection
        session.send(int(self._wall().timestamp() * 1000).to_bytes(ACCEPTED_SIZE, "big"))
        self._counts["handshakes"] += 1
        self._events.append(events.Connected(session.peer, connection.cid))

    def _look_at_address(self, connection: _Connection, size: int, address: Address, now: float) -> None:
        session = connection.session
        if address != connection.address and session.newest:  # an older one came late, or was held back by somebody
            connection.address, connection.allowance = address, 0
            connection.first_there = session.next_number
        if connection.allowance == NEVER:
            return
        if session.largest_acked >= connection.first_there:
            connection.allowance = NEVER
            self._counts["address_changes"] += 1
        elif address == connection.address:
            datagram = session.challenge(now)  # shorter than any packet that came
            connection.allowance += AMPLIFICATION * size - len(datagram)
            self._outbox.append((datagram, address))

    def _remove(self, connection: _Connection, reason: End) -> None:
        session, half_open = connection.session, connection.half_open
        if half_open is not None:
            del self._half_open[half_open.key]
        else:
            if reason is not End.CLOSED_BY_PEER and connection.allowance >= wire.DATA_OVERHEAD + 2:
                self._outbox.append((session.close_datagram(reason), connection.address))
            self._events.append(events.Disconnected(reason, connection.cid, session.peer))
        session.release()
        del self._connections[connection.cid]
        self._touched.pop(connection.cid, None)
        if self._by_name.get(session.peer.name) is connection:
            del self._by_name[session.peer.name]
