"""What a live source counts, topic by topic; written by its network thread, read by anybody."""

from __future__ import annotations

from dataclasses import dataclass, field, replace
from enum import StrEnum


class Cause(StrEnum):
    """Why a connection to a publisher ended, or was not made."""

    UNREACHABLE = "unreachable"  # no answer, refused, name does not resolve, timed out
    CLOSED = "closed"  # by the publisher, in good order as far as one can see
    REFUSED = "refused"  # the publisher will not, or cannot be recorded: another type, no definition, a bad one
    PROTOCOL = "protocol"  # what it sent is not TCPROS or XML-RPC


@dataclass(slots=True)
class TopicCounters:
    """Of one topic, since the source was opened.

    received: messages read completely; each is emitted, still waiting, or dropped.
    dropped: messages given up because those before them were not taken fast enough.
    too_large: messages above the size that is read.
    latched: messages received as the first of a connection to a latching publisher, so perhaps not for the first time.
    connected: publishers read from now. connections: headers accepted so far. ended: by cause.
    """

    received: int = 0
    bytes: int = 0
    dropped: int = 0
    too_large: int = 0
    latched: int = 0
    connected: int = 0
    connections: int = 0
    ended: dict[Cause, int] = field(default_factory=lambda: dict.fromkeys(Cause, 0))

    def copy(self, *, dropped: int) -> TopicCounters:
        """As of now, with what only the backlog knows."""
        return replace(self, dropped=dropped, ended=dict(self.ended))
