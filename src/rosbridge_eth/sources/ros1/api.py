"""ROS 1's XML-RPC APIs (wiki.ros.org/ROS/Master_API, Slave_API, Master_Slave_APIs), with the standard library, bounded.

The peer may be anyone on the robot's network. So a call has a deadline as a whole, however its answer trickles in; a
body has an upper size; no document type is read, which is where entities that grow are declared. Every answer is
[code, text, value]; code 1 is success.
"""

from __future__ import annotations

import contextlib
import http.client
import socket
import threading
import time
import xmlrpc.client
from collections import deque
from collections.abc import Callable, Iterator, Sequence
from http.server import BaseHTTPRequestHandler, ThreadingHTTPServer
from typing import Any, Final
from xml.parsers.expat import ExpatError

from rosbridge_eth.capture import DefinitionError, normalised_type_name
from rosbridge_eth.config import Address
from rosbridge_eth.errors import SourceError
from rosbridge_eth.sources.protocol import Offer
from rosbridge_eth.sources.ros1.addressing import ProtocolError, is_graph_name, read_address

MASTER_ANSWER: Final = 4 << 20
"""Bytes of a master's answer; the state of a thousand topics and nodes has a few hundred thousand."""
PEER_BODY: Final = 1 << 20
"""Bytes of a publisher's answer, and of a call to us."""
MAX_CALLERS: Final = 64
"""Connections to our API at once; the oldest goes when one more comes."""
SHARED: Final = frozenset({"/rosout"})
"""Topics that every node publishes: naming a node does not mean them."""
UNKNOWN_TYPE: Final = "*"
"""A topic's type before anybody said it."""
_LOOK_EVERY: Final = 0.05
_LATE: Final = "it took too long"

NodesByTopic = dict[str, list[str]]


class Refusal(SourceError):
    """The peer answered in good order that it will not do what was asked, or cannot be recorded as it is."""


class Deadlines:
    """Ends what takes too long, by closing its socket: one thread for all that is under way."""

    def __init__(self) -> None:
        self._under_way: dict[socket.socket, float] = {}
        self._closed = threading.Event()
        threading.Thread(target=self._watch, name="ros1 deadlines", daemon=True).start()

    @contextlib.contextmanager
    def within(self, sock: socket.socket, seconds: float) -> Iterator[None]:
        """What is done with the socket meanwhile ends by then, with a TimeoutError."""
        deadline = self._under_way[sock] = time.monotonic() + seconds
        try:
            yield
        except (OSError, EOFError, SourceError, http.client.HTTPException):
            if time.monotonic() < deadline:
                raise
        finally:
            del self._under_way[sock]
        if time.monotonic() >= deadline:
            raise TimeoutError(_LATE)

    def close(self) -> None:
        self._closed.set()

    def _watch(self) -> None:
        while not self._closed.wait(_LOOK_EVERY):
            now = time.monotonic()
            for sock, deadline in self._under_way.copy().items():
                if now >= deadline:
                    hang_up(sock)


def hang_up(sock: socket.socket) -> None:
    """End the connection under whoever reads from it, in any thread."""
    with contextlib.suppress(OSError):
        sock.shutdown(socket.SHUT_RDWR)


def why(error: BaseException) -> str:
    """The reason of a failed connection in words."""
    if isinstance(error, socket.gaierror | UnicodeError):
        return "its name does not resolve"
    if isinstance(error, ConnectionRefusedError):
        return "the connection was refused"
    if isinstance(error, ConnectionError | http.client.HTTPException | EOFError):
        return "the connection was closed"
    if isinstance(error, TimeoutError):
        return _LATE if str(error) == _LATE else "it cannot be reached in time"
    return (error.strerror or "the connection failed").lower() if isinstance(error, OSError) else str(error)


def call(address: Address, deadlines: Deadlines, timeout: float, limit: int, method: str, *parameters: Any) -> Any:
    """The value of a successful answer. Raises Refusal, ProtocolError, or OSError if there is none in time.

    timeout: seconds to connect, and then for the call.
    """
    connection = http.client.HTTPConnection(*address, timeout=timeout)
    try:
        connection.connect()
        with deadlines.within(connection.sock, timeout):
            connection.request("POST", "/", xmlrpc.client.dumps(parameters, method), {"Content-Type": "text/xml"})
            response = connection.getresponse()
            body = response.read(limit + 1)
    except (http.client.HTTPException, UnicodeError) as error:
        raise ProtocolError(f"this is not HTTP: {type(error).__name__}") from None
    finally:
        connection.close()
    if response.status != 200:
        raise ProtocolError(f"HTTP status {response.status}")
    if len(body) > limit:
        raise ProtocolError(f"an answer of more than {limit} bytes is not read")
    try:
        values, _ = read_document(body)
    except xmlrpc.client.Fault as fault:
        raise Refusal(f"it answered with a fault: {str(fault.faultString)[:200]}") from None
    match values:
        case [[int(code), str(text), value]] if not isinstance(code, bool):
            if code != 1:
                raise Refusal(f"it answered {text[:200]!r}")
            return value
    raise ProtocolError("the answer is not [code, text, value]")


