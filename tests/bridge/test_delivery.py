"""Writer to inbox through a bad network, in simulated time: every line stored once and in order, whatever restarts.

The real writer, spool, sender, channel, reception and inbox; only the network and the clock are simulated. What is
asserted is what the inbox holds, opened with the reader's key.
"""

from __future__ import annotations

import os
import random
import sqlite3
from collections.abc import Callable
from contextlib import closing
from datetime import UTC, datetime, timedelta
from functools import cache, partial
from pathlib import Path

import pytest
from eth_hash.auto import keccak

from bridge.channel.simulation import Faults, Network
from rosbridge_eth import identity as ids
from rosbridge_eth.channel import Client, ClientConfig, Event, Server, ServerConfig, cookie_key
from rosbridge_eth.errors import StoreError
from rosbridge_eth.inbox.sqlite import SqliteInbox
from rosbridge_eth.log.chunk import Chunk, Log, content_key, drop, open_lines, robot_id, seal
from rosbridge_eth.log.writer import LogWriter
from rosbridge_eth.robot.sender import Sender
from rosbridge_eth.server.reception import HELD, MISMATCH, Reception
from rosbridge_eth.spool import Spool

BIRTH = datetime(2026, 1, 1, tzinfo=UTC)
ROBOT_ADDRESS, SERVER_ADDRESS = ("192.0.2.2", 5000), ("192.0.2.1", 7410)
SEEDS = range(int(os.environ.get("DELIVERY_SEEDS", "2")))
BAD = Faults(loss=0.3, duplication=0.1, corruption=0.05, delay=0.02, jitter=0.05)
LEDGER = bytes(range(32))
STREAM_LINE = b'{"stream":{}}'
MIB = 1 << 20


@cache
def authority() -> ids.CertificateAuthority:
    return ids.create_ca("operator", at=BIRTH)


@cache
def identity(role: ids.Role) -> ids.Identity:
    return ids.enrol(authority(), role, "hub" if role is ids.Role.SERVER else "robot_1", at=BIRTH)


PLACE = Log(LEDGER, robot_id("robot_1"))


def wall() -> datetime:
    return BIRTH + timedelta(days=1)


