"""A chain as the submitter sees it, without an EVM: the contract's rules, a pool like geth's, blocks when a test says.

Stands in for `Ledger`. `mine`, `drop`, `reorg`, `spend` and `cost` do what happens to chains; `reverted` counts the
transactions that were in a block for nothing.
"""

from __future__ import annotations

import copy
from collections import Counter
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from typing import Any, NamedTuple

from eth_hash.auto import keccak

from rosbridge_eth.errors import ChainError
from rosbridge_eth.ledger.contract import BALANCE_LIMIT, NOTHING, Block, DataEvent, Fees, Signed, Standing
from rosbridge_eth.ledger.transport import (
    AlreadyKnown,
    ChainUnavailable,
    NonceTooLow,
    OutOfFunds,
    Reverted,
    Underpriced,
)

GWEI, ETH = 10**9, 10**18


class Transaction(NamedTuple):
    sender: str
    nonce: int
    gas: int
    fees: Fees
    value: int
    call: tuple[Any, ...]


@dataclass
class State:
    block: Block
    nonces: Counter[str]
    balances: Counter[str]
    standings: dict[bytes, Standing] = field(default_factory=dict)
    events: dict[bytes, list[DataEvent]] = field(default_factory=dict)
    transactions: list[Transaction] = field(default_factory=list)


