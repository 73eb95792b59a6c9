"""A chain and the ledger contract as a page of Python: what the submitter relies on, nothing else.

It is as unkind as a test wants it. Rules: nonces in order; a replacement raises
both fees by 10 %; a transaction is mined once its fee covers the base fee and its
sender can pay; a block can be taken back. The contract takes one batch per index.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import rlp
from eth_abi.abi import decode
from eth_account import Account
from eth_utils.address import to_checksum_address
from eth_utils.crypto import keccak

from rosbridge_eth.errors import VerificationError
from rosbridge_eth.ledger import merkle, packing
from rosbridge_eth.ledger.chain import Block, Call, Log, Receipt
from rosbridge_eth.ledger.contract import BALANCE_LIMIT, _entries
from rosbridge_eth.ledger.failures import (
    AlreadyKnown,
    GasRefused,
    InsufficientFunds,
    NodeFailure,
    NonceTooLow,
    Reverted,
    Underpriced,
)
from rosbridge_eth.records import SealedRecord

CONTRACT = to_checksum_address("0x" + "cc" * 20)
GWEI = 10**9
CHAIN_ID = 4242


@dataclass(frozen=True)
class Tx:
    hash: bytes
    raw: bytes
    sender: str
    nonce: int
    tip: int
    max_fee: int
    gas: int
    to: str
    value: int
    data: bytes


def parse(raw: bytes) -> Tx:
    fields: Any = rlp.decode(raw[1:])
    nonce, tip, max_fee, gas = (int.from_bytes(f, "big") for f in fields[1:5])
    sender = Account.recover_transaction(raw)
    to, value, data = to_checksum_address(fields[5]), int.from_bytes(fields[6], "big"), fields[7]
    return Tx(keccak(raw), raw, sender, nonce, tip, max_fee, gas, to, value, data)


@dataclass
class State:
    """Balances, nonces and the contract's storage; copied for every block."""

    balances: dict[str, int] = field(default_factory=dict)
    nonces: dict[str, int] = field(default_factory=dict)
    accounts: dict[bytes, str] = field(default_factory=dict)
    revoked: set[bytes] = field(default_factory=set)
    roots: dict[tuple[bytes, int], bytes] = field(default_factory=dict)

    def copy(self) -> State:
        return State(
            dict(self.balances), dict(self.nonces), dict(self.accounts), set(self.revoked), dict(self.roots)
        )


@dataclass
class Mined:
    block: Block
    state: State
    transactions: list[Tx]
    receipts: dict[bytes, Receipt]
    written: list[tuple[int, SealedRecord]]


