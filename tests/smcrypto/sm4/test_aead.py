"""SM4-GCM and SM4-CCM against RFC 8998, third-party vectors, OpenSSL, and the modes written out on single blocks."""

from __future__ import annotations

import random

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sm4_reference import ghash_by_definition
from smcrypto import InvalidKey, InvalidLength, InvalidTag
from smcrypto.sm4 import SM4, SM4CCM, SM4GCM, aead, foreign
from smcrypto.sm4.engine import Engine
from vectors_json import load

KEY = bytes.fromhex("0123456789abcdeffedcba9876543210")

pytestmark = pytest.mark.usefixtures("sm4_engine")
NONCE = b"twelve bytes"
TEXT = random.Random(6).randbytes(777)


def object_for(v):
    return SM4GCM(v.key, len(v.tag)) if v.mode == "GCM" else SM4CCM(v.key, len(v.tag))


def one_bit_flips(data: bytes):
    for i in range(8 * len(data)):
        flipped = bytearray(data)
        flipped[i // 8] ^= 0x80 >> i % 8
        yield bytes(flipped)


def gcm_written_out(key: bytes, nonce: bytes, data: bytes, A: bytes) -> bytes:
    """SP 800-38D, 7.1, one block at a time."""
    E = SM4(key).encrypt_block
    H = int.from_bytes(E(bytes(16)), "big")

    def pad(b: bytes) -> bytes:
        return b + bytes(-len(b) % 16)

    def GHASH(*parts: bytes) -> bytes:
        return ghash_by_definition(H, b"".join(parts)).to_bytes(16, "big")

    J_0 = nonce + b"\0\0\0\1" if len(nonce) == 12 else GHASH(pad(nonce), (8 * len(nonce)).to_bytes(16, "big"))
    C = b""
    for i in range(0, len(data), 16):
        counter = (int.from_bytes(J_0[12:], "big") + 1 + i // 16) % 2**32
        stream = E(J_0[:12] + counter.to_bytes(4, "big"))
        C += bytes(a ^ b for a, b in zip(data[i : i + 16], stream, strict=False))
    S = GHASH(pad(A), pad(C), (8 * len(A)).to_bytes(8, "big"), (8 * len(C)).to_bytes(8, "big"))
    return C + bytes(a ^ b for a, b in zip(S, E(J_0), strict=True))


# --- vectors ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize("v", load("standards/sm4_gcm_ccm.json"))
def test_the_standards_vectors_open_and_no_flipped_bit_does(v):
    cipher, sealed = object_for(v), v.ciphertext + v.tag
    assert cipher.encrypt(v.iv, v.plaintext, v.aad) == sealed
    assert cipher.decrypt(v.iv, sealed, v.aad) == v.plaintext
    for bad in one_bit_flips(sealed):
        with pytest.raises(InvalidTag):
            cipher.decrypt(v.iv, bad, v.aad)
    for bad in one_bit_flips(v.aad):
        with pytest.raises(InvalidTag):
            cipher.decrypt(v.iv, sealed, bad)
    for bad in one_bit_flips(v.iv):
        with pytest.raises(InvalidTag):
            cipher.decrypt(bad, sealed, v.aad)


@pytest.mark.parametrize("v", load("third_party/sm4_gcm_ccm.json", result="valid"))
def test_valid_third_party_vectors(v):
    cipher = object_for(v)
    assert cipher.encrypt(v.iv, v.plaintext, v.aad) == v.ciphertext + v.tag
    assert cipher.decrypt(v.iv, v.ciphertext + v.tag, v.aad) == v.plaintext


@pytest.mark.parametrize("v", load("third_party/sm4_gcm_ccm.json", result="invalid"))
def test_invalid_third_party_vectors(v):
    """A wrong tag is InvalidTag; a nonce or tag of a length the mode does not have is InvalidLength."""
    lengths_exist = len(v.iv) >= 1 if v.mode == "GCM" else 7 <= len(v.iv) <= 13
    allowed = range(12, 17) if v.mode == "GCM" else range(4, 17, 2)
    with pytest.raises(InvalidTag if lengths_exist and len(v.tag) in allowed else InvalidLength):
        object_for(v).decrypt(v.iv, v.ciphertext + v.tag, v.aad)


# --- the modes written out, and another implementation ------------------------------------------------------------


@given(
    st.binary(min_size=16, max_size=16), st.binary(min_size=1, max_size=40),
    st.binary(max_size=100), st.binary(max_size=50),
)
def test_gcm_is_the_mode_written_out(key, nonce, data, A):
    sealed = gcm_written_out(key, nonce, data, A)
    fresh = SM4GCM(key)
    assert [fresh.encrypt(nonce, data, A) for _ in range(2)] == [sealed] * 2
    assert SM4GCM(key).decrypt(nonce, sealed, A) == data


@pytest.mark.parametrize(
    "length",
    [0, 1, 15, 16, 17, 31, 32, 33, 200, 255, 256, 257, 415, 416, 1000, 1199, 1200, 4095, 12300, 40000, 200_000],
)
def test_gcm_around_the_switch_over_of_its_engines_is_openssls(length):
    peer = pytest.importorskip("cryptography.hazmat.primitives.ciphers")
    source = random.Random(length)
    key, nonce, data, A = (source.randbytes(n) for n in (16, 12, length, length % 70))
    theirs = peer.Cipher(peer.algorithms.SM4(key), peer.modes.GCM(nonce)).encryptor()
    theirs.authenticate_additional_data(A)
    expected = theirs.update(data) + theirs.finalize() + theirs.tag
    ours = SM4GCM(key)
    for _ in range(4):
        assert ours.encrypt(nonce, data, A) == expected
        assert ours.decrypt(nonce, expected, A) == data


def nonce_that_starts_the_counter_at(key: bytes, counter: int) -> bytes:
    """A 16-byte nonce whose J_0 ends in `counter`: GHASH is solved for it (its inverse by Fermat)."""
    from sm4_reference import multiply_by_definition as times

    H = int.from_bytes(SM4(key).encrypt_block(bytes(16)), "big")
    inverse, power = 1 << 127, H  # H^(2^128 - 2) = H^2 · H^4 · ... · H^(2^127)
    for _ in range(127):
        power = times(power, power)
        inverse = times(inverse, power)
    J_0 = int.from_bytes(random.Random(7).randbytes(12) + counter.to_bytes(4, "big"), "big")
    return times(times(J_0, inverse) ^ 128, inverse).to_bytes(16, "big")


@pytest.mark.parametrize("counter", [0xFFFFFFFF, 0xFFFFFFFE, 0xFFFFFFF0, 0xFFFFFF00])
@pytest.mark.parametrize("length", [1, 16, 33, 300, 5000, 40000])
def test_the_counter_wraps_at_32_bits(counter, length):
    """inc32 leaves the upper 96 bits of J_0 alone (SP 800-38D, 6.2)."""
    peer = pytest.importorskip("cryptography.hazmat.primitives.ciphers")
    nonce, data = nonce_that_starts_the_counter_at(KEY, counter), random.Random(length).randbytes(length)
    theirs = peer.Cipher(peer.algorithms.SM4(KEY), peer.modes.GCM(nonce)).encryptor()
    expected = theirs.update(data) + theirs.finalize() + theirs.tag
    if length < 400:
        assert gcm_written_out(KEY, nonce, data, b"") == expected
    gcm = SM4GCM(KEY)
    assert gcm._J_0(nonce)[12:] == counter.to_bytes(4, "big")
    assert gcm.encrypt(nonce, data) == expected
    assert gcm.decrypt(nonce, expected) == data


@given(
    st.binary(min_size=7, max_size=13), st.sampled_from([4, 6, 8, 10, 12, 14, 16]),
    st.binary(max_size=80), st.binary(max_size=60),
)
def test_ccm_is_the_mode_written_out(nonce, t, data, A):
    """RFC 3610, 2.2 and 2.3: B_0, the CBC-MAC, and the key stream from A_1; the MAC is masked with S_0."""
    E, q = SM4(KEY).encrypt_block, 15 - len(nonce)
    B = bytes([64 * (A != b"") + 8 * (t - 2) // 2 + q - 1]) + nonce + len(data).to_bytes(q, "big")
    if A:
        B += len(A).to_bytes(2, "big") + A
        B += bytes(-len(B) % 16)
    B += data + bytes(-len(data) % 16)
    X = bytes(16)
    for i in range(0, len(B), 16):
        X = E(bytes(a ^ b for a, b in zip(X, B[i : i + 16], strict=True)))
    stream = b"".join(E(bytes([q - 1]) + nonce + i.to_bytes(q, "big")) for i in range(len(data) // 16 + 2))
    sealed = bytes(a ^ b for a, b in zip(data + X[:t], stream[16 : 16 + len(data)] + stream[:t], strict=True))
    assert SM4CCM(KEY, t).encrypt(nonce, data, A) == sealed
    assert SM4CCM(KEY, tag_length=t).decrypt(nonce, sealed, A) == data


def test_ccm_encodes_the_length_of_associated_data_in_three_ways():
    """SP 800-38C, A.2.2, with its examples' values."""
    assert aead._encoded_length(0x0001) == bytes.fromhex("0001")
    assert aead._encoded_length(0xFEFF) == bytes.fromhex("feff")
    assert aead._encoded_length(0xFF00) == bytes.fromhex("fffe0000ff00")
    assert aead._encoded_length(2**32 - 1) == bytes.fromhex("fffeffffffff")
    assert aead._encoded_length(2**32) == bytes.fromhex("ffff0000000100000000")


@pytest.mark.parametrize("length", [0xFEFF, 0xFF00])
def test_ccm_with_long_associated_data(length):
    A, ccm = bytes(length), SM4CCM(KEY)
    sealed = ccm.encrypt(NONCE, b"text", A)
    assert ccm.decrypt(NONCE, sealed, A) == b"text"
    with pytest.raises(InvalidTag):
        ccm.decrypt(NONCE, sealed, A + b"\0")


def test_shorter_tags_are_the_front_of_the_whole_tag():
    whole = SM4GCM(KEY).encrypt(NONCE, TEXT, b"A")
    for t in (12, 13, 14, 15):
        gcm = SM4GCM(KEY, tag_length=t)
        assert gcm.encrypt(NONCE, TEXT, b"A") == whole[: len(TEXT) + t]
        assert gcm.decrypt(NONCE, whole[: len(TEXT) + t], b"A") == TEXT


# --- what is refused -----------------------------------------------------------------------------------------------

BOTH = pytest.mark.parametrize("cipher", [SM4GCM(KEY), SM4CCM(KEY), SM4CCM(KEY, 4)], ids=repr)


@BOTH
def test_every_truncation_is_refused(cipher):
    sealed = cipher.encrypt(NONCE, TEXT[:40], b"A")
    for length in range(len(sealed)):
        with pytest.raises(InvalidTag):
            cipher.decrypt(NONCE, sealed[:length], b"A")
    with pytest.raises(InvalidTag):
        cipher.decrypt(NONCE, sealed + b"\0", b"A")


@BOTH
def test_data_does_not_pass_for_associated_data(cipher):
    """The two lengths are covered: moving the boundary, or padding, changes the tag."""
    sealed = cipher.encrypt(NONCE, b"", b"A" * 15)
    for A in (b"", b"A" * 14, b"A" * 15 + b"\0", b"A" * 16):
        with pytest.raises(InvalidTag):
            cipher.decrypt(NONCE, sealed, A)


@BOTH
def test_another_key_or_nonce_is_refused(cipher):
    sealed = cipher.encrypt(NONCE, TEXT, b"A")
    with pytest.raises(InvalidTag):
        cipher.decrypt(b"twelve byteS", sealed, b"A")
    other = type(cipher)(KEY[::-1], tag_length=len(sealed) - len(TEXT))
    with pytest.raises(InvalidTag):
        other.decrypt(NONCE, sealed, b"A")


@BOTH
def test_the_refusal_tells_nothing(cipher):
    sealed = cipher.encrypt(NONCE, TEXT)
    messages = set()
    for bad in (b"", sealed[:-1], bytes(len(sealed)), sealed[:-1] + bytes([sealed[-1] ^ 1])):
        with pytest.raises(InvalidTag) as refusal:
            cipher.decrypt(NONCE, bad)
        messages.add(str(refusal.value))
    assert messages == {"the message is not authentic"}


@pytest.mark.parametrize("length", [300, 4096, 4097, 9000])
def test_gcm_decrypts_nothing_before_the_tag_is_right(length, monkeypatch):
    """In Python the cipher is not shown the ciphertext, so no plaintext can exist."""
    monkeypatch.setattr(foreign.ENGINE, "name", "python")
    monkeypatch.setattr(foreign.ENGINE, "_loaded", None)
    gcm, text = SM4GCM(KEY), random.Random(length).randbytes(length)
    sealed = gcm.encrypt(NONCE, text)
    shown: list[bytes] = []
    for name in ("encrypt", "ctr_xor", "encrypt_and_ctr_xor"):
        original = getattr(Engine, name)

        def watched(self, *arguments, original=original):
            shown.extend(argument for argument in arguments if isinstance(argument, bytes))
            return original(self, *arguments)

        monkeypatch.setattr(Engine, name, watched)
    with pytest.raises(InvalidTag):
        gcm.decrypt(NONCE, sealed[:-1] + bytes([sealed[-1] ^ 1]))
    assert shown and sealed[:-16] not in shown
    assert gcm.decrypt(NONCE, sealed) == text


@pytest.mark.parametrize("length", [0, 15, 17, 32])
def test_keys_are_16_bytes(length):
    for kind in (SM4GCM, SM4CCM):
        with pytest.raises(InvalidKey):
            kind(bytes(length))


def test_gcm_nonces_are_a_byte_or_more():
    with pytest.raises(InvalidLength):
        SM4GCM(KEY).encrypt(b"", b"")
    with pytest.raises(InvalidLength):
        SM4GCM(KEY).decrypt(b"", bytes(16))
    sealed = SM4GCM(KEY).encrypt(b"n", b"text")
    assert SM4GCM(KEY).decrypt(b"n", sealed) == b"text"


@pytest.mark.parametrize("length", [0, 6, 14, 16])
def test_ccm_nonces_are_7_to_13_bytes(length):
    with pytest.raises(InvalidLength):
        SM4CCM(KEY).encrypt(bytes(length), b"")
    with pytest.raises(InvalidLength):
        SM4CCM(KEY).decrypt(bytes(length), bytes(16))


@pytest.mark.parametrize("length", [-1, 0, 2, 3, 5, 15, 17, 18])
def test_ccm_tag_lengths(length):
    with pytest.raises(InvalidLength):
        SM4CCM(KEY, length)


@pytest.mark.parametrize("length", [-1, 0, 4, 8, 11, 17])
def test_gcm_tag_lengths(length):
    with pytest.raises(InvalidLength):
        SM4GCM(KEY, length)


@pytest.mark.parametrize("bad", ["16", 16.0, None, True, b"\x10"])
def test_tag_lengths_are_integers(bad):
    for kind in (SM4GCM, SM4CCM):
        with pytest.raises(TypeError):
            kind(KEY, bad)


def test_ccm_refuses_messages_its_counter_cannot_number():
    """A nonce of 13 bytes leaves two for the length (SP 800-38C, A.1)."""
    ccm, nonce = SM4CCM(KEY), bytes(13)
    with pytest.raises(InvalidLength):
        ccm.encrypt(nonce, bytes(65536))
    with pytest.raises(InvalidTag):  # nobody can have sealed that
        ccm.decrypt(nonce, bytes(65536 + 16))
    longest = bytes(65535)
    assert ccm.decrypt(nonce, ccm.encrypt(nonce, longest)) == longest


@pytest.mark.parametrize(("nonce", "text", "A"), [(12, 2**36 - 31, 0), (12, 0, 2**61), (2**61, 0, 0)])
def test_gcm_refuses_lengths_beyond_the_standard(nonce, text, A):
    """SP 800-38D, 5.2.1.1; such data does not fit into memory, so the check is asked with lengths alone."""
    aead._check_gcm_lengths(12, 2**36 - 32, 2**61 - 1)
    with pytest.raises(InvalidLength):
        aead._check_gcm_lengths(nonce, text, A)


@pytest.mark.parametrize("bad", ["text", 12, None, [1]])
def test_anything_but_bytes_is_a_type_error(bad):
    for kind in (SM4GCM, SM4CCM):
        with pytest.raises(TypeError):
            kind(bad)
        cipher = kind(KEY)
        for call in (cipher.encrypt, cipher.decrypt):
            for arguments in ((bad, b"", b""), (NONCE, bad, b""), (NONCE, b"", bad)):
                with pytest.raises(TypeError):
                    call(*arguments)


@BOTH
def test_any_bytes_like_object(cipher):
    sealed = cipher.encrypt(NONCE, TEXT, b"A")
    assert cipher.encrypt(bytearray(NONCE), memoryview(TEXT), bytearray(b"A")) == sealed
    assert cipher.decrypt(memoryview(NONCE), bytearray(sealed), memoryview(b"A")) == TEXT
    assert cipher.encrypt(NONCE, memoryview(bytes(2 * len(TEXT)))[::2]) == cipher.encrypt(NONCE, bytes(len(TEXT)))


@BOTH
def test_nothing_shows_the_key(cipher):
    assert KEY.hex() not in repr(cipher) and repr(KEY) not in repr(cipher)
    assert not hasattr(cipher, "__dict__")


@BOTH
def test_empty_message_and_no_associated_data(cipher):
    sealed = cipher.encrypt(NONCE, b"")
    assert cipher.decrypt(NONCE, sealed) == b""
    assert cipher.decrypt(NONCE, sealed, b"") == b""
