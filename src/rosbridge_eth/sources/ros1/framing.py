"""TCPROS, as a subscriber reads it: a connection header, then messages. Bytes in, events out.

Everything is little-endian (wiki.ros.org/ROS/TCPROS, wiki.ros.org/ROS/Connection Header):

    header    length(4)  then fields, each  length(4) "name=value"
    message   length(4)  body

A publisher is not trusted. A header has an upper size; a message above
`max_message` is passed over without being kept; what no message can be is an error.
"""

from __future__ import annotations

import re
import struct
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from typing import TypeAlias

from rosbridge_eth.sources.ros1.errors import ProtocolError

MAX_HEADER = 1 << 20
"""Bytes of a connection header: four times the longest message definition that is read."""
MAX_FIELDS = 64
"""Fields of a connection header; publishers send seven or eight."""
IMPLAUSIBLE = 1_000_000_000
"""A message length above this means that the stream is out of step; roscpp draws the line at the same place."""

_LENGTH = struct.Struct("<I")
_NAME = re.compile(rb"[A-Za-z0-9_]{1,64}")


@dataclass(frozen=True, slots=True)
class Header:
    """The publisher's answer to ours; sent once, before any message."""

    fields: Mapping[str, str]


@dataclass(frozen=True, slots=True)
class Message:
    """One message, as genpy or roscpp serialised it."""

    body: bytes


@dataclass(frozen=True, slots=True)
class PassedOver:
    """A message of `length` bytes is too large; it will not be kept."""

    length: int


Event: TypeAlias = Header | Message | PassedOver


def encode_header(fields: Mapping[str, str]) -> bytes:
    """A connection header with its length before it."""
    body = b"".join(
        _LENGTH.pack(len(field)) + field for field in (f"{name}={value}".encode() for name, value in fields.items())
    )
    return _LENGTH.pack(len(body)) + body


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


class Framer:
    """One connection's bytes, in any chunks, to events.

    `buffered` is the number of bytes kept of what has not arrived completely.
    """

    def __init__(self, max_message: int) -> None:
        self._max_message = max_message
        self._partial = bytearray()
        self._wanted = 4  # bytes that `_partial` is to have
        self._length_known = False
        self._header_done = False
        self._to_pass_over = 0

    @property
    def buffered(self) -> int:
        return len(self._partial)

    @property
    def header_done(self) -> bool:
        return self._header_done

    @property
    def between_messages(self) -> bool:
        """Nothing of a next message has come yet: silence is not a fault."""
        return self._header_done and not self._partial and not self._length_known and not self._to_pass_over

    def pass_over(self) -> PassedOver | None:
        """Give up the message that is arriving and free its bytes; None if none is."""
        if not self._header_done or not self._length_known:
            return None
        length = self._wanted
        self._to_pass_over = length - len(self._partial)
        self._expect_length()
        return PassedOver(length)

    def feed(self, data: bytes | memoryview) -> Iterator[Event]:
        """The events that `data` completes; to be exhausted. Raises ProtocolError."""
        view = memoryview(data)
        while view or (self._length_known and self._wanted == 0):
            if self._to_pass_over:
                step = min(self._to_pass_over, len(view))
                self._to_pass_over -= step
                view = view[step:]
                continue
            if not self._partial and len(view) >= self._wanted:
                piece = bytes(view[: self._wanted])  # the usual case: complete, copied once
                view = view[self._wanted :]
            else:
                step = min(self._wanted - len(self._partial), len(view))
                self._partial += view[:step]
                view = view[step:]
                if len(self._partial) < self._wanted:
                    return
                piece = bytes(self._partial)
            event = self._complete(piece)
            if event is not None:
                yield event

    def _expect_length(self) -> None:
        self._partial = bytearray()
        self._wanted, self._length_known = 4, False

    def _complete(self, piece: bytes) -> Event | None:
        if self._length_known:
            self._expect_length()
            if self._header_done:
                return Message(piece)
            self._header_done = True
            return Header(decode_header(piece))
        (length,) = _LENGTH.unpack(piece)
        if not self._header_done and length > MAX_HEADER:
            raise ProtocolError(f"a connection header of {length} bytes is not read; at most {MAX_HEADER}")
        if length > IMPLAUSIBLE:
            raise ProtocolError(f"a message of {length} bytes was announced: the stream is out of step")
        self._partial = bytearray()
        if self._header_done and length > self._max_message:
            self._expect_length()
            self._to_pass_over = length
            return PassedOver(length)
        self._wanted, self._length_known = length, True
        return None
