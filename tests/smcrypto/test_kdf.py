"""The key derivations with SM3, under both of SM3's engines."""

from __future__ import annotations

import hashlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from smcrypto import InvalidLength, InvalidOption, kdf, sm3
from vectors_json import load

PBKDF2 = load("third_party/kdf_sm3.json", "pbkdf2_hmac_sm3")
# 4,096 iterations take our own engine half a second for each 32 bytes.
SOME_PBKDF2 = PBKDF2[:1] + PBKDF2[4::11]


@pytest.mark.parametrize("v", PBKDF2 if sm3.ENGINE == "openssl" else SOME_PBKDF2)
def test_pbkdf2_vectors(v):
    assert kdf.pbkdf2_hmac(v.password, v.salt, v.iterations, v.dklen) == v.dk


@pytest.mark.parametrize("v", SOME_PBKDF2)
def test_pbkdf2_vectors_in_python(v):
    assert kdf._pbkdf2_python(v.password, v.salt, v.iterations, v.dklen) == v.dk


@pytest.mark.parametrize("v", load("third_party/kdf_sm3.json", "hkdf_sm3"))
def test_hkdf_vectors(v, sm3_engine):
    if v.result != "valid":
        with pytest.raises(InvalidLength):
            kdf.hkdf(v.ikm, v.size, salt=v.salt, info=v.info)
        return
    assert kdf.hkdf(v.ikm, v.size, salt=v.salt, info=v.info) == v.okm


def test_sm2_kdf_gives_the_key_stream_of_the_standards_encryption_example(sm3_engine):
    """GB/T 32918.4-2016, A.2 (Fp-256): x2, y2, klen = 152 bits and t = KDF(x2 || y2, klen)."""
    x2 = bytes.fromhex("64D20D27D0632957F8028C1E024F6B02EDF23102A566C932AE8BD613A8E865FE")
    y2 = bytes.fromhex("58D225ECA784AE300A81A2D48281A828E1CEDF11C4219099840265375077BF78")
    assert kdf.sm2_kdf(x2 + y2, 19) == bytes.fromhex("006E30DAE231B071DFAD8AA379E90264491603")


@given(st.binary(max_size=150), st.integers(0, 200))
def test_sm2_kdf_is_counter_hashing(z, length):
    """GB/T 32918.4-2016, 5.4.3: Ha_i = SM3(Z || ct) with a 32-bit ct from 1, the last one cut."""
    hashes = b"".join(sm3.digest(z + ct.to_bytes(4, "big")) for ct in range(1, 9))
    assert kdf.sm2_kdf(z, length) == hashes[:length]


@given(st.binary(max_size=150), st.binary(max_size=100), st.binary(max_size=100), st.integers(0, 150))
def test_hkdf_is_extract_then_expand(key, salt, info, length):
    """RFC 5869, 2.2 and 2.3, written out."""
    PRK = sm3.hmac(salt or bytes(32), key)
    T, OKM = b"", b""
    for i in range(1, 6):
        T = sm3.hmac(PRK, T + info + bytes([i]))
        OKM += T
    assert kdf.hkdf(key, length, salt=salt, info=info) == OKM[:length]


@given(st.binary(max_size=100), st.binary(max_size=50), st.integers(1, 6), st.integers(1, 100))
def test_pbkdf2_in_python_is_rfc_8018_written_out(password, salt, iterations, length):
    blocks = b""
    for i in range(1, 5):
        U = sm3.hmac(password, salt + i.to_bytes(4, "big"))
        T = int.from_bytes(U, "big")
        for _ in range(iterations - 1):
            U = sm3.hmac(password, U)
            T ^= int.from_bytes(U, "big")
        blocks += T.to_bytes(32, "big")
    assert kdf._pbkdf2_python(password, salt, iterations, length) == blocks[:length]
    assert kdf.pbkdf2_hmac(password, salt, iterations, length) == blocks[:length]


def test_the_whole_range_of_lengths(sm3_engine):
    assert kdf.sm2_kdf(b"z", 0) == b"" == kdf.hkdf(b"key", 0)
    longest = kdf.hkdf(b"key", 255 * 32)
    assert len(longest) == 255 * 32 and longest.startswith(kdf.hkdf(b"key", 33))
    assert kdf.pbkdf2_hmac(b"", b"", 1, 65).startswith(kdf.pbkdf2_hmac(b"", b"", 1, 1))


@pytest.mark.parametrize("length", [-1, 32 * (2**32 - 1), 2**64])
def test_sm2_kdf_refuses_lengths_its_counter_cannot_reach(length):
    with pytest.raises(InvalidLength):
        kdf.sm2_kdf(b"z", length)


@pytest.mark.parametrize("length", [-1, 255 * 32 + 1])
def test_hkdf_refuses_lengths_outside_the_rfc(length):
    with pytest.raises(InvalidLength):
        kdf.hkdf(b"key", length)


@pytest.mark.parametrize(("iterations", "length", "error"), [
    (0, 32, InvalidOption), (-1, 32, InvalidOption), (2**31, 32, InvalidOption),
    (1, 0, InvalidLength), (1, -1, InvalidLength), (1, 2**31, InvalidLength),
])
def test_pbkdf2_refuses_what_is_out_of_range(iterations, length, error, sm3_engine):
    with pytest.raises(error):
        kdf.pbkdf2_hmac(b"password", b"salt", iterations, length)


@pytest.mark.parametrize("bad", ["text", 1.5, None, True, b"1"])
def test_lengths_and_iterations_are_integers(bad):
    for call in (
        lambda: kdf.sm2_kdf(b"z", bad),
        lambda: kdf.hkdf(b"key", bad),
        lambda: kdf.pbkdf2_hmac(b"p", b"s", bad, 1),
        lambda: kdf.pbkdf2_hmac(b"p", b"s", 1, bad),
    ):
        with pytest.raises(TypeError):
            call()


@pytest.mark.parametrize("bad", ["text", 7, None])
def test_secrets_and_salts_are_bytes(bad):
    for call in (
        lambda: kdf.sm2_kdf(bad, 1),
        lambda: kdf.hkdf(bad, 1),
        lambda: kdf.hkdf(b"key", 1, salt=bad),
        lambda: kdf.hkdf(b"key", 1, info=bad),
        lambda: kdf.pbkdf2_hmac(bad, b"s", 1, 1),
        lambda: kdf.pbkdf2_hmac(b"p", bad, 1, 1),
    ):
        with pytest.raises(TypeError):
            call()


def test_bytes_like_objects_are_taken(sm3_engine):
    z, v = bytearray(b"z"), memoryview(b"z")
    assert kdf.sm2_kdf(z, 5) == kdf.sm2_kdf(b"z", 5)
    assert kdf.hkdf(z, 5, salt=v, info=v) == kdf.hkdf(b"z", 5, salt=b"z", info=b"z")
    assert kdf.pbkdf2_hmac(z, v, 2, 5) == kdf.pbkdf2_hmac(b"z", b"z", 2, 5)


def test_hashlib_agrees_with_python_pbkdf2():
    if "sm3" not in hashlib.algorithms_available:
        pytest.skip("this Python's hashlib offers no SM3")
    for password in (b"", b"p" * 64, b"p" * 65):
        assert kdf._pbkdf2_python(password, b"salt", 20, 100) == hashlib.pbkdf2_hmac("sm3", password, b"salt", 20, 100)
