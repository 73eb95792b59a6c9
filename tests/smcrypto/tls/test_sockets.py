"""`SMContext.wrap_socket` over real sockets: with Tongsuo, with itself, and in the manner of `ssl.SSLSocket`."""

from __future__ import annotations

import contextlib
import select
import socket
import ssl
import threading
from collections.abc import Callable, Iterator
from concurrent.futures import Future, ThreadPoolExecutor
from typing import Any

import pytest

import tongsuo
from conftest import unavailable
from smcrypto.errors import InvalidOption, OutOfOrder
from smcrypto.tls import SUITES, TLSError
from smcrypto.tls.sockets import SMSocket
from tls_authority import HOST, Authority

SUITE = "TLS_SM4_GCM_SM3"
TIMEOUT = 20.0  # seconds; only a failure waits for so long


@pytest.fixture(scope="module")
def authority() -> Authority:
    return Authority.make()


@pytest.fixture
def beside() -> Iterator[Callable[..., Future[Any]]]:
    """Run a function in a thread."""
    with ThreadPoolExecutor() as pool:
        yield pool.submit


def plain_pair() -> tuple[socket.socket, socket.socket]:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        near = socket.create_connection(listener.getsockname(), timeout=TIMEOUT)
        far, _ = listener.accept()
    far.settimeout(TIMEOUT)
    return near, far


def pair(authority: Authority, suite: str = SUITE, **server: Any) -> tuple[SMSocket, SMSocket]:
    """A client and a server, both ours, after the handshake."""
    near, far = plain_pair()
    serving = authority.context(suite, authority.server, **server)
    with ThreadPoolExecutor() as pool:
        accepted = pool.submit(serving.wrap_socket, far, server_side=True)
        client = authority.context(suite, authority.client).wrap_socket(near, server_hostname=HOST)
        return client, accepted.result()


def serve_tongsuo(context: tongsuo.Context, plain: socket.socket) -> str:
    """Send back what comes until close_notify; the suite."""
    peer = tongsuo.Peer(context)
    with plain:
        peer.handshake_over(plain)
        with contextlib.suppress(EOFError):
            while True:
                if data := peer.read():
                    peer.write(data)
                    plain.sendall(peer.to_send())
                received = plain.recv(1 << 16)
                assert received
                peer.receive(received)
        peer.close()
        plain.sendall(peer.to_send())
    return peer.suite


@pytest.mark.service
@pytest.mark.parametrize("suite", SUITES)
def test_a_socket_to_tongsuo(authority: Authority, suite: str, beside: Callable[..., Future[Any]]) -> None:
    if tongsuo.library() is None:
        unavailable("the package 'tongsuopy' is not installed")
    near, far = plain_pair()
    theirs = beside(serve_tongsuo, tongsuo.Context(suite, True, authority.server, authority.roots), far)
    with authority.context(suite, authority.client).wrap_socket(near, server_hostname=HOST) as client:
        assert near.fileno() == -1
        assert client.cipher() == (suite, SUITES[suite][1], 128)
        data = bytes(range(256)) * 256
        client.sendall(data)
        with client.makefile("rb") as file:
            assert file.read(len(data)) == data
        assert isinstance(client.unwrap(), socket.socket)
    assert theirs.result(TIMEOUT) == suite


def test_what_was_agreed_on(authority: Authority) -> None:
    client, server = pair(authority, alpn=("http/1.1",), verify_client="required")
    with client, server:
        assert client.version() == server.version() == "TLSv1.3"
        assert client.selected_alpn_protocol() is None
        assert client.getpeercert() == authority.server.certificate
        assert server.getpeercert(binary_form=True) == authority.client.certificate.to_der()
        assert server.session_reused is False
        client.do_handshake()  # is done already
        server.sendall(b"x")  # the tickets come before it
        assert client.recv(1) == b"x"
        session = client.session
        assert session is not None
        near, far = plain_pair()
        resuming = threading.Thread(target=lambda: server.context.wrap_socket(far, server_side=True).close())
        resuming.start()
        with client.context.wrap_socket(near, server_hostname=HOST, session=session) as again:
            assert again.session_reused
        resuming.join(TIMEOUT)


def test_a_client_without_a_certificate_has_none(authority: Authority) -> None:
    near, far = plain_pair()
    with far, near:
        server = authority.context(SUITE, authority.server).wrap_socket(
            far, server_side=True, do_handshake_on_connect=False
        )
        assert (server.cipher(), server.version(), server.selected_alpn_protocol()) == (None, None, None)
        assert (server.session_reused, server.getpeercert(), server.peer_certificates) == (None, None, ())
        server.close()


def test_reading(authority: Authority) -> None:
    client, server = pair(authority)
    with client, server:
        server.sendall(b"0123456789")
        assert client.recv(0) == b""
        assert client.recv(3) == b"012"
        assert client.pending() == 7
        assert client.recv_into(buffer := bytearray(5)) == 5
        assert buffer == b"34567"
        assert client.recv_into(memoryview(buffer), 1) == 1
        assert buffer == b"84567"
        server.close()
        assert client.recv() == b"9"
        assert client.recv(10) == b""
        with pytest.raises(ValueError, match="negative"):
            client.recv(-1)
        with pytest.raises(ValueError, match="flags"):
            client.recv(1, socket.MSG_PEEK)


def test_either_call_makes_the_handshake(authority: Authority, beside: Callable[..., Future[Any]]) -> None:
    near, far = plain_pair()
    server = authority.context(SUITE, authority.server).wrap_socket(
        far, server_side=True, do_handshake_on_connect=False
    )
    client = authority.context(SUITE).wrap_socket(near, do_handshake_on_connect=False, server_hostname=HOST)
    with client, server:
        received = beside(server.recv, 10)
        client.sendall(bytearray(b"first"))
        assert received.result(TIMEOUT) == b"first"


