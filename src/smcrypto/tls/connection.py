"""One connection: bytes in, bytes and events out. The records go to the handshake, to the caller, or are refused.

    before        the handshake's generator says which messages may come (handshake.py); no application data
    open          application data both ways; in TLS 1.3 tickets and key updates; in TLCP no handshake message
    closed        after the peer's close_notify all that arrives is ignored (RFC 8446, 6.1)
    failed        after a TLSError; each further call raises it again

Bounds: a record of 2^14 bytes and its expansion, a handshake message of MAX_MESSAGE, and MAX_IDLE records in a
row that bring the connection no further (empty, warnings, tickets, key updates).
"""

from __future__ import annotations

from typing import Final

from smcrypto.errors import OutOfOrder
from smcrypto.inputs import BytesLike, as_bytes
from smcrypto.tls import record
from smcrypto.tls.alerts import Alert, TLSError, require
from smcrypto.tls.context import SMContext, expect
from smcrypto.tls.events import ConnectionClosed, DataReceived, Event, Session
from smcrypto.tls.handshake import Handshake, Steps
from smcrypto.tls.messages import MAX_MESSAGE, Extension, Hello, Kind, Message, read_numbers
from smcrypto.tls.record import Plain, Records
from smcrypto.tls.tlcp import TLCP
from smcrypto.tls.tls13 import TLS13, TLS13_VERSION

__all__ = ["Connection"]

MAX_IDLE: Final = 32
KEY_UPDATE_AFTER: Final = 1 << 23
"""Records under one key before it is replaced: below the 2^24.5 of RFC 8446, 5.5."""


