"""The parent of the server's shards: checks chain and stores, starts a child for each shard, and again if it ended.

Children are forked, so that no key travels through a pipe or an argument.
"""

from __future__ import annotations

import logging
import multiprocessing
import os
import signal
import threading
import time
from collections.abc import Callable, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass
from multiprocessing.process import BaseProcess
from socket import AF_UNIX, SOCK_CLOEXEC, SOCK_DGRAM
from socket import socket as Socket
from types import FrameType

from rosbridge_eth.channel.udp import server_socket
from rosbridge_eth.config import ServerConfig, load_server_config
from rosbridge_eth.config.home import OperatorHome
from rosbridge_eth.config.values import Address
from rosbridge_eth.errors import BridgeError, ConfigError, ExitCode
from rosbridge_eth.ledger import Ledger
from rosbridge_eth.operator.registry import Registry
from rosbridge_eth.server import metrics
from rosbridge_eth.server.shard import Secrets, name_of, open_store, run_shard

log = logging.getLogger(__name__)

WATCH = 0.2  # seconds between looks at the children
GRACE = 10.0  # seconds for children to end
PAUSE = 2.0  # seconds before a shard that ended is started again
_FORK = multiprocessing.get_context("fork")


def notify(state: str) -> None:
    """Tell the service manager, where there is one (sd_notify(3)): READY=1, WATCHDOG=1, STOPPING=1."""
    address = os.environ.get("NOTIFY_SOCKET", "")
    if not address:
        return
    with Socket(AF_UNIX, SOCK_DGRAM | SOCK_CLOEXEC) as sock, suppress(OSError):  # it may be gone
        # A leading @ is the abstract namespace, written as a zero byte.
        sock.sendto(state.encode(), "\0" + address[1:] if address.startswith("@") else address)


@dataclass(slots=True)
class Child:
    """A shard's process. due: when it is started; None while it runs."""

    process: BaseProcess | None = None
    starts: int = 0
    since: float = 0.0
    due: float | None = float("-inf")


