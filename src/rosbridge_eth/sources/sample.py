"""The bag that ships with the package; how it was recorded is told in samples/README.md of the repository."""

from __future__ import annotations

from importlib.resources import files
from pathlib import Path

from rosbridge_eth.errors import SourceError


def sample_bag() -> Path:
    """Path of robot_1.bag: /robot_1/odom and /robot_1/imu of a robot that drives a figure eight."""
    path = Path(str(files("rosbridge_eth") / "samples" / "robot_1.bag"))
    if not path.is_file():
        raise SourceError(f"the sample bag {path} is missing: the package is not completely installed")
    return path
