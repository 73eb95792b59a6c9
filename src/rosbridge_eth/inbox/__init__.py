"""The server's replica of the robots' logs: what was taken from robots, in the order of their logs on the chain.

Here is what both back ends have in common; tests/bridge/inbox/test_conformance.py says what it means. A robot is
named by its Tk. A *row* is a chunk at a position; positions order a robot's rows and mean nothing else. Rows up to
the robot's confirmed one are on the chain and kept for some time, so that the chain may still turn back; the others
wait. `now` is the wall clock in seconds, shared by the processes that use one inbox. Workers append; one submitter
does the rest.
"""

from __future__ import annotations

import json
from collections.abc import Collection, Mapping, Sequence
from enum import Enum
from pathlib import Path
from typing import Any, Final, NamedTuple, Protocol

from rosbridge_eth.errors import StoreError
from rosbridge_eth.log.chunk import Chunk

DEAD_LETTERS: Final = 1000
"""Dead letters that are kept; the oldest go."""
_AT_ONCE: Final = 200
"""Rows that one transaction removes; on a full disk there is little room for its log."""


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
    """What the submitter knows of a robot.

    confirmed: stream and number of the newest row that is confirmed on the chain, and position: where it stands;
    block: which has it, 0 where that is not known.
    hold: why nothing is written for the robot. certificates_hash: keccak256 of the certificates that the contract
    has for it. mark: a position that was confirmed at `marked_at`, for `forget`.
    """

    confirmed: tuple[bytes, int] | None = None
    hold: str | None = None
    certificates_hash: bytes | None = None
    position: int | None = None
    mark: int | None = None
    marked_at: float = 0.0
    block: int = 0


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
    max_bytes: int
    max_bytes_per_robot: int

    # What each back end does in its own way

    def append(self, chunks: Sequence[tuple[bytes, Chunk]], now: float) -> list[Outcome]:
        """Take chunks, (Tk, chunk) each, all in one commit; one outcome for each, in order. Also InboxExchanged.

        A chunk is taken if its number is above the head of its stream, and neither the robot's share nor the whole
        would be exceeded by it. Without chunks it tells whether the store is there, and the one it was.
        """

    def head(self, tk: bytes, stream: bytes) -> Head | None:
        """The newest chunk of the stream that was ever taken; it outlives the row."""

    def raise_heads(self, tk: bytes, heads: Mapping[bytes, Head]) -> None:
        """These chunks are on the chain: from now on nothing of these streams up to them is taken."""

    def sizes(self) -> dict[bytes, int]:
        """Of every robot of which there ever was a row or a state, the bytes of its rows."""

    def find(self, tk: bytes, hash: bytes) -> int | None:
        """The position of the row with this keccak256."""

    def rows(self, tk: bytes, after: int | None, limit: int) -> list[Row]:
        """Up to `limit` rows behind a position (None: from the first), in order."""

    def chunks(self, tk: bytes, positions: Collection[int]) -> list[bytes]:
        """The encoded chunks at these positions. StoreError if one is not there any more."""

    def remove(self, tk: bytes, positions: Collection[int], why: str | None = None) -> None:
        """Remove rows; with a reason they become dead letters."""

    def dead(self, limit: int = 100) -> list[DeadLetter]:
        """Dead letters, the newest first."""

    def waiting(self, tk: bytes, after: int | None) -> Waiting:
        """The rows of a robot behind a position."""

    def check(self) -> None:
        """StoreError, with what to do, unless what is committed is kept and every right that is needed is there."""

    def close(self) -> None:
        """Let go of it."""

    def _put_in_front(self, tk: bytes, front: Sequence[Chunk], on_chain: set[bytes], now: float) -> None:
        """Remove the rows whose digest is in `on_chain`, then make `front` the first rows."""

    def _load(self, tks: Sequence[bytes]) -> Sequence[str | bytes | None]:
        """The texts last given to `_save`, which need not outlive a power cut."""

    def _save(self, tk: bytes, text: str) -> None:
        """Keep a text about a robot."""

    # What they have in common

    def states(self, tks: Sequence[bytes]) -> dict[bytes, RobotState]:
        """What was set last of each, or nothing at all."""
        return {tk: _state(text) for tk, text in zip(tks, self._load(tks), strict=True)}

    def state(self, tk: bytes) -> RobotState:
        """What was set last, or nothing at all."""
        return self.states([tk])[tk]

    def set_state(self, tk: bytes, **changes: Any) -> None:
        """Change fields of the state, such as `hold`. A power cut may take it back."""
        known = self.state(tk)
        state = known._replace(**changes)
        if state != known:
            self._save(tk, json.dumps(state, default=bytes.hex))

    def confirm(self, tk: bytes, position: int | None, now: float, block: int = 0) -> None:
        """The row there, in this block, and all before it are confirmed on the chain, and none behind it. It may move
        back.

        To be called at every look at the chain, also where nothing changed.
        """
        known = self.state(tk)
        if position is None:
            self.set_state(tk, confirmed=None, position=None, mark=None)
        elif position != known.position or known.mark is None:
            header = Chunk.parse(self.chunks(tk, [position])[0]).header
            kept = known.mark is not None and known.mark <= position
            self.set_state(
                tk, confirmed=(header.stream, header.number), position=position, block=block,
                mark=known.mark if kept else position, marked_at=known.marked_at if kept else now,
            )  # fmt: skip

    def rebase(self, tk: bytes, front: Sequence[Chunk], on_chain: Collection[bytes], now: float) -> None:
        """Make the rows follow a chain whose last chunk is not among them.

        front: what is on the chain and not confirmed, and ends with the chain's last chunk; it becomes the first rows,
        because a robot is not asked again for what is below a head, should the chain turn back. Rows whose digest is
        in `on_chain` go, the others stay behind it in their order, perhaps at other positions; nothing is confirmed
        until `confirm` says so. A caller who reads rows to see which of them are on the chain calls `raise_heads`
        before: then none that is can be added meanwhile.
        """
        self.raise_heads(tk, {one.header.stream: Head(one.header.number, one.header.digest) for one in front})
        self.confirm(tk, None, now)
        self._put_in_front(tk, front, {*on_chain, *(one.header.digest for one in front)}, now)

    def forget(self, before: float) -> None:
        """Remove rows that were confirmed before that time, some of them only at twice their age; and make room.

        While a robot's rows take more than half of its share, or of its part of a store that is more than half
        full, its oldest confirmed ones go at once. A robot's newest confirmed row stays. To be called every minute
        or so.
        """
        sizes = self.sizes()
        kept = self.max_bytes_per_robot // 2
        if sum(sizes.values()) > self.max_bytes // 2:
            kept = min(kept, self.max_bytes // len(sizes) // 2)
        for tk, size in sizes.items():
            state = self.state(tk)
            aged = state.mark if state.mark is not None and state.marked_at < before else None
            going = state.position is not None and (aged is not None or size > kept)
            while going and (rows := self.rows(tk, None, _AT_ONCE)):
                gone: list[int] = []
                for row in rows:
                    old = aged is not None and row.position <= aged
                    going = row.position != state.position and (old or size > kept)
                    if not going:
                        break
                    gone.append(row.position)
                    size -= row.size
                self.remove(tk, gone)
            if aged is not None:
                self.set_state(tk, mark=None)

    def bury(self, tk: bytes, after: int | None, why: str) -> int:
        """Rows behind a position (None: all) become dead letters; how many."""
        position = self.state(tk).position
        if position is not None and (after is None or position > after):
            self.confirm(tk, None, 0.0)
        count = 0
        while rows := self.rows(tk, after, _AT_ONCE):
            self.remove(tk, [row.position for row in rows], why)
            count += len(rows)
        return count

    def totals(self) -> dict[bytes, Waiting]:
        """What waits, of every robot."""
        return {tk: self.waiting(tk, state.position) for tk, state in self.states([*self.sizes()]).items()}


def _state(text: str | bytes | None) -> RobotState:
    if text is None:
        return RobotState()
    confirmed, hold, certificates_hash, *rest = json.loads(text)
    return RobotState(
        confirmed and (bytes.fromhex(confirmed[0]), confirmed[1]), hold,
        certificates_hash and bytes.fromhex(certificates_hash), *rest,
    )  # fmt: skip


def open_inbox(
    url: str, *, file: Path, ledger: bytes, max_bytes: int, max_bytes_per_robot: int, read_only: bool = False
) -> Inbox:
    """The inbox at `url`, for one ledger (chunk.ledger_id): "sqlite", in `file`, or a Redis.

    The bounds are on the rows as they travel. Where all robots' shares fit into max_bytes, none can take another's.
    read_only: nothing is made or changed; database.NothingThere where there is no inbox yet. StoreError.
    """
    if url == "sqlite":
        from rosbridge_eth.inbox.sqlite import SqliteInbox

        return SqliteInbox(file, ledger, max_bytes, max_bytes_per_robot, read_only=read_only)
    from rosbridge_eth.inbox.redis import RedisInbox

    return RedisInbox(url, ledger, max_bytes, max_bytes_per_robot, read_only=read_only)
