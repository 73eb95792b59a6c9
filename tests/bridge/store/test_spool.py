"""The robot's spool: what it keeps through crashes, full disks and its own bound, and what it says of the rest."""

from __future__ import annotations

import os
import random
import shutil
import sqlite3
import stat
import subprocess
import sys
import textwrap
from contextlib import nullcontext
from functools import partial

import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule, run_state_machine_as_test

from bridge.store.disks import fill_up
from rosbridge_eth.errors import StoreError
from rosbridge_eth.records import RecordId, SealedRecord, SeqRange
from rosbridge_eth.store import Delivery, Spool, SpoolFull, SpoolLimits

ROBOT, S1, S2 = b"r" * 32, b"1" * 16, b"2" * 16
RELIABLE, LATEST = Delivery.RELIABLE, Delivery.LATEST
SOON = SpoolLimits(group=1)  # each append is committed


def record(seq: int, stream: bytes = S1, size: int = 256) -> SealedRecord:
    return SealedRecord(RecordId(ROBOT, stream, seq), seq.to_bytes(8, "big").ljust(size, b"."))


def fill(spool: Spool, seqs, delivery: Delivery = RELIABLE, now: float = 0.0, **more) -> None:
    for seq in seqs:
        spool.append([record(seq)], delivery, now, **more)


def seqs(records) -> list[int]:
    return [item.id.seq for item in records]


def undeclared(spool: Spool) -> list[SeqRange]:
    """What a gap record would say now, without saying it."""
    seen: list[SeqRange] = []

    class Looked(Exception):
        pass

    def look(ranges):
        seen.extend(ranges)
        raise Looked

    with pytest.raises(Looked) if spool.statistics.undeclared else nullcontext():
        spool.declare(look, 0.0)
    return sorted(seen)


@pytest.fixture
def path(tmp_path):
    return tmp_path / "spool.db"


@pytest.fixture
def spool(path):
    with Spool(path, ROBOT, SOON) as opened:
        yield opened


def test_records_come_out_in_order_and_leave_when_acknowledged(spool):
    fill(spool, range(5))
    first = spool.pending(3)
    assert [*first, *spool.pending(9)] == [record(n) for n in range(5)]
    assert spool.pending(9) == []
    spool.acknowledged([item.id for item in first], 0.0)
    spool.returned()
    assert seqs(spool.pending(9)) == [3, 4]


def test_a_session_that_ends_gives_back_what_was_not_acknowledged(spool):
    fill(spool, range(6))
    spool.pending(4)
    spool.acknowledged([record(1).id], 0.0)
    spool.returned([record(3).id, record(0).id])
    assert seqs(spool.pending(2)) == [0, 3]
    spool.returned()
    assert seqs(spool.pending(9)) == [0, 2, 3, 4, 5]


def test_limits_of_what_is_handed_out(spool):
    fill(spool, range(4))
    assert seqs(spool.pending(9, max_bytes=600)) == [0, 1]
    assert seqs(spool.pending(1, max_bytes=1)) == [2]


def test_acknowledging_what_was_never_handed_out_does_nothing(spool):
    fill(spool, range(2))
    spool.acknowledged([record(0).id, record(77).id], 0.0)
    assert seqs(spool.pending(9)) == [0, 1]


def test_only_what_is_committed_is_handed_out(path):
    with Spool(path, ROBOT, SpoolLimits(group=3, window=0.05)) as spool:
        fill(spool, [0, 1], now=10.0)
        assert spool.next_commit() == pytest.approx(10.05)
        assert spool.pending(9) == []
        spool.commit(10.04)
        assert spool.pending(9) == []
        spool.commit(10.05)
        assert seqs(spool.pending(9)) == [0, 1]
        assert spool.next_commit() is None
        fill(spool, [2, 3, 4], now=11.0)  # a full group does not wait
        assert seqs(spool.pending(9)) == [2, 3, 4]


def test_closing_writes_the_group(path):
    with Spool(path, ROBOT) as spool:
        fill(spool, range(3))
    with Spool(path, ROBOT) as spool:
        assert seqs(spool.pending(9)) == [0, 1, 2]
        assert spool.last == record(2).id


# --- latest


