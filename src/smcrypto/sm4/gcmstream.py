"""GCM in pieces: NIST SP 800-38D, as `aead.SM4GCM` does it at once, and with the same result.

GHASH goes on where it was by XORing its state into the next block: GHASH(X_1, X_2, ...) = (...(X_1·H + X_2)·H + ...)·H.
"""

from __future__ import annotations

from hmac import compare_digest

from smcrypto.errors import InvalidTag
from smcrypto.sm4.aead import SM4GCM, inc32, require_gcm_text
from smcrypto.sm4.engine import Engine, xor_bytes
from smcrypto.sm4.foreign import ENGINE, Foreign, Opening, Sealing
from smcrypto.sm4.modes import AnyLength

__all__ = ["EarlyGCMDecryption", "GCMDecryption", "GCMEncryption"]


def _ctr32(engine: Engine, chain: bytes, data: bytes, whole: int) -> tuple[bytes, bytes]:
    """GCTR (6.5), a step for `AnyLength`: only the last 32 bits of the counter block count."""
    low = (int.from_bytes(chain[12:], "big") + whole // 16) % (1 << 32)
    return engine.ctr_xor(chain, data, 32), chain[:12] + low.to_bytes(4, "big")


class _Python:
    """One message under way, GHASH and the counter mode in Python."""

    def __init__(self, key: bytes, nonce: bytes, associated_data: bytes) -> None:
        gcm = SM4GCM(key)
        J_0 = gcm._J_0(nonce)
        self._ghash, self._mask = gcm._hashing(), gcm._engine.encrypt(J_0)
        self._xor = AnyLength(gcm._engine, _ctr32, inc32(J_0)).update
        self._Y, self._begun = 0, b""
        self._lengths = len(associated_data) << 67
        self._absorb(associated_data + bytes(-len(associated_data) % 16))

    def _absorb(self, blocks: bytes) -> None:
        if blocks:
            first = (self._Y ^ int.from_bytes(blocks[:16], "big")).to_bytes(16, "big")
            self._Y = self._ghash(first + blocks[16:])

    def _hash(self, ciphertext: bytes) -> None:
        self._lengths += len(ciphertext) << 3
        data = self._begun + ciphertext
        whole = len(data) & ~15
        self._begun = data[whole:]
        self._absorb(data[:whole])

    def seal(self, data: bytes) -> bytes:
        out = self._xor(data)
        self._hash(out)
        return out

    def open(self, data: bytes) -> bytes:
        self._hash(data)
        return self._xor(data)

    def tag(self) -> bytes:
        self._absorb(self._begun + bytes(-len(self._begun) % 16))
        self._absorb(self._lengths.to_bytes(16, "big"))
        return xor_bytes(self._Y.to_bytes(16, "big"), self._mask)

    def holds(self, T: bytes) -> bool:
        return compare_digest(self.tag()[: len(T)], T)


def _python_sealing(key: bytes, nonce: bytes, A: bytes) -> Sealing:
    state = _Python(key, nonce, A)
    return state.seal, state.tag


def _python_opening(key: bytes, nonce: bytes, A: bytes) -> Opening:
    state = _Python(key, nonce, A)
    return state.open, state.holds


def _foreign(nonce: bytes) -> Foreign | None:
    """Imported at once where it is chosen: what comes in pieces is long."""
    return ENGINE.after(1 << 30) if len(nonce) == 12 else None


class GCMEncryption:
    """Ciphertext as it comes, the tag at the end."""

    def __init__(self, key: bytes, nonce: bytes, associated_data: bytes, tag_length: int) -> None:
        foreign = _foreign(nonce)
        sealing = _python_sealing if foreign is None else foreign.sealing
        self._seal, self._tag = sealing(key, nonce, associated_data)
        self._tag_length, self._text = tag_length, 0

    def update(self, data: bytes) -> bytes:
        self._text = require_gcm_text(self._text + len(data))
        return self._seal(data)

    def finalize(self) -> bytes:
        return self._tag()[: self._tag_length]


class EarlyGCMDecryption:
    """Plaintext as it comes, not verified, all but the last bytes, which may be the tag."""

    def __init__(self, key: bytes, nonce: bytes, associated_data: bytes, tag_length: int) -> None:
        foreign = _foreign(nonce)
        opening = _python_opening if foreign is None else foreign.opening
        self._open, self._holds = opening(key, nonce, associated_data)
        self._tag_length, self._text = tag_length, 0
        self._held = b""

    def update(self, data: bytes) -> bytes:
        data = self._held + data
        ready = max(0, len(data) - self._tag_length)
        self._held = data[ready:]
        self._text = require_gcm_text(self._text + ready)
        return self._open(data[:ready])

    def finalize(self) -> bytes:
        if len(self._held) < self._tag_length or not self._holds(self._held):
            raise InvalidTag("the message is not authentic")
        return b""


class GCMDecryption:
    """Keeps all until the end: nothing is decrypted before the tag was right."""

    def __init__(self, key: bytes, nonce: bytes, associated_data: bytes, tag_length: int) -> None:
        self._gcm, self._nonce, self._associated_data = SM4GCM(key, tag_length), nonce, associated_data
        self._pieces: list[bytes] = []

    def update(self, data: bytes) -> bytes:
        self._pieces.append(data)
        return b""

    def finalize(self) -> bytes:
        return self._gcm.decrypt(self._nonce, b"".join(self._pieces), self._associated_data)
