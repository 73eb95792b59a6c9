"""Time stamps, RFC 3161: what counts, what does not, and what OpenSSL makes of our requests."""

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
    InvalidEncoding,
    InvalidOption,
    InvalidSignature,
    SMCryptoError,
    der,
    sm2,
    sm3,
    timestamp,
    x509,
)

NOW = datetime(2026, 6, 1, 12, tzinfo=timezone.utc)
DAY = timedelta(days=1)
DATA = b"what existed"
NONCE = 0x1234567890ABCDEF
CA_KEY, KEY = sm2.PrivateKey.from_int(0xCA), sm2.PrivateKey.from_int(0x75A)
CA = x509.self_signed(CA_KEY, subject={"CN": "CA"}, not_before=NOW - 99 * DAY, not_after=NOW + 99 * DAY)
TST_INFO, SIGNED_DATA = "1.2.840.113549.1.9.16.1.4", "1.2.840.113549.1.7.2"
SM3, SM2_WITH_SM3 = "1.2.156.10197.1.401", "1.2.156.10197.1.501"


def issued(**options: Any) -> x509.Certificate:
    request = x509.CertificateSigningRequest.create(KEY, subject={"CN": "authority"})
    request.verify()
    options = {"not_before": NOW - 50 * DAY, "not_after": NOW + 50 * DAY, "extended_key_usage": ["timeStamping"],
               **options}  # fmt: skip
    return x509.issue(request, CA, CA_KEY, **options)


AUTHORITY = issued()


def imprint(data: bytes = DATA, *, oid: str = SM3, null: bool = True) -> bytes:
    digest = sm3.digest(data) if oid == SM3 else hashlib.sha256(data).digest()
    return der.sequence(der.sequence(der.oid(oid), *([der.null()] if null else [])), der.octet_string(digest))


def info(
    *after: bytes, version: int = 1, of: bytes = imprint(), time: bytes = b"20260601120000Z",
    tail: tuple[bytes, ...] = (),
) -> bytes:
    """TSTInfo; `after`: what comes between the time and the nonce."""
    return der.sequence(
        der.integer(version), der.oid("1.2.3.4"), of, der.integer(77),
        der.element(der.GENERALIZED_TIME, time), *after, *tail,
    )  # fmt: skip


def named(hash: str = "sha256", certificate: x509.Certificate = AUTHORITY) -> tuple[bytes, bytes]:
    """The attribute that names the signer's certificate, RFC 5816."""
    encoded = certificate.to_der()
    if hash == "sha1":
        one = der.sequence(der.octet_string(hashlib.sha1(encoded).digest()))
        return der.oid("1.2.840.113549.1.9.16.2.12"), der.sequence(der.sequence(one))
    algorithm = {"sha256": b"", "sm3": der.sequence(der.oid(SM3)), "other": der.sequence(der.oid("1.2.3"))}[hash]
    digest = sm3.digest(encoded) if hash == "sm3" else hashlib.sha256(encoded).digest()
    one = der.sequence(algorithm, der.octet_string(digest))
    return der.oid("1.2.840.113549.1.9.16.2.47"), der.sequence(der.sequence(one))


def token(
    content: bytes | None = None, *, names: tuple[bytes, bytes] | None = named(), signer: x509.Certificate = AUTHORITY,
    uid: bytes = sm2.DEFAULT_UID, type: str = TST_INFO, signers: int = 1, certificates: bool = True,
) -> bytes:  # fmt: skip
    data = info() if content is None else content
    attributes = [(der.oid("1.2.840.113549.1.9.3"), der.oid(type)),
                  (der.oid("1.2.840.113549.1.9.4"), der.octet_string(sm3.digest(data))),
                  *([] if names is None else [names])]  # fmt: skip
    encoded = sorted(der.sequence(kind, der.set_of(value)) for kind, value in attributes)
    algorithm = der.sequence(der.oid(SM3), der.null())
    one = der.sequence(
        der.integer(1), der.sequence(signer.issuer.to_der(), der.integer(signer.serial_number)), algorithm,
        der.explicit(0, *encoded), der.sequence(der.oid(SM2_WITH_SM3)),
        der.octet_string(KEY.sign(der.set_of(*encoded), uid=uid)),
    )  # fmt: skip
    body = der.sequence(
        der.integer(3), der.set_of(algorithm), der.sequence(der.oid(type), der.explicit(0, der.octet_string(data))),
        *([der.explicit(0, signer.to_der())] if certificates else []), der.element(der.SET, one * signers),
    )  # fmt: skip
    return der.sequence(der.oid(SIGNED_DATA), der.explicit(0, body))


def response(status: int, *after: bytes) -> bytes:
    return der.sequence(der.sequence(der.integer(status), *after[:1]), *after[1:])


def verify(data: bytes, content: bytes = DATA, **options: Any) -> timestamp.TimeStamp:
    return timestamp.verify(data, content, **{"roots": [CA], "at": NOW, **options})


# --- what counts ---


