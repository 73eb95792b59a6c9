"""Identities for TLS and TLCP in a line each, and the peers that run as programs: gmsm (Go) and bctls (Java)."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import datetime, timedelta
from functools import cached_property
from pathlib import Path
from typing import Any

import tongsuo
import x509_authority
from conftest import unavailable
from smcrypto import x509
from smcrypto.tls import SUITES, SMContext

HOST = "server.example"
TLCP = [name for name, (_, version) in SUITES.items() if version == "TLCPv1.1"]
TLS13 = [name for name, (_, version) in SUITES.items() if version == "TLSv1.3"]


@dataclass(frozen=True)
class Authority:
    """A CA, a server and a client, each with the two certificates of TLCP; valid now by the clock of the machine."""

    root: x509_authority.Holder
    server: tongsuo.Identity
    client: tongsuo.Identity

    @classmethod
    def make(cls) -> Authority:
        now = datetime.now(x509_authority.UTC).replace(microsecond=0)
        dates = {"not_before": now - timedelta(days=1), "not_after": now + timedelta(days=2)}
        root = x509_authority.root(**dates)

        def identity(name: str, purpose: str) -> tongsuo.Identity:
            options: dict[str, Any] = {"subject_alt_names": [f"DNS:{name}"], "extended_key_usage": [purpose]} | dates
            signing = root.issue(name, key_usage=["digitalSignature"], **options)
            encryption = root.issue(name, key_usage=x509.ENCRYPTION_KEY_USAGE, **options)
            return tongsuo.Identity(signing.certificate, signing.key, encryption.certificate, encryption.key)

        return cls(root, identity(HOST, "serverAuth"), identity("client.example", "clientAuth"))

    @property
    def roots(self) -> tuple[x509.Certificate, ...]:
        return (self.root.certificate,)

    def context(self, suite: str, identity: tongsuo.Identity | None = None, **options: Any) -> SMContext:
        """For one suite and its version."""
        own: dict[str, Any] = {}
        if identity is not None:
            own = {"certificates": (identity.certificate,), "key": identity.key}
            if suite in TLCP:
                own |= {
                    "encryption_certificate": identity.encryption_certificate,
                    "encryption_key": identity.encryption_key,
                }
        return SMContext(versions=(SUITES[suite][1],), suites=(suite,), roots=self.roots, **own, **options)

    def files(self, folder: Path, identity: tongsuo.Identity) -> dict[str, Path]:
        """The identity's PEM files, by what the options are called: cert, key, enc-cert, enc-key."""
        name = identity.certificate.subject.get("CN")
        assert identity.encryption_certificate is not None and identity.encryption_key is not None
        contents: dict[str, bytes | str] = {
            "cert": identity.certificate.to_pem(), "key": identity.key.to_pem(),
            "enc-cert": identity.encryption_certificate.to_pem(), "enc-key": identity.encryption_key.to_pem(),
        }  # fmt: skip
        paths = {kind: folder / f"{name}.{kind}.pem" for kind in contents}
        for kind, content in contents.items():
            paths[kind].write_bytes(content if isinstance(content, bytes) else content.encode())
        return paths


class Program:
    """A peer that runs as a program of its own; `lines` are what it says."""

    def __init__(self, command: list[str | Path], text: bytes = b"") -> None:
        self.process = subprocess.Popen([str(c) for c in command], stdin=subprocess.PIPE, stdout=subprocess.PIPE)
        assert self.process.stdin is not None and self.process.stdout is not None
        self.process.stdin.write(text)
        self.process.stdin.close()
        self._output = self.process.stdout

    def line(self) -> str:
        return self._output.readline().decode().rstrip("\n")

    @cached_property
    def port(self) -> int:
        return int(self.line().removeprefix("port "))

    def rest(self) -> bytes:
        return self._output.read()


@contextmanager
def program(command: list[str | Path], text: bytes = b"") -> Iterator[Program]:
    started = Program(command, text)
    try:
        yield started
    finally:
        started.process.kill()
        started.process.wait()


def gmsm() -> list[str | Path]:
    """The command of gmsm's peer; skips without GMSM_PEER."""
    path = os.environ.get("GMSM_PEER")
    if path is None:
        unavailable("GMSM_PEER does not name the program built of tests/smcrypto/tls/peers/gmsm")
    return [str(path)]


def bctls() -> list[str | Path]:
    """The command of bctls's peer; skips without BCTLS_PEER."""
    folder = os.environ.get("BCTLS_PEER")
    if folder is None:
        unavailable("BCTLS_PEER does not name the folder with bctls and the classes of tests/smcrypto/tls/peers/bctls")
    return ["java", "-XX:TieredStopAtLevel=1", "-cp", f"{folder}/*:{folder}", "BctlsPeer"]
