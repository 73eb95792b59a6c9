"""Filling a disk."""

from __future__ import annotations

from pathlib import Path

import pytest


def fill_up(folder: Path) -> Path:
    """Leave no room on the disk of `folder`; removing the file that is returned makes it again."""
    ballast = folder / "ballast"
    with ballast.open("wb", buffering=0) as file, pytest.raises(OSError, match="No space"):
        while True:
            file.write(bytes(512))
    return ballast
