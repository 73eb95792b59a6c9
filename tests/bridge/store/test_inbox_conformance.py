"""What every back end of the inbox has to do; see rosbridge_eth.store.inbox.Inbox.

Written against the protocol alone. `now` is given, never slept for.
"""

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

from bridge.store.inbox_backends import BACKENDS, Backend
from rosbridge_eth.records import MAX_SEQ, RecordId, SealedRecord
from rosbridge_eth.store import Inbox, InboxLimits, Outcome, State

A, B = b"a" * 32, b"b" * 32
S1, S2 = b"\xff" * 16, b"\x00" * 16  # the stream that arrives first sorts last
T0 = 1_763_690_000.0


@pytest.fixture(params=list(BACKENDS))
def backend(request, tmp_path) -> Backend:
    return BACKENDS[request.param](tmp_path, request.getfixturevalue)


@pytest.fixture
def inbox(backend) -> Iterator[Inbox]:
    opened = backend.open()
    yield opened
    opened.close()


def record(seq: int, robot: bytes = A, stream: bytes = S1, content: bytes = b"", size: int = 256) -> SealedRecord:
    return SealedRecord(RecordId(robot, stream, seq), (content or seq.to_bytes(8, "big")).ljust(size, b"."))


def take(inbox: Inbox, consumer: str = "c", limit: int = 100, max_bytes: int = 1 << 20, now: float = T0, **more):
    return inbox.lease(consumer, limit=limit, max_bytes=max_bytes, now=now, ttl=30, **more)


def seqs(leased) -> list[int]:
    return [item.record.id.seq for item in leased]


def ids(leased) -> list[RecordId]:
    return [item.record.id for item in leased]


# --- append


def test_each_record_is_new_once_and_then_a_duplicate(inbox):
    records = [record(n) for n in range(3)]
    assert inbox.append(records, T0) == [Outcome.NEW] * 3
    assert inbox.append([*records, record(3)], T0) == [Outcome.DUPLICATE] * 3 + [Outcome.NEW]
    assert inbox.append([], T0) == []
    assert inbox.statistics(T0).waiting == 4


def test_twice_in_one_append(inbox):
    assert inbox.append([record(1), record(1), record(1, content=b"other")], T0) == [
        Outcome.NEW,
        Outcome.DUPLICATE,
        Outcome.CONFLICT,
    ]


def test_what_was_appended_comes_out_unchanged(inbox):
    sent = SealedRecord(RecordId(A, S1, 7), bytes(range(256)) * 128)
    inbox.append([sent], T0)
    (leased,) = take(inbox, now=T0 + 5)
    assert (leased.record, leased.arrived, leased.attempts) == (sent, T0, 1)


def test_the_largest_seq(inbox):
    inbox.append([record(MAX_SEQ), record(0), record(2**63), record(2**63 - 1)], T0)
    assert seqs(take(inbox)) == [0, 2**63 - 1, 2**63, MAX_SEQ]


def test_the_same_place_in_other_streams_and_robots_is_another_record(inbox):
    assert inbox.append([record(1), record(1, stream=S2), record(1, robot=B)], T0) == [Outcome.NEW] * 3


@pytest.mark.parametrize("fate", ["waiting", "leased", "done", "dead"])
def test_other_bytes_under_a_known_identity_are_a_conflict_and_kept_aside(inbox, fate):
    first, other = record(1), record(1, content=b"other")
    inbox.append([first], T0)
    if fate == "leased":
        take(inbox)
    if fate == "done":
        inbox.done([first.id], T0)
    if fate == "dead":
        inbox.dead_letter([first.id], "cannot be mined", T0)
    state, held = inbox.state(first.id, T0), inbox.statistics(T0).bytes
    assert inbox.append([other, other], T0 + 1) == [Outcome.CONFLICT] * 2
    assert inbox.append([first], T0 + 2) == [Outcome.DUPLICATE]
    assert inbox.append([other], T0 + 3) == [Outcome.CONFLICT]
    assert inbox.state(first.id, T0) is state
    assert inbox.statistics(T0).bytes == held + len(other.ciphertext)
    conflicts = [letter for letter in inbox.dead_letters() if letter.conflict]
    assert [(letter.record, letter.at) for letter in conflicts] == [(other, T0 + 1)]
    assert conflicts[0].reason


