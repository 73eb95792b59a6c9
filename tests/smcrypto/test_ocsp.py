"""OCSP, RFC 6960: requests that OpenSSL and `cryptography` read, OpenSSL's answers, and answers that do not count."""

from __future__ import annotations

import hashlib
import subprocess
from collections.abc import Callable
from datetime import datetime, timedelta, timezone
from pathlib import Path
from typing import Any

import pytest

from der_variants import overfull
from smcrypto import (
    CertificateError,
    InvalidLength,
    InvalidOption,
    SMCryptoError,
    der,
    ocsp,
    sm2,
    sm3,
    x509,
)

NOW = datetime(2026, 6, 1, 12, tzinfo=timezone.utc)
DAY = timedelta(days=1)
CA_KEY, LEAF_KEY, RESPONDER_KEY = (sm2.PrivateKey.from_int(n) for n in (0xCA, 0x1EAF, 0x0C59))
NONCE = bytes(range(16))
SHA1, SM3 = "1.3.14.3.2.26", "1.2.156.10197.1.401"


def root(name: str, key: sm2.PrivateKey) -> x509.Certificate:
    return x509.self_signed(key, subject={"CN": name}, not_before=NOW - 100 * DAY, not_after=NOW + 9999 * DAY)


def issued(name: str, key: sm2.PrivateKey, *, days: int = 9000, **options: Any) -> x509.Certificate:
    request = x509.CertificateSigningRequest.create(key, subject={"CN": name})
    request.verify()
    return x509.issue(request, CA, CA_KEY, not_before=NOW - 50 * DAY, not_after=NOW + days * DAY, **options)


CA = root("CA", CA_KEY)
LEAF = issued("leaf", LEAF_KEY)
RESPONDER = issued("responder", RESPONDER_KEY, extended_key_usage=["OCSPSigning"])


def certificate_id(hash: str = "sm3", serial: int = LEAF.serial_number, ca: x509.Certificate = CA) -> bytes:
    digest, oid = (sm3.digest, SM3) if hash == "sm3" else (lambda data: hashlib.sha1(data).digest(), SHA1)
    return der.sequence(
        der.sequence(der.oid(oid), der.null()), der.octet_string(digest(ca.subject.to_der())),
        der.octet_string(digest(ca.public_key.to_bytes())), der.integer(serial),
    )  # fmt: skip


GOOD = der.implicit(0, b"")


def single(
    status: bytes = GOOD, *, identifier: bytes = certificate_id(), this: datetime = NOW - DAY,
    until: datetime | None = NOW + DAY, extensions: list[x509.Extension] | None = None,
) -> bytes:  # fmt: skip
    return der.sequence(
        identifier, status, der.generalized_time(this),
        *([] if until is None else [der.explicit(0, der.generalized_time(until))]),
        *([] if extensions is None else [der.explicit(1, der.sequence(*(e.to_der() for e in extensions)))]),
    )  # fmt: skip


def nonce_extension(nonce: bytes) -> x509.Extension:
    return x509.Extension("1.3.6.1.5.5.7.48.1.2", False, der.octet_string(nonce))


def response(
    *singles: bytes, key: sm2.PrivateKey = CA_KEY, responder: x509.Certificate = CA, by_key: bool = False,
    certificates: tuple[x509.AnyCertificate, ...] = (), extensions: list[x509.Extension] | None = None,
    uid: bytes = sm2.DEFAULT_UID, algorithm: str = "1.2.156.10197.1.501", kind: str = "1.3.6.1.5.5.7.48.1.1",
) -> bytes:  # fmt: skip
    name = (der.explicit(2, der.octet_string(hashlib.sha1(responder.public_key.to_bytes()).digest())) if by_key
            else der.explicit(1, responder.subject.to_der()))  # fmt: skip
    body = der.sequence(
        name, der.generalized_time(NOW), der.sequence(*(singles or (single(),))),
        *([] if extensions is None else [der.explicit(1, der.sequence(*(e.to_der() for e in extensions)))]),
    )  # fmt: skip
    basic = der.sequence(
        body, der.sequence(der.oid(algorithm)), der.bit_string(key.sign(body, uid=uid)),
        *([der.explicit(0, der.sequence(*(c.to_der() for c in certificates)))] if certificates else []),
    )  # fmt: skip
    return der.sequence(
        der.enumerated(0), der.explicit(0, der.sequence(der.oid(kind), der.octet_string(basic)))
    )


