"""A chain in this process, a robot that writes its log, and the submitter between them."""

from __future__ import annotations

import sqlite3
from collections.abc import Callable, Sequence
from contextlib import closing
from pathlib import Path
from typing import Any

from bridge.ledger.model_chain import ModelChain
from rosbridge_eth.ledger import Keyring
from rosbridge_eth.log.chunk import Chunk, Log, robot_id, seal
from rosbridge_eth.log.sqlite import SqliteStore
from rosbridge_eth.log.store import NOWHERE, Offer, Outcome, State, place_of
from rosbridge_eth.server.submitter import Settings, Submitter
from smcrypto import sm2

ETH = 10**18
KEYS = Keyring.from_mnemonic("test " * 11 + "junk")
SIGNER = sm2.PrivateKey.from_bytes(bytes(31) + b"\x07")
READER = sm2.PrivateKey.from_bytes(bytes(31) + b"\x09").public_key
LEDGER_ID = bytes(32)


class Pen:
    """A robot: one log, in streams. disk: the chunks that it was not told to be confirmed."""

    def __init__(self, name: str = "robot_1", number: int = 1) -> None:
        self.tk, self.account = robot_id(name), KEYS.account(number)
        self.log = Log(LEDGER_ID, self.tk)
        self.previous, self.stream, self.number, self.streams = bytes(32), bytes(15) + b"\x01", 0, 1
        self.written: list[Chunk] = []
        self.disk: list[Chunk] = []

    @property
    def digests(self) -> list[bytes]:
        return [chunk.header.digest for chunk in self.written]

    @property
    def last(self) -> bytes:
        """The place of the newest chunk."""
        return place_of(self.written[-1].header) if self.written else NOWHERE

    def restart(self, *, knows_previous: bool = True) -> None:
        self.streams += 1
        self.stream, self.number = self.streams.to_bytes(16, "big"), 0
        self.previous = self.previous if knows_previous else bytes(32)

    def chunk(self, size: int = 0) -> Chunk:
        """The next one; of about `size` bytes, 203 at least."""
        made = seal(
            self.log, SIGNER, [b"x" * max(1, size - 400)] if size else [], stream=self.stream, number=self.number,
            previous=self.previous, sealed_ms=1_700_000_000_000 + len(self.written), readers=[READER], compress=False,
        )  # fmt: skip
        self.previous, self.number = made.header.digest, self.number + 1
        self.written.append(made)
        self.disk.append(made)
        return made

    def chunks(self, count: int, size: int = 0) -> list[Chunk]:
        return [self.chunk(size) for _ in range(count)]

    def offers(self, chunks: Sequence[Chunk], head: bytes) -> list[Offer]:
        """These, behind the head with this digest."""
        before = [head, *(chunk.header.digest for chunk in chunks)]
        return [Offer(self.tk, *each) for each in zip(chunks, before, strict=False)]

    def told(self, state: State) -> list[Offer]:
        """What it sends when the server says this: what follows the head."""
        self.disk = [chunk for chunk in self.disk if place_of(chunk.header) > state.confirmed]
        return self.offers([chunk for chunk in self.disk if place_of(chunk.header) > state.head], state.digest)


def copy_file(source: Path, target: Path) -> Path:
    """SQLite's online backup, which is also its restore where somebody uses the target."""
    with closing(sqlite3.connect(source)) as one, closing(sqlite3.connect(target)) as other:
        one.backup(other)
    return target


