"""Certificates whose keys are of other algorithms: named, kept, and never judged."""

from __future__ import annotations

import pickle
from collections.abc import Callable
from pathlib import Path

import pytest

from smcrypto import CertificateError, der, sm2, x509
from smcrypto.x509 import Certificate, CertificateAlgorithmError, CertificateMalformedError, ForeignCertificate, Name
from x509_authority import BEGIN, END, NOW, RSA, SHA256_RSA, Holder, foreign_der, root

ROOT = root("root")
LEAF = ROOT.issue("leaf")

EC = "1.2.840.10045.2.1"
EXPLICIT = der.sequence(der.integer(1), der.sequence(der.oid("1.2.840.10045.1.1"), der.integer(23)))


def foreign(subject: str = "foreign", key_algorithm: bytes = RSA, issuer: str = "foreign") -> ForeignCertificate:
    return ForeignCertificate.from_der(foreign_der(subject, key_algorithm, issuer))


ALGORITHMS = {
    "RSA": RSA,
    "RSA-PSS": der.sequence(der.oid("1.2.840.113549.1.1.10")),
    "DSA": der.sequence(der.oid("1.2.840.10040.4.1"), der.sequence(der.integer(23))),
    "Ed25519": der.sequence(der.oid("1.3.101.112")),
    "Ed448": der.sequence(der.oid("1.3.101.113")),
    "ML-DSA-65": der.sequence(der.oid("2.16.840.1.101.3.4.3.18")),
    "EC P-256": der.sequence(der.oid(EC), der.oid("1.2.840.10045.3.1.7")),
    "EC P-384": der.sequence(der.oid(EC), der.oid("1.3.132.0.34")),
    "EC 1.3.36.3.3.2.8.1.1.7": der.sequence(der.oid(EC), der.oid("1.3.36.3.3.2.8.1.1.7")),
    "EC with explicit parameters": der.sequence(der.oid(EC), EXPLICIT),
    "1.2.3.4": der.sequence(der.oid("1.2.3.4")),
}


@pytest.mark.parametrize("name", ALGORITHMS)
def test_it_is_named_and_kept_as_it_is(name: str) -> None:
    data = foreign_der("it", ALGORITHMS[name])
    with pytest.raises(CertificateAlgorithmError, match=f"the key of CN=it is {name}, not SM2"):
        Certificate.from_der(data)
    read = x509.load_der_certificate(bytearray(data))
    assert isinstance(read, ForeignCertificate) and isinstance(read, x509.AnyCertificate)
    assert read.algorithm == name and read.to_der() == data
    assert (str(read.subject), str(read.issuer), read.serial_number) == ("CN=it", "CN=foreign", 7)
    assert (read.version, read.not_before, read.not_after) == (3, BEGIN, END)
    assert repr(read) == "<ForeignCertificate CN=it, serial 7, issued by CN=foreign>"
    assert pickle.loads(pickle.dumps(read)) == read == ForeignCertificate.from_pem(read.to_pem())


def test_a_bundle_may_hold_both() -> None:
    bundle = foreign().to_pem() + LEAF.certificate.to_pem() + foreign("b").to_pem()
    assert x509.load_pem_certificates(bundle) == (foreign(), LEAF.certificate, foreign("b"))
    assert LEAF.certificate.algorithm == "SM2"


def test_an_sm2_certificate_is_not_foreign() -> None:
    with pytest.raises(CertificateMalformedError, match="its key is of SM2"):
        ForeignCertificate.from_der(LEAF.certificate.to_der())
    assert type(x509.load_der_certificate(LEAF.certificate.to_der())) is Certificate


def test_a_malformed_one_is_refused_all_the_same() -> None:
    off_curve = LEAF.certificate.to_der().replace(LEAF.certificate.public_key.to_bytes(), b"\4" + bytes(63) + b"\1")
    for data in (b"", b"\x30\x00", foreign_der()[:-1], foreign_der() + b"\0", off_curve,
                 foreign_der(key_algorithm=der.sequence()), foreign_der(key_algorithm=der.sequence(der.oid(EC))),
                 foreign_der(key_algorithm=der.sequence(der.oid(EC), der.null()))):  # fmt: skip
        with pytest.raises(CertificateError, match="not a valid certificate"):
            x509.load_der_certificate(data)


