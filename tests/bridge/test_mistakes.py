"""What goes wrong where no part of the bridge has a sentence of its own: still one line, a code, and nothing lost."""

from __future__ import annotations

import json
import os
import sqlite3
import subprocess
import sys
import threading
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

import pytest
from rosbridge_eth.robot.assembly import open_robot

import rosbridge_eth
from bridge.test_cli import Capture, fails, made, place
from rosbridge_eth.capture import RawMessage
from rosbridge_eth.cli import run
from rosbridge_eth.config import load_robot_config
from rosbridge_eth.errors import ExitCode
from rosbridge_eth.home import RobotHome
from rosbridge_eth.ledger.accounts import Keyring
from rosbridge_eth.registry import Registry

__all__ = ["made", "place"]  # fixtures

BUNDLE = "operator/bundles/robot_1.bundle"
DAY_ONE = 42.0  # seconds after the first of January 1970: a clock without a battery


def test_a_file_in_the_way_of_a_folder_is_one_line(place: Path, capsys: Capture) -> None:
    Path("taken").write_text("not a folder")
    error = fails(capsys, ExitCode.FAILED, "taken", "join", BUNDLE, "--home", "taken/robot", "--password-file", "word")
    assert len(error.splitlines()) == 1
    fails(capsys, ExitCode.FAILED, "taken", "init", "--home", "taken/operator", "--passphrase-file", "pass")


def test_a_database_that_fails_while_it_is_used_is_one_line(place: Path, capsys: Capture) -> None:
    holder = sqlite3.connect("operator/registry.sqlite", isolation_level=None)
    holder.execute("ALTER TABLE enrolment RENAME COLUMN role TO part")  # opens, and fails at the first question
    holder.close()
    error = fails(capsys, ExitCode.STORE, "database", "status")
    assert len(error.splitlines()) == 1


def test_a_source_that_breaks_ends_the_robot_with_its_error(place: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    home = RobotHome(Path("robot"))
    Path("robot/robot.toml").write_text('topics = ["/robot_1/odom"]\n[source]\nkind = "sim"\n')
    robot = open_robot(home, load_robot_config(home.config), b"robot's")

    def breaks(emit: Callable[[RawMessage], None], stop: threading.Event) -> None:
        raise MemoryError("no room for this message")

    monkeypatch.setattr(robot._source, "run", breaks)
    with pytest.raises(MemoryError):
        robot.run()


def test_usage_is_still_told_by_its_own_code(place: Path) -> None:
    assert run(["read"]) == ExitCode.USAGE


def test_ctrl_c_while_the_packages_load_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "typer.py").write_text("import os, signal\nos.kill(os.getpid(), signal.SIGINT)\n")
    source = str(Path(rosbridge_eth.__file__).parents[1])
    process = subprocess.run(
        [sys.executable, "-m", "rosbridge_eth", "status"], capture_output=True, text=True, timeout=60, check=False,
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), source])},
    )
    assert (process.returncode, process.stderr) == (130, "rosbridge-eth: interrupted\n")


@pytest.mark.parametrize("emptied", [False, True])
@pytest.mark.parametrize("command", [
    ("status",), ("register", "robot_2", "--password-file", "word"), ("revoke", "robot_1"),
    ("reader", "analyst", "--password-file", "word"), ("renew",), ("export", "robot_1", "keystore.json"),
])
def test_a_lost_registry_is_told_and_nothing_is_built_upon_an_empty_one(
    place: Path, command: tuple[str, ...], emptied: bool, capsys: Capture
) -> None:
    registry = Path("operator/registry.sqlite")
    for part in Path("operator").glob("registry.sqlite*"):
        part.unlink()
    if emptied:
        registry.touch()
    before = sorted(path for path in Path("operator").rglob("*") if not path.name.startswith("registry"))
    more = () if command == ("status",) else ("--passphrase-file", "pass")
    error = fails(capsys, ExitCode.STORE, "restore registry.sqlite from your backup", *command, *more)
    assert len(error.splitlines()) == 1
    assert registry.exists() == emptied
    assert sorted(path for path in Path("operator").rglob("*") if not path.name.startswith("registry")) == before


def test_export_never_takes_the_treasury_for_a_robot(place: Path, capsys: Capture) -> None:
    ours = ("--passphrase-file", "pass", "--password-file", "word")
    registry = Registry(Path("operator/registry.sqlite"))
    registry.enrol(number=registry.next_number(), role="robot", name="operator", fingerprint=b"f" * 32,
                   certificates=b"", account="0x1", now=datetime.now(UTC))  # before the name was reserved
    fails(capsys, ExitCode.IDENTITY, "--role", "export", "operator", "a.json", *ours)
    assert not Path("a.json").exists()
    assert run(["export", "operator", "a.json", "--role", "operator", *ours]) == 0
    assert run(["export", "operator", "b.json", "--role", "robot", *ours]) == 0
    registry.revoke("robot", "operator", datetime.now(UTC))
    assert run(["export", "operator", "c.json", *ours]) == 0
    keys = Keyring.load(Path("operator/accounts.json"), b"operator's")
    addresses = [json.loads(Path(file).read_text())["address"][-40:].lower() for file in ("a.json", "b.json", "c.json")]
    treasury = keys.operator.address.lower().removeprefix("0x")
    assert [address == treasury for address in addresses] == [True, False, True]
    fails(capsys, ExitCode.IDENTITY, "reader 'owner'", "export", "owner", "d.json", "--role", "reader", *ours)


def test_a_record_is_asked_for_by_a_name_that_is_enrolled_and_a_stream_that_is_one(
    place: Path, capsys: Capture
) -> None:
    stream = "0f" * 16
    fails(capsys, ExitCode.IDENTITY, "no robot 'robot_9' is enrolled; `status` lists", "check", "robot_9", stream, "1")
    for wrong in ("zz", "0f" * 15, "0f" * 17, "0f " * 16):
        fails(capsys, ExitCode.CONFIG, "the stream is 32 hex digits", "check", "robot_1", wrong, "1")
    assert run(["check", "robot_1", stream, "1"]) == 0
    assert capsys.readouterr().out.strip() == "unknown"
