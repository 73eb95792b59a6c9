"""The machine without sockets: what it asks of a master, and whom it is connected to, as time goes by."""

from __future__ import annotations

import itertools

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule

from rosbridge_eth.sources import Selection
from rosbridge_eth.sources.ros1.subscriptions import (
    DOORBELL_REST,
    LAST_RETRY,
    MAX_CONNECTIONS,
    PARALLEL_CALLS,
    STEADY,
    Connect,
    Disconnect,
    MasterCall,
    Say,
    Subscriptions,
)

API = "http://me:1/"


def machine(*topics: str, nodes: tuple[str, ...] = ()) -> Subscriptions:
    return Subscriptions(Selection(topics, nodes), "/me", API)


def calls(actions: list) -> list[str]:
    return [f"{action.method} {action.topic}".strip() for action in actions if isinstance(action, MasterCall)]


def call(actions: list, method: str) -> MasterCall:
    return next(action for action in actions if isinstance(action, MasterCall) and action.method == method)


def state(publishers: dict, subscribers: dict) -> list:
    return [1, "", [[[t, n] for t, n in publishers.items()], [[t, n] for t, n in subscribers.items()], []]]


def poll(
    subject: Subscriptions, actions: list, publishers: dict, subscribers: dict, now: float, api: str = API
) -> list:
    """Answer one look at the master; what is to be done then."""
    subject.answered(call(actions, "lookupNode"), [1, "", api], now)
    actions = subject.actions(now)
    subject.answered(call(actions, "getSystemState"), state(publishers, subscribers), now)
    actions += subject.actions(now)
    if "getTopicTypes" in calls(actions):
        subject.answered(call(actions, "getTopicTypes"), [1, "", []], now)
        actions += subject.actions(now)
    looks = ("getSystemState", "getTopicTypes")
    return [action for action in actions if not (isinstance(action, MasterCall) and action.method in looks)]


def test_a_named_topic_is_registered_before_anybody_publishes_it():
    assert calls(machine("/a", "/b*").actions(0.0)) == ["lookupNode", "registerSubscriber /a"]


def test_a_pattern_is_registered_when_it_matches_and_left_when_it_does_not():
    subject = machine("/b*")
    actions = poll(subject, subject.actions(0.0), {"/b1": ["/x"], "/c": ["/x"]}, {}, 0.0)
    assert "registerSubscriber /b1" in calls(actions)
    assert "registerSubscriber /c" not in calls(actions)
    subject.answered(call(actions, "registerSubscriber"), [1, "", ["http://x:1/"]], 0.1)
    assert Connect("/b1", "http://x:1/") in subject.actions(0.1)
    actions = poll(subject, subject.actions(3.0), {}, {"/b1": ["/me"]}, 3.0)
    assert Disconnect("/b1", "http://x:1/") in actions
    assert "unregisterSubscriber /b1" in calls(actions)


def registered(uris: list[str], now: float = 0.0) -> Subscriptions:
    subject = machine("/a")
    actions = subject.actions(now)
    subject.answered(call(actions, "registerSubscriber"), [1, "", uris], now)
    actions = poll(subject, actions, {"/a": ["/x"] * len(uris)}, {"/a": ["/me"]}, now)
    assert [action.uri for action in actions if isinstance(action, Connect)] == uris
    return subject


def test_the_doorbell_has_the_master_asked_and_nothing_believed():
    subject = registered(["http://x:1/"])
    subject.doorbell("/a", 1.0)
    subject.doorbell("/unknown", 1.0)
    actions = subject.actions(1.0)
    assert calls(actions) == ["registerSubscriber /a"]
    subject.doorbell("/a", 1.1)  # while the answer is awaited: it may be older than this
    assert calls(subject.actions(1.1)) == []
    subject.answered(call(actions, "registerSubscriber"), [1, "", ["http://y:1/"]], 1.2)
    actions = subject.actions(1.2)
    assert calls(actions) == []  # whoever rings all the time does not have the master asked all the time
    actions += subject.actions(1.2 + DOORBELL_REST)
    assert Disconnect("/a", "http://x:1/") in actions
    assert Connect("/a", "http://y:1/") in actions
    assert calls(actions) == ["registerSubscriber /a"]


