"""The proof of one record, against a plain transcription of RFC 9162, 2.1, over every small tree."""

from __future__ import annotations

from dataclasses import replace

import pytest
from hypothesis import given
from hypothesis import strategies as st

from bridge.log.making import LINES, READER, sealed
from rosbridge_eth.log.chunk import MAX_RECORDS, Altered, Proof, check_proof, content_key, proofs
from smcrypto import sm3

KEY = b"k" * 16
SALT_KEY = sm3.hmac(KEY, b"rosbridge-eth/3 salts\1")


def leaf(i: int, line: bytes) -> bytes:
    return sm3.digest(b"\0" + sm3.hmac(SALT_KEY, i.to_bytes(4, "big"))[:16] + line)


def split(n: int) -> int:
    """The largest power of two below n."""
    k = 1
    while 2 * k < n:
        k *= 2
    return k


def tree_hash(leaves: list[bytes]) -> bytes:
    """MTH of RFC 9162, 2.1.1, over leaf hashes."""
    if not leaves:
        return sm3.digest(b"")
    if len(leaves) == 1:
        return leaves[0]
    k = split(len(leaves))
    return sm3.digest(b"\1" + tree_hash(leaves[:k]) + tree_hash(leaves[k:]))


def path(m: int, leaves: list[bytes]) -> list[bytes]:
    """PATH of RFC 9162, 2.1.3.1."""
    if len(leaves) == 1:
        return []
    k = split(len(leaves))
    if m < k:
        return [*path(m, leaves[:k]), tree_hash(leaves[k:])]
    return [*path(m - k, leaves[k:]), tree_hash(leaves[:k])]


@pytest.mark.parametrize("n", [*range(1, 34), 63, 64, 65, 100])
def test_every_record_of_every_small_chunk_is_proven_as_the_rfc_says(n):
    lines = [b"line %d" % i for i in range(n)]
    leaves = [leaf(i, line) for i, line in enumerate(lines)]
    root = tree_hash(leaves)
    for i, line in enumerate(lines):
        proof = next(proofs(lines, KEY, [i]))
        assert proof == Proof(i, sm3.hmac(SALT_KEY, i.to_bytes(4, "big"))[:16], tuple(path(i, leaves)))
        check_proof(root, n, line, proof)
        for j in range(-1, n + 2) if n < 20 else ():
            if j != i:
                with pytest.raises(Altered):
                    check_proof(root, n, line, replace(proof, index=j))


def test_the_root_in_a_header_is_the_rfc_s_over_the_chunk_s_lines():
    for lines in ([], LINES, [b"x"] * MAX_RECORDS):
        header = sealed(lines).header
        key = content_key(header, READER) if lines else b""
        salt_key = sm3.hmac(key, b"rosbridge-eth/3 salts\1")
        leaves = [
            sm3.digest(b"\0" + sm3.hmac(salt_key, i.to_bytes(4, "big"))[:16] + line) for i, line in enumerate(lines)
        ]
        assert header.root == tree_hash(leaves)


@given(st.integers(1, 40), st.data())
def test_a_proof_that_was_changed_shows_nothing(n, data):
    lines = [b"line %d" % i for i in range(n)]
    root = tree_hash([leaf(i, line) for i, line in enumerate(lines)])
    i = data.draw(st.integers(0, n - 1))
    proof, line = next(proofs(lines, KEY, [i])), lines[i]
    node, bit = data.draw(st.integers(0, len(proof.path))), data.draw(st.integers(0, 127))

    def flipped(value: bytes) -> bytes:
        return (int.from_bytes(value, "big") ^ 1 << bit).to_bytes(len(value), "big")

    changed = [
        (line + b" ", proof), (line, replace(proof, salt=flipped(proof.salt))),
        (line, replace(proof, salt=proof.salt + b"\0")), (line, replace(proof, salt=proof.salt[1:])),
        (line, replace(proof, path=(*proof.path, bytes(32)))), (line, replace(proof, path=(*proof.path, root))),
        (proof.salt[-1:] + line, replace(proof, salt=proof.salt[:-1])),
    ]  # fmt: skip
    if proof.path:
        node %= len(proof.path)
        other = (*proof.path[:node], flipped(proof.path[node]), *proof.path[node + 1:])
        changed += [
            (line, replace(proof, path=other)), (line, replace(proof, path=proof.path[:-1])),
            (line, replace(proof, path=tuple(value[:-1] for value in proof.path))), (line, replace(proof, path=())),
        ]  # fmt: skip
    for shown, wrong in changed:
        with pytest.raises(Altered):
            check_proof(root, n, shown, wrong)
    with pytest.raises(Altered):
        check_proof(flipped(root), n, line, proof)


def test_an_inner_node_is_no_record():
    """What the two prefixes are for: without them the concatenation of two hashes would be a line."""
    lines = [b"a", b"b", b"c", b"d"]
    leaves = [leaf(i, line) for i, line in enumerate(lines)]
    root, left = tree_hash(leaves), leaves[0] + leaves[1]
    with pytest.raises(Altered):
        check_proof(root, 2, left[16:], Proof(0, left[:16], (tree_hash(leaves[2:]),)))


@pytest.mark.parametrize(("records", "index"), [(0, 0), (1, 1), (1, -1), (0, -1), (2**32, 2**32)])
def test_a_place_that_is_none_is_refused(records, index):
    with pytest.raises(Altered):
        check_proof(leaf(0, b"a"), records, b"a", Proof(index, sm3.hmac(KEY, bytes(4))[:16], ()))


def test_a_long_path_costs_nothing():
    with pytest.raises(Altered):
        check_proof(bytes(32), 1000, b"a", Proof(5, bytes(16), (bytes(32),) * 100_000))
