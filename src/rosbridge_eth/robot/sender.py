"""From the spool through the channel to the server's acknowledgement. Sans-IO: it drives a Client, no socket.

A record leaves the spool when the server stored it durably, or, by choice,
when its block is confirmed. A session that ends gives all unanswered records
back to the spool; the server recognises what it has already.
"""

from __future__ import annotations

import logging
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

from rosbridge_eth import protocol
from rosbridge_eth.channel import Client, Connected, Disconnected, Event, HandshakeFailed, MessageAnswered, Reason
from rosbridge_eth.errors import NetworkError
from rosbridge_eth.protocol import (
    Ack,
    CheckRequest,
    ProtocolError,
    RecordRequest,
    RecordStatus,
    RegisterRequest,
    Registration,
)
from rosbridge_eth.records import RecordId
from rosbridge_eth.store import Spool

log = logging.getLogger(__name__)

BUSY_PAUSE = 1.0  # seconds without sending after the server had no room
CHECK_EVERY = 0.5  # seconds between rounds of asking whether stored records are confirmed
CHECKS_AT_ONCE = 128
SAY_AGAIN = 60.0  # seconds before the same reason for having no session is said once more
_LOST = {"unknown"}  # the server lost the record after acknowledging it: send it again


@dataclass(slots=True)
class SenderStatistics:
    """Records by what became of them, and what the robot knows of the server."""

    sent: int = 0
    stored: int = 0
    confirmed: int = 0
    conflicts: int = 0
    refused: int = 0
    busy: int = 0
    sessions: int = 0
    connected: bool = False
    trouble: str | None = None
    refusal: str | None = None
    """Why there has been no session since the last one, and what to do about it."""
    registration: Registration | None = None


def mend(failure: HandshakeFailed, channel: str) -> str:
    """What to do about a session that did not come about; `channel` is the configured mode."""
    match failure.hint:
        case Reason.NOT_ALLOWED | Reason.CERTIFICATE:
            return (
                "ask the operator, whose `status` says whether this robot is in force; if it was revoked or replaced,"
                " have it registered again (`register --replace`) and `join` the new bundle in a new folder: records"
                " sealed under a replaced identity cannot be delivered"
            )
        case Reason.EXPIRED:
            return "see to this machine's clock; if the certificates have expired, have the robot registered again"
        case Reason.FULL:
            return "wait, or ask the operator for more [limits] connections"
        case _:
            return (
                "is it up, is the address right, is UDP let through, and does it take"
                f' channel = "{channel}" (`channel` in its server.toml)? `doctor` at this home tries it'
            )


