"""What a reading ends with: findings, the verdict, and the bookmark from which the next reading goes on.

A violation says that the log on the chain is not what the robot wrote, or not all of it. A notice is true and
worth knowing, and no breach. Whatever of a log is shown goes through `shown`.
"""

from __future__ import annotations

import fcntl
import os
from array import array
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping
from dataclasses import asdict, dataclass, field, fields, replace
from enum import Enum
from pathlib import Path
from typing import Annotated, Any, Final, Literal, NamedTuple

import numpy
from pydantic import BaseModel, Field, StringConstraints, ValidationError

from rosbridge_eth.capture import TypeLine
from rosbridge_eth.config.values import counted, duration_text, time_text
from rosbridge_eth.errors import ConfigError
from rosbridge_eth.files import write_atomically
from rosbridge_eth.log.chunk import Log
from smcrypto import sm2

MAX_FINDINGS: Final = 500
"""Findings kept one by one, notices only among the first half; what is above that is counted by kind."""
MAX_PLACES: Final = 100
"""Runs of chunks that are kept of a finding."""
MAX_SHOWN: Final = 120
HEARTBEAT: Final = 3600.0
"""Seconds without a message after which a robot seals an empty chunk, unless its robot.toml says otherwise."""


class Kind(Enum):
    """A finding's name for programs, whether it is a violation, what its count counts, and what it says."""

    MALFORMED = "malformed", True, "chunk", "not in the form of a chunk"
    ALTERED = "altered", True, "chunk", "not what the robot sealed"
    FORGED = "forged", True, "chunk", "not signed by the robot for this place"
    MISSING = "missing", True, "place", "the robot wrote more before this than the chain has"
    FORKED = "forked", True, "place", "the log continues in two ways from here"
    UNTRUSTED = "untrusted", True, "chunk", "no certificate of this robot that is to be trusted governs this"
    WITHHELD = "withheld", True, "chunk", "counted by the contract and not shown by the node"
    ROLLED_BACK = "rolled-back", True, "place", "what an earlier reading found here is not here now"
    CONTRADICTED = "contradicted", True, "difference", "the nodes do not say the same of this robot"
    UNOPENABLE = "unopenable", True, "chunk", "the signature holds and the content does not"
    DROPPED = "dropped", False, "record", "dropped by the robot, whose disk or spool was full"
    LOST = "lost", False, "message", "not captured, says the robot"
    TRIGGERED = "triggered", False, "event", "what the robot kept in memory for it is written"
    RESTARTED = "restarted", False, "restart", "restarted without a goodbye"
    NEW_CERTIFICATE = "new-certificate", False, "certificate", "not known to this reader: compare its fingerprint"
    NO_GRANT = "no-grant", False, "record", "not for this reader"
    CLOCK = "clock", False, "time", "the robot's clock may have been wrong"

    label: str
    violation: bool
    unit: str
    meaning: str

    def __new__(cls, label: str, violation: bool, unit: str, meaning: str) -> Kind:
        kind = object.__new__(cls)
        kind._value_ = kind.label = label
        kind.violation, kind.unit, kind.meaning = violation, unit, meaning
        return kind

    def counted(self, count: int) -> str:
        return counted(count, self.unit)


@dataclass(slots=True)
class Finding:
    """places: first and last index of each run of chunks in the robot's log on the chain, both included, ascending.

    more: places that are not among them, since there would be more than MAX_PLACES. detail: safe to show.
    """

    kind: Kind
    places: list[tuple[int, int]]
    count: int
    detail: str
    more: int = 0

    def __str__(self) -> str:
        runs = [str(first) if first == last else f"{first} to {last}" for first, last in self.places]
        where = f"chunk{'' if runs == [str(self.places[0][0])] else 's'} {', '.join(runs)}"
        more = f" and {self.more:,} places behind" if self.more else ""
        return f"{self.kind.label}: {where}{more}: {self.kind.counted(self.count)}: {self.kind.meaning}" + (
            f" ({self.detail})" if self.detail else ""
        )

    def add(self, first: int, last: int, count: int) -> None:
        self.count += count
        begin, end = self.places[-1]
        if begin <= first <= end + 1 and not self.more:
            self.places[-1] = begin, max(end, last)
        elif len(self.places) < MAX_PLACES:
            self.places.append((first, last))
        else:
            self.more += 1


