"""Is a certificate revoked? Asked of its issuer's responder: OCSP, RFC 6960, with SM2 signatures; nonces, RFC 8954.

`request` makes what is sent (by HTTP POST as application/ocsp-request), `verify` judges what comes back. The signer of
an answer is the issuer itself, or a responder that the issuer gave a certificate for OCSPSigning (4.2.2.2). Such a
certificate is not asked about in turn (4.2.2.2.1): the issuer keeps its life short.

Not here: signed requests, several certificates in one request, responders that are trusted for other reasons.
"""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from datetime import datetime, timedelta
from hmac import compare_digest
from typing import Final, Literal, NamedTuple

from smcrypto import der, sm2, sm3
from smcrypto.errors import (
    CertificateError,
    CertificateMalformedError,
    CertificateRevokedError,
    CertificateUnknownIssuerError,
    CertificateUsageError,
    InvalidEncoding,
    InvalidLength,
    InvalidOption,
)
from smcrypto.inputs import BytesLike, as_bytes, require_type
from smcrypto.x509 import AnyCertificate, Certificate, load_der_certificate, verify_chain
from smcrypto.x509 import extensions as ext
from smcrypto.x509.certificate import require_usage
from smcrypto.x509.signed import instant, parsing, require_signature

__all__ = ["Answer", "request", "verify"]

_BASIC: Final = "1.3.6.1.5.5.7.48.1.1"  # 4.2.1
_NONCE: Final = "1.3.6.1.5.5.7.48.1.2"  # 4.4.1
_FAILURES: Final = {1: "malformedRequest", 2: "internalError", 3: "tryLater", 5: "sigRequired", 6: "unauthorized"}
SKEW: Final = timedelta(minutes=5)
"""How far the clock of whoever answers may be ahead."""


def _sha1(data: bytes) -> bytes:
    return hashlib.sha1(data, usedforsecurity=False).digest()


# Of the issuer's name and key, 4.1.1: they tell issuers apart.
HASHES: Final[dict[str, tuple[str, Callable[[bytes], bytes]]]] = {
    "sm3": ("1.2.156.10197.1.401", sm3.digest),
    "sha1": ("1.3.14.3.2.26", _sha1),
    "sha256": ("2.16.840.1.101.3.4.2.1", lambda data: hashlib.sha256(data).digest()),
}
DIGESTS: Final = dict(HASHES.values())
"""Functions of the hashes, by their identifiers."""


class Answer(NamedTuple):
    """That a certificate is not revoked: when the responder said so, as of when, and until when it holds (or None)."""

    produced_at: datetime
    this_update: datetime
    next_update: datetime | None


class _Single(NamedTuple):
    """SingleResponse, 4.2.1."""

    identifier: tuple[str, bytes, bytes, int]  # the hash, those of the issuer's name and key, the serial number
    refusal: CertificateError | None
    this_update: datetime
    next_update: datetime | None
    extensions: tuple[ext.Extension, ...]


def request(
    certificate: Certificate, issuer: Certificate, *, nonce: BytesLike | None = None,
    hash: Literal["sm3", "sha1", "sha256"] = "sm3",
) -> bytes:  # fmt: skip
    """OCSPRequest in DER about `certificate`, which `issuer` issued: RFC 6960, 4.1.1.

    nonce: 1 to 32 random bytes, given to `verify` again, so that an old answer is none; else InvalidLength. hash: by
    which the issuer is named; responders that do not know SM3 want "sha1". CertificateUnknownIssuerError: another
    issuer's name stands in `certificate`.
    """
    if hash not in HASHES:
        raise InvalidOption(f"hash must be 'sm3', 'sha1' or 'sha256', not {hash!r}")
    oid, name_hash, key_hash, serial_number = _identifier(certificate, issuer, HASHES[hash][0])
    identifier = der.sequence(
        der.algorithm(oid), der.octet_string(name_hash), der.octet_string(key_hash), der.integer(serial_number)
    )
    extensions = b""
    if nonce is not None:
        extension = ext.Extension(_NONCE, False, der.octet_string(_require_nonce(nonce)))
        extensions = der.explicit(2, der.sequence(extension.to_der()))
    return der.sequence(der.sequence(der.sequence(der.sequence(identifier)), extensions))


