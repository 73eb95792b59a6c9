"""A robot's log from one or more nodes of a chain: who is asked for what, and what is told if they disagree."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import TYPE_CHECKING

from rosbridge_eth.config.values import time_text
from rosbridge_eth.errors import ChainError, ConfigError, IdentityError
from rosbridge_eth.identity import Trust, check_name
from rosbridge_eth.log.chunk import Chunk, Log, robot_id
from rosbridge_eth.reading.memo import Memo
from rosbridge_eth.reading.verdict import Bookmark, Bookmarks, Kind, Links, Progress, Verdict, shown
from rosbridge_eth.reading.verify import EVERYTHING, Choice, Place, ProvenRecord, Verifier, digest_of
from smcrypto import sm2

if TYPE_CHECKING:
    from rosbridge_eth.ledger.contract import Block, DataEvent, Ledger, RegistrationEvent, Standing

MAX_TOPICS = 1_000
BEHIND = 8
"""Blocks by which a node may be behind another without being told: they are asked one after the other."""


@dataclass(frozen=True, slots=True)
class Reading:
    """A robot's log while it is read: first `records` to the end; then `verdict`, then `keep`.

    proven: all records, of which `records` takes those that are chosen.
    top: the block up to which is read. ledger: on the node that is read. registrations: all of them, as it says.
    trust: of who reads. now: seconds since 1970, by the reader's clock. topics: that were read so far.
    """

    verifier: Verifier
    proven: Iterator[ProvenRecord]
    nodes: Sequence[str]
    top: Block
    ledger: Ledger
    registrations: Sequence[RegistrationEvent]
    trust: Trust
    now: float
    memo: Memo | None = None
    topics: set[str] = field(default_factory=set)

    def records(self, choice: Choice = EVERYTHING, first: int = 0) -> Iterator[ProvenRecord]:
        """Those that are chosen, from the chunk of index `first` on."""
        return choice.choose(record for record in self._noted() if record.place.chunk >= first)

    def _noted(self) -> Iterator[ProvenRecord]:
        """All of them. The topics are for who named one that is not there: MAX_TOPICS at most, whatever a log holds."""
        for record in self.proven:
            if len(self.topics) < MAX_TOPICS:
                self.topics.add(record.content.topic)
            yield record

    def again(self, places: Iterable[Place]) -> Iterator[tuple[DataEvent, int, Chunk]]:
        """Of a log that is read to its end, these chunks once more, with index and batch: a reading keeps none.

        ChainError where the node does not show again what it showed.
        """
        wanted = {place.chunk: place for place in places}
        blocks = {place.block for place in wanted.values()}
        tk = self.verifier.log.tk
        for event in self.ledger.data_events(tk, min(blocks), max(blocks)) if blocks else ():
            for index, encoded in enumerate(event.chunks, event.first):
                place = wanted.get(index)
                if place is not None and (place.digest, place.block) == (digest_of(encoded), event.block):
                    del wanted[index]
                    yield event, index, Chunk.parse(encoded)
        if wanted:
            raise ChainError(f"{shown(self.ledger.url)} does not show again what it showed; do it once more")

    def verdict(self) -> Verdict:
        return self.verifier.verdict(self.nodes)

    def close(self) -> None:
        if self.memo is not None:
            self.memo.close()

    def keep(self, bookmarks: Bookmarks, *, confirm: bool = False) -> None:
        """Write the bookmark. confirm: the reader has compared the fingerprints of new certificates."""
        bookmark = self.verifier.bookmark(confirm=confirm)
        if bookmark is not None:
            time = min(self.top.time, self.now) if self.verifier.honest else bookmark.time
            bookmarks.put(self.verifier.log, replace(bookmark, time=time))


def read_robot(
    ledgers: Sequence[Ledger], name: str, *, trust: Trust, reader: sm2.PrivateKey | None, now: float,
    bookmarks: Bookmarks | None = None, memo: Path | None = None, confirmations: int = 1,
    before: Reading | None = None, granted: Mapping[bytes, bytes] | None = None,
) -> Reading:  # fmt: skip
    """Begin to read a robot's log; nothing of it is fetched before it is asked for.

    ledgers: the contract on one node or several; the first that answers is read, up to a block that all have, and what
    the others say of the robot there is compared. memo: a folder for the facts that need not be proven again.
    confirmations: read up to the block that has so many, itself counted. granted: see Verifier. before: a reading that
    came to its end; this one goes on behind it if the chain and the registrations are the same up to there. Raises
    ChainError; ConfigError for nodes of different ledgers; IdentityError for a name that the contract does not know.
    """
    tk = robot_id(check_name(name))
    ledger, top, standing, registrations, told, differing = _compared(ledgers, tk, confirmations)
    block = top.number
    if standing.account is None and not differing:
        raise IdentityError(
            f"no robot of the name {name} is registered in the contract {ledger.contract}; the operator's `status`"
            " lists the names there are"
        )
    log = Log(ledger.ledger, tk)
    mark = None if bookmarks is None else bookmarks.get(log)
    if mark is not None and standing.chunks < mark.count:
        if _is_above(ledger, tk, mark, block):
            mark = replace(mark, count=0)
        elif top.time < mark.time:
            raise ChainError(
                f"node {shown(ledger.url)} is behind: its block {block:,} is of {time_text(int(top.time * 10**9))}, and"
                f" what was read before of {time_text(int(mark.time * 10**9))}; wait until it has caught up, or name"
                " another node"
            )
    at, links, first_block = Progress(), Links(), registrations[0].block if registrations else 0
    if before is not None and not differing and _goes_on(ledger, before, block, registrations):
        at, links, first_block = before.verifier.progress(), before.verifier.links, before.top.number + 1
    facts = None
    if memo is not None and reader is not None:
        facts = Memo(memo / f"{name}-{log.ledger.hex()[:16]}.sqlite", reader)
    verifier = Verifier(
        name, log.ledger, standing, registrations, trust=trust, reader=reader, block=block,
        block_time=ledger.block_time, now=now, mark=mark, at=at, links=links, granted=granted, facts=facts,
    )  # fmt: skip
    for difference in differing:
        verifier.findings.add(Kind.CONTRADICTED, max(0, standing.chunks - 1), detail=difference)
    records = verifier.read(ledger.data_events(tk, first_block, standing.data_block))
    return Reading(verifier, _settled(ledger, top, records), told, top, ledger, registrations, trust, now, facts)


def _goes_on(ledger: Ledger, before: Reading, block: int, registrations: Sequence[RegistrationEvent]) -> bool:
    """Whether this node says again what the reading before was told: its last block, so all before, and who signs."""
    known = before.registrations
    return (
        before.verifier.honest and before.top.number <= block and registrations[: len(known)] == known
        and ledger.block(before.top.number).hash == before.top.hash
    )  # fmt: skip


def _is_above(ledger: Ledger, tk: bytes, mark: Bookmark, block: int) -> bool:
    """Whether the node shows the bookmark's chunk above the block: then it is not taken back, only not read yet."""
    [standing] = ledger.standings([tk])
    for event in ledger.newest_data(tk, standing.data_block):
        if event.block <= block:
            break
        if event.first < mark.count:
            ours = event.chunks[mark.count - event.first - 1 : mark.count - event.first]
            return [digest_of(encoded).hex() for encoded in ours] == [mark.digest]
    return False


