"""GB/T 35275 messages and SM2EnvelopedKey: another implementation's, our own both ways, and what is refused."""

from __future__ import annotations

import base64
import contextlib
import json
import subprocess
from collections.abc import Callable
from datetime import datetime, timedelta, timezone
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest
from hypothesis import given
from hypothesis import strategies as st

import smcrypto
from der_variants import opened, unchecked
from smcrypto import (
    CertificateError,
    InvalidCiphertext,
    InvalidEncoding,
    InvalidKey,
    InvalidOption,
    InvalidSignature,
    SMCryptoError,
    cms,
    der,
    pem,
    sm2,
    sm3,
    x509,
)

NOW = datetime(2026, 6, 1, tzinfo=timezone.utc)
PEER = SimpleNamespace(**{
    name: value if name in ("source", "verified_with") else bytes.fromhex(value)
    for name, value in json.loads(
        (Path(__file__).parents[1] / "vectors/peers/cms_gmsm/messages.json").read_text("utf-8")).items()
})  # fmt: skip
CONTENT = PEER.content
KEY = sm2.PrivateKey.from_bytes(PEER.key)
CERTIFICATE = x509.Certificate.from_der(PEER.certificate)
ROOT_KEY = sm2.PrivateKey.from_int(0x13579)
ROOT = x509.self_signed(ROOT_KEY, subject={"CN": "root"}, not_before=NOW, not_after=NOW + timedelta(99))
OTHER = sm2.PrivateKey.from_int(0x2468)


def issued(key: sm2.PrivateKey, **options: Any) -> x509.Certificate:
    request = x509.CertificateSigningRequest.create(key, subject={"CN": "employee"})
    return x509.issue(request, ROOT, ROOT_KEY, not_before=NOW, not_after=NOW + timedelta(9), **options)


SIGNING = issued(OTHER)
SEALING = issued(OTHER, key_usage=x509.ENCRYPTION_KEY_USAGE)
FREE = issued(OTHER, key_usage=())
TRUST: dict[str, Any] = {"roots": [ROOT], "at": NOW}


def test_a_negative_serial_number_names_its_certificate() -> None:
    """As in `Certificate.oddities`: CMS names certificates by issuer and serial number."""
    with der.reading_sequence(FREE.tbs_certificate) as body:
        fields = [body.raw() for _ in range(8)]
    tbs = der.sequence(fields[0], der.integer(-5), *fields[2:])
    algorithm = der.sequence(der.oid("1.2.156.10197.1.501"))
    signed = der.sequence(tbs, algorithm, der.bit_string(ROOT_KEY.sign(tbs)))
    odd = x509.Certificate.from_der(signed)
    assert odd.serial_number == -5
    assert cms.verify(cms.sign(CONTENT, OTHER, odd), **TRUST).signers == (odd,)


# --- what another implementation wrote ---


@pytest.mark.parametrize("name", ["signed", "signed_attributes"])
@pytest.mark.parametrize("detached", [False, True])
def test_signed_messages_of_the_peer(name: str, detached: bool) -> None:
    data = getattr(PEER, f"{name}_detached={str(detached).lower()}")
    found = cms.verify(data, roots=[CERTIFICATE], at=NOW, content=CONTENT if detached else None)
    assert (found.content, found.signers) == (CONTENT, (CERTIFICATE,))
    assert (found.times[0] is not None) == (name == "signed_attributes")


def test_enveloped_messages_of_the_peer() -> None:
    assert cms.decrypt(PEER.enveloped, KEY, CERTIFICATE) == CONTENT
    found = cms.decrypt_and_verify(PEER.signed_and_enveloped, KEY, CERTIFICATE, roots=[CERTIFICATE], at=NOW)
    assert (found.content, found.signers) == (CONTENT, (CERTIFICATE,))
    assert sm2.PrivateKey.from_enveloped(PEER.enveloped_key, KEY).to_bytes() == PEER.enveloped_key_d


def test_messages_of_cfca() -> None:
    """SADK names recipients by their keys (SHA-1 of it, where the certificate has no identifier), and SM4 by itself."""
    sadk = json.loads((Path(__file__).parents[1] / "vectors/peers/cms_cfca/messages.json").read_text("utf-8"))
    content = sadk["signed_content"].encode()
    for name, outside in (("signed", None), ("signed_detached", content)):
        data = base64.b64decode(sadk[name])
        signer = x509.Certificate.from_der(unchecked(parts(data)[3]).explicit(0).raw())
        assert cms.verify(data, roots=[signer], at=signer.not_before, content=outside)[:2] == (content, (signer,))
    for one in sadk["enveloped"]:
        key = sm2.PrivateKey.from_bytes(bytes.fromhex(one["key"]))
        certificate = x509.Certificate.from_der(base64.b64decode(one["certificate"]))
        assert cms.decrypt(base64.b64decode(one["message"]), key, certificate) == sadk["enveloped_content"].encode()


# --- our own ---


