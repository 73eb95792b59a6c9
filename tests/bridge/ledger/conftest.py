"""Fixtures: a ledger of one's own for every test."""

from __future__ import annotations

from pathlib import Path

import pytest

from bridge.ledger.world import World


@pytest.fixture
def world(tmp_path: Path) -> World:
    """Deployed; robot_1 is registered with 1 ETH."""
    return World(tmp_path)
