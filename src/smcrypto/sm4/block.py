"""The constants and linear maps of the SM4 block cipher, GB/T 32907-2016.

Names are the standard's: FK and CK the constants of the key expansion, tau the S-box on four bytes,
L and L' the linear maps, T = L.tau, T' = L'.tau. Words are 32-bit integers,
most significant byte first (6.2).

What the engines take their constants and tables from (tables for serial work, byteplanes and bitslice for many
blocks at once). The rounds as clauses 6 and 7 write them are the tests' oracle (tests/sm4_reference.py).
"""

from __future__ import annotations

__all__ = ["CK", "FK", "SBOX", "L", "L_prime"]

FK = (0xA3B1BAC6, 0x56AA3350, 0x677D9197, 0xB27022DC)
# ck[i][j] = (4i + j) * 7 mod 256, 7.3.2.
CK = tuple(int.from_bytes(bytes((4 * i + j) * 7 % 256 for j in range(4)), "big") for i in range(32))
# 6.2 a), two rows of the table to a line.
SBOX = bytes.fromhex("""
    d690e9fecce13db716b614c228fb2c05 2b679a762abe04c3aa44132649860699
    9c4250f491ef987a33540b43edcfac62 e4b31ca9c908e89580df94fa758f3fa6
    4707a7fcf37317ba83593c19e6854fa8 686b81b27164da8bf8eb0f4b70569d35
    1e240e5e6358d1a225227c3b01217887 d40046579fd327524c3602e7a0c4c89e
    eabf8ad240c738b5a3f7f2cef96115a1 e0ae5da49b341a55ad933230f58cb1e3
    1df6e22e8266ca60c02923ab0d534e6f d5db3745defd8e2f03ff6a726d6c5b51
    8d1baf92bbddbc7f11d95c411f105ad8 0ac13188a5cd7bbd2d74d012b8e5b4b0
    8969974a0c96777e65b9f109c56ec684 18f07dec3adc4d2079ee5f3ed7cb3948
""")


def _rotl(word: int, n: int) -> int:
    return (word << n | word >> (32 - n)) & 0xFFFFFFFF


def L(B: int) -> int:
    """6.2 b)."""
    return B ^ _rotl(B, 2) ^ _rotl(B, 10) ^ _rotl(B, 18) ^ _rotl(B, 24)


def L_prime(B: int) -> int:
    """7.3 c)."""
    return B ^ _rotl(B, 13) ^ _rotl(B, 23)
