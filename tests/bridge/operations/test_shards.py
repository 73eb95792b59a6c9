"""The number of shards changes while robots send, and shards are killed: nothing is lost, doubled or out of order.

Also where the store of all shards is a Redis Cluster, one node of which is killed with them.
"""

from __future__ import annotations

import json
import os
import re
import signal
import socket
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from bridge.operations.test_processes import ROOT, Bridge
from bridge.redis_server import RedisClusterServer
from ports import free_port
from rosbridge_eth.config.home import OperatorHome, shard_of
from rosbridge_eth.ledger.nodes import Anvil
from rosbridge_eth.log.chunk import robot_id

pytestmark = [pytest.mark.service, pytest.mark.slow]
ROBOTS = [next(name for name in map("robot_{}".format, range(99)) if shard_of(robot_id(name), 4) == shard)
          for shard in (1, 2, 3)]  # fmt: skip
SIM = 'topics = ["/robot_1/odom"]\n[log]\nperiod = "300ms"\n[source]\nkind = "sim"\n'


@pytest.fixture(name="cluster", params=[False, True], ids=["sqlite", "redis cluster"])
def _cluster(request: pytest.FixtureRequest, tmp_path: Path) -> Iterator[RedisClusterServer | None]:
    if not request.param:
        yield None
        return
    (tmp_path / "redis").mkdir()
    made = RedisClusterServer(tmp_path / "redis")
    yield made
    made.kill()


@pytest.fixture(name="bridge")
def _bridge(tmp_path: Path, cluster: RedisClusterServer | None, require: Callable[[str], str]) -> Iterator[Bridge]:
    require("npx")
    node, udp, monitor = free_port(), free_port(socket.SOCK_DGRAM, 4), free_port(count=4)
    made = Bridge(tmp_path, node, monitor, Anvil.start(node, state=tmp_path / "chain.json"))
    made.environment = {**os.environ, "PYTHONPATH": str(ROOT / "src")}
    try:
        for name in ("pass", "word", "readers"):
            (tmp_path / name).write_text(f"{name}-4711")
        made.do("init", "--listen", f"127.0.0.1:{udp}", "--chain", f"http://127.0.0.1:{node}",
                "--passphrase-file", "pass", "--reader-passphrase-file", "readers")
        made.anvil.fund(OperatorHome(tmp_path / "operator").account, 1000)
        made.do("deploy", "--wait", "60", "--passphrase-file", "pass")
        if cluster is not None:
            with (tmp_path / "operator/server.toml").open("a") as config:
                config.write(f'[store]\nurl = "{cluster.url}"\n')
        for name in ROBOTS:  # while there is one shard: their bundles name no other
            made.do("join", "--name", name, "--home", name, "--password-file", "word")
            made.do("register", name, f"{name}/request.json", "--passphrase-file", "pass")
        made.start_server()
        yield made
    finally:
        if made.server is not None and made.server.poll() is None:
            made.server.terminate()
            made.server.wait(30)
        made.anvil.stop()


def run_all(bridge: Bridge, source: str) -> list[subprocess.Popen[bytes]]:
    for name in ROBOTS:
        (bridge.path / name / "robot.toml").write_text(SIM + source)
    return [bridge.start(f"{name}.log", "robot", "--home", name, "--password-file", "word") for name in ROBOTS]


def test_the_number_of_shards_changes_and_shards_are_killed_while_robots_send(
    bridge: Bridge, cluster: RedisClusterServer | None
):
    def chunks() -> dict[str, int]:
        report = json.loads(bridge.do("status", "--json").stdout)
        return {name: report["robots"][name]["chunks"] for name in ROBOTS}

    def grow(what: str) -> None:
        before = chunks()
        bridge.until(what, lambda: all(now > before[name] + 2 for name, now in chunks().items()))

    config, robots = bridge.path / "operator" / "server.toml", run_all(bridge, "")
    good = config.read_text()
    grow("one shard writes for all")
    for number, shards in enumerate((4, 2, 1) if cluster is None else (4, 1), 1):
        config.write_text(good.replace("[chain]", f"shards = {shards}\n[chain]"))
        assert bridge.server is not None
        bridge.server.send_signal(signal.SIGHUP)
        bridge.until("reloaded", lambda number=number: bridge.said("server.log", "reloaded: shard-0") == number)
        grow(f"{shards} shards write")
        for shard in range(shards):
            os.kill(bridge.pid(f"shard-{shard}"), signal.SIGKILL)
        if cluster is not None:
            node = cluster.nodes[number - 1]
            node.kill()
            cluster.wait("fail")
            node.start()
            cluster.wait("ok")
        grow(f"{shards} shards that were killed write")
    for process in robots:
        process.terminate()
        assert process.wait(60) == 0
    for process in run_all(bridge, 'duration = "1s"\nspeed = "max"\n'):
        assert process.wait(100) == 0
    for name in ROBOTS:
        said = " ".join(str(event["event"]) for event in bridge.events(f"{name}.log"))
        captured = sum(int(count.replace(",", "")) for count in re.findall(r"([\d,]+) records captured in", said))
        assert "this robot belongs to the server's shard at 127.0.0.1:" in said

        def read(name: str = name) -> dict[str, object]:
            answer: dict[str, object] = json.loads(
                bridge.do("read", name, "--passphrase-file", "readers", "--json").stdout
            )
            return answer

        bridge.until("all on the chain", lambda read=read, captured=captured: read()["records"] == captured)
        verdict = read()
        assert verdict["sound"] and verdict["head"]["goodbye"], verdict  # type: ignore[index]
        assert captured > 100
