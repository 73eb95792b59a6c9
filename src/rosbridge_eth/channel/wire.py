"""What stands in a datagram, byte for byte. Big-endian throughout; see docs/channel.md for the figures.

A datagram is one of six handshake kinds, each with its own fixed header, or
DATA: 0x40 | epoch & 15, connection id (8), packet number (6), then SM4-GCM of
a sequence of frames, and its tag (16). The 15 bytes before are authenticated.

Parsers here take bytes from anybody. They return values or raise Malformed;
they never allocate more than they were given.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from dataclasses import dataclass
from enum import IntEnum

__all__ = [
    "DATAGRAM_SIZE",
    "DATA_HEADER_SIZE",
    "DATA_OVERHEAD",
    "VERSION",
    "Cookie",
    "Frame",
    "Hello",
    "Kind",
    "Malformed",
    "Mode",
    "Piece",
    "ServerPiece",
]

VERSION = 1
DATAGRAM_SIZE = 1200
"""Bytes of UDP payload that every path is taken to carry (RFC 9000, 14: the same figure, for the same reason)."""

CID_SIZE = 8
NONCE_SIZE = 32
COOKIE_SIZE = 24
RESET_TOKEN_SIZE = 16
TAG_SIZE = 16
DATA_HEADER_SIZE = 15
DATA_OVERHEAD = DATA_HEADER_SIZE + TAG_SIZE
MAX_PACKET_NUMBER = 2**48 - 1
MAX_PIECES = 8
"""Pieces of one handshake message: 8 of them hold about 9 KiB, two generous certificates."""


class Malformed(ValueError):
    """Bytes are not what the wire format says; always the sender's fault."""


class Mode(IntEnum):
    """How the session's secret comes about. One is configured; it is signed, and part of the key schedule."""

    EXCHANGE = 1
    TRANSPORT = 2


class Kind(IntEnum):
    """First byte of a datagram; DATA is 0x40 to 0x4f."""

    HELLO = 0x01
    COOKIE = 0x02
    PROOF = 0x03
    OFFER = 0x04
    RESET = 0x05
    REFUSAL = 0x06
    DATA = 0x40


class Frame(IntEnum):
    """First byte of a frame inside DATA."""

    PING = 0x01
    ACK = 0x02
    MESSAGE = 0x03
    MESSAGE_PART = 0x04
    ANSWER = 0x05
    ANSWER_PART = 0x06
    KEY_UPDATE = 0x07
    PATH_CHALLENGE = 0x08
    PATH_RESPONSE = 0x09
    FINISHED = 0x0A
    ACCEPTED = 0x0B
    CLOSE = 0x0C


# HELLO and COOKIE

_HELLO = struct.Struct(">BBB8s32s")
_HELLO_PADDING = bytes(DATAGRAM_SIZE - _HELLO.size)
_COOKIE = struct.Struct(">BB8s32s24s")


@dataclass(frozen=True, slots=True)
class Hello:
    """HELLO: kind, version, mode, client's connection id (8), client nonce N (32), zeros up to 1,200 bytes."""

    mode: Mode
    client_cid: bytes
    nonce: bytes

    def to_bytes(self) -> bytes:
        return _HELLO.pack(Kind.HELLO, VERSION, self.mode, self.client_cid, self.nonce) + _HELLO_PADDING

    @classmethod
    def parse(cls, data: bytes) -> Hello:
        if len(data) != DATAGRAM_SIZE or data[_HELLO.size :] != _HELLO_PADDING:
            raise Malformed("a HELLO is 1,200 bytes, zeros after its fields")
        _, version, mode, cid, nonce = _HELLO.unpack_from(data)
        return cls(_mode(version, mode), cid, nonce)


@dataclass(frozen=True, slots=True)
class Cookie:
    """COOKIE: kind, version, client's connection id (8), N (32), cookie (24)."""

    client_cid: bytes
    nonce: bytes
    cookie: bytes

    def to_bytes(self) -> bytes:
        return _COOKIE.pack(Kind.COOKIE, VERSION, self.client_cid, self.nonce, self.cookie)

    @classmethod
    def parse(cls, data: bytes) -> Cookie:
        if len(data) != _COOKIE.size:
            raise Malformed("a COOKIE has another length")
        _, version, cid, nonce, cookie = _COOKIE.unpack(data)
        if version != VERSION:
            raise Malformed("another version")
        return cls(cid, nonce, cookie)


def _mode(version: int, mode: int) -> Mode:
    if version != VERSION:
        raise Malformed("another version")
    if mode not in (1, 2):
        raise Malformed("a mode that does not exist")
    return Mode(mode)


