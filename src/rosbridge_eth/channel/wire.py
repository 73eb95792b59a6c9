"""What stands in a datagram, byte for byte. Big-endian throughout; docs/channel.md has the figures.

A datagram is one of five handshake kinds, each with its own fixed header, or DATA: 0x40, connection id (8),
packet number (4), then SM4-GCM of a sequence of frames, and its tag (16). The 13 bytes before are authenticated.

Parsers here take bytes from anybody. They return values or raise Malformed; they never allocate more than they
were given.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from enum import IntEnum
from typing import Any, NamedTuple

VERSION = 2
DATAGRAM_SIZE = 1200
"""Bytes of UDP payload that every path is taken to carry (RFC 9000, 14: the same figure, for the same reason)."""

CID_SIZE = 8
NONCE_SIZE = 32
COOKIE_SIZE = 24
DATA_HEADER_SIZE = 13
DATA_OVERHEAD = DATA_HEADER_SIZE + 16
MAX_PIECES = 8
"""Pieces of one handshake message: 8 of them hold about 9 KiB, two generous certificates."""


class Malformed(ValueError):
    """Bytes are not what the wire format says; always the sender's fault."""


class Mode(IntEnum):
    """How the session's secret comes about. One is configured; it is signed, and part of the key schedule."""

    EXCHANGE = 1
    TRANSPORT = 2


class Kind(IntEnum):
    """First byte of a datagram."""

    HELLO = 0x01
    COOKIE = 0x02
    PROOF = 0x03
    OFFER = 0x04
    REFUSAL = 0x05
    DATA = 0x40


class Reason(IntEnum):
    """Why a server does not go on with a handshake, as far as it says: a hint, not authenticated."""

    CERTIFICATE = 1
    EXPIRED = 2
    NOT_ALLOWED = 3
    FULL = 4


# HELLO, COOKIE, REFUSAL

_HELLO = struct.Struct(">BBB8s32s")
_HELLO_PADDING = bytes(DATAGRAM_SIZE - _HELLO.size)
_COOKIE = struct.Struct(">BB8s32s24s")
_REFUSAL = struct.Struct(">BB8s32sB")


class Hello(NamedTuple):
    """HELLO: kind, version, mode, client's connection id (8), client nonce N (32), zeros up to 1,200 bytes."""

    mode: Mode
    client_cid: bytes
    nonce: bytes

    def to_bytes(self) -> bytes:
        return _HELLO.pack(Kind.HELLO, VERSION, *self) + _HELLO_PADDING

    @staticmethod
    def parse(data: bytes) -> Hello:
        if data[_HELLO.size :] != _HELLO_PADDING:
            raise Malformed("a HELLO is 1,200 bytes, zeros after its fields")
        return _hello(*_unpacked(_HELLO, data[: _HELLO.size]))


class Cookie(NamedTuple):
    """COOKIE: kind, version, client's connection id (8), N (32), cookie (24)."""

    client_cid: bytes
    nonce: bytes
    cookie: bytes

    def to_bytes(self) -> bytes:
        return _COOKIE.pack(Kind.COOKIE, VERSION, *self)

    @staticmethod
    def parse(data: bytes) -> Cookie:
        return Cookie(*_unpacked(_COOKIE, data))


class Refusal(NamedTuple):
    """REFUSAL: kind, version, client's connection id (8), N (32), reason (1)."""

    client_cid: bytes
    nonce: bytes
    reason: Reason

    def to_bytes(self) -> bytes:
        return _REFUSAL.pack(Kind.REFUSAL, VERSION, *self)

    @staticmethod
    def parse(data: bytes) -> Refusal:
        cid, nonce, reason = _unpacked(_REFUSAL, data)
        if reason not in Reason.__members__.values():
            raise Malformed("a reason that does not exist")
        return Refusal(cid, nonce, Reason(reason))


def _unpacked(layout: struct.Struct, data: bytes) -> tuple[Any, ...]:
    """The fields behind kind and version."""
    if len(data) != layout.size:
        raise Malformed("a handshake message has another length")
    _, version, *rest = layout.unpack(data)
    if version != VERSION:
        raise Malformed("another version")
    return tuple(rest)


def _hello(mode: int, cid: bytes, nonce: bytes) -> Hello:
    if mode not in Mode.__members__.values():
        raise Malformed("a mode that does not exist")
    return Hello(Mode(mode), cid, nonce)


# PROOF and OFFER: handshake messages in pieces

_PROOF = struct.Struct(">BBB8s32s24sBB")
_OFFER = struct.Struct(">BB8sBB")


Piece = tuple[int, int, bytes]
"""What a datagram of a PROOF or an OFFER carries: index, count, a piece of the body."""


def proof_datagrams(hello: Hello, cookie: bytes, body: bytes) -> list[bytes]:
    """PROOF: the HELLO's fields and the cookie in each, so that a server judges each without having kept anything."""
    pieces = _split(body, DATAGRAM_SIZE - _PROOF.size)
    return [_PROOF.pack(Kind.PROOF, VERSION, *hello, cookie, i, len(pieces)) + p for i, p in enumerate(pieces)]


