"""SM4 modes: vectors of the standards and of others, OpenSSL beside them, streaming, padding, errors."""

from __future__ import annotations

import dataclasses
import random
import tracemalloc
from collections.abc import Callable
from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st

import smcrypto
from smcrypto import sm4
from smcrypto.sm4.engine import BULK_BLOCKS
from smcrypto.sm4.tables import WIDE_BLOCKS
from vectors_json import load

KEY = bytes.fromhex("0123456789abcdeffedcba9876543210")
IV = bytes(range(16))
RANDOM = random.Random(17964)
pytestmark = pytest.mark.usefixtures("sm4_engine")

MODES: dict[str, Callable[[bytes], sm4.Mode]] = {
    "ECB": lambda iv: sm4.ECB(),
    "CBC": sm4.CBC,
    "CFB": sm4.CFB,
    "OFB": sm4.OFB,
    "CTR": sm4.CTR,
}
ALL = [make(IV) for make in MODES.values()] + [sm4.XTS(IV), sm4.XTS(IV, variant="ieee")]
WITH_IV = [sm4.CBC, sm4.CFB, sm4.OFB, sm4.CTR, sm4.XTS]


def name(mode: object) -> str:
    if isinstance(mode, type):
        return mode.__name__
    return type(mode).__name__ + getattr(mode, "variant", "")


def key_for(mode: sm4.Mode) -> bytes:
    return KEY + KEY[::-1] if isinstance(mode, sm4.XTS) else KEY


@pytest.mark.parametrize("v", load("standards/sm4_modes.json") + load("third_party/sm4_modes.json"))
def test_vectors_in_both_directions(v: SimpleNamespace) -> None:
    mode = MODES[v.mode](v.iv)
    padding = None if v.padding == "none" else v.padding
    assert sm4.encrypt(v.key, mode, v.plaintext, padding=padding) == v.ciphertext
    assert sm4.decrypt(v.key, mode, v.ciphertext, padding=padding) == v.plaintext


@pytest.mark.parametrize("v", load("third_party/sm4_modes.json", section="cbc_pkcs7"))
def test_third_party_padding(v: SimpleNamespace) -> None:
    mode = sm4.CBC(v.iv)
    if v.result == "valid":
        assert sm4.encrypt(v.key, mode, v.plaintext, padding="pkcs7") == v.ciphertext
        assert sm4.decrypt(v.key, mode, v.ciphertext, padding="pkcs7") == v.plaintext
    else:
        with pytest.raises(smcrypto.InvalidPadding):
            sm4.decrypt(v.key, mode, v.ciphertext, padding="pkcs7")


@pytest.mark.parametrize("mode", list(MODES))
@pytest.mark.parametrize("blocks", [0, 1, 3, 4, 5, 64, 700, WIDE_BLOCKS, BULK_BLOCKS - 1, BULK_BLOCKS, 3000, 70_000])
def test_openssl_agrees(mode: str, blocks: int) -> None:
    ciphers = pytest.importorskip("cryptography.hazmat.primitives.ciphers")
    decrepit = pytest.importorskip("cryptography.hazmat.decrepit.ciphers.modes")
    data = RANDOM.randbytes(16 * blocks + (0 if mode in ("ECB", "CBC") else 5))
    theirs = getattr(decrepit if mode in ("CFB", "OFB") else ciphers.modes, mode)(*([] if mode == "ECB" else [IV]))
    encryptor = ciphers.Cipher(ciphers.algorithms.SM4(KEY), theirs).encryptor()
    expected = encryptor.update(data) + encryptor.finalize()
    ours = MODES[mode](IV)
    assert sm4.encrypt(KEY, ours, data) == expected
    assert sm4.decrypt(KEY, ours, expected) == data


@st.composite
def cut_data(draw: st.DrawFn) -> list[bytes]:
    """Up to some kilobytes in pieces of any length, empty ones among them, and 5 blocks at least."""
    pieces = draw(st.lists(st.one_of(st.integers(0, 40), st.integers(0, 1200)), max_size=12))
    seed = draw(st.integers(0, 2**32))
    return [random.Random(seed + i).randbytes(n) for i, n in enumerate([*pieces, 80 + -sum(pieces) % 16])]


