"""The bundle opens under its password, and under nothing else."""

from __future__ import annotations

import json

import pytest

from rosbridge_eth.bundle import Bundle, open_bundle, seal_bundle
from rosbridge_eth.errors import IdentityError

BUNDLE = Bundle("robot_1", {"sign.key.pem": "-----BEGIN"}, "server_1", "127.0.0.1:7600", ("cert",), "0xabc", 31337)


@pytest.fixture(scope="module")
def sealed() -> bytes:
    return seal_bundle(BUNDLE, b"horse")


def test_it_opens_under_its_password(sealed: bytes) -> None:
    assert open_bundle(sealed, b"horse") == BUNDLE


def test_a_wrong_password_is_refused(sealed: bytes) -> None:
    with pytest.raises(IdentityError, match="password is wrong"):
        open_bundle(sealed, b"hors")


def test_its_contents_are_not_readable(sealed: bytes) -> None:
    assert b"BEGIN" not in sealed and b"server_1" not in sealed


def test_an_altered_outer_field_is_noticed(sealed: bytes) -> None:
    fields = json.loads(sealed)
    fields["name"] = "robot_2"
    with pytest.raises(IdentityError, match="altered"):
        open_bundle(json.dumps(fields).encode(), b"horse")


def test_a_hostile_work_factor_is_refused_before_it_is_paid(sealed: bytes) -> None:
    fields = json.loads(sealed)
    fields["n"] = 2**40
    with pytest.raises(IdentityError, match="format"):
        open_bundle(json.dumps(fields).encode(), b"horse")


@pytest.mark.parametrize("data", [b"", b"{}", b"[]", b"null", b'{"sealed": "!"}', b"\xff\xfe"])
def test_what_is_no_bundle_is_refused(data: bytes) -> None:
    with pytest.raises(IdentityError, match="not a bundle"):
        open_bundle(data, b"horse")
