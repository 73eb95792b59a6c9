"""docs/verify.mjs, written from docs/log.md on other libraries, and this reader come to the same of one chain."""

from __future__ import annotations

import json
import shutil
import subprocess
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest

from bridge.reading.world import (
    NAME,
    START,
    STREAM_LINE,
    Pen,
    authority,
    line,
    message,
    reader,
    robot,
)
from conftest import unavailable
from ports import free_port
from rosbridge_eth.chunk import Log
from rosbridge_eth.errors import ChainError
from rosbridge_eth.identity import Trust
from rosbridge_eth.ledger import Keyring, Ledger
from rosbridge_eth.ledger.nodes import Anvil
from rosbridge_eth.reading import Verdict, read_robot

pytestmark = [pytest.mark.service, pytest.mark.slow]
DOCS = Path(__file__).resolve().parents[3] / "docs"
KEYS = Keyring.from_mnemonic("test " * 11 + "junk")  # the accounts to which anvil gives ETH


@pytest.fixture(scope="module")
def verifier(require: Callable[[str], str], tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """The command, with its packages installed as the lock file pins them."""
    node, npm = require("node"), require("npm")
    folder = tmp_path_factory.mktemp("verify")
    for name in ("verify.mjs", "package.json", "package-lock.json"):
        shutil.copy(DOCS / name, folder)
    try:
        subprocess.run([npm, "ci", "--no-audit", "--no-fund"], cwd=folder, check=True, capture_output=True, timeout=120)
    except (subprocess.SubprocessError, OSError) as error:
        unavailable(f"npm cannot install what docs/verify.mjs needs: {error}")
    return [node, str(folder / "verify.mjs")]


@pytest.fixture(scope="module")
def anvil(require: Callable[[str], str]) -> Iterator[Anvil]:
    require("npx")
    try:
        chain = Anvil.start(free_port())
    except ChainError as error:
        unavailable(str(error))
    with chain:
        yield chain


@dataclass
class Written:
    ledger: Ledger
    pen: Pen

    def write(self, *chunks: Any) -> None:
        encoded = [chunk if isinstance(chunk, bytes) else chunk.on_chain.encoded for chunk in chunks]
        self.ledger.set_data(KEYS.robot(1), self.pen.log.tk, encoded)


@pytest.fixture
def chain(anvil: Anvil) -> Written:
    ledger, _ = Ledger.deploy(anvil.url, KEYS.operator)
    pen = Pen()
    pen.log = Log(ledger.ledger, pen.log.tk)
    ledger.registration(KEYS.operator, pen.log.tk, KEYS.robot(1).address, robot().public.certificates)
    return Written(ledger, pen)


@dataclass
class Both:
    """What the two readers make of one chain: the verdict of each, the records they agree on."""

    here: Verdict
    there: dict[str, Any]
    records: list[dict[str, Any]]


def both(
    chain: Written, verifier: list[str], tmp_path: Path, key: bool = True, archive: Path | None = None
) -> Both:
    def body(digest: bytes, length: int) -> bytes | None:
        file = (archive or tmp_path) / digest.hex()[:2] / digest.hex()
        return file.read_bytes() if file.exists() else None

    reading = read_robot(
        [chain.ledger], NAME, trust=Trust([authority().certificate]), now=START.timestamp(),
        reader=reader().encryption_key if key else None, bodies=body if archive else None,
    )  # fmt: skip
    mine = [(record.line, record.place.chunk, record.number) for record in reading.records()]
    here = reading.verdict()
    ca = tmp_path / "ca.crt.pem"
    ca.write_bytes(authority().certificate.to_pem())
    command = [*verifier, "--node", chain.ledger.url, "--contract", chain.ledger.contract]
    command += ["--robot", NAME, "--ca", str(ca)]
    command += ["--key", reader().encryption_key.to_bytes().hex()] if key else []
    command += ["--archive", str(archive)] if archive else []
    done = subprocess.run(command, capture_output=True, timeout=120)
    assert done.returncode in (0, 9), done.stderr.decode()
    there = json.loads(done.stderr)
    records = []
    for text, (mine_line, index, number) in zip(done.stdout.splitlines(), mine, strict=True):
        value = json.loads(text)
        proof = value.pop("proof")
        assert (value, proof["chunk"], proof["record"]) == (json.loads(mine_line), index, number)
        records.append(value)
    assert (done.returncode == 0) == there["sound"] == here.sound
    assert (there["chunks"], there["records"]) == (here.chunks, here.records)
    counts = {kind: count for kind, count in here.counts.items() if kind != "new-certificate"}
    assert there["counts"] == counts
    assert [one["fingerprint"] for one in there["certificates"] if not one["revoked"]] == [
        one.fingerprint for one in here.certificates if not one.revoked
    ]
    return Both(here, there, records)


def test_a_log_of_all_there_is(chain, verifier, tmp_path):
    pen = chain.pen
    first = pen.write(STREAM_LINE, message(1), message(2, text="é漢\u2028\x9b31m"), b"null", b"no json")
    chain.write(first, *pen.chunks(3, records=120))
    event = line({"trigger": "crash", "why": "/bumper data == true", "at_ns": 10**18})
    lost = line({"lost": 3, "topic": "/scan", "why": "too long"})
    dropped = pen.drop(pen.write(message(7), message(8)))
    chain.write(dropped, pen.write(lost, event, message(9)), pen.write())
    pen.new_stream(b"b" * 16)
    chain.write(*pen.chunks(2), pen.write(goodbye=True))
    read = both(chain, verifier, tmp_path)
    assert not read.here.sound
    assert read.there["counts"] == {"unopenable": 2, "dropped": 2, "lost": 3, "triggered": 1, "restarted": 1}
    assert len(read.records) == 2 + 360 + 1 + 2
    assert read.there["head"]["goodbye"]


def test_several_readers_and_a_certificate_that_changes(chain, verifier, tmp_path):
    pen = chain.pen
    pen.readers = [reader("insurer"), reader()]
    chain.write(*pen.chunks(2))
    pen.readers = [reader("insurer")]
    chain.write(*pen.chunks(1, goodbye=True))
    account = KEYS.robot(2)
    chain.ledger.replace_registration(KEYS.operator, pen.log.tk, account.address, robot(1).public.certificates)
    pen.identity = robot(1)
    pen.new_stream(b"b" * 16)
    pen.readers = [reader()]
    chain.ledger.set_data(account, pen.log.tk, [chunk.encoded for chunk in pen.chunks(2)])
    chain.ledger.revoke_robot(KEYS.operator, pen.log.tk)
    read = both(chain, verifier, tmp_path)
    assert read.there["counts"] == {"no-grant": 1}
    assert len(read.records) == 4


def test_without_a_key(chain, verifier, tmp_path):
    chain.write(*chain.pen.chunks(3, records=2))
    assert both(chain, verifier, tmp_path, key=False).there["counts"] == {"no-grant": 6}


def test_an_archive(chain, verifier, tmp_path):
    pen = chain.pen
    chunks = [pen.write(message(n, image=100_000 * "QUJD"), archived=True) for n in range(4)]
    dropped = pen.drop(pen.write(message(9), archived=True))
    chain.write(*chunks, dropped, *pen.chunks(1, goodbye=True))
    folder = tmp_path / "bodies"
    for chunk, spoil in zip(chunks[:3], (b"", b"", b"x"), strict=True):
        name = chunk.header.body_digest.hex()
        (folder / name[:2]).mkdir(parents=True, exist_ok=True)
        (folder / name[:2] / name).write_bytes(chunk.body + spoil)
    read = both(chain, verifier, tmp_path, archive=folder)
    assert read.there["counts"] == {"withheld": 2, "dropped": 1} and not read.there["sound"]
    assert [record["data"]["x"] for record in read.records] == [0, 1, 5]
    unseen = both(chain, verifier, tmp_path)
    assert unseen.there["counts"] == {"archived": 4, "dropped": 1} and unseen.there["sound"]


def test_what_is_wrong_is_called_by_the_same_name(chain, verifier, tmp_path):
    pen = chain.pen
    chunks = pen.chunks(8)
    flipped = bytearray(chunks[2].encoded)
    flipped[70] ^= 1
    body = replace(chunks[4], body=bytes([chunks[4].body[0] ^ 1]) + chunks[4].body[1:])
    chain.write(chunks[0], b"junk" * 100, chunks[1], bytes(flipped), chunks[3], body, chunks[0], chunks[7])
    foreign = Pen(log=Log(b"M" * 32, pen.log.tk)).write(message(1))
    other = Pen(log=pen.log, number=1, previous=chunks[0].header.digest, sealed_ms=pen.sealed_ms).write(message(99))
    chain.write(foreign, other, Pen(log=pen.log, identity=robot(1)).write(message(1)))
    read = both(chain, verifier, tmp_path)
    assert set(read.there["counts"]) == {"malformed", "forged", "altered", "forked", "missing"}
