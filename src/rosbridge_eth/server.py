"""The robots' door: what a worker of the server answers to the chunks that its robots offer.

A chunk is taken if its header is well formed, its body's digest is right, its signature holds under the certificate
that the contract has for this robot now, and the inbox takes it (its number is higher than the stream's last). All
robots' chunks of one turn are committed together, and answered after. Sans-IO: drives a channel.Server and an Inbox.

The body of an archived chunk goes into the archive before the rest goes into the inbox: so what a robot is told is
stored is in both. Threads put the bodies; a robot's chunks behind one that is not there yet wait for it. Such a chunk
comes in parts. Its header and signature are in the first and are checked before room is given to the others.
"""

from __future__ import annotations

import logging
import time
from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from dataclasses import dataclass, field
from typing import NamedTuple

from eth_hash.auto import keccak

from rosbridge_eth import protocol
from rosbridge_eth.archive import Archive
from rosbridge_eth.channel import Connected, Disconnected, End, Event, Message, Server
from rosbridge_eth.channel.udp import UdpLoop
from rosbridge_eth.chunk import Altered, Chunk, ChunkError, Forged, Log, robot_id, signed_as, verify
from rosbridge_eth.errors import StoreError
from rosbridge_eth.identity import PeerIdentity
from rosbridge_eth.inbox import Head, Inbox, InboxExchanged, Outcome
from rosbridge_eth.logs import Trouble
from rosbridge_eth.protocol import Confirmed, Have, Hold, Offer, Part, ProtocolError, Refused, Stored, Where
from smcrypto import sm2

log = logging.getLogger(__name__)

TURN = 0.05  # seconds that chunks are gathered for one commit
ENOUGH = 64  # chunks, for which a commit does not wait
LOOK_EVERY = 1.0  # seconds between looks at what the submitter and the operator changed
HELD = 5.0  # seconds before a robot that was told to hold is asked to go on
WELL_AFTER = 3 * HELD  # seconds without a chunk to try it with, after which a store that answers counts as well
LONGEST_WAIT = 0.5
ALIVE = 10.0  # seconds after its last message in which a session counts as alive
MISMATCH = "the contract has other certificates for this robot; the operator's `status` says more"
NO_ARCHIVE = "it has no archive for chunks of topics with store = \"archive\"; its operator can name one in server.toml"
PUTS = 4  # bodies put into the archive at once
HANGS = 60.0  # seconds for the archive to take a body, after which it counts as away
ROOM = 256 * 1024 * 1024  # bytes of chunks that are arriving or being put into the archive
ROOM_OF_ONE = 48 * 1024 * 1024  # of one robot: what sender.AHEAD lets it have begun, one that is arriving, and some
COST = 16 * 1024  # bytes that count for each chunk beside its body: header, grants, objects
_NO_DIGEST = bytes(32)


class Put(NamedTuple):
    """A body on its way into the archive: whose, the bytes that it counts, and when that began."""

    tk: bytes
    work: Future[None]
    size: int
    begun: float


class Offered(NamedTuple):
    """A chunk in the form for the inbox, and the work of putting its body into the archive, where it has one."""

    chunk: Chunk
    put: Future[None] | None = None


@dataclass(slots=True)
class Arriving:
    """A chunk that comes in parts: what of it is here, how long it will be, and when its last part came."""

    data: bytearray
    of: int
    at: float


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
    offers: list[Offered] = field(default_factory=list)


