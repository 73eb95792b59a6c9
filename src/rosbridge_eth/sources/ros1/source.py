"""A live ROS 1 graph as a source, with no ROS installed.

The threads of the `node` receive, and never wait for anybody; the caller's own takes messages from the backlog and
emits them. So `emit` may block for as long as it likes: what then finds no room is dropped, oldest first, and counted.
Publishers are never held up.
"""

from __future__ import annotations

import threading
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

from rosbridge_eth.sources.backlog import Backlog
from rosbridge_eth.sources.protocol import Clock, Emit, Offer, Source, SystemClock
from rosbridge_eth.sources.ros1.addressing import master_endpoint, node_name
from rosbridge_eth.sources.ros1.node import Node, ask_offers
from rosbridge_eth.sources.selection import Selection

TAKE_PATIENCE = 0.1
"""Seconds after which the emitting thread looks whether it is to stop."""


@dataclass(frozen=True)
class Ros1Settings:
    """Which master, and what it may cost.

    master: URI; None is ROS_MASTER_URI. hostname: under which the master reaches us; None is ROS_HOSTNAME, ROS_IP or
    the address towards the master. node: our name; None is one of its own for each process.
    max_message: bytes. waiting: messages. timeout: seconds for a call, and for a publisher's header.
    """

    kind: ClassVar[str] = "ros1"
    master: str | None = None
    hostname: str | None = None
    node: str | None = None
    max_message: int = 32 << 20
    waiting: int = 4096
    timeout: float = 5.0


class Ros1Source(Source):
    """The chosen topics of a master. It waits for a master that is not there yet; nothing is asked before `run`."""

    kind = "ros1"
    live = True

    def __init__(self, settings: Ros1Settings, selection: Selection, clock: Clock | None = None) -> None:
        """Raises SourceError for a master's address that is none."""
        self._settings, self._selection = settings, selection
        self._clock = clock or SystemClock()
        self._master = master_endpoint(settings.master)
        self._name = node_name(settings.node)
        self._closed = threading.Event()
        self.counts: Counter[tuple[str, str]] = Counter()
        """By topic: messages received and too_large; publishers connected now; connections ended, by Cause."""
        self._backlog = Backlog(settings.waiting, 2 * settings.max_message)

    def offers(self) -> Sequence[Offer]:
        """What is published now, asked of the master. Raises SourceError."""
        return ask_offers(self._master, self._name, self._settings.timeout)

    @property
    def dropped(self) -> Mapping[str, int]:
        """Messages received and lost here for want of time, by topic."""
        return self._backlog.dropped

    def run(self, emit: Emit, stop: threading.Event) -> None:
        """Emit until `stop` is set or the source closed; it ends within a second then, if `emit` returns.

        Raises SourceError.
        """
        node = Node(
            self._master, self._settings.hostname, self._name, self._selection, self._backlog, self.counts,
            self._clock, max_message=self._settings.max_message, timeout=self._settings.timeout,
        )  # fmt: skip
        node.start()
        try:
            while not stop.is_set() and not self._closed.is_set() and node.is_alive():
                message = self._backlog.take(TAKE_PATIENCE)
                if message is not None:
                    emit(message)
        finally:
            node.leave()
        if node.failure is not None:
            raise node.failure

    def close(self) -> None:
        """Let `run` end, if it is running."""
        self._closed.set()
