"""What is SQLite's own about the inbox in a file: permissions, damage, versions, a full disk."""

from __future__ import annotations

import os
import sqlite3
import stat

import pytest

from bridge.store.disks import fill_up
from rosbridge_eth.errors import StoreError
from rosbridge_eth.records import RecordId, SealedRecord
from rosbridge_eth.store import Outcome, SqliteInbox, State

T0 = 1_763_690_000.0


def record(seq: int, size: int = 256) -> SealedRecord:
    return SealedRecord(RecordId(b"r" * 32, b"s" * 16, seq), seq.to_bytes(8, "big").ljust(size, b"."))


@pytest.fixture
def path(tmp_path):
    return tmp_path / "inbox.db"


def test_the_file_is_for_its_owner_alone(path):
    with SqliteInbox(path) as inbox:
        inbox.append([record(0)], T0)
        modes = {stat.S_IMODE(file.stat().st_mode) for file in path.parent.iterdir()}
    assert modes == {0o600}


def test_it_is_durable_the_way_it_claims(path):
    with SqliteInbox(path) as inbox:
        db = inbox._db
        assert db.execute("PRAGMA journal_mode").fetchone() == ("wal",)
        assert db.execute("PRAGMA synchronous").fetchone() == (2,)  # FULL


@pytest.mark.parametrize("name", ["missing/inbox.db", "."])
def test_a_place_where_no_file_can_be_is_told(tmp_path, name):
    with pytest.raises(StoreError, match="cannot be opened"):
        SqliteInbox(tmp_path / name)


def test_damage_is_told_with_the_way_out_and_the_file_is_left_where_it_is(path):
    """Other processes may have it open, so it is not moved from under them."""
    with SqliteInbox(path) as inbox:
        inbox.append([record(n) for n in range(200)], T0)
    data = bytearray(path.read_bytes())
    data[4096:-4096] = os.urandom(len(data) - 8192)
    path.write_bytes(data)
    with pytest.raises(StoreError, match=r"damaged.*stop every process.*move it.*start again"):
        SqliteInbox(path)
    assert path.read_bytes() == data


def test_a_file_that_is_no_database(path):
    path.write_bytes(b"not a database, " * 999)
    with pytest.raises(StoreError, match="damaged"):
        SqliteInbox(path)


def test_a_spool_is_no_inbox(path):
    db = sqlite3.connect(path)
    db.execute("CREATE TABLE record (x)")
    db.execute("PRAGMA application_id = 1380078416")
    db.close()
    with pytest.raises(StoreError, match="no inbox"):
        SqliteInbox(path)


def test_a_newer_version_is_refused(path):
    SqliteInbox(path).close()
    db = sqlite3.connect(path)
    db.execute("PRAGMA user_version = 2")
    db.close()
    with pytest.raises(StoreError, match="version 2; this program knows 1"):
        SqliteInbox(path)


def test_a_full_disk_acknowledges_nothing_loses_nothing_and_recovers(small_disk):
    with SqliteInbox(small_disk / "inbox.db") as inbox:
        inbox.append([record(n) for n in range(50)], T0)
        ballast = fill_up(small_disk)
        taken = 50
        with pytest.raises(StoreError, match="full"):
            for taken in range(50, 2000):
                inbox.append([record(taken)], T0)
        assert inbox.state(record(0).id, T0) is State.WAITING
        assert inbox.state(record(taken).id, T0) is State.UNKNOWN
        ballast.unlink()
        assert inbox.append([record(taken), record(0)], T0) == [Outcome.NEW, Outcome.DUPLICATE]
        assert inbox.statistics(T0).waiting == taken + 1


def test_a_failed_append_leaves_no_trace_of_a_new_stream(small_disk):
    """The numbers given to a robot and a stream in a transaction that failed are not used afterwards."""
    with SqliteInbox(small_disk / "inbox.db") as inbox:
        ballast = fill_up(small_disk)
        ids = [RecordId(bytes([n]) * 32, b"s" * 16, seq) for n in range(40) for seq in (0, 1)]
        new = [SealedRecord(id, bytes(20_000)) for id in ids]
        with pytest.raises(StoreError, match="full"):
            inbox.append(new, T0)
        ballast.unlink()
        kept = new[9::-1]  # in another order, so that the numbers are others
        assert inbox.append(kept, T0) == [Outcome.NEW] * 10
        for robot in {one.id.robot for one in kept}:
            leased = inbox.lease("c", limit=9, max_bytes=1 << 20, now=T0, ttl=9, robot=robot)
            assert [item.record.id for item in leased] == sorted(one.id for one in kept if one.id.robot == robot)
