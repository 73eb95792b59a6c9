"""Proving a robot's history: what was fetched from the chain, and a reader's key, to records and findings.

Pure: no clock, no chain. Whoever wrote the records to the chain is trusted
with nothing. A record counts only if its tag and the robot's signature hold;
which ones there have to be follows from signed statements alone: seq counts
from 0, `gap` names what was dropped, `end` and the next stream's `open` name
the last. docs/records.md argues what that proves and what it does not.
"""

from __future__ import annotations

import json
from collections import defaultdict
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from datetime import UTC, datetime
from typing import Any, Protocol

from rosbridge_eth.errors import IdentityError, VerificationError
from rosbridge_eth.identity import PeerIdentity, Role, Trust, verify
from rosbridge_eth.reading.findings import Finding, FindingKind, Severity
from rosbridge_eth.records import RecordId, SealedRecord, SeqRange, robot_id
from rosbridge_eth.sealing import (
    Altered,
    Forged,
    Kind,
    Malformed,
    NoGrant,
    OpenedRecord,
    Opener,
    Opening,
    OpenStream,
    read_opening,
)


class ChainItem(Protocol):
    """A record and where the chain has it; `ledger.history.ChainRecord` is one. Times are UTC seconds."""

    @property
    def record(self) -> SealedRecord: ...
    @property
    def block_number(self) -> int: ...
    @property
    def block_timestamp(self) -> int: ...
    @property
    def log_index(self) -> int: ...
    @property
    def leaf(self) -> int: ...
    @property
    def tx_hash(self) -> bytes: ...
    @property
    def sender(self) -> str: ...


class ChainRegistration(Protocol):
    """A registration of the robot; `ledger.history.Registration` is one. certificates: see join_certificates."""

    @property
    def account(self) -> str: ...
    @property
    def certificates(self) -> bytes: ...
    @property
    def block_number(self) -> int: ...
    @property
    def block_timestamp(self) -> int: ...
    @property
    def revoked_block(self) -> int | None: ...


@dataclass(frozen=True, slots=True)
class ProvenRecord:
    """A payload that the robot signed, and where it is written. `opened` has what proves it to third parties."""

    opened: OpenedRecord
    item: ChainItem

    @property
    def id(self) -> RecordId:
        return self.opened.id

    @property
    def payload(self) -> bytes:
        return self.opened.payload

    def content(self) -> dict[str, Any]:
        """The payload as the JSON object that capture made; VerificationError if it is none."""
        try:
            value = json.loads(self.payload)
        except (ValueError, RecursionError):
            value = None
        if not isinstance(value, dict):
            raise VerificationError(f"record {self.id} is the robot's, but its content is not a JSON object")
        return value


@dataclass(frozen=True, slots=True)
class StreamSummary:
    """One stream. opening: None if no valid `open` was found. highest: seq of the last record written.

    end: seq of the last record there is, None if unknown. proven, dropped: how many records.
    """

    stream: bytes
    opening: Opening | None
    granted: bool
    highest: int
    end: int | None
    proven: int
    dropped: int


@dataclass(frozen=True, slots=True)
class ProvenHistory:
    """records: payloads alone, in the order the robot sealed them. streams: in that order as well."""

    robot: str
    records: tuple[ProvenRecord, ...]
    streams: tuple[StreamSummary, ...]
    findings: tuple[Finding, ...]

    @property
    def violations(self) -> tuple[Finding, ...]:
        return tuple(found for found in self.findings if found.severity is Severity.VIOLATION)

    @property
    def is_complete(self) -> bool:
        """Nothing is wrong, and it is proven that nothing is missing to the very end."""
        unproven = {FindingKind.END_UNKNOWN, FindingKind.UNDECIDED, FindingKind.BEFORE_RANGE, FindingKind.NO_GRANT}
        return not self.violations and not any(found.kind in unproven for found in self.findings)

    def require_sound(self) -> None:
        """VerificationError that tells the first violation, if there is one."""
        if self.violations:
            first, more = self.violations[0], len(self.violations) - 1
            raise VerificationError(f"{self.robot}: {first}" + (f" (and {more} more)" if more else ""))


def join_certificates(signing_der: bytes, encryption_der: bytes) -> bytes:
    """How a robot's certificates stand in its registration: both in DER, signing first."""
    return signing_der + encryption_der


