"""What the chain holds of a robot, read back and checked against the contract's own books.

The contract's events of one robot are linked and numbered (contracts/RobotLedger.sol),
so reading starts at the last one and follows the links: no scan of the chain, and
an event that a node leaves out is missed. Every batch's records are hashed again
and compared with the root that the event names and the one the contract stores.

A node that lies consistently, state and events alike, is believed: whoever
needs more than that asks several nodes, or runs one.

`fetch` proves that bytes are recorded. Opening them and checking the robot's
signature is the reader's business.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from enum import StrEnum

from eth_utils.crypto import keccak

from rosbridge_eth.errors import ChainError, VerificationError
from rosbridge_eth.ledger import merkle, packing
from rosbridge_eth.ledger.chain import Block, Chain, Log
from rosbridge_eth.ledger.contract import BatchRecorded, Contract, Registered, Revoked, decode_event, topic
from rosbridge_eth.ledger.failures import RangeTooWide
from rosbridge_eth.records import SealedRecord

SPAN = 2_000  # blocks asked for at once; what public nodes usually allow
MAX_REREADS = 3


@dataclass(frozen=True, slots=True)
class ChainRecord:
    """A record and where it is recorded. `block_timestamp`: UTC seconds; `leaf` of `leaves` in the batch."""

    record: SealedRecord
    tx_hash: bytes
    block_number: int
    block_hash: bytes
    block_timestamp: int
    batch_index: int
    leaf: int
    leaves: int
    log_index: int
    sender: str


@dataclass(frozen=True, slots=True)
class Registration:
    """A robot's binding to an account and certificates, and the blocks in which it held."""

    robot: bytes
    account: str
    generation: int
    certificates: bytes = field(repr=False)
    block_number: int
    block_timestamp: int
    revoked_block: int | None = None
    revoked_timestamp: int | None = None


class ProblemKind(StrEnum):
    """What is wrong with a node's account of a robot."""

    MISSING_BATCH = "missing-batch"  # the contract counts a batch whose event is not given
    ROOT_MISMATCH = "root-mismatch"  # records, event and contract do not agree on the Merkle root
    MALFORMED_EVENT = "malformed-event"  # an event of the contract that the contract cannot have written
    WRONG_BLOCK = "wrong-block"  # an event is said to be in a block that is not the chain's
    MISSING_REGISTRATION = "missing-registration"  # the contract knows a registration whose event is not given
    WRONG_CERTIFICATES = "wrong-certificates"  # the event's certificates are not those the contract has the hash of


@dataclass(frozen=True, slots=True)
class Problem:
    """One disagreement; nothing that it touches is among the records."""

    kind: ProblemKind
    block_number: int
    detail: str
    batch_index: int | None = None


@dataclass(frozen=True, slots=True)
class History:
    """All of one robot in a range of blocks, oldest first."""

    robot: bytes
    from_block: int
    to_block: int
    registrations: tuple[Registration, ...]
    records: tuple[ChainRecord, ...]
    batches: int
    problems: tuple[Problem, ...]

    def require_sound(self) -> None:
        """VerificationError that tells the first problem, if there is one."""
        if self.problems:
            first, more = self.problems[0], len(self.problems) - 1
            also = f" (and {more} more)" if more else ""
            raise VerificationError(f"block {first.block_number}: {first.kind}: {first.detail}{also}")


class _Reorganised(Exception):
    """The chain changed while it was read."""


def fetch(
    chain: Chain, contract: Contract, robot: bytes, from_block: int = 0, to_block: int | None = None
) -> History:
    """All records of `robot` (Tk) in blocks from_block .. to_block (the head by default), and its registrations.

    Registrations are given whole, whatever the range. ChainError if the chain does not hold still.
    """
    for _ in range(MAX_REREADS):
        head = chain.head()
        try:
            history = _Reading(chain, contract, robot, head).history(from_block, to_block)
        except _Reorganised:
            continue
        now = chain.block(head.number)
        if now is not None and now.hash == head.hash:
            return history
    raise ChainError(f"{chain.url} changed its mind about the chain {MAX_REREADS} times while it was read; try again")


def block_at(chain: Chain, timestamp: float) -> int:
    """The first block at or after that time (UTC seconds); one past the head if there is none yet."""
    low, high = 0, chain.head().number + 1
    while low < high:
        middle = (low + high) // 2
        if _block(chain, middle).timestamp < timestamp:
            low = middle + 1
        else:
            high = middle
    return low


def _block(chain: Chain, number: int) -> Block:
    block = chain.block(number)
    if block is None:
        raise _Reorganised
    return block


