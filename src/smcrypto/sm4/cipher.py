"""The bare SM4 block cipher as a class, GB/T 32907-2016."""

from __future__ import annotations

from smcrypto.errors import InvalidKey
from smcrypto.inputs import BytesLike, as_bytes, as_exact_bytes
from smcrypto.sm4 import serial
from smcrypto.sm4.tables import crypt_block, expand_key

__all__ = ["SM4"]


class SM4:
    """The bare block cipher, GB/T 32907-2016: one block of 16 bytes at a time.

    key: 16 bytes, otherwise InvalidKey. Data of other lengths needs a mode
    (`encrypt`, `Cipher`) or, better, `SM4GCM`, which also detects changes.

    >>> key = bytes.fromhex("0123456789abcdeffedcba9876543210")
    >>> SM4(key).encrypt_block(key).hex()
    '681edf34d206965e86b3e94f536e4246'
    """

    __slots__ = ("_blocks", "_decrypt_keys", "_encrypt_keys", "_functions", "_key")

    block_size = 16
    key_size = 16

    def __init__(self, key: BytesLike) -> None:
        key = as_bytes(key, "key")
        if len(key) != 16:
            raise InvalidKey(f"an SM4 key is 16 bytes, not {len(key)}")
        self._key = key
        self._functions: serial.BlockFunctions | None = None
        self._encrypt_keys = expand_key(key)
        self._decrypt_keys = self._encrypt_keys[::-1]
        self._blocks = 0  # a key that is used a lot gets the wide tables

    def encrypt_block(self, block: BytesLike) -> bytes:
        """The 16-byte ciphertext of a 16-byte block; another length is InvalidLength."""
        if type(block) is not bytes or len(block) != 16:
            block = as_exact_bytes(block, "block", 16)
        functions = self._functions
        if functions is None:
            self._blocks += 1
            if serial.ENGINE == "python" or (functions := self._other_engine()) is None:
                return crypt_block(self._encrypt_keys, block, self._blocks)
        return functions[0](block)

    def decrypt_block(self, block: BytesLike) -> bytes:
        """The 16-byte plaintext of a 16-byte block; another length is InvalidLength."""
        if type(block) is not bytes or len(block) != 16:
            block = as_exact_bytes(block, "block", 16)
        functions = self._functions
        if functions is None:
            self._blocks += 1
            if serial.ENGINE == "python" or (functions := self._other_engine()) is None:
                return crypt_block(self._decrypt_keys, block, self._blocks)
        return functions[1](block)

    def _other_engine(self) -> serial.BlockFunctions | None:
        self._functions = serial.block_functions(self._key)
        return self._functions

    def __reduce__(self) -> tuple[type[SM4], tuple[bytes]]:
        return SM4, (self._key,)
