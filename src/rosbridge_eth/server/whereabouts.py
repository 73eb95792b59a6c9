"""Where a record is, as one word: the inbox's and the journal's answers put together."""

from __future__ import annotations

from rosbridge_eth.ledger.journal import Journal
from rosbridge_eth.ledger.states import State as JobState
from rosbridge_eth.protocol import RecordStatus
from rosbridge_eth.records import RecordId
from rosbridge_eth.store import Inbox
from rosbridge_eth.store import State as InboxState

_IN_JOURNAL = {
    JobState.SEALED: "batched",
    JobState.READY: "batched",
    JobState.SPLIT: "batched",
    JobState.VOID: "batched",
    JobState.PENDING: "submitted",
    JobState.INCLUDED: "included",
    JobState.CONFIRMED: "confirmed",
    JobState.ACKNOWLEDGED: "confirmed",
    JobState.DEAD: "dead",
}
_IN_INBOX = {
    InboxState.UNKNOWN: "unknown",
    InboxState.WAITING: "stored",
    InboxState.LEASED: "stored",
    InboxState.DONE: "batched",
    InboxState.DEAD: "dead",
}


def whereabouts(id: RecordId, inbox: Inbox, journal: Journal, now: float) -> RecordStatus:
    """The record's state, and its transaction and block once it is in one."""
    location = journal.find(id)
    if location is None:
        return RecordStatus(_IN_INBOX[inbox.state(id, now)])
    transaction = None if location.tx_hash is None else "0x" + location.tx_hash.hex()
    return RecordStatus(_IN_JOURNAL[location.state], transaction, location.block_number)
