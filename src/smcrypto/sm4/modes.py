"""Modes of operation for SM4, GB/T 17964-2021: ECB, CBC, CFB, OFB, CTR, XTS; and GCM in pieces (SP 800-38D).

A mode is an immutable value; it says how, never what with. `Cipher` joins it
with a key and opens streams; `encrypt` and `decrypt` do the whole in one call.
CFB is the 128-bit one. XTS lives in its own file.

Of these only GCM detects a change. New designs want SM4GCM (aead), which does
it in one call; CCM is there too.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, field
from typing import Literal, NoReturn, Protocol, TypeAlias

from smcrypto.errors import AlreadyFinalized, InvalidKey, InvalidLength, InvalidOption, InvalidPadding, OutOfOrder
from smcrypto.inputs import BytesLike, KeyHolder, as_bytes, as_exact_bytes, require_int
from smcrypto.sm4.engine import Engine, xor_bytes
from smcrypto.sm4.xts import Variant, XTSStream

__all__ = [
    "CBC", "CFB", "CTR", "ECB", "GCM", "OFB", "XTS", "Cipher", "CipherStream", "Mode", "Padding", "decrypt", "encrypt",
]  # fmt: skip

Padding: TypeAlias = Literal["pkcs7", "iso7816", "zeros"] | None

_PIECE = 1 << 20  # bytes worked on at once: some modes keep several copies of them, and longer is no faster


@dataclass(frozen=True, slots=True)
class ECB:
    """Electronic codebook: every block on its own, so equal blocks show. For key wrapping and tests, not messages."""


@dataclass(frozen=True, slots=True, init=False)
class _WithIV:
    iv: bytes

    def __init__(self, iv: BytesLike) -> None:
        object.__setattr__(self, "iv", as_exact_bytes(iv, "iv", 16))


class CBC(_WithIV):
    """Cipher block chaining. iv: 16 bytes, unpredictable and never used twice with one key; otherwise InvalidLength."""

    __slots__ = ()


class CFB(_WithIV):
    """Cipher feedback over whole blocks (CFB-128).

    iv: 16 bytes, never used twice with one key; otherwise InvalidLength.
    """

    __slots__ = ()


class OFB(_WithIV):
    """Output feedback. iv: 16 bytes, never used twice with one key; otherwise InvalidLength."""

    __slots__ = ()


@dataclass(frozen=True, slots=True, init=False)
class CTR:
    """Counter mode. nonce: the first counter block, 16 bytes; otherwise InvalidLength.

    The counter is the whole block, big-endian, and wraps from 2**128 - 1 to 0.
    No two messages under one key may use the same counter value.
    """

    nonce: bytes

    def __init__(self, nonce: BytesLike) -> None:
        object.__setattr__(self, "nonce", as_exact_bytes(nonce, "nonce", 16))


@dataclass(frozen=True, slots=True, init=False)
class XTS:
    """XTS for storage, with ciphertext stealing; takes a 32-byte key and data of at least 16 bytes.

    tweak: 16 bytes, the number of the data unit; otherwise InvalidLength.
    variant: "gb" doubles the tweak as GB/T 17964-2021 does, "ieee" as IEEE
    1619-2018; they differ from the second block on.
    """

    tweak: bytes
    variant: Variant = "gb"

    def __init__(self, tweak: BytesLike, variant: Variant = "gb") -> None:
        object.__setattr__(self, "tweak", as_exact_bytes(tweak, "tweak", 16))
        if variant not in ("gb", "ieee"):
            raise InvalidOption('variant must be "gb" or "ieee"')
        object.__setattr__(self, "variant", variant)


@dataclass(frozen=True, slots=True, init=False)
class GCM:
    """Galois/Counter Mode for a message in pieces; the ciphertext ends with the tag, as `SM4GCM` has it.

    nonce: 1 byte or more, 12 are usual, never used twice with one key. associated_data: authenticated, not
    contained. tag_length: 12 to 16. InvalidLength otherwise. One object serves one encryption, the second is
    OutOfOrder, and any number of decryptions.
    """

    nonce: bytes
    associated_data: bytes = b""
    tag_length: int = 16
    _unused: list[bool] = field(init=False, repr=False, compare=False)

    def __init__(self, nonce: BytesLike, associated_data: BytesLike = b"", tag_length: int = 16) -> None:
        octets = as_bytes(nonce, "nonce")
        if not octets:
            raise InvalidLength("nonce must be 1 byte or more")
        if not 12 <= require_int(tag_length, "tag_length") <= 16:
            raise InvalidLength(f"tag_length must be 12 to 16 bytes, not {tag_length}")
        object.__setattr__(self, "nonce", octets)
        object.__setattr__(self, "associated_data", as_bytes(associated_data, "associated_data"))
        object.__setattr__(self, "tag_length", tag_length)
        object.__setattr__(self, "_unused", [True])

    def __deepcopy__(self, memo: object) -> GCM:
        """Itself: a copy with a record of its own would encrypt with the nonce once more."""
        return self

    def _take(self) -> None:
        """For an encryption: once. (A list's pop is one step, whatever the threads.)"""
        try:
            self._unused.pop()
        except IndexError:
            raise OutOfOrder("this GCM object has encrypted; take a new one, with another nonce") from None


Mode: TypeAlias = ECB | CBC | CFB | OFB | CTR | XTS | GCM


class _Transform(Protocol):
    """What a mode does with a stream of bytes, in one direction."""

    def update(self, data: bytes) -> bytes: ...

    def finalize(self) -> bytes: ...


# What a mode does to blocks: (engine, chain, data, whole) -> (image of the data, the chain after its first `whole`
# bytes). The chain is a block: the IV or the counter at first. Data is whole blocks; of the last, a part may be zeros
# that stand for what has not come yet, and then `whole` ends before it.
_Step: TypeAlias = Callable[[Engine, bytes, bytes, int], tuple[bytes, bytes]]


def _ecb_encrypt(engine: Engine, chain: bytes, data: bytes, whole: int) -> tuple[bytes, bytes]:
    return engine.encrypt(data), chain


def _ecb_decrypt(engine: Engine, chain: bytes, data: bytes, whole: int) -> tuple[bytes, bytes]:
    return engine.decrypt(data), chain


def _cbc_encrypt(engine: Engine, chain: bytes, data: bytes, whole: int) -> tuple[bytes, bytes]:
    out = engine.cbc_encrypt(chain, data)
    return out, (chain + out[-16:])[-16:]


def _cbc_decrypt(engine: Engine, chain: bytes, data: bytes, whole: int) -> tuple[bytes, bytes]:
    before = chain + data
    return engine.decrypt(data, before[: len(data)]), before[-16:]


def _cfb_encrypt(engine: Engine, chain: bytes, data: bytes, whole: int) -> tuple[bytes, bytes]:
    """C_i = P_i ^ D_i with D_i = E(C_(i-1)) = E(P_(i-1) ^ D_(i-1)): D is CBC of C_0, P_1, P_2, ... from zero on."""
    before = chain + data
    out = xor_bytes(engine.cbc_encrypt(bytes(16), before[: len(data)]), data)
    return out, out[whole - 16 : whole] if whole else chain


def _cfb_decrypt(engine: Engine, chain: bytes, data: bytes, whole: int) -> tuple[bytes, bytes]:
    before = chain + data
    return engine.encrypt(before[: len(data)], data), before[whole : whole + 16]


def _ofb(engine: Engine, chain: bytes, data: bytes, whole: int) -> tuple[bytes, bytes]:
    """O_i = E(O_(i-1)): CBC of zeros."""
    stream = engine.cbc_encrypt(chain, bytes(len(data)))
    return xor_bytes(data, stream), stream[whole - 16 : whole] if whole else chain


def _ctr(engine: Engine, chain: bytes, data: bytes, whole: int) -> tuple[bytes, bytes]:
    counter = (int.from_bytes(chain, "big") + whole // 16) % (1 << 128)
    return engine.ctr_xor(chain, data), counter.to_bytes(16, "big")


class _WholeBlocks:
    """ECB and CBC: keeps an incomplete block back, and the last one where it ends in padding to be removed."""

    def __init__(self, engine: Engine, step: _Step, chain: bytes, padding: Padding, *, encrypting: bool) -> None:
        self._engine, self._step, self._chain = engine, step, chain
        self._padding, self._encrypting = padding, encrypting
        self._pending = b""

    def update(self, data: bytes) -> bytes:
        data = self._pending + data
        held = self._padding is not None and not self._encrypting
        whole = max(0, len(data) - held) & ~15
        self._pending = data[whole:]
        return self._crypt(data[:whole])

    def _crypt(self, blocks: bytes) -> bytes:
        out, self._chain = self._step(self._engine, self._chain, blocks, len(blocks))
        return out

    def finalize(self) -> bytes:
        last, padding = self._pending, self._padding
        if padding is None:
            if last:
                raise InvalidLength("without padding the data must be a multiple of 16 bytes")
            return b""
        if self._encrypting:
            return self._crypt(last + _ending(padding, 16 - len(last)))
        if len(last) % 16 or (not last and padding != "zeros"):
            raise InvalidPadding("the padding is malformed")
        last = self._crypt(last)
        if padding == "zeros":
            return last.rstrip(b"\0")
        return remove_pkcs7(last) if padding == "pkcs7" else remove_iso7816(last)


def _ending(padding: str, count: int) -> bytes:
    """What fills up a block in which `count` bytes are left; 16 where the data ends with a block."""
    if padding == "pkcs7":  # RFC 5652, 6.3: 1 to 16 bytes, each saying how many
        return bytes([count]) * count
    if padding == "iso7816":  # ISO/IEC 7816-4; method 2 of GB/T 15852.1
        return b"\x80" + bytes(count - 1)
    return bytes(count % 16)


class AnyLength:
    """CFB, OFB and CTR: out = in XOR mask. A block that was begun is done again, whole, once the rest has come."""

    def __init__(self, engine: Engine, step: _Step, chain: bytes) -> None:
        self._engine, self._step, self._chain = engine, step, chain
        self._begun = self._mask = b""  # what came of the block, and the mask for what has not

    def update(self, data: bytes) -> bytes:
        begun = len(self._begun)
        if begun and len(data) < len(self._mask):
            mask, self._mask = self._mask[: len(data)], self._mask[len(data) :]
            self._begun += data
            return xor_bytes(data, mask)
        data = self._begun + data
        whole = len(data) & ~15
        out, self._chain = self._step(self._engine, self._chain, data + bytes(-len(data) % 16), whole)
        self._begun, self._mask = data[whole:], out[len(data) :]
        return out[begun : len(data)]

    def finalize(self) -> bytes:
        return b""


def remove_pkcs7(block: bytes) -> bytes:
    """The last block without its padding, or InvalidPadding; looks at all 16 bytes whatever it finds."""
    count = block[15]
    wrong = int(count == 0) | int(count > 16)
    for i in range(16):
        inside = int(i < count)
        wrong |= inside * (block[15 - i] ^ count)
    if wrong:
        raise InvalidPadding("the padding is malformed")
    return block[: 16 - count]


def remove_iso7816(block: bytes) -> bytes:
    """The last block before 80 and zeros, or InvalidPadding; looks at all 16 bytes whatever it finds."""
    length, searching = 0, 1
    for i in range(15, -1, -1):
        marker = searching & int(block[i] == 0x80)
        length |= marker * (i + 1)
        searching &= int(block[i] == 0)
    if not length:
        raise InvalidPadding("the padding is malformed")
    return block[: length - 1]


class CipherStream:
    """One encryption or decryption under way; made by `Cipher.encryptor()` and `Cipher.decryptor()`.

    The outputs of all `update` calls and of `finalize`, joined, do not depend
    on how the data was cut.
    """

    __slots__ = ("_transform",)

    def __init__(self, transform: _Transform) -> None:
        self._transform: _Transform | None = transform

    def update(self, data: BytesLike) -> bytes:
        """Take more data, return what is ready; after `finalize`, AlreadyFinalized."""
        data = as_bytes(data, "data")
        if self._transform is None:
            raise AlreadyFinalized("this stream was finalized")
        if len(data) <= _PIECE:
            return self._transform.update(data)
        return b"".join([self._transform.update(data[i : i + _PIECE]) for i in range(0, len(data), _PIECE)])

    def finalize(self) -> bytes:
        """Return the rest; InvalidLength or InvalidPadding where the whole does not fit; only once."""
        if self._transform is None:
            raise AlreadyFinalized("this stream was finalized")
        transform, self._transform = self._transform, None
        return transform.finalize()

    def __reduce__(self) -> NoReturn:
        raise TypeError("streams are neither copied nor pickled: two would go on with one state")


@dataclass(frozen=True, slots=True, init=False)
class Cipher(KeyHolder):
    """A key joined with a mode, GB/T 17964-2021.

    key: 16 bytes, for XTS 32; otherwise InvalidKey.
    padding: None, or with ECB and CBC "pkcs7", "iso7816" (80 and zeros) or "zeros"; anything else is InvalidOption.
    "zeros" is for what exists: data that ends in zeros comes back shorter, and nothing is ever malformed.

    >>> stream = Cipher(bytes(16), CTR(bytes(16))).encryptor()
    >>> ciphertext = stream.update(b"any num") + stream.update(b"ber of bytes") + stream.finalize()
    >>> ciphertext == encrypt(bytes(16), CTR(bytes(16)), b"any number of bytes")
    True
    """

    key: bytes = field(repr=False)
    mode: Mode
    padding: Padding = field(default=None, kw_only=True)

    def __init__(self, key: BytesLike, mode: Mode, *, padding: Padding = None) -> None:
        key = as_bytes(key, "key")
        if not isinstance(mode, Mode):
            raise TypeError(f"mode must be a mode of sm4, not {type(mode).__name__}")
        if padding not in (None, "pkcs7", "iso7816", "zeros"):
            raise InvalidOption('padding must be None, "pkcs7", "iso7816" or "zeros"')
        if padding and not isinstance(mode, ECB | CBC):
            raise InvalidOption(f"{type(mode).__name__} takes no padding")
        length = 32 if isinstance(mode, XTS) else 16
        if len(key) != length:
            raise InvalidKey(f"SM4-{type(mode).__name__} takes a key of {length} bytes, not {len(key)}")
        object.__setattr__(self, "key", key)
        object.__setattr__(self, "mode", mode)
        object.__setattr__(self, "padding", padding)

    def encryptor(self) -> CipherStream:
        """A new stream that encrypts."""
        return CipherStream(_transform(self, encrypting=True))

    def decryptor(self, *, release_unverified: bool = False) -> CipherStream:
        """A new stream that decrypts.

        Of GCM, `update` returns nothing and `finalize` everything, once the tag, the last bytes of the data, was found
        right; else InvalidTag. With release_unverified `update` returns plaintext that NOTHING HAS CHECKED YET: whoever
        uses it before `finalize` has returned acts on what an attacker may have written. For other modes, which
        never check, it is InvalidOption.
        """
        if release_unverified and not isinstance(self.mode, GCM):
            raise InvalidOption("release_unverified is for GCM: no other mode verifies anything")
        return CipherStream(_transform(self, encrypting=False, early=release_unverified))


def _transform(cipher: Cipher, *, encrypting: bool, early: bool = False) -> _Transform:
    mode = cipher.mode
    if isinstance(mode, GCM):
        from smcrypto.sm4.gcmstream import EarlyGCMDecryption, GCMDecryption, GCMEncryption

        if encrypting:
            mode._take()
        stream = GCMEncryption if encrypting else EarlyGCMDecryption if early else GCMDecryption
        return stream(cipher.key, mode.nonce, mode.associated_data, mode.tag_length)
    if isinstance(mode, XTS):
        return XTSStream(cipher.key, mode.tweak, mode.variant, encrypting=encrypting)
    engine = Engine(cipher.key)
    if isinstance(mode, CTR):
        return AnyLength(engine, _ctr, mode.nonce)
    if isinstance(mode, OFB):
        return AnyLength(engine, _ofb, mode.iv)
    if isinstance(mode, CFB):
        return AnyLength(engine, _cfb_encrypt if encrypting else _cfb_decrypt, mode.iv)
    if isinstance(mode, ECB):
        step, chain = _ecb_encrypt if encrypting else _ecb_decrypt, b""
    else:
        step, chain = _cbc_encrypt if encrypting else _cbc_decrypt, mode.iv
    return _WholeBlocks(engine, step, chain, cipher.padding, encrypting=encrypting)


def encrypt(key: BytesLike, mode: Mode, data: BytesLike, *, padding: Padding = None) -> bytes:
    """`data` encrypted in one call.

    key: 16 bytes, for XTS 32; otherwise InvalidKey.
    data: whole blocks for ECB and CBC without padding, 16 bytes or more for
    XTS, otherwise InvalidLength; any length for CFB, OFB, CTR, and with padding.
    padding: None, or "pkcs7", "iso7816", "zeros" with ECB and CBC; anything else is InvalidOption.

    >>> import secrets
    >>> key, iv = secrets.token_bytes(16), secrets.token_bytes(16)
    >>> sealed = encrypt(key, CBC(iv), b"attack at dawn", padding="pkcs7")
    >>> decrypt(key, CBC(iv), sealed, padding="pkcs7")
    b'attack at dawn'
    """
    stream = Cipher(key, mode, padding=padding).encryptor()
    return stream.update(data) + stream.finalize()


def decrypt(key: BytesLike, mode: Mode, data: BytesLike, *, padding: Padding = None) -> bytes:
    """The inverse of `encrypt`, with the same errors.

    With padding="pkcs7" or "iso7816", data that is empty, not whole blocks, or does not
    end in well-formed padding is InvalidPadding. Do not tell an attacker
    which decryptions fail: that alone reveals CBC plaintext.
    """
    stream = Cipher(key, mode, padding=padding).decryptor()
    return stream.update(data) + stream.finalize()
