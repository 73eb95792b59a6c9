"""What the operator, the network and the public can see of a run: no field, no topic, no key, no passphrase."""

from __future__ import annotations

import base64
import io
import json
import logging
import secrets
import struct
import threading
from datetime import UTC, datetime
from functools import cached_property
from pathlib import Path
from socket import socket
from types import SimpleNamespace
from typing import Any

import pytest
from web3 import Web3

from bridge.secrecy import betrayed, leaves
from rosbridge_eth.channel import handshake
from rosbridge_eth.channel.protection import SessionSecrets
from rosbridge_eth.cli import demo
from rosbridge_eth.cli.demo import DemoResult, LossySocket, run_demo
from rosbridge_eth.identity import load_ca, load_identity
from rosbridge_eth.ledger import Keyring, Ledger, nodes
from rosbridge_eth.log.chunk import MAX_READERS, Chunk, content_key, robot_id
from rosbridge_eth.robot.sources.bag import sample_bag
from rosbridge_eth.terminal import LOGGER, TextFormatter
from smcrypto import sm2

PLACES = ("network", "chain", "operator's home", "spool", "logs")


class RecordedSocket(LossySocket):
    """Loses a tenth of the datagrams, and keeps all that come in and go out."""

    def __init__(self, sock: socket, seen: list[bytes]) -> None:
        super().__init__(sock, 0.1)
        self.seen = seen

    def recvfrom(self, *arguments: Any) -> Any:
        received = super().recvfrom(*arguments)
        self.seen.append(received[0])
        return received

    def sendto(self, *arguments: Any) -> int:
        self.seen.append(arguments[0])
        return super().sendto(*arguments)


class Seen:
    """One run on a bad network, and every byte that left the robot's memory for a place others can see."""

    def __init__(self, folder: Path, patch: pytest.MonkeyPatch) -> None:
        self.folder = folder
        self.passphrases, self.session_keys = list[str](), list[bytes]()
        self._record(patch)
        datagrams, logs = list[bytes](), io.StringIO()
        handler = logging.StreamHandler(logs)
        handler.setFormatter(TextFormatter())
        others = {thread.ident for thread in threading.enumerate()} - {threading.get_ident()}
        handler.addFilter(lambda record: record.thread not in others)  # what another test left running is not this run
        logger = logging.getLogger(LOGGER)
        logger.addHandler(handler)
        level = logger.level
        logger.setLevel(logging.DEBUG)  # which the loggers below it have to be told
        try:
            self.result: DemoResult = run_demo(
                folder, sample_bag(), network=lambda sock: RecordedSocket(sock, datagrams)
            )
        finally:
            logger.setLevel(level)
            logger.removeHandler(handler)
        chain, self.chunks = self._chain()
        self.places = {
            "network": b"".join(datagrams),
            "chain": chain,
            "operator's home": _files(folder / "operator", "**/*"),
            "spool": _files(folder / "robot", "spool.sqlite*"),
            "logs": logs.getvalue().encode(),
        }

    def _record(self, patch: pytest.MonkeyPatch) -> None:
        """Keep what the run makes for itself: its passphrases, its sessions' secrets, its chain."""
        seen = self

        def passphrase(size: int) -> str:
            seen.passphrases.append(secrets.token_hex(size))
            return seen.passphrases[-1]

        def secrets_of_session(*arguments: Any) -> SessionSecrets:
            made = SessionSecrets(*arguments)
            seen.session_keys += [made.client, made.server, made.finished]
            return made

        class Kept(nodes.EmbeddedChain):
            def __init__(self, *arguments: Any, **more: Any) -> None:
                super().__init__(*arguments, **more)
                seen.provider = self

        patch.setattr(demo, "secrets", SimpleNamespace(token_hex=passphrase))
        patch.setattr(handshake, "SessionSecrets", secrets_of_session)
        patch.setattr(nodes, "EmbeddedChain", Kept)

    def _chain(self) -> tuple[bytes, list[Chunk]]:
        """All that a node gives out: transactions with their data, events; and the robot's chunks."""
        ledger, content, chunks = Ledger(self.provider, self.result.contract), list[bytes](), list[Chunk]()
        eth: Any = Web3(self.provider).eth
        for number in range(ledger.block_number() + 1):
            content += [bytes(eth.get_transaction(one)["input"]) for one in eth.get_block(number)["transactions"]]
            content += [bytes(one["data"]) for one in eth.get_logs({"fromBlock": number, "toBlock": number})]
        for event in ledger.data_events(robot_id(demo.ROBOT), 0, ledger.block_number()):
            chunks += map(Chunk.parse, event.chunks)
        return b"".join(content), chunks

    @cached_property
    def keys(self) -> dict[str, bytes]:
        """Every secret of the run, by what it is."""
        passphrase, password, readers = (text.encode() for text in self.passphrases)
        operator = self.folder / "operator"
        ring = Keyring.load(operator / "accounts.json", passphrase)
        found = {f"passphrase {number}": text.encode() for number, text in enumerate(self.passphrases)}
        found |= {f"session secret {number}": key for number, key in enumerate(self.session_keys)}
        found |= {f"account {number}": bytes(ring.account(number).key) for number in range(2)}
        found["mnemonic"] = ring.mnemonic.encode()
        for who, folder, word in (
            ("server", operator / "server", passphrase), ("robot", self.folder / "robot" / "identity", password),
            ("reader", self.folder / "reader", readers),
        ):  # fmt: skip
            identity, _ = load_identity(folder, word)
            found[f"{who}'s signing key"] = _bytes(identity.signing_key)
            found[f"{who}'s encryption key"] = _bytes(identity.encryption_key)
            if who == "reader":
                keys = (content_key(chunk.header, identity.encryption_key) for chunk in self.chunks if chunk.body)
                found |= {f"key of chunk {number}": key for number, key in enumerate(keys)}
        found["CA's key"] = _bytes(load_ca(operator / "ca", passphrase, datetime.now(UTC)).key)
        return found