def split_certificates(certificates: bytes) -> tuple[bytes, bytes]:
    """The reverse; VerificationError if it is not two DER values and nothing else."""
    parts, rest = list[bytes](), certificates
    while rest and len(parts) < 2:
        # SEQUENCE with a two-byte length (X.690, 8.1.3.5): every certificate has between 256 and 65,535 bytes.
        if rest[:2] != b"\x30\x82" or len(rest) < 4:
            break
        size = 4 + int.from_bytes(rest[2:4], "big")
        parts.append(rest[:size])
        rest = rest[size:]
    if len(parts) != 2 or rest or len(parts[1]) < 4 + int.from_bytes(parts[1][2:4], "big"):
        raise VerificationError("a registration does not hold two certificates")
    return parts[0], parts[1]


def prove(
    name: str,
    registrations: Sequence[ChainRegistration],
    items: Iterable[ChainItem],
    *,
    trust: Trust,
    opener: Opener | None,
    from_start: bool = True,
    progress: Callable[[int], None] | None = None,
) -> ProvenHistory:
    """Prove what can be proven of the robot `name`.

    registrations, items: all of the robot's that the chain has, or, with
    from_start=False, the items from some block on (streams that opened earlier
    cannot be read then). opener: the reader's key; None checks only what needs
    no key. progress: called with the number of items done.
    """
    return _Proof(name, registrations, trust, opener, from_start, progress).of(items)


@dataclass(slots=True)
class _Signer:
    """A certificate that was registered, and the blocks from and until which it held; None is without end."""

    peer: PeerIdentity
    periods: list[tuple[int, int | None]] = field(default_factory=list)

    def held_at(self, block: int) -> bool:
        # Within the block of a revocation itself, before and after are not told apart: it passes.
        return any(first <= block and (until is None or block <= until) for first, until in self.periods)

    def verify(self, purpose: str, body: bytes, signature: bytes) -> None:
        verify(self.peer.signing_certificate.public_key, purpose, body, signature)


@dataclass(slots=True)
class _Stream:
    """What is known of one stream."""

    id: bytes
    items: list[ChainItem] = field(default_factory=list)
    opening: Opening | None = None
    signer: _Signer | None = None
    key: OpenStream | None = None
    opened: dict[int, ProvenRecord] = field(default_factory=dict)
    present: set[int] = field(default_factory=set)
    end: int | None = None

    @property
    def highest(self) -> int:
        """Of what is proven; of what is written only where this reader cannot prove anything."""
        return max(self.opened, default=0) if self.key is not None else max(self.present)


