"""What a robot says of itself: why it has no session and what to do, and at the end what became of everything."""

from __future__ import annotations

import io
import logging
import re
import socket
from contextlib import closing
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

import pytest
from rich.console import Console

from bridge import disks
from bridge.lone_robot import CA, NOW, READER, lone_robot
from bridge.operations.conftest import PASSWORD, Place
from rosbridge_eth.capture import process
from rosbridge_eth.channel import ClientConfig, Connected, HandshakeFailed, Reason
from rosbridge_eth.config import Address, load_robot_config
from rosbridge_eth.errors import ConfigError
from rosbridge_eth.log.chunk import MAX_READERS
from rosbridge_eth.operator.registry import Registry
from rosbridge_eth.operator.status import robot_picture
from rosbridge_eth.robot import loop as module
from rosbridge_eth.robot.loop import Robot, open_robot, reader_keys
from rosbridge_eth.robot.sources import sample_bag
from rosbridge_eth.server import metrics

NO_SERVER = 'server = "127.0.0.1:9"\n'
BAG = '[source]\nkind = "bag"\npath = "BAG"\nspeed = "max"\n'
ODOM = 'topics = ["/robot_1/odom"]\n'
Logged = pytest.LogCaptureFixture


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    """A robot that gives a handshake half a second."""
    monkeypatch.setattr(module, "ClientConfig", partial(ClientConfig, attempt_timeout=0.5))


def opened(place: Place, text: str) -> Robot:
    place.robot.config.write_text(text.replace("BAG", str(sample_bag())))
    return open_robot(place.robot, load_robot_config(place.robot.config), PASSWORD)


def run_to_the_sources_end(robot: Robot) -> str:
    robot.run(on_turn=lambda: robot.stop() if robot._source_ended.is_set() and not robot._queue else None)
    return robot.summary


def warnings(caplog: Logged) -> list[str]:
    return [record.getMessage() for record in caplog.records if record.levelno == logging.WARNING]


def test_a_reason_is_said_with_its_fix_and_at_most_once_a_minute(place: Place, caplog: Logged) -> None:
    robot = opened(place, NO_SERVER + ODOM + BAG)
    for now in range(0, 121, 5):
        robot.sender.handle(HandshakeFailed("it is silent"), now)
        robot.sender.handle(HandshakeFailed("it refuses", Reason.NOT_ALLOWED), now)
    robot.spool.close()
    robot.loop.close()
    said = warnings(caplog)
    assert [sum(why in line for line in said) for why in ("it is silent", "it refuses")] == [3, 3]
    assert all("register --replace" in line and "join" in line for line in said if "it refuses" in line)
    assert all('channel = "exchange"' in line for line in said if "it is silent" in line)


def test_a_running_robot_is_shown_at_its_terminal_by_its_own_figures(place: Place) -> None:
    robot = opened(place, NO_SERVER + ODOM + BAG)
    with closing(robot.spool), closing(robot.loop):
        for chunk in robot.writer.finish(0):
            robot.spool.append(chunk)
            robot.spool.set_aside(chunk.header.digest)
        metrics.show(metrics.of_robot("robot_1", robot, 0.0))
        shown = Console(width=200, file=(out := io.StringIO()))
        shown.print(robot_picture("robot_1", "no session yet", metrics.figures()))
        assert re.search("session +no session yet", out.getvalue())
        assert re.search("spool chunks not stored +0", out.getvalue())
        assert re.search("spool chunks set aside +1", out.getvalue())


def test_the_records_of_a_topic_are_shown_and_what_is_confirmed_only_while_it_is_known(place: Place) -> None:
    robot = opened(place, NO_SERVER + ODOM + BAG)
    run_to_the_sources_end(robot)
    again = open_robot(place.robot, load_robot_config(place.robot.config), PASSWORD)
    again.written, again.writer.sealed["/robot_1/odom"] = robot.written, robot.captured - 10
    count = robot.captured
    with closing(again.spool), closing(again.loop):
        for refused, states in (0, f"{count} +{count - 10} +{count - 10} +0"), (1, rf"{count} +{count - 10} +\? +\?"):
            again.sender.refused = refused
            metrics.show(metrics.of_robot("robot_1", again, 0.0))
            shown = Console(width=80, file=(out := io.StringIO()))
            shown.print(robot_picture("robot_1", "no session yet", metrics.figures()))
            assert re.search(f"/robot_1/odom +{states}", out.getvalue())


def test_a_disk_that_is_full_when_a_session_begins_does_not_end_a_robot(tmp_path: Path, caplog: Logged) -> None:
    with disks.small_disk(tmp_path / "disk", "5m") as disk:
        home = lone_robot(disk)
        home.config.write_text(ODOM + '[source]\nkind = "sim"\n')
        robot = open_robot(home, load_robot_config(home.config), b"robot's")
        with closing(robot.spool), closing(robot.loop):
            ballast = disks.fill_up(disk)
            robot.handle(Connected(READER.public, bytes(8), NOW))
            assert robot.sender.connected and "cannot be kept" in caplog.text
            ballast.unlink()
            robot.handle(Connected(READER.public, bytes(8), NOW))
            assert home.clock_floor() == pytest.approx(NOW.timestamp(), abs=1)


