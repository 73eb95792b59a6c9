"""The server's end of the hop: takes the robots' chunks into the store, and says to each how far its log is there.

A chunk is taken if it is this robot's by its signature, and follows what the store has (log/store.py); nothing else
is decided here. All robots' chunks of one turn are committed together. What was not taken is not remembered: the
robot is told the head, and sends what follows it (log/hop.py).

    the signature or the body is wrong       `refused`: the robot sets the chunk aside
    it does not follow the head              `again`
    no room, the store is away, others'      `again`, and `why`: nothing more comes until that is over
    certificates, the log forked

Drives a channel.Server and a Store. `now` is seconds of a clock that does not jump.
"""

from __future__ import annotations

import logging
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

from eth_hash.auto import keccak

from rosbridge_eth.channel import Connected, Disconnected, End, Event, Message, Server
from rosbridge_eth.channel.udp import UdpLoop
from rosbridge_eth.errors import StoreError
from rosbridge_eth.identity import PeerIdentity
from rosbridge_eth.log.chunk import Altered, Chunk, ChunkError, Forged, Log, robot_id, verify
from rosbridge_eth.log.hop import ELSEWHERE, FORKED, HopError, ServerState, decode_offer
from rosbridge_eth.log.store import NO_DIGEST, Offer, Outcome, State, Store
from rosbridge_eth.terminal import Trouble

log = logging.getLogger(__name__)

TURN = 0.05  # seconds that chunks are gathered for one commit
ENOUGH = 64  # chunks, for which a commit does not wait; and those of one robot that a commit looks at
WAITING = 2 * ENOUGH  # chunks of one robot that wait for a commit; what comes beyond them is not taken
LOOK_EVERY = 1.0  # seconds between looks at what the submitter and the operator changed
HELD = 5.0  # seconds before a robot that was told why nothing is taken may try again
WELL_AFTER = 3 * HELD  # seconds without a failed commit, after which a store that answers counts as well
LONGEST_WAIT = 0.5
ALIVE = 10.0  # seconds after its last message in which a session counts as alive
SAY_AGAIN = 60.0  # seconds before the same is logged of a robot once more
MISMATCH = (
    "the chain has this robot revoked or with other certificates: the server's node is behind, or its registry is an"
    " older copy; the operator's `status` says which"
)
AWAY = "the server's store is away"
NO_ROOM = "the room for this robot's chunks is full until some are on the chain"
REPLACED = (
    "a session took the place of one that was alive: the robot was killed and started again, or heard nothing from a"
    " server that is too busy, or two machines have its identity"
)
NEVER = float("inf")


@dataclass(slots=True)
class Session:
    """A robot that is connected. why: nothing is taken from it before `until`. The rest is what it is told."""

    connection: bytes
    peer: PeerIdentity
    tk: bytes
    certificates: bytes  # keccak256 of them
    heard: float
    offers: list[Offer] = field(default_factory=list)
    why: str = ""
    until: float = 0.0
    state: State = field(default_factory=State)
    behind: bool = False  # something was not taken since the robot was last told
    again: int = 0
    refused: bytes = NO_DIGEST


