"""Many robots at once against the real processes: benchmarks/load.py with fewer of them.

Every session has its own identity, spool, socket and account. What is asserted is what a reader finds on the chain at
the end.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

import load
from rosbridge_eth.channel import ServerConfig
from rosbridge_eth.server import shard

SESSIONS, MESSAGES = 24, 5


@pytest.mark.slow
@pytest.mark.parametrize("store, per_chunk", [("sqlite", 1), ("redis", 5)])
def test_every_record_of_many_robots_is_on_the_chain_once(
    store: str, per_chunk: int, tmp_path: Path, require: Callable[[str], str]
) -> None:
    if store == "redis":
        require("redis-server")
    operator = load.Operator(tmp_path, "embedded", store, SESSIONS, lambda stage: None)
    try:
        figures = load.run(operator, SESSIONS, MESSAGES, per_chunk=per_chunk, limit=120)
    finally:
        operator.close()
    print(load.table([[figures]]))
    assert figures.established == SESSIONS
    assert figures.chunks == figures.stored == figures.on_chain == SESSIONS * MESSAGES / per_chunk
    assert figures.equal == SESSIONS * MESSAGES
    assert (figures.lost, figures.doubled, figures.altered, figures.unsound) == (0, 0, 0, [])
    # A session's own keys, certificates and windows, beside what a shard loads as it starts to work.
    assert figures.growth_kib_per_session * SESSIONS < 32 * 1024 + SESSIONS * 256


@pytest.mark.slow
def test_more_robots_than_their_address_may_fail_at_once_wait_and_get_in(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The caps on strangers delay honest robots behind one address, and keep none of them out."""
    monkeypatch.setattr(shard, "ServerConfig", partial(ServerConfig, max_half_open=4))
    operator = load.Operator(tmp_path, "embedded", "sqlite", 24, lambda stage: None)
    try:
        figures = load.run(operator, 24, 2, limit=120)
    finally:
        operator.close()
    assert sum(figures.dropped.values()) > 0  # the caps were reached, or nothing was tested
    assert (figures.established, figures.stored, figures.lost, figures.doubled) == (24, 48, 0, 0)
    assert figures.equal == 48
