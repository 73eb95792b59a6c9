"""The Merkle tree over a batch, as contracts/RobotLedger.sol computes it.

    leaf  keccak256(0x00 | Tk | stream | seq | keccak256(ciphertext))
    node  keccak256(0x01 | left | right); an odd node moves up unchanged

The shape is that of RFC 9162, 2.1.1 (certificate transparency); the prefixes
keep a node from being passed off as a leaf. A proof is the sibling hashes from
the leaf upwards (2.1.3.1), and its length follows from index and size.
"""

from __future__ import annotations

from collections.abc import Sequence

from eth_utils.crypto import keccak

from rosbridge_eth.errors import VerificationError
from rosbridge_eth.records import SealedRecord


def leaf_hash(record: SealedRecord) -> bytes:
    """The leaf of one record, 32 bytes."""
    id = record.id
    return keccak(b"\x00" + id.robot + id.stream + id.seq.to_bytes(8, "big") + keccak(record.ciphertext))


def node_hash(left: bytes, right: bytes) -> bytes:
    return keccak(b"\x01" + left + right)


def _levels(leaves: Sequence[bytes]) -> list[list[bytes]]:
    if not leaves:
        raise ValueError("a batch has at least one record")
    levels = [list(leaves)]
    while len(levels[-1]) > 1:
        below = levels[-1]
        above = [node_hash(below[i], below[i + 1]) for i in range(0, len(below) - 1, 2)]
        levels.append(above + below[-1:] if len(below) % 2 else above)
    return levels


def root(leaves: Sequence[bytes]) -> bytes:
    """Merkle root of one leaf or more; ValueError for none."""
    return _levels(leaves)[-1][0]


def proof(leaves: Sequence[bytes], index: int) -> list[bytes]:
    """The siblings of leaf `index`, from below upwards; at most ceil(log2(len(leaves)))."""
    if not 0 <= index < len(leaves):
        raise ValueError(f"leaf {index} of {len(leaves)} does not exist")
    path = []
    for level in _levels(leaves)[:-1]:
        sibling = index ^ 1
        if sibling < len(level):
            path.append(level[sibling])
        index //= 2
    return path


def check_proof(leaf: bytes, index: int, size: int, path: Sequence[bytes], expected_root: bytes) -> None:
    """VerificationError unless `leaf` is leaf `index` of the `size` leaves under `expected_root`.

    RFC 9162, 2.1.3.2; a path too short or too long for index and size is refused.
    """
    if not 0 <= index < size:
        raise VerificationError(f"leaf {index} of {size} does not exist")
    node, last, siblings = leaf, size - 1, iter(path)
    while last > 0:
        if index % 2 == 1 or index < last:
            sibling = next(siblings, None)
            if sibling is None:
                raise VerificationError("the proof of inclusion is too short")
            node = node_hash(sibling, node) if index % 2 else node_hash(node, sibling)
        index //= 2
        last //= 2
    if next(siblings, None) is not None:
        raise VerificationError("the proof of inclusion is too long")
    if node != expected_root:
        raise VerificationError("the record is not under the batch's Merkle root")
