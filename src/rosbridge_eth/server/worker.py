"""One of the server's processes at the robots' door: its own sessions, the shared inbox."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable

from rosbridge_eth.channel import AddressChanged, Connected, Disconnected, Event, MessageReceived, Server
from rosbridge_eth.channel.udp import UdpLoop
from rosbridge_eth.identity import PeerIdentity
from rosbridge_eth.server.reception import Reception

log = logging.getLogger(__name__)

LOOK_AT_LIST = 1.0  # seconds between looks whether a connected robot was revoked
LONGEST_WAIT = 0.5


class Worker:
    """Drives a Reception over a socket until told to stop.

    allowed: the allow list. revision: another value after each change of it, asked once a second; the list itself is
    gone through only then, and after a session began, whose handshake may have been allowed before the change.
    """

    def __init__(
        self,
        server: Server,
        reception: Reception,
        make_loop: Callable[[Callable[[Event], None], Callable[[float], None]], UdpLoop],
        allowed: Callable[[PeerIdentity], bool],
        revision: Callable[[], object],
    ) -> None:
        self.server, self.reception = server, reception
        self.loop = make_loop(self._on_event, self._on_batch)
        self._allowed, self._revision = allowed, revision
        self._looked_at: object = None  # the revision that all sessions were held against
        self._arrived: list[MessageReceived] = []
        self._look_at = 0.0

    def _on_event(self, event: Event) -> None:
        match event:
            case MessageReceived():
                self._arrived.append(event)
            case Connected(peer=peer):
                self._looked_at = None
                log.info("%s: session begun", peer)
            case Disconnected(reason=reason, peer=peer):
                log.info("%s: session ended, %s", peer, reason)
            case AddressChanged(peer=peer):
                log.info("%s: goes on from another address", peer)

    def _on_batch(self, now: float) -> None:
        arrived, self._arrived = self._arrived, []
        if arrived:
            self.reception.take(arrived, wall=time.time(), now=now)

    def run(self, stopped: Callable[[], bool], *, on_turn: Callable[[], None] = lambda: None) -> None:
        """Until `stopped()`; then every session is ended in good order. on_turn: called after every step."""
        while not stopped():
            self.loop.step(LONGEST_WAIT)
            on_turn()
            now = time.monotonic()
            if now >= self._look_at:
                self._look_at = now + LOOK_AT_LIST
                self._close_revoked(now)
        self.server.close(time.monotonic())
        self.loop.step(0.0)
        self.loop.close()

    def _close_revoked(self, now: float) -> None:
        revision = self._revision()  # before the list: a change in between is seen the next time
        if revision == self._looked_at:
            return
        self._looked_at = revision
        for peer in self.server.peers():
            if not self._allowed(peer):
                log.warning("%s is no longer allowed; its session is closed", peer)
                self.server.close_peer(peer.name, now, role=peer.role)
