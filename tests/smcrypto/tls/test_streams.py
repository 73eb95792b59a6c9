"""Streams that are cut, glued, flooded or interrupted; alerts; and what a stranger between the two can do."""

from __future__ import annotations

import random
from collections.abc import Callable
from typing import Any

import pytest

from smcrypto.tls import Alert, Connection, ConnectionClosed, DataReceived, TLSError
from smcrypto.tls.messages import MAX_MESSAGE, Kind, pack_message, vector
from smcrypto.tls.record import ALERT, APPLICATION_DATA, CHANGE_CIPHER_SPEC, HANDSHAKE, Plain
from tls_peers import Pair, client_context, connect, pair, refused, server_context

TLCP, TLS13 = "TLCPv1.1", "TLSv1.3"
VERSIONS = pytest.mark.parametrize("version", [TLCP, TLS13])
SUITES = pytest.mark.parametrize("suite", ["ECC_SM4_GCM_SM3", "ECC_SM4_CBC_SM3", "TLS_SM4_GCM_SM3", "TLS_SM4_CCM_SM3"])
PLAIN = {TLCP: Plain(0x0101), TLS13: Plain(0x0303)}


def contexts(version: str, **options: Any) -> tuple[Any, Any]:
    return client_context(versions=[version], **options), server_context(versions=[version])


def suite_contexts(suite: str) -> tuple[Any, Any]:
    version = TLS13 if suite.startswith("TLS_") else TLCP
    return client_context(versions=[version], suites=[suite]), server_context(versions=[version], suites=[suite])


def refusal(connection: Connection, data: bytes, alert: Alert) -> str:
    with pytest.raises(TLSError) as caught:
        connection.receive_data(data)
    assert caught.value.alert == alert, caught.value
    return str(caught.value)


# --- the end ---


@VERSIONS
def test_an_end_without_close_notify_is_an_error_at_any_time(version: str) -> None:
    flights = 0
    made = pair(*contexts(version))
    while True:
        for receiver, sender in ((made.server, made.client), (made.client, made.server)):
            data = sender.data_to_send()
            if not data:
                break
            receiver.receive_data(data)
            flights += 1
        else:
            continue
        break
    assert flights >= 3
    made.client.send(b"text")
    cut = made.client.data_to_send()[:-1]
    assert made.server.receive_data(cut) == []
    assert "close_notify" in refusal(made.server, b"", Alert.close_notify)
    assert made.server.data_to_send() == b""
    fresh = Connection(server_context(), server_side=True)
    refusal(fresh, b"", Alert.close_notify)


@VERSIONS
def test_after_close_notify_everything_is_ignored(version: str) -> None:
    made = connect(*contexts(version))
    made.client.send(b"last")
    made.client.close()
    assert made.server.receive_data(made.client.data_to_send() + b"anything") == [
        DataReceived(b"last"), ConnectionClosed(),
    ]  # fmt: skip
    assert made.server.receive_data(b"anything") == made.server.receive_data(b"") == []
    made.server.send(b"still open")
    made.server.close()
    assert made.client.receive_data(made.server.data_to_send()) == [DataReceived(b"still open"), ConnectionClosed()]


def test_close_during_the_handshake() -> None:
    made = pair(*contexts(TLCP))
    made.client.close()
    made.run()
    assert made.server_events == [ConnectionClosed()] and not made.client_events
    made = pair(*contexts(TLS13))
    made.client.close()  # not protected, after a hello that made the server change its keys: may be a stranger's
    refused(made, Alert.unexpected_message)


# --- alerts ---


@VERSIONS
def test_what_the_peer_gave_up_for_is_told_and_not_answered(version: str) -> None:
    made = connect(*contexts(version))
    made.server._alert(2, Alert.access_denied)
    assert "49" in refusal(made.client, made.server.data_to_send(), Alert.access_denied)
    assert made.client.data_to_send() == b""
    made = connect(*contexts(version))
    made.server._records.write(ALERT, b"\2\xee")
    assert "238" in refusal(made.client, made.server.data_to_send(), Alert.internal_error)


