"""Keys of a session, sealed packets, and the replay window.

Key schedule, HKDF with SM3 (RFC 5869). K is the handshake's shared secret, H
the hash of its whole transcript, `mode` the mode's name:

    client ‖ server ‖ client-finished ‖ server-finished (32 each)
        = HKDF(K, salt = H, info = "rosbridge-eth/1 session " ‖ mode)
    key (16) ‖ IV (12) ‖ next secret (32) = HKDF(secret, info = "rosbridge-eth/1 packets")

Each direction has its own secret, and its epochs follow one another by the
next secret: who learns the keys of an epoch learns nothing of the one before.

Packets: SM4-GCM (RFC 8998), nonce = IV ⊕ packet number, the header as
associated data. Packet numbers run through all epochs of a session and are
never used twice.
"""

from __future__ import annotations

import hmac

from rosbridge_eth.channel.wire import DATA_HEADER_SIZE, Mode, data_header
from smcrypto import kdf, sm3, sm4

__all__ = ["Direction", "ReplayWindow", "SessionSecrets", "finished"]

SECRET_SIZE = 32


class SessionSecrets:
    """The four secrets of a session. No repr shows them."""

    __slots__ = ("client", "client_finished", "server", "server_finished")

    def __init__(self, shared: bytes, transcript: bytes, mode: Mode) -> None:
        info = b"rosbridge-eth/1 session " + mode.name.lower().encode("ascii")
        derived = kdf.hkdf(shared, 4 * SECRET_SIZE, salt=transcript, info=info)
        self.client, self.server, self.client_finished, self.server_finished = (
            derived[i : i + SECRET_SIZE] for i in range(0, 4 * SECRET_SIZE, SECRET_SIZE)
        )


def finished(secret: bytes, transcript: bytes) -> bytes:
    """The confirmation of a whole handshake: HMAC-SM3 of its transcript hash, 32 bytes."""
    return hmac.new(secret, transcript, sm3.SM3).digest()


class Direction:
    """The keys of one direction of a session in one epoch; `next_epoch` gives the following one's."""

    __slots__ = ("_aead", "_iv", "_next_secret", "epoch")

    def __init__(self, secret: bytes, epoch: int = 0) -> None:
        derived = kdf.hkdf(secret, 16 + 12 + SECRET_SIZE, info=b"rosbridge-eth/1 packets")
        self._aead = sm4.SM4GCM(derived[:16])
        self._iv = int.from_bytes(derived[16:28], "big")
        self._next_secret = derived[28:]
        self.epoch = epoch

    def next_epoch(self) -> Direction:
        return Direction(self._next_secret, self.epoch + 1)

    def seal(self, cid: bytes, number: int, frames: bytes) -> bytes:
        """The datagram that carries `frames`: header, ciphertext, tag."""
        header = data_header(self.epoch, cid, number)
        return header + self._aead.encrypt((self._iv ^ number).to_bytes(12, "big"), frames, header)

    def open(self, datagram: bytes, number: int) -> bytes:
        """The frames of a datagram whose packet number is `number`, or smcrypto.InvalidTag."""
        return self._aead.decrypt(
            (self._iv ^ number).to_bytes(12, "big"),
            datagram[DATA_HEADER_SIZE:],
            datagram[:DATA_HEADER_SIZE],
        )


class ReplayWindow:
    """Which of the last `size` packet numbers were received; older ones count as received.

    `seen` changes nothing; `mark` is for numbers that were authenticated.
    """

    __slots__ = ("_bits", "_mask", "highest", "size")

    def __init__(self, size: int = 2048) -> None:
        self.size = size
        self.highest = -1
        self._bits = 0  # bit i: highest - i was received
        self._mask = (1 << size) - 1

    def seen(self, number: int) -> bool:
        behind = self.highest - number
        if behind < 0:
            return False
        return behind >= self.size or bool(self._bits >> behind & 1)

    def mark(self, number: int) -> None:
        ahead = number - self.highest
        if ahead > 0:
            # Shifted no further than the window is wide: a jump of 2**40 must not make a number of 2**40 bits.
            self._bits = (self._bits << min(ahead, self.size) | 1) & self._mask
            self.highest = number
        else:
            self._bits |= 1 << -ahead
