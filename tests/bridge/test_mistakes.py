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

import rosbridge_eth
from bridge.test_cli import Capture, fails, made, place
from rosbridge_eth.bundle import open_bundle
from rosbridge_eth.capture import RawMessage
from rosbridge_eth.cli import run
from rosbridge_eth.config import load_robot_config
from rosbridge_eth.errors import ExitCode, IdentityError
from rosbridge_eth.home import OperatorHome, RobotHome
from rosbridge_eth.identity import Role, load_identity
from rosbridge_eth.ledger.accounts import Keyring
from rosbridge_eth.registry import Registry
from rosbridge_eth.robot.assembly import join, open_robot
from rosbridge_eth.robot.clock import certificate_clock
from rosbridge_eth.server.administration import enrol_reader, load_ca, renew_server

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


def test_keys_that_are_not_there_are_named(place: Path) -> None:
    bundle = open_bundle(Path(BUNDLE).read_bytes(), b"robot's")
    for name in ("sign.key.pem", "enc.key.pem"):
        del bundle.identity[name]
    with pytest.raises(IdentityError, match=r"nowhere/sign\.key\.pem cannot be read"):
        join(RobotHome(Path("other")), bundle, b"robot's", Path("nowhere"))
    assert not Path("other").exists()


def test_a_robot_whose_clock_begins_in_1970_believes_the_certificates_it_joined_with(place: Path) -> None:
    home = RobotHome(Path("robot"))
    identity, _ = load_identity(OperatorHome(Path("operator")).server, b"operator's")
    at = certificate_clock(home, lambda: DAY_ONE)()
    assert identity.role is Role.SERVER
    assert identity.public.not_before <= at <= datetime.now(UTC)


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


@pytest.mark.parametrize("home, whose", [("operator", "an operator's"), ("operator/readers/owner", "a reader's")])
def test_a_robot_does_not_move_into_a_home_of_another_kind(
    place: Path, home: str, whose: str, capsys: Capture
) -> None:
    before = {path: path.read_bytes() for path in Path("operator").rglob("*") if path.is_file()}
    fails(capsys, ExitCode.CONFIG, f"{home} is {whose} home", "join", BUNDLE, "--home", home, "--password-file", "word")
    assert {path: path.read_bytes() for path in Path("operator").rglob("*") if path.is_file()} == before


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


def test_the_server_is_renewed_twice_within_a_second(place: Path) -> None:
    home, now = OperatorHome(Path("operator")), datetime.now(UTC)
    ca = load_ca(home, b"operator's")
    first = load_identity(home.server, b"operator's")[0].signing_certificate
    kept = [renew_server(home, ca=ca, passphrase=b"operator's", now=now) for _ in range(3)]
    assert len(set(kept)) == 3
    assert load_identity(kept[0], b"operator's")[0].signing_certificate.to_der() == first.to_der()
    assert load_identity(home.server, b"operator's")[0].role is Role.SERVER
    assert not [path.name for path in home.path.iterdir() if "new" in path.name]


def test_a_readers_name_is_made_anew_on_demand_and_the_old_keys_are_kept(place: Path, capsys: Capture) -> None:
    ours = ("--passphrase-file", "pass", "--password-file", "word")
    assert run(["reader", "analyst", *ours]) == 0
    folder = OperatorHome(Path("operator")).reader("analyst")
    old, _ = load_identity(folder, b"robot's")
    fails(capsys, ExitCode.IDENTITY, "--replace", "reader", "analyst", *ours)
    assert run(["revoke", "analyst", "--role", "reader", "--passphrase-file", "pass"]) in (0, ExitCode.CHAIN)
    fails(capsys, ExitCode.IDENTITY, "--replace", "reader", "analyst", *ours)
    for _ in range(2):  # a revoked one, and one in force
        assert run(["reader", "analyst", "--replace", *ours]) == 0
    new, _ = load_identity(folder, b"robot's")
    assert {path.name for path in folder.iterdir()} >= {"public.pem", "reader.toml", "enc.key.pem"}
    registry = Registry(Path("operator/registry.sqlite"))
    assert registry.allows("reader", "analyst", new.signing_certificate.fingerprint())
    assert not registry.allows("reader", "analyst", old.signing_certificate.fingerprint())
    kept = sorted(path for path in folder.parent.iterdir() if path.name.startswith("analyst.until-"))
    assert len(kept) == 2 and str(kept[0]) in capsys.readouterr().err
    assert any(load_identity(path, b"robot's")[0].encryption_certificate == old.encryption_certificate for path in kept)


def test_a_reader_that_is_not_made_leaves_the_old_one_where_it_is(
    place: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    home, now = OperatorHome(Path("operator")), datetime.now(UTC)
    ca = load_ca(home, b"operator's")
    before = sorted(home.path.rglob("*"))
    monkeypatch.setattr("rosbridge_eth.server.administration.write_reader_toml", lambda *_: 1 / 0)
    with pytest.raises(ZeroDivisionError):
        enrol_reader(home, "owner", ca=ca, password=b"word", now=now, replace=True)
    assert [path for path in sorted(home.path.rglob("*")) if "registry" not in path.name] == [
        path for path in before if "registry" not in path.name
    ]
    registry = Registry(home.registry)
    assert registry.find("reader", "owner") == registry.all("reader")[0]


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
