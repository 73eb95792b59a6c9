"""The robot's end of the hop: sends what follows the server's head, from the robot's own disk.

The server's last word (log/hop.py) says how far it has the log, and that is all that is remembered of it: what follows
is sent as long as the session takes it, again from the head where the server did not take it, and nothing while it
says why not. A chunk that it refuses is set aside if it is wrong here, too; what is confirmed on the chain leaves the
disk.

The log forked where the server's head is no chunk of this robot's and what follows here does not follow it: another
machine has this robot's identity, or the disk was put back from an old copy. Then nothing is sent or removed, and it
is told. `now` is seconds of a clock that does not jump.
"""

from __future__ import annotations

import logging
from collections.abc import Callable

from rosbridge_eth.channel import (
    Client,
    Connected,
    Disconnected,
    End,
    Event,
    HandshakeFailed,
    Reason,
    State,
    Unresolved,
)  # fmt: skip
from rosbridge_eth.log.chunk import MAX_TIME_MS, STREAM_SIZE
from rosbridge_eth.log.hop import ELSEWHERE, FORKED, HopError, ServerState, encode_offer
from rosbridge_eth.log.store import NO_DIGEST, NOWHERE
from rosbridge_eth.log.writer import LogWriter
from rosbridge_eth.robot.spool import Spool

log = logging.getLogger(__name__)

AT_ONCE = 32  # chunks that are looked up on the disk at a time
SAY_AGAIN = 60.0  # seconds before the same reason why nothing is sent is said once more
TWICE = (
    "another session took the place of this one: another machine has this robot's identity; `revoke` it,"
    " `register --replace` it, and `join` the new bundle in a new folder, on one machine"
)
REFUSED_RIGHT = (
    "the server refuses a chunk whose signature and body are right: it is the server of another contract, or has a"
    " defect; ask the operator, whose log says more"
)


def fix(failure: HandshakeFailed, channel: str) -> str:
    """What to do about a session that did not come about; `channel` is the configured mode."""
    match failure.hint:
        case Reason.NOT_ALLOWED | Reason.CERTIFICATE:
            return (
                "ask the operator, whose `status` says whether this robot is in force; if it was revoked or replaced,"
                " have it registered again (`register --replace`) and `join` the new bundle in a new folder"
            )
        case Reason.EXPIRED:
            return (
                "see to this machine's clock; if the certificates have expired, have the robot registered again, or the"
                " server's made again (`renew`)"
            )
        case Reason.FULL:
            return "wait, or ask the operator for more `shards` (server.toml)"
        case _:
            return (
                "is it up, is the address right, is UDP let through, and does it take"
                f' channel = "{channel}" (`channel` in its server.toml)? `doctor` at this home tries it'
            )


