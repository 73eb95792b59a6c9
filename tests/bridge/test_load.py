"""Many robots at once against the real processes: benchmarks/load.py with fewer of them.

Every session has its own identity, socket and account; two workers share the
port. What is asserted is what the chain holds at the end.
"""

from __future__ import annotations

import pytest

from bridge.load_script import load_script

SESSIONS, MESSAGES, WORKERS = 80, 10, 2
load = load_script("load")


@pytest.mark.slow
@pytest.mark.parametrize("store", ["sqlite", "redis"])
def test_every_record_of_many_robots_is_on_the_chain_once(store, tmp_path, require):
    if store == "redis":
        require("redis-server")
    operator = load.Operator(tmp_path, "embedded", store, SESSIONS, lambda stage: None)
    try:
        figures = load.run(operator, SESSIONS, MESSAGES, workers=WORKERS, limit=120)
    finally:
        operator.close()
    print(load.table([figures]))
    assert figures.established == SESSIONS
    assert figures.sent == figures.stored == figures.on_chain == SESSIONS * MESSAGES
    assert (figures.lost, figures.doubled, figures.altered) == (0, 0, 0)
    # A session's own 2 x 32 places of packet numbers, keys and certificates, beside what a worker loads as it starts
    # to work; the messages under way have a bound of their own ([limits] memory).
    assert figures.growth_kib_per_session * SESSIONS < WORKERS * 16 * 1024 + SESSIONS * 256


@pytest.mark.slow
def test_more_robots_than_places_for_handshakes_wait_and_get_in(tmp_path):
    """The caps on strangers delay honest robots behind one address, and keep none of them out."""
    operator = load.Operator(tmp_path, "embedded", "sqlite", 40, lambda stage: None)
    with operator.home.config.open("a") as file:
        file.write("\n[limits]\nhalf_open = 4\nsource_burst = 3.0\nsource_rate = 1.0\n")
    operator.config = load.load_server_config(operator.home.config)
    try:
        figures = load.run(operator, 40, 2, workers=1, limit=120)
    finally:
        operator.close()
    assert sum(figures.dropped.values()) > 0  # the caps were reached, or nothing was tested
    assert (figures.established, figures.stored, figures.lost, figures.doubled) == (40, 80, 0, 0)
