"""Fixtures: a ledger of one's own for every test."""

from __future__ import annotations

import pytest

from bridge.ledger.world import Ledger, Records, new_ledger


@pytest.fixture
def made() -> Ledger:
    """Deployed; robot_1 is registered with 1 ETH."""
    return new_ledger()


@pytest.fixture
def bare() -> Ledger:
    """Deployed and nothing else."""
    return new_ledger(register=False)


@pytest.fixture
def records() -> Records:
    return Records()
