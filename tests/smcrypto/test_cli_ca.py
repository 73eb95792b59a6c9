"""`python -m smcrypto ca`: a CA in a folder, run as its operator would."""

from __future__ import annotations

import fcntl
import os
import stat
import subprocess
from collections.abc import Callable
from datetime import datetime, timedelta, timezone
from pathlib import Path
from threading import Thread

import pytest

from smcrypto import der, pem, sm2, x509
from smcrypto.cli import main
from x509_authority import NOW, foreign_der

UTC = timezone.utc

PASSWORD = ("--password-file", "password")


def run(*arguments: str, code: int = 0) -> None:
    assert main(["ca", *arguments]) == code


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    Path("password").write_bytes(b"open sesame\n")
    assert main(["keygen", "-o", "robot.key"]) == 0
    return tmp_path


@pytest.fixture
def fleet(folder: Path) -> Path:
    run("init", "--dir", "fleet", "--subject", "CN=Fleet CA,O=Example", *PASSWORD)
    run("csr", "--key", "robot.key", "--subject", "CN=robot_1", "--san", "DNS:robot.example",
        "--extended-key-usage", "clientAuth", "-o", "robot.csr")  # fmt: skip
    return folder


def issue(*arguments: str, output: str = "robot.crt", code: int = 0) -> x509.Certificate | None:
    run("issue", "--dir", "fleet", *PASSWORD, "-o", output, *arguments, "robot.csr", code=code)
    return x509.Certificate.from_pem(Path(output).read_bytes()) if code == 0 else None


def certificate(name: str) -> x509.Certificate:
    return x509.Certificate.from_pem(Path(name).read_bytes())


def refusal(capsys: pytest.CaptureFixture[str], *arguments: str) -> str:
    capsys.readouterr()
    run(*arguments, code=1)
    captured = capsys.readouterr()
    assert captured.err.startswith("smcrypto: ") and captured.err.count("\n") == 1
    return captured.err


