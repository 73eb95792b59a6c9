"""BER of message frames becomes DER; what must be DER stays as it was."""

from __future__ import annotations

import contextlib

import pytest
from hypothesis import given
from hypothesis import strategies as st

from der_variants import unchecked
from smcrypto import InvalidEncoding, ber, der

END = b"\0\0"


def indefinite(tag: int, *parts: bytes) -> bytes:
    return bytes((tag, 0x80)) + b"".join(parts) + END


ONE, TEXT = der.integer(1), der.octet_string(b"ab")


@pytest.mark.parametrize("data, expected", [
    (der.sequence(ONE, der.sequence(TEXT)), der.sequence(ONE, der.sequence(TEXT))),
    (indefinite(0x30, ONE, indefinite(0xA0, TEXT)), der.sequence(ONE, der.explicit(0, TEXT))),
    (b"\x30\x81\x03" + ONE, der.sequence(ONE)),  # a length that is not in the fewest bytes
    (b"\x30\x84\0\0\0\x03" + ONE, der.sequence(ONE)),
    (b"\x04\x81\x01a", der.octet_string(b"a")),
    (indefinite(0x24), der.octet_string(b"")),
    (indefinite(0x24, TEXT, TEXT), der.octet_string(b"abab")),
    (der.element(0x24, indefinite(0x24, TEXT, TEXT) + TEXT), der.octet_string(b"ababab")),
    (der.sequence(indefinite(0x31)), der.sequence(der.set_of())),
    (indefinite(0x30, der.sequence(der.octet_string(bytes(70_000)))), der.sequence(der.sequence(
        der.octet_string(bytes(70_000))))),
    # the level below the frame is taken as it stands, DER or not: this is a boolean that is none
    (indefinite(0x30, indefinite(0x30, b"\x30\x03\x01\x01\x05")), der.sequence(der.sequence(b"\x30\x03\x01\x01\x05"))),
])  # fmt: skip
def test_what_becomes_der(data: bytes, expected: bytes) -> None:
    assert ber.to_der(data, below=2) == expected


@pytest.mark.parametrize("data", [
    b"", b"\x30", b"\x30\x80", b"\x30\x80\0", b"\x30\x81", b"\x30\x82\x01", b"\x30\x05" + ONE, b"\x30\x81\x80" + ONE,
    b"\x30\x85\0\0\0\0\x03" + ONE, b"\x30\xff" + ONE, der.sequence(ONE) + b"\0", indefinite(0x30) + END,
    b"\x04\x80" + END, b"\x3f\x81\x01\x00", b"\x1f\x01a", b"\x30\x09\x30\x04\x04\x05abcde", b"\x04\x85\0\0\0\0\0",
    b"\x30\x03" + indefinite(0x30), b"\x30\x04\x30\x80\0" + END,
    indefinite(0x24, ONE), indefinite(0x24, b"\x80\x01a"), indefinite(0x30, indefinite(0x30, indefinite(0x30))),
    b"\xa0\x80" * 14 + END * 14, b"\xa0\x80" * 500_000,
])  # fmt: skip
def test_what_is_refused(data: bytes) -> None:
    with pytest.raises(InvalidEncoding):
        ber.to_der(data, below=2)
    assert ber.to_der(b"\xa0\x80" * 13 + END * 13, below=2)


def test_the_work_is_bounded() -> None:
    pieces = 1 << 18
    assert ber.to_der(indefinite(0x24, TEXT * (pieces - 1))) == der.octet_string(b"ab" * (pieces - 1))
    with pytest.raises(InvalidEncoding, match="more than 262144 values"):
        ber.to_der(indefinite(0x24, TEXT * pieces))


@given(st.binary(max_size=60) | st.lists(st.sampled_from([b"\x30\x80", b"\x24\x80", b"\xa0\x80", END, ONE, TEXT,
                                                          b"\x30\x03"]), max_size=12).map(b"".join))  # fmt: skip
def test_any_bytes_become_one_value_or_are_refused(data: bytes) -> None:
    with contextlib.suppress(InvalidEncoding):
        value = ber.to_der(data, below=99)
        reader = unchecked(value)
        reader.raw()
        assert reader.at_end() and ber.to_der(value, below=99) == value
