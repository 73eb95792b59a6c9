"""The robot's spool: order, bounds, what a full spool gives up, files that are not what they should be."""

from __future__ import annotations

import os
import sqlite3
import stat
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest
from hypothesis import settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule, run_state_machine_as_test
from rosbridge_eth.spool import Spool

from bridge.chunks import STREAM, chain, chunk, dropped
from rosbridge_eth.errors import StoreError
from rosbridge_eth.log.chunk import Chunk, Log
from rosbridge_eth.log.database import InUse, NothingThere

LOG = Log(b"l" * 32, b"r" * 32)
OTHER = b"o" * 16
PLENTY = 1 << 30


@pytest.fixture
def path(tmp_path: Path) -> Path:
    return tmp_path / "spool.sqlite"


def open_spool(path: Path, max_bytes: int = PLENTY, **more) -> Spool:
    return Spool(path, LOG, max_bytes=max_bytes, drop=dropped, **more)


@pytest.fixture
def spool(path: Path) -> Iterator[Spool]:
    opened = open_spool(path)
    yield opened
    opened.close()


def fill(spool: Spool, count: int, **more) -> list[Chunk]:
    made = list(chain(count, previous=spool.last_digest, **more))
    for one in made:
        spool.append(one)
    return made


def numbers(chunks: list[Chunk]) -> list[int]:
    return [one.header.number for one in chunks]


# --- the log


def test_an_empty_spool_knows_nothing(spool):
    assert (spool.last_digest, spool.next_stream(b""), spool.next_stream(STREAM)) == (bytes(32), None, None)
    assert spool.following(STREAM, None, 1000) == []
    assert set(spool.statistics()) == {0}


def test_chunks_come_back_unchanged_in_the_order_of_the_log(spool):
    first = fill(spool, 3)
    second = fill(spool, 2, stream=bytes(16))  # its id sorts before
    assert spool.following(STREAM, None, PLENTY) == first
    assert spool.following(STREAM, 1, PLENTY) == first[2:]
    assert spool.following(STREAM, 2, PLENTY) == []
    assert spool.next_stream(b"") == (STREAM, 0, first[0].header.digest)
    assert spool.next_stream(STREAM) == (bytes(16), 0, second[0].header.digest)
    assert spool.next_stream(bytes(16)) is None
    assert spool.last_digest == second[-1].header.digest


def test_what_follows_is_given_up_to_a_size_and_at_least_one(spool):
    made = fill(spool, 5)
    size = len(made[0].encoded)
    assert numbers(spool.following(STREAM, None, 2 * size)) == [0, 1]
    assert numbers(spool.following(STREAM, None, 2 * size - 1)) == [0]
    assert numbers(spool.following(STREAM, 1, 0)) == [2]


def test_what_is_confirmed_leaves_with_all_before_it_and_the_last_digest_stays(path, spool):
    first, second = fill(spool, 3), fill(spool, 3, stream=OTHER)
    spool.confirmed(STREAM, 1)
    assert spool.next_stream(b"") == (STREAM, 2, first[2].header.digest)
    spool.confirmed(OTHER, 0)
    assert spool.next_stream(b"") == (OTHER, 1, second[1].header.digest)
    spool.confirmed(STREAM, 2)  # told again, of a stream that is gone
    assert spool.statistics().chunks == 2
    spool.confirmed(OTHER, 2**64 - 1)
    assert spool.next_stream(b"") is None
    spool.close()
    again = open_spool(path)
    assert again.last_digest == second[-1].header.digest
    again.close()


def test_what_the_server_has_is_still_sent_to_one_that_lost_it(spool):
    made = fill(spool, 3)
    spool.stored(STREAM, 1)
    assert spool.statistics().unstored == 1
    assert spool.following(STREAM, None, PLENTY) == made
    assert spool.next_stream(b"") == (STREAM, 0, made[0].header.digest)


def test_what_the_server_lost_waits_for_it_again(spool):
    made = fill(spool, 5)
    spool.append(bare := dropped(chunk(5, previous=made[-1].header.digest)))
    other = fill(spool, 1, stream=OTHER)
    spool.stored(STREAM, 5)
    spool.stored(OTHER, 0)
    assert spool.statistics().unstored == 0
    spool.lost(STREAM, 2)
    assert spool.statistics().unstored == 3
    spool.lost(STREAM, None)
    assert (spool.statistics().unstored, spool.following(STREAM, None, PLENTY)) == (6, [*made, bare])
    assert spool.following(OTHER, None, PLENTY) == other


