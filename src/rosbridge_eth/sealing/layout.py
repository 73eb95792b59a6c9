"""The bytes of a sealed record, Cp of the contract. docs/records.md draws them.

    ciphertext = version 1 | kind 1 | key id 8 | body                        (numbers are big-endian)

The associated data of a record is Tk 32 | stream 16 | seq 8 | version | kind |
key id: it is authenticated with every record and covered by every signature.

    open, seq 0     body = content | signature 64                             in clear
    data, gap, end  body = SM4-GCM(stream key, nonce = 0000 | seq, padded) | tag 16
                    padded = signature 64 | packed payload | zeros

The whole ciphertext of the latter is padded to a multiple of 256 bytes up to
4 KiB and to a Padmé size (Nikitin et al., "Reducing Metadata Leakage from
Encrypted Files and Communication with PURBs", PoPETs 2019, 4) above, at most
32 KiB. Padmé of 4,096 and more steps by 256 at first, so the two meet.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from enum import IntEnum
from typing import Final, TypeAlias

from rosbridge_eth.records import STREAM_ID_SIZE, RecordId, SealedRecord, SeqRange
from rosbridge_eth.sealing.errors import Malformed
from smcrypto import sm3

VERSION: Final = 1
HEADER_SIZE: Final = 10
KEY_SIZE: Final = 16
KEY_ID_SIZE: Final = 8
SIGNATURE_SIZE: Final = 64
TAG_SIZE: Final = 16
GRAIN: Final = 256
MAX_CIPHERTEXT: Final = 32 * 1024
MAX_PACKED: Final = MAX_CIPHERTEXT - HEADER_SIZE - SIGNATURE_SIZE - TAG_SIZE
MAX_PAYLOAD: Final = 256 * 1024
"""Bytes of a payload before packing; unpacking stops there, so that a small record cannot fill a memory."""

WRAPPED_KEY_SIZE: Final = 65 + 32 + KEY_SIZE  # C1 | C3 | C2, GB/T 32918.4, 6.1
READER_TAG_SIZE: Final = 8
COMMITMENT_SIZE: Final = 32
MAX_READERS: Final = 128

Sign: TypeAlias = Callable[[str, bytes], bytes]
"""(purpose, body) -> the robot's raw 64-byte signature; functools.partial(identity.sign, key)."""

Verify: TypeAlias = Callable[[str, bytes, bytes], None]
"""(purpose, body, signature), raises InvalidSignature; functools.partial(identity.verify, public_key)."""


class Kind(IntEnum):
    """What a record is; its second byte."""

    OPEN = 0  # first of its stream: who may read it, and what came before
    DATA = 1  # a payload
    GAP = 2  # declares records that were dropped and will never come
    END = 3  # last of its stream: the robot stopped in good order


PURPOSES: Final = {Kind.OPEN: "open", Kind.DATA: "record", Kind.GAP: "gap", Kind.END: "end"}


@dataclass(frozen=True, slots=True)
class Header:
    kind: Kind
    key_id: bytes


def pack_header(kind: Kind, key_id: bytes) -> bytes:
    return bytes((VERSION, kind)) + key_id


def parse_header(record: SealedRecord) -> Header:
    """The header of a record, or Malformed. An `open` is the record of seq 0 and only that."""
    head = record.ciphertext[:HEADER_SIZE]
    if len(head) < HEADER_SIZE:
        raise Malformed(f"record {record.id} has {len(record.ciphertext)} bytes, less than a header")
    if head[0] != VERSION:
        raise Malformed(f"record {record.id} has version {head[0]}; this reader knows {VERSION}")
    if head[1] not in PURPOSES:
        raise Malformed(f"record {record.id} is of no known kind ({head[1]})")
    kind = Kind(head[1])
    if (kind is Kind.OPEN) != (record.id.seq == 0):
        raise Malformed(f"record {record.id} is {kind.name.lower()}, which its place in the stream rules out")
    return Header(kind, head[2:])


def associated_data(id: RecordId, head: bytes) -> bytes:
    return id.robot + id.stream + id.seq.to_bytes(8, "big") + head


def nonce(seq: int) -> bytes:
    """12 bytes; a stream's key seals one record per seq, so none repeats."""
    return seq.to_bytes(12, "big")


