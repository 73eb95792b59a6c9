"""Writer to store through a bad network, in simulated time: every line stored once and in order, whatever restarts.

The real writer, spool, sender, channel, reception and store; only the network and the clock are simulated. What is
asserted is what the store holds, opened with the reader's key. What the chain has of it in the end is
test_restored_store.py's.
"""

from __future__ import annotations

import logging
import os
import random
import shutil
import sqlite3
from collections.abc import Callable, Sequence
from contextlib import closing
from datetime import UTC, datetime, timedelta
from functools import cache, partial
from pathlib import Path

import pytest
from eth_hash.auto import keccak

from bridge.channel.simulation import Faults, Network
from rosbridge_eth import identity as ids
from rosbridge_eth.channel import (
    Client,
    ClientConfig,
    Disconnected,
    End,
    Event,
    Message,
    Server,
    ServerConfig,
    cookie_key,
)
from rosbridge_eth.errors import StoreError
from rosbridge_eth.log.chunk import MAX_TIME_MS, Chunk, Log, content_key, drop, open_lines, robot_id, seal
from rosbridge_eth.log.hop import FORKED, ServerState, encode_offer
from rosbridge_eth.log.sqlite import SqliteStore
from rosbridge_eth.log.store import NOWHERE, Offer, Outcome, Store, place_of
from rosbridge_eth.log.writer import LogWriter
from rosbridge_eth.robot.sender import REFUSED_RIGHT, TWICE, Sender
from rosbridge_eth.robot.spool import Spool
from rosbridge_eth.server.reception import AWAY, ENOUGH, HELD, MISMATCH, NO_ROOM, WAITING, Reception

BIRTH = datetime(2026, 1, 1, tzinfo=UTC)
ROBOT_ADDRESS, SERVER_ADDRESS = ("192.0.2.2", 5000), ("192.0.2.1", 7410)
SEEDS = range(int(os.environ.get("DELIVERY_SEEDS", "2")))
BAD = Faults(loss=0.3, duplication=0.1, corruption=0.05, delay=0.02, jitter=0.05)
LEDGER = bytes(range(32))
STREAM_LINE = b'{"stream":{}}'
MIB = 1 << 20
FIRST_MS = 1_780_000_000_000


@cache
def authority() -> ids.CertificateAuthority:
    return ids.create_ca("operator", at=BIRTH)


@cache
def identity(role: ids.Role) -> ids.Identity:
    return ids.enrol(authority(), role, "hub" if role is ids.Role.SERVER else "robot_1", at=BIRTH)


PLACE = Log(LEDGER, robot_id("robot_1"))


def wall() -> datetime:
    return BIRTH + timedelta(days=1)


class Machine:
    """A robot's machine: its disk is a folder, and its process can be started again."""

    def __init__(self, world: World, folder: Path, address: tuple[str, int] = ROBOT_ADDRESS) -> None:
        self.world, self.folder = world, folder
        folder.mkdir(exist_ok=True)
        self.lines: list[bytes] = []
        self.start()
        self.host = world.network.attach(self.client, address, self.on_event)
        self.client.connect(SERVER_ADDRESS, world.network.now)

    def start(self) -> None:
        key, world = identity(ids.Role.ROBOT).signing_key, self.world
        self.spool = Spool(self.folder / "spool.sqlite", PLACE, max_bytes=64 * MIB, drop=partial(drop, PLACE, key))
        self.writer = LogWriter(
            PLACE, key, [identity(ids.Role.ROBOT).encryption_key.public_key], previous=self.spool.last_digest,
            newest=self.spool.newest[:16], stream_line=STREAM_LINE, now=world.network.now,
            randomness=world.random.randbytes,
        )
        self.client = Client(ClientConfig(), identity(ids.Role.ROBOT), ids.Trust((authority().certificate,)), "hub",
                             world.network.now, wall=wall)
        self.sender = Sender(self.client, self.spool, self.writer)

    def restart(self, *, disk: Callable[[], None] = lambda: None) -> None:
        """disk: what happens to the disk meanwhile."""
        self.spool.close()
        disk()
        self.start()
        self.host.endpoint = self.client
        self.client.connect(SERVER_ADDRESS, self.world.network.now)

    def lose_disk(self) -> None:
        for file in self.folder.glob("spool.sqlite*"):
            file.unlink()

    def on_event(self, event: Event) -> None:
        self.sender.handle(event, self.world.network.now)

    def capture(self, count: int, *, clock_ms: int | None = None) -> None:
        """So many lines, sealed and spooled at once, as one chunk."""
        now = self.world.network.now
        for _ in range(count):
            self.lines.append(b'{"n":%d}' % len(self.world.lines))
            self.world.lines.append(self.lines[-1])
            self.writer.add(self.lines[-1], now)
        for chunk in self.writer.closed(now + 1.0, int(FIRST_MS + now * 1000) if clock_ms is None else clock_ms):
            self.spool.append(chunk)

    def chunks(self) -> list[Chunk]:
        """What is on its disk and not confirmed; the newest confirmed one stays, since it shows a fork."""
        count = self.spool.statistics().chunks
        rows = self.spool.rows(NOWHERE, 10_000)[-count:] if count else []
        return [Chunk.parse(self.spool.chunks([row.place])[0]) for row in rows]


