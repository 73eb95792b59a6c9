"""A robot is replaced or revoked while the server still has chunks of it; what a reader of the chain finds afterwards.

The real administration, store, submitter and contract on the embedded chain, and robots that sign with the keys that
they made; tests/bridge/home/test_administration.py has the steps one by one.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path

import pytest

from bridge.home.world import READER_PASSPHRASE, TK, World
from rosbridge_eth.capture import stream_line
from rosbridge_eth.config import load_server_config
from rosbridge_eth.config.home import RobotHome
from rosbridge_eth.errors import StoreError
from rosbridge_eth.identity import Identity, Role, Trust, load_identity
from rosbridge_eth.log.chunk import Chunk, Log
from rosbridge_eth.log.store import Offer, Outcome
from rosbridge_eth.log.writer import LogWriter
from rosbridge_eth.operator.bundle import join, read_bundle
from rosbridge_eth.operator.registry import Registry
from rosbridge_eth.reading import Kind, Verdict, read_robot
from rosbridge_eth.server.shard import open_submitter

SERVED = 3.0  # seconds of the server's, for what it has to be written and confirmed


@dataclass
class Town(World):
    """A home whose server runs: a submitter that takes a turn whenever somebody waits."""

    serving: bool = True

    def __post_init__(self) -> None:
        super().__post_init__()
        self.submitter = open_submitter(
            load_server_config(self.home.config), self.ledger, self.open_store(), Registry(self.home.registry),
            self.keys,
        )  # fmt: skip
        self.on_pause: Callable[[], None] = lambda: None

    def pause(self, seconds: float) -> None:
        self.now += seconds
        self.on_pause()
        if self.serving:
            self.submitter.turn(self.now)

    def serve(self, seconds: float = SERVED) -> None:
        self.serving, end = True, self.now + seconds
        while self.now < end:
            self.pause(0.5)

    def robot(self, **options: bool) -> Robot:
        """Register `robot_1`, perhaps once more, with keys of its own."""
        made = self.register(**options)
        place = RobotHome(self.path / f"robot-{self.number}")
        join(place, read_bundle(made.bundle.read_bytes()))
        return Robot(self, load_identity(place.identity, b"robot's")[0], made.account, made.buried)

    def read(self) -> tuple[str, Verdict]:
        """The words on the chain, in their order."""
        reader, roots = load_identity(self.reader.path, READER_PASSPHRASE)
        reading = read_robot(
            [self.ledger], "robot_1", trust=Trust(roots), reader=reader.encryption_key, now=time.time()
        )  # fmt: skip
        list(reading.records())
        verdict = reading.verdict()
        said = [found.detail.removeprefix("/t: ") for found in verdict.findings if found.kind is Kind.LOST]
        return " ".join(said), verdict

    def lost(self) -> list[tuple[str, bytes]]:
        """Dead letters: why, and which chunk."""
        return [(letter.why, letter.chunk) for letter in self.store.dead()]


@dataclass
class Robot:
    """One that was registered; `says` seals a chunk with a line and hands it to the server."""

    town: Town
    identity: Identity
    account: str
    buried: int
    writer: LogWriter | None = None

    def says(self, *lines: str) -> list[Chunk]:
        reader, _ = load_identity(self.town.reader.path, READER_PASSPHRASE)
        self.writer = self.writer or LogWriter(
            Log(self.town.ledger.ledger, TK), self.identity.signing_key, [reader.encryption_key.public_key],
            previous=bytes(32), stream_line=stream_line("sim", "test"), now=0.0,
        )  # fmt: skip
        chunks = []
        for line in lines:
            self.writer.add(b'{"lost":1,"topic":"/t","why":"%s"}' % line.encode(), 0.0)
            chunks += self.writer.closed(10.0, int(time.time() * 1000))
        assert len(chunks) == len(lines)
        [state] = self.town.store.states([TK])
        offers = [Offer(TK, chunk, b"" if chunk.header.number else state.digest) for chunk in chunks]
        outcomes = self.town.store.append(offers, self.town.now)
        assert set(outcomes) == {Outcome.STORED}
        return chunks


@pytest.fixture
def town(tmp_path: Path) -> Town:
    return Town(tmp_path)


def test_what_the_old_robot_handed_over_is_written_under_its_own_certificate_before_it_is_replaced(town: Town) -> None:
    old = town.robot()
    old.says("a", "b")
    late = iter(["c"])

    def until_its_session_is_closed() -> None:
        for word in late:  # within a second, and not before
            old.says(word)

    town.on_pause = until_its_session_is_closed
    new = town.robot(replace=True)
    assert new.account != old.account and new.buried == 0
    new.says("d")
    town.serve()
    words, verdict = town.read()
    assert words == "a b c d"
    assert {account for account, _ in town.written()} == {old.account, new.account}
    assert verdict.sound
    assert [(governing.first, governing.revoked) for governing in verdict.certificates] == [(0, False), (3, False)]
    assert town.lost() == []


def test_without_a_server_the_robot_is_not_replaced_and_nothing_is_lost_when_it_is_back(town: Town) -> None:
    old = town.robot()
    town.serving = False
    chunks = old.says("a", "b", "c")
    with pytest.raises(StoreError, match="3 chunks that the old 'robot_1' handed to the server"):
        town.register(replace=True)
    [standing] = town.ledger.standings([TK])
    assert standing.account == old.account
    with Registry(town.home.registry) as registry:
        assert registry.find(Role.ROBOT, "robot_1") is None  # it takes nothing more, whatever becomes of this
    town.serving = True
    new = town.robot(replace=True)
    assert new.buried == 0
    assert [count for account, count in town.written() if account == old.account] == [len(chunks)]
    assert town.read()[1].sound


def test_what_a_compromised_robot_handed_over_becomes_dead_letters_and_what_was_written_stays(town: Town) -> None:
    old = town.robot()
    old.says("a")
    town.serve()
    town.serving = False
    never = old.says("b", "c")
    new = town.robot(replace=True, compromised=True)
    assert new.buried == 2
    assert {chunk for _, chunk in town.lost()} == {chunk.encoded for chunk in never}
    assert {why for why, _ in town.lost()} == {"robot_1 was replaced"}
    new.says("d")
    town.serve()
    words, verdict = town.read()
    assert words == "a d" and verdict.sound and verdict.chunks == 2
    assert [governing.first for governing in verdict.certificates] == [0, 1]
    assert {finding.kind for finding in verdict.findings} >= {Kind.RESTARTED}  # the old one never said goodbye


def test_a_robot_revoked_on_the_chain_is_replaced_without_waiting(town: Town) -> None:
    old = town.robot()
    town.revoke()
    before = town.now
    assert town.robot(replace=True).account != old.account
    assert town.now == before


def test_what_a_revoked_robot_handed_over_is_written_before_its_right_ends(town: Town) -> None:
    old = town.robot()
    old.says("a", "b", "c")
    ended = town.revoke()
    assert ended.block is not None and ended.buried == 0
    assert town.written() == [(old.account, 3)]
    _, verdict = town.read()
    assert verdict.sound and verdict.certificates[-1].revoked
    assert [governing.first for governing in verdict.certificates] == [0, 3]


@pytest.mark.parametrize("compromised", [False, True])
def test_what_is_not_written_in_time_becomes_dead_letters_and_is_never_written(town: Town, compromised: bool) -> None:
    robot = town.robot()
    town.serving = compromised  # a compromised one gets no time at all, though the server runs
    town.on_pause = (lambda: None) if not compromised else lambda: setattr(town, "serving", False)
    robot.says("a", "b")
    began = town.now
    ended = town.revoke(compromised=compromised)
    assert ended.buried == 2
    assert (town.now - began < 5) == compromised
    assert {why for why, _ in town.lost()} == {"robot_1 was revoked"}
    town.on_pause = lambda: None
    town.serve()
    assert town.written() == []
    [standing] = town.ledger.standings([TK])
    assert standing.revoked and standing.chunks == 0
    assert town.store.waiting(TK).chunks == 0


def test_the_new_robot_of_a_name_is_not_held_up_by_the_old_ones_dead_letters(town: Town) -> None:
    old = town.robot()
    town.serving = False
    old.says("a", "b")
    assert town.revoke().buried == 2
    new = town.robot(replace=True)
    new.says("c")
    town.serve()
    assert town.written() == [(new.account, 1)]
    assert town.store.states([TK])[0].hold == ""
