"""When the server starts a process again: at growing intervals, not for ever, patiently where others are to blame."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from collections.abc import Callable
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

import rosbridge_eth
from bridge.operations.conftest import Place
from rosbridge_eth.channel.udp import server_sockets
from rosbridge_eth.cli import run
from rosbridge_eth.config import Address, load_server_config
from rosbridge_eth.errors import ExitCode, NetworkError, ProcessError, StoreError
from rosbridge_eth.log.chunk import Log, robot_id
from rosbridge_eth.robot.spool import Spool
from rosbridge_eth.server import metrics, supervisor
from rosbridge_eth.server.supervisor import (
    GIVE_UP_AFTER,
    LONGEST_PAUSE,
    MONITOR,
    PATIENT,
    SHORT_LIFE,
    SUBMITTER,
    Supervisor,
    notify,
    worker_name,
)

Pause = Callable[[str, int | None, float], float]


@pytest.fixture
def pause(place: Place) -> Pause:
    """How long a supervisor waits before it starts a process again: name, exit code, how long it lived."""
    secrets: Any = None
    return Supervisor(place.operator, load_server_config(place.operator.config), secrets)._pause


def test_pauses_grow_and_then_it_is_given_up(pause: Pause):
    given = [pause("worker-0", 1, 0.1) for _ in range(GIVE_UP_AFTER - 1)]
    assert given == sorted(given) and len(set(given)) == len(given)
    assert sum(given) < 60
    with pytest.raises(ProcessError, match="worker-0 ends with exit code 1"):
        pause("worker-0", 1, 0.1)


def test_a_process_that_worked_for_a_while_begins_anew(pause: Pause):
    first = pause("worker-0", -9, SHORT_LIFE + 1)
    for _ in range(3 * GIVE_UP_AFTER):
        assert pause("worker-0", -9, SHORT_LIFE + 100) == first


def test_a_long_life_between_short_ones_counts_for_a_fresh_start(pause: Pause):
    for _ in range(10):
        for _ in range(GIVE_UP_AFTER - 1):
            pause(SUBMITTER, 1, 0.0)
        pause(SUBMITTER, 1, SHORT_LIFE + 1)


def test_processes_are_counted_apart(pause: Pause):
    for _ in range(GIVE_UP_AFTER - 1):
        pause("worker-0", 1, 0.0)
    pause("worker-1", 1, 0.0)
    with pytest.raises(ProcessError):
        pause("worker-0", 1, 0.0)


@pytest.mark.parametrize("name, code", [("submitter", code) for code in sorted(PATIENT)] + [(MONITOR, 1)])
def test_what_others_are_to_blame_for_and_what_is_not_vital_is_tried_for_ever(pause: Pause, name: str, code: int):
    given = [pause(name, code, 0.1) for _ in range(100)]
    assert given[-1] == max(given) == LONGEST_PAUSE
    assert {ExitCode.CHAIN, ExitCode.STORE} == PATIENT


def test_who_starts_a_second_one_by_mistake_leaves_the_first_its_figures(
    place: Place, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    """Without them the first would count as dead, and its next child find no folder to count in."""
    secrets: Any = None
    monkeypatch.setattr(Supervisor, "_check", lambda *_: None)
    with metrics.shared(place.operator.path), closing(server_sockets(Address("127.0.0.1", 0))[0]) as door:
        metrics.beat("submitter", 1.0)
        place.configure('listen = "127.0.0.1:0"', f'listen = "127.0.0.1:{door.getsockname()[1]}"')
        with pytest.raises(NetworkError, match="in use"):
            Supervisor(place.operator, load_server_config(place.operator.config), secrets).run()
        assert metrics.figures(place.operator.path) == [("beat_seconds", {"process": "submitter"}, 1.0)]
    place.robot.config.write_text('topics = ["/robot_1/odom"]\n[source]\nkind = "sim"\n')
    log = Log(place.robot.bridge().ledger, robot_id("robot_1"))
    with metrics.shared(place.robot.path), closing(
        Spool(place.robot.spool, log, max_bytes=2**20, drop=lambda chunk: chunk)
    ):
        metrics.beat("robot", 1.0)
        assert run(["robot", "--password-file", "word"]) == ExitCode.STORE
        assert "in use" in capsys.readouterr().err
        assert metrics.figures(place.robot.path) == [("beat_seconds", {"process": "robot"}, 1.0)]


def test_the_submitter_asks_as_seldom_as_it_says_and_is_seen_meanwhile(place: Place, monkeypatch: pytest.MonkeyPatch):
    secrets, clock, turns, seen = SimpleNamespace(keys=None), [100.0], list[float](), list[float]()

    def sleep(seconds: float) -> None:
        clock[0] += seconds
        if clock[0] >= 150:
            raise KeyboardInterrupt

    def turn(now: float) -> float:
        turns.append(now)
        if now == 110:
            raise StoreError("away")
        return 10.0 if now < 120 else 30.0

    submitter = SimpleNamespace(turn=turn, trouble=None, unconfirmed=None, funds=None)
    patched = SimpleNamespace(monotonic=lambda: clock[0], time=lambda: clock[0], sleep=sleep)
    monkeypatch.setattr(supervisor, "time", patched)
    monkeypatch.setattr(supervisor, "open_submitter", lambda *_: submitter)
    monkeypatch.setattr(metrics, "show_submitter", lambda *given: seen.append(given[-1]))
    server: Any = Supervisor(place.operator, load_server_config(place.operator.config), secrets)  # type: ignore[arg-type]
    server._pid, handler = os.getppid(), signal.getsignal(signal.SIGTERM)
    with pytest.raises(KeyboardInterrupt):
        server._submit()
    signal.signal(signal.SIGTERM, handler)
    assert turns == [100, 110, 111, 121]
    assert seen == [float(second) for second in range(100, 150) if second != 110]


def test_workers_that_were_given_at_the_start_are_no_change_of_the_file(place: Place, caplog: pytest.LogCaptureFixture):
    secrets: Any = None
    server = Supervisor(place.operator, load_server_config(place.operator.config), secrets, workers=3)
    server._check = lambda config: None  # type: ignore[method-assign]
    server._read_again({})
    assert "reloaded" in caplog.text and "next start" not in caplog.text


def test_workers_are_named_by_their_numbers():
    assert [worker_name(number) for number in (0, 11)] == ["worker-0", "worker-11"]


@pytest.mark.parametrize("abstract", [False, True])
def test_the_service_manager_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, abstract: bool):
    import socket

    name = f"@rosbridge-eth-{os.getpid()}" if abstract else str(tmp_path / "notify")
    with socket.socket(socket.AF_UNIX, socket.SOCK_DGRAM) as manager:
        manager.bind("\0" + name[1:] if abstract else name)
        manager.settimeout(5)
        monkeypatch.setenv("NOTIFY_SOCKET", name)
        notify("READY=1")
        assert manager.recv(100) == b"READY=1"
    notify("WATCHDOG=1")  # the manager is gone
    monkeypatch.delenv("NOTIFY_SOCKET")
    notify("STOPPING=1")


CHILD = """
import os, signal, sys, time
from rosbridge_eth.server import supervisor
parent = supervisor.Supervisor.__new__(supervisor.Supervisor)
parent._pid = os.getpid()
signal.signal(signal.SIGTERM, lambda number, frame: print("the parent's own", flush=True))

