"""Message authentication by a chain of SM4 blocks: CMAC and CBC-MAC, GB/T 15852.1-2020 (ISO/IEC 9797-1).

CMAC is MAC algorithm 5 there, NIST SP 800-38B and RFC 4493: for messages of any length. CBC-MAC is MAC algorithm 1, for
formats that name it. Compare tags by `hmac.compare_digest` of the standard library, never by ==.
"""

from __future__ import annotations

from typing import Literal

from smcrypto.errors import InvalidLength, InvalidOption
from smcrypto.inputs import BytesLike, as_bytes, require_int
from smcrypto.sm4.engine import Engine, xor_bytes

__all__ = ["cbc_mac", "cmac"]

_ZERO = bytes(16)


def cmac(key: BytesLike, data: BytesLike, *, length: int = 16) -> bytes:
    """CMAC of `data`, of any length: `length` bytes.

    key: 16 bytes, otherwise InvalidKey; for CMAC alone. length: 8 to 16, otherwise InvalidLength (SP 800-38B, A.2:
    64 bits at least). Source: NIST SP 800-38B, 6.2; GB/T 15852.1-2020, MAC algorithm 5.

    >>> cmac(bytes.fromhex("0123456789abcdeffedcba9876543210"), b"This is the test message ").hex()
    '4738a6c760b280fc0c8a8af3886e9f5d'
    """
    engine, M, size = _checked(key, data, length)
    subkey = _doubled(engine.encrypt(_ZERO))  # K1
    whole = max(0, -(-len(M) // 16) - 1) * 16
    last = M[whole:]
    if len(last) < 16:
        last, subkey = _padded(last), _doubled(subkey)  # K2
    return engine.cbc_encrypt(_ZERO, M[:whole] + xor_bytes(last, subkey))[-16:][:size]


def cbc_mac(
    key: BytesLike, data: BytesLike, *, padding: Literal["zeros", "iso7816"] | None = "iso7816", length: int = 16
) -> bytes:
    """CBC-MAC of `data`: the last block of its CBC encryption from a zero IV, `length` bytes of it.

    key: 16 bytes, otherwise InvalidKey; for this alone, and never for CBC encryption. padding: "iso7816" (method 2, a
    bit and zeros), "zeros" (method 1: data that ends in zeros is not told from shorter data), or None for whole
    blocks, one at least; otherwise InvalidOption or InvalidLength. length: 4 to 16, otherwise InvalidLength.

    Only for messages of one length, or whose length stands in their first block: of others, who has the MACs of two
    can make that of a third. Where nothing names CBC-MAC, take `cmac`. Source: GB/T 15852.1-2020, MAC algorithm 1.
    """
    engine, M, size = _checked(key, data, length, least=4)
    if padding == "iso7816":
        M += _padded(b"" if len(M) % 16 == 0 else M[-(len(M) % 16) :])[len(M) % 16 :]
    elif padding == "zeros":
        M += bytes(-len(M) % 16) if M else _ZERO
    elif padding is not None:
        raise InvalidOption('padding must be None, "zeros" or "iso7816"')
    elif len(M) % 16 or not M:
        raise InvalidLength("without padding the data must be a multiple of 16 bytes, and not empty")
    return engine.cbc_encrypt(_ZERO, M)[-16:][:size]


def _checked(key: BytesLike, data: BytesLike, length: int, *, least: int = 8) -> tuple[Engine, bytes, int]:
    if not least <= require_int(length, "length") <= 16:
        raise InvalidLength(f"length must be {least} to 16 bytes, not {length}")
    return Engine(as_bytes(key, "key")), as_bytes(data, "data"), length


def _padded(rest: bytes) -> bytes:
    """An incomplete block, a bit, and zeros: method 2 of GB/T 15852.1-2020, 6.3.3."""
    return (rest + b"\x80").ljust(16, b"\0")


def _doubled(block: bytes) -> bytes:
    """Times x in GF(2^128), x^128 = x^7 + x^2 + x + 1: SP 800-38B, 6.1."""
    number = int.from_bytes(block, "big") << 1
    return (number ^ (number >> 128) * (1 << 128 | 0x87)).to_bytes(16, "big")
