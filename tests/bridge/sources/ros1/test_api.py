"""Calls of ROS 1's APIs, and our own: whatever is answered, it is a value or an error."""

from __future__ import annotations

import contextlib
import socket
import threading
import time
import xmlrpc.client

import pytest
from hypothesis import example, given, settings
from hypothesis import strategies as st

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
    saying,
)
from rosbridge_eth.config import Address
from rosbridge_eth.robot.sources import Offer
from rosbridge_eth.robot.sources.ros1 import api
from rosbridge_eth.robot.sources.ros1.api import ProtocolError


def asked(conversation, timeout: float = 5.0):
    """What a call says that is answered so."""
    peer = Peer(conversation)
    with closing_all(peer):
        return api.call(Address("127.0.0.1", peer.port), timeout, lambda value: value, "getPid", "/me")


def answered(value: object) -> bytes:
    return xmlrpc.client.dumps((value,), methodresponse=True, allow_none=True).encode()  # type: ignore[arg-type]


TEXT = st.text(st.characters(codec="utf-8", exclude_categories=["Cs", "Cc"]), max_size=30)
SCALARS = st.one_of(st.integers(-(2**31), 2**31 - 1), st.booleans(), TEXT, st.just(1.5), st.just(b"abc"))
VALUES = st.recursive(SCALARS, lambda inner: st.lists(inner, max_size=4) | st.dictionaries(TEXT, inner, max_size=3))


@settings(max_examples=50)
@given(VALUES)
def test_what_python_answers_is_read(value):
    assert asked(answering(answered([1, "", value]))) == value


@pytest.mark.parametrize(
    "head",
    [
        b"HTTP/1.1 200 OK\r\nServer: x\r\n\r\n",
        b"HTTP/1.0 200 OK\r\nContent-Length: %d\r\n\r\n",
        b"HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\n%x\r\n",
    ],
)
def test_an_answer_may_end_with_its_length_its_connection_or_its_chunks(head):
    body = answered([1, "", "x"])
    data = head % len(body) + body if b"%" in head else head + body
    assert asked(saying(data + (b"\r\n0\r\n\r\n" if b"chunked" in head else b""))) == "x"


def test_a_value_without_a_type_is_a_string():
    # As roscpp's XmlRpc++ writes it.
    body = b"<?xml version=\"1.0\"?>\r\n<methodResponse><params><param>\r\n\t<value><array><data>"
    body += b"<value><i4>1</i4></value><value>ready </value><value><array><data><value/><value><string/></value>"
    body += b"</data></array></value></data></array></value>\r\n</param></params></methodResponse>\r\n"
    assert asked(answering(body)) == ["", ""]


LAUGHS = b"""<?xml version="1.0"?><!DOCTYPE l [<!ENTITY a "ha"><!ENTITY b "&a;&a;&a;&a;&a;&a;">]>
<methodResponse><params><param><value>&b;</value></param></params></methodResponse>"""


def wrapped(value: str) -> bytes:
    return f"<methodResponse><params><param>{value}</param></params></methodResponse>".encode()


@pytest.mark.parametrize(
    "body",
    [
        b"", b"not XML", b"<methodResponse>", b"<other/>", b"<methodResponse/>",
        LAUGHS,
        LAUGHS.decode().replace("?>", " encoding='utf-16'?>", 1).encode("utf-16"),
        b"<?xml version='1.0' encoding='klingon'?><methodResponse/>",
        b"<?xml version='1.0' encoding='cp037'?>" + LAUGHS.decode().partition("?>")[2].encode("cp037"),
        wrapped("<value><array><data>" * 1000 + "</data></array></value>" * 1000),
        wrapped("<value><int>one</int></value>"),
        wrapped("<value><int></int></value>"),
        wrapped(f"<value><int>{'9' * 5000}</int></value>"),
        wrapped("<value><boolean>2</boolean></value>"),
        wrapped("<value><base64>a</base64></value>"),
        wrapped("<value><bigdecimal>x</bigdecimal></value>"),
        wrapped("<value><dateTime.iso8601>x</dateTime.iso8601></value>"),
        wrapped("<value><struct><member><value>1</value></member></struct></value>"),
        wrapped("<value>1</value><value>2</value>"),
        answered(1), answered([1, ""]), answered(["1", "", 1]), answered([0, "no", 0]),
        xmlrpc.client.dumps(xmlrpc.client.Fault(1, "no such thing")).encode(),
    ],
)  # fmt: skip
def test_what_is_not_an_answer_of_ros_is_refused(body):
    with pytest.raises((ProtocolError, api.Refusal)):
        asked(answering(body))


