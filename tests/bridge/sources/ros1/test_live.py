"""The source against Debian's real master, real rospy nodes and a real roscpp one (`rosbag play`)."""

from __future__ import annotations

import threading
import time
import xmlrpc.client

import pytest

from bridge.sources.ros1.graph import Graph, Listening, eventually
from rosbridge_eth.capture import Capture, RawMessage, Restoration, TopicRule, definition_line, parse_line
from rosbridge_eth.errors import SourceError
from rosbridge_eth.robot.sources import BagSource, Offer, Selection, sample_bag
from rosbridge_eth.robot.sources.queue import OVERHEAD
from rosbridge_eth.robot.sources.ros1.source import Ros1Source

pytestmark = pytest.mark.service


@pytest.fixture(scope="module")
def shared(require, tmp_path_factory):
    require("rosmaster")
    graph = Graph(tmp_path_factory.mktemp("ros"))
    graph.start_master()
    yield graph
    graph.close()


@pytest.fixture
def graph(shared):
    """The shared master, without what the test before has started."""
    yield shared
    for process in [process for process in shared.processes if process is not shared.master]:
        shared.kill(process)


@pytest.fixture
def own(require, tmp_path):
    """A graph that the test may break."""
    require("rosmaster")
    graph = Graph(tmp_path)
    yield graph
    graph.close()


def test_typed_custom_latched_empty_and_huge_messages(graph):
    huge, too_huge = 20_000_000, 40_000_000
    graph.publish("before", {"topic": "/latched", "kind": "text", "text": "hello", "count": 1, "latch": True})
    topics = ["/typed", "/custom", "/latched", "/nothing", "/huge"]
    with Listening(graph.uri, topics) as listening:
        graph.publish(
            "all_kinds",
            {"topic": "/typed", "kind": "odometry", "count": 50},
            {"topic": "/custom", "kind": "report", "count": 4},
            {"topic": "/nothing", "kind": "empty", "count": 3},
            {"topic": "/huge", "kind": "image", "size": huge, "count": 2},
        )
        odometry = listening.wait_for("/typed", 50)
        reports = listening.wait_for("/custom", 4)
        listening.wait_for("/nothing", 3)
        images = listening.wait_for("/huge", 2)
        latched = listening.wait_for("/latched", 1)
        graph.publish(
            "another", {"topic": "/huge", "kind": "image", "size": too_huge, "count": 1},
        )  # fmt: skip
        eventually(lambda: listening.lost == {("/huge", "too_large"): 1}, "the largest one is passed over")
        graph.publish("a_third", {"topic": "/huge", "kind": "image", "size": 1, "count": 1})
        assert listening.wait_for("/huge", 3)[-1]["width"] == 1

    assert [message["header"]["stamp"] for message in odometry] == [(4_000_000_000 + n) * 10**9 + n for n in range(50)]
    assert [message["pose"]["pose"]["position"]["x"] for message in odometry] == [n / 8 for n in range(50)]
    assert {raw.type_name for raw in listening.raw} == {
        "nav_msgs/msg/Odometry", "fleet_msgs/msg/Report", "std_msgs/msg/String", "std_msgs/msg/Empty",
        "sensor_msgs/msg/Image",
    }  # fmt: skip
    last = reports[3]
    assert (last["header"]["frame_id"], last["state"], last["last"]) == ("map", -1, True)
    assert last["span"] == [3 * 10**9 + 1, (2**32 - 1) * 10**9 + 2]
    assert last["readings"][2] == {"name": "r2", "values": [2.0, 2.5, -2.0], "raw": "AAE="}
    assert [len(message["readings"]) for message in reports] == [0, 1, 2, 3]
    assert latched == [{"data": "hello0"}]
    assert [image["data"]["length"] for image in images[:2]] == [huge, huge]
    assert images[0]["data"] != images[1]["data"]
    assert listening.data["/nothing"] == [{}, {}, {}]


def test_several_publishers_of_one_topic(graph):
    with Listening(graph.uri, ["/many"]) as listening:
        for name in "abc":
            graph.publish(f"publisher_{name}", {"topic": "/many", "kind": "text", "text": name, "count": 40})
        listening.wait_for("/many", 120)
        texts = [data["data"] for data in listening.data["/many"]]
    for name in "abc":
        assert [text for text in texts if text[0] == name] == [f"{name}{n}" for n in range(40)]


def test_a_topic_that_appears_later_is_complete_once_it_is_subscribed(graph):
    with Listening(graph.uri, ["/late/by_name", "/late/pattern_*"]) as listening:
        eventually(lambda: graph.subscribers("/late/by_name"), "the named topic is subscribed before it is published")
        graph.publish(
            "late",
            {"topic": "/late/by_name", "kind": "number", "count": 30},
            {"topic": "/late/pattern_1", "kind": "number", "count": 30},
            {"topic": "/late/else", "kind": "number", "count": 1, "latch": True},
        )
        for topic in ("/late/by_name", "/late/pattern_1"):
            listening.wait_for(topic, 30)
            assert listening.numbers(topic) == list(range(30))
        assert not graph.subscribers("/late/else")


