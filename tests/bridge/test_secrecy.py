"""What the operator, the network and the public can see of a run: no field, no topic, no key."""

from __future__ import annotations

import json
import struct
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pytest

from rosbridge_eth.demo import DemoResult, run_demo
from rosbridge_eth.relay import Harm
from rosbridge_eth.sources.sample import sample_bag


class Seen:
    """One run, and every byte that left the robot's memory for a place others can see."""

    def __init__(self, folder: Path) -> None:
        self.datagrams: list[bytes] = []
        self.result: DemoResult = run_demo(
            folder, sample_bag(), harm=Harm(loss=0.1, duplicate=0.05, reorder=0.05), on_datagram=self.datagrams.append
        )
        self.places = {
            "network": b"".join(self.datagrams),
            "spool": self._files(folder / "robot", "spool.sqlite*"),
            "inbox": self._files(folder / "operator", "inbox.sqlite*"),
            "journal": self._files(folder / "operator", "journal.sqlite*"),
            "chain": b"".join(item.record.ciphertext for item in self.result.reading.history.records),
        }

    @staticmethod
    def _files(folder: Path, pattern: str) -> bytes:
        return b"".join(path.read_bytes() for path in folder.glob(pattern))


@pytest.fixture(scope="module")
def seen(tmp_path_factory: pytest.TempPathFactory) -> Seen:
    return Seen(tmp_path_factory.mktemp("secrecy"))


def leaves(value: Any) -> Iterator[Any]:
    if isinstance(value, dict):
        for part in value.values():
            yield from leaves(part)
    elif isinstance(value, list):
        for part in value:
            yield from leaves(part)
    else:
        yield value


def telltales(result: DemoResult) -> set[bytes]:
    """Names, and values long enough not to occur by chance: as JSON writes them, and as IEEE 754 in both orders."""
    found = {b"/robot_1/odom", b"nav_msgs/msg/Odometry", b"nav_msgs", b"position", b"received_ns"}
    for record in result.records:
        found.add(str(record.captured.received_ns).encode())
        for leaf in leaves(record.captured.data):
            if isinstance(leaf, float) and leaf:
                text = json.dumps(leaf).encode()
                if len(text) >= 8:
                    found |= {text, struct.pack("<d", leaf), struct.pack(">d", leaf)}
            elif isinstance(leaf, str) and len(leaf) >= 4:
                found.add(leaf.encode())
    return found


def test_the_run_was_harmed_and_still_complete(seen: Seen) -> None:
    assert seen.result.passed
    assert seen.result.stages.retransmitted > 0


@pytest.mark.parametrize("place", ["network", "spool", "inbox", "journal", "chain"])
def test_nothing_of_the_bag_is_to_be_seen(seen: Seen, place: str) -> None:
    content = seen.places[place]
    assert len(content) > 4096
    found = sorted(word for word in telltales(seen.result) if word in content)
    assert not found


def test_the_test_would_notice(seen: Seen) -> None:
    opened = b"".join(record.proven.payload for record in seen.result.records)
    assert sum(word in opened for word in telltales(seen.result)) > 1000


def test_equal_messages_give_unequal_ciphertexts(seen: Seen) -> None:
    ciphertexts = [item.record.ciphertext for item in seen.result.reading.history.records]
    assert len(set(ciphertexts)) == len(ciphertexts)
    bodies = [text[10:42] for text in ciphertexts]
    assert len(set(bodies)) == len(bodies)


def test_lengths_tell_only_the_multiple_of_256(seen: Seen) -> None:
    assert all(
        len(item.record.ciphertext) % 256 == 0
        for item in seen.result.reading.history.records
        if item.record.id.seq > 0
    )
