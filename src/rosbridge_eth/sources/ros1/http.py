"""As much of HTTP/1.0 (RFC 1945) as XML-RPC needs: one request and one answer on a connection. No sockets.

We ask in version 1.0 and answer `Connection: close`, so that nobody sends chunks and
an answer without a length ends with its connection.
"""

from __future__ import annotations

import re

from rosbridge_eth.sources.ros1.errors import ProtocolError

MAX_HEAD = 16 * 1024
"""Bytes of the start line and header fields."""

_STATUS = re.compile(rb"HTTP/1\.[0-9] ([0-9]{3})(?: .*)?")
_REQUEST = re.compile(rb"([A-Z]{1,16}) (\S{1,2048}) HTTP/1\.[0-9]")
_LENGTH = re.compile(rb"[0-9]{1,12}")


def encode_request(host: str, port: int, path: str, body: bytes) -> bytes:
    """A POST of an XML-RPC call."""
    shown = f"[{host}]" if ":" in host else host
    head = (
        f"POST {path} HTTP/1.0\r\nHost: {shown}:{port}\r\nUser-Agent: rosbridge-eth\r\n"
        f"Content-Type: text/xml\r\nContent-Length: {len(body)}\r\nConnection: close\r\n\r\n"
    )
    return head.encode() + body


def encode_response(body: bytes, status: str = "200 OK") -> bytes:
    """The answer to a POST."""
    head = (
        f"HTTP/1.0 {status}\r\nContent-Type: text/xml\r\nContent-Length: {len(body)}\r\nConnection: close\r\n\r\n"
    )
    return head.encode() + body


class BodyReader:
    """The body of one message, a request or an answer, from bytes in any chunks."""

    def __init__(self, *, request: bool, limit: int) -> None:
        self._request, self._limit = request, limit
        self._data = bytearray()
        self._searched = 0
        self._head_length: int | None = None
        self._length: int | None = None

    def feed(self, data: bytes | memoryview) -> bytes | None:
        """The body once it is complete; None before. What follows it is ignored. Raises ProtocolError."""
        self._data += data
        if self._head_length is None:
            end = self._data.find(b"\r\n\r\n", self._searched)
            if end < 0:
                self._searched = max(0, len(self._data) - 3)
                if len(self._data) > MAX_HEAD:
                    raise ProtocolError(f"an HTTP head of more than {MAX_HEAD} bytes")
                return None
            if end > MAX_HEAD:
                raise ProtocolError(f"an HTTP head of more than {MAX_HEAD} bytes")
            self._head_length = end + 4
            self._read_head(bytes(self._data[:end]).split(b"\r\n"))
        body_length = len(self._data) - self._head_length
        if body_length > self._limit and self._length is None:
            raise ProtocolError(f"an HTTP body of more than {self._limit} bytes")
        if self._length is not None and body_length >= self._length:
            return bytes(self._data[self._head_length : self._head_length + self._length])
        return None

    def end(self) -> bytes:
        """The connection ended: the body, if that is how its end is marked. Raises ProtocolError."""
        if self._head_length is None or self._length is not None or self._request:
            raise ProtocolError("the connection ended within an HTTP message")
        return bytes(self._data[self._head_length :])

    def _read_head(self, lines: list[bytes]) -> None:
        expected = _REQUEST if self._request else _STATUS
        start = expected.fullmatch(lines[0])
        if start is None:
            raise ProtocolError("this is not HTTP")
        if not self._request and start[1] != b"200":
            raise ProtocolError(f"HTTP status {start[1].decode()}")
        if self._request and start[1] != b"POST":
            raise ProtocolError("only POST is answered")
        for line in lines[1:]:
            name, _, value = line.partition(b":")
            name, value = name.strip().lower(), value.strip()
            if name == b"transfer-encoding":
                raise ProtocolError("an HTTP transfer encoding was not asked for")
            if name == b"content-length":
                if not _LENGTH.fullmatch(value) or self._length not in (None, int(value)):
                    raise ProtocolError("an HTTP content length that is no number, or two of them")
                self._length = int(value)
                if self._length > self._limit:
                    raise ProtocolError(f"an HTTP body of {self._length} bytes is not read; at most {self._limit}")
        if self._request and self._length is None:
            raise ProtocolError("an HTTP request without its length")
