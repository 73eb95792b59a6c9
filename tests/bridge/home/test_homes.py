"""Whose home a folder is, and that one of another edition is refused."""

from __future__ import annotations

from pathlib import Path

import pytest

from rosbridge_eth.config.home import (
    Deployment,
    HomeKind,
    OperatorHome,
    ReaderHome,
    RobotHome,
    home_of,
    kind_of,
    make_home,
    new_home,
    require_empty,
)
from rosbridge_eth.errors import ChainError, ConfigError
from rosbridge_eth.log.chunk import ledger_id

DEPLOYMENT = Deployment(31337, "0x" + "11" * 32, "0x" + "aB" * 20, 7)


def test_a_clock_that_cannot_be_read_is_none(tmp_path: Path) -> None:
    (tmp_path / "clock").mkdir()
    assert RobotHome(tmp_path).clock_floor() == 0.0


@pytest.mark.parametrize("kind", HomeKind)
def test_a_home_says_whose_it_is_and_no_other_command_takes_it(kind: HomeKind, tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match="not a home; `init --home`"):
        kind_of(tmp_path)
    make_home(tmp_path, kind, name="x")
    assert kind_of(tmp_path) is kind and home_of(tmp_path)["name"] == "x"
    for other, ask in (
        (HomeKind.OPERATOR, OperatorHome(tmp_path).require), (HomeKind.READER, ReaderHome(tmp_path).require),
        (HomeKind.ROBOT, RobotHome(tmp_path).bridge),
    ):
        if other is not kind:
            with pytest.raises(ConfigError, match=rf"home, not .* {other}'s"):
                ask()
    with pytest.raises(ConfigError, match="home already"):
        require_empty(tmp_path)


def test_what_is_no_home_says_how_to_make_one(tmp_path: Path) -> None:
    for ask, way in (
        (OperatorHome(tmp_path).require, "run `init --home"), (ReaderHome(tmp_path).require, "`reader NAME`"),
        (RobotHome(tmp_path).bridge, "run `join --name NAME --home"),
    ):
        with pytest.raises(ConfigError, match=way):
            ask()


def test_a_home_that_was_cut_short_is_begun_anew(tmp_path: Path) -> None:
    """A kill leaves what there was at that moment; a failure or Ctrl-C leaves nothing."""
    (tmp_path / "home/ca").mkdir(parents=True)
    for name in (".unfinished", "server.toml"):
        (tmp_path / "home" / name).touch()
    with pytest.raises(ConfigError, match="is not an operator's home; run `init"):
        OperatorHome(tmp_path / "home").require()
    with new_home(tmp_path / "home"):
        assert [path.name for path in (tmp_path / "home").iterdir()] == [".unfinished"]
        make_home(tmp_path / "home", HomeKind.ROBOT, name="x")
    assert [path.name for path in (tmp_path / "home").iterdir()] == ["home.json"]
    (tmp_path / "home/.unfinished").touch()  # killed at the very end
    with pytest.raises(ConfigError, match="a robot's home already"), new_home(tmp_path / "home"):
        pass
    with pytest.raises(KeyboardInterrupt), new_home(tmp_path / "other"):
        (tmp_path / "other/file").touch()
        raise KeyboardInterrupt
    assert not (tmp_path / "other").exists()
    (tmp_path / "other").mkdir()
    (tmp_path / "other/precious").touch()
    with pytest.raises(ConfigError, match="not empty"), new_home(tmp_path / "other"):
        pass
    assert (tmp_path / "other/precious").exists()


@pytest.mark.parametrize("edition", [1, 2, 4])
def test_a_home_of_another_edition_is_refused_with_a_sentence(edition: int, tmp_path: Path) -> None:
    """Its logs have another format."""
    (tmp_path / "home.json").write_text(f'{{"format": "rosbridge-eth home {edition}", "kind": "robot"}}')
    for ask in (OperatorHome(tmp_path).require, RobotHome(tmp_path).bridge, ReaderHome(tmp_path).require,
                lambda: kind_of(tmp_path), lambda: require_empty(tmp_path)):
        with pytest.raises(ConfigError, match=r"made by another version of this program; .* make a new home"):
            ask()


@pytest.mark.parametrize("text", [
    "", "[]", "5", '{"format": "rosbridge-eth home 4", "kind": "robot"}', '{"kind": []}', "{}",
])
def test_a_damaged_mark_is_told(text: str, tmp_path: Path) -> None:
    (tmp_path / "home.json").write_text(text)
    with pytest.raises(ConfigError, match=r"restore|another version"):
        kind_of(tmp_path)


def test_the_deployment_is_kept_and_its_damage_told(tmp_path: Path) -> None:
    home = OperatorHome(tmp_path)
    with pytest.raises(ChainError, match="run `deploy"):
        home.deployment()
    home.save_deployment(DEPLOYMENT)
    assert home.deployment() == DEPLOYMENT
    assert home.deployment().ledger == ledger_id(31337, b"\x11" * 32, b"\xab" * 20)
    for text in ('{"chain_id": 1}', "nonsense", '{"chain_id": 1, "genesis": "", "contract": "", "code_hash": ""}'):
        home.deployment_file.write_text(text)
        with pytest.raises(ConfigError, match="restore it from your backup"):
            home.deployment()


def test_a_clock_only_goes_forward_and_a_damaged_one_counts_for_nothing(tmp_path: Path) -> None:
    home = RobotHome(tmp_path)
    assert home.clock_floor() == 0
    home.raise_clock_floor(1_800_000_000.4)
    home.raise_clock_floor(5)
    assert home.clock_floor() == 1_800_000_000
    for text in ("", "soon", "nan", "inf", "-5", "1e300"):
        home.clock.write_text(text)
        assert home.clock_floor() == 0


def test_a_file_in_the_way_is_told(tmp_path: Path) -> None:
    (tmp_path / "taken").write_text("")
    with pytest.raises(ConfigError, match="not empty"):
        require_empty(tmp_path / "taken")
    require_empty(tmp_path / "new")
