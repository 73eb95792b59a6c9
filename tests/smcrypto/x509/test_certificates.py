"""Certificates and requests: what is written, what is read back, by us and by openssl, and what is refused."""

from __future__ import annotations

import dataclasses
import pickle
from collections.abc import Callable
from datetime import datetime, timedelta, timezone
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from der_variants import overfull, unchecked
from smcrypto import CertificateError, InvalidKey, InvalidLength, InvalidOption, SMCryptoError, der, pem, sm2, sm3, x509
from smcrypto.x509 import Certificate, CertificateSigningRequest, Extension, Name
from vectors_json import load
from x509_authority import BEGIN, END, NOW, Holder, root

UTC = timezone.utc

ROOT = root("root")
KEY = sm2.PrivateKey.generate()
CSR = CertificateSigningRequest.create(
    KEY,
    subject={"C": "CN", "O": "舰队", "CN": "robot_1"},
    subject_alt_names=("URI:urn:rosbridge-eth:robot:robot_1", "DNS:robot.example"),
    key_usage=("digitalSignature",),
    extended_key_usage=("clientAuth", "1.2.3.4"),
)
NAMES = (
    "URI:urn:rosbridge-eth:robot:robot_1", "DNS:*.example.com", "email:a@example.com", "IP:192.0.2.1", "IP:2001:db8::1",
    "dirName:CN=a\\,b,O=c",
)  # fmt: skip
TIMES = {"not_before": BEGIN, "not_after": END}


def issue(**options: Any) -> Certificate:
    return x509.issue(CSR, ROOT.certificate, ROOT.key, **(TIMES | options))


CERTIFICATE = issue(subject_alt_names=NAMES, extended_key_usage=("serverAuth", "1.2.3.4"))


# --- what a certificate says ---


def test_a_certificate_says_what_was_put_in() -> None:
    c = Certificate.from_pem(b"some text\n" + KEY.to_pem() + CERTIFICATE.to_pem().replace(b"\n", b"\r\n"))
    assert c == CERTIFICATE == Certificate.from_der(bytearray(CERTIFICATE.to_der())) and hash(c) == hash(CERTIFICATE)
    assert c != CERTIFICATE.to_der() and c != ROOT.certificate
    assert c.version == 3
    assert str(c.subject) == "CN=robot_1,O=舰队,C=CN" and str(c.issuer) == "CN=root"
    assert (c.not_before, c.not_after) == (BEGIN, END) and c.not_before.tzinfo is UTC
    assert c.public_key == KEY.public_key
    assert c.key_usage == {"digitalSignature", "nonRepudiation"}
    assert c.extended_key_usage == ("serverAuth", "1.2.3.4")
    assert c.basic_constraints == x509.BasicConstraints(False, None) and not c.is_ca
    assert c.subject_alt_names == NAMES
    assert c.authority_key_identifier == x509.AuthorityKeyIdentifier(ROOT.certificate.subject_key_identifier)
    assert len(c.subject_key_identifier or b"") == 20
    assert {e.oid: e.critical for e in c.extensions} == {
        "2.5.29.19": True, "2.5.29.15": True, "2.5.29.37": False, "2.5.29.17": False, "2.5.29.14": False,
        "2.5.29.35": False,
    }  # fmt: skip
    ROOT.certificate.public_key.verify(c.signature, c.tbs_certificate)
    c.verify_signature(ROOT.certificate)
    c.verify_signature(ROOT.key.public_key)
    assert "CN=robot_1" in repr(c) and f"{c.serial_number:x}" in repr(c)


def test_the_fingerprint_is_sm3_of_the_whole() -> None:
    assert CERTIFICATE.fingerprint() == sm3.digest(CERTIFICATE.to_der()) and len(CERTIFICATE.fingerprint()) == 32


def test_openssl_has_the_same_fingerprint(openssl: Callable[..., bytes]) -> None:
    printed = openssl("x509", "-noout", "-fingerprint", "-sm3", data=CERTIFICATE.to_pem()).decode()
    assert printed.strip().split("=")[1].replace(":", "").lower() == CERTIFICATE.fingerprint().hex()


def test_a_root_says_what_was_put_in() -> None:
    c = root("plain", path_length=2).certificate
    assert c.subject == c.issuer and c.is_ca
    assert c.basic_constraints == x509.BasicConstraints(True, 2)
    assert c.key_usage == {"keyCertSign", "cRLSign"} and c.extended_key_usage is None and c.subject_alt_names == ()
    assert c.authority_key_identifier == x509.AuthorityKeyIdentifier(c.subject_key_identifier)
    c.verify_signature(c)


def test_tlcp_has_two_certificates() -> None:
    """GM/T 0015 and GB/T 38636: one to sign, one to decrypt and agree on keys."""
    signing, encryption = issue(), issue(key_usage=x509.ENCRYPTION_KEY_USAGE)
    assert signing.key_usage == {"digitalSignature", "nonRepudiation"}
    assert encryption.key_usage == {"keyEncipherment", "dataEncipherment", "keyAgreement"}


def test_certificates_do_not_change_and_can_be_pickled() -> None:
    with pytest.raises(AttributeError):
        CERTIFICATE.subject = Name()  # type: ignore[misc]
    assert pickle.loads(pickle.dumps(CERTIFICATE)) == CERTIFICATE
    for thing in (CERTIFICATE, CSR, ROOT.crl()):
        with pytest.raises(AttributeError):
            thing.signature = b""  # type: ignore[misc]
        with pytest.raises(TypeError):
            type(thing)()
        with pytest.raises(TypeError):  # what exists has been read from its DER
            dataclasses.replace(thing, signature=b"")


