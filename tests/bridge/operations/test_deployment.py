"""The units, the container file and the pages fit the program they are for."""

from __future__ import annotations

import re
import subprocess
from collections.abc import Callable
from pathlib import Path
from typing import Any

import pytest
import typer.main

from rosbridge_eth.cli import app
from rosbridge_eth.errors import ExitCode
from rosbridge_eth.operations.figures import METRICS, Kind, reference

ROOT = Path(__file__).resolve().parents[3]
UNITS = sorted((ROOT / "deploy/systemd").glob("*.service"))
PAGE = (ROOT / "docs/operations.md").read_text(encoding="utf-8")
RULES = (ROOT / "deploy/prometheus/rosbridge-eth.rules.yml").read_text(encoding="utf-8")


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
    parse(arguments)
    role = {"server": "operator", "robot": "robot"}[arguments[0]]
    assert f"LoadCredential=rosbridge-eth-{role}:" in text
    kept_down = {int(code) for code in re.findall(r"^RestartPreventExitStatus=(.*)$", text, re.MULTILINE)[0].split()}
    assert kept_down == {ExitCode.USAGE, ExitCode.CONFIG, ExitCode.IDENTITY}


def test_the_container_runs_a_command_that_exists_as_nobody_special_and_holds_no_secret():
    text = (ROOT / "deploy/Containerfile").read_text()
    final = text.rpartition("\nFROM ")[2]
    assert re.search(r"^USER (?!0|root)", final, re.MULTILINE)
    assert "HEALTHCHECK" in final and "/healthz" in final
    command = re.findall(r"^CMD (\[.*\])$", final, re.MULTILINE)[-1]
    parse(re.findall(r'"([^"]*)"', command))
    copied = re.findall(r"^COPY (?!--from)(.*) \S+$", text, re.MULTILINE)
    assert sorted(" ".join(copied).split()) == ["LICENSE", "README.md", "pyproject.toml", "src"]


def test_the_page_describes_every_metric_there_is():
    assert reference() in PAGE


def test_every_rule_is_on_the_page_and_asks_for_metrics_that_exist():
    alerts = re.findall(r"alert: (\w+)", RULES)
    assert len(alerts) > 15
    for alert in alerts:
        assert f"| {alert} |" in PAGE, alert
    shown = {metric.shown + ("_bucket" if metric.kind is Kind.HISTOGRAM else "") for metric in METRICS.values()}
    asked = set(re.findall(r"rosbridge_eth_\w+", RULES))
    assert asked <= shown


def test_the_page_names_every_exit_code():
    listed = {int(code) for code in re.findall(r"(?:^|· ?\n?)(\d+) [a-z]", PAGE.partition("### Exit codes")[2], re.M)}
    assert {int(code) for code in ExitCode} <= listed
