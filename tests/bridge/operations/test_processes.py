"""A server and a robot as processes on a real node: what they show and log, how they say they are ill, how they end."""

from __future__ import annotations

import contextlib
import http.client
import json
import os
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pytest
from prometheus_client.parser import text_string_to_metric_families

from bridge.secrecy import betrayed, leaves
from ports import free_port
from rosbridge_eth.config.home import OperatorHome
from rosbridge_eth.errors import ExitCode
from rosbridge_eth.ledger.nodes import Anvil
from rosbridge_eth.robot.sources import sample_bag

ROOT = Path(__file__).resolve().parents[3]
PASSPHRASE, PASSWORD, READERS = "operators-words-4711", "robots-words-0815", "readers-words-2342"
PATIENCE = 60.0
pytestmark = [pytest.mark.service, pytest.mark.slow]


def ask(port: int, path: str) -> tuple[int, bytes]:
    with contextlib.closing(http.client.HTTPConnection("127.0.0.1", port, timeout=5)) as connection:
        connection.request("GET", path)
        answer = connection.getresponse()
        return answer.status, answer.read()


def figures_at(port: int) -> dict[str, float]:
    """Sums over the processes."""
    found: dict[str, float] = {}
    for family in text_string_to_metric_families(ask(port, "/metrics")[1].decode()):
        for one in family.samples:
            key = one.name.removeprefix("rosbridge_eth_")
            key += "".join(f" {value}" for label, value in sorted(one.labels.items()) if label != "process")
            found[key] = found.get(key, 0) + one.value
    return found


@dataclass
class Bridge:
    """A home, a node and a server that runs; the logs are files."""

    path: Path
    node_port: int
    monitor: int
    anvil: Anvil
    server: subprocess.Popen[bytes] | None = None
    environment: dict[str, str] = field(default_factory=dict)
    shards: int = 2

    def command(self, *arguments: str) -> list[str]:
        return [sys.executable, "-m", "rosbridge_eth", *arguments]

    def do(self, *arguments: str, code: int = 0) -> subprocess.CompletedProcess[str]:
        done = subprocess.run(self.command(*arguments), cwd=self.path, env=self.environment, text=True,
                              capture_output=True, timeout=100, check=False)
        assert done.returncode == code, done.stderr
        assert "Traceback" not in done.stderr
        return done

    def start(self, log: str, *arguments: str) -> subprocess.Popen[bytes]:
        with (self.path / log).open("ab") as stream:
            return subprocess.Popen(self.command(*arguments, "-vv", "--log-format", "json"), cwd=self.path,
                                    env=self.environment, stderr=stream)  # fmt: skip

    def start_server(self) -> None:
        self.server = self.start("server.log", "server", "--passphrase-file", "pass")

    def start_robot(self, source: str, more: str = "") -> subprocess.Popen[bytes]:
        (self.path / "robot/robot.toml").write_text(f'topics = ["/robot_1/odom"]\n{more}[source]\n{source}\n')
        return self.start("robot.log", "robot", "--password-file", "word")

    def start_anvil(self) -> None:
        self.anvil = Anvil.start(self.node_port, state=self.path / "chain.json")

    def until(self, what: str, holds: Callable[[], bool]) -> None:
        """Wait for the processes; they have no clock of ours."""
        deadline = time.monotonic() + PATIENCE
        while time.monotonic() < deadline:
            with contextlib.suppress(OSError, http.client.HTTPException, KeyError):
                if holds():
                    return
            time.sleep(0.2)
        raise AssertionError(f"{what} within {PATIENCE:.0f} s; figures: {self.figures()}")

    def failing(self) -> list[str]:
        failing: list[str] | None = json.loads(self.do("status", "--json").stdout)["process"]
        return ["it does not run"] if failing is None else failing

    def ready(self) -> bool:
        return self.failing() == []

    def figures(self, shard: int | None = None) -> dict[str, float]:
        """Of a shard, or sums over all."""
        found: dict[str, float] = {}
        for each in range(self.shards) if shard is None else [shard]:
            for key, value in figures_at(self.monitor + each).items():
                found[key] = found.get(key, 0) + value
        return found

    def events(self, log: str) -> list[dict[str, object]]:
        return [json.loads(line) for line in (self.path / log).read_text().splitlines()]

    def said(self, log: str, words: str) -> int:
        return sum(words in str(event["event"]) for event in self.events(log))

    def pid(self, name: str) -> int:
        starts = [str(event["event"]) for event in self.events("server.log")
                  if str(event["event"]).startswith(f"{name} started")]  # fmt: skip
        return int(starts[-1].rpartition(" ")[2])


