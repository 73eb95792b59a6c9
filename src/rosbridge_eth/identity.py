"""Who is who: roles, names, certificates under the operator's CA, and signatures bound to a purpose.

An identity is a role and a name with two SM2 key pairs, as in TLCP (GB/T
38636-2020, 6.4.5.3): one for signatures, one for encryption and key exchange,
each with its X.509 certificate. The name stands in the subject alternative
name `urn:rosbridge-eth:ROLE:NAME`; nothing else in a certificate is believed
to say who somebody is.

Every signature covers `"rosbridge-eth/2 " ‖ purpose ‖ 0x00 ‖ body`, so that
one made for a purpose means nothing for another.

Not here: how certificates travel (channel), what is encrypted for whom (log.chunk).
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field
from datetime import datetime, timedelta
from enum import StrEnum
from pathlib import Path

from rosbridge_eth.errors import IdentityError, VerificationError
from rosbridge_eth.files import read_file, write_atomically
from smcrypto import CertificateError, InvalidKey, InvalidSignature, SMCryptoError, sm2, x509

SIGNATURE_SIZE = 64
"""Bytes of a signature: r ‖ s, GB/T 32918.2."""

URI_PREFIX = "URI:urn:rosbridge-eth:"
_NAME = re.compile(r"[a-z0-9][a-z0-9_.-]{0,62}\Z")

_CA_LIFE, _LIFE = timedelta(days=3650), timedelta(days=825)
_BACKDATED = timedelta(days=1)
"""Certificates begin so long before they are made, so that a chain or a robot whose clock is behind does no harm."""

# GB/T 38636-2020, 6.4.5.3: a signing certificate signs, an encryption certificate takes keys. What is signed here is
# kept and shown to others (nonRepudiation, RFC 5280, 4.2.1.3); a TLS client's certificate is no log's signer.
SIGNING_USAGE = ("digitalSignature", "nonRepudiation")
ENCRYPTION_USAGE = ("keyEncipherment", "dataEncipherment", "keyAgreement")

KEY_FILES = ("sign.key.pem", "enc.key.pem")
CERTIFICATE_FILES = ("sign.crt.pem", "enc.crt.pem", "ca.crt.pem")


class Role(StrEnum):
    """What an identity may be; it stands in the certificate and in every handshake."""

    ROBOT = "robot"
    SERVER = "server"
    READER = "reader"


class UntrustedCertificate(IdentityError):
    """A certificate is malformed, of another CA, for another use, or the two are not of one identity."""


class ExpiredCertificate(UntrustedCertificate):
    """A certificate is not valid yet, or not any more."""


class NotAllowed(UntrustedCertificate):
    """The certificate is good, but its holder is not, or no longer, on the allow list."""


def check_name(name: str) -> str:
    """`name`, if it is 1 to 63 of `a-z 0-9 _ . -` and begins with a letter or digit; else IdentityError."""
    if not isinstance(name, str) or not _NAME.match(name):
        raise IdentityError(
            f"the name {name!r} cannot be used: 1 to 63 of a-z, 0-9, '_', '.', '-', and first a letter or digit"
        )
    return name


@dataclass(frozen=True, slots=True)
class PeerIdentity:
    """Somebody, as two certificates say: checked if it came from `Trust.check`."""

    role: Role
    name: str
    signing_certificate: x509.Certificate = field(repr=False)
    encryption_certificate: x509.Certificate = field(repr=False)

    @property
    def certificates(self) -> bytes:
        """Both in DER, signing first: how they stand in a robot's registration on the chain."""
        return b"".join(self.pair)

    @property
    def pair(self) -> tuple[bytes, bytes]:
        """Both in DER, signing first: what `Trust.check` takes."""
        return self.signing_certificate.to_der(), self.encryption_certificate.to_der()

    @property
    def pem(self) -> bytes:
        """Both in PEM, signing first: how they stand in files."""
        return self.signing_certificate.to_pem() + self.encryption_certificate.to_pem()

    @property
    def not_before(self) -> datetime:
        """Both certificates are valid from here."""
        return max(self.signing_certificate.not_before, self.encryption_certificate.not_before)

    @property
    def not_after(self) -> datetime:
        """Both certificates are valid until here."""
        return min(self.signing_certificate.not_after, self.encryption_certificate.not_after)

    def __str__(self) -> str:
        return f"{self.role} {self.name}"