def test_a_newer_one_supersedes_what_was_not_sent_of_its_lane(spool):
    spool.append([record(0), record(1)], LATEST, 0.0, lane=1)
    fill(spool, [2], LATEST, lane=2)
    fill(spool, [3, 4], LATEST, lane=1)
    fill(spool, [5], LATEST, lane=2)
    assert seqs(spool.pending(9)) == [0, 4, 5]
    assert undeclared(spool) == [SeqRange(S1, 1, 3)]
    assert spool.statistics.superseded == 3


def test_what_is_on_its_way_is_not_superseded(spool):
    fill(spool, [1], LATEST, lane=1)
    spool.pending(9)
    fill(spool, [2], LATEST, lane=1)
    assert undeclared(spool) == []
    spool.returned([record(1).id])
    fill(spool, [3], LATEST, lane=1)
    assert undeclared(spool) == [SeqRange(S1, 2, 2)]


def test_supersession_within_a_group_that_is_not_written_yet(path):
    with Spool(path, ROBOT) as spool:
        fill(spool, [1, 2, 3], LATEST, lane=1)
        assert undeclared(spool) == [SeqRange(S1, 1, 2)]
    with Spool(path, ROBOT) as spool:
        assert seqs(spool.pending(9)) == [3]
        assert undeclared(spool) == [SeqRange(S1, 1, 2)]


# --- the bound


def test_at_the_bound_the_oldest_goes_and_is_noted(path):
    with Spool(path, ROBOT, SpoolLimits(records=3, group=1)) as spool:
        fill(spool, range(1, 6))
        assert seqs(spool.pending(9)) == [3, 4, 5]
        assert undeclared(spool) == [SeqRange(S1, 1, 2)]
        spool.commit(5.0)
        assert spool.next_commit() is None  # that is written already, and not again


def test_bytes_bound_as_well(path):
    with Spool(path, ROBOT, SpoolLimits(bytes=1024, group=1)) as spool:
        fill(spool, range(1, 5))
        spool.append([record(5, size=700)], RELIABLE, 0.0)
        assert seqs(spool.pending(9)) == [4, 5]
        with pytest.raises(SpoolFull):
            spool.append([record(6, size=1025)], RELIABLE, 0.0)
        assert undeclared(spool) == [SeqRange(S1, 1, 3), SeqRange(S1, 6, 6)]
        assert spool.statistics.bytes == 256 + 700


def test_latest_makes_room_for_reliable_and_not_the_other_way(path):
    with Spool(path, ROBOT, SpoolLimits(records=3, group=1)) as spool:
        fill(spool, [1])
        fill(spool, [2], LATEST, lane=1)
        fill(spool, [3, 4])
        assert undeclared(spool) == [SeqRange(S1, 2, 2)]
        with pytest.raises(SpoolFull):
            fill(spool, [5], LATEST, lane=1)
        assert seqs(spool.pending(9)) == [1, 3, 4]
        assert undeclared(spool) == [SeqRange(S1, 2, 2), SeqRange(S1, 5, 5)]


def test_control_records_are_never_dropped_and_take_no_room(path):
    with Spool(path, ROBOT, SpoolLimits(records=1, group=1)) as spool:
        for stream in (S1, S2):
            spool.append([record(0, stream), record(1, stream)], RELIABLE, 0.0)
        spool.append([record(2, S2)], Delivery.CONTROL, 0.0)
        assert [(i.id.stream, i.id.seq) for i in spool.pending(9)] == [(S1, 0), (S2, 0), (S2, 1), (S2, 2)]
        assert undeclared(spool) == [SeqRange(S1, 1, 1)]


def test_what_is_dropped_is_not_handed_out_although_that_is_not_written_yet(path):
    with Spool(path, ROBOT, SpoolLimits(records=2, window=1.0)) as spool:
        fill(spool, [1, 2])
        spool.commit(1.0)
        fill(spool, [3], now=2.0)
        assert seqs(spool.pending(9)) == [2]
        spool.commit(3.0)
        assert seqs(spool.pending(9)) == [3]


def test_dropped_while_on_its_way(path):
    """The acknowledgement of a record that was dropped meanwhile does no harm."""
    with Spool(path, ROBOT, SpoolLimits(records=2, group=1)) as spool:
        fill(spool, [1, 2])
        spool.pending(9)
        fill(spool, [3])
        spool.acknowledged([record(1).id, record(2).id], 0.0)
        assert spool.statistics.records == 1
        assert seqs(spool.pending(9)) == [3]


