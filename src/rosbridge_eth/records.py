"""What travels from a robot to the chain: the identity of a record and its sealed bytes.

The vocabulary that the robot's end, the server's end and the reader share.
Nothing here is secret and nothing here can open a record (see sealing).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import NamedTuple

from eth_utils.crypto import keccak

ROBOT_ID_SIZE = 32
STREAM_ID_SIZE = 16
MAX_SEQ = 2**64 - 1


def robot_id(name: str) -> bytes:
    """Tk of the contract: keccak256 of the robot's name in UTF-8, 32 bytes. An identity, not a secret."""
    return keccak(name.encode("utf-8"))


@dataclass(frozen=True, slots=True, order=True)
class RecordId:
    """Which record: the robot (Tk, 32 bytes), its stream (16 bytes), its place in it (from 0)."""

    robot: bytes
    stream: bytes
    seq: int

    def __post_init__(self) -> None:
        if len(self.robot) != ROBOT_ID_SIZE:
            raise ValueError(f"robot id must be {ROBOT_ID_SIZE} bytes, not {len(self.robot)}")
        if len(self.stream) != STREAM_ID_SIZE:
            raise ValueError(f"stream id must be {STREAM_ID_SIZE} bytes, not {len(self.stream)}")
        if not 0 <= self.seq <= MAX_SEQ:
            raise ValueError(f"seq must be in [0, 2**64), not {self.seq}")

    def __str__(self) -> str:
        return f"{self.robot.hex()[:8]}/{self.stream.hex()[:8]}/{self.seq}"


@dataclass(frozen=True, slots=True)
class SealedRecord:
    """One record as it is spooled, sent, cached and written: `ciphertext` is the contract's Cp.

    The identity is not repeated inside `ciphertext`; it is authenticated with it.
    """

    id: RecordId
    ciphertext: bytes


class SeqRange(NamedTuple):
    """Records `first` to `last` of a stream, both included: what a gap record declares as dropped."""

    stream: bytes
    first: int
    last: int