class World:
    """One robot and one server over one network, both of which can be started again."""

    def __init__(self, folder: Path, seed: int, faults: Faults, *, room: int = 64 * MIB) -> None:
        self.network = Network(seed, faults)
        self.random = random.Random(seed)
        self.folder, self.room = folder, room
        self.allowed, self.certificates = True, keccak(identity(ids.Role.ROBOT).public.certificates)
        self.lines: list[bytes] = []
        self.unspooled_lines = 0
        self.look_at = 0.0
        self.open_server()
        self.server_host = self.network.attach(self.server, SERVER_ADDRESS, self.on_server_event)
        self.open_robot()
        self.robot_host = self.network.attach(self.client, ROBOT_ADDRESS, self.on_robot_event)
        self.client.connect(SERVER_ADDRESS, self.network.now)

    def open_inbox(self) -> SqliteInbox:
        return SqliteInbox(self.folder / "inbox.sqlite", LEDGER, self.room, self.room)

    def open_server(self) -> None:
        self.inbox = self.open_inbox()
        self.server = Server(ServerConfig(), identity(ids.Role.SERVER), ids.Trust((authority().certificate,)),
                             cookie_key(identity(ids.Role.SERVER)), self.network.now, wall=wall, stopwatch=lambda: 0.0)
        self.reception = Reception(
            self.server, self.inbox, LEDGER, lambda: {PLACE.tk: self.certificates} if self.allowed else {}
        )

    def open_robot(self) -> None:
        key = identity(ids.Role.ROBOT).signing_key
        self.spool = Spool(self.folder / "spool.sqlite", PLACE, max_bytes=64 * MIB, drop=partial(drop, PLACE, key))
        self.writer = LogWriter(
            PLACE, key, [identity(ids.Role.ROBOT).encryption_key.public_key], previous=self.spool.last_digest,
            stream_line=STREAM_LINE, now=self.network.now, randomness=self.random.randbytes,
        )
        self.client = Client(ClientConfig(), identity(ids.Role.ROBOT), ids.Trust((authority().certificate,)), "hub",
                             self.network.now, wall=wall)
        self.sender = Sender(self.client, self.spool)
        self.sender.begin_stream = self.begin_stream

    def begin_stream(self, refused: bytes) -> None:
        if refused == self.writer.stream:
            self.writer.new_stream()

    def restart_server(self) -> None:
        self.inbox.close()  # what was heard and not committed is lost with the process
        self.open_server()
        self.server_host.endpoint = self.server

    def restart_robot(self) -> None:
        self.spool.close()
        self.open_robot()
        self.robot_host.endpoint = self.client
        self.client.connect(SERVER_ADDRESS, self.network.now)

    def on_server_event(self, event: Event) -> None:
        self.reception.handle(event, self.network.now)

    def on_robot_event(self, event: Event) -> None:
        self.sender.handle(event, self.network.now)

    def capture(self, count: int) -> None:
        """So many lines, sealed and spooled at once."""
        for _ in range(count):
            self.lines.append(b'{"n":%d}' % len(self.lines))
            self.writer.add(self.lines[-1], self.network.now)
        for chunk in self.writer.closed(self.network.now + 1.0, 0):
            self.spool.append(chunk)

    def turn(self) -> None:
        """What both processes do between two waits."""
        self.reception.turn(self.network.now, self.network.now)
        self.sender.send()

    def run(self, seconds: float, until: Callable[[], bool] | None = None) -> bool:
        """Until the server has all there is, or `until`; False if that takes more than so many simulated seconds."""
        end = self.network.now + seconds
        while self.network.now < end:
            self.turn()
            if until() if until else self.sender.idle and self.sender.statistics.connected:
                return True
            if self.network.now >= self.look_at:  # one that waits is enough: more would multiply
                self.look_at = self.network.now + 0.05
                self.network.at(self.look_at, lambda: None)
            self.network.step()
        return False

    def stored(self) -> list[Chunk]:
        """What the inbox holds of the robot, in its order."""
        rows = self.inbox.rows(PLACE.tk, None, 10_000)
        return [Chunk.parse(data) for data in self.inbox.chunks(PLACE.tk, [row.position for row in rows])]

    def stored_lines(self) -> list[bytes]:
        lines: list[bytes] = []
        for chunk in self.stored():
            key = content_key(chunk.header, identity(ids.Role.ROBOT).encryption_key)
            lines += [line for line in open_lines(PLACE, chunk, key) if line != STREAM_LINE]
        return lines

    def assert_linked(self) -> None:
        headers = [chunk.header for chunk in self.stored()]
        assert [header.previous for header in headers] == [bytes(32), *(header.digest for header in headers[:-1])]


@pytest.mark.parametrize("seed", SEEDS)
def test_everything_arrives_once_and_in_order_through_a_bad_network(tmp_path: Path, seed: int) -> None:
    world = World(tmp_path, seed, BAD)
    for _ in range(30):
        world.capture(40)
        world.run(0.4, until=lambda: False)
    assert world.run(120)
    assert world.stored_lines() == world.lines
    world.assert_linked()


@pytest.mark.parametrize("seed", SEEDS)
def test_restarts_of_either_end_lose_and_double_nothing(tmp_path: Path, seed: int) -> None:
    world = World(tmp_path, seed, BAD)
    for _ in range(25):
        world.capture(20)
        world.run(world.random.uniform(0, 3), until=lambda: False)
        draw = world.random.random()
        if draw < 0.2:
            world.restart_server()
        elif draw < 0.4:
            world.restart_robot()
    assert world.run(300)
    assert world.stored_lines() == world.lines
    world.assert_linked()