@pytest.mark.parametrize("mode", ALL, ids=name)
@given(pieces=cut_data(), odd=st.integers(0, 15))
def test_any_chunking_equals_one_call(mode: sm4.Mode, pieces: list[bytes], odd: int) -> None:
    if not isinstance(mode, sm4.ECB | sm4.CBC):
        pieces = [*pieces, bytes(odd)]
    data, key = b"".join(pieces), key_for(mode)
    whole = sm4.encrypt(key, mode, data)
    assert len(whole) == len(data)
    encryptor, decryptor = sm4.Cipher(key, mode).encryptor(), sm4.Cipher(key, mode).decryptor()
    sealed = [encryptor.update(piece) for piece in pieces]
    assert b"".join(sealed) + encryptor.finalize() == whole
    opened = [decryptor.update(whole[start : start + 37]) for start in range(0, len(whole), 37)]
    assert b"".join(opened) + decryptor.finalize() == data == sm4.decrypt(key, mode, whole)


@pytest.mark.parametrize("mode", [sm4.ECB(), sm4.CBC(IV)], ids=name)
@given(data=st.binary(max_size=100), cut=st.integers(0, 100))
def test_padding_streams_like_one_call(mode: sm4.Mode, data: bytes, cut: int) -> None:
    cipher = sm4.Cipher(KEY, mode, padding="pkcs7")
    whole = sm4.encrypt(KEY, mode, data, padding="pkcs7")
    assert len(whole) == len(data) // 16 * 16 + 16
    encryptor = cipher.encryptor()
    assert encryptor.update(data[:cut]) + encryptor.update(data[cut:]) + encryptor.finalize() == whole
    decryptor = cipher.decryptor()
    assert decryptor.update(whole[:cut]) + decryptor.update(whole[cut:]) + decryptor.finalize() == data


@pytest.mark.parametrize("mode", [sm4.CTR(IV), sm4.OFB(IV), sm4.CFB(IV)], ids=name)
def test_stream_modes_hold_nothing_back(mode: sm4.Mode) -> None:
    stream = sm4.Cipher(KEY, mode).encryptor()
    assert [len(stream.update(bytes(n))) for n in (1, 0, 3, 20, 16, 5)] == [1, 0, 3, 20, 16, 5]
    assert stream.finalize() == b""


def test_a_stream_of_several_megabytes_in_unequal_pieces() -> None:
    data = RANDOM.randbytes(1_200_007)
    whole = sm4.encrypt(KEY, sm4.CTR(IV), data)
    stream, out, position = sm4.Cipher(KEY, sm4.CTR(IV)).encryptor(), b"", 0
    for size in (3, 50_000, 17, 300_001, 1 << 20):
        out += stream.update(data[position : position + size])
        position += size
    assert out + stream.finalize() == whole


@pytest.mark.parametrize("start", [2**128 - 1, 2**128 - 3, 2**64 - 1, 2**32 - 2])
def test_ctr_wraps_as_a_128_bit_number_also_between_updates(start: int) -> None:
    nonce = start.to_bytes(16, "big")
    block = sm4.SM4(KEY).encrypt_block
    stream = b"".join(block(((start + i) % 2**128).to_bytes(16, "big")) for i in range(6))
    assert sm4.encrypt(KEY, sm4.CTR(nonce), bytes(96)) == stream
    cipher = sm4.Cipher(KEY, sm4.CTR(nonce)).encryptor()
    assert b"".join(cipher.update(bytes(n)) for n in (20, 1, 40, 35)) == stream


@pytest.mark.parametrize("mode", ALL, ids=name)
def test_any_bytes_like_object_is_taken(mode: sm4.Mode) -> None:
    data, key = bytes(range(64)), key_for(mode)
    expected = sm4.encrypt(key, mode, data)
    for kind in (bytearray, memoryview, lambda b: memoryview(b"xyz" + b)[3:], lambda b: memoryview(b).cast("H")):
        assert sm4.encrypt(kind(key), mode, kind(data)) == expected
        assert sm4.decrypt(kind(key), mode, kind(expected)) == data
        stream = sm4.Cipher(kind(key), mode).encryptor()
        assert stream.update(kind(data)) + stream.finalize() == expected


