"""What stands in a datagram, byte for byte. Big-endian throughout; docs/channel.md has the figures.

A datagram is one of five handshake kinds, which all begin alike, or DATA: 0x40, connection id (8), packet number (4),
then SM4-GCM of one frame, and its tag (16). The 13 bytes before are authenticated.

Parsers here take bytes from anybody. They return values or raise Malformed; they never allocate more than they
were given.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from enum import IntEnum, StrEnum
from typing import NamedTuple

VERSION = 3
DATAGRAM_SIZE = 1200
"""Bytes of UDP payload that every path is taken to carry (RFC 9000, 14: the same figure, for the same reason)."""

CID_SIZE = 8
NONCE_SIZE = 16
COOKIE_SIZE = 24
DATA_HEADER_SIZE = 13
DATA_OVERHEAD = DATA_HEADER_SIZE + 16
MAX_PIECES = 8
"""Pieces of one handshake message: 8 of them hold about 9 KiB, two generous certificates."""


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


class Drop(StrEnum):
    """Why a datagram was dropped without a word; counted in an endpoint's `statistics`."""

    MALFORMED = "malformed"
    MODE = "other mode"
    UNEXPECTED = "unexpected in this state"
    ADDRESS = "from another address"
    COOKIE = "cookie wrong or too old"
    BUSY = "no time left for handshakes"
    HALF_OPEN = "too many half-open handshakes"
    CONNECTIONS = "too many connections"
    CERTIFICATE = "certificate refused"
    SIGNATURE = "handshake signature or confirmation wrong"
    UNKNOWN_CONNECTION = "unknown connection"
    REPLAYED = "packet number seen before"
    TAG = "authentication failed"
    FULL = "no room to keep it until what comes before it is there"


class Refused(Exception):
    """A datagram is not accepted; `hint` is what its sender may be told."""

    def __init__(self, drop: Drop, why: str = "", hint: Reason | None = None) -> None:
        super().__init__(why)
        self.drop, self.hint = drop, hint


class Malformed(Refused):
    """Bytes are not what the wire format says; always the sender's fault."""

    def __init__(self, why: str) -> None:
        super().__init__(Drop.MALFORMED, why)


# The handshake

_HEAD = struct.Struct(">BBB8s16s")
HEAD_SIZE = _HEAD.size
HELLO_PADDING = bytes(DATAGRAM_SIZE - HEAD_SIZE)


class Hello(NamedTuple):
    """What every handshake datagram says behind its kind and version: mode (1), client's connection id (8), N (16).

    It names one attempt of one client. Behind it stands: in HELLO zeros up to 1,200 bytes; in COOKIE the cookie; in
    PROOF the cookie and a piece, of which the last ends in zeros up to 1,200 bytes; in OFFER a piece; in REFUSAL a
    reason (1).
    """

    mode: Mode
    client_cid: bytes
    nonce: bytes

    def datagram(self, kind: Kind, rest: bytes) -> bytes:
        return _HEAD.pack(kind, VERSION, *self) + rest

    @staticmethod
    def parse(data: bytes) -> tuple[Hello, bytes]:
        """The fields of a handshake datagram, and what stands behind them."""
        if not HEAD_SIZE <= len(data) <= DATAGRAM_SIZE:
            raise Malformed("a handshake message has another length")
        _, version, mode, cid, nonce = _HEAD.unpack_from(data)
        if version != VERSION or mode not in Mode.__members__.values():
            raise Malformed("a version or mode that does not exist")
        return Hello(Mode(mode), cid, nonce), data[HEAD_SIZE:]

    def in_pieces(self, kind: Kind, before: bytes, body: bytes) -> list[bytes]:
        """The datagrams of a PROOF or an OFFER: in each `before`, index, count, a piece of the body."""
        size = DATAGRAM_SIZE - HEAD_SIZE - len(before) - 2
        if kind is Kind.PROOF:  # the answer is never longer than what asked for it
            body += bytes(-len(body) % size)
        pieces = [body[start : start + size] for start in range(0, len(body), size)]
        if len(pieces) > MAX_PIECES:
            raise ValueError(f"a handshake message of {len(body)} bytes does not fit in {MAX_PIECES} datagrams")
        return [self.datagram(kind, before + bytes((i, len(pieces))) + piece) for i, piece in enumerate(pieces)]


