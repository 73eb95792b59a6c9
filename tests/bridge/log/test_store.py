"""What every back end of the store has to do; see rosbridge_eth.log.store. `now` is given, never slept for."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import pytest
from hypothesis import HealthCheck, settings
from hypothesis import strategies as st
from hypothesis.stateful import RuleBasedStateMachine, initialize, invariant, rule, run_state_machine_as_test
from web3 import Web3

from bridge.chunks import chain, chunk, dropped
from bridge.log.backends import BACKENDS, PLENTY, Backend, ClusterBackend
from rosbridge_eth.errors import StoreError
from rosbridge_eth.log.chunk import Chunk
from rosbridge_eth.log.store import (
    DEAD_LETTERS,
    NO_DIGEST,
    NO_HASH,
    NOWHERE,
    Offer,
    Outcome,
    Row,
    State,
    Store,
    Waiting,
    place_of,
    successor,
)

A, B = b"a" * 32, b"b" * 32
EARLY, STREAM, LATE = b"e" * 16, b"s" * 16, b"t" * 16
T0 = 1_795_226_000.0
STORED, KNOWN, NOT_NEXT, DIFFERENT, FULL = Outcome


@pytest.fixture(params=list(BACKENDS))
def backend(request, tmp_path) -> Backend:
    return BACKENDS[request.param](tmp_path, request.getfixturevalue)


@pytest.fixture
def store(backend) -> Iterator[Store]:
    opened = backend.open()
    yield opened
    opened.close()


def put(store: Store, chunks, tk: bytes = A, now: float = T0, *, oldest: bool = False) -> list[Outcome]:
    """oldest: the robot says that it has nothing between the head and each of the chunks."""
    return store.append([Offer(tk, one, state(store, tk).digest if oldest else b"") for one in chunks], now)


def rows(store: Store, tk: bytes = A) -> list[Row]:
    return store.rows(tk, NOWHERE, 1_000_000)


def held(store: Store, tk: bytes = A) -> list[Chunk]:
    return [Chunk.parse(one) for one in store.chunks(tk, [row.place for row in rows(store, tk)])]


def place(one: Chunk) -> bytes:
    return place_of(one.header)


def state(store: Store, tk: bytes = A) -> State:
    [found] = store.states([tk])
    return found


def head_is(store: Store, one: Chunk, tk: bytes = A) -> bool:
    return state(store, tk)[:2] == (place(one), one.header.digest)


# --- append


def test_a_log_is_taken_in_its_order_and_known_afterwards(store):
    made = list(chain(3))
    assert state(store) == State(NOWHERE, NO_DIGEST, NO_HASH, NOWHERE, 0, "", b"")
    assert put(store, made[:2]) == [STORED] * 2
    assert head_is(store, made[1])
    assert put(store, made) == [KNOWN, KNOWN, STORED]
    assert head_is(store, made[2])
    assert put(store, []) == []
    assert held(store) == made


def test_rows_come_back_unchanged_in_their_order(store):
    made = [*chain(2, size=60_000)]
    made += chain(3, LATE, previous=made[-1].header.digest)
    put(store, made)
    put(store, chain(1), B)
    found = rows(store)
    assert found == [
        Row(place(one), one.header.digest, Web3.keccak(one.encoded), len(one.encoded), one.header.records, T0)
        for one in made
    ]
    assert found == sorted(found)
    assert store.rows(A, found[1].place, 2) == found[2:4]
    assert store.rows(A, found[-1].place, 3) == []
    assert store.rows(b"?" * 32, NOWHERE, 3) == []


def test_what_does_not_follow_the_head_is_not_taken_unless_it_is_the_oldest(store):
    made = list(chain(6))
    assert put(store, [made[1]]) == [NOT_NEXT]
    assert put(store, [made[0], made[2], made[3]]) == [STORED, NOT_NEXT, NOT_NEXT]
    assert head_is(store, made[0])
    assert put(store, [made[3]], oldest=True) == [STORED]
    assert put(store, [made[4], made[2]]) == [STORED, DIFFERENT]
    assert held(store) == [made[0], made[3], made[4]]
    assert store.append([Offer(A, chunk(0, LATE), made[3].header.digest)], T0) == [NOT_NEXT]  # said of another head
    later = list(chain(2, LATE))  # of a robot whose disk was lost: nothing stands before it
    assert put(store, later[:1]) == [NOT_NEXT]
    assert put(store, later[:1], oldest=True) + put(store, later[1:]) == [STORED, STORED]


def test_the_head_outlives_the_rows(store):
    made = list(chain(4))
    put(store, made[:3])
    store.remove(A, [row.place for row in rows(store)])
    assert head_is(store, made[2])
    assert put(store, made[:3]) == [KNOWN] * 3
    assert put(store, [chunk(2, variant=1), chunk(1, variant=1)]) == [DIFFERENT, KNOWN]
    assert put(store, [chunk(9, EARLY)], oldest=True) == [KNOWN]
    assert rows(store) == []
    assert put(store, made) == [KNOWN] * 3 + [STORED]


def test_the_dropped_form_is_the_same_chunk_and_what_came_first_is_kept(store):
    first, second = chain(2)
    assert put(store, [first, dropped(first), dropped(second), second]) == [STORED, KNOWN, STORED, KNOWN]
    assert held(store) == [first, dropped(second)]


@pytest.mark.parametrize("oldest", [False, True])
def test_a_log_that_goes_on_in_two_ways_is_told_and_not_interleaved(store, oldest):
    """Two machines with one identity: where their logs have parted, only the one that came first is taken."""
    common = list(chain(3))
    put(store, [*common, chunk(3, previous=common[-1].header.digest)])
    mine = held(store)
    for other in (
        chunk(3, variant=1, previous=common[-1].header.digest),  # the same place
        chunk(4, previous=chunk(3, variant=1).header.digest),  # the place after the head, behind another chunk
        chunk(0, LATE, previous=common[-1].header.digest),  # another stream behind what something else follows
        chunk(0, LATE, previous=common[0].header.digest),
        chunk(1, variant=1),
    ):
        assert put(store, [other], oldest=oldest) == [DIFFERENT]
    assert (held(store), state(store).head) == (mine, place(mine[-1]))


def test_many_robots_in_one_append_in_any_order(store):
    tks = [bytes([n]) * 32 for n in range(20)]
    made = list(chain(4))
    batch = [Offer(tk, one) for one in made[:3] for tk in tks]
    assert store.append(batch, T0) == [STORED] * 60
    again = [Offer(tk, made[2]) for tk in tks] + [Offer(tks[3], made[3])]
    assert store.append(again, T0) == [KNOWN] * 20 + [STORED]
    assert [len(rows(store, tk)) for tk in tks] == [3 + (tk == tks[3]) for tk in tks]


def test_numbers_order_by_their_value_whatever_bytes_they_have(store):
    numbers = [0, 1, 127, 128, 255, 256, 2**32, 2**63, 2**64 - 1]
    made, previous = [], NO_DIGEST
    for number in numbers:
        made.append(chunk(number, b"\xff" * 16, previous=previous))
        previous = made[-1].header.digest
        assert put(store, made[-1:]) == [STORED]
    assert held(store) == made
    assert put(store, [chunk(2**63 - 1, b"\xff" * 16)], oldest=True) == [DIFFERENT]


# --- room

SIZE = len(chunk(0).encoded)


def test_a_robot_that_fills_its_share_blocks_no_other_and_none_of_its_later_chunks_overtakes(backend):
    store = backend.open(max_bytes=20 * SIZE, share=5 * SIZE - 1)
    made = list(chain(5))
    small = chunk(5, size=0, previous=made[4].header.digest)
    assert len(small.encoded) < SIZE - 1
    batch = [*(Offer(A, one) for one in made), Offer(B, made[0]), Offer(A, small, made[3].header.digest)]
    batch += Offer(A, made[1]), Offer(B, made[1])
    assert store.append(batch, T0) == [STORED] * 4 + [FULL, STORED, FULL, KNOWN, STORED]
    assert head_is(store, made[3])
    assert put(store, [made[4]]) == [FULL]
    store.remove(A, [rows(store)[0].place])
    assert put(store, [made[4]]) == [STORED]
    assert store.sizes() == {A: 4 * SIZE, B: 2 * SIZE}
    store.close()


def test_the_whole_is_bounded_too_by_objects_that_do_not_know_of_each_other(backend):
    if not backend.bounded:
        pytest.skip("its own bound on all robots together is tested beside it")
    one, two = backend.open(max_bytes=6 * SIZE), backend.open(max_bytes=6 * SIZE)
    made = list(chain(5))
    assert put(one, made[:4]) == [STORED] * 4
    assert put(two, made[:4], B) == [STORED, STORED, FULL, FULL]
    assert put(one, made[4:]) == [FULL]
    assert put(two, made[:4]) == [KNOWN] * 4
    one.close()
    two.close()


# --- looking


def test_a_row_is_found_by_the_hash_that_the_contract_has_and_by_its_digest(store):
    made = list(chain(3))
    put(store, made)
    for one in made:
        assert store.find(A, Web3.keccak(one.encoded)) == place(one)
        assert store.has(A, one.header.digest)
    assert store.find(A, Web3.keccak(dropped(made[0]).encoded)) is None
    assert store.find(B, Web3.keccak(made[0].encoded)) is None
    assert not store.has(B, made[0].header.digest)
    store.remove(A, [place(made[1])])
    assert store.find(A, Web3.keccak(made[1].encoded)) is None
    assert not store.has(A, made[1].header.digest)


def test_chunks_that_are_gone_are_told(store):
    first, second, third = made = list(chain(3))
    put(store, made)
    store.remove(A, [place(second)])
    store.remove(A, [place(second)])
    assert store.chunks(A, [place(third), place(first)]) == [third.encoded, first.encoded]
    assert store.chunks(A, []) == []
    for wanted in ([second], [first, second]):
        with pytest.raises(StoreError, match="no such row any more"):
            store.chunks(A, [place(one) for one in wanted])


def test_waiting_sums_what_is_not_confirmed(store):
    made = list(chain(2))
    put(store, made, now=T0)
    made.append(chunk(2, records=11, size=1000, previous=made[1].header.digest))
    put(store, made[2:], now=T0 + 5)
    sizes = [row.size for row in rows(store)]
    assert store.waiting(A) == Waiting(3, 21, sum(sizes), T0)
    store.set_state(A, confirmed=place(made[1]))
    assert store.waiting(A) == Waiting(1, 11, sizes[2], T0 + 5)
    store.set_state(A, confirmed=place(made[2]))
    assert store.waiting(A) == store.waiting(B) == Waiting(0, 0, 0, None)


def test_sizes_name_every_robot_that_is_known(store):
    assert store.sizes() == {}
    put(store, chain(2))
    store.set_state(B, hold="no registration")
    assert store.sizes() == {A: 2 * SIZE, B: 0}
    store.remove(A, [row.place for row in rows(store)])
    assert store.sizes() == {A: 0, B: 0}


# --- state, dead letters


def test_the_state_is_what_was_set(store):
    store.set_state(A, hold="no money ⛽")
    store.set_state(A, certificates=b"\0\xff" * 16, block=2**53 - 1)
    assert state(store) == State(hold="no money ⛽", certificates=b"\0\xff" * 16, block=2**53 - 1)
    put(store, made := list(chain(2)))
    store.set_state(A, hold="", confirmed=place(made[0]))
    assert store.states([B, A]) == [
        State(),
        State(place(made[1]), made[1].header.digest, NO_HASH, place(made[0]), 2**53 - 1, "", b"\0\xff" * 16),
    ]
    with pytest.raises(ValueError, match="nonsense"):
        store.set_state(A, nonsense=1)


def test_what_cannot_be_written_becomes_dead_letters_with_the_reason(store):
    made = list(chain(4))
    put(store, made)
    put(store, made[:1], B, T0 + 1)
    store.remove(A, [place(made[3])], "revoked «x»")
    store.remove(B, [place(made[0])], "gone")
    store.remove(B, [place(made[0])], "told twice")
    assert held(store) == made[:3]
    assert store.dead() == [(B, "gone", T0 + 1, made[0].encoded), (A, "revoked «x»", T0, made[3].encoded)]
    assert store.dead(1) == store.dead()[:1]
    assert put(store, made) == [KNOWN] * 4


def test_so_many_dead_letters_are_kept(store):
    made = list(chain(DEAD_LETTERS + 5, size=0))
    put(store, made)
    for begin in range(0, len(made), 100):
        store.remove(A, [place(one) for one in made[begin : begin + 100]], "why")
    assert [letter.chunk for letter in store.dead(PLENTY)] == [one.encoded for one in made[:4:-1]]


# --- follow, forget


def test_a_store_that_was_lost_follows_the_chain_and_takes_what_comes_next(store):
    made = list(chain(6))
    store.follow(A, Web3.keccak(made[3].encoded), made[3].header)
    assert state(store) == State(place(made[3]), made[3].header.digest, Web3.keccak(made[3].encoded))
    assert put(store, made) == [KNOWN] * 4 + [STORED] * 2
    assert held(store) == made[4:]


def test_rows_behind_the_chains_last_chunk_stay_until_what_stands_before_them_is_there(store):
    made = list(chain(8))
    put(store, made[:3])
    put(store, made[5:7], oldest=True)
    store.follow(A, Web3.keccak(made[3].encoded), made[3].header)
    assert held(store) == made[5:7]
    assert head_is(store, made[3])
    assert put(store, made[6:]) == [NOT_NEXT, NOT_NEXT]
    assert put(store, made[4:]) == [STORED, KNOWN, KNOWN, STORED]
    assert held(store) == made[4:]
    assert head_is(store, made[7])
    assert store.sizes() == {A: 4 * SIZE}


def test_a_chain_that_has_nothing_is_followed_too(store):
    made = list(chain(4))
    store.follow(A, Web3.keccak(made[1].encoded), made[1].header)
    put(store, made[2:])
    store.follow(A, NO_HASH, None)
    assert state(store) == State()
    assert held(store) == made[2:]
    assert put(store, made) == [STORED, STORED, KNOWN, KNOWN]
    assert held(store) == made


def test_another_log_behind_the_chains_last_chunk_is_told(store):
    made = list(chain(5))
    put(store, made[:2])
    put(store, made[3:], oldest=True)
    store.follow(A, Web3.keccak(made[1].encoded), made[1].header)
    assert put(store, [chunk(2, previous=made[1].header.digest), chunk(3, variant=1)]) == [STORED, DIFFERENT]


def test_confirmed_rows_are_forgotten_by_age_the_newest_of_them_stays(store):
    made = list(chain(6))
    for second, one in enumerate(made):
        put(store, [one], now=T0 + second)
    store.forget(A, T0 + 100, PLENTY)
    assert held(store) == made
    store.set_state(A, confirmed=place(made[3]))
    store.forget(A, T0 + 2, PLENTY)
    assert held(store) == made[2:]
    assert state(store).base == Web3.keccak(made[1].encoded)
    store.forget(A, T0 + 100, PLENTY)
    assert held(store) == made[3:]
    assert put(store, made) == [KNOWN] * 6


def test_confirmed_rows_are_forgotten_where_room_is_short_the_oldest_first(store):
    made = list(chain(10))
    put(store, made)
    store.set_state(A, confirmed=place(made[7]))
    store.forget(A, 0.0, 5 * SIZE)
    assert held(store) == made[5:]
    store.forget(A, 0.0, 0)
    assert held(store) == made[7:]
    store.forget(B, 0.0, 0)


def test_a_long_log_is_no_obstacle(store):
    made = list(chain(3000, size=0))
    for begin in range(0, 3000, 500):
        put(store, made[begin : begin + 500])
    store.set_state(A, confirmed=place(made[-1]))
    store.forget(A, T0 + 1, PLENTY)
    assert held(store) == made[-1:]
    more = list(chain(1000, LATE, size=0, previous=made[-1].header.digest))
    put(store, more)
    store.follow(A, Web3.keccak(more[900].encoded), more[900].header)
    assert held(store) == more[901:]


# --- several at once, and a copy put back


def test_two_objects_see_what_the_other_did(backend):
    one, two = backend.open(), backend.open()
    made = list(chain(4))
    assert put(one, made[:2]) + put(two, made[1:3]) + put(one, made[2:]) == [
        STORED,
        STORED,
        KNOWN,
        STORED,
        KNOWN,
        STORED,
    ]
    two.set_state(A, hold="why")
    one.set_state(A, block=7)
    assert state(one)[4:6] == state(two)[4:6] == (7, "why")
    one.close()
    two.close()


def test_a_copy_that_is_put_back_while_it_is_in_use_says_a_lower_head_and_is_sent_the_rest(backend):
    one, two = backend.open(), backend.open()
    made = list(chain(9))
    put(one, made[:4])
    copy = backend.copy()
    put(two, made[4:7])
    backend.put_back(copy)
    assert head_is(one, made[3])
    assert put(two, made[7:]) == [NOT_NEXT, NOT_NEXT]
    assert put(one, made[4:]) == [STORED] * 5
    assert held(one) == held(two) == made
    assert one.sizes() == {A: 9 * SIZE}
    backend.put_back(None)
    assert state(one) == State()
    assert put(two, made) == [STORED] * 9
    assert held(one) == made
    one.close()
    two.close()


def test_a_look_changes_nothing(backend):
    store = backend.open()
    put(store, made := list(chain(2)))
    looking = backend.open(read_only=True)
    assert held(looking) == made
    assert store.waiting(A) == looking.waiting(A)
    looking.close()
    store.close()


# --- a model of it


class Model(RuleBasedStateMachine):
    """Against plain lists: of each robot its rows and its state; and dead letters."""

    SHARE, WHOLE = 4000, 6000

    def __init__(self, backend: Backend) -> None:
        super().__init__()
        backend.put_back(None)
        self.backend = backend
        self.store = self.open()

    def open(self) -> Store:
        return self.backend.open(max_bytes=self.WHOLE, share=self.SHARE)

    def teardown(self) -> None:
        self.store.close()

    @initialize()
    def begin(self) -> None:
        self.rows: dict[bytes, dict[bytes, Chunk]] = {A: {}, B: {}}
        self.states = {A: State(), B: State()}
        self.made: list[Chunk] = []
        self.buried: set[tuple[bytes, bytes]] = set()

    def _size(self, *tks: bytes) -> int:
        return sum(len(one.encoded) for tk in tks for one in self.rows[tk].values())

    def _expect(self, offer: Offer, full: set[bytes]) -> Outcome:
        tk, one, after = offer
        mine, known, here, size = self.rows[tk], self.states[tk], place(one), len(one.encoded)
        there = {mine[here].header.digest} if here in mine else set()
        there |= {known.digest} if here == known.head else set()
        if there - {one.header.digest}:
            return DIFFERENT
        if here <= known.head:
            return DIFFERENT if not there and mine and min(mine) < here else KNOWN
        if one.header.previous != known.digest:
            named = [at for at, row in mine.items() if row.header.digest == one.header.previous]
            if here == successor(known.head) or (named and any(named[0] < at < here for at in [*mine, known.head])):
                return DIFFERENT
            if after != known.digest and tk not in full:
                return NOT_NEXT
        if not there:
            whole = self._size(A, B) + size > self.WHOLE and self.backend.bounded
            if tk in full or whole or self._size(tk) + size > self.SHARE:
                full.add(tk)
                return FULL
            mine[here] = one
        self.states[tk] = known._replace(head=here, digest=one.header.digest)
        return KNOWN if there else STORED

    @rule(data=st.data(), tks=st.lists(st.sampled_from([A, B]), max_size=5))
    def append(self, data: st.DataObject, tks: Sequence[bytes]) -> None:
        offers, full, expected = [], set[bytes](), []
        draw, pick = data.draw, st.sampled_from
        for tk in tks:
            heads = [NO_DIGEST, *(one.header.digest for one in self.made), *([self.states[tk].digest] * 4)]
            previous = draw(pick(heads))
            one = chunk(draw(st.integers(0, 5)), draw(pick([EARLY, STREAM, LATE])), size=draw(pick([0, 400, 1200])),
                        variant=draw(st.integers(0, 1)), previous=previous)  # fmt: skip
            one = draw(pick([one, one, *self.made[-5:]]))
            self.made.append(one)
            offers.append(Offer(tk, dropped(one) if draw(st.booleans()) else one, draw(pick([b"", *heads]))))
        for offer in offers:
            expected.append(self._expect(offer, full))
        assert self.store.append(offers, T0) == expected

    @rule(data=st.data(), tk=st.sampled_from([A, B]), why=st.sampled_from(["", "", "why"]))
    def remove(self, data: st.DataObject, tk: bytes, why: str) -> None:
        if self.made:
            gone = [place(one) for one in data.draw(st.lists(st.sampled_from(self.made), max_size=3))]
            self.store.remove(tk, gone, why)
            for at in gone:
                one = self.rows[tk].pop(at, None)
                if why and one:
                    self.buried.add((tk, one.encoded))

    @rule(data=st.data(), tk=st.sampled_from([A, B]))
    def follow(self, data: st.DataObject, tk: bytes) -> None:
        tail = data.draw(st.sampled_from([None, *self.made]))
        hash = NO_HASH if tail is None else Web3.keccak(tail.encoded)
        self.store.follow(tk, hash, None if tail is None else tail.header)
        at, digest = (NOWHERE, NO_DIGEST) if tail is None else (place(tail), tail.header.digest)
        self.states[tk] = self.states[tk]._replace(head=at, digest=digest, base=hash)
        self.rows[tk] = {there: one for there, one in self.rows[tk].items() if there > at}

    @rule(data=st.data(), tk=st.sampled_from([A, B]), keep=st.sampled_from([0, 1000, PLENTY]), old=st.booleans())
    def confirm_and_forget(self, data: st.DataObject, tk: bytes, keep: int, old: bool) -> None:
        mine = self.rows[tk]
        confirmed = data.draw(st.sampled_from([NOWHERE, *mine]))
        block = len(mine)
        self.store.set_state(tk, confirmed=confirmed, block=block)
        self.store.forget(tk, T0 + old, keep)
        base = self.states[tk].base
        for at in sorted(mine):
            if at < confirmed and (old or self._size(tk) > keep):
                base = Web3.keccak(mine.pop(at).encoded)
        self.states[tk] = self.states[tk]._replace(confirmed=confirmed, block=block, base=base)

    @rule()
    def another_process(self) -> None:
        self.store.close()
        self.store = self.open()

    @invariant()
    def agree(self) -> None:
        assert self.store.states([A, B]) == [self.states[A], self.states[B]]
        for tk, mine in self.rows.items():
            assert [one.encoded for one in held(self.store, tk)] == [mine[at].encoded for at in sorted(mine)]
            assert self.store.sizes().get(tk, 0) == self._size(tk)
            waits = [one for at, one in mine.items() if at > self.states[tk].confirmed]
            assert self.store.waiting(tk)[:3] == (
                len(waits), sum(one.header.records for one in waits), sum(len(one.encoded) for one in waits),
            )  # fmt: skip
        assert {(letter.tk, letter.chunk) for letter in self.store.dead(PLENTY)} == self.buried


def test_any_sequence_of_calls_agrees_with_plain_lists(backend):
    examples = settings.default.max_examples // (5 if isinstance(backend, ClusterBackend) else 1)
    run_state_machine_as_test(
        lambda: Model(backend),
        settings=settings(max_examples=examples, stateful_step_count=15, suppress_health_check=[HealthCheck.too_slow]),
    )
