"""What a block's header proves without a node: receipts with their events, and the contract's storage.

    header    RLP of the fields of HEADER, as many as the chain's rules have; its keccak256 is the block's hash
    receipt   [type |] RLP(status, gas, bloom, logs), in the trie with the root receiptsRoot under RLP(index)
    account   RLP(nonce, balance, storage's root, code's hash), in the trie stateRoot under keccak256(address)
    slot      RLP(value), in the trie of the storage's root under keccak256(slot)

RLP and the Merkle-Patricia trie are those of Ethereum's yellow paper, appendices B and D; a receipt's type is that of
EIP-2718. What is taken apart here may come from anybody: that takes time and memory linear in its length, one level at
a time, or ends in a VerificationError (rlp.decode recurses, and is quadratic in a long list). What is proven is made
by `rlp` and `trie`.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from functools import cache
from itertools import islice
from typing import Any, Final, NamedTuple

import rlp  # type: ignore[import-untyped]
from eth_hash.auto import keccak
from trie.hexary import HexaryTrie

from rosbridge_eth.errors import ChainError, VerificationError
from rosbridge_eth.ledger.contract import DataEvent, Ledger, RegistrationEvent, Standing, artifact
from rosbridge_eth.ledger.transport import bytes32, natural

#: A block's header by the names of JSON-RPC; a * marks a number. After `nonce` each hard fork has added to the end.
HEADER: Final = (
    "parentHash", "sha3Uncles", "miner", "stateRoot", "transactionsRoot", "receiptsRoot", "logsBloom", "*difficulty",
    "*number", "*gasLimit", "*gasUsed", "*timestamp", "extraData", "mixHash", "nonce",
    "*baseFeePerGas", "withdrawalsRoot", "*blobGasUsed", "*excessBlobGas", "parentBeaconBlockRoot", "requestsHash",
)  # fmt: skip
_BEFORE_LONDON: Final = 15
#: Bytes of a node, 17 hashes and their RLP. What is larger is a leaf.
_LARGEST_BRANCH: Final = 3 + 17 * 33
_ROBOTS, _BATCH = 2, 4  # slots of RobotLedger.sol
_SLOTS = 500  # asked for at once; geth proves 1,024, Erigon 1,000
_OTHERWISE = "an event of the contract is not as Solidity writes it"
_DATA = keccak(b"Data(bytes32,uint256,address,uint256,bytes[])")
_REGISTERED = keccak(b"Registered(bytes32,address,uint256,uint256,bytes)")
_REVOKED = keccak(b"Revoked(bytes32,address,uint256,uint256)")


# RLP


class RlpList(bytes):
    """A list within a list, as it is encoded: `items` takes it apart."""


def items(encoded: bytes, most: int = 1 << 20) -> list[bytes]:
    """The items of one RLP list, of so many at most: strings, and lists as RlpList."""
    found = list(islice(_items(encoded), most + 1))
    if len(found) > most:
        raise VerificationError(f"an RLP list has more than {most} items")
    return found


def _items(encoded: bytes) -> Iterator[bytes]:
    is_list, at, end = _extent(encoded, 0)
    while is_list and at < end:
        inner_list, start, stop = _extent(encoded, at)
        yield RlpList(encoded[at:stop]) if inner_list else encoded[start:stop]
        at = stop
    if not is_list or at != end or end != len(encoded):
        raise VerificationError("what should be an RLP list is none")


def _parts(encoded: bytes, form: str) -> list[bytes]:
    """The items of an RLP list of this form: s is a string, l a list."""
    found = items(encoded, len(form))
    if "".join("sl"[isinstance(one, RlpList)] for one in found) != form:
        raise VerificationError("an RLP list does not hold what it should")
    return found


def _extent(encoded: bytes, at: int) -> tuple[bool, int, int]:
    """Of the item that begins there: whether it is a list, and where its payload begins and ends."""
    if at >= len(encoded):
        raise VerificationError("an RLP item ends early")
    first = encoded[at]
    if first < 0x80:
        return False, at, at + 1
    is_list, size = first >= 0xC0, first & 0x3F
    start = at + 1
    if size >= 56:
        start, length = at + 1 + size - 55, encoded[at + 1 : at + 1 + size - 55]
        size = int.from_bytes(length, "big")
        if size < 56 or length[0] == 0:
            raise VerificationError("the length of an RLP item is not in its one form")
    elif not is_list and size == 1 and encoded[start : start + 1] < b"\x80":
        raise VerificationError("an RLP string is not in its one form")
    if start + size > len(encoded):
        raise VerificationError("an RLP item ends early")
    return is_list, start, start + size


def _string(encoded: bytes) -> bytes:
    """The one RLP string, of 32 bytes at most, that this is."""
    is_list, start, end = _extent(encoded, 0)
    if is_list or end != len(encoded) or end - start > 32:
        raise VerificationError("what should be an RLP string of up to 32 bytes is none")
    return encoded[start:end]


def _number(value: bytes) -> int:
    return int.from_bytes(value, "big")


# Tries


class Nodes(dict[bytes, bytes]):
    """Nodes of any tries, by their keccak256. used: those that a proof went through.

    A proof takes as many steps as its key has nibbles, through nodes of a branch's size and a leaf. No leaf is read
    twice: of what is proven of one robot no two are the same.
    """

    def __init__(self, nodes: Iterable[bytes] = ()) -> None:
        super().__init__((keccak(node), node) for node in nodes)
        self.used, self._leaves = dict[bytes, bytes](), set[bytes]()

    def value(self, root: bytes, key: bytes, what: str) -> bytes:
        """What the trie with this root has there. VerificationError where it has nothing, or a node is missing."""
        absent = VerificationError(f"the trie does not have {what}")
        path, digest, node = key.hex(), root, self._node(root, what)
        while True:
            parts = items(node, 17)
            if len(parts) == 17 and path:
                is_leaf, shared, child = False, path[0], parts[int(path[0], 16)]
            elif len(parts) == 2 and parts[0] and not isinstance(parts[0], RlpList):
                flag, rest = divmod(parts[0][0], 16)
                is_leaf, shared, child = bool(flag & 2), f"{rest:x}" * (flag & 1) + parts[0][1:].hex(), parts[1]
                if flag > 3 or (rest and not flag & 1):
                    raise absent
            else:
                raise absent
            if not path.startswith(shared):
                raise absent
            path = path[len(shared) :]
            if is_leaf:
                if path or isinstance(child, RlpList):
                    raise absent
                if digest in self._leaves:
                    raise VerificationError(f"the proof of {what} has the leaf of another")
                self._leaves |= {digest} - {b""}
                return child
            if not shared or len(node) > _LARGEST_BRANCH:
                raise absent
            if isinstance(child, RlpList) and len(child) < 32:
                digest, node = b"", child
            else:
                digest, node = child, self._node(child, what)

    def _node(self, digest: bytes, what: str) -> bytes:
        if digest not in self:
            raise VerificationError(f"the proof of {what} does not hold: a node of its trie is missing")
        self.used[digest] = self[digest]
        return self[digest]


# What is proven


class Header(NamedTuple):
    """A block's header as far as it is looked at. time: seconds since 1970. encoded: its RLP."""

    number: int
    time: int
    state_root: bytes
    receipts_root: bytes
    hash: bytes
    encoded: bytes

    @staticmethod
    def parse(encoded: bytes) -> Header:
        fields = items(encoded, len(HEADER))
        if not _BEFORE_LONDON <= len(fields) <= len(HEADER) or any(isinstance(one, RlpList) for one in fields):
            raise VerificationError("a block's header is not in the form of one")
        number, time = _number(fields[8]), _number(fields[11])
        if number >= 1 << 53 or time >= 1 << 53:
            raise VerificationError("a block's number or time is beyond all bounds")
        return Header(number, time, fields[3], fields[5], keccak(encoded), encoded)


