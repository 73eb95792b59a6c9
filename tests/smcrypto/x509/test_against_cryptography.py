"""The package `cryptography` reads our certificates, requests and lists, and finds in them what we find."""

from __future__ import annotations

from datetime import timedelta
from types import SimpleNamespace
from typing import Any

import pytest

from smcrypto import sm2, x509
from vectors_json import load
from x509_authority import BEGIN, END, NOW, root

theirs = pytest.importorskip("cryptography.x509")
OID = theirs.oid

SUBJECT = {"C": "CN", "O": "舰队, Ltd.", "CN": "robot+1"}
NAMES = (
    "DNS:robot.example",
    "URI:urn:x:y",
    "email:a@example.com",
    "IP:192.0.2.1",
    "IP:2001:db8::1",
    "dirName:CN=a,O=b",
)
ROOT = root("root", path_length=1, subject_alt_names=NAMES)
KEY = sm2.PrivateKey.generate()
CSR = x509.CertificateSigningRequest.create(KEY, subject=SUBJECT, subject_alt_names=NAMES)
LEAF = x509.issue(
    CSR, ROOT.certificate, ROOT.key, not_before=BEGIN, not_after=END, subject_alt_names=NAMES,
    extended_key_usage=("serverAuth", "1.2.3.4"), key_usage=("digitalSignature", "keyAgreement", "decipherOnly"),
)  # fmt: skip


def value(certificate: Any, oid: Any) -> Any:
    return certificate.extensions.get_extension_for_oid(oid).value


def test_the_plain_fields() -> None:
    c = theirs.load_der_x509_certificate(LEAF.to_der())
    assert c.version.name == "v3" and c.serial_number == LEAF.serial_number
    assert c.signature_algorithm_oid.dotted_string == "1.2.156.10197.1.501"
    assert (c.not_valid_before_utc, c.not_valid_after_utc) == (LEAF.not_before, LEAF.not_after)
    assert c.subject.rfc4514_string() == str(LEAF.subject) == "CN=robot\\+1,O=舰队\\, Ltd.,C=CN"
    assert c.issuer.rfc4514_string() == str(LEAF.issuer)
    assert (c.signature, c.tbs_certificate_bytes) == (LEAF.signature, LEAF.tbs_certificate)
    assert [(e.oid.dotted_string, e.critical) for e in c.extensions] == [(e.oid, e.critical) for e in LEAF.extensions]


def test_the_extensions() -> None:
    c, r = (theirs.load_der_x509_certificate(x.to_der()) for x in (LEAF, ROOT.certificate))
    names = value(c, OID.ExtensionOID.SUBJECT_ALTERNATIVE_NAME)
    assert names.get_values_for_type(theirs.DNSName) == ["robot.example"]
    assert names.get_values_for_type(theirs.UniformResourceIdentifier) == ["urn:x:y"]
    assert names.get_values_for_type(theirs.RFC822Name) == ["a@example.com"]
    assert [str(a) for a in names.get_values_for_type(theirs.IPAddress)] == ["192.0.2.1", "2001:db8::1"]
    assert [n.rfc4514_string() for n in names.get_values_for_type(theirs.DirectoryName)] == ["CN=a,O=b"]
    purposes = value(c, OID.ExtensionOID.EXTENDED_KEY_USAGE)
    assert [p.dotted_string for p in purposes] == ["1.3.6.1.5.5.7.3.1", "1.2.3.4"]
    usage = value(c, OID.ExtensionOID.KEY_USAGE)
    assert usage.digital_signature and usage.key_agreement and usage.decipher_only
    assert not (usage.key_encipherment or usage.key_cert_sign or usage.encipher_only or usage.crl_sign)
    assert value(r, OID.ExtensionOID.BASIC_CONSTRAINTS) == theirs.BasicConstraints(True, 1)
    assert value(c, OID.ExtensionOID.BASIC_CONSTRAINTS) == theirs.BasicConstraints(False, None)
    own = value(r, OID.ExtensionOID.SUBJECT_KEY_IDENTIFIER).digest
    assert own == value(c, OID.ExtensionOID.AUTHORITY_KEY_IDENTIFIER).key_identifier
    assert own == ROOT.certificate.subject_key_identifier


def test_the_request() -> None:
    csr = theirs.load_der_x509_csr(CSR.to_der())
    assert csr.subject.rfc4514_string() == str(CSR.subject)
    assert csr.tbs_certrequest_bytes in CSR.to_der()
    names = value(csr, OID.ExtensionOID.SUBJECT_ALTERNATIVE_NAME)
    assert names.get_values_for_type(theirs.DNSName) == ["robot.example"]


def test_the_revocation_list() -> None:
    crl = ROOT.crl(x509.RevokedCertificate(LEAF.serial_number, NOW, "keyCompromise"), x509.RevokedCertificate(9, NOW))
    read = theirs.load_der_x509_crl(crl.to_der())
    assert read.issuer.rfc4514_string() == str(crl.issuer)
    assert (read.last_update_utc, read.next_update_utc) == (NOW, NOW + timedelta(days=7))
    assert [e.serial_number for e in read] == [LEAF.serial_number, 9]
    entry = read.get_revoked_certificate_by_serial_number(LEAF.serial_number)
    assert entry.revocation_date_utc == NOW
    assert value(entry, OID.CRLEntryExtensionOID.CRL_REASON).reason is theirs.ReasonFlags.key_compromise
    assert value(read, OID.ExtensionOID.CRL_NUMBER).crl_number == crl.number


@pytest.mark.parametrize("v", load("third_party/x509.json", "certificates", kind="certificate"))
def test_certificates_of_other_projects_say_the_same(v: SimpleNamespace) -> None:
    ours, read = x509.Certificate.from_der(v.der), theirs.load_der_x509_certificate(v.der)
    assert ours.serial_number == read.serial_number
    assert (ours.not_before, ours.not_after) == (read.not_valid_before_utc, read.not_valid_after_utc)
    assert [(e.oid, e.critical) for e in ours.extensions] == [
        (e.oid.dotted_string, e.critical) for e in read.extensions
    ]
    for name, other in ((ours.subject, read.subject), (ours.issuer, read.issuer)):
        assert [(a.oid, a.text) for a in name.attributes] == [(a.oid.dotted_string, a.value) for a in other]
