"""What is SQLite's own about the store in a file: files that are not what they should be, disks, a cut log."""

from __future__ import annotations

import os
import random
import shutil
import sqlite3
import stat
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from bridge import disks
from bridge.chunks import chain
from rosbridge_eth.errors import StoreError
from rosbridge_eth.log.chunk import Chunk
from rosbridge_eth.log.database import DiskFull
from rosbridge_eth.log.sqlite import SqliteStore
from rosbridge_eth.log.store import NOWHERE, Offer, Outcome, place_of

A = b"a" * 32
PLENTY = 1 << 30


def open_file(path: Path, **more) -> SqliteStore:
    return SqliteStore(path, b"l" * 32, PLENTY, PLENTY, **more)


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "store.sqlite"


def numbers(store: SqliteStore) -> list[int]:
    places = [row.place for row in store.rows(A, NOWHERE, PLENTY)]
    return [Chunk.parse(encoded).header.number for encoded in store.chunks(A, places)]


def put(store: SqliteStore, *chunks: Chunk, now: float = 1.0) -> list[Outcome]:
    return store.append([Offer(A, one) for one in chunks], now)


def test_the_file_is_for_its_owner_alone(path):
    open_file(path).close()
    assert stat.S_IMODE(path.stat().st_mode) == 0o600


def test_the_inbox_of_another_contract_is_refused(path):
    open_file(path).close()
    with pytest.raises(StoreError, match="another contract or chain; move it away"):
        SqliteStore(path, b"x" * 32, PLENTY, PLENTY)


@pytest.mark.parametrize("name", ["missing/store.sqlite", "."])
def test_a_place_where_no_file_can_be_is_told(tmp_path, name):
    with pytest.raises(StoreError, match=r"cannot be (opened|used)"):
        open_file(tmp_path / name)


def test_another_process_that_opens_the_file_and_closes_it_leaves_the_log_of_two_connections_alone(path):
    first, second = open_file(path), open_file(path)  # as a shard and its submitter have it
    made = list(chain(2))
    put(first, made[0])
    look = "import sqlite3, sys; db = sqlite3.connect(sys.argv[1]); db.execute('SELECT * FROM robot'); db.close()"
    subprocess.run([sys.executable, "-c", look, str(path)], check=True)
    put(second, made[1])
    assert path.with_name(path.name + "-wal").exists()
    assert numbers(open_file(path, read_only=True)) == [0, 1]


@pytest.mark.parametrize("version", [1, 3])
@pytest.mark.parametrize("read_only", [False, True])
def test_one_of_the_first_edition_or_a_newer_one_is_refused(path, version, read_only):
    open_file(path).close()
    other = sqlite3.connect(path)
    other.execute(f"PRAGMA user_version = {version}")
    other.close()
    with pytest.raises(StoreError, match="is no store of version 2"):
        open_file(path, read_only=read_only)


def test_damage_is_told_with_the_way_out_and_the_file_is_left_where_others_may_have_it_open(path):
    store = open_file(path)
    put(store, *chain(50))
    store.close()
    data = bytearray(path.read_bytes())
    middle = len(data) // 2
    data[middle : middle + 8192] = bytes(8192)
    path.write_bytes(data)
    store = open_file(path)
    with pytest.raises(StoreError, match=r"damaged.*stop what uses it, move it.*\.recover"):
        store.check()
    store.close()
    assert path.read_bytes() == data


def test_a_file_that_is_no_database(path):
    path.write_bytes(b"something else entirely" * 100)
    with pytest.raises(StoreError, match="damaged"):
        open_file(path)


def test_a_file_that_is_exchanged_under_a_store_is_what_it_holds_then(path):
    store = open_file(path)
    made = list(chain(3))
    put(store, *made[:2])
    store.close()
    copy = path.read_bytes()
    store = open_file(path)
    put(store, made[2])
    new = path.with_name("new")
    new.write_bytes(copy)
    for beside in ("-wal", "-shm"):
        path.with_name(path.name + beside).unlink()
    new.rename(path)
    assert store.states([A])[0].head == place_of(made[1].header)
    assert put(store, *made) == [Outcome.KNOWN] * 2 + [Outcome.STORED]
    store.close()