class World:
    """One server and a robot's machine over one network, each of which can be started again."""

    def __init__(self, folder: Path, seed: int, faults: Faults, *, room: int = 64 * MIB) -> None:
        self.network = Network(seed, faults)
        self.random = random.Random(seed)
        self.folder, self.room = folder, room
        self.allowed, self.certificates = True, keccak(identity(ids.Role.ROBOT).public.certificates)
        self.lines: list[bytes] = []
        self.look_at = 0.0
        self.open_server()
        self.server_host = self.network.attach(self.server, SERVER_ADDRESS, self.on_server_event)
        self.robot = Machine(self, folder / "robot")
        self.machines = [self.robot]

    @property
    def sender(self) -> Sender:
        return self.robot.sender

    def clone(self, name: str = "clone", *, with_disk: bool = False) -> Machine:
        """Another machine with the robot's identity."""
        if with_disk:
            self.robot.spool.close()
            shutil.copytree(self.robot.folder, self.folder / name)
            self.robot.start()
            self.robot.host.endpoint = self.robot.client
            self.robot.client.connect(SERVER_ADDRESS, self.network.now)
        self.machines.append(Machine(self, self.folder / name, ("192.0.2.3", 5000)))
        return self.machines[-1]

    def open_store(self) -> Store:
        return SqliteStore(self.folder / "store.sqlite", LEDGER, self.room, self.room)

    def open_server(self) -> None:
        self.store = self.open_store()
        self.server = Server(ServerConfig(), identity(ids.Role.SERVER), ids.Trust((authority().certificate,)),
                             cookie_key(identity(ids.Role.SERVER)), self.network.now, wall=wall, stopwatch=lambda: 0.0)
        self.reception = Reception(
            self.server, self.store, LEDGER, lambda: {PLACE.tk: self.certificates} if self.allowed else {}
        )

    def restart_server(self, *, store: Callable[[], None] = lambda: None) -> None:
        """store: what happens to the store meanwhile."""
        self.store.close()  # what was heard and not committed is lost with the process
        store()
        self.open_server()
        self.server_host.endpoint = self.server

    def lose_store(self) -> None:
        for file in self.folder.glob("store.sqlite*"):
            file.unlink()

    def on_server_event(self, event: Event) -> None:
        self.reception.handle(event, self.network.now)

    def run(self, seconds: float, until: Callable[[], bool] | None = None) -> bool:
        """Until the server has all there is, or `until`; False if that takes more than so many simulated seconds."""
        end = self.network.now + seconds
        while self.network.now < end:
            self.reception.turn(self.network.now, self.network.now)
            for machine in self.machines:
                machine.sender.send(self.network.now)
            if until() if until else self.sender.idle:
                return True
            if self.network.now >= self.look_at:  # one that waits is enough: more would multiply
                self.look_at = self.network.now + 0.05
                self.network.at(self.look_at, lambda: None)
            self.network.step()
        return False

    def pass_time(self, seconds: float) -> None:
        self.run(seconds, until=lambda: False)

    def confirm(self) -> None:
        """All that the store has is on the chain, for good."""
        [state] = self.store.states([PLACE.tk])
        self.store.set_state(PLACE.tk, confirmed=state.head, block=7)

    def stored(self) -> list[Chunk]:
        """What the store holds of the robot, in its order."""
        rows = self.store.rows(PLACE.tk, NOWHERE, 10_000)
        return [Chunk.parse(data) for data in self.store.chunks(PLACE.tk, [row.place for row in rows])]

    def stored_lines(self) -> list[bytes]:
        return [line for chunk in self.stored() for line in lines_of(chunk)]

    def assert_linked(self) -> None:
        headers = [chunk.header for chunk in self.stored()]
        assert [header.previous for header in headers] == [bytes(32), *(header.digest for header in headers[:-1])]


