"""Snapshots of many processes in one place: what is shown, what is healthy, what is ready."""

from __future__ import annotations

import os

import pytest
from prometheus_client.parser import text_string_to_metric_families

from rosbridge_eth.operations.board import SILENCE, Board, Pace, Wire
from rosbridge_eth.operations.figures import (
    LATENCIES,
    METRICS,
    Condition,
    Histogram,
    Kind,
    Sample,
    Snapshot,
    histogram,
    sample,
)
from rosbridge_eth.operations.web import render


class Clock:
    def __init__(self) -> None:
        self.now = 100.0

    def __call__(self) -> float:
        return self.now


def full() -> Snapshot:
    """A snapshot with one sample of every metric there is."""
    latencies = Histogram()
    for seconds in (0.004, 0.01, 0.3, 5000.0):
        latencies.observe(seconds)
    return Snapshot.of(
        "worker-0",
        [
            histogram(name, latencies) if metric.kind is Kind.HISTOGRAM
            else sample(name, 7, *(f"a {label}" for label in metric.labels))
            for name, metric in METRICS.items()
        ],
        [Condition("all is well", True), Condition("all is said", False, 'it is "not";\nnot at all')],
    )


def shown(board: Board) -> dict[tuple[str, tuple[tuple[str, str], ...]], float]:
    """What a Prometheus server reads, by Prometheus' own parser."""
    return {
        (one.name, tuple(sorted(one.labels.items()))): one.value
        for family in text_string_to_metric_families(render(board).decode())
        for one in family.samples
    }


def test_a_snapshot_survives_its_datagram():
    assert Snapshot.decode(full().encode()) == full()


def test_every_metric_reaches_a_prometheus_parser_under_its_conventional_name():
    board = Board(["worker-0"])
    board.put(full())
    names = {name for name, _ in shown(board)}
    for metric in METRICS.values():
        expected = {metric.shown + end for end in ("_bucket", "_count", "_sum")} \
            if metric.kind is Kind.HISTOGRAM else {metric.shown}
        assert expected <= names, metric
        assert not metric.name.endswith("_total"), "the suffix is added"
        assert metric.help.endswith(".")


def test_processes_stand_side_by_side_and_the_newest_snapshot_counts():
    board = Board(["worker-0", "worker-1"])
    board.put(Snapshot.of("worker-0", [sample("records", 5, "stored")]))
    board.put(Snapshot.of("worker-1", [sample("records", 11, "stored")]))
    board.put(Snapshot.of("worker-0", [sample("records", 6, "stored")]))
    read = shown(board)
    assert read["rosbridge_eth_records_total", (("outcome", "stored"), ("process", "worker-0"))] == 6
    assert read["rosbridge_eth_records_total", (("outcome", "stored"), ("process", "worker-1"))] == 11


def test_buckets_are_cumulative_and_bounds_belong_to_the_bucket_below():
    values = Histogram()
    for seconds in (-1.0, LATENCIES[0], LATENCIES[0] + 1e-9, LATENCIES[-1], LATENCIES[-1] + 1):
        values.observe(seconds)
    buckets = dict(values.buckets())
    assert buckets[str(LATENCIES[0])] == 2  # 0.01 is "less or equal 0.01"; what is negative counts as 0
    assert buckets[str(LATENCIES[1])] == 3
    assert buckets[str(LATENCIES[-1])] == 4
    assert buckets["+Inf"] == 5
    assert values.sum == pytest.approx(2 * LATENCIES[0] + 2 * LATENCIES[-1] + 1, abs=1e-6)


@pytest.mark.parametrize("labels", [(), ("stored", "more")])
def test_a_sample_with_other_labels_than_its_metric_is_refused(labels: tuple[str, ...]):
    with pytest.raises(ValueError, match="records has the labels"):
        Sample("records", 1.0, labels)


def test_health_needs_every_expected_process_within_the_limit_of_silence():
    clock = Clock()
    board = Board(["worker-0", "submitter"], clock=clock)
    assert all(condition.holds for condition in board.health()), "it has just been started"
    clock.now += SILENCE + 1
    assert not any(condition.holds for condition in board.health())
    board.put(Snapshot.of("worker-0", []))
    assert {c.name: c.holds for c in board.health()} == {"process worker-0": True, "process submitter": False}
    board.put(Snapshot.of("submitter", []))
    assert all(condition.holds for condition in board.health())
    clock.now += SILENCE + 1
    assert [c.says for c in board.health() if not c.holds] == ["silent for 16 s"] * 2


def test_readiness_waits_for_everyones_first_word_and_for_every_condition():
    clock = Clock()
    board = Board(["worker-0"], ["node"], clock=clock)
    board.put(Snapshot.of("worker-0", [], [Condition("worker-0 stores records", True)]))
    assert [c.name for c in board.readiness() if not c.holds] == ["node"]
    board.put(Snapshot.of("node", [], [Condition("node answers", False, "refused")]))
    assert [(c.name, c.says) for c in board.readiness() if not c.holds] == [("node answers", "refused")]
    board.put(Snapshot.of("node", [], [Condition("node answers", True)]))
    assert all(c.holds for c in board.readiness())
    clock.now += SILENCE + 1
    board.put(Snapshot.of("worker-0", []))
    assert [c.name for c in board.readiness() if not c.holds] == ["news of the node"]
    assert all(c.holds for c in board.health()), "a node that hangs is no reason to start the server again"


def test_snapshots_cross_from_a_forked_process():
    wire = Wire()
    child = os.fork()
    if child == 0:
        wire.publish(full())
        os._exit(0)
    try:
        assert wire.receive(5.0) == full()
        assert wire.receive(0.01) is None
    finally:
        os.waitpid(child, 0)
        wire.close()


def test_a_wire_that_nobody_reads_holds_nobody_up():
    wire = Wire()
    try:
        for _ in range(10_000):
            wire.publish(full())
        assert wire.lost > 0
        assert wire.receive(1.0) == full()
    finally:
        wire.close()


def test_a_pace_is_due_at_once_and_then_once_per_interval():
    pace = Pace(1.0)
    assert [now for now in (0.0, 0.5, 0.99, 1.0, 1.5, 2.5, 3.4, 3.5) if pace.due(now)] == [0.0, 1.0, 2.5, 3.5]
