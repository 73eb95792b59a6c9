"""Whatever a publisher, a master or a caller of our API says: an honest publisher is heard, and memory stays bounded.

The honest one publishes /good the whole time; the test is over when it was
heard after the hostile one had its say.
"""

from __future__ import annotations

import errno
import socket
import struct
import threading
import time
import tracemalloc
import xmlrpc.client

import pytest

from bridge.sources.ros1.graph import Listening, eventually
from bridge.sources.ros1.impostors import (
    GOOD,
    Master,
    Peer,
    Publisher,
    answering,
    closing_all,
    counting,
    dribbling,
    flooding,
    numbered,
    saying,
)
from rosbridge_eth.robot.sources.ros1 import source
from rosbridge_eth.robot.sources.ros1.tcpros import encode_header

MIB = 2**20


@pytest.fixture
def master():
    master = Master()
    honest = Publisher(counting(GOOD))
    master.publishers["/good"] = [honest.uri]
    with closing_all(master, honest):
        yield master


def still_heard(listening: Listening) -> None:
    """More of the honest publisher arrives."""
    listening.wait_for("/good", listening.count("/good") + 50)


def changed(**fields: str) -> bytes:
    return encode_header({**GOOD, **fields})


def without(*names: str) -> bytes:
    return encode_header({name: value for name, value in GOOD.items() if name not in names})


BAD_HEADERS = {
    "nothing at all": b"",
    "half a length": b"\x01\0",
    "not TCPROS": b"HTTP/1.0 200 OK\r\n\r\n",
    "a header of 4 GiB": b"\xff\xff\xff\xff" + bytes(1000),
    "a field longer than the header": struct.pack("<II", 10, 2**31) + b"abcdef",
    "no type": without("type"),
    "no md5 sum": without("md5sum"),
    "an error": encode_header({"error": "go away"}),
    "any type": changed(type="*"),
    "a type that is no name": changed(type="__import__('os')/x"),
    "an md5 sum that is none": changed(md5sum="*"),
    "the md5 sum of another definition": changed(md5sum="0" * 32),
    "no definition of an unknown type": changed(type="a/B", message_definition=""),
    "another definition than the type's": changed(message_definition="uint32 data"),
    "code for a definition": changed(message_definition="uint8 x\nimport os; os.abort()"),
    "a field's name that is code": changed(message_definition="uint8 x=(1)\nuint8 __class__"),
    "a type within itself": changed(message_definition="UInt64 x"),
    "an array beyond memory": changed(message_definition="uint64[4294967295] x"),
    "a definition that is not text": encode_header(GOOD).replace(b"uint64", b"\xff\xfe\x00int"),
    "a definition of 300 kB": changed(message_definition="# comment\n" * 30_000),
    "messages out of step": changed() + b"\xff" * 64,
}


def test_publishers_that_are_none_are_left_counted_said_once_and_tried_again(master, caplog):
    topics = {name: f"/t{number}" for number, name in enumerate(BAD_HEADERS)}
    hostile = {name: Publisher(saying(data)) for name, data in BAD_HEADERS.items()}
    master.publishers |= {topics[name]: [publisher.uri] for name, publisher in hostile.items()}
    with closing_all(*hostile.values()), Listening(master.uri, [*topics.values(), "/good"]) as listening:
        for name in BAD_HEADERS:
            eventually(lambda name=name: hostile[name].data.connections >= 3, f"{name}: it is tried again")
            assert listening.count(topics[name]) == 0, name
        still_heard(listening)
    for name, topic in topics.items():
        said = [record.levelname for record in caplog.records if f"{topic}: the publisher" in record.getMessage()]
        assert said == ["WARNING"], name
        # Every RESOLVE_EVERY seconds; a loop without a wait would have connected thousands of times.
        assert hostile[name].data.connections < 12, name


def answer(value: object) -> bytes:
    return xmlrpc.client.dumps((value,), methodresponse=True).encode()  # type: ignore[arg-type]


