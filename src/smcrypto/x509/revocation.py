"""Certificate revocation lists, version 2: RFC 5280, 5 and 6.3.

Not here: delta lists, indirect lists and lists by distribution point. They
mark themselves by critical extensions, and a list with a critical extension
is refused.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime
from itertools import pairwise
from typing import Final

from smcrypto import der, pem, sm2
from smcrypto.errors import CertificateError, InvalidKey, InvalidOption
from smcrypto.inputs import BytesLike, as_bytes, require_int, require_type
from smcrypto.x509 import extensions as ext
from smcrypto.x509.certificate import Certificate
from smcrypto.x509.names import Name
from smcrypto.x509.signed import (
    SM2_WITH_SM3,
    CertificateRevokedError,
    instant,
    one_block,
    parsing,
    read_signed,
    sign,
)

__all__ = ["CertificateRevocationList", "RevokedCertificate", "check_revocation"]

_CRL_NUMBER: Final = "2.5.29.20"
_REASON_CODE: Final = "2.5.29.21"
# 5.3.1; 7 is not used, 8 (removeFromCRL) belongs to delta lists.
_REASONS: Final = {
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
_REASON_NAMES: Final = {code: name for name, code in _REASONS.items()}
_LABELS: Final = ("X509 CRL",)  # RFC 7468, 6


@dataclass(frozen=True, slots=True)
class RevokedCertificate:
    """One entry: which certificate, since when, and why ("unspecified" where no reason is given)."""

    serial_number: int
    revoked_at: datetime
    reason: str = "unspecified"


class CertificateRevocationList:
    """What a CA has revoked, at one moment and until the next list is due."""

    __slots__ = (
        "_authority_key_identifier",
        "_by_serial",
        "_der",
        "_extensions",
        "_issuer",
        "_next_update",
        "_number",
        "_signed",
        "_this_update",
        "_unprocessed",
    )

    def __init__(self) -> None:
        raise TypeError("revocation lists come from create, from_pem or from_der")

    @classmethod
    def create(
        cls,
        ca_certificate: Certificate,
        ca_key: sm2.PrivateKey,
        *,
        revoked: Iterable[RevokedCertificate],
        this_update: datetime,
        next_update: datetime,
        number: int,
        uid: BytesLike = sm2.DEFAULT_UID,
    ) -> CertificateRevocationList:
        """The CA's list, complete. number: above that of every list before (5.2.3).

        InvalidKey: `ca_key` is not the key of `ca_certificate`. InvalidOption:
        an entry twice, an unknown reason, a negative number, naive or reversed times.
        """
        require_type(ca_certificate, Certificate, "ca_certificate")
        require_type(ca_key, sm2.PrivateKey, "ca_key")
        if ca_key.public_key != ca_certificate.public_key:
            raise InvalidKey("ca_key is not the key of ca_certificate")
        begin, end = instant(this_update, "this_update"), instant(next_update, "next_update")
        if end < begin:
            raise InvalidOption("next_update lies before this_update")
        if not 0 <= require_int(number, "number") < 2**159:
            raise InvalidOption("the list's number must not be negative and must fit 20 bytes (RFC 5280, 5.2.3)")
        entries = tuple(revoked)
        for entry in entries:
            require_type(entry, RevokedCertificate, "what is revoked")
        if len({entry.serial_number for entry in entries}) != len(entries):
            raise InvalidOption("a serial number is revoked twice")
        extensions = [ext.Extension(_CRL_NUMBER, False, der.integer(number))]
        if ca_certificate.subject_key_identifier is not None:
            extensions.insert(0, ext.authority_key_identifier(ca_certificate.subject_key_identifier))
        body = der.sequence(
            der.integer(1),  # version 2
            SM2_WITH_SM3,
            ca_certificate.subject.to_der(),
            der.time(begin),
            der.time(end),
            *([der.sequence(*map(_write_entry, entries))] if entries else []),
            der.explicit(0, der.sequence(*(e.to_der() for e in extensions))),
        )
        return cls.from_der(sign(body, ca_key, as_bytes(uid, "uid")))

    @classmethod
    def from_pem(cls, data: BytesLike) -> CertificateRevocationList:
        """The first revocation list in `data`; text and other blocks around it are skipped."""
        return cls.from_der(one_block(as_bytes(data, "data"), _LABELS, "revocation list"))

    @classmethod
    def from_der(cls, data: BytesLike) -> CertificateRevocationList:
        """CertificateError for anything but one DER revocation list. The signature is left to `verify`."""
        found = cls.__new__(cls)
        with parsing("revocation list"):
            found._read(as_bytes(data, "data"))
        return found

    def _read(self, data: bytes) -> None:
        self._der = data
        self._signed = read_signed(data)
        body = self._signed.fields()
        version_2 = body.peek_tag() == der.INTEGER
        if version_2 and body.integer() != 1:
            raise CertificateError("a revocation list of a version other than 1 and 2")
        if body.raw() != self._signed.algorithm:
            raise CertificateError("the two statements of the signature algorithm differ (RFC 5280, 5.1.1.2)")
        self._issuer = Name.read(body)
        self._this_update = body.time()
        timed = body.peek_tag() in (der.UTC_TIME, der.GENERALIZED_TIME)
        self._next_update = body.time() if timed else None
        self._by_serial: dict[int, RevokedCertificate] = {}
        self._unprocessed: list[str] = []
        if body.peek_tag() == der.SEQUENCE:
            self._read_entries(body.sequence())
        self._extensions: tuple[ext.Extension, ...] = ()
        if body.has_explicit(0) and version_2:
            wrapped = body.explicit(0)
            self._extensions = ext.read_extensions(wrapped)
            wrapped.finish()
        body.finish()
        self._number: int | None = None
        self._authority_key_identifier: ext.AuthorityKeyIdentifier | None = None
        for extension in self._extensions:
            if extension.oid == _CRL_NUMBER:
                reader = der.Reader(extension.value)
                self._number = reader.integer()
                reader.finish()
            elif extension.oid == ext.AUTHORITY_KEY_IDENTIFIER:
                self._authority_key_identifier = ext.read_authority_key_identifier(extension.value)
            elif extension.critical:
                self._unprocessed.append(extension.oid)

    def _read_entries(self, entries: der.Reader) -> None:
        if entries.at_end():
            raise CertificateError("the list of revoked certificates is there, but empty (RFC 5280, 5.1.2.6)")
        while not entries.at_end():
            entry = entries.sequence()
            serial_number, revoked_at, reason = entry.integer(), entry.time(), 0
            if not entry.at_end():
                for extension in ext.read_extensions(entry):
                    if extension.oid == _REASON_CODE:
                        reader = der.Reader(extension.value)
                        reason = reader.enumerated()
                        reader.finish()
                    elif extension.critical:
                        self._unprocessed.append(extension.oid)
            entry.finish()
            if reason not in _REASON_NAMES:
                raise CertificateError(f"revocation reason {reason} has no meaning in a complete list")
            if serial_number in self._by_serial:
                raise CertificateError(f"serial number {serial_number:x} is listed twice")
            self._by_serial[serial_number] = RevokedCertificate(serial_number, revoked_at, _REASON_NAMES[reason])

    @property
    def issuer(self) -> Name:
        """The name of the CA whose certificates it is about."""
        return self._issuer

    @property
    def this_update(self) -> datetime:
        """When it was made, aware, UTC."""
        return self._this_update

    @property
    def next_update(self) -> datetime | None:
        """When the next list is due at the latest; a list without it (RFC 5280 wants it) is never fresh."""
        return self._next_update

    @property
    def number(self) -> int | None:
        """Its place among the lists of its issuer (RFC 5280, 5.2.3); None if it does not say."""
        return self._number

    @property
    def revoked(self) -> tuple[RevokedCertificate, ...]:
        """Every entry, in the order of the list."""
        return tuple(self._by_serial.values())

    @property
    def extensions(self) -> tuple[ext.Extension, ...]:
        """All extensions of the list, in their order."""
        return self._extensions

    def find(self, serial_number: int) -> RevokedCertificate | None:
        """The entry for a certificate of this issuer, None if it is not revoked."""
        return self._by_serial.get(serial_number)

    def verify(self, issuer: Certificate, *, uid: BytesLike = sm2.DEFAULT_UID) -> None:
        """CertificateError unless `issuer` may sign revocation lists and signed this one under `uid`."""
        require_type(issuer, Certificate, "issuer")
        what = f"the revocation list of {self._issuer}"
        if issuer.subject != self._issuer:
            raise CertificateError(f"{what} is not from {issuer.subject}")
        if issuer.key_usage is not None and "cRLSign" not in issuer.key_usage:
            raise CertificateError(f"{issuer.subject} may not sign revocation lists (no cRLSign)")
        if self._unprocessed:
            raise CertificateError(f"{what} has the critical extension {self._unprocessed[0]}, which is not understood")
        self._signed.verify(issuer.public_key, as_bytes(uid, "uid"), what)

    def require_fresh(self, at: datetime) -> None:
        """CertificateError unless `at` lies between this_update and next_update."""
        moment = instant(at, "at")
        if moment < self._this_update:
            raise CertificateError(f"the revocation list of {self._issuer} is from {self._this_update}, the future")
        if self._next_update is None or moment > self._next_update:
            due = self._next_update or "nobody knows when"
            raise CertificateError(f"the revocation list of {self._issuer} is stale: the next was due {due}")

    def to_der(self) -> bytes:
        """The bytes it was read from, or made as."""
        return self._der

    def to_pem(self) -> bytes:
        """The same as PEM, label X509 CRL."""
        return pem.encode(_LABELS[0], self._der)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, CertificateRevocationList):
            return NotImplemented
        return self._der == other._der

    def __hash__(self) -> int:
        return hash(self._der)

    def __repr__(self) -> str:
        return f"<CertificateRevocationList of {self._issuer}, {len(self._by_serial)} revoked>"


def _write_entry(entry: RevokedCertificate) -> bytes:
    if entry.reason not in _REASONS:
        raise InvalidOption(f"unknown reason {entry.reason!r}; there are {', '.join(_REASONS)}")
    parts = [der.integer(entry.serial_number), der.time(instant(entry.revoked_at, "revoked_at"))]
    if entry.reason != "unspecified":  # 5.3.1: left out rather than said
        code = ext.Extension(_REASON_CODE, False, der.enumerated(_REASONS[entry.reason]))
        parts.append(der.sequence(code.to_der()))
    return der.sequence(*parts)


def check_revocation(
    path: Sequence[Certificate],
    crls: Sequence[CertificateRevocationList],
    at: datetime,
    uid: bytes,
    *,
    every: bool,
) -> None:
    """CertificateError if a certificate of `path` (leaf first, root last) is revoked, or that cannot be known.

    The leaf needs a fresh list of its issuer; with `every` so does each
    certificate below the root, without it a CA is checked where a list of its issuer is given.
    A listed certificate is refused whatever the date of its revocation.
    """
    for position, (certificate, issuer) in enumerate(pairwise(path)):
        problem: CertificateError | None = None
        known = False
        for crl in crls:
            if crl.issuer != certificate.issuer:
                continue
            try:
                crl.verify(issuer, uid=uid)
                crl.require_fresh(at)
            except CertificateError as error:
                problem = error
                continue
            known = True
            entry = crl.find(certificate.serial_number)
            if entry is not None:
                raise CertificateRevokedError(
                    f"{certificate.subject} was revoked at {entry.revoked_at}: {entry.reason}"
                )
        if not known and problem is not None:
            raise problem
        if not known and (every or position == 0):
            raise CertificateError(f"there is no revocation list of {certificate.issuer} for {certificate.subject}")
