"""Sockets for one thread: connections with a deadline that deliver bytes, a listener, and names resolved elsewhere.

Knows nothing of ROS. Every connection has a moment by which it must have made
progress; whoever owns it moves that moment on. A name server that hangs holds up
its own thread, never the loop.
"""

from __future__ import annotations

import contextlib
import errno
import ipaddress
import os
import queue
import selectors
import socket
import threading
import time
from collections import OrderedDict, deque
from collections.abc import Callable
from typing import Any, TypeAlias

Received: TypeAlias = Callable[[memoryview], None]
Ended: TypeAlias = Callable[[str], None]
Addresses: TypeAlias = "list[tuple[socket.AddressFamily, tuple[Any, ...]]]"

CHUNK = 256 * 1024
MAX_INCOMING = 64
"""Connections to our listener at once; the oldest goes when one more comes."""
RESOLVERS = 4
"""Threads that ask the name server."""
REFRESH = 10.0
"""Seconds after which a name that is used is asked again."""
MAX_KNOWN = 256
"""Names whose addresses are remembered; the one used least recently goes."""
SCAN_EVERY = 0.05
"""Seconds between looks at the deadlines."""
LONGEST_TURN = 0.1
CLOSED = "the connection was closed"


class Connection:
    """One TCP connection, being made or open. `ended` is called once, with the reason, unless we `close` it."""

    def __init__(self, loop: Loop, received: Received, ended: Ended, deadline: float | None) -> None:
        self.deadline = deadline
        self.connected = False
        self._loop = loop
        self._received, self._ended = received, ended
        self._socket: socket.socket | None = None
        self._addresses: Addresses = []
        self._out = bytearray()
        self._last_word = False
        self._open = True

    def send(self, data: bytes, *, last: bool = False) -> None:
        """Send as soon as possible. last: and close then."""
        self._out += data
        self._last_word = last
        if self.connected:
            self._write()

    def close(self) -> None:
        """Without calling `ended`."""
        if self._open:
            self._open = False
            self._forget_socket()
            self._loop._connections.discard(self)

    def end(self, why: str) -> None:
        """Close and tell the owner."""
        if self._open:
            self.close()
            self._ended(why)

    def _resolved(self, addresses: Addresses | str) -> None:
        if not self._open:
            return
        if isinstance(addresses, str):
            self.end(addresses)
            return
        self._addresses = list(addresses)
        self._dial("the name has no address")

    def _dial(self, why: str) -> None:
        while self._addresses:
            family, address = self._addresses.pop(0)
            try:
                self._socket = socket.socket(family, socket.SOCK_STREAM)
                self._socket.setblocking(False)
                self._socket.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
                self._socket.connect_ex(address)
                self._loop._watch(self._socket, selectors.EVENT_READ | selectors.EVENT_WRITE, self._ready)
            except OSError as error:
                why = _reason(error)
                self._forget_socket()
                continue
            return
        self.end(why)

    def _accepted(self, sock: socket.socket) -> None:
        self._socket, self.connected = sock, True
        self._loop._watch(sock, selectors.EVENT_READ, self._ready)

    def _forget_socket(self) -> None:
        if self._socket is not None:
            self._loop._unwatch(self._socket)
            self._socket.close()
            self._socket = None

    def _ready(self, events: int) -> None:
        if self._socket is None:
            return
        if not self.connected:
            error = self._socket.getsockopt(socket.SOL_SOCKET, socket.SO_ERROR)
            if error:
                self._forget_socket()
                self._dial(_reason(OSError(error, "")))
                return
            self.connected = True
            _keep_alive(self._socket)
            self._write()
        elif events & selectors.EVENT_WRITE:
            self._write()
        if self._socket is not None and events & selectors.EVENT_READ:
            self._read(self._socket)

    def _read(self, sock: socket.socket) -> None:
        buffer = self._loop._buffer
        try:
            count = sock.recv_into(buffer)
        except BlockingIOError:
            return
        except OSError as error:
            self.end(_reason(error))
            return
        if count:
            self._received(buffer[:count])
        else:
            self.end(CLOSED)

    def _write(self) -> None:
        if self._socket is None:
            return
        try:
            if self._out:
                del self._out[: self._socket.send(self._out)]
        except BlockingIOError:
            pass
        except OSError as error:
            self.end(_reason(error))
            return
        if self._out:
            self._loop._watch(self._socket, selectors.EVENT_READ | selectors.EVENT_WRITE, self._ready)
        elif self._last_word:
            self.end(CLOSED)
        else:
            self._loop._watch(self._socket, selectors.EVENT_READ, self._ready)


