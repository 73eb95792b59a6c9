"""What is SQLite's own about the inbox in a file: files that are not what they should be, disks, a cut log."""

from __future__ import annotations

import shutil
import sqlite3
import stat
from collections.abc import Iterator
from contextlib import closing
from pathlib import Path

import pytest

from bridge import disks
from bridge.chunks import STREAM, chain, chunk
from rosbridge_eth.errors import StoreError
from rosbridge_eth.inbox import InboxExchanged, Outcome
from rosbridge_eth.inbox.sqlite import SqliteInbox
from rosbridge_eth.log.chunk import Chunk
from rosbridge_eth.log.database import DiskFull

A = b"a" * 32
PLENTY = 1 << 30


def open_file(path: Path, **more) -> SqliteInbox:
    return SqliteInbox(path, b"l" * 32, PLENTY, PLENTY, **more)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "inbox.sqlite"


def numbers(inbox: SqliteInbox) -> list[int]:
    positions = [row.position for row in inbox.rows(A, None, PLENTY)]
    return [Chunk.parse(encoded).header.number for encoded in inbox.chunks(A, positions)]


def test_an_old_copy_that_is_put_back_is_told_to_who_committed_since(path, tmp_path):
    one, two = open_file(path), open_file(path)
    put = lambda inbox, *given: inbox.append([(A, chunk) for chunk in given], 1.0)  # noqa: E731
    made = list(chain(9))
    put(one, *made[:4])
    put(two, made[4])
    with closing(sqlite3.connect(path)) as file, closing(sqlite3.connect(tmp_path / "copy")) as copy:
        file.backup(copy)
        put(one, *made[5:7])
        copy.backup(file)
    assert put(two, made[8]) == [Outcome.STORED], "all that this one was told is stored is there"
    for given in (made[7:8], ()):
        with pytest.raises(InboxExchanged, match="an old copy of the inbox"):
            put(one, *given)
        assert put(one, *given) in ([Outcome.KNOWN], []), "told once; what is asked anew is answered by what is there"
        with closing(sqlite3.connect(path)) as file, closing(sqlite3.connect(tmp_path / "copy")) as copy:
            put(one, made[8])
            copy.backup(file)
    one.close()
    two.close()


def test_the_file_is_for_its_owner_alone(path):
    open_file(path).close()
    assert stat.S_IMODE(path.stat().st_mode) == 0o600


def test_the_inbox_of_another_contract_is_refused(path):
    open_file(path).close()
    with pytest.raises(StoreError, match="another contract or chain; move it away"):
        SqliteInbox(path, b"x" * 32, PLENTY, PLENTY)


@pytest.mark.parametrize("name", ["missing/inbox.sqlite", "."])
def test_a_place_where_no_file_can_be_is_told(tmp_path, name):
    with pytest.raises(StoreError, match="cannot be opened"):
        open_file(tmp_path / name)


@pytest.mark.parametrize(("version", "says"), [(1, "first edition"), (3, "version 3")])
@pytest.mark.parametrize("read_only", [False, True])
def test_one_of_the_first_edition_or_a_newer_one_is_refused(path, version, says, read_only):
    open_file(path).close()
    other = sqlite3.connect(path)
    other.execute(f"PRAGMA user_version = {version}")
    other.close()
    with pytest.raises(StoreError, match=says):
        open_file(path, read_only=read_only)


def test_damage_is_told_with_the_way_out_and_the_file_is_left_where_others_may_have_it_open(path):
    inbox = open_file(path)
    inbox.append([(A, one) for one in chain(50)], 1.0)
    inbox.close()
    data = bytearray(path.read_bytes())
    middle = len(data) // 2
    data[middle : middle + 8192] = bytes(8192)
    path.write_bytes(data)
    inbox = open_file(path)
    with pytest.raises(StoreError, match=r"damaged.*stop what uses it, move it.*\.recover"):
        inbox.check()
    inbox.close()
    assert path.read_bytes() == data


def test_a_file_that_is_no_database(path):
    path.write_bytes(b"something else entirely" * 100)
    with pytest.raises(StoreError, match="damaged"):
        open_file(path)


