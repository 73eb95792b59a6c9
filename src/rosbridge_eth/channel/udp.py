"""Sockets under the channel: a loop that receives, hands out events, and sends. The only part that waits."""

from __future__ import annotations

import contextlib
import errno
import select
import socket
import threading
import time
from collections.abc import Callable, Sequence
from concurrent.futures import Future

from rosbridge_eth.channel.admission import Address
from rosbridge_eth.channel.client import Client
from rosbridge_eth.channel.events import Event, Unresolved
from rosbridge_eth.channel.server import Server
from rosbridge_eth.errors import NetworkError

RECEIVE_BUFFER = 4 << 20  # bytes: about 3,500 full datagrams while the process is busy elsewhere
SEND_BUFFER = 1 << 20
LONGEST = 2048  # bytes; a longer datagram is cut, and fails its authentication
BATCH = 128  # datagrams taken before events are handed out and answers sent
ASK_AGAIN = 10.0  # seconds between questions for the address of a server with which there is no session

_NOT_THE_NETWORK = frozenset({errno.EBADF, errno.ENOTSOCK, errno.EFAULT, errno.ENOMEM})
"""Errors of recvfrom that say that this socket is of no use any more. Any other is news of a datagram sent before."""


def _open(family: int) -> socket.socket:
    sock = socket.socket(family, socket.SOCK_DGRAM)
    sock.setblocking(False)
    # The kernel grants what its limits allow (net.core.rmem_max); less only means more retransmissions.
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, RECEIVE_BUFFER)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, SEND_BUFFER)
    return sock


def _resolve(host: str, port: int, flags: int = 0) -> tuple[int, Address]:
    try:
        found = socket.getaddrinfo(host or None, port, type=socket.SOCK_DGRAM, flags=flags)
    except (OSError, UnicodeError) as error:  # the latter for what cannot be a name
        raise NetworkError(
            f"the address {host!r} cannot be found: {getattr(error, 'strerror', error)}; see that this machine has a"
            " network and a name server, and that the name is right"
        ) from error
    # Of several the first that is IPv4, as servers listen where nothing else is said: `localhost` is ::1, too.
    family, _, _, _, place = min(found, key=lambda one: one[0] != socket.AF_INET)
    return family, (str(place[0]), int(place[1]))


def client_socket(server: Address) -> tuple[socket.socket, Address]:
    """A socket to talk to `server` (host name or address, port), and its address for Client.connect."""
    family, address = _resolve(*server)
    return _open(family), address


def server_socket(address: Address) -> socket.socket:
    """A socket bound to an address. NetworkError if the port is taken or not allowed."""
    family, place = _resolve(*address, socket.AI_PASSIVE)
    sock = _open(family)
    try:
        sock.bind(place)
    except OSError as error:
        sock.close()
        fix = {
            errno.EADDRNOTAVAIL: "no interface here has that address; listen at one of them, or at 0.0.0.0 for all",
            errno.EACCES: "choose a port from 1024 on, or run with the right to open it",
        }.get(error.errno or 0, "stop the program that has it, or choose another port")
        raise NetworkError(f"UDP port {place[1]} of {place[0]} cannot be opened: {error.strerror}; {fix}") from error
    return sock


