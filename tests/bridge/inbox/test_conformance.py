"""What every back end of the inbox has to do; see rosbridge_eth.inbox.Inbox. `now` is given, never slept for."""

from __future__ import annotations

import os
import random
import subprocess
import sys
import textwrap
from collections.abc import Iterator

import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule, run_state_machine_as_test
from web3 import Web3

from bridge.chunks import STREAM, chain, chunk, dropped
from bridge.inbox.backends import BACKENDS, PLENTY, Backend
from rosbridge_eth.errors import StoreError
from rosbridge_eth.inbox import DEAD_LETTERS, Head, Inbox, InboxExchanged, Outcome, RobotState, Row, Waiting
from rosbridge_eth.log.chunk import Chunk
from rosbridge_eth.log.database import NothingThere

A, B = b"a" * 32, b"b" * 32
OTHER = bytes(16)  # sorts before STREAM
T0 = 1_795_226_000.0
STORED, KNOWN, DIFFERENT, FULL = Outcome.STORED, Outcome.KNOWN, Outcome.DIFFERENT, Outcome.FULL


@pytest.fixture(params=list(BACKENDS))
def backend(request, tmp_path) -> Backend:
    return BACKENDS[request.param](tmp_path, request.getfixturevalue)


@pytest.fixture
def inbox(backend) -> Iterator[Inbox]:
    opened = backend.open()
    yield opened
    opened.close()


def put(inbox: Inbox, chunks, tk: bytes = A, now: float = T0) -> list[Outcome]:
    return inbox.append([(tk, one) for one in chunks], now)


def rows(inbox: Inbox, tk: bytes = A) -> list[Row]:
    return inbox.rows(tk, None, 1_000_000)


def held(inbox: Inbox, tk: bytes = A) -> list[Chunk]:
    return [Chunk.parse(chunk) for chunk in inbox.chunks(tk, [row.position for row in rows(inbox, tk)])]


def position_of(inbox: Inbox, one: Chunk, tk: bytes = A) -> int:
    return next(row.position for row in rows(inbox, tk) if row.digest == one.header.digest)


# --- append


def test_each_chunk_is_stored_once_and_known_afterwards(inbox):
    made = list(chain(3))
    assert put(inbox, made) == [STORED] * 3
    assert put(inbox, [*made, chunk(3)]) == [KNOWN] * 3 + [STORED]
    assert put(inbox, []) == []
    assert len(rows(inbox)) == 4


def test_a_robots_chunks_come_back_unchanged_in_the_order_they_were_taken(inbox):
    made = [*chain(2), *chain(2, OTHER), *chain(3, b"\xff" * 16, size=60_000)]
    put(inbox, made)
    put(inbox, [chunk(7)], B)
    assert held(inbox) == made
    found = rows(inbox)
    assert [row.position for row in found] == sorted({row.position for row in found})
    assert [row[1:] for row in found] == [
        (one.header.digest, Web3.keccak(one.encoded), len(one.encoded), T0, one.header.records) for one in made
    ]
    assert inbox.rows(A, found[2].position, 3) == found[3:6]
    assert inbox.rows(A, -(2**63), 2) == found[:2]
    assert inbox.rows(A, found[-1].position, 3) == []
    assert inbox.rows(b"?" * 32, None, 3) == []


def test_a_number_is_above_the_head_or_it_is_not_taken_and_a_new_stream_may_begin_anywhere(inbox):
    assert put(inbox, [chunk(5), chunk(9), chunk(7), chunk(10)]) == [STORED, STORED, KNOWN, STORED]
    assert put(inbox, [chunk(2**63, OTHER), chunk(2**64 - 1, OTHER), chunk(2**63 + 1, OTHER)]) == [
        STORED, STORED, KNOWN,
    ]  # fmt: skip
    assert inbox.head(A, OTHER) == Head(2**64 - 1, chunk(2**64 - 1, OTHER).header.digest)
    assert (inbox.head(A, b"?" * 16), inbox.head(B, STREAM)) == (None, None)
    assert put(inbox, [chunk(5)], B) == [STORED]  # another robot's stream of the same name is another stream
    assert set(inbox.sizes()) == {A, B}