def parse_proof(data: bytes) -> tuple[Hello, bytes, Piece]:
    """The HELLO's fields, the cookie, and the piece."""
    mode, cid, nonce, cookie, index, count = _unpacked(_PROOF, data[: _PROOF.size])
    return _hello(mode, cid, nonce), cookie, _piece(index, count, data[_PROOF.size :])


def offer_datagrams(client_cid: bytes, body: bytes) -> list[bytes]:
    """OFFER: kind, version, client's connection id (8), index, count, a piece of the body."""
    pieces = _split(body, DATAGRAM_SIZE - _OFFER.size)
    return [_OFFER.pack(Kind.OFFER, VERSION, client_cid, i, len(pieces)) + p for i, p in enumerate(pieces)]


def parse_offer(data: bytes) -> tuple[bytes, Piece]:
    """The client's connection id, and the piece."""
    cid, index, count = _unpacked(_OFFER, data[: _OFFER.size])
    return cid, _piece(index, count, data[_OFFER.size :])


def _piece(index: int, count: int, data: bytes) -> Piece:
    if not index < count <= MAX_PIECES or not 0 < len(data) < DATAGRAM_SIZE:
        raise Malformed("a piece that does not exist, or is empty or too long")
    return index, count, data


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

    def add(self, piece: Piece) -> bytes | None:
        """The whole body once its last piece has come, else None.

        If the number of pieces changed: Malformed, and begun anew; one wrong piece must not keep the right ones out.
        """
        index, count, data = piece
        if self._pieces and count != self._count:
            self._pieces = {}
            raise Malformed("the number of pieces changed")
        self._count = count
        self._pieces.setdefault(index, data)
        if len(self._pieces) < count:
            return None
        body = b"".join(self._pieces[i] for i in range(count))
        self._pieces = {}
        return body


def fields(parts: Sequence[bytes]) -> bytes:
    """The body of a PROOF or OFFER: each part behind its length in two bytes."""
    return b"".join(len(part).to_bytes(2, "big") + part for part in parts)


def parse_fields(body: bytes, count: int) -> tuple[list[bytes], list[int]]:
    """Exactly `count` fields and nothing after them; and the offset in `body` at which each begins."""
    parts: list[bytes] = []
    offsets: list[int] = []
    position = 0
    for _ in range(count):
        start = position + 2
        stop = start + int.from_bytes(body[position:start], "big")
        if start > len(body) or stop > len(body):
            raise Malformed("a handshake message ends within a field")
        parts.append(body[start:stop])
        offsets.append(position)
        position = stop
    if position != len(body):
        raise Malformed("a handshake message goes on after its last field")
    return parts, offsets


# Frames inside DATA


class Frame(IntEnum):
    """First byte of a frame. PING: nothing. SEGMENT: index (4), data to the end of the packet. CLOSE: reason (1)."""

    PING = 0x01
    ACK = 0x02
    SEGMENT = 0x03
    CLOSE = 0x04


SEGMENT_HEADER = struct.Struct(">BI")
SEGMENT_SIZE = DATAGRAM_SIZE - DATA_OVERHEAD - SEGMENT_HEADER.size
_ACK = struct.Struct(">BIHIIB")
ACK_BITS = 512
_ACK_MASK = (1 << ACK_BITS) - 1
MAX_ACK_SIZE = _ACK.size + ACK_BITS // 8


class Ack(NamedTuple):
    """ACK: largest packet number received (4), since when, in 100 µs (2), the segment that comes next in order (4),
    the segment that may not be sent yet (4), n (1), n bytes: bit i, from the low end, is packet largest - i.
    """

    largest: int
    delay: float
    next_segment: int
    limit: int
    bits: int

    def to_bytes(self) -> bytes:
        bits = self.bits & _ACK_MASK
        size = (bits.bit_length() + 7) // 8
        delay = min(int(self.delay * 10000), 0xFFFF)
        head = _ACK.pack(Frame.ACK, self.largest, delay, self.next_segment, self.limit, size)
        return head + bits.to_bytes(size, "big")

    @staticmethod
    def parse(frames: bytes, position: int) -> tuple[Ack, int]:
        """The ACK at `position`, and the position behind it."""
        start = position + _ACK.size
        if start > len(frames):
            raise Malformed("an ACK ends early")
        _, largest, delay, next_segment, limit, size = _ACK.unpack_from(frames, position)
        stop = start + size
        if stop > len(frames) or size > ACK_BITS // 8:
            raise Malformed("an ACK ends early, or is too long")
        bits = int.from_bytes(frames[start:stop], "big")
        if not bits & 1 or bits.bit_length() > largest + 1:
            raise Malformed("an ACK without its largest packet, or of negative packet numbers")
        return Ack(largest, delay / 10000, next_segment, limit, bits), stop
