"""SM2 key files: what OpenSSL, Tongsuo and cloud services write is read, OpenSSL reads ours, the rest is refused."""

from __future__ import annotations

import builtins
import hashlib
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

from der_variants import overfull, unchecked
from smcrypto import (
    InvalidKey,
    InvalidOption,
    InvalidPadding,
    MissingDependency,
    SMCryptoError,
    cbc,
    der,
    kdf,
    pem,
    sm2,
    sm3,
    sm4,
)
from smcrypto.sm2 import keyfiles
from vectors_json import load

KEY = sm2.PrivateKey.from_int(0x3945208F7B2144B13F36E38AC6D39F95889393692860B51A42FB81EF4DF7C5B8)  # GB/T 32918.5, A.2
POINT = KEY.public_key.to_bytes()
OTHER = sm2.PrivateKey.from_int(0x1234567)
SM2_OID = "1.2.156.10197.1.301"
P256_OID = "1.2.840.10045.3.1.7"
EC_OID = "1.2.840.10045.2.1"


@pytest.fixture(scope="module")
def openssl(require: Callable[[str], str]) -> Callable[..., bytes]:
    program = require("openssl")

    def run(*arguments: str | Path, data: bytes = b"") -> bytes:
        done = subprocess.run([program, *map(str, arguments)], input=data, capture_output=True, check=False)
        assert done.returncode == 0, done.stderr.decode()
        return done.stdout

    return run


# --- other people's files ---


@pytest.mark.parametrize("v", load("third_party/x509.json", "keys"))
def test_keys_of_other_projects(v: SimpleNamespace) -> None:
    data = v.pem.encode()
    if getattr(v, "result", "valid") == "invalid":
        with pytest.raises(InvalidKey):
            sm2.PrivateKey.from_pem(data)
    elif getattr(v, "private_key", None):
        key = sm2.PrivateKey.from_pem(data)
        assert key.to_bytes() == v.private_key
        assert key.public_key.to_bytes() == v.public_key
    else:
        assert sm2.PublicKey.from_pem(data).to_bytes() == v.public_key


@pytest.mark.parametrize("v", load("third_party/x509.json", "keys"))
def test_a_file_that_has_lines_ended_by_crlf_and_text_before(v: SimpleNamespace) -> None:
    if v.source.endswith(("bad_0.pem", "bad_1.pem", "bad_neg1.pem")):
        return
    data = b"Bag Attributes\r\n    friendlyName: robot\r\n" + v.pem.encode().replace(b"\n", b"\r\n")
    if getattr(v, "private_key", None):
        assert sm2.PrivateKey.from_pem(data).to_bytes() == v.private_key
    else:
        assert sm2.PublicKey.from_pem(data).to_bytes() == v.public_key


# --- openssl writes, we read ---


@pytest.mark.parametrize("public", [True, False])
@pytest.mark.parametrize("parameters", ["named_curve", "explicit"])
@pytest.mark.parametrize("conversion", ["compressed", "uncompressed"])
def test_openssl_writes_sec1_we_read(
    openssl: Any, tmp_path: Path, public: bool, parameters: str, conversion: str
) -> None:
    source = tmp_path / "key.pem"
    openssl("ecparam", "-name", "SM2", "-genkey", "-out", source)  # an EC PARAMETERS block stands first
    wanted = sm2.PrivateKey.from_pem(source.read_bytes())
    arguments = ["-param_enc", parameters, "-conv_form", conversion, *([] if public else ["-no_public"])]
    assert sm2.PrivateKey.from_pem(openssl("ec", "-in", source, *arguments)) == wanted
    assert sm2.PrivateKey.from_der(openssl("ec", "-in", source, "-outform", "DER", *arguments)) == wanted
    assert sm2.PublicKey.from_pem(openssl("ec", "-in", source, "-pubout", *arguments[:4])) == wanted.public_key


def test_openssl_writes_pkcs8_we_read(openssl: Any, tmp_path: Path) -> None:
    data = openssl("genpkey", "-algorithm", "SM2")
    key = sm2.PrivateKey.from_pem(data)
    assert sm2.PrivateKey.from_der(openssl("pkey", "-outform", "DER", data=data)) == key
    assert sm2.PublicKey.from_der(openssl("pkey", "-pubout", "-outform", "DER", data=data)) == key.public_key
    explicit = openssl(
        "genpkey", "-algorithm", "EC", "-pkeyopt", "ec_paramgen_curve:SM2", "-pkeyopt", "ec_param_enc:explicit"
    )
    assert sm2.PrivateKey.from_pem(explicit).public_key == sm2.PublicKey.from_pem(
        openssl("pkey", "-pubout", data=explicit)
    )


@pytest.mark.parametrize(
    "arguments",
    [
        *(
            ["-v2", cipher, "-v2prf", prf]
            for cipher, prf in [
                ("sm4-cbc", "hmacWithSHA1"),
                ("sm4-cbc", "hmacWithSHA256"),
                ("aes-128-cbc", "hmacWithSHA512"),
                ("aes-192-cbc", "hmacWithSHA384"),
                ("aes-256-cbc", "hmacWithSHA224"),
                ("des3", "hmacWithSHA256"),
            ]
        ),
        ["-scrypt"],
        ["-scrypt", "-v2", "sm4-cbc"],
        ["-scrypt", "-scrypt_N", "1024", "-scrypt_r", "8", "-scrypt_p", "16"],
    ],
    ids=" ".join,
)
def test_openssl_encrypts_we_read(openssl: Any, tmp_path: Path, arguments: list[str]) -> None:
    plain = openssl("genpkey", "-algorithm", "SM2")
    encrypted = openssl("pkcs8", "-topk8", "-passout", "pass:geheim", *arguments, data=plain)
    key = sm2.PrivateKey.from_pem(plain)
    assert b"ENCRYPTED PRIVATE KEY" in encrypted
    assert sm2.PrivateKey.from_pem(encrypted, password=b"geheim") == key
    assert sm2.PrivateKey.from_der(pem.first(encrypted, ["ENCRYPTED PRIVATE KEY"]).der, b"geheim") == key
    for wrong in (b"Geheim", b"", b"geheim\n"):
        with pytest.raises(InvalidKey, match="the password is wrong, or the key file is damaged"):
            sm2.PrivateKey.from_pem(encrypted, password=wrong)