def test_at_the_bound_nothing_new_is_taken_but_duplicates_are_still_known(backend):
    inbox = backend.open(InboxLimits(records=3))
    assert inbox.append([record(n) for n in range(5)], T0) == [Outcome.NEW] * 3 + [Outcome.FULL] * 2
    assert inbox.append([record(2), record(3)], T0) == [Outcome.DUPLICATE, Outcome.FULL]
    assert inbox.append([record(2, content=b"other")], T0) == [Outcome.FULL]
    assert inbox.state(record(3).id, T0) is State.UNKNOWN
    inbox.done([record(0).id], T0)
    assert inbox.append([record(3), record(4)], T0) == [Outcome.NEW, Outcome.FULL]
    inbox.close()


def test_bytes_are_bounded_too_and_dead_letters_count(backend):
    inbox = backend.open(InboxLimits(bytes=1000))
    assert inbox.append([record(n, size=400) for n in range(3)], T0) == [Outcome.NEW, Outcome.NEW, Outcome.FULL]
    inbox.dead_letter([record(0).id], "bad", T0)
    assert inbox.append([record(2, size=400)], T0) == [Outcome.FULL]
    inbox.done([record(1).id], T0)
    assert inbox.append([record(2, size=400)], T0) == [Outcome.NEW]
    assert inbox.statistics(T0).bytes == 800
    inbox.close()


# --- lease


def test_records_come_in_order_streams_as_they_arrived(inbox):
    inbox.append([record(n, stream=S1) for n in (5, 3, 4)], T0)
    inbox.append([record(n, stream=S2) for n in (1, 0)], T0)
    inbox.append([record(2, stream=S1)], T0)
    assert [(i.stream, i.seq) for i in ids(take(inbox))] == [(S1, 2), (S1, 3), (S1, 4), (S1, 5), (S2, 0), (S2, 1)]


def test_limits_of_a_lease(inbox):
    inbox.append([record(n, size=300) for n in range(6)], T0)
    assert seqs(take(inbox, limit=2)) == [0, 1]
    assert seqs(take(inbox, max_bytes=899)) == [2, 3]
    assert seqs(take(inbox, max_bytes=1)) == [4]  # one in any case, or it would never go


def test_a_leased_record_is_not_given_out_again_until_the_lease_ends(inbox):
    inbox.append([record(0)], T0)
    assert seqs(take(inbox, now=T0)) == [0]
    assert take(inbox, now=T0 + 29.9) == []
    assert inbox.state(record(0).id, T0 + 29.9) is State.LEASED
    assert inbox.state(record(0).id, T0 + 30) is State.WAITING
    (again,) = take(inbox, "another", now=T0 + 30)
    assert again.attempts == 2


def test_one_robot_is_leased_to_one_consumer_at_a_time(inbox):
    inbox.append([record(n) for n in range(4)], T0)
    assert seqs(take(inbox, "one", limit=2)) == [0, 1]
    assert take(inbox, "two") == []
    assert seqs(take(inbox, "one", limit=1)) == [2]
    inbox.append([record(0, robot=B)], T0)
    assert ids(take(inbox, "two")) == [RecordId(B, S1, 0)]
    assert seqs(take(inbox, "two", now=T0 + 31, robot=A)) == [0, 1, 2, 3]


def test_robots_take_turns(inbox):
    inbox.append([record(n, robot=robot) for robot in (A, B) for n in range(6)], T0)
    turns = [take(inbox, limit=2)[0].record.id.robot for _ in range(6)]
    assert turns in ([A, B] * 3, [B, A] * 3)


