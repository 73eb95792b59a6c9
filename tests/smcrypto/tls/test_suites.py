"""Every suite, this library's client against its server: GB/T 38636-2020, RFC 8446, RFC 8998."""

from __future__ import annotations

import pytest

from smcrypto.tls import SUITES, ConnectionClosed, DataReceived, Session, SessionIssued
from tls_peers import (
    CA,
    CLIENT,
    CLIENT_ENC,
    HOST,
    SERVER,
    SERVER_ENC,
    Pair,
    client_context,
    completed,
    connect,
    server_context,
)
from x509_authority import certificates

CASES = [(suite, authenticated) for suite in SUITES for authenticated in (False, True)]
CASES.remove(("ECDHE_SM4_GCM_SM3", False))
CASES.remove(("ECDHE_SM4_CBC_SM3", False))


def session_of(pair: Pair) -> Session:
    [session] = [event.session for event in pair.client_events if isinstance(event, SessionIssued)]
    return session


@pytest.mark.parametrize(("suite", "authenticated"), CASES)
def test_data_go_both_ways_and_a_second_connection_resumes(suite: str, authenticated: bool) -> None:
    version = SUITES[suite][1]
    client = client_context(versions=[version], suites=[suite], certificate=authenticated)
    server = server_context(verify_client="required" if authenticated else "none")
    tlcp = version == "TLCPv1.1"
    servers = certificates(SERVER, SERVER_ENC, CA) if tlcp else certificates(SERVER, CA)
    clients = (certificates(CLIENT, CLIENT_ENC) if tlcp else certificates(CLIENT)) if authenticated else []
    session = None
    for resumed in (False, True):
        pair = connect(client, server, session=session)
        for events, peer in ((pair.client_events, servers), (pair.server_events, clients)):
            event = completed(events)
            assert (event.version, event.suite, event.alpn, event.resumed) == (version, suite, None, resumed)
            assert event.peer_certificates == tuple(peer)
        assert pair.server.server_hostname == HOST
        session = session or session_of(pair)
        pair.client.send(b"request" * 5000)
        pair.server.send(b"answer")
        pair.run()
        arrived = b"".join(event.data for event in pair.server_events if isinstance(event, DataReceived))
        assert arrived == b"request" * 5000
        assert pair.client_events[-1] == DataReceived(b"answer")
        pair.client.close()
        pair.server.close()
        pair.run()
        assert pair.client_events[-1] == pair.server_events[-1] == ConnectionClosed()
