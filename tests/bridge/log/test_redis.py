"""What is Redis' own about the store in a Redis: durability demanded, outages, rights, passwords, a cluster."""

from __future__ import annotations

import random
import re
import shlex
import socket
import subprocess
import sys
import threading
import traceback
from collections.abc import Iterator, Sequence
from contextlib import suppress
from pathlib import Path

import pytest
import redis

from bridge.chunks import chain
from bridge.redis_server import DURABLE, RedisClusterServer, RedisServer
from rosbridge_eth.errors import ConfigError, StoreError
from rosbridge_eth.log import opening
from rosbridge_eth.log import redis as redis_module
from rosbridge_eth.log.chunk import Chunk
from rosbridge_eth.log.redis import COMMANDS, RedisStore
from rosbridge_eth.log.store import NOWHERE, Offer, Outcome, place_of

A, B = b"a" * 32, b"b" * 32
STORED, KNOWN = Outcome.STORED, Outcome.KNOWN
ROOT = Path(__file__).parents[3]
HOWTO = ROOT / "docs" / "howto-redis.md"
SECRET = "pa:ss word%2F"
PLENTY = 1 << 30


MADE = list(chain(300, size=1000))


def open_url(url: str, ledger: bytes = b"l" * 32) -> RedisStore:
    return RedisStore(url, ledger, PLENTY, PLENTY)


def put(store: RedisStore, *numbers: int, tk: bytes = A, made: Sequence[Chunk] = MADE) -> list[Outcome]:
    return store.append([Offer(tk, made[number]) for number in numbers], 1.0)


def held(store: RedisStore, tk: bytes = A) -> list[int]:
    places = [row.place for row in store.rows(tk, NOWHERE, PLENTY)]
    return [Chunk.parse(encoded).header.number for encoded in store.chunks(tk, places)]


def head(store: RedisStore, tk: bytes = A) -> int:
    return int.from_bytes(store.states([tk])[0].head[16:], "big")


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
def test_a_redis_that_may_lose_chunks_is_refused_and_the_commands_named_fix_it(start, options, names):
    server = start(*options)
    store = open_url(server.url)
    with pytest.raises(StoreError, match="could lose") as refusal:
        store.check()
    text = str(refusal.value)
    assert all(name in text for name in names)
    with server.client() as client:
        for command in text.partition("In redis-cli: ")[2].split("; ")[:-1]:
            client.execute_command(*command.split())
    store.check()
    store.close()


