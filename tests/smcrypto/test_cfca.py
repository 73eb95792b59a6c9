"""CFCA's request with a temporary key, and the key that comes back: examples of others, byte for byte."""

from __future__ import annotations

import base64
from collections.abc import Callable
from typing import Any

import pytest

from der_variants import opened, unchecked
from smcrypto import InvalidCiphertext, InvalidKey, InvalidOption, cfca, der, sm2, x509

# A request from CFCA's specification of double certificates, 3.2.
REQUEST = base64.b64decode(
    "MIIB0TCCAXUCAQAwWzENMAsGA1UEBh4EAEMATjEhMB8GA1UECh4YAEMARgBDAEEAIABUAEUAUwBUACAAQwBBMScwJQYDVQQDHh4AYwBlAHIAdABS"
    "AGUAcQB1AGkAcwBpAHQAaQBvAG4wWTATBgcqhkjOPQIBBggqgRzPVQGCLQNCAAQv93JF1oROzBImU6Plgleu+HI659cECfKn+gajy7JWGAEoSyw+"
    "9rsBWoRA+kqA7FmgO8NcNcm3fRBWS+yLBMLUoIG3MBMGCSqGSIb3DQEJBxMGMTExMTExMIGfBgkqhkiG9w0BCT8EgZEwgY4CAQEEgYgAtAAAAAEA"
    "AGmQSyS20/zQ4tHJQKA5EYPgdLuPE568SYcKlqmwWGjWAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAACokwM02BfEmqVM+qPPlx2I4v38"
    "pc1N4WgCxVb2QmgSygAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAAMAwGCCqBHM9VAYN1BQADSAAwRQIgfm4txwd5pHMPPtsHEfN+4Y8i"
    "MKmKCxy1T3eIMwkYS0kCIQCu6nbbBxVF99qaX1h1/qksk9u9fs6qkzlkrFbkPkvMjw=="
)
# gmsm, cfca/pkcs10_test.go: an answer, the temporary key that opens it, the key in it.
TEMPORARY = sm2.PrivateKey.from_bytes(bytes.fromhex("cacece36cac24aab94e52bcd5c0f552c95028f2856053135a1e47510b4c307ba"))
EXPECTED = sm2.PrivateKey.from_bytes(bytes.fromhex("f6e02c941a0dfdac58d8b3b1bc1bd136f179741b7465ebc7b0b25bb381840a3b"))
ANSWER = (
    b"MIHGAgEBBIHArhtKwTVT8dPEkykVRpvQNMxHv/yeqtaKZiSp2MbjcqMZtPfKW8Ia,tiIPPitNhQtU5C7gMbsUxgf5Yo16vDSXdoWqoOOaes2pEJwm"
    b"XWZI55lMMWc168Wg,zQ82fmMi05Vhlw9HNjGI3azE6MS5/ujSNGLZ0qAAmLnBiHlXFAXXAWRiy9MxZKwF,4xKn6qMaKmkqbYmTbBbEJEhzJBmu0IJ1"
    b"kNDcTFirAyapghHSw267erSUwsHjkQis,9mKYpzGied0E,"
)
HEADER = b"0000000000000001000000000000000100000000000000000000000000000000"
KEY = sm2.PrivateKey.from_int(0x1234567)


def attributes(request: bytes) -> bytes:
    """What stands in a request after its key, version and name."""
    body = opened(opened(request).raw())
    for _ in range(3):
        body.raw()
    return body.raw()


def test_the_temporary_key_is_written_as_cfca_does() -> None:
    theirs = attributes(REQUEST)
    start = theirs.index(bytes.fromhex("00b4000000010000")) + 8
    temporary = sm2.PublicKey.from_bytes(b"\4" + theirs[start : start + 32] + theirs[start + 64 : start + 96])
    ours = cfca.create_request(KEY, temporary, subject={"C": "CN", "O": "CFCA TEST CA", "CN": "certRequisition"})
    assert attributes(ours) == theirs
    body, algorithm, signature = opened(ours).rest()
    KEY.public_key.verify(unchecked(signature).bit_string(), body)
    assert algorithm == der.sequence(der.oid("1.2.156.10197.1.501"))
    members = opened(body)
    assert members.integer() == 0 and x509.Name.read(members).get("CN") == "certRequisition"
    assert sm2.PublicKey.from_der(members.raw()) == KEY.public_key
    other = cfca.create_request(KEY, temporary, subject={"CN": "x"}, password="a1B2", uid=b"bank")
    assert b"\x13\x04a1B2" in attributes(other)
    KEY.public_key.verify(unchecked(opened(other).rest()[2]).bit_string(),
                          opened(other).raw(), uid=b"bank")  # fmt: skip


@pytest.mark.parametrize("data", [
    ANSWER, ANSWER.replace(b",", b""), b"\n" + ANSWER + b"\n", HEADER + b"%016d" % len(ANSWER) + ANSWER,
], ids=range(4))  # fmt: skip
def test_the_key_that_comes_back(data: bytes) -> None:
    assert cfca.open_key(data, TEMPORARY) == EXPECTED
    with pytest.raises(InvalidCiphertext):
        cfca.open_key(data, KEY)


def sealed(text: bytes, version: int = 1) -> bytes:
    ciphertext = TEMPORARY.public_key.encrypt(text, encoding="c1c3c2")[1:]
    return base64.b64encode(der.sequence(der.integer(version), der.octet_string(ciphertext)))


PAIR = EXPECTED.public_key.to_bytes()[1:] + EXPECTED.to_bytes()


@pytest.mark.parametrize("data", [
    b"", b"!", ANSWER[:-5], HEADER, HEADER + b"%016d" % 9 + ANSWER, HEADER + b"-" * 16, ANSWER.replace(b",", b", "),
    sealed(PAIR, 2), sealed(PAIR[:-1]), sealed(PAIR[:64] + bytes(32)), sealed(PAIR[:64] + KEY.to_bytes()),
    sealed(KEY.public_key.to_bytes()[1:] + EXPECTED.to_bytes()),
], ids=range(12))  # fmt: skip
def test_what_is_no_answer(data: bytes) -> None:
    assert cfca.open_key(sealed(PAIR), TEMPORARY) == EXPECTED
    with pytest.raises(InvalidKey):
        cfca.open_key(data, TEMPORARY)


@pytest.mark.parametrize("call, error", [
    (lambda: cfca.create_request(KEY, KEY.public_key, subject={"CN": "x"}, password=""), InvalidOption),
    (lambda: cfca.create_request(KEY, KEY.public_key, subject={"CN": "x"}, password="密码"), InvalidOption),
    (lambda: cfca.create_request(KEY, KEY.public_key, subject={"CN": "x"}, password="a b"), InvalidOption),
    (lambda: cfca.create_request(KEY, KEY.public_key, subject={"CN": "x"}, password=b"1"), TypeError),
    (lambda: cfca.create_request(KEY, KEY, subject={"CN": "x"}), TypeError),
    (lambda: cfca.create_request(b"", KEY.public_key, subject={"CN": "x"}), TypeError),
    (lambda: cfca.open_key("", TEMPORARY), TypeError),
    (lambda: cfca.open_key(ANSWER, TEMPORARY.public_key), TypeError),
])  # fmt: skip
def test_wrong_calls(call: Callable[[], Any], error: type[Exception]) -> None:
    with pytest.raises(error):
        call()
