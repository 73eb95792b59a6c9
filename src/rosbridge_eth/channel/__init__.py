"""The secure channel between robot and server, over UDP, without a socket in it: docs/channel.md.

A robot's messages go up, in order; the server's state comes down, the newest one. `Client` and `Server` take datagrams
and the time, and give datagrams, events and the next time. `channel.udp` puts sockets under them.
"""

from rosbridge_eth.channel.admission import Address
from rosbridge_eth.channel.client import Client

from rosbridge_eth.channel.events import (  # isort: skip
    ClientConfig, Connected, Disconnected, End, Event, Full, HandshakeFailed, Message, ServerConfig, State, Unresolved,
)  # fmt: skip
from rosbridge_eth.channel.handshake import Randomness
from rosbridge_eth.channel.server import Server, cookie_key
from rosbridge_eth.channel.wire import MAX_STATE, Drop, Mode, Reason

__all__ = [
    "MAX_STATE", "Address", "Client", "ClientConfig", "Connected", "Disconnected", "Drop", "End", "Event", "Full",
    "HandshakeFailed", "Message", "Mode", "Randomness", "Reason", "Server", "ServerConfig", "State",
    "Unresolved", "cookie_key",
]  # fmt: skip