def test_foreign_neighbours_do_no_harm_to_a_path() -> None:
    path = x509.verify_chain(
        LEAF.certificate, intermediates=[foreign("root")], roots=[foreign("root"), foreign(), ROOT.certificate], at=NOW
    )
    assert path == (LEAF.certificate, ROOT.certificate)


def test_a_path_through_a_foreign_one_names_its_algorithm() -> None:
    for given in ({"roots": [foreign("root")]}, {"roots": [], "intermediates": [foreign("root")]}):
        with pytest.raises(CertificateAlgorithmError, match="CN=root, which may have issued CN=leaf, has a key of RSA"):
            x509.verify_chain(LEAF.certificate, at=NOW, **given)  # type: ignore[arg-type]
    with pytest.raises(CertificateAlgorithmError, match="the key of CN=foreign is RSA, not SM2"):
        x509.verify_chain(foreign(), roots=[foreign()], at=NOW)


def test_what_was_wrong_with_the_right_issuer_is_told_first() -> None:
    impostor = root("root")
    trusted = Holder(impostor.key, impostor.certificate)
    late = ROOT.issue("late", not_before=NOW + (END - NOW) / 2)
    with pytest.raises(x509.CertificateNotYetValidError):
        x509.verify_chain(late.certificate, roots=[foreign("root"), ROOT.certificate], at=NOW)
    old = root("root", key=ROOT.key, not_after=NOW - (NOW - BEGIN) / 2)
    with pytest.raises(x509.CertificateExpiredError):
        x509.verify_chain(LEAF.certificate, roots=[foreign("root"), old.certificate], at=NOW)
    with pytest.raises(CertificateAlgorithmError):
        x509.verify_chain(LEAF.certificate, roots=[foreign("root"), trusted.certificate], at=NOW)


def test_foreign_certificates_count_as_steps_of_the_search() -> None:
    many = [foreign("root", der.sequence(der.oid(f"1.2.3.{i}"))) for i in range(1001)]
    with pytest.raises(CertificateError, match="no path was found in 1000 steps"):
        x509.verify_chain(LEAF.certificate, roots=many, at=NOW)


def test_certificates_of_openssl(openssl: Callable[..., bytes], tmp_path: Path) -> None:
    for kind, options in {"RSA": ["-newkey", "rsa:2048"], "EC P-384": ["-newkey", "ec:secp384r1"],
                          "Ed25519": ["-newkey", "ed25519"]}.items():  # fmt: skip
        if kind.startswith("EC"):
            options = ["-newkey", "ec", "-pkeyopt", "ec_paramgen_curve:P-384"]
        made = openssl("req", "-x509", *options, "-nodes", "-keyout", tmp_path / "key", "-subj", "/C=CN/CN=other",
                       "-days", "9", ok=None)  # fmt: skip
        (read,) = x509.load_pem_certificates(made)
        assert isinstance(read, ForeignCertificate) and read.algorithm == kind
        assert str(read.subject) == "CN=other,C=CN"


def test_the_bundle_of_the_system() -> None:
    path = Path("/etc/ssl/certs/ca-certificates.crt")
    if not path.exists():
        pytest.skip("no CA bundle on this machine")
    found = x509.load_pem_certificates(path.read_bytes())
    assert len(found) > 20 and {"RSA", "EC P-384"} <= {one.algorithm for one in found}


def test_an_sm2_certificate_that_an_rsa_ca_signed() -> None:
    """Its key is of SM2, so it is a Certificate; who signed it is a matter of the path."""
    tbs = der.sequence(
        der.explicit(0, der.integer(2)), der.integer(7), SHA256_RSA, Name.build({"CN": "root"}).to_der(),
        der.sequence(der.time(BEGIN), der.time(END)), Name.build({"CN": "x"}).to_der(),
        sm2.PrivateKey.from_int(7).public_key.to_der(),
    )  # fmt: skip
    certificate = x509.load_der_certificate(der.sequence(tbs, SHA256_RSA, der.bit_string(b"signature")))
    assert isinstance(certificate, Certificate)
    with pytest.raises(CertificateAlgorithmError, match="not signed with SM2-with-SM3"):
        certificate.verify_signature(ROOT.certificate)
    with pytest.raises(CertificateAlgorithmError, match="has a key of RSA"):
        x509.verify_chain(certificate, roots=[foreign("root")], at=NOW)
