"""TCPROS, as a subscriber reads it (wiki.ros.org/ROS/TCPROS, wiki.ros.org/ROS/Connection Header), little-endian:

    header    length(4)  then fields, each  length(4) "name=value"
    message   length(4)  body

A publisher's header carries the whole definition, so any type can be read. Where it leaves the definition out (some
microcontrollers' bridges do), that of ROS Noetic serves if it has the same md5 sum.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Mapping
from typing import BinaryIO, Final, NamedTuple

from rosbridge_eth.capture import Decoder, DefinitionError, Wire, decoder_for, decoder_for_known, normalised_type_name
from rosbridge_eth.robot.sources.ros1.addressing import ProtocolError
from rosbridge_eth.robot.sources.ros1.api import Refusal

MAX_HEADER: Final = 1 << 20
"""Bytes of a connection header: four times the longest message definition that is read."""
MAX_FIELDS: Final = 64
"""Fields of a connection header; publishers send seven or eight."""
IMPLAUSIBLE: Final = 1_000_000_000
"""A message length above this means that the stream is out of step; roscpp draws the line at the same place."""
ANY: Final = "*"
"""As a subscriber's type and md5 sum: whatever you publish."""

_LENGTH = struct.Struct("<I")
_NAME = re.compile(rb"[A-Za-z0-9_]{1,64}")
_MD5 = re.compile(r"[0-9a-f]{32}")
_PIECE: Final = 1 << 16


class Publication(NamedTuple):
    """What comes over one connection."""

    type_name: str
    md5: str
    decoder: Decoder
    node: str


def request_header(topic: str, node: str) -> bytes:
    """What a subscriber of any type sends first."""
    return encode_header({"callerid": node, "md5sum": ANY, "tcp_nodelay": "1", "topic": topic, "type": ANY})


def encode_header(fields: Mapping[str, str]) -> bytes:
    """A connection header with its length before it."""
    body = b"".join(
        _LENGTH.pack(len(field)) + field for field in (f"{name}={value}".encode() for name, value in fields.items())
    )
    return _LENGTH.pack(len(body)) + body


def read_header(stream: BinaryIO) -> dict[str, str]:
    """The fields of the publisher's header. Raises ProtocolError, or EOFError."""
    length = read_length(stream)
    if length > MAX_HEADER:
        raise ProtocolError(f"a connection header of {length} bytes is not read; at most {MAX_HEADER}")
    return decode_header(read_exactly(stream, length))


def decode_header(body: bytes) -> dict[str, str]:
    """The fields of a connection header, without the length before it. Raises ProtocolError."""
    fields: dict[str, str] = {}
    position = 0
    while position < len(body):
        if position + 4 > len(body):
            raise ProtocolError("the connection header ends within a field's length")
        (length,) = _LENGTH.unpack_from(body, position)
        position += 4
        if length > len(body) - position:
            raise ProtocolError(f"a field of {length} bytes does not fit into the connection header")
        name, equals, value = body[position : position + length].partition(b"=")
        position += length
        if not equals or not _NAME.fullmatch(name):
            raise ProtocolError("a field of the connection header is not name=value")
        if len(fields) == MAX_FIELDS:
            raise ProtocolError(f"the connection header has more than {MAX_FIELDS} fields")
        if fields.setdefault(name.decode(), text := value.decode("utf-8", "replace")) != text:
            raise ProtocolError(f"the connection header has {name.decode()} twice")
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


def read_publication(topic: str, fields: Mapping[str, str]) -> Publication:
    """Judge the answer to our header. Raises Refusal, ProtocolError or DefinitionError."""
    if "error" in fields:
        raise Refusal(f"the publisher refuses: {fields['error'][:200]}")
    for name in ("type", "md5sum"):
        if name not in fields:
            raise ProtocolError(f"the publisher's header has no {name}")
    if fields.get("topic", topic) != topic:
        raise ProtocolError(f"the publisher's header is for another topic, {fields['topic'][:60]!r}")
    if fields["type"] == ANY:
        raise Refusal("the publisher does not say which type it sends")
    md5 = fields["md5sum"].lower()
    if not _MD5.fullmatch(md5):
        raise ProtocolError(f"{fields['md5sum'][:60]!r} is not an md5 sum")
    name = normalised_type_name(fields["type"])
    decoder = _decoder(name, md5, fields.get("message_definition", ""))
    return Publication(name, md5, decoder, fields.get("callerid", "")[:256])


def _decoder(name: str, md5: str, text: str) -> Decoder:
    if not text.strip() and (known := decoder_for_known(Wire.ROS1, name)) and known.definition.md5 == md5:
        return known
    if not text.strip():
        raise DefinitionError(f"the publisher does not define {name}, and it is not the one that Noetic ships")
    decoder = decoder_for(Wire.ROS1, name, text)
    if (computed := decoder.definition.md5) != md5:
        raise DefinitionError(f"the definition of {name} has the md5 sum {computed}, not {md5} as announced")
    return decoder
