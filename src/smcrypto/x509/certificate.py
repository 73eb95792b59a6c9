"""X.509 certificates that hold SM2 keys: RFC 5280, 4.1; GM/T 0015."""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime

from smcrypto import der, pem, sm2, sm3
from smcrypto.errors import CertificateError
from smcrypto.inputs import BytesLike, as_bytes, require_type
from smcrypto.sm2 import keyfiles
from smcrypto.x509 import extensions as ext
from smcrypto.x509.names import Name
from smcrypto.x509.signed import Signed, parsing

__all__ = ["Certificate", "load_pem_certificates"]


@dataclass(frozen=True, slots=True, init=False, eq=False, repr=False)
class Certificate(Signed):
    """One certificate: read in full, so that what exists is well formed; judged by `verify_chain`."""

    KIND = "certificate"
    LABELS = ("CERTIFICATE", "X509 CERTIFICATE", "X.509 CERTIFICATE")  # RFC 7468, 5.1 and 5.3

    version: int
    """1, 2 or 3."""
    serial_number: int
    """The number that its issuer gave it; with the issuer's name it tells the certificate from all others."""
    issuer: Name
    """The name of who signed it."""
    not_before: datetime
    """The first second of validity, aware, UTC."""
    not_after: datetime
    """The last second of validity, aware, UTC."""
    subject: Name
    """The name of whose key it holds."""
    public_key: sm2.PublicKey
    """The subject's SM2 key."""
    extensions: tuple[ext.Extension, ...]
    """All extensions in their order, those we do not understand among them."""
    basic_constraints: ext.BasicConstraints | None
    """Whether it is a CA's, and how many CAs may follow (RFC 5280, 4.2.1.9); None without the extension."""
    key_usage: frozenset[str] | None
    """Names of RFC 5280, 4.2.1.3 ("digitalSignature" …); None without the extension, which allows all."""
    extended_key_usage: tuple[str, ...] | None
    """Purposes by name ("serverAuth" …) or dotted identifier; None without the extension, which allows all."""
    subject_alt_names: tuple[str, ...]
    """`"URI:urn:…"`, `"DNS:…"`, `"email:…"`, `"IP:…"`, …; empty without the extension."""
    subject_key_identifier: bytes | None
    """The name of its key (4.2.1.2), by which those it issues point to it; None without the extension."""
    authority_key_identifier: ext.AuthorityKeyIdentifier | None
    """Which key of the issuer signed it (4.2.1.1); None without the extension."""

    def _read(self, body: der.Reader) -> None:
        version, serial_number = _read_version(body), body.integer()
        self._require_same_algorithm(body)
        issuer = Name.read(body)
        if not issuer:
            raise CertificateError("the issuer's name is empty (RFC 5280, 4.1.2.4)")
        validity = body.sequence()
        not_before, not_after = validity.time(), validity.time()
        validity.finish()
        subject = Name.read(body)
        public_key = sm2.PublicKey.from_bytes(keyfiles.load_public(body.raw(), form="der"))
        for number in (1, 2):  # issuerUniqueID and subjectUniqueID, 4.1.2.8: allowed from version 2, never used
            if body.has_implicit(number) and version >= 2:
                body.implicit(number)
        extensions = ext.read_optional(body, 3) if version == 3 else ()
        self._fill(
            version=version, serial_number=serial_number, issuer=issuer, not_before=not_before, not_after=not_after,
            subject=subject, public_key=public_key, extensions=extensions,
            **ext.values(
                extensions, "basic_constraints", "key_usage", "extended_key_usage", "subject_alt_names",
                "subject_key_identifier", "authority_key_identifier",
            ),
        )  # fmt: skip

    @property
    def is_ca(self) -> bool:
        """Do its basic constraints say that it may issue?"""
        return self.basic_constraints is not None and self.basic_constraints.ca

    @property
    def tbs_certificate(self) -> bytes:
        """The bytes that the signature covers."""
        return self._body

    def verify_signature(self, issuer: Certificate | sm2.PublicKey, *, uid: BytesLike = sm2.DEFAULT_UID) -> None:
        """CertificateError unless `issuer`'s key made this signature. Nothing else is checked: see `verify_chain`."""
        key = issuer.public_key if isinstance(issuer, Certificate) else issuer
        require_type(key, sm2.PublicKey, "issuer")
        self._verify(key, as_bytes(uid, "uid"), f"the certificate of {self.subject or 'nobody'}")

    def fingerprint(self) -> bytes:
        """SM3 of the whole certificate, 32 bytes."""
        return sm3.digest(self._der)

    def __repr__(self) -> str:
        return f"<Certificate {self.subject}, serial {self.serial_number:x}, issued by {self.issuer}>"


def load_pem_certificates(data: BytesLike) -> tuple[Certificate, ...]:
    """Every certificate of a PEM bundle, in order; CertificateError where there is none."""
    with parsing("certificate bundle"):
        blocks = pem.decode(as_bytes(data, "data"), Certificate.LABELS)
    found = tuple(Certificate.from_der(block.der) for block in blocks)
    if not found:
        raise CertificateError("no certificate in the PEM data")
    return found


def _read_version(body: der.Reader) -> int:
    """4.1.2.1: absent is version 1, a default that DER never spells out."""
    if not body.has_explicit(0):
        return 1
    wrapped = body.explicit(0)
    number = wrapped.integer()
    wrapped.finish()
    if number not in (1, 2):
        raise CertificateError(f"certificate version {number + 1}")
    return number + 1
