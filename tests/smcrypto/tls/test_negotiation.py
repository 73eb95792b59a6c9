"""What two honest sides agree on: version, suite, protocol, name, certificates, session; what they do not start."""

from __future__ import annotations

from dataclasses import replace
from datetime import timedelta
from typing import Any

import pytest

from smcrypto.errors import InvalidOption, OutOfOrder
from smcrypto.tls import Alert, Connection, DataReceived, Session, SessionIssued, SMContext, schedule, tlcp, tls13
from smcrypto.tls import connection as connections
from smcrypto.tls import handshake as handshakes
from smcrypto.tls.messages import Extension, Hello, Kind, Message, pack, pack_message, vector
from smcrypto.tls.record import HANDSHAKE, TLS12_VERSION, Plain
from tls_peers import (
    CA,
    CLIENT,
    CLIENT_ENC,
    HOST,
    NOW,
    ROOT,
    SERVER,
    SERVER_ENC,
    Pair,
    client_context,
    completed,
    connect,
    context,
    lie,
    pair,
    refused,
    server_context,
)
from x509_authority import certificates

TLCP, TLS13 = "TLCPv1.1", "TLSv1.3"
VERSIONS = pytest.mark.parametrize("version", [TLCP, TLS13])


def sessions(made: Pair) -> list[Session]:
    return [event.session for event in made.client_events if isinstance(event, SessionIssued)]


@VERSIONS
@pytest.mark.parametrize("step", [1, 2, 7, 100])
def test_bytes_may_come_in_any_pieces(version: str, step: int) -> None:
    made = connect(client_context(versions=[version]), server_context(), step=step)
    made.client.send(b"text")
    made.run(step)
    assert completed(made.client_events).version == completed(made.server_events).version == version
    assert made.server_events[-1] == DataReceived(b"text")


