"""What a robot says of itself: why it has no session and what to do, and at the end what became of everything."""

from __future__ import annotations

import logging
import re
from datetime import UTC, datetime
from functools import partial
from pathlib import Path

import pytest

from bridge.operations.conftest import PASSWORD, Place
from bridge.operations.test_doctor import server
from bridge.test_delivery import World
from rosbridge_eth.channel import ClientConfig, HandshakeFailed, Reason
from rosbridge_eth.channel.simulation import Faults
from rosbridge_eth.config import Address, load_robot_config
from rosbridge_eth.registry import Registry
from rosbridge_eth.robot import assembly
from rosbridge_eth.robot.process import Robot
from rosbridge_eth.sources.sample import sample_bag

__all__ = ["server"]  # a fixture

NO_SERVER = 'server = "127.0.0.1:9"\n'
Logged = pytest.LogCaptureFixture


@pytest.fixture
def impatient(monkeypatch: pytest.MonkeyPatch) -> None:
    """A robot that gives a handshake half a second."""
    monkeypatch.setattr(assembly, "ClientConfig", partial(ClientConfig, attempt_timeout=0.5))


def opened(place: Place, text: str) -> Robot:
    place.robot.config.write_text(text.replace("BAG", str(sample_bag())))
    return assembly.open_robot(place.robot, load_robot_config(place.robot.config), PASSWORD)


def run_to_the_sources_end(robot: Robot) -> str:
    def on_turn() -> None:
        if robot._source_ended.is_set() and robot._ring.empty():
            robot.stop()

    robot.run(on_turn=on_turn)
    return robot.summary()


def warnings(caplog: Logged) -> list[str]:
    return [record.getMessage() for record in caplog.records if record.levelno == logging.WARNING]


def test_a_reason_is_said_with_its_mend_and_at_most_once_a_minute(tmp_path: Path, caplog: Logged) -> None:
    sender = World(tmp_path, 1, Faults()).sender
    for now in range(0, 121, 5):
        sender.handle(HandshakeFailed("it is silent"), now)
        sender.handle(HandshakeFailed("it refuses", Reason.NOT_ALLOWED), now)
    said = warnings(caplog)
    assert [sum(why in line for line in said) for why in ("it is silent", "it refuses")] == [3, 3]
    assert all("register --replace" in line and "join" in line for line in said if "it refuses" in line)
    assert all('channel = "exchange"' in line for line in said if "it is silent" in line)


def test_a_revoked_robot_ends_with_the_reason_for_what_it_keeps(
    place: Place, server: Address, impatient: None, caplog: Logged
) -> None:
    registry = Registry(place.operator.registry)
    registry.revoke("robot", "robot_1", datetime.now(UTC))
    registry.close()
    robot = opened(place, place.robot.config.read_text())
    robot.run(on_turn=lambda: robot.stop() if robot.sender.statistics.refusal else None)
    assert robot.spool_left > 0
    for text in (robot.summary(), " ".join(warnings(caplog))):
        assert "allow list" in text and "register --replace" in text and "cannot be delivered" in text


def test_a_mode_that_the_server_may_not_take_is_named(
    place: Place, server: Address, impatient: None, caplog: Logged
) -> None:
    robot = opened(place, 'channel = "transport"\n' + place.robot.config.read_text())
    robot.run(on_turn=lambda: robot.stop() if robot.sender.statistics.refusal else None)
    [said] = warnings(caplog)
    assert "does not answer" in said and 'channel = "transport"' in said


def test_a_robot_that_is_stopped_before_any_answer_says_so(place: Place) -> None:
    robot = opened(place, NO_SERVER + 'topics = ["/robot_1/odom"]\n[source]\nkind = "bag"\npath = "BAG"\nspeed = "max"')
    line = run_to_the_sources_end(robot)
    assert re.search(r"^\d+ captured, 0 stored by the server, \d+ kept for later: there was no session yet", line)


def test_the_sum_counts_what_was_superseded_and_left_out(place: Place) -> None:
    robot = opened(place, NO_SERVER + '''
[[topics]]
topic = "/robot_1/odom"
delivery = "latest"
fields = ["pose.pose.position.x"]
[[topics]]
topic = "/robot_1/imu"
fields = ["header.frame_id"]
[capture]
oversize = "refuse"
field_limit = 1
[source]
kind = "bag"
path = "BAG"
speed = "max"
''')
    line = run_to_the_sources_end(robot)
    found = {what: int(number) for number, what in re.findall(r"(\d+) ([a-z]+(?: out)?)", line)}
    per_topic = {name: topic.seen for name, topic in robot.recorder._capture.statistics().items()}
    assert found["captured"] == per_topic["/robot_1/odom"]
    assert found["left out"] == per_topic["/robot_1/imu"]
    assert found["superseded"] == found["captured"] - 1, "of a latest topic one record waits"


@pytest.mark.parametrize("topic, source, says", [
    ('at = "2099-01-01T00:00:00Z"', "", "/robot_1/odom: `at` leaves nothing"),
    ('from = "2099-01-01T00:00:00Z"', "", "/robot_1/odom: `from` leaves nothing"),
    ('until = "1999-01-01T00:00:00Z"', "", "/robot_1/odom: `until` leaves nothing"),
    ("", 'start = "2h"', "start = 7200s is after its last message; the recording lasts"),
    ('at = "1999-01-01T00:00:00Z"', 'start = "100ms"', None),
])
def test_a_moment_outside_the_recording_is_remarked(
    place: Place, topic: str, source: str, says: str | None, caplog: Logged
) -> None:
    rule = ", ".join(['topic = "/robot_1/odom"', *([topic] if topic else [])])
    robot = opened(place, f'{NO_SERVER}topics = [{{{rule}}}]\n[source]\nkind = "bag"\npath = "BAG"\nspeed = "max"\n'
                          f"{source}\n")
    line = run_to_the_sources_end(robot)
    assert line.startswith("0 captured") == (says is not None)
    said = warnings(caplog)
    assert (len(said) == 1 and says in said[0]) if says is not None else said == []
    if topic and says:
        assert re.search(r"from 20\d\d-\d\d-\d\dT\S+Z to 20\d\d-", said[0])