@pytest.mark.parametrize("uid", [sm2.DEFAULT_UID, b"", b"bank"])
@pytest.mark.parametrize("time", [None, NOW])
@pytest.mark.parametrize("detached", [False, True])
@pytest.mark.parametrize("content", [b"", b"pay 10", bytes(5000)])
def test_signed(content: bytes, detached: bool, time: datetime | None, uid: bytes) -> None:
    key = sm2.PrivateKey.from_int(0x555)
    certificate = x509.self_signed(key, subject={"CN": "x"}, not_before=NOW, not_after=NOW + timedelta(9),
                                   key_usage=("nonRepudiation",))  # fmt: skip
    data = cms.sign(content, key, certificate, detached=detached, signing_time=time, uid=uid)
    assert der.check(data) == data
    given_content = content if detached else None
    found = cms.verify(data, roots=[certificate], at=NOW, content=given_content, uid=uid)
    assert found == (content, (certificate,), (time,))
    armoured = pem.encode("PKCS7", data)
    assert cms.verify(armoured, roots=[certificate], at=NOW, content=given_content, uid=uid) == found
    with pytest.raises(InvalidSignature):
        cms.verify(data, roots=[certificate], at=NOW, content=given_content, uid=b"another")
    if detached:
        with pytest.raises(InvalidSignature):
            cms.verify(data, roots=[certificate], at=NOW, content=content + b"!", uid=uid)


def test_a_message_may_have_pem_in_its_content() -> None:
    """Also another message: it is the outer one that is read."""
    for inside in (CERTIFICATE.to_pem(), pem.encode("CMS", cms.sign(b"inner", OTHER, SIGNING))):
        content = b"see\n" + inside
        assert cms.verify(cms.sign(content, OTHER, SIGNING), **TRUST).content == content


def without_attributes(data: bytes) -> bytes:
    """The message whose signature `data` has: no attributes, and their DER as the content."""
    info = opened(data)
    kind, body = info.raw(), info.explicit(0).sequence()
    version, digests, _, certificates = (body.raw() for _ in range(4))
    signer = body.set_of().sequence()
    parts = [signer.raw() for _ in range(6)]
    attributes = bytes([der.SET]) + parts.pop(3)[1:]
    content = der.sequence(der.oid("1.2.156.10197.6.1.4.2.1"), der.explicit(0, der.octet_string(attributes)))
    signers = der.set_of(der.sequence(*parts))
    return der.sequence(kind, der.explicit(0, der.sequence(version, digests, content, certificates, signers)))


def test_attributes_are_not_taken_for_a_content() -> None:
    """The signature over the attributes of one message would hold over another that has their DER as its content."""
    forged = without_attributes(cms.sign(b"pay 10", OTHER, SIGNING, signing_time=NOW))
    with pytest.raises(InvalidSignature, match="attributes of another message"):
        cms.verify(forged, **TRUST)
    attributes = der.set_of(der.sequence(der.oid("1.2.840.113549.1.9.4"), der.set_of(der.octet_string(bytes(32)))))
    with pytest.raises(InvalidOption, match="signing_time"):
        cms.sign(attributes, OTHER, SIGNING)
    assert cms.verify(cms.sign(attributes, OTHER, SIGNING, signing_time=NOW), **TRUST).content == attributes
    for other in (der.set_of(), der.set_of(der.sequence(der.oid("1.2.3"), der.set_of())), attributes + b"!"):
        assert cms.verify(cms.sign(other, OTHER, SIGNING), **TRUST).content == other


@pytest.mark.parametrize("value", [
    bytes.fromhex("010101"), bytes.fromhex("3106020102020101"), bytes.fromhex("1b0161"), bytes.fromhex("5f810001"),
], ids=["a boolean of BER", "a set out of order", "a GeneralString", "a long tag"])  # fmt: skip
def test_nor_are_attributes_that_this_library_would_not_read(value: bytes) -> None:
    """Another library signed them: the message itself is refused here, but its signature holds over their DER."""
    message = signed_with([TYPE, DIGEST, der.sequence(der.oid("1.2.3"), der.element(der.SET, value))])
    with pytest.raises(InvalidSignature, match="attributes of another message"):
        cms.verify(without_attributes(message), **TRUST)


def test_a_changed_content_is_told_in_one_way_only() -> None:
    """Bad padding or a bad signature: the difference would be an oracle for the content (Vaudenay, 2002)."""
    data = cms.sign_and_encrypt(b"a content of more than one block", OTHER, SIGNING, [SEALING])
    info = opened(data)
    info.oid()
    body = info.explicit(0).sequence()
    encrypted = [body.raw() for _ in range(4)][3]
    begin = data.index(encrypted) + len(encrypted) - 48  # the ciphertext ends it
    reasons = set()
    for position in range(begin, begin + 48):
        altered = bytearray(data)
        altered[position] ^= 1
        with pytest.raises(InvalidSignature) as error:
            cms.decrypt_and_verify(altered, OTHER, SEALING, **TRUST)
        reasons.add(str(error.value))
    assert len(reasons) == 1


