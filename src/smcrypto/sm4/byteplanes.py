"""SM4 on some dozens or hundreds of blocks at once, one byte of every block to a run of bytes.

Layout. n blocks are four big-endian integers, one for each word X_0 ... X_3:

    bytes j*n ... j*n + n - 1 of word w   =   byte 4w + j of blocks 0 ... n - 1

XOR is one operation on a word of all blocks, the S-box one bytes.translate,
and a rotation of words by bytes a rotation by n bytes. Only L's rotations by 2
cut through bytes. With b the bytes after the S-box (b_0 the most significant),

    byte j of L = b_j ^ b_j<<2 ^ b_(j+1)>>6 ^ b_(j+1)<<2 ^ b_(j+2)>>6
                      ^ b_(j+2)<<2 ^ b_(j+3)>>6 ^ b_(j+3)
                = F b_j ^ G b_(j+1) ^ G b_(j+2) ^ H b_(j+3),   F = 1 ^ <<2, G = >>6 ^ <<2, H = >>6 ^ 1

and, as F ^ G = H,  = y_(j+1) ^ y_(j+2) ^ y_(j+3)  with  y_j = H b_j ^ F b_(j+3):
two translations a round, of tables with the S-box built in, and sums.

From 3 blocks on faster than single blocks, until the bit slices take over
(measured, see engine). bytes.translate indexes 256 bytes, four cache lines, by
secret data.
"""

from __future__ import annotations

import struct
from collections.abc import Sequence
from itertools import repeat
from operator import mul

from smcrypto.sm4.block import SBOX

__all__ = ["crypt", "crypt_words", "key_words", "words_from_bytes", "words_to_bytes"]

_F = bytes(b ^ (b << 2 & 0xFF) for b in SBOX)
_H = bytes(b >> 6 ^ b for b in SBOX)


def words_from_bytes(data: bytes) -> list[int]:
    """The four words of whole blocks."""
    return [int.from_bytes(b"".join([data[i::16] for i in range(j, j + 4)]), "big") for j in (0, 4, 8, 12)]


def words_to_bytes(words: Sequence[int], n: int) -> bytes:
    """The 16 * n bytes of four words."""
    out = bytearray(16 * n)
    for w, word in enumerate(words):
        run = word.to_bytes(4 * n, "big")
        for j in range(4):
            out[4 * w + j :: 16] = run[j * n : j * n + n]
    return bytes(out)


def key_words(rk: Sequence[int], n: int) -> list[int]:
    """The round keys, each byte n times."""
    key_bytes = struct.pack(">32I", *rk)
    if n <= 24:  # n assignments of all bytes, rather than 128 repetitions
        runs = bytearray(128 * n)
        for i in range(n):
            runs[i::n] = key_bytes
    else:
        runs = bytearray().join(map(mul, struct.unpack("128c", key_bytes), repeat(n)))
    return [int.from_bytes(run, "big") for run in struct.unpack(f"{4 * n}s" * 32, runs)]


def crypt_words(keys: Sequence[int], words: Sequence[int], n: int) -> list[int]:
    """The 32 rounds on all blocks: words to words."""
    from_bytes, F, H = int.from_bytes, _F, _H
    size, head, one, two = 4 * n, 3 * n, 8 * n, 16 * n
    last_byte = (1 << one) - 1
    a, b, c, d = words
    keys_in_pairs = iter(keys)
    for k0, k1 in zip(keys_in_pairs, keys_in_pairs, strict=True):
        shared = c ^ d  # X_(i+2) ^ X_(i+3) enters this round and the next
        t = (shared ^ b ^ k0).to_bytes(size, "big")
        f = t.translate(F)
        y = from_bytes(t.translate(H), "big") ^ from_bytes(f[head:] + f[:head], "big")
        s = y ^ y >> two
        s = (s ^ s >> one) & last_byte  # y_0 ^ y_1 ^ y_2 ^ y_3
        s |= s << one
        a ^= y ^ s ^ s << two
        t = (shared ^ a ^ k1).to_bytes(size, "big")
        f = t.translate(F)
        y = from_bytes(t.translate(H), "big") ^ from_bytes(f[head:] + f[:head], "big")
        s = y ^ y >> two
        s = (s ^ s >> one) & last_byte
        s |= s << one
        b ^= y ^ s ^ s << two
        a, b, c, d = c, d, a, b
    return [d, c, b, a]


def crypt(keys: Sequence[int], blocks: bytes) -> bytes:
    """Whole blocks through the cipher; keys: `key_words` for as many blocks."""
    n = len(blocks) // 16
    return words_to_bytes(crypt_words(keys, words_from_bytes(blocks), n), n)
