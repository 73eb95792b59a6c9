"""Encryption, GB/T 32918.4: vectors, malformed ciphertexts, the key stream that is all zero."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

import sm2_reference as reference
from sm2_reference import CURVES, SAMPLE, TINY_17, TINY_61, TINY_1009, number
from smcrypto import InvalidCiphertext, InvalidOption, der, sm2, sm3
from smcrypto.kdf import sm2_kdf
from smcrypto.sm2 import SM2P256V1, encryption
from smcrypto.sm2.curve import encode_point
from vectors_json import load

pytestmark = pytest.mark.usefixtures("sm2_engine")

KEY = sm2.PrivateKey.from_int(0x3945208F_7B2144B1_3F36E38A_C6D39F95_88939369_2860B51A_42FB81EF_4DF7C5B8)
ENCODINGS = ("der", "c1c3c2", "c1c2c3")


@pytest.mark.parametrize("v", [*load("standards/sm2_encrypt.json"), *load("third_party/sm2_encrypt.json")])
def test_vectors_are_encrypted_with_their_nonce_and_decrypted(v):
    curve = CURVES[v.curve]
    key = sm2.PrivateKey(number(v.private_key), curve)
    assert key.public_key.to_bytes() == v.public_key
    C1, C3, C2 = encryption.decode_ciphertext(v.der, curve, "der")
    assert (encode_point(C1, curve), C3, C2) == (v.c1, v.c3, v.c2)
    if v.k is not None:
        assert encryption.encrypt(curve, key.public_key.point, v.msg, iter([number(v.k)])) == (C1, C3, C2)
    for encoding in ENCODINGS:
        assert encryption.encode_ciphertext(C1, C3, C2, curve, encoding) == getattr(v, encoding)
        assert key.decrypt(getattr(v, encoding), encoding=encoding) == v.msg


@pytest.mark.parametrize(
    "v", [*load("standards/sm2_encrypt.json", "invalid"), *load("third_party/sm2_encrypt.json", "invalid")]
)
def test_invalid_ciphertexts(v):
    # "acceptable" are C1 without its 04 and compressed C1, which we refuse.
    key = sm2.PrivateKey.from_bytes(v.private_key)
    if v.result == "valid":
        assert key.decrypt(v.ciphertext, encoding=v.format) == v.plaintext
    else:
        with pytest.raises(InvalidCiphertext):
            key.decrypt(v.ciphertext, encoding=v.format)


@pytest.mark.parametrize("encoding", ENCODINGS)
@given(d=st.integers(1, SM2P256V1.n - 2), message=st.binary(max_size=300))
def test_what_is_encrypted_for_a_key_it_decrypts(encoding, d, message):
    key = sm2.PrivateKey.from_int(d)
    assert key.decrypt(key.public_key.encrypt(message, encoding=encoding), encoding=encoding) == message


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_every_changed_bit_and_every_cut_is_refused(encoding):
    ciphertext = KEY.public_key.encrypt(b"secret", encoding=encoding)
    for bit in range(8 * len(ciphertext)):
        changed = bytearray(ciphertext)
        changed[bit // 8] ^= 1 << bit % 8
        with pytest.raises(InvalidCiphertext):
            KEY.decrypt(changed, encoding=encoding)
    for length in range(len(ciphertext)):
        with pytest.raises(InvalidCiphertext):
            KEY.decrypt(ciphertext[:length], encoding=encoding)
    for longer in (ciphertext + b"\0", b"\0" + ciphertext, ciphertext * 2):
        with pytest.raises(InvalidCiphertext):
            KEY.decrypt(longer, encoding=encoding)


@given(st.binary(max_size=300))
def test_arbitrary_bytes_are_no_ciphertext(data):
    for encoding in ENCODINGS:
        with pytest.raises(InvalidCiphertext):
            KEY.decrypt(data, encoding=encoding)


@pytest.mark.parametrize("encoding", ENCODINGS)
def test_the_empty_message(encoding):
    ciphertext = KEY.public_key.encrypt(b"", encoding=encoding)
    if encoding != "der":
        assert len(ciphertext) == 65 + 32
    assert KEY.decrypt(ciphertext, encoding=encoding) == b""
    changed = bytearray(ciphertext)
    changed[-3] ^= 1  # in C3, except in DER, where it is in C3 as well: 0400 ends the sequence
    with pytest.raises(InvalidCiphertext):
        KEY.decrypt(changed, encoding=encoding)


def test_another_key_or_another_order_is_refused():
    ciphertext = KEY.public_key.encrypt(bytes(32), encoding="c1c3c2")
    for key, encoding in ((sm2.PrivateKey.generate(), "c1c3c2"), (KEY, "c1c2c3"), (KEY, "der")):
        with pytest.raises(InvalidCiphertext):
            key.decrypt(ciphertext, encoding=encoding)


def test_der_has_no_second_form():
    C1, C3, C2 = encryption.decode_ciphertext(KEY.public_key.encrypt(b"secret"), SM2P256V1, "der")
    x, y, c3, c2 = der.integer(C1[0]), der.integer(C1[1]), der.octet_string(C3), der.octet_string(C2)
    assert KEY.decrypt(der.sequence(x, y, c3, c2)) == b"secret"
    p = SM2P256V1.p
    for bad in (
        der.sequence(x, y, c2, c3),
        der.sequence(x, y, c3),
        der.sequence(x, y, c3, c2, c2),
        der.sequence(x, y, der.octet_string(C3[:-1]), c2),
        der.sequence(x, y, der.octet_string(C3 + b"\0"), c2),
        der.sequence(der.integer(C1[0] + p), y, c3, c2),
        der.sequence(x, der.integer(C1[1] + p), c3, c2),
        der.sequence(x, der.integer(-C1[1]), c3, c2),
        der.sequence(x, der.integer(p - C1[1]), c3, c2),
        der.sequence(der.octet_string(C1[0].to_bytes(32, "big")), y, c3, c2),
        der.set_of(x, y, c3, c2),
        b"\x30\x80" + x + y + c3 + c2 + b"\0\0",
    ):
        with pytest.raises(InvalidCiphertext):
            KEY.decrypt(bad)


@pytest.mark.parametrize("length", [0, 31, 33])
def test_a_c3_of_another_length_is_no_ciphertext_at_all(length):
    x, y = (der.integer(v) for v in SM2P256V1.G)
    with pytest.raises(InvalidCiphertext):
        encryption.decode_ciphertext(
            der.sequence(x, y, der.octet_string(bytes(length)), der.octet_string(b"")), SM2P256V1, "der"
        )


def zero_stream_nonces(curve, P):
    """The nonces whose one-byte key stream is 00."""
    size = curve.field_bytes
    zero = []
    for k in range(1, curve.n):
        x, y = reference.multiple(k, P, curve)
        if sm2_kdf(x.to_bytes(size, "big") + y.to_bytes(size, "big"), 1) == b"\0":
            zero.append(k)
    return zero


def test_a_key_stream_of_zeros_is_drawn_again_and_refused():
    # One byte of key stream is 00 for one nonce in 256; SM2's curve is searched from k = 1 on.
    curve, P = SM2P256V1, KEY.public_key.point
    shared, bad = None, None
    for k in range(1, 5000):
        shared = reference.add(shared, P, curve)
        if sm2_kdf(shared[0].to_bytes(32, "big") + shared[1].to_bytes(32, "big"), 1) == b"\0":
            bad = k
            break
    assert bad is not None
    with pytest.raises(StopIteration):
        encryption.encrypt(curve, P, b"m", iter([bad]))
    C1, C3, C2 = encryption.encrypt(curve, P, b"m", iter([bad, bad, bad + 1]))
    assert reference.multiple(bad + 1, curve.G, curve) == C1
    assert encryption.decrypt(curve, KEY.to_int(), C1, C3, C2) == b"m"
    # The ciphertext an encryptor without that check would have made: C2 is the message in clear.
    x2, y2 = (v.to_bytes(32, "big") for v in shared)
    C1, C3 = reference.multiple(bad, curve.G, curve), sm3.digest(x2 + b"m" + y2)
    with pytest.raises(InvalidCiphertext):
        encryption.decrypt(curve, KEY.to_int(), C1, C3, b"m")
    # The same nonce serves the empty message, whose key stream is empty.
    C1, C3, C2 = encryption.encrypt(curve, P, b"", iter([bad]))
    assert encryption.decrypt(curve, KEY.to_int(), C1, C3, C2) == b""


@pytest.mark.parametrize(("curve", "step"), [(TINY_17, 1), (TINY_61, 1), (TINY_1009, 500)])
def test_every_nonce_of_a_tiny_curve(curve, step):
    passed_over = 0
    for d in range(1, curve.n - 1, step):
        P = reference.multiple(d, curve.G, curve)
        zero = zero_stream_nonces(curve, P)
        passed_over += len(zero)
        for k in range(1, curve.n):
            if k in zero:
                with pytest.raises(StopIteration):
                    encryption.encrypt(curve, P, b"m", iter([k]))
                continue
            C1, C3, C2 = encryption.encrypt(curve, P, b"m", iter([k]))
            assert reference.multiple(k, curve.G, curve) == C1
            for encoding in ENCODINGS:
                encoded = encryption.encode_ciphertext(C1, C3, C2, curve, encoding)
                assert encryption.decode_ciphertext(encoded, curve, encoding) == (C1, C3, C2)
            assert encryption.decrypt(curve, d, C1, C3, C2) == b"m"
    assert passed_over or curve is not TINY_1009


@pytest.mark.parametrize("encoding", ["hex", "raw", "C1C3C2", "", None, 1])
def test_there_are_three_encodings(encoding):
    ciphertext = KEY.public_key.encrypt(b"")
    with pytest.raises(InvalidOption):
        KEY.public_key.encrypt(b"", encoding=encoding)
    with pytest.raises(InvalidOption):
        KEY.decrypt(ciphertext, encoding=encoding)


@pytest.mark.parametrize("wrong", ["text", 1, None, 2.5, [1]])
def test_only_bytes_are_bytes(wrong):
    with pytest.raises(TypeError):
        KEY.public_key.encrypt(wrong)
    with pytest.raises(TypeError):
        KEY.decrypt(wrong)


def test_long_messages():
    message = bytes(range(256)) * 400
    for encoding in ENCODINGS:
        assert KEY.decrypt(KEY.public_key.encrypt(message, encoding=encoding), encoding=encoding) == message


def test_two_ciphertexts_of_one_message_differ():
    assert len({KEY.public_key.encrypt(b"message") for _ in range(10)}) == 10


def test_a_key_on_the_sample_curve_decrypts():
    key = sm2.PrivateKey(5, SAMPLE)
    assert key.decrypt(key.public_key.encrypt(b"message")) == b"message"
    with pytest.raises(InvalidCiphertext):
        KEY.decrypt(key.public_key.encrypt(b"message"))
