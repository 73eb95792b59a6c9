"""DER, the one encoding of ASN.1 values that is unique: X.690 (2021), clauses 8, 10 and 11.

One bounded reader stands under every parser of this library: signatures and
ciphertexts, key files, certificates. It takes what DER allows and nothing of
BER: definite lengths in the fewest bytes (10.1), integers in the fewest bytes
(8.3.2), booleans 00 and FF (11.1), unused bits zero (11.2.1), sets in order
(11.6). So a value that was read has one encoding only, the one that was read.

Not here: tag numbers above 30, REAL and EMBEDDED PDV, which none of our
structures use; they are refused. What a structure means is its parser's
business. No parser has to ask whether something is left over: `reading` and
`reading_sequence` do at the end of their block, and a reader does for every
value inside it before it goes on behind that value.
Every refusal is InvalidEncoding.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Container, Iterable, Iterator
from contextlib import contextmanager
from datetime import datetime, timezone
from functools import lru_cache
from typing import Final, TypeVar

from smcrypto.errors import InvalidEncoding
from smcrypto.inputs import BytesLike, as_bytes

__all__ = [
    "BIT_STRING", "BMP_STRING", "BOOLEAN", "ENUMERATED", "GENERALIZED_TIME", "IA5_STRING", "INTEGER", "NULL",
    "NUMERIC_STRING", "OCTET_STRING", "OID", "PRINTABLE_STRING", "SEQUENCE", "SET", "T61_STRING",
    "UNIVERSAL_STRING", "UTC_TIME", "UTF8_STRING", "VISIBLE_STRING", "Reader", "algorithm", "bit_string", "boolean",
    "check", "element", "enumerated", "explicit", "generalized_time", "implicit", "integer", "named_bits", "null",
    "octet_string", "oid", "parse", "reading", "reading_sequence", "sequence", "set_of", "time", "utf8_string",
]  # fmt: skip

# Identifier octets, X.690 8.1.2 and X.680 table 1; SEQUENCE and SET with the constructed bit (0x20).
BOOLEAN: Final = 0x01
INTEGER: Final = 0x02
BIT_STRING: Final = 0x03
OCTET_STRING: Final = 0x04
NULL: Final = 0x05
OID: Final = 0x06
ENUMERATED: Final = 0x0A
UTF8_STRING: Final = 0x0C
NUMERIC_STRING: Final = 0x12
PRINTABLE_STRING: Final = 0x13
T61_STRING: Final = 0x14
IA5_STRING: Final = 0x16
UTC_TIME: Final = 0x17
GENERALIZED_TIME: Final = 0x18
VISIBLE_STRING: Final = 0x1A
UNIVERSAL_STRING: Final = 0x1C
BMP_STRING: Final = 0x1E
SEQUENCE: Final = 0x30
SET: Final = 0x31

_CONSTRUCTED: Final = 0x20
_CONTEXT: Final = 0x80  # context-specific class, 8.1.2.2
# A certificate nests about ten deep; this bounds what hostile input can make a reader of readers do.
_MAX_DEPTH: Final = 32
# The tags above, each in the one form that DER has: primitive but for the last two (8.2 to 8.11, 8.19, 10.2).
_UNIVERSAL: Final = frozenset(globals()[name] for name in __all__ if name.isupper())
# Bounds in bytes of content, far above what our structures hold (20, 33 and 2): what is longer is hostile, and
# costs more than its size once it is printed in decimal or spread into a set.
_MAX_OID: Final = 64
_MAX_INTEGER: Final = 256
_MAX_NAMED_BITS: Final = 16

# 8.19.4: below the roots 0 and 1 stand arcs of up to 39. 39 digits hold the longest arcs in use, UUIDs (X.667).
_DOTTED: Final = re.compile(r"([01]\.[1-3]?[0-9]|2\.ARC)(\.ARC)*".replace("ARC", "(0|[1-9][0-9]{0,38})"))

_T = TypeVar("_T")


class Reader:
    """Reads one run of DER values front to back, never outside it.

    A method that expects another type than the one that stands next raises
    InvalidEncoding, as does anything that is not DER. A reader of what is inside a
    value is read to its end before the one that it came from goes on: what is left
    then is refused.
    """

    __slots__ = ("_data", "_depth", "_end", "_inside", "_pos")

    def __init__(self, data: bytes, start: int, end: int, depth: int) -> None:
        """For this module: a reader comes from `reading`, which sees to its end, or from another reader."""
        self._data = data
        self._pos = start
        self._end = end
        self._depth = depth
        self._inside: Reader | None = None  # the reader of the last value, until what follows that is read

    # --- the one place where lengths are read ---

    def _content(self, tag: int) -> tuple[int, int]:
        """Step over the value that stands next, which must have `tag`; (start, end) of its content."""
        if self._inside is not None:
            self._inside._complete()
            self._inside = None
        data, pos, limit = self._data, self._pos, self._end
        if pos + 2 > limit:
            raise InvalidEncoding(f"expected tag {tag:#04x} at byte {pos}, found the end")
        if data[pos] != tag:
            raise InvalidEncoding(f"expected tag {tag:#04x} at byte {pos}, found {data[pos]:#04x}")
        length = data[pos + 1]
        start = pos + 2
        if length >= 0x80:
            # 8.1.3.5 long form; 8.1.3.6 (indefinite, 0x80) is not DER (10.1). Four bytes of length are 4 GiB.
            count = length & 0x7F
            if not 1 <= count <= 4 or start + count > limit:
                raise InvalidEncoding(f"length at byte {pos + 1} is indefinite, too large or cut off")
            length = int.from_bytes(data[start : start + count], "big")
            if length < 0x80 or length >> (8 * (count - 1)) == 0:
                raise InvalidEncoding(f"length at byte {pos + 1} is not in the fewest bytes")
            start += count
        end = start + length
        if end > limit:
            raise InvalidEncoding(f"value at byte {pos} runs {end - limit} bytes past its container")
        self._pos = end
        return start, end

    def _inner(self, tag: int, *, ordered: bool = False) -> Reader:
        """A reader of what is inside; `ordered`: its values must stand in ascending order of their encodings."""
        start, end = self._content(tag)
        if self._depth >= _MAX_DEPTH:
            raise InvalidEncoding(f"more than {_MAX_DEPTH} levels deep")
        inner = self._inside = Reader(self._data, start, end, self._depth + 1)
        if ordered:
            values = inner.each(Reader.raw)
            if values != sorted(values):
                raise InvalidEncoding(f"set at byte {start} is not in ascending order")
            inner._pos = start
        return inner

    # --- position ---

    def peek_tag(self) -> int | None:
        """The identifier octet that stands next, None at the end."""
        return self._data[self._pos] if self._pos < self._end else None

    def at_end(self) -> bool:
        """Is nothing left?"""
        return self._pos >= self._end

    def _complete(self) -> None:
        """InvalidEncoding if anything is left, here or in the value read last: called by what handed the reader out."""
        if self._inside is not None:
            self._inside._complete()
        if self._pos != self._end:
            raise InvalidEncoding(f"{self._end - self._pos} bytes left over at byte {self._pos}")

    # --- values ---

    def value(self, tag: int) -> bytes:
        """The content of the next value, which must have exactly the identifier octet `tag`."""
        start, end = self._content(tag)
        return self._data[start:end]

    def raw(self) -> bytes:
        """The next value whole, identifier and length included; what is inside it is not looked at."""
        begin = self._pos
        self._content(self._tag(range(1, 0x40)))
        return self._data[begin : self._pos]

    def each(self, read: Callable[[Reader], _T]) -> list[_T]:
        """What `read` makes of this reader again and again, until nothing is left."""
        found = []
        while not self.at_end():
            found.append(read(self))
        return found

    def rest(self) -> list[bytes]:
        """All values that are left, each as `checked` gives it."""
        return self.each(Reader.checked)

    def checked(self) -> bytes:
        """As `raw`, and everything inside is DER as well, as far as its tags tell (`check`)."""
        begin = self._pos
        self._walk()
        return self._data[begin : self._pos]

    def boolean(self) -> bool:
        """A BOOLEAN: 00 or FF, nothing else (11.1)."""
        start, end = self._content(BOOLEAN)
        if end - start != 1 or self._data[start] not in (0x00, 0xFF):
            raise InvalidEncoding(f"boolean at byte {start} is neither 00 nor FF")
        return self._data[start] == 0xFF

    def integer(self, *, signed: bool = False) -> int:
        """A whole number in the fewest bytes (8.3.2); a negative one only with `signed`."""
        return self._number(INTEGER, signed)

    def enumerated(self) -> int:
        """An ENUMERATED, not negative, in the fewest bytes (8.4)."""
        return self._number(ENUMERATED, False)

    def implicit_integer(self, number: int) -> int:
        """An INTEGER under the implicit tag [number], possibly negative."""
        return self._number(_CONTEXT | number, True)

    def _number(self, tag: int, signed: bool) -> int:
        start, end = self._content(tag)
        octets = self._data[start:end]
        if not 1 <= len(octets) <= _MAX_INTEGER:
            raise InvalidEncoding(f"integer at byte {start} is empty, or longer than {_MAX_INTEGER} bytes")
        number = int.from_bytes(octets, "big", signed=True)
        if _magnitude(number) != octets:
            raise InvalidEncoding(f"integer at byte {start} is not in the fewest bytes")
        if number < 0 and not signed:
            raise InvalidEncoding(f"integer at byte {start} is negative")
        return number

    def octet_string(self) -> bytes:
        """An OCTET STRING in one piece (10.2)."""
        return self.value(OCTET_STRING)

    def bit_string(self) -> bytes:
        """A bit string of whole bytes."""
        start, end = self._content(BIT_STRING)
        if start == end or self._data[start] != 0:
            raise InvalidEncoding(f"bit string at byte {start} is not a whole number of bytes")
        return self._data[start + 1 : end]

    def named_bits(self) -> frozenset[int]:
        """The numbers of the bits that are set in a NamedBitList; zero bits at its end (11.2.2) say nothing."""
        body = self._bits()
        if len(body) > _MAX_NAMED_BITS:
            raise InvalidEncoding(f"named bits are longer than {_MAX_NAMED_BITS} bytes")
        return frozenset(8 * i + j for i, byte in enumerate(body) for j in range(8) if byte & (0x80 >> j))

    def _bits(self) -> bytes:
        """The bytes of a bit string; the unused bits of the last one must be zero (11.2.1)."""
        content = self.value(BIT_STRING)
        if not content or content[0] > 7 or (content[0] and len(content) == 1):
            raise InvalidEncoding("bit string has an impossible number of unused bits")
        if content[-1] & ((1 << content[0]) - 1):
            raise InvalidEncoding("bit string has unused bits that are not zero")
        return content[1:]

    def null(self) -> None:
        """A NULL, which is empty (8.8)."""
        start, end = self._content(NULL)
        if start != end:
            raise InvalidEncoding(f"null at byte {start} is not empty")

    def oid(self) -> str:
        """An object identifier in dotted form."""
        return _dotted(self.value(OID))

    def algorithm(self, known: Container[str], what: str) -> str:
        """The name in an AlgorithmIdentifier (RFC 5280, 4.1.1.2), one of `known`; its parameters: NULL or nothing."""
        inner = self.sequence()
        name = inner.oid()
        if name not in known:
            raise InvalidEncoding(f"the {what} is by {name}, which is not supported")
        if not inner.at_end():
            inner.null()
        return name

    def sequence(self) -> Reader:
        """A reader of what is inside a SEQUENCE."""
        return self._inner(SEQUENCE)

    def set_of(self) -> Reader:
        """The elements of a SET OF, which must stand in ascending order of their encodings (11.6)."""
        return self._inner(SET, ordered=True)

    def set_in_any_order(self) -> Reader:
        """The elements of a SET OF where a standard asks for BER only (RFC 2315): their order is not looked at."""
        return self._inner(SET)

    def implicit_set_of(self, number: int) -> Reader:
        """As `set_of`, under the implicit tag [number]."""
        return self._inner(_CONTEXT | _CONSTRUCTED | number, ordered=True)

    def explicit(self, number: int) -> Reader:
        """What is inside the constructed tag [number]: an EXPLICIT value, or an IMPLICIT sequence."""
        return self._inner(_CONTEXT | _CONSTRUCTED | number)

    def implicit(self, number: int) -> bytes:
        """The content under the primitive tag [number]."""
        return self.value(_CONTEXT | number)

    def has_explicit(self, number: int) -> bool:
        """Does the constructed tag [number] come next?"""
        return self.peek_tag() == _CONTEXT | _CONSTRUCTED | number

    def has_implicit(self, number: int) -> bool:
        """Does the primitive tag [number] come next?"""
        return self.peek_tag() == _CONTEXT | number

    def time(self) -> datetime:
        """A Time of RFC 5280, 4.1.2.5: UTCTime or GeneralizedTime, whichever the year; UTC, whole seconds."""
        tag = UTC_TIME if self.peek_tag() == UTC_TIME else GENERALIZED_TIME
        return _parse_time(tag, self.value(tag))

    def generalized_time(self, *, fraction: bool = False) -> datetime:
        """A GeneralizedTime in UTC and whole seconds (11.7; RFC 5280, 4.1.2.5.2), or with a fraction (11.7.3)."""
        whole, point, digits = self.value(GENERALIZED_TIME).partition(b"." if fraction else b"Z")
        if not fraction or not point:
            return _parse_time(GENERALIZED_TIME, whole + point + digits)
        if not digits[:-1].isdigit() or digits[-2:-1] == b"0" or digits[-1:] != b"Z":
            raise InvalidEncoding("time has a fraction that is not of the form .s*Z without zeros at the end")
        moment = _parse_time(GENERALIZED_TIME, whole + b"Z")
        return moment.replace(microsecond=int(digits[:-1][:6].ljust(6, b"0")))

    # --- walk ---

    def _tag(self, known: Container[int]) -> int:
        """The identifier octet that stands next, one of `known` if below 0x40: universal, or of an application."""
        tag = self.peek_tag()
        if tag is None:
            raise InvalidEncoding(f"expected a value at byte {self._pos}, found the end")
        if tag & 0x1F == 0x1F or (tag < 0x40 and tag not in known):
            raise InvalidEncoding(f"tag {tag:#04x} at byte {self._pos} is not used here")
        return tag

    def _walk(self) -> None:
        tag = self._tag(_UNIVERSAL)
        if tag & _CONSTRUCTED:
            inner = self._inner(tag, ordered=tag == SET)
            while not inner.at_end():
                inner._walk()
        elif tag in (INTEGER, ENUMERATED):
            self._number(tag, True)
        else:
            table = {BOOLEAN: Reader.boolean, NULL: Reader.null, OID: Reader.oid, BIT_STRING: Reader._bits}
            table.get(tag, Reader.raw)(self)


@contextmanager
def reading(data: BytesLike) -> Iterator[Reader]:
    """`with reading(data) as reader:` hands out a reader of `data`, all of which is to be read in the block."""
    octets = as_bytes(data, "data")
    reader = Reader(octets, 0, len(octets), 0)
    yield reader
    reader._complete()


@contextmanager
def reading_sequence(data: BytesLike) -> Iterator[Reader]:
    """As `reading`, of what is inside the one SEQUENCE that `data` is."""
    with reading(data) as outer:
        yield outer.sequence()


def parse(data: BytesLike, read: Callable[[Reader], _T]) -> _T:
    """What `read` makes of a reader of `data`: `parse(data, Reader.integer)` is the one INTEGER that `data` is."""
    with reading(data) as reader:
        return read(reader)


def check(data: BytesLike) -> bytes:
    """`data` again, if it is exactly one DER value and everything inside it is DER; else InvalidEncoding."""
    return parse(data, Reader.checked)


@lru_cache(maxsize=512)
def _dotted(content: bytes) -> str:
    """8.19: base 128, each arc in the fewest bytes; the first two arcs share a number."""
    if not content or content[-1] >= 0x80 or len(content) > _MAX_OID:
        raise InvalidEncoding("object identifier is empty, cut off or too long")
    arcs: list[int] = []
    number, fresh = 0, True
    for byte in content:
        if fresh and byte == 0x80:
            raise InvalidEncoding("object identifier has an arc that is not in the fewest bytes")
        number = number << 7 | byte & 0x7F
        fresh = byte < 0x80
        if fresh:
            arcs.append(number)
            number = 0
    first = min(arcs[0] // 40, 2)
    return ".".join(map(str, [first, arcs[0] - 40 * first, *arcs[1:]]))


def _parse_time(tag: int, content: bytes) -> datetime:
    """YYMMDDHHMMSSZ or YYYYMMDDHHMMSSZ (11.7, 11.8; RFC 5280, 4.1.2.5.1 and .2: no fractions, no offsets)."""
    digits = 12 if tag == UTC_TIME else 14
    if len(content) != digits + 1 or content[-1:] != b"Z" or not content[:-1].isdigit():
        raise InvalidEncoding("time is not of the form [YY]YYMMDDHHMMSSZ")
    text = content[:-1].decode("ascii")
    if tag == UTC_TIME:
        text = ("19" if text >= "50" else "20") + text
    year, rest = int(text[:4]), [int(text[i : i + 2]) for i in range(4, 14, 2)]
    try:
        return datetime(year, rest[0], rest[1], rest[2], rest[3], rest[4], tzinfo=timezone.utc)
    except ValueError:
        raise InvalidEncoding(f"there is no time {text}Z") from None


# --- writing ---


def element(tag: int, content: bytes) -> bytes:
    """One value: identifier octet, length in the fewest bytes, content."""
    length = len(content)
    if length < 0x80:
        return bytes((tag, length)) + content
    size = (length.bit_length() + 7) // 8
    return bytes((tag, 0x80 | size)) + length.to_bytes(size, "big") + content


def boolean(value: bool) -> bytes:
    """A BOOLEAN: FF for true (11.1)."""
    return b"\x01\x01\xff" if value else b"\x01\x01\x00"


def _magnitude(number: int) -> bytes:
    """Two's complement in the fewest bytes: n >= 0 needs bit_length + 1 bits, n < 0 as many as -n-1 does."""
    bits = number.bit_length() if number >= 0 else (-number - 1).bit_length()
    return number.to_bytes(bits // 8 + 1, "big", signed=True)


def integer(number: int) -> bytes:
    """An INTEGER, in the fewest bytes (8.3)."""
    return element(INTEGER, _magnitude(number))


def enumerated(number: int) -> bytes:
    """An ENUMERATED, in the fewest bytes (8.4)."""
    return element(ENUMERATED, _magnitude(number))


def octet_string(content: bytes) -> bytes:
    """An OCTET STRING."""
    return element(OCTET_STRING, content)


def bit_string(content: bytes) -> bytes:
    """A bit string of whole bytes."""
    return element(BIT_STRING, b"\x00" + content)


def named_bits(bits: Iterable[int]) -> bytes:
    """A NamedBitList with these bits set, without trailing zero bits (11.2.2)."""
    wanted = set(bits)
    top = max(wanted, default=-1)
    unused = 7 - top % 8
    number = sum(1 << (top - bit) for bit in wanted) << unused
    return element(BIT_STRING, bytes((unused,)) + number.to_bytes(top // 8 + 1, "big"))


def null() -> bytes:
    """A NULL."""
    return b"\x05\x00"


@lru_cache(maxsize=512)
def oid(dotted: str) -> bytes:
    """The object identifier written as `1.2.156.10197`; InvalidEncoding if that is not one."""
    if not _DOTTED.fullmatch(dotted):
        raise InvalidEncoding(f"not an object identifier: {dotted!r}")
    first, second, *rest = map(int, dotted.split("."))
    content = bytearray()
    for arc in (40 * first + second, *rest):
        groups = [arc & 0x7F]
        while arc := arc >> 7:
            groups.append(arc & 0x7F | 0x80)
        content += bytes(reversed(groups))
    if len(content) > _MAX_OID:
        raise InvalidEncoding(f"object identifier longer than {_MAX_OID} bytes")
    return element(OID, bytes(content))


def algorithm(dotted: str) -> bytes:
    """An AlgorithmIdentifier (RFC 5280, 4.1.1.2) with NULL for its parameters."""
    return sequence(oid(dotted), null())


def sequence(*parts: bytes) -> bytes:
    """A SEQUENCE of encoded parts, in their order."""
    return element(SEQUENCE, b"".join(parts))


def set_of(*parts: bytes) -> bytes:
    """A SET OF, its elements put in order (11.6)."""
    return element(SET, b"".join(sorted(parts)))


def explicit(number: int, *parts: bytes) -> bytes:
    """The constructed tag [number] around `parts`: an EXPLICIT value, or an IMPLICIT sequence."""
    return element(_CONTEXT | _CONSTRUCTED | number, b"".join(parts))


def implicit(number: int, content: bytes) -> bytes:
    """The primitive tag [number] around `content`."""
    return element(_CONTEXT | number, content)


def utf8_string(text: str) -> bytes:
    """A UTF8String."""
    return element(UTF8_STRING, text.encode("utf-8"))


def generalized_time(moment: datetime) -> bytes:
    """`moment`, an aware datetime, in UTC and whole seconds (a fraction is cut off)."""
    utc = moment.astimezone(timezone.utc)
    return element(GENERALIZED_TIME, f"{utc:%Y%m%d%H%M%SZ}".rjust(15, "0").encode("ascii"))


def time(moment: datetime) -> bytes:
    """A Time of RFC 5280, 4.1.2.5: UTCTime for the years 1950 to 2049, else GeneralizedTime."""
    utc = moment.astimezone(timezone.utc)
    if 1950 <= utc.year <= 2049:
        return element(UTC_TIME, f"{utc:%y%m%d%H%M%SZ}".encode("ascii"))
    return generalized_time(utc)
