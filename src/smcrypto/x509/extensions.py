"""Extensions of certificates, requests and revocation lists: RFC 5280, 4.2 and 5.2.

An `Extension` keeps identifier, criticality and the bytes of its value. Those
that this library understands are read when the certificate is (`values`), so
that one which cannot be read is refused at once.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from dataclasses import dataclass
from ipaddress import ip_address
from typing import Final

from smcrypto import der, sm3
from smcrypto.errors import CertificateError, InvalidOption
from smcrypto.inputs import as_bytes, require_int, require_type
from smcrypto.x509.names import Name, written_oid

__all__ = [
    "AUTHORITY_KEY_IDENTIFIER",
    "BASIC_CONSTRAINTS",
    "EXTENDED_KEY_USAGE",
    "KEY_USAGE",
    "SUBJECT_ALT_NAME",
    "SUBJECT_KEY_IDENTIFIER",
    "AuthorityKeyIdentifier",
    "BasicConstraints",
    "Extension",
    "usage_oid",
]

SUBJECT_KEY_IDENTIFIER: Final = "2.5.29.14"
KEY_USAGE: Final = "2.5.29.15"
SUBJECT_ALT_NAME: Final = "2.5.29.17"
BASIC_CONSTRAINTS: Final = "2.5.29.19"
CRL_NUMBER: Final = "2.5.29.20"
REASON_CODE: Final = "2.5.29.21"
NAME_CONSTRAINTS: Final = "2.5.29.30"
AUTHORITY_KEY_IDENTIFIER: Final = "2.5.29.35"
EXTENDED_KEY_USAGE: Final = "2.5.29.37"

# Bits of KeyUsage, 4.2.1.3. X.509 now calls bit 1 contentCommitment.
_KEY_USAGES: Final = (
    "digitalSignature", "nonRepudiation", "keyEncipherment", "dataEncipherment", "keyAgreement", "keyCertSign",
    "cRLSign", "encipherOnly", "decipherOnly",
)  # fmt: skip
_KEY_USAGE_BITS: Final = {name: bit for bit, name in enumerate(_KEY_USAGES)} | {"contentCommitment": 1}

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
    """Extensions, 4.1 and 4.2: at least one, no two of the same kind."""
    sequence = reader.sequence()
    found: dict[str, Extension] = {}
    while not sequence.at_end():
        one = sequence.sequence()
        oid = one.oid()
        critical = False
        if one.peek_tag() == der.BOOLEAN:
            critical = one.boolean()
            if not critical:
                raise CertificateError(f"extension {oid} spells out its default (X.690, 11.5)")
        value = one.octet_string()
        one.finish()
        if oid in found:
            raise CertificateError(f"extension {oid} occurs twice")
        found[oid] = Extension(oid, critical, value)
    if not found:
        raise CertificateError("the list of extensions is empty")
    return tuple(found.values())


def read_optional(body: der.Reader, number: int) -> tuple[Extension, ...]:
    """The extensions under the explicit tag [number], none where that is absent."""
    if not body.has_explicit(number):
        return ()
    wrapped = body.explicit(number)
    extensions = read_extensions(wrapped)
    wrapped.finish()
    return extensions


# --- one function to read and one to write each extension ---


def read_basic_constraints(value: bytes) -> BasicConstraints:
    sequence = der.only_sequence(value)
    ca, path_length = False, None
    if sequence.peek_tag() == der.BOOLEAN:
        ca = sequence.boolean()
        if not ca:
            raise CertificateError("basicConstraints spells out its default (X.690, 11.5)")
    if not sequence.at_end():
        path_length = sequence.integer()
        if not ca:
            raise CertificateError("basicConstraints has a path length, but not for a CA")
    sequence.finish()
    return BasicConstraints(ca, path_length)


def basic_constraints(ca: bool, path_length: int | None) -> Extension:
    require_type(ca, bool, "ca")
    if path_length is not None and (require_int(path_length, "path_length") < 0 or not ca):
        raise InvalidOption("a path length is a number from 0 on, and for a CA only")
    parts = ([der.boolean(True)] if ca else []) + ([] if path_length is None else [der.integer(path_length)])
    return Extension(BASIC_CONSTRAINTS, True, der.sequence(*parts))


def read_key_usage(value: bytes) -> frozenset[str]:
    reader = der.Reader(value)
    bits = reader.named_bits()
    reader.finish()
    if not bits or max(bits) >= len(_KEY_USAGES):
        raise CertificateError("keyUsage has no bit set, or one that has no meaning")
    return frozenset(_KEY_USAGES[bit] for bit in bits)


def usage_names(names: Iterable[str]) -> frozenset[str]:
    """`names` under the names of this module; InvalidOption for one that is no key usage."""
    wanted = set()
    for name in names:
        if name not in _KEY_USAGE_BITS:
            raise InvalidOption(f"unknown key usage {name!r}; there are {', '.join(_KEY_USAGES)}")
        wanted.add(_KEY_USAGES[_KEY_USAGE_BITS[name]])
    return frozenset(wanted)


def key_usage(names: Iterable[str]) -> Extension:
    bits = [_KEY_USAGE_BITS[name] for name in usage_names(names)]
    return Extension(KEY_USAGE, True, der.named_bits(bits))


def read_extended_key_usage(value: bytes) -> tuple[str, ...]:
    sequence = der.only_sequence(value)
    purposes: list[str] = []
    while not sequence.at_end():
        oid = sequence.oid()
        purposes.append(_PURPOSE_NAMES.get(oid, oid))
    if not purposes:
        raise CertificateError("extendedKeyUsage names no purpose")
    return tuple(purposes)


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
    return Extension(EXTENDED_KEY_USAGE, False, der.sequence(*(der.oid(usage_oid(p)) for p in purposes)))


def key_identifier(point: bytes) -> bytes:
    """4.2.1.2 leaves the method open; here the leading 160 bits of SM3 over the key's bit string."""
    return sm3.digest(point)[:20]