def read_document(body: bytes) -> tuple[Sequence[Any], str | None]:
    """The values of a call or answer, and the method of a call. Raises ProtocolError, or xmlrpc.client.Fault."""
    if b"<!" in body or b"\0" in body:
        raise ProtocolError("a document type in XML-RPC, or another encoding than UTF-8, is refused")
    try:
        return xmlrpc.client.loads(body, use_builtin_types=True)
    except xmlrpc.client.Fault:
        raise
    except (
        ExpatError, xmlrpc.client.Error, ArithmeticError, AttributeError, LookupError, TypeError, ValueError,
    ) as error:  # fmt: skip
        # What the standard library's reader runs into where tags are out of order.
        raise ProtocolError(f"this is not XML-RPC: {str(error)[:100]}") from None


class Server(ThreadingHTTPServer):
    """Our own API: every call goes to `answer(method, parameters)`, which raises KeyError for a method it has not."""

    daemon_threads = True
    block_on_close = False
    request_queue_size = 128

    def __init__(self, host: str, answer: Callable[[str, Sequence[Any]], Any], timeout: float) -> None:
        """Raises OSError."""
        self.answer, self._patience = answer, timeout
        self.address_family = socket.AF_INET6 if ":" in host else socket.AF_INET
        self._callers: deque[socket.socket] = deque()
        super().__init__((host, 0), _Call)
        threading.Thread(target=self.serve_forever, args=(_LOOK_EVERY,), name="ros1 api", daemon=True).start()

    def close(self) -> None:
        self.shutdown()
        self.server_close()

    def server_bind(self) -> None:
        """Without asking a name server for our own name."""
        self.socket.bind(self.server_address)
        self.server_address = self.socket.getsockname()

    def process_request(self, request: Any, client_address: Any) -> None:
        request.settimeout(self._patience)
        self._callers = deque(known for known in self._callers if known.fileno() >= 0)
        if len(self._callers) >= MAX_CALLERS:
            hang_up(self._callers.popleft())
        self._callers.append(request)
        super().process_request(request, client_address)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Nothing: the caller has gone, or was sent away."""


class _Call(BaseHTTPRequestHandler):
    server: Server

    def do_POST(self) -> None:
        length = self.headers.get("Content-Length", "")
        if not (length.isascii() and length.isdecimal() and len(length) < 9 and int(length) <= PEER_BODY):
            self.send_error(400)
            return
        try:
            parameters, method = read_document(self.rfile.read(int(length)))
            text = xmlrpc.client.dumps((self.server.answer(method or "", parameters),), methodresponse=True)
        except KeyError:
            text = xmlrpc.client.dumps(xmlrpc.client.Fault(1, "no such method"), methodresponse=True)
        except (ProtocolError, xmlrpc.client.Fault):
            self.send_error(400)
            return
        self.send_response(200)
        self.send_header("Content-Type", "text/xml")
        self.send_header("Content-Length", str(len(body := text.encode())))
        self.end_headers()
        self.wfile.write(body)

    def log_message(self, *_: object) -> None:
        """Nothing: whoever calls may do so as often as he likes."""


# What the answers mean


def system_state(value: Any) -> tuple[NodesByTopic, NodesByTopic]:
    """Of getSystemState: the publishers and the subscribers, node names by topic. Raises ProtocolError."""
    match value:
        case [publishers, subscribers, _]:
            return _nodes_by_topic(publishers), _nodes_by_topic(subscribers)
    raise ProtocolError("the master's state is not [publishers, subscribers, services]")


def offers(publishers: NodesByTopic, types: Any) -> tuple[Offer, ...]:
    """What is published now, sorted by topic, with the answer of getTopicTypes. A name that is none is left out."""
    known: dict[str, str] = {}
    for topic, name in _pairs(types):
        # "*" for a topic that nobody has typed yet, or a hostile name: unknown either way
        with contextlib.suppress(DefinitionError):
            known[topic] = normalised_type_name(str(name))
    return tuple(
        Offer(topic, known.get(topic, UNKNOWN_TYPE), () if topic in SHARED else tuple(sorted(set(nodes))))
        for topic, nodes in sorted(publishers.items())
        if is_graph_name(topic)
    )


def strings(value: Any) -> list[str]:
    """A list of strings, each once. Raises ProtocolError."""
    if not isinstance(value, list) or not all(isinstance(item, str) for item in value):
        raise ProtocolError("a list of strings was expected in a ROS answer")
    return list(dict.fromkeys(value))


def tcpros_address(value: Any) -> Address:
    """Of requestTopic: where the publisher listens. Raises ProtocolError."""
    match value:
        case ["TCPROS", host, port, *_]:
            return read_address(host, port)
    raise ProtocolError("the publisher does not offer TCPROS")


def _nodes_by_topic(value: Any) -> NodesByTopic:
    nodes: NodesByTopic = {}
    for topic, names in _pairs(value):
        nodes.setdefault(topic, []).extend(strings(names))
    return nodes


def _pairs(value: Any) -> Iterator[tuple[str, Any]]:
    for pair in value if isinstance(value, list) else [None]:
        match pair:
            case [str(topic), about]:
                yield topic, about
            case _:
                raise ProtocolError("what the master says of its topics are not pairs of a topic and something")
