"""Signing and verifying, GB/T 32918.2: vectors, every signature of a tiny curve, malformed ones."""

from __future__ import annotations

from itertools import product

import pytest
from hypothesis import given
from hypothesis import strategies as st

import sm2_reference as reference
from sm2_reference import CURVES, SAMPLE, TINY_17, TINY_61, TINY_79, number
from smcrypto import InvalidLength, InvalidOption, InvalidSignature, der, sm2
from smcrypto.sm2 import SM2P256V1, signature
from smcrypto.sm2.signature import DEFAULT_UID, z_value
from vectors_json import load

pytestmark = pytest.mark.usefixtures("sm2_engine")

KEY = sm2.PrivateKey.from_int(0x3945208F_7B2144B1_3F36E38A_C6D39F95_88939369_2860B51A_42FB81EF_4DF7C5B8)
N = SM2P256V1.n


def inverse(d, curve):
    return pow(1 + d, -1, curve.n)


@pytest.mark.parametrize("v", [*load("standards/sm2_sign.json"), *load("third_party/sm2_sign.json")])
def test_vectors_are_signed_with_their_nonce_and_verify(v):
    curve = CURVES[v.curve]
    d, k = number(v.private_key), number(v.k)
    key = sm2.PrivateKey(d, curve)
    assert key.public_key.to_bytes() == v.public_key
    assert z_value(curve, key.public_key.point, v.uid) == v.za
    assert signature.message_digest(curve, key.public_key.point, v.uid, v.msg) == v.e
    r, s = signature.sign(curve, inverse(d, curve), number(v.e), iter([k]))
    assert (r, s) == (number(v.r), number(v.s))
    assert signature.encode_signature(r, s, curve, "der") == v.signature_der
    public_key = sm2.PublicKey(key.public_key.point, curve)
    public_key.verify(v.signature_der, v.msg, uid=v.uid)
    public_key.verify(v.r.rjust(32, b"\0") + v.s.rjust(32, b"\0"), v.msg, uid=v.uid, encoding="raw")
    public_key.verify_digest(v.signature_der, v.e)
    with pytest.raises(InvalidSignature):
        public_key.verify(v.signature_der, v.msg + b"!", uid=v.uid)
    with pytest.raises(InvalidSignature):
        public_key.verify(v.signature_der, v.msg, uid=v.uid + b"!" if len(v.uid) < 8191 else b"")


@pytest.mark.parametrize("v", load("third_party/sm2_sign.json", "digest_tests"))
def test_third_party_signatures_of_a_digest(v):
    sm2.PublicKey.from_bytes(v.public_key).verify_digest(v.signature_der, v.e)


@pytest.mark.parametrize("v", load("standards/sm2_adversarial.json", "signatures"))
def test_adversarial_signatures(v):
    public_key = sm2.PublicKey.from_bytes(v.public_key)
    if v.result == "valid":
        public_key.verify(v.signature_der, v.msg, uid=v.uid)
    else:
        with pytest.raises(InvalidSignature):
            public_key.verify(v.signature_der, v.msg, uid=v.uid)


@pytest.mark.parametrize("v", load("standards/sm2_adversarial.json", "digest_level"))
def test_adversarial_signatures_of_a_digest(v):
    public_key = sm2.PublicKey.from_bytes(v.public_key)
    for _ in range(5):  # before and after the key has earned a comb
        if v.result == "valid":
            public_key.verify_digest(v.signature_der, v.e)
        else:
            with pytest.raises(InvalidSignature):
                public_key.verify_digest(v.signature_der, v.e)


