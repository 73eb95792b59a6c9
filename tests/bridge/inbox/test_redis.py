"""What is Redis' own about the inbox in a Redis: durability demanded, outages, exchanges, rights, passwords."""

from __future__ import annotations

import random
import re
import shlex
import shutil
import socket
import subprocess
import sys
import threading
import time
import traceback
from collections.abc import Iterator
from pathlib import Path

import pytest
import redis

from bridge.chunks import STREAM, chain, chunk, dropped
from bridge.redis_server import DURABLE, RedisServer
from rosbridge_eth.errors import StoreError
from rosbridge_eth.inbox import InboxExchanged, Outcome
from rosbridge_eth.inbox import redis as redis_inbox
from rosbridge_eth.inbox.redis import COMMANDS, RedisInbox
from rosbridge_eth.log.chunk import Chunk

A, B = b"a" * 32, b"b" * 32
STORED, KNOWN = Outcome.STORED, Outcome.KNOWN
ROOT = Path(__file__).parents[3]
HOWTO = ROOT / "docs" / "howto-redis.md"
SECRET = "pa:ss word%2F"
PLENTY = 1 << 30


def open_url(url: str, ledger: bytes = b"l" * 32, **more) -> RedisInbox:
    return RedisInbox(url, ledger, PLENTY, PLENTY, **more)


def put(inbox: RedisInbox, *numbers: int, tk: bytes = A, **more) -> list[Outcome]:
    return inbox.append([(tk, chunk(number, **more)) for number in numbers], 1.0)


def held(inbox: RedisInbox, tk: bytes = A) -> list[int]:
    positions = [row.position for row in inbox.rows(tk, None, PLENTY)]
    return [Chunk.parse(encoded).header.number for encoded in inbox.chunks(tk, positions)]


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
def test_a_redis_that_may_lose_chunks_is_refused_and_the_commands_named_mend_it(start, options, names):
    server = start(*options)
    inbox = open_url(server.url)
    with pytest.raises(StoreError, match="could lose") as refusal:
        inbox.check()
    text = str(refusal.value)
    assert all(name in text for name in names)
    with server.client() as client:
        for command in text.partition("In redis-cli: ")[2].split("; ")[:-1]:
            client.execute_command(*command.split())
    inbox.check()
    inbox.close()