def test_verifying_a_request_does_not_change_it() -> None:
    """Of two equal requests both are issued for, or none."""
    made = CertificateSigningRequest.create(KEY, subject={"CN": "x"}, uid=b"robot")
    read = CertificateSigningRequest.from_der(made.to_der())
    made.verify(uid=b"robot")
    for request in (made, read, pickle.loads(pickle.dumps(made))):
        assert request == made
        with pytest.raises(x509.CertificateSignatureError):
            x509.issue(request, ROOT.certificate, ROOT.key, **TIMES)
        assert x509.issue(request, ROOT.certificate, ROOT.key, **TIMES, request_uid=b"robot")


def test_serial_numbers_are_random_positive_and_fit_20_bytes() -> None:
    numbers = {issue().serial_number for _ in range(20)}
    assert len(numbers) == 20
    assert all(0 < n < 2**159 for n in numbers) and max(numbers) > 2**128
    assert issue(serial_number=1).serial_number == 1
    assert issue(serial_number=2**159 - 1).serial_number == 2**159 - 1


def test_a_bundle_of_certificates() -> None:
    bundle = ROOT.certificate.to_pem() + b"text\n" + KEY.to_pem() + CERTIFICATE.to_pem()
    assert x509.load_pem_certificates(bundle) == (ROOT.certificate, CERTIFICATE)
    for data in (b"", KEY.to_pem(), CERTIFICATE.to_pem()[:-30]):
        with pytest.raises(CertificateError):
            x509.load_pem_certificates(data)


def test_the_signature_covers_the_bytes_received() -> None:
    """A name out of UTF8String that we would write as PrintableString is verified as it stands."""
    body = unchecked(CERTIFICATE.tbs_certificate).sequence()
    fields = [body.raw() for _ in range(8)]
    fields[3] = der.sequence(der.set_of(der.sequence(der.oid("2.5.4.3"), der.element(der.T61_STRING, b"root"))))
    certificate = ROOT.resigned(der.sequence(*fields))
    certificate.verify_signature(ROOT.certificate)
    assert certificate.issuer == ROOT.certificate.subject


# --- requests ---


def test_a_request_says_what_was_put_in() -> None:
    again = CertificateSigningRequest.from_pem(b"text\n" + CSR.to_pem())
    assert again == CSR == CertificateSigningRequest.from_der(CSR.to_der()) and hash(again) == hash(CSR)
    assert again != CSR.to_der()
    assert str(again.subject) == "CN=robot_1,O=舰队,C=CN" and again.public_key == KEY.public_key
    assert again.subject_alt_names == ("URI:urn:rosbridge-eth:robot:robot_1", "DNS:robot.example")
    assert again.key_usage == {"digitalSignature"} and again.extended_key_usage == ("clientAuth", "1.2.3.4")
    assert [a.oid for a in again.attributes] == ["1.2.840.113549.1.9.14"] and len(again.extensions) == 3
    again.verify()
    assert repr(again) == "<CertificateSigningRequest CN=robot_1,O=舰队,C=CN>"


def test_a_request_that_asks_for_nothing() -> None:
    csr = CertificateSigningRequest.create(KEY, subject="CN=robot")
    assert csr.attributes == () and csr.extensions == ()
    assert csr.subject_alt_names == () and csr.key_usage is None and csr.extended_key_usage is None


def test_a_request_under_another_uid() -> None:
    csr = CertificateSigningRequest.from_pem(
        CertificateSigningRequest.create(KEY, subject={"CN": "x"}, uid=b"robot").to_pem()
    )
    with pytest.raises(x509.CertificateSignatureError):
        csr.verify()
    with pytest.raises(CertificateError):
        x509.issue(csr, ROOT.certificate, ROOT.key, **TIMES)
    assert x509.issue(csr, ROOT.certificate, ROOT.key, **TIMES, request_uid=b"robot")
    csr.verify(uid=b"robot")
    with pytest.raises(InvalidLength):
        csr.verify(uid=bytes(8192))


def test_alternative_names_take_all_that_prints() -> None:
    names = ("email:a b@example.com", "URI:urn:~")  # the first and the last of printable ASCII
    assert issue(subject_alt_names=names).subject_alt_names == names


def test_nothing_asked_for_is_granted_unless_passed_on() -> None:
    assert issue().subject_alt_names == () and issue().extended_key_usage is None
    assert issue(subject_alt_names=CSR.subject_alt_names).subject_alt_names == CSR.subject_alt_names


def test_an_altered_request_is_not_issued_for() -> None:
    data = CSR.to_der()
    for position in range(0, len(data), 3):
        altered = bytearray(data)
        altered[position] ^= 1
        with pytest.raises(CertificateError):
            x509.issue(CertificateSigningRequest.from_der(altered), ROOT.certificate, ROOT.key, **TIMES)


@pytest.mark.parametrize("v", load("third_party/x509.json", "certificates", kind="csr"))
def test_requests_of_other_projects(v: SimpleNamespace) -> None:
    csr = CertificateSigningRequest.from_pem(v.pem.encode())
    assert csr.to_der() == v.der
    if "1234567812345678" in v.signature_valid_with_uid:
        csr.verify()
    else:  # a digest without Z_A, which no standard allows
        with pytest.raises(CertificateError):
            csr.verify()


def request_of(
    *,
    version: int = 0,
    spki: bytes | None = None,
    attributes: bytes | None = der.explicit(0),
    subject: bytes = Name().to_der(),
) -> CertificateSigningRequest:
    body = der.sequence(
        der.integer(version), subject, KEY.public_key.to_der() if spki is None else spki,
        b"" if attributes is None else attributes,
    )  # fmt: skip
    algorithm = der.sequence(der.oid("1.2.156.10197.1.501"))
    return CertificateSigningRequest.from_der(der.sequence(body, algorithm, der.bit_string(KEY.sign(body))))


