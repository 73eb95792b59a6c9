"""Images through a bad network into the archive, in simulated time: what a robot is told is stored is in both.

The real writer, spool, sender, channel, reception, inbox and folder; network and clock are simulated, and the threads
that put bodies do it at once, or when the test says so.
"""

from __future__ import annotations

import random
import tracemalloc
from collections.abc import Callable
from concurrent.futures import Future
from pathlib import Path
from typing import Any

import pytest

from bridge.channel.simulation import Faults
from bridge.test_delivery import PLACE, STREAM_LINE, World, identity
from rosbridge_eth import identity as ids
from rosbridge_eth import protocol, server
from rosbridge_eth.archive import Folder
from rosbridge_eth.chunk import (
    MAX_ARCHIVED_LINE,
    Chunk,
    content_key,
    drop,
    open_lines,
    seal,
    signed_as,
)  # fmt: skip
from rosbridge_eth.errors import StoreError
from rosbridge_eth.inbox import Outcome
from rosbridge_eth.server import HELD, NO_ARCHIVE
from smcrypto import sm3

BAD = Faults(loss=0.2, duplication=0.05, corruption=0.02, delay=0.02, jitter=0.03)
MIB = 1 << 20


class Threads:
    """What puts bodies: at once, or when `work` is called."""

    def __init__(self, at_once: bool = True) -> None:
        self.at_once = at_once
        self.waiting: list[tuple[Future[Any], Callable[[], Any]]] = []

    def submit(self, call: Callable[[], Any]) -> Future[Any]:
        future: Future[Any] = Future()
        self.waiting.append((future, call))
        if self.at_once:
            self.work()
        return future

    def work(self) -> None:
        for future, call in self.waiting:
            try:
                future.set_result(call())
            except Exception as error:
                future.set_exception(error)
        self.waiting = []

    def shutdown(self, **how: bool) -> None: ...