def test_a_token_and_a_response_with_one_count() -> None:
    stamp = timestamp.TimeStamp(NOW, None, "1.2.3.4", 77, AUTHORITY)
    assert verify(token()) == stamp
    for status in (0, 1):
        assert verify(response(status, b"", token())) == stamp
    assert verify(token(info(of=imprint(null=False)))) == stamp
    assert verify(token(uid=b"authority"), uid=b"authority") == stamp
    assert verify(token(certificates=False), intermediates=[AUTHORITY]) == stamp


@pytest.mark.parametrize("hash", ["sha1", "sha256", "sm3"])
def test_the_signer_is_named_by_every_usual_hash(hash: str) -> None:
    assert verify(token(names=named(hash))).signer == AUTHORITY


def test_every_optional_part_is_read() -> None:
    accuracy = der.sequence(der.integer(2), der.implicit(0, b"\5"), der.implicit(1, b"\7"))
    authority = der.explicit(0, der.explicit(4, AUTHORITY.subject.to_der()))
    other_name = der.explicit(0, der.implicit(2, b"tsa.example"))
    extension = der.explicit(1, x509.Extension("1.2.3", False, der.null()).to_der())
    for name in (authority, other_name):
        content = info(accuracy, der.boolean(True), tail=(der.integer(NONCE), name, extension))
        assert verify(token(content), nonce=NONCE).accuracy == timedelta(seconds=2, milliseconds=5, microseconds=7)
    assert verify(token(info(der.sequence()))).accuracy == timedelta(0)
    assert verify(token(info(time=b"20260601115959.25Z"))).time == NOW - timedelta(milliseconds=750)
    assert verify(token(info(time=b"20260601115959.1234567Z"))).time == NOW - timedelta(microseconds=1_000_000 - 123456)


def test_the_time_lies_in_the_validity_of_the_signer_and_at_most_five_minutes_ahead() -> None:
    assert verify(token(), at=NOW - timedelta(minutes=5)).time == NOW
    for at, time in ((NOW - timedelta(minutes=5, seconds=1), b"20260601120000Z"), (NOW, b"20260412115959Z")):
        with pytest.raises(InvalidSignature, match="when its signer was not valid"):
            verify(token(info(time=time)), at=at)
    assert verify(token(info(time=b"20260412120000Z")))
    for time in (b"00010101000000Z", b"99991231235959Z"):
        with pytest.raises(InvalidSignature, match="when its signer was not valid"):
            verify(token(info(time=time)))
    last = datetime(9999, 12, 31, 23, 59, 59, tzinfo=timezone.utc)
    with pytest.raises(x509.CertificateExpiredError):
        verify(token(), at=last)


# --- what does not ---

NOT_ALONE = issued(extended_key_usage=["timeStamping", "codeSigning"])
CRITICAL = der.explicit(1, x509.Extension("1.2.3", True, der.null()).to_der())
OTHER_NAME = der.explicit(0, der.explicit(4, CA.subject.to_der()))
REFUSED: dict[str, tuple[bytes, type[Exception], str]] = {
    "other data": (token(info(of=imprint(b"other"))), InvalidSignature, "not of this content"),
    "another hash": (token(info(of=imprint(oid="2.16.840.1.101.3.4.2.1"))), InvalidSignature, "not over SM3"),
    "another uid": (token(uid=b""), InvalidSignature, "does not hold"),
    "two signers": (token(signers=2), InvalidEncoding, "one signer, not 2"),
    "nobody": (token(signers=0), InvalidSignature, "nobody signed"),
    "no name of the signer": (token(names=None), InvalidSignature, "by which certificate"),
    "another signer named": (token(names=named(certificate=CA)), InvalidSignature, "another certificate than it says"),
    "the signer named by a hash that is not known": (token(names=named("other")), InvalidSignature, "than it says"),
    "another authority named": (token(info(tail=(OTHER_NAME,))), InvalidSignature, "names another authority"),
    "a critical extension": (token(info(tail=(CRITICAL,))), InvalidEncoding, r"critical extension 1\.2\.3"),
    "another version": (token(info(version=2)), InvalidEncoding, "version 2"),
    "an accuracy of 1000 ms": (
        token(info(der.sequence(der.implicit(0, b"\3\xe8")))), InvalidEncoding, "out of range"
    ),
    "an accuracy of 1000 us": (
        token(info(der.sequence(der.implicit(1, b"\3\xe8")))), InvalidEncoding, "out of range"
    ),
    "an accuracy of -1 ms": (token(info(der.sequence(der.implicit(0, b"\xff")))), InvalidEncoding, "out of range"),
    "an accuracy of -1 us": (token(info(der.sequence(der.implicit(1, b"\xff")))), InvalidEncoding, "out of range"),
    "an accuracy of 136 years": (token(info(der.sequence(der.integer(1 << 32)))), InvalidEncoding, "out of range"),
    "a fraction that ends in 0": (token(info(time=b"20260601120000.50Z")), InvalidEncoding, "fraction"),
    "an empty fraction": (token(info(time=b"20260601120000.Z")), InvalidEncoding, "fraction"),
    "a fraction without Z": (token(info(time=b"20260601120000.55")), InvalidEncoding, "fraction"),
    "something after the token's fields": (token(info(tail=(der.null(),))), InvalidEncoding, "left over"),
    "a message that is no token": (token(type="1.2.840.113549.1.7.1"), InvalidEncoding, "the content is of the kind"),
    "a signer that is not for time stamps alone": (
        token(signer=NOT_ALONE, names=named(certificate=NOT_ALONE)), x509.CertificateUsageError, "alone"
    ),
    "refused": (
        response(2, der.sequence(der.utf8_string("too busy"))), InvalidSignature, "status 2: '.*too busy"
    ),
    "granted without a token": (response(0), InvalidEncoding, "the end"),
    "nothing": (b"", InvalidEncoding, "the end"),
}  # fmt: skip