def attribute(oid: str, *values: bytes) -> bytes:
    return der.sequence(der.oid(oid), der.set_of(*values))


EXTENSION_REQUEST = "1.2.840.113549.1.9.14"
SAN = der.sequence(Extension("2.5.29.17", False, der.sequence(der.implicit(2, b"a"))).to_der())
SKI = der.sequence(Extension("2.5.29.14", False, der.octet_string(b"k")).to_der())


def test_requests_as_others_write_them() -> None:
    request_of(attributes=None).verify()
    several = sorted([attribute(EXTENSION_REQUEST, SAN), attribute(EXTENSION_REQUEST, SKI)])
    assert len(request_of(attributes=der.explicit(0, *several)).extensions) == 2
    assert request_of(attributes=der.explicit(0, attribute(EXTENSION_REQUEST, der.sequence()))).extensions == ()
    challenge = attribute("1.2.840.113549.1.9.7", der.utf8_string("secret"))
    assert request_of(attributes=der.explicit(0, challenge)).attributes == (
        ("1.2.840.113549.1.9.7", (der.utf8_string("secret"),)),
    )


@pytest.mark.parametrize(
    "parts",
    [
        {"version": 1},
        {"spki": der.sequence(der.sequence(der.oid("1.2.840.113549.1.1.1"), der.null()), der.bit_string(b"rsa"))},
        {"attributes": der.explicit(0, attribute("1.2.3"))},
        {"attributes": der.explicit(0, attribute(EXTENSION_REQUEST, SAN, SKI))},
        {"attributes": der.explicit(0, attribute(EXTENSION_REQUEST, SAN), attribute(EXTENSION_REQUEST, SAN))},
        {"attributes": der.explicit(0, attribute(EXTENSION_REQUEST, der.sequence(
            Extension("2.5.29.15", True, b"\x03\x01\x00").to_der())))},
        {"attributes": der.explicit(1)},
        {"subject": der.null()},
    ],
)  # fmt: skip
def test_requests_that_are_malformed(parts: dict[str, Any]) -> None:
    with pytest.raises(CertificateError, match="not a valid certificate signing request"):
        request_of(**parts)


# --- what issuing refuses ---


def test_what_is_no_ca_issues_nothing() -> None:
    no_ca = Holder(KEY, CERTIFICATE)
    crl_signer = ROOT.ca("crl", key_usage=("cRLSign",))
    old = Holder(KEY, certificate_of(version=b""))  # version 1: no basic constraints
    for holder, reason in (
        (no_ca, "CN=robot_1,O=舰队,C=CN is not a CA"), (old, "CN=x is not a CA"),
        (crl_signer, "CN=crl may not sign certificates"),
    ):  # fmt: skip
        with pytest.raises(x509.CertificateUsageError, match=reason):
            x509.issue(CSR, holder.certificate, holder.key, **TIMES)


def test_nothing_is_issued_beyond_the_ca_s_own_end() -> None:
    with pytest.raises(InvalidOption, match=r"not_after lies after 2027-06-01 .*, when the CA's"):
        issue(not_after=END + timedelta(seconds=1))
    assert issue(not_after=END + timedelta(microseconds=999999)).not_after == END == ROOT.certificate.not_after


def test_the_ca_key_must_be_that_of_the_ca_certificate() -> None:
    with pytest.raises(InvalidKey, match="not the key of ca_certificate"):
        x509.issue(CSR, ROOT.certificate, KEY, **TIMES)


EAST, WEST = timezone(timedelta(hours=8)), timezone(timedelta(hours=-5))


@pytest.mark.parametrize(
    ("options", "reason"),
    [
        ({"not_before": NOW.replace(tzinfo=None)}, "not_before must be an aware datetime"),
        ({"not_after": NOW.replace(tzinfo=None)}, "not_after must be an aware datetime"),
        ({"not_before": datetime(1, 1, 1, tzinfo=EAST)}, "not_before is not within the years 1 to 9999 of UTC"),
        ({"not_after": datetime(9999, 12, 31, 23, tzinfo=WEST)}, "not_after is not within the years"),
        ({"not_after": BEGIN - timedelta(seconds=1)}, "not_after lies before not_before"),
        ({"serial_number": 0}, "serial_number"),
        ({"serial_number": -1}, "serial_number"),
        ({"serial_number": 2**159}, "serial_number"),
        ({"path_length": 0}, "for a CA only"),
        ({"path_length": -1, "ca": True}, "from 0 on"),
        ({"key_usage": ("signing",)}, "unknown key usage 'signing'"),
        ({"extended_key_usage": ("server",)}, "unknown extended key usage 'server'"),
        ({"extended_key_usage": ("1.40",)}, "unknown extended key usage"),
        ({"subject_alt_names": ("robot_1",)}, "is not 'URI:"),
        ({"subject_alt_names": ("host:robot_1",)}, "is not 'URI:"),
        ({"subject_alt_names": ("DNS:",)}, "empty"),
        ({"subject_alt_names": ("DNS:a\x1fb",)}, "printable ASCII"),
        ({"subject_alt_names": ("DNS:a\x7fb",)}, "printable ASCII"),
        ({"subject_alt_names": ("URI:http://ü",)}, "printable ASCII"),
        ({"subject_alt_names": ("IP:1.2.3",)}, "not an IP address"),
        ({"subject_alt_names": ("dirName:robot",)}, "RFC 4514"),
        ({"subject": {}}, "needs a subject or a subject alternative name"),
        ({"extensions": [Extension("2.5.29.19", True, der.sequence())]}, "given twice"),
    ],
)
def test_issuing_refuses(options: dict[str, Any], reason: str) -> None:
    with pytest.raises(InvalidOption, match=reason):
        issue(**options)