def test_the_head_outlives_the_rows(inbox):
    made = list(chain(3))
    put(inbox, made)
    inbox.remove(A, [row.position for row in rows(inbox)])
    assert inbox.head(A, STREAM) == Head(2, made[2].header.digest)
    assert put(inbox, made) == [KNOWN] * 3
    assert put(inbox, [chunk(2, variant=1), chunk(1, variant=1)]) == [DIFFERENT, KNOWN]
    assert rows(inbox) == []


def test_the_dropped_form_is_the_same_chunk_and_what_came_first_is_kept(inbox):
    first, second = chain(2)
    assert put(inbox, [first, dropped(first), dropped(second), second]) == [STORED, KNOWN, STORED, KNOWN]
    assert held(inbox) == [first, dropped(second)]


def test_another_chunk_with_a_number_that_is_there_is_different(inbox):
    assert put(inbox, [chunk(0), chunk(1), chunk(0, variant=1), chunk(1, variant=1)]) == [
        STORED, STORED, DIFFERENT, DIFFERENT,
    ]  # fmt: skip
    assert [one.header.digest for one in held(inbox)] == [chunk(0).header.digest, chunk(1).header.digest]


def test_many_robots_in_one_append_in_any_order(inbox):
    tks = [bytes([n]) * 32 for n in range(20)]
    batch = [(tk, chunk(number)) for number in range(3) for tk in tks]
    assert inbox.append(batch, T0) == [STORED] * 60
    assert inbox.append([(tk, chunk(2)) for tk in tks] + [(tks[3], chunk(3))], T0) == [KNOWN] * 20 + [STORED]
    assert all([one.header.number for one in held(inbox, tk)] == [0, 1, 2] for tk in tks if tk != tks[3])


# --- room

SIZE = len(chunk(0).encoded)


def test_a_robot_that_fills_its_share_blocks_no_other_and_none_of_its_later_chunks_overtakes(backend):
    inbox = backend.open(max_bytes=20 * SIZE, share=5 * SIZE - 1)
    small = chunk(5, size=0)
    assert len(small.encoded) < SIZE - 1
    made = list(chain(5))
    batch = [(A, one) for one in made] + [(B, chunk(0)), (A, small), (A, made[1]), (B, chunk(1))]
    assert inbox.append(batch, T0) == [STORED] * 4 + [FULL, STORED, FULL, KNOWN, STORED]
    assert inbox.head(A, STREAM).number == 3
    assert put(inbox, [made[4]]) == [FULL]
    inbox.remove(A, [rows(inbox)[0].position])
    assert put(inbox, [made[4]]) == [STORED]
    assert inbox.sizes() == {A: 4 * SIZE, B: 2 * SIZE}
    inbox.close()


def test_the_whole_is_bounded_too_by_objects_that_do_not_know_of_each_other(backend):
    one, two = backend.open(max_bytes=6 * SIZE), backend.open(max_bytes=6 * SIZE)
    assert put(one, chain(4)) == [STORED] * 4
    assert put(two, chain(4), B) == [STORED, STORED, FULL, FULL]
    assert put(one, [chunk(9, OTHER)]) == [FULL]
    assert put(two, chain(4)) == [KNOWN] * 4
    one.close()
    two.close()


# --- looking


def test_a_row_is_found_by_the_hash_that_the_contract_has(inbox):
    made = list(chain(3))
    put(inbox, made)
    for one in made:
        assert inbox.find(A, Web3.keccak(one.encoded)) == position_of(inbox, one)
    assert inbox.find(A, Web3.keccak(dropped(made[0]).encoded)) is None
    assert inbox.find(B, Web3.keccak(made[0].encoded)) is None


def test_chunks_that_are_gone_are_told(inbox):
    put(inbox, chain(3))
    first, second, third = (row.position for row in rows(inbox))
    inbox.remove(A, [second])
    assert len(inbox.chunks(A, [third, first])) == 2
    assert Chunk.parse(inbox.chunks(A, [third, first])[0]).header.number == 2
    assert inbox.chunks(A, []) == []
    for wanted in ([second], [first, second]):
        with pytest.raises(StoreError, match="no such row any more"):
            inbox.chunks(A, wanted)


