"""Passphrases come from a file, the credentials folder or a terminal, and never silently from nowhere."""

from __future__ import annotations

import io
from pathlib import Path

import pytest

from rosbridge_eth.errors import IdentityError
from rosbridge_eth.passphrases import read_passphrase


def test_the_first_line_of_the_file_is_the_passphrase(tmp_path: Path) -> None:
    (tmp_path / "p").write_bytes(b"two words\r\nsecond line\n")
    assert read_passphrase("robot", "Robot", file=tmp_path / "p") == b"two words"


def test_the_credentials_folder_is_used_where_no_file_is_named(tmp_path: Path) -> None:
    (tmp_path / "rosbridge-eth-operator").write_bytes(b"secret")
    environment = {"CREDENTIALS_DIRECTORY": str(tmp_path)}
    assert read_passphrase("operator", "Operator", environment=environment) == b"secret"


@pytest.mark.parametrize("content", [b"", b"\n", None])
def test_an_empty_or_missing_file_is_refused_by_name(tmp_path: Path, content: bytes | None) -> None:
    if content is not None:
        (tmp_path / "p").write_bytes(content)
    with pytest.raises(IdentityError, match=r"/p"):
        read_passphrase("robot", "Robot", file=tmp_path / "p")


def test_without_a_terminal_it_does_not_wait(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("sys.stdin", io.StringIO(""))
    with pytest.raises(IdentityError, match="--passphrase-file"):
        read_passphrase("robot", "Robot", environment={})