@pytest.mark.parametrize(
    "options",
    [
        {"not_before": "2026-01-01"}, {"not_after": 0}, {"serial_number": True}, {"serial_number": "1"},
        {"path_length": True, "ca": True}, {"path_length": "1", "ca": True}, {"key_usage": "digitalSignature"},
        {"extended_key_usage": "serverAuth"}, {"subject_alt_names": "DNS:a"}, {"uid": "1234567812345678"},
        {"key_usage": [0]}, {"extended_key_usage": [5]}, {"subject_alt_names": [None]},
        {"subject_alt_names": [b"DNS:a"]}, {"ca": "no"}, {"ca": 1}, {"ca": None},
        {"extensions": [b"\x05\x00"]}, {"extensions": 5},
    ],
)  # fmt: skip
def test_issuing_takes_no_other_types(options: dict[str, Any]) -> None:
    with pytest.raises(TypeError):
        issue(**options)


@pytest.mark.parametrize("arguments", [(5, True, b""), (b"1.2.3", True, b""), ("1.2.3", 1, b""), ("1.2.3", True, "")])
def test_an_extension_takes_no_other_types(arguments: Any) -> None:
    with pytest.raises(TypeError):
        Extension(*arguments)


def test_an_extension_keeps_its_own_copy() -> None:
    value = bytearray(b"\x05\x00")
    extension = Extension("1.2.3", False, value)
    value[0] = 0
    assert extension.value == b"\x05\x00"


def test_arguments_must_be_what_they_are_called() -> None:
    for arguments in (
        (CSR.to_der(), ROOT.certificate, ROOT.key),
        (CSR, ROOT.certificate.to_der(), ROOT.key),
        (CSR, ROOT.certificate, ROOT.key.to_bytes()),
    ):
        with pytest.raises(TypeError):
            x509.issue(*arguments, **TIMES)
    with pytest.raises(TypeError):
        x509.self_signed(KEY.public_key, subject={"CN": "x"}, **TIMES)
    with pytest.raises(TypeError):
        CertificateSigningRequest.create(KEY.to_bytes(), subject={"CN": "x"})
    with pytest.raises(InvalidOption, match="issuer's name must not be empty"):
        x509.self_signed(KEY, subject={}, **TIMES)
    for read in (Certificate.from_pem, Certificate.from_der, CertificateSigningRequest.from_pem):
        with pytest.raises(TypeError):
            read(CERTIFICATE.to_pem().decode())  # type: ignore[arg-type]


def test_a_subject_may_be_empty_where_alternative_names_stand_in() -> None:
    c = issue(subject={}, subject_alt_names=("DNS:a",))
    assert not c.subject
    assert next(e for e in c.extensions if e.oid == "2.5.29.17").critical  # RFC 5280, 4.2.1.6
    assert len(x509.verify_chain(c, roots=[ROOT.certificate], at=NOW)) == 2


def test_the_ca_may_choose_another_subject() -> None:
    assert str(issue(subject="CN=robot_2").subject) == "CN=robot_2"


def test_times_of_any_zone_are_written_in_utc() -> None:
    c = x509.self_signed(
        KEY, subject="CN=x",
        not_before=datetime(2026, 1, 1, 8, tzinfo=EAST), not_after=datetime(2055, 1, 1, 0, 0, 0, 999999, tzinfo=UTC),
    )  # fmt: skip
    assert c.not_before == datetime(2026, 1, 1, tzinfo=UTC)
    assert c.not_after == datetime(2055, 1, 1, tzinfo=UTC)
    assert b"\x18\x0f20550101000000Z" in c.to_der()


def test_a_ca_without_key_identifier() -> None:
    body = unchecked(ROOT.certificate.tbs_certificate).sequence()
    fields = [body.raw() for _ in range(7)]
    kept = [e.to_der() for e in ROOT.certificate.extensions if e.oid in ("2.5.29.19", "2.5.29.15")]
    bare = Holder(ROOT.key, ROOT.resigned(der.sequence(*fields, der.explicit(3, der.sequence(*kept)))))
    leaf = bare.issue("leaf")
    assert leaf.certificate.authority_key_identifier is None
    assert len(x509.verify_chain(leaf.certificate, roots=[bare.certificate], at=NOW)) == 2
    assert [e.oid for e in bare.crl(leaf).extensions] == ["2.5.29.20"]


# --- what reading refuses ---


def certificate_of(
    *,
    version: bytes = der.explicit(0, der.integer(2)),
    serial: bytes = der.integer(1),
    algorithm: bytes = der.sequence(der.oid("1.2.156.10197.1.501")),
    issuer: bytes = ROOT.certificate.subject.to_der(),
    validity: bytes = der.sequence(der.time(BEGIN), der.time(END)),
    spki: bytes | None = None,
    ids: bytes = b"",
    extensions: tuple[Extension | bytes, ...] = (),
    tail: bytes = b"",
) -> Certificate:
    encoded = [e if isinstance(e, bytes) else e.to_der() for e in extensions]
    return ROOT.resigned(
        der.sequence(
            version, serial, algorithm, issuer, validity, Name.build({"CN": "x"}).to_der(),
            KEY.public_key.to_der() if spki is None else spki, ids,
            der.explicit(3, der.sequence(*encoded)) if extensions else b"", tail,
        )
    )  # fmt: skip