@dataclass(frozen=True, slots=True)
class Identity(PeerIdentity):
    """One's own: with the keys of both certificates. Its repr shows no key."""

    signing_key: sm2.PrivateKey = field(repr=False)
    encryption_key: sm2.PrivateKey = field(repr=False)

    @property
    def public(self) -> PeerIdentity:
        """What others may know of it."""
        return PeerIdentity(self.role, self.name, self.signing_certificate, self.encryption_certificate)


@dataclass(frozen=True, slots=True)
class CertificateAuthority:
    """The operator's CA: its key (not shown) and its certificate."""

    key: sm2.PrivateKey = field(repr=False)
    certificate: x509.Certificate = field(repr=False)


# Signatures bound to a purpose


def _message(purpose: str, body: bytes) -> bytes:
    """purpose: lower-case letters and hyphens; it ends at the zero byte."""
    return b"rosbridge-eth/2 " + purpose.encode("ascii") + b"\0" + body


def sign(key: sm2.PrivateKey, purpose: str, body: bytes) -> bytes:
    """The 64-byte SM2 signature r ‖ s of `body` for `purpose`."""
    return key.sign(_message(purpose, body), encoding="raw")


def verify(public_key: sm2.PublicKey, purpose: str, body: bytes, signature: bytes) -> None:
    """Return if `signature` is `public_key`'s for `purpose` and `body`; else smcrypto.InvalidSignature."""
    if len(signature) != SIGNATURE_SIZE:
        raise InvalidSignature("the signature does not hold")
    public_key.verify(signature, _message(purpose, body), encoding="raw")


# Trust


def _holder(certificate: x509.Certificate) -> tuple[Role, str]:
    names = certificate.subject_alt_names
    if len(names) != 1 or not names[0].startswith(URI_PREFIX):
        raise UntrustedCertificate(f"a certificate must carry exactly one name, {URI_PREFIX}ROLE:NAME")
    role, _, name = names[0].removeprefix(URI_PREFIX).partition(":")
    if role not in Role.__members__.values() or not _NAME.match(name):
        raise UntrustedCertificate(f"{names[0]!r} names no role and name that exist here")
    return Role(role), name


def _pair(signing: x509.Certificate, encryption: x509.Certificate) -> PeerIdentity:
    """Whom two certificates name; UntrustedCertificate if they are not of one identity."""
    holder = _holder(signing)
    if _holder(encryption) != holder:
        raise UntrustedCertificate("the signing and the encryption certificate are of two identities")
    return PeerIdentity(*holder, signing, encryption)


def _check_usage(peer: PeerIdentity) -> None:
    for certificate, usages, others in (
        (peer.signing_certificate, SIGNING_USAGE, ENCRYPTION_USAGE),
        (peer.encryption_certificate, ("keyAgreement",), SIGNING_USAGE),
    ):
        allowed = certificate.key_usage or ()
        if certificate.extended_key_usage is not None or not {*usages} <= {*allowed} or {*others} & {*allowed}:
            raise UntrustedCertificate(
                f"the certificates of {peer} are for another use than signing and encrypting logs. Those of earlier"
                " versions are made again: of a robot by `register --replace` and `join`, of the server by `renew`, of"
                " a reader by `reader` in a new folder"
            )


@dataclass(frozen=True, slots=True)
class Trust:
    """Whom to believe: whom the operator's CA certified, and who is on the allow list.

    allowed: called with a peer whose certificates are good; False refuses it.
    None allows everybody with a good certificate.
    """

    roots: Sequence[x509.Certificate]
    allowed: Callable[[PeerIdentity], bool] | None = None

    def check(
        self, signing_der: bytes, encryption_der: bytes, *, role: Role | Iterable[Role], name: str | None = None,
        at: datetime,
    ) -> PeerIdentity:  # fmt: skip
        """Who the two certificates (DER) say they are, if all of it holds at `at` (aware UTC).

        What has to hold is the table of docs/log.md (Certificates).
        role: the one expected, or several; name: None for any. Raises a
        subclass of UntrustedCertificate that tells why. Costs two or more
        signature verifications.
        """
        try:
            peer = _pair(*map(x509.Certificate.from_der, (signing_der, encryption_der)))
        except (CertificateError, InvalidKey) as error:
            raise UntrustedCertificate(f"a certificate cannot be read: {error}") from error
        if not peer.not_before <= at <= peer.not_after:
            raise ExpiredCertificate(
                f"the certificate of {peer} is valid from {peer.not_before} to {peer.not_after}, not at {at}"
            )
        _check_usage(peer)
        for certificate in (peer.signing_certificate, peer.encryption_certificate):
            try:
                path = x509.verify_chain(certificate, roots=self.roots, at=at)
            except CertificateError as error:
                raise UntrustedCertificate(f"the certificate of {peer} is not to be trusted: {error}") from error
            if len(path) != 2 or certificate.is_ca:
                raise UntrustedCertificate(f"the certificate of {peer} is a CA's, or was not issued by one")
        roles = (role,) if isinstance(role, Role) else tuple(role)
        if peer.role not in roles:
            raise UntrustedCertificate(f"{peer} was met where a {' or '.join(roles)} is expected")
        if name is not None and peer.name != name:
            raise UntrustedCertificate(f"{peer} was met where {name} is expected")
        if self.allowed is not None and not self.allowed(peer):
            raise NotAllowed(f"{peer} is not on the allow list")
        return peer


