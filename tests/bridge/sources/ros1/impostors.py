"""Peers for the source that say whatever a test wants: a master, and publishers that need not keep to any protocol."""

from __future__ import annotations

import contextlib
import socket
import struct
import threading
import time
from collections.abc import Callable, Iterator, Mapping
from xmlrpc.server import SimpleXMLRPCRequestHandler, SimpleXMLRPCServer

from rosbridge_eth.robot.sources.ros1.tcpros import encode_header

Conversation = Callable[[socket.socket], None]

UINT64_MD5 = "1b2a79973e8bf53d7b53acb71299cb57"
GOOD = {"callerid": "/impostor", "latching": "0", "md5sum": UINT64_MD5, "message_definition": "uint64 data",
        "type": "std_msgs/UInt64"}  # fmt: skip


def numbered(value: int) -> bytes:
    return struct.pack("<IQ", 8, value)


class Master:
    """The master's API with publishers that a test names; who has subscribed is noted."""

    def __init__(self) -> None:
        self.publishers: dict[str, list[str]] = {}
        self.types: dict[str, str] = {}
        self.apis: dict[str, str] = {}
        self.registered: dict[str, set[str]] = {}
        self.hanging = False
        self._released = threading.Event()
        self._server = SimpleXMLRPCServer(
            ("127.0.0.1", 0), requestHandler=SimpleXMLRPCRequestHandler, logRequests=False
        )
        self._server.register_instance(self)
        self.uri = f"http://127.0.0.1:{self._server.server_address[1]}"
        self._thread = threading.Thread(target=self._server.serve_forever, args=(0.05,), daemon=True)
        self._thread.start()

    def registerSubscriber(self, node: str, topic: str, _type: str, api: str) -> list:
        if self.hanging:
            self._released.wait(60)
        self.apis[node] = api
        self.registered.setdefault(topic, set()).add(node)
        return [1, "", self.publishers.get(topic, [])]

    def unregisterSubscriber(self, node: str, topic: str, _api: str) -> list:
        self.registered.get(topic, set()).discard(node)
        return [1, "", 1]

    def getSystemState(self, _node: str) -> list:
        state = [[topic, [f"/n{n}" for n in range(len(uris))]] for topic, uris in self.publishers.items()]
        return [1, "", [state, [[topic, sorted(nodes)] for topic, nodes in self.registered.items()], []]]

    def getTopicTypes(self, _node: str) -> list:
        return [1, "", [list(pair) for pair in self.types.items()]]

    def lookupNode(self, _node: str, name: str) -> list:
        return [1, "", self.apis[name]] if name in self.apis else [-1, "unknown node", ""]

    def close(self) -> None:
        self._released.set()
        self._server.shutdown()
        self._server.server_close()


class Peer:
    """Listens, and holds a conversation with everyone who connects, in a thread each."""

    def __init__(self, conversation: Conversation) -> None:
        self.connections = 0
        self._conversation = conversation
        self._listener = socket.create_server(("127.0.0.1", 0))
        self.port: int = self._listener.getsockname()[1]
        self.uri = f"http://127.0.0.1:{self.port}"
        threading.Thread(target=self._accept, daemon=True).start()

    def _accept(self) -> None:
        with contextlib.suppress(OSError):
            while True:
                connection, _ = self._listener.accept()
                self.connections += 1
                threading.Thread(target=self._hold, args=(connection,), daemon=True).start()

    def _hold(self, connection: socket.socket) -> None:
        with connection, contextlib.suppress(OSError):
            connection.settimeout(30)
            self._conversation(connection)

    def close(self) -> None:
        with contextlib.suppress(OSError):
            self._listener.shutdown(socket.SHUT_RDWR)
        self._listener.close()


def answering(body: bytes) -> Conversation:
    """An HTTP server that gives one answer to everything."""

    def conversation(connection: socket.socket) -> None:
        connection.recv(65536)
        connection.sendall(b"HTTP/1.0 200 OK\r\nContent-Length: %d\r\n\r\n" % len(body) + body)
        while connection.recv(65536):  # as in `saying`
            pass

    return conversation


def saying(data: bytes, *, then_stay: bool = False) -> Conversation:
    """Says that, whatever it hears, and leaves or stays."""

    def conversation(connection: socket.socket) -> None:
        connection.recv(65536)
        connection.sendall(data)
        if not then_stay:
            connection.shutdown(socket.SHUT_WR)
        # Closed with something unread, the connection would be reset, and what was said might never arrive.
        while connection.recv(65536):
            pass

    return conversation


def dribbling(chunk: bytes, pause: float) -> Conversation:
    """Says a little now and then, without end."""

    def conversation(connection: socket.socket) -> None:
        while True:
            connection.sendall(chunk)
            time.sleep(pause)

    return conversation


def flooding(head: bytes, chunk: bytes) -> Conversation:
    """Says as much as is taken, without end."""

    def conversation(connection: socket.socket) -> None:
        connection.sendall(head)
        while True:
            connection.sendall(chunk)

    return conversation


def counting(fields: Mapping[str, str], rate: float = 200.0) -> Conversation:
    """An honest publisher of numbers."""

    def conversation(connection: socket.socket) -> None:
        connection.recv(65536)
        connection.sendall(encode_header(fields))
        value = 0
        while True:
            connection.sendall(numbered(value))
            value += 1
            time.sleep(1 / rate)

    return conversation


class Publisher:
    """A node that answers requestTopic with the port of a conversation."""

    def __init__(self, conversation: Conversation) -> None:
        self.data = Peer(conversation)
        answer = (
            "<?xml version='1.0'?><methodResponse><params><param><value><array><data><value><int>1</int></value>"
            "<value></value><value><array><data><value>TCPROS</value><value>127.0.0.1</value><value><int>"
            f"{self.data.port}</int></value></data></array></value></data></array></value></param></params>"
            "</methodResponse>"
        )
        self.api = Peer(answering(answer.encode()))
        self.uri = self.api.uri

    def close(self) -> None:
        self.data.close()
        self.api.close()


@contextlib.contextmanager
def closing_all(*things: object) -> Iterator[None]:
    try:
        yield
    finally:
        for thing in things:
            thing.close()  # type: ignore[attr-defined]
