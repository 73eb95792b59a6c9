"""A live ROS 2 graph, through the robot's own rclpy: any DDS or Zenoh middleware that it is set up with.

Messages are subscribed to as bytes and decoded by rosbags, as those of every other source: equal messages give equal
records. Every LOOK_EVERY the graph is read (from rclpy's own memory, microseconds): topics appear, publishers change
what they offer. A subscription stays as long as its topic is wanted, so that a publisher that is restarted loses
nothing. It asks for the best that all publishers offer at its beginning (BEST_AVAILABLE); when one comes that offers
less, it is made again, and messages may be lost meanwhile.

Where the middleware numbers messages and says who published them (Fast DDS on Kilted), losses are counted and nothing
is taken twice.
"""

from __future__ import annotations

import logging
import threading
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

from rosbridge_eth.capture import Decoder, RawMessage, Wire, decoder_for
from rosbridge_eth.errors import SourceError
from rosbridge_eth.robot.sources.live import LiveSource
from rosbridge_eth.robot.sources.protocol import Clock, Emit, Offer, Selection
from rosbridge_eth.robot.sources.ros2 import rclpy_parts as parts

log = logging.getLogger(__name__)

LOOK_EVERY: Final = 0.25
"""Seconds between looks at the graph: what a late topic publishes before is missed, unless it is latched."""
AT_ONCE: Final = 32
"""Messages of one topic taken before the others get their turn."""
UNMATCHED_AFTER: Final = 5.0
"""Seconds that discovery has before names that nothing publishes are told."""
STOP_TIME: Final = 2.0
_SHARED: Final = frozenset({"/rosout", "/parameter_events"})
"""Topics that every node publishes; naming a node does not mean them."""


@dataclass
class _Topic:
    """A watched topic: its subscription and what is known of its publishers."""

    offer: Offer
    generated: Any
    decoder: Decoder
    subscription: Any = None
    refused: bool = False  # a publisher offers less than it asks for
    hash: str | None = None  # of the type, as it is installed here
    publishers: dict[bytes, bool] = field(default_factory=dict)  # by identity: whether its definition is another one
    last: dict[bytes, int] = field(default_factory=dict)  # by publisher: number of its newest message


