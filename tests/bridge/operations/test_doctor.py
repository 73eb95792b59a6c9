"""`doctor` finds what was broken on purpose and names the mend; on what works it is quiet. It changes nothing."""

from __future__ import annotations

import json
import shutil
import socket
from collections.abc import Iterator
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest

from bridge.operations.conftest import PASSPHRASE, PASSWORD, Place
from rosbridge_eth import ledger
from rosbridge_eth.channel.udp import server_sockets
from rosbridge_eth.cli import run
from rosbridge_eth.config import Address, load_robot_config, load_server_config
from rosbridge_eth.errors import ExitCode
from rosbridge_eth.identity import Role, Trust, read_certificates
from rosbridge_eth.ledger.accounts import Keyring
from rosbridge_eth.ledger.embedded import EmbeddedChain
from rosbridge_eth.records import RecordId, SealedRecord, robot_id
from rosbridge_eth.registry import Registry
from rosbridge_eth.robot.assembly import open_robot
from rosbridge_eth.server.administration import load_server_identity, server_trust
from rosbridge_eth.server.assembly import open_inbox, open_journal, open_worker
from rosbridge_eth.store import Delivery
from rosbridge_eth.store.peek import SpoolPeek, peek_spool

Capture = pytest.CaptureFixture[str]


def doctor(capsys: Capture, *arguments: str) -> tuple[int, list[dict[str, Any]]]:
    code = run(["doctor", "--json", *arguments])
    report = json.loads(capsys.readouterr().out)
    findings: list[dict[str, Any]] = report["findings"]
    assert report["broken"] == sum(f["result"] == "broken" for f in findings)
    assert (code == 0) == (report["broken"] == 0)
    assert all(f["mend"] for f in findings if f["result"] != "ok")
    return code, findings


def of(findings: list[dict[str, Any]], what: str) -> dict[str, Any]:
    return next(finding for finding in findings if finding["what"] == what)


def files(folder: Path) -> dict[str, bytes]:
    return {str(path): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()
            and not path.name.endswith(("-wal", "-shm"))}


@pytest.fixture
def server(place: Place) -> Iterator[Address]:
    """A real worker at a real port, its loop in a thread; the robot's home knows the address."""
    import threading

    config, deployment = load_server_config(place.operator.config), place.operator.deployment()
    [sock] = server_sockets(config.listen)
    registry = Registry(place.operator.registry)
    worker = open_worker(
        0, sock, config=config, identity=load_server_identity(place.operator, PASSPHRASE),
        trust=server_trust(place.operator, registry), registry=registry, inbox=open_inbox(config, place.operator),
        journal=open_journal(place.operator, deployment), deployment=deployment,
    )
    stop = threading.Event()
    thread = threading.Thread(target=worker.run, args=(stop.is_set,))
    thread.start()
    address = Address(*sock.getsockname()[:2])
    place.robot.config.write_text(f'topics = ["/robot_1/odom"]\nserver = "{address}"\n[source]\nkind = "sim"\n')
    yield address
    stop.set()
    worker.loop.wake()
    thread.join(10)


def test_a_robot_that_can_reach_its_server_is_sound(place: Place, server: Address, capsys: Capture):
    code, findings = doctor(capsys, "--home", "robot", "--passphrase-file", "word")
    assert code == 0, findings
    assert of(findings, "server")["found"].startswith(f"{server} made a session in")
    assert of(findings, "password")["result"] == of(findings, "readers")["result"] == "ok"


def test_without_the_password_the_session_is_not_tried_and_that_is_no_failure(place: Place, capsys: Capture):
    code, findings = doctor(capsys, "--home", "robot")
    assert code == 0
    assert of(findings, "server")["result"] == of(findings, "password")["result"] == "skipped"


