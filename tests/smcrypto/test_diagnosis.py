"""`diagnose`: every form of every thing is recognised, what fits is said, and the call that it prints does read it."""

from __future__ import annotations

import base64
import hashlib
from pathlib import Path
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

import smcrypto
from smcrypto import InvalidKey, InvalidLength, diagnose, sm2, sm3, x509
from smcrypto.cli import main
from smcrypto.diagnosis import MAX_SIZE, Reading, key_of
from smcrypto.sm2.curve import SM2P256V1
from x509_authority import root

KEY = sm2.PrivateKey.from_int(0x3945208F7B2144B13F36E38AC6D39F95889393692860B51A42FB81EF4DF7C5B8)  # GB/T 32918.5, A.2
PUBLIC, OTHER = KEY.public_key, sm2.PrivateKey.from_int(0x1234567)
MESSAGE = b"message digest"
D, XY = KEY.to_bytes().hex(), PUBLIC.to_bytes()[1:].hex()

WRITTEN = {
    "bytes": lambda data: data,
    "hex": lambda data: data.hex(),
    "HEX with 0x and spaces": lambda data: "0x" + data.hex(" ").upper() + "\n",
    "hex with colons": lambda data: data.hex(":"),
    "base64": lambda data: base64.b64encode(data).decode(),
    "base64 for addresses": lambda data: base64.urlsafe_b64encode(data).rstrip(b"=").decode(),
    "hex in base64": lambda data: base64.b64encode(data.hex().encode()),
    "base64 in hex": lambda data: base64.b64encode(data).hex(),
}


def evaluated(reading: Reading, **names: Any) -> Any:
    """The Python that a diagnosis prints, run."""
    return eval(reading.call.partition("   #")[0], {"sm2": sm2, "x509": x509, "octets": reading.octets, **names})


@pytest.mark.parametrize("written", WRITTEN)
@pytest.mark.parametrize("form", ["der", "sec1", "raw", "raw after 00"])
def test_private_keys(form: str, written: str) -> None:
    octets = {"der": KEY.to_der(), "sec1": KEY.to_der(format="sec1"), "raw": KEY.to_bytes(),
              "raw after 00": b"\0" + KEY.to_bytes()}[form]  # fmt: skip
    data = WRITTEN[written](octets)
    [reading] = diagnose(data, key=PUBLIC).readings
    assert reading.what == "private key" and reading.verdict == "it is the given key's"
    assert D not in str(reading) and repr(KEY.to_bytes()) not in repr(reading), "the secret is not printed"
    assert diagnose(data, key=OTHER).readings[0].verdict == "it is another key than the one given"
    assert evaluated(reading) == KEY


@pytest.mark.parametrize("written", WRITTEN)
@pytest.mark.parametrize("form", ["der", "point", "compressed", "bare"])
def test_public_keys(form: str, written: str) -> None:
    octets = {"der": PUBLIC.to_der(), "point": PUBLIC.to_bytes(), "compressed": PUBLIC.to_bytes(compressed=True),
              "bare": PUBLIC.to_bytes()[1:]}[form]  # fmt: skip
    data = WRITTEN[written](octets)
    [reading] = diagnose(data, key=KEY).readings
    assert reading.what == "public key" and reading.verdict == "it belongs to the given key"
    assert diagnose(data, key=OTHER.public_key).readings[0].verdict == "it is of another key than the one given"
    assert diagnose(data).readings[0].verdict == ""
    assert evaluated(reading) == PUBLIC


@pytest.mark.parametrize("written", WRITTEN)
@pytest.mark.parametrize("encoding", ["der", "raw"])
@pytest.mark.parametrize("uid", [sm2.DEFAULT_UID, b"", b"ALICE123@YAHOO.COM"])
def test_signatures(uid: bytes, encoding: Any, written: str) -> None:
    data = WRITTEN[written](KEY.sign(MESSAGE, uid=uid, encoding=encoding))
    [reading] = diagnose(data, key=PUBLIC, message=MESSAGE, uid=b"ALICE123@YAHOO.COM").readings
    assert reading.what == "signature" and reading.verdict == f"holds for the key, with uid {uid!r}"
    evaluated(reading, key=PUBLIC, message=MESSAGE)
    assert "does not hold" in diagnose(data, key=PUBLIC, message=b"another").readings[0].verdict
    assert "give the message" in diagnose(data, key=PUBLIC).readings[0].verdict
    assert diagnose(data).readings[0].verdict == ""


