"""A replica of robots' logs: on a robot its own log, on a server those of all its robots. One interface, two back ends.

A chunk's *place* is stream | number, 24 bytes; places order as the log does, since a stream's name begins with the time
at which it was begun. A robot is named by its Tk. Its *head* is the place up to which its log was taken, and stays
where it is when rows are removed.

The rule: a chunk is taken if it follows the head: its `previous` is the digest there, or the robot says that it has
nothing else behind that digest. So whoever sends is told the head, and sends what follows it; a replica that was lost,
or put back from an old copy, says a lower head and is sent the rest.

Rows up to the confirmed place are on the chain, and kept for some time, since the chain may still turn back. Every
write is named by its place, so that one that is carried out twice changes nothing. `now` is seconds since 1970.
tests/bridge/log/test_store.py says what both back ends have in common.
"""

from __future__ import annotations

from collections.abc import Collection, Sequence
from enum import Enum
from typing import Any, Final, NamedTuple, Protocol

from rosbridge_eth.log.chunk import Chunk, Header

NOWHERE: Final = bytes(24)
"""The place in front of every log."""
NO_DIGEST: Final = bytes(32)
NO_HASH: Final = bytes(32)
"""As the contract has it for a robot without chunks."""
DEAD_LETTERS: Final = 1000
"""Dead letters that are kept; the oldest go."""


class Outcome(Enum):
    """What became of a chunk. STORED and KNOWN are durable."""

    STORED = "stored"
    KNOWN = "known"  # it, or its dropped or whole form, is here, or was, below the rows
    NOT_NEXT = "not next"  # it does not follow the head: the sender is to go on from there
    DIFFERENT = "different"  # the log went on otherwise here: another chunk has the place, or follows the one before
    FULL = "full"  # no room for it, nor for any later one of this robot in the same call: send again later


class Offer(NamedTuple):
    """A chunk of the robot `tk`.

    after: the digest behind which the robot has nothing else than this chunk, where that is not the chunk's `previous`:
    what stood between them it gave up, or never had.
    """

    tk: bytes
    chunk: Chunk
    after: bytes = b""


class State(NamedTuple):
    """What is kept of a robot beside its rows.

    head, digest: the place up to which the log was taken, and the digest of the header there.
    base: keccak256 of the chunk in front of the first row, NO_HASH if there is none; a row with that hash comes first.
    confirmed, block: the newest place that is confirmed on the chain, and the number of the block that has it.
    hold: why nothing is written for the robot, "" where nothing stands in the way.
    certificates: keccak256 of the certificates that the contract has for it, b"" where that is not known yet.
    """

    head: bytes = NOWHERE
    digest: bytes = NO_DIGEST
    base: bytes = NO_HASH
    confirmed: bytes = NOWHERE
    block: int = 0
    hold: str = ""
    certificates: bytes = b""


class Row(NamedTuple):
    """A chunk that is here. digest: of the header; hash: keccak256 of the encoded chunk, whose `size` is in bytes."""

    place: bytes
    digest: bytes
    hash: bytes
    size: int
    records: int
    taken_at: float


class Waiting(NamedTuple):
    """The rows of a robot that are not confirmed; oldest: when the first of them was taken."""

    chunks: int = 0
    records: int = 0
    bytes: int = 0
    oldest: float | None = None


class DeadLetter(NamedTuple):
    """A chunk that will not be written."""

    tk: bytes
    why: str
    taken_at: float
    chunk: bytes


def place_of(header: Header) -> bytes:
    return header.stream + header.number.to_bytes(8, "big")


def successor(place: bytes) -> bytes:
    """The place after it in the same stream."""
    return place[:16] + ((int.from_bytes(place[16:], "big") + 1) % 2**64).to_bytes(8, "big")


