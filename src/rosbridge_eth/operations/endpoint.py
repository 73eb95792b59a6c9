"""The figures of an end of the channel: its counters, and what the kernel says of its socket."""

from __future__ import annotations

import socket
import struct
import sys

from rosbridge_eth.channel import Statistics
from rosbridge_eth.operations.figures import Sample, sample

_SO_MEMINFO = 55  # include/uapi/asm-generic/socket.h
_MEMINFO = struct.Struct("=9I")  # include/uapi/linux/sock_diag.h: SK_MEMINFO_RMEM_ALLOC ... SK_MEMINFO_DROPS
_DROPS = 8


def socket_overflows(sock: socket.socket) -> int | None:
    """Datagrams that the kernel dropped for want of room in the receive buffer; None where it cannot be asked."""
    if not sys.platform.startswith("linux"):
        return None
    try:
        answer = sock.getsockopt(socket.SOL_SOCKET, _SO_MEMINFO, _MEMINFO.size)
    except OSError:
        return None  # a kernel before 4.12
    return int(_MEMINFO.unpack(answer)[_DROPS]) if len(answer) == _MEMINFO.size else None


def channel_samples(counted: Statistics, sock: socket.socket, lost_sends: int) -> list[Sample]:
    """What both ends publish of their channel."""
    found = [
        sample("datagrams_sent", counted.datagrams_sent),
        sample("datagrams_received", counted.datagrams_received),
        sample("sent_bytes", counted.bytes_sent),
        sample("received_bytes", counted.bytes_received),
        sample("socket_refused", lost_sends),
        sample("packets_lost", counted.packets_lost),
        sample("frames_retransmitted", counted.frames_retransmitted),
        sample("handshakes", counted.handshakes),
        sample("handshakes_begun", counted.handshakes_begun),
        sample("rekeys", counted.rekeys),
        *(sample("datagrams_dropped", number, reason) for reason, number in counted.dropped.items()),
    ]
    overflows = socket_overflows(sock)
    return found if overflows is None else [*found, sample("socket_overflows", overflows)]
