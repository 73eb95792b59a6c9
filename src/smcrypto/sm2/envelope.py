"""A private key sealed for another SM2 key: SM2EnvelopedKey, GM/T 0009-2012, 7.4 (GB/T 35276-2017, 7.4).

This is how a CA hands out the key pair that it made for encryption (GM/T 0014, GM/T 0092):

    SEQUENCE { symAlgID AlgorithmIdentifier, symEncryptedKey SM2Cipher,
               sm2PublicKey BIT STRING, sm2EncryptedPrivateKey BIT STRING }

d is encrypted in 32 bytes by SM4-ECB without padding, on which the standard is silent; it is what is written elsewhere.
ECB does not detect changes: that d belongs to the public key beside it is checked instead.
"""

from __future__ import annotations

import secrets
from hmac import compare_digest
from typing import Final

from smcrypto import der
from smcrypto.errors import InvalidEncoding, InvalidKey
from smcrypto.sm2.keyfiles import standard_point
from smcrypto.sm2.keys import PrivateKey, PublicKey

__all__ = ["open_key", "seal_key"]

# SM4 and SM4-ECB, GM/T 0006; parameters NULL or absent.
_ALGORITHMS: Final = ("1.2.156.10197.1.104.1", "1.2.156.10197.1.104")


def seal_key(key: PrivateKey, recipient: PublicKey) -> bytes:
    """`key` for the holder of `recipient`'s private key, in DER."""
    from smcrypto import sm4

    point = standard_point(key.public_key)
    symmetric = secrets.token_bytes(16)
    return der.sequence(
        der.sequence(der.oid(_ALGORITHMS[0]), der.null()),
        recipient.encrypt(symmetric),
        der.bit_string(point),
        der.bit_string(sm4.encrypt(symmetric, sm4.ECB(), key.to_bytes())),
    )


def open_key(data: bytes, key: PrivateKey) -> PrivateKey:
    """The private key that was sealed for `key`; InvalidKey for what is malformed.

    InvalidCiphertext: sealed for another key. InvalidKey also where what was sealed is not the key beside it.
    """
    from smcrypto import sm4

    try:
        with der.reading_sequence(data) as members:
            algorithm = members.sequence()
            name = algorithm.oid()
            if name not in _ALGORITHMS:
                raise InvalidEncoding(f"the key is encrypted by {name}, not by SM4 in ECB mode")
            if not algorithm.at_end():
                algorithm.null()
            sealed = members.raw()
            point, ciphertext = members.bit_string(), members.bit_string()
        if len(ciphertext) != 32:
            raise InvalidEncoding(f"the encrypted private key has {len(ciphertext)} bytes, not 32")
    except InvalidEncoding as error:
        raise InvalidKey(f"not an SM2EnvelopedKey: {error}") from None
    public = PublicKey.from_bytes(point)
    symmetric = key.decrypt(sealed)
    if len(symmetric) == 16:
        d = int.from_bytes(sm4.decrypt(symmetric, sm4.ECB(), ciphertext), "big")
        if 1 <= d <= public.curve.n - 2:
            found = PrivateKey(d)
            if compare_digest(found.public_key.to_bytes(), public.to_bytes()):
                return found
    raise InvalidKey("what was sealed is not the private key of the public key beside it")
