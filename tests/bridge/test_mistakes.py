"""What goes wrong where no part of the bridge has a sentence of its own: still one line, a code, and nothing lost."""

from __future__ import annotations

import os
import re
import sqlite3
import subprocess
import sys
import threading
from collections.abc import Callable
from pathlib import Path

import pytest

import rosbridge_eth
from bridge.disks import fill_up, small_disk
from bridge.operations.conftest import PASSWORD, READERS, Place
from bridge.test_cli import BUNDLE, ODOM, OPERATOR, Capture, _files, _made, fails, place
from rosbridge_eth import terminal
from rosbridge_eth.capture import RawMessage
from rosbridge_eth.cli import run
from rosbridge_eth.config import load_robot_config
from rosbridge_eth.errors import ExitCode
from rosbridge_eth.identity import load_identity, read_certificates
from rosbridge_eth.ledger.transport import Node
from rosbridge_eth.operator.registry import Registry
from rosbridge_eth.reading.evidence import Asked
from rosbridge_eth.robot.loop import open_robot, reader_keys

__all__ = ["_files", "_made", "place"]  # fixtures

SOURCE = str(Path(rosbridge_eth.__file__).parents[1])


def test_a_file_in_the_way_of_a_folder_is_one_line(capsys: Capture) -> None:
    Path("taken").write_text("not a folder")
    error = fails(capsys, ExitCode.FAILED, "taken", "join", "--name", "x", "--home", "taken/robot",
                  "--password-file", "word")  # fmt: skip
    assert len(error.splitlines()) == 1
    fails(capsys, ExitCode.FAILED, "taken", "init", "--home", "taken/operator", "--reader", "r", *OPERATOR,
          "--reader-passphrase-file", "readers")


def test_a_database_that_fails_while_it_is_used_is_one_line(capsys: Capture) -> None:
    holder = sqlite3.connect("operator/registry.sqlite", isolation_level=None)
    holder.execute("ALTER TABLE enrolment RENAME COLUMN account TO part")  # opens, and fails at the first write
    holder.execute("ALTER TABLE enrolment RENAME COLUMN revoked_at TO gone")
    holder.close()
    error = fails(capsys, ExitCode.STORE, "database", "renew", *OPERATOR)
    assert len(error.splitlines()) == 1


def test_a_full_disk_at_the_operators_is_one_line(place: Place, tmp_path: Path, capsys: Capture) -> None:
    with small_disk(tmp_path / "disk", "1m") as disk:
        fill_up(disk)
        error = fails(capsys, ExitCode.FAILED, "No space left", "join", "--name", "x", "--home", str(disk / "robot"),
                      "--password-file", "word")  # fmt: skip
        assert len(error.splitlines()) == 1


@pytest.mark.parametrize("unbuffered", ["", "1"])
def test_a_reader_of_the_output_that_has_enough_is_no_mistake(place: Place, unbuffered: str) -> None:
    environment = {**os.environ, "PYTHONPATH": SOURCE, "PYTHONUNBUFFERED": unbuffered}
    process = subprocess.Popen([sys.executable, "-m", "rosbridge_eth", "status", "--json"], stdout=subprocess.PIPE,
                               stderr=subprocess.PIPE, env=environment)  # fmt: skip
    assert process.stdout is not None and process.stderr is not None
    process.stdout.close()
    assert process.stderr.read() == b""
    assert process.wait(60) == ExitCode.FAILED


@pytest.mark.parametrize("unbuffered", ["", "1"])
def test_output_that_cannot_be_written_is_one_line(place: Place, unbuffered: str) -> None:
    environment = {**os.environ, "PYTHONPATH": SOURCE, "PYTHONUNBUFFERED": unbuffered}
    with open("/dev/full", "w") as full:
        process = subprocess.run([sys.executable, "-m", "rosbridge_eth", "status", "--json"], stdout=full,
                                 stderr=subprocess.PIPE, text=True, env=environment, check=False)  # fmt: skip
    assert (process.returncode, process.stderr) == (ExitCode.FAILED, "rosbridge-eth: No space left on device\n")