def test_what_the_server_lost_is_not_what_a_full_spool_gives_up_first(path):
    spool = open_spool(path, 5300)
    made = fill(spool, 4, size=1000)
    spool.append(bare := dropped(chunk(4, size=1000)))
    spool.stored(STREAM, 4)
    spool.lost(STREAM, 1)
    fill(spool, 3, stream=OTHER, size=1000)
    assert spool.following(STREAM, None, PLENTY) == [*made[2:], bare]
    assert spool.statistics().dropped_bodies == 0
    fill(spool, 1, stream=b"3" * 16, size=1000)
    assert spool.following(STREAM, None, PLENTY) == [*map(dropped, made[2:]), bare]
    assert spool.statistics().dropped_bodies == 2
    spool.close()


def test_a_stream_that_is_gone_is_followed_by_the_oldest_there_is(spool):
    fill(spool, 2)
    spool.confirmed(STREAM, 1)
    rest = fill(spool, 2, stream=OTHER)
    assert spool.next_stream(STREAM) == (OTHER, 0, rest[0].header.digest)


def test_what_is_refused_is_set_aside_and_not_sent_again(spool):
    fill(spool, 4)
    spool.stored(STREAM, 3)  # as a server said that was put back from an old copy since
    rest = fill(spool, 1, stream=OTHER)
    assert spool.set_aside(STREAM, 2) == 2
    assert spool.set_aside(STREAM, 2) == 0
    assert numbers(spool.following(STREAM, None, PLENTY)) == [0, 1]
    assert spool.next_stream(STREAM) == (OTHER, 0, rest[0].header.digest)
    assert spool.statistics().aside == 2
    spool.confirmed(OTHER, 0)
    assert spool.statistics()[:1] == (2,)
    assert spool.next_stream(b"") is None


# --- the bound


def size_of(*chunks: Chunk) -> int:
    return sum(len(one.encoded) for one in chunks)


def test_a_full_spool_gives_up_what_the_server_has_first(path):
    one = size_of(chunk(0))
    spool = open_spool(path, 4 * one)
    fill(spool, 4)
    spool.stored(STREAM, 1)
    spool.append(chunk(4))
    spool.append(chunk(5))
    assert numbers(spool.following(STREAM, None, PLENTY)) == [2, 3, 4, 5]
    assert spool.statistics().dropped_bodies == 0
    spool.close()


def test_then_what_was_set_aside_which_counts_as_dropped(path):
    one = size_of(chunk(0))
    spool = open_spool(path, 4 * one)
    fill(spool, 4)
    spool.set_aside(STREAM, 3)
    spool.append(chunk(0, OTHER))
    statistics = spool.statistics()
    assert (statistics.aside, statistics.chunks) == (0, 4)
    assert statistics.dropped_bodies == 1
    spool.close()


def test_what_was_set_aside_without_its_body_is_not_counted_as_a_body_dropped_again(path):
    spool = open_spool(path, 2000)
    spool.append(dropped(chunk(0, size=1000)))
    spool.append(chunk(1, size=0))  # of an hour without records
    spool.set_aside(STREAM, 0)
    fill(spool, 2, stream=OTHER, size=1000)
    assert spool.statistics().dropped_bodies == 0
    spool.close()


def test_then_the_bodies_of_the_oldest_which_are_still_sent_in_the_form_that_was_signed_for_it(path):
    one = size_of(chunk(0, size=4000))
    spool = open_spool(path, 4 * one)
    made = fill(spool, 6, size=4000)
    sent = spool.following(STREAM, None, PLENTY)
    assert numbers(sent) == list(range(6))
    gone = [number for number, form in enumerate(sent) if form.bare]
    assert gone == list(range(len(gone)))
    assert sent == [dropped(made[n]) if n in gone else made[n] for n in range(6)]
    statistics = spool.statistics()
    assert statistics.dropped_bodies == len(gone)
    assert statistics.bytes == size_of(*sent) <= 4 * one
    assert statistics.unstored == 6
    spool.close()


def test_then_the_headers_of_the_oldest_so_that_bodies_keep_most_of_the_room(path):
    one = size_of(chunk(0, size=4000))
    spool = open_spool(path, 10 * one)
    fill(spool, 200, size=4000)
    sent = spool.following(STREAM, None, PLENTY)
    assert numbers(sent) == list(range(200 - len(sent), 200))
    whole = [form for form in sent if not form.bare]
    assert len(whole) >= 7
    statistics = spool.statistics()
    assert len(sent) < 200
    assert statistics.dropped_bodies == 200 - len(whole)
    spool.close()


def test_chunks_without_records_do_not_fill_it_for_ever(path):
    spool = open_spool(path, 20_000)
    for number in range(500):
        spool.append(chunk(number, size=0))
    statistics = spool.statistics()
    assert statistics.bytes <= 20_000
    assert statistics.dropped_bodies == 0
    spool.close()


