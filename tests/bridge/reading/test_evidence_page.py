"""The page of evidence in a real browser: what it shows, that altered ones fail there, and that it asks nobody."""

from __future__ import annotations

import json
import os
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest
from eth_hash.auto import keccak

from bridge.browser import Browser
from bridge.reading.recorded import EVIL, KEYS, ROOTS, Recorded, at, record
from bridge.reading.test_evidence import start
from bridge.reading.world import message
from rosbridge_eth.errors import VerificationError
from rosbridge_eth.identity import create_ca
from rosbridge_eth.ledger import Ledger
from rosbridge_eth.log.chunk import Chunk
from rosbridge_eth.reading import Choice
from rosbridge_eth.reading.evidence import Evidence, verify
from rosbridge_eth.reading.verdict import grouped
from smcrypto import sm3

pytestmark = [pytest.mark.service, pytest.mark.slow]


@pytest.fixture(scope="module")
def recorded(require: Callable[[str], str]) -> Iterator[Recorded]:
    require("npx")
    with start() as node:
        yield record(node)


@pytest.fixture(scope="module")
def browser(tmp_path_factory: pytest.TempPathFactory) -> Iterator[Browser]:
    with Browser(tmp_path_factory.mktemp("browser")) as opened:
        yield opened


@pytest.fixture(scope="module")
def one(recorded: Recorded) -> Evidence:
    return recorded.evidence(Choice("/robot_1/odom", at_ns=at(5)))


def show(browser: Browser, page: str, folder: Path) -> str:
    """Open the page as a file; all its text."""
    (folder / "evidence.html").write_text(page, encoding="utf-8")
    browser.requests.clear()
    browser.said.clear()
    browser.open((folder / "evidence.html").as_uri())
    browser.until("document.getElementById('verdict').className !== ''")
    return str(browser.run("document.body.innerText"))


def verdict(browser: Browser) -> str:
    return str(browser.run("document.getElementById('verdict').className"))


def test_it_checks_itself_and_shows_the_record_and_what_it_proves(browser: Browser, one: Evidence, tmp_path: Path):
    said = show(browser, one.page(), tmp_path)
    found = verify(one, ROOTS, lambda line: None)
    assert verdict(browser) == "good"
    for line in found.proves():
        assert line in said
    assert "What it does not prove" in said and "there are no other records" in said
    assert grouped(found.authorities[0]) in said and found.contract in said and found.genesis in said
    assert all(f"0x{each.place.transaction.hex()}" in said for each in found.records)
    assert "2026-11-22T10:06:45.000Z" in said and "pose.pose.position.x" in said
    assert str(found.records[0].content.data["pose"]["pose"]["position"]["x"]) in said
    assert "✗" not in said and browser.said == []
    assert browser.requests == [(tmp_path / "evidence.html").as_uri()]


def test_the_trajectory_is_drawn(browser: Browser, recorded: Recorded, tmp_path: Path):
    said = show(browser, recorded.evidence(Choice("/robot_1/odom", from_ns=at(0))).page(), tmp_path)
    assert "/robot_1/odom: 143 positions" in said
    points = browser.run("document.querySelector('svg .track').getAttribute('points')").split()
    assert len(points) == 143
    xs = [float(point.split(",")[0]) for point in points]
    assert 40 < min(xs) < max(xs) < 680
    assert browser.run("document.querySelectorAll('.record').length") == 143


def test_nothing_of_the_log_acts_on_the_page(browser: Browser, recorded: Recorded, tmp_path: Path):
    evidence = recorded.evidence(Choice("/evil"))
    assert EVIL.encode() not in evidence.page().encode()
    said = show(browser, evidence.page(), tmp_path)
    assert verdict(browser) == "good" and browser.run("document.title") == "Evidence of 1 record of robot_1"
    assert EVIL.replace("\u202e", "\\u202e") in said and "\u202e" not in said
    assert "4611686018427387904" in said
    assert browser.run("document.querySelectorAll('img').length") == 0


def test_of_a_record_of_very_many_fields_the_page_shows_the_first(browser: Browser, tmp_path: Path):
    with start() as node:
        made = Recorded(Ledger.deploy(node.url, KEYS.operator)[0])
        made.write(made.pen.write(message(at(1), "/many", **{f"f{n}": n for n in range(4_000)})))
        said = show(browser, made.evidence(Choice("/many")).page(), tmp_path)
    assert verdict(browser) == "good" and "more fields; the file has all" in said and "\nf4\n" in said
    assert browser.run("document.querySelectorAll('.record dt').length") < 600


def test_its_policy_lets_it_connect_to_nobody_and_run_no_other_script(browser: Browser, one: Evidence, tmp_path: Path):
    show(browser, one.page().replace("</main>", "<script>document.title = 'owned'</script></main>"), tmp_path)
    assert browser.run("document.title") != "owned"
    assert browser.run("fetch('http://127.0.0.1:1/').then(() => 'sent', (error) => String(error))") != "sent"
    refused = " ".join(browser.said)
    assert "Content Security Policy" in refused and "connect-src" in refused


