"""asyncio's streams over TLCP and TLS 1.3."""

from __future__ import annotations

import asyncio
import contextlib
import socket
from collections.abc import Awaitable, Callable
from typing import Any

import pytest

from smcrypto.tls import HandshakeCompleted, TLSError, streams
from tls_authority import HOST, Authority

SUITE = "TLS_SM4_GCM_SM3"
Streams = tuple[asyncio.StreamReader, asyncio.StreamWriter]


@pytest.fixture(scope="module")
def authority() -> Authority:
    return Authority.make()


def run(authority: Authority, client: Callable[[int], Awaitable[Any]], *, suite: str = SUITE,
        serve: Callable[..., Any] | None = None, **options: Any) -> list[dict[str, Any]]:  # fmt: skip
    """`client` with the port of a server that, unless told otherwise, sends back what comes; what the loop was told."""
    told: list[dict[str, Any]] = []

    async def echo(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        while data := await reader.read(1 << 16):
            writer.write(data)
            await writer.drain()
        writer.close()

    async def main() -> None:
        asyncio.get_running_loop().set_exception_handler(lambda _loop, context: told.append(context))
        context = authority.context(suite, authority.server, **options)
        server = await streams.start_server(serve or echo, "127.0.0.1", 0, context=context)
        async with server:
            await asyncio.wait_for(client(server.sockets[0].getsockname()[1]), 20)

    asyncio.run(main())
    return told


def open_to(authority: Authority, port: int, **options: Any) -> Awaitable[Streams]:
    options = {"context": authority.context(options.pop("suite", SUITE)), "server_hostname": HOST} | options
    return streams.open_connection("127.0.0.1", port, **options)


@pytest.mark.parametrize("suite", [SUITE, "ECC_SM4_GCM_SM3"])
def test_what_is_sent_comes_back(authority: Authority, suite: str) -> None:
    async def client(port: int) -> None:
        reader, writer = await open_to(authority, port, suite=suite)
        data = bytes(range(256)) * (1 << 13)  # 2 MiB: more than the buffers hold, so that both sides have to wait
        writer.writelines([data[:1000], data[1000:]])
        received = await reader.readexactly(len(data))
        assert received == data
        completed = writer.get_extra_info("handshake")
        assert isinstance(completed, HandshakeCompleted)
        assert (completed.suite, completed.peer_certificates[0]) == (suite, authority.server.certificate)
        assert writer.get_extra_info("peername")[1] == port
        assert writer.get_extra_info("nothing", "default") == "default"
        assert not writer.can_write_eof()
        session = writer.get_extra_info("session")
        writer.close()
        writer.close()
        assert writer.is_closing()
        await writer.wait_closed()
        _, again = await open_to(authority, port, context=authority.context(suite), session=session)
        assert again.get_extra_info("handshake").resumed
        again.close()

    assert run(authority, client, suite=suite) == []


def test_a_writer_waits_for_a_reader_that_is_slow(authority: Authority) -> None:
    size = 8 << 20  # more than the kernel keeps
    paused = asyncio.Event()

    async def client(port: int) -> None:
        _, writer = await open_to(authority, port)
        transport = writer.transport
        assert isinstance(transport, asyncio.Transport)
        transport.set_write_buffer_limits(high=1 << 16)
        assert transport.get_write_buffer_size() == 0
        writer.write(bytes(size))
        with pytest.raises(asyncio.TimeoutError):
            await asyncio.wait_for(writer.drain(), 0)
        paused.set()
        await writer.drain()
        transport.abort()
        assert transport.is_closing()

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        assert isinstance(writer.transport, asyncio.Transport)
        writer.transport.pause_reading()
        await paused.wait()
        writer.transport.resume_reading()
        with contextlib.suppress(TLSError, ConnectionError):
            await reader.read()

    run(authority, client, serve=serve)


def test_the_end_is_seen_and_the_other_direction_stays_open(authority: Authority) -> None:
    async def client(port: int) -> None:
        reader, writer = await open_to(authority, port)
        assert await reader.read() == b"all"
        writer.write(b"answer")
        writer.close()
        assert await asyncio.wait_for(answers, 10) == b"answer"
        writer.write(b"too late")  # nothing happens, as with asyncio's own transports

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(b"all")
        writer.transport._connection.close()  # type: ignore[attr-defined]  # half of `close`
        writer.transport._flush()  # type: ignore[attr-defined]
        answers.set_result(await reader.read())
        writer.close()

    async def with_future(port: int) -> None:
        nonlocal answers
        answers = asyncio.get_running_loop().create_future()
        await client(port)

    answers: asyncio.Future[bytes]
    assert run(authority, with_future, serve=serve) == []


def test_an_answer_may_come_after_the_network_connection_was_half_closed(authority: Authority) -> None:
    """As `SMSocket.shutdown` does it: close_notify, and at once the end of the stream below."""

    async def client(port: int) -> None:
        reader, writer = await open_to(authority, port)
        writer.write(b"question")
        writer.transport._connection.close()  # type: ignore[attr-defined]  # half of `close`
        writer.transport._flush()  # type: ignore[attr-defined]
        writer.transport._lower.write_eof()  # type: ignore[attr-defined]
        assert await reader.read() == b"answer"
        writer.close()

    async def serve(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        assert await reader.read() == b"question"
        await asyncio.sleep(0.05)  # until the end of the stream has come too
        writer.write(b"answer")
        writer.close()

    assert run(authority, client, serve=serve) == []


def test_a_stream_that_is_cut_is_an_error(authority: Authority) -> None:
    async def client(port: int) -> None:
        reader, _ = await open_to(authority, port)
        assert await reader.readexactly(3) == b"all"
        with pytest.raises(TLSError, match="close_notify"):
            await reader.read()

    async def serve(_reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        writer.write(b"all")
        writer.transport._lower.close()  # type: ignore[attr-defined]  # without close_notify

    run(authority, client, serve=serve)


def test_a_handshake_that_fails_is_told_to_both(authority: Authority) -> None:
    async def client(port: int) -> None:
        with pytest.raises(TLSError, match="issuer"):
            await open_to(authority, port, context=Authority.make().context(SUITE))
        await asyncio.sleep(0)

    [told] = run(authority, client)
    assert isinstance(told["exception"], TLSError)


@pytest.mark.parametrize("bytes_sent", [b"", b"GET / HTTP/1.1\r\n\r\n"])
def test_a_server_goes_on_after_strangers(authority: Authority, bytes_sent: bytes) -> None:
    async def client(port: int) -> None:
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        writer.write(bytes_sent)
        writer.write_eof()
        with contextlib.suppress(ConnectionResetError):
            await reader.read()
        writer.close()
        reader, writer = await open_to(authority, port)
        writer.write(b"a line\n")
        assert await reader.readline() == b"a line\n"
        writer.close()

    [told] = run(authority, client)
    assert told["message"] == "TLS handshake failed"


def test_a_handshake_has_a_minute(authority: Authority, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(streams, "HANDSHAKE_SECONDS", 0.0)

    async def client(port: int) -> None:
        reader, writer = await asyncio.open_connection("127.0.0.1", port)
        assert await reader.read() == b""
        writer.close()

    [told] = run(authority, client)
    assert isinstance(told["exception"], TimeoutError)


def test_a_connection_that_ends_in_the_handshake(authority: Authority) -> None:
    async def main() -> None:
        with socket.create_server(("127.0.0.1", 0)) as listener:
            opening = asyncio.ensure_future(open_to(authority, listener.getsockname()[1]))
            listener.setblocking(False)
            plain, _ = await asyncio.get_running_loop().sock_accept(listener)
            await asyncio.get_running_loop().sock_recv(plain, 1 << 16)
            plain.close()
            with pytest.raises(TLSError, match="close_notify"):
                await opening

    asyncio.run(main())


def test_opening_can_be_cancelled(authority: Authority) -> None:
    async def main() -> None:
        with socket.create_server(("127.0.0.1", 0)) as listener:
            listener.setblocking(False)
            opening = asyncio.ensure_future(open_to(authority, listener.getsockname()[1]))
            plain, _ = await asyncio.get_running_loop().sock_accept(listener)
            with plain:
                await asyncio.get_running_loop().sock_recv(plain, 1 << 16)
                opening.cancel()
                with pytest.raises(asyncio.CancelledError):
                    await opening
                assert await asyncio.get_running_loop().sock_recv(plain, 1 << 16) == b""

    with contextlib.suppress(ConnectionResetError):
        asyncio.run(main())
