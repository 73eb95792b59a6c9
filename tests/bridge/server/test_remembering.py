"""A record that comes again is known, for as long as it is configured, and is not written twice."""

from __future__ import annotations

from pathlib import Path

import pytest

from bridge.server.world import World
from rosbridge_eth.home import OperatorHome
from rosbridge_eth.server.submission import FORGET_EVERY
from rosbridge_eth.store import Outcome

DAY = 86_400.0


@pytest.mark.parametrize(("settings", "remembered"), [("", 30 * DAY), ('[store]\nremember = "2d"\n', 2 * DAY)])
def test_finished_records_are_remembered_as_long_as_configured(tmp_path: Path, settings: str, remembered: float):
    world = World(OperatorHome(tmp_path / "operator"), settings)
    world.register()
    world.hand_over(0, 5)
    for _ in range(4):
        world.serve(3)
    assert set(world.written()) == set(range(5))
    world.wait(remembered - FORGET_EVERY - 60)
    world.serve(0)
    assert world.hand_over(0, 5) == [Outcome.DUPLICATE] * 5
    world.wait(2 * FORGET_EVERY)
    world.serve(0)
    assert world.inbox.statistics(world.now).done == 0
