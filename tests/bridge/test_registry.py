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
    return Registry(tmp_path / "registry.sqlite")


def enrol(registry: Registry, name: str, mark: int, *, replace: bool = False) -> Enrolment:
    return registry.enrol(
        number=registry.next_number(), role="robot", name=name, fingerprint=bytes([mark]) * 32,
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