def test_a_signer_must_be_trusted() -> None:
    data = cms.sign(CONTENT, OTHER, SIGNING)
    assert cms.verify(data, **TRUST).signers == (SIGNING,)
    with pytest.raises(CertificateError):
        cms.verify(data, roots=[CERTIFICATE], at=NOW)
    with pytest.raises(CertificateError):
        cms.verify(data, roots=[ROOT], at=NOW + timedelta(100))
    info = unchecked(parts(data)[-1]).set_of().sequence().rest()
    named = der.sequence(SEALING.issuer.to_der(), der.integer(SEALING.serial_number))
    members = [*parts(data)[:3], der.explicit(0, SEALING.to_der()), der.set_of(der.sequence(info[0], named, *info[2:]))]
    with pytest.raises(x509.CertificateUsageError, match="may not sign"):
        cms.verify(message(2, members), **TRUST)
    assert cms.verify(cms.sign(CONTENT, OTHER, FREE), **TRUST)
    revoked = x509.CertificateRevocationList.create(
        ROOT, ROOT_KEY, revoked=[x509.RevokedCertificate(SIGNING.serial_number, NOW)], this_update=NOW,
        next_update=NOW + timedelta(1), number=1)  # fmt: skip
    with pytest.raises(x509.CertificateRevokedError):
        cms.verify(data, **TRUST, crls=[revoked])


def test_issuers_and_revocation_lists_inside_are_used() -> None:
    middle_key = sm2.PrivateKey.from_int(0x777)
    request = x509.CertificateSigningRequest.create(middle_key, subject={"CN": "middle"})
    middle = x509.issue(request, ROOT, ROOT_KEY, not_before=NOW, not_after=NOW + timedelta(9), ca=True)
    leaf = x509.issue(x509.CertificateSigningRequest.create(OTHER, subject={"CN": "leaf"}), middle, middle_key,
                      not_before=NOW, not_after=NOW + timedelta(9))  # fmt: skip
    assert cms.verify(cms.sign(b"m", OTHER, leaf, certificates=[middle, leaf]), **TRUST).signers == (leaf,)
    with pytest.raises(CertificateError):
        cms.verify(cms.sign(b"m", OTHER, leaf), **TRUST)
    assert cms.verify(cms.sign(b"m", OTHER, leaf), **TRUST, intermediates=[middle])
    crl = x509.CertificateRevocationList.create(middle, middle_key, revoked=[x509.RevokedCertificate(
        leaf.serial_number, NOW)], this_update=NOW, next_update=NOW + timedelta(1), number=1)  # fmt: skip
    body = parts(cms.sign(b"m", OTHER, leaf, certificates=[middle]))
    body.insert(4, der.explicit(1, crl.to_der()))
    with pytest.raises(x509.CertificateRevokedError):
        cms.verify(message(2, body), **TRUST)


@pytest.mark.parametrize("content", [b"", b"pay 10", bytes(5000)])
def test_enveloped(content: bytes) -> None:
    for data in (cms.encrypt(content, [CERTIFICATE, SEALING, FREE]), ):
        assert der.check(data) == data
        for key, certificate in ((KEY, CERTIFICATE), (OTHER, SEALING), (OTHER, FREE)):
            assert cms.decrypt(data, key, certificate) == content
        assert cms.decrypt(pem.encode("CMS", data), KEY, CERTIFICATE) == content
        with pytest.raises(CertificateError, match="not for"):
            cms.decrypt(data, ROOT_KEY, ROOT)
        with pytest.raises(InvalidKey):
            cms.decrypt(data, OTHER, CERTIFICATE)
    data = cms.sign_and_encrypt(content, OTHER, SIGNING, [SEALING])
    assert cms.decrypt_and_verify(data, OTHER, SEALING, **TRUST) == (content, (SIGNING,), (None,))
    with pytest.raises(InvalidSignature):
        cms.decrypt_and_verify(data, OTHER, SEALING, **TRUST, uid=b"another")
    with pytest.raises(CertificateError):
        cms.decrypt_and_verify(data, OTHER, SEALING, roots=[CERTIFICATE], at=NOW)


def test_what_cannot_be_written() -> None:
    with pytest.raises(InvalidOption):
        cms.encrypt(b"m", [])
    with pytest.raises(CertificateError, match="not for encryption"):
        cms.encrypt(b"m", [SIGNING])
    with pytest.raises(InvalidKey):
        cms.sign(b"m", KEY, SIGNING)
    with pytest.raises(InvalidOption):
        cms.sign(b"m", OTHER, SIGNING, signing_time=NOW.replace(tzinfo=None))
    wrong: list[Callable[[], Any]] = [
        lambda: cms.sign("m", OTHER, SIGNING),
        lambda: cms.sign(b"m", b"key", SIGNING),
        lambda: cms.sign(b"m", OTHER, b"certificate"),
        lambda: cms.sign(b"m", OTHER, SIGNING, certificates=[b""]),
        lambda: cms.encrypt(b"m", [b""]),
        lambda: cms.decrypt(b"", b"", SIGNING),
        lambda: cms.decrypt(PEER.enveloped, KEY, b""),
        lambda: cms.verify("", **TRUST),
        lambda: OTHER.to_enveloped(b""),
        lambda: sm2.PrivateKey.from_enveloped(b"", b""),
    ]
    for call in wrong:
        with pytest.raises((TypeError, InvalidEncoding)):
            call()


