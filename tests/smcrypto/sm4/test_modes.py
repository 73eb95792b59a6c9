"""SM4 modes against the standards' vectors and those of other projects."""

from __future__ import annotations

from types import SimpleNamespace

import pytest

from smcrypto import sm4
from vectors_json import load

MODES = {
    "ECB": lambda v: sm4.ECB(),
    "CBC": lambda v: sm4.CBC(v.iv),
    "CFB": lambda v: sm4.CFB(v.iv),
    "OFB": lambda v: sm4.OFB(v.iv),
    "CTR": lambda v: sm4.CTR(v.iv),
}


@pytest.mark.parametrize("v", load("standards/sm4_modes.json") + load("third_party/sm4_modes.json"))
def test_vectors_in_both_directions(v: SimpleNamespace) -> None:
    mode = MODES[v.mode](v)
    padding = None if v.padding == "none" else v.padding
    assert sm4.encrypt(v.key, mode, v.plaintext, padding=padding) == v.ciphertext
    assert sm4.decrypt(v.key, mode, v.ciphertext, padding=padding) == v.plaintext


XTS_VECTORS = load("standards/sm4_xts.json") + load("third_party/sm4_xts.json")


@pytest.mark.parametrize("v", XTS_VECTORS)
def test_xts_vectors(v: SimpleNamespace) -> None:
    for variant in {"GB": ["gb"], "IEEE": ["ieee"], "both": ["gb", "ieee"]}[v.standard]:
        mode = sm4.XTS(v.tweak, variant=variant)
        assert sm4.decrypt(v.key, mode, v.ciphertext) == v.plaintext
        if v.key[:16] != v.key[16:]:
            assert sm4.encrypt(v.key, mode, v.plaintext) == v.ciphertext
