"""SM3, the 256-bit hash function of GB/T 32905-2016, under the protocol of hashlib; and HMAC-SM3.

Two engines compute it. ENGINE is "openssl" where the standard library's own `hashlib` offers SM3 (about two
hundred times as fast), and "python" where it does not, or where the environment has SMCRYPTO_PURE=1 when
this module is first imported. They give the same results; the one that is not used is not loaded.

A message has fewer than 2^64 bits (5.2); there is no other limit.
"""

from __future__ import annotations

import hashlib
import hmac as _hmac
import os
from contextlib import suppress
from typing import TYPE_CHECKING, ClassVar, Protocol

from smcrypto.inputs import BytesLike, as_bytes

if TYPE_CHECKING:
    from typing_extensions import Self

__all__ = ["ENGINE", "SM3", "digest", "hmac", "new"]


class _Hash(Protocol):
    """What is used of an engine's hash object; hashlib's fit it."""

    def update(self, data: bytes, /) -> None: ...
    def digest(self) -> bytes: ...
    def copy(self) -> Self: ...


def _choose(pure: bool) -> tuple[str, _Hash]:
    """(name, hash object of the empty message) of the engine to use.

    hashlib's is made rather than looked up: `hashlib.algorithms_available` names what the linked OpenSSL knows, not
    what its configuration lets a program use. `usedforsecurity=False` would get round such a configuration,
    and is not ours to say.
    """
    if not pure:
        with suppress(ValueError):
            return "openssl", hashlib.new("sm3")
    from smcrypto._sm3_python import PythonSM3

    return "python", PythonSM3()


#: "openssl" or "python": what computes SM3 in this process.
ENGINE: str
#: The engine's state before any input; every hash starts as its copy, twice as fast as hashlib.new.
_EMPTY: _Hash
ENGINE, _EMPTY = _choose(os.environ.get("SMCRYPTO_PURE") == "1")


def _started(data: bytes) -> _Hash:
    """A hash object of the engine that has taken `data` in: what loops copy instead of hashing again."""
    state = _EMPTY.copy()
    state.update(data)
    return state


class SM3:
    """A running SM3 hash; the protocol is hashlib's, so `hmac.new(key, message, SM3)` works.

    data: any bytes-like object, hashed at once. Source: GB/T 32905-2016.

    >>> SM3(b"abc").hexdigest()
    '66c7f0f462eeedd9d1f2d46bdc10e4e24167c4875cf2f7a2297da02b8f4ba8e0'
    """

    __slots__ = ("_state",)

    name: ClassVar[str] = "sm3"
    digest_size: ClassVar[int] = 32
    block_size: ClassVar[int] = 64

    def __init__(self, data: BytesLike = b"") -> None:
        self._state = _started(as_bytes(data, "data"))

    def update(self, data: BytesLike, /) -> None:
        """Append `data` to the message; as often as one likes, also after `digest`."""
        self._state.update(as_bytes(data, "data"))

    def digest(self) -> bytes:
        """The hash of what came so far: 32 bytes. The object stays usable."""
        return self._state.digest()

    def hexdigest(self) -> str:
        """`digest` as 64 lower-case hexadecimal digits."""
        return self._state.digest().hex()

    def copy(self) -> SM3:
        """An independent hash object that has seen the same message."""
        other = SM3.__new__(SM3)
        other._state = self._state.copy()
        return other

    __copy__ = copy

    def __deepcopy__(self, memo: object) -> SM3:
        return self.copy()

    def __repr__(self) -> str:
        return f"<SM3 hash ({ENGINE})>"


def new(data: BytesLike = b"") -> SM3:
    """`SM3(data)`; with it the module itself serves as `digestmod` of `hmac.new`."""
    return SM3(data)


def digest(data: BytesLike) -> bytes:
    """The SM3 hash of `data`: 32 bytes.

    >>> digest(b"").hex()[:16]
    '1ab21d8355cfa17f'
    """
    state = _EMPTY.copy()  # written out, not `_started`: a call less is a tenth of a short message's time
    state.update(data if type(data) is bytes else as_bytes(data, "data"))
    return state.digest()


def hmac(key: BytesLike, data: BytesLike) -> bytes:
    """HMAC-SM3 of `data`: 32 bytes. A key may have any length; above 64 bytes its hash stands for it.

    Compare a received tag with `hmac.compare_digest` of the standard library, never with ==. For messages
    that arrive in pieces use `hmac.new(key, digestmod=sm3.SM3)` of the standard library.
    Source: RFC 2104; GM/T 0042-2015, annex D has vectors.

    >>> hmac(b"Jefe", b"what do ya want for nothing?").hex()[:16]
    '2e87f1d16862e6d9'
    """
    key = as_bytes(key, "key")
    data = as_bytes(data, "data")
    if ENGINE == "openssl" and len(key) <= _INT_MAX and len(data) <= _INT_MAX:
        return _hmac.digest(key, data, "sm3")
    inner, outer = _keyed(key)
    inner.update(data)
    outer.update(inner.digest())
    return outer.digest()


_INT_MAX = 2**31 - 1  # of what OpenSSL counts in a C int
_IPAD = bytes(x ^ 0x36 for x in range(256))
_OPAD = bytes(x ^ 0x5C for x in range(256))


def _keyed(key: bytes) -> tuple[_Hash, _Hash]:
    """The inner and the outer hash of HMAC with the padded key taken in (RFC 2104, 2)."""
    if len(key) > SM3.block_size:
        key = digest(key)
    block = key.ljust(SM3.block_size, b"\0")
    return _started(block.translate(_IPAD)), _started(block.translate(_OPAD))