# --- what is refused ---


def parts(data: bytes) -> list[bytes]:
    """The members of the body of a message."""
    outer = unchecked(data).sequence()
    outer.oid()
    body = outer.explicit(0).sequence()
    members = []
    while not body.at_end():
        members.append(body.raw())
    return members


def message(kind: int, members: list[bytes], arc: str = "1.2.156.10197.6.1.4.2") -> bytes:
    return der.sequence(der.oid(f"{arc}.{kind}"), der.explicit(0, der.sequence(*members)))


def attribute(kind: str, *values: bytes) -> bytes:
    return der.sequence(der.oid(kind), der.set_of(*values))


TYPE = attribute("1.2.840.113549.1.9.3", der.oid("1.2.156.10197.6.1.4.2.1"))
DIGEST = attribute("1.2.840.113549.1.9.4", der.octet_string(sm3.digest(CONTENT)))
SM3 = der.sequence(der.oid("1.2.156.10197.1.401"))
SIGN = der.sequence(der.oid("1.2.156.10197.1.501"))


def signed_with(attributes: list[bytes], *, sort: bool = True, after: bytes = b"", signature: bytes = SIGN,
                digest: bytes = SM3, version: int = 1) -> bytes:  # fmt: skip
    """SignedData of CONTENT whose one signer signed these attributes."""
    ordered = sorted(attributes) if sort else attributes
    info = der.sequence(
        der.integer(version), der.sequence(SIGNING.issuer.to_der(), der.integer(SIGNING.serial_number)), digest,
        der.explicit(0, *ordered), signature, der.octet_string(OTHER.sign(der.set_of(*attributes))), after)  # fmt: skip
    members = parts(cms.sign(CONTENT, OTHER, SIGNING))
    return message(2, [*members[:-1], der.element(der.SET, info)])


def test_attributes_are_required_and_compared() -> None:
    assert cms.verify(signed_with([TYPE, DIGEST]), **TRUST).content == CONTENT
    extra = attribute("1.2.3", der.integer(1), der.integer(2))
    assert cms.verify(signed_with([TYPE, DIGEST, extra], after=der.explicit(1, extra)), **TRUST)
    pkcs7_type = attribute("1.2.840.113549.1.9.3", der.oid("1.2.840.113549.1.7.1"))
    assert cms.verify(signed_with([pkcs7_type, DIGEST]), **TRUST)
    for attributes in ([TYPE], [DIGEST], [TYPE, DIGEST, DIGEST],
                       [TYPE, attribute("1.2.840.113549.1.9.4", der.octet_string(b"1"), der.octet_string(b"2"))]):
        with pytest.raises(InvalidEncoding):
            cms.verify(signed_with(attributes), **TRUST)
    with pytest.raises(InvalidEncoding):
        cms.verify(signed_with(sorted([TYPE, DIGEST], reverse=True), sort=False), **TRUST)
    for attributes in ([attribute("1.2.840.113549.1.9.3", der.oid("1.2.3")), DIGEST],
                       [TYPE, attribute("1.2.840.113549.1.9.4", der.octet_string(bytes(32)))]):
        with pytest.raises(InvalidSignature):
            cms.verify(signed_with(attributes), **TRUST)


def test_other_algorithms_and_versions_are_refused() -> None:
    sha256 = der.sequence(der.oid("2.16.840.1.101.3.4.2.1"))
    for options in ({"digest": sha256}, {"signature": sha256}, {"version": 4},
                    {"signature": der.sequence(der.oid("1.2.156.10197.1.501"), der.integer(1))}):  # fmt: skip
        with pytest.raises(InvalidEncoding):
            cms.verify(signed_with([TYPE, DIGEST], **options), **TRUST)  # type: ignore[arg-type]
    members = parts(cms.encrypt(b"m", [FREE]))
    info = unchecked(members[2]).sequence()
    name, cipher, text = info.raw(), info.raw(), info.raw()
    for altered in (
        [name, der.sequence(der.oid("1.2.156.10197.1.104.1")), text],
        [name, der.sequence(der.oid("1.2.156.10197.1.104.2"), der.octet_string(bytes(15))), text],
        [der.oid("1.2.3"), cipher, text],
    ):
        with pytest.raises(InvalidEncoding):
            cms.decrypt(message(3, [*members[:2], der.sequence(*altered)]), OTHER, FREE)