def slow() -> None:
    os.write(1, b"forked\\n")  # at once, whole
    time.sleep(60)

def good() -> None:
    asked = supervisor._terminated(parent._pid)
    os.write(1, b"forked\\n")  # at once, whole
    while not asked():
        time.sleep(0.02)

process = supervisor._FORK.Process(target=supervisor._child, args=("x", 1, {"slow": slow, "good": good}[sys.argv[1]]))
process.start()
os.write(1, b"%d\\n" % process.pid)
process.join(30)
print("code", process.exitcode, flush=True)
"""


@pytest.mark.parametrize("task, ends", [("slow", "code -15"), ("good", "code 0")])
def test_a_child_ends_when_it_is_asked_to_whatever_it_is_doing(task: str, ends: str):
    """Between the fork and its own handler it has the parent's, which would only tell the copy of the parent."""
    source = str(Path(rosbridge_eth.__file__).parents[1])
    process = subprocess.Popen([sys.executable, "-c", CHILD, task], stdout=subprocess.PIPE, text=True,
                               env={**os.environ, "PYTHONPATH": source})  # fmt: skip
    assert process.stdout is not None
    said = [process.stdout.readline().strip() for _ in range(2)]
    pid = int(next(line for line in said if line.isdigit()))
    for ignored in (signal.SIGHUP, signal.SIGINT):
        os.kill(pid, ignored)
    time.sleep(0.1)
    os.kill(pid, signal.SIGTERM)
    out, _ = process.communicate(timeout=40)
    assert ends in out and "the parent's own" not in out
