"""Revocation lists: RFC 5280, 5; what openssl makes of ours and we of its; their weight in a chain."""

from __future__ import annotations

from collections.abc import Callable
from datetime import datetime, timedelta, timezone
from pathlib import Path

import pytest
from hypothesis import given
from hypothesis import strategies as st

from smcrypto import CertificateError, InvalidKey, InvalidOption, SMCryptoError, der, x509
from smcrypto.x509 import CertificateRevocationList, CertificateRevokedError, RevokedCertificate
from x509_authority import BEGIN, NOW, Holder, certificates, root

UTC = timezone.utc

ROOT = root()
SUB = ROOT.ca("sub")
LEAF = SUB.issue("leaf")
GOOD = SUB.issue("good")
CRL = SUB.crl(LEAF, number=7)


def verify(leaf: Holder, *crls: CertificateRevocationList, **options) -> tuple[x509.Certificate, ...]:
    options = {"at": NOW + timedelta(hours=1)} | options
    return x509.verify_chain(
        leaf.certificate, intermediates=[SUB.certificate], roots=[ROOT.certificate], crls=crls, **options
    )


# --- what a list says ---


def test_a_list_says_what_was_put_in() -> None:
    again = CertificateRevocationList.from_pem(b"text\n" + CRL.to_pem())
    assert again == CRL == CertificateRevocationList.from_der(CRL.to_der()) and hash(again) == hash(CRL)
    assert again != CRL.to_der()
    assert again.issuer == SUB.certificate.subject
    assert (again.this_update, again.next_update, again.number) == (NOW, NOW + timedelta(days=7), 7)
    entry = RevokedCertificate(LEAF.certificate.serial_number, NOW, "keyCompromise")
    assert again.revoked == (entry,) and again.find(entry.serial_number) == entry
    assert again.find(GOOD.certificate.serial_number) is None
    assert [e.oid for e in again.extensions] == ["2.5.29.35", "2.5.29.20"]
    again.verify(SUB.certificate)
    assert "CN=sub, 1 revoked" in repr(again)
    assert SUB.crl().revoked == ()


# RFC 5280, 5.3.1
REASONS = {
    "keyCompromise": 1,
    "cACompromise": 2,
    "affiliationChanged": 3,
    "superseded": 4,
    "cessationOfOperation": 5,
    "certificateHold": 6,
    "privilegeWithdrawn": 9,
    "aACompromise": 10,
}


@pytest.mark.parametrize("reason", REASONS)
def test_every_reason(reason: str) -> None:
    crl = SUB.crl(RevokedCertificate(5, NOW, reason))
    assert crl.revoked == (RevokedCertificate(5, NOW, reason),)
    assert der.oid("2.5.29.21") + der.octet_string(der.enumerated(REASONS[reason])) in crl.to_der()


def test_an_unspecified_reason_is_not_written() -> None:
    crl = SUB.crl(RevokedCertificate(5, NOW, "unspecified"))
    assert crl.revoked == (RevokedCertificate(5, NOW),) and der.oid("2.5.29.21") not in crl.to_der()


def test_numbers_fit_20_bytes() -> None:
    assert SUB.crl(number=2**159 - 1).number == 2**159 - 1 and SUB.crl(number=0).number == 0
    with pytest.raises(InvalidOption, match="20 bytes"):
        SUB.crl(number=2**159)


def test_a_list_is_fresh_from_its_first_to_its_last_second() -> None:
    for at in (NOW, NOW + timedelta(days=7)):
        CRL.require_fresh(at)
    assert SUB.crl(next_update=NOW).next_update == NOW


