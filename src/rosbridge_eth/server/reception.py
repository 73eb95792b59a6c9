"""What a worker of the server answers to the chunks that its robots offer.

A chunk is taken if its header is well formed, its body's digest is right, its signature holds under the certificate
that the contract has for this robot now, and the inbox takes it (its number is higher than the stream's last). All
robots' chunks of one turn are committed together, and answered after. Sans-IO: drives a channel.Server and an Inbox.
"""

from __future__ import annotations

import logging
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field

from eth_hash.auto import keccak

from rosbridge_eth import protocol
from rosbridge_eth.channel import Connected, Disconnected, End, Event, Message, Server
from rosbridge_eth.channel.udp import UdpLoop
from rosbridge_eth.errors import StoreError
from rosbridge_eth.identity import PeerIdentity
from rosbridge_eth.inbox import Head, Inbox, InboxExchanged, Outcome
from rosbridge_eth.log.chunk import Altered, Chunk, ChunkError, Forged, Log, robot_id, verify
from rosbridge_eth.logs import Trouble
from rosbridge_eth.protocol import Confirmed, Hold, Offer, ProtocolError, Refused, Stored, Where

log = logging.getLogger(__name__)

TURN = 0.05  # seconds that chunks are gathered for one commit
ENOUGH = 64  # chunks, for which a commit does not wait
LOOK_EVERY = 1.0  # seconds between looks at what the submitter and the operator changed
HELD = 5.0  # seconds before a robot that was told to hold is asked to go on
WELL_AFTER = 3 * HELD  # seconds without a chunk to try it with, after which a store that answers counts as well
LONGEST_WAIT = 0.5
ALIVE = 10.0  # seconds after its last message in which a session counts as alive
MISMATCH = "the contract has other certificates for this robot; the operator's `status` says more"
_NO_DIGEST = bytes(32)


@dataclass(slots=True)
class Session:
    """A robot that is connected. Streams are named by their 16 bytes."""

    connection: bytes
    peer: PeerIdentity
    tk: bytes
    certificates: bytes  # keccak256 of them
    heard: float
    stream: bytes | None = None  # the one it asked about or sent last
    asked: bool = False  # it is to be told what is stored of that stream
    held: bool = False  # told to hold: its offers are passed over until it asks again
    ask_at: float = 0.0  # when a robot that holds is told what is stored, so that it asks again
    refused: bytes | None = None  # the stream whose rest is passed over until it asks again
    mismatch: str | None = None  # why nothing is taken from it although the session stands
    confirmed: tuple[bytes, int] | None = None  # what it was told last
    offers: list[Chunk] = field(default_factory=list)