def test_the_forms_that_are_read() -> None:
    assert certificate_of().version == 3
    assert certificate_of(version=b"").version == 1
    v2 = certificate_of(
        version=der.explicit(0, der.integer(1)), ids=der.implicit(1, b"\0\1") + der.implicit(2, b"\0\2")
    )
    assert v2.version == 2
    v2.verify_signature(ROOT.certificate)
    assert certificate_of(serial=der.integer(0)).serial_number == 0  # RFC 5280, 4.1.2.2 wants readers prepared
    other = der.explicit(0, der.oid("1.2.3"), der.explicit(0, der.utf8_string("x")))
    registered = der.implicit(8, der.oid("1.2.3")[2:])
    c = certificate_of(extensions=(Extension("2.5.29.17", False, der.sequence(other, registered)),))
    assert c.subject_alt_names == (f"otherName:{other.hex()}", "RID:1.2.3")
    assert certificate_of(extensions=(Extension("2.5.29.35", False, der.sequence()),)).authority_key_identifier == (
        x509.AuthorityKeyIdentifier()
    )


P256 = der.sequence(der.sequence(der.oid("1.2.840.10045.2.1"), der.oid("1.2.840.10045.3.1.7")),
                    der.bit_string(KEY.public_key.to_bytes()))  # fmt: skip
CRITICAL_SPELT_OUT = der.sequence(der.oid("1.2.3"), der.boolean(False), der.octet_string(der.null()))
CA_SPELT_OUT = Extension("2.5.29.19", True, der.sequence(der.boolean(False)))
MALFORMED = {
    "version 1 spelt out": {"version": der.explicit(0, der.integer(0))},
    "version 4": {"version": der.explicit(0, der.integer(3))},
    "extensions in version 2": {
        "version": der.explicit(0, der.integer(1)), "extensions": (Extension("1.2.3", False, der.null()),)},
    "unique identifiers in version 1": {"version": b"", "ids": der.implicit(1, b"\0\1")},
    "two algorithms": {"algorithm": der.sequence(der.oid("1.2.840.10045.4.3.2"))},
    "an empty issuer": {"issuer": der.sequence()},
    "three times": {"validity": der.sequence(der.time(BEGIN), der.time(END), der.time(END))},
    "a key off the curve": {"spki": KEY.public_key.to_der()[:-1] + bytes([KEY.public_key.to_der()[-1] ^ 1])},
    "something after the extensions": {"tail": der.null()},
    "two lists of extensions": {"tail": der.explicit(3, der.null(), der.null())},
    "an extension twice": {"extensions": (Extension("1.2.3", False, b""), Extension("1.2.3", True, b""))},
    "an extension with a tail": {"extensions": (der.sequence(der.oid("1.2.3"), der.octet_string(b""), der.null()),)},
    "a negative path length": {
        "extensions": (Extension("2.5.29.19", True, der.sequence(der.boolean(True), der.integer(-1))),)},
    "bytes after basic constraints": {"extensions": (Extension("2.5.29.19", True, der.sequence() + b"\0"),)},
    "key usage without a bit": {"extensions": (Extension("2.5.29.15", True, der.named_bits(())),)},
    "key usage bit 9": {"extensions": (Extension("2.5.29.15", True, der.named_bits({9})),)},
    "extended key usage of nothing": {"extensions": (Extension("2.5.29.37", True, der.sequence()),)},
    "alternative names of nothing": {"extensions": (Extension("2.5.29.17", True, der.sequence()),)},
    "an empty DNS name": {"extensions": (Extension("2.5.29.17", True, der.sequence(der.implicit(2, b""))),)},
    "a DNS name with a null": {"extensions": (Extension("2.5.29.17", True, der.sequence(der.implicit(2, b"a\0b"))),)},
    "a URI with a line end": {"extensions": (Extension("2.5.29.17", True, der.sequence(der.implicit(6, b"a\nb"))),)},
    "an IP address of 5 bytes": {
        "extensions": (Extension("2.5.29.17", True, der.sequence(der.implicit(7, bytes(5)))),)},
    "an X.400 address": {"extensions": (Extension("2.5.29.17", True, der.sequence(der.explicit(3))),)},
    "a key identifier that is none": {"extensions": (Extension("2.5.29.14", True, der.null()),)},
    "an authority that is none": {"extensions": (Extension("2.5.29.35", True, der.sequence(der.null())),)},
}  # fmt: skip


@pytest.mark.parametrize("case", MALFORMED)
def test_certificates_that_are_malformed(case: str) -> None:
    with pytest.raises(x509.CertificateMalformedError, match="not a valid certificate"):
        certificate_of(**MALFORMED[case])


def test_a_key_of_another_curve_is_named() -> None:
    with pytest.raises(x509.CertificateAlgorithmError, match="the key of CN=x is EC P-256, not SM2"):
        certificate_of(spki=P256)


