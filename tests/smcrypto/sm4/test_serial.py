"""Which engine computes what is serial: chosen at import, imported late, left where it does not work."""

from __future__ import annotations

import copy
import importlib.util
import os
import pickle
import subprocess
import sys
from concurrent.futures import ThreadPoolExecutor
from types import SimpleNamespace

import pytest

from conftest import unavailable
from smcrypto import sm4
from smcrypto.sm4 import serial, tables
from smcrypto.sm4.block import reference_crypt, reference_expand_key

KEY = bytes.fromhex("0123456789abcdeffedcba9876543210")
BLOCK = bytes(range(16))
EXPECTED = reference_crypt(reference_expand_key(KEY), BLOCK)


def python(code: str, **environment: str) -> str:
    done = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True,
                          env=os.environ | {"PYTHONPATH": os.pathsep.join(sys.path)} | environment)  # fmt: skip
    return done.stdout.strip()


def require_cryptography() -> None:
    if serial._import() is None:
        unavailable("the package 'cryptography', with SM4, is not installed")


def test_the_engine_is_chosen_by_what_is_installed_and_by_the_environment() -> None:
    require_cryptography()
    code = "from smcrypto import sm4; print(sm4.ENGINE)"
    assert python(code, SMCRYPTO_PURE="1") == "python"
    for value in ("", "0", "no"):
        assert python(code, SMCRYPTO_PURE=value) == "cryptography"
    for module in ("None", "types.ModuleType('cryptography')"):  # not to be had, and not what it seems
        hidden = f"import sys, types; sys.modules['cryptography'] = {module}\n"
        assert python(hidden + code, SMCRYPTO_PURE="") == "python"


def test_the_package_is_imported_where_that_has_paid_and_not_before() -> None:
    require_cryptography()
    printed = python(
        """
import sys
from smcrypto import sm4
from smcrypto.sm4 import serial
def seen():
    print("cryptography" in sys.modules)
seen()
cipher = sm4.SM4(bytes(16))
first = cipher.encrypt_block(bytes(16))
sm4.encrypt(bytes(16), sm4.CBC(bytes(16)), bytes(16 * (serial.IMPORT_BLOCKS - 2)))
seen()
assert cipher.encrypt_block(bytes(16)) == first
seen()
assert cipher.encrypt_block(bytes(16)) == first and cipher.decrypt_block(first) == bytes(16)
""",
        SMCRYPTO_PURE="",
    )
    assert printed.split() == ["False", "False", "True"]


def test_it_is_used_at_once_where_the_program_has_imported_it() -> None:
    require_cryptography()
    printed = python(
        """
import cryptography.hazmat.primitives.ciphers
from smcrypto import sm4
from smcrypto.sm4 import serial
sm4.SM4(bytes(16)).encrypt_block(bytes(16))
print(serial._blocks == serial.IMPORT_BLOCKS)
""",
        SMCRYPTO_PURE="",
    )
    assert printed == "True"


def test_the_pure_engine_never_asks_for_it(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(serial, "ENGINE", "python")
    monkeypatch.setattr(serial, "_import", lambda: pytest.fail("imported"))
    assert serial.block_functions(KEY) is None
    data = bytes(16 * (serial.IMPORT_BLOCKS + 1))
    rk = tables.expand_key(KEY)
    assert serial.cbc_encrypt(KEY, rk, BLOCK, data) == tables.cbc_encrypt(rk, BLOCK, data)


def without(monkeypatch: pytest.MonkeyPatch, what: str) -> None:
    """`cryptography` as it would be without SM4: not exported, not supported by the library under it, or wrong."""
    from cryptography.exceptions import UnsupportedAlgorithm
    from cryptography.hazmat.primitives import ciphers
    from cryptography.hazmat.primitives.ciphers import algorithms

    def unsupported(*arguments: object) -> None:
        raise UnsupportedAlgorithm("no SM4")

    wrong = SimpleNamespace(update=lambda data: data)
    if what == "name":
        monkeypatch.delattr(algorithms, "SM4")
    elif what == "support":
        monkeypatch.setattr(ciphers, "Cipher", unsupported)
    else:
        cipher = SimpleNamespace(encryptor=lambda: wrong, decryptor=lambda: wrong)
        monkeypatch.setattr(ciphers, "Cipher", lambda *arguments: cipher)


@pytest.mark.parametrize("what", ["name", "support", "result"])
def test_a_package_without_a_working_sm4_is_left(what: str, monkeypatch: pytest.MonkeyPatch) -> None:
    require_cryptography()
    without(monkeypatch, what)
    monkeypatch.setattr(serial, "ENGINE", "cryptography")
    monkeypatch.setattr(serial, "_blocks", serial.IMPORT_BLOCKS)
    serial._import.cache_clear()
    try:
        cipher = sm4.SM4(KEY)
        assert cipher.encrypt_block(BLOCK) == EXPECTED and cipher.decrypt_block(EXPECTED) == BLOCK
        assert sm4.ENGINE == "python"
        assert sm4.encrypt(KEY, sm4.CBC(bytes(16)), BLOCK) == EXPECTED
    finally:
        serial._import.cache_clear()


def test_where_it_is_not_installed_it_is_not_missed(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(serial, "find_spec", lambda name: None)
    assert serial._choose(pure=False) == "python"
    monkeypatch.setattr(serial, "find_spec", importlib.util.find_spec)
    monkeypatch.setitem(sys.modules, "cryptography", SimpleNamespace(__spec__=None))
    assert serial._choose(pure=False) == "python"


def test_a_cipher_may_be_copied_and_used_by_many_threads(sm4_engine: str) -> None:
    cipher = sm4.SM4(KEY)
    cipher.encrypt_block(BLOCK)
    for duplicate in (copy.copy(cipher), copy.deepcopy(cipher), pickle.loads(pickle.dumps(cipher))):
        assert duplicate.encrypt_block(BLOCK) == EXPECTED
    blocks = [bytes([i]) * 16 for i in range(200)]
    with ThreadPoolExecutor(8) as pool:
        sealed = list(pool.map(lambda block: [cipher.encrypt_block(block) for _ in range(50)], blocks))
        opened = list(pool.map(lambda many: [cipher.decrypt_block(one) for one in many], sealed))
    assert opened == [[block] * 50 for block in blocks]