def test_init_makes_an_encrypted_key_and_a_root(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run("init", "--dir", "fleet", "--subject", "CN=Fleet CA,O=Example", *PASSWORD)
    key, root = Path("fleet/ca.key.pem"), certificate("fleet/ca.crt.pem")
    assert stat.S_IMODE(key.stat().st_mode) == 0o600 and stat.S_IMODE(key.parent.stat().st_mode) == 0o700
    assert b"ENCRYPTED" in key.read_bytes()
    assert sm2.PrivateKey.from_pem(key.read_bytes(), b"open sesame").public_key == root.public_key
    assert str(root.subject) == "CN=Fleet CA,O=Example" and root.is_ca
    assert root.not_after - root.not_before == timedelta(days=3650)
    assert root.fingerprint().hex() in capsys.readouterr().err


def test_init_does_not_overwrite(fleet: Path, capsys: pytest.CaptureFixture[str]) -> None:
    before = Path("fleet/ca.key.pem").read_bytes()
    again = ("init", "--dir", "fleet", "--subject", "CN=Another", *PASSWORD)
    assert "give --force" in refusal(capsys, *again)
    Path("fleet/ca.key.pem").rename("fleet/kept")
    assert "ca.crt.pem exists" in refusal(capsys, *again)
    Path("fleet/kept").rename("fleet/ca.key.pem")
    assert Path("fleet/ca.key.pem").read_bytes() == before
    run("revoke", "--dir", "fleet", *PASSWORD)
    for name in ("fleet/ca.key.pem", "fleet/ca.crt.pem"):
        Path(name).rename(f"{name}.old")
    assert "ca.crl.pem exists" in refusal(capsys, *again)
    run(*again, "--force")
    assert str(certificate("fleet/ca.crt.pem").subject) == "CN=Another"
    run("revoke", "--dir", "fleet", *PASSWORD)  # a list of the new CA's own


def test_an_unencrypted_ca_on_purpose(folder: Path) -> None:
    run("init", "--dir", "lab", "--subject", "CN=Lab", "--unencrypted")
    assert sm2.PrivateKey.from_pem(Path("lab/ca.key.pem").read_bytes())
    with pytest.raises(SystemExit, match="2"):  # a password that would not be used
        run("init", "--dir", "other", "--subject", "CN=Lab", "--unencrypted", *PASSWORD)
    assert not Path("other").exists()


def test_a_failed_init_leaves_nothing(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    for wrong in (["--subject", "robot"], ["--subject", "C=CHN"], ["--subject", "CN=x", "--days", "0"],
                  ["--subject", "CN=x", "--days", "40000"]):  # fmt: skip
        refusal(capsys, "init", "--dir", "new", *wrong, *PASSWORD)
    assert "a password is needed" in refusal(capsys, "init", "--dir", "new", "--subject", "CN=x")
    assert not Path("new").exists()


def test_issue_grants_what_the_operator_names(fleet: Path) -> None:
    plain = issue()
    assert plain is not None and plain.subject_alt_names == () and plain.extended_key_usage is None
    assert plain.key_usage == set(x509.SIGNING_KEY_USAGE)
    named = issue("--for", "encrypt", "--san", "URI:urn:x", "--requested-names", "--extended-key-usage", "serverAuth")
    assert named is not None and named.subject_alt_names == ("URI:urn:x", "DNS:robot.example")
    assert named.key_usage == set(x509.ENCRYPTION_KEY_USAGE) and named.extended_key_usage == ("serverAuth",)
    assert x509.verify_chain(named, roots=[certificate("fleet/ca.crt.pem")], at=datetime.now(UTC))


def test_issue_needs_the_password(fleet: Path, capsys: pytest.CaptureFixture[str]) -> None:
    Path("wrong").write_bytes(b"open barley\n")
    arguments = ("issue", "--dir", "fleet", "-o", "robot.crt", "robot.csr")
    assert "password is wrong" in refusal(capsys, *arguments, "--password-file", "wrong")
    assert not Path("robot.crt").exists()


def test_issue_verifies_the_request(fleet: Path, capsys: pytest.CaptureFixture[str]) -> None:
    csr = x509.CertificateSigningRequest.from_pem(Path("robot.csr").read_bytes())
    altered = csr.to_der()[:-1] + bytes([csr.to_der()[-1] ^ 1])
    Path("robot.csr").write_bytes(pem.encode("CERTIFICATE REQUEST", altered))
    assert "does not hold" in refusal(capsys, "issue", "--dir", "fleet", *PASSWORD, "robot.csr")


def test_issue_hands_out_nothing_that_would_be_refused(fleet: Path, capsys: pytest.CaptureFixture[str]) -> None:
    common = ("issue", "--dir", "fleet", *PASSWORD, "-o", "out", "robot.csr")
    assert "when the CA's certificate ends" in refusal(capsys, *common, "--days", "4000")
    issue("--intermediate", "--path-length", "0", output="sub.crt")
    Path("sub").mkdir()
    Path("sub/ca.crt.pem").write_bytes(Path("sub.crt").read_bytes())
    Path("sub/ca.key.pem").write_bytes(Path("robot.key").read_bytes())
    assert main(["keygen", "-o", "leaf.key"]) == 0
    run("csr", "--key", "leaf.key", "--subject", "CN=leaf", "-o", "leaf.csr")
    sub = ("issue", "--dir", "sub", "-o", "out", "leaf.csr")
    assert "allows no CA below it" in refusal(capsys, *sub, "--intermediate", "--days", "9")
    issue(output="sub/ca.crt.pem")
    assert "is not a CA" in refusal(capsys, *sub, "--days", "9")
    assert not Path("out").exists()


def test_without_days_a_certificate_ends_with_the_ca_at_the_latest(
    folder: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    run("init", "--dir", "short", "--subject", "CN=Short", "--days", "9", "--unencrypted")
    assert main(["keygen", "-o", "own.key"]) == 0
    run("csr", "--key", "own.key", "--subject", "CN=robot", "-o", "robot.csr")
    run("issue", "--dir", "short", "-o", "robot.crt", "robot.csr")
    assert certificate("robot.crt").not_after == certificate("short/ca.crt.pem").not_after
    run("issue", "--dir", "short", "-o", "robot.crt", "--days", "8", "robot.csr")
    assert certificate("robot.crt").not_after < certificate("short/ca.crt.pem").not_after
    refusal(capsys, "issue", "--dir", "short", "--days", "365", "robot.csr")
    refusal(capsys, "issue", "--dir", "short", "--days", "0", "robot.csr")
    key = sm2.PrivateKey.from_pem(Path("short/ca.key.pem").read_bytes())
    past = datetime.now(UTC) - timedelta(days=1)
    expired = x509.self_signed(key, subject="CN=Short", not_before=past, not_after=past)
    Path("short/ca.crt.pem").write_bytes(expired.to_pem())
    assert "when the CA's certificate ends" in refusal(capsys, "issue", "--dir", "short", "robot.csr")


def test_show_names_what_is_foreign_or_odd(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    foreign, odd = foreign_der("other"), x509.self_signed(
        sm2.PrivateKey.generate(), subject="CN=odd", not_before=NOW, not_after=NOW,
        extensions=[x509.Extension("2.5.29.32", True, b"\x30\x00")],
    )  # fmt: skip
    Path("bundle").write_bytes(pem.encode("CERTIFICATE", foreign) + odd.to_pem())
    run("show", "bundle")
    shown = capsys.readouterr().out
    assert "subject:              CN=other" in shown and "key:                  RSA" in shown
    assert "odd:                  certificatePolicies is critical" in shown


def test_another_distinguishing_id(fleet: Path, capsys: pytest.CaptureFixture[str]) -> None:
    run("csr", "--key", "robot.key", "--subject", "CN=robot_1", "--uid", "robot", "-o", "robot.csr")
    refusal(capsys, "issue", "--dir", "fleet", *PASSWORD, "robot.csr")
    issue("--request-uid", "robot")
    run("verify", "--roots", "fleet/ca.crt.pem", "robot.crt")
    assert "not trusted" in refusal(capsys, "verify", "--roots", "fleet/ca.crt.pem", "--uid", "x", "robot.crt")


def test_verify_says_trusted_or_why_not(fleet: Path, capsys: pytest.CaptureFixture[str]) -> None:
    issue("--extended-key-usage", "clientAuth")
    verify = ("verify", "--roots", "fleet/ca.crt.pem", "robot.crt")
    capsys.readouterr()
    run(*verify)
    assert capsys.readouterr().err == "trusted: CN=robot_1 <- CN=Fleet CA,O=Example\n"
    run(*verify, "--key-usage", "digitalSignature", "--extended-key-usage", "clientAuth")
    assert "not for serverAuth" in refusal(capsys, *verify, "--extended-key-usage", "serverAuth")
    assert "may not be used" in refusal(capsys, *verify, "--key-usage", "keyAgreement")
    assert "not valid before" in refusal(capsys, *verify, "--at", "2020-01-01T00:00:00Z")
    for time in ("2030-01-01T00:00:00", "yesterday"):
        assert "--at takes a time" in refusal(capsys, *verify, "--at", time)
    for option in ("--roots", "--crl", "--intermediates"):
        assert "smcrypto: password: no" in refusal(capsys, *verify, option, "password")
    assert "No such file" in refusal(capsys, "verify", "--roots", "nothing", "robot.crt")


def test_verify_with_intermediates_in_either_file(fleet: Path) -> None:
    issue("--intermediate", output="sub.crt")
    sub = sm2.PrivateKey.from_pem(Path("robot.key").read_bytes())
    key = sm2.PrivateKey.generate()
    now = datetime.now(UTC) - timedelta(minutes=1)
    leaf = x509.issue(x509.CertificateSigningRequest.create(key, subject="CN=leaf"), certificate("sub.crt"), sub,
                      not_before=now, not_after=now + timedelta(days=1))  # fmt: skip
    Path("leaf.crt").write_bytes(leaf.to_pem())
    Path("chain.crt").write_bytes(leaf.to_pem() + Path("sub.crt").read_bytes())
    run("verify", "--roots", "fleet/ca.crt.pem", "leaf.crt", code=1)
    run("verify", "--roots", "fleet/ca.crt.pem", "--intermediates", "sub.crt", "leaf.crt")
    run("verify", "--roots", "fleet/ca.crt.pem", "chain.crt")


def test_revoke_keeps_the_record_in_the_list(fleet: Path, capsys: pytest.CaptureFixture[str]) -> None:
    first, second = issue(output="a.crt"), issue(output="b.crt")
    assert first is not None and second is not None
    revoke = ("revoke", "--dir", "fleet", *PASSWORD)

    def crl() -> x509.CertificateRevocationList:
        return x509.CertificateRevocationList.from_pem(Path("fleet/ca.crl.pem").read_bytes())

    run(*revoke)
    assert (crl().number, crl().revoked) == (0, ())
    run(*revoke, "--reason", "superseded", "a.crt")
    assert [(e.serial_number, e.reason) for e in crl().revoked] == [(first.serial_number, "superseded")]
    run(*revoke, "--reason", "keyCompromise", "a.crt", "b.crt")
    assert crl().number == 2
    assert [(e.serial_number, e.reason) for e in crl().revoked] == [
        (first.serial_number, "superseded"), (second.serial_number, "keyCompromise"),
    ]  # fmt: skip
    verify = ("verify", "--roots", "fleet/ca.crt.pem", "--crl", "fleet/ca.crl.pem")
    assert "was revoked at" in refusal(capsys, *verify, "b.crt")
    issue(output="c.crt")
    run(*verify, "c.crt")
    assert "unknown reason" in refusal(capsys, *revoke, "--reason", "bored", "c.crt")
    now = datetime.now(UTC)
    foreign = x509.self_signed(sm2.PrivateKey.generate(), subject="CN=x", not_before=now, not_after=now)
    Path("foreign.crt").write_bytes(foreign.to_pem())
    assert "does not hold" in refusal(capsys, *revoke, "foreign.crt")


def test_revocations_wait_for_each_other(fleet: Path) -> None:
    revoked, crl = issue(), Path("fleet/ca.crl.pem")
    run("revoke", "--dir", "fleet", *PASSWORD)
    before = crl.read_bytes()
    crl.unlink()
    os.mkfifo(crl)  # shows when it is read, and makes that last
    first = Thread(target=run, args=("revoke", "--dir", "fleet", *PASSWORD, "robot.crt"))
    first.start()
    with crl.open("wb") as read_by_first, Path("fleet/ca.crt.pem").open("rb") as second:
        with pytest.raises(BlockingIOError):
            fcntl.flock(second, fcntl.LOCK_EX | fcntl.LOCK_NB)
        read_by_first.write(before)
    after = x509.CertificateRevocationList.from_pem(crl.read_bytes())
    first.join()
    assert revoked is not None and after.find(revoked.serial_number)


def test_show_prints_what_there_is(fleet: Path, capsys: pytest.CaptureFixture[str]) -> None:
    issued = issue("--san", "URI:urn:x", "--days", "30")
    assert issued is not None
    run("revoke", "--dir", "fleet", *PASSWORD, "--reason", "superseded", "robot.crt")
    capsys.readouterr()
    run("show", "robot.crt")
    shown = capsys.readouterr().out
    for part in (
        "  subject:              CN=robot_1\n",
        "  issuer:               CN=Fleet CA,O=Example\n",
        "  CA:                   no\n",
        "  key usage:            digitalSignature, nonRepudiation\n",
        "  alternative names:    URI:urn:x\n",
        f"  serial number:        {issued.serial_number:x}\n",
        f"  SM3 fingerprint:      {issued.fingerprint().hex()}\n",
    ):
        assert part in shown
    assert "extended key usage" not in shown
    issue("--intermediate", "--path-length", "3", output="sub.crt")
    run("show", "sub.crt")
    assert "CA:                   yes, path length 3" in capsys.readouterr().out
    Path("old.crt").write_bytes(Path("sub.crt").read_bytes().replace(b" CERTIFICATE-", b" X509 CERTIFICATE-"))
    run("show", "old.crt")
    assert "CA:                   yes, path length 3" in capsys.readouterr().out
    run("show", "robot.csr")
    assert "certificate request\n  subject:              CN=robot_1\n" in capsys.readouterr().out
    run("show", "fleet/ca.crl.pem")
    assert "superseded" in capsys.readouterr().out
    assert "no certificate, request or revocation list" in refusal(capsys, "show", "robot.key")


def test_show_of_a_certificate_without_extensions(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    key = sm2.PrivateKey.generate()
    name = x509.Name.build("CN=old").to_der()
    algorithm = der.sequence(der.oid("1.2.156.10197.1.501"))
    now = der.time(datetime.now(UTC))
    body = der.sequence(der.integer(1), algorithm, name, der.sequence(now, now), name, key.public_key.to_der())
    Path("old.crt").write_bytes(
        pem.encode("CERTIFICATE", der.sequence(body, algorithm, der.bit_string(key.sign(body))))
    )
    run("show", "old.crt")
    shown = capsys.readouterr().out
    assert "CA:" not in shown and "key identifier" not in shown and "subject:              CN=old" in shown


def test_hostile_names_do_not_reach_the_terminal(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    key = sm2.PrivateKey.generate()
    csr = x509.CertificateSigningRequest.create(key, subject={"CN": "x\x1b]0;owned\x07\n  subject: CN=root"})
    Path("evil.csr").write_bytes(csr.to_pem())
    run("show", "evil.csr")
    shown = capsys.readouterr().out
    assert "\x1b" not in shown and "\\1b" in shown and shown.count("\n  subject:") == 1
    names = ("URI:urn:x, DNS:bank.example", "DNS:robot.example")
    csr = x509.CertificateSigningRequest.create(key, subject={"CN": "x"}, subject_alt_names=names)
    Path("evil.csr").write_bytes(csr.to_pem())
    run("show", "evil.csr")
    assert tuple(line[24:] for line in capsys.readouterr().out.splitlines()[2:4]) == names


def test_openssl_accepts_the_chain(fleet: Path, require: Callable[[str], str]) -> None:
    issue()
    subprocess.run([require("openssl"), "verify", "-x509_strict", "-vfyopt", "distid:1234567812345678",
                    "-CAfile", "fleet/ca.crt.pem", "robot.crt"], check=True, capture_output=True)  # fmt: skip
