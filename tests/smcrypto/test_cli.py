"""The command line, run as a user would, and against the openssl program in both directions."""

from __future__ import annotations

import os
import stat
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path

import pytest

from smcrypto.cli import main

ABC_DIGEST = "66c7f0f462eeedd9d1f2d46bdc10e4e24167c4875cf2f7a2297da02b8f4ba8e0"  # GB/T 32905, A.1


@pytest.fixture
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.chdir(tmp_path)
    Path("message").write_bytes(b"the message\n" * 100)
    Path("password").write_bytes(b"open sesame\n")
    return tmp_path


@pytest.fixture
def keys(folder: Path) -> Path:
    assert main(["keygen", "-o", "key.pem", "--public", "pub.pem"]) == 0
    return folder


@pytest.fixture
def openssl(require: Callable[[str], str]) -> Callable[..., bytes]:
    program = require("openssl")

    def run(*arguments: str, ok: bool = True) -> bytes:
        done = subprocess.run([program, *arguments], capture_output=True, check=False)
        assert (done.returncode == 0) == ok, done.stderr.decode()
        return done.stdout

    return run


def test_hash_prints_as_sha256sum_does(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    Path("abc").write_bytes(b"abc")
    assert main(["hash", "abc", "abc"]) == 0
    assert capsys.readouterr().out == f"{ABC_DIGEST}  abc\n" * 2


def test_hash_reads_a_pipe() -> None:
    done = subprocess.run([sys.executable, "-m", "smcrypto", "hash"], input=b"abc", capture_output=True, check=True)
    assert done.stdout == f"{ABC_DIGEST}  -\n".encode()


def test_hmac_is_that_of_openssl(folder: Path, openssl: Callable[..., bytes], capsys: pytest.CaptureFixture[str]) -> None:
    Path("mac.key").write_bytes(bytes(range(32)))
    assert main(["hmac", "--key-file", "mac.key", "message"]) == 0
    ours = capsys.readouterr().out.split()[0]
    theirs = openssl("dgst", "-sm3", "-mac", "HMAC", "-macopt", f"hexkey:{bytes(range(32)).hex()}", "message")
    assert theirs.decode().split()[-1] == ours


def test_a_private_key_is_for_its_owner_alone_and_not_overwritten(
    keys: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    before = Path("key.pem").read_bytes()
    assert stat.S_IMODE(os.stat("key.pem").st_mode) == 0o600
    assert main(["keygen", "-o", "key.pem"]) == 1
    assert "--force" in capsys.readouterr().err
    assert Path("key.pem").read_bytes() == before
    assert main(["keygen", "-o", "key.pem", "--force"]) == 0
    assert Path("key.pem").read_bytes() != before


def test_pubkey_gives_what_keygen_wrote(keys: Path, capsysbinary: pytest.CaptureFixture[bytes]) -> None:
    assert main(["pubkey", "--key", "key.pem"]) == 0
    assert capsysbinary.readouterr().out == Path("pub.pem").read_bytes()


@pytest.mark.parametrize("encoding", ["der", "raw"])
def test_a_signature_verifies_and_a_changed_file_does_not(
    keys: Path, encoding: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(["sign", "--key", "key.pem", "--encoding", encoding, "-o", "sig", "message"]) == 0
    verify = ["verify", "--public", "pub.pem", "--signature", "sig", "--encoding", encoding, "message"]
    assert main(verify) == 0
    assert main([*verify[:-1], "--uid", "somebody", "message"]) == 1
    with Path("message").open("ab") as message:
        message.write(b"x")
    assert main(verify) == 1
    assert "does not hold" in capsys.readouterr().err


def test_openssl_verifies_our_signature_and_we_verify_its(keys: Path, openssl: Callable[..., bytes]) -> None:
    common = ["-rawin", "-digest", "sm3", "-pkeyopt", "distid:robot-1", "-in", "message"]
    assert main(["sign", "--key", "key.pem", "--uid", "robot-1", "-o", "sig", "message"]) == 0
    openssl("pkeyutl", "-verify", "-pubin", "-inkey", "pub.pem", "-sigfile", "sig", *common)
    openssl("pkeyutl", "-sign", "-inkey", "key.pem", "-out", "theirs", *common)
    assert main(["verify", "--public", "pub.pem", "--uid", "robot-1", "--signature", "theirs", "message"]) == 0
    Path("message").write_bytes(b"another")
    openssl("pkeyutl", "-verify", "-pubin", "-inkey", "pub.pem", "-sigfile", "sig", *common, ok=False)


def test_we_sign_with_a_key_that_openssl_made(folder: Path, openssl: Callable[..., bytes]) -> None:
    openssl("genpkey", "-algorithm", "SM2", "-out", "key.pem")
    openssl("pkey", "-in", "key.pem", "-pubout", "-out", "pub.pem")
    assert main(["sign", "--key", "key.pem", "-o", "sig", "message"]) == 0
    assert main(["verify", "--public", "pub.pem", "--signature", "sig", "message"]) == 0


def test_sm2_encryption_in_both_directions(
    keys: Path, openssl: Callable[..., bytes], capsysbinary: pytest.CaptureFixture[bytes]
) -> None:
    Path("short").write_bytes(b"a short secret")
    assert main(["encrypt", "--to", "pub.pem", "-o", "sealed", "short"]) == 0
    assert openssl("pkeyutl", "-decrypt", "-inkey", "key.pem", "-in", "sealed") == b"a short secret"
    openssl("pkeyutl", "-encrypt", "-pubin", "-inkey", "pub.pem", "-in", "short", "-out", "theirs")
    assert main(["decrypt", "--key", "key.pem", "theirs"]) == 0
    assert capsysbinary.readouterr().out == b"a short secret"


@pytest.mark.parametrize("mode", ["cbc", "ctr", "cfb", "ofb"])
def test_encryption_under_a_password_in_both_directions(
    folder: Path, mode: str, openssl: Callable[..., bytes]
) -> None:
    ours = ["--password-file", "password", "--iterations", "1000", "--mode", mode]
    theirs = ["enc", f"-sm4-{mode}", "-pbkdf2", "-md", "sm3", "-iter", "1000", "-pass", "file:password"]
    assert main(["encrypt", *ours, "-o", "sealed", "message"]) == 0
    assert openssl(*theirs, "-d", "-in", "sealed") == Path("message").read_bytes()
    openssl(*theirs, "-in", "message", "-out", "theirs")
    assert main(["decrypt", *ours, "-o", "opened", "theirs"]) == 0
    assert Path("opened").read_bytes() == Path("message").read_bytes()


def test_encryption_under_a_key_in_both_directions(folder: Path, openssl: Callable[..., bytes]) -> None:
    key, iv = bytes(range(16)), bytes(range(16, 32)).hex()
    Path("sm4.key").write_bytes(key)
    ours = ["--sm4-key-file", "sm4.key", "--iv", iv]
    assert main(["encrypt", *ours, "-o", "sealed", "message"]) == 0
    theirs = ["enc", "-sm4-cbc", "-K", key.hex(), "-iv", iv]
    assert openssl(*theirs, "-d", "-in", "sealed") == Path("message").read_bytes()
    assert main(["decrypt", *ours, "-o", "opened", "sealed"]) == 0
    assert Path("opened").read_bytes() == Path("message").read_bytes()


def test_a_decryption_that_fails_leaves_nothing_behind(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    common = ["--password-file", "password", "--iterations", "1000"]
    assert main(["encrypt", *common, "-o", "sealed", "message"]) == 0
    Path("password").write_bytes(b"wrong\n")
    before = sorted(folder.iterdir())
    # PKCS#7 passes by chance for one wrong key in 256; a message of many blocks then still differs.
    code = main(["decrypt", *common, "-o", "opened", "sealed"])
    if code == 0:
        assert Path("opened").read_bytes() != Path("message").read_bytes()
    else:
        assert sorted(folder.iterdir()) == before
        assert capsys.readouterr().err.startswith("smcrypto: ")


@pytest.mark.parametrize("arguments, says", [
    (["hash", "absent"], "absent: No such file"),
    (["sign", "--key", "absent.pem", "message"], "absent.pem"),
    (["sign", "--key", "message", "message"], "smcrypto: "),
    (["decrypt", "--password-file", "password", "message"], "Salted__"),
    (["encrypt", "--sm4-key-file", "password", "--iv", "zz", "message"], "hex"),
    (["encrypt", "--sm4-key-file", "password", "--iv", "00" * 16, "message"], "16 bytes"),
    (["encrypt", "--password-env", "UNSET_VARIABLE", "message"], "UNSET_VARIABLE"),
])
def test_mistakes_end_in_one_line_and_exit_code_1(
    folder: Path, arguments: list[str], says: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(arguments) == 1
    error = capsys.readouterr().err
    assert says in error and error.count("\n") == 1


def test_a_command_line_that_makes_no_sense_exits_with_2() -> None:
    with pytest.raises(SystemExit) as exit:
        main(["no-such-command"])
    assert exit.value.code == 2


def test_an_encrypted_key_needs_its_password(keys: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["keygen", "-o", "locked.pem", "--password-file", "password"]) == 0
    assert b"ENCRYPTED" in Path("locked.pem").read_bytes()
    assert main(["sign", "--key", "locked.pem", "--password-file", "password", "-o", "sig", "message"]) == 0
    Path("wrong").write_bytes(b"shut sesame")
    assert main(["sign", "--key", "locked.pem", "--password-file", "wrong", "message"]) == 1
    assert capsys.readouterr().err.startswith("smcrypto: ")
