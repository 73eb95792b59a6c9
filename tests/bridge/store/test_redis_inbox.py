"""What is Redis's own about the inbox in a Redis: durability demanded, outages, crashes, passwords, sharing."""

from __future__ import annotations

import random
import re
import socket
import subprocess
import sys
import threading
import traceback
from collections.abc import Iterator
from pathlib import Path

import pytest
import redis

from bridge.store.redis_server import DURABLE, RedisServer
from rosbridge_eth.errors import StoreError
from rosbridge_eth.records import RecordId, SealedRecord
from rosbridge_eth.store import InboxLimits, Outcome, State, redis_inbox
from rosbridge_eth.store.redis_inbox import RedisInbox

T0 = 1_763_690_000.0
A, B = b"a" * 32, b"b" * 32
HOWTO = Path(__file__).parents[3] / "docs" / "howto-redis.md"
SECRET = "pa:ss word%2F"


def record(seq: int, size: int = 256, robot: bytes = A) -> SealedRecord:
    return SealedRecord(RecordId(robot, b"s" * 16, seq), seq.to_bytes(8, "big").ljust(size, b"."))


def take(inbox: RedisInbox, consumer: str = "c", limit: int = 100, now: float = T0):
    return [item.record.id.seq for item in inbox.lease(consumer, limit=limit, max_bytes=1 << 30, now=now, ttl=30)]


@pytest.fixture
def start(tmp_path) -> Iterator:
    """Start a Redis of this test's own, with other options if given."""
    servers: list[RedisServer] = []

    def begin(*options: str) -> RedisServer:
        folder = tmp_path / str(len(servers))
        folder.mkdir()
        servers.append(RedisServer(folder, *options))
        return servers[-1]

    yield begin
    for server in servers:
        server.kill()


@pytest.fixture
def server(start) -> RedisServer:
    return start()


# --- durability


@pytest.mark.parametrize(
    ("options", "names"),
    [
        (("--appendonly", "no"), ["CONFIG SET appendonly yes", "CONFIG SET appendfsync always"]),
        (("--appendonly", "yes", "--appendfsync", "everysec"), ["CONFIG SET appendfsync always"]),
        ((*DURABLE, "--no-appendfsync-on-rewrite", "yes"), ["CONFIG SET no-appendfsync-on-rewrite no"]),
        ((*DURABLE[:4], "--maxmemory-policy", "allkeys-lru"), ["CONFIG SET maxmemory-policy noeviction"]),
    ],
    ids=["no AOF", "everysec", "no fsync while rewriting", "eviction"],
)
def test_a_redis_that_may_lose_records_is_refused_and_the_commands_named_mend_it(start, options, names):
    server = start(*options)
    with pytest.raises(StoreError, match="could lose") as refusal:
        RedisInbox(server.url, "x")
    text = str(refusal.value)
    assert all(name in text for name in names)
    with server.client() as client:
        assert client.dbsize() == 0
        for command in text.partition("In redis-cli: ")[2].split("; ")[:-1]:
            client.execute_command(*command.split())
    RedisInbox(server.url, "x").close()


@pytest.mark.parametrize(("name", "value"), [("appendfsync", "everysec"), ("appendonly", "no"),
                                             ("maxmemory-policy", "volatile-lru")])
def test_a_setting_that_is_changed_while_the_server_runs_stops_acknowledgements(server, name, value):
    inbox = RedisInbox(server.url, "x")
    inbox.append([record(0)], T0)
    with server.client() as client:
        before = client.config_get(name)[name]
        client.config_set(name, value)
        with pytest.raises(StoreError, match=name):
            inbox.append([record(1)], T0)
        client.config_set(name, before)
    # It may be there already: then it is a duplicate, and only now acknowledged.
    assert inbox.append([record(1)], T0)[0] in (Outcome.NEW, Outcome.DUPLICATE)
    inbox.close()


def test_keys_that_vanish_are_told_and_not_begun_anew_unseen(server):
    inbox = RedisInbox(server.url, "x")
    inbox.append([record(0)], T0)
    with server.client() as client:
        client.flushall()
    for call in (lambda: inbox.append([record(1)], T0), lambda: take(inbox), lambda: inbox.statistics(T0)):
        with pytest.raises(StoreError, match=r"gone.*restore"):
            call()
    inbox.close()
    with RedisInbox(server.url, "x") as again:
        assert again.append([record(1)], T0) == [Outcome.NEW]


def test_keys_changed_by_something_else_are_told(server):
    with RedisInbox(server.url, "x") as inbox, server.client() as client:
        inbox.append([record(0)], T0)
        (stream,) = client.keys("rosbridge-eth:*:records")
        client.xtrim(stream, maxlen=0)
        with pytest.raises(StoreError, match="do not agree"):
            take(inbox)


