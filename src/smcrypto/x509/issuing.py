"""Making certificates: RFC 5280, 4.1 and 4.2; usages of TLCP's two certificates: GM/T 0015, GB/T 38636.

`issue` signs what it is told to. Whether the CA's certificate allows it (CA flag,
path length, usages) is what `verify_chain` judges, for everyone alike.
"""

from __future__ import annotations

import secrets
from collections.abc import Iterable, Mapping
from datetime import datetime
from typing import Final

from smcrypto import der, sm2
from smcrypto.errors import InvalidKey, InvalidOption
from smcrypto.inputs import BytesLike, as_bytes, require_int, require_type
from smcrypto.x509 import extensions as ext
from smcrypto.x509.certificate import Certificate
from smcrypto.x509.names import Name
from smcrypto.x509.request import CertificateSigningRequest
from smcrypto.x509.signed import SM2_WITH_SM3, instant, sign

__all__ = ["CA_KEY_USAGE", "ENCRYPTION_KEY_USAGE", "SIGNING_KEY_USAGE", "issue", "self_signed"]

CA_KEY_USAGE: Final = ("keyCertSign", "cRLSign")
"""What `issue` writes for a CA by default."""
SIGNING_KEY_USAGE: Final = ("digitalSignature", "nonRepudiation")
"""Of the first of a TLCP identity's two certificates; what `issue` writes for an end entity by default."""
ENCRYPTION_KEY_USAGE: Final = ("keyEncipherment", "dataEncipherment", "keyAgreement")
"""Of the second: decryption and key agreement."""

_MAX_SERIAL: Final = 2**159 - 1  # 20 bytes and positive, RFC 5280, 4.1.2.2


def issue(
    csr: CertificateSigningRequest,
    ca_certificate: Certificate,
    ca_key: sm2.PrivateKey,
    *,
    not_before: datetime,
    not_after: datetime,
    ca: bool = False,
    path_length: int | None = None,
    key_usage: Iterable[str] | None = None,
    extended_key_usage: Iterable[str] = (),
    subject_alt_names: Iterable[str] = (),
    extensions: Iterable[ext.Extension] = (),
    subject: Name | str | Mapping[str, str] | Iterable[tuple[str, str]] | None = None,
    serial_number: int | None = None,
    uid: BytesLike = sm2.DEFAULT_UID,
    request_uid: BytesLike | None = None,
) -> Certificate:
    """The certificate for `csr`'s key, signed by the CA under `uid`.

    Nothing that the request asks for is copied; pass `csr.subject_alt_names`
    and the like to grant it. subject: instead of the request's.
    key_usage: None gives CA_KEY_USAGE or SIGNING_KEY_USAGE, () no such extension.
    serial_number: None gives 159 random bits. extensions: further ones, as they are.
    The request must be proven: `csr.verify(uid=…)` was called, or its signature
    holds under `request_uid` (default: `uid`), else CertificateError.
    InvalidKey: `ca_key` is not the key of `ca_certificate`. Naive times and values that cannot be
    written are InvalidOption.
    """
    require_type(csr, CertificateSigningRequest, "csr")
    require_type(ca_certificate, Certificate, "ca_certificate")
    require_type(ca_key, sm2.PrivateKey, "ca_key")
    if ca_key.public_key != ca_certificate.public_key:
        raise InvalidKey("ca_key is not the key of ca_certificate")
    signer_uid = as_bytes(uid, "uid")
    requester_uid = signer_uid if request_uid is None else as_bytes(request_uid, "request_uid")
    if not csr.verified:
        csr.verify(uid=requester_uid)
    return _certificate(
        issuer=ca_certificate.subject, authority=ca_certificate.subject_key_identifier,
        subject=csr.subject if subject is None else Name.build(subject), public_key=csr.public_key,
        key=ca_key, uid=signer_uid, validity=_validity(not_before, not_after), serial_number=serial_number,
        basic=ext.basic_constraints(ca, path_length), usages=_usages(key_usage, ca), purposes=extended_key_usage,
        alt_names=subject_alt_names, further=extensions,
    )  # fmt: skip


