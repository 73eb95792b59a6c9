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

from bridge.chunks import chain, chunk, dropped
from rosbridge_eth.errors import StoreError
from rosbridge_eth.log.chunk import Chunk, Log
from rosbridge_eth.log.database import InUse, NothingThere
from rosbridge_eth.log.store import NO_DIGEST, NOWHERE, place_of
from rosbridge_eth.robot.spool import Spool

LOG = Log(b"l" * 32, b"r" * 32)
OTHER = b"t" * 16
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


def all_of(spool: Spool) -> list[Chunk]:
    return [Chunk.parse(one) for one in spool.chunks([row.place for row in spool.rows(NOWHERE, PLENTY)])]


def place(one: Chunk) -> bytes:
    return place_of(one.header)


def numbers(chunks: list[Chunk]) -> list[int]:
    return [one.header.number for one in chunks]


# --- the log


def test_an_empty_spool_knows_nothing(spool):
    assert (spool.newest, spool.last_digest, all_of(spool)) == (NOWHERE, NO_DIGEST, [])
    assert set(spool.statistics()) == {0}
    assert spool.place(NO_DIGEST) is None


def test_chunks_come_back_unchanged_in_the_order_of_the_log(spool):
    first = fill(spool, 3)
    second = fill(spool, 2, stream=OTHER)
    assert all_of(spool) == [*first, *second]
    assert [row.place for row in spool.rows(place(first[1]), 2)] == [place(first[2]), place(second[0])]
    assert (spool.newest, spool.last_digest) == (place(second[1]), second[1].header.digest)
    assert all(spool.place(one.header.digest) == place(one) for one in (*first, *second))


def test_what_is_confirmed_leaves_with_all_before_it_and_what_the_next_chunk_needs_stays(path, spool):
    first, second = fill(spool, 40), fill(spool, 3, stream=OTHER)
    assert spool.confirmed(place(first[1])) == 2
    assert all_of(spool) == [*first[1:], *second]
    assert spool.confirmed(place(second[0])) == 39
    assert spool.confirmed(place(first[2])) == spool.confirmed(place(second[0])) == 0  # told again
    assert all_of(spool) == second
    assert spool.confirmed(OTHER + b"\xff" * 8) == 2
    spool.close()
    again = open_spool(path)
    assert (again.newest, again.last_digest) == (place(second[-1]), second[-1].header.digest)
    made = fill(again, 2, stream=b"u" * 16)
    assert all_of(again) == [second[-1], *made]
    assert again.statistics()[:4] == (2, 10, size_of(*made), 2)
    again.close()


def test_what_the_servers_head_covers_is_still_here_and_does_not_wait(path, spool):
    made = fill(spool, 5)
    assert spool.statistics().unstored == 5
    spool.stored(place(made[3]))
    assert (spool.statistics().unstored, all_of(spool)) == (1, made)
    spool.stored(place(made[0]))  # of a server whose store was put back
    assert spool.statistics().unstored == 4
    spool.close()
    again = open_spool(path)
    assert again.statistics().unstored == 4
    again.close()


def test_what_the_server_lost_is_not_what_a_full_spool_gives_up_first(path):
    spool = open_spool(path, 5300)
    made = fill(spool, 4, size=1000)
    spool.append(bare := dropped(chunk(4, size=1000, previous=spool.last_digest)))
    spool.stored(place(bare))
    spool.stored(place(made[1]))
    fill(spool, 3, stream=OTHER, size=1000)
    assert all_of(spool)[:3] == [*made[2:], bare]
    assert spool.statistics().dropped_bodies == 0
    fill(spool, 1, stream=b"u" * 16, size=1000)
    assert all_of(spool)[:3] == [*map(dropped, made[2:]), bare]
    assert spool.statistics().dropped_bodies == 2
    spool.close()