class _Reading:
    """One pass, as of one head."""

    def __init__(self, chain: Chain, contract: Contract, robot: bytes, head: Block) -> None:
        self._chain = chain
        self._contract = contract
        self._robot = robot
        self._head = head
        self._blocks: dict[int, Block] = {head.number: head}
        self._problems: list[Problem] = []

    def history(self, from_block: int, to_block: int | None) -> History:
        last = self._head.number if to_block is None else min(to_block, self._head.number)
        state = self._contract.robot(self._robot, self._head.number)
        registrations = self._registrations(state.changed_at, state.generation, state.certificates_hash)
        records: list[ChainRecord] = []
        batches = 0
        for event in reversed(list(self._batches(state.batch_block, state.batches, from_block))):
            if event.log.block_number > last:
                continue
            batches += 1
            records += self._records(event)
        self._problems.sort(key=lambda problem: problem.block_number)
        return History(
            self._robot, from_block, last, tuple(registrations), tuple(records), batches, tuple(self._problems)
        )

    def _problem(self, kind: ProblemKind, block: int, detail: str, batch_index: int | None = None) -> None:
        self._problems.append(Problem(kind, block, detail, batch_index))

    def _time(self, number: int) -> Block:
        if number not in self._blocks:
            self._blocks[number] = _block(self._chain, number)
        return self._blocks[number]

    def _logs(self, event: str | None, first: int, last: int) -> tuple[int, list[Log]]:
        """Of this robot, newest first, and from which block on: the node may want a narrower range."""
        wanted = [topic(event) if event else None, self._robot]
        while True:
            try:
                logs = self._chain.logs(self._contract.address, wanted, first, last)
            except RangeTooWide:
                if first == last:
                    raise
                first = (first + last + 1) // 2
                continue
            return first, sorted(logs, key=lambda log: (log.block_number, log.index), reverse=True)

    def _events(
        self, name: str | None, first: int, last: int
    ) -> tuple[int, list[Registered | Revoked | BatchRecorded]]:
        """From which block on, and newest first what is well-formed, of this robot and in the chain's blocks.

        Anything else is reported.
        """
        first, logs = self._logs(name, first, last)
        events: list[Registered | Revoked | BatchRecorded] = []
        for log in logs:
            number = log.block_number
            if not first <= number <= last or self._time(number).hash != log.block_hash:
                if self._head_moved():
                    raise _Reorganised
                self._problem(ProblemKind.WRONG_BLOCK, number, f"an event in block 0x{log.block_hash.hex()}")
                continue
            try:
                event = decode_event(log)
            except VerificationError as error:
                self._problem(ProblemKind.MALFORMED_EVENT, number, str(error))
                continue
            if isinstance(event, Registered | Revoked | BatchRecorded) and event.robot == self._robot:
                events.append(event)
        return first, events

    def _head_moved(self) -> bool:
        now = self._chain.block(self._head.number)
        return now is None or now.hash != self._head.hash

    def _batches(self, block: int, number: int, from_block: int) -> Iterator[BatchRecorded]:
        """From the newest, number `number` in `block`, along the links to `from_block`."""
        lost_at = 0  # where a link led to no event; from there on downwards every block is looked at
        while block >= max(from_block, 1) and number > 0:
            first, events = self._events("Batch", max(from_block, block - SPAN + 1, 1), block)
            below, found = first - 1, False
            for event in events:
                if not isinstance(event, BatchRecorded) or event.number > number:
                    continue  # seen already
                if event.number < number:
                    self._withheld(lost_at or event.log.block_number, event.number + 1, number)
                yield event
                number, below, found, lost_at = event.number - 1, event.previous_block, True, 0
            if not found:
                lost_at = lost_at or block
            block = below
        if number > 0 and (lost_at or from_block <= 1):
            self._withheld(lost_at, 1, number)

    def _withheld(self, block: int, first: int, last: int) -> None:
        which = f"batch number {first}" if first == last else f"batches number {first} to {last}"
        detail = f"{which} of the robot: counted by the contract, shown by no event"
        self._problem(ProblemKind.MISSING_BATCH, block, detail)

    def _records(self, event: BatchRecorded) -> list[ChainRecord]:
        log, index = event.log, event.batch_index
        try:
            records = packing.unpack(self._robot, event.records)
        except VerificationError as error:
            self._problem(ProblemKind.MALFORMED_EVENT, log.block_number, str(error), index)
            return []
        computed = merkle.root([merkle.leaf_hash(record) for record in records])
        stored = self._contract.root(self._robot, index, self._head.number)
        if not computed == event.root == stored:
            detail = (
                f"batch {index}: the records hash to 0x{computed.hex()}, the event says 0x{event.root.hex()},"
                f" the contract 0x{stored.hex()}"
            )
            self._problem(ProblemKind.ROOT_MISMATCH, log.block_number, detail, index)
            return []
        time = self._time(log.block_number).timestamp
        where = (log.tx_hash, log.block_number, log.block_hash, time, index)
        return [
            ChainRecord(record, *where, leaf, len(records), log.index, event.account)
            for leaf, record in enumerate(records)
        ]

    def _registrations(self, block: int, generation: int, certificates_hash: bytes) -> list[Registration]:
        found: list[Registration] = []
        revoked: dict[int, int] = {}
        newest = generation
        while block > 0 and generation > 0:
            previous = None
            for event in self._events(None, block, block)[1]:
                if isinstance(event, Revoked):
                    revoked[event.generation] = block
                    previous = event.previous_block
                elif isinstance(event, Registered):
                    if event.generation != generation:
                        self._unregistered(block, generation)
                    if event.generation == newest and keccak(event.certificates) != certificates_hash:
                        self._problem(
                            ProblemKind.WRONG_CERTIFICATES, block, f"registration {newest} does not hash as recorded"
                        )
                    found.append(self._registration(event, revoked.get(event.generation)))
                    generation = event.generation - 1
                    previous = event.previous_block
            if previous is None or previous >= block:
                self._unregistered(block, generation)
                break
            block = previous
        return found[::-1]

    def _unregistered(self, block: int, generation: int) -> None:
        self._problem(ProblemKind.MISSING_REGISTRATION, block, f"registration {generation} has no event")

    def _registration(self, event: Registered, revoked: int | None) -> Registration:
        return Registration(
            event.robot,
            event.account,
            event.generation,
            event.certificates,
            event.log.block_number,
            self._time(event.log.block_number).timestamp,
            revoked,
            self._time(revoked).timestamp if revoked else None,
        )
