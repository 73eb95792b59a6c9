"""What every kind of source is: something that offers topics and emits the messages of the chosen ones."""

from __future__ import annotations

import threading
import time
from abc import abstractmethod
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar, Protocol, TypeAlias

from rosbridge_eth.capture import Decoder, RawMessage

Emit: TypeAlias = Callable[[RawMessage], None]
"""Takes a message; may block, which slows a bag or a simulation down (a live source drops instead)."""


@dataclass(frozen=True, slots=True)
class Offer:
    """A topic that a source has, its type (pkg/msg/Name) and the nodes known to publish it, sorted."""

    topic: str
    type_name: str
    nodes: tuple[str, ...] = ()

    def __str__(self) -> str:
        return f"{self.topic} ({self.type_name})"


class Source(Protocol):
    """A bag, a simulation, a live master. One thread calls `run`; `offers` and `close` may come from another."""

    kind: ClassVar[str]
    """bag, sim, ros1 or ros2: stands in every line of the log."""
    live: ClassVar[bool]
    """Whether topics may still appear: a name that matches nothing is then no error."""

    @abstractmethod
    def offers(self) -> Sequence[Offer]:
        """The topics there are now, sorted by name. Raises SourceError."""

    def decoders(self) -> Mapping[str, Sequence[Decoder]]:
        """The decoders of the chosen topics as far as they are known before the first message; a live source: none."""
        return {}

    @property
    def dropped(self) -> Mapping[str, int]:
        """Messages received but not emitted, `emit` being too slow, by topic; only a live source drops."""
        return {}

    @abstractmethod
    def run(self, emit: Emit, stop: threading.Event) -> None:
        """Emit messages in receive order until the source ends or `stop` is set. Raises SourceError."""

    def close(self) -> None:
        """Release files and sockets. May be called twice."""


class Clock(Protocol):
    """Time as a source sees it; passed in, so that tests need not wait."""

    def wall_ns(self) -> int:
        """Nanoseconds since 1970."""

    def monotonic_ns(self) -> int:
        """Nanoseconds since some start, never stepping."""

    def wait_until(self, monotonic_ns: int, stop: threading.Event) -> bool:
        """Wait until then or until `stop` is set; whether it is set."""


class SystemClock:
    """The machine's clocks."""

    def wall_ns(self) -> int:
        return time.time_ns()

    def monotonic_ns(self) -> int:
        return time.monotonic_ns()

    def wait_until(self, monotonic_ns: int, stop: threading.Event) -> bool:
        remaining = monotonic_ns - time.monotonic_ns()
        return stop.wait(remaining / 1e9) if remaining > 0 else stop.is_set()