def test_publishers_come_to_light_even_if_the_doorbell_never_rings():
    subject = registered([])
    actions = poll(subject, subject.actions(3.0), {"/a": ["/x"]}, {"/a": ["/me"]}, 3.0)
    assert calls(actions) == ["registerSubscriber /a"]


def test_attempts_come_at_longer_and_longer_intervals_until_a_connection_lasts():
    subject = registered(["http://x:1/"])
    subject.connection_ended("/a", "http://x:1/", 0.0)
    now, times = 0.05, [0.0]
    while now < 100:
        subject_actions = subject.actions(now)
        if Connect("/a", "http://x:1/") in subject_actions:
            times.append(now)
            subject.connection_ended("/a", "http://x:1/", now)
        for action in subject_actions:
            if isinstance(action, MasterCall):  # a master that answers, so that only the publisher is at fault
                subject.failed(action, "not now", now)
        now = round(now + 0.05, 2)
    gaps = [round(after - before, 1) for before, after in itertools.pairwise(times)]
    assert gaps[:6] == pytest.approx([0.1, 0.2, 0.4, 0.8, 1.6, 3.2], abs=0.11)  # it looks every 0.05 s
    assert max(gaps) <= LAST_RETRY + 0.1
    while Connect("/a", "http://x:1/") not in subject.actions(now):
        now += 0.5
    subject.connection_ended("/a", "http://x:1/", now + STEADY)
    assert Connect("/a", "http://x:1/") in subject.actions(now + STEADY + 0.1)


def test_a_restarted_master_is_told_again_and_living_connections_are_kept():
    subject = registered(["http://x:1/"])
    actions = subject.actions(3.0)
    subject.failed(call(actions, "lookupNode"), "refused", 3.0)
    said = [action for action in subject.actions(3.0) if isinstance(action, Say)]
    assert len(said) == 1
    assert calls(subject.actions(5.9)) == []
    actions = poll(subject, subject.actions(6.0), {}, {}, 6.0)
    assert calls(actions) == ["registerSubscriber /a"]
    subject.answered(call(actions, "registerSubscriber"), [1, "", []], 6.1)
    assert not [action for action in subject.actions(6.1) if isinstance(action, Disconnect)]
    # Once it ends, there is nobody to ask for it again.
    subject.connection_ended("/a", "http://x:1/", 7.0)
    assert not [action for action in subject.actions(30.0) if isinstance(action, Connect)]


def test_a_publisher_that_registers_again_at_the_new_master_is_an_ordinary_one_again():
    subject = registered(["http://x:1/"])
    actions = poll(subject, subject.actions(3.0), {}, {}, 3.0)
    subject.answered(call(actions, "registerSubscriber"), [1, "", ["http://x:1/"]], 3.1)
    subject.connection_ended("/a", "http://x:1/", 4.0)
    assert Connect("/a", "http://x:1/") in subject.actions(5.0)


def test_a_name_that_was_taken_is_left_to_the_other():
    subject = registered([])
    actions = poll(subject, subject.actions(3.0), {}, {"/a": ["/me"]}, 3.0, api="http://other:1/")
    assert subject.node == "/me_2"
    assert call(actions, "registerSubscriber").parameters[0] == "/me_2"


def test_a_dead_namesake_from_before_is_replaced():
    subject = machine("/a")
    actions = subject.actions(0.0)
    poll(subject, actions, {}, {"/a": ["/me"]}, 0.0, api="http://dead:1/")
    assert subject.node == "/me"


def test_connections_are_limited():
    subject = machine("/a")
    actions = subject.actions(0.0)
    subject.answered(call(actions, "registerSubscriber"), [1, "", [f"http://x:{n}/" for n in range(5000)]], 0.0)
    actions = subject.actions(0.0)
    assert len([action for action in actions if isinstance(action, Connect)]) == MAX_CONNECTIONS
    assert [action.key for action in actions if isinstance(action, Say) and action.text] == ["room"]


