"""ROS 1's XML-RPC APIs (wiki.ros.org/ROS/Master_API, Slave_API), with the standard library; addresses and names.

    ROS_MASTER_URI            http://HOST:PORT/ of the master; http://localhost:11311 without it
    ROS_HOSTNAME, ROS_IP      the name or address under which the master reaches us, in this order of preference

(wiki.ros.org/ROS/EnvironmentVariables.) Without the latter two, we give the address that this machine uses towards the
master; rospy gives the machine's name, which others often cannot resolve.

Every answer of an API is [code, text, value]; code 1 is success.
"""

from __future__ import annotations

import contextlib
import http.client
import os
import re
import socket
import threading
import xmlrpc.client
from collections.abc import Callable, Mapping, Sequence
from socketserver import ThreadingMixIn
from typing import Any, Final, TypeVar
from urllib.parse import urlsplit
from xml.parsers.expat import ExpatError
from xmlrpc.server import SimpleXMLRPCRequestHandler, SimpleXMLRPCServer

from rosbridge_eth.capture import DefinitionError, normalised_type_name
from rosbridge_eth.config import Address
from rosbridge_eth.errors import SourceError
from rosbridge_eth.robot.sources.protocol import Offer

MASTER_PORT: Final = 11311
SHARED: Final = frozenset({"/rosout"})
"""Topics that every node publishes: naming a node does not mean them."""
UNKNOWN_TYPE: Final = "*"
"""A topic's type before anybody said it."""

_HOST = re.compile(r"[A-Za-z0-9_.\-]{1,253}|[0-9A-Fa-f:.]{2,45}", re.ASCII)
_GRAPH_NAME = re.compile(r"/[A-Za-z0-9_][A-Za-z0-9_/]{0,254}", re.ASCII)
_T = TypeVar("_T")


class ProtocolError(SourceError):
    """The peer sent what TCPROS or XML-RPC does not allow, or more than is read. Its connection is closed."""


class Refusal(SourceError):
    """The peer answered correctly that it will not do what was asked, or cannot be recorded as it is."""


FAILURES: Final = (SourceError, OSError, EOFError, UnicodeError, OverflowError)
"""What a peer can bring about: it says what is wrong, is gone or silent, or has a name or a port that is none."""


def why(error: BaseException) -> str:
    """The reason of a failed connection in words."""
    if isinstance(error, OSError):
        return error.strerror or str(error) or "the connection failed"
    return str(error) or "the connection was closed"


# Addresses and names


def read_uri(text: str, default_port: int | None = None) -> Address:
    """The address in an XML-RPC URI. Raises ProtocolError."""
    with contextlib.suppress(ValueError):
        parts = urlsplit(text)
        port = parts.port or default_port
        if parts.scheme == "http" and port is not None and _HOST.fullmatch(parts.hostname or ""):
            return Address(str(parts.hostname), port)
    raise ProtocolError(f"{text[:60]!r} is not a ROS URI, such as http://192.0.2.7:11311/")


def master_address(configured: str | None, environment: Mapping[str, str] = os.environ) -> Address:
    """The master. Raises SourceError that says where the wrong value stands."""
    text = configured or environment.get("ROS_MASTER_URI") or f"http://localhost:{MASTER_PORT}"
    try:
        return read_uri(text, MASTER_PORT)
    except ProtocolError as error:
        where = "`master` of [source]" if configured else "the environment variable ROS_MASTER_URI"
        raise SourceError(f"{where} is wrong: {error}") from None


def own_host(configured: str | None, master: Address, environment: Mapping[str, str] = os.environ) -> str | None:
    """The name or address that we tell the master. Raises SourceError; may ask the resolver.

    None: there is no route to the master, or its name does not resolve, as on a robot whose network is not up yet.
    """
    text = configured or environment.get("ROS_HOSTNAME") or environment.get("ROS_IP")
    if text:
        if not _HOST.fullmatch(text):
            raise SourceError(f"{text!r} (`hostname` of [source], ROS_HOSTNAME or ROS_IP) is not a name or address")
        return text
    with contextlib.suppress(OSError, UnicodeError):  # a name that can be none, such as a..b, is UnicodeError
        for family, kind, protocol, _, address in socket.getaddrinfo(*master, type=socket.SOCK_DGRAM):
            with contextlib.suppress(OSError), socket.socket(family, kind, protocol) as probe:
                probe.connect(address)  # sends nothing: it only has the kernel choose our address
                return str(probe.getsockname()[0])
    return None


def bind_host(host: str) -> str:
    """Where our server listens: on loopback alone if that is what we tell the master, otherwise everywhere."""
    if host in ("localhost", "::1") or host.startswith("127."):
        return "127.0.0.1" if host == "localhost" else host
    return "::" if ":" in host else "0.0.0.0"  # noqa: S104 - as rospy: the master may be on any side


