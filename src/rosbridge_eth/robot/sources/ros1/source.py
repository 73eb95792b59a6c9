"""A live ROS 1 graph as a source: one thread that looks at the master and compares, and one for each publisher.

Every RESOLVE_EVERY, and when the master says that a topic's publishers have changed (publisherUpdate), the master's
state is looked at, and what is missing is done:

    a topic is wanted, and we are not among its subscribers    register, which answers with the publishers' APIs
    others publish it than at the last registration            register again, which is idempotent
    we are subscribed to a topic that is not wanted            unregister

So a master that was restarted is told again. Publishers do not register again at a restarted master: a connection is
kept until it ends or its topic is not wanted. When it has ended, there is a look at once, and it is made again if the
master lists the publisher; one that could not be made waits for the next look. Anyone may call our API, so nothing is
believed from there but that it is time to look.
"""

from __future__ import annotations

import contextlib
import logging
import os
import socket
import threading
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from itertools import count
from typing import Any, Final, TypeVar

from rosbridge_eth.capture import Decoder, RawMessage
from rosbridge_eth.config import Address
from rosbridge_eth.errors import SourceError
from rosbridge_eth.robot.sources.live import LiveSource
from rosbridge_eth.robot.sources.protocol import Clock, Emit, Offer, Selection
from rosbridge_eth.robot.sources.ros1 import api, tcpros

log = logging.getLogger(__name__)
_T = TypeVar("_T")

RESOLVE_EVERY: Final = 3.0
"""Seconds after which new topics and nodes are looked for."""
REST: Final = 0.1
"""Seconds between looks at the least, however often the master calls."""
FAREWELL: Final = 0.6
"""Seconds in which the master is told that we leave."""
STALLED = 30.0
"""Seconds without a byte, within a message, after which a publisher is given up."""


@dataclass
class _Topic:
    nodes: list[str] | None = None  # the publishers at the last registration; None: register at the next look
    listed: list[str] = field(default_factory=list)  # their APIs, as the master said then
    publishers: dict[str, Publisher] = field(default_factory=dict)  # by API


