"""A bad network on one machine: a UDP relay that loses, doubles and reorders what passes through it.

For tests where the kernel's own (tc netem) is not permitted. One client at a time is told from
the server by its address.
"""

from __future__ import annotations

import contextlib
import random
import socket
import threading
from collections.abc import Callable
from dataclasses import dataclass

LONGEST = 65_535
Place = tuple[str, int]


@dataclass(frozen=True, slots=True)
class Harm:
    """Probabilities for each datagram, each way; `seed` makes a run repeatable as far as its timing is."""

    loss: float = 0.0
    duplicate: float = 0.0
    reorder: float = 0.0
    seed: int = 1


class Relay:
    """Listens on 127.0.0.1:`port` and passes datagrams to and from `server`. Ends with `close`.

    on_datagram: is given every datagram that arrives, before harm is done to it. lost: datagrams.
    """

    def __init__(self, server: Place, harm: Harm, on_datagram: Callable[[bytes], None] = lambda data: None) -> None:
        self._server, self._harm, self._on_datagram = server, harm, on_datagram
        self._chance = random.Random(harm.seed).random
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.bind(("127.0.0.1", 0))
        self._socket.settimeout(0.05)
        self.port: int = self._socket.getsockname()[1]
        self._held: dict[Place, bytes] = {}
        self.lost = 0
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="relay", daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._stop.set()
        self._thread.join(5)
        self._socket.close()

    def _run(self) -> None:
        client: Place | None = None
        while not self._stop.is_set():
            try:
                data, sender = self._socket.recvfrom(LONGEST)
            except OSError:
                continue  # nothing came; or a datagram met a closed port
            self._on_datagram(data)
            if sender != self._server:
                client = sender
                self._pass(data, self._server)
            elif client is not None:
                self._pass(data, client)

    def _pass(self, data: bytes, to: Place) -> None:
        if self._chance() < self._harm.loss:
            self.lost += 1
            return
        if to not in self._held and self._chance() < self._harm.reorder:
            self._held[to] = data  # goes after the next one
            return
        going = [data] * (2 if self._chance() < self._harm.duplicate else 1)
        if to in self._held:
            going.append(self._held.pop(to))
        for each in going:
            with contextlib.suppress(OSError):  # lost, too
                self._socket.sendto(each, to)
