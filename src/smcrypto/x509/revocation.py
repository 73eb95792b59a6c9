"""Certificate revocation lists, version 2: RFC 5280, 5 and 6.3.

Not here: delta lists, indirect lists and lists by distribution point. They
mark themselves by critical extensions, and a list with a critical extension
is refused.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass
from datetime import datetime
from itertools import pairwise
from typing import Final

from smcrypto import der, sm2
from smcrypto.errors import CertificateError, CertificateRevokedError, InvalidOption
from smcrypto.inputs import BytesLike, as_bytes, require_int, require_type
from smcrypto.x509 import extensions as ext
from smcrypto.x509.certificate import Certificate, require_key_of, require_usage
from smcrypto.x509.names import Name
from smcrypto.x509.signed import SM2_WITH_SM3, Signed, instant, sign

__all__ = ["CertificateRevocationList", "RevokedCertificate", "check_revocation"]

_UNDERSTOOD: Final = (ext.CRL_NUMBER, ext.AUTHORITY_KEY_IDENTIFIER)


@dataclass(frozen=True, slots=True)
class RevokedCertificate:
    """One entry: which certificate, since when, and why ("unspecified" where no reason is given)."""

    serial_number: int
    revoked_at: datetime
    reason: str = "unspecified"


@dataclass(frozen=True, slots=True, init=False, eq=False, repr=False)
class CertificateRevocationList(Signed):
    """What a CA has revoked, at one moment and until the next list is due."""

    KIND = "revocation list"
    LABELS = ("X509 CRL",)  # RFC 7468, 6

    issuer: Name
    """The name of the CA whose certificates it is about."""
    this_update: datetime
    """When it was made, aware, UTC."""
    next_update: datetime | None
    """When the next list is due at the latest; a list without it (RFC 5280 wants it) is never fresh."""
    extensions: tuple[ext.Extension, ...]
    """All extensions of the list, in their order."""
    number: int | None
    """Its place among the lists of its issuer (RFC 5280, 5.2.3); None if it does not say."""
    authority_key_identifier: ext.AuthorityKeyIdentifier | None
    """Which key of the issuer signed it (5.2.1); None without the extension."""
    _by_serial: dict[int, RevokedCertificate]
    _not_understood: tuple[str, ...]  # critical extensions

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
        an entry twice, an unknown reason, a negative number or serial number, naive or reversed times.
        """
        require_key_of(ca_certificate, ca_key)
        begin, end = instant(this_update, "this_update"), instant(next_update, "next_update")
        if end < begin:
            raise InvalidOption("next_update lies before this_update")
        if not 0 <= require_int(number, "number") < 2**159:
            raise InvalidOption("the list's number must not be negative and must fit 20 bytes (RFC 5280, 5.2.3)")
        entries = tuple(revoked)
        for entry in entries:
            require_type(entry, RevokedCertificate, "what is revoked")
            if require_int(entry.serial_number, "serial_number") < 0:
                raise InvalidOption("a serial number that is revoked must not be negative")
        if len({entry.serial_number for entry in entries}) != len(entries):
            raise InvalidOption("a serial number is revoked twice")
        extensions = [ext.Extension(ext.CRL_NUMBER, False, der.integer(number))]
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

    def _read(self, body: der.Reader) -> None:
        version_2 = body.peek_tag() == der.INTEGER
        if version_2 and body.integer() != 1:
            raise CertificateError("a revocation list of a version other than 1 and 2")
        self._require_same_algorithm(body)
        issuer, this_update = Name.read(body), body.time()
        next_update = body.time() if body.peek_tag() in (der.UTC_TIME, der.GENERALIZED_TIME) else None
        by_serial: dict[int, RevokedCertificate] = {}
        critical: list[str] = []
        if body.peek_tag() == der.SEQUENCE:
            entries = body.sequence()
            if entries.at_end():
                raise CertificateError("the list of revoked certificates is there, but empty (RFC 5280, 5.1.2.6)")
            while not entries.at_end():
                entry = entries.sequence()
                serial_number, revoked_at, reason = entry.integer(signed=True), entry.time(), "unspecified"
                if not entry.at_end():
                    extensions = ext.read_extensions(entry)
                    reason = str(ext.values(extensions, "reason")["reason"])
                    critical += [e.oid for e in extensions if e.critical and e.oid != ext.REASON_CODE]
                if serial_number in by_serial:
                    raise CertificateError(f"serial number {serial_number:x} is listed twice")
                by_serial[serial_number] = RevokedCertificate(serial_number, revoked_at, reason)
        extensions = ext.read_extensions(body.explicit(0)) if version_2 and body.has_explicit(0) else ()
        critical += [e.oid for e in extensions if e.critical and e.oid not in _UNDERSTOOD]
        self._fill(
            issuer=issuer, this_update=this_update, next_update=next_update, extensions=extensions,
            **ext.values(extensions, "number", "authority_key_identifier"),
            _by_serial=by_serial, _not_understood=tuple(critical),
        )  # fmt: skip

    @property
    def revoked(self) -> tuple[RevokedCertificate, ...]:
        """Every entry, in the order of the list."""
        return tuple(self._by_serial.values())

    def find(self, serial_number: int) -> RevokedCertificate | None:
        """The entry for a certificate of this issuer, None if it is not revoked."""
        return self._by_serial.get(require_int(serial_number, "serial_number"))

    def verify(self, issuer: Certificate, *, uid: BytesLike = sm2.DEFAULT_UID) -> None:
        """CertificateError unless `issuer` may sign revocation lists and signed this one under `uid`."""
        require_type(issuer, Certificate, "issuer")
        what = f"the revocation list of {self.issuer}"
        if issuer.subject != self.issuer:
            raise CertificateError(f"{what} is not from {issuer.subject}")
        require_usage(issuer, "may not sign revocation lists (no cRLSign)", "cRLSign")
        if self._not_understood:
            oid = self._not_understood[0]
            raise CertificateError(f"{what} has the critical extension {oid}, which is not understood")
        self._verify(issuer.public_key, as_bytes(uid, "uid"), what)

    def require_fresh(self, at: datetime) -> None:
        """CertificateError unless `at` lies between this_update and next_update."""
        moment = instant(at, "at")
        if moment < self.this_update:
            raise CertificateError(f"the revocation list of {self.issuer} is from {self.this_update}, the future")
        if self.next_update is None or moment > self.next_update:
            due = self.next_update or "nobody knows when"
            raise CertificateError(f"the revocation list of {self.issuer} is stale: the next was due {due}")

    def __repr__(self) -> str:
        return f"<CertificateRevocationList of {self.issuer}, {len(self._by_serial)} revoked>"


