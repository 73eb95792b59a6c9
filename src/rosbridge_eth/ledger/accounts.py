"""The Ethereum accounts of an operator and its robots: one mnemonic, one passphrase.

Accounts are those of BIP-44, m/44'/60'/0'/0/N, from a BIP-39 mnemonic: number 0
is the operator's, number n that of the n-th enrolment. A wallet given the words
shows the same ones, so whoever wrote them down needs no copy of the file.

At rest the words are in a sealed box (files.py), whose key is worked out once, however many robots there are;
the operator's address is shown in the clear. What is sealed is "mnemonic", a NUL, and the words in UTF-8.
"""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

from rosbridge_eth.errors import IdentityError
from rosbridge_eth.files import STRONG_SCRYPT_N, open_box, read_file, seal_box, write_atomically
from rosbridge_eth.ledger.transport import limit_recursion

if TYPE_CHECKING:
    from eth_account.signers.local import LocalAccount

FORMAT = "rosbridge-eth accounts 2"
WORDS = 24
_KIND = b"mnemonic\0"


def _eth_account() -> Any:
    """eth_account.Account, imported where it is first needed."""
    from eth_account import Account

    Account.enable_unaudited_hdwallet_features()
    limit_recursion()
    return Account


class Keyring:
    """All accounts of one operator. Made by `create`, `from_mnemonic` or `open`. mnemonic: the words, a secret."""

    def __init__(self, mnemonic: str) -> None:
        self.mnemonic = mnemonic
        self._accounts: dict[int, LocalAccount] = {}

    def __repr__(self) -> str:
        return "Keyring(<secret>)"

    @staticmethod
    def create() -> Keyring:
        """A new mnemonic of 24 words from the system's generator."""
        return Keyring(_eth_account().create_with_mnemonic(num_words=WORDS)[1])

    @staticmethod
    def from_mnemonic(words: str) -> Keyring:
        """BIP-39, any of its lengths; IdentityError if a word or the checksum is wrong."""
        from eth_utils.exceptions import ValidationError

        keyring = Keyring(" ".join(words.split()))
        try:
            keyring.account(0)
        except (ValidationError, ValueError):
            raise IdentityError("this is no BIP-39 mnemonic: a word is unknown or the checksum wrong") from None
        return keyring

    def account(self, number: int) -> LocalAccount:
        """m/44'/60'/0'/0/number: 0 is the operator's, n that of the n-th enrolment."""
        if not 0 <= number < 2**31:
            raise IdentityError(f"an account's number is in [0, 2**31), not {number}")
        if number not in self._accounts:
            path = f"m/44'/60'/0'/0/{number}"
            self._accounts[number] = _eth_account().from_mnemonic(self.mnemonic, account_path=path)
        return self._accounts[number]

    @property
    def operator(self) -> LocalAccount:
        """Account 0: owns the contract and pays for the others."""
        return self.account(0)

    # ------------------------------------------------------------------ at rest

    def seal(self, passphrase: bytes, *, n: int = STRONG_SCRYPT_N) -> bytes:
        """The file that `open` reads; `n` is scrypt's cost."""
        head = {"format": FORMAT, "operator": self.operator.address}
        return seal_box(_KIND + self.mnemonic.encode(), passphrase, head, n=n)

    @staticmethod
    def open(content: bytes, passphrase: bytes) -> Keyring:
        """The keyring of a sealed file; IdentityError if the passphrase or the file is wrong."""
        return Keyring(open_box(content, passphrase, FORMAT)[1].removeprefix(_KIND).decode())

    def save(self, path: Path, passphrase: bytes, *, n: int = STRONG_SCRYPT_N) -> None:
        """Write the sealed file, readable by its owner alone, all of it or nothing. Never over another one."""
        try:
            write_atomically(path, self.seal(passphrase, n=n), mode=0o600, new=True)
        except FileExistsError as error:
            raise IdentityError(f"{path} exists already; it holds a seed and is not overwritten") from error
        except OSError as error:
            raise IdentityError(f"cannot write {path}: {error.strerror}") from error

    @staticmethod
    def load(path: Path, passphrase: bytes) -> Keyring:
        """Read what `save` wrote; IdentityError also where others may read the file."""
        return Keyring.open(read_file(path, private=True), passphrase)
