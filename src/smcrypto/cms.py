"""Signed and enveloped messages with SM2, SM3 and SM4: GM/T 0010-2012, GB/T 35275-2017 (RFC 2315's syntax); RFC 5652.

SignedData, EnvelopedData and SignedAndEnvelopedData, attached or detached. A signature is SM2's with Z of the uid, over
the content's octets; where there are authenticated attributes, over their DER as a SET OF, in which messageDigest is
SM3 of the content. The content key of an envelope is encrypted by SM2, the content by SM4-CBC.

Written are the identifiers of the Chinese standards ("gm") or those that Bouncy Castle reads ("rfc"): RFC 5652's
content types, SM2-with-SM3 as signature, and in envelopes SM2 as C1C2C3 and AES-128-CBC, since it finds no SM4 here.
Read are both, NULL or nothing for the parameters of algorithms, and BER for the frame (see `ber`). The members of a SET
OF may stand in any order, but the attributes, which are signed, must be sorted. All else is strict DER.

An envelope hides; it does not show who made it, nor that it was not changed. `sign_and_encrypt` does both. Not here:
countersignatures and timestamps (unauthenticated attributes are skipped), key agreement, recipients without a
certificate, hashes other than SM3. Certificates and recipients of other algorithms are passed over.
"""

from __future__ import annotations

import hashlib
import secrets
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from datetime import datetime
from hmac import compare_digest
from typing import Final, Literal, NamedTuple, TypeAlias

from smcrypto import ber, cbc, der, pem, sm2, sm3
from smcrypto.errors import (
    CertificateAlgorithmError,
    CertificateError,
    InvalidCiphertext,
    InvalidEncoding,
    InvalidKey,
    InvalidOption,
    InvalidPadding,
    InvalidSignature,
)
from smcrypto.inputs import BytesLike, as_bytes, require_type
from smcrypto.x509 import AnyCertificate, Certificate, CertificateRevocationList, Name, verify_chain
from smcrypto.x509.certificate import load_der_certificate, require_usage
from smcrypto.x509.signed import instant

__all__ = ["Identifiers", "Signed", "decrypt", "decrypt_and_verify", "encrypt", "sign", "sign_and_encrypt", "verify"]

Identifiers: TypeAlias = Literal["gm", "rfc"]
"""Of the Chinese standards, or those that Java reads."""

# Kinds of content, the last arc: GM/T 0010, 6; RFC 2315, 14; RFC 5652.
_DATA, _SIGNED, _ENVELOPED, _SIGNED_AND_ENVELOPED = 1, 2, 3, 4
_ARCS: Final = {"gm": "1.2.156.10197.6.1.4.2", "rfc": "1.2.840.113549.1.7"}
_KINDS: Final = {f"{arc}.{kind}": kind for arc in _ARCS.values() for kind in (1, 2, 3, 4)}
_DATA_TYPES: Final = tuple(f"{arc}.{_DATA}" for arc in _ARCS.values())
# Algorithms: GM/T 0006; the last as Bouncy Castle's GMObjectIdentifiers has it.
_SM3: Final = "1.2.156.10197.1.401"
_SM2_SIGN: Final = {"gm": "1.2.156.10197.1.301.1", "rfc": "1.2.156.10197.1.501"}
_SM2_ENCRYPT: Final = {"gm": "1.2.156.10197.1.301.3", "rfc": "1.2.156.10197.1.301.3.2.1"}
# What stands for "signed by SM2" and "encrypted by SM2": also SM2 itself.
_SIGNATURES: Final = (*_SM2_SIGN.values(), "1.2.156.10197.1.301")
_ENCRYPTIONS: Final = (*_SM2_ENCRYPT.values(), "1.2.156.10197.1.301")
# Attributes: RFC 2985, 5.3.
_CONTENT_TYPE: Final = "1.2.840.113549.1.9.3"
_MESSAGE_DIGEST: Final = "1.2.840.113549.1.9.4"
_SIGNING_TIME: Final = "1.2.840.113549.1.9.5"

_LABELS: Final = ("CMS", "PKCS7")  # RFC 7468, 8 and 9


