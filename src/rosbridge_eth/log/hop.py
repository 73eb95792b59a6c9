"""What a robot and its server say to each other inside the channel.

    up    a chunk    00 | chunk, or 01 | after 32 | chunk
    down  a state    head 24 | digest 32 | confirmed 24 | block 8 | again 1 | refused 32 | why, UTF-8, at most 400 bytes

The server says how far its replica of the robot's log goes, the robot sends what follows. A chunk follows the one that
its header names as `previous`; where the robot has that one no more, `after` is the digest of the one behind which it
has nothing else. So a chunk is taken behind this digest or not at all, whatever happened to the server meanwhile.

The state is a level: only the newest counts, and it may come again. Numbers are big-endian. The robot is never named:
it is who the channel authenticated.
"""

from __future__ import annotations

import struct
from typing import Final, NamedTuple

from rosbridge_eth.log.store import NO_DIGEST, NOWHERE

MAX_WHY: Final = 400
MAX_OVERHEAD: Final = 33
"""Bytes that an offer has beside its chunk."""
_STATE: Final = struct.Struct(">24s32s24sQB32s")
FORKED: Final = (
    "the robot's log goes on elsewhere: another machine has its identity, or its disk was put back from an old copy;"
    " `revoke` it, `register --replace` it, and `join` the new bundle in a new folder, on one machine"
)
"""Why nothing is taken of a log that forked, on both ends."""
ELSEWHERE: Final = "this robot belongs to the server's shard at "
"""Why a shard takes nothing of a robot that belongs to another one, whose HOST:PORT follows: the robot goes there."""


class HopError(Exception):
    """The peer sent what is not a message here."""


class ServerState(NamedTuple):
    """How the server stands to a robot's log.

    head, digest: the place up to which it has the log, and the digest of the header there. confirmed, block: what the
    chain has for good, and in which block the newest of that is. again: changes whenever the server did not take what
    came; the robot goes on from `head`. refused: digest of a chunk that will never be taken. why: nothing is taken now.
    """

    head: bytes = NOWHERE
    digest: bytes = NO_DIGEST
    confirmed: bytes = NOWHERE
    block: int = 0
    again: int = 0
    refused: bytes = NO_DIGEST
    why: str = ""

    def encode(self) -> bytes:
        """A reason is cut to MAX_WHY bytes, and what does not print in it becomes a space."""
        printable = "".join(letter if letter.isprintable() else " " for letter in self.why).encode("utf-8", "replace")
        return _STATE.pack(*self[:-1]) + printable[:MAX_WHY].decode("utf-8", "ignore").encode()

    @staticmethod
    def decode(data: bytes) -> ServerState:
        """HopError unless `data` is a state."""
        try:
            head, digest, confirmed, block, again, refused = _STATE.unpack_from(data)
            why = data[_STATE.size :].decode("utf-8")
        except (struct.error, UnicodeDecodeError):
            raise HopError(f"not a server's state: {len(data)} bytes") from None
        if len(data) > _STATE.size + MAX_WHY or not why.isprintable():
            raise HopError("a reason that is too long or does not print")
        return ServerState(head, digest, confirmed, block, again, refused, why)


def encode_offer(chunk: bytes, after: bytes = b"") -> bytes:
    """after: the digest behind which the robot has nothing else than this chunk, empty where that is its `previous`."""
    return bytes((bool(after),)) + after + chunk


def decode_offer(data: bytes) -> tuple[bytes, bytes]:
    """The encoded chunk, which is not looked into, and `after`. HopError."""
    start = {b"\0": 1, b"\1": MAX_OVERHEAD}.get(data[:1], 0)
    if not 0 < start < len(data):
        raise HopError(f"not an offer: {len(data)} bytes")
    return data[start:], data[1:start]