def test_one_robot_can_be_asked_for(inbox):
    inbox.append([record(0, robot=A), record(0, robot=B)], T0)
    assert ids(take(inbox, robot=B)) == [RecordId(B, S1, 0)]
    assert take(inbox, robot=B) == []
    assert take(inbox, robot=b"c" * 32) == []


def test_all_that_is_held_of_one_robot_can_be_looked_at_whoever_leased_it(inbox):
    inbox.append([record(n) for n in (2, 0, 1)], T0)
    inbox.append([record(5, stream=S2), record(7, robot=B)], T0)
    take(inbox, limit=1)
    inbox.done([record(1).id], T0)
    assert inbox.held(A, 100) == [record(0), record(2), record(5, stream=S2)]
    assert inbox.held(A, 2) == [record(0), record(2)]
    assert inbox.held(b"c" * 32, 100) == []
    assert inbox.statistics(T0).leased == 1


def test_released_records_are_given_out_again_in_order(inbox):
    inbox.append([record(n) for n in range(4)], T0)
    leased = take(inbox, "one")
    inbox.release("two", ids(leased))
    assert take(inbox, "two") == []
    inbox.release("one", [*ids(leased)[:2], RecordId(A, S1, 99), RecordId(B, S2, 0)])
    assert take(inbox, "two") == []  # the other two are still out
    inbox.release("one", ids(leased))
    assert seqs(take(inbox, "two")) == [0, 1, 2, 3]


def test_a_consumer_that_starts_again_takes_back_what_its_earlier_life_had(inbox):
    inbox.append([record(n) for n in range(3)] + [record(0, robot=B)], T0)
    taken = take(inbox, "one", robot=A)
    assert seqs(taken) == [0, 1, 2]
    inbox.reclaim("two")
    assert take(inbox, "two", robot=A) == []
    assert ids(take(inbox, "two", robot=B)) == [RecordId(B, S1, 0)]
    inbox.reclaim("one")
    assert take(inbox, "one", robot=B) == []  # another's, still
    again = take(inbox, "one", robot=A)
    assert seqs(again) == [0, 1, 2]
    assert [entry.attempts for entry in again] == [2, 2, 2]
    assert take(inbox, "two", robot=A) == []
    inbox.done(ids(again), T0)
    inbox.reclaim("one")
    assert take(inbox, "one", robot=A) == []


# --- the end of a record


def test_done_is_remembered(inbox):
    inbox.append([record(0), record(1)], T0)
    take(inbox)
    inbox.done([record(0).id, RecordId(B, S1, 9)], T0)
    assert inbox.state(record(0).id, T0) is State.DONE
    assert inbox.append([record(0)], T0) == [Outcome.DUPLICATE]
    assert seqs(take(inbox, now=T0 + 31)) == [1]
    assert inbox.state(RecordId(B, S1, 9), T0) is State.UNKNOWN


def test_the_journal_may_finish_what_was_leased_to_someone_else_by_now(inbox):
    inbox.append([record(0)], T0)
    take(inbox, "slow")
    take(inbox, "fast", now=T0 + 31)
    inbox.done([record(0).id], T0 + 32)
    assert inbox.state(record(0).id, T0 + 32) is State.DONE
    inbox.release("fast", [record(0).id])
    assert take(inbox, now=T0 + 99) == []


def test_dead_letters_are_listed_with_their_reason(inbox):
    inbox.append([record(n) for n in range(3)], T0)
    inbox.dead_letter([record(0).id], "too large for a block", T0 + 1)
    inbox.dead_letter([record(2).id, record(0).id, RecordId(B, S1, 9)], "reverts", T0 + 2)
    letters = inbox.dead_letters()
    assert [(d.record, d.reason, d.at, d.conflict) for d in letters] == [
        (record(0), "too large for a block", T0 + 1, False),
        (record(2), "reverts", T0 + 2, False),
    ]
    assert inbox.dead_letters(1) == letters[:1]
    assert inbox.dead_letters(after=1) == letters[1:]
    assert inbox.state(record(0).id, T0) is State.DEAD
    inbox.done([record(0).id], T0 + 3)
    assert inbox.state(record(0).id, T0) is State.DEAD
    assert seqs(take(inbox)) == [1]


