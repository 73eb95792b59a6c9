"""The command line, run as a user would, and against the openssl program in both directions."""

from __future__ import annotations

import contextlib
import getpass
import hashlib
import hmac
import importlib
import io
import os
import pty
import runpy
import stat
import subprocess
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

import smcrypto
from smcrypto import __version__, sm2, sm3, sm4
from smcrypto.cli import digest, files, main

# A process of its own finds the package where this one did.
ENVIRONMENT = os.environ | {"PYTHONPATH": str(Path(smcrypto.__file__).parents[1])}
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


@pytest.mark.parametrize("name", ["a\nb", "a\\b", "plain"])
def test_names_are_escaped_as_sha256sum_does(name: str, folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    Path(name).write_bytes(b"abc")
    assert main(["hash", name]) == 0
    theirs = subprocess.run(["sha256sum", name], capture_output=True, check=True).stdout.decode()
    ours = capsys.readouterr().out
    assert ours.replace(ABC_DIGEST, "") == theirs.replace(hashlib.sha256(b"abc").hexdigest(), "")


def test_hash_reads_a_pipe() -> None:
    done = subprocess.run([sys.executable, "-m", "smcrypto", "hash"], input=b"abc", capture_output=True, check=True,
                          env=ENVIRONMENT)  # fmt: skip
    assert done.stdout == f"{ABC_DIGEST}  -\n".encode() and done.stderr == b""


def test_it_runs_as_a_program_and_only_then(folder: Path, monkeypatch: pytest.MonkeyPatch,
                                            capsys: pytest.CaptureFixture[str]) -> None:  # fmt: skip
    monkeypatch.setattr(sys, "argv", ["smcrypto", "hash", "message"])
    monkeypatch.delitem(sys.modules, "smcrypto.__main__", raising=False)
    importlib.import_module("smcrypto.__main__")
    del sys.modules["smcrypto.__main__"]
    assert capsys.readouterr().out == ""
    with pytest.raises(SystemExit) as exit:
        runpy.run_module("smcrypto", run_name="__main__")
    assert exit.value.code == 0
    assert capsys.readouterr().out == f"{sm3.digest(Path('message').read_bytes()).hex()}  message\n"


def test_hash_and_hmac_of_many_files(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    Path("large").write_bytes(bytes(files.CHUNK + 1))
    Path("empty").write_bytes(b"")
    names = ["large", "empty"]
    assert main(["hash", *names]) == 0
    assert capsys.readouterr().out == "".join(f"{sm3.digest(Path(n).read_bytes()).hex()}  {n}\n" for n in names)
    assert main(["hmac", "--key-file", "password", *names]) == 0
    mac = [hmac.new(Path("password").read_bytes(), Path(name).read_bytes(), sm3.SM3).hexdigest() for name in names]
    assert capsys.readouterr().out == f"{mac[0]}  large\n{mac[1]}  empty\n"


def test_hmac_is_that_of_openssl(
    folder: Path, openssl: Callable[..., bytes], capsys: pytest.CaptureFixture[str]
) -> None:
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
    key = bytes(16)
    Path("sm4.key").write_bytes(key)
    Path("sealed").write_bytes(sm4.encrypt(key, sm4.CBC(bytes(16)), bytes(3 << 20)))  # its end is no padding
    Path("opened").write_bytes(b"what was there before")
    before = sorted(folder.iterdir())
    assert main(["decrypt", "--sm4-key-file", "sm4.key", "--iv", "00" * 16, "-o", "opened", "sealed"]) == 1
    assert "padding" in capsys.readouterr().err
    assert sorted(folder.iterdir()) == before and Path("opened").read_bytes() == b"what was there before"


def test_a_key_that_cannot_be_written_leaves_nothing_behind(folder: Path, capsys: pytest.CaptureFixture[str]) -> None:
    Path("taken").mkdir()
    before = sorted(folder.iterdir())
    assert main(["keygen", "-o", "taken", "--force"]) == 1
    assert main(["keygen", "-o", "absent/key.pem"]) == 1
    assert sorted(folder.iterdir()) == before


@pytest.mark.parametrize("arguments, says", [
    (["hash", "absent"], "absent: No such file"),
    (["sign", "--key", "absent.pem", "message"], "absent.pem"),
    (["sign", "--key", "message", "message"], "smcrypto: "),
    (["decrypt", "--password-file", "password", "message"], "Salted__"),
    (["encrypt", "--sm4-key-file", "password", "--iv", "zz", "message"], "hex"),
    (["encrypt", "--sm4-key-file", "password", "--iv", "00" * 16, "message"], "16 bytes"),
    (["encrypt", "--password-env", "UNSET_VARIABLE", "message"], "UNSET_VARIABLE"),
    (["encrypt", "--password-file", "empty", "message"], "no password in empty"),
    (["encrypt", "message"], "a password is needed"),
    (["encrypt", "--password-file", "password", "--iterations", "0", "message"], "iterations must be"),
    (["encrypt", "--password-file", "password", "--iv", "00", "message"], "--iv belongs to"),
    (["encrypt", "--sm4-key-file", "sm4.key", "message"], "needs --iv"),
    (["encrypt", "--sm4-key-file", "sm4.key", "--iv", "00", "message"], "iv must be 16 bytes"),
    (["encrypt", "--to", "pub.pem", "--mode", "ctr", "message"], "--to takes no --mode"),
    (["encrypt", "--sm4-key-file", "sm4.key", "--iv", "00" * 16, "--to", "pub.pem", "message"], "neither --to"),
    (["decrypt", "--sm4-key-file", "sm4.key", "--iv", "00" * 16, "--key", "key.pem", "message"], "neither --key"),
    (["decrypt", "--sm4-key-file", "sm4.key", "--iv", "00" * 16, "--password-file", "password"], "nor a password"),
    (["encrypt", "--to", "pub.pem", "--password-file", "password", "message"], "without a password"),
    (["decrypt", "--password-file", "password", "empty"], "Salted__"),
    (["keygen", "-o", "new.pem", "--format", "sec1", "--password-file", "password"], "SEC1"),
    (["keygen", "-o", "new.pem", "--public", "new.pem"], "the same file"),
    (["keygen", "-o", "absent/new.pem"], "absent/new.pem: No such file"),
    (["verify", "--public", "message", "--signature", "message", "message"], "smcrypto: "),
    (["hmac", "--key-file", "absent", "message"], "absent: No such file"),
    (["hash", "."], "Is a directory"),
])
def test_mistakes_end_in_one_line_and_exit_code_1(
    folder: Path, arguments: list[str], says: str, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    Path("empty").write_bytes(b"")
    Path("sm4.key").write_bytes(bytes(16))
    monkeypatch.setattr(sys, "stdin", SimpleNamespace(buffer=io.BytesIO(), isatty=lambda: False))
    before = sorted(folder.iterdir())
    assert main(arguments) == 1
    printed = capsys.readouterr()
    assert says in printed.err and printed.err.count("\n") == 1 and printed.out == ""
    assert sorted(folder.iterdir()) == before


def test_a_command_line_that_makes_no_sense_exits_with_2() -> None:
    with pytest.raises(SystemExit) as exit:
        main(["no-such-command"])
    assert exit.value.code == 2


def test_a_password_for_a_key_that_is_not_encrypted_is_refused(keys: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["sign", "--key", "key.pem", "--password-file", "password", "-o", "sig", "message"]) == 1
    assert "the private key is not encrypted" in capsys.readouterr().err
    assert not Path("sig").exists()


def test_names_that_the_terminal_cannot_write_are_escaped(folder: Path) -> None:
    Path("报文").write_bytes(b"abc")
    done = subprocess.run([sys.executable, "-m", "smcrypto", "hash", "报文"], capture_output=True, check=True,
                          env=ENVIRONMENT | {"PYTHONIOENCODING": "ascii"})  # fmt: skip
    assert done.stdout == f"{ABC_DIGEST}  \\u62a5\\u6587\n".encode() and done.stderr == b""
    done = subprocess.run([sys.executable, "-m", "smcrypto", "ca", "verify", "--help"], capture_output=True, check=True,
                          env=ENVIRONMENT | {"PYTHONIOENCODING": "ascii"})  # fmt: skip
    assert b"serverAuth, \\u2026" in done.stdout


def test_output_goes_wherever_stdout_was_redirected_to(folder: Path) -> None:
    Path("报文").write_bytes(b"abc")
    with contextlib.redirect_stdout(io.StringIO()) as redirected:
        assert main(["hash", "报文"]) == 0
    assert redirected.getvalue() == f"{ABC_DIGEST}  报文\n"


def test_an_encrypted_key_needs_its_password(keys: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["keygen", "-o", "locked.pem", "--password-file", "password"]) == 0
    assert b"ENCRYPTED" in Path("locked.pem").read_bytes()
    assert main(["sign", "--key", "locked.pem", "--password-file", "password", "-o", "sig", "message"]) == 0
    Path("wrong").write_bytes(b"shut sesame")
    assert main(["sign", "--key", "locked.pem", "--password-file", "wrong", "message"]) == 1
    assert capsys.readouterr().err.startswith("smcrypto: ")


def test_bytes_go_through_pipes_unchanged(keys: Path) -> None:
    def run(*arguments: str, data: bytes) -> bytes:
        return subprocess.run(
            [sys.executable, "-m", "smcrypto", *arguments],
            input=data, capture_output=True, check=True, env=ENVIRONMENT,
        ).stdout  # fmt: skip

    data = bytes(range(256)) * 3
    sealed = run("encrypt", "--to", "pub.pem", "--encoding", "c1c3c2", data=data)
    assert len(sealed) == len(data) + 97
    assert run("decrypt", "--key", "key.pem", "--encoding", "c1c3c2", "-", data=sealed) == data
    signature = run("sign", "--key", "key.pem", "--encoding", "raw", data=data)
    sm2.PublicKey.from_pem(Path("pub.pem").read_bytes()).verify(signature, data, encoding="raw")
    common = ["--password-file", "password", "--iterations", "1000"]
    assert run("decrypt", *common, data=run("encrypt", *common, data=data)) == data


def test_a_closed_pipe_is_no_traceback(keys: Path) -> None:
    large = Path("large")
    large.write_bytes(bytes(4 << 20))
    Path("sm4.key").write_bytes(bytes(16))
    with subprocess.Popen(
        [sys.executable, "-m", "smcrypto", "encrypt", "--sm4-key-file", "sm4.key", "--iv", "00" * 16, "large"],
        stdout=subprocess.PIPE, stderr=subprocess.PIPE, env=ENVIRONMENT,
    ) as process:  # fmt: skip
        assert process.stdout is not None and process.stderr is not None
        process.stdout.read(10)
        process.stdout.close()
        assert process.stderr.read() == b""
    assert process.returncode == 1


def test_a_pipe_that_nobody_reads_is_noticed_before_the_end(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    reader, writer = os.pipe()
    os.close(reader)
    with os.fdopen(writer, "w") as stdout:
        monkeypatch.setattr(sys, "stdout", stdout)
        assert main(["hash", "message"]) == 1  # one short line, which waits in a buffer
    assert capfd.readouterr().err == ""


def test_stdin_is_read_where_no_file_is_named(
    folder: Path, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    for arguments in (["hash"], ["hash", "-"]):
        monkeypatch.setattr(sys, "stdin", SimpleNamespace(buffer=io.BytesIO(b"abc")))
        assert main(arguments) == 0
        assert capsys.readouterr().out == f"{ABC_DIGEST}  -\n"


@pytest.mark.parametrize("error, code", [(KeyboardInterrupt, 130), (MemoryError, 1)])
def test_what_stops_a_command_has_its_exit_code(
    folder: Path, monkeypatch: pytest.MonkeyPatch, error: type[BaseException], code: int
) -> None:
    def interrupted(name: str) -> Iterator[bytes]:
        raise error

    monkeypatch.setattr(digest, "chunks", interrupted)
    assert main(["hash", "message"]) == code


def test_version_and_help_name_every_command(capsys: pytest.CaptureFixture[str]) -> None:
    for option in ("--version", "--help"):
        with pytest.raises(SystemExit) as exit:
            main([option])
        assert exit.value.code == 0
    printed = capsys.readouterr().out
    assert f"smcrypto {__version__}" in printed
    for command in ("hash", "hmac", "keygen", "pubkey", "sign", "verify", "encrypt", "decrypt", "ca"):
        assert f"\n    {command}" in printed
        with pytest.raises(SystemExit) as exit:
            main([command, "--help"])
        assert exit.value.code == 0 and f"smcrypto {command}" in capsys.readouterr().out


def test_a_private_key_keeps_its_password_out_of_the_command_line(
    keys: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("KEY_PASSWORD", "open sesame")
    assert main(["keygen", "-o", "locked.pem", "--password-env", "KEY_PASSWORD", "--public", "locked.pub"]) == 0
    key = sm2.PrivateKey.from_pem(Path("locked.pem").read_bytes(), b"open sesame")
    assert key.public_key.to_pem() == Path("locked.pub").read_bytes()
    assert main(["pubkey", "--key", "locked.pem", "--password-env", "KEY_PASSWORD", "-o", "again.pub"]) == 0
    assert Path("again.pub").read_bytes() == Path("locked.pub").read_bytes()


def test_sec1_keys_are_written_and_read(folder: Path, openssl: Callable[..., bytes]) -> None:
    assert main(["keygen", "-o", "key.pem", "--format", "sec1", "--public", "pub.pem"]) == 0
    assert Path("key.pem").read_bytes().startswith(b"-----BEGIN EC PRIVATE KEY-----")
    assert openssl("pkey", "-in", "key.pem", "-pubout") == Path("pub.pem").read_bytes()


@pytest.mark.parametrize("command, path", [
    (["keygen", "-o", "key.pem"], "key.pem"),
    (["ca", "init", "--dir", "fleet", "--subject", "CN=x"], "fleet/ca.key.pem"),
])  # fmt: skip
def test_openssl_reads_our_encrypted_keys_where_it_is_asked_for(
    folder: Path, command: list[str], path: str, openssl: Callable[..., bytes]
) -> None:
    assert main([*command, "--password-file", "password", "--prf", "sha256"]) == 0
    assert main(["pubkey", "--key", path, "--password-file", "password", "-o", "pub.pem"]) == 0
    assert openssl("pkey", "-in", path, "-passin", "file:password", "-pubout") == Path("pub.pem").read_bytes()


@pytest.mark.parametrize("cipher", ["-aes-256-cbc", "-sm4-cbc"])
def test_an_encrypted_key_of_openssl_opens_with_its_password(
    folder: Path, cipher: str, openssl: Callable[..., bytes]
) -> None:
    if cipher != "-sm4-cbc":
        pytest.importorskip("cryptography")
    openssl("genpkey", "-algorithm", "SM2", cipher, "-pass", "file:password", "-out", "key.pem")
    openssl("pkey", "-in", "key.pem", "-passin", "file:password", "-pubout", "-out", "pub.pem")
    assert main(["pubkey", "--key", "key.pem", "--password-file", "password", "-o", "ours.pem"]) == 0
    assert Path("ours.pem").read_bytes() == Path("pub.pem").read_bytes()


# --- prompts ---


@pytest.fixture
def typed(monkeypatch: pytest.MonkeyPatch) -> Callable[..., list[str]]:
    """What a user types at the prompts; gives the list of prompts that were shown."""

    def answer(*passwords: str) -> list[str]:
        prompts: list[str] = []
        waiting = list(passwords)

        def ask(prompt: str) -> str:
            prompts.append(prompt)
            return waiting.pop(0)

        monkeypatch.setattr(getpass, "getpass", ask)
        monkeypatch.setattr(sys, "stdin", SimpleNamespace(isatty=lambda: True))
        return prompts

    return answer


def test_a_new_password_is_asked_for_twice(folder: Path, typed: Callable[..., list[str]]) -> None:
    prompts = typed("öffne dich", "öffne dich")
    assert main(["keygen", "-o", "key.pem", "--encrypt"]) == 0
    assert prompts == ["New password: ", "New password (again): "]
    assert sm2.PrivateKey.from_pem(Path("key.pem").read_bytes(), "öffne dich".encode())
    prompts = typed("öffne dich")
    assert main(["sign", "--key", "key.pem", "-o", "sig", "message"]) == 0
    assert prompts == ["Password for key.pem: "]


def test_what_was_encrypted_at_a_prompt_is_decrypted_at_one(folder: Path, typed: Callable[..., list[str]]) -> None:
    typed("sesame", "sesame")
    assert main(["encrypt", "--iterations", "1000", "-o", "sealed", "message"]) == 0
    prompts = typed("sesame")
    assert main(["decrypt", "--iterations", "1000", "-o", "opened", "sealed"]) == 0
    assert Path("opened").read_bytes() == Path("message").read_bytes() and prompts == ["Password: "]


@pytest.mark.parametrize("answers, says", [(("one", "two"), "differ"), (("", ""), "no password in the prompt")])
def test_a_mistyped_or_empty_password_writes_nothing(
    folder: Path, typed: Callable[..., list[str]], answers: tuple[str, ...], says: str,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    typed(*answers)
    assert main(["keygen", "-o", "key.pem", "--encrypt"]) == 1
    assert says in capsys.readouterr().err and not Path("key.pem").exists()


def test_no_password_is_asked_for_when_the_key_would_not_be_written(
    keys: Path, typed: Callable[..., list[str]], capsys: pytest.CaptureFixture[str]
) -> None:
    prompts = typed("never", "typed")
    assert main(["keygen", "-o", "key.pem", "--encrypt"]) == 1
    assert prompts == [] and "--force" in capsys.readouterr().err


# --- progress ---


@contextmanager
def terminal() -> Iterator[Callable[[], str]]:
    """stderr is a terminal; gives what it shows."""
    leader, follower = pty.openpty()
    with os.fdopen(follower, "w", buffering=1) as stderr, pytest.MonkeyPatch.context() as monkeypatch:
        monkeypatch.setattr(sys, "stderr", stderr)

        def shown() -> str:
            print("END", file=stderr)  # a terminal delivers in order, though not at once
            text = ""
            while not text.endswith("END\r\n"):
                text += os.read(leader, 1 << 16).decode()
            return text.removesuffix("END\r\n")

        yield shown
    os.close(leader)


@pytest.fixture
def large(folder: Path) -> Path:
    path = folder / "large"
    with path.open("wb") as stream:
        stream.truncate(files.PROGRESS_FROM)  # a hole: no disk is filled
    return path


def test_a_large_file_shows_progress_on_a_terminal(large: Path) -> None:
    with terminal() as shown:
        pieces = [len(piece) for piece in files.chunks("large")]
        lines = shown().replace("\r\n", "\n").split("\r")
    assert pieces == [files.CHUNK] * (files.PROGRESS_FROM // files.CHUNK)
    assert lines[0] == "" and len(lines) == 1 + len(pieces)
    assert lines[8] == f"large [{'#' * 20}{'.' * 20}]  50%" and lines[-1] == f"large [{'#' * 40}] 100%\n"


def test_a_small_file_shows_none(folder: Path) -> None:
    with terminal() as shown:
        assert sum(map(len, files.chunks("message"))) == 1200
        assert shown() == ""


def test_no_progress_goes_into_a_pipe(large: Path, capfd: pytest.CaptureFixture[str]) -> None:
    assert sum(map(len, files.chunks("large"))) == files.PROGRESS_FROM
    assert capfd.readouterr() == ("", "")


def test_a_file_that_grows_while_it_is_read_stays_at_100_percent(large: Path) -> None:
    with terminal() as shown:
        reading = files.chunks("large")
        next(reading)
        with large.open("r+b") as stream:
            stream.truncate(files.PROGRESS_FROM + (2 << 20))
        assert sum(map(len, reading)) == files.PROGRESS_FROM + (1 << 20)
        assert shown().count("100%") == 3


# --- files ---


def test_output_takes_the_mode_that_the_umask_leaves(keys: Path) -> None:
    before = os.umask(0o027)
    try:
        assert main(["pubkey", "--key", "key.pem", "-o", "new.pem"]) == 0
    finally:
        os.umask(before)
    assert stat.S_IMODE(os.stat("new.pem").st_mode) == 0o640


def test_output_into_a_device_does_not_replace_it(keys: Path, tmp_path: Path) -> None:
    os.mkfifo("fifo")
    reader = os.open("fifo", os.O_RDONLY | os.O_NONBLOCK)
    try:
        assert main(["pubkey", "--key", "key.pem", "-o", "fifo"]) == 0
        assert os.read(reader, 1 << 16) == Path("pub.pem").read_bytes()
    finally:
        os.close(reader)
    assert stat.S_ISFIFO(os.stat("fifo").st_mode)


def test_output_through_a_link_goes_where_it_leads(keys: Path) -> None:
    Path("target").write_bytes(b"old")
    Path("link").symlink_to("target")
    assert main(["pubkey", "--key", "key.pem", "-o", "link"]) == 0
    assert Path("link").is_symlink() and Path("target").read_bytes() == Path("pub.pem").read_bytes()


@pytest.mark.parametrize("command, closed, code, says", [
    ("hash", ["stdin"], 1, "stdin or stdout is closed"), ("hash message", ["stdout"], 1, "stdin or stdout is closed"),
    ("pubkey --key key.pem", ["stdout"], 1, "stdin or stdout is closed"), ("hash absent", ["stderr"], 1, ""),
    ("keygen --encrypt -o new.pem", ["stdin"], 1, "a password is needed"), ("hash message", ["stdin"], 0, ""),
    ("pubkey --key key.pem -o new.pem", ["stdin", "stdout", "stderr"], 0, ""),
])  # fmt: skip
def test_streams_that_were_closed_before(
    keys: Path, command: str, closed: list[str], code: int, says: str, monkeypatch: pytest.MonkeyPatch,
    capsys: pytest.CaptureFixture[str],
) -> None:  # fmt: skip
    for name in closed:
        monkeypatch.setattr(sys, name, None)  # as Python has it then
    assert main(command.split()) == code
    for name in closed:
        getattr(sys, name).close()
    printed = capsys.readouterr()
    assert says in printed.err and printed.err.count("\n") == bool(says)
    assert bool(printed.out) == (command == "hash message" and code == 0)


def test_a_distinguishing_id_is_the_bytes_of_the_command_line(keys: Path) -> None:
    """Also where they are no text in the user's encoding."""
    arguments: list[Any] = [sys.executable, "-m", "smcrypto", "sign", "--key", "key.pem", "-o", "sig", "message"]
    subprocess.run([*arguments, "--uid", b"robot\xff"], check=True, env=ENVIRONMENT)
    public = sm2.PublicKey.from_pem(Path("pub.pem").read_bytes())
    public.verify(Path("sig").read_bytes(), Path("message").read_bytes(), uid=b"robot\xff")
