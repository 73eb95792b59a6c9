"""Coverage-guided fuzzing of everything that reads foreign bytes; needs the package `atheris`.

Invariant, for every reader below and any bytes whatever:

1. it returns a value or raises an SMCryptoError: no other exception, no hang;
2. what it returned is written again as exactly the bytes that were read, where
   the form has one encoding (DER containers, names, signatures of tags and lengths);
3. text made of it contains nothing that does not print.

    python fuzz/parsers.py -max_total_time=60 [CORPUS]

Without atheris the same invariant is checked with random alterations of valid
files by tests/smcrypto (test_der, test_keyfiles, test_certificates).
"""

from __future__ import annotations

import sys
from collections.abc import Callable
from datetime import datetime, timezone

if __name__ == "__main__":
    import atheris

    # At import, which leaves out the unrolled rounds that are compiled then: to instrument those takes many minutes.
    with atheris.instrument_imports(include=["smcrypto"]):
        import smcrypto.cfca
        import smcrypto.cms
        import smcrypto.diagnosis
        import smcrypto.pkcs12  # noqa: F401

from smcrypto import SMCryptoError, cfca, cms, der, diagnose, pem, pkcs12, sm2, x509
from smcrypto.x509 import Certificate, CertificateRevocationList, CertificateSigningRequest, Name


def _require(holds: bool, what: str) -> None:
    if not holds:
        raise RuntimeError(f"invariant broken: {what}")


def _der(data: bytes) -> None:
    _require(der.check(data) == data, "DER")


def _pem(data: bytes) -> None:
    for label, content in pem.decode(data):
        _require(pem.decode(pem.encode(label, content)) == [(label, content)], "PEM")


def _private_key(data: bytes) -> None:
    key = sm2.PrivateKey.from_der(data)
    _require(sm2.PrivateKey.from_der(key.to_der()) == key, "private key")


def _public_key(data: bytes) -> None:
    key = sm2.PublicKey.from_der(data)
    _require(sm2.PublicKey.from_der(key.to_der()) == key, "public key")


def _name(data: bytes) -> None:
    name = der.parse(data, Name.read)
    _require(Name(name.rdns).to_der() == data, "name")
    _require(str(name).isprintable(), "name's text")


def _certificate(data: bytes) -> None:
    certificate = Certificate.from_der(data)
    _require(certificate.to_der() == data, "certificate")
    _require(repr(certificate).isprintable(), "certificate's text")
    _require(all(name.isprintable() for name in certificate.subject_alt_names), "alternative names")
    x509.verify_chain(certificate, roots=[certificate], at=certificate.not_before)


def _request(data: bytes) -> None:
    request = CertificateSigningRequest.from_der(data)
    _require(request.to_der() == data and repr(request).isprintable(), "request")
    request.verify()


def _crl(data: bytes) -> None:
    crl = CertificateRevocationList.from_der(data)
    _require(crl.to_der() == data and repr(crl).isprintable(), "revocation list")


_KEY = sm2.PrivateKey.from_int(0x1234567)
_AT = datetime(2026, 6, 1, tzinfo=timezone.utc)
_CERTIFICATE = x509.self_signed(_KEY, subject={"CN": "fuzz"}, not_before=_AT, not_after=_AT,
                                serial_number=1, key_usage=())  # fmt: skip


def _cms(data: bytes) -> None:
    for read in (
        lambda: cms.verify(data, roots=[_CERTIFICATE], at=_AT),
        lambda: cms.decrypt(data, _KEY, _CERTIFICATE),
        lambda: cms.decrypt_and_verify(data, _KEY, _CERTIFICATE, roots=[_CERTIFICATE], at=_AT),
    ):
        try:
            read()
            return
        except SMCryptoError as error:
            refusal = error
    raise refusal


def _pkcs12(data: bytes) -> None:
    pkcs12.load(data, b"password")


def _pkcs12_inside(data: bytes) -> None:
    """What stands behind the MAC, which no change by chance would pass."""
    password, salt = "password".encode("utf-16-be") + b"\0\0", b"salt"
    name = "1.2.156.10197.1.401"
    tag = pkcs12._mac(name, password, salt, 1, data)
    algorithm = der.sequence(der.oid(name))
    mac = der.sequence(der.sequence(algorithm, der.octet_string(tag)), der.octet_string(salt))
    content = der.sequence(der.oid("1.2.840.113549.1.7.1"), der.explicit(0, der.octet_string(data)))
    pkcs12.load(der.sequence(der.integer(3), content, mac), b"password")


def _enveloped_key(data: bytes) -> None:
    key = sm2.PrivateKey.from_enveloped(data, _KEY)
    _require(sm2.PrivateKey.from_enveloped(key.to_enveloped(_KEY.public_key), _KEY) == key, "enveloped key")


def _cfca_key(data: bytes) -> None:
    cfca.open_key(data, _KEY)


def _diagnose(data: bytes) -> None:
    _require("\0" not in str(diagnose(data, key=_KEY, message=b"m")), "diagnosis")


READERS: tuple[Callable[[bytes], None], ...] = (
    _der, _pem, _private_key, _public_key, _name, _certificate, _request, _crl, _cms, _pkcs12,
    _pkcs12_inside, _enveloped_key, _cfca_key, _diagnose,
)  # fmt: skip


def check(data: bytes) -> None:
    """One input: its first byte chooses the reader."""
    if not data:
        return
    try:
        READERS[data[0] % len(READERS)](data[1:])
    except SMCryptoError:
        return


if __name__ == "__main__":
    atheris.Setup(sys.argv, check)
    atheris.Fuzz()
