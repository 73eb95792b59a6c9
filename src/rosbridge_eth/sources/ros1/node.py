"""Our node in the ROS graph: calls to the master, our own API, and a connection to each publisher. One thread.

What to do comes from `subscriptions`, what bytes mean from `xmlrpc`, `http`,
`framing` and `publication`; here they meet the sockets. Whatever a peer does
ends in its own connection being closed, counted, said once, and tried again later.
"""

from __future__ import annotations

import logging
import os
import threading
import time
from collections.abc import Callable
from dataclasses import dataclass

from rosbridge_eth.capture import RawMessage
from rosbridge_eth.errors import SourceError
from rosbridge_eth.sources.backlog import Backlog
from rosbridge_eth.sources.protocol import Clock, Offer
from rosbridge_eth.sources.ros1.addressing import Endpoint, bind_host, own_host, read_uri, uri_of
from rosbridge_eth.sources.ros1.counters import Cause, TopicCounters
from rosbridge_eth.sources.ros1.errors import ProtocolError, Refusal
from rosbridge_eth.sources.ros1.framing import Framer, Header, Message, PassedOver, encode_header
from rosbridge_eth.sources.ros1.graph import offers, system_state, tcpros_endpoint, topic_types, unwrap
from rosbridge_eth.sources.ros1.http import BodyReader, encode_request, encode_response
from rosbridge_eth.sources.ros1.loop import CLOSED, Connection, Ended, Loop, Received
from rosbridge_eth.sources.ros1.publication import Publication, read_publication, request_header
from rosbridge_eth.sources.ros1.subscriptions import Connect, Disconnect, MasterCall, Say, Subscriptions
from rosbridge_eth.sources.ros1.xmlrpc import (
    Value,
    decode_answer,
    decode_call,
    encode_answer,
    encode_call,
    encode_fault,
)
from rosbridge_eth.sources.selection import RESOLVE_EVERY, Selection

log = logging.getLogger(__name__)

MASTER_ANSWER = 16 << 20
"""Bytes of a master's answer; the state of a thousand topics and nodes has a few hundred thousand."""
PEER_BODY = 1 << 20
"""Bytes of a publisher's answer, and of a call to us."""
STALLED = 30.0
"""Seconds that a publisher may fall silent in the middle of a message."""
FAREWELL = 0.6
"""Seconds in which the master is told that we leave."""
MAX_SAID = 2048
"""Things remembered as said."""


class RemoteCall:
    """One XML-RPC call on a connection of its own: an answer or a reason, within the deadline."""

    def __init__(
        self,
        loop: Loop,
        endpoint: Endpoint,
        body: bytes,
        answered: Callable[[Value], None],
        failed: Callable[[Exception], None],
        *,
        limit: int,
        timeout: float,
    ) -> None:
        self._answered, self._failed = answered, failed
        self._reader = BodyReader(request=False, limit=limit)
        self._connection = loop.connect(*endpoint, self._received, self._ended, time.monotonic() + timeout)
        self._connection.send(encode_request(*endpoint, "/", body))

    def close(self) -> None:
        self._connection.close()

    def _received(self, data: memoryview) -> None:
        try:
            body = self._reader.feed(data)
        except ProtocolError as error:
            self._connection.close()
            self._failed(error)
            return
        if body is not None:
            self._connection.close()
            self._take(body)

    def _ended(self, why: str) -> None:
        if why == CLOSED:
            try:
                body = self._reader.end()
            except ProtocolError:
                self._failed(ConnectionError(why))
                return
            self._take(body)
        else:
            self._failed(ConnectionError(why))

    def _take(self, body: bytes) -> None:
        try:
            value = decode_answer(body)
        except (ProtocolError, Refusal) as error:
            self._failed(error)
            return
        self._answered(value)


@dataclass(frozen=True)
class NodeLimits:
    """What the network may cost.

    max_message: bytes of one message. partial: bytes of all messages that are arriving.
    timeout: seconds for a call, and for a publisher to answer with its header.
    """

    max_message: int
    partial: int
    timeout: float