def test_a_drop_that_fails_changes_nothing(path):
    def fails(whole: Chunk) -> Chunk:
        raise OSError("the token is gone")

    spool = Spool(path, LOG, max_bytes=2 * size_of(chunk(0)), drop=fails)
    made = fill(spool, 2)
    with pytest.raises(OSError, match="token"):
        spool.append(chunk(2))
    assert spool.following(STREAM, None, PLENTY) == made
    assert spool.last_digest == made[-1].header.digest
    spool.close()


# --- files


def test_the_file_is_for_its_owner_alone(path, spool):
    assert stat.S_IMODE(path.stat().st_mode) == 0o600


def test_a_second_process_is_refused_and_may_not_even_look(path, spool):
    source = f"""
from pathlib import Path
from rosbridge_eth.log.chunk import Log
from rosbridge_eth.log.database import InUse
from rosbridge_eth.spool import Spool
for read_only in (False, True):
    try:
        Spool(Path({str(path)!r}), Log({LOG.ledger!r}, {LOG.tk!r}), max_bytes=1, drop=None, read_only=read_only)
    except InUse as error:
        print(error)
"""
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(part for part in sys.path if part)}
    out = subprocess.run([sys.executable, "-c", source], env=environment, capture_output=True, text=True, check=True)
    assert out.stdout.count("in use by another process") == 2
    assert issubclass(InUse, StoreError)


def test_a_look_makes_and_changes_nothing(path):
    with pytest.raises(NothingThere):
        open_spool(path, read_only=True)
    assert list(path.parent.iterdir()) == []
    spool = open_spool(path)
    fill(spool, 3)
    spool.close()
    before = {file.name: file.read_bytes() for file in path.parent.iterdir()}
    looking = open_spool(path, read_only=True)
    assert looking.statistics().chunks == 3
    with pytest.raises(StoreError):
        looking.append(chunk(3))
    looking.close()
    assert {file.name: file.read_bytes() for file in path.parent.iterdir()} == before


def test_a_file_that_was_just_begun_has_nothing_to_look_at(path):
    path.touch()  # as a robot leaves it that is killed at its very first step
    with pytest.raises(NothingThere, match="there is no spool"):
        open_spool(path, read_only=True)
    sqlite3.connect(path).execute("PRAGMA journal_mode = WAL").connection.close()  # and at the next
    with pytest.raises(NothingThere, match="there is no spool"):
        open_spool(path, read_only=True)
    open_spool(path).close()


@pytest.mark.parametrize("log", [Log(LOG.ledger, b"x" * 32), Log(b"x" * 32, LOG.tk)])
def test_the_spool_of_another_robot_or_contract_is_refused(path, spool, log):
    spool.close()
    with pytest.raises(StoreError, match="another robot's, or for another contract"):
        Spool(path, log, max_bytes=PLENTY, drop=dropped)


def test_a_folder_that_is_not_there_is_told(tmp_path):
    with pytest.raises(StoreError, match="cannot be opened: No such file"):
        open_spool(tmp_path / "none" / "spool.sqlite")


def test_a_database_of_another_kind_is_refused_and_left_alone(path):
    other = sqlite3.connect(path)
    other.execute("CREATE TABLE mine (x)")
    other.commit()
    other.close()
    with pytest.raises(StoreError, match="is no spool"):
        open_spool(path)
    assert list(path.parent.glob("*damaged*")) == []


@pytest.mark.parametrize(("version", "says"), [(1, "first edition"), (99, "version 99")])
def test_one_of_the_first_edition_or_a_newer_one_is_refused_and_left_alone(path, spool, version, says):
    spool.close()
    other = sqlite3.connect(path)
    other.execute(f"PRAGMA user_version = {version}")
    other.close()
    before = path.read_bytes()
    with pytest.raises(StoreError, match=says):
        open_spool(path)
    assert path.read_bytes() == before


def _spoil_start(data: bytearray) -> None:
    data[:64] = os.urandom(64)


def _spoil_middle(data: bytearray) -> None:
    data[4096 : len(data) - 4096] = os.urandom(len(data) - 8192)


