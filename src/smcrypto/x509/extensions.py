"""Extensions of certificates, requests and revocation lists: RFC 5280, 4.2 and 5.2.

An `Extension` keeps identifier, criticality and the bytes of its value. Those
that this library understands are read when the certificate is (`values`), so
that one which cannot be read is refused at once.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterable, Iterator
from dataclasses import dataclass
from ipaddress import ip_address
from typing import Final

from smcrypto import der, sm2, sm3
from smcrypto.errors import CertificateError, InvalidOption
from smcrypto.inputs import as_bytes, require_int, require_type
from smcrypto.x509.names import Name, written_oid

__all__ = [
    "AUTHORITY_KEY_IDENTIFIER", "BASIC_CONSTRAINTS", "EXTENDED_KEY_USAGE", "KEY_USAGE", "SUBJECT_ALT_NAME",
    "SUBJECT_KEY_IDENTIFIER", "AuthorityKeyIdentifier", "BasicConstraints", "Extension", "usage_oid",
]  # fmt: skip

SUBJECT_KEY_IDENTIFIER: Final = "2.5.29.14"
KEY_USAGE: Final = "2.5.29.15"
SUBJECT_ALT_NAME: Final = "2.5.29.17"
BASIC_CONSTRAINTS: Final = "2.5.29.19"
CRL_NUMBER: Final = "2.5.29.20"
REASON_CODE: Final = "2.5.29.21"
NAME_CONSTRAINTS: Final = "2.5.29.30"
CERTIFICATE_POLICIES: Final = "2.5.29.32"
AUTHORITY_KEY_IDENTIFIER: Final = "2.5.29.35"
EXTENDED_KEY_USAGE: Final = "2.5.29.37"

# Bits of KeyUsage, 4.2.1.3. X.509 now calls bit 1 contentCommitment.
_KEY_USAGES: Final = (
    "digitalSignature", "nonRepudiation", "keyEncipherment", "dataEncipherment", "keyAgreement", "keyCertSign",
    "cRLSign", "encipherOnly", "decipherOnly",
)  # fmt: skip

# Key purposes, 4.2.1.12.
_PURPOSES: Final = {
    "serverAuth": "1.3.6.1.5.5.7.3.1",
    "clientAuth": "1.3.6.1.5.5.7.3.2",
    "codeSigning": "1.3.6.1.5.5.7.3.3",
    "emailProtection": "1.3.6.1.5.5.7.3.4",
    "timeStamping": "1.3.6.1.5.5.7.3.8",
    "OCSPSigning": "1.3.6.1.5.5.7.3.9",
    "anyExtendedKeyUsage": "2.5.29.37.0",
}
_PURPOSE_NAMES: Final = {oid: name for name, oid in _PURPOSES.items()}

# Why a certificate was revoked, 5.3.1; 7 is not used, 8 (removeFromCRL) belongs to delta lists.
REASONS: Final = {
    "unspecified": 0,
    "keyCompromise": 1,
    "cACompromise": 2,
    "affiliationChanged": 3,
    "superseded": 4,
    "cessationOfOperation": 5,
    "certificateHold": 6,
    "privilegeWithdrawn": 9,
    "aACompromise": 10,
}
_REASON_NAMES: Final = {code: name for name, code in REASONS.items()}


@dataclass(frozen=True, slots=True)
class Extension:
    """One extension: dotted identifier, whether it must be understood, and its value in DER."""

    oid: str
    critical: bool
    value: bytes

    def __post_init__(self) -> None:
        require_type(self.oid, str, "oid")
        require_type(self.critical, bool, "critical")
        object.__setattr__(self, "value", as_bytes(self.value, "value"))

    def to_der(self) -> bytes:
        """Extension ::= SEQUENCE { extnID, critical, extnValue } (RFC 5280, 4.1)."""
        # DER leaves out a critical that is FALSE, its default (X.690, 11.5).
        flag = der.boolean(True) if self.critical else b""
        oid = written_oid(self.oid, f"an extension's oid must be a dotted object identifier, not {self.oid!r}")
        return der.sequence(oid, flag, der.octet_string(self.value))


@dataclass(frozen=True, slots=True)
class BasicConstraints:
    """4.2.1.9: may the subject issue certificates, and how many intermediates may follow it (None: any)."""

    ca: bool
    path_length: int | None = None


@dataclass(frozen=True, slots=True)
class AuthorityKeyIdentifier:
    """4.2.1.1: which key signed; each part may be missing."""

    key_identifier: bytes | None = None
    issuer: Name | None = None
    serial_number: int | None = None


def read_extensions(reader: der.Reader) -> tuple[Extension, ...]:
    """Extensions, 4.1 and 4.2: no two of the same kind."""
    found = reader.sequence().each(lambda one: _read_extension(one.sequence()))
    require_distinct(found)
    return tuple(found)


def _read_extension(one: der.Reader) -> Extension:
    return Extension(one.oid(), one.peek_tag() == der.BOOLEAN and one.boolean(), one.octet_string())


def require_distinct(extensions: Collection[Extension]) -> None:
    """CertificateError where two are of the same kind (4.2)."""
    if len({extension.oid for extension in extensions}) != len(extensions):
        raise CertificateError("an extension occurs twice")


def oddities(extensions: tuple[Extension, ...], encoded: bytes) -> Iterator[str]:
    """What in `extensions`, read from `encoded`, a CA may not write, though what it means is plain."""
    if not extensions:
        yield "the list of extensions is empty (RFC 5280, 4.1)"
    if encoded != der.sequence(*(extension.to_der() for extension in extensions)):
        yield "an extension spells out that it is not critical (X.690, 11.5)"
    for extension in extensions:
        if extension.oid == BASIC_CONSTRAINTS:
            constraints = read_basic_constraints(extension.value)
            if constraints.path_length is not None and not constraints.ca:
                yield "basicConstraints has a path length, but not for a CA (RFC 5280, 4.2.1.9)"
            if extension.value[2:5] == der.boolean(False):
                yield "basicConstraints spells out its default (X.690, 11.5)"
        if extension.oid == KEY_USAGE and extension.value != key_usage(read_key_usage(extension.value)).value:
            yield "keyUsage ends in zero bits (X.690, 11.2.2)"
        if extension.oid == CERTIFICATE_POLICIES and extension.critical:
            yield "certificatePolicies is critical, and policies are not judged (RFC 5280, 4.2.1.4)"


# --- one function to read and one to write each extension ---


def read_basic_constraints(value: bytes) -> BasicConstraints:
    with der.reading_sequence(value) as sequence:
        ca = sequence.peek_tag() == der.BOOLEAN and sequence.boolean()
        return BasicConstraints(ca, None if sequence.at_end() else sequence.integer())


def basic_constraints(ca: bool, path_length: int | None) -> Extension:
    require_type(ca, bool, "ca")
    if path_length is not None and (require_int(path_length, "path_length") < 0 or not ca):
        raise InvalidOption("a path length is a number from 0 on, and for a CA only")
    parts = ([der.boolean(True)] if ca else []) + ([] if path_length is None else [der.integer(path_length)])
    return Extension(BASIC_CONSTRAINTS, True, der.sequence(*parts))


def read_key_usage(value: bytes) -> frozenset[str]:
    bits = der.parse(value, der.Reader.named_bits)
    if not bits or max(bits) >= len(_KEY_USAGES):
        raise CertificateError("keyUsage has no bit set, or one that has no meaning")
    return frozenset(_KEY_USAGES[bit] for bit in bits)


def usage_names(names: Iterable[str]) -> frozenset[str]:
    """`names` under the names of this module; InvalidOption for one that is no key usage."""
    wanted = ["nonRepudiation" if name == "contentCommitment" else name for name in names]
    for name in wanted:
        if name not in _KEY_USAGES:
            raise InvalidOption(f"unknown key usage {name!r}; there are {', '.join(_KEY_USAGES)}")
    return frozenset(wanted)


def key_usage(names: Iterable[str]) -> Extension:
    return Extension(KEY_USAGE, True, der.named_bits(map(_KEY_USAGES.index, usage_names(names))))


def read_extended_key_usage(value: bytes) -> tuple[str, ...]:
    with der.reading_sequence(value) as sequence:
        purposes = sequence.each(der.Reader.oid)
    if not purposes:
        raise CertificateError("extendedKeyUsage names no purpose")
    return tuple(_PURPOSE_NAMES.get(oid, oid) for oid in purposes)


def usage_oid(purpose: str) -> str:
    """The identifier of a purpose given by name ("serverAuth") or as a dotted identifier."""
    oid = _PURPOSES.get(purpose, purpose)
    written_oid(oid, f"unknown extended key usage {purpose!r}; a dotted object identifier names any other")
    return oid


def purpose_name(purpose: str) -> str:
    """As `read_extended_key_usage` gives it: the name where there is one."""
    oid = usage_oid(purpose)
    return _PURPOSE_NAMES.get(oid, oid)


def extended_key_usage(purposes: Iterable[str]) -> Extension:
    oids = [usage_oid(purpose) for purpose in purposes]
    alone = oids == [_PURPOSES["timeStamping"]]  # RFC 3161, 2.3: that is critical, and stands alone
    return Extension(EXTENDED_KEY_USAGE, alone, der.sequence(*map(der.oid, oids)))


def key_identifier(key: sm2.PublicKey) -> bytes:
    """4.2.1.2 leaves the method open; here the leading 160 bits of SM3 over the key's bit string."""
    return sm3.digest(key.to_bytes())[:20]