def self_signed(
    key: sm2.PrivateKey,
    *,
    subject: Name | str | Mapping[str, str] | Iterable[tuple[str, str]],
    not_before: datetime,
    not_after: datetime,
    ca: bool = True,
    path_length: int | None = None,
    key_usage: Iterable[str] | None = None,
    extended_key_usage: Iterable[str] = (),
    subject_alt_names: Iterable[str] = (),
    extensions: Iterable[ext.Extension] = (),
    serial_number: int | None = None,
    uid: BytesLike = sm2.DEFAULT_UID,
) -> Certificate:
    """A certificate that `key` issues to itself: the root of a CA. Arguments and errors as of `issue`."""
    require_type(key, sm2.PrivateKey, "key")
    name = Name.build(subject)
    return _certificate(
        issuer=name, authority=ext.key_identifier(key.public_key.to_bytes()), subject=name, public_key=key.public_key,
        key=key, uid=as_bytes(uid, "uid"), validity=_validity(not_before, not_after), serial_number=serial_number,
        basic=ext.basic_constraints(ca, path_length), usages=_usages(key_usage, ca), purposes=extended_key_usage,
        alt_names=subject_alt_names, further=extensions,
    )  # fmt: skip


def _certificate(
    *, issuer: Name, authority: bytes | None, subject: Name, public_key: sm2.PublicKey, key: sm2.PrivateKey, uid: bytes,
    validity: bytes, serial_number: int | None, basic: ext.Extension, usages: Iterable[str], purposes: Iterable[str],
    alt_names: Iterable[str], further: Iterable[ext.Extension],
) -> Certificate:  # fmt: skip
    if not issuer:
        raise InvalidOption("the issuer's name must not be empty (RFC 5280, 4.1.2.4)")
    wanted = ext.requested(subject, alt_names, usages, purposes)
    if not subject and not any(e.oid == ext.SUBJECT_ALT_NAME for e in wanted):
        raise InvalidOption("a certificate needs a subject or a subject alternative name")
    all_extensions = [basic, *wanted, ext.subject_key_identifier(ext.key_identifier(public_key.to_bytes()))]
    if authority is not None:
        all_extensions.append(ext.authority_key_identifier(authority))
    for extension in further:
        require_type(extension, ext.Extension, "each of extensions")
        all_extensions.append(extension)
    kinds = [e.oid for e in all_extensions]
    if len(set(kinds)) != len(kinds):
        raise InvalidOption("an extension is given twice")
    body = der.sequence(
        der.explicit(0, der.integer(2)),  # version 3
        der.integer(_serial(serial_number)),
        SM2_WITH_SM3,
        issuer.to_der(),
        validity,
        subject.to_der(),
        public_key.to_der(),
        der.explicit(3, der.sequence(*(e.to_der() for e in all_extensions))),
    )
    return Certificate.from_der(sign(body, key, uid))


def _usages(names: Iterable[str] | None, ca: bool) -> Iterable[str]:
    if names is None:
        return CA_KEY_USAGE if ca else SIGNING_KEY_USAGE
    return names


def _validity(not_before: datetime, not_after: datetime) -> bytes:
    begin, end = instant(not_before, "not_before"), instant(not_after, "not_after")
    if end < begin:
        raise InvalidOption("not_after lies before not_before")
    return der.sequence(der.time(begin), der.time(end))


def _serial(number: int | None) -> int:
    if number is None:
        return secrets.randbelow(_MAX_SERIAL) + 1
    if not 1 <= require_int(number, "serial_number") <= _MAX_SERIAL:
        raise InvalidOption("serial_number must be positive and fit 20 bytes (RFC 5280, 4.1.2.2)")
    return number
