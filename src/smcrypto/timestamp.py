"""When did some data exist? Time stamps: RFC 3161, GM/T 0033-2014, with SM2 signatures and SM3.

`request` makes what is sent to the authority (by HTTP POST as application/timestamp-query), `verify` judges what comes
back, or the token in it that was kept. A token is SignedData (see `cms`) around a TSTInfo: SM3 of the data, and a time.

Not here: tokens over other hashes than SM3.
"""

from __future__ import annotations

from collections.abc import Iterable
from datetime import datetime, timedelta
from hmac import compare_digest
from typing import Final, NamedTuple

from smcrypto import cms, der, sm2, sm3
from smcrypto.errors import CertificateUsageError, InvalidEncoding, InvalidOption, InvalidSignature
from smcrypto.inputs import BytesLike, as_bytes, require_int, require_type
from smcrypto.ocsp import DIGESTS, HASHES, SKEW
from smcrypto.x509 import AnyCertificate, Certificate, CertificateRevocationList
from smcrypto.x509 import extensions as ext
from smcrypto.x509.signed import instant

__all__ = ["TimeStamp", "request", "verify"]

_TST_INFO: Final = "1.2.840.113549.1.9.16.1.4"  # 2.4.2
# By which certificate it is signed: RFC 2634, 5.4; RFC 5816. Of the former the hash is SHA-1.
_SIGNING_CERTIFICATE: Final = "1.2.840.113549.1.9.16.2.12"
_SIGNING_CERTIFICATE_V2: Final = "1.2.840.113549.1.9.16.2.47"


class TimeStamp(NamedTuple):
    """That data existed at `time` (UTC), which is right by `accuracy` (None: not said).

    policy: under which the authority says so, a dotted identifier. serial_number: of the token, at this authority.
    """

    time: datetime
    accuracy: timedelta | None
    policy: str
    serial_number: int
    signer: Certificate


def request(content: BytesLike, *, nonce: int | None = None, policy: str | None = None) -> bytes:
    """TimeStampReq in DER for SM3 of `content`, which asks for the authority's certificate as well. RFC 3161, 2.4.1.

    nonce: random, positive, of at most 20 bytes, given to `verify` again, so that no old token is taken; otherwise
    InvalidOption. policy: the one that is wanted, a dotted identifier; otherwise InvalidEncoding.
    """
    if policy is not None:
        require_type(policy, str, "policy")
    return der.sequence(
        der.integer(1),
        _imprint(as_bytes(content, "content")),
        b"" if policy is None else der.oid(policy),
        b"" if nonce is None else der.integer(_require_nonce(nonce)),
        der.boolean(True),
    )


def verify(
    data: BytesLike, content: BytesLike, *, roots: Iterable[AnyCertificate], at: datetime, nonce: int | None = None,
    intermediates: Iterable[AnyCertificate] = (), crls: Iterable[CertificateRevocationList] = (),
    uid: BytesLike = sm2.DEFAULT_UID,
) -> TimeStamp:  # fmt: skip
    """The time stamp of `content`, once its signature holds and its signer is to be trusted. RFC 3161, 2.2 and 2.4.2.

    data: TimeStampResp or the token in it, DER. roots, intermediates, crls: as of `x509.verify_chain`. at: the moment
    at which the signer's certificate is judged; the time may be five minutes later at most. nonce: of the request; the
    token must then have it. uid: of the token's signature.
    InvalidEncoding: no such structure. InvalidSignature: no token was granted, it is of other data or another request,
    or its signature does not hold. CertificateError: the signer is not to be trusted; CertificateUsageError: it is not
    for time stamps alone (2.3).
    """
    octets, moment = as_bytes(content, "content"), instant(at, "at")
    wanted = None if nonce is None else _require_nonce(nonce)
    trust = cms.Trust(tuple(roots), moment, tuple(intermediates), tuple(crls), as_bytes(uid, "uid"), (_TST_INFO,),
                      ("timeStamping",))  # fmt: skip
    signed, attributes = cms.verify_typed(_token(as_bytes(data, "data")), None, trust)
    if len(signed.signers) != 1:
        raise InvalidEncoding(f"a time stamp has one signer, not {len(signed.signers)}")
    signer = signed.signers[0]
    purpose = [(e.value, e.critical) for e in signer.extensions if e.oid == ext.EXTENDED_KEY_USAGE]
    if purpose != [(ext.extended_key_usage(["timeStamping"]).value, True)]:
        raise CertificateUsageError(f"{signer.subject} is not for time stamps alone, by a critical extension")
    _require_named(attributes[0], signer)
    with der.reading_sequence(signed.content) as info:
        if (version := info.integer()) != 1:
            raise InvalidEncoding(f"version {version} of TSTInfo")
        policy, imprint, serial_number = info.oid(), info.checked(), info.integer()
        time = info.generalized_time(fraction=True)
        accuracy = _read_accuracy(info.sequence()) if info.peek_tag() == der.SEQUENCE else None
        if info.peek_tag() == der.BOOLEAN:
            info.boolean()  # ordering: of two tokens of one authority
        found = info.integer() if info.peek_tag() == der.INTEGER else None
        authority = info.explicit(0).checked() if info.has_explicit(0) else None
        extensions = der.sequence(*info.explicit(1).rest()) if info.has_explicit(1) else der.sequence()
    for extension in der.parse(extensions, ext.read_extensions):
        if extension.critical:
            raise InvalidEncoding(f"the time stamp has the critical extension {extension.oid}, which is not understood")
    if authority is not None and authority[0] == 0xA4 and authority != der.explicit(4, signer.subject.to_der()):
        raise InvalidSignature("the time stamp names another authority than the one that signed it")
    if not compare_digest(imprint, _imprint(octets)) and not compare_digest(imprint, _imprint(octets, null=False)):
        raise InvalidSignature("the time stamp is not of this content, or not over SM3")
    if wanted is not None and found != wanted:
        raise InvalidSignature("the time stamp does not have the nonce of the request")
    if not signer.not_before <= time <= signer.not_after or time - moment > SKEW:
        raise InvalidSignature(f"the time stamp is of {time}, when its signer was not valid, or which is to come")
    return TimeStamp(time, accuracy, policy, serial_number, signer)