def test_totals_count_what_waits(inbox):
    put(inbox, [chunk(0), chunk(1, records=7)], now=T0)
    put(inbox, [chunk(2, records=11, size=1000)], now=T0 + 5)
    put(inbox, [chunk(0)], B, now=T0 + 6)
    sizes = [row.size for row in rows(inbox)]
    assert inbox.totals() == {A: Waiting(3, 23, sum(sizes), T0), B: Waiting(1, 5, SIZE, T0 + 6)}
    inbox.confirm(A, rows(inbox)[1].position, T0)
    assert inbox.totals()[A] == Waiting(1, 11, sizes[2], T0 + 5)
    inbox.confirm(A, rows(inbox)[2].position, T0)
    assert inbox.totals()[A] == Waiting(0, 0, 0, None)


# --- confirm, forget


def test_confirming_says_what_to_tell_the_robot_and_may_move_back(inbox):
    put(inbox, [*chain(2), chunk(2**64 - 1, OTHER)])
    first, second, third = (row.position for row in rows(inbox))
    assert inbox.state(A) == RobotState()
    inbox.confirm(A, third, T0)
    assert inbox.state(A).confirmed == (OTHER, 2**64 - 1)
    inbox.confirm(A, first, T0 + 1)
    assert inbox.state(A).confirmed == (STREAM, 0)
    assert inbox.totals()[A].chunks == 2
    inbox.confirm(A, None, T0 + 2)
    assert inbox.state(A).confirmed is None
    inbox.confirm(A, second, T0 + 3)
    assert inbox.state(A).confirmed == (STREAM, 1)
    inbox.remove(A, [third])
    with pytest.raises(StoreError, match="no such row"):
        inbox.confirm(A, third, T0)


def test_what_was_confirmed_is_kept_for_the_time_and_the_newest_one_longer(inbox):
    made = list(chain(6))
    put(inbox, made[:4])
    inbox.confirm(A, position_of(inbox, made[1]), T0 + 100)
    inbox.forget(T0 + 100)
    assert held(inbox) == made[:4]
    inbox.confirm(A, position_of(inbox, made[3]), T0 + 150)
    inbox.forget(T0 + 101)
    assert held(inbox) == made[2:4]  # what was confirmed at 100
    inbox.confirm(A, position_of(inbox, made[3]), T0 + 160)
    inbox.forget(T0 + 160)
    assert held(inbox) == made[2:4]
    inbox.forget(T0 + 1000)
    inbox.forget(T0 + 3000)
    assert held(inbox) == made[3:4]
    assert inbox.find(A, Web3.keccak(made[3].encoded)) is not None
    assert put(inbox, made) == [KNOWN] * 4 + [STORED] * 2
    inbox.forget(T0 + 9999)
    assert held(inbox) == made[3:]


def test_what_moves_back_is_not_forgotten_for_an_earlier_confirmation(inbox):
    made = list(chain(4))
    put(inbox, made)
    inbox.confirm(A, position_of(inbox, made[3]), T0)
    inbox.confirm(A, position_of(inbox, made[1]), T0 + 10)
    inbox.forget(T0 + 5)
    assert held(inbox) == made
    inbox.confirm(A, None, T0)
    inbox.forget(T0 + 10**6)
    assert held(inbox) == made


def test_where_room_is_short_confirmed_rows_go_before_their_time_oldest_first(backend):
    inbox = backend.open(max_bytes=100 * SIZE, share=20 * SIZE)
    made = list(chain(20))
    assert put(inbox, made) == [STORED] * 20
    inbox.forget(0.0)
    assert len(rows(inbox)) == 20
    inbox.confirm(A, position_of(inbox, made[17]), T0)
    inbox.forget(0.0)
    assert held(inbox) == made[10:]
    inbox.close()


def test_where_the_whole_is_short_of_room_every_robot_gives_up_what_is_above_its_part(backend):
    inbox = backend.open(max_bytes=40 * SIZE)
    made = list(chain(30))
    put(inbox, made)
    put(inbox, chain(4), B)
    inbox.confirm(A, position_of(inbox, made[25]), T0)
    inbox.forget(0.0)
    assert held(inbox) == made[20:]  # half of half of the whole
    assert len(rows(inbox, B)) == 4
    inbox.close()


# --- rebase


