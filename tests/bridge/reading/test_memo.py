"""What is kept are facts: a reading that finds them ends as one that does not, and no node can write one."""

from __future__ import annotations

import sqlite3
from collections.abc import Iterator, Sequence
from dataclasses import dataclass, field
from itertools import islice
from pathlib import Path
from typing import Any

import pytest

from bridge.reading.world import (
    LEDGER,
    NAME,
    START,
    T0,
    Pen,
    authority,
    events,
    message,
    reader,
    registration,
    robot,
    standing,
)
from rosbridge_eth.identity import Trust, create_ca
from rosbridge_eth.ledger import DataEvent, Standing
from rosbridge_eth.ledger.contract import RegistrationEvent
from rosbridge_eth.reading import Reading, Verdict, fetch, read_robot, verify


@dataclass(frozen=True)
class Block:
    number: int
    hash: bytes
    time: int


@dataclass
class Chain:
    """A node with batches, one a block."""

    data: list[DataEvent]
    head: int
    registered: list[RegistrationEvent] = field(default_factory=lambda: [registration()])
    late: int = 0
    url: str = "http://node"
    ledger: bytes = LEDGER
    contract: str = "0x"

    def block_number(self) -> int:
        return self.head

    def block(self, number: int) -> Block:
        return Block(number, b"%d" % number, T0 + number + self.late)

    def block_time(self, number: int) -> int:
        return T0 + number + self.late

    def standings(self, tks: Sequence[bytes], block: int) -> list[Standing]:
        return [standing([event for event in self.data if event.block <= block], self.registered)]

    def registrations(self, tk: bytes, stands: Standing) -> list[Any]:
        return self.registered

    def data_events(self, tk: bytes, first: int, last: int) -> Iterator[DataEvent]:
        return (event for event in self.data if first <= event.block <= last)


def begin(chain: Chain, folder: Path, **more: Any) -> Reading:
    more = {"trust": Trust([authority().certificate]), "reader": reader().encryption_key} | more
    return read_robot([chain], NAME, now=T0 + 60, memo=folder / "proven", **more)  # type: ignore[list-item]


def read(chain: Chain, folder: Path, **more: Any) -> tuple[list[Any], Verdict]:
    reading = begin(chain, folder, **more)
    found = [record.content.data["x"] for record in reading.records()]
    reading.close()
    return found, reading.verdict()


@pytest.fixture
def chain() -> Chain:
    """Twenty chunks of two records."""
    return Chain(events(Pen().chunks(20, records=2), 2), 50)


@pytest.fixture
def proven(monkeypatch) -> list[str]:
    """What is computed, and not found among the facts."""
    done: list[str] = []

    def counting(name: str) -> None:
        real = getattr(verify, name)
        monkeypatch.setattr(verify, name, lambda *given: done.append(name) or real(*given))

    counting("verify_signature")
    counting("unwrap")
    return done


def test_the_second_reading_ends_the_same_and_proves_nothing_again(chain, tmp_path, proven):
    first = read(chain, tmp_path)
    assert first[0] == list(range(40)) and first[1].sound
    assert len(proven) == 40
    assert read(chain, tmp_path) == first
    assert len(proven) == 40


def test_a_reading_that_was_cut_off_has_kept_what_it_proved(chain, tmp_path, proven):
    cut = begin(chain, tmp_path)
    list(islice(cut.records(), 17))
    cut.close()
    assert read(chain, tmp_path)[0] == list(range(40))
    assert len(proven) == 40


# --- what a node says once is not believed later


def lying(chain: Chain, lie: str) -> Chain:
    """A node that shows an old state, false times, a batch with one flipped digit, or not the replacement."""
    liar = Chain(chain.data, chain.head, chain.registered)
    if lie == "old state":
        liar.data = chain.data[:3]
    elif lie == "false times":
        liar.late = 10**7
    elif lie == "no replacement":
        liar.registered = chain.registered[:1]
    elif lie == "a flipped digit":
        first, second = chain.data[2].chunks
        liar.data = [*chain.data]
        liar.data[2] = chain.data[2]._replace(chunks=(first[:-1] + bytes([first[-1] ^ 1]), second))
    return liar


@pytest.mark.parametrize("lie", ["old state", "false times", "no replacement", "a flipped digit"])
@pytest.mark.parametrize("honest_first", [False, True])
def test_one_reading_at_a_node_that_lies_changes_no_later_one(tmp_path, lie, honest_first):
    """The thief has the replaced key, and goes on writing with it."""
    thief, owner = Pen(), Pen(identity=robot(1))
    stolen = thief.chunks(8)
    owner.previous, owner.stream, owner.number = stolen[5].header.digest, b"b" * 16, 0
    honest = Chain(
        events([*stolen[:6], *owner.chunks(6)], 2), 300, [registration(), registration(robot(1), 6, 2, previous=1)]
    )
    expected = read(honest, tmp_path / "elsewhere") if not (tmp_path / "elsewhere").mkdir() else None
    assert expected is not None and expected[1].sound
    if honest_first:
        read(honest, tmp_path)
    liar = lying(honest, lie)
    if lie == "no replacement":
        liar.data = events(stolen, 2)
    read(liar, tmp_path)
    assert read(honest, tmp_path) == expected


