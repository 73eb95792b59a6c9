"""What a process counts: served at /metrics, and in a file where `status` finds it, also of one that was killed."""

from __future__ import annotations

import contextlib
import http.client
import os
import time
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from prometheus_client.parser import text_string_to_metric_families

from bridge.disks import fill_up, small_disk
from ports import free_port
from rosbridge_eth.config.values import Address
from rosbridge_eth.errors import ConfigError, NetworkError
from rosbridge_eth.server import metrics


def ask(address: Address) -> tuple[int, str]:
    with contextlib.closing(http.client.HTTPConnection(*address, timeout=5)) as connection:
        connection.request("GET", "/metrics")
        answer = connection.getresponse()
        return answer.status, answer.read().decode()


@pytest.mark.parametrize("host", ["127.0.0.1", "::1"])
def test_the_figures_are_served_as_long_as_the_process_runs(host: str):
    address = Address(host, free_port())
    metrics.show([("captured", {"robot": "robot_1"}, 3)])
    try:
        with metrics.served(address):
            status, body = ask(address)
            assert status == 200
            [sample] = [sample for family in text_string_to_metric_families(body) for sample in family.samples]
            assert (sample.name, sample.labels, sample.value) == ("rosbridge_eth_captured", {"robot": "robot_1"}, 3.0)
            with pytest.raises(NetworkError, match="correct `monitor`"), metrics.served(address):
                pass
    except NetworkError:
        assert host == "::1", "a machine without IPv6"
        return
    with pytest.raises(OSError, match="refused"):
        ask(address)
    with metrics.served(None):
        pass


def test_without_the_package_one_sentence_says_how_to_get_it(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(metrics, "find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=r"pip install '.*\[metrics\]'"), metrics.served(Address("127.0.0.1", 0)):
        pass
    with metrics.served(None):
        pass


def test_a_home_shows_the_figures_of_each_of_its_processes_and_which_were_killed(tmp_path: Path):
    metrics.show([("captured", {"robot": "robot_1"}, 7)])
    for process in ("shard-0", "shard-1"):
        metrics.save(metrics.file_of(tmp_path, process))
    before = time.time() - metrics.SILENCE - 1
    os.utime(metrics.file_of(tmp_path, "shard-1"), (before, before))
    assert metrics.running(tmp_path) == {"shard-0": [("captured", {"robot": "robot_1"}, 7.0)], "shard-1": None}


def test_what_hangs_and_what_does_not_hold_are_named():
    metrics.show([("beat_seconds", {"process": "shard-0"}, 1000.0)])
    metrics.show([("beat_seconds", {"process": "shard-0 submitter"}, 1000.0 - metrics.SILENCE)])
    metrics.show([("condition", {"process": "shard-0", "name": "node answers"}, 1)])
    metrics.show([("condition", {"process": "shard-0", "name": "disk has room"}, 0)])
    assert metrics.failing(metrics.figures()) == ["shard-0: disk has room"]
    metrics.show([("beat_seconds", {"process": "shard-0"}, 1001.0)])
    assert metrics.failing(metrics.figures()) == ["shard-0 submitter works", "shard-0: disk has room"]


@pytest.mark.service
def test_on_a_full_disk_a_process_is_still_seen_to_run(tmp_path: Path):
    with small_disk(tmp_path / "disk", "1m") as disk:
        file = metrics.file_of(disk, "shard-0")
        metrics.show([("captured", {"robot": "robot_1"}, 7)])
        metrics.save(file)
        os.utime(file, (1.0, 1.0))
        assert metrics.running(disk) == {"shard-0": None}
        fill_up(disk)
        metrics.save(file)
        assert metrics.running(disk) == {"shard-0": [("captured", {"robot": "robot_1"}, 7.0)]}
        assert [each.name for each in disk.glob(".*")] == [file.name], "nothing half written is left"


def test_a_robots_file_in_a_folder_that_is_gone_is_no_trouble(tmp_path: Path):
    metrics.save(tmp_path / "absent" / ".robot.json")
    assert metrics.running(tmp_path / "absent") == {}


def test_figures_are_due_at_a_steady_pace():
    now = [0.0]
    beats = metrics.Beats(2.0, lambda: now[0])
    due = []
    for step in range(12):
        now[0] = step / 2
        due.append(beats.due())
    assert [step / 2 for step, so in enumerate(due) if so] == [0.0, 2.0, 4.0]


def test_how_fast_a_count_grows_is_what_it_grew_by_in_the_last_ten_looks():
    rates = metrics.Rates()
    assert rates.of("a", 100, 0.0) == 0.0
    assert [rates.of("a", 100 + 5 * second, second) for second in range(1, 30)] == [5.0] * 29
    assert rates.of("a", 245, 30) == 4.5 and rates.of("b", 7, 30) == 0.0


def test_a_robot_that_changes_its_address_without_end_has_one_figure(monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(metrics, "FIGURES", {})
    places = iter([("192.0.2.1", 1), ("192.0.2.1", 2), *((f"198.51.100.{number}", 1) for number in range(99))])
    session = SimpleNamespace(peer=SimpleNamespace(name="roaming"), connection=b"c")
    reception = SimpleNamespace(
        server=SimpleNamespace(statistics=dict, address_of=lambda connection: next(places)), counts={}, records={},
        forked={}, sessions={b"c": session}, trouble=SimpleNamespace(why=None),
    )  # fmt: skip
    worker: Any = SimpleNamespace(reception=reception, loop=SimpleNamespace(lost_sends=0))
    for wall in range(101):
        metrics.show(metrics.of_worker("shard-0", worker, float(wall)))
    seen = [(labels, value) for name, labels, value in metrics.figures() if name == "session_seen_seconds"]
    assert seen == [({"robot": "roaming", "address": "198.51.100.98"}, 100.0)]