def test_a_file_that_is_removed_under_a_reader_is_still_that_file_and_under_a_writer_it_is_told(path):
    inbox = open_file(path)
    inbox.append([(A, chunk(0))], 1.0)
    path.rename(path.with_name("moved"))
    assert len(inbox.rows(A, None, 9)) == 1
    with pytest.raises(StoreError, match="exchanged or removed"):
        inbox.append([(A, chunk(1))], 1.0)
    assert inbox.append([(A, chunk(1))], 1.0) == [Outcome.STORED]
    inbox.close()


def test_a_log_cut_at_any_place_holds_whole_appends_of_all_robots_and_all_that_returned_before(tmp_path):
    path, wal = tmp_path / "inbox.sqlite", tmp_path / "inbox.sqlite-wal"
    inbox = open_file(path)
    returned = []  # length of the log, and how much each of two robots had then
    for number in range(5):
        inbox.append([(tk * 32, chunk(number, size=3000)) for tk in (b"a", b"b")], 1.0)
        returned.append((wal.stat().st_size, number + 1))
    database, log = path.read_bytes(), wal.read_bytes()
    inbox.close()
    copy = tmp_path / "copy"
    for end in range(32, len(log) + 1, 4096 + 24):  # https://sqlite.org/fileformat2.html#walformat
        for cut in (end - 1, end):
            if cut < returned[0][0]:
                continue
            copy.mkdir()
            (copy / "inbox.sqlite").write_bytes(database)
            (copy / "inbox.sqlite-wal").write_bytes(log[:cut])
            again = open_file(copy / "inbox.sqlite")
            count = max(count for size, count in returned if size <= cut)
            for tk in (b"a" * 32, b"b" * 32):
                assert len(again.rows(tk, None, 99)) == count
                assert again.head(tk, STREAM).number == count - 1
            again.close()
            shutil.rmtree(copy)


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    with disks.small_disk(tmp_path / "disk", "24m") as folder:
        yield folder


def test_a_full_disk_takes_nothing_loses_nothing_and_drains(disk):
    """The bound is larger than the disk: what is confirmed makes room, although removing takes room as well."""
    inbox = open_file(disk / "inbox.sqlite")
    taken = 0
    with pytest.raises(DiskFull, match="make room, what was kept before is safe"):
        for one in chain(10_000, size=8000):
            inbox.append([(A, one)], 1.0)
            taken += 1
    assert taken > 500
    assert numbers(inbox) == list(range(taken))
    assert inbox.head(A, STREAM).number == taken - 1
    inbox.close()
    inbox = open_file(disk / "inbox.sqlite")  # as a server that is started again
    inbox.confirm(A, inbox.rows(A, None, PLENTY)[-2].position, 1.0)
    inbox.set_state(A, hold="why")
    inbox.forget(2.0)
    assert numbers(inbox) == [taken - 2, taken - 1]
    assert inbox.append([(A, chunk(number, size=8000)) for number in range(taken, taken + 100)], 3.0) == [
        Outcome.STORED
    ] * 100
    inbox.close()


def test_a_disk_that_others_fill_is_told_and_when_there_is_room_it_goes_on(disk):
    inbox = open_file(disk / "inbox.sqlite")
    made = list(chain(1500, size=8000))
    inbox.append([(A, one) for one in made[:20]], 1.0)
    ballast = disks.fill_up(disk)
    with pytest.raises(DiskFull):
        for one in made[20:]:
            inbox.append([(A, one)], 1.0)
    kept = numbers(inbox)
    assert kept == list(range(len(kept)))
    ballast.unlink()
    assert set(inbox.append([(A, one) for one in made[: len(kept) + 200]], 1.0)) == {Outcome.KNOWN, Outcome.STORED}
    assert numbers(inbox) == list(range(len(kept) + 200))
    inbox.close()


def test_a_disk_that_is_mounted_read_only_can_be_looked_at(disk):
    inbox = open_file(disk / "inbox.sqlite")
    inbox.append([(A, one) for one in chain(3)], 1.0)
    inbox.close()
    with disks.read_only(disk):
        with pytest.raises(StoreError, match="Read-only file system"):
            open_file(disk / "inbox.sqlite")
        looking = open_file(disk / "inbox.sqlite", read_only=True)
        assert numbers(looking) == [0, 1, 2]
        looking.close()
