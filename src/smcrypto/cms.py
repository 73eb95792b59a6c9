"""Signed and enveloped messages with SM2, SM3 and SM4: GM/T 0010-2012, GB/T 35275-2017 (the syntax of RFC 2315).

SignedData, EnvelopedData and SignedAndEnvelopedData, attached or detached. A signature is SM2's with Z of the uid, over
the content's octets; where there are authenticated attributes, over their DER as a SET OF, in which messageDigest is
SM3 of the content. The content key of an envelope is encrypted by SM2 as GM/T 0009 writes it, the content by SM4-CBC.

Written are the object identifiers of the standards. Read are those of RFC 2315 as well, and NULL or nothing for
the parameters of algorithms. The members of a SET OF may stand in any order, as RFC 2315 has no DER there and writers
do not sort; the attributes, which are signed, must be sorted. All else is strict DER.

An envelope hides; it does not show who made it, nor that it was not changed. `sign_and_encrypt` does both. Not here:
countersignatures and timestamps (unauthenticated attributes are skipped), key agreement, recipients without a
certificate, hashes other than SM3.
"""

from __future__ import annotations

import secrets
from collections.abc import Iterable, Iterator, Sequence
from datetime import datetime
from hmac import compare_digest
from typing import Final, NamedTuple

from smcrypto import der, pem, sm2, sm3, sm4
from smcrypto.errors import (
    CertificateError,
    InvalidCiphertext,
    InvalidEncoding,
    InvalidKey,
    InvalidOption,
    InvalidPadding,
    InvalidSignature,
)
from smcrypto.inputs import BytesLike, as_bytes, require_type
from smcrypto.x509 import Certificate, CertificateRevocationList, Name, verify_chain
from smcrypto.x509.signed import instant

__all__ = ["Signed", "decrypt", "decrypt_and_verify", "encrypt", "sign", "sign_and_encrypt", "verify"]

# Content types: GM/T 0010, 6, and RFC 2315, 14.
_DATA, _SIGNED, _ENVELOPED, _SIGNED_AND_ENVELOPED = (f"1.2.156.10197.6.1.4.2.{i}" for i in (1, 2, 3, 4))
_KINDS: Final = {
    f"{arc}.{i}": f"1.2.156.10197.6.1.4.2.{i}"
    for arc in ("1.2.156.10197.6.1.4.2", "1.2.840.113549.1.7") for i in (1, 2, 3, 4)
}  # fmt: skip
# Algorithms: GM/T 0006.
_SM3: Final = "1.2.156.10197.1.401"
_SM2_SIGN: Final = "1.2.156.10197.1.301.1"
_SM2_ENCRYPT: Final = "1.2.156.10197.1.301.3"
_SM4_CBC: Final = "1.2.156.10197.1.104.2"
# What stands for "signed by SM2": also SM2 itself, and SM2-with-SM3.
_SIGNATURES: Final = (_SM2_SIGN, "1.2.156.10197.1.301", "1.2.156.10197.1.501")
_ENCRYPTIONS: Final = (_SM2_ENCRYPT, "1.2.156.10197.1.301")
# Attributes: RFC 2985, 5.3.
_CONTENT_TYPE: Final = "1.2.840.113549.1.9.3"
_MESSAGE_DIGEST: Final = "1.2.840.113549.1.9.4"
_SIGNING_TIME: Final = "1.2.840.113549.1.9.5"

_LABELS: Final = ("CMS", "PKCS7")  # RFC 7468, 8 and 9
_NOT_FOR_US: Final = "the message does not open with this key, or is damaged"


class Signed(NamedTuple):
    """A verified message: its content, who signed it, and when they say they did (None where they do not say)."""

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
    certificates: Iterable[Certificate] = (),
    signing_time: datetime | None = None,
    uid: BytesLike = sm2.DEFAULT_UID,
) -> bytes:
    """SignedData in DER, with `certificate` and `certificates` (its issuers) inside.

    detached: without the content, which travels beside it. signing_time: aware; adds the authenticated attributes.
    InvalidKey: `key` is not the key of `certificate`. InvalidOption: a naive time; or, without signing_time, a content
    that has the form of authenticated attributes, which `verify` refuses. Source: GM/T 0010, 8.
    """
    data, signer = as_bytes(content, "content"), _signer_info(content, key, certificate, signing_time, uid)
    inner = () if detached else (der.explicit(0, der.octet_string(data)),)
    return _message(
        _SIGNED,
        der.integer(1),
        der.set_of(_algorithm(_SM3)),
        der.sequence(der.oid(_DATA), *inner),
        _certificates([certificate, *certificates]),
        der.set_of(signer),
    )


