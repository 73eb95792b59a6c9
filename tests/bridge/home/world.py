"""A home on an embedded chain, with the store that the server would fill and what a submitter would write of it."""

from __future__ import annotations

import atexit
import shutil
import tempfile
from dataclasses import dataclass, field
from datetime import UTC, datetime
from functools import cache
from pathlib import Path
from typing import Any

from rosbridge_eth.config.home import OperatorHome, ReaderHome, RobotHome
from rosbridge_eth.identity import Role, load_ca
from rosbridge_eth.ledger import Keyring, Ledger
from rosbridge_eth.ledger.nodes import EmbeddedChain
from rosbridge_eth.log.chunk import Chunk, Log, robot_id, seal
from rosbridge_eth.log.opening import open_store
from rosbridge_eth.log.store import NOWHERE, Offer, Store
from rosbridge_eth.operator import enrolment as admin
from rosbridge_eth.operator.bundle import Request, ask_to_join
from smcrypto import sm2

PASSPHRASE, READER_PASSPHRASE, NOW = b"operator's", b"reader's", datetime(2026, 6, 1, 12, tzinfo=UTC)
TK = robot_id("robot_1")
KEY = sm2.PrivateKey.generate()


@cache
def first_day() -> tuple[Path, Keyring, EmbeddedChain, Any]:
    """A home and its reader just after `deploy`, made once: keys and passphrases take seconds."""
    path = Path(tempfile.mkdtemp(prefix="rosbridge-eth-home-"))
    atexit.register(shutil.rmtree, path)
    home = OperatorHome(path / "operator")
    keys = admin.init_home(
        home, PASSPHRASE, reader=ReaderHome(path / "reader"), reader_passphrase=READER_PASSPHRASE, now=NOW,
        listen="127.0.0.1:7410",
    )
    chain = EmbeddedChain({keys.operator.address: 10**21})
    admin.deploy_contract(home, chain, keys)
    return path, keys, chain, chain.ethereum_tester.take_snapshot()


@dataclass
class World:
    """served: whether a submitter is there, which writes a chunk a second."""

    path: Path
    served: bool = False
    now: float = 1_780_000_000.0
    events: list[str] = field(default_factory=list)

    def __post_init__(self) -> None:
        self.home, self.reader = OperatorHome(self.path / "operator"), ReaderHome(self.path / "reader")
        made, self.keys, self.chain, snapshot = first_day()
        shutil.copytree(made, self.path, dirs_exist_ok=True)
        self.chain.ethereum_tester.revert_to_snapshot(snapshot)
        self.ledger = Ledger.connect(self.chain, self.home.deployment())
        self.store = self.open_store()
        self.number = self.streams = 0

    def open_store(self) -> Store:
        return open_store(
            "sqlite", file=self.home.store(0), ledger=self.ledger.ledger, max_bytes=2**28, max_bytes_per_robot=2**26
        )

    def request(self, name: str = "robot_1") -> Request:
        self.number += 1
        return ask_to_join(RobotHome(self.path / f"robot-{self.number}"), name, b"robot's")

    def register(self, name: str = "robot_1", **options: Any) -> admin.Registered:
        options = {"request": None if "password" in options else self.request(name)} | options
        return admin.register_robot(
            self.home, name, ca=load_ca(self.home.ca, PASSPHRASE, NOW), keys=self.keys, ledger=self.ledger,
            inbox=self.open_store, now=NOW, pause=self.pause, **options,
        )

    def revoke(self, name: str = "robot_1", role: Role = Role.ROBOT, **options: Any) -> admin.Revoked:
        return admin.revoke(
            self.home, role, name, keys=self.keys, ledger=self.ledger, inbox=self.open_store, now=NOW,
            pause=self.pause, **options,
        )

    def pause(self, seconds: float) -> None:
        self.now += seconds
        self.events.append(f"paused {seconds}")
        if self.served:
            self.write()

    def hand_over(self, count: int) -> list[Chunk]:
        """The robot's next chunks of a new stream reach the store."""
        self.streams += 1
        log, previous, stream = Log(self.ledger.ledger, TK), bytes(32), self.streams.to_bytes(16, "big")
        chunks, [state] = [], self.store.states([TK])
        for number in range(count):
            chunk = seal(
                log, KEY, [b"{}"], stream=stream, number=number, previous=previous, sealed_ms=1,
                readers=[KEY.public_key],
            )
            previous = chunk.header.digest
            chunks.append(chunk)
        offers = [Offer(TK, chunk, b"" if chunk.header.number else state.digest) for chunk in chunks]
        self.store.append(offers, self.now)
        return chunks

    def write(self, limit: int = 1, *, confirm: bool = True) -> None:
        """What the submitter does: the next chunks go onto the chain from the robot's account, and are confirmed."""
        [standing] = self.ledger.standings([TK])
        tail = self.store.find(TK, standing.tail)
        rows = self.store.rows(TK, tail or NOWHERE, limit)
        if rows:
            number = next(n for n in range(1, 100) if self.keys.account(n).address == standing.account)
            chunks = self.store.chunks(TK, [row.place for row in rows])
            self.ledger.set_data(self.keys.account(number), TK, chunks)
            if confirm:
                self.store.set_state(TK, confirmed=rows[-1].place)

    def written(self) -> list[tuple[str, int]]:
        """(account, chunks) of each batch on the chain."""
        found = self.ledger.data_events(TK, 0, self.ledger.block_number())
        return [(event.account, len(event.chunks)) for event in found]
