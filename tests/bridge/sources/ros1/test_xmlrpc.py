"""XML-RPC and its HTTP: against Python's own xmlrpc.client, which is what rospy and the master speak with."""

from __future__ import annotations

import contextlib
import itertools
import xmlrpc.client

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from rosbridge_eth.sources.ros1.errors import ProtocolError
from rosbridge_eth.sources.ros1.http import MAX_HEAD, BodyReader, encode_request, encode_response
from rosbridge_eth.sources.ros1.xmlrpc import (
    MAX_DEPTH,
    Fault,
    decode_answer,
    decode_call,
    encode_answer,
    encode_call,
    encode_fault,
)

TEXT = st.text(st.characters(codec="utf-8", exclude_categories=["Cs", "Cc"]), max_size=30)
SCALARS = st.one_of(st.integers(-(2**31), 2**31 - 1), st.booleans(), TEXT)
VALUES = st.recursive(SCALARS, lambda inner: st.lists(inner, max_size=4) | st.dictionaries(TEXT, inner, max_size=3))


@given(VALUES)
def test_what_python_answers_is_read(value):
    body = xmlrpc.client.dumps((value,), methodresponse=True).encode()
    assert decode_answer(body) == value


@given(st.from_regex(r"[a-zA-Z.]{1,20}", fullmatch=True), st.lists(VALUES, max_size=4))
def test_python_reads_what_is_called_and_answered(method, parameters):
    read, name = xmlrpc.client.loads(encode_call(method, parameters))
    assert (name, list(read)) == (method, parameters)
    for value in parameters:
        assert xmlrpc.client.loads(encode_answer(value))[0] == (value,)


@given(st.from_regex(r"[a-zA-Z.]{1,20}", fullmatch=True), st.lists(VALUES, max_size=4))
def test_what_python_calls_is_read(method, parameters):
    body = xmlrpc.client.dumps(tuple(parameters), method).encode()
    assert decode_call(body) == (method, parameters)


def test_the_values_that_ros_does_not_send_are_read_as_well():
    body = xmlrpc.client.dumps(([1.5, xmlrpc.client.Binary(b"abc"), None],), methodresponse=True, allow_none=True)
    assert decode_answer(body.encode()) == [1.5, b"abc", None]


def test_a_value_without_a_type_is_a_string():
    # As roscpp's XmlRpc++ writes it.
    body = b"<?xml version=\"1.0\"?>\r\n<methodResponse><params><param>\r\n\t<value><array><data>"
    body += b"<value><i4>1</i4> </value><value>ready </value><value/><value><string/></value></data></array></value>"
    assert decode_answer(body + b"\r\n</param></params></methodResponse>\r\n") == [1, "ready ", "", ""]


def test_faults_are_refusals():
    with pytest.raises(Fault, match="no such thing"):
        decode_answer(encode_fault(1, "no such thing"))
    with pytest.raises(xmlrpc.client.Fault, match="no such thing"):
        xmlrpc.client.loads(encode_fault(1, "no such thing"))


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
        wrapped("<value><array><data>" * (MAX_DEPTH + 1) + "</data></array></value>" * (MAX_DEPTH + 1)),
        wrapped("<value><int>one</int></value>"),
        wrapped("<value><int></int></value>"),
        wrapped(f"<value><int>{'9' * 5000}</int></value>"),
        wrapped("<value><boolean>2</boolean></value>"),
        wrapped("<value><base64>a</base64></value>"),
        wrapped("<value><struct><member><value>1</value></member></struct></value>"),
        wrapped("<value>1</value><value>2</value>"),
        wrapped("<value>a</value>").replace(b"methodResponse", b"methodCall"),
    ],
)  # fmt: skip
def test_what_is_not_an_answer_is_refused(body):
    with pytest.raises(ProtocolError):
        decode_answer(body)


def test_a_document_of_too_many_values_is_refused_before_it_is_kept(monkeypatch):
    monkeypatch.setattr("rosbridge_eth.sources.ros1.xmlrpc.MAX_VALUES", 100)
    with pytest.raises(ProtocolError, match="more than 100 values"):
        decode_answer(wrapped(f"<value><array><data>{'<value/>' * 101}</data></array></value>"))


