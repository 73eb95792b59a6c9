"""The Ethereum accounts of an operator and its robots: one seed, one passphrase.

Accounts are those of BIP-44, m/44'/60'/0'/0/N, from a BIP-39 mnemonic or a raw
seed: number 0 is the operator's, number n that of the n-th enrolment. A wallet
given the mnemonic shows the same ones.

At rest the seed is under SM4-GCM with a key by scrypt from the passphrase,
which is worked out once, however many robots there are:

    {"version": 1, "kdf": {"name": "scrypt", "n", "r", "p", "salt"},
     "cipher": {"name": "SM4-GCM", "nonce"}, "operator": address, "sealed": hex}

Everything but `sealed` is authenticated with it. What is sealed is `kind`,
a NUL, and the mnemonic in UTF-8 or the seed's bytes.
"""

from __future__ import annotations

import hashlib
import json
import os
import secrets
import tempfile
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

from rosbridge_eth.errors import IdentityError

if TYPE_CHECKING:
    from eth_account.signers.local import LocalAccount

WORDS = 24
MIN_SEED, MAX_SEED = 16, 64  # bytes, BIP-32
SCRYPT_N, SCRYPT_R, SCRYPT_P = 2**17, 8, 1  # 128 MiB, as the keystores of Ethereum's clients
_SCRYPT_MEMORY = 2**30
_KEY_SIZE, _SALT_SIZE, _NONCE_SIZE = 16, 32, 12
_MNEMONIC, _RAW = b"mnemonic", b"raw"


