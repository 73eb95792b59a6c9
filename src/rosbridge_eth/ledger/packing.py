"""Records packed into one byte string: the argument of setBatch and the data of its event.

    records := run+
    run     := stream (16) | first seq (8) | count (2) | count * ( length (2) | ciphertext )

Integers are big-endian; count and length are at least 1; record i of a run has
seq first + i. Packing is canonical (a run is as long as it can be), unpacking
takes all that the contract takes. Two bytes per record, against the 100 or more
of an ABI array: since EIP-7623 calldata is the price of a batch.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from rosbridge_eth.errors import VerificationError
from rosbridge_eth.records import STREAM_ID_SIZE, RecordId, SealedRecord

MAX_CIPHERTEXT = 2**16 - 1
RUN_HEADER_SIZE = STREAM_ID_SIZE + 8 + 2
LENGTH_SIZE = 2
_MAX_COUNT = 2**16 - 1


def _runs(records: Sequence[SealedRecord]) -> Iterator[Sequence[SealedRecord]]:
    start = 0
    for i in range(1, len(records) + 1):
        if i < len(records) and i - start < _MAX_COUNT:
            before, here = records[i - 1].id, records[i].id
            if here.stream == before.stream and here.seq == before.seq + 1:
                continue
        yield records[start:i]
        start = i


def pack(records: Sequence[SealedRecord]) -> bytes:
    """Pack records of one robot in the order given; ValueError for none, mixed robots or impossible lengths."""
    if not records:
        raise ValueError("a batch has at least one record")
    if any(record.id.robot != records[0].id.robot for record in records):
        raise ValueError("a batch holds the records of one robot")
    parts = []
    for run in _runs(records):
        first = run[0].id
        parts.append(first.stream + first.seq.to_bytes(8, "big") + len(run).to_bytes(2, "big"))
        for record in run:
            if not 1 <= len(record.ciphertext) <= MAX_CIPHERTEXT:
                raise ValueError(f"{record.id}: a ciphertext has 1 to {MAX_CIPHERTEXT} bytes")
            parts.append(len(record.ciphertext).to_bytes(LENGTH_SIZE, "big") + record.ciphertext)
    return b"".join(parts)


def unpack(robot: bytes, packed: bytes) -> list[SealedRecord]:
    """The records of `robot` (Tk) in packed form; VerificationError where the contract reverts."""
    records: list[SealedRecord] = []
    position = 0

    def take(size: int) -> bytes:
        nonlocal position
        piece = packed[position : position + size]
        if len(piece) != size:
            raise VerificationError(f"packed records end early, at byte {len(packed)}")
        position += size
        return piece

    def positive(size: int) -> int:
        value = int.from_bytes(take(size), "big")
        if value == 0:
            raise VerificationError(f"packed records have an empty run or record at byte {position - size}")
        return value

    while position < len(packed):
        stream = take(STREAM_ID_SIZE)
        first = int.from_bytes(take(8), "big")
        count = positive(2)
        if first + count > 2**64:
            raise VerificationError(f"packed records count past the last seq at byte {position}")
        for seq in range(first, first + count):
            records.append(SealedRecord(RecordId(robot, stream, seq), take(positive(LENGTH_SIZE))))
    if not records:
        raise VerificationError("packed records hold no record")
    return records


def packed_size(records: Sequence[SealedRecord]) -> int:
    """len(pack(records)) without packing."""
    runs = sum(1 for _ in _runs(records))
    return runs * RUN_HEADER_SIZE + sum(LENGTH_SIZE + len(record.ciphertext) for record in records)
