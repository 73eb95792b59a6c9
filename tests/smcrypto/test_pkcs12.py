"""PKCS#12: openssl's files are read, it reads ours, and nothing is believed before the MAC holds."""

from __future__ import annotations

import subprocess
import sys
from collections.abc import Callable
from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from der_variants import opened
from smcrypto import (
    CertificateError,
    InvalidKey,
    InvalidOption,
    MissingDependency,
    SMCryptoError,
    der,
    pkcs12,
    sm2,
    x509,
)
from smcrypto.pkcs12 import Contents, Entry, dump, load
from smcrypto.sm2 import keyfiles
from smcrypto.sm2.keyfiles import write_pbes2

NOW = datetime(2026, 6, 1, tzinfo=timezone.utc)
KEY, ROOT_KEY = sm2.PrivateKey.from_int(0x1234567), sm2.PrivateKey.from_int(0x13579)
ROOT = x509.self_signed(ROOT_KEY, subject={"CN": "root"}, not_before=NOW, not_after=NOW + timedelta(99))
LEAF = x509.issue(x509.CertificateSigningRequest.create(KEY, subject={"CN": "robot"}), ROOT, ROOT_KEY,
                  not_before=NOW, not_after=NOW + timedelta(9))  # fmt: skip
PASSWORD = "密码 pass".encode()
FAST: dict[str, Any] = {"iterations": 3}
DATA, ENCRYPTED = "1.2.840.113549.1.7.1", "1.2.840.113549.1.7.6"
BAGS = "1.2.840.113549.1.12.10.1."


def openssl(require: Callable[[str], str], *arguments: str | Path, data: bytes = b"") -> bytes:
    done = subprocess.run([require("openssl"), *map(str, arguments)], input=data, capture_output=True, check=False)
    assert done.returncode == 0, done.stderr.decode()
    return done.stdout


@pytest.mark.parametrize("options", [
    ["-keypbe", "sm4-cbc", "-certpbe", "sm4-cbc", "-macalg", "sm3"],
    ["-keypbe", "sm4-cbc", "-certpbe", "NONE", "-macalg", "sha1"],
    ["-keypbe", "NONE", "-certpbe", "NONE", "-macalg", "sha224"],
    ["-keypbe", "NONE", "-certpbe", "sm4-cbc", "-macalg", "sha512", "-maciter"],
    ["-keypbe", "aes-256-cbc", "-certpbe", "aes-128-cbc", "-macalg", "sha384"],
    ["-keypbe", "sm4-cbc", "-certpbe", "sm4-cbc", "-macalg", "sha256", "-nomaciter"],
    ["-keypbe", "PBE-SHA1-3DES", "-certpbe", "PBE-SHA1-3DES", "-macalg", "sha1"],
    ["-keypbe", "PBE-SHA1-2DES", "-certpbe", "PBE-SHA1-2DES", "-macalg", "sha256"],
], ids=" ".join)  # fmt: skip
def test_files_of_openssl(options: list[str], tmp_path: Path, require: Callable[[str], str]) -> None:
    (tmp_path / "key.pem").write_bytes(KEY.to_pem())
    (tmp_path / "chain.pem").write_bytes(LEAF.to_pem() + ROOT.to_pem())
    (tmp_path / "password").write_bytes(PASSWORD)
    openssl(require, "pkcs12", "-export", "-inkey", tmp_path / "key.pem", "-in", tmp_path / "chain.pem", "-name", "n名",
            "-passout", f"file:{tmp_path}/password", "-out", tmp_path / "f.p12", *options)  # fmt: skip
    data = (tmp_path / "f.p12").read_bytes()
    assert load(data, PASSWORD) == Contents((Entry(KEY, LEAF, "n名"),), (ROOT,))
    with pytest.raises(InvalidKey, match="password is wrong"):
        load(data, b"another")


