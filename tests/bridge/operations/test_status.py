"""`status` shows what is there, names robots, and says what it cannot know; it makes nothing."""

from __future__ import annotations

import io
import json
import os
import re
import time
from collections.abc import Callable
from contextlib import closing
from datetime import UTC, datetime
from pathlib import Path
from typing import Any

import pytest

from bridge.chunks import chain as chunk_chain
from bridge.chunks import dropped
from bridge.operations.conftest import NODE_SECRETS, PASSPHRASE, PASSWORD, Place
from bridge.redis_server import RedisServer
from rosbridge_eth.cli import run
from rosbridge_eth.config import load_robot_config, load_server_config
from rosbridge_eth.config.home import RobotHome
from rosbridge_eth.errors import BridgeError, ExitCode
from rosbridge_eth.identity import load_ca
from rosbridge_eth.ledger import Keyring, Ledger
from rosbridge_eth.ledger.nodes import EmbeddedChain
from rosbridge_eth.log.chunk import robot_id
from rosbridge_eth.log.hop import FORKED
from rosbridge_eth.log.store import NOWHERE, Offer
from rosbridge_eth.operator import doctor
from rosbridge_eth.operator import enrolment as admin
from rosbridge_eth.operator import status as module
from rosbridge_eth.operator.bundle import ask_to_join
from rosbridge_eth.operator.registry import Registry
from rosbridge_eth.operator.status import span
from rosbridge_eth.robot.loop import open_robot
from rosbridge_eth.server import metrics
from rosbridge_eth.server.shard import open_submitter

TK = robot_id("robot_1")
STREAM = b"s" * 16
Capture = pytest.CaptureFixture[str]
Patch = pytest.MonkeyPatch


def status(capsys: Capture, *arguments: str, code: int = 0) -> dict[str, Any]:
    assert run(["status", "--json", *arguments]) == code
    report: dict[str, Any] = json.loads(capsys.readouterr().out)
    return report | {kind: [": ".join(pair) for pair in report[kind]] for kind in ("alarms", "unknown")}


@pytest.fixture
def on_chain(place: Place, monkeypatch: Patch) -> None:
    """The node of the home answers."""
    connect = Ledger.connect
    monkeypatch.setattr(Ledger, "connect", lambda where, at, **more: connect(place.chain, at, **more))


@pytest.fixture
def write(place: Place, keys: Keyring) -> Callable[..., None]:
    """Have the chain take these chunks of robot_1, one batch."""
    account = next(keys.account(n) for n in range(1, 9)
                   if keys.account(n).address == place.ledger.standings([TK])[0].account)  # fmt: skip
    return lambda *chunks: place.ledger.set_data(account, TK, [chunk.encoded for chunk in chunks]) and None


# An operator's home


def test_with_node_and_server_away_the_rest_is_shown_and_what_is_not_known_is_said(place: Place, capsys: Capture):
    inbox = place.inbox()
    inbox.append([Offer(TK, chunk) for chunk in chunk_chain(3, records=7)], time.time() - 60)
    inbox.close()
    before = sorted(place.path.rglob("*"))
    report = status(capsys)
    assert [each["name"] for each in report["names"]] == ["server", "owner", "robot_1"]
    robot = report["robots"]["robot_1"]
    assert robot["waiting"]["chunks"] == 3 and robot["waiting"]["records"] == 21
    assert 60 <= robot["waiting"]["oldest"] < 90
    assert "chunks" not in robot and "connected" not in robot
    assert report["node"] is None and report["operator"]["eth"] is None
    said = " ".join(report["unknown"])
    assert "127.0.0.1:9" in said and "server: it does not run here" in said
    assert run(["status"]) == 0
    shown = capsys.readouterr()
    assert "robot_1" in shown.out and "not known" in shown.out and "127.0.0.1:9" in shown.err
    assert TK.hex()[:8] not in shown.out, "robots are named"
    assert not any(secret in shown.out + shown.err + json.dumps(report) for secret in NODE_SECRETS)
    assert [path for path in sorted(place.path.rglob("*")) if path.suffix != ".sqlite-shm"] == [
        path for path in before if path.suffix != ".sqlite-shm"], "nothing is made"  # fmt: skip


