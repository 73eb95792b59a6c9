"""A bad network on one machine: a UDP relay that loses, doubles and reorders what passes through it.

For `demo --loss`, and for tests where the kernel's own (tc netem) is not
permitted. One client at a time is told from the server by its address.
"""

from __future__ import annotations

import contextlib
import random
import select
import socket
import threading
from collections.abc import Callable
from dataclasses import dataclass

LONGEST = 65_535


@dataclass(frozen=True, slots=True)
class Harm:
    """Probabilities for each datagram, each way; `seed` makes a run repeatable as far as its timing is."""

    loss: float = 0.0
    duplicate: float = 0.0
    reorder: float = 0.0
    seed: int = 1


class Relay:
    """Listens on 127.0.0.1:`port` and passes datagrams to and from `server`. Ends with `close`.

    on_datagram: is given every datagram that arrives, before harm is done to it.
    """

    def __init__(
        self, server: tuple[str, int], harm: Harm, on_datagram: Callable[[bytes], None] = lambda data: None
    ) -> None:
        self._server, self._harm, self._on_datagram = server, harm, on_datagram
        self._random = random.Random(harm.seed)  # noqa: S311 - a bad network, not a secret
        self._near, self._far = (socket.socket(socket.AF_INET, socket.SOCK_DGRAM) for _ in range(2))
        self._near.bind(("127.0.0.1", 0))
        self._far.bind(("127.0.0.1", 0))
        self.port: int = self._near.getsockname()[1]
        self._client: tuple[str, int] | None = None
        self._held: dict[socket.socket, tuple[bytes, tuple[str, int]]] = {}
        self.lost = 0  # datagrams
        self._stop = threading.Event()
        self._thread = threading.Thread(target=self._run, name="relay", daemon=True)
        self._thread.start()

    def close(self) -> None:
        self._stop.set()
        self._thread.join(5)
        self._near.close()
        self._far.close()

    def _run(self) -> None:
        while not self._stop.is_set():
            for sock in select.select([self._near, self._far], [], [], 0.05)[0]:
                try:
                    data, sender = sock.recvfrom(LONGEST)
                except OSError:
                    continue  # news that a datagram found nobody; UDP promises no more
                self._on_datagram(data)
                if sock is self._near:
                    self._client = sender
                    self._pass(self._far, data, self._server)
                elif self._client is not None:
                    self._pass(self._near, data, self._client)

    def _pass(self, out: socket.socket, data: bytes, to: tuple[str, int]) -> None:
        chance = self._random.random
        if chance() < self._harm.loss:
            self.lost += 1
            return
        if out not in self._held and chance() < self._harm.reorder:
            self._held[out] = data, to  # goes after the next one
            return
        going = [(data, to)] * (2 if chance() < self._harm.duplicate else 1)
        if out in self._held:
            going.append(self._held.pop(out))
        for each in going:
            with contextlib.suppress(OSError):  # lost, too
                out.sendto(*each)
