"""The robot's side: payloads to sealed records, in streams.

A stream is a random id with a random SM4 key that lives in memory alone. It
begins anew at every start, every day, every 2**20 records and whenever the
readers change. `seq` counts from 0 within it and is the GCM nonce, so no nonce
repeats after a restart or when a disk is restored: the key is gone by then.
"""

from __future__ import annotations

import secrets
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass

from rosbridge_eth.records import STREAM_ID_SIZE, RecordId, SealedRecord, SeqRange
from rosbridge_eth.sealing.errors import NoReaders, RecordTooLarge
from rosbridge_eth.sealing.layout import (
    HEADER_SIZE,
    KEY_SIZE,
    MAX_CIPHERTEXT,
    MAX_PACKED,
    MAX_PAYLOAD,
    MAX_READERS,
    PURPOSES,
    TAG_SIZE,
    Kind,
    Opening,
    Sign,
    associated_data,
    commitment,
    nonce,
    pack_header,
    pack_ranges,
    padded_size,
    reader_tag,
)
from rosbridge_eth.sealing.packing import pack
from smcrypto import sm2, sm4

DAY_NS = 24 * 3600 * 10**9


@dataclass(frozen=True, slots=True)
class StreamLimits:
    """When a new stream begins: after this many records, or this long by the wall clock, whichever way it moved."""

    records: int = 2**20
    age_ns: int = DAY_NS


class Sealer:
    """Seals what a robot captured. Not for more than one thread at a time.

    Every method that seals returns records in the order they have to be kept:
    the one asked for is the last, before it stands the `open` record of a new
    stream where one was due. A stream begins with its first record, so a robot
    that starts and stops with nothing to say leaves nothing behind.

    sign: makes the robot's signatures. readers: their SM2 encryption keys, one
    at least. previous: the last record known of the stream before, from the
    spool. now_ns is always the wall clock.
    """

    def __init__(
        self,
        robot: bytes,
        sign: Sign,
        readers: Iterable[sm2.PublicKey],
        *,
        previous: RecordId | None = None,
        limits: StreamLimits = StreamLimits(),
        random: Callable[[int], bytes] = secrets.token_bytes,
    ) -> None:
        self._robot = robot
        self._sign = sign
        self._limits = limits
        self._random = random
        self._last = previous
        self._stream: _Stream | None = None
        self._readers = _distinct(readers)

    def __repr__(self) -> str:
        return f"<Sealer of robot {self._robot.hex()[:8]}, {len(self._readers)} readers, last {self._last}>"

    @property
    def last(self) -> RecordId | None:
        """The newest record sealed, of this stream or the one before."""
        return self._last

    def set_readers(self, readers: Iterable[sm2.PublicKey]) -> None:
        """From the next record on, these may read and no others; NoReaders if there are none."""
        self._readers = _distinct(readers)
        self._stream = None

    def seal(self, payload: bytes, now_ns: int) -> tuple[SealedRecord, ...]:
        """Seal one payload; RecordTooLarge if it does not fit, and then nothing was used up."""
        return self._seal(Kind.DATA, payload, now_ns)

    def declare(self, dropped: Sequence[SeqRange], now_ns: int) -> tuple[SealedRecord, ...]:
        """Seal the statement that these records, of this stream or earlier ones, were dropped and will not come."""
        return self._seal(Kind.GAP, pack_ranges(dropped), now_ns)

    def end(self, now_ns: int) -> tuple[SealedRecord, ...]:
        """Seal the end of the stream, if there is one: the robot stops in good order and nothing follows."""
        if self._stream is None:
            return ()
        end = self._seal(Kind.END, b"", now_ns)
        self._stream = None
        return end

    def _seal(self, kind: Kind, payload: bytes, now_ns: int) -> tuple[SealedRecord, ...]:
        if len(payload) > MAX_PAYLOAD:
            raise RecordTooLarge(f"{len(payload)} bytes do not fit a record; the most is {MAX_PAYLOAD}")
        packed = pack(payload)
        if len(packed) > MAX_PACKED:
            raise RecordTooLarge(
                f"{len(payload)} bytes, {len(packed)} compressed, do not fit a record of {MAX_CIPHERTEXT}; "
                "capture fewer fields of this topic"
            )
        stream, before = self._stream, list[SealedRecord]()
        if stream is None or (stream.is_spent(self._limits, now_ns) and kind is not Kind.END):
            stream, opening = self._open(now_ns)
            before.append(opening)
        record = stream.seal(kind, payload, packed, self._sign)
        # Only now: a stream whose first record failed was never begun, and its `open` record is not owed.
        self._stream, self._last = stream, record.id
        return (*before, record)

    def _open(self, now_ns: int) -> tuple[_Stream, SealedRecord]:
        id, key = self._random(STREAM_ID_SIZE), self._random(KEY_SIZE)
        opening = Opening(
            robot=self._robot,
            stream=id,
            created_ns=now_ns,
            previous=self._last,
            commitment=commitment(self._robot, id, key),
            wrapped={
                reader_tag(self._robot, id, encoded): reader.encrypt(key, encoding="c1c3c2")
                for encoded, reader in self._readers.items()
            },
        )
        head = pack_header(Kind.OPEN, opening.key_id)
        record_id, content = RecordId(self._robot, id, 0), opening.to_bytes()
        signature = self._sign(PURPOSES[Kind.OPEN], associated_data(record_id, head) + content)
        stream = _Stream(self._robot, id, key, opening.key_id, now_ns)
        return stream, SealedRecord(record_id, head + content + signature)


class _Stream:
    """One stream that is being written: its key, and the next seq."""

    def __init__(self, robot: bytes, id: bytes, key: bytes, key_id: bytes, created_ns: int) -> None:
        self._robot, self._id, self._key_id = robot, id, key_id
        self._gcm = sm4.SM4GCM(key)
        self._created_ns = created_ns
        self._next_seq = 1

    def is_spent(self, limits: StreamLimits, now_ns: int) -> bool:
        return self._next_seq >= limits.records or abs(now_ns - self._created_ns) >= limits.age_ns

    def seal(self, kind: Kind, payload: bytes, packed: bytes, sign: Sign) -> SealedRecord:
        id = RecordId(self._robot, self._id, self._next_seq)
        head = pack_header(kind, self._key_id)
        bound = associated_data(id, head)
        signed = sign(PURPOSES[kind], bound + payload) + packed
        size = padded_size(HEADER_SIZE + len(signed) + TAG_SIZE) - HEADER_SIZE - TAG_SIZE
        self._next_seq += 1  # first: should what follows fail, its nonce is not used again
        return SealedRecord(id, head + self._gcm.encrypt(nonce(id.seq), signed.ljust(size, b"\0"), bound))


def _distinct(readers: Iterable[sm2.PublicKey]) -> dict[bytes, sm2.PublicKey]:
    distinct = {reader.to_bytes(): reader for reader in readers}
    if not distinct:
        raise NoReaders("no reader is configured, nobody could open what is written; name a reader's certificate")
    if len(distinct) > MAX_READERS:
        raise NoReaders(f"{len(distinct)} readers are configured; a stream takes at most {MAX_READERS}")
    return distinct
