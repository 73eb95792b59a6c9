"""A server and a robot as processes on a real node: what they show, what they log, and how they say they are ill."""

from __future__ import annotations

import contextlib
import http.client
import json
import os
import signal
import socket
import sqlite3
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path

import pytest
from prometheus_client.parser import text_string_to_metric_families

from bridge.secrecy import assert_hidden, secrets_of
from rosbridge_eth.errors import ExitCode
from rosbridge_eth.ledger.anvil import Anvil, start
from rosbridge_eth.sources.sample import sample_bag

ROOT = Path(__file__).resolve().parents[3]
PASSPHRASE, PASSWORD = "operators-words-4711", "robots-words-0815"
PATIENCE = 40.0
pytestmark = [pytest.mark.service, pytest.mark.slow]


def free_port(kind: int) -> int:
    with socket.socket(socket.AF_INET, kind) as probe:
        probe.bind(("127.0.0.1", 0))
        return int(probe.getsockname()[1])


@dataclass
class Bridge:
    """A home, a node and a server that runs; the logs are files."""

    path: Path
    node_port: int
    monitor: int
    anvil: Anvil
    server: subprocess.Popen[bytes] | None = None
    environment: dict[str, str] = field(default_factory=dict)

    def command(self, *arguments: str) -> list[str]:
        return [sys.executable, "-m", "rosbridge_eth", *arguments]

    def do(self, *arguments: str) -> subprocess.CompletedProcess[str]:
        done = subprocess.run(self.command(*arguments), cwd=self.path, env=self.environment, text=True,
                              capture_output=True, timeout=100, check=False)
        assert done.returncode == 0, done.stderr
        return done

    def start_server(self) -> None:
        with (self.path / "server.log").open("ab") as log:
            self.server = subprocess.Popen(
                self.command("server", "-vv", "--log-format", "json", "--workers", "2", "--passphrase-file", "pass"),
                cwd=self.path, env=self.environment, stderr=log,
            )

    def ask(self, path: str) -> tuple[int, bytes]:
        connection = http.client.HTTPConnection("127.0.0.1", self.monitor, timeout=5)
        try:
            connection.request("GET", path)
            answer = connection.getresponse()
            return answer.status, answer.read()
        finally:
            connection.close()

    def until(self, what: str, holds: Callable[[], bool]) -> None:
        """Wait for the processes; they have no clock of ours."""
        deadline = time.monotonic() + PATIENCE
        while time.monotonic() < deadline:
            with contextlib.suppress(OSError, http.client.HTTPException):
                if holds():
                    return
            time.sleep(0.2)
        raise AssertionError(f"{what} within {PATIENCE:.0f} s; readyz: {self.ask('/readyz')}")

    def ready(self) -> bool:
        return self.ask("/readyz")[0] == 200

    def figures(self) -> dict[str, float]:
        """Sums over the processes."""
        found: dict[str, float] = {}
        for family in text_string_to_metric_families(self.ask("/metrics")[1].decode()):
            for one in family.samples:
                key = one.name.removeprefix("rosbridge_eth_")
                key += "".join(f" {value}" for label, value in sorted(one.labels.items()) if label != "process")
                found[key] = found.get(key, 0) + one.value
        return found

    def events(self, log: str) -> list[dict[str, object]]:
        return [json.loads(line) for line in (self.path / log).read_text().splitlines()]


