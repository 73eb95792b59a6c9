"""SM2, public key cryptography on an elliptic curve: GB/T 32918-2016/2017, GM/T 0009-2012.

`PrivateKey` signs and decrypts, `PublicKey` verifies and encrypts, `KeyExchange` makes a
key with a peer. Signing takes a uid, the signer's distinguishing identifier; where
signer and verifier have agreed on none it is DEFAULT_UID.

    curve        the curve as a value, points and their encodings
    points       arithmetic: doublings, additions, combs, windows
    known_keys   which public keys have earned a comb
    nonces       the secret k of signing and encrypting
    signature, encryption, exchange    the three algorithms
    keys, keyfiles                     keys as objects and as files

What pure Python cannot promise: the time of an integer operation depends on its operands,
memory that held a secret is not wiped, and which entry of a table is read can show in the
caches that other programs on the machine share. What is done about it: the sequence of
operations on a secret scalar is the same for all scalars, every such computation begins
with a random factor (a random Z) so that its operands cannot be predicted or averaged over, and
inverses are taken behind a random factor. Do not sign where an attacker can
run code on the same processor core or measure single operations.
"""

from __future__ import annotations

from smcrypto.sm2.curve import SM2P256V1
from smcrypto.sm2.exchange import KeyExchange
from smcrypto.sm2.keys import PrivateKey, PublicKey
from smcrypto.sm2.signature import DEFAULT_UID

__all__ = ["DEFAULT_UID", "SM2P256V1", "KeyExchange", "PrivateKey", "PublicKey"]
