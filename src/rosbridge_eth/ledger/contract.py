"""The contract RobotLedger on a node, through web3.py.

Names are the contract's (contracts/RobotLedger.sol, docs/ledger.md): Tk is a
robot's 32 bytes, `first` the number of a batch's first chunk, `tail` the
keccak256 of the last chunk written. Addresses are EIP-55 strings, amounts wei.

Whatever a node answers ends in a value of the stated form or in a ChainError;
transport.py has the errors and bounds every answer in time and size. An
answer is believed as far as its form goes: what it says is the reader's to judge.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from functools import cache, cached_property, lru_cache
from importlib import resources
from typing import TYPE_CHECKING, Any, NamedTuple, Protocol, TypeVar

from rosbridge_eth.errors import ChainError
from rosbridge_eth.ledger import transport
from rosbridge_eth.ledger.transport import AlreadyKnown, Node, NonceTooLow, TooMuch, Underpriced, bytes32, natural
from rosbridge_eth.log.chunk import ledger_id

if TYPE_CHECKING:
    from eth_account.signers.local import LocalAccount

WEI_PER_ETH = 10**18
BALANCE_LIMIT = 5 * WEI_PER_ETH  # allocETH does not go beyond it
#: Of calldata: the floor of EIP-7623, and more than a byte takes in execution (16 calldata, 8 event, about 1 for
#: hashing and memory).
GAS_A_BYTE = 40
_STANDINGS = bytes.fromhex("1dae3c11")  # standings(bytes32[])
_ROW = 8 * 32  # bytes of a standing
NOTHING = bytes(32)  # the tail of a robot that wrote no chunk
PAGE = 500  # robots in one `standings`
SPAN = 2_000  # blocks asked for at once; what public nodes usually allow
MAX_BLOCK = 2**32  # no chain has as many blocks; at four a second they take 34 years
MAX_REGISTRATIONS = 1_000  # of one robot
MAX_CERTIFICATES = 16 * 2**20  # bytes in all of them
RECEIPT_LATE = 5.0  # seconds that a node may know an account's nonce before it has the transaction's receipt
SENT_AT_ONCE = 4  # of 200 kB in hex at most; nginx takes 1 MB where nobody said otherwise, anvil 2, geth 5
_Event = TypeVar("_Event")
_Linked = TypeVar("_Linked", "DataEvent", "RegistrationEvent")
_Answer = TypeVar("_Answer")
_Maker = Callable[[Any, Any], _Event]


class Standing(NamedTuple):
    """How a robot stands in the contract. `account` is None for a name never registered."""

    account: str | None
    certificates_hash: bytes
    revoked: bool
    chunks: int
    tail: bytes
    balance: int
    data_block: int
    changed_block: int


class DataEvent(NamedTuple):
    """A batch of chunks. `previous_block` holds the robot's batch before, 0 if there is none."""

    first: int
    previous_block: int
    chunks: tuple[bytes, ...]
    block: int
    transaction: bytes
    account: str


@dataclass(frozen=True, slots=True)
class RegistrationEvent:
    """A registration or revocation that holds from chunk number `index`; `certificates` is b'' for the latter."""

    account: str
    certificates: bytes
    index: int
    previous_block: int
    block: int
    revoked: bool


class Block(NamedTuple):
    """A block's header as far as it is looked at. `time`: UTC seconds; `base_fee` is None before London."""

    number: int
    time: int
    hash: bytes
    gas_limit: int
    base_fee: int | None


