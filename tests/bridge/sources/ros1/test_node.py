"""What our node asks of a master, and whom it is connected to: calls are answered by a script, turn by turn."""

from __future__ import annotations

from collections.abc import Callable

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rosbridge_eth.robot.sources import Selection
from rosbridge_eth.robot.sources.ros1 import api
from rosbridge_eth.robot.sources.ros1.api import ProtocolError
from rosbridge_eth.robot.sources.ros1.source import Publisher, Ros1Source

API = "http://me:1/"


class Script:
    """A master: `state` is what it says, and `calls` what it was asked since it was last looked at."""

    def __init__(self, subject: Ros1Source) -> None:
        self.subject = subject
        self.publishers: dict[str, list[str]] = {}  # APIs by topic
        self.subscribers: dict[str, set[str]] = {}
        self.apis: dict[str, str] = {}
        self.calls: list[str] = []
        self.failure: Exception | None = None

    def __call__(self, endpoint, timeout, read, method, caller, *parameters):
        self.calls.append(" ".join([method, *(p for p in parameters[:1] if method.endswith("Subscriber"))]))
        if self.failure is not None:
            raise self.failure
        return read(getattr(self, method)(caller, *parameters))

    def getSystemState(self, _caller):
        publishers = [[topic, [f"/n_{uri}" for uri in uris]] for topic, uris in self.publishers.items()]
        return [publishers, [[topic, sorted(nodes)] for topic, nodes in self.subscribers.items()], []]

    def registerSubscriber(self, caller, topic, _type, uri):
        self.apis[caller] = uri
        self.subscribers.setdefault(topic, set()).add(caller)
        return list(self.publishers.get(topic, ()))

    def unregisterSubscriber(self, caller, topic, _uri):
        self.subscribers.get(topic, set()).discard(caller)
        return 1

    def turn(self) -> list[str]:
        """One look; the calls besides those of every look."""
        self.calls.clear()
        self.subject._look()
        return [call for call in self.calls if call != "getSystemState"]


@pytest.fixture
def begun(monkeypatch):
    """Publishers whose threads were started; none runs."""
    started: list[Publisher] = []
    monkeypatch.setattr(Publisher, "start", lambda publisher: started.append(publisher))
    return started


def scripted(patch: pytest.MonkeyPatch, *topics: str, nodes: tuple[str, ...] = ()) -> Script:
    subject = Ros1Source(Selection(topics, nodes), master="http://m:1", node="me", max_message=1 << 20, timeout=1.0)
    subject._uri = API
    script = Script(subject)
    patch.setattr(api, "call", script)
    return script


@pytest.fixture
def make(monkeypatch, begun) -> Callable[..., Script]:
    return lambda *topics, **options: scripted(monkeypatch, *topics, **options)


def connected(script: Script, topic: str) -> list[str]:
    state = script.subject._topics.get(topic)
    return list(state.publishers) if state is not None else []


def ends(publisher: Publisher, error: Exception | None = None) -> None:
    """Its connection ends, or was never made."""
    with pytest.MonkeyPatch.context() as patch:

        def read() -> None:
            raise error or EOFError

        patch.setattr(publisher, "_read", read)
        publisher.run()
    assert publisher.over.is_set()


def read_from(publisher: Publisher) -> None:
    """As if its header had been accepted."""
    publisher.connected = True


def test_a_named_topic_is_registered_before_anybody_publishes_it(make):
    script = make("/a", "/b*")
    assert script.turn() == ["registerSubscriber /a"]
    assert script.turn() == []


def test_a_pattern_is_registered_when_it_matches_and_left_when_it_does_not(make, begun):
    script = make("/b*")
    script.publishers = {"/b1": ["http://x:1/"], "/c": ["http://x:1/"]}
    assert script.turn() == ["registerSubscriber /b1"]
    assert connected(script, "/b1") == ["http://x:1/"]
    script.publishers = {}
    assert script.turn() == ["unregisterSubscriber /b1"]
    assert begun[0].over.is_set()
    assert script.subject._topics == {}
    assert script.turn() == []


def test_a_name_that_nobody_publishes_is_said_after_every_change_of_the_topics(make, caplog):
    script = make("/a")
    script.turn()
    script.turn()
    script.subject.watch(Selection(["/a", "/b"]))
    script.turn()
    script.turn()
    assert [record.message for record in caplog.records if "/a" in record.message] == [
        "nothing publishes /a yet; waiting for it"
    ]
    assert [record.message for record in caplog.records if "/b" in record.message] == [
        "nothing publishes /b yet; waiting for it"
    ]