# --- gaps


def test_a_declared_gap_is_kept_and_not_declared_again(path):
    with Spool(path, ROBOT, SpoolLimits(records=2, group=1)) as spool:
        fill(spool, range(1, 6))
        given = []

        def seal(ranges):
            given.extend(ranges)
            return [record(6)]

        assert spool.declare(seal, 0.0)
        assert given == [SeqRange(S1, 1, 3)]
        assert not spool.declare(seal, 0.0)
        fill(spool, [7])
        assert undeclared(spool) == [SeqRange(S1, 4, 4)]
    with Spool(path, ROBOT) as spool:
        assert undeclared(spool) == [SeqRange(S1, 4, 4)]
        assert seqs(spool.pending(9)) == [5, 6, 7]


def test_a_gap_that_cannot_be_sealed_stays_undeclared(path):
    with Spool(path, ROBOT, SpoolLimits(records=1, group=1)) as spool:
        fill(spool, [1, 2])

        def fail(ranges):
            raise OSError("token removed")

        with pytest.raises(OSError, match="token"):
            spool.declare(fail, 0.0)
        assert undeclared(spool) == [SeqRange(S1, 1, 1)]


# --- files


def test_the_file_is_for_its_owner_alone(path, spool):
    assert stat.S_IMODE(path.stat().st_mode) == 0o600


def test_a_second_process_is_refused(path, spool):
    with pytest.raises(StoreError, match="in use by another process"):
        Spool(path, ROBOT)


def test_another_robots_spool_is_refused(path, spool):
    spool.close()
    with pytest.raises(StoreError, match="another robot's"):
        Spool(path, b"x" * 32)


def test_a_folder_that_is_not_there_is_told(tmp_path):
    with pytest.raises(StoreError, match="cannot be opened"):
        Spool(tmp_path / "none" / "spool.db", ROBOT)


def test_a_database_of_another_kind_is_refused_and_left_alone(path):
    other = sqlite3.connect(path)
    other.execute("CREATE TABLE mine (x)")
    other.commit()
    other.close()
    with pytest.raises(StoreError, match="no spool"):
        Spool(path, ROBOT)
    assert list(path.parent.glob("*damaged*")) == []


def test_a_newer_version_is_refused_and_left_alone(path, spool):
    spool.close()
    other = sqlite3.connect(path)
    other.execute("PRAGMA user_version = 99")
    other.close()
    with pytest.raises(StoreError, match="version 99"):
        Spool(path, ROBOT)


def _spoil_start(data: bytearray) -> None:
    data[:64] = os.urandom(64)


def _spoil_middle(data: bytearray) -> None:
    data[4096 : len(data) - 4096] = os.urandom(len(data) - 8192)