def test_a_buffer_changed_after_update_changes_nothing() -> None:
    buffer = bytearray(b"incomplete")
    stream = sm4.Cipher(KEY, sm4.CBC(IV)).encryptor()
    stream.update(buffer)
    buffer[:] = bytes(len(buffer))
    assert stream.update(b" block") == sm4.encrypt(KEY, sm4.CBC(IV), b"incomplete block")


def test_modes_are_immutable_values() -> None:
    iv = bytearray(IV)
    mode = sm4.CBC(iv)
    iv[0] ^= 1
    assert mode == sm4.CBC(IV) and hash(mode) == hash(sm4.CBC(IV)) and mode != sm4.OFB(IV)
    with pytest.raises(dataclasses.FrozenInstanceError):
        mode.iv = IV  # type: ignore[misc]
    cipher = sm4.Cipher(KEY, mode)
    assert cipher.encryptor().update(IV) == cipher.encryptor().update(IV)


@pytest.mark.parametrize("make", WITH_IV, ids=name)
@pytest.mark.parametrize("length", [0, 12, 15, 17, 32])
def test_wrong_iv_lengths(make: Callable[[bytes], sm4.Mode], length: int) -> None:
    with pytest.raises(smcrypto.InvalidLength):
        make(bytes(length))


@pytest.mark.parametrize("make", WITH_IV, ids=name)
@pytest.mark.parametrize("value", ["0" * 16, 16, None])
def test_wrong_iv_types(make: Callable[[object], sm4.Mode], value: object) -> None:
    with pytest.raises(TypeError):
        make(value)


@pytest.mark.parametrize("mode", ALL, ids=name)
def test_wrong_keys(mode: sm4.Mode) -> None:
    right = len(key_for(mode))
    for length in {0, 8, 15, 16, 17, 24, 31, 32, 33, 64} - {right}:
        for call in (sm4.encrypt, sm4.decrypt):
            with pytest.raises(smcrypto.InvalidKey):
                call(bytes(length), mode, bytes(32))
        with pytest.raises(smcrypto.InvalidKey):
            sm4.Cipher(bytes(length), mode)
    with pytest.raises(TypeError):
        sm4.Cipher("0" * right, mode)  # type: ignore[arg-type]


@pytest.mark.parametrize("mode", ALL, ids=name)
def test_wrong_data_types(mode: sm4.Mode) -> None:
    for value in ("text", 5, None, [1]):
        for call in (sm4.encrypt, sm4.decrypt):
            with pytest.raises(TypeError, match="data"):
                call(key_for(mode), mode, value)  # type: ignore[arg-type]
        with pytest.raises(TypeError, match="data"):
            sm4.Cipher(key_for(mode), mode).encryptor().update(value)  # type: ignore[arg-type]


@pytest.mark.parametrize("mode", ["CTR", None, sm4.CTR, b""])
def test_what_is_not_a_mode(mode: object) -> None:
    with pytest.raises(TypeError, match="mode"):
        sm4.encrypt(KEY, mode, b"")  # type: ignore[arg-type]


@pytest.mark.parametrize("length", [1, 15, 17, 31, 100])
@pytest.mark.parametrize("mode", [sm4.ECB(), sm4.CBC(IV)], ids=name)
def test_incomplete_blocks_without_padding(mode: sm4.Mode, length: int) -> None:
    for call in (sm4.encrypt, sm4.decrypt):
        with pytest.raises(smcrypto.InvalidLength):
            call(KEY, mode, bytes(length))
    stream = sm4.Cipher(KEY, mode).decryptor()
    stream.update(bytes(length))
    with pytest.raises(smcrypto.InvalidLength):
        stream.finalize()


@pytest.mark.parametrize("mode", ALL, ids=name)
def test_a_finalized_stream_takes_nothing_more(mode: sm4.Mode) -> None:
    for stream in (sm4.Cipher(key_for(mode), mode).encryptor(), sm4.Cipher(key_for(mode), mode).decryptor()):
        stream.update(bytes(32))
        stream.finalize()
        with pytest.raises(smcrypto.AlreadyFinalized):
            stream.update(b"")
        with pytest.raises(smcrypto.AlreadyFinalized):
            stream.finalize()


