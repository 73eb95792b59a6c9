"""`doctor` finds what was broken on purpose and names the fix; on what works it is quiet. It changes nothing."""

from __future__ import annotations

import json
import os
import shutil
import socket
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from bridge.chunks import chain as chunk_chain
from bridge.disks import fill_up, small_disk
from bridge.operations.conftest import NODE_SECRETS, PASSPHRASE, Place
from bridge.redis_server import DURABLE, RedisServer
from rosbridge_eth import identity as ids
from rosbridge_eth.cli import run
from rosbridge_eth.config import Address
from rosbridge_eth.config.home import RobotHome
from rosbridge_eth.errors import ExitCode
from rosbridge_eth.identity import load_ca
from rosbridge_eth.ledger import Keyring, Ledger
from rosbridge_eth.ledger.nodes import EmbeddedChain
from rosbridge_eth.log import store
from rosbridge_eth.log.chunk import robot_id
from rosbridge_eth.operator import doctor as checks
from rosbridge_eth.operator import enrolment as admin
from rosbridge_eth.operator.registry import Registry
from rosbridge_eth.server import metrics

Capture = pytest.CaptureFixture[str]
Patch = pytest.MonkeyPatch
Findings = list[dict[str, Any]]


def doctor(capsys: Capture, *arguments: str) -> tuple[int, Findings]:
    code = run(["doctor", "--json", *arguments])
    report = json.loads(capsys.readouterr().out)
    findings: Findings = report["findings"]
    assert report["broken"] == sum(f["result"] == "broken" for f in findings)
    assert (code == 0) == (report["broken"] == 0)
    assert all(f["fix"] for f in findings if f["result"] in ("note", "skipped")), findings
    return code, findings


def of(findings: Findings, what: str) -> dict[str, Any]:
    return next(finding for finding in findings if finding["what"] == what)


def broken(findings: Findings) -> list[str]:
    return [finding["what"] for finding in findings if finding["result"] == "broken"]


def files(folder: Path) -> dict[str, bytes]:
    return {str(path): path.read_bytes() for path in sorted(folder.rglob("*")) if path.is_file()
            and not path.name.endswith(("-wal", "-shm"))}


@pytest.fixture(autouse=True)
def _impatient(monkeypatch: Patch) -> None:
    """A handshake that comes about takes a tenth of a second here."""
    monkeypatch.setattr(checks, "HANDSHAKE_TIME", 2.0)
    monkeypatch.setattr(checks, "ATTEMPT_TIME", 0.9)


@pytest.fixture
def on_chain(place: Place, monkeypatch: Patch) -> None:
    """The node of the home answers."""
    connect = Ledger.connect
    monkeypatch.setattr(Ledger, "connect", lambda where, at, **more: connect(place.chain, at, **more))


def test_what_ends_several_checks_is_told_once(place: Place, capsys: Capture):
    config = place.robot.config.read_text()
    place.robot.config.write_text('topcs = ["/odom"]\n')
    code, findings = doctor(capsys, "--home", "robot")
    assert ["topcs" in finding["found"] for finding in findings].count(True) == 1
    place.robot.config.write_text(config)
    place.robot.bridge_file.unlink()
    (place.robot.identity / "ca.crt.pem").unlink()  # the bundle brings it
    code, findings = doctor(capsys, "--home", "robot")
    assert code == ExitCode.FAILED and broken(findings) == ["configuration"]


def test_a_robot_that_can_reach_its_server_is_sound(place: Place, server: Address, capsys: Capture):
    code, findings = doctor(capsys, "--home", "robot", "--passphrase-file", "word")
    assert code == 0, findings
    assert of(findings, "server")["found"] == f"{server} made a session"
    assert of(findings, "password")["result"] == of(findings, "readers")["result"] == "ok"


def test_without_the_password_the_session_is_not_tried_and_that_is_no_failure(place: Place, capsys: Capture):
    code, findings = doctor(capsys, "--home", "robot")
    assert code in (0, ExitCode.FAILED) and "server" not in broken(findings)
    assert of(findings, "server")["result"] == "skipped"


def test_a_revoked_robot_learns_that_it_is_refused_rather_than_unheard(
    place: Place, server: Address, capsys: Capture
):
    with Registry(place.operator.registry) as registry:
        registry.revoke("robot", "robot_1", datetime.now(UTC))
    code, findings = doctor(capsys, "--home", "robot", "--passphrase-file", "word")
    assert code == ExitCode.FAILED
    assert "in force" in of(findings, "server")["fix"] and "register --replace" in of(findings, "server")["fix"]
    assert "no answer" not in of(findings, "server")["found"]