# --- we write, openssl reads ---


@pytest.mark.parametrize("format", ["pkcs8", "sec1"])
def test_we_write_openssl_reads(openssl: Any, format: Any) -> None:
    key = sm2.PrivateKey.generate()
    public = openssl("pkey", "-pubout", "-check", data=key.to_pem(format=format))
    assert b"Key is valid" in public
    assert sm2.PublicKey.from_pem(public) == key.public_key
    assert public.endswith(key.public_key.to_pem())
    assert openssl("pkey", "-inform", "DER", "-pubout", "-outform", "DER", data=key.to_der(format=format)) == (
        key.public_key.to_der()
    )
    assert openssl("pkey", "-pubin", "-pubout", data=key.public_key.to_pem()) == key.public_key.to_pem()


def test_we_encrypt_openssl_reads(openssl: Any) -> None:
    encrypted = keyfiles.dump_private(KEY, b"geheim", "pkcs8", form="pem", prf="sha256")
    plain = openssl("pkey", "-passin", "pass:geheim", data=encrypted)
    assert sm2.PrivateKey.from_pem(plain) == KEY
    assert sm2.PrivateKey.from_pem(encrypted, b"geheim") == KEY


def test_the_default_encryption_is_that_of_gmssl(openssl: Any) -> None:
    """GmSSL 3 reads PBES2 with PBKDF2-HMAC-SM3 (1.2.156.10197.1.401.2, without parameters) and SM4-CBC only."""
    listing = openssl("asn1parse", "-inform", "DER", data=KEY.to_der(password=b"geheim")).decode()
    objects = [line.split(":")[-1] for line in listing.splitlines() if "OBJECT" in line]
    assert objects == ["PBES2", "PBKDF2", "1.2.156.10197.1.401.2", "sm4-cbc"]
    assert "NULL" not in listing


def test_the_encryption_by_another_hand() -> None:
    """hashlib and our SM4 alone, step by step after RFC 8018, 6.2.2."""
    if "sm3" not in hashlib.algorithms_available:
        pytest.skip("this Python's hashlib has no SM3")
    info = unchecked(KEY.to_der(password=b"geheim")).sequence()
    scheme = info.sequence()
    assert scheme.oid() == "1.2.840.113549.1.5.13"
    both = scheme.sequence()
    derivation = both.sequence()
    assert derivation.oid() == "1.2.840.113549.1.5.12"
    parameters = derivation.sequence()
    salt, iterations = parameters.octet_string(), parameters.integer()
    assert len(salt) == 16 and iterations == keyfiles.ITERATIONS
    parameters.rest()
    cipher = both.sequence()
    cipher.oid()
    key = hashlib.pbkdf2_hmac("sm3", b"geheim", salt, iterations, 16)
    plain = sm4.decrypt(key, sm4.CBC(cipher.octet_string()), info.octet_string(), padding="pkcs7")
    assert plain == KEY.to_der()


@pytest.mark.parametrize("oid", ["1.2.156.10197.1.401.2", "1.2.156.10197.1.401.3.1"])
@pytest.mark.parametrize("null", [False, True])
def test_both_identifiers_of_hmac_sm3_are_read(oid: str, null: bool) -> None:
    """GM/T 0091 gives two; GmSSL writes the first without, OpenSSL the second with NULL."""
    data = encrypted(prf=der.sequence(der.oid(oid), *([der.null()] if null else [])), hash_name="sm3")
    assert sm2.PrivateKey.from_der(data, b"pw") == KEY


# --- the forms that are read ---


def sec1(d: int = KEY.to_int(), *, parameters: bytes | None = der.oid(SM2_OID), public: bytes | None = POINT) -> bytes:
    return der.sequence(
        der.integer(1),
        der.octet_string(d.to_bytes(32, "big")),
        b"" if parameters is None else der.explicit(0, parameters),
        b"" if public is None else der.explicit(1, der.bit_string(public)),
    )


def pkcs8(inner: bytes, algorithm: bytes | None = None, *, version: int = 0, tail: bytes = b"") -> bytes:
    if algorithm is None:
        algorithm = der.sequence(der.oid(EC_OID), der.oid(SM2_OID))
    return der.sequence(der.integer(version), algorithm, der.octet_string(inner), tail)


def spki(algorithm: bytes, point: bytes = POINT) -> bytes:
    return der.sequence(algorithm, der.bit_string(point))


def explicit(
    p: int = sm2.PrivateKey.from_int(1).curve.p,
    *,
    cofactor: int | None = 1,
    base: bytes | None = None,
    seed: bytes = b"",
) -> bytes:
    curve = KEY.curve
    G = sm2.PrivateKey.from_int(1).public_key.to_bytes()
    return der.sequence(
        der.integer(1),
        der.sequence(der.oid("1.2.840.10045.1.1"), der.integer(p)),
        der.sequence(
            der.octet_string(curve.a.to_bytes(32, "big")), der.octet_string(curve.b.to_bytes(32, "big")), seed
        ),
        der.octet_string(G if base is None else base),
        der.integer(curve.n),
        b"" if cofactor is None else der.integer(cofactor),
    )


