"""From the channel to the inbox: every request is answered, and a record only after its commit. No socket here.

Requests are taken in groups, as many as arrived together, so that one commit
of the inbox serves them all.
"""

from __future__ import annotations

import logging
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import dataclass

from rosbridge_eth import protocol
from rosbridge_eth.channel import End, MessageReceived, Server
from rosbridge_eth.errors import StoreError
from rosbridge_eth.identity import PeerIdentity
from rosbridge_eth.protocol import (
    Ack,
    CheckRequest,
    ProtocolError,
    RecordRequest,
    RecordStatus,
    RegisterRequest,
    Registration,
)
from rosbridge_eth.records import RecordId, SealedRecord
from rosbridge_eth.store import Inbox, Outcome

log = logging.getLogger(__name__)

MAX_CIPHERTEXT = 32 * 1024  # what sealing makes at most; longer ones the contract's batches could not hold
_ACKS = {
    Outcome.NEW: Ack.STORED,
    Outcome.DUPLICATE: Ack.STORED,
    Outcome.CONFLICT: Ack.CONFLICT,
    Outcome.FULL: Ack.BUSY,
}

_COUNTED = {
    Outcome.NEW: "stored",
    Outcome.DUPLICATE: "duplicate",
    Outcome.CONFLICT: "conflict",
    Outcome.FULL: "busy",
}


@dataclass(frozen=True, slots=True)
class _Arrived:
    message: MessageReceived
    record: SealedRecord


class Reception:
    """Answers the requests of one server endpoint.

    status_of: where a record is, asked for CHECK. registration_of: what is
    known of a robot, asked for REGISTER.
    """

    def __init__(
        self,
        server: Server,
        inbox: Inbox,
        *,
        status_of: Callable[[RecordId], RecordStatus],
        registration_of: Callable[[PeerIdentity], Registration],
    ) -> None:
        self._server, self._inbox = server, inbox
        self._status_of, self._registration_of = status_of, registration_of
        self.acks: Counter[Ack] = Counter()
        self.counts: Counter[str] = Counter()
        """Records by what became of them: stored, duplicate, conflict, busy, refused."""
        self.trouble: str | None = None

    def take(self, messages: Sequence[MessageReceived], *, wall: float, now: float) -> None:
        """Answer all of `messages`. wall: seconds since 1970, for the inbox; now: the channel's clock."""
        arrived: list[_Arrived] = []
        for message in messages:
            try:
                request = protocol.decode_request(message.payload, message.peer.robot_id)
            except ProtocolError as error:
                log.warning("%s: %s; its session is closed", message.peer, error)
                self._server.close_connection(message.connection, now, End.PROTOCOL)
                continue
            match request:
                case RecordRequest(record) if len(record.ciphertext) <= MAX_CIPHERTEXT:
                    arrived.append(_Arrived(message, record))
                case RecordRequest():
                    self.counts["refused"] += 1
                    self._acknowledge(message, Ack.REFUSED)
                case CheckRequest(id):
                    self._reply(message, protocol.encode_answer(self._status(id)))
                case RegisterRequest():
                    self._reply(message, protocol.encode_answer(self._registration_of(message.peer)))
        if arrived:
            self._store(arrived, wall)

    def _store(self, arrived: Sequence[_Arrived], wall: float) -> None:
        try:
            outcomes = self._inbox.append([entry.record for entry in arrived], wall)
        except StoreError as error:
            # Nothing was committed, so nothing is acknowledged: the robots keep it and try again.
            if self.trouble is None:
                log.error("records are not taken: %s", error)
            self.trouble = str(error)
            self.counts["busy"] += len(arrived)
            for entry in arrived:
                self._acknowledge(entry.message, Ack.BUSY)
            return
        self.trouble = None
        for entry, outcome in zip(arrived, outcomes, strict=True):
            self.counts[_COUNTED[outcome]] += 1
            log.debug("record %s: %s", entry.record.id, _COUNTED[outcome])
            if outcome is Outcome.CONFLICT:
                log.error("record %s of %s: its identity is taken by other bytes", entry.record.id, entry.message.peer)
            self._acknowledge(entry.message, _ACKS[outcome])

    def _status(self, id: RecordId) -> RecordStatus:
        try:
            return self._status_of(id)
        except StoreError as error:
            log.warning("a robot's question is not answered: %s", error)
            return RecordStatus("unavailable")

    def _acknowledge(self, message: MessageReceived, ack: Ack) -> None:
        self.acks[ack] += 1
        self._reply(message, protocol.encode_ack(ack))

    def _reply(self, message: MessageReceived, payload: bytes) -> None:
        self._server.reply(message.connection, message.message_id, payload)
