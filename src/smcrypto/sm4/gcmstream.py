"""GCM in pieces: NIST SP 800-38D, as `aead.SM4GCM` does it at once, and with the same result.

GHASH goes on where it was by XORing its state into the next block: GHASH(X_1, X_2, ...) = (...(X_1·H + X_2)·H + ...)·H.
"""

from __future__ import annotations

from hmac import compare_digest

from smcrypto.errors import InvalidLength, InvalidTag
from smcrypto.sm4.aead import GCM_TEXT
from smcrypto.sm4.engine import Engine, xor_bytes
from smcrypto.sm4.ghash import GHASH

__all__ = ["GCMDecryption", "GCMEncryption"]


class _State:
    """GHASH and the counter of one message under way."""

    def __init__(self, key: bytes, nonce: bytes, associated_data: bytes) -> None:
        self._engine = Engine(key)
        self._ghash = GHASH(self._engine.encrypt(bytes(16)))
        if len(nonce) == 12:
            J_0 = nonce + b"\0\0\0\1"
        else:
            lengths = (len(nonce) << 3).to_bytes(16, "big")
            J_0 = self._ghash(nonce + bytes(-len(nonce) % 16) + lengths).to_bytes(16, "big")
        self._mask = self._engine.encrypt(J_0)
        self._counter = J_0
        self._Y, self._begun = 0, b""
        self._lengths = len(associated_data) << 67
        self._text = 0
        self._absorb(associated_data + bytes(-len(associated_data) % 16))
        self._left = b""  # of the key stream

    def _absorb(self, blocks: bytes) -> None:
        if blocks:
            first = (self._Y ^ int.from_bytes(blocks[:16], "big")).to_bytes(16, "big")
            self._Y = self._ghash(first + blocks[16:])

    def count(self, length: int) -> None:
        self._text += length
        if self._text > GCM_TEXT:
            raise InvalidLength("GCM takes at most 2^36 - 32 bytes (SP 800-38D, 5.2.1.1)")

    def hash(self, ciphertext: bytes) -> None:
        data = self._begun + ciphertext
        whole = len(data) & ~15
        self._begun = data[whole:]
        self._absorb(data[:whole])

    def xor(self, data: bytes) -> bytes:
        """`data` XOR the key stream where it stands: from inc32(J_0) on."""
        head, rest = data[: len(self._left)], data[len(self._left) :]
        out = xor_bytes(head, self._left[: len(head)])
        self._left = self._left[len(head) :]
        if not rest:
            return out
        padded = rest + bytes(-len(rest) % 16)
        number = int.from_bytes(self._counter, "big")
        first, last = (number & -(1 << 32) | (number + n) % (1 << 32) for n in (1, len(padded) // 16))
        masked = self._engine.ctr_xor(first.to_bytes(16, "big"), padded, 32)
        self._counter = last.to_bytes(16, "big")
        self._left = masked[len(rest) :]
        return out + masked[: len(rest)]

    def tag(self) -> bytes:
        self._absorb(self._begun + bytes(-len(self._begun) % 16))
        self._absorb((self._lengths | self._text << 3).to_bytes(16, "big"))
        return xor_bytes(self._Y.to_bytes(16, "big"), self._mask)


class GCMEncryption:
    """Ciphertext as it comes, the tag at the end."""

    def __init__(self, key: bytes, nonce: bytes, associated_data: bytes, tag_length: int) -> None:
        self._state, self._tag_length = _State(key, nonce, associated_data), tag_length

    def update(self, data: bytes) -> bytes:
        self._state.count(len(data))
        out = self._state.xor(data)
        self._state.hash(out)
        return out

    def finalize(self) -> bytes:
        return self._state.tag()[: self._tag_length]


class GCMDecryption:
    """Holds all plaintext back until the tag was right, or (`early`) only the last bytes, which may be the tag."""

    def __init__(self, key: bytes, nonce: bytes, associated_data: bytes, tag_length: int, *, early: bool) -> None:
        self._state, self._tag_length, self._early = _State(key, nonce, associated_data), tag_length, early
        self._held = b""
        self._kept: list[bytes] = []

    def update(self, data: bytes) -> bytes:
        data = self._held + data
        ready = max(0, len(data) - self._tag_length)
        ciphertext, self._held = data[:ready], data[ready:]
        self._state.count(len(ciphertext))
        self._state.hash(ciphertext)
        if self._early:
            return self._state.xor(ciphertext)
        self._kept.append(ciphertext)
        return b""

    def finalize(self) -> bytes:
        if len(self._held) < self._tag_length or not compare_digest(
            self._state.tag()[: self._tag_length], self._held
        ):
            raise InvalidTag("the message is not authentic")
        return self._state.xor(b"".join(self._kept))
