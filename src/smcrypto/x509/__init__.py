"""X.509 with SM2-with-SM3: certificates, requests, chains, revocation (RFC 5280, GM/T 0015, RFC 8998).

`verify_chain` says whether a certificate is to be trusted, its `verify_hostname` for which hosts; everything else
reads and writes. Reading is strict DER but for the `oddities` of certificates; a signature covers the bytes received.
Failures are CertificateError; its subclasses say which.
"""

from smcrypto.errors import (
    CertificateAlgorithmError,
    CertificateExpiredError,
    CertificateHostnameError,
    CertificateMalformedError,
    CertificateNotYetValidError,
    CertificateRevokedError,
    CertificateSignatureError,
    CertificateUnknownIssuerError,
    CertificateUsageError,
)
from smcrypto.x509.certificate import (
    AnyCertificate,
    Certificate,
    ForeignCertificate,
    load_der_certificate,
    load_pem_certificates,
)
from smcrypto.x509.chain import verify_chain
from smcrypto.x509.extensions import AuthorityKeyIdentifier, BasicConstraints, Extension
from smcrypto.x509.issuing import CA_KEY_USAGE, ENCRYPTION_KEY_USAGE, SIGNING_KEY_USAGE, issue, self_signed
from smcrypto.x509.names import Attribute, Name
from smcrypto.x509.request import CertificateSigningRequest, RequestAttribute
from smcrypto.x509.revocation import CertificateRevocationList, RevokedCertificate

__all__ = [
    "CA_KEY_USAGE", "ENCRYPTION_KEY_USAGE", "SIGNING_KEY_USAGE", "AnyCertificate", "Attribute",
    "AuthorityKeyIdentifier", "BasicConstraints", "Certificate", "CertificateAlgorithmError",
    "CertificateExpiredError", "CertificateHostnameError", "CertificateMalformedError",
    "CertificateNotYetValidError", "CertificateRevocationList", "CertificateRevokedError",
    "CertificateSignatureError", "CertificateSigningRequest", "CertificateUnknownIssuerError",
    "CertificateUsageError", "Extension", "ForeignCertificate", "Name", "RequestAttribute", "RevokedCertificate",
    "issue", "load_der_certificate", "load_pem_certificates", "self_signed", "verify_chain",
]  # fmt: skip
