"""What goes wrong between a ROS 1 graph and us, by whose fault it is and what follows from it."""

from __future__ import annotations

from rosbridge_eth.errors import SourceError


class ProtocolError(SourceError):
    """The peer sent what TCPROS or XML-RPC does not allow, or more than is read. Its connection is closed."""


class Refusal(SourceError):
    """The peer answered in good order that it will not do what was asked, or cannot be recorded as it is."""
