"""X.509 certificates: RFC 5280, 4.1; GM/T 0015. Those with SM2 keys are read in full, all others only as far as names.

`load_pem_certificates` and `load_der_certificate` read both kinds, so that an RSA certificate beside an SM2 one
does no harm.
"""

from __future__ import annotations

from dataclasses import dataclass
from datetime import datetime
from ipaddress import IPv4Address, IPv6Address, ip_address
from typing import Final

from smcrypto import der, pem, sm2, sm3
from smcrypto.errors import CertificateAlgorithmError, CertificateError, CertificateUsageError, InvalidKey
from smcrypto.inputs import BytesLike, as_bytes, require_type
from smcrypto.x509 import extensions as ext
from smcrypto.x509.hostnames import IPAddress, require_hostname
from smcrypto.x509.names import Name
from smcrypto.x509.signed import Signed, parsing

__all__ = [
    "AnyCertificate", "Certificate", "ForeignCertificate", "load_der_certificate", "load_pem_certificates",
    "require_usage",
]  # fmt: skip

# Algorithms of keys, by what stands in SubjectPublicKeyInfo: RFC 3279, 2.3; RFC 5480, 2.1.1; RFC 8410, 3; RFC 9881, 2.
_EC: Final = "1.2.840.10045.2.1"
_ALGORITHMS: Final = {
    "1.2.840.113549.1.1.1": "RSA",
    "1.2.840.113549.1.1.10": "RSA-PSS",
    "1.2.840.10040.4.1": "DSA",
    "1.3.101.112": "Ed25519",
    "1.3.101.113": "Ed448",
    "2.16.840.1.101.3.4.3.17": "ML-DSA-44",
    "2.16.840.1.101.3.4.3.18": "ML-DSA-65",
    "2.16.840.1.101.3.4.3.19": "ML-DSA-87",
    "1.2.840.10045.3.1.7": "EC P-256",
    "1.3.132.0.34": "EC P-384",
    "1.3.132.0.35": "EC P-521",
    "1.3.132.0.10": "EC secp256k1",
    "1.2.156.10197.1.301": "SM2",
}


@dataclass(frozen=True, slots=True, init=False, eq=False, repr=False)
class AnyCertificate(Signed):
    """What every certificate says, of whatever algorithm its key is."""

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
    algorithm: str
    """Of its key: "SM2", "RSA", "EC P-256", "Ed25519" …; a dotted identifier where it has no name here."""
    oddities: tuple[str, ...]
    """What is not as RFC 5280 and DER want it, in a sentence each, though its meaning is plain; empty as a rule."""

    def _read(self, body: der.Reader) -> None:
        version = 1  # where nothing is said; DER never spells that out (4.1.2.1)
        if body.has_explicit(0):
            version += body.explicit(0).integer()
            if version not in (2, 3):
                raise CertificateError(f"certificate version {version}")
        serial_number = body.integer(signed=True)
        self._require_same_algorithm(body)
        issuer = Name.read(body)
        if not issuer:
            raise CertificateError("the issuer's name is empty (RFC 5280, 4.1.2.4)")
        validity = body.raw()
        with der.reading_sequence(validity) as times:
            not_before, not_after = times.time(), times.time()
        odd = []
        if not 0 < serial_number < 2**159:
            odd.append("the serial number is not positive, or longer than 20 bytes (RFC 5280, 4.1.2.2)")
        if validity != der.sequence(der.time(not_before), der.time(not_after)):
            odd.append("a date through 2049 is not a UTCTime (RFC 5280, 4.1.2.5)")
        self._fill(version=version, serial_number=serial_number, issuer=issuer, not_before=not_before,
                   not_after=not_after, subject=Name.read(body), oddities=tuple(odd))  # fmt: skip

    def fingerprint(self) -> bytes:
        """SM3 of the whole certificate, 32 bytes."""
        return sm3.digest(self._der)

    def __repr__(self) -> str:
        return f"<{type(self).__name__} {self.subject}, serial {self.serial_number:x}, issued by {self.issuer}>"


@dataclass(frozen=True, slots=True, init=False, eq=False, repr=False)
class ForeignCertificate(AnyCertificate):
    """A certificate whose key is not of SM2: kept as bytes and named, never judged; no path leads through it."""

    def _read(self, body: der.Reader) -> None:
        AnyCertificate._read(self, body)
        algorithm = _algorithm(body.raw())
        if algorithm == "SM2":
            raise CertificateError("its key is of SM2: it is a Certificate")
        self._fill(algorithm=algorithm)
        body.each(der.Reader.raw)