def node_name(configured: str | None) -> str:
    """The name that we register under. Anonymous unless configured, as `rosbag record` does it: two may run."""
    if configured is not None:
        return f"/{configured.removeprefix('/')}"
    machine = re.sub(r"[^A-Za-z0-9_]", "_", socket.gethostname())[:60]
    return f"/rosbridge_eth_{machine}_{os.getpid()}"


# Calls


class _Transport(xmlrpc.client.Transport):
    """One connection for each call; every step of it ends in so many seconds."""

    def __init__(self, timeout: float) -> None:
        super().__init__(use_builtin_types=True)
        self._timeout = timeout

    def make_connection(self, host: Any) -> http.client.HTTPConnection:
        return http.client.HTTPConnection(host, timeout=self._timeout)


def call(address: Address, timeout: float, read: Callable[[Any], _T], method: str, *parameters: Any) -> _T:
    """What `read` makes of the value of a successful answer; whatever it raises for another one is a ProtocolError.

    Raises Refusal, ProtocolError, or OSError if there is no answer in time (in seconds, for each step of the call).
    """
    try:
        with xmlrpc.client.ServerProxy(f"http://{address}/", _Transport(timeout)) as proxy:
            code, text, value = getattr(proxy, method)(*parameters)
        if code == 1:
            return read(value)
    except xmlrpc.client.Fault as fault:
        raise Refusal(f"it answered with a fault: {str(fault.faultString)[:200]}") from None
    except (
        http.client.HTTPException, ExpatError, xmlrpc.client.Error, ArithmeticError, AttributeError, LookupError,
        TypeError, ValueError,
    ) as error:  # fmt: skip
        # What the standard library's reader runs into where tags are out of order.
        raise ProtocolError(f"this is no answer of ROS: {type(error).__name__} {str(error)[:100]}") from None
    raise Refusal(f"it answered {str(text)[:200]!r}")


def system_state(value: Any) -> list[dict[str, list[str]]]:
    """Of getSystemState: the publishers, the subscribers and the services, node names by topic."""
    publishers, subscribers, services = value
    return [{str(name): strings(nodes) for name, nodes in each} for each in (publishers, subscribers, services)]


def offers(publishers: Mapping[str, list[str]], types: Mapping[str, str]) -> tuple[Offer, ...]:
    """What is published now, sorted by topic. A name that is none is left out; "*" stands for an unknown type."""
    found = []
    for topic, nodes in sorted(publishers.items()):
        known = UNKNOWN_TYPE
        with contextlib.suppress(DefinitionError):  # not typed yet
            known = normalised_type_name(types.get(topic, UNKNOWN_TYPE))
        if _GRAPH_NAME.fullmatch(topic):
            found.append(Offer(topic, known, () if topic in SHARED else tuple(sorted(set(nodes)))))
    return tuple(found)


def topic_types(value: Any) -> dict[str, str]:
    """Of getTopicTypes."""
    return {str(topic): str(name) for topic, name in value}


def strings(value: Any) -> list[str]:
    """A list of strings, each once."""
    return list(dict.fromkeys(map(str, value)))


def tcpros_address(value: Any) -> Address:
    """Of requestTopic: where the publisher listens."""
    protocol, host, port, *_ = value
    if protocol != "TCPROS":
        raise ProtocolError("the publisher does not offer TCPROS")
    return Address(str(host), int(port))


class _Calls(SimpleXMLRPCRequestHandler):
    timeout = 2.0
    """Seconds for each step of a call."""

    def log_message(self, format: str, *args: Any) -> None:
        """Nothing: what a caller does wrong is no event of ours."""


class Server(ThreadingMixIn, SimpleXMLRPCServer):
    """Our own API: every call goes to `answer(method, parameters)`, which raises KeyError for a method it has not."""

    daemon_threads = True
    block_on_close = False

    def __init__(self, host: str, answer: Callable[[str, Sequence[Any]], Any]) -> None:
        """Raises OSError."""
        self.address_family = socket.AF_INET6 if ":" in host else socket.AF_INET
        self._answer = answer
        super().__init__((host, 0), _Calls, logRequests=False, use_builtin_types=True)
        threading.Thread(target=self.serve_forever, args=(0.05,), name="ros1 api", daemon=True).start()

    def close(self) -> None:
        self.shutdown()
        self.server_close()

    def _dispatch(self, method: str, params: Any) -> Any:
        return self._answer(method, params)

    def handle_error(self, request: Any, client_address: Any) -> None:
        """Nothing: the caller has gone, or sent what is no call."""
