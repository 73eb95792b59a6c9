"""The robot's end of the hop to the server: asks what is there of a stream, and sends what follows. Sans-IO.

The one rule: the server's word for what is there, the robot's for what follows. Streams are gone through in the order
of the log, each begun with the question what the server has of it (protocol.Where); a session begins with the oldest
chunk that is not confirmed on the chain.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass

from rosbridge_eth import protocol
from rosbridge_eth.channel import Client, Connected, Disconnected, Event, HandshakeFailed, Message, Reason, Unresolved
from rosbridge_eth.errors import StoreError
from rosbridge_eth.protocol import Confirmed, Hold, Offer, ProtocolError, Refused, Stored, Where
from rosbridge_eth.spool import Spool

log = logging.getLogger(__name__)

READ_AHEAD = 256 * 1024  # bytes of chunks read from the spool at a time
SAY_AGAIN = 60.0  # seconds before the same reason why nothing is sent is said once more


def mend(failure: HandshakeFailed, channel: str) -> str:
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
                " server's made anew (`renew`)"
            )
        case Reason.FULL:
            return "wait, or ask the operator for more `shards` (server.toml)"
        case _:
            return (
                "is it up, is the address right, is UDP let through, and does it take"
                f' channel = "{channel}" (`channel` in its server.toml)? `doctor` at this home tries it'
            )


@dataclass(slots=True)
class SenderStatistics:
    """Chunks by what became of them in this process, and the session."""

    sent: int = 0
    refused: int = 0
    sessions: int = 0
    connected: bool = False
    held: str | None = None
    """Why the server wants nothing at this moment."""
    confirmed: int = 0
    newest: Confirmed | None = None
    """What the server said last of what is confirmed."""
    refusal: str | None = None
    """Why there has been no session since the last one, and what to do about it."""


class Sender:
    """From the spool through the channel: asks what the server has of a stream, and sends what follows. Sans-IO.

    on_server_time: is given the server's authenticated time (seconds since 1970) at each new session.
    """

    def __init__(
        self, client: Client, spool: Spool, *, channel: str = "exchange",
        on_server_time: Callable[[float], None] = lambda seconds: None,
    ) -> None:  # fmt: skip
        self._client, self._spool, self._channel = client, spool, channel
        self._on_server_time = on_server_time
        self.begin_stream: Callable[[bytes], None] = lambda refused: None
        """Called when the server refused a stream, which may be the one that is being written."""
        self._said: dict[str, float] = {}  # reason -> when it was said
        self._stream: bytes | None = None  # being sent; None: the next one is to be asked about
        self._sent: int | None = None  # the newest number of it that went out in this session, or that is stored
        self._stored: int | None = None  # the newest number of it that the server has
        self._asked = False  # a question is out, or a hold is on: nothing is sent until the next Stored
        self.statistics = SenderStatistics()

    @property
    def idle(self) -> bool:
        """The server has all that the spool has."""
        return self._spool.statistics().unstored == 0

    def send(self) -> None:
        """Send as much as the session takes."""
        if not self.statistics.connected or self._asked:
            return
        if self._stream is None:
            self._ask(self._spool.next_stream(b""))
            return
        if not self._client.writable():
            return
        for chunk in self._spool.following(self._stream, self._sent, READ_AHEAD):
            if not self._put(Offer(chunk.encoded)):
                return
            self._sent = chunk.header.number
            self.statistics.sent += 1
        if self._sent == self._stored:
            self._ask(self._spool.next_stream(self._stream))

    def _put(self, message: protocol.Up) -> bool:
        """Send it, if there is room."""
        encoded = protocol.encode(message)
        if not self._client.writable(len(encoded)):
            return False
        self._client.send(encoded)
        self._client.expecting(True)
        return True

    def _ask(self, place: tuple[bytes, int, bytes] | None) -> None:
        if place is not None and self._put(Where(*place)):
            self._stream, self._sent, self._stored, self._asked = place[0], None, None, True

    def handle(self, event: Event, now: float) -> None:
        """Take one event of the client. StoreError where the spool cannot note it; then it is asked for again."""
        match event:
            case Connected(peer=peer, server_time=server_time):
                self.statistics.sessions += 1
                self.statistics.connected = True
                self.statistics.refusal = None
                self._stream, self._asked = None, False
                log.info("connected to %s", peer)
                if server_time is not None and server_time <= peer.not_after:  # else its clock is wrong
                    self._on_server_time(server_time.timestamp())
            case Disconnected(reason=reason):
                self.statistics.connected, self.statistics.held = False, None
                log.info("disconnected: %s", reason)
            case HandshakeFailed(why=why) | Unresolved(why=why):
                todo = "" if isinstance(event, Unresolved) else f"; {mend(event, self._channel)}"
                self.statistics.refusal = why + todo
                self._warn(why, f"no session: {self.statistics.refusal}", now)
            case Message(payload=payload):
                try:
                    self._take(protocol.decode_down(payload), now)
                except ProtocolError as error:
                    why = "the server says what is no message here; use the same version on both ends"
                    self.statistics.refusal = why
                    self._warn(why, f"{why} ({error})", now)
                except StoreError:  # not noted: ask again, and the server says it again
                    self._stream, self._asked = None, False
                    raise

    def _warn(self, why: str, text: str, now: float) -> None:
        """At most once a minute for the same reason."""
        if now - self._said.get(why, float("-inf")) >= SAY_AGAIN:
            self._said[why] = now
            log.warning("%s", text)

    def _take(self, message: protocol.Down, now: float) -> None:
        match message:
            case Stored() if self.statistics.held is not None:  # it takes chunks again: ask from the beginning
                self._stream, self._asked, self.statistics.held = None, False, None
            case Stored(stream=stream, number=number) if stream == self._stream:
                if self._asked:  # the server's word for what is there, ours for what follows
                    self._spool.lost(stream, number)
                    self._sent, self._asked = number, False
                self._stored = number
                if number is not None:
                    self._spool.stored(stream, number)
                    self._client.progressed()
                self._client.expecting(self._sent != self._stored)
                log.debug("stream %s: the server has it up to %s", stream.hex(), number)
            case Confirmed(stream=stream, number=number):
                self.statistics.confirmed += self._spool.confirmed(stream, number)
                self.statistics.newest = message
                log.debug("stream %s: confirmed up to %d", stream.hex(), number)
            case Hold(why=why):
                self._asked, self.statistics.held = True, why
                self._client.expecting(False)
                self._warn(why, f"the server takes nothing at this moment: {why}", now)
            case Refused(stream=stream, number=number, why=why):
                aside = self._spool.set_aside(stream, number)
                self.statistics.refused += aside
                log.error(
                    "the server refuses chunk %d of stream %s: %s; %d chunks are set aside and a new stream begins",
                    number, stream.hex(), why, aside,
                )
                self.begin_stream(stream)
                if stream == self._stream:
                    self._stream, self._asked = None, False
                    self._client.expecting(False)
