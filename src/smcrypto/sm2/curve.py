"""The elliptic curve as a value, and its points as bytes: GB/T 32918.1-2016.

A `Curve` is the standard's system parameters (5.2.1). Everything in this package
takes it as an argument, so the standards' sample curve and curves small enough
to test exhaustively run through the code that runs on sm2p256v1.

Points that leave this module are on the curve, not at infinity and of order n:
whatever comes from outside passes `decode_point` or `require_point` first.

Not here: arithmetic (points), what is done with it (signature, encryption, exchange).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Final, TypeAlias

from smcrypto.errors import InvalidKey

__all__ = ["SM2P256V1", "Curve", "Point", "decode_point", "encode_point", "require_point"]

Point: TypeAlias = tuple[int, int]
"""A finite point in affine coordinates, 0 <= x, y < p."""


@dataclass(frozen=True, slots=True)
class Curve:
    """y^2 = x^3 + a*x + b over F_p, p = 3 mod 4 a prime, with a base point G of odd prime order n, cofactor 1."""

    name: str
    p: int
    a: int
    b: int
    n: int
    G: Point

    def __hash__(self) -> int:
        return hash((self.p, self.n))

    @property
    def field_bytes(self) -> int:
        """Bytes of a field element, GB/T 32918.1, 4.2.6."""
        return (self.p.bit_length() + 7) // 8

    @property
    def scalar_bytes(self) -> int:
        """Bytes of an integer modulo n."""
        return (self.n.bit_length() + 7) // 8

    def holds(self, point: Point) -> bool:
        """Is (x, y) a finite point of the curve? (GB/T 32918.1, 6.2.1 steps 2 and 3.)"""
        x, y = point
        return 0 <= x < self.p and 0 <= y < self.p and (y * y - (x * x + self.a) * x - self.b) % self.p == 0


SM2P256V1: Final = Curve(
    name="sm2p256v1",  # GB/T 32918.5-2017, clause 2; OID 1.2.156.10197.1.301
    p=2**256 - 2**224 - 2**96 + 2**64 - 1,
    a=2**256 - 2**224 - 2**96 + 2**64 - 4,  # p - 3
    b=0x28E9FA9E_9D9F5E34_4D5A9E4B_CF6509A7_F39789F5_15AB8F92_DDBCBD41_4D940E93,
    n=0xFFFFFFFE_FFFFFFFF_FFFFFFFF_FFFFFFFF_7203DF6B_21C6052B_53BBF409_39D54123,
    G=(
        0x32C4AE2C_1F198119_5F990446_6A39C994_8FE30BBF_F2660BE1_715A4589_334C74C7,
        0xBC3736A2_F4F6779C_59BDCEE3_6B692153_D0A9877C_C62A4740_02DF32E5_2139F0A0,
    ),
)


def require_point(point: Point, curve: Curve) -> Point:
    """`point` again if it is a public key of `curve`, else InvalidKey (GB/T 32918.1, 6.2.1).

    Step 4, [n]P = O, holds for every point, the cofactor being 1.
    """
    if not curve.holds(point):
        raise InvalidKey("the point is not on the curve")
    return point


def encode_point(point: Point, curve: Curve, *, compressed: bool = False) -> bytes:
    """04 || x || y, or 02 or 03 || x by the parity of y (GB/T 32918.1, 4.2.9)."""
    x, y = point
    size = curve.field_bytes
    if compressed:
        return bytes((2 | y & 1,)) + x.to_bytes(size, "big")
    return b"\x04" + x.to_bytes(size, "big") + y.to_bytes(size, "big")


def decode_point(data: bytes, curve: Curve, *, allow_compressed: bool = True) -> Point:
    """The point that `data` encodes, or InvalidKey (GB/T 32918.1, 4.2.10).

    Accepted are 04 || x || y and, if allowed, 02 or 03 || x. Refused are infinity (00),
    the hybrid forms 06 and 07, any other length, x or y >= p, a point off the curve.
    """
    size = curve.field_bytes
    if len(data) == 1 + 2 * size and data[0] == 4:
        x = int.from_bytes(data[1 : 1 + size], "big")
        return require_point((x, int.from_bytes(data[1 + size :], "big")), curve)
    if allow_compressed and len(data) == 1 + size and data[0] in (2, 3):
        x = int.from_bytes(data[1:], "big")
        # A root where there is one, B.1.4 for p = 3 mod 4; otherwise the point is not on the curve.
        y = pow((x * x + curve.a) * x + curve.b, (curve.p + 1) // 4, curve.p)
        if y & 1 != data[0] & 1:
            y = curve.p - y
        return require_point((x, y), curve)
    raise InvalidKey("not an encoded point")