def verify(
    data: BytesLike,
    *,
    roots: Iterable[Certificate] | None,
    at: datetime,
    content: BytesLike | None = None,
    intermediates: Iterable[Certificate] = (),
    crls: Iterable[CertificateRevocationList] = (),
    uid: BytesLike = sm2.DEFAULT_UID,
) -> Signed:
    """The content and its signers, once every signature holds and every signer is to be trusted.

    data: SignedData in DER, or PEM labelled CMS or PKCS7. roots: trusted at the moment `at`; None leaves the trust
    in the signers' certificates to the caller. content: of a detached message, which must not have one inside.
    intermediates, crls: as of `x509.verify_chain`; the certificates and revocation lists inside are used as if given,
    so a list inside must be in force at the moment `at`. uid: of the signers.
    InvalidEncoding: not such a message, or the content is missing or twice. InvalidSignature: a signature does not
    hold, or there is none. CertificateError: a signer is not to be trusted, or has no certificate here.
    """
    body = _opened(as_bytes(data, "data"), _SIGNED)
    _require_digests(body)
    inside = body.sequence()
    _require_data(inside)
    held: bytes | None = None
    if inside.has_explicit(0):
        wrapped = inside.explicit(0)
        held = wrapped.octet_string()
        wrapped.finish()
    inside.finish()
    if content is not None:
        if held is not None:
            raise InvalidEncoding("the content is inside and given as well")
        held = as_bytes(content, "content")
    if held is None:
        raise InvalidEncoding("the content is missing")
    return _verified(body, held, _Trust.of(roots, at, intermediates, crls, uid))


class _Trust(NamedTuple):
    """What signers are judged by."""

    roots: tuple[Certificate, ...] | None
    at: datetime
    intermediates: tuple[Certificate, ...]
    crls: tuple[CertificateRevocationList, ...]
    uid: bytes

    @classmethod
    def of(
        cls, roots: Iterable[Certificate] | None, at: datetime, intermediates: Iterable[Certificate],
        crls: Iterable[CertificateRevocationList], uid: BytesLike,
    ) -> _Trust:  # fmt: skip
        trusted = None if roots is None else tuple(roots)
        return cls(trusted, instant(at, "at"), tuple(intermediates), tuple(crls), as_bytes(uid, "uid"))


def _verified(body: der.Reader, content: bytes, trust: _Trust) -> Signed:
    """The end of SignedData and of SignedAndEnvelopedData: certificates, revocation lists, signers."""
    found = [Certificate.from_der(one) for one in _members(body, 0)]
    lists = [CertificateRevocationList.from_der(one) for one in _members(body, 1)]
    infos = body.set_in_any_order()
    signers: list[Certificate] = []
    times: list[datetime | None] = []
    known = [*found, *trust.intermediates]
    while not infos.at_end():
        certificate, time = _verify_signer(infos.sequence(), content, known, trust.uid)
        signers.append(certificate)
        times.append(time)
    body.finish()
    if not signers:
        raise InvalidSignature("nobody signed the message")
    if trust.roots is not None:
        for certificate in dict.fromkeys(signers):
            verify_chain(
                certificate, intermediates=known, roots=trust.roots, at=trust.at, crls=[*trust.crls, *lists],
            )  # fmt: skip
    return Signed(content, tuple(signers), tuple(times))


def _verify_signer(
    info: der.Reader, content: bytes, known: Sequence[Certificate], uid: bytes
) -> tuple[Certificate, datetime | None]:
    """One SignerInfo, GM/T 0010, 8.2."""
    _require_version(info)
    certificate = _find(info.sequence(), known)
    _require_algorithm(info, (_SM3,), "hash")
    signed, time = content, None
    if info.has_explicit(0):
        attributes = info.implicit_set_of(0)
        signed, time = _read_attributes(attributes, content)
    elif _are_attributes(content):
        raise InvalidSignature("what was signed are the attributes of another message")
    _require_algorithm(info, _SIGNATURES, "signature")
    signature = info.octet_string()
    if info.has_explicit(1):
        skipped = info.explicit(1)
        while not skipped.at_end():
            skipped.checked()
    info.finish()
    usage = certificate.key_usage
    if usage is not None and not usage & {"digitalSignature", "nonRepudiation"}:
        raise CertificateError(f"{certificate.subject} may not sign: its certificate is for {', '.join(sorted(usage))}")
    certificate.public_key.verify(signature, signed, uid=uid)
    return certificate, time


