"""What the tests of the log share: a robot, readers, chunks as they should be, and chunks of a robot that lies."""

from __future__ import annotations

import random
import struct
from collections.abc import Callable, Sequence
from typing import Any

from rosbridge_eth import identity
from rosbridge_eth.log.chunk import Chunk, Header, Log, _body_key, ledger_id, proofs, robot_id, seal
from smcrypto import sm2, sm3, sm4

LOG = Log(ledger_id(1337, b"g" * 32, b"c" * 20), robot_id("robot_1"))
ROBOT, READER, SECOND, STRANGER = (sm2.PrivateKey.from_int(1000 + i) for i in range(4))
STREAM = bytes(range(16))
LINES = (b'{"stream":{"source":"sim"}}', b'{"type":"a/B"}', *(b'{"topic":"/a","n":%d}' % i for i in range(5)))

FIXED = ">BB16sQ32sQI32sI32sB"
FIELDS = ("version", "flags", "stream", "number", "previous", "sealed_ms", "records", "root", "body_length",
          "body_digest", "n")  # fmt: skip


def sealed(lines: Sequence[bytes] = LINES, **changes: Any) -> Chunk:
    """A chunk as the robot makes it, for READER."""
    given: dict[str, Any] = {
        "stream": STREAM, "number": 3, "previous": b"p" * 32, "sealed_ms": 1_795_226_223_026,
        "readers": [READER.public_key], "secret": b"s" * 32,
    }  # fmt: skip
    return seal(LOG, ROBOT, lines, **given | changes)


def header_bytes(header: Header | Chunk, **changes: Any) -> bytes:
    """The header with some of its fixed fields changed."""
    encoded = header.encoded
    values = dict(zip(FIELDS, struct.unpack_from(FIXED, encoded), strict=True)) | changes
    return struct.pack(FIXED, *values.values()) + encoded[struct.calcsize(FIXED) :]


def signed(header: bytes, body: bytes, purpose: str = "chunk") -> Chunk:
    """A chunk of these parts whose signature holds."""
    signature = identity.sign(ROBOT, purpose, LOG.ledger + LOG.tk + header)
    return Chunk(Header.parse(header), signature, body)


def lying(frame: bytes, *, records: int = 1, root: bytes = b"r" * 32, pad: int | None = None, key: bytes = b"k" * 16,
          sealed_under: bytes | None = None, flags: int = 0) -> Chunk:  # fmt: skip
    """A chunk that the robot signed, and whose body holds `frame` and whatever the robot likes."""
    plaintext = frame + bytes(-len(frame) % 64 if pad is None else pad)
    place = STREAM + (3).to_bytes(8, "big")
    body = sm4.SM4GCM(_body_key(sealed_under or key)).encrypt(bytes(12), plaintext, LOG.ledger + LOG.tk + place)
    header = struct.pack(
        FIXED, 3, flags, STREAM, 3, bytes(32), 5, records, root, len(body), sm3.digest(body), 1
    ) + READER.public_key.encrypt(key, encoding="c1c3c2")  # fmt: skip
    return signed(header, body)


def root_of(lines: Sequence[bytes], key: bytes = b"k" * 16) -> bytes:
    """The root over these lines, by the proof of the first."""
    proof = next(proofs(lines, key, [0]))
    value = sm3.digest(b"\0" + proof.salt + lines[0])
    for sibling in proof.path:
        value = sm3.digest(b"\1" + value + sibling)
    return value


def repeating(seed: int = 1) -> Callable[[int], bytes]:
    """A random source that gives the same bytes in every copy of it."""
    source = random.Random(seed)
    return source.randbytes
