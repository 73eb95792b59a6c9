"""SM3's message expansion and compression function, GB/T 32905-2016, 5.3.2 and 5.3.3.

Names are the standard's: V, B, W, W' (here X), A ... H, SS1, SS2, TT1, TT2, T_j, FF_j, GG_j,
P_0, P_1. A state V is a tuple of eight 32-bit integers, a block sixteen.

As the standard writes them they are the tests' oracle (tests/sm3_reference.py). Here they are faster:

* Rotations work on *repeated* words: x·(2^32 + 1) holds x twice, so one right shift puts any rotation of
  x in the low 32 bits. Sums, XORs and ANDs do not mind what lies above bit 31, so that words are masked
  only before a multiplication or where they leave. A round is about 30 integer operations, not 45.
* The rounds are unrolled, and no word changes its variable: a round gives the eight names new roles.
* The expansion does not depend on V. For many blocks it runs once for all of them: W_j of n blocks is
  one integer of n 64-bit lanes (`expand_many`, from MANY blocks on).

Imported only where the OpenSSL engine is absent or not wanted; compiling the unrolled rounds takes
some ten milliseconds.
"""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterable, Iterator
from typing import Any, TypeAlias

__all__ = ["IV", "MANY", "compress", "compress_bytes", "expand_many", "expand_one"]

State: TypeAlias = tuple[int, ...]
# The 132 words W_0 ... W_67, W'_0 ... W'_63 of one block.
Expanded: TypeAlias = tuple[int, ...]

# GB/T 32905-2016, 4.1.
IV: State = (0x7380166F, 0x4914B2B9, 0x172442D7, 0xDA8A0600, 0xA96F30BC, 0x163138AA, 0xE38DEE4D, 0xB0FB0E4E)

MANY = 4  # blocks from which expanding them together is the faster way (measured: benchmarks/bench_sm3.py)
_TOGETHER = 256  # blocks expanded at once at most: bounds memory, and keeps the lanes in the cache

_M = 0xFFFFFFFF


def _T(j: int) -> int:
    """The round constant of 4.2, rotated by j as 5.3.3 uses it."""
    return (0x79CC4519 if j < 16 else 0x7A879D8A) * _TWICE >> 32 - j % 32 & _M


_TWICE = (1 << 32) + 1  # x * _TWICE is x repeated: rotl(x, n) are the low 32 bits of x * _TWICE >> 32 - n
_THRICE = (1 << 64) + (1 << 32) + 1

# x·_TWICE leaves 64 bits of the word's repetition, x·_THRICE 96, of which P_0 (shifts by 23 and 15) leaves 73.
# What is shifted afterwards: A by 20 (rotl 12), B by 23 (rotl 9), F by 13 (rotl 19): 32 good bits remain.
_ROUND = """\
        r = {A} >> 20
        s = ({E} + r + {T} & M) * TWICE >> 25
        {D} = ({FF} + {D} + (s ^ r) + X{j} & M) * TWICE
        t = ({GG} + {H} + s + W{j} & M) * THRICE
        {H} = t ^ t >> 15 ^ t >> 23
        {B} >>= 23
        {F} >>= 13
"""
_COMPRESS = """\
def compress(V, blocks):
    a, b, c, d, e, f, g, h = V
    for {words} in blocks:
        A = a * TWICE; B = b * TWICE; C = c; D = d
        E = e * TWICE; F = f * TWICE; G = g; H = h
{rounds}\
        a ^= A & M; b ^= B & M; c ^= C & M; d ^= D & M
        e ^= E & M; f ^= F & M; g ^= G & M; h ^= H & M
    return a, b, c, d, e, f, g, h
"""


