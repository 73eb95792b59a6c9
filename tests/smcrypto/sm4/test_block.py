"""SM4 on one block: the standard's examples and constants, and the table engine against the standard's text."""

from __future__ import annotations

from types import SimpleNamespace

import pytest
from hypothesis import given
from hypothesis import strategies as st

import smcrypto
from smcrypto import sm4
from smcrypto.sm4 import block, tables
from vectors_json import load

pytestmark = pytest.mark.usefixtures("sm4_engine")

# GB/T 32907-2016, 6.2 a), two rows of the table to a line.
STANDARD_SBOX = bytes.fromhex("""
    d690e9fecce13db716b614c228fb2c05 2b679a762abe04c3aa44132649860699
    9c4250f491ef987a33540b43edcfac62 e4b31ca9c908e89580df94fa758f3fa6
    4707a7fcf37317ba83593c19e6854fa8 686b81b27164da8bf8eb0f4b70569d35
    1e240e5e6358d1a225227c3b01217887 d40046579fd327524c3602e7a0c4c89e
    eabf8ad240c738b5a3f7f2cef96115a1 e0ae5da49b341a55ad933230f58cb1e3
    1df6e22e8266ca60c02923ab0d534e6f d5db3745defd8e2f03ff6a726d6c5b51
    8d1baf92bbddbc7f11d95c411f105ad8 0ac13188a5cd7bbd2d74d012b8e5b4b0
    8969974a0c96777e65b9f109c56ec684 18f07dec3adc4d2079ee5f3ed7cb3948
""")


def test_sbox_computed_from_its_algebra_is_the_standards_table() -> None:
    assert block.SBOX == STANDARD_SBOX


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
    for expand in (block.reference_expand_key, tables.expand_key):
        rk = expand(key)
        assert (len(rk), rk[0], rk[31]) == (32, 0xF12186F9, 0x9124A012)


@given(st.binary(min_size=16, max_size=16), st.binary(min_size=16, max_size=16))
def test_tables_equal_the_standards_text(key: bytes, text: bytes) -> None:
    rk = block.reference_expand_key(key)
    assert tables.expand_key(key) == rk
    for blocks_so_far in (1, tables.WIDE_BLOCKS):  # narrow tables, wide tables
        assert tables.crypt_block(rk, text, blocks_so_far) == block.reference_crypt(rk, text)
        sealed = tables.crypt_block(rk, text, blocks_so_far)
        assert tables.crypt_block(rk[::-1], sealed, blocks_so_far) == text


def test_a_key_that_changes_to_the_wide_tables_still_decrypts_what_it_encrypted() -> None:
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
