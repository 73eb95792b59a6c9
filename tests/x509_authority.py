"""Certification authorities for tests: a root, and whatever it issues, in a line each."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime, timedelta, timezone
from typing import Any

from smcrypto import der, sm2, x509

UTC = timezone.utc

NOW = datetime(2026, 6, 1, 12, tzinfo=UTC)
BEGIN, END = NOW - timedelta(days=1), NOW + timedelta(days=365)


@dataclass(frozen=True)
class Holder:
    """A certificate and its key."""

    key: sm2.PrivateKey
    certificate: x509.Certificate

    def issue(self, name: str, **options: Any) -> Holder:
        """A certificate for a new key (or `key`), issued by this one."""
        key = options.pop("key", None) or sm2.PrivateKey.generate()
        csr = x509.CertificateSigningRequest.create(key, subject={"CN": name})
        options = {"not_before": BEGIN, "not_after": END, "request_uid": sm2.DEFAULT_UID} | options
        return Holder(key, x509.issue(csr, self.certificate, self.key, **options))

    def forge(self, name: str, **options: Any) -> Holder:
        """As `issue`, where this certificate may not: issued by one of the same name and key that may."""
        forever = datetime(9999, 12, 31, tzinfo=UTC)
        allowed = x509.self_signed(self.key, subject=self.certificate.subject, not_before=BEGIN, not_after=forever)
        return Holder(self.key, allowed).issue(name, **options)

    def ca(self, name: str, **options: Any) -> Holder:
        return self.issue(name, ca=True, **options)

    def crl(self, *revoked: Holder | x509.RevokedCertificate, **options: Any) -> x509.CertificateRevocationList:
        entries = [
            x509.RevokedCertificate(r.certificate.serial_number, NOW, "keyCompromise") if isinstance(r, Holder) else r
            for r in revoked
        ]
        options = {"this_update": NOW, "next_update": NOW + timedelta(days=7), "number": 1} | options
        return x509.CertificateRevocationList.create(self.certificate, self.key, revoked=entries, **options)

    def resigned(self, tbs: bytes, algorithm: bytes | None = None, **options: Any) -> x509.Certificate:
        """The certificate with any body, well formed or not, signed by this key."""
        algorithm = der.sequence(der.oid("1.2.156.10197.1.501")) if algorithm is None else algorithm
        signature = self.key.sign(tbs, **options)
        return x509.Certificate.from_der(der.sequence(tbs, algorithm, der.bit_string(signature)))


def root(name: str = "root", **options: Any) -> Holder:
    key = options.pop("key", None) or sm2.PrivateKey.generate()
    options = {"not_before": BEGIN, "not_after": END} | options
    return Holder(key, x509.self_signed(key, subject={"CN": name}, **options))


def certificates(*holders: Holder) -> list[x509.Certificate]:
    return [holder.certificate for holder in holders]


RSA = der.sequence(der.oid("1.2.840.113549.1.1.1"), der.null())
SHA256_RSA = der.sequence(der.oid("1.2.840.113549.1.1.11"), der.null())


def foreign_der(subject: str = "foreign", key_algorithm: bytes = RSA, issuer: str = "foreign") -> bytes:
    """A certificate of another algorithm, as far as its form goes; nothing verifies its signature."""
    # What stands after the key is not looked at: a BOOLEAN of 1 is not DER.
    odd = der.explicit(3, der.sequence(der.sequence(der.oid("1.2.3"), b"\x01\x01\x01", der.octet_string(b""))))
    tbs = der.sequence(
        der.explicit(0, der.integer(2)), der.integer(7), SHA256_RSA, x509.Name.build({"CN": issuer}).to_der(),
        der.sequence(der.time(BEGIN), der.time(END)), x509.Name.build({"CN": subject}).to_der(),
        der.sequence(key_algorithm, der.bit_string(b"key")), odd,
    )  # fmt: skip
    return der.sequence(tbs, SHA256_RSA, der.bit_string(b"signature"))