def test_a_full_share_makes_the_robot_hold_and_go_on_without_a_hole(tmp_path: Path) -> None:
    world = World(tmp_path, 1, Faults(), room=8_000)
    for _ in range(40):
        world.capture(10)
    assert world.run(30, until=lambda: world.sender.statistics.held is not None)
    before = len(world.stored())
    assert 0 < before < 40
    for _ in range(60):
        rows = world.inbox.rows(PLACE.tk, None, 10_000)
        world.inbox.confirm(PLACE.tk, rows[-1].position, world.network.now)
        kept = world.stored()  # before they go
        world.lines_seen = getattr(world, "lines_seen", [])
        world.lines_seen += [chunk.header.number for chunk in kept]
        world.inbox.forget(world.network.now + 1)
        if world.run(2 * HELD, until=lambda: world.sender.idle):
            break
    rows = world.inbox.rows(PLACE.tk, None, 10_000)
    numbers = world.lines_seen + [chunk.header.number for chunk in world.stored()]
    assert sorted(set(numbers)) == list(range(40)), "a chunk that was offered while the robot had to hold is not lost"
    assert rows


def test_confirmed_chunks_leave_the_spool(tmp_path: Path) -> None:
    world = World(tmp_path, 2, BAD)
    world.capture(50)
    assert world.run(60)
    assert world.spool.statistics().chunks == 1
    [row] = world.inbox.rows(PLACE.tk, None, 10)
    world.inbox.confirm(PLACE.tk, row.position, world.network.now)
    assert world.run(60, until=lambda: world.spool.statistics().chunks == 0)


def test_a_lost_inbox_is_filled_again_with_what_is_not_confirmed(tmp_path: Path) -> None:
    world = World(tmp_path, 3, Faults())
    for _ in range(10):
        world.capture(10)
    assert world.run(60)
    world.inbox.close()
    for file in tmp_path.glob("inbox.sqlite*"):
        file.unlink()
    world.open_server()
    world.server_host.endpoint = world.server
    world.capture(10)
    assert world.run(60, until=lambda: world.spool.statistics().unstored == 11), "all of it waits for the server again"
    assert world.run(300)
    assert world.stored_lines() == world.lines