class Store(Protocol):
    """What `append`, and `remove` with a reason, changed survives the loss of power when they return.

    What `set_state` and other removals changed survives the end of the process; a power cut may take it back, and it is
    then found out again from the chain.

    An object belongs to one thread; several objects and processes may use one store. Every method may raise StoreError;
    then nothing was changed, or (Redis) it is not known whether.
    """

    max_bytes: int
    max_bytes_per_robot: int

    def append(self, offers: Sequence[Offer], now: float) -> list[Outcome]:
        """Take chunks by the rule, those of one robot in one commit; one outcome for each, in order.

        Checked in this order:

        1. another header at its place, as a row or the head: DIFFERENT
        2. not above the head: KNOWN; but DIFFERENT between rows, or between the rows and the head
        3. above the head, and its `previous` is not the digest there:
           a. the log went on otherwise here, which no honest robot's does: its place is the one after the head's in the
              same stream, or the chunk that it names is a row and not the newest below its place: DIFFERENT
           b. NOT_NEXT, unless the offer's `after` is the digest of the head
        4. a row already, as there are above a head that `follow` has lowered: KNOWN, and the head is there
        5. beyond the robot's share or the whole bound: FULL, and so is any later one of the robot
        6. else STORED, and the head is there
        """

    def states(self, tks: Sequence[bytes]) -> list[State]:
        """Of each, in order; State() of who is not known."""

    def set_state(self, tk: bytes, **changes: Any) -> None:
        """Change fields of a robot's state, such as `hold`."""

    def find(self, tk: bytes, hash: bytes) -> bytes | None:
        """The place of the row with this keccak256."""

    def has(self, tk: bytes, digest: bytes) -> bool:
        """Whether there is a row with this header."""

    def rows(self, tk: bytes, after: bytes, limit: int) -> list[Row]:
        """Up to `limit` rows behind a place, in order."""

    def chunks(self, tk: bytes, places: Sequence[bytes]) -> list[bytes]:
        """The encoded chunks at these places. StoreError if one is not there any more."""

    def remove(self, tk: bytes, places: Collection[bytes], why: str = "") -> None:
        """Remove rows; with a reason they become dead letters."""

    def sizes(self) -> dict[bytes, int]:
        """Of every robot that is known, the bytes of its rows."""

    def waiting(self, tk: bytes) -> Waiting:
        """The rows behind the confirmed place, summed."""

    def dead(self, limit: int = 100) -> list[DeadLetter]:
        """Dead letters, the newest first."""

    def check(self) -> None:
        """StoreError, with what to do, unless what is committed is kept and every right that is needed is there."""

    def close(self) -> None:
        """Let go of it."""

    # In common

    def follow(self, tk: bytes, hash: bytes, tail: Header | None) -> None:
        """Make the log whole up to the chain's last chunk (None: it has none), which is neither a row nor in front of
        the first one. hash: its keccak256. The robot is asked for what follows; rows behind it stay until it is there.
        This is the one place where a head goes back, but for a store that was lost or put back.
        """
        place, digest = (NOWHERE, NO_DIGEST) if tail is None else (place_of(tail), tail.digest)
        self.set_state(tk, head=place, digest=digest, base=hash)
        while rows := [row.place for row in self.rows(tk, NOWHERE, 200) if row.place <= place]:
            self.remove(tk, rows)

    def forget(self, tk: bytes, before: float, keep: int) -> None:
        """Remove confirmed rows that were taken before that time, or are beyond `keep` bytes, the oldest first; the
        newest confirmed one stays."""
        [state], size = self.states([tk]), self.sizes().get(tk, 0)
        going = True
        while going and (rows := self.rows(tk, NOWHERE, 200)):
            gone: list[Row] = []
            for row in rows:
                going = row.place < state.confirmed and (row.taken_at < before or size > keep)
                if not going:
                    break
                gone.append(row)
                size -= row.size
            if gone:
                self.set_state(tk, base=gone[-1].hash)
                self.remove(tk, [row.place for row in gone])