class Archiving(World):
    """A world whose server has an archive."""

    at_once, archive_away = True, False

    def open_server(self) -> None:
        super().open_server()
        (self.folder / "bodies").mkdir(exist_ok=True)
        self.bodies = Folder(self.folder / "bodies")
        self.reception._archive = self.bodies
        self.reception._threads = self.threads = Threads(self.at_once)  # type: ignore[assignment]

    def image(self, size: int, archived: bool = True) -> None:
        """A line of noise, sealed and spooled at once."""
        line = b'{"n":%d,"%s"}' % (len(self.lines), self.random.randbytes(size // 2).hex().encode())
        self.lines.append(line)
        self.writer.add(line, self.network.now, archived=archived)
        for chunk in self.writer.closed(self.network.now + 1.0, 0):
            self.spool.append(chunk)

    def whole(self) -> list[Chunk]:
        """The inbox's chunks, with their bodies from the archive."""
        found = []
        for chunk in self.stored():
            header = chunk.header
            if header.archived and signed_as(PLACE, self.key.public_key, chunk) == "chunk":
                assert chunk.bare
                body = self.bodies.get(header.body_digest, header.body_length)
                assert body is not None, "what the inbox has is in the archive"
                found.append(Chunk.parse(chunk.encoded + body))
            else:
                found.append(chunk)
        return found

    @property
    def key(self) -> Any:
        return identity(ids.Role.ROBOT).signing_key

    def read(self) -> list[bytes]:
        reader = identity(ids.Role.ROBOT).encryption_key
        chunks = [chunk for chunk in self.whole() if not chunk.bare]
        lines = [line for one in chunks for line in open_lines(PLACE, one, content_key(one.header, reader))]
        return [line for line in lines if line != STREAM_LINE]

    def seal(self, size: int, **more: Any) -> Chunk:
        given = {"stream": b"s" * 16, "number": 0, "previous": bytes(32), "sealed_ms": 0, "archived": True}
        readers = [identity(ids.Role.ROBOT).encryption_key.public_key]
        return seal(PLACE, self.key, [random.Random(size).randbytes(size).replace(b"\n", b"")], readers=readers,
                    **given | more)  # fmt: skip

    def offer(self, chunk: bytes) -> None:
        """Hand a chunk over as a robot may that is not ours: whatever it is, in messages of any kind."""
        if len(chunk) <= 60_000:
            self.client.send(protocol.encode(protocol.Offer(chunk)))
            return
        for at in range(0, len(chunk), 60_000):
            self.part(chunk, at)

    def part(self, chunk: bytes, at: int, size: int = 60_000) -> None:
        message = protocol.encode(protocol.Part(at, len(chunk), chunk[at : at + size]))
        while not self.client.writable(len(message)):
            self.network.at(self.network.now + 0.05, lambda: None)
            self.network.step()
        self.client.send(message)


@pytest.mark.parametrize("seed", [0, 1])
def test_images_and_records_arrive_once_and_in_order_through_a_bad_network(tmp_path: Path, seed: int) -> None:
    world = Archiving(tmp_path, seed, BAD)
    for n in range(8):
        world.image(120_000 if n % 4 else 1_000, archived=n % 4 != 0)
        world.run(0.3, until=lambda: False)
    assert world.run(300)
    assert world.read() == world.lines
    world.assert_linked()


def test_restarts_of_either_end_lose_and_double_no_image(tmp_path: Path) -> None:
    world = Archiving(tmp_path, 3, BAD)
    for n in range(6):
        world.image(120_000 if n % 3 else 1_000, archived=n % 3 != 0)
        world.run(world.random.uniform(0, 2), until=lambda: False)
        (world.restart_server if n % 2 else world.restart_robot)()
    assert world.run(300)
    assert world.read() == world.lines
    world.assert_linked()


def test_the_largest_chunk_passes(tmp_path: Path) -> None:
    world = Archiving(tmp_path, 4, Faults(delay=0.001))
    world.image(MAX_ARCHIVED_LINE - 40)
    assert world.run(300)
    assert world.read() == world.lines


def test_no_body_is_in_memory_more_than_twice(tmp_path: Path) -> None:
    world = Archiving(tmp_path, 4, Faults(delay=0.001))
    assert world.run(60, until=lambda: world.sender.statistics.connected)
    world.image(8 * MIB)
    length = world.spool.following(world.writer.stream, 0, 0)[0].header.body_length
    assert length > 3.9 * MIB  # hexadecimal digits, packed again
    tracemalloc.start()
    try:
        assert world.run(300)
        _, peak = tracemalloc.get_traced_memory()
    finally:
        tracemalloc.stop()
    assert world.read() == world.lines
    # Robot and server are one process here: two copies each, at most, and what the channel has on its way.
    assert peak < 4 * length + 3 * MIB


def test_a_chunk_goes_on_in_the_next_session_where_it_was_cut_off(tmp_path: Path) -> None:
    world = Archiving(tmp_path, 5, Faults(delay=0.02))
    world.image(3 * MIB)
    arriving = world.reception._arriving
    assert world.run(60, until=lambda: any(len(each.data) > MIB for each in arriving.values()))
    [before] = [len(each.data) for each in arriving.values()]
    sent: list[protocol.Up] = []
    take = world.reception._take

    def watched(session: Any, payload: bytes, now: float) -> None:
        sent.append(protocol.decode_up(payload))
        take(session, payload, now)

    world.reception._take = watched  # type: ignore[method-assign]
    world.restart_robot()
    assert world.run(120)
    assert world.read() == world.lines
    assert min(part.at for part in sent if isinstance(part, protocol.Part)) >= before


def test_a_robots_chunks_wait_for_the_body_in_front_of_them_and_others_do_not(tmp_path: Path) -> None:
    class Slow(Archiving):
        at_once = False

    world = Slow(tmp_path, 6, Faults())
    world.capture(3)
    world.image(100_000)
    world.capture(3)
    assert world.run(60, until=lambda: len(world.threads.waiting) == 1)
    world.run(5, until=lambda: False)
    assert [chunk.header.archived for chunk in world.stored()] == [False]
    world.threads.work()
    assert world.run(5)
    assert [chunk.header.archived for chunk in world.whole()] == [False, True, False]
    assert world.read() == world.lines


@pytest.mark.parametrize("trouble", ["store away", "full"])
def test_nothing_is_taken_behind_a_chunk_that_was_not(tmp_path: Path, trouble: str) -> None:
    world = Archiving(tmp_path, 6, Faults())
    world.threads.at_once = False
    for _ in range(2):
        world.image(100_000)
    assert world.run(60, until=lambda: len(world.threads.waiting) == 2)
    append, behind = world.inbox.append, world.threads.waiting.pop()

    def once(chunks: Any, now: float) -> list[Outcome]:
        if not chunks:
            return append(chunks, now)
        world.inbox.append = append  # type: ignore[method-assign]
        if trouble == "full":
            return [Outcome.FULL] * len(chunks)
        raise StoreError("away")

    world.inbox.append = once  # type: ignore[method-assign]
    world.threads.work()
    world.run(1, until=lambda: world.inbox.append == append)
    world.threads.waiting.append(behind)
    world.threads.at_once = True
    world.threads.work()
    assert world.run(60)
    assert world.read() == world.lines
    world.assert_linked()


def test_an_archive_that_does_not_answer_is_one_that_is_away(tmp_path: Path) -> None:
    world = Archiving(tmp_path, 6, Faults())
    world.threads.at_once = False
    world.image(100_000)
    world.run(2 * server.HANGS, until=lambda: False)
    assert world.reception.archive_trouble.why == "it does not answer"
    world.image(100_000)
    assert world.run(10, until=lambda: world.sender.statistics.held is not None)


def test_an_archive_that_is_away_makes_robots_hold_until_it_is_back_and_nothing_is_lost(
    tmp_path: Path, caplog: pytest.LogCaptureFixture
) -> None:
    world = Archiving(tmp_path, 7, Faults())
    world.capture(2)
    assert world.run(30)
    (tmp_path / "bodies").rename(tmp_path / "away")
    for _ in range(4):
        world.image(150_000)
        world.capture(2)
        world.run(HELD, until=lambda: False)
    assert world.sender.statistics.held == "the server's archive is away"
    assert len(world.stored()) == 1 and world.sender.idle is False
    assert world.reception.counts["not archived"] >= 1
    (tmp_path / "away").rename(tmp_path / "bodies")
    assert world.run(60)
    assert world.read() == world.lines
    world.assert_linked()
    assert caplog.text.count("is not there; mount it") == caplog.text.count("the archive: well again") == 1


@pytest.mark.parametrize("size", [1_000, 200_000], ids=["in one message", "in parts"])
def test_a_server_without_an_archive_says_so_and_keeps_nothing(
    tmp_path: Path, caplog: pytest.LogCaptureFixture, size: int
) -> None:
    world = Archiving(tmp_path, 8, Faults())
    world.reception._archive = None
    world.image(size)
    world.capture(1)
    assert world.run(30, until=lambda: world.sender.statistics.held is not None)
    assert world.sender.statistics.held == NO_ARCHIVE
    world.run(2 * HELD + 1, until=lambda: False)
    assert caplog.text.count(NO_ARCHIVE) == 1  # not at every attempt
    assert [chunk.header.archived for chunk in world.stored()] == [False]  # the stream's line
    world.reception._archive = world.bodies  # as after SIGHUP
    assert world.run(30)
    assert world.read() == world.lines


def test_an_image_that_a_full_disk_dropped_needs_no_archive(tmp_path: Path) -> None:
    world = Archiving(tmp_path, 9, Faults())
    world.reception._archive = None
    chunk = world.seal(100_000)
    world.spool.append(drop(PLACE, world.key, chunk))
    assert world.run(30)
    assert [one.bare for one in world.stored()] == [True]


# Robots that are not ours


def refused(world: Archiving) -> str | None:
    """What the robot is told of what it handed over; None while nothing is said."""
    why: list[str] = []
    take = world.sender._take

    def watch(message: Any, now: float) -> None:
        if isinstance(message, protocol.Refused | protocol.Hold):
            why.append(message.why)
        take(message, now)

    world.sender._take = watch  # type: ignore[method-assign]
    world.run(10, until=lambda: bool(why))
    return why[0] if why else None


@pytest.fixture
def world(tmp_path: Path) -> Archiving:
    made = Archiving(tmp_path, 10, Faults())
    assert made.run(30, until=lambda: made.sender.statistics.connected)
    return made


@pytest.mark.parametrize("size", [1_000, 300_000])
def test_a_body_that_is_another_is_refused_and_not_archived(world: Archiving, size: int) -> None:
    chunk = world.seal(size)
    world.offer(chunk.encoded[:-1] + bytes([chunk.encoded[-1] ^ 1]))
    assert "not the one that its header names" in str(refused(world))
    assert world.stored() == [] and not any((world.folder / "bodies").iterdir())


def test_a_header_for_the_archive_without_its_body_is_refused(world: Archiving) -> None:
    world.offer(world.seal(1_000).on_chain.encoded)
    assert "is not with it" in str(refused(world))
    assert world.stored() == []


def test_a_chunk_that_somebody_else_signed_is_refused_at_its_first_part(world: Archiving) -> None:
    chunk = world.seal(3 * MIB)
    spoiled = bytearray(chunk.encoded)
    spoiled[60] ^= 1  # in `previous`
    world.part(bytes(spoiled), 0)
    assert "does not hold" in str(refused(world)) and not world.reception._arriving


def ends(world: Archiving) -> bool:
    """Whether the session is closed."""
    sessions = world.sender.statistics.sessions
    return world.run(30, until=lambda: world.sender.statistics.sessions > sessions)


@pytest.mark.parametrize("claimed", [-64, 64])
def test_parts_of_another_length_than_the_header_names_end_the_session(world: Archiving, claimed: int) -> None:
    chunk = world.seal(300_000).encoded
    data = chunk if claimed < 0 else chunk + bytes(claimed)
    world.client.send(protocol.encode(protocol.Part(0, len(chunk) + claimed, data[:60_000])))
    assert ends(world) and not world.reception._arriving


def test_parts_of_a_chunk_for_the_chain_and_of_none_are_refused(world: Archiving) -> None:
    whole = world.seal(30_000, archived=False).encoded
    world.part(whole, 0, 20_000)
    assert "does not hold" in str(refused(world)) and not world.reception._arriving
    world.part(b"\x02" * 30_000, 0, 20_000)
    assert ends(world) and not world.reception._arriving


def test_a_part_that_follows_nothing_makes_the_robot_ask(world: Archiving) -> None:
    world.part(world.seal(300_000).encoded, 60_000)
    assert refused(world) == "what came of this chunk is not kept any more"
    assert not world.reception._arriving


def test_what_arrives_is_bounded_for_one_robot_and_for_all(world: Archiving, monkeypatch: pytest.MonkeyPatch) -> None:
    world.threads.at_once = False
    chunks = [world.seal(2 * MIB, number=n).encoded for n in range(3)]
    monkeypatch.setattr(server, "ROOM_OF_ONE", 5 * MIB)
    world.offer(chunks[0])
    world.offer(chunks[1])
    assert world.run(60, until=lambda: len(world.threads.waiting) == 2)
    world.part(chunks[2], 0)
    assert refused(world) == "as much as may be of this robot is on its way into the archive"
    world.threads.work()
    monkeypatch.setattr(server, "ROOM", 3 * MIB)
    now = world.network.now
    others = world.reception._arriving
    others[b"a" * 32] = server.Arriving(bytearray(), 2 * MIB, now)
    session = next(iter(world.reception.sessions.values()))
    assert "of all robots" in str(world.reception._no_room(session, 2 * MIB, now + 1))
    assert list(others) == [b"a" * 32]  # it goes on
    assert world.reception._no_room(session, 2 * MIB, now + 60) is None
    assert not others  # nothing of it came for long: there is room again


def test_many_small_chunks_are_bounded_by_what_they_take_and_not_by_their_bodies(
    world: Archiving, monkeypatch: pytest.MonkeyPatch
) -> None:
    world.threads.at_once = False
    monkeypatch.setattr(server, "ROOM_OF_ONE", 10 * server.COST)
    for number in range(20):
        world.offer(world.seal(100, number=number).encoded)
    assert refused(world) == "as much as may be of this robot is on its way into the archive"
    assert len(world.threads.waiting) == 9


def test_a_chunk_whose_number_was_taken_leaves_no_body(world: Archiving) -> None:
    for size in (100_000, 50_000):
        world.offer(world.seal(size).encoded)
        world.run(5, until=lambda: False)
    assert world.reception.counts["different"] == 1
    assert len(list((world.folder / "bodies").glob("*/*"))) == 1


def test_a_chunk_that_is_known_is_answered_again(world: Archiving) -> None:
    chunk = world.seal(100_000)
    for _ in range(2):
        world.offer(chunk.encoded)
        world.run(5, until=lambda: False)
    assert len(world.stored()) == 1 and world.reception.counts[Outcome.KNOWN.value] == 1
    assert world.bodies.get(sm3.digest(chunk.body), 10**6) == chunk.body


def test_a_crash_between_archive_and_inbox_leaves_a_body_and_no_promise(tmp_path: Path) -> None:
    world = Archiving(tmp_path, 11, Faults())
    append, world.inbox.append = world.inbox.append, lambda *_: (_ for _ in ()).throw(StoreError("away"))  # type: ignore[method-assign]
    world.image(100_000)
    assert world.run(30, until=lambda: world.sender.statistics.held is not None)
    world.inbox.append = append  # type: ignore[method-assign]
    assert world.stored() == []
    world.restart_server()
    assert world.run(60)
    assert world.read() == world.lines

