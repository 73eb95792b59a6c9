"""A server of the channel: the sessions of one process. Sans-IO.

What a stranger can cost: a HELLO, one keyed hash and a COOKIE of 51 bytes for 1,200; a piece of a PROOF with a good
cookie, one of `max_half_open` places, from which the oldest goes; a whole PROOF, signatures, within `handshake_share`.
DATA of unknown sessions costs a look-up, and is not answered. To no address go more bytes than came from it.
"""

from __future__ import annotations

import time
from collections import Counter, OrderedDict
from collections.abc import Callable
from datetime import datetime
from hashlib import blake2s

from rosbridge_eth.channel import events, wire
from rosbridge_eth.channel.admission import Address, Cookies, TokenBucket
from rosbridge_eth.channel.endpoint import Endpoint, utc_now
from rosbridge_eth.channel.events import End, ServerConfig, close_frame, parse_close
from rosbridge_eth.channel.handshake import Agreed, Randomness, answer_proof
from rosbridge_eth.channel.protection import SESSION_PACKETS, Direction, ReplayWindow
from rosbridge_eth.channel.transfer import ACK_DELAY, ACK_EVERY, NEVER, Receiving
from rosbridge_eth.channel.wire import Answer, Assembly, Drop, Frame, Hello, Kind, Malformed, Reason, Refused
from rosbridge_eth.identity import Identity, Trust

HANDSHAKE_LIFETIME = 20.0
"""s that a cookie holds, and that pieces of a PROOF, an OFFER, and a session without a packet are kept."""
IDLE_TIMEOUT = 30.0
"""s; a session without an authenticated packet for so long has ended."""
SHARE_BURST = 0.25  # s of handshake work that may come at once
SWEEP = 0.5  # s between two looks for what is over: half-open, silent and expired


def cookie_key(identity: Identity) -> bytes:
    """A cookie key for `Server` that a server's next start derives alike."""
    return blake2s(identity.signing_key.to_bytes(), person=b"rbe-key3").digest()


class _Proof:
    """A PROOF of which pieces are missing, or that waits for time. size: bytes of its datagrams that came."""

    def __init__(self, now: float) -> None:
        self.began, self.assembly, self.size = now, Assembly(), 0


class _Session:
    """One client, at the address that sent the newest authentic packet (WireGuard's rule).

    credit: how many bytes more came from there than went there.
    """

    def __init__(
        self, agreed: Agreed, cid: bytes, key: tuple[Address, Hello], credit: int, now: float, receiving: Receiving
    ) -> None:
        self.peer, self.cid, self.client_cid = agreed.peer, cid, key[1].client_cid
        self.address, self.credit = key[0], credit
        self.offer, self._next_offer = key[1].in_pieces(Kind.OFFER, b"", agreed.told), 0
        self.seals, self.opens = Direction(agreed.secrets.server), Direction(agreed.secrets.client)
        self.replay, self.receiving = ReplayWindow(), receiving
        self.state = self.told = b""  # what the program says, and what of it went out last
        self.number = 0  # of the next packet
        self.began = self.heard = now
        self.pending, self.due = 0, NEVER  # packets without an answer, and when they get one

    def offers(self) -> list[bytes]:
        """The next datagrams of the OFFER, each once at most, as far as the credit goes."""
        out = list[bytes]()
        for _ in self.offer:
            datagram = self.offer[self._next_offer]
            if len(datagram) > self.credit:
                break
            self.credit -= len(datagram)
            self._next_offer = (self._next_offer + 1) % len(self.offer)
            out.append(datagram)
        return out

    def seal(self, frame: bytes) -> bytes | None:
        """A packet to the client, or None where its address has no credit for it."""
        if len(frame) + wire.DATA_OVERHEAD > self.credit:
            return None
        self.credit -= len(frame) + wire.DATA_OVERHEAD
        self.number += 1
        return self.seals.seal(self.client_cid, self.number - 1, frame)

    def answer(self, time_ms: int) -> bytes | None:
        """What came, and the state; without the state, or nothing, where there is no credit for more."""
        if self.replay.highest < 0:
            return None
        answer = Answer(self.replay.highest, self.receiving.next, time_ms, self.replay.bits, self.state)
        datagram = self.seal(answer.to_bytes())
        if datagram is not None:
            self.told = self.state
        else:
            datagram = self.seal(answer._replace(data=b"").to_bytes())
        self.pending, self.due = 0, NEVER
        return datagram