@pytest.fixture(scope="module", name="bridge")
def _bridge(tmp_path_factory: pytest.TempPathFactory, require: Callable[[str], str]) -> Iterator[Bridge]:
    require("npx")
    path, node, udp, monitor = (
        tmp_path_factory.mktemp("processes"), free_port(), free_port(socket.SOCK_DGRAM, 4), free_port(count=4),
    )
    made = Bridge(path, node, monitor, Anvil.start(node, state=path / "chain.json"))
    made.environment = {**os.environ, "PYTHONPATH": str(ROOT / "src")}
    try:
        for name, words in (("pass", PASSPHRASE), ("word", PASSWORD), ("readers", READERS)):
            (path / name).write_text(words)
        made.do("init", "--listen", f"127.0.0.1:{udp}", "--chain", f"http://127.0.0.1:{node}",
                "--passphrase-file", "pass", "--reader-passphrase-file", "readers")
        config = path / "operator" / "server.toml"
        more = f'monitor = "127.0.0.1:{monitor}"\nshards = 2\n\n[chain]'
        config.write_text(config.read_text().replace("[chain]", more))
        made.anvil.fund(OperatorHome(path / "operator").account, 1000)
        made.do("deploy", "--wait", "60", "--passphrase-file", "pass")
        made.do("join", "--name", "robot_1", "--password-file", "word")
        made.do("register", "robot_1", "robot/request.json", "--passphrase-file", "pass")
        made.do("join", "operator/bundles/robot_1.bundle")
        made.start_server()
        yield made
    finally:
        if made.server is not None and made.server.poll() is None:
            made.server.terminate()
            made.server.wait(30)
        made.anvil.stop()


def test_the_figures_of_a_run_are_those_of_the_run(bridge: Bridge):
    bridge.until("ready", bridge.ready)
    robot = bridge.start_robot(f'kind = "bag"\npath = "{sample_bag()}"\nspeed = "max"')
    assert robot.wait(100) == 0
    lines = 302  # the bag's 300 messages, the line that opens the stream and the one that defines their type
    bridge.until("everything stored", lambda: bridge.figures()["records_stored robot_1"] == lines)
    bridge.until("something sent", lambda: bridge.figures()["submitter sent"] >= 1)
    bridge.until("everything confirmed", lambda: bridge.figures()["waiting_chunks robot_1"] == 0)
    figures = bridge.figures()
    report = json.loads(bridge.do("status", "--json").stdout)
    assert figures["chunks stored"] == report["robots"]["robot_1"]["chunks"] > 0
    assert figures["channel handshakes"] == 1
    assert figures["on_hold robot_1"] == figures["waiting_bytes robot_1"] == figures["waiting_seconds robot_1"] == 0
    assert bridge.figures(0)["treasury_eth"] == pytest.approx(report["operator"]["eth"], abs=1)
    assert report["process"] == []
    assert "treasury_eth" not in bridge.figures(1), "the first shard alone pays"
    bridge.until("the last block", lambda: bridge.figures(1)["head_block"] == report["node"]["block"])


def test_logs_at_their_most_talkative_name_every_chunk_and_betray_nothing(bridge: Bridge):
    read = bridge.do("read", "robot_1", "--passphrase-file", "readers").stdout
    records = [json.loads(line) for line in read.splitlines()]
    assert len(records) == 300
    verdict = json.loads(bridge.do("read", "robot_1", "--passphrase-file", "readers", "--json").stdout)
    assert bridge.said("robot.log", verdict["head"]["stream"]) > 0
    secrets = {PASSPHRASE.encode(), PASSWORD.encode(), READERS.encode(), b"/robot_1/odom", b"nav_msgs"}
    for record in records[::10]:
        secrets |= {text.encode() for text in map(str, leaves(record["data"])) if len(text) >= 8}
    assert len(secrets) > 100
    for key in bridge.path.rglob("*.key.pem"):
        secrets |= {line for line in key.read_bytes().splitlines() if len(line) > 40 and b"-----" not in line}
    for log in ("server.log", "robot.log"):
        content = (bridge.path / log).read_bytes()
        assert len(content) > 500
        assert betrayed(content, secrets) == []


