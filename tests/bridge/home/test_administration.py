"""The operator's work on a home, an embedded chain and a store: who may write when, and what a crash leaves."""

from __future__ import annotations

import os
import shutil
import socket
import sqlite3
import subprocess
import sys
from contextlib import suppress
from dataclasses import replace
from datetime import UTC, datetime, timedelta
from functools import partial
from pathlib import Path

import pytest

from bridge.home.world import NOW, PASSPHRASE, READER_PASSPHRASE, TK, World
from rosbridge_eth import identity as ids
from rosbridge_eth.config import Address, load_reader_config
from rosbridge_eth.config.home import HomeKind, OperatorHome, ReaderHome, RobotHome, kind_of
from rosbridge_eth.errors import ChainError, ConfigError, IdentityError, StoreError
from rosbridge_eth.identity import Role, load_ca, load_identity, split_certificates
from rosbridge_eth.ledger import Keyring, Ledger
from rosbridge_eth.ledger.nodes import EmbeddedChain
from rosbridge_eth.ledger.transport import ChainUnavailable
from rosbridge_eth.log.opening import open_store
from rosbridge_eth.operator import enrolment as admin
from rosbridge_eth.operator.bundle import join, needs_password, read_bundle
from rosbridge_eth.operator.registry import Registry
from smcrypto import x509


@pytest.fixture
def world(tmp_path: Path) -> World:
    return World(tmp_path)


def registry(world: World) -> Registry:
    return Registry(world.home.registry)


# The home


def test_the_address_robots_are_given_is_a_machines_own() -> None:
    for host in ("0.0.0.0", "::"):
        found = admin.own_address(Address(host, 7410))
        assert found.host != host and found.port == 7410
        socket.getaddrinfo(*found)
    for given in (Address("192.0.2.7", 7410), Address("robots.example", 1)):
        assert admin.own_address(given) == given


def test_without_a_default_route_it_is_the_loopbacks(monkeypatch: pytest.MonkeyPatch) -> None:
    class NoRoute(socket.socket):
        def connect(self, address: object) -> None:
            raise OSError(101, "Network is unreachable")

    monkeypatch.setattr(socket, "socket", NoRoute)
    assert admin.own_address(Address("0.0.0.0", 7410)) == ("127.0.0.1", 7410)
    assert admin.own_address(Address("::", 7410)) == ("::1", 7410)


@pytest.mark.parametrize("change", [
    {"listen": "nowhere"}, {"public": "0.0.0.0"}, {"chain_url": "ws://node"},
    {"chain_url": 'http://x"\nshards = 3\n#'},
])
def test_what_cannot_be_a_configuration_is_refused_before_anything_is_made(
    change: dict[str, str], tmp_path: Path
) -> None:
    with pytest.raises((ConfigError, IdentityError)):
        admin.init_home(
            OperatorHome(tmp_path / "home"), PASSPHRASE, reader=ReaderHome(tmp_path / "reader"),
            reader_passphrase=READER_PASSPHRASE, now=NOW, **change,  # type: ignore[arg-type]
        )
    assert not list(tmp_path.iterdir())


