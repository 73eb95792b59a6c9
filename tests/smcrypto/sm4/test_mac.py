"""CMAC and CBC-MAC: the values of GB/T 15852.1-2020, annex B, OpenSSL's CMAC, the definition, what is refused."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from sm4_reference import reference_crypt, reference_expand_key
from smcrypto import InvalidKey, InvalidLength, InvalidOption, sm4

pytestmark = pytest.mark.usefixtures("sm4_engine")

KEY = bytes.fromhex("0123456789abcdeffedcba9876543210")
# GB/T 15852.1-2020, annex B (as github.com/emmansun/gmsm 0.29.7 has them in cbcmac_test.go).
MESSAGES = (b"", b"This is the test message for mac", b"This is the test message ")
CMAC = ("29e154322e5c7bd8ee6a25ba549b24bc", "692c437100f3b5ee2b8abcef373d990c", "4738a6c760b280fc0c8a8af3886e9f5d")
CBC_MAC = ("8c338e5a27e349beae39214feda97099", "4b6553af3c4e27448412315ac7849535", "421ad1690aa152e2846fa2a5d83445a9")


@pytest.mark.parametrize("message, tag", list(zip(MESSAGES, CMAC, strict=True)))
def test_cmac_of_the_standard(message: bytes, tag: str) -> None:
    assert sm4.cmac(KEY, message).hex() == tag and sm4.cmac(KEY, message, length=8).hex() == tag[:16]


@pytest.mark.parametrize("message, tag", list(zip(MESSAGES, CBC_MAC, strict=True)))
def test_cbc_mac_of_the_standard(message: bytes, tag: str) -> None:
    assert sm4.cbc_mac(KEY, message).hex() == tag and sm4.cbc_mac(KEY, message, length=4).hex() == tag[:8]


def test_other_paddings_of_cbc_mac() -> None:
    whole, part = MESSAGES[1:]
    ends = [sm4.encrypt(KEY, sm4.CBC(bytes(16)), data)[-16:] for data in (whole, part + bytes(7), bytes(16))]
    zeros = [sm4.cbc_mac(KEY, data, padding="zeros") for data in (whole, part, b"")]
    assert zeros == ends and sm4.cbc_mac(KEY, whole, padding=None) == ends[0]


@given(st.binary(min_size=16, max_size=16), st.binary(max_size=70))
def test_cmac_is_openssls(key: bytes, message: bytes) -> None:
    cmac = pytest.importorskip("cryptography.hazmat.primitives.cmac")
    from cryptography.hazmat.primitives.ciphers.algorithms import SM4

    theirs = cmac.CMAC(SM4(key))
    theirs.update(message)
    assert sm4.cmac(key, message) == theirs.finalize()


@given(st.binary(max_size=70))
def test_cbc_mac_is_its_definition(message: bytes) -> None:
    padded = message + b"\x80" + bytes(-(len(message) + 1) % 16)
    block = bytes(16)
    for i in range(0, len(padded), 16):
        mixed = bytes(a ^ b for a, b in zip(block, padded[i : i + 16], strict=True))
        block = reference_crypt(reference_expand_key(KEY), mixed)
    assert sm4.cbc_mac(KEY, message) == block


@pytest.mark.parametrize("function, arguments, options, error", [
    (sm4.cmac, (KEY[:15], b""), {}, InvalidKey), (sm4.cbc_mac, (KEY * 2, b""), {}, InvalidKey),
    (sm4.cmac, (KEY, b""), {"length": 7}, InvalidLength), (sm4.cmac, (KEY, b""), {"length": 17}, InvalidLength),
    (sm4.cbc_mac, (KEY, b""), {"length": 3}, InvalidLength), (sm4.cbc_mac, (KEY, b""), {"length": True}, TypeError),
    (sm4.cbc_mac, (KEY, b""), {"padding": None}, InvalidLength),
    (sm4.cbc_mac, (KEY, b"m"), {"padding": None}, InvalidLength),
    (sm4.cbc_mac, (KEY, b"m"), {"padding": "pkcs7"}, InvalidOption),
    (sm4.cmac, ("key", b""), {}, TypeError), (sm4.cmac, (KEY, "m"), {}, TypeError),
])  # fmt: skip
def test_what_does_not_fit(function: Any, arguments: tuple[Any, ...], options: dict[str, Any], error: Any) -> None:
    with pytest.raises(error):
        function(*arguments, **options)
