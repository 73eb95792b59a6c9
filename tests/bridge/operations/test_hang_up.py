"""SIGHUP at a robot: topics and readers are taken up without losing a message; without its terminal it ends."""

from __future__ import annotations

import json
import os
import pty
import signal
import subprocess
import sys
from collections.abc import Callable, Iterator
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

import pytest

import rosbridge_eth
from bridge.sources.ros1.graph import Graph, eventually
from rosbridge_eth import identity as ids
from rosbridge_eth.bundle import Bundle, ask_to_join, join
from rosbridge_eth.chunk import Chunk, Log, NoGrant, content_key, drop, open_lines, robot_id
from rosbridge_eth.home import BridgeEnd, RobotHome
from rosbridge_eth.spool import Spool
from smcrypto import sm2

PASSWORD = b"robot's"
END = BridgeEnd("robot_1", "server", "127.0.0.1:9", 31337, "0x" + "11" * 32, "0x" + "22" * 20)
LOG = Log(END.ledger, robot_id(END.robot))
NOW = datetime.now(UTC)
CA = ids.create_ca("CA", at=NOW)
OWNER, LATE = (ids.enrol(CA, ids.Role.READER, name, at=NOW) for name in ("owner", "late"))


@pytest.fixture
def robot(tmp_path: Path) -> RobotHome:
    """The home of a registered robot, whose server is not there."""
    home = RobotHome(tmp_path / "robot")
    request = ask_to_join(home, END.robot, PASSWORD)
    peer = ids.enrol_requests(CA, ids.Role.ROBOT, END.robot, request.signing, request.encryption, at=NOW)
    certificates = {name: text.decode() for name, text in ids.certificate_files(peer, [CA.certificate]).items()}
    join(home, Bundle(END, certificates, {"owner": OWNER.public.pem.decode()}))
    (tmp_path / "word").write_bytes(PASSWORD)
    return home


def command(home: RobotHome, *more: str) -> list[str]:
    arguments = ["--home", str(home.path), "--password-file", str(home.path.parent / "word"), *more]
    return [sys.executable, "-m", "rosbridge_eth", "robot", *arguments]


def environment(**more: str) -> dict[str, str]:
    kept = {name: value for name, value in os.environ.items() if not name.startswith("ROS")}
    return kept | {"PYTHONPATH": str(Path(rosbridge_eth.__file__).parents[1])} | more


def chunks_of(home: RobotHome) -> Iterator[Chunk]:
    """What stands in its spool."""
    spool = Spool(home.spool, LOG, max_bytes=1 << 30, drop=partial(drop, LOG, OWNER.signing_key))
    place = spool.first_unconfirmed()
    while place is not None:
        yield from spool.following(place[0], None, 1 << 30)
        place = spool.next_stream(place[0])
    spool.close()


def lines_of(chunks: list[Chunk], key: sm2.PrivateKey) -> list[dict[str, object]]:
    """The lines that the key opens."""
    found: list[dict[str, object]] = []
    for chunk in chunks:
        try:
            found += map(json.loads, open_lines(LOG, chunk, content_key(chunk.header, key)) if chunk.body else ())
        except NoGrant:
            continue
    return found


@pytest.mark.service
def test_topics_and_readers_are_taken_up_and_no_message_is_lost(
    robot: RobotHome, require: Callable[[str], str], tmp_path: Path
):
    require("rosmaster")
    graph = Graph(tmp_path)
    source = f'[source]\nkind = "ros1"\nmaster = "{graph.uri}"\nhostname = "127.0.0.1"\n'
    robot.config.write_text(f'topics = ["/kept", "/left"]\n{source}')
    log = tmp_path / "log"
    with log.open("wb") as stream:
        process = subprocess.Popen(command(robot), env=environment(), stderr=stream)

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
        eventually(lambda: said("nothing is taken up"), "a file that does not parse is told")
        assert graph.subscribers("/new") == [] and process.poll() is None
        (robot.readers / "late.pem").write_bytes(LATE.public.pem)
        robot.config.write_text(f'topics = ["/kept", "/new"]\nserver = "192.0.2.1:9"\n{source}')
        process.send_signal(signal.SIGHUP)
        eventually(lambda: graph.subscribers("/new") and not graph.subscribers("/left"), "the topics are taken up")
        assert said("taken up: topics, nodes, capture, readers; ") and said("from the next start on: server\n")
        assert arm.stdout is not None and arm.stdout.readline() == "done\n"
        (robot.readers / "owner.pem").unlink()
        process.send_signal(signal.SIGHUP)
        eventually(lambda: log.read_text().count("taken up: topics") == 2, "a reader is removed")
        process.send_signal(signal.SIGTERM)
        assert process.wait(30) == 0, log.read_text()
    finally:
        process.kill()
        graph.close()
    chunks = [*chunks_of(robot)]
    owners, lates = (lines_of(chunks, reader.encryption_key) for reader in (OWNER, LATE))
    numbers = {line["data"]["data"] for line in owners + lates if line.get("topic") == "/kept"}  # type: ignore[index]
    assert numbers == {*range(max(numbers) + 1)}, "every message from the first to the last"
    assert {line.get("topic") for line in lines_of(chunks[-1:], LATE.encryption_key)} <= {"/kept", "/new", None}
    assert sum(line.get("topic") == "/new" for line in lates) == 50
    first = next(line for line in lates if "stream" not in line)
    assert "definition" in first, "it stands before the first message"
    assert len(lines_of(chunks[-1:], OWNER.encryption_key)) == 0 < len(lines_of(chunks, OWNER.encryption_key))
    assert len({chunk.header.stream for chunk in chunks}) == 1


def test_a_robot_whose_terminal_is_gone_ends_in_good_order(robot: RobotHome):
    robot.config.write_text('topics = ["/robot_1/odom"]\n[source]\nkind = "sim"\n')
    pid, terminal = pty.fork()
    if pid == 0:
        arguments = command(robot)
        os.execve(arguments[0], arguments, environment(TERM="dumb"))
    said = b""
    while b"Ctrl-C ends it" not in said:
        said += os.read(terminal, 1 << 16)
    os.kill(pid, signal.SIGHUP)
    while b"taken up: capture, readers" not in said:
        said += os.read(terminal, 1 << 16)
    os.close(terminal)
    _, status = os.waitpid(pid, 0)
    assert os.WIFEXITED(status), "no signal ended it"
    assert [*chunks_of(robot)][-1].header.goodbye
