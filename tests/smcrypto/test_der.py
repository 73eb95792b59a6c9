"""DER: what X.690 demands, what it forbids, and that a value has one encoding only."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from datetime import datetime, timedelta, timezone
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from der_variants import unchecked
from smcrypto import InvalidEncoding, der

UTC = timezone.utc


def one(data: bytes, read: Callable[[der.Reader], Any]) -> Any:
    return der.parse(data, read)


# --- examples of the standard ---


@pytest.mark.parametrize(
    ("number", "encoded"),
    [  # X.690, 8.3: two's complement in the fewest octets
        (0, "020100"), (1, "020101"), (127, "02017f"), (128, "02020080"), (255, "020200ff"), (256, "02020100"),
        (-1, "0201ff"), (-128, "020180"), (-129, "0202ff7f"), (-256, "0202ff00"), (2**64, "0209010000000000000000"),
    ],
)  # fmt: skip
def test_integers_are_the_shortest_twos_complement(number: int, encoded: str) -> None:
    assert der.integer(number).hex() == encoded
    assert one(bytes.fromhex(encoded), lambda r: r.integer(signed=True)) == number


@pytest.mark.parametrize(
    ("dotted", "encoded"),
    [
        ("2.999.3", "0603883703"),  # X.690, 8.19.5
        ("1.2.840.113549", "06062a864886f70d"),
        ("1.2.156.10197.1.301", "06082a811ccf5501822d"),  # sm2p256v1, as it stands in every SM2 key
        ("0.39", "060127"), ("1.0", "060128"), ("2.0", "060150"), ("2.47", "06017f"), ("2.48", "06028100"),
    ],
)  # fmt: skip
def test_object_identifiers(dotted: str, encoded: str) -> None:
    assert der.oid(dotted).hex() == encoded
    assert one(bytes.fromhex(encoded), der.Reader.oid) == dotted


def test_tags_are_those_of_x_680() -> None:
    """Table 1; SEQUENCE and SET with the bit for constructed values (X.690, 8.1.2.5)."""
    numbers = {
        "BOOLEAN": 1, "INTEGER": 2, "BIT_STRING": 3, "OCTET_STRING": 4, "NULL": 5, "OID": 6, "ENUMERATED": 10,
        "UTF8_STRING": 12, "SEQUENCE": 16 + 32, "SET": 17 + 32, "NUMERIC_STRING": 18, "PRINTABLE_STRING": 19,
        "T61_STRING": 20, "IA5_STRING": 22, "UTC_TIME": 23, "GENERALIZED_TIME": 24, "VISIBLE_STRING": 26,
        "UNIVERSAL_STRING": 28, "BMP_STRING": 30,
    }  # fmt: skip
    assert {name: getattr(der, name) for name in der.__all__ if name.isupper()} == numbers


def test_a_length_of_four_bytes_is_read() -> None:
    data = b"\x04\x84\x01\0\0\0" + bytes(1 << 24)
    assert der.element(der.OCTET_STRING, bytes(1 << 24)) == data
    assert one(data, der.Reader.octet_string) == bytes(1 << 24)


def test_named_bits_of_16_bytes_are_read() -> None:
    assert one(bytes.fromhex("031100" + "ff" * 16), der.Reader.named_bits) == frozenset(range(128))


def test_named_bits_carry_no_trailing_zeros() -> None:
    # keyCertSign and cRLSign are bits 5 and 6: every CA certificate has these four bytes.
    assert der.named_bits({5, 6}) == bytes.fromhex("03020106")
    assert one(bytes.fromhex("03020006"), der.Reader.named_bits) == {5, 6}
    assert der.named_bits({0, 8}) == bytes.fromhex("0303078080")
    assert der.named_bits(()) == bytes.fromhex("030100")


def test_lengths_are_in_the_fewest_bytes() -> None:
    assert der.octet_string(bytes(127))[:2].hex() == "047f"
    assert der.octet_string(bytes(128))[:3].hex() == "048180"
    assert der.octet_string(bytes(256))[:4].hex() == "04820100"
    assert der.octet_string(bytes(65536))[:5].hex() == "0483010000"


def test_a_set_is_put_in_order() -> None:
    assert der.set_of(der.integer(2), der.integer(1)).hex() == "3106020101020102"


def test_times_follow_rfc_5280() -> None:
    assert der.time(datetime(2049, 12, 31, 23, 59, 59, tzinfo=UTC)) == b"\x17\x0d491231235959Z"
    assert der.time(datetime(2050, 1, 1, tzinfo=UTC)) == b"\x18\x0f20500101000000Z"
    assert der.time(datetime(1950, 1, 1, tzinfo=UTC)) == b"\x17\x0d500101000000Z"
    assert der.time(datetime(1949, 12, 31, tzinfo=UTC)) == b"\x18\x0f19491231000000Z"
    assert der.generalized_time(datetime(33, 4, 3, tzinfo=UTC)) == b"\x18\x0f00330403000000Z"
    east = timezone(timedelta(hours=8))
    assert der.time(datetime(2026, 1, 1, 7, 30, tzinfo=east)) == b"\x17\x0d251231233000Z"
    assert one(b"\x17\x0d491231235959Z", der.Reader.time) == datetime(2049, 12, 31, 23, 59, 59, tzinfo=UTC)
    assert one(b"\x17\x0d500101000000Z", der.Reader.time).year == 1950
    assert one(b"\x18\x0f20500101000000Z", der.Reader.time).year == 2050


# --- what is not DER ---

REFUSED = {
    "nothing where a value is due": ("", "integer"),
    "an identifier without a length": ("02", "integer"),
    "another type": ("0401ff", "integer"),
    "indefinite length (10.1)": ("3080020101 0000", "sequence"),
    "long length where one byte does (10.1)": ("02810101", "integer"),
    "length with a leading zero (10.1)": ("0482000101", "octet_string"),
    "length of a length cut off": ("0482ff", "octet_string"),
    "a length of five bytes": ("04850000000001ff", "octet_string"),
    "length 0xFF (8.1.3.5 c)": ("04ff" + "01" * 127, "octet_string"),
    "a value longer than its container": ("040200", "octet_string"),
    "an inner value longer than its container": ("3003020201", "nested"),
    "an empty integer (8.3.1)": ("0200", "integer"),
    "an integer with a superfluous 00 (8.3.2)": ("0202007f", "integer"),
    "an integer with a superfluous FF (8.3.2)": ("0202ff80", "signed"),
    "a negative integer": ("0201ff", "integer"),
    "a negative enumerated": ("0a0180", "enumerated"),
    "boolean 01 (11.1)": ("010101", "boolean"),
    "boolean of two bytes": ("01020000", "boolean"),
    "null with content": ("050100", "null"),
    "bit string without its count": ("0300", "bit_string"),
    "bit string that is not whole bytes": ("03020780", "bit_string"),
    "bit string without its count, as named bits": ("0300", "named_bits"),
    "eight unused bits": ("03020800", "named_bits"),
    "unused bits of nothing": ("030101", "named_bits"),
    "unused bits that are set (11.2.1)": ("030201ff", "named_bits"),
    "an empty object identifier": ("0600", "oid"),
    "an object identifier cut off": ("060188", "oid"),
    "an arc with a leading 80 (8.19.2)": ("06038037 03", "oid"),
    "an endless object identifier": ("0641" + "01" * 65, "oid"),
    "an integer of 257 bytes": ("02820101" + "01" * 257, "integer"),
    "named bits of 17 bytes": ("031200" + "ff" * 17, "named_bits"),
    "a set out of order (11.6)": ("3106020102020101", "set_of"),
    "a tag number above 30": ("9f1f00", "raw"),
    "end-of-contents": ("0000", "raw"),
    "raw at the end": ("", "raw"),
    "checked at the end": ("", "checked"),
    "a sequence that is primitive": ("1000", "checked"),
    "an octet string in pieces (10.2)": ("2403040100", "checked"),
    "an object descriptor": ("0700", "checked"),
    "a REAL": ("0900", "checked"),
    "a high tag inside": ("30031f0100", "checked"),
    "a bad boolean inside": ("3003010101", "checked"),
    "a bad integer inside": ("30040202007f", "checked"),
    "bad unused bits inside": ("3004030201ff", "checked"),
    "a bad null inside": ("3003050100", "checked"),
    "a bad object identifier inside": ("3003060188", "checked"),
    "a set out of order inside": ("30083106020102020101", "checked"),
    "UTCTime without seconds": ("170b3530303130313030" + "30305a", "time"),
    "UTCTime with an offset": ("1711" + b"260101000000+0800".hex(), "time"),
    "UTCTime without Z": ("170d" + b"2601010000000".hex(), "time"),
    "a month 13": ("170d" + b"261301000000Z".hex(), "time"),
    "29 February of a common year": ("170d" + b"260229000000Z".hex(), "time"),
    "hour 24": ("170d" + b"260101240000Z".hex(), "time"),
    "letters in a time": ("170d" + b"26O101000000Z".hex(), "time"),
    "GeneralizedTime with fractions": ("1811" + b"20500101000000.5Z".hex(), "time"),
    "year 0": ("180f" + b"00000101000000Z".hex(), "time"),
}
SPECIAL = {
    "nested": lambda r: r.sequence().integer(),
    "signed": lambda r: r.integer(signed=True),
    "implicit_integer": lambda r: r.implicit_integer(2),
}


@pytest.mark.parametrize("case", REFUSED)
def test_refused(case: str) -> None:
    encoded, method = REFUSED[case]
    read = SPECIAL.get(method) or (lambda r: getattr(r, method)())
    with pytest.raises(InvalidEncoding):
        read(unchecked(bytes.fromhex(encoded)))


@pytest.mark.parametrize(
    "dotted",
    ["", "1", "3.1", "1.40", "1.2.", "1..2", "1.02", "a.b", "1.-2", "1.٢", "2." + "9" * 99, "1.2" + ".999999999" * 20],
)
def test_no_object_identifier(dotted: str) -> None:
    with pytest.raises(InvalidEncoding):
        der.oid(dotted)


def test_what_is_left_over_is_refused_at_the_end_of_the_block() -> None:
    with pytest.raises(InvalidEncoding, match="1 bytes left over at byte 3"), der.reading(der.integer(1) + b"\0") as r:
        assert r.integer() == 1
    with pytest.raises(InvalidEncoding, match="3 bytes left over at byte 5"), der.reading_sequence(
        der.sequence(der.integer(1), der.integer(2))
    ) as r:
        assert r.integer() == 1
    with pytest.raises(InvalidEncoding, match="2 bytes left over at byte 5"), der.reading_sequence(
        der.sequence(der.integer(1)) + der.null()
    ) as r:
        assert r.integer() == 1
    with pytest.raises(InvalidEncoding, match="left over"):
        der.parse(der.integer(1) + der.null(), der.Reader.integer)


def test_the_error_of_a_parser_is_not_replaced_by_what_is_left_over() -> None:
    with pytest.raises(KeyError), der.reading(der.integer(1)):
        raise KeyError


def _forget_and_go_on(reader: der.Reader) -> None:
    reader.sequence().integer()
    reader.null()


def _forget_and_open_the_next(reader: der.Reader) -> None:
    reader.sequence()
    reader.checked()


def _forget_at_the_end(reader: der.Reader) -> None:
    reader.sequence().integer()
    reader.sequence().raw()


def _forget_two_levels_down(reader: der.Reader) -> None:
    reader.checked()
    reader.sequence().explicit(0)


@pytest.mark.parametrize(
    "forget", [_forget_and_go_on, _forget_and_open_the_next, _forget_at_the_end, _forget_two_levels_down]
)
def test_no_parser_can_forget_what_is_left_inside_a_value(forget: Callable[[der.Reader], None]) -> None:
    """Two of the changes of fuzz/mutate.py that no test noticed were a forgotten check for what is left over."""
    data = {
        _forget_and_go_on: der.sequence(der.integer(1), der.null()) + der.null(),
        _forget_and_open_the_next: der.sequence(der.integer(1)) + der.sequence(),
        _forget_at_the_end: der.sequence(der.integer(1)) + der.sequence(der.null(), der.null()),
        _forget_two_levels_down: der.null() + der.sequence(der.explicit(0, der.null())),
    }[forget]
    with pytest.raises(InvalidEncoding, match="left over"):
        der.parse(data, forget)


def test_the_rest_is_every_value_and_each_is_der() -> None:
    with der.reading_sequence(der.sequence(der.integer(1), der.null(), der.sequence())) as r:
        assert r.integer() == 1
        assert r.rest() == [der.null(), der.sequence()] and r.rest() == []
    with pytest.raises(InvalidEncoding, match="fewest bytes"), der.reading(bytes.fromhex("020100 02020001")) as r:
        r.rest()


@pytest.mark.parametrize("walk", [True, False])
def test_depth_is_bounded(walk: bool) -> None:
    data = b"\x05\x00"
    for _ in range(40):
        data = der.sequence(data)
    with pytest.raises(InvalidEncoding, match="levels deep"):
        if walk:
            der.check(data)
        else:
            reader = unchecked(data)
            while reader.peek_tag() == der.SEQUENCE:
                reader = reader.sequence()


def test_data_must_be_bytes() -> None:
    with pytest.raises(TypeError), der.reading("30 00"):  # type: ignore[arg-type]
        pass
    with pytest.raises(TypeError):
        der.Reader(b"")  # type: ignore[call-arg]
    assert one(bytearray(b"\x05\x00"), der.Reader.null) is None


def test_tagged_values() -> None:
    data = der.explicit(0, der.integer(7)) + der.implicit(1, b"seven") + der.explicit(2, der.integer(2), der.integer(3))
    reader = unchecked(data)
    assert reader.has_explicit(0) and not reader.has_implicit(0)
    inner = reader.explicit(0)
    assert inner.integer() == 7
    assert reader.has_implicit(1) and reader.implicit(1) == b"seven"
    members = reader.implicit_set_of(2)
    assert (members.integer(), members.integer()) == (2, 3)
    assert reader.at_end() and reader.peek_tag() is None
    assert one(der.octet_string(b"octets"), der.Reader.octet_string) == b"octets"
    assert one(der.boolean(True), der.Reader.boolean) is True
    assert one(der.boolean(False), der.Reader.boolean) is False
    assert one(der.null(), der.Reader.null) is None
    assert one(der.enumerated(4), der.Reader.enumerated) == 4
    assert one(der.bit_string(b"\x80\x01"), der.Reader.bit_string) == b"\x80\x01"
    assert one(der.utf8_string("机器人"), lambda r: r.value(der.UTF8_STRING)).decode() == "机器人"


def test_other_classes_are_passed_over_unread() -> None:
    for data in (b"\x40\x01\xff", b"\xc0\x00", b"\x60\x03\x02\x01\x05"):
        assert der.check(data) == data
    with pytest.raises(InvalidEncoding):
        der.check(b"\x60\x03\x02\x02\x05")


# --- properties ---


@given(st.integers(-(2**600), 2**600))
def test_any_integer_comes_back(number: int) -> None:
    assert one(der.integer(number), lambda r: r.integer(signed=True)) == number


@given(st.sets(st.integers(0, 40)))
def test_any_named_bits_come_back(bits: set[int]) -> None:
    assert one(der.named_bits(bits), der.Reader.named_bits) == bits


@given(st.lists(st.integers(0, 2**70), max_size=5), st.integers(0, 2), st.integers(0, 39))
def test_any_object_identifier_comes_back(arcs: list[int], first: int, second: int) -> None:
    dotted = ".".join(map(str, [first, second, *arcs]))
    assert one(der.oid(dotted), der.Reader.oid) == dotted


@given(st.datetimes(datetime(1, 1, 1), datetime(9999, 12, 31, 23, 59, 59)))
def test_any_time_comes_back_to_the_second(moment: datetime) -> None:
    aware = moment.replace(tzinfo=UTC, microsecond=0)
    assert one(der.time(aware), der.Reader.time) == aware


LEAVES = st.one_of(
    st.integers(-(2**70), 2**70).map(der.integer),
    st.booleans().map(der.boolean),
    st.binary(max_size=200).map(der.octet_string),
    st.binary(max_size=40).map(der.bit_string),
    st.just(der.null()),
    st.text(max_size=20).map(der.utf8_string),
    st.sampled_from(["1.2.156.10197.1.301", "2.5.4.3"]).map(der.oid),
    st.binary(max_size=20).map(lambda content: der.implicit(5, content)),
)
TREES = st.recursive(
    LEAVES,
    lambda children: st.one_of(
        st.lists(children, max_size=4).map(lambda parts: der.sequence(*parts)),
        st.lists(children, max_size=4).map(lambda parts: der.set_of(*parts)),
        children.map(lambda part: der.explicit(3, part)),
    ),
    max_leaves=20,
)


def rewritten(reader: der.Reader) -> bytes:
    """Read everything by its meaning and write it again."""
    out = b""
    while (tag := reader.peek_tag()) is not None:
        match tag:
            case der.INTEGER:
                out += der.integer(reader.integer(signed=True))
            case der.BOOLEAN:
                out += der.boolean(reader.boolean())
            case der.NULL:
                reader.null()
                out += der.null()
            case der.OID:
                out += der.oid(reader.oid())
            case der.SEQUENCE:
                out += der.sequence(rewritten(reader.sequence()))
            case _ if tag & 0x20:
                inner = reader.set_of() if tag == der.SET else reader.explicit(tag & 0x1F)
                out += der.element(tag, rewritten(inner))
            case _:
                out += der.element(tag, reader.value(tag))
    return out


@given(TREES)
def test_what_is_written_is_der_and_reads_back_the_same(data: bytes) -> None:
    assert der.check(data) == data
    assert rewritten(unchecked(data)) == data


@given(TREES, st.data())
def test_altered_der_is_refused_or_has_one_encoding_still(data: bytes, draw: st.DataObject) -> None:
    position = draw.draw(st.integers(0, len(data) - 1))
    altered = bytearray(data)
    altered[position] = draw.draw(st.integers(0, 255))
    try:
        der.check(altered)
    except InvalidEncoding:
        return
    if altered[0] & 0xC0 in (0x00, 0x80):
        try:
            again = rewritten(unchecked(bytes(altered)))
        except InvalidEncoding:  # application and private classes, which `rewritten` does not read
            return
        assert again == altered


@given(st.binary(max_size=64))
def test_any_bytes_are_der_or_refused(data: bytes) -> None:
    try:
        assert der.check(data) == data
    except InvalidEncoding:
        return


def test_openssl_parses_what_is_written(require: Callable[[str], str]) -> None:
    data = der.sequence(
        der.integer(-129), der.oid("1.2.156.10197.1.501"), der.set_of(der.utf8_string("b"), der.utf8_string("a")),
        der.explicit(0, der.generalized_time(datetime(2050, 1, 1, tzinfo=UTC))), der.octet_string(bytes(300)),
    )  # fmt: skip
    command = [require("openssl"), "asn1parse", "-inform", "DER"]
    done = subprocess.run(command, input=data, capture_output=True, check=True)
    text = done.stdout.decode()
    assert "INTEGER           :-81" in text and "SM2-with-SM3" in text and "20500101000000Z" in text
    assert text.index("UTF8STRING        :a") < text.index("UTF8STRING        :b")


def _read_fraction(reader: der.Reader) -> datetime:
    return reader.generalized_time(fraction=True)


def test_generalized_time_with_a_fraction_only_where_it_is_asked_for() -> None:
    """X.690, 11.7: a point, no zeros at the end, no point alone, Z."""
    whole, half = (der.element(der.GENERALIZED_TIME, text) for text in (b"20260601120000Z", b"20260601120000.5Z"))
    moment = datetime(2026, 6, 1, 12, tzinfo=UTC)
    assert one(whole, der.Reader.generalized_time) == one(whole, _read_fraction) == moment
    assert one(half, _read_fraction) == moment.replace(microsecond=500_000)
    long = der.element(der.GENERALIZED_TIME, b"20260601120000.00000012Z")
    assert one(long, _read_fraction) == moment
    with pytest.raises(InvalidEncoding, match="not of the form"):
        one(half, der.Reader.generalized_time)
    for text in (b"20260601120000.Z", b"20260601120000.50Z", b"20260601120000.5", b"20260601120000.5+", b"1.5Z", b".Z"):
        with pytest.raises(InvalidEncoding):
            one(der.element(der.GENERALIZED_TIME, text), _read_fraction)
