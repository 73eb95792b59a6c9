"""The robot's loop on a spool whose disk is full or away, with a source that says what it is told to."""

from __future__ import annotations

import re
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import closing
from datetime import UTC, datetime, timedelta
from functools import partial
from pathlib import Path

import pytest

from rosbridge_eth import identity as ids
from rosbridge_eth.capture import Capture, RawMessage, TopicRule, stream_line
from rosbridge_eth.channel import Client, ClientConfig, Connected, State
from rosbridge_eth.channel.udp import server_socket
from rosbridge_eth.config import Address
from rosbridge_eth.errors import NetworkError, SourceError, StoreError
from rosbridge_eth.log.chunk import Chunk, Log, drop, robot_id
from rosbridge_eth.log.database import DiskFull
from rosbridge_eth.log.hop import ServerState, decode_offer
from rosbridge_eth.log.store import NOWHERE, place_of
from rosbridge_eth.log.writer import LogWriter
from rosbridge_eth.robot.loop import MAX_UNSPOOLED, REPLAYED_BYTES, Robot
from rosbridge_eth.robot.sender import Sender
from rosbridge_eth.robot.sources import BagSource, Selection, sample_bag
from rosbridge_eth.robot.spool import Spool

MANY = REPLAYED_BYTES // 300
"""Messages, more than wait."""
TOPIC = "/robot_1/odom"
PLACE = Log(bytes(32), robot_id("robot_1"))
NOW = datetime.now(UTC)


class Source:
    """Emits the sample bag's messages, over and over, `count` of them; `live` decides whether it could drop."""

    kind, live = "bag", False

    def __init__(self, count: int) -> None:
        bag = BagSource(sample_bag(), Selection([TOPIC]), speed=None)
        self.messages, self.count, self.emitted = list(bag.messages()), count, 0
        bag.close()
        self.lost: dict[tuple[str, str], int] = {}
        self.closed = False

    def run(self, emit: Callable[[RawMessage], None], stop: threading.Event) -> None:
        while self.emitted < self.count and not stop.is_set():
            emit(self.messages[self.emitted % len(self.messages)])
            self.emitted += 1

    def close(self) -> None:
        self.closed = True


@pytest.fixture
def make(tmp_path: Path) -> Iterator[Callable[[int], Robot]]:
    """Robots with nobody at the other end."""
    ca = ids.create_ca("operator", at=NOW)
    who = ids.enrol(ca, ids.Role.ROBOT, "robot_1", at=NOW)
    nobody = server_socket(("127.0.0.1", 0))

    def made(count: int) -> Robot:
        now = time.monotonic()
        spool = Spool(tmp_path / "spool.sqlite", PLACE, max_bytes=1 << 24, drop=partial(drop, PLACE, who.signing_key))
        client = Client(ClientConfig(), who, ids.Trust((ca.certificate,)), "hub", now)
        writer = LogWriter(PLACE, who.signing_key, [who.encryption_key.public_key], previous=bytes(32),
                           stream_line=stream_line("bag", "test"), period=0.001, now=now)
        return Robot(source=Source(count), capture=Capture([TopicRule(TOPIC)], source_kind="bag"), writer=writer,
                     spool=spool, client=client, sender=Sender(client, spool, writer),
                     servers=[Address(*nobody.getsockname()[:2])])

    yield made
    nobody.close()


