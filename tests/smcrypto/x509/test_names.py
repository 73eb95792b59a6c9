"""Distinguished names: RFC 5280, 4.1.2.4, and their text, RFC 4514."""

from __future__ import annotations

from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from smcrypto import CertificateError, InvalidEncoding, InvalidOption, der
from smcrypto.x509 import Attribute, Name


def read(data: bytes) -> Name:
    return der.parse(data, Name.read)


def single(tag: int, content: bytes, oid: str = "2.5.4.3") -> bytes:
    return der.sequence(der.set_of(der.sequence(der.oid(oid), der.element(tag, content))))


# --- text ---

# RFC 4514, 4.
EXAMPLES = [
    ([("DC", "net"), ("DC", "example"), ("UID", "jsmith")], "UID=jsmith,DC=example,DC=net"),
    ([("DC", "net"), ("DC", "example"), ("CN", 'James "Jim" Smith, III')],
     'CN=James \\"Jim\\" Smith\\, III,DC=example,DC=net'),
    ([("DC", "net"), ("DC", "example"), ("CN", "Before\rAfter")], "CN=Before\\0dAfter,DC=example,DC=net"),
    ([("SN", "Lučić")], "SN=Lučić"),
]  # fmt: skip


@pytest.mark.parametrize(("pairs", "text"), EXAMPLES)
def test_examples_of_rfc_4514(pairs: list[tuple[str, str]], text: str) -> None:
    name = Name.build(pairs)
    assert str(name) == text
    assert Name.from_rfc4514(text) == name


def test_the_example_with_two_types_in_one_relative_name() -> None:
    text = "OU=Sales+CN=J.  Smith,DC=example,DC=net"
    name = Name.from_rfc4514(text)
    assert [len(rdn) for rdn in name.rdns] == [1, 1, 2]
    assert set(str(name).split(",")[0].split("+")) == {"OU=Sales", "CN=J.  Smith"}
    assert Name.from_rfc4514(str(name)) == name


def test_the_example_with_a_type_that_has_no_name() -> None:
    name = Name.from_rfc4514("1.3.6.1.4.1.1466.0=#04024869")
    assert name.attributes == (Attribute("1.3.6.1.4.1.1466.0", b"\x04\x02Hi", None),)
    assert str(name) == "1.3.6.1.4.1.1466.0=#04024869"


@pytest.mark.parametrize(
    ("value", "printed"),
    [
        ("robot, O=Evil", "robot\\, O=Evil"),
        (" lead", "\\ lead"),
        ("trail ", "trail\\ "),
        (" ", "\\ "),
        ("#0102", "\\#0102"),
        ("a#b", "a#b"),
        ("a+b<c>d;e\\f", "a\\+b\\<c\\>d\\;e\\\\f"),
        ("a\0b", "a\\00b"),
        ("line\nfeed", "line\\0afeed"),
        ("\x1b[2Jescape", "\\1b[2Jescape"),
        ("\u202egnp.exe", "\\e2\\80\\aegnp.exe"),  # a right-to-left override
        ("zero\u200bwidth", "zero\\e2\\80\\8bwidth"),
        ("no\u00a0break", "no\\c2\\a0break"),
        ("机器人一号", "机器人一号"),
    ],
)
def test_hostile_values_are_escaped(value: str, printed: str) -> None:
    name = Name.build({"CN": value})
    assert str(name) == f"CN={printed}"
    assert f"CN={printed}" in repr(name)
    assert Name.from_rfc4514(str(name)).to_der() == name.to_der()


VALUES = st.text(st.characters(exclude_categories=["Cs"]), min_size=1, max_size=30)


@given(st.lists(st.tuples(st.sampled_from(["CN", "O", "OU", "L", "ST", "2.5.4.8"]), VALUES), max_size=4))
def test_any_name_comes_back_from_its_text_and_from_its_der(pairs: list[tuple[str, str]]) -> None:
    name = Name.build(pairs)
    assert Name.from_rfc4514(str(name)).to_der() == name.to_der()
    assert str(name).isprintable()
    again = read(name.to_der())
    assert again == name and str(again) == str(name) and hash(again) == hash(name)
    assert Name(again.rdns).to_der() == name.to_der()


