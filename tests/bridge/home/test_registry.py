"""The list of enrolled names: one in force per name, replaced only on demand, forgotten never."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import pytest
from eth_hash.auto import keccak

from rosbridge_eth import identity as ids
from rosbridge_eth.errors import IdentityError, StoreError
from rosbridge_eth.identity import PeerIdentity, Role, create_ca
from rosbridge_eth.log.chunk import robot_id
from rosbridge_eth.operator.registry import Registry

NOON = datetime(2026, 6, 1, 12, tzinfo=UTC)


CA = create_ca("CA", at=NOON)


@pytest.fixture
def registry(tmp_path: Path) -> Registry:
    """As `init` leaves it."""
    made = Registry(tmp_path / "registry.sqlite", new=True)
    for role, name in ((Role.SERVER, "server"), (Role.READER, "owner")):
        enrol(made, name, role=role)
    return made


def enrol(registry: Registry, name: str, *, role: Role = Role.ROBOT, replace: bool = False) -> PeerIdentity:
    peer = ids.enrol(CA, role, name, at=NOON).public
    registry.enrol(peer, NOON, account="0x1", replace=replace)
    return peer


def test_an_enrolled_certificate_is_allowed_and_no_other(registry: Registry) -> None:
    peer = enrol(registry, "robot_1")
    assert registry.allows(peer)
    for other in (("robot_1", Role.ROBOT), ("robot_1", Role.READER), ("robot_2", Role.ROBOT)):
        assert not registry.allows(ids.enrol(CA, other[1], other[0], at=NOON).public)


def test_a_used_name_needs_replace_which_revokes_the_old(registry: Registry) -> None:
    old = enrol(registry, "robot_1")
    with pytest.raises(IdentityError, match="--replace"):
        enrol(registry, "robot_1")
    assert registry.allows(old)
    new = enrol(registry, "robot_1", replace=True)
    assert not registry.allows(old)
    assert registry.allows(new)
    assert [found.revoked_at for found in registry.all("robot")] == [NOON.isoformat(), None]


def test_what_the_submitter_and_the_server_ask(registry: Registry) -> None:
    enrol(registry, "robot_1")
    second = enrol(registry, "robot_2")
    newest = enrol(registry, "robot_1", replace=True)
    registry.revoke(Role.ROBOT, "robot_2", NOON)
    assert [*registry.robots()] == [robot_id("robot_1"), robot_id("robot_2")]
    robots = registry.robots()
    assert {tk: (robot.number, robot.revoked_at) for tk, robot in robots.items()} == {
        robot_id("robot_1"): (5, None), robot_id("robot_2"): (4, NOON.isoformat()),
    }
    assert robots[robot_id("robot_1")].hash == keccak(newest.certificates)
    assert registry.find("robot", "robot_2") is None
    assert robots[robot_id("robot_2")].hash == keccak(second.certificates)
    assert [reader.name for reader in registry.readers()] == ["owner"]


def test_numbers_are_never_used_twice(registry: Registry) -> None:
    enrol(registry, "robot_1")
    first = registry.next_number()
    registry.revoke("robot", "robot_1", NOON)
    enrol(registry, "robot_1")
    assert registry.next_number() > first


def test_a_revoked_name_is_free_again_and_not_revoked_twice(registry: Registry) -> None:
    peer = enrol(registry, "robot_1")
    assert registry.revoke("robot", "robot_1", NOON)
    assert not registry.allows(peer)
    assert not registry.revoke("robot", "robot_1", NOON)
    enrol(registry, "robot_1")


def test_another_process_sees_a_revocation(registry: Registry, tmp_path: Path) -> None:
    peer = enrol(registry, "robot_1")
    with Registry(tmp_path / "registry.sqlite") as other:
        before = other.revision()
        registry.revoke("robot", "robot_1", NOON)
        assert other.revision() != before
        assert not other.allows(peer)


def test_a_file_that_is_no_database_is_refused_with_the_way_out(tmp_path: Path) -> None:
    (tmp_path / "registry.sqlite").write_bytes(b"not a database" * 100)
    with pytest.raises(StoreError, match="backup"):
        Registry(tmp_path / "registry.sqlite")


def test_one_that_cannot_be_opened_is_not_said_to_be_damaged(tmp_path: Path) -> None:
    """Who puts a backup in its place brings back whom it knew and who was revoked since."""
    (tmp_path / "folder").mkdir()
    with pytest.raises(StoreError, match="unable to open database file; see that") as caught:
        Registry(tmp_path / "folder")
    assert "backup" not in str(caught.value)


def test_a_registry_that_cannot_be_made_is_not_said_to_be_lost(tmp_path: Path) -> None:
    with pytest.raises(StoreError, match="cannot be used: unable to open database file"):
        Registry(tmp_path / "absent" / "registry.sqlite", new=True)


@pytest.mark.parametrize("harm", ["deleted", "emptied", "made anew", "of another robot"])
def test_a_registry_that_was_lost_is_not_taken_for_a_new_one(registry: Registry, tmp_path: Path, harm: str) -> None:
    enrol(registry, "robot_1")
    registry.close()
    path = tmp_path / "registry.sqlite"
    path.unlink()
    if harm == "emptied":
        path.touch()
    if harm in ("made anew", "of another robot"):
        made = Registry(path, new=True)
        if harm == "of another robot":
            enrol(made, "robot_4")
        made.close()
    with pytest.raises(StoreError, match=r"restore registry\.sqlite from your backup"):
        Registry(path)
    assert path.exists() == (harm != "deleted")


def test_a_home_whose_server_and_owner_were_replaced_has_its_registry_still(registry: Registry, tmp_path: Path) -> None:
    enrol(registry, "server", role=Role.SERVER, replace=True)
    registry.revoke("reader", "owner", NOON)
    registry.close()
    Registry(tmp_path / "registry.sqlite").close()


def test_a_registry_deleted_or_replaced_while_it_is_open_is_noticed(registry: Registry, tmp_path: Path) -> None:
    path = tmp_path / "registry.sqlite"
    registry.revision()
    copy = tmp_path / "copy"
    copy.write_bytes(path.read_bytes())
    path.unlink()
    with pytest.raises(StoreError, match="restore"):
        registry.revision()
    copy.rename(path)
    with pytest.raises(StoreError, match="replaced"):
        registry.revision()
