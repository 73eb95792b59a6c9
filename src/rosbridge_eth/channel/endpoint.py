"""What both ends of the channel have in common: a datagram is taken, or dropped and counted; events wait."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections import Counter, deque
from collections.abc import Callable
from datetime import UTC, datetime

from rosbridge_eth.channel.admission import Address
from rosbridge_eth.channel.events import Event
from rosbridge_eth.channel.handshake import Randomness
from rosbridge_eth.channel.wire import Kind, Refused


def utc_now() -> datetime:
    return datetime.now(UTC)


class Endpoint(ABC):
    """wall: the clock that certificates are checked against. Not thread-safe."""

    def __init__(self, wall: Callable[[], datetime], randomness: Randomness | None) -> None:
        self._wall, self._randomness = wall, randomness or Randomness()
        self._counts: Counter[str] = Counter()
        self._events: deque[Event] = deque()
        self._outbox: list[tuple[bytes, Address]] = []

    def next_event(self) -> Event | None:
        """The oldest event that was not fetched, or None. Fetch them all in each turn: nothing bounds them."""
        return self._events.popleft() if self._events else None

    def receive_datagram(self, data: bytes, address: Address, now: float) -> None:
        """Take what came; anything that is not right is dropped and counted."""
        self._counts["datagrams_received"] += 1
        self._counts["bytes_received"] += len(data)
        try:
            (self._on_data if data[:1] == bytes((Kind.DATA,)) else self._on_handshake)(data, address, now)
        except Refused as refused:
            self._counts[refused.drop] += 1

    def datagrams_to_send(self, now: float) -> list[tuple[bytes, Address]]:
        """What may go to the network now."""
        self._prepare(now)
        out, self._outbox = self._outbox, []
        self._counts["datagrams_sent"] += len(out)
        self._counts["bytes_sent"] += sum(len(datagram) for datagram, _ in out)
        return out

    @abstractmethod
    def _on_data(self, data: bytes, address: Address, now: float) -> None: ...

    @abstractmethod
    def _on_handshake(self, data: bytes, address: Address, now: float) -> None: ...

    @abstractmethod
    def _prepare(self, now: float) -> None:
        """Put what may be sent now into the outbox."""