class Reception:
    """Answers the robots of one worker.

    in_force: the robots that may have a session, by Tk, and keccak256 of their certificates in the operator's registry;
    asked once a second. Those that the contract has are in the inbox's state. archive: for the bodies of archived
    chunks; without one a robot that has such chunks is told to hold.
    counts: chunks by outcome; records: by robot's name, those stored; newest: when it sealed the last of them.
    """

    def __init__(
        self, server: Server, inbox: Inbox, ledger: bytes, in_force: Callable[[], Mapping[bytes, bytes]],
        archive: Archive | None = None,
    ) -> None:  # fmt: skip
        self._archive, self._threads = archive, ThreadPoolExecutor(PUTS, "archive")  # which starts them when needed
        self._arriving: dict[bytes, Arriving] = {}  # by Tk; outlives a session, so that the next one goes on with it
        self._puts: list[Put] = []  # that may be going on
        self._probe = None if archive is None else self._threads.submit(archive.check)
        self.archive_trouble = Trouble(log, "the archive")
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
            case Offer() | Part() if session.held:
                return
            case Offer() | Part():
                encoded = message.chunk if isinstance(message, Offer) else self._assembled(session, message, now)
                chunk = None if encoded is None else self._checked(session, encoded)
                if chunk is None or chunk.header.stream == session.refused:
                    return
                why = session.mismatch
                if isinstance(message, Offer) and chunk.header.archived and chunk.body:
                    why = why or self._no_room(session, len(chunk.body) + COST, now)
                if why is not None:
                    self._hold(session, why, now)
                    return
                session.offers.append(self._offered(session, chunk, now))
        if self._commit_at is None:
            self._commit_at = now + TURN

    def _checked(self, session: Session, encoded: bytes | bytearray, *, front: bool = False) -> Chunk | None:
        """The chunk if it is this robot's, well formed and signed; otherwise it is refused, or nothing is said.

        A body for the archive is checked by the thread that puts it there. front: the chunk only begins like this.
        """
        try:
            chunk = Chunk.parse_front(encoded) if front else Chunk.parse(encoded)
        except ChunkError as error:
            self.counts["malformed"] += 1
            log.warning("%s: sends what is no chunk (%s); its session is closed", session.peer, error)
            self.server.close_connection(session.connection, End.PROTOCOL)
            return None
        try:
            (signed_as if front or (chunk.header.archived and chunk.body) else verify)(*self._signer(session), chunk)
        except (Forged, Altered) as error:
            self._refuse(session, chunk, str(error))
            return None
        return chunk

    def _signer(self, session: Session) -> tuple[Log, sm2.PublicKey]:
        return Log(self._ledger, session.tk), session.peer.signing_certificate.public_key

    # Chunks for the archive

    def _assembled(self, session: Session, part: Part, now: float) -> bytearray | None:
        """The chunk, when this is its last part."""
        arriving = self._arriving.get(session.tk)
        if part.at == 0:
            self._arriving.pop(session.tk, None)
            front = self._checked(session, bytes(part.data), front=True)
            if front is None or front.header.stream == session.refused:
                return None
            if not front.header.archived or part.of != len(front.encoded) + front.header.body_length:
                self.server.close_connection(session.connection, End.PROTOCOL)
                return None
            if (why := self._no_room(session, part.of + COST, now)) is not None:
                self._hold(session, why, now)
                return None
            arriving = self._arriving[session.tk] = Arriving(bytearray(), part.of, now)
        if arriving is None or (len(arriving.data), arriving.of) != (part.at, part.of):  # it had to make room
            self._hold(session, "what came of this chunk is not kept any more", now)
            return None
        arriving.data += part.data
        arriving.at = now
        if len(arriving.data) < part.of:
            return None
        del self._arriving[session.tk]
        return arriving.data

    def _no_room(self, session: Session, size: int, now: float) -> str | None:
        """Why a chunk of this size cannot begin to arrive; one of another robot that goes on no more makes room."""
        if self._archive is None:
            return NO_ARCHIVE
        if self.archive_trouble.why is not None:
            return "the server's archive is away"
        self._puts = [put for put in self._puts if not put.work.done()]
        if sum(put.size for put in self._puts if put.tk == session.tk) + size > ROOM_OF_ONE:
            return "as much as may be of this robot is on its way into the archive"
        total = size + sum(put.size for put in self._puts) + sum(each.of for each in self._arriving.values())
        for tk, other in sorted(self._arriving.items(), key=lambda item: item[1].at):
            if total <= ROOM or now - other.at <= ALIVE:
                break
            total -= other.of
            del self._arriving[tk]
        if total > ROOM:
            return "as much as may be of all robots is on its way into the archive"
        return None

    def _offered(self, session: Session, chunk: Chunk, now: float) -> Offered:
        """The chunk for the next commit; a body for the archive is on its way there, unless its number was taken."""
        archive, signer = self._archive, self._signer(session)
        if not chunk.header.archived or not chunk.body or archive is None:
            return Offered(chunk)
        try:
            head = self._inbox.head(session.tk, chunk.header.stream)
        except StoreError:  # the commit finds that, too, and says so
            head = None
        if head is not None and chunk.header.number <= head.number:
            return Offered(chunk.on_chain)

        def put() -> None:
            verify(*signer, chunk)
            archive.put(chunk.header.body_digest, chunk.body)

        work = self._threads.submit(put)
        self._puts.append(Put(session.tk, work, len(chunk.body) + COST, now))
        return Offered(chunk.on_chain, work)

    def _ready(self, session: Session, now: float) -> list[Chunk]:
        """Its chunks that can be committed: up to the first whose body is not in the archive yet."""
        ready: list[Chunk] = []
        while session.offers and ((put := session.offers[0].put) is None or put.done()):
            chunk = session.offers.pop(0).chunk
            error = None if put is None else put.exception()
            if error is None:
                ready.append(chunk)
                if put is not None:
                    self.archive_trouble.now(None)
                continue
            session.offers.clear()
            if isinstance(error, Forged | Altered):
                self._refuse(session, chunk, str(error))
            else:
                self.counts["not archived"] += 1
                self.archive_trouble.now(str(error))
                self._hold(session, "the server's archive is away", now)
        return ready

    def _look_at_archive(self, now: float) -> None:
        """Whether the archive works at the start, and whether one that was away is well again: a thread tries it."""
        if any(not put.work.done() and now - put.begun > HANGS for put in self._puts):
            self.archive_trouble.now("it does not answer")
        if self._probe is not None and self._probe.done():
            error, self._probe = self._probe.exception(), None
            self.archive_trouble.now(None if error is None else str(error))
        elif self._probe is None and self._archive is not None and self.archive_trouble.why is not None:
            self._probe = self._threads.submit(self._archive.check)

    def close(self) -> None:
        """End the threads; what they have not put is sent again."""
        self._threads.shutdown(wait=False, cancel_futures=True)

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
            self._look_at_archive(now)
            self.look(now, [*self.sessions.values()])

    def commit(self, now: float, wall: float) -> None:
        """Everything gathered goes into the inbox by one commit; then each robot is answered."""
        waiting = [session for session in self.sessions.values() if session.asked or session.offers]
        gathered = [(session, chunk) for session in waiting for chunk in self._ready(session, now)]
        outcomes = self._append([(session.tk, chunk) for session, chunk in gathered], now, wall)
        for (session, chunk), outcome in zip(gathered, outcomes or (), strict=False):
            self._take_outcome(session, chunk, outcome, now)
        in_force = self._in_force()  # after the commit: of what a slow disk took, `revoke` knows nothing
        for session in waiting:
            if in_force.get(session.tk) != session.certificates:
                continue  # `look` closes it
            why = "the server's store is away" if outcomes is None else session.mismatch
            if outcomes is None:  # what is behind a chunk that was not taken is not taken either
                session.offers.clear()
            if why is not None:
                self._hold(session, why, now)
            elif session.asked and not session.held:
                self._answer(session, now)
            session.asked = False
            if session.offers:
                self._commit_at = now + TURN

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
                session.offers.clear()
                if chunk.header.stream != session.refused:
                    self._refuse(session, chunk, "another chunk with this number is there")
            case Outcome.FULL:
                session.offers.clear()
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
        if (arriving := self._arriving.get(session.tk)) is not None:
            digest = Chunk.parse_front(arriving.data).header.digest
            self._send(session, Have(digest, len(arriving.data)))
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
        self.reception.close()
        self.reception.server.close()
        self.loop.step(0.0)
        self.loop.close()
