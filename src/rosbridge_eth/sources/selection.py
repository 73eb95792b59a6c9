"""Which of the topics that a source offers are watched: by topic or by node, by name or by pattern.

A node stands for the topics it publishes. Live sources resolve again every few seconds, since nodes and topics come
and go.
"""

from __future__ import annotations

import difflib
from collections.abc import Iterable, Sequence

from rosbridge_eth.capture import NamePattern
from rosbridge_eth.errors import SourceError
from rosbridge_eth.sources.protocol import Offer

RESOLVE_EVERY = 3.0
"""Seconds after which a live source looks for new topics and nodes."""


class Selection:
    """Names and patterns of topics and of nodes; a topic is watched if any of them means it."""

    def __init__(self, topics: Iterable[str] = (), nodes: Iterable[str] = ()) -> None:
        """Raises ValueError with a sentence for a malformed pattern."""
        self._topics = [NamePattern(topic) for topic in topics]
        self._nodes = [NamePattern(node) for node in nodes]

    @property
    def names_nodes(self) -> bool:
        """Whether nodes are to be watched: the source must know who publishes."""
        return bool(self._nodes)

    @property
    def named_topics(self) -> tuple[str, ...]:
        """The topics that are asked for by name, with their leading slash: known before anybody offers them."""
        return tuple(dict.fromkeys(pattern.text for pattern in self._topics if pattern.is_exact))

    def names(self, topic: str) -> bool:
        """Whether the topic is asked for by its name, not by a pattern or a node."""
        return any(pattern.is_exact and pattern.matches(topic) for pattern in self._topics)

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
        nodes = sorted({node for offer in offers for node in offer.nodes})
        near = difflib.get_close_matches(missing[0], [*(offer.topic for offer in offers), *nodes], 1) if missing else []
        hint = f"did you mean {near[0]}? " if near else ""
        topics = ", ".join(map(str, offers[:20])) or "no topics"
        more = f" and {len(offers) - 20} more" if len(offers) > 20 else ""
        raise SourceError(
            f"{where} has no topic or node {', '.join(missing)}; {hint}"
            f"It has {topics}{more}" + (f", published by {', '.join(nodes[:20])}" if nodes else "")
            + ("" if nodes or not self.names_nodes else "; it does not say which nodes published: name topics")
        )  # fmt: skip