def _cut(data: bytearray) -> None:
    del data[len(data) // 2 :]


@pytest.mark.parametrize("spoil", [_spoil_start, _spoil_middle, _cut])
def test_a_damaged_spool_is_kept_aside_and_the_next_start_begins_anew(path, spoil):
    spool = open_spool(path)
    fill(spool, 60)
    spool.close()
    data = bytearray(path.read_bytes())
    spoil(data)
    path.write_bytes(data)
    with pytest.raises(StoreError, match=r"damaged.*kept as .*damaged-1.*start again"):
        open_spool(path)
    assert (path.parent / "spool.sqlite.damaged-1").read_bytes() == data
    spool = open_spool(path)
    assert (spool.next_stream(b""), spool.last_digest) == (None, bytes(32))
    spool.close()


# --- a model of it


class Model(RuleBasedStateMachine):
    """Against a list of [chunk, stored, aside]; the room is what differs the rules from a plain list."""

    LIMIT = 6000

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self.path = folder / "spool.sqlite"
        for file in folder.iterdir():
            file.unlink()
        self.spool = open_spool(self.path, self.LIMIT)
        self.rows: list[list] = []
        self.stream, self.number, self.last = bytes(16), 0, bytes(32)
        self.drops = 0

    def teardown(self) -> None:
        self.spool.close()

    @initialize()
    def begin(self) -> None:
        self.new_stream()

    @rule()
    def new_stream(self) -> None:
        self.stream, self.number = os.urandom(16), 0

    def _make_room(self, size: int) -> None:
        def held(rows: list[list]) -> int:
            return sum(len(row[0].encoded) for row in rows)

        while held(self.rows) > self.LIMIT - size:
            stored = [row for row in self.rows if row[1] and not row[2]]
            aside = [row for row in self.rows if row[2]]
            rest = [row for row in self.rows if not row[1] and not row[2]]
            bare, whole = [row for row in rest if not row[0].body], [row for row in rest if row[0].body]
            if stored:
                self.rows.remove(stored[0])
            elif aside:
                self.rows.remove(aside[0])
                self.drops += bool(aside[0][0].body)  # else it was counted when the body went
            elif whole and held(bare) <= held(self.rows) // 8:
                self.drops += 1
                whole[0][0] = dropped(whole[0][0])
            else:
                self.rows.remove(bare[0])

    @rule(size=st.sampled_from([400, 900, 2000]))
    def append(self, size: int) -> None:
        made = chunk(self.number, self.stream, size=size, previous=self.last)
        self.spool.append(made)
        self._make_room(len(made.encoded))
        self.rows.append([made, False, False])
        self.number, self.last = self.number + 1, made.header.digest

    def _place(self, data: st.DataObject) -> tuple[bytes, int]:
        known = [(row[0].header.stream, row[0].header.number) for row in self.rows]
        return data.draw(st.sampled_from([*known, (self.stream, self.number), (b"?" * 16, 3)]))

    @rule(data=st.data())
    def stored(self, data: st.DataObject) -> None:
        stream, number = self._place(data)
        self.spool.stored(stream, number)
        for row in self.rows:
            row[1] = row[1] or (not row[2] and row[0].header.stream == stream and row[0].header.number <= number)

    @rule(data=st.data())
    def confirmed(self, data: st.DataObject) -> None:
        stream, number = self._place(data)
        self.spool.confirmed(stream, number)
        upto = [i for i, (c, _, _) in enumerate(self.rows) if c.header.stream == stream and c.header.number <= number]
        if upto:
            self.rows = [row for i, row in enumerate(self.rows) if row[2] or i > upto[-1]]

    @rule(data=st.data())
    def set_aside(self, data: st.DataObject) -> None:
        stream, number = self._place(data)
        these = [r for r in self.rows if not r[2] and r[0].header.stream == stream and r[0].header.number >= number]
        assert self.spool.set_aside(stream, number) == len(these)
        for row in these:
            row[2] = True

    @rule()
    def start_again(self) -> None:
        self.spool.close()
        self.spool = open_spool(self.path, self.LIMIT)

    @invariant()
    def agree(self) -> None:
        sent = [row[0] for row in self.rows if not row[2]]
        first = self.spool.next_stream(b"")
        assert first == ((sent[0].header.stream, sent[0].header.number, sent[0].header.digest) if sent else None)
        found, place = [], first
        while place is not None:
            found += self.spool.following(place[0], None, PLENTY)
            place = self.spool.next_stream(place[0])
        assert found == sent
        assert self.spool.last_digest == self.last
        statistics = self.spool.statistics()
        assert statistics[:3] == (
            len(self.rows), sum(r[0].header.records for r in self.rows), sum(len(r[0].encoded) for r in self.rows),
        )
        assert statistics.unstored == sum(1 for r in self.rows if not r[1] and not r[2])
        assert statistics.aside == sum(r[2] for r in self.rows)
        assert statistics.dropped_bodies == self.drops


def test_any_sequence_of_calls_agrees_with_a_plain_list(tmp_path):
    run_state_machine_as_test(lambda: Model(tmp_path), settings=settings(stateful_step_count=25))
