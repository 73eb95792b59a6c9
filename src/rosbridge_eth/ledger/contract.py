"""The contract as Python sees it: calldata, answers, events and errors of contracts/RobotLedger.sol.

Everything follows the ABI in the packaged artifact. `Contract.at` makes sure
that the code at the address is this very contract: one that only looks like
it could accept records and lose them.
"""

from __future__ import annotations

import json
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from functools import cache
from importlib import resources
from typing import TYPE_CHECKING, Any, TypeAlias

from eth_utils.crypto import keccak

from rosbridge_eth.errors import ChainError, VerificationError
from rosbridge_eth.ledger.chain import Call, Chain, Log, Receipt
from rosbridge_eth.ledger.failures import NodeFailure, Reverted
from rosbridge_eth.ledger.transactions import Fees, Transaction, sign
from rosbridge_eth.records import SealedRecord

if TYPE_CHECKING:
    from eth_account.signers.local import LocalAccount

BALANCE_LIMIT = 5 * 10**18  # BALANCE_LIMIT of the contract, wei
GAS_MARGIN_PERCENT = 20  # over the estimate: another batch may have changed what the estimate saw
NO_ADDRESS = "0x" + "0" * 40


@cache
def artifact() -> dict[str, Any]:
    """The packaged artifact: abi, bytecode, deployedBytecode, compiler, settings."""
    text = resources.files("rosbridge_eth.ledger").joinpath("artifact/RobotLedger.json").read_text("utf-8")
    loaded: dict[str, Any] = json.loads(text)
    return loaded


def bytecode() -> bytes:
    """What is sent to create the contract."""
    return bytes.fromhex(artifact()["bytecode"])


def runtime_code() -> bytes:
    """What lies at the contract's address."""
    return bytes.fromhex(artifact()["deployedBytecode"])


@dataclass(frozen=True, slots=True)
class _Entry:
    """A function, event or error of the ABI."""

    name: str
    id: bytes  # selector (4 bytes) or topic (32)
    inputs: tuple[tuple[str, str, bool], ...]  # name, type, indexed
    outputs: tuple[str, ...]


@cache
def _entries(kind: str) -> dict[str, _Entry]:
    found = {}
    for item in artifact()["abi"]:
        if item["type"] == kind:
            inputs = tuple((i["name"], i["type"], i.get("indexed", False)) for i in item["inputs"])
            id = keccak(f"{item['name']}({','.join(type for _, type, _ in inputs)})".encode())
            outputs = tuple(o["type"] for o in item.get("outputs", ()))
            found[item["name"]] = _Entry(item["name"], id if kind == "event" else id[:4], inputs, outputs)
    return found


def calldata(function: str, *arguments: object) -> bytes:
    """The data of a transaction that calls `function`."""
    from eth_abi.abi import encode

    entry = _entries("function")[function]
    return entry.id + encode([type for _, type, _ in entry.inputs], arguments)


def explain(failure: NodeFailure) -> NodeFailure:
    """A Reverted with the contract's own error named; any other failure unchanged."""
    from eth_abi.abi import decode
    from eth_abi.exceptions import DecodingError

    if not isinstance(failure, Reverted) or failure.name or len(failure.data) < 4:
        return failure
    for entry in _entries("error").values():
        if entry.id == failure.data[:4]:
            try:
                values = decode([type for _, type, _ in entry.inputs], failure.data[4:])
            except DecodingError:
                return failure
            words = ", ".join(f"{name} {_readable(v)}" for (name, _, _), v in zip(entry.inputs, values, strict=True))
            return Reverted(f"the contract refused: {entry.name}({words})", failure.data, entry.name, tuple(values))
    return failure


def _readable(value: object) -> str:
    return "0x" + value.hex() if isinstance(value, bytes) else str(value)


# ---------------------------------------------------------------------- events


@dataclass(frozen=True, slots=True)
class Registered:
    """A robot was bound to an account. `certificates`: whatever the operator put there."""

    robot: bytes
    account: str
    generation: int
    previous_block: int
    certificates: bytes = field(repr=False)
    log: Log = field(repr=False)


@dataclass(frozen=True, slots=True)
class Revoked:
    """A robot's account may not write any more."""

    robot: bytes
    account: str
    generation: int
    previous_block: int
    log: Log = field(repr=False)


