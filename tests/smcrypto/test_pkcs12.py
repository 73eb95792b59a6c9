"""PKCS#12: openssl's files are read, it reads ours, and nothing is believed before the MAC holds."""

from __future__ import annotations

import subprocess
from collections.abc import Callable
from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from smcrypto import CertificateError, InvalidKey, InvalidOption, SMCryptoError, der, pkcs12, sm2, x509
from smcrypto.pkcs12 import Contents, Entry, dump, load

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


def test_openssl_reads_ours(tmp_path: Path, require: Callable[[str], str]) -> None:
    (tmp_path / "f.p12").write_bytes(dump([Entry(KEY, LEAF, "robot")], PASSWORD, others=[ROOT], prf="sha256", **FAST))
    (tmp_path / "password").write_bytes(PASSWORD)
    shown = openssl(require, "pkcs12", "-in", tmp_path / "f.p12", "-passin", f"file:{tmp_path}/password", "-nodes")
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
    from smcrypto.sm2.keyfiles import write_pbes2

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
