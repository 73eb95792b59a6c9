"""Handshake messages as bytes: RFC 8446, 4; GB/T 38636-2020, 6.4.5; extensions: RFC 6066, RFC 7301.

Everything is read by `Reader`, which never looks beyond its data: what is too short, too long or followed by more
is decode_error. A length is bounded by the bytes that are there, those by MAX_MESSAGE.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Mapping
from enum import IntEnum
from typing import Final, NamedTuple, TypeVar

from smcrypto.tls.alerts import Alert, require

__all__ = ["MAX_MESSAGE", "Extension", "Hello", "Kind", "Message", "Reader", "pack", "read_numbers", "vector"]

T = TypeVar("T")
MAX_MESSAGE: Final = 1 << 17
"""The longest handshake message that is taken in, in bytes; the format has room for 16 MiB."""


class Kind(IntEnum):
    """HandshakeType; the last is none, but comes in a record of its own in TLCP's order of messages."""

    client_hello, server_hello, new_session_ticket, encrypted_extensions = 1, 2, 4, 8
    certificate, server_key_exchange, certificate_request, server_hello_done = 11, 12, 13, 14
    certificate_verify, client_key_exchange, finished, key_update = 15, 16, 20, 24
    message_hash, change_cipher_spec = 254, 256

    @classmethod
    def name_of(cls, number: int) -> str:
        return next((kind.name for kind in cls if kind == number), f"message {number}")


class Extension(IntEnum):
    """ExtensionType: RFC 8446, 4.2."""

    server_name, supported_groups, signature_algorithms, alpn, pre_shared_key = 0, 10, 13, 16, 41
    supported_versions, cookie, psk_key_exchange_modes, key_share = 43, 44, 45, 51


def pack(number: int, size: int = 2) -> bytes:
    return number.to_bytes(size, "big")


def vector(size: int, *parts: bytes) -> bytes:
    """The parts, behind their length in `size` bytes."""
    data = b"".join(parts)
    return pack(len(data), size) + data


def pack_message(kind: int, *parts: bytes) -> bytes:
    return bytes([kind]) + vector(3, *parts)


def pack_extensions(extensions: Mapping[int, bytes]) -> bytes:
    return vector(2, *(pack(number) + vector(2, data) for number, data in extensions.items()))


def pack_numbers(numbers: Iterable[int], size: int = 2) -> bytes:
    return vector(size, *map(pack, numbers))


class Message(NamedTuple):
    """One handshake message."""

    kind: int
    body: bytes

    @property
    def raw(self) -> bytes:
        """As it stands in the transcript."""
        return pack_message(self.kind, self.body)


class Reader:
    """Reads bytes front to back; at the end of its `with` block nothing may be left."""

    def __init__(self, data: bytes) -> None:
        self._data, self._at = data, 0

    def __enter__(self) -> Reader:
        return self

    def __exit__(self, kind: object, *_: object) -> None:
        require(kind is not None or not self.more(), Alert.decode_error, "a message is too long")

    def more(self) -> bool:
        return self._at < len(self._data)

    def take(self, length: int) -> bytes:
        """The next `length` bytes."""
        piece = self._data[self._at : self._at + length]
        require(len(piece) == length, Alert.decode_error, "a message is too short")
        self._at += length
        return piece

    def integer(self, size: int) -> int:
        return int.from_bytes(self.take(size), "big")

    def vector(self, size: int, least: int = 0) -> bytes:
        """A vector with a length of `size` bytes, of at least `least` bytes."""
        data = self.take(self.integer(size))
        require(len(data) >= least, Alert.decode_error, f"a vector of {len(data)} bytes, at least {least} are due")
        return data

    def each(self, read: Callable[[Reader], T]) -> Iterator[T]:
        """What `read` makes of the rest, piece by piece."""
        while self.more():
            yield read(self)

    def numbered(self, least: int = 0) -> dict[int, bytes]:
        """A vector of vectors with numbers, each of which comes once: extensions (RFC 8446, 4.2), shares (4.2.8)."""
        found: dict[int, bytes] = {}
        for number, data in Reader(self.vector(2)).each(lambda inner: (inner.integer(2), inner.vector(2, least))):
            require(number not in found, Alert.illegal_parameter, f"extension or group {number} comes twice")
            found[number] = data
        return found


def read_numbers(data: bytes, size: int = 2) -> tuple[int, ...]:
    """A vector of numbers of two bytes, its length in `size` bytes: suites, groups, versions, algorithms."""
    with Reader(data) as reader:
        return tuple(Reader(reader.vector(size, 2)).each(lambda inner: inner.integer(2)))


def read_server_name(data: bytes) -> str | None:
    """The DNS name of RFC 6066, 3; None where only names of other types are listed."""
    with Reader(data) as reader:
        names = dict(Reader(reader.vector(2, 4)).each(lambda inner: (inner.integer(1), inner.vector(2, 1))))
    name = names.get(0)
    require(name is None or name.isascii(), Alert.illegal_parameter, "server_name is not ASCII")
    return None if name is None else name.decode("ascii")


def read_alpn(data: bytes) -> tuple[bytes, ...]:
    """The protocols of RFC 7301, 3.1."""
    with Reader(data) as reader:
        return tuple(Reader(reader.vector(2, 2)).each(lambda inner: inner.vector(1, 1)))


class Hello(NamedTuple):
    """ClientHello, and ServerHello, which has one suite: RFC 8446, 4.1.2 and 4.1.3; GB/T 38636-2020, 6.4.5.2."""

    version: int
    random: bytes
    session_id: bytes
    suites: tuple[int, ...]
    extensions: dict[int, bytes]

    @classmethod
    def read(cls, message: Message) -> Hello:
        with Reader(message.body) as reader:
            version, random, session_id = reader.integer(2), reader.take(32), reader.vector(1)
            if message.kind == Kind.client_hello:
                suites, compression = read_numbers(vector(2, reader.vector(2))), reader.vector(1, 1)
            else:
                suites, compression = (reader.integer(2),), reader.take(1)
            extensions = reader.numbered() if reader.more() else {}
        require(len(session_id) <= 32, Alert.decode_error, f"a session id of {len(session_id)} bytes")
        require(0 in compression, Alert.illegal_parameter, "the peer wants to compress")
        return cls(version, random, session_id, suites, extensions)

    def pack(self, kind: Kind) -> bytes:
        chosen = pack_numbers(self.suites) + b"\1\0" if kind == Kind.client_hello else pack(self.suites[0]) + b"\0"
        extensions = pack_extensions(self.extensions) if self.extensions else b""
        return pack(self.version) + self.random + vector(1, self.session_id) + chosen + extensions