@pytest.mark.parametrize("options", [{}, {"mac": "sha256"}, {"mac": "sha256", "cipher": "aes256"}], ids=str)
def test_openssl_reads_ours(options: dict[str, Any], tmp_path: Path, require: Callable[[str], str]) -> None:
    data = dump([Entry(KEY, LEAF, "robot")], PASSWORD, others=[ROOT], prf="sha256", **options, **FAST)
    assert load(data, PASSWORD) == Contents((Entry(KEY, LEAF, "robot"),), (ROOT,))
    (tmp_path / "f.p12").write_bytes(data)
    (tmp_path / "password").write_bytes(PASSWORD)
    shown = openssl(require, "pkcs12", "-in", tmp_path / "f.p12", "-passin", f"file:{tmp_path}/password", "-nodes",
                    "-info")  # fmt: skip
    assert sm2.PrivateKey.from_pem(shown) == KEY and x509.load_pem_certificates(shown) == (LEAF, ROOT)
    assert b"friendlyName: robot" in shown


@pytest.mark.parametrize("prf", ["sm3", "sha256"])
def test_both_pairs_of_an_identity(prf: Any) -> None:
    other = sm2.PrivateKey.from_int(99)
    entries = (Entry(KEY, LEAF, "sign"), Entry(other, None, None))
    data = dump(entries, PASSWORD, others=[ROOT], prf=prf, **FAST)
    assert der.check(data) == data and load(data, PASSWORD) == Contents(entries, (ROOT,))
    alone = dump([Entry(other)], PASSWORD, prf=prf, iterations=1)
    assert load(alone, PASSWORD) == Contents((Entry(other),), ())


def test_a_key_that_is_there_twice_has_its_certificates_in_their_order() -> None:
    renewed = x509.self_signed(KEY, subject={"CN": "renewed"}, not_before=NOW, not_after=NOW + timedelta(99))
    entries = (Entry(KEY, LEAF, "old"), Entry(ROOT_KEY, None, None), Entry(KEY, renewed, "new"))
    others = (renewed, ROOT, LEAF)
    found = load(dump(entries, PASSWORD, others=others, **FAST), PASSWORD)
    # a certificate beside its key is that key's, whoever wrote it down as another one
    assert found == Contents((entries[0], Entry(ROOT_KEY, ROOT), entries[2]), (renewed, LEAF))


@pytest.mark.parametrize("call, error", [
    (lambda: dump([], b"p"), InvalidOption),
    (lambda: dump([Entry(KEY)], b""), InvalidOption),
    (lambda: dump([Entry(KEY)], b"\xff"), InvalidOption),
    (lambda: dump([Entry(KEY)], b"p", prf="md5"), InvalidOption),
    (lambda: dump([Entry(KEY)], b"p", mac="sha1"), InvalidOption),
    (lambda: dump([Entry(KEY)], b"p", cipher="aes"), InvalidOption),
    (lambda: dump([Entry(KEY)], b"p", iterations=0), InvalidOption),
    (lambda: dump([Entry(KEY)] * 10, b"p", iterations=1_000_000), InvalidOption),
    (lambda: dump([Entry(KEY, ROOT)], b"p", **FAST), InvalidKey),
    (lambda: dump([KEY], b"p"), TypeError),
    (lambda: dump([Entry(b"")], b"p"), TypeError),
    (lambda: dump([Entry(KEY, b"")], b"p", **FAST), TypeError),
    (lambda: dump([Entry(KEY)], b"p", others=[b""], **FAST), TypeError),
    (lambda: load(dump([Entry(KEY)], b"p", **FAST), b"\xff"), InvalidKey),
    (lambda: load(KEY.to_der(), b"p"), InvalidKey),
    (lambda: load("", b"p"), TypeError),
])  # fmt: skip
def test_what_is_refused(call: Callable[[], Any], error: type[Exception]) -> None:
    with pytest.raises(error):
        call()


# --- files of any shape ---

SM3_OID = "1.2.156.10197.1.401"


