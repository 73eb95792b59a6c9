"""The HTTP end: three paths, verdicts as status codes, and clients that dawdle or lie."""

from __future__ import annotations

import contextlib
import http.client
import json
import multiprocessing
import os
import socket
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest
from prometheus_client import generate_latest
from prometheus_client.parser import text_string_to_metric_families

from rosbridge_eth.config.values import Address
from rosbridge_eth.errors import NetworkError
from rosbridge_eth.server import metrics
from rosbridge_eth.server.metrics import Web

SLOW = 16


@pytest.fixture
def web() -> Iterator[Web]:
    made = Web(Address("127.0.0.1", 0), ["robot"])
    metrics.beat("robot", time.time())
    metrics.CONDITION.labels("robot has a session").set(1)
    metrics.CAPTURED.labels("robot_1").set(3)
    made.start()
    yield made
    made.stop()
    metrics.CONDITION.clear()
    metrics.BEAT.clear()


def ask(web: Web, path: str, method: str = "GET") -> tuple[int, bytes]:
    with contextlib.closing(http.client.HTTPConnection(*web.address, timeout=5)) as connection:
        connection.request(method, path)
        answer = connection.getresponse()
        return answer.status, answer.read()


def test_metrics_health_and_readiness_are_served(web: Web):
    status, body = ask(web, "/metrics")
    assert status == 200 and b'rosbridge_eth_captured{robot="robot_1"} 3.0' in body
    assert ask(web, "/healthz")[0] == 200
    status, body = ask(web, "/readyz?verbose=1")
    assert status == 200 and json.loads(body)["ok"] is True


def test_what_does_not_hold_is_503_with_its_name(web: Web):
    metrics.CONDITION.labels("robot has a session").set(0)
    status, body = ask(web, "/readyz")
    assert status == 503 and json.loads(body)["conditions"]["robot has a session"] is False
    assert ask(web, "/healthz")[0] == 200, "it is well, and waits"


def test_a_process_that_fell_silent_is_unhealthy(web: Web):
    metrics.beat("robot", time.time() - metrics.SILENCE - 1)
    status, body = ask(web, "/healthz")
    assert status == 503 and json.loads(body)["conditions"] == {"robot runs": False}
    metrics.BEAT.clear()
    assert ask(web, "/healthz")[0] == 503, "one that never was there too"


@pytest.mark.parametrize("path", ["/", "/metrics/", "/../metrics", "//x/metrics", "/" + "a" * 60_000])
def test_there_is_nothing_else(web: Web, path: str):
    assert ask(web, path)[0] == 404


@pytest.mark.parametrize("method", ["POST", "PUT", "DELETE", "OPTIONS"])
def test_nothing_can_be_written(web: Web, method: str):
    assert ask(web, "/metrics", method)[0] == 405


@pytest.mark.parametrize("said", [b"", b"GET /healthz HT", b"GET /healthz HTTP/1.1\r\nX: ", b"\x16\x03\x01 no HTTP"])
def test_slow_clients_silence_nobody_and_are_shut(web: Web, monkeypatch: pytest.MonkeyPatch, said: bytes):
    monkeypatch.setattr(metrics, "DEADLINE", 1.0)
    slow = [socket.create_connection(web.address, timeout=10) for _ in range(SLOW)]
    try:
        for sock in slow:
            sock.sendall(said)
        assert ask(web, "/healthz")[0] == 200
        for sock in slow:  # a byte every now and then does not help
            with contextlib.suppress(OSError):
                sock.sendall(b"x")
        for sock in slow:
            with contextlib.suppress(ConnectionResetError):
                while sock.recv(4096):
                    continue
        assert ask(web, "/healthz")[0] == 200
    finally:
        for sock in slow:
            sock.close()


def test_a_port_that_is_taken_is_an_error_that_names_the_key(web: Web):
    with pytest.raises(NetworkError, match="correct `monitor`"):
        Web(web.address, [])


def test_it_is_started_in_a_process_that_was_forked_since():
    made = Web(Address("127.0.0.1", 0), [])
    child = multiprocessing.get_context("fork").Process(target=made.start)  # as the server starts its monitor
    child.start()
    child.join(30)
    assert child.exitcode == 0


def test_it_listens_on_ipv6_too():
    try:
        made = Web(Address("::1", 0), [])
    except NetworkError:
        pytest.skip("this machine has no IPv6")
    made.start()
    assert str(made.address) == f"[::1]:{made.address.port}" != "[::1]:0", "as a browser takes it"
    made.stop()


