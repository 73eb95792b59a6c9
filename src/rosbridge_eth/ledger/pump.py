"""Between the submitter and a node: asks what it wants asked and hands the answers back.

The node's failures are answers like any other. Everything else that goes wrong
(a full disk, a lost lease) ends the pump: the journal is then as it was before.
"""

from __future__ import annotations

import time
from collections.abc import Callable
from threading import Event

from rosbridge_eth.ledger.chain import Chain
from rosbridge_eth.ledger.failures import NodeFailure
from rosbridge_eth.ledger.submitter import (
    AccountView,
    Action,
    Answer,
    Broadcast,
    EstimateGas,
    FetchReceipts,
    Probe,
    ReadAccount,
    ReadBlock,
    ReadHead,
    Submitter,
)

MAX_ROUNDS = 1_000
LONGEST_PAUSE = 1.0  # seconds; how long `stop` may have to wait


def perform(chain: Chain, action: Action) -> Answer:
    """Ask the node one thing."""
    try:
        match action:
            case ReadHead():
                return chain.head(), chain.priority_fee()
            case ReadAccount(account, deep_block):
                nonce, deep_nonce = chain.nonce(account), chain.nonce(account, deep_block)
                return AccountView(nonce, deep_nonce, chain.balance(account))
            case ReadBlock(number):
                return chain.block(number)
            case EstimateGas(_, call):
                return chain.estimate_gas(call)
            case Broadcast(attempts):
                return chain.send([attempt.raw for attempt in attempts])
            case FetchReceipts(_, _, attempts):
                return chain.receipts([attempt.hash for attempt in attempts])
            case Probe(_, tx_hash):
                return chain.knows(tx_hash)
    except NodeFailure as failure:
        return failure


def pump(submitter: Submitter, chain: Chain, now: float, *, clock: Callable[[], float] | None = None) -> int:
    """Do all that can be done at `now`; how many questions it took.

    clock: read as each answer comes, so that latencies count the node's time;
    without it every answer counts as of `now`. What becomes due meanwhile is
    left for the next call, or a slow node would never let this one end.
    """
    asked, answered_at = 0, now
    for _ in range(MAX_ROUNDS):
        actions = submitter.actions(now)
        if not actions:
            break
        for action in actions:
            answer = perform(chain, action)
            if clock is not None:
                answered_at = max(answered_at, clock())  # a wall clock may be set back
            submitter.handle(action, answer, answered_at)
        asked += len(actions)
    return asked


def run(
    submitter: Submitter,
    chain: Chain,
    stop: Event,
    *,
    wake: Event | None = None,
    clock: Callable[[], float] = time.time,
) -> None:
    """Pump until `stop` is set; `wake` cuts a pause short, for instance when something was sealed."""
    pause = wake or stop
    while not stop.is_set():
        pump(submitter, chain, clock())
        now = clock()
        if pause.wait(max(0.0, min(submitter.next_timer(now) - now, LONGEST_PAUSE))) and pause is not stop:
            pause.clear()
    submitter.close()