def authority_key_identifier(identifier: bytes) -> Extension:
    return Extension(AUTHORITY_KEY_IDENTIFIER, False, der.sequence(der.implicit(0, identifier)))


def read_authority_key_identifier(value: bytes) -> AuthorityKeyIdentifier:
    issuer = serial = None
    with der.reading_sequence(value) as sequence:
        identifier = sequence.implicit(0) if sequence.has_implicit(0) else None
        if sequence.has_explicit(1):
            names = sequence.explicit(1)
            while not names.at_end():
                if names.has_explicit(4):
                    issuer = Name.read(names.explicit(4))
                else:
                    names.checked()
        if sequence.has_implicit(2):
            serial = sequence.implicit_integer(2)
    return AuthorityKeyIdentifier(identifier, issuer, serial)


def read_reason_code(value: bytes) -> str:
    reason = der.parse(value, der.Reader.enumerated)
    if reason not in _REASON_NAMES:
        raise CertificateError(f"revocation reason {reason} has no meaning in a complete list")
    return _REASON_NAMES[reason]


# --- GeneralName, 4.2.1.6, as text "KIND:value" ---

_IA5_KINDS: Final = {1: "email", 2: "DNS", 6: "URI"}
_IA5_TAGS: Final = {name.lower(): tag for tag, name in _IA5_KINDS.items()}