def test_a_revoked_robot_learns_that_it_is_refused_rather_than_unheard(
    place: Place, server: Address, capsys: Capture
):
    registry = Registry(place.operator.registry)
    registry.revoke("robot", "robot_1", datetime.now(UTC))
    registry.close()
    code, findings = doctor(capsys, "--home", "robot", "--passphrase-file", "word")
    assert code == ExitCode.FAILED
    assert "in force" in of(findings, "server")["mend"] and "register --replace" in of(findings, "server")["mend"]
    assert "allow list" in of(findings, "server")["found"] and "no answer" not in of(findings, "server")["found"]


def test_a_mode_that_the_server_does_not_take_is_among_what_to_look_at(
    place: Place, server: Address, capsys: Capture
):
    place.robot.config.write_text('channel = "transport"\n' + place.robot.config.read_text())
    code, findings = doctor(capsys, "--home", "robot", "--passphrase-file", "word")
    assert code == ExitCode.FAILED
    assert 'channel = "transport"' in of(findings, "server")["mend"]


def test_a_server_that_is_not_there_is_told_with_what_to_look_at(place: Place, capsys: Capture):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as deaf:
        deaf.bind(("127.0.0.1", 0))
        port = deaf.getsockname()[1]
        place.robot.config.write_text(f'topics = ["/robot_1/odom"]\nserver = "127.0.0.1:{port}"\n')
        code, findings = doctor(capsys, "--home", "robot", "--passphrase-file", "word")
    assert code == ExitCode.FAILED
    assert str(port) in of(findings, "server")["mend"] and "firewall" in of(findings, "server")["mend"]


@pytest.mark.parametrize("home, break_it, what, mend", [
    ("robot", lambda p: (p / "robot/robot.toml").write_text("topics = []"), "configuration", ""),
    ("robot", lambda p: (p / "robot/identity/sign.key.pem").chmod(0o644), "key files", "chmod 600"),
    ("robot", lambda p: shutil.rmtree(p / "robot/readers"), "readers", "join again"),
    ("robot", lambda p: (p / "robot/spool.sqlite").write_bytes(b"no database" * 999), "spool", ""),
    ("robot", lambda p: (p / "word").write_bytes(b"another"), "password", ""),
    ("robot", lambda p: (p / "robot").chmod(0o777), "home", "chmod 700"),
    ("robot", lambda p: (p / "robot/robot.toml").write_text(
        'topics = ["/x"]\n[source]\nkind = "bag"\npath = "absent.bag"'), "source", ""),
    ("operator", lambda p: (p / "operator/server/enc.key.pem").chmod(0o640), "key files", "chmod 600"),
    ("operator", lambda p: (p / "operator/server.toml").write_text("listen = 1"), "configuration", ""),
    ("operator", lambda p: (p / "operator/registry.sqlite").write_bytes(b"no database" * 999), "registry", "backup"),
    ("operator", lambda p: (p / "pass").write_bytes(b"another"), "passphrase", ""),
    ("operator", lambda p: (p / "operator/inbox.sqlite").write_bytes(b"no database" * 999), "store", ""),
])
def test_what_is_broken_is_found_and_nothing_is_changed(
    place: Place, capsys: Capture, home: str, break_it: Any, what: str, mend: str
):
    break_it(place.path)
    before = files(place.path / home)
    code, findings = doctor(capsys, "--home", home, "--passphrase-file", "word" if home == "robot" else "pass")
    assert code == ExitCode.FAILED
    found = [f for f in findings if f["what"] == what and f["result"] == "broken"]
    assert found, findings
    assert mend in found[0]["mend"]
    assert files(place.path / home) == before


def test_a_node_that_does_not_answer_is_named_without_the_keys_of_its_url(place: Place, capsys: Capture):
    code, findings = doctor(capsys, "--passphrase-file", "pass")
    assert code == ExitCode.FAILED
    assert [f["what"] for f in findings if f["result"] == "broken"] == ["node"]
    assert "127.0.0.1:9" in of(findings, "node")["found"]
    assert not any(secret in json.dumps(findings) for secret in ("node-key", "path-key", "query-key"))


