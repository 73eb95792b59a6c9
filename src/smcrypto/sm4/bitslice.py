"""SM4 on thousands of blocks at once, one bit of every block to an integer.

Layout. A chunk is n = 128 * width blocks, stored as 128 rows: row r is the
integer of blocks r*width ... (r+1)*width - 1 as they lie in memory, little-endian.
Transposed, it is 128 planes of n bits:

    plane i, bit 128*m + r   =   bit i of block r*width + m
    bit i of a block         =   bit of weight 2**(i % 8) in its byte i // 8

so that every operation below works on all n blocks, and a rotation of words
merely renames planes. `transpose` leads from one to the other and back.

The S-box is a circuit of 105 gates (SBOX_CIRCUIT); with L in 3 XORs a bit, the
round input in 2.5 and the key in 1, a round is 4 * 105 + 6.5 * 32 = 628
operations on n-bit integers, and a chunk 20,096, whatever the data is. No
table is indexed by data or key; a key bit decides which of two constant planes
is XORed. From BULK_BLOCKS on this is the fastest engine (measured, see engine).
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from functools import cache, lru_cache
from operator import rshift, xor
from typing import Any

__all__ = [
    "SBOX_CIRCUIT", "chunk_width", "compiled_sbox", "counter_planes", "crypt_planes", "crypt_xor", "ctr_xor",
    "key_planes", "rows_from_bytes", "transpose",
]  # fmt: skip

# S(x) = circuit(x ^ 0x75) ^ 0xD3; x0 and o0 are the bits of weight 1.
#
# First and last part are the linear maps into and out of the tower field, the
# middle is the inversion of Boyar and Peralta (A new combinational logic
# minimization technique with applications to cryptology, SEA 2010, 62 gates).
# Two of its products are taken as OR (a | b = ab + a + b): the sums this adds
# cancel two of its four linear terms, which leaves 60. Of the 8 isomorphisms
# and 255 scalings that commute with inversion, this one had the shortest linear
# maps (18 and 27) under their greedy heuristic, the second one transposed.
SBOX_CIRCUIT = """
    y0 = x2 ^ x6; y15 = x1 ^ y0; y4 = x0 ^ y15; y3 = x5 ^ y4; y18 = x1 ^ y3; y14 = x2 ^ y4
    y13 = x2 ^ y3; y2 = x4 ^ y18; y11 = x3 ^ y3; y5 = y13 ^ y2; y7 = y0 ^ y11; y9 = y4 ^ y2
    y20 = y11 ^ y9; y16 = x7 ^ y20; y8 = x2 ^ y2; y1 = y7 ^ y16; y17 = y15 ^ y16; y10 = x1 ^ y1
    t2 = x5 & y15; t3 = y3 & x1; t4 = t3 ^ t2; t5 = y4 & y0; t6 = t5 ^ t2; t7 = y13 | y16; t8 = y5 & y1
    t9 = t8 ^ t7; t10 = y2 & y7; t11 = t10 ^ t7; t12 = y9 & y11; t13 = y14 & y17; t14 = t13 ^ t12
    t15 = y8 | y10; t16 = t15 ^ t12; t17 = t4 ^ t14; t18 = t6 ^ t16; t19 = t9 ^ t14; t20 = t11 ^ t16
    t21 = t17 ^ y20; t24 = t20 ^ y18; t25 = t21 ^ t18; t26 = t21 & t19; t27 = t24 ^ t26; t28 = t25 & t27
    t29 = t28 ^ t18; t30 = t19 ^ t24; t31 = t18 ^ t26; t32 = t31 & t30; t33 = t32 ^ t24; t34 = t19 ^ t33
    t35 = t27 ^ t33; t36 = t24 & t35; t37 = t36 ^ t34; t38 = t27 ^ t36; t39 = t29 & t38; t40 = t25 ^ t39
    t41 = t40 ^ t37; t42 = t29 ^ t33; t43 = t29 ^ t40; t44 = t33 ^ t37; t45 = t42 ^ t41; z0 = t44 & y15
    z1 = t37 & x1; z2 = t33 & y0; z3 = t43 & y16; z4 = t40 & y1; z5 = t29 & y7; z6 = t42 & y11
    z7 = t45 & y17; z8 = t41 & y10; z9 = t44 & x5; z10 = t37 & y3; z11 = t33 & y4; z12 = t43 & y13
    z13 = t40 & y5; z14 = t29 & y2; z15 = t42 & y9; z16 = t45 & y14; z17 = t41 & y8
    s0 = z6 ^ z0; s1 = z5 ^ z2; s2 = z7 ^ s0; s4 = z4 ^ s1; o7 = s4 ^ s2; s5 = z16 ^ z17; s6 = z11 ^ s5
    s8 = z9 ^ z13; s7 = s8 ^ s6; s9 = z14 ^ o7; s11 = z15 ^ z17; s12 = s11 ^ s7; s10 = s12 ^ s9
    s14 = z3 ^ z0; s15 = s14 ^ s1; o4 = s15 ^ s10; o3 = z1 ^ s2; s18 = z10 ^ s6; s19 = s18 ^ o4
    o0 = s19 ^ o3; s20 = z8 ^ z2; s21 = s20 ^ s0; o1 = s21 ^ s10; o2 = s10 ^ o0; s22 = z13 ^ s5
    o5 = s22 ^ s9; o6 = z12 ^ s7