def test_at_maxmemory_nothing_is_acknowledged_and_what_is_there_drains(server):
    with RedisInbox(server.url, "x") as inbox, server.client() as client:
        inbox.append([record(n, size=30_000) for n in range(100)], T0)
        client.config_set("maxmemory", client.info("memory")["used_memory"] + 1_000_000)
        taken = 100
        with pytest.raises(StoreError, match="maxmemory"):
            for taken in range(100, 1000, 10):
                inbox.append([record(n, size=30_000) for n in range(taken, taken + 10)], T0)
        known = [inbox.state(record(n).id, T0) is State.WAITING for n in range(taken + 10)]
        assert known == [True] * taken + [False] * 10
        assert take(inbox, limit=70) == list(range(70))
        inbox.release("c", [record(69).id])
        inbox.done([record(n).id for n in range(69)], T0)
        assert inbox.append([record(taken, size=30_000)], T0) == [Outcome.NEW]
        assert inbox.statistics(T0).waiting == taken + 1 - 69


# --- outages


def test_no_redis_there_is_told_and_the_password_is_not():
    url = "redis://operator:hunter2@127.0.0.1:1/3"
    with pytest.raises(StoreError, match=r"127\.0\.0\.1:1 ") as failure:
        RedisInbox(url, "x")
    assert "hunter2" not in "".join(traceback.format_exception(failure.value))


@pytest.mark.parametrize("url", ["redis://:hunter2@host:port/0", "redis://:hunter2/@host/0", "http://:hunter2@host",
                                 "redis://:hunter2@host:70000/0", "redis://:hunter2@host/0?decode_responses=yes"])
def test_a_url_that_cannot_be_used_is_told_without_the_password(url):
    with pytest.raises(StoreError) as failure:
        RedisInbox(url, "x")
    assert "hunter2" not in "".join(traceback.format_exception(failure.value))


def test_passwords(start):
    server = start(*DURABLE, "--requirepass", SECRET)
    host = f"127.0.0.1:{server.port}"
    with RedisInbox(f"redis://:{'pa%3Ass%20word%252F'}@{host}/0", "x") as inbox:
        assert inbox.append([record(0)], T0) == [Outcome.NEW]
        assert SECRET not in repr(inbox)
    for url in (f"redis://:wr0ng@{host}/0", f"redis://someone:wr0ng@{host}/0", f"redis://{host}/0"):
        with pytest.raises(StoreError, match=r"(user name or password|Authentication)") as failure:
            RedisInbox(url, "x")
        assert "wr0ng" not in "".join(traceback.format_exception(failure.value))


def test_a_unix_socket(start, tmp_path):
    path = tmp_path / "redis.sock"
    start(*DURABLE, "--unixsocket", str(path))
    with RedisInbox(f"unix://{path}?db=2", "x") as inbox:
        assert inbox.append([record(0)], T0) == [Outcome.NEW]


def test_each_call_fails_while_redis_is_away_and_the_next_one_after_its_return_works(server):
    with RedisInbox(server.url, "x") as inbox:
        inbox.append([record(0)], T0)
        server.kill()
        for _ in range(2):
            with pytest.raises(StoreError, match="cannot be used"):
                inbox.append([record(1)], T0)
        with pytest.raises(StoreError):
            take(inbox)
        server.start()
        assert inbox.append([record(0), record(1)], T0) == [Outcome.DUPLICATE, Outcome.NEW]
        assert take(inbox) == [0, 1]


def test_a_redis_that_does_not_answer_is_given_up_and_a_late_answer_is_not_taken_for_the_next(server, monkeypatch):
    monkeypatch.setattr(redis_inbox, "ANSWER_TIMEOUT", 0.2)
    with RedisInbox(server.url, "x") as inbox:
        server.pause()
        try:
            with pytest.raises(StoreError, match="does not answer"):
                inbox.append([record(0)], T0)
        finally:
            server.resume()
        with server.client() as client:
            client.ping()
        assert inbox.statistics(T0).waiting == 1  # the command had reached it; sent again it is no second one
        assert inbox.append([record(0)], T0) == [Outcome.DUPLICATE]


def test_scripts_may_be_flushed(server):
    with RedisInbox(server.url, "x") as inbox, server.client() as client:
        client.script_flush()
        assert inbox.append([record(0), record(1)], T0) == [Outcome.NEW] * 2
        client.script_flush()
        assert take(inbox) == [0, 1]


# --- sharing, and what redis-cli shows


def test_inboxes_of_other_contracts_in_one_redis_are_apart(server):
    with RedisInbox(server.url, "chain 1, contract 0xA") as one, RedisInbox(server.url, "chain 1, contract 0xB") as two:
        one.append([record(0)], T0)
        assert two.state(record(0).id, T0) is State.UNKNOWN
        assert take(two) == []
        assert two.append([record(0)], T0) == [Outcome.NEW]


