"""The server's replica of the robots' logs: what was taken from robots, in the order of their logs on the chain.

This is the protocol that both back ends keep, and its vocabulary; tests/bridge/inbox/test_conformance.py says what
it means. A robot is named by its Tk. A *row* is a chunk at a position; positions order a robot's rows and mean
nothing else. Rows up to the robot's confirmed one are on the chain and kept for some time, so that the chain may
still turn back; the others wait. `now` is the wall clock in seconds, shared by the processes that use one inbox.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from enum import Enum
from pathlib import Path
from typing import Any, Final, NamedTuple, Protocol

from rosbridge_eth.chunk import Chunk
from rosbridge_eth.errors import StoreError

MAX_STREAMS: Final = 4096
"""Streams a robot whose heads are kept; beyond that the one that was written to least recently is forgotten."""
DEAD_SHARE: Final = 8
"""Dead letters take at most this part of max_bytes, on top of it; the oldest go."""


class InboxExchanged(StoreError):
    """The store is not the one it was: exchanged, emptied, or (Redis) started anew, perhaps with its newest rows lost.

    Raised once, and nothing was changed. What robots were told before is void: the caller ends all sessions, so
    that they ask what is there, and goes on with the same object.
    """


class Outcome(Enum):
    """What became of a chunk. STORED and KNOWN are durable."""

    STORED = "stored"
    KNOWN = "known"  # it, or its dropped or whole form, is here, or was
    DIFFERENT = "different"  # another chunk of this stream has the number
    FULL = "full"  # not stored, nor any later one of this robot in the same call: send again later


class Head(NamedTuple):
    """The newest chunk of a stream that was ever taken."""

    number: int
    digest: bytes


class Row(NamedTuple):
    """digest: of the header. hash: keccak256 of the encoded chunk. size: of that, bytes. taken_at: seconds."""

    position: int
    digest: bytes
    hash: bytes
    size: int
    taken_at: float
    records: int


class RobotState(NamedTuple):
    """confirmed: stream and number of the newest row that is confirmed on the chain. hold: why nothing is written
    for this robot. certificates_hash: keccak256 of the certificates that the contract has for it."""

    confirmed: tuple[bytes, int] | None = None
    hold: str | None = None
    certificates_hash: bytes | None = None


class Waiting(NamedTuple):
    """The rows of a robot that are not confirmed; oldest: when the first of them was taken."""

    chunks: int
    records: int
    bytes: int
    oldest: float | None


class DeadLetter(NamedTuple):
    """A chunk that will not be written."""

    tk: bytes
    why: str
    taken_at: float
    chunk: bytes


class Inbox(Protocol):
    """Durable; for several processes, each with its own object. What changes something has committed it on return.

    Every method may raise StoreError; then nothing was changed, or (Redis) it is not known whether.
    """

    id: bytes
    """Random, made with the store: another id is another store."""

    def head(self, tk: bytes, stream: bytes) -> Head | None:
        """The newest chunk of the stream that was ever taken; it outlives the row."""
        ...

    def append(self, chunks: Sequence[tuple[bytes, Chunk]], now: float) -> list[Outcome]:
        """Take chunks, (Tk, chunk) each, all in one commit; one outcome for each, in order. Also InboxExchanged.

        A chunk is taken if its number is above the head of its stream, and neither the robot's share nor the whole
        would be exceeded by it.
        """
        ...

    def robots(self) -> list[bytes]:
        """All of whom there ever was a row or a state."""
        ...

    def find(self, tk: bytes, hash: bytes) -> int | None:
        """The position of the row with this keccak256."""
        ...

    def rows(self, tk: bytes, after: int | None, limit: int) -> list[Row]:
        """Up to `limit` rows behind a position (None: from the first), in order."""
        ...

    def chunks(self, tk: bytes, positions: Collection[int]) -> list[bytes]:
        """The encoded chunks at these positions. StoreError if one is not there any more."""
        ...

    def raise_heads(self, tk: bytes, heads: Mapping[bytes, Head], now: float) -> None:
        """These chunks are on the chain: from now on nothing of these streams up to them is taken."""
        ...

    def rebase(
        self, tk: bytes, tail: Chunk | None, on_chain: Collection[bytes], heads: Mapping[bytes, Head], now: float
    ) -> None:
        """Make the rows follow a chain whose last chunk, `tail`, is not among them (None: the chain has none).

        Rows whose digest is in `on_chain` go, `tail` becomes the first row, the others stay behind it in their
        order; heads are raised; nothing is confirmed until `confirm` says so. Positions change. Whoever reads rows
        to see which are on the chain calls `raise_heads` before: then none can be added meanwhile that is.
        """
        ...

    def confirm(self, tk: bytes, position: int | None, now: float) -> None:
        """The row there and all before it are confirmed on the chain, and none behind it. It may move back.

        StoreError if no row is there. A power cut may take this and `forget` back.
        """
        ...

    def forget(self, before: float) -> None:
        """Remove rows that were confirmed before that time, and make room: while a robot's rows take more than half
        of its share, or of its part of a store that is more than half full, its oldest confirmed ones go as well.

        A robot's newest confirmed row stays. To be called every minute or so.
        """
        ...

    def state(self, tk: bytes) -> RobotState: ...

    def set_state(self, tk: bytes, **changes: Any) -> None:
        """Change fields of the state, `hold` or `certificates_hash`. A power cut may take it back."""
        ...

    def bury(self, tk: bytes, after: int | None, why: str) -> int:
        """Rows behind a position (None: all) become dead letters; how many."""
        ...

    def dead(self, limit: int = 100) -> list[DeadLetter]:
        """Dead letters, the newest first."""
        ...

    def totals(self) -> dict[bytes, Waiting]:
        """What waits, of every robot."""
        ...

    def check(self) -> None:
        """StoreError, with what to do, unless what is committed is kept and every right that is needed is there."""
        ...

    def close(self) -> None: ...


def open_inbox(
    url: str, *, home: Path, ledger: bytes, max_bytes: int, max_bytes_per_robot: int, read_only: bool = False
) -> Inbox:
    """The inbox at `url`, for one ledger (chunk.ledger_id): "sqlite", in the folder `home`, or a Redis.

    The bounds are on the rows as they travel. Where all robots' shares fit into max_bytes, none can take another's.
    read_only: nothing is made or changed; database.NothingThere where there is no inbox yet. StoreError.
    """
    if url == "sqlite":
        from rosbridge_eth.inbox.sqlite import SqliteInbox

        return SqliteInbox(home / "inbox.sqlite", ledger, max_bytes, max_bytes_per_robot, read_only=read_only)
    from rosbridge_eth.inbox.redis import RedisInbox

    return RedisInbox(url, ledger, max_bytes, max_bytes_per_robot, read_only=read_only)


def kept_for(total: int, robots: int, max_bytes: int, share: int) -> int:
    """Above how many bytes the confirmed rows of each robot go before their time."""
    return (min(share, max_bytes // max(1, robots)) if total > max_bytes // 2 else share) // 2
