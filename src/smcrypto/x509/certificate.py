"""X.509 certificates that hold SM2 keys: RFC 5280, 4.1; GM/T 0015."""

from __future__ import annotations

from datetime import datetime

from smcrypto import der, pem, sm2, sm3
from smcrypto.errors import CertificateError
from smcrypto.inputs import BytesLike, as_bytes, require_type
from smcrypto.sm2 import keyfiles
from smcrypto.x509 import extensions as ext
from smcrypto.x509.names import Name
from smcrypto.x509.signed import one_block, parsing, read_signed

__all__ = ["Certificate", "load_pem_certificates"]

# RFC 7468, 5.1 and 5.3: generators write the first; parsers may take the others.
_LABELS = ("CERTIFICATE", "X509 CERTIFICATE", "X.509 CERTIFICATE")
LABEL = _LABELS[0]


class Certificate:
    """One certificate: read in full, so that what exists is well formed; judged by `verify_chain`."""

    __slots__ = (
        "_authority_key_identifier",
        "_basic_constraints",
        "_der",
        "_extended_key_usage",
        "_extensions",
        "_issuer",
        "_key_usage",
        "_not_after",
        "_not_before",
        "_public_key",
        "_serial_number",
        "_signed",
        "_subject",
        "_subject_alt_names",
        "_subject_key_identifier",
        "_version",
    )

    def __init__(self) -> None:
        raise TypeError("certificates come from from_pem, from_der, issue or self_signed")

    @classmethod
    def from_pem(cls, data: BytesLike) -> Certificate:
        """The first certificate in `data`; text and other blocks around it are skipped."""
        return cls.from_der(one_block(as_bytes(data, "data"), _LABELS, "certificate"))

    @classmethod
    def from_der(cls, data: BytesLike) -> Certificate:
        """CertificateError for anything but one DER certificate with an SM2 key."""
        certificate = cls.__new__(cls)
        with parsing("certificate"):
            certificate._read(as_bytes(data, "data"))
        return certificate

    def _read(self, data: bytes) -> None:
        self._der = data
        self._signed = read_signed(data)
        body = self._signed.fields()
        self._version = _read_version(body)
        self._serial_number = body.integer()
        if body.raw() != self._signed.algorithm:
            raise CertificateError("the two statements of the signature algorithm differ (RFC 5280, 4.1.1.2)")
        self._issuer = Name.read(body)
        if not self._issuer:
            raise CertificateError("the issuer's name is empty (RFC 5280, 4.1.2.4)")
        validity = body.sequence()
        self._not_before, self._not_after = validity.time(), validity.time()
        validity.finish()
        self._subject = Name.read(body)
        self._public_key = sm2.PublicKey.from_bytes(keyfiles.load_public(body.raw(), form="der"))
        for number in (1, 2):  # issuerUniqueID and subjectUniqueID, 4.1.2.8: allowed from version 2, never used
            if body.has_implicit(number) and self._version >= 2:
                body.implicit(number)
        self._extensions: tuple[ext.Extension, ...] = ()
        if body.has_explicit(3) and self._version == 3:
            wrapped = body.explicit(3)
            self._extensions = ext.read_extensions(wrapped)
            wrapped.finish()
        body.finish()
        self._read_extensions()

    def _read_extensions(self) -> None:
        self._basic_constraints: ext.BasicConstraints | None = None
        self._key_usage: frozenset[str] | None = None
        self._extended_key_usage: tuple[str, ...] | None = None
        self._subject_alt_names: tuple[str, ...] = ()
        self._subject_key_identifier: bytes | None = None
        self._authority_key_identifier: ext.AuthorityKeyIdentifier | None = None
        for extension in self._extensions:
            value = extension.value
            match extension.oid:
                case ext.BASIC_CONSTRAINTS:
                    self._basic_constraints = ext.read_basic_constraints(value)
                case ext.KEY_USAGE:
                    self._key_usage = ext.read_key_usage(value)
                case ext.EXTENDED_KEY_USAGE:
                    self._extended_key_usage = ext.read_extended_key_usage(value)
                case ext.SUBJECT_ALT_NAME:
                    self._subject_alt_names = ext.read_subject_alt_names(value)
                case ext.SUBJECT_KEY_IDENTIFIER:
                    self._subject_key_identifier = ext.read_subject_key_identifier(value)
                case ext.AUTHORITY_KEY_IDENTIFIER:
                    self._authority_key_identifier = ext.read_authority_key_identifier(value)

    # --- what it says ---

    @property
    def version(self) -> int:
        """1, 2 or 3."""
        return self._version

    @property
    def serial_number(self) -> int:
        """The number that its issuer gave it; with the issuer's name it tells the certificate from all others."""
        return self._serial_number

    @property
    def issuer(self) -> Name:
        """The name of who signed it."""
        return self._issuer

    @property
    def subject(self) -> Name:
        """The name of whose key it holds."""
        return self._subject

    @property
    def not_before(self) -> datetime:
        """The first second of validity, aware, UTC."""
        return self._not_before

    @property
    def not_after(self) -> datetime:
        """The last second of validity, aware, UTC."""
        return self._not_after

    @property
    def public_key(self) -> sm2.PublicKey:
        """The subject's SM2 key."""
        return self._public_key

    @property
    def extensions(self) -> tuple[ext.Extension, ...]:
        """All extensions in their order, those we do not understand among them."""
        return self._extensions

    @property
    def basic_constraints(self) -> ext.BasicConstraints | None:
        """Whether it is a CA's, and how many CAs may follow (RFC 5280, 4.2.1.9); None without the extension."""
        return self._basic_constraints

    @property
    def is_ca(self) -> bool:
        """Do its basic constraints say that it may issue?"""
        return self._basic_constraints is not None and self._basic_constraints.ca

    @property
    def key_usage(self) -> frozenset[str] | None:
        """Names of RFC 5280, 4.2.1.3 ("digitalSignature" …); None without the extension, which allows all."""
        return self._key_usage

    @property
    def extended_key_usage(self) -> tuple[str, ...] | None:
        """Purposes by name ("serverAuth" …) or dotted identifier; None without the extension, which allows all."""
        return self._extended_key_usage

    @property
    def subject_alt_names(self) -> tuple[str, ...]:
        """`"URI:urn:…"`, `"DNS:…"`, `"email:…"`, `"IP:…"`, …; empty without the extension."""
        return self._subject_alt_names

    @property
    def subject_key_identifier(self) -> bytes | None:
        """The name of its key (4.2.1.2), by which those it issues point to it; None without the extension."""
        return self._subject_key_identifier

    @property
    def authority_key_identifier(self) -> ext.AuthorityKeyIdentifier | None:
        """Which key of the issuer signed it (4.2.1.1); None without the extension."""
        return self._authority_key_identifier

    @property
    def signature(self) -> bytes:
        """As it stands in the certificate: the DER of GM/T 0009."""
        return self._signed.signature

    @property
    def tbs_certificate(self) -> bytes:
        """The bytes that the signature covers."""
        return self._signed.body

    # --- what can be done with it ---

    def verify_signature(
        self, issuer: Certificate | sm2.PublicKey, *, uid: BytesLike = sm2.DEFAULT_UID
    ) -> None:
        """CertificateError unless `issuer`'s key made this signature. Nothing else is checked: see `verify_chain`."""
        key = issuer.public_key if isinstance(issuer, Certificate) else issuer
        require_type(key, sm2.PublicKey, "issuer")
        self._signed.verify(key, as_bytes(uid, "uid"), f"the certificate of {self._subject or 'nobody'}")

    def fingerprint(self) -> bytes:
        """SM3 of the whole certificate, 32 bytes."""
        return sm3.digest(self._der)

    def to_der(self) -> bytes:
        """The bytes it was read from, or issued as."""
        return self._der

    def to_pem(self) -> bytes:
        """The same as PEM, label CERTIFICATE."""
        return pem.encode(LABEL, self._der)

    def __eq__(self, other: object) -> bool:
        if not isinstance(other, Certificate):
            return NotImplemented
        return self._der == other._der

    def __hash__(self) -> int:
        return hash(self._der)

    def __repr__(self) -> str:
        return f"<Certificate {self._subject}, serial {self._serial_number:x}, issued by {self._issuer}>"

    def __reduce__(self) -> tuple[object, tuple[bytes]]:
        return Certificate.from_der, (self._der,)


def load_pem_certificates(data: BytesLike) -> tuple[Certificate, ...]:
    """Every certificate of a PEM bundle, in order; CertificateError where there is none."""
    with parsing("certificate bundle"):
        blocks = pem.decode(as_bytes(data, "data"))
    found = tuple(Certificate.from_der(block.der) for block in blocks if block.label in _LABELS)
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