@pytest.mark.parametrize("curve", [TINY_17, TINY_61, TINY_79], ids=lambda c: c.name)
def test_exactly_the_signatures_of_the_definition_verify(curve):
    """All (r, s), r and s from 0 to n: valid iff 7.1 says so, with the reference's arithmetic."""
    n = curve.n
    multiples = [reference.multiple(k, curve.G, curve) for k in range(n)]
    for d, e in ((1, 0), (2, n - 1), (n - 2, 5), (n // 2, 3 * n + 7)):
        valid = set()
        for r, s in product(range(n + 1), repeat=2):
            t = (r + s) % n
            point = multiples[(s + t * d) % n]
            if 0 < r < n and 0 < s < n and t and point and (e + point[0]) % n == r:
                valid.add((r, s))
            try:
                signature.verify(curve, multiples[d], e, r, s)
            except InvalidSignature:
                assert (r, s) not in valid
            else:
                assert (r, s) in valid
        assert valid


@pytest.mark.parametrize("curve", [TINY_17, TINY_61, TINY_79], ids=lambda c: c.name)
def test_every_nonce_signs_or_is_passed_over(curve):
    """For every d, k and many e: s = (k - r d)/(1 + d), unless r = 0, r + k = n or s = 0."""
    n = curve.n
    refused = set()
    for d, k, e in product(range(1, n - 1, 3), range(1, n), range(0, n, 7)):
        r = (e + reference.multiple(k, curve.G, curve)[0]) % n
        s = (k - r * d) * inverse(d, curve) % n
        if reason := [name for name, bad in (("r", r == 0), ("r+k", r + k == n), ("s", s == 0)) if bad]:
            refused.update(reason)
            with pytest.raises(StopIteration):
                signature.sign(curve, inverse(d, curve), e, iter([k]))
            signature.sign(curve, inverse(d, curve), e, iter([k, *range(1, n)]))
        else:
            assert signature.sign(curve, inverse(d, curve), e, iter([k])) == (r, s)
    assert refused == {"r", "r+k", "s"}


@pytest.mark.parametrize("encoding", ["der", "raw"])
@given(d=st.integers(1, N - 2), message=st.binary(max_size=200), uid=st.binary(max_size=40))
def test_what_a_key_signs_its_public_key_verifies(encoding, d, message, uid):
    key = sm2.PrivateKey.from_int(d)
    signed = key.sign(message, uid=uid, encoding=encoding)
    key.public_key.verify(signed, message, uid=uid, encoding=encoding)
    for wrong in ({"message": message + b"\0"}, {"uid": uid + b"\0"}, {"signature": signed[:-1]}):
        arguments = {"signature": signed, "message": message, "uid": uid} | wrong
        with pytest.raises(InvalidSignature):
            key.public_key.verify(**arguments, encoding=encoding)


@pytest.mark.parametrize("encoding", ["der", "raw"])
def test_every_changed_bit_is_refused(encoding):
    signed = KEY.sign(b"message", encoding=encoding)
    for bit in range(8 * len(signed)):
        changed = bytearray(signed)
        changed[bit // 8] ^= 1 << bit % 8
        with pytest.raises(InvalidSignature):
            KEY.public_key.verify(changed, b"message", encoding=encoding)


@given(st.binary(max_size=80))
def test_arbitrary_bytes_are_no_signature(data):
    for encoding in ("der", "raw"):
        with pytest.raises(InvalidSignature):
            KEY.public_key.verify(data, b"message", encoding=encoding)


def test_the_same_numbers_in_another_guise_are_refused():
    r, s = signature.decode_signature(KEY.sign(b"message"), SM2P256V1, "der")
    for bad in ((r + N, s), (r, s + N), (r - N, s), (r, s - N), (s, r), (N - r, s), (r, N - s), (0, s), (r, 0), (r, N)):
        encoded = der.sequence(der.integer(bad[0]), der.integer(bad[1]))
        with pytest.raises(InvalidSignature):
            KEY.public_key.verify(encoded, b"message")
    raw = KEY.sign(b"message", encoding="raw")
    for bad in (raw + b"\0", b"\0" + raw, raw[:-1], raw[1:], b"", raw * 2):
        with pytest.raises(InvalidSignature):
            KEY.public_key.verify(bad, b"message", encoding="raw")
    with pytest.raises(InvalidSignature):
        KEY.public_key.verify(raw, b"message")
    with pytest.raises(InvalidSignature):
        KEY.public_key.verify(KEY.sign(b"message"), b"message", encoding="raw")


def test_identifiers_have_at_most_8191_bytes():
    assert sm2.DEFAULT_UID == DEFAULT_UID == b"1234567812345678"
    for uid in (b"", bytes(8191)):
        KEY.public_key.verify(KEY.sign(b"", uid=uid), b"", uid=uid)
    signed = KEY.sign(b"")
    with pytest.raises(InvalidLength, match="8191"):
        KEY.sign(b"", uid=bytes(8192))
    with pytest.raises(InvalidLength, match="8191"):
        KEY.public_key.verify(signed, b"", uid=bytes(8192))


def test_a_digest_has_32_bytes():
    for length in (0, 31, 33):
        with pytest.raises(InvalidLength):
            KEY.sign_digest(bytes(length))
        with pytest.raises(InvalidLength):
            KEY.public_key.verify_digest(KEY.sign_digest(bytes(32)), bytes(length))


@pytest.mark.parametrize("encoding", ["hex", "DER", "", None, 1, b"der"])
def test_there_are_two_encodings(encoding):
    signed = KEY.sign(b"")
    for call in (
        lambda: KEY.sign(b"", encoding=encoding),
        lambda: KEY.sign_digest(bytes(32), encoding=encoding),
        lambda: KEY.public_key.verify(signed, b"", encoding=encoding),
        lambda: KEY.public_key.verify_digest(signed, bytes(32), encoding=encoding),
    ):
        with pytest.raises(InvalidOption):
            call()


@pytest.mark.parametrize("wrong", ["text", 1, None, 2.5, [1]])
def test_only_bytes_are_bytes(wrong):
    signed = KEY.sign(b"")
    for call in (
        lambda: KEY.sign(wrong),
        lambda: KEY.sign(b"", uid=wrong),
        lambda: KEY.sign_digest(wrong),
        lambda: KEY.public_key.verify(wrong, b""),
        lambda: KEY.public_key.verify(signed, wrong),
        lambda: KEY.public_key.verify(signed, b"", uid=wrong),
        lambda: KEY.public_key.verify_digest(signed, wrong),
        lambda: KEY.public_key.verify_digest(wrong, bytes(32)),
    ):
        with pytest.raises(TypeError):
            call()


def test_any_bytes_like_object_is_taken():
    signed = KEY.sign(bytearray(b"message"), uid=memoryview(b"uid"))
    KEY.public_key.verify(bytearray(signed), memoryview(b"message"), uid=bytearray(b"uid"))


def test_two_signatures_of_one_message_differ():
    assert len({KEY.sign(b"message") for _ in range(10)}) == 10


def test_a_key_on_the_sample_curve_signs():
    key = sm2.PrivateKey(5, SAMPLE)
    key.public_key.verify(key.sign(b"message"), b"message")
    with pytest.raises(InvalidSignature):
        sm2.PrivateKey.from_int(5).public_key.verify(key.sign(b"message"), b"message")