class ModelChain:
    """A Chain. `never_mines(tx)` and `bad(record)` make transactions and records impossible."""

    url = "model"

    def __init__(self, operator: str, wei: int) -> None:
        self.base_fee = GWEI
        self.operator = operator
        self.never_mines: Callable[[Tx], bool] = lambda tx: False
        self.bad: Callable[[SealedRecord], bool] = lambda record: False
        self.pool: dict[tuple[str, int], Tx] = {}
        self._forks = 0
        state = State({operator: wei})
        self.blocks = [Mined(self._block(0, bytes(32)), state, [], {}, [])]

    def _block(self, number: int, parent: bytes) -> Block:
        hash = keccak(b"%d %d" % (number, self._forks) + parent)
        return Block(number, hash, parent, 1_700_000_000 + 12 * number, 30_000_000, self.base_fee)

    # ---- what tests do

    @property
    def state(self) -> State:
        return self.blocks[-1].state

    @property
    def written(self) -> list[SealedRecord]:
        """All records on the chain, in order, as often as they are there."""
        return [record for mined in self.blocks for _, record in mined.written]

    def mine(self, blocks: int = 1) -> None:
        for _ in range(blocks):
            self._mine()

    def _mine(self) -> None:
        parent = self.blocks[-1]
        mined = Mined(self._block(parent.block.number + 1, parent.block.hash), parent.state.copy(), [], {}, [])
        self.blocks.append(mined)
        moved = True
        while moved:
            moved = False
            for key, tx in sorted(self.pool.items()):
                if tx.nonce < mined.state.nonces.get(tx.sender, 0):
                    del self.pool[key]
                elif self._can_mine(tx, mined.state):
                    del self.pool[key]
                    self._execute(tx, mined)
                    moved = True

    def _can_mine(self, tx: Tx, state: State) -> bool:
        return (
            tx.nonce == state.nonces.get(tx.sender, 0)
            and tx.max_fee >= self.base_fee
            and tx.gas * tx.max_fee + tx.value <= state.balances.get(tx.sender, 0)
            and not self.never_mines(tx)
        )

    def _execute(self, tx: Tx, mined: Mined) -> None:
        state, block = mined.state, mined.block
        price = min(tx.max_fee, self.base_fee + tx.tip)
        state.nonces[tx.sender] = tx.nonce + 1
        state.balances[tx.sender] -= 50_000 * price
        try:
            written = self._apply(tx.sender, tx.to, tx.value, tx.data, state)
            succeeded = True
        except Reverted:
            written, succeeded = [], False
        mined.transactions.append(tx)
        mined.written += [(tx.nonce, record) for record in written]
        mined.receipts[tx.hash] = Receipt(
            tx.hash, block.number, block.hash, succeeded, 50_000, price, tx.sender, (), None
        )

    def _apply(self, sender: str, to: str, value: int, data: bytes, state: State) -> list[SealedRecord]:
        if to != CONTRACT:
            return []
        functions = _entries("function")
        if data[:4] == functions["setBatch"].id:
            robot, index, packed = decode(["bytes32", "uint256", "bytes"], data[4:])
            return self._set_batch(sender, robot, index, packed, state)
        if data[:4] == functions["allocETH"].id:
            (account,) = decode(["address"], data[4:])
            self._alloc(sender, to_checksum_address(account), value, state)
            return []
        raise Reverted("execution reverted")

    def _set_batch(self, sender: str, robot: bytes, index: int, packed: bytes, state: State) -> list[SealedRecord]:
        if robot not in state.accounts:
            raise _revert("NotRegistered", robot)
        if state.accounts[robot] != sender:
            raise _revert("NotTheRobot", robot, sender)
        if robot in state.revoked:
            raise _revert("AlreadyRevoked", robot, 1)
        if state.balances.get(sender, 0) == 0:
            raise _revert("NoBalance", sender)
        try:
            records = packing.unpack(robot, packed)
        except VerificationError:
            raise _revert("MalformedRecords", 0) from None
        root = merkle.root([merkle.leaf_hash(record) for record in records])
        kept = state.roots.get((robot, index))
        if kept == root:
            return []
        if kept is not None:
            raise _revert("BatchIndexTaken", robot, index, kept)
        state.roots[robot, index] = root
        return records

    def _alloc(self, sender: str, account: str, value: int, state: State) -> None:
        if sender != self.operator:
            raise _revert("NotOperator", sender)
        if account not in state.accounts.values():
            raise _revert("AccountNotRegistered", account)
        if state.balances.get(account, 0) + value > BALANCE_LIMIT:
            raise _revert("AboveLimit", account, state.balances.get(account, 0))
        state.balances[sender] -= value
        state.balances[account] = state.balances.get(account, 0) + value

    def drop(self, tx_hash: bytes) -> None:
        self.pool = {key: tx for key, tx in self.pool.items() if tx.hash != tx_hash}

    def reorg(self, depth: int, *, forget: bool = False) -> None:
        """Take blocks back; empty ones, and one more, stand in their place."""
        removed = self.blocks[-depth:]
        del self.blocks[-depth:]
        self._forks += 1
        pool, self.pool = self.pool, {}
        self.mine(depth + 1)
        self.pool = pool
        if not forget:
            for mined in removed:
                for tx in mined.transactions:
                    self.pool.setdefault((tx.sender, tx.nonce), tx)

    # ---- Chain

    def chain_id(self) -> int:
        return CHAIN_ID

    def head(self) -> Block:
        return self.blocks[-1].block

    def block(self, number: int) -> Block | None:
        return self.blocks[number].block if number < len(self.blocks) else None

    def code(self, address: str) -> bytes:
        return b""

    def balance(self, address: str) -> int:
        return self.state.balances.get(address, 0)

    def nonce(self, address: str, block: int | None = None) -> int:
        return self.blocks[-1 if block is None else block].state.nonces.get(address, 0)

    def priority_fee(self) -> int:
        return GWEI

    def call(self, call: Call, block: int | None = None) -> bytes:
        raise NotImplementedError("the submitter does not call")

    def estimate_gas(self, call: Call) -> int:
        state = self.state.copy()
        if call.value > state.balances.get(call.sender or "", 0):
            raise InsufficientFunds("insufficient funds for transfer")
        written = self._apply(call.sender or "", call.to or "", call.value, call.data, state)
        if any(self.bad(record) for record in written):
            raise GasRefused("gas required exceeds allowance (30000000)")
        return 50_000

    def send(self, raws: Sequence[bytes]) -> list[bytes | NodeFailure]:
        return [self._accept(parse(raw)) for raw in raws]

    def _accept(self, tx: Tx) -> bytes | NodeFailure:
        old = self.pool.get((tx.sender, tx.nonce))
        if old == tx or any(tx.hash in mined.receipts for mined in self.blocks):
            return AlreadyKnown("already known")
        if tx.nonce < self.state.nonces.get(tx.sender, 0):
            return NonceTooLow("nonce too low")
        if old and (10 * tx.max_fee < 11 * old.max_fee or 10 * tx.tip < 11 * old.tip):
            return Underpriced("replacement transaction underpriced")
        others = sum(
            t.gas * t.max_fee + t.value for (s, n), t in self.pool.items() if s == tx.sender and n != tx.nonce
        )
        if tx.gas * tx.max_fee + tx.value + others > self.state.balances.get(tx.sender, 0):
            return InsufficientFunds("insufficient funds for gas * price + value")
        self.pool[tx.sender, tx.nonce] = tx
        return tx.hash

    def receipts(self, tx_hashes: Sequence[bytes]) -> list[Receipt | None]:
        mined = {hash: receipt for block in self.blocks for hash, receipt in block.receipts.items()}
        return [mined.get(hash) for hash in tx_hashes]

    def knows(self, tx_hash: bytes) -> bool:
        return any(tx.hash == tx_hash for tx in self.pool.values()) or self.receipts([tx_hash]) != [None]

    def logs(self, address: str, topics: Sequence[bytes | None], from_block: int, to_block: int) -> list[Log]:
        raise NotImplementedError("the submitter reads no logs")

    def close(self) -> None:
        pass


def _revert(name: str, *arguments: Any) -> Reverted:
    from eth_abi.abi import encode

    entry = _entries("error")[name]
    return Reverted("execution reverted", entry.id + encode([type for _, type, _ in entry.inputs], arguments))


