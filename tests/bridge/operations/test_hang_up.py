"""SIGHUP at a robot: topics and readers are reloaded without losing a message; without its terminal it ends."""

from __future__ import annotations

import os
import pty
import signal
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from bridge.lone_robot import CA, NOW, READER, chunks_of, command, environment, lines_of, lone_robot
from bridge.sources.ros1.graph import Graph, eventually
from rosbridge_eth import identity as ids
from rosbridge_eth.config.home import RobotHome

LATE = ids.enrol(CA, ids.Role.READER, "late", at=NOW)


@pytest.fixture
def robot(tmp_path: Path) -> RobotHome:
    return lone_robot(tmp_path)


@pytest.mark.service
def test_topics_and_readers_are_reloaded_and_no_message_is_lost(
    robot: RobotHome, require: Callable[[str], str], tmp_path: Path
):
    require("rosmaster")
    graph = Graph(tmp_path)
    source = f'[source]\nkind = "ros1"\nmaster = "{graph.uri}"\nhostname = "127.0.0.1"\n'
    robot.config.write_text(f'topics = ["/kept", "/left"]\n{source}')
    log = tmp_path / "log"
    with log.open("wb") as stream:
        process = subprocess.Popen([sys.executable, *command(robot)], env=environment(), stderr=stream)

    def said(words: str) -> bool:
        return words in log.read_text()

    try:
        graph.start_master()
        topics = [{"topic": topic, "kind": "number", "rate": 50} for topic in ("/kept", "/left", "/new")]
        graph.publish("base", *topics[:2])
        arm = graph.publish("arm", topics[2] | {"count": 50})
        eventually(lambda: graph.subscribers("/kept") and robot.spool.exists(), "it listens")
        robot.config.write_text("topics = [")
        process.send_signal(signal.SIGHUP)
        eventually(lambda: said("nothing is reloaded"), "a file that does not parse is told")
        assert graph.subscribers("/new") == [] and process.poll() is None
        (robot.readers / "late.pem").write_bytes(LATE.public.pem)
        robot.config.write_text(f'topics = ["/kept", "/new"]\nserver = "192.0.2.1:9"\n{source}')
        process.send_signal(signal.SIGHUP)
        eventually(lambda: graph.subscribers("/new") and not graph.subscribers("/left"), "the topics are reloaded")
        assert said("reloaded: topics, nodes, trigger, readers; ")
        assert said("not before the next start: server\n")
        assert arm.stdout is not None and arm.stdout.readline() == "done\n"
        (robot.readers / "owner.pem").unlink()
        process.send_signal(signal.SIGHUP)
        eventually(lambda: log.read_text().count("reloaded: topics") == 2, "a reader is removed")
        process.send_signal(signal.SIGTERM)
        assert process.wait(30) == 0, log.read_text()
    finally:
        process.kill()
        graph.close()
    chunks = [*chunks_of(robot)]
    owners, lates = (lines_of(chunks, reader.encryption_key) for reader in (READER, LATE))
    numbers = {line["data"]["data"] for line in owners + lates if line.get("topic") == "/kept"}
    assert numbers == {*range(max(numbers) + 1)}, "every message from the first to the last"
    assert {line.get("topic") for line in lines_of(chunks[-1:], LATE.encryption_key)} <= {"/kept", "/new", None}
    assert sum(line.get("topic") == "/new" for line in lates) == 50
    first = next(line for line in lates if "stream" not in line)
    assert "definition" in first, "it stands before the first message"
    assert len(lines_of(chunks[-1:])) == 0 < len(lines_of(chunks))
    assert len({chunk.header.stream for chunk in chunks}) == 1


def test_a_robot_whose_terminal_is_gone_ends_in_good_order(robot: RobotHome):
    robot.config.write_text('topics = ["/robot_1/odom"]\n[source]\nkind = "sim"\n')
    pid, terminal = pty.fork()
    if pid == 0:
        arguments = [sys.executable, *command(robot)]
        os.execve(arguments[0], arguments, environment(TERM="dumb"))
    said = b""
    while b"Ctrl-C ends it" not in said:
        said += os.read(terminal, 1 << 16)
    os.kill(pid, signal.SIGHUP)
    while b"reloaded: readers" not in said:
        said += os.read(terminal, 1 << 16)
    os.close(terminal)
    _, status = os.waitpid(pid, 0)
    assert os.WIFEXITED(status), "no signal ended it"
    assert [*chunks_of(robot)][-1].header.goodbye
