"""ROS 1's XML-RPC APIs (wiki.ros.org/ROS/Master_API, Slave_API, Master_Slave_APIs), with the standard library.

Every answer is [code, text, value]; code 1 is success. Each step of a call has a timeout. What a peer answers may be
anything, and ends in a value or an error; a network of ROS 1, on which anybody may publish anything, is not defended
against slow or endless answers.
"""

from __future__ import annotations

import contextlib
import http.client
import socket
import threading
import xmlrpc.client
from collections.abc import Callable, Iterator, Sequence
from socketserver import ThreadingMixIn
from typing import Any, Final
from xml.parsers.expat import ExpatError
from xmlrpc.server import SimpleXMLRPCRequestHandler, SimpleXMLRPCServer

from rosbridge_eth.capture import DefinitionError, normalised_type_name
from rosbridge_eth.config import Address
from rosbridge_eth.errors import SourceError
from rosbridge_eth.robot.sources.protocol import Offer
from rosbridge_eth.robot.sources.ros1.addressing import ProtocolError, is_graph_name, read_address

SHARED: Final = frozenset({"/rosout"})
"""Topics that every node publishes: naming a node does not mean them."""
UNKNOWN_TYPE: Final = "*"
"""A topic's type before anybody said it."""
_LOOK_EVERY: Final = 0.05

NodesByTopic = dict[str, list[str]]


class Refusal(SourceError):
    """The peer answered in good order that it will not do what was asked, or cannot be recorded as it is."""


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
        return "it does not answer in time"
    return (error.strerror or "the connection failed").lower() if isinstance(error, OSError) else str(error)


class _Transport(xmlrpc.client.Transport):
    """One connection for each call; every step of it ends in so many seconds."""

    def __init__(self, timeout: float) -> None:
        super().__init__(use_builtin_types=True)
        self._timeout = timeout

    def make_connection(self, host: Any) -> http.client.HTTPConnection:
        return http.client.HTTPConnection(host, timeout=self._timeout)


def call(address: Address, timeout: float, method: str, *parameters: Any) -> Any:
    """The value of a successful answer. Raises Refusal, ProtocolError, or OSError if there is none in time.

    timeout: seconds to connect, and for each step of the call.
    """
    try:
        with xmlrpc.client.ServerProxy(f"http://{address}/", _Transport(timeout)) as proxy:
            answer = getattr(proxy, method)(*parameters)
    except xmlrpc.client.Fault as fault:
        raise Refusal(f"it answered with a fault: {str(fault.faultString)[:200]}") from None
    except (
        http.client.HTTPException, ExpatError, xmlrpc.client.Error, ArithmeticError, AttributeError, LookupError,
        TypeError, ValueError,
    ) as error:  # fmt: skip
        # What the standard library's reader runs into where tags are out of order.
        raise ProtocolError(f"this is not XML-RPC: {type(error).__name__} {str(error)[:100]}") from None
    match answer:
        case [int(code), str(text), value] if not isinstance(code, bool):
            if code != 1:
                raise Refusal(f"it answered {text[:200]!r}")
            return value
    raise ProtocolError("the answer is not [code, text, value]")


class _Calls(SimpleXMLRPCRequestHandler):
    rpc_paths = ()  # any


class Server(ThreadingMixIn, SimpleXMLRPCServer):
    """Our own API: every call goes to `answer(method, parameters)`, which raises KeyError for a method it has not."""

    daemon_threads = True
    block_on_close = False
    request_queue_size = 128

    def __init__(self, host: str, answer: Callable[[str, Sequence[Any]], Any], timeout: float) -> None:
        """Raises OSError. timeout: seconds for each step of a call."""
        self.address_family = socket.AF_INET6 if ":" in host else socket.AF_INET
        self._answer, self._patience = answer, timeout
        super().__init__((host, 0), _Calls, logRequests=False, use_builtin_types=True)
        threading.Thread(target=self.serve_forever, args=(_LOOK_EVERY,), name="ros1 api", daemon=True).start()

    def close(self) -> None:
        self.shutdown()
        self.server_close()

    def process_request(self, request: Any, client_address: Any) -> None:
        request.settimeout(self._patience)
        super().process_request(request, client_address)

    def _dispatch(self, method: str, params: Any) -> Any:
        return self._answer(method, params)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Nothing: the caller has gone, or sent what is no call."""


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