def test_nothing_is_shown_before_somebody_has_said_it():
    script = (
        "from prometheus_client import generate_latest; from rosbridge_eth import metrics;"
        " print(generate_latest(metrics.collected()).decode())"
    )
    shown = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True,
                           env={**os.environ, "PYTHONPATH": str(Path(metrics.__file__).parents[1])}).stdout
    samples = [sample for family in text_string_to_metric_families(shown) for sample in family.samples]
    assert samples == [], "a server that has no robot's figures rings no robot's alarm"


def test_a_home_leads_to_the_figures_while_it_runs_and_nothing_is_left_of_that(tmp_path: Path):
    """A server in this very process must not change what is shown after it."""
    metrics.CAPTURED.labels("before").set(1)
    known = os.environ.get("PROMETHEUS_MULTIPROC_DIR")
    with metrics.shared(tmp_path):
        metrics.CAPTURED.labels("robot_1").set(7)
        folder = (tmp_path / ".figures").resolve()
        assert folder.stat().st_mode & 0o077 == 0
        assert metrics.figures(tmp_path) == [("captured", {"robot": "robot_1"}, 7.0)]
    assert not folder.exists() and not any(tmp_path.iterdir())
    assert os.environ.get("PROMETHEUS_MULTIPROC_DIR") == known
    assert metrics.collected() is metrics.REGISTRY
    metrics.CAPTURED.labels("robot_1").set(8)
    assert "rosbridge_eth_captured" in generate_latest(metrics.REGISTRY).decode()
    with pytest.raises(ValueError):
        metrics.figures(tmp_path)


def test_what_a_killed_process_left_is_removed_and_a_home_that_takes_no_link_is_no_trouble(tmp_path: Path):
    left = tmp_path / "rosbridge-eth-left"
    left.mkdir()
    (tmp_path / ".figures").symlink_to(left)
    with metrics.shared(tmp_path):
        assert not left.exists() and (tmp_path / ".figures").resolve().is_dir()
    with metrics.shared(tmp_path / "absent"):
        metrics.CAPTURED.labels("robot_1").set(7)
        assert 'rosbridge_eth_captured{robot="robot_1"} 7.0' in generate_latest(metrics.collected()).decode()


def test_processes_share_their_figures_by_a_folder(tmp_path: Path):
    """A worker that is killed and started again goes on under its name; the newest word of several holds."""
    environment = {**os.environ, "PYTHONPATH": str(Path(metrics.__file__).parents[1]),
                   "PROMETHEUS_MULTIPROC_DIR": str(tmp_path)}  # fmt: skip
    say = "from rosbridge_eth import metrics as m; m.beat('worker-0', {0}); m.SESSION.labels('robot_1', 'a').set({0})"
    for moment in (10, 20, 15):
        subprocess.run([sys.executable, "-c", say.format(moment)], check=True, env=environment)
    script = (
        "from prometheus_client import generate_latest; from rosbridge_eth import metrics as m;"
        " print(generate_latest(m.collected()).decode()); print(dict(m.conditions(m.collected(), ['worker-0'], 16)))"
    )
    shown = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True, env=environment)
    assert 'rosbridge_eth_beat_seconds{process="worker-0"} 15.0' in shown.stdout
    assert shown.stdout.count("rosbridge_eth_session_seen_seconds{") == 1
    assert "{'worker-0 runs': True}" in shown.stdout


def test_figures_end_with_their_process_when_the_next_one_is_started(tmp_path: Path):
    with metrics.shared(tmp_path):
        metrics.beat("worker-1", 1.0)
        say = "from rosbridge_eth import metrics as m; m.RATE.labels('worker-0', 'robot_1').set(10)"
        worker = subprocess.Popen([sys.executable, "-c", say])
        assert worker.wait(30) == 0
        assert ("records_per_second", {"process": "worker-0", "robot": "robot_1"}, 10) in metrics.figures(tmp_path)
        metrics.forget_process(worker.pid)
        assert metrics.figures(tmp_path) == [("beat_seconds", {"process": "worker-1"}, 1.0)]


def test_figures_of_a_process_that_is_just_making_its_file_are_read_when_it_has_them(tmp_path: Path) -> None:
    with metrics.shared(tmp_path):
        metrics.beat("worker-0", 1.0)
        made = tmp_path / metrics._LINK / "gauge_max_4711.db"
        made.touch()
        with pytest.raises(ValueError, match="cut off"):
            metrics.figures(tmp_path)
        threading.Timer(0.2, made.unlink).start()
        assert metrics.figures(tmp_path)