@pytest.fixture(scope="module", name="bridge")
def _bridge(tmp_path_factory: pytest.TempPathFactory, require: Callable[[str], str]) -> Iterator[Bridge]:
    require("npx")
    path, node, udp, monitor = (
        tmp_path_factory.mktemp("processes"), free_port(socket.SOCK_STREAM), free_port(socket.SOCK_DGRAM),
        free_port(socket.SOCK_STREAM),
    )
    made = Bridge(path, node, monitor, start(node, state=path / "chain.json"))
    made.environment = {**os.environ, "PYTHONPATH": str(ROOT / "src")}
    try:
        (path / "pass").write_text(PASSPHRASE)
        (path / "word").write_text(PASSWORD)
        made.do("init", "--listen", f"127.0.0.1:{udp}", "--chain", f"http://127.0.0.1:{node}",
                "--passphrase-file", "pass")
        config = path / "operator" / "server.toml"
        config.write_text(config.read_text().replace("[chain]", f'monitor = "127.0.0.1:{monitor}"\n\n[chain]'))
        from rosbridge_eth import ledger

        operator = json.loads((path / "operator/accounts.json").read_bytes())["operator"]
        chain = ledger.connect(f"http://127.0.0.1:{node}")
        chain.request("anvil_setBalance", operator, hex(10**21))
        chain.close()
        made.do("deploy", "--passphrase-file", "pass")
        made.do("register", "robot_1", "--passphrase-file", "pass", "--password-file", "word")
        made.do("join", "operator/bundles/robot_1.bundle", "--password-file", "word")
        (path / "robot/robot.toml").write_text(
            f'topics = ["/robot_1/odom"]\n[source]\nkind = "bag"\npath = "{sample_bag()}"\nspeed = "max"\n'
        )
        made.start_server()
        yield made
    finally:
        if made.server is not None and made.server.poll() is None:
            made.server.terminate()
            made.server.wait(30)
        made.anvil.stop()


def test_the_figures_of_a_run_are_those_of_the_run(bridge: Bridge):
    bridge.until("ready", bridge.ready)
    done = subprocess.run(
        bridge.command("robot", "-vv", "--log-format", "json", "--password-file", "word"), cwd=bridge.path,
        env=bridge.environment, capture_output=True, timeout=100, check=True,
    )
    (bridge.path / "robot.log").write_bytes(done.stderr)
    written = 302  # the bag's 300 messages, the record that opens the stream and the one that ends it
    bridge.until("everything confirmed", lambda: bridge.figures().get("records_confirmed_total") == written)
    bridge.until("the inbox drained", lambda: bridge.figures()["inbox_records waiting"] == 0)
    figures = bridge.figures()
    assert figures["records_total stored"] == figures["records_gathered_total"] == written
    assert figures["batches_confirmed_total"] == figures["batches_sealed_total"] == figures["confirm_seconds_count"]
    assert figures["handshakes_total"] == 1
    assert figures["dead_letters inbox"] == figures["dead_letters journal"] == 0
    assert figures["gas_used_total"] > 16 * 256 * written  # calldata alone, at 16 gas a byte: EIP-2028
    status = json.loads(bridge.do("status", "--json").stdout)
    assert status["server"]["ready"] is True
    assert status["server"]["figures"]["records_total"]["stored"] == written
    bridge.until("the last block", lambda: bridge.figures()["head_block"] == status["block"])


def test_logs_at_their_most_talkative_name_every_record_and_betray_nothing(bridge: Bridge):
    read = bridge.do("read", "robot_1", "--passphrase-file", "pass").stdout
    records = [json.loads(line) for line in read.splitlines()]
    assert len(records) == 300
    for log in ("server.log", "robot.log"):
        named = {name for event in bridge.events(log) for name in event.get("records", [])}  # type: ignore[union-attr]
        proofs = [record["proof"] for record in records]
        assert {f"{proof['stream']}/{proof['seq']}" for proof in proofs} <= {
            name.partition("/")[2] for name in named  # type: ignore[attr-defined]
        }, log
    secrets = {PASSPHRASE.encode(), PASSWORD.encode()}
    for record in records[::10]:
        secrets |= {found for found in secrets_of(json.dumps(record["data"]).encode()) if len(found) >= 8}
    secrets |= {b"/robot_1/odom", b"nav_msgs"}
    assert len(secrets) > 100
    for key in bridge.path.rglob("*.key.pem"):
        secrets |= {line for line in key.read_bytes().splitlines() if len(line) > 40 and b"-----" not in line}
    for log in ("server.log", "robot.log"):
        content = (bridge.path / log).read_bytes()
        assert len(content) > 10_000
        assert_hidden(content, secrets)


