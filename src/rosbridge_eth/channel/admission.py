"""Cookies, by which a stranger shows that it receives at its address, and token buckets, which bound a rate."""

from __future__ import annotations

import hmac
from hashlib import blake2s

from rosbridge_eth.channel.wire import COOKIE_SIZE, Hello

Address = tuple[str, int]
"""Host and port. More that a socket may add (flow label, scope) is kept out of it by the shell."""


class Cookies:
    """Cookies under one 32-byte key.

    A cookie is the time (8 bytes, ms) and a keyed hash of it, the address, and the HELLO's fields.
    """

    def __init__(self, key: bytes, lifetime: float) -> None:
        self._key = blake2s(b"cookie", key=key).digest()
        self.lifetime = lifetime

    def _hash(self, stamp: bytes, address: Address, hello: Hello) -> bytes:
        place = f"{address[0]} {address[1]}".encode()
        bound = stamp + bytes((hello.mode,)) + hello.client_cid + hello.nonce + place
        return blake2s(bound, key=self._key, digest_size=COOKIE_SIZE - 8).digest()

    def make(self, address: Address, hello: Hello, now: float) -> bytes:
        stamp = int(now * 1000).to_bytes(8, "big")
        return stamp + self._hash(stamp, address, hello)

    def holds(self, cookie: bytes, address: Address, hello: Hello, now: float) -> bool:
        stamp = cookie[:8]
        age = now - int.from_bytes(stamp, "big") / 1000
        return -0.001 <= age <= self.lifetime and hmac.compare_digest(cookie[8:], self._hash(stamp, address, hello))


class TokenBucket:
    """`rate` tokens a second, at most `burst` saved up. May be charged below zero, and then waits longer."""

    def __init__(self, rate: float, burst: float, now: float) -> None:
        self.rate, self.burst, self.level, self._at = rate, burst, burst, now

    def available(self, now: float) -> float:
        if now > self._at:
            self.level = min(self.burst, self.level + (now - self._at) * self.rate)
            self._at = now
        return self.level

    def ready_at(self) -> float:
        """When `available` will be above zero, if nothing is charged until then; to be asked after `available`.

        Rounded up, since a timer that fires too early would find nothing to do.
        """
        return self._at + max(0.0, -self.level) / self.rate + 1e-4

    def charge(self, amount: float) -> None:
        self.level = min(self.burst, self.level - amount)
