"""X.509 with SM2-with-SM3: certificates, requests, chains, revocation (RFC 5280, GM/T 0015, RFC 8998).

`verify_chain` says whether a certificate is to be trusted; everything else
only reads and writes. Reading is strict DER; a signature covers the bytes
received. Failures are CertificateError.
"""

from smcrypto.x509.certificate import Certificate, load_pem_certificates
from smcrypto.x509.chain import verify_chain
from smcrypto.x509.extensions import AuthorityKeyIdentifier, BasicConstraints, Extension
from smcrypto.x509.issuing import (
    CA_KEY_USAGE,
    ENCRYPTION_KEY_USAGE,
    SIGNING_KEY_USAGE,
    issue,
    self_signed,
)
from smcrypto.x509.names import Attribute, Name
from smcrypto.x509.request import CertificateSigningRequest, RequestAttribute
from smcrypto.x509.revocation import CertificateRevocationList, RevokedCertificate
from smcrypto.x509.signed import CertificateRevokedError, CertificateSignatureError

__all__ = [
    "CA_KEY_USAGE",
    "ENCRYPTION_KEY_USAGE",
    "SIGNING_KEY_USAGE",
    "Attribute",
    "AuthorityKeyIdentifier",
    "BasicConstraints",
    "Certificate",
    "CertificateRevocationList",
    "CertificateRevokedError",
    "CertificateSignatureError",
    "CertificateSigningRequest",
    "Extension",
    "Name",
    "RequestAttribute",
    "RevokedCertificate",
    "issue",
    "load_pem_certificates",
    "self_signed",
    "verify_chain",
]