def _settled(ledger: Ledger, top: Block, records: Iterator[ProvenRecord]) -> Iterator[ProvenRecord]:
    """The records; then ChainError if the chain was reorganised meanwhile: what is not there may have moved."""
    yield from records
    if ledger.block(top.number).hash != top.hash:
        raise ChainError(
            f"the chain of {shown(ledger.url)} was reorganised while it was read; read again, with more confirmations"
        )


def _compared(
    ledgers: Sequence[Ledger], tk: bytes, confirmations: int
) -> tuple[Ledger, Block, Standing, list[RegistrationEvent], list[str], list[str]]:
    """The first node that answers, the newest block that all have, and what is said of the robot there.

    Then what is told of nodes, and what one of them says otherwise, or cannot say of that block.
    """
    heads: list[tuple[Ledger, int]] = []
    told: list[str] = []
    for ledger in ledgers:
        try:
            heads.append((ledger, ledger.block_number()))
            if ledger.ledger != heads[0][0].ledger:
                raise ConfigError(f"{heads[0][0].url} and {ledger.url} are not of one chain and contract")
        except ChainError as error:
            if len(ledgers) == 1:
                raise
            told.append(f"node {shown(ledger.url)}: {shown(str(error))}")
    if not heads:
        raise ChainError("none of the nodes answers: " + "; ".join(told))
    newest, oldest = max(head for _, head in heads), min(head for _, head in heads)
    told += [
        f"node {shown(ledger.url)} is {newest - head:,} blocks behind; all are read up to what it has"
        for ledger, head in heads if newest - head > BEHIND
    ]  # fmt: skip
    block = max(0, oldest - confirmations + 1)
    ledger, differing = heads[0][0], list[str]()
    try:
        top, said = ledger.block(block), _said(ledger, tk, block)
    except ChainError as error:
        raise ChainError("; ".join([str(error), *told])) from error
    for other, _ in heads[1:]:
        try:
            differing += [f"{shown(other.url)} {what}" for what in _differences(said, _said(other, tk, block))]
        except ChainError as error:
            differing.append(f"{shown(other.url)} does not answer for block {block}: {shown(str(error))}")
    return ledger, top, *said, told, differing


def _said(ledger: Ledger, tk: bytes, block: int) -> tuple[Standing, list[RegistrationEvent]]:
    [standing] = ledger.standings([tk], block)
    return standing, ledger.registrations(tk, standing)


def _differences(
    one: tuple[Standing, list[RegistrationEvent]], other: tuple[Standing, list[RegistrationEvent]]
) -> Iterator[str]:
    for name, ours, theirs in zip(one[0]._fields, one[0], other[0], strict=True):
        if ours != theirs:
            ours, theirs = (value.hex() if isinstance(value, bytes) else value for value in (ours, theirs))
            yield f"has another {name}: {shown(str(theirs))}, not {shown(str(ours))}"
    if one[1] != other[1]:
        yield "shows other registrations"