class Signed(NamedTuple):
    """A verified message: its content, its signers, all of them trusted, and when they say they signed (or None)."""

    content: bytes
    signers: tuple[Certificate, ...]
    times: tuple[datetime | None, ...]


# --- signed ---


def sign(
    content: BytesLike,
    key: sm2.PrivateKey,
    certificate: Certificate,
    *,
    detached: bool = False,
    certificates: Iterable[AnyCertificate] = (),
    signing_time: datetime | None = None,
    identifiers: Identifiers = "gm",
    uid: BytesLike = sm2.DEFAULT_UID,
) -> bytes:
    """SignedData in DER, with `certificate` and `certificates` (its issuers) inside.

    detached: without the content, which travels beside it. signing_time: aware; adds the authenticated attributes.
    identifiers: "rfc" for Java. InvalidKey: `key` is not the key of `certificate`. CertificateError: a certificate that
    `verify` would refuse, as it is not for signing, has an unknown critical extension, or is not in force at the
    signing_time. InvalidOption: other identifiers; a naive time; or, without signing_time, a content that has the form
    of authenticated attributes, which `verify` refuses. Source: GM/T 0010, 8; RFC 5652, 5.
    """
    _require_identifiers(identifiers)
    data = as_bytes(content, "content")
    signer = _signer_info(data, key, certificate, signing_time, identifiers, uid)
    inside = b"" if detached else der.explicit(0, der.octet_string(data))
    digests, held = der.set_of(der.algorithm(_SM3)), der.sequence(_kind(identifiers, _DATA), inside)
    chain = _certificates([certificate, *certificates])
    return _message(identifiers, _SIGNED, der.integer(1), digests, held, chain, der.set_of(signer))


def verify(
    data: BytesLike,
    *,
    roots: Iterable[AnyCertificate],
    at: datetime,
    content: BytesLike | None = None,
    intermediates: Iterable[AnyCertificate] = (),
    crls: Iterable[CertificateRevocationList] = (),
    uid: BytesLike = sm2.DEFAULT_UID,
) -> Signed:
    """The content and its signers, once every signature holds and every signer is to be trusted.

    data: SignedData, or PEM of it labelled CMS or PKCS7. roots: trusted at the moment `at`; to trust one signer without
    its issuer, give the signer's certificate. content: of a detached message, which must not have one inside.
    intermediates, crls: as of `x509.verify_chain`; the certificates and revocation lists inside are used as if given,
    so a list inside must be in force at the moment `at`. uid: of the signers.
    InvalidEncoding: not such a message, or the content is missing or twice. InvalidSignature: a signature does not
    hold, or there is none. CertificateError: a signer is not to be trusted, or has no certificate here.
    """
    trust = Trust(tuple(roots), at, tuple(intermediates), tuple(crls), as_bytes(uid, "uid"))
    return verify_typed(as_bytes(data, "data"), None if content is None else as_bytes(content, "content"), trust)[0]


class Trust(NamedTuple):
    """What signers are judged by: `types` of content that count, `purposes` that their certificates must allow."""

    roots: tuple[AnyCertificate, ...]
    at: datetime
    intermediates: tuple[AnyCertificate, ...]
    crls: tuple[CertificateRevocationList, ...]
    uid: bytes
    types: tuple[str, ...] = _DATA_TYPES
    purposes: tuple[str, ...] = ()


def verify_typed(data: bytes, content: bytes | None, trust: Trust) -> tuple[Signed, list[dict[str, bytes]]]:
    """As `verify`; and the first value of each attribute of each signer, in DER, by type."""
    with _opened(data, _SIGNED) as body:
        body.set_in_any_order().each(_read_digest)
        inside = body.sequence()
        _require_type(inside, trust.types)
        held = inside.explicit(0).octet_string() if inside.has_explicit(0) else None
        if (held is None) == (content is None):
            raise InvalidEncoding(f"the content is {'missing' if held is None else 'inside and given as well'}")
        return _verified(body, held or content or b"", trust)