@VERSIONS
@pytest.mark.parametrize("body", [b"\1", b"\1\0\0"])
def test_an_alert_has_two_bytes(version: str, body: bytes) -> None:
    made = connect(*contexts(version))
    made.server._records.write(ALERT, body)
    refusal(made.client, made.server.data_to_send(), Alert.decode_error)


def test_warnings_are_passed_over_in_tlcp_and_mostly_fatal_in_tls_13() -> None:
    for version, alert, fatal in (
        (TLCP, Alert.no_renegotiation, False), (TLS13, Alert.no_renegotiation, True),
        (TLCP, Alert.user_canceled, False), (TLS13, Alert.user_canceled, False),
    ):  # fmt: skip
        made = connect(*contexts(version))
        made.server._records.write(ALERT, bytes([1, alert]))
        sent = made.server.data_to_send()
        if fatal:
            refusal(made.client, sent, alert)
        else:
            assert made.client.receive_data(sent) == []


def test_a_client_may_refuse_before_it_has_keys_but_nobody_can_close_for_it() -> None:
    """OpenSSL's clients do: the alert is not protected although the server has changed its keys."""
    for body, alert in (
        (b"\2\x30", Alert.unknown_ca), (b"\1\0", Alert.unexpected_message), (b"\2\x5a", Alert.unexpected_message),
        (b"\2", Alert.unexpected_message),
    ):  # fmt: skip
        made = pair(*contexts(TLS13))
        made.server.receive_data(made.client.data_to_send())
        refusal(made.server, PLAIN[TLS13].seal(ALERT, body), alert)
    made = connect(*contexts(TLS13))
    made.client.send(b"text")
    made.run()
    refusal(made.server, PLAIN[TLS13].seal(ALERT, b"\2\x30"), Alert.unexpected_message)


# --- records at the wrong time ---


@VERSIONS
def test_data_before_the_end_of_the_handshake(version: str) -> None:
    made = pair(*contexts(version))
    refusal(made.server, PLAIN[version].seal(APPLICATION_DATA, b"early"), Alert.unexpected_message)
    made = pair(*contexts(version))
    made.server.receive_data(made.client.data_to_send())
    sent = made.server.data_to_send()
    end = 5 + int.from_bytes(sent[3:5], "big")
    early = PLAIN[version].seal(APPLICATION_DATA, b"early" * 9)
    refusal(made.client, sent[:end] + early, Alert.bad_record_mac if version == TLS13 else Alert.unexpected_message)


@VERSIONS
def test_a_handshake_message_is_not_interrupted(version: str) -> None:
    made = connect(*contexts(version))
    made.server._records.write(HANDSHAKE, b"\x18\0")
    made.server.send(b"text")
    refusal(made.client, made.server.data_to_send(), Alert.unexpected_message)


def test_keys_do_not_change_within_a_record() -> None:
    made = pair(*contexts(TLS13))
    made.server.receive_data(made.client.data_to_send())
    sent = made.server.data_to_send()
    length = int.from_bytes(sent[3:5], "big")
    joined = PLAIN[TLS13].seal(HANDSHAKE, sent[5 : 5 + length] + pack_message(Kind.encrypted_extensions, b"\0\0"))
    assert "keys change" in refusal(made.client, joined, Alert.unexpected_message)


@VERSIONS
def test_no_renegotiation(version: str) -> None:
    for from_server, kind in ((True, 0), (False, Kind.client_hello)):
        made = connect(*contexts(version))
        sender, receiver = (made.server, made.client) if from_server else (made.client, made.server)
        sender._records.write(HANDSHAKE, pack_message(kind))
        refusal(receiver, sender.data_to_send(), Alert.unexpected_message)