def test_a_killed_worker_is_started_again_and_counted(bridge: Bridge):
    bridge.until("ready", bridge.ready)
    pids = [str(event["event"]).rpartition(" ")[2] for event in bridge.events("server.log")
            if str(event["event"]).startswith("worker-1 started")]
    os.kill(int(pids[-1]), signal.SIGKILL)
    bridge.until("counted", lambda: bridge.figures()["process_restarts_total"] == 1)
    bridge.until("up again", lambda: bridge.figures()["process_up"] == 4 and bridge.ready())
    assert any("worker-1 ended with exit code -9" in str(event["event"]) for event in bridge.events("server.log"))


def test_a_node_that_is_away_makes_it_unready_but_not_unhealthy(bridge: Bridge):
    bridge.anvil.stop()

    def blames_the_node() -> bool:
        status, body = bridge.ask("/readyz")
        wrong = {each["name"] for each in json.loads(body)["conditions"] if not each["ok"]}
        return status == 503 and "node answers" in wrong

    bridge.until("unready", blames_the_node)
    assert bridge.ask("/healthz")[0] == 200
    bridge.anvil = start(bridge.node_port, state=bridge.path / "chain.json")
    bridge.until("ready again", bridge.ready)


def test_a_submitter_that_starts_while_the_node_is_away_waits_for_it(bridge: Bridge):
    bridge.until("ready at first", bridge.ready)
    bridge.anvil.kill()  # what it wrote at its last end is all there is: nothing was written since
    before = bridge.figures()["process_restarts_total"]
    pids = [str(event["event"]).rpartition(" ")[2] for event in bridge.events("server.log")
            if str(event["event"]).startswith("submitter started")]
    os.kill(int(pids[-1]), signal.SIGKILL)
    bridge.until("tried more than once", lambda: bridge.figures()["process_restarts_total"] >= before + 2)
    bridge.anvil = start(bridge.node_port, state=bridge.path / "chain.json")
    bridge.until("ready again", bridge.ready)


def test_a_server_ends_in_good_order_and_its_log_is_events_to_the_end(bridge: Bridge):
    assert bridge.server is not None
    bridge.until("ready at first", bridge.ready)
    bridge.server.terminate()
    assert bridge.server.wait(30) == ExitCode.OK
    assert all({"time", "level", "part", "process", "event"} <= event.keys() for event in bridge.events("server.log"))


def test_a_monitor_whose_port_is_taken_is_told_at_the_start(bridge: Bridge):
    with socket.socket() as taken:
        taken.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)  # connections of before linger
        taken.bind(("127.0.0.1", bridge.monitor))
        taken.listen()
        done = subprocess.run(bridge.command("server", "--passphrase-file", "pass"), cwd=bridge.path, text=True,
                              env=bridge.environment, capture_output=True, timeout=60, check=False)
    assert done.returncode == ExitCode.NETWORK
    assert "correct `monitor`" in done.stderr and "Traceback" not in done.stderr


def test_check_believes_the_chain_and_not_the_store(bridge: Bridge):
    proof = json.loads(bridge.do("read", "robot_1", "--passphrase-file", "pass").stdout.splitlines()[-1])["proof"]
    ask = ["check", "robot_1", proof["stream"], str(proof["seq"]), "--json"]
    found = json.loads(bridge.do(*ask).stdout)
    assert found["proven"] is True and found["state"] in ("confirmed", "acknowledged")
    # As after a reorganisation that the submitter has not seen yet: the chain has the batch in another block.
    with contextlib.closing(sqlite3.connect(bridge.path / "operator/journal.sqlite")) as journal, journal:
        assert journal.execute("UPDATE job SET block_number = block_number + 1000").rowcount > 0
    done = subprocess.run(bridge.command(*ask), cwd=bridge.path, text=True, env=bridge.environment,
                          capture_output=True, timeout=60, check=False)
    assert done.returncode == ExitCode.VERIFICATION
    assert json.loads(done.stdout)["proven"] is False
    assert "reorganised" in done.stderr and "Traceback" not in done.stderr