def test_an_exchanged_inbox_is_noticed_while_nobody_sends_and_filled_again(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    world = World(tmp_path, 3, Faults())
    for _ in range(10):
        world.capture(10)
    assert world.run(60)
    for file in tmp_path.glob("inbox.sqlite*"):
        file.unlink()
    assert world.run(5, until=lambda: "all sessions begin anew" in caplog.text)
    assert world.stored() == []
    assert world.run(60, until=lambda: len(world.stored()) == 10)
    assert world.stored_lines() == world.lines


@pytest.mark.parametrize("seed", range(6))
def test_an_old_copy_that_is_put_back_while_the_server_runs_loses_nothing(
    tmp_path: Path, seed: int, caplog: pytest.LogCaptureFixture
) -> None:
    """SQLite's own backup writes into the file that is in use: neither its name nor its inode changes."""
    world = World(tmp_path, seed, BAD)
    file, copy = tmp_path / "inbox.sqlite", tmp_path / "copy"
    for turn in range(30):
        world.capture(10)
        world.run(world.random.uniform(0, 2), until=lambda: False)
        if turn % 7 == 2:
            backup(file, copy)
        elif turn % 7 == 6:
            backup(copy, file)
    assert world.run(300)
    assert world.stored_lines() == world.lines
    world.assert_linked()
    assert "an old copy of the inbox" in caplog.text and "all sessions begin anew" in caplog.text


def backup(source: Path, target: Path) -> None:
    with closing(sqlite3.connect(source)) as read, closing(sqlite3.connect(target, timeout=30)) as written:
        read.backup(written)


def test_another_chunk_under_the_same_number_is_refused_and_a_new_stream_begins(tmp_path: Path) -> None:
    world = World(tmp_path, 4, Faults())
    other = seal(PLACE, identity(ids.Role.ROBOT).signing_key, [b'{"other":1}'], stream=world.writer.stream, number=0,
                 previous=bytes(32), sealed_ms=0, readers=[identity(ids.Role.ROBOT).encryption_key.public_key])
    world.inbox.append([(PLACE.tk, other)], 0.0)
    first = world.writer.stream
    # The robot asks about number 1 on: what it would send first is above what is there, so only number 0 is a loss.
    world.capture(5)
    assert world.run(60)
    world.capture(5)
    assert world.run(60)
    assert world.stored_lines()[0] == b'{"other":1}'
    assert world.stored_lines()[1:] == world.lines[5:]
    assert world.writer.stream == first


def test_a_chunk_signed_by_another_key_is_refused_and_the_robot_goes_on_in_a_new_stream(tmp_path: Path) -> None:
    world = World(tmp_path, 5, Faults())
    stranger = ids.enrol(authority(), ids.Role.ROBOT, "robot_1", at=BIRTH)  # the name's identity before it was replaced
    forged = seal(PLACE, stranger.signing_key, [b'{"old":1}'], stream=world.writer.stream, number=0,
                  previous=bytes(32), sealed_ms=0, readers=[stranger.encryption_key.public_key])
    world.spool.append(forged)
    first = world.writer.stream
    assert world.run(60, until=lambda: world.sender.statistics.refused == 1)
    assert world.writer.stream != first
    world.capture(5)
    assert world.run(60)
    assert world.stored_lines() == world.lines
    assert world.spool.statistics().aside == 1


def test_a_robot_whose_certificates_the_contract_does_not_have_is_told_to_hold(tmp_path: Path) -> None:
    world = World(tmp_path, 6, Faults())
    world.inbox.set_state(PLACE.tk, certificates_hash=b"d" * 32)
    world.capture(5)
    assert world.run(60, until=lambda: world.sender.statistics.held == MISMATCH)
    assert world.stored() == []
    world.inbox.set_state(PLACE.tk, certificates_hash=world.certificates)
    assert world.run(60)
    assert world.stored_lines() == world.lines


def test_a_store_that_is_away_makes_robots_hold_until_it_is_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    world = World(tmp_path, 7, Faults())

    def away(inbox: object, chunks: list[object], now: float) -> list[object]:
        if chunks:  # a look at a full disk succeeds, and is no reason to call it well
            raise StoreError("the disk is full; make room")
        return []

    with monkeypatch.context() as patch:
        patch.setattr(SqliteInbox, "append", away)
        world.capture(5)
        assert world.run(60, until=lambda: world.sender.statistics.held is not None)
        world.run(3 * HELD, until=lambda: False)
        assert world.stored() == []
    assert world.run(60)
    assert world.stored_lines() == world.lines
    assert caplog.text.count("the disk is full") == 1
    assert caplog.text.count("the inbox: well again") == 1


def test_a_session_of_somebody_who_is_revoked_ends_within_two_seconds(tmp_path: Path) -> None:
    world = World(tmp_path, 8, Faults())
    world.capture(5)
    assert world.run(60)
    world.allowed = False
    assert world.run(2, until=lambda: not world.sender.statistics.connected)


def test_what_a_slow_disk_took_of_somebody_who_was_revoked_meanwhile_is_not_acknowledged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    world, append = World(tmp_path, 8, Faults()), SqliteInbox.append

    def slow(inbox: SqliteInbox, chunks: list[tuple[bytes, Chunk]], now: float) -> object:
        world.allowed = world.allowed and not chunks
        return append(inbox, chunks, now)

    monkeypatch.setattr(SqliteInbox, "append", slow)
    world.capture(5)
    assert world.run(60, until=lambda: not world.allowed and not world.sender.statistics.connected)
    assert world.stored()
    assert world.spool.statistics().unstored == world.spool.statistics().chunks > 0


@pytest.mark.parametrize("junk", [b"", b"\x02", b"\x02junk", b"\x01" + bytes(10), b"\xff" * 100])
def test_what_is_no_message_ends_the_session_and_nothing_else(tmp_path: Path, junk: bytes) -> None:
    world = World(tmp_path, 9, Faults())
    world.capture(5)
    assert world.run(60)
    world.client.send(junk)
    sessions = world.sender.statistics.sessions
    assert world.run(60, until=lambda: world.sender.statistics.sessions > sessions)
    world.capture(5)
    assert world.run(60)
    assert world.stored_lines() == world.lines