def test_a_port_in_use_is_a_note_for_it_may_be_the_server_itself(place: Place, capsys: Capture):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as taken:
        taken.bind(("127.0.0.1", 0))
        text = place.operator.config.read_text()
        place.operator.config.write_text(text.replace("127.0.0.1:0", f"127.0.0.1:{taken.getsockname()[1]}"))
        _, findings = doctor(capsys)
    assert of(findings, "UDP port")["result"] == "note"


def test_what_is_nobodys_home_names_the_commands_that_make_one(place: Place, capsys: Capture):
    Path("empty").mkdir()
    for command in ("doctor", "status"):
        assert run([command, "--home", "empty"]) == ExitCode.CONFIG
        assert "join BUNDLE" in capsys.readouterr().err


def test_a_spool_is_looked_into_and_left_to_its_robot(place: Place):
    place.robot.config.write_text('topics = ["/robot_1/odom"]\n[source]\nkind = "sim"\n')
    robot = open_robot(place.robot, load_robot_config(place.robot.config), PASSWORD)
    try:
        records = [SealedRecord(RecordId(robot_id("robot_1"), bytes(16), seq), bytes(100 + seq)) for seq in range(3)]
        robot.spool.append(records, Delivery.RELIABLE, 0.0)
        assert peek_spool(place.robot.spool) == SpoolPeek(in_use=True)
    finally:
        robot.spool.close()
        robot.loop.close()
    assert peek_spool(place.robot.spool) == SpoolPeek(False, 3, 100 + 101 + 102)


def test_status_tells_a_robots_home_from_an_operators(place: Place, capsys: Capture):
    assert run(["status", "--home", "robot", "--json"]) == 0
    report = json.loads(capsys.readouterr().out)
    assert (report["kind"], report["robot"], report["runs"]) == ("robot", "robot_1", False)
    assert run(["status", "--robot-home", "robot"]) == 0
    assert "/robot_1/odom" in capsys.readouterr().out
    assert run(["status"]) == 0
    shown = capsys.readouterr()
    assert "not running" in shown.out and "127.0.0.1:9" in shown.err
    assert not any(secret in shown.out + shown.err for secret in ("node-key", "path-key", "query-key"))


def test_a_renewed_server_is_still_the_server_its_robots_know(place: Place, capsys: Capture):
    before = load_server_identity(place.operator, PASSPHRASE)
    assert run(["renew", "--passphrase-file", "pass"]) == 0
    after = load_server_identity(place.operator, PASSPHRASE)
    assert after.name == before.name
    assert after.signing_certificate.fingerprint() != before.signing_certificate.fingerprint()
    assert after.signing_key.public_key.to_bytes() != before.signing_key.public_key.to_bytes()
    roots = read_certificates((place.robot.identity / "ca.crt.pem").read_bytes())
    Trust(roots).check(
        after.signing_certificate.to_der(), after.encryption_certificate.to_der(), role=Role.SERVER, name="server",
        at=datetime.now(UTC),
    )
    registry = Registry(place.operator.registry)
    assert registry.allows("server", "server", after.signing_certificate.fingerprint())
    assert not registry.allows("server", "server", before.signing_certificate.fingerprint())
    assert [old.is_dir() for old in place.operator.path.glob("server.until-*")] == [True]
    assert run(["renew", "--passphrase-file", "word"]) == ExitCode.IDENTITY
    assert "Traceback" not in capsys.readouterr().err
    assert load_server_identity(place.operator, PASSPHRASE).name == "server", "a wrong passphrase changes nothing"


@pytest.fixture
def made_anew(place: Place, monkeypatch: pytest.MonkeyPatch) -> EmbeddedChain:
    """What a local chain is after it was started without its state: the same id, another first block."""
    chain = EmbeddedChain(fund={Keyring.load(place.operator.accounts, PASSPHRASE).operator.address: 10**20})
    assert chain.chain_id() == place.chain.chain_id()
    monkeypatch.setattr(ledger, "connect", lambda url, **more: chain)
    return chain


