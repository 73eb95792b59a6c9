"""What certificates, requests and revocation lists have in common: a body, an algorithm, a signature.

RFC 5280, 4.1.1: SEQUENCE { body, AlgorithmIdentifier, BIT STRING }. The
signature covers the body's bytes as they were received; nothing is encoded
again to be verified. The algorithm is SM2-with-SM3, GM/T 0015 and RFC 8998.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from datetime import datetime, timezone
from typing import Final, NamedTuple

from smcrypto import der, pem, sm2
from smcrypto.errors import (
    CertificateError,
    InvalidEncoding,
    InvalidKey,
    InvalidOption,
    InvalidSignature,
)

__all__ = [
    "SM2_WITH_SM3",
    "CertificateRevokedError",
    "CertificateSignatureError",
    "Signed",
    "instant",
    "one_block",
    "parsing",
    "read_signed",
    "sign",
]

SM2_WITH_SM3: Final = der.sequence(der.oid("1.2.156.10197.1.501"))
# Parameters are absent in what OpenSSL, Tongsuo and GmSSL write; some older software writes NULL.
_ACCEPTED: Final = (SM2_WITH_SM3, der.sequence(der.oid("1.2.156.10197.1.501"), der.null()))


class CertificateSignatureError(CertificateError, InvalidSignature):
    """The signature of a certificate, request or revocation list does not hold."""


class CertificateRevokedError(CertificateError):
    """A revocation list of its issuer names the certificate."""


class Signed(NamedTuple):
    body: bytes
    algorithm: bytes
    signature: bytes

    def fields(self) -> der.Reader:
        """A reader of what the body, one SEQUENCE, holds."""
        outer = der.Reader(self.body)
        body = outer.sequence()
        outer.finish()
        return body

    def verify(self, public_key: sm2.PublicKey, uid: bytes, what: str) -> None:
        if self.algorithm not in _ACCEPTED:
            raise CertificateError(f"{what} is not signed with SM2-with-SM3, the only algorithm supported")
        try:
            public_key.verify(self.signature, self.body, uid=uid)
        except InvalidSignature:
            raise CertificateSignatureError(f"the signature of {what} does not hold") from None


@contextmanager
def parsing(what: str) -> Iterator[None]:
    """Every way in which bytes are not a `what` is a CertificateError that says so."""
    try:
        yield
    except (InvalidEncoding, InvalidKey, CertificateError) as error:
        raise CertificateError(f"not a valid {what}: {error}") from None


def one_block(data: bytes, labels: tuple[str, ...], what: str) -> bytes:
    """The content of the first PEM block with one of `labels`."""
    with parsing(what):
        return pem.first(data, labels).der


def read_signed(data: bytes) -> Signed:
    outer = der.Reader(data)
    sequence = outer.sequence()
    outer.finish()
    body = sequence.raw()
    algorithm = sequence.checked()
    signature = sequence.bit_string()
    sequence.finish()
    return Signed(body, algorithm, signature)


def sign(body: bytes, key: sm2.PrivateKey, uid: bytes) -> bytes:
    return der.sequence(body, SM2_WITH_SM3, der.bit_string(key.sign(body, uid=uid)))


def instant(value: datetime, name: str) -> datetime:
    """`value` in UTC; TypeError if it is no datetime, InvalidOption if it names no moment of the years 1 to 9999."""
    if not isinstance(value, datetime):
        raise TypeError(f"{name} must be a datetime, not {type(value).__name__}")
    if value.utcoffset() is None:
        raise InvalidOption(f"{name} must be an aware datetime, such as datetime.now(timezone.utc)")
    try:
        return value.astimezone(timezone.utc)
    except OverflowError:
        raise InvalidOption(f"{name} is not within the years 1 to 9999 of UTC") from None