class Sender:
    """One robot's; give it every event of the client, and call `send` in every turn.

    writer: its streams are named above what the server has; one of which the server refuses a chunk is ended.
    on_server_time: is given the server's authenticated time (seconds since 1970) at each new session.

    sent, refused, confirmed: chunks in this process, by what became of them; sessions: how many there were.
    held: why nothing is sent at this moment. refusal: why there is no session, and what to do about it.
    state: what the server said last, None before it says anything in this session.
    """

    def __init__(
        self, client: Client, spool: Spool, writer: LogWriter, *, channel: str = "exchange",
        on_server_time: Callable[[float], None] = lambda seconds: None,
    ) -> None:  # fmt: skip
        self._client, self._spool, self._writer, self._channel = client, spool, writer, channel
        self._on_server_time = on_server_time
        self.sent = self.refused = self.confirmed = self.sessions = 0
        self.connected = False
        self.held = self.refusal = ""
        self.state: ServerState | None = None
        self.newest, self.block = NOWHERE, 0
        """The newest place that is confirmed on the chain, and the block that has it, as the server said last."""
        self._sent, self._digest = NOWHERE, NO_DIGEST  # up to where this session has the log, or will
        self._noted: ServerState | None = None  # what was done on the disk of what the server said
        self._offered = NOWHERE  # what was sent to show that the log forked
        self._said: dict[str, float] = {}  # reason -> when it was said

    @property
    def idle(self) -> bool:
        """The server has all that is on the disk."""
        state = self.state
        return state is not None and not self.held and not self._spool.rows(state.head, 1)

    @property
    def forked(self) -> bool:
        """Whether another machine, or an older life of this one, has written into this robot's log."""
        return self.held == FORKED or self.refusal == TWICE

    @property
    def elsewhere(self) -> str:
        """HOST:PORT of the shard to which this robot belongs, where the one that it asks says that it is another."""
        head, _, shard = ("" if self.state is None else self.state.why).partition(ELSEWHERE)
        return "" if head else shard

    # What comes

    def handle(self, event: Event, now: float) -> None:
        match event:
            case Connected(peer=peer, server_time=server_time):
                self.sessions += 1
                self.connected, self.state, self.refusal = True, None, ""
                log.info("connected to %s", peer)
                if server_time is not None and server_time <= peer.not_after:  # else its clock is wrong
                    self._on_server_time(server_time.timestamp())
            case Disconnected(reason=reason):
                self.connected, self.state, self.held = False, None, ""
                log.info("disconnected: %s", reason)
                if reason is End.REPLACED:
                    self.refusal = TWICE
                    self._warn(TWICE, TWICE, now)
            case HandshakeFailed(why=why) | Unresolved(why=why):
                todo = "" if isinstance(event, Unresolved) else f"; {fix(event, self._channel)}"
                self.refusal = why + todo
                self._warn(why, f"no session: {self.refusal}", now)
            case State(data=data):
                self.take(data, now)

    def take(self, data: bytes, now: float) -> None:
        """Take the bytes of the server's state; what comes of it is done by `send`."""
        try:
            state = ServerState.decode(data)
        except HopError as error:
            self.refusal = "the server says what is no message here; use the same version on both ends"
            self._warn(self.refusal, f"{self.refusal} ({error})", now)
            return
        known = self.state
        if known is None or state.again != known.again or not known.head <= state.head <= self._sent:
            self._sent, self._digest = state.head, state.digest
        if state.confirmed > self.newest:
            self.newest, self.block = state.confirmed, state.block
        self.state = state
        log.debug("stream %s: the server has it up to %d", state.head[:STREAM_SIZE].hex(),
                  int.from_bytes(state.head[STREAM_SIZE:], "big"))
        if int.from_bytes(state.head[:8], "big") <= MAX_TIME_MS:  # above any such time there is room for no name
            self._writer.newest = max(self._writer.newest, state.head[:STREAM_SIZE])
        if self.elsewhere:
            log.info("%s", state.why)
        elif state.why:
            self._warn(state.why, f"the server takes nothing at this moment: {state.why}", now)

    def _warn(self, why: str, text: str, now: float) -> None:
        """At most once a minute for the same reason."""
        if now - self._said.get(why, float("-inf")) >= SAY_AGAIN:
            self._said[why] = now
            log.warning("%s", text)

    # What goes

    def send(self, now: float) -> None:
        """Do what the server's state asks for, and send as much as the session takes. StoreError: call it again."""
        state = self.state
        if state is None:
            return
        if self._noted is not state:
            self._note(state)
            self._noted = state
        self.held = state.why
        if state.why:
            return
        if self._spool.place(state.refused):
            self.held = REFUSED_RIGHT
            self._warn(REFUSED_RIGHT, REFUSED_RIGHT, now)
            return
        if self._writer.stream and state.head[:STREAM_SIZE] > self._writer.stream:
            self._fork(self._spool.newest, now)  # what this process wrote stands below what somebody else did
            return
        while self._sent < self._spool.newest and (rows := self._spool.rows(self._sent, AT_ONCE)):
            for row in rows:
                if (chunk := self._spool.chunk(row.place, row.digest)) is None:
                    self._set_aside(row.digest)
                    continue
                previous = chunk.header.previous
                if previous != self._digest and self._spool.place(previous):
                    self._fork(row.place, now)
                    return
                if not self._put(chunk.encoded, b"" if previous == self._digest else self._digest):
                    return
                self._sent, self._digest = row.place, row.digest

    def _note(self, state: ServerState) -> None:
        """Take from the disk what is confirmed, and set aside what is refused."""
        ours = self._ours(state)
        if ours and state.confirmed <= state.head:
            self.confirmed += self._spool.confirmed(state.confirmed)
        if ours or state.head < self._spool.covered:
            self._spool.stored(state.head)
        if place := self._spool.place(state.refused):
            chunk = self._spool.chunk(place, state.refused)
            if chunk is None or not self._writer.wrote(chunk):
                self._set_aside(state.refused)

    def _set_aside(self, digest: bytes) -> None:
        """The chunk with this header is not what was sealed, or not by this robot's key."""
        if place := self._spool.set_aside(digest):
            self.refused += 1
            log.error(
                "chunk %d of stream %s is not sent, since its signature or its body is wrong; it is set aside"
                " and a new stream begins", int.from_bytes(place[STREAM_SIZE:], "big"), place[:STREAM_SIZE].hex(),
            )  # fmt: skip
            if place[:STREAM_SIZE] == self._writer.stream:
                self._writer.new_stream()

    def _ours(self, state: ServerState) -> bool:
        """Whether the server's head is a chunk of this robot's; not known of one that has left the disk. Who was never
        sent it does not know its digest: so a server that lies has no chunk removed that it does not have, either."""
        if (state.head, state.digest) == (self._spool.newest, self._spool.last_digest):
            return True
        before = max(0, int.from_bytes(state.head, "big") - 1).to_bytes(len(state.head), "big")
        return any((row.place, row.digest) == (state.head, state.digest) for row in self._spool.rows(before, 1))

    def _fork(self, place: bytes, now: float) -> None:
        """Send nothing more, but once the chunk at `place`, so that the server knows, too."""
        self.held = FORKED
        self._warn(FORKED, FORKED, now)
        if place != self._offered:
            [encoded] = self._spool.chunks([place])
            self._offered = place if self._put(encoded) else NOWHERE

    def _put(self, encoded: bytes, after: bytes = b"") -> bool:
        """Send it, if there is room."""
        offer = encode_offer(encoded, after)
        if self._client.room() < len(offer):
            return False
        self._client.send(offer)
        self.sent += 1
        return True