def test_change_cipher_spec_is_passed_over_in_the_handshake_of_tls_13_only() -> None:
    dummy = PLAIN[TLS13].seal(CHANGE_CIPHER_SPEC, b"\1")
    made = pair(*contexts(TLS13))
    made.server.receive_data(made.client.data_to_send() + dummy)
    made.client_events += made.client.receive_data(dummy + made.server.data_to_send())
    made.run()
    made.client.send(b"text")
    made.run()
    assert made.server_events[-1] == DataReceived(b"text")
    refusal(made.server, dummy, Alert.unexpected_message)
    refusal(Connection(server_context(), server_side=True), dummy, Alert.unexpected_message)
    made = pair(*contexts(TLS13))
    refusal(made.client, PLAIN[TLS13].seal(CHANGE_CIPHER_SPEC, b"\2"), Alert.unexpected_message)


def test_tlcp_needs_change_cipher_spec_before_finished() -> None:
    made = pair(*contexts(TLCP))
    made.server.receive_data(made.client.data_to_send())
    made.client.receive_data(made.server.data_to_send())
    sent = made.client.data_to_send()
    changed = sent.index(PLAIN[TLCP].seal(CHANGE_CIPHER_SPEC, b"\1"))
    refusal(made.server, sent[:changed] + sent[changed + 6 :], Alert.unexpected_message)


# --- floods and sizes ---


@VERSIONS
@pytest.mark.parametrize("kind", [HANDSHAKE, APPLICATION_DATA, ALERT, CHANGE_CIPHER_SPEC])
def test_empty_records(version: str, kind: int) -> None:
    made = connect(*contexts(version))
    for _ in range(200):
        made.server._records.outgoing += made.server._records.writer.seal(kind, b"")
    with pytest.raises(TLSError):
        made.client.receive_data(made.server.data_to_send())


@VERSIONS
def test_an_endless_handshake_of_empty_records(version: str) -> None:
    made = pair(*contexts(version))
    assert "lead no further" in refusal(
        made.server, PLAIN[version].seal(HANDSHAKE, b"") * 100, Alert.unexpected_message
    )


def test_endless_key_updates_tickets_and_warnings() -> None:
    floods: list[tuple[str, Callable[[Any], None]]] = [
        (TLS13, lambda server: server._handshake.update_keys()),
        (TLS13, lambda server: server._handshake._issue()),
        (TLS13, lambda server: server._records.write(ALERT, b"\1\x5a")),
        (TLCP, lambda server: server._records.write(ALERT, b"\1\x64")),
    ]
    for version, flood in floods:
        made = connect(*contexts(version))
        for _ in range(1000):
            flood(made.server)
        assert "lead no further" in refusal(made.client, made.server.data_to_send(), Alert.unexpected_message)
        made = connect(*contexts(version))
        for i in range(100):  # data between them
            flood(made.server)
            made.server.send(b"%d" % i)
        made.run()
        assert made.client_events[-1] == DataReceived(b"99")


