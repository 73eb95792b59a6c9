"""Key derivation with SM3: the KDF of SM2 (GB/T 32918.4-2016, 5.4.3), HKDF (RFC 5869), PBKDF2 (RFC 8018).

All take bytes and give bytes; lengths are in bytes. Which for what: `sm2_kdf` is a part of SM2 encryption
and key exchange; `hkdf` makes several keys of one good secret; `pbkdf2_hmac` makes a key of a password.
"""

from __future__ import annotations

import hashlib
import struct

from smcrypto import sm3
from smcrypto.errors import InvalidLength, InvalidOption
from smcrypto.inputs import BytesLike, as_bytes, require_int

__all__ = ["hkdf", "pbkdf2_hmac", "sm2_kdf"]

_HASH = sm3.SM3.digest_size
_SM2_LIMIT = _HASH * (2**32 - 1)
_HKDF_LIMIT = 255 * _HASH


def sm2_kdf(z: BytesLike, length: int) -> bytes:
    """Derive `length` bytes from the shared secret `z`.

    length: in bytes, 0 or more and below 32·(2^32 - 1); otherwise InvalidLength.
    The output may be all zero: GB/T 32918.4, 6.1 A5 and 7.1 B4 make the caller
    refuse it. Source: GB/T 32918.4-2016, 5.4.3 (the KDF of X9.63 with SM3).

    >>> len(sm2_kdf(b"shared secret", 40))
    40
    """
    z = as_bytes(z, "z")
    if not 0 <= require_int(length, "length") < _SM2_LIMIT:
        raise InvalidLength(f"length must be 0 or more and below 32·(2^32 - 1) bytes, not {length}")
    hashed = sm3._started(z)
    output = []
    for ct in range(1, (length + _HASH - 1) // _HASH + 1):
        H = hashed.copy()
        H.update(ct.to_bytes(4, "big"))
        output.append(H.digest())
    return b"".join(output)[:length]


def hkdf(key: BytesLike, length: int, *, salt: BytesLike = b"", info: BytesLike = b"") -> bytes:
    """Derive `length` bytes from the input keying material `key`: HKDF-SM3, extract then expand.

    key: a secret with enough entropy, any length; not a password. salt: any length; b"" stands for 32 zero
    bytes, as the RFC says. info: what the derived key is for. length: 0 ... 8,160 bytes (255 hashes),
    otherwise InvalidLength. Source: RFC 5869.
    """
    IKM, salt, info = as_bytes(key, "key"), as_bytes(salt, "salt"), as_bytes(info, "info")
    if not 0 <= require_int(length, "length") <= _HKDF_LIMIT:
        raise InvalidLength(f"length must be 0 ... {_HKDF_LIMIT} bytes, not {length}")
    PRK = sm3.hmac(salt, IKM)
    T, output = b"", []
    for i in range(1, (length + _HASH - 1) // _HASH + 1):
        T = sm3.hmac(PRK, T + info + bytes([i]))
        output.append(T)
    return b"".join(output)[:length]


def pbkdf2_hmac(password: BytesLike, salt: BytesLike, iterations: int, length: int) -> bytes:
    """Derive `length` bytes from a password: PBKDF2 with HMAC-SM3.

    password, salt: any length (a salt of 16 random bytes is usual). iterations: 1 ... 2^31 - 1, otherwise
    InvalidOption; the cost grows with it. length: 1 ... 2^31 - 1 bytes, otherwise InvalidLength. (The RFC
    allows lengths to 32·(2^32 - 1); OpenSSL counts both in a C int.) Source: RFC 8018, 5.2.

    >>> pbkdf2_hmac(b"passwd", b"salt", 1, 8).hex()
    '30530b86537c85ea'
    """
    password, salt = as_bytes(password, "password"), as_bytes(salt, "salt")
    if not 1 <= require_int(iterations, "iterations") <= sm3._INT_MAX:
        raise InvalidOption(f"iterations must be 1 ... 2^31 - 1, not {iterations}")
    if not 1 <= require_int(length, "length") <= sm3._INT_MAX:
        raise InvalidLength(f"length must be 1 ... 2^31 - 1 bytes, not {length}")
    if sm3.ENGINE == "openssl":
        return hashlib.pbkdf2_hmac("sm3", password, salt, iterations, length)
    return _pbkdf2_python(password, salt, iterations, length)


def _pbkdf2_python(P: bytes, S: bytes, c: int, dkLen: int) -> bytes:
    """RFC 8018, 5.2 on SM3's state words; an iteration is two compressions, nothing is packed between them.

    Names are the RFC's. In U_2, U_3, ... both hashes of HMAC end with one block: the 32 bytes of a hash,
    and the padding of a message that was one block (the padded key) and 32 bytes long.
    """
    from smcrypto._sm3_compression import IV, compress, compress_bytes, expand_one

    if len(P) > 64:
        P = sm3.digest(P)
    block = P.ljust(64, b"\0")
    inner = compress_bytes(IV, bytes(x ^ 0x36 for x in block), 1)
    outer = compress_bytes(IV, bytes(x ^ 0x5C for x in block), 1)
    padding = (0x80000000, 0, 0, 0, 0, 0, 0, 8 * (64 + 32))
    output = []
    for i in range(1, (dkLen + _HASH - 1) // _HASH + 1):
        U = struct.unpack(">8I", sm3.hmac(P, S + i.to_bytes(4, "big")))
        T = U
        for _ in range(c - 1):
            U = compress(inner, (expand_one(U + padding),))
            U = compress(outer, (expand_one(U + padding),))
            T = tuple(t ^ u for t, u in zip(T, U, strict=True))
        output.append(struct.pack(">8I", *T))
    return b"".join(output)[:dkLen]