class World:
    """A chain with the contract, robots registered and funded, a store, a submitter; `now` is the time."""

    def __init__(self, folder: Path, robots: int = 1, *, wei: int = ETH, ledger: Any = None, **settings: Any) -> None:
        """ledger: one with the contract; otherwise a model chain (model_chain.py)."""
        self.folder, self.now = folder, 1_700_000_000.0
        self.pens = [Pen(f"robot_{n}", n) for n in range(1, robots + 1)]
        self.settings, self.stores = Settings(**settings), 0
        self.robots: Callable[[], Sequence[bytes]] = lambda: [pen.tk for pen in self.pens]
        self.pays = True
        self.chain = ModelChain() if ledger is None else None
        self.ledger = ledger or self.chain
        for pen in self.pens:
            if self.chain is not None:
                self.chain.register(pen.tk, pen.account.address, wei)
            else:
                self.ledger.registration(KEYS.operator, pen.tk, pen.account.address, b"certificates")
                self.ledger.alloc_eth(KEYS.operator, pen.account.address, wei)
        if self.chain is not None:
            self.chain.state.balances[KEYS.operator.address] = 1000 * ETH
            self.chain.mine()
        self.new_store()

    @property
    def pen(self) -> Pen:
        return self.pens[0]

    @property
    def model(self) -> ModelChain:
        assert self.chain is not None
        return self.chain

    @property
    def in_flight(self) -> int:
        """Transactions that are sent and in no block yet."""
        return sum(len(account.flights) for account in self.submitter._known.values())

    def new_store(self, path: Path | None = None) -> None:
        """An empty one, or the one at this path, and a submitter that begins with it."""
        self.stores += 1
        self.path = path or self.folder / f"store-{self.stores}"
        self.store = SqliteStore(self.path, LEDGER_ID, 10**9, 10**8)
        self.restart()

    def copy(self) -> Path:
        """The store as it is now."""
        self.stores += 1
        return copy_file(self.path, self.folder / f"copy-{self.stores}")

    def put_back(self, copy: Path) -> None:
        """A copy in place of the store, under those who use it."""
        copy_file(copy, self.path)

    def lose(self) -> None:
        """The store's file is deleted under those who use it."""
        for suffix in ("", "-wal", "-shm"):
            Path(f"{self.path}{suffix}").unlink(missing_ok=True)

    def restart(self) -> Submitter:
        """A new submitter, which remembers nothing."""
        accounts = {pen.tk: pen.account for pen in self.pens}
        self.submitter = Submitter(
            self.ledger, self.store, self.robots, accounts.get, KEYS.operator if self.pays else None, self.settings,
            others=lambda: accounts.keys() - set(self.robots()),
        )  # fmt: skip
        return self.submitter

    def take(self, chunks: Sequence[Chunk], pen: Pen | None = None) -> list[Outcome]:
        return self.store.append((pen or self.pen).offers(chunks, self.state(pen).digest), self.now)

    def talk(self, pen: Pen | None = None) -> list[Outcome]:
        """The robot is told the state, and sends what follows."""
        pen = pen or self.pen
        [state] = self.store.states([pen.tk])
        return self.store.append(pen.told(state), self.now)

    def turn(self, seconds: float = 1.0, *, mine: int = 0) -> float:
        self.now += seconds
        pause = self.submitter.turn(self.now)
        if self.chain is not None and mine:
            self.chain.mine(mine)
        return pause

    def run(self, turns: int = 60) -> None:
        """Turns, with robots' words and a block after each, until all chunks are on the chain and confirmed."""
        for _ in range(turns):
            self.turn()
            for pen in self.pens:
                assert Outcome.DIFFERENT not in self.talk(pen)
            if self.chain is not None:
                self.chain.mine()
            if all(self.on_chain(pen) == pen.digests and self.confirmed(pen) == pen.last for pen in self.pens):
                return
        states = self.store.states([pen.tk for pen in self.pens])
        raise AssertionError(f"{self.submitter.trouble} {self.submitter.counts} {states}")

    def state(self, pen: Pen | None = None) -> State:
        [state] = self.store.states([(pen or self.pen).tk])
        return state

    def confirmed(self, pen: Pen | None = None) -> bytes:
        return self.state(pen).confirmed

    def hold(self, pen: Pen | None = None) -> str:
        return self.state(pen).hold

    def on_chain(self, pen: Pen | None = None) -> list[bytes]:
        """The digests of the robot's chunks, in the order of the chain."""
        tk = (pen or self.pen).tk
        [standing] = self.ledger.standings([tk])
        events = list(self.ledger.newest_data(tk, standing.data_block))[::-1]
        chunks = [chunk for event in events for chunk in event.chunks]
        assert len(chunks) == standing.chunks
        return [Chunk.parse(chunk).header.digest for chunk in chunks]