@VERSIONS
def test_a_message_that_is_too_long_is_refused_by_its_header(version: str) -> None:
    assert MAX_MESSAGE == 131072
    made = pair(*contexts(version))
    header = b"\1" + (MAX_MESSAGE + 1).to_bytes(3, "big")
    refusal(made.server, PLAIN[version].seal(HANDSHAKE, header), Alert.illegal_parameter)
    made = pair(*contexts(version))
    made.server.receive_data(PLAIN[version].seal(HANDSHAKE, b"\1" + MAX_MESSAGE.to_bytes(3, "big")))
    for _ in range(MAX_MESSAGE // 16384):
        part = PLAIN[version].seal(HANDSHAKE, bytes(16384))
        if len(made.server._records.message) + 16384 <= MAX_MESSAGE:
            made.server.receive_data(part)
    assert len(made.server._records.message) <= MAX_MESSAGE + 4 and not made.server._records.incoming


def test_what_is_held_of_an_unfinished_record_is_bounded() -> None:
    made = connect(*contexts(TLS13))
    made.server.send(bytes(16384))
    sent = made.server.data_to_send()
    made.client.receive_data(sent[:-1])
    assert len(made.client._records.incoming) == len(sent) - 1 <= 5 + 16384 + 256
    assert made.client.receive_data(sent[-1:]) == [DataReceived(bytes(16384))]


@VERSIONS
@pytest.mark.parametrize("body", [{"lifetime": 604801}, {"ticket": b""}, {"more": b"x"}])
def test_wrong_tickets(version: str, body: dict[str, Any]) -> None:
    made = connect(*contexts(version))
    ticket = vector(1, b"nonce") + vector(2, body.get("ticket", b"t")) + vector(2) + body.get("more", b"")
    times = body.get("lifetime", 1).to_bytes(4, "big") + bytes(4)
    made.server._records.write(HANDSHAKE, pack_message(4, times + ticket))
    alert = Alert.illegal_parameter if "lifetime" in body else Alert.decode_error
    refusal(made.client, made.server.data_to_send(), alert if version == TLS13 else Alert.unexpected_message)


@pytest.mark.parametrize("body", [b"", b"\2", b"\0\0"])
def test_wrong_key_updates(body: bytes) -> None:
    made = connect(*contexts(TLS13))
    made.server._records.write(HANDSHAKE, pack_message(Kind.key_update, body))
    refusal(made.client, made.server.data_to_send(), Alert.illegal_parameter)


# --- a stranger between the two ---


@SUITES
def test_data_that_are_changed_replayed_reordered_or_left_out(suite: str) -> None:
    def records(*texts: bytes) -> tuple[Pair, list[bytes]]:
        made, sent = connect(*suite_contexts(suite)), []
        for text in texts:
            made.client.send(text)
            sent.append(made.client.data_to_send())
        return made, sent

    made, [first, second] = records(b"first", b"second")
    refusal(made.server, second, Alert.bad_record_mac)
    made, [first, second] = records(b"first", b"second")
    made.server.receive_data(first)
    refusal(made.server, first, Alert.bad_record_mac)
    made, [first] = records(b"first")
    refusal(made.server, first[:-1] + bytes([first[-1] ^ 1]), Alert.bad_record_mac)
    made, [first] = records(b"first")
    refusal(made.client, first, Alert.bad_record_mac)  # reflected


@VERSIONS
def test_a_downgrade_of_the_suites_is_noticed_at_the_first_protected_message(version: str) -> None:
    """A stranger takes the better suite out of the client's hello; each side then has seen another one."""
    better, worse = (b"\xe0\x53", b"\xe0\x13") if version == TLCP else (b"\0\xc6", b"\0\xc7")
    made = pair(client_context(versions=[version]), server_context())
    hello = made.client.data_to_send()
    assert hello.count(better + worse) == 1
    made.server.receive_data(hello.replace(better + worse, worse + worse))
    refused(made, Alert.bad_record_mac if version == TLS13 else Alert.decrypt_error)


def test_a_downgrade_of_the_version_is_refused() -> None:
    """Nothing that a stranger makes of a hello of TLS 1.3 is one of TLCP that the client goes on with."""
    made = pair(client_context(versions=[TLS13]), server_context())
    hello = made.client.data_to_send()
    made.server._records.incoming.clear()
    changed = hello[:1] + b"\1\1" + hello[3:9] + b"\1\1" + hello[11:]
    with pytest.raises(TLSError):
        made.server.receive_data(changed)


@pytest.mark.no_cover
@pytest.mark.parametrize("suite", ["ECC_SM4_CBC_SM3", "ECDHE_SM4_GCM_SM3", "TLS_SM4_GCM_SM3", "TLS_SM4_CCM_SM3"])
def test_mutated_flights(suite: str) -> None:
    """Four times five hundred; fuzz/tls_flights.py makes as many as one likes."""
    from tls_mutation import mutated_handshake

    for seed in range(500):
        mutated_handshake(suite, random.Random(f"{suite} {seed}"))