POLICIES = der.sequence(der.sequence(der.oid("1.2.3")))
# What is odd: the certificate, the sentence that says it, what openssl prints, and what it means all the same.
ODD: dict[str, tuple[dict[str, Any], str, str, Callable[[Certificate], bool]]] = {
    "key usage with zero bits at its end": (
        {"extensions": (Extension("2.5.29.15", True, bytes.fromhex("030200c0")),)}, "keyUsage ends in zero bits",
        "Digital Signature, Non Repudiation\n", lambda c: c.key_usage == {"digitalSignature", "nonRepudiation"}),
    "key usage of a byte too many": (
        {"extensions": (Extension("2.5.29.15", True, bytes.fromhex("0303008000")),)}, "keyUsage ends in zero bits",
        "Digital Signature\n", lambda c: c.key_usage == {"digitalSignature"}),
    "GeneralizedTime at the beginning": (
        {"validity": der.sequence(der.generalized_time(BEGIN), der.time(END))}, "a date through 2049 is not a UTCTime",
        "Not Before: May 31 12:00:00 2026 GMT", lambda c: (c.not_before, c.not_after) == (BEGIN, END)),
    "GeneralizedTime at the end": (
        {"validity": der.sequence(der.time(BEGIN), der.generalized_time(END))}, "a date through 2049 is not a UTCTime",
        "Not After : Jun  1 12:00:00 2027 GMT", lambda c: (c.not_before, c.not_after) == (BEGIN, END)),
    "an empty list of extensions": (
        {"tail": der.explicit(3, der.sequence())}, "the list of extensions is empty", "Version: 3",
        lambda c: c.extensions == ()),
    "a negative serial number": (
        {"serial": der.integer(-5)}, "the serial number is not positive", "Serial Number: -5 (-0x5)",
        lambda c: c.serial_number == -5),
    "serial number 0": (  # RFC 5280, 4.1.2.2 wants readers prepared for both
        {"serial": der.integer(0)}, "the serial number is not positive", "Serial Number: 0 (0x0)",
        lambda c: c.serial_number == 0),
    "a serial number of 21 bytes": (
        {"serial": der.integer(2**159)}, "or longer than 20 bytes", "80:00:00:00:00",
        lambda c: c.serial_number == 2**159),
    "CA:FALSE spelt out": (
        {"extensions": (CA_SPELT_OUT,)}, "basicConstraints spells out its default", "CA:FALSE",
        lambda c: c.basic_constraints == x509.BasicConstraints(False)),
    "a path length without CA": (
        {"extensions": (Extension("2.5.29.19", True, der.sequence(der.integer(3))),)},
        "has a path length, but not for a CA", "CA:FALSE, pathlen:3",
        lambda c: c.basic_constraints == x509.BasicConstraints(False, 3)),
    "critical spelt out": (
        {"extensions": (CRITICAL_SPELT_OUT,)}, "an extension spells out that it is not critical", "1.2.3:",
        lambda c: c.extensions == (Extension("1.2.3", False, der.null()),)),
    "critical policies": (
        {"extensions": (Extension("2.5.29.32", True, POLICIES),)}, "certificatePolicies is critical", "Policy: 1.2.3",
        lambda c: c.extensions[0].critical),
}  # fmt: skip


@pytest.mark.parametrize("case", ODD)
def test_what_is_odd_is_read_said_and_refused_by_a_strict_judge(case: str) -> None:
    parts, sentence, _, means = ODD[case]
    c = certificate_of(**parts)
    assert len(c.oddities) == 1 and sentence in c.oddities[0]
    assert means(c)
    assert x509.verify_chain(c, roots=[ROOT.certificate], at=NOW) == (c, ROOT.certificate)
    with pytest.raises(x509.CertificateMalformedError, match=f"CN=x is odd: .*{sentence}"):
        x509.verify_chain(c, roots=[ROOT.certificate], at=NOW, strict=True)
    with pytest.raises(x509.CertificateMalformedError, match="CN=x is odd"):
        x509.verify_chain(c, roots=[c], at=NOW, strict=True)


def test_several_oddities_are_all_said() -> None:
    usage = Extension("2.5.29.15", True, bytes.fromhex("030200c0"))
    spelt = Extension("2.5.29.19", True, der.sequence(der.boolean(False), der.integer(0)))
    c = certificate_of(
        serial=der.integer(-1), validity=der.sequence(der.generalized_time(BEGIN), der.time(END)),
        extensions=(CRITICAL_SPELT_OUT, usage, spelt, Extension("2.5.29.32", True, POLICIES)),
    )  # fmt: skip
    assert len(c.oddities) == 7 == len(set(c.oddities))


def test_what_we_write_is_not_odd() -> None:
    late = root("r", path_length=0, not_after=datetime(2050, 1, 1, tzinfo=UTC), serial_number=2**159 - 1).certificate
    policies = certificate_of(extensions=(Extension("2.5.29.32", False, POLICIES),))
    for c in (CERTIFICATE, ROOT.certificate, late, certificate_of(version=b""), policies):
        assert c.oddities == ()
    assert len(x509.verify_chain(CERTIFICATE, roots=[ROOT.certificate], at=NOW, strict=True)) == 2


def test_an_odd_issuer_is_refused_by_a_strict_judge() -> None:
    odd_ca = Holder(KEY, certificate_of(extensions=(
        Extension("2.5.29.19", True, der.sequence(der.boolean(True))), Extension("2.5.29.32", True, POLICIES))))
    leaf = odd_ca.issue("leaf").certificate
    options = {"intermediates": [odd_ca.certificate], "roots": [ROOT.certificate], "at": NOW}
    assert len(x509.verify_chain(leaf, **options)) == 3
    with pytest.raises(x509.CertificateMalformedError, match="CN=x is odd: certificatePolicies"):
        x509.verify_chain(leaf, **options, strict=True)


def test_a_negative_serial_number_can_be_revoked() -> None:
    c = certificate_of(serial=der.integer(-5))
    entry = der.sequence(der.integer(-5), der.time(NOW))
    body = der.sequence(der.integer(1), der.sequence(der.oid("1.2.156.10197.1.501")), ROOT.certificate.subject.to_der(),
                        der.time(NOW), der.time(END), der.sequence(entry))  # fmt: skip
    signed = der.sequence(body, der.sequence(der.oid("1.2.156.10197.1.501")), der.bit_string(ROOT.key.sign(body)))
    with pytest.raises(x509.CertificateRevokedError):
        x509.verify_chain(c, roots=[ROOT.certificate], at=NOW, crls=[x509.CertificateRevocationList.from_der(signed)])


