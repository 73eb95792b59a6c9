"""Monitoring ready to use: what deploy/compose.yml starts, started here without containers, and asked what the
dashboard and the rules ask.

Of each service the command runs that stands in compose.yml, with other ports and folders. There is no Grafana here:
its files are only read.
"""

from __future__ import annotations

import ast
import contextlib
import http.client
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any
from urllib.parse import urlencode

import compose_spec
import pytest
from grafana_foundation_sdk.cog.encoder import JSONEncoder
from grafana_foundation_sdk.models.dashboard import Dashboard
from prometheus_client.parser import text_string_to_metric_families
from ruamel.yaml import YAML

from bridge.figures import LABELS
from bridge.operations.test_deployment import parse
from ports import free_port

ROOT = Path(__file__).resolve().parents[3]
DEPLOY = ROOT / "deploy"
COMPOSE = YAML(typ="safe").load(DEPLOY / "compose.yml")
SERVICES = COMPOSE["services"]
DASHBOARD = json.loads((DEPLOY / "grafana/rosbridge-eth.json").read_text())
PANELS = [panel for panel in DASHBOARD["panels"] if panel["type"] != "row"]
RULES = YAML(typ="safe").load(DEPLOY / "prometheus/rosbridge-eth.rules.yml")["groups"][0]["rules"]
PATIENCE = 90.0
ROBOT = """
topics = ["/robot_1/odom", { topic = "/robot_1/imu", trigger = "crash" }]
monitor = "127.0.0.1:PORT"
[[trigger]]
name = "crash"
after = "1s"
when = "/robot_1/odom header.seq == 20"
[source]
kind = "sim"
"""


# What is written


def strictly_parsed(text: dict[str, Any]) -> None:
    """With variables at their defaults, which the parser does not put in; ValueError."""
    text = json.loads(re.sub(r"\$\{\w+:-([^}]*)\}", r"\1", json.dumps(text)))
    compose_spec.PyCompose.from_json(json.dumps(text)).validate()
    compose_spec.ComposeSpecification.model_validate(text)


def test_the_compose_file_is_one_by_the_specification():
    strictly_parsed(COMPOSE)
    for damage in ('"restart"', '"service_healthy"', '"interval"'):
        with pytest.raises(ValueError, match="damaged"):
            strictly_parsed(json.loads(json.dumps(COMPOSE).replace(damage, f'"damaged{damage[1:]}', 1)))


def test_every_port_is_this_machines_own_and_every_secret_is_a_file():
    for name, service in SERVICES.items():
        for port in service.get("ports", ()):
            assert port.startswith(("127.0.0.1:", "${DOOR:-127.0.0.1}:")), name
        assert not any(re.search("PASS|SECRET|KEY", key) for key in service.get("environment", ()) if "FILE" not in key)
    assert all(set(secret) == {"file"} for secret in COMPOSE["secrets"].values())
    named = {volume.partition(":")[0] for service in SERVICES.values() for volume in service.get("volumes", ())}
    assert {name for name in named if not name.startswith(".")} == set(COMPOSE["volumes"])
    assert all("healthcheck" in service for name, service in SERVICES.items() if name != "server")
    assert "HEALTHCHECK" in (DEPLOY / "Containerfile").read_text(), "the server's"


@pytest.mark.parametrize("file", [config["file"] for config in COMPOSE["configs"].values()])
def test_the_files_that_it_mounts_are_there(file: str):
    assert (DEPLOY / file).is_file()


def test_grafana_finds_its_source_and_the_dashboard_where_they_are_mounted():
    load = YAML(typ="safe").load
    [source] = load(DEPLOY / "grafana/datasources.yml")["datasources"]
    [provider] = load(DEPLOY / "grafana/dashboards.yml")["providers"]
    where = {each["source"]: each["target"] for each in SERVICES["grafana"]["configs"]}
    assert where["dashboard"].startswith(provider["options"]["path"] + "/")
    assert source["url"] == "http://prometheus:9090" and source["type"] == "prometheus"
    assert SERVICES["grafana"]["environment"]["GF_DASHBOARDS_DEFAULT_HOME_DASHBOARD_PATH"] == where["dashboard"]


def test_the_panels_do_not_overlap_and_each_has_a_title_and_a_source():
    cells: set[tuple[int, int]] = set()
    assert len({panel["id"] for panel in DASHBOARD["panels"]}) == len(DASHBOARD["panels"])
    for panel in DASHBOARD["panels"]:
        place = panel["gridPos"]
        own = {(place["x"] + x, place["y"] + y) for x in range(place["w"]) for y in range(place["h"])}
        assert not own & cells and place["x"] + place["w"] <= 24, panel["title"]
        cells |= own
    assert {panel["datasource"]["uid"] for panel in PANELS} == {"${datasource}"}
    assert all(panel["title"] and panel["targets"] for panel in PANELS)