def test_what_is_missing_or_twice() -> None:
    attached, detached = cms.sign(CONTENT, OTHER, SIGNING), cms.sign(CONTENT, OTHER, SIGNING, detached=True)
    with pytest.raises(InvalidEncoding, match="given as well"):
        cms.verify(attached, **TRUST, content=CONTENT)
    with pytest.raises(InvalidEncoding, match="missing"):
        cms.verify(detached, **TRUST)
    with pytest.raises(TypeError):
        cms.verify(detached, **TRUST, content="")
    members = parts(attached)
    with pytest.raises(InvalidSignature, match="nobody"):
        cms.verify(message(2, [*members[:-1], der.set_of()]), **TRUST)
    with pytest.raises(CertificateError, match="not here"):
        cms.verify(message(2, [*members[:3], members[4]]), **TRUST)
    assert cms.verify(message(2, [*members[:3], members[4]]), **TRUST, intermediates=[CERTIFICATE, SIGNING])
    assert cms.verify(message(2, members, "1.2.840.113549.1.7"), **TRUST).content == CONTENT
    with pytest.raises(InvalidEncoding, match="kind"):
        cms.verify(message(3, members), **TRUST)
    with pytest.raises(InvalidEncoding):
        cms.decrypt(attached, KEY, CERTIFICATE)
    for cut in (attached[:-1], attached + b"\0", b"", b"-----BEGIN CMS-----\n-----END CMS-----\n"):
        with pytest.raises(InvalidEncoding):
            cms.verify(cut, **TRUST)


def with_key(sealed_key: bytes) -> bytes:
    """An envelope for FREE whose encrypted content key is this."""
    members = parts(cms.encrypt(b"m", [FREE]))
    recipient = der.sequence(
        der.integer(0), der.sequence(FREE.issuer.to_der(), der.integer(FREE.serial_number)),
        der.sequence(der.oid("1.2.156.10197.1.301.3")), der.octet_string(sealed_key))  # fmt: skip
    return message(3, [members[0], der.element(der.SET, recipient + recipient), members[2]])


def test_content_keys_that_do_not_open() -> None:
    for sealed_key in (CERTIFICATE.public_key.encrypt(bytes(16)), OTHER.public_key.encrypt(bytes(15)),
                       OTHER.public_key.encrypt(bytes(32)), b"", b"0", b"\4"):  # fmt: skip
        with pytest.raises(InvalidCiphertext):
            cms.decrypt(with_key(sealed_key), OTHER, FREE)
    assert len(cms.decrypt(with_key(OTHER.public_key.encrypt(bytes(16))), OTHER, FREE)) <= 16  # of another key
    raw = OTHER.public_key.encrypt(bytes(16), encoding="c1c2c3")
    for sealed_key in (raw, raw[1:]):  # without 04: CFCA's software before version 3.2
        assert len(cms.decrypt(with_key(sealed_key), OTHER, FREE)) <= 16


def test_no_alteration_of_an_envelope_tells_the_content() -> None:
    """The attack of Vaudenay (2002): an error for some of the 256 values of a byte would tell the byte after it."""
    content = b"a secret of 35 bytes, which is here"
    data = cms.encrypt(content, [FREE])
    altered = bytearray(data)
    lengths = set()
    for value in range(256):
        altered[-17] = data[-17] ^ value
        lengths.add(len(cms.decrypt(altered, OTHER, FREE)))
    assert 48 in lengths  # padding that is not well formed stays
    for cut in (1, 48):
        members = parts(data)
        name, cipher, text = unchecked(members[2]).sequence().rest()
        shorter = der.sequence(name, cipher, der.implicit(0, unchecked(text).implicit(0)[cut:]))
        with pytest.raises(InvalidCiphertext, match="whole number"):
            cms.decrypt(message(3, [*members[:2], shorter]), OTHER, FREE)


SAMPLES = [cms.sign(b"m", OTHER, SIGNING, signing_time=NOW), cms.encrypt(b"m", [FREE]),
           cms.sign_and_encrypt(b"m", OTHER, SIGNING, [FREE]), OTHER.to_enveloped(KEY.public_key)]  # fmt: skip


@given(st.sampled_from(SAMPLES), st.data())
def test_altered_messages_are_refused_or_say_the_same(sample: bytes, draw: st.DataObject) -> None:
    data = bytearray(sample)
    position = draw.draw(st.integers(0, len(data) - 1))
    data[position] ^= draw.draw(st.integers(1, 255))
    with contextlib.suppress(SMCryptoError):
        assert cms.verify(bytes(data), **TRUST).content == b"m"
    with contextlib.suppress(SMCryptoError):
        assert cms.decrypt_and_verify(bytes(data), OTHER, FREE, **TRUST).content == b"m"
    with contextlib.suppress(SMCryptoError):
        cms.decrypt(bytes(data), OTHER, FREE)  # any content: nothing authenticates it
    with contextlib.suppress(SMCryptoError):
        assert sm2.PrivateKey.from_enveloped(bytes(data), KEY) == OTHER


