"""GCM in pieces gives what SM4GCM gives at once, however it is cut, and releases nothing that was not verified."""

from __future__ import annotations

import copy
import random
from itertools import pairwise
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

import smcrypto
from smcrypto import InvalidKey, InvalidLength, InvalidOption, InvalidTag, sm4
from smcrypto.sm4 import aead, gcmstream
from vectors_json import load

pytestmark = pytest.mark.usefixtures("sm4_engine")

KEY, NONCE = bytes(range(16)), bytes(12)
RANDOM = random.Random(38)


def cut(data: bytes, points: list[int]) -> list[bytes]:
    edges = sorted({0, len(data), *(p % (len(data) + 1) for p in points)})
    return [data[a:b] for a, b in pairwise(edges)] or [b""]


@pytest.mark.parametrize("v", load("standards/sm4_gcm_ccm.json", mode="GCM"))
def test_vectors(v: SimpleNamespace) -> None:
    if len(v.tag) >= 12:
        mode = sm4.GCM(v.iv, v.aad, len(v.tag))
        assert sm4.encrypt(v.key, mode, v.plaintext) == v.ciphertext + v.tag
        assert sm4.decrypt(v.key, mode, v.ciphertext + v.tag) == v.plaintext


@given(st.binary(min_size=1, max_size=40), st.binary(max_size=40), st.integers(0, 400), st.integers(12, 16),
       st.lists(st.integers(0, 500), max_size=6))  # fmt: skip
def test_any_cut_equals_one_call(nonce: bytes, header: bytes, size: int, tag_length: int, points: list[int]) -> None:
    data = RANDOM.randbytes(size)
    sealed = sm4.SM4GCM(KEY, tag_length).encrypt(nonce, data, header)
    cipher = sm4.Cipher(KEY, sm4.GCM(nonce, header, tag_length))
    stream = cipher.encryptor()
    assert b"".join([stream.update(piece) for piece in cut(data, points)] + [stream.finalize()]) == sealed
    for early in (False, True):
        stream = cipher.decryptor(release_unverified=early)
        pieces = [stream.update(piece) for piece in cut(sealed, points)]
        assert early or not any(pieces), "nothing is released before the tag was verified"
        assert b"".join([*pieces, stream.finalize()]) == data


def test_long_messages_and_a_counter_that_wraps(monkeypatch: pytest.MonkeyPatch) -> None:
    data = RANDOM.randbytes(100_003)
    for nonce in (NONCE, b"n" * 100):
        cipher = sm4.Cipher(KEY, sm4.GCM(nonce))
        stream = cipher.encryptor()
        sealed = b"".join([stream.update(data[i : i + 999]) for i in range(0, len(data), 999)] + [stream.finalize()])
        assert sealed == sm4.SM4GCM(KEY).encrypt(nonce, data)
    J_0 = NONCE + b"\xff\xff\xff\xfe"
    expected = sm4.SM4(KEY).encrypt_block(NONCE + b"\xff" * 4) + b"".join(
        sm4.SM4(KEY).encrypt_block(NONCE + bytes([0, 0, 0, i])) for i in range(3))  # inc32, SP 800-38D, 6.2
    monkeypatch.setattr(sm4.SM4GCM, "_J_0", lambda self, nonce: J_0)
    state = gcmstream._Python(KEY, NONCE, b"")
    assert b"".join(state.open(bytes(n)) for n in (16, 20, 0, 28)) == expected