class Reception:
    """Answers the robots of one port.

    in_force: the robots that may have a session, by Tk, and keccak256 of their certificates in the operator's registry;
    asked once a second. Those that the contract has are in the store's state.
    elsewhere: HOST:PORT of the shard to which a robot belongs, "" if to this one.
    counts: chunks by outcome; records: by robot's name, those stored; newest: when it sealed the last of them;
    forked: by robot's name, when its log was last seen to go on in two places.
    """

    def __init__(
        self, server: Server, store: Store, ledger: bytes, in_force: Callable[[], Mapping[bytes, bytes]],
        elsewhere: Callable[[bytes], str] = lambda tk: "",
    ) -> None:  # fmt: skip
        self.server, self._store, self._ledger, self._in_force = server, store, ledger, in_force
        self._elsewhere = elsewhere
        self.sessions: dict[bytes, Session] = {}
        self._gone: dict[str, Session] = {}  # by name: sessions that a newer one of the same identity replaced
        self._due: dict[bytes, Session] = {}  # those that sent something since the last commit
        self._commit_at, self._look_at, self._failed_at = NEVER, -NEVER, -NEVER
        self._said: dict[tuple[str, str], float] = {}  # robot and sentence -> when it was logged
        self.counts: Counter[str] = Counter()
        self.records: Counter[str] = Counter()
        self.newest: dict[str, float] = {}
        self.forked: dict[str, float] = {}
        self.trouble = Trouble(log, "the store")

    # From the channel

    def handle(self, event: Event, now: float) -> None:
        """Take one event; what comes of it is said by `turn`."""
        match event:
            case Connected(peer=peer, connection=connection):
                session = Session(connection, peer, robot_id(peer.name), keccak(peer.certificates), now)
                self.sessions[connection] = session
                before = self._gone.pop(peer.name, None)
                if before is not None and now - before.heard <= ALIVE:
                    if now - self._said.get((peer.name, REPLACED), -NEVER) < SAY_AGAIN:
                        self._fork(session, now)
                    self._tell(session, REPLACED, now)
                if shard := self._elsewhere(session.tk):
                    session.why, session.until = ELSEWHERE + shard, NEVER
                log.info("%s: session begun", peer)
                self.look(now, [session])  # its handshake may have been allowed before the list changed
            case Disconnected(reason=reason, connection=connection):
                ended = self.sessions.pop(connection, None)
                if ended is not None:
                    log.info("%s: session ended, %s", ended.peer, reason)
                    if reason is End.REPLACED:
                        self._gone[ended.peer.name] = ended
            case Message(connection=connection, payload=payload):
                found = self.sessions.get(connection)
                if found is not None:
                    found.heard = now
                    self._take(found, payload, now)

    def _take(self, session: Session, payload: bytes, now: float) -> None:
        try:
            encoded, after = decode_offer(payload)
            chunk = Chunk.parse(encoded)
        except (HopError, ChunkError) as error:
            self.counts["malformed"] += 1
            log.warning("%s: sends what is no chunk (%s); its session is closed", session.peer, error)
            self.server.close_connection(session.connection, End.PROTOCOL)
            del self.sessions[session.connection]  # and what came behind it is not looked at
            return
        self._due[session.connection] = session
        self._commit_at = min(self._commit_at, now + TURN)
        if session.why:
            self._turn_away(session)
        elif len(session.offers) < WAITING:
            session.offers.append(Offer(session.tk, chunk, after))
        else:
            session.behind = True

    # The turn

    def next_timer(self) -> float:
        """When `turn` has something to do although no event came."""
        return min(self._commit_at, self._look_at)

    def turn(self, now: float, wall: float) -> None:
        """Commit what was gathered, if its time has come, and look once a second at what others changed.

        wall: seconds since 1970, for the store.
        """
        if now >= self._commit_at or sum(len(session.offers) for session in self._due.values()) >= ENOUGH:
            self.commit(now, wall)
        if now >= self._look_at:
            self._look_at = now + LOOK_EVERY
            self.look(now, [*self.sessions.values()])

    def commit(self, now: float, wall: float) -> None:
        """What was gathered goes into the store, ENOUGH of each robot; then each is told how far its log is there.

        So a robot that floods the server costs the others a bounded time in each turn.
        """
        waiting = [session for connection, session in self._due.items() if connection in self.sessions]
        offered = [(session, offer) for session in waiting for offer in self._verified(session, now)]
        try:
            outcomes = self._store.append([offer for _, offer in offered], wall) if offered else []
            self._failed_at = -NEVER if offered else self._failed_at
        except StoreError as error:
            self._failed_at = now
            self.trouble.now(str(error))
            for session, _ in offered:
                self._turn_away(session, AWAY, now + HELD)
        else:
            for (session, offer), outcome in zip(offered, outcomes, strict=True):
                self._note(session, offer.chunk, outcome, now)
        self._due = {session.connection: session for session in waiting if session.offers}
        self._commit_at = now if self._due else NEVER
        self.look(now, waiting)

    def _verified(self, session: Session, now: float) -> list[Offer]:
        """The next offers of a session, up to the first that is not this robot's; those that follow it are dropped."""
        offers, session.offers = session.offers[:ENOUGH], session.offers[ENOUGH:]
        for number, offer in enumerate(offers):
            try:
                verify(Log(self._ledger, session.tk), session.peer.signing_certificate.public_key, offer.chunk)
            except (Forged, Altered) as error:
                self.counts["refused"] += 1
                self._tell(session, "a chunk is refused", now, f": {error}")
                session.refused = offer.chunk.header.digest
                self._turn_away(session)
                return offers[:number]
        return offers

    def _note(self, session: Session, chunk: Chunk, outcome: Outcome, now: float) -> None:
        self.counts[outcome.name.lower()] += 1
        match outcome:
            case Outcome.STORED:
                self.records[session.peer.name] += chunk.header.records
                self.newest[session.peer.name] = chunk.header.sealed_ms / 1000
            case Outcome.NOT_NEXT:
                self._turn_away(session)
            case Outcome.FULL:
                self._turn_away(session, NO_ROOM, now + HELD)
            case Outcome.DIFFERENT:
                self._turn_away(session, FORKED, NEVER)

    def look(self, now: float, sessions: Sequence[Session]) -> None:
        """Close the sessions of who is not allowed any more, and tell the others how their logs stand."""
        in_force, known = self._in_force(), list[Session]()  # after a commit, which on a slow disk takes long
        for session in sessions:
            if in_force.get(session.tk) == session.certificates:
                known.append(session)
            else:
                log.warning("%s is no longer allowed; its session is closed", session.peer)
                self.server.close_peer(session.peer.name)
        try:
            for session, state in zip(known, self._store.states([one.tk for one in known]), strict=True):
                session.state = state
                if now >= session.until:
                    session.why = "" if state.certificates in (b"", session.certificates) else MISMATCH
                if session.why == MISMATCH:
                    self._tell(session, MISMATCH, now)
                if session.why == FORKED:
                    self._fork(session, now)
            if now - self._failed_at > WELL_AFTER:
                self.trouble.now(None)
        except StoreError as error:
            self.trouble.now(str(error))
            for session in known:
                self._hold(session, AWAY, now + HELD)
        for session in known:
            self._say(session)

    # What a robot is told

    def _turn_away(self, session: Session, why: str = "", until: float = -NEVER) -> None:
        """What came is not taken: the robot is to go on from the head, once nothing stands in the way."""
        session.offers, session.behind = [], True
        self._hold(session, why, until)

    def _hold(self, session: Session, why: str, until: float) -> None:
        if until > session.until:
            session.why, session.until = why, until

    def _fork(self, session: Session, now: float) -> None:
        self.forked[session.peer.name] = now
        self._tell(session, FORKED, now)

    def _tell(self, session: Session, what: str, now: float, more: str = "") -> None:
        """Log it, at most once a minute for a robot."""
        if now - self._said.get((session.peer.name, what), -NEVER) >= SAY_AGAIN:
            log.warning("%s: %s%s", session.peer, what, more)
            self._said[session.peer.name, what] = now

    def _say(self, session: Session) -> None:
        """Have the robot told how its log stands here."""
        state = session.state
        session.again, session.behind = (session.again + session.behind) % 256, False
        self.server.set_state(session.connection, ServerState(
            state.head, state.digest, state.confirmed, state.block, session.again, session.refused, session.why
        ).encode())  # fmt: skip


class Worker:
    """Drives a Reception over a socket until told to stop."""

    def __init__(self, reception: Reception, make_loop: Callable[[Callable[[Event], None]], UdpLoop]) -> None:
        self.reception = reception
        self.loop = make_loop(lambda event: reception.handle(event, time.monotonic()))

    def run(self, stopped: Callable[[], bool], *, on_turn: Callable[[], None] = lambda: None) -> None:
        """Until `stopped()`; then every session is closed in order. on_turn: called after every step."""
        while not stopped():
            wait = self.reception.next_timer() - time.monotonic()
            self.loop.step(max(0.0, min(LONGEST_WAIT, wait)))
            self.reception.turn(time.monotonic(), time.time())
            on_turn()
        self.reception.commit(time.monotonic(), time.time())
        self.reception.server.close()
        self.loop.step(0.0)
        self.loop.close()