def test_what_is_forgotten_is_new_again_and_only_the_done_are(inbox):
    inbox.append([record(n) for n in range(4)], T0)
    inbox.done([record(0).id], T0)
    inbox.done([record(1).id], T0 + 10)
    inbox.dead_letter([record(2).id], "bad", T0)
    assert inbox.forget(T0 + 10) == 1
    assert [inbox.state(record(n).id, T0) for n in range(4)] == [
        State.UNKNOWN, State.DONE, State.DEAD, State.WAITING,
    ]
    assert inbox.append([record(n) for n in range(4)], T0) == [Outcome.NEW] + [Outcome.DUPLICATE] * 3
    inbox.done([record(0).id], T0)
    assert [inbox.forget(T0 + 11, limit=1) for _ in range(3)] == [1, 1, 0]


def test_statistics(inbox):
    assert inbox.statistics(T0).oldest_age is None
    inbox.append([record(n) for n in range(2)], T0)
    inbox.append([record(n) for n in range(2, 6)], T0 + 3)
    take(inbox, limit=3)
    inbox.done([record(0).id, record(1).id], T0)
    inbox.dead_letter([record(5).id], "bad", T0)
    stats = inbox.statistics(T0 + 10)
    assert (stats.waiting, stats.leased, stats.done, stats.dead) == (2, 1, 2, 1)
    assert (stats.bytes, stats.oldest_age) == (4 * 256, 7)


# --- several processes, and their death


def test_another_object_sees_what_was_committed(backend):
    one, two = backend.open(), backend.open()
    one.append([record(0)], T0)
    assert two.append([record(0), record(1)], T0) == [Outcome.DUPLICATE, Outcome.NEW]
    assert seqs(take(two, "two")) == [0, 1]
    assert take(one, "one") == []
    one.done([record(0).id], T0)
    assert two.state(record(0).id, T0) is State.DONE
    one.close()
    two.close()


CHILD = """
import random, sys
from rosbridge_eth.records import RecordId, SealedRecord
inbox, seed, T0 = {opener}, int(sys.argv[1]), {T0}
rng = random.Random(seed)
A, S = b"a" * 32, bytes([seed]) * 16
{body}
"""


def child(backend: Backend, seed: int, body: str) -> subprocess.Popen[str]:
    source = CHILD.format(opener=backend.opener_source(), T0=T0, body=textwrap.dedent(body))
    environment = os.environ | {"PYTHONPATH": os.pathsep.join(path for path in sys.path if path)}
    return subprocess.Popen(
        [sys.executable, "-c", source, str(seed)], stdout=subprocess.PIPE, text=True, env=environment
    )


def test_processes_append_the_same_records_and_each_is_new_once(backend, inbox):
    body = """
    news = 0
    order = list(range(300))
    rng.shuffle(order)
    for start in range(0, 300, 20):
        group = [SealedRecord(RecordId(A, b"s" * 16, n), b"%d" % n) for n in order[start:start + 20]]
        news += sum(outcome.value == "new" for outcome in inbox.append(group, T0))
    print(news)
    """
    children = [child(backend, seed, body) for seed in range(3)]
    counts = [int(process.communicate(timeout=60)[0]) for process in children]
    assert sum(counts) == 300
    assert inbox.statistics(T0).waiting == 300


def test_processes_lease_and_no_record_is_given_to_two(backend, inbox):
    inbox.append([record(n, robot=bytes([r]) * 32) for r in range(6) for n in range(50)], T0)
    body = """
    while leased := inbox.lease(str(seed), limit=7, max_bytes=1 << 20, now=T0, ttl=1000):
        for item in leased:
            print(item.record.id.robot[0], item.record.id.seq)
        if rng.random() < 0.5:
            inbox.done([item.record.id for item in leased], T0)
    """
    children = [child(backend, seed, body) for seed in range(3)]
    given = [line for process in children for line in process.communicate(timeout=60)[0].split("\n") if line]
    assert sorted(given) == sorted(f"{r} {n}" for r in range(6) for n in range(50))


