"""What the kernel says of a socket: datagrams that found the receive buffer full."""

from __future__ import annotations

import socket
import sys

import pytest

from rosbridge_eth.operations.endpoint import socket_overflows


@pytest.mark.skipif(not sys.platform.startswith("linux"), reason="SO_MEMINFO is Linux's")
def test_overflows_are_the_datagrams_that_were_sent_and_never_arrived():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as receiver, \
            socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as sender:
        receiver.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, 4096)
        receiver.bind(("127.0.0.1", 0))
        receiver.setblocking(False)
        assert socket_overflows(receiver) == 0
        for _ in range(200):
            sender.sendto(bytes(1000), receiver.getsockname())
        arrived = 0
        while True:
            try:
                receiver.recv(2000)
            except BlockingIOError:
                break
            arrived += 1
        assert 0 < arrived < 200
        assert socket_overflows(receiver) == 200 - arrived