@pytest.mark.parametrize("closed, code, says", [
    ("<&-", ExitCode.IDENTITY, "rosbridge-eth: the reader passphrase is needed and there is no terminal to ask at: "
     "give --passphrase-file"),
    (">&-", ExitCode.FAILED, "rosbridge-eth: not writable"), ("<&- >&- 2>&-", ExitCode.FAILED, None),
])  # fmt: skip
def test_streams_that_were_closed_before(place: Place, closed: str, code: ExitCode, says: str | None) -> None:
    command = "read robot_1" if closed == "<&-" else "status --json"
    process = subprocess.run(
        ["bash", "-c", f'"{sys.executable}" -m rosbridge_eth {command} {closed}'], stderr=subprocess.PIPE, text=True,
        env={**os.environ, "PYTHONPATH": SOURCE}, check=False,
    )
    assert (process.returncode, process.stderr) == (code, f"{says}\n" if says else "")


def test_a_source_that_breaks_ends_the_robot_with_its_error(place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    place.robot.config.write_text(f'{ODOM}[source]\nkind = "sim"\n')
    robot = open_robot(place.robot, load_robot_config(place.robot.config), PASSWORD)

    def breaks(emit: Callable[[RawMessage], None], stop: threading.Event) -> None:
        raise MemoryError("no room for this message")

    monkeypatch.setattr(robot.source, "run", breaks)
    with pytest.raises(MemoryError):
        robot.run(on_turn=lambda: robot.stop() if robot._source_ended.is_set() else None)


@pytest.mark.parametrize("home, whose", [("operator", "an operator's"), ("reader", "a reader's")])
def test_a_robot_does_not_move_into_a_home_of_another_kind(home: str, whose: str, capsys: Capture) -> None:
    before = {path: path.read_bytes() for path in Path(home).rglob("*") if path.is_file()}
    fails(capsys, ExitCode.CONFIG, f"{home} is {whose} home", "join", BUNDLE, "--home", home)
    fails(capsys, ExitCode.CONFIG, f"{home} is {whose} home", "join", "--name", "x", "--home", home,
          "--password-file", "word")
    assert {path: path.read_bytes() for path in Path(home).rglob("*") if path.is_file()} == before


def test_ctrl_c_while_the_packages_load_is_one_line(tmp_path: Path) -> None:
    (tmp_path / "typer.py").write_text("import os, signal\nos.kill(os.getpid(), signal.SIGINT)\n")
    process = subprocess.run(
        [sys.executable, "-m", "rosbridge_eth", "status"], capture_output=True, text=True, timeout=60, check=False,
        env={**os.environ, "PYTHONPATH": os.pathsep.join([str(tmp_path), SOURCE])},
    )
    assert (process.returncode, process.stderr) == (130, "rosbridge-eth: interrupted\n")


@pytest.mark.parametrize("emptied", [False, True])
@pytest.mark.parametrize("command", [
    ("status",), ("renew",),
    ("reader", "analyst", "--reader-passphrase-file", "word"),
])
def test_a_lost_registry_is_told_and_nothing_is_built_upon_an_empty_one(
    command: tuple[str, ...], emptied: bool, capsys: Capture
) -> None:
    registry = Path("operator/registry.sqlite")
    for part in Path("operator").glob("registry.sqlite*"):
        part.unlink()
    if emptied:
        registry.touch()
    before = sorted(path for path in Path().rglob("*") if not path.name.startswith("registry"))
    more = () if command == ("status",) else OPERATOR
    error = fails(capsys, ExitCode.STORE, "restore registry.sqlite from your backup", *command, *more)
    assert len(error.splitlines()) == 1
    assert registry.exists() == emptied
    assert sorted(path for path in Path().rglob("*") if not path.name.startswith("registry")) == before


def test_another_reader_is_made_carried_and_given_to_a_robot(place: Place, capsys: Capture) -> None:
    ours = (*OPERATOR, "--reader-passphrase-file", "word")
    assert run(["reader", "analyst", *ours]) == 0
    assert "public.pem" in capsys.readouterr().err
    fails(capsys, ExitCode.CONFIG, "home already", "reader", "analyst", *ours)
    fails(capsys, ExitCode.IDENTITY, "--replace", "reader", "analyst", "--to", "elsewhere", *ours)
    assert run(["reader", "analyst", "--to", "elsewhere", "--replace", *ours]) == 0
    carried = Path("elsewhere").rename("carried")
    content = b"".join(path.read_bytes() for path in carried.iterdir())
    assert not any(secret in content for secret in (b"node-key", b"path-key", b"query-key", READERS))
    # As far as the node, which is not there: everything before it was found in the folder.
    fails(capsys, ExitCode.CHAIN, "127.0.0.1:9", "read", "robot_1", "--home", "carried", "--passphrase-file", "word")
    roots = read_certificates((place.robot.identity / "ca.crt.pem").read_bytes())
    before = reader_keys(place.robot, roots)
    (place.robot.readers / "analyst.pem").write_bytes((carried / "public.pem").read_bytes())
    identity, _ = load_identity(carried, PASSWORD)
    after = {key.to_bytes() for key in reader_keys(place.robot, roots)}
    assert after == {key.to_bytes() for key in before} | {identity.encryption_key.public_key.to_bytes()}
    assert run(["revoke", "analyst", "--role", "reader", *OPERATOR]) == 0, "that takes no node"
    with Registry(place.operator.registry) as registry:
        assert [reader.name for reader in registry.readers()] == ["owner"]


def test_a_node_that_confirms_evidence_is_named_without_its_keys(
    monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    vectors = Path(__file__).resolve().parents[1] / "vectors" / "evidence"
    url = "https://user:node-key@rpc.example:8545/path-key?token=query-key"
    node = Node(url, 1.0, [])  # as a ledger says which one it asks
    monkeypatch.setattr("rosbridge_eth.reading.evidence.ask", lambda *_: Asked(node.url, {7: 1_795_219_200}, 1, False))
    assert run(["verify", str(vectors / "span.json"), "--ca", str(vectors / "ca.crt.pem"), "--node", url]) == 0
    said = capsys.readouterr().err
    assert len(re.findall(r"says https://rpc\.example:8545[ .\n]", said)) == 2
    assert not any(secret in said for secret in ("node-key", "path-key", "query-key"))


def test_what_is_said_is_never_markup(capsys: Capture) -> None:
    terminal.talk("[red]what a stranger[/red] says [/]")
    assert capsys.readouterr().err == "[red]what a stranger[/red] says [/]\n"
    terminal.data.print(terminal.table("T", ["a"], [["[red]x[/red] [/]"]]))
    assert "[red]x[/red] [/]" in capsys.readouterr().out


def test_what_is_said_is_shown_letter_by_letter(capsys: Capture) -> None:
    address, escaped = "[2001:db8:a:b::1]:7410", r"\[red]x"
    terminal.talk(address)
    terminal.data.print(terminal.table(r"\[red]of", ["a"], [[address], [escaped]]))
    shown = capsys.readouterr()
    assert shown.err == f"{address}\n", "and :b: is no picture"
    assert address in shown.out and escaped in shown.out and r"\[red]of" in shown.out


def test_json_goes_to_stdout_and_words_to_stderr(place: Place) -> None:
    environment = {**os.environ, "PYTHONPATH": SOURCE}
    done = subprocess.run([sys.executable, "-m", "rosbridge_eth", "doctor", "--json"], capture_output=True, text=True,
                          env=environment, check=False)  # fmt: skip
    assert done.stdout.startswith("{") and done.stdout.count("\n") == 1
    assert done.returncode == ExitCode.FAILED and "broken: 1; each line" in done.stderr
