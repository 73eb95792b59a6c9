"""A live ROS 2 graph, through the robot's own rclpy: any DDS or Zenoh middleware that it is set up with.

Messages are subscribed to as bytes and decoded by rosbags, as those of every other source: equal messages give equal
records. Every LOOK_EVERY the graph is read (from rclpy's own memory, microseconds): topics appear, publishers change
what they offer. A subscription stays for KEEP after the last publisher has gone, so that one that is restarted misses
nothing. It asks for the best that all publishers offer at its beginning (BEST_AVAILABLE); when one comes that offers
less, it is made anew, in which messages may be lost.

Where the middleware numbers messages and says who published them (Fast DDS on Kilted), losses are counted and nothing
is taken twice.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

from rosbridge_eth.capture import Decoder, RawMessage, Wire, decoder_for
from rosbridge_eth.errors import SourceError
from rosbridge_eth.robot.sources import live
from rosbridge_eth.robot.sources.protocol import Clock, Offer, Selection
from rosbridge_eth.robot.sources.ros2 import rclpy_parts as parts

log = logging.getLogger(__name__)

LOOK_EVERY: Final = 0.25
"""Seconds between looks at the graph: what a late topic publishes before is missed, unless it is latched."""
KEEP: Final = 300.0
"""Seconds that a subscription outlives the last publisher."""
AT_ONCE: Final = 32
"""Messages of one topic taken before the others get their turn."""
UNMATCHED_AFTER: Final = 5.0
"""Seconds after which names that nothing publishes are told."""
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
    type_hash: str | None = None
    publishers: frozenset[bytes] = frozenset()
    foreign: frozenset[bytes] = frozenset()
    last_seen: float = 0.0
    sequence: dict[bytes, int] = field(default_factory=dict)


class Ros2Source(live.LiveSource):
    """The watched topics of one ROS 2 graph. Its own rclpy context: no signal handler is set, no argument read.

    domain: ROS domain; None follows ROS_DOMAIN_ID. node: name of the node that the robot becomes, without namespace.
    depth: messages that the middleware keeps of each topic for us.
    counts: messages received; lost, which did not reach this process (best effort, or faster than the queue of `depth`
    was emptied); foreign, of a publisher with another definition of the type.
    """

    kind = "ros2"

    def __init__(
        self, selection: Selection, clock: Clock | None = None, *,
        domain: int | None = None, node: str = "rosbridge_eth", depth: int = 256,
    ) -> None:  # fmt: skip
        """Joins the graph. Raises SourceError if rclpy is not there or cannot."""
        super().__init__(selection, clock, live.MESSAGES, live.SIZE)
        self._depth = depth
        self._topics: dict[tuple[str, str], _Topic] = {}
        self._unusable: set[tuple[str, str]] = set()
        self._look_now, self._complain_at = False, float("inf")
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
        self._open = True
        self._full_name = self._node.get_fully_qualified_name()

    def offers(self) -> Sequence[Offer]:
        """The topics that somebody publishes now, without hidden ones. Discovery takes a second or two."""
        return self._read_graph()[0]

    def watch(self, selection: Selection) -> None:
        super().watch(selection)
        self._complain_at = self._now() + UNMATCHED_AFTER

    def close(self) -> None:
        """Leave the graph."""
        self._ending.set()
        self._backlog.close()
        with self._lock:
            was_open, self._open = self._open, False
        if was_open:
            self._executor.wake()
            if self._receiving.is_alive():
                self._receiving.join(STOP_TIME)
            self._executor.shutdown(timeout_sec=STOP_TIME)
            self._node.destroy_node()
            self._context.try_shutdown()

    # The receiving thread

    def _receive(self) -> None:
        try:
            due = self._now()
            self._complain_at = due + UNMATCHED_AFTER
            while not self._ending.is_set():
                now = self._now()
                if now >= due or self._look_now:
                    self._look(now)
                    due = now + LOOK_EVERY
                if now >= self._complain_at:
                    self._tell_unmatched()
                    self._complain_at = float("inf")
                self._executor.spin_once(timeout_sec=max(due - now, 0.0))
        except RuntimeError as error:
            raise SourceError(f"the ROS 2 graph was lost: {parts.first_line(error)}") from error

    def _now(self) -> float:
        return self._clock.monotonic_ns() / 1e9

    def _look(self, now: float) -> None:
        """Read the graph; subscribe to what has come, adapt to what has changed, leave what is over."""
        self._look_now = False
        offers, publishers = self._read_graph(only_wanted=True)
        published = {(offer.topic, offer.type_name) for offer in offers}
        for key in published:
            if topic := self._topics.get(key):
                topic.last_seen = now
        known = self._topics.items()
        waiting = [topic.offer for key, topic in known if key not in published and now - topic.last_seen < KEEP]
        wanted = {(offer.topic, offer.type_name): offer for offer in self._selection.resolve([*offers, *waiting])}
        for key in self._topics.keys() - wanted.keys():
            self._leave(self._topics.pop(key))
        for key, offer in wanted.items():
            if key not in self._topics and key not in self._unusable:
                self._join(offer, now)
        for key, topic in self._topics.items():
            self._know(topic, publishers.get(key, []))
            if topic.refused:
                self._node.destroy_subscription(topic.subscription)
                topic.subscription, topic.refused = self._subscribe(topic), False
                log.info("%s: publishers changed, watched anew", topic.offer.topic)

    def _read_graph(self, only_wanted: bool = False) -> tuple[list[Offer], dict[tuple[str, str], list[Any]]]:
        """What is offered, and by which endpoints. only_wanted: leave out what no name or pattern of a topic means."""
        any_topic = not only_wanted or self._selection.names_nodes
        offers: list[Offer] = []
        publishers: dict[tuple[str, str], list[Any]] = {}
        for name, _ in sorted(self._node.get_topic_names_and_types()):
            if any(part.startswith("_") for part in name.split("/")) and name not in self._selection.named_topics:
                continue
            if not (any_topic or self._selection.wants(Offer(name, ""))):
                continue
            nodes: dict[str, set[str]] = {}
            for endpoint in self._node.get_publishers_info_by_topic(name):
                node = parts.name_of(endpoint)
                if node == self._full_name:
                    continue
                found = nodes.setdefault(endpoint.topic_type, set())
                if node is not None and name not in _SHARED:
                    found.add(node)
                publishers.setdefault((name, endpoint.topic_type), []).append(endpoint)
            offers += [Offer(name, kind, tuple(sorted(found))) for kind, found in sorted(nodes.items())]
        return offers, publishers

    def _join(self, offer: Offer, now: float) -> None:
        key = (offer.topic, offer.type_name)
        try:
            decoder = decoder_for(Wire.CDR, offer.type_name, parts.definition_text(offer.type_name))
            topic = _Topic(offer, parts.message_class(offer.type_name), decoder, last_seen=now)
            topic.subscription = self._subscribe(topic)
        except SourceError as error:
            self._unusable.add(key)
            log.warning("%s is left out: %s", offer, error)
            return
        self._topics[key] = topic
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

    def _know(self, topic: _Topic, publishers: Sequence[Any]) -> None:
        """Who publishes the topic now, and who of them with another definition of its type."""
        if topic.type_hash is None:
            # As it is installed here, which our own subscription advertises.
            ours = self._node.get_subscriptions_info_by_topic(topic.offer.topic)
            mine = (each for each in ours if parts.name_of(each) == self._full_name)
            hashes = (parts.type_hash_of(each) for each in mine if each.topic_type == topic.offer.type_name)
            topic.type_hash = next(hashes, None)
        present = {bytes(endpoint.endpoint_gid): endpoint for endpoint in publishers}
        topic.publishers = frozenset(present)
        known = (None, topic.type_hash)
        foreign = [] if topic.type_hash is None else [
            gid for gid, endpoint in present.items() if parts.type_hash_of(endpoint) not in known
        ]
        for gid in foreign:
            self._tell_foreign(topic.offer, present[gid])
        topic.foreign = frozenset(foreign)
        for gone in topic.sequence.keys() - present.keys():
            del topic.sequence[gone]

    def _leave(self, topic: _Topic) -> None:
        self._node.destroy_subscription(topic.subscription)
        log.info("%s: left", topic.offer.topic)

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
        identity = info.get("publisher_gid")
        publisher = bytes(identity["data"]) if identity else None
        if publisher is not None and publisher not in topic.publishers:
            # Somebody new, faster than our look at the graph: nothing of a foreign type may pass meanwhile.
            offer, self._look_now = topic.offer, True
            found = self._node.get_publishers_info_by_topic(offer.topic)
            self._know(topic, [endpoint for endpoint in found if endpoint.topic_type == offer.type_name])
        if topic.foreign and (publisher is None or publisher in topic.foreign):
            self.counts[topic.offer.topic, "foreign"] += 1
            return
        number = info.get("publication_sequence_number")
        if publisher is not None and number is not None:
            last = topic.sequence.get(publisher)
            if last is not None and number <= last:
                return  # received before the subscription was changed
            topic.sequence[publisher] = number
            if last is not None and number > last + 1:
                self._tell_lost(topic, number - last - 1)
        self.counts[topic.offer.topic, "received"] += 1
        received_ns = info.get("received_timestamp") or self._clock.wall_ns()
        self._backlog.put(RawMessage(topic.offer.topic, topic.offer.type_name, received_ns, raw, topic.decoder))

    # What a person is told, once

    def _tell_lost(self, topic: _Topic, count: int) -> None:
        name = topic.offer.topic
        self.counts[name, "lost"] += count
        why = "its publisher is best effort, or a larger depth in [source] helps"
        text = f"{name}: messages were lost on their way here ({count} now, then counted); {why}"
        self._say(f"lost {name}", text)

    def _tell_foreign(self, offer: Offer, endpoint: Any) -> None:
        self._say(
            f"foreign {offer.topic} {parts.type_hash_of(endpoint)}",
            f"{offer.topic}: {parts.name_of(endpoint) or 'somebody'} publishes with another definition of "
            f"{offer.type_name} than is installed here; its messages are left out and counted. Build both from the "
            f"same version of package {offer.type_name.partition('/')[0]}",
        )

    def _tell_unmatched(self) -> None:
        offers = self._read_graph()[0]
        missing = self._selection.unmatched([*offers, *(topic.offer for topic in self._topics.values())])
        if missing:
            log.warning(
                "nothing publishes %s yet; domain %d has %s. Check ROS_DOMAIN_ID and ROS_AUTOMATIC_DISCOVERY_RANGE",
                ", ".join(missing), self._context.get_domain_id(), ", ".join(map(str, offers[:20])) or "no topics",
            )
