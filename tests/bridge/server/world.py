"""A home on an embedded chain, with the inbox that workers would fill and the submission that a server runs."""

from __future__ import annotations

import time
from collections.abc import Callable
from dataclasses import dataclass, field
from datetime import UTC, datetime

from rosbridge_eth.config import load_server_config
from rosbridge_eth.home import OperatorHome
from rosbridge_eth.identity import Role
from rosbridge_eth.ledger import Contract, fetch
from rosbridge_eth.ledger.accounts import Keyring
from rosbridge_eth.ledger.embedded import EmbeddedChain
from rosbridge_eth.records import RecordId, SealedRecord, robot_id
from rosbridge_eth.registry import Registry
from rosbridge_eth.server.administration import (
    Registered,
    Revoked,
    deploy_contract,
    init_home,
    load_ca,
    register_robot,
    revoke,
)
from rosbridge_eth.server.assembly import bound_contract, open_inbox, open_journal, open_submission
from rosbridge_eth.server.submission import Submission
from rosbridge_eth.store import Outcome

PASSPHRASE, NOW = b"operator's", datetime.now(UTC)
TK = robot_id("robot_1")


@dataclass
class World:
    """settings: TOML that the server's configuration gets besides what `init` writes."""

    home: OperatorHome
    settings: str = ""
    now: float = field(default_factory=time.time)

    def __post_init__(self) -> None:
        init_home(self.home, PASSPHRASE, listen="127.0.0.1:0", public=None, chain_url="embedded", server="server",
                  now=NOW)
        self.keys = Keyring.load(self.home.accounts, PASSPHRASE)
        self.chain = EmbeddedChain(fund={self.keys.operator.address: 10**21})
        deployment = deploy_contract(self.home, self.chain, self.keys)
        self.contract: Contract = bound_contract(self.chain, deployment)
        self.home.config.write_text(f"{self.home.config.read_text()}\n{self.settings}")
        self.inbox = open_inbox(load_server_config(self.home.config), self.home)
        self.registry = Registry(self.home.registry)
        self.submission = self.next_submission()

    def next_submission(self) -> Submission:
        config = load_server_config(self.home.config)
        return open_submission(
            config=config, contract=self.contract, journal=open_journal(self.home, self.home.deployment()),
            inbox=open_inbox(config, self.home), registry=self.registry, keys=self.keys,
        )

    def register(self, pause: Callable[[float], None] = lambda seconds: None, *, replace: bool = False) -> Registered:
        return self.register_as("robot_1", pause, replace=replace)

    def register_as(
        self, name: str, pause: Callable[[float], None] = lambda seconds: None, *, replace: bool = False
    ) -> Registered:
        return register_robot(
            self.home, name, ca=load_ca(self.home, PASSPHRASE), keys=self.keys, chain=self.chain,
            password=b"robot's", now=NOW, replace=replace, clock=lambda: self.now, pause=pause,
        )

    def revoke(self, pause: Callable[[float], None]) -> Revoked:
        return revoke(self.home, Role.ROBOT, "robot_1", keys=self.keys, chain=self.chain, now=NOW,
                      clock=lambda: self.now, pause=pause)

    def hand_over(self, first: int, count: int) -> list[Outcome]:
        seqs = range(first, first + count)
        records = [SealedRecord(RecordId(TK, bytes(16), seq), bytes([seq % 256]) * 300) for seq in seqs]
        return self.inbox.append(records, self.now)

    def wait(self, seconds: float) -> None:
        self.now += seconds

    def serve(self, seconds: float) -> None:
        self.now += seconds
        self.submission.turn(self.now)

    def written(self) -> dict[int, str]:
        return {found.record.id.seq: found.sender for found in fetch(self.chain, self.contract, TK).records}
