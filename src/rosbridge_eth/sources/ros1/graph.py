"""What the master and a publisher's node answer, taken apart: each call's value or an error, never a surprise.

Every call of ROS's APIs answers [code, text, value]; code 1 is success
(wiki.ros.org/ROS/Master_Slave_APIs).
"""

from __future__ import annotations

from rosbridge_eth.capture import DefinitionError, normalised_type_name
from rosbridge_eth.sources.protocol import Offer
from rosbridge_eth.sources.ros1.addressing import Endpoint, is_graph_name, read_endpoint
from rosbridge_eth.sources.ros1.errors import ProtocolError, Refusal
from rosbridge_eth.sources.ros1.xmlrpc import Value

SUCCESS = 1
SHARED = frozenset({"/rosout"})
"""Topics that every node publishes: naming a node does not mean them."""
UNKNOWN_TYPE = "*"
"""A topic's type before anybody said it."""


def unwrap(answer: Value) -> Value:
    """The value of a successful answer. Raises Refusal or ProtocolError."""
    match answer:
        case [bool(), *_]:
            pass
        case [int(code), str(text), value]:
            if code != SUCCESS:
                raise Refusal(f"it answered {text[:200]!r}")
            return value
    raise ProtocolError("the answer is not [code, text, value]")


def publisher_uris(value: Value) -> list[str]:
    """Of registerSubscriber: the APIs of the topic's publishers, each once."""
    return list(dict.fromkeys(_strings(value)))


def system_state(value: Value) -> tuple[dict[str, list[str]], dict[str, list[str]]]:
    """Of getSystemState: the publishers and the subscribers, node names by topic."""
    match value:
        case [publishers, subscribers, _]:
            return _nodes_by_topic(publishers), _nodes_by_topic(subscribers)
    raise ProtocolError("the master's state is not [publishers, subscribers, services]")


def topic_types(value: Value) -> dict[str, str]:
    """Of getTopicTypes: type names by topic, in the form pkg/msg/Name; what is not a type's name is left out."""
    types: dict[str, str] = {}
    for pair in _items(value):
        match pair:
            case [str(topic), str(name)]:
                try:
                    types[topic] = normalised_type_name(name)
                except DefinitionError:
                    continue  # "*" for a topic that nobody has typed yet, or a hostile name: unknown either way
            case _:
                raise ProtocolError("the master's topic types are not [topic, type] pairs")
    return types


def offers(publishers: dict[str, list[str]], types: dict[str, str]) -> tuple[Offer, ...]:
    """What is published now, sorted by topic. A name that cannot be a topic's is left out."""
    return tuple(
        Offer(topic, types.get(topic, UNKNOWN_TYPE), () if topic in SHARED else tuple(sorted(set(nodes))))
        for topic, nodes in sorted(publishers.items())
        if is_graph_name(topic)
    )


def tcpros_endpoint(value: Value) -> Endpoint:
    """Of requestTopic: where the publisher listens."""
    match value:
        case ["TCPROS", host, port, *_]:
            return read_endpoint(host, port)
    raise ProtocolError("the publisher does not offer TCPROS")


def _items(value: Value) -> list[Value]:
    if not isinstance(value, list):
        raise ProtocolError("a list was expected in a ROS answer")
    return value


def _strings(value: Value) -> list[str]:
    found = [item for item in _items(value) if isinstance(item, str)]
    if len(found) != len(_items(value)):
        raise ProtocolError("a list of strings was expected in a ROS answer")
    return found


def _nodes_by_topic(value: Value) -> dict[str, list[str]]:
    nodes: dict[str, list[str]] = {}
    for pair in _items(value):
        match pair:
            case [str(topic), names]:
                nodes.setdefault(topic, []).extend(_strings(names))
            case _:
                raise ProtocolError("the master's state does not have [topic, nodes] pairs")
    return nodes
