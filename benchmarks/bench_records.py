"""The sealed record: sealing, opening and proving it, and the spool and inbox where it rests.

Beside each stands its floor in the same run: for sealing and opening, the SM2
and SM4-GCM calls alone that they cannot do without; for spool and inbox, the
same bytes put into a bare SQLite table with the same durability.
"""

from __future__ import annotations

import itertools
import sqlite3
import time
from functools import partial
from typing import Any

import pytest

from rosbridge_eth.capture import Capture, TopicRule
from rosbridge_eth.identity import sign, verify
from rosbridge_eth.records import RecordId, SealedRecord, robot_id
from rosbridge_eth.sealing import Opener, Sealer, read_opening
from rosbridge_eth.sealing.packing import pack
from rosbridge_eth.sources import BagSettings, BagSource, Selection, sample_bag
from rosbridge_eth.store import Delivery, Spool, SpoolLimits, SqliteInbox
from smcrypto import sm2, sm4

ROBOT = robot_id("robot_1")
KEY, READER = sm2.PrivateKey.generate(), sm2.PrivateKey.generate()
SIGN, VERIFY = partial(sign, KEY), partial(verify, KEY.public_key)
T0 = time.time_ns()
GROUP = 64


@pytest.fixture(scope="module")
def payload() -> bytes:
    source = BagSource(BagSettings(sample_bag()), Selection(["/robot_1/odom"]))
    capture = Capture([TopicRule("/robot_1/odom")], lambda notice: None)
    captured = (capture.process(message, T0, 84_120_012_345_678) for message in source.messages())
    return next(itertools.islice((record for record in captured if record), 150, None)).to_json()


def describe(benchmark: Any, implementation: str, **more: object) -> None:
    benchmark.extra_info.update(implementation=implementation, **more)


def per_record(benchmark: Any) -> None:
    benchmark.extra_info["microseconds per record"] = round(benchmark.stats["mean"] / GROUP * 1e6, 2)


@pytest.mark.benchmark(group="seal one Odometry")
def test_seal(benchmark: Any, payload: bytes) -> None:
    sealer = Sealer(ROBOT, SIGN, [READER.public_key])
    size = len(sealer.seal(payload, T0)[-1].ciphertext)
    describe(benchmark, "rosbridge_eth", payload=len(payload), packed=len(pack(payload)), ciphertext=size)
    benchmark(sealer.seal, payload, T0)


@pytest.mark.benchmark(group="seal one Odometry")
def test_seal_floor(benchmark: Any, payload: bytes) -> None:
    describe(benchmark, "sign and SM4-GCM alone")
    gcm = sm4.SM4GCM(bytes(16))

    def floor() -> None:
        SIGN("record", payload)
        gcm.encrypt(bytes(12), bytes(230), bytes(66))

    benchmark(floor)


@pytest.mark.benchmark(group="open one Odometry")
def test_open(benchmark: Any, payload: bytes) -> None:
    opening, record = Sealer(ROBOT, SIGN, [READER.public_key]).seal(payload, T0)
    stream = Opener(READER).grant(read_opening(opening, VERIFY))
    describe(benchmark, "rosbridge_eth")
    benchmark(stream.open, record, VERIFY)


@pytest.mark.benchmark(group="open one Odometry")
def test_open_floor(benchmark: Any, payload: bytes) -> None:
    describe(benchmark, "SM4-GCM and verify alone")
    gcm = sm4.SM4GCM(bytes(16))
    sealed, signature = gcm.encrypt(bytes(12), bytes(230), bytes(66)), SIGN("record", payload)

    def floor() -> None:
        gcm.decrypt(bytes(12), sealed, bytes(66))
        VERIFY("record", payload, signature)

    benchmark(floor)


@pytest.mark.benchmark(group="begin a stream for one reader")
def test_begin_a_stream(benchmark: Any) -> None:
    describe(benchmark, "rosbridge_eth")
    benchmark(lambda: Sealer(ROBOT, SIGN, [READER.public_key]).seal(b"", T0))