def test_a_stream_that_failed_to_finalize_is_finalized() -> None:
    stream = sm4.Cipher(KEY, sm4.ECB()).encryptor()
    stream.update(b"odd")
    with pytest.raises(smcrypto.InvalidLength):
        stream.finalize()
    with pytest.raises(smcrypto.AlreadyFinalized):
        stream.update(bytes(13))


@pytest.mark.parametrize("mode", [m for m in ALL if not isinstance(m, sm4.ECB | sm4.CBC)], ids=name)
def test_padding_is_for_block_modes_only(mode: sm4.Mode) -> None:
    for call in (sm4.encrypt, sm4.decrypt):
        with pytest.raises(smcrypto.InvalidOption):
            call(key_for(mode), mode, bytes(32), padding="pkcs7")


@pytest.mark.parametrize("padding", ["zero", "PKCS7", "", True, 7, b"pkcs7"])
def test_unknown_padding(padding: object) -> None:
    with pytest.raises(smcrypto.InvalidOption):
        sm4.encrypt(KEY, sm4.ECB(), b"", padding=padding)  # type: ignore[arg-type]


def test_every_last_block_either_is_padding_or_is_refused() -> None:
    """All 256 last bytes, each right and with every byte of the padding altered in turn."""
    for count in range(256):
        padding = bytes([count]) * min(count, 16)
        plain = bytes(16 - len(padding)) + padding if padding else bytes(16)
        block = sm4.encrypt(KEY, sm4.ECB(), plain)
        if 1 <= count <= 16:
            assert sm4.decrypt(KEY, sm4.ECB(), block, padding="pkcs7") == bytes(16 - count)
            for position in range(16 - count, 15):
                broken = plain[:position] + bytes([count ^ 0x80]) + plain[position + 1 :]
                with pytest.raises(smcrypto.InvalidPadding):
                    sm4.decrypt(KEY, sm4.ECB(), sm4.encrypt(KEY, sm4.ECB(), broken), padding="pkcs7")
        else:
            with pytest.raises(smcrypto.InvalidPadding):
                sm4.decrypt(KEY, sm4.ECB(), block, padding="pkcs7")


@pytest.mark.parametrize("length", [0, 1, 15, 17, 33])
def test_padded_ciphertext_of_an_impossible_length(length: int) -> None:
    with pytest.raises(smcrypto.InvalidPadding):
        sm4.decrypt(KEY, sm4.CBC(IV), bytes(length), padding="pkcs7")


def test_all_padding_failures_read_the_same() -> None:
    messages = set()
    for ciphertext in (b"", bytes(15), bytes(16), bytes(32)):
        with pytest.raises(smcrypto.InvalidPadding) as failure:
            sm4.decrypt(KEY, sm4.CBC(IV), ciphertext, padding="pkcs7")
        messages.add(str(failure.value))
    assert len(messages) == 1


@pytest.mark.parametrize("mode", [mode for mode in ALL if not isinstance(mode, sm4.OFB)], ids=name)
def test_memory_stays_within_a_small_multiple_of_the_input(mode: sm4.Mode) -> None:
    """And what is worked on in several pieces is the same as what comes in several.

    Not OFB: it makes numbers of every block, and to trace each of them takes minutes.
    """
    key = random.Random(7).randbytes(32 if isinstance(mode, sm4.XTS) else 16)
    data = random.Random(8).randbytes((5 << 19) + 16)
    sealed = sm4.encrypt(key, mode, data)  # tables and planes are made by now
    stream = sm4.Cipher(key, mode).encryptor()
    assert b"".join(stream.update(data[i : i + 100_000]) for i in range(0, len(data), 100_000)) + stream.finalize() == (
        sealed
    )
    tracemalloc.start()
    try:
        opened = sm4.decrypt(key, mode, sealed)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert opened == data
    assert peak < 4.5 * len(data) + (6 << 20), peak / len(data)