class ModelChain:
    def __init__(self, *, gas_limit: int = 30_000_000) -> None:
        self.states = [State(Block(0, 0, bytes(32), gas_limit, GWEI), Counter(), Counter())]
        self.pool: dict[str, dict[int, Transaction]] = {}
        self.known: dict[bytes, Transaction] = {}
        self.base_fee, self.reverted, self.forks, self.history = GWEI, 0, 0, 100
        self.least_tip = 0  # that the pool takes
        self.down = False  # no request is answered
        self.mute = False  # transactions are taken, and the answer is lost

    @property
    def state(self) -> State:
        return self.states[-1]

    # ------------------------------------------------------------------ what happens

    def register(self, tk: bytes, account: str, wei: int = ETH) -> None:
        self.state.standings[tk] = Standing(account, keccak(b"c"), False, 0, NOTHING, 0, 0, 1)
        self.state.balances[account] = wei

    def mine(self, blocks: int = 1) -> None:
        for _ in range(blocks):
            number = self.state.block.number + 1
            hash = keccak(f"{number} {self.forks}".encode())
            state = copy.copy(self.state)
            state.nonces, state.balances = self.state.nonces.copy(), self.state.balances.copy()
            state.standings, state.events = dict(self.state.standings), dict(self.state.events)
            state.transactions = []
            state.block = Block(number, number, hash, self.state.block.gas_limit, self.base_fee)
            self.states.append(state)
            room = state.block.gas_limit
            for account, waiting in self.pool.items():
                while (tx := waiting.get(state.nonces[account])) is not None and tx.fees.highest >= self.base_fee:
                    if (room := room - tx.gas) < 0:
                        break
                    del waiting[tx.nonce]
                    self._execute(tx)

    def _execute(self, tx: Transaction) -> None:
        state = self.state
        state.nonces[tx.sender] += 1
        state.transactions.append(tx)
        state.balances[tx.sender] -= tx.gas * self.base_fee
        try:
            self._refuse(tx.sender, tx.call, tx.value)
        except Reverted:
            self.reverted += 1
            return
        if tx.call[0] == "allocETH":
            state.balances[tx.call[1]] += tx.value
            state.balances[tx.sender] -= tx.value
        elif tx.call[0] == "setData":
            _, tk, first, _, chunks = tx.call
            before, number = state.standings[tk], state.block.number
            event = DataEvent(first, before.data_block, tuple(chunks), number, keccak(repr(tx[:3]).encode()), tx.sender)
            state.events[tk] = [*state.events.get(tk, []), event]
            state.standings[tk] = before._replace(
                chunks=first + len(chunks), tail=keccak(chunks[-1]), data_block=number
            )

    def _refuse(self, sender: str, call: tuple[Any, ...], value: int) -> None:
        if call[0] == "setData":
            _, tk, first, tail, _ = call
            standing = self.state.standings[tk]
            if standing.revoked or standing.account != sender:
                raise Reverted("the contract refuses: AlreadyRevoked()", "AlreadyRevoked")
            if (first, tail) != (standing.chunks, standing.tail):
                raise Reverted("the contract refuses: NotNext()", "NotNext")
        if call[0] == "allocETH" and self.state.balances[call[1]] + value > BALANCE_LIMIT:
            raise Reverted("the contract refuses: AboveLimit()", "AboveLimit")

    def drop(self, account: str | None = None, nonce: int | None = None) -> None:
        """The pool loses one transaction, those of an account, or all."""
        for address in [account] if account else list(self.pool):
            waiting = self.pool.get(address, {})
            for number in [nonce] if nonce is not None else list(waiting):
                waiting.pop(number, None)

    def reorg(self, depth: int, *, forget: bool = False) -> None:
        """Other blocks in place of the last ones, empty; what those held is in the pool again, unless forgotten."""
        self.forks += 1
        depth = min(depth, len(self.states) - 2)
        gone, self.states = self.states[len(self.states) - depth :], self.states[: len(self.states) - depth]
        for tx in (tx for state in gone for tx in state.transactions):
            if not forget:
                self.pool.setdefault(tx.sender, {}).setdefault(tx.nonce, tx)
        saved, self.pool = self.pool, {}
        self.mine(depth)
        self.pool = saved

    def spend(self, account: str, fees: Fees | None = None) -> None:
        """A transaction of somebody else who has the key."""
        waiting = self.pool.setdefault(account, {})
        nonce = max([self.state.nonces[account] - 1, *waiting]) + 1
        waiting[nonce] = Transaction(account, nonce, 21_000, fees or Fees(3 * self.base_fee, 1), 0, ("plain",))

    # ------------------------------------------------------------------ Ledger

    def _ask(self) -> None:
        if self.down:
            raise ChainUnavailable("model does not answer")

    def check(self) -> None:
        self._ask()

    def block(self, number: int | str = "latest") -> Block:
        self._ask()
        return self.state.block

    def fees(self, head: Block) -> Fees:
        return Fees(2 * self.base_fee + GWEI, GWEI)

    def balance(self, account: str) -> int:
        return self.state.balances[account]

    def nonces(self, accounts: Sequence[str]) -> list[tuple[int, int]]:
        self._ask()
        found = []
        for account in accounts:
            latest = pending = self.state.nonces[account]
            while pending in self.pool.get(account, {}):
                pending += 1
            found.append((latest, pending))
        return found

    def standings(self, tks: Sequence[bytes], block: int | str = "latest") -> list[Standing]:
        self._ask()
        if isinstance(block, int) and not len(self.states) - self.history <= block < len(self.states):
            raise ChainUnavailable("missing trie node")
        state = self.state if block == "latest" else self.states[int(block)]
        nobody = Standing(None, NOTHING, False, 0, NOTHING, 0, 0, 0)
        found = [state.standings.get(tk, nobody) for tk in tks]
        return [s._replace(balance=state.balances[s.account]) if s.account else s for s in found]

    def newest_data(self, tk: bytes, last_block: int) -> Iterator[DataEvent]:
        self._ask()
        return reversed([event for event in self.state.events.get(tk, []) if event.block <= last_block])

    def calldata(self, function: str, *arguments: Any) -> Any:
        return (function, *arguments)

    def sign(self, account: Any, data: Any, *, nonce: int, gas: int, fees: Fees, value: int = 0) -> Signed:
        tx = Transaction(account.address, nonce, gas, fees, value, data)
        raw = repr(tx).encode()
        self.known[raw] = tx
        return Signed(raw, keccak(raw))

    def call(self, account: str, data: Any, *, value: int = 0, gas: int | None = None) -> None:
        self._ask()
        self._refuse(account, data, value)

    def send(self, raws: Sequence[bytes]) -> list[ChainError | None]:
        self._ask()
        answers = [self._accept(self.known[raw]) for raw in raws]
        if self.mute:
            raise ChainUnavailable("model does not answer: too slow")
        return answers

    def _accept(self, tx: Transaction) -> ChainError | None:
        waiting = self.pool.setdefault(tx.sender, {})
        there = waiting.get(tx.nonce)
        if tx.nonce < self.state.nonces[tx.sender]:
            return NonceTooLow("nonce too low")
        if there == tx:
            return AlreadyKnown("already known")
        if there and 10 * tx.fees.highest < 11 * there.fees.highest:
            return Underpriced("replacement transaction underpriced")
        if (tx.fees.tip or 0) < self.least_tip:
            return Underpriced(f"transaction underpriced: tip needed {self.least_tip}, tip permitted {tx.fees.tip}")
        if self.state.balances[tx.sender] < tx.gas * tx.fees.highest + tx.value:
            return OutOfFunds("insufficient funds for gas * price + value")
        waiting[tx.nonce] = tx
        return None
