"""A live ROS 1 graph as a source: one thread that looks at the master and compares, and one for each publisher.

Every RESOLVE_EVERY, and when the doorbell rings, the master's state is looked at, and what is missing is done:

    a topic is wanted and we do not stand there    register, which answers with the publishers' APIs
    others publish it than at the last look        register again, which is idempotent
    we stand at a topic that is not wanted         unregister
    we are missing at a topic we registered        the master has restarted
    our name has another API                       another node took it, and the master dropped us: take another name

The doorbell is publisherUpdate. Anyone may call our API, so nothing is believed from there but that it is time to look.
Publishers do not register again at a restarted master. So a connection that was there before is kept until it ends by
itself, although the new master does not list it. Whatever a peer does ends in its own connection being closed, counted,
said once, and tried again later.
"""

from __future__ import annotations

import contextlib
import logging
import os
import threading
import time
from collections.abc import Sequence
from dataclasses import dataclass, field
from typing import Any, Final

from rosbridge_eth.capture import RawMessage
from rosbridge_eth.config import Address
from rosbridge_eth.errors import SourceError
from rosbridge_eth.robot.sources.live import LiveSource
from rosbridge_eth.robot.sources.protocol import Clock, Offer, Selection
from rosbridge_eth.robot.sources.ros1 import addressing, api
from rosbridge_eth.robot.sources.ros1.addressing import ProtocolError
from rosbridge_eth.robot.sources.ros1.publisher import FAILURES, LAST_RETRY, Publisher
from rosbridge_eth.robot.sources.ros1.tcpros import ANY, Publication

log = logging.getLogger(__name__)

RESOLVE_EVERY: Final = 3.0
"""Seconds after which new topics and nodes are looked for."""
MAX_TOPICS: Final = 2048
"""Topics that are watched at once; a pattern may match more than was meant."""
MAX_CONNECTIONS: Final = 512
"""Connections to publishers at once: threads, and file descriptors, of which a process usually has 1,024."""
DOORBELL_REST: Final = 0.1
"""Seconds between looks at the least, however often the doorbell rings."""
FAREWELL: Final = 0.6
"""Seconds in which the master is told that we leave."""
STOP_PATIENCE: Final = 1.0


@dataclass
class _Topic:
    registered: bool = False
    rung: bool = False  # to be registered again at the next look
    not_before: float = 0.0  # when to try again after the master refused
    nodes: list[str] = field(default_factory=list)  # the publishers at the last registration
    publishers: dict[str, Publisher] = field(default_factory=dict)  # by API