def test_a_revoked_robot_is_no_alarm_unless_some_of_its_chunks_wait(
    place: Place, on_chain: None, keys: Keyring, capsys: Capture
):
    with Registry(place.operator.registry) as registry, closing(place.inbox()) as inbox:
        submitter = open_submitter(load_server_config(place.operator.config), place.ledger, inbox, registry, keys)
        registry.revoke("robot", "robot_1", datetime.now(UTC))
        place.ledger.revoke_robot(keys.operator, TK)

        def alarms(now: float) -> tuple[list[str], float]:
            submitter.turn(now)
            metrics.show(metrics.of_submitter("shard-0", submitter, registry.robots(), place.operator.path, now))
            return status(capsys)["alarms"], metrics.FIGURES["on_hold", (("robot", "robot_1"),)]

        now = time.time()
        assert alarms(now) == ([], 0)
        assert "robot_1" not in {finding.what for finding in doctor.operations(place.operator, None)}
        inbox.append([Offer(TK, chunk) for chunk in chunk_chain(1)], now)
        assert alarms(now + 1) == (["robot_1: it is on hold: it is revoked"], 1)


def test_accounts_are_on_lines_of_their_own_at_any_width(place: Place, monkeypatch: Patch, capsys: Capture):
    monkeypatch.setenv("COLUMNS", "40")
    assert run(["status"]) == 0
    lines = capsys.readouterr().out.splitlines()
    with Registry(place.operator.registry) as registry:
        robot = registry.robots()[TK]
    assert f"{robot.account}  robot_1" in lines and f"{place.operator.account}  operator" in lines


def test_without_a_store_or_a_contract_it_is_no_trouble(place: Place, capsys: Capture):
    report = status(capsys)
    assert not place.operator.store(0).exists() and not any("store" in line for line in report["unknown"])
    place.operator.deployment_file.unlink()
    report = status(capsys)
    assert report["contract"] is None and any("deploy" in line for line in report["unknown"])


def test_with_the_node_it_shows_what_the_chain_has(
    place: Place, on_chain: None, write: Callable[..., None], capsys: Capture
):
    write(*chunk_chain(3))
    report = status(capsys)
    robot = report["robots"]["robot_1"]
    assert robot["chunks"] == 3 and 0 < robot["eth"] < 1 and robot["revoked_on_chain"] is False
    assert report["node"]["block"] == place.ledger.block_number()
    assert report["operator"]["eth"] == place.ledger.balance(place.operator.account) / 10**18
    assert run(["status"]) == 0
    assert f"{robot['eth']:.4f}" in capsys.readouterr().out


def test_a_treasury_that_cannot_top_up_is_an_alarm(
    place: Place, on_chain: None, monkeypatch: Patch, capsys: Capture
):
    monkeypatch.setattr(Ledger, "balance", lambda ledger, account: 10**17)
    [alarm] = status(capsys)["alarms"]
    assert alarm == f"treasury: {place.operator.account} has 0.1000 ETH, and a top-up takes 0.5: send ETH to it"


def register_again(place: Place, keys: Keyring) -> None:
    second = RobotHome(place.path / "second")
    admin.register_robot(
        place.operator, "robot_1", ca=load_ca(place.operator.ca, PASSPHRASE, datetime.now(UTC)), keys=keys,
        ledger=place.ledger, inbox=place.inbox, now=datetime.now(UTC), pause=lambda seconds: None, replace=True,
        request=ask_to_join(second, "robot_1", PASSWORD),
    )  # fmt: skip


def test_a_robot_that_was_revoked_after_the_registrys_backup_is_told_and_not_in_force(
    place: Place, on_chain: None, keys: Keyring, capsys: Capture
):
    assert status(capsys)["alarms"] == []
    place.ledger.revoke_robot(keys.operator, TK)
    report = status(capsys)
    assert report["robots"]["robot_1"]["in_force"] is False
    [alarm] = report["alarms"]
    assert "robot_1: it was revoked on the chain" in alarm and "run `revoke robot_1`" in alarm
    assert run(["revoke", "robot_1", "--passphrase-file", "pass"]) == ExitCode.OK
    capsys.readouterr()
    assert status(capsys)["alarms"] == []