class _Proof:
    def __init__(
        self,
        name: str,
        registrations: Sequence[ChainRegistration],
        trust: Trust,
        opener: Opener | None,
        from_start: bool,
        progress: Callable[[int], None] | None,
    ) -> None:
        self._name, self._robot = name, robot_id(name)
        self._registrations = sorted(registrations, key=lambda r: r.block_number)
        self._opener = opener
        self._from_start = from_start
        self._progress = progress
        self._done = 0
        self._findings: list[Finding] = []
        self._signers = self._trusted(trust)

    def _find(
        self,
        kind: FindingKind,
        where: RecordId | bytes | SeqRange | None = None,
        item: ChainItem | None = None,
        detail: str = "",
    ) -> None:
        block = None if item is None else item.block_number
        match where:
            case RecordId(_, stream, seq):
                found = Finding(kind, stream, seq, seq, block, detail)
            case SeqRange(stream, first, last):
                found = Finding(kind, stream, first, last, block, detail)
            case _:
                found = Finding(kind, where, block=block, detail=detail)
        self._findings.append(found)

    def _trusted(self, trust: Trust) -> list[_Signer]:
        """The certificates that were registered and good when they were; the newest first."""
        signers: dict[bytes, _Signer] = {}
        for number, registration in enumerate(self._registrations):
            ends = [later.block_number for later in self._registrations[number + 1 : number + 2]]
            if registration.revoked_block is not None:
                ends.append(registration.revoked_block)
            try:
                signing, encryption = split_certificates(registration.certificates)
                at = datetime.fromtimestamp(registration.block_timestamp, UTC)
                peer = trust.check(signing, encryption, role=Role.ROBOT, name=self._name, at=at)
            except (IdentityError, VerificationError) as error:
                self._findings.append(
                    Finding(FindingKind.UNTRUSTED, block=registration.block_number, detail=str(error))
                )
                continue
            period = registration.block_number, min(ends) if ends else None
            signers.setdefault(signing, _Signer(peer)).periods.append(period)
        return list(signers.values())[::-1]

    def of(self, items: Iterable[ChainItem]) -> ProvenHistory:
        if not self._registrations:
            self._find(FindingKind.UNREGISTERED)
        streams: dict[bytes, _Stream] = {}
        for item in sorted(items, key=_position):
            id = item.record.id
            if id.robot != self._robot:
                self._find(FindingKind.OTHER_ROBOT, id, item)
                continue
            self._check_sender(item)
            streams.setdefault(id.stream, _Stream(id.stream)).items.append(item)
        for stream in streams.values():
            self._prove_stream(stream)
            self._check_order(stream)
        ends = self._check_links(streams)
        dropped = self._check_gaps(streams, ends)
        ordered = list(_in_robots_order(streams))
        return ProvenHistory(
            robot=self._name,
            records=tuple(
                record
                for stream in ordered
                for _, record in sorted(stream.opened.items())
                if record.opened.kind is Kind.DATA
            ),
            streams=tuple(
                StreamSummary(
                    stream=stream.id,
                    opening=stream.opening,
                    granted=stream.key is not None,
                    highest=stream.highest,
                    end=ends.get(stream.id),
                    proven=len(stream.opened) + (stream.opening is not None),
                    dropped=dropped.get(stream.id, 0),
                )
                for stream in ordered
            ),
            findings=tuple(self._findings),
        )

    # --- records

    def _check_sender(self, item: ChainItem) -> None:
        """The contract lets only the registered account write; that is checked here once more."""
        for registration in reversed(self._registrations):
            if registration.block_number <= item.block_number:
                if registration.account.lower() != item.sender.lower():
                    self._find(FindingKind.STRANGER, item.record.id, item, f"account {item.sender}")
                return
        if self._registrations:
            self._find(FindingKind.STRANGER, item.record.id, item, f"account {item.sender}, before any registration")

    def _check_order(self, stream: _Stream) -> None:
        """Seq has to grow along the chain: over what is proven, or all where nothing can be."""
        items = stream.items if stream.key is None else [record.item for record in stream.opened.values()]
        highest, seen = -1, set[int]()
        late: dict[int, list[ChainItem]] = defaultdict(list)
        for item in sorted(items, key=_position):
            seq = item.record.id.seq
            if seq < highest and seq not in seen:
                late[item.block_number].append(item)
            highest = max(highest, seq)
            seen.add(seq)
        for of_block in late.values():  # one finding for neighbours: a bad network reorders hundreds
            for part in _ranges(stream.id, {item.record.id.seq for item in of_block}):
                self._find(FindingKind.REORDERED, part, of_block[0])

    def _prove_stream(self, stream: _Stream) -> None:
        by_seq: dict[int, list[ChainItem]] = defaultdict(list)
        for item in stream.items:
            by_seq[item.record.id.seq].append(item)
        stream.present = set(by_seq)
        self._open_stream(stream, self._distinct(by_seq.pop(0, [])))
        if stream.signer is None or stream.key is None:
            return
        late: list[ChainItem] = []
        invalid: list[ChainItem] = []
        unsynchronised: list[int] = []
        for seq in sorted(by_seq):
            for item in self._distinct(by_seq[seq]):
                record = self._open(stream.key, stream.signer, item)
                if record is None:
                    continue
                if seq in stream.opened:
                    # Two sealings of one seq under one key: only who holds the robot's signing key can do that.
                    self._find(FindingKind.CONFLICTING, item.record.id, item, "both bear the robot's signature")
                    continue
                stream.opened[seq] = ProvenRecord(record, item)
                if record.kind is Kind.END:
                    stream.end = seq
                if not _was_synchronised(record):
                    unsynchronised.append(seq)
                self._check_period(stream.signer, item, late, invalid)
        for kind, where in ((FindingKind.AFTER_REVOCATION, late), (FindingKind.OUTSIDE_VALIDITY, invalid)):
            for part in _ranges(stream.id, {item.record.id.seq for item in where}):
                self._find(kind, part, where[0])
        for part in _ranges(stream.id, unsynchronised):
            self._find(FindingKind.CLOCK, part)

    def _distinct(self, items: list[ChainItem]) -> list[ChainItem]:
        """The items of one identity with different bytes; reports what is written twice."""
        distinct: dict[bytes, ChainItem] = {}
        for item in items:
            self._done += 1
            if item.record.ciphertext in distinct:
                self._find(FindingKind.DUPLICATED, item.record.id, item)
            else:
                distinct[item.record.ciphertext] = item
        if len(distinct) > 1:
            self._find(FindingKind.CONFLICTING, items[0].record.id, items[-1], f"{len(distinct)} versions")
        if self._progress is not None:
            self._progress(self._done)
        return list(distinct.values())

    def _open_stream(self, stream: _Stream, items: list[ChainItem]) -> None:
        """Find the opening, who signed it, and the key that it grants."""
        for item in items:
            error: VerificationError | None = None
            for signer in self._signers:
                try:
                    opening = read_opening(item.record, signer.verify)
                except Forged as not_his:
                    error = not_his
                    continue
                except Malformed as malformed:
                    error = malformed
                    break
                error = None
                if stream.opening is None:
                    stream.opening, stream.signer = opening, signer
                    self._check_period_of_one(signer, item)
                break
            if error is not None:
                kind = FindingKind.FORGED if isinstance(error, Forged) else FindingKind.MALFORMED
                self._find(kind, item.record.id, item)
        if stream.opening is None:
            if items or self._from_start:
                self._find(FindingKind.NO_OPEN, stream.id, None if items else stream.items[0])
            else:
                self._find(FindingKind.BEFORE_RANGE, stream.id, stream.items[0], "its open record is not there")
            return
        if self._opener is None:
            self._find(FindingKind.NO_GRANT, stream.id, detail="there is no reader key")
            return
        try:
            stream.key = self._opener.grant(stream.opening)
        except NoGrant:
            self._find(FindingKind.NO_GRANT, stream.id)
        except Altered:
            self._find(FindingKind.WRONG_KEY, stream.id)

    def _open(self, key: OpenStream, signer: _Signer, item: ChainItem) -> OpenedRecord | None:
        kinds = {Malformed: FindingKind.MALFORMED, Altered: FindingKind.ALTERED, Forged: FindingKind.FORGED}
        try:
            return key.open(item.record, signer.verify)
        except (Malformed, Altered, Forged) as error:
            self._find(kinds[type(error)], item.record.id, item)
            return None

    def _check_period_of_one(self, signer: _Signer, item: ChainItem) -> None:
        late: list[ChainItem] = []
        invalid: list[ChainItem] = []
        self._check_period(signer, item, late, invalid)
        if late:
            self._find(FindingKind.AFTER_REVOCATION, item.record.id, item)
        if invalid:
            self._find(FindingKind.OUTSIDE_VALIDITY, item.record.id, item)

    def _check_period(
        self, signer: _Signer, item: ChainItem, late: list[ChainItem], invalid: list[ChainItem]
    ) -> None:
        if not signer.held_at(item.block_number):
            late.append(item)
        if not signer.peer.not_before <= datetime.fromtimestamp(item.block_timestamp, UTC) <= signer.peer.not_after:
            invalid.append(item)

    # --- what has to be there

    def _check_links(self, streams: dict[bytes, _Stream]) -> dict[bytes, int]:
        """The last seq of every stream whose end is stated, by its own `end` or by the stream that follows."""
        ends: dict[bytes, int] = {}
        followers: dict[bytes, list[_Stream]] = defaultdict(list)
        for stream in streams.values():
            if stream.end is not None:
                ends[stream.id] = stream.end
            if stream.opening is not None and stream.opening.previous is not None:
                followers[stream.opening.previous.stream].append(stream)
        for id, following in followers.items():
            last = max(s.opening.previous.seq for s in following if s.opening and s.opening.previous)
            previous = streams.get(id)
            if len(following) > 1:
                self._find(FindingKind.FORKED, id, detail=", ".join(s.id.hex()[:8] for s in following))
            if previous is None:
                kind = FindingKind.UNKNOWN_PREVIOUS if self._from_start else FindingKind.BEFORE_RANGE
                self._find(kind, following[0].id, detail=f"{last + 1} records of stream {id.hex()[:8]}")
                continue
            if previous.highest > last:
                self._find(FindingKind.PREVIOUS_MISMATCH, SeqRange(id, last + 1, previous.highest))
            ends[id] = max(last, ends.get(id, 0))
        first = True
        for stream in _in_robots_order(streams):
            if stream.opening is None:
                continue
            if stream.id not in ends:
                self._find(FindingKind.END_UNKNOWN, stream.id, detail=f"after record {stream.highest}")
            if stream.opening.previous is None and not first:
                self._find(FindingKind.RESTARTED, stream.id)
            first = False
        return ends

    def _check_gaps(self, streams: dict[bytes, _Stream], ends: dict[bytes, int]) -> dict[bytes, int]:
        """Report what is not there and whether it was declared; how many of each stream were."""
        declared: dict[bytes, list[SeqRange]] = defaultdict(list)
        for stream in streams.values():
            for record in stream.opened.values():
                for part in record.opened.dropped:
                    declared[part.stream].append(part)
        # A gap record can stand in any stream; in one that this reader may not open it is not seen.
        unread = any(stream.opening is not None and stream.key is None for stream in streams.values())
        dropped: dict[bytes, int] = {}
        for stream in streams.values():
            if stream.opening is None and stream.id not in ends:
                continue  # reported as such; not even that it is a stream of the robot is known
            highest, count = stream.highest, 0
            for hole in _absent(stream.id, stream.present, max(ends.get(stream.id, 0), highest)):
                for part, is_declared in _divide(hole, declared[stream.id]):
                    if is_declared:
                        count += part.last - part.first + 1
                        self._find(FindingKind.DROPPED, part)
                    elif part.first == 0 and stream.opening is None:
                        continue  # said already: no open
                    elif not self._from_start and stream.opening is None and part.last < min(stream.present):
                        self._find(FindingKind.BEFORE_RANGE, part)
                    elif unread:
                        self._find(FindingKind.UNDECIDED, part)
                    else:
                        kind = FindingKind.TAIL_MISSING if part.first > highest else FindingKind.MISSING
                        self._find(kind, part)
            dropped[stream.id] = count
        return dropped


