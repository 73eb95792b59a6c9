"""Curves as values, and points as bytes."""

from __future__ import annotations

import copy
import json
import pickle

import pytest
from hypothesis import given
from hypothesis import strategies as st

import sm2_reference as reference
from sm2_reference import COFACTOR_4, CURVES, SAMPLE, TINY, TINY_17, TINY_61, TINY_79
from smcrypto import InvalidKey
from smcrypto.sm2 import SM2P256V1, PrivateKey, PublicKey
from smcrypto.sm2.curve import decode_point, encode_point, plain_add, plain_multiple, require_point, square_root
from vectors_json import STANDARDS, load


@pytest.mark.parametrize("curve", [SM2P256V1, SAMPLE, *TINY, COFACTOR_4], ids=lambda c: c.name)
def test_the_base_point_is_on_the_curve_and_of_prime_order(curve):
    assert curve.holds(curve.G)
    assert pow(2, curve.n - 1, curve.n) == 1
    assert reference.multiple(curve.n, curve.G, curve) is None
    assert (4 * curve.a**3 + 27 * curve.b**2) % curve.p != 0


@pytest.mark.parametrize("curve", [*TINY, COFACTOR_4], ids=lambda c: c.name)
def test_a_tiny_curve_has_as_many_points_as_it_says(curve):
    assert len(reference.points(curve)) + 1 == curve.n * curve.h


def test_the_standard_curve_has_the_parameters_of_the_vectors():
    published = json.loads((STANDARDS / "sm2_sign.json").read_text())["curves"]["sm2p256v1"]
    for name in ("p", "a", "b", "n"):
        assert getattr(SM2P256V1, name) == int(published[name], 16)
    assert (int(published["gx"], 16), int(published["gy"], 16)) == SM2P256V1.G
    assert SM2P256V1.h == published["h"]


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


def test_a_point_outside_the_group_of_order_n_is_refused_where_there_is_a_cofactor():
    inside = 0
    for P in reference.points(COFACTOR_4):
        if reference.multiple(19, P, COFACTOR_4) is None:
            assert require_point(P, COFACTOR_4) == P
            inside += 1
        else:
            with pytest.raises(InvalidKey):
                require_point(P, COFACTOR_4)
    assert inside == 18


def test_plain_arithmetic_is_that_of_the_reference():
    group = [None, *reference.points(TINY_17)]
    for P in group:
        for Q in group:
            assert plain_add(P, Q, TINY_17) == reference.add(P, Q, TINY_17)
        for k in range(40):
            assert plain_multiple(k, P, TINY_17) == reference.multiple(k, P, TINY_17)


def test_square_roots_need_a_prime_of_the_right_form():
    assert square_root(4, 7) in (2, 5)
    with pytest.raises(NotImplementedError, match="3 mod 4"):
        square_root(4, 13)


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
