"""The server's processes: workers that share one UDP port, one submitter, and the monitor's HTTP where it is wanted.

The parent opens the sockets and every secret once, checks chain and store before the port opens, and then only
watches: what ends is started again. Children are forked, so no key travels through a pipe or an argument. They share
nothing but the inbox.
"""

from __future__ import annotations

import logging
import multiprocessing
import os
import signal
import threading
import time
from collections import Counter
from collections.abc import Callable, Collection
from contextlib import closing, suppress
from dataclasses import dataclass
from functools import partial
from multiprocessing.process import BaseProcess
from socket import AF_UNIX, SOCK_CLOEXEC, SOCK_DGRAM
from socket import socket as Socket
from types import FrameType
from typing import TYPE_CHECKING

from rosbridge_eth.channel import Mode, Server, ServerConfig, cookie_key
from rosbridge_eth.channel.udp import UdpLoop, server_sockets
from rosbridge_eth.config import ServerConfig as Settings
from rosbridge_eth.config import load_server_config, reread
from rosbridge_eth.config.home import Deployment, OperatorHome
from rosbridge_eth.config.values import Address
from rosbridge_eth.errors import BridgeError, ExitCode, ProcessError, StoreError
from rosbridge_eth.identity import Identity
from rosbridge_eth.ledger import Keyring, Ledger
from rosbridge_eth.ledger.contract import WEI_PER_ETH
from rosbridge_eth.log import opening
from rosbridge_eth.log.store import Store
from rosbridge_eth.logs import Trouble
from rosbridge_eth.operator.enrolment import server_trust
from rosbridge_eth.operator.registry import Registry
from rosbridge_eth.server import metrics
from rosbridge_eth.server.reception import Reception, Worker
from rosbridge_eth.server.submitter import Settings as SubmitterSettings
from rosbridge_eth.server.submitter import Submitter

if TYPE_CHECKING:
    from eth_account.signers.local import LocalAccount

log = logging.getLogger(__name__)

WATCH = 0.2  # seconds between looks at the children
GRACE = 10.0  # seconds for children to end in good order
FIRST_PAUSE, LONGEST_PAUSE = 1.0, 30.0  # seconds before a process that ended is started again
SHORT_LIFE = 5.0  # seconds; a process that lived longer began its work
GIVE_UP_AFTER = 6  # short lives in a row: half a minute of trying
PATIENT = frozenset({ExitCode.CHAIN, ExitCode.STORE})
"""Ends for which one waits as long as it takes: the node, the disk or Redis is away, and people mend that."""

TAKEN_UP = ("channel", "chain", "store", "funds")
"""Keys of server.toml that SIGHUP reloads: those that the parent, its sockets and certificates do not rest on."""

SUBMITTER, MONITOR = "submitter", "monitor"
_FORK = multiprocessing.get_context("fork")


@dataclass(frozen=True, slots=True)
class Secrets:
    """What the server needs and no file holds in clear."""

    identity: Identity
    keys: Keyring


def worker_name(number: int) -> str:
    return f"worker-{number}"


def notify(state: str) -> None:
    """Tell the service manager, where there is one (sd_notify(3)): READY=1, WATCHDOG=1, STOPPING=1."""
    address = os.environ.get("NOTIFY_SOCKET", "")
    if not address:
        return
    with Socket(AF_UNIX, SOCK_DGRAM | SOCK_CLOEXEC) as sock, suppress(OSError):  # it may be gone
        # A leading @ is the abstract namespace, written as a zero byte.
        sock.sendto(state.encode(), "\0" + address[1:] if address.startswith("@") else address)


def open_store(config: Settings, home: OperatorHome, *, read_only: bool = False) -> Store:
    """The store that the configuration names. Raises StoreError."""
    return opening.open_store(
        config.store.url, home=home.path, ledger=home.deployment().ledger, max_bytes=config.store.max_size,
        max_bytes_per_robot=config.store.share, read_only=read_only,
    )


def open_reception(
    number: int, config: Settings, identity: Identity, home: OperatorHome, registry: Registry, store: Store,
    deployment: Deployment,
) -> Reception:  # fmt: skip
    """The door of one worker."""
    channel = ServerConfig(modes=tuple(Mode[mode.upper()] for mode in config.channel), worker=number)
    server = Server(channel, identity, server_trust(home, registry), cookie_key(identity), time.monotonic())
    return Reception(server, store, deployment.ledger, registry.in_force)


