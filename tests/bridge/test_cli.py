"""Mistakes at the command line: a sentence that says what to do, a named exit code, no traceback, nothing lost."""

from __future__ import annotations

import json
import os
import re
import socket
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path

import pytest

from bridge.operations.conftest import Place, _made, place
from rosbridge_eth import terminal
from rosbridge_eth.cli import run
from rosbridge_eth.cli.reader import DAY_NS, _choice_of
from rosbridge_eth.config.home import OperatorHome
from rosbridge_eth.errors import ExitCode
from rosbridge_eth.ledger.nodes import Anvil, free_port
from rosbridge_eth.robot.sources import sample_bag

__all__ = ["_made", "place"]  # fixtures

Capture = pytest.CaptureFixture[str]
BUNDLE = "operator/bundles/robot_1.bundle"
ODOM = 'topics = ["/robot_1/odom"]\n'
OPERATOR = ("--passphrase-file", "pass")


@pytest.fixture(autouse=True)
def _files(place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    """A wrong passphrase, and an environment that speaks of no ROS."""
    Path("wrong").write_bytes(b"not it")
    for name in ("ROS_VERSION", "ROS_DISTRO", "ROS_MASTER_URI"):
        monkeypatch.delenv(name, raising=False)


def fails(capsys: Capture, code: ExitCode, says: str, *arguments: str) -> str:
    assert run(arguments) == code, capsys.readouterr().err
    error = capsys.readouterr().err
    assert says in error, error
    assert "Traceback" not in error
    return error


@pytest.mark.parametrize("text, says", [
    ("topics = []\n", "names nothing to watch"),
    ('topic = ["/a"]\n', "unknown key 'topic'"),
    ('topics = "/a"\n', "input should be a valid list"),
    ("topics = [1]\n", "topics"),
    ('topics = ["/a"\n', "not TOML"),
    (f'{ODOM}name = "robot_2"\n', "name"),
    (ODOM, '[source] with kind = "ros1"'),
    (f'{ODOM}[source]\nkind = "bag"\npath = "absent.bag"\n', "absent.bag"),
    ('topics = [{topic = "/robot_1/odom", fields = ["pose.nose"]}]\n[source]\nkind = "sim"', "nose"),
    ('topics = ["/robot_2/odom"]\n[source]\nkind = "sim"', "/robot_2/odom"),
])
def test_a_robot_with_a_mistake_in_its_configuration_says_which(text: str, says: str, capsys: Capture) -> None:
    Path("robot/robot.toml").write_text(text)
    assert run(["robot", "--password-file", "word"]) in (ExitCode.CONFIG, ExitCode.SOURCE)
    error = capsys.readouterr().err
    assert says in error and "Traceback" not in error


def test_what_others_may_read_is_told(place: Place, capsys: Capture) -> None:
    """The keys are encrypted; whoever reads them and the password has the robot's identity."""
    Path("robot/robot.toml").write_text('topics = ["/robot_2/odom"]\n[source]\nkind = "sim"')
    key = next(Path("robot/identity").glob("*.key.pem"))
    for file, mode, told in ((key, 0o644, True), (Path("word"), 0o640, True), (key, 0o600, False)):
        Path("word").chmod(0o600)
        key.chmod(0o600)
        file.chmod(mode)
        run(["robot", "--password-file", "word"])
        assert (f"{file} may be read by other users" in capsys.readouterr().err) is told


def test_a_command_that_is_told_can_be_pasted(place: Place, capsys: Capture) -> None:
    """A home whose name has a space."""
    joined = ["join", "--name", "robot_5", "--home", "a b", "--source", "sim", "--yes", "--password-file", "word"]
    assert run(joined) == 0
    assert "rosbridge-eth register robot_5 'a b/request.json'" in capsys.readouterr().err
    assert run(["robot", "--home", "a b", "--password-file", "word"]) == ExitCode.CONFIG
    assert "run `robot --home 'a b'`" in capsys.readouterr().err


def test_help_is_grouped_by_who_gives_a_command(capsys: Capture) -> None:
    assert run(["--help"]) == 0
    shown = capsys.readouterr().out
    assert [line for line in shown.splitlines() if re.fullmatch(r"[A-Z][a-z]+:", line)][-4:] == [
        "All:", "Operator:", "Robot:", "Reader:"]


def test_no_private_words_are_left() -> None:
    """Words that a newcomer did not understand at the first reading."""
    words = re.compile(
        "names the mend|robots' door|nobody's home|of your own with|log branches|kept for later|knows nothing|take up|"
        r"give what a robot wrote|slow disk took|\banew\b|be had\b|in good order", re.IGNORECASE)
    found = [f"{file.name}: {line}" for file in Path(terminal.__file__).parent.rglob("*.py")
             for line in file.read_text().splitlines() if words.search(line)]  # fmt: skip
    assert not found


def test_a_date_is_a_whole_day() -> None:
    choice = _choice_of(None, "2026-11-21", "2026-11-22", None)
    assert (choice.from_ns, choice.to_ns) == (1_795_219_200_000_000_000, 1_795_219_200_000_000_000 + 2 * DAY_NS)
    assert _choice_of(None, None, None, "2026-11-21").at_ns == 1_795_219_200_000_000_000


def test_a_missing_home_names_the_command_that_makes_it(capsys: Capture) -> None:
    fails(capsys, ExitCode.CONFIG, "join", "robot", "--home", "nowhere", "--password-file", "word")
    fails(capsys, ExitCode.CONFIG, "init", "status", "--home", "nowhere")
    fails(capsys, ExitCode.CONFIG, "init", "server", "--home", "nowhere", *OPERATOR)
    fails(capsys, ExitCode.CONFIG, "reader NAME", "read", "robot_1", "--home", "nowhere", *OPERATOR)


def test_an_existing_home_is_not_made_again(capsys: Capture) -> None:
    before = Path("operator/accounts.json").read_bytes()
    fails(capsys, ExitCode.CONFIG, "home already", "init", *OPERATOR, "--reader-passphrase-file", "readers")
    fails(capsys, ExitCode.CONFIG, "home already", "init", "--home", "new", *OPERATOR, "--reader-passphrase-file",
          "readers")  # the reader's would be
    assert Path("operator/accounts.json").read_bytes() == before and not Path("new").exists()
    fails(capsys, ExitCode.CONFIG, "already", "join", "--name", "robot_1", "--password-file", "word")


def test_a_home_of_another_kind_is_told(capsys: Capture) -> None:
    fails(capsys, ExitCode.CONFIG, "operator is an operator's home", "robot", "--home", "operator",
          "--password-file", "word")
    fails(capsys, ExitCode.CONFIG, "robot is a robot's home", "server", "--home", "robot", *OPERATOR)
    fails(capsys, ExitCode.CONFIG, "robot is a robot's home", "read", "robot_1", "--home", "robot", *OPERATOR)


def test_a_wrong_passphrase_is_told(capsys: Capture) -> None:
    fails(capsys, ExitCode.IDENTITY, "password is wrong", "server", "--passphrase-file", "wrong")
    fails(capsys, ExitCode.IDENTITY, "", "mnemonic", "--passphrase-file", "wrong")
    fails(capsys, ExitCode.IDENTITY, "", "read", "robot_1", "--passphrase-file", "wrong")
    Path("robot/robot.toml").write_text(f'{ODOM}[source]\nkind = "sim"\n')
    fails(capsys, ExitCode.IDENTITY, "pass", "robot", "--password-file", "wrong")
    fails(capsys, ExitCode.IDENTITY, "does not open", "passwd", "--passphrase-file", "wrong",
          "--new-passphrase-file", "word")


def test_a_key_that_others_can_read_is_refused_with_the_fix(capsys: Capture) -> None:
    Path("robot/robot.toml").write_text(f'{ODOM}[source]\nkind = "sim"\n')
    Path("robot/identity/sign.key.pem").chmod(0o644)
    fails(capsys, ExitCode.IDENTITY, "chmod 600", "robot", "--password-file", "word")


def test_a_node_that_does_not_answer_is_told(capsys: Capture) -> None:
    Path("operator/deployment.json").rename("deployment.kept")
    fails(capsys, ExitCode.CHAIN, "127.0.0.1:9", "deploy", *OPERATOR)
    fails(capsys, ExitCode.CHAIN, "deploy", "server", *OPERATOR)
    Path("deployment.kept").rename("operator/deployment.json")
    fails(capsys, ExitCode.CHAIN, "127.0.0.1:9", "server", *OPERATOR)
    fails(capsys, ExitCode.CHAIN, "127.0.0.1:9", "read", "robot_1", "--passphrase-file", "readers")
    fails(capsys, ExitCode.CHAIN, "half done", "revoke", "robot_1", "--compromised", *OPERATOR)
    assert run(["status", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["robots"]["robot_1"]["in_force"] is False, "the server knows it"


def test_a_second_contract_is_not_deployed_by_accident(capsys: Capture) -> None:
    fails(capsys, ExitCode.CONFIG, "deployed already", "deploy", *OPERATOR)


def test_a_robot_that_cannot_be_registered_leaves_nothing(capsys: Capture) -> None:
    fails(capsys, ExitCode.CHAIN, "127.0.0.1:9", "register", "robot_2", *OPERATOR, "--password-file", "word")
    assert not Path("operator/bundles/robot_2.bundle").exists()
    fails(capsys, ExitCode.CONFIG, "absent", "register", "robot_2", "absent", *OPERATOR)
    for said in ("word: this is no request file", "give the request that `join --name` wrote"):
        fails(capsys, ExitCode.IDENTITY, said, "register", "robot_2", "word", *OPERATOR)


@pytest.mark.parametrize("name", ["", "Robot", "../x", "a" * 64, "-x", "é"])
def test_a_name_that_is_none_is_refused(name: str, capsys: Capture) -> None:
    assert run(["join", "--home", "other", "--password-file", "word", f"--name={name}"]) == ExitCode.IDENTITY
    assert not Path("other").exists()
    assert run(["reader", "--to", "other", *OPERATOR, "--reader-passphrase-file", "word", "--", name]) == (
        ExitCode.IDENTITY
    )
    assert not Path("other").exists()
    assert run(["revoke", *OPERATOR, "--", name]) in (ExitCode.IDENTITY, ExitCode.CHAIN)
    assert "Traceback" not in capsys.readouterr().err


def test_a_corrupt_spool_is_kept_aside_and_told(capsys: Capture) -> None:
    Path("robot/robot.toml").write_text(f'{ODOM}[source]\nkind = "sim"\n')
    Path("robot/spool.sqlite").write_bytes(b"no database " * 400)
    fails(capsys, ExitCode.STORE, "spool.sqlite.damaged-1", "robot", "--password-file", "word")


def test_a_corrupt_bag_is_told(place: Place, capsys: Capture) -> None:
    whole = sample_bag().read_bytes()
    Path("cut.bag").write_bytes(whole[: len(whole) // 2])
    Path("robot/robot.toml").write_text(f'{ODOM}[source]\nkind = "bag"\npath = "{place.path}/cut.bag"\n')
    fails(capsys, ExitCode.SOURCE, "cut.bag", "robot", "--password-file", "word")


def test_a_bundle_that_is_none_is_told(capsys: Capture) -> None:
    told = "word: this is no bundle file"
    fails(capsys, ExitCode.IDENTITY, told, "join", "word", "--home", "other", "--password-file", "word")
    fails(capsys, ExitCode.CONFIG, "absent", "join", "absent", "--home", "other", "--password-file", "word")
    fails(capsys, ExitCode.CONFIG, "request", "join", BUNDLE, "--home", "other")
    assert not Path("other").exists()
    assert run(["join"]) == run(["join", BUNDLE, "--name", "robot_1"]) == ExitCode.USAGE


@pytest.mark.parametrize("option", ["--from", "--to", "--at"])
@pytest.mark.parametrize("time", ["yesterday", "2026-11-21T10:00:00", "10^400", ""])
def test_times_that_are_none_or_have_no_zone_are_refused(option: str, time: str, capsys: Capture) -> None:
    fails(capsys, ExitCode.USAGE, "time", "read", "robot_1", option, time, "--passphrase-file", "readers")


def test_usage_errors_end_with_2(capsys: Capture) -> None:
    assert run(["no-such-command"]) == ExitCode.USAGE
    assert run(["server", "--shard", "-1"]) == ExitCode.USAGE
    assert run(["read"]) == ExitCode.USAGE
    assert run(["read", "robot_1", "--at", "2026-11-21T10:00:00Z", "--to", "2026-11-22T10:00:00Z"]) == ExitCode.USAGE
    assert run(["read", "robot_1", "--from", "2026-11-22T10:00:00Z", "--to", "2026-11-21T10:00:00Z"]) == ExitCode.USAGE


def test_version_and_help_are_there_in_short_and_long(capsys: Capture) -> None:
    assert run(["--version"]) == 0
    assert capsys.readouterr().out.startswith("rosbridge-eth 0.")
    for help_option in ("-h", "--help"):
        for command in ([], ["read"], ["doctor"], ["status"]):
            assert run([*command, help_option]) == 0
            assert "Usage" in capsys.readouterr().out


def test_the_list_of_commands_says_of_each_a_whole_sentence(capsys: Capture, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setenv("COLUMNS", "80")
    assert run(["--help"]) == 0
    out = capsys.readouterr().out
    assert "Usage: rosbridge-eth [OPTIONS]" in out, "completion is installed for that name"
    assert "doctor" in out and "..." not in out.replace("[ARGS]...", "")


@pytest.mark.service
def test_a_port_in_use_and_another_chain_are_told(place: Place, require: Callable[[str], str], capsys: Capture) -> None:
    require("npx")
    with socket.socket() as free:
        free.bind(("127.0.0.1", 0))
        port = free.getsockname()[1]
    text = place.operator.config.read_text()
    place.operator.config.write_text(text[: text.index("[chain]")] + f'[chain]\nurl = "http://127.0.0.1:{port}"\n')
    with Anvil.start(port) as anvil:
        fails(capsys, ExitCode.CHAIN, "another chain", "server", *OPERATOR)
        place.operator.deployment_file.unlink()
        error = fails(capsys, ExitCode.CHAIN, place.operator.account, "deploy", *OPERATOR)
        assert "ETH" in error, "who is to be paid, and how much"
        anvil.fund(place.operator.account, 100)
        assert run(["deploy", *OPERATOR]) == 0
        with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
            taken.bind(("127.0.0.1", 0))
            place.configure("127.0.0.1:0", f"127.0.0.1:{taken.getsockname()[1]}")
            fails(capsys, ExitCode.NETWORK, "port", "server", *OPERATOR)


def test_up_says_what_it_lacks_and_goes_on_when_that_is_there(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    monkeypatch.chdir(tmp_path)
    Path("pass").write_text("word")
    monkeypatch.setattr("shutil.which", lambda name: None)
    error = fails(capsys, ExitCode.CHAIN, "npx", "up", *OPERATOR)
    assert "--chain URL" in error and "getfoundry" in error
    assert Path("operator/home.json").exists() and Path("reader/home.json").exists()
    account = OperatorHome(Path("operator")).account
    fails(capsys, ExitCode.CHAIN, "npx", "up", *OPERATOR)
    assert OperatorHome(Path("operator")).account == account, "what is there is used"
    for option, value, key in (
        ("--chain", "http://127.0.0.1:9", "[chain] url"), ("--listen", "127.0.0.1:9", "listen"),
        ("--public", "192.0.2.1:9", "public"),
    ):
        fails(capsys, ExitCode.CONFIG, f"change {key} there", "up", option, value, *OPERATOR)
    fails(capsys, ExitCode.CHAIN, "npx", "up", "--listen", "0.0.0.0:7410", *OPERATOR)
    fails(capsys, ExitCode.CHAIN, "127.0.0.1:9", "up", "--home", "other", "--reader", "others", "--chain",
          "http://127.0.0.1:9", *OPERATOR)


@pytest.mark.service
def test_up_takes_a_given_node_and_shows_no_picture_where_there_is_no_terminal(
    tmp_path: Path, require: Callable[[str], str], monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    require("npx")
    monkeypatch.chdir(tmp_path)
    Path("pass").write_text("word")
    given = ("up", "--passphrase-file", "pass", "--listen", "127.0.0.1:0", "--public", "192.0.2.1:7410", "--chain")
    with Anvil.start(free_port(18545)) as anvil:
        account = re.search(r"0x[0-9a-fA-F]{40}", fails(capsys, ExitCode.CHAIN, "1 ETH", *given, anvil.url))
        assert account
        anvil.fund(account[0], 10)
        up = subprocess.Popen([sys.executable, "-m", "rosbridge_eth", *given, anvil.url], stdin=subprocess.DEVNULL,
                              stderr=subprocess.PIPE, text=True)  # fmt: skip
        try:
            assert up.stderr is not None
            said = ""
            while "Listening on UDP" not in said:
                line = up.stderr.readline()
                assert line, said
                said += line
            assert run(["status", "--json"]) == 0
            time.sleep(1.5)  # in which a picture would be drawn
        finally:
            up.terminate()
        said += up.communicate(timeout=30)[1]
    assert up.returncode == 0, said
    assert "join" in said and "register NAME REQUEST" in said and "\x1b" not in said and "session" not in said
    assert not Path("operator/chain.json").exists(), "the node is somebody else's"


def test_the_passphrase_may_be_named_by_the_environment(
    place: Place, monkeypatch: pytest.MonkeyPatch, capsys: Capture
) -> None:
    fails(capsys, ExitCode.IDENTITY, "--passphrase-file", "mnemonic")
    monkeypatch.setenv("ROSBRIDGE_ETH_OPERATOR_PASSPHRASE_FILE", str(place.path / "pass"))
    assert run(["mnemonic"]) == 0
    assert len(capsys.readouterr().out.split()) == 24


def test_accounts_are_restored_from_the_words_that_mnemonic_shows(place: Place, capsys: Capture) -> None:
    assert run(["mnemonic", *OPERATOR]) == 0
    Path("words").write_text(capsys.readouterr().out)
    arguments = ["init", "--home", "again", "--reader", "again-reader", "--mnemonic-file", "words", *OPERATOR,
                 "--reader-passphrase-file", "readers", "--public", "192.0.2.1:7410"]  # fmt: skip
    assert run(arguments) == 0
    said = capsys.readouterr().err
    assert f"The operator's account is {place.operator.account}" in said and "192.0.2.1:7410" in said
    Path("words").write_text("one two three\n")
    fails(capsys, ExitCode.IDENTITY, "mnemonic", *(word.replace("again", "third") for word in arguments))


def test_a_home_is_copied_and_its_passphrase_changed(place: Place, capsys: Capture) -> None:
    assert run(["backup", "copy"]) == 0
    fails(capsys, ExitCode.CONFIG, "copy is an operator's home already", "backup", "copy")
    Path("new").write_bytes(b"a new one")
    assert run(["passwd", *OPERATOR, "--new-passphrase-file", "new"]) == 0
    fails(capsys, ExitCode.IDENTITY, "", "mnemonic", *OPERATOR)
    assert run(["mnemonic", "--passphrase-file", "new"]) == 0
    assert run(["mnemonic", "--home", "copy", *OPERATOR]) == 0
    for home, secret in (("robot", "word"), ("reader", "readers")):
        assert run(["passwd", "--home", home, "--passphrase-file", secret, "--new-passphrase-file", "new"]) == 0


def test_the_words_open_the_accounts_in_other_software(place: Place, capsys: Capture) -> None:
    """By BIP-39 and BIP-44, as any wallet derives them; so no keystore is written here."""
    from eth_account import Account

    Account.enable_unaudited_hdwallet_features()
    assert run(["mnemonic", *OPERATOR]) == 0
    words = capsys.readouterr().out.strip()
    assert Account.from_mnemonic(words, account_path="m/44'/60'/0'/0/0").address == place.operator.account


def test_the_shell_completes_commands_and_options() -> None:
    script = "import sys; from rosbridge_eth.__main__ import main; sys.argv[0] = 'rosbridge-eth'; sys.exit(main())"

    def complete(words: str) -> list[str]:
        asked = {"_ROSBRIDGE_ETH_COMPLETE": "complete_bash", "COMP_WORDS": words, "COMP_CWORD": str(words.count(" "))}
        done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=True,
                              env={**os.environ, **asked})  # fmt: skip
        return done.stdout.split()

    assert complete("rosbridge-eth st") == ["status"]
    assert {"--home", "--json"} <= {*complete("rosbridge-eth status --")}


def test_without_the_bridge_packages_the_command_says_how_to_get_them() -> None:
    script = "import sys; sys.modules['typer'] = None; from rosbridge_eth.__main__ import main; sys.exit(main())"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.returncode == 1
    assert "[bridge]" in done.stderr and "Traceback" not in done.stderr


def test_python_3_10_is_told_that_the_bridge_needs_a_newer_one() -> None:
    script = "import sys; sys.version_info = (3, 10, 13); import smcrypto.sm2, rosbridge_eth"
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, check=False)
    assert done.stderr.splitlines()[-1] == (
        "ImportError: rosbridge_eth, the bridge, needs Python 3.11 or later; smcrypto, the library, does with 3.10"
    )


def test_nothing_that_comes_from_elsewhere_acts_on_the_terminal(capsys: pytest.CaptureFixture[str]) -> None:
    foreign = "a\x1b[2J\u202e\x9b31m\rb\nc [bold]d"
    terminal.talk(foreign)
    terminal.errors.print(terminal.table("t", ["one"], [[foreign]]))
    said = capsys.readouterr().err
    assert "a\\x1b[2J\\u202e\\x9b31m\\rb\\nc [bold]d\n" in said
    assert all(line.isprintable() for line in said.splitlines())
