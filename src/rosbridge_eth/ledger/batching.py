"""How records become batches: pure, with the clock passed in.

A batch holds records of one robot in the order they were given and is closed by
the first limit it reaches: records, bytes of calldata, gas, or age.

Records that can never be written are told apart before they cost a nonce:
`refusal` by their form, and `halves` cuts a batch that a node refuses for good,
until the one bad record is alone.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass, field
from itertools import pairwise

from rosbridge_eth.ledger import packing
from rosbridge_eth.records import SealedRecord

# Upper bounds on the gas of a batch; tests hold them against the EVM.
# Per byte: 40 where calldata has its floor price (EIP-7623), more than the 16 + 8 + hashing of before.
GAS_PER_BATCH = 75_000
GAS_PER_RUN = 2_000
GAS_PER_RECORD = 4_500
GAS_PER_BYTE = 40
# Selector, Tk, batchIndex, offset and length of `records`, padding to a word.
CALLDATA_OVERHEAD = 4 + 4 * 32 + 31


@dataclass(frozen=True, slots=True)
class Limits:
    """When a batch is full. `calldata` in bytes, `age` in seconds since its first record."""

    records: int = 100
    calldata: int = 96 * 1024
    gas: int = 8_000_000
    age: float = 2.0


def calldata_size(records: Sequence[SealedRecord]) -> int:
    """Bytes of a setBatch call with these records; at most 31 too many."""
    return CALLDATA_OVERHEAD + packing.packed_size(records)


def gas_bound(records: Sequence[SealedRecord]) -> int:
    """More gas than a setBatch call with these records takes under any rules from London to Prague."""
    runs = 1 + sum(1 for a, b in pairwise(records) if not _follows(a, b))
    return (
        GAS_PER_BATCH + GAS_PER_RUN * runs + GAS_PER_RECORD * len(records) + GAS_PER_BYTE * calldata_size(records)
    )


def _follows(before: SealedRecord, after: SealedRecord) -> bool:
    return before.id.stream == after.id.stream and before.id.seq + 1 == after.id.seq


def refusal(record: SealedRecord, limits: Limits) -> str | None:
    """Why this record can be in no batch at all, or None."""
    size = len(record.ciphertext)
    if not 1 <= size <= packing.MAX_CIPHERTEXT:
        return f"a ciphertext of {size} bytes; the contract takes 1 to {packing.MAX_CIPHERTEXT}"
    if calldata_size([record]) > limits.calldata:
        return f"{calldata_size([record])} bytes of calldata by itself; the limit is {limits.calldata}"
    if gas_bound([record]) > limits.gas:
        return f"needs up to {gas_bound([record])} gas by itself; the limit is {limits.gas}"
    return None


def plan(records: Iterable[SealedRecord], limits: Limits) -> list[list[SealedRecord]]:
    """Cut one robot's records, none of which is refused, into batches as large as the limits allow."""
    batches: list[list[SealedRecord]] = []
    filling = _Filling(limits)
    for record in records:
        if not filling.takes(record):
            batches.append(filling.records)
            filling = _Filling(limits)
        filling.add(record)
    return [*batches, filling.records] if filling.records else batches


def halves(records: Sequence[SealedRecord]) -> tuple[Sequence[SealedRecord], Sequence[SealedRecord]]:
    """The two halves of a batch of two records or more."""
    if len(records) < 2:
        raise ValueError("one record cannot be halved")
    middle = len(records) // 2
    return records[:middle], records[middle:]


@dataclass(slots=True)
class _Filling:
    """A batch under way, its size and gas kept up to date."""

    limits: Limits
    since: float = 0.0
    records: list[SealedRecord] = field(default_factory=list)
    _calldata: int = CALLDATA_OVERHEAD
    _gas: int = GAS_PER_BATCH + GAS_PER_BYTE * CALLDATA_OVERHEAD

    def _cost(self, record: SealedRecord) -> tuple[int, int]:
        size, gas = packing.LENGTH_SIZE + len(record.ciphertext), GAS_PER_RECORD
        if not self.records or not _follows(self.records[-1], record):
            size, gas = size + packing.RUN_HEADER_SIZE, gas + GAS_PER_RUN
        return size, gas + GAS_PER_BYTE * size

    def takes(self, record: SealedRecord) -> bool:
        """Always true for the first: what is too large by itself was refused before."""
        size, gas = self._cost(record)
        return not self.records or (
            len(self.records) < self.limits.records
            and self._calldata + size <= self.limits.calldata
            and self._gas + gas <= self.limits.gas
        )

    def add(self, record: SealedRecord) -> None:
        size, gas = self._cost(record)
        self._calldata += size
        self._gas += gas
        self.records.append(record)


class Batcher:
    """Gathers records of many robots and gives out batches that are full or old enough.

    It holds records in memory only: whoever feeds it still owns them until the journal has the batch.
    """

    def __init__(self, limits: Limits) -> None:
        self._limits = limits
        self._filling: dict[bytes, _Filling] = {}
        self._full: list[list[SealedRecord]] = []

    def __len__(self) -> int:
        """Records held."""
        return sum(len(f.records) for f in self._filling.values()) + sum(len(b) for b in self._full)

    def add(self, record: SealedRecord, now: float) -> None:
        """Take a record in; ValueError if `refusal` has a reason against it."""
        reason = refusal(record, self._limits)
        if reason:
            raise ValueError(reason)
        filling = self._filling.get(record.id.robot)
        if filling is None or not filling.takes(record):
            if filling is not None:
                self._full.append(filling.records)
            filling = self._filling[record.id.robot] = _Filling(self._limits, since=now)
        filling.add(record)
        if len(filling.records) == self._limits.records:
            self._full.append(self._filling.pop(record.id.robot).records)

    def due(self, now: float, *, flush: bool = False) -> list[list[SealedRecord]]:
        """Batches that are full or `age` old; with `flush`, all."""
        due, self._full = self._full, []
        for robot, filling in list(self._filling.items()):
            if flush or now - filling.since >= self._limits.age:
                due.append(self._filling.pop(robot).records)
        return due

    def next_timer(self) -> float | None:
        """When the oldest batch becomes due, or None."""
        return min((f.since + self._limits.age for f in self._filling.values()), default=None)