def test_at_maxmemory_nothing_is_taken_in_part_and_what_is_there_drains(server):
    inbox = open_url(server.url)
    with server.client() as client:
        put(inbox, *range(100), size=30_000)
        client.config_set("maxmemory", client.info("memory")["used_memory"] + 1_000_000)
        taken = 100
        with pytest.raises(StoreError, match="maxmemory"):
            for taken in range(100, 1000, 10):
                put(inbox, *range(taken, taken + 10), size=30_000)
        assert held(inbox) == list(range(taken))
        assert inbox.head(A, STREAM).number == taken - 1
        client.config_set("maxmemory", client.info("memory")["used_memory"] // 2)
        inbox.set_state(A, hold="why")
        inbox.confirm(A, inbox.rows(A, None, PLENTY)[69].position, 1.0)
        inbox.forget(2.0)
        assert held(inbox) == list(range(69, taken))
        inbox.rebase(A, [chunk(70, size=30_000)], [], 1.0)
        inbox.confirm(A, inbox.rows(A, None, 1)[0].position, 1.0)
        with pytest.raises(StoreError, match="maxmemory"):
            put(inbox, taken)
        client.config_set("maxmemory", client.info("memory")["used_memory"] + 1_000_000)
        assert put(inbox, taken, size=30_000) == [STORED]
    inbox.close()


def test_a_log_cut_short_by_a_crash_loses_whole_appends_of_a_robot(server):
    inbox = open_url(server.url)
    (log,) = server.folder.glob("appendonlydir/*.incr.aof")
    ends = [log.stat().st_size]
    for number in range(0, 8, 2):
        put(inbox, number, number + 1)
        ends.append(log.stat().st_size)
    inbox.close()
    server.kill()
    whole = log.read_bytes()
    for cut in (ends[4] - 1, ends[3] + 1, ends[3], (ends[2] + ends[3]) // 2, ends[1] + 40):
        log.write_bytes(whole[:cut])
        server.start()
        inbox = open_url(server.url)
        count = 2 * max(n for n, end in enumerate(ends) if end <= cut)
        assert held(inbox) == list(range(count))
        assert inbox.head(A, STREAM).number == count - 1
        inbox.close()
        server.kill()


# --- a Redis that is not the one it was


def test_a_flushed_redis_is_told_once_also_if_somebody_looked_meanwhile(server):
    inbox = open_url(server.url)
    put(inbox, 0, 1)
    before = inbox.id
    with server.client() as client:
        client.flushall()
        with pytest.raises(StoreError, match="there is no inbox"):
            open_url(server.url, read_only=True)
        assert client.dbsize() == 0
    with pytest.raises(InboxExchanged):
        put(inbox, 2)
    assert (held(inbox), inbox.id != before) == ([], True)
    assert put(inbox, 0, 1, 2) == [STORED] * 3
    inbox.close()


def test_one_that_another_worker_has_begun_anew_is_told_to_each(server):
    one, two = open_url(server.url), open_url(server.url)
    put(one, 0)
    with server.client() as client:
        client.flushall()
    for inbox in (one, two):
        with pytest.raises(InboxExchanged):
            put(inbox, 1)
        assert put(inbox, 5, tk=A if inbox is one else B) == [STORED]
    assert one.id == two.id
    one.close()
    two.close()


def test_one_that_came_back_without_its_newest_rows_takes_nothing_behind_the_hole(server):
    """What robots were told is void then: they are asked again, and the hole is filled."""
    inbox = open_url(server.url)
    (log,) = server.folder.glob("appendonlydir/*.incr.aof")
    put(inbox, 0, 1, 2)
    lost_from = log.stat().st_size
    put(inbox, 3, 4)
    server.kill()
    log.write_bytes(log.read_bytes()[:lost_from])
    server.start()
    with pytest.raises(InboxExchanged):
        put(inbox, 5)
    assert inbox.head(A, STREAM).number == 2
    assert put(inbox, 3, 4, 5) == [STORED] * 3
    assert held(inbox) == [0, 1, 2, 3, 4, 5]
    inbox.close()


def test_a_replica_that_takes_over_behind_the_same_address_is_told(start):
    """Replication is asynchronous: what it lacks is asked for again."""
    first = start()
    inbox = open_url(first.url)
    put(inbox, 0, 1)
    second_folder = first.folder.parent / "replica"
    shutil.copytree(first.folder, second_folder)  # as far as it had come
    put(inbox, 2)
    first.kill()
    first.folder = second_folder
    first._arguments[first._arguments.index("--dir") + 1] = str(second_folder)
    first.start()
    with pytest.raises(InboxExchanged):
        put(inbox, 3)
    assert put(inbox, 2, 3) == [STORED] * 2
    inbox.close()


def test_a_replica_takes_nothing_and_says_so(start):
    primary, replica = start(), start()
    open_url(primary.url).close()
    inbox = open_url(replica.url)
    with replica.client() as client:
        client.replicaof("127.0.0.1", primary.port)
    with pytest.raises(StoreError, match=r"(?i)read only replica|loading|master"):
        for _ in range(3):
            put(inbox, 0)
    inbox.close()


# --- outages


def test_no_redis_there_is_told_with_the_mend_and_the_password_is_not():
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
    inbox = open_url(f"redis://:{'pa%3Ass%20word%252F'}@{host}/0")
    assert put(inbox, 0) == [STORED]
    assert SECRET not in repr(inbox)
    inbox.close()
    for url in (f"redis://:wr0ng@{host}/0", f"redis://someone:wr0ng@{host}/0", f"redis://{host}/0"):
        with pytest.raises(StoreError, match=r"(invalid username-password|WRONGPASS|Authentication)") as failure:
            open_url(url)
        assert "wr0ng" not in "".join(traceback.format_exception(failure.value))


def test_a_unix_socket_and_another_database(start, tmp_path):
    path = tmp_path / "redis.sock"
    start(*DURABLE, "--unixsocket", str(path))
    inbox = open_url(f"unix://{path}?db=2")
    inbox.check()
    assert put(inbox, 0) == [STORED]
    inbox.close()


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
    inbox = open_url(f"rediss://localhost:{port}/0?ssl_ca_certs={certificate}")
    assert put(inbox, 0) == [STORED]
    inbox.close()
    with pytest.raises(StoreError, match="CERTIFICATE_VERIFY_FAILED"):
        open_url(f"rediss://localhost:{port}/0")


def test_each_call_fails_while_redis_is_away_and_after_its_return_it_is_told_that_it_was_started_anew(server):
    inbox = open_url(server.url)
    put(inbox, 0)
    server.kill()
    for call in (lambda: put(inbox, 1), lambda: inbox.rows(A, None, 9), lambda: inbox.confirm(A, None, 1.0)):
        with pytest.raises(StoreError, match="cannot be used"):
            call()
    server.start()
    assert held(inbox) == [0]
    with pytest.raises(InboxExchanged):
        put(inbox, 1)
    assert put(inbox, 0, 1) == [KNOWN, STORED]
    inbox.close()


def test_a_redis_that_does_not_answer_is_given_up_and_a_late_answer_is_not_taken_for_the_next(server, monkeypatch):
    monkeypatch.setattr(redis_inbox, "ANSWER_TIMEOUT", 0.2)
    inbox = open_url(server.url)
    server.pause()
    try:
        with pytest.raises(StoreError, match="Timeout"):
            put(inbox, 0)
    finally:
        server.resume()
    with server.client() as client:
        client.ping()
    assert held(inbox) == [0]  # the command had reached it; sent again it is known
    assert put(inbox, 0) == [KNOWN]
    inbox.close()


def test_a_redis_whose_scripts_were_flushed_counts_as_started_anew(server):
    inbox = open_url(server.url)
    with server.client() as client:
        put(inbox, 0)
        client.script_flush()
        with pytest.raises(InboxExchanged):
            put(inbox, 1)
        assert put(inbox, 0, 1) == [KNOWN, STORED]
    inbox.close()


def test_inboxes_of_other_contracts_in_one_redis_are_apart_and_other_keys_are_left_alone(server):
    with server.client() as client:
        client.hset("rosbridge-eth:0123456789abcdef:meta", "format", 1)  # the first edition's
        one, two = open_url(server.url), open_url(server.url, b"x" * 32)
        put(one, 0)
        assert (held(two), list(two.sizes())) == ([], [])
        assert put(two, 0) == [STORED]
        assert client.hgetall("rosbridge-eth:0123456789abcdef:meta") == {b"format": b"1"}
        client.hset(f"rosbridge-eth:2:{(b'x' * 8).hex()}:meta", "ledger", "another")
    with pytest.raises(StoreError, match="another contract or program"):
        open_url(server.url, b"x" * 32)
    one.close()
    two.close()


def test_everything_removed_leaves_nothing_per_chunk(server):
    inbox = open_url(server.url)
    put(inbox, 0)
    inbox.remove(A, [row.position for row in inbox.rows(A, None, 9)])
    with server.client() as client:
        empty = {key: client.memory_usage(key) for key in client.keys("*")}
        for begin in range(1, 1000, 100):
            put(inbox, *range(begin, begin + 100))
            inbox.remove(A, [row.position for row in inbox.rows(A, None, 999)])
        after = {key: client.memory_usage(key) for key in client.keys("*")}
    assert after.keys() == empty.keys()
    assert sum(after.values()) < sum(empty.values()) + 1000
    inbox.close()


# --- killed and started again under load

WRITER = """
import sys
from bridge.chunks import chunk
from rosbridge_eth.errors import StoreError
from rosbridge_eth.inbox.redis import RedisInbox
url, tk, groups = sys.argv[1], bytes([int(sys.argv[2])]) * 32, int(sys.argv[3])
inbox = RedisInbox(url, b"l" * 32, 1 << 30, 1 << 30)
print("ready", flush=True)
for start in range(0, groups * 5, 5):
    while True:
        try:
            outcomes = inbox.append([(tk, chunk(n)) for n in range(start, start + 5)], 1.0)
            break
        except StoreError:
            pass
    assert {outcome.value for outcome in outcomes} in ({"stored"}, {"known"}), outcomes
    print(start, flush=True)
"""


def rewritten(server) -> None:
    """Have Redis write its log anew, as docs/howto-redis.md says for one that was killed.

    7.0.15 cuts a torn command off its log, and leaves those before it of the same transaction: the start after the next
    carries them out, and rows stand there twice.
    """
    with server.client() as client:
        client.bgrewriteaof()
        while any(client.info("persistence")[key] for key in ("aof_rewrite_in_progress", "aof_rewrite_scheduled")):
            time.sleep(0.01)


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
            rewritten(server)
        listeners[0].join(0.001)
    assert [child.wait() for child in children] == [0] * writers
    assert (told, kill_at) == ([groups] * writers, [])
    inbox = open_url(server.url)
    for n in range(writers):
        assert held(inbox, bytes([n]) * 32) == list(range(groups * 5))
    inbox.close()


# --- rights


def documented_acl() -> list[str]:
    command = re.search(r"ACL SETUSER .*?(?=\nrosbridge-eth)", HOWTO.read_text(encoding="utf-8"), re.DOTALL)
    assert command is not None
    return shlex.split(command.group().replace("\\\n", " "))


def as_bridge(server: RedisServer, **more) -> RedisInbox:
    return open_url(f"redis://bridge:PASSWORD@127.0.0.1:{server.port}/0", **more)


def use_everything(inbox: RedisInbox) -> None:
    """Every method, and in the script every branch that writes."""
    made = list(chain(6))
    inbox.check()
    inbox.append([(A, one) for one in made[:4]] + [(B, made[0])], 1.0)
    assert inbox.append([(A, made[0]), (A, chunk(3, variant=1))], 1.0) == [KNOWN, Outcome.DIFFERENT]
    rows = inbox.rows(A, None, 9)
    assert len(inbox.chunks(A, [row.position for row in rows])) == 4
    assert inbox.find(A, rows[1].hash) == rows[1].position
    inbox.confirm(A, rows[2].position, 1.0)
    inbox.forget(2.0)
    inbox.set_state(A, hold="why")
    assert inbox.state(A).confirmed == (STREAM, 2)
    inbox.raise_heads(B, {b"n" * 16: inbox.head(A, STREAM)})
    inbox.rebase(A, [dropped(made[4]), made[5]], [made[3].header.digest], 1.0)
    assert held(inbox) == [4, 5, 2]
    assert inbox.bury(A, inbox.rows(A, None, 1)[0].position, "why") == 2
    assert len(inbox.dead()) == 2
    assert set(inbox.totals()) == {A, B}


def test_the_rights_that_the_page_names_are_those_that_are_used_and_touch_no_other_key(server):
    acl = documented_acl()
    assert {right[1:] for right in acl if right.startswith("+")} - {"client", "select"} == set(COMMANDS)
    with server.client() as client:
        client.execute_command(*acl)
        client.config_resetstat()
    inbox = as_bridge(server)
    use_everything(inbox)
    as_bridge(server, read_only=True).close()
    inbox.close()
    with server.client() as client:
        used = {name.removeprefix("cmdstat_") for name in client.info("commandstats")}
    assert used - {"auth", "client|setinfo", "client", "config|resetstat", "ping", "hello"} == set(COMMANDS)
    in_the_script = set(re.findall(r"call\('(\w+)'", (ROOT / "src/rosbridge_eth/inbox/redis.lua").read_text()))
    assert {name.lower() for name in in_the_script} <= set(COMMANDS)
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
        with pytest.raises(StoreError, match="lacks rights") as refusal:
            as_bridge(redis_server, ledger=ledger).check()
        assert f"ACL SETUSER bridge +{name} (" in str(refusal.value)
        mend = re.search(r"ACL SETUSER [^(]*", str(refusal.value))
        client.execute_command(*mend.group().split())
    inbox = as_bridge(redis_server, ledger=ledger)
    use_everything(inbox)
    inbox.close()


def test_all_that_is_missing_is_named_at_once_and_the_keys_too(server):
    with server.client() as client:
        client.execute_command(*documented_acl())
        client.execute_command("ACL", "SETUSER", "bridge", "-xadd", "-hset", "-config|get")
        with pytest.raises(StoreError, match=r"SETUSER bridge \+config\|get \+hset \+xadd \("):
            as_bridge(server).check()
        client.execute_command("ACL", "SETUSER", "bridge", "+xadd", "+hset", "+config|get", "resetkeys")
        with pytest.raises(StoreError, match=r"SETUSER bridge ~rosbridge-eth:\* \("):
            as_bridge(server).check()
