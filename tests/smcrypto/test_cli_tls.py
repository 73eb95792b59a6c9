"""`python -m smcrypto tls` against a server of our own, and against Tongsuo."""

from __future__ import annotations

import io
import socket
import subprocess
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

import tongsuo
from conftest import unavailable
from smcrypto.cli import main
from smcrypto.tls import SMContext, TLSError
from smcrypto.tls.sockets import SMSocket
from tls_authority import HOST, Authority

TIMEOUT = 20.0  # seconds; only a failure waits for so long


@pytest.fixture(scope="module")
def authority() -> Authority:
    return Authority.make()


@pytest.fixture
def folder(authority: Authority, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """Where the root's certificate and the client's files are; the server's name leads to this machine."""
    monkeypatch.chdir(tmp_path)
    Path("ca.pem").write_bytes(bytes(authority.root.certificate.to_pem()))
    authority.files(tmp_path, authority.client)
    look_up = socket.getaddrinfo

    def to_this_machine(host: str, *rest: Any, **options: Any) -> Any:
        return look_up("127.0.0.1" if host == HOST else host, *rest, **options)

    monkeypatch.setattr(socket, "getaddrinfo", to_this_machine)
    return tmp_path


@contextmanager
def serving(context: SMContext, serve: Callable[[SMSocket], None]) -> Iterator[int]:
    """The port of a server for one connection."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        listener.settimeout(TIMEOUT)

        def accept() -> None:
            plain, _ = listener.accept()
            plain.settimeout(TIMEOUT)
            try:
                with context.wrap_socket(plain, server_side=True) as connection:
                    serve(connection)
            except (TLSError, ConnectionError):
                pass

        thread = threading.Thread(target=accept)
        thread.start()
        yield listener.getsockname()[1]
        thread.join(TIMEOUT)


def answer(connection: SMSocket) -> None:
    request = b""
    while not request.endswith(b"\n"):
        request += connection.recv()
    connection.sendall(b"you said " + request)


def stdin(monkeypatch: pytest.MonkeyPatch, data: bytes) -> None:
    monkeypatch.setattr(sys, "stdin", io.TextIOWrapper(io.BytesIO(data)))


def test_what_stands_on_stdin_is_sent_and_the_answer_printed(
    authority: Authority, folder: Path, monkeypatch: pytest.MonkeyPatch, capfdbinary: pytest.CaptureFixture[bytes]
) -> None:
    stdin(monkeypatch, b"hello\n")
    with serving(authority.context("ECC_SM4_GCM_SM3", authority.server), answer) as port:
        assert main(["tls", f"{HOST}:{port}", "--ca", "ca.pem"]) == 0
    out, err = capfdbinary.readouterr()
    assert out == b"you said hello\n"
    lines = err.decode().splitlines()
    assert lines[:2] == ["protocol:    TLCPv1.1", "suite:       ECC_SM4_GCM_SM3"]
    assert sum(line.startswith("certificate: CN=server.example, issued by CN=root") for line in lines) == 2
    assert authority.server.certificate.fingerprint().hex() in err.decode()
    assert lines[-1] == "verdict:     trusted, and for server.example"


@pytest.mark.parametrize("suite", ["ECDHE_SM4_CBC_SM3", "TLS_SM4_CCM_SM3"])
def test_a_client_shows_its_certificates(
    authority: Authority, folder: Path, monkeypatch: pytest.MonkeyPatch, capfdbinary: pytest.CaptureFixture[bytes],
    suite: str,
) -> None:  # fmt: skip
    stdin(monkeypatch, b"")
    context = authority.context(suite, authority.server, verify_client="required")

    def serve(connection: SMSocket) -> None:
        connection.sendall(str(connection.peer_certificates[0].subject).encode())

    with serving(context, serve) as port:
        own = [part for kind in ("cert", "key", "enc-cert", "enc-key")
               for part in (f"--{kind}", f"client.example.{kind}.pem")]  # fmt: skip
        assert main(["tls", f"{HOST}:{port}", "--ca", "ca.pem", "--suite", suite, *own]) == 0
    assert capfdbinary.readouterr().out == b"CN=client.example"


def test_what_does_not_hold_is_exit_code_1(
    authority: Authority, folder: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    stdin(monkeypatch, b"hello\n")
    stranger = Authority.make()
    context = stranger.context("ECC_SM4_GCM_SM3", stranger.server)
    with serving(context, answer) as port:
        assert main(["tls", f"{HOST}:{port}", "--ca", "ca.pem"]) == 1
    out, err = capfd.readouterr()
    assert (out, err.count("\n")) == ("", 1)
    assert "issuer" in err
    with serving(authority.context("ECC_SM4_GCM_SM3", authority.server), answer) as port:
        assert main(["tls", f"127.0.0.1:{port}", "--ca", "ca.pem"]) == 1  # a certificate for another name
    assert "127.0.0.1" in capfd.readouterr().err


def test_an_answer_that_is_cut_is_exit_code_1(
    authority: Authority, folder: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    stdin(monkeypatch, b"")

    def cut(connection: SMSocket) -> None:
        connection.sendall(b"half of")
        socket.socket(fileno=connection.detach()).close()

    with serving(authority.context("ECC_SM4_GCM_SM3", authority.server), cut) as port:
        assert main(["tls", f"{HOST}:{port}", "--ca", "ca.pem"]) == 1
    out, err = capfd.readouterr()
    assert out == "half of"
    assert "close_notify" in err


NO_ADDRESSES = ["localhost", "localhost:", ":443", "localhost:0", "localhost:65536", "h:４４３", "h:" + "9" * 5000,
                ".:443", "a..b:443", "a" * 64 + ":443"]  # fmt: skip


@pytest.mark.parametrize("server", NO_ADDRESSES)
def test_an_address_is_host_and_port(folder: Path, server: str, capfd: pytest.CaptureFixture[str]) -> None:
    assert main(["tls", server, "--ca", "ca.pem"]) == 1
    assert "HOST:PORT" in capfd.readouterr().err


def test_files_that_are_none(folder: Path, capfd: pytest.CaptureFixture[str]) -> None:
    Path("empty").touch()
    assert main(["tls", "[::1]:443", "--ca", "empty"]) == 1
    assert "empty: " in capfd.readouterr().err
    assert main(["tls", "[::1]:443", "--ca", "ca.pem", "--cert", "client.example.cert.pem"]) == 1
    assert "key" in capfd.readouterr().err


@pytest.mark.service
def test_the_program_against_tongsuo(authority: Authority, folder: Path) -> None:
    """As a program of its own, whose stdin stays open: the server's end is the end."""
    if tongsuo.library() is None:
        unavailable("the package 'tongsuopy' is not installed")
    with socket.create_server(("127.0.0.1", 0)) as listener:
        command = [sys.executable, "-m", "smcrypto", "tls", f"localhost:{listener.getsockname()[1]}", "--ca", "ca.pem",
                   "--suite", "TLS_SM4_GCM_SM3"]  # fmt: skip
        local = authority.root.issue(
            "localhost", subject_alt_names=["DNS:localhost"], not_before=authority.root.certificate.not_before,
            not_after=authority.root.certificate.not_after,
        )  # fmt: skip
        context = tongsuo.Context("TLS_SM4_GCM_SM3", True, tongsuo.Identity(local.certificate, local.key))
        pipes = dict.fromkeys(("stdin", "stdout", "stderr"), subprocess.PIPE)
        with subprocess.Popen(command, **pipes) as program:
            assert program.stdin is not None and program.stdout is not None and program.stderr is not None
            plain, _ = listener.accept()
            plain.settimeout(TIMEOUT)
            peer = tongsuo.Peer(context)
            with plain:
                peer.handshake_over(plain)
                program.stdin.write(b"a question\n")
                program.stdin.flush()
                question = peer.read()
                while not question.endswith(b"\n"):
                    peer.receive(plain.recv(1 << 16))
                    question += peer.read()
                peer.write(b"answer to " + question)
                peer.close()
                plain.sendall(peer.to_send())
                assert program.stdout.read() == b"answer to a question\n"
                assert program.wait(TIMEOUT) == 0
            assert b"TLS_SM4_GCM_SM3" in program.stderr.read()
