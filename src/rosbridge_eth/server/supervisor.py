"""The server's processes: N workers at one port, one submitter, and a monitor where one is configured.

Started, watched, started again, ended.

The parent opens the sockets and every secret once, checks the chain, and
restores a lost journal before the port opens; then it only watches. Children
are forked, so no key travels through a pipe or an argument.
"""

from __future__ import annotations

import logging
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass
from multiprocessing.process import BaseProcess
from socket import socket as Socket
from types import FrameType

from rosbridge_eth.channel.udp import server_sockets
from rosbridge_eth.config import ServerConfig
from rosbridge_eth.errors import BridgeError, ExitCode, ProcessError
from rosbridge_eth.home import Deployment, OperatorHome
from rosbridge_eth.identity import Identity, Role
from rosbridge_eth.ledger.accounts import Keyring
from rosbridge_eth.ledger.recovery import adopt_history, missing_batches
from rosbridge_eth.operations.board import Board, Pace, Wire
from rosbridge_eth.operations.figures import Snapshot
from rosbridge_eth.operations.notify import Notifier
from rosbridge_eth.operations.web import Web
from rosbridge_eth.records import robot_id
from rosbridge_eth.registry import Registry
from rosbridge_eth.server.administration import server_trust
from rosbridge_eth.server.assembly import (
    bound_contract,
    open_chain,
    open_inbox,
    open_journal,
    open_submission,
    open_worker,
)
from rosbridge_eth.server.monitor import NODE, STORE, Monitor, NodeWatch, StoreWatch
from rosbridge_eth.server.publishing import (
    MONITOR,
    SUBMITTER,
    SUPERVISOR,
    Costs,
    supervisor_snapshot,
    worker_name,
    worker_snapshot,
)
from rosbridge_eth.server.restarts import Restarts
from rosbridge_eth.server.sole import sole_submitter

log = logging.getLogger(__name__)

WATCH = 0.2  # seconds between looks at the children
GRACE = 10.0  # seconds for children to end in good order
_FORK = multiprocessing.get_context("fork")


@dataclass(frozen=True, slots=True)
class Secrets:
    """What the server needs and no file holds in clear."""

    identity: Identity
    keys: Keyring


