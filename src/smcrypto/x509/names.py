"""Distinguished names: RFC 5280, 4.1.2.4 and 7.1; written as text by RFC 4514.

A name keeps the bytes it was read from. Two names are the same when their
attributes are, compared without regard to ASCII case, to runs of blanks and to
which string type carries the text: the rules of RFC 5280, 7.1 but for Unicode
normalisation, as OpenSSL has them.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping
from typing import Final, NamedTuple

from smcrypto import der
from smcrypto.errors import CertificateError, InvalidEncoding, InvalidOption
from smcrypto.inputs import require_type

__all__ = ["Attribute", "Name", "written_oid"]

# Attribute types: short name (RFC 4514, 3, and OpenSSL's for the rest), long name (X.520, RFC 4519; understood, never
# printed), identifier, upper bound in characters on writing (RFC 5280, appendix A.1), string type on writing.
_TYPES: Final = (
    ("CN", "commonName", "2.5.4.3", 64, der.UTF8_STRING),
    ("SN", "surname", "2.5.4.4", 40, der.UTF8_STRING),
    ("serialNumber", "serialNumber", "2.5.4.5", 64, der.PRINTABLE_STRING),
    ("C", "countryName", "2.5.4.6", 2, der.PRINTABLE_STRING),
    ("L", "localityName", "2.5.4.7", 128, der.UTF8_STRING),
    ("ST", "stateOrProvinceName", "2.5.4.8", 128, der.UTF8_STRING),
    ("STREET", "streetAddress", "2.5.4.9", 128, der.UTF8_STRING),
    ("O", "organizationName", "2.5.4.10", 64, der.UTF8_STRING),
    ("OU", "organizationalUnitName", "2.5.4.11", 64, der.UTF8_STRING),
    ("title", "title", "2.5.4.12", 64, der.UTF8_STRING),
    ("GN", "givenName", "2.5.4.42", 16, der.UTF8_STRING),
    ("initials", "initials", "2.5.4.43", 5, der.UTF8_STRING),
    ("generationQualifier", "generationQualifier", "2.5.4.44", 3, der.UTF8_STRING),
    ("dnQualifier", "dnQualifier", "2.5.4.46", 64, der.PRINTABLE_STRING),
    ("pseudonym", "pseudonym", "2.5.4.65", 128, der.UTF8_STRING),
    ("UID", "userId", "0.9.2342.19200300.100.1.1", 256, der.UTF8_STRING),
    ("DC", "domainComponent", "0.9.2342.19200300.100.1.25", 63, der.IA5_STRING),
    ("emailAddress", "emailAddress", "1.2.840.113549.1.9.1", 255, der.IA5_STRING),
)
_BY_OID: Final = {oid: short for short, _, oid, _, _ in _TYPES}
_BY_NAME: Final = {
    name.lower(): (oid, bound, tag) for short, long, oid, bound, tag in _TYPES for name in (short, long)
}
_COUNTRY: Final = "2.5.4.6"
_PRINTABLE: Final = re.compile(r"[A-Za-z0-9 '()+,\-./:=?]*")  # X.680, 41.4
# PrintableString is read more widely than X.680 allows, because CAs write "*", "@", "_" and "&" into it.
_CODECS: Final = {
    der.UTF8_STRING: "utf-8",
    der.PRINTABLE_STRING: "ascii",
    der.NUMERIC_STRING: "ascii",
    der.IA5_STRING: "ascii",
    der.VISIBLE_STRING: "ascii",
    der.T61_STRING: "latin-1",
    der.BMP_STRING: "utf-16-be",
    der.UNIVERSAL_STRING: "utf-32-be",
}
_SPECIAL: Final = re.compile(r'["+,;<>\\]|\A[ #]| \Z')


class Attribute(NamedTuple):
    """One type and value; `text` is None where the value is not of a string type."""

    oid: str
    value: bytes
    """The value in DER."""
    text: str | None

    @property
    def type(self) -> str:
        """The short name of the type, its dotted identifier where it has none."""
        return _BY_OID.get(self.oid, self.oid)


class Name:
    """A distinguished name: relative names from the root of the tree downwards, each a set of attributes."""

    __slots__ = ("_der", "_rdns")

    def __init__(self, rdns: Iterable[Iterable[Attribute]] = ()) -> None:
        self._rdns = tuple(tuple(sorted(rdn, key=_encode_attribute)) for rdn in rdns)
        if not all(self._rdns):
            raise InvalidOption("a relative distinguished name needs an attribute")
        self._der = der.sequence(*(der.set_of(*map(_encode_attribute, rdn)) for rdn in self._rdns))

    @classmethod
    def build(cls, subject: Name | str | Mapping[str, str] | Iterable[tuple[str, str]]) -> Name:
        """A name from what callers have: `{"C": "CN", "CN": "robot_1"}`, pairs, RFC 4514 text, or a Name.

        Order is kept: the first entry is the one nearest to the root, printed
        last. In text it is the other way round (RFC 4514, 2.1).
        InvalidOption: an unknown type, an empty or too long value, a character its string type lacks.
        """
        if isinstance(subject, Name):
            return subject
        if isinstance(subject, str):
            return cls.from_rfc4514(subject)
        pairs = tuple(subject.items() if isinstance(subject, Mapping) else subject)
        for pair in pairs:
            if not isinstance(pair, tuple | list) or len(pair) != 2:
                raise TypeError(f"a name is made of pairs of type and value, not of {pair!r}")
        return cls((_attribute(kind, text),) for kind, text in pairs)

    @classmethod
    def from_rfc4514(cls, text: str) -> Name:
        """The name that `text` spells, as `str` prints it (RFC 4514, 3)."""
        return cls(reversed(_parse(text))) if text else cls()

    @classmethod
    def read(cls, reader: der.Reader) -> Name:
        """Name ::= RDNSequence, X.501, 9.2. CertificateError for a string that is not one."""
        rdns = reader.sequence().each(lambda one: one.set_of().each(lambda member: _read_attribute(member.sequence())))
        if not all(rdns):
            raise CertificateError("a relative distinguished name is empty")
        return cls(rdns)  # in DER there is one way to write it, the one that was read

    @property
    def rdns(self) -> tuple[tuple[Attribute, ...], ...]:
        """The relative distinguished names, from the root downwards, each of one attribute or more."""
        return self._rdns

    @property
    def attributes(self) -> tuple[Attribute, ...]:
        """All attributes, from the root downwards."""
        return tuple(attribute for rdn in self._rdns for attribute in rdn)

    def get(self, kind: str) -> str | None:
        """The text of the last attribute of type `kind` ("CN", or a dotted identifier), None if there is none."""
        require_type(kind, str, "kind")
        oid, _, _ = _BY_NAME.get(kind.lower(), (kind, 0, 0))
        return next((a.text for a in reversed(self.attributes) if a.oid == oid), None)

    def to_der(self) -> bytes:
        """The bytes it was read from, or the name written (X.501, 9.2)."""
        return self._der

    def rfc4514(self) -> str:
        """RFC 4514, 2: the last relative name first; what could mislead a reader is escaped."""
        return ",".join("+".join(_print_attribute(a) for a in rdn) for rdn in reversed(self._rdns))

    __str__ = rfc4514

    def _comparable(self) -> tuple[tuple[int, frozenset[tuple[str, bytes | str]]], ...]:
        folded = ([(a.oid, a.value if a.text is None else _fold(a.text)) for a in rdn] for rdn in self._rdns)
        return tuple((len(rdn), frozenset(rdn)) for rdn in folded)

    def __bool__(self) -> bool:
        return bool(self._rdns)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Name):
            return NotImplemented
        return self._der == other._der or self._comparable() == other._comparable()

    def __hash__(self) -> int:
        return hash(self._comparable())

    def __repr__(self) -> str:
        return f"<Name {self.rfc4514()}>"


_ASCII_LOWER: Final = {upper: upper + 32 for upper in range(ord("A"), ord("Z") + 1)}


def _fold(text: str) -> str:
    """RFC 5280, 7.1 by way of OpenSSL: blanks at the ends gone, runs of them one, ASCII letters small."""
    return " ".join(re.split(r"[ \t\n\v\f\r]+", text.strip(" \t\n\v\f\r"))).translate(_ASCII_LOWER)


def _encode_attribute(attribute: Attribute) -> bytes:
    return der.sequence(der.oid(attribute.oid), attribute.value)


def _read_attribute(reader: der.Reader) -> Attribute:
    oid = reader.oid()
    value = reader.checked()
    codec = _CODECS.get(value[0])
    text = None
    if codec is not None:
        content = der.parse(value, lambda one: one.value(value[0]))
        try:
            text = content.decode(codec)
        except UnicodeDecodeError:
            raise CertificateError(f"a name's {_BY_OID.get(oid, oid)} is not {codec} text") from None
    return Attribute(oid, value, text)


def written_oid(dotted: str, problem: str) -> bytes:
    """The object identifier in DER; InvalidOption, saying `problem`, if it is none."""
    try:
        return der.oid(dotted)
    except InvalidEncoding:
        raise InvalidOption(problem) from None


def _attribute(kind: str, text: str) -> Attribute:
    require_type(kind, str, "a name's type")
    require_type(text, str, "a name's value")
    oid, bound, tag = _BY_NAME.get(kind.lower(), (kind, 32768, der.UTF8_STRING))
    written_oid(oid, f"unknown attribute type {kind!r}; a dotted object identifier names any other")
    if not 1 <= len(text) <= bound or (oid == _COUNTRY and len(text) != 2):
        limits = "exactly 2" if oid == _COUNTRY else f"1 to {bound}"
        raise InvalidOption(f"a name's {kind} must have {limits} characters, not {len(text)}")
    if tag == der.PRINTABLE_STRING and not _PRINTABLE.fullmatch(text):
        raise InvalidOption(f"a name's {kind} takes letters, digits, blank and '()+,-./:=? only")
    try:
        return Attribute(oid, der.element(tag, text.encode(_CODECS[tag])), text)
    except UnicodeEncodeError:
        raise InvalidOption(f"a name's {kind} has a character that {_CODECS[tag]} cannot write") from None


# --- RFC 4514 text ---


def _print_attribute(attribute: Attribute) -> str:
    if attribute.text is None or attribute.oid not in _BY_OID:
        # 2.4: types without a short name, and values that are not strings, as # and the DER in hex.
        return f"{attribute.type}=#{attribute.value.hex()}"
    return f"{attribute.type}={_escape(attribute.text)}"


def _escape(text: str) -> str:
    """2.4, and hex pairs for whatever does not print: controls, line ends, bidirectional marks, odd blanks."""
    return "".join(
        c if c.isprintable() else "".join(f"\\{byte:02x}" for byte in c.encode("utf-8", "surrogatepass"))
        for c in _SPECIAL.sub(r"\\\g<0>", text)
    )


# 3: one type and value, up to the separator. Blanks around both do not count unless they are escaped; a leading #
# that is not escaped precedes the value's DER in hex.
_KIND: Final = r"\s*([A-Za-z][A-Za-z0-9-]*|[0-9]+(?:\.[0-9]+)+)\s*=\s*(?!\s)"
_ESCAPED: Final = r'\\(?:[0-9A-Fa-f]{2}|[ "#+,;<=>\\])'
_PLAIN: Final = r'[^\\"+,;<>\x00'
_VALUE: Final = rf"(?!#)((?:(?:{_ESCAPED}|{_PLAIN}])*(?:{_ESCAPED}|{_PLAIN} ]))?)"
_PART: Final = re.compile(rf"{_KIND}(?:#((?:[0-9A-Fa-f]{{2}})+)|{_VALUE}) *([+,]|\Z)")
_ESCAPE: Final = re.compile(r"((?:\\[0-9A-Fa-f]{2})+)|\\(.)")


def _parse(text: str) -> list[list[Attribute]]:
    """RFC 4514, 3: the relative names in the order of the text."""
    rdns: list[list[Attribute]] = [[]]
    position = 0
    while (part := _PART.match(text, position)) is not None:
        kind, hexadecimal, value, separator = part.groups()
        rdns[-1].append(_attribute(kind, _ESCAPE.sub(_unescape, value)) if hexadecimal is None
                        else _hex_attribute(kind, bytes.fromhex(hexadecimal)))  # fmt: skip
        position = part.end()
        if not separator:
            return rdns
        if separator == ",":
            rdns.append([])
    raise InvalidOption(f"not a distinguished name of RFC 4514 (TYPE=value, …) from character {position} on")


def _unescape(escape: re.Match[str]) -> str:
    if escape[2]:
        return escape[2]
    try:
        return bytes.fromhex(escape[1].replace("\\", "")).decode("utf-8")
    except UnicodeDecodeError:
        raise InvalidOption("the escaped bytes of a name are not UTF-8") from None


def _hex_attribute(kind: str, value: bytes) -> Attribute:
    oid, _, _ = _BY_NAME.get(kind.lower(), (kind, 0, 0))
    try:
        return der.parse(der.oid(oid) + der.check(value), _read_attribute)
    except (CertificateError, InvalidEncoding) as error:
        raise InvalidOption(f"the value after {kind}=# is no attribute value: {error}") from None
