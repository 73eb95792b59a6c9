"""The life of a transaction that the submitter owns, as one table.

A job is a batch, a top-up of a robot's account, or a filler that uses up a
nonce. Its state changes in the journal only, by an event of this table and
together with everything that belongs to it, in one SQLite transaction. A pair
that is not in the table is an error of the program: WrongTransition.
"""

from __future__ import annotations

from enum import StrEnum


class Kind(StrEnum):
    BATCH = "batch"
    TOP_UP = "top-up"  # allocETH to a robot's account, from the operator's
    FILLER = "filler"  # nothing, to oneself: a nonce that nothing else will use


class State(StrEnum):
    SEALED = "sealed"  # what is to be written is on disk; no nonce, or that of its parent
    READY = "ready"  # nonce and signed transaction are on disk; to be sent
    PENDING = "pending"  # a node took it
    INCLUDED = "included"  # in a block
    CONFIRMED = "confirmed"  # N blocks deep
    ACKNOWLEDGED = "acknowledged"  # and whoever waited for it has been told
    SPLIT = "split"  # two halves stand in its place, but its nonce is not settled yet
    VOID = "void"  # something else stands in its place for good
    DEAD = "dead"  # can never be written; its record is a dead letter


class Event(StrEnum):
    SIGNED = "signed"
    ACCEPTED = "accepted"
    BUMPED = "bumped"
    DROPPED = "dropped"
    MINED = "mined"
    FAILED = "failed"
    SUPERSEDED = "superseded"
    REINDEXED = "reindexed"
    HALVED = "halved"
    REFUSED = "refused"
    OVERTAKEN = "overtaken"
    SETTLED = "settled"
    REORGED = "reorged"
    BURIED = "buried"
    ACKNOWLEDGED = "acknowledged"


class WrongTransition(RuntimeError):
    """An event met a state it has no meaning in. A defect here, or two programs at one journal."""


S, E = State, Event
TRANSITIONS: dict[tuple[State, Event], State] = {
    (S.SEALED, E.SIGNED): S.READY,  # nonce and raw transaction are on disk
    (S.SEALED, E.REINDEXED): S.SEALED,  # another batch has the index: the next one
    (S.SEALED, E.HALVED): S.VOID,  # refused before it had a nonce
    (S.SEALED, E.REFUSED): S.DEAD,  # the one bad record
    (S.READY, E.ACCEPTED): S.PENDING,  # "already known" is acceptance
    (S.READY, E.BUMPED): S.READY,  # refused as underpriced
    (S.READY, E.MINED): S.INCLUDED,  # a crash fell after the broadcast
    (S.PENDING, E.BUMPED): S.READY,  # same nonce, both fees up by 10 % or more
    (S.PENDING, E.DROPPED): S.READY,  # the same bytes again
    (S.PENDING, E.MINED): S.INCLUDED,
    (S.INCLUDED, E.BURIED): S.CONFIRMED,  # N blocks deep
    (S.CONFIRMED, E.ACKNOWLEDGED): S.ACKNOWLEDGED,
    # The chain changes its mind.
    (S.INCLUDED, E.REORGED): S.PENDING,
    (S.CONFIRMED, E.REORGED): S.PENDING,
    (S.ACKNOWLEDGED, E.REORGED): S.PENDING,
    # The nonce is spent and the job is not done: it needs another one. Its index keeps it from being done twice.
    (S.READY, E.FAILED): S.SEALED,  # mined and reverted
    (S.PENDING, E.FAILED): S.SEALED,
    (S.READY, E.SUPERSEDED): S.SEALED,  # a transaction that is not ours has the nonce
    (S.PENDING, E.SUPERSEDED): S.SEALED,
    (S.SEALED, E.SUPERSEDED): S.SEALED,  # the nonce was its parent's
    # A filler whose nonce something else has used up has nothing left to do.
    (S.SEALED, E.SETTLED): S.VOID,
    (S.READY, E.SETTLED): S.VOID,
    (S.PENDING, E.SETTLED): S.VOID,
    # It will never be mined as it is: halves under the same nonce, or a filler in its place.
    (S.READY, E.HALVED): S.SPLIT,
    (S.PENDING, E.HALVED): S.SPLIT,
    (S.READY, E.REFUSED): S.DEAD,
    (S.PENDING, E.REFUSED): S.DEAD,
    (S.SPLIT, E.SETTLED): S.VOID,  # what took its nonce is N blocks deep
    (S.SPLIT, E.MINED): S.INCLUDED,  # it was mined after all
    (S.DEAD, E.MINED): S.INCLUDED,
    # Its parent was mined after all.
    (S.SEALED, E.OVERTAKEN): S.VOID,
    (S.READY, E.OVERTAKEN): S.VOID,
    (S.PENDING, E.OVERTAKEN): S.VOID,
    (S.SPLIT, E.OVERTAKEN): S.VOID,
    (S.DEAD, E.OVERTAKEN): S.VOID,
}
del S, E

OPEN = (State.SEALED, State.READY, State.PENDING, State.INCLUDED, State.SPLIT)
IN_FLIGHT = (State.READY, State.PENDING)
SETTLED = (State.CONFIRMED, State.ACKNOWLEDGED)


def after(state: State, event: Event) -> State:
    """The state that `event` leads to; WrongTransition if the table has no such pair."""
    try:
        return TRANSITIONS[state, event]
    except KeyError:
        raise WrongTransition(f"a transaction that is {state} cannot be {event}") from None