def test_a_publisher_that_is_killed_and_started_again(graph):
    with Listening(graph.uri, ["/counted"]) as listening:
        first = graph.publish("counter", {"topic": "/counted", "kind": "number", "rate": 50})
        listening.wait_for("/counted", 20)
        graph.kill(first)
        eventually(lambda: listening.connected("/counted") == 0, "the loss is noticed")
        second = graph.publish("counter", {"topic": "/counted", "kind": "number", "rate": 50, "start": 10_000})
        eventually(lambda: 10_020 in listening.numbers("/counted"), "it is heard again")
        graph.kill(second)
    numbers = listening.numbers("/counted")
    resumed = numbers.index(10_000)  # it waits for its subscriber, so its first message arrives
    assert numbers[:resumed] == list(range(resumed))
    assert numbers[resumed:] == list(range(10_000, 10_000 + len(numbers) - resumed))
    assert listening.lost == {}


def test_a_master_that_is_not_there_yet_and_one_that_is_restarted(own):
    with Listening(own.uri, ["/steady", "/new_*"]) as listening:
        with pytest.raises(SourceError, match="does not answer"):
            listening.source.offers()
        own.start_master()
        own.publish("steady", {"topic": "/steady", "kind": "number", "rate": 50})
        listening.wait_for("/steady", 10)
        own.stop_master()
        during = listening.count("/steady")
        listening.wait_for("/steady", during + 20)
        own.start_master()
        eventually(lambda: own.subscribers("/steady"), "we are registered at the new master")
        # rospy does not register again: only the connection that was there before can bring its messages.
        after = listening.count("/steady")
        listening.wait_for("/steady", after + 20)
        own.publish("newcomer", {"topic": "/new_1", "kind": "number", "count": 5},
                    {"topic": "/steady", "kind": "number", "count": 5, "start": 10**6})  # fmt: skip
        listening.wait_for("/new_1", 5)
        eventually(lambda: 10**6 + 4 in listening.numbers("/steady"), "a second publisher at the new master")
        more = listening.count("/steady")
        listening.wait_for("/steady", more + 20)
    steady = [number for number in listening.numbers("/steady") if number < 10**6]
    assert steady == list(range(len(steady)))


def test_a_node_means_the_topics_it_publishes(graph):
    with Listening(graph.uri, nodes=["/base", "/arm_*"]) as listening:
        base = graph.publish("base", {"topic": "/base/a", "kind": "number", "count": 5},
                             {"topic": "/base/b", "kind": "text", "count": 5})  # fmt: skip
        graph.publish("arm_left", {"topic": "/shared_name", "kind": "number", "count": 5})
        graph.publish("other", {"topic": "/other", "kind": "number", "rate": 20}, wait=False)
        for topic in ("/base/a", "/base/b", "/shared_name"):
            listening.wait_for(topic, 5)
        graph.call("unregisterPublisher", "/base/a", "")  # of nobody: changes nothing
        assert set(listening.data) == {"/base/a", "/base/b", "/shared_name"}
        assert not graph.subscribers("/other")
        assert not graph.subscribers("/rosout")  # which both nodes publish, as every node does
        # As `rosnode cleanup` does it for a node that is gone.
        graph.kill(base)
        for topic in ("/base/a", "/base/b"):
            unregister_everyone(graph, topic)
        eventually(lambda: not graph.subscribers("/base/a"), "what nobody of that name publishes is left")
        assert graph.subscribers("/shared_name")


def unregister_everyone(graph: Graph, topic: str) -> None:
    with xmlrpc.client.ServerProxy(graph.uri) as master:
        for name, nodes in master.getSystemState("/test")[2][0]:
            for node in nodes if name == topic else ():
                master.unregisterPublisher(node, topic, master.lookupNode("/test", node)[2])


def test_rosbag_play_brings_the_bag_byte_for_byte(graph, require):
    """rosbag play is roscpp: the other client library."""
    require("rosbag")
    bag = BagSource(sample_bag(), Selection(["/robot_1/*"]), speed=None)
    expected = [(message.topic, message.raw) for message in bag.messages()]
    with Listening(graph.uri, ["/robot_1/*"]) as listening:
        play = graph.start("/usr/lib/rosbag/play", "--wait-for-subscribers", "-r", "10", "-q", str(sample_bag()))
        eventually(lambda: len(listening.raw) >= len(expected), f"{len(expected)} messages", 40)
        play.wait(10)
    for topic in ("/robot_1/odom", "/robot_1/imu"):
        # A roscpp publisher writes its own count into header.seq, the first four bytes.
        received = [raw.raw[4:] for raw in listening.raw if raw.topic == topic]
        assert received == [raw[4:] for name, raw in expected if name == topic]


def test_a_hundred_hertz_on_ten_topics_without_a_loss(graph):
    topics = [f"/fast_{n}" for n in range(10)]
    with Listening(graph.uri, ["/fast_*"]) as listening:
        for half in (topics[:5], topics[5:]):
            graph.publish(f"fast{half[0][-1]}",
                          *({"topic": topic, "kind": "number", "rate": 100, "count": 1000} for topic in half))
        for topic in topics:
            listening.wait_for(topic, 1000, 60)
    for topic in topics:
        assert listening.numbers(topic) == list(range(1000))
        assert (topic, "dropped") not in listening.lost