@pytest.mark.parametrize("case", REFUSED)
def test_what_is_no_time_stamp_of_the_content_is_refused(case: str) -> None:
    data, error, reason = REFUSED[case]
    with pytest.raises(error, match=reason) as raised:
        verify(data)
    assert type(raised.value) is error


def test_a_signer_without_the_purpose_is_refused() -> None:
    for usage, reason in (([], "alone"), (["codeSigning"], "is not for timeStamping")):
        signer = issued(extended_key_usage=usage)
        with pytest.raises(x509.CertificateUsageError, match=reason):
            verify(token(signer=signer, names=named(certificate=signer)))


def test_certificates_for_time_stamps_are_issued_as_rfc_3161_wants_them() -> None:
    critical = [e.critical for c in (AUTHORITY, NOT_ALONE) for e in c.extensions if e.oid == "2.5.29.37"]
    assert critical == [True, False]


def test_the_nonce_must_be_the_requests() -> None:
    data = token(info(tail=(der.integer(NONCE),)))
    assert verify(data, nonce=NONCE) == verify(data)
    for stale, nonce in ((data, NONCE + 1), (token(), NONCE)):
        with pytest.raises(InvalidSignature, match="nonce of the request"):
            verify(stale, nonce=nonce)


def test_every_changed_byte_and_every_value_too_many_is_refused() -> None:
    data = token()
    changed = [data[:i] + bytes([data[i] ^ 1]) + data[i + 1 :] for i in range(len(data))]
    accepted = []
    for one in (*changed, *overfull(data)):
        try:
            verify(one)
            accepted.append(one)
        except SMCryptoError:
            continue
    # What no signature covers and says nothing: the versions of SignedData and SignerInfo, a NULL behind SM2-with-SM3.
    assert len(accepted) == 3 and [one in changed for one in accepted] == [True, True, False]
    for size in range(len(data)):
        with pytest.raises(InvalidEncoding):
            verify(data[:size])


def test_arguments_that_do_not_fit() -> None:
    for call, error in (
        (lambda: timestamp.request(DATA, nonce=0), InvalidOption),
        (lambda: timestamp.request(DATA, nonce=1 << 159), InvalidOption),
        (lambda: timestamp.request(DATA, nonce=b"1"), TypeError),  # type: ignore[arg-type]
        (lambda: timestamp.request(DATA, policy="x"), InvalidEncoding),
        (lambda: timestamp.request(DATA, policy=1), TypeError),  # type: ignore[arg-type]
        (lambda: timestamp.request("text"), TypeError),  # type: ignore[arg-type]
        (lambda: verify(token(), nonce=-1), InvalidOption),
        (lambda: verify(token(), at=NOW.replace(tzinfo=None)), InvalidOption),
    ):
        with pytest.raises(error):
            call()


# --- OpenSSL: 3.0 reads requests over SM3, but signs no token with SM2 ("signing not supported for this key type") ---


def test_openssl_reads_our_request_and_we_read_its_refusal(tmp_path: Path, require: Callable[[str], str]) -> None:
    def openssl(*arguments: str) -> str:
        command = [require("openssl"), "ts", *arguments]
        return subprocess.run(command, cwd=tmp_path, capture_output=True, check=True, text=True).stdout

    (tmp_path / "request").write_bytes(timestamp.request(DATA, nonce=NONCE, policy="1.2.3.4"))
    shown = openssl("-query", "-in", "request", "-text")
    assert "Hash Algorithm: sm3" in shown and f"Nonce: {NONCE:#x}".lower() in shown.lower()
    assert "Policy OID: 1.2.3.4" in shown and "Certificate required: yes" in shown
    (tmp_path / "signer.pem").write_bytes(AUTHORITY.to_pem())
    (tmp_path / "key.pem").write_bytes(KEY.to_pem())
    (tmp_path / "serial").write_text("01\n")
    (tmp_path / "conf").write_text(
        "[tsa]\ndefault_tsa=t\n[t]\nserial=serial\nsigner_digest=sm3\ndefault_policy=1.2.3.4\ndigests=sha256\n"
    )
    openssl("-reply", "-config", "conf", "-queryfile", "request", "-signer", "signer.pem", "-inkey", "key.pem",
            "-out", "response")  # fmt: skip
    with pytest.raises(InvalidSignature, match="status 2"):
        verify((tmp_path / "response").read_bytes())