def test_rows_that_are_on_the_chain_go_and_the_tail_stands_in_front_of_the_others(inbox):
    made = list(chain(8))
    put(inbox, made[:3])
    inbox.confirm(A, position_of(inbox, made[1]), T0)
    heads = {STREAM: Head(5, made[5].header.digest), OTHER: Head(9, b"9" * 32)}
    inbox.raise_heads(A, heads)
    inbox.rebase(A, [made[5]], [one.header.digest for one in made[1:5]], T0 + 1)
    assert held(inbox) == [made[5], made[0]]
    assert rows(inbox)[0].taken_at == T0 + 1
    assert inbox.find(A, Web3.keccak(made[5].encoded)) == rows(inbox)[0].position
    assert inbox.state(A).confirmed is None
    assert (inbox.head(A, STREAM), inbox.head(A, OTHER)) == tuple(heads.values())
    assert put(inbox, [*made, chunk(9, OTHER)]) == [KNOWN] * 6 + [STORED] * 2 + [DIFFERENT]
    assert held(inbox) == [made[5], made[0], made[6], made[7]]
    assert inbox.sizes()[A] == 4 * SIZE
    assert inbox.totals()[A].chunks == 4


def test_an_inbox_that_was_deleted_gets_the_tail_alone(inbox):
    tail = chunk(7)
    inbox.rebase(A, [tail], [], T0)
    assert held(inbox) == [tail]
    assert put(inbox, [chunk(6), chunk(7), chunk(8)]) == [KNOWN, KNOWN, STORED]
    inbox.confirm(A, position_of(inbox, tail), T0)
    inbox.forget(T0 + 1)
    assert [one.header.number for one in held(inbox)] == [7, 8]


def test_a_chain_without_chunks_leaves_all_rows_and_confirms_none(inbox):
    made = list(chain(3))
    put(inbox, made)
    inbox.confirm(A, position_of(inbox, made[2]), T0)
    inbox.rebase(A, [], [], T0)
    assert held(inbox) == made
    assert inbox.state(A).confirmed is None


def test_a_tail_that_is_there_in_the_other_form_is_replaced_by_the_one_of_the_chain(inbox):
    made = list(chain(3))
    put(inbox, made)
    inbox.rebase(A, [dropped(made[1])], [made[0].header.digest], T0)
    assert held(inbox) == [dropped(made[1]), made[2]]
    assert inbox.find(A, Web3.keccak(made[1].encoded)) is None


def test_rebase_twice_is_as_once_and_a_fork_stays_behind_the_tail(inbox):
    made = list(chain(3))
    put(inbox, [made[0], chunk(1, variant=1)])
    for _ in range(2):
        inbox.rebase(A, [made[1]], [made[0].header.digest], T0)
        assert [one.header.digest for one in held(inbox)] == [
            made[1].header.digest, chunk(1, variant=1).header.digest,
        ]  # fmt: skip


def test_what_a_reorganisation_may_take_back_becomes_rows_too(inbox):
    made = list(chain(9))
    put(inbox, made[6:])
    inbox.rebase(A, made[3:7], [one.header.digest for one in made[:7]], T0)
    assert held(inbox) == made[3:]
    inbox.rebase(A, made[:3], [], T0)
    assert held(inbox) == made
    assert put(inbox, made) == [KNOWN] * 9
    assert put(inbox, [chunk(9)]) == [STORED]
    assert len(held(inbox)) == 10


def test_a_long_history_is_no_obstacle(inbox):
    heads = {n.to_bytes(16, "big"): Head(n, bytes(32)) for n in range(1, 10_000)}
    on_chain = [n.to_bytes(32, "big") for n in range(50_000)]
    put(inbox, [chunk(n, size=0) for n in range(3000)])
    inbox.raise_heads(A, heads)
    inbox.rebase(A, [chunk(2999, size=0)], on_chain, T0)
    assert (len(rows(inbox)), inbox.head(A, (9999).to_bytes(16, "big"))) == (3000, Head(9999, bytes(32)))
    assert [one.header.number for one in held(inbox)[:2]] == [2999, 0]
    inbox.confirm(A, rows(inbox)[-1].position, T0)
    inbox.forget(T0 + 1)
    assert len(rows(inbox)) == 1


def test_heads_are_raised_and_never_lowered(inbox):
    put(inbox, chain(3))
    inbox.raise_heads(A, {STREAM: Head(1, b"1" * 32), OTHER: Head(0, b"0" * 32)})
    inbox.raise_heads(B, {STREAM: Head(4, b"4" * 32)})
    assert inbox.head(A, STREAM) == Head(2, chunk(2, previous=held(inbox)[2].header.previous).header.digest)
    assert inbox.head(A, OTHER) == Head(0, b"0" * 32)
    assert put(inbox, [chunk(3), chunk(4), chunk(5)], B) == [KNOWN, DIFFERENT, STORED]


