"""One handshake by hand, message by message, so that a test can stand in between."""

from __future__ import annotations

from bridge.channel.world import SERVER_ADDRESS, make_client, make_server
from rosbridge_eth.channel import Client, ClientConfig, Connected, Drop, Event, Mode, Server, ServerConfig
from rosbridge_eth.channel.wire import SEGMENT_HEADER, Frame

HERE = ("198.51.100.7", 50000)
OPEN = {"handshake_share": 1e9}  # the limit on handshakes is a test of its own


class Steps:
    def __init__(
        self,
        mode: Mode = Mode.EXCHANGE,
        *,
        server: Server | None = None,
        client: Client | None = None,
        now: float = 1000.0,
    ) -> None:
        self.now = now
        self.server = server or make_server(now, ServerConfig(modes=(mode,), **OPEN))
        self.client = client or make_client(now, ClientConfig(mode=mode))
        self.client.connect(SERVER_ADDRESS, now)
        [(self.hello, _)] = self.client.datagrams_to_send(now)

    def to_server(self, *datagrams: bytes, source: tuple[str, int] = HERE) -> list[bytes]:
        """Deliver, and what the server sends to anybody."""
        for data in datagrams:
            self.server.receive_datagram(data, source, self.now)
        return [data for data, _ in self.server.datagrams_to_send(self.now)]

    def to_client(self, *datagrams: bytes) -> list[bytes]:
        for data in datagrams:
            self.client.receive_datagram(data, SERVER_ADDRESS, self.now)
        return [data for data, _ in self.client.datagrams_to_send(self.now)]

    def until_cookie(self) -> bytes:
        [self.cookie] = self.to_server(self.hello)
        return self.cookie

    def until_proof(self) -> list[bytes]:
        self.proof = self.to_client(self.until_cookie())
        return self.proof

    def until_offer(self) -> list[bytes]:
        self.offer = self.to_server(*self.until_proof())
        return self.offer

    def until_first(self) -> bytes:
        """The client's first packet under the session's keys: a probe."""
        [self.first] = self.to_client(*self.until_offer())
        return self.first

    def until_connected(self) -> Steps:
        self.answer = self.to_server(self.until_first())
        self.to_client(*self.answer)
        assert any(isinstance(event, Connected) for event in events(self.client))
        return self

    # Under the session's keys

    @property
    def session(self):
        """The server's only session."""
        [session] = self.server._sessions.values()
        return session

    @property
    def connection(self) -> bytes:
        return self.session.cid

    def sealed(self, frame: bytes) -> bytes:
        """A packet of the client's keys with any frame at all in it."""
        session = self.client._session
        return session.seal(session.sending.take_number(), frame)

    def from_client(self, frame: bytes) -> list[bytes]:
        return self.to_server(self.sealed(frame))

    def from_server(self, frame: bytes) -> list[bytes]:
        """Deliver a packet of the server's keys with any frame at all in it."""
        session = self.session
        session.credit += 1200
        return self.to_client(session.seal(frame))

    def sent(self, *payloads: bytes) -> list[bytes]:
        """The client's packets with these messages."""
        for payload in payloads:
            self.client.send(payload)
        return [data for data, _ in self.client.datagrams_to_send(self.now)]


def segment(index: int, data: bytes) -> bytes:
    return SEGMENT_HEADER.pack(Frame.SEGMENT, index) + data


def message(payload: bytes) -> bytes:
    return len(payload).to_bytes(4, "big") + payload


def events(end: Client | Server) -> list[Event]:
    found = []
    while (event := end.next_event()) is not None:
        found.append(event)
    return found


def dropped(end: Client | Server) -> dict[str, int]:
    return {what: count for what, count in end.statistics().items() if isinstance(what, Drop)}


def flipped(data: bytes, bit: int) -> bytes:
    changed = bytearray(data)
    changed[bit // 8] ^= 1 << bit % 8
    return bytes(changed)