def _are_attributes(content: bytes) -> bool:
    """Is `content` what another message's signature covers, its attributes?

    Without this, whoever has a message with attributes could make one without them, and with their DER as its content.
    """
    try:
        outer = der.Reader(content)
        attributes = outer.set_of()
        outer.finish()
        kinds: set[str] = set()
        while not attributes.at_end():
            attribute = attributes.sequence()
            kinds.add(attribute.oid())
            attribute.set_of()
            attribute.finish()
    except InvalidEncoding:
        return False
    return _MESSAGE_DIGEST in kinds


def _read_attributes(attributes: der.Reader, content: bytes) -> tuple[bytes, datetime | None]:
    """(their DER as a SET OF, signingTime); InvalidSignature unless they are of this content (RFC 2315, 9.2)."""
    parts: list[bytes] = []
    values: dict[str, bytes] = {}
    while not attributes.at_end():
        parts.append(attributes.checked())
        attribute = der.only_sequence(parts[-1])
        kind = attribute.oid()
        members = attribute.set_of()
        attribute.finish()
        value = members.raw()
        if kind in values:
            raise InvalidEncoding(f"the attribute {kind} is there twice")
        if kind in (_CONTENT_TYPE, _MESSAGE_DIGEST, _SIGNING_TIME):
            members.finish()
        values[kind] = value
    if _MESSAGE_DIGEST not in values or _CONTENT_TYPE not in values:
        raise InvalidEncoding("the attributes lack the content's type or its digest (RFC 2315, 9.2)")
    kind = der.Reader(values[_CONTENT_TYPE]).oid()
    digest = der.Reader(values[_MESSAGE_DIGEST]).octet_string()
    time = der.Reader(values[_SIGNING_TIME]).time() if _SIGNING_TIME in values else None
    if _KINDS.get(kind) != _DATA or not compare_digest(digest, sm3.digest(content)):
        raise InvalidSignature("the content is not the one that was signed")
    return der.set_of(*parts), time


def _signer_info(
    content: BytesLike, key: sm2.PrivateKey, certificate: Certificate, time: datetime | None, uid: BytesLike
) -> bytes:
    data = as_bytes(content, "content")
    require_type(key, sm2.PrivateKey, "key")
    require_type(certificate, Certificate, "certificate")
    if key.public_key != certificate.public_key:
        raise InvalidKey("key is not the key of certificate")
    attributes: list[bytes] = []
    signed = data
    if time is None and _are_attributes(data):
        raise InvalidOption("the content has the form of authenticated attributes: sign it with a signing_time")
    if time is not None:
        attributes = sorted(
            der.sequence(der.oid(kind), der.set_of(value))
            for kind, value in (
                (_CONTENT_TYPE, der.oid(_DATA)),
                (_MESSAGE_DIGEST, der.octet_string(sm3.digest(data))),
                (_SIGNING_TIME, der.time(instant(time, "signing_time"))),
            )
        )
        signed = der.set_of(*attributes)
    return der.sequence(
        der.integer(1),
        _issuer_and_serial(certificate),
        _algorithm(_SM3),
        *([der.explicit(0, *attributes)] if attributes else []),
        _algorithm(_SM2_SIGN),
        der.octet_string(key.sign(signed, uid=uid)),
    )


# --- enveloped ---


def encrypt(content: BytesLike, recipients: Iterable[Certificate]) -> bytes:
    """EnvelopedData in DER, which any of `recipients` opens with its private key. Source: GM/T 0010, 9.

    recipients: one at least, otherwise InvalidOption. CertificateError: one whose certificate is not for encryption
    (of TLCP's two certificates it is the second). Nothing shows who made the message, nor a change.
    """
    infos, sealed = _envelope(as_bytes(content, "content"), recipients)
    return _message(_ENVELOPED, der.integer(1), infos, sealed)