def open_submitter(config: Settings, ledger: Ledger, store: Store, registry: Registry, keys: Keyring) -> Submitter:
    """The submitter for all robots of a registry."""

    def account(tk: bytes) -> LocalAccount | None:
        found = registry.robots().get(tk)
        return None if found is None else keys.robot(found.number)

    return Submitter(
        ledger, store, lambda: registry.robots().keys(), account, keys.operator,
        SubmitterSettings(
            confirmations=config.chain.confirmations, max_fee=int(config.chain.max_fee_gwei * 10**9),
            low_water=int(config.funds.below * WEI_PER_ETH), top_up=int(config.funds.by * WEI_PER_ETH),
            gas_per_day=config.funds.gas_per_day,
        ),
    )  # fmt: skip


class Supervisor:
    """Runs a server until `stop`, SIGTERM, SIGINT, or its terminal is gone; SIGHUP: server.toml is read again."""

    def __init__(self, home: OperatorHome, config: Settings, secrets: Secrets, workers: int | None = None) -> None:
        """workers: how many, where that is not to be as in the configuration."""
        self._workers = workers or config.workers
        self._home, self._config, self._secrets = home, config, secrets
        self._deployment = home.deployment()
        self._children: dict[str, BaseProcess] = {}
        self._started_at: dict[str, float] = {}
        self._starts: Counter[str] = Counter()
        self._due: dict[str, float] = {}  # processes that ended, and when they are started again
        self._short_lives: Counter[str] = Counter()
        self._stop, self._again = threading.Event(), threading.Event()
        self._at_terminal = os.isatty(0)
        self._pid = os.getpid()

    def stop(self) -> None:
        self._stop.set()

    def run(
        self, on_ready: Callable[[Address], None] = lambda address: None, on_look: Callable[[], None] = lambda: None
    ) -> None:  # fmt: skip
        """Check, open the port, start the processes, watch them.

        Raises BridgeError before the port is open, and ProcessError where a process does not come up however often
        it is started. on_ready: called with the address that is listened on; on_look: after every look at them.
        """
        self._check(self._config)
        sockets = server_sockets(self._config.listen, self._workers)  # a second server gets no further
        with metrics.shared(self._home.path):
            tasks: dict[str, Callable[[], None]] = {SUBMITTER: self._submit}
            for number, sock in enumerate(sockets):
                tasks[worker_name(number)] = partial(self._work, number, sock)
            if self._config.monitor is not None:  # a port that is taken is told now, before a robot is answered
                tasks[MONITOR] = partial(self._watch, metrics.Web(self._config.monitor, list(tasks)))
            for signaled in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
                signal.signal(signaled, self._on_signal)
            try:
                for name, task in tasks.items():
                    self._start(name, task)
                on_ready(Address(*sockets[0].getsockname()[:2]))
                notify("READY=1")
                while not self._stop.wait(WATCH):
                    if self._again.is_set():
                        self._again.clear()
                        self._read_again(tasks)
                    self._look(tasks, time.monotonic())
                    on_look()
                    notify("WATCHDOG=1")
            finally:
                notify("STOPPING=1")
                self._end(self._children)
                for sock in sockets:
                    sock.close()

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        if number == signal.SIGHUP and os.isatty(0) == self._at_terminal:
            self._again.set()
        else:  # also of a terminal that is gone
            self.stop()

    def _read_again(self, tasks: dict[str, Callable[[], None]]) -> None:
        """Replace workers and submitter by such that go by what changed in server.toml; the port stays open, and
        robots make new sessions. What cannot be used is told, and nothing changes."""
        try:
            config, said = reread(self._config, load_server_config(self._home.config), TAKEN_UP)
            self._check(config)
        except BridgeError as error:
            log.error("nothing is reloaded: %s", error)
            return
        self._config = config
        log.warning("%s", said)
        names = [name for name in self._children if name != MONITOR]
        self._end(names)
        for name in names:
            self._due.pop(name, None)
            self._start(name, tasks[name])

    def _check(self, config: Settings) -> None:
        """The chain is the right one and the store keeps what it is given: only then may a robot be answered."""
        Registry(self._home.registry).close()
        with closing(Ledger.connect(config.chain.url, self._deployment)) as ledger:
            ledger.check()
        with closing(open_store(config, self._home)) as store:
            store.check()

    def _start(self, name: str, task: Callable[[], None]) -> None:
        self._starts[name] += 1
        if name in self._children:
            metrics.forget_process(self._children[name].pid)
        process = _FORK.Process(target=_child, args=(name, self._starts[name], task), name=name, daemon=False)
        process.start()
        self._children[name], self._started_at[name] = process, time.monotonic()
        log.info("%s started, process %d", name, process.pid)

    def _look(self, tasks: dict[str, Callable[[], None]], now: float) -> None:
        for name, process in list(self._children.items()):
            if process.is_alive() or name in self._due:
                continue
            lived = now - self._started_at[name]
            pause = self._pause(name, process.exitcode, lived)
            log.error("%s ended with exit code %s after %.0f s; it is started again in %.0f s",
                      name, process.exitcode, lived, pause)
            self._due[name] = now + pause
        for name, due in list(self._due.items()):
            if now >= due:
                del self._due[name]
                self._start(name, tasks[name])

    def _pause(self, name: str, code: int | None, lived: float) -> float:
        """Seconds until it is started again. Raises ProcessError where that has no prospect."""
        short = self._short_lives[name] = self._short_lives[name] + 1 if lived < SHORT_LIFE else 0
        if name != MONITOR and short >= GIVE_UP_AFTER and code not in PATIENT:
            raise ProcessError(
                f"{name} ends with exit code {code} as soon as it is started; the log says why."
                " Robots keep their records until the server is back"
            )
        return float(min(LONGEST_PAUSE, FIRST_PAUSE * 2 ** max(0, short - 1)))

    def _end(self, names: Collection[str]) -> None:
        for name in names:
            self._children[name].terminate()
        deadline = time.monotonic() + GRACE
        for name in names:
            process = self._children[name]
            process.join(max(0.0, deadline - time.monotonic()))
            if process.is_alive():
                log.error("%s does not end; it is killed", name)
                process.kill()
                process.join()

    # What runs in the children; each opens its own connections to store and chain.

    def _work(self, number: int, sock: Socket) -> None:
        reception = open_reception(
            number, self._config, self._secrets.identity, self._home, Registry(self._home.registry),
            open_store(self._config, self._home), self._deployment,
        )
        worker, beats = Worker(reception, lambda handle: UdpLoop(reception.server, sock, handle)), Beats()

        def show() -> None:
            if beats.due():
                metrics.show_worker(worker_name(number), worker, time.time())

        worker.run(_terminated(self._pid), on_turn=show)

    def _submit(self) -> None:
        asked, ledger = _terminated(self._pid), Ledger.connect(self._config.chain.url, self._deployment)
        registry, inbox = Registry(self._home.registry), open_store(self._config, self._home)
        submitter = open_submitter(self._config, ledger, inbox, registry, self._secrets.keys)
        subjects = {"trouble": "the node", "unconfirmed": "confirmation", "funds": "the treasury"}
        troubles = {name: Trouble(log, subject) for name, subject in subjects.items()}
        store, beats, due = Trouble(log, "the store"), Beats(), 0.0
        while not asked():
            robots = registry.robots()  # StoreError where it was exchanged: the next process opens it anew
            try:
                if time.monotonic() >= due:
                    due = submitter.turn(time.time()) + time.monotonic()
                    for name, trouble in troubles.items():
                        trouble.now(getattr(submitter, name))
                if beats.due():
                    metrics.show_submitter(submitter, inbox, robots, self._home.path, time.time())
                store.now(None)
            except StoreError as error:
                store.now(str(error))
                due = time.monotonic() + FIRST_PAUSE
            time.sleep(max(0.0, min(due - time.monotonic(), FIRST_PAUSE)))

    def _watch(self, web: metrics.Web) -> None:
        web.start()
        log.info("/metrics, /healthz and /readyz at http://%s", web.address)
        stopped = _terminated(self._pid)
        while not stopped():
            time.sleep(WATCH)
        web.stop()


