"""One submitter at a time, and the next one at once; times that do not follow a clock that is set."""

from __future__ import annotations

import multiprocessing
import os
import signal
import time
from multiprocessing.connection import Connection
from pathlib import Path

import pytest

from rosbridge_eth.errors import StoreError
from rosbridge_eth.server.sole import sole_submitter
from rosbridge_eth.server.submission import steady_clock

FORK = multiprocessing.get_context("fork")


def hold(lock: Path, say: Connection) -> None:
    with sole_submitter(lock, lambda: False) as name:
        say.send(name)
        signal.pause()


def started(lock: Path) -> tuple[multiprocessing.process.BaseProcess, str]:
    here, there = FORK.Pipe()
    process = FORK.Process(target=hold, args=(lock, there))
    process.start()
    assert here.poll(20), "the lock is not taken over"
    return process, here.recv()


def test_the_next_submitter_takes_over_at_once_when_one_is_killed(tmp_path: Path) -> None:
    lock = tmp_path / "submitter.lock"
    first, name = started(lock)
    looks = iter([False, False, True])
    with sole_submitter(lock, lambda: next(looks)) as refused:
        assert refused is None
    assert first.pid is not None
    os.kill(first.pid, signal.SIGKILL)
    first.join()
    second, same = started(lock)
    assert same == name
    second.kill()
    second.join()


def test_a_lock_that_cannot_be_made_is_said(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match="cannot be opened"), sole_submitter(tmp_path / "no" / "lock", lambda: False):
        pass


@pytest.mark.parametrize("jump", [-86_400.0, 86_400.0])
def test_a_clock_that_is_set_does_not_move_the_submitters(monkeypatch: pytest.MonkeyPatch, jump: float) -> None:
    true = time.time
    clock = steady_clock()
    before = clock()
    assert abs(before - true()) < 60
    monkeypatch.setattr(time, "time", lambda: true() + jump)
    assert 0 <= clock() - before < 60