def subject_key_identifier(identifier: bytes) -> Extension:
    return Extension(SUBJECT_KEY_IDENTIFIER, False, der.octet_string(identifier))


def read_subject_key_identifier(value: bytes) -> bytes:
    reader = der.Reader(value)
    identifier = reader.octet_string()
    reader.finish()
    return identifier


def authority_key_identifier(identifier: bytes) -> Extension:
    return Extension(AUTHORITY_KEY_IDENTIFIER, False, der.sequence(der.implicit(0, identifier)))


def read_authority_key_identifier(value: bytes) -> AuthorityKeyIdentifier:
    sequence = der.only_sequence(value)
    identifier = sequence.implicit(0) if sequence.has_implicit(0) else None
    issuer = serial = None
    if sequence.has_explicit(1):
        names = sequence.explicit(1)
        while not names.at_end():
            if names.has_explicit(4):
                wrapped = names.explicit(4)
                issuer = Name.read(wrapped)
                wrapped.finish()
            else:
                names.checked()
    if sequence.has_implicit(2):
        serial = sequence.implicit_integer(2)
    sequence.finish()
    return AuthorityKeyIdentifier(identifier, issuer, serial)


def crl_number(number: int) -> Extension:
    return Extension(CRL_NUMBER, False, der.integer(number))


def read_crl_number(value: bytes) -> int:
    reader = der.Reader(value)
    number = reader.integer()
    reader.finish()
    return number


def reason_code(reason: str) -> Extension:
    return Extension(REASON_CODE, False, der.enumerated(REASONS[reason]))


def read_reason_code(value: bytes) -> str:
    reader = der.Reader(value)
    reason = reader.enumerated()
    reader.finish()
    if reason not in _REASON_NAMES:
        raise CertificateError(f"revocation reason {reason} has no meaning in a complete list")
    return _REASON_NAMES[reason]


# --- GeneralName, 4.2.1.6, as text "KIND:value" ---

_IA5_KINDS: Final = {1: "email", 2: "DNS", 6: "URI"}
_IA5_TAGS: Final = {name.lower(): tag for tag, name in _IA5_KINDS.items()}


def read_subject_alt_names(value: bytes) -> tuple[str, ...]:
    sequence = der.only_sequence(value)
    names: list[str] = []
    while not sequence.at_end():
        names.append(_read_general_name(sequence))
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
        inner = der.Reader(der.element(der.OID, reader.implicit(8)))
        return f"RID:{inner.oid()}"
    if reader.has_explicit(4):
        wrapped = reader.explicit(4)
        name = Name.read(wrapped)
        wrapped.finish()
        return f"dirName:{name.rfc4514()}"
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
    "subject_key_identifier": (SUBJECT_KEY_IDENTIFIER, read_subject_key_identifier, None),
    "authority_key_identifier": (AUTHORITY_KEY_IDENTIFIER, read_authority_key_identifier, None),
    "number": (CRL_NUMBER, read_crl_number, None),
    "reason": (REASON_CODE, read_reason_code, "unspecified"),
}


def values(extensions: Iterable[Extension], *fields: str) -> dict[str, object]:
    """What `extensions` say for each of `fields`; those of other kinds are not looked at."""
    present = {extension.oid: extension.value for extension in extensions}
    found: dict[str, object] = {}
    for field in fields:
        oid, read, absent = _FIELDS[field]
        found[field] = read(present[oid]) if oid in present else absent
    return found


def requested(
    subject: Name, alt_names: Iterable[str], usages: Iterable[str], purposes: Iterable[str]
) -> list[Extension]:
    """The extensions that a caller names, without those of which nothing is named.

    4.2.1.6: alternative names are critical where the subject is empty.
    """
    found: list[Extension] = []
    alt_names, usages, purposes = _listed(alt_names), _listed(usages), _listed(purposes)
    if usages:
        found.append(key_usage(usages))
    if purposes:
        found.append(extended_key_usage(purposes))
    if alt_names:
        found.append(subject_alt_names(alt_names, critical=not subject))
    return found


def _listed(names: Iterable[str]) -> tuple[str, ...]:
    if isinstance(names, str):
        raise TypeError(f"a collection of names is needed, not the one str {names!r}")
    listed = tuple(names)
    for name in listed:
        require_type(name, str, "each name")
    return listed