# Creating identities


def create_ca(name: str, *, at: datetime) -> CertificateAuthority:
    """A new CA for ten years, whose certificate says CN=`name`; it certifies identities only, not other CAs."""
    key = sm2.PrivateKey.generate()
    certificate = x509.self_signed(
        key, subject={"CN": name}, not_before=at - _BACKDATED, not_after=at + _CA_LIFE, ca=True, path_length=0
    )
    return CertificateAuthority(key, certificate)


def load_ca(folder: Path, password: bytes, at: datetime) -> CertificateAuthority:
    """The CA in a folder, as `create_ca` or `python -m smcrypto ca init` made it: `ca.key.pem` and `ca.crt.pem`.

    IdentityError where the key does not open or the certificate is not valid at `at`; `enrol_requests` finds the rest.
    """
    key_file, file = folder / "ca.key.pem", folder / "ca.crt.pem"
    certificate = read_certificates(read_file(file))[0]
    try:
        key = sm2.PrivateKey.from_pem(read_file(key_file, private=True), password=password)
    except InvalidKey as error:
        raise IdentityError(f"{key_file} does not open under this passphrase") from error
    if not certificate.not_before <= at <= certificate.not_after:
        raise IdentityError(f"{file} is valid from {certificate.not_before} to {certificate.not_after}, not at {at}")
    return CertificateAuthority(key, certificate)


def requests(name: str, *keys: sm2.PrivateKey) -> list[x509.CertificateSigningRequest]:
    """The two certificate requests of a signing and an encryption key that never leave their machine."""
    return [x509.CertificateSigningRequest.create(key, subject={"CN": check_name(name)}) for key in keys]


def enrol_requests(
    ca: CertificateAuthority, role: Role, name: str, signing_request: x509.CertificateSigningRequest,
    encryption_request: x509.CertificateSigningRequest, *, at: datetime,
) -> PeerIdentity:  # fmt: skip
    """Certificates for `role` and `name` over the keys of two requests; they begin a day before `at`.

    Role, name, uses and validity are the CA's to say; of a request only the
    key and the subject are taken, and the subject must be CN=`name`.
    """
    certificates = []
    for request, usage in ((signing_request, SIGNING_USAGE), (encryption_request, ENCRYPTION_USAGE)):
        if str(request.subject) != f"CN={check_name(name)}":
            raise IdentityError(f"the certificate request says {request.subject}, not CN={name}")
        try:
            certificates.append(x509.issue(
                request, ca.certificate, ca.key, key_usage=usage, subject_alt_names=(f"{URI_PREFIX}{role}:{name}",),
                not_before=max(at - _BACKDATED, ca.certificate.not_before),
                not_after=min(at + _LIFE, ca.certificate.not_after),
            ))  # fmt: skip
        except SMCryptoError as error:  # the request's signature, the CA's key, or a certificate that is no CA's
            raise IdentityError(f"the request of {name} cannot be certified: {error}") from error
    if signing_request.public_key == encryption_request.public_key:
        raise IdentityError("the signing and the encryption key must be two keys")
    return PeerIdentity(role, name, *certificates)


def enrol(ca: CertificateAuthority, role: Role, name: str, *, at: datetime) -> Identity:
    """A new identity with two fresh keys and their certificates."""
    keys = sm2.PrivateKey.generate(), sm2.PrivateKey.generate()
    peer = enrol_requests(ca, role, name, *requests(name, *keys), at=at)
    return Identity(role, name, peer.signing_certificate, peer.encryption_certificate, *keys)


# Files


def certificate_files(peer: PeerIdentity, roots: Sequence[x509.Certificate]) -> dict[str, bytes]:
    """An identity's certificates, and the CA's, as file name → PEM."""
    return {
        "sign.crt.pem": peer.signing_certificate.to_pem(),
        "enc.crt.pem": peer.encryption_certificate.to_pem(),
        "ca.crt.pem": b"".join(root.to_pem() for root in roots),
    }


