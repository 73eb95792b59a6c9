"""Keys from secrets: the key schedule of TLS 1.3 (RFC 8446, 7.1) and the PRF of TLCP (GB/T 38636-2020, 5.2), with SM3.

All secrets of TLS 1.3 are 32 bytes, the length of SM3's output, so HKDF-Expand never needs a second block.
"""

from __future__ import annotations

from typing import Final

from smcrypto import sm3

__all__ = ["EMPTY_HASH", "derive_secret", "expand_label", "extract", "finished_mac", "next_stage", "prf", "updated"]

EMPTY_HASH: Final = sm3.digest(b"")


def extract(salt: bytes, key: bytes) -> bytes:
    """HKDF-Extract: 32 bytes (RFC 5869, 2.2)."""
    return sm3.hmac(salt, key)


def expand_label(secret: bytes, label: bytes, context: bytes, length: int) -> bytes:
    """HKDF-Expand-Label, at most 32 bytes (RFC 8446, 7.1)."""
    label = b"tls13 " + label
    info = length.to_bytes(2, "big") + bytes([len(label)]) + label + bytes([len(context)]) + context
    return sm3.hmac(secret, info + b"\x01")[:length]


def derive_secret(secret: bytes, label: bytes, transcript_hash: bytes) -> bytes:
    """Derive-Secret, the hash of the messages being given (RFC 8446, 7.1)."""
    return expand_label(secret, label, transcript_hash, 32)


def next_stage(secret: bytes, key: bytes) -> bytes:
    """The secret of the next stage, with `key` taken in (RFC 8446, 7.1): Early, Handshake, Master."""
    return extract(derive_secret(secret, b"derived", EMPTY_HASH), key)


def updated(secret: bytes) -> bytes:
    """The traffic secret that follows a KeyUpdate (RFC 8446, 7.2)."""
    return expand_label(secret, b"traffic upd", b"", 32)


def finished_mac(secret: bytes, transcript_hash: bytes) -> bytes:
    """verify_data of Finished, and the binder of a pre-shared key (RFC 8446, 4.4.4 and 4.2.11.2)."""
    return sm3.hmac(expand_label(secret, b"finished", b"", 32), transcript_hash)


def prf(secret: bytes, label: bytes, seed: bytes, length: int) -> bytes:
    """PRF = P_SM3(secret, label || seed), `length` bytes (GB/T 38636-2020, 5.2; RFC 5246, 5)."""
    seed = label + seed
    A, output = seed, b""
    while len(output) < length:
        A = sm3.hmac(secret, A)
        output += sm3.hmac(secret, A + seed)
    return output[:length]