def pfx(safe: bytes, *, version: int = 3, kind: str = DATA, hash_name: str = SM3_OID, iterations: int | None = None,
        tag: bytes | None = None, mac: bool = True) -> bytes:  # fmt: skip
    """A file around an AuthenticatedSafe, its MAC right unless `tag` is given."""
    if tag is None:
        tag = pkcs12._mac(SM3_OID, pkcs12._bmp(b"p"), b"salt", iterations or 1, safe)
    data = der.sequence(
        der.sequence(der.sequence(der.oid(hash_name)), der.octet_string(tag)), der.octet_string(b"salt"),
        *([der.integer(iterations)] if iterations is not None else []))  # fmt: skip
    content = der.sequence(der.oid(kind), der.explicit(0, der.octet_string(safe)))
    return der.sequence(der.integer(version), content, *([data] if mac else []))


def plain(*bags: bytes) -> bytes:
    return der.sequence(der.sequence(der.oid(DATA), der.explicit(0, der.octet_string(der.sequence(*bags)))))


def bag(kind: str, value: bytes, *attributes: bytes) -> bytes:
    return der.sequence(der.oid(kind), der.explicit(0, value), *([der.set_of(*attributes)] if attributes else []))


def certificate(kind: str = "1.2.840.113549.1.9.22.1", data: bytes = LEAF.to_der()) -> bytes:
    return bag(BAGS + "3", der.sequence(der.oid(kind), der.explicit(0, der.octet_string(data))))


def encrypted(*, version: int = 0, kind: str = DATA, text: bytes | None = None) -> bytes:
    algorithm, sealed = write_pbes2(der.sequence(certificate()), b"p", "sm3", 2)
    info = der.sequence(der.oid(kind), algorithm, der.implicit(0, sealed if text is None else text))
    return der.sequence(
        der.sequence(der.oid(ENCRYPTED), der.explicit(0, der.sequence(der.integer(version), info))))


NAME = "1.2.840.113549.1.9.20"


def named(value: bytes) -> bytes:
    return bag(BAGS + "1", KEY.to_der(), der.sequence(der.oid(NAME), der.set_of(value)))


def test_shapes_that_are_taken() -> None:
    assert load(pfx(plain(bag(BAGS + "1", KEY.to_der()), certificate())), b"p").entries == (Entry(KEY, LEAF),)
    assert load(pfx(encrypted(), iterations=2), b"p") == Contents((), (LEAF,))
    assert load(pfx(plain(named(der.element(der.BMP_STRING, "n".encode("utf-16-be"))))), b"p").entries[0].name == "n"
    assert load(pfx(plain()), b"p") == Contents((), ())


@pytest.mark.parametrize("data", [
    pfx(plain(), version=2), pfx(plain(), kind=ENCRYPTED), pfx(plain(), mac=False), pfx(plain(), hash_name="1.2.3"),
    pfx(plain(), iterations=0), pfx(plain(), iterations=10**9, tag=bytes(32)),
    pfx(plain(), tag=bytes(32)), pfx(plain(), tag=b""),
    pfx(plain(bag("1.2.3", KEY.to_der()))), pfx(plain(bag(BAGS + "5", KEY.to_der()))),
    pfx(plain(bag(BAGS + "1", KEY.public_key.to_der()))), pfx(plain(certificate(kind="1.2.3"))),
    pfx(der.sequence(der.sequence(der.oid("1.2.3"), der.explicit(0, der.null())))),
    pfx(encrypted(version=1)), pfx(encrypted(kind="1.2.3")), pfx(encrypted(text=bytes(32))), pfx(encrypted(text=b"")),
    pfx(plain(named(der.element(der.BMP_STRING, b"odd")))), pfx(plain(named(der.null()))), pfx(b""), b"", b"\x30\x00",
], ids=range(22))  # fmt: skip
def test_shapes_that_are_refused(data: bytes) -> None:
    with pytest.raises(InvalidKey):
        load(data, b"p")


def test_contents_of_other_kinds_are_named() -> None:
    with pytest.raises(InvalidKey, match=r"contents of the kind 1\.2\.3"):
        load(pfx(der.sequence(der.sequence(der.oid("1.2.3"), der.explicit(0)))), b"p")


def asks_for(iterations: int) -> bytes:
    function = der.sequence(der.oid("1.2.840.113549.2.9"), der.null())
    derivation = der.sequence(der.oid("1.2.840.113549.1.5.12"),
                              der.sequence(der.octet_string(b"salt"), der.integer(iterations), function))
    cipher = der.sequence(der.oid("1.2.156.10197.1.104.2"), der.octet_string(bytes(16)))
    return der.sequence(der.oid("1.2.840.113549.1.5.13"), der.sequence(derivation, cipher))