def test_keys_of_another_format_are_not_touched(server):
    RedisInbox(server.url, "x").close()
    with server.client() as client:
        (meta,) = client.keys("rosbridge-eth:*:meta")
        client.hset(meta, "format", 2)
    with pytest.raises(StoreError, match="another version"):
        RedisInbox(server.url, "x")


def test_the_consumer_group_shows_who_holds_what_and_a_dead_holders_records_go_to_another(server):
    with RedisInbox(server.url, "x") as inbox, server.client() as client:
        inbox.append([record(n) for n in range(4)], T0)
        (stream,) = client.keys("rosbridge-eth:*:records")
        assert take(inbox, "host:1", limit=2) == [0, 1]
        assert client.xpending(stream, "ledger")["consumers"] == [{"name": b"host:1", "pending": 2}]
        assert take(inbox, "host:2", now=T0 + 29) == []
        assert take(inbox, "host:2", now=T0 + 30) == [0, 1, 2, 3]
        pending = client.xpending_range(stream, "ledger", "-", "+", 10)
        assert [(entry["consumer"], entry["times_delivered"]) for entry in pending] == [
            (b"host:2", 2), (b"host:2", 2), (b"host:2", 1), (b"host:2", 1),
        ]
        inbox.release("host:2", [record(3).id])
        assert [item.attempts for item in inbox.lease("host:2", limit=9, max_bytes=9999, now=T0 + 31, ttl=9)] == [2]
        inbox.done([record(n).id for n in range(4)], T0)
        assert client.xpending(stream, "ledger")["pending"] == 0
        inbox.forget(T0)
        assert client.xinfo_consumers(stream, "ledger") == []


def test_everything_done_and_forgotten_leaves_nothing_per_record(server):
    with RedisInbox(server.url, "x") as inbox, server.client() as client:
        inbox.append([record(0)], T0)
        inbox.done([record(0).id], T0)
        inbox.forget(T0 + 1)
        empty = {key: client.memory_usage(key) for key in client.keys("*")}
        for start in range(0, 2000, 100):
            inbox.append([record(n) for n in range(start, start + 100)], T0)
            take(inbox)
            inbox.done([record(n).id for n in range(start, start + 100)], T0)
        assert inbox.forget(T0 + 1) == 2000
        after = {key: client.memory_usage(key) for key in client.keys("*")}
        assert after.keys() == empty.keys()
        assert sum(after.values()) < sum(empty.values()) + 2000


# --- killed and started again under load

WRITER = """
import sys
from rosbridge_eth.errors import StoreError
from rosbridge_eth.records import RecordId, SealedRecord
from rosbridge_eth.store import Outcome
from rosbridge_eth.store.redis_inbox import RedisInbox
url, robot, groups = sys.argv[1], bytes([int(sys.argv[2])]) * 32, int(sys.argv[3])
inbox = RedisInbox(url, "x")
print("ready", flush=True)
for start in range(0, groups * 5, 5):
    group = [SealedRecord(RecordId(robot, b"s" * 16, n), b"%d" % n) for n in range(start, start + 5)]
    while True:
        try:
            outcomes = inbox.append(group, 1763690000.0)
            break
        except StoreError:
            pass
    assert set(outcomes) in ({Outcome.NEW}, {Outcome.DUPLICATE}), outcomes
    print(start, flush=True)
"""


