"""What each folder gives to who steals it, with its passphrase: the table of docs/threat-model.md, tried."""

from __future__ import annotations

import re
from contextlib import suppress
from pathlib import Path

import pytest

from bridge.home.world import PASSPHRASE, READER_PASSPHRASE, World
from rosbridge_eth.config.home import RobotHome
from rosbridge_eth.identity import KEY_FILES, Role, load_identity, public_identity
from rosbridge_eth.log import chunk as chunks
from rosbridge_eth.operator.bundle import join, read_bundle
from smcrypto import SMCryptoError, sm2

PASSWORD = b"robot's"
_PEM = re.compile(rb"-----BEGIN (?:ENCRYPTED )?PRIVATE KEY-----.*?-----END (?:ENCRYPTED )?PRIVATE KEY-----", re.DOTALL)


def keys_in(folder: Path, *passwords: bytes) -> list[sm2.PrivateKey]:
    """Every SM2 key that somebody with these passwords finds in a folder, wherever it is."""
    found = []
    for file in (path for path in folder.rglob("*") if path.is_file()):
        for pem in _PEM.findall(file.read_bytes()):
            for password in (None, *passwords):
                with suppress(SMCryptoError):
                    found.append(sm2.PrivateKey.from_pem(pem + b"\n", password))
                    break
    return found


def may_open(keys: list[sm2.PrivateKey], header: chunks.Header) -> bool:
    for key in keys:
        try:
            chunks.content_key(header, key)
        except chunks.ChunkError:
            continue
        return True
    return False


@pytest.fixture(scope="module")
def world(tmp_path_factory: pytest.TempPathFactory) -> World:
    """A robot with its own keys that has joined, and one whose keys the operator made."""
    made = World(tmp_path_factory.mktemp("world"))
    robot = RobotHome(made.path / "robot-1")
    join(robot, read_bundle(made.register().bundle.read_bytes()))
    made.register("robot_2", password=PASSWORD)
    return made


@pytest.fixture(scope="module")
def header(world: World) -> chunks.Header:
    """Of a chunk that robot_1 sealed for the readers of its bundle."""
    robot = RobotHome(world.path / "robot-1")
    identity, _ = load_identity(robot.identity, PASSWORD)
    readers = [public_identity(file.read_bytes()).encryption_certificate.public_key for file in robot.readers.iterdir()]
    log = chunks.Log(robot.bridge().ledger, chunks.robot_id("robot_1"))
    return chunks.seal(
        log, identity.signing_key, [b'{"secret":1}'], stream=bytes(16), number=0, previous=bytes(32), sealed_ms=1,
        readers=readers,
    ).header


def robots_key(world: World) -> sm2.PublicKey:
    return load_identity(world.path / "robot-1/identity", PASSWORD)[0].signing_key.public_key


def test_the_operators_home_with_its_passphrase_opens_no_record_and_signs_as_no_robot_with_its_own_keys(
    world: World, header: chunks.Header
) -> None:
    keys = keys_in(world.home.path, PASSPHRASE)
    assert len(keys) == 3  # the CA's, and the server's two
    assert not may_open(keys, header)
    assert robots_key(world) not in [key.public_key for key in keys]


def test_a_bundle_of_a_request_and_the_request_hold_no_key_under_any_password(world: World) -> None:
    for file in (world.home.bundles / "robot_1.bundle", world.path / "robot-1/request.json"):
        assert b"PRIVATE" not in file.read_bytes() and b"sealed" not in file.read_bytes()


def test_a_bundle_of_easy_register_with_its_password_is_the_robot(world: World) -> None:
    bundle = read_bundle((world.home.bundles / "robot_2.bundle").read_bytes(), PASSWORD)
    assert set(bundle.keys) == set(KEY_FILES)


def test_the_robots_home_signs_as_it_and_opens_nothing_that_it_sealed(world: World, header: chunks.Header) -> None:
    keys = keys_in(world.path / "robot-1", PASSWORD)
    assert robots_key(world) in [key.public_key for key in keys]
    assert not may_open(keys, header)
    assert keys_in(world.path / "robot-1") == []


def test_the_readers_home_opens_what_was_sealed_for_it_and_signs_as_nobody_else(
    world: World, header: chunks.Header
) -> None:
    identity, _ = load_identity(world.reader.path, READER_PASSPHRASE)
    keys = keys_in(world.reader.path, READER_PASSPHRASE)
    assert len(keys) == 2 and may_open(keys, header) and identity.role is Role.READER
    assert keys_in(world.reader.path, PASSPHRASE) == []


def test_no_home_gives_a_key_to_who_has_no_passphrase(world: World) -> None:
    assert keys_in(world.path) == []