def test_a_robot_that_was_replaced_after_the_registrys_backup_is_told(
    place: Place, on_chain: None, keys: Keyring, capsys: Capture
):
    old = place.operator.registry.read_bytes()
    register_again(place, keys)
    assert status(capsys)["alarms"] == []
    place.operator.registry.write_bytes(old)
    [alarm] = status(capsys)["alarms"]
    assert "certificates that this registry does not know" in alarm and "restore a newer registry.sqlite" in alarm


def test_a_node_that_is_behind_a_registration_is_told_as_such(
    place: Place, on_chain: None, keys: Keyring, capsys: Capture
):
    before = place.chain.ethereum_tester.take_snapshot()
    register_again(place, keys)
    place.chain.ethereum_tester.revert_to_snapshot(before)
    [alarm] = status(capsys)["alarms"]
    assert alarm == "robot_1: the node does not have its registration yet: wait until the node has caught up"


def test_no_address_is_broken_at_80_columns(place: Place, monkeypatch: Patch, capsys: Capture):
    monkeypatch.setenv("COLUMNS", "80")
    source = "[2001:db8:1234:5678:9abc:def0:1234:5678]:54321"
    metrics.show([("session_seen_seconds", {"robot": "robot_1", "address": source}, time.time())])
    metrics.save(metrics.file_of(place.operator.path, "shard-0"))
    assert run(["status"]) == 0
    shown = capsys.readouterr().out
    contract = place.operator.deployment().contract
    for address in (source, contract, place.operator.account):
        assert address in shown
    assert run(["status", "--home", "robot"]) == 0
    assert contract in capsys.readouterr().out


def test_what_is_on_hold_or_dead_is_told_with_the_reason(place: Place, capsys: Capture):
    inbox = place.inbox()
    inbox.append([Offer(TK, chunk) for chunk in chunk_chain(4)], time.time())
    inbox.append([Offer(robot_id("stranger"), chunk) for chunk in chunk_chain(2)], time.time())
    inbox.set_state(TK, hold="the contract refuses")
    inbox.remove(TK, [row.place for row in inbox.rows(TK, NOWHERE, 9)[1:]], "given up")
    inbox.close()
    report = status(capsys)
    assert report["robots"]["robot_1"]["hold"] == "the contract refuses"
    assert report["dead"] == [{"robot": "robot_1", "why": "given up", "chunks": 3}]
    assert report["robots"][robot_id("stranger").hex()]["waiting"]["chunks"] == 2
    assert run(["status"]) == 0
    shown = capsys.readouterr().out
    assert "robot_1: it is on hold: the contract refuses" in shown
    assert "robot_1: dead letters, 3 chunks: given up" in shown
    assert report["alarms"] == ["robot_1: it is on hold: the contract refuses"]


def test_a_revoked_robot_is_shown_as_such(place: Place, capsys: Capture):
    with Registry(place.operator.registry) as registry:
        registry.revoke("robot", "robot_1", datetime.now(UTC))
    assert status(capsys)["robots"]["robot_1"]["in_force"] is False
    assert run(["status"]) == 0
    assert "revoked" in capsys.readouterr().out


def test_the_node_on_another_chain_is_told_by_the_exit_code_and_the_rest_is_shown(
    place: Place, keys: Keyring, monkeypatch: Patch, capsys: Capture
):
    connect, chain = Ledger.connect, EmbeddedChain({keys.operator.address: 10**20})
    monkeypatch.setattr(Ledger, "connect", lambda where, at, **more: connect(chain, at, **more))
    report = status(capsys, code=ExitCode.CHAIN)
    assert "another chain" in report["wrong_chain"] and "chunks" not in report["robots"]["robot_1"]
    assert run(["status"]) == ExitCode.CHAIN
    shown = capsys.readouterr()
    assert "robot_1" in shown.out and "another chain" in shown.err