COMPRESSED_G = sm2.PrivateKey.from_int(1).public_key.to_bytes(compressed=True)
ALGORITHMS = {
    "the named curve": der.sequence(der.oid(EC_OID), der.oid(SM2_OID)),
    "the curve as algorithm": der.sequence(der.oid(SM2_OID)),
    "the curve as algorithm, NULL": der.sequence(der.oid(SM2_OID), der.null()),
    "the curve as algorithm, named again": der.sequence(der.oid(SM2_OID), der.oid(SM2_OID)),
    "explicit parameters": der.sequence(der.oid(EC_OID), explicit()),
    "explicit parameters without cofactor": der.sequence(der.oid(EC_OID), explicit(cofactor=None)),
    "explicit parameters, G compressed": der.sequence(der.oid(EC_OID), explicit(base=COMPRESSED_G)),
}


@pytest.mark.parametrize("algorithm", ALGORITHMS.values(), ids=ALGORITHMS)
def test_algorithm_identifiers_that_are_sm2(algorithm: bytes) -> None:
    assert sm2.PrivateKey.from_der(pkcs8(sec1(), algorithm)) == KEY
    assert sm2.PublicKey.from_der(spki(algorithm)) == KEY.public_key


@pytest.mark.parametrize("public", [None, POINT, KEY.public_key.to_bytes(compressed=True)])
@pytest.mark.parametrize("parameters", [None, der.oid(SM2_OID), explicit()])
def test_optional_parts_of_sec1(public: bytes | None, parameters: bytes | None) -> None:
    inner = sec1(parameters=parameters, public=public)
    assert sm2.PrivateKey.from_der(pkcs8(inner)) == KEY
    assert sm2.PrivateKey.from_pem(pem.encode("SM2 PRIVATE KEY", inner)) == KEY
    named = pem.encode("EC PARAMETERS", der.oid(SM2_OID))
    assert sm2.PrivateKey.from_pem(named + pem.encode("EC PRIVATE KEY", inner)) == KEY
    if parameters is None and public is None:
        for read, data in (
            (sm2.PrivateKey.from_der, inner),
            (sm2.PrivateKey.from_pem, pem.encode("EC PRIVATE KEY", inner)),
        ):
            with pytest.raises(InvalidKey, match="nothing says which curve"):
                read(data)
    else:
        assert sm2.PrivateKey.from_der(inner) == KEY


def test_pkcs8_version_2_with_attributes_and_public_key() -> None:
    attributes = der.explicit(0, der.sequence(der.oid("1.2.3"), der.set_of(der.utf8_string("robot"))))
    public = der.implicit(1, b"\0" + POINT)
    assert sm2.PrivateKey.from_der(pkcs8(sec1(), version=1, tail=attributes + public)) == KEY
    assert sm2.PrivateKey.from_der(pkcs8(sec1(), version=0, tail=attributes)) == KEY


def test_compressed_public_keys_are_read() -> None:
    algorithm = ALGORITHMS["the named curve"]
    assert sm2.PublicKey.from_der(spki(algorithm, KEY.public_key.to_bytes(compressed=True))) == KEY.public_key


def test_the_first_private_key_is_taken_and_other_blocks_are_skipped() -> None:
    data = pem.encode("CERTIFICATE", b"") + KEY.to_pem() + OTHER.to_pem()
    assert sm2.PrivateKey.from_pem(data) == KEY


# --- what is refused ---

P256 = der.sequence(der.oid(EC_OID), der.oid(P256_OID))
WRONG_PRIVATE = {
    "not DER": b"\x30\x80\x00\x00",
    "nothing": b"",
    "bytes after the key": KEY.to_der() + b"\0",
    "PKCS#8 of P-256": pkcs8(sec1(parameters=None), P256),
    "PKCS#8 of SM2 around a key of P-256": pkcs8(sec1(parameters=der.oid(P256_OID))),
    "PKCS#8 of RSA": pkcs8(sec1(), der.sequence(der.oid("1.2.840.113549.1.1.1"), der.null())),
    "PKCS#8 of version 2": pkcs8(sec1(), version=2),
    "ecPublicKey without a curve": pkcs8(sec1(), der.sequence(der.oid(EC_OID))),
    "an implicit curve": pkcs8(sec1(), der.sequence(der.oid(EC_OID), der.null())),
    "explicit parameters of another p": pkcs8(sec1(), der.sequence(der.oid(EC_OID), explicit(KEY.curve.p + 2))),
    "explicit parameters of another G": pkcs8(sec1(), der.sequence(der.oid(EC_OID), explicit(base=POINT))),
    "explicit parameters of another cofactor": pkcs8(sec1(), der.sequence(der.oid(EC_OID), explicit(cofactor=2))),
    "explicit parameters with a seed": pkcs8(
        sec1(), der.sequence(der.oid(EC_OID), explicit(seed=der.bit_string(b"s")))
    ),
    "a public key of version 1": pkcs8(sec1(), version=0, tail=der.implicit(1, b"\0" + POINT)),
    "a public key of another private key outside": pkcs8(
        sec1(), version=1, tail=der.implicit(1, b"\0" + OTHER.public_key.to_bytes())
    ),
    "a public key that is not whole bytes": pkcs8(sec1(), version=1, tail=der.implicit(1, b"\4" + POINT)),
    "a public key of another private key inside": pkcs8(sec1(public=OTHER.public_key.to_bytes())),
    "a negated public key": sec1(public=POINT[:33] + (KEY.curve.p - KEY.public_key.point[1]).to_bytes(32, "big")),
    "a public key that is no point": sec1(public=b"\4" + bytes(64)),
    "a hybrid public key": sec1(public=bytes([6 + POINT[-1] % 2]) + POINT[1:]),
    "SEC1 of version 2": der.sequence(
        der.integer(2), der.octet_string(bytes(31) + b"\1"), der.explicit(0, der.oid(SM2_OID))
    ),
    "SEC1 of 31 bytes": der.sequence(der.integer(1), der.octet_string(bytes(31)), der.explicit(0, der.oid(SM2_OID))),
    "SEC1 of 33 bytes": der.sequence(
        der.integer(1), der.octet_string(bytes(32) + b"\1"), der.explicit(0, der.oid(SM2_OID))
    ),
    "SEC1 of P-256": sec1(parameters=der.oid(P256_OID), public=None),
    "d = 0": sec1(0, public=None),
    "d = 0 with a public key": sec1(0),
    "d = n - 1": sec1(KEY.curve.n - 1, public=None),
    "d = n": sec1(KEY.curve.n, public=None),
    "d above n with a public key": sec1(2**256 - 1),
}


