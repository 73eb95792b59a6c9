"""The chunk, the unit of a robot's log: build it, check it, open it, prove one record of it.

    chunk     = header | signature 64 | body
    header    = version 1 | flags 1 | stream 16 | number 8 | previous 32 | sealed at, ms since 1970, 8
              | records 4 | root 32 | body length 4 | body digest 32 | n 1 | n * wrapped key 113
    body      = SM4-GCM(body key, nonce 0, associated data ledger | Tk | stream | number, plaintext)
    plaintext = one zstd frame (RFC 8878), then zeros to a multiple of 64
    content   = what the frame holds: the records, one line each, every line ended by 0A

Numbers are big-endian, hashes SM3, signatures SM2. The signature is over ledger | Tk | header for the
purpose "chunk", or "dropped" where the robot itself removed the body; see identity. The root is the Merkle
tree of RFC 9162, 2.1, over salted lines. What is wrapped is the content key, of which body key and salt key
are derived. docs/log.md says all of it byte by byte.

Not here: what a line says (capture), when a chunk is closed (writer), which certificate governs (reading).
"""

from __future__ import annotations

import secrets
import struct
import sys
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Final, NamedTuple

from eth_hash.auto import keccak

from rosbridge_eth import identity
from rosbridge_eth.errors import VerificationError
from smcrypto import InvalidCiphertext, InvalidSignature, InvalidTag, sm2, sm3, sm4

if TYPE_CHECKING or sys.version_info < (3, 14):
    from backports import zstd
else:
    from compression import zstd

VERSION: Final = 3
#: The only flag: the last chunk of an orderly run.
GOODBYE: Final = 1

MAX_BODY: Final = 64 * 1024 - 48  # the longest below 64 KiB: 1,023 blocks of 64 and the tag
MAX_READERS: Final = 16
MAX_RECORDS: Final = 1000
#: Bytes of JSON Lines that a reader unpacks at most.
MAX_PLAINTEXT: Final = 4 * 1024 * 1024
#: Bytes of a line that fits a chunk of its own whatever it holds.
MAX_LINE: Final = 60 * 1024
#: The year 10000; a chunk is sealed before.
MAX_TIME_MS: Final = 253_402_300_800_000

STREAM_SIZE: Final = 16
KEY_SIZE: Final = 16
_SALT, _GCM_TAG, _HASH, _BLOCK = 16, 16, 32, 64
_GRANT = 1 + 64 + _HASH + KEY_SIZE  # C1 | C3 | C2, GB/T 32918.4
_FIXED = struct.Struct(">BB16sQ32sQI32sI32sB")
MAX_HEADER: Final = _FIXED.size + MAX_READERS * _GRANT
MAX_CHUNK: Final = MAX_HEADER + identity.SIGNATURE_SIZE + MAX_BODY

#: zstd's level, chosen by benchmarks/bench_log.py.
LEVEL: Final = 9
#: How every frame begins: magic, then a descriptor that says one segment, size in 4 bytes, no checksum, no dictionary.
_FRAME = b"\x28\xb5\x2f\xfd\xa0"
_MAX_BLOCK = 128 * 1024  # RFC 8878, 3.1.1.2.4

Randomness = Callable[[int], bytes]


class ChunkError(VerificationError):
    """Something is wrong with a chunk; the subclass says what."""


class Malformed(ChunkError):
    """These bytes are not a chunk."""


class Altered(ChunkError):
    """A body is not the one its header names, or a line not the one its proof is for."""


class Forged(ChunkError):
    """The signature is not the robot's, for this chunk in this form, robot, contract and chain."""


class Unopenable(ChunkError):
    """The signature may hold, but what the robot signed cannot be opened, or is not what the header says."""


class NoGrant(ChunkError):
    """The chunk's key was not wrapped to this reader."""


class TooLarge(ChunkError):
    """The lines do not fit one chunk."""


class Log(NamedTuple):
    """Where a chunk stands: the ledger (32 bytes, `ledger_id`) and the robot (Tk, 32 bytes). Signed, not sent."""

    ledger: bytes
    tk: bytes


def robot_id(name: str) -> bytes:
    """Tk of the contract: keccak256 of the robot's name in UTF-8, 32 bytes. An identity, not a secret."""
    return keccak(name.encode("utf-8"))