def receipt_of(nodes: Nodes, header: Header, index: int) -> bytes:
    """The receipt of the block's transaction of this index."""
    return nodes.value(header.receipts_root, rlp.encode(index), f"receipt {index} of block {header.number}")


def events_of(receipt: bytes, contract: bytes, tk: bytes, block: int) -> Iterator[DataEvent | RegistrationEvent]:
    """The robot's events in a receipt, in their order."""
    status, _, _, logs = _parts(receipt[1:] if receipt[:1] < b"\x80" else receipt, "sssl")
    if logs != b"\xc0" and status != b"\x01":
        raise VerificationError("a receipt shows events of a transaction that failed")
    for log in _items(logs):
        address, topics, data = _parts(log if isinstance(log, RlpList) else b"", "sls")
        named = items(topics, 4) if address == contract else []
        if any(len(topic) != 32 or isinstance(topic, RlpList) for topic in named):
            raise VerificationError("an event has a topic that is none")
        if named[1:2] != [tk] or named[0] not in (_DATA, _REGISTERED, _REVOKED):
            continue
        kind, account = named[0], "0x" + named[-1][-20:].hex()
        offset = {_DATA: (32, 64), _REGISTERED: (64, 96)}.get(kind)
        if len(named) != 3 + (kind == _DATA) or (offset and _word(data, offset[0]) != offset[1]):
            raise VerificationError(_OTHERWISE)
        if kind == _DATA:
            yield DataEvent(_small(named[2]), _word(data, 0), tuple(_blobs(data, 64)), block, b"", account)
        else:
            certificates = _blob(data, 96) if kind == _REGISTERED else b""
            yield RegistrationEvent(account, certificates, _word(data, 0), _word(data, 32), block, kind == _REVOKED)