# --- state, dead letters


def test_the_state_is_what_was_set(inbox):
    inbox.set_state(A, hold="no money ⛽")
    inbox.set_state(A, certificates_hash=b"\0\xff" * 16)
    assert inbox.state(A) == RobotState(None, "no money ⛽", b"\0\xff" * 16)
    inbox.set_state(A, hold=None)
    assert inbox.state(A) == RobotState(None, None, b"\0\xff" * 16)
    assert list(inbox.sizes()) == [A]
    with pytest.raises(ValueError, match="nonsense"):
        inbox.set_state(A, nonsense=1)


def test_what_cannot_be_written_becomes_dead_letters_with_the_reason(inbox):
    made = list(chain(4))
    put(inbox, made)
    put(inbox, [chunk(0)], B)
    assert inbox.bury(A, position_of(inbox, made[1]), "revoked «x»") == 2
    assert held(inbox) == made[:2]
    assert len(rows(inbox, B)) == 1
    assert [(letter[:3], Chunk.parse(letter.chunk)) for letter in inbox.dead()] == [
        ((A, "revoked «x»", T0), made[3]), ((A, "revoked «x»", T0), made[2]),
    ]  # fmt: skip
    assert [letter.chunk for letter in inbox.dead(1)] == [made[3].encoded]
    assert put(inbox, made) == [KNOWN] * 4
    inbox.confirm(A, position_of(inbox, made[1]), T0)
    assert inbox.bury(A, None, "all") == 2
    assert inbox.bury(A, None, "all") == 0
    assert inbox.state(A).confirmed is None
    assert inbox.sizes()[A] == 0


def test_dead_letters_are_bounded(inbox):
    for stream in range(3):
        put(inbox, (chunk(number, bytes([stream]) * 16, size=0) for number in range(400)))
    assert inbox.bury(A, None, "why") == 1200
    letters = inbox.dead(5000)
    assert len(letters) == DEAD_LETTERS
    assert Chunk.parse(letters[0].chunk).header.number == 399
    assert (Chunk.parse(letters[-1].chunk).header.stream, rows(inbox)) == (bytes(16), [])


# --- several objects and processes, and their death


def test_another_object_sees_what_was_committed_and_has_the_same_id(backend):
    one, two = backend.open(), backend.open()
    put(one, [chunk(0)])
    assert put(two, [chunk(0), chunk(1)]) == [KNOWN, STORED]
    assert rows(one) == rows(two)
    assert one.id == two.id and len(one.id) == 16
    one.close()
    two.close()


def test_a_look_makes_nothing_and_changes_nothing(backend):
    with pytest.raises(NothingThere, match="there is no inbox"):
        backend.open(read_only=True)
    assert backend.copy() == {}
    inbox = backend.open()
    put(inbox, chain(3))
    inbox.close()
    before = backend.copy()
    looking = backend.open(read_only=True)
    assert (looking.id, len(rows(looking)), looking.dead(), looking.totals()[A].chunks) == (inbox.id, 3, [], 3)
    assert looking.head(A, STREAM) is not None
    looking.close()
    assert backend.copy() == before
    writing, looking = backend.open(), backend.open(read_only=True)
    put(writing, [chunk(7)])
    assert len(rows(looking)) == 4
    looking.close()
    writing.close()


def test_the_inbox_of_another_contract_is_refused_or_apart(backend):
    inbox = backend.open()
    put(inbox, chain(3))
    backend.ledger = backend.ledger[::-1] if backend.url != "sqlite" else b"x" * 32
    try:
        other = backend.open()
    except StoreError as error:
        assert "another contract" in str(error)
    else:
        assert (rows(other), list(other.sizes())) == ([], [])
        other.close()
    inbox.close()


def test_a_store_that_is_emptied_or_exchanged_is_told_once_before_anything_is_taken(backend):
    inbox = backend.open()
    put(inbox, chain(3))
    backend.put_back(None)
    before = inbox.id
    with pytest.raises(InboxExchanged):
        put(inbox, [chunk(3)])
    assert inbox.id != before
    assert inbox.head(A, STREAM) is None
    assert put(inbox, [chunk(0)]) == [STORED]
    inbox.close()


