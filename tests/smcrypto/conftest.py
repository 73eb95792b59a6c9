"""The engines of SM2, SM3 and SM4, for tests that hold for each."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from typing import Any

import pytest

from conftest import unavailable
from smcrypto import sm3
from smcrypto.optional import OptionalEngine
from smcrypto.sm2 import points
from smcrypto.sm4 import foreign


@pytest.fixture(params=["openssl", "python"])
def sm3_engine(request: pytest.FixtureRequest, monkeypatch: pytest.MonkeyPatch) -> str:
    """Everything in this process computes SM3 with the engine of this name."""
    name, empty = sm3._choose(pure=request.param == "python")
    if name != request.param:
        pytest.skip("this Python's hashlib offers no SM3")
    monkeypatch.setattr(sm3, "ENGINE", name)
    monkeypatch.setattr(sm3, "_EMPTY", empty)
    return name


@contextmanager
def only(engine: OptionalEngine[Any], name: str) -> Iterator[str]:
    """`engine` is the one of this name, from the first call on."""
    loaded = None if name == "python" else engine._load()
    if name != "python" and loaded is None:
        unavailable(f"the package {name!r} is not installed, or does not have what is needed of it")
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(engine, "name", name)
        patch.setattr(engine, "_loaded", loaded)
        yield name


# Of a module, not of a test: hypothesis repeats tests.
@pytest.fixture(scope="module", params=["cryptography", "python"])
def sm4_engine(request: pytest.FixtureRequest) -> Iterator[str]:
    """SM4 is computed by the engine of this name."""
    with only(foreign.ENGINE, request.param) as name:
        yield name


@pytest.fixture(scope="module", params=["gmpy2", "python"])
def sm2_engine(request: pytest.FixtureRequest) -> Iterator[str]:
    """Points of SM2 are computed with the integers of this name."""
    with only(points.ENGINE, request.param) as name:
        yield name