"""
_INPUT_CONSTANT = 0x75757575
_OUTPUT_CONSTANT = 0x4F4F4F4F  # L of 0xD3 in every byte: 0xD3 rotated left by 2


@cache
def compiled_sbox() -> Callable[..., tuple[int, ...]]:
    """The circuit as a function of x0 ... x7.

    Each value is kept in a variable that is free again after its last use, so
    that planes return to the allocator while they are still in the cache.
    """
    gates = [gate.split() for line in SBOX_CIRCUIT.strip().splitlines() for gate in line.split("; ")]
    last_use = {}
    for position, (_, _, left, _, right) in enumerate(gates):
        last_use[left] = last_use[right] = position
    last_use |= {f"o{i}": len(gates) for i in range(8)}
    variable = {f"x{i}": f"v{i}" for i in range(8)}
    free: list[str] = []
    body = []
    for position, (name, _, left, operator, right) in enumerate(gates):
        source = f"{variable[left]} {operator} {variable[right]}"
        free += [variable[operand] for operand in (left, right) if last_use[operand] == position]
        variable[name] = free.pop() if free else f"v{len(variable)}"
        body.append(f"    {variable[name]} = {source}")
    lines = ["def sbox(v0, v1, v2, v3, v4, v5, v6, v7):", *body]
    lines.append("    return " + ", ".join(variable[f"o{i}"] for i in range(8)))
    namespace: dict[str, Any] = {}
    exec("\n".join(lines), namespace)  # noqa: S102 - the text is the constant above
    compiled: Callable[..., tuple[int, ...]] = namespace["sbox"]
    return compiled




# ---------------------------------------------------------------- rows and planes

MAX_WIDTH = 512  # 65,536 blocks, 1 MiB: longer planes gain little, and the work space stays near 5 MiB


def chunk_width(blocks: int) -> int:
    """The width with which to cut `blocks` blocks into equal chunks, none above MAX_WIDTH."""
    chunks = -(-blocks // (128 * MAX_WIDTH))
    return -(-blocks // (128 * chunks))


def rows_from_bytes(data: bytes, width: int) -> list[int]:
    """128 rows of `width` blocks; `data` may be shorter, what is missing is zero."""
    size = 16 * width
    return [int.from_bytes(data[start : start + size], "little") for start in range(0, 128 * size, size)]


@lru_cache(maxsize=8)
def _alternating(width: int) -> tuple[int, ...]:
    """For s = 0 ... 6, the positions with bit s set, among 128 * (width + 1)."""
    masks = []
    for s in range(7):
        period = sum(1 << p for p in range(128) if p >> s & 1)
        masks.append(int.from_bytes(period.to_bytes(16, "little") * (width + 1), "little"))
    return tuple(masks)


def transpose(rows: list[int], width: int) -> None:
    """Rows become planes, or planes rows, in place: it is its own inverse.

    Bit p of (row r << r) is bit p of (plane i << i) where i = p - r mod 128. So
    after shifting, bits only move between integers, never within one: by the
    distance p mod 128, which 7 masked steps of 1, 2, 4 ... 64 add up to.
    """
    rows[:] = [rows[-r % 128] << (-r % 128) for r in range(128)]
    for s, mask in enumerate(_alternating(width)):
        step = 1 << s
        wrapped = rows[-step:] + rows  # entry r is row r - step as it was
        del wrapped[128:]
        while wrapped:
            r = len(wrapped) - 1
            row = rows[r]
            rows[r] = row ^ (row ^ wrapped.pop()) & mask
    rows[:] = map(rshift, rows, range(128))


# ---------------------------------------------------------------- the cipher

def key_planes(rk: Sequence[int], width: int) -> list[list[int]]:
    """The round keys as planes, bit 0 first, with the constants of the S-box circuit folded in.

    X_i has taken i // 4 output constants; those of X_32 ... X_35 cancel.
    A guard bit above the n lanes keeps a plane of zeros as long as one of
    ones, so that XOR takes the same time with both.
    """
    n = 128 * width
    zeros, ones = 1 << n, (2 << n) - 1
    planes = []
    for i, word in enumerate(rk):
        constants_taken = (i + 1) // 4 + (i + 2) // 4 + (i + 3) // 4
        word ^= _INPUT_CONSTANT ^ (_OUTPUT_CONSTANT if constants_taken % 2 else 0)
        planes.append([ones if word >> bit & 1 else zeros for bit in range(32)])
    return planes


def _tau_then_L(t: list[int]) -> Iterator[int]:
    """L(tau(t)) without its constant; L(B) = (D <<< 24) ^ ((D ^ B <<< 16) <<< 2) with D = B ^ B <<< 8."""
    sbox = compiled_sbox()
    B = [*sbox(*t[0:8]), *sbox(*t[8:16]), *sbox(*t[16:24]), *sbox(*t[24:32])]
    D = list(map(xor, B, B[-8:] + B[:-8]))
    E = list(map(xor, D, B[-16:] + B[:-16]))
    return map(xor, D[-24:] + D[:-24], E[-2:] + E[:-2])


# Bit b of word w (b = 0 has weight 1) is in plane _WORDS[w][b]: byte 4w + 3 - b // 8, weight b % 8.
_WORDS = [[8 * (4 * w + 3 - b // 8) + b % 8 for b in range(32)] for w in range(4)]


def crypt_planes(planes: list[int], keys: Sequence[list[int]], width: int) -> None:
    """The 32 rounds on all lanes, in place."""
    a, b, c, d = ([planes[i] for i in word] for word in _WORDS)
    planes.clear()
    for i in range(0, 32, 2):
        shared = list(map(xor, c, d))  # X_(i+2) ^ X_(i+3) enters this round and the next
        a = list(map(xor, a, _tau_then_L(list(map(xor, map(xor, shared, b), keys[i])))))
        b = list(map(xor, b, _tau_then_L(list(map(xor, map(xor, shared, a), keys[i + 1])))))
        a, b, c, d = c, d, a, b
    lanes = (1 << 128 * width) - 1
    planes += [0] * 128
    for word, bits in zip(_WORDS, (d, c, b, a), strict=True):
        for i, plane in zip(word, bits, strict=True):
            planes[i] = plane & lanes


@lru_cache(maxsize=8)
def _index_planes(width: int) -> tuple[int, ...]:
    """The bits of m, lowest first, where lane 128*m + r belongs to column m of a row."""
    planes = []
    for bit in range((width - 1).bit_length()):
        columns = b"".join([(b"\xff" if m >> bit & 1 else b"\0") * 16 for m in range(width)])
        planes.append(int.from_bytes(columns, "little"))
    return tuple(planes)


def counter_planes(first: int, width: int, counter_bits: int = 128) -> list[int]:
    """Planes of the blocks `first`, `first` + 1, ..., big-endian, of which the low `counter_bits` count and wrap.

    The 128 row starts are ordinary integers; to them the column number is
    added by a ripple of half and full adders, which ends where the carries do.
    Planes in which all blocks agree cost next to nothing.
    """
    modulus = 1 << counter_bits
    fixed, start = first & -modulus, first % modulus
    starts = "".join([format(fixed | (start + r * width) % modulus, "0128b") for r in range(127, -1, -1)])
    index = _index_planes(width)
    planes = [0] * 128
    carry = 0
    for weight in range(128):
        bits = int(starts[127 - weight :: 128], 2)
        plane = int.from_bytes(bits.to_bytes(16, "little") * width, "little")
        addend = index[weight] if weight < len(index) else 0
        if weight < counter_bits and (addend or carry):
            half = plane ^ addend
            plane, carry = half ^ carry, (plane & addend) | (half & carry)
        # weight 2**w of the big-endian block is byte 15 - w // 8
        planes[8 * (15 - weight // 8) + weight % 8] = plane
    return planes


# ---------------------------------------------------------------- on bytes

def _finish(planes: list[int], keys: Sequence[list[int]], width: int, mask: bytes | None, length: int) -> bytes:
    """The cipher on `planes`, back to bytes, XOR `mask`, cut to `length`."""
    crypt_planes(planes, keys, width)
    transpose(planes, width)
    size = 16 * width
    if mask is not None:
        for r in range(128):
            planes[r] ^= int.from_bytes(mask[r * size : (r + 1) * size], "little")
    return b"".join([row.to_bytes(size, "little") for row in planes])[:length]


def crypt_xor(keys: Sequence[list[int]], blocks: bytes, mask: bytes | None, width: int) -> bytes:
    """The cipher on up to 128 * `width` blocks, XOR `mask` of the same length; keys: `key_planes` for this width."""
    planes = rows_from_bytes(blocks, width)
    transpose(planes, width)
    return _finish(planes, keys, width, mask, len(blocks))


def ctr_xor(keys: Sequence[list[int]], first: int, data: bytes, width: int, counter_bits: int) -> bytes:
    """Up to 2048 * `width` bytes of data XOR the encryptions of `first`, `first` + 1, ..."""
    return _finish(counter_planes(first, width, counter_bits), keys, width, data, len(data))
