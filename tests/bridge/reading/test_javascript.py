"""docs/verify.mjs, written from docs/log.md on other libraries, and this reader come to the same of one chain."""

from __future__ import annotations

import json
import shutil
import subprocess
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import pytest

from bridge.reading.certificates import CAS, cases
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
from rosbridge_eth.errors import ChainError
from rosbridge_eth.identity import CertificateAuthority, Trust
from rosbridge_eth.ledger import Keyring, Ledger
from rosbridge_eth.ledger.nodes import Anvil
from rosbridge_eth.log import chunk
from rosbridge_eth.log.chunk import Log, zstd
from rosbridge_eth.reading import Verdict, read_robot
from rosbridge_eth.reading.outputs import json_line

pytestmark = [pytest.mark.service, pytest.mark.slow]
DOCS = Path(__file__).resolve().parents[3] / "docs"
REST = "src/rosbridge_eth/reading/evidence.js"
KEYS = Keyring.from_mnemonic("test " * 11 + "junk")  # the accounts to which anvil gives ETH


@pytest.fixture(scope="module")
def verifier(require: Callable[[str], str], tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """The command, with its packages installed as the lock file pins them."""
    node, npm = require("node"), require("npm")
    folder = tmp_path_factory.mktemp("verify") / "docs"
    (folder.parent / REST).parent.mkdir(parents=True)
    shutil.copy(DOCS.parent / REST, folder.parent / REST)
    folder.mkdir()
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
        encoded = [chunk if isinstance(chunk, bytes) else chunk.encoded for chunk in chunks]
        self.ledger.set_data(KEYS.account(1), self.pen.log.tk, encoded)


@pytest.fixture
def chain(anvil: Anvil) -> Written:
    ledger, _ = Ledger.deploy(anvil.url, KEYS.operator)
    pen = Pen()
    pen.log = Log(ledger.ledger, pen.log.tk)
    ledger.registration(KEYS.operator, pen.log.tk, KEYS.account(1).address, robot().public.certificates)
    return Written(ledger, pen)


@dataclass
class Both:
    """What the two readers make of one chain: the verdict of each, the records they agree on."""

    here: Verdict
    there: dict[str, Any]
    records: list[dict[str, Any]]


def both(
    chain: Written, verifier: list[str], tmp_path: Path, key: bool = True,
    cas: Sequence[CertificateAuthority] = (authority(),),
) -> Both:  # fmt: skip
    reading = read_robot(
        [chain.ledger], NAME, trust=Trust([one.certificate for one in cas]), now=START.timestamp(),
        reader=reader().encryption_key if key else None,
    )  # fmt: skip
    mine = [json.loads(json_line(record)) for record in reading.records()]
    here = reading.verdict()
    ca = tmp_path / "ca.crt.pem"
    ca.write_bytes(b"".join(one.certificate.to_pem() for one in cas))
    command = [*verifier, "--node", chain.ledger.url, "--contract", chain.ledger.contract]
    command += ["--robot", NAME, "--ca", str(ca)]
    command += ["--key", reader().encryption_key.to_bytes().hex()] if key else []
    done = subprocess.run(command, capture_output=True, timeout=120)
    assert done.returncode in (0, 9), done.stderr.decode()
    there = json.loads(done.stderr)
    records = []
    for text, expected in zip(done.stdout.splitlines(), mine, strict=True):
        value = json.loads(text)
        assert value == expected and list(value["proof"]) == list(expected["proof"])
        records.append(value)
    assert (done.returncode == 0) == there["sound"] == here.sound
    assert (there["chunks"], there["records"]) == (here.chunks, here.records)
    counts = {kind: count for kind, count in here.counts.items() if kind != "new-certificate"}
    assert there["counts"] == counts
    assert [one["fingerprint"] for one in there["certificates"] if not one["revoked"]] == [
        one.fingerprint for one in here.certificates if not one.revoked
    ]
    assert [one["trusted"] for one in there["certificates"]] == [one.key is not None for one in here.certificates]
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
    account = KEYS.account(2)
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


def test_certificates_are_judged_by_the_table_of_the_page(chain, verifier, tmp_path):
    """The same cases as evidence in test_evidence.py."""
    known = list(cases())
    for number, case in enumerate(known, 20):
        account = KEYS.account(number).address
        chain.ledger.replace_registration(KEYS.operator, chain.pen.log.tk, account, case.registered)
    read = both(chain, verifier, tmp_path, cas=CAS)
    judged = dict(zip((case.name for case in known), read.here.certificates[1:], strict=True))
    assert [name for name, one in judged.items() if one.key] == [case.name for case in known if case.good]


def streamed(content: bytes, **options: int) -> bytes:
    packing = zstd.ZstdCompressor(options={int(getattr(zstd.CompressionParameter, k)): v for k, v in options.items()})
    return packing.compress(content) + packing.flush()


def test_frames_that_are_none_are_opened_by_neither(chain, verifier, tmp_path, monkeypatch):
    good = message(1), message(2)
    content = b"\n".join([*good, b""])
    checked = streamed(content, checksum_flag=1)
    dictionary = zstd.train_dict([message(n, topic=f"/t{n % 7}") for n in range(2_000)], 4096)
    foreign = zstd.compress(content, zstd_dict=dictionary)
    long = message(1, text="x" * 70_000), message(2)
    frames = {
        "good": chunk._framed(streamed(content), content), "raw": chunk._stored(content),
        "window of 4 MiB": streamed(content, window_log=22), "with a checksum": checked,
        "a wrong checksum": checked[:-1] + bytes([checked[-1] ^ 1]), "a dictionary": foreign,
        "an empty record in the middle": streamed(good[0] + b"\n\n" + good[1] + b"\n"),
        "an empty record in front": streamed(b"\n" + content), "no end": streamed(content[:-1]),
        "a bomb": streamed(content + b"a" * (5 << 20) + b"\n"), "another size": zstd.compress(content)[:5] + b"\x01"
        + zstd.compress(content)[6:], "two frames": streamed(content) * 2, "a long line": None,
    }  # fmt: skip
    for frame in frames.values():
        if frame is None:
            chain.write(chain.pen.write(*long))
            continue
        with monkeypatch.context() as patched:
            padded = frame.ljust(len(frame) + -len(frame) % 64, b"\0")
            patched.setattr(chunk, "_pack", lambda *given, padded=padded: padded)
            chain.write(chain.pen.write(*good))
    read = both(chain, verifier, tmp_path)
    assert read.there["counts"]["unopenable"] == read.here.counts["unopenable"] > 6
    assert len(read.records) == 5


@pytest.mark.parametrize("clock", [True, False])
def test_lines_in_another_form_are_told_by_both(chain, verifier, tmp_path, clock):
    data = message(1, text="é\u2028", big=2**62, small=1e-300)
    spoiled = [
        data.replace(b",", b", ", 1), data.replace(b"/odom", b"\\u002fodom"), data.replace(b"/odom", b"\\/odom"),
        data.replace(b'"x":1', b'"x":1,"x":2'), data.replace(b'"clock":true', b'"clock":1'), data + b" ", data[:-1],
        data.replace(b'"received_ns":1', b'"received_ns":-1'), data.replace(b'"received_ns":1', b'"received_ns":1.0'),
        data.replace(b'"received_ns":1', b'"received_ns":9223372036854775808'), data.replace(b'"x":1', b'"x":1e400'),
        data.replace(b'"x":1', b'"x":NaN'), data.replace(b'"x":1', b'"x":' + b"[" * 120 + b"]" * 120),
        data.replace(b'"x":1', b'"x":"\\ud800"'), data.replace(b'"x":1', b'"x":"\xff"'), message(1, text="x" * 62_000),
        data.replace(b'"topic"', b'"topics"'), data.replace(b'"data":{', b'"more":1,"data":{'), b"[]", b"{}", b"1",
        line({"source": "sim", "software": "s"}), line({"lost": -1, "topic": "/t", "why": "w"}),
        line({"lost": 1, "topic": "/t"}), line({"type": "t", "wire": "ros1", "format": 1, "definition": "d"}),
        line({"trigger": "t", "why": "w", "at_ns": 2**63}), b'{"stream":{"source":"sim","software":"s"},"x":1}',
    ]
    fine = [
        data, message(2, clock=clock), line({"lost": 2**53, "topic": "/t", "why": 'a"b\n\x1b'}), STREAM_LINE,
        data.replace(b'"x":1', b'"x":[1.50,-0,1E5,123456789012345678901234567890]'), message(3, lost=5, at_ns=-7),
    ]
    chain.write(chain.pen.write(*spoiled, *fine))
    read = both(chain, verifier, tmp_path)
    assert read.there["counts"]["unopenable"] == len(spoiled)
    assert len(read.records) == 4


def test_a_whole_chunk_behind_its_dropped_form(chain, verifier, tmp_path):
    pen = chain.pen
    one, two, three = pen.chunks(3, records=2)
    chain.write(one, pen.drop(two), three, two, two)
    read = both(chain, verifier, tmp_path)
    assert read.there["counts"] == {"dropped": 2, "forked": 1} and len(read.records) == 6
