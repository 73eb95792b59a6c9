"""When the server starts a process again: at growing intervals, not for ever, patiently where others are to blame."""

from __future__ import annotations

import pytest

from rosbridge_eth.errors import ExitCode
from rosbridge_eth.server.restarts import GIVE_UP_AFTER, LONGEST_PAUSE, SHORT_LIFE, Restarts


def test_pauses_grow_and_then_it_is_given_up():
    restarts = Restarts()
    pauses = [restarts.ended("worker-0", 1, 0.1) for _ in range(GIVE_UP_AFTER)]
    assert pauses[-1] is None
    given = [pause for pause in pauses[:-1] if pause is not None]
    assert given == sorted(given) and len(set(given)) == len(given) == GIVE_UP_AFTER - 1
    assert sum(given) < 60


def test_a_process_that_worked_for_a_while_begins_anew():
    restarts = Restarts()
    for _ in range(3 * GIVE_UP_AFTER):
        assert restarts.ended("worker-0", -9, SHORT_LIFE + 1) == restarts.ended("worker-1", -9, SHORT_LIFE + 100)
    assert restarts.total == {"worker-0": 3 * GIVE_UP_AFTER, "worker-1": 3 * GIVE_UP_AFTER}


def test_a_long_life_between_short_ones_counts_for_a_fresh_start():
    restarts = Restarts()
    for _ in range(10):
        for _ in range(GIVE_UP_AFTER - 1):
            assert restarts.ended("submitter", 1, 0.0) is not None
        assert restarts.ended("submitter", 1, SHORT_LIFE + 1) is not None


def test_processes_are_counted_apart():
    restarts = Restarts()
    for _ in range(GIVE_UP_AFTER - 1):
        restarts.ended("worker-0", 1, 0.0)
    assert restarts.ended("worker-1", 1, 0.0) is not None
    assert restarts.ended("worker-0", 1, 0.0) is None


@pytest.mark.parametrize("away", [ExitCode.CHAIN, ExitCode.STORE])
def test_a_node_or_a_store_that_is_away_is_waited_for_however_long(away: ExitCode):
    restarts = Restarts()
    pauses = [restarts.ended("submitter", away, 0.1) for _ in range(100)]
    assert None not in pauses
    assert pauses[-1] == LONGEST_PAUSE


def test_what_is_not_vital_is_tried_for_ever():
    restarts = Restarts()
    pauses = [restarts.ended("monitor", 1, 0.1, vital=False) for _ in range(100)]
    assert None not in pauses and pauses[-1] == LONGEST_PAUSE
