"""Every suite in both roles with Tongsuo, over memory."""

from __future__ import annotations

import pytest

import tongsuo
from conftest import unavailable
from smcrypto.tls import (
    SUITES,
    Alert,
    Connection,
    ConnectionClosed,
    DataReceived,
    Event,
    HandshakeCompleted,
    Session,
    SessionIssued,
    TLSError,
)
from tls_authority import HOST, TLCP, TLS13, Authority

pytestmark = pytest.mark.service


@pytest.fixture(scope="module")
def authority() -> Authority:
    if tongsuo.library() is None:
        unavailable("the package 'tongsuopy' is not installed")
    return Authority.make()


def exchange(ours: Connection, theirs: tongsuo.Peer) -> list[Event]:
    """Carry bytes to and fro until both have nothing more to say; our events."""
    events: list[Event] = []
    while True:
        theirs.receive(out := ours.data_to_send())
        theirs.handshake()
        back = theirs.to_send()
        if back:
            events += ours.receive_data(back)
        if not out and not back:
            return events


def say(ours: Connection, theirs: tongsuo.Peer, data: bytes) -> None:
    """`data` to Tongsuo and back."""
    ours.send(data)
    theirs.receive(ours.data_to_send())
    assert theirs.read() == data
    theirs.write(data)
    assert received(ours.receive_data(theirs.to_send())) == data


def received(events: list[Event]) -> bytes:
    return b"".join(event.data for event in events if isinstance(event, DataReceived))


def completed(events: list[Event]) -> HandshakeCompleted:
    [event] = [event for event in events if isinstance(event, HandshakeCompleted)]
    return event


def connect(
    authority: Authority, suite: str, role: str, *, authenticated: bool, ours_session: Session | None = None,
    theirs_session: tongsuo.Session | None = None, contexts: tuple | None = None, **theirs: object,
) -> tuple[Connection, tongsuo.Peer, list[Event], tuple]:  # fmt: skip
    """One connection in our `role`; contexts of an earlier one can be used again."""
    if contexts is None:
        client = authority.client if authenticated else None
        if role == "client":
            contexts = (
                authority.context(suite, client, alpn=("h2", "http/1.1")),
                tongsuo.Context(suite, True, authority.server, authority.roots if authenticated else (),
                                alpn=("http/1.1",), **theirs),
            )  # fmt: skip
        else:
            contexts = (
                authority.context(suite, authority.server, verify_client="required" if authenticated else "none",
                                  alpn=("http/1.1",)),
                tongsuo.Context(suite, False, client, authority.roots, alpn=("h2", "http/1.1"), **theirs),
            )  # fmt: skip
    if role == "client":
        ours = Connection(contexts[0], server_hostname=HOST, session=ours_session)
        peer = tongsuo.Peer(contexts[1])
    else:
        ours = Connection(contexts[0], server_side=True)
        peer = tongsuo.Peer(contexts[1], server_name=HOST, session=theirs_session)
    return ours, peer, exchange(ours, peer), contexts


CASES = [(suite, authenticated) for suite in SUITES for authenticated in (False, True)
         if authenticated or not suite.startswith("ECDHE")]  # fmt: skip


@pytest.mark.parametrize("role", ["client", "server"])
@pytest.mark.parametrize(("suite", "authenticated"), CASES)
def test_every_suite_in_both_roles(authority: Authority, suite: str, role: str, authenticated: bool) -> None:
    ours, peer, events, _ = connect(authority, suite, role, authenticated=authenticated)
    done = completed(events)
    assert (done.version, done.suite, done.alpn, done.resumed) == (SUITES[suite][1], suite, "http/1.1", False)
    assert (peer.suite, peer.alpn, peer.resumed) == (suite, "http/1.1", False)
    expected = authority.server if role == "client" else authority.client if authenticated else None
    assert done.peer_certificates[:1] == ((expected.certificate,) if expected else ())
    assert (peer.server_name if role == "client" else ours.server_hostname) == HOST
    say(ours, peer, b"short")
    say(ours, peer, bytes(range(256)) * 300)  # several records
    ours.close()
    peer.receive(ours.data_to_send())
    with pytest.raises(EOFError):
        peer.read()
    peer.close()
    assert ours.receive_data(peer.to_send()) == [ConnectionClosed()]


