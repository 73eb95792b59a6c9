"""The rule of all hops under dice: robots' disks, the server's store and the chain, each lost or put back at any time.

The robot's spool, its sender and the store are the real ones; the channel, the submitter and the chain are what a page
says of them: messages that arrive or do not, look and send what follows, the contract's "only what follows the tail".
RULE_SEEDS=A:B runs these seeds instead of the few of every run.
"""

from __future__ import annotations

import os
import random
import shutil
from collections import Counter
from collections.abc import Iterator, Sequence
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from web3 import Web3

from bridge.chunks import chunk, dropped
from bridge.log.backends import BACKENDS, PLENTY, Backend
from rosbridge_eth.log.chunk import Chunk, Log
from rosbridge_eth.log.hop import FORKED, ServerState, decode_offer
from rosbridge_eth.log.store import NO_HASH, NOWHERE, Offer, Outcome, place_of
from rosbridge_eth.robot.sender import Sender
from rosbridge_eth.robot.spool import Spool

TK = b"r" * 32
CONFIRMATIONS = 3
SEEDS = range(*map(int, os.environ["RULE_SEEDS"].split(":"))) if "RULE_SEEDS" in os.environ else range(2)
STEPS = 300


class Chain:
    """Blocks of chunks. It may turn back, never below what was taken for confirmed."""

    def __init__(self) -> None:
        self.blocks: list[list[bytes]] = [[]]
        self.final = 1

    def chunks(self, confirmations: int = 0) -> list[bytes]:
        return [one for block in self.blocks[: len(self.blocks) - confirmations] for one in block]

    def set_data(self, first: int, tail: bytes, chunks: Sequence[bytes]) -> None:
        """The contract's rule."""
        there = self.chunks()
        fits = (first, tail) == (len(there), Web3.keccak(there[-1]) if there else NO_HASH)
        self.blocks.append([*chunks] if fits else [])

    def turn_back(self, depth: int) -> None:
        self.blocks = self.blocks[: max(self.final, len(self.blocks) - depth)]


class Robot:
    """Seals chunks, keeps them in its spool, and sends them by its sender into `sent`."""

    def __init__(self, folder: Path, clock: int, kept: int, nonce: int) -> None:
        folder.mkdir(exist_ok=True)
        self.folder, self._nonce = folder, nonce
        self.spool = Spool(folder / "spool.sqlite", Log(b"l" * 32, TK), max_bytes=kept, drop=dropped)
        self.writer = SimpleNamespace(stream=b"", newest=self.spool.newest[:16], new_stream=lambda: None)
        self.sent: list[bytes] = []
        self.room = 0
        client: Any = SimpleNamespace(
            room=lambda: PLENTY * (len(self.sent) < self.room), send=self.sent.append
        )  # fmt: skip
        self.sender = Sender(client, self.spool, self.writer)
        self._clock, self._number = clock, 0

    def seal(self, clock: int) -> Chunk:
        if not self.writer.stream:
            begun = max(clock, int.from_bytes(self.writer.newest[:8], "big") + 1)
            self.writer.stream = self.writer.newest = begun.to_bytes(8, "big") + self._nonce.to_bytes(8, "big")
        made = chunk(self._number, self.writer.stream, size=400, previous=self.spool.last_digest, variant=self._nonce)
        self.spool.append(made)
        self._number += 1
        return made

    def close(self) -> None:
        self.spool.close()