# --- SM2EnvelopedKey ---


def sealed(*, algorithm: bytes | None = None, key: bytes | None = None, point: bytes | None = None,
           text: bytes | None = None, after: bytes = b"") -> bytes:  # fmt: skip
    symmetric = bytes(16)
    return der.sequence(
        der.sequence(der.oid("1.2.156.10197.1.104.1")) if algorithm is None else algorithm,
        KEY.public_key.encrypt(symmetric) if key is None else key,
        der.bit_string(OTHER.public_key.to_bytes() if point is None else point),
        der.bit_string(smcrypto.sm4.encrypt(symmetric, smcrypto.sm4.ECB(), OTHER.to_bytes()) if text is None else text),
        after)  # fmt: skip


def test_keys_are_sealed_and_opened() -> None:
    data = OTHER.to_enveloped(KEY.public_key)
    assert der.check(data) == data and sm2.PrivateKey.from_enveloped(data, KEY) == OTHER
    assert sm2.PrivateKey.from_enveloped(sealed(), KEY) == OTHER
    sm4_null = der.sequence(der.oid("1.2.156.10197.1.104"), der.null())
    assert sm2.PrivateKey.from_enveloped(sealed(algorithm=sm4_null), KEY) == OTHER
    with pytest.raises(InvalidCiphertext):
        sm2.PrivateKey.from_enveloped(data, ROOT_KEY)


@pytest.mark.parametrize("altered", [
    {"algorithm": der.sequence(der.oid("1.2.156.10197.1.104.2"))},
    {"algorithm": der.sequence(der.oid("1.2.156.10197.1.104.1"), der.integer(1))},
    {"point": ROOT_KEY.public_key.to_bytes()}, {"point": b"\4" + bytes(64)}, {"text": bytes(48)}, {"text": bytes(32)},
    {"after": der.null()}, {"key": KEY.public_key.encrypt(bytes(15))},
    {"text": smcrypto.sm4.encrypt(bytes(16), smcrypto.sm4.ECB(), bytes(32))},
])  # fmt: skip
def test_what_is_no_sealed_key(altered: dict[str, bytes]) -> None:
    with pytest.raises(InvalidKey):
        sm2.PrivateKey.from_enveloped(sealed(**altered), KEY)


def test_the_algorithm_of_an_enveloped_key_has_nothing_after_its_parameters() -> None:
    members = opened(OTHER.to_enveloped(KEY.public_key))
    algorithm, rest = members.raw(), [members.raw() for _ in range(3)]
    assert sm2.PrivateKey.from_enveloped(der.sequence(algorithm, *rest), KEY) == OTHER
    longer = der.sequence(algorithm[2:] + der.null())
    with pytest.raises(InvalidKey, match="left over"):
        sm2.PrivateKey.from_enveloped(der.sequence(longer, *rest), KEY)


# --- BER, identifiers, neighbours of other algorithms, wrong use ---


def foreign(certificate: x509.Certificate) -> bytes:
    """The same certificate with the curve P-256 for its key; nothing verifies its signature."""
    return certificate.to_der().replace(der.oid("1.2.156.10197.1.301"), der.oid("1.2.840.10045.3.1.7"))


def with_indefinite_lengths(data: bytes, levels: int = 4) -> bytes:
    """`data` as streaming writers write it: the frame in indefinite lengths, a string in pieces of five bytes."""
    reader = unchecked(data)
    tag = data[0]
    if not tag & 0x20:
        content = reader.value(tag)
        if tag not in (der.OCTET_STRING, 0x80) or levels > 2:
            return data
        pieces = [der.octet_string(content[i : i + 5]) for i in range(0, len(content), 5)]
        return bytes((tag | 0x20, 0x80)) + b"".join(pieces) + b"\0\0"
    if levels == 0 and tag == der.SEQUENCE:
        return data
    inner = reader._inner(tag)
    parts = []
    while not inner.at_end():
        parts.append(with_indefinite_lengths(inner.raw(), levels - 1))
    return bytes((tag, 0x80)) + b"".join(parts) + b"\0\0"


@pytest.mark.parametrize("time", [None, NOW])
def test_messages_in_ber(time: datetime | None) -> None:
    signed = with_indefinite_lengths(cms.sign(CONTENT, OTHER, SIGNING, signing_time=time))
    assert cms.verify(signed, **TRUST) == (CONTENT, (SIGNING,), (time,))
    assert cms.verify(pem.encode("PKCS7", signed), **TRUST).content == CONTENT
    assert cms.decrypt(with_indefinite_lengths(cms.encrypt(CONTENT, [SEALING])), OTHER, SEALING) == CONTENT
    both = with_indefinite_lengths(cms.sign_and_encrypt(CONTENT, OTHER, SIGNING, [SEALING]))
    assert cms.decrypt_and_verify(both, OTHER, SEALING, **TRUST).content == CONTENT