def ledger_id(chain_id: int, genesis: bytes, contract: bytes) -> bytes:
    """SM3(chain id, 32 bytes | hash of the genesis block, 32 | contract's address, 20)."""
    if len(genesis) != 32 or len(contract) != 20:
        raise ValueError(f"a block's hash has 32 bytes and an address 20, not {len(genesis)} and {len(contract)}")
    return sm3.digest(chain_id.to_bytes(32, "big") + genesis + contract)


def stream_name(wall_ms: int, newest: bytes, randomness: Randomness = secrets.token_bytes) -> bytes:
    """The name of a stream that begins now: ms since 1970 in 8 bytes, and 8 random ones.

    It is above `newest`, the newest one known of the robot, whatever the clock says: so names order as the log does.
    """
    began = max(min(wall_ms, MAX_TIME_MS), int.from_bytes(newest[:8], "big") + 1)
    return began.to_bytes(8, "big") + randomness(STREAM_SIZE - 8)


@dataclass(frozen=True, slots=True)
class Header:
    """What everybody may read. `digest`, SM3 of it as encoded, is the identity of the chunk."""

    flags: int
    stream: bytes
    number: int
    previous: bytes
    sealed_ms: int
    records: int
    root: bytes
    body_length: int
    body_digest: bytes
    grants: tuple[bytes, ...] = field(repr=False)
    encoded: bytes = field(repr=False)
    digest: bytes

    @property
    def goodbye(self) -> bool:
        """Whether the robot said that nothing follows in this stream."""
        return bool(self.flags & GOODBYE)

    def __str__(self) -> str:
        return f"chunk {self.number} of stream {self.stream.hex()[:8]}"

    @staticmethod
    def parse(data: bytes) -> Header:
        """The header whose encoding is exactly `data`; Malformed if there is none."""
        if not _FIXED.size <= len(data) <= MAX_HEADER:
            raise Malformed(f"no header of a chunk has {len(data)} bytes")
        version, flags, stream, number, previous, sealed, records, root, size, digest, count = _FIXED.unpack_from(data)
        if version != VERSION or flags & ~GOODBYE:
            raise Malformed(f"a chunk of version {version} with flags {flags} is not known here")
        if len(data) != _FIXED.size + count * _GRANT:
            raise Malformed(f"a header with {count} grants does not have {len(data)} bytes")
        grants = tuple(data[at : at + _GRANT] for at in range(_FIXED.size, len(data), _GRANT))
        name = sm3.digest(data)
        header = Header(flags, stream, number, previous, sealed, records, root, size, digest, grants, data, name)
        if sealed >= MAX_TIME_MS:
            raise Malformed(f"{header} was sealed after the year 9999")
        if records == 0:
            if size or grants or root != _EMPTY or digest != _EMPTY:
                raise Malformed(f"{header} has no records, and a body, root or grants nevertheless")
        elif (
            records > MAX_RECORDS or not 1 <= count <= MAX_READERS or size % _BLOCK != _GCM_TAG
            or not _GCM_TAG < size <= MAX_BODY
        ):  # fmt: skip
            raise Malformed(f"{header} cannot have {records} records in {size} bytes for {count} readers")
        return header


#: Digest of the empty body, and root of the tree without leaves (RFC 9162, 2.1.1).
_EMPTY = sm3.digest(b"")


@dataclass(frozen=True, slots=True)
class Chunk:
    """Header, signature and body; a bare one has no body although its header names one."""

    header: Header
    signature: bytes = field(repr=False)
    body: bytes = field(repr=False)

    @property
    def encoded(self) -> bytes:
        """The bytes that travel from the robot's spool to the server."""
        return self.header.encoded + self.signature + self.body

    @property
    def bare(self) -> bool:
        """Whether the body is not here: the robot dropped it, and signed that it did."""
        return self.header.body_length > 0 and not self.body

    @staticmethod
    def parse(data: bytes | bytearray | memoryview) -> Chunk:
        """The chunk whose encoding is exactly `data`, whole or bare; Malformed if there is none.

        Nothing is verified: see `verify`.
        """
        if not _FIXED.size <= len(data) <= MAX_CHUNK:
            raise Malformed(f"no chunk has {len(data)} bytes")
        end = _FIXED.size + data[_FIXED.size - 1] * _GRANT
        header, body_at = Header.parse(bytes(data[:end])), end + identity.SIGNATURE_SIZE
        if len(data) not in (body_at, body_at + header.body_length):
            raise Malformed(f"{header} does not have {len(data)} bytes")
        return Chunk(header, bytes(data[end:body_at]), bytes(data[body_at:]))


