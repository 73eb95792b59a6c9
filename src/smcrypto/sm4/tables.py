"""SM4 one block after the other: single blocks and CBC encryption, in Python (where `foreign` does not do it).

A round is one expression over tables that hold T of each byte of a word, or
of each half of it:

narrow  4 tables of 256 words; ready in a millisecond
wide    2 tables of 65,536 words, 4 ms to build; a fifth faster a block, so they are
        built once the process has had about WIDE_BLOCKS blocks, under whatever keys.
        Arrays, of 0.5 MB: lists of integers take 5 MB, and where others use the caches
        they take twice the time of the narrow tables

All 32 rounds are unrolled into one function for a block and one for a chain, in which
words stay integers from the first block to the last. The functions are written by
`_source`, below. Tables are indexed by secret data: on a machine shared with an
attacker who can watch the cache, this engine is not the one to trust.
"""

from __future__ import annotations

import struct
from array import array
from collections.abc import Callable, Sequence
from functools import cache
from typing import Any, TypeAlias

from smcrypto.sm4.block import CK, FK, SBOX, L, L_prime

__all__ = ["WIDE_BLOCKS", "cbc_encrypt", "crypt_block", "expand_key"]

WIDE_BLOCKS = 2000
_blocks = 0  # that the process has had

Tables: TypeAlias = tuple[Sequence[int], ...]

# One round, t being X_(i+1) ^ X_(i+2) ^ X_(i+3) ^ rk_i.
_NARROW = "{x} ^= T0[t >> 24] ^ T1[t >> 16 & 255] ^ T2[t >> 8 & 255] ^ T3[t & 255]"
_WIDE = "{x} ^= T0[t >> 16] ^ T1[t & 65535]"


def _rounds(one_round: str) -> list[str]:
    """Rounds 0 ... 31 on a, b, c, d with the keys k0 ... k31; two rounds share X_(i+2) ^ X_(i+3)."""
    lines = []
    for i in range(32):
        x, x1, x2, x3 = ("abcd"[(i + j) % 4] for j in range(4))
        if i % 2 == 0:
            lines.append(f"u = {x2} ^ {x3}; t = u ^ {x1} ^ k{i}")
        else:
            lines.append(f"t = u ^ {x3} ^ k{i}")
        lines.append(one_round.format(x=x))
    return lines


def _source(one_round: str, table_count: int) -> str:
    """The text of block() and cbc() for one kind of table."""
    unpack_arguments = [
        ", ".join(f"k{i}" for i in range(32)) + " = rk",
        ", ".join(f"T{i}" for i in range(table_count)) + " = tables",
    ]
    rounds = _rounds(one_round)
    block = [*unpack_arguments, "a, b, c, d = unpack(data)", *rounds, "return pack(d, c, b, a)"]
    chain = [*unpack_arguments, "a, b, c, d = unpack(chain)", "out = []"]
    chain.append("for p, q, r, s in zip(words, words, words, words):")
    in_loop = ["a ^= p; b ^= q; c ^= r; d ^= s", *rounds, "a, b, c, d = d, c, b, a", "out += (a, b, c, d)"]
    lines = ["def block(tables, rk, data):", *("    " + line for line in block)]
    lines += ["def cbc(tables, rk, chain, words):", *("    " + line for line in chain)]
    return "\n".join([*lines, *("        " + line for line in in_loop), "    return out"])


def _compile(one_round: str, table_count: int) -> dict[str, Callable[..., Any]]:
    block = struct.Struct(">4I")
    namespace: dict[str, Any] = {"unpack": block.unpack, "pack": block.pack}
    exec(_source(one_round, table_count), namespace)  # noqa: S102 - the text is made above, of constants
    return namespace


def _byte_tables(linear: Callable[[int], int]) -> Tables:
    return tuple([linear(byte << shift) for byte in SBOX] for shift in (24, 16, 8, 0))


@cache
def _narrow() -> tuple[dict[str, Callable[..., Any]], Tables]:
    return _compile(_NARROW, 4), _byte_tables(L)


@cache
def _wide() -> tuple[dict[str, Callable[..., Any]], Tables]:
    T0, T1, T2, T3 = _narrow()[1]
    T0_1, T2_3 = (array("I", [a ^ b for a in high for b in low]) for high, low in ((T0, T1), (T2, T3)))
    return _compile(_WIDE, 2), (T0_1, T2_3)


@cache
def _key_expansion() -> tuple[Callable[[Tables, Sequence[int], Sequence[int]], tuple[int, ...]], Tables]:
    """The key expansion unrolled: the same rounds with T' for T and CK for rk, each new word a round key."""
    lines = ["def expand(tables, words, CK):", "    T0, T1, T2, T3 = tables", "    a, b, c, d = words"]
    for i in range(32):
        lines += ["    " + line for line in _rounds(_NARROW)[2 * i : 2 * i + 2]]
        lines.append(f"    r{i} = {'abcd'[i % 4]}")
    lines.insert(3, "    " + ", ".join(f"k{i}" for i in range(32)) + " = CK")
    lines.append("    return " + ", ".join(f"r{i}" for i in range(32)))
    namespace: dict[str, Any] = {}
    exec("\n".join(lines), namespace)  # noqa: S102 - the text is made above, of constants
    return namespace["expand"], _byte_tables(L_prime)


def expand_key(key: bytes) -> tuple[int, ...]:
    """The 32 round keys of a 16-byte key, 7.3. Reversed, they decrypt (7.2)."""
    expand, tables = _key_expansion()
    a, b, c, d = struct.unpack(">4I", key)
    return expand(tables, (a ^ FK[0], b ^ FK[1], c ^ FK[2], d ^ FK[3]), CK)


def _for_blocks(count: int) -> tuple[dict[str, Callable[..., Any]], Tables]:
    """The functions and tables for the process's next `count` blocks."""
    global _blocks
    _blocks += count
    return _narrow() if _blocks < WIDE_BLOCKS else _wide()


def crypt_block(rk: Sequence[int], block: bytes) -> bytes:
    """One 16-byte block."""
    functions, tables = _for_blocks(1)
    result: bytes = functions["block"](tables, rk, block)
    return result


def cbc_encrypt(rk: Sequence[int], chain: bytes, data: bytes) -> bytes:
    """C_i = E(P_i ^ C_(i-1)) over whole blocks, C_0 being `chain`."""
    functions, tables = _for_blocks(len(data) // 16)
    count = len(data) // 4
    words = iter(struct.unpack(f">{count}I", data))
    return struct.pack(f">{count}I", *functions["cbc"](tables, rk, chain, words))
