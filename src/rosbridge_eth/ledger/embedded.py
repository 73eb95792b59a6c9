"""An Ethereum chain in this process: py-evm under a transaction pool of our own.

For the demo and the tests. It ends with the process and keeps nothing. The
EVM is genuine (Prague rules); the pool follows geth's where a submitter can
tell: nonces that leave a gap wait, a replacement must raise both fees by 10 %,
a fee below the base fee waits, what cannot be paid for is refused.

`auto_mine` puts every accepted transaction into a block at once. Otherwise
`mine` does, and `drop`, `reorg` and `hold` do what networks do to people.
"""

from __future__ import annotations

import sys
import threading
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from rosbridge_eth.ledger.chain import Block, Call, Log, Receipt
from rosbridge_eth.ledger.failures import (
    AlreadyKnown,
    GasRefused,
    InsufficientFunds,
    NodeFailure,
    NonceTooLow,
    Refused,
    Reverted,
    TooLarge,
    Underpriced,
)

CHAIN_ID = 1337  # the customary id of a chain for development
BLOCK_GAS_LIMIT = 30_000_000
MAX_TRANSACTION_SIZE = 128 * 1024  # geth, core/txpool/legacypool: txMaxSize
REPLACEMENT_PERCENT = 10  # geth, core/txpool/legacypool: PriceBump
PRIORITY_FEE = 1_000_000_000
_FAUCET_KEY = (1).to_bytes(32, "big")  # holds the coins of genesis; public, as those of every development chain
_FAUCET_WEI = 10**27
_NO_ACCOUNT = b"\0" * 20


@dataclass(slots=True)
class _Mined:
    """A canonical block and what it did."""

    header: Any
    transactions: tuple[Any, ...]
    receipts: tuple[Receipt, ...]

    @property
    def logs(self) -> tuple[Log, ...]:
        return tuple(log for receipt in self.receipts for log in receipt.logs)


