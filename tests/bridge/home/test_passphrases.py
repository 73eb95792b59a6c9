"""Passphrases come from a file, the credentials folder or a terminal, and never silently from nowhere."""

from __future__ import annotations

import contextlib
import io
import os
import pty
import subprocess
import sys
from pathlib import Path

import pytest

from rosbridge_eth.config.passphrases import passphrase_file, read_passphrase
from rosbridge_eth.errors import IdentityError


def test_the_first_line_of_the_file_is_the_passphrase(tmp_path: Path) -> None:
    (tmp_path / "p").write_bytes(b"two words\r\nsecond line\n")
    assert read_passphrase("robot", "Robot", file=tmp_path / "p") == b"two words"


def test_the_credentials_folder_is_used_where_no_file_is_named(tmp_path: Path) -> None:
    (tmp_path / "rosbridge-eth-operator").write_bytes(b"secret")
    environment = {"CREDENTIALS_DIRECTORY": str(tmp_path)}
    assert read_passphrase("operator", "Operator", environment=environment) == b"secret"


def test_which_file_holds_in_which_order(tmp_path: Path) -> None:
    for name in ("given", "named", "rosbridge-eth-operator"):
        (tmp_path / name).write_text(name)
    credentials = {"CREDENTIALS_DIRECTORY": str(tmp_path)}
    variable = {"ROSBRIDGE_ETH_OPERATOR_PASSPHRASE_FILE": str(tmp_path / "named")}

    def read(file: str | None, environment: dict[str, str]) -> bytes:
        return read_passphrase(
            "operator", "Operator", file=None if file is None else tmp_path / file, environment=environment,
        )

    assert read("given", credentials | variable) == b"given"
    assert read(None, credentials | variable) == b"named"
    assert read(None, credentials) == b"rosbridge-eth-operator"
    assert passphrase_file("operator", {}) is None
    assert passphrase_file("operator", {"CREDENTIALS_DIRECTORY": "/nowhere"}) is None


@pytest.mark.parametrize("content", [b"", b"\n", None])
def test_an_empty_or_missing_file_is_refused_by_name(tmp_path: Path, content: bytes | None) -> None:
    if content is not None:
        (tmp_path / "p").write_bytes(content)
    with pytest.raises(IdentityError, match=r"/p"):
        read_passphrase("robot", "Robot", file=tmp_path / "p")


@pytest.mark.parametrize("name, confirm, option", [
    ("operator", False, "--passphrase-file"), ("operator", True, "--passphrase-file"),
    ("reader", False, "--passphrase-file"), ("reader", True, "--password-file"), ("robot", False, "--password-file"),
])
def test_without_a_terminal_it_does_not_wait(
    name: str, confirm: bool, option: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr("sys.stdin", io.StringIO(""))
    with pytest.raises(IdentityError, match=option):
        read_passphrase(name, "Of whom", environment={}, confirm=confirm)


@pytest.mark.parametrize("typed", [["\x04"], ["words\n", "\x04"]])
def test_the_end_of_input_at_a_terminal_says_the_same(typed: list[str]) -> None:
    """Ctrl-D at the first prompt, and at the second: what is raised by a process whose input is a terminal."""
    script = (
        "from rosbridge_eth.errors import IdentityError\n"
        "from rosbridge_eth.config.passphrases import read_passphrase\n"
        "try: read_passphrase('operator', 'Operator passphrase', environment={}, confirm=True)\n"
        "except IdentityError as error: print('SAID', error)\n"
    )
    ours, theirs = pty.openpty()
    process = subprocess.Popen([sys.executable, "-c", script], stdin=theirs, stdout=theirs, stderr=theirs,
                               start_new_session=True)
    os.close(theirs)
    shown = ""
    for number, answer in enumerate(typed, 1):
        while shown.count(": ") < number:  # each prompt ends so
            shown += os.read(ours, 1024).decode()
        os.write(ours, answer.encode())
    with contextlib.suppress(OSError):  # how Linux tells that the other side of a terminal is closed
        while part := os.read(ours, 1024):
            shown += part.decode()
    os.close(ours)
    assert process.wait(timeout=30) == 0
    assert "SAID the operator passphrase is needed and none was given: give --passphrase-file" in shown
    assert "words" not in shown and "Traceback" not in shown