@pytest.mark.parametrize("e, story", [
    (sm3.digest(MESSAGE), "e = SM3 of the message alone"),
    (hashlib.sha256(MESSAGE).digest(), "e = SHA-256 of the message alone"),
    (MESSAGE.rjust(32, b"\0"), "the message itself in the hash's place"),
])  # fmt: skip
def test_signatures_without_z(e: bytes, story: str) -> None:
    data = KEY.sign_digest(e, encoding="raw").hex()
    [reading] = diagnose(data, key=KEY, message=MESSAGE).readings
    assert story in reading.verdict and "holds" in reading.verdict
    evaluated(reading, key=PUBLIC, e=e)


def test_signatures_of_what_was_not_meant() -> None:
    def verdict(signature: bytes | str, message: bytes) -> str:
        return diagnose(signature, key=KEY, message=message).readings[0].verdict

    assert verdict(KEY.sign(b"m"), b"m\r\n").endswith("without its last line end")
    assert verdict(KEY.sign(b"\x01\xab"), b"01AB").endswith("of the bytes that the message spells in hex")
    assert verdict(KEY.sign(b"m".hex().encode()), b"m").endswith("of the message's hex digits as text")
    raw = KEY.sign(b"m", encoding="raw")
    exchanged = (raw[32:] + raw[:32]).hex()
    assert verdict(exchanged, b"m").endswith("; r and s are exchanged")
    evaluated(diagnose(exchanged, key=KEY, message=b"m").readings[0], key=PUBLIC, message=b"m")
    assert "does not hold" in verdict(raw, b"")
    assert diagnose(bytes(64)).readings == diagnose(b"\xff" * 64).readings == ()


@pytest.mark.parametrize("written", WRITTEN)
@pytest.mark.parametrize("bare", [False, True], ids=["with 04", "without 04"])
@pytest.mark.parametrize("encoding", ["der", "c1c3c2", "c1c2c3"])
def test_ciphertexts(encoding: Any, bare: bool, written: str) -> None:
    octets = PUBLIC.encrypt(MESSAGE, encoding=encoding)
    data = WRITTEN[written](octets[1:] if bare and encoding != "der" else octets)
    [reading] = diagnose(data, key=KEY).readings
    assert reading.what == "ciphertext" and reading.verdict == "opens with the key: 14 bytes"
    assert evaluated(reading, key=KEY) == MESSAGE
    expected = 1 if encoding == "der" else 2
    assert [r.verdict for r in diagnose(data, key=OTHER).readings] == ["does not open with the key"] * expected
    # Without the private key, nothing tells the orders apart.
    assert [r.verdict for r in diagnose(data, key=PUBLIC).readings] == [""] * expected


def test_pem_and_what_holds_keys() -> None:
    certificate = root().certificate
    request = x509.CertificateSigningRequest.create(KEY, subject={"CN": "robot"})
    holder = certificate.public_key
    for data, what, key in ((KEY.to_pem(), "private key", KEY), (PUBLIC.to_pem(), "public key", KEY),
                            (certificate.to_pem(), "certificate", holder),
                            (certificate.to_der(), "certificate", holder),
                            (request.to_pem(), "certificate signing request", KEY)):  # fmt: skip
        [reading] = diagnose(data, key=key).readings
        assert reading.what == what and reading.verdict in (
            "it is the given key's", "it belongs to the given key", "it holds the given key")  # fmt: skip
        assert evaluated(reading)
    assert diagnose(certificate.to_der(), key=KEY).readings[0].verdict == "it holds another key than the one given"
    assert diagnose(root().crl().to_pem(), key=KEY).readings[0].what == "revocation list"
    both = diagnose(KEY.to_pem() + b"and\n" + PUBLIC.to_pem())
    assert [reading.what for reading in both.readings] == ["private key", "public key"]


def test_encrypted_keys() -> None:
    sealed = KEY.to_pem(b"password", prf="sha256")
    assert "a password is needed" in str(diagnose(sealed)) and diagnose(sealed).readings == ()
    assert diagnose(sealed, password=b"password", key=KEY).readings[0].verdict == "it is the given key's"
    assert "the password is wrong" in diagnose(sealed, password=b"pass").remarks[0]
    assert evaluated(diagnose(sealed, password=b"password").readings[0], password=b"password") == KEY


def test_what_needs_another_package_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    def missing(*arguments: object) -> None:
        raise smcrypto.MissingDependency("needs the package 'cryptography'")

    monkeypatch.setattr(sm2.PrivateKey, "from_der", missing)
    assert diagnose(KEY.to_der()).remarks == ("needs the package 'cryptography'",)


