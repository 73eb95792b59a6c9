"""Authenticated encryption with SM4: GCM (NIST SP 800-38D) and CCM (NIST SP 800-38C, RFC 3610).

RFC 8998 fixes both for SM4 in TLS 1.3, with nonces of 12 bytes and tags of 16; GB/T 36624-2018 has them too.
Names are the standards'. A sealed message is ciphertext ‖ tag.

What neither can do: survive a nonce used twice under one key. GCM then reveals the XOR of the two messages and
lets anyone forge, CCM reveals the XOR. Nor do tags commit to a key: the same sealed message can be made to open
under two keys by one who knows both.
"""

from __future__ import annotations

from hmac import compare_digest

from smcrypto.errors import InvalidLength, InvalidTag
from smcrypto.inputs import BytesLike, KeyHolder, as_bytes, require_int
from smcrypto.sm4.engine import Engine, xor_bytes
from smcrypto.sm4.foreign import ENGINE
from smcrypto.sm4.ghash import GHASH

__all__ = ["SM4CCM", "SM4GCM", "inc32", "require_gcm_text"]

_ZERO = bytes(16)
_ONE = b"\0\0\0\1"
# SP 800-38D, 5.2.1.1: 2^39 - 256 bits of plaintext, 2^64 - 1 bits of associated data and of nonce (whole bytes).
GCM_TEXT = 2**36 - 32
_GCM_BYTES = 2**61 - 1
_ONE_PASS = 4096  # bytes up to which decryption makes E(K, J_0) and the key stream together


def _checked_tag_length(tag_length: int, allowed: tuple[int, ...]) -> int:
    if require_int(tag_length, "tag_length") not in allowed:
        raise InvalidLength(f"tag_length must be one of {', '.join(map(str, allowed))} bytes, not {tag_length}")
    return tag_length