@pytest.mark.parametrize("role", ["client", "server"])
@pytest.mark.parametrize(("suite", "authenticated"), CASES)
def test_sessions_are_resumed(authority: Authority, suite: str, role: str, authenticated: bool) -> None:
    ours, peer, events, contexts = connect(authority, suite, role, authenticated=authenticated)
    say(ours, peer, b"first")
    issued = [event.session for event in events if isinstance(event, SessionIssued)]
    ours, peer, events, _ = connect(
        authority, suite, role, authenticated=authenticated, contexts=contexts,
        ours_session=issued[-1] if role == "client" else None,
        theirs_session=peer.session if role == "server" else None,
    )  # fmt: skip
    assert completed(events).resumed and peer.resumed
    expected = authority.server if role == "client" else authority.client if authenticated else None
    assert completed(events).peer_certificates[:1] == ((expected.certificate,) if expected else ())
    say(ours, peer, b"second")


@pytest.mark.parametrize("suite", TLS13)
def test_a_client_without_a_share_of_our_group_is_asked_again(authority: Authority, suite: str) -> None:
    """HelloRetryRequest, RFC 8446, 4.1.4. Our client has one group, and no server has to ask it again."""
    peer = tongsuo.Peer(tongsuo.Context(suite, False, None, authority.roots, groups="P-256:SM2", strict=False))
    ours = Connection(authority.context(suite, authority.server), server_side=True)
    events = exchange(ours, peer)
    assert completed(events).suite == suite
    say(ours, peer, b"after the second hello")


@pytest.mark.parametrize("requested", [False, True])
@pytest.mark.parametrize("role", ["client", "server"])
def test_keys_are_updated(authority: Authority, role: str, requested: bool) -> None:
    ours, peer, _, _ = connect(authority, "TLS_SM4_GCM_SM3", role, authenticated=False)
    peer.key_update(requested=requested)
    peer.write(b"with new keys")
    assert received(ours.receive_data(peer.to_send())) == b"with new keys"
    say(ours, peer, b"in both directions")


@pytest.mark.parametrize("suite", [TLCP[-1], TLS13[0]])
def test_a_client_that_refuses_our_certificate(authority: Authority, suite: str) -> None:
    ours = Connection(authority.context(suite, authority.server), server_side=True)
    theirs = tongsuo.Peer(tongsuo.Context(suite, False, None, Authority.make().roots), server_name=HOST)
    theirs.handshake()
    ours.receive_data(theirs.to_send())
    theirs.receive(ours.data_to_send())
    with pytest.raises(tongsuo.TongsuoError, match="certificate verify failed"):
        theirs.handshake()
    with pytest.raises(TLSError) as failure:
        ours.receive_data(theirs.to_send())
    assert failure.value.alert == Alert.unknown_ca


@pytest.mark.parametrize("suite", [TLCP[-1], TLS13[0]])
def test_a_server_that_we_do_not_trust(authority: Authority, suite: str) -> None:
    stranger = Authority.make()
    theirs = tongsuo.Peer(tongsuo.Context(suite, True, stranger.server))
    ours = Connection(authority.context(suite), server_hostname=HOST)
    with pytest.raises(TLSError) as failure:
        exchange(ours, theirs)
    assert failure.value.alert in (Alert.unknown_ca, Alert.bad_certificate)
    theirs.receive(ours.data_to_send())
    with pytest.raises(tongsuo.TongsuoError, match=r"alert (unknown ca|bad certificate)"):
        theirs.handshake()
