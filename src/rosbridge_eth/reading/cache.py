"""What a reader has proven of one robot's log, kept beside its key: the next reading asks only for what is new.

One SQLite file of sealed rows. Their SM4 key comes of the reader's private key, the log and the CA: the file tells
nothing to who has not that key but sizes, and what was proven with another key or under another CA does not count.
Nothing depends on the file; one that does not open is begun anew.

    state    0               the block up to which all was read and its hash; where to go on; Progress
    segment  first chunk     of each part: topic, first and last receive time; then the Links
    part     first chunk, n  0: where the segment's chunks stand; 1 ...: records of one topic under one definition

Only what is final is kept (fetch.MARGIN), and a block's hash stands for the whole chain before it.
"""

from __future__ import annotations

import logging
import os
import secrets
import sqlite3
import sys
from collections import defaultdict
from collections.abc import Iterable, Iterator, Mapping
from itertools import islice
from operator import itemgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any, Final

import orjson
from pydantic import TypeAdapter

from rosbridge_eth.capture import MessageLine, TypeLine
from rosbridge_eth.chunk import Log
from rosbridge_eth.errors import StoreError
from rosbridge_eth.identity import Trust
from rosbridge_eth.reading.verdict import Links, Progress
from rosbridge_eth.reading.verify import Choice, Place, ProvenChunk, ProvenRecord
from smcrypto import InvalidTag, sm2, sm3, sm4

if TYPE_CHECKING or sys.version_info < (3, 14):
    from backports import zstd
else:
    from compression import zstd

MAX_CHUNKS: Final = 256
MAX_BYTES: Final = 4 << 20
"""A segment, which memory holds whole, is closed at so many chunks or bytes of lines."""
MAX_TOPICS: Final = 1_000
_STATE, _SEGMENT, _PART = range(3)
_PARTS: Final = 1 << 20  # what a segment may have: one for each line of its chunks
_NONCE: Final = 12
_PROGRESS: Final = TypeAdapter(Progress)

log = logging.getLogger(__name__)


