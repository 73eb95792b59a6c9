"""A reader's folder holds all it takes to read, and nothing of the operator's."""

from __future__ import annotations

from pathlib import Path

import pytest

from bridge.operations.conftest import PASSPHRASE, Place
from rosbridge_eth.cli import run
from rosbridge_eth.config import load_reader_config
from rosbridge_eth.errors import ConfigError, ExitCode
from rosbridge_eth.home import HomeKind, RobotHome, kind_of
from rosbridge_eth.identity import Role, Trust, load_identity, read_certificates
from rosbridge_eth.robot.assembly import reader_keys


@pytest.fixture
def analyst(place: Place, capsys: pytest.CaptureFixture[str]) -> Path:
    Path("analysts").write_bytes(b"the analyst's own words")
    assert run(["reader", "analyst", "--passphrase-file", "pass", "--password-file", "analysts"]) == 0
    assert "public.pem" in capsys.readouterr().err
    return (place.path / "operator/readers/analyst").rename(place.path / "carried")


def test_the_folder_works_where_it_was_carried(place: Place, analyst: Path):
    assert kind_of(analyst) is HomeKind.READER
    config = load_reader_config(analyst / "reader.toml")
    assert config.contract == place.operator.deployment().contract
    identity, roots = load_identity(config.identity, b"the analyst's own words")
    assert (identity.role, identity.name) == (Role.READER, "analyst")
    assert read_certificates(config.ca.read_bytes()) == roots
    Trust(roots).check(
        identity.signing_certificate.to_der(), identity.encryption_certificate.to_der(), role=Role.READER,
        at=identity.signing_certificate.not_before,
    )
    # As far as the node, which is not there: everything before it was found in the folder.
    arguments = ["read", "robot_1", "--config", str(analyst / "reader.toml"), "--passphrase-file", "analysts"]
    assert run(arguments) == ExitCode.CHAIN


def test_nothing_of_the_operators_goes_along(place: Place, analyst: Path):
    content = b"".join(path.read_bytes() for path in analyst.iterdir())
    for secret in (b"node-key", b"path-key", b"query-key", PASSPHRASE):
        assert secret not in content
    assert b'chain = "http://127.0.0.1:9"' in (analyst / "reader.toml").read_bytes()
    assert all(path.stat().st_mode & 0o077 == 0 for path in analyst.glob("*.key.pem"))


def test_a_robot_seals_for_a_reader_whose_public_file_it_is_given(place: Place, analyst: Path):
    from rosbridge_eth.config import load_robot_config

    home = RobotHome(place.path / "robot")
    config = load_robot_config(home.config)
    roots = read_certificates((home.identity / "ca.crt.pem").read_bytes())
    before = reader_keys(config, home, roots)
    (home.readers / "analyst.pem").write_bytes((analyst / "public.pem").read_bytes())
    after = {key.to_bytes() for key in reader_keys(config, home, roots)}
    identity, _ = load_identity(analyst, b"the analyst's own words")
    assert after == {key.to_bytes() for key in before} | {identity.encryption_key.public_key.to_bytes()}


def test_the_owner_has_one_from_the_deployment_on(place: Place):
    owner = place.operator.reader("owner")
    assert load_reader_config(owner / "reader.toml").contract == place.operator.deployment().contract
    assert len(read_certificates((owner / "public.pem").read_bytes())) == 2


def test_a_folder_without_the_file_is_nobodys(tmp_path: Path):
    with pytest.raises(ConfigError, match="nobody's home"):
        kind_of(tmp_path)