def test_a_home_is_complete_or_none(world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    world.home.require()
    for path in (world.home.path, world.reader.path):
        assert path.stat().st_mode & 0o777 == 0o700
        with pytest.raises(ConfigError, match="home already"):
            admin.init_home(OperatorHome(path), PASSPHRASE, reader=ReaderHome(tmp_path / "r"),
                            reader_passphrase=READER_PASSPHRASE, now=NOW)
    monkeypatch.setattr(Keyring, "save", lambda *_: 1 / 0)
    half = OperatorHome(tmp_path / "half")
    with pytest.raises(ZeroDivisionError):
        admin.init_home(half, PASSPHRASE, reader=ReaderHome(tmp_path / "r"), reader_passphrase=b"r", now=NOW)
    with pytest.raises(ConfigError):
        half.require()
    monkeypatch.undo()
    with pytest.raises(ConfigError, match="cannot be the reader's home as well"):
        admin.init_home(half, PASSPHRASE, reader=ReaderHome(half.path), reader_passphrase=b"r", now=NOW)
    admin.init_home(half, PASSPHRASE, reader=ReaderHome(tmp_path / "r"), reader_passphrase=b"r", now=NOW)
    assert half.require() and ReaderHome(tmp_path / "r").require()


def test_the_seed_of_a_mnemonic_is_taken(tmp_path: Path) -> None:
    words = Keyring.create().mnemonic
    home = OperatorHome(tmp_path / "home")
    made = admin.init_home(
        home, PASSPHRASE, reader=ReaderHome(tmp_path / "r"), reader_passphrase=READER_PASSPHRASE, now=NOW,
        keys=Keyring.from_mnemonic(words),
    )
    assert Keyring.load(home.accounts, PASSPHRASE).mnemonic == words == made.mnemonic


def existing_ca(folder: Path, password: bytes) -> x509.Certificate:
    """One of docs/fleet-ca.md."""
    (folder.parent / "ca.pass").write_bytes(password)
    subprocess.run(
        [sys.executable, "-m", "smcrypto", "ca", "init", "--dir", folder, "--subject", "CN=Fleet CA,O=Example,C=CN",
         "--path-length", "1", "--days", "3650", "--password-file", folder.parent / "ca.pass"],
        check=True, capture_output=True,
    )
    return x509.Certificate.from_pem((folder / "ca.crt.pem").read_bytes())


def test_an_existing_ca_certifies_and_its_key_stays_where_it_is(tmp_path: Path) -> None:
    ca, now = existing_ca(tmp_path / "fleet", b"fleet's"), datetime.now(UTC)
    home, reader = OperatorHome(tmp_path / "home"), ReaderHome(tmp_path / "r")
    admin.init_home(home, PASSPHRASE, reader=reader, reader_passphrase=READER_PASSPHRASE, now=now,
                    ca=tmp_path / "fleet", ca_passphrase=b"fleet's")
    server, roots = load_identity(home.server, PASSPHRASE)
    assert roots == (ca,) and home.ca == tmp_path / "fleet"
    assert not [path for path in home.path.rglob("*") if path.name == "ca.key.pem"]
    with registry_of(home) as known:
        assert admin.server_trust(home, known).check(
            server.signing_certificate.to_der(), server.encryption_certificate.to_der(), role=Role.SERVER, at=now)
    admin.change_passphrase(home.path, PASSPHRASE, b"new")
    assert load_ca(home.ca, b"fleet's", now).certificate == ca


def registry_of(home: OperatorHome) -> Registry:
    return Registry(home.registry)


def test_a_new_ca_may_be_kept_apart_and_half_a_ca_is_told(tmp_path: Path) -> None:
    home = OperatorHome(tmp_path / "home")
    admin.init_home(home, PASSPHRASE, reader=ReaderHome(tmp_path / "r"), reader_passphrase=READER_PASSPHRASE, now=NOW,
                    ca=tmp_path / "stick")
    assert (tmp_path / "stick/ca.key.pem").stat().st_mode & 0o777 == 0o600
    shutil.move(tmp_path / "stick", tmp_path / "safe")
    with pytest.raises(IdentityError, match="stick/ca"):
        load_ca(home.ca, PASSPHRASE, NOW)
    (tmp_path / "safe/ca.key.pem").unlink()
    with pytest.raises(IdentityError, match=r"safe/ca\.key\.pem cannot be read"):
        admin.init_home(OperatorHome(tmp_path / "two"), PASSPHRASE, reader=ReaderHome(tmp_path / "r2"),
                        reader_passphrase=READER_PASSPHRASE, now=NOW, ca=tmp_path / "safe")


def test_the_server_is_renewed_and_the_old_keys_are_kept(world: World) -> None:
    ca, first = load_ca(world.home.ca, PASSPHRASE, NOW), load_identity(world.home.server, PASSPHRASE)[0]
    kept = [admin.renew_server(world.home, ca=ca, passphrase=PASSPHRASE, now=NOW + timedelta(seconds=second))
            for second in range(3)]  # fmt: skip
    assert len(set(kept)) == 3
    assert load_identity(kept[0], PASSPHRASE)[0].public == first.public
    now, _ = load_identity(world.home.server, PASSPHRASE)
    with registry(world) as known:
        assert known.allows(now.public) and not known.allows(first.public)


def test_a_passphrase_is_changed_everywhere_and_after_a_crash_by_doing_it_again(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = world.register()
    admin.change_passphrase(world.path / "robot-1", b"robot's", b"new")
    join(RobotHome(world.path / "robot-1"), read_bundle(made.bundle.read_bytes()))
    load_identity(world.path / "robot-1/identity", b"new")
    home, real, done = world.home, os.replace, 0

    def dies(*args: object) -> None:
        nonlocal done
        done += 1
        if done == 3:
            raise KeyboardInterrupt
        real(*args)  # type: ignore[arg-type]

    with pytest.raises(IdentityError, match="does not open"):
        admin.change_passphrase(home.path, b"wrong", b"new")
    monkeypatch.setattr(os, "replace", dies)
    with pytest.raises(KeyboardInterrupt):
        admin.change_passphrase(home.path, PASSPHRASE, b"new")
    changed = admin.change_passphrase(home.path, PASSPHRASE, b"new")
    assert {path.name for path in changed} == {"ca.key.pem", "sign.key.pem", "enc.key.pem", "accounts.json"}
    load_ca(home.ca, b"new", NOW), load_identity(home.server, b"new"), Keyring.load(home.accounts, b"new")
    for path in changed:
        assert path.stat().st_mode & 0o777 == 0o600
    admin.change_passphrase(world.reader.path, READER_PASSPHRASE, b"new")
    load_identity(world.reader.path, b"new")


def test_a_backup_of_a_home_in_use_is_a_home(world: World, tmp_path: Path) -> None:
    made = world.register()
    world.hand_over(2)
    admin.backup(world.home.path, tmp_path / "copy")
    copy = OperatorHome(tmp_path / "copy").require()
    assert (copy.path / "store-0.sqlite").stat().st_mode & 0o777 == 0o600
    with registry_of(copy) as known:
        assert [*known.robots()] == [TK]
    assert load_ca(copy.ca, PASSPHRASE, NOW)
    assert Keyring.load(copy.accounts, PASSPHRASE).account(3).address == made.account
    assert (copy.bundles / "robot_1.bundle").read_bytes() == made.bundle.read_bytes()
    assert copy.deployment() == world.home.deployment() and not (copy.path / "submitter.lock").exists()
    with pytest.raises(ConfigError, match="already"):
        admin.backup(world.home.path, tmp_path / "copy")


def test_a_backup_lies_outside_the_home(world: World) -> None:
    with pytest.raises(ConfigError, match="whose loss it shall outlast"):
        admin.backup(world.home.path, world.home.path / "copy")
    assert not (world.home.path / "copy").exists()


def test_a_robots_backup_leaves_its_log_out(world: World, tmp_path: Path) -> None:
    made = world.register()
    robot = RobotHome(world.path / "robot-1")
    join(robot, read_bundle(made.bundle.read_bytes()))
    sqlite3.connect(robot.spool).close()
    robot.spool.touch()
    admin.backup(robot.path, tmp_path / "copy")
    copy = RobotHome(tmp_path / "copy")
    assert copy.bridge() == robot.bridge() and not copy.spool.exists()
    assert load_identity(copy.identity, b"robot's")[0].name == "robot_1"


# The contract


def test_a_second_contract_is_refused(world: World) -> None:
    with pytest.raises(ConfigError, match="deployed already"):
        admin.deploy_contract(world.home, world.chain, world.keys)


def test_an_account_without_eth_is_named_and_may_be_waited_for(tmp_path: Path) -> None:
    home, seconds = OperatorHome(tmp_path / "home"), []
    keys = admin.init_home(home, PASSPHRASE, reader=ReaderHome(tmp_path / "r"), reader_passphrase=b"r", now=NOW)
    rich = Keyring.create()
    chain = EmbeddedChain({rich.operator.address: 10**21})

    def pause(length: float) -> None:
        seconds.append(length)
        if len(seconds) == 3:
            from web3 import Web3

            web3 = Web3(chain)
            raw = rich.operator.sign_transaction({
                "to": keys.operator.address, "value": 10**20, "nonce": 0, "gas": 21_000, "gasPrice": 10**10,
                "chainId": web3.eth.chain_id,
            })
            web3.eth.send_raw_transaction(raw.raw_transaction)

    with pytest.raises(ChainError, match=keys.operator.address):
        admin.deploy_contract(home, chain, keys)
    assert not home.deployment_file.exists() and seconds == []
    admin.deploy_contract(home, chain, keys, wait=10, clock=lambda: sum(seconds), pause=pause)
    assert len(seconds) == 3 and home.deployment()


@pytest.mark.parametrize("gone", ["receipt", "genesis"])
def test_a_contract_whose_receipt_was_not_had_is_found_again(
    tmp_path: Path, gone: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A second one would cost as much again, and nobody would know of the first."""
    home, seconds = OperatorHome(tmp_path / "home"), []
    keys = admin.init_home(home, PASSPHRASE, reader=ReaderHome(tmp_path / "r"), reader_passphrase=b"r", now=NOW)
    chain = EmbeddedChain({keys.operator.address: 10**21})

    def away(*_: object) -> None:
        raise ChainUnavailable("the node does not answer")

    def back(length: float) -> None:
        seconds.append(length)
        patched.undo()

    with monkeypatch.context() as patched, pytest.raises(ChainUnavailable):
        patched.setattr(Ledger, gone, property(away) if gone == "genesis" else away)
        admin.deploy_contract(home, chain, keys)
    assert not home.deployment_file.exists()
    with monkeypatch.context() as patched:
        patched.setattr(Ledger, "code", property(away))
        made = admin.deploy_contract(home, chain, keys, wait=10, clock=lambda: sum(seconds), pause=back)
    ledger = Ledger.connect(chain, made)
    ledger.check()
    assert ledger.nonces([keys.operator.address]) == [(1, 1)] and len(seconds) == 1
    assert ledger.operator() == keys.operator.address and made.block == ledger.block_number()


def test_a_readers_configuration_is_complete_and_tells_no_key_of_the_operators_node(tmp_path: Path) -> None:
    home, reader = OperatorHome(tmp_path / "home"), ReaderHome(tmp_path / "r")
    keys = admin.init_home(home, PASSPHRASE, reader=reader, reader_passphrase=READER_PASSPHRASE, now=NOW,
                           chain_url="https://me:word@node.example:8545/v2/secretkey")
    made = admin.deploy_contract(home, EmbeddedChain({keys.operator.address: 10**21}), keys)
    config = load_reader_config(reader.config)
    assert config.ledger == made.ledger
    assert config.chain == ["https://node.example:8545"]
    assert home.reader_config.read_bytes() == reader.config.read_bytes()


def test_a_reader_carried_away_before_is_given_its_configuration_later(tmp_path: Path) -> None:
    home, reader = OperatorHome(tmp_path / "home"), ReaderHome(tmp_path / "r")
    keys = admin.init_home(home, PASSPHRASE, reader=reader, reader_passphrase=READER_PASSPHRASE, now=NOW)
    reader.path.rename(tmp_path / "carried")
    admin.deploy_contract(home, EmbeddedChain({keys.operator.address: 10**21}), keys)
    assert not reader.path.exists() and home.reader_config.exists()


# Readers


def test_another_reader_is_made_elsewhere_and_robots_registered_later_seal_for_it(world: World, tmp_path: Path) -> None:
    ca, analyst = load_ca(world.home.ca, PASSPHRASE, NOW), ReaderHome(tmp_path / "analyst")
    admin.add_reader(world.home, "analyst", analyst, ca=ca, passphrase=b"analyst's", now=NOW)
    identity, _ = load_identity(analyst.path, b"analyst's")
    assert kind_of(analyst.path) is HomeKind.READER and load_reader_config(analyst.config)
    assert ids.public_identity((world.home.readers / "analyst.pem").read_bytes()) == identity.public
    bundle = read_bundle(world.register().bundle.read_bytes())
    assert ids.public_identity(bundle.readers["analyst"].encode()) == identity.public
    assert set(bundle.readers) == {"owner", "analyst"}
    again = ReaderHome(tmp_path / "again")
    with pytest.raises(IdentityError, match="--replace"):
        admin.add_reader(world.home, "analyst", again, ca=ca, passphrase=b"x", now=NOW)
    assert not again.path.exists()
    admin.add_reader(world.home, "analyst", again, ca=ca, passphrase=b"x", now=NOW, replace=True)
    with registry(world) as known:
        assert not known.allows(identity.public)
    assert load_identity(analyst.path, b"analyst's")  # what was sealed for the old one only it can open
    world.revoke("analyst", Role.READER)
    assert not (world.home.readers / "analyst.pem").exists()
    with pytest.raises(IdentityError, match="is in force"):
        world.revoke("analyst", Role.READER)


def test_no_more_readers_than_a_chunk_has_room_for(world: World, tmp_path: Path) -> None:
    ca = load_ca(world.home.ca, PASSPHRASE, NOW)
    with registry(world) as known:
        for number in range(15):
            known.enrol(ids.enrol(ca, Role.READER, f"reader_{number}", at=NOW).public, NOW)
    with pytest.raises(IdentityError, match="16 readers"):
        admin.add_reader(world.home, "one-more", ReaderHome(tmp_path / "r17"), ca=ca, passphrase=b"x", now=NOW)


# Robots


def test_a_robot_with_its_own_keys_is_registered_and_nothing_secret_is_in_its_bundle(world: World) -> None:
    made = world.register()
    assert made.buried == 0 and world.events == []
    data = made.bundle.read_bytes()
    assert not needs_password(data) and b"PRIVATE" not in data
    robot = RobotHome(world.path / "robot-1")
    join(robot, read_bundle(data))
    peer = load_identity(robot.identity, b"robot's")[0].public
    [standing] = world.ledger.standings([TK])
    [event] = world.ledger.registrations(TK, standing)
    assert split_certificates(event.certificates) == (
        peer.signing_certificate.to_der(), peer.encryption_certificate.to_der())
    assert (standing.account, event.block) == (made.account, made.block)
    assert world.ledger.balance(made.account) == 5 * 10**17
    with registry(world) as known:
        assert known.robots()[TK].hash == standing.certificates_hash and known.allows(peer)
    assert robot.bridge().servers == ["127.0.0.1:7410"] and robot.bridge().ledger == world.ledger.ledger


def test_easy_register_makes_the_keys_and_seals_them_under_the_password(world: World) -> None:
    made = world.register(password=b"robot's")
    data = made.bundle.read_bytes()
    assert needs_password(data) and made.bundle.stat().st_mode & 0o777 == 0o600
    robot = RobotHome(world.path / "easy")
    join(robot, read_bundle(data, b"robot's"), b"robot's")
    assert load_identity(robot.identity, b"robot's")[0].name == "robot_1"


def test_what_cannot_be_registered_is_refused_before_the_chain_is_told(world: World) -> None:
    with pytest.raises(IdentityError, match="treasury"):
        world.register("operator")
    with pytest.raises(IdentityError, match="the request is of 'robot_2'"):
        world.register(request=world.request("robot_2"))
    with pytest.raises(IdentityError, match="a password that seals"):
        world.register(password=b"")
    world.home.config.write_text('listen = "0.0.0.0:7410"')
    with pytest.raises(ConfigError, match="public"):
        world.register()
    assert world.ledger.standings([TK])[0].account is None
    with registry(world) as known:
        assert not known.robots()


def test_a_used_name_is_not_taken_over_by_mistake(world: World) -> None:
    first = world.register()
    with pytest.raises(IdentityError, match="enrolled already"):
        world.register()
    with registry(world) as known:
        known.revoke("robot", "robot_1", NOW)
    with pytest.raises(IdentityError, match="the contract knows a robot 'robot_1' that the registry does not"):
        world.register()
    world.revoke()
    with pytest.raises(IdentityError, match="was revoked; give --replace"):
        world.register()
    assert world.register(replace=True).account != first.account


def test_what_the_old_robot_handed_over_is_written_from_its_own_account_before_it_is_replaced(world: World) -> None:
    old = world.register()
    world.hand_over(3)
    world.served = True
    new = world.register(replace=True)
    assert world.written() == [(old.account, 1)] * 3 and new.account != old.account and new.buried == 0
    [standing] = world.ledger.standings([TK])
    events = world.ledger.registrations(TK, standing)
    assert [(event.revoked, event.index) for event in events] == [(False, 0), (False, 3)]


def test_without_a_server_the_robot_is_not_replaced_and_the_way_out_is_told(world: World) -> None:
    old = world.register()
    world.hand_over(3)
    with pytest.raises(StoreError, match=r"3 chunks .* --compromised"):
        world.register(replace=True)
    assert world.ledger.standings([TK])[0].account == old.account
    with registry(world) as known:
        assert known.find("robot", "robot_1") is None  # it takes nothing more, whatever becomes of this
    world.served = True
    world.register(replace=True)
    assert world.written() == [(old.account, 1)] * 3


def test_what_is_on_the_chain_and_not_yet_confirmed_is_waited_for_too(world: World) -> None:
    world.register()
    world.hand_over(1)
    world.write(confirm=False)
    with pytest.raises(StoreError, match="1 chunks"):
        world.register(replace=True)


def test_a_compromised_robot_is_replaced_at_once_and_what_it_handed_over_is_never_written(world: World) -> None:
    old = world.register()
    world.hand_over(4)
    world.write(1)
    new = world.register(replace=True, compromised=True)
    assert new.buried == 3 and world.written() == [(old.account, 1)]
    assert [(letter.tk, letter.why) for letter in world.store.dead()] == [(TK, "robot_1 was replaced")] * 3
    assert sum(float(event.split()[1]) for event in world.events) == admin.HANDING_OVER
    world.write(9)
    assert world.written() == [(old.account, 1)]


def test_a_robot_revoked_on_the_chain_is_replaced_without_waiting(world: World) -> None:
    world.register()
    assert world.revoke().buried == 0
    at = world.now
    world.register(replace=True)
    assert world.now == at


def test_what_a_revoked_robot_handed_over_is_written_before_its_right_ends(world: World) -> None:
    old = world.register()
    world.hand_over(3)
    world.served = True
    ended = world.revoke()
    assert ended.buried == 0 and ended.block is not None and world.written() == [(old.account, 1)] * 3
    assert world.ledger.standings([TK])[0].revoked


@pytest.mark.parametrize("compromised", [False, True])
def test_without_a_server_a_robot_is_revoked_all_the_same_and_the_rest_becomes_dead_letters(
    world: World, compromised: bool
) -> None:
    world.register()
    world.hand_over(3)
    at = world.now
    assert world.revoke(compromised=compromised).buried == 3
    assert (world.now - at < 3) == compromised
    assert world.ledger.standings([TK])[0].revoked and world.store.waiting(TK).chunks == 0
    assert world.written() == []


def test_a_revocation_that_the_chain_did_not_hear_of_says_so_and_is_done_again(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    world.register()

    def down(*_: object) -> None:
        raise ChainError("the node does not answer")

    for call in ("standings", "revoke_robot"):
        with monkeypatch.context() as patched:
            patched.setattr(world.ledger, call, down)
            with pytest.raises(ChainError, match=r"half done: .* run `revoke robot_1` again"):
                world.revoke()
    with monkeypatch.context() as patched:
        patched.setattr(world, "open_store", partial(open_store, "redis://127.0.0.1:9", file=world.home.path,
                                                     ledger=bytes(32), max_bytes=1, max_bytes_per_robot=1))
        with pytest.raises(StoreError, match=r"half done: .* run `revoke robot_1` again"):
            world.revoke()
    assert world.revoke().block is not None
    with pytest.raises(IdentityError, match="no robot 'robot_1' is in force"):
        world.revoke()
    with pytest.raises(IdentityError, match="no robot 'robot_2' is in force"):
        world.revoke("robot_2")


def test_what_came_after_a_revocation_is_buried_by_revoking_again(world: World) -> None:
    """A worker whose disk was slow may take a chunk when `revoke` has looked: docs/operations.md, On hold."""
    world.register()
    assert world.revoke().buried == 0
    world.hand_over(3)
    assert world.revoke() == admin.Revoked(None, 3)
    assert len(world.store.dead()) == 3 and world.store.waiting(TK).chunks == 0
    with pytest.raises(IdentityError, match="no robot 'robot_1' is in force"):
        world.revoke()


def test_a_request_that_cannot_be_certified_does_not_end_the_robot_that_is_in_force(world: World) -> None:
    world.register()
    request = world.request()
    with pytest.raises(IdentityError, match="two keys"):
        world.register(replace=True, request=replace(request, encryption=request.signing))
    with registry(world) as known:
        assert known.find("robot", "robot_1") is not None


def test_an_old_backup_of_the_registry_does_not_stop_registrations(world: World, tmp_path: Path) -> None:
    admin.backup(world.home.path, tmp_path / "copy")
    accounts = {world.register(f"robot_{n}").account for n in (1, 2, 3)}
    for part in world.home.path.glob("registry.sqlite*"):
        part.unlink()
    shutil.copy(tmp_path / "copy/registry.sqlite", world.home.registry)
    new = world.register("robot_4")
    assert new.account not in accounts
    with registry(world) as known:
        found = known.find("robot", "robot_4")
    assert found is not None and found.account == new.account == world.keys.account(found.number).address
    with pytest.raises(IdentityError, match="robot_2"):
        world.register("robot_2")


@pytest.mark.parametrize("step", [
    "Registry.revoke", "Registry.enrol", "Bundle.encode", "ledger.replace_registration", "ledger.alloc_eth", "_bury",
])
def test_a_crash_between_any_two_steps_is_repaired_by_doing_it_again(
    world: World, step: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    old = world.register()
    world.hand_over(2)

    def crash(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        if step.startswith("ledger."):
            patched.setattr(world.ledger, step.removeprefix("ledger."), crash)
        else:
            patched.setattr(f"rosbridge_eth.operator.enrolment.{step}", crash)
        with pytest.raises(KeyboardInterrupt):
            world.register(replace=True, compromised=True)
    world.number = 50
    request = world.request()
    new = world.register(replace=True, compromised=True, request=request)
    join(RobotHome(world.path / "robot-51"), read_bundle(new.bundle.read_bytes()))
    peer = load_identity(world.path / "robot-51/identity", b"robot's")[0].public
    [standing] = world.ledger.standings([TK])
    with registry(world) as known:
        assert known.allows(peer) and known.robots()[TK].hash == standing.certificates_hash
    assert standing.account == new.account != old.account and not standing.revoked
    assert world.written() == [] and len(world.store.dead()) == 2


def test_a_robot_is_registered_also_where_its_account_gets_no_eth_at_once(
    world: World, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The bundle is written by then, and the server gives what is missing."""
    def down(*_: object) -> None:
        raise ChainError("the node does not answer")

    monkeypatch.setattr(world.ledger, "alloc_eth", down)
    made = world.register()
    assert made.bundle.exists()


def test_a_revocation_of_a_reader_that_was_cut_short_is_done_again(
    world: World, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    later = ReaderHome(tmp_path / "later")
    ca = load_ca(world.home.ca, PASSPHRASE, NOW)
    admin.add_reader(world.home, "later", later, ca=ca, passphrase=PASSPHRASE, now=NOW)

    def crash(*_: object, **__: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patched:
        patched.setattr(Path, "unlink", crash)
        with pytest.raises(KeyboardInterrupt):
            world.revoke("later", Role.READER)
    with suppress(IdentityError):
        world.revoke("later", Role.READER)
    assert [path.name for path in world.home.readers.iterdir()] == ["owner.pem"]
    with pytest.raises(IdentityError, match="no reader 'later' is in force"):
        world.revoke("later", Role.READER)


def test_a_server_of_a_readers_name_is_revoked_without_it(world: World, tmp_path: Path) -> None:
    ca = load_ca(world.home.ca, PASSPHRASE, NOW)
    admin.add_reader(world.home, "server", ReaderHome(tmp_path / "r"), ca=ca, passphrase=PASSPHRASE, now=NOW)
    world.revoke("server", Role.SERVER)
    assert (world.home.readers / "server.pem").exists()
    with registry(world) as known:
        assert known.find("reader", "server") and not known.find("server", "server")