class World:
    """One robot's log on its way. dice: what happens. kept: bound on the robot's spool."""

    def __init__(self, backend: Backend, folder: Path, seed: int, kept: int = PLENTY) -> None:
        self.dice, self.backend, self.folder, self.kept = random.Random(seed), backend, folder, kept
        self.store, self.looking = backend.open(), backend.open()  # the reception's and the submitter's
        self.chain, self.clock, self.again, self.nonce = Chain(), 1_000_000, 0, 0
        self.pending: list[tuple[int, bytes, list[bytes]]] = []
        self.log: list[bytes] = []
        """Digests of all chunks, in their order."""
        self.acknowledged: set[bytes] = set()
        self.looked, self.copy, self.counts = True, None, Counter[str]()
        self.given_up: set[bytes] = set()
        """What a full spool had no room for, and the server had said it has."""
        self.robot = self.start(folder / "robot")

    def start(self, folder: Path) -> Robot:
        self.nonce += 1
        return Robot(folder, self.clock, self.kept, self.nonce)

    def close(self) -> None:
        self.robot.close()
        self.store.close()
        self.looking.close()

    def seal(self, robot: Robot) -> None:
        before = {row.digest for row in robot.spool.rows(NOWHERE, PLENTY)}
        self.log.append(robot.seal(self.clock + self.dice.choice((0, 0, -5000))).header.digest)
        self.given_up |= before - {row.digest for row in robot.spool.rows(NOWHERE, PLENTY)}

    def submit(self) -> None:
        """Look and compare; then what is to be sent is on its way."""
        there, confirmed = self.chain.chunks(), self.chain.chunks(CONFIRMATIONS - 1)
        hash = Web3.keccak(there[-1]) if there else NO_HASH
        after = self.looking.find(TK, hash) if there else None
        [state] = self.looking.states([TK])
        if after is None and state.base == hash:
            after = NOWHERE
        if after is None:
            self.looking.follow(TK, hash, Chunk.parse(there[-1]).header if there else None)
            self.counts["followed"] += 1
            after = NOWHERE
        if confirmed:
            self.chain.final = max(self.chain.final, len(self.chain.blocks) - CONFIRMATIONS + 1)
            self.looking.set_state(TK, confirmed=place_of(Chunk.parse(confirmed[-1]).header))
        [state] = self.looking.states([TK])
        rows = [row.place for row in self.looking.rows(TK, after, 5) if row.place <= state.head]
        if rows:
            self.pending.append((len(there), hash, self.looking.chunks(TK, rows)))
        self.looked = True

    def talk(self, robot: Robot, lose: bool = True) -> None:
        """The robot is told how its log stands and sends what follows; either may be lost on its way."""
        if not self.looked or (lose and self.dice.random() < 0.2):
            return
        [state] = self.store.states([TK])
        said = ServerState(state.head, state.digest, state.confirmed, again=self.again)
        known = {row.digest for row in robot.spool.rows(NOWHERE, PLENTY) if row.place <= state.head}
        robot.sender.take(said.encode(), 0.0)
        robot.room = self.dice.randrange(1, 6)
        robot.sender.send(0.0)
        if robot.sender.held != FORKED:
            self.acknowledged |= known
        offers = [Offer(TK, Chunk.parse(data), after) for data, after in map(decode_offer, robot.sent)]
        robot.sent.clear()
        if lose and offers and self.dice.random() < 0.1:
            self.again += 1  # the channel ended, and what was on its way with it
            offers = offers[1:]
        outcomes = self.store.append(offers, float(self.clock)) if offers else []
        self.counts.update(outcome.value for outcome in outcomes)
        self.again = (self.again + any(one not in (Outcome.STORED, Outcome.KNOWN) for one in outcomes)) % 256

    def mine(self) -> None:
        if self.pending and self.dice.random() < 0.8:
            self.dice.shuffle(self.pending)
            self.chain.set_data(*self.pending.pop())
        else:
            self.chain.blocks.append([])

    def restart(self) -> None:
        self.robot.close()
        self.robot = self.start(self.robot.folder)

    def step(self) -> None:
        self.clock += 1000
        match self.dice.random():
            case x if x < 0.30:
                self.seal(self.robot)
            case x if x < 0.55:
                self.talk(self.robot)
            case x if x < 0.75:
                self.submit()
            case x if x < 0.87:
                self.mine()
            case x if x < 0.90:
                self.chain.turn_back(self.dice.randrange(1, CONFIRMATIONS))
            case x if x < 0.91:
                self.looking.forget(TK, self.clock - 200_000.0, 3000)
            case x if x < 0.93:
                self.restart()
            case x if x < 0.95:
                self.store.states([TK])  # makes it, if it was lost
                self.copy = self.backend.copy()
            case x if x < 0.97 and self.copy is not None:
                self.lose(self.copy)
            case x if x < 0.98:
                self.lose(None)

    def lose(self, copy: Any) -> None:
        """The store, which is in use, is put back as it was, or emptied; robots are told once the chain was looked at,
        or at once."""
        self.backend.put_back(copy)
        self.looked = self.dice.random() < 0.5
        self.counts["lost" if copy is None else "put back"] += 1

    def settle(self, *robots: Robot) -> list[bytes]:
        """Everything works from now on: what the chain has in the end, by digest."""
        for _ in range(600):
            self.submit()
            for robot in robots or [self.robot]:
                self.talk(robot, lose=False)
            for _ in range(CONFIRMATIONS):
                self.chain.set_data(*self.pending.pop()) if self.pending else self.chain.blocks.append([])
            self.pending.clear()
            if all(robot.spool.statistics().chunks == 0 for robot in robots or [self.robot]):
                break
        print(self.counts)
        return [Chunk.parse(one).header.digest for one in self.chain.chunks()]


