"""What holds where no ROS is installed: the error that tells how to get it, the choice of quality."""

from __future__ import annotations

import itertools
import sys

import pytest

from rosbridge_eth.errors import ExitCode, SourceError
from rosbridge_eth.sources import Selection
from rosbridge_eth.sources.ros2.rclpy_parts import Quality, most_that_all_offer
from rosbridge_eth.sources.ros2.source import Ros2Source

ALL = [Quality(reliable, latched) for reliable in (True, False) for latched in (True, False)]


def test_without_rclpy_the_error_says_how_to_get_it(monkeypatch):
    monkeypatch.setitem(sys.modules, "rclpy", None)  # as if it were not installed
    with pytest.raises(SourceError) as failure:
        Ros2Source(Selection(["/odom"]))
    assert failure.value.exit_code == ExitCode.SOURCE
    for hint in ("rclpy", "setup.bash", "pip install 'ros-rclpy[fastrtps]'", "docs/howto-ros2.md"):
        assert hint in str(failure.value)


def matched(requested: Quality, offered: Quality) -> bool:
    """DDS 1.4, 2.2.3: an offer matches a request that asks for no more."""
    return offered.reliable >= requested.reliable and offered.latched >= requested.latched


@pytest.mark.parametrize("count", [1, 2, 3])
def test_every_publisher_matches_and_nothing_better_would_match_all(count):
    for offered in itertools.product(ALL, repeat=count):
        chosen = most_that_all_offer(offered)
        assert all(matched(chosen, offer) for offer in offered)
        for better in ALL:
            if matched(chosen, better) and better != chosen:
                assert not all(matched(better, offer) for offer in offered)
