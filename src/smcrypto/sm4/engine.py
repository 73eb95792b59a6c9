"""One expanded key, and the fastest engine for any number of independent blocks."""

from __future__ import annotations

from smcrypto.errors import InvalidKey
from smcrypto.sm4.block import crypt_block, expand_key

__all__ = ["Engine"]


class Engine:
    """The internal workhorse under every mode: it trusts its callers to have checked types and lengths.

    encrypt, decrypt: any number of whole, independent blocks, in one call.
    ctr_xor: the counter mode's stream over data of any length.
    """

    __slots__ = ("_decrypt_keys", "_encrypt_keys")

    def __init__(self, key: bytes) -> None:
        if len(key) != 16:
            raise InvalidKey(f"an SM4 key is 16 bytes, not {len(key)}")
        self._encrypt_keys = expand_key(key)
        self._decrypt_keys = self._encrypt_keys[::-1]

    def encrypt(self, blocks: bytes) -> bytes:
        """ECB over whole blocks."""
        rk = self._encrypt_keys
        return b"".join(crypt_block(rk, blocks[i : i + 16]) for i in range(0, len(blocks), 16))

    def decrypt(self, blocks: bytes) -> bytes:
        """The inverse of `encrypt`."""
        rk = self._decrypt_keys
        return b"".join(crypt_block(rk, blocks[i : i + 16]) for i in range(0, len(blocks), 16))

    def ctr_xor(self, first: bytes, data: bytes, counter_bits: int = 128) -> bytes:
        """`data` XOR the encryptions of `first`, `first` + 1, ...

        first: the first counter block, 16 bytes. Only its low `counter_bits`
        bits count, big-endian, and wrap: 128 for CTR (GB/T 17964), 32 for
        GCM's inc32 (NIST SP 800-38D, 6.2).
        """
        return self.encrypt_and_ctr_xor(b"", first, data, counter_bits)[1]

    def encrypt_and_ctr_xor(
        self, blocks: bytes, first: bytes, data: bytes, counter_bits: int = 128
    ) -> tuple[bytes, bytes]:
        """(`encrypt(blocks)`, `ctr_xor(first, data, counter_bits)`) in one pass.

        GCM needs E(0^128), E(J0) and the key stream for every message;
        beside the key stream the two single blocks cost next to nothing.
        """
        count = -(-len(data) // 16)
        mask = (1 << counter_bits) - 1
        start = int.from_bytes(first, "big")
        high, low = start & ~mask, start & mask
        counters = b"".join((high | ((low + i) & mask)).to_bytes(16, "big") for i in range(count))
        out = self.encrypt(blocks + counters)
        split = len(blocks)
        stream = int.from_bytes(out[split : split + len(data)], "big")
        return out[:split], (stream ^ int.from_bytes(data, "big")).to_bytes(len(data), "big")