@pytest.mark.parametrize("seed", range(4))
def test_a_killed_process_leaves_every_append_it_was_told_of_and_none_in_part(backend, seed):
    """SIGKILL at a random moment, between any two writes. Groups of 5 are there whole or not at all."""
    body = """
    for start in range(0, 100_000, 5):
        inbox.append([SealedRecord(RecordId(A, S, n), b"%d" % n) for n in range(start, start + 5)], T0)
        print(start, flush=True)
        if start % 3 == 0:
            leased = inbox.lease("c", limit=3, max_bytes=1 << 20, now=T0, ttl=1)
            inbox.done([item.record.id for item in leased], T0)
    """
    rng = random.Random(seed)
    process = child(backend, seed, body)
    told, wanted = -5, rng.randrange(5, 500, 5)
    for line in process.stdout:
        told = int(line)
        if told >= wanted:
            process.kill()
    process.wait(timeout=60)
    inbox = backend.open()
    known = [inbox.state(RecordId(A, bytes([seed]) * 16, n), T0) is not State.UNKNOWN for n in range(told + 15)]
    stored = sum(known)
    assert known == [True] * stored + [False] * (len(known) - stored), f"seed {seed}"
    assert stored % 5 == 0
    assert told + 5 <= stored <= told + 10
    stats = inbox.statistics(T0)
    assert stats.waiting + stats.leased + stats.done == stored
    assert stats.bytes == sum(len(b"%d" % n) for n in range(stored)) - _done_bytes(inbox, seed, stored)
    inbox.close()


def _done_bytes(inbox: Inbox, seed: int, stored: int) -> int:
    ids = ((n, RecordId(A, bytes([seed]) * 16, n)) for n in range(stored))
    return sum(len(b"%d" % n) for n, id in ids if inbox.state(id, T0) is State.DONE)


# --- any sequence of calls, against a model


