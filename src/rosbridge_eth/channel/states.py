"""The states of a client and of a server's connection, as tables; an absent pair is an error.

What comes from the network is looked up first: a datagram whose input is not in the table for the present state is
dropped and counted. What this program itself does in the wrong state is a mistake of this program, and raises.
docs/channel.md shows these tables; `python -m rosbridge_eth.channel.states` prints them.
"""

from __future__ import annotations

from collections.abc import Mapping
from enum import StrEnum
from typing import TypeVar


class ClientState(StrEnum):
    """Where a client stands."""

    IDLE = "idle"  # made, or closed: nothing is sent
    GREETING = "greeting"  # HELLO sent, waiting for a COOKIE
    PROVING = "proving"  # PROOF sent, waiting for an OFFER
    FINISHING = "finishing"  # FINISHED sent, waiting for ACCEPTED
    CONNECTED = "connected"
    WAITING = "waiting"  # between two attempts


class ClientInput(StrEnum):
    """What happens to a client."""

    CONNECT = "connect()"
    COOKIE = "COOKIE"
    OFFER = "good OFFER"
    ACCEPTED = "ACCEPTED"
    FAILED = "attempt failed"
    RETRY = "wait is over"
    LOST = "session ended"
    CLOSE = "close()"


class ServerState(StrEnum):
    """Where one connection of a server stands; before the first there is a cookie, and no state."""

    ASSEMBLING = "assembling"  # some pieces of a PROOF, each with a good cookie
    OFFERED = "offered"  # OFFER sent, waiting for FINISHED
    CONNECTED = "connected"
    GONE = "gone"


class ServerInput(StrEnum):
    """What happens to a connection of a server."""

    PROOF = "good PROOF"
    REFUSED = "PROOF refused"
    FINISHED = "good FINISHED"
    EXPIRED = "half-open too long"
    CLOSED = "closed, silent or replaced"


CLIENT: Mapping[tuple[ClientState, ClientInput], ClientState] = {
    (ClientState.IDLE, ClientInput.CONNECT): ClientState.GREETING,
    (ClientState.GREETING, ClientInput.COOKIE): ClientState.PROVING,
    (ClientState.GREETING, ClientInput.FAILED): ClientState.WAITING,
    (ClientState.GREETING, ClientInput.CLOSE): ClientState.IDLE,
    (ClientState.PROVING, ClientInput.OFFER): ClientState.FINISHING,
    (ClientState.PROVING, ClientInput.FAILED): ClientState.WAITING,
    (ClientState.PROVING, ClientInput.CLOSE): ClientState.IDLE,
    (ClientState.FINISHING, ClientInput.ACCEPTED): ClientState.CONNECTED,
    (ClientState.FINISHING, ClientInput.FAILED): ClientState.WAITING,
    (ClientState.FINISHING, ClientInput.CLOSE): ClientState.IDLE,
    (ClientState.CONNECTED, ClientInput.LOST): ClientState.WAITING,
    (ClientState.CONNECTED, ClientInput.CLOSE): ClientState.IDLE,
    (ClientState.WAITING, ClientInput.RETRY): ClientState.GREETING,
    (ClientState.WAITING, ClientInput.CLOSE): ClientState.IDLE,
}

SERVER: Mapping[tuple[ServerState, ServerInput], ServerState] = {
    (ServerState.ASSEMBLING, ServerInput.PROOF): ServerState.OFFERED,
    (ServerState.ASSEMBLING, ServerInput.REFUSED): ServerState.GONE,
    (ServerState.ASSEMBLING, ServerInput.EXPIRED): ServerState.GONE,
    (ServerState.OFFERED, ServerInput.FINISHED): ServerState.CONNECTED,
    (ServerState.OFFERED, ServerInput.EXPIRED): ServerState.GONE,
    (ServerState.OFFERED, ServerInput.CLOSED): ServerState.GONE,
    (ServerState.CONNECTED, ServerInput.CLOSED): ServerState.GONE,
}

State = TypeVar("State", bound=StrEnum)
Input = TypeVar("Input", bound=StrEnum)


def advance(table: Mapping[tuple[State, Input], State], state: State, happened: Input) -> State:
    """The state after `happened`; RuntimeError if the table has no such step."""
    try:
        return table[state, happened]
    except KeyError:
        raise RuntimeError(f"{happened!r} cannot happen to a connection that is {state!r}") from None


def as_markdown(table: Mapping[tuple[State, Input], State]) -> str:
    """The table as Markdown, one step a line, in the order of the code."""
    lines = ["| state | what happens | next state |", "| --- | --- | --- |"]
    lines += [f"| {state} | {happened} | {after} |" for (state, happened), after in table.items()]
    return "\n".join(lines)


if __name__ == "__main__":
    print(f"Client\n\n{as_markdown(CLIENT)}\n\nServer, one connection\n\n{as_markdown(SERVER)}")