def _position(item: ChainItem) -> tuple[int, int, int]:
    return item.block_number, item.log_index, item.leaf


def _was_synchronised(record: OpenedRecord) -> bool:
    if record.kind is not Kind.DATA:
        return True
    try:
        content = json.loads(record.payload)
    except (ValueError, RecursionError):
        return True
    return not (isinstance(content, dict) and content.get("clock") is False)


def _in_robots_order(streams: dict[bytes, _Stream]) -> Iterator[_Stream]:
    """Each stream after the one it follows; where that says nothing, as they appear on the chain."""
    given: set[bytes] = set()
    for stream in streams.values():
        before: list[_Stream] = []
        current: _Stream | None = stream
        while current is not None and current.id not in given:
            given.add(current.id)
            before.append(current)
            opening = current.opening
            current = None if opening is None or opening.previous is None else streams.get(opening.previous.stream)
        yield from reversed(before)


def _ranges(stream: bytes, seqs: Iterable[int]) -> list[SeqRange]:
    ranges: list[SeqRange] = []
    for seq in sorted(seqs):
        if ranges and ranges[-1].last + 1 == seq:
            ranges[-1] = SeqRange(stream, ranges[-1].first, seq)
        else:
            ranges.append(SeqRange(stream, seq, seq))
    return ranges


def _absent(stream: bytes, present: set[int], last: int) -> list[SeqRange]:
    """The holes in 0 .. last. Walks over what is present, so that a huge `last` costs nothing."""
    holes, after = [], 0
    for seq in sorted(present):
        if seq > after:
            holes.append(SeqRange(stream, after, min(seq - 1, last)))
        after = seq + 1
        if after > last:
            return holes
    if last >= after:
        holes.append(SeqRange(stream, after, last))
    return holes


def _divide(hole: SeqRange, declared: Sequence[SeqRange]) -> Iterator[tuple[SeqRange, bool]]:
    """The parts of a hole that were declared (True) and were not (False), in order."""
    after = hole.first
    for part in sorted(declared):
        first, last = max(part.first, after), min(part.last, hole.last)
        if first > last:
            continue
        if first > after:
            yield SeqRange(hole.stream, after, first - 1), False
        yield SeqRange(hole.stream, first, last), True
        after = last + 1
    if after <= hole.last:
        yield SeqRange(hole.stream, after, hole.last), False