@pytest.mark.parametrize("seed", range(3))
def test_killed_and_started_again_under_load_it_loses_nothing_and_doubles_nothing(server, seed):
    """Three writers and a reader go on through three SIGKILLs of Redis at random moments."""
    print(f"seed {seed}")
    rng, groups, writers = random.Random(seed), 120, 3
    RedisInbox(server.url, "x").close()
    children = [
        subprocess.Popen(
            [sys.executable, "-c", WRITER, server.url, str(n), str(groups)], stdout=subprocess.PIPE, text=True
        )
        for n in range(writers)
    ]
    told = [0] * writers
    finished: set[RecordId] = set()

    def listen(n: int) -> None:
        for _ in children[n].stdout:
            told[n] += 1

    assert [child.stdout.readline() for child in children] == ["ready\n"] * writers
    listeners = [threading.Thread(target=listen, args=(n,)) for n in range(writers)]
    for listener in listeners:
        listener.start()
    kill_at = sorted(rng.sample(range(20, writers * groups - 20), 3))
    now, inbox = T0, RedisInbox(server.url, "x")
    while any(listener.is_alive() for listener in listeners):
        if kill_at and sum(told) >= kill_at[0]:
            kill_at.pop(0)
            server.kill()
            server.start()
        now, given = now + 100, []  # a lease whose answer was lost has run out by the next turn
        try:
            given = [item.record.id for item in inbox.lease("c", limit=7, max_bytes=9999, now=now, ttl=30)]
            assert not finished & set(given)
            assert given == sorted(given)
            inbox.done(given, now)
            finished |= set(given)
        except StoreError:
            # Whether `done` was committed is not known; the records are given out again if not.
            finished |= {id for id in given if _state(inbox, id, now) is State.DONE}
    assert [child.wait() for child in children] == [0] * writers
    assert told == [groups] * writers
    assert kill_at == []
    everything = {RecordId(bytes([n]) * 32, b"s" * 16, seq) for n in range(writers) for seq in range(groups * 5)}
    states = {id: inbox.state(id, now + 100) for id in everything}
    assert {id for id, state in states.items() if state is State.DONE} == finished
    assert {id for id, state in states.items() if state is State.WAITING} == everything - finished
    stats = inbox.statistics(now + 100)
    assert (stats.waiting, stats.leased, stats.done, stats.dead) == (
        len(everything) - len(finished), 0, len(finished), 0,
    )
    assert stats.bytes == sum(len(b"%d" % id.seq) for id in everything - finished)
    inbox.close()


def _state(inbox: RedisInbox, id: RecordId, now: float) -> State:
    while True:
        try:
            return inbox.state(id, now)
        except StoreError:
            continue


def test_a_log_cut_short_by_a_crash_loses_only_what_was_not_confirmed(server):
    """The last command half written, as a crash of the machine leaves it."""
    with RedisInbox(server.url, "x") as inbox:
        for n in range(10):
            inbox.append([record(2 * n), record(2 * n + 1)], T0)
    server.kill()
    (log,) = server.folder.glob("appendonlydir/*.incr.aof")
    log.write_bytes(log.read_bytes()[:-40])
    server.start()
    with RedisInbox(server.url, "x") as inbox:
        # Each append is whole or not there.
        assert [inbox.state(record(n).id, T0) for n in range(20)] == [State.WAITING] * 18 + [State.UNKNOWN] * 2
        assert inbox.append([record(18), record(19)], T0) == [Outcome.NEW] * 2
        assert take(inbox) == list(range(20))


def test_bounds_hold_across_processes_that_do_not_know_of_each_other(server):
    limits = InboxLimits(records=10)
    with RedisInbox(server.url, "x", limits) as one, RedisInbox(server.url, "x", limits) as two:
        outcomes = [box.append([record(n)], T0)[0] for n, box in zip(range(12), [one, two] * 6, strict=True)]
        assert outcomes == [Outcome.NEW] * 10 + [Outcome.FULL] * 2


def test_a_user_without_the_right_to_look_at_the_settings_is_refused_with_the_reason(server):
    with server.client() as client:
        client.execute_command("ACL", "SETUSER", "bridge", "on", ">pw", "~*", "+@all", "-config")
    with pytest.raises(StoreError, match=r"may not use.*howto-redis"):
        RedisInbox(f"redis://bridge:pw@127.0.0.1:{server.port}/0", "x")


def test_the_rights_that_the_documentation_names_are_enough_and_touch_no_other_key(server):
    command = re.search(r"ACL SETUSER .*?(?=\n```)", HOWTO.read_text(encoding="utf-8"), re.DOTALL)
    assert command is not None
    with server.client() as client:
        client.execute_command(*command.group().split())
    with RedisInbox(f"redis://bridge:PASSWORD@127.0.0.1:{server.port}/0", "x") as inbox:
        inbox.append([record(n) for n in range(4)], T0)
        inbox.append([record(0, size=300)], T0)
        assert take(inbox, limit=3) == [0, 1, 2]
        inbox.release("c", [record(2).id])
        inbox.done([record(0).id], T0)
        inbox.dead_letter([record(1).id], "reason", T0)
        assert len(inbox.dead_letters()) == 2
        assert inbox.state(record(2).id, T0) is State.WAITING
        assert inbox.statistics(T0).done == 1
        assert inbox.forget(T0 + 1) == 1
    with redis.Redis(port=server.port, username="bridge", password="PASSWORD") as client:
        with pytest.raises(redis.exceptions.NoPermissionError):
            client.hget("another", "field")
        with pytest.raises(redis.exceptions.NoPermissionError):
            client.flushall()


def test_a_redis_that_is_not_there_is_told_with_the_mend() -> None:
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))
        port = unused.getsockname()[1]
        with pytest.raises(StoreError, match=r"127\.0\.0\.1:\d+ .*[^.]; start Redis, or correct \[store\] url$"):
            RedisInbox(f"redis://127.0.0.1:{port}/0", "a binding")
