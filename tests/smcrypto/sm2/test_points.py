"""The fast arithmetic against the definition: exhaustively on tiny curves, at the edges on real ones."""

from __future__ import annotations

from itertools import product

import pytest
from hypothesis import given
from hypothesis import strategies as st

import sm2_reference as reference
from sm2_reference import SAMPLE, TINY, TINY_17, TINY_61, TINY_79, TINY_1009
from smcrypto.sm2 import SM2P256V1, points
from smcrypto.sm2.points import Comb, base_comb, odd_multiples, public_sum, secret_sum, to_affine

pytestmark = pytest.mark.usefixtures("sm2_engine")

REAL = (SM2P256V1, SAMPLE)
NAME = {"ids": lambda c: c.name}
BIG = {
    curve: {
        *range(20),
        *(curve.n + i for i in range(-20, 0)),
        *(curve.n // 2 + i for i in range(-3, 4)),
        *(2**i + j for i in range(8, 256) for j in (-1, 0, 1) if 2**i + j < curve.n),
    }
    for curve in REAL
}


def secret(curve, *terms):
    return to_affine(secret_sum(curve, *terms), curve)


def public(curve, *terms):
    return to_affine(public_sum(curve, *terms), curve)


@pytest.mark.parametrize("curve", [TINY_17, TINY_61, TINY_79], **NAME)
def test_every_scalar_times_every_point(curve):
    for P in reference.points(curve):
        comb = Comb(P, 3, curve)
        expected = None
        for k in range(curve.n):
            assert secret(curve, (k, P)) == expected
            assert secret(curve, (k, comb)) == expected
            assert public(curve, (k, P)) == expected
            assert public(curve, (k, comb)) == expected
            expected = reference.add(expected, P, curve)
        assert expected is None


def test_every_scalar_times_points_of_a_curve_of_order_1009():
    curve = TINY_1009
    chosen = (curve.G, reference.multiple(500, curve.G, curve))
    combs = [Comb(P, width, curve) for P in chosen for width in (1, 2, 4, 8, 12)]
    for P in chosen:
        expected = None
        for k in range(curve.n):
            assert secret(curve, (k, P)) == public(curve, (k, P)) == expected
            for comb in combs[:5] if P is chosen[0] else combs[5:]:
                assert secret(curve, (k, comb)) == public(curve, (k, comb)) == expected
            expected = reference.add(expected, P, curve)


def test_every_sum_of_two_multiples():
    curve = TINY_17
    G, comb = curve.G, base_comb(curve)
    for P in reference.points(curve)[:5]:
        own = Comb(P, 2, curve)
        for j, k in product(range(curve.n), repeat=2):
            expected = reference.add(reference.multiple(j, G, curve), reference.multiple(k, P, curve), curve)
            assert public(curve, (j, comb), (k, P)) == expected
            assert public(curve, (j, comb), (k, own)) == expected
            assert secret(curve, (j, G), (k, P)) == expected
            assert secret(curve, (j, own), (k, P)) == reference.multiple((j + k) % 17, P, curve)
            assert secret(curve, (j, comb), (k, own)) == expected


@pytest.mark.parametrize("curve", REAL, **NAME)
def test_scalars_at_the_edges(curve):
    P = reference.multiple(0xC0FFEE, curve.G, curve)
    for k in sorted(BIG[curve]):
        expected = reference.multiple(k, curve.G, curve)
        assert secret(curve, (k, base_comb(curve))) == expected
        assert public(curve, (k, base_comb(curve))) == expected
        if k < 40 or k.bit_length() % 16 == 0 or k > curve.n - 20:
            expected = reference.multiple(k, P, curve)
            assert secret(curve, (k, P)) == public(curve, (k, P)) == expected


@pytest.mark.parametrize("curve", REAL, **NAME)
@given(data=st.data())
def test_sums_of_random_multiples(curve, data):
    scalars = st.integers(0, curve.n - 1)
    j, k, m = data.draw(scalars), data.draw(scalars), data.draw(scalars)
    P = reference.multiple(m or 1, curve.G, curve)
    expected = reference.multiple((j + k * (m or 1)) % curve.n, curve.G, curve)
    assert public(curve, (j, base_comb(curve)), (k, P)) == expected
    assert secret(curve, (j, base_comb(curve)), (k, P)) == expected
    assert secret(curve, (j, curve.G), (k, P)) == expected


def table_entries(comb, P, curve):
    """(the entry, the multiple of P it must be) of the whole table."""
    for i, row in enumerate(comb.rows):
        assert len(row) == 1 << comb.width
        for b, entry in enumerate(row):
            yield entry, (2 * b - (1 << comb.width) + 1) * 2 ** (comb.width * i) % curve.n


@pytest.mark.parametrize("curve", TINY, **NAME)
@pytest.mark.parametrize("width", [1, 2, 3, 9])
def test_every_entry_of_tiny_tables(curve, width):
    for entry, k in table_entries(Comb(curve.G, width, curve), curve.G, curve):
        assert entry == reference.multiple(k, curve.G, curve)


@pytest.mark.parametrize("curve", REAL, **NAME)
def test_every_entry_of_the_table_of_the_base_point(curve):
    # Entry by entry by adding twice the row's base, so that the oracle needs one addition for each.
    comb = base_comb(curve)
    base = curve.G
    for row in comb.rows:
        half = len(row) // 2
        twice = reference.add(base, base, curve)
        expected = base
        for positive, negative in zip(row[half:], reversed(row[:half]), strict=True):
            assert positive == expected
            assert negative == (expected[0], curve.p - expected[1])
            expected = reference.add(expected, twice, curve)
        base = reference.multiple(2**comb.width, base, curve)
    assert len(comb.rows) * comb.width >= curve.n.bit_length()


@pytest.mark.parametrize("curve", [*TINY, *REAL], **NAME)
def test_odd_multiples_are_the_odd_multiples(curve):
    P = reference.multiple(3, curve.G, curve)
    for count in (1, 2, 3, 8):
        assert odd_multiples(P, count, curve) == [reference.multiple(2 * i + 1, P, curve) for i in range(count)]


def test_a_sum_starts_with_random_coordinates():
    curve = SM2P256V1
    for term in (curve.G, base_comb(curve)):
        sums = {secret_sum(curve, (5, term)) for _ in range(4)}
        assert len(sums) == 4
        assert {to_affine(total, curve) for total in sums} == {reference.multiple(5, curve.G, curve)}


@pytest.mark.parametrize("term", ["point", "comb"])
def test_the_number_of_operations_does_not_depend_on_the_scalar(term, monkeypatch):
    """Every reduction modulo p is counted by a prime that is an int which counts."""
    curve = SM2P256V1

    monkeypatch.setattr(points.ENGINE, "name", "python")
    monkeypatch.setattr(points.ENGINE, "_loaded", None)

    class CountingPrime(int):
        reductions = 0

        def __rmod__(self, value):
            CountingPrime.reductions += 1
            return value % int(self)

    counted = type(curve)("counted", CountingPrime(curve.p), curve.a, curve.b, curve.n, curve.G)
    monkeypatch.setattr(points.secrets, "randbelow", lambda bound: 7)
    P = curve.G if term == "point" else Comb(curve.G, 8, curve)
    counts = set()
    for k in (1, 2, 3, 2**255, 2**256 % curve.n, curve.n - 1, curve.n - 2, 0x5555 << 200, (1 << 255) - 1):
        CountingPrime.reductions = 0
        secret_sum(counted, (k, P))
        counts.add(CountingPrime.reductions)
    assert len(counts) == 1
    assert counts.pop() > 200