def test_certificates_in_a_message_are_der() -> None:
    """A certificate is compared and hashed by the bytes received: it is not written again."""
    members = parts(cms.sign(CONTENT, OTHER, SIGNING))
    inside = opened(SIGNING.to_der()).rest()
    members[3] = der.explicit(0, b"\x30\x80" + b"".join(inside) + b"\0\0")
    with pytest.raises(InvalidEncoding, match="definite length"):
        cms.verify(message(2, members), **TRUST)


def test_certificates_of_other_algorithms_do_no_harm() -> None:
    beside = x509.ForeignCertificate.from_der(foreign(CERTIFICATE))
    data = cms.sign(CONTENT, OTHER, SIGNING, certificates=[beside])
    assert beside.to_der() in data
    assert cms.verify(data, roots=[ROOT, beside], at=NOW, intermediates=[beside]).signers == (SIGNING,)
    both = cms.sign_and_encrypt(CONTENT, OTHER, SIGNING, [SEALING], certificates=[beside])
    assert cms.decrypt_and_verify(both, OTHER, SEALING, **TRUST).signers == (SIGNING,)
    members = parts(cms.sign(CONTENT, OTHER, SIGNING))
    members[3] = der.explicit(0, foreign(SIGNING))
    with pytest.raises(x509.CertificateAlgorithmError, match="EC P-256, not SM2"):
        cms.verify(message(2, members), **TRUST)
    members[3] = der.explicit(0, der.sequence(der.integer(1)))
    with pytest.raises(CertificateError, match="not a valid"):
        cms.verify(message(2, members), **TRUST)


def test_recipients_of_other_kinds_are_passed_over() -> None:
    members = parts(cms.encrypt(CONTENT, [FREE]))
    ours = unchecked(members[1]).set_of().raw()
    rsa = der.sequence(
        der.integer(0), der.sequence(ROOT.subject.to_der(), der.integer(1)),
        der.sequence(der.oid("1.2.840.113549.1.1.1"), der.null()), der.octet_string(bytes(256)))  # fmt: skip
    agreement = der.explicit(1, der.integer(3))  # KeyAgreeRecipientInfo, RFC 5652, 6.2.2
    for order in ([ours, rsa, agreement], [agreement, rsa, ours]):
        data = message(3, [members[0], der.element(der.SET, b"".join(order)), members[2], der.explicit(1, SM3)])
        assert cms.decrypt(data, OTHER, FREE) == CONTENT
    with pytest.raises(CertificateError, match="not for"):
        cms.decrypt(message(3, [members[0], der.set_of(rsa, agreement), members[2]]), OTHER, FREE)
    with pytest.raises(InvalidEncoding, match="key encryption"):  # for us, but by RSA
        named = der.sequence(FREE.issuer.to_der(), der.integer(FREE.serial_number))
        wrong = der.sequence(der.integer(0), named, *opened(rsa).rest()[2:])
        cms.decrypt(message(3, [members[0], der.set_of(wrong), members[2]]), OTHER, FREE)


@pytest.mark.parametrize("identifiers", ["gm", "rfc"])
def test_recipients_and_signers_are_named_by_their_keys_too(identifiers: Any) -> None:
    """As CFCA's software names them: RecipientInfo of version 2 with the SubjectKeyIdentifier."""
    if identifiers == "rfc":
        pytest.importorskip("cryptography")
    assert SEALING.subject_key_identifier is not None
    data = cms.encrypt(CONTENT, [CERTIFICATE, SEALING], identifiers=identifiers, named_by="key")
    assert der.implicit(0, SEALING.subject_key_identifier) in data and SEALING.issuer.to_der() not in data
    assert cms.decrypt(data, OTHER, SEALING) == CONTENT
    with pytest.raises(CertificateError, match="not for"):
        cms.decrypt(data, ROOT_KEY, ROOT)
    info = unchecked(parts(cms.sign(CONTENT, OTHER, SIGNING))[-1]).set_of().sequence().rest()
    for identifier, trusted in ((SIGNING.subject_key_identifier, True), (bytes(20), False)):
        assert identifier is not None
        named = der.sequence(der.integer(3), der.implicit(0, identifier), *info[2:])
        members = [der.integer(3), *parts(cms.sign(CONTENT, OTHER, SIGNING))[1:-1], der.set_of(named)]
        if trusted:
            assert cms.verify(message(2, members), **TRUST).signers == (SIGNING,)
        else:
            with pytest.raises(CertificateError, match=f"not here: key {bytes(20).hex()}"):
                cms.verify(message(2, members), **TRUST)