def _verified(body: der.Reader, content: bytes, trust: Trust) -> tuple[Signed, list[dict[str, bytes]]]:
    """The end of SignedData and of SignedAndEnvelopedData: certificates, revocation lists, signers."""
    known = [*map(load_der_certificate, _members(body, 0)), *trust.intermediates]
    lists = [*map(CertificateRevocationList.from_der, _members(body, 1)), *trust.crls]
    infos = body.set_in_any_order().each(lambda one: _verify_signer(one.sequence(), content, known, trust))
    if not infos:
        raise InvalidSignature("nobody signed the message")
    signers, attributes = tuple(signer for signer, _ in infos), [values for _, values in infos]
    for certificate in dict.fromkeys(signers):
        verify_chain(certificate, intermediates=known, roots=trust.roots, at=trust.at, crls=lists,
                     extended_key_usage=trust.purposes)  # fmt: skip
    times = (der.parse(one[_SIGNING_TIME], der.Reader.time) if _SIGNING_TIME in one else None for one in attributes)
    return Signed(content, signers, tuple(times)), attributes


def _verify_signer(
    info: der.Reader, content: bytes, known: Sequence[AnyCertificate], trust: Trust
) -> tuple[Certificate, dict[str, bytes]]:
    """One SignerInfo, GM/T 0010, 8.2; RFC 5652, 5.3."""
    _require_version(info)
    is_named, name = _read_identifier(info)
    certificate = next(filter(is_named, known), None)
    if certificate is None:
        raise CertificateError(f"the certificate of a signer is not here: {name}")
    if not isinstance(certificate, Certificate):
        raise CertificateAlgorithmError(f"the key of {certificate.subject} is {certificate.algorithm}, not SM2")
    _read_digest(info)
    signed, values = content, dict[str, bytes]()
    if info.has_explicit(0):
        signed, values = _read_attributes(info.implicit_set_of(0), content, trust.types)
    elif _are_attributes(content):
        raise InvalidSignature("what was signed are the attributes of another message")
    info.algorithm(_SIGNATURES, "signature")
    signature = info.octet_string()
    if info.has_explicit(1):
        info.explicit(1).rest()
    _require_signer(certificate)
    certificate.public_key.verify(signature, signed, uid=trust.uid)
    return certificate, values


def _require_signer(certificate: Certificate) -> None:
    require_usage(certificate, "may not sign", "digitalSignature", "nonRepudiation")


def _are_attributes(content: bytes) -> bool:
    """Is `content` what another message's signature covers, its attributes?

    Without this, whoever has a message with attributes could make one without them, and with their DER as its content.
    A SET with the identifier of messageDigest anywhere in it is enough: other signers' attributes may have values that
    are not read here.
    """
    try:
        attributes = der.parse(content, lambda outer: outer.value(der.SET))
    except InvalidEncoding:
        return False
    return der.oid(_MESSAGE_DIGEST) in attributes


def _read_attributes(
    attributes: der.Reader, content: bytes, types: tuple[str, ...]
) -> tuple[bytes, dict[str, bytes]]:
    """(their DER as a SET OF, their values); InvalidSignature unless they are of this content (RFC 2315, 9.2)."""
    parts, values = attributes.rest(), dict[str, bytes]()
    for part in parts:
        with der.reading_sequence(part) as attribute:
            kind = attribute.oid()
            members = attribute.set_of()
            value = members.raw()
            if kind in values:
                raise InvalidEncoding(f"the attribute {kind} is there twice")
            if kind not in (_CONTENT_TYPE, _MESSAGE_DIGEST, _SIGNING_TIME):
                members.rest()
            values[kind] = value
    if _MESSAGE_DIGEST not in values or _CONTENT_TYPE not in values:
        raise InvalidEncoding("the attributes lack the content's type or its digest (RFC 2315, 9.2)")
    kind = der.parse(values[_CONTENT_TYPE], der.Reader.oid)
    digest = der.parse(values[_MESSAGE_DIGEST], der.Reader.octet_string)
    if kind not in types or not compare_digest(digest, sm3.digest(content)):
        raise InvalidSignature("the content is not the one that was signed")
    return der.set_of(*parts), values


