"""The units, the container file, the rules and the pages fit the program they are for."""

from __future__ import annotations

import re
import subprocess
import tomllib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import typer.main

from bridge.figures import LABELS
from rosbridge_eth.cli import app
from rosbridge_eth.errors import ExitCode

ROOT = Path(__file__).resolve().parents[3]
UNITS = sorted((ROOT / "deploy/systemd").glob("*.service"))
PAGE = (ROOT / "docs/operations.md").read_text(encoding="utf-8")
RULES = (ROOT / "deploy/prometheus/rosbridge-eth.rules.yml").read_text(encoding="utf-8")
PAGES = ("operations.md", "howto-poa.md", "walkthrough.md")


@pytest.mark.service
@pytest.mark.parametrize("unit", UNITS, ids=lambda path: path.stem)
def test_systemd_finds_nothing_wrong_with_a_unit(unit: Path, require: Callable[[str], str], tmp_path: Path):
    copy = tmp_path / unit.name  # the program is not installed here; everything else is as it is
    copy.write_text(re.sub(r"^ExecStart=\S+", "ExecStart=/bin/true", unit.read_text(), flags=re.MULTILINE))
    done = subprocess.run([require("systemd-analyze"), "verify", "--man=no", str(copy)], capture_output=True, text=True,
                          check=False)
    assert (done.returncode, done.stderr) == (0, "")


def parse(arguments: list[str]) -> None:
    """What the real command line makes of arguments, without running anything."""
    group: Any = typer.main.get_command(app)
    command = group.commands[arguments[0]]
    command.make_context(arguments[0], arguments[1:])


@pytest.mark.parametrize("unit", UNITS, ids=lambda path: path.stem)
def test_a_unit_starts_a_command_that_exists_with_the_credential_it_looks_for(unit: Path):
    text = unit.read_text()
    program, *arguments = re.findall(r"^ExecStart=(.*)$", text, re.MULTILINE)[0].split()
    assert program.endswith("/rosbridge-eth")
    parse([argument.replace("%i", "1") for argument in arguments])
    role = {"server": "operator", "robot": "robot"}[arguments[0]]
    assert f"LoadCredential=rosbridge-eth-{role}:" in text
    kept_down = {int(code) for code in re.findall(r"^RestartPreventExitStatus=(.*)$", text, re.MULTILINE)[0].split()}
    assert kept_down == {ExitCode.USAGE, ExitCode.CONFIG, ExitCode.IDENTITY}
    assert "Type=notify" in text and re.search(r"^WatchdogSec=\d+$", text, re.MULTILINE)


def test_a_robots_unit_waits_for_no_network_and_leaves_room_for_every_publisher():
    [unit] = [path for path in UNITS if path.stem.endswith("robot")]
    settings = dict(re.findall(r"^(\w+)=(.*)$", unit.read_text(), re.MULTILINE))
    assert settings["After"] == "network.target" and "Wants" not in settings
    assert int(settings["TasksMax"]) >= 512, "a thread for each publisher"


def test_the_container_runs_a_command_that_exists_as_nobody_special_and_holds_no_secret():
    text = (ROOT / "deploy/Containerfile").read_text()
    final = text.rpartition("\nFROM ")[2]
    assert re.search(r"^USER (?!0|root)", final, re.MULTILINE)
    assert "HEALTHCHECK" in final and "/metrics" in final
    command = re.findall(r"^CMD (\[.*\])$", final, re.MULTILINE)[-1]
    parse(re.findall(r'"([^"]*)"', command))
    copied = re.findall(r"^COPY (?!--from)(.*) \S+$", text, re.MULTILINE)
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    assert {*" ".join(copied).split()} == {"pyproject.toml", "src", project["readme"], *project["license-files"]}


def test_the_page_describes_every_metric_there_is():
    section = PAGE.partition("### Metrics")[2].partition("## When an alarm rings")[0]
    rows = re.findall(r"^- `(\w+)` \((.*?)\): .+$", section, re.MULTILINE)
    assert dict(rows) == {name: ", ".join(f"`{label}`" for label in labels) for name, labels in LABELS.items()}


def test_every_rule_is_on_the_page_and_asks_for_metrics_and_labels_that_exist():
    alerts = re.findall(r"alert: (\w+)", RULES)
    assert len(alerts) > 20 and len(set(alerts)) == len(alerts)
    section = PAGE.partition("## When an alarm rings")[2].partition("### Exit codes")[0]
    assert alerts == re.findall(r"^- \*\*([A-Z]\w+)\*\*: ", section, re.MULTILINE)
    assert set(re.findall(r"rosbridge_eth_(\w+)", RULES)) <= LABELS.keys()
    for name, label in re.findall(r"rosbridge_eth_(\w+)\{(\w+)=", RULES):
        assert label in LABELS[name], name


def test_the_conditions_that_rules_ask_for_are_said_by_the_program():
    source = (ROOT / "src/rosbridge_eth/server/metrics.py").read_text()
    for condition in re.findall(r'condition\{name="([^"]+)"\}', RULES):
        assert f'"{condition}"' in source, condition


def test_the_page_names_every_exit_code():
    listed = {int(code) for code in re.findall(r"(?:^|· ?\n?)(\d+) [a-z]", PAGE.partition("### Exit codes")[2], re.M)}
    assert {int(code) for code in ExitCode} <= listed


@pytest.mark.parametrize("page", PAGES)
def test_every_command_on_a_page_exists_with_its_options(page: str):
    """Of every code block and every `rosbridge-eth …` within a line, as far as they are not cut short with an …"""
    text = (ROOT / "docs" / page).read_text(encoding="utf-8")
    blocks = "\n".join(re.findall(r"^```(?:sh|bash)?\n(.*?)^```", text, re.MULTILINE | re.DOTALL)).replace("\\\n", " ")
    found = re.findall(r"rosbridge-eth ((?!_)[a-z][^`\n|&;>#]*)", blocks) + re.findall(r"`rosbridge-eth ([^`]+)`", text)
    group: Any = typer.main.get_command(app)
    assert found
    for line in found:
        name, *arguments = line.split()
        assert name in group.commands, line
        options = {option for parameter in group.commands[name].params for option in (*parameter.opts,)} | {"--help"}
        assert {argument for argument in arguments if argument.startswith("--")} <= options, line


def test_every_extra_that_is_named_is_one_of_the_distribution():
    """In what the programs and the pages say: `pip install '.[bridge]'`, `NAME[table]`, a wheel's `…whl[bridge]`."""
    project = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]
    files = [*(ROOT / "src").rglob("*.py"), *(ROOT / "docs").rglob("*.md"), *ROOT.glob("*.md"), ROOT / ".ci/run"]
    form = re.compile(r"([\w.-]*smcrypto[\w.-]*|(?<=')\.|WHEEL)\[([a-z0-9,]+)\]")
    named = [(file.name, *found) for file in files for found in form.findall(file.read_text(encoding="utf-8"))]
    assert len(named) > 10
    for file, distribution, extras in named:
        assert distribution in (".", "WHEEL", project["name"]) or distribution.endswith(".whl"), (file, distribution)
        assert set(extras.split(",")) <= project["optional-dependencies"].keys(), (file, extras)