def read_subject_alt_names(value: bytes) -> tuple[str, ...]:
    with der.reading_sequence(value) as sequence:
        names = sequence.each(_read_general_name)
    if not names:
        raise CertificateError("subjectAltName names nothing")
    return tuple(names)


def _read_general_name(reader: der.Reader) -> str:
    for number, kind in _IA5_KINDS.items():
        if reader.has_implicit(number):
            content = reader.implicit(number)
            # Text with control characters is how a name is made to look like another.
            if not content or not all(0x20 <= byte <= 0x7E for byte in content):
                raise CertificateError(f"a {kind} name is empty or has characters that do not print")
            return f"{kind}:{content.decode('ascii')}"
    if reader.has_implicit(7):
        content = reader.implicit(7)
        if len(content) not in (4, 16):
            raise CertificateError(f"an IP address has {len(content)} bytes, not 4 or 16")
        return f"IP:{ip_address(content)}"
    if reader.has_implicit(8):
        return f"RID:{der.parse(der.element(der.OID, reader.implicit(8)), der.Reader.oid)}"
    if reader.has_explicit(4):
        return f"dirName:{Name.read(reader.explicit(4)).rfc4514()}"
    if reader.has_explicit(0):
        return f"otherName:{reader.checked().hex()}"
    raise CertificateError("a subject alternative name is of a kind that is not supported")


