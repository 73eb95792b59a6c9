"""A network made of a seed: it loses, doubles, delays, reorders and corrupts datagrams, queues them, and moves hosts.

Whole conversations in simulated time, no socket, no sleeping, the same every time for the same seed.
"""

from __future__ import annotations

import heapq
import random
from collections.abc import Callable
from dataclasses import dataclass

from rosbridge_eth.channel import Address, Client, Event, Server


@dataclass(frozen=True, slots=True)
class Faults:
    """What happens to a datagram: probabilities from 0 to 1, times in seconds."""

    loss: float = 0.0
    duplication: float = 0.0
    corruption: float = 0.0
    delay: float = 0.02
    jitter: float = 0.0
    """Up to so much more delay, drawn for each datagram: what reorders them."""
    rate: float = 0.0
    """Bytes a second towards each host; 0: no limit."""
    queue: int = 1 << 30
    """Bytes that wait at most for a host; what does not fit is lost."""


class Host:
    """An endpoint at an address, and what is done with its events."""

    def __init__(self, endpoint: Client | Server, address: Address, on_event: Callable[[Event], None]) -> None:
        self.endpoint = endpoint
        self.address = address
        self.on_event = on_event


class Network:
    """Hosts, datagrams on their way, and the time. `run` goes on until nothing is left to do or a condition holds."""

    def __init__(self, seed: int, faults: Faults, *, start: float = 1000.0) -> None:
        self.now = start
        self.faults = faults
        self.random = random.Random(seed)
        self.hosts: list[Host] = []
        self.delivered = 0
        self.watch: Callable[[bytes, Address, Address], None] | None = None
        """Called with every datagram sent (data, from, to), before its fate is drawn."""
        self._free_at: dict[Address, float] = {}  # when the link to a host has sent what waits for it
        self._on_the_way: list[tuple[float, int, bytes, Address, Address]] = []
        self._calls: list[tuple[float, int, Callable[[], None]]] = []
        self._count = 0

    def attach(self, endpoint: Client | Server, address: Address, on_event: Callable[[Event], None]) -> Host:
        host = Host(endpoint, address, on_event)
        self.hosts.append(host)
        return host

    def at(self, when: float, call: Callable[[], None]) -> None:
        """Call `call` at the time `when`."""
        self._count += 1
        heapq.heappush(self._calls, (when, self._count, call))

    def inject(self, data: bytes, source: Address, target: Address, delay: float = 0.0) -> None:
        """Let somebody send a datagram with any source address; it arrives unharmed."""
        self._count += 1
        heapq.heappush(self._on_the_way, (self.now + delay, self._count, data, source, target))

    def send(self, data: bytes, source: Address, target: Address) -> None:
        """Draw a datagram's fate."""
        if self.watch is not None:
            self.watch(data, source, target)
        faults, draw = self.faults, self.random
        if draw.random() < faults.loss:
            return
        copies = 2 if draw.random() < faults.duplication else 1
        for _ in range(copies):
            if data and draw.random() < faults.corruption:
                data = self._corrupted(data)
            waits = 0.0
            if faults.rate:
                waits = max(0.0, self._free_at.get(target, 0.0) - self.now)
                if waits * faults.rate + len(data) > faults.queue:
                    continue
                waits += len(data) / faults.rate
                self._free_at[target] = self.now + waits
            self.inject(data, source, target, waits + faults.delay + draw.random() * faults.jitter)

    def _corrupted(self, data: bytes) -> bytes:
        draw = self.random
        if draw.random() < 0.2:
            return data[: draw.randrange(len(data))]
        damaged = bytearray(data)
        for _ in range(draw.randint(1, 3)):
            damaged[draw.randrange(len(damaged))] ^= 1 << draw.randrange(8)
        return bytes(damaged)

    def settle(self) -> None:
        """Hand out every event there is, and let every host send what it may send now."""
        for host in self.hosts:
            while (event := host.endpoint.next_event()) is not None:
                host.on_event(event)
        for host in self.hosts:
            for data, target in host.endpoint.datagrams_to_send(self.now):
                self.send(data, host.address, target)

    def step(self) -> bool:
        """Go on to the next thing that happens; False if there is none."""
        self.settle()
        times = [when for host in self.hosts if (when := host.endpoint.next_timer()) is not None]
        times += [queue[0][0] for queue in (self._on_the_way, self._calls) if queue]
        if not times:
            return False
        self.now = max(self.now, min(times))
        while self._calls and self._calls[0][0] <= self.now:
            heapq.heappop(self._calls)[2]()
        while self._on_the_way and self._on_the_way[0][0] <= self.now:
            _, _, data, source, target = heapq.heappop(self._on_the_way)
            for host in self.hosts:
                if host.address == target:
                    host.endpoint.receive_datagram(data, source, self.now)
                    self.delivered += 1
        for host in self.hosts:
            when = host.endpoint.next_timer()
            if when is not None and when <= self.now:
                host.endpoint.handle_timer(self.now)
        return True

    def run(self, until: Callable[[], bool], *, limit: float = 600.0) -> bool:
        """Step until `until()`; False if `limit` simulated seconds pass, or nothing can happen, before it holds."""
        end = self.now + limit
        while True:
            self.settle()
            if until():
                return True
            if self.now >= end or not self.step():
                return until()
