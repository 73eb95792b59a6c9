"""CFCA's two certificates for one request, which names a temporary key; under that the encryption key comes back.

China Financial Certification Authority, "Application for and download of SM2 double certificates"; its software (SADK)
and gmsm write and read the same. The request is a PKCS#10 (RFC 2986) with two attributes, each an identifier and its
value without the SET around it that RFC 2986 wants, which is why `x509.CertificateSigningRequest` does not read it.

A CA that follows GM/T 0009 instead answers with SM2EnvelopedKey: `PrivateKey.from_enveloped`.
"""

from __future__ import annotations

from base64 import b64decode
from collections.abc import Iterable, Mapping
from typing import Final

from smcrypto import der, sm2
from smcrypto.errors import InvalidEncoding, InvalidKey, InvalidOption
from smcrypto.inputs import BytesLike, as_bytes, require_type
from smcrypto.sm2.keyfiles import standard_point
from smcrypto.x509 import Name
from smcrypto.x509.signed import sign

__all__ = ["create_request", "open_key"]

_CHALLENGE: Final = "1.2.840.113549.1.9.7"  # challengePassword, RFC 2985, 5.4.1
_TEMPORARY_KEY: Final = "1.2.840.113549.1.9.63"  # CFCA's own
_KEY_HEADER: Final = bytes.fromhex("00b4000000010000")
# Before the key that comes back may stand this, and its length in 16 digits.
_ANSWER_HEADER: Final = b"0000000000000001" * 2 + b"0" * 32


def create_request(
    key: sm2.PrivateKey,
    temporary: sm2.PublicKey,
    *,
    subject: Name | str | Mapping[str, str] | Iterable[tuple[str, str]],
    password: str = "111111",  # noqa: S107 - CFCA's default, and no secret: the request is not encrypted
    uid: BytesLike = sm2.DEFAULT_UID,
) -> bytes:
    """A signing request in DER, signed by `key`, for two certificates: of `key`, and of a key that CFCA makes.

    temporary: of a key that is used for nothing else; `open_key` wants its private key. password: ASCII letters and
    digits, one at least, as agreed upon with CFCA. InvalidOption: another password, or a name that cannot be written.
    """
    require_type(key, sm2.PrivateKey, "key")
    require_type(temporary, sm2.PublicKey, "temporary")
    require_type(password, str, "password")
    if not (password.isascii() and password.isalnum()):
        raise InvalidOption("the password must be ASCII letters and digits")
    point = standard_point(temporary)
    # Each coordinate stands before 32 bytes of zero, which are there for larger keys.
    coordinates = _KEY_HEADER + point[1:33] + bytes(32) + point[33:] + bytes(32)
    named_key = der.octet_string(der.sequence(der.integer(1), der.octet_string(coordinates)))
    attributes = der.explicit(
        0,
        der.sequence(der.oid(_CHALLENGE), der.element(der.PRINTABLE_STRING, password.encode("ascii"))),
        der.sequence(der.oid(_TEMPORARY_KEY), named_key),
    )
    body = der.sequence(der.integer(0), Name.build(subject).to_der(), key.public_key.to_der(), attributes)
    return sign(body, key, as_bytes(uid, "uid"))


def open_key(data: BytesLike, temporary: sm2.PrivateKey) -> sm2.PrivateKey:
    """The private key for encryption that came back, opened with the temporary key of the request.

    data: as CFCA sends it, base64, commas in it or not, after a header of 80 digits or not. InvalidKey: not such an
    answer, or what is in it is no pair of keys. InvalidCiphertext: encrypted for another key.
    """
    text = as_bytes(data, "data").strip()
    require_type(temporary, sm2.PrivateKey, "temporary")
    if text.startswith(_ANSWER_HEADER):
        length, text = text[64:80], text[80:]
        if length != b"%016d" % len(text):
            raise InvalidKey(f"the header says another length than the {len(text)} bytes after it")
    try:
        with der.reading_sequence(b64decode(text.replace(b",", b""), validate=True)) as members:
            if members.integer() != 1:
                raise InvalidEncoding("the version is not 1")
            sealed = members.octet_string()
    except ValueError as error:  # of base64, and InvalidEncoding, which is one
        raise InvalidKey(f"not a key as CFCA sends it: {error}") from None
    pair = temporary.decrypt(b"\x04" + sealed, encoding="c1c3c2")
    if len(pair) != 96:
        raise InvalidKey(f"a public and a private key have 96 bytes, not {len(pair)}")
    key = sm2.PrivateKey.from_bytes(pair[64:])
    if key.public_key.to_bytes() != b"\x04" + pair[:64]:
        raise InvalidKey("the private key is not that of the public key beside it")
    return key
