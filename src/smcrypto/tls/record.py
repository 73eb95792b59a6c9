"""Records and their protection: RFC 8446, 5; GB/T 38636-2020, 6.3.

    Plain     before keys are there: type || version || length || fragment
    AEAD13    TLS 1.3: SM4-GCM or SM4-CCM over fragment || type || zeros, the nonce is iv xor sequence number
    GCM       TLCP: SM4-GCM, nonce = 4 bytes of the key block || the sequence number, which is sent with the record
    CBC       TLCP: HMAC-SM3 of the fragment, padding, SM4-CBC with a random IV that is sent with the record

A protection serves one direction and counts its records. What fails to open is bad_record_mac, always with
the same text. For CBC that is one path too (RFC 5246, 6.2.3.2): after wrong padding the MAC is computed all the same,
and then both are judged together. The time still depends, weakly, on the length of the padding (Lucky 13); GCM has no
such channel.

`Records` cuts what arrives into records and collects what is to be sent. It holds at most one incomplete record.
"""

from __future__ import annotations

from collections.abc import Callable
from hmac import compare_digest
from typing import Final, TypeAlias

from smcrypto import sm3
from smcrypto.sm4 import CBC as CBCMode
from smcrypto.sm4 import decrypt, encrypt
from smcrypto.sm4.aead import SM4CCM, SM4GCM
from smcrypto.sm4.engine import xor_bytes
from smcrypto.tls.alerts import Alert, refusing, require
from smcrypto.tls.schedule import expand_label

__all__ = ["AEAD13", "CBC", "GCM", "Plain", "Protection", "Records"]

CHANGE_CIPHER_SPEC, ALERT, HANDSHAKE, APPLICATION_DATA = 20, 21, 22, 23
TLCP_VERSION: Final = 0x0101
TLS12_VERSION: Final = 0x0303  # what TLS 1.3 writes into records and hello messages

MAX_FRAGMENT: Final = 1 << 14
EXPANSION: Final = {TLS12_VERSION: 256, TLCP_VERSION: 2048}  # the most bytes that protection may add
REFUSED: Final = "a record is refused"
UNAUTHENTIC: Final = f"{REFUSED}: the message is not authentic"  # what SM4GCM and SM4CCM say, too
_PEACEFUL: Final = (Alert.close_notify, Alert.user_canceled)


def _header(kind: int, version: int, length: int) -> bytes:
    return bytes([kind]) + version.to_bytes(2, "big") + length.to_bytes(2, "big")


class Plain:
    """No protection."""

    sequence = 0

    def __init__(self, version: int) -> None:
        self.version = version

    def seal(self, kind: int, fragment: bytes) -> bytes:
        return _header(kind, self.version, len(fragment)) + fragment

    def open(self, header: bytes, body: bytes) -> tuple[int, bytes]:
        return header[0], body


class AEAD13:
    """TLS 1.3 with the keys that follow from a traffic secret: RFC 8446, 5.2, 5.3 and 7.3."""

    version = TLS12_VERSION

    def __init__(self, suite: str, secret: bytes) -> None:
        key, self._iv = expand_label(secret, b"key", b"", 16), expand_label(secret, b"iv", b"", 12)
        self._aead: SM4GCM | SM4CCM = SM4GCM(key) if suite == "TLS_SM4_GCM_SM3" else SM4CCM(key)
        self.sequence = 0

    def _nonce(self) -> bytes:
        self.sequence += 1
        return xor_bytes(self._iv, (self.sequence - 1).to_bytes(12, "big"))

    def seal(self, kind: int, fragment: bytes) -> bytes:
        header = _header(APPLICATION_DATA, self.version, len(fragment) + 17)
        return header + self._aead.encrypt(self._nonce(), fragment + bytes([kind]), header)

    def open(self, header: bytes, body: bytes) -> tuple[int, bytes]:
        # Who refuses this side's certificate may have no keys yet to say so (OpenSSL). Only failures: a stranger who
        # could send close_notify would cut the data.
        if header[0] == ALERT and len(body) == 2 and body[1] not in _PEACEFUL and self.sequence == 0:
            return ALERT, body
        require(header[0] == APPLICATION_DATA, Alert.unexpected_message, "a record without protection, under keys")
        with refusing(Alert.bad_record_mac, REFUSED):
            inner = self._aead.decrypt(self._nonce(), body, header).rstrip(b"\0")
        typed = inner and inner[-1] in (ALERT, HANDSHAKE, APPLICATION_DATA)
        require(typed, Alert.unexpected_message, "a protected record is of no type that may be protected")
        return inner[-1], inner[:-1]


