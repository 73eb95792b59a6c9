"""A robot's log on a chain, made by hand: real chunks, and the tuples that a contract would give of them."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass, field, replace
from datetime import UTC, datetime
from functools import cache
from typing import Any

from eth_hash.auto import keccak
from pydantic import TypeAdapter

from rosbridge_eth.identity import CertificateAuthority, Identity, Role, Trust, create_ca, enrol
from rosbridge_eth.ledger.contract import DataEvent, RegistrationEvent, Standing
from rosbridge_eth.log.chunk import Chunk, Log, drop, robot_id, seal
from rosbridge_eth.reading.verdict import Bookmark, Finding, Kind, Links, Progress, Verdict
from rosbridge_eth.reading.verify import NO_DIGEST, ProvenRecord, Verifier

NAME, LEDGER = "robot_1", b"L" * 32
LOG = Log(LEDGER, robot_id(NAME))
START = datetime(2026, 1, 1, tzinfo=UTC)
T0 = int(START.timestamp()) + 86_400
"""Block n was made at T0 + n seconds; the robot's chunks are sealed a second before their block."""
ACCOUNT = "0x" + "aB" * 20


@cache
def authority(name: str = "Test CA") -> CertificateAuthority:
    return create_ca(name, at=START)


@cache
def robot(number: int = 0, name: str = NAME, role: Role = Role.ROBOT) -> Identity:
    return enrol(authority(), role, name, at=START)


@cache
def reader(name: str = "owner") -> Identity:
    return enrol(authority(), Role.READER, name, at=START)


def message(n: int, topic: str = "/odom", clock: bool = True, **data: Any) -> bytes:
    return line({
        "topic": topic, "type": "pkg/msg/Type", "source": "sim", "received_ns": n, "captured_ns": n, "clock": clock,
        "data": {"x": n} | data,
    })  # fmt: skip


def line(value: Any) -> bytes:
    return json.dumps(value, separators=(",", ":"), ensure_ascii=False).encode()


STREAM_LINE = line({"stream": {"source": "sim", "software": "rosbridge_eth 2.0"}})


@dataclass
class Pen:
    """Writes chunks as a robot does: in streams, each header naming the one before."""

    identity: Identity = field(default_factory=robot)
    log: Log = LOG
    stream: bytes = b"a" * 16
    number: int = 0
    previous: bytes = NO_DIGEST
    sealed_ms: int = T0 * 1000
    readers: Sequence[Identity] = field(default_factory=lambda: (reader(),))

    def write(self, *lines: bytes, goodbye: bool = False, sealed_ms: int | None = None) -> Chunk:
        self.sealed_ms = self.sealed_ms + 1000 if sealed_ms is None else sealed_ms
        chunk = seal(
            self.log, self.identity.signing_key, lines, stream=self.stream, number=self.number, goodbye=goodbye,
            previous=self.previous, sealed_ms=self.sealed_ms,
            readers=[one.encryption_key.public_key for one in self.readers], secret=b"s" * 32,
        )  # fmt: skip
        self.number, self.previous = self.number + 1, chunk.header.digest
        return chunk

    def chunks(self, count: int, records: int = 1, goodbye: bool = False) -> list[Chunk]:
        """`count` chunks of messages that are numbered through."""
        first = self.number
        return [
            self.write(*(message(n * records + r) for r in range(records)), goodbye=goodbye and n == first + count - 1)
            for n in range(first, first + count)
        ]

    def new_stream(self, stream: bytes, previous: bytes | None = None) -> None:
        self.stream, self.number = stream, 0
        self.previous = self.previous if previous is None else previous

    def drop(self, chunk: Chunk) -> Chunk:
        return drop(self.log, self.identity.signing_key, chunk)


def registration(identity: Identity | None = None, index: int = 0, block: int = 1, previous: int = 0, **more: Any):
    certificates = (identity or robot()).public.certificates
    return replace(RegistrationEvent(ACCOUNT, certificates, index, previous, block, False), **more)


def revocation(index: int, block: int, previous: int = 1) -> RegistrationEvent:
    return RegistrationEvent(ACCOUNT, b"", index, previous, block, True)


def events(chunks: Sequence[Chunk | bytes], per_event: int = 3, first: int = 0) -> list[DataEvent]:
    encoded = [chunk if isinstance(chunk, bytes) else chunk.encoded for chunk in chunks]
    return [
        DataEvent(first + at, 0, tuple(encoded[at : at + per_event]), first + at + per_event + 1, b"\x11" * 32, ACCOUNT)
        for at in range(0, len(encoded), per_event)
    ]


def standing(data: Sequence[DataEvent], registrations: Sequence[RegistrationEvent]) -> Standing:
    """What the contract has once all these events happened."""
    registered = [event for event in registrations if not event.revoked]
    return Standing(
        ACCOUNT,
        keccak(registered[-1].certificates) if registered else NO_DIGEST,
        bool(registrations) and registrations[-1].revoked,
        data[-1].first + len(data[-1].chunks) if data else 0,
        keccak(data[-1].chunks[-1]) if data else NO_DIGEST,
        0,
        data[-1].block if data else 0,
        registrations[-1].block if registrations else 0,
    )


@dataclass
class Read:
    verifier: Verifier
    records: list[ProvenRecord]
    verdict: Verdict

    @property
    def found(self) -> list[tuple[str, int, int, int]]:
        """(kind, first, last, count) of each finding."""
        return [(one.kind.label, one.places[0][0], one.places[-1][1], one.count) for one in self.verdict.findings]

    @property
    def numbers(self) -> list[Any]:
        return [record.content.data["x"] for record in self.records]

    @property
    def mark(self) -> Bookmark:
        mark = self.verifier.bookmark()
        assert mark is not None
        return mark

    @property
    def at(self) -> dict[str, Any]:
        """Where the next reading goes on."""
        links = Links()
        known = self.verifier.links
        for digest, dropped in zip(known.digests, known.dropped, strict=True):
            links.add(digest.to_bytes(8, "big"), bool(dropped))
        progress = TypeAdapter(Progress)
        return {"at": progress.validate_json(progress.dump_json(self.verifier.progress())), "links": links}

    def only(self, kind: Kind) -> Finding:
        assert [one.kind for one in self.verdict.findings] == [kind], list(self.verdict.lines())
        return self.verdict.findings[0]


def read(
    chunks: Sequence[Chunk | bytes] | None = None,
    *,
    data: Sequence[DataEvent] | None = None,
    registrations: Sequence[RegistrationEvent] | None = None,
    stands: Standing | None = None,
    key: Identity | None = None,
    keyless: bool = False,
    now: float | None = None,
    **more: Any,
) -> Read:
    """Read chunks (or events) as the chain would give them."""
    data = events(chunks or []) if data is None else data
    registrations = [registration()] if registrations is None else registrations
    more = {"block_time": lambda block: T0 + block, "trust": Trust([authority().certificate]), "block": 1000} | more
    verifier = Verifier(
        NAME, LEDGER, stands or standing(data, registrations), registrations,
        reader=None if keyless else (key or reader()).encryption_key, now=T0 + 60 if now is None else now, **more,
    )  # fmt: skip
    proven = list(verifier.read(data))
    return Read(verifier, proven, verifier.verdict())
