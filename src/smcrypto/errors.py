"""Every failure smcrypto reports, named by what the caller can do about it.

All derive from SMCryptoError; those where the given input is at fault are
ValueErrors as well. A value of the wrong *type* is TypeError, as everywhere
in Python. Checks that touch secrets give one undetailed failure: a wrong tag,
a malformed ciphertext and a tampered one are not told apart.
"""

from __future__ import annotations

__all__ = [
    "AlreadyFinalized", "CertificateAlgorithmError", "CertificateError", "CertificateExpiredError",
    "CertificateHostnameError", "CertificateMalformedError", "CertificateNotYetValidError",
    "CertificateRevokedError", "CertificateSignatureError", "CertificateUnknownIssuerError",
    "CertificateUsageError", "ConfirmationError", "InvalidCiphertext", "InvalidEncoding", "InvalidKey",
    "InvalidLength", "InvalidOption", "InvalidPadding", "InvalidSignature", "InvalidTag", "MissingDependency",
    "OutOfOrder", "SMCryptoError",
]  # fmt: skip


class SMCryptoError(Exception):
    """Base of every error of this library."""


class InvalidLength(SMCryptoError, ValueError):
    """A length is outside what the algorithm takes: IV, nonce, digest, data, uid, output."""


class InvalidOption(SMCryptoError, ValueError):
    """An option has a value that does not exist (`encoding="hex"`, `padding="none"`)."""


class InvalidKey(SMCryptoError, ValueError):
    """A key is not one: wrong length, out of range, off the curve, unreadable, wrong password."""


class InvalidEncoding(SMCryptoError, ValueError):
    """Bytes are not the canonical DER, or not the PEM, that was expected."""


class InvalidSignature(SMCryptoError, ValueError):
    """The signature does not hold for this message, key and uid, or is malformed."""


class InvalidCiphertext(SMCryptoError, ValueError):
    """An SM2 ciphertext was malformed, altered, or made for another key."""


class InvalidTag(SMCryptoError, ValueError):
    """An authenticated ciphertext was altered, truncated, or made with another key, nonce or data."""


class InvalidPadding(SMCryptoError, ValueError):
    """A padded ciphertext did not decrypt to well-formed padding."""


class ConfirmationError(SMCryptoError, ValueError):
    """The peer of a key exchange did not arrive at the same key."""


class CertificateError(SMCryptoError, ValueError):
    """A certificate, request or revocation list is malformed, or is not to be trusted; the text says why."""


class CertificateMalformedError(CertificateError):
    """A field of a certificate, request or revocation list is not well formed, or, to a strict judge, odd."""


class CertificateAlgorithmError(CertificateError):
    """A certificate has a key, or a signature, of another algorithm than SM2; the text names it."""


class CertificateExpiredError(CertificateError):
    """The moment lies after a certificate's last second."""


class CertificateNotYetValidError(CertificateError):
    """The moment lies before a certificate's first second."""


class CertificateUnknownIssuerError(CertificateError):
    """No path leads to a trusted root: a certificate's issuer is not among those given, or the root is not trusted."""


class CertificateUsageError(CertificateError):
    """A certificate's basic constraints, key usage or extended key usage do not allow what it is used for."""


class CertificateHostnameError(CertificateError):
    """A certificate is not for this host name or IP address."""


class CertificateSignatureError(CertificateError, InvalidSignature):
    """The signature of a certificate, request or revocation list does not hold."""


class CertificateRevokedError(CertificateError):
    """A revocation list of its issuer names the certificate."""


class AlreadyFinalized(SMCryptoError):
    """The object was finalized and takes no more data."""


class OutOfOrder(SMCryptoError):
    """The steps of a protocol were called in an order it does not have."""


class MissingDependency(SMCryptoError):
    """Reading this needs an optional package that is not installed; the text names it."""
