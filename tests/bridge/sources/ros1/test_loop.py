"""Names that hang: the master's is answered beside them."""

from __future__ import annotations

import socket
import threading
import time

from bridge.sources.ros1.graph import Listening, eventually
from bridge.sources.ros1.impostors import GOOD, Master, Publisher, closing_all, counting


def test_names_that_never_resolve_do_not_keep_us_from_the_master(monkeypatch):
    real, released = socket.getaddrinfo, threading.Event()

    def slow(host, *arguments, **options):
        if str(host).endswith(".slow"):
            released.wait(30)
            raise socket.gaierror(-3, "Temporary failure in name resolution")
        return real(host, *arguments, **options)

    monkeypatch.setattr(socket, "getaddrinfo", slow)
    master, honest = Master(), Publisher(counting(GOOD))
    master.publishers["/t"] = [f"http://robot_{n}.slow:1/" for n in range(40)]
    with closing_all(master, honest):
        by_name = master.uri.replace("127.0.0.1", "localhost")
        with Listening(by_name, ["/t", "/good_*"], timeout=0.5) as listening:
            eventually(lambda: listening.ended("/t") > 40, "the names are asked for")
            master.publishers["/good_1"] = [honest.uri]
            listening.wait_for("/good_1", 10)
            started = time.monotonic()
        assert time.monotonic() - started < 2
        released.set()