@pytest.mark.parametrize(
    "data",
    [
        b"", b"\0" * 100, b"GET / HTTP/1.0\r\n\r\n", b"a" * 100_000,
        b"HTTP/1.0 404 Not Found\r\n\r\n", b"HTTP/1.0 302 Found\r\nLocation: http://127.0.0.1:1/\r\n\r\n",
        b"HTTP/1.1 200 OK\r\nContent-Length: -1\r\n\r\n", b"HTTP/1.1 200 OK\r\nContent-Length: 50\r\n\r\nab",
        b"HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\nzz\r\n", b"HTTP/1.1 200 OK\r\n" + b"a: b\r\n" * 1000,
        b"HTTP/1.1 200 OK\r\nContent-Encoding: gzip\r\n\r\n" + answered([1, "", "x"])[:50],
    ],
)  # fmt: skip
def test_what_is_not_an_answer_of_http_is_refused(data):
    with pytest.raises((ProtocolError, OSError)):
        asked(saying(data))


@pytest.mark.parametrize(
    "conversation",
    [dribbling(b"", 60), saying(b"HTTP/1.0 200 OK\r\nContent-Length: 9\r\n\r\nx", then_stay=True)],
    ids=["silence", "half an answer"],
)
def test_a_call_that_is_not_answered_ends_in_time(conversation):
    started = time.monotonic()
    with pytest.raises(TimeoutError):
        asked(conversation, 0.3)
    assert time.monotonic() - started < 5


TAGS = ["methodResponse", "methodCall", "methodName", "params", "param", "value", "array", "data", "struct", "member",
        "name", "fault", "int", "i4", "boolean", "string", "double", "base64", "nil", "bigdecimal"]  # fmt: skip


@settings(max_examples=50)
@given(st.recursive(TEXT, lambda inner: st.builds(
    lambda tag, parts: f"<{tag}>{''.join(parts)}</{tag}>", st.sampled_from(TAGS), st.lists(inner, max_size=4))))
@example("<array></array>")
@example("<value><array><value><int>1</int></value><value/></array></value>")
def test_any_arrangement_of_tags_is_a_value_or_an_error(text):
    text = text.replace("&", "")
    for body in (text.encode(), wrapped(text), wrapped(f"<value>{text}</value>")):
        with contextlib.suppress(ProtocolError, api.Refusal):
            asked(answering(body))


ANY = st.recursive(
    st.one_of(st.none(), st.booleans(), st.integers(-5, 5), TEXT),
    lambda inner: st.lists(inner, max_size=4) | st.dictionaries(TEXT, inner, max_size=2),
)


@settings(max_examples=30)
@given(ANY)
@example([[["/a", ["/n"]]], [], []])
@example([[["/a", ["/n"], 1]], [], []])
def test_any_value_is_what_was_asked_for_or_an_error(value):
    peer = Peer(answering(answered([1, "", value])))
    with closing_all(peer):
        for read in (api.system_state, api.strings, api.tcpros_address, api.topic_types):
            with contextlib.suppress(ProtocolError):
                api.call(Address("127.0.0.1", peer.port), 5.0, read, "getPid", "/me")


def test_offers_are_sorted_and_leave_out_what_is_no_topic():
    publishers = {"/b": ["/y", "/x", "/x"], "/a b": ["/x"], "/a": ["/x"], "/rosout": ["/x"]}
    assert api.offers(publishers, {"/a": "a/B", "/b": "*", "/c": "../d"}) == (
        Offer("/a", "a/msg/B", ("/x",)), Offer("/b", "*", ("/x", "/y")), Offer("/rosout", "*", ()),
    )  # fmt: skip


def test_names_that_never_resolve_do_not_keep_us_from_the_master(monkeypatch):
    real, released, hanging = socket.getaddrinfo, threading.Event(), set()

    def slow(host, *arguments, **options):
        if str(host).endswith(".slow"):
            hanging.add(host)
            released.wait(30)
            raise socket.gaierror(-3, "Temporary failure in name resolution")
        return real(host, *arguments, **options)

    monkeypatch.setattr(socket, "getaddrinfo", slow)
    master, honest = Master(), Publisher(counting(GOOD))
    master.publishers["/t"] = [f"http://robot_{n}.slow:1/" for n in range(40)]
    with closing_all(master, honest):
        by_name = master.uri.replace("127.0.0.1", "localhost")
        with Listening(by_name, ["/t", "/good_*"], timeout=0.5) as listening:
            eventually(lambda: len(hanging) == 40, "the names are asked for")
            master.publishers["/good_1"] = [honest.uri]
            listening.wait_for("/good_1", 10)
            started = time.monotonic()
        assert time.monotonic() - started < 20
        released.set()
