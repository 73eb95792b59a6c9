"""Is a certificate for this host? RFC 9525, 6; judged by the package `cryptography` and by openssl as well."""

from __future__ import annotations

from collections.abc import Callable
from datetime import timedelta
from ipaddress import IPv4Address, IPv6Address, ip_address
from pathlib import Path
from typing import Any

import pytest

from smcrypto import CertificateError, InvalidOption
from smcrypto.x509 import Certificate, CertificateHostnameError
from x509_authority import BEGIN, NOW, root

ROOT = root("root")
NAMES = (
    "DNS:robot.example", "DNS:*.fleet.example", "DNS:Mixed.Example", "DNS:f*o.example", "DNS:*.*.star.example",
    "DNS:*.com", "DNS:absolute.example.", "DNS:xn--bcher-kva.example", "DNS:under_score.example", "DNS:192.0.2.9",
    "DNS:*", "DNS:*bar.example", "DNS:a.*.example", "DNS:blank .example", "IP:192.0.2.1", "IP:2001:db8::1",
    "email:a@mail.example", "URI:https://uri.example/", "dirName:CN=directory.example",
)  # fmt: skip
CERTIFICATE = ROOT.issue("common.example", subject_alt_names=NAMES, extended_key_usage=("serverAuth",)).certificate

MATCHING = [
    "robot.example", "ROBOT.example", "robot.example.", "mixed.example", "a.fleet.example", "A.Fleet.EXAMPLE.",
    "xn--bcher-kva.fleet.example", "xn--bcher-kva.example", "XN--BCHER-KVA.example", "under_score.example", "192.0.2.1",
    "2001:db8::1", "2001:0DB8:0::1", IPv4Address("192.0.2.1"), IPv6Address("2001:db8::1"),
]  # fmt: skip
OTHERS = [
    "example", "other.example", "a.robot.example", "fleet.example", "a.b.fleet.example", "fo.example", "foo.example",
    "example.com", "a.b.star.example", "absolute.example", "absolute.example.", "common.example", "mail.example",
    "uri.example", "directory.example", "localhost", "foobar.example", "a.b.example", "robot.exampl", "obot.example",
    "192.0.2.2", "192.0.2.9", "::1", "::ffff:192.0.2.1", "2001:db8::1%eth0", IPv4Address("192.0.2.9"),
    "a." * 62 + "a.fleet.example",
]  # fmt: skip
NO_HOSTS: list[Any] = [
    "", ".", "robot.example..", ".robot.example", "*.fleet.example", "*", "bücher.example", "\u212aelvin.example",
    "a..example", "-a.example", "a-.example", "a" * 64 + ".example", "a." * 127 + "a", "robot.example\n",
    "robot.example\0", "robot .example", "https://robot.example", "robot.example:443", "[2001:db8::1]", "192.0.2.1.",
    "192.0.2", "1", "0x7f.1", "robot.123", "192.0.2.1/32",
]  # fmt: skip


def test_names_and_addresses_are_typed_values() -> None:
    names = tuple(name[4:] for name in NAMES if name.startswith("DNS:"))
    assert CERTIFICATE.dns_names == names
    assert CERTIFICATE.ip_addresses == (IPv4Address("192.0.2.1"), IPv6Address("2001:db8::1"))
    assert ROOT.certificate.dns_names == ROOT.certificate.ip_addresses == ()


@pytest.mark.parametrize("name", MATCHING, ids=str)
def test_a_host_that_it_is_for(name: Any) -> None:
    CERTIFICATE.verify_hostname(name)


@pytest.mark.parametrize("name", OTHERS, ids=str)
def test_a_host_that_it_is_not_for(name: Any) -> None:
    with pytest.raises(CertificateHostnameError, match=r"the certificate of CN=common.example is for .*, not for "):
        CERTIFICATE.verify_hostname(name)


@pytest.mark.parametrize("name", NO_HOSTS, ids=repr)
def test_what_is_no_host_name_is_the_callers_fault(name: Any) -> None:
    with pytest.raises(InvalidOption, match="is not a host name"):
        CERTIFICATE.verify_hostname(name)


@pytest.mark.parametrize("name", [b"robot.example", None, 5, ("robot.example",)])
def test_a_host_name_is_text(name: Any) -> None:
    with pytest.raises(TypeError):
        CERTIFICATE.verify_hostname(name)


