"""Spool to inbox through a bad network, in simulated time: every record stored once, whatever restarts.

The real spool, sender, channel, reception and inbox; only the network and the
clock are simulated. What is asserted is what the inbox gives out.
"""

from __future__ import annotations

import os
import random
from datetime import UTC, datetime, timedelta
from functools import cache
from pathlib import Path

import pytest

from rosbridge_eth import identity as ids
from rosbridge_eth.channel import Client, ClientConfig, Event, MessageReceived, Server, ServerConfig, cookie_key
from rosbridge_eth.channel.simulation import Faults, Network
from rosbridge_eth.errors import NetworkError
from rosbridge_eth.protocol import Ack, RecordStatus, Registration
from rosbridge_eth.records import RecordId, SealedRecord
from rosbridge_eth.robot.sender import Sender
from rosbridge_eth.server.reception import Reception
from rosbridge_eth.store import Delivery, InboxLimits, Spool, SqliteInbox

BIRTH = datetime(2026, 1, 1, tzinfo=UTC)
ROBOT_ADDRESS, SERVER_ADDRESS = ("192.0.2.2", 5000), ("192.0.2.1", 7410)
SEEDS = range(int(os.environ.get("DELIVERY_SEEDS", "4")))
BAD = Faults(loss=0.3, duplication=0.1, corruption=0.05, delay=0.02, jitter=0.05)


@cache
def authority() -> ids.CertificateAuthority:
    return ids.create_ca("operator", at=BIRTH)


@cache
def identity(role: ids.Role) -> ids.Identity:
    return ids.enrol(authority(), role, "hub" if role is ids.Role.SERVER else "robot_1", at=BIRTH)


def trust() -> ids.Trust:
    return ids.Trust((authority().certificate,))


def wall() -> datetime:
    return BIRTH + timedelta(days=1)


class World:
    """One robot and one server over one network, both of which can be started again."""

    def __init__(self, folder: Path, seed: int, faults: Faults, *, release: str = "stored",
                 limits: InboxLimits | None = None) -> None:
        self.network = Network(seed, faults)
        self.folder, self.release, self.limits = folder, release, limits or InboxLimits()
        self.states: dict[RecordId, str] = {}
        self.registration = Registration(True, "0xA", "0xC", 1, 1)
        self.arrived: list[MessageReceived] = []
        self.open_server()
        self.server_host = self.network.attach(self.server, SERVER_ADDRESS, self.on_server_event)
        self.open_robot()
        self.robot_host = self.network.attach(self.client, ROBOT_ADDRESS, self.on_robot_event)
        self.client.connect(SERVER_ADDRESS, self.network.now)

    def open_server(self) -> None:
        self.inbox = SqliteInbox(self.folder / "inbox.sqlite", self.limits)
        self.server = Server(ServerConfig(), identity(ids.Role.SERVER), trust(), cookie_key(identity(ids.Role.SERVER)),
                             self.network.now, wall=wall, stopwatch=lambda: 0.0)
        self.reception = Reception(
            self.server, self.inbox, status_of=lambda id: RecordStatus(self.states.get(id, "stored")),
            registration_of=lambda peer: self.registration,
        )

    def open_robot(self) -> None:
        robot = identity(ids.Role.ROBOT)
        self.spool = Spool(self.folder / "spool.sqlite", robot.public.robot_id)
        self.client = Client(ClientConfig(), robot, trust(), "hub", self.network.now, wall=wall)
        self.sender = Sender(self.client, self.spool, release=self.release)  # type: ignore[arg-type]

    def restart_server(self) -> None:
        self.arrived.clear()  # heard and not committed: lost with the process
        self.inbox.close()
        self.open_server()
        self.server_host.endpoint = self.server

    def restart_robot(self) -> None:
        self.spool.close()
        self.open_robot()
        self.robot_host.endpoint = self.client
        self.client.connect(SERVER_ADDRESS, self.network.now)

    def on_server_event(self, event: Event) -> None:
        if isinstance(event, MessageReceived):
            self.arrived.append(event)

    def on_robot_event(self, event: Event) -> None:
        self.sender.handle(event, self.network.now)

    def turn(self) -> None:
        """What both processes do between two waits."""
        arrived, self.arrived = self.arrived, []
        self.reception.take(arrived, wall=self.network.now, now=self.network.now)
        self.spool.commit(self.network.now)
        self.sender.send(self.network.now)

    def run(self, seconds: float) -> bool:
        """Until the robot has nothing left to do; False if that takes longer than so many simulated seconds."""
        end = self.network.now + seconds
        while self.network.now < end:
            self.turn()
            if self.sender.idle:
                return True
            self.network.at(self.network.now + 0.05, lambda: None)
            self.network.step()
        return False

    def keep(self, records: list[SealedRecord]) -> None:
        for record in records:
            self.spool.append([record], Delivery.RELIABLE, self.network.now)

    def stored(self) -> list[SealedRecord]:
        found: list[SealedRecord] = []
        while leased := self.inbox.lease("test", limit=1000, max_bytes=1 << 24, now=self.network.now, ttl=1e6):
            found += [entry.record for entry in leased]
            self.inbox.done([entry.record.id for entry in leased], self.network.now)
        return found


