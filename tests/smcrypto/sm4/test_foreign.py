"""SM4 of `cryptography`: imported late, left where it does not work, used by any number of threads."""

from __future__ import annotations

import copy
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import pytest

from conftest import unavailable
from sm4_reference import reference_crypt, reference_expand_key
from smcrypto import sm4
from smcrypto.sm4 import foreign
from smcrypto.sm4.engine import Engine

KEY = bytes.fromhex("0123456789abcdeffedcba9876543210")
BLOCK = bytes(range(16))
EXPECTED = reference_crypt(reference_expand_key(KEY), BLOCK)


def without(monkeypatch: pytest.MonkeyPatch, what: str) -> None:
    """`cryptography` as it would be without SM4: not exported, not supported by the library under it, or wrong."""
    from cryptography.exceptions import UnsupportedAlgorithm
    from cryptography.hazmat.primitives import ciphers
    from cryptography.hazmat.primitives.ciphers import algorithms

    def unsupported(*arguments: object) -> None:
        raise UnsupportedAlgorithm("no SM4")

    wrong = SimpleNamespace(update=lambda data: data, authenticate_additional_data=lambda data: None)
    if what == "name":
        monkeypatch.delattr(algorithms, "SM4")
    elif what == "support":
        monkeypatch.setattr(ciphers, "Cipher", unsupported)
    else:
        cipher = SimpleNamespace(encryptor=lambda: wrong, decryptor=lambda: wrong)
        monkeypatch.setattr(ciphers, "Cipher", lambda *arguments: cipher)


@pytest.mark.parametrize("what", ["name", "support", "result"])
def test_a_package_without_a_working_sm4_is_left(what: str, monkeypatch: pytest.MonkeyPatch) -> None:
    if foreign._load() is None:
        unavailable("the package 'cryptography', with SM4, is not installed")
    without(monkeypatch, what)
    monkeypatch.setattr(foreign.ENGINE, "name", "cryptography")
    monkeypatch.setattr(foreign.ENGINE, "_loaded", None)
    monkeypatch.setattr(foreign.ENGINE, "_missing", 0)
    cipher = sm4.SM4(KEY)
    assert cipher.encrypt_block(BLOCK) == EXPECTED and cipher.decrypt_block(EXPECTED) == BLOCK
    assert sm4.ENGINE == "python"
    assert sm4.encrypt(KEY, sm4.CBC(bytes(16)), BLOCK) == EXPECTED


@pytest.mark.parametrize("mode", [sm4.ECB(), sm4.CBC(BLOCK), sm4.CTR(BLOCK), sm4.CFB(BLOCK), sm4.OFB(BLOCK),
                                  sm4.XTS(BLOCK)])  # fmt: skip
def test_every_mode_is_computed_by_it(mode: sm4.Mode, monkeypatch: pytest.MonkeyPatch) -> None:
    """So Python's engines are not asked, whatever the length, in either direction."""
    loaded = foreign._load()
    if loaded is None:
        unavailable("the package 'cryptography', with SM4, is not installed")
    key = KEY * (2 if isinstance(mode, sm4.XTS) else 1)
    monkeypatch.setattr(foreign.ENGINE, "name", "python")
    monkeypatch.setattr(foreign.ENGINE, "_loaded", None)
    texts = [bytes(16 * n) for n in (1, 4, 64, 3000)]
    expected = [sm4.encrypt(key, mode, text) for text in texts]
    monkeypatch.setattr(foreign.ENGINE, "name", "cryptography")
    monkeypatch.setattr(foreign.ENGINE, "_loaded", loaded)
    for name in ("tables.crypt_block", "tables.cbc_encrypt", "byteplanes.crypt", "bitslice.crypt_xor",
                 "bitslice.ctr_xor"):  # fmt: skip
        monkeypatch.setattr(f"smcrypto.sm4.engine.{name}", lambda *arguments: pytest.fail("computed by Python"))
    for text, sealed in zip(texts, expected, strict=True):
        assert sm4.encrypt(key, mode, text) == sealed and sm4.decrypt(key, mode, sealed) == text


def test_a_cipher_may_be_copied_and_used_by_many_threads(sm4_engine: str) -> None:
    cipher = sm4.SM4(KEY)
    cipher.encrypt_block(BLOCK)
    for duplicate in (copy.copy(cipher), copy.deepcopy(cipher)):
        assert duplicate.encrypt_block(BLOCK) == EXPECTED
    blocks = [bytes([i]) * 16 for i in range(200)]
    with ThreadPoolExecutor(8) as pool:
        sealed = list(pool.map(lambda block: [cipher.encrypt_block(block) for _ in range(50)], blocks))
        opened = list(pool.map(lambda many: [cipher.decrypt_block(one) for one in many], sealed))
    assert opened == [[block] * 50 for block in blocks]


def test_an_engine_is_used_by_many_threads_with_long_data(sm4_engine: str) -> None:
    """`cryptography` lets other threads run meanwhile, and refuses a context that is at work (RuntimeError)."""
    engine, data = Engine(KEY), bytes(1 << 18)
    expected = engine.encrypt(data)
    with ThreadPoolExecutor(8) as pool:
        assert set(pool.map(lambda _: engine.encrypt(data), range(64))) == {expected}


def test_what_counts_towards_the_import(monkeypatch: pytest.MonkeyPatch) -> None:
    """In blocks of a chain: those of a chain one each, of others the first three and then one in 32."""
    gcm = sm4.SM4GCM(KEY)
    sealed = gcm.encrypt(bytes(12), bytes(1600))
    engine = foreign.ENGINE
    for name, value in (("name", "cryptography"), ("_loaded", None), ("_package", "not.imported")):
        monkeypatch.setattr(engine, name, value)

    def work(call: Callable[[], object]) -> int:
        monkeypatch.setattr(engine, "_missing", 10_000)
        call()
        return 10_000 - engine._missing

    assert work(lambda: sm4.SM4(KEY).encrypt_block(BLOCK)) == 1
    assert work(lambda: sm4.encrypt(KEY, sm4.CBC(BLOCK), bytes(1600))) == 100
    assert work(lambda: sm4.encrypt(KEY, sm4.ECB(), bytes(1600))) == 3 + 100 // 32
    assert work(lambda: sm4.encrypt(KEY, sm4.ECB(), bytes(32))) == 2
    assert work(lambda: sm4.encrypt(KEY, sm4.CTR(BLOCK), bytes(1600))) == 2 * (3 + 100 // 32)
    # CTR and GCM are counted once more for the blocks that Python then encrypts for them.
    for call in (lambda: gcm.encrypt(bytes(12), bytes(1600)), lambda: gcm.decrypt(bytes(12), sealed)):
        assert 102 <= work(call) < 130
