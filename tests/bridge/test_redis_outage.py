"""The server's ends while its Redis is away: robots are told BUSY, batches go on, nothing is lost or written twice."""

from __future__ import annotations

import threading
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from bridge.load_script import load_script
from bridge.store.redis_server import RedisServer
from rosbridge_eth import ledger, protocol
from rosbridge_eth.channel import MessageReceived
from rosbridge_eth.protocol import Ack, CheckRequest, RecordRequest, RecordStatus, Registration
from rosbridge_eth.records import RecordId, SealedRecord
from rosbridge_eth.registry import Registry
from rosbridge_eth.server.assembly import open_inbox, open_journal, open_submission
from rosbridge_eth.server.reception import Reception
from rosbridge_eth.server.whereabouts import whereabouts
from rosbridge_eth.store import State

load = load_script("load")


@pytest.fixture
def redis_server(tmp_path) -> Iterator[RedisServer]:
    (tmp_path / "redis").mkdir()
    server = RedisServer(tmp_path / "redis")
    yield server
    server.kill()


@pytest.fixture
def operator(redis_server, tmp_path: Path) -> Iterator:
    made = load.Operator(tmp_path, "embedded", redis_server.url, 1, lambda stage: None)
    yield made
    made.close()


def records(operator, seqs: range) -> list[SealedRecord]:
    return [SealedRecord(RecordId(operator.robots[0].tk, b"s" * 16, n), n.to_bytes(8, "big") * 32) for n in seqs]


def test_the_submitter_goes_on_with_what_it_has_and_settles_with_the_inbox_later(operator, redis_server):
    now = time.time()
    inbox, journal = open_inbox(operator.config, operator.home), open_journal(operator.home, operator.deployment)
    submission = open_submission(
        config=operator.config, contract=operator.contract, journal=journal,
        inbox=open_inbox(operator.config, operator.home), registry=Registry(operator.home.registry),
        keys=operator.keys,
    )
    inbox.append(records(operator, range(5)), now)
    submission.turn(now)
    redis_server.kill()
    for second in range(1, 5):
        submission.turn(now + second, flush=True)
    tk = operator.robots[0].tk
    on_chain = [one.record for one in ledger.fetch(operator.chain, operator.contract, tk).records]
    assert on_chain == records(operator, range(5))
    redis_server.start()
    assert {inbox.state(record.id, now + 5) for record in on_chain} == {State.LEASED}
    inbox.append(records(operator, range(7)), now + 5)
    for second in range(6, 10):
        submission.turn(now + second, flush=True)
    assert {inbox.state(record.id, now + 10) for record in records(operator, range(7))} == {State.DONE}
    on_chain = [one.record for one in ledger.fetch(operator.chain, operator.contract, tk).records]
    assert on_chain == records(operator, range(7))


class Replies:
    """Where a Reception's answers go."""

    def __init__(self) -> None:
        self.sent: list[bytes] = []

    def reply(self, connection: bytes, message_id: int, payload: bytes) -> None:
        self.sent.append(payload)


def test_a_robot_is_told_busy_while_redis_is_away_and_stored_when_it_is_back(operator, redis_server):
    replies, peer = Replies(), operator.robots[0].identity.public
    inbox, journal = open_inbox(operator.config, operator.home), open_journal(operator.home, operator.deployment)
    reception = Reception(
        replies, inbox, status_of=lambda id: whereabouts(id, inbox, journal, 0.0),
        registration_of=lambda peer: Registration(True, None, "0x", 1, 0),
    )
    [record] = records(operator, range(1))

    def ask(request: protocol.Request) -> bytes:
        message = MessageReceived(b"c" * 8, 1, protocol.encode_request(request), peer)
        reception.take([message], wall=time.time(), now=0.0)
        return replies.sent[-1]

    redis_server.kill()
    assert protocol.decode_ack(ask(RecordRequest(record))) is Ack.BUSY
    assert protocol.decode_status(ask(CheckRequest(record.id))) == RecordStatus("unavailable")
    redis_server.start()
    assert protocol.decode_ack(ask(RecordRequest(record))) is Ack.STORED
    assert protocol.decode_status(ask(CheckRequest(record.id))) == RecordStatus("stored")


@pytest.mark.slow
def test_redis_is_killed_again_and_again_while_many_robots_send(redis_server, tmp_path):
    operator = load.Operator(tmp_path, "embedded", redis_server.url, 40, lambda stage: None)
    kills, over = 0, threading.Event()

    def harm() -> None:
        nonlocal kills
        while kills < 5 or (not over.is_set() and kills < 25):
            redis_server.kill()
            redis_server.start()
            kills += 1

    harming = threading.Thread(target=harm)

    def on_stage(stage: str) -> None:
        if stage == "messages":
            harming.start()
        elif stage == "reading back":
            over.set()

    try:
        figures = load.run(operator, 40, 20, workers=2, limit=120, on_stage=on_stage)
    finally:
        over.set()
        harming.join()
        operator.close()
    print(f"{kills} kills, told busy {figures.busy} times")
    assert kills >= 5
    assert figures.sent == figures.stored == figures.on_chain == 800
    assert (figures.lost, figures.doubled, figures.altered) == (0, 0, 0)