# PROOF and OFFER: handshake messages in pieces

_PIECE = struct.Struct(">BBB8s32s24sBB")
_SERVER_PIECE = struct.Struct(">BB8sBB")


@dataclass(frozen=True, slots=True)
class Piece:
    """One datagram of a PROOF: the HELLO's fields and the cookie again, index, count, a piece of the body.

    The cookie in each lets a server judge each without having kept anything.
    """

    mode: Mode
    client_cid: bytes
    nonce: bytes
    cookie: bytes
    index: int
    count: int
    data: bytes

    @classmethod
    def parse(cls, data: bytes) -> Piece:
        if not _PIECE.size < len(data) <= DATAGRAM_SIZE:
            raise Malformed("a PROOF has another length")
        _, version, mode, cid, nonce, cookie, index, count = _PIECE.unpack_from(data)
        if not index < count <= MAX_PIECES:
            raise Malformed("a piece that does not exist")
        return cls(_mode(version, mode), cid, nonce, cookie, index, count, data[_PIECE.size :])


def proof_datagrams(hello: Hello, cookie: bytes, body: bytes) -> list[bytes]:
    """The datagrams of the PROOF whose body is `body`."""
    pieces = _split(body, DATAGRAM_SIZE - _PIECE.size)
    return [
        _PIECE.pack(
            Kind.PROOF, VERSION, hello.mode, hello.client_cid, hello.nonce, cookie, index, len(pieces)
        )
        + piece
        for index, piece in enumerate(pieces)
    ]


@dataclass(frozen=True, slots=True)
class ServerPiece:
    """One datagram of an OFFER: kind, version, client's connection id (8), index, count, a piece of the body."""

    client_cid: bytes
    index: int
    count: int
    data: bytes

    @classmethod
    def parse(cls, data: bytes) -> ServerPiece:
        if not _SERVER_PIECE.size < len(data) <= DATAGRAM_SIZE:
            raise Malformed("an OFFER has another length")
        _, version, cid, index, count = _SERVER_PIECE.unpack_from(data)
        if version != VERSION:
            raise Malformed("another version")
        if not index < count <= MAX_PIECES:
            raise Malformed("a piece that does not exist")
        return cls(cid, index, count, data[_SERVER_PIECE.size :])


def offer_datagrams(client_cid: bytes, body: bytes) -> list[bytes]:
    """The datagrams of the OFFER whose body is `body`."""
    pieces = _split(body, DATAGRAM_SIZE - _SERVER_PIECE.size)
    return [
        _SERVER_PIECE.pack(Kind.OFFER, VERSION, client_cid, index, len(pieces)) + piece
        for index, piece in enumerate(pieces)
    ]


def _split(body: bytes, size: int) -> list[bytes]:
    pieces = [body[start : start + size] for start in range(0, len(body), size)]
    if len(pieces) > MAX_PIECES:
        raise ValueError(f"a handshake message of {len(body)} bytes does not fit in {MAX_PIECES} datagrams")
    return pieces


class Assembly:
    """The pieces of one handshake message on their way; takes each index once, at most MAX_PIECES of them."""

    __slots__ = ("_count", "_pieces")

    def __init__(self) -> None:
        self._pieces: dict[int, bytes] = {}
        self._count = 0

    def add(self, index: int, count: int, data: bytes) -> bytes | None:
        """The whole body once its last piece has come, else None; Malformed if the count changed."""
        if self._count and count != self._count:
            raise Malformed("the number of pieces changed")
        self._count = count
        self._pieces.setdefault(index, data)
        if len(self._pieces) < count:
            return None
        return b"".join(self._pieces[i] for i in range(count))


# RESET and REFUSAL

_RESET = struct.Struct(">BB8s16s")
_REFUSAL = struct.Struct(">BB8s32sB")
RESET_SIZE = _RESET.size


def reset_datagram(cid: bytes, token: bytes) -> bytes:
    """RESET: kind, version, the unknown connection id (8), the token of that connection (16)."""
    return _RESET.pack(Kind.RESET, VERSION, cid, token)


def parse_reset(data: bytes) -> tuple[bytes, bytes]:
    """(connection id, token) of a RESET."""
    if len(data) != _RESET.size or data[1] != VERSION:
        raise Malformed("a RESET has another length or version")
    _, _, cid, token = _RESET.unpack(data)
    return cid, token