@given(st.text(max_size=40))
def test_any_text_is_a_name_or_refused(text: str) -> None:
    try:
        name = Name.from_rfc4514(text)
    except InvalidOption:
        return
    assert Name.from_rfc4514(str(name)).to_der() == name.to_der()


@pytest.mark.parametrize(
    "text",
    [
        "robot", "CN", "=x", "CN=a,", "CN=a,,O=b", "CN=a;O=b", 'CN="a"', "CN=a<b", "CN=", "CN=a\\", "CN=a\\zz",
        "CN=\\ff", "CN=#", "CN=#01", "CN=#0c01ff", "CN=#0c016100", "XX=y", "1=y", "CN=#12", "CN=a\0b", "CN=a+",
        "3.1=#0500",
    ],
)  # fmt: skip
def test_text_that_is_no_name(text: str) -> None:
    with pytest.raises(InvalidOption):
        Name.from_rfc4514(text)


@pytest.mark.parametrize("part", ["a", " ", "a ", "\\ ", "\\61"])
def test_long_text_is_refused_in_one_pass(part: str) -> None:
    """A parser that went back over what it read would take minutes."""
    with pytest.raises(InvalidOption):
        Name.from_rfc4514(f'CN={part * 100_000}"')


def test_blanks_around_types_and_unescaped_values_do_not_count() -> None:
    assert Name.from_rfc4514(" CN = robot ,  O=x ") == Name.build([("O", "x"), ("CN", "robot")])
    assert Name.from_rfc4514("cn=robot") == Name.build({"CN": "robot"})
    assert Name.from_rfc4514("") == Name.build({}) == Name()


# --- building ---


def test_a_name_from_each_form() -> None:
    name = Name.build({"C": "CN", "O": "Fleet", "CN": "robot_1"})
    assert str(name) == "CN=robot_1,O=Fleet,C=CN"
    assert Name.build(name) is name
    assert Name.build("CN=robot_1,O=Fleet,C=CN") == name == Name.build([("C", "CN"), ("O", "Fleet"), ("CN", "robot_1")])
    assert name.get("cn") == name.get("2.5.4.3") == "robot_1" and name.get("L") is None
    assert [a.type for a in name.attributes] == ["C", "O", "CN"]
    assert name and not Name()
    assert name != "CN=robot_1,O=Fleet,C=CN"


def test_long_names_of_types_are_understood() -> None:
    name = Name.build({"countryName": "CN", "organizationName": "Fleet", "commonName": "robot_1"})
    assert name == Name.build({"C": "CN", "O": "Fleet", "CN": "robot_1"}) and name.get("commonName") == "robot_1"
    with pytest.raises(InvalidOption, match="exactly 2"):
        Name.build({"countryName": "C"})


def test_a_dotted_type_keeps_to_no_bound_but_its_own() -> None:
    assert Name.build({"2.5.4.3": "x" * 65}).get("CN") == "x" * 65  # as CAs out there have it


def test_string_types_are_those_of_rfc_5280() -> None:
    name = Name.build({"C": "CN", "CN": "a", "DC": "a", "emailAddress": "a@b", "serialNumber": "7", "2.5.4.99": "x"})
    tags = [a.value[0] for a in name.attributes]
    assert tags == [der.PRINTABLE_STRING, der.UTF8_STRING, der.IA5_STRING, der.IA5_STRING, der.PRINTABLE_STRING,
                    der.UTF8_STRING]  # fmt: skip


@pytest.mark.parametrize(
    "subject",
    [
        {"C": "CHN"}, {"C": "C"}, {"C": "中国"}, {"CN": ""}, {"CN": "x" * 65}, {"O": "x" * 65}, {"XX": "x"}, {"": "x"},
        {"serialNumber": "a_b"}, {"emailAddress": "ü@b"}, {"DC": "ü"}, {"CN": "\ud800"}, {"2.5.4.3.": "x"},
        {"9.9": "x"}, {"1.40": "x"}, {"1.2" + ".999999999" * 30: "x"},
    ],
)  # fmt: skip
def test_names_that_cannot_be_written(subject: dict[str, str]) -> None:
    with pytest.raises(InvalidOption):
        Name.build(subject)


