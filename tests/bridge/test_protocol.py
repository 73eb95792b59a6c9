"""Requests and answers inside the channel: the documented layout, and refusal of everything else."""

from __future__ import annotations

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosbridge_eth import protocol
from rosbridge_eth.records import RecordId, SealedRecord, robot_id

ROBOT = robot_id("robot_1")
ID = RecordId(ROBOT, bytes(range(16)), 258)


def test_a_record_is_laid_out_as_documented() -> None:
    encoded = protocol.encode_request(protocol.RecordRequest(SealedRecord(ID, b"sealed")))
    assert encoded == b"\x01" + bytes(range(16)) + b"\0\0\0\0\0\0\x01\x02" + b"sealed"


@pytest.mark.parametrize("request_", [
    protocol.RecordRequest(SealedRecord(ID, b"x" * 300)),
    protocol.CheckRequest(ID),
    protocol.RegisterRequest(),
], ids=lambda r: type(r).__name__)
def test_a_request_arrives_as_it_was_sent(request_: protocol.Request) -> None:
    assert protocol.decode_request(protocol.encode_request(request_), ROBOT) == request_


@pytest.mark.parametrize("payload", [
    b"", b"\x00", b"\x04", b"\x03x", b"\x01", b"\x01" + bytes(23), b"\x01" + bytes(24), b"\x02" + bytes(23),
    b"\x02" + bytes(25),
], ids=lambda p: p[:2].hex() + f"-{len(p)}")
def test_what_is_no_request_is_refused(payload: bytes) -> None:
    with pytest.raises(protocol.ProtocolError):
        protocol.decode_request(payload, ROBOT)


@given(st.binary(max_size=80))
def test_any_bytes_are_a_request_or_refused(payload: bytes) -> None:
    try:
        request = protocol.decode_request(payload, ROBOT)
    except protocol.ProtocolError:
        return
    assert protocol.encode_request(request) == payload


@pytest.mark.parametrize("answer", [
    protocol.RecordStatus("confirmed", "0x12", 7), protocol.RecordStatus("stored"),
])
def test_a_status_arrives_as_it_was_sent(answer: protocol.RecordStatus) -> None:
    assert protocol.decode_status(protocol.encode_answer(answer)) == answer


def test_a_registration_arrives_as_it_was_sent() -> None:
    answer = protocol.Registration(True, "0xabc", "0xdef", 31337, 1_760_000_000)
    assert protocol.decode_registration(protocol.encode_answer(answer)) == answer


@pytest.mark.parametrize("payload", [b"", b"[]", b"{}", b'{"state": 3, "transaction": null, "block": null}', b"\xff"])
def test_what_is_no_answer_is_refused(payload: bytes) -> None:
    for decode in (protocol.decode_status, protocol.decode_registration):
        with pytest.raises(protocol.ProtocolError):
            decode(payload)


def test_acknowledgements_are_one_byte() -> None:
    assert [protocol.decode_ack(protocol.encode_ack(ack)) for ack in protocol.Ack] == list(protocol.Ack)
    for payload in (b"", b"\x09", b"\0\0"):
        with pytest.raises(protocol.ProtocolError):
            protocol.decode_ack(payload)