def verify(
    data: BytesLike, certificate: Certificate, issuer: Certificate, *, at: datetime, nonce: BytesLike | None = None,
    uid: BytesLike = sm2.DEFAULT_UID,
) -> Answer:  # fmt: skip
    """The answer that `certificate` is not revoked; a CertificateError for every other, and for none. RFC 6960, 3.2.

    data: OCSPResponse in DER. issuer: trusted, and the issuer of `certificate`: both as in a path of `verify_chain`.
    at: the moment, aware; the answer's times must enclose it, the responder's clock being at most five minutes ahead.
    nonce: of the request; the answer must then have it. An answer without a time at which the next is due counts with a
    nonce only. uid: of the answer's signature; OpenSSL signs with b"".
    CertificateRevokedError: it is revoked. CertificateSignatureError, CertificateUsageError, CertificateExpiredError,
    CertificateUnknownIssuerError: the signature or the signer is not to be trusted. CertificateMalformedError: it is
    no OCSPResponse.
    """
    identifiers = [_identifier(certificate, issuer, oid) for oid in DIGESTS]
    moment, octets, name = instant(at, "at"), as_bytes(data, "data"), as_bytes(uid, "uid")
    wanted, signed_by = None if nonce is None else _require_nonce(nonce), f"the answer about {certificate.subject}"
    with parsing("OCSP response", CertificateMalformedError), der.reading_sequence(octets) as outer:
        status = outer.enumerated()
        content = b"" if status else _read_basic(outer.explicit(0).sequence())
    if status:
        raise CertificateError(f"the responder gives no answer: {_FAILURES.get(status, status)}")
    with parsing("OCSP response", CertificateMalformedError):
        with der.reading_sequence(content) as parts:
            body, algorithm, signature = parts.raw(), parts.checked(), parts.bit_string()
            certificates = parts.explicit(0).sequence().rest() if parts.has_explicit(0) else []
        inside = [load_der_certificate(one) for one in certificates]
        with der.reading_sequence(body) as fields:
            responder, produced_at = fields.raw(), fields.generalized_time()
            singles = fields.sequence().each(_read_single)
            extensions = ext.read_extensions(fields.explicit(1)) if fields.has_explicit(1) else ()
    signer = _signer(responder, issuer, inside, moment)
    require_signature(signer.public_key, body, algorithm, signature, name, signed_by)
    found = [one for one in singles if one.identifier in identifiers]
    if len(found) != 1:
        raise CertificateError(f"{signed_by} has {len(found)} statements about it, not one")
    [single] = found
    for extension in (*extensions, *single.extensions):
        if extension.critical and extension.oid != _NONCE:
            raise CertificateError(f"{signed_by} has the critical extension {extension.oid}, which is not understood")
    if wanted is not None:
        values = [extension.value for extension in extensions if extension.oid == _NONCE]
        if not values or not compare_digest(values[0], der.octet_string(wanted)):
            raise CertificateError(f"{signed_by} does not have the nonce of the request")
    if single.this_update - moment > SKEW:
        raise CertificateError(f"{signed_by} is from {single.this_update}, the future")
    if moment > single.next_update if single.next_update is not None else wanted is None:
        raise CertificateError(f"{signed_by} is stale: the next was due {single.next_update or 'at once'}")
    if single.refusal is not None:
        raise single.refusal
    return Answer(produced_at, single.this_update, single.next_update)


def _require_nonce(nonce: BytesLike) -> bytes:
    octets = as_bytes(nonce, "nonce")
    if not 1 <= len(octets) <= 32:
        raise InvalidLength(f"a nonce has 1 to 32 bytes (RFC 8954, 2.1), not {len(octets)}")
    return octets


def _identifier(certificate: Certificate, issuer: Certificate, oid: str) -> tuple[str, bytes, bytes, int]:
    """The members of a CertID."""
    require_type(certificate, Certificate, "certificate")
    require_type(issuer, Certificate, "issuer")
    if certificate.issuer != issuer.subject:
        raise CertificateUnknownIssuerError(f"{certificate.subject} is not issued by {issuer.subject}")
    name, key = certificate.issuer.to_der(), issuer.public_key.to_bytes()
    return oid, DIGESTS[oid](name), DIGESTS[oid](key), certificate.serial_number


def _read_basic(response: der.Reader) -> bytes:
    """The BasicOCSPResponse in ResponseBytes, 4.2.1."""
    if (kind := response.oid()) != _BASIC:
        raise InvalidEncoding(f"the kind {kind} of responses is not known")
    return response.octet_string()


def _read_single(singles: der.Reader) -> _Single:
    single = singles.sequence()
    certificate = single.sequence()
    algorithm = certificate.sequence()
    oid, _ = algorithm.oid(), algorithm.rest()
    issuer = certificate.octet_string(), certificate.octet_string()
    identifier = oid, *issuer, certificate.integer(signed=True)
    refusal: CertificateError | None = None
    if single.has_explicit(1):
        info = single.explicit(1)
        text = f"the certificate was revoked at {info.generalized_time()}"
        if info.has_explicit(0):
            text += f", reason {info.explicit(0).enumerated()} (RFC 5280, 5.3.1)"
        refusal = CertificateRevokedError(text)
    else:
        if single.has_implicit(2):
            refusal = CertificateError("the responder does not know the certificate")
        if single.implicit(2 if refusal else 0):
            raise InvalidEncoding("a status is not empty")
    this_update = single.generalized_time()
    next_update = single.explicit(0).generalized_time() if single.has_explicit(0) else None
    extensions = ext.read_extensions(single.explicit(1)) if single.has_explicit(1) else ()
    return _Single(identifier, refusal, this_update, next_update, extensions)


def _signer(responder: bytes, issuer: Certificate, inside: Sequence[AnyCertificate], at: datetime) -> Certificate:
    """Whose signature counts, 4.2.2.2: the issuer's, or that of a certificate which it issued for the purpose."""
    for certificate in (issuer, *inside):
        if not isinstance(certificate, Certificate) or responder not in _identifiers(certificate):
            continue
        if certificate.public_key == issuer.public_key:
            return issuer
        verify_chain(certificate, roots=[issuer], at=at)
        require_usage(certificate, "is not for OCSPSigning", "digitalSignature", "nonRepudiation")
        if "OCSPSigning" not in (certificate.extended_key_usage or ()):
            raise CertificateUsageError(f"{certificate.subject} is not for OCSPSigning")
        return certificate
    raise CertificateUnknownIssuerError("the certificate of the responder is not here")


def _identifiers(certificate: Certificate) -> tuple[bytes, bytes]:
    """ResponderID, 4.2.1: the name, or SHA-1 of the key."""
    key = _sha1(certificate.public_key.to_bytes())
    return der.explicit(1, certificate.subject.to_der()), der.explicit(2, der.octet_string(key))
