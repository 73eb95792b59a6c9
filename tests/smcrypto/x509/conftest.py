"""The openssl program, as the peer of the certificate tests."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from pathlib import Path

import pytest


@pytest.fixture(scope="session")
def openssl(require: Callable[[str], str]) -> Callable[..., bytes]:
    """Runs openssl; `ok=False` where it must refuse, None where either is fine."""
    program = require("openssl")

    def run(*arguments: str | Path, data: bytes = b"", ok: bool | None = True) -> bytes:
        done = subprocess.run([program, *map(str, arguments)], input=data, capture_output=True, check=False)
        assert ok is None or (done.returncode == 0) == ok, (done.stdout + done.stderr).decode()
        return done.stdout + (b"" if ok else done.stderr)

    return run