@dataclass(frozen=True, slots=True, init=False, eq=False, repr=False)
class Certificate(AnyCertificate):
    """One certificate: read in full, so that what exists is well formed; judged by `verify_chain`."""

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
        AnyCertificate._read(self, body)
        info = body.raw()
        try:
            public_key = sm2.PublicKey.from_der(info)
        except InvalidKey:
            algorithm = _algorithm(info)
            if algorithm == "SM2":
                raise
            raise CertificateAlgorithmError(f"the key of {self.subject or 'nobody'} is {algorithm}, not SM2") from None
        for number in (1, 2):  # issuerUniqueID and subjectUniqueID, 4.1.2.8: allowed from version 2, never used
            if body.has_implicit(number) and self.version >= 2:
                body.implicit(number)
        extensions: tuple[ext.Extension, ...] = ()
        odd = self.oddities
        if self.version == 3 and body.has_explicit(3):
            encoded = body.explicit(3).raw()
            extensions = der.parse(encoded, ext.read_extensions)
            odd += tuple(ext.oddities(extensions, encoded))
        self._fill(
            algorithm="SM2", public_key=public_key, extensions=extensions, oddities=odd,
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
    def dns_names(self) -> tuple[str, ...]:
        """The host names among its alternative names, as they stand there; `*.example.com` is a wildcard."""
        return tuple(name[4:] for name in self.subject_alt_names if name.startswith("DNS:"))

    @property
    def ip_addresses(self) -> tuple[IPAddress, ...]:
        """The IP addresses among its alternative names."""
        return tuple(ip_address(name[3:]) for name in self.subject_alt_names if name.startswith("IP:"))

    def verify_hostname(self, name: str | IPv4Address | IPv6Address) -> None:
        """CertificateHostnameError unless the certificate is for the host `name`: RFC 9525, 6.

        name: a host name, or an IP address as text or object. Case and one dot at the end do not count. A name
        with other letters than ASCII's is given as its A-labels ("xn--…"); what is no host name is InvalidOption.
        An address matches alternative names of type iPAddress only, a host name those of type dNSName only, in which
        `*` is read where it is the whole left-most label, two labels at least follow, and stands for one label.
        The subject's CN is never looked at. Nothing else is checked: see `verify_chain`.
        """
        require_hostname(name, self.dns_names, self.ip_addresses, f"the certificate of {self.subject or 'nobody'}")

    @property
    def tbs_certificate(self) -> bytes:
        """The bytes that the signature covers."""
        return self._body

    def verify_signature(self, issuer: Certificate | sm2.PublicKey, *, uid: BytesLike = sm2.DEFAULT_UID) -> None:
        """CertificateError unless `issuer`'s key made this signature. Nothing else is checked: see `verify_chain`."""
        key = issuer.public_key if isinstance(issuer, Certificate) else issuer
        require_type(key, sm2.PublicKey, "issuer")
        self._verify(key, as_bytes(uid, "uid"), f"the certificate of {self.subject or 'nobody'}")


def require_key_of(ca_certificate: Certificate, ca_key: sm2.PrivateKey) -> None:
    """InvalidKey, or TypeError, unless `ca_key` is the key of `ca_certificate`."""
    require_type(ca_certificate, Certificate, "ca_certificate")
    require_type(ca_key, sm2.PrivateKey, "ca_key")
    if ca_key.public_key != ca_certificate.public_key:
        raise InvalidKey("ca_key is not the key of ca_certificate")


def load_der_certificate(data: BytesLike) -> Certificate | ForeignCertificate:
    """The certificate that `data` is: a ForeignCertificate where its key is not of SM2. CertificateMalformedError."""
    try:
        return Certificate.from_der(data)
    except CertificateAlgorithmError:
        return ForeignCertificate.from_der(data)


def load_pem_certificates(data: BytesLike) -> tuple[Certificate | ForeignCertificate, ...]:
    """Every certificate of a PEM bundle, in order; CertificateError where there is none or one is malformed."""
    with parsing("certificate bundle"):
        blocks = pem.decode(as_bytes(data, "data"), AnyCertificate.LABELS)
    found = tuple(load_der_certificate(block.der) for block in blocks)
    if not found:
        raise CertificateError("no certificate in the PEM data")
    return found


def require_usage(certificate: Certificate, refusal: str, *usages: str) -> None:
    """CertificateUsageError with `refusal` unless keyUsage has one of `usages`, or is not there (RFC 5280, 4.2.1.3)."""
    usage = certificate.key_usage
    if usage is not None and usage.isdisjoint(usages):
        found = ", ".join(sorted(usage))
        raise CertificateUsageError(f"{certificate.subject} {refusal}: its certificate is for {found}")


def _algorithm(info: bytes) -> str:
    """The name of the algorithm of a SubjectPublicKeyInfo; of an EC key, that of its curve."""
    with der.reading_sequence(info) as members:
        algorithm = members.sequence()
        oid = algorithm.oid()
        curve = algorithm.oid() if oid == _EC and algorithm.peek_tag() != der.SEQUENCE else None
        algorithm.rest()
        members.rest()
    if oid == _EC:
        return "EC with explicit parameters" if curve is None else _ALGORITHMS.get(curve, f"EC {curve}")
    return _ALGORITHMS.get(oid, oid)