class Connection:
    """One side of one TLCP or TLS 1.3 connection. No socket, no clock of its own, no thread.

    server_hostname: a client's, the DNS name or IP address that the server's certificate must be for; a DNS name is
    sent to the server too (SNI). session: a client's, to be resumed. InvalidOption where the context lacks what the
    role needs: certificates and keys for a server, roots for whoever checks certificates.

    A client has its first bytes to send at once. After a TLSError nothing more is received or sent; the alert
    for the peer is the last that `data_to_send` gives.
    """

    def __init__(
        self, context: SMContext, *, server_side: bool = False, server_hostname: str | None = None,
        session: Session | None = None,
    ) -> None:  # fmt: skip
        self.context = context
        self.server_side = server_side
        self._events: list[Event] = []
        self._error: TLSError | None = None
        self._peer_closed = False
        self._idle = 0
        self._handshake: Handshake | None = None
        self._steps: Steps | None = None
        self._expected: tuple[int, ...] = (Kind.client_hello,)
        if server_side:
            self._records = Records(record.TLS12_VERSION)
            _require_server(context, server_hostname, session)
        else:
            _require_client(context, server_hostname, session)
            tlcp = context.versions[0] == TLCP.VERSION
            self._records = Records(record.TLCP_VERSION if tlcp else record.TLS12_VERSION)
            made = (TLCP if tlcp else TLS13)(context, self._records, self._events.append, server_hostname, session)
            self._start(made, made.client())

    @property
    def server_hostname(self) -> str | None:
        """The name that a client checks, or that a server was asked for, if any, once the handshake is completed."""
        return None if self._handshake is None else self._handshake.server_hostname

    def receive_data(self, data: BytesLike) -> list[Event]:
        """What came of `data`, any number of bytes from the network; b"" says that the stream has ended.

        TLSError: the connection failed; what had come before in the same call is lost. A stream that ends
        before close_notify is one: the data may have been cut.
        """
        arrived = as_bytes(data, "data")
        self._require_working()
        if self._peer_closed:
            return []
        try:
            if not arrived:
                raise TLSError(Alert.close_notify, "the stream ended without close_notify")
            self._records.incoming += arrived
            while not self._peer_closed and (found := self._records.next()) is not None:
                self._process(*found)
        except TLSError as error:
            if error.alert != Alert.close_notify:
                self._alert(2, error.alert)
            self._error = error
            raise
        events = self._events[:]
        self._events.clear()
        return events

    def data_to_send(self) -> bytes:
        """The bytes for the network, each given once; b"" if there are none."""
        data = bytes(self._records.outgoing)
        self._records.outgoing.clear()
        return data

    def send(self, data: BytesLike) -> None:
        """Protect `data`, any length, for `data_to_send`; OutOfOrder before the handshake's end and after `close`."""
        text = as_bytes(data, "data")
        self._require_working()
        if self._handshake is None or not self._handshake.completed or self._records.closed:
            raise OutOfOrder("data is sent between the handshake and close")
        for i in range(0, len(text), record.MAX_FRAGMENT):
            if isinstance(self._handshake, TLS13) and self._records.writer.sequence >= KEY_UPDATE_AFTER:
                self._handshake.update_keys()
            self._records.write(record.APPLICATION_DATA, text[i : i + record.MAX_FRAGMENT])

    def close(self) -> None:
        """Say that no data follow (close_notify), once. The peer's may still come: read to ConnectionClosed."""
        self._alert(1, Alert.close_notify)

    def _alert(self, level: int, alert: Alert) -> None:
        self._records.write(record.ALERT, bytes([level, alert]))
        self._records.closed = True

    def _require_working(self) -> None:
        if self._error is not None:
            raise self._error

    def _process(self, kind: int, fragment: bytes) -> None:
        completed = self._handshake is not None and self._handshake.completed
        whole = not self._records.message or kind in (record.HANDSHAKE, record.ALERT)
        require(whole, Alert.unexpected_message, "a handshake message is interrupted")
        if kind == record.APPLICATION_DATA and fragment and completed:
            self._idle = 0
            self._events.append(DataReceived(fragment))
            return
        if completed or not fragment or kind == record.CHANGE_CIPHER_SPEC:
            self._idle += 1
            require(self._idle <= MAX_IDLE, Alert.unexpected_message, f"{self._idle} records that lead no further")
        if kind == record.HANDSHAKE:
            self._reassemble(fragment)
        elif kind == record.ALERT:
            self._take_alert(fragment)
        elif kind == record.APPLICATION_DATA:
            require(completed, Alert.unexpected_message, "application data before the end of the handshake")
        else:
            require(fragment == b"\x01", Alert.unexpected_message, f"a record of type {kind} that is none of TLS")
            # TLS 1.3 ignores it until the handshake's end, its purpose being to look like TLS 1.2: RFC 8446, 5.
            if completed or not isinstance(self._handshake, TLS13):
                self._advance(Message(Kind.change_cipher_spec, fragment))

    def _reassemble(self, fragment: bytes) -> None:
        """Messages may lie across records, and several in one."""
        waiting = self._records.message
        waiting += fragment
        while len(waiting) >= 4:
            length = int.from_bytes(waiting[1:4], "big")
            require(length <= MAX_MESSAGE, Alert.illegal_parameter, f"a handshake message of {length} bytes")
            if len(waiting) < 4 + length:
                break
            message = Message(waiting[0], bytes(waiting[4 : 4 + length]))
            del waiting[: 4 + length]
            self._advance(message)

    def _advance(self, message: Message) -> None:
        if message.kind not in self._expected:
            due = " or ".join(map(Kind.name_of, self._expected)) or "no handshake message"
            raise TLSError(Alert.unexpected_message, f"{Kind.name_of(message.kind)} where {due} is due")
        if self._steps is None:
            made = self._chosen(message)
            self._start(made, made.server(message))
            return
        try:
            self._expected = self._steps.send(message)
        except StopIteration:  # TLCP's ends with the handshake
            self._expected = ()

    def _start(self, handshake: Handshake, steps: Steps) -> None:
        self._handshake, self._steps = handshake, steps
        self._expected = next(steps)

    def _chosen(self, message: Message) -> TLCP | TLS13:
        """The handshake for the version that the client asks for, if the context allows it."""
        hello = Hello.read(message)
        versions = hello.extensions.get(Extension.supported_versions, b"\2\0\0")
        kind: type[TLCP] | type[TLS13] | None = None
        if hello.version == record.TLCP_VERSION:
            kind = TLCP
            self._records.reader, self._records.writer = Plain(hello.version), Plain(hello.version)
        elif hello.version == record.TLS12_VERSION and TLS13_VERSION in read_numbers(versions, 1):
            kind = TLS13
        if kind is None or kind.VERSION not in self.context.versions:
            raise TLSError(Alert.protocol_version, "the client offers no version that is allowed here")
        return kind(self.context, self._records, self._events.append)

    def _take_alert(self, fragment: bytes) -> None:
        require(len(fragment) == 2, Alert.decode_error, "an alert has two bytes")
        level, number = fragment
        alert = Alert.of(number)
        if alert == Alert.close_notify:
            self._peer_closed = True
            self._events.append(ConnectionClosed())
        elif not (alert == Alert.user_canceled or (level == 1 and self._records.reader.version == record.TLCP_VERSION)):
            self._records.closed = True
            raise TLSError(alert, f"the peer gave up with alert {number}")


def _require_server(context: SMContext, server_hostname: str | None, session: Session | None) -> None:
    expect(server_hostname is None and session is None, "server_hostname and session are a client's")
    expect(context.key is not None, "a server needs a certificate and its key")
    both = TLCP.VERSION not in context.versions or context.encryption_key is not None
    expect(both, "a server of TLCP needs an encryption certificate and its key")
    expect(context.verify_client == "none" or context.roots, "a server that checks clients needs roots")


def _require_client(context: SMContext, server_hostname: str | None, session: Session | None) -> None:
    expect(context.roots, "a client needs roots: the CAs that it trusts")
    expect(server_hostname or not context.check_hostname, "a client needs server_hostname, or check_hostname=False")
    name = server_hostname or ""
    expect(name.isascii() and len(name) < 256, f"server_hostname is 1 to 255 ASCII letters (xn--…), not {name!r}")
    checked = server_hostname if context.check_hostname else None
    expect(session is None or session.server_hostname == checked, f"the session's server was not checked as {checked}")