def in_order(there: Sequence[bytes], log: Sequence[bytes]) -> bool:
    """Whether these are, each once, of this log and in its order."""
    found = set(there)
    return len(found) == len(there) and list(there) == [digest for digest in log if digest in found]


@pytest.fixture(params=["sqlite", "redis"])
def backend(request, tmp_path) -> Backend:
    (tmp_path / "server").mkdir()
    return BACKENDS[request.param](tmp_path / "server", request.getfixturevalue)


@pytest.fixture(params=SEEDS)
def world(request, backend, tmp_path) -> Iterator[World]:
    made = World(backend, tmp_path, request.param)
    yield made
    made.close()


def test_everything_that_was_sealed_is_on_the_chain_once_and_in_order(world):
    """The store lost and put back while it runs, reorganisations, restarts, clocks that go back, lost answers."""
    for _ in range(STEPS):
        world.step()
    assert world.settle() == world.log


@pytest.mark.parametrize("seed", SEEDS)
def test_a_full_spool_gives_up_old_ones_and_says_so_and_nothing_else_is_lost(backend, tmp_path, seed):
    world = World(backend, tmp_path, seed, kept=4000)
    for _ in range(STEPS):
        world.step()
    there = world.settle()
    assert in_order(there, world.log)
    missing = set(world.log) - set(there)
    print(f"{len(missing)} of {len(world.log)} missing, {len(world.given_up)} given up")
    assert missing <= world.given_up
    world.close()


def test_of_a_robot_that_was_copied_one_goes_on_and_the_other_is_held(world):
    """Whichever came first: the chain has one log, and both are told."""
    for _ in range(world.dice.randrange(20, STEPS)):
        world.step()
    if world.dice.random() < 0.5:
        world.settle()  # all of it confirmed: nothing of the past waits in either copy
    world.robot.close()
    shutil.copytree(world.robot.folder, world.folder / "copy")
    common = len(world.log)
    world.robot = world.start(world.robot.folder)
    copy = world.start(world.folder / "copy")
    logs: dict[Robot, list[bytes]] = {world.robot: [], copy: []}
    for _ in range(STEPS // 3):
        world.clock += 1000
        which = world.dice.choice([*logs])
        if world.dice.random() < 0.3:
            world.seal(which)
            logs[which].append(world.log.pop())
        else:
            world.talk(which)
        if world.dice.random() < 0.2:
            world.submit()
            world.mine()
    there = world.settle(*logs)
    first, second = (sum(digest in there for digest in log) for log in logs.values())
    assert not (first and second), "the two are interleaved"
    assert in_order(there, world.log[:common] + logs[world.robot] + logs[copy])
    held = [robot.sender.held for robot in logs if robot.spool.statistics().unstored]
    assert held.count(FORKED) == len(held) >= 1
    copy.close()


def test_a_disk_that_is_put_back_from_an_old_copy_is_told_and_what_was_before_stays_whole(world):
    for _ in range(world.dice.randrange(20, STEPS)):
        world.step()
    world.robot.close()
    shutil.copytree(world.robot.folder, world.folder / "copy")
    world.robot = world.start(world.robot.folder)
    for _ in range(3):
        world.seal(world.robot)
    whole = world.settle()
    assert whole == world.log
    world.robot.close()
    world.robot = old = world.start(world.folder / "copy")
    for _ in range(10):
        world.seal(old)
        world.talk(old)
        world.submit()
        world.mine()
    assert world.settle() == whole
    assert old.sender.held == FORKED