class InboxMachine(RuleBasedStateMachine):
    """Two objects on the same data; the model is a dictionary."""

    backend: Backend
    LIMIT = 12

    @initialize()
    def begin(self) -> None:
        self.now = T0
        self.inboxes = [self.backend.open(InboxLimits(records=self.LIMIT)) for _ in range(2)]
        self.bytes: dict[RecordId, bytes] = {}
        self.fate: dict[RecordId, State] = {}
        self.leases: dict[RecordId, tuple[str, float]] = {}
        self.arrival: dict[tuple[bytes, bytes], int] = {}
        self.conflicts: set[tuple[RecordId, bytes]] = set()
        self.dead: list[tuple[RecordId, bytes]] = []

    def teardown(self) -> None:
        for inbox in getattr(self, "inboxes", []):
            inbox.close()
        self.backend.clear()

    KEYS = st.builds(RecordId, st.sampled_from([A, B]), st.sampled_from([S1, S2]), st.integers(0, 5))
    WHICH = st.integers(0, 1)

    def held(self) -> int:
        return sum(self.fate[id] in (State.WAITING, State.DEAD) for id in self.fate) + len(self.conflicts)

    def lessee(self, id: RecordId) -> str | None:
        consumer, until = self.leases.get(id, ("", 0.0))
        return consumer if until > self.now else None

    @rule(which=WHICH, keys=st.lists(st.tuples(KEYS, st.sampled_from([b"x", b"x", b"x", b"y"])), max_size=5))
    def append(self, which, keys):
        outcomes = self.inboxes[which].append([SealedRecord(id, content) for id, content in keys], self.now)
        for (id, content), outcome in zip(keys, outcomes, strict=True):
            if id in self.bytes and self.bytes[id] == content:
                assert outcome is Outcome.DUPLICATE
            elif self.held() >= self.LIMIT:
                assert outcome is Outcome.FULL
            elif id in self.bytes:
                assert outcome is Outcome.CONFLICT
                if (id, content) not in self.conflicts:
                    self.dead.append((id, content))
                self.conflicts.add((id, content))
            else:
                assert outcome is Outcome.NEW
                self.arrival.setdefault((id.robot, id.stream), len(self.arrival))
                self.bytes[id], self.fate[id] = content, State.WAITING

    @rule(which=WHICH, consumer=st.sampled_from(["c", "d"]), limit=st.integers(1, 6), ttl=st.integers(1, 9),
          robot=st.sampled_from([None, A, B]))
    def lease(self, which, consumer, limit, ttl, robot):
        free = {id for id, fate in self.fate.items() if fate is State.WAITING and self.lessee(id) is None}
        barred = {id.robot for id, fate in self.fate.items()
                  if fate is State.WAITING and self.lessee(id) not in (None, consumer)}
        open_to = {id.robot for id in free} - barred & {id.robot for id in free}
        if robot is not None:
            open_to &= {robot}
        leased = self.inboxes[which].lease(
            consumer, limit=limit, max_bytes=1 << 20, now=self.now, ttl=ttl, robot=robot
        )
        assert bool(leased) == bool(open_to)
        if leased:
            given = leased[0].record.id.robot
            assert given in open_to
            order = sorted((id for id in free if id.robot == given),
                           key=lambda id: (self.arrival[id.robot, id.stream], id.seq))
            assert ids(leased) == order[:limit]
            for item in leased:
                assert item.record.ciphertext == self.bytes[item.record.id]
                self.leases[item.record.id] = consumer, self.now + ttl

    @rule(which=WHICH, consumer=st.sampled_from(["c", "d"]), keys=st.lists(KEYS, max_size=4))
    def release(self, which, consumer, keys):
        self.inboxes[which].release(consumer, keys)
        for id in keys:
            if self.leases.get(id, ("", 0))[0] == consumer:
                del self.leases[id]

    @rule(which=WHICH, keys=st.lists(KEYS, max_size=4), dead=st.booleans())
    def finish(self, which, keys, dead):
        if dead:
            self.inboxes[which].dead_letter(keys, "reason", self.now)
        else:
            self.inboxes[which].done(keys, self.now)
        for id in keys:
            if self.fate.get(id) is State.WAITING:
                self.fate[id] = State.DEAD if dead else State.DONE
                self.leases.pop(id, None)
                if dead:
                    self.dead.append((id, self.bytes[id]))

    @rule(seconds=st.integers(1, 10))
    def wait(self, seconds):
        self.now += seconds

    @rule(which=WHICH)
    def reopen(self, which):
        self.inboxes[which].close()
        self.inboxes[which] = self.backend.open(InboxLimits(records=self.LIMIT))

    @rule(which=WHICH)
    def forget(self, which):
        done = [id for id, fate in self.fate.items() if fate is State.DONE]
        assert self.inboxes[which].forget(self.now + 1) == len(done)
        for id in done:
            del self.fate[id], self.bytes[id]

    @invariant()
    def agrees(self):
        if not hasattr(self, "inboxes"):
            return
        for inbox in self.inboxes:
            for id, fate in self.fate.items():
                leased = fate is State.WAITING and self.lessee(id) is not None
                assert inbox.state(id, self.now) is (State.LEASED if leased else fate)
            assert [(d.record.id, d.record.ciphertext) for d in inbox.dead_letters()] == self.dead
            stats = inbox.statistics(self.now)
            counts = [list(self.fate.values()).count(fate) for fate in (State.WAITING, State.DONE)]
            assert [stats.waiting + stats.leased, stats.done] == counts
            assert stats.dead == len(self.dead)
            assert stats.bytes == self.held()


def test_any_sequence_of_calls_agrees_with_the_model(backend):
    machine = type("Machine", (InboxMachine,), {"backend": backend})
    run_state_machine_as_test(
        machine,
        settings=settings(
            max_examples=60, stateful_step_count=30, deadline=None, suppress_health_check=list(HealthCheck)
        ),
    )
