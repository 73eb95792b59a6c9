"""Accounts: those of the standards' own examples, sealed well, and never written over."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from rosbridge_eth.errors import IdentityError
from rosbridge_eth.ledger.accounts import Keyring

WORDS = "test test test test test test test test test test test junk"
# The accounts that anvil and hardhat print for these words.
KNOWN = [
    "0xf39Fd6e51aad88F6F4ce6aB8827279cffFb92266",
    "0x70997970C51812dc3A010C7d01b50e0d17dc79C8",
    "0x3C44CdDdB6a900fa2b585dd299e03d12FA4293BC",
]
COST = 2**12  # scrypt's, for tests


def test_accounts_are_those_a_wallet_shows():
    keyring = Keyring.from_mnemonic(f"  {WORDS.replace(' ', '   ')}\n")
    assert [keyring.operator.address, keyring.account(1).address, keyring.account(2).address] == KNOWN
    assert keyring.account(1) is keyring.account(1)


def test_new_ones_differ_and_can_be_written_down():
    first, second = Keyring.create(), Keyring.create()
    assert first.operator.address != second.operator.address
    assert len(first.mnemonic.split()) == 24
    assert Keyring.from_mnemonic(first.mnemonic).operator.address == first.operator.address


@pytest.mark.parametrize(
    "words", ["", "test", WORDS[:-4] + "test", WORDS + " test", "x" * 100, WORDS.replace("t", "ß")]
)
def test_words_that_are_no_mnemonic_are_refused(words: str):
    with pytest.raises(IdentityError, match="mnemonic"):
        Keyring.from_mnemonic(words)


@pytest.mark.parametrize("number", [-1, 2**31])
def test_a_number_that_bip_44_does_not_have_is_refused(number: int):
    with pytest.raises(IdentityError):
        Keyring.from_mnemonic(WORDS).account(number)


def test_what_is_sealed_opens_with_the_passphrase_alone():
    keyring = Keyring.from_mnemonic(WORDS)
    sealed = keyring.seal(b"pass phrase \xff", n=COST)
    opened = Keyring.open(sealed, b"pass phrase \xff")
    assert opened.account(5).address == keyring.account(5).address
    assert opened.mnemonic == keyring.mnemonic
    for wrong in (b"", b"pass phrase", b"pass phrase \xff "):
        with pytest.raises(IdentityError, match="password is wrong"):
            Keyring.open(sealed, wrong)


def test_the_file_shows_nothing_and_nothing_in_it_can_be_changed():
    keyring = Keyring.from_mnemonic(WORDS)
    sealed = keyring.seal(b"p", n=COST)
    assert b"junk" not in sealed
    assert keyring.seal(b"p", n=COST) != sealed
    content = json.loads(sealed)
    assert content["operator"] == KNOWN[0]
    for change in (
        {"operator": KNOWN[1]},
        {"format": "rosbridge-eth accounts 1"},
        {"format": "rosbridge-eth reader 2"},
        {"sealed": content["sealed"][:-4]},
        {"sealed": ""},
        {"sealed": "!"},
        {"scrypt": [2 * COST, 8, 1]},
        {"scrypt": [3, 8, 1]},
        {"scrypt": [2**40, 8, 1]},
        {"scrypt": 5},
        {"salt": "00"},
    ):
        with pytest.raises(IdentityError):
            Keyring.open(json.dumps(content | change).encode(), b"p")
    for garbage in (b"", b"[]", b"{}", b"null", b"\xff"):
        with pytest.raises(IdentityError, match="damaged"):
            Keyring.open(garbage, b"p")


def test_an_empty_passphrase_is_refused():
    with pytest.raises(IdentityError, match="empty"):
        Keyring.from_mnemonic(WORDS).seal(b"", n=COST)


def test_secrets_are_not_shown():
    keyring = Keyring.from_mnemonic(WORDS)
    assert "test" not in repr(keyring)
    assert "test" not in str(keyring)


def test_the_file_is_its_owners_and_never_written_over(tmp_path: Path):
    path = tmp_path / "accounts.json"
    Keyring.from_mnemonic(WORDS).save(path, b"p", n=COST)
    assert path.stat().st_mode & 0o777 == 0o600
    with pytest.raises(IdentityError, match="not overwritten"):
        Keyring.create().save(path, b"p", n=COST)
    assert Keyring.load(path, b"p").operator.address == KNOWN[0]
    assert [file.name for file in tmp_path.iterdir()] == ["accounts.json"]
    path.chmod(0o640)
    with pytest.raises(IdentityError, match="chmod 600"):
        Keyring.load(path, b"p")
    with pytest.raises(IdentityError, match="cannot be read"):
        Keyring.load(tmp_path / "none", b"p")