def _cut(data: bytearray) -> None:
    del data[len(data) // 2 :]


@pytest.mark.parametrize("spoil", [_spoil_start, _spoil_middle, _cut])
def test_a_damaged_spool_is_kept_aside_and_the_next_start_begins_anew(path, spoil):
    with Spool(path, ROBOT) as spool:
        fill(spool, range(200))
    data = bytearray(path.read_bytes())
    spoil(data)
    path.write_bytes(data)
    with pytest.raises(StoreError, match=r"damaged.*kept as .*damaged-1.*start again"):
        Spool(path, ROBOT)
    assert (path.parent / "spool.db.damaged-1").read_bytes() == data
    with Spool(path, ROBOT) as spool:
        assert (spool.pending(9), spool.last) == ([], None)


def test_a_full_disk_takes_nothing_new_loses_nothing_old_and_recovers(small_disk):
    with Spool(small_disk / "spool.db", ROBOT, SpoolLimits(group=1, unwritten=20)) as spool:
        fill(spool, range(20))
        ballast = fill_up(small_disk)
        refused = []
        for seq in range(20, 5000):
            try:
                fill(spool, [seq], now=float(seq))
            except SpoolFull as error:
                assert "full" in str(error)
                refused.append(seq)
        assert refused
        assert "make room" in spool.statistics.trouble
        kept = [n for n in range(5000) if n not in refused]
        assert set(seqs(spool.pending(9999))) <= set(kept)
        ballast.unlink()
        spool.commit(9000.0)
        assert spool.statistics.trouble is None
        spool.returned()
        assert seqs(spool.pending(9999)) == kept
        assert [n for part in undeclared(spool) for n in range(part.first, part.last + 1)] == refused
        fill(spool, [5000], now=9001.0)
        assert seqs(spool.pending(9)) == [5000]
        assert spool.last == record(5000).id


@pytest.mark.parametrize("at_once", [9, 100, 9999])
def test_a_disk_that_the_spool_itself_filled_is_drained_by_acknowledgements(small_disk, at_once):
    """Removing takes room as well, of which there is none; nobody helps."""
    with Spool(small_disk / "spool.db", ROBOT, SpoolLimits(group=1, unwritten=20)) as spool:
        with pytest.raises(SpoolFull):
            fill(spool, range(1, 5000))
        full_at = spool.last.seq
        now = 0.0
        while sent := spool.pending(at_once):
            now += 5
            spool.acknowledged([item.id for item in sent], now)
            spool.commit(now + 2)
        assert spool.statistics.trouble is None
        assert undeclared(spool) == [SeqRange(S1, full_at, full_at)]
        assert spool.statistics.records == 0
        fill(spool, [full_at + 1], now=now)
        assert seqs(spool.pending(9)) == [full_at + 1]


def test_a_crash_on_a_full_disk_forgets_what_was_only_in_memory(small_disk, path):
    """The newest record that the file knows is one that it has: those in memory were never sent."""
    with Spool(small_disk / "spool.db", ROBOT, SpoolLimits(group=1, unwritten=20)) as spool:
        with pytest.raises(SpoolFull):
            fill(spool, range(1, 5000))
        shutil.copytree(small_disk, path.parent / "as the crash left it")
        kept, full_at = seqs(spool.pending(9999)), spool.last.seq
        spool.acknowledged([record(n).id for n in kept], 100.0)
    with Spool(path.parent / "as the crash left it" / "spool.db", ROBOT) as spool:
        assert seqs(spool.pending(9999)) == kept
        assert spool.last.seq == kept[-1] == full_at - 21


# --- crashes

CHILD = """
import sys
from rosbridge_eth.records import RecordId, SealedRecord
from rosbridge_eth.store import Delivery, Spool, SpoolLimits
spool = Spool(sys.argv[1], b"r" * 32, SpoolLimits(group=7, records=60))
stream, now = sys.argv[2].encode() * 16, 0.0
print("last", spool.last.seq if spool.last else -1, flush=True)
for seq in range(1, 100_000):
    now += 0.001
    delivery = (Delivery.RELIABLE, Delivery.LATEST, Delivery.RELIABLE)[seq % 3]
    spool.append([SealedRecord(RecordId(b"r" * 32, stream, seq), b"%08d" % seq)], delivery, now, lane=seq % 2)
    sent = spool.pending(2)
    for record in sent:
        print("sent", record.id.seq, flush=True)
    if seq % 5 == 0:
        spool.acknowledged([record.id for record in sent], now)
        for record in sent:
            print("gone", record.id.seq, flush=True)
"""


@pytest.mark.parametrize("seed", range(5))
def test_after_kill_9_every_record_is_there_or_acknowledged_or_to_be_declared(path, seed):
    """And the newest record that was ever sent is no newer than what the next `open` would name as the last."""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(part for part in sys.path if part)}
    command = [sys.executable, "-c", textwrap.dedent(CHILD), str(path), "1"]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True, env=environment)
    lines, wanted = [], random.Random(seed).randrange(20, 900)
    for line in process.stdout:
        if line.endswith("\n"):
            lines.append(line.split())
        if len(lines) >= wanted:
            process.kill()
    process.wait(timeout=60)
    sent = {int(number) for word, number in lines if word == "sent"}
    gone = {int(number) for word, number in lines if word == "gone"}
    with Spool(path, ROBOT) as spool:
        left = set(seqs(spool.pending(10_000)))
        gaps = {n for part in undeclared(spool) for n in range(part.first, part.last + 1)}
        last = spool.last.seq
    assert max(sent, default=0) <= last, f"seed {seed}"
    assert set(range(1, last + 1)) <= left | gaps | gone | sent, f"seed {seed}"
    # What was neither acknowledged nor declared has to be there still (the child may die before it says "gone").
    assert not (set(range(1, last + 1)) - left - gaps) - sent, f"seed {seed}"
    assert max(left) <= last