def test_what_is_published_now_is_offered_with_types_and_nodes(graph):
    graph.publish("offering", {"topic": "/offered", "kind": "odometry", "count": 1, "latch": True}, wait=False)
    source = Ros1Source(Selection(["/offered"]), master=graph.uri)
    assert source.live
    assert source.decoders() == {}
    assert Offer("/offered", "nav_msgs/msg/Odometry", ("/offering",)) in source.offers()


def test_the_end_comes_within_a_second_and_the_master_is_told(graph):
    topics = [f"/left_{n}" for n in range(30)]
    with Listening(graph.uri, topics) as listening:
        eventually(lambda: all(graph.subscribers(topic) for topic in topics), "30 topics are registered")
        started = time.monotonic()
    assert time.monotonic() - started < 10  # a second, and room for a machine that does other things
    assert not any(graph.subscribers(topic) for topic in topics)
    assert listening.raw == []


def test_a_node_that_takes_our_name_does_not_silence_us(graph):
    with Listening(graph.uri, ["/contested"], node="/recorder") as first:
        eventually(lambda: "/recorder" in graph.subscribers("/contested"), "the first has the name")
        with Listening(graph.uri, ["/contested"], node="/recorder") as second:
            eventually(lambda: len(graph.subscribers("/contested")) == 2, "the first goes on under another name")
            graph.publish("speaker", {"topic": "/contested", "kind": "number", "rate": 50})
            first.wait_for("/contested", 10)
            second.wait_for("/contested", 10)


def test_ros_tools_see_a_node_in_good_order(graph):
    with Listening(graph.uri, ["/watched"], node="/recorder"):
        eventually(lambda: graph.subscribers("/watched"), "registered")
        api = graph.call("lookupNode", "/recorder")[2]
        with xmlrpc.client.ServerProxy(api) as node:
            assert node.getPid("/test")[0] == 1
            assert node.getSubscriptions("/test") == [1, "", [["/watched", "*"]]]
            assert node.getPublications("/test") == [1, "", []]
            assert node.getMasterUri("/test")[2] == f"{graph.uri}/"
            assert node.requestTopic("/test", "/watched", [["TCPROS"]])[0] == 0
            assert node.paramUpdate("/test", "/x", 1) == [1, "", 0]
            assert node.getBusInfo("/test") == [1, "", []]
            assert node.getBusStats("/test") == [1, "", [[], [], []]]
            assert node.shutdown("/test", "please")[0] == 1
            with pytest.raises(xmlrpc.client.Fault):
                node.system.listMethods()
            assert node.getName("/test") == [1, "", "/recorder_2"]  # it is still there


def test_messages_are_dropped_and_counted_while_nobody_takes_them(graph):
    listening = Listening(graph.uri, ["/flood"], max_message=8 * (8 + OVERHEAD))
    take = threading.Event()
    listening.take = lambda raw: (take.wait(), listening.keep(raw))
    with listening:
        graph.publish("flood", {"topic": "/flood", "kind": "number", "count": 200})
        eventually(lambda: sum(listening.lost.values()) >= 200 - 17, "everything is received")
        dropped = listening.lost["/flood", "dropped"]
        take.set()
        listening.wait_for("/flood", 200 - dropped)
    numbers = listening.numbers("/flood")
    assert numbers[-15:] == list(range(185, 200))  # the newest are kept
    assert len(numbers) in (16, 17)  # as many as may wait, and the one that was being emitted
    assert listening.lost["/flood", "dropped"] == dropped == 200 - len(numbers)


def test_what_is_captured_of_a_live_robot_can_be_rebuilt_from_its_lines(graph):
    """rospy to lines, and from the lines alone back to the bytes that rospy sent, a type of nobody's included."""
    capture = Capture([TopicRule("/logged/**")], source_kind=Ros1Source.kind, live=True)
    found: list[tuple[RawMessage, bytes]] = []

    def take(raw: RawMessage) -> None:
        found.append((raw, capture.process(raw, time.time_ns(), True).line))

    listening = Listening(graph.uri, ["/logged/**"])
    listening.take = take
    with listening:
        graph.publish(
            "logged",
            {"topic": "/logged/odom", "kind": "odometry", "count": 40, "rate": 50},
            {"topic": "/logged/report", "kind": "report", "count": 5, "rate": 10},
        )
        eventually(lambda: len(found) == 45, "45 records")
    restorations = {
        raw.type_name: Restoration(parse_line(definition_line(raw.decoder)).decoder()) for raw, _ in found
    }
    assert restorations.keys() == {"nav_msgs/msg/Odometry", "fleet_msgs/msg/Report"}
    for raw, line in found:
        record, restoration = parse_line(line), restorations[raw.type_name]
        assert (record.source, record.clock) == ("ros1", True)
        assert 0 < record.captured_ns - record.received_ns < 10**10
        assert restoration.decoder.encode(restoration.restore(record.data).message) == raw.raw
    assert capture.loss_lines(listening.lost) == []