def test_making_a_list_refuses_what_cannot_be_written() -> None:
    entry = RevokedCertificate(5, NOW)
    for reason, make in {
        "unknown reason": lambda: SUB.crl(RevokedCertificate(5, NOW, "bored")),
        "revoked twice": lambda: SUB.crl(entry, entry),
        "before this_update": lambda: SUB.crl(next_update=NOW - timedelta(seconds=1)),
        "aware": lambda: SUB.crl(this_update=NOW.replace(tzinfo=None)),
        "number must not be negative": lambda: SUB.crl(number=-1),
        "is revoked must not be negative": lambda: SUB.crl(RevokedCertificate(-5, NOW)),
    }.items():
        with pytest.raises(InvalidOption, match=reason):
            make()
    for number in (True, "1", None):
        with pytest.raises(TypeError):
            SUB.crl(number=number)
    with pytest.raises(InvalidKey):
        Holder(ROOT.key, SUB.certificate).crl()
    with pytest.raises(TypeError):
        CertificateRevocationList()


# --- in a chain ---


def test_a_revoked_leaf() -> None:
    with pytest.raises(CertificateRevokedError, match=r"CN=leaf was revoked at 2026-06-01 .*: keyCompromise"):
        verify(LEAF, CRL)


def test_a_leaf_that_is_not_revoked() -> None:
    assert len(verify(GOOD, CRL)) == 3


def test_without_lists_nothing_is_asked() -> None:
    assert len(verify(LEAF)) == 3


def test_lists_are_given_but_none_of_the_issuer() -> None:
    with pytest.raises(CertificateError, match="there is no revocation list of CN=sub for CN=good"):
        verify(GOOD, ROOT.crl())


def test_every_certificate_must_be_covered_if_so_wanted() -> None:
    assert len(verify(GOOD, CRL, ROOT.crl(), revocation="every")) == 3
    with pytest.raises(CertificateError, match="no revocation list of CN=root for CN=sub"):
        verify(GOOD, CRL, revocation="every")
    with pytest.raises(CertificateError, match="no revocation list of CN=sub for CN=good"):
        verify(GOOD, revocation="every")


def test_a_revoked_intermediate() -> None:
    with pytest.raises(CertificateRevokedError, match="CN=sub was revoked"):
        verify(GOOD, CRL, ROOT.crl(SUB))


@pytest.mark.parametrize(
    ("at", "reason"),
    [(NOW - timedelta(seconds=1), "the future"), (NOW + timedelta(days=7, seconds=1), "is stale")],
)
def test_a_list_that_is_not_fresh_is_no_answer(at: datetime, reason: str) -> None:
    with pytest.raises(CertificateError, match=reason):
        verify(GOOD, CRL, at=at)


def test_a_fresh_list_beside_a_stale_one_is_enough() -> None:
    old = SUB.crl(this_update=BEGIN, next_update=BEGIN + timedelta(hours=1))
    assert len(verify(GOOD, old, CRL)) == 3
    with pytest.raises(CertificateRevokedError):
        verify(LEAF, old, CRL)


def test_a_list_signed_by_somebody_else() -> None:
    impostor = root("sub")
    with pytest.raises(x509.CertificateSignatureError, match="the revocation list of CN=sub"):
        verify(GOOD, impostor.crl())
    assert len(verify(GOOD, impostor.crl(GOOD), CRL)) == 3


def test_a_list_under_another_uid() -> None:
    with pytest.raises(x509.CertificateSignatureError):
        verify(GOOD, SUB.crl(uid=b"other"))


def test_an_issuer_that_may_not_sign_lists() -> None:
    ca = ROOT.ca("no crl", key_usage=("keyCertSign",))
    with pytest.raises(CertificateError, match="no cRLSign"):
        ca.crl().verify(ca.certificate)


def test_a_list_of_another_issuer() -> None:
    with pytest.raises(CertificateError, match="is not from CN=root"):
        CRL.verify(ROOT.certificate)


def test_the_date_of_revocation_does_not_excuse() -> None:
    with pytest.raises(CertificateRevokedError):
        verify(LEAF, SUB.crl(RevokedCertificate(LEAF.certificate.serial_number, NOW + timedelta(days=2))))


# --- what is read ---


