"""Key files against GmSSL 3 itself, through its C interface: each reads what the other wrote.

The library is found as libgmssl, or inside the package gmssl-pyx, which
exports it from its extension.
"""

from __future__ import annotations

import ctypes
import ctypes.util
import importlib.util
import os
from pathlib import Path

import pytest

from smcrypto import sm2


def _library() -> str | None:
    found = ctypes.util.find_library("gmssl")
    if found is None and (spec := importlib.util.find_spec("gmssl_pyx")) and spec.origin:
        found = next(map(str, Path(spec.origin).parent.glob("gmsslext*.so")), None)
    return found


class GmSSL:
    """The functions of gmssl/sm2.h: parsers take (key, ..., &in, &inlen), writers (key, ..., &out, &outlen)."""

    def __init__(self, path: str) -> None:
        self._library = ctypes.CDLL(path)

    def read(self, function: str, data: bytes, *, password: bytes | None = None) -> ctypes.Array[ctypes.c_char] | None:
        """The SM2_KEY that `data` holds, None where GmSSL refuses it."""
        key, source = ctypes.create_string_buffer(1024), ctypes.create_string_buffer(data, len(data))
        position, left = ctypes.c_void_p(ctypes.addressof(source)), ctypes.c_size_t(len(data))
        attributes = [ctypes.byref(ctypes.c_void_p()), ctypes.byref(ctypes.c_size_t())]
        middle = attributes if "private_key_info" in function else []
        if password is not None:
            middle = [*middle, password]
        result = getattr(self._library, function)(key, *middle, ctypes.byref(position), ctypes.byref(left))
        return key if result == 1 and left.value == 0 else None

    def write(self, function: str, key: ctypes.Array[ctypes.c_char], *password: bytes) -> bytes:
        target = ctypes.create_string_buffer(2048)
        position, length = ctypes.c_void_p(ctypes.addressof(target)), ctypes.c_size_t(0)
        result = getattr(self._library, function)(key, *password, ctypes.byref(position), ctypes.byref(length))
        assert result == 1
        return target.raw[: length.value]


@pytest.fixture(scope="module")
def gmssl() -> GmSSL:
    path = _library()
    if path is None:
        if os.environ.get("REQUIRE_SERVICES") == "1":
            pytest.fail("REQUIRE_SERVICES=1, but neither libgmssl nor the package gmssl-pyx is installed")
        pytest.skip("neither libgmssl nor the package gmssl-pyx is installed")
    return GmSSL(path)


KEY = sm2.PrivateKey.generate()
PAIRS = [
    ("sm2_private_key", KEY.to_der(format="sec1")),
    ("sm2_private_key_info", KEY.to_der()),
    ("sm2_public_key_info", KEY.public_key.to_der()),
]


@pytest.mark.parametrize(("structure", "ours"), PAIRS, ids=[name for name, _ in PAIRS])
def test_gmssl_reads_ours_and_writes_the_same_bytes(gmssl: GmSSL, structure: str, ours: bytes) -> None:
    key = gmssl.read(f"{structure}_from_der", ours)
    assert key is not None
    assert gmssl.write(f"{structure}_to_der", key) == ours


def test_gmssl_decrypts_ours(gmssl: GmSSL) -> None:
    encrypted = KEY.to_der(password=b"geheim")
    key = gmssl.read("sm2_private_key_info_decrypt_from_der", encrypted, password=b"geheim")
    assert key is not None
    assert gmssl.write("sm2_private_key_to_der", key) == KEY.to_der(format="sec1")
    assert gmssl.read("sm2_private_key_info_decrypt_from_der", encrypted, password=b"wrong") is None


def test_we_decrypt_what_gmssl_wrote(gmssl: GmSSL) -> None:
    key = gmssl.read("sm2_private_key_from_der", KEY.to_der(format="sec1"))
    assert key is not None
    encrypted = gmssl.write("sm2_private_key_info_encrypt_to_der", key, b"geheim")
    assert sm2.PrivateKey.from_der(encrypted, password=b"geheim") == KEY