def test_the_longest_names() -> None:
    label = "a" * 63
    longest = ".".join([label, label, label, "a" * 61])
    certificate = ROOT.issue("x", subject_alt_names=(f"DNS:{longest}",)).certificate
    assert len(longest) == 253
    certificate.verify_hostname(longest)
    certificate.verify_hostname(longest + ".")
    with pytest.raises(InvalidOption):
        certificate.verify_hostname(longest + "a")


def test_without_alternative_names_it_is_for_no_host() -> None:
    with pytest.raises(CertificateHostnameError, match="is for no host, not for root"):
        ROOT.certificate.verify_hostname("root")
    assert issubclass(CertificateHostnameError, CertificateError)


def _ours(certificate: Certificate, name: str) -> bool:
    try:
        certificate.verify_hostname(name)
    except CertificateHostnameError:
        return False
    return True


def test_openssl_judges_the_same(openssl: Callable[..., bytes], tmp_path: Path) -> None:
    """Except that it lets a wildcard stand for a part of a label, which RFC 9525, 6.3 does not."""
    (tmp_path / "c.pem").write_bytes(CERTIFICATE.to_pem())
    known = {"foo.example", "fo.example", "foobar.example", "absolute.example.", "robot.example.", "A.Fleet.EXAMPLE."}
    for name in MATCHING + OTHERS:
        if not isinstance(name, str) or name in known or "%" in name:
            continue
        try:
            option = "-checkip" if ip_address(name) else ""
        except ValueError:
            option = "-checkhost"
        said = openssl("x509", "-noout", option, name, "-in", tmp_path / "c.pem").decode()
        assert ("does match" in said) == _ours(CERTIFICATE, name), name


def test_cryptography_judges_the_same() -> None:
    """Its verifier wants certificates of its own algorithms: the names are ours, the key is of P-256."""
    theirs = pytest.importorskip("cryptography.x509")
    verification = pytest.importorskip("cryptography.x509.verification")
    ec = pytest.importorskip("cryptography.hazmat.primitives.asymmetric.ec")
    hashes = pytest.importorskip("cryptography.hazmat.primitives.hashes")
    presented = ["robot.example", "*.fleet.example", "mixed.example", "xn--bcher-kva.example"]
    ours = ROOT.issue("x", subject_alt_names=[*(f"DNS:{n}" for n in presented), "IP:192.0.2.1"]).certificate
    ca_key, key = ec.generate_private_key(ec.SECP256R1()), ec.generate_private_key(ec.SECP256R1())
    ca_name, name = (theirs.Name([theirs.NameAttribute(theirs.NameOID.COMMON_NAME, n)]) for n in ("ca", "leaf"))

    def build(subject: Any, public: Any) -> Any:
        builder = theirs.CertificateBuilder().subject_name(subject).issuer_name(ca_name).public_key(public)
        builder = builder.serial_number(7).not_valid_before(BEGIN).not_valid_after(NOW + timedelta(days=9))
        authority = theirs.AuthorityKeyIdentifier.from_issuer_public_key(ca_key.public_key())
        return builder.add_extension(authority, False)

    ca = build(ca_name, ca_key.public_key()).add_extension(theirs.BasicConstraints(True, None), True)
    ca = ca.add_extension(theirs.SubjectKeyIdentifier.from_public_key(ca_key.public_key()), False)
    ca = ca.add_extension(theirs.KeyUsage(False, False, False, False, False, True, True, False, False), True)
    leaf = build(name, key.public_key()).add_extension(theirs.SubjectAlternativeName(
        [*map(theirs.DNSName, presented), theirs.IPAddress(IPv4Address("192.0.2.1"))]), False)  # fmt: skip
    leaf = leaf.add_extension(theirs.ExtendedKeyUsage([theirs.ExtendedKeyUsageOID.SERVER_AUTH]), False)
    ca, leaf = (b.sign(ca_key, hashes.SHA256()) for b in (ca, leaf))
    policy = verification.PolicyBuilder().store(verification.Store([ca])).time(NOW)
    for host in (
        "robot.example", "ROBOT.example", "a.fleet.example", "a.b.fleet.example", "fleet.example", "mixed.example",
        "xn--bcher-kva.example", "leaf", "192.0.2.1", "192.0.2.2", "::1",
    ):  # fmt: skip
        try:
            subject = theirs.IPAddress(ip_address(host))
        except ValueError:
            subject = theirs.DNSName(host)
        try:
            policy.build_server_verifier(subject).verify(leaf, [])
            accepted = True
        except verification.VerificationError:
            accepted = False
        assert accepted == _ours(ours, host), host
