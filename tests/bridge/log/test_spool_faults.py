"""The spool when the power fails, the process is killed, and the disk is full or read-only."""

from __future__ import annotations

import errno
import os
import random
import shutil
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from bridge import disks
from bridge.chunks import STREAM, chain, chunk, dropped
from rosbridge_eth.errors import StoreError
from rosbridge_eth.log.chunk import Chunk, Log
from rosbridge_eth.log.database import DiskFull
from rosbridge_eth.log.store import NOWHERE
from rosbridge_eth.robot.spool import Spool

LOG = Log(b"l" * 32, b"r" * 32)
PLENTY = 1 << 30


def open_spool(path: Path, max_bytes: int = PLENTY) -> Spool:
    return Spool(path, LOG, max_bytes=max_bytes, drop=dropped)


def all_of(spool: Spool) -> list[Chunk]:
    return [Chunk.parse(one) for one in spool.chunks([row.place for row in spool.rows(NOWHERE, PLENTY)])]


def at(number: int, stream: bytes = STREAM) -> bytes:
    return stream + number.to_bytes(8, "big")


def numbers(chunks: list[Chunk]) -> list[int]:
    return [one.header.number for one in chunks]


def test_without_its_reserve_the_spool_takes_what_fits_the_file(tmp_path, monkeypatch):
    spool = open_spool(tmp_path / "spool.sqlite")

    def fails(path: object) -> None:
        raise OSError(errno.EIO, "Input/output error")

    monkeypatch.setattr(os, "statvfs", fails)
    (tmp_path / "spool.sqlite.reserve").unlink()
    spool.append(chunk(0))
    assert not (tmp_path / "spool.sqlite.reserve").exists() and len(spool.rows(NOWHERE, 9)) == 1
    spool.close()


# --- crashes


def test_a_log_cut_at_any_place_holds_whole_appends_and_all_that_returned_before(tmp_path):
    """The write-ahead log is only ever added to: a crash between any two writes leaves a beginning of it."""
    path, wal = tmp_path / "spool.sqlite", tmp_path / "spool.sqlite-wal"
    spool = open_spool(path, 9000)
    made = list(chain(9, size=3000))
    returned = []  # length of the log, and what was there then
    for one in made:
        spool.append(one)
        returned.append((wal.stat().st_size, all_of(spool), spool.last_digest, spool.statistics()))
    database, log = path.read_bytes(), wal.read_bytes()
    spool.close()
    copy = tmp_path / "copy"
    frame = 4096 + 24  # https://sqlite.org/fileformat2.html#walformat
    ends = range(32, len(log) + 1, frame)
    assert returned[0][0] in ends
    for cut in sorted({place + more for place in ends for more in (-1, 0, 1) if place + more >= returned[0][0]}):
        copy.mkdir()
        (copy / "spool.sqlite").write_bytes(database)
        (copy / "spool.sqlite-wal").write_bytes(log[:cut])
        again = open_spool(copy / "spool.sqlite", 9000)
        _, chunks, last, statistics = [state for state in returned if state[0] <= cut][-1]
        assert (all_of(again), again.last_digest, again.statistics()[:5]) == (chunks, last, statistics[:5])
        again.close()
        shutil.rmtree(copy)


CHILD = f"""
import sys
from pathlib import Path
from bridge.chunks import chain, dropped
from rosbridge_eth.log.chunk import Log
from rosbridge_eth.robot.spool import Spool
spool = Spool(Path(sys.argv[1]), Log({LOG.ledger!r}, {LOG.tk!r}), max_bytes=20_000, drop=dropped)
for number, one in enumerate(chain(100_000, size=1000)):
    print("next", number, one.header.digest.hex(), flush=True)
    spool.append(one)
    print("kept", number, one.header.digest.hex(), flush=True)
    if number % 3 == 0:
        spool.stored({STREAM!r} + max(number - 2, 0).to_bytes(8, "big"))
    if number % 7 == 0 and number:
        print("gone", number - 5, flush=True)
        spool.confirmed({STREAM!r} + (number - 5).to_bytes(8, "big"))
"""


@pytest.mark.parametrize("seed", range(6))
def test_after_kill_9_everything_that_append_returned_for_is_there_and_the_last_digest_is_its_own(tmp_path, seed):
    path = tmp_path / "spool.sqlite"
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(part for part in sys.path if part)}
    process = subprocess.Popen(
        [sys.executable, "-c", CHILD, str(path)], stdout=subprocess.PIPE, text=True, env=environment
    )
    wanted, told = random.Random(seed).randrange(20, 400), []
    for line in process.stdout:
        if line.endswith("\n"):
            told.append(line.split())
        if len(told) >= wanted:
            process.kill()
    process.wait(timeout=60)
    digests = {int(number): digest[0] for word, number, *digest in told if word != "gone"}
    kept = max(int(number) for word, number, *_ in told if word == "kept")
    gone = max((int(number) for word, number, *_ in told if word == "gone"), default=-1)
    spool = open_spool(path, 20_000)
    found = numbers(all_of(spool))
    print(f"seed {seed}: {found[0]} to {found[-1]}, told {kept}")
    assert found[-1] in (kept, kept + 1)
    assert spool.last_digest.hex() == digests.get(found[-1], spool.last_digest.hex())
    assert found == list(range(found[0], found[-1] + 1))
    assert found[0] <= max(gone, 0)  # nothing went that was not to: stored ones go only when there is no room
    spool.close()