def crl_of(
    *,
    version: bytes = der.integer(1),
    algorithm: bytes = der.sequence(der.oid("1.2.156.10197.1.501")),
    times: tuple[bytes, ...] = (der.time(NOW), der.time(NOW + timedelta(days=1))),
    entries: bytes = b"",
    extensions: bytes = b"",
) -> CertificateRevocationList:
    body = der.sequence(version, algorithm, SUB.certificate.subject.to_der(), *times, entries, extensions)
    outer = der.sequence(der.oid("1.2.156.10197.1.501"))
    return CertificateRevocationList.from_der(der.sequence(body, outer, der.bit_string(SUB.key.sign(body))))


def entry(serial: int, *extensions: x509.Extension) -> bytes:
    more = der.sequence(*(e.to_der() for e in extensions)) if extensions else b""
    return der.sequence(der.integer(serial), der.time(NOW), more)


def listed(*extensions: x509.Extension) -> bytes:
    return der.explicit(0, der.sequence(*(e.to_der() for e in extensions)))


TRIFLE = der.sequence(x509.Extension("1.2.3", False, der.null()).to_der())


def test_a_version_1_list() -> None:
    crl = crl_of(version=b"", entries=der.sequence(entry(5)))
    crl.verify(SUB.certificate)
    assert crl.number is None and crl.find(5) is not None


def test_a_list_without_next_update_is_never_fresh() -> None:
    crl = crl_of(times=(der.time(NOW),))
    assert crl.next_update is None
    with pytest.raises(CertificateError, match="stale"):
        crl.require_fresh(NOW)


DISTRIBUTION_POINT = x509.Extension("2.5.29.28", True, der.sequence())


def test_unknown_critical_extensions_make_a_list_useless() -> None:
    for crl in (
        crl_of(extensions=listed(DISTRIBUTION_POINT)),
        crl_of(entries=der.sequence(entry(5, x509.Extension("2.5.29.29", True, der.sequence())))),
    ):
        with pytest.raises(CertificateError, match="critical extension"):
            crl.verify(SUB.certificate)


def test_unknown_extensions_that_are_not_critical_are_no_matter() -> None:
    harmless = x509.Extension("1.2.3", False, der.null())
    crl_of(extensions=listed(harmless), entries=der.sequence(entry(5, harmless))).verify(SUB.certificate)


@pytest.mark.parametrize(
    "parts",
    [
        {"version": der.integer(2)},
        {"version": der.integer(0)},
        {"version": der.integer(1) + der.integer(1)},
        {"algorithm": der.sequence(der.oid("1.2.840.10045.4.3.2"))},
        {"entries": der.sequence()},
        {"entries": der.sequence(entry(5), entry(5))},
        {"entries": der.sequence(entry(5, x509.Extension("2.5.29.21", False, der.enumerated(8))))},
        {"entries": der.sequence(entry(5, x509.Extension("2.5.29.21", False, der.integer(1))))},
        {"entries": der.sequence(der.sequence(der.integer(5)))},
        {"entries": der.sequence(entry(5)[:1] + bytes([entry(5)[1] + 4]) + entry(5)[2:] + der.null() + der.null())},
        {"entries": der.sequence(der.sequence(der.integer(5), der.time(NOW), TRIFLE, der.null()))},
        {"entries": der.sequence(entry(5, x509.Extension("2.5.29.21", False, der.enumerated(1) + der.null())))},
        {"extensions": listed(x509.Extension("2.5.29.20", False, der.integer(1) + der.null()))},
        {"version": b"", "extensions": listed(x509.Extension("1.2.3", False, der.null()))},
        {"extensions": der.explicit(1, der.null())},
        {"times": ()},
    ],
)
def test_lists_that_are_malformed(parts: dict[str, bytes]) -> None:
    with pytest.raises(CertificateError, match="not a valid revocation list"):
        crl_of(**parts)


def test_no_list_in_the_pem_data() -> None:
    with pytest.raises(CertificateError, match="no PEM block labelled X509 CRL"):
        CertificateRevocationList.from_pem(SUB.certificate.to_pem())