def _small(value: bytes) -> int:
    if (number := _number(value)) >= 1 << 53:
        raise VerificationError("a number in an event is beyond all bounds")
    return number


def _word(data: bytes, at: int) -> int:
    word = data[at : at + 32]
    if len(word) != 32:
        raise VerificationError("an event of the contract ends early")
    return _small(word)


def _blob(data: bytes, at: int) -> bytes:
    end = at + 32 + _word(data, at)
    if end > len(data):
        raise VerificationError("an event of the contract ends early")
    return data[at + 32 : end]


def _blobs(data: bytes, at: int) -> Iterator[bytes]:
    """A bytes[] as Solidity writes it, one behind the other: no byte is in two of them."""
    count, begin = _word(data, at), at + 32
    place = 32 * count
    for number in range(count):
        if _word(data, begin + 32 * number) != place:
            raise VerificationError(_OTHERWISE)
        blob = _blob(data, begin + place)
        yield blob
        place += 32 + -(-len(blob) // 32) * 32


@cache
def code_hash() -> bytes:
    """Keccak256 of the contract's code."""
    return keccak(bytes.fromhex(artifact()["deployedBytecode"]))


def robot_slots(tk: bytes) -> list[int]:
    """Where the contract keeps how the robot stands."""
    first = _number(keccak(tk + _ROBOTS.to_bytes(32, "big")))
    return [(first + n) % 2**256 for n in range(4)]


def batch_slot(tk: bytes, first: int) -> int:
    """Where the contract keeps the hash of the batch that begins with this chunk."""
    return _number(keccak(first.to_bytes(32, "big") + keccak(tk + _BATCH.to_bytes(32, "big"))))


class State:
    """The contract's storage in one block. VerificationError where what is there is not RobotLedger."""

    def __init__(self, nodes: Nodes, header: Header, contract: bytes) -> None:
        self._nodes = nodes
        account = nodes.value(header.state_root, keccak(contract), f"the contract in block {header.number}")
        _, _, self._root, code = _parts(account, "ssss")
        if code != code_hash():
            raise VerificationError("what is at the contract's address is not RobotLedger of this edition")

    def __getitem__(self, slot: int) -> int:
        key = keccak(slot.to_bytes(32, "big"))
        return _number(_string(self._nodes.value(self._root, key, "a slot of the contract's storage")))

    def standing(self, tk: bytes) -> Standing:
        """How the robot stands; the account's balance is not in it."""
        packed, tail, certificates_hash, changed_block = (self[slot] for slot in robot_slots(tk))
        account = (packed % 2**160).to_bytes(20, "big")
        return Standing(
            "0x" + account.hex(), certificates_hash.to_bytes(32, "big"), packed >> 160 & 0xFF != 0,
            packed >> 168 & 2**40 - 1, tail.to_bytes(32, "big"), 0, packed >> 208 & 2**40 - 1, changed_block,
        )  # fmt: skip

    def has(self, tk: bytes, event: DataEvent) -> bool:
        """Whether the contract has the hash of these chunks as a batch of this robot."""
        return self[batch_slot(tk, event.first)] == _number(keccak(b"".join(map(keccak, event.chunks))))


# What a node gives for it


def header_of(ledger: Ledger, number: int) -> tuple[Header, list[str]]:
    """A block's header and the hashes of its transactions. ChainError where its hash does not come of its fields."""

    def form(answers: Sequence[Any]) -> tuple[Header, list[str]]:
        [block] = answers
        fields = [(name[0] == "*", block.get(name.lstrip("*"))) for name in HEADER]
        encoded = rlp.encode([
            natural(value, 2**256) if is_number else _bytes(value) for is_number, value in fields if value is not None
        ])  # fmt: skip
        if keccak(encoded) != bytes32(block["hash"]):
            raise ChainError(f"block {number} of this chain has a header of a kind that is not known here: no proof")
        return Header.parse(encoded), [str(each) for each in block["transactions"]]

    return ledger.ask([("eth_getBlockByNumber", [hex(number), False])], form)


def prove_receipts(ledger: Ledger, header: Header, transactions: Sequence[str]) -> tuple[list[bytes], Nodes]:
    """The receipts of these transactions, all of the block's or none, and their trie.

    ChainError where that does not have the header's root.
    """
    asked = [("eth_getTransactionReceipt", [each]) for each in transactions]
    receipts = ledger.ask(asked, lambda answers: [_receipt(answer) for answer in answers])
    nodes = Nodes()
    trie = HexaryTrie(nodes)
    for index, receipt in enumerate(receipts):
        trie[rlp.encode(index)] = receipt
    if transactions and trie.root_hash != header.receipts_root:
        raise ChainError(f"block {header.number} of this chain has receipts of a kind that is not known here: no proof")
    return receipts, nodes


def prove_state(ledger: Ledger, header: Header, slots: Sequence[int]) -> Nodes:
    """The nodes from the state's root to these slots of the contract. ChainError where the node does not give them."""

    def form(answers: Sequence[Any]) -> Nodes:
        proofs = [[answer["accountProof"], *(one["proof"] for one in answer["storageProof"])] for answer in answers]
        return Nodes(_bytes(node) for answer in proofs for proof in answer for node in proof)

    wanted = ["0x" + slot.to_bytes(32, "big").hex() for slot in slots]
    pages = [wanted[at : at + _SLOTS] for at in range(0, len(wanted), _SLOTS)]
    return ledger.ask([("eth_getProof", [ledger.contract, page, hex(header.number)]) for page in pages], form)


def _receipt(receipt: Mapping[str, Any]) -> bytes:
    logs = [
        [_bytes(log["address"]), [_bytes(topic) for topic in log["topics"]], _bytes(log["data"])]
        for log in receipt["logs"]
    ]
    encoded: bytes = rlp.encode(
        [natural(receipt["status"]), natural(receipt["cumulativeGasUsed"]), _bytes(receipt["logsBloom"]), logs]
    )
    kind = natural(receipt.get("type", 0), 128)
    return (bytes([kind]) if kind else b"") + encoded


def _bytes(value: Any) -> bytes:
    if not isinstance(value, str):
        raise ValueError(f"a {type(value).__name__} where hexadecimal was expected")
    return bytes.fromhex(value.removeprefix("0x"))
