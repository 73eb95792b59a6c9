"""Identities: who is believed, who is not, and what stands in the files."""

from __future__ import annotations

import stat
from dataclasses import replace
from datetime import UTC, datetime, timedelta

import pytest
from hypothesis import given
from hypothesis import strategies as st

from rosbridge_eth import identity as ids
from rosbridge_eth.errors import ExitCode, IdentityError, VerificationError
from smcrypto import InvalidSignature, sm2, x509

BIRTH = datetime(2026, 1, 1, tzinfo=UTC)
TODAY = BIRTH + timedelta(days=30)
CA = ids.create_ca("operator", at=BIRTH)
OTHER_CA = ids.create_ca("operator", at=BIRTH)  # the same name, another key
ROBOT = ids.enrol(CA, ids.Role.ROBOT, "robot_1", at=BIRTH)
TRUST = ids.Trust((CA.certificate,))


def ders(who: ids.Identity) -> tuple[bytes, bytes]:
    return who.signing_certificate.to_der(), who.encryption_certificate.to_der()


def test_an_enrolled_identity_is_who_it_says():
    peer = TRUST.check(*ders(ROBOT), role=ids.Role.ROBOT, name="robot_1", at=TODAY)
    assert (peer.role, peer.name) == (ids.Role.ROBOT, "robot_1")
    assert "CN=robot_1" in str(peer.signing_certificate.subject)


def test_certificates_begin_a_day_before_they_are_made_and_never_before_their_ca():
    for certificate in (CA.certificate, ROBOT.signing_certificate, ROBOT.encryption_certificate):
        assert certificate.not_before == BIRTH - timedelta(days=1)
    TRUST.check(*ders(ROBOT), role=ids.Role.ROBOT, at=BIRTH - timedelta(hours=23))
    early = ids.enrol(CA, ids.Role.ROBOT, "robot_2", at=BIRTH - timedelta(hours=1))
    assert early.public.not_before == BIRTH - timedelta(days=1)


def test_certificates_of_a_registration_are_taken_apart_again():
    together = ROBOT.public.certificates
    assert ids.split_certificates(together) == ders(ROBOT)
    for wrong in (b"", together[:-1], together + b"\0", ders(ROBOT)[0], ders(ROBOT)[0] * 3, b"\x30\x82\xff\xff" * 2):
        with pytest.raises(VerificationError):
            ids.split_certificates(wrong)


def test_a_pem_file_names_its_identity():
    assert ids.public_identity(ROBOT.public.pem) == ROBOT.public
    other = ids.enrol(CA, ids.Role.ROBOT, "robot_2", at=BIRTH).public.pem
    for wrong in (b"", ROBOT.public.pem + other, CA.certificate.to_pem(), CA.certificate.to_pem() * 2):
        with pytest.raises(IdentityError):
            ids.public_identity(wrong)
    with pytest.raises(IdentityError, match="two identities"):
        ids.public_identity(ROBOT.signing_certificate.to_pem() + other.split(b"-----END CERTIFICATE-----\n")[1]
                            + b"-----END CERTIFICATE-----\n")


@pytest.mark.parametrize(
    ("change", "error"),
    [
        ({"role": ids.Role.SERVER}, ids.UntrustedCertificate),
        ({"role": (ids.Role.READER, ids.Role.SERVER)}, ids.UntrustedCertificate),
        ({"name": "robot_2"}, ids.UntrustedCertificate),
        ({"at": BIRTH - timedelta(days=1, seconds=1)}, ids.ExpiredCertificate),
        ({"at": BIRTH + timedelta(days=826)}, ids.ExpiredCertificate),
    ],
)
def test_another_role_name_or_time_is_refused(change, error):
    with pytest.raises(error):
        TRUST.check(*ders(ROBOT), **({"role": ids.Role.ROBOT, "name": None, "at": TODAY} | change))


def _certificates(ca: ids.CertificateAuthority, **changes) -> tuple[bytes, bytes]:
    """Two certificates of a robot, as enrol_requests makes them but for `changes`."""
    made = []
    for usage in (ids.SIGNING_USAGE, ids.ENCRYPTION_USAGE):
        request = x509.CertificateSigningRequest.create(sm2.PrivateKey.generate(), subject={"CN": "robot_1"})
        options = {
            "not_before": BIRTH,
            "not_after": BIRTH + timedelta(days=100),
            "key_usage": usage,
            "subject_alt_names": ("URI:urn:rosbridge-eth:robot:robot_1",),
        } | changes
        made.append(x509.issue(request, ca.certificate, ca.key, **options).to_der())
    return made[0], made[1]