def test_a_log_cut_at_any_place_holds_whole_appends_of_all_robots_and_all_that_returned_before(tmp_path):
    path, wal = tmp_path / "store.sqlite", tmp_path / "store.sqlite-wal"
    store = open_file(path)
    made = list(chain(5, size=3000))
    returned = []  # length of the log, and how much each of two robots had then
    for number in range(5):
        store.append([Offer(tk * 32, made[number]) for tk in (b"a", b"b")], 1.0)
        returned.append((wal.stat().st_size, number + 1))
    database, log = path.read_bytes(), wal.read_bytes()
    store.close()
    copy = tmp_path / "copy"
    for end in range(32, len(log) + 1, 4096 + 24):  # https://sqlite.org/fileformat2.html#walformat
        for cut in (end - 1, end):
            if cut < returned[0][0]:
                continue
            copy.mkdir()
            (copy / "store.sqlite").write_bytes(database)
            (copy / "store.sqlite-wal").write_bytes(log[:cut])
            again = open_file(copy / "store.sqlite")
            count = max(count for size, count in returned if size <= cut)
            for tk in (b"a" * 32, b"b" * 32):
                assert len(again.rows(tk, NOWHERE, 99)) == count
                assert again.states([tk])[0].head == place_of(made[count - 1].header)
            again.close()
            shutil.rmtree(copy)


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    with disks.small_disk(tmp_path / "disk", "24m") as folder:
        yield folder


def test_a_full_disk_takes_nothing_loses_nothing_and_drains(disk):
    """The bound is larger than the disk: what is confirmed makes room, although removing takes room as well."""
    store, made = open_file(disk / "store.sqlite"), list(chain(10_000, size=8000))
    taken = 0
    with pytest.raises(DiskFull, match="make room, what was kept before is safe"):
        for one in made:
            put(store, one)
            taken += 1
    assert taken > 500
    assert numbers(store) == list(range(taken))
    assert store.states([A])[0].head == place_of(made[taken - 1].header)
    store.close()
    store = open_file(disk / "store.sqlite")  # as a server that is started again
    store.set_state(A, confirmed=place_of(made[taken - 2].header), hold="why")
    store.forget(A, 2.0, PLENTY)
    assert numbers(store) == [taken - 2, taken - 1]
    assert put(store, *made[taken : taken + 100], now=3.0) == [Outcome.STORED] * 100
    store.close()


def test_a_disk_that_others_fill_is_told_and_when_there_is_room_it_goes_on(disk):
    store, made = open_file(disk / "store.sqlite"), list(chain(1500, size=8000))
    put(store, *made[:20])
    ballast = disks.fill_up(disk)
    with pytest.raises(DiskFull):
        for one in made[20:]:
            put(store, one)
    kept = numbers(store)
    assert kept == list(range(len(kept)))
    ballast.unlink()
    assert set(put(store, *made[: len(kept) + 200])) == {Outcome.KNOWN, Outcome.STORED}
    assert numbers(store) == list(range(len(kept) + 200))
    store.close()


def test_a_disk_that_is_mounted_read_only_can_be_looked_at(disk):
    store = open_file(disk / "store.sqlite")
    put(store, *chain(3))
    store.close()
    with disks.read_only(disk):
        with pytest.raises(StoreError, match="Read-only file system"):
            open_file(disk / "store.sqlite")
        looking = open_file(disk / "store.sqlite", read_only=True)
        assert numbers(looking) == [0, 1, 2]
        looking.close()


WRITER = """
import sys
from pathlib import Path
from bridge.chunks import chain
from rosbridge_eth.log.sqlite import SqliteStore
from rosbridge_eth.log.store import Offer
store = SqliteStore(Path(sys.argv[1]), b"l" * 32, 1 << 30, 1 << 30)
made = list(chain(2000, size=1000))
for begin in range(0, 2000, 4):
    store.append([Offer(tk * 32, one) for tk in (b"a", b"b") for one in made[begin : begin + 4]], 1.0)
    print(begin + 4, flush=True)
"""


@pytest.mark.parametrize("seed", range(4))
def test_after_kill_9_everything_that_append_returned_for_is_there(path, seed):
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(part for part in sys.path if part)}
    writer = subprocess.Popen([sys.executable, "-c", WRITER, path], stdout=subprocess.PIPE, text=True, env=environment)
    told, wanted = 0, random.Random(seed).randrange(10, 400)
    for line in writer.stdout:
        told = int(line) if line.endswith("\n") else told
        if told >= 4 * wanted:
            writer.kill()
    writer.wait(timeout=60)
    store = open_file(path)
    for tk in (b"a" * 32, b"b" * 32):
        found = store.rows(tk, NOWHERE, PLENTY)
        assert len(found) in (told, told + 4)
        assert store.states([tk])[0].head == found[-1].place
    store.close()
