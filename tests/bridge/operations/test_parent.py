"""The parent of the shards: what it checks, when it starts one again, how children end; and a shard's two halves."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import threading
import time
from contextlib import closing
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

import rosbridge_eth
from bridge.operations.conftest import PASSPHRASE, PASSWORD, Place
from rosbridge_eth.channel.udp import UdpLoop, server_socket
from rosbridge_eth.cli import run
from rosbridge_eth.config import Address, load_robot_config, load_server_config
from rosbridge_eth.config.home import BridgeEnd, shard_of
from rosbridge_eth.errors import ConfigError, ExitCode, NetworkError, StoreError
from rosbridge_eth.log.chunk import Log, robot_id
from rosbridge_eth.operator.enrolment import load_server_identity
from rosbridge_eth.operator.registry import Registry
from rosbridge_eth.robot.loop import open_robot
from rosbridge_eth.robot.spool import Spool
from rosbridge_eth.server import metrics, parent
from rosbridge_eth.server.parent import Child, Parent, notify
from rosbridge_eth.server.reception import Worker
from rosbridge_eth.server.shard import Shard, open_reception, open_store, submit

SECRETS: Any = None


def test_what_is_due_is_started_and_what_ended_is_due_after_its_pause(place: Place, monkeypatch: pytest.MonkeyPatch):
    started: list[int] = []

    class Process:
        pid, exitcode, name = 1, -9, "shard"

        def __init__(self, target: object, args: tuple[Any, ...], name: str) -> None:
            self.alive, self.shard = True, args[2]

        def start(self) -> None:
            started.append(self.shard)

        def is_alive(self) -> bool:
            return self.alive

    monkeypatch.setattr(parent, "_FORK", SimpleNamespace(Process=Process))
    running, config = Parent(place.operator, SECRETS), SimpleNamespace(shards=2)
    running._children = {0: Child(), 1: Child()}
    running._look(config, 100.0)  # type: ignore[arg-type]
    assert started == [0, 1]
    running._children[1].process.alive = False  # type: ignore[union-attr]
    for moment, expected in ((100.2, [0, 1]), (102.1, [0, 1]), (102.3, [0, 1, 1]), (102.5, [0, 1, 1])):
        running._look(config, moment)  # type: ignore[arg-type]
        assert started == expected, moment
    assert [child.starts for child in running._children.values()] == [1, 2]


def test_who_starts_a_second_one_by_mistake_leaves_the_first_its_figures(
    place: Place, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    monkeypatch.setattr(parent.Ledger, "check", lambda ledger: None)
    metrics.show([("beat_seconds", {"process": "shard-0"}, 1.0)])
    metrics.save(metrics.file_of(place.operator.path, "shard-0"))
    with closing(server_socket(Address("127.0.0.1", 0))) as door:
        place.configure('listen = "127.0.0.1:0"', f'listen = "127.0.0.1:{door.getsockname()[1]}"')
        with pytest.raises(NetworkError, match="in use"):
            Parent(place.operator, SECRETS).run()
    assert metrics.running(place.operator.path)["shard-0"] == [("beat_seconds", {"process": "shard-0"}, 1.0)]
    place.robot.config.write_text('topics = ["/robot_1/odom"]\n[source]\nkind = "sim"\n')
    metrics.save(metrics.file_of(place.robot.path, "robot"))
    log = Log(place.robot.bridge().ledger, robot_id("robot_1"))
    with closing(Spool(place.robot.spool, log, max_bytes=2**20, drop=lambda chunk: chunk)):
        assert run(["robot", "--password-file", "word"]) == ExitCode.STORE
        assert "in use" in capsys.readouterr().err
    assert metrics.running(place.robot.path)["robot"]


@pytest.mark.parametrize("key, kind", [("listen", socket.SOCK_DGRAM), ("monitor", socket.SOCK_STREAM)])
def test_a_reload_that_names_a_port_that_is_taken_changes_nothing(
    place: Place, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture, key: str, kind: int
):
    begun: list[object] = []
    monkeypatch.setattr(parent.Ledger, "check", lambda ledger: None)
    monkeypatch.setattr(Parent, "_begin", lambda self, config: begun.append(config))
    before = place.operator.config.read_text().replace('listen = "127.0.0.1:0"\n', "")

    def configured(sock: socket.socket) -> None:
        addresses = {"listen": "127.0.0.1:0", key: f"127.0.0.1:{sock.getsockname()[1]}"}
        lines = "".join(f'{name} = "{address}"\n' for name, address in addresses.items())
        place.operator.config.write_text(lines + before)

    with socket.socket(socket.AF_INET, kind) as taken, socket.socket(socket.AF_INET, kind) as ours:
        for sock in (taken, ours):
            sock.bind(("127.0.0.1", 0))
            if kind == socket.SOCK_STREAM:
                sock.listen()
        configured(ours)
        config = load_server_config(place.operator.config)
        configured(taken)
        assert Parent(place.operator, SECRETS)._reload(config) is config and not begun
        assert "nothing is reloaded" in caplog.text and "in use" in caplog.text
        configured(ours)  # which the shards that run have, and give up
        assert [Parent(place.operator, SECRETS)._reload(config)] == begun == [config]


@pytest.mark.parametrize("text, only, says", [
    ("", [1], "there is no shard 1: .*shards = 1"),
    ('shards = 4\npublic = "0.0.0.0:7410"', [], "no machine can have"),
])  # fmt: skip
def test_shards_that_robots_could_not_find_are_not_started(place: Place, text: str, only: list[int], says: str):
    config = place.operator.config.read_text().replace('public = "127.0.0.1:9"', text)
    place.operator.config.write_text(config.replace('"127.0.0.1:0"', '"127.0.0.1:7410"'))
    with pytest.raises(ConfigError, match=says):
        Parent(place.operator, SECRETS, only).run()


def test_figures_of_shards_that_are_no_more_are_removed(place: Place, monkeypatch: pytest.MonkeyPatch):
    monkeypatch.setattr(Parent, "_look", lambda *_: None)
    for shard in range(4):
        metrics.save(metrics.file_of(place.operator.path, f"shard-{shard}"))
    Parent(place.operator, SECRETS)._begin(SimpleNamespace(shards=2))  # type: ignore[arg-type]
    assert list(metrics.running(place.operator.path)) == ["shard-0", "shard-1"]


def test_every_robot_has_one_shard_and_they_are_even():
    robots = [robot_id(f"robot_{number}") for number in range(4000)]
    for shards in (1, 2, 4, 64):
        counts = [sum(shard_of(tk, shards) == shard for tk in robots) for shard in range(shards)]
        assert sum(counts) == 4000 and max(counts) < 4000 / shards * 1.5


@pytest.mark.parametrize("abstract", [False, True])
def test_the_service_manager_is_told(tmp_path: Path, monkeypatch: pytest.MonkeyPatch, abstract: bool):
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


# A shard


class Clock(threading.Event):
    """The submitter's `stop`, which waits by a clock of its own, and is set after 50 seconds of it."""

    now = 100.0

    def wait(self, timeout: float | None = None) -> bool:
        self.now += timeout or 0.0
        if self.now >= 150:
            self.set()
        return self.is_set()