def test_an_exchanged_store_is_told_although_there_is_nothing_to_take(backend):
    inbox = backend.open()
    assert inbox.append([], 0.0) == []
    put(inbox, chain(3))
    backend.put_back(None)
    with pytest.raises(InboxExchanged):
        inbox.append([], 0.0)
    assert inbox.append([], 0.0) == []
    assert list(inbox.sizes()) == []
    inbox.close()


CHILD = """
import random, sys
from pathlib import Path
from bridge.chunks import chunk
from rosbridge_eth.inbox import open_inbox
seed, A = int(sys.argv[1]), b"a" * 32
rng = random.Random(seed)
inbox = open_inbox({url!r}, home=Path({home!r}), ledger={ledger!r}, max_bytes=1 << 30, max_bytes_per_robot=1 << 30)
{body}
"""


def child(backend: Backend, seed: int, body: str) -> subprocess.Popen[str]:
    source = CHILD.format(
        url=backend.url, home=str(backend.folder), ledger=backend.ledger, body=textwrap.dedent(body)
    )
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
    return subprocess.Popen(
        [sys.executable, "-c", source, str(seed)], stdout=subprocess.PIPE, text=True, env=environment
    )


def test_two_machines_with_one_identity_and_workers_of_other_robots_append_at_once(backend, inbox):
    body = """
    stored = 0
    for start in range(0, 200, 5):
        batch = [(tk, chunk(n)) for n in range(start, start + 5) for tk in (A, bytes([seed]) * 32)]
        stored += sum(outcome.value == "stored" for outcome in inbox.append(batch, 1.0)[::2])
    print(stored)
    """
    children = [child(backend, seed, body) for seed in range(3)]
    counts = [int(process.communicate(timeout=60)[0]) for process in children]
    numbers = [one.header.number for one in held(inbox)]
    assert sum(counts) == len(numbers)
    assert numbers == sorted(set(numbers))
    for seed in range(3):
        assert [one.header.number for one in held(inbox, bytes([seed]) * 32)] == list(range(200))


@pytest.mark.parametrize("seed", range(4))
def test_a_killed_process_leaves_every_append_it_was_told_of_and_none_in_part(backend, seed):
    """SIGKILL at a random moment, between any two writes. Groups of 5 are there whole or not at all."""
    body = """
    for start in range(0, 100_000, 5):
        inbox.append([(A, chunk(n)) for n in range(start, start + 5)], 1.0)
        print(start, flush=True)
        if start % 3 == 0:
            rows = inbox.rows(A, None, 3)
            inbox.confirm(A, rows[-1].position, 1.0)
            inbox.forget(2.0)
    """
    process = child(backend, seed, body)
    told, wanted = -5, random.Random(seed).randrange(5, 500, 5)
    for line in process.stdout:
        told = int(line)
        if told >= wanted:
            process.kill()
    process.wait(timeout=60)
    inbox = backend.open()
    numbers = [one.header.number for one in held(inbox)]
    head = inbox.head(A, STREAM).number
    assert numbers == list(range(numbers[0], head + 1)), f"seed {seed}"
    assert (head + 1) % 5 == 0
    assert head in (told + 4, told + 9)
    assert inbox.sizes()[A] == sum(row.size for row in rows(inbox))
    assert inbox.totals()[A].chunks <= len(numbers)
    assert put(inbox, [chunk(n) for n in range(head + 2)]) == [KNOWN] * (head + 1) + [STORED]
    inbox.close()


# --- the rule of the hops, with an inbox that is put back, deleted, or lost its newest rows


UNCONFIRMED = 3  # chunks at the end of the chain that a reorganisation may take back


def heal(inbox: Inbox, tk: bytes, on_chain: list[bytes], now: float) -> int | None:
    """The submitter's comparison with a chain that is a list of encoded chunks; where to send from."""
    if not on_chain:
        return None
    position = inbox.find(tk, Web3.keccak(on_chain[-1]))
    if position is None:
        past = [Chunk.parse(one).header for one in on_chain]
        heads: dict[bytes, Head] = {}
        for header in past:
            if header.stream not in heads or heads[header.stream].number < header.number:
                heads[header.stream] = Head(header.number, header.digest)
        inbox.raise_heads(tk, heads)
        front = [Chunk.parse(one) for one in on_chain[-UNCONFIRMED:]]
        inbox.rebase(tk, front, [header.digest for header in past], now)
        position = inbox.find(tk, Web3.keccak(on_chain[-1]))
    return position


