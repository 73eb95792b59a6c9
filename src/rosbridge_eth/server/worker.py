"""One of the server's processes at the robots' door: its own sessions, the shared inbox."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable

from rosbridge_eth.channel import Event, MessageReceived, Server
from rosbridge_eth.channel.udp import UdpLoop
from rosbridge_eth.identity import PeerIdentity
from rosbridge_eth.server.reception import Reception

log = logging.getLogger(__name__)

LOOK_AT_LIST = 1.0  # seconds between looks whether a connected robot was revoked
LONGEST_WAIT = 0.5


class Worker:
    """Drives a Reception over a socket until told to stop. allowed: the allow list, asked once a second."""

    def __init__(
        self,
        server: Server,
        reception: Reception,
        make_loop: Callable[[Callable[[Event], None], Callable[[float], None]], UdpLoop],
        allowed: Callable[[PeerIdentity], bool],
    ) -> None:
        self.server, self.reception = server, reception
        self.loop = make_loop(self._on_event, self._on_batch)
        self._allowed = allowed
        self._arrived: list[MessageReceived] = []
        self._look_at = 0.0

    def _on_event(self, event: Event) -> None:
        if isinstance(event, MessageReceived):
            self._arrived.append(event)
        else:
            log.info("%s", event)

    def _on_batch(self, now: float) -> None:
        arrived, self._arrived = self._arrived, []
        if arrived:
            self.reception.take(arrived, wall=time.time(), now=now)

    def run(self, stopped: Callable[[], bool]) -> None:
        """Until `stopped()`; then every session is ended in good order."""
        while not stopped():
            self.loop.step(LONGEST_WAIT)
            now = time.monotonic()
            if now >= self._look_at:
                self._look_at = now + LOOK_AT_LIST
                self._close_revoked(now)
        self.server.close(time.monotonic())
        self.loop.step(0.0)
        self.loop.close()

    def _close_revoked(self, now: float) -> None:
        for peer in self.server.peers():
            if not self._allowed(peer):
                log.warning("%s is no longer allowed; its session is closed", peer)
                self.server.close_peer(peer.name, now, role=peer.role)