def _signer_info(
    data: bytes, key: sm2.PrivateKey, certificate: Certificate, time: datetime | None, identifiers: Identifiers,
    uid: BytesLike,
) -> bytes:  # fmt: skip
    _require_pair(key, certificate)
    moment = certificate.not_before if time is None else instant(time, "signing_time")
    _require_signer(certificate)
    verify_chain(certificate, roots=[certificate], at=moment)  # what does not depend on who issued it
    signed, attributes = data, b""
    if time is not None:
        values = {
            _CONTENT_TYPE: _kind(identifiers, _DATA),
            _MESSAGE_DIGEST: der.octet_string(sm3.digest(data)),
            _SIGNING_TIME: der.time(moment),
        }
        signed = der.set_of(*(der.sequence(der.oid(kind), der.set_of(value)) for kind, value in values.items()))
        attributes = b"\xa0" + signed[1:]  # [0] IMPLICIT in place of SET
    elif _are_attributes(data):
        raise InvalidOption("the content has the form of authenticated attributes: sign it with a signing_time")
    return der.sequence(
        der.integer(1),
        _issuer_and_serial(certificate),
        der.algorithm(_SM3),
        attributes,
        der.algorithm(_SM2_SIGN[identifiers]),
        der.octet_string(key.sign(signed, uid=uid)),
    )


# --- enveloped ---


def encrypt(
    content: BytesLike,
    recipients: Iterable[Certificate],
    *,
    identifiers: Identifiers = "gm",
    named_by: Literal["issuer", "key"] = "issuer",
) -> bytes:
    """EnvelopedData in DER, which any of `recipients` opens with its private key.

    Nothing shows who made it, nor that it was changed: `sign_and_encrypt` does both.

    recipients: one at least, otherwise InvalidOption. identifiers: "rfc" for Java, with AES-128-CBC by the package
    `cryptography`; MissingDependency without it. named_by: "issuer" and serial number, or "key", which is the
    SubjectKeyIdentifier that CFCA's software writes. CertificateError: a recipient whose certificate is not for
    encryption (of TLCP's two certificates it is the second). Source: GM/T 0010, 9; RFC 5652, 6.
    """
    _require_identifiers(identifiers)
    if named_by not in ("issuer", "key"):
        raise InvalidOption(f"named_by must be 'issuer' or 'key', not {named_by!r}")
    version, infos, sealed = _envelope(as_bytes(content, "content"), recipients, identifiers, named_by)
    return _message(identifiers, _ENVELOPED, version, infos, sealed)


def decrypt(data: BytesLike, key: sm2.PrivateKey, certificate: Certificate) -> bytes:
    """The content of EnvelopedData, which nothing authenticates: a message that was altered gives another content.

    Padding that is not well formed is therefore left in the content: an error would tell whoever alters messages what
    the content is (Vaudenay, 2002). Where that matters, only `sign_and_encrypt` and `decrypt_and_verify` are safe.

    data: as of `verify`. InvalidEncoding: not such a message. InvalidKey: `key` is not the key of `certificate`.
    CertificateError: the message is not for `certificate`. InvalidCiphertext: the content key does not open, or the
    encrypted content is not a whole number of blocks. MissingDependency: AES, without the package `cryptography`.
    """
    with _opened(as_bytes(data, "data"), _ENVELOPED) as body:
        sealed_key = _own_key(body, key, certificate)
        cipher, iv, ciphertext = _encrypted_content(body)
        if body.has_explicit(1):  # unprotectedAttrs
            body.explicit(1).rest()
    return _decrypted(sealed_key, key, cipher, iv, ciphertext)


def sign_and_encrypt(
    content: BytesLike,
    key: sm2.PrivateKey,
    certificate: Certificate,
    recipients: Iterable[Certificate],
    *,
    certificates: Iterable[AnyCertificate] = (),
    uid: BytesLike = sm2.DEFAULT_UID,
) -> bytes:
    """SignedAndEnvelopedData in DER; the signature is over the content, not encrypted. Source: GM/T 0010, 10.

    Arguments and errors as of `sign` and `encrypt`. RFC 5652 has no such type, and Java reads none.
    """
    data = as_bytes(content, "content")
    signer = _signer_info(data, key, certificate, None, "gm", uid)
    version, infos, sealed = _envelope(data, recipients, "gm", "issuer")
    parts = der.set_of(der.algorithm(_SM3)), sealed, _certificates([certificate, *certificates])
    return _message("gm", _SIGNED_AND_ENVELOPED, version, infos, *parts, der.set_of(signer))