def test_a_ca_of_negative_serial_number_is_named_by_it() -> None:
    ca = Holder(KEY, certificate_of(serial=der.integer(-5), extensions=(
        Extension("2.5.29.19", True, der.sequence(der.boolean(True))),)))
    for serial, length in ((b"\xfb", 3), (b"\x05", 0)):
        named = Extension("2.5.29.35", False, der.sequence(der.implicit(2, serial)))
        with der.reading_sequence(CERTIFICATE.tbs_certificate) as body:
            fields = [body.raw() for _ in range(8)]
        leaf = ca.resigned(der.sequence(*fields[:3], ca.certificate.subject.to_der(), *fields[4:7],
                                        der.explicit(3, der.sequence(named.to_der()))))  # fmt: skip
        options = {"intermediates": [ca.certificate], "roots": [ROOT.certificate], "at": NOW}
        if length:
            assert len(x509.verify_chain(leaf, **options)) == length
        else:
            with pytest.raises(x509.CertificateUnknownIssuerError):
                x509.verify_chain(leaf, **options)


@pytest.mark.parametrize("case", ODD)
def test_openssl_reads_the_same_out_of_what_is_odd(case: str, openssl: Callable[..., bytes]) -> None:
    parts, _, printed, _ = ODD[case]
    assert printed in openssl("x509", "-noout", "-text", data=certificate_of(**parts).to_pem()).decode()


@pytest.mark.filterwarnings("ignore:Parsed a serial number which wasn't positive")
def test_cryptography_reads_the_same_out_of_what_is_odd() -> None:
    theirs = pytest.importorskip("cryptography.x509")
    agreed = 0
    for parts, _, _, _ in ODD.values():
        ours = certificate_of(**parts)
        try:
            read = theirs.load_der_x509_certificate(ours.to_der())
            extensions = [(e.oid.dotted_string, e.critical) for e in read.extensions]
        except (ValueError, theirs.UnsupportedGeneralNameType):  # stricter than we are
            continue
        agreed += 1
        assert (read.serial_number, read.not_valid_before_utc) == (ours.serial_number, ours.not_before)
        assert extensions == [(e.oid, e.critical) for e in ours.extensions]
    assert agreed >= 4


def test_no_container_takes_anything_more() -> None:
    crl = ROOT.crl(x509.RevokedCertificate(7, NOW, "superseded"))
    old = certificate_of(version=b"")
    algorithm, with_null = (der.sequence(der.oid("1.2.156.10197.1.501"), more) for more in (b"", der.null()))
    length = len(CSR.to_der()) - 4
    lengths = b"\x30\x82" + length.to_bytes(2, "big"), b"\x30\x82" + (length + 2).to_bytes(2, "big")
    for value in (CERTIFICATE, ROOT.certificate, old, CSR, crl):
        variants = list(overfull(value.to_der()))
        assert len(variants) >= 10
        for data in variants:
            if value is CSR and data == value.to_der().replace(algorithm, with_null).replace(*lengths):
                CertificateSigningRequest.from_der(data).verify()  # the algorithm's parameters may be NULL
                continue
            with pytest.raises(CertificateError):
                type(value).from_der(data)


def test_what_is_no_certificate() -> None:
    with pytest.raises(CertificateError, match="no PEM block labelled CERTIFICATE"):
        Certificate.from_pem(KEY.to_pem())
    for data in (b"", b"\x30\x00", CERTIFICATE.to_der() + b"\0", CERTIFICATE.to_der()[:-1], CSR.to_der()):
        with pytest.raises(CertificateError):
            Certificate.from_der(data)
        with pytest.raises(CertificateError):
            Certificate.from_pem(pem.encode("CERTIFICATE", data))


@given(st.integers(0, len(CERTIFICATE.to_der()) - 1), st.integers(0, 255), st.integers(0, 2))
def test_an_altered_certificate_is_refused(position: int, value: int, kind: int) -> None:
    data = CERTIFICATE.to_der()
    altered = [
        data[:position] + bytes([value]) + data[position + 1 :],
        data[:position] + data[position + 1 :],
        data[:position] + bytes([value]) + data[position:],
    ][kind]
    if altered == data:
        return
    try:
        certificate = Certificate.from_der(altered)
    except SMCryptoError:
        return
    assert certificate.to_der() == der.check(altered) == altered
    assert Name(certificate.subject.rdns).to_der() == certificate.subject.to_der()
    assert str(certificate.subject).isprintable()
    with pytest.raises(CertificateError):
        certificate.verify_signature(ROOT.certificate)


@given(st.binary(max_size=100))
def test_any_bytes_are_refused(data: bytes) -> None:
    for read in (Certificate.from_der, Certificate.from_pem, CertificateSigningRequest.from_der,
                 x509.CertificateRevocationList.from_der):  # fmt: skip
        with pytest.raises(CertificateError):
            read(data)


# --- openssl ---


def test_openssl_shows_what_we_wrote(openssl: Callable[..., bytes]) -> None:
    text = openssl("x509", "-noout", "-text", "-nameopt", "RFC2253,-esc_msb,utf8", data=CERTIFICATE.to_pem()).decode()
    for part in (
        "Version: 3", "SM2-with-SM3", "Issuer: CN=root", "Subject: CN=robot_1,O=舰队,C=CN", "ASN1 OID: SM2",
        "CA:FALSE", "Digital Signature, Non Repudiation", "TLS Web Server Authentication, 1.2.3.4",
        "URI:urn:rosbridge-eth:robot:robot_1", "DNS:*.example.com", "email:a@example.com", "IP Address:192.0.2.1",
        "May 31 12:00:00 2026 GMT", "Jun  1 12:00:00 2027 GMT",
    ):  # fmt: skip
        assert part in text
    assert int(text.split("Serial Number:")[1].split("Signature")[0].replace(":", ""), 16) == CERTIFICATE.serial_number


