"""Following a real contract on the embedded chain: every record once, in order, whatever node and chain do."""

from __future__ import annotations

from collections.abc import Iterator
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from bridge.reading.test_fetch import ACCOUNT, ETH, KEYS, NOW, OPERATOR, Chain, Node, chain
from bridge.reading.world import NAME, Pen, authority, reader, robot
from rosbridge_eth.errors import ChainError, IdentityError
from rosbridge_eth.identity import Trust
from rosbridge_eth.ledger import Ledger
from rosbridge_eth.log.chunk import Log, robot_id
from rosbridge_eth.reading import Bookmark, Bookmarks, Choice, read_robot
from rosbridge_eth.reading.follow import Followed, Following

__all__ = ["chain"]


class Follow:
    """A `Following`, and what each look gave."""

    def __init__(self, folder: Path, *ledgers: Any, names: tuple[str, ...] = (NAME,), **more: Any) -> None:
        self.bookmarks = Bookmarks(folder / "bookmarks.json")
        read = partial(
            read_robot, ledgers, trust=Trust([authority().certificate]), reader=reader().encryption_key,
            bookmarks=self.bookmarks, memo=folder / "proven", **more,
        )  # fmt: skip
        self.robots = [Followed(name, read, self.bookmarks) for name in names]
        self.following = Following(self.robots, ledgers)

    def look(self, choice: Choice = Choice()) -> list[Any]:  # noqa: B008
        return [record.content.data["x"] for _, record in self.following.new(choice, lambda: NOW)]

    @property
    def verdict(self) -> Any:
        reading = self.robots[0].reading
        assert reading is not None
        return reading.verdict()


def test_every_look_gives_what_is_new_and_asks_for_nothing_else(chain: Chain, tmp_path: Path, monkeypatch: Any):
    asked = list[range]()
    real = Ledger.data_events

    def data_events(self: Ledger, tk: bytes, first: int, last: int) -> Iterator[Any]:
        asked.append(range(first, last + 1))
        return real(self, tk, first, last)

    monkeypatch.setattr(Ledger, "data_events", data_events)
    follow = Follow(tmp_path, chain.ledger)
    assert follow.look() == []
    assert follow.look() == [] and len(asked) == 1, "without a new block nothing is read"
    for n in range(3):
        chain.write(chain.pen.chunks(2, records=2))
        assert follow.look() == list(range(4 * n, 4 * n + 4))
    assert all(len(blocks) <= 1 for blocks in asked[1:])
    assert (follow.verdict.sound, follow.verdict.chunks, follow.verdict.records) == (True, 6, 12)
    assert list(follow.following.news()) == [f"{NAME}: sound, 6 chunks, read up to block {follow.verdict.block}"]
    assert list(follow.following.news()) == []
    mark = follow.bookmarks.get(chain.pen.log)
    assert mark is not None and mark.count == 6


def test_only_what_is_chosen_is_given(chain: Chain, tmp_path: Path):
    follow = Follow(tmp_path, chain.ledger)
    for _ in range(3):
        chain.write(chain.pen.chunks(2))
        assert follow.look(Choice(topic="/none")) == []
        assert follow.look(Choice()) == [], "what was passed over is not given later"
    assert follow.verdict.records == 6


class Flaky(Node):
    """A node that can be away, or fail in the middle of an answer."""

    away = False
    fails_after = 10**9

    def block(self, number: int | str = "latest") -> Any:
        if self.away:
            raise ChainError(f"{self.url} does not answer: Connection refused")
        return self._ledger.block(number)

    def data_events(self, tk: bytes, first: int, last: int) -> Iterator[Any]:
        for n, event in enumerate(self._ledger.data_events(tk, first, last)):
            if n == self.fails_after:
                raise ChainError(f"{self.url} does not answer: too slow")
            yield event


@pytest.mark.parametrize("fails_after", [0, 1, 2])
def test_a_node_that_goes_away_is_waited_for_and_no_record_comes_twice(chain: Chain, tmp_path: Path, fails_after: int):
    node = Flaky(chain.ledger, "http://flaky")
    follow = Follow(tmp_path, node)
    chain.write(chain.pen.chunks(2))
    assert follow.look() == [0, 1]
    list(follow.following.news())
    node.away = True
    for _ in range(2):
        assert follow.look() == []
    away = f"{NAME}: http://flaky does not answer: Connection refused; it is asked again"
    assert list(follow.following.news()) == [away]
    assert list(follow.following.news()) == [], "it is said once"
    assert follow.verdict.chunks == 2, "what was found before stands"
    for _ in range(3):
        chain.write(chain.pen.chunks(2))
    node.away, node.fails_after = False, fails_after
    given = follow.look()
    assert given == list(range(2, 2 + 2 * fails_after))
    node.fails_after = 10**9
    assert given + follow.look() == [2, 3, 4, 5, 6, 7], "without another block"
    assert list(follow.following.news()) == [f"{NAME}: read on"] and follow.verdict.sound


