"""What the chain has of a robot's log, read back from its end as far as is needed to compare rows with it.

Chunks stand on the chain in the order of the log, so it is known that a chunk is not there as soon as the one in
front of it, or an earlier one of its stream, was met.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field

from rosbridge_eth.inbox import Head
from rosbridge_eth.ledger.contract import DataEvent
from rosbridge_eth.log.chunk import Chunk, Header, Malformed


@dataclass(slots=True)
class Walk:
    """A reading of a robot's batches back from the last one. final: the block from which on all is confirmed."""

    events: Iterator[DataEvent]
    final: int
    newest: list[bytes] = field(default_factory=list)  # chunks that are not confirmed and the one in front of them
    reached: bool = False  # whether that one was read
    on_chain: set[bytes] = field(default_factory=set)
    heads: dict[bytes, Head] = field(default_factory=dict)
    lowest: dict[bytes, int] = field(default_factory=dict)

    def add(self, event: DataEvent) -> None:
        for encoded in reversed(event.chunks):
            if not self.reached:
                self.newest.append(encoded)
                self.reached = event.block <= self.final
            try:
                header = Chunk.parse(encoded).header
            except Malformed:
                continue  # another program's; no robot has it
            self.on_chain.add(header.digest)
            self.heads.setdefault(header.stream, Head(header.number, header.digest))
            self.lowest[header.stream] = header.number

    def settles(self, header: Header | None) -> bool:
        """Whether it is known by now if this chunk is on the chain (None: none is asked for)."""
        if header is None or not self.reached:
            return self.reached
        met = header.digest in self.on_chain or header.previous in self.on_chain
        return met or self.lowest.get(header.stream, header.number) < header.number
