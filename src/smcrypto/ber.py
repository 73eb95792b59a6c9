"""BER turned into DER, as far as messages and PKCS#12 files need it: X.690 (2021), 8.1.3.6, 8.1.4, 8.7.

Java's libraries write the frame of a message with indefinite lengths and its content in pieces. `to_der` writes
the same values again with definite lengths, strings in one piece. It converts the frame only: a SEQUENCE at the level
`below` is taken as it stands. So certificates, whose bytes are signed, remain the bytes received, and must be DER.
"""

from __future__ import annotations

from collections.abc import Iterator
from typing import Final

from smcrypto import der
from smcrypto.errors import InvalidEncoding

__all__ = ["MAX_DEPTH", "octets", "to_der"]

MAX_DEPTH: Final = 12  # a message nests six deep, and pieces of pieces are of no use to anybody
_MAX_VALUES: Final = 1 << 18  # half a second; Java's pieces have 1,000 bytes
_CONSTRUCTED: Final = 0x20


def to_der(data: bytes, below: int = MAX_DEPTH) -> bytes:
    """The one value that `data` is, with definite lengths down to the level `below`, the outermost being 0.

    InvalidEncoding: not BER, more than 12 levels deep, of more than 262,144 values, or something left over.
    """
    value, end = _converted(data, 0, len(data), 0, below, iter(range(_MAX_VALUES)))
    if end != len(data):
        raise InvalidEncoding(f"{len(data) - end} bytes left over at byte {end}")
    return value


def _converted(
    data: bytes, begin: int, limit: int, level: int, below: int, budget: Iterator[int]
) -> tuple[bytes, int]:
    """The value at `begin`, which ends by `limit`, and where it ends; `budget` gives a number for each value."""
    if next(budget, None) is None:
        raise InvalidEncoding(f"more than {_MAX_VALUES} values")
    head = data[begin : min(begin + 6, limit)]
    if len(head) < 2 or head[0] & 0x1F == 0x1F or level > MAX_DEPTH:
        raise InvalidEncoding(f"the value at byte {begin} is cut off, more than {MAX_DEPTH} levels deep, or strange")
    tag, first = head[0], head[1]
    count = first & 0x7F if first > 0x80 else 0
    start = begin + 2 + count
    end = start + (int.from_bytes(head[2 : 2 + count], "big") if count else first & 0x7F)
    if count > len(head) - 2 or end > limit:
        raise InvalidEncoding(f"the value at byte {begin} is cut off, or too long")
    indefinite = first == 0x80
    if not tag & _CONSTRUCTED or (tag == der.SEQUENCE and level == below):
        if indefinite:
            raise InvalidEncoding(f"the value at byte {begin} has no definite length, which it must have here")
        return data[begin:end] if tag & _CONSTRUCTED else der.element(tag, data[start:end]), end
    position, parts = start, []
    while data[position : min(position + 2, limit)] != b"\0\0" if indefinite else position < end:
        part, position = _converted(data, position, limit if indefinite else end, level + 1, below, budget)
        parts.append(part)
    content = b"".join(parts)
    if tag == der.OCTET_STRING | _CONSTRUCTED:
        return der.octet_string(der.parse(content, octets)), position + 2 * indefinite
    return der.element(tag, content), position + 2 * indefinite


def octets(pieces: der.Reader) -> bytes:
    """The OCTET STRINGs that are left in `pieces`, one after the other."""
    return b"".join(pieces.each(der.Reader.octet_string))
