"""`grant` as it is typed, and what the person reads who was given one."""

from __future__ import annotations

import json
import shutil
from datetime import UTC, datetime

import pytest

from bridge.operations.conftest import PASSPHRASE, READERS, Place
from bridge.operations.test_exit_codes import READER, STREAM_LINE, replayed, written
from rosbridge_eth.cli import run
from rosbridge_eth.config.home import ReaderHome
from rosbridge_eth.config.values import time_text
from rosbridge_eth.identity import load_ca, load_identity
from rosbridge_eth.ledger import Keyring, Ledger
from rosbridge_eth.operator import enrolment as admin

SPAN = ("--from", "2026-11-01T00:00:00Z", "--to", "2027-01-01T00:00:00Z")
INSURER = ("read", "robot_1", "--home", "insurer", *READER)


@pytest.fixture(autouse=True)
def insurer(place: Place, monkeypatch: pytest.MonkeyPatch) -> ReaderHome:
    """A reader of the same operator, for whom the robot does not seal."""
    connect = Ledger.connect
    monkeypatch.setattr(Ledger, "connect", lambda where, at, **more: connect(place.chain, at, **more))
    now = datetime.now(UTC)
    ca = load_ca(place.operator.ca, PASSPHRASE, now)
    home = ReaderHome(place.path / "insurer")
    admin.add_reader(place.operator, "insurer", home, ca=ca, passphrase=READERS, now=now)
    return home


def message(when: datetime, x: int) -> bytes:
    ns = round(when.timestamp()) * 10**9
    return json.dumps({"topic": "/odom", "type": "a/msg/A", "source": "sim", "received_ns": ns, "captured_ns": ns,
                       "clock": True, "data": {"x": x}}, separators=(",", ":")).encode()  # fmt: skip


def test_a_span_is_handed_to_somebody_who_was_no_reader(
    place: Place, keys: Keyring, insurer: ReaderHome, capsys: pytest.CaptureFixture[str]
):
    owner, _ = load_identity(place.path / "reader", READERS)
    when = datetime(2026, 11, 20, tzinfo=UTC)
    written(place, keys, owner.encryption_key.public_key, [STREAM_LINE, message(when, 1), message(when, 2)])
    assert run(INSURER) == 4
    assert "nothing of robot_1 is sealed for this reader" in capsys.readouterr().err
    (place.path / "reader" / "readers").mkdir()
    shutil.copy(insurer.public, place.path / "reader" / "readers" / "insurer.pem")
    assert run(["grant", "robot_1", *SPAN, "--reader", "insurer", *READER]) == 0
    said = capsys.readouterr().err
    assert "robot_1-insurer.grant opens 1 chunk of robot_1 for reader insurer, and for nobody else" in said
    assert run(["grant", "robot_1", *SPAN, "--reader", str(insurer.public), *READER]) == 3, "it is there already"
    insurer.grants.mkdir()
    shutil.move("robot_1-insurer.grant", insurer.grants)
    assert run(INSURER) == 0
    said = capsys.readouterr()
    assert [json.loads(line)["data"]["x"] for line in said.out.splitlines()] == [1, 2]
    assert "robot_1: sound" in said.err
    assert run(["read", "robot_1", *READER]) == 0
    capsys.readouterr()
    end = time_text(int(when.timestamp() + 1) * 10**9)
    assert run(["grant", "robot_1", "--from", end, "--to", "2027-01-01T00:00:00Z", "--reader", "insurer", *READER]) == 3
    assert "can open nothing of robot_1 that was received in that time" in capsys.readouterr().err


def test_a_grant_that_is_no_good_ends_a_reading_with_a_sentence(
    place: Place, keys: Keyring, insurer: ReaderHome, capsys: pytest.CaptureFixture[str]
):
    replayed(place, keys)
    out = place.path / "mine.grant"
    assert run(["grant", "robot_1", *SPAN, "--reader", str(insurer.public), "--out", str(out), *READER]) == 0
    insurer.grants.mkdir()
    file = insurer.grants / "g"
    file.write_bytes(out.read_bytes().replace(b'"begin": "2026-11', b'"begin": "2025-11'))
    assert run(INSURER) == 9
    assert "the grant insurer/grants/g cannot be used: it is not as reader owner signed it" in capsys.readouterr().err
    owners = ReaderHome(place.path / "reader").grants
    owners.mkdir()
    shutil.copy(out, owners)
    assert run(["read", "robot_1", *READER]) == 4
    assert "it is for reader insurer, whose keys are not here; remove it" in capsys.readouterr().err


@pytest.mark.parametrize("arguments, code", [
    ([*SPAN[:2], "--reader", "insurer/public.pem"], 2),
    ([*SPAN[2:], *SPAN[:2], "--reader", "nobody"], 3),
    (["--from", SPAN[3], "--to", SPAN[1], "--reader", "insurer/public.pem"], 2),
    ([*SPAN, "--reader", "robot/identity/ca.crt.pem"], 4),
    ([*SPAN, "--reader", "robot.pem"], 4),
])  # fmt: skip
def test_a_span_and_a_reader_of_the_same_ca_are_wanted(place: Place, arguments: list[str], code: int):
    who, _ = load_identity(place.robot.identity, b"the robot's own words")
    (place.path / "robot.pem").write_bytes(who.pem)
    assert run(["grant", "robot_1", *arguments, *READER]) == code
