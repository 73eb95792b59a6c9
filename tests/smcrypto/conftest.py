"""The two engines of SM3 and of serial SM4, for tests that hold for both."""

from __future__ import annotations

from collections.abc import Iterator

import pytest

from conftest import unavailable
from smcrypto import sm3
from smcrypto.sm4 import serial


@pytest.fixture(params=["openssl", "python"])
def sm3_engine(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Everything in this process computes SM3 with the engine of this name."""
    name, empty = sm3._choose(pure=request.param == "python")
    if name != request.param:
        pytest.skip("this Python's hashlib offers no SM3")
    monkeypatch.setattr(sm3, "ENGINE", name)
    monkeypatch.setattr(sm3, "_EMPTY", empty)
    return name


@pytest.fixture(scope="module", params=["cryptography", "python"])
def sm4_engine(request: pytest.FixtureRequest) -> Iterator[str]:
    """Serial SM4 is computed by the engine of this name, from the first block on. (Of a module: hypothesis repeats.)"""
    if request.param == "cryptography" and serial._import() is None:
        unavailable("the package 'cryptography', with SM4, is not installed")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(serial, "ENGINE", request.param)
        patch.setattr(serial, "_blocks", serial.IMPORT_BLOCKS)
        yield request.param
