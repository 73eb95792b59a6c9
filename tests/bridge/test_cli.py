"""Mistakes at the command line: a sentence that says what to do, a named exit code, no traceback, nothing lost."""

from __future__ import annotations

import json
import socket
import subprocess
import sys
from collections.abc import Callable
from datetime import UTC, datetime
from pathlib import Path

import pytest

from rosbridge_eth.bundle import open_bundle
from rosbridge_eth.cli import run
from rosbridge_eth.errors import ExitCode
from rosbridge_eth.home import OperatorHome, RobotHome
from rosbridge_eth.ledger.accounts import Keyring
from rosbridge_eth.ledger.embedded import EmbeddedChain
from rosbridge_eth.robot.assembly import join
from rosbridge_eth.server.administration import deploy_contract, init_home, load_ca, register_robot
from rosbridge_eth.sources import sample_bag

PASSPHRASE, PASSWORD = b"operator's", b"robot's"
NOW = datetime.now(UTC)
Capture = pytest.CaptureFixture[str]


@pytest.fixture(scope="module")
def made(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A folder with an operator's home, a deployed contract, a registered robot and its home."""
    folder = tmp_path_factory.mktemp("made")
    home, robot = OperatorHome(folder / "operator"), RobotHome(folder / "robot")
    init_home(home, PASSPHRASE, listen="127.0.0.1:0", public=None, chain_url="http://127.0.0.1:9", server="server",
              now=NOW)
    keys = Keyring.load(home.accounts, PASSPHRASE)
    chain = EmbeddedChain(fund={keys.operator.address: 10**21})
    deploy_contract(home, chain, keys)
    registered = register_robot(home, "robot_1", ca=load_ca(home, PASSPHRASE), keys=keys, chain=chain,
                                password=PASSWORD, now=NOW)
    join(robot, open_bundle(registered.bundle.read_bytes(), PASSWORD), PASSWORD)
    return folder


@pytest.fixture
def place(made: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """A fresh copy of it, with the passphrases in files; the current folder."""
    subprocess.run(["cp", "-a", f"{made}/.", str(tmp_path)], check=True)
    (tmp_path / "pass").write_bytes(PASSPHRASE)
    (tmp_path / "word").write_bytes(PASSWORD)
    (tmp_path / "wrong").write_bytes(b"not it")
    monkeypatch.chdir(tmp_path)
    return tmp_path


def fails(capsys: Capture, code: ExitCode, says: str, *arguments: str) -> str:
    assert run(arguments) == code, capsys.readouterr().err
    error = capsys.readouterr().err
    assert says in error, error
    assert "Traceback" not in error
    return error


@pytest.mark.parametrize("text, says", [
    ("topics = []\n", "names nothing to watch"),
    ('topic = ["/a"]\n', "did you mean 'topics'"),
    ('topics = "/a"\n', "it should be a list"),
    ("topics = [1]\n", "topics"),
    ('topics = ["/a"\n', "not TOML"),
    ('topics = ["/robot_1/odom"]\nreaders = []\n', "no reader"),
    ('topics = ["/robot_1/odom"]\nreaders = ["absent.pem"]\n', "does not exist"),
    ('topics = ["/robot_1/odom"]\nname = "robot_2"\n', "robot_1"),
    ('topics = ["/robot_1/odom"]\n[source]\nkind = "bag"\npath = "absent.bag"\n', "absent.bag"),
    ('topics = [{topic = "/robot_1/odom", fields = ["pose.nose"]}]\n', "nose"),
    ('topics = ["/robot_2/odom"]\n', "/robot_2/odom"),
])
def test_a_robot_with_a_mistake_in_its_configuration_says_which(
    place: Path, text: str, says: str, capsys: Capture
) -> None:
    Path("robot/robot.toml").write_text(text)
    assert run(["robot", "--password-file", "word"]) in (ExitCode.CONFIG, ExitCode.SOURCE)
    error = capsys.readouterr().err
    assert says in error and "Traceback" not in error


def test_a_missing_home_names_the_command_that_makes_it(place: Path, capsys: Capture) -> None:
    fails(capsys, ExitCode.CONFIG, "join", "robot", "--home", "nowhere", "--password-file", "word")
    fails(capsys, ExitCode.CONFIG, "init", "status", "--home", "nowhere")


def test_an_existing_home_is_not_made_again(place: Path, capsys: Capture) -> None:
    before = Path("operator/accounts.json").read_bytes()
    fails(capsys, ExitCode.CONFIG, "not empty", "init", "--passphrase-file", "pass")
    assert Path("operator/accounts.json").read_bytes() == before
    bundle = "operator/bundles/robot_1.bundle"
    fails(capsys, ExitCode.CONFIG, "already", "join", bundle, "--password-file", "word")


def test_a_wrong_passphrase_is_told(place: Path, capsys: Capture) -> None:
    fails(capsys, ExitCode.IDENTITY, "password", "robot", "--password-file", "wrong")
    fails(capsys, ExitCode.IDENTITY, "", "server", "--passphrase-file", "wrong")
    bundle = "operator/bundles/robot_1.bundle"
    fails(capsys, ExitCode.IDENTITY, "password", "join", bundle, "--home", "other", "--password-file", "wrong")
    assert not Path("other").exists()


def test_a_key_that_others_can_read_is_refused_with_the_mend(place: Path, capsys: Capture) -> None:
    Path("robot/identity/sign.key.pem").chmod(0o644)
    fails(capsys, ExitCode.IDENTITY, "chmod 600", "robot", "--password-file", "word")


def test_a_node_that_does_not_answer_is_told(place: Path, capsys: Capture) -> None:
    Path("operator/deployment.json").rename("deployment.kept")
    fails(capsys, ExitCode.CHAIN, "127.0.0.1:9", "deploy", "--passphrase-file", "pass")
    Path("deployment.kept").rename("operator/deployment.json")
    fails(capsys, ExitCode.CHAIN, "127.0.0.1:9", "server", "--passphrase-file", "pass")
    fails(capsys, ExitCode.CHAIN, "127.0.0.1:9", "read", "robot_1", "--passphrase-file", "pass")


def test_status_works_without_the_node_and_says_so(place: Path, capsys: Capture) -> None:
    assert run(["status", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert [name["name"] for name in report["names"]] == ["server", "owner", "robot_1"]
    assert "127.0.0.1:9" in report["node"]


def test_a_second_contract_is_not_deployed_by_accident(place: Path, capsys: Capture) -> None:
    fails(capsys, ExitCode.CONFIG, "deployed already", "deploy", "--passphrase-file", "pass")


def test_a_used_name_is_not_taken(place: Path, capsys: Capture) -> None:
    fails(capsys, ExitCode.CHAIN, "127.0.0.1:9", "register", "robot_2", "--passphrase-file", "pass",
          "--password-file", "word")
    assert not Path("operator/bundles/robot_2.bundle").exists()


@pytest.mark.parametrize("name", ["", "Robot", "../x", "a" * 64])
def test_a_name_that_is_none_is_refused(place: Path, name: str, capsys: Capture) -> None:
    assert run(["revoke", name, "--passphrase-file", "pass"]) in (ExitCode.IDENTITY, ExitCode.CHAIN)
    assert "Traceback" not in capsys.readouterr().err


def test_a_corrupt_spool_is_kept_aside_and_told(place: Path, capsys: Capture) -> None:
    Path("robot/spool.sqlite").write_bytes(b"no database " * 400)
    fails(capsys, ExitCode.STORE, "spool", "robot", "--password-file", "word")


def test_a_corrupt_bag_is_told(place: Path, capsys: Capture) -> None:
    whole = sample_bag().read_bytes()
    Path("cut.bag").write_bytes(whole[: len(whole) // 2])
    Path("robot/robot.toml").write_text(
        f'topics = ["/robot_1/odom"]\n[source]\nkind = "bag"\npath = "{place}/cut.bag"\n'
    )
    fails(capsys, ExitCode.SOURCE, "cut.bag", "robot", "--password-file", "word")


def test_a_bundle_that_is_none_is_told(place: Path, capsys: Capture) -> None:
    fails(capsys, ExitCode.IDENTITY, "not a bundle", "join", "word", "--home", "other", "--password-file", "word")
    fails(capsys, ExitCode.CONFIG, "absent", "join", "absent", "--home", "other", "--password-file", "word")


def test_times_without_a_zone_are_refused(place: Path, capsys: Capture) -> None:
    fails(capsys, ExitCode.CONFIG, "time", "read", "robot_1", "--from", "yesterday", "--passphrase-file", "pass")


def test_usage_errors_end_with_2(place: Path) -> None:
    assert run(["no-such-command"]) == ExitCode.USAGE
    assert run(["server", "--workers", "0"]) == ExitCode.USAGE


@pytest.mark.service
def test_a_port_in_use_and_another_chain_are_told(place: Path, require: Callable[[str], str], capsys: Capture) -> None:
    require("npx")
    from rosbridge_eth.ledger.anvil import start

    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    config = Path("operator/server.toml")
    config.write_text(config.read_text().replace("127.0.0.1:9", f"127.0.0.1:{port}"))
    with start(port):
        fails(capsys, ExitCode.CHAIN, "chain", "server", "--passphrase-file", "pass")
        Path("operator/deployment.json").unlink()
        from rosbridge_eth import ledger

        node = ledger.connect(f"http://127.0.0.1:{port}")
        node.request("anvil_setBalance", Keyring.load(Path("operator/accounts.json"), PASSPHRASE).operator.address,
                     hex(10**20))
        node.close()
        assert run(["deploy", "--passphrase-file", "pass"]) == 0
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
            taken.bind(("127.0.0.1", 0))
            text = config.read_text().replace("127.0.0.1:0", f"127.0.0.1:{taken.getsockname()[1]}")
            config.write_text(text)
            fails(capsys, ExitCode.NETWORK, "port", "server", "--passphrase-file", "pass")


def test_without_the_bridge_packages_the_command_says_how_to_get_them() -> None:
    script = "import sys; sys.modules['typer'] = None; from rosbridge_eth.__main__ import main; sys.exit(main())"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "[bridge]" in done.stderr and "Traceback" not in done.stderr