URIS = [f"http://p:{n}/" for n in range(1, 5)]
TOPICS = ["/a", "/b/1", "/b/2", "/c"]
VALUES = st.recursive(
    st.one_of(st.integers(-2, 2), st.sampled_from([*TOPICS, *URIS, "/me", "/n1", ""]), st.none(), st.booleans()),
    lambda inner: st.lists(inner, max_size=3),
    max_leaves=8,
)


class AnyMaster(RuleBasedStateMachine):
    """A master that answers anything, fails, rings; publishers that end; and the rules that hold regardless."""

    @initialize()
    def begin(self) -> None:
        self.now = 0.0
        self.subject = machine("/a", "/b/*", nodes=("/n1",))
        self.pending: list[MasterCall] = []
        self.connected: set[tuple[str, str]] = set()

    @rule(passed=st.sampled_from([0.0, 0.05, 0.5, 3.0, 11.0]))
    def act(self, passed: float) -> None:
        self.now += passed
        for action in self.subject.actions(self.now):
            match action:
                case MasterCall():
                    assert action not in self.pending
                    self.pending.append(action)
                case Connect(topic, uri):
                    assert (topic, uri) not in self.connected
                    self.connected.add((topic, uri))
                case Disconnect(topic, uri):
                    # It may have ended by itself after this was decided.
                    self.connected.discard((topic, uri))

    @rule(data=st.data(), value=VALUES)
    def nonsense(self, data: st.DataObject, value: object) -> None:
        if self.pending:
            answered = self.pending.pop(data.draw(st.integers(0, len(self.pending) - 1)))
            self.subject.answered(answered, value, self.now)  # type: ignore[arg-type]

    @rule(data=st.data())
    def answer(self, data: st.DataObject) -> None:
        if not self.pending:
            return
        answered = self.pending.pop(0)
        lists = st.lists(st.tuples(st.sampled_from(TOPICS), st.lists(st.sampled_from(["/me", "/n1", "/n2"]))).map(list))
        value = {
            "registerSubscriber": st.lists(st.sampled_from(URIS)),
            "unregisterSubscriber": st.just(1),
            "lookupNode": st.sampled_from([API, API, "http://other/"]),
            "getSystemState": st.tuples(lists, lists, st.just([])).map(list),
            "getTopicTypes": st.lists(st.tuples(st.sampled_from(TOPICS), st.sampled_from(["a/B", "*"])).map(list)),
        }[answered.method]
        self.subject.answered(answered, [1, "", data.draw(value)], self.now)

    @rule(data=st.data())
    def fail(self, data: st.DataObject) -> None:
        if self.pending:
            self.subject.failed(self.pending.pop(0), "refused", self.now)

    @rule(topic=st.sampled_from([*TOPICS, "/x"]))
    def ring(self, topic: str) -> None:
        self.subject.doorbell(topic, self.now)

    @rule(data=st.data())
    def end(self, data: st.DataObject) -> None:
        if self.connected:
            gone = data.draw(st.sampled_from(sorted(self.connected)))
            self.connected.remove(gone)
            self.subject.connection_ended(*gone, self.now)

    @invariant()
    def bounded(self) -> None:
        assert len(self.pending) <= PARALLEL_CALLS + 1  # and one of a look at the state
        assert "/a" in self.subject.topics

    def teardown(self) -> None:
        """A master that answers again is asked again, and has us registered, within the time that was set."""
        if not hasattr(self, "subject"):
            return
        for _ in range(60):
            self.act(1.0)
            while self.pending:
                answered = self.pending.pop(0)
                name = self.subject.node
                self.subject.answered(
                    answered,
                    {
                        "registerSubscriber": [1, "", [URIS[0]]],
                        "getSystemState": state({"/a": ["/n1"]}, {"/a": [name]}),
                        "getTopicTypes": [1, "", []],
                        "lookupNode": [1, "", API],
                        "unregisterSubscriber": [1, "", 1],
                    }[answered.method],
                    self.now,
                )
        assert self.subject.topics == ["/a"]
        assert ("/a", URIS[0]) in self.connected


TestAnyMaster = AnyMaster.TestCase
TestAnyMaster.settings = settings(max_examples=60, stateful_step_count=40, deadline=None)