def test_identifiers_of_rfc() -> None:
    """RFC 5652's content types, and SM2-with-SM3 as the algorithm of the signature."""
    data = cms.sign(CONTENT, OTHER, SIGNING, signing_time=NOW, identifiers="rfc")
    assert opened(data).oid() == "1.2.840.113549.1.7.2"
    assert data.count(der.oid("1.2.840.113549.1.7.1")) == 2  # of the content, and in the attributes
    assert b"".join(map(der.oid, ("1.2.156.10197.1.501",))) in parts(data)[-1]
    assert cms.verify(data, **TRUST) == (CONTENT, (SIGNING,), (NOW,))
    gm = cms.sign(CONTENT, OTHER, SIGNING, signing_time=NOW)
    assert opened(gm).oid() == "1.2.156.10197.6.1.4.2.2" and der.oid("1.2.840.113549.1.7.1") not in gm
    wrong: Any = "cfca"
    with pytest.raises(InvalidOption, match="identifiers"):
        cms.sign(CONTENT, OTHER, SIGNING, identifiers=wrong)
    with pytest.raises(InvalidOption, match="identifiers"):
        cms.encrypt(CONTENT, [SEALING], identifiers=wrong)
    with pytest.raises(InvalidOption, match="named_by"):
        cms.encrypt(CONTENT, [SEALING], named_by=wrong)
    anonymous = x509.Certificate.from_der(SEALING.to_der().replace(der.oid("2.5.29.14"), der.oid("2.5.29.99")))
    assert cms.decrypt(cms.encrypt(CONTENT, [anonymous], named_by="key"), OTHER, anonymous) == CONTENT


@pytest.mark.parametrize("identifiers, named_by, version", [
    ("gm", "issuer", 1), ("gm", "key", 2), ("rfc", "issuer", 0), ("rfc", "key", 2),
])  # fmt: skip
def test_versions_of_envelopes(identifiers: Any, named_by: Any, version: int) -> None:
    """GM/T 0010, 9; RFC 5652, 6.1 and 6.2.1: of the envelope, and of the recipient in it."""
    if identifiers == "rfc":
        pytest.importorskip("cryptography")
    body = parts(cms.encrypt(CONTENT, [SEALING], identifiers=identifiers, named_by=named_by))
    assert body[0] == der.integer(version) == unchecked(body[1]).set_of().sequence().raw()


def test_nobody_signs_with_a_certificate_that_verification_refuses() -> None:
    critical = x509.Certificate.from_der(SIGNING.to_der().replace(der.oid("2.5.29.15"), der.oid("2.5.29.99")))
    for certificate, time, error in (
        (SEALING, None, x509.CertificateUsageError),
        (issued(OTHER, ca=True), None, x509.CertificateUsageError),
        (critical, None, CertificateError),
        (SIGNING, NOW + timedelta(99), x509.CertificateExpiredError),
        (SIGNING, NOW - timedelta(99), x509.CertificateNotYetValidError),
    ):
        with pytest.raises(error):
            cms.sign(CONTENT, OTHER, certificate, signing_time=time)
    with pytest.raises(x509.CertificateUsageError):
        cms.sign_and_encrypt(CONTENT, OTHER, SEALING, [SEALING])


def test_nothing_is_verified_without_roots() -> None:
    """What has no trusted signer does not come back as a verified message."""
    nobody: Any = None
    data = cms.sign(CONTENT, OTHER, SIGNING)
    with pytest.raises(TypeError):
        cms.verify(data, roots=nobody, at=NOW)
    with pytest.raises(CertificateError):
        cms.verify(data, roots=[], at=NOW)
    with pytest.raises(TypeError):
        cms.decrypt_and_verify(cms.sign_and_encrypt(CONTENT, OTHER, SIGNING, [FREE]), OTHER, FREE, roots=nobody, at=NOW)


@pytest.mark.parametrize("uid, time, verified", [
    (b"", NOW, True), (sm2.DEFAULT_UID, NOW, False),
    (b"", None, False),  # without attributes it verifies SM3 of the content, without the Z of GB/T 32918.2
])  # fmt: skip
def test_openssl_verifies_what_is_signed_for_it(
    uid: bytes, time: datetime | None, verified: bool, tmp_path: Path, require: Callable[[str], str]
) -> None:
    """OpenSSL 3.0 takes an empty uid for signatures of messages, and knows the identifiers of RFC 5652 only."""
    data = cms.sign(b"pay 10", OTHER, SIGNING, signing_time=time, identifiers="rfc", uid=uid)
    (tmp_path / "message").write_bytes(data)
    # -noverify: its check of the certificate itself wants its purpose for S/MIME
    done = subprocess.run([require("openssl"), "cms", "-verify", "-inform", "DER", "-in", tmp_path / "message",
                           "-noverify", "-binary"], capture_output=True, check=False)  # fmt: skip
    assert (done.returncode == 0) == verified, done.stderr
    assert not verified or done.stdout == b"pay 10"


@given(st.sampled_from(SAMPLES[:3]).map(with_indefinite_lengths), st.data())
def test_altered_messages_in_ber_are_refused_or_say_the_same(sample: bytes, draw: st.DataObject) -> None:
    test_altered_messages_are_refused_or_say_the_same.hypothesis.inner_test(sample, draw)  # type: ignore[attr-defined]
