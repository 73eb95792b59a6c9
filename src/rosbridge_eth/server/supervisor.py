"""The server's processes: N workers at one port and one submitter, started, watched, started again, ended.

The parent opens the sockets and every secret once, checks the chain, and
restores a lost journal before the port opens; then it only watches. Children
are forked, so no key travels through a pipe or an argument.
"""

from __future__ import annotations

import logging
import multiprocessing
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
from rosbridge_eth.errors import BridgeError, ExitCode
from rosbridge_eth.home import Deployment, OperatorHome
from rosbridge_eth.identity import Identity, Role
from rosbridge_eth.ledger.accounts import Keyring
from rosbridge_eth.ledger.recovery import adopt_history, missing_batches
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

log = logging.getLogger(__name__)

WATCH = 0.2  # seconds between looks at the children
RESTART_PAUSE = 1.0
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
        self._stop = threading.Event()

    def stop(self) -> None:
        self._stop.set()

    def run(self, on_ready: Callable[[tuple[str, int]], None] = lambda address: None) -> None:
        """Check, open the port, start the processes, watch them. Raises BridgeError before the port is open.

        on_ready: called with the address that is listened on.
        """
        self._prepare()
        sockets = server_sockets(self._config.listen, self._config.workers)
        tasks: dict[str, Callable[[], None]] = {"submitter": self._submit}
        for worker, sock in enumerate(sockets):
            tasks[f"worker-{worker}"] = self._worker_task(worker, sock)
        for number in (signal.SIGTERM, signal.SIGINT):
            signal.signal(number, self._on_signal)
        try:
            for name, task in tasks.items():
                self._start(name, task)
            host, port = sockets[0].getsockname()[:2]
            on_ready((host, port))
            while not self._stop.wait(WATCH):
                self._look(tasks)
        finally:
            self._end()
            for sock in sockets:
                sock.close()

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        self.stop()

    def _prepare(self) -> None:
        """The chain is the right one, the store is whole: only then may a robot be answered."""
        chain = open_chain(self._config)
        try:
            contract = bound_contract(chain, self._deployment)
            journal = open_journal(self._home, self._deployment)
            registry = Registry(self._home.registry)
            try:
                open_inbox(self._config, self._home).close()
                robots = {robot_id(enrolment.name) for enrolment in registry.all(Role.ROBOT)}
                lost = missing_batches(journal, contract, sorted(robots))
                if lost:
                    log.warning("the journal lacks %d batches that the chain has; it is restored", sum(lost.values()))
                    adopt_history(journal, contract, lost, time.time())
            finally:
                registry.close()
                journal.close()
        finally:
            chain.close()

    def _start(self, name: str, task: Callable[[], None]) -> None:
        process = _FORK.Process(target=_child, args=(task,), name=name, daemon=False)
        process.start()
        self._children[name] = process
        log.info("%s started, process %d", name, process.pid)

    def _look(self, tasks: dict[str, Callable[[], None]]) -> None:
        for name, process in list(self._children.items()):
            if not process.is_alive():
                log.error("%s ended with exit code %s; it is started again", name, process.exitcode)
                self._stop.wait(RESTART_PAUSE)
                if not self._stop.is_set():
                    self._start(name, tasks[name])

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
            worker.run(_terminated())

        return work

    def _submit(self) -> None:
        chain = open_chain(self._config)
        submission = open_submission(
            config=self._config,
            contract=bound_contract(chain, self._deployment),
            journal=open_journal(self._home, self._deployment),
            inbox=open_inbox(self._config, self._home),
            registry=Registry(self._home.registry),
            keys=self._secrets.keys,
        )
        submission.run(_terminated())


def _terminated() -> Callable[[], bool]:
    """True once this process was asked to end."""
    asked = threading.Event()
    signal.signal(signal.SIGTERM, lambda number, frame: asked.set())
    return asked.is_set


def _child(task: Callable[[], None]) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group; the parent ends the children
    try:
        task()
    except BridgeError as error:
        log.error("%s", error)
        raise SystemExit(int(error.exit_code)) from error
    raise SystemExit(int(ExitCode.OK))
