"""What a script can act on: the table of docs/operations.md, each of its rows brought about."""

from __future__ import annotations

import json
import re
import subprocess
import sys
import time
from collections.abc import Callable, Sequence
from pathlib import Path

import pytest

from bridge.chunks import chain as chunk_chain
from bridge.operations.conftest import PASSWORD, Place
from rosbridge_eth.capture import Capture, TopicRule
from rosbridge_eth.cli import run
from rosbridge_eth.identity import load_identity
from rosbridge_eth.ledger import Keyring, Ledger
from rosbridge_eth.ledger.nodes import EmbeddedChain
from rosbridge_eth.log import chunk
from rosbridge_eth.log.chunk import Log, robot_id
from rosbridge_eth.log.store import NOWHERE, Offer
from rosbridge_eth.robot.sources import BagSource, Selection, sample_bag
from smcrypto import sm2

PAGE = Path(__file__).resolve().parents[3] / "docs" / "operations.md"
TABLE = PAGE.read_text(encoding="utf-8").partition("### Exit codes")[2].partition("###")[0]
FOUND = re.findall(r"^- `([a-z]+)` (\d+): (.+)$", TABLE, re.MULTILINE)
ROWS = [(command, told, code) for command, code, told in FOUND]
TK, STREAM = robot_id("robot_1"), b"s" * 16
OPERATOR, READER = ("--passphrase-file", "pass"), ("--passphrase-file", "readers")
REVOKE = ("revoke", "robot_1", "--compromised", *OPERATOR)
COMPARE = ("compare", str(sample_bag()), "robot_1", "--topic", "/robot_1/odom", *READER)
EVIDENCE = ("evidence", "robot_1", "evidence.json", *READER)
VECTOR = PAGE.parents[1] / "tests" / "vectors" / "evidence"
VERIFY = ("verify", str(VECTOR / "span.json"), "--ca", str(VECTOR / "ca.crt.pem"))
GRANT = ("grant", "robot_1", "--from", "2026-01-01T00:00:00Z", "--to", "2100-01-01T00:00:00Z",
         "--reader", "reader/public.pem", *READER)  # fmt: skip
Given = Callable[[Place, Keyring], object]


def as_it_is(place: Place, keys: Keyring) -> None:
    """A home, a robot that wrote nothing yet, a node that answers."""


def waiting(place: Place, keys: Keyring) -> None:
    inbox = place.inbox()
    inbox.append([Offer(TK, one) for one in chunk_chain(1)], time.time())
    inbox.close()


def dead(place: Place, keys: Keyring) -> None:
    waiting(place, keys)
    inbox = place.inbox()
    inbox.remove(TK, [row.place for row in inbox.rows(TK, NOWHERE, 9)], "given up")
    inbox.close()


STREAM_LINE = b'{"stream":{"source":"sim","software":"a test"}}'


def written(
    place: Place, keys: Keyring, reader: sm2.PublicKey | None = None, lines: Sequence[bytes] = (STREAM_LINE,)
) -> None:
    """One chunk of the robot on the chain, for this reader or for one of whom nobody knows."""
    who, _ = load_identity(place.robot.identity, PASSWORD)
    [standing] = place.ledger.standings([TK])
    account = next(keys.account(number) for number in range(1, 9) if keys.account(number).address == standing.account)
    log = Log(place.operator.deployment().ledger, TK)
    made = chunk.seal(
        log, who.signing_key, lines, stream=STREAM, number=0,
        previous=bytes(32), sealed_ms=time.time_ns() // 10**6, goodbye=False, compress=True,
        readers=[reader or sm2.PrivateKey.generate().public_key],
    )  # fmt: skip
    place.ledger.set_data(account, TK, [made.encoded])


def replayed(place: Place, keys: Keyring, without: int | None = None) -> None:
    """The sample bag on the chain, but for one message."""
    capture, source = Capture([TopicRule("**")], source_kind="bag"), BagSource(sample_bag(), Selection(["**/odom"]))
    found = [one for raw in source.messages() if (one := capture.process(raw, raw.received_ns))]
    source.close()
    lines = [found[0].definition[1], *(one.line for n, one in enumerate(found) if n != without)]
    owner, _ = load_identity(place.path / "reader", b"the reader's own words")
    written(place, keys, owner.encryption_key.public_key, [STREAM_LINE, *lines])


def forged(place: Place, keys: Keyring) -> None:
    """A chunk in the robot's place, of which nobody can say who signed it."""
    [standing] = place.ledger.standings([TK])
    account = next(keys.account(number) for number in range(1, 9) if keys.account(number).address == standing.account)
    place.ledger.set_data(account, TK, [next(iter(chunk_chain(1))).encoded])


def altered_grant(place: Place, keys: Keyring) -> None:
    replayed(place, keys)
    place.path.joinpath("reader", "grants").mkdir()
    assert run([*GRANT, "--out", "reader/grants/g"]) == 0
    file = place.path / "reader" / "grants" / "g"
    file.write_bytes(file.read_bytes().replace(b"robot_1", b"robot_2"))