UNTRUSTED = {
    "another CA of the same name": lambda: _certificates(OTHER_CA),
    "both for signing": lambda: _certificates(CA, key_usage=ids.SIGNING_USAGE),
    "both for encryption": lambda: _certificates(CA, key_usage=ids.ENCRYPTION_USAGE),
    "both for everything": lambda: _certificates(CA, key_usage=ids.SIGNING_USAGE + ids.ENCRYPTION_USAGE),
    "for servers": lambda: _certificates(CA, extended_key_usage=("serverAuth",)),
    "no log's signer": lambda: _certificates(CA, key_usage=("digitalSignature",)),
    "no name": lambda: _certificates(CA, subject_alt_names=("DNS:robot_1",)),
    "two names": lambda: _certificates(
        CA, subject_alt_names=("URI:urn:rosbridge-eth:robot:robot_1", "URI:urn:rosbridge-eth:robot:robot_2")
    ),
    "a role that does not exist": lambda: _certificates(CA, subject_alt_names=("URI:urn:rosbridge-eth:god:robot_1",)),
    "a name that cannot be": lambda: _certificates(CA, subject_alt_names=("URI:urn:rosbridge-eth:robot:Robot 1",)),
    "of two robots": lambda: (ders(ROBOT)[0], ders(ids.enrol(CA, ids.Role.ROBOT, "robot_2", at=BIRTH))[1]),
    "the wrong way round": lambda: ders(ROBOT)[::-1],
    "the same twice": lambda: (ders(ROBOT)[0], ders(ROBOT)[0]),
    "the CA's own": lambda: (CA.certificate.to_der(), CA.certificate.to_der()),
    "nothing": lambda: (b"", b""),
    "cut short": lambda: (ders(ROBOT)[0][:-1], ders(ROBOT)[1]),
    "with more behind": lambda: (ders(ROBOT)[0] + b"\0", ders(ROBOT)[1]),
}


@pytest.mark.parametrize("what", UNTRUSTED)
def test_certificates_that_do_not_hold_are_refused(what):
    with pytest.raises(ids.UntrustedCertificate) as refused:
        TRUST.check(*UNTRUSTED[what](), role=tuple(ids.Role), at=TODAY)
    assert refused.value.exit_code is ExitCode.IDENTITY


def test_who_is_not_on_the_allow_list_is_refused():
    with pytest.raises(ids.NotAllowed):
        replace(TRUST, allowed=lambda peer: peer.name != "robot_1").check(*ders(ROBOT), role=ids.Role.ROBOT, at=TODAY)


# Names


@given(st.text(max_size=70))
def test_a_name_is_lower_case_short_and_safe_in_a_path_and_a_uri(name):
    try:
        ids.check_name(name)
    except IdentityError:
        return
    assert 1 <= len(name) <= 63 and name.isascii() and not name.startswith((".", "-", "_"))
    assert not set(name) - set("abcdefghijklmnopqrstuvwxyz0123456789_.-")


@pytest.mark.parametrize("name", ["", "A", ".", "../x", "a b", "a\n", "-a", "a" * 64, "é", None, 7])
def test_a_name_that_cannot_be_is_refused(name):
    with pytest.raises(IdentityError):
        ids.check_name(name)


# Signatures


def test_a_signature_holds_for_its_purpose_body_and_key_alone():
    key, other = sm2.PrivateKey.generate(), sm2.PrivateKey.generate()
    signature = ids.sign(key, "record", b"body")
    assert len(signature) == 64
    ids.verify(key.public_key, "record", b"body", signature)
    # The covered bytes are fixed: what a reader in another language would verify.
    key.public_key.verify(signature, b"rosbridge-eth/2 record\0body", encoding="raw")
    for public, purpose, body, text in (
        (key.public_key, "gap", b"body", signature),
        (key.public_key, "record", b"other", signature),
        (other.public_key, "record", b"body", signature),
        (key.public_key, "record", b"body", signature[:-1]),
        (key.public_key, "record", b"body", signature + b"\0"),
        (key.public_key, "record", b"body", b""),
    ):
        with pytest.raises(InvalidSignature):
            ids.verify(public, purpose, body, text)


# The CA


