"""What was proven is kept: the next reading ends the same and asks only for what is new; a file that lies is none."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

import pytest

from bridge.reading.world import (
    LEDGER,
    LOG,
    NAME,
    START,
    STREAM_LINE,
    T0,
    Pen,
    authority,
    events,
    line,
    message,
    reader,
    registration,
    standing,
)
from rosbridge_eth.errors import StoreError
from rosbridge_eth.identity import Trust, create_ca
from rosbridge_eth.ledger import DataEvent, Standing
from rosbridge_eth.reading import Bookmarks, Choice, ProvenRecord, Reading, read_robot
from rosbridge_eth.reading import cache as caching
from rosbridge_eth.reading.fetch import MARGIN

TYPE_LINE = line({"type": "pkg/msg/Type", "wire": "ros1", "format": "msg", "definition": "int64 x\n"})


@dataclass(frozen=True)
class Block:
    number: int
    hash: bytes
    time: int


@dataclass
class Chain:
    """A node with batches, one a block; `fork` changes the hash of every block from one on. asked: first blocks."""

    data: list[DataEvent]
    head: int
    fork: int | None = None
    asked: list[int] = field(default_factory=list)
    url: str = "http://node"
    ledger: bytes = LEDGER
    contract: str = "0x"

    def block_number(self) -> int:
        return self.head

    def block(self, number: int) -> Block:
        return Block(number, b"%d %d" % (number, self.fork is not None and number >= self.fork), T0 + number)

    def block_time(self, number: int) -> int:
        return T0 + number

    def standings(self, tks: Sequence[bytes], block: int) -> list[Standing]:
        return [standing([event for event in self.data if event.block <= block], [registration()])]

    def registrations(self, tk: bytes, stands: Standing) -> list[Any]:
        return [registration()]

    def data_events(self, tk: bytes, first: int, last: int) -> Iterator[DataEvent]:
        self.asked.append(first)
        return (event for event in self.data if first <= event.block <= last)


def log_of(count: int, per_event: int = 2) -> list[DataEvent]:
    pen = Pen()
    chunks = [pen.write(STREAM_LINE, TYPE_LINE, message(0, "/a"), message(1, "/b"))]
    for n in range(2, 2 * count, 2):
        chunks.append(pen.write(message(n, "/a"), message(n + 1, "/b")))
    return events(chunks, per_event)


def begin(chain: Chain, folder: Path, **more: Any) -> Reading:
    more = {"trust": Trust([authority().certificate]), "reader": reader().encryption_key} | more
    return read_robot([chain], NAME, now=T0 + 60, cache=folder / "proven", **more)  # type: ignore[list-item]


def read(chain: Chain, folder: Path, choice: Choice = Choice(), **more: Any) -> tuple[list[ProvenRecord], Reading]:  # noqa: B008
    reading = begin(chain, folder, **more)
    found = list(reading.records(choice))
    reading.close()
    return found, reading


def numbers(records: Sequence[ProvenRecord]) -> list[int]:
    return [record.content.data["x"] for record in records]


@pytest.fixture(autouse=True)
def small_segments(monkeypatch):
    monkeypatch.setattr(caching, "MAX_CHUNKS", 3)


@pytest.fixture
def chain() -> Chain:
    """Twenty chunks in blocks 3, 5 ... 21, of which those up to 13 are final."""
    return Chain(log_of(20), 13 + MARGIN)


def test_the_second_reading_gives_the_same_and_asks_only_for_what_is_new(chain, tmp_path):
    first, whole = read(chain, tmp_path)
    again, second = read(chain, tmp_path)
    assert again == first
    assert numbers(first) == list(range(40))
    assert second.verdict() == whole.verdict()
    assert chain.asked == [1, 14]
    assert second.topics == whole.topics == {"/a", "/b"}


def test_what_came_since_is_read_too(tmp_path):
    data = log_of(30)
    short = Chain(data[:10], data[9].block + MARGIN)
    read(short, tmp_path)
    found, reading = read(Chain(data, data[-1].block + MARGIN), tmp_path)
    assert numbers(found) == list(range(60))
    assert (reading.verdict().records, reading.verdict().chunks) == (60, 30)
    assert reading.verdict().sound
    last = Chain(data, data[-1].block + MARGIN)
    assert numbers(read(last, tmp_path)[0]) == list(range(60))
    assert last.asked == [data[-1].block + 1]


@pytest.mark.parametrize(
    "choice",
    [Choice(topic="/a"), Choice(from_ns=7, to_ns=23), Choice("/b", 7, 23), Choice(at_ns=17), Choice("/a", at_ns=17),
     Choice(topic="/c"), Choice(at_ns=39), Choice(from_ns=25)],
)  # fmt: skip
def test_a_choice_gives_the_same_from_what_is_kept(chain, tmp_path, choice):
    first, _ = read(chain, tmp_path / "a", choice) if not (tmp_path / "a").mkdir() else ([], None)
    read(chain, tmp_path)
    again, reading = read(chain, tmp_path, choice)
    assert sorted(again) == sorted(first)
    assert reading.topics == {"/a", "/b"}


def test_only_the_parts_that_are_wanted_are_opened(chain, tmp_path, monkeypatch):
    read(chain, tmp_path)
    opened: list[int] = []
    real = caching.Cache._get

    def get(self: Any, kind: int, id_: int) -> bytes:
        opened.append(kind)
        return real(self, kind, id_)

    monkeypatch.setattr(caching.Cache, "_get", get)
    read(chain, tmp_path, Choice("/a", 6, 7))
    assert opened.count(caching._PART) == 2  # where the chunks of one segment stand, and its records on this topic


def test_a_reading_that_was_cut_off_is_gone_on_with(chain, tmp_path):
    cut = begin(chain, tmp_path)
    records = cut.records()
    for _ in range(17):
        next(records)
    cut.close()
    found, reading = read(chain, tmp_path)
    assert numbers(found) == list(range(40))
    assert 1 < chain.asked[1] < 13
    assert reading.verdict().sound


def test_a_reorganisation_of_what_was_kept_is_told_and_all_is_read_anew(chain, tmp_path):
    read(chain, tmp_path)
    chain.fork = 13
    found, reading = read(chain, tmp_path)
    assert numbers(found) == list(range(40))
    assert chain.asked == [1, 1]
    assert "another block 13" in "\n".join(reading.verdict().lines())
    assert read(chain, tmp_path)[1].verdict().nodes == ()


def test_a_reorganisation_above_it_costs_nothing(chain, tmp_path):
    read(chain, tmp_path)
    chain.fork = 14
    assert numbers(read(chain, tmp_path)[0]) == list(range(40))
    assert chain.asked == [1, 14]


def test_a_node_that_is_behind_is_read_as_it_is_and_nothing_is_lost(chain, tmp_path):
    bookmarks = Bookmarks(tmp_path / "bookmarks.json")
    _, first = read(chain, tmp_path, bookmarks=bookmarks)
    first.keep(bookmarks)
    behind = Chain(chain.data, 10)
    found, reading = read(behind, tmp_path, bookmarks=bookmarks)
    assert numbers(found) == list(range(16))
    assert reading.verdict().counts["rolled-back"] == 1
    assert "above block 10" in "\n".join(reading.verdict().lines())
    assert numbers(read(chain, tmp_path)[0]) == list(range(40))
    assert chain.asked == [1, 14]


def test_what_was_wrong_stays_wrong_and_is_still_listed(tmp_path):
    chunks = Pen().chunks(12)
    del chunks[2]
    chain = Chain(events(chunks, 2), 100 + MARGIN)
    _, first = read(chain, tmp_path)
    _, second = read(chain, tmp_path)
    assert second.verdict() == first.verdict()
    assert [str(found) for found in second.verdict().findings] == [str(found) for found in first.verdict().findings]
    assert not second.verdict().sound


def test_what_a_node_kept_back_is_asked_for_again(chain, tmp_path):
    withholding = Chain([*chain.data[:2], *chain.data[3:]], chain.head)
    _, reading = read(withholding, tmp_path)
    assert reading.verdict().counts["withheld"] == 2
    assert numbers(read(chain, tmp_path)[0]) == list(range(40))


@pytest.mark.parametrize("gone", [5, 9])
def test_what_a_node_kept_back_at_the_end_of_what_is_final_is_asked_for_again(chain, tmp_path, gone, monkeypatch):
    """gone: the last batch of the final ones, and the very last."""
    chain.head = chain.data[gone].block + MARGIN
    withholding = Chain(chain.data, chain.head)
    shown = [event for event in chain.data if event is not chain.data[gone]]
    monkeypatch.setattr(withholding, "data_events", lambda tk, first, last: iter(shown))
    assert read(withholding, tmp_path)[1].verdict().counts["withheld"] == 2
    found, reading = read(chain, tmp_path)
    assert numbers(found) == list(range(40))
    assert reading.verdict().sound


# --- the file


def test_only_the_owner_may_read_it_and_it_shows_nothing(chain, tmp_path):
    read(chain, tmp_path)
    [path] = (tmp_path / "proven").iterdir()
    assert path.stat().st_mode & 0o777 == 0o600
    assert path.parent.stat().st_mode & 0o777 == 0o700
    content = path.read_bytes()
    assert not any(text in content for text in (b"pkg/", b"topic", b"int64", b"stream", b"count"))


def test_another_key_or_ca_finds_nothing_in_it(chain, tmp_path):
    read(chain, tmp_path)
    _, reading = read(chain, tmp_path, reader=reader("other").encryption_key)
    assert reading.verdict().counts["no-grant"] == 42
    _, reading = read(chain, tmp_path, trust=Trust([create_ca("Another", at=START).certificate]))
    assert not reading.verdict().sound
    assert chain.asked == [1, 1, 1]


@pytest.mark.parametrize("content", [b"", b"SQLite format 3\0 and no more", b"x" * 8192])
def test_a_file_that_is_none_is_begun_anew(chain, tmp_path, content):
    read(chain, tmp_path)
    [path] = (tmp_path / "proven").iterdir()
    path.write_bytes(content)
    assert numbers(read(chain, tmp_path)[0]) == list(range(40))
    assert numbers(read(chain, tmp_path)[0]) == list(range(40))
    assert chain.asked == [1, 1, 14]


@pytest.mark.parametrize("kind", [caching._STATE, caching._SEGMENT, caching._PART])
@pytest.mark.parametrize("change", ["sealed = zeroblob(40)", "sealed = NULL", "sealed = substr(sealed, 1, 60)"])
def test_a_row_that_was_altered_is_not_believed(chain, tmp_path, kind, change):
    read(chain, tmp_path)
    [path] = (tmp_path / "proven").iterdir()
    with sqlite3.connect(path) as db:
        db.execute(f"UPDATE row SET {change} WHERE kind = ?", [kind])
    if kind == caching._PART:
        with pytest.raises(StoreError, match="remove it and read again"):
            read(chain, tmp_path)
    else:
        assert numbers(read(chain, tmp_path)[0]) == list(range(40))


def test_rows_that_changed_places_are_not_believed(chain, tmp_path):
    read(chain, tmp_path)
    [path] = (tmp_path / "proven").iterdir()
    with sqlite3.connect(path) as db:
        (one, a), (two, b) = db.execute("SELECT id, sealed FROM row WHERE kind = 2 ORDER BY id LIMIT 2").fetchall()
        db.executemany("UPDATE row SET sealed = ? WHERE kind = 2 AND id = ?", [(b, one), (a, two)])
    with pytest.raises(StoreError, match="damaged"):
        read(chain, tmp_path)


def test_a_file_of_another_version_is_begun_anew(chain, tmp_path):
    read(chain, tmp_path)
    trust = Trust([authority().certificate])
    [path] = (tmp_path / "proven").iterdir()
    kept = caching.open_cache(path.parent, path.stem, LOG, reader().encryption_key, trust, {})
    assert kept is not None and kept.progress.count > 0
    kept._put(caching._STATE, 0, b'[13, "", 14]\n{"count": "as it was counted then"}')
    kept.close()
    assert numbers(read(chain, tmp_path)[0]) == list(range(40))


def test_a_file_that_cannot_be_begun_anew_costs_only_the_keeping(chain, tmp_path, caplog, monkeypatch):
    read(chain, tmp_path)
    chain.fork = 13

    def unlink(self: Path) -> None:
        raise PermissionError(13, "Permission denied")

    monkeypatch.setattr(caching.Path, "unlink", unlink)
    assert numbers(read(chain, tmp_path)[0]) == list(range(40))
    assert "is not kept" in caplog.text


def test_two_at_once_both_read(chain, tmp_path, caplog):
    first = begin(chain, tmp_path)
    second, _ = read(chain, tmp_path)
    assert numbers(second) == numbers(list(first.records())) == list(range(40))
    assert "is not kept" in caplog.text
    first.close()


def test_a_folder_that_cannot_be_made_costs_only_the_keeping(chain, tmp_path, caplog):
    (tmp_path / "proven").write_text("a file")
    assert numbers(read(chain, tmp_path)[0]) == list(range(40))
    assert "is not kept" in caplog.text


def test_a_full_disk_ends_the_keeping_and_not_the_reading(chain, tmp_path, caplog, monkeypatch):
    def full(self: Any, kind: int, id_: int, plaintext: bytes) -> None:
        raise sqlite3.OperationalError("database or disk is full")

    with monkeypatch.context() as patched:
        patched.setattr(caching.Cache, "_put", full)
        assert numbers(read(chain, tmp_path)[0]) == list(range(40))
    assert "disk is full" in caplog.text
    assert numbers(read(chain, tmp_path)[0]) == list(range(40))
    trust = Trust([authority().certificate])
    assert caching.open_cache(tmp_path / "proven", NAME, LOG, reader().encryption_key, trust, {})


def test_of_endlessly_many_topics_some_are_remembered(tmp_path, monkeypatch):
    monkeypatch.setattr(caching, "MAX_TOPICS", 5)
    pen = Pen()
    chunks = [pen.write(*(message(n, f"/t{n}") for n in range(at, at + 10))) for at in range(0, 100, 10)]
    chain = Chain(events(chunks, 1), 20 + MARGIN)
    for _ in range(2):
        found, reading = read(chain, tmp_path)
        assert numbers(found) == list(range(100))
        assert len(reading.topics) == 5
        assert numbers(read(chain, tmp_path, Choice("/t77"))[0]) == [77]