@pytest.mark.parametrize("early", [False, True])
def test_every_flipped_bit_is_noticed(early: bool) -> None:
    cipher = sm4.Cipher(KEY, sm4.GCM(NONCE, b"header"))
    sealed = sm4.encrypt(KEY, cipher.mode, b"message")
    for i in range(8 * len(sealed)):
        altered = bytearray(sealed)
        altered[i // 8] ^= 1 << i % 8
        stream = cipher.decryptor(release_unverified=early)
        stream.update(altered)
        with pytest.raises(InvalidTag):
            stream.finalize()
    for short in (sealed[:-1], sealed[:15], b""):
        with pytest.raises(InvalidTag):
            sm4.decrypt(KEY, cipher.mode, short)


def test_the_bound_of_a_message_holds_for_all_its_pieces(monkeypatch: pytest.MonkeyPatch) -> None:
    """2^39 - 256 bits: SP 800-38D, 5.2.1.1. The bound itself is still taken."""
    assert aead.GCM_TEXT == (2**39 - 256) // 8
    sealed = sm4.encrypt(KEY, sm4.GCM(NONCE), bytes(21))
    monkeypatch.setattr(aead, "GCM_TEXT", 20)
    whole = sm4.encrypt(KEY, sm4.GCM(NONCE), bytes(20))
    cipher = sm4.Cipher(KEY, sm4.GCM(NONCE))
    stream = cipher.encryptor()
    assert stream.update(bytes(13)) + stream.update(bytes(7)) == whole[:20]
    with pytest.raises(InvalidLength, match=r"2\^36 - 32 bytes.*21"):
        stream.update(b"x")
    for early in (False, True):
        stream = cipher.decryptor(release_unverified=early)
        assert stream.update(whole[:19]) + stream.update(whole[19:]) + stream.finalize() == bytes(20)
        stream = cipher.decryptor(release_unverified=early)
        with pytest.raises(InvalidLength):
            stream.update(sealed[:30]), stream.update(sealed[30:]), stream.finalize()


def test_a_nonce_object_serves_one_encryption_and_any_number_of_decryptions() -> None:
    mode = sm4.GCM(NONCE, b"header")
    sealed = sm4.encrypt(KEY, mode, b"message")
    cipher = sm4.Cipher(KEY, mode)
    for again in (cipher.encryptor, lambda: sm4.encrypt(KEY, mode, b"other"), copy.copy(cipher).encryptor,
                  sm4.Cipher(bytes(16), copy.copy(mode)).encryptor):  # fmt: skip
        with pytest.raises(smcrypto.OutOfOrder, match="another nonce"):
            again()
    for _ in range(3):
        assert sm4.decrypt(KEY, mode, sealed) == b"message"
    cipher = sm4.Cipher(KEY, sm4.GCM(NONCE))
    cipher.encryptor()
    with pytest.raises(smcrypto.OutOfOrder):
        cipher.encryptor()
    assert mode == sm4.GCM(NONCE, b"header") and hash(mode) == hash(sm4.GCM(NONCE, b"header"))
    assert repr(mode) == repr(sm4.GCM(NONCE, b"header"))
    mode = sm4.GCM(NONCE)
    copies = [copy.deepcopy(mode), copy.deepcopy({"mode": mode})["mode"], copy.copy(mode)]
    sm4.encrypt(KEY, mode, b"message")
    for one in copies:
        with pytest.raises(smcrypto.OutOfOrder):
            sm4.encrypt(KEY, one, b"other")


def test_what_does_not_fit() -> None:
    calls: list[tuple[Any, type[Exception]]] = [
        (lambda: sm4.GCM(b""), InvalidLength), (lambda: sm4.GCM(NONCE, tag_length=11), InvalidLength),
        (lambda: sm4.GCM(NONCE, b"", 17), InvalidLength), (lambda: sm4.GCM("n"), TypeError),
        (lambda: sm4.GCM(NONCE, "a"), TypeError), (lambda: sm4.GCM(NONCE, b"", None), TypeError),
        (lambda: sm4.Cipher(bytes(15), sm4.GCM(NONCE)), InvalidKey),
        (lambda: sm4.Cipher(KEY, sm4.GCM(NONCE), padding="pkcs7"), InvalidOption),
        (lambda: sm4.Cipher(KEY, sm4.CTR(bytes(16))).decryptor(release_unverified=True), InvalidOption),
    ]  # fmt: skip
    for call, error in calls:
        with pytest.raises(error):
            call()
    stream = sm4.Cipher(KEY, sm4.GCM(NONCE)).encryptor()
    stream.finalize()
    with pytest.raises(smcrypto.AlreadyFinalized):
        stream.update(b"")


# --- paddings ---


@pytest.mark.parametrize("mode", [sm4.ECB(), sm4.CBC(bytes(16))])
@pytest.mark.parametrize("padding, ending", [("iso7816", b"\x80"), ("zeros", b"")])
def test_paddings_are_what_they_say(padding: Any, ending: bytes, mode: sm4.Mode) -> None:
    for size in range(35):
        data = b"\x01" * size
        sealed = sm4.encrypt(KEY, mode, data, padding=padding)
        opened = sm4.decrypt(KEY, mode, sealed)
        assert opened == data + ending + bytes(-len(data + ending) % 16)
        assert sm4.decrypt(KEY, mode, sealed, padding=padding) == data


def test_malformed_padding() -> None:
    def decrypted(block: bytes, padding: Any) -> bytes:
        return sm4.decrypt(KEY, sm4.ECB(), sm4.encrypt(KEY, sm4.ECB(), block), padding=padding)

    for block in (bytes(16), b"\x80" + bytes(14) + b"\x01", b"\x01" * 16):
        with pytest.raises(smcrypto.InvalidPadding):
            decrypted(block, "iso7816")
    assert decrypted(b"\x80" * 16, "iso7816") == b"\x80" * 15 and decrypted(b"\x80" + bytes(15), "iso7816") == b""
    assert decrypted(b"ab" + bytes(14), "zeros") == b"ab" and decrypted(bytes(16), "zeros") == b""
    assert sm4.decrypt(KEY, sm4.ECB(), b"", padding="zeros") == b""
    for padding in ("iso7816", "zeros"):
        with pytest.raises(smcrypto.InvalidPadding):
            sm4.decrypt(KEY, sm4.ECB(), bytes(17), padding=padding)  # type: ignore[arg-type]
    with pytest.raises(smcrypto.InvalidPadding):
        sm4.decrypt(KEY, sm4.ECB(), b"", padding="iso7816")
