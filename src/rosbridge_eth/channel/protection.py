"""Keys of a session, sealed packets, and the replay window.

Key schedule, HKDF with SM3 (RFC 5869). K is the handshake's shared secret, H its transcript hash H3, `mode` the
mode's name:

    client | server | finished (32 each) = HKDF(K, salt = H, info = "rosbridge-eth/3 session " | mode)
    key (16) | IV (12) = HKDF(client or server, info = "rosbridge-eth/3 packets")

Packets: SM4-GCM (RFC 8998), nonce = IV xor packet number, the header as associated data. Numbers count from 0 in
each direction and are never used twice; a session ends long before its keys are used up, so there is no key update.
"""

from __future__ import annotations

import hmac

from rosbridge_eth.channel.events import Drop, Refused
from rosbridge_eth.channel.wire import DATA_HEADER_SIZE, DATA_OVERHEAD, Kind, Malformed, Mode
from smcrypto import InvalidTag, kdf, sm3, sm4

SESSION_PACKETS = 1 << 20
"""A session ends when so many packets were sent in a direction."""


class SessionSecrets:
    """The three secrets of a session. No repr shows them."""

    __slots__ = ("client", "finished", "server")

    def __init__(self, shared: bytes, transcript: bytes, mode: Mode) -> None:
        info = b"rosbridge-eth/3 session " + mode.name.lower().encode("ascii")
        derived = kdf.hkdf(shared, 96, salt=transcript, info=info)
        self.client, self.server, self.finished = derived[:32], derived[32:64], derived[64:]


def finished(secret: bytes, transcript: bytes) -> bytes:
    """The server's confirmation of a handshake: HMAC-SM3 of its transcript hash, 32 bytes."""
    return hmac.new(secret, transcript, sm3.SM3).digest()


class Direction:
    """The keys of one direction of a session."""

    __slots__ = ("_aead", "_iv")

    def __init__(self, secret: bytes) -> None:
        derived = kdf.hkdf(secret, 28, info=b"rosbridge-eth/3 packets")
        self._aead = sm4.SM4GCM(derived[:16])
        self._iv = int.from_bytes(derived[16:], "big")

    def seal(self, cid: bytes, number: int, frame: bytes) -> bytes:
        """The datagram that carries `frame`: header, ciphertext, tag."""
        header = b"%c%b%b" % (Kind.DATA, cid, number.to_bytes(4, "big"))
        return header + self._aead.encrypt((self._iv ^ number).to_bytes(12, "big"), frame, header)

    def open(self, datagram: bytes, replay: ReplayWindow) -> tuple[int, bytes]:
        """Number and frame of a datagram, which `replay` has not seen; else Refused or Malformed."""
        if len(datagram) <= DATA_OVERHEAD:
            raise Malformed("a packet without a frame")
        number = int.from_bytes(datagram[9:DATA_HEADER_SIZE], "big")
        if replay.seen(number):
            raise Refused(Drop.REPLAYED)
        nonce = (self._iv ^ number).to_bytes(12, "big")
        try:
            return number, self._aead.decrypt(nonce, datagram[DATA_HEADER_SIZE:], datagram[:DATA_HEADER_SIZE])
        except InvalidTag:
            raise Refused(Drop.TAG) from None


class ReplayWindow:
    """Which of the last `size` packet numbers were received; older ones count as received.

    `seen` changes nothing; `mark` is for numbers that were authenticated. Bit i of `bits`: highest - i was received.
    """

    __slots__ = ("_mask", "bits", "highest", "size")

    def __init__(self, size: int = 2048) -> None:
        self.size = size
        self.highest = -1
        self.bits = 0
        self._mask = (1 << size) - 1

    def seen(self, number: int) -> bool:
        behind = self.highest - number
        if behind < 0:
            return False
        return behind >= self.size or bool(self.bits >> behind & 1)

    def mark(self, number: int) -> None:
        ahead = number - self.highest
        if ahead > 0:
            # Shifted no further than the window is wide: a jump of 2**30 must not make a number of 2**30 bits.
            self.bits = (self.bits << min(ahead, self.size) | 1) & self._mask
            self.highest = number
        else:
            self.bits |= 1 << -ahead
