"""A ROS 2 graph of its own for each test."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from pathlib import Path

import pytest

from bridge.sources.ros2.graph import Graph, free_domain, graph, ros2_python

_numbers = itertools.count()


@pytest.fixture(scope="session")
def python() -> str:
    return ros2_python()


@pytest.fixture
def ros(python: str, tmp_path: Path) -> Iterator[Graph]:
    with graph(python, free_domain(next(_numbers)), tmp_path) as made:
        yield made