class Reason(IntEnum):
    """Why a server does not go on with a handshake, as far as it says: a hint, not authenticated."""

    CERTIFICATE = 1
    EXPIRED = 2
    NOT_ALLOWED = 3
    FULL = 4


def refusal_datagram(client_cid: bytes, nonce: bytes, reason: Reason) -> bytes:
    """REFUSAL: kind, version, client's connection id (8), N (32), reason (1)."""
    return _REFUSAL.pack(Kind.REFUSAL, VERSION, client_cid, nonce, reason)


def parse_refusal(data: bytes) -> tuple[bytes, bytes, Reason]:
    """(client's connection id, N, reason) of a REFUSAL."""
    if len(data) != _REFUSAL.size or data[1] != VERSION:
        raise Malformed("a REFUSAL has another length or version")
    _, _, cid, nonce, reason = _REFUSAL.unpack(data)
    if reason not in Reason.__members__.values():
        raise Malformed("a reason that does not exist")
    return cid, nonce, Reason(reason)


# Bodies of PROOF and OFFER: fields, each behind its two-byte length


def fields(parts: Sequence[bytes]) -> bytes:
    """Each part behind its length in two bytes."""
    return b"".join(len(part).to_bytes(2, "big") + part for part in parts)


def parse_fields(body: bytes, count: int) -> tuple[list[bytes], list[int]]:
    """Exactly `count` fields and nothing after them; and the offset in `body` at which each begins."""
    parts: list[bytes] = []
    offsets: list[int] = []
    position = 0
    for _ in range(count):
        start = position + 2
        stop = start + int.from_bytes(body[position:start], "big")
        if stop > len(body) or start > len(body):
            raise Malformed("a handshake message ends within a field")
        parts.append(body[start:stop])
        offsets.append(position)
        position = stop
    if position != len(body):
        raise Malformed("a handshake message goes on after its last field")
    return parts, offsets


# DATA


def data_header(epoch: int, cid: bytes, number: int) -> bytes:
    """The 15 authenticated bytes before the ciphertext."""
    return bytes((Kind.DATA | epoch & 15,)) + cid + number.to_bytes(6, "big")


# Frames. MESSAGE and ANSWER: id (4), length (2). Parts: id (4), total (2), offset (2), length (2).

WHOLE = struct.Struct(">BIH")
PART = struct.Struct(">BIHHH")
_ACK = struct.Struct(">6sHHB")
_RANGE = struct.Struct(">HH")
ACCEPTED = struct.Struct(">B16sIIHQ")
"""ACCEPTED: reset token (16), unanswered messages (4) and bytes (4) the server holds, idle timeout in s (2),
server's wall clock in ms since 1970 (8)."""

MAX_ACK_RANGES = 16


def ack_frame(ranges: Sequence[tuple[int, int]], delay: float) -> bytes:
    """ACK: largest number (6), delay in units of 100 µs (2), numbers below it also received (2), ranges (1),
    then each (gap, length) (2, 2): so many missing, so many received, going down.

    ranges: inclusive (first, last), highest first, at least one.
    """
    first, last = ranges[0]
    run = min(last - first, 0xFFFF)
    low = last - run
    rest = bytearray()
    count = 0
    if low == first:
        for start, stop in ranges[1 : MAX_ACK_RANGES + 1]:
            gap, length = low - stop - 1, stop - start + 1
            if gap > 0xFFFF or length > 0xFFFF:
                break
            rest += _RANGE.pack(gap, length)
            count += 1
            low = start
    units = min(int(delay * 10000), 0xFFFF)
    return bytes((Frame.ACK,)) + _ACK.pack(last.to_bytes(6, "big"), units, run, count) + rest


def parse_ack(data: bytes, position: int) -> tuple[list[tuple[int, int]], float, int]:
    """Ranges (highest first, inclusive), the delay in s, and the position behind the frame at `position`."""
    start = position + 1
    body = start + _ACK.size
    if body > len(data):
        raise Malformed("an ACK ends early")
    number, units, run, count = _ACK.unpack_from(data, start)
    last = int.from_bytes(number, "big")
    low = last - run
    stop = body + count * _RANGE.size
    if count > MAX_ACK_RANGES or stop > len(data):
        raise Malformed("an ACK ends early")
    ranges = [(low, last)]
    for gap, length in _RANGE.iter_unpack(data[body:stop]):
        if not gap or not length:
            raise Malformed("an empty range in an ACK")
        high = low - gap - 1
        low = high - length + 1
        ranges.append((low, high))
    if low < 0:
        raise Malformed("an ACK of negative packet numbers")
    return ranges, units / 10000, stop