class _Publisher:
    """One publisher of one topic, from the question where it listens to its last byte."""

    def __init__(self, node: Node, topic: str, uri: str) -> None:
        self.topic, self.uri = topic, uri
        self.publication: Publication | None = None
        self.messages = 0
        self._node = node
        self._framer = Framer(node.limits.max_message)
        self._partial = 0
        self._call: RemoteCall | None = None
        self._connection: Connection | None = None

    def begin(self) -> None:
        """Ask the publisher's node where it listens."""
        try:
            api = read_uri(self.uri)
        except ProtocolError as error:
            self._fail(error)
            return
        self._call = RemoteCall(
            self._node.loop,
            api,
            encode_call("requestTopic", [self._node.name, self.topic, [["TCPROS"]]]),
            self._located,
            self._fail,
            limit=PEER_BODY,
            timeout=self._node.limits.timeout,
        )

    def close(self) -> None:
        for part in (self._call, self._connection):
            if part is not None:
                part.close()
        self._call = self._connection = None
        self._account(0)

    def _located(self, answer: Value) -> None:
        try:
            endpoint = tcpros_endpoint(unwrap(answer))
        except (ProtocolError, Refusal) as error:
            self._fail(error)
            return
        deadline = time.monotonic() + self._node.limits.timeout
        self._connection = self._node.loop.connect(*endpoint, self._received, self._lost, deadline)
        self._connection.send(encode_header(request_header(self.topic, self._node.name)))

    def _received(self, data: memoryview) -> None:
        try:
            for event in self._framer.feed(data):
                match event:
                    case Message(body):
                        self.messages += 1
                        self._node.received(self, body)
                    case Header(fields):
                        publication = read_publication(self.topic, fields)
                        self._node.admit(self, publication)
                        self.publication = publication
                    case PassedOver(length):
                        self._node.passed_over(self, length)
        except SourceError as error:  # of the protocol, of the definition, or a refusal: each is the publisher's
            self._fail(error)
            return
        self._account(self._framer.buffered)
        if self._node.partial > self._node.limits.partial:
            given_up = self._framer.pass_over()
            if given_up is not None:
                self._node.passed_over(self, given_up.length)
                self._account(0)
        if self._connection is not None and self._framer.header_done:
            # Before the header is complete, the deadline of the connection stands, however it trickles in.
            silent = self._framer.between_messages
            self._connection.deadline = None if silent else time.monotonic() + STALLED

    def _lost(self, why: str) -> None:
        self._fail(ConnectionError(why))

    def _fail(self, error: Exception) -> None:
        self.close()
        self._node.ended(self, error)

    def _account(self, buffered: int) -> None:
        self._node.partial += buffered - self._partial
        self._partial = buffered