def _compress_source() -> str:
    """Text of `compress(V, blocks)`: the 64 rounds with the names of their roles written in."""
    rounds = []
    A, B, C, D, E, F, G, H = "ABCDEFGH"
    for j in range(64):
        FF = f"({A} ^ {B} ^ {C})" if j < 16 else f"({A} & {B} | ({A} | {B}) & {C})"
        GG = f"({E} ^ {F} ^ {G})" if j < 16 else f"({G} ^ {E} & ({F} ^ {G}))"
        rounds.append(_ROUND.format(A=A, B=B, D=D, E=E, F=F, H=H, FF=FF, GG=GG, T=_T(j), j=j))
        # What was computed into D is the next A, and so on: the roles move, the words stay.
        A, B, C, D = D, A, B, C
        E, F, G, H = H, E, F, G
    words = ", ".join([f"W{j}" for j in range(68)] + [f"X{j}" for j in range(64)])
    return _COMPRESS.format(words=words, rounds="".join(rounds))


def _expand_source() -> str:
    """Text of `expand_one(B)`: 5.3.2 for one block; Rj is W_j repeated."""
    lines = ["def expand_one(B):", f"    {', '.join(f'W{j}' for j in range(16))} = B"]
    lines += [f"    R{j} = W{j} * TWICE" for j in range(3, 16)]
    for j in range(16, 68):
        lines.append(f"    x = (W{j - 16} ^ W{j - 9} ^ R{j - 3} >> 17 & M) * TWICE")
        lines.append(f"    W{j} = (x ^ x >> 17 ^ x >> 9 ^ R{j - 13} >> 25 ^ W{j - 6}) & M")
        if j < 65:
            lines.append(f"    R{j} = W{j} * TWICE")
    words = [f"W{j}" for j in range(68)] + [f"W{j} ^ W{j + 4}" for j in range(64)]
    lines.append(f"    return {', '.join(words)}")
    return "\n".join(lines)


def _compiled(source: str, name: str) -> Callable[..., Any]:
    names: dict[str, Any] = {"M": _M, "TWICE": _TWICE, "THRICE": _THRICE}
    exec(compile(source, f"<unrolled {name} of {__name__}>", "exec"), names)  # noqa: S102  (text made above)
    unrolled: Callable[..., Any] = names[name]
    return unrolled


#: CF over expanded blocks, one after another.
compress: Callable[[State, Iterable[Expanded]], State] = _compiled(_compress_source(), "compress")
#: 5.3.2 for one block of sixteen words.
expand_one: Callable[[tuple[int, ...]], Expanded] = _compiled(_expand_source(), "expand_one")


def expand_many(B: tuple[int, ...]) -> Iterator[Expanded]:
    """5.3.2 for n blocks at once; `B` holds their 16·n words, block after block.

    W_j of all blocks is one integer, block i in bits 64·i ... 64·i + 31; above them 32 bits of room, so that
    a rotation is two shifts: what leaves a word to either side falls into a room, which one AND empties.
    """
    n = len(B) // 16
    lanes = f"<{n}Q"
    columns = [B[j::16] for j in range(16)]
    W = [int.from_bytes(struct.pack(lanes, *column), "little") for column in columns]
    mask = int.from_bytes(struct.pack("<Q", _M) * n, "little")
    for j in range(16, 68):
        w = W[j - 3]
        x = (W[j - 16] ^ W[j - 9] ^ w << 15 ^ w >> 17) & mask
        w = W[j - 13]
        W.append((x ^ x << 15 ^ x >> 17 ^ x << 23 ^ x >> 9 ^ w << 7 ^ w >> 25 ^ W[j - 6]) & mask)
    both = W[16:] + [W[j] ^ W[j + 4] for j in range(64)]
    columns += [struct.unpack(lanes, column.to_bytes(8 * n, "little")) for column in both]
    return zip(*columns, strict=True)


def compress_bytes(V: State, data: bytes, blocks: int) -> State:
    """CF over the first `blocks` blocks (64 bytes each) of `data`."""
    done = 0
    while blocks - done >= MANY:
        n = min(blocks - done, _TOGETHER)
        V = compress(V, expand_many(struct.unpack_from(f">{16 * n}I", data, 64 * done)))
        done += n
    one = struct.Struct(">16I")
    return compress(V, [expand_one(one.unpack_from(data, 64 * i)) for i in range(done, blocks)])
