"""One of the server's processes at the robots' door: its own sessions, the shared inbox."""

from __future__ import annotations

import logging
import time
from collections.abc import Callable
from dataclasses import dataclass

from rosbridge_eth.channel import Address, AddressChanged, Connected, Disconnected, End, Event, MessageReceived, Server
from rosbridge_eth.channel.udp import UdpLoop
from rosbridge_eth.identity import PeerIdentity
from rosbridge_eth.server.reception import Reception

log = logging.getLogger(__name__)

LOOK_AT_LIST = 1.0  # seconds between looks whether a connected robot was revoked
LONGEST_WAIT = 0.5
ALIVE = 10.0  # seconds after its last message or its beginning in which a session counts as alive


@dataclass(slots=True)
class _Session:
    """Where a robot's session comes from, and when (on the monotonic clock) it was last heard of."""

    address: Address | None
    heard: float


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
        self._sessions: dict[bytes, _Session] = {}  # by connection
        self._replaced: dict[str, _Session] = {}  # by peer: what the session that begins next takes the place of

    def _on_event(self, event: Event) -> None:
        match event:
            case MessageReceived(connection=connection):
                self._arrived.append(event)
                if (session := self._sessions.get(connection)) is not None:
                    session.heard = time.monotonic()
            case Connected(peer=peer, connection=connection):
                self._looked_at = None
                session = _Session(self.server.address_of(connection), time.monotonic())
                self._sessions[connection] = session
                log.info("%s: session begun", peer)
                self._compare(peer, self._replaced.pop(str(peer), None), session)
            case Disconnected(reason=reason, peer=peer, connection=connection):
                ended = self._sessions.pop(connection, None)
                if reason is End.REPLACED and ended is not None:
                    self._replaced[str(peer)] = ended
                log.info("%s: session ended, %s", peer, reason)
            case AddressChanged(peer=peer, connection=connection, address=address):
                if (session := self._sessions.get(connection)) is not None:
                    session.address = address
                log.info("%s: goes on from another address", peer)

    @staticmethod
    def _compare(peer: PeerIdentity, before: _Session | None, session: _Session) -> None:
        """A session that took the place of a living one: perhaps two machines have one identity."""
        if before is None or session.heard - before.heard > ALIVE or before.address == session.address:
            return
        log.warning(
            "%s: a session from %s took the place of one from %s that was alive: the robot was killed and started"
            " again, or two machines have its identity; then revoke it and register it anew",
            peer, _place(session.address), _place(before.address),
        )

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


def _place(address: Address | None) -> str:
    return "an unknown address" if address is None else f"{address[0]} port {address[1]}"