def test_status_says_that_the_node_is_on_another_chain_and_still_shows_the_rest(
    place: Place, made_anew: EmbeddedChain, capsys: Capture
):
    assert run(["status"]) == ExitCode.CHAIN
    shown = capsys.readouterr()
    assert "robot_1" in shown.out and "the node is on another chain" in shown.out
    assert "is another chain with the id" in shown.err and "make a new home" in shown.err
    assert run(["status", "--json"]) == ExitCode.CHAIN
    report = json.loads(capsys.readouterr().out)
    assert "another chain" in report["wrong_chain"]
    assert report["inbox"]["waiting"] == 0 and "balances" not in report and "block" not in report
    assert run(["status", "--home", "operator/readers/owner"]) == ExitCode.CHAIN
    assert place.operator.deployment().contract in capsys.readouterr().err


def test_on_the_right_chain_status_is_content(place: Place, monkeypatch: pytest.MonkeyPatch, capsys: Capture):
    monkeypatch.setattr(ledger, "connect", lambda url, **more: place.chain)
    for home in ("operator", "operator/readers/owner"):
        assert run(["status", "--home", home, "--json"]) == 0
        assert json.loads(capsys.readouterr().out)["block"] == place.chain.head().number


def test_doctor_has_a_mend_for_another_chain(place: Place, made_anew: EmbeddedChain, capsys: Capture):
    code, findings = doctor(capsys, "--passphrase-file", "pass")
    assert code == ExitCode.FAILED
    [found] = [f for f in findings if f["result"] == "broken"]
    assert "another chain" in found["found"] and "make a new home" in found["mend"]


def test_status_says_whose_batches_wait_and_why(place: Place, capsys: Capture):
    registry = Registry(place.operator.registry)
    registry.revoke("robot", "robot_1", datetime.now(UTC))
    registry.close()
    journal = open_journal(place.operator, place.operator.deployment())
    records = [SealedRecord(RecordId(robot_id(name), bytes(16), 0), bytes(100)) for name in ("robot_1", "stranger")]
    journal.seal([[record] for record in records], 0.0)
    journal.close()
    assert run(["status", "--json"]) == 0
    waiting = json.loads(capsys.readouterr().out)["waiting_batches"]
    assert {each["robot"]: (each["batches"], each["why"].partition(":")[0]) for each in waiting} == {
        "robot_1": (1, "revoked"), robot_id("stranger").hex(): (1, "not in the registry")}
    assert run(["status"]) == 0
    assert "of robot_1 wait" in capsys.readouterr().out


def test_status_says_whose_records_will_never_be_written_and_why(place: Place, capsys: Capture):
    deployment, config = place.operator.deployment(), load_server_config(place.operator.config)
    journal, inbox = open_journal(place.operator, deployment), open_inbox(config, place.operator)
    records = [SealedRecord(RecordId(robot_id("robot_1"), bytes(16), seq), bytes(100)) for seq in range(3)]
    journal.seal([records], 0.0)
    assert journal.give_up(robot_id("robot_1"), [], [], "given up", 0.0) == 3
    fourth = RecordId(robot_id("robot_1"), bytes(16), 3)
    inbox.append([SealedRecord(fourth, bytes(100)), SealedRecord(fourth, bytes(101))], 0.0)
    inbox.close()
    journal.close()
    assert run(["status", "--json"]) == 0
    dead = json.loads(capsys.readouterr().out)["dead"]
    assert {(each["robot"], each["records"]) for each in dead} == {("robot_1", 3), ("robot_1", 1)}
    assert {each["reason"] for each in dead if each["records"] == 3} == {"given up"}
    assert run(["status"]) == 0
    assert "3 (given up)" in capsys.readouterr().out