def test_a_ca_is_loaded_and_what_is_none_is_refused(tmp_path):
    def put(key: sm2.PrivateKey, certificate: x509.Certificate, password: bytes = b"pass") -> None:
        (tmp_path / "ca.crt.pem").write_bytes(certificate.to_pem())
        (tmp_path / "ca.key.pem").unlink(missing_ok=True)
        (tmp_path / "ca.key.pem").touch(0o600)
        (tmp_path / "ca.key.pem").write_bytes(key.to_pem(password))

    put(CA.key, CA.certificate)
    loaded = ids.load_ca(tmp_path, b"pass", TODAY)
    made = ids.enrol(loaded, ids.Role.ROBOT, "robot_3", at=TODAY)
    TRUST.check(*ders(made), role=ids.Role.ROBOT, at=TODAY)
    with pytest.raises(IdentityError, match="does not open"):
        ids.load_ca(tmp_path, b"word", TODAY)
    for at in (BIRTH - timedelta(days=2), BIRTH + timedelta(days=3651)):
        with pytest.raises(IdentityError, match="is valid from"):
            ids.load_ca(tmp_path, b"pass", at)
    (tmp_path / "ca.key.pem").chmod(0o644)
    with pytest.raises(IdentityError, match="chmod 600"):
        ids.load_ca(tmp_path, b"pass", TODAY)
    for key, certificate in ((OTHER_CA.key, CA.certificate), (ROBOT.signing_key, ROBOT.signing_certificate)):
        put(key, certificate)
        with pytest.raises(IdentityError, match="cannot be certified"):
            ids.enrol(ids.load_ca(tmp_path, b"pass", TODAY), ids.Role.ROBOT, "robot_3", at=TODAY)
    (tmp_path / "ca.crt.pem").unlink()
    with pytest.raises(IdentityError, match="cannot be read"):
        ids.load_ca(tmp_path, b"pass", TODAY)


# Enrolment from requests, and files


def test_a_request_for_another_name_or_with_one_key_twice_is_refused():
    one, two = sm2.PrivateKey.generate(), sm2.PrivateKey.generate()
    with pytest.raises(IdentityError, match="CN=robot_9"):
        ids.enrol_requests(CA, ids.Role.ROBOT, "robot_9", *ids.requests("robot_1", one, two), at=BIRTH)
    with pytest.raises(IdentityError, match="two keys"):
        ids.enrol_requests(CA, ids.Role.ROBOT, "robot_1", *ids.requests("robot_1", one, one), at=BIRTH)
    peer = ids.enrol_requests(CA, ids.Role.ROBOT, "robot_1", *ids.requests("robot_1", one, two), at=BIRTH)
    assert peer.signing_certificate.public_key == one.public_key
    assert peer.encryption_certificate.public_key == two.public_key


def test_saved_and_loaded_it_is_the_same_identity_and_others_cannot_read_the_keys(tmp_path):
    folder = tmp_path / "robot_1"
    ids.save_identity(folder, ROBOT, (CA.certificate,), b"pass phrase")
    assert stat.S_IMODE(folder.stat().st_mode) == 0o700
    for name in ("sign", "enc"):
        key = folder / f"{name}.key.pem"
        assert stat.S_IMODE(key.stat().st_mode) == 0o600
        assert key.read_bytes().startswith(b"-----BEGIN ENCRYPTED PRIVATE KEY-----")
    loaded, roots = ids.load_identity(folder, b"pass phrase")
    assert loaded.public == ROBOT.public and roots == (CA.certificate,)
    assert loaded.signing_key.to_bytes() == ROBOT.signing_key.to_bytes()
    with pytest.raises(IdentityError, match="not overwritten"):
        ids.save_identity(folder, ROBOT, (CA.certificate,), b"other")
    with pytest.raises(IdentityError, match=r"wrong password.*; give"):
        ids.load_identity(folder, b"pass phrases")
    (folder / "enc.key.pem").chmod(0o640)
    with pytest.raises(IdentityError, match="chmod 600"):
        ids.load_identity(folder, b"pass phrase")
    (folder / "enc.key.pem").unlink()
    with pytest.raises(IdentityError, match="cannot be read"):
        ids.load_identity(folder, b"pass phrase")


def test_files_that_do_not_belong_together_are_refused():
    files = ids.identity_files(ROBOT, (CA.certificate,), None)
    other = ids.identity_files(ids.enrol(CA, ids.Role.ROBOT, "robot_2", at=BIRTH), (CA.certificate,), None)
    for change in (
        {"sign.key.pem": other["sign.key.pem"]},
        {"enc.key.pem": other["sign.key.pem"], "enc.crt.pem": other["sign.crt.pem"]},
        {"enc.crt.pem": b""},
        {"ca.crt.pem": b"nonsense"},
        {"sign.key.pem": b"nonsense"},
    ):
        with pytest.raises(IdentityError):
            ids.identity_from_files(files | change, None)
    del files["ca.crt.pem"]
    with pytest.raises(IdentityError, match=r"ca\.crt\.pem missing"):
        ids.identity_from_files(files, None)


def test_no_key_shows_in_a_repr():
    text = repr(ROBOT) + str(ROBOT) + repr(CA)
    assert ROBOT.signing_key.to_bytes().hex() not in text and "PrivateKey" not in text