@VERSIONS
def test_messages_may_come_in_one_record_or_in_many(version: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr("smcrypto.tls.record.MAX_FRAGMENT", 40)  # each message is many records, as far as it is known
    writing = connect(client_context(versions=[version]), server_context())
    assert completed(writing.client_events) and completed(writing.server_events)


def test_a_flight_may_come_in_one_record() -> None:
    """TLCP's first flight of the server, which nothing protects."""
    made = pair(client_context(versions=[TLCP]), server_context())
    made.server.receive_data(made.client.data_to_send())
    flight, merged = made.server.data_to_send(), b""
    while flight:
        length = int.from_bytes(flight[3:5], "big")
        merged, flight = merged + flight[5 : 5 + length], flight[5 + length :]
    made.client.receive_data(Plain(0x0101).seal(HANDSHAKE, merged))
    made.run()
    assert completed(made.server_events).version == TLCP


@VERSIONS
def test_a_server_takes_the_version_that_the_client_asks_for_if_it_allows_it(version: str) -> None:
    other = TLS13 if version == TLCP else TLCP
    made = connect(client_context(versions=[version, other]), server_context())
    assert completed(made.server_events).version == version
    refused(pair(client_context(versions=[other]), server_context(versions=[version])), Alert.protocol_version)


@VERSIONS
def test_protocols(version: str) -> None:
    for theirs, ours, agreed in (
        (["h2", "http/1.1"], ["http/1.1", "h2"], "http/1.1"),
        (["h2"], [], None),
        ([], ["h2"], None),
    ):
        made = connect(client_context(versions=[version], alpn=theirs), server_context(alpn=ours))
        assert completed(made.client_events).alpn == completed(made.server_events).alpn == agreed
    made = pair(client_context(versions=[version], alpn=["h3"]), server_context(alpn=["h2"]))
    refused(made, Alert.no_application_protocol)


@VERSIONS
def test_the_servers_certificate_is_for_the_name_or_address(version: str) -> None:
    client = client_context(versions=[version])
    made = connect(client, server_context(), host=HOST.upper() + ".")
    assert made.server.server_hostname == HOST.upper()
    made = connect(client, server_context(), host="192.0.2.1")
    assert completed(made.server_events) and made.server.server_hostname is None
    refused(pair(client, server_context(), host="192.0.2.2"), Alert.bad_certificate)
    refused(pair(client, server_context(), host="other.example"), Alert.bad_certificate)


@VERSIONS
def test_without_sni_the_name_is_checked_but_not_sent(version: str) -> None:
    client = client_context(versions=[version], sni=False)
    made = connect(client, server_context())
    assert completed(made.client_events) and made.server.server_hostname is None
    refused(pair(client, server_context(), host="other.example"), Alert.bad_certificate)


def test_a_tlcp_hello_without_a_name_and_protocols_has_no_extensions() -> None:
    """What GmSSL's servers need: GB/T 38636-2020, 6.4.5.2.1 ends with the compression methods."""
    hello = pair(client_context(versions=[TLCP], sni=False), server_context()).client.data_to_send()
    assert hello.endswith(b"\xe0\x53\xe0\x13" + b"\1\0")


def test_a_tlcp_server_names_the_cas_it_trusts(monkeypatch: pytest.MonkeyPatch) -> None:
    client = client_context(versions=[TLCP], certificate=True)
    requests = []
    honest = tlcp._read_request

    def read(message: Message) -> None:
        requests.append(message.body)
        honest(message)

    monkeypatch.setattr(tlcp, "_read_request", read)
    for roots, names in (([ROOT], vector(2, ROOT.certificate.subject.to_der())), ([ROOT] * 4000, b"")):
        server = server_context(verify_client="required", roots=certificates(*roots))
        assert completed(connect(client, server).server_events).peer_certificates
        assert requests.pop() == b"\1\x40" + vector(2, names)


@VERSIONS
def test_without_check_hostname_any_certificate_of_the_roots_will_do(version: str) -> None:
    client = client_context(versions=[version], check_hostname=False)
    for host in (None, "other.example"):
        assert completed(connect(client, server_context(), host=host).client_events)
    stranger = context(versions=[version], check_hostname=False, roots=[CLIENT.certificate])
    refused(pair(stranger, server_context()), Alert.unknown_ca)


def test_a_name_of_another_type_is_no_name() -> None:
    hello = first_hello()
    names = vector(2, b"\1" + vector(2, b"x"))
    made = serve(hello._replace(extensions={Extension.server_name: names} | drop(hello, Extension.server_name)))
    assert made.server_hostname is None


@pytest.mark.parametrize("version", [TLCP, TLS13])
def test_a_client_may_do_without_a_certificate_only_where_that_is_optional(version: str) -> None:
    suites = {"suites": ["ECC_SM4_GCM_SM3", "TLS_SM4_GCM_SM3"]}
    for certificate, peer in ((True, CLIENT.certificate), (False, None)):
        made = connect(
            client_context(versions=[version], certificate=certificate, **suites),
            server_context(verify_client="optional", **suites),
        )
        found = completed(made.server_events).peer_certificates
        assert found[:1] == ((peer,) if peer else ())
    made = pair(client_context(versions=[version], **suites), server_context(verify_client="required", **suites))
    refused(made, Alert.certificate_required if version == TLS13 else Alert.handshake_failure)


def test_a_tlcp_server_that_does_not_require_certificates_prefers_ecc() -> None:
    client = client_context(versions=[TLCP], certificate=True)
    for options, suite in (
        ({}, "ECC_SM4_GCM_SM3"),
        ({"verify_client": "optional"}, "ECC_SM4_GCM_SM3"),
        ({"verify_client": "required"}, "ECDHE_SM4_GCM_SM3"),
        ({"suites": ["ECDHE_SM4_CBC_SM3", "TLS_SM4_GCM_SM3"]}, "ECDHE_SM4_CBC_SM3"),
    ):
        assert completed(connect(client, server_context(**options)).client_events).suite == suite
    ephemeral = client_context(versions=[TLCP], certificate=True, suites=["ECDHE_SM4_CBC_SM3"])
    refused(pair(ephemeral, server_context(roots=[])), Alert.handshake_failure)


def test_with_ecc_a_client_may_have_the_signing_certificate_only() -> None:
    """gmsm's client sends no other, GmSSL's server takes no other; the standard, 6.4.5.3, has two."""
    own = {"certificates": (CLIENT.certificate,), "key": CLIENT.key}
    made = connect(client_context(versions=[TLCP], **own), server_context(verify_client="optional"))
    assert completed(made.server_events).peer_certificates == (CLIENT.certificate,)
    assert completed(made.client_events).suite == "ECC_SM4_GCM_SM3"


def test_the_client_key_exchange_of_gmssl_and_gotlcp_has_a_length_before_it(monkeypatch: pytest.MonkeyPatch) -> None:
    client = client_context(versions=[TLCP], certificate=True, suites=["ECDHE_SM4_GCM_SM3"])
    lie(monkeypatch, client, Kind.client_key_exchange, lambda body: [(Kind.client_key_exchange, vector(2, body))])
    assert completed(connect(client, server_context()).server_events)


def test_rsa_certificates_are_told_apart(monkeypatch: pytest.MonkeyPatch) -> None:
    """A certificate of another algorithm is read, so that the error can name it, and is nobody's."""
    rsa = pytest.importorskip("cryptography.hazmat.primitives.asymmetric.rsa")
    from cryptography import x509 as other
    from cryptography.hazmat.primitives import hashes

    key = rsa.generate_private_key(65537, 2048)
    name = other.Name([other.NameAttribute(other.NameOID.COMMON_NAME, HOST)])
    made = other.CertificateBuilder(name, name, key.public_key(), 1, NOW - timedelta(1), NOW + timedelta(1))
    from cryptography.hazmat.primitives.serialization import Encoding

    der = made.sign(key, hashes.SHA256()).public_bytes(Encoding.DER)
    server = server_context()
    body = vector(1) + vector(3, vector(3, der) + vector(2))
    lie(monkeypatch, server, Kind.certificate, lambda _: [(Kind.certificate, body)])
    error = refused(pair(client_context(versions=[TLS13]), server), Alert.unsupported_certificate)
    assert "not SM2" in str(error)


# --- HelloRetryRequest ---


def first_hello(**options: Any) -> Hello:
    client = Connection(client_context(versions=[TLS13], **options), server_hostname=HOST)
    return Hello.read(Message(Kind.client_hello, client.data_to_send()[9:]))


def drop(hello: Hello, *numbers: int) -> dict[int, bytes]:
    return {number: data for number, data in hello.extensions.items() if number not in numbers}


def serve(hello: Hello) -> Connection:
    server = Connection(server_context(), server_side=True)
    server.receive_data(Plain(TLS12_VERSION).seal(HANDSHAKE, pack_message(1, hello.pack(Kind.client_hello))))
    return server


@pytest.mark.parametrize("resumed", [False, True])
def test_a_client_without_a_share_is_asked_for_one(monkeypatch: pytest.MonkeyPatch, resumed: bool) -> None:
    """The server's half is the library's; the client here sends its shares only when it is asked again."""
    client, server = client_context(versions=[TLS13]), server_context()
    session = sessions(connect(client, server))[0] if resumed else None
    shares: list[bytes] = []
    honest = tls13.TLS13._offer

    def offer(self: tls13.TLS13, key: Any) -> dict[int, bytes]:
        offered = honest(self, key)
        shares.append(offered[Extension.key_share])
        return offered | {Extension.key_share: vector(2, pack(23) + vector(2, bytes(65)))}

    def retried(self: tls13.TLS13, hello: Hello, answer: Hello, message: Message) -> Hello:
        assert answer.extensions[Extension.key_share] == pack(41)
        self.transcript = tls13._restarted(self.earlier)
        self.transcript.update(message.raw)
        return hello._replace(extensions=hello.extensions | {Extension.key_share: shares[0]})

    monkeypatch.setattr(tls13.TLS13, "_offer", offer)
    monkeypatch.setattr(tls13.TLS13, "_retried", retried)
    made = connect(client, server, session=session)
    for events in (made.client_events, made.server_events):
        assert completed(events).resumed == resumed


@pytest.mark.parametrize("resumed", [False, True])
def test_a_client_sends_the_cookie_back(monkeypatch: pytest.MonkeyPatch, resumed: bool) -> None:
    """The client's half is the library's; the server here asks for another hello, with a cookie, before it answers."""
    client, server = client_context(versions=[TLS13]), server_context()
    session = sessions(connect(client, server))[0] if resumed else None
    cookies = ask_again(monkeypatch, {Extension.cookie: vector(2, b"crumbs")})
    made = connect(client, server, session=session)
    assert cookies == [vector(2, b"crumbs")]
    for events in (made.client_events, made.server_events):
        assert completed(events).resumed == resumed


def ask_again(monkeypatch: pytest.MonkeyPatch, extra: dict[int, bytes], times: int = 1) -> list[bytes]:
    """Servers answer with HelloRetryRequests first; the cookies that came back."""
    cookies: list[bytes] = []
    honest = tls13.TLS13.server

    def server(self: tls13.TLS13, message: Message) -> Any:
        self.took(message)
        hello = Hello.read(message)
        for _ in range(times):
            self.choose_suite(self.suites, hello.suites)
            self.transcript = tls13._restarted(self.transcript)
            self.send_answer(0x0303, tls13.RETRY, hello.session_id, {Extension.supported_versions: b"\3\4"} | extra)
            message = yield (Kind.client_hello,)
            cookies.append(Hello.read(message).extensions[Extension.cookie])
        yield from honest(self, message)

    monkeypatch.setattr(tls13.TLS13, "server", server)
    return cookies


def test_a_client_is_asked_again_once_at_most(monkeypatch: pytest.MonkeyPatch) -> None:
    ask_again(monkeypatch, {Extension.cookie: vector(2, b"crumbs")}, times=2)
    refused(pair(client_context(versions=[TLS13]), server_context()), Alert.unexpected_message)


def test_the_suite_of_the_retry_stands(monkeypatch: pytest.MonkeyPatch) -> None:
    ask_again(monkeypatch, {Extension.cookie: vector(2, b"crumbs")})
    answers = iter([0x00C7, 0x00C6])
    honest = tls13.TLS13.send_answer

    def answer(self: tls13.TLS13, *arguments: Any) -> None:
        self.suite = {0x00C7: "TLS_SM4_CCM_SM3", 0x00C6: "TLS_SM4_GCM_SM3"}[next(answers)]
        honest(self, *arguments)

    monkeypatch.setattr(tls13.TLS13, "send_answer", answer)
    refused(pair(client_context(versions=[TLS13]), server_context()), Alert.illegal_parameter)


def test_the_second_hello_is_the_first_one() -> None:
    without = first_hello()
    without = without._replace(extensions=without.extensions | {Extension.key_share: vector(2)})
    server = serve(without)
    assert server.data_to_send()
    changed = first_hello()._replace(random=bytes(32))
    record = Plain(TLS12_VERSION).seal(HANDSHAKE, pack_message(1, changed.pack(Kind.client_hello)))
    with pytest.raises(Exception, match="illegal_parameter"):
        server.receive_data(record)


# --- sessions ---


@VERSIONS
def test_a_session_ends_with_its_time_and_with_its_certificate(version: str, monkeypatch: pytest.MonkeyPatch) -> None:
    now = [NOW]
    client = client_context(versions=[version], now=lambda: now[0])
    server = server_context(now=lambda: now[0])
    [session] = sessions(connect(client, server))
    assert session.lifetime == 86400 and session.version == version
    assert repr(session.secret) not in repr(session) and repr(session.identity) not in repr(session)
    now[0] = NOW + timedelta(seconds=86399)
    assert completed(connect(client, server, session=session).client_events).resumed
    now[0] = NOW + timedelta(seconds=86400)
    assert not completed(connect(client, server, session=session).client_events).resumed
    now[0] = NOW - timedelta(seconds=1)
    assert not completed(connect(client, server, session=session).client_events).resumed
    now[0] = NOW
    assert not completed(connect(client, server, session=replace(session, version="other")).client_events).resumed

    server.sessions.clear()
    made = connect(client, server, session=session)
    assert not completed(made.client_events).resumed and sessions(made)

    monkeypatch.setattr(handshakes, "MAX_SESSIONS", 2)
    for _ in range(4):
        connect(client, server)
    assert len(server.sessions) == 2

    now[0] = SERVER.certificate.not_after - timedelta(seconds=100)
    assert sessions(connect(client, server))[0].lifetime == 100


@VERSIONS
def test_a_session_without_a_certificate_is_of_no_use_where_one_is_required(version: str) -> None:
    suites = {"suites": ["ECC_SM4_GCM_SM3", "TLS_SM4_GCM_SM3"]}
    server = server_context(**suites)
    client = client_context(versions=[version], certificate=True, **suites)
    [session] = sessions(connect(client, server))
    server.verify_client = "required"
    made = connect(client, server, session=session)
    assert not completed(made.server_events).resumed and completed(made.server_events).peer_certificates


def test_a_tlcp_session_goes_on_with_its_own_suite_only() -> None:
    server = server_context()
    client = client_context(versions=[TLCP], suites=["ECC_SM4_CBC_SM3"])
    [session] = sessions(connect(client, server))
    other = client_context(versions=[TLCP], suites=["ECC_SM4_GCM_SM3"])
    assert not completed(connect(other, server, session=session).client_events).resumed
    server.sessions[session.identity] = replace(session, suite="ECC_SM4_GCM_SM3")
    refused(pair(client_context(versions=[TLCP]), server, session=session), Alert.illegal_parameter)


def test_a_tlcp_server_may_issue_no_session(monkeypatch: pytest.MonkeyPatch) -> None:
    server = server_context()

    def nameless(body: bytes) -> list[tuple[int, bytes]]:
        hello = Hello.read(Message(Kind.server_hello, body))
        return [(Kind.server_hello, hello._replace(session_id=b"").pack(Kind.server_hello))]

    lie(monkeypatch, server, Kind.server_hello, nameless)
    made = connect(client_context(versions=[TLCP]), server)
    assert completed(made.client_events) and not sessions(made)


@pytest.mark.parametrize(
    ("change", "alert"),
    [
        (lambda x: dict(reversed(x.items())), Alert.illegal_parameter),
        (lambda x: {k: v for k, v in x.items() if k != Extension.psk_key_exchange_modes}, Alert.missing_extension),
        (lambda x: x | {Extension.pre_shared_key: x[Extension.pre_shared_key][:-1] + b"x"}, Alert.decrypt_error),
        (lambda x: x | {Extension.pre_shared_key: x[Extension.pre_shared_key][:-1]}, Alert.decode_error),
        (lambda x: x | {Extension.pre_shared_key: x[Extension.pre_shared_key] + b"x"}, Alert.decode_error),
    ],
)
def test_an_offer_of_a_session_that_is_wrong_is_refused(change: Any, alert: Alert) -> None:
    client, server = client_context(versions=[TLS13]), server_context()
    [session] = sessions(connect(client, server))
    sent = Connection(client, server_hostname=HOST, session=session).data_to_send()
    hello = Hello.read(Message(Kind.client_hello, sent[9:]))
    changed = hello._replace(extensions=change(hello.extensions)).pack(Kind.client_hello)
    made = Connection(server, server_side=True)
    with pytest.raises(Exception, match=alert.name):
        made.receive_data(Plain(TLS12_VERSION).seal(HANDSHAKE, pack_message(1, changed)))


def test_the_age_of_a_session_is_hidden() -> None:
    """RFC 8446, 4.2.11.1: its age in milliseconds plus ticket_age_add, modulo 2^32."""
    now = [NOW]
    client = client_context(versions=[TLS13], now=lambda: now[0])
    [session] = sessions(connect(client, server_context()))
    now[0] = NOW + timedelta(seconds=1)
    for age_add, hidden in ((0, 1000), (5, 1005), (0xFFFFFFFF, 999)):
        offer = replace(session, age_add=age_add)
        sent = Connection(client, server_hostname=HOST, session=offer).data_to_send()
        identity, age = vector(2, session.identity), pack(hidden, 4)
        psk = Hello.read(Message(Kind.client_hello, sent[9:])).extensions[Extension.pre_shared_key]
        assert psk[:-35] == vector(2, identity + age)


def test_a_session_is_passed_over_if_it_is_unknown_or_its_mode_is_not_offered() -> None:
    client, server = client_context(versions=[TLS13]), server_context()
    [session] = sessions(connect(client, server))
    sent = Connection(client, server_hostname=HOST, session=session).data_to_send()
    hello = Hello.read(Message(Kind.client_hello, sent[9:]))
    psk = hello.extensions[Extension.pre_shared_key]
    unknown = vector(2, vector(2, b"unknown") + bytes(4)) + psk[-35:]
    for change in ({Extension.pre_shared_key: unknown}, {Extension.psk_key_exchange_modes: b"\1\0"}):
        extensions = {k: change.get(k, v) for k, v in hello.extensions.items()}
        made = Connection(server, server_side=True)
        body = hello._replace(extensions=extensions).pack(Kind.client_hello)
        made.receive_data(Plain(TLS12_VERSION).seal(HANDSHAKE, pack_message(1, body)))
        assert made._handshake is not None and not made._handshake.resumed and made.data_to_send()


@pytest.mark.parametrize("modes", [None, b"\1\0"])
def test_a_client_that_cannot_resume_gets_no_ticket(modes: bytes | None, monkeypatch: pytest.MonkeyPatch) -> None:
    """RFC 8446, 4.2.9. GmSSL 3.1's clients, which offer no mode, give up when they see one."""
    client = client_context(versions=[TLS13])

    def without(body: bytes) -> list[tuple[int, bytes]]:
        hello = Hello.read(Message(Kind.client_hello, body))
        extensions = hello.extensions | {Extension.psk_key_exchange_modes: modes or b""}
        if modes is None:
            del extensions[Extension.psk_key_exchange_modes]
        return [(Kind.client_hello, hello._replace(extensions=extensions).pack(Kind.client_hello))]

    lie(monkeypatch, client, Kind.client_hello, without)
    made = connect(client, server_context())
    assert completed(made.client_events) and not sessions(made)


def test_a_server_that_resumes_another_session_than_the_one_offered_is_refused(monkeypatch: pytest.MonkeyPatch) -> None:
    client, server = client_context(versions=[TLS13]), server_context()
    [session] = sessions(connect(client, server))

    def second(body: bytes) -> list[tuple[int, bytes]]:
        hello = Hello.read(Message(Kind.server_hello, body))
        extensions = hello.extensions | {Extension.pre_shared_key: pack(1)}
        return [(Kind.server_hello, hello._replace(extensions=extensions).pack(Kind.server_hello))]

    lie(monkeypatch, server, Kind.server_hello, second)
    refused(pair(client, server, session=session), Alert.illegal_parameter)


# --- after the handshake ---


@pytest.mark.parametrize("suite", ["TLS_SM4_GCM_SM3", "TLS_SM4_CCM_SM3"])
def test_keys_are_replaced_before_they_have_served_too_long(suite: str, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(connections, "KEY_UPDATE_AFTER", 2)
    made = connect(client_context(versions=[TLS13], suites=[suite]), server_context())
    for i in range(7):
        made.client.send(b"%d" % i)
        made.server.send(b"%d" % i)
        made.run()
        assert made.client._records.writer.sequence <= 2 and made.server._records.writer.sequence <= 2
    for events in (made.client_events, made.server_events):
        assert [event.data for event in events if isinstance(event, DataReceived)] == [b"%d" % i for i in range(7)]


def test_a_key_update_that_asks_for_one_gets_one() -> None:
    made = connect(client_context(versions=[TLS13]), server_context())
    handshake = made.client._handshake
    assert isinstance(handshake, tls13.TLS13)
    made.client._records.write(HANDSHAKE, pack_message(Kind.key_update, b"\1"))
    handshake._write_with(schedule.updated(handshake._own))
    made.server.receive_data(made.client.data_to_send())
    made.server.send(b"text")
    assert len(made.server.data_to_send()) > 5 + 4 + 1 + 17 + 5 + 17  # KeyUpdate and the data


# --- what is refused before a byte is sent ---


def test_contexts_that_cannot_work_are_refused() -> None:
    other = {"key": CLIENT.key}
    for options, text in (
        ({"versions": ()}, "no version"),
        ({"versions": ("TLSv1.2",)}, "TLSv1.2"),
        ({"suites": ("TLS_AES_128_GCM_SHA256",)}, "there is no version or suite"),
        ({"suites": ("TLS_SM4_GCM_SM3",)}, "no suite of TLCPv1.1"),
        ({"verify_client": "yes"}, "verify_client"),
        ({"alpn": ("",)}, "protocols"),
        ({"alpn": ("é" * 128,)}, "protocols"),
        (other, "signing"),
        ({"certificates": (CLIENT.certificate,)}, "signing"),
        (other | {"certificates": (CLIENT_ENC.certificate,)}, "signing"),
        ({"encryption_key": CLIENT_ENC.key}, "encryption"),
        ({"encryption_key": CLIENT_ENC.key, "encryption_certificate": CLIENT_ENC.certificate}, "beside it"),
    ):
        with pytest.raises(InvalidOption, match=text):
            SMContext(**options)  # type: ignore[arg-type]
    assert repr(CLIENT.key.to_int()) not in repr(server_context())


def test_connections_that_cannot_work_are_refused() -> None:
    [session] = sessions(connect(client_context(versions=[TLS13]), server_context()))
    roots = {"roots": (ROOT.certificate,)}
    own = {"certificates": (SERVER.certificate,), "key": SERVER.key}
    both = own | {"encryption_certificate": SERVER_ENC.certificate, "encryption_key": SERVER_ENC.key}
    unchecked = SMContext(check_hostname=False, **roots)
    for made, options, text in (
        (SMContext(), {"server_hostname": HOST}, "roots"),
        (SMContext(**roots), {}, "server_hostname"),
        (SMContext(**roots), {"server_hostname": "sérver.example"}, "ASCII"),
        (SMContext(**roots), {"server_hostname": "a" * 256}, "ASCII"),
        (SMContext(**roots), {"server_hostname": "other.example", "session": session}, "session"),
        (unchecked, {"server_hostname": HOST, "session": session}, "session"),
        (SMContext(suites=("ECDHE_SM4_GCM_SM3",), versions=(TLCP,), **roots), {"server_hostname": HOST}, "ECDHE"),
        (SMContext(**roots), {"server_side": True}, "certificate and its key"),
        (SMContext(**own), {"server_side": True}, "encryption certificate"),
        (SMContext(verify_client="required", **both), {"server_side": True}, "roots"),
        (SMContext(**both), {"server_side": True, "server_hostname": HOST}, "client's"),
        (SMContext(**both), {"server_side": True, "session": session}, "client's"),
    ):
        with pytest.raises(InvalidOption, match=text):
            Connection(made, **options)  # type: ignore[arg-type]


@VERSIONS
def test_data_are_sent_between_the_handshake_and_close(version: str) -> None:
    made = pair(client_context(versions=[version]), server_context())
    for early in (made.client, made.server):
        with pytest.raises(OutOfOrder):
            early.send(b"too early")
    assert made.server.server_hostname is None
    made.run()
    made.client.send(b"")
    assert made.client.data_to_send() == b""
    made.client.send(memoryview(b"text"))
    made.client.close()
    made.client.close()
    with pytest.raises(OutOfOrder):
        made.client.send(b"too late")
    made.server.send(b"the other direction is open")
    made.run()
    assert made.client_events[-1] == DataReceived(b"the other direction is open")
    with pytest.raises(TypeError):
        made.client.receive_data("text")  # type: ignore[arg-type]


def test_the_default_clock_and_random_source_work() -> None:
    hellos = {Connection(SMContext(roots=(CA.certificate,)), server_hostname=HOST).data_to_send() for _ in range(2)}
    assert len(hellos) == 2
    assert SMContext().now().tzinfo is not None