@pytest.mark.service
def test_a_redis_is_looked_at_and_left_as_it_is_and_its_absence_is_told(place: Place, tmp_path: Path, capsys: Capture):
    (tmp_path / "redis").mkdir()
    redis = RedisServer(tmp_path / "redis")
    try:
        url = redis.url.replace("//", "//default:redis-secret@")
        place.configure("\n[chain]", f'\n[store]\nurl = "{url}"\n[chain]')
        with redis.client() as client:
            client.config_set("requirepass", "redis-secret")
            client.auth("redis-secret")
            assert "waiting" not in status(capsys)["robots"]["robot_1"]
            assert client.keys() == []
            inbox = place.inbox()
            inbox.append([Offer(TK, chunk) for chunk in chunk_chain(2)], time.time())
            inbox.close()
            before = {key: client.dump(key) for key in client.scan_iter()}
            assert status(capsys)["robots"]["robot_1"]["waiting"]["chunks"] == 2
            assert {key: client.dump(key) for key in client.scan_iter()} == before
    finally:
        redis.kill()
    report = status(capsys)
    assert any("Redis" in line for line in report["unknown"]) and "redis-secret" not in json.dumps(report)


# Who is connected


def test_who_is_connected_and_what_comes_from_them_is_what_the_running_shards_show(place: Place, capsys: Capture):
    now = time.time()
    files = [metrics.file_of(place.operator.path, f"shard-{shard}") for shard in range(2)]
    metrics.show([("beat_seconds", {"process": "shard-0"}, now)])
    metrics.show([("session_seen_seconds", {"robot": "robot_1", "address": "192.0.2.1"}, now - 3600)])
    metrics.show([("session_seen_seconds", {"robot": "robot_1", "address": "192.0.2.2"}, now)])
    metrics.show([("session_seen_seconds", {"robot": "robot_2", "address": "192.0.2.3"}, now)])
    metrics.show([("records_per_second", {"process": "shard-0", "robot": "robot_1"}, 12.5)])
    metrics.show([("newest_chunk_seconds", {"process": "shard-0", "robot": "robot_1"}, now - 30)])
    metrics.show([("gas", {"robot": "robot_1"}, 123_000)])
    metrics.save(files[0])
    files[1].touch()
    report = status(capsys)
    robot = report["robots"]["robot_1"]
    assert (robot["connected"], robot["address"]) == (True, "192.0.2.2") and "robot_2" not in report["robots"]
    assert (robot["rate"], robot["gas"]) == (12.5, 123_000) and 30 <= robot["newest"] < 60
    assert report["process"] == []
    metrics.show([("session_seen_seconds", {"robot": "robot_1", "address": "192.0.2.2"}, now - 3000)])
    metrics.show([("condition", {"process": "shard-0", "name": "node answers"}, 0)])
    metrics.save(files[0])
    report = status(capsys)
    assert report["robots"]["robot_1"]["connected"] is False
    assert report["process"] == ["shard-0: node answers"] and "node answers" in report["alarms"][0]
    assert run(["status"]) == 0
    shown = capsys.readouterr().out
    assert "NOT READY: shard-0: node answers" in shown and "12.5" in shown and "ALARM: " in shown


def test_a_shard_or_a_server_that_was_killed_is_not_ready(place: Place, capsys: Capture):
    files = [metrics.file_of(place.operator.path, f"shard-{shard}") for shard in range(2)]
    metrics.show([("beat_seconds", {"process": "shard-0"}, time.time())])
    metrics.show([("records_per_second", {"process": "shard-0", "robot": "robot_1"}, 12.5)])
    for killed in range(2):
        for each in files:
            metrics.save(each)
        for each in files[1 - killed:]:
            os.utime(each, (time.time() - 60, time.time() - 60))
        report = status(capsys)
        dead = [f"{each.stem[1:]} runs" for each in files[1 - killed:]]
        assert report["process"] == dead and report["alarms"][0] == f"not ready: {dead[0]}: no"
        assert ("rate" in report["robots"]["robot_1"]) is (killed == 0), "what a killed one left is not true any more"
        assert run(["status"]) == 0
        assert f"NOT READY: {', '.join(dead)}" in capsys.readouterr().out
    for file in files:
        file.unlink()
    assert status(capsys)["process"] is None, "it was ended in good order"