def lines_of(chunk: Chunk) -> list[bytes]:
    key = content_key(chunk.header, identity(ids.Role.ROBOT).encryption_key)
    return [line for line in open_lines(PLACE, chunk, key) if line != STREAM_LINE]


def copy_folder(source: Path, target: Path) -> None:
    shutil.rmtree(target, ignore_errors=True)
    shutil.copytree(source, target)


def told(caplog: pytest.LogCaptureFixture, who: str) -> str:
    """The warnings of one end."""
    return "\n".join(entry.getMessage() for entry in caplog.records
                     if entry.levelno >= logging.WARNING and entry.name.endswith(who))  # fmt: skip


# Through a bad network, and restarts


@pytest.mark.parametrize("seed", SEEDS)
def test_everything_arrives_once_and_in_order_through_a_bad_network(tmp_path: Path, seed: int) -> None:
    world = World(tmp_path, seed, BAD)
    for _ in range(30):
        world.robot.capture(40)
        world.pass_time(0.4)
    assert world.run(120)
    assert world.stored_lines() == world.lines
    world.assert_linked()


@pytest.mark.parametrize("loss", [0.0, 0.1, 0.3])
@pytest.mark.parametrize("seed", SEEDS)
def test_kills_of_either_end_and_lost_and_restored_stores_lose_and_double_nothing(
    tmp_path: Path, seed: int, loss: float
) -> None:
    world = World(tmp_path, seed, Faults(loss=loss, delay=0.02, jitter=0.02))
    copy, happened = tmp_path / "copy", set[int]()
    for turn in range(40):
        world.robot.capture(20)
        world.pass_time(world.random.uniform(0, 2))
        draw = world.random.randrange(12)
        if draw == 0:
            world.restart_server()
        elif draw == 1:
            world.robot.restart()
        elif draw == 2:
            world.restart_server(store=world.lose_store)
        elif draw == 3 and copy.exists():  # SQLite's own backup writes into the file that is in use
            backup(copy, tmp_path / "store.sqlite")
        elif turn % 10 == 5:
            backup(tmp_path / "store.sqlite", copy)
        happened.add(draw)
    world.pass_time(60)  # until the robot has noticed what happened last
    assert world.run(300)
    assert world.stored_lines() == world.lines
    world.assert_linked()
    assert len(happened & {0, 1, 2, 3}) >= 3


def backup(source: Path, target: Path) -> None:
    with closing(sqlite3.connect(source)) as read, closing(sqlite3.connect(target, timeout=30)) as written:
        read.backup(written)


def test_weeks_without_a_network_are_sent_when_it_is_back(tmp_path: Path) -> None:
    world = World(tmp_path, 3, Faults(rate=4_000_000))
    world.allowed = False
    for _ in range(2500):
        world.robot.capture(1)
    assert world.stored() == []
    world.allowed = True
    assert world.run(120)
    assert world.stored_lines() == world.lines
    world.assert_linked()
    world.confirm()
    assert world.run(5, until=lambda: world.robot.chunks() == [])


def test_confirmed_chunks_leave_the_disk_and_stored_ones_do_not(tmp_path: Path) -> None:
    world = World(tmp_path, 2, BAD)
    for _ in range(3):
        world.robot.capture(10)
    assert world.run(60)
    first, *rest = world.robot.chunks()
    assert len(rest) == 2
    world.store.set_state(PLACE.tk, confirmed=place_of(first.header), block=7)
    assert world.run(60, until=lambda: len(world.robot.chunks()) == 2)
    world.pass_time(5)
    assert world.robot.chunks() == rest and world.sender.block == 7
    world.confirm()
    assert world.run(60, until=lambda: world.robot.chunks() == [])


# The server's store


def test_a_store_that_is_lost_while_the_server_is_down_is_filled_again(tmp_path: Path) -> None:
    world = World(tmp_path, 3, Faults())
    for _ in range(10):
        world.robot.capture(10)
    assert world.run(60)
    world.restart_server(store=world.lose_store)
    world.robot.capture(10)
    assert world.run(300)
    assert world.stored_lines() == world.lines