def padded_size(size: int) -> int:
    """The size that a ciphertext of `size` bytes is padded to."""
    if size <= 4096:
        return -(-size // GRAIN) * GRAIN
    exponent = size.bit_length() - 1
    step = 1 << (exponent - exponent.bit_length())
    return -(-size // step) * step


def commitment(robot: bytes, stream: bytes, key: bytes) -> bytes:
    """Binds the one key of a stream, which GCM by itself does not; 32 bytes in `open`, the first 8 are the key id."""
    return sm3.digest(b"rosbridge-eth/1 stream key\0" + robot + stream + key)


def reader_tag(robot: bytes, stream: bytes, reader: bytes) -> bytes:
    """Where a reader (its encoded public key) finds its wrapped key; unlinkable between streams to others."""
    return sm3.digest(b"rosbridge-eth/1 reader\0" + robot + stream + reader)[:READER_TAG_SIZE]


@dataclass(frozen=True, slots=True)
class Opening:
    """The content of an `open` record.

    created_ns: the robot's wall clock. previous: the last record before this
    stream that may exist; None if the robot knows of none (its first start, or
    its spool was lost). wrapped: by reader tag, the stream key encrypted by SM2.
    """

    robot: bytes
    stream: bytes
    created_ns: int
    previous: RecordId | None
    commitment: bytes
    wrapped: dict[bytes, bytes]

    @property
    def key_id(self) -> bytes:
        return self.commitment[:KEY_ID_SIZE]

    def to_bytes(self) -> bytes:
        """created 8 | commitment 32 | 0, or 1 | previous stream 16 | last seq 8 | readers 1 | (tag 8 | key 113)*"""
        last = b"\0" if self.previous is None else b"\1" + self.previous.stream + self.previous.seq.to_bytes(8, "big")
        readers = b"".join(tag + wrapped for tag, wrapped in self.wrapped.items())
        return b"".join(
            (self.created_ns.to_bytes(8, "big"), self.commitment, last, bytes([len(self.wrapped)]), readers)
        )

    @classmethod
    def from_bytes(cls, robot: bytes, stream: bytes, content: bytes) -> Opening:
        take = _Taker(content)
        created_ns, bound = int.from_bytes(take(8), "big"), take(COMMITMENT_SIZE)
        previous = None
        if take.flag():
            previous = RecordId(robot, take(STREAM_ID_SIZE), int.from_bytes(take(8), "big"))
        count = take(1)[0]
        wrapped = {take(READER_TAG_SIZE): take(WRAPPED_KEY_SIZE) for _ in range(count)}
        take.finish()
        if len(wrapped) != count or not 1 <= count <= MAX_READERS:
            raise Malformed("an open record names a reader twice, none, or too many")
        return cls(robot, stream, created_ns, previous, bound, wrapped)


def pack_ranges(ranges: Sequence[SeqRange]) -> bytes:
    """(stream 16 | number of ranges | (distance from the end of the one before | length - 1)*)*, numbers as LEB128.

    Ranges are sorted and joined, so that a regular pattern of drops is a
    regular pattern of bytes and shrinks.
    """
    parts: list[bytes] = []
    by_stream: dict[bytes, list[SeqRange]] = {}
    for part in join_ranges(ranges):
        by_stream.setdefault(part.stream, []).append(part)
    for stream, members in by_stream.items():
        parts += (stream, _leb128(len(members)))
        after = 0
        for part in members:
            parts += (_leb128(part.first - after), _leb128(part.last - part.first))
            after = part.last + 1
    return b"".join(parts)


def parse_ranges(content: bytes) -> tuple[SeqRange, ...]:
    take, ranges = _Taker(content), list[SeqRange]()
    while take.left:
        stream, count, after = take(STREAM_ID_SIZE), take.leb128(), 0
        if count > take.left:
            raise Malformed("a gap record ends early")
        for _ in range(count):
            first = after + take.leb128()
            last = first + take.leb128()
            ranges.append(SeqRange(stream, first, last))
            after = last + 1
    return tuple(ranges)


def join_ranges(ranges: Iterable[SeqRange]) -> list[SeqRange]:
    """The same records in as few ranges as possible, in order."""
    joined: list[SeqRange] = []
    for part in sorted(ranges):
        if joined and joined[-1].stream == part.stream and part.first <= joined[-1].last + 1:
            joined[-1] = joined[-1]._replace(last=max(joined[-1].last, part.last))
        else:
            joined.append(part)
    return joined


def _leb128(number: int) -> bytes:
    out = bytearray()
    while number > 0x7F:
        out.append(number & 0x7F | 0x80)
        number >>= 7
    out.append(number)
    return bytes(out)


class _Taker:
    """Takes bytes from the front; Malformed where there are too few, or some are left at the end."""

    def __init__(self, data: bytes) -> None:
        self._data, self._at = data, 0

    @property
    def left(self) -> int:
        return len(self._data) - self._at

    def __call__(self, size: int) -> bytes:
        if size > self.left:
            raise Malformed("a record's content ends early")
        self._at += size
        return self._data[self._at - size : self._at]

    def flag(self) -> bool:
        value = self(1)[0]
        if value > 1:
            raise Malformed("a record's content has a flag that is neither 0 nor 1")
        return bool(value)

    def leb128(self) -> int:
        number = 0
        for shift in range(0, 64, 7):
            byte = self(1)[0]
            number |= (byte & 0x7F) << shift
            if byte < 0x80:
                return number
        raise Malformed("a record's content has a number above 64 bits")

    def finish(self) -> None:
        if self.left:
            raise Malformed("a record's content has bytes after its end")