def groups(stream: bytes = b"s" * 16) -> Any:
    """Endless groups of fresh 256-byte records."""
    for start in itertools.count(0, GROUP):
        yield [SealedRecord(RecordId(ROBOT, stream, start + n), bytes(256)) for n in range(GROUP)]


@pytest.mark.benchmark(group=f"keep {GROUP} records of 256 bytes in one commit")
def test_inbox_append(benchmark: Any, tmp_path: Any) -> None:
    describe(benchmark, "SqliteInbox.append")
    source = groups()
    with SqliteInbox(tmp_path / "inbox.db") as inbox:
        benchmark.pedantic(lambda records: inbox.append(records, 1.0), setup=lambda: ((next(source),), {}), rounds=150)
    per_record(benchmark)


@pytest.mark.benchmark(group=f"keep {GROUP} records of 256 bytes in one commit")
def test_spool_append(benchmark: Any, tmp_path: Any) -> None:
    describe(benchmark, "Spool.append")
    source = groups()
    with Spool(tmp_path / "spool.db", ROBOT, SpoolLimits(group=GROUP, window=1e9)) as spool:

        def keep(records: list[SealedRecord]) -> None:
            for record in records:
                spool.append((record,), Delivery.RELIABLE, 0.0)

        benchmark.pedantic(keep, setup=lambda: ((next(source),), {}), rounds=150)
    per_record(benchmark)


@pytest.mark.benchmark(group=f"keep {GROUP} records of 256 bytes in one commit")
def test_bare_sqlite(benchmark: Any, tmp_path: Any) -> None:
    describe(benchmark, "one bare table, executemany")
    db = sqlite3.connect(tmp_path / "bare.db", isolation_level=None)
    db.execute("PRAGMA journal_mode = WAL")
    db.execute("PRAGMA synchronous = FULL")
    db.execute("CREATE TABLE record (id BLOB UNIQUE, ciphertext BLOB)")
    source = groups()

    def keep(records: list[SealedRecord]) -> None:
        rows = [(r.id.robot + r.id.stream + r.id.seq.to_bytes(8, "big"), r.ciphertext) for r in records]
        db.execute("BEGIN IMMEDIATE")
        db.executemany("INSERT INTO record VALUES (?, ?)", rows)
        db.execute("COMMIT")

    benchmark.pedantic(keep, setup=lambda: ((next(source),), {}), rounds=150)
    db.close()
    per_record(benchmark)


@pytest.mark.benchmark(group=f"take {GROUP} records out again")
def test_inbox_lease_and_done(benchmark: Any, tmp_path: Any) -> None:
    describe(benchmark, "SqliteInbox.lease and done")
    source = groups()
    with SqliteInbox(tmp_path / "inbox.db") as inbox:

        def fill() -> None:
            inbox.append(next(source), 1.0)

        def take() -> None:
            leased = inbox.lease("c", limit=GROUP, max_bytes=1 << 20, now=1.0, ttl=30)
            inbox.done([item.record.id for item in leased], 1.0)

        benchmark.pedantic(take, setup=fill, rounds=150)
    per_record(benchmark)


@pytest.mark.benchmark(group=f"take {GROUP} records out again")
def test_spool_pending_and_acknowledged(benchmark: Any, tmp_path: Any) -> None:
    describe(benchmark, "Spool.pending and acknowledged")
    source = groups()
    with Spool(tmp_path / "spool.db", ROBOT, SpoolLimits(group=GROUP, window=1e9)) as spool:

        def fill() -> None:
            spool.append(next(source), Delivery.RELIABLE, 0.0)

        def send() -> None:
            spool.acknowledged([record.id for record in spool.pending(GROUP)], 0.0)

        benchmark.pedantic(send, setup=fill, rounds=150)
    per_record(benchmark)
