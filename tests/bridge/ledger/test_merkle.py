"""The Merkle tree against RFC 9162's recursive definition, and against the contract."""

from __future__ import annotations

import pytest
from eth_utils.crypto import keccak
from hypothesis import given
from hypothesis import strategies as st

from bridge.ledger.world import ROBOT, Ledger, Records
from rosbridge_eth.errors import VerificationError
from rosbridge_eth.ledger import merkle, packing

LEAVES = st.lists(st.binary(min_size=32, max_size=32), min_size=1, max_size=40)


def tree_hash(leaves: list[bytes]) -> bytes:
    """MTH of RFC 9162, 2.1.1, with keccak256: split at the largest power of two below n."""
    if len(leaves) == 1:
        return leaves[0]
    k = 1
    while 2 * k < len(leaves):
        k *= 2
    return keccak(b"\x01" + tree_hash(leaves[:k]) + tree_hash(leaves[k:]))


def path(leaves: list[bytes], m: int) -> list[bytes]:
    """PATH of RFC 9162, 2.1.3.1."""
    if len(leaves) == 1:
        return []
    k = 1
    while 2 * k < len(leaves):
        k *= 2
    if m < k:
        return [*path(leaves[:k], m), tree_hash(leaves[k:])]
    return [*path(leaves[k:], m - k), tree_hash(leaves[:k])]


@given(LEAVES)
def test_root_and_proofs_are_those_of_the_rfc(leaves):
    root = merkle.root(leaves)
    assert root == tree_hash(leaves)
    for i, leaf in enumerate(leaves):
        proof = merkle.proof(leaves, i)
        assert proof == path(leaves, i)
        merkle.check_proof(leaf, i, len(leaves), proof, root)


@given(LEAVES, st.data())
def test_a_proof_altered_in_any_way_is_refused(leaves, data):
    i = data.draw(st.integers(0, len(leaves) - 1))
    proof, root, leaf = merkle.proof(leaves, i), merkle.root(leaves), leaves[i]
    bad = [
        (bytes(32) if leaf != bytes(32) else b"\1" * 32, i, len(leaves), proof, root),
        (leaf, i, len(leaves), [*proof, bytes(32)], root),
        (leaf, i, len(leaves), proof, keccak(root)),
        (leaf, len(leaves), len(leaves), proof, root),
        (leaf, -1, len(leaves), proof, root),
        (leaf, 0, 0, proof, root),
    ]
    if proof:
        bad.append((leaf, i, len(leaves), proof[:-1], root))
        j = data.draw(st.integers(0, len(proof) - 1))
        bad.append((leaf, i, len(leaves), [*proof[:j], keccak(proof[j]), *proof[j + 1 :]], root))
    for arguments in bad:
        with pytest.raises(VerificationError):
            merkle.check_proof(*arguments)


def test_a_node_cannot_be_passed_off_as_a_leaf():
    leaves = [keccak(bytes([i])) for i in range(4)]
    inner = merkle.node_hash(leaves[0], leaves[1])
    # With the tree's real size the shorter proof is refused; claiming a tree of two is caught by the record's
    # own leaf hash, which starts with another byte than a node's.
    with pytest.raises(VerificationError):
        merkle.check_proof(inner, 0, 4, [merkle.node_hash(leaves[2], leaves[3])], merkle.root(leaves))


def test_there_is_no_tree_of_nothing_and_no_leaf_beyond():
    with pytest.raises(ValueError, match="at least one"):
        merkle.root([])
    for index in (-1, 1):
        with pytest.raises(ValueError, match="does not exist"):
            merkle.proof([bytes(32)], index)


def test_a_leaf_is_the_hash_the_contract_documents():
    (record,) = Records().run(1, first=0x0102030405060708)
    id = record.id
    text = b"\0" + id.robot + id.stream + bytes(range(1, 9)) + keccak(record.ciphertext)
    assert len(text) == 89
    assert merkle.leaf_hash(record) == keccak(text)


def test_the_contract_computes_the_same_root_for_every_size(made: Ledger, records: Records):
    for size in [*range(1, 35), 63, 64, 65, 127, 128, 129, 200]:
        batch = records.run(size, size=3)
        packed = packing.pack(batch)
        assert made.contract.merkle_root(ROBOT, packed) == tree_hash([merkle.leaf_hash(record) for record in batch])
