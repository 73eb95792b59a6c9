"""SM4-XTS in both variants: vectors, the standards' definitions written out, stealing at every length."""

from __future__ import annotations

import random
from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st

import smcrypto
from sm4_reference import reference_crypt, reference_expand_key
from smcrypto import sm4
from smcrypto.sm4.engine import BULK_BLOCKS
from smcrypto.sm4.xts import tweak_sequence
from vectors_json import load

pytestmark = pytest.mark.usefixtures("sm4_engine")

KEY = bytes(range(32))
TWEAK = bytes.fromhex("f0e1d2c3b4a5968778695a4b3c2d1e0f")
VARIANTS = ["gb", "ieee"]


def doubled(T: bytes, variant: str) -> bytes:
    """IEEE 1619-2018, 5.2: little-endian, left, 0x87. GB/T 17964-2021: big-endian, right, 0xE1 on top."""
    if variant == "ieee":
        number = int.from_bytes(T, "little") << 1
        return (number ^ 0x87 if number >> 128 else number).to_bytes(17, "little")[:16]
    number = int.from_bytes(T, "big")
    return (number >> 1 ^ (0xE1 << 120 if number & 1 else 0)).to_bytes(16, "big")


def xor(a: bytes, b: bytes) -> bytes:
    return bytes(x ^ y for x, y in zip(a, b, strict=True))


def defined_encrypt(key: bytes, tweak: bytes, data: bytes, variant: str) -> bytes:
    """IEEE 1619-2018, 5.3.2, with the doubling of either standard."""
    K1, K2 = reference_expand_key(key[:16]), reference_expand_key(key[16:])
    T, out = reference_crypt(K2, tweak), []
    blocks = [data[i : i + 16] for i in range(0, len(data), 16)]
    for block in blocks:
        if len(block) < 16:
            stolen = out.pop()
            block, rest = block + stolen[len(block) :], stolen[: len(block)]
        else:
            rest = b""
        out.append(xor(reference_crypt(K1, xor(block, T)), T))
        out.append(rest) if rest else None
        T = doubled(T, variant)
    return b"".join(out)


@pytest.mark.parametrize("v", load("standards/sm4_xts.json") + load("third_party/sm4_xts.json"))
def test_vectors(v: SimpleNamespace) -> None:
    for variant in {"GB": ["gb"], "IEEE": ["ieee"], "both": VARIANTS}[v.standard]:
        mode = sm4.XTS(v.tweak, variant=variant)
        assert sm4.decrypt(v.key, mode, v.ciphertext) == v.plaintext
        assert sm4.encrypt(v.key, mode, v.plaintext) == v.ciphertext


@pytest.mark.parametrize("variant", VARIANTS)
def test_every_length_of_stealing_follows_the_definition(variant: str) -> None:
    mode = sm4.XTS(TWEAK, variant=variant)
    for length in [*range(16, 100), 1024, 1031, 1100, 16 * 130 + 9]:
        data = random.Random(length).randbytes(length)
        sealed = sm4.encrypt(KEY, mode, data)
        assert sealed == defined_encrypt(KEY, TWEAK, data, variant)
        assert sm4.decrypt(KEY, mode, sealed) == data


@pytest.mark.parametrize("variant", VARIANTS)
def test_a_data_unit_in_bit_slices(variant: str) -> None:
    data = random.Random(1619).randbytes(16 * BULK_BLOCKS + 16 + 3)
    mode = sm4.XTS(TWEAK, variant=variant)
    sealed = sm4.encrypt(KEY, mode, data)
    assert sealed == defined_encrypt(KEY, TWEAK, data, variant)
    assert sm4.decrypt(KEY, mode, sealed) == data


@pytest.mark.parametrize("variant", VARIANTS)
@given(first=st.binary(min_size=16, max_size=16), n=st.integers(1, 300))
def test_tweaks_are_doublings(variant: str, first: bytes, n: int) -> None:
    tweaks = tweak_sequence(first, n, variant)
    assert (tweaks[:16], len(tweaks)) == (first, 16 * n)
    for i in range(0, 16 * (n - 1), 16):
        assert tweaks[i + 16 : i + 32] == doubled(tweaks[i : i + 16], variant)


def test_variants_agree_on_the_first_block_alone() -> None:
    gb, ieee = (sm4.encrypt(KEY, sm4.XTS(TWEAK, variant=variant), bytes(32)) for variant in VARIANTS)
    assert gb[:16] == ieee[:16]
    assert gb[16:] != ieee[16:]


def test_gb_is_the_default() -> None:
    assert sm4.XTS(TWEAK) == sm4.XTS(TWEAK, variant="gb")


@pytest.mark.parametrize("length", [0, 1, 15])
def test_less_than_a_block_is_refused(length: int) -> None:
    for call in (sm4.encrypt, sm4.decrypt):
        with pytest.raises(smcrypto.InvalidLength):
            call(KEY, sm4.XTS(TWEAK), bytes(length))


@pytest.mark.parametrize("variant", ["GB", "", None, 1619])
def test_unknown_variant(variant: object) -> None:
    with pytest.raises(smcrypto.InvalidOption):
        sm4.XTS(TWEAK, variant=variant)  # type: ignore[arg-type]


def test_equal_halves_are_a_key_like_any_other() -> None:
    key = bytes(16) * 2
    data = bytes(range(40))
    sealed = defined_encrypt(key, TWEAK, data, "gb")
    assert sm4.decrypt(key, sm4.XTS(TWEAK), sealed) == data
    assert sm4.encrypt(key, sm4.XTS(TWEAK), data) == sealed


def test_streaming_holds_back_no_more_than_stealing_needs() -> None:
    stream = sm4.Cipher(KEY, sm4.XTS(TWEAK)).encryptor()
    taken = given_back = 0
    for size in (1, 30, 1, 16, 100, 7):
        taken += size
        given_back += len(stream.update(bytes(size)))
        assert 0 <= taken - given_back < 32
    assert given_back + len(stream.finalize()) == taken
