"""The list of enrolled names: one in force per name, replaced only on demand, forgotten never."""

from __future__ import annotations

from datetime import UTC, datetime
from pathlib import Path

import pytest

from rosbridge_eth.errors import IdentityError, StoreError
from rosbridge_eth.registry import Enrolment, Registry

NOON = datetime(2026, 6, 1, 12, tzinfo=UTC)


@pytest.fixture
def registry(tmp_path: Path) -> Registry:
    """As `init` leaves it."""
    made = Registry(tmp_path / "registry.sqlite", new=True)
    for mark, role, name in ((254, "server", "server"), (255, "reader", "owner")):
        enrol(made, name, mark, role=role)
    return made


def enrol(registry: Registry, name: str, mark: int, *, role: str = "robot", replace: bool = False) -> Enrolment:
    return registry.enrol(
        number=registry.next_number(), role=role, name=name, fingerprint=bytes([mark]) * 32,
        certificates=b"pem", account=f"0x{mark}", now=NOON, replace=replace,
    )


def test_an_enrolled_certificate_is_allowed_and_no_other(registry: Registry) -> None:
    enrol(registry, "robot_1", 1)
    assert registry.allows("robot", "robot_1", b"\x01" * 32)
    assert not registry.allows("robot", "robot_1", b"\x02" * 32)
    assert not registry.allows("reader", "robot_1", b"\x01" * 32)
    assert not registry.allows("robot", "robot_2", b"\x01" * 32)


def test_a_used_name_needs_replace_which_revokes_the_old(registry: Registry) -> None:
    enrol(registry, "robot_1", 1)
    with pytest.raises(IdentityError, match="--replace"):
        enrol(registry, "robot_1", 2)
    assert registry.allows("robot", "robot_1", b"\x01" * 32)
    enrol(registry, "robot_1", 2, replace=True)
    assert not registry.allows("robot", "robot_1", b"\x01" * 32)
    assert registry.allows("robot", "robot_1", b"\x02" * 32)
    assert [found.revoked_at for found in registry.all("robot")] == [NOON, None]


def test_numbers_are_never_used_twice(registry: Registry) -> None:
    first = enrol(registry, "robot_1", 1)
    registry.revoke("robot", "robot_1", NOON)
    assert enrol(registry, "robot_1", 2).number > first.number


def test_a_revoked_name_is_free_again_and_not_revoked_twice(registry: Registry) -> None:
    enrol(registry, "robot_1", 1)
    registry.revoke("robot", "robot_1", NOON)
    assert not registry.allows("robot", "robot_1", b"\x01" * 32)
    with pytest.raises(IdentityError, match="no robot 'robot_1'"):
        registry.revoke("robot", "robot_1", NOON)


def test_another_process_sees_a_revocation(registry: Registry, tmp_path: Path) -> None:
    enrol(registry, "robot_1", 1)
    other = Registry(tmp_path / "registry.sqlite")
    registry.revoke("robot", "robot_1", NOON)
    assert not other.allows("robot", "robot_1", b"\x01" * 32)


def test_a_file_that_is_no_database_is_refused_with_the_way_out(tmp_path: Path) -> None:
    (tmp_path / "registry.sqlite").write_bytes(b"not a database" * 100)
    with pytest.raises(StoreError, match="backup"):
        Registry(tmp_path / "registry.sqlite")


@pytest.mark.parametrize("harm", ["deleted", "emptied", "made anew", "of another robot"])
def test_a_registry_that_was_lost_is_not_taken_for_a_new_one(registry: Registry, tmp_path: Path, harm: str) -> None:
    enrol(registry, "robot_1", 1)
    registry.close()
    path = tmp_path / "registry.sqlite"
    path.unlink()
    if harm == "emptied":
        path.touch()
    if harm in ("made anew", "of another robot"):
        made = Registry(path, new=True)
        if harm == "of another robot":
            enrol(made, "robot_4", 4)
        made.close()
    with pytest.raises(StoreError, match=r"restore registry\.sqlite from your backup"):
        Registry(path)
    assert path.exists() == (harm != "deleted")


def test_a_home_whose_server_and_owner_were_replaced_has_its_registry_still(registry: Registry, tmp_path: Path) -> None:
    enrol(registry, "server", 7, role="server", replace=True)
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
