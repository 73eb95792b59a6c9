"""Peers that lie: each message of either side, in each way that a check is there for, and the alert that it earns.

The liar knows all keys that it should know, and its Finished covers what it sent: what refuses is the check itself.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Mapping
from types import MappingProxyType
from typing import Any, NamedTuple

import pytest

from smcrypto.sm2 import PrivateKey
from smcrypto.tls import Alert, TLSError
from smcrypto.tls.messages import Extension, Hello, Kind, Message, pack, pack_extensions, pack_numbers, vector
from smcrypto.tls.tls13 import RETRY
from tls_peers import (
    CA,
    CLIENT,
    CLIENT_ENC,
    HOST,
    OTHER_ROOT,
    ROOT,
    SERVER,
    SERVER_ENC,
    client_context,
    lie,
    pair,
    refused,
    server_context,
)

TLCP, TLS13 = "TLCPv1.1", "TLSv1.3"
Change = Callable[[bytes], Iterable[tuple[int, bytes]]]
STRANGER = PrivateKey.from_int(0x1234567)


class Lie(NamedTuple):
    """`liar` sends what `change` makes of its message `kind`; the other refuses with `alert`."""

    name: str
    liar: str
    kind: Kind
    change: Change
    alert: Alert
    options: Mapping[str, Any] = MappingProxyType({})


def instead(kind: Kind, body: Callable[[bytes], bytes]) -> Change:
    return lambda honest: [(kind, body(honest))]


def hello(kind: Kind, **changes: Any) -> Change:
    """A hello with other fields; `extensions` are laid over its own, None takes one away."""

    def change(honest: bytes) -> Iterable[tuple[int, bytes]]:
        read = Hello.read(Message(kind, honest))
        extensions = {k: v for k, v in (read.extensions | changes.get("extensions", {})).items() if v is not None}
        fields = {name: value for name, value in changes.items() if name != "extensions"}
        yield kind, read._replace(extensions=extensions, **fields).pack(kind)

    return change


def server_says(**changes: Any) -> Change:
    return hello(Kind.server_hello, **changes)


def client_says(**changes: Any) -> Change:
    return hello(Kind.client_hello, **changes)


def certificates13(*holders: Any) -> bytes:
    return vector(1) + vector(3, *(vector(3, one.certificate.to_der()) + vector(2) for one in holders))


def certificates_tlcp(*holders: Any) -> bytes:
    return vector(3, *(vector(3, one.certificate.to_der()) for one in holders))


def says(body: bytes) -> Callable[[bytes], bytes]:
    return lambda honest: body


def signed_by_stranger(honest: bytes) -> bytes:
    return honest[:2] + vector(2, STRANGER.sign(b"something else"))


def flipped(honest: bytes) -> bytes:
    return honest[:-1] + bytes([honest[-1] ^ 1])


OFF_CURVE = b"\x04" + bytes(64)
OTHER = OTHER_ROOT.issue(HOST, subject_alt_names=[f"DNS:{HOST}"])
ELSEWHERE = ROOT.issue("elsewhere", subject_alt_names=["DNS:elsewhere.example"])
EXPIRED = ROOT.issue(
    HOST, subject_alt_names=[f"DNS:{HOST}"], not_before=ROOT.certificate.not_before,
    not_after=ROOT.certificate.not_before,
)  # fmt: skip
FOR_CLIENTS = ROOT.issue(HOST, subject_alt_names=[f"DNS:{HOST}"], extended_key_usage=["clientAuth"])
SH, CH, CERT = Kind.server_hello, Kind.client_hello, Kind.certificate
VERIFY, FINISHED, REQUEST = Kind.certificate_verify, Kind.finished, Kind.certificate_request
X = Extension
AUTH = {"verify_client": "required"}

LIES_13 = [
    Lie("version", "server", SH, server_says(version=0x0302), Alert.illegal_parameter),
    Lie("session id", "server", SH, server_says(session_id=b"x"), Alert.illegal_parameter),
    Lie("suite", "server", SH, server_says(suites=(0x1301,)), Alert.illegal_parameter),
    Lie("TLS 1.2", "server", SH, server_says(extensions={X.supported_versions: None}), Alert.protocol_version),
    Lie("TLS 1.2, said", "server", SH, server_says(extensions={X.supported_versions: b"\3\3"}), Alert.protocol_version),
    Lie("unasked", "server", SH, server_says(extensions={99: b""}), Alert.unsupported_extension),
    Lie("resumes nothing", "server", SH, server_says(extensions={X.pre_shared_key: b"\0\0"}),
        Alert.unsupported_extension),
    Lie("no share", "server", SH, server_says(extensions={X.key_share: None}), Alert.missing_extension),
    Lie("other group", "server", SH, server_says(extensions={X.key_share: pack(23) + vector(2, bytes(65))}),
        Alert.illegal_parameter),
    Lie("short share", "server", SH, server_says(extensions={X.key_share: pack(41) + vector(2, b"\2" + bytes(32))}),
        Alert.illegal_parameter),
    Lie("off the curve", "server", SH, server_says(extensions={X.key_share: pack(41) + vector(2, OFF_CURVE)}),
        Alert.illegal_parameter),
    Lie("compresses", "server", SH, instead(SH, lambda b: b[:37] + b"\1" + b[38:]), Alert.illegal_parameter),
    Lie("extension twice", "server", SH, instead(SH, lambda b: b[:38] + vector(2, b[40:] + b[40:])),
        Alert.illegal_parameter),
    Lie("too long", "server", SH, instead(SH, lambda b: b + b"\0"), Alert.decode_error),
    Lie("too short", "server", SH, instead(SH, lambda b: b[:-1]), Alert.decode_error),
    Lie("retry for nothing", "server", SH, server_says(random=RETRY, extensions={X.key_share: None}),
        Alert.illegal_parameter),
    Lie("retry for a share that was there", "server", SH,
        server_says(random=RETRY, extensions={X.cookie: vector(2, b"x")}), Alert.illegal_parameter),
    Lie("unasked protocol", "server", Kind.encrypted_extensions,
        instead(Kind.encrypted_extensions, says(pack_extensions({X.alpn: vector(2, vector(1, b"h2"))}))),
        Alert.unsupported_extension),
    Lie("protocol not offered", "server", Kind.encrypted_extensions,
        instead(Kind.encrypted_extensions, says(pack_extensions({X.alpn: vector(2, vector(1, b"h3"))}))),
        Alert.illegal_parameter, {"alpn": ["h2", "x"]}),
    Lie("two protocols", "server", Kind.encrypted_extensions,
        instead(Kind.encrypted_extensions, says(pack_extensions({X.alpn: vector(2, b"\2h2\1x")}))),
        Alert.illegal_parameter, {"alpn": ["h2", "x"]}),
    Lie("request with context", "server", REQUEST, instead(REQUEST, lambda b: vector(1, b"x") + b[1:]),
        Alert.illegal_parameter, AUTH),
    Lie("request without algorithms", "server", REQUEST, instead(REQUEST, says(b"\0\0\0")), Alert.missing_extension,
        AUTH),
    Lie("request for other algorithms", "server", REQUEST,
        instead(REQUEST, says(b"\0" + pack_extensions({X.signature_algorithms: pack_numbers([0x0403])}))),
        Alert.handshake_failure, AUTH),
    Lie("no certificate", "server", CERT, instead(CERT, says(certificates13())), Alert.decode_error),
    Lie("certificate context", "server", CERT, instead(CERT, lambda b: vector(1, b"x") + b[1:]),
        Alert.illegal_parameter),
    Lie("no certificate at all", "server", CERT, instead(CERT, says(vector(1) + vector(3, vector(3, b"0") + b"\0\0"))),
        Alert.bad_certificate),
    Lie("certificate cut", "server", CERT, instead(CERT, lambda b: b[:-1]), Alert.decode_error),
    Lie("eleven certificates", "server", CERT, instead(CERT, says(certificates13(*[SERVER] * 11))),
        Alert.bad_certificate),
    Lie("the encryption certificate", "server", CERT, instead(CERT, says(certificates13(SERVER_ENC, CA))),
        Alert.unsupported_certificate),
    Lie("unknown CA", "server", CERT, instead(CERT, says(certificates13(OTHER))), Alert.unknown_ca),
    Lie("without the CA's", "server", CERT, instead(CERT, says(certificates13(SERVER))), Alert.unknown_ca),
    Lie("expired", "server", CERT, instead(CERT, says(certificates13(EXPIRED))), Alert.certificate_expired),
    Lie("another host's", "server", CERT, instead(CERT, says(certificates13(ELSEWHERE))), Alert.bad_certificate),
    Lie("a client's", "server", CERT, instead(CERT, says(certificates13(FOR_CLIENTS))), Alert.unsupported_certificate),
    Lie("stolen certificate", "server", VERIFY, instead(VERIFY, signed_by_stranger), Alert.decrypt_error),
    Lie("no signature", "server", VERIFY, instead(VERIFY, lambda b: b[:2] + b"\0\0"), Alert.decrypt_error),
    Lie("other algorithm", "server", VERIFY, instead(VERIFY, lambda b: b"\4\3" + b[2:]), Alert.illegal_parameter),
    Lie("Finished", "server", FINISHED, instead(FINISHED, flipped), Alert.decrypt_error),
    Lie("short Finished", "server", FINISHED, instead(FINISHED, lambda b: b[:-1]), Alert.decrypt_error),
    Lie("other suites", "client", CH, client_says(suites=(0x1301,)), Alert.handshake_failure),
    Lie("TLS 1.2", "client", CH, client_says(extensions={X.supported_versions: None}), Alert.protocol_version),
    Lie("TLS 1.2, said", "client", CH, client_says(extensions={X.supported_versions: b"\2\3\3"}),
        Alert.protocol_version),
    Lie("version", "client", CH, client_says(version=0x0302), Alert.protocol_version),
    Lie("no groups", "client", CH, client_says(extensions={X.supported_groups: None}), Alert.missing_extension),
    Lie("other groups", "client", CH, client_says(extensions={X.supported_groups: pack_numbers([23])}),
        Alert.handshake_failure),
    Lie("odd groups", "client", CH, client_says(extensions={X.supported_groups: vector(2, b"123")}),
        Alert.decode_error),
    Lie("no shares", "client", CH, client_says(extensions={X.key_share: None}), Alert.missing_extension),
    Lie("two shares", "client", CH,
        client_says(extensions={X.key_share: vector(2, (pack(41) + vector(2, bytes(65))) * 2)}),
        Alert.illegal_parameter),
    Lie("off the curve", "client", CH,
        client_says(extensions={X.key_share: vector(2, pack(41) + vector(2, OFF_CURVE))}),
        Alert.illegal_parameter),
    Lie("no algorithms", "client", CH, client_says(extensions={X.signature_algorithms: None}), Alert.missing_extension),
    Lie("other algorithms", "client", CH, client_says(extensions={X.signature_algorithms: pack_numbers([0x0403])}),
        Alert.handshake_failure),
    Lie("other protocols", "client", CH, client_says(extensions={X.alpn: vector(2, vector(1, b"h3"))}),
        Alert.no_application_protocol, {"alpn": ["h2"]}),
    Lie("name not ASCII", "client", CH,
        client_says(extensions={X.server_name: vector(2, b"\0", vector(2, b"\xff"))}), Alert.illegal_parameter),
    Lie("long session id", "client", CH, client_says(session_id=bytes(33)), Alert.decode_error),
    Lie("must compress", "client", CH, instead(CH, lambda b: b[:39] + vector(1, b"\1") + b[41:]),
        Alert.illegal_parameter),
    Lie("always the same hello", "client", CH, client_says(extensions={X.key_share: vector(2)}),
        Alert.illegal_parameter),
    Lie("no certificate", "client", CERT, instead(CERT, says(certificates13())), Alert.certificate_required, AUTH),
    Lie("a server's", "client", CERT, instead(CERT, says(certificates13(SERVER, CA))), Alert.unsupported_certificate,
        AUTH),
    Lie("stolen certificate", "client", VERIFY, instead(VERIFY, signed_by_stranger), Alert.decrypt_error, AUTH),
    Lie("Finished", "client", FINISHED, instead(FINISHED, flipped), Alert.decrypt_error),
]  # fmt: skip

SKE, CKE, DONE = Kind.server_key_exchange, Kind.client_key_exchange, Kind.server_hello_done
EPHEMERAL = AUTH | {"suites": ["ECDHE_SM4_GCM_SM3"]}


def sealed(secret: bytes) -> bytes:
    return vector(2, SERVER_ENC.key.public_key.encrypt(secret))


LIES_TLCP = [
    Lie("version", "server", SH, server_says(version=0x0303), Alert.protocol_version),
    Lie("suite", "server", SH, server_says(suites=(0xE011,)), Alert.illegal_parameter),
    Lie("unasked", "server", SH, server_says(extensions={99: b""}), Alert.unsupported_extension),
    Lie("one certificate", "server", CERT, instead(CERT, says(certificates_tlcp(SERVER))), Alert.bad_certificate),
    Lie("no certificate", "server", CERT, instead(CERT, says(certificates_tlcp())), Alert.bad_certificate),
    Lie("swapped", "server", CERT, instead(CERT, says(certificates_tlcp(SERVER_ENC, SERVER, CA))),
        Alert.unsupported_certificate),
    Lie("two that sign", "server", CERT, instead(CERT, says(certificates_tlcp(SERVER, SERVER, CA))),
        Alert.unsupported_certificate),
    Lie("another host's", "server", CERT, instead(CERT, says(certificates_tlcp(ELSEWHERE, SERVER_ENC, CA))),
        Alert.bad_certificate),
    Lie("expired", "server", CERT, instead(CERT, says(certificates_tlcp(EXPIRED, SERVER_ENC, CA))),
        Alert.certificate_expired),
    Lie("another encryption certificate", "server", CERT,
        instead(CERT, says(certificates_tlcp(SERVER, CLIENT_ENC, CA))), Alert.decrypt_error),
    Lie("stolen certificate", "server", SKE, instead(SKE, lambda b: vector(2, STRANGER.sign(b""))),
        Alert.decrypt_error),
    Lie("exchange too long", "server", SKE, instead(SKE, lambda b: b + b"\0"), Alert.decode_error),
    Lie("off the curve", "server", SKE, instead(SKE, lambda b: b[:4] + OFF_CURVE + b[69:]), Alert.decrypt_error,
        EPHEMERAL),
    Lie("ECDHE without request", "server", REQUEST, lambda b: [], Alert.handshake_failure, EPHEMERAL),
    Lie("request cut", "server", REQUEST, instead(REQUEST, lambda b: b[:-1]), Alert.decode_error, AUTH),
    Lie("done and more", "server", DONE, instead(DONE, says(b"\0")), Alert.decode_error),
    Lie("Finished", "server", FINISHED, instead(FINISHED, flipped), Alert.decrypt_error),
    Lie("other suites", "client", CH, client_says(suites=(0xE001,)), Alert.handshake_failure),
    Lie("no certificate", "client", CERT, instead(CERT, says(certificates_tlcp())), Alert.handshake_failure, AUTH),
    Lie("one certificate", "client", CERT, instead(CERT, says(certificates_tlcp(CLIENT))), Alert.bad_certificate,
        EPHEMERAL),
    Lie("two that sign", "client", CERT, instead(CERT, says(certificates_tlcp(CLIENT, CLIENT))),
        Alert.unsupported_certificate, EPHEMERAL),
    Lie("that to encrypt only", "client", CERT, instead(CERT, says(certificates_tlcp(CLIENT_ENC))),
        Alert.unsupported_certificate, AUTH),
    Lie("a server's", "client", CERT, instead(CERT, says(certificates_tlcp(SERVER, SERVER_ENC, CA))),
        Alert.unsupported_certificate, AUTH),
    Lie("stolen certificate", "client", VERIFY, instead(VERIFY, lambda b: vector(2, STRANGER.sign(b""))),
        Alert.decrypt_error, AUTH),
    Lie("no ciphertext", "client", CKE, instead(CKE, says(vector(2, b"x"))), Alert.decrypt_error),
    Lie("another key's ciphertext", "client", CKE,
        instead(CKE, says(vector(2, STRANGER.public_key.encrypt(bytes(48))))),
        Alert.decrypt_error),
    Lie("another version's secret", "client", CKE, instead(CKE, says(sealed(bytes(48)))), Alert.decrypt_error),
    Lie("long secret", "client", CKE, instead(CKE, says(sealed(b"\1\1" + bytes(47)))), Alert.decrypt_error),
    Lie("another secret", "client", CKE, instead(CKE, says(sealed(b"\1\1" + bytes(46)))), Alert.bad_record_mac),
    Lie("point not on the curve", "client", CKE, instead(CKE, says(b"\3\0\x29" + vector(1, OFF_CURVE))),
        Alert.illegal_parameter, EPHEMERAL),
    Lie("Finished", "client", FINISHED, instead(FINISHED, flipped), Alert.decrypt_error),
]  # fmt: skip


CASES = [pytest.param(version, one, id=f"{version}-{one.liar}-{one.kind.name}-{one.name}")
         for version, lies in ((TLS13, LIES_13), (TLCP, LIES_TLCP)) for one in lies]  # fmt: skip


@pytest.mark.parametrize(("version", "told"), CASES)
def test_a_lie_is_refused_with_its_alert(version: str, told: Lie, monkeypatch: pytest.MonkeyPatch) -> None:
    suites = told.options.get("suites", ["ECC_SM4_GCM_SM3", "TLS_SM4_GCM_SM3"])
    suites = [name for name in suites if name.startswith("TLS_") == (version == TLS13)]
    common = {"versions": [version], "suites": suites, "alpn": told.options.get("alpn", [])}
    asks = "verify_client" in told.options
    client = client_context(certificate=asks, **common)
    server = server_context(verify_client="required" if asks else "none", **common)
    lie(monkeypatch, client if told.liar == "client" else server, told.kind, told.change)
    refused(pair(client, server), told.alert)


# --- messages that are missing, repeated or of another kind, in each state ---

SIDES = {
    (TLS13, "server"): (SH, Kind.encrypted_extensions, REQUEST, CERT, VERIFY, FINISHED),
    (TLS13, "client"): (CH, CERT, VERIFY, FINISHED),
    (TLCP, "server"): (SH, CERT, SKE, REQUEST, DONE, FINISHED),
    (TLCP, "client"): (CH, CERT, CKE, VERIFY, FINISHED),
}
PLACES = [(*side, kind) for side, kinds in SIDES.items() for kind in kinds]


def authenticated(version: str) -> tuple[Any, Any]:
    suites = ["ECC_SM4_CBC_SM3", "TLS_SM4_GCM_SM3"]
    return client_context(versions=[version], suites=suites, certificate=True), server_context(
        versions=[version], suites=suites, **AUTH
    )


@pytest.mark.parametrize(("version", "liar", "kind"), PLACES)
@pytest.mark.parametrize("number", [0, 2, 99, 254])
def test_another_message_is_refused_in_every_state(
    version: str, liar: str, kind: Kind, number: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    client, server = authenticated(version)
    number = Kind.client_key_exchange if number == 2 and kind == SH else number
    lie(monkeypatch, client if liar == "client" else server, kind, lambda body: [(number, body)])
    error = refused(pair(client, server), Alert.unexpected_message)
    assert "is due" in str(error)


@pytest.mark.parametrize(("version", "liar", "kind"), PLACES)
def test_a_message_that_comes_twice_is_refused(
    version: str, liar: str, kind: Kind, monkeypatch: pytest.MonkeyPatch
) -> None:
    client, server = authenticated(version)
    lie(monkeypatch, client if liar == "client" else server, kind, lambda body: [(kind, body)] * 2)
    made = pair(client, server)
    if (version, kind) in ((TLS13, SH), (TLS13, FINISHED)):  # the second one comes under keys that are no longer used
        refused(made, Alert.bad_record_mac if kind == FINISHED else Alert.unexpected_message)
    else:
        refused(made, Alert.unexpected_message)


@pytest.mark.parametrize(("version", "liar", "kind"), PLACES)
def test_a_message_that_is_left_out_is_missed(
    version: str, liar: str, kind: Kind, monkeypatch: pytest.MonkeyPatch
) -> None:
    """By the next message, or where none follows by the end of the stream."""
    client, server = authenticated(version)
    lie(monkeypatch, client if liar == "client" else server, kind, lambda body: [])
    made = pair(client, server)
    last = {(TLS13, "client", FINISHED), (TLS13, "client", CH), (TLCP, "client", CH), (TLCP, "server", FINISHED),
            (TLCP, "client", FINISHED), (TLCP, "server", DONE), (TLS13, "server", FINISHED)}  # fmt: skip
    if (version, liar, kind) in last:  # the other waits; the stream's end ends it
        made.run()
        victim = made.client if liar == "server" else made.server
        with pytest.raises(TLSError) as caught:
            victim.receive_data(b"")
        assert caught.value.alert == Alert.close_notify
    else:
        with pytest.raises(TLSError) as caught:
            made.run()
        assert caught.value.alert in (Alert.unexpected_message, Alert.bad_record_mac)