def test_a_mode_that_the_server_does_not_take_is_among_what_to_look_at(place: Place, server: Address, capsys: Capture):
    place.robot.config.write_text('channel = "transport"\n' + place.robot.config.read_text())
    code, findings = doctor(capsys, "--home", "robot", "--passphrase-file", "word")
    assert code == ExitCode.FAILED
    assert 'channel = "transport"' in of(findings, "server")["fix"]


def test_a_server_that_is_not_there_is_told_with_what_to_look_at(place: Place, capsys: Capture):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as deaf:
        deaf.bind(("127.0.0.1", 0))
        port = deaf.getsockname()[1]
        place.robot.config.write_text(f'topics = ["/robot_1/odom"]\nserver = "127.0.0.1:{port}"\n')
        code, findings = doctor(capsys, "--home", "robot", "--passphrase-file", "word")
    assert code == ExitCode.FAILED
    assert str(port) in of(findings, "server")["fix"] and "firewall" in of(findings, "server")["fix"]


ODOM = 'topics = ["/robot_1/odom"]\n'


@pytest.mark.parametrize("home, break_it, what, fix", [
    ("robot", lambda p: (p / "robot/robot.toml").write_text("topics = []"), "configuration", ""),
    ("robot", lambda p: (p / "robot/identity/sign.key.pem").chmod(0o644), "key files", "chmod 600"),
    ("robot", lambda p: shutil.rmtree(p / "robot/readers"), "readers", "join again"),
    ("robot", lambda p: (p / "robot/spool.sqlite").write_bytes(b"no database" * 999), "server", ""),
    ("robot", lambda p: (p / "word").write_bytes(b"another"), "server", ""),
    ("robot", lambda p: (p / "robot").chmod(0o777), "home", "chmod 700"),
    ("robot", lambda p: (p / "robot/bridge.json").write_text("{"), "configuration", "join again"),
    ("robot", lambda p: (p / "robot/bridge.json").unlink(), "configuration", "register"),
    ("robot", lambda p: (p / "robot/identity/ca.crt.pem").unlink(), "readers", "ca.crt.pem"),
    ("operator", lambda p: (p / "operator/server/ca.crt.pem").unlink()
        or (p / "operator/server/ca.crt.pem").mkdir(), "server's certificates", "ca.crt.pem"),
    ("operator", lambda p: (p / "operator/server/enc.key.pem").chmod(0o640), "key files", "chmod 600"),
    ("operator", lambda p: (p / "operator/accounts.json").chmod(0o604), "key files", "chmod 600"),
    ("operator", lambda p: (p / "operator/server.toml").write_text("listen = 1"), "configuration", ""),
    ("operator", lambda p: (p / "operator/registry.sqlite").write_bytes(b"no database" * 999), "server", "backup"),
    ("operator", lambda p: (p / "pass").write_bytes(b"another"), "passphrase", ""),
    ("operator", lambda p: (p / "operator/store-0.sqlite").write_bytes(b"no database" * 999), "store", ""),
    ("reader", lambda p: (p / "readers").write_bytes(b"another"), "keys", ""),
    ("reader", lambda p: (p / "reader/reader.toml").write_text("x = 1"), "node", ""),
])
def test_what_is_broken_is_found_and_nothing_is_changed(
    place: Place, capsys: Capture, monkeypatch: Patch, home: str, break_it: Any, what: str, fix: str
):
    for name in [name for name in os.environ if name.startswith("ROS_")]:
        monkeypatch.delenv(name)
    monkeypatch.setattr(checks, "HANDSHAKE_TIME", 0.2)
    break_it(place.path)
    before = files(place.path / home)
    secret = {"robot": "word", "operator": "pass", "reader": "readers"}[home]
    code, findings = doctor(capsys, "--home", home, "--passphrase-file", secret)
    assert code == ExitCode.FAILED
    found = [f for f in findings if f["what"] == what and f["result"] == "broken"]
    assert found, findings
    assert fix in found[0]["fix"] + found[0]["found"]
    assert files(place.path / home) == before


@pytest.mark.parametrize("home, secret", [("operator", "pass"), ("reader", "readers")])
def test_a_node_that_does_not_answer_is_named_without_the_keys_of_its_url(
    place: Place, capsys: Capture, home: str, secret: str
):
    code, findings = doctor(capsys, "--home", home, "--passphrase-file", secret)
    assert code == ExitCode.FAILED
    assert broken(findings) == ["node"]
    assert "127.0.0.1:9" in of(findings, "node")["found"]
    assert not any(secret in json.dumps(findings) for secret in NODE_SECRETS)


