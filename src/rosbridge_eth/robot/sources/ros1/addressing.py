"""Where the master is, how others reach us, and what we are called: ROS's environment variables and our own keys.

    ROS_MASTER_URI            http://HOST:PORT/ of the master; http://localhost:11311 without it
    ROS_HOSTNAME, ROS_IP      the name or address under which the master reaches us, in this order of preference

(wiki.ros.org/ROS/EnvironmentVariables.) Without the latter two, we give the
address that this machine uses towards the master; rospy gives the machine's
name, which others often cannot resolve.
"""

from __future__ import annotations

import ipaddress
import os
import re
import socket
from collections.abc import Mapping
from contextlib import suppress
from urllib.parse import urlsplit

from rosbridge_eth.config import Address
from rosbridge_eth.errors import SourceError

MASTER_PORT = 11311
MAX_URI = 512

_HOST = re.compile(r"[A-Za-z0-9_.\-]{1,253}|[0-9A-Fa-f:.]{2,45}", re.ASCII)
_GRAPH_NAME = re.compile(r"/[A-Za-z0-9_][A-Za-z0-9_/]{0,254}", re.ASCII)


class ProtocolError(SourceError):
    """The peer sent what TCPROS or XML-RPC does not allow, or more than is read. Its connection is closed."""


def read_uri(text: str, default_port: int | None = None) -> Address:
    """The address in an XML-RPC URI. Raises ProtocolError."""
    try:
        parts = urlsplit(text if len(text) <= MAX_URI else "")
        host, port = parts.hostname or "", parts.port or default_port
    except ValueError:
        raise ProtocolError(f"{text[:60]!r} is not a ROS URI") from None
    if parts.scheme != "http" or port is None:
        raise ProtocolError(f"{text[:60]!r} is not a ROS URI, such as http://192.0.2.7:11311/")
    return read_address(host, port)


def read_address(host: object, port: object) -> Address:
    """Host and port as a publisher gave them. Raises ProtocolError."""
    if not isinstance(host, str) or not _HOST.fullmatch(host):
        raise ProtocolError(f"{str(host)[:60]!r} is not a host")
    if type(port) is not int or not 0 < port < 65536:
        raise ProtocolError(f"{str(port)[:60]!r} is not a port")
    return Address(host, port)


def is_graph_name(name: object) -> bool:
    """Whether this can be the full name of a topic or node."""
    return isinstance(name, str) and _GRAPH_NAME.fullmatch(name) is not None


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
    with suppress(OSError, UnicodeError):  # a name that can be none, such as a..b, is UnicodeError
        for family, kind, protocol, _, address in socket.getaddrinfo(*master, type=socket.SOCK_DGRAM):
            with suppress(OSError), socket.socket(family, kind, protocol) as probe:
                probe.connect(address)  # sends nothing: it only has the kernel choose our address
                return str(probe.getsockname()[0])
    return None


def bind_host(host: str) -> str:
    """Where our server listens: on loopback alone if that is what we tell the master, otherwise everywhere."""
    try:
        address = ipaddress.ip_address("127.0.0.1" if host == "localhost" else host)
    except ValueError:
        return "0.0.0.0"  # noqa: S104 - a name may stand for any of our addresses
    if address.is_loopback:
        return str(address)
    return "::" if address.version == 6 else "0.0.0.0"  # noqa: S104 - as rospy: the master may be on any side


def node_name(configured: str | None) -> str:
    """The name that we register under. Anonymous unless configured, as `rosbag record` does it: two may run."""
    if configured is not None:
        return f"/{configured.removeprefix('/')}"
    machine = re.sub(r"[^A-Za-z0-9_]", "_", socket.gethostname())[:60]
    return f"/rosbridge_eth_{machine}_{os.getpid()}"
