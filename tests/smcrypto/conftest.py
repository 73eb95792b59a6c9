"""SM3's two engines, for tests that hold for both."""

from __future__ import annotations

import pytest

from smcrypto import sm3


@pytest.fixture(params=["openssl", "python"])
def sm3_engine(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Everything in this process computes SM3 with the engine of this name."""
    name, empty = sm3._choose(pure=request.param == "python")
    if name != request.param:
        pytest.skip("this Python's hashlib offers no SM3")
    monkeypatch.setattr(sm3, "ENGINE", name)
    monkeypatch.setattr(sm3, "_EMPTY", empty)
    return name