def records(count: int, stream: int = 1) -> list[SealedRecord]:
    robot = identity(ids.Role.ROBOT).public.robot_id
    return [
        SealedRecord(RecordId(robot, bytes([stream]) * 16, seq), random.Random(seq).randbytes(256 + seq % 3 * 256))
        for seq in range(count)
    ]


@pytest.mark.parametrize("seed", SEEDS)
def test_every_record_is_stored_once_through_a_bad_network(tmp_path: Path, seed: int) -> None:
    world = World(tmp_path, seed, BAD)
    sealed = records(120)
    world.keep(sealed)
    assert world.run(600), f"seed {seed}"
    assert world.stored() == sealed
    assert world.sender.statistics.stored == len(sealed)


@pytest.mark.parametrize("seed", SEEDS)
def test_restarts_of_either_end_lose_and_double_nothing(tmp_path: Path, seed: int) -> None:
    world = World(tmp_path, seed, BAD)
    sealed = records(150)
    world.keep(sealed)
    draw = random.Random(seed)
    for _ in range(4):
        world.run(draw.uniform(0.5, 4))
        draw.choice([world.restart_server, world.restart_robot])()
    assert world.run(600), f"seed {seed}"
    assert world.stored() == sealed


def test_a_full_inbox_makes_the_robot_wait_and_not_lose(tmp_path: Path) -> None:
    world = World(tmp_path, 1, Faults(), limits=InboxLimits(records=30))
    sealed = records(100)
    world.keep(sealed)
    got: list[SealedRecord] = []
    for _ in range(60):
        if world.run(5):
            break
        got += world.stored()
    assert world.sender.statistics.busy > 0
    assert got + world.stored() == sealed


def test_a_disk_error_at_the_server_is_not_acknowledged(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    from rosbridge_eth.errors import StoreError

    world = World(tmp_path, 1, Faults())
    world.keep(records(5))
    healthy = world.inbox.append

    def broken(*_: object) -> None:
        raise StoreError("the disk is full")

    monkeypatch.setattr(world.inbox, "append", broken)
    assert not world.run(5)
    assert world.reception.trouble == "the disk is full"
    assert world.reception.acks[Ack.STORED] == 0
    monkeypatch.setattr(world.inbox, "append", healthy)
    assert world.run(30)
    assert world.stored() == records(5)


def test_a_conflict_is_told_and_does_not_block_what_follows(tmp_path: Path) -> None:
    world = World(tmp_path, 1, Faults())
    sealed = records(10)
    world.inbox.append([SealedRecord(sealed[3].id, b"other bytes" * 20)], world.network.now)
    world.keep(sealed)
    assert world.run(60)
    assert world.sender.statistics.conflicts == 1
    assert len(world.stored()) == 10
    assert [letter.record for letter in world.inbox.dead_letters()] == [sealed[3]]


def test_a_record_beyond_the_bound_is_refused_and_does_not_block(tmp_path: Path) -> None:
    world = World(tmp_path, 1, Faults())
    sealed = records(3)
    sealed[1] = SealedRecord(sealed[1].id, bytes(33 * 1024))
    world.keep(sealed)
    assert world.run(60)
    assert world.sender.statistics.refused == 1
    assert world.stored() == [sealed[0], sealed[2]]


def test_by_choice_records_stay_until_the_chain_has_them(tmp_path: Path) -> None:
    world = World(tmp_path, 1, Faults(), release="confirmed")
    sealed = records(20)
    world.keep(sealed)
    assert not world.run(10)
    assert world.sender.statistics.stored == 20
    assert world.spool.statistics.records == 19  # the first, which opens the stream, is not counted
    world.states = {record.id: "confirmed" for record in sealed[:-1]}
    assert not world.run(10)
    world.states[sealed[-1].id] = "dead"
    assert world.run(10)
    assert world.sender.statistics.confirmed == 19


def test_by_choice_a_record_that_the_server_lost_is_sent_again(tmp_path: Path) -> None:
    world = World(tmp_path, 1, Faults(), release="confirmed")
    sealed = records(5)
    world.keep(sealed)
    assert not world.run(3)
    world.states[sealed[2].id] = "unknown"
    assert not world.run(3)
    assert world.sender.statistics.sent > 5
    world.states = {record.id: "confirmed" for record in sealed}
    assert world.run(10)


def test_the_robot_learns_its_registration_and_the_servers_time(tmp_path: Path) -> None:
    world = World(tmp_path, 1, Faults())
    times: list[float] = []
    world.sender._on_server_time = times.append
    world.keep(records(1))
    assert world.run(20)
    assert world.sender.statistics.registration == world.registration
    assert times == [wall().timestamp()]


@pytest.mark.parametrize("payload", [b"", b"\x09", b"stored", b"{}"])
def test_an_answer_that_is_none_ends_the_robot_with_a_sentence_and_keeps_the_records(
    tmp_path: Path, payload: bytes, monkeypatch: pytest.MonkeyPatch
) -> None:
    world = World(tmp_path, 1, Faults())
    sealed = records(3)
    world.keep(sealed)
    monkeypatch.setattr(Reception, "_acknowledge", lambda self, message, ack: self._reply(message, payload))
    with pytest.raises(NetworkError, match="same version"):
        world.run(20)
    monkeypatch.undo()
    world.restart_robot()
    assert world.run(60)
    assert world.stored() == sealed