def test_a_running_server_is_shown_at_its_terminal_by_its_own_figures(place: Place):
    from rich.console import Console

    screen = Console(width=100, record=True, file=io.StringIO())
    metrics.show([("beat_seconds", {"process": "shard-0"}, time.time())])
    metrics.show([("session_seen_seconds", {"robot": "robot_1", "address": "192.0.2.2"}, time.time())])
    metrics.show([("waiting_chunks", {"robot": "robot_1"}, 7)])
    metrics.show([("waiting_seconds", {"robot": "robot_1"}, 300)])
    metrics.show([("chain_chunks", {"robot": "robot_1"}, 41)])
    metrics.show([("chain_block", {"robot": "robot_1"}, 99)])
    metrics.show([("on_hold", {"robot": "robot_1"}, 1)])
    metrics.save(metrics.file_of(place.operator.path, "shard-0"))
    screen.print(module.fleet(place.operator))
    shown = screen.export_text()
    assert re.search(r"robot_1 +yes .* 7 \(5m\) .* 41 ", shown), shown
    assert "robot_1: it is on hold" in shown and "has waited 5m" in shown


@pytest.mark.parametrize("name", ["robot_1", "r" * 63])
def test_no_word_or_figure_is_broken_at_eighty_columns(name: str):
    from rich.console import Console

    robot = {
        "in_force": False, "newest": 108_000, "rate": 12_345.6, "waiting": {"chunks": 1234, "oldest": 4000},
        "chunks": 1_234_567, "gas": 123_456.7e6, "eth": 1234.5678,
    }  # fmt: skip
    screen = Console(width=80, record=True, file=io.StringIO())
    screen.print(module._robots({"robots": {name: robot}}))
    shown = screen.export_text()
    assert re.search("robot +session +newest +rec/s +waiting +on chain +Mgas +ETH", shown), shown
    assert re.search(r" revoked +30h +12345.6 +1234 \(67m\) +1234567 +123456.7 +1234.5678 ", shown), shown
    assert max(map(len, shown.split("\n"))) <= 80


def test_what_a_robot_left_in_the_store_of_another_shard_is_not_counted(place: Place, capsys: Capture):
    tk = int.from_bytes(TK, "big")
    place.configure('"127.0.0.1:0"', '"127.0.0.1:7410"')
    inbox = place.inbox()
    inbox.append([Offer(TK, chunk) for chunk in chunk_chain(3)], time.time())
    inbox.close()
    assert status(capsys)["robots"]["robot_1"]["waiting"]["chunks"] == 3
    shards = next(number for number in range(2, 64) if tk % number)
    place.configure("\n[chain]", f"shards = {shards}\n[chain]")
    report = status(capsys)
    assert "waiting" not in report["robots"]["robot_1"] and report["unknown"] == status(capsys)["unknown"]


# A robot's home


def test_a_robots_home_shows_its_spool_and_whether_it_runs(place: Place, capsys: Capture):
    place.robot.config.write_text('topics = ["/robot_1/odom"]\nserver = "192.0.2.1:7410"\n[source]\nkind = "sim"\n')
    assert status(capsys, "--home", "robot")["spool"] is None
    assert not place.robot.spool.exists()
    robot = open_robot(place.robot, load_robot_config(place.robot.config), PASSWORD)
    try:
        for chunk in chunk_chain(3):
            robot.spool.append(chunk)
        report = status(capsys, "--home", "robot")
        assert (report["kind"], report["robot"], report["runs"], report["spool"]) == ("robot", "robot_1", True, None)
        assert any("shows no figures" in line for line in report["unknown"])
        assert not any("does not run" in line for line in report["unknown"]), "it does, or something that has its spool"
    finally:
        robot.spool.close()
        robot.loop.close()
    report = status(capsys, "--home", "robot")
    assert report["runs"] is False and report["spool"]["chunks"] == report["spool"]["unstored"] == 3
    assert run(["status", "--home", "robot"]) == 0
    shown = capsys.readouterr().out
    assert "/robot_1/odom" in shown and "192.0.2.1:7410" in shown and "3 chunks" in shown


def test_a_running_robot_shows_its_figures(place: Place, capsys: Capture):
    place.robot.config.write_text('topics = ["/robot_1/odom"]\n[source]\nkind = "sim"\n')
    robot = open_robot(place.robot, load_robot_config(place.robot.config), PASSWORD)
    try:
        metrics.show(metrics.of_robot("robot_1", robot, time.time()))
        metrics.save(metrics.file_of(place.robot.path, "robot"))
        report = status(capsys, "--home", "robot")
        assert "robot: robot has a session" in report["process"]
        assert report["figures"]["captured"] == 0 and "spool_chunks not stored" in report["figures"]
    finally:
        robot.spool.close()
        robot.loop.close()


