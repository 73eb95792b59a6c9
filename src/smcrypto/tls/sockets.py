"""Connections over a socket, with the methods and the manner of `ssl.SSLSocket`.

What differs from it: a stream that ends without close_notify is TLSError on `recv`, never an end of the data;
`close` says close_notify, where that can be said without waiting. One thread at a time may use a socket.
"""

from __future__ import annotations

import contextlib
import socket
import ssl
from typing import Any

from smcrypto.errors import SMCryptoError
from smcrypto.tls.alerts import TLSError
from smcrypto.tls.connection import Connection
from smcrypto.tls.context import SMContext
from smcrypto.tls.events import DataReceived, HandshakeCompleted, Session, SessionIssued
from smcrypto.x509 import AnyCertificate

__all__ = ["SMSocket"]

_READ = 1 << 16
_WRITE = 1 << 14  # one record, RFC 8446, 5.1


class SMSocket(socket.socket):
    """A TLCP or TLS 1.3 connection over the socket `sock`, which is detached; made by `SMContext.wrap_socket`.

    As of `ssl`: a non-blocking socket raises SSLWantReadError or SSLWantWriteError, and the same call is to be made
    again when the socket is ready; after a timeout too, `send` is to be called again with the same data.
    Failures of the protocol are TLSError, those of the network OSError.
    """

    def __init__(
        self, sock: socket.socket, context: SMContext, server_side: bool, server_hostname: str | None,
        session: Session | None, do_handshake_on_connect: bool,
    ) -> None:  # fmt: skip
        self._connection = Connection(
            context, server_side=server_side, server_hostname=server_hostname, session=session
        )
        timeout = sock.gettimeout()
        super().__init__(sock.family, sock.type, sock.proto, fileno=sock.fileno())
        sock.detach()
        self.settimeout(timeout)
        self.context = context
        self.session = session
        """The newest session that a client can resume, else the one that it was given."""
        self._completed: HandshakeCompleted | None = None
        self._on_connect = do_handshake_on_connect
        self._received = bytearray()
        self._ended = False  # the peer's close_notify came
        self._unsent = b""  # protected, and not yet taken by the network
        self._writing = 0  # bytes of the `send` that has to be called again
        if do_handshake_on_connect and self._connected():
            try:
                self.do_handshake()
            except BaseException:
                self.close()
                raise

    def _connected(self) -> bool:
        try:
            self.getpeername()
        except OSError:
            return False
        return True

    def connect(self, address: Any, /) -> None:
        super().connect(address)
        if self._on_connect:
            self.do_handshake()

    def accept(self) -> tuple[SMSocket, Any]:
        """The next connection, its handshake made; OSError where that fails, and this socket goes on.

        A TLSError is the cause of an SSLError here: socketserver's loop goes on after an OSError alone.
        """
        plain, address = super().accept()
        try:
            return SMSocket(plain, self.context, True, None, None, self._on_connect), address
        except TLSError as error:
            raise ssl.SSLError(str(error)) from error

    # --- between connection and network ---

    def _flush(self) -> None:
        """Hand what is protected to the network; SSLWantWriteError, or TimeoutError, keeps the rest for the next."""
        self._unsent += self._connection.data_to_send()
        while self._unsent:
            try:
                sent = super().send(self._unsent)
            except BlockingIOError:
                raise ssl.SSLWantWriteError("the socket takes no more now") from None
            self._unsent = self._unsent[sent:]

    def _receive(self) -> None:
        """One read from the network and what comes of it."""
        try:
            data = super().recv(_READ)
        except BlockingIOError:
            raise ssl.SSLWantReadError("the socket has nothing to read now") from None
        try:
            for event in self._connection.receive_data(data):
                if isinstance(event, DataReceived):
                    self._received += event.data
                elif isinstance(event, HandshakeCompleted):
                    self._completed = event
                elif isinstance(event, SessionIssued):
                    self.session = event.session
                else:
                    self._ended = True
        except TLSError:
            with contextlib.suppress(OSError):  # the alert, if the peer still listens
                self._flush()
            raise
        with contextlib.suppress(ssl.SSLWantWriteError):  # answers of the protocol, such as KeyUpdate
            self._flush()

    def do_handshake(self) -> None:
        """TLSError where it fails; once it is done, nothing happens."""
        while True:
            self._flush()
            if self._completed is not None:
                return
            self._receive()

    # --- data ---

    def send(self, data: Any, flags: int = 0, /) -> int:
        """How many bytes went out: at most one record of them, 2**14."""
        _require_none(flags)
        if self._completed is None:
            self.do_handshake()
        if not self._writing:
            with memoryview(data).cast("B") as octets, octets[:_WRITE] as record:
                self._connection.send(record)
                self._writing = len(record)
        self._flush()
        sent, self._writing = self._writing, 0
        return sent

    def sendall(self, data: Any, flags: int = 0, /) -> None:
        with memoryview(data).cast("B") as octets:
            done = 0
            while done < len(octets):
                done += self.send(octets[done:], flags)

    def recv(self, bufsize: int = _READ, flags: int = 0, /) -> bytes:
        """At most `bufsize` bytes; b"" after the peer's close_notify, and TLSError where the stream ends without."""
        _require_none(flags)
        if bufsize < 0:
            raise ValueError("negative buffersize in recv")
        if self._completed is None:
            self.do_handshake()
        while bufsize and not self._received and not self._ended:
            self._receive()
        data = bytes(self._received[:bufsize])
        del self._received[:bufsize]
        return data

    def recv_into(self, buffer: Any, nbytes: int = 0, flags: int = 0, /) -> int:
        with memoryview(buffer).cast("B") as octets:
            data = self.recv(nbytes or len(octets), flags)
            octets[: len(data)] = data
        return len(data)

    def pending(self) -> int:
        """Bytes that `recv` gives without reading from the network: `select` does not see them."""
        return len(self._received)

    def _refused(self, *_arguments: Any, **_options: Any) -> Any:
        raise ValueError("this method would go past the protection")

    sendto = sendmsg = sendfile = recvfrom = recvfrom_into = recvmsg = recvmsg_into = dup = _refused

    # --- the end ---

    def unwrap(self) -> socket.socket:
        """Say close_notify, wait for the peer's, and give the plain socket; what the peer sent before is dropped."""
        self._connection.close()
        self._flush()
        while not self._ended:
            self._receive()
        timeout = self.gettimeout()
        plain = socket.socket(self.family, self.type, self.proto, fileno=self.detach())
        plain.settimeout(timeout)
        return plain

    def shutdown(self, how: int, /) -> None:
        """Where writing ends, close_notify goes first."""
        if how != socket.SHUT_RD and self._completed is not None:
            self._connection.close()
            self._flush()
        super().shutdown(how)

    def _real_close(self, *arguments: Any) -> None:  # of socket.socket: when the last file of `makefile` is closed too
        if self._completed is not None:
            with contextlib.suppress(OSError, SMCryptoError):
                self.setblocking(False)
                self._connection.close()
                self._flush()
        super()._real_close(*arguments)  # type: ignore[misc]

    # --- what was agreed on ---

    @property
    def peer_certificates(self) -> tuple[AnyCertificate, ...]:
        """As HandshakeCompleted has them; empty before the handshake."""
        return () if self._completed is None else self._completed.peer_certificates

    def getpeercert(self, binary_form: bool = False) -> AnyCertificate | bytes | None:
        """The peer's first certificate, not as a dict but as smcrypto.x509 has it, or its DER; None without one."""
        if not self.peer_certificates:
            return None
        certificate = self.peer_certificates[0]
        return certificate.to_der() if binary_form else certificate

    def cipher(self) -> tuple[str, str, int] | None:
        """Suite, version and bits of the key; None before the handshake."""
        return None if self._completed is None else (self._completed.suite, self._completed.version, 128)

    def version(self) -> str | None:
        """"TLCPv1.1" or "TLSv1.3"; None before the handshake."""
        return None if self._completed is None else self._completed.version

    def selected_alpn_protocol(self) -> str | None:
        return None if self._completed is None else self._completed.alpn

    @property
    def session_reused(self) -> bool | None:
        return None if self._completed is None else self._completed.resumed


def _require_none(flags: int) -> None:
    if flags:
        raise ValueError("flags of the socket make no sense for protected data")