TAGS = ["methodResponse", "methodCall", "methodName", "params", "param", "value", "array", "data", "struct", "member",
        "name", "fault", "int", "i4", "boolean", "string", "double", "base64", "nil"]  # fmt: skip


@given(st.recursive(TEXT, lambda inner: st.builds(
    lambda tag, parts: f"<{tag}>{''.join(parts)}</{tag}>", st.sampled_from(TAGS), st.lists(inner, max_size=4))))
@example("<array></array>")
@example("<value><array><value><int>1</int></value><value/></array></value>")
def test_any_arrangement_of_tags_is_a_value_or_a_protocol_error(text):
    text = text.replace("&", "")
    for body in (text.encode(), wrapped(text), wrapped(f"<value>{text}</value>")):
        for decode in (decode_answer, decode_call):
            with contextlib.suppress(ProtocolError, Fault):
                decode(body)


@given(st.binary(max_size=200))
def test_any_bytes_are_a_protocol_error(body):
    with pytest.raises(ProtocolError):
        decode_answer(body)
    with pytest.raises(ProtocolError):
        decode_call(body)


# HTTP

def feed(reader: BodyReader, data: bytes, cuts: list[int]) -> bytes | None:
    edges = [0, *sorted(min(cut, len(data)) for cut in cuts), len(data)]
    body = None
    for start, end in itertools.pairwise(edges):
        body = reader.feed(data[start:end]) if body is None else body
    return body


@given(st.binary(max_size=100), st.lists(st.integers(0, 400), max_size=10))
def test_bodies_are_found_in_any_chunks(body, cuts):
    assert feed(BodyReader(request=False, limit=100), encode_response(body), cuts) == body
    assert feed(BodyReader(request=True, limit=100), encode_request("robot", 1, "/", body), cuts) == body


def test_an_answer_without_a_length_ends_with_its_connection():
    reader = BodyReader(request=False, limit=100)
    assert reader.feed(b"HTTP/1.1 200 OK\r\nServer: x\r\n\r\nab") is None
    assert reader.feed(b"c") is None
    assert reader.end() == b"abc"


@pytest.mark.parametrize(
    ("data", "why"),
    [
        (b"GET / HTTP/1.0\r\n\r\n", "not HTTP"),
        (b"HTTP/1.0 404 Not Found\r\n\r\n", "HTTP status 404"),
        (b"HTTP/1.1 200 OK\r\nTransfer-Encoding: chunked\r\n\r\n", "transfer encoding"),
        (b"HTTP/1.1 200 OK\r\nContent-Length: -1\r\n\r\n", "content length"),
        (b"HTTP/1.1 200 OK\r\nContent-Length: 1\r\ncontent-length: 2\r\n\r\n", "content length"),
        (b"HTTP/1.1 200 OK\r\nContent-Length: 101\r\n\r\n", "101 bytes is not read"),
        (b"HTTP/1.1 200 OK\r\n\r\n" + bytes(101), "more than 100 bytes"),
        (b"HTTP/1.1 200 OK\r\n" + b"a: b\r\n" * MAX_HEAD, "head of more than"),
        (b"a" * (MAX_HEAD + 1), "head of more than"),
    ],
)
def test_answers_that_are_none_are_refused(data, why):
    with pytest.raises(ProtocolError, match=why):
        BodyReader(request=False, limit=100).feed(data)


@pytest.mark.parametrize("data", [b"GET / HTTP/1.1\r\nContent-Length: 0\r\n\r\n", b"POST / HTTP/1.1\r\n\r\n"])
def test_requests_that_are_none_are_refused(data):
    with pytest.raises(ProtocolError):
        BodyReader(request=True, limit=100).feed(data)


def test_a_connection_that_ends_too_early_is_no_answer():
    reader = BodyReader(request=False, limit=100)
    reader.feed(b"HTTP/1.1 200 OK\r\nContent-Length: 3\r\n\r\nab")
    with pytest.raises(ProtocolError):
        reader.end()
    with pytest.raises(ProtocolError):
        BodyReader(request=False, limit=100).end()


@given(st.lists(st.binary(max_size=60), max_size=20), st.booleans())
def test_any_bytes_are_a_body_or_a_protocol_error(chunks, request):
    reader = BodyReader(request=request, limit=100)
    try:
        for chunk in chunks:
            reader.feed(chunk)
    except ProtocolError:
        pass
