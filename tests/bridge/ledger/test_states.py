"""The submitter's table: closed, without dead ends, and the one the documents show."""

from __future__ import annotations

import pytest

from rosbridge_eth.ledger.states import IN_FLIGHT, OPEN, TRANSITIONS, Event, State, WrongTransition, after


@pytest.mark.parametrize("state", State)
@pytest.mark.parametrize("event", Event)
def test_a_pair_that_is_not_in_the_table_is_an_error(state: State, event: Event):
    if (state, event) in TRANSITIONS:
        assert after(state, event) is TRANSITIONS[state, event]
    else:
        with pytest.raises(WrongTransition, match=f"{state} cannot be {event}"):
            after(state, event)


def reachable(start: State) -> set[State]:
    found, wanted = {start}, [start]
    while wanted:
        state = wanted.pop()
        for (source, _), target in TRANSITIONS.items():
            if source is state and target not in found:
                found.add(target)
                wanted.append(target)
    return found


def test_every_state_is_reached_and_every_open_one_can_still_be_acknowledged():
    assert reachable(State.SEALED) == set(State)
    for state in OPEN:
        assert State.ACKNOWLEDGED in reachable(state)


def test_nothing_is_confirmed_that_was_not_in_a_block():
    assert {source for (source, _), target in TRANSITIONS.items() if target is State.CONFIRMED} == {State.INCLUDED}
    into_blocks = {event for (_, event), target in TRANSITIONS.items() if target is State.INCLUDED}
    assert into_blocks == {Event.MINED}
    assert all(TRANSITIONS[state, Event.REORGED] is State.PENDING for state in (State.INCLUDED, State.CONFIRMED))


def test_only_a_signed_transaction_is_sent():
    assert {event for (_, event), target in TRANSITIONS.items() if target in IN_FLIGHT} == {
        Event.SIGNED,
        Event.BUMPED,
        Event.DROPPED,
        Event.ACCEPTED,
        Event.REORGED,
    }