def triggered(place: Place, keys: Keyring) -> None:
    """A process that shows a trigger, as a robot does, and takes one event."""
    program = """
import sys, time
from pathlib import Path
from rosbridge_eth.server import metrics
from rosbridge_eth.config.home import RobotHome
place = RobotHome(Path("robot"))
metrics.show([("trigger_fired", {"robot": "robot_1", "trigger": "crash"}, 0)])
metrics.save(metrics.file_of(place.path, "robot"))
print("up", flush=True)
while not place.event("crash").exists():
    time.sleep(0.02)
place.event("crash").unlink()
"""
    running = subprocess.Popen([sys.executable, "-c", program], cwd=place.path, stdout=subprocess.PIPE)
    assert running.stdout is not None and running.stdout.readline() == b"up\n"


CASES: list[tuple[str, tuple[str, ...], Given]] = [
    ("done", REVOKE, as_it_is),
    ("the node is away", REVOKE, as_it_is),
    ("it was revoked already", REVOKE, lambda place, keys: run(REVOKE)),
    ("the name is used", ("register", "robot_1", "robot/request.json", *OPERATOR), as_it_is),
    ("no robot of that name was ever enrolled", ("status", "robot_9"), as_it_is),
    ("what is there is sound", ("read", "robot_1", *READER), as_it_is),
    ("what is there is not what", ("read", "robot_1", *READER), forged),
    ("it is sound, and every record is sealed for others", ("read", "robot_1", *READER), written),
    ("no robot of that name is in the contract", ("read", "robot_9", *READER), as_it_is),
    ("a file in `grants/` is altered", ("read", "robot_1", *READER), altered_grant),
    ("the file is written", GRANT, replayed),
    ("this reader can open nothing", GRANT, as_it_is),
    ("the running robot has taken it", ("trigger", "crash"), triggered),
    ("no robot runs with that home", ("trigger", "crash"), as_it_is),
    ("every message of the bag is on the chain", COMPARE, replayed),
    ("one is missing", COMPARE, lambda place, keys: replayed(place, keys, without=7)),
    ("there is no such bag", ("compare", "none.bag", "robot_1", *READER), replayed),
    ("no record was chosen", (*EVIDENCE, "--topic", "/other"), replayed),
    ("all of it holds", VERIFY, as_it_is),
    ("something does not hold", ("verify", "robot/request.json", *VERIFY[2:]), as_it_is),
    ("shown", ("status",), as_it_is),
    ("the node is on another chain", ("status",), as_it_is),
    ("something is broken", ("doctor",), lambda place, keys: place.path.joinpath("operator").chmod(0o777)),
    ("a contract is deployed already", ("deploy", *OPERATOR), as_it_is),
    ("the folder is a home already", ("backup", "robot"), as_it_is),
]


def test_every_row_is_brought_about_here():
    assert len(ROWS) == len(CASES)
    assert [command for command, _, _ in ROWS] == [arguments[0] for _, arguments, _ in CASES]
    assert all(told.startswith(case) for (_, told, _), (case, _, _) in zip(ROWS, CASES, strict=True))


@pytest.mark.parametrize("row, case", [*zip(ROWS, CASES, strict=True)], ids=[f"{row[0]} {row[2]}" for row in ROWS])
def test_the_exit_code_is_the_one_of_the_table(
    row: tuple[str, str, str], case: tuple[str, tuple[str, ...], Given], place: Place, keys: Keyring,
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str],
):  # fmt: skip
    (_, _, code), (what, arguments, given) = row, case
    connect = Ledger.connect
    node = place.chain
    if "another chain" in what:
        node = EmbeddedChain({keys.operator.address: 10**20})
    if "away" not in what:  # else the home's URL is tried, where nobody is
        monkeypatch.setattr(Ledger, "connect", lambda where, at, **more: connect(node, at, **more))
    given(place, keys)
    assert run(arguments) == int(code), capsys.readouterr().err


def test_compare_says_what_is_missing_and_how_much_is_equal(
    place: Place, keys: Keyring, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
):
    connect = Ledger.connect
    monkeypatch.setattr(Ledger, "connect", lambda where, at, **more: connect(place.chain, at, **more))
    replayed(place, keys, without=7)
    assert run([*COMPARE, "--json"]) == 9
    said = capsys.readouterr()
    assert "the chain has no record of this message" in said.err
    told = json.loads(said.out)
    assert (told["sound"], told["equal"], told["wrong"], told["absent"]) == (True, 299, 1, [])
    assert run([*COMPARE, "--some"]) == 0
    assert run(["compare", *COMPARE[1:3], *READER]) == 9, "without --topic, too"


def test_one_record_that_opens_is_enough(place: Place, keys: Keyring, monkeypatch: pytest.MonkeyPatch):
    connect = Ledger.connect
    monkeypatch.setattr(Ledger, "connect", lambda where, at, **more: connect(place.chain, at, **more))
    owner, _ = load_identity(place.path / "reader", b"the reader's own words")
    written(place, keys, owner.encryption_key.public_key)
    assert run(["read", "robot_1", *READER]) == 0