class Loop:
    """A selector and what hangs on it. Everything but `wake` is for one thread."""

    def __init__(self) -> None:
        self._selector = selectors.DefaultSelector()
        self._connections: set[Connection] = set()
        self._incoming: deque[Connection] = deque()
        self._buffer = memoryview(bytearray(CHUNK))
        self._resolver = _Resolver(self.wake)
        self._wake_receive, self._wake_send = socket.socketpair()
        self._wake_receive.setblocking(False)
        self._wake_send.setblocking(False)
        self._listener: socket.socket | None = None
        self._next_scan = 0.0
        self._watch(self._wake_receive, selectors.EVENT_READ, self._woken)

    def connect(self, host: str, port: int, received: Received, ended: Ended, deadline: float) -> Connection:
        """Begin to connect; what goes wrong, already now perhaps, is told by `ended` at a later turn."""
        connection = Connection(self, received, ended, deadline)
        self._connections.add(connection)
        self._resolver.ask(host, port, connection)
        return connection

    def listen(self, host: str, accepted: Callable[[Connection], tuple[Received, Ended]], patience: float) -> int:
        """Listen on a port that the system chooses, and return it. `patience`: seconds that a connection may last."""
        listener = socket.socket(socket.AF_INET6 if ":" in host else socket.AF_INET, socket.SOCK_STREAM)
        self._listener = listener
        listener.setblocking(False)
        listener.bind((host, 0))
        listener.listen(128)

        def accept(_: int) -> None:
            try:
                sock, _address = listener.accept()
            except OSError:
                return  # it went away again, or we have no descriptor left for it just now
            sock.setblocking(False)
            connection = Connection(self, lambda data: None, lambda why: None, time.monotonic() + patience)
            connection._received, connection._ended = accepted(connection)
            self._connections.add(connection)
            self._incoming = deque(known for known in self._incoming if known._open)
            self._incoming.append(connection)
            if len(self._incoming) > MAX_INCOMING:
                self._incoming.popleft().end("there were too many connections")
            connection._accepted(sock)

        self._watch(listener, selectors.EVENT_READ, accept)
        return int(listener.getsockname()[1])

    def turn(self, until: float) -> None:
        """Wait for something to happen, at most until then (monotonic seconds) and LONGEST_TURN, and handle it."""
        now = time.monotonic()
        for key, events in self._selector.select(max(0.0, min(until - now, LONGEST_TURN))):
            handle: Callable[[int], None] = key.data
            if self._selector.get_map().get(key.fd) is key:  # not closed by what was handled before it
                handle(events)
        for connection, addresses in self._resolver.found():
            connection._resolved(addresses)
        now = time.monotonic()
        if now >= self._next_scan:
            self._next_scan = now + SCAN_EVERY
            for connection in [c for c in self._connections if c.deadline is not None and now >= c.deadline]:
                connection.end("it took too long" if connection.connected else "it cannot be reached in time")

    def wake(self) -> None:
        """End a turn now, from any thread."""
        with contextlib.suppress(OSError):  # full: it will wake anyway; closed: there is nothing to wake
            self._wake_send.send(b"\0")

    def close(self) -> None:
        """Close everything; no `ended` is called."""
        for connection in list(self._connections):
            connection.close()
        self._resolver.close()
        if self._listener is not None:
            self._listener.close()
        self._selector.close()
        self._wake_receive.close()
        self._wake_send.close()

    def _woken(self, _: int) -> None:
        with contextlib.suppress(BlockingIOError):
            while self._wake_receive.recv(1024):
                pass

    def _watch(self, sock: socket.socket, events: int, handle: Callable[[int], None]) -> None:
        known = self._selector.get_map().get(sock)
        if known is None:
            self._selector.register(sock, events, handle)
        elif known.events != events:
            self._selector.modify(sock, events, handle)

    def _unwatch(self, sock: socket.socket) -> None:
        if self._selector.get_map().get(sock) is not None:
            self._selector.unregister(sock)