def test_the_doorbell_has_the_master_asked_and_nothing_believed(make, begun):
    script = make("/a")
    script.publishers = {"/a": ["http://x:1/"]}
    script.turn()
    assert script.subject._answer("publisherUpdate", ["/master", "/a", ["http://liar:1/"]]) == [1, "", 0]
    assert script.subject._answer("publisherUpdate", ["/master", "/unknown", ["http://liar:1/"]]) == [1, "", 0]
    script.publishers = {"/a": ["http://y:1/"]}
    assert script.turn() == ["registerSubscriber /a"]
    assert connected(script, "/a") == ["http://x:1/", "http://y:1/"], "a connection lasts until it ends by itself"
    ends(begun[0])
    assert (begun[0].over.is_set(), begun[1].over.is_set()) == (True, False), "it is not made again"
    assert script.turn() == ["registerSubscriber /a"]
    assert connected(script, "/a") == ["http://y:1/"]
    assert script.turn() == []


def test_publishers_come_to_light_even_if_the_doorbell_never_rings(make):
    script = make("/a")
    script.turn()
    script.publishers = {"/a": ["http://x:1/"]}
    assert script.turn() == ["registerSubscriber /a"]
    assert connected(script, "/a") == ["http://x:1/"]
    # One that starts anew under its name, at another address: when its connection has ended, the master is asked.
    [publisher] = script.subject._topics["/a"].publishers.values()
    script.subject.ended(publisher, EOFError())
    assert script.turn() == ["registerSubscriber /a"]


def test_a_restarted_master_is_told_again_and_living_connections_are_kept(make, begun):
    script = make("/a")
    script.publishers = {"/a": ["http://living:1/", "http://dead:1/"]}
    script.turn()
    living, dead = begun
    read_from(living)
    script.publishers, script.subscribers, script.apis = {}, {}, {}  # publishers do not register again
    assert script.turn() == ["registerSubscriber /a"]
    ends(dead)
    assert (living.over.is_set(), dead.over.is_set()) == (False, True)
    script.turn()
    assert connected(script, "/a") == ["http://living:1/"]
    ends(living)
    script.turn()
    assert connected(script, "/a") == [], "once it has ended, there is nobody to ask for it again"


def test_a_publisher_that_registers_again_at_the_new_master_is_an_ordinary_one_again(make, begun):
    script = make("/a")
    script.publishers = {"/a": ["http://x:1/"]}
    script.turn()
    read_from(begun[0])
    script.publishers, script.subscribers, script.apis = {}, {}, {}
    script.turn()
    assert begun[0].uri not in begun[0].topic.listed
    script.publishers = {"/a": ["http://x:1/"]}
    script.turn()
    assert begun[0].uri in begun[0].topic.listed
    assert len(begun) == 1


def test_a_name_that_was_taken_is_left_to_the_other(make):
    script = make("/a")
    script.turn()
    script.subscribers = {"/a": {"/me"}}  # the other one
    assert script.subject._answer("shutdown", ["/master", "new node registered with same name"])[0] == 1
    assert script.turn() == ["registerSubscriber /a"]
    assert script.subject.caller_id == "/me_2"
    assert script.subscribers == {"/a": {"/me", "/me_2"}}
    assert script.turn() == []


def test_a_dead_namesake_from_before_is_replaced(make):
    script = make("/a")
    script.apis["/me"], script.subscribers = "http://dead:1/", {"/a": {"/me"}}
    assert script.turn() == ["registerSubscriber /a"]
    assert (script.subject.caller_id, script.apis["/me"]) == ("/me", API)


def test_a_farewell_that_did_not_reach_the_master_is_said_again(make):
    script = make("/a")
    script.subscribers = {"/old": {"/me"}, "/foreign": {"/other"}}
    assert script.turn() == ["unregisterSubscriber /old", "registerSubscriber /a"]
    assert script.subscribers["/foreign"] == {"/other"}