@pytest.mark.parametrize("seed", range(5))
def test_whatever_copy_of_the_inbox_is_put_back_every_chunk_is_once_on_the_chain_and_in_order(backend, seed):
    """A robot that keeps what is not confirmed, a chain that is reorganised, a store that is restored and deleted."""
    print(f"seed {seed}")
    rng, inbox = random.Random(seed), backend.open()
    spool = list(chain(60))
    chain_of, copies, first, now = [], [None], 0, T0  # first: the oldest chunk that the robot still has
    deepest = 0  # what was that many chunks ago stays
    for _ in range(400):
        now += 60
        deepest = max(deepest, len(chain_of) - UNCONFIRMED)
        match rng.randrange(12):
            case 0:
                inbox.close()
                copies.append(backend.copy())
                inbox = backend.open()
            case 1 if rng.random() < 0.4:
                inbox.close()
                backend.put_back(rng.choice(copies))
                inbox = backend.open()
            case 2:
                del chain_of[max(deepest, len(chain_of) - rng.randrange(UNCONFIRMED + 1)) :]
            case 3 | 4 | 5:  # a session: Where, Stored, what follows
                head = inbox.head(A, STREAM)
                begin = max(first, 0 if head is None else head.number + 1)
                put(inbox, spool[begin : begin + rng.randrange(1, 6)], now=now)
            case 6:
                inbox.forget(now - rng.randrange(10_000))
            case _:  # the submitter
                position = heal(inbox, A, chain_of, now)
                waiting = inbox.rows(A, position, rng.randrange(1, 5))
                chain_of += inbox.chunks(A, [row.position for row in waiting])
                deep = inbox.find(A, Web3.keccak(chain_of[-UNCONFIRMED - 1])) if len(chain_of) > UNCONFIRMED else None
                if deep is not None:
                    inbox.confirm(A, deep, now)
                    first = max(first, inbox.state(A).confirmed[1] + 1)
        numbers = [Chunk.parse(one).header.number for one in chain_of]
        assert numbers == list(range(len(numbers)))
    inbox.close()
    print(f"{len(numbers)} on the chain")
    assert len(numbers) > 20


# --- a model of it


