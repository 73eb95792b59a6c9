"""What a robot and a server say to each other inside the channel, one message each. Numbers are big-endian.

    up      WHERE      01 | stream 16 | number 8 | digest 32
            OFFER      02 | chunk
    down    STORED     11 | stream 16 | 00, or 01 | number 8 | digest 32     00: nothing of this stream is stored
            CONFIRMED  12 | stream 16 | number 8 | block 8
            HOLD       13 | why, UTF-8, at most 400 bytes
            REFUSED    14 | stream 16 | number 8 | why

The robot says which chunk of which stream it would send next; the server answers what it has stored of that
stream, and the robot goes on from there. The robot is never named: it is who the channel authenticated.
"""

from __future__ import annotations

import struct
from typing import NamedTuple, TypeAlias

from rosbridge_eth.log.chunk import MAX_CHUNK

MAX_WHY = 400

_WHERE, _OFFER, _STORED, _CONFIRMED, _HOLD, _REFUSED = 0x01, 0x02, 0x11, 0x12, 0x13, 0x14
_WHERE_FORM, _STORED_FORM = struct.Struct(">B16sQ32s"), struct.Struct(">B16s?Q32s")
_PLACE_FORM, _CONFIRMED_FORM = struct.Struct(">B16sQ"), struct.Struct(">B16sQQ")


class ProtocolError(Exception):
    """The peer sent what is not a message; the session is of no use any more."""


class Where(NamedTuple):
    """Up: I would send this chunk of this stream next; the answer is Stored, or Hold."""

    stream: bytes
    number: int
    digest: bytes


class Offer(NamedTuple):
    """Up: one encoded chunk."""

    chunk: bytes


class Stored(NamedTuple):
    """Down: the newest chunk of that stream that is committed; None and zeros if there is none."""

    stream: bytes
    number: int | None
    digest: bytes


class Confirmed(NamedTuple):
    """Down: everything of the log up to this chunk, which is in this block, is confirmed on the chain."""

    stream: bytes
    number: int
    block: int


class Hold(NamedTuple):
    """Down: send nothing until the next Stored."""

    why: str


class Refused(NamedTuple):
    """Down: this chunk will never be taken."""

    stream: bytes
    number: int
    why: str


Up: TypeAlias = Where | Offer
Down: TypeAlias = Stored | Confirmed | Hold | Refused


def encode(message: Up | Down) -> bytes:
    """The message as bytes. A reason is cut to MAX_WHY bytes, and what does not print in it becomes a space."""
    match message:
        case Where():
            return _WHERE_FORM.pack(_WHERE, *message)
        case Offer(chunk):
            return bytes((_OFFER,)) + chunk
        case Stored(stream, number, digest):
            return _STORED_FORM.pack(_STORED, stream, number is not None, number or 0, digest)
        case Confirmed():
            return _CONFIRMED_FORM.pack(_CONFIRMED, *message)
        case Hold(why):
            return bytes((_HOLD,)) + _reason(why)
        case Refused(stream, number, why):
            return _PLACE_FORM.pack(_REFUSED, stream, number) + _reason(why)


def _reason(why: str) -> bytes:
    printable = "".join(letter if letter.isprintable() else " " for letter in why)
    return printable.encode("utf-8", "replace")[:MAX_WHY].decode("utf-8", "ignore").encode("utf-8")


def _why(data: bytes) -> str:
    try:
        why = data.decode("utf-8")
    except UnicodeDecodeError:
        raise ProtocolError("a reason that is not UTF-8") from None
    if len(data) > MAX_WHY or not why.isprintable():
        raise ProtocolError("a reason that is too long or does not print")
    return why


def decode_up(data: bytes) -> Up:
    """What a robot sent; ProtocolError if it is none of its messages. A chunk is not looked into."""
    if data[:1] == bytes((_WHERE,)) and len(data) == _WHERE_FORM.size:
        return Where(*_WHERE_FORM.unpack(data)[1:])
    if data[:1] == bytes((_OFFER,)) and 1 < len(data) <= 1 + MAX_CHUNK:
        return Offer(data[1:])
    raise ProtocolError(f"not a robot's message: {len(data)} bytes")


def decode_down(data: bytes) -> Down:
    """What a server sent; ProtocolError if it is none of its messages."""
    kind = data[0] if data else 0
    if kind == _STORED and len(data) == _STORED_FORM.size and data[17] in (0, 1):
        _, stream, known, number, digest = _STORED_FORM.unpack(data)
        if not known and (number or any(digest)):
            raise ProtocolError("a stream of which nothing is stored, with a chunk")
        return Stored(stream, number if known else None, digest)
    if kind == _CONFIRMED and len(data) == _CONFIRMED_FORM.size:
        return Confirmed(*_CONFIRMED_FORM.unpack(data)[1:])
    if kind == _HOLD:
        return Hold(_why(data[1:]))
    if kind == _REFUSED and len(data) >= _PLACE_FORM.size:
        _, stream, number = _PLACE_FORM.unpack_from(data)
        return Refused(stream, number, _why(data[_PLACE_FORM.size :]))
    raise ProtocolError(f"not a server's message: {len(data)} bytes")
