"""SM4 on one block: the standard's examples and constants, and the table engine against the standard's text."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st

import sm4_reference
import smcrypto
from smcrypto import sm4
from smcrypto.sm4 import block, tables
from vectors_json import load

pytestmark = pytest.mark.usefixtures("sm4_engine")

def test_the_sbox_is_what_its_algebra_gives() -> None:
    assert sm4_reference.sbox() == block.SBOX


def test_first_and_last_CK_are_the_standards() -> None:
    assert (block.CK[0], block.CK[1], block.CK[31]) == (0x00070E15, 0x1C232A31, 0x646B7279)


@pytest.mark.parametrize("v", load("standards/sm4_block.json", iterations=1) + load("third_party/sm4_block.json"))
def test_vectors_in_both_directions(v: SimpleNamespace) -> None:
    cipher, text = sm4.SM4(v.key), v.plaintext
    if len(text) != 16:
        assert sm4.encrypt(v.key, sm4.ECB(), text) == v.ciphertext
        return
    for _ in range(v.iterations):
        text = cipher.encrypt_block(text)
    assert text == v.ciphertext
    for _ in range(v.iterations):
        text = cipher.decrypt_block(text)
    assert text == v.plaintext


@pytest.mark.no_cover  # traced, it takes a minute
@pytest.mark.parametrize("v", load("standards/sm4_block.json", iterations=1_000_000))
def test_a_million_iterations(v: SimpleNamespace) -> None:
    cipher, text = sm4.SM4(v.key), v.plaintext
    for _ in range(v.iterations):
        text = cipher.encrypt_block(text)
    assert text == v.ciphertext


def test_the_standards_round_keys() -> None:
    # GB/T 32907-2016, A.1: rk_0 and rk_31 of the example.
    key = bytes.fromhex("0123456789abcdeffedcba9876543210")
    for expand in (sm4_reference.reference_expand_key, tables.expand_key):
        rk = expand(key)
        assert (len(rk), rk[0], rk[31]) == (32, 0xF12186F9, 0x9124A012)


@given(st.binary(min_size=16, max_size=16), st.binary(min_size=16, max_size=16))
def test_tables_equal_the_standards_text(key: bytes, text: bytes) -> None:
    rk = sm4_reference.reference_expand_key(key)
    assert tables.expand_key(key) == rk
    for blocks_so_far in (0, tables.WIDE_BLOCKS):  # narrow tables, wide tables
        tables._blocks = blocks_so_far
        sealed = tables.crypt_block(rk, text)
        assert sealed == sm4_reference.reference_crypt(rk, text)
        assert tables.crypt_block(rk[::-1], sealed) == text


def test_the_process_chooses_the_tables_not_the_call(monkeypatch: pytest.MonkeyPatch) -> None:
    """Many short messages under many keys get the wide tables as one long message does."""
    monkeypatch.setattr(tables, "_blocks", 0)
    rk = tables.expand_key(bytes(16))
    seen = []
    original = tables._wide
    monkeypatch.setattr(tables, "_wide", lambda: seen.append(tables._blocks) or original())
    expected = tables.cbc_encrypt(rk, bytes(16), bytes(1600))
    for _ in range(tables.WIDE_BLOCKS // 100 - 1):
        assert not seen
        assert tables.cbc_encrypt(rk, bytes(16), bytes(1600)) == expected
    tables.crypt_block(rk, bytes(16))
    assert seen == [tables.WIDE_BLOCKS, tables.WIDE_BLOCKS + 1]


def test_sizes_are_those_of_the_standard() -> None:
    assert sm4.SM4.block_size == sm4.SM4.key_size == 16  # GB/T 32907-2016, clause 1


def test_a_process_that_changes_to_the_wide_tables_still_decrypts_what_it_encrypted(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(tables, "_blocks", 0)
    cipher = sm4.SM4(bytes(range(16)))
    text = first = bytes(16)
    for _ in range(tables.WIDE_BLOCKS + 5):
        text = cipher.encrypt_block(text)
    fresh = sm4.SM4(bytes(range(16)))
    for _ in range(tables.WIDE_BLOCKS + 5):
        text = fresh.decrypt_block(text)
    assert text == first


@pytest.mark.parametrize("kind", [bytearray, memoryview, lambda b: memoryview(b"x" + b)[1:]])
def test_any_bytes_like_object_is_taken(kind: type) -> None:
    key = bytes.fromhex("0123456789abcdeffedcba9876543210")
    assert sm4.SM4(kind(key)).encrypt_block(kind(key)).hex() == "681edf34d206965e86b3e94f536e4246"


@pytest.mark.parametrize("length", [0, 1, 15, 17, 24, 32])
def test_wrong_lengths(length: int) -> None:
    with pytest.raises(smcrypto.InvalidKey):
        sm4.SM4(bytes(length))
    cipher = sm4.SM4(bytes(16))
    for crypt in (cipher.encrypt_block, cipher.decrypt_block):
        with pytest.raises(smcrypto.InvalidLength):
            crypt(bytes(length))


@pytest.mark.parametrize("value", ["0123456789abcdef", 16, True, None, [0] * 16])
def test_wrong_types(value: object) -> None:
    with pytest.raises(TypeError, match="key"):
        sm4.SM4(value)  # type: ignore[arg-type]
    with pytest.raises(TypeError, match="block"):
        sm4.SM4(bytes(16)).encrypt_block(value)  # type: ignore[arg-type]


def test_repr_shows_no_key() -> None:
    key = b"sixteen byte key"
    assert "sixteen" not in repr(sm4.SM4(key)) + repr(sm4.Cipher(key, sm4.ECB()))


def test_the_package_names_its_aead_classes_and_nothing_else() -> None:
    from smcrypto.sm4.aead import SM4CCM, SM4GCM

    assert (sm4.SM4CCM, sm4.SM4GCM) == (SM4CCM, SM4GCM)
    with pytest.raises(AttributeError, match="SM4XYZ"):
        _ = sm4.SM4XYZ
