"""SM4 of the package `cryptography`, which is OpenSSL's in C: for every mode, where it is installed (extra `fast`).

It is chosen, and imported late, as `optional` says. Where it has no SM4 (other builds than OpenSSL's) Python computes.
The results are the same. Against Python it takes a twentieth of the time in CBC encryption, which is serial, and a
tenth in GCM of a kilobyte; a fifth in CTR and in CBC decryption; in CTR of a mebibyte, which is what bit slices are
best at, four fifths.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, TypeAlias

from smcrypto.optional import OptionalEngine

__all__ = ["ENGINE", "BlockFunctions", "Foreign", "Opening", "Sealing"]

_Function: TypeAlias = Callable[[bytes], bytes]
BlockFunctions: TypeAlias = tuple[_Function, _Function]
"""Encryption and decryption of whole blocks."""
Sealing: TypeAlias = tuple[_Function, Callable[[], bytes]]
"""Of one message in GCM: a function from P to C, in pieces, and what gives T, of 16 bytes, in the end."""
Opening: TypeAlias = tuple[_Function, Callable[[bytes], bool]]
"""Of one message in GCM: a function from C to P, in pieces, and whether T, of 12 bytes or more, is theirs."""


class Foreign(NamedTuple):
    """What is used of the package. A key is 16 bytes."""

    ecb: Callable[[bytes], BlockFunctions]  # (key): for any number of calls, from any number of threads
    cbc: Callable[[bytes, bytes, bytes], bytes]  # (key, IV, whole blocks), encrypted
    ctr: Callable[[bytes, bytes, bytes], bytes]  # (key, first counter block, data of any length)
    sealing: Callable[[bytes, bytes, bytes], Sealing]  # (key, nonce of 12 bytes, A)
    opening: Callable[[bytes, bytes, bytes], Opening]  # (key, nonce of 12 bytes, A)


def _shared(context: Callable[[], _Function]) -> _Function:
    """One function of contexts, of which each serves one call at a time: two threads in one are a RuntimeError."""
    idle: list[_Function] = []

    def crypt(blocks: bytes) -> bytes:
        try:
            update = idle.pop()
        except IndexError:
            update = context()
        out = update(blocks)
        idle.append(update)
        return out

    return crypt


def _load() -> Foreign | None:
    """None if the package has no SM4, or none that works: the example of GB/T 32907-2016, A.1 decides."""
    try:
        from cryptography.exceptions import InvalidTag, UnsupportedAlgorithm
        from cryptography.hazmat.primitives.ciphers import Cipher, modes
        from cryptography.hazmat.primitives.ciphers.algorithms import SM4
    except ImportError:
        return None

    def ecb(key: bytes) -> BlockFunctions:
        cipher = Cipher(SM4(key), modes.ECB())  # noqa: S305 - the bare block, which is what is asked for
        return _shared(lambda: cipher.encryptor().update), _shared(lambda: cipher.decryptor().update)

    def cbc(key: bytes, chain: bytes, data: bytes) -> bytes:
        return Cipher(SM4(key), modes.CBC(chain)).encryptor().update(data)

    def ctr(key: bytes, first: bytes, data: bytes) -> bytes:
        return Cipher(SM4(key), modes.CTR(first)).encryptor().update(data)

    def sealing(key: bytes, nonce: bytes, A: bytes) -> Sealing:
        encryptor = Cipher(SM4(key), modes.GCM(nonce)).encryptor()
        encryptor.authenticate_additional_data(A)

        def tag() -> bytes:
            encryptor.finalize()
            return encryptor.tag

        return encryptor.update, tag

    def opening(key: bytes, nonce: bytes, A: bytes) -> Opening:
        decryptor = Cipher(SM4(key), modes.GCM(nonce, min_tag_length=12)).decryptor()
        decryptor.authenticate_additional_data(A)

        def holds(T: bytes) -> bool:
            try:
                decryptor.finalize_with_tag(T)
            except InvalidTag:
                return False
            return True

        return decryptor.update, holds

    example = bytes.fromhex("0123456789abcdeffedcba9876543210")
    try:
        sealed = sealing(example, example[:12], b"")[0](example)
        right = ecb(example)[0](example).hex() == "681edf34d206965e86b3e94f536e4246"
        right = right and ctr(example, example[:12] + b"\0\0\0\2", example) == sealed
    except UnsupportedAlgorithm:
        return None
    return Foreign(ecb, cbc, ctr, sealing, opening) if right else None


ENGINE = OptionalEngine("cryptography", _load, 4000)  # single blocks of 6 us in Python: the import takes 25 ms
