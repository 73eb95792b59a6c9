"""SM2, public key cryptography on elliptic curves: GB/T 32918-2016/2017."""

from __future__ import annotations

from smcrypto.sm2.curve import SM2P256V1, Curve
from smcrypto.sm2.exchange import KeyExchange
from smcrypto.sm2.keys import PrivateKey, PublicKey
from smcrypto.sm2.signature import DEFAULT_UID

__all__ = ["DEFAULT_UID", "SM2P256V1", "Curve", "KeyExchange", "PrivateKey", "PublicKey"]
