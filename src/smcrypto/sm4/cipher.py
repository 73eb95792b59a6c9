"""The bare SM4 block cipher as a class, GB/T 32907-2016."""

from __future__ import annotations

from smcrypto.errors import InvalidKey
from smcrypto.inputs import BytesLike, KeyHolder, as_bytes, as_exact_bytes
from smcrypto.sm4.foreign import ENGINE, BlockFunctions
from smcrypto.sm4.tables import crypt_block, expand_key

__all__ = ["SM4"]


class SM4(KeyHolder):
    """The bare block cipher, GB/T 32907-2016: one block of 16 bytes at a time.

    key: 16 bytes, otherwise InvalidKey. Data of other lengths needs a mode
    (`encrypt`, `Cipher`) or, better, `SM4GCM`, which also detects changes.

    >>> key = bytes.fromhex("0123456789abcdeffedcba9876543210")
    >>> SM4(key).encrypt_block(key).hex()
    '681edf34d206965e86b3e94f536e4246'
    """

    __slots__ = ("_functions", "_key", "_rk")

    block_size = 16
    key_size = 16

    def __init__(self, key: BytesLike) -> None:
        self._key = as_bytes(key, "key")
        if len(self._key) != 16:
            raise InvalidKey(f"an SM4 key is 16 bytes, not {len(self._key)}")
        self._functions: BlockFunctions | None = None
        rk = expand_key(self._key)
        self._rk = rk, rk[::-1]

    def encrypt_block(self, block: BytesLike) -> bytes:
        """The 16-byte ciphertext of a 16-byte block; another length is InvalidLength."""
        return self._crypt(0, block)

    def decrypt_block(self, block: BytesLike) -> bytes:
        """The 16-byte plaintext of a 16-byte block; another length is InvalidLength."""
        return self._crypt(1, block)

    def _crypt(self, way: int, block: BytesLike) -> bytes:
        if type(block) is not bytes or len(block) != 16:
            block = as_exact_bytes(block, "block", 16)
        if self._functions is None:
            foreign = ENGINE.after(1)
            if foreign is None:
                return crypt_block(self._rk[way], block)
            self._functions = foreign.ecb(self._key)
        return self._functions[way](block)