def test_what_is_nearly_something_has_a_remark() -> None:
    assert "31 hex digits" not in str(diagnose("0" * 32))
    assert "odd number" in diagnose(D[:-1]).remarks[0]
    short = sm2.PrivateKey.from_int(5).to_bytes().hex()[1:]
    assert evaluated(diagnose(short).readings[0]) == sm2.PrivateKey.from_int(5)
    assert "END line" in diagnose(KEY.to_pem()[:-10]).remarks[0]
    for written in (b"  " + KEY.to_pem(), KEY.to_pem().replace(b"\n", b"\\n")):
        assert "no line is a PEM boundary" in diagnose(written).remarks[0]
    assert diagnose(b"\xef\xbb\xbf" + KEY.to_pem()).readings == diagnose(KEY.to_pem()).readings
    from cryptography.hazmat.primitives import serialization
    from cryptography.hazmat.primitives.asymmetric import ec

    foreign = ec.generate_private_key(ec.SECP256R1()).private_bytes(
        serialization.Encoding.DER, serialization.PrivateFormat.PKCS8, serialization.NoEncryption())  # fmt: skip
    assert "curve" in diagnose(foreign).remarks[0]
    assert diagnose("0" * 32).readings[0].what == "16 bytes" and diagnose(bytes(16)).readings == ()
    assert str(diagnose("?")) == "nothing of SM2 that is known here"
    assert diagnose(b"\xff" * 32).readings == () == diagnose(SM2P256V1.n.to_bytes(32, "big")).readings
    assert diagnose(b"\x30\x00").readings == diagnose(b"").readings == ()


def test_arguments() -> None:
    with pytest.raises(InvalidLength):
        diagnose(bytes(MAX_SIZE + 1))
    with pytest.raises(TypeError, match="key must be"):
        diagnose(b"", key=b"")  # type: ignore[arg-type]
    with pytest.raises(TypeError):
        diagnose(5)  # type: ignore[arg-type]


@given(st.binary(max_size=300) | st.text(max_size=300))
def test_nothing_else_is_raised(data: bytes | str) -> None:
    diagnose(data, key=KEY, message=b"m", password=b"p")


def test_keys_in_any_form_are_found() -> None:
    for data in (D.encode(), KEY.to_pem(), KEY.to_bytes(), KEY.to_der()):
        assert key_of(data) == KEY
    assert key_of(KEY.to_pem(b"pw", prf="sha256"), b"pw") == KEY
    assert key_of(XY.encode()) == PUBLIC == key_of(PUBLIC.to_pem())
    for data in (b"", b"abc", KEY.to_pem(b"pw", prf="sha256")):
        with pytest.raises(InvalidKey):
            key_of(data)


def test_refusals_point_to_it() -> None:
    with pytest.raises(smcrypto.InvalidSignature, match=r"smcrypto\.diagnose"):
        PUBLIC.verify(b"", b"")
    with pytest.raises(smcrypto.InvalidCiphertext, match=r"smcrypto\.diagnose"):
        KEY.decrypt(b"")


def test_on_the_command_line(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "key").write_text(D)
    (tmp_path / "message").write_bytes(MESSAGE)
    (tmp_path / "signature").write_text(KEY.sign(MESSAGE, uid=b"me").hex())
    (tmp_path / "password").write_text("password")
    (tmp_path / "sealed").write_bytes(KEY.to_pem(b"password", prf="sha256"))
    at = str(tmp_path)
    assert main(["diagnose", "--key", f"{at}/key", "--message", f"{at}/message", "--uid", "me", f"{at}/signature"]) == 0
    assert "holds for the key, with uid b'me'" in capsys.readouterr().out
    assert main(["diagnose", "--password-file", f"{at}/password", f"{at}/sealed"]) == 0
    assert "private key: DER, encrypted" in capsys.readouterr().out
    assert main(["diagnose", f"{at}/message"]) == 1
    assert "nothing of SM2" in capsys.readouterr().err
    assert main(["diagnose", "/dev/zero"]) == 1  # which has no end
    assert "at most 1048576 bytes" in capsys.readouterr().err


def test_a_points_64_bytes_are_no_signature() -> None:
    for d in range(1, 21):
        point = sm2.PrivateKey.from_int(d).public_key.to_bytes()[1:]
        assert [reading.what for reading in diagnose(point).readings] == ["public key"]


def test_bytes_that_begin_as_der_does_are_keys_all_the_same() -> None:
    """One in 256 raw keys begins with 30, the tag of SEQUENCE."""
    d = b"\x30" + bytes(range(200, 231))
    assert [reading.what for reading in diagnose(d).readings] == ["private key"]
    point = next(
        xy for d in range(1, 5000) if (xy := sm2.PrivateKey.from_int(d).public_key.to_bytes()[1:])[0] == 0x30
    )
    assert [reading.what for reading in diagnose(point).readings] == ["public key"]


def test_text_that_is_no_text_is_nothing() -> None:
    assert diagnose("\ud800").readings == ()