def decrypt(data: BytesLike, key: sm2.PrivateKey, certificate: Certificate) -> bytes:
    """The content of EnvelopedData for the holder of `certificate`.

    data: DER, or PEM labelled CMS or PKCS7. InvalidEncoding: not such a message. InvalidKey: `key` is not the key of
    `certificate`. CertificateError: the message is not for `certificate`. InvalidCiphertext: it does not open.
    """
    body = _opened(as_bytes(data, "data"), _ENVELOPED)
    sealed_key = _own_key(body, key, certificate)
    ciphertext, iv = _encrypted_content(body)
    body.finish()
    try:
        return sm4.decrypt(_content_key(sealed_key, key), sm4.CBC(iv), ciphertext, padding="pkcs7")
    except (InvalidCiphertext, InvalidPadding):  # what differs would be an oracle (Bleichenbacher, Vaudenay)
        raise InvalidCiphertext(_NOT_FOR_US) from None


def sign_and_encrypt(
    content: BytesLike,
    key: sm2.PrivateKey,
    certificate: Certificate,
    recipients: Iterable[Certificate],
    *,
    certificates: Iterable[Certificate] = (),
    uid: BytesLike = sm2.DEFAULT_UID,
) -> bytes:
    """SignedAndEnvelopedData in DER; the signature is over the content, not encrypted. Source: GM/T 0010, 10.

    Arguments and errors as of `sign` and `encrypt`.
    """
    signer = _signer_info(content, key, certificate, None, uid)
    infos, sealed = _envelope(as_bytes(content, "content"), recipients)
    return _message(
        _SIGNED_AND_ENVELOPED,
        der.integer(1),
        infos,
        der.set_of(_algorithm(_SM3)),
        sealed,
        _certificates([certificate, *certificates]),
        der.set_of(signer),
    )


def decrypt_and_verify(
    data: BytesLike,
    key: sm2.PrivateKey,
    certificate: Certificate,
    *,
    roots: Iterable[Certificate] | None,
    at: datetime,
    intermediates: Iterable[Certificate] = (),
    crls: Iterable[CertificateRevocationList] = (),
    uid: BytesLike = sm2.DEFAULT_UID,
) -> Signed:
    """The content of SignedAndEnvelopedData and its signers; arguments and errors as of `decrypt` and `verify`.

    InvalidCiphertext: the content key does not open. A content that was changed is InvalidSignature.
    """
    body = _opened(as_bytes(data, "data"), _SIGNED_AND_ENVELOPED)
    sealed_key = _own_key(body, key, certificate)
    _require_digests(body)
    ciphertext, iv = _encrypted_content(body)
    try:
        content = sm4.decrypt(_content_key(sealed_key, key), sm4.CBC(iv), ciphertext, padding="pkcs7")
    except InvalidPadding:
        # Nobody signed this. To tell bad padding from a bad signature would give the content away (Vaudenay, 2002).
        content = secrets.token_bytes(32)
    return _verified(body, content, _Trust.of(roots, at, intermediates, crls, uid))


def _envelope(content: bytes, recipients: Iterable[Certificate]) -> tuple[bytes, bytes]:
    """(RecipientInfos, EncryptedContentInfo) under a fresh key."""
    key, iv = secrets.token_bytes(16), secrets.token_bytes(16)
    infos: list[bytes] = []
    for certificate in recipients:
        require_type(certificate, Certificate, "each of recipients")
        usage = certificate.key_usage
        if usage is not None and not usage & {"keyEncipherment", "dataEncipherment", "keyAgreement"}:
            raise CertificateError(f"the certificate of {certificate.subject} is not for encryption")
        infos.append(
            der.sequence(
                der.integer(1),
                _issuer_and_serial(certificate),
                _algorithm(_SM2_ENCRYPT),
                der.octet_string(certificate.public_key.encrypt(key)),
            )
        )
    if not infos:
        raise InvalidOption("there is no recipient")
    cipher = der.sequence(der.oid(_SM4_CBC), der.octet_string(iv))
    ciphertext = sm4.encrypt(key, sm4.CBC(iv), content, padding="pkcs7")
    return der.set_of(*infos), der.sequence(der.oid(_DATA), cipher, der.implicit(0, ciphertext))


def _own_key(body: der.Reader, key: sm2.PrivateKey, certificate: Certificate) -> bytes:
    """The encrypted content key that is meant for `certificate`."""
    require_type(key, sm2.PrivateKey, "key")
    require_type(certificate, Certificate, "certificate")
    if key.public_key != certificate.public_key:
        raise InvalidKey("key is not the key of certificate")
    infos, found = body.set_in_any_order(), None
    while not infos.at_end():
        info = infos.sequence()
        _require_version(info)
        ours = _is_of(info.sequence(), certificate)
        _require_algorithm(info, _ENCRYPTIONS, "key encryption")
        sealed = info.octet_string()
        info.finish()
        if ours and found is None:
            found = sealed
    if found is None:
        raise CertificateError(f"the message is not for {certificate.subject}, serial {certificate.serial_number:x}")
    return found