def identity_files(identity: Identity, roots: Sequence[x509.Certificate], password: bytes | None) -> dict[str, bytes]:
    """An identity as file name → content; keys are PKCS#8 PEM, encrypted under `password` unless None."""
    keys = (identity.signing_key, identity.encryption_key)
    private = {name: key.to_pem(password) for name, key in zip(KEY_FILES, keys, strict=True)}
    return private | certificate_files(identity, roots)


def read_certificates(pem: bytes) -> tuple[x509.Certificate, ...]:
    """Every certificate of a PEM file, in order; IdentityError if there is none or one is malformed."""
    try:
        return tuple(x509.Certificate.from_der(one.to_der()) for one in x509.load_pem_certificates(pem))
    except SMCryptoError as error:
        raise IdentityError(f"a certificate cannot be read: {error}") from error


def public_identity(pem: bytes) -> PeerIdentity:
    """Whom a PEM file of two certificates, signing first, names; nothing of it is checked (`Trust.check`)."""
    found = read_certificates(pem)
    if len(found) != 2:
        raise IdentityError(f"a file holds {len(found)} certificates; an identity has two, signing and encryption")
    return _pair(*found)


def split_certificates(certificates: bytes) -> tuple[bytes, bytes]:
    """The two (DER) of `PeerIdentity.certificates`; VerificationError if it is not two DER values and nothing else."""
    # SEQUENCE with a two-byte length (X.690, 8.1.3.5): every certificate has between 256 and 65,535 bytes.
    size = 4 + int.from_bytes(certificates[2:4], "big")
    signing, encryption = certificates[:size], certificates[size:]
    for part in (signing, encryption):
        if part[:2] != b"\x30\x82" or len(part) != 4 + int.from_bytes(part[2:4], "big"):
            raise VerificationError("a registration does not hold two certificates")
    return signing, encryption


def identity_from_files(
    files: Mapping[str, bytes], password: bytes | None
) -> tuple[Identity, tuple[x509.Certificate, ...]]:
    """The reverse of `identity_files`: the identity and the roots. Keys must belong to their certificates."""
    if missing := [name for name in (*KEY_FILES, *CERTIFICATE_FILES) if name not in files]:
        raise IdentityError(f"the identity is not complete: {', '.join(missing)} missing")
    peer = public_identity(files["sign.crt.pem"] + files["enc.crt.pem"])
    keys = []
    for name, certificate in zip(KEY_FILES, (peer.signing_certificate, peer.encryption_certificate), strict=True):
        try:
            keys.append(sm2.PrivateKey.from_pem(files[name], password))
        except SMCryptoError as error:
            raise IdentityError(f"{name} cannot be opened: wrong password, or not a key file") from error
        if keys[-1].public_key != certificate.public_key:
            raise IdentityError(f"{name} is not the key of {name.replace('key', 'crt')}")
    _check_usage(peer)
    identity = Identity(peer.role, peer.name, peer.signing_certificate, peer.encryption_certificate, *keys)
    return identity, read_certificates(files["ca.crt.pem"])


def write_files(folder: Path, files: Mapping[str, bytes], *, new: bool = False) -> None:
    """Write an identity's files into `folder` (made 0700 if absent), keys 0600. new: IdentityError if one exists."""
    folder.mkdir(mode=0o700, parents=True, exist_ok=True)
    for name, content in files.items():
        try:
            write_atomically(folder / name, content, mode=0o600 if name in KEY_FILES else 0o644, new=new)
        except FileExistsError:
            raise IdentityError(f"{folder / name} exists and is not overwritten") from None


def save_identity(folder: Path, identity: Identity, roots: Sequence[x509.Certificate], password: bytes | None) -> None:
    """Write `identity_files` into `folder`; nothing is overwritten."""
    write_files(folder, identity_files(identity, roots, password), new=True)


def load_identity(folder: Path, password: bytes | None) -> tuple[Identity, tuple[x509.Certificate, ...]]:
    """Read what `save_identity` wrote; a key file that others may read is refused."""
    names = (*KEY_FILES, *CERTIFICATE_FILES)
    files = {name: read_file(folder / name, private=name in KEY_FILES) for name in names}
    try:
        return identity_from_files(files, password)
    except IdentityError as error:
        raise IdentityError(f"{folder}: {error}; give the password it has, or restore it from a backup") from error
