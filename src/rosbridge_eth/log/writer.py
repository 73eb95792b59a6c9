"""The robot's pen: captured lines in, chunks out.

A chunk is closed `period` seconds after its first line, at 1,000 records or at 256 KiB of JSON, whichever
comes first; one that does not fit is cut in two. After `heartbeat` seconds without a chunk one without
records is sealed, so that silence can be told from withholding.

Every stream begins with its `{"stream": ...}` line, and the definition of a type stands before the first
message of that type in it, and again where it changes. The header of each chunk names the digest of the one
before, across streams too.

Not here: what a line says (capture), where chunks are kept (spool). No clock: `now` is seconds of a clock
that does not jump, `wall_ms` milliseconds since 1970.
"""

from __future__ import annotations

import secrets
from collections import Counter, deque
from collections.abc import Sequence

from rosbridge_eth.log import chunk
from rosbridge_eth.log.chunk import MAX_LINE, MAX_RECORDS, MAX_TIME_MS, Chunk, Log, Randomness, TooLarge
from smcrypto import sm2

#: Bytes of lines at which a chunk is closed.
MAX_JSON = 256 * 1024


class LogWriter:
    """Lines in, chunks out. One per robot process; begins a new stream at construction.

    readers: 1 to 16 SM2 encryption keys. previous: the digest of the newest header this robot is known to have
    sealed, zeros if none is. newest: the newest stream that is known of it, zeros if none is. stream_line: the
    first line of every stream; it counts as a record, so that a start shows in the log after `period` even if
    nothing is captured. A line and a definition have at most MAX_LINE bytes; `add` raises TooLarge for a longer one.
    period and heartbeat: seconds, above 0.
    """

    def __init__(
        self, log: Log, key: sm2.PrivateKey, readers: Sequence[sm2.PublicKey], *,
        previous: bytes, newest: bytes = bytes(chunk.STREAM_SIZE), stream_line: bytes, period: float = 1.0,
        heartbeat: float = 3600.0, compress: bool = True, now: float, randomness: Randomness = secrets.token_bytes,
    ) -> None:
        self._log, self._key, self._readers = log, key, tuple(readers)
        self._previous, self._stream_line = previous, _check(stream_line)
        self._period, self._heartbeat, self._compress = period, heartbeat, compress
        self._randomness, self._secret = randomness, chunk.content_secret(key)
        self._now = self._last_chunk = now
        self._waiting: deque[tuple[float, bytes, tuple[str, bytes] | None, str]] = deque()  # as `add` was given them
        self._bytes = 0
        self.sealed = Counter[str]()
        """Lines that are in chunks, by the topic that `add` was told."""
        self.stream = b""
        """The newest stream of which a chunk was sealed; empty before the first."""
        self.newest = newest
        """The newest stream that is known of this robot; the next one is named above it."""
        self.new_stream()

    def new_stream(self) -> None:
        """Begin another stream, after the server refused the present one or it ended; lines in no chunk go into it.

        It has its name with its first chunk: the time then, and above the name of every stream known.
        """
        self._number = 0
        self._defined: dict[str, bytes] = {}  # what the stream said last of a type
        self._begun = self._now

    def change_readers(self, readers: Sequence[sm2.PublicKey]) -> None:
        """Seal the next chunk, and all after it, for these; definitions are said again, for who reads from there on."""
        if self._readers != tuple(readers):
            self._readers = tuple(readers)
            self._defined.clear()

    def add(self, line: bytes, now: float, definition: tuple[str, bytes] | None = None, *, topic: str = "") -> None:
        """Take one line in. Call `closed` afterwards, or when `next_timer` says.

        definition: a type, and the line that defines it, which goes before this one unless the stream has said it
        already, and nothing else of that type since.
        """
        _check(line)
        if definition is not None:
            _check(definition[1])
        self._now = now
        self._waiting.append((now, line, definition, topic))
        self._bytes += len(line)

    def wrote(self, sealed: Chunk) -> bool:
        """Whether the signature is of this log's key, and the body the chunk's own."""
        try:
            chunk.verify(self._log, self._key.public_key, sealed)
        except chunk.ChunkError:
            return False
        return True

    def next_timer(self) -> float:
        """When `closed` has something to give; in the past if it has now."""
        if self._number and not self._waiting:
            return self._last_chunk + self._heartbeat
        first = self._waiting[0][0] if self._number else self._begun
        return first if len(self._waiting) >= MAX_RECORDS or self._bytes >= MAX_JSON else first + self._period

    def closed(self, now: float, wall_ms: int) -> list[Chunk]:
        """The chunks that are due, oldest first. They have to be kept in this order."""
        self._now = now
        chunks: list[Chunk] = []
        while now >= self.next_timer():
            chunks += self._seal_next(wall_ms)
        return chunks

    def finish(self, wall_ms: int) -> list[Chunk]:
        """The rest; the last chunk says goodbye. What may come after it takes a new stream."""
        chunks: list[Chunk] = []
        while not chunks or not chunks[-1].header.goodbye:
            chunks += self._seal_next(wall_ms, last=True)
        return chunks

    def _seal_next(self, wall_ms: int, *, last: bool = False) -> list[Chunk]:
        """The next lines as a chunk, each behind what has to be said before it."""
        if not self._number:
            self.stream = self.newest = chunk.stream_name(wall_ms, self.newest, self._randomness)
        lines = [] if self._number else [self._stream_line]
        size = sum(map(len, lines))
        while self._waiting and size < MAX_JSON:
            _, line, definition, topic = self._waiting[0]
            said = definition is None or self._defined.get(definition[0]) == definition[1]
            new = [line] if said or definition is None else [definition[1], line]
            if len(lines) + len(new) > MAX_RECORDS:
                break
            self._defined |= [definition] if definition is not None else []
            lines += new
            size += sum(map(len, new))
            self._bytes -= len(line)
            self.sealed[topic] += 1
            self._waiting.popleft()
        return self._seal(lines, wall_ms, goodbye=last and not self._waiting)

    def _seal(self, lines: list[bytes], wall_ms: int, *, goodbye: bool) -> list[Chunk]:
        """The lines as one chunk, or as several where they do not fit one."""
        try:
            sealed = chunk.seal(
                self._log, self._key, lines, stream=self.stream, number=self._number, previous=self._previous,
                sealed_ms=min(max(wall_ms, 0), MAX_TIME_MS - 1), readers=self._readers, goodbye=goodbye,
                compress=self._compress, secret=self._secret, randomness=self._randomness,
            )  # fmt: skip
        except TooLarge:
            middle = len(lines) // 2
            first = self._seal(lines[:middle], wall_ms, goodbye=False)
            return first + self._seal(lines[middle:], wall_ms, goodbye=goodbye)
        self._number, self._previous, self._last_chunk = self._number + 1, sealed.header.digest, self._now
        return [sealed]


def _check(line: bytes) -> bytes:
    if len(line) > MAX_LINE:
        raise TooLarge(f"a line of {len(line)} bytes does not fit a chunk; the most is {MAX_LINE}")
    return line