def decrypt_and_verify(
    data: BytesLike,
    key: sm2.PrivateKey,
    certificate: Certificate,
    *,
    roots: Iterable[AnyCertificate],
    at: datetime,
    intermediates: Iterable[AnyCertificate] = (),
    crls: Iterable[CertificateRevocationList] = (),
    uid: BytesLike = sm2.DEFAULT_UID,
) -> Signed:
    """The content of SignedAndEnvelopedData and its signers; arguments and errors as of `decrypt` and `verify`.

    A content that was changed is InvalidSignature, whatever its padding.
    """
    with _opened(as_bytes(data, "data"), _SIGNED_AND_ENVELOPED) as body:
        sealed_key = _own_key(body, key, certificate)
        body.set_in_any_order().each(_read_digest)
        content = _decrypted(sealed_key, key, *_encrypted_content(body))
        trust = Trust(tuple(roots), at, tuple(intermediates), tuple(crls), as_bytes(uid, "uid"))
        return _verified(body, content, trust)[0]


def _envelope(
    content: bytes, recipients: Iterable[Certificate], identifiers: Identifiers, named_by: str
) -> tuple[bytes, bytes, bytes]:
    """(version, RecipientInfos, EncryptedContentInfo) under a fresh key."""
    key, iv = secrets.token_bytes(16), secrets.token_bytes(16)
    # Of the message and of each RecipientInfo: RFC 5652, 6.1 and 6.2.1; GM/T 0010 has 1.
    version = der.integer(2 if named_by == "key" else 1 if identifiers == "gm" else 0)
    infos: list[bytes] = []
    for certificate in recipients:
        require_type(certificate, Certificate, "each of recipients")
        require_usage(certificate, "is not for encryption", "keyEncipherment", "dataEncipherment", "keyAgreement")
        name = der.implicit(0, _key_identifier(certificate)) if named_by == "key" else _issuer_and_serial(certificate)
        sealed = certificate.public_key.encrypt(key, encoding="der" if identifiers == "gm" else "c1c2c3")
        infos.append(der.sequence(version, name, der.algorithm(_SM2_ENCRYPT[identifiers]), der.octet_string(sealed)))
    if not infos:
        raise InvalidOption("there is no recipient")
    cipher = cbc.SM4 if identifiers == "gm" else cbc.AES128
    ciphertext = der.implicit(0, cipher.encrypt(key, iv, content))
    return version, der.set_of(*infos), der.sequence(_kind(identifiers, _DATA), cipher.algorithm(iv), ciphertext)


def _own_key(body: der.Reader, key: sm2.PrivateKey, certificate: Certificate) -> bytes:
    """The encrypted content key that is meant for `certificate`; recipients of other kinds are passed over."""
    _require_pair(key, certificate)
    found = None
    for one in body.set_in_any_order().rest():
        if one[0] != der.SEQUENCE:
            continue
        with der.reading_sequence(one) as info:
            _require_version(info)
            if found is None and _read_identifier(info)[0](certificate):
                info.algorithm(_ENCRYPTIONS, "key encryption")
                found = info.octet_string()
            else:
                info.rest()
    if found is None:
        raise CertificateError(f"the message is not for {certificate.subject}, serial {certificate.serial_number:x}")
    return found


def _encrypted_content(body: der.Reader) -> tuple[cbc.CBC, bytes, bytes]:
    """(cipher, IV, ciphertext) of an EncryptedContentInfo."""
    info = body.sequence()
    _require_type(info)
    cipher, iv = cbc.read_algorithm(info.sequence(), "the content")
    return cipher, iv, ber.octets(info.explicit(0)) if info.has_explicit(0) else info.implicit(0)


def _decrypted(sealed_key: bytes, key: sm2.PrivateKey, cipher: cbc.CBC, iv: bytes, ciphertext: bytes) -> bytes:
    """The content, with its padding where that is not well formed: to tell would give the content away."""
    # Raw ones are C1C2C3: Bouncy Castle's, and without their 04 those of CFCA's software before version 3.2.
    if len(sealed_key) == 96 + cipher.key_length:
        sealed_key = b"\x04" + sealed_key
    content_key = key.decrypt(sealed_key, encoding="c1c2c3" if sealed_key[:1] == b"\x04" else "der")
    if len(content_key) != cipher.key_length or not ciphertext or len(ciphertext) % cipher.block:
        raise InvalidCiphertext("the encrypted content is no whole number of blocks, or its key has no fit")
    plaintext = cipher.decrypt(content_key, iv, ciphertext)
    with suppress(InvalidPadding):
        return cipher.unpadded(plaintext)
    return plaintext