@dataclass(frozen=True, slots=True)
class BatchRecorded:
    """A batch was written, the robot's `number`-th (from 1). `records` are packed (see packing)."""

    robot: bytes
    batch_index: int
    account: str
    root: bytes
    number: int
    previous_block: int
    records: bytes = field(repr=False)
    log: Log = field(repr=False)


@dataclass(frozen=True, slots=True)
class ETHAllocated:
    """A robot's account was topped up by `amount` wei."""

    robot: bytes
    account: str
    amount: int
    log: Log = field(repr=False)


@dataclass(frozen=True, slots=True)
class OperatorOffered:
    operator: str
    offered: str
    log: Log = field(repr=False)


@dataclass(frozen=True, slots=True)
class OperatorChanged:
    previous: str
    operator: str
    log: Log = field(repr=False)


Event: TypeAlias = Registered | Revoked | BatchRecorded | ETHAllocated | OperatorOffered | OperatorChanged
_EVENTS: dict[str, Callable[..., Event]] = {
    "Registered": Registered,
    "Revoked": Revoked,
    "Batch": BatchRecorded,
    "ETHAllocated": ETHAllocated,
    "OperatorOffered": OperatorOffered,
    "OperatorChanged": OperatorChanged,
}


def topic(event: str) -> bytes:
    """Topic 0 of an event."""
    return _entries("event")[event].id


def decode_event(log: Log) -> Event:
    """The event a log stands for; VerificationError if it is none of the contract's or is malformed."""
    from eth_abi.abi import decode
    from eth_abi.exceptions import DecodingError

    for name, entry in _entries("event").items():
        if log.topics[:1] != (entry.id,):
            continue
        plain = [type for _, type, indexed in entry.inputs if not indexed]
        try:
            topics = iter([decode([t], v)[0] for t, v in zip(_indexed(entry), log.topics[1:], strict=True)])
            data = iter(decode(plain, log.data))
        except (DecodingError, ValueError) as error:
            raise VerificationError(f"a {name} event of block {log.block_number} is malformed: {error}") from error
        values = [next(topics) if indexed else next(data) for _, _, indexed in entry.inputs]
        return _EVENTS[name](*(_checksummed(v, t) for v, (_, t, _) in zip(values, entry.inputs, strict=True)), log)
    raise VerificationError(f"a log of block {log.block_number} is no event of the contract")


def _indexed(entry: _Entry) -> list[str]:
    return [type for _, type, indexed in entry.inputs if indexed]


def _checksummed(value: Any, type: str) -> Any:
    from eth_utils.address import to_checksum_address

    return to_checksum_address(value) if type == "address" else value


# ---------------------------------------------------------------------- the contract on a chain


@dataclass(frozen=True, slots=True)
class RobotState:
    """What the contract knows of a robot now. Block numbers are 0 where there is none."""

    account: str
    revoked: bool
    batches: int
    batch_block: int
    registered_at: int
    revoked_at: int
    changed_at: int
    generation: int
    certificates_hash: bytes

    @property
    def registered(self) -> bool:
        """Was it ever?"""
        return self.generation > 0

    @property
    def may_write(self) -> bool:
        return self.registered and not self.revoked