def verify(data: bytes, **options: Any) -> ocsp.Answer:
    return ocsp.verify(data, LEAF, CA, **{"at": NOW, **options})


# --- what counts ---


@pytest.mark.parametrize("by_key", [False, True])
def test_an_answer_of_the_issuer_counts(by_key: bool) -> None:
    assert verify(response(by_key=by_key)) == ocsp.Answer(NOW, NOW - DAY, NOW + DAY)
    assert verify(response(single(identifier=certificate_id("sha1"))))
    assert verify(response(single(identifier=certificate_id(serial=5)), single(), certificates=(CA,)))
    assert verify(response(uid=b"ca"), uid=b"ca")


@pytest.mark.parametrize("by_key", [False, True])
def test_an_answer_of_a_responder_that_the_issuer_appointed_counts(by_key: bool) -> None:
    data = response(key=RESPONDER_KEY, responder=RESPONDER, certificates=(LEAF, RESPONDER), by_key=by_key)
    assert verify(data).this_update == NOW - DAY


def test_the_nonce_must_be_the_requests() -> None:
    data = response(single(until=None), extensions=[nonce_extension(NONCE)])
    assert verify(data, nonce=NONCE).next_update is None
    for wrong in (NONCE[:-1], NONCE + b"\0", b"\1" + NONCE[1:]):
        with pytest.raises(CertificateError, match="nonce of the request"):
            verify(data, nonce=wrong)
    with pytest.raises(CertificateError, match="nonce of the request"):
        verify(response(), nonce=NONCE)
    with pytest.raises(CertificateError, match="stale: the next was due at once"):
        verify(data)
    assert verify(response(extensions=[nonce_extension(NONCE)]))


def test_the_times_enclose_the_moment() -> None:
    for moment in (NOW - DAY - timedelta(minutes=5), NOW - DAY, NOW + DAY):
        assert verify(response(), at=moment)
    first, last = datetime(1, 1, 1, tzinfo=timezone.utc), datetime(9999, 12, 31, 23, 59, 59, tzinfo=timezone.utc)
    assert verify(response(single(this=first, until=last))).this_update == first
    with pytest.raises(CertificateError, match="the future"):
        verify(response(single(this=last, until=last)))
    with pytest.raises(CertificateError, match="the future"):
        verify(response(), at=NOW - DAY - timedelta(minutes=5, seconds=1))
    with pytest.raises(CertificateError, match="stale"):
        verify(response(), at=NOW + DAY + timedelta(seconds=1))


# --- what does not ---