def test_a_store_that_is_emptied_while_nobody_sends_is_filled_again_in_the_same_session(tmp_path: Path) -> None:
    world = World(tmp_path, 3, Faults())
    backup(tmp_path / "store.sqlite", tmp_path / "copy")
    for _ in range(10):
        world.robot.capture(10)
    assert world.run(60)
    backup(tmp_path / "copy", tmp_path / "store.sqlite")
    assert world.stored() == []
    assert world.run(5, until=lambda: len(world.stored()) == 10)
    assert world.stored_lines() == world.lines and world.sender.sessions == 1


def test_a_store_that_is_away_makes_robots_wait_until_it_is_back(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, caplog: pytest.LogCaptureFixture
) -> None:
    world = World(tmp_path, 7, Faults())

    def full(offers: object, now: float) -> list[Outcome]:
        raise StoreError("the disk is full; make room")

    with monkeypatch.context() as patch:
        patch.setattr(world.store, "append", full)
        world.robot.capture(5)
        assert world.run(60, until=lambda: world.sender.held == AWAY)
        sent = world.sender.sent
        world.pass_time(3 * HELD)
        assert world.stored() == []
        assert world.sender.sent - sent <= 4, "it tries again every HELD seconds"
    assert world.run(60)
    assert world.stored_lines() == world.lines
    assert caplog.text.count("the disk is full") == 1
    assert caplog.text.count("the store: works again") == 1


