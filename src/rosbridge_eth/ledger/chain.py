"""What the ledger needs of an Ethereum node: a dozen calls, with two implementations (embedded, jsonrpc).

Addresses are EIP-55 strings as people write them; hashes, calldata and topics
are bytes. Every failure is a NodeFailure of failures.py. An implementation
holds no state that its node does not have.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Protocol

from rosbridge_eth.ledger.failures import NodeFailure


@dataclass(frozen=True, slots=True)
class Block:
    """A block's header as far as the ledger looks at it. Time in UTC seconds.

    `base_fee` in wei; None on a network from before London, where gas has one price.
    """

    number: int
    hash: bytes
    parent_hash: bytes
    timestamp: int
    gas_limit: int
    base_fee: int | None


@dataclass(frozen=True, slots=True)
class Log:
    """One event. `index` counts within the block."""

    address: str
    topics: tuple[bytes, ...]
    data: bytes
    block_number: int
    block_hash: bytes
    tx_hash: bytes
    index: int


@dataclass(frozen=True, slots=True)
class Receipt:
    """A mined transaction's outcome. `succeeded` is False if it reverted or ran out of gas."""

    tx_hash: bytes
    block_number: int
    block_hash: bytes
    succeeded: bool
    gas_used: int
    gas_price: int
    sender: str
    logs: tuple[Log, ...] = field(default=(), repr=False)
    contract: str | None = None


@dataclass(frozen=True, slots=True)
class Call:
    """A transaction that is only tried: eth_call or eth_estimateGas."""

    to: str | None
    data: bytes = field(repr=False)
    sender: str | None = None
    value: int = 0


class Chain(Protocol):
    """A node. `block=None` is the latest block everywhere."""

    @property
    def url(self) -> str:
        """How the chain is named to people; without credentials."""

    def chain_id(self) -> int: ...

    def head(self) -> Block: ...

    def block(self, number: int) -> Block | None:
        """The canonical block of that height, or None above the head."""

    def code(self, address: str) -> bytes: ...

    def balance(self, address: str) -> int: ...

    def nonce(self, address: str, block: int | None = None) -> int:
        """How many transactions of the account are mined, up to that block."""

    def priority_fee(self) -> int:
        """The tip per gas that gets a transaction mined soon, in the node's opinion; wei."""

    def call(self, call: Call, block: int | None = None) -> bytes:
        """What the call would return; Reverted with the contract's error otherwise."""

    def estimate_gas(self, call: Call) -> int: ...

    def send(self, raws: Sequence[bytes]) -> list[bytes | NodeFailure]:
        """Hand signed transactions over; for each, its hash or why not. Raises only if none was asked."""

    def receipts(self, tx_hashes: Sequence[bytes]) -> list[Receipt | None]:
        """For each transaction, its receipt if it is in a block of the present chain."""

    def knows(self, tx_hash: bytes) -> bool:
        """Does the node hold the transaction, mined or waiting?"""

    def logs(self, address: str, topics: Sequence[bytes | None], from_block: int, to_block: int) -> list[Log]:
        """Events in order; a topic None matches any. The range is inclusive."""

    def close(self) -> None: ...