def test_a_robot_shows_itself_in_one_process_and_is_seen_by_the_server(bridge: Bridge):
    port = free_port()
    robot = bridge.start_robot('kind = "sim"', f'monitor = "127.0.0.1:{port}"\n')
    try:
        bridge.until("captured", lambda: figures_at(port)["captured robot_1"] > 10)
        assert figures_at(port)["connected robot_1"] == 1
        assert "treasury_eth" not in figures_at(port), "a robot says nothing of what the server knows"
        bridge.until("seen", lambda: json.loads(bridge.do("status", "--json").stdout)["robots"]["robot_1"]["connected"])
        assert json.loads(bridge.do("status", "--json").stdout)["robots"]["robot_1"]["address"] == "127.0.0.1"
        assert json.loads(bridge.do("status", "--home", "robot", "--json").stdout)["figures"]["connected"] == 1
        findings = json.loads(bridge.do("doctor", "--passphrase-file", "pass", "--json").stdout)["findings"]
        assert [f["found"] for f in findings if f["what"] == "server"] == ["runs, and is ready"]
        findings = json.loads(bridge.do("doctor", "--home", "robot", "--json").stdout)["findings"]
        assert {f["what"]: f["result"] for f in findings}["server"] == "skipped"
        assert {f["what"]: f["result"] for f in findings}["robot"] == "ok"
    finally:
        robot.send_signal(signal.SIGINT)
    assert robot.wait(30) == 0
    assert bridge.said("robot.log", "records captured in") == 2
    bridge.until("seen to leave", lambda: bridge.figures()["channel connections"] == 0)
    bridge.until("confirmed", lambda: bridge.figures()["waiting_chunks robot_1"] == 0)
    verdict = json.loads(bridge.do("read", "robot_1", "--passphrase-file", "readers", "--json").stdout)
    assert verdict["sound"] and verdict["head"]["goodbye"]


def test_a_killed_shard_is_told_started_again_and_counted(bridge: Bridge):
    bridge.until("ready", bridge.ready)
    before = bridge.figures(1)["starts"]
    assert bridge.server is not None
    bridge.server.send_signal(signal.SIGSTOP)  # the parent does not start it again meanwhile
    try:
        os.kill(bridge.pid("shard-1"), signal.SIGKILL)
        bridge.until("told", lambda: "shard-1 runs" in bridge.failing())
        assert "shard-0 runs" not in bridge.failing()
    finally:
        bridge.server.send_signal(signal.SIGCONT)
    bridge.until("counted", lambda: bridge.figures(1)["starts"] == before + 1)
    bridge.until("up again", bridge.ready)
    assert bridge.said("server.log", "shard-1 ended with exit code -9") == 1


def test_a_shard_that_hangs_is_told(bridge: Bridge):
    bridge.until("ready", bridge.ready)
    shard = bridge.pid("shard-0")
    os.kill(shard, signal.SIGSTOP)
    try:
        bridge.until("told", lambda: bridge.failing() == ["shard-0 runs"])
    finally:
        os.kill(shard, signal.SIGCONT)
    bridge.until("ready again", bridge.ready)


def test_a_node_that_is_away_is_told_and_so_is_its_return(bridge: Bridge):
    bridge.until("ready at first", bridge.ready)
    bridge.anvil.stop()
    bridge.until("told", lambda: bridge.failing() == ["shard-0: node answers", "shard-1: node answers"])
    report = json.loads(bridge.do("status", "--json").stdout)
    assert report["node"] is None
    bridge.start_anvil()
    bridge.until("ready again", bridge.ready)
    bridge.until("said so", lambda: bridge.said("server.log", "the node: works again") == 2)
    assert bridge.said("server.log", "the node: http://127.0.0.1") >= 2


def test_a_shard_that_starts_while_the_node_is_away_waits_for_it(bridge: Bridge):
    bridge.until("ready at first", bridge.ready)
    bridge.anvil.stop()
    before = bridge.figures(0)["starts"]
    os.kill(bridge.pid("shard-0"), signal.SIGKILL)
    bridge.until("started again", lambda: bridge.figures(0)["starts"] > before)
    bridge.until("unready", lambda: not bridge.ready())
    bridge.start_anvil()
    bridge.until("ready again", bridge.ready)


