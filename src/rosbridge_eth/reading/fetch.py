"""A robot's log from one or more nodes of a chain: who is asked for what, and what is told if they disagree."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from typing import TYPE_CHECKING

from rosbridge_eth.chunk import Log, robot_id
from rosbridge_eth.errors import ChainError, ConfigError, IdentityError
from rosbridge_eth.identity import Trust, check_name
from rosbridge_eth.reading.verdict import Bookmarks, Verdict, shown
from rosbridge_eth.reading.verify import HEARTBEAT, ProvenChunk, ProvenRecord, Verifier
from smcrypto import sm2

if TYPE_CHECKING:
    from rosbridge_eth.ledger.contract import Ledger, Standing

MARGIN = 128
"""Blocks that are asked for again before a bookmark: a reorganisation moves batches to other blocks."""


@dataclass(frozen=True, slots=True)
class Reading:
    """A robot's log while it is read: first `chunks` or `records` to the end, then `verdict`, then `keep`."""

    verifier: Verifier
    chunks: Iterator[ProvenChunk]
    nodes: tuple[str, ...]

    def records(self) -> Iterator[ProvenRecord]:
        for chunk in self.chunks:
            yield from chunk.records

    def verdict(self) -> Verdict:
        return self.verifier.verdict(self.nodes)

    def keep(self, bookmarks: Bookmarks, *, confirm: bool = False) -> None:
        """Write the bookmark. confirm: the reader has compared the fingerprints of new certificates."""
        bookmark = self.verifier.bookmark(confirm=confirm)
        if bookmark is not None:
            bookmarks.put(self.verifier.log, bookmark)


def read_robot(
    ledgers: Sequence[Ledger],
    name: str,
    *,
    trust: Trust,
    reader: sm2.PrivateKey | None,
    now: float,
    bookmarks: Bookmarks | None = None,
    resume: bool = False,
    confirmations: int = 1,
    heartbeat: float = HEARTBEAT,
) -> Reading:
    """Begin to read a robot's log, on the node that has most of it; nothing of it is fetched before it is asked for.

    ledgers: the contract on one node or several. resume: only what is new since the bookmark. confirmations: read up to
    the block that has so many, itself counted. Raises ChainError; ConfigError for nodes of different ledgers;
    IdentityError for a name that is none, or that the contract does not know.
    """
    tk = robot_id(check_name(name))
    ledger, block, standing, nodes = _best(ledgers, tk, confirmations)
    if standing.account is None:
        raise IdentityError(
            f"no robot of the name {name} is registered in the contract {ledger.contract}; the operator's `status`"
            " lists the names there are"
        )
    log = Log(ledger.ledger, tk)
    mark = None if bookmarks is None else bookmarks.get(log)
    registrations = ledger.registrations(tk, standing)
    verifier = Verifier(
        name, log.ledger, standing, registrations, trust=trust, reader=reader, block=block,
        block_time=ledger.block_time, now=now, mark=mark, resume=resume, heartbeat=heartbeat,
        elsewhere=[] if bookmarks is None else bookmarks.other_ledgers(log),
    )  # fmt: skip
    first_block = registrations[0].block if registrations else 0
    if resume and mark is not None:
        first_block = max(first_block, mark.block - MARGIN)
    events = ledger.data_events(tk, first_block, standing.data_block)
    return Reading(verifier, _settled(ledger, block, verifier.read(events)), nodes)


def _settled(ledger: Ledger, block: int, chunks: Iterator[ProvenChunk]) -> Iterator[ProvenChunk]:
    """The chunks; then ChainError if the chain was reorganised meanwhile: what is not there may have moved."""
    before = ledger.block(block).hash
    yield from chunks
    if ledger.block(block).hash != before:
        raise ChainError(
            f"the chain of {shown(ledger.url)} was reorganised while it was read; read again, with more confirmations"
        )


def _best(ledgers: Sequence[Ledger], tk: bytes, confirmations: int) -> tuple[Ledger, int, Standing, tuple[str, ...]]:
    """The node with the highest count, the block up to which it is read, and what the others say otherwise."""
    answers: list[tuple[Ledger, int, Standing]] = []
    told: list[str] = []
    for ledger in ledgers:
        try:
            block = max(0, ledger.block_number() - confirmations + 1)
            [standing] = ledger.standings([tk], block)
            answers.append((ledger, block, standing))
            if ledger.ledger != answers[0][0].ledger:
                raise ConfigError(f"{answers[0][0].url} and {ledger.url} are not of one chain and contract")
        except ChainError as error:
            if len(ledgers) == 1:
                raise
            told.append(f"node {shown(ledger.url)}: {shown(str(error))}")
    if not answers:
        raise ChainError("none of the nodes answers: " + "; ".join(told))
    best = max(answers, key=lambda answer: answer[2].chunks)
    for ledger, block, standing in answers:
        if standing.chunks != best[2].chunks:
            told.append(f"node {shown(ledger.url)} shows {standing.chunks:,} chunks only, in block {block}")
        elif standing.tail != best[2].tail:
            told.append(f"node {shown(ledger.url)} has another last chunk, in block {block}: the nodes contradict")
    return *best, tuple(told)