def subject_alt_names(names: Iterable[str], *, critical: bool) -> Extension:
    return Extension(SUBJECT_ALT_NAME, critical, der.sequence(*map(_general_name, names)))


def _general_name(text: str) -> bytes:
    kind, colon, value = text.partition(":")
    if colon and kind.lower() in _IA5_TAGS:
        if not value or not all(0x20 <= ord(c) <= 0x7E for c in value):
            raise InvalidOption(f"{text!r} is empty or has characters other than printable ASCII")
        return der.implicit(_IA5_TAGS[kind.lower()], value.encode("ascii"))
    if colon and kind == "IP":
        try:
            return der.implicit(7, ip_address(value).packed)
        except ValueError:
            raise InvalidOption(f"{value!r} is not an IP address") from None
    if colon and kind == "dirName":
        return der.explicit(4, Name.from_rfc4514(value).to_der())
    raise InvalidOption(f"{text!r} is not 'URI:…', 'DNS:…', 'email:…', 'IP:…' or 'dirName:…'")

# What the extensions say that are understood, by the name of the field that holds it: identifier, reader of the value,
# and what stands for an extension that is not there.
_FIELDS: Final[dict[str, tuple[str, Callable[[bytes], object], object]]] = {
    "basic_constraints": (BASIC_CONSTRAINTS, read_basic_constraints, None),
    "key_usage": (KEY_USAGE, read_key_usage, None),
    "extended_key_usage": (EXTENDED_KEY_USAGE, read_extended_key_usage, None),
    "subject_alt_names": (SUBJECT_ALT_NAME, read_subject_alt_names, ()),
    "subject_key_identifier": (SUBJECT_KEY_IDENTIFIER, lambda value: der.parse(value, der.Reader.octet_string), None),
    "authority_key_identifier": (AUTHORITY_KEY_IDENTIFIER, read_authority_key_identifier, None),
    "number": (CRL_NUMBER, lambda value: der.parse(value, der.Reader.integer), None),
    "reason": (REASON_CODE, read_reason_code, "unspecified"),
}


def values(extensions: Iterable[Extension], *fields: str) -> dict[str, object]:
    """What `extensions` say for each of `fields`; those of other kinds are not looked at."""
    present = {extension.oid: extension.value for extension in extensions}
    wanted = {field: _FIELDS[field] for field in fields}
    return {field: read(present[oid]) if oid in present else absent for field, (oid, read, absent) in wanted.items()}


def requested(
    subject: Name, alt_names: Iterable[str], usages: Iterable[str], purposes: Iterable[str]
) -> list[Extension]:
    """The extensions that a caller names, without those of which nothing is named.

    4.2.1.6: alternative names are critical where the subject is empty.
    """
    found: list[Extension] = []
    alt_names, usages, purposes = listed(alt_names), listed(usages), listed(purposes)
    if usages:
        found.append(key_usage(usages))
    if purposes:
        found.append(extended_key_usage(purposes))
    if alt_names:
        found.append(subject_alt_names(alt_names, critical=not subject))
    return found


def listed(names: Iterable[str]) -> tuple[str, ...]:
    """`names` as a tuple; TypeError where they are not several, or not text."""
    if isinstance(names, str):
        raise TypeError(f"a collection of names is needed, not the one str {names!r}")
    found = tuple(names)
    for name in found:
        require_type(name, str, "each name")
    return found