# --- what all have in common ---


def _require_identifiers(identifiers: str) -> None:
    if identifiers not in _ARCS:
        raise InvalidOption(f"identifiers must be 'gm' or 'rfc', not {identifiers!r}")


def _require_pair(key: sm2.PrivateKey, certificate: Certificate) -> None:
    require_type(key, sm2.PrivateKey, "key")
    require_type(certificate, Certificate, "certificate")
    if key.public_key != certificate.public_key:
        raise InvalidKey("key is not the key of certificate")


def _kind(identifiers: Identifiers, kind: int) -> bytes:
    return der.oid(f"{_ARCS[identifiers]}.{kind}")


def _message(identifiers: Identifiers, kind: int, *parts: bytes) -> bytes:
    return der.sequence(_kind(identifiers, kind), der.explicit(0, der.sequence(*parts)))


@contextmanager
def _opened(data: bytes, kind: int) -> Iterator[der.Reader]:
    """The body of a ContentInfo of this kind, its version read."""
    # Binary first: a message may well have PEM in its content. Below its fourth level are certificates and what is
    # signed, which are DER.
    octets = ber.to_der(data if data[:1] == b"\x30" else pem.first(data, _LABELS).der, below=4)
    with der.reading_sequence(octets) as info:
        name = info.oid()
        if _KINDS.get(name) != kind:
            raise InvalidEncoding(f"the message is of the kind {name}, not {_ARCS['gm']}.{kind}")
        body = info.explicit(0).sequence()
        _require_version(body)
        yield body


def _require_version(reader: der.Reader) -> None:
    """1 after GM/T 0010; RFC 5652 has 0 and 2 in envelopes and their recipients, 3 for signers named by their key."""
    if (version := reader.integer()) > 3:
        raise InvalidEncoding(f"version {version}")


def _read_digest(reader: der.Reader) -> str:
    return reader.algorithm((_SM3,), "hash")


def _require_type(reader: der.Reader, types: Sequence[str] = _DATA_TYPES) -> None:
    if (name := reader.oid()) not in types:
        raise InvalidEncoding(f"the content is of the kind {name}, not {' or '.join(types)}")


def _members(reader: der.Reader, number: int) -> list[bytes]:
    """The values under the constructed tag [number], if it is there: certificates, revocation lists."""
    return reader.explicit(number).each(der.Reader.raw) if reader.has_explicit(number) else []


def _certificates(certificates: Sequence[AnyCertificate]) -> bytes:
    for certificate in certificates:
        require_type(certificate, AnyCertificate, "each of certificates")
    return der.explicit(0, *sorted({certificate.to_der() for certificate in certificates}))


def _issuer_and_serial(certificate: Certificate) -> bytes:
    return der.sequence(certificate.issuer.to_der(), der.integer(certificate.serial_number))


def _key_identifier(certificate: Certificate) -> bytes:
    """Its SubjectKeyIdentifier; where it has none, as CFCA does, SHA-1 of its point (RFC 5280, 4.2.1.2, (1))."""
    point = certificate.public_key.to_bytes()
    return certificate.subject_key_identifier or hashlib.sha1(point, usedforsecurity=False).digest()


def _read_identifier(reader: der.Reader) -> tuple[Callable[[AnyCertificate], bool], str]:
    """Is a certificate the one that a message names, by issuer and serial number or by SubjectKeyIdentifier (RFC 5652,
    5.3)? And the name for people."""
    if reader.has_implicit(0):
        key = reader.implicit(0)
        return lambda one: isinstance(one, Certificate) and _key_identifier(one) == key, f"key {key.hex()}"
    pair = reader.sequence()
    issuer, serial = Name.read(pair), pair.integer(signed=True)
    return (
        lambda one: one.serial_number == serial and one.issuer == issuer, f"serial {serial:x}, issued by {issuer}"
    )  # fmt: skip
