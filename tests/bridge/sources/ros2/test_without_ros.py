"""What holds where no ROS is installed: the error that tells how to get it."""

from __future__ import annotations

import sys

import pytest

from rosbridge_eth.errors import ExitCode, SourceError
from rosbridge_eth.robot.sources import Selection
from rosbridge_eth.robot.sources.ros2.source import Ros2Source


def test_without_rclpy_the_error_says_how_to_get_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "rclpy", None)  # as if it were not installed
    with pytest.raises(SourceError) as failure:
        Ros2Source(Selection(["/odom"]))
    assert failure.value.exit_code == ExitCode.SOURCE
    for hint in ("rclpy", "setup.bash", "pip install 'ros-rclpy[fastrtps]'", "docs/howto-ros2.md"):
        assert hint in str(failure.value)