# --- the file


def test_only_the_owner_may_read_it_and_it_shows_nothing(chain, tmp_path):
    read(chain, tmp_path)
    [path] = (tmp_path / "proven").iterdir()
    assert path.stat().st_mode & 0o777 == 0o600
    assert path.parent.stat().st_mode & 0o777 == 0o700
    content = path.read_bytes()
    assert len(content) > 4_000 and not any(text in content for text in (b"chunk", b"dropped", b"topic"))


def test_another_reader_finds_nothing_in_it(chain, tmp_path, proven):
    read(chain, tmp_path)
    _, verdict = read(chain, tmp_path, reader=reader("other").encryption_key)
    assert verdict.counts["no-grant"] == 40
    _, verdict = read(chain, tmp_path, trust=Trust([create_ca("Another", at=START).certificate]))
    assert verdict.counts["untrusted"] == 20


@pytest.mark.parametrize("content", [b"", b"SQLite format 3\0 and no more", b"x" * 8192])
def test_a_file_that_is_none_is_begun_anew(chain, tmp_path, content, proven):
    read(chain, tmp_path)
    [path] = (tmp_path / "proven").iterdir()
    path.write_bytes(content)
    for _ in range(3):
        assert read(chain, tmp_path)[0] == list(range(40))
    assert len(proven) == (120 if content else 80), "what is no database is emptied, and used by the next reading"


def test_a_damaged_page_costs_the_keeping_once(chain, tmp_path, caplog, proven):
    read(chain, tmp_path)
    [path] = (tmp_path / "proven").iterdir()
    content = bytearray(path.read_bytes())
    content[4096:4196] = bytes([255]) * 100
    path.write_bytes(content)
    for _ in range(3):
        assert read(chain, tmp_path)[0] == list(range(40))
    assert caplog.text.count("is not kept") == 1
    assert len(proven) == 120, "at first, with the damage, and after it; then all is known"


CHANGES = ["sealed = zeroblob(40)", "sealed = NULL", "sealed = substr(sealed, 1, 20)", "sealed = 7", "sealed = 'text'"]


@pytest.mark.parametrize("change", [*CHANGES, "sealed = (SELECT sealed FROM fact LIMIT 1)"])
def test_a_row_that_was_altered_or_moved_is_proven_again(chain, tmp_path, change, proven):
    expected = read(chain, tmp_path)
    [path] = (tmp_path / "proven").iterdir()
    with sqlite3.connect(path) as db:
        db.execute(f"UPDATE fact SET {change}")
    for _ in range(2):
        assert read(chain, tmp_path) == expected
    assert len(proven) in (79, 80)


def test_two_at_once_both_keep_what_they_prove(chain, tmp_path, caplog, proven):
    first = begin(chain, tmp_path)
    assert read(chain, tmp_path)[0] == [record.content.data["x"] for record in first.records()]
    first.close()
    assert not caplog.text
    assert len(proven) == 40


def test_a_folder_that_cannot_be_made_costs_only_the_keeping(chain, tmp_path, caplog):
    (tmp_path / "proven").write_text("a file")
    assert read(chain, tmp_path)[0] == list(range(40))
    assert caplog.text.count("is not kept") == 1


def test_a_full_disk_ends_the_keeping_and_not_the_reading(tmp_path, caplog):
    chain = Chain(events(Pen().chunks(60), 2), 100)
    reading = begin(chain, tmp_path)
    assert reading.memo is not None and reading.memo._db is not None
    reading.memo._db.execute("PRAGMA max_page_count = 1")
    assert len(list(reading.records())) == 60
    reading.close()
    assert "disk is full" in caplog.text
    assert read(chain, tmp_path)[0] == list(range(60))


def test_of_endlessly_many_topics_some_are_remembered(tmp_path, monkeypatch):
    monkeypatch.setattr(fetch, "MAX_TOPICS", 5)
    pen = Pen()
    chunks = [pen.write(*(message(n, f"/t{n}") for n in range(at, at + 10))) for at in range(0, 100, 10)]
    reading = begin(Chain(events(chunks, 1), 20), tmp_path)
    assert len(list(reading.records())) == 100
    assert len(reading.topics) == 5
    reading.close()
