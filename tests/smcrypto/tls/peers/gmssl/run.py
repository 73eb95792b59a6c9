"""smcrypto.tls against GmSSL 3.1's own programs, both roles, with certificates that GmSSL issued.

    python tests/smcrypto/tls/peers/gmssl/run.py [GMSSL]

GMSSL: the program `gmssl`, by default the one in PATH. GmSSL has one suite in each version, ECC_SM4_CBC_SM3 and
TLS_SM4_GCM_SM3, and no resumption. Prints a line for each connection; exit code 1 if one fails. Not run by pytest:
GmSSL has to be built by hand (its source is in the source distribution of easy-gmssl, too).
"""

from __future__ import annotations

import socket
import subprocess
import sys
import tempfile
import time
from dataclasses import replace
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[5]
sys.path[:0] = [str(ROOT / "src"), str(ROOT / "tests")]

from smcrypto import SMCryptoError, sm2, x509  # noqa: E402
from smcrypto.tls import SMContext  # noqa: E402

GMSSL = sys.argv[1] if len(sys.argv) > 1 else "gmssl"
PASSWORD = ("-pass", "1234")


class Files:
    """Keys and certificates in a folder, made by GmSSL."""

    def __init__(self, folder: Path) -> None:
        self.folder = folder
        self.key("ca")
        self.run("certgen", "-CN", "ca", "-days", "30", "-key", "ca.key", *PASSWORD, "-ca", "-path_len_constraint", "2",
                 "-key_usage", "keyCertSign", "-key_usage", "cRLSign", "-out", "ca.pem")  # fmt: skip
        for name, usage in (
            ("server", "digitalSignature"), ("server-enc", "keyEncipherment"),
            ("client", "digitalSignature"), ("client-enc", "keyEncipherment"),
        ):  # fmt: skip
            self.key(name)
            self.run("reqgen", "-CN", "localhost", "-key", f"{name}.key", *PASSWORD, "-out", f"{name}.req")
            self.run("reqsign", "-in", f"{name}.req", "-days", "30", "-cacert", "ca.pem", "-key", "ca.key", *PASSWORD,
                     "-key_usage", usage, "-subject_dns_name", "localhost", "-out", f"{name}.pem")  # fmt: skip
        for chain in (("server", "ca"), ("server", "server-enc", "ca"), ("client", "ca")):
            self.path("-and-".join(chain) + ".pem").write_bytes(b"".join(self.read(f"{name}.pem") for name in chain))

    def path(self, name: str) -> Path:
        return self.folder / name

    def read(self, name: str) -> bytes:
        return self.path(name).read_bytes()

    def run(self, *arguments: str) -> None:
        subprocess.run([GMSSL, *arguments], cwd=self.folder, check=True, capture_output=True)

    def key(self, name: str) -> None:
        self.run("sm2keygen", *PASSWORD, "-out", f"{name}.key", "-pubout", f"{name}.pub")

    def own(self, name: str, *, both: bool) -> dict[str, Any]:
        """The fields of a context for this holder."""
        certificate = x509.Certificate.from_pem
        found = {"certificates": (certificate(self.read(f"{name}.pem")),), "key": self.private(name)}
        if both:
            found["encryption_certificate"] = certificate(self.read(f"{name}-enc.pem"))
            found["encryption_key"] = self.private(f"{name}-enc")
        return found

    def private(self, name: str) -> sm2.PrivateKey:
        return sm2.PrivateKey.from_pem(self.read(f"{name}.key"), b"1234")


def free_port() -> int:
    with socket.create_server(("127.0.0.1", 0)) as probe:
        return int(probe.getsockname()[1])


def start(files: Files, *arguments: str) -> subprocess.Popen[bytes]:
    return subprocess.Popen([GMSSL, *arguments], cwd=files.folder, stdin=subprocess.PIPE, stdout=subprocess.PIPE,
                            stderr=subprocess.DEVNULL)  # fmt: skip


def as_client(files: Files, context: SMContext, *arguments: str) -> str:
    """GmSSL's server sends back what it reads."""
    port = free_port()
    program = start(files, *arguments, "-port", str(port))
    try:
        for _ in range(100):
            try:
                plain = socket.create_connection(("127.0.0.1", port), 5)
                break
            except ConnectionRefusedError:
                time.sleep(0.1)
        with context.wrap_socket(plain, server_hostname="localhost") as connection:
            connection.sendall(b"hello\n")
            if connection.recv(100) != b"hello\n":
                raise ValueError("another answer")
            return str(connection.cipher())
    finally:
        program.kill()


def as_server(files: Files, context: SMContext, *arguments: str) -> str:
    """GmSSL's client sends what it reads from stdin, and prints what it receives."""
    with socket.create_server(("127.0.0.1", 0)) as listening:
        listening.settimeout(10)
        program = start(files, *arguments, "-host", "127.0.0.1", "-port", str(listening.getsockname()[1]))
        try:
            plain, _ = listening.accept()
            plain.settimeout(10)
            with context.wrap_socket(plain, server_side=True) as connection:
                assert program.stdin is not None
                program.stdin.write(b"hello\n")
                program.stdin.flush()
                if connection.recv(100) != b"hello\n":
                    raise ValueError("another text")
                connection.sendall(b"the answer\n")
                assert program.stdout is not None
                while b"the answer" not in (line := program.stdout.readline()):
                    if not line:
                        raise ValueError("GmSSL did not print the answer")
                return str(connection.cipher())
        finally:
            program.kill()


def main() -> int:
    failed = 0
    with tempfile.TemporaryDirectory() as folder:
        files = Files(Path(folder))
        trusted = SMContext(roots=x509.load_pem_certificates(files.read("ca.pem")), sni=False)
        server13 = ("tls13_server", "-cert", "server-and-ca.pem", "-key", "server.key", *PASSWORD)
        server = ("tlcp_server", "-cert", "server-and-server-enc-and-ca.pem", "-key", "server.key", *PASSWORD,
                  "-ex_key", "server-enc.key", "-ex_pass", "1234")  # fmt: skip
        client = ("-cacert", "ca.pem")
        known = (*client, "-cert", "client-and-ca.pem", "-key", "client.key", *PASSWORD)
        for version, program, peer in (("TLCPv1.1", "tlcp", server), ("TLSv1.3", "tls13", server13)):
            one = replace(trusted, versions=(version,))
            identified = replace(one, **files.own("client", both=False))
            asking = replace(one, **files.own("server", both=True))
            for call, context, arguments in (
                (as_client, one, peer),
                (as_client, identified, (*peer, "-cacert", "ca.pem")),
                (as_server, asking, (f"{program}_client", *client)),
                (as_server, replace(asking, verify_client="required"), (f"{program}_client", *known)),
            ):
                shown = context is identified or context.verify_client == "required"
                what = f"{version} {call.__name__.replace('_', ' ')}, client certificate {'yes' if shown else 'no'}"
                try:
                    print(f"{what}: {call(files, context, *arguments)}")
                except (OSError, ValueError, SMCryptoError) as error:
                    print(f"{what}: FAILED, {error}")
                    failed = 1
    return failed


if __name__ == "__main__":
    sys.exit(main())
