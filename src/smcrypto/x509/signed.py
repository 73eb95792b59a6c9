"""What certificates, requests and revocation lists have in common: a body, an algorithm, a signature.

RFC 5280, 4.1.1: SEQUENCE { body, AlgorithmIdentifier, BIT STRING }. `Signed` reads it and has the class of each
read its body, once and in full; the result does not change. The
signature covers the body's bytes as they were received; nothing is encoded
again to be verified. The algorithm is SM2-with-SM3, GM/T 0015 and RFC 8998.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime, timezone
from typing import ClassVar, Final, TypeVar

from smcrypto import der, pem, sm2
from smcrypto.errors import (
    CertificateAlgorithmError,
    CertificateError,
    CertificateMalformedError,
    CertificateSignatureError,
    InvalidEncoding,
    InvalidKey,
    InvalidOption,
    InvalidSignature,
)
from smcrypto.inputs import BytesLike, as_bytes

__all__ = ["SM2_WITH_SM3", "Signed", "instant", "parsing", "require_signature", "sign"]

SM2_WITH_SM3: Final = der.sequence(der.oid("1.2.156.10197.1.501"))
# Parameters are absent in what OpenSSL, Tongsuo and GmSSL write; some older software writes NULL.
_ACCEPTED: Final = (SM2_WITH_SM3, der.sequence(der.oid("1.2.156.10197.1.501"), der.null()))


@contextmanager
def parsing(what: str, kind: type[CertificateError] = CertificateError) -> Iterator[None]:
    """Every way in which bytes are not a `what` is a `kind` that says so; another algorithm stays what it is."""
    try:
        yield
    except CertificateAlgorithmError:
        raise
    except (InvalidEncoding, InvalidKey, CertificateError) as error:
        raise kind(f"not a valid {what}: {error}") from None


_T = TypeVar("_T", bound="Signed")


@dataclass(frozen=True, slots=True, init=False, eq=False, repr=False)
class Signed:
    """One certificate, request or revocation list, read in full, so that what exists is well formed."""

    KIND: ClassVar[str]
    """What it is called in messages."""
    LABELS: ClassVar[tuple[str, ...]]
    """Of PEM blocks, RFC 7468: the first is written, the others are read as well."""

    signature: bytes
    """As it stands in it: the DER of GM/T 0009."""
    _der: bytes
    _body: bytes  # what the signature covers
    _algorithm: bytes

    def __init__(self) -> None:
        raise TypeError(f"a {self.KIND} is read by from_pem or from_der, or made by a function that signs it")

    @classmethod
    def from_pem(cls: type[_T], data: BytesLike) -> _T:
        """The first one in `data`; text and other blocks around it are skipped. Errors as of `from_der`."""
        octets = as_bytes(data, "data")
        with parsing(cls.KIND):
            content = pem.first(octets, cls.LABELS).der
        return cls.from_der(content)

    @classmethod
    def from_der(cls: type[_T], data: BytesLike) -> _T:
        """CertificateError for anything but the DER of one; the signature is not verified here.

        CertificateMalformedError: it has the outer form of one, but a field is not well formed.
        CertificateAlgorithmError: a certificate whose key is not of SM2.
        """
        octets = as_bytes(data, "data")
        made = object.__new__(cls)
        with parsing(cls.KIND):
            with der.reading_sequence(octets) as outer:
                body, algorithm, signature = outer.raw(), outer.checked(), outer.bit_string()
            made._fill(_der=octets, _body=body, _algorithm=algorithm, signature=signature)
        with parsing(cls.KIND, CertificateMalformedError), der.reading_sequence(body) as fields:
            made._read(fields)
        return made

    def _read(self, body: der.Reader) -> None:
        """Fill the fields of a class with what stands in the body: each class has its own."""

    def _fill(self, **fields: object) -> None:
        for name, value in fields.items():
            object.__setattr__(self, name, value)

    def _require_same_algorithm(self, body: der.Reader) -> None:
        """RFC 5280, 4.1.1.2 and 5.1.1.2: it is stated twice, once within what is signed."""
        if body.raw() != self._algorithm:
            raise CertificateError("the two statements of the signature algorithm differ (RFC 5280, 4.1.1.2)")

    def _verify(self, public_key: sm2.PublicKey, uid: bytes, what: str) -> None:
        require_signature(public_key, self._body, self._algorithm, self.signature, uid, what)

    def to_der(self) -> bytes:
        """The bytes it was read from, or made as."""
        return self._der

    def to_pem(self) -> bytes:
        """The same as PEM."""
        return pem.encode(self.LABELS[0], self._der)

    def __eq__(self, other: object) -> bool:
        return self._der == other._der if isinstance(other, Signed) else NotImplemented

    def __hash__(self) -> int:
        return hash(self._der)

    def __reduce__(self: _T) -> tuple[object, tuple[bytes]]:
        return type(self).from_der, (self._der,)


def require_signature(
    public_key: sm2.PublicKey, body: bytes, algorithm: bytes, signature: bytes, uid: bytes, what: str
) -> None:
    """CertificateError unless `signature` is this key's of `body` by SM2-with-SM3. algorithm: its identifier in DER."""
    if algorithm not in _ACCEPTED:
        raise CertificateAlgorithmError(f"{what} is not signed with SM2-with-SM3, the only algorithm supported")
    try:
        public_key.verify(signature, body, uid=uid)
    except InvalidSignature:
        raise CertificateSignatureError(f"the signature of {what} does not hold") from None


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
