"""Faults in the real processes: whatever fails, every chunk is on the chain exactly once or is where it can be found.

benchmarks/faults.py has the processes, the faults and the account. One run of
each by default, the lone kills as parts of `several`; FAULTS=all runs every
fault by itself, FAULTS_SEED repeats a run, FAULTS_ROUNDS=N runs each N times.
"""

from __future__ import annotations

import os
import random
from collections.abc import Iterator
from contextlib import ExitStack

import pytest

import faults
from conftest import unavailable

IN_SEVERAL = {"robot", "shard", "network"}
CHOSEN = [name for name in faults.FAULTS if os.environ.get("FAULTS") == "all" or name not in IN_SEVERAL]
SEED = int(os.environ.get("FAULTS_SEED") or random.SystemRandom().randrange(1 << 31))
ROUNDS = int(os.environ.get("FAULTS_ROUNDS", "1"))

pytestmark = [pytest.mark.service, pytest.mark.slow]


@pytest.fixture(scope="module")
def sites(tmp_path_factory: pytest.TempPathFactory) -> Iterator[dict[bool, object]]:
    """The site with the inbox in SQLite, and the one with the inbox in Redis, opened when they are first used."""
    with ExitStack() as stack:

        class Sites(dict[bool, object]):
            def __missing__(self, redis: bool) -> object:
                folder = tmp_path_factory.mktemp("site")
                self[redis] = stack.enter_context(faults.open_site(folder, redis=redis))
                return self[redis]

        yield Sites()


@pytest.mark.parametrize("number", range(ROUNDS))
@pytest.mark.parametrize("name", CHOSEN)
def test_every_chunk_is_on_the_chain_once_or_is_kept(sites: dict[bool, object], name: str, number: int) -> None:
    print(f"FAULTS_SEED={SEED}")
    try:
        count = faults.FAULTS[name](sites[name in faults.ON_REDIS], SEED + number)
    except faults.Unavailable as reason:
        unavailable(str(reason))
    print(faults.table([count]), *count.events, sep="\n")
    assert count.injected > 0
    assert (count.missing, count.doubled, count.altered) == (0, 0, 0), count
    assert count.findings == [], count
    if name == "revoked":
        assert 0 < count.on_chain < count.sealed
        assert 0 < count.records < faults.MESSAGES
    else:
        assert count.sealed == count.on_chain + count.declared
        assert (count.declared > 0) == (name == "twins")
        assert count.records >= faults.MESSAGES  # a life that ran to its end said all of the bag


def test_the_report_is_a_table_of_what_was_counted() -> None:
    count = faults.Count("robot killed", 7, injected=2, lives=3, sealed=32, acknowledged=30, on_chain=31, missing=1)
    heads, row = faults.table([count]).splitlines()
    assert heads.split()[:6] == ["fault", "times", "lives", "sealed", "acked", "on"]
    assert row.split() == ["robot", "killed", "2", "3", "32", "30", "31", "0", "0", "1", *"0000", "0"]
