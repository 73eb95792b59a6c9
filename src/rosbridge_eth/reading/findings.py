"""What a reader may find wrong, or unproven, in a robot's history: each its own kind."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum


class Severity(Enum):
    """VIOLATION: somebody did what they must not, or something is lost. NOTICE: true, worth knowing, no breach."""

    VIOLATION = "violation"
    NOTICE = "notice"


class FindingKind(Enum):
    """Its name for programs, its severity, and what it means, as a sentence."""

    # One record
    MALFORMED = "malformed", Severity.VIOLATION, "has not the form of a record"
    ALTERED = "altered", Severity.VIOLATION, "is not what the robot sealed"
    FORGED = "forged", Severity.VIOLATION, "does not bear the robot's signature"
    CONFLICTING = "conflicting", Severity.VIOLATION, "is written more than once, with other bytes"
    DUPLICATED = "duplicated", Severity.VIOLATION, "is written more than once"
    REORDERED = "reordered", Severity.NOTICE, "is written after records that followed it; shown in the robot's order"
    STRANGER = "stranger", Severity.VIOLATION, "was written by an account that was not the robot's"
    OTHER_ROBOT = "other-robot", Severity.VIOLATION, "is another robot's"
    AFTER_REVOCATION = "after-revocation", Severity.VIOLATION, "was written after its certificate was revoked"
    OUTSIDE_VALIDITY = "outside-validity", Severity.VIOLATION, "was written outside its certificate's validity"
    # Records that are not there
    MISSING = "missing", Severity.VIOLATION, "was sealed and neither written nor declared as dropped"
    TAIL_MISSING = "tail-missing", Severity.VIOLATION, "came last in its stream, and was not written"
    DROPPED = "dropped", Severity.NOTICE, "was dropped by the robot, which says so"
    UNDECIDED = "undecided", Severity.NOTICE, "is not written; if it was dropped, this reader may not see it"
    BEFORE_RANGE = "before-range", Severity.NOTICE, "lies before what was fetched"
    # Streams
    NO_OPEN = "no-open", Severity.VIOLATION, "has no open record: nobody can open it"
    NO_GRANT = "no-grant", Severity.NOTICE, "was not granted to this reader"
    WRONG_KEY = "wrong-key", Severity.VIOLATION, "grants this reader a key that is not its own"
    UNKNOWN_PREVIOUS = "unknown-previous", Severity.VIOLATION, "follows a stream of which nothing is written"
    PREVIOUS_MISMATCH = "previous-mismatch", Severity.VIOLATION, "goes on beyond where the robot says that it ended"
    FORKED = "forked", Severity.VIOLATION, "is followed by two streams: a restored disk, or a second robot with its key"
    RESTARTED = "restarted", Severity.NOTICE, "begins without knowing of the streams before: the robot lost its spool"
    END_UNKNOWN = "end-unknown", Severity.NOTICE, "has no known end: later records may exist that are not written yet"
    # The robot
    UNTRUSTED = "untrusted", Severity.VIOLATION, "the registered certificate is not to be trusted"
    UNREGISTERED = "unregistered", Severity.VIOLATION, "the robot is not registered"
    CLOCK = "clock", Severity.NOTICE, "was captured while the robot's clock was not synchronised"

    def __init__(self, label: str, severity: Severity, meaning: str) -> None:
        self.label = label
        self.severity = severity
        self.meaning = meaning


@dataclass(frozen=True, slots=True)
class Finding:
    """One finding. stream, first, last: which records, both ends included; None where it is about more than that.

    block: where it was seen, if it was. detail: what is known besides the kind.
    """

    kind: FindingKind
    stream: bytes | None = None
    first: int | None = None
    last: int | None = None
    block: int | None = None
    detail: str = ""

    @property
    def severity(self) -> Severity:
        return self.kind.severity

    def __str__(self) -> str:
        parts = [self.kind.label, ":"]
        if self.stream is not None:
            parts.append(f" stream {self.stream.hex()[:8]}")
        if self.first is not None:
            single = self.last in (None, self.first)
            parts.append(f" record {self.first}" if single else f" records {self.first}-{self.last}")
        if self.block is not None:
            parts.append(f" in block {self.block}")
        parts.append(f" {self.kind.meaning}")
        if self.detail:
            parts.append(f" ({self.detail})")
        return "".join(parts)
