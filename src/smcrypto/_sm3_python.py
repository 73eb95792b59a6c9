"""The pure Python engine of SM3: padding and streaming, GB/T 32905-2016, 5.2 and 5.3.1.

The compression function is `_sm3_compression`. Used by `sm3` where hashlib has no SM3.
"""

from __future__ import annotations

import struct

from smcrypto._sm3_compression import IV, State, compress_bytes

__all__ = ["PythonSM3"]


class PythonSM3:
    """A running hash of bytes: V after the whole blocks, the bytes after them, the length of all."""

    __slots__ = ("_V", "_length", "_tail")

    def __init__(self) -> None:
        self._V: State = IV
        self._tail = b""
        self._length = 0

    def update(self, data: bytes) -> None:
        self._length += len(data)
        if self._tail:
            data = self._tail + data
        blocks = len(data) // 64
        if blocks:
            self._V = compress_bytes(self._V, data, blocks)
        self._tail = data[64 * blocks :]

    def digest(self) -> bytes:
        # 5.2: a one bit, zeros up to 56 bytes modulo 64, the length in bits as 64 bits.
        zeros = bytes((55 - self._length) % 64)
        padded = b"".join((self._tail, b"\x80", zeros, struct.pack(">Q", 8 * self._length)))
        return struct.pack(">8I", *compress_bytes(self._V, padded, len(padded) // 64))

    def copy(self) -> PythonSM3:
        other = PythonSM3.__new__(PythonSM3)
        other._V, other._tail, other._length = self._V, self._tail, self._length
        return other