def test_names_print_as_openssl_prints_them(openssl: Callable[..., bytes]) -> None:
    subject = {
        "C": "CN",
        "ST": "广东",
        "L": "a+b",
        "O": 'x,"y"',
        "OU": " #",
        "emailAddress": "a@b",
        "DC": "x",
        "CN": "a<b>;",
    }
    c = issue(subject=subject)
    printed = openssl("x509", "-noout", "-subject", "-nameopt", "RFC2253,-esc_msb,utf8", data=c.to_pem()).decode()
    assert printed.strip().removeprefix("subject=") == str(c.subject)


def test_openssl_verifies_our_requests(openssl: Callable[..., bytes]) -> None:
    shown = openssl(
        "req", "-verify", "-vfyopt", "distid:1234567812345678", "-noout", "-text", data=CSR.to_pem(), ok=None
    )
    assert b"verify OK" in shown and b"DNS:robot.example" in shown
    shown = openssl("req", "-verify", "-vfyopt", "distid:another", "-noout", data=CSR.to_pem(), ok=None)
    assert b"verify OK" not in shown


def test_openssl_verifies_our_chains(openssl: Callable[..., bytes], tmp_path: Path) -> None:
    """OpenSSL 3.0 gives a distinguishing id to the leaf only: the default one step by step, the empty one at once."""
    now = datetime.now(UTC)
    for uid in (b"1234567812345678", b""):
        options = {"not_before": now - timedelta(days=1), "not_after": now + timedelta(days=1), "uid": uid}
        top = root("top", **options)
        sub = top.ca("sub", path_length=0, **options)
        leaf = sub.issue("leaf", **options)
        for name, holder in (("top", top), ("sub", sub), ("leaf", leaf)):
            (tmp_path / name).write_bytes(holder.certificate.to_pem())
        verify = ["verify", "-x509_strict"]
        if uid:
            verify += ["-partial_chain", "-vfyopt", f"distid:{uid.decode()}"]
            openssl(*verify, "-CAfile", tmp_path / "sub", tmp_path / "leaf")
            openssl(*verify, "-CAfile", tmp_path / "top", tmp_path / "sub")
            verify[-1] = "distid:another"
            openssl(*verify, "-CAfile", tmp_path / "top", tmp_path / "sub", ok=False)
        else:
            openssl(*verify, "-CAfile", tmp_path / "top", "-untrusted", tmp_path / "sub", tmp_path / "leaf")


def test_we_verify_what_openssl_issued(openssl: Callable[..., bytes], tmp_path: Path) -> None:
    uid = "distid:fleet-7"
    (tmp_path / "ca.ext").write_text(
        "basicConstraints=critical,CA:TRUE,pathlen:0\nkeyUsage=critical,keyCertSign,cRLSign\n"
        "subjectKeyIdentifier=hash\nauthorityKeyIdentifier=keyid,issuer\n"
    )
    (tmp_path / "leaf.ext").write_text(
        "basicConstraints=CA:FALSE\nkeyUsage=digitalSignature\nextendedKeyUsage=clientAuth\n"
        "subjectAltName=URI:urn:x,IP:::1,dirName:d\nauthorityKeyIdentifier=keyid,issuer:always\n[d]\nCN=a\n"
    )
    for name in ("root", "sub", "leaf"):
        openssl("genpkey", "-algorithm", "SM2", "-out", tmp_path / f"{name}.key")
    openssl("req", "-x509", "-new", "-key", tmp_path / "root.key", "-sm3", "-sigopt", uid, "-subj", "/C=CN/O=F/CN=root",
            "-days", "9", "-out", tmp_path / "root.crt")  # fmt: skip
    for name, issuer, extensions in (("sub", "root", "ca"), ("leaf", "sub", "leaf")):
        openssl("req", "-new", "-key", tmp_path / f"{name}.key", "-sm3", "-sigopt", uid, "-subj", f"/CN={name}",
                "-out", tmp_path / f"{name}.csr")  # fmt: skip
        csr = CertificateSigningRequest.from_pem((tmp_path / f"{name}.csr").read_bytes())
        csr.verify(uid=b"fleet-7")
        openssl("x509", "-req", "-in", tmp_path / f"{name}.csr", "-CA", tmp_path / f"{issuer}.crt", "-CAkey",
                tmp_path / f"{issuer}.key", "-sm3", "-sigopt", uid, "-vfyopt", uid, "-days", "5", "-extfile",
                tmp_path / f"{extensions}.ext", "-out", tmp_path / f"{name}.crt")  # fmt: skip
    top, sub, leaf = (Certificate.from_pem((tmp_path / f"{name}.crt").read_bytes()) for name in ("root", "sub", "leaf"))
    now = datetime.now(UTC) + timedelta(seconds=2)
    path = x509.verify_chain(
        leaf, intermediates=[sub], roots=[top], at=now, uid=b"fleet-7", extended_key_usage="clientAuth"
    )
    assert path == (leaf, sub, top)
    assert leaf.subject_alt_names == ("URI:urn:x", "IP:::1", "dirName:CN=a")
    assert (
        leaf.authority_key_identifier is not None and leaf.authority_key_identifier.serial_number == sub.serial_number
    )
    assert leaf.public_key == sm2.PrivateKey.from_pem((tmp_path / "leaf.key").read_bytes()).public_key
    with pytest.raises(CertificateError):
        x509.verify_chain(leaf, intermediates=[sub], roots=[top], at=now)