class Parent:
    """Runs shards until `stop`, SIGTERM, SIGINT, or its terminal is gone. SIGHUP: all start again by server.toml."""

    def __init__(self, home: OperatorHome, secrets: Secrets, only: Sequence[int] = ()) -> None:
        """only: the shards that run here, where the others run elsewhere."""
        self._home, self._secrets, self._only = home, secrets, only
        self._children: dict[int, Child] = {}
        self._stop, self._again = threading.Event(), threading.Event()
        self._at_terminal = os.isatty(0)

    def stop(self) -> None:
        self._stop.set()

    def run(
        self, on_ready: Callable[[list[Address]], None] = lambda addresses: None,
        on_look: Callable[[], None] = lambda: None,
    ) -> None:  # fmt: skip
        """Check, start the shards, start again what ends. Raises BridgeError where something is missing at the start.

        on_ready: called with the addresses that are listened on; on_look: after every look at the children.
        """
        config = self._checked()
        for signaled in (signal.SIGTERM, signal.SIGINT, signal.SIGHUP):
            signal.signal(signaled, self._on_signal)
        try:
            self._begin(config)
            on_ready(self._addresses(config)[0])
            notify("READY=1")
            while not self._stop.wait(WATCH):
                if self._again.is_set():
                    self._again.clear()
                    config = self._reload(config)
                self._look(config, time.monotonic())
                on_look()
                notify("WATCHDOG=1")
        finally:
            notify("STOPPING=1")
            self._end()

    def _on_signal(self, number: int, frame: FrameType | None) -> None:
        if number == signal.SIGHUP and os.isatty(0) == self._at_terminal:
            self._again.set()
        else:  # also of a terminal that is gone
            self.stop()

    def _shards(self, config: ServerConfig) -> Sequence[int]:
        return self._only or range(config.shards)

    def _addresses(self, config: ServerConfig | None) -> tuple[list[Address], list[Address]]:
        """Where the shards take robots, and where they serve /metrics."""
        if config is None:
            return [], []
        shards, monitor = self._shards(config), config.monitor
        return [config.listen.next(shard) for shard in shards], [monitor.next(shard) for shard in shards if monitor]

    def _checked(self, runs: ServerConfig | None = None) -> ServerConfig:
        """server.toml, whose chain is the right one, whose stores keep what they are given, and whose ports are free or
        used by the shards that run by `runs`: else BridgeError."""
        config = load_server_config(self._home.config)
        if wrong := [shard for shard in self._only if shard >= config.shards]:
            raise ConfigError(f"there is no shard {wrong[0]}: {self._home.config} has shards = {config.shards}")
        if config.shards > 1:
            config.addresses()  # which shards name to robots of others
        Registry(self._home.registry).close()
        with closing(Ledger.connect(config.chain.url, self._home.deployment())) as ledger:
            ledger.check()
        for shard in self._shards(config):
            with closing(open_store(config, self._home, shard)) as store:
                store.check()
        (robots_now, metrics_now), (robots, monitors) = self._addresses(runs), self._addresses(config)
        for address in robots:  # a second server gets no further
            if address.port not in {each.port for each in robots_now}:
                server_socket(address).close()
        for address in monitors:
            if address.port not in {each.port for each in metrics_now}:
                metrics.require_free(address)
        return config

    def _begin(self, config: ServerConfig) -> None:
        for file in self._home.path.glob(".shard-*.json"):  # of a server that was killed and had more of them
            if int(file.stem.rpartition("-")[2]) >= config.shards:
                file.unlink(missing_ok=True)
        self._children = {shard: Child() for shard in self._shards(config)}
        self._look(config, time.monotonic())

    def _reload(self, config: ServerConfig) -> ServerConfig:
        """Begin again by server.toml. What cannot be used is told, and nothing changes."""
        try:
            new = self._checked(config)
        except BridgeError as error:
            log.error("nothing is reloaded: %s", error)
            return config
        self._end()
        self._begin(new)
        log.warning("reloaded: %s", ", ".join(map(name_of, self._children)))
        return new

    def _look(self, config: ServerConfig, now: float) -> None:
        for shard, child in self._children.items():
            if child.due is None and child.process is not None and not child.process.is_alive():
                child.due = now + PAUSE
                log.error("%s ended with exit code %s after %.0f s; it is started again in %.0f s",
                          name_of(shard), child.process.exitcode, now - child.since, PAUSE)
            if child.due is not None and now >= child.due:
                child.starts, child.since, child.due = child.starts + 1, now, None
                task = (os.getpid(), child.starts, shard, config, self._home, self._secrets)
                child.process = _FORK.Process(target=_child, args=task, name=name_of(shard))
                child.process.start()
                log.info("%s started, process %d", name_of(shard), child.process.pid)

    def _end(self) -> None:
        """Ask the children to end; kill those that do not within GRACE."""
        running = [child.process for child in self._children.values() if child.process is not None]
        for process in running:
            process.terminate()
        deadline = time.monotonic() + GRACE
        for process in running:
            process.join(max(0.0, deadline - time.monotonic()))
            if process.is_alive():
                log.error("%s does not end; it is killed", process.name)
                process.kill()
                process.join()


def _child(
    parent: int, starts: int, shard: int, config: ServerConfig, home: OperatorHome, secrets: Secrets
) -> None:  # fmt: skip
    """What the process of a shard does: until SIGTERM, or until its parent is no more, since nobody would end it."""
    asked = threading.Event()
    signal.signal(signal.SIGTERM, lambda number, frame: asked.set())
    for number in (signal.SIGINT, signal.SIGHUP):  # they reach the whole group; the parent ends the children
        signal.signal(number, signal.SIG_IGN)
    try:
        metrics.show([("starts", {"process": name_of(shard)}, starts)])
        run_shard(shard, config, home, secrets, lambda: asked.is_set() or os.getppid() != parent)
    except BridgeError as error:
        log.error("%s", error)
        raise SystemExit(int(error.exit_code)) from error
    except Exception as error:  # the end of the process: its last words belong into the log, as one event
        log.critical("a defect ended this process", exc_info=True)
        raise SystemExit(int(ExitCode.FAILED)) from error