def test_a_log_that_goes_on_in_two_places_is_an_alarm_on_both_ends(place: Place, capsys: Capture):
    now, report = time.time(), status(capsys)
    metrics.show([("beat_seconds", {"process": "shard-0"}, now)])
    for age, told in ((700.0, False), (5.0, True)):
        metrics.show([("forked_seconds", {"robot": "robot_1"}, now - age)])
        metrics.save(metrics.file_of(place.operator.path, "shard-0"))
        report = status(capsys)
        assert (f"robot_1: {FORKED}" in report["alarms"]) == told
    place.robot.config.write_text('topics = ["/robot_1/odom"]\n[source]\nkind = "sim"\n')
    metrics.FIGURES.clear()
    robot = open_robot(place.robot, load_robot_config(place.robot.config), PASSWORD)
    try:
        for held in ("", FORKED):
            robot.sender.held = held
            metrics.show(metrics.of_robot("robot_1", robot, time.time()))
            metrics.save(metrics.file_of(place.robot.path, "robot"))
            assert (f"log: {FORKED}" in status(capsys, "--home", "robot")["alarms"]) == bool(held)
        assert run(["status", "--home", "robot"]) == 0
        assert FORKED in " ".join(capsys.readouterr().out.split())
    finally:
        robot.spool.close()
        robot.loop.close()


def test_a_robot_without_its_bundle_is_told_what_is_next(place: Place, capsys: Capture):
    place.robot.bridge_file.unlink()
    assert run(["status", "--home", "robot"]) == ExitCode.CONFIG
    assert "register" in capsys.readouterr().err


def test_of_a_reader_doctor_tells(place: Place, capsys: Capture):
    assert run(["status", "--home", "reader"]) == ExitCode.CONFIG
    assert "doctor --home reader" in capsys.readouterr().err


@pytest.mark.parametrize("seconds, says", [
    (None, ""), (0, "0s"), (1.4, "1s"), (119, "119s"), (125, "2m"), (7199, "120m"), (7201, "2h"), (86_400, "24h"),
    (200_000, "2d"),
])
def test_a_span_is_short(seconds: float | None, says: str):
    assert span(seconds) == says


# of one robot


def test_of_one_robot_it_is_said_how_far_its_log_is_written_and_confirmed(
    place: Place, on_chain: None, write: Callable[..., None], capsys: Capture
):
    def log() -> dict[str, Any]:
        assert run(["status", "robot_1", "--json"]) == 0
        report = json.loads(capsys.readouterr().out)
        assert list(report["robots"]) == ["robot_1"]
        return report["robots"]["robot_1"]["log"]

    assert log() == {"written": None, "confirmed": None}
    chunks = [*chunk_chain(6)]
    write(*chunks[:2])
    write(dropped(chunks[2]), chunks[3])
    block = place.ledger.block_number()
    first, second = (
        {"stream": STREAM.hex(), "number": number, "block": event.block, "transaction": "0x" + event.transaction.hex()}
        for number, event in zip((1, 3), place.ledger.data_events(TK, 0, block), strict=True)
    )
    assert log() == {"written": second, "confirmed": second}
    place.configure("\n[chain]", "\n[chain]\nconfirmations = 2")
    assert log() == {"written": second, "confirmed": first}
    assert run(["status", "robot_1"]) == 0
    said = capsys.readouterr().out
    assert f"robot_1: confirmed up to chunk 1 of stream {STREAM.hex()}, in block {block - 1}" in said
    for file in place.path.glob("operator/store-0.sqlite*"):
        file.unlink()
    assert log()["written"] == second, "the chain alone is enough"


def test_a_name_that_is_not_enrolled_is_told(place: Place, on_chain: None, capsys: Capture):
    assert run(["status", "robot_9"]) == ExitCode.IDENTITY
    assert "no robot 'robot_9' is enrolled; `status` lists" in capsys.readouterr().err
    assert run(["status", "robot_1", "--home", "robot"]) == ExitCode.CONFIG
    assert "home of one robot" in capsys.readouterr().err


def test_status_may_be_imported_by_itself():
    assert issubclass(module.ConfigError, BridgeError)
