"""Is a certificate to be trusted? Path building and validation, RFC 5280, 6.1; RFC 4158.

`verify_chain` looks for a path from the leaf to a root: at each step every
certificate whose subject is the current issuer is tried, roots first, so that
several intermediates, cross-signed ones and ones of the same name all work.
The search is bounded, whatever the pile of intermediates looks like.

Not here: name constraints and policies. A CA certificate with name constraints, and any
certificate with a critical extension that is not in `_PROCESSED`, is refused. Policies may be
critical: the user's set is "any-policy" and none is required (6.1.1 c, e), so that none can fail.
"""

from __future__ import annotations

from collections.abc import Iterable
from datetime import datetime
from typing import Final, Literal

from smcrypto import sm2
from smcrypto.errors import (
    CertificateAlgorithmError,
    CertificateError,
    CertificateExpiredError,
    CertificateMalformedError,
    CertificateNotYetValidError,
    CertificateUnknownIssuerError,
    CertificateUsageError,
    InvalidOption,
)
from smcrypto.inputs import BytesLike, as_bytes, require_type
from smcrypto.x509 import extensions as ext
from smcrypto.x509.certificate import AnyCertificate, Certificate, require_usage
from smcrypto.x509.names import Name
from smcrypto.x509.revocation import CertificateRevocationList, check_revocation
from smcrypto.x509.signed import Signed, instant

__all__ = ["MAX_PATH", "require_ca", "verify_chain"]

MAX_PATH: Final = 10
"""The most certificates in a path, leaf and root included."""
_MAX_STEPS: Final = 1000  # candidates looked at in one search
_MAX_SIGNATURES: Final = 100  # signatures of certificates and revocation lists verified in one search

# Extensions that are processed here or bind nobody but the subject, and so may be critical.
_PROCESSED: Final = (
    ext.BASIC_CONSTRAINTS, ext.KEY_USAGE, ext.EXTENDED_KEY_USAGE, ext.SUBJECT_ALT_NAME, ext.SUBJECT_KEY_IDENTIFIER,
    ext.AUTHORITY_KEY_IDENTIFIER, ext.CERTIFICATE_POLICIES,
)  # fmt: skip


def verify_chain(
    leaf: AnyCertificate,
    *,
    intermediates: Iterable[AnyCertificate] = (),
    roots: Iterable[AnyCertificate],
    at: datetime,
    uid: BytesLike = sm2.DEFAULT_UID,
    extended_key_usage: str | Iterable[str] | None = None,
    key_usage: str | Iterable[str] | None = None,
    crls: Iterable[CertificateRevocationList] = (),
    revocation: Literal["leaf", "every"] = "leaf",
    strict: bool = False,
) -> tuple[Certificate, ...]:
    """The path from `leaf` to one of `roots`, both included; CertificateError, saying why, if there is none.

    Certificates of other algorithms (`ForeignCertificate`) may be among all of these; a path through one of them is a
    CertificateAlgorithmError. Others are CertificateExpiredError, CertificateNotYetValidError,
    CertificateUnknownIssuerError, CertificateUsageError, CertificateSignatureError and CertificateRevokedError.

    at: the moment, aware. uid: of every signature in the path.
    extended_key_usage: purposes that the leaf, and every CA that restricts them, must allow.
    key_usage: usages that the leaf must allow. Certificates without these extensions allow everything.
    crls: where any are given, the leaf must be covered by a fresh one of its issuer, CAs are checked against
    those there are, and with `revocation="every"` each certificate below the root must be covered.
    strict: a certificate of the path that has `oddities` is a CertificateMalformedError.
    """
    if revocation not in ("leaf", "every"):
        raise InvalidOption(f"revocation must be 'leaf' or 'every', not {revocation!r}")
    intermediates, roots, crls = tuple(intermediates), tuple(roots), tuple(crls)
    for certificate, name in ((leaf, "leaf"), *((c, "each of intermediates") for c in intermediates),
                              *((c, "each of roots") for c in roots)):  # fmt: skip
        require_type(certificate, AnyCertificate, name)
    if not isinstance(leaf, Certificate):
        raise CertificateAlgorithmError(f"the key of {leaf.subject or 'nobody'} is {leaf.algorithm}, not SM2")
    for crl in crls:
        require_type(crl, CertificateRevocationList, "each of crls")
    search = _Search(intermediates, roots, instant(at, "at"), as_bytes(uid, "uid"), _names(extended_key_usage), crls,
                     revocation == "every", strict)  # fmt: skip
    usages = ext.usage_names(_names(key_usage))
    if leaf.key_usage is not None and not usages <= leaf.key_usage:
        raise CertificateUsageError(f"{leaf.subject} may not be used for {', '.join(sorted(usages - leaf.key_usage))}")
    search.require_fit(leaf)
    try:
        path = search.extend((leaf,))
    except _GivenUp as error:
        raise CertificateError(str(error)) from None
    if path is None:
        raise search.refusal[1]
    return path