def _bytes(key: sm2.PrivateKey) -> bytes:
    return key.to_int().to_bytes(32, "big")


def _files(folder: Path, pattern: str) -> bytes:
    return b"".join(path.read_bytes() for path in sorted(folder.glob(pattern)) if path.is_file())


@pytest.fixture(scope="module")
def seen(tmp_path_factory: pytest.TempPathFactory) -> Seen:
    with pytest.MonkeyPatch.context() as patch:
        return Seen(tmp_path_factory.mktemp("secrecy"), patch)


def telltales(result: DemoResult) -> set[bytes]:
    """Names, and values long enough not to occur by chance: as JSON writes them, and as IEEE 754 in both orders."""
    found = {b"/robot_1/odom", b"nav_msgs", b'"position"', b"orientation", b"covariance", b"frame_id", b"received_ns",
             b"captured_ns", b"geometry_msgs", b"float64"}  # fmt: skip
    for record in result.records:
        found |= {str(record.content.received_ns).encode(), str(record.content.captured_ns).encode()}
        for leaf in leaves(record.content.data):
            if isinstance(leaf, float) and leaf:
                text = json.dumps(leaf).encode()
                if len(text) >= 8:
                    found |= {text, struct.pack("<d", leaf), struct.pack(">d", leaf)}
            elif isinstance(leaf, str) and len(leaf) >= 4 and leaf not in ("position", "header"):
                found.add(leaf.encode())  # those two are words of the databases and of HTTP
    return found


def test_the_run_was_harmed_and_still_complete(seen: Seen) -> None:
    assert seen.result.passed
    assert len(seen.passphrases) == 3 and len(seen.session_keys) >= 6
    assert len(seen.keys) > 20


@pytest.mark.parametrize("place", PLACES)
def test_nothing_of_the_bag_is_to_be_seen(seen: Seen, place: str) -> None:
    assert len(seen.places[place]) > (300 if place == "logs" else 4096)
    assert betrayed(seen.places[place], telltales(seen.result)) == []


@pytest.mark.parametrize("place", [*PLACES, "everything that was written"])
def test_no_key_and_no_passphrase_is_to_be_seen(seen: Seen, place: str) -> None:
    content = seen.places.get(place) or _files(seen.folder, "**/*")
    names = {key: name for name, key in seen.keys.items()}
    assert [names[key] for key in names if betrayed(content, [key])] == []


def test_the_test_would_notice(seen: Seen) -> None:
    opened = b"".join(record.line for record in seen.result.records)
    assert len(betrayed(opened, telltales(seen.result))) > 1000
    key = next(iter(seen.keys.values()))
    for hidden in (key, key.hex().encode(), key.hex().upper().encode()):
        assert betrayed(b"x" * 5 + hidden + b"y", [key])


@pytest.mark.parametrize("before", range(3))
def test_the_test_would_notice_base64(before: int) -> None:
    assert betrayed(base64.b64encode(b"a" * before + b"a secret of some length" + b"zz"), [b"a secret of some length"])


def test_equal_messages_give_unequal_ciphertexts(seen: Seen) -> None:
    blocks = [chunk.body[at : at + 32] for chunk in seen.chunks for at in range(0, len(chunk.body) - 31, 16)]
    assert len(blocks) > 100
    assert len(set(blocks)) == len(blocks)


def test_lengths_tell_only_the_multiple_of_64(seen: Seen) -> None:
    assert seen.chunks
    assert all((len(chunk.body) - 16) % 64 == 0 for chunk in seen.chunks if chunk.body)


def test_the_header_names_readers_by_nothing_that_two_chunks_share(seen: Seen) -> None:
    points = [grant[:65] for chunk in seen.chunks for grant in chunk.header.grants]
    assert len(points) > 1 and len(set(points)) == len(points)
    assert all(len(chunk.header.grants) <= MAX_READERS for chunk in seen.chunks)
