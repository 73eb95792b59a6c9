"""Chunks that nobody signed, quickly made: stores look at headers and sizes alone."""

from __future__ import annotations

import os
import struct
from collections.abc import Iterator

from rosbridge_eth.log.chunk import Chunk
from smcrypto import sm3

STREAM = b"s" * 16
FIXED = struct.Struct(">BB16sQ32sQI32sI32sB")


def chunk(number: int, stream: bytes = STREAM, *, size: int = 500, records: int = 5, variant: int = 0,
          previous: bytes = bytes(32)) -> Chunk:  # fmt: skip
    """One of about `size` bytes; the same arguments give the same header, and other content. size=0: without body."""
    blocks = max(1, (size - FIXED.size - 113 - 64 - 16) // 64)
    body = os.urandom(blocks * 64 + 16) if size else b""
    digest = sm3.digest(b"%d" % variant) if size else sm3.digest(b"")
    fixed = FIXED.pack(
        3, 0, stream, number, previous, 1000 + variant, records if size else 0, bytes(32) if size else digest,
        len(body), digest, 1 if size else 0,
    )  # fmt: skip
    return Chunk.parse(fixed + bytes(113 if size else 0) + b"w" * 64 + body)


def chain(count: int, stream: bytes = STREAM, *, previous: bytes = bytes(32), **more) -> Iterator[Chunk]:
    """The first `count` chunks of a stream, each linked to the one before."""
    for number in range(count):
        made = chunk(number, stream, previous=previous, **more)
        previous = made.header.digest
        yield made


def dropped(whole: Chunk) -> Chunk:
    """Its dropped form."""
    return Chunk(whole.header, b"d" * 64, b"") if whole.body else whole