# --- any sequence of calls, against a model


class SpoolMachine(RuleBasedStateMachine):
    """Every seq that was ever given to the spool is in exactly one place: kept, acknowledged, or to be declared."""

    LIMITS = SpoolLimits(records=6, bytes=6 * 300, group=4, window=1.0)

    def __init__(self, folder):
        super().__init__()
        self.path = folder / "spool.db"

    @initialize()
    def begin(self):
        for path in self.path.parent.glob("spool.db*"):
            path.unlink()
        self.now, self.seq = 0.0, 0
        self.spool = Spool(self.path, ROBOT, self.LIMITS)
        self.alive: set[int] = set()  # kept, as far as the model can tell
        self.control: set[int] = set()
        self.handed: set[int] = set()
        self.done: set[int] = set()
        self.declared: set[int] = set()
        self.written_to = 0

    def teardown(self):
        if hasattr(self, "spool"):
            self.spool.close()

    @rule(delivery=st.sampled_from([RELIABLE, RELIABLE, LATEST, Delivery.CONTROL]), lane=st.integers(0, 1),
          size=st.integers(8, 400))
    def append(self, delivery, lane, size):
        self.seq += 1
        try:
            self.spool.append([record(self.seq, size=size)], delivery, self.now, lane)
        except SpoolFull:
            assert delivery is not Delivery.CONTROL
        if delivery is Delivery.CONTROL:
            self.control.add(self.seq)

    @rule(limit=st.integers(1, 4))
    def pending(self, limit):
        got = seqs(self.spool.pending(limit))
        assert not set(got) & (self.handed | self.done | self.gaps())
        self.handed |= set(got)

    @rule(data=st.data())
    def acknowledge(self, data):
        some = data.draw(st.sets(st.sampled_from(sorted(self.handed)))) if self.handed else set()
        before = self.gaps()
        self.spool.acknowledged([record(n).id for n in some], self.now)
        self.handed -= some
        self.done |= some - before

    @rule()
    def returned(self):
        self.spool.returned()
        self.handed.clear()

    @rule()
    def declare(self):
        def seal(ranges):
            self.seq += 1
            self.control.add(self.seq)
            self.declared |= {n for part in ranges for n in range(part.first, part.last + 1)}
            return [record(self.seq)]

        self.spool.declare(seal, self.now)

    @rule(seconds=st.floats(0, 2))
    def wait(self, seconds):
        self.now += seconds
        self.spool.commit(self.now)

    @rule()
    def reopen(self):
        self.spool.close()
        self.spool = Spool(self.path, ROBOT, self.LIMITS)
        self.handed.clear()

    def gaps(self):
        return {n for part in undeclared(self.spool) for n in range(part.first, part.last + 1)} | self.declared

    @invariant()
    def nothing_is_unaccounted_for(self):
        if not hasattr(self, "spool"):
            return
        if self.seq:
            assert self.spool.last == record(self.seq).id
        gaps, stats = self.gaps(), self.spool.statistics
        assert not gaps & self.control
        assert not gaps & self.done
        assert stats.records <= self.LIMITS.records
        assert stats.bytes <= self.LIMITS.bytes
        kept = set(range(1, self.seq + 1)) - gaps - self.done
        assert stats.records == len(kept - self.control)

    @rule()
    def all_that_is_kept_comes_out(self):
        self.now += 10
        self.spool.commit(self.now)
        self.returned()
        kept = set(range(1, self.seq + 1)) - self.gaps() - self.done
        assert seqs(self.spool.pending(10_000)) == sorted(kept)
        self.handed = kept


def test_any_sequence_of_calls_leaves_nothing_unaccounted_for(tmp_path):
    run_state_machine_as_test(
        partial(SpoolMachine, tmp_path),
        settings=settings(
            max_examples=80, stateful_step_count=40, deadline=None, suppress_health_check=list(HealthCheck)
        ),
    )