def test_sighup_reloads_server_toml_and_the_robots_go_on(bridge: Bridge):
    """With another number of shards, too: from 2 to 4, to 1, and to 2 again."""
    assert bridge.server is not None
    bridge.until("ready at first", bridge.ready)
    robot = bridge.start_robot('kind = "sim"')
    bridge.until("a session", lambda: bridge.figures()["channel connections"] == 1)
    config = bridge.path / "operator" / "server.toml"
    good, before = config.read_text(), bridge.pid("shard-0")
    try:
        config.write_text(good.replace("[chain]", "[chain]\nconfirmations = 0"))
        bridge.server.send_signal(signal.SIGHUP)
        bridge.until("refused", lambda: bridge.said("server.log", "nothing is reloaded") == 1)
        assert bridge.pid("shard-0") == before
        for number, shards in enumerate((4, 1, 2), 1):
            config.write_text(good.replace("shards = 2", f"shards = {shards}"))
            bridge.server.send_signal(signal.SIGHUP)
            bridge.until("reloaded", lambda number=number: bridge.said("server.log", "reloaded: shard-0") == number)
            bridge.until("ready", bridge.ready)
            bridge.shards = shards
            bridge.until("the session again", lambda: bridge.figures()["channel connections"] == 1)
            written = bridge.figures().get("chain_chunks robot_1", 0)
            bridge.until("what follows", lambda written=written: (
                bridge.figures().get("chain_chunks robot_1", 0) > written + 1))
            assert len(list((bridge.path / "operator").glob(".shard-*.json"))) == shards
    finally:
        bridge.shards = 2
        config.write_text(good)
        robot.terminate()
    assert robot.wait(30) == 0
    bridge.until("confirmed", lambda: bridge.figures()["waiting_chunks robot_1"] == 0)
    verdict = json.loads(bridge.do("read", "robot_1", "--passphrase-file", "readers", "--json").stdout)
    assert verdict["sound"] and verdict["head"]["goodbye"]


def test_all_homes_come_back_from_backups_and_nothing_is_lost_or_doubled(bridge: Bridge):
    """The backup is older than what was written since: robot, inbox and bookmark go on from an old copy."""
    assert bridge.server is not None
    bridge.until("ready at first", bridge.ready)
    homes = ("operator", "robot", "reader")
    for home in homes:
        bridge.do("backup", f"kept/{home}", "--home", home)

    def records() -> int:
        verdict = json.loads(bridge.do("read", "robot_1", "--passphrase-file", "readers", "--json").stdout)
        assert verdict["sound"]
        return int(verdict["records"])

    def run() -> None:
        assert bridge.start_robot('kind = "sim"\nduration = "3s"\nspeed = "max"').wait(100) == 0
        bridge.until("confirmed", lambda: bridge.figures()["waiting_chunks robot_1"] == 0)

    before = records()
    run()
    assert records() == before + 30
    bridge.server.terminate()
    assert bridge.server.wait(30) == ExitCode.OK
    for home in homes:
        shutil.rmtree(bridge.path / home)
        (bridge.path / "kept" / home).rename(bridge.path / home)
    bridge.start_server()
    bridge.until("ready again", bridge.ready)
    run()
    assert records() == before + 60


@pytest.mark.parametrize("number", [signal.SIGTERM, signal.SIGINT])
def test_a_server_ends_in_good_order_and_its_log_is_events_to_the_end(bridge: Bridge, number: signal.Signals):
    assert bridge.server is not None
    bridge.until("ready at first", bridge.ready)
    children = [bridge.pid(name) for name in ("shard-0", "shard-1")]
    bridge.server.send_signal(number)
    assert bridge.server.wait(30) == ExitCode.OK
    assert all({"time", "level", "part", "process", "event"} <= event.keys() for event in bridge.events("server.log"))
    assert bridge.said("server.log", "does not end; it is killed") == 0
    assert not any(Path(f"/proc/{child}").exists() for child in children)
    bridge.start_server()


def test_children_of_a_killed_server_end_by_themselves(bridge: Bridge):
    assert bridge.server is not None
    bridge.until("ready at first", bridge.ready)
    children = [bridge.pid(name) for name in ("shard-0", "shard-1")]
    bridge.server.kill()
    bridge.server.wait(10)
    bridge.until("gone", lambda: not any(Path(f"/proc/{child}").exists() for child in children))
    bridge.start_server()
    bridge.until("ready again", bridge.ready)


def test_a_port_that_is_taken_is_told_at_the_start(bridge: Bridge):
    assert bridge.server is not None
    bridge.until("ready at first", bridge.ready)
    said = bridge.do("server", "--passphrase-file", "pass", code=ExitCode.NETWORK).stderr
    assert "UDP port" in said, "two servers do not share one port"
    bridge.server.terminate()
    bridge.server.wait(30)
    with socket.socket() as taken:
        taken.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # connections of before linger
        taken.bind(("127.0.0.1", bridge.monitor))
        taken.listen()
        said = bridge.do("server", "--passphrase-file", "pass", code=ExitCode.NETWORK).stderr
    assert "correct `monitor`" in said