class Beats:
    """Says once a second that the figures are due."""

    def __init__(self) -> None:
        self._next = float("-inf")

    def due(self) -> bool:
        now = time.monotonic()
        if now < self._next:
            return False
        self._next = now + 1.0
        return True


def _terminated(parent: int) -> Callable[[], bool]:
    """True once this process was asked to end, or `parent` is no more: nobody would end it then."""
    asked = threading.Event()
    signal.signal(signal.SIGTERM, lambda number, frame: asked.set())
    return lambda: asked.is_set() or os.getppid() != parent


def _child(name: str, starts: int, task: Callable[[], None]) -> None:
    signal.signal(signal.SIGTERM, signal.SIG_DFL)  # until the task has its own; the parent's stops the parent
    for number in (signal.SIGINT, signal.SIGHUP):  # they reach the whole group; the parent ends the children
        signal.signal(number, signal.SIG_IGN)
    try:
        metrics.STARTS.labels(name).set(starts)
        task()
    except BridgeError as error:
        log.error("%s", error)
        raise SystemExit(int(error.exit_code)) from error
    except Exception as error:  # the end of the process: its last words belong into the log, as one event
        log.critical("a defect ended this process", exc_info=True)
        raise SystemExit(int(ExitCode.FAILED)) from error
    raise SystemExit(int(ExitCode.OK))