@pytest.mark.parametrize("case", WRONG_PRIVATE)
def test_private_keys_that_are_refused(case: str) -> None:
    with pytest.raises(InvalidKey):
        sm2.PrivateKey.from_der(WRONG_PRIVATE[case])
    for label in ("PRIVATE KEY", "EC PRIVATE KEY", "SM2 PRIVATE KEY"):
        with pytest.raises(InvalidKey):
            sm2.PrivateKey.from_pem(pem.encode(label, WRONG_PRIVATE[case]))


def test_a_hybrid_point_of_the_right_key_is_not_said_to_be_of_another() -> None:
    with pytest.raises(InvalidKey, match="or its point does not begin with 04, 02 or 03"):  # ec -conv_form hybrid
        sm2.PrivateKey.from_der(WRONG_PRIVATE["a hybrid public key"])


@pytest.mark.parametrize(
    "data",
    [
        b"",
        KEY.to_pem(),
        pem.encode("PUBLIC KEY", KEY.public_key.to_der() + b"\0"),
        pem.encode("PUBLIC KEY", spki(P256)),
        pem.encode("PUBLIC KEY", spki(der.sequence(der.oid(SM2_OID), der.oid(P256_OID)))),
        pem.encode("PUBLIC KEY", spki(ALGORITHMS["the named curve"], b"\4" + bytes(64))),
        pem.encode("PUBLIC KEY", spki(ALGORITHMS["the named curve"], b"\0")),
        pem.encode("PUBLIC KEY", spki(ALGORITHMS["the named curve"], bytes([6 + POINT[-1] % 2]) + POINT[1:])),
        pem.encode("PUBLIC KEY", der.sequence(ALGORITHMS["the named curve"], der.octet_string(POINT))),
    ],
)
def test_public_keys_that_are_refused(data: bytes) -> None:
    with pytest.raises(InvalidKey):
        sm2.PublicKey.from_pem(data)
    with pytest.raises(InvalidKey):
        sm2.PublicKey.from_der(data)


def test_ec_parameters_of_another_curve_are_refused() -> None:
    data = pem.encode("EC PARAMETERS", der.oid(P256_OID)) + KEY.to_pem(format="sec1")
    with pytest.raises(InvalidKey, match=r"curve is 1\.2\.840\.10045\.3\.1\.7"):
        sm2.PrivateKey.from_pem(data)
    with pytest.raises(InvalidKey):
        sm2.PrivateKey.from_pem(pem.encode("EC PARAMETERS", der.oid(SM2_OID) + b"\0") + KEY.to_pem(format="sec1"))


def test_no_private_key_in_the_file() -> None:
    with pytest.raises(InvalidKey, match="no PEM block labelled PRIVATE KEY"):
        sm2.PrivateKey.from_pem(KEY.public_key.to_pem())


def test_a_password_for_what_is_not_encrypted_is_an_error() -> None:
    for data in (KEY.to_pem(), KEY.to_pem(format="sec1")):
        with pytest.raises(InvalidKey, match="is not encrypted"):
            sm2.PrivateKey.from_pem(data, password=b"pw")
    with pytest.raises(InvalidKey, match="is not encrypted"):
        sm2.PrivateKey.from_der(KEY.to_der(), password=b"")


def test_no_password_for_what_is_encrypted_is_an_error() -> None:
    for read, data in ((sm2.PrivateKey.from_pem, KEY.to_pem(b"pw")), (sm2.PrivateKey.from_der, KEY.to_der(b"pw"))):
        with pytest.raises(InvalidKey, match="a password is needed"):
            read(data)


def test_writing_refuses_what_makes_no_sense() -> None:
    with pytest.raises(InvalidOption, match="SEC1 private keys are not encrypted"):
        KEY.to_pem(password=b"pw", format="sec1")
    with pytest.raises(InvalidOption, match="format must be"):
        KEY.to_pem(format="pkcs1")  # type: ignore[arg-type]
    with pytest.raises(InvalidOption, match="empty password"):
        KEY.to_pem(password=b"")
    with pytest.raises(TypeError):
        KEY.to_pem(password="pw")  # type: ignore[arg-type]
    with pytest.raises(InvalidOption, match="prf"):
        keyfiles.dump_private(KEY, b"pw", "pkcs8", form="der", prf="md5")  # type: ignore[arg-type]
    with pytest.raises(InvalidOption, match="iterations"):
        keyfiles.dump_private(KEY, b"pw", "pkcs8", form="der", iterations=0)


# --- encrypted keys that are refused ---

SHA256 = der.sequence(der.oid("1.2.840.113549.2.9"), der.null())
SM3 = der.sequence(der.oid("1.2.156.10197.1.401.2"))


