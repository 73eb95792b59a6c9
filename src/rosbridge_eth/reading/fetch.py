"""A robot's log from one or more nodes of a chain: who is asked for what, and what is told if they disagree."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from rosbridge_eth.chunk import Log, robot_id
from rosbridge_eth.errors import ChainError, ConfigError, IdentityError
from rosbridge_eth.identity import Trust, check_name
from rosbridge_eth.reading.cache import Cache, add_topics, open_cache
from rosbridge_eth.reading.verdict import Bookmarks, Links, Progress, Verdict, shown
from rosbridge_eth.reading.verify import EVERYTHING, Bodies, Choice, ProvenChunk, ProvenRecord, Verifier
from smcrypto import sm2

if TYPE_CHECKING:
    from rosbridge_eth.ledger.contract import Block, DataEvent, Ledger, Standing

MARGIN = 128
"""Blocks above a batch after which it is kept; the newer ones are asked for again, since a chain may replace them."""


@dataclass(frozen=True, slots=True)
class Reading:
    """A robot's log while it is read: first `records` to the end, or `chunks`; then `verdict`, then `keep`.

    top: the block up to which is read. ledger: on the node that is read. trust, bodies: of who reads. kept: of
    earlier readings; `chunks` are those behind it. topics: that were read so far.
    """

    verifier: Verifier
    chunks: Iterator[ProvenChunk]
    nodes: Sequence[str]
    top: Block
    ledger: Ledger
    trust: Trust
    bodies: Bodies | None = None
    kept: Cache | None = None
    topics: set[str] = field(default_factory=set)

    def records(self, choice: Choice = EVERYTHING, first: int = 0) -> Iterator[ProvenRecord]:
        """Those that are chosen, from the chunk of index `first` on."""
        return choice.choose(self._records(choice, first))

    def _records(self, choice: Choice, first: int) -> Iterator[ProvenRecord]:
        if self.kept is not None and self.kept.progress.count > first:
            yield from (one for one in self.kept.records(choice, self.topics) if one.place.chunk >= first)
        for chunk in self.chunks:
            if chunk.place.chunk >= first:
                add_topics(self.topics, (record.content.topic for record in chunk.records))
                yield from chunk.records

    def verdict(self) -> Verdict:
        return self.verifier.verdict(self.nodes)

    def close(self) -> None:
        if self.kept is not None:
            self.kept.close()

    def keep(self, bookmarks: Bookmarks, *, confirm: bool = False) -> None:
        """Write the bookmark. confirm: the reader has compared the fingerprints of new certificates."""
        bookmark = self.verifier.bookmark(confirm=confirm)
        if bookmark is not None:
            bookmarks.put(self.verifier.log, bookmark)


def read_robot(
    ledgers: Sequence[Ledger], name: str, *, trust: Trust, reader: sm2.PrivateKey | None, now: float,
    bookmarks: Bookmarks | None = None, cache: Path | None = None, confirmations: int = 1,
    bodies: Bodies | None = None, before: Reading | None = None, granted: Mapping[bytes, bytes] | None = None,
) -> Reading:  # fmt: skip
    """Begin to read a robot's log, on the node that has most of it; nothing of it is fetched before it is asked for.

    ledgers: the contract on one node or several. cache: a folder in which what is proven is kept, so that the next
    reading asks only for what is new. confirmations: read up to the block that has so many, itself counted. bodies: of
    archived chunks, and granted: see Verifier. before: a reading that came to its end; this one goes on behind it if
    the chain is the same up to there, and keeps nothing. Raises ChainError; ConfigError for nodes of different ledgers;
    IdentityError for a name that the contract does not know.
    """
    tk = robot_id(check_name(name))
    ledger, top, standing, told = _best(ledgers, tk, confirmations)
    block = top.number
    if standing.account is None:
        raise IdentityError(
            f"no robot of the name {name} is registered in the contract {ledger.contract}; the operator's `status`"
            " lists the names there are"
        )
    log = Log(ledger.ledger, tk)
    mark = None if bookmarks is None else bookmarks.get(log)
    if mark is not None and confirmations > 1 and standing.chunks < mark.count <= ledger.standings([tk])[0].chunks:
        mark = replace(mark, count=0)  # it is above the block that is asked for, and not taken back
    registrations = ledger.registrations(tk, standing)
    at, links, next_block, kept = Progress(), Links(), 0, None
    if before is not None and before.verifier.honest and _is_there(ledger, before.top.number, before.top.hash, block):
        at, links, next_block = before.verifier.progress(), before.verifier.links, before.top.number + 1
    elif cache is not None and reader is not None:
        file = f"{name}-{log.ledger.hex()[:16]}{'' if bodies is None else '-archive'}"
        kept = _kept(partial(open_cache, cache, file, log, reader, trust, granted or {}), ledger, block, told)
        if kept is not None:
            at, links, next_block = kept.progress, kept.links, kept.next_block
    verifier = Verifier(
        name, log.ledger, standing, registrations, trust=trust, reader=reader, block=block,
        block_time=ledger.block_time, now=now, mark=mark, at=at, links=links, bodies=bodies, granted=granted,
        elsewhere=[] if bookmarks is None else bookmarks.other_ledgers(log),
    )  # fmt: skip
    first_block = max(registrations[0].block if registrations else 0, next_block)
    events = ledger.data_events(tk, first_block, standing.data_block)
    if kept is None:
        chunks = verifier.read(events)
    else:
        chunks = _keeping(kept, verifier, events, standing.chunks, ledger.block(max(0, block - MARGIN)))
    return Reading(verifier, _settled(ledger, top, chunks), told, top, ledger, trust, bodies, kept)


def _is_there(ledger: Ledger, number: int, hash_: bytes, block: int) -> bool:
    """Whether the chain up to `block` has this one, and so all that came before it."""
    return number <= block and ledger.block(number).hash == hash_


def _kept(opened: Callable[..., Cache | None], ledger: Ledger, block: int, told: list[str]) -> Cache | None:
    """What earlier readings have proven, if the chain up to there is the same; empty if it is another one."""
    kept = opened()
    if kept is None or kept.block == 0 or _is_there(ledger, kept.block, kept.hash, block):
        return kept
    kept.close()
    if kept.block <= block:
        told.append(f"the chain has another block {kept.block} than at the reading before: all of it was read anew")
        return opened(anew=True)
    told.append(f"what was read before reaches block {kept.block}, above block {block}: it was not used")
    return None


def _keeping(
    kept: Cache, verifier: Verifier, events: Iterator[DataEvent], chunks: int, final: Block
) -> Iterator[ProvenChunk]:
    """The chunks of the events, `chunks` in all; what is in final blocks is kept, unless the node is not honest."""

    def commit(next_block: int, until: int = 0) -> None:
        """until: the chunks that were read, if none was withheld before `next_block`."""
        progress = verifier.progress()
        if verifier.keeps and progress.count >= until and final.number > 0:
            kept.commit(progress, next_block, final.number, final.hash)

    def finals() -> Iterator[DataEvent]:
        for event in events:
            if event.block > final.number:
                commit(final.number + 1, event.first)
                yield event
                break
            yield event
        else:
            commit(final.number + 1, chunks)
        yield from events

    for chunk in verifier.read(finals()):
        if chunk.place.block <= final.number and verifier.keeps:
            kept.add(chunk)
            if kept.full:
                commit(chunk.place.block)
        yield chunk


def _settled(ledger: Ledger, top: Block, chunks: Iterator[ProvenChunk]) -> Iterator[ProvenChunk]:
    """The chunks; then ChainError if the chain was reorganised meanwhile: what is not there may have moved."""
    yield from chunks
    if ledger.block(top.number).hash != top.hash:
        raise ChainError(
            f"the chain of {shown(ledger.url)} was reorganised while it was read; read again, with more confirmations"
        )


def _best(ledgers: Sequence[Ledger], tk: bytes, confirmations: int) -> tuple[Ledger, Block, Standing, list[str]]:
    """The node with the highest count, the block up to which it is read, and what the others say otherwise."""
    answers: list[tuple[Ledger, Block, Standing]] = []
    told: list[str] = []
    for ledger in ledgers:
        try:
            top = ledger.block(max(0, ledger.block_number() - confirmations + 1))
            [standing] = ledger.standings([tk], top.number)
            answers.append((ledger, top, standing))
            if ledger.ledger != answers[0][0].ledger:
                raise ConfigError(f"{answers[0][0].url} and {ledger.url} are not of one chain and contract")
        except ChainError as error:
            if len(ledgers) == 1:
                raise
            told.append(f"node {shown(ledger.url)}: {shown(str(error))}")
    if not answers:
        raise ChainError("none of the nodes answers: " + "; ".join(told))
    best = max(answers, key=lambda answer: answer[2].chunks)
    for ledger, top, standing in answers:
        if standing.chunks != best[2].chunks:
            told.append(f"node {shown(ledger.url)} shows {standing.chunks:,} chunks only, in block {top.number}")
        elif standing.tail != best[2].tail:
            told.append(f"node {shown(ledger.url)} has another last chunk, in block {top.number}: the nodes contradict")
    return *best, told