def test_a_store_that_cannot_be_read_is_told_to_robots_that_come(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    world = World(tmp_path, 7, Faults())
    world.robot.capture(5)

    def away(tks: object) -> object:
        raise StoreError("Redis does not answer")

    with monkeypatch.context() as patch:
        patch.setattr(world.store, "states", away)
        assert world.run(60, until=lambda: world.sender.held == AWAY)
        world.pass_time(10)
        assert world.sender.sent == 0 and not world.sender.idle
    assert world.run(60)
    assert world.stored_lines() == world.lines


def test_a_full_share_makes_the_robot_wait_and_go_on_without_a_hole(tmp_path: Path) -> None:
    world = World(tmp_path, 1, Faults(), room=8_000)
    for _ in range(40):
        world.robot.capture(10)
    assert world.run(30, until=lambda: world.sender.held == NO_ROOM)
    seen = list[Chunk]()
    assert 0 < len(world.stored()) < 40
    for _ in range(60):
        seen += world.stored()  # before they go
        world.confirm()
        world.store.forget(PLACE.tk, world.network.now + 1, 0)
        if world.run(2 * HELD):
            break
    seen += world.stored()
    digests = list(dict.fromkeys(chunk.header.digest for chunk in seen))
    lines = {chunk.header.digest: lines_of(chunk) for chunk in seen}
    assert [line for digest in digests for line in lines[digest]] == world.lines


# What is refused, and what is behind it


def forged(world: World) -> Chunk:
    """What the name's identity before it was replaced would have written next."""
    stranger = ids.enrol(authority(), ids.Role.ROBOT, "robot_1", at=BIRTH)
    place = world.robot.spool.newest
    return seal(PLACE, stranger.signing_key, [b'{"old":1}'], stream=place[:16] if any(place) else bytes(15) + b"1",
                number=int.from_bytes(place[16:], "big") + 1, previous=world.robot.spool.last_digest, sealed_ms=0,
                readers=[stranger.encryption_key.public_key])  # fmt: skip


def test_a_refused_chunk_is_set_aside_and_what_is_behind_it_is_taken_only_then(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    world = World(tmp_path, 5, Faults())
    world.robot.capture(5)
    bad = forged(world)
    world.robot.spool.append(bad)
    world.robot.writer._previous = bad.header.digest
    world.robot.writer._number += 1
    stream = world.robot.writer.stream
    world.robot.capture(5)
    world.robot.capture(5)
    assert world.run(60, until=lambda: world.reception.counts["refused"] == 1)
    assert len(world.stored()) == 1, "those behind it were on their way, and are not taken"
    assert world.run(60)
    assert world.sender.refused == 1 and world.robot.spool.statistics().aside == 1
    assert world.stored_lines() == world.lines
    assert "its signature or its body is wrong" in told(caplog, "sender") and "is refused" in told(caplog, "reception")
    world.pass_time(2)
    world.robot.capture(5)
    assert world.robot.writer.stream > stream
    assert world.run(60)
    assert world.stored_lines() == world.lines
    world.confirm()
    assert world.run(60, until=lambda: world.robot.chunks() == [])


def test_a_chunk_behind_a_gap_is_taken_only_behind_what_the_robot_named(tmp_path: Path) -> None:
    """The store goes back to an old copy while such a chunk is on its way: it is no reason to leave out what is
    acknowledged and not in that copy."""
    world = World(tmp_path, 5, Faults(delay=0.5))
    world.robot.capture(5)
    assert world.run(60)
    backup(tmp_path / "store.sqlite", tmp_path / "copy")
    world.robot.capture(5)
    assert world.run(60)
    bad = forged(world)
    world.robot.spool.append(bad)
    world.robot.writer._previous = bad.header.digest
    assert world.run(60, until=lambda: world.sender.refused == 1)
    world.pass_time(2)
    world.robot.capture(5)
    sent, missed = world.sender.sent, world.reception.counts["not_next"]
    assert world.run(60, until=lambda: world.sender.sent > sent)
    backup(tmp_path / "copy", tmp_path / "store.sqlite")
    assert world.run(60, until=lambda: world.reception.counts["not_next"] > missed)
    assert world.run(60)
    assert world.stored_lines() == world.lines


def test_a_robot_whose_certificates_the_contract_does_not_have_is_told_so(tmp_path: Path) -> None:
    world = World(tmp_path, 6, Faults())
    world.store.set_state(PLACE.tk, certificates=b"d" * 32)
    world.robot.capture(5)
    assert world.run(60, until=lambda: world.sender.held == MISMATCH)
    world.pass_time(10)
    assert world.stored() == [] and not world.sender.idle
    world.store.set_state(PLACE.tk, certificates=world.certificates)
    assert world.run(60)
    assert world.stored_lines() == world.lines


def test_a_robot_that_was_revoked_after_the_registrys_backup_is_told_so_and_nothing_of_it_is_taken(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """The registry still has it in force, the submitter has seen the contract's word."""
    world = World(tmp_path, 6, Faults())
    world.store.set_state(PLACE.tk, certificates=bytes(32))
    world.robot.capture(5)
    assert world.run(60, until=lambda: world.sender.held == MISMATCH)
    world.pass_time(30)
    assert world.stored() == [] and not world.sender.idle
    assert caplog.messages.count(f"robot robot_1: {MISMATCH}") == 1
    assert "registry is an older copy" in MISMATCH and "node is behind" in MISMATCH


def test_a_session_of_somebody_who_is_revoked_ends_within_two_seconds(tmp_path: Path) -> None:
    world = World(tmp_path, 8, Faults())
    world.robot.capture(5)
    assert world.run(60)
    world.allowed = False
    assert world.run(2, until=lambda: not world.sender.connected)


def test_what_a_slow_disk_took_of_somebody_who_was_revoked_meanwhile_is_not_acknowledged(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    world = World(tmp_path, 8, Faults())
    append = world.store.append

    def slow(offers: Sequence[Offer], now: float) -> list[Outcome]:
        world.allowed = False
        return append(offers, now)

    world.robot.capture(5)
    assert world.run(60, until=lambda: world.sender.state is not None)
    head = world.sender.state and world.sender.state.head
    monkeypatch.setattr(world.store, "append", slow)
    assert world.run(60, until=lambda: not world.allowed and not world.sender.connected)
    assert world.stored() and head == NOWHERE and not world.sender.idle
    assert len(world.robot.chunks()) == 1


@pytest.mark.parametrize("junk", [b"", b"\0", b"\0junk", b"\1" + bytes(32), b"\2" * 100, b"\xff" * 100])
def test_what_is_no_message_ends_the_session_and_nothing_else(tmp_path: Path, junk: bytes) -> None:
    world = World(tmp_path, 9, Faults())
    world.robot.capture(5)
    assert world.run(60)
    world.robot.client.send(junk)
    sessions = world.sender.sessions
    assert world.run(60, until=lambda: world.sender.sessions > sessions)
    world.robot.capture(5)
    assert world.run(60)
    assert world.stored_lines() == world.lines


def test_what_comes_behind_no_message_is_not_looked_at(tmp_path: Path, caplog: pytest.LogCaptureFixture) -> None:
    """Thousands of empty messages fit the segments that one datagram completes."""
    world = World(tmp_path, 9, Faults())
    world.robot.capture(5)
    assert world.run(60)
    for _ in range(2000):
        world.robot.client.send(b"")
    sessions = world.sender.sessions
    assert world.run(60, until=lambda: world.sender.sessions > sessions)
    assert world.reception.counts["malformed"] == 1
    assert caplog.text.count("sends what is no chunk") == 1


def test_a_robot_that_floods_the_server_has_a_bounded_share_of_each_turn(tmp_path: Path) -> None:
    world = World(tmp_path, 10, Faults())
    world.robot.capture(1)
    assert world.run(60)
    [session] = world.reception.sessions.values()
    for _ in range(400):
        world.robot.capture(1)
    for row in world.robot.spool.rows(place_of(world.stored()[-1].header), 10_000):
        offer = encode_offer(world.robot.spool.chunks([row.place])[0])
        world.reception.handle(Message(session.connection, offer), world.network.now)
    before = len(world.stored())
    world.reception.commit(world.network.now, world.network.now)
    assert len(world.stored()) - before <= ENOUGH and len(session.offers) <= WAITING
    assert world.run(60)
    assert world.stored_lines() == world.lines
    world.assert_linked()


# A server that lies


def says(world: World, *state: bytes) -> None:
    """To the robot, which does what there is to do."""
    world.sender.take(ServerState(*state).encode(), world.network.now)
    world.sender.send(world.network.now)
    world.sender.handle(Disconnected(End.SILENT, b"", identity(ids.Role.SERVER).public), world.network.now)


@pytest.mark.parametrize("head", [0, 1, 3])
def test_no_chunk_that_the_server_never_had_leaves_the_disk_at_its_word(tmp_path: Path, head: int) -> None:
    """It says that a chunk is there, and confirmed, whose place it can guess, and whose digest it cannot."""
    world = World(tmp_path, 2, Faults())
    for _ in range(4):
        world.robot.capture(3)
    chunks = world.robot.chunks()
    place, newest = place_of(chunks[head].header), place_of(chunks[-1].header)
    says(world, place, bytes(32), place)
    says(world, place, chunks[0].header.digest if head else bytes(32), newest)
    assert world.robot.chunks() == chunks and world.robot.spool.covered == NOWHERE
    world.robot.restart()
    assert world.run(60)
    assert world.stored_lines() == world.lines


def test_a_chunk_that_is_right_is_not_set_aside_whatever_the_server_says(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """As one that is of another contract by mistake, or has a defect: more would be set aside than is kept."""
    world = World(tmp_path, 5, Faults())
    right, world.reception._ledger = world.reception._ledger, bytes(32)
    for _ in range(3):
        world.robot.capture(5)
    world.run(20, until=lambda: bool(world.sender.held))
    world.robot.capture(5)
    world.pass_time(20)
    assert world.sender.held == REFUSED_RIGHT and told(caplog, "sender").count(REFUSED_RIGHT) == 1
    assert len(world.robot.chunks()) == 4 and world.robot.spool.statistics().aside == 0
    world.restart_server()
    world.reception._ledger = right
    world.pass_time(60)
    assert world.run(60)
    assert world.stored_lines() == world.lines


@pytest.mark.parametrize("at", [0, 18, 34, 60, 138, 260, -1])
def test_a_chunk_that_the_disk_changed_is_set_aside_and_the_others_go_on(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, at: int
) -> None:
    """at: which byte: version, place, previous, time, number of grants, signature, body."""
    world = World(tmp_path, 5, Faults())
    for _ in range(3):
        world.robot.capture(5)
    bad = world.robot.chunks()[1]
    changed = bytearray(bad.encoded)
    changed[at] ^= 1
    world.robot.spool.close()
    with closing(sqlite3.connect(tmp_path / "robot" / "spool.sqlite")) as disk, disk:
        disk.execute("UPDATE chunk SET chunk = ? WHERE digest = ?", (bytes(changed), bad.header.digest))
    world.robot.restart()
    world.robot.capture(5)
    assert world.run(20)
    assert world.stored_lines() == [line for line in world.lines if line not in lines_of(bad)]
    assert world.sender.refused == 1 and world.robot.spool.statistics().aside == 1
    assert world.reception.counts["refused"] <= 1 and "set aside" in told(caplog, "sender")


@pytest.mark.parametrize("time", [2**64 - 1, MAX_TIME_MS, MAX_TIME_MS - 1])
def test_a_head_at_the_end_of_all_time_leaves_room_for_new_streams(tmp_path: Path, time: int) -> None:
    world = World(tmp_path, 2, Faults())
    says(world, time.to_bytes(8, "big") + b"\xff" * 16)
    for _ in range(10):
        world.robot.capture(3)
        world.robot.restart()
    assert world.run(60)
    assert world.stored_lines() == world.lines


# The robot's disk, and a second machine


def test_a_robot_that_lost_its_disk_goes_on_behind_what_the_server_has(tmp_path: Path) -> None:
    world = World(tmp_path, 4, Faults())
    world.robot.capture(5)
    world.robot.capture(5)
    assert world.run(60)
    world.robot.restart(disk=world.robot.lose_disk)
    world.robot.capture(5)
    assert world.run(60)
    assert world.stored_lines() == world.lines
    assert world.stored()[-1].header.previous == bytes(32), "the reader sees that the log was cut"


def test_a_robot_without_disk_and_clock_names_its_stream_above_what_the_server_has(tmp_path: Path) -> None:
    world = World(tmp_path, 4, Faults())
    world.robot.capture(5)
    assert world.run(60)
    world.robot.restart(disk=world.robot.lose_disk)
    assert world.run(60, until=lambda: world.sender.state is not None)
    world.robot.capture(5, clock_ms=0)
    assert world.run(60)
    assert world.stored_lines() == world.lines


def test_a_disk_that_is_put_back_from_an_old_copy_is_told_on_both_ends_and_nothing_is_dropped(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    world = World(tmp_path, 4, Faults())
    robot, copy = world.robot, tmp_path / "old"
    robot.capture(5)
    robot.restart(disk=partial(copy_folder, robot.folder, copy))
    robot.capture(5)
    assert world.run(60)
    stored = world.stored()
    robot.restart(disk=partial(copy_folder, copy, robot.folder))
    robot.capture(5)
    world.confirm()
    assert world.run(30, until=lambda: world.sender.held == FORKED and bool(world.reception.forked))
    world.pass_time(20)
    assert world.stored() == stored and len(robot.chunks()) == 2 and not world.sender.idle
    assert FORKED in told(caplog, "sender") and FORKED in told(caplog, "reception")
    assert world.sender.sent <= 3, "what is held is not sent again and again"


@pytest.mark.parametrize("with_disk", [False, True])
def test_a_clone_is_told_on_both_machines_and_by_the_server(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, with_disk: bool
) -> None:
    world = World(tmp_path, 4, Faults())
    world.robot.capture(5)
    assert world.run(60)
    clone = world.clone(with_disk=with_disk)
    for _ in range(40):  # the session goes to and fro
        world.robot.capture(1)
        clone.capture(1)
        world.pass_time(1.0)
    assert TWICE in told(caplog, "sender") and FORKED in told(caplog, "sender")
    assert FORKED in told(caplog, "reception") and "robot_1" in world.reception.forked
    world.confirm()
    world.pass_time(25)  # each has its turn; they come ever more slowly
    stored = {*world.stored_lines()}
    held = [machine for machine in world.machines if not stored.issuperset(machine.lines)]
    assert len(held) == 1, "one of the two goes on, the other is held"
    kept = {line for chunk in held[0].chunks() for line in lines_of(chunk)}
    assert kept | stored >= {*held[0].lines}, "nothing of it is dropped"


def test_a_machine_that_begins_below_what_another_has_written_keeps_its_chunks(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    """Its clock is years behind, and it wrote before it heard of the server's head: no place is left for it."""
    world = World(tmp_path, 4, Faults())
    world.robot.capture(5)
    assert world.run(60)
    stored = world.stored()
    world.robot.restart(disk=world.robot.lose_disk)
    world.robot.capture(5, clock_ms=0)
    assert world.run(30, until=lambda: world.sender.held == FORKED)
    world.confirm()
    world.pass_time(20)
    assert world.stored() == stored and len(world.robot.chunks()) == 1 and not world.sender.idle
    assert "the robot's log goes on elsewhere" in told(caplog, "sender")
