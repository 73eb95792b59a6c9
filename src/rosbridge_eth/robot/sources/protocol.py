"""What every kind of source is: something that offers topics and emits the messages of the chosen ones.

Chosen is by topic or by node, by name or by pattern. A node stands for the topics it publishes. Live sources choose
again every few seconds, since nodes and topics come and go.
"""

from __future__ import annotations

import difflib
import threading
import time
from abc import abstractmethod
from collections.abc import Callable, Iterable, Mapping, Sequence
from typing import TYPE_CHECKING, ClassVar, NamedTuple, Protocol, TypeAlias

from rosbridge_eth.capture import Decoder, NamePattern, RawMessage
from rosbridge_eth.errors import SourceError

if TYPE_CHECKING:
    from rosbridge_eth.config import RobotConfig

Emit: TypeAlias = Callable[[RawMessage], None]
"""Takes a message. It may wait for a bag or a simulation; a live source calls it from several threads, and must not
wait."""


class Offer(NamedTuple):
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
    def lost(self) -> Mapping[tuple[str, str], int]:
        """Messages that were published and not emitted, by topic and why; only a live source loses any."""
        return {}

    @abstractmethod
    def run(self, emit: Emit, stop: threading.Event) -> None:
        """Emit messages in receive order until the source ends or `stop` is set. Raises SourceError."""

    def watch(self, selection: Selection) -> None:
        """Watch what this names instead; only a live source does, which looks every few seconds."""
        return

    def close(self) -> None:
        """Release files and sockets. May be called twice."""


class Clock:
    """The machine's clocks, as a source sees time; passed in, so that tests need not wait."""

    def wall_ns(self) -> int:
        """Nanoseconds since 1970."""
        return time.time_ns()

    def monotonic_ns(self) -> int:
        """Nanoseconds since some start, never stepping."""
        return time.monotonic_ns()

    def wait_until(self, monotonic_ns: int, stop: threading.Event) -> bool:
        """Wait until then or until `stop` is set; whether it is set."""
        return stop.wait(max(0, monotonic_ns - time.monotonic_ns()) / 1e9)


class Selection:
    """Names and patterns of topics and of nodes; a topic is watched if any of them means it.

    names_nodes: nodes are to be watched, so the source must know who publishes.
    named_topics: those that are asked for by name, with their leading slash: known before anybody offers them.
    """

    def __init__(self, topics: Iterable[str] = (), nodes: Iterable[str] = ()) -> None:
        """Raises ValueError with a sentence for a malformed pattern."""
        self._topics = [NamePattern(topic) for topic in topics]
        self._nodes = [NamePattern(node) for node in nodes]
        self.names_nodes = bool(self._nodes)
        self.named_topics = tuple(dict.fromkeys(pattern.text for pattern in self._topics if pattern.is_exact))

    @staticmethod
    def of(config: RobotConfig) -> Selection:
        return Selection([topic.topic for topic in config.topics], config.nodes)

    def wants(self, offer: Offer) -> bool:
        """Whether a topic is watched."""
        return any(pattern.matches(offer.topic) for pattern in self._topics) or any(
            pattern.matches(node) for pattern in self._nodes for node in offer.nodes
        )

    def resolve(self, offers: Iterable[Offer]) -> tuple[Offer, ...]:
        """The watched topics among those offered."""
        return tuple(offer for offer in offers if self.wants(offer))

    def unmatched(self, offers: Sequence[Offer]) -> tuple[str, ...]:
        """The names and patterns that mean nothing of what is offered."""
        nodes = {node for offer in offers for node in offer.nodes}
        return (
            *(p.text for p in self._topics if not any(p.matches(offer.topic) for offer in offers)),
            *(p.text for p in self._nodes if not any(p.matches(node) for node in nodes)),
        )

    def resolve_all(self, offers: Sequence[Offer], where: str) -> tuple[Offer, ...]:
        """As resolve, for a source that will not offer more: SourceError if a name means nothing of it.

        A pattern may match nothing as long as something is watched.
        """
        chosen = self.resolve(offers)
        exact = {pattern.text for pattern in (*self._topics, *self._nodes) if pattern.is_exact}
        missing = [name for name in self.unmatched(offers) if name in exact or not chosen]
        if not missing and chosen:
            return chosen
        names = [*(offer.topic for offer in offers), *(node for offer in offers for node in offer.nodes)]
        near = difflib.get_close_matches(missing[0], names, 1) if missing else []
        hint = f"did you mean {near[0]}? It" if near else "it"
        nodes = " and does not say which nodes published" if self.names_nodes and len(names) == len(offers) else ""
        topics = ", ".join(map(str, offers[:20])) or "no topics"
        raise SourceError(f"{where} has no topic or node {', '.join(missing)}; {hint} has {topics}{nodes}")
