"""A live ROS 1 graph, read with no ROS installed: own XML-RPC and TCPROS (wiki.ros.org/ROS/Technical Overview).

    addressing     environment variables, URIs, names
    http, xmlrpc   calls and answers as bytes
    graph          what the master's and publishers' answers mean
    framing        connection headers and messages as bytes
    publication    a publisher's header: its type and decoder; md5 checks one against the other
    subscriptions  what to ask and whom to be connected to: a machine without sockets
    loop, node     the sockets
    source         the Source

ROS 1 has no authentication: whoever reaches the network can publish. What is
promised is that no publisher, master or caller of our API can make the bridge
crash, wait, or use more memory than was set.
"""

from rosbridge_eth.sources.ros1.counters import Cause, TopicCounters
from rosbridge_eth.sources.ros1.source import Ros1Settings, Ros1Source

__all__ = ["Cause", "Ros1Settings", "Ros1Source", "TopicCounters"]