def test_the_dashboard_is_one_by_grafanas_schema():
    """What its models do not know, they leave out when they write it anew."""
    model = Dashboard.from_json(json.loads((DEPLOY / "grafana/rosbridge-eth.json").read_text()))
    written = json.loads(JSONEncoder().encode(model))

    def unknown(ours: Any, theirs: Any, path: str) -> list[str]:
        if isinstance(ours, dict):
            return [one for key in ours for one in (unknown(ours[key], theirs[key], f"{path}.{key}") if key in theirs
                                                    else [f"{path}.{key}"])]  # fmt: skip
        if isinstance(ours, list):
            assert len(ours) == len(theirs), path
            return [one for index, each in enumerate(ours) for one in unknown(each, theirs[index], f"{path}[{index}]")]
        assert ours == theirs, path
        return []

    assert unknown(DASHBOARD, written, "") == [".annotations.list[0].titleFormat"], "known to the Prometheus source"


def test_every_metric_of_the_dashboard_is_one_and_every_metric_is_on_it():
    asked = set(re.findall(r"rosbridge_eth_(\w+)", " ".join(expressions(PANELS))))
    assert asked == LABELS.keys()
    for name, label in re.findall(r"rosbridge_eth_(\w+)\{(\w+)=", " ".join(expressions(PANELS))):
        assert label in (*LABELS[name], "job"), name


def expressions(panels: list[dict[str, Any]]) -> list[str]:
    return [target["expr"] for panel in panels for target in panel["targets"]]


def test_the_launch_file_starts_a_command_that_exists():
    """`launch` is not to be had without a ROS installation: the file is compiled and read, and its command parsed."""
    path = DEPLOY / "ros2/rosbridge_eth.launch.py"
    tree = ast.parse(path.read_text(), str(path))
    compile(tree, str(path), "exec")
    imports = [node for node in ast.walk(tree) if isinstance(node, ast.ImportFrom)]
    imported = {(node.module, name.name) for node in imports for name in node.names}
    assert imported == {
        ("launch", "LaunchDescription"), ("launch.actions", "DeclareLaunchArgument"),
        ("launch.actions", "ExecuteProcess"), ("launch.substitutions", "LaunchConfiguration"),
    }  # fmt: skip
    calls = [node for node in ast.walk(tree) if isinstance(node, ast.Call)]
    [process] = [call for call in calls if ast.unparse(call.func) == "ExecuteProcess"]
    given = {keyword.arg: keyword.value for keyword in process.keywords}
    # launch 3 (Jazzy, Kilted): ExecuteProcess(cmd, ...) and ExecuteLocal's; other names it would refuse
    assert given.keys() == {"name", "cmd", "output", "sigterm_timeout", "respawn", "respawn_delay"}
    [declared] = [ast.literal_eval(node.value) for node in tree.body
                  if isinstance(node, ast.Assign) and ast.unparse(node.targets[0]) == "ARGUMENTS"]  # fmt: skip
    words = [each.value if isinstance(each, ast.Constant) else declared[each.args[0].value][0] or "word"
             for each in given["cmd"].elts]  # fmt: skip
    assert words[0] == "rosbridge-eth"
    parse(words[1:])


# What runs