BAD_ANSWERS = {
    "no XML": b"hello",
    "no answer of ROS": answer(1),
    "a fault": xmlrpc.client.dumps(xmlrpc.client.Fault(1, "no")).encode(),
    "a refusal": answer([0, "no", 0]),
    "another protocol": answer([1, "", ["UDPROS", "h", 1, 2, 3]]),
    "no port": answer([1, "", ["TCPROS", "h", 70000]]),
    "a host that is none": answer([1, "", ["TCPROS", "a b", 1]]),
    "a host without an address": answer([1, "", ["TCPROS", "x.invalid", 1]]),
    "a port where nobody listens": answer([1, "", ["TCPROS", "127.0.0.1", 1]]),
    "too much": b"x" * (2 * MIB),
}
BAD_URIS = ["nonsense", "http://127.0.0.1:1/", "http://127.0.0.1", "http://" + "a" * 5000]


def test_nodes_that_answer_nonsense_or_are_none_are_tried_again(master):
    hostile = {name: Peer(answering(body)) for name, body in BAD_ANSWERS.items()}
    topics = {name: f"/t{number}" for number, name in enumerate(hostile)}
    master.publishers |= {topics[name]: [peer.uri] for name, peer in hostile.items()}
    master.publishers["/nowhere"] = BAD_URIS * 2
    with closing_all(*hostile.values()), Listening(master.uri, [*topics.values(), "/nowhere", "/good"]) as listening:
        for name, peer in hostile.items():
            eventually(lambda peer=peer: peer.connections >= 3, f"{name}: it is tried again")
        still_heard(listening)
        assert listening.count("/nowhere") == 0


@pytest.mark.parametrize(
    "conversation",
    [dribbling(b"", 60), saying(struct.pack("<I", 1000) + b"x", then_stay=True)],
    ids=["silence", "half a header"],
)
@pytest.mark.parametrize("where", ["api", "data"])
def test_a_publisher_that_never_finishes_its_header_is_given_up(master, conversation, where):
    hostile = Peer(conversation) if where == "api" else Publisher(conversation)
    peer = hostile if isinstance(hostile, Peer) else hostile.data
    master.publishers["/t"] = [hostile.uri]
    with closing_all(hostile), Listening(master.uri, ["/t", "/good"], timeout=0.3) as listening:
        eventually(lambda: peer.connections >= 2, "it is given up and tried again")
        still_heard(listening)


def test_a_publisher_that_stops_within_a_message_is_given_up(master, monkeypatch):
    monkeypatch.setattr(source, "STALLED", 0.3)
    hostile = Publisher(saying(changed() + numbered(7) + b"\x08\0\0\0\1\2", then_stay=True))
    master.publishers["/t"] = [hostile.uri]
    with closing_all(hostile), Listening(master.uri, ["/t", "/good"]) as listening:
        eventually(lambda: hostile.data.connections >= 2, "it is given up and tried again")
        assert set(listening.numbers("/t")) <= {7}
        still_heard(listening)


def test_two_types_of_one_topic_are_both_read_each_by_its_own_definition(master):
    uint8 = changed(type="std_msgs/UInt8", message_definition="uint8 data", md5sum="7c8164229e7d2c17eb95e9231617fdee")
    first = Publisher(counting(GOOD, 20))
    other = Publisher(saying(uint8 + b"\1\0\0\0\7", then_stay=True))
    master.publishers["/t"] = [first.uri]
    with closing_all(first, other), Listening(master.uri, ["/t", "/good"]) as listening:
        listening.wait_for("/t", 3)
        master.publishers["/t"] = [first.uri, other.uri]
        kinds = {"std_msgs/msg/UInt64", "std_msgs/msg/UInt8"}
        eventually(lambda: {raw.type_name for raw in listening.raw if raw.topic == "/t"} == kinds, "both are read")
        still_heard(listening)


def test_messages_that_do_not_fit_their_definition_do_not_end_anything(master):
    text = {**GOOD, "type": "std_msgs/String", "message_definition": "string data",
            "md5sum": "992ce8a1687cec8c8bd883ec73ca41d1"}  # fmt: skip
    bad = [b"", b"\1", b"\xff\xff\xff\xff", b"\xff\xff\xff\x7fabc", b"\1\0\0\0", b"\2\0\0\0\xff\xfe"]
    stream = b"".join(struct.pack("<I", len(body)) + body for body in [*bad, b"\2\0\0\0ok"])
    hostile = Publisher(saying(encode_header(text) + stream, then_stay=True))
    master.publishers["/t"] = [hostile.uri]
    with closing_all(hostile), Listening(master.uri, ["/t", "/good"], tolerant=True) as listening:
        listening.wait_for("/t", 1)
        assert listening.data["/t"] == [{"data": "ok"}]
        assert listening.capture.lost["/t", "undecodable"] == len(bad)
        assert listening.connected("/t") == 1
        still_heard(listening)


