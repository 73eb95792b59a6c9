"""Reading from a chain: a contract on the embedded chain, real registrations, real batches; and nodes that disagree."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest
from eth_hash.auto import keccak

from bridge.reading.world import NAME, START, Pen, authority, reader, robot
from rosbridge_eth.errors import ChainError, ConfigError, IdentityError
from rosbridge_eth.identity import Trust
from rosbridge_eth.ledger import DataEvent, Keyring, Ledger, Standing, contract
from rosbridge_eth.ledger.contract import RegistrationEvent
from rosbridge_eth.ledger.nodes import EmbeddedChain
from rosbridge_eth.ledger.transport import TooMuch
from rosbridge_eth.log.chunk import Log
from rosbridge_eth.reading import Bookmarks, Kind, Reading, read_robot

KEYS = Keyring.from_mnemonic("test " * 11 + "junk")
OPERATOR, ACCOUNT = KEYS.operator, KEYS.account(1)
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
            reader=reader().encryption_key, **({"now": NOW} | more),
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
    other = KEYS.account(2)
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


def test_a_record_that_is_replayed_on_a_second_contract_is_refused(chain):
    chunks = chain.pen.chunks(2)
    second, _ = Ledger.deploy(chain.where, OPERATOR)
    second.registration(OPERATOR, chain.pen.log.tk, KEYS.account(3).address, robot().public.certificates)
    second.alloc_eth(OPERATOR, KEYS.account(3).address, ETH)
    second.set_data(KEYS.account(3), chain.pen.log.tk, [chunk.encoded for chunk in chunks])
    reading = chain.read(ledgers=[second])
    assert numbers(reading) == []
    assert violations(reading) == [Kind.FORGED.label]


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

    def standings(self, tks: Sequence[bytes], block: int | str = "latest") -> list[Standing]:
        return [one._replace(**self._standing) for one in self._ledger.standings(tks, block)]


class Dead(Node):
    def block_number(self) -> int:
        raise ChainError(f"{self.url} does not answer: \x1b[2J")


CHANGED = [
    {"account": KEYS.account(5).address}, {"certificates_hash": b"x" * 32}, {"revoked": True}, {"chunks": 2},
    {"chunks": 10**18}, {"tail": b"x" * 32}, {"data_block": 1}, {"account": None}, {"balance": 7},
]  # fmt: skip


@pytest.mark.parametrize("order", [1, -1])
@pytest.mark.parametrize("lie", CHANGED, ids=str)
def test_nodes_that_do_not_say_the_same_of_a_robot_are_told_and_nothing_is_sound(chain, lie, order, tmp_path):
    bookmarks = Bookmarks(tmp_path / "bookmarks.json")
    chain.write(chain.pen.chunks(3))
    liar = Node(chain.ledger, "http://liar\x1b[2J", **lie)
    reading = chain.read(ledgers=[chain.ledger, liar][::order], bookmarks=bookmarks)
    numbers(reading)
    verdict = reading.verdict()
    assert not verdict.sound and verdict.counts["contradicted"] >= 1
    [name] = lie
    told = "\n".join(verdict.lines())
    assert f"has another {name}: " in told and "\x1b" not in told
    reading.keep(bookmarks)
    assert bookmarks.get(chain.pen.log) is None, "what nodes do not agree on is not what later readings are held to"
    assert chain.read(Node(chain.ledger, "http://other")).verdict().sound


def test_a_node_that_hides_a_revocation_is_told_beside_an_honest_one(chain):
    """Its chunks behind it would be those of who has the stolen key."""
    tk = chain.pen.log.tk
    chain.write(chain.pen.chunks(2))
    chain.ledger.revoke_robot(OPERATOR, tk)
    [stands] = chain.ledger.standings([tk])
    stolen = [chunk.encoded for chunk in chain.pen.chunks(2)]

    class Hiding(Node):
        def registrations(self, tk: bytes, standing: Any) -> Any:
            return [event for event in self._ledger.registrations(tk, stands) if not event.revoked]

        def data_events(self, tk: bytes, first: int, last: int) -> Any:
            yield from self._ledger.data_events(tk, first, last)
            yield DataEvent(2, stands.data_block, tuple(stolen), last, b"t" * 32, ACCOUNT.address)

    changed = Node(chain.ledger, "").registrations(tk, stands)[0].block
    liar = Hiding(
        chain.ledger, "http://liar", revoked=False, chunks=4, tail=keccak(stolen[-1]), changed_block=changed,
        data_block=chain.ledger.block_number(),
    )  # fmt: skip
    alone = chain.read(ledgers=[liar])
    assert numbers(alone) == [0, 1, 2, 3] and alone.verdict().sound, "one node alone is believed"
    for ledgers in ([liar, chain.ledger], [chain.ledger, liar]):
        reading = chain.read(ledgers=ledgers)
        numbers(reading)
        assert violations(reading) and "contradicted" in violations(reading)


def test_a_replacement_in_the_middle_that_one_node_hides_is_told(chain):
    tk = chain.pen.log.tk
    for number in (1, 2):
        chain.ledger.replace_registration(OPERATOR, tk, KEYS.account(9).address, robot(number).public.certificates)

    class Hiding(Node):
        def registrations(self, tk: bytes, standing: Any) -> Any:
            first, _, last = self._ledger.registrations(tk, standing)
            return [first, replace(last, previous_block=first.block)]

    liar = Hiding(chain.ledger, "http://liar")
    assert chain.read(ledgers=[liar]).verdict().sound
    assert violations(chain.read(liar)) == ["contradicted"]


class Behind(Node):
    """Has so many blocks less; what it cannot show is `missing`."""

    def __init__(self, ledger: Ledger, blocks: int) -> None:
        super().__init__(ledger, "http://behind")
        self._blocks = blocks

    def block_number(self) -> int:
        return self._ledger.block_number() - self._blocks


def test_all_nodes_are_read_up_to_the_block_that_the_last_of_them_has(chain):
    for _ in range(3):
        chain.write(chain.pen.chunks(1))
    for ledgers in ([chain.ledger, Behind(chain.ledger, 1)], [Behind(chain.ledger, 1), chain.ledger]):
        reading = chain.read(ledgers=ledgers)
        assert numbers(reading) == [0, 1]
        assert reading.verdict().sound and not reading.verdict().nodes
    chain.where.ethereum_tester.mine_blocks(20)
    reading = chain.read(Behind(chain.ledger, 20))
    assert numbers(reading) == [0, 1, 2]
    assert reading.verdict().nodes == ("node http://behind is 20 blocks behind; all are read up to what it has",)


def test_a_node_that_cannot_show_the_block_in_which_all_are_compared_is_no_agreement(chain):
    """So a liar cannot silence a node without old states by naming an old block."""

    class Pruned(Node):
        def standings(self, tks: Sequence[bytes], block: int) -> Any:
            raise ChainError("missing trie node")

    chain.write(chain.pen.chunks(1))
    chain.where.ethereum_tester.mine_blocks(20)
    with pytest.raises(ChainError, match="missing trie node; node http://behind is 20 blocks behind"):
        chain.read(ledgers=[Pruned(chain.ledger, "http://pruned"), Behind(chain.ledger, 20)])
    for other in (Pruned(chain.ledger, "http://pruned"), Node(chain.ledger, "http://pruned", changed_block=1)):
        reading = chain.read(other)
        assert numbers(reading) == [0] and violations(reading) == ["contradicted"]
    assert "http://pruned does not answer for block" in "\n".join(reading.verdict().lines())


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


@pytest.mark.parametrize("behind", [1, 2, 50])
def test_one_node_that_is_behind_what_was_read_before_is_no_roll_back(chain, tmp_path: Path, behind):
    """Its newest block is older than the one that was read up to: read again when it has caught up."""
    tester, bookmarks = chain.where.ethereum_tester, Bookmarks(tmp_path / "bookmarks.json")
    chain.write(chain.pen.chunks(2))
    old = tester.take_snapshot()
    chain.write(chain.pen.chunks(1))
    tester.mine_blocks(behind - 1)
    now = chain.ledger.block().time + 5.0
    first = chain.read(bookmarks=bookmarks, now=now)
    assert numbers(first) == [0, 1, 2]
    first.keep(bookmarks)
    tester.revert_to_snapshot(old)
    with pytest.raises(ChainError, match=r"is behind: its block .* wait until it has caught up"):
        chain.read(bookmarks=bookmarks, now=now)
    tester.time_travel(int(now) + 60)
    tester.mine_blocks(1)
    again = chain.read(bookmarks=bookmarks, now=now + 60)
    assert numbers(again) == [0, 1] and violations(again) == ["rolled-back"], "newer blocks without the chunk"


def test_a_node_that_claims_a_block_of_tomorrow_makes_no_later_node_look_behind(chain, tmp_path: Path):
    bookmarks = Bookmarks(tmp_path / "bookmarks.json")
    chain.write(chain.pen.chunks(1))
    first = chain.read(bookmarks=bookmarks)  # NOW is long before the chain's time
    numbers(first)
    first.keep(bookmarks)
    mark = bookmarks.get(chain.pen.log)
    assert mark is not None and mark.time == NOW < chain.ledger.block().time


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


# --- confirmations, and what was read before


@pytest.mark.parametrize("confirmations", [1, 2, 3])
def test_a_node_that_counts_more_chunks_in_its_newest_block_has_to_show_them(chain, tmp_path, confirmations):
    """It shows an old state where it is read, and says that the rest stands above."""
    bookmarks = Bookmarks(tmp_path / "bookmarks.json")
    for _ in range(4):
        chain.write(chain.pen.chunks(1))
    reading = chain.read(bookmarks=bookmarks)
    numbers(reading)
    reading.keep(bookmarks)
    top = chain.ledger.block_number()
    other = chain.pen.chunks(1)[0].encoded

    class Old(Node):
        def standings(self, tks: Sequence[bytes], block: int | str = "latest") -> list[Standing]:
            shown = self._ledger.standings(tks, "latest" if block == "latest" else min(block, top - 3))
            return [one._replace(**self._standing) for one in shown] if block == "latest" else shown

        def newest_data(self, tk: bytes, last: int) -> Any:
            return self.shows(tk, last)

    chain.where.ethereum_tester.mine_blocks(4)
    for chunks, shows in (
        (10**6, lambda tk, last: iter([])),
        (4, lambda tk, last: iter([DataEvent(3, top, (other,), last, b"", "")])),
        (4, lambda tk, last: iter([DataEvent(3, top, (), last, b"", "")])),
    ):
        node = Old(chain.ledger, "http://old", chunks=chunks)
        node.shows = shows
        reading = chain.read(ledgers=[node], bookmarks=bookmarks, confirmations=confirmations)
        assert numbers(reading) == [0]
        assert "rolled-back" in violations(reading)


# --- a node that would hold a reader


@pytest.mark.parametrize("block", [2**60, 2**40])
def test_no_block_above_the_one_that_is_read_is_taken(chain, monkeypatch, block):
    chain.write(chain.pen.chunks(1))
    real = contract._standing
    for position in (6, 7):
        def standing(row: bytes, end: int, at: int = 32 * position) -> Any:
            return real(row[:at] + block.to_bytes(32, "big") + row[at + 32 :], end)

        with monkeypatch.context() as patched:
            patched.setattr(contract, "_standing", standing)
            with pytest.raises(ChainError, match="where a number was expected"):
                chain.read()
        with monkeypatch.context() as patched:
            patched.setattr(contract, "_standing", standing)
            with pytest.raises(ChainError, match="where a number was expected"):
                chain.ledger.standings([chain.pen.log.tk])


def test_registrations_without_end_are_refused(chain, monkeypatch):
    """Each block says that the one before it has another."""
    asked: list[int] = []

    [stands] = chain.ledger.standings([chain.pen.log.tk])
    for size, most in ((10, contract.MAX_REGISTRATIONS + 1), (2**20, 17)):
        asked.clear()

        def events(self: Ledger, makers: Any, tk: bytes, start: int, end: int, size: int = size) -> Any:
            asked.append(start)
            return [RegistrationEvent(ACCOUNT.address, bytes(size), 0, start - 1, start, False)]

        monkeypatch.setattr(Ledger, "_events", events)
        with pytest.raises(ChainError, match="more than 1,000 registrations"):
            chain.ledger.registrations(chain.pen.log.tk, stands._replace(changed_block=10**6))
        assert len(asked) == most


def test_blocks_without_batches_cost_few_requests_however_many_a_node_shows(chain, monkeypatch):
    asked: list[int] = []

    def data(self: Ledger, makers: Any, tk: bytes, start: int, end: int) -> Any:
        asked.append(end - start + 1)
        if end - start >= most:
            raise TooMuch("ranges of so many blocks only")
        return []

    monkeypatch.setattr(Ledger, "_events", data)
    most = contract.MAX_BLOCK
    assert list(chain.ledger.data_events(chain.pen.log.tk, 1, contract.MAX_BLOCK - 1)) == []
    assert len(asked) < 30 and sum(asked) == contract.MAX_BLOCK - 1
    asked.clear()
    most = 5_000
    assert list(chain.ledger.data_events(chain.pen.log.tk, 1, 10**6)) == []
    assert len(asked) < 10**6 / 4_000 + 10, "what a node refuses is not asked for again and again"
    asked.clear()
    monkeypatch.setattr(Ledger, "_events", lambda self, makers, tk, start, end: (
        data(self, makers, tk, start, end) if start < 100 else []
    ))  # fmt: skip
    most = 1
    assert list(chain.ledger.data_events(chain.pen.log.tk, 1, 10**6)) == []
    assert len(asked) < 300, "blocks that are too full for more than one at once do not slow down what is behind"