def test_at_maxmemory_nothing_is_taken_in_part_and_what_is_there_drains(server):
    store, made = open_url(server.url), list(chain(400, size=30_000))
    with server.client() as client:
        put(store, *range(100), made=made)
        client.config_set("maxmemory", client.info("memory")["used_memory"] + 1_000_000)
        outcomes, taken = [STORED], 100
        while set(outcomes) == {STORED}:
            outcomes = put(store, *range(taken, taken + 10), made=made)
            taken += 10 * (set(outcomes) == {STORED})
        assert outcomes == [Outcome.FULL] * 10
        assert (held(store), head(store)) == (list(range(taken)), taken - 1)
        client.config_set("maxmemory", client.info("memory")["used_memory"] // 2)
        both = [Offer(tk, made[taken]) for tk in (A, B)]
        assert store.append(both, 1.0) == [Outcome.FULL, Outcome.NOT_NEXT]
        store.set_state(A, hold="why", confirmed=place_of(made[69].header))
        store.set_state(B, hold="another")
        store.forget(A, 2.0, PLENTY)
        assert held(store) == list(range(69, taken))
        store.remove(A, [place_of(made[taken - 1].header)], "why")
        store.follow(A, b"h" * 32, made[80].header)
        assert held(store) == list(range(81, taken - 1))
        assert put(store, 81, made=made) == [Outcome.FULL], "what is known takes memory, too: the head moves"
        client.config_set("maxmemory", 0)
        assert set(put(store, *range(81, taken), made=made)) == {KNOWN, STORED}
    store.close()


def commands(log: bytes) -> list[int]:
    """Where the commands of an append-only file end."""
    ends, at = [], 0
    while at < len(log):
        count, at = int(log[at + 1 : log.index(b"\r\n", at)]), log.index(b"\r\n", at) + 2
        for _ in range(count):
            size, at = int(log[at + 1 : log.index(b"\r\n", at)]), log.index(b"\r\n", at) + 2
            at += size + 2
        ends.append(at)
    return ends


def test_killed_between_any_two_commands_of_a_script_it_holds_what_was_told_and_is_well_after_two_starts(server):
    """Redis 7.0.15 cuts a torn command off its log and leaves those before it of the same transaction, which the start
    after the next carries out."""
    store = open_url(server.url)
    (log,) = server.folder.glob("appendonlydir/*.incr.aof")
    put(store, 0, 1, 2)
    put(store, 3, 4)
    appended = log.stat().st_size
    store.set_state(A, confirmed=place_of(MADE[2].header))
    store.remove(A, [place_of(one.header) for one in MADE[:2]])
    store.remove(A, [place_of(MADE[4].header)], "why")
    store.close()
    server.kill()
    whole = log.read_bytes()
    ends = commands(whole)
    for cut in sorted({end + more for end in ends[3:] for more in (0, 9)} & set(range(len(whole) + 1))):
        log.write_bytes(whole[:cut])
        for start in range(3):
            server.start()
            store = open_url(server.url)
            if start == 1:  # a transaction behind the torn one; the robot sends what follows, the submitter forgets
                put(store, *range(6))
            rows = store.rows(A, NOWHERE, 99)
            assert held(store) == [int.from_bytes(row.place[16:], "big") for row in rows]
            assert store.sizes().get(A, 0) == sum(row.size for row in rows), (cut, start)
            if start and cut < appended:
                assert held(store) == list(range(6))
            elif start:
                assert held(store) in ([*range(6)], [1, 2, 3, 4, 5], [2, 3, 4, 5], [2, 3, 5])
            assert all(store.find(A, row.hash) == row.place and store.has(A, row.digest) for row in rows)
            store.close()
            server.kill()


# --- a Redis that is not the one it was


def test_a_flushed_redis_says_that_it_has_nothing_and_is_sent_everything_again(server):
    one, two = open_url(server.url), open_url(server.url)
    put(one, 0, 1)
    with server.client() as client:
        client.flushall()
    assert (head(one), held(two), put(two, 2)) == (0, [], [Outcome.NOT_NEXT])
    assert put(one, 0, 1, 2) == [STORED] * 3
    assert list(two.sizes()) == [A]
    one.close()
    two.close()


def test_one_that_came_back_without_its_newest_rows_takes_nothing_behind_the_hole(server):
    store = open_url(server.url)
    (log,) = server.folder.glob("appendonlydir/*.incr.aof")
    put(store, 0, 1, 2)
    lost_from = log.stat().st_size
    put(store, 3, 4)
    server.kill()
    log.write_bytes(log.read_bytes()[:lost_from])
    server.start()
    with suppress(StoreError):  # the connection is new
        store.states([A])
    assert put(store, 5) == [Outcome.NOT_NEXT]
    assert head(store) == 2
    assert put(store, 3, 4, 5) == [STORED] * 3
    assert held(store) == [0, 1, 2, 3, 4, 5]
    store.close()


def test_a_replica_takes_nothing_and_says_so(start):
    primary, replica = start(), start()
    open_url(primary.url).close()
    store = open_url(replica.url)
    with replica.client() as client:
        client.replicaof("127.0.0.1", primary.port)
    with pytest.raises(StoreError, match=r"(?i)read only replica|loading|master"):
        for _ in range(3):
            put(store, 0)
    store.close()


# --- outages


def test_without_the_package_one_sentence_says_how_to_get_it(tmp_path, monkeypatch):
    monkeypatch.setattr(opening, "find_spec", lambda name: None)
    with pytest.raises(ConfigError, match=r"pip install 'pysmcrypto\[redis\]'"):
        opening.open_store("redis://127.0.0.1:1", file=tmp_path / "s", ledger=bytes(32), max_bytes=1,
                           max_bytes_per_robot=1)  # fmt: skip


def test_no_redis_there_is_told_with_the_fix_and_the_password_is_not():
    with socket.socket() as unused:
        unused.bind(("127.0.0.1", 0))
        url = f"redis://operator:hunter2@127.0.0.1:{unused.getsockname()[1]}/3"
        with pytest.raises(StoreError, match=r"127\.0\.0\.1:\d+ .*; start Redis, or correct \[store\] url$") as failure:
            open_url(url)
    assert "hunter2" not in "".join(traceback.format_exception(failure.value))


@pytest.mark.parametrize("url", ["redis://:hunter2@host:port/0", "redis://:hunter2/@host/0", "http://:hunter2@host",
                                 "redis://:hunter2@host:70000/0", "redis://:hunter2@host/0?decode_responses=yes"])
def test_a_url_that_cannot_be_used_is_told_without_the_password(url):
    with pytest.raises(StoreError) as failure:
        open_url(url)
    assert "hunter2" not in "".join(traceback.format_exception(failure.value))


def test_passwords(start):
    server = start(*DURABLE, "--requirepass", SECRET)
    host = f"127.0.0.1:{server.port}"
    store = open_url(f"redis://:{'pa%3Ass%20word%252F'}@{host}/0")
    assert put(store, 0) == [STORED]
    assert SECRET not in repr(store)
    store.close()
    for url in (f"redis://:wr0ng@{host}/0", f"redis://someone:wr0ng@{host}/0", f"redis://{host}/0"):
        with pytest.raises(StoreError, match=r"(invalid username-password|WRONGPASS|Authentication)") as failure:
            open_url(url)
        assert "wr0ng" not in "".join(traceback.format_exception(failure.value))


def test_a_unix_socket_and_another_database(start, tmp_path):
    path = tmp_path / "redis.sock"
    start(*DURABLE, "--unixsocket", str(path))
    store = open_url(f"unix://{path}?db=2")
    store.check()
    assert put(store, 0) == [STORED]
    store.close()


def test_tls(start, tmp_path, require):
    openssl = require("openssl")
    key, certificate = tmp_path / "key.pem", tmp_path / "crt.pem"
    subprocess.run(
        [openssl, "req", "-x509", "-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:prime256v1", "-nodes", "-days", "1",
         "-keyout", key, "-out", certificate, "-subj", "/CN=localhost", "-addext", "subjectAltName=DNS:localhost"],
        check=True, capture_output=True,
    )  # fmt: skip
    with socket.socket() as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
    tls = ("--tls-port", str(port), "--tls-cert-file", str(certificate), "--tls-key-file", str(key),
           "--tls-auth-clients", "no", "--tls-ca-cert-file", str(certificate))  # fmt: skip
    start(*DURABLE, *tls)
    store = open_url(f"rediss://localhost:{port}/0?ssl_ca_certs={certificate}")
    assert put(store, 0) == [STORED]
    store.close()
    with pytest.raises(StoreError, match="CERTIFICATE_VERIFY_FAILED"):
        open_url(f"rediss://localhost:{port}/0")


def test_each_call_fails_while_redis_is_away_and_after_its_return_it_goes_on(server):
    store = open_url(server.url)
    put(store, 0)
    server.kill()
    for call in (lambda: put(store, 1), lambda: store.rows(A, NOWHERE, 9), lambda: store.set_state(A, hold="why")):
        with pytest.raises(StoreError, match="cannot be used"):
            call()
    server.start()
    assert held(store) == [0]
    assert put(store, 0, 1) == [KNOWN, STORED]
    store.close()


def test_a_redis_that_does_not_answer_is_given_up_and_a_late_answer_is_not_taken_for_the_next(server, monkeypatch):
    monkeypatch.setattr(redis_module, "ANSWER_TIMEOUT", 0.2)
    store = open_url(server.url)
    server.pause()
    try:
        with pytest.raises(StoreError, match="Timeout"):
            put(store, 0)
    finally:
        server.resume()
    with server.client() as client:
        client.ping()
    there = held(store)  # whatever had reached it
    assert put(store, 0, 1) == [KNOWN if there else STORED, STORED]
    store.close()


def test_stores_of_other_contracts_in_one_redis_are_apart(server):
    one, two = open_url(server.url), open_url(server.url, b"x" * 32)
    put(one, 0)
    assert (held(two), list(two.sizes())) == ([], [])
    assert put(two, 0) == [STORED]
    one.close()
    two.close()


def test_everything_removed_leaves_nothing_per_chunk(server):
    store = open_url(server.url)
    put(store, 0)
    store.remove(A, [row.place for row in store.rows(A, NOWHERE, 9)])
    with server.client() as client:
        empty = {key: client.memory_usage(key, samples=0) for key in client.keys("*")}
        for begin in range(1, 300, 100):
            put(store, *range(begin, min(begin + 100, 300)))
            store.remove(A, [row.place for row in store.rows(A, NOWHERE, 999)])
        after = {key: client.memory_usage(key, samples=0) for key in client.keys("*")}
    assert after.keys() == empty.keys()
    assert sum(after.values()) < sum(empty.values()) + 1000
    store.close()


# --- killed and started again under load

WRITER = """
import sys
from bridge.chunks import chain
from rosbridge_eth.errors import StoreError
from rosbridge_eth.log.redis import RedisStore
from rosbridge_eth.log.store import Offer
url, tk, groups = sys.argv[1], bytes([int(sys.argv[2])]) * 32, int(sys.argv[3])
store = RedisStore(url, b"l" * 32, 1 << 30, 1 << 30)
made = list(chain(groups * 5))
print("ready", flush=True)
for start in range(0, groups * 5, 5):
    while True:
        try:
            outcomes = store.append([Offer(tk, one) for one in made[start : start + 5]], 1.0)
            break
        except StoreError:
            pass
    assert {outcome.value for outcome in outcomes} <= {"stored", "known"}, outcomes
    print(start, flush=True)
"""


@pytest.mark.parametrize("seed", range(3))
def test_killed_and_started_again_under_load_it_loses_nothing_and_doubles_nothing(server, seed):
    """Three writers go on through three SIGKILLs of Redis at random moments."""
    print(f"seed {seed}")
    rng, groups, writers = random.Random(seed), 80, 3
    path = ":".join(part for part in sys.path if part)
    children = [
        subprocess.Popen(
            [sys.executable, "-c", WRITER, server.url, str(n), str(groups)], stdout=subprocess.PIPE, text=True,
            env={"PYTHONPATH": path},
        )
        for n in range(writers)
    ]  # fmt: skip
    told = [0] * writers

    def listen(n: int) -> None:
        for _ in children[n].stdout:
            told[n] += 1

    assert [child.stdout.readline() for child in children] == ["ready\n"] * writers
    listeners = [threading.Thread(target=listen, args=(n,)) for n in range(writers)]
    for listener in listeners:
        listener.start()
    kill_at = sorted(rng.sample(range(20, writers * groups - 20), 3))
    while any(listener.is_alive() for listener in listeners):
        if kill_at and sum(told) >= kill_at[0]:
            kill_at.pop(0)
            server.kill()
            server.start()
        listeners[0].join(0.001)
    assert [child.wait() for child in children] == [0] * writers
    assert (told, kill_at) == ([groups] * writers, [])
    for _ in range(2):  # and after one start more, when what was torn may be carried out again
        store = open_url(server.url)
        for n in range(writers):
            tk = bytes([n]) * 32
            assert held(store, tk) == list(range(groups * 5))
            assert store.sizes()[tk] == sum(row.size for row in store.rows(tk, NOWHERE, PLENTY))
        store.close()
        server.kill()
        server.start()


# --- a cluster


@pytest.fixture
def cluster(tmp_path) -> Iterator[RedisClusterServer]:
    (tmp_path / "cluster").mkdir()
    made = RedisClusterServer(tmp_path / "cluster")
    yield made
    made.kill()


def test_a_killed_node_of_a_cluster_holds_everybody_until_it_is_back_and_nothing_is_lost(cluster):
    """Without replicas, and with cluster-require-full-coverage as it is by default."""
    store, tks = open_url(cluster.url), [bytes([n]) * 32 for n in range(12)]
    store.check()
    assert store.append([Offer(tk, one) for one in MADE[:3] for tk in tks], 1.0) == [STORED] * 36
    spread = [node.client().dbsize() for node in cluster.nodes]
    assert min(spread) > 1, "every node has some robots"
    cluster.nodes[1].kill()
    cluster.wait("fail")
    for call in (lambda: [put(store, 3, tk=tk) for tk in tks], lambda: store.states(tks), store.sizes):
        with pytest.raises(StoreError, match="cannot be used"):
            call()
    cluster.nodes[1].start()
    cluster.wait("ok")
    outcomes = store.append([Offer(tk, one) for one in MADE[:5] for tk in tks], 1.0)
    assert set(outcomes[:36]) == {KNOWN}
    assert set(outcomes[36:]) <= {KNOWN, STORED}
    assert all(held(store, tk) == [0, 1, 2, 3, 4] for tk in tks)
    store.close()


def test_a_cluster_of_which_one_node_may_lose_chunks_is_refused(cluster):
    store = open_url(cluster.url)
    with cluster.nodes[2].client() as client:
        client.config_set("appendfsync", "everysec")
    with pytest.raises(StoreError, match=rf"{cluster.nodes[2].port} .*could lose.*CONFIG SET appendfsync always"):
        store.check()
    store.close()


# --- rights


@pytest.mark.parametrize("name", ["cluster|slots", "command", "zadd"])
def test_the_rights_for_a_cluster_are_those_of_the_page_and_each_that_is_missing_is_named(redis_cluster, name):
    url = redis_cluster.url.replace("redis://", "redis://bridge:PASSWORD@")
    for node in redis_cluster.nodes:
        with node.client() as client:
            client.execute_command("ACL", "SETUSER", "bridge", "reset")
            client.execute_command(*documented_acl())
    store = open_url(url, name.encode().ljust(32))
    use_everything(store)
    store.close()
    for node in redis_cluster.nodes:
        with node.client() as client:
            client.execute_command("ACL", "SETUSER", "bridge", f"-{name}")
    with pytest.raises(StoreError, match=rf"ACL SETUSER bridge .*\+{re.escape(name)} "):
        open_url(url).check()


def documented_acl() -> list[str]:
    command = re.search(r"ACL SETUSER .*?(?=\nrosbridge-eth)", HOWTO.read_text(encoding="utf-8"), re.DOTALL)
    assert command is not None
    return shlex.split(command.group().replace("\\\n", " "))


def as_bridge(server: RedisServer, **more) -> RedisStore:
    return open_url(f"redis://bridge:PASSWORD@127.0.0.1:{server.port}/0", **more)


def use_everything(store: RedisStore) -> None:
    """Every method, and in the scripts every branch that writes."""
    store.check()
    assert put(store, 0, 1, 2, 3) + put(store, 0, tk=B) == [STORED] * 5
    assert put(store, 3, 5) == [KNOWN, Outcome.NOT_NEXT]
    rows = store.rows(A, NOWHERE, 9)
    assert len(store.chunks(A, [row.place for row in rows])) == 4
    assert store.find(A, rows[1].hash) == rows[1].place
    assert store.has(A, rows[1].digest)
    store.set_state(A, confirmed=rows[2].place)
    store.forget(A, 2.0, PLENTY)
    assert store.waiting(A).chunks == 1
    store.follow(A, rows[2].hash, MADE[2].header)
    assert put(store, 3, 4) == [KNOWN, STORED]
    store.remove(A, [place_of(MADE[4].header)], "why")
    assert (held(store), len(store.dead()), set(store.sizes())) == ([3], 1, {A, B})


def test_the_rights_that_the_page_names_are_those_that_are_used_and_touch_no_other_key(server):
    acl = documented_acl()
    named = {right[1:] for right in acl if right.startswith("+")}
    assert named - {"client", "select"} == set(COMMANDS)
    with server.client() as client:
        client.execute_command(*acl)
        client.config_resetstat()
    store = as_bridge(server)
    use_everything(store)
    store.close()
    with server.client() as client:
        used = {name.removeprefix("cmdstat_") for name in client.info("commandstats")}
    assert used - {"auth", "client|setinfo", "client", "config|resetstat", "ping", "hello"} == set(COMMANDS)
    in_the_scripts = set(re.findall(r"call\('(\w+)'", Path(redis_module.__file__).read_text()))
    assert {name.lower() for name in in_the_scripts} <= set(COMMANDS)
    with redis.Redis(port=server.port, username="bridge", password="PASSWORD") as client:
        with pytest.raises(redis.exceptions.NoPermissionError):
            client.hget("another", "field")
        with pytest.raises(redis.exceptions.NoPermissionError):
            client.flushall()


@pytest.mark.parametrize("name", sorted(COMMANDS))
def test_each_right_that_is_missing_is_named_with_the_command_that_gives_it(redis_server, name):
    ledger = name.encode().ljust(32)
    with redis_server.client() as client:
        client.execute_command("ACL", "SETUSER", "bridge", "reset")
        client.execute_command(*documented_acl())
        client.execute_command("ACL", "SETUSER", "bridge", f"-{name}")
        with pytest.raises(StoreError, match=f"permissions.*{re.escape(name)}") as refusal:
            as_bridge(redis_server, ledger=ledger).check()
        fix = re.search(r"ACL SETUSER [^(]*", str(refusal.value))
        client.execute_command(*fix.group().split())
    store = as_bridge(redis_server, ledger=ledger)
    use_everything(store)
    store.close()


def test_the_command_gives_all_that_is_missing_at_once_and_the_keys_too(server):
    with server.client() as client:
        client.execute_command(*documented_acl())
        client.execute_command("ACL", "SETUSER", "bridge", "-zadd", "-hset", "-config|get", "resetkeys")
        with pytest.raises(StoreError, match="permissions") as refusal:
            as_bridge(server).check()
        client.execute_command(*re.search(r"ACL SETUSER [^(]*", str(refusal.value)).group().split())
    store = as_bridge(server)
    use_everything(store)
    store.close()