def _require_nonce(nonce: int) -> int:
    if not 0 < require_int(nonce, "nonce") < 1 << 159:
        raise InvalidOption("a nonce is positive and has at most 20 bytes in DER")
    return nonce


def _imprint(content: bytes, *, null: bool = True) -> bytes:
    """MessageImprint, 2.4.1."""
    algorithm = der.sequence(der.oid(HASHES["sm3"][0]), der.null() if null else b"")
    return der.sequence(algorithm, der.octet_string(sm3.digest(content)))


def _token(data: bytes) -> bytes:
    """The token in a TimeStampResp, 2.4.2, or `data`, if it is one: its first member is an identifier then."""
    with der.reading_sequence(data) as response:
        if response.peek_tag() == der.OID:
            response.rest()
            return data
        info = response.sequence()
        status, said = info.integer(), b" ".join(info.rest())
        if status > 1:
            text = "".join(chr(byte) for byte in said if 0x20 <= byte < 0x7F)
            raise InvalidSignature(f"the authority gives no time stamp, status {status}: {text!r}")
        return response.raw()


def _read_accuracy(reader: der.Reader) -> timedelta:
    seconds = reader.integer() if reader.peek_tag() == der.INTEGER else 0
    millis, micros = (reader.implicit_integer(number) if reader.has_implicit(number) else 0 for number in (0, 1))
    if seconds >= 1 << 32 or not (0 <= millis <= 999 and 0 <= micros <= 999):
        raise InvalidEncoding("the accuracy of a time stamp is out of range (RFC 3161, 2.4.2)")
    return timedelta(seconds=seconds, milliseconds=millis, microseconds=micros)


def _require_named(attributes: dict[str, bytes], signer: Certificate) -> None:
    """Do the signed attributes name the signer's certificate, as they must? RFC 5816, 2.2."""
    old = _SIGNING_CERTIFICATE_V2 not in attributes
    value = attributes.get(_SIGNING_CERTIFICATE if old else _SIGNING_CERTIFICATE_V2)
    if value is None:
        raise InvalidSignature("the time stamp does not say by which certificate it is signed (RFC 5816, 2.2)")
    with der.reading_sequence(value) as outer:
        certificates = outer.sequence()
        first, name = certificates.sequence(), HASHES["sha1" if old else "sha256"][0]
        if first.peek_tag() == der.SEQUENCE:
            algorithm = first.sequence()
            name = algorithm.oid()
            algorithm.rest()
        found = first.octet_string()
        for reader in (first, certificates, outer):
            reader.rest()
    if name not in DIGESTS or not compare_digest(found, DIGESTS[name](signer.to_der())):
        raise InvalidSignature("the time stamp is signed by another certificate than it says")