ALTERED: dict[str, Callable[[dict[str, Any]], Any]] = {
    "record": lambda e: e["records"][0].update(line=e["records"][0]["line"].replace('"z":0.0', '"z":9.0')),
    "salt": lambda e: e["records"][0].update(salt="00" * 16),
    "path": lambda e: e["records"][0]["path"].reverse(),
    "place of the record": lambda e: e["records"][0].update(record=11),
    "robot": lambda e: e.update(robot="robot_2"),
    "contract": lambda e: e.update(contract="11" * 20),
    "chain": lambda e: e.update(chain_id=1),
    "CA": lambda e: e.update(authorities=[create_ca("CA", at=ROOTS[0].not_before).certificate.to_der().hex()]),
    "certificate": lambda e: e["certificates"].__setitem__(0, e["certificates"][0][:-8] + "12345678"),
    "chunk": lambda e: e["chunks"][0].update(encoded=e["chunks"][0]["encoded"][:-8] + "12345678"),
    "hash of the chunk": lambda e: e["chunks"][0].update(hashes=[]),
    "the robot's Tk": lambda e: e.update(tk="00" * 32),
    "transaction": lambda e: e["chunks"][0].update(transaction="00"),
}


@pytest.mark.parametrize("what", ALTERED)
def test_an_altered_file_is_shown_to_fail_and_nothing_of_it_is_shown(
    what: str, browser: Browser, one: Evidence, tmp_path: Path
):
    value = json.loads(one.encode())
    ALTERED[what](value)
    text = json.dumps(value, separators=(",", ":"))
    assert text != one.encode()
    with pytest.raises(VerificationError):
        verify(Evidence.read(text.encode()), ROOTS, lambda line: None)
    said = show(browser, one.page().replace(one.encode(), text), tmp_path)
    assert verdict(browser) == "bad" and "This file does not hold" in said
    assert "✗" in browser.run("getComputedStyle(document.querySelector('#checks .bad'), '::before').content")
    assert "pose.pose.position" not in said and "What this proves" not in said


@pytest.mark.parametrize("what", ["root", "signature"])
def test_what_is_altered_within_a_chunk_is_shown_to_fail(what: str, browser: Browser, one: Evidence, tmp_path: Path):
    """With the hash of the batch made anew, as somebody would who can invent a batch."""
    [written] = one.chunks
    header = Chunk.parse(written.encoded).header
    old = {"root": header.root, "signature": written.encoded[len(header.encoded) :][:64]}[what]
    encoded = written.encoded.replace(old, b"\x11" * len(old))
    hashes = [keccak(encoded) if hash_ == keccak(written.encoded) else hash_ for hash_ in written.hashes]
    other = written.model_copy(update={"encoded": encoded, "hashes": hashes})
    show(browser, one.model_copy(update={"chunks": [other]}).page(), tmp_path)
    assert encoded != written.encoded and verdict(browser) == "bad"


def choose(browser: Browser, input_: str, file: Path) -> None:
    document = browser.ask("DOM.getDocument")["root"]["nodeId"]
    node = browser.ask("DOM.querySelector", nodeId=document, selector=f"#{input_}")["nodeId"]
    browser.ask("DOM.setFileInputFiles", nodeId=node, files=[str(file)])


def test_the_ca_that_one_has_is_compared(browser: Browser, one: Evidence, tmp_path: Path):
    show(browser, one.page(), tmp_path)
    other = create_ca("Another", at=ROOTS[0].not_before).certificate
    for number, (name, pem, expected) in enumerate((
        ("bad", other.to_pem(), "ANOTHER CA"), ("good", ROOTS[0].to_pem(), "It is the CA of this"),
        ("bad", b"nothing", "holds no certificate"), ("good", ROOTS[0].to_pem() + b"\n", "It is the CA of this"),
        ("bad", ROOTS[0].to_pem().replace(b"\nMII", b"\n!!!!!MII"), "holds no certificate"),
    )):  # fmt: skip
        (tmp_path / f"{number}.pem").write_bytes(pem)
        choose(browser, "ca", tmp_path / f"{number}.pem")
        browser.until(f"document.getElementById('compared').textContent.includes({expected!r})")
        assert browser.run("document.getElementById('compared').className") == name
    assert grouped(sm3.digest(other.to_der()).hex()) not in browser.run("document.body.innerText")


def test_a_page_that_one_has_checks_other_files(browser: Browser, one: Evidence, recorded: Recorded, tmp_path: Path):
    show(browser, one.page(), tmp_path)
    other = recorded.evidence(Choice("/evil"))
    for number, (content, expected) in enumerate((
        (other.page(), "Evidence of 1 record of robot_1"), (other.encode(), "Evidence of 1 record of robot_1"),
        (other.encode()[:-1], "Evidence that does not hold"), (one.encode(), "Evidence of 1 record of robot_1"),
    )):  # fmt: skip
        (tmp_path / f"{number}").write_text(content, encoding="utf-8")
        browser.run("document.title = ''")
        choose(browser, "other", tmp_path / f"{number}")
        browser.until(f"document.title === {expected!r}")
    assert "pose.pose.position.x" in browser.run("document.body.innerText")


@pytest.mark.parametrize(("width", "dark"), [(1100, False), (1100, True), (320, False)])
def test_it_can_be_read_in_the_dark_and_on_a_narrow_screen(
    width: int, dark: bool, browser: Browser, recorded: Recorded, tmp_path: Path
):
    browser.looks(width, 900, dark=dark)
    show(browser, recorded.evidence(Choice(None, from_ns=at(13.8))).page(), tmp_path)
    assert browser.run("document.documentElement.scrollWidth") <= width
    back = browser.run("getComputedStyle(document.body).backgroundColor")
    assert (back == "rgb(255, 255, 255)") != dark
    if "PICTURES" in os.environ:
        browser.picture(Path(os.environ["PICTURES"]) / f"evidence-{width}-{'dark' if dark else 'light'}.png")
    browser.looks()