def test_the_work_of_all_parts_together_is_bounded() -> None:
    key = bag(BAGS + "2", der.sequence(asks_for(5_000_001), der.octet_string(bytes(32))))
    with pytest.raises(InvalidKey, match="10000002 iterations in all"):
        load(pfx(plain(key, key)), b"p")
    info = der.sequence(der.oid(DATA), asks_for(5_000_001), der.implicit(0, bytes(32)))
    part = der.sequence(der.oid(ENCRYPTED), der.explicit(0, der.sequence(der.integer(0), info)))
    with pytest.raises(InvalidKey, match="10000002 iterations in all"):
        load(pfx(der.sequence(part, part)), b"p")


def test_a_certificate_that_is_none_is_named() -> None:
    with pytest.raises(CertificateError):
        load(pfx(plain(certificate(data=b"\x30\x00"))), b"p")


@given(st.data())
def test_alterations_are_refused_by_the_mac(draw: st.DataObject) -> None:
    data = bytearray(dump([Entry(KEY, LEAF)], b"p", **FAST))
    position = draw.draw(st.integers(0, len(data) - 1))
    data[position] ^= draw.draw(st.integers(1, 255))
    with pytest.raises(SMCryptoError):
        load(bytes(data), b"p")


def test_a_name_that_cannot_be_written() -> None:
    with pytest.raises(InvalidOption, match="surrogate"):
        dump([Entry(KEY, name="\ud800")], PASSWORD, **FAST)
    for entry, options in ((Entry(KEY, name=b"robot"), FAST), (Entry(KEY), {"iterations": "3"})):  # type: ignore[arg-type]
        with pytest.raises(TypeError):
            dump([entry], PASSWORD, **options)
    assert load(dump([Entry(KEY, name="机器人 🤖")], PASSWORD, **FAST), PASSWORD).entries[0].name == "机器人 🤖"


# --- neighbours of other algorithms, BER, old encryptions ---

SM2_CURVE, P256 = der.oid("1.2.156.10197.1.301"), der.oid("1.2.840.10045.3.1.7")  # of the same length
FOREIGN = x509.ForeignCertificate.from_der(LEAF.to_der().replace(SM2_CURVE, P256))
FOREIGN_KEY = bag(BAGS + "1", der.sequence(
    der.integer(0), der.sequence(der.oid("1.2.840.113549.1.1.1"), der.null()), der.octet_string(b"key")))  # fmt: skip


def test_certificates_and_keys_of_other_algorithms_do_no_harm() -> None:
    data = dump([Entry(KEY, LEAF)], b"p", others=[FOREIGN, ROOT], **FAST)
    assert load(data, b"p") == Contents((Entry(KEY, LEAF),), (FOREIGN, ROOT))
    ours = bag(BAGS + "1", KEY.to_der())
    for bags in ([FOREIGN_KEY, ours], [ours, FOREIGN_KEY]):
        assert load(pfx(plain(*bags, certificate(data=FOREIGN.to_der()), certificate())), b"p") == Contents(
            (Entry(KEY, LEAF),), (FOREIGN,))  # fmt: skip
    with pytest.raises(InvalidKey, match=r"1\.2\.840\.113549\.1\.1\.1, not SM2"):
        load(pfx(plain(FOREIGN_KEY)), b"p")
    with pytest.raises(InvalidKey, match="of another key"):  # a broken one of ours is not passed over
        load(pfx(plain(ours, bag(BAGS + "1", KEY.to_der()[:-1] + b"\0"))), b"p")


def indefinite(tag: int, *parts: bytes) -> bytes:
    return bytes((tag, 0x80)) + b"".join(parts) + b"\0\0"


def in_pieces(tag: int, content: bytes) -> bytes:
    return indefinite(tag, *(der.octet_string(content[i : i + 99]) for i in range(0, len(content), 99)))