class Assembly:
    """The pieces of one handshake message on their way; takes each index once, at most MAX_PIECES of them."""

    def __init__(self) -> None:
        self._pieces: dict[int, bytes] = {}
        self.count = 0
        """How many pieces there are."""

    def add(self, piece: bytes) -> bytes | None:
        """Take index, count and a piece of the body. The whole body once all its pieces have come, else None.

        If the number of pieces changed: Malformed, and started again; one wrong piece must not keep the right ones out.
        """
        if len(piece) < 3 or not piece[0] < piece[1] <= MAX_PIECES:
            raise Malformed("a piece that does not exist, or is empty")
        if self._pieces and piece[1] != self.count:
            self._pieces = {}
            raise Malformed("the number of pieces changed")
        self.count = piece[1]
        self._pieces.setdefault(piece[0], piece[2:])
        if len(self._pieces) < self.count:
            return None
        return b"".join(self._pieces[index] for index in range(self.count))


def fields(parts: Sequence[bytes]) -> bytes:
    """The body of a PROOF or OFFER: each part behind its length in two bytes."""
    return b"".join(len(part).to_bytes(2, "big") + part for part in parts)


def parse_fields(body: bytes, lengths: Sequence[int | None]) -> tuple[list[bytes], list[int]]:
    """Fields of exactly these lengths (None: any), then nothing but zeros; and offsets in `body`: where each field
    begins, and the end."""
    parts, offsets = list[bytes](), [0]
    for length in lengths:
        start = offsets[-1] + 2
        stop = start + int.from_bytes(body[start - 2 : start], "big")
        if max(start, stop) > len(body) or length not in (None, stop - start):
            raise Malformed("a handshake message ends within a field, or a field has another length")
        parts.append(body[start:stop])
        offsets.append(stop)
    if any(body[offsets[-1] :]):
        raise Malformed("a handshake message goes on after its last field")
    return parts, offsets


# The frame inside DATA: one, to the end of the packet


class Frame(IntEnum):
    """First byte of a frame. Up: SEGMENT: index (4), data. PROBE: zeros. Down: ANSWER. Both: CLOSE: reason (1)."""

    SEGMENT = 0x01
    PROBE = 0x02
    ANSWER = 0x03
    CLOSE = 0x04


SEGMENT_HEADER = struct.Struct(">BI")
SEGMENT_SIZE = DATAGRAM_SIZE - DATA_OVERHEAD - SEGMENT_HEADER.size
MAX_STATE = 600
"""Bytes that a server's program may say to a robot."""
ACK_BITS = 512
_ACK_MASK = (1 << ACK_BITS) - 1
_ANSWER = struct.Struct(">BIIQB")
PROBE = bytes((Frame.PROBE,)).ljust(_ANSWER.size + ACK_BITS // 8 + MAX_STATE, b"\0")
"""As long as the longest ANSWER."""


class Answer(NamedTuple):
    """ANSWER: largest packet number received (4), the segment that comes next in order (4), the server's clock in ms
    since 1970 (8), n (1), n bytes: bit i, from the low end, is packet largest - i; then what the program says.
    """

    largest: int
    next_segment: int
    time_ms: int
    bits: int
    data: bytes

    def to_bytes(self) -> bytes:
        bits = self.bits & _ACK_MASK
        size = (bits.bit_length() + 7) // 8
        head = _ANSWER.pack(Frame.ANSWER, self.largest, self.next_segment, self.time_ms, size)
        return head + bits.to_bytes(size, "big") + self.data

    @staticmethod
    def parse(frame: bytes) -> Answer:
        if len(frame) < _ANSWER.size or frame[0] != Frame.ANSWER:
            raise Malformed("a frame that does not exist or is not for a client, or an answer that ends early")
        _, largest, next_segment, time_ms, size = _ANSWER.unpack_from(frame)
        stop = _ANSWER.size + size
        if stop > len(frame) or size > ACK_BITS // 8 or len(frame) - stop > MAX_STATE:
            raise Malformed("an answer ends early, or is too long")
        bits = int.from_bytes(frame[_ANSWER.size : stop], "big")
        if not bits & 1 or bits.bit_length() > largest + 1 or size != (bits.bit_length() + 7) // 8:
            raise Malformed("an answer without its largest packet, of negative packet numbers, or with zeros behind")
        return Answer(largest, next_segment, time_ms, bits, frame[stop:])
