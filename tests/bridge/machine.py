"""Real sockets for tests of a worker: one that runs in a thread, and machines that have a session with it."""

from __future__ import annotations

import threading
import time

from rosbridge_eth import identity as ids
from rosbridge_eth.channel import Client, ClientConfig, Event
from rosbridge_eth.channel.udp import UdpLoop, client_socket
from rosbridge_eth.server.reception import Worker

PATIENCE = 30.0  # s, until a test gives up


class Running:
    """A worker that runs in a thread until `stop`; error: what ended it before."""

    def __init__(self, worker: Worker) -> None:
        self.worker = worker
        self.port: int = worker.loop.socket.getsockname()[1]
        self.error: Exception | None = None
        self._stop = threading.Event()
        self.thread = threading.Thread(target=self._run)
        self.thread.start()

    def _run(self) -> None:
        try:
            self.worker.run(self._stop.is_set)
        except Exception as error:
            self.error = error
            self.worker.loop.close()

    def stop(self) -> None:
        self._stop.set()
        self.worker.loop.wake()
        self.thread.join()


class Machine:
    """A client with a socket of its own, in the thread of who calls."""

    def __init__(self, who: ids.Identity, roots: ids.Trust, server: str, port: int) -> None:
        self.client = Client(ClientConfig(), who, roots, server, time.monotonic())
        sock, address = client_socket(("127.0.0.1", port))
        self.events: list[Event] = []
        self.loop = UdpLoop(self.client, sock, self.events.append)
        self.client.connect(address, time.monotonic())

    def until(self, phase: str) -> None:
        end = time.monotonic() + PATIENCE
        while self.client.phase != phase:
            assert time.monotonic() < end, self.client.phase
            self.loop.step(0.2)

    def close(self) -> None:
        self.client.close(time.monotonic())
        self.until("idle")
        self.loop.close()
