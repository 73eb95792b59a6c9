"""TCPROS, as a subscriber reads it (wiki.ros.org/ROS/TCPROS, wiki.ros.org/ROS/Connection Header), little-endian:

    header    length(4)  then fields, each  length(4) "name=value"
    message   length(4)  body

A publisher's header carries the whole definition, so any type can be read. Where it leaves the definition out (some
microcontrollers' bridges do), that of ROS Noetic serves if it has the same md5 sum.
"""

from __future__ import annotations

import struct
from collections.abc import Mapping
from typing import BinaryIO, Final

from rosbridge_eth.capture import Decoder, DefinitionError, Wire, decoder_for, decoder_for_known, normalised_type_name
from rosbridge_eth.robot.sources.ros1.api import ProtocolError, Refusal

MAX_HEADER: Final = 1 << 20
"""Bytes of a connection header: four times the longest message definition that is read."""
IMPLAUSIBLE: Final = 1_000_000_000
"""A message length above this means that the stream is out of step; roscpp draws the line at the same place."""
ANY: Final = "*"
"""As a subscriber's type and md5 sum: whatever you publish."""

_LENGTH = struct.Struct("<I")
_PIECE: Final = 1 << 16


def request_header(topic: str, node: str) -> bytes:
    """What a subscriber of any type sends first."""
    return encode_header({"callerid": node, "md5sum": ANY, "tcp_nodelay": "1", "topic": topic, "type": ANY})


def encode_header(fields: Mapping[str, str]) -> bytes:
    """A connection header with its length before it."""
    encoded = (f"{name}={value}".encode() for name, value in fields.items())
    body = b"".join(_LENGTH.pack(len(field)) + field for field in encoded)
    return _LENGTH.pack(len(body)) + body


def read_header(stream: BinaryIO) -> dict[str, str]:
    """The fields of the publisher's header. Raises ProtocolError, or EOFError."""
    left, fields = read_length(stream), dict[str, str]()
    if left > MAX_HEADER:
        raise ProtocolError(f"a connection header of {left} bytes is not read; at most {MAX_HEADER}")
    while left:
        length = read_length(stream)
        left -= 4 + length
        if left < 0:
            raise ProtocolError(f"a field of {length} bytes does not fit into the connection header")
        name, equals, value = read_exactly(stream, length).decode("utf-8", "replace").partition("=")
        if not equals:
            raise ProtocolError("a field of the connection header is not name=value")
        fields[name] = value
    return fields


def read_length(stream: BinaryIO) -> int:
    """The length of what follows. Raises ProtocolError for one that no message has, EOFError at the end."""
    length: int = _LENGTH.unpack(read_exactly(stream, 4))[0]
    if length > IMPLAUSIBLE:
        raise ProtocolError(f"a length of {length} bytes was announced: the stream is out of step")
    return length


def read_exactly(stream: BinaryIO, length: int) -> bytes:
    """Raises EOFError."""
    data = stream.read(length)
    if len(data) < length:
        raise EOFError
    return data


def pass_over(stream: BinaryIO, length: int) -> None:
    """Read a message without keeping it. Raises EOFError."""
    while length:
        length -= len(read_exactly(stream, min(length, _PIECE)))


def read_decoder(fields: Mapping[str, str]) -> Decoder:
    """Judge the answer to our header. Raises Refusal, ProtocolError or DefinitionError."""
    if "error" in fields:
        raise Refusal(f"the publisher refuses: {fields['error'][:200]}")
    if missing := {"type", "md5sum"} - fields.keys():
        raise ProtocolError(f"the publisher's header has no {min(missing)}")
    if fields["type"] == ANY:
        raise Refusal("the publisher does not say which type it sends")
    name, md5, text = normalised_type_name(fields["type"]), fields["md5sum"].lower(), fields.get("message_definition")
    decoder = decoder_for(Wire.ROS1, name, text) if text and text.strip() else decoder_for_known(Wire.ROS1, name)
    if decoder is None:
        raise DefinitionError(f"the publisher does not define {name}, and ROS Noetic does not ship it")
    if decoder.definition.md5 != md5:
        raise DefinitionError(f"the definition of {name} has the md5 sum {decoder.definition.md5}, not {md5[:60]!r}")
    return decoder
