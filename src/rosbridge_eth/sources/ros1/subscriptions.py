"""What to ask the master, and which publishers to be connected to. No sockets: answers and `now` in, actions out.

    topics named in the configuration   registered at once, so that their first message is not missed
    patterns and nodes                  resolved from the master's state every few seconds (selection.Watch)
    publisherUpdate                     rings the doorbell only: we register again, which is idempotent, and
                                        take the list of publishers from the master's answer. Anyone may call
                                        our API, so nothing is believed from there.
    other publishers in the state       the doorbell did not reach us (a firewall): register again as well
    we are missing in the state         the master has restarted
    our name has another API            another node took it, and the master has dropped us: we take another one

Publishers do not register again at a restarted master. So a connection that was
there before is kept until it ends by itself, although the new master does not list it.

`now` is monotonic seconds.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from enum import Enum, auto
from typing import TypeAlias

from rosbridge_eth.sources.protocol import Offer
from rosbridge_eth.sources.ros1.addressing import is_graph_name
from rosbridge_eth.sources.ros1.errors import ProtocolError, Refusal
from rosbridge_eth.sources.ros1.graph import offers, publisher_uris, system_state, topic_types, unwrap
from rosbridge_eth.sources.ros1.publication import ANY
from rosbridge_eth.sources.ros1.xmlrpc import Value
from rosbridge_eth.sources.selection import RESOLVE_EVERY, Selection, Watch

MAX_TOPICS = 2048
"""Topics that are watched at once; a pattern may match more than was meant."""
MAX_CONNECTIONS = 512
"""Connections to publishers at once: file descriptors, of which a process usually has 1,024."""
PARALLEL_CALLS = 8
"""Calls to the master under way at once."""
DOORBELL_REST = 0.05
"""Seconds after which a topic is registered again at the earliest, however often the doorbell rings."""
FIRST_RETRY = 0.1
LAST_RETRY = 10.0
"""Seconds between attempts to reach a publisher: doubled at each failure."""
STEADY = 10.0
"""A connection that lasted so long was a good one: the next attempt is the first again."""


@dataclass(frozen=True, slots=True)
class MasterCall:
    """Call a method of the master, and report what came of it with this same object."""

    method: str
    parameters: tuple[str, ...]
    topic: str = ""


@dataclass(frozen=True, slots=True)
class Connect:
    """Ask this publisher for the topic and read from it; report the end by `connection_ended`."""

    topic: str
    uri: str


@dataclass(frozen=True, slots=True)
class Disconnect:
    """Close that connection, or stop trying; not to be reported."""

    topic: str
    uri: str


@dataclass(frozen=True, slots=True)
class Say:
    """For the log, once for each key; None as text: it is over, say it anew the next time."""

    key: str
    text: str | None


Action: TypeAlias = MasterCall | Connect | Disconnect | Say


class _Registration(Enum):
    DUE = auto()
    ASKED = auto()
    RUNG = auto()  # the doorbell rang while the answer is awaited
    DONE = auto()
    GIVEN_UP = auto()  # not wanted any more; only connections from before a master's restart are left


@dataclass
class _Connection:
    retry_at: float | None  # None: under way or established
    since: float = 0.0
    failures: int = 0
    orphan: bool = False  # from before the master's restart, and not listed since


@dataclass
class _Topic:
    registration: _Registration = _Registration.DUE
    not_before: float = 0.0  # when to register again after the master refused
    registered_at: float = 0.0
    nodes: tuple[str, ...] | None = None  # the publishers of the state that was judged last
    connections: dict[str, _Connection] = field(default_factory=dict)


class Subscriptions:
    """The state of one node's subscriptions. `node` changes if another node takes our name."""

    def __init__(self, selection: Selection, node: str, api: str, every: float = RESOLVE_EVERY) -> None:
        self.node = node
        self.master_answers = False
        self.offers: tuple[Offer, ...] = ()
        self._base_name, self._renamed = node, 0
        self._api = api
        self._selection = selection
        self._watch = Watch(selection, every)
        self._every = every
        self._topics: dict[str, _Topic] = {name: _Topic() for name in selection.named_topics}
        self._calls: set[MasterCall] = set()
        self._leaving: dict[str, None] = {}
        self._state: tuple[dict[str, list[str]], dict[str, list[str]]] | None = None
        self._polling_since: float | None = None
        self._named_since: float | None = None  # when the master first took our name
        self._master_retry_at = 0.0
        self._actions: list[Action] = []

    @property
    def topics(self) -> list[str]:
        """The topics that are registered, or are to be."""
        return [name for name, topic in self._topics.items() if topic.registration is not _Registration.GIVEN_UP]

    def actions(self, now: float) -> list[Action]:
        """What is to be done now."""
        self._connect(now)
        if now >= self._master_retry_at:
            self._call_master(now)
        actions, self._actions = self._actions, []
        return actions

    def next_timer(self) -> float:
        """When to ask for actions again although nothing was reported."""
        timers = [
            link.retry_at
            for topic in self._topics.values()
            for link in topic.connections.values()
            if link.retry_at is not None
        ]
        if self._polling_since is None:
            timers.append(max(self._watch.next_timer() or 0.0, self._master_retry_at))
        if len(self._calls) < PARALLEL_CALLS:
            timers += [self._master_retry_at] if self._leaving else []
            timers += [
                max(topic.not_before, self._master_retry_at)
                for topic in self._topics.values()
                if topic.registration is _Registration.DUE
            ]
        return min(timers, default=float("inf"))

    def doorbell(self, topic: str, now: float) -> None:
        """Somebody says that the topic's publishers changed."""
        state = self._topics.get(topic)
        if state is None:
            return
        state.not_before = state.registered_at + DOORBELL_REST
        if state.registration is _Registration.DONE:
            state.registration = _Registration.DUE
        elif state.registration is _Registration.ASKED:
            state.registration = _Registration.RUNG

    def answered(self, call: MasterCall, answer: Value, now: float) -> None:
        """The master answered the call. What it must not answer counts as a failure."""
        self._calls.discard(call)
        if not self.master_answers:
            self.master_answers = True
            self._say("master", None)
        try:
            match call.method:
                case "registerSubscriber":
                    self._registered(call, publisher_uris(unwrap(answer)), now)
                case "getSystemState":
                    self._state = system_state(unwrap(answer))
                    self._judge_registrations(self._state[1], now)
                    self._judge_publishers(self._state[0], now)
                    if self._selection.names_only_topics:
                        self._resolve({}, now)
                    else:
                        self._call(MasterCall("getTopicTypes", (self.node,)))
                case "getTopicTypes":
                    self._resolve(topic_types(unwrap(answer)), now)
                case "lookupNode":
                    if unwrap(answer) != self._api and self._named_before(self._polling_since):
                        self._take_another_name()
                    self._call(MasterCall("getSystemState", (self.node,)))
        except Refusal as error:
            if call.method == "lookupNode":
                self._call(MasterCall("getSystemState", (self.node,)))  # nobody has our name
            elif call.method == "registerSubscriber":
                self._refused(call, str(error), now)
            else:
                self._master_failed(call, str(error), now)
        except ProtocolError as error:
            self._master_failed(call, str(error), now)

    def failed(self, call: MasterCall, why: str, now: float) -> None:
        """The master could not be reached, or did not answer in time or in XML-RPC."""
        self._calls.discard(call)
        if self.master_answers:
            self.master_answers = False
        self._master_failed(call, why, now)

    def connection_ended(self, topic: str, uri: str, now: float) -> None:
        """A connection to a publisher was not made, or ended, for whatever reason."""
        state = self._topics.get(topic)
        link = state.connections.get(uri) if state is not None else None
        if state is None or link is None or link.retry_at is not None:
            return
        if link.orphan:
            del state.connections[uri]
            if state.registration is _Registration.GIVEN_UP and not state.connections:
                del self._topics[topic]
            return
        if now - link.since >= STEADY:
            link.failures = 0
        link.retry_at = now + min(LAST_RETRY, FIRST_RETRY * 2 ** min(link.failures, 16))
        link.failures += 1
        if state.registration is _Registration.DONE:
            # It may have started anew somewhere else: when we try again, we also ask the master.
            state.registration, state.not_before = _Registration.DUE, link.retry_at

    def farewells(self) -> list[MasterCall]:
        """The calls that leave every topic, for the end."""
        return [
            MasterCall("unregisterSubscriber", (self.node, name, self._api), name)
            for name, topic in self._topics.items()
            if topic.registration not in (_Registration.DUE, _Registration.GIVEN_UP)
        ]

    # Towards the master

    def _call_master(self, now: float) -> None:
        due = self._watch.next_timer()
        if self._polling_since is None and (due is None or now >= due):
            self._polling_since = now
            self._call(MasterCall("lookupNode", (self.node, self.node)))
        while self._leaving and len(self._calls) < PARALLEL_CALLS:
            name = next(iter(self._leaving))
            del self._leaving[name]
            self._call(MasterCall("unregisterSubscriber", (self.node, name, self._api), name))
        for name, topic in self._topics.items():
            if len(self._calls) >= PARALLEL_CALLS:
                break
            if topic.registration is _Registration.DUE and now >= topic.not_before:
                topic.registration = _Registration.ASKED
                self._call(MasterCall("registerSubscriber", (self.node, name, ANY, self._api), name))

    def _call(self, call: MasterCall) -> None:
        self._calls.add(call)
        self._actions.append(call)

    def _master_failed(self, call: MasterCall, why: str, now: float) -> None:
        self._say("master", f"the master does not answer as it should ({why}); trying again every {self._every:g} s")
        self._master_retry_at = now + self._every
        match call.method:
            case "registerSubscriber":
                topic = self._topics.get(call.topic)
                if topic is not None and topic.registration is not _Registration.GIVEN_UP:
                    topic.registration = _Registration.DUE
            case "lookupNode" | "getSystemState" | "getTopicTypes":
                self._polling_since = None
                self._watch.failed(now)

    def _refused(self, call: MasterCall, why: str, now: float) -> None:
        self._say(f"register {call.topic}", f"the master does not take a subscription to {call.topic}: {why}")
        topic = self._topics.get(call.topic)
        if topic is not None and topic.registration is not _Registration.GIVEN_UP:
            topic.registration = _Registration.DUE
            topic.not_before = now + LAST_RETRY

    def _registered(self, call: MasterCall, uris: list[str], now: float) -> None:
        topic = self._topics.get(call.topic)
        if topic is None or topic.registration is _Registration.GIVEN_UP:
            self._leave(call.topic)
            return
        rung = topic.registration is _Registration.RUNG
        topic.registration = _Registration.DUE if rung else _Registration.DONE
        topic.registered_at, topic.not_before = now, now + DOORBELL_REST
        if self._named_since is None and call.parameters[0] == self.node:
            self._named_since = now
        self._say(f"register {call.topic}", None)
        for uri in [uri for uri in topic.connections if uri not in uris]:
            link = topic.connections[uri]
            if not (link.orphan and link.retry_at is None):
                self._disconnect(call.topic, topic, uri)
        room = MAX_CONNECTIONS - sum(len(other.connections) for other in self._topics.values())
        for uri in uris:
            if uri in topic.connections:
                topic.connections[uri].orphan = False
            elif room > 0:
                room -= 1
                topic.connections[uri] = _Connection(retry_at=now)
            else:
                self._say("room", f"more than {MAX_CONNECTIONS} publishers; some of {call.topic} are left out")
                break

    def _judge_registrations(self, subscribers: dict[str, list[str]], now: float) -> None:
        """Register again what the master does not know."""
        since = now if self._polling_since is None else self._polling_since
        for name, topic in self._topics.items():
            if (
                topic.registration is _Registration.DONE
                and topic.registered_at < since
                and self.node not in subscribers.get(name, ())
            ):
                topic.registration = _Registration.DUE
                for uri in [uri for uri, link in topic.connections.items() if link.retry_at is not None]:
                    self._disconnect(name, topic, uri)
                for link in topic.connections.values():
                    link.orphan = True
        for name, nodes in subscribers.items():
            if self.node in nodes and is_graph_name(name) and self._topics.get(name) is None:
                self._leave(name)  # an earlier farewell did not reach the master

    def _judge_publishers(self, publishers: dict[str, list[str]], now: float) -> None:
        """Register again, that is, ask for the publishers' APIs, where there are others than at the last look."""
        since = now if self._polling_since is None else self._polling_since
        for name, topic in self._topics.items():
            nodes = tuple(sorted(publishers.get(name, ())))
            if topic.registration is _Registration.DONE and topic.registered_at < since:
                known = len(topic.connections) == len(nodes) if topic.nodes is None else topic.nodes == nodes
                if not known:
                    topic.registration = _Registration.DUE
                topic.nodes = nodes

    def _named_before(self, moment: float | None) -> bool:
        return self._named_since is not None and moment is not None and self._named_since < moment

    def _take_another_name(self) -> None:
        """Two nodes of one name would push each other out of the master in turn."""
        old = self.node
        self._renamed += 1
        self.node = f"{self._base_name}_{self._renamed + 1}"
        self._named_since = None
        self._say(f"name {self.node}", f"another node has registered as {old}; this one goes on as {self.node}")
        for topic in self._topics.values():
            if topic.registration is not _Registration.GIVEN_UP:
                topic.registration = _Registration.DUE

    def _resolve(self, types: dict[str, str], now: float) -> None:
        if self._state is None:
            return
        first = self._watch.next_timer() is None
        self.offers, self._state, self._polling_since = offers(self._state[0], types), None, None
        self._watch.update(self.offers, now)
        for text in self._selection.unmatched(self.offers) if first else ():
            self._say(f"unmatched {text}", f"nothing of the name {text} is published yet; waiting for it")
        matched = (offer.topic for offer in self._watch.watched.values())
        wanted = dict.fromkeys([*self._selection.named_topics, *matched])
        for name in [name for name in self._topics if name not in wanted]:
            self._drop(name)
        for name in wanted:
            topic = self._topics.get(name)
            if topic is None and len(self._topics) >= MAX_TOPICS:
                self._say("topics", f"more than {MAX_TOPICS} topics match; {name} and others are left out")
                break
            if topic is None:
                self._topics[name] = _Topic()
            elif topic.registration is _Registration.GIVEN_UP:
                topic.registration = _Registration.DUE

    def _drop(self, name: str) -> None:
        topic = self._topics[name]
        if topic.registration is _Registration.GIVEN_UP:
            return
        if topic.registration is not _Registration.DUE:
            self._leave(name)
        topic.registration = _Registration.GIVEN_UP
        for uri in [uri for uri, link in topic.connections.items() if not link.orphan]:
            self._disconnect(name, topic, uri)
        if not topic.connections:
            del self._topics[name]

    def _leave(self, name: str) -> None:
        self._leaving[name] = None

    # Towards the publishers

    def _connect(self, now: float) -> None:
        for name, topic in self._topics.items():
            for uri, link in topic.connections.items():
                if link.retry_at is not None and now >= link.retry_at:
                    link.retry_at, link.since = None, now
                    self._actions.append(Connect(name, uri))

    def _disconnect(self, name: str, topic: _Topic, uri: str) -> None:
        if topic.connections.pop(uri).retry_at is None:
            self._actions.append(Disconnect(name, uri))

    def _say(self, key: str, text: str | None) -> None:
        self._actions.append(Say(key, text))