class EmbeddedChain:
    """A Chain in process. `clock` gives UTC seconds for block times; fund accounts with `fund`."""

    url = "embedded"

    def __init__(
        self,
        *,
        fund: Mapping[str, int] | None = None,
        auto_mine: bool = True,
        clock: Callable[[], float] = time.time,
        block_gas_limit: int = BLOCK_GAS_LIMIT,
    ) -> None:
        recursion_limit = sys.getrecursionlimit()
        from eth.chains.base import MiningChain
        from eth.constants import POST_MERGE_DIFFICULTY, POST_MERGE_MIX_HASH, POST_MERGE_NONCE
        from eth.db.atomic import AtomicDB
        from eth.vm.forks.prague import PragueVM
        from eth_keys.datatypes import PrivateKey
        from eth_utils.address import to_canonical_address

        # py-evm raises the limit of the whole process so far that deeply nested JSON would overflow the C stack.
        # It wants it for calls within calls 1,024 deep; the contract here makes none.
        sys.setrecursionlimit(recursion_limit)
        chain_class: Any = MiningChain.configure(
            __name__="EmbeddedChain", vm_configuration=((0, PragueVM),), chain_id=CHAIN_ID
        )
        self._faucet = PrivateKey(_FAUCET_KEY)
        wealth = {self._faucet.public_key.to_canonical_address(): _FAUCET_WEI}
        wealth.update({to_canonical_address(address): wei for address, wei in (fund or {}).items()})
        state: Any = {
            address: {"balance": wei, "nonce": 0, "code": b"", "storage": {}} for address, wei in wealth.items()
        }
        genesis: Any = {
            "coinbase": _NO_ACCOUNT,
            "difficulty": POST_MERGE_DIFFICULTY,
            "extra_data": b"",
            "gas_limit": block_gas_limit,
            "mix_hash": POST_MERGE_MIX_HASH,
            "nonce": POST_MERGE_NONCE,
            "timestamp": int(clock()),
        }
        self._chain: Any = chain_class.from_genesis(AtomicDB(), genesis, state)
        self._clock = clock
        self.auto_mine = auto_mine
        self._lock = threading.RLock()
        self._blocks = [_Mined(self._chain.get_canonical_block_header_by_number(0), (), ())]
        self._pool: dict[bytes, dict[int, Any]] = {}
        self._held: set[bytes] = set()
        self._forks = 0  # the beneficiary of blocks, so that those of a fork differ from those they replace
        self._mined_in: dict[bytes, Receipt] = {}

    # ------------------------------------------------------------------ Chain

    def chain_id(self) -> int:
        return CHAIN_ID

    def head(self) -> Block:
        with self._lock:
            return self._as_block(self._blocks[-1].header)

    def block(self, number: int) -> Block | None:
        with self._lock:
            return self._as_block(self._blocks[number].header) if 0 <= number < len(self._blocks) else None

    def code(self, address: str) -> bytes:
        with self._lock:
            return bytes(self._state().get_code(_canonical(address)))

    def balance(self, address: str) -> int:
        with self._lock:
            return int(self._state().get_balance(_canonical(address)))

    def nonce(self, address: str, block: int | None = None) -> int:
        with self._lock:
            return int(self._state(block).get_nonce(_canonical(address)))

    def priority_fee(self) -> int:
        return PRIORITY_FEE

    def call(self, call: Call, block: int | None = None) -> bytes:
        with self._lock:
            return bytes(self._try(call, block)[1].output)

    def estimate_gas(self, call: Call) -> int:
        """One run with all the gas of a block tells the need: refunds are given back only afterwards.

        A call into a contract keeps 1/64 of the gas back (EIP-150), hence the margin for value transfers.
        """
        used = self.execution_gas(call)
        margin = 2_300 + used // 64 if call.value else 0
        return max(used + margin, self._floor_gas(call.data))

    def execution_gas(self, call: Call) -> int:
        """What a call costs apart from the floor price of its calldata (EIP-7623): the price before Prague."""
        with self._lock:
            transaction, computation = self._try(call, None)
            return int(transaction.intrinsic_gas + computation.get_gas_used())

    def send(self, raws: Sequence[bytes]) -> list[bytes | NodeFailure]:
        answers: list[bytes | NodeFailure] = []
        with self._lock:
            for raw in raws:
                try:
                    answers.append(self._accept(raw))
                except NodeFailure as failure:
                    answers.append(failure)
            if self.auto_mine and self._pool:
                self.mine()
        return answers

    def receipts(self, tx_hashes: Sequence[bytes]) -> list[Receipt | None]:
        with self._lock:
            return [self._mined_in.get(tx_hash) for tx_hash in tx_hashes]

    def knows(self, tx_hash: bytes) -> bool:
        with self._lock:
            waiting = any(tx.hash == tx_hash for queue in self._pool.values() for tx in queue.values())
            return waiting or tx_hash in self._mined_in

    def logs(self, address: str, topics: Sequence[bytes | None], from_block: int, to_block: int) -> list[Log]:
        with self._lock:
            blocks = self._blocks[max(0, from_block) : to_block + 1]
            return [log for block in blocks for log in block.logs if _matches(log, address, topics)]

    def close(self) -> None:
        """Nothing to release."""

    # ------------------------------------------------------------------ what a developer's chain can do besides

    def fund(self, address: str, wei: int) -> None:
        """Send coins from genesis, and mine them."""
        with self._lock:
            nonce = self.nonce(self._faucet.public_key.to_checksum_address())
            transaction = self._builder().new_unsigned_dynamic_fee_transaction(
                chain_id=CHAIN_ID,
                nonce=nonce,
                max_priority_fee_per_gas=PRIORITY_FEE,
                max_fee_per_gas=PRIORITY_FEE + 2 * self._blocks[-1].header.base_fee_per_gas,
                gas=100_000,
                to=_canonical(address),
                value=wei,
                data=b"",
                access_list=(),
            )
            self._accept(transaction.as_signed_transaction(self._faucet).encode())
            self.mine()

    def receipts_of(self, block: int) -> tuple[Receipt, ...]:
        """All receipts of a block."""
        with self._lock:
            return self._blocks[block].receipts

    def mine(self, blocks: int = 1) -> None:
        """Mine so many blocks; the first takes what the pool has and the gas limit allows."""
        with self._lock:
            for _ in range(blocks):
                self._mine_one()

    def drop(self, tx_hash: bytes) -> None:
        """Forget a waiting transaction, as a node under pressure does."""
        with self._lock:
            for queue in self._pool.values():
                for nonce in [n for n, tx in queue.items() if tx.hash == tx_hash]:
                    del queue[nonce]

    def hold(self, tx_hash: bytes) -> None:
        """Accept this transaction but never mine it."""
        with self._lock:
            self._held.add(tx_hash)

    def reorg(self, depth: int, *, forget: bool = False) -> None:
        """Replace the last `depth` blocks by empty ones, and one more. Their transactions wait again,
        or are forgotten."""
        with self._lock:
            if not 0 < depth < len(self._blocks):
                raise ValueError(f"cannot take back {depth} of {len(self._blocks) - 1} blocks")
            self._forks += 1
            removed = self._blocks[-depth:]
            del self._blocks[-depth:]
            pool, self._pool = self._pool, {}
            for block in removed:
                for transaction in block.transactions:
                    del self._mined_in[transaction.hash]
            for _ in range(depth + 1):
                self._mine_one()
            self._pool = pool
            if not forget:
                for block in removed:
                    for transaction in block.transactions:
                        self._pool.setdefault(transaction.sender, {}).setdefault(transaction.nonce, transaction)

    # ------------------------------------------------------------------ within

    def _builder(self) -> Any:
        return self._chain.get_vm(self._blocks[-1].header).get_transaction_builder()

    def _state(self, block: int | None = None) -> Any:
        if block is not None and not 0 <= block < len(self._blocks):
            raise Refused(f"header not found: block {block} of {len(self._blocks) - 1}")
        return self._chain.get_vm(self._blocks[-1 if block is None else block].header).state

    @staticmethod
    def _as_block(header: Any) -> Block:
        return Block(
            header.block_number,
            bytes(header.hash),
            bytes(header.parent_hash),
            header.timestamp,
            header.gas_limit,
            header.base_fee_per_gas,
        )

    @staticmethod
    def _floor_gas(data: bytes) -> int:
        """EIP-7623: ten gas a token at least, a token being a zero byte or a quarter of another."""
        zeros = data.count(0)
        return 21_000 + 10 * (zeros + 4 * (len(data) - zeros))

    def _try(self, call: Call, block: int | None) -> tuple[Any, Any]:
        """The transaction and its computation, undone."""
        from eth.exceptions import Revert, VMError
        from eth.vm.spoof import SpoofTransaction
        from eth_utils.exceptions import ValidationError

        sender = _canonical(call.sender) if call.sender else _NO_ACCOUNT
        transaction = self._builder().new_unsigned_dynamic_fee_transaction(
            chain_id=CHAIN_ID,
            nonce=self._state(block).get_nonce(sender),
            max_priority_fee_per_gas=0,
            max_fee_per_gas=0,
            gas=self._blocks[-1].header.gas_limit,
            to=_canonical(call.to) if call.to else b"",
            value=call.value,
            data=call.data,
            access_list=(),
        )
        header = self._blocks[-1 if block is None else block].header
        spoofed = SpoofTransaction(transaction, from_=sender)
        with self._chain.get_vm(header).in_costless_state() as state:
            try:
                computation = state.apply_transaction(spoofed)
            except ValidationError as error:
                raise InsufficientFunds(f"insufficient funds: {error}") from error
        if computation.is_error:
            fault = computation.error
            if isinstance(fault, Revert):
                data = bytes(fault.args[0]) if fault.args and isinstance(fault.args[0], bytes) else b""
                raise Reverted("execution reverted", data)
            if isinstance(fault, VMError):
                raise GasRefused(f"execution failed: {type(fault).__name__}")
            raise fault
        return spoofed, computation

    def _accept(self, raw: bytes) -> bytes:
        from eth.exceptions import UnrecognizedTransactionType
        from eth_utils.exceptions import ValidationError
        from rlp.exceptions import RLPException  # type: ignore[import-untyped]

        if len(raw) > MAX_TRANSACTION_SIZE:
            raise TooLarge(f"oversized data: transaction size {len(raw)}, limit {MAX_TRANSACTION_SIZE}")
        try:
            tx = self._builder().decode(raw)
            tx.validate()
            sender = tx.sender
            if tx.chain_id != CHAIN_ID:
                raise Refused(f"invalid chain id: {tx.chain_id} instead of {CHAIN_ID}")
        except (RLPException, ValidationError, UnrecognizedTransactionType, TypeError) as error:
            raise Refused(f"not a transaction of this chain: {error}") from error
        tx_hash = bytes(tx.hash)
        queue = self._pool.setdefault(sender, {})
        if tx_hash in self._mined_in or (tx.nonce in queue and queue[tx.nonce].hash == tx_hash):
            raise AlreadyKnown("already known")
        state = self._state()
        if tx.nonce < state.get_nonce(sender):
            raise NonceTooLow(f"nonce too low: next nonce {state.get_nonce(sender)}, tx nonce {tx.nonce}")
        head = self._blocks[-1].header
        if tx.gas > head.gas_limit:
            raise GasRefused("exceeds block gas limit")
        if tx.gas < max(tx.intrinsic_gas, self._floor_gas(tx.data)):
            raise GasRefused("intrinsic gas too low")
        others = sum(_cost(other) for nonce, other in queue.items() if nonce != tx.nonce)
        if _cost(tx) + others > state.get_balance(sender):
            raise InsufficientFunds("insufficient funds for gas * price + value")
        if (old := queue.get(tx.nonce)) is not None:
            enough = all(
                100 * getattr(tx, fee) >= (100 + REPLACEMENT_PERCENT) * getattr(old, fee)
                for fee in ("max_fee_per_gas", "max_priority_fee_per_gas")
            )
            if not enough:
                raise Underpriced("replacement transaction underpriced")
        queue[tx.nonce] = tx
        return tx_hash

    def _choose(self) -> list[Any]:
        """What goes into the next block: each account's nonces in order, while fee and gas allow."""
        state, head = self._state(), self._blocks[-1].header
        header = self._next_header()
        chosen: list[Any] = []
        room = head.gas_limit
        for sender, queue in self._pool.items():
            nonce = state.get_nonce(sender)
            for stale in [n for n in queue if n < nonce]:
                del queue[stale]
            while (tx := queue.get(nonce)) is not None and tx.hash not in self._held:
                if tx.max_fee_per_gas < header.base_fee_per_gas or tx.gas > room:
                    break
                chosen.append(tx)
                room -= tx.gas
                nonce += 1
        return chosen

    def _next_header(self) -> Any:
        parent = self._blocks[-1].header
        return self._chain.get_vm(parent).create_header_from_parent(
            parent, gas_limit=parent.gas_limit, timestamp=max(int(self._clock()), parent.timestamp + 1)
        )

    def _mine_one(self) -> None:
        from eth_utils.exceptions import ValidationError

        chosen = self._choose()
        while True:
            self._chain.header = self._next_header()
            try:
                result, receipts, computations = self._chain.mine_all(chosen, coinbase=self._forks.to_bytes(20, "big"))
                break
            except ValidationError:
                # Balances change within a block: leave out what can no longer be paid for, the last one first.
                if not chosen:
                    raise
                chosen.pop()
        block = result.imported_block
        mined = _Mined(block.header, tuple(block.transactions), ())
        mined.receipts = tuple(self._receipts_of(block, receipts, computations))
        self._blocks.append(mined)
        for tx, receipt in zip(block.transactions, mined.receipts, strict=True):
            self._pool[tx.sender].pop(tx.nonce, None)
            self._mined_in[receipt.tx_hash] = receipt

    def _receipts_of(self, block: Any, receipts: Sequence[Any], computations: Sequence[Any]) -> list[Receipt]:
        base_fee = block.header.base_fee_per_gas
        found: list[Receipt] = []
        before = index = 0
        for tx, receipt, computation in zip(block.transactions, receipts, computations, strict=True):
            tx_hash, logs = bytes(tx.hash), []
            for log in receipt.logs:
                topics = tuple(topic.to_bytes(32, "big") for topic in log.topics)
                where = (block.number, bytes(block.hash), tx_hash, index)
                logs.append(Log(_checksum(log.address), topics, bytes(log.data), *where))
                index += 1
            created = _checksum(computation.msg.storage_address) if not tx.to else None
            found.append(
                Receipt(
                    tx_hash,
                    block.number,
                    bytes(block.hash),
                    computation.is_success,
                    receipt.gas_used - before,
                    base_fee + min(tx.max_priority_fee_per_gas, tx.max_fee_per_gas - base_fee),
                    _checksum(tx.sender),
                    tuple(logs),
                    created,
                )
            )
            before = receipt.gas_used
        return found


def _cost(tx: Any) -> int:
    return int(tx.gas * tx.max_fee_per_gas + tx.value)


def _canonical(address: str) -> Any:
    from eth_utils.address import to_canonical_address

    return to_canonical_address(address)


def _checksum(address: bytes) -> str:
    from eth_utils.address import to_checksum_address

    return str(to_checksum_address(address))


def _matches(log: Log, address: str, topics: Sequence[bytes | None]) -> bool:
    if log.address != address or len(topics) > len(log.topics):
        return False
    return all(wanted is None or wanted == topic for wanted, topic in zip(topics, log.topics, strict=False))