@pytest.mark.parametrize("full", [False, True])
@pytest.mark.parametrize("at", [0, 10, 138])
def test_a_chunk_that_the_disk_changed_keeps_nothing_from_going_on(path, at, full):
    """at: which byte: version, place, number of grants."""
    spool = open_spool(path, 5300)
    made = fill(spool, 4, size=1000)
    spool.close()
    changed = bytearray(made[0].encoded)
    changed[at] ^= 1
    with sqlite3.connect(path) as disk:
        disk.execute("UPDATE chunk SET chunk = ? WHERE digest = ?", (bytes(changed), made[0].header.digest))
    disk.close()
    spool = open_spool(path, 5300)
    assert spool.chunk(place(made[0]), made[0].header.digest) is None
    assert spool.chunk(place(made[1]), made[1].header.digest) == made[1]
    if full:
        spool.append(chunk(0, OTHER, size=1900, previous=spool.last_digest))
    else:
        assert spool.confirmed(place(made[0])) == 1 and spool.confirmed(place(made[0])) == 0
    assert numbers(all_of(spool))[:3] == [1, 2, 3]
    spool.close()


def test_what_is_refused_is_set_aside_and_not_sent_again(path, spool):
    made = fill(spool, 4)
    assert spool.set_aside(made[2].header.digest) == place(made[2])
    assert spool.set_aside(made[2].header.digest) is None
    assert spool.place(made[2].header.digest) is None
    assert all_of(spool) == [*made[:2], made[3]]
    assert (spool.statistics().aside, spool.statistics().chunks) == (1, 3)
    spool.confirmed(spool.newest)
    spool.close()
    again = open_spool(path)
    assert (again.statistics().aside, again.statistics().chunks, len(all_of(again))) == (1, 0, 1)
    again.close()


# --- the bound


def size_of(*chunks: Chunk) -> int:
    return sum(len(one.encoded) for one in chunks)


def test_a_full_spool_gives_up_what_the_server_has_first(path):
    one = size_of(chunk(0))
    spool = open_spool(path, 4 * one)
    fill(spool, 4)
    spool.stored(spool.rows(NOWHERE, 2)[1].place)
    fill(spool, 2, stream=OTHER)
    assert numbers(all_of(spool)) == [2, 3, 0, 1]
    assert spool.statistics().dropped_bodies == 0
    spool.close()


def test_then_what_was_set_aside_which_counts_as_dropped(path):
    one = size_of(chunk(0))
    spool = open_spool(path, 4 * one)
    fill(spool, 4)
    spool.set_aside(spool.last_digest)
    fill(spool, 1, stream=OTHER)
    statistics = spool.statistics()
    assert (statistics.aside, statistics.chunks) == (0, 4)
    assert statistics.dropped_bodies == 1
    spool.close()


def test_then_the_bodies_of_the_oldest_which_are_still_sent_in_the_form_that_was_signed_for_it(path):
    one = size_of(chunk(0, size=4000))
    spool = open_spool(path, 4 * one)
    made = fill(spool, 6, size=4000)
    sent = all_of(spool)
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
    sent = all_of(spool)
    assert numbers(sent) == list(range(200 - len(sent), 200))
    whole = [form for form in sent if not form.bare]
    assert len(whole) >= 7
    statistics = spool.statistics()
    assert len(sent) < 200
    assert statistics.dropped_bodies == 200 - len(whole)
    spool.close()


def test_chunks_without_records_do_not_fill_it_for_ever(path):
    spool = open_spool(path, 20_000)
    fill(spool, 500, size=0)
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
    assert all_of(spool) == made
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
from rosbridge_eth.robot.spool import Spool
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
    fill(spool, 1)
    spool.close()
    with pytest.raises(StoreError, match=r"another robot's; what|for another contract"):
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


@pytest.mark.parametrize("version", [1, 99])
def test_one_of_the_first_edition_or_a_newer_one_is_refused_and_left_alone(path, spool, version):
    spool.close()
    other = sqlite3.connect(path)
    other.execute(f"PRAGMA user_version = {version}")
    other.close()
    before = path.read_bytes()
    with pytest.raises(StoreError, match="is no spool of version 2"):
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
    assert (all_of(spool), spool.last_digest) == ([], bytes(32))
    spool.close()