class Cache:
    """An open file; no other process has it. sqlite3.Error, InvalidTag: it is in use, damaged or of another key.

    progress, links: of what is kept. block, hash: up to where the chain was read for it; next_block: where to go on.
    """

    def __init__(self, path: Path, key: bytes) -> None:
        self._path, self._gcm = path, sm4.SM4GCM(key)
        self.progress, self.links = Progress(), Links()
        self.block, self.hash, self.next_block = 0, b"", 0
        self._keeping, self._linked = True, 0
        self._begin_segment()
        os.close(os.open(path, os.O_RDWR | os.O_CREAT | os.O_CLOEXEC, 0o600))
        self._db = sqlite3.connect(path, timeout=0, isolation_level=None)
        try:
            self._db.execute("PRAGMA locking_mode = EXCLUSIVE")
            self._db.execute("CREATE TABLE IF NOT EXISTS row (kind INT, id INT, sealed BLOB, PRIMARY KEY (kind, id))")
            self._db.executescript("BEGIN EXCLUSIVE; COMMIT")
            self._load()
        except BaseException:
            self._db.close()
            raise

    def _load(self) -> None:
        kept = False
        for _, _, links in self._segments():
            self.links.digests.frombytes(links[: len(links) // 2])
            self.links.indices.frombytes(links[len(links) // 2 :])
            kept = True
        if kept:
            state, progress = self._get(_STATE, 0).split(b"\n", 1)
            self.block, hash_, self.next_block = orjson.loads(state)
            self.hash, self.progress = bytes.fromhex(hash_), _PROGRESS.validate_json(progress)
        self._linked = len(self.links.digests)

    def _segments(self) -> Iterator[tuple[int, list[tuple[str, int, int]], bytes]]:
        """The first chunk of each, topic and times of each of its parts, and its links."""
        for (first,) in self._db.execute("SELECT id FROM row WHERE kind = ? ORDER BY id", [_SEGMENT]).fetchall():
            parts, links = self._get(_SEGMENT, first).split(b"\n", 1)
            yield first, orjson.loads(parts), links

    def close(self) -> None:
        self._db.close()

    def _begin_segment(self) -> None:
        self._places: list[Place] = []
        self._parts: dict[tuple[str, TypeLine | None], list[ProvenRecord]] = defaultdict(list)
        self._bytes = 0

    # --- filling

    def add(self, chunk: ProvenChunk) -> None:
        """Take the chunk in; `commit` keeps it."""
        self._places.append(chunk.place)
        for record in chunk.records:
            self._parts[record.content.topic, record.definition].append(record)
            self._bytes += len(record.line)

    @property
    def full(self) -> bool:
        return len(self._places) >= MAX_CHUNKS or self._bytes >= MAX_BYTES

    def commit(self, progress: Progress, next_block: int, block: int, hash_: bytes) -> None:
        """Keep all that was added, which is all that `progress` says was read. A disk that is full ends the keeping."""
        first, at = self.progress.count, {place: n for n, place in enumerate(self._places)}
        try:
            if not self._keeping:
                return
            self._db.execute("BEGIN")
            for n, ((_, definition), records) in enumerate(self._parts.items(), 1):
                where = [(at[one.place], one.number, one.content.received_ns) for one in records]
                head = orjson.dumps([definition, where], default=_plain)
                self._put(_PART, first * _PARTS + n, zstd.compress(b"\n".join([head, *(one.line for one in records)])))
            if progress.count > first:
                self._put(_PART, first * _PARTS, orjson.dumps(self._places, default=_plain))
                parts = [(topic, *_span(records)) for (topic, _), records in self._parts.items()]
                links = b"".join(each[self._linked :].tobytes() for each in (self.links.digests, self.links.indices))
                self._put(_SEGMENT, first, orjson.dumps(parts) + b"\n" + links)
            state = orjson.dumps([block, hash_.hex(), next_block])
            self._put(_STATE, 0, state + b"\n" + _PROGRESS.dump_json(progress))
            self._db.execute("COMMIT")
        except sqlite3.Error as error:
            log.warning("%s: what is read is not kept: %s", self._path, error)
            self._keeping = False
        finally:
            self.progress, self._linked = progress, len(self.links.digests)
            self._begin_segment()

    # --- reading

    def records(self, choice: Choice, topics: set[str]) -> Iterator[ProvenRecord]:
        """What was kept before this reading, in the order of the log; with `at_ns` no more than is needed of it.

        topics: to this is added what there is, chosen or not.
        """
        for first, parts in self._wanted(choice, topics):
            places = [
                Place(chunk, bytes.fromhex(stream), number, bytes.fromhex(digest), block, time, bytes.fromhex(hash_))
                for chunk, stream, number, digest, block, time, hash_ in orjson.loads(self._get(_PART, first * _PARTS))
            ]
            rows = [row for n, topic in parts for row in self._rows(first * _PARTS + n, topic, choice)]
            for place, number, line, definition in sorted(rows, key=itemgetter(0, 1)):
                content = MessageLine._make(orjson.loads(line).values())
                yield ProvenRecord(places[place], number, line, content, definition)

    def _wanted(self, choice: Choice, topics: set[str]) -> Iterator[tuple[int, list[tuple[int, str]]]]:
        """Of each segment, the parts in which something may be wanted; with `at_ns` of each topic the last segment."""
        last: dict[str, tuple[int, list[tuple[int, str]]]] = {}
        for first, parts, _ in self._segments():
            add_topics(topics, (topic for topic, _, _ in parts))
            wanted = [(n, part[0]) for n, part in enumerate(parts, 1) if choice.wants(*part)]
            if choice.at_ns is None and wanted:
                yield first, wanted
            elif choice.at_ns is not None:
                last |= {topic: (first, [each for each in wanted if each[1] == topic]) for _, topic in wanted}
        yield from last.values()

    def _rows(self, id_: int, topic: str, choice: Choice) -> Iterator[tuple[int, int, bytes, TypeLine | None]]:
        head, *lines = zstd.decompress(self._get(_PART, id_)).split(b"\n")
        definition, where = orjson.loads(head)
        definition = definition and TypeLine._make(definition)
        for (place, number, time), line in zip(where, lines, strict=True):
            if choice.wants(topic, time, time):
                yield place, number, line, definition

    # --- rows

    def _put(self, kind: int, id_: int, plaintext: bytes) -> None:
        nonce = secrets.token_bytes(_NONCE)
        sealed = nonce + self._gcm.encrypt(nonce, plaintext, b"%d %d" % (kind, id_))
        self._db.execute("INSERT OR REPLACE INTO row VALUES (?, ?, ?)", (kind, id_, sealed))

    def _get(self, kind: int, id_: int) -> bytes:
        try:
            [(sealed,)] = self._db.execute("SELECT sealed FROM row WHERE kind = ? AND id = ?", (kind, id_)).fetchall()
            return self._gcm.decrypt(sealed[:_NONCE], sealed[_NONCE:], b"%d %d" % (kind, id_))
        except (InvalidTag, sqlite3.Error, ValueError, TypeError) as error:
            raise StoreError(f"{self._path} is damaged; remove it and read again") from error


def open_cache(
    folder: Path, name: str, log_: Log, reader: sm2.PrivateKey, trust: Trust, granted: Mapping[bytes, bytes], *,
    anew: bool = False,
) -> Cache | None:  # fmt: skip
    """What this reader has proven of the robot on this ledger under these CAs; None where nothing can be kept.

    granted: keys that were handed over; with others, the file is begun anew. anew: so it is whatever it holds.
    """
    roots = sm3.digest(b"".join(root.to_der() for root in trust.roots))
    given = b"".join(digest + key for digest, key in sorted(granted.items()))
    key = sm3.hmac(reader.to_bytes(), b"rosbridge-eth/2 what is proven" + log_.ledger + log_.tk + roots + given)[:16]
    path = folder / f"{name}.sqlite"
    try:
        folder.mkdir(mode=0o700, exist_ok=True)
        try:
            if not anew:
                return Cache(path, key)
        except sqlite3.OperationalError:
            raise
        except (sqlite3.DatabaseError, StoreError, ValueError):  # damaged, of another key or of another version
            pass
        path.unlink()
        return Cache(path, key)
    except (sqlite3.Error, OSError) as error:
        log.warning("%s: what is read is not kept: %s", path, error)
        return None


def add_topics(known: set[str], more: Iterable[str]) -> None:
    """For a person who named a topic that is not there: MAX_TOPICS at most, whatever a log holds."""
    if len(known) < MAX_TOPICS:
        known.update(islice(more, MAX_TOPICS))


def _span(records: list[ProvenRecord]) -> tuple[int, int]:
    times = [one.content.received_ns for one in records]
    return min(times), max(times)


def _plain(value: Any) -> Any:
    return value.hex() if isinstance(value, bytes) else list(value)
