"""The secret k of signing and encrypting, drawn so that a broken random source does not give the key away.

GB/T 32918.2, 6.1 A3 and .4, 6.1 A1 want k random in [1, n-1]. A k that repeats, or
that can be guessed, reveals the signing key. So, in the manner of RFC 6979 with
the additional randomness of its section 3.6, k is

    KDF(label || secret || R || digest || j) mod (n - 1) + 1,

KDF being the standard's (SM3 in counter mode, 512 bits, so that the bias of the
reduction is below 2^-250), R 32 fresh random bytes, j the number of the attempt.
While R is good, k is uniform whatever the rest. If R is constant, k is a function
of key and message that nobody without the key can evaluate, and differs between
messages, as in deterministic signing. Encryption has no secret to give, and gives
the public key: with R constant, who guesses a message can make sure that it is this one.
"""

from __future__ import annotations

import secrets
from collections.abc import Callable, Iterator

from smcrypto.kdf import sm2_kdf

__all__ = ["hedged_nonces"]


def hedged_nonces(
    n: int, label: bytes, secret: bytes, digest: bytes, *, entropy: Callable[[int], bytes] = secrets.token_bytes
) -> Iterator[int]:
    """Candidates for k in [1, n-1], without end; the first one nearly always serves."""
    attempt = 0
    while True:
        seed = label + secret + entropy(32) + digest + attempt.to_bytes(2, "big")
        yield int.from_bytes(sm2_kdf(seed, 64), "big") % (n - 1) + 1
        attempt += 1