def test_the_submitter_asks_as_seldom_as_it_says_and_is_seen_meanwhile():
    stop, turns, seen = Clock(), list[float](), list[float]()

    def turn(now: float) -> float:
        turns.append(stop.now)
        if stop.now == 110:
            raise StoreError("away")
        return 10.0 if stop.now < 120 else 30.0

    submitter: Any = SimpleNamespace(turn=turn, trouble=None, unconfirmed=None, funds=None)
    submit(submitter, stop, lambda: seen.append(stop.now), lambda: stop.now)
    assert turns == [100, 110, 111, 121]
    assert seen == [float(second) for second in range(100, 150) if second != 110]


class Half:
    """A reception that runs until it is told to stop, or a submitter whose turn fails."""

    def __init__(self, error: Exception | None = None) -> None:
        self.error, self.trouble, self.unconfirmed, self.funds = error, None, None, None
        self.loop = SimpleNamespace(wake=lambda: None)
        self.turns = 0

    def run(self, stopped: Any, on_turn: Any) -> None:
        while not stopped():
            if self.error is not None:
                raise self.error
            on_turn()
            time.sleep(0.01)

    def turn(self, now: float) -> float:
        self.turns += 1
        if self.error is not None:
            raise self.error
        return 0.01


@pytest.mark.parametrize("reception, submitter", [(None, RuntimeError("a defect")), (StoreError("exchanged"), None)])
def test_what_ends_one_half_of_a_shard_ends_the_other(reception: Exception | None, submitter: Exception | None):
    shard: Any = Shard(Half(reception), Half(submitter))  # type: ignore[arg-type]
    with pytest.raises((RuntimeError, StoreError), match=r"defect|exchanged"):
        shard.run(lambda: False)


