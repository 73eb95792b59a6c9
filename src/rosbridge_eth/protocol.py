"""What a robot and a server say to each other inside the channel: requests and their answers.

A channel message is one request; its reply is the answer. A record's answer
is its acknowledgement and follows the server's commit. Layout, big-endian:

    RECORD    01 | stream 16 | seq 8 | ciphertext     answer: one Ack byte
    CHECK     02 | stream 16 | seq 8                  answer: JSON RecordStatus
    REGISTER  03                                      answer: JSON Registration

The robot is never named: it is who the channel authenticated.
"""

from __future__ import annotations

import json
from dataclasses import asdict, dataclass
from enum import IntEnum
from typing import TypeAlias

from rosbridge_eth.records import STREAM_ID_SIZE, RecordId, SealedRecord

_RECORD, _CHECK, _REGISTER = 1, 2, 3
_ID_SIZE = STREAM_ID_SIZE + 8


class ProtocolError(Exception):
    """The peer sent a request or an answer that is not one; the session is of no use any more."""


class Ack(IntEnum):
    """How the server answers a record. Only STORED lets the robot forget it."""

    STORED = 0  # on disk, now or before
    CONFLICT = 1  # this identity is taken by other bytes; kept as a dead letter
    BUSY = 2  # the inbox is full; send again later
    REFUSED = 3  # not a record this server takes (too long, or the robot was revoked)


@dataclass(frozen=True, slots=True)
class RecordRequest:
    record: SealedRecord


@dataclass(frozen=True, slots=True)
class CheckRequest:
    id: RecordId


@dataclass(frozen=True, slots=True)
class RegisterRequest:
    """The robot asks what the server and the chain know of it."""


Request: TypeAlias = RecordRequest | CheckRequest | RegisterRequest


@dataclass(frozen=True, slots=True)
class RecordStatus:
    """Where a record is: 'unknown', 'stored', 'batched', 'submitted', 'included', 'confirmed', 'dead'.

    'unavailable': the server cannot look at this moment; ask again.
    """

    state: str
    transaction: str | None = None
    block: int | None = None


@dataclass(frozen=True, slots=True)
class Registration:
    """What the chain end knows of the asking robot; `server_time` is UTC seconds, to correct a bad clock."""

    registered: bool
    account: str | None
    contract: str
    chain_id: int
    server_time: int


def _pack_id(id: RecordId) -> bytes:
    return id.stream + id.seq.to_bytes(8, "big")


def encode_request(request: Request) -> bytes:
    match request:
        case RecordRequest(record):
            return bytes([_RECORD]) + _pack_id(record.id) + record.ciphertext
        case CheckRequest(id):
            return bytes([_CHECK]) + _pack_id(id)
        case RegisterRequest():
            return bytes([_REGISTER])


def decode_request(payload: bytes, robot: bytes) -> Request:
    """Parse a request of the robot (Tk) whose session it arrived in; ProtocolError if it is none."""
    kind, body = payload[:1], payload[1:]
    if kind == bytes([_REGISTER]) and not body:
        return RegisterRequest()
    if kind not in (bytes([_RECORD]), bytes([_CHECK])) or len(body) < _ID_SIZE:
        raise ProtocolError(f"not a request: {len(payload)} bytes")
    id = RecordId(robot, body[:STREAM_ID_SIZE], int.from_bytes(body[STREAM_ID_SIZE:_ID_SIZE], "big"))
    rest = body[_ID_SIZE:]
    if kind == bytes([_RECORD]):
        if not rest:
            raise ProtocolError("a record without ciphertext")
        return RecordRequest(SealedRecord(id, rest))
    if rest:
        raise ProtocolError("a check request with trailing bytes")
    return CheckRequest(id)


def encode_ack(ack: Ack) -> bytes:
    return bytes([ack])


def decode_ack(payload: bytes) -> Ack:
    if len(payload) != 1 or payload[0] not in {ack.value for ack in Ack}:
        raise ProtocolError("not an acknowledgement")
    return Ack(payload[0])


def encode_answer(answer: RecordStatus | Registration) -> bytes:
    return json.dumps(asdict(answer), separators=(",", ":")).encode()


def _fields(payload: bytes) -> dict[str, object]:
    try:
        fields = json.loads(payload)
    except ValueError as error:
        raise ProtocolError("an answer that is not JSON") from error
    if not isinstance(fields, dict):
        raise ProtocolError("an answer that is not a JSON object")
    return fields


def decode_status(payload: bytes) -> RecordStatus:
    match _fields(payload):
        case {"state": str(state), "transaction": str() | None as transaction, "block": int() | None as block}:
            return RecordStatus(state, transaction, block)
    raise ProtocolError("not the status of a record")


def decode_registration(payload: bytes) -> Registration:
    match _fields(payload):
        case {"registered": bool(registered), "account": str() | None as account, "contract": str(contract),
              "chain_id": int(chain_id), "server_time": int(server_time)}:
            return Registration(registered, account, contract, chain_id, server_time)
    raise ProtocolError("not a registration")