class Keyring:
    """All accounts of one operator. Made by `create`, `from_mnemonic`, `from_seed` or `open`."""

    def __init__(self, kind: bytes, secret: bytes) -> None:
        self._kind = kind
        self._secret = secret
        self._accounts: dict[int, LocalAccount] = {}

    def __repr__(self) -> str:
        return "Keyring(<secret>)"

    @staticmethod
    def create() -> Keyring:
        """A new mnemonic of 24 words from the system's generator."""
        from eth_account.hdaccount import generate_mnemonic
        from eth_account.types import Language

        return Keyring(_MNEMONIC, generate_mnemonic(WORDS, Language.ENGLISH).encode())

    @staticmethod
    def from_mnemonic(words: str) -> Keyring:
        """BIP-39, any of its lengths; IdentityError if a word or the checksum is wrong."""
        from eth_account.hdaccount import ETHEREUM_DEFAULT_PATH, key_from_seed, seed_from_mnemonic
        from eth_utils.exceptions import ValidationError

        normal = " ".join(words.split())
        try:
            key_from_seed(seed_from_mnemonic(normal, ""), ETHEREUM_DEFAULT_PATH)
        except (ValidationError, ValueError):
            raise IdentityError("this is no BIP-39 mnemonic: a word is unknown or the checksum wrong") from None
        return Keyring(_MNEMONIC, normal.encode())

    @staticmethod
    def from_seed(seed: bytes) -> Keyring:
        """A BIP-32 seed of 16 to 64 bytes."""
        if not MIN_SEED <= len(seed) <= MAX_SEED:
            raise IdentityError(f"a seed has {MIN_SEED} to {MAX_SEED} bytes, not {len(seed)}")
        return Keyring(_RAW, bytes(seed))

    @property
    def mnemonic(self) -> str | None:
        """The words to write down, None for a raw seed. A secret."""
        return self._secret.decode() if self._kind == _MNEMONIC else None

    @cached_property
    def _seed(self) -> bytes:
        from eth_account.hdaccount import seed_from_mnemonic

        return self._secret if self._kind == _RAW else seed_from_mnemonic(self._secret.decode(), "")

    def account(self, number: int) -> LocalAccount:
        """m/44'/60'/0'/0/number."""
        from eth_account import Account
        from eth_account.hdaccount import key_from_seed

        if not 0 <= number < 2**31:
            raise IdentityError(f"an account's number is in [0, 2**31), not {number}")
        if number not in self._accounts:
            self._accounts[number] = Account.from_key(key_from_seed(self._seed, f"m/44'/60'/0'/0/{number}"))
        return self._accounts[number]

    @property
    def operator(self) -> LocalAccount:
        """Account 0: owns the contract and pays for the others."""
        return self.account(0)

    def robot(self, number: int) -> LocalAccount:
        """The account of an enrolment; numbers count from 1."""
        if number < 1:
            raise IdentityError("robots' accounts count from 1; number 0 is the operator's")
        return self.account(number)

    def export(self, number: int, passphrase: bytes) -> dict[str, Any]:
        """One account as a keystore (Web3 Secret Storage, version 3) that any client imports."""
        from eth_account import Account

        password = passphrase.decode("utf-8", "surrogateescape")
        exported: dict[str, Any] = Account.encrypt(self.account(number).key, password)
        return exported

    # ------------------------------------------------------------------ at rest

    def seal(self, passphrase: bytes, *, n: int = SCRYPT_N) -> bytes:
        """The file that `open` reads; `n` is scrypt's cost."""
        from smcrypto.sm4 import SM4GCM

        if not passphrase:
            raise IdentityError("an empty passphrase protects nothing; choose another")
        header: dict[str, Any] = {
            "version": 1,
            "kdf": {"name": "scrypt", "n": n, "r": SCRYPT_R, "p": SCRYPT_P, "salt": secrets.token_hex(_SALT_SIZE)},
            "cipher": {"name": "SM4-GCM", "nonce": secrets.token_hex(_NONCE_SIZE)},
            "operator": self.operator.address,
        }
        cipher = SM4GCM(_derive(passphrase, header["kdf"]))
        plain = self._kind + b"\0" + self._secret
        sealed = cipher.encrypt(bytes.fromhex(header["cipher"]["nonce"]), plain, _canonical(header))
        return json.dumps(header | {"sealed": sealed.hex()}, indent=2).encode() + b"\n"

    @staticmethod
    def open(content: bytes, passphrase: bytes) -> Keyring:
        """The keyring of a sealed file; IdentityError if the passphrase or the file is wrong."""
        from smcrypto import InvalidTag
        from smcrypto.sm4 import SM4GCM

        try:
            header = json.loads(content)
            sealed = bytes.fromhex(header.pop("sealed"))
            nonce = bytes.fromhex(header["cipher"]["nonce"])
            form = (header["version"], header["kdf"]["name"], header["cipher"]["name"])
            key = _derive(passphrase, header["kdf"])
        except (ValueError, KeyError, TypeError, AttributeError, MemoryError):
            raise IdentityError("the accounts file is damaged; restore it or use the mnemonic") from None
        if form != (1, "scrypt", "SM4-GCM"):
            raise IdentityError("the accounts file is of another version of this program; use that one")
        try:
            kind, _, secret = SM4GCM(key).decrypt(nonce, sealed, _canonical(header)).partition(b"\0")
        except InvalidTag:
            raise IdentityError("the accounts file does not open: the passphrase is wrong, or it was changed") from None
        return Keyring(kind, secret)

    def save(self, path: Path, passphrase: bytes, *, n: int = SCRYPT_N) -> None:
        """Write the sealed file, readable by its owner alone, all of it or nothing. Never over another one."""
        content = self.seal(passphrase, n=n)
        descriptor, temporary = tempfile.mkstemp(dir=path.parent, prefix=f".{path.name}.")
        try:
            with os.fdopen(descriptor, "wb") as stream:
                stream.write(content)
                stream.flush()
                os.fsync(stream.fileno())
            os.link(temporary, path)  # fails where the file exists: a seed is never overwritten
        except FileExistsError:
            raise IdentityError(f"{path} exists already; it holds a seed and is not overwritten") from None
        except OSError as error:
            raise IdentityError(f"cannot write {path}: {error.strerror}") from error
        finally:
            Path(temporary).unlink(missing_ok=True)

    @staticmethod
    def load(path: Path, passphrase: bytes) -> Keyring:
        """Read what `save` wrote; IdentityError also where others may read the file."""
        try:
            if path.stat().st_mode & 0o077:
                raise IdentityError(f"{path} can be read by others; run: chmod 600 {path}")
            content = path.read_bytes()
        except OSError as error:
            raise IdentityError(f"cannot read {path}: {error.strerror}") from error
        return Keyring.open(content, passphrase)


def _canonical(header: dict[str, Any]) -> bytes:
    return json.dumps(header, sort_keys=True, separators=(",", ":")).encode()


def _derive(passphrase: bytes, kdf: dict[str, Any]) -> bytes:
    return hashlib.scrypt(
        passphrase,
        salt=bytes.fromhex(kdf["salt"]),
        n=kdf["n"],
        r=kdf["r"],
        p=kdf["p"],
        maxmem=_SCRYPT_MEMORY,
        dklen=_KEY_SIZE,
    )