# Building


def seal(
    log: Log, key: sm2.PrivateKey, lines: Sequence[bytes], *,
    stream: bytes, number: int, previous: bytes, sealed_ms: int, readers: Sequence[sm2.PublicKey],
    goodbye: bool = False, compress: bool = True, level: int = LEVEL, secret: bytes | None = None,
    randomness: Randomness = secrets.token_bytes,
) -> Chunk:
    """The chunk that holds `lines`, signed with the robot's `key` and encrypted to `readers` (1 to 16).

    lines: not empty and without newline, each; none at all make a chunk without body. previous: the digest of
    the header before. compress=False stores the lines as they are, so that sizes tell nothing of the content.
    secret: a `content_secret` of the robot, for all chunks of a run; None makes one, which costs a signature.
    TooLarge if the lines do not fit; then nothing was used up. Malformed for another number of readers.
    """
    root, body, grants = _EMPTY, b"", b""
    if lines:
        plaintext = _pack(lines, compress, level)
        place = stream + number.to_bytes(8, "big")
        fresh = randomness(32) + log.ledger + log.tk + place + sm3.digest(plaintext)
        new_key = sm3.hmac(content_secret(key) if secret is None else secret, fresh)[:KEY_SIZE]
        body = sm4.SM4GCM(_body_key(new_key)).encrypt(bytes(12), plaintext, log.ledger + log.tk + place)
        root = _levels(_leaves(lines, new_key))[-1][0]
        grants = b"".join(reader.encrypt(new_key, encoding="c1c3c2") for reader in readers)
    fixed = _FIXED.pack(
        VERSION, GOODBYE * goodbye, stream, number, previous, sealed_ms,
        len(lines), root, len(body), sm3.digest(body), len(grants) // _GRANT,
    )  # fmt: skip
    header = Header.parse(fixed + grants)
    return Chunk(header, identity.sign(key, "chunk", _signed(log, header)), body)


def content_secret(key: sm2.PrivateKey) -> bytes:
    """The secret behind the content keys of a run, 32 bytes: SM3 of a signature that nobody else sees.

    A signature is all that is asked of the key, so that it may live in a token; without the key its s cannot be
    computed, not even by who knows every random byte.
    """
    return sm3.digest(identity.sign(key, "content-keys", b""))


def drop(log: Log, key: sm2.PrivateKey, chunk: Chunk) -> Chunk:
    """The dropped form of `chunk`: the same header, signed for it, and no body. Without a body nothing changes."""
    if not chunk.body:
        return chunk
    return Chunk(chunk.header, identity.sign(key, "dropped", _signed(log, chunk.header)), b"")


def _pack(lines: Sequence[bytes], compress: bool, level: int) -> bytes:
    """The plaintext: the lines in one frame, padded."""
    if any(not line or b"\n" in line for line in lines):
        raise ValueError("a line is not empty and holds no newline")
    size = sum(map(len, lines)) + len(lines)
    if len(lines) > MAX_RECORDS or size > MAX_PLAINTEXT:
        raise TooLarge(f"{len(lines)} lines of {size} bytes are too many for a chunk")
    content = b"\n".join([*lines, b""])
    frame = _compressed(content, level) if compress else _stored(content)
    if len(frame) > MAX_BODY - _GCM_TAG:
        raise TooLarge(f"{len(lines)} lines take {len(frame)} bytes, more than fit a chunk")
    return frame.ljust(len(frame) + -len(frame) % _BLOCK, b"\0")


def _compressed(content: bytes, level: int) -> bytes:
    # Messages are long repetitions with digits between them. Matches of three digits, or far away, cost more
    # bits than the digits themselves: 68 bytes a record instead of 82 (see benchmarks/bench_log.py).
    of = zstd.CompressionParameter
    options: dict[int, int] = {of.compression_level: level, of.min_match: 6, of.hash_log: 14}
    return _framed(zstd.compress(content, options=options), content)


