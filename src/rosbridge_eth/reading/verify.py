"""One pass over a robot's log as a chain gives it: what is proven, chunk by chunk, and what is wrong with the rest.

Pure: no clock, no file, no chain. What comes in are the contract's standing of the robot, its registrations and
its data events, oldest first, as ledger.contract has them; the node that gave them is trusted with nothing that a
signature or the contract's count can show. Memory is bounded: 9 bytes a chunk, the certificates, the types of the
messages, and the findings, of which so many are kept. docs/reading.md has the order of the checks and the reasons.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import suppress
from copy import deepcopy
from dataclasses import dataclass, replace
from datetime import UTC, datetime
from typing import TYPE_CHECKING, Final, NamedTuple, Protocol

from eth_hash.auto import keccak

from rosbridge_eth.capture import LostLine, MessageLine, StreamLine, TriggerLine, TypeLine, parse_line

from rosbridge_eth.log.chunk import (  # isort: skip
    Chunk, Forged, Header, Log, Malformed, NoGrant, Unopenable, open_lines, robot_id, unwrap,
    verify_signature,
)  # fmt: skip
from rosbridge_eth.config.values import time_text
from rosbridge_eth.errors import IdentityError, VerificationError
from rosbridge_eth.identity import Role, Trust, split_certificates
from rosbridge_eth.reading.verdict import (
    HEARTBEAT,
    Bookmark,
    Findings,
    Governing,
    Head,
    Kind,
    Links,
    Progress,
    Verdict,
    shown,
)
from smcrypto import CertificateError, InvalidKey, sm2, sm3, x509

if TYPE_CHECKING:
    from rosbridge_eth.ledger.contract import DataEvent, RegistrationEvent, Standing

CLOCK_AHEAD_MS: Final = 300_000
"""A chunk that was sealed so much later than its block, by the clocks of robot and chain, is told."""
CLOCK_BACK_MS: Final = 1_000
"""What a clock may be set back between two chunks without being told: what NTP does by itself."""
MAX_TYPES: Final = 256
NO_DIGEST: Final = bytes(32)
REMEDY: Final = (
    "another machine has this robot's identity, or its disk was put back from an old copy: `revoke` the robot,"
    " `register --replace`, and `join` the new bundle in a new folder on one machine"
)
"""Told once for a log that branches, whatever the number of chunks."""
LAST_MOMENT: Final = 253_402_300_799
"""The end of 9999 in seconds since 1970; what a node says is later is taken for that."""


class Facts(Protocol):
    """What was proven once, by the SM3 of what it is about: a dict, or memo.Memo."""

    def get(self, name: bytes, /) -> bytes | None: ...
    def __setitem__(self, name: bytes, value: bytes, /) -> None: ...


class Place(NamedTuple):
    """Where a chunk stands. chunk: its index in the robot's log on the chain. block_time: seconds since 1970, by the
    chain, None where nobody asked it; sealed_ms: milliseconds, by the robot."""

    chunk: int
    stream: bytes
    number: int
    digest: bytes
    block: int
    block_time: int | None
    transaction: bytes
    sealed_ms: int


class ProvenRecord(NamedTuple):
    """A captured message that the robot signed. number: of its line in the chunk. definition: None if none came."""

    place: Place
    number: int
    line: bytes
    content: MessageLine
    definition: TypeLine | None


@dataclass(frozen=True, slots=True)
class Choice:
    """Which records are wanted: a topic, and times (nanoseconds since 1970, by the robot's receive time)."""

    topic: str | None = None
    from_ns: int | None = None
    to_ns: int | None = None
    at_ns: int | None = None

    def choose(self, records: Iterable[ProvenRecord]) -> Iterator[ProvenRecord]:
        """The chosen ones as they come; with `at_ns` the last one of each topic up to then, when all have come."""
        last: dict[str, ProvenRecord] = {}
        for record in records:
            time = record.content.received_ns
            if (
                (self.topic is None or record.content.topic == self.topic)
                and (self.from_ns is None or time >= self.from_ns)
                and (self.to_ns is None or time < self.to_ns)
                and (self.at_ns is None or time <= self.at_ns)
            ):
                if self.at_ns is None:
                    yield record
                else:
                    last[record.content.topic] = record
        yield from last.values()


EVERYTHING: Final = Choice()


class Refused(VerificationError):
    """A check ends a chunk, with this finding."""

    def __init__(self, kind: Kind, detail: str = "", *, count: int = 1) -> None:
        super().__init__(f"{kind.label}: {kind.meaning}{f' ({detail})' if detail else ''}")
        self.kind, self.detail, self.count = kind, detail, count


class Verifier:
    """Reads one robot's log once: `read` gives what is proven, then `verdict` and `bookmark` say how it ended.

    standing: of the robot, at the block up to which is read. registrations: all of them, oldest first.
    reader: the private key of who reads; None proves what needs no key. mark: of the last reading.
    granted: by a chunk's digest, the content key that another reader handed over.
    at, links: where to go on, on the chain that was read up to there; `read` passes over what comes before.
    now: in seconds. block_time: of a block's number, in seconds. facts: of earlier readings; new ones are added.
    """

    def __init__(
        self, name: str, ledger: bytes, standing: Standing, registrations: Sequence[RegistrationEvent], *,
        trust: Trust, reader: sm2.PrivateKey | None, block: int, block_time: Callable[[int], int], now: float,
        mark: Bookmark | None = None, at: Progress | None = None, links: Links | None = None,
        granted: Mapping[bytes, bytes] | None = None, facts: Facts | None = None,
    ) -> None:  # fmt: skip
        self.name, self.log, self._facts = name, Log(ledger, robot_id(name)), facts
        self._granted = granted or {}
        self._standing, self._block, self._block_time = standing, block, block_time
        self._trust, self._reader, self._mark = trust, reader, mark
        self._now = now
        self._at, self.links = deepcopy(at or Progress()), links or Links()
        self.findings = Findings(self._at.found, self._at.findings)
        self._broken = any(self.findings.counts[kind.label] for kind in (Kind.MISSING, Kind.FORKED))
        self._last: bytes | None = None  # the newest chunk, as it came
        self._marked = mark is None or mark.count <= self._at.count  # whether the mark's chunk was compared
        self._timed = -1, 0  # the latest block and its time
        self._signers = [self._signer(event) for event in registrations]
        self._current = -1  # the one of them that governs the next chunk
        self._grant = 0  # the index of the grant that fitted last
        self._check_registrations(registrations)
        if mark is not None and mark.count > standing.chunks:
            detail = f"{mark.count:,} chunks then, {standing.chunks:,} now"
            self.findings.add(Kind.ROLLED_BACK, standing.chunks, detail=detail)

    # --- certificates

    def _signer(self, event: RegistrationEvent) -> Governing:
        key, why, begins, ends, fingerprint = None, "revoked", 0, 0, ""
        if not event.revoked:
            fingerprint = fingerprint_of(event.certificates)
            try:
                at = datetime.fromtimestamp(self._time(event.block), UTC)
                key, begins, ends = signer(event.certificates, self._trust, self.name, at)
                why = ""
            except VerificationError as error:
                why = str(error)
        new = self._mark is not None and not event.revoked and fingerprint not in self._mark.fingerprints
        if new:
            self.findings.add(Kind.NEW_CERTIFICATE, event.index, detail=fingerprint)
        account = shown(event.account)
        return Governing(event.index, event.block, account, fingerprint, event.revoked, new, key, why, begins, ends)

    def _check_registrations(self, events: Sequence[RegistrationEvent]) -> None:
        """The events are linked, and the contract has the newest certificates' hash: a node cannot hide one."""
        standing, block, index, certificates_hash, revoked = self._standing, 0, 0, NO_DIGEST, False
        whole = True
        for event in events:
            whole = whole and event.previous_block == block and event.index >= index
            block, index, revoked = event.block, event.index, event.revoked
            certificates_hash = certificates_hash if revoked else keccak(event.certificates)
        told = certificates_hash, revoked, block
        if not whole or told != (standing.certificates_hash, standing.revoked, standing.changed_block):
            detail = "a registration or revocation: the node does not show what the contract has"
            self.findings.add(Kind.WITHHELD, standing.chunks, detail=detail)

    def _governing(self, index: int) -> Governing | None:
        while self._current + 1 < len(self._signers) and self._signers[self._current + 1].first <= index:
            self._current += 1
        return self._signers[self._current] if self._current >= 0 else None

    def _time(self, block: int) -> int:
        if block != self._timed[0]:
            self._timed = block, max(0, min(self._block_time(block), LAST_MOMENT))
        return self._timed[1]

    # --- the pass

    def read(self, events: Iterable[DataEvent]) -> Iterator[ProvenRecord]:
        """The records that are proven, in the order of the log. events: oldest first."""
        end, mark = self._standing.chunks, self._mark
        for event in events:
            if event.first > self._at.count:
                self._withhold(min(event.first, end))
            for index, encoded in enumerate(event.chunks, event.first):
                if index >= end:
                    break  # came after the block that is looked at
                if index < self._at.count:
                    continue
                self._at.count, self._last = index + 1, encoded
                proven: Iterable[ProvenRecord] = ()
                try:
                    proven = self._chunk(index, encoded, event)
                except Refused as refused:
                    self.findings.add(refused.kind, index, count=refused.count, detail=refused.detail)
                if mark is not None and self._at.count == mark.count:
                    self._marked = True
                    if self._at.digest != mark.digest:
                        self.findings.add(Kind.ROLLED_BACK, index, detail="another chunk than then")
                yield from proven
        if end and self._at.count == end and self._tail() != self._standing.tail.hex():
            self.findings.add(Kind.ALTERED, end - 1, detail="the contract has another hash of its last chunk")
        self._withhold(end)
        if not self._marked and mark is not None and mark.count <= end:
            self.findings.add(Kind.WITHHELD, mark.count - 1, detail="the last chunk of the reading before")

    def _tail(self) -> str:
        return self._at.tail if self._last is None else keccak(self._last).hex()

    def _withhold(self, until: int) -> None:
        if until > self._at.count:
            self.findings.add(Kind.WITHHELD, self._at.count, until - 1, count=until - self._at.count)
            self._at.count, self._last, self._at.tail = until, None, ""

    def _chunk(self, index: int, encoded: bytes, event: DataEvent) -> list[ProvenRecord]:
        """The order of the checks; each may end it. A chunk that is not the robot's has no say in what follows."""
        chunk, signer = self.authentic(index, encoded)
        header, head = chunk.header, self._at.head
        altered = bool(chunk.body) and sm3.digest(chunk.body) != header.body_digest
        whole = not chunk.bare and not altered and head is not None and header.previous.hex() != head.digest
        if not (whole and self.links.restore(header.digest)):  # else its dropped form has the place already
            self._follow(index, chunk)
            self._check_clock(index, header, signer, event.block)
            self._at.head = Head(
                header.stream.hex(), header.number, header.digest.hex(), header.sealed_ms, header.goodbye
            )
        if altered:
            raise Refused(Kind.ALTERED, "the body is not the one that the header names")
        if chunk.bare:
            raise Refused(Kind.DROPPED, count=header.records)
        time = self._time(event.block)
        place = Place(
            index, header.stream, header.number, header.digest, event.block, time, event.transaction, header.sealed_ms
        )  # fmt: skip
        return self._open(place, chunk)

    def authentic(self, index: int, encoded: bytes) -> tuple[Chunk, Governing]:
        """The chunk that the robot wrote, and what governs it; else Refused.

        The body is not looked at. index: in the robot's log; it does not go back from call to call.
        """
        signer = self._governing(index)
        try:
            chunk = Chunk.parse(encoded)
        except Malformed as error:
            self._at.digest = sm3.digest(encoded).hex()
            raise Refused(Kind.MALFORMED, shown(str(error))) from None
        self._at.digest = chunk.header.digest.hex()
        if signer is None or signer.key is None:
            raise Refused(Kind.UNTRUSTED, "no certificate is registered" if signer is None else signer.why)
        try:
            self._verify_signature(signer.key, chunk)
        except Forged:
            raise Refused(Kind.FORGED) from None
        if chunk.header.sealed_ms > signer.ends_ms:
            end = time_text(signer.ends_ms * 10**6)
            raise Refused(Kind.UNTRUSTED, f"sealed after the certificate's end, {end}")
        return chunk, signer

    def _verify_signature(self, key: sm2.PublicKey, chunk: Chunk) -> None:
        about = self.log.ledger + self.log.tk + key.to_bytes() + bytes([chunk.bare]) + chunk.signature
        name = sm3.digest(b"signature" + about + chunk.header.encoded)
        if self._facts is None or self._facts.get(name) is None:
            verify_signature(self.log, key, chunk)
            if self._facts is not None:
                self._facts[name] = b""

    # --- links

    def _follow(self, index: int, chunk: Chunk) -> None:
        """Tell where the chunk does not follow the newest one; one that was read already is refused."""
        head, header = self._at.head, chunk.header
        follows = header.previous == (NO_DIGEST if head is None else bytes.fromhex(head.digest))
        same_stream = head is not None and header.stream.hex() == head.stream
        ahead = header.number - (head.number + 1 if head is not None and same_stream else 0)
        knows_none = not same_stream and header.number == 0 and header.previous == NO_DIGEST
        goes_back = head is not None and (head.goodbye if same_stream else header.stream.hex() < head.stream)
        breaks = ahead != 0 or goes_back or not (follows or knows_none)
        self._broken = self._broken or breaks
        # In an unbroken log what names the one before it cannot be there twice; after a break it can.
        if (self._broken or knows_none) and header.digest in self.links:
            raise Refused(Kind.FORKED, "a chunk that was read before, once more")
        if goes_back or (same_stream and ahead <= 0 and breaks) or (breaks and header.previous in self.links):
            self.findings.add(Kind.FORKED, index, detail=REMEDY)
        elif breaks:
            self.findings.add(Kind.MISSING, index, count=max(1, ahead), detail="" if ahead else "one chunk or more")
        if head is not None and not same_stream and (knows_none or not head.goodbye):
            detail = "it knows of nothing before: what it held is lost" if knows_none else ""
            self.findings.add(Kind.RESTARTED, index, detail=detail)
        self.links.add(header.digest, chunk.bare)

    def _check_clock(self, index: int, header: Header, signer: Governing, block: int) -> None:
        sealed = header.sealed_ms
        if sealed > self._time(block) * 1000 + CLOCK_AHEAD_MS:
            self.findings.add(Kind.CLOCK, index, detail="sealed later than its block was made")
        if sealed < signer.begins_ms:
            self.findings.add(Kind.CLOCK, index, detail="sealed before the robot's certificate began")
        if self._at.head is not None and sealed < self._at.head.sealed_ms - CLOCK_BACK_MS:
            self.findings.add(Kind.CLOCK, index, detail="sealed before the chunk that it follows")

    # --- content

    def key_of(self, header: Header) -> bytes:
        """The content key, for this reader on the chain or handed over to it; else NoGrant."""
        key = self._own_key(header) or self._granted.get(header.digest)
        if not key:
            raise NoGrant(f"{header} was not granted to this reader")
        return key

    def _own_key(self, header: Header) -> bytes:
        """The key that the header wraps for this reader; empty where it wraps none."""
        if self._reader is None:
            return b""
        name = sm3.digest(b"content key" + self._reader.public_key.to_bytes() + header.encoded)
        key = None if self._facts is None else self._facts.get(name)
        if key is None:
            key = b""
            with suppress(NoGrant):
                key, self._grant = unwrap(header, self._reader, self._grant)
            if self._facts is not None:
                self._facts[name] = key
        return key

    def _open(self, place: Place, chunk: Chunk) -> list[ProvenRecord]:
        count, key = chunk.header.records, b""
        if not count:
            return []
        try:
            key = self.key_of(chunk.header)
            lines = open_lines(self.log, chunk, key)
        except NoGrant:
            raise Refused(Kind.NO_GRANT, count=count) from None
        except Unopenable as error:
            if key and key == self._granted.get(place.digest):  # who gave it could open the chunk
                raise VerificationError(f"a wrong key was granted for {chunk.header}: remove that grant") from None
            raise Refused(Kind.UNOPENABLE, shown(str(error))) from None
        records = list(self._parsed(place, lines))
        self._at.records += len(records)
        return records

    def _parsed(self, place: Place, lines: Sequence[bytes]) -> Iterator[ProvenRecord]:
        unsynchronised = 0
        for number, line in enumerate(lines):
            try:
                content = parse_line(line)
            except VerificationError as error:
                self.findings.add(Kind.UNOPENABLE, place.chunk, detail=f"line {number}: {shown(str(error))}")
                continue
            match content:
                case MessageLine():
                    unsynchronised += not content.clock
                    yield ProvenRecord(place, number, line, content, self._at.types.get(content.type_name))
                case TypeLine():
                    if len(self._at.types) < MAX_TYPES or content.type_name in self._at.types:
                        self._at.types[content.type_name] = content
                case LostLine():
                    detail = f"{shown(content.topic)}: {shown(content.why)}"
                    self.findings.add(Kind.LOST, place.chunk, count=content.lost, detail=detail)
                case TriggerLine():
                    detail = f"{shown(content.trigger)}: {shown(content.why)}, {time_text(content.at_ns)}"
                    self.findings.add(Kind.TRIGGERED, place.chunk, detail=detail)
                case StreamLine():
                    pass
        if unsynchronised:
            detail = "messages captured while it was not synchronised"
            self.findings.add(Kind.CLOCK, place.chunk, count=unsynchronised, detail=detail)

    # --- how it ended

    def verdict(self, nodes: Sequence[str] = ()) -> Verdict:
        head = self._at.head
        silent = head is not None and not head.goodbye and self._now - head.sealed_ms / 1000 > HEARTBEAT
        return Verdict(
            self.name, self.findings.sound, self._standing.chunks, self._block, head, self._at.records,
            dict(self.findings.counts), tuple(self._signers), silent, tuple(self.findings.kept), tuple(nodes),
        )  # fmt: skip

    @property
    def shown_all(self) -> bool:
        """Whether the node kept nothing back so far."""
        return self.findings.counts[Kind.WITHHELD.label] == 0

    @property
    def honest(self) -> bool:
        """Whether the node kept nothing back, showed again what it showed before, and no other node contradicts it."""
        counts = self.findings.counts
        return self.shown_all and not counts[Kind.ROLLED_BACK.label] and not counts[Kind.CONTRADICTED.label]

    def progress(self) -> Progress:
        """Where the reading stands, between two chunks. New certificates are not in it: they are told again."""
        kept = [one for one in self.findings.kept if one.kind is not Kind.NEW_CERTIFICATE]
        found = {label: count for label, count in self.findings.counts.items() if label != Kind.NEW_CERTIFICATE.label}
        return deepcopy(replace(self._at, tail=self._tail(), found=found, findings=kept))

    def bookmark(self, *, confirm: bool = False) -> Bookmark | None:
        """What to keep after `read` has ended; the old mark where the node kept something back or rolled back.

        confirm: the reader has compared the fingerprints; new certificates are known from now on.
        """
        if not self.honest:
            return self._mark
        now = [signer.fingerprint for signer in self._signers if not signer.revoked]
        known = now if confirm or self._mark is None else self._mark.fingerprints
        return Bookmark(self._at.count, self._at.digest, tuple(dict.fromkeys(known)))


def signer(certificates: bytes, trust: Trust, name: str, at: datetime | None = None) -> tuple[sm2.PublicKey, int, int]:
    """The robot's key of a registration, and from when to when it holds, in ms; VerificationError says why not.

    The certificates are the robot's, of the CA, and had not ended at the time of the block, or, if that is later, when
    both began: a chain's clock may be behind. at: None where nobody says the block's time.
    """
    try:
        pair = split_certificates(certificates)
        begin = max(x509.Certificate.from_der(der).not_before for der in pair)
        peer = trust.check(*pair, role=Role.ROBOT, name=name, at=max(begin, at or begin))
    except (IdentityError, VerificationError, CertificateError, InvalidKey) as error:
        raise VerificationError(shown(str(error))) from None
    begins, ends = (round(moment.timestamp() * 1000) for moment in (begin, peer.not_after))
    return peer.signing_certificate.public_key, begins, ends


def fingerprint_of(certificates: bytes) -> str:
    """SM3 of a registration's signing certificate, or of all of it where it is not two."""
    try:
        return sm3.digest(split_certificates(certificates)[0]).hex()
    except VerificationError:
        return sm3.digest(certificates).hex()


def digest_of(encoded: bytes) -> bytes:
    """The identity of a chunk, or of what is none."""
    try:
        return Chunk.parse(encoded).header.digest
    except Malformed:
        return sm3.digest(encoded)