@pytest.mark.parametrize("name", ["a flood of small ones", "large ones", "half a large one of each", "passed over"])
def test_memory_is_bounded(master, name):
    """8 publishers send as much as is taken; nothing is taken out."""
    largest = 4 * MIB
    head = changed()
    conversation = {
        "a flood of small ones": flooding(head, numbered(1) * 5000),
        "large ones": flooding(head, struct.pack("<I", largest) + bytes(largest)),
        "half a large one of each": saying(head + struct.pack("<I", largest) + bytes(largest - 1), then_stay=True),
        "passed over": flooding(head + struct.pack("<I", 900 * MIB), bytes(MIB)),
    }[name]
    hostile = [Publisher(conversation) for _ in range(8)]
    master.publishers["/t"] = [publisher.uri for publisher in hostile]
    master.publishers.pop("/good")
    gate = threading.Event()
    listening = Listening(master.uri, ["/t"], max_message=largest, tolerant=True)
    listening.take = lambda raw: (gate.wait(20), listening.keep(raw))
    tracemalloc.start()
    try:
        with closing_all(*hostile), listening:
            eventually(lambda: sum(publisher.data.connections for publisher in hostile) == 8, "all are connected")
            until = time.monotonic() + 1.5
            while time.monotonic() < until:
                time.sleep(0.1)
            _, peak = tracemalloc.get_traced_memory()
            listening.stop.set()
            gate.set()
    finally:
        tracemalloc.stop()
    # Two of the largest that wait, and one for each connection, as documented; then what the hostile ones hold.
    assert peak < (2 + len(hostile) + 1) * largest + 4 * MIB, peak


def test_our_api_takes_any_bytes_from_anyone(master):
    with Listening(master.uri, ["/good"], timeout=0.5) as listening:
        eventually(lambda: master.apis, "registered")
        host, _, port = next(iter(master.apis.values())).removeprefix("http://").rstrip("/").partition(":")
        for data in (b"", b"\0" * 100, b"GET / HTTP/1.0\r\n\r\n", b"POST / HTTP/1.1\r\nContent-Length: 3\r\n\r\nabc",
                     b"POST / HTTP/1.1\r\nContent-Length: 999999999999\r\n\r\n", b"x" * 100_000):  # fmt: skip
            with socket.create_connection((host, int(port)), 5) as caller:
                try:
                    caller.sendall(data)
                    caller.shutdown(socket.SHUT_WR)
                    assert b"<params>" not in caller.recv(10_000), "at most a fault"
                except OSError as error:  # closed before all was said
                    assert error.errno in (errno.ECONNRESET, errno.EPIPE, errno.ENOTCONN)
        silent = [socket.create_connection((host, int(port)), 5) for _ in range(200)]
        with xmlrpc.client.ServerProxy(f"http://{host}:{port}") as api:
            assert api.getPid("/x")[0] == 1
            # An update is a doorbell: a publisher named here, but not by the master, is not connected to.
            liar = Peer(saying(b""))
            with closing_all(liar):
                assert api.publisherUpdate("/master", "/good", [liar.uri])[0] == 1
                assert api.publisherUpdate("/master", "/unknown", [liar.uri])[0] == 1
                with pytest.raises(xmlrpc.client.Fault):
                    api.publisherUpdate("/master")
                still_heard(listening)
                assert liar.connections == 0
        for caller in silent:
            caller.close()


def test_a_master_that_hangs_does_not_hold_up_the_messages(master):
    with Listening(master.uri, ["/good"], timeout=0.5) as listening:
        listening.wait_for("/good", 10)
        master.hanging = True  # from the next registration on: its only thread hangs
        with xmlrpc.client.ServerProxy(next(iter(master.apis.values()))) as api:
            api.publisherUpdate("/master", "/good", [])
        still_heard(listening)
        started = time.monotonic()
    assert time.monotonic() - started < 15