def _framed(frame: bytes, content: bytes) -> bytes:
    """The frame with the one header that is taken; the blocks are the same. RFC 8878, 3.1.1.1."""
    single, size = frame[4] >> 5 & 1, (0, 2, 4, 8)[frame[4] >> 6]
    return _FRAME + len(content).to_bytes(4, "little") + frame[6 + (size or single) - single :]


def _stored(content: bytes) -> bytes:
    """A frame of raw blocks (RFC 8878, 3.1.1.2)."""
    parts = [_FRAME, len(content).to_bytes(4, "little")]
    for at in range(0, len(content), _MAX_BLOCK):
        block = content[at : at + _MAX_BLOCK]
        last = at + len(block) == len(content)
        parts += (len(block) << 3 | last).to_bytes(3, "little"), block
    return b"".join(parts)


def _signed(log: Log, header: Header) -> bytes:
    return log.ledger + log.tk + header.encoded


def _body_key(content_key: bytes) -> bytes:
    return _expanded(content_key, b"rosbridge-eth/3 body")[:KEY_SIZE]


def _expanded(key: bytes, label: bytes) -> bytes:
    """HKDF-Expand with SM3, one block of 32 bytes (RFC 5869, 2.3)."""
    return sm3.hmac(key, label + b"\1")


# Checking and opening


def verify(log: Log, public_key: sm2.PublicKey, chunk: Chunk) -> None:
    """Return if the holder of `public_key` signed `chunk` in this form and the body is its own; else Altered, Forged.

    A bare chunk is the dropped form. What is inside is not looked at: that needs the content key.
    """
    header = chunk.header
    if not chunk.bare and (len(chunk.body) != header.body_length or sm3.digest(chunk.body) != header.body_digest):
        raise Altered(f"the body of {header} is not the one that its header names")
    verify_signature(log, public_key, chunk)


def verify_signature(log: Log, public_key: sm2.PublicKey, chunk: Chunk) -> None:
    """As `verify`, but the body is not looked at: whether the robot wrote this header, for this form. Forged."""
    try:
        purpose = "dropped" if chunk.bare else "chunk"
        identity.verify(public_key, purpose, _signed(log, chunk.header), chunk.signature)
    except InvalidSignature:
        raise Forged(f"the signature of {chunk.header} does not hold") from None


def content_key(header: Header, reader: sm2.PrivateKey) -> bytes:
    """The 16-byte key of the chunk's body; NoGrant if it was not wrapped to `reader`."""
    return unwrap(header, reader)[0]


def unwrap(header: Header, reader: sm2.PrivateKey, likely: int = 0) -> tuple[bytes, int]:
    """As `content_key`, with the index of the grant that fitted.

    likely: the index to be tried first, as a robot gives its grants the same order in every chunk. Each that does
    not fit costs a multiplication on the curve.
    """
    order = sorted(range(len(header.grants)), key=lambda index: index != likely)
    for index in order:
        try:
            return reader.decrypt(header.grants[index], encoding="c1c3c2"), index
        except InvalidCiphertext:
            continue
    raise NoGrant(f"{header} was not granted to this reader")


def open_lines(log: Log, chunk: Chunk, key: bytes) -> tuple[bytes, ...]:
    """The records of `chunk` under its content key; Unopenable unless tag, frame, padding, number and root are right.

    The chunk is not bare; its signature is `verify`'s matter.
    """
    header = chunk.header
    if chunk.bare:
        raise ValueError(f"the body of {header} is not here")
    if not chunk.body:
        return ()
    associated = log.ledger + log.tk + header.stream + header.number.to_bytes(8, "big")
    try:
        plaintext = sm4.SM4GCM(_body_key(key)).decrypt(bytes(12), chunk.body, associated)
    except InvalidTag:
        raise Unopenable(f"{header} does not open with this key") from None
    lines = _unpack(header, plaintext)
    if _levels(_leaves(lines, key))[-1][0] != header.root:
        raise Unopenable(f"the records of {header} are not those that its root commits to")
    return lines