def test_an_operators_home_whose_parts_work_is_sound(place: Place, on_chain: None, capsys: Capture):
    code, findings = doctor(capsys, "--passphrase-file", "pass")
    assert code == 0, findings
    for what in (
        "configuration", "certificates", "passphrase", "server", "registry", "store", "node", "treasury",
    ):  # fmt: skip
        assert of(findings, what)["result"] == "ok"


# Ports


@contextmanager
def runs(home: Path, name: str, **conditions: bool) -> Iterator[None]:
    """What a process of this home leaves while it runs."""
    metrics.FIGURES.clear()
    metrics.show(("condition", {"process": name, "name": condition}, holds) for condition, holds in conditions.items())
    file = metrics.file_of(home, name)
    metrics.save(file)
    yield
    file.unlink()


def test_the_servers_own_port_is_told_from_a_strangers(place: Place, server: Address, capsys: Capture):
    place.configure("127.0.0.1:0", str(server))
    _, findings = doctor(capsys)
    assert "Address already in use; stop the program that has it" in of(findings, "server")["found"]
    with runs(place.operator.path, "shard-0", store=True):
        assert of(doctor(capsys)[1], "server") == {
            "what": "server", "result": "ok", "found": "runs, and is ready", "fix": "",
        }
    with runs(place.operator.path, "shard-0", store=True, node=False):
        _, findings = doctor(capsys)
    assert of(findings, "not ready")["result"] == "broken"
    assert "shard-0: node" in of(findings, "not ready")["found"]


def test_each_shard_has_its_ports_tried(place: Place, capsys: Capture):
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as probe:
        probe.bind(("127.0.0.1", 0))
        port = probe.getsockname()[1]
        place.configure("127.0.0.1:0", f"127.0.0.1:{port - 1}")
        place.configure("\n[chain]", "shards = 2\n[chain]")
        _, findings = doctor(capsys)
    assert f"UDP port {port}" in of(findings, "server")["found"]


def test_an_address_that_no_interface_here_has_is_not_said_to_be_in_use(place: Place, capsys: Capture):
    place.configure("127.0.0.1:0", "192.0.2.9:7410")
    _, findings = doctor(capsys)
    assert of(findings, "server")["result"] == "broken"
    assert "no interface here has that address" in of(findings, "server")["found"]


@pytest.mark.parametrize("home", ["operator", "robot"])
def test_a_taken_monitor_port_is_broken(place: Place, home: str, capsys: Capture):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))
        taken.listen()
        monitor = f'monitor = "127.0.0.1:{taken.getsockname()[1]}"\n'
        place.configure("\n[chain]", f"{monitor}[chain]")
        place.robot.config.write_text(monitor + ODOM)
        code, findings = doctor(capsys, "--home", home)
    assert code == ExitCode.FAILED
    assert "correct `monitor`" in of(findings, "server")["found"]
    _, findings = doctor(capsys, "--home", home)
    assert any("its ports are free" in finding["found"] for finding in findings)


# Disk and clock


def test_a_full_disk_is_broken(place: Place, tmp_path: Path, capsys: Capture):
    with small_disk(tmp_path / "disk", "4m") as disk:
        home = shutil.copytree(place.operator.path, disk / "operator")
        ballast = fill_up(disk)
        code, findings = doctor(capsys, "--home", str(home))
        assert code == ExitCode.FAILED
        assert "disk" in broken(findings) and "make room" in of(findings, "disk")["fix"]
        ballast.unlink()
        assert "disk" in broken(doctor(capsys, "--home", str(home))[1]), "4 MiB are not enough either"


