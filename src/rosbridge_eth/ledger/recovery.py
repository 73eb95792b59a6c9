"""A journal made anew from the chain, when the old one is lost.

What is on the chain need not be written again, and must not: `adopt_history`
puts every batch that the contract has into the journal, so that records which
robots send once more are recognised.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from itertools import groupby

from rosbridge_eth.ledger.contract import Contract
from rosbridge_eth.ledger.history import ChainRecord, fetch
from rosbridge_eth.ledger.journal import Journal


def missing_batches(journal: Journal, contract: Contract, robots: Iterable[bytes]) -> dict[bytes, int]:
    """Robots (Tk) of which the contract counts more batches than the journal has seen included, and how many more."""
    missing = {}
    for robot in robots:
        lacking = contract.robot(robot).batches - journal.included(robot)
        if lacking > 0:
            missing[robot] = lacking
    return missing


def adopt_history(
    journal: Journal,
    contract: Contract,
    robots: Iterable[bytes],
    now: float,
    *,
    progress: Callable[[bytes, int], None] | None = None,
) -> int:
    """Take over what the chain has of these robots; how many batches were new here.

    VerificationError where the node's account is not sound: a journal with holes
    would let records be written twice. `progress(robot, records)` after each robot.
    """
    adopted = 0
    for robot in robots:
        history = fetch(contract.chain, contract, robot)
        history.require_sound()
        for index, items in groupby(history.records, key=_batch):
            adopted += _adopt(journal, index, list(items), now)
        if progress is not None:
            progress(robot, len(history.records))
    return adopted


def _batch(item: ChainRecord) -> int:
    return item.batch_index


def _adopt(journal: Journal, index: int, items: list[ChainRecord], now: float) -> bool:
    first = items[0]
    where = (first.tx_hash, first.block_number, first.block_hash)
    return journal.adopt(index, [item.record for item in items], first.sender, where, now)
