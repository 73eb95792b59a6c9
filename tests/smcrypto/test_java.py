"""Messages and PKCS#12 files to and from Bouncy Castle, which runs beside the tests in a process of its own.

BOUNCY_CASTLE names the folder with its jars and the class of java/BouncyCastle.java.
"""

from __future__ import annotations

import base64
import os
import subprocess
from collections.abc import Callable, Iterator
from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import Any

import pytest

from conftest import unavailable
from smcrypto import CertificateError, InvalidKey, InvalidSignature, cms, pkcs12, sm2, timestamp, x509

pytestmark = pytest.mark.service

NOW = datetime(2026, 6, 1, tzinfo=timezone.utc)
LATER = NOW + timedelta(36500)  # Bouncy Castle compares the signing time with the certificate's validity
KEY = sm2.PrivateKey.from_int(0x1234567)
CERTIFICATE = x509.self_signed(
    KEY, subject={"C": "CN", "CN": "a bank"}, not_before=NOW - timedelta(3650), not_after=LATER,
    key_usage=("digitalSignature", "keyEncipherment", "keyCertSign"))  # fmt: skip
TRUST: dict[str, Any] = {"roots": [CERTIFICATE], "at": NOW}
CONTENTS = [b"pay 10", bytes(range(256)) * 40]  # Java writes the longer one in several pieces

Java = Callable[..., bytes]


class JavaError(Exception):
    """What Bouncy Castle says where it refuses."""


@pytest.fixture(scope="module")
def java(require: Callable[[str], str]) -> Iterator[Java]:
    """`java(command, *arguments)` is Bouncy Castle's answer; JavaError where it refuses."""
    folder = os.environ.get("BOUNCY_CASTLE")
    if folder is None:
        unavailable("BOUNCY_CASTLE does not name a folder with Bouncy Castle")
    path = os.pathsep.join([str(folder), *map(str, Path(str(folder)).glob("*.jar"))])
    with subprocess.Popen([require("java"), "-cp", path, "BouncyCastle"], stdin=subprocess.PIPE,
                          stdout=subprocess.PIPE, text=True) as process:  # fmt: skip
        assert process.stdin is not None and process.stdout is not None
        pipes = process.stdin, process.stdout

        def ask(command: str, *arguments: bytes | None) -> bytes:
            words = ["-" if each is None else base64.b64encode(each).decode() for each in arguments]
            pipes[0].write(" ".join([command, *words]) + "\n")
            pipes[0].flush()
            kind, _, answer = pipes[1].readline().rstrip("\n").partition(" ")
            if kind != "ok":
                raise JavaError(answer)
            return base64.b64decode(answer)

        yield ask
        process.stdin.close()


@pytest.mark.parametrize("content", CONTENTS, ids=len)
@pytest.mark.parametrize("how", ["attached", "detached", "key"])
def test_signed_by_java(java: Java, content: bytes, how: str) -> None:
    data = java("sign", content, KEY.to_der(), CERTIFICATE.to_der(), how.encode())
    assert data[:2] == b"\x30\x80"  # BER, of indefinite length
    outside = content if how == "detached" else None
    found = cms.verify(data, **TRUST, content=outside)
    assert (found.content, found.signers) == (content, (CERTIFICATE,)) and found.times[0] is not None
    with pytest.raises(InvalidSignature):
        cms.verify(data, **TRUST, content=outside, uid=b"another")
    with pytest.raises(CertificateError):
        cms.verify(data, roots=[], at=NOW, content=outside)


@pytest.mark.parametrize("time", [None, NOW])
@pytest.mark.parametrize("detached", [False, True])
def test_java_verifies_what_is_signed_for_it(java: Java, time: datetime | None, detached: bool) -> None:
    data = cms.sign(b"pay 10", KEY, CERTIFICATE, signing_time=time, detached=detached, identifiers="rfc")
    assert cms.verify(data, **TRUST, content=b"pay 10" if detached else None).content == b"pay 10"
    assert java("verify", data, CERTIFICATE.to_der(), b"pay 10" if detached else None) == b"pay 10"
    if detached:
        with pytest.raises(JavaError):
            java("verify", data, CERTIFICATE.to_der(), b"pay 11")
    with pytest.raises(JavaError):  # what the documentation says of identifiers="gm"
        java("verify", cms.sign(b"pay 10", KEY, CERTIFICATE), CERTIFICATE.to_der(), None)


@pytest.mark.parametrize("content", CONTENTS, ids=len)
@pytest.mark.parametrize("named_by", ["issuer", "key"])
def test_envelopes_both_ways(java: Java, content: bytes, named_by: Any) -> None:
    pytest.importorskip("cryptography")  # for AES
    written = java("encrypt", content, CERTIFICATE.to_der(), named_by.encode())
    assert written[:2] == b"\x30\x80" and cms.decrypt(written, KEY, CERTIFICATE) == content
    ours = cms.encrypt(content, [CERTIFICATE], identifiers="rfc", named_by=named_by)
    assert java("decrypt", ours, KEY.to_der()) == content == cms.decrypt(ours, KEY, CERTIFICATE)


@pytest.mark.parametrize("kind", ["PKCS12-3DES-3DES", "PKCS12-AES256-AES128"])
def test_key_stores_of_java(java: Java, kind: str) -> None:
    pytest.importorskip("cryptography")  # for 3DES and AES
    data = java("store", KEY.to_der(), CERTIFICATE.to_der(), "密码".encode(), kind.encode())
    assert pkcs12.load(data, "密码".encode()).entries == (pkcs12.Entry(KEY, CERTIFICATE, "robot"),)
    with pytest.raises(InvalidKey, match="password is wrong"):
        pkcs12.load(data, b"another")


def test_a_key_store_by_rc2_is_refused_by_name(java: Java) -> None:
    data = java("store", KEY.to_der(), CERTIFICATE.to_der(), b"password", b"PKCS12")
    with pytest.raises(InvalidKey, match="encrypted by RC2"):
        pkcs12.load(data, b"password")


def test_java_reads_our_files(java: Java) -> None:
    pytest.importorskip("cryptography")
    entries, password = [pkcs12.Entry(KEY, CERTIFICATE, "a bank")], "密码".encode()
    data = pkcs12.dump(entries, password, cipher="aes256", prf="sha256", mac="sha256", iterations=1000)
    certificate, key = CERTIFICATE.to_der(), java("load", data, password)
    assert key.startswith(certificate) and sm2.PrivateKey.from_der(key[len(certificate) :]) == KEY
    with pytest.raises(JavaError):  # what the documentation says of the default
        java("load", pkcs12.dump(entries, password, iterations=1000), password)


def test_a_time_stamp_of_bouncy_castle(java: Java) -> None:
    request = x509.CertificateSigningRequest.create(KEY, subject={"CN": "authority"})
    authority = x509.issue(request, CERTIFICATE, KEY, not_before=NOW, not_after=LATER,
                           extended_key_usage=["timeStamping"])  # fmt: skip
    moment = NOW + timedelta(days=1, milliseconds=250)
    query = timestamp.request(b"a contract", nonce=99)
    answer = java("stamp", query, KEY.to_der(), authority.to_der(), str(round(moment.timestamp() * 1000)).encode())
    stamp = timestamp.verify(answer, b"a contract", roots=[CERTIFICATE], at=moment, nonce=99)
    assert stamp == timestamp.TimeStamp(moment, timedelta(milliseconds=20), "1.2.3.4", 7, authority)
    with pytest.raises(InvalidSignature, match="not of this content"):
        timestamp.verify(answer, b"another contract", roots=[CERTIFICATE], at=moment)
