"""Making certificates: RFC 5280, 4.1 and 4.2; usages of TLCP's two certificates: GM/T 0015, GB/T 38636.

`issue` verifies the request, and refuses an issuer that is no CA and an end after the issuer's own. Everything else
about a path, such as path lengths, is what `verify_chain` judges, for everyone alike.
"""

from __future__ import annotations

import secrets
from collections.abc import Iterable, Mapping
from datetime import datetime
from typing import Final

from smcrypto import der, sm2
from smcrypto.errors import InvalidOption
from smcrypto.inputs import BytesLike, as_bytes, require_int, require_type
from smcrypto.x509 import extensions as ext
from smcrypto.x509.certificate import Certificate, require_key_of
from smcrypto.x509.chain import require_ca
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
    request_uid: that of the request's signature (default: `uid`), without which it is a CertificateSignatureError.
    CertificateUsageError: `ca_certificate` is not that of a CA (basic constraints, keyCertSign).
    InvalidKey: `ca_key` is not the key of `ca_certificate`. InvalidOption: `not_after` lies after that of
    `ca_certificate`, a naive time, or a value that cannot be written.
    """
    require_type(csr, CertificateSigningRequest, "csr")
    require_key_of(ca_certificate, ca_key)
    signer_uid = as_bytes(uid, "uid")
    csr.verify(uid=signer_uid if request_uid is None else as_bytes(request_uid, "request_uid"))
    require_ca(ca_certificate)
    if instant(not_after, "not_after").replace(microsecond=0) > ca_certificate.not_after:
        raise InvalidOption(f"not_after lies after {ca_certificate.not_after}, when the CA's certificate ends")
    return _certificate(
        issuer=ca_certificate.subject, authority=ca_certificate.subject_key_identifier,
        subject=csr.subject if subject is None else Name.build(subject), public_key=csr.public_key,
        key=ca_key, uid=signer_uid, not_before=not_before, not_after=not_after, serial_number=serial_number,
        ca=ca, path_length=path_length, usages=key_usage, purposes=extended_key_usage, alt_names=subject_alt_names,
        further=extensions,
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
        issuer=name, authority=ext.key_identifier(key.public_key), subject=name, public_key=key.public_key,
        key=key, uid=as_bytes(uid, "uid"), not_before=not_before, not_after=not_after, serial_number=serial_number,
        ca=ca, path_length=path_length, usages=key_usage, purposes=extended_key_usage, alt_names=subject_alt_names,
        further=extensions,
    )  # fmt: skip


def _certificate(
    *, issuer: Name, authority: bytes | None, subject: Name, public_key: sm2.PublicKey, key: sm2.PrivateKey, uid: bytes,
    not_before: datetime, not_after: datetime, serial_number: int | None, ca: bool, path_length: int | None,
    usages: Iterable[str] | None, purposes: Iterable[str], alt_names: Iterable[str], further: Iterable[ext.Extension],
) -> Certificate:  # fmt: skip
    begin, end = instant(not_before, "not_before"), instant(not_after, "not_after")
    if end < begin:
        raise InvalidOption("not_after lies before not_before")
    if not issuer:
        raise InvalidOption("the issuer's name must not be empty (RFC 5280, 4.1.2.4)")
    basic = ext.basic_constraints(ca, path_length)
    if usages is None:
        usages = CA_KEY_USAGE if ca else SIGNING_KEY_USAGE
    wanted = ext.requested(subject, alt_names, usages, purposes)
    if not subject and not any(e.oid == ext.SUBJECT_ALT_NAME for e in wanted):
        raise InvalidOption("a certificate needs a subject or a subject alternative name")
    identifier = ext.Extension(ext.SUBJECT_KEY_IDENTIFIER, False, der.octet_string(ext.key_identifier(public_key)))
    all_extensions = [basic, *wanted, identifier]
    if authority is not None:
        all_extensions.append(ext.authority_key_identifier(authority))
    for extension in further:
        require_type(extension, ext.Extension, "each of extensions")
        all_extensions.append(extension)
    if len({e.oid for e in all_extensions}) != len(all_extensions):
        raise InvalidOption("an extension is given twice")
    if serial_number is None:
        serial_number = secrets.randbelow(_MAX_SERIAL) + 1
    elif not 1 <= require_int(serial_number, "serial_number") <= _MAX_SERIAL:
        raise InvalidOption("serial_number must be positive and fit 20 bytes (RFC 5280, 4.1.2.2)")
    body = der.sequence(
        der.explicit(0, der.integer(2)),  # version 3
        der.integer(serial_number),
        SM2_WITH_SM3,
        issuer.to_der(),
        der.sequence(der.time(begin), der.time(end)),
        subject.to_der(),
        public_key.to_der(),
        der.explicit(3, der.sequence(*(e.to_der() for e in all_extensions))),
    )
    return Certificate.from_der(sign(body, key, uid))