NOT_OCSP = issued("other", RESPONDER_KEY)
OTHER_CA = root("other CA", RESPONDER_KEY)
EXPIRED = issued("responder", RESPONDER_KEY, days=-1, extended_key_usage=["OCSPSigning"])
SEALS = issued("responder", RESPONDER_KEY, extended_key_usage=["OCSPSigning"], key_usage=["keyEncipherment"])
REVOKED = der.explicit(1, der.generalized_time(NOW - DAY), der.explicit(0, der.enumerated(1)))
CRITICAL = x509.Extension("1.2.3", True, der.null())
REFUSED: dict[str, tuple[bytes, type[Exception], str]] = {
    "revoked": (response(single(REVOKED)), x509.CertificateRevokedError, "revoked at 2026-05-31 .* reason 1"),
    "revoked without a reason": (
        response(single(der.explicit(1, der.generalized_time(NOW - DAY)))), x509.CertificateRevokedError, "00:00$"
    ),
    "unknown": (response(single(der.implicit(2, b""))), CertificateError, "does not know the certificate"),
    "another serial number": (response(single(identifier=certificate_id(serial=5))), CertificateError, "0 statements"),
    "another issuer": (response(single(identifier=certificate_id(ca=OTHER_CA))), CertificateError, "0 statements"),
    "a hash that is not known": (
        response(single(identifier=certificate_id().replace(der.oid(SM3), der.oid("1.2.156.10197.1.402")))),
        CertificateError, "0 statements",
    ),
    "good and revoked": (response(single(), single(REVOKED)), CertificateError, "2 statements"),
    "a critical extension": (response(extensions=[CRITICAL]), CertificateError, r"critical extension 1\.2\.3"),
    "a critical extension of one": (response(single(extensions=[CRITICAL])), CertificateError, "critical extension"),
    "a wrong signature": (response(key=LEAF_KEY), x509.CertificateSignatureError, "does not hold"),
    "another uid": (response(uid=b""), x509.CertificateSignatureError, "does not hold"),
    "another algorithm": (
        response(algorithm="1.2.840.10045.4.3.2"), x509.CertificateAlgorithmError, "not signed with SM2-with-SM3"
    ),
    "a responder that is not here": (
        response(key=RESPONDER_KEY, responder=RESPONDER), x509.CertificateUnknownIssuerError, "responder is not here"
    ),
    "a responder of another CA": (
        response(key=RESPONDER_KEY, responder=OTHER_CA, certificates=(OTHER_CA,)),
        x509.CertificateUnknownIssuerError, "no trusted root",
    ),
    "a responder that was not appointed": (
        response(key=RESPONDER_KEY, responder=NOT_OCSP, certificates=(NOT_OCSP,)),
        x509.CertificateUsageError, "not for OCSPSigning",
    ),
    "the certificate itself": (
        response(key=LEAF_KEY, responder=LEAF, certificates=(LEAF,)), x509.CertificateUsageError, "not for OCSPSigning"
    ),
    "a responder that may not sign": (
        response(key=RESPONDER_KEY, responder=SEALS, certificates=(SEALS,)),
        x509.CertificateUsageError, "not for OCSPSigning",
    ),
    "an expired responder": (
        response(key=RESPONDER_KEY, responder=EXPIRED, certificates=(EXPIRED,)), x509.CertificateExpiredError, "expired"
    ),
    "no answer": (der.sequence(der.enumerated(3)), CertificateError, "gives no answer: tryLater"),
    "no answer for another reason": (der.sequence(der.enumerated(4)), CertificateError, "gives no answer: 4"),
    "another kind": (response(kind="1.2.3"), x509.CertificateMalformedError, r"the kind 1\.2\.3"),
    "a status with content": (response(single(der.implicit(0, b"\0"))), x509.CertificateMalformedError, "not empty"),
    "nothing": (b"", x509.CertificateMalformedError, "not a valid OCSP response"),
    "a certificate": (LEAF.to_der(), x509.CertificateMalformedError, "not a valid OCSP response"),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_what_is_no_good_answer_is_refused(case: str) -> None:
    data, error, reason = REFUSED[case]
    with pytest.raises(CertificateError, match=reason) as raised:
        verify(data)
    assert type(raised.value) is error


def test_every_changed_byte_and_every_value_too_many_is_refused() -> None:
    data = response(key=RESPONDER_KEY, responder=RESPONDER, certificates=(RESPONDER,))
    for i in range(len(data)):
        with pytest.raises(SMCryptoError):
            verify(data[:i] + bytes([data[i] ^ 1]) + data[i + 1 :])
    accepted = []
    for changed in overfull(data):
        try:
            accepted.append(verify(changed))
        except SMCryptoError:
            continue
    assert len(accepted) == 1  # the NULL behind SM2-with-SM3 that older software writes
    for size in range(len(data)):
        with pytest.raises(x509.CertificateMalformedError):
            verify(data[:size])


def test_arguments_that_do_not_fit() -> None:
    for call, error in (
        (lambda: ocsp.request(LEAF, CA, hash="md5"), InvalidOption),  # type: ignore[arg-type]
        (lambda: ocsp.request(LEAF, CA, nonce=b""), InvalidLength),
        (lambda: ocsp.request(LEAF, CA, nonce=bytes(33)), InvalidLength),
        (lambda: ocsp.request(LEAF, LEAF), x509.CertificateUnknownIssuerError),
        (lambda: ocsp.request(b"", CA), TypeError),  # type: ignore[arg-type]
        (lambda: ocsp.request(LEAF, b""), TypeError),  # type: ignore[arg-type]
        (lambda: verify(response(), at=NOW.replace(tzinfo=None)), InvalidOption),
        (lambda: verify(response(), nonce=b""), InvalidLength),
        (lambda: verify("response"), TypeError),  # type: ignore[arg-type]
        (lambda: ocsp.verify(response(), b"", CA, at=NOW), TypeError),  # type: ignore[arg-type]
        (lambda: ocsp.verify(response(), LEAF, LEAF, at=NOW), x509.CertificateUnknownIssuerError),
    ):
        with pytest.raises(error):
            call()


# --- others ---


@pytest.mark.parametrize(("hash", "nonce"), [("sha1", None), ("sha256", NONCE)])
def test_cryptography_reads_our_requests_and_the_answers_of_these_tests(hash: Any, nonce: bytes | None) -> None:
    theirs = pytest.importorskip("cryptography.x509.ocsp")
    read = theirs.load_der_ocsp_request(ocsp.request(LEAF, CA, nonce=nonce, hash=hash))
    assert read.serial_number == LEAF.serial_number and read.hash_algorithm.name == hash
    digest = hashlib.new(hash, CA.public_key.to_bytes()).digest()
    assert read.issuer_key_hash == digest and len(read.extensions) == (nonce is not None)
    if nonce is not None:
        assert [extension.value.nonce for extension in read.extensions] == [nonce]
    answer = theirs.load_der_ocsp_response(response(single(identifier=certificate_id("sha1")), responder=CA))
    assert answer.serial_number == LEAF.serial_number and answer.certificate_status.name == "GOOD"


@pytest.mark.parametrize("delegated", [False, True])
@pytest.mark.parametrize("revoked", [False, True])
def test_openssl_answers_our_request(
    delegated: bool, revoked: bool, tmp_path: Path, require: Callable[[str], str]
) -> None:
    """OpenSSL 3.0 signs answers with an empty uid; those of a certificate under the usual uid it cannot verify."""
    signer, key = (RESPONDER, RESPONDER_KEY) if delegated else (CA, CA_KEY)
    (tmp_path / "ca.pem").write_bytes(CA.to_pem())
    (tmp_path / "signer.pem").write_bytes(signer.to_pem())
    (tmp_path / "key.pem").write_bytes(key.to_pem())
    state = "R\t351231000000Z\t260101000000Z,superseded" if revoked else "V\t351231000000Z\t"
    (tmp_path / "index").write_text(f"{state}\t{LEAF.serial_number:X}\tunknown\t/CN=leaf\n")
    (tmp_path / "request").write_bytes(ocsp.request(LEAF, CA, nonce=NONCE))
    subprocess.run(
        [require("openssl"), "ocsp", "-index", "index", "-CA", "ca.pem", "-rsigner", "signer.pem", "-rkey", "key.pem",
         "-rmd", "sm3", "-reqin", "request", "-respout", "response", "-ndays", "1"],
        cwd=tmp_path, capture_output=True, check=True,
    )  # fmt: skip
    data = (tmp_path / "response").read_bytes()
    moment = datetime.now(timezone.utc)  # as OpenSSL writes it
    if revoked:
        with pytest.raises(x509.CertificateRevokedError, match=r"revoked at 2026-01-01 .* reason 4"):
            ocsp.verify(data, LEAF, CA, at=moment, nonce=NONCE, uid=b"")
    else:
        answer = ocsp.verify(data, LEAF, CA, at=moment, nonce=NONCE, uid=b"")
        assert answer.next_update is not None and abs(answer.produced_at - moment) < timedelta(minutes=5)
    with pytest.raises(x509.CertificateSignatureError):
        ocsp.verify(data, LEAF, CA, at=moment, nonce=NONCE)