@pytest.mark.parametrize("free, result", [(0, "broken"), (63 << 20, "broken"), (65 << 20, "ok")])
@pytest.mark.parametrize("inodes", [5, 0])
def test_how_much_room_is_enough(monkeypatch: Patch, tmp_path: Path, free: int, result: str, inodes: int):
    found = os.statvfs(tmp_path)
    fake = os.statvfs_result((4096, 4096, 0, 0, free // 4096, 1000, inodes, inodes, 0, 255))
    assert type(found) is type(fake)
    monkeypatch.setattr(os, "statvfs", lambda path: fake)
    [finding] = checks.disk(RobotHome(tmp_path), None)
    assert finding.result == (result if inodes else "broken")


@pytest.mark.parametrize("off, result", [
    (-86_400, "broken"), (86_400, "broken"), (7_200, None), (60, None), (-60, None),
])
def test_a_clock_is_held_against_the_last_block(
    place: Place, on_chain: None, monkeypatch: Patch, capsys: Capture, off: float, result: str | None
):
    head = place.ledger.block().time
    monkeypatch.setattr(checks.time, "time", lambda: head + off)
    _, findings = doctor(capsys)
    clocks = [f for f in findings if f["what"] == "clock" and "block" in f["found"]]
    assert [f["result"] for f in clocks] == ([result] if result else [])
    assert all("set" in f["fix"] for f in clocks)


@pytest.mark.parametrize("off, says", [(-86_400, "behind"), (86_400, "ahead of")])
def test_a_robots_clock_is_held_against_the_servers(
    place: Place, server: Address, monkeypatch: Patch, capsys: Capture, off: float, says: str
):
    wrong = SimpleNamespace(time=lambda: time.time() + off, monotonic=time.monotonic)
    monkeypatch.setattr(checks, "time", wrong)
    code, findings = doctor(capsys, "--home", "robot", "--passphrase-file", "word")
    assert code == ExitCode.FAILED
    [finding] = [f for f in findings if f["what"] == "clock" and "server's" in f["found"]]
    assert finding["result"] == "broken" and f"24h {says}" in finding["found"]


# Addresses, certificates, registrations


def test_an_address_that_is_none_is_found_at_both_ends(place: Place, capsys: Capture):
    place.configure('public = "127.0.0.1:9"', "")
    place.configure("127.0.0.1:0", "0.0.0.0:0")
    _, findings = doctor(capsys)
    assert any("public =" in f["found"] + f["fix"] for f in findings if f["result"] == "broken")
    end = place.robot.bridge()
    place.robot.save_bridge(replace(end, servers=["0.0.0.0:7410"]))
    _, findings = doctor(capsys, "--home", "robot")
    assert of(findings, "bridge")["result"] == "broken" and "robot.toml" in of(findings, "bridge")["fix"]
    place.robot.config.write_text(f'server = "192.0.2.1:7410"\n{ODOM}')
    _, findings = doctor(capsys, "--home", "robot")
    assert of(findings, "bridge")["result"] == "ok"


@pytest.mark.parametrize("home, fix", [("operator", "renew"), ("robot", "register robot_1 REQUEST --replace"),
                                        ("reader", "reader NAME --replace")])
@pytest.mark.parametrize("left, result", [(0, "broken"), (20, "note")])
def test_a_certificate_that_ended_or_ends_soon_has_its_fix(
    place: Place, home: str, fix: str, left: int, result: str, capsys: Capture, monkeypatch: Patch
):
    role = {"operator": ids.Role.SERVER, "robot": ids.Role.ROBOT, "reader": ids.Role.READER}[home]
    folder = {"operator": "operator/server", "robot": "robot/identity", "reader": "reader"}[home]
    ca = load_ca(place.operator.ca, PASSPHRASE, datetime.now(UTC))
    monkeypatch.setattr(ids, "_LIFE", timedelta(days=left))
    old = ids.enrol(ca, role, "robot_1", at=datetime.now(UTC) - timedelta(seconds=5))
    for name in ("sign.crt.pem", "enc.crt.pem"):
        Path(folder, name).write_bytes(ids.identity_files(old, [ca.certificate], b"x")[name])
    _, findings = doctor(capsys, "--home", home)
    found = [f for f in findings if f["what"] == "certificates" and f["result"] == result]
    assert len(found) == 2 and all(fix in f["fix"] for f in found)


def test_a_registration_that_the_contract_does_not_have_is_found(
    place: Place, on_chain: None, keys: Keyring, capsys: Capture
):
    place.ledger.revoke_robot(keys.operator, robot_id("robot_1"))
    _, findings = doctor(capsys)
    assert "register robot_1 REQUEST --replace" in of(findings, "robot_1")["found"]


def test_a_contract_of_another_operator_and_an_empty_treasury_are_found(place: Place, capsys: Capture, monkeypatch):
    connect, other = Ledger.connect, Keyring.create()
    monkeypatch.setattr(Ledger, "connect", lambda where, at, **more: connect(place.chain, at, **more))
    accounts = json.loads(place.operator.accounts.read_bytes())
    accounts["operator"] = other.operator.address
    place.operator.accounts.write_text(json.dumps(accounts))
    _, findings = doctor(capsys)
    assert {"operator", "treasury"} <= set(broken(findings))
    assert other.operator.address in of(findings, "treasury")["found"]


def test_another_chain_with_the_same_id_has_its_fix(place: Place, keys: Keyring, monkeypatch, capsys: Capture):
    connect, chain = Ledger.connect, EmbeddedChain({keys.operator.address: 10**20})
    monkeypatch.setattr(Ledger, "connect", lambda where, at, **more: connect(chain, at, **more))
    code, findings = doctor(capsys, "--passphrase-file", "pass")
    assert code == ExitCode.FAILED
    assert broken(findings) == ["node"] and "is another chain" in json.dumps(findings)


# The store


def test_what_waits_is_told(place: Place, capsys: Capture):
    inbox, tk = place.inbox(), robot_id("robot_1")
    inbox.append([store.Offer(tk, chunk) for chunk in chunk_chain(3)], time.time())
    inbox.close()
    _, findings = doctor(capsys)
    assert of(findings, "store")["found"] == "3 chunks wait"


@pytest.mark.service
def test_a_redis_that_may_lose_chunks_or_gives_too_few_rights_is_broken(place: Place, tmp_path: Path, capsys: Capture):
    (tmp_path / "redis").mkdir()
    redis = RedisServer(tmp_path / "redis", *DURABLE)
    try:
        place.configure("\n[chain]", f'\n[store]\nurl = "{redis.url}"\n[chain]')
        _, findings = doctor(capsys)
        assert of(findings, "store")["found"] == "0 chunks wait"
        with redis.client() as client:
            assert client.keys() == [], "doctor makes nothing"
            client.acl_setuser("default", enabled=True, nopass=True, keys=["*"], commands=["+@all", "-hset"])
            assert "+hset" in json.dumps(of(doctor(capsys)[1], "store")), "rights are tried before there is a store"
            client.acl_setuser("default", enabled=True, nopass=True, keys=["*"], commands=["+@all"])
            place.inbox().close()
            assert of(doctor(capsys)[1], "store")["result"] == "ok"
            client.config_set("appendfsync", "everysec")
            _, findings = doctor(capsys)
            assert "CONFIG SET appendfsync always" in json.dumps(of(findings, "store"))
            client.config_set("appendfsync", "always")
            client.acl_setuser("default", enabled=True, nopass=True, keys=["*"], commands=["+@all", "-zadd"])
            _, findings = doctor(capsys)
            assert of(findings, "store")["result"] == "broken" and "+zadd" in json.dumps(of(findings, "store"))
    finally:
        redis.kill()


def test_a_redis_that_is_away_is_told_without_its_password(place: Place, capsys: Capture):
    place.configure("\n[chain]", '\n[store]\nurl = "redis://user:redis-secret@127.0.0.1:9/0"\n[chain]')
    _, findings = doctor(capsys)
    assert of(findings, "store")["result"] == "broken" and "redis-secret" not in json.dumps(findings)


# Homes, and what a person sees


def test_what_is_no_home_and_one_of_another_edition_are_refused(place: Place, capsys: Capture):
    Path("empty").mkdir()
    Path("old").mkdir()
    Path("old/home.json").write_text('{"format": "rosbridge-eth home 2", "kind": "operator"}')
    for command in ("doctor", "status"):
        assert run([command, "--home", "empty"]) == ExitCode.CONFIG
        assert "not a home" in capsys.readouterr().err
        assert run([command, "--home", "old"]) == ExitCode.CONFIG
        assert "another version" in capsys.readouterr().err


def test_a_person_sees_a_table_and_every_fix(place: Place, capsys: Capture):
    assert run(["doctor"]) == ExitCode.FAILED
    shown = capsys.readouterr()
    assert "BROKEN" in shown.out and "127.0.0.1:9" in shown.err and "Traceback" not in shown.err
    assert "not tried: passphrase" in shown.err
    assert not any(secret in shown.out + shown.err for secret in NODE_SECRETS)


def test_a_renewed_server_is_sound_again(place: Place, on_chain: None, capsys: Capture):
    ca = load_ca(place.operator.ca, PASSPHRASE, datetime.now(UTC))
    admin.renew_server(place.operator, ca=ca, passphrase=PASSPHRASE, now=datetime.now(UTC))
    code, findings = doctor(capsys, "--passphrase-file", "pass")
    assert code == 0, findings
