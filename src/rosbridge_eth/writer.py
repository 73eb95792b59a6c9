"""The robot's pen: captured lines in, chunks out.

A chunk is closed `period` seconds after its first line, at 1,000 records or at 256 KiB of JSON, whichever
comes first; one that does not fit is cut in two. After `heartbeat` seconds without a chunk one without
records is sealed, so that silence can be told from withholding.

Every stream begins with its `{"stream": ...}` line, and the definition of a type stands before the first
message of that type in it. The header of each chunk names the digest of the one before, across streams too.

Not here: what a line says (capture), where chunks are kept (spool). No clock: `now` is seconds of a clock
that does not jump, `wall_ms` milliseconds since 1970.
"""

from __future__ import annotations

import secrets
from collections.abc import Callable, Sequence
from typing import NamedTuple

from rosbridge_eth.chunk import (
    MAX_LINE,
    MAX_RECORDS,
    MAX_TIME_MS,
    STREAM_SIZE,
    Chunk,
    Log,
    Randomness,
    TooLarge,
    seal,
)
from smcrypto import sm2

MAX_JSON = 256 * 1024
"""Bytes of lines at which a chunk is closed."""


class _Waiting(NamedTuple):
    """A line that is in no chunk yet; `type_name` is the type whose definition must stand before it."""

    line: bytes
    type_name: str | None = None
    of_stream: bool = False
    """The line belongs to its stream (its first line, a definition) and is written anew in another one."""


class LogWriter:
    """Lines in, chunks out. One per robot process; begins a new stream at construction.

    readers: 1 to 16 SM2 encryption keys. previous: the digest of the newest header this robot is known to have
    sealed, zeros if none is. stream_line: the first line of every stream; it counts as a record, so that a
    start shows in the log after `period` even if nothing is captured. A line and a definition have at most
    MAX_LINE bytes; `add` raises TooLarge for a longer one.
    """

    def __init__(
        self,
        log: Log,
        key: sm2.PrivateKey,
        readers: Sequence[sm2.PublicKey],
        *,
        previous: bytes,
        stream_line: bytes,
        period: float = 1.0,
        heartbeat: float = 3600.0,
        compress: bool = True,
        now: float,
        randomness: Randomness = secrets.token_bytes,
    ) -> None:
        self._log, self._key, self._readers = log, key, tuple(readers)
        self._previous, self._stream_line = previous, stream_line
        self._period, self._heartbeat, self._compress = period, heartbeat, compress
        self._randomness = randomness
        self._now = self._last_chunk = now
        self._definitions: dict[str, bytes] = {}
        self._waiting: list[_Waiting] = []
        self._begin()

    def __repr__(self) -> str:
        return f"<LogWriter of stream {self.stream.hex()[:8]}, {self._number} chunks, {len(self._waiting)} lines>"

    def _begin(self) -> None:
        self.stream = self._randomness(STREAM_SIZE)
        self._number = 0
        self._defined: set[str] = set()
        self._waiting, self._bytes = [], 0
        self._first = self._now
        self._put(_Waiting(self._stream_line, of_stream=True))

    def _put(self, waiting: _Waiting) -> None:
        if not self._waiting:
            self._first = self._now
        self._waiting.append(waiting)
        self._bytes += len(waiting.line) + 1

    def _put_message(self, line: bytes, type_name: str | None) -> None:
        if type_name is not None and type_name not in self._defined:
            self._put(_Waiting(self._definitions[type_name], of_stream=True))
            self._defined.add(type_name)
        self._put(_Waiting(line, type_name))

    def add(
        self,
        line: bytes,
        now: float,
        *,
        type_name: str | None = None,
        definition_line: Callable[[], bytes] | None = None,
    ) -> None:
        """Take one line in. Call `closed` afterwards, or when `next_timer` says.

        type_name: whatever names the definition of the line's type; at its first line in a stream, what
        `definition_line` returned (called once in all) goes before it.
        """
        definition = b""
        if type_name is not None and type_name not in self._definitions:
            if definition_line is None:
                raise ValueError(f"the first line of type {type_name} comes without the type's definition")
            definition = definition_line()
        for text in (line, definition):
            if len(text) > MAX_LINE:
                raise TooLarge(f"a line of {len(text)} bytes does not fit; the most is {MAX_LINE}")
        if type_name is not None and definition:
            self._definitions[type_name] = definition
        self._now = now
        self._put_message(line, type_name)

    def next_timer(self) -> float:
        """When `closed` has something to give; in the past if it has now."""
        if not self._waiting:
            return self._last_chunk + self._heartbeat
        full = len(self._waiting) >= MAX_RECORDS or self._bytes >= MAX_JSON
        return self._first if full else self._first + self._period

    def closed(self, now: float, wall_ms: int) -> list[Chunk]:
        """The chunks that are due, oldest first. They have to be kept in this order."""
        self._now = now
        return self._seal_waiting(wall_ms, goodbye=False) if now >= self.next_timer() else []

    def finish(self, wall_ms: int) -> list[Chunk]:
        """The rest; the last chunk says goodbye, and the writer is of no use any more."""
        return self._seal_waiting(wall_ms, goodbye=True)

    def new_stream(self) -> None:
        """Begin another stream, after the server refused the present one; lines in no chunk yet go into it."""
        kept = [waiting for waiting in self._waiting if not waiting.of_stream]
        self._begin()
        for line, type_name, _ in kept:
            self._put_message(line, type_name)

    def _seal_waiting(self, wall_ms: int, *, goodbye: bool) -> list[Chunk]:
        """Everything that waits as chunks, one without records if nothing does."""
        groups: list[list[bytes]] = [[]]
        size = 0
        for waiting in self._waiting:
            if len(groups[-1]) == MAX_RECORDS or size >= MAX_JSON:
                groups.append([])
                size = 0
            groups[-1].append(waiting.line)
            size += len(waiting.line) + 1
        self._waiting, self._bytes = [], 0
        self._last_chunk = self._now
        chunks: list[Chunk] = []
        while groups:
            lines = groups.pop(0)
            try:
                chunk = self._seal(lines, wall_ms, goodbye=goodbye and not groups)
            except TooLarge:
                middle = len(lines) // 2
                groups[:0] = [lines[:middle], lines[middle:]]
                continue
            self._number += 1
            self._previous = chunk.header.digest
            chunks.append(chunk)
        return chunks

    def _seal(self, lines: list[bytes], wall_ms: int, *, goodbye: bool) -> Chunk:
        return seal(
            self._log, self._key, lines,
            stream=self.stream, number=self._number, previous=self._previous,
            sealed_ms=min(max(wall_ms, 0), MAX_TIME_MS - 1),
            readers=self._readers, goodbye=goodbye, compress=self._compress, randomness=self._randomness,
        )  # fmt: skip