def _unpack(header: Header, plaintext: bytes) -> tuple[bytes, ...]:
    """The lines of a plaintext; memory and time are bounded whatever it holds."""
    if not plaintext.startswith(_FRAME):  # libzstd would take skippable frames and old formats as well
        raise Unopenable(f"{header} holds no zstd frame in the one form")
    window = {int(zstd.DecompressionParameter.window_log_max): MAX_PLAINTEXT.bit_length() - 1}
    unpacking = zstd.ZstdDecompressor(options=window)
    try:
        content = unpacking.decompress(plaintext, MAX_PLAINTEXT + 1)
    except zstd.ZstdError as error:
        raise Unopenable(f"{header} cannot be unpacked: {error}") from None
    if not unpacking.eof or len(content) > MAX_PLAINTEXT:
        raise Unopenable(f"{header} unpacks to more than {MAX_PLAINTEXT} bytes, or its frame has no end")
    padding = unpacking.unused_data
    if len(padding) >= _BLOCK or any(padding):
        raise Unopenable(f"{header} holds more than one frame and its padding")
    if not content.endswith(b"\n") or content.startswith(b"\n") or b"\n\n" in content:
        raise Unopenable(f"{header} holds a record that is empty or has no end")
    if (count := content.count(b"\n")) != header.records:
        raise Unopenable(f"{header} holds {count} records and not {header.records}")
    return tuple(content[:-1].split(b"\n"))


# One record


@dataclass(frozen=True, slots=True)
class Proof:
    """What shows one line to somebody who has the root: its index, its salt, and the hashes beside its path."""

    index: int
    salt: bytes
    path: tuple[bytes, ...]


def proofs(lines: Sequence[bytes], key: bytes, indexes: Iterable[int]) -> Iterator[Proof]:
    """The proof of each `lines[index]` among all the lines of a chunk (RFC 9162, 2.1.3.1)."""
    levels = _levels(_leaves(lines, key))
    for index in indexes:
        beside = ((level, index >> height ^ 1) for height, level in enumerate(levels[:-1]))
        path = tuple(level[place] for level, place in beside if place < len(level))
        yield Proof(index, next(_salts(key, [index])), path)


def check_proof(root: bytes, records: int, line: bytes, proof: Proof) -> None:
    """Return if `line` is record `proof.index` of the chunk with this root and number of records; else Altered.

    RFC 9162, 2.1.3.2, with its names fn and sn.
    """
    fn, sn = proof.index, records - 1
    fits = 0 <= fn <= sn and len(proof.salt) == _SALT and all(len(value) == _HASH for value in proof.path)
    value = _leaf(proof.salt, line)
    for sibling in proof.path if fits else ():
        if sn == 0:
            fits = False
            break
        if fn & 1 or fn == sn:
            value = _node(sibling, value)
            while fn and not fn & 1:
                fn, sn = fn >> 1, sn >> 1
        else:
            value = _node(value, sibling)
        fn, sn = fn >> 1, sn >> 1
    if not fits or sn != 0 or value != root:
        raise Altered("the proof does not show this record")


_IPAD = bytes(x ^ 0x36 for x in range(256))
_OPAD = bytes(x ^ 0x5C for x in range(256))


def _salts(key: bytes, indexes: Iterable[int]) -> Iterator[bytes]:
    """The first 16 bytes of HMAC-SM3(salt key, index in 4 bytes), for each index; key: the content key.

    RFC 2104 written out with the pads made once: 4.1 us a salt where `sm3.hmac` takes 7.0 and copies of two
    started hashes take 4.2.
    """
    block = _expanded(key, b"rosbridge-eth/3 salts").ljust(sm3.SM3.block_size, b"\0")
    inner, outer = block.translate(_IPAD), block.translate(_OPAD)
    for index in indexes:
        yield sm3.digest(outer + sm3.digest(inner + index.to_bytes(4, "big")))[:_SALT]


def _leaves(lines: Sequence[bytes], key: bytes) -> list[bytes]:
    return [_leaf(salt, line) for salt, line in zip(_salts(key, range(len(lines))), lines, strict=True)]


def _leaf(salt: bytes, line: bytes) -> bytes:
    return sm3.digest(b"\0" + salt + line)


def _node(left: bytes, right: bytes) -> bytes:
    return sm3.digest(b"\1" + left + right)


def _levels(leaves: list[bytes]) -> list[list[bytes]]:
    """The tree from the leaves up to the root; the last of an odd level goes up as it is.

    That is the tree of RFC 9162, 2.1.1, which splits at the largest power of two below the number of leaves.
    """
    levels = [leaves]
    while len(level := levels[-1]) > 1:
        above = [_node(level[i], level[i + 1]) for i in range(0, len(level) - 1, 2)]
        levels.append(above + level[len(level) & ~1 :])
    return levels
