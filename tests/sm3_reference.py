"""SM3's expansion and compression as GB/T 32905-2016 writes them, 5.3.2 and 5.3.3: the oracle of the SM3 tests."""

from __future__ import annotations

from smcrypto._sm3_compression import Expanded, State

_M = 0xFFFFFFFF


def _rotl(x: int, n: int) -> int:
    n %= 32
    return (x << n | x >> (32 - n)) & _M


def _T(j: int) -> int:
    """The round constant of 4.2, rotated by j as 5.3.3 uses it."""
    return _rotl(0x79CC4519 if j < 16 else 0x7A879D8A, j)


def expand_by_definition(B: tuple[int, ...]) -> Expanded:
    """5.3.2: W_0 ... W_67 and W'_0 ... W'_63 of the block B of sixteen words."""
    W = list(B)
    for j in range(16, 68):
        x = W[j - 16] ^ W[j - 9] ^ _rotl(W[j - 3], 15)
        P_1 = x ^ _rotl(x, 15) ^ _rotl(x, 23)
        W.append(P_1 ^ _rotl(W[j - 13], 7) ^ W[j - 6])
    return (*W, *(W[j] ^ W[j + 4] for j in range(64)))


def compress_by_definition(V: State, expanded: Expanded) -> State:
    """5.3.3: CF(V, B) for an expanded block."""
    W, X = expanded[:68], expanded[68:]
    A, B, C, D, E, F, G, H = V
    for j in range(64):
        SS1 = _rotl((_rotl(A, 12) + E + _T(j)) & _M, 7)
        SS2 = SS1 ^ _rotl(A, 12)
        FF = A ^ B ^ C if j < 16 else (A & B) | (A & C) | (B & C)
        GG = E ^ F ^ G if j < 16 else (E & F) | (~E & G)
        TT1 = (FF + D + SS2 + X[j]) & _M
        TT2 = (GG + H + SS1 + W[j]) & _M
        D, C, B, A = C, _rotl(B, 9), A, TT1
        H, G, F, E = G, _rotl(F, 19), E, TT2 ^ _rotl(TT2, 9) ^ _rotl(TT2, 17)
    return tuple(v ^ w for v, w in zip(V, (A, B, C, D, E, F, G, H), strict=True))