def _names(names: str | Iterable[str] | None) -> tuple[str, ...]:
    if names is None:
        return ()
    return ext.listed((names,) if isinstance(names, str) else names)


class _GivenUp(Exception):
    """A limit of the search was reached: no other path is tried."""


class _Search:
    """One depth-first search; keeps the refusal that came furthest, which is the one worth telling."""

    def __init__(
        self, intermediates: tuple[AnyCertificate, ...], roots: tuple[AnyCertificate, ...], at: datetime, uid: bytes,
        purposes: tuple[str, ...], crls: tuple[CertificateRevocationList, ...], every: bool, strict: bool,
    ) -> None:  # fmt: skip
        self.roots = frozenset(roots)
        self.issuers: dict[Name, list[AnyCertificate]] = {}
        for certificate in dict.fromkeys(roots + intermediates):
            self.issuers.setdefault(certificate.subject, []).append(certificate)
        self.at = at
        self.uid = uid
        self.purposes = frozenset(map(ext.purpose_name, purposes))
        self.crls = crls
        self.every = every
        self.strict = strict
        self.steps = 0
        self.signatures: dict[tuple[Signed, Certificate], CertificateError | None] = {}
        self.refusal: tuple[float, CertificateError] = (0, CertificateUnknownIssuerError("no path was found"))

    def extend(self, path: tuple[Certificate, ...]) -> tuple[Certificate, ...] | None:
        """A path to a root that begins with `path`; None if there is none."""
        current = path[-1]
        if current in self.roots:
            try:
                if self.crls or self.every:  # 6.3: does a revocation list of one of its issuers speak against it?
                    check_revocation(path, self.crls, self.at, self.require_signature, every=self.every)
            except CertificateError as error:
                self.refused(path, error)
                return None
            return path
        if len(path) >= MAX_PATH:
            self.refused(path, CertificateError(f"the path is longer than {MAX_PATH} certificates"))
            return None
        # A second one with the same key and name is a detour or a loop (RFC 4158, 2.4.2 and 5.2).
        holders = [(certificate.public_key, certificate.subject) for certificate in path]
        found = False
        for issuer in self.issuers.get(current.issuer, ()):
            self.steps += 1
            if self.steps > _MAX_STEPS:
                raise _GivenUp(f"no path was found in {_MAX_STEPS} steps")
            if not isinstance(issuer, Certificate):
                # Says less than what was wrong with an issuer whose signature could be verified.
                foreign = f"{issuer.subject}, which may have issued {current.subject}, has a key of {issuer.algorithm}"
                self.refused(path, CertificateAlgorithmError(f"{foreign}, not SM2"), less=0.25)
                continue
            if not _may_have_issued(issuer, current) or (issuer.public_key, issuer.subject) in holders:
                continue
            found = True
            try:
                self.require_fit(issuer)
                _require_issuer(issuer, path)
                self.require_signature(current, issuer)
            except CertificateError as error:
                self.refused(path, error)
                continue
            whole = self.extend((*path, issuer))
            if whole is not None:
                return whole
        if not found:
            trusted = "trusted root" if current.subject == current.issuer else "known issuer"
            # Says less than what was wrong with an issuer that is there.
            missing = CertificateUnknownIssuerError(f"no {trusted} {current.issuer} for {current.subject}")
            self.refused(path, missing, less=0.5)
        return None

    def refused(self, path: tuple[Certificate, ...], error: CertificateError, *, less: float = 0) -> None:
        if len(path) - less > self.refusal[0]:
            self.refusal = (len(path) - less, error)

    def require_fit(self, certificate: Certificate) -> None:
        """What holds for every certificate of a path: validity (6.1.3 a 2), extensions (6.1.4 o), purposes."""
        if self.at < certificate.not_before:
            raise CertificateNotYetValidError(f"{certificate.subject} is not valid before {certificate.not_before}")
        if self.at > certificate.not_after:
            raise CertificateExpiredError(f"{certificate.subject} expired at {certificate.not_after}")
        if self.strict and certificate.oddities:
            raise CertificateMalformedError(f"{certificate.subject} is odd: {certificate.oddities[0]}")
        oid = next((e.oid for e in certificate.extensions if e.critical and e.oid not in _PROCESSED), None)
        if oid is not None:
            raise CertificateError(f"{certificate.subject} has the critical extension {oid}, which is not understood")
        allowed = certificate.extended_key_usage
        missing = self.purposes.difference(allowed or ())
        if allowed is not None and "anyExtendedKeyUsage" not in allowed and missing:
            raise CertificateUsageError(f"{certificate.subject} is not for {', '.join(sorted(missing))}")

    def require_signature(self, signed: Certificate | CertificateRevocationList, issuer: Certificate) -> None:
        pair = (signed, issuer)
        if pair not in self.signatures:
            if len(self.signatures) >= _MAX_SIGNATURES:
                raise _GivenUp(f"no path was found with {_MAX_SIGNATURES} signatures")
            verify = signed.verify_signature if isinstance(signed, Certificate) else signed.verify
            try:
                verify(issuer, uid=self.uid)
                self.signatures[pair] = None
            except CertificateError as error:
                self.signatures[pair] = error
        if (failure := self.signatures[pair]) is not None:
            raise failure


