"""Both roles with peers that are programs: gmsm (TLCP, in Go) and bctls (RFC 8998, in Java), over sockets."""

from __future__ import annotations

import socket
from pathlib import Path

import pytest

from smcrypto.tls import SMContext
from tls_authority import HOST, TLS13, Authority, bctls, gmsm, program

pytestmark = pytest.mark.service

TIMEOUT = 60.0  # seconds; a Java program takes one or two to start
DATA = bytes(range(256)) * 150  # three records, and less than a pipe holds
Command = list[str | Path]


@pytest.fixture(scope="module")
def authority() -> Authority:
    return Authority.make()


def ask(command: Command, context: SMContext) -> str:
    """Our client to the server `command`: what the server says of the handshake."""
    with program(command) as server:
        plain = socket.create_connection(("127.0.0.1", server.port), timeout=TIMEOUT)
        with context.wrap_socket(plain, server_hostname=HOST) as client:
            client.sendall(DATA)
            with client.makefile("rb") as file:
                assert file.read(len(DATA)) == DATA
        return server.line()


def answer(command: Command, context: SMContext) -> str:
    """Our server to the client `command`, in which HOST and PORT stand for its address: what the client says."""
    with socket.create_server(("127.0.0.1", 0)) as listener:
        listener.settimeout(TIMEOUT)
        port = str(listener.getsockname()[1])
        with program([str(part).replace("PORT", port) for part in command], DATA) as client:
            plain, _ = listener.accept()
            plain.settimeout(TIMEOUT)
            with context.wrap_socket(plain, server_side=True) as server:
                while data := server.recv(1 << 16):
                    server.sendall(data)
            line = client.line()
            assert client.rest() == DATA
            return line


# --- gmsm ---


@pytest.mark.parametrize("authenticated", [False, True])
def test_our_client_and_a_server_of_gmsm(authority: Authority, tmp_path: Path, authenticated: bool) -> None:
    ca = tmp_path / "ca.pem"
    ca.write_bytes(bytes(authority.root.certificate.to_pem()))
    command = [*gmsm(), "server"]
    for kind, path in authority.files(tmp_path, authority.server).items():
        command += [f"-{kind}", path]
    if authenticated:
        command += ["-client-ca", ca]
    context = authority.context("ECC_SM4_CBC_SM3", authority.client if authenticated else None)
    assert ask(command, context) == f"done ECC_SM4_CBC_SM3 false {'client.example' if authenticated else '-'}"


@pytest.mark.parametrize("kinds", [(), ("cert", "key"), ("cert", "key", "enc-cert", "enc-key")])
def test_our_server_and_a_client_of_gmsm(authority: Authority, tmp_path: Path, kinds: tuple[str, ...]) -> None:
    """Left to itself it sends its signing certificate alone."""
    ca = tmp_path / "ca.pem"
    ca.write_bytes(bytes(authority.root.certificate.to_pem()))
    command = [*gmsm(), "client", "127.0.0.1:PORT", "-ca", ca, "-name", HOST]
    files = authority.files(tmp_path, authority.client)
    for kind in kinds:
        command += [f"-{kind}", files[kind]]
    context = authority.context("ECC_SM4_CBC_SM3", authority.server, verify_client="required" if kinds else "none")
    assert answer(command, context) == f"done ECC_SM4_CBC_SM3 false {HOST}"


# --- bctls ---


def der_files(folder: Path, name: str, authority: Authority) -> Command:
    identity = authority.server if name == "server" else authority.client
    certificate, key = folder / f"{name}.cert.der", folder / f"{name}.key.der"
    certificate.write_bytes(identity.certificate.to_der())
    key.write_bytes(identity.key.to_der())
    return ["-cert", certificate, "-key", key]


@pytest.mark.parametrize(("suite", "authenticated"), list(zip(TLS13, [True, False], strict=True)))
def test_our_client_and_a_server_of_bctls(
    authority: Authority, tmp_path: Path, suite: str, authenticated: bool
) -> None:
    command = [*bctls(), "server", suite, *der_files(tmp_path, "server", authority), "-alpn", "http/1.1"]
    context = authority.context(suite, authority.client if authenticated else None, alpn=("h2", "http/1.1"))
    if authenticated:
        command.append("-client-auth")
    expected = f"done {suite} http/1.1 {'CN=client.example' if authenticated else '-'}"
    assert ask(command, context) == expected


@pytest.mark.parametrize(
    ("suite", "options"),
    [(TLS13[0], ["-auth"]), (TLS13[1], []), (TLS13[0], ["-retry"]), (TLS13[1], ["-retry", "-auth"])],
)
def test_our_server_and_a_client_of_bctls(
    authority: Authority, tmp_path: Path, suite: str, options: list[str]
) -> None:
    command = [*bctls(), "client", suite, "127.0.0.1", "PORT", "-name", HOST, "-alpn", "http/1.1"]
    if "-retry" in options:  # HelloRetryRequest
        command.append("-retry")
    if "-auth" in options:
        command += der_files(tmp_path, "client", authority)
    context = authority.context(
        suite, authority.server, alpn=("http/1.1",), verify_client="required" if "-auth" in options else "none"
    )
    assert answer(command, context) == f"done {suite} http/1.1 CN={HOST}"