def encrypted(
    *,
    plain: bytes | None = None,
    iterations: int = 1,
    key_length: int | None = None,
    prf: bytes = SHA256,
    hash_name: str = "sha256",
    cipher_oid: str = "1.2.156.10197.1.104.2",
    iv: bytes = bytes(16),
    scheme_oid: str = "1.2.840.113549.1.5.13",
    derivation: bytes | None = None,
    ciphertext: bytes | None = None,
    salt: bytes = der.octet_string(b"salt"),
) -> bytes:
    if ciphertext is None:
        key = hashlib.pbkdf2_hmac(hash_name, b"pw", b"salt", max(1, min(iterations, 1000)), 16)
        ciphertext = sm4.encrypt(key, sm4.CBC(bytes(16)), KEY.to_der() if plain is None else plain, padding="pkcs7")
    if derivation is None:
        length = b"" if key_length is None else der.integer(key_length)
        parameters = der.sequence(salt, der.integer(iterations), length, prf)
        derivation = der.sequence(der.oid("1.2.840.113549.1.5.12"), parameters)
    cipher = der.sequence(der.oid(cipher_oid), der.octet_string(iv))
    return der.sequence(
        der.sequence(der.oid(scheme_oid), der.sequence(derivation, cipher)), der.octet_string(ciphertext)
    )


def scrypt(N: int, r: int, p: int, key_length: int | None = None) -> bytes:
    length = b"" if key_length is None else der.integer(key_length)
    numbers = der.integer(N) + der.integer(r) + der.integer(p)
    return der.sequence(der.oid("1.3.6.1.4.1.11591.4.11"), der.sequence(der.octet_string(b"salt"), numbers, length))


@pytest.mark.parametrize("bits", [400, 40000])
def test_absurd_numbers_are_refused_and_said_without_harm(bits: int) -> None:
    number = 2**bits
    for data, password in (
        (der.sequence(der.integer(number), ALGORITHMS["the named curve"], der.octet_string(sec1())), None),
        (der.sequence(der.integer(number), der.octet_string(bytes(32))), None),
        (encrypted(iterations=number), b"pw"),
        (encrypted(key_length=number), b"pw"),
        (encrypted(derivation=scrypt(number, number, number)), b"pw"),
    ):
        with pytest.raises(InvalidKey):
            sm2.PrivateKey.from_der(data, password)


def test_the_helper_writes_what_is_read() -> None:
    assert sm2.PrivateKey.from_der(encrypted(), b"pw") == KEY
    assert sm2.PrivateKey.from_der(encrypted(key_length=16), b"pw") == KEY


WRONG_ENCRYPTED = {
    "PBES1": (encrypted(scheme_oid="1.2.840.113549.1.5.3"), "PBES2 is what is supported"),
    "an unknown cipher": (encrypted(cipher_oid="1.2.156.10197.1.104.1"), "which is not supported"),
    "an unknown hash": (encrypted(prf=der.sequence(der.oid("1.2.840.113549.2.6"))), "pseudorandom function"),
    "the default hash spelt out (X.690, 11.5)": (
        encrypted(prf=der.sequence(der.oid("1.2.840.113549.2.7"), der.null())),
        "pseudorandom function",
    ),
    "an unknown key derivation": (
        encrypted(derivation=der.sequence(der.oid("1.2.3"), der.sequence())),
        "key derivation 1.2.3",
    ),
    "a salt that is named, not given": (encrypted(salt=der.sequence(der.oid("1.2.3"))), "expected tag 0x04"),
    "an IV of 8 bytes": (encrypted(iv=bytes(8)), "the IV has 8 bytes, not 16"),
    "a key length that does not fit": (encrypted(key_length=32), "a key of 32 bytes is derived"),
    "no iterations": (encrypted(iterations=0), "0 PBKDF2 iterations"),
    "10,000,001 iterations": (encrypted(iterations=10_000_001), "the limit is 10000000"),
    "2**400 iterations": (encrypted(iterations=2**400), "the limit is 10000000"),
    "scrypt N = 3": (encrypted(derivation=scrypt(3, 8, 1)), "power of two"),
    "scrypt N = 1": (encrypted(derivation=scrypt(1, 8, 1)), "power of two"),
    "scrypt r = 0": (encrypted(derivation=scrypt(16, 0, 1)), "r and p positive"),
    "scrypt p = 0": (encrypted(derivation=scrypt(16, 1, 0)), "r and p positive"),
    "scrypt beyond 256 MiB": (encrypted(derivation=scrypt(2**19, 8, 1)), "268435456 bytes"),
    "scrypt beyond 256 MiB by p": (encrypted(derivation=scrypt(2, 1, 2**22)), "268435456 bytes"),
    "scrypt beyond 256 MiB by p and r": (encrypted(derivation=scrypt(2, 2**20, 4)), "268435456 bytes"),
    "scrypt N = 2^(16 r)": (encrypted(derivation=scrypt(2**16, 1, 1)), "and below 2"),
    "scrypt with too much work": (encrypted(derivation=scrypt(2**14, 8, 65)), "8388608"),
    "scrypt with a key length that does not fit": (encrypted(derivation=scrypt(16, 1, 1, 32)), "a key of 32 bytes"),
    "an empty ciphertext": (encrypted(ciphertext=b""), "the password is wrong"),
    "a ciphertext of 17 bytes": (encrypted(ciphertext=bytes(17)), "the password is wrong"),
    "something else inside": (encrypted(plain=b"hello"), "the password is wrong"),
    "a key of P-256 inside": (encrypted(plain=pkcs8(sec1(parameters=None), P256)), "the password is wrong"),
}


