"""One thread for each publisher: ask where it listens, connect, read; and again, later and later, when that ends."""

from __future__ import annotations

import socket
import threading
import time
from typing import TYPE_CHECKING, BinaryIO, Final

from rosbridge_eth.errors import SourceError
from rosbridge_eth.robot.sources.ros1 import api, tcpros
from rosbridge_eth.robot.sources.ros1.addressing import read_uri

if TYPE_CHECKING:
    from rosbridge_eth.robot.sources.ros1.source import Ros1Source

FIRST_RETRY: Final = 0.1
LAST_RETRY: Final = 10.0
"""Seconds between attempts to reach a publisher: doubled at each failure."""
STEADY: Final = 10.0
"""A connection that lasted so long was a good one: the next attempt is the first again."""
STALLED = 30.0
"""Seconds without a byte, within a message, after which a publisher is given up."""
FAILURES: Final = (SourceError, OSError, EOFError, UnicodeError)
"""What a peer can bring about: it says what is wrong, is gone or silent, or has a name that is none."""


class Publisher(threading.Thread):
    """Reads one publisher of one topic, again and again until it is closed; what comes of it, the node is told.

    kept: the master does not list it any more; it is over when its connection ends.
    """

    def __init__(self, node: Ros1Source, topic: str, uri: str) -> None:
        super().__init__(name=f"ros1 {topic}", daemon=True)
        self.topic, self.uri = topic, uri
        self.publication: tcpros.Publication | None = None
        self.kept = False
        self.over = threading.Event()
        self._node = node
        self._socket: socket.socket | None = None

    def close(self) -> None:
        """Without waiting: a name server that hangs may hold the thread for a while."""
        self.over.set()
        if (sock := self._socket) is not None:
            api.hang_up(sock)

    def run(self) -> None:
        failures = 0
        while not self.over.is_set():
            began = time.monotonic()
            try:
                self._connect()
            except FAILURES as error:
                self._node.ended(self, error)
            if self.kept:
                break
            failures = 0 if time.monotonic() - began >= STEADY else failures
            self.over.wait(min(LAST_RETRY, FIRST_RETRY * 2.0 ** min(failures, 16)))
            failures += 1
        self._node.gone(self)

    def _connect(self) -> None:
        node, topic = self._node, self.topic
        answer = api.call(
            read_uri(self.uri), node.timeout, "requestTopic", node.caller_id, topic, [["TCPROS"]]
        )
        with (
            socket.create_connection(api.tcpros_address(answer), node.timeout) as sock,
            sock.makefile("rb") as stream,
        ):
            _tune(sock)
            self._socket = sock
            if self.over.is_set():
                return
            sock.sendall(tcpros.request_header(topic, node.caller_id))
            publication = tcpros.read_publication(topic, tcpros.read_header(stream))
            node.admit(self, publication)
            self._read(sock, stream, publication)

    def _read(self, sock: socket.socket, stream: BinaryIO, publication: tcpros.Publication) -> None:
        node = self._node
        while True:
            sock.settimeout(None)  # between messages, silence is no fault
            length = tcpros.read_length(stream)
            sock.settimeout(STALLED)
            if length <= node.max_message:
                node.received(self.topic, publication, tcpros.read_exactly(stream, length))
            else:
                node.passed_over(self, length)
                tcpros.pass_over(stream, length)


def _tune(sock: socket.socket) -> None:
    """Without delay; notice within about two minutes that the other machine is gone."""
    sock.setsockopt(socket.IPPROTO_TCP, socket.TCP_NODELAY, 1)
    sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)
    for name, value in (("TCP_KEEPIDLE", 60), ("TCP_KEEPINTVL", 10), ("TCP_KEEPCNT", 6)):
        if (option := getattr(socket, name, None)) is not None:
            sock.setsockopt(socket.IPPROTO_TCP, option, value)
