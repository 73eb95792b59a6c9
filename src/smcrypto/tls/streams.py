"""Connections in asyncio: `open_connection` and `start_server` give the reader and writer of asyncio's own streams."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable
from typing import Any, Final, cast

from smcrypto.tls.alerts import TLSError
from smcrypto.tls.connection import Connection
from smcrypto.tls.context import SMContext
from smcrypto.tls.events import DataReceived, HandshakeCompleted, Session, SessionIssued

__all__ = ["open_connection", "start_server"]

HANDSHAKE_SECONDS: Final = 60.0  # as asyncio's ssl_handshake_timeout
_LIMIT: Final = 1 << 16  # of asyncio.StreamReader


async def open_connection(
    host: str, port: int, *, context: SMContext, server_hostname: str | None = None, session: Session | None = None,
    limit: int = _LIMIT, **options: Any,
) -> tuple[asyncio.StreamReader, asyncio.StreamWriter]:  # fmt: skip
    """As `asyncio.open_connection`, when the handshake is done; TLSError or OSError where it fails.

    server_hostname: `host`, unless told otherwise. options: those of `loop.create_connection`.
    `writer.get_extra_info` knows "handshake", the HandshakeCompleted, and "session", the newest one to resume.
    """
    loop = asyncio.get_running_loop()
    reader = asyncio.StreamReader(limit=limit, loop=loop)
    protocol = asyncio.StreamReaderProtocol(reader, loop=loop)
    connection = Connection(
        context, server_hostname=host if server_hostname is None else server_hostname, session=session
    )
    done: asyncio.Future[None] = loop.create_future()
    layer = _Layer(connection, protocol, done)
    await loop.create_connection(lambda: layer, host, port, **options)
    try:
        await done
    except BaseException:
        layer.abort()
        raise
    return reader, asyncio.StreamWriter(layer, protocol, reader, loop)


async def start_server(
    client_connected_cb: Callable[[asyncio.StreamReader, asyncio.StreamWriter], Awaitable[None] | None],
    host: str | None = None, port: int | None = None, *, context: SMContext, limit: int = _LIMIT, **options: Any,
) -> asyncio.Server:  # fmt: skip
    """As `asyncio.start_server`; the callback comes when the handshake is done.

    A handshake that fails, or takes a minute, is told to the loop's exception handler, which logs it.
    """
    loop = asyncio.get_running_loop()

    def accept() -> _Layer:
        given = asyncio.StreamReader(limit=limit, loop=loop), client_connected_cb
        return _Layer(Connection(context, server_side=True), asyncio.StreamReaderProtocol(*given, loop=loop), None)

    return await loop.create_server(accept, host, port, **options)


class _Layer(asyncio.Protocol, asyncio.Transport):
    """To the network's transport a protocol, to the application's protocol a transport."""

    def __init__(
        self, connection: Connection, protocol: asyncio.Protocol, done: asyncio.Future[None] | None
    ) -> None:
        super().__init__()
        self._loop = asyncio.get_running_loop()
        self._connection, self._protocol, self._done = connection, protocol, done
        self._completed: HandshakeCompleted | None = None
        self._session: Session | None = None
        self._error: Exception | None = None

    # --- what the network's transport calls ---

    def connection_made(self, transport: asyncio.BaseTransport) -> None:
        self._lower = cast(asyncio.Transport, transport)  # as create_connection and create_server make it
        self._timer = self._loop.call_later(HANDSHAKE_SECONDS, self._fail, TimeoutError("the handshake takes too long"))
        self._flush()

    def data_received(self, data: bytes) -> None:
        try:
            events = self._connection.receive_data(data)
        except TLSError as error:
            self._flush()  # the alert
            self._fail(error)
            return
        self._flush()
        for event in events:
            if isinstance(event, DataReceived):
                self._protocol.data_received(event.data)
            elif isinstance(event, HandshakeCompleted):
                self._timer.cancel()
                self._completed = event
                self._protocol.connection_made(self)
                if self._done is not None and not self._done.done():
                    self._done.set_result(None)
            elif isinstance(event, SessionIssued):
                self._session = event.session
            else:
                self._protocol.eof_received()

    def eof_received(self) -> bool:
        """After close_notify the network's transport stays open for what is still to be answered."""
        self.data_received(b"")
        return self._completed is not None

    def connection_lost(self, error: Exception | None) -> None:
        self._timer.cancel()
        self._error = self._error or error
        if self._completed is not None:
            self._protocol.connection_lost(self._error)
            return
        reason = self._error or ConnectionResetError("the connection ended in the handshake")
        if self._done is None:
            self._loop.call_exception_handler({"message": "TLS handshake failed", "exception": reason})
        elif not self._done.done():
            self._done.set_exception(reason)

    def pause_writing(self) -> None:
        self._protocol.pause_writing()

    def resume_writing(self) -> None:
        self._protocol.resume_writing()

    def _fail(self, error: Exception) -> None:
        self._error = self._error or error
        self._lower.close()

    def _flush(self) -> None:
        if data := self._connection.data_to_send():
            self._lower.write(data)

    # --- what the application's protocol calls ---

    def write(self, data: bytes | bytearray | memoryview[Any]) -> None:
        if not self._lower.is_closing():
            self._connection.send(data)
            self._flush()

    def close(self) -> None:
        if not self._lower.is_closing():
            self._connection.close()
            self._flush()
            self._lower.close()

    def abort(self) -> None:
        self._lower.abort()

    def is_closing(self) -> bool:
        return self._lower.is_closing()

    def can_write_eof(self) -> bool:
        return False

    def pause_reading(self) -> None:
        self._lower.pause_reading()

    def resume_reading(self) -> None:
        self._lower.resume_reading()

    def get_write_buffer_size(self) -> int:
        return self._lower.get_write_buffer_size()

    def set_write_buffer_limits(self, high: int | None = None, low: int | None = None) -> None:
        self._lower.set_write_buffer_limits(high, low)

    def get_extra_info(self, name: str, default: Any = None) -> Any:
        own = {"handshake": self._completed, "session": self._session}
        return own[name] if name in own else self._lower.get_extra_info(name, default)