def test_frames_in_ber() -> None:
    """As Bouncy Castle writes them; the MAC covers the content of the pieces (RFC 7292, 4)."""
    algorithm, sealed = write_pbes2(indefinite(0x30, indefinite(0x30, *opened(certificate()).rest())), b"p",
                                    "sm3", 2)  # fmt: skip
    info = indefinite(0x30, der.oid(DATA), algorithm, in_pieces(0xA0, sealed))
    part = indefinite(0x30, der.oid(ENCRYPTED), indefinite(0xA0, indefinite(0x30, der.integer(0), info)))
    safe = indefinite(0x30, part, *opened(plain(bag(BAGS + "1", KEY.to_der()))).rest())
    version, _, mac = opened(pfx(safe)).rest()
    data = indefinite(0x30, version, indefinite(0x30, der.oid(DATA), indefinite(0xA0, in_pieces(0x24, safe))), mac)
    assert load(data, b"p") == Contents((Entry(KEY, LEAF),), ())
    key = indefinite(0x30, *opened(KEY.to_der()).rest())
    with pytest.raises(InvalidKey, match="definite length"):  # keys are DER
        load(pfx(plain(bag(BAGS + "1", key))), b"p")


def old(kind: int, *parameters: bytes) -> bytes:
    scheme = der.sequence(der.oid(f"1.2.840.113549.1.12.1.{kind}"), der.sequence(*parameters))
    return pfx(plain(bag(BAGS + "2", der.sequence(scheme, der.octet_string(bytes(16))))))


@pytest.mark.parametrize("data, reason", [
    (old(6, der.octet_string(b"salt"), der.integer(1)), "encrypted by RC2"),
    (old(1, der.octet_string(b"salt"), der.integer(1)), "encrypted by RC4"),
    (old(9, der.octet_string(b"salt"), der.integer(1)), r"encrypted by 1\.2\.840\.113549\.1\.12\.1\.9"),
    (old(3, der.octet_string(b"salt"), der.integer(0)), "no iteration"),
    (old(3, der.octet_string(b"salt"), der.integer(1), der.null()), "left over"),
    (old(3, der.octet_string(b"salt"), der.integer(3_333_334)), "10000002 iterations in all"),
    (old(3, der.octet_string(b"salt"), der.integer(1)), "password is wrong"),
])  # fmt: skip
def test_what_old_encryptions_cannot_ask_for(data: bytes, reason: str) -> None:
    with pytest.raises(InvalidKey, match=reason):
        load(data, b"p")


def test_aes_and_old_files_need_a_package(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "cryptography.hazmat.primitives.ciphers", None)
    with pytest.raises(MissingDependency, match="AES needs the package 'cryptography'"):
        dump([Entry(KEY)], b"p", cipher="aes256", **FAST)
    with pytest.raises(MissingDependency, match="TripleDES needs the package 'cryptography'"):
        load(old(3, der.octet_string(b"salt"), der.integer(1)), b"p")


def test_keys_are_derived_as_an_outside_implementation_does() -> None:
    """PKCS12KDF of OpenSSL 3.0.22 (`openssl kdf`), SHA-1: a key longer than a hash, and the IV."""
    password, salt = pkcs12._bmp(b"smeg"), bytes.fromhex("0a58cf64530d823f")
    key = pkcs12._derive(pkcs12._hashlib("sha1"), 64, password, salt, 1, 1, 24)
    assert key.hex() == "8aaae6297b6cb04642ab5b077851284eb7128f1a2a7fbca3"
    assert pkcs12._derive(pkcs12._hashlib("sha1"), 64, password, salt, 1, 2, 8).hex() == "79993dfe048d3b76"


def test_just_as_many_iterations_are_written_as_all_keys_together_may_ask_for(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(keyfiles, "MAX_ITERATIONS", 6)  # of one key and of the certificates
    assert load(dump([Entry(KEY)], b"p", iterations=3), b"p").entries[0].key == KEY
    monkeypatch.setattr(keyfiles, "MAX_ITERATIONS", 5)
    with pytest.raises(InvalidOption, match="too many"):
        dump([Entry(KEY)], b"p", iterations=3)
