"""One shard of the server: a UDP port, a store, a submitter, a port for /metrics, in one process; and its parts.

Shards share nothing but the chain (and a Redis, whose keys are one robot's each). A robot belongs to one of them
(config.home.shard_of), and a shard works for its own robots only. Reception runs in the calling thread; the submitter
in a second one, with a store and a connection to the node of its own.
"""

from __future__ import annotations

import logging
import threading
import time
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from contextlib import closing
from dataclasses import dataclass
from socket import socket
from typing import TYPE_CHECKING

from rosbridge_eth.channel import Mode, Server, ServerConfig, cookie_key
from rosbridge_eth.channel.udp import UdpLoop, server_socket
from rosbridge_eth.config import ServerConfig as Settings
from rosbridge_eth.config.home import OperatorHome, shard_of
from rosbridge_eth.errors import StoreError
from rosbridge_eth.identity import Identity
from rosbridge_eth.ledger import Keyring, Ledger
from rosbridge_eth.ledger.contract import WEI_PER_ETH
from rosbridge_eth.log import opening
from rosbridge_eth.log.store import Store
from rosbridge_eth.operator.enrolment import server_trust
from rosbridge_eth.operator.registry import Enrolment, Registry
from rosbridge_eth.server import metrics
from rosbridge_eth.server.reception import Reception, Worker
from rosbridge_eth.server.submitter import Settings as SubmitterSettings
from rosbridge_eth.server.submitter import Submitter
from rosbridge_eth.terminal import Trouble

if TYPE_CHECKING:
    from eth_account.signers.local import LocalAccount

log = logging.getLogger(__name__)

STORE_AGAIN = 1.0  # seconds before the submitter asks a store again that did not answer


@dataclass(frozen=True, slots=True)
class Secrets:
    """What the server needs and no file holds in clear."""

    identity: Identity
    keys: Keyring


def name_of(shard: int) -> str:
    """What a shard is called in logs, figures and `status`."""
    return f"shard-{shard}"


def open_store(config: Settings, home: OperatorHome, shard: int = 0, *, read_only: bool = False) -> Store:
    """The store of a shard: a file of its own, or the Redis of all. Raises StoreError."""
    return opening.open_store(
        config.store.url, file=home.store(shard), ledger=home.deployment().ledger, max_bytes=config.store.max_size,
        max_bytes_per_robot=config.store.share, read_only=read_only,
    )


def robots_of(shard: int, config: Settings, registry: Registry) -> dict[bytes, Enrolment]:
    """The robots that belong to a shard, by Tk. Raises StoreError."""
    return {tk: robot for tk, robot in registry.robots().items() if shard_of(tk, config.shards) == shard}


def open_reception(
    config: Settings, identity: Identity, home: OperatorHome, registry: Registry, store: Store, shard: int = 0,
) -> Reception:  # fmt: skip
    """What answers the robots of a shard."""
    channel = ServerConfig(modes=tuple(Mode[mode.upper()] for mode in config.channel))
    server = Server(channel, identity, server_trust(home, registry), cookie_key(identity), time.monotonic())

    def elsewhere(tk: bytes) -> str:
        own = shard_of(tk, config.shards)
        return "" if own == shard else str(config.addresses()[own])

    return Reception(server, store, home.deployment().ledger, registry.in_force, elsewhere)


def open_submitter(
    config: Settings, ledger: Ledger, store: Store, registry: Registry, keys: Keyring, shard: int = 0
) -> Submitter:
    """The submitter of a shard. The first one alone pays: two would send with the same nonces of one account."""

    def account(tk: bytes) -> LocalAccount | None:
        found = registry.robots().get(tk)
        return None if found is None else keys.account(found.number)

    return Submitter(
        ledger, store, lambda: robots_of(shard, config, registry), account, keys.operator if shard == 0 else None,
        SubmitterSettings(
            confirmations=config.chain.confirmations, max_fee=int(config.chain.max_fee_gwei * 10**9),
            low_water=int(config.funds.below * WEI_PER_ETH), top_up=int(config.funds.by * WEI_PER_ETH),
            gas_per_day=config.funds.gas_per_day,
        ),
        lambda: registry.in_force().keys() - robots_of(shard, config, registry).keys(),
    )  # fmt: skip