def test_more_readers_than_a_chunk_may_have_are_refused_before_it_is_sealed_for_them(tmp_path: Path) -> None:
    home = lone_robot(tmp_path)
    home.config.write_text(ODOM + '[source]\nkind = "sim"\n')
    for number in range(MAX_READERS - 1):
        (home.readers / f"reader_{number}.pem").write_bytes(READER.public.pem)
    roots = [CA.certificate]
    assert len(reader_keys(home, roots)) == MAX_READERS
    (home.readers / "one_more.pem").write_bytes(READER.public.pem)
    with pytest.raises(ConfigError, match="certificates of 17 readers, and a chunk is for 1 to 16"):
        reader_keys(home, roots)


def test_a_revoked_robot_ends_with_the_reason_for_what_it_keeps(
    place: Place, server: Address, impatient: None, caplog: Logged
) -> None:
    with Registry(place.operator.registry) as registry:
        registry.revoke("robot", "robot_1", datetime.now(UTC))
    robot = opened(place, place.robot.config.read_text())
    robot.run(on_turn=lambda: robot.stop() if robot.sender.refusal and robot.chunks else None)
    for text in (robot.summary, " ".join(warnings(caplog))):
        assert "register --replace" in text
    assert re.search(r"[1-9]\d* chunks not yet at the server", robot.summary)


def test_a_robot_that_is_stopped_says_that_the_server_has_its_last_chunk(place: Place, server: Address) -> None:
    """At an ordinary Ctrl-C: what the server said last counts."""
    robot = opened(place, place.robot.config.read_text() + "rate = 100\n")
    robot.run(on_turn=lambda: robot.stop() if robot.sender.connected and robot.captured > 30 else None)
    assert robot.summary.endswith("nothing waits for the server.")


def test_a_mode_that_the_server_may_not_take_is_named(
    place: Place, server: Address, impatient: None, caplog: Logged
) -> None:
    robot = opened(place, 'channel = "transport"\n' + place.robot.config.read_text())
    robot.run(on_turn=lambda: robot.stop() if robot.sender.refusal else None)
    [said] = warnings(caplog)
    assert 'channel = "transport"' in said


def test_a_server_whose_name_has_no_address_yet_does_not_keep_a_robot_from_capturing(
    place: Place, monkeypatch: pytest.MonkeyPatch, caplog: Logged
) -> None:
    def away(*given: object, **more: object) -> object:
        raise socket.gaierror(socket.EAI_AGAIN, "Temporary failure in name resolution")

    monkeypatch.setattr(socket, "getaddrinfo", away)
    robot = opened(place, f'server = "robots.example:7410"\n{ODOM}{BAG}')
    captured, figures = len(list(robot.source.messages())), list[object]()  # type: ignore[attr-defined]

    def on_turn() -> None:
        figures[:] = metrics.of_robot("robot_1", robot, 0.0)
        if robot.captured == captured and robot.sender.refusal:
            robot.stop()

    robot.run(on_turn=on_turn)
    assert ("condition", {"process": "robot", "name": "server's name has an address"}, False) in figures
    [said] = warnings(caplog)
    why = "the address 'robots.example' cannot be found: Temporary failure in name resolution; see that this machine"
    assert why in said and why in robot.summary and f"{captured} records captured" in robot.summary


def test_a_robot_that_is_stopped_before_any_answer_says_so(place: Place) -> None:
    line = run_to_the_sources_end(opened(place, NO_SERVER + ODOM + BAG))
    said = r"^\d+ records captured in \d+ chunks, [1-9]\d* chunks not yet at the server: there was no session"
    assert re.search(said, line)


def test_the_sum_counts_what_was_left_out(place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(process, "MAX_LINE", 10)
    robot = opened(place, f'''{NO_SERVER}
topics = ["/robot_1/odom"]
[[topics]]
topic = "/robot_1/imu"
{BAG}'''.replace('topics = ["/robot_1/odom"]\n', ""))
    line = run_to_the_sources_end(robot)
    seen = sum(robot.capture.lost.values())
    left_out = re.search(r"(\d+) messages left out as too large or undecodable", line)
    assert line.startswith("0 records captured") and left_out is not None and int(left_out[1]) == seen > 0


def test_without_a_source_and_without_ros_nothing_is_invented(place: Place, monkeypatch: pytest.MonkeyPatch) -> None:
    for name in ("ROS_VERSION", "ROS_DISTRO", "ROS_MASTER_URI"):
        monkeypatch.delenv(name, raising=False)
    with pytest.raises(ConfigError, match=r"\[source\]"):
        opened(place, ODOM)
