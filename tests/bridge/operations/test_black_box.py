"""The black box in a robot: a bag gives the same at any pace; a process is told by signal, command and message."""

from __future__ import annotations

import json
import signal
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any

import pytest
from rosbags.rosbag1 import Writer
from rosbags.typesys import Stores, get_typestore

from bridge.lone_robot import PASSWORD, READER, chunks_of, command, environment, lines_of, lone_robot
from bridge.sources.ros1.graph import Graph, eventually
from rosbridge_eth.cli import run
from rosbridge_eth.config import load_robot_config
from rosbridge_eth.config.home import RobotHome
from rosbridge_eth.errors import ConfigError, ExitCode
from rosbridge_eth.log.chunk import Chunk
from rosbridge_eth.log.store import NOWHERE
from rosbridge_eth.robot.loop import Robot, open_robot
from rosbridge_eth.server import metrics

S = 10**9
START = 1_700_000_000 * S
CRASH = """
[[trigger]]
name = "crash"
before = "5s"
after = "3s"
when = "/bumper data == true"
"""
TOPICS = 'topics = ["/odom", "/bumper", { topic = "/scan", trigger = "crash" }]\n'


@pytest.fixture
def robot(tmp_path: Path) -> RobotHome:
    return lone_robot(tmp_path)


@pytest.fixture(scope="module")
def bag(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A minute: /scan at 10 Hz, /odom at 1 Hz, /bumper at 2 Hz, which is pressed in second 30 and at 52.0 s."""
    store, path = get_typestore(Stores.ROS1_NOETIC), tmp_path_factory.mktemp("bag") / "drive.bag"
    number, pressed = (store.types[f"std_msgs/msg/{name}"] for name in ("Int64", "Bool"))
    with Writer(path) as writer:
        connections = {
            topic: writer.add_connection(topic, f"std_msgs/msg/{name}", typestore=store)
            for topic, name in (("/scan", "Int64"), ("/odom", "Int64"), ("/bumper", "Bool"))
        }

        def say(topic: str, at: int, message: object) -> None:
            connection = connections[topic]
            writer.write(connection, at, store.serialize_ros1(message, connection.msgtype))

        for tick in range(600):
            at = START + tick * S // 10
            if tick % 5 == 0:
                say("/bumper", at, pressed(data=300 <= tick < 310 or tick == 520))
            if tick % 10 == 0:
                say("/odom", at, number(data=tick))
            say("/scan", at, number(data=tick))
    return path


def opened(home: RobotHome, text: str) -> Robot:
    home.config.write_text(text)
    return open_robot(home, load_robot_config(home.config), PASSWORD)


def until_the_end(robot: Robot) -> None:
    robot.run(on_turn=lambda: robot.stop() if robot._source_ended.is_set() and not robot._queue else None)


def seen(home: RobotHome) -> dict[str, list[Any]]:
    """What stands in its log, by topic, "trigger" and "lost"."""
    found: dict[str, list[Any]] = {}
    for line in lines_of(chunks_of(home)):
        if "data" in line:
            found.setdefault(line["topic"], []).append(line["data"]["data"])
        for kind in ("trigger", "lost"):
            if kind in line:
                found.setdefault(kind, []).append(line)
    return found


@pytest.mark.parametrize("pace", ["max", "100"])
def test_a_bag_gives_the_records_around_each_event_at_any_pace(robot: RobotHome, bag: Path, pace: str):
    speed = '"max"' if pace == "max" else "100.0"
    running = opened(robot, f'{TOPICS}{CRASH}\n[source]\nkind = "bag"\npath = "{bag}"\nspeed = {speed}\n')
    until_the_end(running)
    found = seen(robot)
    assert found["/odom"] == [*range(0, 600, 10)] and len(found["/bumper"]) == 120, "the others are written always"
    # pressed at 30.0 and 30.5 s, which is one event that lasts until 33.5 s; and at 52 s
    assert found["/scan"] == [*range(250, 336), *range(470, 551)]
    assert found["trigger"] == [
        {"trigger": "crash", "why": "/bumper data == true", "at_ns": START + at * S} for at in (30, 52)
    ]
    assert "lost" not in found
    assert running.summary.startswith(f"{60 + 120 + 86 + 81} records captured")
    assert running.box.triggers["crash"].fired == 2


def test_an_event_after_the_end_of_a_bag_is_written_while_the_robot_waits_for_its_server(robot: RobotHome, bag: Path):
    running = opened(robot, f'{TOPICS}{CRASH}\n[source]\nkind = "bag"\npath = "{bag}"\nspeed = "max"\n')
    streams: set[bytes] = set()

    def on_turn() -> None:
        if running._unspooled or running.chunks == 0 or not running._source_ended.is_set() or running._queue:
            return
        chunks = [Chunk.parse(running.spool.chunks([row.place])[0]) for row in running.spool.rows(NOWHERE, 10_000)]
        if chunks and chunks[-1].header.goodbye:
            streams.add(chunks[-1].header.stream)
            if len(streams) == 2:
                running.stop()
            else:
                running.fire("by hand")

    running.run(on_turn=on_turn)
    found = seen(robot)
    assert [each["why"] for each in found["trigger"]] == ["/bumper data == true"] * 2 + ["by hand"]
    assert found["/scan"] == [*range(250, 336), *range(470, 600)], "all that was kept for the last one, too"
    assert running.summary.startswith(f"{60 + 120 + 86 + 130} records captured") and len(streams) == 2


def test_what_there_is_no_memory_for_is_lost_in_the_log_and_in_the_figures(robot: RobotHome, bag: Path):
    text = f'{TOPICS}{CRASH}before = "1h"\n'.replace('before = "5s"\n', "") + 'memory = "64 KiB"\n'
    running = opened(robot, f'{text}[source]\nkind = "bag"\npath = "{bag}"\nspeed = "max"\n')
    until_the_end(running)
    found = seen(robot)
    lost = sum(line["lost"] for line in found["lost"])
    assert {(line["topic"], line["why"]) for line in found["lost"]} == {("/scan", "memory")}
    assert lost > 100 and running.lost == {("/scan", "memory"): lost}
    assert f"{lost} records that there was no memory for" in running.summary
    first = found["/scan"][: found["/scan"].index(300)]
    assert first == [*range(300 - len(first), 300)], "the newest before the event, in order"
    assert lost + len(found["/scan"]) == 551, "every message up to the end of the last event is one or the other"


def test_a_condition_that_does_not_fit_the_type_stops_the_start(robot: RobotHome, bag: Path):
    for condition, says in (("/bumper dat == true", "it has: data"), ("/bumper data == 1", "never holds")):
        text = f'{TOPICS}{CRASH}\n[source]\nkind = "bag"\npath = "{bag}"\n'.replace("/bumper data == true", condition)
        with pytest.raises(ConfigError, match=says):
            opened(robot, text)


@pytest.mark.parametrize(("text", "says"), [
    ('topics = ["/a"]' + CRASH, "trigger 'crash' for which no topic is kept"),
    ('topics = [{ topic = "/a", trigger = "crsh" }]' + CRASH, r"trigger = 'crsh', and no \[\[trigger\]\] of that name"),
    ('topics = [{ topic = "/a", trigger = "crash" }]' + CRASH, "condition on /bumper, which is not watched"),
    (TOPICS + CRASH + CRASH, "names trigger crash twice"),
    (TOPICS + CRASH.replace("true", "pressed"), r"trigger\[0\].when\[0\] is '/bumper data == pressed'"),
    (TOPICS.replace("trigger", "once = true, trigger") + CRASH, "one message only"),
    (TOPICS + CRASH + 'memory = "1 KiB"', "at least '64 KiB'"),
    (TOPICS + CRASH.replace('"5s"', '"0s"'), "longer than nothing"),
    (TOPICS + CRASH.replace("before", "befor"), r"unknown key 'trigger\[0\].befor'"),
    (TOPICS + "".join(CRASH.replace("crash", f"c{number}") for number in range(17)), "16"),
])  # fmt: skip
def test_a_mistake_is_told_with_its_place(tmp_path: Path, text: str, says: str):
    (tmp_path / "robot.toml").write_text(text)
    with pytest.raises(ConfigError, match=says):
        load_robot_config(tmp_path / "robot.toml")


def test_topics_tells_that_it_costs_nothing_until_the_event(
    robot: RobotHome, bag: Path, capsys: pytest.CaptureFixture[str]
):
    robot.config.write_text(f'{TOPICS}{CRASH}\n[source]\nkind = "bag"\npath = "{bag}"\n')
    assert run(["topics", "--home", str(robot.path), "--json"]) == 0
    report = {each["topic"]: each for each in json.loads(capsys.readouterr().out)["topics"]}
    assert (report["/scan"]["trigger"], report["/scan"]["bytes_per_day"], report["/scan"]["rate"]) == (
        "crash", 0, pytest.approx(10)
    )  # fmt: skip
    assert report["/odom"]["trigger"] is None and report["/odom"]["bytes_per_day"] > 0
    assert run(["topics", "--home", str(robot.path)]) == 0
    assert "at crash" in capsys.readouterr().out


# A process


@contextmanager
def running(home: RobotHome, log: Path) -> Iterator[subprocess.Popen[bytes]]:
    with log.open("wb") as stream:
        process = subprocess.Popen([sys.executable, *command(home)], env=environment(), stderr=stream)
    try:
        yield process
    finally:
        process.kill()
        process.wait()


def fired(home: RobotHome) -> dict[str, float]:
    figures = metrics.running(home.path).get("robot") or []
    return {of["trigger"]: value for name, of, value in figures if name == "trigger_fired"}


def test_a_signal_and_the_command_are_events(
    robot: RobotHome, tmp_path: Path, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
):
    monkeypatch.setattr("rosbridge_eth.cli.robot.TAKEN_WITHIN", 30.0)  # on a machine that is busy
    robot.config.write_text("""
topics = [{ topic = "/robot_1/odom", trigger = "near" }, { topic = "/robot_1/imu", trigger = "far" }]
[[trigger]]
name = "near"
after = "10ms"
[[trigger]]
name = "far"
after = "10ms"
[source]
kind = "sim"
rate = 50
""")
    log = tmp_path / "log"

    def ask(*more: str) -> tuple[int, str]:
        return run(["trigger", "--home", str(robot.path), *more]), capsys.readouterr().err

    code, said = ask("near")
    assert code == ExitCode.CONFIG and "no robot runs with the home" in said
    robot.event("near").touch()  # left by a command that was killed
    with running(robot, log) as process:
        eventually(lambda: len(fired(robot)) == 2, "it shows its figures")
        eventually(lambda: not robot.event("near").exists(), "what was asked for before is gone")
        assert fired(robot) == {"near": 0, "far": 0}
        code, said = ask("crash")
        assert code == ExitCode.CONFIG and "no trigger crash; it has: near, far" in said
        assert ask("near") == (0, "near: what was kept is written, and so is what comes next.\n")
        eventually(lambda: fired(robot) == {"near": 1, "far": 0}, "the one that was named")
        process.send_signal(signal.SIGUSR1)
        eventually(lambda: fired(robot) == {"near": 2, "far": 1}, "both")
        assert ask()[0] == 0
        eventually(lambda: fired(robot) == {"near": 3, "far": 2}, "both")
        process.send_signal(signal.SIGTERM)
        assert process.wait(30) == 0, log.read_text()
    lines = lines_of(chunks_of(robot))
    assert [(line["trigger"], line["why"]) for line in lines if "trigger" in line] == [
        ("near", "asked for"), ("near", "SIGUSR1"), ("far", "SIGUSR1"), ("near", "asked for"), ("far", "asked for"),
    ]  # fmt: skip
    topics = [line["topic"] for line in lines if "data" in line]
    first_far = topics.index("/robot_1/imu")
    assert first_far > 5 and set(topics) == {"/robot_1/odom", "/robot_1/imu"}
    times = [line["received_ns"] for line in lines if line.get("topic") == "/robot_1/odom"]
    assert times == sorted(set(times)), "nothing twice, in order"
    assert "trigger near (SIGUSR1): " in log.read_text()


def test_a_trigger_that_is_gone_after_a_reload_has_no_figures(robot: RobotHome):
    one = '[source]\nkind = "sim"\n[[trigger]]\nname = "crash"\n'
    topics = 'topics = [{topic = "/robot_1/odom", trigger = "crash"}, {topic = "/robot_1/imu", trigger = "NAME"}]\n'
    robot.config.write_text(f'{topics.replace("NAME", "fall")}{one}[[trigger]]\nname = "fall"\n')
    made = open_robot(robot, load_robot_config(robot.config), PASSWORD)
    with closing(made.spool), closing(made.loop):
        metrics.show(metrics.of_robot("robot_1", made, 1.0))
        robot.config.write_text(topics.replace("NAME", "crash") + one)
        made.reload(load_robot_config(robot.config), [READER.encryption_certificate.public_key])
        metrics.show(metrics.of_robot("robot_1", made, 2.0))
        metrics.save(metrics.file_of(robot.path, "robot"))
        figures = metrics.running(robot.path)["robot"] or []
        named = {labels["trigger"] for _, labels, _ in figures if "trigger" in labels}
    assert named == {"crash"}, "`trigger` asks for those that there are"


def test_a_robot_without_a_trigger_is_not_ended_by_the_signal(robot: RobotHome, tmp_path: Path):
    robot.config.write_text('topics = ["/robot_1/odom"]\n[source]\nkind = "sim"\n')
    with running(robot, tmp_path / "log") as process:
        eventually(lambda: "Ctrl-C ends it" in (tmp_path / "log").read_text(), "it runs")
        process.send_signal(signal.SIGUSR1)
        process.send_signal(signal.SIGHUP)
        eventually(lambda: "reloaded" in (tmp_path / "log").read_text(), "it goes on")


@pytest.mark.service
def test_a_message_of_a_live_graph_is_an_event(robot: RobotHome, require: Callable[[str], str], tmp_path: Path):
    require("rosmaster")
    graph, log = Graph(tmp_path), tmp_path / "log"
    trigger = '[[trigger]]\nname = "alarm"\nbefore = "1s"\nafter = "500ms"\nwhen = "/alarm data >= 3"\n'
    robot.config.write_text(
        f'topics = ["/alarm", {{ topic = "/kept", trigger = "alarm" }}]\n{trigger}'
        f'[source]\nkind = "ros1"\nmaster = "{graph.uri}"\nhostname = "127.0.0.1"\n'
    )
    try:
        graph.start_master()
        graph.publish("base", {"topic": "/kept", "kind": "number", "rate": 100})
        with running(robot, log) as process:
            eventually(lambda: graph.subscribers("/kept") and fired(robot), "it listens")
            time.sleep(1.5)  # a while before: what is older than 1 s is not to be written
            graph.publish("arm", {"topic": "/alarm", "kind": "number", "rate": 100, "count": 4})
            eventually(lambda: fired(robot) == {"alarm": 1}, "the fourth message, 3, is the event")
            time.sleep(1.0)  # and a while behind it
            process.send_signal(signal.SIGTERM)
            assert process.wait(30) == 0, log.read_text()
    finally:
        graph.close()
    lines = lines_of(chunks_of(robot))
    [event] = [line for line in lines if "trigger" in line]
    kept = [line for line in lines if line.get("topic") == "/kept"]
    numbers = [line["data"]["data"] for line in kept]
    assert numbers == [*range(numbers[0], numbers[0] + len(numbers))] and numbers[0] > 0
    apart = [line["received_ns"] - event["at_ns"] for line in kept]
    assert all(-S <= each <= S / 2 for each in apart) and apart[0] < -S / 2 < S / 4 < apart[-1]
    assert [line["data"]["data"] for line in lines if line.get("topic") == "/alarm"] == [0, 1, 2, 3]