class Reception:
    """Answers the robots of one worker.

    in_force: the robots that may have a session, by Tk, and keccak256 of their certificates in the operator's registry;
    asked once a second. Those that the contract has are in the inbox's state.
    counts: chunks by outcome; records: by robot's name, those stored; newest: when it sealed the last of them.
    """

    def __init__(
        self, server: Server, inbox: Inbox, ledger: bytes, in_force: Callable[[], Mapping[bytes, bytes]],
    ) -> None:  # fmt: skip
        self.server, self._inbox, self._ledger = server, inbox, ledger
        self._in_force = in_force
        self.sessions: dict[bytes, Session] = {}
        self._gone: dict[str, Session] = {}  # by name: sessions that a newer one of the same identity replaced
        self._commit_at: float | None = None
        self._look_at = float("-inf")
        self.counts: Counter[str] = Counter()
        self.records: Counter[str] = Counter()
        self.newest: dict[str, float] = {}
        self.trouble = Trouble(log, "the inbox")
        self._failed_at = float("-inf")

    # From the channel

    def handle(self, event: Event, now: float) -> None:
        """Take one event; what it asks for is answered by `commit`."""
        match event:
            case Connected(peer=peer, connection=connection):
                session = Session(connection, peer, robot_id(peer.name), keccak(peer.certificates), now)
                self.sessions[connection] = session
                before = self._gone.pop(peer.name, None)
                if before is not None and now - before.heard <= ALIVE:
                    log.warning(
                        "%s: a session took the place of one that was alive: the robot was killed and started again,"
                        " or heard nothing from a server that is too busy, or two machines have its identity, in"
                        " which case revoke it and register it anew", peer,
                    )  # fmt: skip
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
            message = protocol.decode_up(payload)
        except ProtocolError as error:
            log.warning("%s: %s; its session is closed", session.peer, error)
            self.server.close_connection(session.connection, End.PROTOCOL)
            return
        match message:
            case Where(stream=stream):
                # Messages are in order: what it offers from here on was chosen after our answer to this.
                session.stream, session.asked, session.held, session.refused = stream, True, False, None
            case Offer() if session.held:
                return
            case Offer(chunk=encoded):
                chunk = self._checked(session, encoded)
                if chunk is None or chunk.header.stream == session.refused:
                    return
                if session.mismatch is not None:
                    self._hold(session, session.mismatch, now)
                    return
                session.offers.append(chunk)
        if self._commit_at is None:
            self._commit_at = now + TURN

    def _checked(self, session: Session, encoded: bytes) -> Chunk | None:
        """The chunk if it is this robot's, well formed and signed; otherwise it is refused, or nothing is said."""
        try:
            chunk = Chunk.parse(encoded)
        except ChunkError as error:
            self.counts["malformed"] += 1
            log.warning("%s: sends what is no chunk (%s); its session is closed", session.peer, error)
            self.server.close_connection(session.connection, End.PROTOCOL)
            return None
        try:
            verify(Log(self._ledger, session.tk), session.peer.signing_certificate.public_key, chunk)
        except (Forged, Altered) as error:
            self._refuse(session, chunk, str(error))
            return None
        return chunk

    # The turn's commit

    def next_timer(self) -> float:
        """When `commit` or `look` has something to do although no event came."""
        return self._look_at if self._commit_at is None else min(self._commit_at, self._look_at)

    def turn(self, now: float, wall: float) -> None:
        """Commit what was gathered, if its time has come, and look once a second at what others changed.

        wall: seconds since 1970, for the inbox.
        """
        if self._commit_at is not None and (
            now >= self._commit_at or sum(len(session.offers) for session in self.sessions.values()) >= ENOUGH
        ):
            self._commit_at = None
            self.commit(now, wall)
        if now >= self._look_at:
            self._look_at = now + LOOK_EVERY
            self._append([], now, wall)
            self.look(now, [*self.sessions.values()])

    def commit(self, now: float, wall: float) -> None:
        """Everything gathered goes into the inbox by one commit; then each robot is answered."""
        waiting = [session for session in self.sessions.values() if session.asked or session.offers]
        gathered = [(session, chunk) for session in waiting for chunk in session.offers]
        for session in waiting:
            session.offers = []
        outcomes = self._append([(session.tk, chunk) for session, chunk in gathered], now, wall)
        for (session, chunk), outcome in zip(gathered, outcomes or (), strict=False):
            self._take_outcome(session, chunk, outcome, now)
        in_force = self._in_force()  # after the commit: of what a slow disk took, `revoke` knows nothing
        for session in waiting:
            if in_force.get(session.tk) != session.certificates:
                continue  # `look` closes it
            why = "the server's store is away" if outcomes is None else session.mismatch
            if why is not None:
                self._hold(session, why, now)
            elif session.asked and not session.held:
                self._answer(session, now)
            session.asked = False

    def _append(self, chunks: list[tuple[bytes, Chunk]], now: float, wall: float) -> list[Outcome] | None:
        """Without chunks only asks whether the store is there, and the same. None where nothing was taken."""
        try:
            outcomes = self._inbox.append(chunks, wall)
        except InboxExchanged as error:  # what robots were told is void: they ask again in a new session
            log.error("%s; all sessions begin anew", error)
            self.server.close()
            self.sessions.clear()
            return None
        except StoreError as error:
            self._failed_at = now if chunks else self._failed_at
            self.trouble.now(str(error))
            return None
        if chunks or now - self._failed_at > WELL_AFTER:
            self.trouble.now(None)
        return outcomes

    def _take_outcome(self, session: Session, chunk: Chunk, outcome: Outcome, now: float) -> None:
        self.counts[outcome.name.lower()] += 1
        match outcome:
            case Outcome.STORED | Outcome.KNOWN:
                if outcome is Outcome.STORED:
                    self.records[session.peer.name] += chunk.header.records
                    self.newest[session.peer.name] = chunk.header.sealed_ms / 1000
                if not session.asked:  # what the robot asks for is answered before what it did not
                    session.stream, session.asked = chunk.header.stream, True
            case Outcome.DIFFERENT:
                if chunk.header.stream != session.refused:
                    self._refuse(session, chunk, "another chunk with this number is there")
            case Outcome.FULL:
                self._hold(session, "the room for this robot's chunks is full until some are on the chain", now)

    def _answer(self, session: Session, now: float) -> None:
        """Say what is stored of its stream."""
        if session.stream is None:
            return
        try:
            head: Head | None = self._inbox.head(session.tk, session.stream)
        except StoreError as error:
            self.trouble.now(str(error))
            self._hold(session, "the server's store is away", now)
            return
        self._send(session, Stored(session.stream, *(head or (None, _NO_DIGEST))))

    # Once a second

    def look(self, now: float, sessions: Sequence[Session]) -> None:
        """Tell what is confirmed, ask those that hold to go on, close the sessions of who is not allowed any more."""
        in_force = self._in_force()
        try:
            states = self._inbox.states([session.tk for session in sessions])
        except StoreError as error:
            self.trouble.now(str(error))
            states = {}
        for session in sessions:
            if in_force.get(session.tk) != session.certificates:
                log.warning("%s is no longer allowed; its session is closed", session.peer)
                self.server.close_peer(session.peer.name)
                continue
            if (state := states.get(session.tk)) is None:
                continue
            session.mismatch = None if state.certificates_hash in (None, session.certificates) else MISMATCH
            if state.confirmed is not None and state.confirmed != session.confirmed:
                session.confirmed = state.confirmed
                self._send(session, Confirmed(*state.confirmed, state.block))
            if session.held and now >= session.ask_at and session.mismatch is None:
                session.ask_at = now + HELD
                self._answer(session, now)

    # Answers

    def _hold(self, session: Session, why: str, now: float) -> None:
        if not session.held and self.sessions.get(session.connection) is session:
            session.held, session.ask_at = True, now + HELD
            self._send(session, Hold(why))

    def _refuse(self, session: Session, chunk: Chunk, why: str) -> None:
        self.counts["refused"] += 1
        session.refused = chunk.header.stream
        log.error("%s: chunk %d of stream %s is refused: %s", session.peer, chunk.header.number,
                  chunk.header.stream.hex(), why)
        self._send(session, Refused(chunk.header.stream, chunk.header.number, why))

    def _send(self, session: Session, message: protocol.Down) -> None:
        encoded = protocol.encode(message)
        if self.server.writable(session.connection, len(encoded)):
            self.server.send(session.connection, encoded)
        else:  # it takes none of our packets: it comes back with a new session, and asks
            log.warning("%s: takes no answers; its session is closed", session.peer)
            self.server.close_connection(session.connection)


class Worker:
    """Drives a Reception over a socket until told to stop."""

    def __init__(self, reception: Reception, make_loop: Callable[[Callable[[Event], None]], UdpLoop]) -> None:
        self.reception = reception
        self.loop = make_loop(lambda event: reception.handle(event, time.monotonic()))

    def run(self, stopped: Callable[[], bool], *, on_turn: Callable[[], None] = lambda: None) -> None:
        """Until `stopped()`; then every session is ended in good order. on_turn: called after every step."""
        while not stopped():
            wait = self.reception.next_timer() - time.monotonic()
            self.loop.step(max(0.0, min(LONGEST_WAIT, wait)))
            self.reception.turn(time.monotonic(), time.time())
            on_turn()
        self.reception.commit(time.monotonic(), time.time())
        self.reception.server.close()
        self.loop.step(0.0)
        self.loop.close()
