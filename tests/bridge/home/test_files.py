"""Files are written whole, secrets are read from private files alone, and a box opens under its password alone."""

from __future__ import annotations

import json
import os
from pathlib import Path

import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from rosbridge_eth.errors import IdentityError
from rosbridge_eth.files import box_head, open_box, read_file, seal_box, write_atomically

HEAD = {"format": "rosbridge-eth bundle 3", "name": "robot_1"}
FORMAT = HEAD["format"]
BOX = seal_box(b"a secret", b"horse", HEAD, n=2)


def crash(*_: object, **__: object) -> None:
    raise KeyboardInterrupt


@pytest.mark.parametrize("step", ["os.fsync", "os.chmod", "os.replace"])
def test_a_crash_leaves_the_old_file_or_the_new_one_and_nothing_beside_it(
    step: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    file = tmp_path / "home.json"
    write_atomically(file, b"old")
    with monkeypatch.context() as patched:
        patched.setattr(step, crash)
        with pytest.raises(KeyboardInterrupt):
            write_atomically(file, b"new")
    assert file.read_bytes() == b"old"
    assert list(tmp_path.iterdir()) == [file]


def test_the_mode_holds_from_the_first_byte_and_a_new_file_overwrites_nothing(tmp_path: Path) -> None:
    file = tmp_path / "key"
    write_atomically(file, b"1", mode=0o600, new=True)
    assert file.stat().st_mode & 0o777 == 0o600
    with pytest.raises(FileExistsError):
        write_atomically(file, b"2", mode=0o600, new=True)
    assert file.read_bytes() == b"1" and list(tmp_path.iterdir()) == [file]


def test_a_file_with_a_secret_must_be_private(tmp_path: Path) -> None:
    key = tmp_path / "sign.key.pem"
    with pytest.raises(IdentityError, match="cannot be read: No such file"):
        read_file(key, private=True)
    key.write_text("secret")
    for mode in (0o644, 0o640, 0o604, 0o620, 0o601):
        os.chmod(key, mode)
        with pytest.raises(IdentityError, match=rf"open to others \(mode {mode:04o}\); run `chmod 600"):
            read_file(key, private=True)
    for mode in (0o600, 0o400):
        os.chmod(key, mode)
        assert read_file(key, private=True) == b"secret"


def test_a_box_opens_under_its_password_and_shows_its_head_alone() -> None:
    head, secret = open_box(BOX, b"horse", FORMAT)
    assert secret == b"a secret" and head.items() >= HEAD.items()
    assert b"secret" not in BOX
    for password in (b"hors", b"", b"horse "):
        with pytest.raises(IdentityError, match="password is wrong"):
            open_box(BOX, password, FORMAT)
    with pytest.raises(IdentityError, match="protects nothing"):
        seal_box(b"a secret", b"", HEAD)


def test_two_boxes_of_the_same_share_nothing_secret() -> None:
    one, two = (json.loads(seal_box(b"a secret", b"horse", HEAD, n=2)) for _ in range(2))
    assert one["salt"] != two["salt"] and one["sealed"] != two["sealed"]


@pytest.mark.parametrize("field", ["name", "salt", "sealed", "scrypt"])
def test_an_altered_box_does_not_open(field: str) -> None:
    head = json.loads(BOX)
    head[field] = {
        "name": "robot_2", "salt": "00" * 16, "sealed": "A" + head["sealed"][1:], "scrypt": [4, 8, 1],
    }[field]
    with pytest.raises(IdentityError, match="altered"):
        open_box(json.dumps(head).encode(), b"horse", FORMAT)


@pytest.mark.parametrize("cost", [
    [2**40, 8, 1], [2, 2**30, 1], [2, 8, 2**30], [2, 8], "2", [3, 8, 1], [2.5, 8, 1], None,
])
def test_a_hostile_cost_is_refused_before_it_is_paid(cost: object) -> None:
    head = json.loads(BOX) | {"scrypt": cost}
    with pytest.raises(IdentityError, match="damaged"):
        open_box(json.dumps(head).encode(), b"horse", FORMAT)


@pytest.mark.parametrize("data", [b"", b"{}", b"[]", b"null", b'{"sealed": "!"}', b"\xff\xfe", b"[" * 100_000])
def test_what_is_none_of_our_files_is_refused(data: bytes) -> None:
    with pytest.raises(IdentityError, match="no bundle file"):
        box_head(data, FORMAT)


def test_a_file_of_the_first_edition_is_refused_with_the_reason() -> None:
    with pytest.raises(IdentityError, match="another format"):
        box_head(b'{"format": "rosbridge-eth bundle 1"}', FORMAT)


@given(st.binary(max_size=200) | st.recursive(
    st.none() | st.text(max_size=3) | st.integers(), lambda x: st.dictionaries(
        st.sampled_from(["format", "salt", "scrypt", "sealed"]), x | st.just(FORMAT), max_size=4), max_leaves=5,
).map(lambda value: json.dumps(value).encode()))
@settings(max_examples=200)
def test_no_file_ends_in_anything_but_a_sentence(data: bytes) -> None:
    with pytest.raises(IdentityError):
        open_box(data, b"horse", FORMAT)