class Ros2Source(LiveSource):
    """The watched topics of one ROS 2 graph. Its own rclpy context: no signal handler is set, no argument read.

    domain: ROS domain; None follows ROS_DOMAIN_ID. node: name of the node that the robot becomes, without namespace.
    depth: messages that the middleware keeps of each topic for us.
    lost: messages that did not reach this process (best effort, or faster than the queue of `depth` was emptied);
    foreign: of a publisher with another definition of the type.
    """

    kind = "ros2"

    def __init__(
        self, selection: Selection, clock: Clock | None = None, *,
        domain: int | None = None, node: str = "rosbridge_eth", depth: int = 256,
    ) -> None:  # fmt: skip
        """Joins the graph. Raises SourceError if rclpy is not there or cannot."""
        super().__init__(selection, clock)
        self._depth = depth
        self._topics: dict[tuple[str, str], _Topic] = {}
        self._unusable: set[tuple[str, str]] = set()
        self._look_now = False
        self._running = threading.Lock()
        self._rclpy = parts.import_rclpy()
        self._context = self._rclpy.Context()
        try:
            # No logging: rclpy would open files in the home of whoever runs the robot.
            self._context.init(args=[], initialize_logging=False, domain_id=domain)
            self._node = self._rclpy.Node(
                node, context=self._context, use_global_arguments=False, enable_rosout=False,
                start_parameter_services=False,
            )  # fmt: skip
            self._executor = self._rclpy.SingleThreadedExecutor(context=self._context)
            self._executor.add_node(self._node)
        except Exception as error:
            # rclpy has classes for bad names and domains and passes on what the middleware raises: an open set.
            self._context.try_shutdown()
            raise SourceError(f"the ROS 2 graph cannot be joined: {parts.first_line(error)}") from error
        self._name = self._node.get_fully_qualified_name()

    def offers(self) -> Sequence[Offer]:
        """The topics that somebody publishes now, without hidden ones. Discovery takes a second or two."""
        return self._read_graph()

    def close(self) -> None:
        """Leave the graph, when `run` has ended."""
        self._stop.set()
        self._executor.wake()
        with self._running:
            if self._context.ok():
                self._executor.shutdown(timeout_sec=STOP_TIME)
                self._node.destroy_node()
                self._context.try_shutdown()

    def run(self, emit: Emit, stop: threading.Event) -> None:
        """Emit what arrives. Raises SourceError."""
        self._emit, self._stop = emit, stop
        with self._running:
            self._spin()

    def _spin(self) -> None:
        try:
            due = began = self._now()
            while not self._stop.is_set():
                now = self._now()
                if now >= due or self._look_now:
                    self._look(tell=now - began > UNMATCHED_AFTER)
                    due = now + LOOK_EVERY
                self._executor.spin_once(timeout_sec=max(due - now, 0.0))
        except RuntimeError as error:
            raise SourceError(f"the ROS 2 graph was lost: {parts.first_line(error)}") from error

    def _now(self) -> float:
        return self._clock.monotonic_ns() / 1e9

    def _look(self, tell: bool) -> None:
        """Read the graph; subscribe to what has come, adapt to what has changed, leave what is wanted no more."""
        self._look_now = False
        offers = [*self._read_graph(only_wanted=True), *(topic.offer for topic in self._topics.values())]
        for text in self._selection.unmatched(offers) if tell else ():
            found = ", ".join(map(str, self._read_graph()[:20])) or "no topics"
            self._say(
                f"unmatched {text}",
                f"nothing publishes {text} yet; domain {self._context.get_domain_id()} has {found}. Check ROS_DOMAIN_ID"
                " and ROS_AUTOMATIC_DISCOVERY_RANGE",
            )
        wanted = {(offer.topic, offer.type_name): offer for offer in self._selection.resolve(offers)}
        for key in self._topics.keys() - wanted.keys():
            self._node.destroy_subscription(self._topics.pop(key).subscription)
        for key in wanted.keys() - self._topics.keys() - self._unusable:
            self._join(wanted[key])
        for topic in self._topics.values():
            self._know(topic)
            if topic.refused:
                self._node.destroy_subscription(topic.subscription)
                topic.subscription, topic.refused = self._subscribe(topic), False
                log.info("%s: publishers changed, watched again", topic.offer.topic)

    def _read_graph(self, only_wanted: bool = False) -> list[Offer]:
        """What is offered. only_wanted: leave out what no name or pattern of a topic means."""
        any_topic = not only_wanted or self._selection.names_nodes
        offers: list[Offer] = []
        for name, _ in sorted(self._node.get_topic_names_and_types()):
            hidden = any(part.startswith("_") for part in name.split("/"))
            if hidden and name not in self._selection.named_topics:
                continue
            if any_topic or self._selection.wants(Offer(name, "")):
                nodes: dict[str, set[str]] = {}
                for endpoint in self._node.get_publishers_info_by_topic(name):
                    if (node := parts.name_of(endpoint)) != self._name:
                        known = {node} if node and name not in _SHARED else set()
                        nodes[endpoint.topic_type] = nodes.get(endpoint.topic_type, set()) | known
                offers += [Offer(name, kind, tuple(sorted(found))) for kind, found in sorted(nodes.items())]
        return offers

    def _join(self, offer: Offer) -> None:
        try:
            decoder = decoder_for(Wire.CDR, offer.type_name, parts.definition_text(offer.type_name))
            topic = _Topic(offer, parts.message_class(offer.type_name), decoder)
            topic.subscription = self._subscribe(topic)
        except SourceError as error:
            self._unusable.add((offer.topic, offer.type_name))
            log.warning("%s is left out: %s", offer, error)
            return
        self._topics[offer.topic, offer.type_name] = topic
        log.info("%s: watched (%s)", offer.topic, offer.type_name)

    def _subscribe(self, topic: _Topic) -> Any:
        qos = self._rclpy.qos
        profile = qos.QoSProfile(
            depth=self._depth, history=qos.HistoryPolicy.KEEP_LAST,
            reliability=qos.ReliabilityPolicy.BEST_AVAILABLE, durability=qos.DurabilityPolicy.BEST_AVAILABLE,
        )  # fmt: skip

        def incompatible(event: Any) -> None:
            """A publisher has come that offers less than is asked for: look at once, not at the next turn."""
            topic.refused = self._look_now = True

        try:
            events = self._rclpy.SubscriptionEventCallbacks(incompatible_qos=incompatible, use_default_callbacks=False)
            return self._node.create_subscription(
                topic.generated, topic.offer.topic, self._callback(topic), profile, event_callbacks=events, raw=True
            )
        except (RuntimeError, ValueError, TypeError) as error:
            raise SourceError(f"it cannot be subscribed to: {parts.first_line(error)}") from error

    def _know(self, topic: _Topic) -> None:
        """Who publishes the topic now, and who of them with another definition of its type than is installed here."""
        name, kind = topic.offer.topic, topic.offer.type_name
        if topic.hash is None:  # that of our own subscription
            ours = self._node.get_subscriptions_info_by_topic(name)
            mine = (each for each in ours if parts.name_of(each) == self._name and each.topic_type == kind)
            topic.hash = next(map(parts.type_hash_of, mine), None)
        found = [each for each in self._node.get_publishers_info_by_topic(name) if each.topic_type == kind]
        known = (None, topic.hash)
        topic.publishers = {
            bytes(each.endpoint_gid): topic.hash is not None and parts.type_hash_of(each) not in known for each in found
        }
        for each in found:
            if topic.publishers[bytes(each.endpoint_gid)]:
                self._say(
                    f"foreign {name} {parts.type_hash_of(each)}",
                    f"{name}: {parts.name_of(each) or 'somebody'} publishes with another definition of {kind} than is"
                    " installed here; its messages are left out and counted. Build both from the same version of"
                    f" package {kind.partition('/')[0]}",
                )
        topic.last = {publisher: number for publisher, number in topic.last.items() if publisher in topic.publishers}

    def _callback(self, topic: _Topic) -> Callable[[bytes, Any], None]:
        def arrived(raw: bytes, info: Any) -> None:
            self._arrived(topic, raw, info)
            # What else waits is taken at once: a turn of the executor costs several times as much as a message.
            for _ in range(AT_ONCE):
                if (waiting := parts.take(topic.subscription, topic.generated)) is None:
                    break
                self._arrived(topic, *waiting)

        return arrived

    def _arrived(self, topic: _Topic, raw: bytes, info: Mapping[str, Any]) -> None:
        name, identity = topic.offer.topic, info.get("publisher_gid")
        publisher = bytes(identity["data"]) if identity else None
        if publisher is not None and publisher not in topic.publishers:
            # Somebody new, faster than our look at the graph: nothing of a foreign type may pass meanwhile.
            self._look_now = True
            self._know(topic)
        if any(topic.publishers.values()) if publisher is None else topic.publishers.get(publisher):
            self._losses[name, "foreign"] += 1
            return
        number = info.get("publication_sequence_number")
        if publisher is not None and number is not None:
            last = topic.last.get(publisher, number - 1)
            if number <= last and publisher in topic.last:
                return  # received before the subscription was made again
            topic.last[publisher] = number
            if number > last + 1:
                self._losses[name, "lost"] += (count := number - last - 1)
                self._say(
                    f"lost {name}",
                    f"{name}: messages were lost on their way here ({count} now, then counted); its publisher is best"
                    " effort, or a larger depth in [source] helps",
                )
        received_ns = info.get("received_timestamp") or self._clock.wall_ns()
        self._emit(RawMessage(name, topic.offer.type_name, received_ns, raw, topic.decoder))