@given(st.integers(0, len(CRL.to_der()) - 1), st.integers(0, 255))
def test_an_altered_list_is_refused(position: int, value: int) -> None:
    altered = bytearray(CRL.to_der())
    if altered[position] == value:
        return
    altered[position] = value
    with pytest.raises(SMCryptoError):
        CertificateRevocationList.from_der(altered).verify(SUB.certificate)


def test_many_lists_are_not_all_verified() -> None:
    forged = [SUB.crl(number=number, uid=b"another") for number in range(101)]
    stale = [SUB.crl(number=number, next_update=NOW) for number in range(101)]
    with pytest.raises(CertificateError, match="no path was found with 100 signatures"):
        verify(GOOD, *forged)
    assert len(verify(GOOD, *stale, CRL)) == 3


# --- openssl ---


def test_openssl_reads_ours_and_refuses_the_revoked(openssl: Callable[..., bytes], tmp_path: Path) -> None:
    now = datetime.now(UTC)
    times = {"not_before": now - timedelta(days=1), "not_after": now + timedelta(days=1), "uid": b""}
    # OpenSSL 3.0 gives a distinguishing id to the leaf only; a chain holds there with the empty one.
    top = root("openssl root", **times)
    bad, good = top.issue("bad", **times), top.issue("good", **times)
    crl = top.crl(bad, this_update=now, next_update=now + timedelta(days=1), number=77, uid=b"")
    for name, pem in (("root", top.certificate), ("bad", bad.certificate), ("good", good.certificate), ("crl", crl)):
        (tmp_path / name).write_bytes(pem.to_pem())
    text = openssl("crl", "-in", tmp_path / "crl", "-noout", "-text").decode()
    assert "Key Compromise" in text and "77" in text and f"{bad.certificate.serial_number:X}" in text
    check = ["verify", "-x509_strict", "-crl_check", "-CRLfile", tmp_path / "crl", "-CAfile", tmp_path / "root"]
    assert b"OK" in openssl(*check, tmp_path / "good")
    assert b"certificate revoked" in openssl(*check, tmp_path / "bad", ok=False)


def test_openssl_writes_a_list_we_read(openssl: Callable[..., bytes], tmp_path: Path) -> None:
    now = datetime.now(UTC)
    times = {"not_before": now - timedelta(days=1), "not_after": now + timedelta(days=9)}
    top = root("openssl root", **times)
    leaf = top.issue("leaf", **times)
    for name, data in {
        "ca.pem": top.certificate.to_pem(), "ca.key": top.key.to_pem(), "leaf.pem": leaf.certificate.to_pem(),
        "index.txt": b"", "number": b"05\n",
        "ca.cnf": f"[ca]\ndefault_ca=d\n[d]\ndatabase={tmp_path}/index.txt\ncrlnumber={tmp_path}/number\n"
                  f"default_md=sm3\ndefault_crl_days=3\ncrl_extensions=x\n[x]\nauthorityKeyIdentifier=keyid\n".encode(),
    }.items():  # fmt: skip
        (tmp_path / name).write_bytes(data)
    common = ["ca", "-config", tmp_path / "ca.cnf", "-cert", tmp_path / "ca.pem", "-keyfile", tmp_path / "ca.key"]
    openssl(*common, "-revoke", tmp_path / "leaf.pem", "-crl_reason", "superseded")
    crl = CertificateRevocationList.from_pem(openssl(*common, "-gencrl", "-sigopt", "distid:1234567812345678"))
    crl.verify(top.certificate)
    assert crl.number == 5
    assert [(e.serial_number, e.reason) for e in crl.revoked] == [(leaf.certificate.serial_number, "superseded")]
    with pytest.raises(CertificateRevokedError):
        x509.verify_chain(leaf.certificate, roots=certificates(top), at=datetime.now(UTC), crls=[crl])