class GCM:
    """TLCP's SM4-GCM: GB/T 38636-2020, 6.3.3.4.4; RFC 5288, 3. `iv`: 4 bytes of the key block."""

    version = TLCP_VERSION

    def __init__(self, key: bytes, iv: bytes) -> None:
        self._gcm, self._iv = SM4GCM(key), iv
        self.sequence = 0

    def _associated(self, kind: int, length: int) -> bytes:
        self.sequence += 1
        return (self.sequence - 1).to_bytes(8, "big") + _header(kind, self.version, length)

    def seal(self, kind: int, fragment: bytes) -> bytes:
        associated = self._associated(kind, len(fragment))
        sealed = self._gcm.encrypt(self._iv + associated[:8], fragment, associated)
        return _header(kind, self.version, len(sealed) + 8) + associated[:8] + sealed

    def open(self, header: bytes, body: bytes) -> tuple[int, bytes]:
        associated = self._associated(header[0], max(len(body) - 24, 0))
        with refusing(Alert.bad_record_mac, REFUSED):  # what is too short for a tag, too
            return header[0], self._gcm.decrypt(self._iv + body[:8], body[8:], associated)


class CBC:
    """TLCP's SM4-CBC with HMAC-SM3: GB/T 38636-2020, 6.3.3.4.3. `random` gives the IVs."""

    version = TLCP_VERSION

    def __init__(self, key: bytes, mac_key: bytes, random: Callable[[int], bytes]) -> None:
        self._key, self._mac_key, self._random = key, mac_key, random
        self.sequence = 0

    def _mac(self, kind: int, fragment: bytes) -> bytes:
        self.sequence += 1
        covered = (self.sequence - 1).to_bytes(8, "big") + _header(kind, self.version, len(fragment)) + fragment
        return sm3.hmac(self._mac_key, covered)

    def seal(self, kind: int, fragment: bytes) -> bytes:
        text = fragment + self._mac(kind, fragment)
        padding = 15 - len(text) % 16
        iv = self._random(16)
        sealed = iv + encrypt(self._key, CBCMode(iv), text + bytes([padding]) * (padding + 1))
        return _header(kind, self.version, len(sealed)) + sealed

    def open(self, header: bytes, body: bytes) -> tuple[int, bytes]:
        # IV, MAC, a block with the padding: what anyone on the way can see.
        require(len(body) >= 64 and len(body) % 16 == 0, Alert.bad_record_mac, UNAUTHENTIC)
        text = decrypt(self._key, CBCMode(body[:16]), body[16:])
        padding = text[-1]
        padded = padding + 33 <= len(text) and text.endswith(bytes([padding]) * (padding + 1))
        end = len(text) - 33 - padding * padded
        fragment, mac = text[:end], text[end : end + 32]
        authentic = compare_digest(self._mac(header[0], fragment), mac)
        require(padded & authentic, Alert.bad_record_mac, UNAUTHENTIC)
        return header[0], fragment


Protection: TypeAlias = Plain | AEAD13 | GCM | CBC
"""One direction's current state. Each has `version` (what stands in headers), `sequence` (the number of the next
record), `seal` (type and fragment to the record), `open` (header and body to type and fragment; TLSError)."""


class Records:
    """Both directions of one connection, as records."""

    def __init__(self, version: int) -> None:
        self.reader: Protection = Plain(version)
        self.writer: Protection = Plain(version)
        self.outgoing = bytearray()
        self.incoming = bytearray()
        self.message = bytearray()
        """The beginning of a handshake message whose end has not arrived."""
        self.closed = False
        """Has close_notify or a fatal alert been sent, or received a fatal one? Nothing is sent then."""

    def next(self) -> tuple[int, bytes] | None:
        """(type, fragment) of the next record that has arrived whole, or None."""
        if len(self.incoming) < 5:
            return None
        header = bytes(self.incoming[:5])
        kind, version, length = header[0], int.from_bytes(header[1:3], "big"), int.from_bytes(header[3:], "big")
        known = CHANGE_CIPHER_SPEC <= kind <= APPLICATION_DATA
        require(known, Alert.unexpected_message, f"not a TLS record: its first byte is {kind}")
        # RFC 8446, 5.1: legacy_record_version is ignored. TLCP has one version, 0x0101.
        same = version == TLCP_VERSION or self.reader.version != TLCP_VERSION
        require(same, Alert.protocol_version, f"a record has version {version:#06x}, not 0x0101")
        limit = MAX_FRAGMENT + (0 if isinstance(self.reader, Plain) else EXPANSION[self.reader.version])
        require(length <= limit, Alert.record_overflow, f"a record of {length} bytes")
        if len(self.incoming) < 5 + length:
            return None
        body = bytes(self.incoming[5 : 5 + length])
        del self.incoming[: 5 + length]
        if kind == CHANGE_CIPHER_SPEC and self.reader.version != TLCP_VERSION:
            return kind, body  # RFC 8446, 5: never protected
        kind, fragment = self.reader.open(header, body)
        require(len(fragment) <= MAX_FRAGMENT, Alert.record_overflow, f"a record with {len(fragment)} bytes of content")
        return kind, fragment

    def write(self, kind: int, data: bytes) -> None:
        """`data`, not empty, as records of one type; nothing once `closed`."""
        if self.closed:
            return
        for i in range(0, len(data), MAX_FRAGMENT):
            self.outgoing += self.writer.seal(kind, data[i : i + MAX_FRAGMENT])

    def read_with(self, protection: Protection) -> None:
        """Keys change between two records, and no handshake message lies across: RFC 8446, 5.1."""
        require(not self.message, Alert.unexpected_message, "a handshake message continues where the keys change")
        self.reader = protection
