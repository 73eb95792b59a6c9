"""Reading from a chain: a contract on the embedded chain, real registrations, real batches; and nodes that disagree."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pytest

from bridge.reading.world import NAME, START, Pen, authority, reader, robot
from rosbridge_eth.chunk import Log
from rosbridge_eth.errors import ChainError, ConfigError, IdentityError
from rosbridge_eth.identity import Trust
from rosbridge_eth.ledger import Keyring, Ledger, Standing
from rosbridge_eth.ledger.nodes import EmbeddedChain
from rosbridge_eth.reading import Bookmarks, Kind, Reading, read_robot
from rosbridge_eth.reading.fetch import MARGIN

KEYS = Keyring.from_mnemonic("test " * 11 + "junk")
OPERATOR, ACCOUNT = KEYS.operator, KEYS.robot(1)
ETH = 10**18
NOW = START.timestamp() + 90_000


@dataclass
class Chain:
    where: EmbeddedChain
    ledger: Ledger
    pen: Pen

    def write(self, chunks: Sequence[Any], account: Any = ACCOUNT) -> None:
        self.ledger.set_data(account, self.pen.log.tk, [chunk.encoded for chunk in chunks])

    def read(self, *others: Any, ledgers: Sequence[Any] | None = None, **more: Any) -> Reading:
        return read_robot(
            ledgers or [self.ledger, *others], NAME, trust=Trust([authority().certificate]),
            reader=reader().encryption_key, now=NOW, **more,
        )  # fmt: skip


@pytest.fixture
def chain() -> Chain:
    where = EmbeddedChain({OPERATOR.address: 1000 * ETH})
    ledger, _ = Ledger.deploy(where, OPERATOR)
    pen = Pen()
    pen.log = Log(ledger.ledger, pen.log.tk)
    ledger.registration(OPERATOR, pen.log.tk, ACCOUNT.address, robot().public.certificates)
    ledger.alloc_eth(OPERATOR, ACCOUNT.address, ETH)
    return Chain(where, ledger, pen)


def numbers(reading: Reading) -> list[int]:
    return [record.content.data["x"] for record in reading.records()]


def violations(reading: Reading) -> list[str]:
    return [found.kind.label for found in reading.verdict().findings if found.kind.violation]


def test_what_was_written_is_read(chain):
    for _ in range(3):
        chain.write(chain.pen.chunks(4))
    reading = chain.read()
    assert numbers(reading) == list(range(12))
    verdict = reading.verdict()
    assert verdict.sound
    assert (verdict.chunks, verdict.records, verdict.nodes) == (12, 12, ())
    assert [one.account for one in verdict.certificates] == [ACCOUNT.address]


def test_nothing_is_written_yet(chain):
    reading = chain.read()
    assert numbers(reading) == []
    assert reading.verdict().sound


def test_a_robot_that_is_replaced_and_revoked(chain):
    chain.write(chain.pen.chunks(2, goodbye=True))
    other = KEYS.robot(2)
    tk = chain.pen.log.tk
    chain.ledger.replace_registration(OPERATOR, tk, other.address, robot(1).public.certificates)
    chain.ledger.alloc_eth(OPERATOR, other.address, ETH)
    chain.pen.identity = robot(1)
    chain.pen.new_stream(b"b" * 16)
    chain.write(chain.pen.chunks(2), other)
    chain.ledger.revoke_robot(OPERATOR, tk)
    reading = chain.read()
    assert numbers(reading) == [0, 1, 0, 1]
    verdict = reading.verdict()
    assert verdict.sound, list(verdict.lines())
    assert [(one.first, one.revoked) for one in verdict.certificates] == [(0, False), (2, False), (4, True)]


def test_a_record_that_is_replayed_on_a_second_contract_is_refused(chain, tmp_path):
    bookmarks = Bookmarks(tmp_path / "bookmarks.json")
    chunks = chain.pen.chunks(2)
    chain.write(chunks)
    first = chain.read()
    numbers(first)
    first.keep(bookmarks)
    second, _ = Ledger.deploy(chain.where, OPERATOR)
    second.registration(OPERATOR, chain.pen.log.tk, KEYS.robot(3).address, robot().public.certificates)
    second.alloc_eth(OPERATOR, KEYS.robot(3).address, ETH)
    second.set_data(KEYS.robot(3), chain.pen.log.tk, [chunk.encoded for chunk in chunks])
    for known, kind in ((None, Kind.FORGED), (bookmarks, Kind.ELSEWHERE)):
        reading = chain.read(ledgers=[second], bookmarks=known)
        assert numbers(reading) == []
        assert violations(reading) == [kind.label]


def test_confirmations_leave_the_newest_blocks_for_later(chain):
    for _ in range(4):
        chain.write(chain.pen.chunks(1))
    reading = chain.read(confirmations=3)
    assert numbers(reading) == [0, 1]
    assert reading.verdict().sound


def test_a_block_from_before_the_contract_is_told_in_a_sentence(chain):
    chain.write(chain.pen.chunks(1))
    with pytest.raises(ChainError, match=r"no contract 0x.* yet in block 0 of .*fewer confirmations"):
        chain.read(confirmations=100)


def test_more_confirmations_than_last_time_are_no_roll_back(chain, tmp_path):
    bookmarks = Bookmarks(tmp_path / "bookmarks.json")
    for _ in range(4):
        chain.write(chain.pen.chunks(1))
    for confirmations, found in ((1, 4), (3, 2), (1, 4)):
        reading = chain.read(confirmations=confirmations, bookmarks=bookmarks)
        assert numbers(reading) == list(range(found))
        assert reading.verdict().sound
        reading.keep(bookmarks)
        mark = bookmarks.get(chain.pen.log)
        assert mark is not None
        assert mark.count == 4, "what was seen once stays known"


def test_a_name_that_nobody_has(chain):
    with pytest.raises(IdentityError, match="no robot of the name robot_9"):
        read_robot([chain.ledger], "robot_9", trust=Trust([]), reader=None, now=NOW)
    with pytest.raises(IdentityError, match="cannot be used"):
        read_robot([chain.ledger], "Robot 9", trust=Trust([]), reader=None, now=NOW)


def test_a_chain_that_is_reorganised_while_it_is_read_is_no_violation(chain):
    class Moving(Node):
        hashes = iter((b"a" * 32, b"b" * 32))

        def block(self, number: int) -> Any:
            return chain.ledger.block(number)._replace(hash=next(self.hashes))

    chain.write(chain.pen.chunks(2))
    with pytest.raises(ChainError, match="reorganised"):
        numbers(chain.read(ledgers=[Moving(chain.ledger, "http://moving")]))


# --- several nodes


class Node:
    """A node that answers as another one does, but for what is overridden."""

    def __init__(self, ledger: Ledger, url: str, **standing: Any) -> None:
        self._ledger, self.url, self._standing = ledger, url, standing

    def __getattr__(self, name: str) -> Any:
        return getattr(self._ledger, name)

    def standings(self, tks: Sequence[bytes], block: int) -> list[Standing]:
        return [one._replace(**self._standing) for one in self._ledger.standings(tks, block)]


class Dead(Node):
    def block_number(self) -> int:
        raise ChainError(f"{self.url} does not answer: \x1b[2J")


@pytest.mark.parametrize("order", [1, -1])
def test_the_node_that_shows_most_is_read_and_the_others_are_told(chain, order):
    chain.write(chain.pen.chunks(3))
    behind, other = Node(chain.ledger, "http://behind", chunks=2), Node(chain.ledger, "http://other", tail=b"x" * 32)
    reading = chain.read(ledgers=[behind, chain.ledger][::order])
    assert numbers(reading) == [0, 1, 2]
    [told] = reading.verdict().nodes
    assert told.startswith("node http://behind shows 2 chunks only")
    reading = chain.read(ledgers=[chain.ledger, other])
    assert "the nodes contradict" in reading.verdict().nodes[0]
    assert reading.verdict().nodes[0] in "\n".join(reading.verdict().lines())


def test_a_node_that_does_not_answer_is_told_and_a_dead_chain_is_an_error(chain):
    chain.write(chain.pen.chunks(1))
    dead = Dead(chain.ledger, "http://dead")
    reading = chain.read(dead)
    assert numbers(reading) == [0]
    assert "http://dead does not answer" in reading.verdict().nodes[0]
    assert all(text.isprintable() for text in reading.verdict().lines())
    for ledgers in ([dead], [dead, dead]):
        with pytest.raises(ChainError, match="does not answer"):
            chain.read(ledgers=ledgers)


def test_nodes_of_two_chains_are_refused(chain):
    stranger = Node(chain.ledger, "http://stranger")
    stranger.ledger = b"z" * 32
    with pytest.raises(ConfigError, match="not of one chain"):
        chain.read(stranger)


def test_a_bookmark_is_not_moved_by_a_node_that_rolled_back(chain, tmp_path: Path):
    bookmarks = Bookmarks(tmp_path / "bookmarks.json")
    chain.write(chain.pen.chunks(3))
    reading = chain.read(bookmarks=bookmarks)
    numbers(reading)
    reading.keep(bookmarks)
    old = Node(chain.ledger, "http://old", chunks=1)
    reading = chain.read(ledgers=[old], bookmarks=bookmarks)
    numbers(reading)
    assert "rolled-back" in violations(reading)
    reading.keep(bookmarks)
    mark = Bookmarks(tmp_path / "bookmarks.json").get(chain.pen.log)
    assert mark is not None
    assert mark.count == 3


def test_what_is_deep_in_a_real_chain_is_kept_and_the_rest_is_asked_for(chain, tmp_path, monkeypatch):
    chain.write(chain.pen.chunks(3, records=5))
    chain.where.ethereum_tester.mine_blocks(MARGIN)
    chain.write(chain.pen.chunks(2, records=5))
    asked: list[int] = []
    real = Ledger.data_events

    def data_events(self: Ledger, tk: bytes, first_block: int, last_block: int) -> Iterator[Any]:
        asked.append(last_block - first_block)
        return real(self, tk, first_block, last_block)

    monkeypatch.setattr(Ledger, "data_events", data_events)
    for _ in range(2):
        reading = chain.read(cache=tmp_path / "proven")
        assert numbers(reading) == list(range(25))
        assert reading.verdict().sound
        assert (reading.verdict().records, reading.verdict().chunks) == (25, 5)
        reading.close()
    assert asked[0] > MARGIN > asked[1]
