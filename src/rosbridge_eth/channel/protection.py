"""Keys of a session, sealed packets, and the replay window.

Key schedule, HKDF with SM3 (RFC 5869). K is the handshake's shared secret, H its transcript hash H3, `mode` the
mode's name:

    client | server | finished (32 each) = HKDF(K, salt = H, info = "rosbridge-eth/3 session " | mode)
    key (16) | IV (12) = HKDF(client or server, info = "rosbridge-eth/3 packets")

Packets: SM4-GCM (RFC 8998), nonce = IV xor packet number, the header as associated data. Numbers count from 0 in
each direction and are never used twice; a session ends long before its keys are used up, so there is no key update.
"""

from __future__ import annotations

from rosbridge_eth.channel.wire import DATA_HEADER_SIZE, DATA_OVERHEAD, Drop, Kind, Malformed, Mode, Refused
from smcrypto import InvalidTag, kdf, sm3, sm4

SESSION_PACKETS = 1 << 20
"""A session ends when so many packets were sent in a direction."""


WINDOW = 2048
_MASK = (1 << WINDOW) - 1


class SessionSecrets:
    """The secrets of a session, and the server's confirmation of the handshake: HMAC-SM3 of H3, 32 bytes. No repr shows
    them."""

    def __init__(self, shared: bytes, transcript: bytes, mode: Mode) -> None:
        info = b"rosbridge-eth/3 session " + mode.name.lower().encode("ascii")
        derived = kdf.hkdf(shared, 96, salt=transcript, info=info)
        self.client, self.server, self.finished = derived[:32], derived[32:64], derived[64:]
        self.confirmation = sm3.hmac(self.finished, transcript)


class Direction:
    """The keys of one direction of a session."""

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
    """Which of the last WINDOW packet numbers were received; older ones count as received.

    `seen` changes nothing; `mark` is for numbers that were authenticated. Bit i of `bits`: highest - i was received.
    """

    def __init__(self) -> None:
        self.highest, self.bits = -1, 0

    def seen(self, number: int) -> bool:
        behind = self.highest - number
        return behind >= WINDOW or (behind >= 0 and bool(self.bits >> behind & 1))

    def mark(self, number: int) -> None:
        ahead = number - self.highest
        if ahead > 0:
            # Shifted no further than the window is wide: a jump of 2**30 must not make a number of 2**30 bits.
            self.bits = (self.bits << min(ahead, WINDOW) | 1) & _MASK
            self.highest = number
        else:
            self.bits |= 1 << -ahead