class _Resolver:
    """getaddrinfo in a few threads, which begin with the first name that is not an address.

    A name that resolved before is answered at once and asked again later, so that names which
    hang (anybody may list one at the master) do not stand in the way of the master's own.
    """

    def __init__(self, wake: Callable[[], None]) -> None:
        self._wake = wake
        self._asked: queue.SimpleQueue[tuple[str, int, Connection | None] | None] = queue.SimpleQueue()
        self._found: deque[tuple[str, Connection | None, Addresses | str]] = deque()  # by the threads
        self._known: OrderedDict[str, tuple[float, Addresses]] = OrderedDict()  # by name, and when it was asked
        self._threads: list[threading.Thread] = []

    def ask(self, host: str, port: int, connection: Connection) -> None:
        try:
            address = ipaddress.ip_address(host)
        except ValueError:
            self._ask_name(host, port, connection)
            return
        family = socket.AF_INET if address.version == 4 else socket.AF_INET6
        self._found.append(("", connection, [(family, (str(address), port))]))
        self._wake()

    def found(self) -> list[tuple[Connection, Addresses | str]]:
        """What was found since the last call."""
        found = []
        while self._found:
            host, connection, answer = self._found.popleft()
            if host and not isinstance(answer, str):
                self._known[host] = (time.monotonic(), answer)
                while len(self._known) > MAX_KNOWN:
                    self._known.popitem(last=False)
            if connection is not None:
                found.append((connection, answer))
        return found

    def close(self) -> None:
        for _ in self._threads:
            self._asked.put(None)

    def _ask_name(self, host: str, port: int, connection: Connection) -> None:
        now = time.monotonic()
        asked_at, addresses = self._known.get(host, (now, None))
        if addresses is not None:
            self._known.move_to_end(host)
            self._found.append(("", connection, [(family, (a[0], port, *a[2:])) for family, a in addresses]))
            self._wake()
            if now - asked_at < REFRESH:
                return
            self._known[host] = (now, addresses)
        if len(self._threads) < RESOLVERS:
            # Daemons: a name server that never answers must not keep the process from ending.
            self._threads.append(threading.Thread(target=self._work, name="resolver", daemon=True))
            self._threads[-1].start()
        self._asked.put((host, port, None if addresses is not None else connection))

    def _work(self) -> None:
        while (question := self._asked.get()) is not None:
            host, port, connection = question
            if connection is not None and not connection._open:
                continue
            answer: Addresses | str
            try:
                answer = [(entry[0], entry[4]) for entry in socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)]
            except (OSError, UnicodeError) as error:
                why = error.strerror if isinstance(error, OSError) and error.strerror else "it is malformed"
                answer = f"the name {host} does not resolve ({why.lower()})"
            self._found.append((host, connection, answer))
            self._wake()


def _keep_alive(sock: socket.socket) -> None:
    """Notice within about two minutes that the other machine is gone."""
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for name, value in (("TCP_KEEPIDLE", 60), ("TCP_KEEPINTVL", 10), ("TCP_KEEPCNT", 6)):
        option = getattr(socket, name, None)
        if option is not None:
            sock.setsockopt(socket.IPPROTO_TCP, option, value)


def _reason(error: OSError) -> str:
    if error.errno in (errno.ECONNRESET, errno.EPIPE):
        return CLOSED
    if error.errno == errno.ECONNREFUSED:
        return "the connection was refused"
    return os.strerror(error.errno).lower() if error.errno else "the connection failed"