def test_while_the_spool_takes_nothing_a_bag_waits_and_then_all_of_it_is_kept(
    make: Callable[[int], Robot], monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    robot = make(MANY)
    append, full = robot.spool.append, [True]

    def maybe(chunk: object) -> None:
        if full[0]:
            raise StoreError("the disk is full; make room")
        append(chunk)  # type: ignore[arg-type]

    monkeypatch.setattr(robot.spool, "append", maybe)
    monkeypatch.setattr("rosbridge_eth.robot.loop.SPOOL_AGAIN", 0.01)
    monkeypatch.setattr("rosbridge_eth.robot.loop.LONGEST_WAIT", 0.01)
    seen: list[int] = []
    turns = 0

    def on_turn() -> None:
        nonlocal turns
        turns += 1
        if full[0] and len(robot._unspooled) >= MAX_UNSPOOLED:
            seen.append(robot.captured)
            full[0] = len(seen) < 50
        if robot.captured == MANY and not robot._unspooled:
            robot.stop()

    robot.run(on_turn=on_turn)
    assert len(set(seen)) == 1 and seen[0] < MANY, "nothing more is captured while nothing can be kept"
    assert robot.captured == MANY
    assert "the spool: the disk is full" in caplog.text
    assert "the spool: works again" in caplog.text
    assert f"{robot.chunks} chunks not yet at the server" in robot.summary


def test_a_spool_that_cannot_be_read_does_not_end_a_robot(
    make: Callable[[int], Robot], monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    robot = make(100)

    def away(*arguments: object) -> object:
        raise StoreError("the disk is gone; mount it")

    turns = 0

    def on_turn() -> None:
        nonlocal turns
        turns += 1
        if turns == 3:
            monkeypatch.setattr(robot.spool, "statistics", away)
            monkeypatch.setattr(robot.sender, "send", away)
            monkeypatch.setattr(type(robot.sender), "idle", property(away))
        if turns == 10:
            robot.stop()

    robot.run(on_turn=on_turn)
    assert turns == 10
    assert robot.summary == "the spool cannot be read"
    assert "the disk is gone" in caplog.text


def test_a_spool_that_can_be_written_and_not_read_is_told_once_and_once_that_it_is_well(
    make: Callable[[int], Robot], monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    robot, sends, away = make(3000), list[bool](), [True]

    def send(now: float) -> None:
        sends.append(away[0])
        if away[0]:
            raise StoreError("a page of it cannot be read")

    monkeypatch.setattr(robot.sender, "send", send)
    monkeypatch.setattr("rosbridge_eth.robot.loop.SPOOL_AGAIN", 0.0)

    def on_turn() -> None:
        if robot.captured == 3000 and not robot._unspooled:
            if away[0]:
                said = [line for line in caplog.messages if line.startswith("the spool: ")]
                assert said == ["the spool: a page of it cannot be read"] and robot.chunks > 3 and len(sends) > 3
            away[0] = False
            if not sends[-1]:
                robot.stop()

    robot.run(on_turn=on_turn)
    assert [line for line in caplog.messages if "the spool" in line][1:] == ["the spool: works again"]


def test_what_the_spool_could_not_note_of_the_servers_word_is_noted_later(
    make: Callable[[int], Robot], monkeypatch: pytest.MonkeyPatch
) -> None:
    robot, sent = make(10), list[bytes]()
    sender, spool = robot.sender, robot.spool
    with closing(spool), closing(robot.loop):
        monkeypatch.setattr(robot.client, "room", lambda: 1 << 16)
        monkeypatch.setattr(robot.client, "send", sent.append)
        [chunk] = robot.writer.finish(0)
        spool.append(chunk)
        robot.handle(State(ServerState().encode()))
        robot._send(0.0)
        assert [decode_offer(offer) for offer in sent] == [(chunk.encoded, b"")]
        here = place_of(chunk.header)
        said = ServerState(here, chunk.header.digest, here, 7).encode()
        confirmed, full = spool.confirmed, DiskFull("the disk is full; make room")

        def fails(*given: object) -> int:
            raise full

        monkeypatch.setattr(spool, "confirmed", fails)
        robot.handle(State(said))
        robot._send(1.0)
        assert robot.spool_trouble.why == str(full) and len(spool.rows(NOWHERE, 9)) == 1
        monkeypatch.setattr(spool, "confirmed", confirmed)
        robot._send(1.5)
        assert robot.spool_trouble.why == str(full), "a second has to pass"
        robot._send(2.0)
        assert robot.spool_trouble.why is None and sender.idle and spool.statistics().chunks == 0
        assert len(sent) == 1 and (sender.confirmed, sender.block) == (1, 7)


def test_a_time_at_which_the_server_s_own_certificates_do_not_hold_is_not_kept(make: Callable[[int], Robot]) -> None:
    robot, kept = make(0), list[float]()
    robot.sender._on_server_time = kept.append
    hub = ids.enrol(ids.create_ca("operator", at=NOW), ids.Role.SERVER, "hub", at=NOW).public
    for at in (NOW, hub.not_after + timedelta(seconds=1)):
        robot.handle(Connected(hub, bytes(8), at))
    with closing(robot.spool), closing(robot.loop):
        assert kept == [NOW.timestamp()], "with a later one, no certificate of this server would ever hold again"


class Full:
    """The spool's `append`, on a disk that is full as long as `full` says so."""

    def __init__(self, robot: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
        self.append, self.full = robot.spool.append, True
        monkeypatch.setattr(robot.spool, "append", self)

    def __call__(self, chunk: Chunk) -> None:
        if self.full:
            raise StoreError("the disk is full; make room")
        self.append(chunk)


def test_what_the_spool_took_nothing_of_until_the_end_is_not_said_to_be_kept(
    make: Callable[[int], Robot], monkeypatch: pytest.MonkeyPatch
) -> None:
    robot = make(100)
    Full(robot, monkeypatch)
    robot.run(on_turn=lambda: robot.stop() if robot.captured == 100 else None)
    assert f"{robot.chunks} chunks lost, since the spool took nothing" in robot.summary
    assert "nothing waits for the server" in robot.summary and "the next start" not in robot.summary


def test_a_robot_that_is_stopped_tries_the_spool_once_more(
    make: Callable[[int], Robot], monkeypatch: pytest.MonkeyPatch
) -> None:
    robot = make(100)
    spool = Full(robot, monkeypatch)
    monkeypatch.setattr("rosbridge_eth.robot.loop.SPOOL_AGAIN", 3600)

    def on_turn() -> None:
        if robot._unspooled and robot.captured == 100:
            spool.full = False
            robot.stop()

    robot.run(on_turn=on_turn)
    assert f"{robot.chunks} chunks not yet at the server" in robot.summary and "lost" not in robot.summary


def test_a_source_that_loses_messages_while_the_spool_takes_nothing_fills_no_memory(
    make: Callable[[int], Robot], monkeypatch: pytest.MonkeyPatch
) -> None:
    robot = make(1000)
    Full(robot, monkeypatch)
    for name, value in {"LOOK_EVERY": 0.0, "LONGEST_WAIT": 0.01, "MAX_UNSPOOLED": 3}.items():
        monkeypatch.setattr(f"rosbridge_eth.robot.loop.{name}", value)
    waiting: list[int] = []

    def on_turn() -> None:
        robot.source.lost[TOPIC, "dropped"] = len(waiting)  # type: ignore[attr-defined]
        if len(robot._unspooled) >= 3:
            waiting.append(len(robot._unspooled))
        if len(waiting) == 100:
            robot.stop()

    robot.run(on_turn=on_turn)
    assert waiting[-1] <= 4
    assert re.search(r"[1-9]\d+ messages lost, since the spool took nothing", robot.summary), "what the queue held"


def test_a_source_that_ended_while_the_spool_took_nothing_is_kept_when_it_does(
    make: Callable[[int], Robot], monkeypatch: pytest.MonkeyPatch
) -> None:
    robot = make(100)
    spool, turns = Full(robot, monkeypatch), 0
    monkeypatch.setattr("rosbridge_eth.robot.loop.SPOOL_AGAIN", 0.0)

    def on_turn() -> None:
        nonlocal turns
        if robot._unspooled and robot._unspooled[-1].header.goodbye:
            spool.full = False
        if not spool.full:
            turns += 1
            assert turns < 20, "the spool takes chunks again, and is not given those that wait"
            if not robot._unspooled:
                robot.stop()

    robot.run(on_turn=on_turn)
    assert f"{robot.chunks} chunks not yet at the server" in robot.summary


def test_a_server_that_says_what_is_no_message_does_not_keep_a_robot_from_capturing(
    make: Callable[[int], Robot], monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    robot = make(100)
    noise = State(b"\xff")
    monkeypatch.setattr(robot.loop, "step", lambda longest: robot.handle(noise))
    robot.run(on_turn=lambda: robot.stop() if robot.captured == 100 else None)
    assert f"{robot.chunks} chunks not yet at the server: the server says what is no message" in robot.summary
    assert caplog.text.count("use the same version on both ends") == 1, "once a minute"


def test_a_socket_that_is_none_any_more_ends_a_robot_with_everything_closed(
    make: Callable[[int], Robot], monkeypatch: pytest.MonkeyPatch
) -> None:
    robot = make(10)

    def breaks(longest: float) -> None:
        raise NetworkError("the socket cannot be read")

    monkeypatch.setattr(robot.loop, "step", breaks)
    with pytest.raises(NetworkError):
        robot.run()
    assert robot.source.closed, "whoever publishes is told that nobody listens any more"  # type: ignore[attr-defined]
    with pytest.raises(StoreError):
        robot.spool.statistics()


def test_what_the_source_raises_is_raised_after_what_was_captured_is_kept(make: Callable[[int], Robot]) -> None:
    robot = make(10)
    run = robot.source.run

    def breaks(emit: Callable[[RawMessage], None], stop: threading.Event) -> None:
        run(emit, stop)
        raise OSError("the bag ends in the middle of a message")

    robot.source.run = breaks  # type: ignore[method-assign]
    with pytest.raises(OSError, match="in the middle"):
        robot.run(on_turn=lambda: robot.stop() if robot.captured == 10 else None)
    assert robot.captured == 10
    assert "not yet at the server" in robot.summary


def test_a_live_source_that_dies_ends_the_robot_at_once_though_no_server_is_there(
    make: Callable[[int], Robot], caplog: pytest.LogCaptureFixture
) -> None:
    robot, began = make(0), time.monotonic()

    def dies(emit: Callable[[RawMessage], None], stop: threading.Event) -> None:
        raise SourceError("the graph was lost")

    robot.source.run, robot.source.live = dies, True  # type: ignore[method-assign, misc]
    turns = iter(range(100))
    with pytest.raises(SourceError, match="the graph was lost"):
        robot.run(on_turn=lambda: robot.stop() if next(turns) == 99 else None)
    assert next(turns) < 99 and "the graph was lost" in caplog.text
    assert time.monotonic() - began < 60 and robot.source.closed  # type: ignore[attr-defined]


@pytest.mark.parametrize("marks", [512, 4])
def test_what_is_confirmed_of_a_topic_is_what_chunks_up_to_that_place_hold(
    make: Callable[[int], Robot], monkeypatch: pytest.MonkeyPatch, marks: int
) -> None:
    monkeypatch.setattr("rosbridge_eth.robot.loop.MARKS", marks)
    monkeypatch.setattr("rosbridge_eth.robot.loop.GATHER", 0.0)
    robot = make(300)
    emit = robot._emit

    def slowly(raw: RawMessage) -> None:  # so that there are several chunks
        time.sleep(0.001)
        emit(raw)

    monkeypatch.setattr(robot, "_emit", slowly)
    monkeypatch.setattr(robot.spool, "close", lambda: None)
    robot.run(on_turn=lambda: robot.stop() if robot.captured == 300 else None)
    chunks = [Chunk.parse(robot.spool.chunks([row.place])[0]) for row in robot.spool.rows(NOWHERE, 10_000)]
    assert robot.writer.sealed[TOPIC] == robot.written[TOPIC] == 300 and len(chunks) > 20
    lines, shown = -2, []  # the line that opens the stream, and that of the type
    for chunk in chunks:
        lines += chunk.header.records
        robot.sender.newest = place_of(chunk.header)
        assert robot.confirmed()[TOPIC] <= max(0, lines)
        shown.append(robot.confirmed()[TOPIC] == max(0, lines))
    assert shown[-1] and robot.confirmed()[TOPIC] == 300 and len(robot._marks) == 0
    assert all(shown) == (marks == 512)
    Spool.close(robot.spool)