class Findings:
    """Collects findings in bounded memory: those of one kind and detail are one."""

    def __init__(self, counts: Mapping[str, int], kept: Iterable[Finding]) -> None:
        self.counts: Counter[str] = Counter(counts)
        self.kept = [replace(one, places=[*one.places]) for one in kept]
        self._latest = {(one.kind, one.detail): one for one in self.kept}

    def add(self, kind: Kind, first: int, last: int | None = None, *, count: int = 1, detail: str = "") -> None:
        last = first if last is None else last
        self.counts[kind.label] += count
        known = self._latest.get((kind, detail))
        if known is not None:
            known.add(first, last, count)
        elif len(self.kept) < (MAX_FINDINGS if kind.violation else MAX_FINDINGS // 2):
            found = self._latest[kind, detail] = Finding(kind, [(first, last)], count, detail)
            self.kept.append(found)

    @property
    def sound(self) -> bool:
        return not any(self.counts[kind.label] for kind in Kind if kind.violation)


class Head(NamedTuple):
    """The robot's newest chunk as the reading has it: what the next one has to follow."""

    stream: str
    number: int
    digest: str
    sealed_ms: int
    goodbye: bool


class Links:
    """Of the robot's chunks that were read: the first 8 bytes of each digest, and whether it came without its body."""

    def __init__(self) -> None:
        self.digests, self.dropped = array("Q"), bytearray()

    def add(self, digest: bytes, dropped: bool) -> None:
        self.digests.append(int.from_bytes(digest[:8], "big"))
        self.dropped.append(dropped)

    def _find(self, digest: bytes) -> int | None:
        known = numpy.asarray(self.digests)
        found = numpy.flatnonzero(known == int.from_bytes(digest[:8], "big"))
        return int(found[0]) if len(found) else None

    def __contains__(self, digest: bytes) -> bool:
        return self._find(digest) is not None

    def restore(self, digest: bytes) -> bool:
        """Whether only the dropped form of this chunk was read; from now on the whole one was."""
        at = self._find(digest)
        if at is None or not self.dropped[at]:
            return False
        self.dropped[at] = False
        return True


@dataclass(slots=True)
class Progress:
    """Where a reading stands in a log, with all that it needs to go on from there and to end as one that read all.

    count: chunks read. digest: hex of the last one's identity; tail: of its keccak256. found: counts of the findings.
    """

    count: int = 0
    digest: str = ""
    tail: str = ""
    head: Head | None = None
    records: int = 0
    types: dict[str, TypeLine] = field(default_factory=dict)
    found: dict[str, int] = field(default_factory=dict)
    findings: list[Finding] = field(default_factory=list)


@dataclass(slots=True)
class Bookmark:
    """How far a reading has come; kept, so that the reader cannot be shown another log, unseen.

    count: chunks read. digest: hex of the last one's identity. fingerprints: certificates that were accepted. time: of
    the newest block that was read up to, seconds since 1970, and not later than the reader's clock.
    """

    count: Annotated[int, Field(ge=0)] = 0
    digest: str = ""
    fingerprints: tuple[str, ...] = ()
    time: float = 0.0


class _File(BaseModel, strict=True, extra="forbid"):
    """By ledger and robot, the bookmark."""

    format: Literal[1] = 1
    logs: dict[Annotated[str, StringConstraints(pattern=r"^[0-9a-f]{64}/[0-9a-f]{64}$")], Bookmark] = {}


class Bookmarks:
    """A JSON file beside the reader's key: of each ledger and robot, the bookmark."""

    def __init__(self, path: Path) -> None:
        self._path = path
        self._logs()

    def _logs(self) -> dict[str, Bookmark]:
        """As they are now: another command may have moved one."""
        try:
            return _File.model_validate_json(self._path.read_bytes()).logs
        except FileNotFoundError:
            return {}
        except (ValueError, OSError) as error:
            why = error.errors(include_url=False)[0]["msg"] if isinstance(error, ValidationError) else error
            raise ConfigError(
                f"the bookmarks in {self._path} cannot be used ({shown(str(why))}); bring the file back from a copy:"
                " without it a reading cannot know whether the log is the one that was read before"
            ) from error

    def get(self, log: Log) -> Bookmark | None:
        return self._logs().get(_key(log))

    def put(self, log: Log, bookmark: Bookmark) -> None:
        """Move it. Where another command has moved it further it stays there, with these fingerprints."""
        folder = os.open(self._path.parent, os.O_RDONLY)
        try:
            fcntl.flock(folder, fcntl.LOCK_EX)  # what another command puts meanwhile is not written over
            logs = self._logs()
            known = logs.get(_key(log))
            if known is not None and known.count > bookmark.count:
                bookmark = replace(known, fingerprints=bookmark.fingerprints)
            if bookmark != known:
                file = _File(logs=logs | {_key(log): bookmark})
                write_atomically(self._path, file.model_dump_json(indent=1).encode() + b"\n")
        finally:
            os.close(folder)


def _key(log: Log) -> str:
    return f"{log.ledger.hex()}/{log.tk.hex()}"


@dataclass(frozen=True, slots=True)
class Governing:
    """A registration or revocation, and from which chunk on it holds. fingerprint: SM3 of the signing certificate.

    key: None where the certificates are not to be trusted, and `why`. Times are milliseconds since 1970.
    """

    first: int
    block: int
    account: str
    fingerprint: str
    revoked: bool
    new: bool
    key: sm2.PublicKey | None
    why: str
    begins_ms: int
    ends_ms: int

    def __str__(self) -> str:
        if self.revoked:
            return f"revoked from chunk {self.first} on, in block {self.block}"
        new = ", NEW to this reader" if self.new else ""
        bad = f", NOT TRUSTED: {self.why}" if self.key is None else ""
        return f"from chunk {self.first} on, in block {self.block}: {grouped(self.fingerprint)}{new}{bad}"

    def as_json(self) -> dict[str, Any]:
        shown = {name: getattr(self, name) for name in ("first", "block", "account", "fingerprint", "revoked", "new")}
        return shown | {"trusted": self.key is not None}


@dataclass(frozen=True, slots=True)
class Verdict:
    """How a reading ended. What is counted is counted since the first chunk, over all readings that the bookmark links.

    chunks: how many the contract counts. block: up to which the chain was looked at. records: opened and proven.
    head: the newest chunk that is the robot's; None where there is none. silent: it is older than a
    HEARTBEAT, and the robot has not said goodbye. nodes: what other nodes said otherwise.
    """

    robot: str
    sound: bool
    chunks: int
    block: int
    head: Head | None
    records: int
    counts: Mapping[str, int]
    certificates: tuple[Governing, ...]
    silent: bool
    findings: tuple[Finding, ...]
    nodes: tuple[str, ...] = ()

    def lines(self) -> Iterator[str]:
        """For a person. Nothing in them can act on a terminal."""
        sound = "sound" if self.sound else "NOT SOUND"
        yield f"{self.robot}: {sound}, {counted(self.chunks, 'chunk')}, read up to block {self.block}"
        head = self.head
        if head is None:
            yield "  no chunk of this robot is written"
        else:
            yield (
                f"  the last one is number {head.number} of stream {head.stream}, which the robot sealed at"
                f" {time_text(head.sealed_ms * 10**6)} by its clock"
            )
            if head.goodbye:
                yield "  the robot has said goodbye: up to there, nothing is missing at the end"
            elif self.silent:
                ago = f"longer ago than {duration_text(HEARTBEAT)}, a robot's heartbeat if it was set no other"
                yield f"  that is {ago}: it is silent, or what it wrote since is withheld or not written yet"
            else:
                yield "  the robot has not said goodbye: more may follow"
        told = [kind for kind in Kind if kind.label in self.counts]
        counts = "".join(f"; {kind.label}: {kind.counted(self.counts[kind.label])}" for kind in told)
        yield f"  {counted(self.records, 'record')} proven{counts}"
        yield from (f"  certificate {certificate}" for certificate in self.certificates)
        yield from (f"  {finding}" for finding in self.findings)
        if sum(one.count for one in self.findings) < sum(self.counts.values()):
            yield f"  only the first {len(self.findings)} findings are listed; the counts above are whole"
        yield from (f"  {node}" for node in self.nodes)

    def as_json(self) -> dict[str, Any]:
        value = {each.name: getattr(self, each.name) for each in fields(self)}
        value["head"] = None if self.head is None else self.head._asdict()
        value["certificates"] = [one.as_json() for one in self.certificates]
        value["findings"] = [
            asdict(one) | {"kind": one.kind.label, "violation": one.kind.violation} for one in self.findings
        ]
        return value


def shown(text: str, limit: int = MAX_SHOWN) -> str:
    """Foreign text for a person: one line, short, and nothing in it acts on a terminal."""
    return printable(text if len(text) <= limit else text[: limit - 3] + "...")


def printable(text: str) -> str:
    r"""The text with what is not printable as JSON's `\uXXXX`; of a JSON text, the same JSON."""
    if text.isprintable():
        return text
    return "".join(char if char.isprintable() else _escaped(char) for char in text)


def _escaped(char: str) -> str:
    units = char.encode("utf-16-be", "surrogatepass")
    return "".join(f"\\u{units[at]:02x}{units[at + 1]:02x}" for at in range(0, len(units), 2))


def grouped(fingerprint: str) -> str:
    """A fingerprint as people compare it: groups of four."""
    return " ".join(fingerprint[at : at + 4] for at in range(0, len(fingerprint), 4))
