"""The reader's side: an `open` record gives a stream's key to who was granted it, the key opens its records.

Nothing is returned unverified: tag first, then the bounded unpacking, then the
robot's signature over what came out.
"""

from __future__ import annotations

import hmac
from dataclasses import dataclass

from rosbridge_eth.records import RecordId, SealedRecord, SeqRange
from rosbridge_eth.sealing.errors import Altered, Forged, Malformed, NoGrant
from rosbridge_eth.sealing.layout import (
    HEADER_SIZE,
    KEY_SIZE,
    MAX_CIPHERTEXT,
    PURPOSES,
    SIGNATURE_SIZE,
    TAG_SIZE,
    Kind,
    Opening,
    Verify,
    associated_data,
    commitment,
    nonce,
    padded_size,
    parse_header,
    parse_ranges,
    reader_tag,
)
from rosbridge_eth.sealing.packing import unpack
from smcrypto import InvalidCiphertext, InvalidSignature, InvalidTag, sm2, sm4


@dataclass(frozen=True, slots=True)
class OpenedRecord:
    """A record that was opened and whose signature holds.

    dropped: of a gap record, what it declares. signature, bound: with the
    payload they prove to anybody who has the certificate what the robot said,
    without the stream's key: the signature is over bound | payload.
    """

    id: RecordId
    kind: Kind
    payload: bytes
    dropped: tuple[SeqRange, ...]
    bound: bytes
    signature: bytes


def read_opening(record: SealedRecord, verify: Verify) -> Opening:
    """The content of an `open` record: Malformed, or Forged if the robot did not sign it. Needs no key."""
    if parse_header(record).kind is not Kind.OPEN:
        raise Malformed(f"record {record.id} is not the open record of its stream")
    head, body = record.ciphertext[:HEADER_SIZE], record.ciphertext[HEADER_SIZE:]
    if not SIGNATURE_SIZE < len(body) <= MAX_CIPHERTEXT:
        raise Malformed(f"open record {record.id} has {len(record.ciphertext)} bytes")
    content, signature = body[:-SIGNATURE_SIZE], body[-SIGNATURE_SIZE:]
    _check_signature(record.id, Kind.OPEN, associated_data(record.id, head) + content, signature, verify)
    opening = Opening.from_bytes(record.id.robot, record.id.stream, content)
    if head[2:] != opening.key_id:
        raise Malformed(f"open record {record.id} contradicts itself on its key")
    return opening


class Opener:
    """A reader's key. `grant` gives the stream that an opening grants to it."""

    def __init__(self, key: sm2.PrivateKey) -> None:
        self._key = key
        self._encoded = key.public_key.to_bytes()

    def __repr__(self) -> str:
        return "<Opener>"

    def grant(self, opening: Opening) -> OpenStream:
        """NoGrant if this reader was not given the stream; Altered if what it was given is not its key."""
        wrapped = opening.wrapped.get(reader_tag(opening.robot, opening.stream, self._encoded))
        if wrapped is None:
            raise NoGrant(f"stream {opening.stream.hex()[:8]} was not granted to this reader")
        try:
            key = self._key.decrypt(wrapped, encoding="c1c3c2")
        except InvalidCiphertext:
            raise Altered(f"the key of stream {opening.stream.hex()[:8]} does not decrypt") from None
        if len(key) != KEY_SIZE or not hmac.compare_digest(
            commitment(opening.robot, opening.stream, key), opening.commitment
        ):
            raise Altered(f"the key of stream {opening.stream.hex()[:8]} is not the one its open record commits to")
        return OpenStream(opening, key)


class OpenStream:
    """A stream whose key this reader holds."""

    def __init__(self, opening: Opening, key: bytes) -> None:
        self.opening = opening
        self._gcm = sm4.SM4GCM(key)

    def __repr__(self) -> str:
        return f"<OpenStream {self.opening.stream.hex()[:8]}>"

    def open(self, record: SealedRecord, verify: Verify) -> OpenedRecord:
        """Open a data, gap or end record of this stream: Malformed, Altered or Forged say what is wrong with it."""
        id, size = record.id, len(record.ciphertext)
        if (id.robot, id.stream) != (self.opening.robot, self.opening.stream):
            raise ValueError(f"record {id} is not of stream {self.opening.stream.hex()[:8]}")
        header = parse_header(record)
        if header.key_id != self.opening.key_id:
            raise Altered(f"record {id} names another key than its stream's")
        if not HEADER_SIZE + SIGNATURE_SIZE + TAG_SIZE < size <= MAX_CIPHERTEXT or padded_size(size) != size:
            raise Malformed(f"record {id} has {size} bytes, which no record has")
        head = record.ciphertext[:HEADER_SIZE]
        bound = associated_data(id, head)
        try:
            padded = self._gcm.decrypt(nonce(id.seq), record.ciphertext[HEADER_SIZE:], bound)
        except InvalidTag:
            raise Altered(f"record {id} is not what was sealed") from None
        signature, payload = padded[:SIGNATURE_SIZE], unpack(padded[SIGNATURE_SIZE:])
        _check_signature(id, header.kind, bound + payload, signature, verify)
        dropped = parse_ranges(payload) if header.kind is Kind.GAP else ()
        return OpenedRecord(id, header.kind, payload, dropped, bound, signature)


def _check_signature(id: RecordId, kind: Kind, body: bytes, signature: bytes, verify: Verify) -> None:
    try:
        verify(PURPOSES[kind], body, signature)
    except InvalidSignature:
        raise Forged(f"record {id} does not bear the robot's signature") from None