class Fees(NamedTuple):
    """What a unit of gas may cost, wei: `highest` at most, of it `tip` to the miner. tip None: before London."""

    highest: int
    tip: int | None

    def at_least(self, other: Fees) -> Fees:
        tip = None if self.tip is None or other.tip is None else max(self.tip, other.tip)
        return Fees(max(self.highest, other.highest), tip)

    def raised(self) -> Fees:
        """An eighth more of both; nodes ask for a tenth more to replace a transaction."""
        return Fees(self.highest * 9 // 8 + 1, None if self.tip is None else self.tip * 9 // 8 + 1)

    def limited(self, limit: int) -> Fees:
        return Fees(min(self.highest, limit), None if self.tip is None else min(self.tip, limit))


class Place(Protocol):
    """Where a contract was deployed: hash of the chain's first block and address in 0x-hex."""

    @property
    def chain_id(self) -> int: ...
    @property
    def genesis(self) -> str: ...
    @property
    def contract(self) -> str: ...


class Signed(NamedTuple):
    raw: bytes
    hash: bytes


class Receipt(NamedTuple):
    hash: bytes
    block: int
    succeeded: bool
    gas_used: int
    contract: str | None


def set_data_gas(chunks: Sequence[int]) -> int:
    """A gas limit for setData with chunks of these many bytes: never too low, and above what is used by a tenth in a
    full batch, by up to 80 % with one small chunk.

    Linear, so that no node has to estimate it; tests/bridge/ledger holds it against the EVM.
    """
    return 110_000 + sum(GAS_A_BYTE * (-size // 32 * -32) + 1_500 for size in chunks)


def set_data_cost(chunks: Sequence[int]) -> int:
    """The gas that setData uses with chunks of these many bytes, to 3 % since Prague: the floor price of calldata
    (EIP-7623) in a batch, execution with one small chunk. Nothing is sent where there are none.
    """
    floor, execution = (
        base + sum(byte * size + each for size in chunks)
        for base, each, byte in ((25_000, 1_000, GAS_A_BYTE), (60_000, 2_100, 24.5))
    )
    return round(max(floor, execution)) if chunks else 0


def call_gas(data: bytes) -> int:
    """A gas limit for any other call of the contract."""
    return 250_000 + GAS_A_BYTE * len(data)


@cache
def artifact() -> dict[str, Any]:
    """What contracts/build.py wrote."""
    loaded: dict[str, Any] = json.loads((resources.files(__package__) / "artifact/RobotLedger.json").read_text("utf-8"))
    return loaded


class Ledger:
    """The contract at an address, on a node. Made by `connect` or `deploy`; asks nothing until it is used."""

    def __init__(self, where: Any, contract: str, place: Place | None = None, *, timeout: float = 10.0) -> None:
        """where: a URL, or a provider of web3 (nodes.embedded). timeout: seconds for one answer."""
        self._node = Node(where, timeout, artifact()["abi"])
        self.url, self._w3 = self._node.url, self._node.w3
        self._place = place
        with self._node.asking():
            self._contract: Any = self._w3.eth.contract(self._w3.to_checksum_address(contract), abi=artifact()["abi"])
        self.contract: str = self._contract.address

    @staticmethod
    def connect(where: Any, place: Place, *, timeout: float = 10.0) -> Ledger:
        """A contract that was deployed before, on the node at `where` (http or https). `check` asks the node."""
        return Ledger(where, place.contract, place, timeout=timeout)

    @staticmethod
    def created_by(where: Any, account: str) -> Ledger | None:
        """The contract that the account's last transaction created, if that is what it did: account and nonce name it.

        ChainUnavailable while one of its transactions is in no block: that may be it.
        """
        from web3.utils import get_create_address

        [(count, pending)] = Ledger(where, "0x" + "00" * 20).nonces([account])
        if pending > count:
            raise transport.ChainUnavailable(f"a transaction of {account} is in no block yet; deploy when it is")
        found = Ledger(where, get_create_address(account, max(0, count - 1)))  # type: ignore[arg-type]
        return found if found.code.hex() == artifact()["deployedBytecode"] else None

    @staticmethod
    def deploy(where: Any, operator: LocalAccount, *, wait: float = 120.0) -> tuple[Ledger, Receipt]:
        """Create the contract; `operator` pays and becomes its operator. Waits until a block holds it."""
        nowhere = Ledger(where, "0x" + "00" * 20)
        code = bytes.fromhex(artifact()["bytecode"])
        receipt = nowhere._send_and_wait(operator, code, 0, 2_500_000, wait, creates=True)
        if receipt.contract is None:
            raise ChainError(f"{nowhere.url} mined the deployment but names no contract address")
        return Ledger(where, receipt.contract), receipt

    def check(self) -> None:
        """ChainError unless the node has this contract, on the chain where it was deployed."""
        with self._node.asking():
            chain_id = self._w3.eth.chain_id
        here, right = (chain_id, self.block(0).hash), (self.chain_id, self.genesis)
        if here != right:
            raise ChainError(
                f"{self.url} is another chain: id {here[0]} and first block {here[1].hex()}, "
                f"not {right[0]} and {right[1].hex()}; name a node of the chain that was set up"
            )
        if not (code := self.code):
            raise ChainError(f"there is no contract at {self.contract} on {self.url}; the node may be behind")
        if code.hex() != artifact()["deployedBytecode"]:
            raise ChainError(f"the contract at {self.contract} on {self.url} is not RobotLedger of this edition")

    def close(self) -> None:
        self._node.close()

    # ------------------------------------------------------------------ the chain

    @cached_property
    def chain_id(self) -> int:
        if self._place is not None:
            return self._place.chain_id
        with self._node.asking():
            return natural(self._w3.eth.chain_id)

    @cached_property
    def genesis(self) -> bytes:
        """The hash of block 0."""
        return self.block(0).hash if self._place is None else bytes.fromhex(self._place.genesis.removeprefix("0x"))

    @property
    def ledger(self) -> bytes:
        """What a robot's signatures name this contract on this chain by."""
        return ledger_id(self.chain_id, self.genesis, bytes.fromhex(self.contract[2:]))

    @property
    def code(self) -> bytes:
        """What is at the contract's address."""
        with self._node.asking():
            return bytes(self._w3.eth.get_code(self._contract.address))

    def block(self, number: int | str = "latest") -> Block:
        with self._node.asking():
            got: Any = self._w3.eth.get_block(number)  # type: ignore[arg-type]
            fee = got.get("baseFeePerGas")
            found = Block(
                natural(got["number"], MAX_BLOCK), natural(got["timestamp"]), bytes32(got["hash"]),
                natural(got["gasLimit"]), None if fee is None else natural(fee, 2**128),
            )  # fmt: skip
            if number not in ("latest", found.number):
                raise ValueError(f"block {found.number} in place of block {number}")
            return found

    def block_number(self) -> int:
        with self._node.asking():
            return natural(self._w3.eth.block_number, MAX_BLOCK)

    def block_time(self, number: int) -> int:
        """UTC seconds."""
        return self.block(number).time

    def balance(self, account: str) -> int:
        with self._node.asking():
            return natural(self._w3.eth.get_balance(self._w3.to_checksum_address(account)), 2**256)

    def ask(self, requests: Sequence[tuple[str, list[Any]]], form: Callable[[list[Any]], _Answer]) -> _Answer:
        """What `form` makes of the node's answers to these calls of JSON-RPC; ChainError where it refuses one."""
        answers = self._node.many(requests)
        with self._node.asking():
            if refused := [answer for answer in answers if isinstance(answer, ChainError)]:
                raise refused[0]
            return form(answers)

    def nonces(self, accounts: Sequence[str]) -> list[tuple[int, int]]:
        """For each account how many transactions are in blocks, and how many with those that wait in the pool."""
        asked = [("eth_getTransactionCount", [a, tag]) for a in accounts for tag in ("latest", "pending")]
        counts = self.ask(asked, lambda answers: [natural(answer) for answer in answers])
        return list(zip(counts[::2], counts[1::2], strict=True))

    def fees(self, head: Block) -> Fees:
        """Enough for six full blocks in a row: the base fee rises by at most 1/8 a block, and 1.125**6 > 2."""
        with self._node.asking():
            if head.base_fee is None:
                return Fees(natural(self._w3.eth.gas_price, 2**128), None)
            tip = natural(self._w3.eth.max_priority_fee, 2**128)
            return Fees(2 * head.base_fee + tip, tip)

    # ------------------------------------------------------------------ what the contract says

    def standings(self, tks: Sequence[bytes], block: int | str = "latest") -> list[Standing]:
        """How these robots stand, as of a block; in the order asked. They name no block above it."""
        end = block + 1 if isinstance(block, int) else MAX_BLOCK
        return [
            found for start in range(0, len(tks), PAGE)
            for found in self._standings(tks[start : start + PAGE], block, end)
        ]  # fmt: skip

    def _standings(self, tks: Sequence[bytes], block: Any, end: int) -> list[Standing]:
        # web3's own coding takes 0.1 ms a robot, and a server asks once a second for all of them.
        call: Any = {"to": self.contract, "data": _STANDINGS + _word(32) + _word(len(tks)) + b"".join(tks)}
        with self._node.asking():
            answer = bytes(self._w3.eth.call(call, block))
            if not answer and not self._w3.eth.get_code(self._contract.address, block):
                when = "the latest block" if block == "latest" else f"block {block}"
                raise ChainError(
                    f"there was no contract {self.contract} yet in {when} of {self.url}: ask for fewer confirmations,"
                    " or wait until the chain or the node is further on"
                )
            if len(answer) != 64 + _ROW * len(tks) or answer[:64] != _word(32) + _word(len(tks)):
                raise ValueError(f"{len(answer)} bytes for {len(tks)} standings")
            return [_standing(answer[at : at + _ROW], end) for at in range(64, len(answer), _ROW)]

    def check_data(self, tk: bytes, first: int, hashes: Sequence[bytes], index: int, chunk: bytes) -> bool:
        """CheckData: is this the chunk at `index` of the batch that begins with number `first`?"""
        with self._node.asking():
            return bool(self._contract.functions.checkData(tk, first, list(hashes), index, chunk).call())

    def operator(self) -> str:
        with self._node.asking():
            return str(self._contract.functions.operator().call())

    # ------------------------------------------------------------------ events

    def data_events(self, tk: bytes, first_block: int, last_block: int) -> Iterator[DataEvent]:
        """The robot's batches in these blocks, oldest first; asked for in ranges, halved where they are refused.

        Ranges double while they are empty: blocks without batches, of which a node may show 2**32, cost little.
        """
        span, start, most = SPAN, first_block, MAX_BLOCK
        while start <= last_block:
            end = min(start + span - 1, last_block)
            try:
                found = self._events({"Data": _data_event}, tk, start, end)
            except TooMuch:
                if span == 1:
                    raise
                span //= 2
                most = max(span, SPAN)
                continue
            yield from found
            start, span = end + 1, min(2 * span, SPAN if found else most)

    def newest_data(self, tk: bytes, last_block: int) -> Iterator[DataEvent]:
        """The robot's batches from `last_block` back, newest first, by their links; `last_block` holds one."""
        for found in self._linked({"Data": _data_event}, tk, last_block):
            yield from reversed(found)

    def registrations(self, tk: bytes, standing: Standing) -> list[RegistrationEvent]:
        """All of the robot's registrations and revocations up to `standing`, oldest first, by their links.

        ChainError also above MAX_REGISTRATIONS or MAX_CERTIFICATES.
        """
        found: list[RegistrationEvent] = []
        for page in self._linked({"Registered": _registration, "Revoked": _registration}, tk, standing.changed_block):
            found = page + found
            if len(found) > MAX_REGISTRATIONS or sum(len(event.certificates) for event in found) > MAX_CERTIFICATES:
                raise ChainError(f"{self.url} shows more than {MAX_REGISTRATIONS:,} registrations of this robot")
        return found

    def _linked(self, makers: Mapping[str, _Maker[_Linked]], tk: bytes, block: int) -> Iterator[list[_Linked]]:
        """The robot's events of this block, then of the block before that they name, and so on.

        ChainError where a link leads nowhere or not back.
        """
        while block > 0:
            found = self._events(makers, tk, block, block)
            if not found or found[0].previous_block >= block:
                names = " or ".join(makers)
                raise ChainError(f"{self.url} has no {names} of this robot in block {block}, where one must be that"
                                 " names a block before it")  # fmt: skip
            yield found
            block = found[0].previous_block

    def _events(self, makers: Mapping[str, _Maker[_Event]], tk: bytes, start: int, end: int) -> list[_Event]:
        """The robot's events of these names in these blocks, in their order, as `makers` make them of (args, log)."""
        events = {self._contract.events[name]().topic: name for name in makers}
        wanted: Any = {
            "address": self.contract, "topics": [list(events), "0x" + tk.hex()],
            "fromBlock": start, "toBlock": end,
        }  # fmt: skip
        with self._node.asking():
            found = []
            logs: Any = self._w3.eth.get_logs(wanted)
            for log in sorted(logs, key=lambda log: (log["blockNumber"], log["logIndex"])):
                name = events["0x" + bytes32(log["topics"][0]).hex()]
                args = self._contract.events[name]().process_log(log)["args"]
                here = log["address"] == self.contract and start <= log["blockNumber"] <= end
                if not here or args["Tk"] != tk:
                    raise ValueError("an event that was not asked for")
                found.append(makers[name](args, log))
            return found

    # ------------------------------------------------------------------ transactions

    def calldata(self, function: str, *arguments: Any) -> bytes:
        return bytes.fromhex(self._contract.encode_abi(function, args=arguments)[2:])

    def sign(
        self, account: LocalAccount, data: bytes, *, nonce: int, gas: int, fees: Fees, value: int = 0,
        creates: bool = False,
    ) -> Signed:  # fmt: skip
        """A transaction to the contract, or one that creates it, for the chain whose id this node first gave."""
        fields: dict[str, Any] = {"chainId": self.chain_id, "nonce": nonce, "gas": gas, "value": value, "data": data}
        if not creates:
            fields["to"] = self.contract
        if fees.tip is None:
            fields["gasPrice"] = fees.highest
        else:
            fields |= {"type": 2, "maxFeePerGas": fees.highest, "maxPriorityFeePerGas": fees.tip}
        signed = account.sign_transaction(fields)
        return Signed(bytes(signed.raw_transaction), bytes(signed.hash))

    def send(self, raws: Sequence[bytes]) -> list[ChainError | None]:
        """Hand signed transactions to the node; for each None, or why it was refused."""
        asked = [("eth_sendRawTransaction", ["0x" + raw.hex()]) for raw in raws]
        answers = self._node.many(asked, at_once=SENT_AT_ONCE)
        return [answer if isinstance(answer, ChainError) else None for answer in answers]

    def call(self, account: str, data: bytes, *, gas: int, value: int = 0) -> None:
        """Try a transaction without sending it; Reverted with the contract's error if it would fail."""
        fields: Any = {"from": account, "to": self.contract, "data": "0x" + data.hex(), "value": value, "gas": gas}
        with self._node.asking():
            self._w3.eth.call(fields)

    def receipt(self, transaction: bytes) -> Receipt | None:
        """The outcome of a transaction that is in a block."""
        from web3.exceptions import TransactionNotFound

        with self._node.asking():
            try:
                got: Any = self._w3.eth.get_transaction_receipt("0x" + transaction.hex())  # type: ignore[arg-type]
            except TransactionNotFound:
                return None
            if got.get("blockNumber") is None:
                return None
            return Receipt(
                transaction, natural(got["blockNumber"]), got["status"] == 1, natural(got["gasUsed"]),
                got.get("contractAddress"),
            )

    def transact(
        self, account: LocalAccount, function: str, *arguments: Any, value: int = 0, wait: float = 120.0
    ) -> Receipt:
        """Send one call and wait until a block holds it; Reverted, at no cost, if the contract would refuse it."""
        data = self.calldata(function, *arguments)
        gas = set_data_gas([len(chunk) for chunk in arguments[-1]]) if function == "setData" else call_gas(data)
        self.call(account.address, data, value=value, gas=gas)
        return self._send_and_wait(account, data, value, gas, wait)

    def set_data(self, account: LocalAccount, tk: bytes, chunks: Sequence[bytes]) -> Receipt:
        """SetData: write these chunks behind what is there, and wait. The submitter does it without waiting."""
        [standing] = self.standings([tk])
        return self.transact(account, "setData", tk, standing.chunks, standing.tail, list(chunks))

    def registration(self, operator: LocalAccount, tk: bytes, account: str, certificates: bytes) -> Receipt:
        return self.transact(operator, "registration", tk, account, certificates)

    def replace_registration(self, operator: LocalAccount, tk: bytes, account: str, certificates: bytes) -> Receipt:
        return self.transact(operator, "replaceRegistration", tk, account, certificates)

    def revoke_robot(self, operator: LocalAccount, tk: bytes) -> Receipt:
        return self.transact(operator, "revokeRobot", tk)

    def alloc_eth(self, operator: LocalAccount, account: str, wei: int) -> Receipt:
        """AllocETH: to a registered robot's account, up to BALANCE_LIMIT."""
        return self.transact(operator, "allocETH", account, value=wei)

    def _send_and_wait(
        self, account: LocalAccount, data: bytes, value: int, gas: int, wait: float, *, creates: bool = False
    ) -> Receipt:
        """Behind what the account has in the pool; again with the next number if another transaction took its own."""
        deadline, signed, nonce, pause, passed = time.monotonic() + wait, None, 0, 0.02, 0.0
        refused: ChainError | None = None
        while time.monotonic() < deadline:
            if signed is None:
                [(_, nonce)] = self.nonces([account.address])
                signed = self.sign(
                    account, data, nonce=nonce, gas=gas, fees=self.fees(self.block()), value=value, creates=creates
                )
                [refused] = self.send([signed.raw])
                if isinstance(refused, NonceTooLow | Underpriced):
                    signed = None  # somebody else was faster, or the price rose
                elif refused is not None and not isinstance(refused, AlreadyKnown):
                    raise refused
            elif (receipt := self.receipt(signed.hash)) is not None:
                if not receipt.succeeded:
                    raise transport.Reverted(f"transaction 0x{signed.hash.hex()} failed in block {receipt.block}")
                return receipt
            elif self.nonces([account.address])[0][0] > nonce:  # ours, whose receipt is not there yet; or another's
                passed = passed or time.monotonic()
                if time.monotonic() - passed > RECEIPT_LATE:
                    signed, passed = None, 0.0
            time.sleep(pause)
            pause = min(2 * pause, 1.0)
        if isinstance(refused, NonceTooLow | Underpriced):
            raise refused
        raise ChainError(
            f"{self.url} took the transaction, but no block holds it after {wait:.0f} s; "
            "look whether the chain makes blocks and whether the fee is enough, then look again"
        )


# ---------------------------------------------------------------------- forms of answers


def _word(number: int) -> bytes:
    return number.to_bytes(32, "big")


@lru_cache(maxsize=2**16)
def _address(raw: bytes) -> str | None:
    """As EIP-55 writes it; None for zeros."""
    from eth_utils.address import to_checksum_address

    return to_checksum_address(raw) if any(raw) else None


def _standing(row: bytes, end: int) -> Standing:
    words = [row[at : at + 32] for at in range(0, _ROW, 32)]
    account, _, revoked, chunks, _, balance, data_block, changed_block = (int.from_bytes(word, "big") for word in words)
    return Standing(
        _address(natural(account, 2**160).to_bytes(20, "big")), words[1], natural(revoked, 2) == 1, natural(chunks),
        words[4], balance, natural(data_block, end), natural(changed_block, end),
    )  # fmt: skip


def _data_event(args: Any, log: Any) -> DataEvent:
    return DataEvent(
        natural(args["first"]), natural(args["previousBlock"]), tuple(args["chunks"]), log["blockNumber"],
        bytes32(log["transactionHash"]), args["account"],
    )  # fmt: skip


def _registration(args: Any, log: Any) -> RegistrationEvent:
    return RegistrationEvent(
        args["account"], args.get("certificates", b""), natural(args["index"]), natural(args["previousBlock"]),
        log["blockNumber"], revoked="certificates" not in args,
    )  # fmt: skip