class Model(RuleBasedStateMachine):
    """Against plain lists: of each robot its rows, heads, what is confirmed; and dead letters."""

    SHARE, WHOLE = 4000, 9000

    def __init__(self, backend: Backend) -> None:
        super().__init__()
        backend.put_back(None)
        self.backend = backend
        self.inbox = self.open()

    def open(self) -> Inbox:
        return self.backend.open(max_bytes=self.WHOLE, share=self.SHARE)

    def teardown(self) -> None:
        self.inbox.close()

    @initialize()
    def begin(self) -> None:
        self.rows: dict[bytes, list[Chunk]] = {}
        self.heads: dict[tuple[bytes, bytes], Head] = {}
        self.confirmed: dict[bytes, Chunk | None] = {}
        self.buried: list[bytes] = []

    def _size(self, *tks: bytes) -> int:
        return sum(len(one.encoded) for tk in tks for one in self.rows.get(tk, []))

    def _expect(self, tk: bytes, one: Chunk, full: set[bytes]) -> Outcome:
        header, head = one.header, self.heads.get((tk, one.header.stream))
        if head is not None and header.number <= head.number:
            place = (header.stream, header.number)
            there = {r.header.digest for r in self.rows[tk] if (r.header.stream, r.header.number) == place}
            there |= {head.digest} if head.number == header.number else set()
            return DIFFERENT if there and header.digest not in there else KNOWN
        size = len(one.encoded)
        if tk in full or self._size(tk) + size > self.SHARE or self._size(*self.rows) + size > self.WHOLE:
            full.add(tk)
            return FULL
        self.rows.setdefault(tk, []).append(one)
        self.heads[tk, header.stream] = Head(header.number, header.digest)
        return STORED

    @rule(
        offers=st.lists(
            st.tuples(
                st.sampled_from([A, B]), st.integers(0, 9), st.sampled_from([STREAM, OTHER]), st.integers(0, 1),
                st.sampled_from([0, 400, 1200]), st.booleans(),
            ),
            max_size=6,
        )
    )  # fmt: skip
    def append(self, offers) -> None:
        chunks = []
        for tk, number, stream, variant, size, drop in offers:
            one = chunk(number, stream, size=size, variant=variant)
            chunks.append((tk, dropped(one) if drop else one))
        full: set[bytes] = set()
        expected = [self._expect(tk, one, full) for tk, one in chunks]
        assert self.inbox.append(chunks, T0) == expected

    def _row(self, data: st.DataObject, tk: bytes) -> int | None:
        places = range(len(self.rows.get(tk, [])))
        return data.draw(st.one_of(st.none(), st.sampled_from(places))) if places else None

    @rule(data=st.data(), tk=st.sampled_from([A, B]))
    def confirm(self, data: st.DataObject, tk: bytes) -> None:
        index = self._row(data, tk)
        self.confirmed[tk] = None if index is None else self.rows[tk][index]
        self.inbox.confirm(tk, None if index is None else rows(self.inbox, tk)[index].position, T0)

    @rule()
    def forget_everything_that_may_be(self) -> None:
        for tk, last in self.confirmed.items():
            if last is not None:
                self.inbox.confirm(tk, rows(self.inbox, tk)[self._index(tk, last)].position, T0)
        self.inbox.forget(T0 + 1e6)
        for tk, last in self.confirmed.items():
            if last is not None:
                self.rows[tk] = self.rows[tk][self._index(tk, last) :]

    def _index(self, tk: bytes, one: Chunk) -> int:
        return next(i for i, row in enumerate(self.rows[tk]) if row is one)

    @rule(data=st.data(), tk=st.sampled_from([A, B]))
    def bury(self, data: st.DataObject, tk: bytes) -> None:
        index = self._row(data, tk)
        after = None if index is None else rows(self.inbox, tk)[index].position
        gone = self.rows.get(tk, [])[0 if index is None else index + 1 :]
        assert self.inbox.bury(tk, after, "why") == len(gone)
        self.buried += [one.encoded for one in gone]
        if any(one is self.confirmed.get(tk) for one in gone):
            self.confirmed[tk] = None
        self.rows[tk] = [one for one in self.rows.get(tk, []) if not any(one is other for other in gone)]

    @rule(data=st.data(), tk=st.sampled_from([A, B]), number=st.integers(0, 9))
    def rebase(self, data: st.DataObject, tk: bytes, number: int) -> None:
        mine = self.rows.get(tk, [])
        on_chain = {one.header.digest for one in mine if data.draw(st.booleans())}
        tail = chunk(number, b"t" * 16, size=0)
        self.inbox.rebase(tk, [tail], on_chain, T0)
        self.rows[tk] = [tail] + [one for one in mine if one.header.digest not in {*on_chain, tail.header.digest}]
        self.confirmed[tk] = None
        head = self.heads.get((tk, b"t" * 16))
        if head is None or head.number < number:
            self.heads[tk, b"t" * 16] = Head(number, tail.header.digest)

    @rule()
    def another_process(self) -> None:
        self.inbox.close()
        self.inbox = self.open()

    @invariant()
    def agree(self) -> None:
        for tk in (A, B):
            mine = self.rows.get(tk, [])
            assert [one.encoded for one in held(self.inbox, tk)] == [one.encoded for one in mine]
            assert self.inbox.sizes().get(tk, 0) == self._size(tk)
            last = self.confirmed.get(tk)
            place = None if last is None else (last.header.stream, last.header.number)
            assert self.inbox.state(tk).confirmed == place
            waits = mine if last is None else mine[self._index(tk, last) + 1 :]
            waiting = self.inbox.waiting(tk, self.inbox.state(tk).position)
            assert waiting[:3] == (
                len(waits), sum(one.header.records for one in waits), sum(len(one.encoded) for one in waits),
            )
            for (robot, stream), head in self.heads.items():
                assert robot != tk or self.inbox.head(tk, stream) == head
        assert [letter.chunk for letter in self.inbox.dead(PLENTY)] == self.buried[::-1]


def test_any_sequence_of_calls_agrees_with_plain_lists(backend):
    run_state_machine_as_test(
        lambda: Model(backend),
        settings=settings(stateful_step_count=15, suppress_health_check=[HealthCheck.too_slow]),
    )