@dataclass
class Site:
    """The services of compose.yml as processes of this machine."""

    path: Path
    ports: dict[str, int] = field(default_factory=dict)
    processes: dict[str, subprocess.Popen[bytes]] = field(default_factory=dict)

    def here(self, text: str) -> str:
        """With this machine's ports and folders instead of the containers'."""
        for written, name in (("anvil:8545", "anvil"), ("redis:6379", "redis"), ("server:9464", "monitor"),
                              ("0.0.0.0:9464", "monitor"), ("127.0.0.1:7410", "door"), ("0.0.0.0:7410", "door"),
                              ("127.0.0.1:8545", "anvil"), ("127.0.0.1:9090", "prometheus")):  # fmt: skip
            text = text.replace(written, f"127.0.0.1:{self.ports[name]}")
        return re.sub("/(chain|etc/prometheus|prometheus|run/secrets)(?=/|$)", rf"{self.path}/\1", text)

    @property
    def environment(self) -> dict[str, str]:
        kept = {name: value for name, value in os.environ.items() if not name.startswith(("ROS", "PROMETHEUS"))}
        ours = {"PATH": f"{self.path}/bin:{os.environ['PATH']}", "CREDENTIALS_DIRECTORY": f"{self.path}/run/secrets"}
        return kept | ours

    def start(self, name: str, command: list[str]) -> None:
        with (self.path / f"{name}.log").open("wb") as log:
            self.processes[name] = subprocess.Popen(
                command, cwd=self.path, env=self.environment, stdout=log, stderr=log, start_new_session=True
            )

    def do(self, *command: str, environment: dict[str, str] | None = None, given: str | None = None) -> str:
        done = subprocess.run(command, cwd=self.path, env=self.environment | (environment or {}), capture_output=True,
                              text=True, timeout=PATIENCE, check=False, input=given)  # fmt: skip
        assert done.returncode == 0, (command, done.stdout, done.stderr)
        return done.stdout

    def until(self, what: str, holds: Callable[[], Any]) -> None:
        deadline = time.monotonic() + PATIENCE
        while time.monotonic() < deadline:
            with contextlib.suppress(OSError, http.client.HTTPException, AssertionError):
                if holds():
                    return
            time.sleep(0.3)
        logs = {file.name: file.read_text(errors="replace")[-800:] for file in self.path.glob("*.log")}
        raise AssertionError(f"{what}: {logs}")

    def get(self, port: str, path: str) -> str:
        with contextlib.closing(http.client.HTTPConnection("127.0.0.1", self.ports[port], timeout=10)) as connection:
            connection.request("GET", path)
            answer = connection.getresponse()
            body = answer.read().decode()
        assert answer.status == 200, body
        return body

    def ask(self, expression: str) -> list[Any]:
        """What Prometheus finds for what Grafana would ask."""
        expression = expression.replace("$robot", ".*").replace("$__rate_interval", "10s").replace("$__interval", "10s")
        answer = json.loads(self.get("prometheus", "/api/v1/query?" + urlencode({"query": expression})))
        result: list[Any] = answer["data"]["result"]
        return result


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory, require: Callable[[str], str]) -> Iterator[Site]:
    for program in ("npx", "redis-server", "prometheus", "promtool"):
        require(program)
    made = Site(tmp_path_factory.mktemp("site"))
    made.ports = {name: free_port() for name in ("anvil", "redis", "prometheus", "robot")}
    made.ports |= {"monitor": free_port(count=2), "door": free_port(socket.SOCK_DGRAM, 2)}
    for folder in ("bin", "chain", "run/secrets", "redis", "prometheus"):
        (made.path / folder).mkdir(parents=True)
    (made.path / "bin/rosbridge-eth").write_text(
        f'#!/bin/sh\nPYTHONPATH="{ROOT / "src"}" exec "{sys.executable}" -m rosbridge_eth "$@"\n'
    )
    (made.path / "bin/rosbridge-eth").chmod(0o755)
    for role in ("operator", "reader", "robot"):
        (made.path / f"run/secrets/rosbridge-eth-{role}").write_text(f"the words of the {role}\n")
    try:
        instead = {"0.0.0.0": "127.0.0.1", "8545": str(made.ports["anvil"])}
        made.start("anvil", [instead.get(word) or made.here(word) for word in SERVICES["anvil"]["command"]])
        redis = SERVICES["redis"]["command"]
        made.start("redis", [*redis, "--port", str(made.ports["redis"]), "--dir", f"{made.path}/redis"])
        made.until("anvil answers", lambda: not socket.create_connection(("127.0.0.1", made.ports["anvil"]), 1).close())
        script = made.path / "setup.sh"
        script.write_text(made.here((DEPLOY / "setup.sh").read_text()))
        words = {name: made.here(re.sub(r"\$\{\w+:-(.*)\}", r"\1", value))
                 for name, value in SERVICES["setup"]["environment"].items()}  # fmt: skip
        for _ in range(2):  # run again, it finds what is there
            made.do("sh", str(script), environment=words)
        settings = made.path / "operator/server.toml"
        settings.write_text(settings.read_text().replace("\n[chain]", "\nshards = 2\n[chain]"))
        made.start("server", ["rosbridge-eth", *SERVICES["server"]["command"]])
        made.until("the server is ready", lambda: made.get("monitor", "/metrics"))
        made.do("rosbridge-eth", "join", "--name", "robot_1", "--source", "sim", "--topic", "/robot_1/odom")
        request = (made.path / "robot/request.json").read_text()
        made.do("rosbridge-eth", "register", "robot_1", "/dev/stdin", given=request)
        shutil.copy(made.path / "operator/bundles/robot_1.bundle", made.path / "robot")
        (made.path / "robot/robot.toml").write_text(ROBOT.replace("PORT", str(made.ports["robot"])))
        made.start("robot", ["rosbridge-eth", "robot"])
        shutil.copytree(DEPLOY / "prometheus", made.path / "etc/prometheus")
        config = made.path / "etc/prometheus/prometheus.yml"
        first, second = (f'"127.0.0.1:{made.ports["monitor"] + shard}"' for shard in range(2))
        config.write_text(made.here(config.read_text()).replace("_interval: 5s", "_interval: 1s").replace(
            first, f"{first}, {second}"))
        (config.parent / "robots.yml").write_text(f'- targets: ["127.0.0.1:{made.ports["robot"]}"]\n')
        made.do("promtool", "check", "config", str(config))
        made.start("prometheus", ["prometheus", *map(made.here, SERVICES["prometheus"]["command"]),
                                  f"--web.listen-address=127.0.0.1:{made.ports['prometheus']}"])  # fmt: skip
        made.until("the robot has chunks on the chain, and Prometheus has asked a few times", lambda: (
            made.ask("rosbridge_eth_chain_chunks > 0") and made.ask("rosbridge_eth_trigger_fired > 0")
            and made.ask("count_over_time(rosbridge_eth_captured[10s]) > 5") and made.ask("rosbridge_eth_gas > 0")
        ))
        yield made
    finally:
        for process in made.processes.values():
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGTERM)
        for process in made.processes.values():
            with contextlib.suppress(subprocess.TimeoutExpired):
                process.wait(10)
            with contextlib.suppress(ProcessLookupError):
                os.killpg(process.pid, signal.SIGKILL)