class Supervisor:
    """Runs a server until `stop` or SIGTERM/SIGINT."""

    def __init__(self, home: OperatorHome, config: ServerConfig, secrets: Secrets) -> None:
        self._home, self._config, self._secrets = home, config, secrets
        self._deployment: Deployment = home.deployment()
        self._children: dict[str, BaseProcess] = {}
        self._started_at: dict[str, float] = {}
        self._due: dict[str, float] = {}  # processes that ended, and when they are started again
        self._restarts = Restarts()
        self._wire: Wire | None = None
        self._notifier = Notifier()
        self._stop = threading.Event()
        self._pid = os.getpid()

    def stop(self) -> None:
        self._stop.set()

    def run(self, on_ready: Callable[[tuple[str, int]], None] = lambda address: None) -> None:
        """Check, open the port, start the processes, watch them.

        Raises BridgeError before the port is open, and ProcessError where a
        process does not come up however often it is started.
        on_ready: called with the address that is listened on.
        """
        self._prepare()
        sockets = server_sockets(self._config.listen, self._config.workers)
        tasks: dict[str, Callable[[], None]] = {SUBMITTER: self._submit}
        for worker, sock in enumerate(sockets):
            tasks[worker_name(worker)] = self._worker_task(worker, sock)
        if self._config.monitor is not None:
            self._wire, board = Wire(), Board([*tasks, SUPERVISOR], [NODE, STORE])
            # Its port is opened here, so that one that is taken is told at the start, before a robot is answered.
            web = Web(self._config.monitor, board)
            tasks[MONITOR] = self._monitor_task(self._wire, board, web)
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, self._on_signal)
        try:
            for name, task in tasks.items():
                self._start(name, task)
            host, port = sockets[0].getsockname()[:2]
            on_ready((host, port))
            self._notifier.say("READY=1")
            pace = Pace()
            while not self._stop.wait(WATCH):
                now = time.monotonic()
                self._look(tasks, now)
                if pace.due(now):
                    self._notifier.say("WATCHDOG=1")
                    self._publish(supervisor_snapshot({name: name not in self._due for name in tasks},
                                                      self._restarts.total))
        finally:
            self._notifier.say("STOPPING=1")
            self._end()
            for sock in sockets:
                sock.close()

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        self.stop()

    def _prepare(self) -> None:
        """The chain is the right one, the store is whole: only then may a robot be answered."""
        registry, chain = Registry(self._home.registry), open_chain(self._config)
        try:
            contract = bound_contract(chain, self._deployment)
            journal = open_journal(self._home, self._deployment)
            try:
                open_inbox(self._config, self._home).close()
                robots = {robot_id(enrolment.name) for enrolment in registry.all(Role.ROBOT)}
                lost = missing_batches(journal, contract, sorted(robots))
                if lost:
                    log.warning("the journal lacks %d batches that the chain has; it is restored", sum(lost.values()))
                    adopt_history(journal, contract, lost, time.time())
            finally:
                journal.close()
        finally:
            registry.close()
            chain.close()

    def _start(self, name: str, task: Callable[[], None]) -> None:
        process = _FORK.Process(target=_child, args=(task,), name=name, daemon=False)
        process.start()
        self._children[name] = process
        self._started_at[name] = time.monotonic()
        log.info("%s started, process %d", name, process.pid)

    def _look(self, tasks: dict[str, Callable[[], None]], now: float) -> None:
        for name, process in list(self._children.items()):
            if process.is_alive() or name in self._due:
                continue
            code, lived = process.exitcode, now - self._started_at[name]
            pause = self._restarts.ended(name, code, lived, vital=name != MONITOR)
            if pause is None:
                raise ProcessError(
                    f"{name} ends with exit code {code} as soon as it is started; the log says why."
                    " Robots keep their records until the server is back"
                )
            log.error("%s ended with exit code %s after %.0f s; it is started again in %.0f s", name, code, lived,
                      pause)
            self._due[name] = now + pause
        for name, due in list(self._due.items()):
            if now >= due:
                del self._due[name]
                self._start(name, tasks[name])

    def _publish(self, snapshot: Snapshot) -> None:
        if self._wire is not None:
            self._wire.publish(snapshot)

    def _end(self) -> None:
        for process in self._children.values():
            process.terminate()
        deadline = time.monotonic() + GRACE
        for name, process in self._children.items():
            process.join(max(0.0, deadline - time.monotonic()))
            if process.is_alive():
                log.error("%s does not end; it is killed", name)
                process.kill()
                process.join()

    # What runs in the children; each opens its own connections to store and chain.

    def _worker_task(self, number: int, sock: Socket) -> Callable[[], None]:
        def work() -> None:
            registry = Registry(self._home.registry)
            worker = open_worker(
                number,
                sock,
                config=self._config,
                identity=self._secrets.identity,
                trust=server_trust(self._home, registry),
                registry=registry,
                inbox=open_inbox(self._config, self._home),
                journal=open_journal(self._home, self._deployment),
                deployment=self._deployment,
            )
            pace = Pace()

            def publish() -> None:
                if self._wire is not None and pace.due(time.monotonic()):
                    self._publish(
                        worker_snapshot(number, worker.server.statistics(), worker.loop, worker.reception)
                    )

            worker.run(_terminated(self._pid), on_turn=publish)

        return work

    def _submit(self) -> None:
        stopped = _terminated(self._pid)
        with sole_submitter(self._home.submitter_lock, stopped) as holder:
            if holder is not None:
                self._submit_as(holder, stopped)

    def _submit_as(self, holder: str, stopped: Callable[[], bool]) -> None:
        chain = open_chain(self._config)
        costs, pace = Costs(), Pace()
        submission = open_submission(
            config=self._config,
            contract=bound_contract(chain, self._deployment),
            journal=open_journal(self._home, self._deployment),
            inbox=open_inbox(self._config, self._home),
            registry=Registry(self._home.registry),
            keys=self._secrets.keys,
            on_confirmed=costs.add,
            holder=holder,
        )

        def publish() -> None:
            if self._wire is not None and pace.due(time.monotonic()):
                self._publish(costs.snapshot(submission, submission.status()))

        submission.run(stopped, on_turn=publish)

    def _monitor_task(self, wire: Wire, board: Board, web: Web) -> Callable[[], None]:
        def watch() -> None:
            chain, registry = open_chain(self._config), Registry(self._home.registry)
            treasury = self._secrets.keys.operator.address

            def accounts() -> list[tuple[str, str]]:
                robots = [(robot.account, robot.name) for robot in registry.all(Role.ROBOT)
                          if robot.account is not None and robot.revoked_at is None]
                return [(treasury, "operator"), *robots]

            Monitor(
                wire,
                board,
                web,
                NodeWatch(chain, lambda: bound_contract(chain, self._deployment), accounts),
                StoreWatch(
                    open_inbox(self._config, self._home), open_journal(self._home, self._deployment), self._home.path
                ),
            ).run(_terminated(self._pid))

        return watch


def _terminated(parent: int) -> Callable[[], bool]:
    """True once this process was asked to end, or `parent` is no more: nobody would end it then."""
    asked = threading.Event()
    signal.signal(signal.SIGTERM, lambda number, frame: asked.set())
    return lambda: asked.is_set() or os.getppid() != parent


def _child(task: Callable[[], None]) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group; the parent ends the children
    try:
        task()
    except BridgeError as error:
        log.error("%s", error)
        raise SystemExit(int(error.exit_code)) from error
    except Exception as error:  # the end of the process: its last words belong into the log, as one event
        log.critical("a defect ended this process", exc_info=True)
        raise SystemExit(int(ExitCode.FAILED)) from error
    raise SystemExit(int(ExitCode.OK))