class Ros1Source(LiveSource):
    """The chosen topics of a master. It waits for a master that is not there yet; nothing is asked before `run`.

    master: URI; None is ROS_MASTER_URI. hostname: under which the master reaches us; None is ROS_HOSTNAME, ROS_IP or
    the address towards the master. node: our name; None is one of its own for each process.
    max_message: bytes. timeout: seconds for a call, and for a publisher's header.
    """

    kind = "ros1"

    def __init__(
        self, selection: Selection, clock: Clock | None = None, *, master: str | None = None,
        hostname: str | None = None, node: str | None = None, max_message: int = 32 << 20, timeout: float = 5.0,
    ) -> None:  # fmt: skip
        """Raises SourceError for a master's address that is none."""
        super().__init__(selection, clock)
        self.timeout, self._hostname = timeout, hostname
        self._master = api.master_address(master)
        self.caller_id = name = api.node_name(node)
        self._other_names = (f"{name}_{number}" for number in count(2))
        self.max_message = max_message
        self._topics: dict[str, _Topic] = {}
        self._rung = threading.Event()
        self._lock = threading.Lock()  # of the losses, which publishers' threads count
        self._uri = ""

    def offers(self) -> Sequence[Offer]:
        """What is published now, asked of the master. Raises SourceError."""
        try:
            publishers, *_ = self._call(api.system_state, "getSystemState")
            return api.offers(publishers, self._call(api.topic_types, "getTopicTypes"))
        except api.FAILURES as error:
            raise SourceError(f"the ROS master at {self._master} does not answer: {api.why(error)}") from None

    def close(self) -> None:
        """Let `run` come to its end, which tells the master."""
        self._stop.set()

    def run(self, emit: Emit, stop: threading.Event) -> None:
        self._emit, self._stop = emit, stop
        while (own := api.own_host(self._hostname, self._master)) is None:
            self._say("master", f"there is no way to the master at {self._master}; trying again")
            if stop.wait(RESOLVE_EVERY):
                return
        try:
            server = api.Server(api.bind_host(own), self._answer)
        except OSError as error:
            raise SourceError(f"our ROS node cannot listen for the master's calls: {error.strerror}") from None
        self._uri = f"http://{Address(own, server.server_address[1])}/"
        with contextlib.closing(server):
            try:
                while not stop.is_set():
                    self._look()
                    for _ in range(round(RESOLVE_EVERY / REST)):
                        if stop.wait(REST) or self._rung.is_set():
                            break
            finally:
                self._leave()

    def _leave(self) -> None:
        until = time.monotonic() + FAREWELL
        for topic in self._topics.values():
            for publisher in topic.publishers.values():
                publisher.close()
        with contextlib.suppress(*api.FAILURES):  # it will be noticed at the master's next look at us
            for name in self._topics:
                self._call(int, "unregisterSubscriber", name, self._uri, timeout=max(0.01, until - time.monotonic()))

    # The master

    def _call(
        self, read: Callable[[Any], _T], method: str, *parameters: str, timeout: float | None = None
    ) -> _T:
        return api.call(self._master, timeout or self.timeout, read, method, self.caller_id, *parameters)

    def _look(self) -> None:
        """Look at the master's state, and do what is missing."""
        self._rung.clear()
        try:
            publishers, subscribers, _ = self._call(api.system_state, "getSystemState")
            self._well_again("master")
            offers = api.offers(publishers, {})
            for text in self._selection.unmatched(offers):
                self._say(f"unmatched {text}", f"nothing publishes {text} yet; waiting for it")
            wanted = dict.fromkeys([*self._selection.named_topics,
                                    *(offer.topic for offer in self._selection.resolve(offers))])  # fmt: skip
            for name in self._topics.keys() - wanted:
                for publisher in self._topics.pop(name).publishers.values():
                    publisher.close()
            for name, nodes in subscribers.items():
                if self.caller_id in nodes and name not in wanted:
                    self._call(int, "unregisterSubscriber", name, self._uri)
            for name in wanted:
                topic, nodes = self._topics.setdefault(name, _Topic()), sorted(publishers.get(name, ()))
                if self.caller_id not in subscribers.get(name, ()) or topic.nodes != nodes:
                    self._register(name, topic, nodes)
        except api.FAILURES as error:
            why = api.why(error)
            self._say("master", f"the master does not answer as it should ({why}); asking every {RESOLVE_EVERY:g} s")

    def _register(self, name: str, topic: _Topic, nodes: list[str]) -> None:
        topic.nodes = nodes  # before the call: what the master calls for from now on counts
        try:
            topic.listed = self._call(api.strings, "registerSubscriber", name, tcpros.ANY, self._uri)
        except api.FAILURES as error:
            topic.nodes = None
            if not isinstance(error, api.Refusal):
                raise
            self._say(f"register {name}", f"the master does not take a subscription to {name}: {error}")
            return
        self._well_again(f"register {name}")
        topic.publishers = {uri: each for uri, each in topic.publishers.items() if not each.over.is_set()}
        for uri in topic.listed:
            if uri in topic.publishers or self._stop.is_set():
                continue
            publisher = topic.publishers[uri] = Publisher(self, topic, name, uri)
            publisher.start()

    def _answer(self, method: str, parameters: Sequence[Any]) -> list[Any]:
        """wiki.ros.org/ROS/Slave_API, for a node that only subscribes. KeyError for another method."""
        if method == "requestTopic":
            return [0, "this node publishes nothing", 0]
        if method == "publisherUpdate" and (topic := self._topics.get(str(parameters[1]))) is not None:
            topic.nodes = None
            self._rung.set()
        if method == "shutdown":  # by the master, when another node registers under our name; the bridge goes on
            self.caller_id = next(self._other_names)
            log.warning("another node has taken this one's name, or asked it to end: it goes on as %s", self.caller_id)
        answers = {
            "publisherUpdate": 0, "paramUpdate": 0, "shutdown": 0, "getPid": os.getpid(), "getName": self.caller_id,
            "getMasterUri": f"http://{self._master}/", "getPublications": [],
            "getSubscriptions": [[name, tcpros.ANY] for name in self._topics.copy()], "getBusInfo": [],
            "getBusStats": [[], [], []],
        }  # fmt: skip
        return [1, "", answers[method]]

    # What the publishers' threads tell

    def received(self, topic: str, decoder: Decoder, body: bytes) -> None:
        """A message is complete."""
        self._emit(RawMessage(topic, decoder.type_name, self._clock.wall_ns(), body, decoder))

    def passed_over(self, topic: str, length: int) -> None:
        """A message is not read."""
        with self._lock:
            self._losses[topic, "too_large"] += 1
        text = f"{topic}: a message of {length} bytes is left out; at most {self.max_message} bytes are read"
        self._say(f"too large {topic}", text)

    def ended(self, publisher: Publisher, error: Exception) -> None:
        """A connection was not made, or was lost, or was ended by us for what came."""
        if publisher.over.is_set():
            return
        publisher.over.set()
        publisher.topic.nodes = None  # it may have started again somewhere else
        text = f"{publisher.name}: the publisher at {publisher.uri[:200]}: {api.why(error)}"
        if publisher.connected and not isinstance(error, SourceError):
            log.info("%s", text)
            self._rung.set()
        else:
            self._say(f"publisher {publisher.name} {publisher.uri}", f"{text}; trying again")


class Publisher(threading.Thread):
    """Reads one publisher of one topic until the connection ends or is closed."""

    def __init__(self, node: Ros1Source, topic: _Topic, name: str, uri: str) -> None:
        super().__init__(name=name, daemon=True)
        self.topic, self.uri = topic, uri
        self.connected = False
        self.over = threading.Event()
        self._node = node
        self._socket: socket.socket | None = None

    def close(self) -> None:
        """Without waiting: a name server that hangs may hold the thread for a while."""
        self.over.set()
        if (sock := self._socket) is not None:
            with contextlib.suppress(OSError):
                sock.shutdown(socket.SHUT_RDWR)

    def run(self) -> None:
        try:
            self._read()
        except api.FAILURES as error:
            self._node.ended(self, error)

    def _read(self) -> None:
        """Ask it where it listens, connect, and read messages until it ends. Raises FAILURES."""
        node, asked = self._node, api.read_uri(self.uri)
        address = api.call(
            asked, node.timeout, api.tcpros_address, "requestTopic", node.caller_id, self.name, [["TCPROS"]]
        )
        with socket.create_connection(address, node.timeout) as sock, sock.makefile("rb") as stream:
            self._socket = sock
            if self.over.is_set():
                return
            sock.setsockopt(socket.SOL_SOCKET, socket.SO_KEEPALIVE, 1)  # a machine may go without a word
            sock.sendall(tcpros.request_header(self.name, node.caller_id))
            decoder = tcpros.read_decoder(tcpros.read_header(stream))
            self.connected = True
            log.info("%s: reading %s from %s", self.name, decoder.type_name, self.uri)
            while True:
                sock.settimeout(None)  # between messages, silence is no fault
                length = tcpros.read_length(stream)
                sock.settimeout(STALLED)
                if length <= node.max_message:
                    node.received(self.name, decoder, tcpros.read_exactly(stream, length))
                else:
                    node.passed_over(self.name, length)
                    tcpros.pass_over(stream, length)
