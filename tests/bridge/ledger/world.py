"""A chain in this process, a robot that writes its log, and the submitter between them."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

from rosbridge_eth.chunk import Chunk, Log, robot_id, seal
from rosbridge_eth.inbox.sqlite import SqliteInbox
from rosbridge_eth.ledger import Keyring, Ledger
from rosbridge_eth.ledger.nodes import EmbeddedChain
from rosbridge_eth.ledger.submitter import Settings, Submitter
from smcrypto import sm2

ETH = 10**18
KEYS = Keyring.from_mnemonic("test " * 11 + "junk")
SIGNER = sm2.PrivateKey.from_bytes(bytes(31) + b"\x07")
READER = sm2.PrivateKey.from_bytes(bytes(31) + b"\x09").public_key
LEDGER_ID = bytes(32)


class Pen:
    """A robot: one log, in streams."""

    def __init__(self, name: str = "robot_1", number: int = 1) -> None:
        self.tk, self.account = robot_id(name), KEYS.robot(number)
        self.log = Log(LEDGER_ID, self.tk)
        self.previous, self.stream, self.number, self.streams = bytes(32), bytes(15) + b"\x01", 0, 1
        self.written: list[Chunk] = []

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
        return made

    def chunks(self, count: int, size: int = 0) -> list[Chunk]:
        return [self.chunk(size) for _ in range(count)]


class World:
    """A deployed contract, robots registered and funded, an inbox, a submitter; `now` is the time."""

    def __init__(self, folder: Path, robots: int = 1, where: Any = None, **settings: Any) -> None:
        self.folder, self.now = folder, 1_700_000_000.0
        self.chain = where or EmbeddedChain({KEYS.operator.address: 1000 * ETH})
        self.ledger, self.deployment = Ledger.deploy(self.chain, KEYS.operator)
        self.pens = [Pen(f"robot_{n}", n) for n in range(1, robots + 1)]
        self.settings = Settings(**settings)
        self.inboxes = 0
        for pen in self.pens:
            self.ledger.registration(KEYS.operator, pen.tk, pen.account.address, b"certificates")
            self.ledger.alloc_eth(KEYS.operator, pen.account.address, ETH)
        self.new_inbox()

    @property
    def pen(self) -> Pen:
        return self.pens[0]

    def new_inbox(self, path: Path | None = None) -> SqliteInbox:
        """An empty one, or the one at `path`, and a submitter that begins with it."""
        self.inboxes += 1
        path = path or self.folder / f"inbox-{self.inboxes}"
        self.inbox = SqliteInbox(path, LEDGER_ID, 10**9, 10**8)
        self.restart()
        return self.inbox

    def restart(self) -> None:
        """A new submitter that remembers nothing."""
        accounts = {pen.tk: pen.account for pen in self.pens}
        self.submitter = Submitter(
            self.ledger, self.inbox, lambda: [pen.tk for pen in self.pens], accounts.get, KEYS.operator, self.settings
        )

    def take(self, chunks: Sequence[Chunk], pen: Pen | None = None) -> None:
        self.inbox.append([((pen or self.pen).tk, chunk) for chunk in chunks], self.now)

    def turn(self, seconds: float = 1.0) -> float:
        self.now += seconds
        return self.submitter.turn(self.now)

    def run(self, turns: int = 30) -> None:
        """Turns until nothing waits."""
        for _ in range(turns):
            self.turn()
            if self.submitter.trouble is None and all(self.on_chain(pen) == pen.written for pen in self.pens):
                self.turn()
                return
        raise AssertionError(f"{self.submitter.trouble} {self.submitter.counts} {self.inbox.state(self.pen.tk)}")

    def on_chain(self, pen: Pen | None = None) -> list[Chunk]:
        tk = (pen or self.pen).tk
        events = list(self.ledger.data_events(tk, 0, self.ledger.block_number()))
        assert [event.first for event in events] == [
            sum(len(e.chunks) for e in events[:i]) for i in range(len(events))
        ]
        return [Chunk.parse(chunk) for event in events for chunk in event.chunks]
