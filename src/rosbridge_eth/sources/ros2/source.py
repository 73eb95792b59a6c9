"""A live ROS 2 graph, through the robot's own rclpy: any DDS or Zenoh middleware that it is set up with.

Messages are subscribed to as bytes and decoded by rosbags, as those of every other source: equal messages give equal
records. Every LOOK_EVERY the graph is read (from rclpy's own memory, microseconds): topics appear, publishers change
what they offer. A subscription stays for KEEP after the last publisher has gone, so that one that is restarted misses
nothing.

Where the middleware numbers messages and says who published them (Fast DDS on Kilted), losses are counted and a change
of subscription loses and repeats nothing.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Final

from rosbridge_eth.capture import Decoder, RawMessage, Wire, decoder_for
from rosbridge_eth.errors import SourceError
from rosbridge_eth.sources import live
from rosbridge_eth.sources.protocol import Clock, Offer, Selection
from rosbridge_eth.sources.ros2 import rclpy_parts as parts

log = logging.getLogger(__name__)

LOOK_EVERY: Final = 0.25
"""Seconds between looks at the graph: what a late topic publishes before is missed, unless it is latched."""
KEEP: Final = 300.0
"""Seconds that a subscription outlives the last publisher."""
AT_ONCE: Final = 32
"""Messages of one topic taken before the others get their turn."""
OVERLAP: Final = 1.0
"""Seconds that a subscription and the one that takes its place both run: publishers learn of a new one late."""
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
    quality: parts.Quality
    subscriptions: int = 0  # so far
    subscription: Any = None
    leaving: Any = None  # the subscription that `subscription` takes the place of
    leaves_at: float = 0.0
    type_hash: str | None = None
    publishers: frozenset[bytes] = frozenset()
    foreign: frozenset[bytes] = frozenset()
    last_seen: float = 0.0
    sequence: dict[bytes, int] = field(default_factory=dict)
    numbered: bool = False  # whether the middleware says publisher and number of a message


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
                self._join(offer, publishers.get(key, []), now)
        for key, topic in self._topics.items():
            found = publishers.get(key, [])
            self._know(topic, found)
            self._adapt(topic, found, now)

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

    def _join(self, offer: Offer, publishers: Sequence[Any], now: float) -> None:
        key = (offer.topic, offer.type_name)
        try:
            quality = parts.most_that_all_offer(map(parts.quality_of, publishers))
            decoder = decoder_for(Wire.CDR, offer.type_name, parts.definition_text(offer.type_name))
            topic = _Topic(offer, parts.message_class(offer.type_name), decoder, quality, last_seen=now)
            topic.subscription = self._subscribe(topic, quality)
        except SourceError as error:
            self._unusable.add(key)
            log.warning("%s is left out: %s", offer, error)
            return
        self._topics[key] = topic
        log.info("%s: watched (%s, %s)", offer.topic, offer.type_name, topic.quality)

    def _subscribe(self, topic: _Topic, quality: parts.Quality) -> Any:
        qos = self._rclpy.qos
        profile = qos.QoSProfile(
            depth=self._depth, history=qos.HistoryPolicy.KEEP_LAST,
            reliability=getattr(qos.ReliabilityPolicy, "RELIABLE" if quality.reliable else "BEST_EFFORT"),
            durability=getattr(qos.DurabilityPolicy, "TRANSIENT_LOCAL" if quality.latched else "VOLATILE"),
        )  # fmt: skip
        try:
            events = self._rclpy.SubscriptionEventCallbacks(
                incompatible_qos=self._incompatible, use_default_callbacks=False
            )
            return self._node.create_subscription(
                topic.generated, topic.offer.topic, self._callback(topic), profile, event_callbacks=events, raw=True
            )
        except (RuntimeError, ValueError, TypeError) as error:
            raise SourceError(f"it cannot be subscribed to: {parts.first_line(error)}") from error

    def _incompatible(self, event: Any) -> None:
        """A publisher has come that offers less than we ask for: look at once, not at the next turn."""
        self._look_now = True

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

    def _adapt(self, topic: _Topic, publishers: Sequence[Any], now: float) -> None:
        """Subscribe anew if the publishers offer more or less than is asked for.

        Where messages are numbered, nothing is lost or repeated by that: both
        subscriptions run for a while, and what both bring is taken once.
        """
        if topic.leaving is not None:
            if now >= topic.leaves_at:
                self._drain(topic)
                self._node.destroy_subscription(topic.leaving)
                topic.leaving = None
            return
        wanted = parts.most_that_all_offer(map(parts.quality_of, publishers))
        if not publishers or wanted == topic.quality:
            return
        if topic.numbered:
            topic.leaving, topic.leaves_at = topic.subscription, now + OVERLAP
        elif (topic.quality.reliable and not wanted.reliable) or (topic.quality.latched and not wanted.latched):
            self._node.destroy_subscription(topic.subscription)
        else:
            return  # asking for more would bring latched messages again, and nothing tells that they were seen
        topic.subscription, topic.quality = self._subscribe(topic, wanted), wanted
        log.info("%s: publishers changed, now watched as %s", topic.offer.topic, wanted)

    def _drain(self, topic: _Topic) -> None:
        """Take what the leaving subscription holds, which is older than what the new one brings."""
        while (waiting := parts.take(topic.leaving, topic.generated)) is not None:
            self._arrived(topic, *waiting)

    def _leave(self, topic: _Topic) -> None:
        for subscription in (topic.subscription, topic.leaving):
            if subscription is not None:
                self._node.destroy_subscription(subscription)
        log.info("%s: left", topic.offer.topic)

    def _callback(self, topic: _Topic) -> Callable[[bytes, Any], None]:
        topic.subscriptions += 1
        number = topic.subscriptions

        def arrived(raw: bytes, info: Any) -> None:
            current = number == topic.subscriptions
            if current and topic.leaving is not None:
                self._drain(topic)
            self._arrived(topic, raw, info)
            # What else waits is taken at once: a turn of the executor costs several times as much as a message.
            for _ in range(AT_ONCE if current else 0):
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
            topic.numbered = True
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
        why = "a larger depth in [source] may help" if topic.quality.reliable else "its publisher is best effort"
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
