"""The reader's end: from the chain, the contract's address, the CA certificate and a reader's key, and nothing else.

No server is asked. What the chain holds of a robot is fetched, checked
against the contract's own books, opened and proven; what is chosen of it by
topic and time is chosen after the proof, so a choice hides no finding.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from rosbridge_eth.capture import CapturedRecord
from rosbridge_eth.errors import ConfigError, IdentityError
from rosbridge_eth.identity import Identity, Trust, check_name
from rosbridge_eth.ledger import Chain, Contract, History, fetch
from rosbridge_eth.reading import FindingKind, ProvenHistory, ProvenRecord, prove
from rosbridge_eth.records import robot_id
from rosbridge_eth.sealing import Opener
from smcrypto import x509


@dataclass(frozen=True, slots=True)
class Reading:
    """A robot's history as the chain gives it and as far as it is proven.

    from_start: all that the contract counts of the robot was read, also what stands before the first block asked for.
    """

    robot: str
    history: History
    proven: ProvenHistory
    from_start: bool

    @property
    def sound(self) -> bool:
        """Neither the node's account nor the records show a violation."""
        return not self.history.problems and not self.proven.violations

    @property
    def complete(self) -> bool:
        """Sound, and proven that nothing is missing from the first record to the very end."""
        return not self.open_ends and self.sound and self.proven.is_complete

    @property
    def open_ends(self) -> list[str]:
        """What keeps a sound reading from being complete, each in words that follow "sound, "."""
        kinds = {found.kind for found in self.proven.findings}
        ends = []
        if not self.from_start:
            ends.append(f"from block {self.history.from_block} on: its beginning was not read")
        elif not self.proven.streams:
            ends.append("nothing of it is written yet")
        ends += [words for kind, words in _OPEN_ENDS.items() if kind in kinds]
        return ends


_OPEN_ENDS = {
    FindingKind.END_UNKNOWN: "its end is open",
    FindingKind.NO_GRANT: "not all of it is for this reader",
    FindingKind.UNDECIDED: "what is not written may be dropped or missing",
}


def read_robot(
    chain: Chain,
    contract_address: str,
    name: str,
    *,
    roots: Sequence[x509.Certificate],
    reader: Identity | None,
    from_block: int = 0,
    progress: Callable[[int], None] | None = None,
) -> Reading:
    """Fetch and prove all of a robot. reader: who reads; None proves what needs no key.

    Raises ChainError; ConfigError for a from_block that the chain has not reached, for nothing read there would look
    like nothing written; IdentityError for a name that is none, or that the contract does not know.
    """
    check_name(name)
    contract = Contract.at(chain, contract_address)
    head = chain.head().number
    if from_block > head:
        raise ConfigError(
            f"block {from_block} is past the end of the chain, whose last block is {head}; read from an earlier one"
            " (--from-block, or from_block in reader.toml)"
        )
    known = contract.robot(robot_id(name), head)
    if known.generation == 0 and known.batches == 0:
        raise IdentityError(
            f"no robot of the name {name} is registered in the contract {contract.address}; the operator's `status`"
            " lists the names there are"
        )
    history = fetch(chain, contract, robot_id(name), from_block)
    # Counted by the contract itself, so a reading that begins late and yet misses nothing is known to be whole.
    from_start = from_block == 0 or history.batches == contract.robot(robot_id(name), history.to_block).batches
    proven = prove(
        name,
        history.registrations,
        history.records,
        trust=Trust(tuple(roots)),
        opener=None if reader is None else Opener(reader.encryption_key),
        from_start=from_start,
        progress=progress,
    )
    return Reading(name, history, proven, from_start)


@dataclass(frozen=True, slots=True)
class ReadRecord:
    """One record of a reading: what the robot captured, and the proof and place of it."""

    captured: CapturedRecord
    proven: ProvenRecord


@dataclass(frozen=True, slots=True)
class Choice:
    """Which records are wanted: a topic, and times (nanoseconds since 1970, by the robot's receive time)."""

    topic: str | None = None
    from_ns: int | None = None
    to_ns: int | None = None
    at_ns: int | None = None

    def choose(self, records: Iterable[ProvenRecord]) -> list[ReadRecord]:
        """The chosen ones, in order; with `at_ns` the last one of each topic up to then. Raises VerificationError."""
        chosen = [
            ReadRecord(captured, record)
            for record in records
            if self._wants(captured := CapturedRecord.from_json(record.payload))
        ]
        if self.at_ns is None:
            return chosen
        return list({record.captured.topic: record for record in chosen}.values())

    def _wants(self, captured: CapturedRecord) -> bool:
        time = captured.received_ns
        return (
            (self.topic is None or captured.topic == self.topic)
            and (self.from_ns is None or time >= self.from_ns)
            and (self.to_ns is None or time < self.to_ns)
            and (self.at_ns is None or time <= self.at_ns)
        )
