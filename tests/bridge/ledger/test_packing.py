"""Packed records: what goes in comes out, and the contract reads the same."""

from __future__ import annotations

from functools import cache

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from bridge.ledger.world import ROBOT, Ledger, Records, new_ledger
from rosbridge_eth.errors import VerificationError
from rosbridge_eth.ledger import merkle, packing
from rosbridge_eth.ledger.failures import Reverted
from rosbridge_eth.records import RecordId, SealedRecord, robot_id

STREAMS = st.sampled_from([bytes(16), b"\xff" * 16, bytes(range(16))])
SEQS = st.one_of(st.integers(0, 5), st.integers(2**64 - 3, 2**64 - 1), st.integers(0, 2**64 - 1))
RECORDS = st.lists(
    st.builds(
        lambda stream, seq, ciphertext: SealedRecord(RecordId(ROBOT, stream, seq), ciphertext),
        STREAMS,
        SEQS,
        st.binary(min_size=1, max_size=40),
    ),
    min_size=1,
    max_size=12,
)


@given(RECORDS)
def test_unpacking_gives_what_was_packed_in_its_order(records):
    packed = packing.pack(records)
    assert packing.unpack(ROBOT, packed) == records
    assert packing.packed_size(records) == len(packed)


def test_the_layout_is_the_documented_one():
    stream = bytes(range(16))
    records = [
        SealedRecord(RecordId(ROBOT, stream, seq), text) for seq, text in ((7, b"ab"), (8, b"c"), (10, b"d"))
    ]
    expected = stream + (7).to_bytes(8, "big") + b"\0\2" + b"\0\2ab" + b"\0\1c"
    expected += stream + (10).to_bytes(8, "big") + b"\0\1" + b"\0\1d"
    assert packing.pack(records) == expected


def test_a_run_counts_up_to_65535(records: Records):
    many = records.run(65_536 + 3, size=1)
    packed = packing.pack(many)
    assert len(packed) == 2 * packing.RUN_HEADER_SIZE + 3 * len(many)
    assert packing.unpack(ROBOT, packed) == many


def test_what_cannot_be_packed_is_refused(records: Records):
    (mine,) = records.run(1)
    (other,) = records.run(1, robot=robot_id("another"))
    for bad in ([], [mine, other], [SealedRecord(mine.id, b"")], [SealedRecord(mine.id, bytes(2**16))]):
        with pytest.raises(ValueError):
            packing.pack(bad)


@cache
def shared_ledger() -> Ledger:
    """One EVM for all examples: nothing is written to it."""
    return new_ledger()


@pytest.fixture(autouse=True, scope="module")
def _evm_is_there():
    shared_ledger()  # importing py-evm changes the recursion limit, which hypothesis would notice


@settings(max_examples=60)
@given(data=st.data(), records=RECORDS)
def test_python_and_the_contract_take_and_refuse_the_same_bytes(data, records):
    made = shared_ledger()
    packed = bytearray(packing.pack(records))
    for _ in range(data.draw(st.integers(0, 2))):
        match data.draw(st.sampled_from(["set", "cut", "add"])):
            case "set" if packed:
                packed[data.draw(st.integers(0, len(packed) - 1))] = data.draw(st.integers(0, 255))
            case "cut":
                del packed[data.draw(st.integers(0, len(packed))) :]
            case "add":
                packed += data.draw(st.binary(max_size=30))
    try:
        root = made.contract.merkle_root(ROBOT, bytes(packed))
    except Reverted:
        with pytest.raises(VerificationError):
            packing.unpack(ROBOT, bytes(packed))
    else:
        unpacked = packing.unpack(ROBOT, bytes(packed))
        assert merkle.root([merkle.leaf_hash(record) for record in unpacked]) == root
