"""SM4 where each block waits for the one before: CBC encryption, single blocks, and the tag of GCM.

Here nothing can be done side by side, and C is 50 to 150 times as fast as Python, in GCM of a kilobyte 14 times. So
where the package `cryptography` is installed (extra `fast`) and has SM4, that computes it; otherwise `tables` and
`aead` do. Both give the same results. CFB and OFB need no engine of their own, they are CBC of something else (see
`modes`).

ENGINE is "cryptography" or "python". It is chosen when this module is imported, by looking whether the package is
there; SMCRYPTO_PURE=1 in the environment chooses "python". The package itself is imported later, since that takes 25 ms
and much memory: with the block number IMPORT_BLOCKS of the process, which is where waiting has cost as much, or at
once if the program has imported it anyway. One that proves to have no SM4 (other builds than OpenSSL's) makes
ENGINE "python".
"""

from __future__ import annotations

import os
import sys
from collections.abc import Callable, Sequence
from functools import cache
from importlib.util import find_spec
from typing import NamedTuple, TypeAlias

from smcrypto.sm4 import tables

__all__ = ["ENGINE", "IMPORT_BLOCKS", "BlockFunctions", "GCMFunctions", "block_functions", "cbc_encrypt", "gcm"]

IMPORT_BLOCKS = 4000

_PACKAGE = "cryptography.hazmat.primitives.ciphers"
_Function: TypeAlias = Callable[[bytes], bytes]
BlockFunctions: TypeAlias = tuple[_Function, _Function]
"""Encryption and decryption of one block."""


class GCMFunctions(NamedTuple):
    """GCM with a nonce of 12 bytes. seal: (key, nonce, A, P) to C ‖ T; open: (key, nonce, A, C, T) to P, or None."""

    seal: Callable[[bytes, bytes, bytes, bytes], bytes]
    open: Callable[[bytes, bytes, bytes, bytes, bytes], bytes | None]


class _Foreign(NamedTuple):
    """What is used of `cryptography`, for a key."""

    gcm: GCMFunctions
    cbc: Callable[[bytes, bytes], _Function]  # (key, IV): continues a chain
    ecb: Callable[[bytes], BlockFunctions]  # (key): encrypts, decrypts whole blocks


def _choose(pure: bool) -> str:
    """The engine's name, nothing being imported."""
    try:
        return "python" if pure or find_spec("cryptography") is None else "cryptography"
    except ValueError:  # a module of that name without a specification stands in sys.modules
        return "python"


ENGINE: str = _choose(os.environ.get("SMCRYPTO_PURE") == "1")
_blocks = 0  # how many have been asked for before the package was imported


@cache
def _import() -> _Foreign | None:
    """`cryptography`'s SM4, or None if it has none that works: the example of GB/T 32907-2016, A.1 decides."""
    try:
        from cryptography.exceptions import InvalidTag, UnsupportedAlgorithm
        from cryptography.hazmat.primitives.ciphers import Cipher, modes
        from cryptography.hazmat.primitives.ciphers.algorithms import SM4
    except ImportError:
        return None

    def cbc(key: bytes, chain: bytes) -> _Function:
        return Cipher(SM4(key), modes.CBC(chain)).encryptor().update

    def ecb(key: bytes) -> BlockFunctions:
        cipher = Cipher(SM4(key), modes.ECB())  # noqa: S305 - the bare block, which is what is asked for
        return cipher.encryptor().update, cipher.decryptor().update

    def seal(key: bytes, nonce: bytes, A: bytes, P: bytes) -> bytes:
        encryptor = Cipher(SM4(key), modes.GCM(nonce)).encryptor()
        encryptor.authenticate_additional_data(A)
        return encryptor.update(P) + encryptor.finalize() + encryptor.tag

    def unseal(key: bytes, nonce: bytes, A: bytes, C: bytes, T: bytes) -> bytes | None:
        decryptor = Cipher(SM4(key), modes.GCM(nonce, T, min_tag_length=12)).decryptor()
        decryptor.authenticate_additional_data(A)
        P = decryptor.update(C)
        try:
            return P + decryptor.finalize()
        except InvalidTag:
            return None

    example = bytes.fromhex("0123456789abcdeffedcba9876543210")
    try:
        if ecb(example)[0](example).hex() != "681edf34d206965e86b3e94f536e4246":
            return None
        sealed = seal(example, example[:12], example, example)
        opened = unseal(example, example[:12], example, sealed[:16], sealed[16:])
    except UnsupportedAlgorithm:
        return None
    return _Foreign(GCMFunctions(seal, unseal), cbc, ecb) if opened == example else None


def _foreign(blocks: int) -> _Foreign | None:
    """The other engine for the next `blocks` blocks, None while `tables` is to do them."""
    global ENGINE, _blocks
    if ENGINE == "python":
        return None
    if _blocks < IMPORT_BLOCKS:
        _blocks += blocks
        if _blocks < IMPORT_BLOCKS and _PACKAGE not in sys.modules:
            return None
        _blocks = IMPORT_BLOCKS
    found = _import()
    if found is None:
        ENGINE = "python"
    return found


def cbc_encrypt(key: bytes, rk: Sequence[int], chain: bytes, data: bytes) -> bytes:
    """C_i = E(P_i ^ C_(i-1)) over whole blocks, C_0 being `chain`. rk: the round keys of `key`."""
    foreign = _foreign(len(data) // 16)
    return tables.cbc_encrypt(rk, chain, data) if foreign is None else foreign.cbc(key, chain)(data)


def block_functions(key: bytes) -> BlockFunctions | None:
    """Encryption and decryption of one block, for any number of calls; None while `tables` is to do them."""
    foreign = _foreign(1)
    return None if foreign is None else foreign.ecb(key)


def gcm(size: int) -> GCMFunctions | None:
    """For one message of `size` bytes; None while `aead` is to do it."""
    foreign = _foreign(size // 16 + 2)
    return None if foreign is None else foreign.gcm