class Node:
    """Runs in one thread until `stop`. Counters and offers may be read from another."""

    def __init__(
        self, master: Endpoint, host: str | None, name: str, selection: Selection, limits: NodeLimits,
        backlog: Backlog, counters: dict[str, TopicCounters], clock: Clock,
    ) -> None:  # fmt: skip
        self.limits = limits
        self.partial = 0
        self.loop = Loop()
        self._master, self._host, self._name, self._selection = master, host, name, selection
        self._backlog, self._counters, self._clock = backlog, counters, clock
        self._publishers: dict[tuple[str, str], _Publisher] = {}
        self._said: dict[str, None] = {}
        self._timer = 0.0

    @property
    def name(self) -> str:
        return self._subscriptions.node

    def run(self, stop: threading.Event) -> None:
        """Until `stop` is set (and the loop woken); the master is told then that we leave. Raises SourceError."""
        try:
            own = own_host(self._host, self._master)
            while own is None:
                self._say("master", f"there is no way to the master at {self._master}; trying again")
                if stop.wait(RESOLVE_EVERY):
                    return
                own = own_host(self._host, self._master)
            self._listen(own)
            while not stop.is_set():
                now = time.monotonic()
                if now >= self._timer:
                    self._act(now)
                self.loop.turn(self._timer)
            self._leave()
        finally:
            self.loop.close()

    def _listen(self, own: str) -> None:
        try:
            port = self.loop.listen(bind_host(own), self._called, self.limits.timeout)
        except OSError as error:
            raise SourceError(f"our ROS node cannot listen for the master's calls: {error.strerror}") from None
        self._uri = uri_of(own, port)
        self._subscriptions = Subscriptions(self._selection, self._name, self._uri)

    def _act(self, now: float) -> None:
        for action in self._subscriptions.actions(now):
            match action:
                case MasterCall():
                    self._call_master(action)
                case Connect(topic, uri):
                    publisher = self._publishers[topic, uri] = _Publisher(self, topic, uri)
                    publisher.begin()
                case Disconnect(topic, uri):
                    self._disconnected(self._publishers.pop((topic, uri), None))
                case Say(key, text):
                    self._say(key, text)
        # An action may have failed at once and be due again; otherwise this is when to look again.
        self._timer = self._subscriptions.next_timer()

    def _changed(self) -> None:
        self._timer = 0.0

    def _leave(self) -> None:
        for publisher in self._publishers.values():
            publisher.close()
        until = time.monotonic() + FAREWELL
        calls = self._subscriptions.farewells() if self._subscriptions.master_answers else []
        under_way: set[MasterCall] = set()
        while (calls or under_way) and time.monotonic() < until:
            while calls and len(under_way) < 8:
                call = calls.pop()
                under_way.add(call)

                def done(_: object, call: MasterCall = call) -> None:
                    under_way.discard(call)

                self._remote(call, done, done)
            self.loop.turn(until)

    # The master

    def _remote(
        self, call: MasterCall, answered: Callable[[Value], None], failed: Callable[[Exception], None]
    ) -> None:
        body = encode_call(call.method, list(call.parameters))
        RemoteCall(
            self.loop, self._master, body, answered, failed, limit=MASTER_ANSWER, timeout=self.limits.timeout
        )  # fmt: skip

    def _call_master(self, call: MasterCall) -> None:
        def answered(answer: Value) -> None:
            self._subscriptions.answered(call, answer, time.monotonic())
            self._changed()

        def failed(error: Exception) -> None:
            self._subscriptions.failed(call, str(error), time.monotonic())
            self._changed()

        self._remote(call, answered, failed)

    def _called(self, connection: Connection) -> tuple[Received, Ended]:
        """Somebody connected to our API."""
        reader = BodyReader(request=True, limit=PEER_BODY)

        def received(data: memoryview) -> None:
            try:
                body = reader.feed(data)
                if body is None:
                    return
                method, parameters = decode_call(body)
            except ProtocolError as error:
                connection.send(encode_response(encode_fault(1, str(error)), "400 Bad Request"), last=True)
                return
            connection.send(encode_response(self._answer(method, parameters)), last=True)

        return received, lambda why: None

    def _answer(self, method: str, parameters: list[Value]) -> bytes:
        """wiki.ros.org/ROS/Slave_API, for a node that only subscribes."""
        match method:
            case "publisherUpdate":
                if len(parameters) == 3 and isinstance(parameters[1], str):
                    self._subscriptions.doorbell(parameters[1], time.monotonic())
                    self._changed()
                return encode_answer([1, "", 0])
            case "getPid":
                return encode_answer([1, "", os.getpid()])
            case "getMasterUri":
                return encode_answer([1, "", uri_of(*self._master)])
            case "getName":
                return encode_answer([1, "", self.name])
            case "getSubscriptions":
                pairs: list[Value] = [[topic, self._type_of(topic)] for topic in self._subscriptions.topics]
                return encode_answer([1, "", pairs])
            case "getPublications" | "getBusInfo":
                return encode_answer([1, "", []])
            case "getBusStats":
                return encode_answer([1, "", [[], [], []]])
            case "paramUpdate":
                return encode_answer([1, "", 0])
            case "requestTopic":
                return encode_answer([0, "this node publishes nothing", 0])
            case "shutdown":
                # Anyone may call this; what stops the bridge is its own service. A name that was taken shows
                # at the next look at the master's state.
                self._say("shutdown", "somebody on the ROS network asked this node to shut down; it goes on")
                return encode_answer([1, "", 0])
        return encode_fault(1, "no such method")

    def _type_of(self, topic: str) -> str:
        for (name, _), publisher in self._publishers.items():
            if name == topic and publisher.publication is not None:
                return publisher.publication.type_name.replace("/msg/", "/")
        return "*"

    # The publishers

    def admit(self, publisher: _Publisher, publication: Publication) -> None:
        """One type for a topic at a time, as ROS has it: that of the publishers read from already."""
        for (topic, _), other in self._publishers.items():
            if topic == publisher.topic and other.publication is not None and other.publication.md5 != publication.md5:
                raise Refusal(
                    f"{publication.node} publishes {publication.type_name} ({publication.md5}) where "
                    f"{other.publication.node} publishes {other.publication.type_name} ({other.publication.md5})"
                )
        counters = self._counters_of(publisher.topic)
        counters.connections += 1
        counters.connected += 1
        log.info("%s: reading %s from %s", publisher.topic, publication.type_name, publication.node or publisher.uri)

    def received(self, publisher: _Publisher, body: bytes) -> None:
        """A message is complete."""
        publication = publisher.publication
        if publication is None:
            return
        counters = self._counters_of(publisher.topic)
        counters.received += 1
        counters.bytes += len(body)
        if publication.latching and publisher.messages == 1:
            counters.latched += 1
        self._backlog.put(
            RawMessage(publisher.topic, publication.type_name, self._clock.wall_ns(), body, publication.decoder)
        )

    def passed_over(self, publisher: _Publisher, length: int) -> None:
        """A message is not read."""
        self._counters_of(publisher.topic).too_large += 1
        self._say(
            f"too large {publisher.topic}",
            f"{publisher.topic}: a message of {length} bytes is left out; at most {self.limits.max_message} bytes of a "
            f"message are read, and {self.limits.partial} of all that are arriving",
        )

    def ended(self, publisher: _Publisher, error: Exception) -> None:
        """A connection was not made, or was lost, or was ended by us for what came."""
        if isinstance(error, ProtocolError):
            cause = Cause.PROTOCOL
        elif isinstance(error, SourceError):
            cause = Cause.REFUSED
        else:
            cause = Cause.CLOSED if publisher.publication is not None else Cause.UNREACHABLE
        self._counters_of(publisher.topic).ended[cause] += 1
        text = f"{publisher.topic}: the publisher at {publisher.uri[:200]}: {error}"
        if cause is Cause.CLOSED:
            log.info("%s", text)
        else:
            key = f"publisher {publisher.topic} {publisher.uri}"
            self._say(key, f"{text}; trying again, further failures are counted")
        where = (publisher.topic, publisher.uri)
        if self._publishers.get(where) is publisher:
            del self._publishers[where]
        self._disconnected(publisher)
        self._subscriptions.connection_ended(*where, time.monotonic())
        self._changed()

    def _disconnected(self, publisher: _Publisher | None) -> None:
        if publisher is None:
            return
        publisher.close()
        if publisher.publication is not None:
            publisher.publication = None
            self._counters_of(publisher.topic).connected -= 1

    def _counters_of(self, topic: str) -> TopicCounters:
        found = self._counters.get(topic)
        if found is None:
            found = self._counters[topic] = TopicCounters()
        return found

    def _say(self, key: str, text: str | None) -> None:
        if text is None:
            if self._said.pop(key, "absent") is None:
                log.info("%s: in order again", key)
            return
        if key not in self._said:
            while len(self._said) >= MAX_SAID:
                del self._said[next(iter(self._said))]
            self._said[key] = None
            log.warning("%s", text)


def ask_offers(master: Endpoint, name: str, timeout: float) -> tuple[Offer, ...]:
    """What is published now, asked once, with sockets of its own. Raises SourceError."""
    loop = Loop()
    answers: list[Value] = []
    errors: list[Exception] = []
    try:
        for method in ("getSystemState", "getTopicTypes"):
            body = encode_call(method, [name])
            RemoteCall(loop, master, body, answers.append, errors.append, limit=MASTER_ANSWER, timeout=timeout)
            wanted = len(answers) + 1
            while len(answers) < wanted and not errors:
                loop.turn(time.monotonic() + 1.0)
            if errors:
                raise SourceError(f"the ROS master at {master} does not answer: {errors[0]}")
        return offers(system_state(unwrap(answers[0]))[0], topic_types(unwrap(answers[1])))
    except (ProtocolError, Refusal) as error:
        raise SourceError(f"the ROS master at {master} does not answer as it should: {error}") from None
    finally:
        loop.close()
