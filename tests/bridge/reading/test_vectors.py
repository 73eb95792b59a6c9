"""Every vector of logs, grants and evidence is given to all that read them: `read`, verify.mjs, the evidence page."""

from __future__ import annotations

import json
import subprocess
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

from bridge.browser import Browser
from bridge.reading.test_javascript import verifier
from bridge.reading.vectors import Node, ask_read
from bridge.reading.world import START
from rosbridge_eth import identity
from rosbridge_eth.errors import VerificationError
from rosbridge_eth.identity import Identity, Role, Trust, read_certificates
from rosbridge_eth.log.chunk import Chunk, Log, Unopenable, open_lines, robot_id
from rosbridge_eth.reading.evidence import Evidence, verify
from rosbridge_eth.reading.grant import open_grant
from smcrypto import sm2

__all__ = ["verifier"]

FOLDER = Path(__file__).parents[2] / "vectors"


def vectors_of(name: str) -> list[dict[str, Any]]:
    found: list[dict[str, Any]] = json.loads((FOLDER / name).read_text())["tests"]
    return found


logs = pytest.mark.parametrize("file", vectors_of("log/logs.json"), ids=lambda file: file["name"])


@logs
def test_read_says_of_each_log_what_the_vector_says(file: dict[str, Any]) -> None:
    with Node(file) as node:
        assert ask_read(node, file) == (file["verdict"], file["lines"])


@logs
@pytest.mark.service
def test_the_reader_in_javascript_says_the_same(file: dict[str, Any], verifier: list[str], tmp_path: Path) -> None:
    (tmp_path / "ca.pem").write_text(file["ca"])
    with Node(file) as node:
        command = [*verifier, "--node", node.url, "--contract", file["contract"], "--robot", file["robot"]]
        command += ["--ca", str(tmp_path / "ca.pem"), "--key", file["reader_key"]]
        done = subprocess.run(command, capture_output=True, timeout=120)
    said, expected = json.loads(done.stderr), file["verdict"]
    assert list(map(json.loads, done.stdout.splitlines())) == list(map(json.loads, file["lines"]))
    assert done.returncode == (0 if expected["sound"] else 9)
    counts = {kind: count for kind, count in expected["counts"].items() if kind != "new-certificate"}
    assert said["counts"] == counts
    for name in ("sound", "chunks", "records", "certificates"):
        assert said[name] == expected[name]
    assert expected["head"] is None or expected["head"].items() <= said["head"].items()
    for kind, places in expected["places"].items():
        assert sorted({one["chunk"] for one in said["findings"] if one["kind"] == kind}) == places, kind


def test_every_wrong_chunk_is_found_under_its_name() -> None:
    kinds = {one["finding"] for file in vectors_of("log/logs.json") for one in file["about"]}
    assert kinds == {
        "malformed", "forged", "altered", "unopenable", "no-grant", "untrusted", "missing", "forked", "restarted",
        "dropped", "clock", None,
    }  # fmt: skip
    for file in vectors_of("log/logs.json"):
        for one in file["about"]:
            if one["finding"] is not None:
                assert one["chunk"] in file["verdict"]["places"][one["finding"]], one


@pytest.mark.parametrize("file", vectors_of("log/grant.json"), ids=["grant"])
def test_the_grant_opens_its_chunks(file: dict[str, Any]) -> None:
    who = identity.enrol(identity.create_ca("any", at=START), Role.READER, "insurer", at=START)
    key = sm2.PrivateKey.from_bytes(bytes.fromhex(file["reader_key"]))
    who = Identity(who.role, who.name, who.signing_certificate, who.encryption_certificate, who.signing_key, key)
    ledger, trust = bytes.fromhex(file["ledger"]), Trust(read_certificates(file["ca"].encode()))
    robot, keys = open_grant(file["grant"].encode(), ledger=ledger, reader=who, trust=trust)
    assert {digest.hex(): one.hex() for digest, one in keys.items()} == file["keys"] and robot == file["robot"]
    given = json.loads(file["grant"])
    signature, by = bytes.fromhex(given.pop("signature")), identity.public_identity(given["by"].encode())
    text = json.dumps(given, separators=(",", ":"), ensure_ascii=False).encode()  # docs/reading.md, Granting
    by.signing_certificate.public_key.verify(signature, b"rosbridge-eth/2 grant\0" + text, encoding="raw")
    chunks = [Chunk.parse(bytes.fromhex(one)) for one in file["chunks"]]
    log = Log(ledger, robot_id(robot))
    assert all(len(open_lines(log, one, keys[one.header.digest])) == 2 for one in chunks[1:])
    with pytest.raises(Unopenable):
        open_lines(log, chunks[0], keys[chunks[1].header.digest])
    for old, new in (("2026-01-03", "2026-01-04"), (file["ledger"], "11" * 32)):
        with pytest.raises(VerificationError):
            open_grant(file["grant"].replace(old, new, 1).encode(), ledger=ledger, reader=who, trust=trust)


EVIDENCE = json.loads((FOLDER / "evidence" / "files.json").read_text())


def test_verify_says_of_each_file_of_evidence_what_the_vector_says() -> None:
    roots = read_certificates(EVIDENCE["ca"].encode())
    for one in EVIDENCE["tests"]:
        try:
            held = bool(verify(Evidence.read(one["text"].encode()), roots, lambda line: None).records)
        except VerificationError:
            held = False
        assert held == one["holds"], one["name"]


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory, require: Callable[[str], str]) -> Iterator[Browser]:
    with Browser(tmp_path_factory.mktemp("browser")) as opened:
        yield opened


@pytest.mark.service
def test_the_page_of_evidence_says_the_same(browser: Browser, tmp_path: Path) -> None:
    good = Evidence.read(next(one["text"] for one in EVIDENCE["tests"] if one["holds"]).encode())
    (tmp_path / "page.html").write_text(good.page())
    browser.open((tmp_path / "page.html").as_uri())
    browser.until("document.getElementById('verdict').className !== ''")
    for one in EVIDENCE["tests"]:
        checked = f"evidence.verify({json.dumps(one['text'])}, () => {{}})"
        said = browser.run(f"(() => {{ try {{ {checked}; return true }} catch (error) {{ return error.message }} }})()")
        assert (said is True) == one["holds"], (one["name"], said)