@dataclass(frozen=True, slots=True)
class Contract:
    """The ledger at an address of a chain; made by `at` or `deploy`."""

    chain: Chain
    address: str

    @staticmethod
    def at(chain: Chain, address: str) -> Contract:
        """The contract at `address`; ChainError if there is none or another one."""
        from eth_utils.address import is_address, to_checksum_address

        if not is_address(address):
            raise ChainError(f"{address!r} is not an Ethereum address (0x and 40 hexadecimal digits)")
        address = to_checksum_address(address)
        code = chain.code(address)
        if not code:
            raise ChainError(
                f"there is no contract at {address} on chain {chain.chain_id()} ({chain.url});"
                " check the address and the node, or deploy the contract there"
            )
        if code != runtime_code():
            raise ChainError(
                f"the contract at {address} is not the RobotLedger of this version;"
                " use the version it was deployed with, or deploy it anew"
            )
        return Contract(chain, address)

    @property
    def code_hash(self) -> bytes:
        return keccak(runtime_code())

    # ---- reading

    def operator(self, block: int | None = None) -> str:
        return str(_checksummed(self._read("operator", block=block)[0], "address"))

    def robot(self, robot: bytes, block: int | None = None) -> RobotState:
        account, *rest = self._read("robots", robot, block=block)
        return RobotState(_checksummed(account, "address"), *rest)

    def robot_of(self, account: str) -> bytes:
        """Tk an account was ever bound to; 32 zero bytes if to none."""
        return bytes(self._read("robotOf", account)[0])

    def root(self, robot: bytes, batch_index: int, block: int | None = None) -> bytes:
        """Merkle root of a batch; 32 zero bytes if the index is free."""
        return bytes(self._read("root", robot, batch_index, block=block)[0])

    def merkle_root(self, robot: bytes, packed: bytes) -> bytes:
        """What the contract makes of packed records; Reverted (MalformedRecords) if it cannot read them."""
        return bytes(self._read("merkleRoot", robot, packed)[0])

    def check_data(
        self,
        record: SealedRecord,
        batch_index: int,
        leaf: int,
        leaves: int,
        proof: Sequence[bytes],
        block: int | None = None,
    ) -> bool:
        """The contract's own answer whether the record is recorded; Reverted for a name never registered."""
        id = record.id
        arguments = (id.robot, batch_index, id.stream, id.seq, record.ciphertext, leaf, leaves, list(proof))
        return bool(self._read("checkData", *arguments, block=block)[0])

    def _read(self, function: str, *arguments: object, block: int | None = None) -> tuple[Any, ...]:
        from eth_abi.abi import decode
        from eth_abi.exceptions import DecodingError

        try:
            answer = self.chain.call(Call(self.address, calldata(function, *arguments)), block)
        except NodeFailure as failure:
            raise explain(failure) from failure
        try:
            return tuple(decode(_entries("function")[function].outputs, answer))
        except DecodingError as error:
            raise ChainError(f"{self.chain.url} answered {function} with {len(answer)} bytes it cannot mean") from error

    # ---- writing, for people; the submitter writes batches

    def transact(
        self, account: LocalAccount, function: str, *arguments: object, value: int = 0, timeout: float = 120
    ) -> Receipt:
        """Send one transaction and wait until it is mined; the contract's error if it refuses."""
        return send_and_wait(self.chain, account, self.address, calldata(function, *arguments), value, timeout)


def deploy(chain: Chain, operator: LocalAccount, timeout: float = 120) -> Contract:
    """Create the contract; `operator` pays and becomes its operator."""
    receipt = send_and_wait(chain, operator, None, bytecode(), 0, timeout)
    if receipt.contract is None:
        raise ChainError(f"{chain.url} mined the deployment but names no contract address")
    return Contract.at(chain, receipt.contract)


def send_and_wait(
    chain: Chain, account: LocalAccount, to: str | None, data: bytes, value: int, timeout: float
) -> Receipt:
    """Estimate, sign, send and wait for the receipt; polls until `timeout` seconds have passed."""
    try:
        gas = chain.estimate_gas(Call(to, data, account.address, value)) * (100 + GAS_MARGIN_PERCENT) // 100
    except NodeFailure as failure:
        raise explain(failure) from failure
    fees = Fees.suggested(chain.head(), chain.priority_fee())
    nonce = chain.nonce(account.address)
    signed = sign(Transaction(chain.chain_id(), nonce, to, data, gas, fees, value), account)
    answer = chain.send([signed.raw])[0]
    if isinstance(answer, NodeFailure):
        raise answer
    deadline, pause = time.monotonic() + timeout, 0.02
    while (receipt := chain.receipts([signed.hash])[0]) is None:
        if time.monotonic() > deadline:
            raise ChainError(
                f"transaction 0x{signed.hash.hex()} was accepted by {chain.url} but is in no block after"
                f" {timeout:.0f} s; look whether the chain is mining, then ask for its state again"
            )
        time.sleep(pause)
        pause = min(2 * pause, 1.0)
    if not receipt.succeeded:
        raise Reverted(f"transaction 0x{signed.hash.hex()} reverted in block {receipt.block_number}")
    return receipt