def test_a_reorganisation_gives_no_record_twice_and_takes_up_what_is_behind_it(chain: Chain, tmp_path: Path):
    follow = Follow(tmp_path, chain.ledger)
    chain.write(chain.pen.chunks(2))
    snapshot = chain.where.ethereum_tester.take_snapshot()
    two, three = chain.pen.chunks(1), chain.pen.chunks(1)
    chain.write(two)
    assert follow.look() == [0, 1, 2]
    chain.where.ethereum_tester.revert_to_snapshot(snapshot)
    assert follow.look() == []
    assert "rolled-back" in follow.verdict.counts, "so it stands in this moment"
    chain.where.ethereum_tester.mine_blocks(2)
    chain.write(two)
    chain.write(three)
    assert follow.look() == [3]
    assert follow.verdict.sound and follow.verdict.records == 4, list(follow.verdict.lines())


def test_another_chunk_after_a_reorganisation_is_rolled_back_and_stays_so(chain: Chain, tmp_path: Path):
    follow = Follow(tmp_path, chain.ledger)
    chain.write(chain.pen.chunks(2))
    snapshot = chain.where.ethereum_tester.take_snapshot()
    before = chain.pen.number, chain.pen.previous
    chain.write(chain.pen.chunks(1))
    assert follow.look() == [0, 1, 2]
    chain.where.ethereum_tester.revert_to_snapshot(snapshot)
    chain.pen.number, chain.pen.previous = before
    chain.pen.sealed_ms += 5
    chain.write(chain.pen.chunks(2))
    assert follow.look() == [3]
    assert not follow.verdict.sound and "rolled-back" in follow.verdict.counts
    assert any("another chunk than then" in line for line in follow.following.news())
    chain.write(chain.pen.chunks(1))
    assert follow.look() == [4] and not follow.verdict.sound


def test_what_is_behind_withheld_chunks_is_given_after_them(chain: Chain, tmp_path: Path):
    class Hiding(Node):
        hidden: tuple[int, ...] = (2,)

        def data_events(self, tk: bytes, first: int, last: int) -> Iterator[Any]:
            return (event for event in self._ledger.data_events(tk, first, last) if event.first not in self.hidden)

    node = Hiding(chain.ledger, "http://hiding")
    follow = Follow(tmp_path, node)
    for _ in range(3):
        chain.write(chain.pen.chunks(2))
    assert follow.look() == [0, 1]
    assert follow.verdict.counts["withheld"] == 2
    chain.write(chain.pen.chunks(1))
    assert follow.look() == []
    node.hidden = ()
    chain.where.ethereum_tester.mine_block()
    assert follow.look() == [2, 3, 4, 5, 6]
    assert follow.verdict.sound




def test_a_bookmark_that_another_command_moved_is_not_moved_back(chain: Chain, tmp_path: Path):
    follow = Follow(tmp_path, chain.ledger)
    elsewhere = Log(b"e" * 32, robot_id("another"))
    Bookmarks(tmp_path / "bookmarks.json").put(elsewhere, Bookmark(7, "ab"))
    chain.write(chain.pen.chunks(1))
    follow.look()
    found = Bookmarks(tmp_path / "bookmarks.json").get(elsewhere)
    assert found is not None and found.count == 7


def test_several_robots_are_followed_and_the_trouble_of_one_is_its_own(chain: Chain, tmp_path: Path):
    name, account = "robot_2", KEYS.account(2)
    pen = Pen(identity=robot(2, name), log=Log(chain.ledger.ledger, robot_id(name)))
    chain.ledger.registration(OPERATOR, pen.log.tk, account.address, robot(2, name).public.certificates)
    chain.ledger.alloc_eth(OPERATOR, account.address, ETH)

    class Choosy(Node):
        def registrations(self, tk: bytes, standing: Any) -> Any:
            if tk == pen.log.tk and self.choosy:
                raise ChainError("no registration where one must be")
            return self._ledger.registrations(tk, standing)

        choosy = True

    node = Choosy(chain.ledger, "http://choosy")
    follow = Follow(tmp_path, node, names=(name, NAME))
    chain.write(chain.pen.chunks(2))
    chain.ledger.set_data(account, pen.log.tk, [chunk.encoded for chunk in pen.chunks(3)])
    assert follow.look() == [0, 1] and follow.robots[0].trouble
    node.choosy = False
    assert follow.look() == [0, 1, 2] and not follow.robots[0].trouble
    assert [robot.reading.verdict().chunks for robot in follow.robots if robot.reading] == [3, 2]


def test_a_name_that_nobody_has_ends_it(chain: Chain, tmp_path: Path):
    with pytest.raises(IdentityError, match="no robot of the name robot_9"):
        Follow(tmp_path, chain.ledger, names=("robot_9",)).look()


def test_a_node_that_comes_back_without_the_robot_is_waited_for(chain: Chain, tmp_path: Path):
    """It is synchronised anew, or another chain: the first may become right, and neither ends the following."""
    node = Node(chain.ledger, "http://behind")
    follow = Follow(tmp_path, node)
    chain.write(chain.pen.chunks(2))
    assert follow.look() == [0, 1]
    node._standing = {"account": None}
    chain.write(chain.pen.chunks(1))
    assert follow.look() == [] and "behind, or of another chain" in follow.robots[0].trouble
    node._standing = {}
    assert follow.look() == [2] and not follow.robots[0].trouble and follow.verdict.sound


def test_with_confirmations_the_newest_blocks_are_given_later(chain: Chain, tmp_path: Path):
    follow = Follow(tmp_path, chain.ledger, confirmations=3)
    given = []
    for _ in range(5):
        chain.write(chain.pen.chunks(1), ACCOUNT)
        given.append(follow.look())
    assert given == [[], [], [0], [1], [2]] and follow.verdict.sound