def _write_entry(entry: RevokedCertificate) -> bytes:
    if entry.reason not in ext.REASONS:
        raise InvalidOption(f"unknown reason {entry.reason!r}; there are {', '.join(ext.REASONS)}")
    parts = [der.integer(entry.serial_number), der.time(instant(entry.revoked_at, "revoked_at"))]
    if entry.reason != "unspecified":  # 5.3.1: left out rather than said
        reason = der.enumerated(ext.REASONS[entry.reason])
        parts.append(der.sequence(ext.Extension(ext.REASON_CODE, False, reason).to_der()))
    return der.sequence(*parts)


def check_revocation(
    path: Sequence[Certificate], crls: Sequence[CertificateRevocationList], at: datetime,
    verify: Callable[[CertificateRevocationList, Certificate], None], *, every: bool,
) -> None:  # fmt: skip
    """CertificateError if a certificate of `path` (leaf first, root last) is revoked, or that cannot be known.

    The leaf needs a fresh list of its issuer; with `every` so does each
    certificate below the root, without it a CA is checked where a list of its issuer is given.
    verify: of a list and its issuer, raises CertificateError. A listed certificate is refused whatever the date of its
    revocation.
    """
    for position, (certificate, issuer) in enumerate(pairwise(path)):
        problem: CertificateError | None = None
        if every or position == 0:
            problem = CertificateError(f"there is no revocation list of {certificate.issuer} for {certificate.subject}")
        known = False
        for crl in (crl for crl in crls if crl.issuer == certificate.issuer):
            try:
                crl.require_fresh(at)  # first, as it costs nothing
                verify(crl, issuer)
            except CertificateError as error:
                problem = error
                continue
            known = True
            if (entry := crl.find(certificate.serial_number)) is not None:
                raise CertificateRevokedError(
                    f"{certificate.subject} was revoked at {entry.revoked_at}: {entry.reason}"
                )
        if not known and problem is not None:
            raise problem