class Ros1Source(LiveSource):
    """The chosen topics of a master. It waits for a master that is not there yet; nothing is asked before `run`.

    master: URI; None is ROS_MASTER_URI. hostname: under which the master reaches us; None is ROS_HOSTNAME, ROS_IP or
    the address towards the master. node: our name; None is one of its own for each process.
    max_message: bytes. waiting: messages. timeout: seconds for a call, and for a publisher's header.
    counts: messages received and too_large; publishers connected now; connections ended.
    """

    kind = "ros1"

    def __init__(
        self, selection: Selection, clock: Clock | None = None, *, master: str | None = None,
        hostname: str | None = None, node: str | None = None, max_message: int = 32 << 20, waiting: int = 4096,
        timeout: float = 5.0,
    ) -> None:  # fmt: skip
        """Raises SourceError for a master's address that is none."""
        super().__init__(selection, clock, waiting, 2 * max_message)
        self.timeout, self._hostname = timeout, hostname
        self._master = addressing.master_address(master)
        self.caller_id = self._base_name = addressing.node_name(node)
        self._renamed = 0
        self.max_message = max_message
        self._topics: dict[str, _Topic] = {}
        self._publishers: set[Publisher] = set()  # whose threads have not ended
        self._rung = threading.Event()
        self._uri = ""
        self._named = self._answers = self._looked = False

    def offers(self) -> Sequence[Offer]:
        """What is published now, asked of the master. Raises SourceError."""
        try:
            publishers, _ = api.system_state(self._call("getSystemState"))
            return api.offers(publishers, self._call("getTopicTypes"))
        except (ProtocolError, api.Refusal) as error:
            raise SourceError(f"the ROS master at {self._master} does not answer as it should: {error}") from None
        except OSError as error:
            raise SourceError(f"the ROS master at {self._master} does not answer: {api.why(error)}") from None

    def watch(self, selection: Selection) -> None:
        super().watch(selection)
        self._looked = False

    def close(self) -> None:
        """End within STOP_PATIENCE; the master is told."""
        self._ending.set()
        self._rung.set()
        if self._receiving.is_alive():
            self._receiving.join(STOP_PATIENCE)

    def _receive(self) -> None:
        while (own := addressing.own_host(self._hostname, self._master)) is None:
            self._say("master", f"there is no way to the master at {self._master}; trying again")
            if self._ending.wait(RESOLVE_EVERY):
                return
        try:
            server = api.Server(addressing.bind_host(own), self._answer, self.timeout)
        except OSError as error:
            raise SourceError(f"our ROS node cannot listen for the master's calls: {error.strerror}") from None
        self._uri = f"http://{Address(own, server.server_address[1])}/"
        with contextlib.closing(server):
            try:
                while not self._ending.is_set():
                    self._look()
                    self._ending.wait(DOORBELL_REST)
                    self._rung.wait(RESOLVE_EVERY)
            finally:
                self._leave()

    def _leave(self) -> None:
        with self._lock:
            registered = [name for name, topic in self._topics.items() if topic.registered]
            for publisher in self._publishers:
                publisher.close()
        until = time.monotonic() + FAREWELL
        with contextlib.suppress(*FAILURES):  # it will be noticed at the master's next look at us
            for name in registered if self._answers else ():
                self._call("unregisterSubscriber", name, self._uri, timeout=max(0.01, until - time.monotonic()))

    # The master

    def _call(self, method: str, *parameters: str, timeout: float | None = None) -> Any:
        return api.call(self._master, timeout or self.timeout, method, self.caller_id, *parameters)

    def _look(self) -> None:
        """Look at the master's state, and do what is missing."""
        self._rung.clear()
        try:
            self._check_name()
            publishers, subscribers = api.system_state(self._call("getSystemState"))
            self._answers = True
            self._say("master", None)
            wanted = self._wanted(api.offers(publishers, []))
            with self._lock:
                self._compare(wanted, subscribers)
            for name, nodes in subscribers.items():
                if self.caller_id in nodes and name not in wanted:
                    self._call("unregisterSubscriber", name, self._uri)
            for name in wanted:
                topic, nodes = self._topics[name], sorted(publishers.get(name, ()))
                missing = not topic.registered or topic.rung or topic.nodes != nodes
                if missing and time.monotonic() >= topic.not_before and not self._ending.is_set():
                    self._register(name, topic, nodes)
        except FAILURES as error:
            self._answers = False
            why = api.why(error)
            self._say("master", f"the master does not answer as it should ({why}); asking every {RESOLVE_EVERY:g} s")

    def _check_name(self) -> None:
        """Two nodes of one name would push each other out of the master in turn."""
        try:
            taken = self._call("lookupNode", self.caller_id) != self._uri
        except api.Refusal:
            return  # nobody has our name
        if taken and self._named:  # otherwise it is a dead one's, which we replace
            old, self._renamed, self._named = self.caller_id, self._renamed + 1, False
            new = self.caller_id = f"{self._base_name}_{self._renamed + 1}"
            self._say(f"name {new}", f"another node has registered as {old}; this one goes on as {new}")
            for topic in self._topics.values():
                topic.registered = False

    def _wanted(self, offers: Sequence[Offer]) -> list[str]:
        for text in () if self._looked else self._selection.unmatched(offers):
            self._say(f"unmatched {text}", f"nothing of the name {text} is published yet; waiting for it")
        self._looked = True
        matched = (offer.topic for offer in self._selection.resolve(offers))
        wanted = list(dict.fromkeys([*self._selection.named_topics, *matched]))
        if len(wanted) > MAX_TOPICS:
            self._say("topics", f"more than {MAX_TOPICS} topics match; {wanted[MAX_TOPICS]} and others are left out")
        return wanted[:MAX_TOPICS]

    def _compare(self, wanted: Sequence[str], subscribers: api.NodesByTopic) -> None:
        for name, topic in list(self._topics.items()):
            if topic.registered and self.caller_id not in subscribers.get(name, ()):  # the master has restarted
                topic.registered = self._named = False
                for publisher in topic.publishers.values():
                    publisher.kept = publisher.publication is not None
            if name not in wanted:
                self._close(topic, [uri for uri, publisher in topic.publishers.items() if not publisher.kept])
                topic.registered = False
                if not topic.publishers:
                    del self._topics[name]
        for name in wanted:
            self._topics.setdefault(name, _Topic())

    def _register(self, name: str, topic: _Topic, nodes: list[str]) -> None:
        topic.rung = False
        try:
            uris = api.strings(self._call("registerSubscriber", name, ANY, self._uri))
        except api.Refusal as error:
            self._say(f"register {name}", f"the master does not take a subscription to {name}: {error}")
            topic.not_before = time.monotonic() + LAST_RETRY
            return
        self._say(f"register {name}", None)
        self._named = True
        with self._lock:
            topic.registered, topic.nodes = True, nodes
            known = topic.publishers
            self._close(topic, [uri for uri, publisher in known.items() if uri not in uris and not publisher.kept])
            for uri in uris:
                if uri in known:
                    known[uri].kept = False
                elif len(self._publishers) >= MAX_CONNECTIONS:
                    self._say("room", f"more than {MAX_CONNECTIONS} publishers; some of {name} are left out")
                    topic.rung, topic.not_before = True, time.monotonic() + LAST_RETRY
                    break
                else:
                    publisher = known[uri] = Publisher(self, name, uri)
                    self._publishers.add(publisher)
                    publisher.start()

    def _close(self, topic: _Topic, uris: Sequence[str]) -> None:
        for uri in uris:
            topic.publishers.pop(uri).close()

    def _answer(self, method: str, parameters: Sequence[Any]) -> list[Any]:
        """wiki.ros.org/ROS/Slave_API, for a node that only subscribes. KeyError for another method."""
        if method == "publisherUpdate" and len(parameters) == 3:
            with self._lock:
                topic = self._topics.get(parameters[1]) if isinstance(parameters[1], str) else None
                if topic is not None:
                    topic.rung = True
                    self._rung.set()
        elif method == "shutdown":
            # Anyone may call this; what stops the bridge is its own service. That our name was taken shows at
            # the next look at the master's state.
            self._say("shutdown", "somebody on the ROS network asked this node to shut down; it goes on")
        elif method == "requestTopic":
            return [0, "this node publishes nothing", 0]
        with self._lock:
            subscriptions = [[name, self._type_of(topic)] for name, topic in self._topics.items()]
        answers = {
            "publisherUpdate": 0, "paramUpdate": 0, "shutdown": 0, "getPid": os.getpid(), "getName": self.caller_id,
            "getMasterUri": f"http://{self._master}/", "getPublications": [], "getSubscriptions": subscriptions,
            "getBusInfo": [], "getBusStats": [[], [], []],
        }  # fmt: skip
        return [1, "", answers[method]]

    def _type_of(self, topic: _Topic) -> str:
        found = (publisher.publication for publisher in topic.publishers.values())
        return next((each.type_name.replace("/msg/", "/") for each in found if each is not None), api.UNKNOWN_TYPE)

    # What the publishers' threads tell

    def admit(self, publisher: Publisher, publication: Publication) -> None:
        """One type for a topic at a time, as ROS has it: that of the publishers read from already. Raises Refusal."""
        with self._lock:
            for other in self._publishers:
                known = other.publication if other.topic == publisher.topic else None
                if known is not None and known.md5 != publication.md5:
                    raise api.Refusal(
                        f"{publication.node} publishes {publication.type_name} ({publication.md5}) where "
                        f"{known.node} publishes {known.type_name} ({known.md5})"
                    )
            publisher.publication = publication
            self.counts[publisher.topic, "connected"] += 1
        log.info("%s: reading %s from %s", publisher.topic, publication.type_name, publication.node or publisher.uri)

    def received(self, topic: str, publication: Publication, body: bytes) -> None:
        """A message is complete."""
        received_ns = self._clock.wall_ns()
        with self._lock:
            self.counts[topic, "received"] += 1
        self._backlog.put(RawMessage(topic, publication.type_name, received_ns, body, publication.decoder))

    def passed_over(self, publisher: Publisher, length: int) -> None:
        """A message is not read."""
        with self._lock:
            self.counts[publisher.topic, "too_large"] += 1
        self._say(
            f"too large {publisher.topic}",
            f"{publisher.topic}: a message of {length} bytes is left out; at most {self.max_message} bytes are read",
        )

    def ended(self, publisher: Publisher, error: Exception) -> None:
        """A connection was not made, or was lost, or was ended by us for what came."""
        with self._lock:
            connected, publisher.publication = publisher.publication is not None, None
            self.counts[publisher.topic, "connected"] -= connected
            if publisher.over.is_set():
                return
            self.counts[publisher.topic, "ended"] += 1
            if (topic := self._topics.get(publisher.topic)) is not None:
                topic.rung = True  # it may have started anew somewhere else
        text = f"{publisher.topic}: the publisher at {publisher.uri[:200]}: {api.why(error)}"
        if connected and not isinstance(error, SourceError):
            log.info("%s", text)
        else:
            key = f"publisher {publisher.topic} {publisher.uri}"
            self._say(key, f"{text}; trying again, further failures are counted")

    def gone(self, publisher: Publisher) -> None:
        """Its thread ends."""
        with self._lock:
            self._publishers.discard(publisher)
            topic = self._topics.get(publisher.topic)
            if topic is not None and topic.publishers.get(publisher.uri) is publisher:
                del topic.publishers[publisher.uri]
                topic.rung = True