@pytest.mark.parametrize("failure", [ProtocolError("nonsense"), ConnectionRefusedError(), TimeoutError(), EOFError()])
def test_a_master_that_fails_is_said_once_and_asked_again(make, begun, caplog, failure):
    script = make("/a")
    script.publishers = {"/a": ["http://x:1/"]}
    script.turn()
    script.failure = failure
    for _ in range(3):
        script.turn()
    assert len([record for record in caplog.records if "the master does not answer" in record.getMessage()]) == 1
    assert not begun[0].over.is_set()
    script.failure = None
    assert script.turn() == []


def test_a_refused_topic_does_not_keep_the_others_waiting(make, caplog):
    script = make("/a", "/b")

    def refuse(caller, topic, *more):
        if topic == "/a":
            raise api.Refusal("not you")
        return Script.registerSubscriber(script, caller, topic, *more)

    script.registerSubscriber = refuse
    assert script.turn() == ["registerSubscriber /a", "registerSubscriber /b"]
    assert script.turn() == ["registerSubscriber /a"]
    assert "does not take a subscription to /a: not you" in caplog.text


ENDS = {"closed": EOFError(), "reset": ConnectionResetError(), "silent": TimeoutError(), "nonsense": ProtocolError("x")}


@pytest.mark.parametrize("error", ENDS.values(), ids=ENDS)
@pytest.mark.parametrize("before", [False, True], ids=["never read from", "read from"])
def test_a_connection_is_made_again_at_the_next_look_and_at_once_where_it_was_good(make, begun, before, error):
    script = make("/a")
    script.publishers = {"/a": ["http://x:1/"]}
    script.turn()
    begun[0].connected = before
    ends(begun[0], error)
    assert script.subject._rung.is_set() == (before and not isinstance(error, ProtocolError))
    assert script.turn() == ["registerSubscriber /a"]
    assert [publisher.over.is_set() for publisher in begun] == [True, False]


VALUES = st.recursive(
    st.one_of(st.integers(-2, 2), st.sampled_from(["/a", "/b/1", "/me", "/n1", "http://p:1/", API]), st.none()),
    lambda inner: st.lists(inner, max_size=3),
    max_leaves=8,
)
URIS = st.lists(st.sampled_from([f"http://p:{n}/" for n in range(1, 4)]))
TOPICS = st.sampled_from(["/a", "/b/1", "/b/2", "/c"])
PAIRS = st.lists(st.tuples(TOPICS, st.lists(st.sampled_from(["/me", "/n1", "/n2"]))).map(list))
TURNS = st.lists(
    st.fixed_dictionaries({
        "getSystemState": st.one_of(st.tuples(PAIRS, PAIRS, st.just([])).map(list), VALUES),
        "registerSubscriber": st.one_of(URIS, VALUES),
        "unregisterSubscriber": VALUES,
        "failing": st.sampled_from(["", "", "", "getSystemState", "registerSubscriber"]),
        "ends": st.booleans(),
    }),
    max_size=6,
)  # fmt: skip


@given(TURNS)
@settings(max_examples=150)
def test_after_a_master_that_answers_anything_one_that_answers_again_has_us_registered(turns):
    with pytest.MonkeyPatch.context() as patch:
        begun: list[Publisher] = []
        patch.setattr(Publisher, "start", lambda publisher: begun.append(publisher))
        script = scripted(patch, "/a", "/b/*", nodes=("/n1",))
        for turn in turns:

            def answer(_endpoint, _timeout, read, method, *_more, turn=turn):
                if method == turn["failing"]:
                    raise TimeoutError
                try:
                    return read(turn[method])
                except (TypeError, ValueError) as error:
                    raise ProtocolError(str(error)) from None

            patch.setattr(api, "call", answer)
            script.subject._look()
            for publisher in begun if turn["ends"] else ():
                script.subject.ended(publisher, EOFError())
            uris = [(p.name, p.uri) for p in begun if not p.over.is_set()]
            assert len(uris) == len(set(uris)), "one connection for each publisher"
        for publisher in begun:  # the living ones would end one day
            script.subject.ended(publisher, EOFError())
        patch.setattr(api, "call", script)
        script.publishers = {"/a": ["http://p:1/"]}
        for _ in range(4):
            script.turn()
        assert script.subscribers["/a"] == {script.subject.caller_id}
        assert connected(script, "/a") == ["http://p:1/"]
        assert [topic for topic in script.subject._topics if not connected(script, topic)] == []
        assert script.turn() == []