def _encrypted_content(body: der.Reader) -> tuple[bytes, bytes]:
    """(ciphertext, IV) of an EncryptedContentInfo."""
    info = body.sequence()
    _require_data(info)
    cipher = info.sequence()
    name = cipher.oid()
    if name != _SM4_CBC:
        raise InvalidEncoding(f"the content is encrypted by {name}, not by SM4-CBC")
    iv = cipher.octet_string()
    cipher.finish()
    if len(iv) != 16:
        raise InvalidEncoding(f"the IV has {len(iv)} bytes, not 16")
    ciphertext = info.implicit(0)
    info.finish()
    return ciphertext, iv


def _content_key(sealed: bytes, key: sm2.PrivateKey) -> bytes:
    content_key = key.decrypt(sealed)
    if len(content_key) != 16:
        raise InvalidCiphertext(_NOT_FOR_US)
    return content_key


# --- what all have in common ---


def _message(kind: str, *parts: bytes) -> bytes:
    return der.sequence(der.oid(kind), der.explicit(0, der.sequence(*parts)))


def _opened(data: bytes, kind: str) -> der.Reader:
    """The body of a ContentInfo of this kind, its version read."""
    # DER first: a message may well have PEM in its content.
    info = der.only_sequence(data if data[:1] == b"\x30" else pem.first(data, _LABELS).der)
    name = info.oid()
    if _KINDS.get(name) != kind:
        raise InvalidEncoding(f"the message is of the kind {name}, not {kind}")
    wrapped = info.explicit(0)
    info.finish()
    body = wrapped.sequence()
    wrapped.finish()
    _require_version(body)
    return body


def _require_version(reader: der.Reader) -> None:
    """1 after GM/T 0010; RFC 2315 has 0 in envelopes and their recipients."""
    if (version := reader.integer()) not in (0, 1):
        raise InvalidEncoding(f"version {version}")


def _require_digests(body: der.Reader) -> None:
    algorithms = body.set_in_any_order()
    while not algorithms.at_end():
        _require_algorithm(algorithms, (_SM3,), "hash")


def _require_data(reader: der.Reader) -> None:
    if _KINDS.get(name := reader.oid()) != _DATA:
        raise InvalidEncoding(f"the content is of the kind {name}, not data")


def _require_algorithm(reader: der.Reader, allowed: Sequence[str], what: str) -> None:
    algorithm = reader.sequence()
    name = algorithm.oid()
    if name not in allowed:
        raise InvalidEncoding(f"the {what} is by {name}, which is not supported")
    if not algorithm.at_end():
        algorithm.null()
    algorithm.finish()


def _algorithm(name: str) -> bytes:
    return der.sequence(der.oid(name), der.null())


def _members(reader: der.Reader, number: int) -> Iterator[bytes]:
    """The values under the constructed tag [number], if it is there: certificates, revocation lists."""
    if reader.has_explicit(number):
        inner = reader.explicit(number)
        while not inner.at_end():
            yield inner.raw()


def _certificates(certificates: Sequence[Certificate]) -> bytes:
    for certificate in certificates:
        require_type(certificate, Certificate, "each of certificates")
    return der.explicit(0, *sorted({certificate.to_der() for certificate in certificates}))


def _issuer_and_serial(certificate: Certificate) -> bytes:
    return der.sequence(certificate.issuer.to_der(), der.integer(certificate.serial_number))


def _is_of(identifier: der.Reader, certificate: Certificate) -> bool:
    """Does the IssuerAndSerialNumber name this certificate?"""
    issuer = Name.read(identifier)
    serial = identifier.integer()
    identifier.finish()
    return serial == certificate.serial_number and issuer == certificate.issuer


def _find(identifier: der.Reader, known: Sequence[Certificate]) -> Certificate:
    issuer = Name.read(identifier)
    serial = identifier.integer()
    identifier.finish()
    for certificate in known:
        if certificate.serial_number == serial and certificate.issuer == issuer:
            return certificate
    raise CertificateError(f"the certificate of a signer is not here: serial {serial:x}, issued by {issuer}")