@pytest.mark.service
@pytest.mark.slow
def test_every_panel_shows_what_there_is(site: Site):
    shown = {
        family.name for port in ("monitor", "robot")
        for family in text_string_to_metric_families(site.get(port, "/metrics")) if family.samples
    }  # fmt: skip
    quiet = {f"rosbridge_eth_{name}" for name in ("lost", "datagrams_dropped", "forked_seconds")}  # as they happen
    assert {f"rosbridge_eth_{name}" for name in LABELS} - shown <= quiet
    for panel in PANELS:
        for target in panel["targets"]:
            found = site.ask(target["expr"])
            assert found or "empty" in panel["description"], (panel["title"], target["expr"])
            labels = set(re.findall(r"\{\{(\w+)\}\}", target["legendFormat"]))
            assert all(labels <= each["metric"].keys() for each in found), panel["title"]
    assert site.ask(DASHBOARD["annotations"]["list"][0]["expr"]) is not None
    robots = json.loads(site.get("prometheus", "/api/v1/label/robot/values?" + urlencode({
        "match[]": re.findall(r"label_values\((.*), robot\)", DASHBOARD["templating"]["list"][1]["query"]["query"])[0]
    })))  # fmt: skip
    assert robots["data"] == ["robot_1"]


@pytest.mark.service
@pytest.mark.slow
def test_the_rules_are_taken_and_find_nothing_wrong_with_what_is_well(site: Site):
    groups = json.loads(site.get("prometheus", "/api/v1/rules"))["data"]["groups"]
    assert [rule["name"] for group in groups for rule in group["rules"]] == [rule["alert"] for rule in RULES]
    fires = {rule["alert"] for rule in RULES if site.ask(rule["expr"])}
    assert fires <= {"Triggered", "HeadStands"}, "the robot's own event; anvil makes a block when there is something"
    assert site.ask("up == 0") == []
    assert len(site.ask('up{job="rosbridge-eth-server"}')) == 2, "of each shard"


@pytest.mark.service
@pytest.mark.slow
def test_a_shard_that_was_killed_is_seen(site: Site):
    """While the parent does not start it again."""
    [ready] = [panel["targets"][0]["expr"] for panel in PANELS if panel["title"] == "Server ready"]
    [alarm] = [rule["expr"] for rule in RULES if rule["alert"] == "NotAnswering"]
    events = map(json.loads, (site.path / "server.log").read_text().splitlines())
    pid = next(int(event["event"].rpartition(" ")[2]) for event in events if "shard-1 started" in event["event"])
    assert site.ask(ready)[0]["value"][1] == "1"
    site.processes["server"].send_signal(signal.SIGSTOP)
    try:
        os.kill(pid, signal.SIGKILL)
        site.until("the alarm", lambda: site.ask(alarm))
        assert site.ask(ready)[0]["value"][1] == "0"
    finally:
        site.processes["server"].send_signal(signal.SIGCONT)
    site.until("it is started again", lambda: site.ask(ready)[0]["value"][1] == "1")


@pytest.mark.service
@pytest.mark.slow
@pytest.mark.parametrize("name", ["anvil", "redis", "prometheus"])
def test_a_health_check_succeeds_where_the_service_is_well_and_fails_where_it_is_not(
    site: Site, name: str, require: Callable[[str], str]
):
    kind, program, *arguments = map(site.here, SERVICES[name]["healthcheck"]["test"])
    command = [require(program), *(["-p", str(site.ports["redis"])] if name == "redis" else []), *arguments]
    assert kind == "CMD"
    site.do(*command)
    elsewhere = [word.replace(str(site.ports[name]), str(free_port())) for word in command]
    assert subprocess.run(elsewhere, capture_output=True, timeout=60, check=False).returncode != 0