@pytest.mark.parametrize("subject", [{"CN": 1}, {1: "x"}, {"CN": b"x"}, [("CN",)], [("CN", "x", "y")], ["CN"], [5], 5])
def test_names_are_text(subject: Any) -> None:
    with pytest.raises(TypeError):
        Name.build(subject)


def test_an_empty_relative_name_is_refused() -> None:
    with pytest.raises(InvalidOption):
        Name([()])
    with pytest.raises(CertificateError):
        read(der.sequence(der.set_of()))


# --- reading ---


@pytest.mark.parametrize(
    ("tag", "content", "text"),
    [
        (der.UTF8_STRING, "机".encode(), "机"),
        (der.PRINTABLE_STRING, b"*.example_com@&", "*.example_com@&"),  # wider than X.680, as found in the field
        (der.IA5_STRING, b"a@b", "a@b"),
        (der.NUMERIC_STRING, b"007", "007"),
        (der.VISIBLE_STRING, b"v", "v"),
        (der.T61_STRING, b"M\xfcller", "Müller"),
        (der.BMP_STRING, "机".encode("utf-16-be"), "机"),
        (der.UNIVERSAL_STRING, "机".encode("utf-32-be"), "机"),
    ],
)
def test_every_string_type_is_read(tag: int, content: bytes, text: str) -> None:
    name = read(single(tag, content))
    assert name.get("CN") == text and str(name) == f"CN={text}"


def test_a_value_that_is_no_string_prints_as_hex() -> None:
    assert str(read(single(der.INTEGER, b"\x07"))) == "CN=#020107"


@pytest.mark.parametrize(
    ("tag", "content"),
    [(der.UTF8_STRING, b"\xff"), (der.PRINTABLE_STRING, b"\xe9"), (der.BMP_STRING, b"\x00"),
     (der.UNIVERSAL_STRING, b"\x00\x11\x00\x00"), (der.UTF8_STRING, b"\xed\xa0\x80")],
)  # fmt: skip
def test_a_string_that_is_not_one_is_refused(tag: int, content: bytes) -> None:
    with pytest.raises(CertificateError):
        read(single(tag, content))


def test_a_relative_name_out_of_order_is_refused() -> None:
    a, b = (der.sequence(der.oid(oid), der.utf8_string("x")) for oid in ("2.5.4.3", "2.5.4.10"))
    with pytest.raises(InvalidEncoding):
        read(der.sequence(der.element(der.SET, b + a)))
    assert len(read(der.sequence(der.element(der.SET, a + b))).attributes) == 2


# --- comparing: RFC 5280, 7.1 ---


@pytest.mark.parametrize("other", ["ROBOT One", " robot  one ", "robot\tone"])
def test_names_are_equal_without_regard_to_ascii_case_and_blanks(other: str) -> None:
    assert Name.build({"CN": "robot one"}) == Name.build({"CN": other})


def test_names_are_equal_without_regard_to_the_string_type() -> None:
    assert read(single(der.PRINTABLE_STRING, b"robot")) == read(single(der.UTF8_STRING, b"robot"))
    assert len({read(single(der.PRINTABLE_STRING, b"robot")), read(single(der.UTF8_STRING, b"Robot"))}) == 1


@pytest.mark.parametrize(
    "other",
    [{"CN": "robot"}, {"CN": "robot one", "O": "x"}, {"O": "robot one"}, {"CN": "robotone"}, {}],
)
def test_other_names_are_not_equal(other: dict[str, str]) -> None:
    assert Name.build({"CN": "robot one"}) != Name.build(other)


def test_a_relative_name_of_two_attributes_is_not_one_of_one() -> None:
    one, two = Name.build("CN=robot"), Name.build("CN=robot+CN=Robot")  # "the same number", RFC 5280, 7.1
    assert one != two and two == Name.build("CN=ROBOT+CN=robot")


def test_order_of_relative_names_counts() -> None:
    assert Name.build([("CN", "a"), ("O", "b")]) != Name.build([("O", "b"), ("CN", "a")])
    assert Name.build({"CN": "STRASSE"}) != Name.build({"CN": "Straße"})
    assert Name.build({"CN": "É"}) != Name.build({"CN": "é"})  # only ASCII letters fold