def test_a_shard_that_is_stopped_ends():
    shard: Any = Shard(Half(), Half())  # type: ignore[arg-type]
    shard.run(lambda: shard.submitter.turns > 3)


CHILD = """
import os, signal, sys, time
from types import SimpleNamespace
from rosbridge_eth.errors import StoreError
from rosbridge_eth.server import parent
signal.signal(signal.SIGTERM, lambda number, frame: print("the parent's own", flush=True))

def good(shard, config, home, secrets, stopped):
    os.write(1, b"forked\\n")  # at once, whole
    while not stopped():
        time.sleep(0.02)

def bad(*given):
    os.write(1, b"forked\\n")
    time.sleep(0.5)
    raise StoreError("exchanged")

parent.run_shard = {"good": good, "bad": bad}[sys.argv[1]]
process = parent._FORK.Process(target=parent._child, args=(os.getpid(), 1, 0, None, None, None))
process.start()
os.write(1, b"%d\\n" % process.pid)
process.join(30)
print("code", process.exitcode, flush=True)
"""


@pytest.mark.parametrize("task, ends", [("good", "code 0"), ("bad", "code 5")])
def test_a_child_ends_when_it_is_asked_to_and_says_by_its_code_why_it_ended_else(task: str, ends: str):
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


def test_a_robot_that_asks_another_shard_is_sent_to_its_own_and_to_the_first_where_nobody_answers(
    place: Place, monkeypatch: pytest.MonkeyPatch
):
    """robot_1 belongs to shard 0 of 2; it is told of one that is no more, then asks shard 1."""
    monkeypatch.setattr("rosbridge_eth.channel.udp.ASK_AGAIN", 1.0)
    socks = [server_socket(Address("127.0.0.1", 0)) for _ in range(3)]
    addresses = [Address(*sock.getsockname()[:2]) for sock in socks]
    socks[2].close()
    names = ", ".join(f'"{address}"' for address in addresses[:2])
    place.configure('public = "127.0.0.1:9"', f"public = [{names}]\nshards = 2")
    place.configure('"127.0.0.1:0"', '"127.0.0.1:7410"')
    config, registry = load_server_config(place.operator.config), Registry(place.operator.registry)
    identity = load_server_identity(place.operator, PASSPHRASE)
    stop, workers = threading.Event(), []
    for shard in range(2):
        reception = open_reception(
            config, identity, place.operator, registry, open_store(config, place.operator, shard), shard
        )
        workers.append(Worker(reception, lambda handle, at=shard, of=reception: UdpLoop(of.server, socks[at], handle)))
    threads = [threading.Thread(target=worker.run, args=(stop.is_set,)) for worker in workers]
    for thread in threads:
        thread.start()
    place.robot.config.write_text(
        'topics = ["/robot_1/odom"]\n[source]\nkind = "sim"\nduration = "2s"\nspeed = "max"\n'
    )
    monkeypatch.setattr(BridgeEnd, "addresses", lambda end: (addresses[2], addresses[1]))
    try:
        robot = open_robot(place.robot, load_robot_config(place.robot.config), PASSWORD)
        robot.run()
    finally:
        stop.set()
        for thread in threads:
            thread.join(10)
    assert "nothing waits for the server" in robot.summary
    assert [worker.reception.records["robot_1"] > 20 for worker in workers] == [True, False]
    assert workers[1].reception.server.statistics()["handshakes"] == 1