class SM4GCM(KeyHolder):
    """SM4 in Galois/Counter Mode: NIST SP 800-38D with the block cipher of GB/T 32907; RFC 8998.

    key: 16 bytes, otherwise InvalidKey. tag_length: 12 to 16 bytes, otherwise InvalidLength; shorter tags are for
    what already exists. One object serves any number of messages, in any number of threads, and gets faster with
    use: it keeps tables for its key.

    nonce: 1 byte or more, otherwise InvalidLength; 12 bytes are the fast and the usual form. No nonce may come
    twice under a key. With random nonces of 12 bytes a key serves at most 2^32 messages (SP 800-38D, 8.3).

    >>> gcm = SM4GCM(bytes(16))
    >>> sealed = gcm.encrypt(b"unique nonce", b"message", b"header")
    >>> len(sealed) - len(b"message")
    16
    >>> gcm.decrypt(b"unique nonce", sealed, b"header")
    b'message'
    """

    __slots__ = ("_engine", "_ghash", "_key", "_t")

    def __init__(self, key: BytesLike, tag_length: int = 16) -> None:
        self._key = as_bytes(key, "key")
        self._engine = Engine(self._key)
        self._t = _checked_tag_length(tag_length, (12, 13, 14, 15, 16))  # SP 800-38D, 5.2.1.2
        self._ghash: GHASH | None = None

    def encrypt(self, nonce: BytesLike, data: BytesLike, associated_data: BytesLike = b"") -> bytes:
        """`data` sealed: ciphertext ‖ tag of `tag_length` bytes.

        data: at most 2^36 - 32 bytes. associated_data: authenticated, not contained. Both may be empty;
        lengths beyond the standard's are InvalidLength. Source: SP 800-38D, 7.1.
        """
        nonce, data, A = as_bytes(nonce, "nonce"), as_bytes(data, "data"), as_bytes(associated_data, "associated_data")
        _check_gcm_lengths(len(nonce), len(data), len(A))
        if len(nonce) == 12 and (foreign := ENGINE.after(len(data) // 16 + 2)) is not None:
            seal, tag = foreign.sealing(self._key, nonce, A)
            return seal(data) + tag()[: self._t]
        J_0 = self._J_0(nonce)
        zero = _ZERO if self._ghash is None else b""  # with the key's first message E(K, 0^128) is computed as well
        masks, C = self._engine.encrypt_and_ctr_xor(zero + J_0, inc32(J_0), data, 32)
        if zero:
            self._ghash = GHASH(masks[:16])
        return C + self._tag(masks[-16:], A, C)

    def decrypt(self, nonce: BytesLike, data: BytesLike, associated_data: BytesLike = b"") -> bytes:
        """The plaintext of `data` = ciphertext ‖ tag; InvalidTag unless all three are as they were sealed.

        Nothing is returned before the tag was compared, in constant time.
        Data shorter than a tag is InvalidTag as well. Source: SP 800-38D, 7.2.
        """
        nonce, data, A = as_bytes(nonce, "nonce"), as_bytes(data, "data"), as_bytes(associated_data, "associated_data")
        _check_gcm_lengths(len(nonce), len(data) - self._t, len(A))
        if len(data) < self._t:
            raise InvalidTag("the message is not authentic")
        C, T = data[: -self._t], data[-self._t :]
        if len(nonce) == 12 and (foreign := ENGINE.after(len(C) // 16 + 2)) is not None:
            opened, holds = foreign.opening(self._key, nonce, A)
            P = opened(C)
            if not holds(T):
                raise InvalidTag("the message is not authentic")
            return P
        J_0 = self._J_0(nonce)
        if len(C) > _ONE_PASS:
            self._check(self._engine.encrypt(J_0), A, C, T)
            return self._engine.ctr_xor(inc32(J_0), C, 32)
        mask, stream = self._engine.encrypt_and_ctr_xor(J_0, inc32(J_0), bytes(len(C)), 32)
        self._check(mask, A, C, T)
        return xor_bytes(stream, C)

    def __repr__(self) -> str:
        return f"<SM4GCM tag_length={self._t}>"

    def _hash(self, A: bytes, C: bytes) -> int:
        """GHASH_H(A ‖ pad ‖ C ‖ pad ‖ len(A) ‖ len(C)): steps 4 and 5 of 7.1."""
        lengths = (len(A) << 67 | len(C) << 3).to_bytes(16, "big")
        return self._hashing()(b"".join((A, bytes(-len(A) % 16), C, bytes(-len(C) % 16), lengths)))

    def _hashing(self) -> GHASH:
        """GHASH under H = E(K, 0^128)."""
        if self._ghash is None:
            self._ghash = GHASH(self._engine.encrypt(_ZERO))
        return self._ghash

    def _J_0(self, nonce: bytes) -> bytes:
        """The pre-counter block: step 2 of 7.1."""
        if len(nonce) == 12:
            return nonce + _ONE
        return self._hash(b"", nonce).to_bytes(16, "big")

    def _check(self, mask: bytes, A: bytes, C: bytes, T: bytes) -> None:
        if not compare_digest(self._tag(mask, A, C), T):
            raise InvalidTag("the message is not authentic")

    def _tag(self, mask: bytes, A: bytes, C: bytes) -> bytes:
        """GHASH of the message XOR mask = E(K, J_0), cut to t bytes: step 6 of 7.1."""
        return (self._hash(A, C) ^ int.from_bytes(mask, "big")).to_bytes(16, "big")[: self._t]


def inc32(block: bytes) -> bytes:
    """The block with its low 32 bits incremented modulo 2^32: 6.2."""
    return block[:12] + (int.from_bytes(block[12:], "big") + 1 & 0xFFFFFFFF).to_bytes(4, "big")


def _check_gcm_lengths(nonce: int, text: int, A: int) -> None:
    if not 1 <= nonce <= _GCM_BYTES:
        raise InvalidLength("nonce must be 1 byte or more")
    require_gcm_text(text)
    if A > _GCM_BYTES:
        raise InvalidLength("associated_data must be below 2^61 bytes (SP 800-38D, 5.2.1.1)")


def require_gcm_text(length: int) -> int:
    """`length` again, of plaintext in bytes, unless it is beyond the standard's: then InvalidLength."""
    if length > GCM_TEXT:
        raise InvalidLength(f"GCM takes at most 2^36 - 32 bytes (SP 800-38D, 5.2.1.1), not {length}")
    return length


class SM4CCM(KeyHolder):
    """SM4 in CCM mode: NIST SP 800-38C (RFC 3610) with the block cipher of GB/T 32907; RFC 8998.

    key: 16 bytes, otherwise InvalidKey. tag_length: 4, 6, 8, 10, 12, 14 or 16 bytes, otherwise InvalidLength.
    One object serves any number of messages, in any number of threads. CCM encrypts every block twice, the
    second time in a chain that no engine can speed up: where there is a choice, `SM4GCM` is much the faster.

    nonce: 7 to 13 bytes, otherwise InvalidLength; none may come twice under a key. A nonce of n bytes leaves
    15 - n for the length of a message: below 2^24 bytes with 12, at most 65,535 with 13.

    >>> ccm = SM4CCM(bytes(16), tag_length=8)
    >>> sealed = ccm.encrypt(b"unique nonce", b"message", b"header")
    >>> len(sealed) - len(b"message")
    8
    >>> ccm.decrypt(b"unique nonce", sealed, b"header")
    b'message'
    """

    __slots__ = ("_engine", "_t")

    def __init__(self, key: BytesLike, tag_length: int = 16) -> None:
        self._engine = Engine(as_bytes(key, "key"))
        self._t = _checked_tag_length(tag_length, (4, 6, 8, 10, 12, 14, 16))  # SP 800-38C, A.1

    def encrypt(self, nonce: BytesLike, data: BytesLike, associated_data: BytesLike = b"") -> bytes:
        """`data` sealed: ciphertext ‖ tag of `tag_length` bytes.

        data: shorter than 2^(8·(15 - len(nonce))) bytes, otherwise InvalidLength. associated_data: below 2^64
        bytes, authenticated, not contained. Both may be empty. Source: SP 800-38C, 6.1.
        """
        N, P, A = as_bytes(nonce, "nonce"), as_bytes(data, "data"), as_bytes(associated_data, "associated_data")
        Ctr_0 = _counter_block(N)
        if len(P) >= _text_limit(N):
            raise InvalidLength(f"with a nonce of {len(N)} bytes the data is below {_text_limit(N)}, not {len(P)}")
        S_0, C = self._engine.encrypt_and_ctr_xor(Ctr_0, Ctr_0[:-1] + b"\1", P, 8 * (15 - len(N)))
        return C + self._tag(S_0, N, A, P)

    def decrypt(self, nonce: BytesLike, data: BytesLike, associated_data: BytesLike = b"") -> bytes:
        """The plaintext of `data` = ciphertext ‖ tag; InvalidTag unless all three are as they were sealed.

        CCM's tag covers the plaintext, so that is computed first; it is returned only when the tag, compared
        in constant time, is right. Data shorter than a tag, or longer than `encrypt` makes it, is InvalidTag as
        well; a nonce of another length is InvalidLength. Source: SP 800-38C, 6.2.
        """
        N, data, A = as_bytes(nonce, "nonce"), as_bytes(data, "data"), as_bytes(associated_data, "associated_data")
        Ctr_0 = _counter_block(N)
        if not self._t <= len(data) < self._t + _text_limit(N):
            raise InvalidTag("the message is not authentic")
        C, T = data[: -self._t], data[-self._t :]
        S_0, P = self._engine.encrypt_and_ctr_xor(Ctr_0, Ctr_0[:-1] + b"\1", C, 8 * (15 - len(N)))
        if not compare_digest(self._tag(S_0, N, A, P), T):
            raise InvalidTag("the message is not authentic")
        return P

    def __repr__(self) -> str:
        return f"<SM4CCM tag_length={self._t}>"

    def _tag(self, S_0: bytes, N: bytes, A: bytes, P: bytes) -> bytes:
        """The CBC-MAC of the formatted blocks B_0 ... B_r (A.2), XOR S_0, cut to t bytes: steps 1-4, 8 of 6.1."""
        q = 15 - len(N)
        flags = 64 * bool(A) + 8 * ((self._t - 2) // 2) + q - 1
        length = _encoded_length(len(A)) if A else b""
        B = b"".join(
            (bytes([flags]), N, len(P).to_bytes(q, "big"),
             length, A, bytes(-(len(length) + len(A)) % 16),
             P, bytes(-len(P) % 16))
        )
        Y = self._engine.cbc_encrypt(_ZERO, B)[-16:]
        return xor_bytes(Y, S_0)[: self._t]


def _counter_block(N: bytes) -> bytes:
    """Ctr_0 (A.3) for a nonce, after checking that (A.1)."""
    if not 7 <= len(N) <= 13:
        raise InvalidLength(f"a CCM nonce is 7 to 13 bytes, not {len(N)}")
    q = 15 - len(N)
    return bytes([q - 1]) + N + bytes(q)


def _text_limit(N: bytes) -> int:
    """The text is shorter than this: its length has to fit the q bytes that the nonce leaves (5.3)."""
    return 1 << 8 * (15 - len(N))


def _encoded_length(a: int) -> bytes:
    """The length of the associated data as it stands before them: A.2.2."""
    if a < 0xFF00:
        return a.to_bytes(2, "big")
    if a < 1 << 32:
        return b"\xff\xfe" + a.to_bytes(4, "big")
    return b"\xff\xff" + a.to_bytes(8, "big")
