"""The invariant of fuzz/parsers.py, by hypothesis: valid files, altered, given to every reader."""

from __future__ import annotations

import base64
import importlib.util
from pathlib import Path

import pytest
from hypothesis import example, given
from hypothesis import strategies as st

from smcrypto import cms, der, pkcs12, sm2, x509
from x509_authority import NOW, root

PATH = Path(__file__).resolve().parents[2] / "fuzz" / "parsers.py"
_SPEC = importlib.util.spec_from_file_location("fuzz_parsers", PATH)
assert _SPEC is not None and _SPEC.loader is not None
parsers = importlib.util.module_from_spec(_SPEC)
_SPEC.loader.exec_module(parsers)

ROOT = root(extended_key_usage=("serverAuth",), subject_alt_names=("DNS:a", "URI:urn:b", "IP:::1", "dirName:CN=c"))
KEY = sm2.PrivateKey.generate()
P12 = pkcs12.dump([pkcs12.Entry(KEY)], b"password", others=[ROOT.certificate], iterations=2)
FILES = [
    KEY.to_der(),
    KEY.to_der(format="sec1"),
    KEY.to_pem(),
    KEY.public_key.to_der(),
    ROOT.certificate.subject.to_der(),
    ROOT.certificate.to_der(),
    ROOT.certificate.to_pem(),
    x509.CertificateSigningRequest.create(KEY, subject={"CN": "robot"}, subject_alt_names=("DNS:a",)).to_der(),
    ROOT.crl(x509.RevokedCertificate(7, NOW, "superseded")).to_der(),
    cms.sign(b"m", parsers._KEY, parsers._CERTIFICATE, signing_time=parsers._AT),
    cms.encrypt(b"m", [parsers._CERTIFICATE]),
    P12,
    pkcs12._authenticated(P12, b"password"),
    KEY.to_enveloped(parsers._KEY.public_key),
    base64.b64encode(der.sequence(der.integer(1), der.octet_string(
        parsers._KEY.public_key.encrypt(KEY.public_key.to_bytes()[1:] + KEY.to_bytes(), encoding="c1c3c2")[1:]))),
]


@given(st.integers(0, len(parsers.READERS) - 1), st.sampled_from(FILES), st.data())
def test_altered_files_break_no_invariant(reader: int, file: bytes, draw: st.DataObject) -> None:
    data = bytearray(file)
    for _ in range(draw.draw(st.integers(0, 3))):
        position = draw.draw(st.integers(0, len(data) - 1))
        match draw.draw(st.sampled_from(["change", "remove", "insert", "cut"])):
            case "change":
                data[position] = draw.draw(st.integers(0, 255))
            case "remove" if len(data) > 1:
                del data[position]
            case "insert":
                data.insert(position, draw.draw(st.integers(0, 255)))
            case "cut":
                del data[position + 1 :]
    parsers.check(bytes([reader]) + bytes(data))


@given(st.binary(max_size=100))
@example(b"")
def test_any_bytes_break_no_invariant(data: bytes) -> None:
    parsers.check(data)


def test_every_reader_accepts_some_file() -> None:
    """Otherwise the invariant would hold of nothing."""
    accepted = set()
    for reader in parsers.READERS:
        for file in FILES:
            try:
                reader(file)
            except parsers.SMCryptoError:
                continue
            accepted.add(reader)
    assert accepted == set(parsers.READERS)


def test_a_broken_invariant_is_reported() -> None:
    with pytest.raises(RuntimeError, match="invariant broken: name"):
        parsers._require(False, "name")