class Sender:
    """Moves records from a spool through a client. `release` says when a record may leave the spool.

    before_sending: called on a live session before records are taken; the
    robot declares dropped records there.
    channel: the configured mode, for what is said where no session comes about.
    on_server_time: given the server's authenticated time (seconds since 1970) at each new session.
    """

    def __init__(
        self,
        client: Client,
        spool: Spool,
        *,
        release: Literal["stored", "confirmed"] = "stored",
        channel: str = "exchange",
        before_sending: Callable[[], object] = lambda: None,
        on_server_time: Callable[[float], None] = lambda seconds: None,
    ) -> None:
        self._client, self._spool = client, spool
        self._wait_for_chain = release == "confirmed"
        self._channel = channel
        self._said: dict[str, float] = {}  # reason for having no session -> when it was said
        self._before_sending, self._on_server_time = before_sending, on_server_time
        self._records: dict[int, RecordId] = {}  # message id -> record waiting for its acknowledgement
        self._checks: dict[int, RecordId] = {}
        self._register: int | None = None
        self._unconfirmed: dict[RecordId, None] = {}  # stored, waiting for the chain; oldest first
        self._next_check = 0.0
        self._resume_at = 0.0
        self.statistics = SenderStatistics()

    @property
    def idle(self) -> bool:
        """Nothing is on its way and nothing waits in the spool to go."""
        return not self._records and not self._unconfirmed and self._spool.empty

    def next_timer(self) -> float | None:
        """When `send` should be called although no event came (monotonic seconds)."""
        timers = []
        if self._resume_at:
            timers.append(self._resume_at)
        if self._unconfirmed:
            timers.append(self._next_check)
        return min(timers, default=None)

    def send(self, now: float) -> None:
        """Send as much as the session takes."""
        if not self._client.writable(now) or now < self._resume_at:
            return
        self._resume_at = 0.0
        if self._register is None:
            self._register = self._client.send(protocol.encode_request(RegisterRequest()), priority=0)
        self._check(now)
        self._before_sending()
        while self._client.writable(now):
            # One by one: what a full window does not take must not be handed out.
            records = self._spool.pending(1)
            if not records:
                break
            message = self._client.send(protocol.encode_request(RecordRequest(records[0])))
            self._records[message] = records[0].id
            log.debug("record %s: sent", records[0].id)
            self.statistics.sent += 1

    def _check(self, now: float) -> None:
        if not self._unconfirmed or now < self._next_check:
            return
        self._next_check = now + CHECK_EVERY
        asked = set(self._checks.values())
        for id in [id for id in self._unconfirmed if id not in asked][: CHECKS_AT_ONCE - len(asked)]:
            if not self._client.writable(now, 64):
                break
            self._checks[self._client.send(protocol.encode_request(CheckRequest(id)), priority=0)] = id

    def handle(self, event: Event, now: float) -> None:
        """Take one event of the client."""
        match event:
            case Connected(peer=peer, server_time=server_time):
                self.statistics.sessions += 1
                self.statistics.connected = True
                self.statistics.trouble = self.statistics.refusal = None
                log.info("connected to %s", peer)
                if server_time is not None:
                    self._on_server_time(server_time.timestamp())
            case Disconnected(reason=reason):
                self.statistics.connected = False
                self.statistics.trouble = str(reason)
                log.info("disconnected: %s", reason)
                self._spool.returned(self._records.values())
                self._records.clear()
                self._checks.clear()
                self._register = None
            case HandshakeFailed(why=why):
                self.statistics.trouble = why
                self.statistics.refusal = f"{why}; {mend(event, self._channel)}"
                if now - self._said.get(why, float("-inf")) >= SAY_AGAIN:  # not at every attempt
                    self._said[why] = now
                    log.warning("no session: %s", self.statistics.refusal)
            case MessageAnswered(message_id=message, payload=payload):
                try:
                    self._answered(message, payload, now)
                except ProtocolError as error:  # nothing is lost: what was not acknowledged is in the spool
                    raise NetworkError(
                        f"the server gives an answer that is none here ({error}); use the same version on both ends"
                    ) from error

    def _answered(self, message: int, payload: bytes, now: float) -> None:
        if message == self._register:
            self.statistics.registration = protocol.decode_registration(payload)
        elif message in self._checks:
            self._checked(self._checks.pop(message), protocol.decode_status(payload), now)
        elif message in self._records:
            self._acknowledged(self._records.pop(message), protocol.decode_ack(payload), now)

    def _acknowledged(self, id: RecordId, ack: Ack, now: float) -> None:
        match ack:
            case Ack.STORED:
                self.statistics.stored += 1
                log.debug("record %s: stored by the server", id)
                if self._wait_for_chain:
                    self._unconfirmed[id] = None
                    return
            case Ack.BUSY:
                self.statistics.busy += 1
                self._resume_at = now + BUSY_PAUSE
                self._spool.returned([id])
                return
            case Ack.CONFLICT:
                # The server keeps both for the operator; sending it again would change nothing.
                self.statistics.conflicts += 1
                log.error("record %s: the server has other bytes under this identity", id)
            case Ack.REFUSED:
                self.statistics.refused += 1
                log.error("record %s: the server does not take it", id)
        self._spool.acknowledged([id], now)

    def _checked(self, id: RecordId, status: RecordStatus, now: float) -> None:
        if id not in self._unconfirmed:
            return
        if status.state in _LOST:
            del self._unconfirmed[id]
            self._spool.returned([id])
        elif status.state in ("confirmed", "dead"):
            del self._unconfirmed[id]
            self.statistics.confirmed += status.state == "confirmed"
            if status.state == "dead":
                log.error("record %s: the ledger can never take it; the operator has it as a dead letter", id)
            self._spool.acknowledged([id], now)