class Server(Endpoint):
    """In a loop: `receive_datagram`, `handle_timer`, `next_event`, `datagrams_to_send`. See Client for clocks.

    cookie_key: 32 secret bytes, the same across restarts (`cookie_key(identity)`). stopwatch: measures what a handshake
    costs.
    """

    def __init__(
        self, config: ServerConfig, identity: Identity, trust: Trust, cookie_key: bytes, now: float, *,
        wall: Callable[[], datetime] = utc_now, randomness: Randomness | None = None,
        stopwatch: Callable[[], float] = time.perf_counter,
    ) -> None:  # fmt: skip
        super().__init__(wall, randomness)
        self.config, self._identity, self._trust, self._stopwatch = config, identity, trust, stopwatch
        self._cookies = Cookies(cookie_key, HANDSHAKE_LIFETIME)
        self._share = TokenBucket(config.handshake_share, SHARE_BURST, now)
        # In the order of their beginning; one that was answered is kept, so that it is examined once.
        self._proofs: OrderedDict[tuple[Address, Hello], _Proof] = OrderedDict()
        self._offered: OrderedDict[tuple[Address, Hello], _Session] = OrderedDict()
        self._sessions: dict[bytes, _Session] = {}
        self._by_name: dict[str, _Session] = {}  # those that stand: a packet of the client's has opened
        self._opening: dict[str, _Session] = {}  # the others, one a client: the newest
        self._unanswered: dict[bytes, _Session] = {}  # to be answered when they are `due`
        self._sweep_at = now

    # What the program calls

    def set_state(self, connection: bytes, state: bytes) -> None:
        """What the client is to know from now on: 1 to wire.MAX_STATE bytes. Nothing happens if the session is gone."""
        session = self._sessions.get(connection)
        if session is not None and session.state != state:
            session.state = state
            self._answer_at(session, -NEVER)

    def close_connection(self, connection: bytes, reason: End = End.CLOSED) -> None:
        """End one session and tell the client; nothing happens if it is gone."""
        if (session := self._sessions.get(connection)) is not None:
            self._remove(session, reason)

    def close_peer(self, name: str, reason: End = End.REVOKED) -> None:
        """End the session of a robot, if it has one here, and those it is about to have."""
        for session in list(self._sessions.values()):
            if session.peer.name == name:
                self._remove(session, reason)

    def close(self) -> None:
        """End every session and tell the clients."""
        for session in list(self._sessions.values()):
            self._remove(session, End.CLOSED)

    def address_of(self, connection: bytes) -> Address | None:
        """Where the client of a session is; None if the session is gone."""
        session = self._sessions.get(connection)
        return None if session is None else session.address

    def statistics(self) -> Counter[str]:
        """What was counted since this server was made, each Drop among it, and what is there at this moment."""
        half_open = len(self._proofs) + len(self._opening)
        return Counter({"early": 0, **self._counts, "connections": len(self._by_name), "half_open": half_open})

    # What the network and the clock call

    def _prepare(self, now: float) -> None:
        due = [session for session in self._unanswered.values() if session.due <= now]
        time_ms = int(self._wall().timestamp() * 1000) if due else 0
        for session in due:
            del self._unanswered[session.cid]
            if (datagram := session.answer(time_ms)) is not None:
                self._outbox.append((datagram, session.address))
            if session.number >= SESSION_PACKETS:
                self._remove(session, End.EXPIRED)

    def next_timer(self) -> float | None:
        """When to call `handle_timer`, on the clock of `now`; None for never."""
        if not (self._proofs or self._offered or self._sessions):
            return None
        return min([self._sweep_at, *(session.due for session in self._unanswered.values())])

    def handle_timer(self, now: float) -> None:
        """Do what is due at `now`; harmless if nothing is."""
        if now >= self._sweep_at:
            self._sweep(now)

    def _answer_at(self, session: _Session, when: float) -> None:
        session.due = min(when, session.due)
        self._unanswered[session.cid] = session

    def _sweep(self, now: float) -> None:
        self._sweep_at = now + SWEEP
        while self._proofs and now >= next(iter(self._proofs.values())).began + HANDSHAKE_LIFETIME:
            self._proofs.popitem(last=False)
        while self._offered and now >= next(iter(self._offered.values())).began + HANDSHAKE_LIFETIME:
            self._offered.popitem(last=False)
        for session in list(self._sessions.values()):
            stands = self._by_name.get(session.peer.name) is session
            if now >= session.heard + (IDLE_TIMEOUT if stands else HANDSHAKE_LIFETIME):
                self._remove(session, End.SILENT)
            elif now >= session.began + self.config.session_seconds:
                self._remove(session, End.EXPIRED)

    # Handshake

    def _on_handshake(self, data: bytes, address: Address, now: float) -> None:
        hello, rest = Hello.parse(data)
        if hello.mode not in self.config.modes:
            raise Refused(Drop.MODE)
        if data[0] == Kind.HELLO and rest == wire.HELLO_PADDING:
            self._counts["cookies"] += 1
            self._outbox.append((hello.datagram(Kind.COOKIE, self._cookies.make(address, hello, now)), address))
        elif data[0] == Kind.PROOF:
            cookie, piece = rest[: wire.COOKIE_SIZE], rest[wire.COOKIE_SIZE :]
            if not self._cookies.holds(cookie, address, hello, now):
                raise Refused(Drop.COOKIE)
            self._on_proof((address, hello), cookie, piece, len(data), now)
        else:
            raise Malformed("not for a server")

    def _on_proof(self, key: tuple[Address, Hello], cookie: bytes, piece: bytes, size: int, now: float) -> None:
        """A PROOF from an address that has shown that it receives there."""
        if (session := self._offered.get(key)) is not None:
            if session.address == key[0]:
                session.credit += size
                self._outbox += [(datagram, key[0]) for datagram in session.offers()]
            return
        proof = self._proofs.get(key) or _Proof(now)
        body = proof.assembly.add(piece)
        if key not in self._proofs:
            self._proofs[key] = proof
            self._counts["handshakes_begun"] += 1
            if len(self._proofs) > self.config.max_half_open:
                self._proofs.popitem(last=False)
                self._counts[Drop.HALF_OPEN] += 1
        proof.size += size
        if body is None:
            return
        if len(self._opening) >= self.config.max_half_open:
            raise Refused(Drop.HALF_OPEN)
        if self._share.available(now) <= 0:
            raise Refused(Drop.BUSY)  # it is examined when it comes again
        del self._proofs[key]
        began = self._stopwatch()
        try:
            self._offer(key, cookie, body, proof.size, now)
        except Refused as refused:
            if refused.hint is not None:
                self._outbox.append((key[1].datagram(Kind.REFUSAL, bytes((refused.hint,))), key[0]))
            raise
        finally:
            self._share.charge(self._stopwatch() - began)

    def _offer(self, key: tuple[Address, Hello], cookie: bytes, body: bytes, credit: int, now: float) -> None:
        if len(self._sessions) >= self.config.max_connections:
            raise Refused(Drop.CONNECTIONS, "no room for another connection", Reason.FULL)
        cid = self._randomness.bytes(wire.CID_SIZE)
        agreed = answer_proof(
            key[1], cookie, body, identity=self._identity, trust=self._trust, server_cid=cid,
            randomness=self._randomness, at=self._wall(),
        )  # fmt: skip
        receiving = Receiving(self._counts, self.config.max_early)
        session = self._sessions[cid] = self._offered[key] = _Session(agreed, cid, key, credit, now, receiving)
        if (older := self._opening.get(agreed.peer.name)) is not None:
            self._remove(older, End.REPLACED)
        self._opening[agreed.peer.name] = session
        self._outbox += [(datagram, key[0]) for datagram in session.offers()]

    # Sessions

    def _on_data(self, data: bytes, address: Address, now: float) -> None:
        session = self._sessions.get(data[1:9])
        if session is None:
            raise Refused(Drop.UNKNOWN_CONNECTION)
        number, frame = session.opens.open(data, session.replay)
        if self._by_name.get(session.peer.name) is not session:
            self._stand(session)
        session.heard = now
        newest = number > session.replay.highest
        if address != session.address and newest:  # an older one came late, or was held back by somebody
            session.address, session.credit = address, 0
            self._counts["address_changes"] += 1
        if address == session.address:
            session.credit += len(data)
        try:
            at_once = self._take(session, frame)
        except Malformed:
            self._remove(session, End.PROTOCOL)
            return
        if at_once is None:
            return
        gap = number != session.replay.highest + 1
        session.replay.mark(number)
        session.pending += 1
        if number >= SESSION_PACKETS:
            self._remove(session, End.EXPIRED)
        else:
            at_once = at_once or gap or session.pending >= ACK_EVERY or session.told != session.state
            self._answer_at(session, now if at_once else now + ACK_DELAY)

    def _stand(self, session: _Session) -> None:
        """The client has the keys, since a packet of its opened. Only now is its older session replaced."""
        if (older := self._by_name.get(session.peer.name)) is not None:
            self._remove(older, End.REPLACED)
        self._by_name[session.peer.name] = self._opening.pop(session.peer.name)
        self._counts["handshakes"] += 1
        self._events.append(events.Connected(session.peer, session.cid))

    def _take(self, session: _Session, frame: bytes) -> bool | None:
        """Whether it asks for an answer at once; None where it was the last."""
        kind, rest = frame[0], frame[1:]
        if kind == Frame.PROBE and not any(rest):
            return True
        if (reason := parse_close(frame)) is not None:
            self._remove(session, reason, told=True)
            return None
        if kind != Frame.SEGMENT or len(rest) <= 4:
            raise Malformed(f"frame {kind} does not exist, or not with {len(rest)} bytes behind it")
        # What is refused here is not marked, so not acknowledged: it comes again when there may be room.
        messages = session.receiving.take(int.from_bytes(rest[:4], "big"), rest[4:])
        self._counts["messages_received"] += len(messages)
        self._events.extend(events.Message(session.cid, payload) for payload in messages)
        return False

    def _remove(self, session: _Session, reason: End, *, told: bool = False) -> None:
        """told: the client knows."""
        if self._by_name.get(session.peer.name) is session:
            del self._by_name[session.peer.name]
            if not told and (datagram := session.seal(close_frame(reason))) is not None:
                self._outbox.append((datagram, session.address))
            self._events.append(events.Disconnected(reason, session.cid, session.peer))
        else:
            del self._opening[session.peer.name]
        session.receiving.release()
        del self._sessions[session.cid]
        self._unanswered.pop(session.cid, None)
