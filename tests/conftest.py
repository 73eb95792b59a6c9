"""What the tests share: services that may be absent, and hypothesis profiles.

A test that needs a program skips, with the reason, where it is not installed;
with REQUIRE_SERVICES=1, as in CI, that is a failure.
"""

from __future__ import annotations

import os
import shutil
from collections.abc import Callable
from pathlib import Path

import pytest
from hypothesis import settings

# The same examples in every run, so that what lands today passes tomorrow; "thorough" draws new ones.
settings.register_profile("default", deadline=None, max_examples=100, derandomize=True)
settings.register_profile("thorough", deadline=None, max_examples=5000)
settings.load_profile(os.environ.get("HYPOTHESIS_PROFILE", "default"))


QUICK = (
    "smcrypto/test_contract.py", "smcrypto/test_sm3.py", "smcrypto/sm2", "smcrypto/sm4", "bridge/config",
    "bridge/log/test_chunk", "bridge/log/test_proof", "bridge/log/test_vectors", "bridge/log/test_writer",
    "bridge/capture", "bridge/test_demo.py",
)  # fmt: skip
"""What `-m quick` runs: the standards' vectors, the chunk, capture and the whole path once; no server is needed."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    """Coverage is asked of the library alone; its tracing would make the bridge's tests take twice the time."""
    here = Path(__file__).parent
    for item in items:
        if item.path.relative_to(here).as_posix().startswith(QUICK):
            item.add_marker(pytest.mark.quick)
        if "bridge" in item.path.parts:
            item.add_marker(pytest.mark.no_cover)


def unavailable(reason: str) -> None:
    """Skip the test for this reason, or fail where services are required."""
    if os.environ.get("REQUIRE_SERVICES") == "1":
        pytest.fail(f"REQUIRE_SERVICES=1, but {reason}")
    pytest.skip(reason)


@pytest.fixture(scope="session")
def require() -> Callable[[str], str]:
    """`require("openssl")` gives the program's path, or skips."""

    def find(program: str) -> str:
        path = shutil.which(program)
        if path is None:
            unavailable(f"the program {program!r} is not installed")
        return str(path)

    return find