@pytest.mark.parametrize("case", WRONG_ENCRYPTED)
def test_encrypted_keys_that_are_refused(case: str) -> None:
    data, reason = WRONG_ENCRYPTED[case]
    with pytest.raises(InvalidKey, match=reason):
        sm2.PrivateKey.from_der(data, b"pw")


@pytest.mark.parametrize(("iterations", "engine", "reason"), [
    (1_000_001, "python", "1000001 PBKDF2 iterations of SM3; without OpenSSL's SM3 the limit is 1000000"),
    (1_000_001, "openssl", "the password is wrong"),
    (10_000_001, "openssl", "the limit is 10000000"),
])
def test_the_limit_of_iterations_is_a_limit_of_time(
    iterations: int, engine: str, reason: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(sm3, "ENGINE", engine)
    monkeypatch.setattr(kdf, "pbkdf2_hmac", lambda password, salt, iterations, length: bytes(length))
    with pytest.raises(InvalidKey, match=reason):
        sm2.PrivateKey.from_der(encrypted(iterations=iterations, prf=SM3, hash_name="sm3"), b"pw")


FULL = {
    "PKCS#8": pkcs8(
        sec1(parameters=explicit()),
        version=1,
        tail=der.explicit(0, der.sequence(der.oid("1.2.3"), der.set_of(der.utf8_string("x"))))
        + der.implicit(1, b"\0" + POINT),
    ),
    "SEC1": KEY.to_der(format="sec1"),
    "explicit curve": pkcs8(sec1(), ALGORITHMS["explicit parameters"]),
    "curve as algorithm": pkcs8(sec1(), ALGORITHMS["the curve as algorithm, named again"]),
    "PBKDF2": encrypted(key_length=16),
}


@pytest.mark.parametrize("name", FULL)
def test_no_container_takes_anything_more(name: str) -> None:
    password = b"pw" if name == "PBKDF2" else None
    assert sm2.PrivateKey.from_der(FULL[name], password) == KEY
    variants = list(overfull(FULL[name]))
    assert len(variants) >= 3
    for data in variants:
        with pytest.raises(InvalidKey):
            sm2.PrivateKey.from_der(data, password)
    for data in overfull(KEY.public_key.to_der()):
        with pytest.raises(InvalidKey):
            sm2.PublicKey.from_der(data)


def test_iterations_are_bounded_when_a_key_is_written(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(keyfiles, "MAX_ITERATIONS", 3)
    for iterations in (1, 3):
        assert len(keyfiles.write_pbes2(b"a key", b"pw", "sha256", iterations)[1]) == 16
    for iterations in (0, 4):
        with pytest.raises(InvalidOption, match="between 1 and 3"):
            keyfiles.write_pbes2(b"a key", b"pw", "sha256", iterations)


@pytest.mark.parametrize(("N", "r", "p"), [(2, 1, 1), (16, 8, 3), (16, 8, 64), (1 << 14, 8, 1), (1 << 15, 1, 1)])
def test_scrypt_as_hashlib_computes_it(N: int, r: int, p: int) -> None:
    key = hashlib.scrypt(b"pw", salt=b"salt", n=N, r=r, p=p, dklen=16)
    ciphertext = sm4.encrypt(key, sm4.CBC(bytes(16)), KEY.to_der(), padding="pkcs7")
    for length in (None, 16):
        data = encrypted(derivation=scrypt(N, r, p, length), ciphertext=ciphertext)
        assert sm2.PrivateKey.from_der(data, b"pw") == KEY
    for variant in overfull(data):
        with pytest.raises(InvalidKey):
            sm2.PrivateKey.from_der(variant, b"pw")


def test_scrypt_with_just_as_much_memory_and_work_as_are_allowed(monkeypatch: pytest.MonkeyPatch) -> None:
    key = hashlib.scrypt(b"pw", salt=b"salt", n=16, r=2, p=3, dklen=16)
    ciphertext = sm4.encrypt(key, sm4.CBC(bytes(16)), KEY.to_der(), padding="pkcs7")
    data = encrypted(derivation=scrypt(16, 2, 3), ciphertext=ciphertext)
    for name, most in (("MAX_SCRYPT_MEMORY", 128 * 16 * 2), ("MAX_SCRYPT_BLOCKS", 16 * 2 * 3)):
        with monkeypatch.context() as patch:
            patch.setattr(keyfiles, name, most)
            assert sm2.PrivateKey.from_der(data, b"pw") == KEY
            patch.setattr(keyfiles, name, most - 1)
            with pytest.raises(InvalidKey, match="the limits are"):
                sm2.PrivateKey.from_der(data, b"pw")


@pytest.mark.parametrize("oid", ["2.16.840.1.101.3.4.1.2", "1.2.840.113549.3.7"])
@pytest.mark.parametrize("ciphertext", [bytes(16), bytes(range(32))])
def test_foreign_ciphers_refuse_bad_padding(oid: str, ciphertext: bytes) -> None:
    pytest.importorskip("cryptography")
    data = encrypted(cipher_oid=oid, ciphertext=ciphertext, iv=bytes(8 if oid.endswith("3.7") else 16))
    with pytest.raises(InvalidKey, match="the password is wrong"):
        sm2.PrivateKey.from_der(data, b"pw")


def test_a_missing_package_is_named(monkeypatch: pytest.MonkeyPatch) -> None:
    real = builtins.__import__

    def without(name: str, *args: Any, **kwargs: Any) -> Any:
        if name.startswith("cryptography"):
            raise ImportError(name)
        return real(name, *args, **kwargs)

    monkeypatch.setattr(builtins, "__import__", without)
    data = encrypted(cipher_oid="2.16.840.1.101.3.4.1.42", ciphertext=bytes(16))
    with pytest.raises(MissingDependency, match="AES needs the package 'cryptography'"):
        sm2.PrivateKey.from_der(data, b"pw")


def test_aes_is_read_where_the_package_is_too_old_for_triple_des(monkeypatch: pytest.MonkeyPatch) -> None:
    ciphers = pytest.importorskip("cryptography.hazmat.primitives.ciphers")
    key = hashlib.pbkdf2_hmac("sha256", b"pw", b"salt", 1, 32)
    padded = KEY.to_der() + bytes([16 - len(KEY.to_der()) % 16]) * (16 - len(KEY.to_der()) % 16)
    encryptor = ciphers.Cipher(ciphers.algorithms.AES(key), ciphers.modes.CBC(bytes(16))).encryptor()
    data = encrypted(cipher_oid="2.16.840.1.101.3.4.1.42", ciphertext=encryptor.update(padded))
    monkeypatch.setitem(sys.modules, "cryptography.hazmat.decrepit.ciphers", None)
    assert sm2.PrivateKey.from_der(data, b"pw") == KEY
    triple = encrypted(cipher_oid="1.2.840.113549.3.7", iv=bytes(8), ciphertext=bytes(16))
    with pytest.raises(MissingDependency, match="TripleDES needs"):
        sm2.PrivateKey.from_der(triple, b"pw")


# --- fuzzing: any bytes are a key or an SMCryptoError, and a key has few encodings ---

SEEDS = [
    KEY.to_der(),
    KEY.to_der(format="sec1"),
    sec1(parameters=None),
    pkcs8(sec1(parameters=explicit())),
    encrypted(),
    encrypted(derivation=scrypt(2, 1, 1)),
]


@given(st.sampled_from(SEEDS), st.data())
def test_an_altered_private_key_is_another_key_or_refused(seed: bytes, draw: st.DataObject) -> None:
    altered = bytearray(seed)
    for _ in range(draw.draw(st.integers(1, 3))):
        altered[draw.draw(st.integers(0, len(altered) - 1))] = draw.draw(st.integers(0, 255))
    try:
        key = sm2.PrivateKey.from_der(altered, b"pw" if seed in SEEDS[4:] else None)
    except SMCryptoError:
        return
    assert 1 <= key.to_int() <= key.curve.n - 2
    # With the public key beside it, an altered d cannot pass.
    assert key == KEY or POINT not in seed


@given(st.binary(max_size=200))
def test_any_bytes_are_a_key_or_refused(data: bytes) -> None:
    for read in (sm2.PrivateKey.from_der, sm2.PrivateKey.from_pem, sm2.PublicKey.from_der, sm2.PublicKey.from_pem):
        with pytest.raises(InvalidKey):
            read(data)


@given(st.integers(0, len(KEY.public_key.to_der()) - 1), st.integers(0, 255))
def test_an_altered_public_key_reencodes_to_the_same_bytes(position: int, value: int) -> None:
    altered = bytearray(KEY.public_key.to_der())
    altered[position] = value
    try:
        key = sm2.PublicKey.from_der(altered)
    except SMCryptoError:
        return
    assert key.to_der() == altered


@given(st.integers(1, KEY.curve.n - 2))
def test_any_key_comes_back(d: int) -> None:
    key = sm2.PrivateKey.from_int(d)
    assert sm2.PrivateKey.from_der(key.to_der()) == key
    assert sm2.PrivateKey.from_pem(key.to_pem(format="sec1")) == key
    assert sm2.PublicKey.from_der(key.public_key.to_der()) == key.public_key


def test_a_key_written_for_older_openssl_is_read_by_it(require: Callable[[str], str], tmp_path: Path) -> None:
    key = sm2.PrivateKey.generate()
    (tmp_path / "key.pem").write_bytes(key.to_pem(b"open sesame", prf="sha256"))
    command = [require("openssl"), "pkey", "-in", str(tmp_path / "key.pem"), "-passin", "pass:open sesame", "-pubout"]
    done = subprocess.run(command, capture_output=True, check=True)
    assert sm2.PublicKey.from_pem(done.stdout) == key.public_key
    with pytest.raises(InvalidOption):
        key.to_pem(b"open sesame", prf="md5")
    with pytest.raises(InvalidOption):
        key.to_pem(prf="md5")


# --- Python without OpenSSL, where hashlib has neither PBKDF2 nor scrypt ---


@pytest.mark.parametrize("prf", ["sm3", "sha256"])
def test_keys_are_encrypted_and_read_without_openssl(prf: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    written_with = KEY.to_pem(b"password", prf=prf)
    monkeypatch.delattr(hashlib, "pbkdf2_hmac")
    monkeypatch.setattr(sm3, "ENGINE", "python")
    monkeypatch.setattr(keyfiles, "ITERATIONS", 100)
    if prf == "sha256":
        assert sm2.PrivateKey.from_pem(written_with, b"password") == KEY
        assert sm2.PrivateKey.from_pem(KEY.to_pem(b"password", prf=prf), b"password") == KEY
    else:
        sealed = keyfiles.dump_private(KEY, b"password", "pkcs8", form="pem", prf=prf, iterations=10)
        assert sm2.PrivateKey.from_pem(sealed, b"password") == KEY


@pytest.mark.parametrize("length", [1, 16, 20, 33, 64])
@pytest.mark.parametrize("name", ["sha1", "sha256", "sha512"])
def test_our_pbkdf2_is_hashlibs(name: str, length: int, monkeypatch: pytest.MonkeyPatch) -> None:
    expected = hashlib.pbkdf2_hmac(name, b"a password", b"salt", 3, length)
    monkeypatch.delattr(hashlib, "pbkdf2_hmac")
    assert keyfiles._pbkdf2(name, b"a password", b"salt", 3, length) == expected


def test_without_openssl_scrypt_is_a_missing_dependency(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.delattr(hashlib, "scrypt")
    with pytest.raises(MissingDependency, match="OpenSSL"):
        sm2.PrivateKey.from_der(encrypted(derivation=scrypt(16, 8, 1)), b"pw")


# --- keys of other algorithms beside ours ---


def _foreign(openssl: Callable[..., bytes]) -> dict[str, bytes]:
    rsa = openssl("genpkey", "-algorithm", "RSA", "-pkeyopt", "rsa_keygen_bits:1024")
    p256 = openssl("ecparam", "-name", "prime256v1", "-genkey")  # EC PARAMETERS and EC PRIVATE KEY
    return {
        "RSA": rsa,
        "RSA, PKCS#1": openssl("rsa", "-traditional", data=rsa),
        "RSA, encrypted": openssl("pkcs8", "-topk8", "-v2", "aes256", "-passout", "pass:theirs", data=rsa),
        "RSA, encrypted with our password": openssl("pkcs8", "-topk8", "-passout", "pass:ours", data=rsa),
        "RSA, encrypted by PBES1": openssl("pkcs8", "-topk8", "-v1", "PBE-SHA1-3DES", "-passout", "pass:x", data=rsa),
        "RSA, encrypted in the old way": openssl("rsa", "-traditional", "-aes128", "-passout", "pass:x", data=rsa),
        "P-256": p256,
        "P-256, encrypted in the old way": openssl("ec", "-aes128", "-passout", "pass:x", data=p256),
        "P-384": openssl("ecparam", "-name", "secp384r1", "-genkey", "-noout"),
        "Ed25519": openssl("genpkey", "-algorithm", "Ed25519"),
    }


@pytest.mark.parametrize("password", [None, b"ours"])
def test_the_sm2_key_of_a_file_that_begins_with_other_keys_is_found(
    openssl: Callable[..., bytes], password: bytes | None
) -> None:
    ours = KEY.to_pem(password, prf="sha256")
    foreign = _foreign(openssl)
    for name, theirs in foreign.items():
        assert sm2.PrivateKey.from_pem(theirs + ours, password) == KEY, name
        assert sm2.PrivateKey.from_pem(ours + theirs, password) == KEY, name
        with pytest.raises(InvalidKey):
            sm2.PrivateKey.from_pem(theirs, password)
    everything = b"".join(foreign.values())
    assert sm2.PrivateKey.from_pem(everything + ours + OTHER.to_pem(), password) == KEY
    if password is None:
        assert sm2.PrivateKey.from_pem(foreign["P-256"] + KEY.to_pem(format="sec1")) == KEY
    else:
        with pytest.raises(InvalidKey, match="the password is wrong"):
            sm2.PrivateKey.from_pem(ours + everything, b"no")
        with pytest.raises(InvalidKey, match="a password is needed"):
            sm2.PrivateKey.from_pem(foreign["RSA"] + ours)


def test_the_sm2_public_key_of_a_file_that_begins_with_another_is_found(openssl: Callable[..., bytes]) -> None:
    theirs = openssl("pkey", "-pubout", data=openssl("genpkey", "-algorithm", "Ed25519"))
    assert sm2.PublicKey.from_pem(theirs + KEY.public_key.to_pem()) == KEY.public_key
    with pytest.raises(InvalidKey, match=r"algorithm is 1\.3\.101\.112, not SM2"):
        sm2.PublicKey.from_pem(theirs)


def test_a_malformed_key_is_not_passed_over() -> None:
    broken = pem.encode("PRIVATE KEY", WRONG_PRIVATE["a public key of another private key inside"])
    with pytest.raises(InvalidKey, match="of another key"):
        sm2.PrivateKey.from_pem(broken + KEY.to_pem())
    with pytest.raises(InvalidKey, match="no END line"):
        sm2.PrivateKey.from_pem(KEY.to_pem() + OTHER.to_pem()[:-9])


def test_the_work_of_all_keys_in_a_file_is_bounded(monkeypatch: pytest.MonkeyPatch) -> None:
    sealed = KEY.to_pem(b"pw", prf="sha256")
    monkeypatch.setattr(keyfiles, "MAX_ITERATIONS", 2 * keyfiles.ITERATIONS)
    with pytest.raises(InvalidKey, match="the password is wrong"):
        sm2.PrivateKey.from_pem(2 * sealed, b"other")
    with pytest.raises(InvalidKey, match="the keys ask for 300000 iterations in all; the limit is 200000"):
        sm2.PrivateKey.from_pem(3 * sealed, b"other")


@pytest.mark.parametrize("cipher", [cbc.AES256, cbc.TRIPLE_DES])
@pytest.mark.parametrize("size", [0, 1, 7, 8, 15, 16])
def test_padding_of_every_size_in_other_ciphers_than_ours(cipher: cbc.CBC, size: int) -> None:
    """PKCS#7 of 1 byte and of a whole block are the ends that a slip moves (RFC 5652, 6.3)."""
    pytest.importorskip("cryptography")
    key, iv, plain = bytes(range(cipher.key_length)), bytes(cipher.block), bytes(range(size))
    padded = cipher.decrypt(key, iv, cipher.encrypt(key, iv, plain))
    count = cipher.block - size % cipher.block
    assert padded == plain + bytes([count]) * count and cipher.unpadded(padded) == plain
    whole = bytes([cipher.block]) * cipher.block
    for bad in (padded[:-1] + b"\0", whole[:-1] + bytes([cipher.block + 1]), b"\1" + whole[1:]):
        with pytest.raises(InvalidPadding):
            cipher.unpadded(bad)
