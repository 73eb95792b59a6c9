"""XML-RPC as ROS 1 speaks it (xmlrpc.com/spec; wiki.ros.org/ROS/Master_API and Slave_API), bounded in every direction.

The standard library's parser reads whatever it is given; here the peer may be
anyone on the robot's network. So: no document type (which is where entities
that grow are declared), a depth, a number of values, and types that ROS uses.
"""

from __future__ import annotations

import base64
import binascii
from collections.abc import Sequence
from typing import TypeAlias
from xml.parsers import expat
from xml.sax.saxutils import escape

from rosbridge_eth.sources.ros1.errors import ProtocolError, Refusal

Value: TypeAlias = "bool | int | float | str | bytes | list[Value] | dict[str, Value] | None"

MAX_DEPTH = 16
"""Arrays and structs within each other; ROS has four."""
MAX_VALUES = 500_000
"""Values in one document. A graph of a thousand nodes comes to some tens of thousands."""

_SCALARS = frozenset({"i4", "int", "i8", "boolean", "string", "double", "base64", "dateTime.iso8601", "nil"})


class Fault(Refusal):
    """The peer answered with an XML-RPC fault."""


def encode_call(method: str, parameters: Sequence[Value]) -> bytes:
    """A method call."""
    return _document(f"<methodCall><methodName>{escape(method)}</methodName>{_parameters(parameters)}</methodCall>")


def encode_answer(value: Value) -> bytes:
    """The answer to a method call."""
    return _document(f"<methodResponse>{_parameters([value])}</methodResponse>")


def encode_fault(code: int, text: str) -> bytes:
    """The answer to a call that cannot be understood."""
    fault = _encoded({"faultCode": code, "faultString": text})
    return _document(f"<methodResponse><fault>{fault}</fault></methodResponse>")


def decode_call(body: bytes) -> tuple[str, list[Value]]:
    """Method name and parameters. Raises ProtocolError."""
    document = _parse(body)
    if document.root != "methodCall" or document.method is None:
        raise ProtocolError("the request is not an XML-RPC method call")
    return document.method, document.values


def decode_answer(body: bytes) -> Value:
    """The one value of an answer. Raises Fault for a fault, ProtocolError for anything that is not an answer."""
    document = _parse(body)
    if document.root != "methodResponse" or len(document.values) != 1:
        raise ProtocolError("the answer is not an XML-RPC response with one value")
    value = document.values[0]
    if document.fault:
        text = value.get("faultString") if isinstance(value, dict) else value
        raise Fault(f"it answered with a fault: {str(text)[:200]}")
    return value


def _document(content: str) -> bytes:
    return f"<?xml version='1.0'?>\n{content}\n".encode()


def _parameters(values: Sequence[Value]) -> str:
    return f"<params>{''.join(f'<param>{_encoded(value)}</param>' for value in values)}</params>"


def _encoded(value: Value) -> str:
    if isinstance(value, bool):
        return f"<value><boolean>{int(value)}</boolean></value>"
    if isinstance(value, int):
        return f"<value><int>{value}</int></value>"
    if isinstance(value, str):
        return f"<value><string>{escape(value)}</string></value>"
    if isinstance(value, dict):
        members = "".join(
            f"<member><name>{escape(name)}</name>{_encoded(item)}</member>" for name, item in value.items()
        )
        return f"<value><struct>{members}</struct></value>"
    if isinstance(value, list):
        return f"<value><array><data>{''.join(map(_encoded, value))}</data></array></value>"
    raise TypeError(f"{type(value).__name__} is not sent in XML-RPC calls of ROS")


def _parse(body: bytes) -> _Document:
    document = _Document()
    parser = expat.ParserCreate()
    parser.buffer_text = True
    parser.StartDoctypeDeclHandler = document.doctype
    parser.StartElementHandler = document.start
    parser.EndElementHandler = document.end
    parser.CharacterDataHandler = document.text
    try:
        parser.Parse(body, True)
    except (expat.ExpatError, LookupError, ValueError) as error:  # LookupError: an encoding nobody knows
        raise ProtocolError(f"this is not XML: {error}") from None
    return document


class _Document:
    """Collects the values of one document; expat calls it."""

    def __init__(self) -> None:
        self.root = ""
        self.method: str | None = None
        self.fault = False
        self.values: list[Value] = []
        self._open: list[list[Value] | dict[str, Value]] = []  # arrays and structs that are being filled
        self._names: list[str] = []  # of the struct members that are being filled
        self._in_value = False  # a value is open and no array or struct has begun in it
        self._kind: str | None = None  # its type's tag, once that was seen
        self._content = ""  # what stood in that tag
        self._text: list[str] = []
        self._count = 0

    def doctype(self, *_: object) -> None:
        raise ProtocolError("a document type in XML-RPC is refused")

    def start(self, tag: str, _: dict[str, str]) -> None:
        self.root = self.root or tag
        self._text = []
        if tag == "value":
            self._count += 1
            if self._count > MAX_VALUES:
                raise ProtocolError(f"more than {MAX_VALUES} values in one XML-RPC document")
            self._in_value, self._kind = True, None
        elif tag in ("array", "struct"):
            if len(self._open) == MAX_DEPTH:
                raise ProtocolError(f"XML-RPC values are nested more than {MAX_DEPTH} deep")
            self._open.append([] if tag == "array" else {})
            self._in_value = False
        elif tag == "fault":
            self.fault = True
        elif tag in _SCALARS:
            self._kind = tag

    def text(self, data: str) -> None:
        self._text.append(data)

    def end(self, tag: str) -> None:
        text, self._text = "".join(self._text), []
        if tag == "value":
            if self._in_value:  # without a tag of its own, a value is a string
                self._add(_scalar("string", text) if self._kind is None else _scalar(self._kind, self._content))
            self._in_value = False
        elif tag in _SCALARS:
            self._content = text
        elif tag in ("array", "struct"):
            if not self._open:
                raise ProtocolError("XML-RPC containers are out of order")
            self._add(self._open.pop())
        elif tag == "name":
            self._names.append(text)
        elif tag == "member":
            if self._names:
                self._names.pop()
        elif tag == "methodName":
            self.method = text.strip()

    def _add(self, value: Value) -> None:
        into = self._open[-1] if self._open else self.values
        if isinstance(into, list):
            into.append(value)
        elif self._names:
            into[self._names[-1]] = value
        else:
            raise ProtocolError("a struct in XML-RPC has a value without a name")


def _scalar(kind: str, text: str) -> Value:
    try:
        if kind in ("i4", "int", "i8"):
            if len(text) > 32:
                raise ProtocolError("a number in XML-RPC has more than 32 digits")
            return int(text)
        if kind == "boolean":
            return {"0": False, "1": True}[text.strip()]
        if kind == "double":
            return float(text)
        if kind == "base64":
            return base64.b64decode(text)
        if kind == "nil":
            return None
    except (ValueError, KeyError, binascii.Error):
        raise ProtocolError(f"{text[:40]!r} is not an XML-RPC {kind}") from None
    return text