def submit(
    submitter: Submitter, stop: threading.Event, show: Callable[[], None], clock: Callable[[], float] = time.monotonic
) -> None:
    """The submitter's turns until `stop`. show: called once a second. A registry that was exchanged ends it."""
    subjects = {"trouble": "the node", "unconfirmed": "confirmation", "funds": "the treasury"}
    troubles = {name: Trouble(log, subject) for name, subject in subjects.items()}
    store, due, beats = Trouble(log, "the store"), 0.0, metrics.Beats(1.0, clock)
    while not stop.is_set():
        try:
            if clock() >= due:
                due = submitter.turn(time.time()) + clock()
                for name, trouble in troubles.items():
                    trouble.now(getattr(submitter, name))
            if beats.due():
                show()
            store.now(None)
        except StoreError as error:
            store.now(str(error))
            due = clock() + STORE_AGAIN
        stop.wait(max(0.0, min(due - clock(), STORE_AGAIN)))


@dataclass(frozen=True, slots=True)
class Shard:
    """Both halves of a shard. Whatever ends one of them ends the other, and is raised by `run`."""

    worker: Worker
    submitter: Submitter

    def run(
        self, stopped: Callable[[], bool], *, on_turn: Callable[[], None] = lambda: None,
        on_submit: Callable[[], None] = lambda: None,
    ) -> None:  # fmt: skip
        """Until `stopped()`. on_turn: called after every step of the reception; on_submit: once a second."""
        stop = threading.Event()
        with ThreadPoolExecutor(1, "submitter") as threads:
            submitting = threads.submit(submit, self.submitter, stop, on_submit)
            submitting.add_done_callback(lambda _: self.worker.loop.wake())
            try:
                self.worker.run(lambda: stopped() or submitting.done(), on_turn=on_turn)
            finally:
                stop.set()
        submitting.result()


def open_shard(
    config: Settings, home: OperatorHome, secrets: Secrets, ledger: Ledger, sock: socket, shard: int = 0
) -> Shard:
    """Both halves; each has a registry and a store of its own, since they run in two threads."""
    reception = open_reception(
        config, secrets.identity, home, Registry(home.registry), open_store(config, home, shard), shard
    )
    store, registry = open_store(config, home, shard), Registry(home.registry)
    submitter = open_submitter(config, ledger, store, registry, secrets.keys, shard)
    return Shard(Worker(reception, lambda handle: UdpLoop(reception.server, sock, handle)), submitter)


def run_shard(
    shard: int, config: Settings, home: OperatorHome, secrets: Secrets, stopped: Callable[[], bool]
) -> None:
    """A shard, as a process of its own. Raises BridgeError where a part is missing, or is exchanged."""
    name, file = name_of(shard), metrics.file_of(home.path, name_of(shard))
    registry, ledger = Registry(home.registry), Ledger.connect(config.chain.url, home.deployment())
    made = open_shard(config, home, secrets, ledger, server_socket(config.listen.next(shard)), shard)
    beats = metrics.Beats()

    def show() -> None:
        if beats.due():
            metrics.show(metrics.of_worker(name, made.worker, time.time()))
            metrics.save(file)

    def show_submitter() -> None:
        robots = robots_of(shard, config, registry)
        metrics.show(metrics.of_submitter(name, made.submitter, robots, home.path, time.time()))

    with closing(ledger), metrics.served(config.monitor and config.monitor.next(shard)):
        made.run(stopped, on_turn=show, on_submit=show_submitter)
    file.unlink(missing_ok=True)
