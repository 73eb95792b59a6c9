"""Curves as values, and points as bytes."""

from __future__ import annotations

import copy
import json
import pickle

import pytest
from hypothesis import given
from hypothesis import strategies as st

import sm2_reference as reference
from sm2_reference import CURVES, SAMPLE, TINY, TINY_17, TINY_61, TINY_79
from smcrypto import InvalidKey, sm2
from smcrypto.sm2 import SM2P256V1, PrivateKey, PublicKey
from smcrypto.sm2.curve import decode_point, encode_point, require_point
from vectors_json import STANDARDS, load


@pytest.mark.parametrize("curve", [SM2P256V1, SAMPLE, *TINY], ids=lambda c: c.name)
def test_the_base_point_is_on_the_curve_and_of_prime_order(curve):
    assert curve.holds(curve.G)
    assert pow(2, curve.n - 1, curve.n) == 1 and curve.p % 4 == 3
    assert reference.multiple(curve.n, curve.G, curve) is None
    assert (4 * curve.a**3 + 27 * curve.b**2) % curve.p != 0


@pytest.mark.parametrize("curve", [*TINY], ids=lambda c: c.name)
def test_a_tiny_curve_has_as_many_points_as_it_says(curve):
    assert len(reference.points(curve)) + 1 == curve.n


def test_a_curve_of_ones_own_is_no_part_of_the_public_interface():
    """Nothing checks that p is prime, or what the order of G is: a wrong curve gives keys away."""
    assert not hasattr(sm2, "Curve") and "Curve" not in sm2.__all__


def test_the_standard_curve_has_the_parameters_of_the_vectors():
    published = json.loads((STANDARDS / "sm2_sign.json").read_text())["curves"]["sm2p256v1"]
    for name in ("p", "a", "b", "n"):
        assert getattr(SM2P256V1, name) == int(published[name], 16)
    assert (int(published["gx"], 16), int(published["gy"], 16)) == SM2P256V1.G
    assert published["h"] == 1


def test_a_curve_is_a_value():
    assert pickle.loads(pickle.dumps(SAMPLE)) == SAMPLE != SM2P256V1
    assert len({SAMPLE, copy.deepcopy(SAMPLE)}) == 1
    with pytest.raises(AttributeError):
        SAMPLE.p = 7


@pytest.mark.parametrize("curve", [TINY_17, TINY_61, TINY_79], ids=lambda c: c.name)
def test_every_pair_of_coordinates_is_a_point_or_refused(curve):
    expected = set(reference.points(curve))
    for x in range(-1, curve.p + 2):
        for y in range(-1, curve.p + 2):
            if (x, y) in expected:
                assert require_point((x, y), curve) == (x, y)
            else:
                with pytest.raises(InvalidKey):
                    require_point((x, y), curve)


@pytest.mark.parametrize("curve", [TINY_17, TINY_61, TINY_79], ids=lambda c: c.name)
def test_every_point_survives_both_encodings_and_no_other_bytes_decode(curve):
    decoded = set()
    for head in range(256):
        for x in range(curve.p + 3):
            try:
                decoded.add(decode_point(bytes((head, x)), curve))
            except InvalidKey:
                continue
            assert head in (2, 3)
    assert decoded == set(reference.points(curve))
    for P in decoded:
        assert decode_point(encode_point(P, curve), curve) == P
        assert decode_point(encode_point(P, curve, compressed=True), curve) == P
        with pytest.raises(InvalidKey):
            decode_point(encode_point(P, curve, compressed=True), curve, allow_compressed=False)


@given(st.integers(1, SM2P256V1.n - 2))
def test_both_encodings_of_a_public_key_are_read_back(d):
    key = PrivateKey.from_int(d).public_key
    assert PublicKey.from_bytes(key.to_bytes()) == key
    assert PublicKey.from_bytes(key.to_bytes(compressed=True)) == key
    assert PublicKey.from_bytes(bytearray(key.to_bytes())) == PublicKey.from_bytes(memoryview(key.to_bytes())) == key


@pytest.mark.parametrize("v", load("standards/sm2_adversarial.json", "public_points"))
def test_points_of_the_adversarial_vectors(v):
    # "acceptable" is the hybrid form, which we refuse.
    if v.result == "valid":
        key = PublicKey.from_bytes(v.point)
        assert v.point in (key.to_bytes(), key.to_bytes(compressed=True))
    else:
        with pytest.raises(InvalidKey):
            PublicKey.from_bytes(v.point)


@pytest.mark.parametrize("name", CURVES)
def test_a_changed_bit_of_a_coordinate_leaves_the_curve(name):
    curve = CURVES[name]
    data = encode_point(curve.G, curve)
    for bit in range(8 * 33, 8 * 65):
        changed = bytearray(data)
        changed[bit // 8] ^= 0x80 >> bit % 8
        with pytest.raises(InvalidKey):
            decode_point(bytes(changed), curve)