def test_a_stream_that_is_cut_is_an_error(authority: Authority) -> None:
    client, server = pair(authority)
    with client:
        server.sendall(b"all but the end")
        socket.socket(fileno=server.detach()).close()
        assert client.recv(100) == b"all but the end"
        with pytest.raises(TLSError, match="close_notify"):
            client.recv(100)


def test_shutdown_says_that_no_data_follow(authority: Authority) -> None:
    client, server = pair(authority)
    with client, server:
        client.shutdown(socket.SHUT_WR)
        assert server.recv(1) == b""
        server.sendall(b"still open")
        assert client.recv(100) == b"still open"
        with pytest.raises(OutOfOrder):
            client.send(b"no more")
        server.shutdown(socket.SHUT_RD)  # says nothing


@pytest.mark.parametrize(
    "name", ["sendto", "sendmsg", "sendfile", "recvfrom", "recvfrom_into", "recvmsg", "recvmsg_into", "dup"]
)
def test_nothing_goes_past_the_protection(authority: Authority, name: str) -> None:
    near, far = plain_pair()
    client = authority.context(SUITE).wrap_socket(near, do_handshake_on_connect=False, server_hostname=HOST)
    with client, far, pytest.raises(ValueError, match="protection"):
        getattr(client, name)(b"in clear")


def test_without_blocking(authority: Authority) -> None:
    near, far = plain_pair()
    near.setblocking(False)
    far.setblocking(False)
    server = authority.context(SUITE, authority.server).wrap_socket(
        far, server_side=True, do_handshake_on_connect=False
    )
    client = authority.context(SUITE).wrap_socket(near, do_handshake_on_connect=False, server_hostname=HOST)
    with client, server:
        waiting = {client, server}
        while waiting:
            for side in list(waiting):
                try:
                    side.do_handshake()
                    waiting.remove(side)
                except ssl.SSLWantReadError:
                    pass
        with pytest.raises(ssl.SSLWantReadError):
            server.recv(1)
        data, sent, received = bytes(range(256)) * (1 << 16), 0, bytearray()  # 16 MiB: more than the kernel takes
        refused = 0
        while len(received) < len(data):
            if sent < len(data):
                try:
                    sent += client.send(data[sent : sent + 100_000])
                    continue
                except ssl.SSLWantWriteError:
                    refused += 1
            select.select([server], [], [], TIMEOUT)
            with contextlib.suppress(ssl.SSLWantReadError):
                while len(received) < sent + (1 << 14):
                    received += server.recv(1 << 16)
        assert refused
        assert received == data


def test_a_listening_socket_accepts(authority: Authority, beside: Callable[..., Future[Any]]) -> None:
    plain = socket.create_server(("127.0.0.1", 0))
    with authority.context(SUITE, authority.server).wrap_socket(plain, server_side=True) as listener:
        accepted = beside(listener.accept)
        with authority.context(SUITE).wrap_socket(socket.socket(), server_hostname=HOST) as client:
            client.settimeout(TIMEOUT)
            client.connect(listener.getsockname())
            server, address = accepted.result(TIMEOUT)
            assert address == client.getsockname()
            with server:
                client.sendall(b"hello")
                assert server.recv(5) == b"hello"


def test_a_listening_socket_goes_on_after_a_stranger(authority: Authority, beside: Callable[..., Future[Any]]) -> None:
    plain = socket.create_server(("127.0.0.1", 0))
    with authority.context(SUITE, authority.server).wrap_socket(plain, server_side=True) as listener:
        accepted = beside(listener.accept)
        with socket.create_connection(listener.getsockname(), timeout=TIMEOUT) as stranger:
            stranger.sendall(b"GET / HTTP/1.1\r\n\r\n")
            with pytest.raises(ssl.SSLError) as failure:  # an OSError
                accepted.result(TIMEOUT)
        assert isinstance(failure.value.__cause__, TLSError)
        accepted = beside(listener.accept)
        near = socket.create_connection(listener.getsockname(), timeout=TIMEOUT)
        with authority.context(SUITE).wrap_socket(near, server_hostname=HOST), accepted.result(TIMEOUT)[0]:
            pass


def test_connect_may_leave_the_handshake_for_later(authority: Authority) -> None:
    with socket.create_server(("127.0.0.1", 0)) as listener:
        wrap = authority.context(SUITE).wrap_socket
        with wrap(socket.socket(), do_handshake_on_connect=False, server_hostname=HOST) as client:
            client.connect(listener.getsockname())
            assert client.version() is None


def test_a_handshake_that_fails_closes_and_tells_the_peer(
    authority: Authority, beside: Callable[..., Future[Any]]
) -> None:
    near, far = plain_pair()
    server = beside(authority.context(SUITE, authority.server).wrap_socket, far, server_side=True)
    with pytest.raises(TLSError, match="issuer"):
        Authority.make().context(SUITE).wrap_socket(near, server_hostname=HOST)
    assert near.fileno() == -1
    with pytest.raises(TLSError, match="the peer gave up"):
        server.result(TIMEOUT)


def test_a_wrong_context_leaves_the_socket_alone(authority: Authority) -> None:
    near, far = plain_pair()
    with near, far:
        with pytest.raises(InvalidOption):
            authority.context(SUITE).wrap_socket(near, server_side=True)
        assert near.fileno() >= 0