def _may_have_issued(issuer: Certificate, certificate: Certificate) -> bool:
    """The names chain; do the key identifiers, where both are there, and the serial number, where it is named?"""
    authority = certificate.authority_key_identifier or ext.AuthorityKeyIdentifier()
    wanted, found = authority.key_identifier, issuer.subject_key_identifier
    same_key = wanted is None or found is None or wanted == found
    return same_key and authority.serial_number in (None, issuer.serial_number)


def require_ca(certificate: Certificate) -> None:
    """CertificateUsageError unless `certificate` may sign others: RFC 5280, 6.1.4 k and n."""
    if not certificate.is_ca:
        raise CertificateUsageError(f"{certificate.subject} is not a CA")
    require_usage(certificate, "may not sign certificates (no keyCertSign)", "keyCertSign")


def _require_issuer(issuer: Certificate, path: tuple[Certificate, ...]) -> None:
    """May `issuer` have issued the last certificate of `path`? RFC 5280, 6.1.4 k, l, m, n."""
    require_ca(issuer)
    # 4.2.1.9: intermediates that follow, self-issued ones and the leaf not counted.
    followers = sum(1 for certificate in path[1:] if certificate.subject != certificate.issuer)
    allowed = issuer.basic_constraints.path_length if issuer.basic_constraints else None
    if allowed is not None and followers > allowed:
        raise CertificateUsageError(f"{issuer.subject} allows {allowed} intermediates, not {followers}")
    if any(extension.oid == ext.NAME_CONSTRAINTS for extension in issuer.extensions):
        raise CertificateError(f"{issuer.subject} has name constraints, which are not supported")