# --- disks


@pytest.fixture
def disk(tmp_path: Path) -> Iterator[Path]:
    with disks.small_disk(tmp_path / "disk", "5m") as folder:
        yield folder


def test_a_disk_that_the_spool_itself_fills_takes_the_new_at_the_expense_of_the_old_and_drains(disk):
    """Nobody helps: the bound is larger than the disk. Removing takes room as well, of which there is none."""
    spool = open_spool(disk / "spool.sqlite")
    for one in chain(1500, size=8000):
        spool.append(one)
    found = all_of(spool)
    assert found[-1].header.number == 1499
    whole = [one for one in found if not one.bare]
    assert numbers(whole) == list(range(1500 - len(whole), 1500))
    assert len(whole) > 100
    statistics = spool.statistics()
    assert statistics.dropped_bodies == 1500 - len(whole)
    spool.close()
    spool = open_spool(disk / "spool.sqlite")  # the robot may be started again in this state
    assert all_of(spool) == found
    spool.stored(at(1450))
    assert spool.statistics().unstored == 49
    for number in range(1300, 1500, 7):
        spool.confirmed(at(number))
    spool.confirmed(at(1499))
    assert (all_of(spool), spool.statistics().chunks, spool.last_digest) == (found[-1:], 0, found[-1].header.digest)
    for one in chain(100, b"t" * 16, size=8000):
        spool.append(one)
    assert spool.statistics().chunks == 100
    spool.close()


def test_a_disk_that_others_fill_is_survived_and_everything_that_was_kept_stays_readable(disk, caplog):
    spool = open_spool(disk / "spool.sqlite")
    made = list(chain(400, size=4000))
    for one in made[:50]:
        spool.append(one)
    ballast = disks.fill_up(disk)
    for one in made[50:]:
        spool.append(one)
    [told] = [event.getMessage() for event in caplog.records if event.levelname == "WARNING"]
    assert str(disk) in told and "is full" in told and "the oldest chunks give way" in told
    found = all_of(spool)
    assert found[-1] == made[-1]
    assert all(one in (whole, dropped(whole)) for one, whole in zip(found, made[found[0].header.number :], strict=True))
    spool.close()
    spool = open_spool(disk / "spool.sqlite")
    assert all_of(spool) == found
    ballast.unlink()
    more = list(chain(100, b"t" * 16, size=4000))
    for one in more:
        spool.append(one)
    assert all_of(spool) == found + more
    spool.close()


def test_where_not_even_old_ones_make_room_it_says_so_changes_nothing_and_goes_on_later(disk):
    spool = open_spool(disk / "spool.sqlite")
    made = list(chain(3, size=60_000))
    spool.append(chunk(0, b"e" * 16, size=500))
    ballast = disks.fill_up(disk)
    (disk / "spool.sqlite.reserve").unlink()
    disks.fill_up(disk)
    before = spool.statistics()
    with pytest.raises(DiskFull, match="is full; make room, what was kept before is safe"):
        for one in made:
            spool.append(one)
    assert spool.statistics().chunks in (before.chunks, before.chunks + 1)
    kept = spool.last_digest
    assert spool.statistics().dropped_bodies == 0
    ballast.unlink()
    for one in made[0 if kept != made[0].header.digest else 1 :]:
        spool.append(one)
    assert all_of(spool)[-3:] == made
    spool.close()


def test_a_reserve_that_was_cut_short_is_none(tmp_path):
    spool = open_spool(tmp_path / "spool.sqlite")
    reserve = tmp_path / "spool.sqlite.reserve"
    whole = reserve.stat().st_size
    reserve.write_bytes(b"what a crash left")
    spool.append(chunk(0))
    assert reserve.stat().st_size == whole
    spool.close()


def test_a_crash_on_a_full_disk_leaves_what_was_there(disk, tmp_path):
    spool = open_spool(disk / "spool.sqlite")
    for one in chain(1000, size=8000):
        spool.append(one)
    found = all_of(spool)
    shutil.copytree(disk, tmp_path / "as the crash left it")
    spool.close()
    crashed = tmp_path / "as the crash left it" / "spool.sqlite"
    looking = Spool(crashed, LOG, max_bytes=PLENTY, drop=dropped, read_only=True)
    assert all_of(looking) == found
    looking.close()
    again = open_spool(crashed)
    assert all_of(again) == found
    assert again.last_digest == found[-1].header.digest
    again.close()


def test_a_disk_that_was_mounted_read_only_is_told(disk):
    open_spool(disk / "spool.sqlite").close()
    with disks.read_only(disk), pytest.raises(StoreError, match="cannot be opened: Read-only file system"):
        open_spool(disk / "spool.sqlite")


def test_a_disk_that_becomes_read_only_can_still_be_read(tmp_path):
    spool = open_spool(tmp_path / "spool.sqlite")
    made = list(chain(3))
    for one in made[:2]:
        spool.append(one)
    spool._store._db.run("PRAGMA query_only = ON")  # SQLite's own refusal, the one that a read-only file gets
    for write in (lambda: spool.append(made[2]), lambda: spool.confirmed(at(1)), lambda: spool.stored(at(1))):
        with pytest.raises(StoreError, match=r"readonly.*what was kept before is safe"):
            write()
    assert all_of(spool) == made[:2]
    spool._store._db.run("PRAGMA query_only = OFF")
    spool.append(made[2])
    assert all_of(spool) == made
    spool.close()
