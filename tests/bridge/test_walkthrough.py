"""docs/walkthrough.md, executed as a reader would type it: real processes, real UDP, a real node."""

from __future__ import annotations

import contextlib
import json
import os
import re
import shutil
import signal
import socket
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from bridge.terminal import Terminal
from ports import free_port
from rosbridge_eth.errors import ExitCode

ROOT = Path(__file__).resolve().parents[2]
PAGE = ROOT / "docs" / "walkthrough.md"


@pytest.mark.service
@pytest.mark.slow
def test_four_commands_are_all_it_takes_to_a_proven_record(tmp_path: Path, require: Callable[[str], str]) -> None:
    """Typed at terminals, with nothing given beforehand; what they ask for is answered."""
    require("npx")
    found = re.search(r"^```sh four\n(.*?)^```", PAGE.read_text(), re.MULTILINE | re.DOTALL)
    assert found
    commands = [line.removeprefix("rosbridge-eth ").split() for line in found[1].splitlines()]
    assert [words[0] for words in commands] == ["up", "join", "register", "robot"]
    door = f"127.0.0.1:{free_port(socket.SOCK_DGRAM)}"  # other tests may have the usual port
    with Terminal(tmp_path, *commands[0], "--listen", door) as up:
        up.answer("A passphrase for all of it: ", "open sesame")
        up.answer("(again): ", "open sesame")
        up.until("The contract is 0x")
        contract = json.loads((tmp_path / "operator/deployment.json").read_text())["contract"].lower()
        assert contract in (tmp_path / "operator/chain.json").read_text(), "a kill now would lose the contract for good"
        up.until("Listening on UDP")
        with Terminal(tmp_path, *commands[1]) as join:
            join.answer("Name of this robot", "")
            join.answer("Messages come from", "sim")
            join.answer("Which, by number, name or pattern", "1, 3")
            join.until("There is no number 3. The numbers are 1 to 2.")
            join.answer("Which, by number, name or pattern", "/a!")
            join.until("is not a name or pattern")
            join.answer("Which, by number, name or pattern", " 2, ")
            join.answer("Password for the keys of robot_1: ", "word")
            join.answer("(again): ", "word")
            join.until("rosbridge-eth register robot_1 robot/request.json")
            assert join.end() == 0 and "/robot_1/imu" in join.shown
        assert 'topics = ["/robot_1/odom"]' in (tmp_path / "robot" / "robot.toml").read_text()
        with Terminal(tmp_path, *commands[2]) as register:
            register.answer("Operator passphrase: ", "open sesame")
            shown = register.until("rosbridge-eth robot")
            assert register.end() == 0 and "registered in block" in shown
        with Terminal(tmp_path, *commands[3]) as robot:
            robot.answer("Password of robot_1: ", "word")
            robot.until("first record is in block ")
            assert robot.interrupt() == 0
            fingerprint = re.compile(r"CA is ((?:[0-9a-f]{4} ){15}[0-9a-f]{4})")
            assert fingerprint.findall(robot.shown) == fingerprint.findall(shown)
        with Terminal(tmp_path, "read", "robot_1", "--topic", "/robot_1/odom") as read:
            read.answer("Passphrase of the reader: ", "open sesame")
            read.until('"source":"sim"')
            assert read.end() == 0, read.shown[-1000:]
        assert up.interrupt() == 0, up.shown[-1000:]
    with Terminal(tmp_path, "up") as up:  # goes on with what is there
        up.answer("Operator passphrase: ", "open sesame")
        assert "The contract is" not in up.until("Listening on UDP")
        [port] = re.findall(r"^url = .*:(\d+)\"$", (tmp_path / "operator/server.toml").read_text(), re.MULTILINE)
        for process in Path("/proc").glob("[0-9]*/cmdline"):  # the chain dies, as out of memory
            with contextlib.suppress(OSError):
                words = process.read_bytes().split(b"\0")
                if b"--state" in words and port.encode() in words:
                    os.kill(int(process.parent.name), signal.SIGKILL)
        up.until("the local chain stopped by itself")
        assert up.end() == ExitCode.CHAIN
    assert "Traceback" not in up.shown + robot.shown


@pytest.mark.service
@pytest.mark.slow
def test_the_walkthrough_runs_as_it_is_written(tmp_path: Path, require: Callable[[str], str]) -> None:
    require("npx")
    commands = "\n".join(re.findall(r"^```sh\n(.*?)^```", PAGE.read_text(), re.MULTILINE | re.DOTALL))
    assert commands.count("rosbridge-eth") > 15
    script = f'set -euo pipefail\nrosbridge-eth() {{ "{sys.executable}" -m rosbridge_eth "$@"; }}\n{commands}'
    environment = {**os.environ, "PYTHONPATH": str(ROOT / "src"), "COLUMNS": "120"}
    for name in [name for name in environment if name.startswith("ROSBRIDGE_ETH_")]:
        del environment[name]
    bash = shutil.which("bash")
    assert bash
    process = subprocess.Popen(
        [bash, "-c", script], cwd=tmp_path, env=environment, stdout=subprocess.PIPE, stderr=subprocess.PIPE,
        text=True, start_new_session=True,
    )
    # The commands in the background hold the pipes open, so the shell's end is waited for, not theirs.
    try:
        code = process.wait(timeout=500)
    finally:
        os.killpg(process.pid, signal.SIGTERM)
    out, err = process.communicate(timeout=30)
    assert code == 0, out[-1000:] + err[-3000:]
    assert "robot_1: confirmed up to chunk" in out, out
    records = [json.loads(line) for line in (tmp_path / "records.jsonl").read_text().splitlines()]
    assert len(records) == 50
    assert {record["topic"] for record in records} == {"/robot_1/odom"}
    assert {record["source"] for record in records} == {"sim"}
    verdict = json.loads((tmp_path / "verdict.json").read_text())
    assert verdict["sound"] and verdict["head"]["goodbye"] and verdict["records"] == 50
    analysts = [json.loads(line) for line in (tmp_path / "analyst.jsonl").read_text().splitlines()]
    assert len(analysts) == 50, "the second run alone was sealed for the second reader"
    before = {record["captured_ns"] for record in records}
    assert min(record["captured_ns"] for record in analysts) > max(before)
    assert (tmp_path / "trajectory.png").stat().st_size > 5_000
    assert (tmp_path / "recovered.bag").stat().st_size > 5_000
    assert "revoked" in out and "Traceback" not in err
    fingerprints = re.findall(r"CA is ((?:[0-9a-f]{4} ){15}[0-9a-f]{4})", err)
    assert len(fingerprints) == 2 and len(set(fingerprints)) == 1, "what is to be compared"
    assert "nav_msgs/msg/Odometry" in out and "MB a day" in err