class UdpLoop:
    """Drives one endpoint over one socket, in one thread; on_event is called with each event.

    `wake` may be called from any thread; all else from the loop's own.
    """

    def __init__(self, endpoint: Client | Server, sock: socket.socket, on_event: Callable[[Event], None]) -> None:
        self.endpoint = endpoint
        self.socket = sock
        self.lost_sends = 0
        """Datagrams that the system did not take."""
        self._on_event = on_event
        self._wake_receive, self._wake_send = socket.socketpair()
        self._wake_receive.setblocking(False)
        self._wake_send.setblocking(False)
        self._poll = select.poll()
        self._poll.register(sock, select.POLLIN)
        self._poll.register(self._wake_receive, select.POLLIN)

    def wake(self) -> None:
        """Make a waiting `step` return, from any thread or a signal handler; nothing happens once it is closed."""
        with contextlib.suppress(OSError):  # wake-ups enough are waiting, or another thread has just closed the loop
            self._wake_send.send(b"\0")

    def step(self, longest: float) -> None:
        """Send what may be sent; wait for something, at most `longest` seconds; take it and give out its events."""
        endpoint, now = self.endpoint, time.monotonic()
        self._turn(now)
        when = endpoint.next_timer()
        wait = longest if when is None else min(longest, max(0.0, when - now))
        # Rounded up to a millisecond: to wake too early would be to wait in circles.
        ready = self._poll.poll(int(wait * 1000 + 0.999))
        now = time.monotonic()
        for descriptor, _ in ready:
            if descriptor == self.socket.fileno():
                self._receive(now)
            else:
                self._wake_receive.recv(4096)
        when = endpoint.next_timer()
        if when is not None and when <= now:
            endpoint.handle_timer(now)
        self._turn(now)

    def close(self) -> None:
        """Send what the endpoint still has to say, and close the socket and what belongs to the loop."""
        self._flush(time.monotonic())
        self.socket.close()
        self._wake_receive.close()
        self._wake_send.close()

    def _receive(self, now: float) -> None:
        receive, take = self.socket.recvfrom, self.endpoint.receive_datagram
        for _ in range(BATCH):
            try:
                data, place = receive(LONGEST)
            except BlockingIOError:
                return
            except OSError as error:
                if error.errno not in _NOT_THE_NETWORK:
                    continue  # ECONNREFUSED and the like
                raise NetworkError(f"the socket cannot be read: {error.strerror}") from error
            take(data, (place[0], place[1]), now)

    def _turn(self, now: float) -> None:
        """Give out every event there is, and send what may be sent."""
        while (event := self.endpoint.next_event()) is not None:
            self._on_event(event)
        self._flush(now)

    def _flush(self, now: float) -> None:
        send = self.socket.sendto
        for data, address in self.endpoint.datagrams_to_send(now):
            try:
                send(data, address)
            except (OSError, OverflowError):  # a full buffer, no route, port 0: the channel sends again what matters
                self.lost_sends += 1


class ClientLoop(UdpLoop):
    """Drives a client whose server is given by name: one that has no address yet, as before the network is up, or
    another one tomorrow. Of several servers they are asked in turn until there is a session."""

    def __init__(self, client: Client, servers: Sequence[Address], on_event: Callable[[Event], None]) -> None:
        super().__init__(client, _open(socket.AF_INET), on_event)
        self.resolved = True
        """False while there is no session and the name has no address."""
        self._client, self._servers = client, servers
        self._asked, self._taken = 0, 0  # which server is asked next, and to which the client connects
        self._left_at = float("-inf")
        self._address: Address | None = None
        self._answer: Future[tuple[int, Address]] | None = None
        self._ask_at = float("-inf")

    def seek(self, now: float) -> None:
        """While there is no session: ask for the server's address, and connect to a new one. Call it in each turn."""
        if self._client.connected:
            self.resolved, self._asked = True, self._taken
            return
        if self._answer is not None and self._answer.done():
            answer, self._answer = self._answer, None
            try:
                self._take(*answer.result(), now)
            except (NetworkError, OSError) as error:  # the latter: such an address is of no use on this machine
                self.resolved = False
                self._on_event(Unresolved(str(error)))
        elif self._answer is None and now >= self._ask_at:
            self._answer, self._ask_at = Future(), now + ASK_AGAIN
            self._taken = self._asked % len(self._servers)
            self._asked = self._taken + 1
            # A thread of its own: getaddrinfo may wait half a minute for a name server, and cannot be told to stop.
            asking = (self._servers[self._taken], self._answer)
            threading.Thread(target=self._ask, args=asking, name="resolver", daemon=True).start()

    def go(self, server: Address, now: float) -> None:
        """End the session and make one with this server instead, or else with the last of the others."""
        self._client.close(now)
        self._servers, self._asked, self._address = (server, self._servers[-1]), 0, None
        if now >= self._left_at + ASK_AGAIN:  # two that name each other are not asked without end
            self._left_at = self._ask_at = now

    def _ask(self, server: Address, answer: Future[tuple[int, Address]]) -> None:
        try:
            answer.set_result(_resolve(*server))
        except NetworkError as error:
            answer.set_exception(error)
        self.wake()

    def _take(self, family: int, address: Address, now: float) -> None:
        self.resolved = True
        if family != self.socket.family:
            self._poll.unregister(self.socket)
            self.socket.close()
            self.socket = _open(family)
            self._poll.register(self.socket, select.POLLIN)
        if address != self._address:
            self._address = address
            self._client.connect(address, now)