# --- a model of it


class Model(RuleBasedStateMachine):
    """Against a list of chunks, what the server has, and what is set aside; the room is what makes it no plain list."""

    LIMIT = 6000

    def __init__(self, folder: Path) -> None:
        super().__init__()
        self.path = folder / "spool.sqlite"
        for file in folder.iterdir():
            file.unlink()
        self.spool = open_spool(self.path, self.LIMIT)
        self.rows: list[Chunk] = []
        self.aside: list[Chunk] = []
        self.covered, self.last, self.confirmed_to = NOWHERE, NO_DIGEST, NOWHERE
        self.stream, self.number, self.drops = 0, 0, 0

    def teardown(self) -> None:
        self.spool.close()

    @initialize()
    def begin(self) -> None:
        self.new_stream()

    @rule()
    def new_stream(self) -> None:
        self.stream, self.number = self.stream + 1, 0

    def _make_room(self, size: int) -> None:
        while size_of(*self.rows, *self.aside) > max(0, self.LIMIT - size):
            whole = [i for i, one in enumerate(self.rows) if one.body]
            ahead = self.rows[: whole[0]] if whole else self.rows
            if self.rows and place(self.rows[0]) <= self.covered:
                del self.rows[0]
            elif self.aside:
                self.drops += len(self.aside)
                self.aside = []
            elif whole and size_of(*ahead) <= size_of(*self.rows, *self.aside) // 8:
                self.drops += 1
                self.rows[whole[0]] = dropped(self.rows[whole[0]])
            else:
                del self.rows[0]

    @rule(size=st.sampled_from([400, 900, 2000]))
    def append(self, size: int) -> None:
        made = chunk(self.number, self.stream.to_bytes(16, "big"), size=size, previous=self.last)
        self.spool.append(made)
        self._make_room(len(made.encoded))
        self.rows.append(made)
        self.number, self.last = self.number + 1, made.header.digest

    def _place(self, data: st.DataObject) -> bytes:
        return data.draw(st.sampled_from([NOWHERE, *map(place, self.rows), (self.stream + 1).to_bytes(24, "big")]))

    @rule(data=st.data())
    def stored(self, data: st.DataObject) -> None:
        self.covered = self._place(data)
        self.spool.stored(self.covered)

    @rule(data=st.data())
    def confirmed(self, data: st.DataObject) -> None:
        upto = self._place(data)
        gone = [one for one in self.rows if place(one) <= upto]
        assert self.spool.confirmed(upto) == sum(place(one) > self.confirmed_to for one in gone)
        if gone:
            self.confirmed_to = place(gone[-1])
            self.rows = [gone[-1], *self.rows[len(gone) :]]

    @rule(data=st.data())
    def set_aside(self, data: st.DataObject) -> None:
        if self.rows:
            one = data.draw(st.sampled_from(self.rows))
            assert self.spool.set_aside(one.header.digest) == place(one)
            self.rows.remove(one)
            self.aside.append(one)

    @rule()
    def start_again(self) -> None:
        self.spool.close()
        self.spool, self.drops = open_spool(self.path, self.LIMIT), 0

    @invariant()
    def agree(self) -> None:
        assert all_of(self.spool) == self.rows
        assert self.spool.last_digest == self.last
        rest = [one for one in self.rows if place(one) > self.confirmed_to]
        assert self.spool.statistics() == (
            len(rest), sum(one.header.records for one in rest), size_of(*rest),
            sum(place(one) > self.covered for one in rest), len(self.aside), self.drops,
        )  # fmt: skip


def test_any_sequence_of_calls_agrees_with_a_plain_list(tmp_path):
    run_state_machine_as_test(lambda: Model(tmp_path), settings=settings(stateful_step_count=25))
