"""GHASH: the definition against published values, and every faster form against the definition."""

from __future__ import annotations

import random
import threading

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from sm4_reference import ghash_by_definition, multiply_by_definition
from smcrypto.sm4 import ghash
from smcrypto.sm4.ghash import GHASH

ELEMENTS = st.integers(0, 2**128 - 1)
ONE = 1 << 127
# Where a product wraps: x^127 and its neighbours, x^0, all coefficients.
EDGES = [0, 1, 2, 3, ONE, ONE >> 1, 2**128 - 1, 0xE1 << 120, 1 << 64]


def element(key: random.Random) -> int:
    return key.getrandbits(128)


def test_the_definition_gives_the_published_values():
    """McGrew and Viega, The Galois/Counter Mode of Operation, appendix B, test case 2: with AES, but GHASH is GHASH."""
    H = 0x66E94BD4EF8A2C3B884CFA59CA342B2E
    C = bytes.fromhex("0388dace60b6a392f328c2b971b2fe78")
    assert multiply_by_definition(int.from_bytes(C, "big"), H) == 0x5E2EC746917062882C85B0685353DEB7
    assert ghash_by_definition(H, C + (128).to_bytes(16, "big")) == 0xF38CBB1AD69223DCC3457AE5B6B0F885


@given(ELEMENTS, ELEMENTS, ELEMENTS)
def test_the_definition_is_a_field_multiplication(a, b, c):
    assert multiply_by_definition(a, b) == multiply_by_definition(b, a)
    times = multiply_by_definition
    assert times(a, ONE) == a
    assert times(a ^ c, b) == times(a, b) ^ times(c, b)
    assert times(times(a, b), c) == times(a, times(b, c))


def test_squaring_128_times_is_the_identity():
    """Fermat in GF(2^128): X^(2^128) = X."""
    X = start = element(random.Random(4))
    for _ in range(128):
        X = ghash._square(X)
    assert start == X


@given(ELEMENTS)
def test_squaring_is_multiplying_by_oneself(X):
    assert ghash._square(X) == multiply_by_definition(X, X)


@pytest.mark.parametrize("H", EDGES)
def test_the_table_is_every_multiple(H):
    assert ghash._multiples(H) == [multiply_by_definition(b << 120, H) for b in range(256)]


@pytest.mark.parametrize("H", EDGES)
def test_serial_at_the_edges(H):
    T = ghash._multiples(H)
    for X in EDGES + [1 << i for i in range(128)]:
        assert ghash._times(T, X) == multiply_by_definition(X, H)


@pytest.mark.parametrize("H", EDGES)
def test_pairs_at_the_edges(H):
    T, T2 = ghash._multiples(H), ghash._multiples(ghash._square(H))
    for X in EDGES:
        for Y in EDGES:
            data = X.to_bytes(16, "big") + Y.to_bytes(16, "big")
            assert ghash._in_pairs(T, T2, data) == ghash_by_definition(H, data)


@given(ELEMENTS, st.binary(max_size=160))
def test_serial_and_pairs_are_the_definition(H, data):
    data = data.ljust(-(-len(data) // 16) * 16, b"\0")
    T, T2 = ghash._multiples(H), ghash._multiples(ghash._square(H))
    assert ghash._serial(T, data) == ghash._in_pairs(T, T2, data) == ghash_by_definition(H, data)


@pytest.mark.parametrize("early", [True, False])
@pytest.mark.parametrize("n", [2, 8, 32, 128])
def test_folding_keeps_the_hash(n, early):
    """Around one part, a whole group of parts (5), and the next group, in an order that also shrinks."""
    source = random.Random(n)
    H = element(source)
    T = ghash._multiples(H)
    fold = ghash._Fold(H, n, early=early)
    for blocks in (1, 2, n - 1, n, n + 1, 5 * n, 4 * n, 5 * n - 1, 11 * n + 1, 5 * n + 1, 3):
        data = source.randbytes(16 * blocks)
        folded = fold.fold(data)
        assert len(folded) == 16 * n
        assert ghash._serial(T, folded) == ghash._serial(T, data), blocks


@pytest.mark.parametrize("H", EDGES)
def test_folding_at_the_edges(H):
    T = ghash._multiples(H)
    for n in (8, 32):
        fold = ghash._Fold(H, n, early=n == 8)
        for data in (b"\xff" * 16 * 83, b"\x80" + bytes(16 * 83 - 1), bytes(16 * 83 - 1) + b"\1", bytes(16 * 83)):
            assert ghash._serial(T, fold.fold(data)) == ghash._serial(T, data)


THRESHOLDS = sorted({least + d for _, least in ghash._FOLDS if least < 2000 for d in (-1, 0, 1)})


@pytest.mark.parametrize("blocks", [0, 1, 2, 3, 62, 63, 64, 65, *THRESHOLDS])
def test_a_key_hashes_alike_at_its_first_use_and_later(blocks):
    """The first call may be too early for constants, later ones have them."""
    source = random.Random(blocks)
    H, data = source.randbytes(16), source.randbytes(16 * blocks)
    expected = ghash_by_definition(int.from_bytes(H, "big"), data)
    hashing = GHASH(H)
    assert [hashing(data) for _ in range(4)] == [expected] * 4


@pytest.mark.parametrize("blocks", [12287, 12288, 12289, 65536, 65537])
def test_long_messages_and_those_folded_in_several_pieces(blocks):
    source = random.Random(blocks)
    H, data = source.randbytes(16), source.randbytes(16 * blocks)
    assert GHASH(H)(data) == ghash._serial(ghash._multiples(int.from_bytes(H, "big")), data)


@settings(max_examples=30)
@given(
    st.binary(min_size=16, max_size=16), st.lists(st.integers(0, 900), min_size=1, max_size=6),
    st.integers(0, 2**32),
)
def test_the_order_of_messages_does_not_matter(H, lengths, seed):
    source = random.Random(seed)
    hashing, T = GHASH(H), ghash._multiples(int.from_bytes(H, "big"))
    for length in lengths:
        data = source.randbytes(16 * length)
        assert hashing(data) == ghash._serial(T, data)


def test_threads_may_share_a_key():
    source = random.Random(5)
    H = source.randbytes(16)
    messages = [source.randbytes(16 * (40 + 37 * i)) for i in range(24)]
    T = ghash._multiples(int.from_bytes(H, "big"))
    expected = [ghash._serial(T, message) for message in messages]
    hashing = GHASH(H)
    found: dict[int, list[int]] = {}

    def work(name: int) -> None:
        found[name] = [hashing(message) for message in messages]

    threads = [threading.Thread(target=work, args=(i,)) for i in range(4)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    assert [found[i] for i in range(4)] == [expected] * 4
