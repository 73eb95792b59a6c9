"""A ledger on a fresh chain in process, and records to write to it."""

from __future__ import annotations

import random
from dataclasses import dataclass, field

from rosbridge_eth import ledger
from rosbridge_eth.ledger import packing
from rosbridge_eth.ledger.accounts import Keyring
from rosbridge_eth.ledger.contract import Contract
from rosbridge_eth.ledger.embedded import EmbeddedChain
from rosbridge_eth.records import RecordId, SealedRecord, robot_id

# The words of every Ethereum development chain; public.
KEYRING = Keyring.from_mnemonic("test test test test test test test test test test test junk")
OPERATOR, ACCOUNT, OTHER_ACCOUNT = KEYRING.operator, KEYRING.robot(1), KEYRING.robot(2)
ROBOT, OTHER_ROBOT = robot_id("robot_1"), robot_id("robot_2")
ETH = 10**18


class TestClock:
    """UTC seconds that only move when told to."""

    __test__ = False

    def __init__(self, now: float = 1_700_000_000.0) -> None:
        self.now = now

    def __call__(self) -> float:
        return self.now


@dataclass
class Records:
    """Makes sealed records with random ciphertexts, the same in every run."""

    random: random.Random = field(default_factory=lambda: random.Random(20260101))

    def stream(self) -> bytes:
        return self.random.randbytes(16)

    def run(
        self, count: int, *, robot: bytes = ROBOT, stream: bytes | None = None, first: int = 0, size: int = 256
    ) -> list[SealedRecord]:
        stream = self.stream() if stream is None else stream
        ids = [RecordId(robot, stream, first + i) for i in range(count)]
        return [SealedRecord(id, self.random.randbytes(size)) for id in ids]


@dataclass
class Ledger:
    """A deployed contract with one registered and funded robot."""

    chain: EmbeddedChain
    contract: Contract
    clock: TestClock

    def register(self, robot: bytes, account: object, certificates: bytes = b"certificates", wei: int = ETH) -> None:
        self.contract.transact(OPERATOR, "registration", robot, account.address, certificates)  # type: ignore[attr-defined]
        if wei:
            self.contract.transact(OPERATOR, "allocETH", account.address, value=wei)  # type: ignore[attr-defined]

    def write(self, records: list[SealedRecord], index: int, account: object = ACCOUNT) -> None:
        self.contract.transact(account, "setBatch", records[0].id.robot, index, packing.pack(records))  # type: ignore[arg-type]


def new_ledger(*, auto_mine: bool = True, register: bool = True) -> Ledger:
    clock = TestClock()
    chain = EmbeddedChain(fund={OPERATOR.address: 100 * ETH}, clock=clock)
    made = Ledger(chain, ledger.deploy(chain, OPERATOR), clock)
    if register:
        made.register(ROBOT, ACCOUNT)
    chain.auto_mine = auto_mine
    return made
